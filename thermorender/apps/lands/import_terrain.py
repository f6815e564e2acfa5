"""A scene folder from GeoTIFFs of any CRS, resolution and extent: an elevation model and, optionally, an orthophoto.

Both are resampled onto the elevation's map (or its UTM zone, if that is in degrees), cut to the area they share, and
thinned where they exceed the size limits. NaN heights leave holes in the mesh, unless the scene fills enclosed gaps.
The orthophoto's empty borders become its mask.
"""

import shutil
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender import defaults, load_camera
from thermorender.apps.lands.import_far import FarGround, read_far
from thermorender.apps.lands.import_rasters import (
    Picture,
    has_vertical_datum,
    heights_on_map,
    map_crs,
    middle,
    read_heights,
    read_picture,
    square_around,
    undeclared_crs,
    write_raster,
)
from thermorender.apps.lands.import_settings import ImportSettings, ThreeD
from thermorender.apps.lands.solids.city_model import CityModel
from thermorender.apps.lands.solids.clouds import SUFFIXES, Cloud, read_cloud
from thermorender.apps.lands.solids.solid_scene import solid_of, write_solid
from thermorender.apps.lands.unexplained import Photograph, with_found, write_unexplained
from thermorender.errors import ThermorenderError
from thermorender.files import atomic_folder, check_new_folder
from thermorender.formats import write_json, write_text
from thermorender.materials.extended import within_band
from thermorender.progress import Progress
from thermorender.scene.folder import read_files
from thermorender.scene.georeference import datum_heights
from thermorender.scene.mapped_cover import read_mapped_cover
from thermorender.scene.orthophoto import COLLAR, empty_border
from thermorender.scene.raster import Bounds, Grid, bounds_in, grid_of, step_m
from thermorender.scene.spec import WeatherSpec, read_scene
from thermorender.scene.surface import scene_kelvin
from thermorender.scene.terrain import doubtful_zeros, filled, read_elevation
from thermorender.schema import toml_text
from thermorender.units import instant, utc_text
from thermorender.weather.declared_weather import declared_weather
from thermorender.weather.year_file import is_year_file

# Placeholders until the user gives better ones [K]: the sky without weather, and the ground without orthophoto.
SKY_K, GROUND_K = 255.0, 288.15
# Duration of the flight that comes with the scene [s]: 180 frames of the default camera.
_FLIGHT_S = 20.0
_DEFAULT = ImportSettings()


# Name of the shapes of OpenStreetMap in the scene's folder.
_KNOWN = "known.geojson"
# Of a scene in three dimensions: values of `CityModel` in the summary.
_FOUND = ("buildings", "trees", "flat_outlines", "stated_walls", "unmatched")


def import_terrain(
    elevation: Path, orthophoto: Path | None, folder: Path, settings: ImportSettings = _DEFAULT,
    three_d: ThreeD | None = None, progress: Progress = lambda what, share: None,
) -> dict[str, Any]:  # fmt: skip
    """Write a scene folder from an elevation model and an orthophoto, and return a summary of what is in it.

    Heights are a GeoTIFF of one band, or a point cloud, LAS or LAZ, whose highest points count; with `three_d` its
    points of class 2 are the ground, and those of class 6 buildings. Without orthophoto the ground has the colour of
    its material. `progress` may raise to end the import, which then leaves nothing behind.
    """
    done = partial(progress, "importing the terrain")
    done(0.0)
    _check(settings, orthophoto, three_d)
    check_new_folder(folder)
    cloud, height, height_grid, notes, square = _read_heights(elevation, settings)
    stated = settings.height_reference is not None or has_vertical_datum(height_grid.crs)
    reference = settings.height_reference or ("geoid" if stated else "ellipsoid")
    day = weather_table(settings.weather, settings.time, height, height_grid)
    crs = map_crs(height_grid)
    bounds = square or bounds_in(crs, height_grid)
    if reference == "ellipsoid" and crs != height_grid.crs:
        # The map is of WGS 84.
        height = height + datum_heights(height_grid)
    done(0.1)
    picture = None
    if orthophoto is not None:
        picture, bounds = read_picture(orthophoto, settings, elevation, crs, bounds, whole=square is None)
        done(0.4)
    height, posts = heights_on_map(height, height_grid, crs, bounds, settings.max_vertices, square=three_d is not None)
    if not np.isfinite(height).any():
        raise ThermorenderError(f"{elevation} has no valid height where {orthophoto} is; give a DEM of the same area")
    done(0.5)
    far, more = read_far(settings.far or (), height, posts, reference, settings)
    done(0.6)
    notes = (*notes, *more)
    if far and picture is not None and (day is not None or settings.known is not None):
        coarse = f"far ground has the material {settings.material} where its texels are too coarse for a learned map"
        notes = (*notes, f"{coarse}; classes in [[terrain.far]] give it others")
    texels = picture.grid if picture else posts
    post_m, texel_m = step_m(crs, posts), step_m(crs, texels)
    solid, known, cover = None, settings.known, None
    if three_d:
        above_m = (settings.geoid_undulation_m or 0.0) if reference == "geoid" else datum_heights(posts)
        solid = solid_of(three_d, height, posts, post_m, above_m, known, picture, settings.material,
                         height_grid.crs, cloud)  # fmt: skip
        notes, cover = (*notes, *solid.notes), solid.cover
        known = known if cover is not None and cover.cases else None
    elif known is not None:
        cover = read_mapped_cover(known, texels, texel_m)
    # Outlines and other shapes of one file say the same of it.
    notes = tuple(dict.fromkeys((*notes, *(cover.notes if cover is not None else ()))))
    photograph, shapes = None, None
    if picture is not None and (day is not None or known is not None):
        photograph = Photograph(*picture, texel_m, height, posts, post_m)
        found = () if solid is None else solid.found
        shapes, stated_cover, words = with_found(known, cover, photograph, found)
        notes = (*notes, *words)
    done(0.7)
    terrain = {"elevation": "elevation.tif", "orthophoto": "orthophoto.tif" if picture else None,
               "height_reference": reference, "geoid_undulation_m": settings.geoid_undulation_m,
               "fill": settings.fill or None}  # fmt: skip
    tables: dict[str, Any] = {"title": Path(folder).resolve().name, "terrain": terrain}
    tables |= source_tables(picture is not None, day, settings, known is not None or shapes is not None)
    flight_m, flight = flight_text(bounds, texel_m)
    with atomic_folder(folder) as part:
        if solid is not None:
            tables = write_solid(part, solid, tables, GROUND_K if day is None else None)
            # Heights above the ground would follow each roof and crown.
            flight = flight.replace("above_ground_m", "up_m")
        else:
            _write_rasters(part, height, posts, picture)
        done(0.8)
        if far:
            placeholder = picture is not None and day is None
            tables["terrain"] = _with_far(part, far, tables["terrain"], reference, settings, placeholder)
        if settings.weather is not None:
            shutil.copyfile(settings.weather, part / weather_name(settings.weather))
        if shapes is not None:
            write_json(part / _KNOWN, shapes)
        elif known is not None:
            shutil.copyfile(known, part / _KNOWN)
        if photograph is not None:
            unexplained = write_unexplained(
                part, Path(folder), stated_cover, photograph, settings.material, lambda share: done(0.8 + 0.2 * share)
            )
            notes = (*notes, *unexplained)
        made_from = " and ".join(Path(path).name for path in (elevation, orthophoto) if path is not None)
        write_text(part / "scene.toml", toml_text(tables, f"Made from {made_from}."))
        write_text(part / "flight.csv", flight)
        if far:
            _try_far(part, Path(folder))
        done(1.0)
    return {
        "crs": crs.to_string(),
        "posts": [posts.height, posts.width],
        "post_m": post_m,
        "texels": [texels.height, texels.width],
        "texel_m": texel_m,
        "height_reference": reference,
        "height_reference_stated": stated,  # By the caller or the CRS
        "flight_m": flight_m,  # Height of flight.csv above the ground
        # Posts, their distance and whether it has an orthophoto, of each far ground
        "far": [([*own.height.shape], step_m(crs, own.posts), own.picture is not None) for own in far],
        "known": notes,  # Sentences on what was doubtful or left out in the files
        **(_solid_counts(solid) if solid else {}),
        **_height_shares(height, settings.fill),
        **_colour_shares(picture),
    }


def _with_far(
    part: Path, far: Sequence[FarGround], terrain: dict[str, Any], reference: str, settings: ImportSettings,
    placeholder: bool,
) -> dict[str, Any]:  # fmt: skip
    """The table [terrain] with far grounds, whose rasters are written to `part`; with `placeholder` temperatures, those
    without a picture have a constant one."""
    found = []
    for number, own in enumerate(far, 1):
        table = own.write(part, number)
        if "mesh" in terrain and settings.geoid_undulation_m is not None:
            table["height_reference"] = own.reference or reference
        # A learned map without a weather reads colours.
        found.append(table | {"temperature": GROUND_K if placeholder and not own.picture else None})
    if "mesh" in terrain and reference == "geoid":
        terrain = terrain | {"geoid_undulation_m": settings.geoid_undulation_m}
    return terrain | {"far": found}


def _try_far(part: Path, folder: Path) -> None:
    """Read a scene with far ground once: only then is known whether its grounds lie around one another."""
    try:
        read_files(read_scene(part), str(part / "scene.toml"))
    except ThermorenderError as error:
        raise ThermorenderError(str(error).replace(f"{part}/", "").replace(str(part), str(folder))) from None


def _check(settings: ImportSettings, orthophoto: Path | None, three_d: ThreeD | None) -> None:
    """Refuse settings that no scene can have, those that exclude each other, and one that needs another."""
    from thermorender.learned.temperature_map import load_model
    from thermorender.materials.library import find, load_library

    load_model(settings.model)
    library = load_library()
    within_band(find(library, settings.material, "material"), defaults.BAND_UM, library, "material")
    if settings.height_reference not in (None, "ellipsoid", "geoid"):
        raise ThermorenderError(
            f"height_reference={settings.height_reference!r} is not allowed; give ellipsoid or geoid"
        )
    _finite("geoid_undulation_m", settings.geoid_undulation_m)
    if settings.texel_m is not None and not 0.0 < settings.texel_m < np.inf:
        raise ThermorenderError(f"texel_m={settings.texel_m:g} is not a length; give metres above 0")
    if settings.sky_temperature is not None:
        _finite("sky_temperature", settings.sky_temperature)
        scene_kelvin("sky_temperature", settings.sky_temperature)
    if three_d and settings.fill:
        raise ThermorenderError("fill is for a raster of heights, and three_d makes a mesh; leave one of them out")
    if settings.known is not None and orthophoto is None and not three_d:
        raise ThermorenderError(
            f"known={settings.known} restricts materials that are read from an orthophoto; give one too"
        )
    if settings.max_vertices < 4 or settings.max_texels < 2:
        raise ThermorenderError(
            f"max_vertices={settings.max_vertices}, max_texels={settings.max_texels} are too small; give at least 4 "
            "and 2"
        )


def _read_heights(
    path: Path, settings: ImportSettings
) -> tuple[Cloud | None, NDArray[Any], Grid, tuple[str, ...], Bounds | None]:
    """(Point cloud or None, its or a raster's heights (h, w) [m], their Grid, sentences on doubtful ones, bounds of the
    square that is read or None)."""
    bounds, undeclared = None, undeclared_crs(settings)
    if Path(path).suffix.lower() in SUFFIXES:
        if settings.around is not None:
            raise ThermorenderError(
                f"around={settings.around} cuts rasters, and {path} is a point cloud; cut it, for example with "
                "`pdal translate`, or leave around out"
            )
        cloud = read_cloud(path)
        return cloud, cloud.surface, cloud.grid, tuple(cloud.notes), None
    if settings.around is None:
        height, grid = read_elevation(path, undeclared=undeclared)
    else:
        crs = map_crs(grid_of(path, any_size=True, undeclared=undeclared))
        square = square_around(settings.around, crs)
        height, grid, bounds = read_heights(path, crs, square, settings.max_vertices, undeclared)
    return None, height, grid, tuple(doubtful_zeros(path, height)), bounds


def weather_table(
    path: Path | None, time: str | None, height: NDArray[np.float64], grid: Grid
) -> dict[str, Any] | None:
    """The table [weather] of a file and an instant, both tried at the terrain's place; None without a file."""
    if path is None:
        if time is not None:
            raise ThermorenderError(f"time={time} is the instant of a weather; give weather too, or leave it out")
        return None
    if time is None:
        raise ThermorenderError(f"weather={path} needs the scene's instant; give time, such as 2018-07-28T14:30Z")
    when = instant("time", time)
    kind = "epw" if is_year_file(path) else "file"
    latitude, longitude = middle(grid)
    spec = WeatherSpec(when, epw=Path(path)) if kind == "epw" else WeatherSpec(when, file=Path(path))
    declared_weather(spec, latitude, longitude, float(np.nanmedian(height)))
    return {"time": utc_text(when), kind: weather_name(path)}


def weather_name(weather: Path) -> str:
    """Name of a weather file in the scene's folder."""
    return "weather" + Path(weather).suffix


def source_tables(
    pictured: bool, weather: dict[str, Any] | None, settings: ImportSettings, known: bool
) -> dict[str, Any]:
    """The scene file's tables of temperatures, materials, weather, sky and camera."""
    found: dict[str, Any] = {"source": "material", "material": settings.material}
    if pictured and (weather is not None or known):
        found = {"source": "learned", "model": defaults.EMISSIVITY_MAP, "fallback": settings.material,
                 "known": _KNOWN if known else None}  # fmt: skip
    sky_temperature = settings.sky_temperature
    if weather is not None:
        tables: dict[str, Any] = {"temperature": {"source": "balance"}, "weather": weather, "emissivity": found}
    else:
        placeholder = (
            {"source": "learned", "model": settings.model} if pictured else {"source": "constant", "value": GROUND_K}
        )
        tables = {"temperature": placeholder, "emissivity": found}
        sky_temperature = SKY_K if sky_temperature is None else sky_temperature
    if sky_temperature is not None:
        tables["sky"] = {"temperature": sky_temperature}
    return tables | {"camera": {"model": defaults.CAMERA}}


def _write_rasters(folder: Path, height: NDArray[Any], posts: Grid, picture: Picture | None) -> None:
    """Write elevation.tif and orthophoto.tif."""
    write_raster(folder / "elevation.tif", height[None].astype(np.float32), posts, nodata=np.nan, predictor=3)
    if picture:
        write_raster(folder / "orthophoto.tif", np.moveaxis(picture.rgb, -1, 0), picture.grid, predictor=2,
               photometric="RGB", mask=picture.valid)  # fmt: skip


def _solid_counts(solid: CityModel) -> dict[str, Any]:
    """Counts of what was found in the heights."""
    return {name: getattr(solid, name) for name in _FOUND}


def _height_shares(height: NDArray[Any], fill: bool) -> dict[str, float]:
    """Shares of the posts that stay without height, and that the scene fills."""
    given = np.isfinite(height)
    after = np.isfinite(filled(height)[0]) if fill else given
    return {"share_without_height": float(1.0 - after.mean()), "share_filled": float((after & ~given).mean())}


def _colour_shares(picture: Picture | None) -> dict[str, float | None]:
    """Shares of the texels without colour, near black or white up to the edge, and black or white in some band."""
    if picture is None:
        return dict.fromkeys(("share_without_colour", "share_collar", "share_clipped"))
    rgb, valid, _ = picture
    shown = np.where(valid[..., None], rgb, 0)
    return {
        "share_without_colour": float(1.0 - valid.mean()),
        "share_collar": float((empty_border(shown, COLLAR) & valid).mean()),
        "share_clipped": float((((rgb == 0) | (rgb == 255)).any(axis=-1) & valid).sum() / max(valid.sum(), 1)),
    }


def flight_text(bounds: Bounds, texel_m: float) -> tuple[float, str]:
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
