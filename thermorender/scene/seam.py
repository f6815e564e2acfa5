"""Seams between grounds: triangulations that keep the sides of a rim, and edges that are cut alike on both sides."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from thermorender.scene.surface import Surface

_Floats = NDArray[np.float64]
# Times that sides of a rim are halved until all are edges of the triangulation.
_HALVINGS = 12
# Edges among which the one that a point lies on is sought, and its largest distance from it per length.
_NEAREST, _ON_EDGE = 8, 1e-6


def with_sides(
    points: _Floats, sides: NDArray[np.integer]
) -> tuple[NDArray[np.integer], list[tuple[int, int]]]:  # fmt: skip
    """Return (Delaunay triangles (t, 3) of points (n, 2) that have all `sides` (m, 2) among their edges; the two ends
    of each point that is added in the middle of a side for that)."""
    from scipy.spatial import Delaunay

    ends = list[tuple[int, int]]()
    triangles: NDArray[np.integer] = np.zeros((0, 3), np.int64)
    for _ in range(_HALVINGS):
        triangles = Delaunay(points).simplices if len(points) > 3 else triangles
        edge = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
        keys = [np.sort(each, axis=1).astype(np.int64) @ (len(points), 1) for each in (edge, sides)]
        missing = ~np.isin(keys[1], keys[0])
        if not missing.any():
            break
        new = len(points) + np.arange(int(missing.sum()))
        ends += [(int(a), int(b)) for a, b in sides[missing]]
        points = np.concatenate([points, points[sides[missing]].mean(axis=1)])
        halves = [np.stack([sides[missing][:, k], new], axis=-1) for k in (0, 1)]
        sides = np.concatenate([sides[~missing], *halves])
    return triangles, ends


def stitched(far: Surface, inside: Sequence[Surface]) -> Surface:
    """Return a ground whose edges beside others are cut where these have vertices."""
    from scipy.spatial import KDTree

    known = {tuple(place) for place in far.vertices[np.unique(_border(far.faces))].tolist()}
    borders = [surface.vertices[np.unique(_border(surface.faces))] for surface in inside]
    new = np.array([place for border in borders for place in border.tolist() if tuple(place) not in known])
    # A face with two such edges is cut twice.
    while len(new):
        side = _border(far.faces)
        start, end = far.vertices[side[:, 0]], far.vertices[side[:, 1]]
        _, near = KDTree(0.5 * (start + end)).query(new, k=np.arange(1, min(_NEAREST, len(side)) + 1))
        along, length = end - start, np.linalg.norm(end - start, axis=1)
        part = np.einsum("nkc,nkc->nk", new[:, None] - start[near], along[near]) / np.square(length)[near]
        away = np.linalg.norm(new[:, None] - start[near] - part[..., None] * along[near], axis=-1)
        away = np.where((part > 0.0) & (part < 1.0), away, np.inf)
        best = away.argmin(axis=1)
        rows = np.arange(len(new))
        on = away[rows, best] < _ON_EDGE * (1.0 + length[near[rows, best]])
        edge, part, new = near[rows, best][on], part[rows, best][on], new[on]
        far, done = _cut(far, side, edge, part, new)
        new = new[~done]
    return far


def _border(faces: NDArray[np.integer]) -> NDArray[np.integer]:
    """The edges of a single face, (n, 2) numbers of vertices in the order of their face."""
    edge = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    _, first, count = np.unique(np.sort(edge, axis=1), axis=0, return_index=True, return_counts=True)
    return edge[first[count == 1]]


def _cut(
    far: Surface, side: NDArray[np.integer], edge: NDArray[np.integer], part: _Floats, new: _Floats
) -> tuple[Surface, NDArray[np.bool_]]:
    """(Far ground with triangles cut at points `new` (n, 3), at parts of edges `side[edge]`; which points it has now).
    One edge of a triangle is cut."""
    faces, uv = list[NDArray[np.integer]](), list[NDArray[np.float32]]()
    number = {(int(a), int(b)): k for k, (a, b) in enumerate(side)}
    points = dict[int, list[int]]()
    for n in np.lexsort((part, edge)).tolist():
        points.setdefault(int(edge[n]), []).append(n)
    whole, done = np.ones(len(far.faces), bool), np.zeros(len(new), bool)
    at_border = np.flatnonzero(np.isin(far.faces, np.unique(side)).sum(axis=1) > 1)
    for face in at_border.tolist():
        for k in range(3):
            a, b, c = (int(far.faces[face, (k + j) % 3]) for j in range(3))
            own = points.get(number.get((a, b), -1))
            if own is None:
                continue
            u, v, w = (far.uv[face, (k + j) % 3] for j in range(3))
            between = [u + np.float32(part[n]) * (v - u) for n in own]
            chain, place = [a, *(len(far.vertices) + n for n in own), b], [u, *between, v]
            faces += [np.array([p, q, c]) for p, q in zip(chain[:-1], chain[1:], strict=True)]
            uv += [np.array([p, q, w]) for p, q in zip(place[:-1], place[1:], strict=True)]
            whole[face], done[own] = False, True
            break
    if not done.any():
        return far, np.ones(len(new), bool)
    return replace(
        far, vertices=np.concatenate([far.vertices, new]),
        faces=np.concatenate([far.faces[whole], np.array(faces)]).astype(far.faces.dtype),
        uv=np.concatenate([far.uv[whole], np.array(uv)]).astype(np.float32),
    ), done  # fmt: skip
