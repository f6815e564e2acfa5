"""A scene folder from GeoTIFFs of any CRS, resolution and extent: an elevation model and, optionally, an orthophoto.

Both are resampled onto the elevation's map (or its UTM zone, if that is in degrees), cut to the area they share, and
thinned where they exceed the size limits. NaN heights leave holes in the mesh, unless the scene fills enclosed gaps.
The orthophoto's empty borders become its mask.
"""

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender import defaults, formats
from thermorender.apps.lands.solids.clouds import SUFFIXES, read_cloud
from thermorender.apps.lands.solids.importing import ThreeD, write_solid
from thermorender.errors import ThermorenderError
from thermorender.files import atomic_folder, check_new_folder
from thermorender.formats import write_text
from thermorender.materials.extended import within_band
from thermorender.scene.mapped_cover import read_mapped_cover
from thermorender.scene.orthophoto import COLLAR, empty_border, read_colour
from thermorender.scene.raster import Grid, bounds_in, grid_of, lon_lat, onto
from thermorender.scene.spec import WeatherSpec
from thermorender.scene.surface import scene_kelvin
from thermorender.scene.terrain import doubtful_zeros, filled, read_elevation
from thermorender.schema import toml_text
from thermorender.sensor.camera import load_camera
from thermorender.units import instant, utc_text
from thermorender.weather.declared import declared_weather
from thermorender.weather.year_file import is_year_file

DEFAULT_VERTICES = 4_000_000
DEFAULT_TEXELS = 8192
# Placeholders until the user gives better ones [K]: the sky without weather, and the ground without orthophoto.
SKY_K, GROUND_K = 255.0, 288.15
# Duration of the flight that comes with the scene [s]: 180 frames of the default camera.
_FLIGHT_S = 20.0


_Bounds = tuple[float, float, float, float]
# Name of the shapes of OpenStreetMap in the scene's folder.
_KNOWN = "known.geojson"
# Of a scene in three dimensions: values of `Imported` in the summary.
_FOUND = ("buildings", "trees", "flat_outlines", "stated_walls", "unmatched")


def import_terrain(
    elevation: Path, orthophoto: Path | None, folder: Path, max_vertices: int = DEFAULT_VERTICES,
    max_texels: int = DEFAULT_TEXELS, height_reference: str | None = None, geoid_undulation_m: float | None = None,
    model: str = defaults.TEMPERATURE_MAP, material: str = "soil_loam", sky_temperature: float | None = None,
    fill: bool = False, bands: Sequence[int] | None = None, colour_range: tuple[float, float] | None = None,
    collar: int = 0, weather: Path | None = None, time: str | None = None, known: Path | None = None,
    three_d: ThreeD | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Write a scene folder from an elevation model and an orthophoto, and return a summary of what is in it.

    Parameters
    ----------
    elevation : path
        GeoTIFF of heights in one band, in metres or the unit it declares; or a point cloud, LAS or LAZ, whose highest
        points are the heights. With `three_d`, its points of class 2 are the ground, and those of class 6 buildings.
    orthophoto : path or None
        GeoTIFF in colour; without one the ground has the colour of its material.
    folder : path
        New scene folder; it does not exist, or is empty.
    max_vertices : int
        Largest number of posts of the mesh; a finer elevation model is averaged.
    max_texels : int
        Largest number of texels along a side of the texture; a finer orthophoto is averaged.
    height_reference : {"ellipsoid", "geoid"}, optional
        Zero of the heights; by default "geoid" if the CRS names a vertical datum, else "ellipsoid".
    geoid_undulation_m : float, optional
        Height of the geoid above the ellipsoid there [m].
    model : str
        Learned map that gives the scene its temperatures if there is an orthophoto and no weather.
    material : str
        Material of the ground; with orthophoto and weather, of texels whose material is not recognised.
    sky_temperature : float, optional
        [K]; by default the sky of the weather, or 255 K without one.
    fill : bool
        Whether the scene fills enclosed gaps in the heights and flags them in the truth mask; not with `three_d`.
    bands : sequence of int, optional
        Numbers of the orthophoto's red, green and blue bands; by default those that it declares.
    colour_range : (float, float), optional
        Its values of black and white; needed where it does not have 8 bits.
    collar : int
        Its borders within this many of 255 levels of black or white are holes: lossy compression changes them.
    weather : path, optional
        A station's CSV, an EPW file, or a TMY3 or PSM table. The scene then has the temperatures of a heat balance, and
        with an orthophoto the materials that a learned map finds in it.
    time : str, optional
        Instant of the scene with its zone; needed with `weather`.
    known : path, optional
        GeoJSON of OpenStreetMap shapes, as `emissivity.known`; needs an orthophoto. The scene then has the materials
        that a learned map finds in the orthophoto. With `three_d` its buildings are the outlines to extrude instead,
        or those of a raster of classes, and no orthophoto is needed.
    three_d : ThreeD, optional
        How the scene becomes a mesh with walls below its roofs and porous trees, all found in the heights. Posts are
        1 m apart or less, unless `known` states the buildings.

    Returns
    -------
    dict
        crs, posts and texels ([rows, columns]), post_m, texel_m, height_reference, height_reference_stated (by the
        caller or the CRS), flight_m (height of flight.csv above the ground), share_without_height, share_filled (of
        the posts), share_without_colour, share_collar (not empty, but near black or white up to the edge),
        share_clipped (black or white in some band), the last three None without orthophoto, and known, sentences on
        what was doubtful or left out in the files. With `three_d` also buildings, trees, flat_outlines (left out, as
        less than a third of each is high), stated_walls (buildings whose outlines declare their walls), unmatched,
        {declared wall without a match: count}, and kinds (number of typical trees of which the trees are copies; 0
        where each has its own leaves).
    """
    _check(model, material, height_reference, geoid_undulation_m, sky_temperature)
    check_new_folder(folder)
    _check_together(orthophoto, known, weather, fill, three_d, max_vertices, max_texels)
    cloud = read_cloud(elevation) if Path(elevation).suffix.lower() in SUFFIXES else None
    height, height_grid = (cloud.surface, cloud.grid) if cloud else read_elevation(elevation)
    notes = cloud.notes if cloud else doubtful_zeros(elevation, height)
    stated = height_reference is not None or _has_vertical_datum(height_grid.crs)
    if height_reference is None:
        height_reference = "geoid" if stated else "ellipsoid"
    day = _weather(weather, time, height, height_grid)
    crs = _map_crs(height_grid)
    bounds = bounds_in(crs, height_grid)
    picture = None
    if orthophoto is not None:
        colours = read_colour(orthophoto, bands, colour_range, collar)
        picture, bounds = _picture(orthophoto, colours, elevation, crs, bounds, max_texels)
    height, target = _heights(height, height_grid, crs, bounds, max_vertices, square=three_d is not None)
    if not np.isfinite(height).any():
        raise ThermorenderError(f"{elevation} has no valid height where {orthophoto} is; give a DEM of the same area")
    terrain = {"elevation": "elevation.tif", "orthophoto": "orthophoto.tif" if picture else None,
               "height_reference": height_reference, "geoid_undulation_m": geoid_undulation_m,
               "fill": fill or None}  # fmt: skip
    tables = {"title": Path(folder).resolve().name, "terrain": terrain}
    tables |= _sources(picture is not None, day, model, material, sky_temperature, None if three_d else known)
    made_from = " and ".join(Path(path).name for path in (elevation, orthophoto) if path is not None)
    texels = picture[2] if picture else target
    solid = None
    if three_d:
        undulation_m = (geoid_undulation_m or 0.0) if height_reference == "geoid" else 0.0
        solid = three_d.made(height, target, _step(crs, target), undulation_m, known, picture, material,
                             height_grid.crs, cloud)  # fmt: skip
        known = None
    shapes = read_mapped_cover(known, texels, _step(crs, texels)).notes if known is not None else ()
    flight_m, flight = _flight(bounds, _step(crs, texels))
    with atomic_folder(folder) as part:
        if solid is not None:
            tables = write_solid(part, solid, tables)
            # Heights above the ground would follow each roof and crown.
            flight = flight.replace("above_ground_m", "up_m")
        else:
            _write(part / "elevation.tif", height[None].astype(np.float32), target, nodata=np.nan, predictor=3)
        if picture and solid is None:
            _write(part / "orthophoto.tif", np.moveaxis(picture[0], -1, 0), texels, predictor=2, photometric="RGB",
                   mask=picture[1])  # fmt: skip
        if weather is not None:
            shutil.copyfile(weather, part / _copied(weather))
        if known is not None:
            shutil.copyfile(known, part / _KNOWN)
        write_text(part / "scene.toml", toml_text(tables, f"Made from {made_from}."))
        write_text(part / "flight.csv", flight)
    given = np.isfinite(height)
    after = np.isfinite(filled(height)[0]) if fill else given
    return {
        "crs": crs.to_string(),
        "posts": [target.height, target.width],
        "post_m": _step(crs, target),
        "texels": [texels.height, texels.width],
        "texel_m": _step(crs, texels),
        "height_reference": height_reference,
        "height_reference_stated": stated,
        "flight_m": flight_m,
        "known": (*notes, *(solid.notes if solid else ()), *shapes),
        **({name: getattr(solid, name) for name in _FOUND} | {"kinds": len(solid.kinds)} if solid else {}),
        "share_without_height": float(1.0 - after.mean()),
        "share_filled": float((after & ~given).mean()),
        **_colour_shares(*picture[:2] if picture else (None, None)),
    }


def _check(
    model: str, material: str, height_reference: str | None, geoid_undulation_m: float | None,
    sky_temperature: float | None,
) -> None:  # fmt: skip
    from thermorender.learned.temperature_map import load_model
    from thermorender.materials.library import find, load_library

    load_model(model)
    library = load_library()
    within_band(find(library, material, "material"), defaults.BAND_UM, library, "material")
    if height_reference not in (None, "ellipsoid", "geoid"):
        raise ThermorenderError(f"height_reference={height_reference!r} is not allowed; give ellipsoid or geoid")
    _finite("geoid_undulation_m", geoid_undulation_m)
    if sky_temperature is not None:
        _finite("sky_temperature", sky_temperature)
        scene_kelvin("sky_temperature", sky_temperature)


def _check_together(
    orthophoto: Path | None, known: Path | None, weather: Path | None, fill: bool, three_d: ThreeD | None,
    max_vertices: int, max_texels: int,
) -> None:  # fmt: skip
    """Refuse arguments that exclude each other, one that needs another, and limits without room for a mesh."""
    if three_d and fill:
        raise ThermorenderError("fill is for a raster of heights, and three_d makes a mesh; leave one of them out")
    if three_d and three_d.copies and weather is None:
        raise ThermorenderError(
            "copies of trees have the temperatures of a heat balance; give a weather and a time too, or leave copies "
            "out"
        )
    if known is not None and orthophoto is None and not three_d:
        raise ThermorenderError(f"known={known} restricts materials that are read from an orthophoto; give one too")
    if max_vertices < 4 or max_texels < 2:
        raise ThermorenderError(
            f"max_vertices={max_vertices}, max_texels={max_texels} are too small; give at least 4 and 2"
        )


def _weather(path: Path | None, time: str | None, height: NDArray[np.float64], grid: Grid) -> dict[str, Any] | None:
    """The table [weather] of a file and an instant, both tried at the terrain's place; None without a file."""
    if path is None:
        if time is not None:
            raise ThermorenderError(f"time={time} is the instant of a weather; give --weather too, or leave it out")
        return None
    if time is None:
        raise ThermorenderError(f"weather={path} needs the scene's instant; give --time, such as 2018-07-28T14:30Z")
    when = instant("time", time)
    kind = "epw" if is_year_file(path) else "file"
    x, y = grid.to_map(grid.width / 2, grid.height / 2)
    (longitude,), (latitude,) = lon_lat(grid, np.array([x]), np.array([y]))
    spec = WeatherSpec(when, epw=Path(path)) if kind == "epw" else WeatherSpec(when, file=Path(path))
    declared_weather(spec, float(latitude), float(longitude), float(np.nanmedian(height)))
    return {"time": utc_text(when), kind: _copied(path)}


def _copied(weather: Path) -> str:
    """Name of a weather file in the scene's folder."""
    return "weather" + Path(weather).suffix


def _sources(
    picture: bool,
    weather: dict[str, Any] | None,
    model: str,
    material: str,
    sky_temperature: float | None,
    known: Path | None,
) -> dict[str, Any]:
    """The scene file's tables of temperatures, materials, weather, sky and camera."""
    found: dict[str, Any] = {"source": "material", "material": material}
    if picture and (weather is not None or known is not None):
        found = {"source": "learned", "model": defaults.EMISSIVITY_MAP, "fallback": material,
                 "known": None if known is None else _KNOWN}  # fmt: skip
    if weather is not None:
        tables: dict[str, Any] = {"temperature": {"source": "balance"}, "weather": weather, "emissivity": found}
    else:
        placeholder = {"source": "learned", "model": model} if picture else {"source": "constant", "value": GROUND_K}
        tables = {"temperature": placeholder, "emissivity": found}
        sky_temperature = SKY_K if sky_temperature is None else sky_temperature
    if sky_temperature is not None:
        tables["sky"] = {"temperature": sky_temperature}
    return tables | {"camera": {"model": defaults.CAMERA}}


def _colour_shares(rgb: NDArray[np.uint8] | None, valid: NDArray[np.bool_] | None) -> dict[str, float | None]:
    if rgb is None or valid is None:
        return dict.fromkeys(("share_without_colour", "share_collar", "share_clipped"))
    shown = np.where(valid[..., None], rgb, 0)
    return {
        "share_without_colour": float(1.0 - valid.mean()),
        "share_collar": float((empty_border(shown, COLLAR) & valid).mean()),
        "share_clipped": float((((rgb == 0) | (rgb == 255)).any(axis=-1) & valid).sum() / max(valid.sum(), 1)),
    }


def _heights(
    height: NDArray[Any], grid: Grid, crs: Any, bounds: _Bounds, max_vertices: int, square: bool
) -> tuple[NDArray[Any], Grid]:
    """Heights on a map's grid within bounds, and that Grid; `square` where lengths are counted in posts."""
    post = _step(crs, grid)
    target = _grid(crs, bounds, max(post, np.sqrt((bounds[2] - bounds[0]) * (bounds[3] - bounds[1]) / max_vertices)))
    wrong = square and abs(grid.transform.a + grid.transform.e) > 1e-3 * abs(grid.transform.a)
    if _aligned(grid, crs, target, post) and not wrong:
        return _cut(height, grid, bounds)
    return onto(height, grid, target, "average" if _step(crs, target) > 1.5 * post else "bilinear"), target


def _picture(
    orthophoto: Path, colours: tuple[NDArray[np.uint8], NDArray[np.bool_]], elevation: Path, crs: Any, bounds: _Bounds,
    max_texels: int,
) -> tuple[tuple[NDArray[np.uint8], NDArray[np.bool_], Grid], _Bounds]:  # fmt: skip
    """(Colours on a map's grid as `_colours`, bounds shared with the elevation)."""
    (rgb, valid), grid = colours, grid_of(orthophoto)
    if not valid.any():
        raise ThermorenderError(f"{orthophoto} is empty: every pixel is masked or border; give another orthophoto")
    bounds = _shared(bounds, bounds_in(crs, grid), elevation, orthophoto)
    picture = _colours(rgb, valid, grid, crs, bounds, max_texels)
    if not picture[1].any():
        raise ThermorenderError(f"{orthophoto} is empty where {elevation} is; give an orthophoto of the same area")
    return picture, bounds


def _colours(
    rgb: NDArray[np.uint8], valid: NDArray[np.bool_], grid: Grid, crs: Any, bounds: _Bounds, max_texels: int
) -> tuple[NDArray[np.uint8], NDArray[np.bool_], Grid]:
    """Colours on a map's grid within bounds, where they are valid, and that Grid."""
    texel = _step(crs, grid)
    span = max(bounds[2] - bounds[0], bounds[3] - bounds[1])
    target = _grid(crs, bounds, max(texel, span / max_texels))
    if _aligned(grid, crs, target, texel):
        rgb, target = _cut(rgb, grid, bounds)
        return rgb, _cut(valid, grid, bounds)[0], target
    resampling = "average" if _step(crs, target) > 1.5 * texel else "bilinear"
    if valid.all():
        # In bytes, a third of the time.
        shown = onto(valid.astype(np.uint8), grid, target, resampling) > 0
        return np.where(shown[..., None], onto(rgb, grid, target, resampling), 0), shown, target
    # Empty texels must not bleed into their neighbours: filter valid colour and its weight separately.
    weight = np.nan_to_num(onto(valid.astype(np.float32), grid, target, resampling))
    filtered = onto(rgb * valid[..., None].astype(np.float32), grid, target, resampling)
    valid = weight > 0.5
    mean = np.where(valid[..., None], filtered / np.maximum(weight, 1e-6)[..., None], 0.0)
    return np.clip(np.rint(np.nan_to_num(mean)), 0, 255).astype(np.uint8), valid, target


def _flight(bounds: _Bounds, texel_m: float) -> tuple[float, str]:
    """(Height above the ground [m], text of flight.csv): along the middle, looking down, a pixel as wide as a texel.

    The flight is lower where the terrain would not fill half of the picture.
    """
    camera = load_camera(defaults.CAMERA)
    across, up = bounds[2] - bounds[0], bounds[3] - bounds[1]
    fits = 0.5 * min(across / camera.width, up / camera.height) * camera.focal_length_px
    height = min(texel_m * camera.focal_length_px, max(fits, 1.0))
    half, east = 0.3 * max(across, up), across >= up
    ends = [(side * half * east, side * half * (not east)) for side in (-1.0, 1.0)]
    yaw = 90.0 if east else 0.0
    rows = [
        f"{time:.1f},{e:.1f},{n:.1f},{height:.1f},{yaw:.0f},-90,0"
        for time, (e, n) in zip((0.0, _FLIGHT_S), ends, strict=True)
    ]
    return height, "\n".join(["time_s,east_m,north_m,above_ground_m,yaw_deg,pitch_deg,roll_deg", *rows]) + "\n"


def _finite(name: str, value: float | None) -> None:
    if value is not None and not np.isfinite(value):
        raise ThermorenderError(f"{name}={value} is not a finite number; give one")


def _has_vertical_datum(crs: Any) -> bool:
    return any(word in crs.to_wkt() for word in ("COMPD_CS", "COMPOUNDCRS", "VERT_CS"))


def _map_crs(grid: Grid) -> Any:
    """The elevation's CRS if it is projected in metres, else the UTM zone of its middle."""
    from rasterio.crs import CRS

    if grid.crs.is_projected and abs(grid.crs.linear_units_factor[1] - 1.0) < 1e-9:
        return grid.crs
    x, y = grid.to_map(grid.width / 2, grid.height / 2)
    (longitude,), (latitude,) = lon_lat(grid, np.array([x]), np.array([y]))
    zone = int((longitude + 180.0) // 6.0) % 60 + 1
    return CRS.from_epsg((32600 if latitude >= 0.0 else 32700) + zone)


def _shared(a: _Bounds, b: _Bounds, elevation: Path, orthophoto: Path) -> _Bounds:
    bounds = max(a[0], b[0]), max(a[1], b[1]), min(a[2], b[2]), min(a[3], b[3])
    if not (bounds[0] < bounds[2] and bounds[1] < bounds[3]):
        raise ThermorenderError(
            f"{elevation} (x {a[0]:.0f}…{a[2]:.0f}, y {a[1]:.0f}…{a[3]:.0f}) and {orthophoto} "
            f"(x {b[0]:.0f}…{b[2]:.0f}, y {b[1]:.0f}…{b[3]:.0f}) do not overlap; give rasters of the same area"
        )
    return bounds


def _step(crs: Any, grid: Grid) -> float:
    """Side of a grid's pixel in a map's metres."""
    # The pixels of a rotated grid fill only a share of its bounding rectangle.
    left, bottom, right, top = grid.bounds
    pixels = (right - left) * (top - bottom) / abs(grid.transform.determinant)
    left, bottom, right, top = bounds_in(crs, grid)
    return float(np.sqrt((right - left) * (top - bottom) / pixels))


def _grid(crs: Any, bounds: _Bounds, step: float) -> Grid:
    from rasterio import Affine

    width = max(2, int(np.floor((bounds[2] - bounds[0]) / step + 1e-6)))
    height = max(2, int(np.floor((bounds[3] - bounds[1]) / step + 1e-6)))
    return Grid(crs, Affine(step, 0.0, bounds[0], 0.0, -step, bounds[3]), height, width)


def _aligned(grid: Grid, crs: Any, target: Grid, step: float) -> bool:
    """Whether cropping a grid is enough: same map, north up and east to the right, no thinning."""
    t = grid.transform
    upright = bool(t.a > 0.0 and t.e < 0.0 and t.b == t.d == 0.0)
    return grid.crs == crs and upright and abs(_step(crs, target) - step) < 1e-6 * step


def _cut(values: NDArray[Any], grid: Grid, bounds: _Bounds) -> tuple[NDArray[Any], Grid]:
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


def _write(path: Path, bands: NDArray[Any], grid: Grid, mask: NDArray[np.bool_] | None = None, **options: Any) -> None:
    import rasterio

    with formats.atomic_raster(path) as part, rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), rasterio.open(
        part, "w", driver="GTiff", count=len(bands), dtype=bands.dtype, height=grid.height, width=grid.width,
        crs=grid.crs, transform=grid.transform, compress="deflate", tiled=True, **options,
    ) as dataset:  # fmt: skip
        dataset.write(bands)
        if mask is not None:
            dataset.write_mask(mask)
