"""Finer triangles beside objects and where triangles are large, because light is constant over a triangle.

Light changes within a fraction of the size of an object beside it, and from foot to eaves of a wall.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thermorender.scene.surface import Surface

_Floats = NDArray[np.float64]

# Longest edge of a triangle beside an object, as a share of the object's extent. It grows with the distance from the
# object's box by _GROWTH, since light changes the more slowly the farther away its source is.
_EDGE_SHARE, _GROWTH = 1.0 / 16.0, 0.5
# Longest edge of a triangle of an object that no body rises before, as a share of its own extent.
_OWN_SHARE = 1.0 / 4.0
# The same of an object with a track: rays from its triangles alone light the scene, and fewer of them are noise there.
TRACKED_SHARE = 1.0 / 8.0
# Triangles that may be added to all objects together. Where the shares above would add more, the shortest edges are
# lengthened first: small objects among many are cut less, and large ones beside them as before.
_MOST_ON_OBJECTS = 1 << 15
# Distance at which bodies touch, as a share of the longest edge at a body.
_TOUCH = 0.1
# Triangles by halving, as a multiple of the product of length and height in longest edges: halving overshoots.
_PARTS = 3.0
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
# Evenly spread directions in which an object's outermost corners are kept.
_DIRECTIONS = 64


@dataclass(frozen=True, eq=False)
class _Body:
    """What lights triangles beside it."""

    low: _Floats  # (3,) lowest corner of its box [m]
    high: _Floats  # (3,)
    outermost: _Floats  # (n, 3) its outermost corners [m]
    planes: tuple[_Floats, _Floats] | None  # Normals (k, 3) and offsets (k,) of a closed convex body; None: other
    edge: float  # Longest edge of a triangle at it [m]


def refined(
    terrain: Sequence[Surface],
    objects: Sequence[Surface],
    beside: Sequence[Surface] = (),
    own_share: float = _OWN_SHARE,
) -> tuple[list[Surface], list[Surface]]:
    """Return (terrain, objects) with the same shapes and smaller triangles: longest edges are halved conformingly.

    Where an object rises before a triangle, no edge is longer than 1/16 of its extent, or half of the distance from it;
    on an object, than `own_share` of its own extent. Longer edges are allowed where the number of triangles would be
    too large. What is only `beside` the terrain refines it and is not returned.
    """
    least = _least_edge(objects)
    bodies = [_body(item, max(_EDGE_SHARE * _extent(item), least)) for item in (*objects, *beside)]
    return [_finer(surface, np.inf, bodies) for surface in terrain], [
        _finer(item, max(own_share * _extent(item), least), bodies[: len(objects)]) for item in objects
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
    return 0.5 * np.linalg.norm(_across(surface.vertices[faces]), axis=1)


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
    height = 2.0 * np.concatenate([_area(item, item.faces) for item in objects]) / np.maximum(longest, 1e-300)
    own = np.repeat([_EDGE_SHARE * _extent(item) for item in objects], [len(item.faces) for item in objects])

    def added(edge: float) -> float:
        most = np.maximum(own, edge)
        return float(np.where(longest > most, _PARTS * longest * np.maximum(height, most) / most**2, 0.0).sum())

    if added(0.0) <= _MOST_ON_OBJECTS:
        return 0.0
    low, high = np.log2(own.min()), np.log2(longest.max())
    for _ in range(30):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if added(np.exp2(middle)) <= _MOST_ON_OBJECTS else (middle, high)
    return float(np.exp2(high))


def _extent(item: Surface) -> float:
    return float(np.ptp(item.vertices, axis=0).max())


def _body(item: Surface, edge: float) -> _Body:
    vertices = item.vertices
    number = np.arange(_DIRECTIONS) + 0.5
    up, turn = 1.0 - 2.0 * number / _DIRECTIONS, np.pi * (1.0 + 5.0**0.5) * number
    level = np.sqrt(1.0 - up**2)
    towards = np.column_stack([level * np.cos(turn), level * np.sin(turn), up])
    outermost = vertices[np.unique((vertices @ towards.T).argmax(axis=0))]
    planes = None
    if len(item.faces) <= _DIRECTIONS:
        normal, area = _normals(vertices[item.faces]), _area(item, item.faces)
        offset = np.einsum("fk,fk->f", normal, vertices[item.faces[:, 0]])
        closed = np.abs(area @ normal).max() <= 1e-3 * area.sum()
        if closed and (vertices @ normal.T <= offset + _TOUCH * edge).all():
            planes = normal, offset
    return _Body(vertices.min(axis=0), vertices.max(axis=0), outermost, planes, edge)


def _normals(corner: _Floats) -> _Floats:
    """Unit normals of triangles by their corners (F, 3 corners, 3), (F, 3); 0 of degenerate ones."""
    across = _across(corner)
    found: _Floats = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-300)
    return found


def _across(corner: _Floats) -> _Floats:
    """Vectors across triangles by their corners (F, 3 corners, 3), twice their area long, (F, 3)."""
    # By components: np.cross takes four times as long for a few triangles.
    (a, b, c), (d, e, f) = (corner[:, 1] - corner[:, 0]).T, (corner[:, 2] - corner[:, 0]).T
    return np.stack([b * f - c * e, c * d - a * f, a * e - b * d], axis=1)


def _longest(corner: _Floats) -> _Floats:
    """Longest edge of triangles by their corners (F, 3 corners, 3), (F,) [m]."""
    edge: _Floats = np.linalg.norm(corner - np.roll(corner, 1, axis=1), axis=-1)
    return edge.max(axis=1)


def _finer(surface: Surface, own: float, bodies: Sequence[_Body]) -> Surface:
    """A surface without edges longer than `own` and than those allowed beside bodies [m]."""
    corner = surface.vertices[surface.faces]
    longest, limit = _longest(corner), _allowed(corner, own, bodies)
    if (longest > limit).any():
        surface = replace(surface, faces=_shared(surface))
    while (large := longest > limit).any():
        surface, whole = _bisected(surface, large)
        corner = surface.vertices[surface.faces[np.count_nonzero(whole) :]]
        longest = np.concatenate([longest[whole], _longest(corner)])
        limit = np.concatenate([limit[whole], _allowed(corner, own, bodies)])
    return surface


def _allowed(corner: _Floats, own: float, bodies: Sequence[_Body]) -> _Floats:
    """Longest edge allowed in triangles (F, 3 corners, 3), (F,) [m]: `own`, or what the bodies before them allow."""
    limit = np.full(len(corner), own)
    if not len(corner):
        return limit
    low, high = corner.min(axis=1).T, corner.max(axis=1).T
    longest = _longest(corner)
    # Farther away, no triangle is too large.
    reach = longest.max() / _GROWTH
    first, last = low.min(axis=1) - reach, high.max(axis=1) + reach
    lows, highs = (np.array([getattr(body, name) for body in bodies]).reshape(-1, 3) for name in ("low", "high"))
    numbers = np.flatnonzero(((highs >= first) & (lows <= last)).all(axis=1)).tolist()
    if not numbers:
        return limit
    normal = _normals(corner)
    for number in numbers:
        body = bodies[number]
        near = np.flatnonzero((low[0] <= body.high[0] + reach) & (high[0] >= body.low[0] - reach))
        apart = [
            np.maximum(np.maximum(body.low[k] - high[k][near], low[k][near] - body.high[k]), 0.0) for k in range(3)
        ]
        edge = np.maximum(body.edge, _GROWTH * np.sqrt(sum(each**2 for each in apart)))
        fine = np.minimum(longest, limit)[near] <= edge
        near, edge = near[~fine], edge[~fine]
        if not len(near):
            continue
        here, across = corner[near], normal[near]
        rises = (across @ body.outermost.T).max(axis=1) - np.einsum("fk,fk->f", across, here[:, 0])
        lit = rises > _TOUCH * body.edge
        if body.planes is not None:
            # All corners of a covered triangle lie in the body or on its surface.
            inside = np.einsum("fck,pk->fcp", here + _TOUCH * body.edge * across[:, None], body.planes[0])
            lit &= ~(inside <= body.planes[1] + 2.0 * _TOUCH * body.edge).all(axis=(1, 2))
        limit[near[lit]] = np.minimum(limit[near[lit]], edge[lit])
    return limit
