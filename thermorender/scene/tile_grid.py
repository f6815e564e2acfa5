"""Square tiles of ground in levels: which of them a camera in a cell needs, by the footprint of its pixels.

A tile of level 0 has the finest texels, and each level above has texels twice as wide; the four tiles below one cover
its ground. Which tiles are chosen depends on the cell that the camera is in and on nothing before it.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from thermorender.scene.raster import Bounds, Grid

_Three = tuple[float, float, float]
# Texels and cells along a side of a tile, and texels around it that filters of pictures reach.
TEXELS, APRON = 512, 16
# Side of a texel over that of a pixel that shows it, at most; and of tiles that the camera does not look at.
FOOTPRINT, ASIDE = 0.25, 16.0
# On level ground seen at a slant a pixel is longer than wide: the geometric mean counts, up to so much of its width.
_LONGER = 2.0**0.5
# A cell is at most so wide and high for its height above ground.
_CELL = 0.25
# Directions of view along a side of each face of a cube, and turns of a picture about its axis [rad].
_FACING, _TURN = 32, np.radians(7.5)
# How far a tilt of the axis may turn the picture about it, over the tilt; widest half angle of a pyramid [rad].
_TWIST, _WIDEST = 1.0, np.radians(80.0)
# Angle of a map's axes to those of a local frame, at most [rad].
_MAP = 0.03
# Cosine of an axis to east from which a picture's turn is counted from north.
_ALONG = 0.9


class Tile(NamedTuple):
    """A tile by its level, and its row and column from the upper left one."""

    level: int
    row: int
    column: int

    def below(self) -> "tuple[Tile, ...]":
        """Return the four tiles of the next finer level on its ground."""
        return tuple(Tile(self.level - 1, 2 * self.row + i, 2 * self.column + j) for i in (0, 1) for j in (0, 1))


class Cell(NamedTuple):
    """Where a camera is and looks: a box of places, and a pyramid that holds every picture taken there, on the map."""

    low: _Three  # Lowest east, north and height above the ellipsoid
    high: _Three
    axis: _Three  # Of the pyramid, towards east, north and up
    right: _Three  # Across the picture
    half: tuple[float, float]  # Tangents of its half angles, across and along the picture


@dataclass(frozen=True)
class TileGrid:
    """The tiles of a map."""

    crs: Any
    left: float  # Of the upper left tiles
    top: float
    texel: float  # Side of a texel of level 0 [map units, metres]
    cells: int  # Along a side of a tile's mesh
    levels: int
    texels: int = TEXELS  # Along a side

    def side(self, level: int) -> float:
        """Return the side of a tile [m]."""
        return self.texels * self.texel * 2.0**level

    def bounds(self, tile: Tile, rows: int = 1) -> tuple[float, float, float, float]:
        """Return (left, bottom, right, top) of a tile, or of a square of `rows`² of them from it on."""
        side = self.side(tile.level)
        left, top = self.left + tile.column * side, self.top - tile.row * side
        return left, top - rows * side, left + rows * side, top

    def posts(self, tile: Tile, rows: int = 1, around: int = 0) -> Grid:
        """Return the Grid whose pixels have the posts of a tile's mesh in their middle, those on its edges included;
        `around` more on each side."""
        step = self.side(tile.level) / self.cells
        left, _, _, top = self.bounds(tile)
        return self._grid(left - (around + 0.5) * step, top + (around + 0.5) * step, step,
                          rows * self.cells + 1 + 2 * around)  # fmt: skip

    def finer_posts(self, tile: Tile, rows: int, around: int, times: int) -> Grid:
        """Return the Grid of `posts` with `times` as many along a side."""
        step = self.side(tile.level) / self.cells
        left, _, _, top = self.bounds(tile)
        fine, count = step / times, times * (rows * self.cells + 2 * around) + 1
        return self._grid(left - around * step - 0.5 * fine, top + around * step + 0.5 * fine, fine, count)

    def texel_grid(self, tile: Tile, rows: int = 1, around: int = APRON) -> Grid:
        """Return the Grid of a tile's texels and of those `around` it."""
        step = self.texel * 2.0**tile.level
        left, _, _, top = self.bounds(tile)
        return self._grid(left - around * step, top + around * step, step, rows * self.texels + 2 * around)

    def _grid(self, left: float, top: float, step: float, count: int) -> Grid:
        from rasterio import Affine

        return Grid(self.crs, Affine(step, 0.0, left, 0.0, -step, top), count, count, "the tiled ground")

    def chosen(self, cell: Cell, slope: float, between: Callable[[Bounds], tuple[float, float]],
               within: Bounds) -> Iterator[Tile]:  # fmt: skip
        """Yield the tiles for a cell. A pixel is `slope` wide at a distance of one; `between` gives the lowest and the
        highest ground within bounds [m]; tiles beyond the bounds `within` are left out."""
        stack = [Tile(self.levels - 1, 0, 0)]
        while stack:
            tile = stack.pop()
            box = self.bounds(tile)
            if box[0] >= within[2] or box[2] <= within[0] or box[1] >= within[3] or box[3] <= within[1]:
                continue
            heights = between(box)
            low, high = np.array([box[0], box[1], heights[0]]), np.array([box[2], box[3], heights[1]])
            away = _distance(low, high, cell)
            sine = max((cell.high[2] - heights[0]) / max(away, 1e-9), 1e-9)
            most = FOOTPRINT * float(np.clip(sine**-0.5, 1.0, _LONGER)) if _looks_at(low, high, cell) else ASIDE
            if tile.level and self.texel * 2.0**tile.level > most * slope * away:
                stack += tile.below()
            else:
                yield tile


def cell_of(
    position: NDArray[np.floating], rotation: NDArray[np.floating], above_m: float, half: tuple[float, float]
) -> Cell:
    """Return the Cell of a camera at a position (east, north, height) on the map, a number of metres above the ground.
    `rotation` (3, 3) has its axes right, down and forward as columns, `half` the largest slopes of rays of its picture
    across and along."""
    step = 2.0 ** np.floor(np.log2(max(_CELL * above_m, 1.0)))
    first = np.floor(np.asarray(position) / step)
    axis = rotation[:, 2]
    face = int(np.abs(axis).argmax())
    square = np.clip(np.floor((axis / abs(axis[face]) + 1.0) * 0.5 * _FACING), 0, _FACING - 1)
    middle = (square + 0.5) * (2.0 / _FACING) - 1.0
    middle[face] = np.sign(axis[face])
    # The farthest corner of a square from its middle.
    corner = middle + np.where(np.arange(3) == face, 0.0, 1.0 / _FACING) * np.where(middle > 0.0, -1.0, 1.0)
    towards = middle / np.linalg.norm(middle)
    wide = float(np.arccos(np.clip(towards @ corner / np.linalg.norm(corner), -1.0, 1.0)))
    # The picture turns about the axis in steps, from east, or from north where the axis is along east.
    level = np.eye(3)[1 if abs(towards[0]) > _ALONG else 0]
    level = level - (level @ towards) * towards
    level /= np.linalg.norm(level)
    other = np.cross(towards, level)
    turn = (np.floor(np.arctan2(rotation[:, 0] @ other, rotation[:, 0] @ level) / _TURN) + 0.5) * _TURN
    right = np.cos(turn) * level + np.sin(turn) * other
    # The picture's corners move outwards as it turns and tilts.
    x, y = half
    wide += _MAP
    sine, cosine = np.sin(0.5 * _TURN + _TWIST * wide), np.cos(0.5 * _TURN + _TWIST * wide)
    tangent = [float(np.tan(min(np.arctan(each) + wide, _WIDEST))) for each in (x * cosine + y * sine,
                                                                              y * cosine + x * sine)]  # fmt: skip
    low, high = first * step, (first + 1.0) * step
    return Cell(_three(low), _three(high), _three(towards), _three(right), (tangent[0], tangent[1]))


def _three(values: NDArray[np.floating]) -> _Three:
    return cast("_Three", tuple(values.tolist()))


def _distance(low: NDArray[np.floating], high: NDArray[np.floating], cell: Cell) -> float:
    """Least distance of a point of a cell from a box [m]."""
    gap = np.maximum(np.maximum(low - cell.high, np.array(cell.low) - high), 0.0)
    return float(np.linalg.norm(gap))


def _looks_at(low: NDArray[np.floating], high: NDArray[np.floating], cell: Cell) -> bool:
    """Whether a picture from a cell may show a part of a box."""
    # Differences of any two points of box and cell, by the corners of their box.
    ends = np.stack([low - np.array(cell.high), high - np.array(cell.low)])
    corner = np.stack(np.meshgrid(*ends.T, indexing="ij"), axis=-1).reshape(-1, 3)
    axis, right = np.array(cell.axis), np.array(cell.right)
    down = np.cross(axis, right)
    depth = corner @ axis
    for along, tangent in ((corner @ right, cell.half[0]), (corner @ down, cell.half[1])):
        if (along > tangent * depth).all() or (along < -tangent * depth).all():
            return False
    return True
