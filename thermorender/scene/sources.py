"""Rasters of any size, in one file or in many: read in windows onto a map's pixel grid, and nothing else of them."""

import hashlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError
from thermorender.scene.georeference import datum_heights
from thermorender.scene.orthophoto import read_colour, resampled
from thermorender.scene.raster import (
    FORMATS,
    Bounds,
    Grid,
    RasterWindow,
    bounds_in,
    files_of,
    grid_of,
    onto,
    read_classes,
    step_m,
)
from thermorender.scene.terrain import heights_in

# Pixels around a window that interpolation may need.
_MARGIN = 2
# Files share a grid if their corners differ by whole pixels, within this share of one.
_ALIGNED = 1e-3


class Extent(NamedTuple):
    """Where a source has pixels: a map, the bounds there, the side of its finest pixels and a corner of one."""

    crs: Any
    bounds: Bounds
    pixel: float  # [map units]
    corner: tuple[float, float]


class Source(Protocol):
    """Values of one kind on a map."""

    @property
    def extent(self) -> Extent:
        """Where it has pixels."""

    def read(self, grid: Grid) -> Any:
        """Return the values on a grid: heights (h, w) [m], NaN where missing; (rgb (h, w, 3), valid (h, w)); or class
        numbers (h, w), 0 where missing."""

    def digest(self) -> str:
        """Return a fingerprint (hex) of the values."""


class _SourceFile(NamedTuple):
    """A file of a layer: its first row and column there, and its size; the bytes of it and of the files that GDAL
    reads with it, and when they were written."""

    path: Path
    row: int
    column: int
    height: int
    width: int
    state: tuple[tuple[str, int, int], ...]

    def refuse_changed(self) -> None:
        """Raise if the file is another one than when it was opened first."""
        if _state([self.path.parent / name for name, *_ in self.state]) != self.state:
            raise ThermorenderError(
                f"{self.path} was changed or removed while the scene is in use; load the scene again"
            )


class _Part(NamedTuple):
    """What is read of a file for a window of its layer: where it lies in the window, and pixels for each of its own, of
    those that a place has."""

    path: Path
    window: RasterWindow
    place: tuple[slice, slice]
    weight: int
    most: int

    def left(self, weight: NDArray[np.floating], known: NDArray[np.bool_]) -> NDArray[np.floating]:
        """Return the weight of known values beside that of other parts, which lie on this one, in the window."""
        return np.minimum(self.weight * known, self.most - weight[self.place]).astype(weight.dtype)


@dataclass(frozen=True, eq=False)
class _Layer:
    """Files whose pixels are on one grid, as those of one survey are."""

    grid: Grid  # Around all of them
    pixel: float  # Side of a pixel on the source's map
    files: tuple[_SourceFile, ...]

    def window(self, grid: Grid, pixel: float) -> tuple[Grid, list[_Part]]:
        """Return (the grid of a window around another grid, of squares of a power of two pixels, counted from the
        layer's corner, whose side is at most `pixel`; its parts)."""
        from rasterio import Affine

        square = 1 << max(0, int(np.floor(np.log2(pixel / self.pixel + 1e-6))))
        bounds = np.array(bounds_in(self.grid.crs, grid))
        column, row = self.grid.to_pixel(bounds[[0, 2, 0, 2]], bounds[[1, 1, 3, 3]])
        ends = []
        for each, size in ((row, self.grid.height), (column, self.grid.width)):
            first = max(0, int(np.floor(each.min() / square)) - _MARGIN)
            ends.append((first, max(first, min(-(-size // square), int(np.ceil(each.max() / square)) + _MARGIN))))
        (top, bottom), (left, right) = ends
        corner = self.grid.transform @ Affine.translation(left * square, top * square) @ Affine.scale(square)
        whole = Grid(self.grid.crs, corner, bottom - top, right - left, self.grid.name)
        parts = []
        for file in self.files if whole.height * whole.width else ():
            several = [(rows, columns) for rows in _runs(file.row, file.height, square, top, bottom)
                       for columns in _runs(file.column, file.width, square, left, right)]  # fmt: skip
            if several:
                file.refuse_changed()
            for rows, columns in several:
                parts.append(self._part(file, rows, columns, (top, left), square))
        return whole, parts

    def _part(
        self, file: _SourceFile, rows: tuple[int, int], columns: tuple[int, int], first: tuple[int, int], square: int
    ) -> _Part:
        """The _Part of a file between two rows and columns of the layer, in a window from the `first` square on."""
        sides = [(ends[0] // square, -(-ends[1] // square)) for ends in (rows, columns)]
        place = tuple(slice(a - start, b - start) for (a, b), start in zip(sides, first, strict=True))
        counts = [b - a for a, b in sides]
        within = tuple((a - own, b - own) for (a, b), own in zip((rows, columns), (file.row, file.column), strict=True))
        grid = Grid(self.grid.crs, self.grid.transform, counts[0], counts[1], str(file.path))
        pixels = (rows[1] - rows[0]) * (columns[1] - columns[0])
        whole = within == ((0, file.height), (0, file.width))
        read = RasterWindow((within[0], within[1]), grid, whole, square > 1)
        return _Part(file.path, read, (place[0], place[1]), pixels // (counts[0] * counts[1]), square * square)


class _Files:
    """The files of a source, which may lie beside or on one another; the finest one counts where it has a value, and
    of equally fine ones the last by name.

    Their map is `crs`, by default that of the first file in metres.
    """

    def __init__(self, paths: Sequence[Path], crs: Any = None) -> None:
        grids = [grid_of(path, any_size=True) for path in paths]
        self.crs = crs or next((each.crs for each in grids if each.crs.is_projected), grids[0].crs)
        # From the coarsest to the finest, in the order of their names among equals.
        self.layers = sorted(_layers(paths, grids, self.crs), key=lambda each: -each.pixel)

    @cached_property
    def extent(self) -> Extent:
        """The Extent of all files."""
        sides = np.array([bounds_in(self.crs, each.grid) for each in self.layers])
        left, bottom = sides[:, :2].min(axis=0).tolist()
        right, top = sides[:, 2:].max(axis=0).tolist()
        return Extent(self.crs, (left, bottom, right, top), self.layers[-1].pixel, (sides[-1, 0], sides[-1, 3]))

    def digest(self) -> str:
        """Return a fingerprint (hex) of the files by their names, sizes and times of change."""
        found = hashlib.blake2b(digest_size=16)
        for layer in self.layers:
            for each in layer.files:
                found.update(f"{each.path.name} {each.state}\n".encode())
        return found.hexdigest()

    def windows(self, grid: Grid) -> Iterator[tuple[Grid, list[_Part]]]:
        """Yield (grid of a window, its parts) of the layers that meet a grid, from the coarsest to the finest."""
        pixel = step_m(self.crs, grid)
        for layer in self.layers:
            window, parts = layer.window(grid, pixel)
            if parts:
                yield window, parts


class Heights(_Files):
    """Heights above the ellipsoid of WGS 84.

    `added_m` is added to those of the files; None: they are above the ellipsoid of their own datum.
    """

    def __init__(self, paths: Sequence[Path], added_m: float | None = None, crs: Any = None) -> None:
        super().__init__(paths, crs)
        self.added_m = added_m

    def read(self, grid: Grid) -> NDArray[np.float64]:
        """Return heights (h, w) [m], NaN where no file has one."""
        found = np.full((grid.height, grid.width), np.nan)
        for window, parts in self.windows(grid):
            total, weight = np.zeros((2, window.height, window.width))
            for part in reversed(parts):
                own = heights_in(part.path, part.window)
                own_weight = part.left(weight, np.isfinite(own))
                total[part.place] += own_weight * np.nan_to_num(own)
                weight[part.place] += own_weight
            merged = np.where(weight > 0.0, total / np.maximum(weight, 1.0), np.nan)
            merged += datum_heights(window) if self.added_m is None else self.added_m
            own = onto(merged, window, grid, "bilinear")
            np.copyto(found, own, where=np.isfinite(own))
        return found

    def digest(self) -> str:
        """Return a fingerprint (hex) of the files and of what is added to them."""
        return f"{super().digest()}{self.added_m!r}"


class Colours(_Files):
    """An orthophoto."""

    def read(self, grid: Grid) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """Return (rgb (h, w, 3), where it is known (h, w))."""
        found, known = np.zeros((grid.height, grid.width, 3), np.uint8), np.zeros((grid.height, grid.width), bool)
        for window, parts in self.windows(grid):
            total = np.zeros((window.height, window.width, 3), np.float32)
            weight = np.zeros((window.height, window.width, 1), np.float32)
            for part in reversed(parts):
                rgb, shown = read_colour(part.path, part=part.window)
                own_weight = part.left(weight, shown[..., None])
                total[part.place] += own_weight * rgb
                weight[part.place] += own_weight
            rgb = np.rint(total / np.maximum(weight, 1.0)).astype(np.uint8)
            own, valid = resampled(rgb, weight[..., 0] > 0.0, window, grid, "bilinear")
            found[valid], known = own[valid], known | valid
        return found, known


class Classes(_Files):
    """Class numbers: the nearest pixel's."""

    def read(self, grid: Grid) -> NDArray[np.uint8]:
        """Return class numbers (h, w), 0 where no file has one."""
        found = np.zeros((grid.height, grid.width), np.uint8)
        for window, parts in self.windows(grid):
            merged = np.zeros((window.height, window.width), np.uint8)
            for part in parts:
                numbers = read_classes(part.path, replace(part.window, thinned=False)).astype(np.uint8)
                np.copyto(merged[part.place], numbers, where=numbers != 0)
            own = onto(merged, window, grid, "nearest")
            np.copyto(found, own, where=own != 0)
        return found


def rasters_of(path: Path) -> list[Path]:
    """Return the raster files of a folder, by name, or a single file."""
    if not path.is_dir():
        return [path]
    found = sorted(each for each in path.iterdir() if each.suffix.lower() in FORMATS and each.is_file())
    if not found:
        raise ThermorenderError(f"{path} holds no raster; give a folder with files such as GeoTIFFs")
    return found


def _layers(paths: Sequence[Path], grids: Sequence[Grid], crs: Any) -> Iterator[_Layer]:
    """Yield the layers of files by their grids."""
    from rasterio import Affine

    groups = list[list[tuple[Path, Grid, float, float]]]()
    for path, grid in zip(paths, grids, strict=True):
        for group in groups:
            first = group[0][1]
            if grid.crs == first.crs and np.allclose(
                grid.transform[:2] + grid.transform[3:5],
                first.transform[:2] + first.transform[3:5],
                rtol=1e-9,
                atol=0.0,
            ):
                column, row = first.to_pixel(*grid.to_map(0.0, 0.0))
                if max(abs(column - np.rint(column)), abs(row - np.rint(row))) < _ALIGNED:
                    group.append((path, grid, np.rint(column), np.rint(row)))
                    break
        else:
            groups.append([(path, grid, 0.0, 0.0)])
    for group in groups:
        left, top = int(min(each[2] for each in group)), int(min(each[3] for each in group))
        files = tuple(
            _SourceFile(path, int(row) - top, int(column) - left, grid.height, grid.width,
                        _state(map(Path, files_of(path, any_size=True))))
            for path, grid, column, row in group
        )  # fmt: skip
        first = group[0][1]
        around = Grid(
            first.crs, first.transform @ Affine.translation(left, top), max(each.row + each.height for each in files),
            max(each.column + each.width for each in files), first.name,
        )  # fmt: skip
        yield _Layer(around, step_m(crs, around), files)


def _state(paths: Iterable[Path]) -> tuple[tuple[str, int, int], ...]:
    """Names of files in a folder, their sizes and when they were written; zeros for one that is gone."""
    found = []
    for path in paths:
        try:
            status = path.stat()
            found.append((path.name, status.st_size, status.st_mtime_ns))
        except OSError:
            found.append((path.name, 0, 0))
    return tuple(found)


def _runs(first: int, size: int, square: int, start: int, stop: int) -> list[tuple[int, int]]:
    """Rows of a file within squares `start` … `stop` − 1, split where a square is not full, (first, last) each."""
    low, high = max(first, start * square), min(first + size, stop * square)
    inner = -(-low // square) * square, high // square * square
    cuts = sorted({low, *(each for each in inner if low < each < high), high})
    return list(zip(cuts[:-1], cuts[1:], strict=True)) if low < high else []
