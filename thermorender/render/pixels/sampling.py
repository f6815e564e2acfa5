"""Where a pixel is sampled: offsets in it, their rays, and which pixels show an edge and need more.

Texture inside a face is read on the face's plane without rays of its own (`thermorender.render.pixels.footprint`);
what that misses are edges, where one surface hides another. Across one plane the inverse of depth is linear in the
image, so an edge shows where its second difference does not vanish. How much an edge matters is told by the radiance
beside it.
"""

from dataclasses import dataclass

import drjit as dr
import numpy as np

from thermorender.render.geometry import aligned

# Sub-pixel offsets (right, down) in 0…1: lattices whose rows and columns are all different, with one point in each of
# the cells that a pixel is cut into.
_MULTIPLIER = {1: 1, 2: 1, 8: 5, 16: 5}
PATTERNS = {
    count: tuple(((index * step % count + 0.5) / count, (index + 0.5) / count) for index in range(count))
    for count, step in _MULTIPLIER.items()
} | {4: ((0.375, 0.125), (0.875, 0.375), (0.125, 0.625), (0.625, 0.875))}
_CELLS = {1: (1, 1), 2: (1, 2), 4: (2, 2), 8: (2, 4), 16: (4, 4)}

# Pixels beyond the image that are looked at: one tells of an edge between the two, and one of an edge in that one.
RING = 2
# Rays of an edge pixel, one stage after the other: after each, only pixels that still need it go on.
STAGES = (16, 64)
# Second difference of inverse depth, over inverse depth, from which on a pixel surely shows an edge.
_SURE_EDGE = 0.01
# How surely a pixel shows an edge that only a neighbour, or its corner, tells of.
_BESIDE = 0.5
# Two empirical errors of the mean of n evenly spread rays over an edge, as shares of the step; neither is a bound. The
# first, over n, decides which pixels get more rays: on heath 0.06, 0.016 and 0.004 are left at 4, 16 and 64 rays. The
# second, times n^−0.8, is for the budget: round heath's hottest objects 0.13, 0.045 and 0.0135 are left, and among a
# village's parked cars a fifth more.
_TYPICAL_EDGE, _SHARP_EDGE = 0.25, 0.37
# Empirical error of the mean of n taps of the texture: this share of the contrast with the neighbours, times n^−0.8.
# Above what heath and ridge show away from edges: 0.015–0.035, 0.011–0.019, 0.005–0.010 and 0.002–0.004 at 1, 2, 4 and
# 16 taps.
_TEXTURE = 0.04
# Steps from one pixel to the next in which nets are shifted (Roberts 2018).
_GOLDEN = np.array([0.7548776662466927, 0.5698402909980532])
# Of a step suspected from the neighbours, the share that may be there although no ray of the pixel met it.
UNSEEN = 0.25


def morton_order(height, width):
    """Return pixel numbers along a Z-order curve, (H·W,) int64: neighbours in it are neighbours in the image."""
    row, column = np.mgrid[:height, :width].astype(np.int64)
    code = np.zeros((height, width), dtype=np.int64)
    for bit in range(int(max(height, width) - 1).bit_length()):
        code |= ((column >> bit & 1) << (2 * bit)) | ((row >> bit & 1) << (2 * bit + 1))
    return np.argsort(code, axis=None, kind="stable")


class CameraRays:
    """A camera's rays on the render side, and those of a ring of pixels round its image, which tell of edges there.

    Attributes
    ----------
    camera : Camera
    width, height : int
        Of its image [px].
    order : (H·W,) int64
        Pixel numbers in the order the arrays keep; the ring follows.
    position : (H·W,) int64
        Where in that order each pixel is.
    ringed : UInt32
        Pixel numbers in the image with its ring of all in that order.
    """

    def __init__(self, mi, camera):
        self._mi, self.camera, self.width, self.height = mi, camera, camera.width, camera.height
        self.order = morton_order(camera.height, camera.width)
        self.position = np.empty_like(self.order)
        self.position[self.order] = np.arange(self.order.size)
        row, column = np.divmod(self.order, camera.width)
        ring = np.argwhere(np.pad(np.zeros((camera.height, camera.width), bool), RING, constant_values=True)) - RING
        row, column = np.concatenate([[row, column], ring.T], axis=1)
        self.ringed = mi.UInt32(aligned((row + RING) * (camera.width + 2 * RING) + column + RING, np.uint32))
        # A pixel of the ring is told by the one beside it in the image: its lens may end there.
        beside = np.clip(row, 0, camera.height - 1), np.clip(column, 0, camera.width - 1)

        def slopes(right, down):
            return camera.directions(np.stack([beside[1] + right, beside[0] + down], axis=-1))[:, :2]

        # Within a pixel a lens is linear to 1e-6 of a pixel.
        across, along = slopes(1.0, 0.5) - slopes(0.0, 0.5), slopes(0.5, 1.0) - slopes(0.5, 0.0)
        off = [(at - inside)[:, None] for at, inside in zip((row, column), beside, strict=True)]
        parts = (slopes(0.5, 0.5) + off[1] * across + off[0] * along, across, along)
        self._parts = [[mi.Float(aligned(part[:, axis])) for axis in (0, 1)] for part in parts]
        self._offsets = _net()
        self._net = [mi.Float(aligned(values)) for values in self._offsets.T]

    def slopes(self, right, down, index=None):
        """Return the slopes (x/z, y/z) of offsets 0…1 in pixels at `index` in the order, or of all and the ring."""
        return self._sloped(right, down, index)[0]

    def footprints(self, samples):
        """Return the Footprints of `samples` rays of every pixel and of the ring's, a list."""
        rows, columns = _CELLS[samples]
        size = dr.opaque(self._mi.Float, 1.0 / columns), dr.opaque(self._mi.Float, 1.0 / rows)
        found = []
        for right, down in PATTERNS[samples]:
            middle = np.floor(right * columns) + 0.5 - right * columns, np.floor(down * rows) + 0.5 - down * rows
            found.append(self._footprint(right, down, size, [float(value) for value in middle]))
        return found

    def _footprint(self, right, down, size, middle, index=None):
        slope, across, along = self._sloped(right, down, index)
        return Footprint(slope, [size[0] * value for value in across], [size[1] * value for value in along], middle)

    def _sloped(self, right, down, index):
        """(slope at offsets, its change across pixels, down them)."""
        middle, across, along = self._parts
        if index is not None:
            middle, across, along = (
                [dr.gather(self._mi.Float, values, index) for values in part] for part in (middle, across, along)
            )
        slope = [dr.fma(right - 0.5, across[axis], dr.fma(down - 0.5, along[axis], middle[axis])) for axis in (0, 1)]
        return slope, across, along

    def finer(self, position, first, last, within=None, shift=None):
        """Return the Footprints of rays first … last − 1 of the pixels at `position`, side by side per pixel.

        The pixel, or its part `within`, is cut into as many cells as `last`, of which each has the one its ray stands
        in.

        Parameters
        ----------
        position : (n,) int
            In the order of `order`.
        first, last : int
        within : Rectangles, optional
            One for each pixel.
        shift : (n, 2), optional
            By how much the rays of each pixel are shifted, each round its cell, in sides of that.
        """
        mi = self._mi
        # Opaque numbers: as literals they would have the kernel compiled anew for each stage.
        count, start = dr.opaque(mi.UInt32, last - first), dr.opaque(mi.UInt32, first)
        ray = dr.arange(mi.UInt32, len(position) * (last - first))
        pixel = ray // count
        index = dr.gather(mi.UInt32, mi.UInt32(aligned(position, np.uint32)), pixel)
        offset = [dr.gather(mi.Float, values, ray % count + start) for values in self._net]
        if within is not None:
            # A thing stands in the middle of its rectangle, where the same net would err alike each time.
            offset = _round(mi, offset, (position[:, None] * _GOLDEN) % 1.0, pixel)
        side = dr.opaque(mi.Float, last**0.5)
        if shift is not None:
            cell = [dr.floor(value * side) for value in offset]
            inner = [value * side - first for value, first in zip(offset, cell, strict=True)]
            inner = _round(mi, inner, shift, pixel)
            offset = [(first + value) / side for first, value in zip(cell, inner, strict=True)]
        middle = [dr.floor(value * side) + 0.5 - value * side for value in offset]
        size = [1.0 / side, 1.0 / side]
        if within is not None:
            corner, sides = (
                [dr.gather(mi.Float, mi.Float(aligned(part[:, axis])), pixel) for axis in (0, 1)]
                for part in (within.corner, within.size)
            )
            offset = [dr.fma(value, a, b) for value, a, b in zip(offset, sides, corner, strict=True)]
            size = [value * part for value, part in zip(size, sides, strict=True)]
        return self._footprint(*offset, size, middle, index)

    def outside(self, within, count):
        """Which of the first `count` rays of pixels lie outside of their Rectangles, (n, count) bool."""
        from_corner = self._offsets[:count] - within.corner[:, None]
        return ~((from_corner >= 0.0) & (from_corner < within.size[:, None])).all(axis=-1)


@dataclass(frozen=True)
class Footprint:
    """A ray and the part of a pixel that it stands for.

    Attributes
    ----------
    slope : (x/z, y/z)
        Of the ray.
    across, along : (x/z, y/z)
        How slopes change from one side of the cell to the other.
    middle : (right, down)
        Of the cell, from the ray, in sides of the cell.
    """

    slope: list
    across: list
    along: list
    middle: list


def _round(mi, values, shift, index):
    """(x, y) in 0…1, shifted by those of `shift` (n, 2) at `index` and round."""
    by = (dr.gather(mi.Float, mi.Float(aligned(part)), index) for part in np.asarray(shift).T)
    total = [value + each for value, each in zip(values, by, strict=True)]
    return [value - dr.floor(value) for value in total]


def places(count):
    """Return `count` offsets (right, down) from the middle of a cell, −0.5…0.5, evenly spread."""
    if count == 16:
        return [((column - 1.5) / 4.0, (row - 1.5) / 4.0) for row in range(4) for column in range(4)]
    return [(right - 0.5, down - 0.5) for right, down in PATTERNS[count]]


def _net():
    """Offsets (64, 2), evenly spread in 0…1, and so are the first 16: Sobol's sequence."""
    from scipy.stats import qmc

    number = np.rint(qmc.Sobol(2, scramble=False).random(STAGES[-1]) * STAGES[-1]).astype(int)
    # Its points lie on the corners of their cells; these digits move those of every stage near the middles.
    return ((number ^ 0b001010) + 0.5) / STAGES[-1]


def edge_step(radiance, inverse_depth, surface=None):
    """Return by how much radiance may differ at an edge within each pixel, (H, W) float32.

    Parameters
    ----------
    radiance : (H + 2 RING, W + 2 RING) float32
        Of the image with its ring.
    inverse_depth : (H + 2 RING, W + 2 RING) float32
        1/depth along the optical axis [1/m], 0 where nothing is hit.
    surface : (H + 2 RING, W + 2 RING) float32, optional
        Number of the surface seen.

    Notes
    -----
    The most that a pixel differs from any of its eight neighbours, times how surely there is an edge in it.
    """
    import cv2

    near = np.ones((3, 3), np.uint8)
    # Where nothing is hit any bend is an edge.
    bend = _second_difference(inverse_depth) / np.maximum(_SURE_EDGE * inverse_depth, 1e-30)
    if surface is not None:
        bend[_second_difference(surface) != 0.0] = 1.0
    bend = np.minimum(bend, 1.0)
    bend = np.maximum(bend, _BESIDE * cv2.dilate(bend, near))
    step = bend * np.maximum(cv2.dilate(radiance, near) - radiance, radiance - cv2.erode(radiance, near))
    return step[RING:-RING, RING:-RING]


def contrast(radiance):
    """Return the span of an image (H, W) float32 over each pixel and its eight neighbours."""
    import cv2

    near = np.ones((3, 3), np.uint8)
    return cv2.dilate(radiance, near) - cv2.erode(radiance, near)


def typical_edge_estimate(step, count):
    """Return the usual error of the mean of `count` rays over a pixel in which radiance differs by `step`.

    Fitted on heath.
    """
    return _TYPICAL_EDGE * step / count


def edge_estimate(step, count):
    """Return the error of the mean of `count` rays over a pixel whose step is one sharp edge.

    Fitted on the hottest objects of heath and the parked cars of village: an estimate, which other scenes may exceed.
    """
    return _SHARP_EDGE * count**-0.8 * step


def texture_estimate(span, count):
    """Return the error of the mean of `count` taps in a pixel that differs by `span` from its neighbours.

    Fitted on heath and ridge: an estimate, which other textures may exceed.
    """
    return _TEXTURE * count**-0.8 * span


def _second_difference(image):
    import cv2

    return np.abs(cv2.Laplacian(image, cv2.CV_32F, borderType=cv2.BORDER_REPLICATE))
