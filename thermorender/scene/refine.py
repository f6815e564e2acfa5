"""Finer triangles beside objects and where triangles are large, because light is constant over a triangle.

Light changes within a fraction of the size of an object beside it, and from foot to eaves of a wall.
"""

from collections.abc import Callable, Sequence
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
# The same of the ground beside objects. A triangle there has parts of a longest edge squared on average, since halving
# overshoots and ends conformingly: measured 4 to 10.
_MOST_BESIDE, _PARTS_BESIDE = 1 << 18, 9.0
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
# Triangles whose longest edges differ by up to 2 to this power are searched for bodies together.
_SIZES = 2
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


class _Bodies:
    """Bodies, found by their boxes. No edge beside them needs to be shorter than `least` [m]."""

    def __init__(self, each: Sequence[_Body], least: float = 0.0) -> None:
        self.each, self.least = each, least
        self._low, self._high = (
            np.array([getattr(body, name) for body in each]).reshape(-1, 3) for name in ("low", "high")
        )

    def within(self, low: _Floats, high: _Floats) -> list[int]:
        """Return the numbers of the bodies whose boxes meet the box from `low` to `high`."""
        found: list[int] = np.flatnonzero(((self._high >= low) & (self._low <= high)).all(axis=1)).tolist()
        return found


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
    near = _least_edge_beside(terrain, (*objects, *beside))
    each = [_body(item, max(_EDGE_SHARE * _extent(item), least)) for item in (*objects, *beside)]
    solid, bodies = _Bodies(each[: len(objects)]), _Bodies(each, near)
    return [_finer(surface, np.inf, bodies) for surface in terrain], [
        _finer(item, max(own_share * _extent(item), least), solid) for item in objects
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

    return _least(added, _MOST_ON_OBJECTS, own.min(), longest.max())


def _least_edge_beside(terrain: Sequence[Surface], bodies: Sequence[Surface]) -> float:
    """Shortest limit of an edge at bodies with which the ground beside all gains at most `_MOST_BESIDE` triangles [m].

    At a distance r from a box of perimeter P in plan, edges of e + r/2 allow an area of (P + 2πr) dr to be cut into
    triangles of about e², up to the ground's typical edge, or half way to the next body.
    """
    bodies = [item for item in bodies if _extent(item) > 0.0]
    longest = [_longest(item.vertices[item.faces]) for item in terrain if len(item.faces)]
    if not bodies or not longest:
        return 0.0
    typical = float(np.median(np.concatenate(longest)))
    own = np.array([_EDGE_SHARE * _extent(item) for item in bodies])
    around = 2.0 * np.array([np.ptp(item.vertices[:, :2], axis=0).sum() for item in bodies])
    # Where edges reach the typical one; bodies within a square of this side share it.
    side = typical / _GROWTH
    square = np.array([np.floor(item.vertices[:, :2].mean(axis=0) / side) for item in bodies])
    _, number, count = np.unique(square, axis=0, return_inverse=True, return_counts=True)
    area = side**2 / count[number.reshape(-1)]
    between = _GROWTH * np.sqrt(area / np.pi)

    def added(edge: float) -> float:
        least = np.minimum(np.maximum(own, edge), typical)
        most = np.minimum(np.maximum(between, least), typical)
        rows = around / _GROWTH * (1.0 / least - 1.0 / most) + 2.0 * np.pi / _GROWTH**2 * np.log(most / least)
        return _PARTS_BESIDE * float((rows + area * (most**-2 - typical**-2)).sum())

    return _least(added, _MOST_BESIDE, own.min(), typical)


def _least(added: Callable[[float], float], most: int, low: float, high: float) -> float:
    """The shortest edge between two with which `added` triangles are at most so many; 0 where they always are."""
    if added(0.0) <= most:
        return 0.0
    low, high = float(np.log2(low)), float(np.log2(high))
    for _ in range(30):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if added(float(np.exp2(middle))) <= most else (middle, high)
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


def _finer(surface: Surface, own: float, bodies: _Bodies) -> Surface:
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


def _allowed(corner: _Floats, own: float, bodies: _Bodies) -> _Floats:
    """Longest edge allowed in triangles (F, 3 corners, 3), (F,) [m]: `own`, or what the bodies before them allow."""
    limit, longest = np.full(len(corner), own), _longest(corner)
    # Small triangles are lit from nearby alone, so those of like size are searched together.
    size = np.frexp(longest)[1] // _SIZES
    for one in np.unique(size):
        alike = np.flatnonzero(size == one)
        limit[alike] = _allowed_alike(corner[alike], longest[alike], own, bodies)
    return limit


def _allowed_alike(corner: _Floats, longest: _Floats, own: float, bodies: _Bodies) -> _Floats:
    """As `_allowed`, of triangles (F, 3 corners, 3) of like size, whose longest edges are `longest` (F,) [m]."""
    limit, low, high = np.full(len(corner), own), corner.min(axis=1).T, corner.max(axis=1).T
    # Farther away, no triangle is too large.
    reach = longest.max() / _GROWTH
    numbers = bodies.within(low.min(axis=1) - reach, high.max(axis=1) + reach)
    if not numbers:
        return limit
    normal = _normals(corner)
    order = low[0].argsort()
    east, widest = low[0][order], (high[0] - low[0]).max()
    for number in numbers:
        body = bodies.each[number]
        first = east.searchsorted(body.low[0] - reach - widest)
        near = order[first : east.searchsorted(body.high[0] + reach, "right")]
        near = near[(low[1][near] <= body.high[1] + reach) & (high[1][near] >= body.low[1] - reach)]
        apart = np.maximum(np.maximum(body.low[:, None] - high[:, near], low[:, near] - body.high[:, None]), 0.0)
        edge = np.maximum(max(body.edge, bodies.least), _GROWTH * np.sqrt(np.einsum("kf,kf->f", apart, apart)))
        fine = np.minimum(longest[near], limit[near]) <= edge
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
