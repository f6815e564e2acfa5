"""Scenes that the start page lists: the shipped ones and those that this user opened lately, with what their files say.

The latter are in a file of the cache folder. An entry that cannot be read, or is gone, is left out.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from thermorender import defaults
from thermorender.cache import cache_folder
from thermorender.errors import ThermorenderError
from thermorender.formats import encoded_image, finite_json, write_json
from thermorender.paths import data_folder, inside
from thermorender.scene.orthophoto import read_colour
from thermorender.scene.raster import grid_of, window_of
from thermorender.scene.spec import SceneSpec, read_scene

# Recent scenes that are kept, and about how many pixels a picture has.
_MOST, _PIXELS = 12, 60_000
# A scene in three dimensions may have a survey from above, a scene of rasters, in this folder.
_SURVEY = "survey"
_SOURCES = {
    "constant": "one temperature", "raster": "temperatures of a raster", "material": "temperatures by material",
    "learned": "temperatures of a learned map", "balance": "temperatures of a heat balance",
}  # fmt: skip


@dataclass(frozen=True)
class Listed:
    """A scene that can be opened: its folder, its title, its size and temperatures in words, and its orthophoto."""

    folder: Path
    title: str
    about: str
    orthophoto: Path | None

    def picture(self) -> bytes:
        """Return a small JPEG of the orthophoto."""
        if self.orthophoto is None:
            raise ThermorenderError(f"{self.folder} has no orthophoto; list the scenes again")
        return _picture(self.orthophoto, self.orthophoto.stat().st_mtime_ns)


def listed() -> tuple[list[Listed], list[Listed]]:
    """Return the shipped scenes, and those that were opened lately, the latest first."""
    shipped = data_folder("scenes")
    recent = [each for name in _recent() if (each := _listed(name, shipped))]
    return [_of_spec(read_scene(shipped / name)) for name in defaults.SCENES], recent


def remember(folder: Path) -> str | None:
    """Put a scene's folder first among the recent ones; return None, or why that failed."""
    name, path = str(folder), Path()
    try:
        path = _file()
        write_json(path, [name, *(each for each in _recent() if each != name)][:_MOST])
    except (OSError, RuntimeError, ThermorenderError) as error:
        # RuntimeError: no home folder exists.
        return f"recent scenes are not kept: {error}; set THERMORENDER_CACHE to a writable folder"
    return None


def _file() -> Path:
    return cache_folder("studio") / "recent.json"


def _recent() -> list[str]:
    """The folders in the file of recent scenes; [] without one, or where it is damaged."""
    try:
        found = finite_json(_file().read_text("utf-8"))
    except (OSError, RuntimeError, ValueError):
        return []
    return [each for each in found if isinstance(each, str) and Path(each).is_absolute()][:_MOST] \
        if isinstance(found, list) else []  # fmt: skip


def _listed(name: str, shipped: Path) -> Listed | None:
    """A scene of the user as it is listed; None where it cannot be read, or is listed as shipped."""
    try:
        return None if inside(name, shipped) else _of_spec(read_scene(name))
    except (OSError, ValueError, ThermorenderError):
        return None


def _of_spec(spec: SceneSpec) -> Listed:
    terrain = spec.terrain
    if terrain.orthophoto is None and (spec.folder / _SURVEY / "scene.toml").is_file():
        terrain = read_scene(spec.folder / _SURVEY).terrain
    of_terrain = "true temperatures" if spec.truth_temperature is True else _SOURCES[spec.temperature.source]
    words = [*_size(terrain.orthophoto or terrain.elevation), of_terrain]
    return Listed(spec.folder, spec.title, " · ".join(words), terrain.orthophoto)


def _size(raster: Path | None) -> Iterator[str]:
    """The size of a raster on a map in metres, in words."""
    if raster is None:
        return
    grid = grid_of(raster, any_size=True)
    if grid.crs.is_projected:
        metres = grid.crs.linear_units_factor[1]
        left, bottom, right, top = (metres * each for each in grid.bounds)
        far = max(right - left, top - bottom) >= 1e3
        across, along = ((f"{each / 1e3:.2g}" if far else f"{each:.0f}") for each in (right - left, top - bottom))
        yield f"{across} × {along} {'km' if far else 'm'}"


@lru_cache(64)
def _picture(path: Path, changed_ns: int) -> bytes:
    """The picture of an orthophoto; `changed_ns` tells its versions apart."""
    grid = grid_of(path)
    rgb, valid = read_colour(path, part=window_of(path, grid.crs, grid.bounds, _PIXELS))
    rgb[~valid] = 128
    return encoded_image(".jpg", rgb)
