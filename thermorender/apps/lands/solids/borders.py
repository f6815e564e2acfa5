"""Borders of buildings: outlines are cut where they meet, cross or touch, so that each piece of wall stands once.

Outlines of maps share walls, overlap by a little, lie inside each other, or cross themselves. Every side is cut at all
others. A piece then has a building on one of its hands, another one or open ground on the other, or the same building
on both, where it is no border. Where outlines overlap, the smaller building keeps its shape.
"""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.lands.solids.detection import Outline, area_of, even_odd

# Corners this near to another building's corner or side are moved onto it [m].
_SNAP_M = 0.3
# Points this near are one; distance from a piece at which its hands are tested [posts].
_SAME, _BESIDE = 1e-3, 1e-2
# Outlines of a smaller mean width cannot be built: a test beside one wall is already beyond the opposite one [posts].
THIN = 2.0 * _BESIDE
# Longest piece [posts].
_LONGEST = 2.0
# Building number of open ground.
OPEN = -1


class Loop(NamedTuple):
    """A closed border of a building, which is to the left in the world as one walks along it."""

    point: NDArray[np.float64]  # (n, 2) float64 (column, row)
    # (n,) int64 building on the other hand of the piece from each point to the next; OPEN for none, and the building
    # itself where no wall stands
    beyond: NDArray[np.int64]
    side: NDArray[np.int64]  # (n,) int64 number of the side of an outline that the piece is a part of
    along: NDArray[np.float64]  # (n, 2) float64 beginning and end of the piece as shares of that side


class _Sides(NamedTuple):
    """Sides of all outlines: ends (n, 2) each, and the building (n,) of each; OPEN for the edge of the grid."""

    a: NDArray[np.float64]
    b: NDArray[np.float64]
    building: NDArray[np.int64]


def borders(outlines: Sequence[Outline], shape: tuple[int, int], post_m: float) -> list[list[Loop]]:
    """Return the Loops of each of some outlines, inside a grid of `shape` (rows, columns) posts.

    An outline that smaller ones cover has none, even if they leave a tip so thin that its border has two points. Parts
    follow the outline that is their `whole`, and are cut by it.
    """
    rings = _snapped([list(each.rings) for each in outlines], _SNAP_M / post_m)
    number = {each: k for k, each in enumerate(outlines)}
    whole = [number[each.whole or each] for each in outlines]
    low, high = np.array([0.5, 0.5]), np.array([shape[1] - 0.5, shape[0] - 0.5])
    edge = np.array([low, [high[0], low[1]], high, [low[0], high[1]]])
    sides = _sides_of([*rings, [edge]])
    sides = sides._replace(building=np.where(sides.building == len(rings), OPEN, sides.building))
    point, first, last, side, begin, end = _pieces(sides)
    middle = 0.5 * (point[first] + point[last])
    step = point[last] - point[first]
    # Rows count southwards, so the left in the world has this sign in (column, row).
    left = np.column_stack([step[:, 1], -step[:, 0]]) / np.linalg.norm(step, axis=1, keepdims=True)
    owner = _owners(np.concatenate([middle + _BESIDE * left, middle - _BESIDE * left]), rings, whole, (low, high))
    on_left, on_right = np.split(owner, 2)
    tables, shares = [], []
    for own, other, start, stop, share in (
        (on_left, on_right, first, last, np.column_stack([begin, end])),
        (on_right, on_left, last, first, np.column_stack([end, begin])),
    ):
        mine = (own != other) & (own != OPEN)
        tables.append(np.column_stack([start, stop, own, other, side])[mine])
        shares.append(share[mine])
    table, along = np.concatenate(tables), np.concatenate(shares)
    order = np.argsort(table[:, 2], kind="stable")
    table, along = table[order], along[order]
    ends = np.searchsorted(table[:, 2], np.arange(len(outlines) + 1))
    parts = [slice(*each) for each in zip(ends[:-1], ends[1:], strict=True)]
    made = [[_loop(point, table[part], along[part], chain) for chain in _chains(table[part, :2])] for part in parts]
    return [loops if sum(len(each.point) for each in loops) > 2 else [] for loops in made]


def _snapped(rings: list[list[NDArray[np.float64]]], near: float) -> list[list[NDArray[np.float64]]]:
    """Rings of buildings whose corners lie on those or on sides of earlier buildings where they were near."""
    rings = [[ring.copy() for ring in each] for each in rings]
    for one, other in _neighbours(rings, near):
        first, second = min(one, other), max(one, other)
        if first == second:
            continue
        fixed = np.concatenate(rings[first])
        a, b = (np.concatenate(each) for each in zip(*((r, np.roll(r, -1, axis=0)) for r in rings[first]), strict=True))
        for index, ring in enumerate(rings[second]):
            away = np.linalg.norm(ring[:, None] - fixed[None], axis=2)
            best = away.argmin(axis=1)
            at_corner = away[np.arange(len(ring)), best] < near
            foot = _feet(ring, a, b)
            apart = np.linalg.norm(ring[:, None] - foot, axis=2)
            nearest = apart.argmin(axis=1)
            rows = np.arange(len(ring))
            at_side = ~at_corner & (apart[rows, nearest] < near)
            ring[at_side] = foot[rows, nearest][at_side]
            ring[at_corner] = fixed[best][at_corner]
            rings[second][index] = _bent(ring, fixed, near)
    return rings


def _bent(ring: NDArray[np.float64], fixed: NDArray[np.float64], near: float) -> NDArray[np.float64]:
    """A ring whose sides also pass through others' corners (n, 2) that are near to them, but not to its own."""
    apart = np.linalg.norm(fixed[:, None] - _feet(fixed, ring, np.roll(ring, -1, axis=0)), axis=2)
    own = np.linalg.norm(fixed[:, None] - ring, axis=2).min(axis=1)
    added = np.flatnonzero((apart.min(axis=1) < near) & (own > _SAME))
    if not added.size:
        return ring
    side = apart[added].argmin(axis=1)
    along = np.roll(ring, -1, axis=0)[side] - ring[side]
    order = np.lexsort((((fixed[added] - ring[side]) * along).sum(axis=1), side))
    return np.insert(ring, side[order] + 1, fixed[added[order]], axis=0)


def _feet(point: NDArray[np.float64], a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Nearest points (n, m, 2) of sides a–b (m, 2) to points (n, 2)."""
    along = b - a
    square = np.maximum((along**2).sum(axis=1), 1e-12)
    share = np.clip(((point[:, None] - a) * along).sum(axis=2) / square, 0.0, 1.0)
    found: NDArray[np.float64] = a + share[..., None] * along
    return found


def _neighbours(rings: Sequence[Sequence[NDArray[np.float64]]], near: float) -> Iterator[tuple[int, int]]:
    """Yield pairs of buildings whose boxes meet, each pair once, and each building with itself."""
    low = np.array([np.concatenate(each).min(axis=0) for each in rings]).reshape(-1, 2) - near
    high = np.array([np.concatenate(each).max(axis=0) for each in rings]).reshape(-1, 2) + near
    order = np.argsort(low[:, 0], kind="stable")
    begins = low[order, 0]
    for place, one in enumerate(order):
        last = np.searchsorted(begins, high[one, 0], "right")
        others = order[place:last]
        meets = (low[others, 1] <= high[one, 1]) & (high[others, 1] >= low[one, 1])
        for other in others[meets]:
            yield int(one), int(other)


def _sides_of(rings: Sequence[Sequence[NDArray[np.float64]]]) -> _Sides:
    a, b, building = [], [], []
    for number, each in enumerate(rings):
        for ring in each:
            following = np.roll(ring, -1, axis=0)
            long = np.linalg.norm(following - ring, axis=1) > _SAME
            a.append(ring[long])
            b.append(following[long])
            building.append(np.full(int(long.sum()), number))
    return _Sides(np.concatenate(a), np.concatenate(b), np.concatenate(building).astype(np.int64))


def _pieces(sides: _Sides) -> tuple[NDArray[Any], ...]:
    """(points (p, 2), first and last point (n,), side (n,), its shares at both ends (n,)), each piece once."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    cut = [[0.0, 1.0] for _ in sides.a]
    for one, other in _near_sides(sides):
        for number, share in _cuts(sides, one, other):
            cut[number].append(share)
    shares = [np.unique(each) for each in cut]
    side = np.repeat(np.arange(len(shares)), [len(each) for each in shares])
    at = np.concatenate(shares)
    point = sides.a[side] + at[:, None] * (sides.b[side] - sides.a[side])
    pairs = cKDTree(point).query_pairs(_SAME, output_type="ndarray").reshape(-1, 2)
    links = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(point), len(point)))
    count, name = connected_components(links, directed=False)
    place = np.zeros((count, 2))
    place[name[::-1]] = point[::-1]
    inner = side[:-1] == side[1:]
    first, last = name[:-1][inner], name[1:][inner]
    keep = first != last
    row = np.flatnonzero(inner)[keep]
    first, last = first[keep], last[keep]
    pair = np.sort(np.column_stack([first, last]), axis=1)
    _, once = np.unique(pair, axis=0, return_index=True)
    return _shortened(place, first[once], last[once], side[row][once], at[row][once], at[row + 1][once])


def _shortened(
    point: NDArray[np.float64], first: NDArray[np.int64], last: NDArray[np.int64], side: NDArray[np.int64],
    begin: NDArray[np.float64], end: NDArray[np.float64],
) -> tuple[NDArray[Any], ...]:  # fmt: skip
    """Pieces as `_pieces` returns them, the longer ones divided."""
    length = np.linalg.norm(point[last] - point[first], axis=1)
    count = np.maximum(np.ceil(length / _LONGEST - 1e-6), 1).astype(int)
    piece = np.repeat(np.arange(len(count)), count)
    k = np.arange(len(piece)) - np.repeat(np.cumsum(count) - count, count)
    share, next_share = k / count[piece], (k + 1) / count[piece]
    inner = k > 0
    number = np.cumsum(inner) - 1 + len(point)
    start = np.where(inner, number, first[piece])
    stop = np.append(start[1:], 0)
    stop = np.where(k + 1 == count[piece], last[piece], stop)
    added = point[first[piece]] + share[:, None] * (point[last[piece]] - point[first[piece]])
    along = [begin[piece] + each * (end - begin)[piece] for each in (share, next_share)]
    return np.concatenate([point, added[inner]]), start, stop, side[piece], *along


def _near_sides(sides: _Sides) -> Iterator[tuple[int, int]]:
    """Yield pairs of sides whose boxes meet."""
    return (pair for pair in _neighbours([[np.stack(ends)] for ends in zip(sides.a, sides.b, strict=True)], _SAME)
            if pair[0] != pair[1])  # fmt: skip


def _cuts(sides: _Sides, one: int, other: int) -> Iterator[tuple[int, float]]:
    """Yield (side, share along it) at which two sides cross, or one ends on the other."""
    ends = {one: (sides.a[one], sides.b[one]), other: (sides.a[other], sides.b[other])}
    for number, against in ((one, other), (other, one)):
        a, b = ends[number]
        for corner in ends[against]:
            share = float((corner - a) @ (b - a) / ((b - a) @ (b - a)))
            if 0.0 < share < 1.0 and np.linalg.norm(a + share * (b - a) - corner) < _SAME:
                yield number, share
    (a, b), (c, d) = ends[one], ends[other]
    across = float((b - a)[0] * (d - c)[1] - (b - a)[1] * (d - c)[0])
    if abs(across) < 1e-9:
        return
    s = float((c - a)[0] * (d - c)[1] - (c - a)[1] * (d - c)[0]) / across
    t = float((c - a)[0] * (b - a)[1] - (c - a)[1] * (b - a)[0]) / across
    if 0.0 < s < 1.0 and 0.0 < t < 1.0:
        yield one, s
        yield other, t


def _owners(
    point: NDArray[np.float64], rings: Sequence[Sequence[NDArray[np.float64]]], whole: Sequence[int],
    within: tuple[Any, Any],
) -> NDArray[np.int64]:  # fmt: skip
    """The smallest building around each point, (n,), or its last part; OPEN without one, and outside of `within`."""
    found = np.full(len(point), OPEN)
    order = np.argsort(point[:, 0], kind="stable")
    x = point[order, 0]
    for number in sorted(range(len(rings)), key=lambda k: -area_of(rings[whole[k]][0])):
        corner = np.concatenate(rings[number])
        low, high = corner.min(axis=0), corner.max(axis=0)
        here = order[np.searchsorted(x, low[0]) : np.searchsorted(x, high[0], "right")]
        here = here[(point[here, 1] >= low[1]) & (point[here, 1] <= high[1])]
        here = here[even_odd(point[here], rings[number])]
        found[here[even_odd(point[here], rings[whole[number]])] if whole[number] != number else here] = number
    found[((point < within[0]) | (point > within[1])).any(axis=1)] = OPEN
    return found


def _chains(pair: NDArray[np.int64]) -> list[list[int]]:
    """Closed chains of rows (start, stop), each row in one chain."""
    leaving: dict[int, list[int]] = {}
    for row, (start, _) in enumerate(pair.tolist()):
        leaving.setdefault(start, []).append(row)
    chains = []
    for start in list(leaving):
        while leaving[start]:
            chain, at = [], start
            while leaving.get(at):
                row = leaving[at].pop()
                chain.append(row)
                at = int(pair[row, 1])
            chains.append(chain)
    return chains


def _loop(
    point: NDArray[np.float64], table: NDArray[np.int64], along: NDArray[np.float64], chain: Sequence[int]
) -> Loop:
    """The Loop of a chain of rows; one that is not closed, at a gap thinner than a probe, is closed without a wall."""
    found = Loop(point[table[chain, 0]], table[chain, 3], table[chain, 4], along[chain])
    if table[chain[-1], 1] == table[chain[0], 0]:
        return found
    return Loop(
        np.append(found.point, point[table[chain[-1:], 1]], axis=0), np.append(found.beyond, table[chain[0], 2]),
        np.append(found.side, found.side[-1]), np.append(found.along, [[0.0, 0.0]], axis=0),
    )  # fmt: skip
