"""A raster ground: what maps say of the texels of its surface."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError
from thermorender.scene.raster import Grid, bounds_in, describe, grid_of, onto, read_classes
from thermorender.scene.surface import MOST_OPEN

# Mixtures of classes of a coarse ground at most; shares of classes are rounded to such parts.
_MOST_MIXED, _PARTS = 48, 8
# Smaller shares of a class in a mixture are left out.
LEAST_SHARE = 1.0 / 32.0
# Texels along a side from which a coarse ground has shares of classes in place of the classes of a finer raster.
_MOST_SIDE = 1024
# Pixels of classes for each texel from which its shares count.
_FINER = 1.5
# Share that stands for 1 in bytes.
_WHOLE = 200


@dataclass(frozen=True, eq=False)
class Drape:
    """What maps say of the texels of one surface, (h, w) each."""

    grid: Grid
    colour: NDArray[np.uint8] | None = None  # (h, w, 3) the orthophoto with its holes; None without one
    valid: NDArray[np.bool_] | None = None  # where the orthophoto has colour
    classes: NDArray[np.uint8] | None = None  # class numbers, 0 for no data; None without a class raster
    # {class number: share} of each number in `classes` from 1 on; empty where the numbers are classes themselves
    mixed: tuple[Mapping[int, float], ...] = ()
    classes_file: Path | None = None
    filled: NDArray[np.bool_] | None = None  # where heights were filled; None where none were
    on_ground: NDArray[np.bool_] | None = None  # texels on the terrain; None if all of them are
    # ((h, w) float64, Grid) the elevation raster beside an orthophoto
    height: tuple[NDArray[np.float64], Grid] | None = None
    most_open: float = MOST_OPEN  # share of it without a class that may have the class beside


def on_ground(height: NDArray[np.float64], grid: Grid, texels: Grid) -> NDArray[np.bool_] | None:
    """Return which texels are on posts with a height, (h, w); None if all of them are."""
    known = np.isfinite(height)
    if known.all() and grid.same_as(texels):
        return None
    found: NDArray[np.bool_] = onto(known.astype(np.float32), grid, texels, "nearest") == 1.0
    return None if found.all() else found


def require_overlap(one: Grid, other: Grid) -> None:
    """Refuse rasters of different areas."""
    a, b = bounds_in(other.crs, one), other.bounds
    if min(a[2], b[2]) <= max(a[0], b[0]) or min(a[3], b[3]) <= max(a[1], b[1]):
        raise ThermorenderError(
            f"{one.name} covers {describe(a)} and {other.name} covers {describe(b)}: they do not overlap; "
            "give rasters of the same area"
        )


def classes_on(path: Path, names: Mapping[int, str], texels: Grid, where: str) -> NDArray[np.uint8]:
    """Return the class numbers of a raster on a texel grid, (h, w) uint8, 0 for no data; `names` has all of them."""
    grid = grid_of(path)
    require_overlap(grid, texels)
    classes: NDArray[np.uint8] = onto(read_classes(path), grid, texels, "nearest")
    refuse_unnamed(classes, path, names, where)
    return classes


def refuse_unnamed(classes: NDArray[np.integer], path: Path, names: Mapping[int, str], where: str) -> None:
    """Refuse class numbers without a material, and none but 0."""
    for value in np.unique(classes[classes != 0]):
        if value not in names:
            raise ThermorenderError(
                f"{path} holds class {value}, which emissivity.classes of {where} does not name; "
                "add it there (0 marks no data)"
            )
    if not classes.any():
        raise ThermorenderError(f"{path} has no class in it, only 0 (no data); give a raster of class numbers")


def coarser(grid: Grid) -> Grid:
    """Return a Grid of the same area whose pixels are whole squares of those of `grid`, 1024 along a side at most."""
    from rasterio import Affine

    step = -(-max(grid.height, grid.width) // _MOST_SIDE)
    if step == 1:
        return grid
    t = grid.transform @ Affine.scale(step)
    return Grid(grid.crs, t, -(-grid.height // step), -(-grid.width // step), grid.name)


def mixed_classes_on(
    path: Path, names: Mapping[int, str], texels: Grid, where: str
) -> tuple[NDArray[np.uint8], tuple[Mapping[int, float], ...]]:
    """Return (numbers (h, w) uint8, shares of classes of each number from 1 on) of a raster on a texel grid.

    A texel of several pixels has the area shares of their classes, rounded to eighths; 0 is no data. Shares are () and
    the numbers are classes where the raster is not finer than the texels.
    """
    grid = grid_of(path)
    require_overlap(grid, texels)
    left, bottom, right, top = bounds_in(texels.crs, grid)
    pixel = (right - left) * (top - bottom) / (grid.height * grid.width)
    if abs(texels.transform.determinant) < _FINER**2 * pixel:
        return classes_on(path, names, texels, where), ()
    fine = read_classes(path)
    refuse_unnamed(fine, path, names, where)
    present = np.unique(fine[fine != 0])
    share = np.stack(
        [onto(np.where(fine == one, _WHOLE, 0).astype(np.uint8), grid, texels, "average") for one in present], axis=-1
    ).astype(np.float32) / _WHOLE  # fmt: skip
    known = share.sum(axis=-1) > 0.5 / _PARTS
    share[known] /= share[known].sum(axis=-1, keepdims=True)
    parts, of = np.unique(in_parts(share[known]), axis=0, return_inverse=True)
    count = np.bincount(of.ravel())
    chosen = representative(parts, count)
    nearest = np.square(parts[:, None].astype(np.float32) - parts[chosen]).sum(axis=-1).argmin(axis=1)
    number = np.zeros(known.shape, np.uint8)
    number[known] = 1 + nearest[of.ravel()]
    # The mean shares of a mixture's texels keep the area of each class.
    mean = np.stack([np.bincount(nearest, count * part, len(chosen)) for part in parts.T], axis=-1).astype(np.float64)
    mean[mean < LEAST_SHARE * mean.sum(axis=1, keepdims=True)] = 0.0
    mean = mean / mean.sum(axis=1, keepdims=True)
    mixed = tuple({int(one): float(part) for one, part in zip(present, row, strict=True) if part} for row in mean)
    return number, mixed


def in_parts(share: NDArray[np.floating]) -> NDArray[np.int8]:
    """Shares (n, c) that sum to one as whole numbers of parts, whose sum is `_PARTS`: largest remainders."""
    exact = share * _PARTS
    whole = np.floor(exact + 1e-4).astype(np.int8)
    rank = np.argsort(np.argsort(whole - exact, axis=1, kind="stable"), axis=1)
    missing = _PARTS - whole.sum(axis=1, keepdims=True)
    return whole + (rank < missing).astype(np.int8)


def representative(parts: NDArray[np.integer], count: NDArray[np.integer]) -> NDArray[np.integer]:
    """Rows of (n, c) shares that stand for all: half the most frequent, half those farthest from all chosen before."""
    if len(parts) <= _MOST_MIXED:
        return np.arange(len(parts))
    chosen = list(np.argsort(-count, kind="stable")[: _MOST_MIXED // 2])
    away = np.square(parts[:, None].astype(np.float32) - parts[chosen]).sum(axis=-1).min(axis=1)
    while len(chosen) < _MOST_MIXED:
        chosen.append(int((away * np.sqrt(count)).argmax()))
        away = np.minimum(away, np.square(parts - parts[chosen[-1]].astype(np.float32)).sum(axis=-1))
    return np.sort(chosen)
