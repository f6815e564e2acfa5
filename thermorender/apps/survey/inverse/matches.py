"""Matches between overlapping frames: the same patch of the ground, found in two of them.

Frames are laid on the ground by their measured poses, without coarse structure, which shutter and lens disturb. A patch
around each node of a grid on the ground is then sought in every other frame by its correlation. Nodes are common to all
frames, so that many frames tell the height of one node.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from thermorender import Camera
from thermorender.errors import ThermorenderError
from thermorender.sensor.camera import edge_directions

Floats = NDArray[np.float64]
Whole = NDArray[np.intp]
Image = NDArray[np.float32]
# Heights (N,) [m] at east, north (N,) [m]; NaN beyond the ground.
Ground = Callable[[Floats, Floats], Floats]
Progress = Callable[[str, float], object]
# Structure coarser than this is left out of a frame, as share of its height.
_COARSEST = 1.0 / 25.0
# Half of a patch [cells]: at most, at least, and as share of the shorter side of a footprint.
_HALF, _LEAST_HALF, _SHARE = 16, 6, 1.0 / 8.0
# Nodes along the longer side of a frame's footprint.
_NODES = 20
# Lowest correlation that is believed, and highest share of it that a second place may have.
_LEAST_ALIKE, _SECOND = 0.5, 0.85
# Cells around the best place that do not count as a second one.
_SAME_PLACE = 4
# Frames with a smaller common share of their footprints are not compared; most partners of a frame.
_LEAST_COMMON, _PARTNERS = 0.2, 16
# Frames laid on the ground that are kept.
_KEPT = 48
# Steps to the point where a ray meets uneven ground.
_STEPS = 8
# Rays closer to the horizon are left out, as the cosine to the vertical.
_FLATTEST = 0.2


class Matches(NamedTuple):
    """N matches: numbers of two frames, of a node, and where each frame shows the node (N, 2) [px]."""

    first: Whole
    second: Whole
    node: Whole
    first_px: Floats
    second_px: Floats
    nodes: Floats  # (K, 2) east, north of the nodes [m]
    alike: float = 1.0  # Matches around a node that share most of their pixels


@dataclass(frozen=True, eq=False)
class View:
    """Frames of one camera over a ground: from pixels to the ground and back."""

    camera: Camera
    poses: Floats  # (F, 4, 4) float64 world_from_camera
    ground: Ground

    def cast(self, frame: Whole, pixel: Floats) -> tuple[Floats, Floats]:
        """Return (points of the ground (N, 3) [m], rays to them (N, 3)) of pixels (N, 2) of frames (N,).

        Rays have depth 1 along the optical axis; points are NaN for rays that meet no ground.
        """
        slope = self.camera.directions(pixel)
        turn, start = self.poses[frame, :3, :3], self.poses[frame, :3, 3]
        way = np.einsum("nij,nj->ni", turn, np.concatenate([slope, np.ones((len(slope), 1))], axis=1))
        steep = way[:, 2] < -_FLATTEST * np.linalg.norm(way, axis=1)
        down = np.where(steep, way[:, 2], np.nan)
        level = self.ground(start[:, 0], start[:, 1])
        known = np.isfinite(level)
        level = np.where(known, level, np.median(level[known]) if known.any() else np.nan)
        for _ in range(_STEPS):
            point = start + ((level - start[:, 2]) / down)[:, None] * way
            found = self.ground(point[:, 0], point[:, 1])
            settled = np.nanmax(np.abs(found - level), initial=0.0) < 1e-4
            level = found
            if settled:
                break
        return start + ((level - start[:, 2]) / down)[:, None] * way, way

    def on_ground(self, frame: Whole, pixel: Floats) -> Floats:
        """Return the points of `cast`."""
        return self.cast(frame, pixel)[0]

    def in_frame(self, frame: Whole, point: Floats) -> Floats:
        """Return where frames (N,) show points (N, 3), (N, 2) [px]; NaN beyond the lens's own field."""
        turn, start = self.poses[frame, :3, :3], self.poses[frame, :3, 3]
        own = np.einsum("nji,nj->ni", turn, point - start)
        pixel = self.camera.project(own)
        slope = np.linalg.norm(own[:, :2], axis=1) / np.where(own[:, 2] > 0.0, own[:, 2], np.nan)
        # Beyond its fold, a lens would show points inside the image.
        return np.asarray(np.where((slope < self._widest)[:, None], pixel, np.nan))

    @cached_property
    def _widest(self) -> float:
        return 1.05 * float(np.linalg.norm(edge_directions(self.camera), axis=-1).max())

    def footprints(self) -> Floats:
        """Return the smallest and largest east and north that each frame shows, (F, 2, 2) [m]; NaN where none."""
        width, height = self.camera.width, self.camera.height
        across, along = np.meshgrid(np.linspace(0.0, width, 9), np.linspace(0.0, height, 9))
        pixel = np.stack([across.ravel(), along.ravel()], axis=1)
        found = []
        for frame in range(len(self.poses)):
            point = self.on_ground(np.full(len(pixel), frame), pixel)[:, :2]
            known = point[np.isfinite(point).all(axis=1)]
            found.append([known.min(axis=0), known.max(axis=0)] if len(known) > 2 else np.full((2, 2), np.nan))
        return np.array(found)

    def cell_m(self) -> float:
        """Return the side of a pixel on the ground, in the median over frames [m]."""
        middle = np.array([[0.5, 0.5], [1.5, 0.5]]) + [self.camera.width // 2, self.camera.height // 2]
        frame = np.repeat(np.arange(len(self.poses)), 2)
        point = self.on_ground(frame, np.tile(middle, (len(self.poses), 1))).reshape(-1, 2, 3)
        return float(np.nanmedian(np.linalg.norm(point[:, 1] - point[:, 0], axis=-1)))


def detailed(kelvin: NDArray[np.float32]) -> Image:
    """Return frames (F, H, W) without coarse structure and without what most of them have in common, such as ghosts."""
    import cv2

    sigma = _COARSEST * kelvin.shape[1]
    found = np.empty_like(kelvin, np.float32)
    for own, image in zip(found, kelvin, strict=True):
        known = np.isfinite(image)
        filled = np.where(known, image, np.median(image[known]) if known.any() else 0.0).astype(np.float32)
        own[:] = np.where(known, filled - cv2.GaussianBlur(filled, (0, 0), sigma), np.nan)
    if len(found) >= 8:
        for row in range(found.shape[1]):
            common = np.nanmedian(found[:, row], axis=0)
            found[:, row] -= np.where(np.isfinite(common), common, 0.0)
    return found


def matched(
    images: Image, view: View, cell_m: float, reach: int, progress: Progress | None = None
) -> Matches:  # fmt: skip
    """Return the Matches of frames, of `detailed` (F, H, W), in cells of `cell_m` on the ground.

    `reach` is how far a patch is sought from where the poses have it [cells].

    Raises
    ------
    ThermorenderError
        No two frames show the same patch.
    """
    feet = view.footprints()
    finest = view.cell_m()
    side = np.nanmedian(feet[:, 1] - feet[:, 0], axis=0) / cell_m
    half = int(np.clip(_SHARE * np.nan_to_num(side.min()), _LEAST_HALF, _HALF))
    step = max(int(np.ceil(np.nan_to_num(side.max()) / _NODES)), 4)
    blur_px = 0.4 * cell_m / finest if cell_m > 1.5 * finest else 0.0
    laid = _Laid(images, view, cell_m, feet, blur_px, half, half + reach)
    found: list[tuple[int, int, int, int, float, float]] = []
    pairs = _pairs(feet)
    for number, (first, second) in enumerate(pairs):
        one, other = laid(first), laid(second)
        away = half + reach
        rows = np.arange(max(one.top, other.top + away), min(one.bottom, other.bottom - away))
        columns = np.arange(max(one.left, other.left + away), min(one.right, other.right - away))
        for row in rows[rows % step == 0]:
            for column in columns[columns % step == 0]:
                here, there = ((row - each.top, column - each.left) for each in (one, other))
                if not one.whole[here]:
                    continue
                shift = _shift(_around(other.values, there, away), _around(one.values, here, half), reach)
                if shift is not None and other.whole[there[0] + round(shift[0]), there[1] + round(shift[1])]:
                    found.append((first, second, row, column, *shift))
        if progress is not None:
            progress("comparing the frames", (number + 1) / len(pairs))
    if not found:
        raise ThermorenderError(
            "no two frames show the same ground where their poses have it; check the poses and their error, the focal "
            "length and the height above the ground, or give frames that overlap by half or more"
        )
    return _matches(found, view, cell_m, max(1.0, ((2 * half + 1) / step) ** 2))


def _matches(found: Sequence[tuple[int, int, int, int, float, float]], view: View, cell_m: float, alike: float
) -> Matches:  # fmt: skip
    table = np.array(found)
    first, second = table[:, 0].astype(np.intp), table[:, 1].astype(np.intp)
    cells, node = np.unique(table[:, 2:4].astype(np.int64), axis=0, return_inverse=True)
    nodes = np.asarray((cells[:, ::-1] + 0.5) * cell_m, np.float64)
    place = nodes[node.ravel()]
    there = place + table[:, :3:-1] * cell_m

    def point(at: Floats) -> Floats:
        return np.concatenate([at, view.ground(at[:, 0], at[:, 1])[:, None]], axis=1)

    pixels = view.in_frame(first, point(place)), view.in_frame(second, point(there))
    known = np.isfinite(pixels[0]).all(axis=1) & np.isfinite(pixels[1]).all(axis=1)
    return Matches(first[known], second[known], node.ravel()[known], pixels[0][known], pixels[1][known], nodes, alike)


def _shift(other: Image, patch: Image, reach: int) -> tuple[float, float] | None:
    """(Down, right) of a patch in a larger one [cells], by their correlation; None if that is low or ambiguous."""
    import cv2

    score = cv2.matchTemplate(other, patch, cv2.TM_CCOEFF_NORMED)
    row, column = (int(each) for each in np.unravel_index(int(np.argmax(score)), score.shape))
    best = float(score[row, column])
    if not best >= _LEAST_ALIKE or not (0 < row < 2 * reach and 0 < column < 2 * reach):
        return None
    near = score[row - 1 : row + 2, column - 1 : column + 2]
    down, right = _vertex(near[:, 1]), _vertex(near[1])
    _around(score, (row, column), _SAME_PLACE)[:] = -1.0
    if score.max() > _SECOND * best:
        return None
    return float(row - reach + down), float(column - reach + right)


def _around(values: NDArray[Any], place: tuple[int, int], half: int) -> NDArray[Any]:
    """The part of an image up to `half` rows and columns around a place."""
    row, column = place
    return values[max(row - half, 0) : row + half + 1, max(column - half, 0) : column + half + 1]


def _vertex(line: NDArray[Any]) -> float:
    """Place of the vertex of a parabola through three values at −1, 0, 1, of which the middle is the largest."""
    before, middle, after = (float(value) for value in line)
    return 0.5 * (after - before) / max(2.0 * middle - before - after, 1e-9)


class _Sheet(NamedTuple):
    """A frame on the ground: cells of rows northwards from `top` and columns eastwards from `left`."""

    top: int
    left: int
    values: Image  # (h, w) float32, 0 outside the frame
    whole: NDArray[np.uint8]  # (h, w) uint8 1 where a patch is inside the frame

    @property
    def bottom(self) -> int:
        return self.top + len(self.values)

    @property
    def right(self) -> int:
        return self.left + self.values.shape[1]


class _Laid:
    """Frames laid on the ground, with a margin; those used last are kept."""

    def __init__(
        self, images: Image, view: View, cell_m: float, feet: Floats, blur_px: float, half: int, margin: int
    ) -> None:  # fmt: skip
        self._images, self._view, self._cell, self._feet, self._blur = images, view, cell_m, feet, blur_px
        self._half, self._margin = half, margin
        self._kept = lru_cache(maxsize=_KEPT)(self._laid)

    def __call__(self, number: int) -> _Sheet:
        """Return a frame on the ground."""
        return self._kept(number)

    def _laid(self, number: int) -> _Sheet:
        import cv2

        low, high = np.floor(self._feet[number] / self._cell).astype(int)
        low, high = low - self._margin, high + self._margin
        east, north = np.meshgrid(np.arange(low[0], high[0] + 1) + 0.5, np.arange(low[1], high[1] + 1) + 0.5)
        east, north = east * self._cell, north * self._cell
        up = self._view.ground(east.ravel(), north.ravel())
        point = np.stack([east.ravel(), north.ravel(), up], axis=1)
        pixel = self._view.in_frame(np.full(len(point), number), point)
        place = np.where(np.isfinite(pixel), pixel - 0.5, -1e4).astype(np.float32).reshape(*east.shape, 2)
        image = self._images[number]
        if self._blur:
            known = np.isfinite(image)
            image = np.where(known, cv2.GaussianBlur(np.where(known, image, 0.0), (0, 0), self._blur), np.nan)
        laid = cv2.remap(image.astype(np.float32), place[..., 0], place[..., 1], cv2.INTER_LINEAR,
                         borderMode=cv2.BORDER_CONSTANT, borderValue=float("nan"))  # fmt: skip
        inside = np.isfinite(laid)
        whole = cv2.erode(inside.astype(np.uint8), np.ones((2 * self._half + 1,) * 2, np.uint8),
                          borderType=cv2.BORDER_CONSTANT, borderValue=0)  # fmt: skip
        return _Sheet(int(low[1]), int(low[0]), np.where(inside, laid, np.float32(0.0)), np.asarray(whole, np.uint8))


def _pairs(feet: Floats) -> list[tuple[int, int]]:
    """Pairs of frames with common ground: for each frame those with most in common, on all sides of it."""
    known = np.flatnonzero(np.isfinite(feet).all(axis=(1, 2)))
    area = np.prod(feet[:, 1] - feet[:, 0], axis=-1)
    middle = feet.mean(axis=1)
    pairs = set()
    for number in known:
        sides = np.minimum(feet[number, 1], feet[known, 1]) - np.maximum(feet[number, 0], feet[known, 0])
        share = np.where((sides > 0.0).all(axis=1), sides.prod(axis=1), 0.0) / np.minimum(area[number], area[known])
        partners = (share >= _LEAST_COMMON) & (known != number)
        away = middle[known] - middle[number]
        sector = np.floor(np.degrees(np.arctan2(away[:, 1], away[:, 0])) / 90.0 + 0.5).astype(int) % 4
        for side in range(4):
            inside = np.flatnonzero(partners & (sector == side))
            # The nearest, and some far ones, which tell heights and bends.
            chosen = inside[np.argsort(-share[inside], kind="stable")]
            if len(chosen) > _PARTNERS // 4:
                chosen = chosen[np.linspace(0, len(chosen) - 1, _PARTNERS // 4).astype(int)]
            pairs |= {(min(number, other), max(number, other)) for other in known[chosen]}
    return sorted((int(one), int(other)) for one, other in pairs)
