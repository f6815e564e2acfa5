"""Finer triangles beside objects and where triangles are large, because light is constant over a triangle.

Light changes within a fraction of the size of an object beside it, and from foot to eaves of a wall.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from thermorender.scene.surface import Surface

_Floats = NDArray[np.float64]
# Lowest and highest corner of a box (3,) each [m].
_Box = tuple[_Floats, _Floats]

# Longest edge of a triangle on and around an object, and margin around it, as shares of the object's extent.
_EDGE_SHARE = 1.0 / 16.0
_MARGIN_SHARE = 0.25
# Triangles that may be added to all objects together. Where the shares above would add more, the shortest edges are
# lengthened first: small objects among many are cut less, and large ones beside them as before.
_MOST_ON_OBJECTS = 1 << 16
# A triangle is cut into at most the square of this many equal ones. A longer one is first quartered repeatedly, and
# only the quarters beside the object are cut further: a small spot does not cut a whole plain finely.
_EQUAL_PARTS = 8
# Triangles added by cutting the largest ones: this share of all, at least the number.
_MORE_SHARE, _MORE = 0.2, 1000
# Only triangles larger than this many times the surface's typical area count as large.
_LEAST_RATIO = 3.0
# Triangles that replace one, by its number of halved edges: corners 0, 1, 2; middles 3, 4, 5 of the edges after them.
_CUTS = {
    1: ((0, 3, 2), (3, 1, 2)),
    2: ((3, 1, 4), (0, 3, 4), (0, 4, 2)),
    3: ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5)),
}


def refined(
    terrain: Sequence[Surface], objects: Sequence[Surface], beside: Sequence[Surface] = ()
) -> tuple[list[Surface], list[Surface]]:
    """Return (terrain, objects) with the same shapes and smaller triangles.

    No edge is longer than 1/16 of the extent of the object that a triangle belongs to or is beside, or than an edge
    that keeps the number of triangles bounded. What is only `beside` the terrain refines it and is not returned.
    """
    least = _least_edge(objects)
    around = [(_box(item), max(_EDGE_SHARE * _extent(item), least)) for item in (*objects, *beside)]
    return [_finer(surface, around) for surface in terrain], [
        _split(item, np.full(len(item.faces), edge), _longest(item.vertices[item.faces]))
        for item, (_, edge) in zip(objects, around, strict=False)
    ]


def evened(surface: Surface) -> Surface:
    """Return a surface whose largest triangles are bisected conformingly, which adds about a fifth more triangles.

    A surface of few triangles, such as a box, gets about a thousand; one of equal triangles stays as it is.
    """
    area = _area(surface, surface.faces)
    limit = _limit(area, max(_MORE, int(_MORE_SHARE * len(area))))
    if limit < area.max():
        surface = replace(surface, faces=_shared(surface))
    while (large := area > limit).any():
        surface, whole = _bisected(surface, large)
        area = np.concatenate([area[whole], _area(surface, surface.faces[np.count_nonzero(whole) :])])
    return surface


def _shared(surface: Surface) -> NDArray[np.int32]:
    """Faces that use one vertex for all corners at one place; a textured mesh may repeat its vertices."""
    _, index, place = np.unique(surface.vertices, axis=0, return_index=True, return_inverse=True)
    return index[place.reshape(-1)][surface.faces].astype(surface.faces.dtype)


def _area(surface: Surface, faces: NDArray[np.int32]) -> _Floats:
    corner = surface.vertices[faces]
    return 0.5 * np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)


def _limit(area: _Floats, more: int) -> float:
    """Area above which triangles are halved repeatedly, so that at most `more` triangles are added."""
    least = 0.0
    if len(area) > more:
        # Triangles smaller than this make up half of the surface: ordinary ground, not worth the rays of halving it.
        order = np.sort(area)
        least = _LEAST_RATIO * order[np.searchsorted(order.cumsum(), 0.5 * order.sum())]
    low, high = np.log2(max(least, 1e-12)), np.log2(max(area.max(), least, 1e-12))
    for _ in range(30):
        middle = 0.5 * (low + high)
        halvings = np.ceil(np.log2(np.maximum(area, 1e-12)) - middle).clip(0)
        low, high = (low, middle) if (np.exp2(halvings) - 1.0).sum() <= more else (middle, high)
    return float(np.exp2(high))


def _bisected(surface: Surface, large: NDArray[np.bool_]) -> tuple[Surface, NDArray[np.bool_]]:
    """Return (surface with the longest edge of each `large` triangle halved, uncut triangles); the uncut come first."""
    faces, vertices, count = surface.faces, surface.vertices, len(surface.vertices)
    touched = np.zeros(count, bool)
    touched[faces[large]] = True
    near = np.flatnonzero(touched[faces[:, 0]] | touched[faces[:, 1]] | touched[faces[:, 2]])
    # Edge k leads from corner k to the next.
    ends = np.sort(faces[near][:, [[0, 1], [1, 2], [2, 0]]].astype(np.int64), axis=-1)
    edge = ends[..., 0] * count + ends[..., 1]
    longest = np.linalg.norm(vertices[ends[..., 1]] - vertices[ends[..., 0]], axis=-1).argmax(axis=1)
    on = np.flatnonzero(large[near])
    halved_edges = np.unique(edge[on, longest[on]])
    halved = np.isin(edge, halved_edges)
    cut = halved.any(axis=1)
    near, edge, halved = near[cut], edge[cut], halved[cut]
    # Rotate the corners: the only halved edge comes first, or the only whole one last.
    number = halved.sum(axis=1)
    first = np.where(number == 1, halved.argmax(axis=1), (halved.argmin(axis=1) + 1) % 3)
    turn = (first[:, None] + np.arange(3)) % 3
    row = np.arange(len(near))[:, None]
    corner, uv = faces[near[:, None], turn], surface.uv[near[:, None], turn]
    corner = np.hstack([corner, count + np.searchsorted(halved_edges, edge[row, turn])])
    uv = np.concatenate([uv, 0.5 * (uv + uv[:, [1, 2, 0]])], axis=1)
    whole = np.ones(len(faces), bool)
    whole[near] = False
    parts = [(faces[whole], surface.uv[whole])]
    parts += [
        (corner[number == n][:, triangle], uv[number == n][:, triangle])
        for n, triangles in _CUTS.items()
        for triangle in triangles
    ]
    middles = 0.5 * (vertices[halved_edges // count] + vertices[halved_edges % count])
    surface = replace(
        surface,
        vertices=np.concatenate([vertices, middles.astype(vertices.dtype)]),
        faces=np.concatenate([part for part, _ in parts]).astype(faces.dtype),
        uv=np.concatenate([part for _, part in parts]).astype(surface.uv.dtype),
    )
    return surface, whole


def _least_edge(objects: Sequence[Surface]) -> float:
    """Shortest limit of an edge with which all objects together gain at most `_MOST_ON_OBJECTS` triangles [m]."""
    if not objects:
        return 0.0
    longest = np.concatenate([_longest(item.vertices[item.faces]) for item in objects])
    own = np.repeat([_EDGE_SHARE * _extent(item) for item in objects], [len(item.faces) for item in objects])

    def added(edge: float) -> float:
        return float((np.ceil(longest / np.maximum(own, edge) - 1e-9).clip(1.0) ** 2 - 1.0).sum())

    if added(0.0) <= _MOST_ON_OBJECTS:
        return 0.0
    low, high = np.log2(own.min()), np.log2(longest.max())
    for _ in range(30):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if added(np.exp2(middle)) <= _MOST_ON_OBJECTS else (middle, high)
    return float(np.exp2(high))


def _extent(item: Surface) -> float:
    return float(np.ptp(item.vertices, axis=0).max())


def _box(item: Surface) -> _Box:
    """The box of what is beside an object."""
    low, high = item.vertices.min(axis=0), item.vertices.max(axis=0)
    margin = _MARGIN_SHARE * float((high - low).max())
    return low - margin, high + margin


def _longest(corner: _Floats) -> _Floats:
    """Longest edge of triangles by their corners (F, 3 corners, 3), (F,) [m]."""
    edge: _Floats = np.linalg.norm(corner - np.roll(corner, 1, axis=1), axis=-1)
    return edge.max(axis=1)


def _finer(surface: Surface, around: Sequence[tuple[_Box, float]]) -> Surface:
    """A surface without edges longer than those allowed in boxes, quartered until `_EQUAL_PARTS` suffice."""
    longest, limit = np.empty(0), np.empty(0)
    while True:
        # Triangles that were cut come last.
        corner = surface.vertices[surface.faces[len(limit) :]]
        longest = np.concatenate([longest, _longest(corner)])
        limit = np.concatenate([limit, _allowed(corner, around)])
        far = longest > _EQUAL_PARTS * limit
        if not far.any():
            return _split(surface, limit, longest)
        surface = _split(surface, np.where(far, 0.5 * longest, np.inf), longest)
        longest, limit = longest[~far], limit[~far]


def _allowed(corner: _Floats, around: Sequence[tuple[_Box, float]]) -> _Floats:
    """Longest edge allowed in triangles (F, 3 corners, 3), (F,) [m]: the shortest of the boxes that they may reach."""
    a, b, c = corner.transpose(1, 2, 0)
    low = np.ascontiguousarray(np.minimum(np.minimum(a, b), c))
    high = np.ascontiguousarray(np.maximum(np.maximum(a, b), c))
    limit = np.full(len(corner), np.inf)
    for (first, last), edge in around:
        near = np.flatnonzero((low[0] <= last[0]) & (high[0] >= first[0]))
        for k in (1, 2):
            near = near[(low[k][near] <= last[k]) & (high[k][near] >= first[k])]
        limit[near] = np.minimum(limit[near], edge)
    return limit


def _split(surface: Surface, limit: _Floats, longest: _Floats) -> Surface:
    """Return a surface without edges above `limit` (F,) [m]; `longest` (F,) are the present ones.

    Uncut triangles come first.
    """
    parts = np.ceil(np.where(np.isfinite(limit), longest / limit, 1.0) - 1e-9).astype(int).clip(1)
    whole = parts == 1
    if whole.all():
        return surface
    vertices, faces, uv = [surface.vertices], [surface.faces[whole]], [surface.uv[whole]]
    count = len(surface.vertices)
    for n in np.unique(parts[~whole]):
        here = parts == n
        weights = _lattice(n)
        # (faces, n² triangles, 3 corners): each with its own vertices, since neighbours may be split differently.
        corner = surface.vertices[surface.faces[here]]
        points = np.einsum("tcw,fwk->ftck", weights, corner).reshape(-1, 3)
        vertices.append(points)
        faces.append(np.arange(count, count + len(points), dtype=np.int32).reshape(-1, 3))
        uv.append(np.einsum("tcw,fwk->ftck", weights, surface.uv[here]).reshape(-1, 3, 2).astype(np.float32))
        count += len(points)
    return replace(surface, vertices=np.concatenate(vertices), faces=np.concatenate(faces), uv=np.concatenate(uv))


def _lattice(n: int) -> _Floats:
    """Barycentric weights of the corners of n² equal triangles in one, (n², 3, 3)."""
    triangles = []
    for i in range(n):
        for j in range(n - i):
            triangles.append([(i, j), (i + 1, j), (i, j + 1)])
            if i + j < n - 1:
                triangles.append([(i + 1, j), (i + 1, j + 1), (i, j + 1)])
    weights = np.array(triangles, dtype=np.float64) / n
    return np.concatenate([1.0 - weights.sum(axis=-1, keepdims=True), weights], axis=-1)
