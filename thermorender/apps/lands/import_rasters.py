"""Rasters of an import: resampled onto one map, cut, thinned and written."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from thermorender import formats
from thermorender.apps.lands.import_settings import ImportSettings
from thermorender.errors import ThermorenderError
from thermorender.numbers import parse_numbers
from thermorender.physics.geodesy import FARTHEST_M
from thermorender.scene.orthophoto import read_colour, resampled
from thermorender.scene.raster import Bounds, Grid, bounds_in, describe, grid_of, lon_lat, onto, step_m, window_of
from thermorender.scene.terrain import read_elevation

# A part of a file is read at up to this many times the posts or texels that are kept, of which means are taken.
_OVERSAMPLED = 4


class Picture(NamedTuple):
    """An orthophoto on a map's grid."""

    rgb: NDArray[np.uint8]  # (h, w, 3) sRGB
    valid: NDArray[np.bool_]  # (h, w)
    grid: Grid


def heights_on_map(
    height: NDArray[Any], grid: Grid, crs: Any, bounds: Bounds, max_vertices: int, square: bool
) -> tuple[NDArray[Any], Grid]:
    """Return heights on a map's grid within bounds, and that Grid; `square` where lengths are counted in posts."""
    post = step_m(crs, grid)
    target = _grid(crs, bounds, max(post, np.sqrt((bounds[2] - bounds[0]) * (bounds[3] - bounds[1]) / max_vertices)))
    wrong = square and abs(grid.transform.a + grid.transform.e) > 1e-3 * abs(grid.transform.a)
    if _aligned(grid, crs, target, post) and not wrong:
        return _cut(height, grid, bounds)
    return onto(height, grid, target, "average" if step_m(crs, target) > 1.5 * post else "bilinear"), target


def square_around(text: str, crs: Any) -> Bounds:
    """Return the bounds on a map of a square of "LATITUDE,LONGITUDE,SIDE", in degrees and metres."""
    from rasterio.crs import CRS
    from rasterio.warp import transform

    latitude, longitude, side = parse_numbers("around", text, ("LATITUDE", "LONGITUDE", "SIDE"))
    if not (abs(latitude) <= 90.0 and abs(longitude) <= 360.0 and 0.0 < side <= FARTHEST_M):
        raise ThermorenderError(
            f"around={text!r} is not allowed; give a latitude of −90…90°, a longitude and the side in metres, up to "
            f"{FARTHEST_M:.0f}"
        )
    (x,), (y,) = transform(CRS.from_epsg(4326), crs, [longitude], [latitude])
    if not np.isfinite([x, y]).all():
        raise ThermorenderError(f"around={text!r} is not on the map of the elevation; give a place on it")
    return x - 0.5 * side, y - 0.5 * side, x + 0.5 * side, y + 0.5 * side


def undeclared_crs(settings: ImportSettings) -> Any:
    """Return the CRS of files that declare none; None without one."""
    from rasterio.crs import CRS
    from rasterio.errors import CRSError

    try:
        return None if settings.crs is None else CRS.from_user_input(settings.crs)
    except CRSError:
        raise ThermorenderError(
            f"crs={settings.crs!r} is not a coordinate reference system; give its EPSG code, such as EPSG:25833"
        ) from None


def read_heights(
    path: Path, crs: Any, bounds: Bounds, most: int, undeclared: Any = None
) -> tuple[NDArray[np.float64], Grid, Bounds]:  # fmt: skip
    """Return (heights (h, w) [m], their Grid, their bounds on a map) of the part of a raster of any size within bounds,
    thinned to a few times `most` posts."""
    part = window_of(path, crs, bounds, _OVERSAMPLED * most, undeclared)
    height, grid = read_elevation(path, part)
    return height, grid, shared(bounds, bounds_in(crs, grid))


def read_picture(
    orthophoto: Path, settings: ImportSettings, elevation: Path, crs: Any, bounds: Bounds, whole: bool = True
) -> tuple[Picture, Bounds]:
    """Return (orthophoto on a map's grid, bounds shared with the elevation); of the file is read what is within them,
    or the `whole`, whose border may be empty."""
    bands, ends = settings.bands, settings.colour_range
    chosen = [int(number) for number in parse_numbers("bands", bands, ("RED", "GREEN", "BLUE"))] if bands else None
    scale = None
    if ends:
        black, white = parse_numbers("colour_range", ends, ("BLACK", "WHITE"))
        scale = black, white
    undeclared = undeclared_crs(settings)
    part = None if whole else window_of(orthophoto, crs, bounds, _OVERSAMPLED * settings.max_texels**2, undeclared)
    rgb, valid = read_colour(orthophoto, chosen, scale, settings.collar, part)
    grid = part.grid if part else grid_of(orthophoto, undeclared=undeclared)
    if not valid.any():
        raise ThermorenderError(f"{orthophoto} is empty: every pixel is masked or border; give another orthophoto")
    own = bounds_in(crs, grid)
    if not all(np.diff(np.array(shared(bounds, own)).reshape(2, 2), axis=0)[0] > 0.0):
        raise ThermorenderError(
            f"{elevation} ({describe(bounds)}) and {orthophoto} ({describe(own)}) do not overlap; give rasters of the "
            "same area"
        )
    bounds = shared(bounds, own)
    picture = Picture(*_colours(rgb, valid, grid, crs, bounds, settings))
    if not picture.valid.any():
        raise ThermorenderError(f"{orthophoto} is empty where {elevation} is; give an orthophoto of the same area")
    return picture, bounds


def _colours(
    rgb: NDArray[np.uint8], valid: NDArray[np.bool_], grid: Grid, crs: Any, bounds: Bounds, settings: ImportSettings
) -> tuple[NDArray[np.uint8], NDArray[np.bool_], Grid]:
    """Colours on a map's grid within bounds, where they are valid, and that Grid."""
    texel = step_m(crs, grid)
    span = max(bounds[2] - bounds[0], bounds[3] - bounds[1])
    target = _grid(crs, bounds, max(texel, span / settings.max_texels, settings.texel_m or 0.0))
    if _aligned(grid, crs, target, texel):
        rgb, target = _cut(rgb, grid, bounds)
        return rgb, _cut(valid, grid, bounds)[0], target
    resampling = "average" if step_m(crs, target) > 1.5 * texel else "bilinear"
    return *resampled(rgb, valid, grid, target, resampling), target


def map_crs(grid: Grid) -> Any:
    """Return the elevation's CRS if it is projected in metres, else the UTM zone of its middle."""
    from rasterio.crs import CRS

    if grid.crs.is_projected and abs(grid.crs.linear_units_factor[1] - 1.0) < 1e-9:
        return grid.crs
    latitude, longitude = middle(grid)
    zone = int((longitude + 180.0) // 6.0) % 60 + 1
    return CRS.from_epsg((32600 if latitude >= 0.0 else 32700) + zone)


def middle(grid: Grid) -> tuple[float, float]:
    """Return (latitude, longitude) of the middle of a grid [deg]."""
    x, y = grid.to_map(grid.width / 2, grid.height / 2)
    (longitude,), (latitude,) = lon_lat(grid, np.array([x]), np.array([y]))
    return float(latitude), float(longitude)


def shared(a: Bounds, b: Bounds) -> Bounds:
    """Return the bounds of what two areas share; without an overlap they are in the wrong order."""
    return max(a[0], b[0]), max(a[1], b[1]), min(a[2], b[2]), min(a[3], b[3])


def _grid(crs: Any, bounds: Bounds, step: float) -> Grid:
    from rasterio import Affine

    width = max(2, int(np.floor((bounds[2] - bounds[0]) / step + 1e-6)))
    height = max(2, int(np.floor((bounds[3] - bounds[1]) / step + 1e-6)))
    return Grid(crs, Affine(step, 0.0, bounds[0], 0.0, -step, bounds[3]), height, width)


def _aligned(grid: Grid, crs: Any, target: Grid, step: float) -> bool:
    """Whether cropping a grid is enough: same map, north up and east to the right, no thinning."""
    t = grid.transform
    upright = bool(t.a > 0.0 and t.e < 0.0 and t.b == t.d == 0.0)
    return grid.crs == crs and upright and abs(step_m(crs, target) - step) < 1e-6 * step


def _cut(values: NDArray[Any], grid: Grid, bounds: Bounds) -> tuple[NDArray[Any], Grid]:
    """Pixels of a north-up grid within bounds, and their Grid."""
    from rasterio import Affine

    column0, row0 = grid.to_pixel(bounds[0], bounds[3])
    column1, row1 = grid.to_pixel(bounds[2], bounds[1])
    column0, row0 = max(0, int(np.floor(column0 + 1e-6))), max(0, int(np.floor(row0 + 1e-6)))
    column1, row1 = min(grid.width, int(np.ceil(column1 - 1e-6))), min(grid.height, int(np.ceil(row1 - 1e-6)))
    part = values[row0:row1, column0:column1]
    t = grid.transform
    x, y = grid.to_map(column0, row0)
    corner = Affine(t.a, t.b, x, t.d, t.e, y)
    return part, Grid(grid.crs, corner, *part.shape[:2])


def write_raster(
    path: Path, bands: NDArray[Any], grid: Grid, mask: NDArray[np.bool_] | None = None, **options: Any
) -> None:
    """Write bands (n, h, w) as a GeoTIFF; `options` as of `rasterio.open`."""
    import rasterio

    with formats.atomic_raster(path) as part, rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), rasterio.open(
        part, "w", driver="GTiff", count=len(bands), dtype=bands.dtype, height=grid.height, width=grid.width,
        crs=grid.crs, transform=grid.transform, compress="deflate", tiled=True, **options,
    ) as dataset:  # fmt: skip
        dataset.write(bands)
        if mask is not None:
            dataset.write_mask(mask)


def has_vertical_datum(crs: Any) -> bool:
    """Return whether a CRS states the zero of heights."""
    return any(word in crs.to_wkt() for word in ("COMPD_CS", "COMPOUNDCRS", "VERT_CS"))
