"""Motion of an image between poses, from the depth of the scene, and resampling of an image by that motion."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.errors import ThermorenderError
from thermorender.sensor.camera import Camera, Image, Pose

# Cells across the grid on which positions are exact, and the most pixels along a cell: over level ground the error
# between is below 0.03 pixels.
_CELLS, _CELL = 80, 8
# Least depth, as of a camera on the ground [m].
_LEAST_M = 0.1
# Iterations that find the point of another view in this one.
_ROUNDS = 2
# Share of the slope of the image's corner up to which directions count as seen: a distortion is not valid far outside.
_BEYOND = 1.02


@dataclass(frozen=True)
class WideImage:
    """An image (h, w) float32 that may reach beyond the sensor's borders. The sensor's first pixel is `left` columns
    and `top` rows inside."""

    image: Image
    left: int = 0
    top: int = 0

    def of(self, camera: Camera) -> Image:
        """Return the part within the camera's borders, (H, W)."""
        return self.image[self.top :, self.left :][: camera.height, : camera.width]

    def moved(self, column: Image, row: Image) -> Image:
        """Return the image at (column, row) of the sensor, as `moved`."""
        return moved(self.image, column + np.float32(self.left), row + np.float32(self.top))

    def uncertainty(self, column: Image, row: Image) -> Image:
        """Return the `border_uncertainty` at (column, row) of the sensor."""
        return border_uncertainty(self.image, column + np.float32(self.left), row + np.float32(self.top))

    def shows(self, column: Image, row: Image) -> NDArray[np.bool_]:
        """Return whether (column, row) of the sensor are within the image."""
        height, width = self.image.shape
        across, down = column + (self.left + 0.5 - 0.5 * width), row + (self.top + 0.5 - 0.5 * height)
        return (np.abs(across) <= 0.5 * width) & (np.abs(down) <= 0.5 * height)


class Relief:
    """The depth of a view on a grid, linear in 1/depth between, from which the motion of its image follows.

    `pose` is world_from_camera; `depth` (h, w) is along the optical axis at the pixel centres of `grid_camera(camera)`
    [m].
    """

    def __init__(self, camera: Camera, pose: ArrayLike, depth: NDArray[np.floating[Any]]) -> None:
        import cv2

        self._camera, self._pose = camera, np.asarray(pose)
        self._slope, self._farthest = _grid(camera)
        near = (1.0 / np.maximum(depth, _LEAST_M)).astype(np.float32)
        # The surroundings of an object before an infinite background move with it.
        near = np.where(near > 0.0, near, cv2.dilate(near, np.ones((3, 3), np.uint8)))
        more = [(1, grid - 1 - given) for grid, given in zip(self._slope.shape, near.shape, strict=False)]
        self._near = np.pad(near, more, mode="edge")

    def motion_px(self, other: Pose) -> float:
        """Return the motion of the image from its pose to another, the 98th percentile over the image [px]."""
        inner = np.s_[1:-1, 1:-1]
        turn, shift = _between(other, self._pose)
        seen = self._slope[inner] @ turn.T + self._near[inner][..., None] * shift
        way = self._camera.project(seen) - self._camera.project(self._slope[inner])
        # A point that ends up behind the camera has crossed the whole image.
        most = np.hypot(self._camera.width, self._camera.height)
        return float(np.percentile(np.nan_to_num(np.linalg.norm(way, axis=-1), nan=most), 98.0))

    def source_pixels(self, seen_from: Pose, wanted_from: Pose) -> tuple[Image, Image]:
        """Return the (column, row) (H, W) of a wanted view's pixels in another image, exact on a grid, linear between.

        Both poses are near this Relief's. Pixel centres are whole numbers; points out of view are far outside.
        """
        import cv2

        turn, shift = _between(seen_from, wanted_from)
        x, outside = self._seen(turn, shift, self._from(wanted_from))
        pixel = np.where(outside[..., None], -1e4, self._camera.project(x) - 0.5)
        cell = _cell(self._camera)
        fine = cv2.resize(pixel.astype(np.float32), None, fx=cell, fy=cell, interpolation=cv2.INTER_LINEAR)
        part = fine[cell : cell + self._camera.height, cell : cell + self._camera.width]
        return np.ascontiguousarray(part[..., 0]), np.ascontiguousarray(part[..., 1])

    def _from(self, wanted_from: Pose) -> NDArray[np.float64]:
        """1/depth on the grid of another pose, looked up in this view at iterated positions."""
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
            # Depth along the wanted axis, times the 1/depth found.
            deep = (x / x[..., 2:] - found[..., None] * shift) @ turn[:, 2]
            near = np.where(outside | (deep <= 0.0), near, found / np.where(deep <= 0.0, 1.0, deep))
        return near

    def _seen(
        self, turn: NDArray[np.float64], shift: NDArray[np.float64], near: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """(Points of the grid in another view's axes, over their depth here; whether each is outside that view)."""
        x = self._slope @ turn.T + near[..., None] * shift
        # The distortion model is not valid outside the image.
        outside = (x[..., 2] <= 0.0) | (np.hypot(x[..., 0], x[..., 1]) > _BEYOND * self._farthest * x[..., 2])
        return np.where(outside[..., None], (0.0, 0.0, 1.0), x), outside


@lru_cache(maxsize=2)
def widest_px(camera: Camera) -> int:
    """Return how many pixels beyond its borders an image may be continued; 0 where the distortion does not reach."""
    most = int((_BEYOND - 1.0) * 0.5 * np.hypot(camera.width, camera.height))
    try:
        camera.directions([(x, y) for x in (-most, camera.width + most) for y in (-most, camera.height + most)])
    except ThermorenderError:
        return 0
    return most


def grid_camera(camera: Camera) -> Camera:
    """Return the Camera with one pixel for each cell of the grid of a Relief."""
    return camera.coarser(_cell(camera))


def _cell(camera: Camera) -> int:
    """Pixels along a cell of the grid."""
    return min(max(camera.width // _CELLS, 1), _CELL)


def _between(seen_from: Pose, wanted_from: Pose) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(Rotation, shift) from the axes of the camera at `wanted_from` to those of the camera at `seen_from`."""
    turn = seen_from[:3, :3].T
    return turn @ wanted_from[:3, :3], turn @ (wanted_from[:3, 3] - seen_from[:3, 3])


def moved(image: Image, column: Image, row: Image, coarsely: bool = False) -> Image:
    """Return an image (H, W) float32 at positions between its pixels, cubic, or linear and faster if `coarsely`.

    Positions outside get the nearest border pixel.
    """
    import cv2

    how = cv2.INTER_LINEAR
    if not coarsely:
        how, column, row = cv2.INTER_CUBIC, _straight(column), _straight(row)
    found: Any = cv2.remap(image, column, row, how, borderMode=cv2.BORDER_REPLICATE)
    return found


def border_uncertainty(image: Image, column: Image, row: Image) -> Image:
    """Return the uncertainty of `moved` outside the image, in the shape of `column`; 0 inside.

    It is the difference between the nearest border pixel and the image as far inside the border.
    """
    import cv2

    borders = (cv2.BORDER_REPLICATE, cv2.BORDER_REFLECT_101)
    nearest, within = (cv2.remap(image, column, row, cv2.INTER_LINEAR, borderMode=border) for border in borders)
    return np.abs(nearest - within)


def _straight(position: Image) -> Image:
    """Positions at which OpenCV's cubic weights give the value at `position`.

    The weights (a = −¾ of Keys 1981, doi:10.1109/TASSP.1981.1163711) do not reproduce a slope: they read it
    ½ f (1−f) (1−2f) of a pixel too far, with f the fraction of the position. This would shift an image that moves by
    the same fraction everywhere by up to 0.05 pixels.
    """
    whole = np.floor(position)
    whole += np.float32(0.5)
    # With h the fraction from the midpoint between two pixels, the error is −h (¼ − h²).
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
def pixel_grid(camera: Camera) -> tuple[Image, Image]:
    """Return the (column, row) of each pixel of the image's array, each (H, W) float32, read-only."""
    row, column = np.mgrid[: camera.height, : camera.width].astype(np.float32)
    row.flags.writeable = column.flags.writeable = False
    return column, row


@lru_cache(maxsize=2)
def _grid(camera: Camera) -> tuple[NDArray[np.float64], float]:
    """((h, w, 3) directions with z = 1 at the cell centres and one cell beyond each side, the largest slope)."""
    cell = _cell(camera)
    count = [-(-n // cell) + 2 for n in (camera.height, camera.width)]
    row, column = ((np.arange(n) - 0.5) * cell for n in count)
    inside = [np.clip(position, 0.0, n) for position, n in ((column, camera.width), (row, camera.height))]
    pixel = np.stack(np.meshgrid(*inside), axis=-1)
    outside = np.stack(np.meshgrid(column, row), axis=-1) - pixel
    # A cell outside continues the image without distortion, which may fold there.
    slope = camera.directions(pixel) + outside / camera.focal_length_px
    return np.concatenate([slope, np.ones_like(slope[..., :1])], axis=-1), np.linalg.norm(slope, axis=-1).max()
