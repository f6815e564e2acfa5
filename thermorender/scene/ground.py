"""Height of the ground below a point: the highest terrain triangle over it, found through a grid of bins."""

from collections.abc import Sequence
from functools import cached_property
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from thermorender.scene.surface import Surface

# Largest sizes of triangles in successive bins.
_RATIO = 8.0
# About 300 bytes of memory per face.
_FACES_AT_ONCE = 1 << 20


def weights_in_plan(
    corner: NDArray[np.floating], point: NDArray[np.floating]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the barycentric weights (n,) of the second and the third corner of triangles (n, 3, 2) at points (n, 2).

    A vertical wall has no area from above: its weights are infinite or NaN.
    """
    a, b, c = np.moveaxis(corner, 1, 0)
    ab, ac, ap = b - a, c - a, point - a
    area = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        v = (ap[:, 0] * ac[:, 1] - ap[:, 1] * ac[:, 0]) / area
        w = (ab[:, 0] * ap[:, 1] - ab[:, 1] * ap[:, 0]) / area
    return v, w


class Ground:
    """Callable (east, north) → local height of the terrain `surfaces` [m], NaN where there is none.

    The bins are made at the first call.
    """

    def __init__(self, surfaces: Sequence[Surface]) -> None:
        self._surfaces = tuple(surfaces)

    @cached_property
    def _bins(self) -> "list[_Bins]":
        """The triangles by their size, each _RATIO times as large as those before."""
        first_vertex = np.cumsum([0] + [len(surface.vertices) for surface in self._surfaces])
        vertices = np.concatenate([surface.vertices for surface in self._surfaces])
        faces = np.concatenate([
            (surface.faces + first).astype(np.int32)
            for surface, first in zip(self._surfaces, first_vertex, strict=False)
        ])  # fmt: skip
        # Bins about as large as a triangle, so that each triangle is in a few bins.
        size = np.concatenate([np.ptp(vertices[part, :2], axis=1).max(axis=1) for part in _parts(faces)])
        least = max(1.5 * float(np.median(size)), 1e-9)
        level = np.ceil(np.log(np.maximum(size / least, 1.0)) / np.log(_RATIO))
        return [_Bins(vertices, faces[level == k], least * _RATIO**k) for k in np.unique(level)]

    @overload
    def __call__(self, east: float, north: float) -> float: ...

    @overload
    def __call__(self, east: NDArray[Any], north: NDArray[Any]) -> NDArray[np.float64]: ...

    def __call__(self, east: Any, north: Any) -> Any:
        """Return local heights [m] in the shape of the arguments, a number for numbers; NaN off the terrain."""
        east, north = np.broadcast_arrays(np.asarray(east, np.float64), np.asarray(north, np.float64))
        point = np.stack([east.ravel(), north.ravel()], axis=-1)
        return self._height(point).reshape(east.shape)[()]

    def _height(self, point: NDArray[np.float64]) -> NDArray[np.float64]:
        """Heights at (n, 2) places, (n,) [m]; NaN off the terrain."""
        found: NDArray[np.float64] = np.fmax.reduce([bins.height(point) for bins in self._bins])
        return found


def _parts(faces: NDArray[np.int32]) -> list[NDArray[np.int32]]:
    """The faces, a few at a time."""
    return [faces[first : first + _FACES_AT_ONCE] for first in range(0, len(faces), _FACES_AT_ONCE)]


class _Bins:
    """Triangles `faces` (F, 3) by squares of the plan, of `side` [m] or more."""

    def __init__(self, vertices: NDArray[np.floating], faces: NDArray[np.int32], side: float) -> None:
        self._vertices, self._faces = vertices, faces
        plan = vertices[:, :2]
        used = np.zeros(len(plan), bool)
        used[faces] = True
        self._origin = plan[used].min(axis=0)
        extent = plan[used].max(axis=0) - self._origin
        self._bin = max(side, float(extent.max()) / 4096)
        spans = [self._span(plan[part]) for part in _parts(faces)]
        self._count = np.floor(extent / self._bin).astype(np.int64) + 1
        triangles, bins_of = [], []
        for number, (first, span) in enumerate(spans):
            per_triangle = span.prod(axis=1)
            own = np.repeat(np.arange(len(span), dtype=np.int32), per_triangle)
            step = np.arange(len(own)) - np.repeat(np.cumsum(per_triangle) - per_triangle, per_triangle)
            column, row = first[own, 0] + step % span[own, 0], first[own, 1] + step // span[own, 0]
            triangles.append(own + number * _FACES_AT_ONCE)
            bins_of.append((row * self._count[0] + column).astype(np.int32))
        bins = np.concatenate(bins_of)
        order = np.argsort(bins, kind="stable")
        self._triangle = np.concatenate(triangles)[order]
        self._start = np.concatenate([[0], np.cumsum(np.bincount(bins, minlength=self._count.prod()))])

    def _span(self, corner: NDArray[np.floating]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """The first bin (F, 2) and the number of bins (F, 2) that triangles (F, 3, 2) reach into."""
        first = np.floor((corner.min(axis=1) - self._origin) / self._bin).astype(np.int32)
        return first, np.floor((corner.max(axis=1) - self._origin) / self._bin).astype(np.int32) - first + 1

    def height(self, point: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the heights at points of the plan (n, 2), (n,) [m]; NaN where there is no triangle."""
        index = np.floor((point - self._origin) / self._bin)
        inside = ((index >= 0.0) & (index < self._count)).all(axis=-1)
        # Far outside, the index exceeds the range of integers.
        column, row = np.where(inside[:, None], index, 0.0).astype(np.int64).T
        bins = row * self._count[0] + column
        count = np.where(inside, self._start[bins + 1] - self._start[bins], 0)
        upto = np.cumsum(count)
        ends = np.searchsorted(upto, np.arange(_FACES_AT_ONCE, upto[-1:].sum(), _FACES_AT_ONCE))
        parts = np.split(np.arange(len(point)), ends)
        height = np.concatenate([self._highest(point[part], self._start[bins[part]], count[part]) for part in parts])
        return np.where(np.isfinite(height), height, np.nan)

    def _highest(self, point: NDArray[Any], start: NDArray[Any], count: NDArray[Any]) -> NDArray[np.float64]:
        """Heights (n,) of the highest of `count` triangles from `start` on in the list of bins at points (n, 2); −inf
        for none.
        """
        which = np.repeat(np.arange(len(point)), count)
        offset = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        corner = self._vertices[self._faces[self._triangle[start[which] + offset]]]
        v, w = weights_in_plan(corner[..., :2], point[which])
        with np.errstate(invalid="ignore"):
            hit = (v >= -1e-9) & (w >= -1e-9) & (v + w <= 1.0 + 1e-9)
        a, b, c = np.moveaxis(corner, 1, 0)
        a, b, c, v, w = (values[hit] for values in (a, b, c, v, w))
        height = np.full(len(point), -np.inf)
        np.maximum.at(height, which[hit], a[:, 2] + v * (b - a)[:, 2] + w * (c - a)[:, 2])
        return height
