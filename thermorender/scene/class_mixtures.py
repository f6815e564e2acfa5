"""The mixtures of classes that coarse texels of a tiled ground have: the same few for all of its tiles."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.scene.drape import LEAST_SHARE, in_parts, refuse_unnamed, representative
from thermorender.scene.raster import Grid
from thermorender.scene.sources import Source

# Class numbers read along a side of a coarse texel.
_ALONG = 4
# Pixels of classes for each texel from which its shares count.
_FINER = 1.5
# Texels along a side of a sample.
_SAMPLE = 256


@dataclass(frozen=True, eq=False)
class ClassMixtures:
    """Mixtures of classes; texels have the number of one, from 1 on."""

    classes: tuple[int, ...]
    parts: NDArray[np.int8]  # (n, c) eighths of each class, those of a single class first

    @property
    def mixed(self) -> tuple[Mapping[int, float], ...]:
        """{class: share} of each."""
        share = self.parts / self.parts.sum(axis=1, keepdims=True)
        return tuple(
            {one: float(part) for one, part in zip(self.classes, row, strict=True) if part >= LEAST_SHARE}
            for row in share
        )

    def on(self, source: Source, grid: Grid) -> NDArray[np.uint8]:
        """Return the numbers of the mixtures nearest to the shares of classes on a grid, (h, w); 0 for no class."""
        counts, of = _counted(source, grid, self.classes)
        away = np.square(self.parts[None].astype(np.int16) - counts[:, None]).sum(axis=-1)
        number = np.where(counts.any(axis=1), 1 + away.argmin(axis=1), 0).astype(np.uint8)
        found: NDArray[np.uint8] = number[of].reshape(grid.height, grid.width)
        return found


def class_mixtures_of(source: Source, names: Mapping[int, str], grids: Sequence[Grid], where: str) -> ClassMixtures:
    """Return the ClassMixtures of a source by its classes on some grids; `names` has the material of each class."""
    classes = tuple(sorted(names))
    pure = 8 * np.eye(len(classes), dtype=np.int8)
    parts, weight = [pure], [np.zeros(len(classes))]
    for grid in grids:
        found, of = _counted(source, grid, classes, where)
        known = found.any(axis=1)
        parts.append(found[known])
        weight.append(np.bincount(of, minlength=len(found))[known] / of.size)
    every, of = np.unique(np.concatenate(parts), axis=0, return_inverse=True)
    count = np.bincount(of.ravel(), np.concatenate(weight))
    mixed = (every != 8).all(axis=1)
    chosen = representative(every[mixed], count[mixed])
    return ClassMixtures(classes, np.concatenate([pure, every[mixed][chosen]]))


def _counted(
    source: Source, grid: Grid, classes: tuple[int, ...], where: str = "the scene"
) -> tuple[NDArray[np.int8], NDArray[np.intp]]:
    """(Different eighths of classes (n, c), which of them each texel of a grid has, (h w,))."""
    fine = abs(grid.transform.a) < _FINER * source.extent.pixel
    along = 1 if fine else _ALONG
    numbers = source.read(_finer(grid, along))
    place = np.full(256, len(classes), np.int64)
    place[list(classes)] = np.arange(len(classes))
    if (numbers != 0).any():
        refuse_unnamed(numbers, Path("terrain.tiles.classes"), dict.fromkeys(classes, ""), where)
    # Sums of random numbers tell different counts apart.
    key = np.random.Generator(np.random.Philox(7)).integers(1, 1 << 58, len(classes) + 1)
    key[-1] = 0
    every = key[place[numbers]].reshape(grid.height, along, grid.width, along).sum(axis=(1, 3)).ravel()
    _, first, of = np.unique(every, return_index=True, return_inverse=True)
    row, column = np.divmod(first, grid.width)
    steps = np.arange(along)
    own = numbers[(along * row)[:, None, None] + steps[:, None], (along * column)[:, None, None] + steps]
    counts = np.stack([(own == one).sum(axis=(1, 2)) for one in classes], axis=-1)
    total = counts.sum(axis=1, keepdims=True)
    parts = in_parts(counts / np.maximum(total, 1))
    # Where less than half is known, nothing is.
    parts[2 * total[:, 0] < along * along] = 0
    return parts, of


def _finer(grid: Grid, along: int) -> Grid:
    from rasterio import Affine

    t = grid.transform @ Affine.scale(1.0 / along)
    return Grid(grid.crs, t, along * grid.height, along * grid.width, grid.name)


def sample(grid: Any) -> Grid:
    """Return a part in the middle of a grid."""
    from rasterio import Affine

    rows, columns = (min(_SAMPLE, each) for each in (grid.height, grid.width))
    corner = grid.transform @ Affine.translation((grid.width - columns) // 2, (grid.height - rows) // 2)
    return Grid(grid.crs, corner, rows, columns, grid.name)
