"""How the image moves between two poses over level ground, and an image moved so."""

from functools import lru_cache

import numpy as np

# Pixels along a cell of the grid on which positions are exact: between them they err by less than 0.02 pixels.
_CELL = 8
# A ray that meets the ground farther than this, over the height above it, sees the sky or what moves like it.
_FARTHEST = 50.0
_LEAST_M = 0.1


def motion_px(camera, pose, other, ground_m):
    """Return how far the image moves from one pose to another, the most over nine points of the image [px].

    Parameters
    ----------
    camera : Camera
    pose, other : (4, 4) arrays
        world_from_camera.
    ground_m : float
        Height of the ground, taken as level [m, local up].
    """
    across, along = np.array([0.5, 0.25, 0.0]) * camera.width, np.array([0.5, 0.25, 0.0]) * camera.height
    pixel = np.stack(np.meshgrid(camera.width - 2 * across, camera.height - 2 * along), axis=-1).reshape(-1, 2)
    slope = camera.directions(pixel)
    ray = np.column_stack([slope, np.ones(len(slope))]) @ pose[:3, :3].T
    height = _off(pose[2, 3] - ground_m)
    down = -ray[:, 2] * np.sign(height)
    length = abs(height) / np.maximum(down, 1e-9)
    far = length > _FARTHEST * abs(height)
    # What is far away turns with the camera and does not shift.
    start = np.where(far[:, None], 0.0, pose[:3, 3] - other[:3, 3])
    seen = (start + np.where(far, 1.0, length)[:, None] * ray) @ other[:3, :3]
    moved = np.linalg.norm(camera.project(seen) - pixel, axis=1)
    # What leaves the view behind the camera has crossed the whole image.
    return float(np.nan_to_num(moved, nan=np.hypot(camera.width, camera.height)).max())


def _off(height):
    """A height above the ground that is not nothing, as of a camera that lies on it."""
    return np.copysign(max(abs(height), _LEAST_M), height)


def homography(seen_from, wanted_from, ground_m):
    """Return the (3, 3) matrix from slopes (x/z, y/z, 1) in one view to those in another, for points of level ground.

    Parameters
    ----------
    seen_from, wanted_from : (4, 4) arrays
        world_from_camera of the view whose slopes come out, and of that whose go in.
    ground_m : float
        Height of the ground [m, local up].
    """
    rotation = seen_from[:3, :3].T @ wanted_from[:3, :3]
    shift = seen_from[:3, :3].T @ (wanted_from[:3, 3] - seen_from[:3, 3])
    normal, distance = wanted_from[2, :3], -_off(wanted_from[2, 3] - ground_m)
    return rotation + np.outer(shift, normal) / distance


def source_pixels(camera, matrix):
    """Return where each pixel finds its value in an image seen through a homography, exact on a grid, linear between.

    Parameters
    ----------
    camera : Camera
    matrix : (3, 3) array
        As by `homography`.

    Returns
    -------
    column, row : (H, W) float32
        Of the image's array; whole numbers are middles of pixels. Far outside where nothing was in view.
    """
    import cv2

    grid, farthest = _grid(camera)
    x, y, w = matrix @ grid.reshape(-1, 3).T
    # Outside the image the model of the distortion holds no longer.
    outside = (w <= 0.0) | (np.hypot(x, y) > 1.02 * farthest * w)
    point = np.stack([np.where(outside, 0.0, x), np.where(outside, 0.0, y), np.where(outside, 1.0, w)], axis=-1)
    pixel = np.where(outside[:, None], -1e4, camera.project(point) - 0.5).reshape(*grid.shape[:2], 2)
    fine = cv2.resize(pixel.astype(np.float32), None, fx=_CELL, fy=_CELL, interpolation=cv2.INTER_LINEAR)
    part = fine[_CELL : _CELL + camera.height, _CELL : _CELL + camera.width]
    return np.ascontiguousarray(part[..., 0]), np.ascontiguousarray(part[..., 1])


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
    count = [-(-n // _CELL) + 2 for n in (camera.height, camera.width)]
    row, column = ((np.arange(n) - 0.5) * _CELL for n in count)
    inside = [np.clip(position, 0.0, n) for position, n in ((column, camera.width), (row, camera.height))]
    pixel = np.stack(np.meshgrid(*inside), axis=-1)
    outside = np.stack(np.meshgrid(column, row), axis=-1) - pixel
    # A cell outside continues the image with the focal length, so that no fold of the distortion is met.
    slope = camera.directions(pixel) + outside / camera.focal_length_px
    return np.concatenate([slope, np.ones_like(slope[..., :1])], axis=-1), np.linalg.norm(slope, axis=-1).max()
