"""A scene of tiles from rasters of any size, in folders or virtual mosaics: its folder links to the files."""

import os
import shutil
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from thermorender.apps.lands.import_rasters import has_vertical_datum
from thermorender.apps.lands.import_settings import ImportSettings
from thermorender.apps.lands.import_terrain import GROUND_K, flight_text, source_tables, weather_name, weather_table
from thermorender.apps.lands.virtual_mosaic import files_of_mosaic
from thermorender.errors import ThermorenderError
from thermorender.files import atomic_folder, check_new_folder
from thermorender.formats import write_text
from thermorender.scene.folder import read_files
from thermorender.scene.raster import FORMATS, files_of, grid_of
from thermorender.scene.sources import rasters_of
from thermorender.scene.spec import read_scene
from thermorender.schema import toml_text

# Options of an import that resamples, which this one does not.
_RESAMPLING = ("fill", "texel_m", "crs", "bands", "colour_range", "collar", "known", "around", "far")
# Length of the flight that comes with the scene [m].
_FLOWN_M = 400.0


def import_tiles(elevation: Path, orthophoto: Path, folder: Path, settings: ImportSettings) -> dict[str, Any]:
    """Write a scene folder of rasters that stay as they are, and return a summary of what is in it.

    Each argument is a folder of rasters, one raster, or a virtual mosaic (.vrt) of some. The scene's folder gets hard
    links to the files, which take no room, so that it holds all of its data.
    """
    for name in _RESAMPLING:
        if getattr(settings, name):
            raise ThermorenderError(
                f"{name} changes the rasters, and tiles leaves them as they are; leave it out, or prepare the files"
            )
    check_new_folder(folder)
    given = {"elevation": _given(elevation), "orthophoto": _given(orthophoto)}
    first = grid_of(given["elevation"][0], any_size=True)
    stated = settings.height_reference is not None or has_vertical_datum(first.crs)
    reference = settings.height_reference or ("geoid" if stated else "ellipsoid")
    day = weather_table(settings.weather, settings.time, np.zeros(1), first)
    terrain = {"height_reference": reference, "geoid_undulation_m": settings.geoid_undulation_m,
               "tiles": {"elevation": "elevation", "orthophoto": "orthophoto"}}  # fmt: skip
    tables: dict[str, Any] = {"title": Path(folder).resolve().name, "terrain": terrain}
    tables |= source_tables(False, day, settings, False)
    if day is None:
        tables["temperature"] = {"source": "constant", "value": GROUND_K}
    with atomic_folder(folder) as part:
        for name, paths in given.items():
            (part / name).mkdir()
            names = [path.name for path in paths]
            ordered = names == sorted(names)
            for number, path in enumerate(paths):
                _link(path, part / name, "" if ordered else f"{number:05d}_")
        if settings.weather is not None:
            shutil.copyfile(settings.weather, part / weather_name(settings.weather))
        write_text(part / "scene.toml", toml_text(tables, f"Made from {elevation} and {orthophoto}."))
        try:
            world = read_files(read_scene(part), str(part / "scene.toml")).world
        except ThermorenderError as error:
            raise ThermorenderError(str(error).replace(f"{part}/", "").replace(str(part), str(folder))) from None
        assert world is not None
        x, y = (0.5 * (world.within[k] + world.within[k + 2]) for k in (0, 1))
        half = 0.5 * min(_FLOWN_M / 0.6, *(world.within[k + 2] - world.within[k] for k in (0, 1)))
        flight_m, flight = flight_text((x - half, y - half, x + half, y + half), world.grid.texel)
        write_text(part / "flight.csv", flight)
    left, bottom, right, top = world.within
    return {
        "side_m": (right - left, top - bottom),
        "texel_m": world.grid.texel,
        "post_m": world.heights.extent.pixel,
        "levels": world.grid.levels,
        "height_reference": reference,
        "height_reference_stated": stated,
        "flight_m": flight_m,
    }


def _given(path: Path) -> list[Path]:
    """The rasters of an argument."""
    found = files_of_mosaic(path) if path.suffix.lower() == ".vrt" else rasters_of(path)
    unread = [each for each in found if each.suffix.lower() not in FORMATS]
    if unread:
        raise ThermorenderError(f"{unread[0]} is not a raster that is read: give {', '.join(FORMATS)}, or convert it")
    twice = [name for name, count in Counter(each.name for each in found).items() if count > 1]
    if twice:
        raise ThermorenderError(f"{path} has two rasters called {twice[0]}; rename one, and make the mosaic again")
    return found


def _link(path: Path, folder: Path, before: str) -> None:
    """Link a raster and the files beside it that GDAL reads with it, with a text before their names, which order them:
    the last one lies on the others."""
    for each in files_of(path, any_size=True):
        place = folder / f"{before}{Path(each).name}"
        if place.exists() and os.path.samefile(each, place):
            # Several rasters may share a file.
            continue
        try:
            os.link(os.path.realpath(each), place)
        except OSError as error:
            raise ThermorenderError(
                f"{each} cannot be linked into the scene ({error.strerror}); write the scene to the drive of its "
                "rasters"
            ) from None
