"""How the image of what lies at known depths moves between poses, and an image moved so."""

from functools import lru_cache

import numpy as np

# Cells across the grid on which positions are exact, and the most pixels along a cell: over level ground they err
# between by less than 0.02 pixels.
_CELLS, _CELL = 80, 8
# Depth that is not nothing, as of a camera that lies on the ground [m].
_LEAST_M = 0.1
# Rounds in which a point of another view is looked for in the own.
_ROUNDS = 2


class Relief:
    """What a view shows, as far as that moves its image: how far away, on a grid, linear in 1/depth between.

    Parameters
    ----------
    camera : Camera
    pose : (4, 4) array
        world_from_camera of the view.
    depth : (h, w) array
        Along the optical axis, of the middles of the pixels of `grid_camera(camera)`; infinite where nothing is [m].
    """

    def __init__(self, camera, pose, depth):
        import cv2

        self._camera, self._pose = camera, np.asarray(pose)
        self._slope, self._farthest = _grid(camera)
        near = (1.0 / np.maximum(depth, _LEAST_M)).astype(np.float32)
        # The rim of what stands before nothing moves with it.
        near = np.where(near > 0.0, near, cv2.dilate(near, np.ones((3, 3), np.uint8)))
        more = [(1, grid - 1 - told) for grid, told in zip(self._slope.shape, near.shape, strict=False)]
        self._near = np.pad(near, more, mode="edge")

    def motion_px(self, other):
        """Return how far the image moves from its pose to another, the most over all but a fiftieth of it [px]."""
        inner = np.s_[1:-1, 1:-1]
        turn, shift = _between(other, self._pose)
        seen = self._slope[inner] @ turn.T + self._near[inner][..., None] * shift
        way = self._camera.project(seen) - self._camera.project(self._slope[inner])
        # What leaves the view behind the camera has crossed the whole image.
        most = np.hypot(self._camera.width, self._camera.height)
        return float(np.percentile(np.nan_to_num(np.linalg.norm(way, axis=-1), nan=most), 98.0))

    def source_pixels(self, seen_from, wanted_from):
        """Return where each pixel of a view finds its value in another's image, exact on a grid, linear between.

        Parameters
        ----------
        seen_from, wanted_from : (4, 4) arrays
            world_from_camera of the view that an image is of, and of that which is wanted; both near the own pose.

        Returns
        -------
        column, row : (H, W) float32
            Of the image's array; whole numbers are middles of pixels. Far outside where nothing was in view.
        """
        import cv2

        turn, shift = _between(seen_from, wanted_from)
        x, outside = self._seen(turn, shift, self._from(wanted_from))
        pixel = np.where(outside[..., None], -1e4, self._camera.project(x) - 0.5)
        cell = _cell(self._camera)
        fine = cv2.resize(pixel.astype(np.float32), None, fx=cell, fy=cell, interpolation=cv2.INTER_LINEAR)
        part = fine[cell : cell + self._camera.height, cell : cell + self._camera.width]
        return np.ascontiguousarray(part[..., 0]), np.ascontiguousarray(part[..., 1])

    def _from(self, wanted_from):
        """1/depth on the grid as seen from another pose: found in the own view, by where it is thought to lie there."""
        import cv2

        near = self._near
        if np.array_equal(wanted_from, self._pose):
            return near
        turn, shift = _between(self._pose, wanted_from)
        for _ in range(_ROUNDS):
            x, outside = self._seen(turn, shift, near)
            place = (self._camera.project(x) / _cell(self._camera) + 0.5).astype(np.float32)
            edge = cv2.BORDER_REPLICATE
            found = cv2.remap(self._near, place[..., 0], place[..., 1], cv2.INTER_LINEAR, borderMode=edge)
            # Depth along the wanted axis, times what was found.
            deep = (x / x[..., 2:] - found[..., None] * shift) @ turn[:, 2]
            near = np.where(outside | (deep <= 0.0), near, found / np.where(deep <= 0.0, 1.0, deep))
        return near

    def _seen(self, turn, shift, near):
        """(Points of the grid in another view's axes, over their depth here; which of them are not in that view)."""
        x = self._slope @ turn.T + near[..., None] * shift
        # Outside the image the model of the distortion holds no longer.
        outside = (x[..., 2] <= 0.0) | (np.hypot(x[..., 0], x[..., 1]) > 1.02 * self._farthest * x[..., 2])
        return np.where(outside[..., None], (0.0, 0.0, 1.0), x), outside


def grid_camera(camera):
    """Return the Camera that has a pixel for each cell of the grid that a Relief is told on."""
    return camera.coarser(_cell(camera))


def _cell(camera):
    """Pixels along a cell of the grid."""
    return min(max(camera.width // _CELLS, 1), _CELL)


def _between(seen_from, wanted_from):
    """(Rotation, shift) from the axes of one camera, `wanted_from`, to those of another."""
    turn = seen_from[:3, :3].T
    return turn @ wanted_from[:3, :3], turn @ (wanted_from[:3, 3] - seen_from[:3, 3])


def moved(image, column, row, coarsely=False):
    """Return the values of an image (H, W) float32 at positions between its pixels, as by `source_pixels`.

    Cubic between pixels; `coarsely` linear, three times as fast, which blurs. The nearest border where a
    position lies outside.
    """
    import cv2

    if coarsely:
        return cv2.remap(image, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    column, row = _straight(column), _straight(row)
    return cv2.remap(image, column, row, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


def guess_of(image, column, row):
    """Return how uncertain the values of an image are at positions beyond it, where `moved` gives its nearest border:
    by how much that differs from what lies as far within; 0 at positions within."""
    import cv2

    borders = (cv2.BORDER_REPLICATE, cv2.BORDER_REFLECT_101)
    nearest, within = (cv2.remap(image, column, row, cv2.INTER_LINEAR, borderMode=border) for border in borders)
    return np.abs(nearest - within)


def _straight(position):
    """Positions at which OpenCV's cubic weights give what belongs to `position`.

    The weights (a = −¾ of Keys 1981, doi:10.1109/TASSP.1981.1163711) do not keep a slope straight: they read it
    ½ f (1−f) (1−2f) of a pixel too far, f being the fraction of the position. Where a whole image moves by the same
    fraction this would shift it by up to 0.05 pixels.
    """
    whole = np.floor(position)
    whole += np.float32(0.5)
    # Fractions counted from the middle between two pixels, h: too far by −h (¼ − h²).
    wanted = position - whole
    half = wanted
    for _ in range(2):
        more = half * half
        np.subtract(np.float32(0.25), more, out=more)
        more *= half
        half = more
        half += wanted
    half += whole
    return half


@lru_cache(maxsize=2)
def pixel_grid(camera):
    """Return the (column, row) of each pixel of the image's array, each (H, W) float32, read-only."""
    row, column = np.mgrid[: camera.height, : camera.width].astype(np.float32)
    row.flags.writeable = column.flags.writeable = False
    return column, row


@lru_cache(maxsize=2)
def _grid(camera):
    """(slopes with a third 1, (h, w, 3), at the middles of cells, one cell more on each side; the largest slope)."""
    cell = _cell(camera)
    count = [-(-n // cell) + 2 for n in (camera.height, camera.width)]
    row, column = ((np.arange(n) - 0.5) * cell for n in count)
    inside = [np.clip(position, 0.0, n) for position, n in ((column, camera.width), (row, camera.height))]
    pixel = np.stack(np.meshgrid(*inside), axis=-1)
    outside = np.stack(np.meshgrid(column, row), axis=-1) - pixel
    # A cell outside continues the image with the focal length, so that no fold of the distortion is met.
    slope = camera.directions(pixel) + outside / camera.focal_length_px
    return np.concatenate([slope, np.ones_like(slope[..., :1])], axis=-1), np.linalg.norm(slope, axis=-1).max()
