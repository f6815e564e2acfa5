"""Parts of a building at different heights: roofs are cut where they step, and at courtyards, and walls stand there."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.lands.solids.detection import LEAST_M, Outline, even_odd, outlines_of

# Neighbouring posts with a steeper slope between them are not of one roof: 60°.
_STEEP = np.tan(np.radians(60.0))
# Parts differ by a storey, and are as large as a garage: [m], [m²].
_STOREY_M, _LEAST_PART_M2 = 2.5, 12.0
# Heights are compared at this distance from the line between two parts; parts reach so far over it and the outline.
_BESIDE = 2


def without_courtyards(
    outlines: Sequence[Outline], height: NDArray[np.float64], ground: NDArray[np.float64], post_m: float
) -> list[Outline]:
    """Return outlines with holes where the surface model has open ground within a building, as large as a part.

    Ground that reaches the outline stays: outlines are often drawn metres off.
    """
    from scipy.ndimage import binary_dilation, binary_opening, label

    low = np.isfinite(height) & (height - ground <= LEAST_M)
    made = []
    for outline in outlines:
        window, corner = _window(outline, height.shape)
        inside = _inside(outline, corner, low[window].shape)
        names, count = label(binary_opening(low[window] & inside, np.ones((3, 3))))
        size = np.bincount(names.ravel(), minlength=count + 1) * post_m**2
        size[np.unique(names[binary_dilation(~inside, np.ones((3, 3)), border_value=1)])] = 0.0
        yards = outlines_of((size >= _LEAST_PART_M2)[names] & (names > 0)) if size[1:].any() else []
        rings = [ring + corner for each in yards for ring in each.rings]
        made.append(replace(outline, rings=[*outline.rings, *rings]) if rings else outline)
    return made


def _window(outline: Outline, shape: tuple[int, ...]) -> tuple[tuple[slice, slice], NDArray[np.int64]]:
    """(Rows and columns around an outline, (column, row) of their first post)."""
    corner = np.concatenate(list(outline.rings))
    low = np.maximum(np.floor(corner.min(axis=0)).astype(int) - _BESIDE - 1, 0)
    high = np.maximum(np.ceil(corner.max(axis=0)).astype(int) + _BESIDE + 1, 0)
    return (slice(low[1], min(high[1], shape[0])), slice(low[0], min(high[0], shape[1]))), low


def _inside(outline: Outline, first: NDArray[np.int64], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Which posts of a window have their middle in an outline."""
    row, column = np.mgrid[: shape[0], : shape[1]]
    place = np.column_stack([column.ravel() + first[0], row.ravel() + first[1]]) + 0.5
    inside: NDArray[np.bool_] = even_odd(place, outline.rings).reshape(shape)
    return inside


def cut_at_steps(
    outlines: Sequence[Outline], height: NDArray[np.float64], ground: NDArray[np.float64], post_m: float
) -> tuple[list[Outline], NDArray[np.float64]]:
    """Return (outlines followed by their parts, heights without the posts that would be in the wrong part's roof) of a
    surface model and its ground, (h, w) [m].

    The largest part of a building keeps the outline; the others name it as their `whole`, from large to small. Borders
    of parts have straight sides, and so enclose some posts of the next part, most of all where a part tapers in the
    plan. A step that falls below the slope of `_STEEP` at one end does not separate its roofs, which are one part.
    """
    parts: list[Outline] = []
    clear = height.copy()
    for outline in outlines:
        window, low = _window(outline, height.shape)
        level = height[window]
        if not level.size:
            continue
        inside = _inside(outline, low, level.shape)
        region, mixed = _regions(np.where(inside & (level - ground[window] > LEAST_M), level, np.nan), inside, post_m)
        owner = np.zeros_like(region)
        for number, rings in _rings(region, inside):
            owner[_inside(Outline(rings), np.zeros(2, np.int64), level.shape)] = number
            parts.append(Outline([ring + low for ring in rings], outline.tags, outline))
        clear[window][mixed | (inside & (owner != region))] = np.nan
    return [*outlines, *parts], clear


def _regions(
    level: NDArray[np.float64], inside: NDArray[np.bool_], post_m: float
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """(number of each post's part, 0… from large to small, posts between two parts that belong to no roof)."""
    from scipy.ndimage import binary_opening, distance_transform_edt, maximum_filter, minimum_filter

    name = _connected(level, _STEEP * post_m)
    count = np.bincount(name[name >= 0], minlength=1)
    large = [k for k in np.flatnonzero(count * post_m**2 >= _LEAST_PART_M2)
             if binary_opening(name == k, np.ones((3, 3))).any()]  # fmt: skip
    nothing = np.zeros(level.shape, bool)
    if len(large) < 2:
        return np.zeros(level.shape, np.int64), nothing
    kept = np.isin(name, large)
    nearest = distance_transform_edt(~kept, return_distances=False, return_indices=True)
    region = _joined(name[tuple(nearest)], level)
    values, region = np.unique(region, return_inverse=True)
    region = region.reshape(level.shape)
    order = np.argsort(-np.bincount(region[inside], minlength=len(values)), kind="stable")
    region = np.argsort(order)[region]
    between = maximum_filter(region, 2 * _BESIDE + 1) != minimum_filter(region, 2 * _BESIDE + 1)
    return region, between & ~kept & np.isfinite(level)


def _connected(level: NDArray[np.float64], most_m: float) -> NDArray[np.int64]:
    """Number of the connected posts to which each belongs, whose heights differ by less than `most_m`; −1 at NaN."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    number = np.arange(level.size).reshape(level.shape)
    pairs = [(number[:-1], number[1:]), (number[:, :-1], number[:, 1:])]
    flat = level.ravel()
    first, last = (np.concatenate([pair[k].ravel() for pair in pairs]) for k in (0, 1))
    near = np.abs(flat[first] - flat[last]) < most_m
    links = coo_matrix((np.ones(near.sum()), (first[near], last[near])), shape=(level.size, level.size))
    name: NDArray[np.int64] = connected_components(links, directed=False)[1].astype(np.int64).reshape(level.shape)
    return np.where(np.isfinite(level), name, -1)


def _joined(region: NDArray[np.int64], level: NDArray[np.float64]) -> NDArray[np.int64]:
    """Parts with one number where the median step between them is less than a storey."""
    steps: dict[tuple[int, int], list[NDArray[np.float64]]] = {}
    for own, high in ((region, level), (region.T, level.T)):
        reach = 2 * _BESIDE + 1
        # Across each line: the post before it, the post after it, and those _BESIDE further away.
        a, b = own[_BESIDE : -_BESIDE - 1], own[_BESIDE + 1 : -_BESIDE]
        step = np.abs(high[:-reach] - high[reach:])
        line = (a != b) & np.isfinite(step) & (own[:-reach] == a) & (own[reach:] == b)
        for pair in np.unique(np.sort(np.column_stack([a[line], b[line]]), axis=1), axis=0):
            here = line & (np.minimum(a, b) == pair[0]) & (np.maximum(a, b) == pair[1])
            steps.setdefault((int(pair[0]), int(pair[1])), []).append(step[here])
    joined = region.copy()
    for (one, other), found in steps.items():
        if np.median(np.concatenate(found)) < _STOREY_M:
            first, second = (joined[region == each][0] for each in (one, other))
            joined[joined == second] = first
    return joined


def _rings(region: NDArray[np.int64], inside: NDArray[np.bool_]) -> list[tuple[int, list[NDArray[np.float64]]]]:
    """(Number, rings) of all parts but the largest; each reaches over the outline and over smaller parts."""
    from scipy.ndimage import binary_dilation

    around = binary_dilation(inside, np.ones((3, 3)), iterations=_BESIDE)
    made = []
    for number in range(1, int(region.max()) + 1):
        part = region == number
        grown = binary_dilation(part, np.ones((3, 3)), iterations=_BESIDE) & (region > number)
        made += [(number, list(each.rings)) for each in outlines_of((part | grown) & around)]
    return made
