"""Georeferenced rasters: read with NaN for missing data, and resampled onto one pixel grid."""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError
from thermorender.formats import can_hold
from thermorender.scene.surface import MOST_TEXELS

# GDAL's driver by file name, and the only one tried. None of these refers to pixels in other files or on a network, as
# VRT and WMS do; GDAL alone would choose by content, not by name.
FORMATS = {
    ".tif": "GTiff", ".tiff": "GTiff", ".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG", ".jp2": "JP2OpenJPEG",
    ".asc": "AAIGrid",
}  # fmt: skip

# Values that a byte of a raster stands for at most. A constant in tiles of 8192² has 117 000 in LERC with ZSTD, 27 000
# in ZSTD and 1300 in LZW; tiles that a file leaves out may add to that.
_MOST, _MOST_PACKED, _PACKED = 1 << 14, 1 << 18, ("ZSTD", "LERC", "LZMA", "JXL", "JP2", "WEBP")


# (left, bottom, right, top) in map units.
Bounds = tuple[float, float, float, float]


@dataclass(frozen=True)
class Grid:
    """A pixel grid on a map: coordinate reference system, affine transform (pixel to map) and size."""

    crs: Any
    transform: Any
    height: int
    width: int
    name: str = field(default="the raster", compare=False)  # for messages

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """(left, bottom, right, top) in map units."""
        # Any of the four corners may be the outermost of a rotated grid.
        x, y = self.to_map(np.array([0, self.width, 0, self.width]), np.array([0, 0, self.height, self.height]))
        return float(x.min()), float(y.min()), float(x.max()), float(y.max())

    def to_map(self, column: Any, row: Any) -> tuple[Any, Any]:
        """Return map coordinates (x, y) of pixel coordinates, which are 0 at the grid's upper left corner."""
        t = self.transform
        return t.a * column + t.b * row + t.c, t.d * column + t.e * row + t.f

    def to_pixel(self, x: Any, y: Any) -> tuple[Any, Any]:
        """Return pixel coordinates (column, row) of map coordinates; the inverse of `to_map`."""
        t = ~self.transform
        return t.a * x + t.b * y + t.c, t.d * x + t.e * y + t.f

    def same_as(self, other: "Grid") -> bool:
        """Return whether both grids have the same pixels."""
        return bool(
            (self.height, self.width) == (other.height, other.width)
            and self.crs == other.crs
            and self.transform.almost_equals(other.transform, precision=1e-6)
        )


@dataclass(frozen=True)
class RasterWindow:
    """A window of a raster, read at its own or at fewer pixels."""

    window: tuple[tuple[int, int], tuple[int, int]]  # First and last row, and column, of the file
    grid: Grid  # Of the pixels that are read
    whole: bool  # Whether it is all of the file
    thinned: bool

    def options(self, bands: int | None = None) -> dict[str, Any]:
        """Return what `read` of an open raster takes for one band, or for several `bands`; a mean where it is thinned,
        for which the file's overviews serve."""
        from rasterio.enums import Resampling

        shape = (self.grid.height, self.grid.width)
        return {
            "window": self.window,
            "out_shape": shape if bands is None else (bands, *shape),
            "resampling": Resampling.average if self.thinned else Resampling.nearest,
        }


def window_of(
    path: Path, crs: Any, bounds: tuple[float, float, float, float], most: int, undeclared: Any = None
) -> RasterWindow:  # fmt: skip
    """Return the RasterWindow of a raster of any size within bounds on a map, with about `most` pixels or less."""
    from rasterio import Affine

    grid = grid_of(path, any_size=True, undeclared=undeclared)
    there = bounds_in(grid.crs, Grid(crs, Affine(bounds[2] - bounds[0], 0.0, bounds[0], 0.0, bounds[1] - bounds[3],
                                                 bounds[3]), 1, 1, grid.name))  # fmt: skip
    x, y = np.array([there[0], there[2], there[0], there[2]]), np.array([there[1], there[1], there[3], there[3]])
    column, row = grid.to_pixel(x, y)
    # A pixel more on each side, for interpolation.
    ends = [(int(np.clip(np.floor(each.min()) - 1, 0, size)), int(np.clip(np.ceil(each.max()) + 1, 0, size)))
            for each, size in ((row, grid.height), (column, grid.width))]  # fmt: skip
    sides = [last - first for first, last in ends]
    if min(sides) < 1:
        raise ThermorenderError(
            f"{path} covers {describe(grid.bounds)} and does not reach {describe(there)}; give a raster of that area"
        )
    step = max(1.0, float(np.sqrt(sides[0] * sides[1] / most)))
    height, width = (max(1, int(np.ceil(side / step))) for side in sides)
    corner = grid.transform @ Affine.translation(ends[1][0], ends[0][0])
    transform = corner @ Affine.scale(sides[1] / width, sides[0] / height)
    whole = tuple(sides) == (grid.height, grid.width)
    return RasterWindow((ends[0], ends[1]), Grid(grid.crs, transform, height, width, grid.name), whole, step > 1.0)


def describe(bounds: tuple[float, ...]) -> str:
    """Return bounds (left, bottom, right, top) in words."""
    return f"x {bounds[0]:.9g}…{bounds[2]:.9g}, y {bounds[1]:.9g}…{bounds[3]:.9g}"


@contextmanager
def opened(path: Path | str, any_size: bool = False) -> Iterator[Any]:
    """Open a raster for reading; a file that is unreadable or too large raises an error that names it. Parts of a file
    of `any_size` are read."""
    import warnings

    import rasterio
    from rasterio.errors import NotGeoreferencedWarning, RasterioError

    if not os.path.isfile(path):
        what = "is a folder or a special file" if Path(path).exists() else "does not exist"
        raise ThermorenderError(f"{path} {what}; give a raster file such as a GeoTIFF")
    driver = FORMATS.get(Path(path).suffix.lower())
    # Files beside a raster may name overviews on a network; this option stops GDAL from fetching them.
    options = {} if driver is None else {"CPL_VSIL_CURL_ALLOWED_FILENAME": "-"}
    try:
        with rasterio.Env(**options):
            with warnings.catch_warnings():
                # `grid_of` refuses such a file.
                warnings.simplefilter("ignore", NotGeoreferencedWarning)
                dataset = rasterio.open(path, driver=driver)
            with dataset:
                if not any_size and dataset.width * dataset.height > MOST_TEXELS:
                    raise ThermorenderError(
                        f"{path} has {dataset.width}×{dataset.height} pixels; a raster may have up to {MOST_TEXELS}, "
                        "so cut or thin it, for example with `rio warp`"
                    )
                if driver is not None and not any_size:
                    _check_size(path, dataset)
                if len(dataset.subdatasets) > 1 or (dataset.subdatasets and dataset.count):
                    raise ThermorenderError(
                        f"{path} holds {len(dataset.subdatasets)} rasters ({_listed(dataset.subdatasets)}); copy "
                        f"one to its own file, for example with `rio convert '{dataset.subdatasets[0]}' OUT.tif`"
                    )
                # A warning of GDAL, such as on a private tag that it skips, is raised by the next call.
                with suppress(Exception):
                    _ = dataset.colorinterp
                yield dataset
    except UnicodeEncodeError:
        raise ThermorenderError(f"{path}: this name is not valid Unicode, which GDAL needs; rename it") from None
    except Exception as error:
        # GDAL's own errors are no RasterioError, and their class is private.
        if not (isinstance(error, (RasterioError, UnicodeDecodeError)) or type(error).__module__ == "rasterio._err"):
            raise
        # The cause of a failed read, GDAL's own error, says where it failed.
        reason = error.__cause__ or error
        raise ThermorenderError(
            f"{path} cannot be read as a raster: {reason}; give a complete file such as a GeoTIFF"
        ) from None


def _check_size(path: Path | str, dataset: Any) -> None:
    """Refuse a raster of more pixels than its bytes can hold, before a library reserves memory for them."""
    size, pixels = os.path.getsize(path), dataset.width * dataset.height
    packed = f"{dataset.driver} {dataset.tags(ns='IMAGE_STRUCTURE').get('COMPRESSION')}"
    most = _MOST_PACKED if any(name in packed for name in _PACKED) else _MOST
    fits = can_hold(size, pixels) if dataset.driver in ("PNG", "JPEG") else pixels * dataset.count <= most * size
    if not fits:
        bands = "" if dataset.count == 1 else f" in {dataset.count} bands"
        raise ThermorenderError(
            f"{path} states {pixels} pixels{bands}, for which it has too few bytes; it is damaged, so copy it again"
        )


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")


def files_of(path: Path, any_size: bool = False) -> list[str]:
    """Return the files a raster is read from: itself and those that GDAL finds beside it."""
    with opened(path, any_size) as dataset:
        return list(dataset.files)


def grid_of(path: Path, any_size: bool = False, undeclared: Any = None) -> Grid:
    """Return the Grid of a raster file; `undeclared` is the CRS of one that declares none."""
    with opened(path, any_size) as dataset:
        crs = dataset.crs or undeclared
        if crs is None:
            raise ThermorenderError(
                f"{path} has no coordinate reference system (CRS); assign one, for example with `rio edit-info --crs "
                "EPSG:32651`, or give crs to an import"
            )
        if crs.to_wkt().startswith("GEOCCS"):
            raise ThermorenderError(
                f"{path} is in {crs_name(crs)}, a geocentric CRS and not a map; convert it "
                "to a geographic or projected one, for example with `rio warp`"
            )
        if dataset.transform.is_identity or dataset.transform.is_degenerate:
            raise ThermorenderError(
                f"{path} has no geotransform, so its position on the map is unknown; assign one, "
                "for example with `rio edit-info --transform`"
            )
        return Grid(crs, dataset.transform, dataset.height, dataset.width, str(path))


def on_map(path: Path) -> bool:
    """Return whether a raster file has a CRS and a position, unlike a picture."""
    with opened(path) as dataset:
        return dataset.crs is not None and not dataset.transform.is_identity


def bounds_in(crs: Any, grid: Grid) -> tuple[float, float, float, float]:
    """Return a Grid's (left, bottom, right, top) in the units of another map."""
    from rasterio.warp import transform_bounds

    if grid.crs == crs:
        return grid.bounds
    with _reprojecting(grid, crs):
        left, bottom, right, top = bounds = transform_bounds(grid.crs, crs, *grid.bounds, densify_pts=21)
        if not np.isfinite(bounds).all():
            raise ValueError("some coordinates are outside that map")
    return left, bottom, right, top


def step_m(crs: Any, grid: Grid) -> float:
    """Return the side of a grid's pixel in a map's metres."""
    # The pixels of a rotated grid fill only a share of its bounding rectangle.
    left, bottom, right, top = grid.bounds
    pixels = (right - left) * (top - bottom) / abs(grid.transform.determinant)
    left, bottom, right, top = bounds_in(crs, grid)
    return float(np.sqrt((right - left) * (top - bottom) / pixels))


def lon_lat(
    grid: Grid, x: NDArray[np.float64], y: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return WGS 84 longitude and latitude [deg] of map coordinates, (N,), in a grid's CRS."""
    from rasterio.crs import CRS
    from rasterio.warp import transform

    target = CRS.from_epsg(4326)
    with _reprojecting(grid, target):
        longitude, latitude = (np.asarray(values) for values in transform(grid.crs, target, x, y))
    if not ((np.abs(latitude) <= 90.0) & (np.abs(longitude) <= 360.0)).all():
        raise ThermorenderError(
            f"{grid.name}: x={x[0]:.9g}, y={y[0]:.9g} is not on Earth in {crs_name(grid.crs)}; assign the CRS of the "
            "coordinates"
        )
    return longitude, latitude


@contextmanager
def _reprojecting(grid: Grid, target: Any) -> Iterator[None]:
    try:
        yield
    except Exception as error:  # GDAL's errors share no public base class
        raise ThermorenderError(
            f"{grid.name}: coordinates in {crs_name(grid.crs)} cannot be converted to "
            f"{crs_name(target)} ({_crs_free(error)}); assign the CRS of the coordinates"
        ) from None


def crs_name(crs: Any) -> str:
    """Return the EPSG code where there is one; other definitions are too long for a sentence."""
    code = crs.to_epsg()
    return f"EPSG:{code}" if code else "a CRS without EPSG code"


def _crs_free(error: Exception) -> str:
    """GDAL's message without the definition of a CRS that it may quote in braces at the end."""
    return str(error).partition(" from '{")[0]


def read_band(path: Path, missing: Sequence[float] = (), part: RasterWindow | None = None) -> NDArray[np.float64]:
    """Return one band, or a RasterWindow of it, as float64, (h, w), scale and offset applied; NaN for no data and for
    raw values in `missing`."""
    with opened(path, part is not None) as dataset:
        if dataset.count != 1:
            raise ThermorenderError(f"{path} has {dataset.count} bands where one is expected; extract the one to use")
        if np.dtype(dataset.dtypes[0]).kind == "c":
            raise ThermorenderError(f"{path} holds complex numbers; give a raster of integers or real numbers")
        values = dataset.read(1, masked=True, **(part.options() if part else {}))
        scale, offset = dataset.scales[0], dataset.offsets[0]
    filled: NDArray[np.float64] = np.ma.filled(values.astype(np.float64), np.nan)
    if missing:
        filled[np.isin(filled, missing)] = np.nan
    filled = filled * scale + offset
    return filled


def read_classes(path: Path, part: RasterWindow | None = None) -> NDArray[np.int16]:
    """Return the class numbers of a raster, or of its window, (h, w) int16, 0 where it has no data."""
    numbers = np.nan_to_num(read_band(path, (), part), nan=0.0)
    odd = (numbers < 0.0) | (numbers > 255.0) | (numbers % 1.0 != 0.0)
    if odd.any():
        raise ThermorenderError(
            f"{path} holds {numbers[odd][0]:g}, which is not a class number; give whole numbers 0…255 (0 marks no data)"
        )
    return numbers.astype(np.int16)


def onto(values: NDArray[Any], source: Grid, target: Grid, resampling: str) -> NDArray[Any]:
    """Return a raster (h, w) or (h, w, c) resampled to another grid, with NaN (0 for integers) where it has no data."""
    if source.same_as(target):
        return values
    from rasterio.warp import Resampling, reproject

    bands = np.moveaxis(values if values.ndim == 3 else values[..., None], -1, 0)
    missing = np.nan if values.dtype.kind == "f" else 0
    result = np.full((len(bands), target.height, target.width), missing, dtype=values.dtype)
    with _reprojecting(source, target.crs):
        reproject(
            np.ascontiguousarray(bands),
            result,
            src_transform=source.transform,
            src_crs=source.crs,
            dst_transform=target.transform,
            dst_crs=target.crs,
            src_nodata=np.nan if values.dtype.kind == "f" else None,
            dst_nodata=missing,
            resampling=Resampling[resampling],
            num_threads=os.cpu_count(),
        )
    result = np.moveaxis(result, 0, -1)
    return np.ascontiguousarray(result if values.ndim == 3 else result[..., 0])
