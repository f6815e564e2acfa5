"""Where a pixel is sampled: places in it, their rays, and which pixels show an edge and need more.

Texture inside a face is sampled on the face's plane without rays of its own; what that misses are edges, where
one surface hides another. Across one plane the inverse of depth is linear in the image, so an edge shows where its
second difference does not vanish.
"""

import drjit as dr
import numpy as np

# Sub-pixel places (right, down) in 0…1: lattices whose rows and columns are all different.
_MULTIPLIER = {1: 1, 2: 1, 8: 5, 16: 7, 32: 7, 64: 19}
PATTERNS = {
    count: tuple(((index * step % count + 0.5) / count, (index + 0.5) / count) for index in range(count))
    for count, step in _MULTIPLIER.items()
} | {4: ((0.375, 0.125), (0.875, 0.375), (0.125, 0.625), (0.625, 0.875))}
_CELLS = {1: (1, 1), 2: (1, 2), 4: (2, 2), 8: (2, 4), 16: (4, 4)}

# Second difference of inverse depth, over inverse depth, from which on a pixel shows an edge. On the shipped heath
# 0.002 marks 1 % of the pixels looking down and 10 % at 45°, and leaves 12 and 29 mK in the others.
EDGE = 0.002


def places(samples, taps):
    """Return [(ray, [tap, …]), …] of a pixel, each place as (right, down) in 0…1.

    Single places make up one lattice. Where a ray has several, it stands in the middle of a cell of the pixel and
    they form a lattice in that cell.
    """
    if taps == 1:
        return [(place, [place]) for place in PATTERNS[samples]]
    rows, columns = _CELLS[samples]
    return [
        (
            ((column + 0.5) / columns, (row + 0.5) / rows),
            [((column + right) / columns, (row + down) / rows) for right, down in PATTERNS[taps]],
        )
        for row in range(rows)
        for column in range(columns)
    ]


def morton_order(height, width):
    """Return pixel numbers along a Z-order curve, (H·W,) int64: neighbours in it are neighbours in the image."""
    row, column = np.mgrid[:height, :width].astype(np.int64)
    code = np.zeros((height, width), dtype=np.int64)
    for bit in range(int(max(height, width) - 1).bit_length()):
        code |= ((column >> bit & 1) << (2 * bit)) | ((row >> bit & 1) << (2 * bit + 1))
    return np.argsort(code, axis=None, kind="stable")


class CameraRays:
    """A camera's rays for a sampling, on the render side.

    Parameters
    ----------
    mi : module
    camera : Camera
    samples, taps, edge_samples : int
        Rays per pixel, places per ray, and rays per pixel that shows an edge.

    Attributes
    ----------
    order : (H·W,) int64
        Pixel numbers in the order the arrays below keep.
    pixel : UInt32
        The same, on the render side.
    rays : list of ((x, y), [(x, y), …])
        Slopes x/z and y/z of each ray and of its taps, Float.
    """

    def __init__(self, mi, camera, samples, taps, edge_samples):
        self._mi, self._camera, self._edge_samples = mi, camera, edge_samples
        self.order = morton_order(camera.height, camera.width)
        self._position = np.empty_like(self.order)
        self._position[self.order] = np.arange(self.order.size)
        self.pixel = mi.UInt32(self.order.astype(np.uint32))
        self.rays = [
            (self._slopes(ray), [self._slopes(tap) for tap in taps_]) for ray, taps_ in places(samples, taps)
        ]
        self._edge_slopes = None

    def at_edges(self, marked):
        """Return (pixel numbers, x, y) of the pixels marked in an (H, W) bool image, and their rays' slopes.

        The slopes have `edge_samples` entries per pixel, side by side.
        """
        mi, count = self._mi, self._edge_samples
        if self._edge_slopes is None:
            found = np.stack([self._slopes_array(place) for place in PATTERNS[count]], axis=1)
            self._edge_slopes = [mi.Float(found[..., axis].ravel()) for axis in (0, 1)]
        position = np.sort(self._position[np.flatnonzero(marked)])
        ray = dr.arange(mi.UInt32, position.size * count)
        index = dr.gather(mi.UInt32, mi.UInt32(position.astype(np.uint32)), ray // count) * count + ray % count
        return self.order[position], *(dr.gather(mi.Float, slopes, index) for slopes in self._edge_slopes)

    def _slopes_array(self, place):
        row, column = np.divmod(self.order, self._camera.width)
        pixel = np.stack([column + place[0], row + place[1]], axis=-1)
        return self._camera.directions(pixel).astype(np.float32)

    def _slopes(self, place):
        found = self._slopes_array(place)
        return self._mi.Float(found[:, 0].copy()), self._mi.Float(found[:, 1].copy())


def edges(inverse_depth, surface):
    """Return the pixels that may show an edge, (H, W) bool.

    Parameters
    ----------
    inverse_depth : (H, W) float32
        1/depth along the optical axis [1/m], 0 where nothing is hit.
    surface : (H, W) float32
        Number of the surface seen.
    """
    import cv2

    bend = np.abs(cv2.Laplacian(inverse_depth, cv2.CV_32F, borderType=cv2.BORDER_REPLICATE)) > EDGE * inverse_depth
    bend |= cv2.Laplacian(surface, cv2.CV_32F, borderType=cv2.BORDER_REPLICATE) != 0.0
    return cv2.dilate(bend.view(np.uint8), np.ones((3, 3), np.uint8)).view(bool)
