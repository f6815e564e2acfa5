"""Samples of a pixel: their offsets, their rays, and the search for pixels with an edge, which need more.

Texture inside a face is read on the face's plane without further rays (`thermorender.render.pixels.footprint`). This
misses edges, where one surface hides another. Across one plane the inverse of depth is linear in the image, so an edge
shows where its second difference is not zero. The contrast of radiance there measures the effect of the edge.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from thermorender.render.arrays import Floats, Jit, Mitsuba, aligned
from thermorender.render.pixels.slender import Rectangles
from thermorender.sensor.camera import Camera

# Sub-pixel offsets (right, down) in 0…1: lattices with all rows and columns different, and one point in each cell.
_MULTIPLIER = {1: 1, 2: 1, 8: 5, 16: 5}
PATTERNS = {
    count: tuple(((index * step % count + 0.5) / count, (index + 0.5) / count) for index in range(count))
    for count, step in _MULTIPLIER.items()
} | {4: ((0.375, 0.125), (0.875, 0.375), (0.125, 0.625), (0.625, 0.875))}
# (rows, columns) of a pixel's cells.
_CELLS = {1: (1, 1), 2: (1, 2), 4: (2, 2), 8: (2, 4), 16: (4, 4)}

# Pixels evaluated beyond the image: one to find an edge next to the border, one to find an edge in that pixel.
RING = 2
# Rays of an edge pixel after each stage; only pixels that still need it enter the next stage.
STAGES = (16, 64)
# Of those that show copies of a body: all pixels of a crown have edges, and few rays are enough for most.
COPIES_STAGES = (4, 16, 64)
# Relative second difference of inverse depth above which a pixel certainly shows an edge.
_SURE_EDGE = 0.01
# Confidence in an edge that only a neighbouring pixel shows.
_BESIDE = 0.5
# Two empirical errors of the mean of n evenly spread rays over an edge, relative to the step; neither is a bound. The
# first, over n, selects the pixels that get more rays: on heath it is 0.06, 0.016 and 0.004 at 4, 16 and 64 rays. The
# second, times n^−0.8, is for the budget: 0.13, 0.045 and 0.0135 round heath's hottest objects, and a fifth more among
# a village's parked cars.
_TYPICAL_EDGE, _SHARP_EDGE = 0.25, 0.37
# Empirical error of the mean of n taps of the texture, relative to the contrast with the neighbours, times n^−0.8. It
# exceeds the errors on heath and ridge away from edges: 0.015–0.035, 0.011–0.019, 0.005–0.010 and 0.002–0.004 at 1, 2,
# 4 and 16 taps.
_TEXTURE = 0.04
# Side of the squares of pixels in which a horizon is looked for [px].
_SQUARE = 16
# Shift of the net from one pixel to the next (Roberts 2018).
_GOLDEN = np.array([0.7548776662466927, 0.5698402909980532])
# Direction numbers of the second dimension of the Sobol sequence, before they are shifted to the first bit.
_DIRECTIONS = (1, 3, 5, 15, 17, 51)
# Share of a step suspected from the neighbours that may exist although no ray of the pixel shows it.
UNSEEN = 0.25


def morton_order(height: int, width: int) -> NDArray[np.int64]:
    """Return pixel numbers along a Z-order curve, (H·W,) int64; neighbours on it are neighbours in the image."""
    row, column = np.mgrid[:height, :width].astype(np.int64)
    code = np.zeros((height, width), dtype=np.int64)
    for bit in range(int(max(height, width) - 1).bit_length()):
        code |= ((column >> bit & 1) << (2 * bit)) | ((row >> bit & 1) << (2 * bit + 1))
    return np.argsort(code, axis=None, kind="stable")


class CameraRays:
    """A camera's rays on the render side, including a ring of pixels round its image, needed to find edges there."""

    def __init__(self, mi: Mitsuba, camera: Camera) -> None:
        self.mi, self.camera, self.width, self.height = mi, camera, camera.width, camera.height
        # (H·W,) pixel numbers in the order of the arrays, where the ring follows; position of each pixel in it.
        self.order = morton_order(camera.height, camera.width)
        self.position = np.empty_like(self.order)
        self.position[self.order] = np.arange(self.order.size)
        row, column = np.divmod(self.order, camera.width)
        ring = np.argwhere(np.pad(np.zeros((camera.height, camera.width), bool), RING, constant_values=True)) - RING
        row, column = np.concatenate([[row, column], ring.T], axis=1)
        # Numbers of all pixels in the image with its ring, in that order.
        self.ringed = mi.UInt32(aligned((row + RING) * (camera.width + 2 * RING) + column + RING, np.uint32))
        # The ring is extrapolated from the nearest pixels of the image, since the lens may not extend to it.
        beside = np.clip(row, 0, camera.height - 1), np.clip(column, 0, camera.width - 1)

        def slopes(right: float, down: float) -> Floats:
            return camera.directions(np.stack([beside[1] + right, beside[0] + down], axis=-1))[:, :2]

        # Within a pixel a lens is linear to 3e-4 of a pixel, up to k1 = −0.26.
        across, along = slopes(1.0, 0.5) - slopes(0.0, 0.5), slopes(0.5, 1.0) - slopes(0.5, 0.0)
        off = [(at - inside)[:, None] for at, inside in zip((row, column), beside, strict=True)]
        parts = (slopes(0.5, 0.5) + off[1] * across + off[0] * along, across, along)
        self._parts = [[mi.Float(aligned(part[:, axis])) for axis in (0, 1)] for part in parts]
        # `SampledImage.hit` of the image rendered last, None where crowns may cover it; the Hit of its rays through the
        # pixels' middles on what is solid, with surfaces numbered over the layers; and its geometry and pose if no
        # object moves. Kept here, so that frames in memory do not each hold it; set and read as a whole.
        self.last_hits: tuple[NDArray[np.bool_] | None, Any, tuple[Any, bytes] | None] | None = None
        self._offsets = _net()
        self._net = [mi.Float(aligned(values)) for values in self._offsets.T]

    def slopes(self, right: Jit, down: Jit, index: Jit = None) -> list[Jit]:
        """Return the slopes (x/z, y/z) of offsets 0…1 in pixels at `index` in the order, or in all with the ring."""
        return self._sloped(right, down, index)[0]

    def crossed(self, up: Floats, horizon: float) -> NDArray[np.int64]:
        """Return the flat numbers of pixels on and next to a horizon, at cosine `horizon` from the vertical `up` (3,)
        in the camera."""
        x, y, side = self._middles

        def rise(*at: Any) -> NDArray[Any]:
            x_at, y_at = x[at], y[at]
            return (up[0] * x_at + up[1] * y_at + up[2]) / np.sqrt(1.0 + x_at * x_at + y_at * y_at) - horizon

        # Squares of pixels first.
        every = slice(None, None, _SQUARE)
        square = np.argwhere(np.abs(rise(every, every)) <= _SQUARE * side)
        inner = np.indices((_SQUARE, _SQUARE)).reshape(2, -1)
        row, column = (_SQUARE * square.T[:, :, None] + inner[:, None]).reshape(2, -1)
        inside = (row < self.height) & (column < self.width)
        row, column = row[inside], column[inside]
        on = np.abs(rise(row, column)) <= 0.5 * side
        return row[on] * self.width + column[on]

    @cached_property
    def _middles(self) -> tuple[NDArray[np.float32], NDArray[np.float32], float]:
        """(x/z (H, W), y/z (H, W) of the pixels' middles, largest change across plus down a pixel)."""
        middle, *sides = ([np.array(values)[self.position] for values in part] for part in self._parts)
        x, y = (values.reshape(self.height, self.width) for values in middle)
        return x, y, float(sum(np.hypot(*part) for part in sides).max())

    @cached_property
    def slope_range(self) -> Floats:
        """Least and largest slopes of rays in all pixels and the ring, (2, 2): of x/z and y/z."""
        middle, *sides = (np.array([np.array(values) for values in part]) for part in self._parts)
        half = 0.5 * sum(np.abs(side) for side in sides)
        return np.stack([(middle - half).min(axis=1), (middle + half).max(axis=1)]).astype(np.float64)

    def footprints(self, samples: int) -> list["Footprint"]:
        """Return the Footprints of `samples` rays of every pixel, including the ring."""
        rows, columns = _CELLS[samples]
        size = dr.opaque(self.mi.Float, 1.0 / columns), dr.opaque(self.mi.Float, 1.0 / rows)
        found = []
        for right, down in PATTERNS[samples]:
            middle = np.floor(right * columns) + 0.5 - right * columns, np.floor(down * rows) + 0.5 - down * rows
            found.append(self._footprint(right, down, size, [float(value) for value in middle]))
        return found

    def _footprint(
        self, right: Jit, down: Jit, size: Sequence[Jit], middle: list[Jit], index: Jit = None
    ) -> "Footprint":
        slope, across, along = self._sloped(right, down, index)
        return Footprint(slope, [size[0] * value for value in across], [size[1] * value for value in along], middle)

    def _sloped(self, right: Jit, down: Jit, index: Jit) -> tuple[list[Jit], list[Jit], list[Jit]]:
        """(slope at offsets, its change across a pixel, down a pixel)."""
        middle, across, along = self._parts
        if index is not None:
            middle, across, along = (
                [dr.gather(self.mi.Float, values, index) for values in part] for part in (middle, across, along)
            )
        slope = [dr.fma(right - 0.5, across[axis], dr.fma(down - 0.5, along[axis], middle[axis])) for axis in (0, 1)]
        return slope, across, along

    def finer(
        self, position: NDArray[np.integer], first: int, last: int, within: Rectangles | None = None,
        shift: Floats | None = None,
    ) -> "Footprint":  # fmt: skip
        """Return the Footprints of rays first … last − 1 of the pixels at `position`, side by side per pixel. The
        pixel, or its part in `within`, is divided into `last` cells, one per ray; `shift` (n, 2) moves rays cyclically
        within their cells."""
        mi = self.mi
        # Opaque: literals would compile the kernel again for each stage.
        count, start = dr.opaque(mi.UInt32, last - first), dr.opaque(mi.UInt32, first)
        ray = dr.arange(mi.UInt32, len(position) * (last - first))
        pixel = ray // count
        index = dr.gather(mi.UInt32, mi.UInt32(aligned(position, np.uint32)), pixel)
        offset = [dr.gather(mi.Float, values, ray % count + start) for values in self._net]
        if within is not None:
            # Details are in the middle of their rectangles, where the same net would repeat its error.
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
        right, down = offset
        return self._footprint(right, down, size, middle, index)

    def outside(self, within: Rectangles, count: int) -> Any:
        """Return which of the first `count` rays of pixels are outside their Rectangles, (n, count) bool."""
        from_corner = self._offsets[:count] - within.corner[:, None]
        return ~((from_corner >= 0.0) & (from_corner < within.size[:, None])).all(axis=-1)


@dataclass(frozen=True)
class Footprint:
    """A ray and the part of a pixel, its cell, that it represents."""

    slope: list[Jit]  # (x/z, y/z) of the ray
    across: list[Jit]  # change of the slope from the left to the right side of the cell
    along: list[Jit]  # from its upper to its lower side
    middle: list[Jit]  # (right, down) of the cell, from the ray, in sides of the cell


def _round(mi: Mitsuba, values: Sequence[Jit], shift: Floats, index: Jit) -> list[Jit]:
    """(x, y) in 0…1, shifted cyclically by `shift` (n, 2) at `index`."""
    by = (dr.gather(mi.Float, mi.Float(aligned(part)), index) for part in np.asarray(shift).T)
    total = [value + each for value, each in zip(values, by, strict=True)]
    return [value - dr.floor(value) for value in total]


def places(count: int) -> list[tuple[float, float]]:
    """Return `count` offsets (right, down) from the middle of a cell, −0.5…0.5, evenly spread."""
    if count == 16:
        return [((column - 1.5) / 4.0, (row - 1.5) / 4.0) for row in range(4) for column in range(4)]
    return [(right - 0.5, down - 0.5) for right, down in PATTERNS[count]]


def _net() -> Floats:
    """Offsets (64, 2) in 0…1 from the Sobol sequence; the first 16 are evenly spread too."""
    bits = STAGES[-1].bit_length() - 1
    # Direction numbers of the first two dimensions (Sobol 1967); scipy.stats, which has them too, takes 0.5 s to load.
    numbers = np.array([[1 << (bits - 1 - k), _DIRECTIONS[k] << (bits - 1 - k)] for k in range(bits)])
    number = np.zeros((STAGES[-1], 2), dtype=int)
    for k in range(1, STAGES[-1]):
        # Points in the order of the Gray code differ from the one before in a single bit of their number.
        number[k] = number[k - 1] ^ numbers[(k & -k).bit_length() - 1]
    # Sobol points are at the corners of their cells; these digits move those of every stage near the middles.
    return ((number ^ 0b001010) + 0.5) / STAGES[-1]


def edge_step(
    radiance: NDArray[np.float32], inverse_depth: NDArray[np.float32], surface: NDArray[np.float32] | None = None
) -> NDArray[np.float32]:
    """Return the difference of radiance that an edge may cause within each pixel, (H, W) float32: the largest
    difference from its eight neighbours, times the confidence that it contains an edge. The inputs (H + 2 RING, W + 2
    RING) float32 are images with their ring: radiance, 1/depth along the optical axis [1/m], 0 where nothing is hit,
    and the number of the surface."""
    import cv2

    near = np.ones((3, 3), np.uint8)
    # Where nothing is hit any second difference is an edge.
    bend = _second_difference(inverse_depth) / np.maximum(_SURE_EDGE * inverse_depth, 1e-30)
    if surface is not None:
        bend[_second_difference(surface) != 0.0] = 1.0
    bend = np.minimum(bend, 1.0)
    bend = np.maximum(bend, _BESIDE * cv2.dilate(bend, near))
    step = bend * np.maximum(cv2.dilate(radiance, near) - radiance, radiance - cv2.erode(radiance, near))
    return step[RING:-RING, RING:-RING]


def touched(shown: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return where a pixel or one of its eight neighbours is shown, (H, W), of an image with its ring."""
    import cv2

    return cv2.dilate(shown.astype(np.uint8), np.ones((3, 3), np.uint8))[RING:-RING, RING:-RING].astype(bool)


def contrast(radiance: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the range of an image (H, W) float32 over each pixel and its eight neighbours."""
    import cv2

    near = np.ones((3, 3), np.uint8)
    return cv2.dilate(radiance, near) - cv2.erode(radiance, near)


def typical_edge_estimate(step: NDArray[Any], count: int) -> NDArray[Any]:
    """Return the usual error of the mean of `count` rays in a pixel with a difference of `step`, fitted on heath."""
    return _TYPICAL_EDGE * step / count


def usual_step(error: float, count: int) -> float:
    """Return the difference in a pixel for which `typical_edge_estimate` of `count` rays gives `error`."""
    return error * count / _TYPICAL_EDGE


def edge_estimate(step: NDArray[Any], count: int) -> NDArray[Any]:
    """Return the error of the mean of `count` rays in a pixel whose step is one sharp edge. Fitted on the hottest
    objects of heath and the parked cars of village: an estimate that other scenes may exceed."""
    return _SHARP_EDGE * count**-0.8 * step


def texture_estimate(span: NDArray[Any], count: int) -> NDArray[Any]:
    """Return the error of the mean of `count` taps in a pixel that differs by `span` from its neighbours. Fitted on
    heath and ridge: an estimate that other textures may exceed."""
    return _TEXTURE * count**-0.8 * span


def _second_difference(image: NDArray[np.float32]) -> NDArray[np.float32]:
    import cv2

    return np.abs(cv2.Laplacian(image, cv2.CV_32F, borderType=cv2.BORDER_REPLICATE))
