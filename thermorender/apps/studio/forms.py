"""The forms of the start page: their fields, what is made of the texts in them, and which one a fault is about."""

import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from thermorender import defaults
from thermorender.apps.lands.import_settings import ImportSettings, ThreeD
from thermorender.errors import ThermorenderError
from thermorender.materials.csv_tables import decimal
from thermorender.progress import Progress

# Texts of a form by the keys of its fields; a flag is "" or "yes".
Texts = Mapping[str, str]
_PLACEHOLDER = (
    "temperatures of the imported terrain are a placeholder, not those of this place at any hour; import it with a "
    "weather file and an hour for a heat balance"
)


@dataclass(frozen=True)
class Field:
    """A field of a form: its key, which is the name of an argument, and its words."""

    key: str
    label: str
    hint: str = ""
    kind: Literal["text", "file", "folder", "flag", "choice"] = "text"
    rare: bool = False  # Shown on demand
    value: str = ""


IMPORT = (
    Field("elevation", "Elevation", "GeoTIFF of heights, or a point cloud as LAS or LAZ", "file"),
    Field("orthophoto", "Orthophoto, if there is one", "GeoTIFF in colour of the same area", "file"),
    Field("output", "New folder for the scene", kind="folder"),
    Field("texel_m", "Least side of a texel [m]", "empty: the orthophoto's pixels; larger ones open faster", rare=True),
    Field("around", "Only a square", "LATITUDE,LONGITUDE,SIDE in degrees and metres, of files of any size", rare=True),
    Field("crs", "CRS of files that state none", "such as EPSG:25833", rare=True),
    Field("bands", "Red, green and blue bands", "such as 3,2,1, where the orthophoto does not declare them", rare=True),
    Field("colour_range", "Values of black and white", "such as 0,4095 for 12 bits", rare=True),
    Field("weather", "Weather file", "station CSV, EPW or TMY3, for a heat balance", "file", rare=True),
    Field("time", "Date and hour", "with their zone, 2018-07-28T14:30+02:00", rare=True),
    Field("three_d", "Walls below roofs and porous trees, from posts of 1 m or less", kind="flag", rare=True),
)
PRACTICE = (
    Field("kind", "Kind", kind="choice", value=defaults.SCENES[0]),
    Field("size_m", "Side [m]", value="60"),
    Field("output", "New folder for the scene", kind="folder"),
    Field("solid", "Walls and trees in three dimensions", kind="flag"),
)
_PATHS = {each.key for each in (*IMPORT, *PRACTICE) if each.kind in ("file", "folder")}
# Entries of a folder that a path is completed from.
_LISTED = 1000
# Texels of a practice scene [m], in whose multiples its side is.
_TEXEL_M = 0.5


def imported(texts: Texts, progress: Progress) -> tuple[Path, list[str]]:
    """Import a terrain as the form says; return (the scene's folder, sentences on what is doubtful)."""
    from thermorender.apps.lands.import_terrain import import_terrain

    if not texts["elevation"]:
        raise ThermorenderError("elevation is empty; give the path of a GeoTIFF of heights")
    folder, orthophoto = _new_folder(texts), path_of(texts["orthophoto"]) if texts["orthophoto"] else None
    settings = ImportSettings(
        texel_m=_number("texel_m", texts["texel_m"]) if texts["texel_m"] else None,
        weather=path_of(texts["weather"]) if texts["weather"] else None,
        time=texts["time"] or None,
        around=texts["around"] or None,
        crs=texts["crs"] or None,
        bands=texts["bands"] or None,
        colour_range=texts["colour_range"] or None,
    )
    three_d = ThreeD() if texts["three_d"] else None
    made = import_terrain(path_of(texts["elevation"]), orthophoto, folder, settings, three_d, progress)
    return folder, [*made["known"], *([] if settings.weather else [_PLACEHOLDER])]


def made(texts: Texts, progress: Progress) -> tuple[Path, list[str]]:
    """Make a practice scene as the form says; return (its folder, no sentences)."""
    from thermorender.apps.lands.procedural.make_scene import make_scene

    folder, size_m = _new_folder(texts), _number("size_m", texts["size_m"])
    made_folder = make_scene(
        texts["kind"], folder, size_m=size_m, texel_m=_TEXEL_M, post_m=2.0 * _TEXEL_M, draped=not texts["solid"],
        progress=progress,
    )  # fmt: skip
    return made_folder, []


def _new_folder(texts: Texts) -> Path:
    if not texts["output"]:
        raise ThermorenderError("output is empty; give the path of a folder to make")
    return path_of(texts["output"])


def _number(key: str, text: str) -> float:
    try:
        return decimal(text)
    except ValueError:
        raise ThermorenderError(f"{key}={text!r} is not a number; give metres, such as 0.5") from None


def path_of(text: str) -> Path:
    """Return the path that a text names on this machine; ~ is the user's folder."""
    try:
        return Path(text.strip()).expanduser()
    except RuntimeError:
        raise ThermorenderError(f"{text!r} names the folder of an unknown user; give the whole path") from None


def about(sentence: str, texts: Texts) -> str:
    """Return the key of the field that a fault is about: the one whose key, or whose path, comes first; "" for none."""
    found = []
    for key, text in texts.items():
        words = [rf"{key}(?:=| is )"]
        with suppress(ThermorenderError):
            words += [re.escape(str(path_of(text)))] if key in _PATHS and text else []
        place = re.search(rf"(?<![\w/])(?:{'|'.join(words)})", sentence)
        # Of two paths where one begins with the other, the longer one.
        found += [(place.start(), -len(text), key)] if place else []
    return min(found)[2] if found else ""


def completions(text: str, folders_only: bool) -> list[str]:
    """Return the paths on this machine that begin with a text, at most 50."""
    try:
        path = Path(text).expanduser()
        folder, begun = (path, "") if text.endswith(("/", "\\")) else (path.parent, path.name)
        found = sorted(each for each in folder.iterdir() if each.name.startswith(begun) and each.name[0] != ".")
        kept = [each for each in found[:_LISTED] if each.is_dir() or not folders_only][:50] if text else []
    except (OSError, RuntimeError, ValueError):
        return []
    typed = text[: len(text) - len(begun)]
    return [f"{typed}{each.name}{'/' if each.is_dir() else ''}" for each in kept]
