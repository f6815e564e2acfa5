"""What stands on the ground, found in a surface model: the ground below, outlines of buildings, and single trees."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError
from thermorender.scene.patch import burnt
from thermorender.scene.raster import Grid, onto
from thermorender.scene.surface import fill, nearest_valid
from thermorender.scene.terrain import filled

# What is lower than this above the ground is part of it [m]; least area of buildings found by height [m²].
LEAST_M, LEAST_AREA_M2 = 2.0, 25.0
# Progressive morphological filter: Zhang and others, IEEE Trans. Geosci. Remote Sens. 41 (2003) 872,
# doi:10.1109/TGRS.2003.810682: largest window, slope of the ground, first and largest threshold [m].
_WINDOW_M, _SLOPE, _FIRST_M, _MOST_M = 60.0, 0.15, 0.4, 2.0
# Roofs are smooth: the mean absolute second difference of heights over 3 × 3 posts of 1 m is below this [m].
_SMOOTH_M = 0.45
# At an edge post with a wall, the surface within this distance is lower by more than `LEAST_M` [m]. Smooth areas are
# buildings if at least this share of their edge posts has a wall. A free-standing building has a share of 1, one that
# is dug into a slope 3/4, and a terrace 1/2.
_BESIDE_M, _FREE_SHARE = 3.0, 2.0 / 3.0
# Missing posts within this distance of known ones may belong to a roof [m].
_GAP_M = 1.0
# A post is green if its excess green index is above this: 2 g − r − b, where r, g, b are shares of the sum of the sRGB
# values; Woebbecke and others, Trans. ASAE 38 (1995) 259. Cyan has it too, so g − b is above the second value, as in
# 95 % of such vegetation in labelled aerial pictures.
_GREEN, _NOT_CYAN = 0.10, 0.03
# On open ground, surface model minus terrain model has at most this standard deviation in a window of this side [m]:
# airborne lidar has errors of 0.05 to 0.15 m. Crowns 2 m wide or more have at least twice as much. It is tested at the
# lowest posts, up to this height above the lowest one [m].
_ROUGH_M, _ROUGH_OVER_M, _FLOOR_M = 0.2, 3.0, 0.5
# Trees: standard deviation of the smoothing of heights and least distance of two tops [m]; least area of a narrow crown
# that stands alone [m²].
_BLUR_M, _APART_M, _LEAST_CROWN_M2 = 0.8, 3.0, 1.0

Ring = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Outline:
    """The outer ring and the holes of a building, (N, 2) each as (column, row), and its tags in the file.

    A part that was cut out of an outline at a step of the roof has that outline as `whole`. A part that the file draws
    as an outline of its own has the outline of its building as `of`.
    """

    rings: Sequence[Ring]
    tags: Mapping[str, str] = field(default_factory=dict)
    whole: "Outline | None" = None
    of: "Outline | None" = None

    @property
    def building(self) -> "Outline":
        """The outline of the building: this one, or the one that it is a part of."""
        whole = self.whole or self
        return whole.of or whole


@dataclass(frozen=True, eq=False)
class Tree:
    """One tree: posts (n, 2) of its crown as (row, column), its highest post, and the height there [m above ground]."""

    posts: NDArray[np.int64]
    top: tuple[int, int]
    height_m: float


def ground_below(
    height: NDArray[np.float64], post_m: float, green: NDArray[np.bool_] | None = None
) -> NDArray[np.float64]:
    """Return the heights of the ground below a surface model, (h, w) [m]; NaN where that has none.

    Morphological openings with growing windows remove what is narrower than the window, and interpolation fills the
    gaps. Openings also remove the edge of a terrace. A part of it becomes ground again if it is smooth, is not `green`,
    (h, w), and has a drop on less than `_FREE_SHARE` of its border.
    """
    from scipy.ndimage import grey_opening

    known = np.isfinite(height)
    last = fill(height, nearest_valid(known))
    ground, before, window = known.copy(), 1, 3
    while window * post_m <= _WINDOW_M:
        opened = grey_opening(last, size=(window, window))
        limit = min(_FIRST_M + _SLOPE * (window - before) * post_m, _MOST_M)
        ground &= last - opened < limit
        last, before, window = opened, window, 2 * window + 1
    bare, _ = filled(np.where(ground, height, np.nan))
    # Gaps at the edge have ground on one side only.
    whole = fill(bare, nearest_valid(np.isfinite(bare)))
    whole = np.where(known, np.minimum(whole, height), np.nan)
    return np.where(_terraces(height, whole, post_m, green), height, whole)


def _terraces(
    height: NDArray[np.float64], ground: NDArray[np.float64], post_m: float, green: NDArray[np.bool_] | None
) -> NDArray[np.bool_]:
    """Posts of smooth parts above a filtered ground with walls on less than `_FREE_SHARE` of their border."""
    from scipy.ndimage import binary_dilation, binary_erosion, find_objects, label, minimum_filter

    parts, _ = label(_high_and_smooth(height, ground, post_m, green))
    reach = 2 * max(1, round(_BESIDE_M / post_m)) + 1
    found = np.zeros(height.shape, bool)
    for number, (rows, columns) in enumerate(find_objects(parts), 1):
        window = tuple(slice(max(each.start - reach, 0), each.stop + reach) for each in (rows, columns))
        part, level = parts[window] == number, height[window]
        outside = np.where(~part & np.isfinite(level), level, np.inf)
        edge = part & ~binary_erosion(part, border_value=True)
        drop = (level - minimum_filter(outside, reach, mode="nearest"))[edge]
        drop = drop[np.isfinite(drop)]
        if drop.size and (drop > LEAST_M).mean() < _FREE_SHARE:
            # Posts beside a drop are not smooth, so the part ends before them.
            found[window] |= binary_dilation(part, np.ones((3, 3)), iterations=2) & (parts[window] == 0) | part
    return found


def check_levels(
    ground: NDArray[np.float64], height: NDArray[np.float64], post_m: float, declared: bool = False
) -> None:
    """Refuse a terrain model and a surface model, (h, w) [m] each, whose heights count from different levels. If both
    files have `declared` the same level, only a surface below the ground is refused.

    The lowest posts show the difference: the surface model is smooth above open ground, and rough above crowns. A
    smooth closed crop looks like open ground, and an offset above a wood without a gap is not detected.
    """
    from scipy.ndimage import uniform_filter

    step = height - ground
    known = np.isfinite(step)
    if not known.any():
        raise ThermorenderError("the ground's heights do not overlap the surface model; give those of the same area")
    lowest, low, middle = np.percentile(step[known], (1.0, 10.0, 50.0))
    below = low < -LEAST_M or middle < -0.5 * LEAST_M
    if not below and (declared or lowest <= LEAST_M):
        return
    window = max(3, 2 * int(0.5 * _ROUGH_OVER_M / post_m) + 1)
    # Only windows without missing posts. The lowest step is subtracted, so that squares keep their digits.
    off = np.where(known, step - lowest, 0.0)
    whole = uniform_filter(known.astype(np.float64), window, mode="constant") > 1.0 - 1e-6
    variance = uniform_filter(off**2, window) - uniform_filter(off, window) ** 2
    floor = variance[whole & (off >= 0.0) & (off < _FLOOR_M)]
    smooth = floor.size and np.sqrt(max(float(np.percentile(floor, 25.0)), 0.0)) < _ROUGH_M
    where = f"{middle:.1f} m above the ground's heights in the median and {lowest:.1f} m at its lowest posts"
    if below:
        raise ThermorenderError(
            f"the surface model is {where}, so both count from different levels; convert one of them, or leave "
            "ground out"
        )
    if smooth:
        raise ThermorenderError(
            f"the surface model is {where}, and smooth there: both count from different levels, or a closed crop "
            "covers everything; convert one of them, declare the vertical CRS of both, or, above a crop, leave "
            "ground out, so that its surface is the ground"
        )


def ground_given(
    ground: NDArray[np.float64], height: NDArray[np.float64], post_m: float, green: NDArray[np.bool_] | None = None
) -> NDArray[np.float64]:
    """Return the ground's heights by a terrain model: its holes are interpolated, and a filter estimates the rest."""
    whole, _ = filled(ground)
    whole = np.where(np.isfinite(whole), whole, ground_below(height, post_m, green))
    return np.where(np.isfinite(height), np.minimum(whole, height), whole)


def area_of(ring: Ring) -> float:
    """Return the sum of the absolute areas of the triangles from the first corner [squares of a post]."""
    a, b = ring[1:-1] - ring[0], ring[2:] - ring[0]
    return float(0.5 * np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum())


def outlines_by_height(
    height: NDArray[np.float64], ground: NDArray[np.float64], post_m: float, green: NDArray[np.bool_] | None = None,
    stated: NDArray[np.bool_] | None = None,
) -> list[Outline]:  # fmt: skip
    """Return the Outlines of buildings: high and smooth parts of the surface model that are not `green`, (h, w).

    Parts that meet a `stated` building, (h, w), are left out.
    """
    found = _high_and_smooth(height, ground, post_m, green)
    if stated is not None:
        from scipy.ndimage import label

        parts, _ = label(found, np.ones((3, 3)))
        found &= ~np.isin(parts, np.unique(parts[stated & found]))
    return outlines_of(found)


def is_green(rgb: NDArray[np.uint8], valid: NDArray[np.bool_], texels: Grid, grid: Grid) -> NDArray[np.bool_]:
    """Return which posts of a grid are green in an orthophoto (h, w, 3), by their mean colour."""
    colour = np.where(valid[..., None], rgb, np.nan).astype(np.float32)
    red, green, blue = np.moveaxis(onto(colour, texels, grid, "average"), -1, 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        total = red + green + blue
        found: NDArray[np.bool_] = ((2.0 * green - red - blue) / total > _GREEN) & ((green - blue) / total > _NOT_CYAN)
    return found


def _high_and_smooth(
    height: NDArray[np.float64], ground: NDArray[np.float64], post_m: float, green: NDArray[np.bool_] | None
) -> NDArray[np.bool_]:
    """Posts of parts as high, smooth and large as buildings."""
    from scipy.ndimage import binary_closing, binary_dilation, binary_opening, uniform_filter

    # Missing posts inside a roof belong to it.
    valid = np.isfinite(height) & np.isfinite(ground)
    near = binary_dilation(valid, iterations=max(1, round(_GAP_M / post_m)))
    level, bare = (fill(each, nearest_valid(valid)) for each in (height, ground))
    high = near & (level - bare > LEAST_M)
    bend = [np.abs(np.gradient(np.gradient(level, axis=axis), axis=axis)) for axis in (0, 1)]
    smooth = high & (uniform_filter(0.5 * (bend[0] + bend[1]), 3) < _SMOOTH_M * min(post_m, 1.0))
    if green is not None:
        smooth &= ~green
    seed = binary_opening(smooth, np.ones((3, 3)))
    # Ridges, gutters and edges of a roof are not smooth. They lie between smooth parts or beside one.
    steps = max(1, round(1.5 / post_m))
    mask = binary_dilation(binary_closing(seed, np.ones((3, 3)), iterations=steps), np.ones((3, 3)), iterations=steps)
    mask &= high
    if green is not None:
        mask &= ~binary_opening(green, np.ones((3, 3)))
    return large(mask, post_m)


def large(mask: NDArray[np.bool_], post_m: float) -> NDArray[np.bool_]:
    """Return the parts of a mask that have the area of a building, without lines one or two posts wide."""
    from scipy.ndimage import binary_opening, label

    mask = binary_opening(mask, np.ones((3, 3)))
    parts, count = label(mask)
    size = np.bincount(parts.ravel(), minlength=count + 1) * post_m**2
    kept: NDArray[np.bool_] = (size >= LEAST_AREA_M2)[parts] & mask
    return kept


def outlines_of(mask: NDArray[np.bool_]) -> list[Outline]:
    """Return the Outlines around connected posts of a mask; sides are straight, within a post of the mask's border."""
    import cv2
    from rasterio.features import shapes

    found = []
    for shape, _ in shapes(mask.astype(np.uint8), mask=mask):
        rings = []
        for ring in shape["coordinates"]:
            line = cv2.approxPolyDP(np.array(ring[:-1], np.float32)[:, None], 1.0, closed=True)[:, 0]
            if len(line) >= 3:
                rings.append(line.astype(np.float64))
        if rings:
            found.append(Outline(rings))
    return found


def inside(outlines: Sequence[Outline], grid: Grid) -> NDArray[np.bool_]:
    """Return which posts of a grid have their middle in one of some outlines, (h, w)."""
    everywhere = slice(0, grid.height), slice(0, grid.width)
    return (
        burnt([[np.append(ring, ring[:1], axis=0) for ring in each.rings] for each in outlines], everywhere)
        if outlines
        else np.zeros((grid.height, grid.width), bool)
    )


def trees_in(above: NDArray[np.float64], taken: NDArray[np.bool_], post_m: float) -> list[Tree]:
    """Return the Trees of heights above the ground, (h, w) [m], outside of `taken`: one for each local maximum."""
    from scipy.ndimage import find_objects, gaussian_filter

    canopy = _canopy((np.nan_to_num(above) > LEAST_M) & ~taken, taken, post_m)
    height = np.where(canopy, np.nan_to_num(above), 0.0)
    smooth = gaussian_filter(height, _BLUR_M / post_m)
    basin = _basins(smooth, canopy, max(1, round(0.5 * _APART_M / post_m)))
    found = []
    for number, part in enumerate(find_objects(basin), 1):
        if part is None:
            continue
        row, column = np.nonzero(basin[part] == number)
        posts = np.column_stack([row + part[0].start, column + part[1].start])
        heights = height[posts[:, 0], posts[:, 1]]
        top = posts[np.argmax(heights)]
        found.append(Tree(posts, (int(top[0]), int(top[1])), float(heights.max())))
    return found


def _canopy(high: NDArray[np.bool_], taken: NDArray[np.bool_], post_m: float) -> NDArray[np.bool_]:
    """The posts of crowns: all that are three posts wide or more, and narrower ones that stand alone."""
    from scipy.ndimage import binary_dilation, binary_opening, label

    wide: NDArray[np.bool_] = binary_opening(high, np.ones((3, 3)))
    # High posts of a building just outside of its outline form strips that are narrower than a crown.
    parts, count = label(high, np.ones((3, 3)))
    narrow = np.bincount(parts.ravel(), minlength=count + 1) * post_m**2 >= _LEAST_CROWN_M2
    narrow[np.unique(parts[wide | binary_dilation(taken, np.ones((3, 3)))])] = False
    return wide | (narrow[parts] & high)


def _basins(height: NDArray[np.float64], canopy: NDArray[np.bool_], reach: int) -> NDArray[np.int64]:
    """Number of the tree to which each post of a canopy belongs, 1…; 0 elsewhere.

    Each post points to the highest of its neighbours, and each local maximum to the highest post within `reach` in the
    same connected canopy. Posts that lead to the same top are one tree.
    """
    from scipy.ndimage import label

    parts = np.pad(label(canopy, np.ones((3, 3)))[0], 1)
    level, number = np.pad(height, 1), np.arange(parts.size).reshape(parts.shape)
    inner = slice(1, -1)
    up, best = number[inner, inner].copy(), level[inner, inner].copy()
    for down, right in ((-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1)):
        beside = slice(1 + down, level.shape[0] - 1 + down), slice(1 + right, level.shape[1] - 1 + right)
        # Of two equal heights the one with the higher number counts as higher, so that no path is a loop.
        higher = (level[beside] > best) | ((level[beside] == best) & (number[beside] > up))
        higher &= parts[beside] == parts[inner, inner]
        up, best = np.where(higher, number[beside], up), np.where(higher, level[beside], best)
    way = number.copy()
    way[inner, inner] = up
    for row, column in np.argwhere((way == number) & (parts > 0)):
        window = tuple(slice(max(k - reach, 0), k + reach + 1) for k in (row, column))
        own = np.where(parts[window] == parts[row, column], level[window], -np.inf)
        higher = own > level[row, column]
        way[row, column] = number[window].flat[own.argmax()] if higher.any() else number[row, column]
    top = way.reshape(-1)
    while (top[top] != top).any():
        top = top[top]
    basin = np.where(canopy, top.reshape(parts.shape)[inner, inner], -1)
    found: NDArray[np.int64] = np.unique(np.append(basin.ravel(), -1), return_inverse=True)[1][:-1]
    return found.reshape(canopy.shape)


def even_odd(point: NDArray[np.float64], rings: Sequence[Ring]) -> NDArray[Any]:
    """Return whether points (n, 2) are inside rings by the even-odd rule."""
    found = np.zeros(len(point), bool)
    x, y = point.T
    for ring in rings:
        for (x0, y0), (x1, y1) in zip(ring, np.roll(ring, -1, axis=0), strict=True):
            crosses = (y0 > y) != (y1 > y)
            with np.errstate(divide="ignore", invalid="ignore"):
                found ^= crosses & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
    return found
