"""Surfaces of different objects in one plane: rays meet either of them, so their pixels mix both."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.scene.surface import Surface

_Floats = NDArray[np.float64]
# Steps in which normals and distances of planes are compared, and by how much the same plane may differ [m].
_NORMAL, _STEP_M, _SAME_M = 1e-3, 1e-3, 1e-5
# A centroid this far within a triangle, as a share of it, lies on it.
_WITHIN = 1e-6
# Faces that look down at least this much are undersides.
_UNDERSIDE = -0.99
_MOST_NAMED = 5
# Cells along each side of the plan in which the ground below objects is found.
_CELLS = 512


def notes(surfaces: Sequence[Surface], terrain_count: int) -> tuple[str, ...]:
    """Return a sentence for each pair of objects, or object and ground, with overlapping coplanar faces.

    Only faces of the same orientation count, so a body may stand on the ground; instances are left out.
    """
    whole = [number for number, surface in enumerate(surfaces) if surface.instances is None]
    objects = [number for number in whole if number >= terrain_count]
    if not objects:
        return ()
    near = _near(surfaces, objects)
    faces = {number: near(surfaces[number]) if number < terrain_count else slice(None) for number in whole}
    planes = [_planes(surfaces[number], faces[number]) for number in whole]
    normal, place = (np.concatenate([plane[k] for plane in planes]) for k in (0, 1))
    face = np.concatenate([np.arange(len(surfaces[number].faces))[faces[number]] for number in whole])
    surface = np.repeat(whole, [len(plane[1]) for plane in planes])
    # Undersides stand on the ground, where nobody sees them.
    seen = normal[:, 2] > _UNDERSIDE
    normal, place, face, surface = normal[seen], place[seen], face[seen], surface[seen]
    found: dict[tuple[int, int], _Floats] = {}
    for shift in (0.0, 0.5):
        key = _number(normal, place, shift)
        kept = np.flatnonzero(np.isin(key, key[surface >= terrain_count]))
        if not len(kept):
            # Objects of undersides only.
            continue
        kept = kept[np.lexsort((surface[kept], key[kept]))]
        first = np.flatnonzero(np.diff(key[kept], prepend=key[kept[0]] - 1))
        for part in np.split(kept, first[1:]):
            _pairs(surfaces, surface[part], face[part], terrain_count, found)
    told = [
        f"{surfaces[one].name!r} and {surfaces[other].name!r} have faces in one plane that overlap near "
        f"{at[0]:.2f} m east, {at[1]:.2f} m north: pixels there show either; move one by 1 cm"
        for (one, other), at in sorted(found.items())[:_MOST_NAMED]
    ]
    if len(found) > _MOST_NAMED:
        told.append(f"{len(found) - _MOST_NAMED} further pairs of objects have overlapping faces in one plane")
    return tuple(told)


def _near(surfaces: Sequence[Surface], objects: Sequence[int]) -> Callable[[Surface], NDArray[np.intp]]:
    """Return a function that selects the ground faces that may lie on or below one of the objects."""
    boxes = np.array([
        [surfaces[number].vertices[:, :2].min(axis=0), surfaces[number].vertices[:, :2].max(axis=0)]
        for number in objects
    ])  # fmt: skip
    low, high = boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)
    step = max(float((high - low).max()) / _CELLS, 1e-3)
    covered = np.zeros((_CELLS + 3, _CELLS + 3), bool)
    for first, last in ((boxes - low) / step).astype(int):
        covered[first[0] : last[0] + 3, first[1] : last[1] + 3] = True

    def faces(ground: Surface) -> NDArray[np.intp]:
        cell = np.floor((ground.vertices[:, :2] - low) / step).astype(int) + 1
        inside = ((cell >= 0) & (cell < _CELLS + 3)).all(axis=1)
        inside[inside] = covered[tuple(cell[inside].T)]
        return np.flatnonzero(inside[ground.faces].any(axis=1))

    return faces


def _planes(surface: Surface, faces: Any) -> tuple[_Floats, _Floats]:
    """Unit normal (n, 3) and distance from the origin (n,) of the planes of some faces."""
    corner = surface.vertices[surface.faces[faces]]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    return normal, np.einsum("fi,fi->f", normal, corner[:, 0])


def _number(normal: _Floats, place: _Floats, shift: float) -> NDArray[np.int64]:
    """Numbers of planes: equal planes have the same, or have the same with another `shift`."""
    step = np.floor(place / _STEP_M + shift).astype(np.int64)
    x, y, z = np.floor(normal / _NORMAL + shift + 0.25).astype(np.int64).T + 2048
    return np.asarray(((step << 36) ^ (x << 24) ^ (y << 12)) ^ z)


def _pairs(
    surfaces: Sequence[Surface], surface: NDArray[np.integer], face: NDArray[np.integer], terrain_count: int,
    found: dict[tuple[int, int], _Floats],
) -> None:  # fmt: skip
    """Add to `found` where faces of one plane overlap, by the numbers of their surfaces."""
    numbers, first = np.unique(surface, return_index=True)
    if len(numbers) < 2 or numbers[-1] < terrain_count:
        return
    corners = [
        surfaces[one].vertices[surfaces[one].faces[own]]
        for one, own in zip(numbers, np.split(face, first[1:]), strict=True)
    ]
    low = np.array([corner.min(axis=(0, 1)) for corner in corners])
    high = np.array([corner.max(axis=(0, 1)) for corner in corners])
    for k, one in enumerate(numbers):
        common = np.minimum(high[k], high[k + 1 :]) - np.maximum(low[k], low[k + 1 :])
        # Bodies side by side share an edge of their boxes at most.
        near = (common >= -_SAME_M).all(axis=1) & ((common > _SAME_M).sum(axis=1) >= 2)
        for j in k + 1 + np.flatnonzero(near):
            other = numbers[j]
            pair = int(one), int(other)
            if other < terrain_count or pair in found or _alike(surfaces[one], surfaces[other]):
                continue
            box = np.maximum(low[k], low[j]), np.minimum(high[k], high[j])
            at = _overlap(_within(corners[k], box), _within(corners[j], box))
            if at is not None:
                found[pair] = at


def _alike(one: Surface, other: Surface) -> bool:
    """Whether two surfaces look the same everywhere, so that it does not matter which is met."""
    if one.material.size > 1 or other.material.size > 1:
        return False
    return bool(one.material.flat[0] == other.material.flat[0] and one.temperature.flat[0] == other.temperature.flat[0])


def _within(corner: _Floats, box: tuple[_Floats, _Floats]) -> _Floats:
    """Triangles (n, 3, 3) that reach into a box."""
    near = (corner.min(axis=1) <= box[1] + _SAME_M) & (corner.max(axis=1) >= box[0] - _SAME_M)
    return corner[near.all(axis=1)]


def _overlap(one: _Floats, other: _Floats) -> _Floats | None:
    """A point at which triangles (n, 3, 3) and (m, 3, 3) of one plane overlap, or None."""
    for points, triangles in ((one.mean(axis=1), other), (other.mean(axis=1), one)):
        for corner in triangles:
            edge_u, edge_v, off = corner[1] - corner[0], corner[2] - corner[0], points - corner[0]
            normal = np.cross(edge_u, edge_v)
            size = float(normal @ normal)
            if size == 0.0:
                continue
            v = np.cross(edge_u, off) @ normal / size
            u = np.cross(off, edge_v) @ normal / size
            inside = (u > _WITHIN) & (v > _WITHIN) & (u + v < 1.0 - _WITHIN)
            inside &= np.abs(off @ normal) < _SAME_M * np.sqrt(size)
            if inside.any():
                return np.asarray(points[inside.argmax()])
    return None
