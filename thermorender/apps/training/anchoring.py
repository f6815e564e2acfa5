"""The MapAnchor that an option states: `air=KELVIN`, or a CSV of known temperatures of pixels.

Columns of the CSV are `column`, `row`, `kelvin` and, with several pictures, `picture`, a file's name. Pixels count from
0 at the upper left, and temperatures are apparent ones, such as of water or a matt marker. One MapAnchor holds for all
pictures, so these should be of one hour and weather, and without sky. Of a video the first frame is meant.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from thermorender import files, formats
from thermorender.apps.training.translate import (
    RECORD,
    VIDEOS,
    Translation,
    UnreadableError,
    first_frame,
    read_picture,
    sources_of,
)
from thermorender.errors import ThermorenderError
from thermorender.learned.anchor import MapAnchor, anchored_to_air, anchored_to_known
from thermorender.learned.temperature_map import TemperatureMap
from thermorender.sensor.radiometric_files import TLINEAR_STEP_K
from thermorender.trajectory.tables import rows_of
from thermorender.units import kelvin

_COLUMNS = ("column", "row", "kelvin")
# Warmest temperature that results hold, and warmest air [K].
_MOST_K, _WARMEST_AIR_K = 65535 * TLINEAR_STEP_K, 350.0
# Most pictures that the level of a map is taken from, evenly spaced.
_MOST = 20
_WANTED = "give air=KELVIN, such as air=288.2, or a .csv with the columns column, row, kelvin"


def anchor_of(
    text: str, model: TemperatureMap, paths: Sequence[files.PathLike], texel_m: float | None = None,
    begun: Path | None = None,
) -> MapAnchor:  # fmt: skip
    """Return the MapAnchor of a text for pictures and videos, or folders of them, as `translate` takes them.

    `begun` is the folder of a translation that is continued: further pictures do not change the line of its air.
    """
    return replace(_of_text(text, model, paths, texel_m, begun), stated=text)


def _of_text(
    text: str, model: TemperatureMap, paths: Sequence[files.PathLike], texel_m: float | None, begun: Path | None
) -> MapAnchor:
    """The MapAnchor of a text, without it."""
    name, equals, value = text.partition("=")
    if equals and name.strip() == "air":
        try:
            air_k = float(value.strip().removesuffix("K"))
        except ValueError:
            raise ThermorenderError(f"anchor={text!r}: {value!r} is not a number; {_WANTED}") from None
        air_k = _at_most(_WARMEST_AIR_K, f"anchor={text!r}: air", kelvin(f"anchor={text!r}: air", air_k))
        # Refused before pictures are read.
        anchored_to_air(model, air_k, air_k, 0.0)
        if begun is not None and (before := _recorded(begun, text)) is not None:
            return before
        sources = sources_of(paths)
        some = [sources[k] for k in np.unique(np.linspace(0, len(sources) - 1, min(_MOST, len(sources))).astype(int))]
        maps = [found for found in (_mapped_if_readable(each, model, texel_m) for each in some) if found is not None]
        if not any(found.any() for found in maps):
            raise ThermorenderError(
                f"anchor={text!r}: none of the {len(some)} pictures that were tried has a pixel with a temperature; "
                "give opaque pictures that can be read"
            )
        return anchored_to_air(model, air_k, float(np.concatenate([each[each > 0.0] for each in maps]).mean()),
                               _spread(maps))  # fmt: skip
    if not text.lower().endswith(".csv"):
        raise ThermorenderError(f"anchor={text!r} is not known; {_WANTED}")
    return _known_anchor(Path(text), model, sources_of(paths), texel_m)


def _known_anchor(path: Path, model: TemperatureMap, sources: Sequence[Path], texel_m: float | None) -> MapAnchor:
    """The MapAnchor of a CSV's known temperatures."""
    mapped, known, maps = [], [], []
    for source, rows in _by_picture(path, sources).items():
        found = _mapped(source, model, texel_m)
        for where, (column, row, value) in rows:
            height, width = found.shape
            if not (0 <= column < width and 0 <= row < height):
                raise ThermorenderError(
                    f"{where}: column={column}, row={row} is outside of {source.name}; give 0…{width - 1} and "
                    f"0…{height - 1}"
                )
            if not found[row, column]:
                raise ThermorenderError(f"{where}: the map has no temperature there; take another pixel")
            mapped.append(found[row, column])
            known.append(value)
        maps.append(found)
    return anchored_to_known(model, np.array(known), np.array(mapped), _spread(maps))


def _recorded(folder: Path, text: str) -> MapAnchor | None:
    """The MapAnchor of a text in the record of a translation; None without one."""
    try:
        record = formats.finite_json((folder / RECORD).read_text(encoding="utf-8"))["anchor"]
        return MapAnchor(float(record["offset_k"]), float(record["span"])) if record["stated"] == text else None
    # Whatever stands there instead is refused where the settings are compared.
    except (OSError, ValueError, KeyError, TypeError, ThermorenderError):
        return None


def _at_most(most_k: float, where: str, value: float) -> float:
    """A temperature [K] that is no typing error and that results can hold."""
    if not value <= most_k:
        raise ThermorenderError(f"{where}={value:g} is not allowed; give at most {most_k:g} K")
    return value


def _mapped_if_readable(source: Path, model: TemperatureMap, texel_m: float | None) -> np.ndarray | None:
    """As `_mapped`, or None for a file that cannot be read, which `translate` names."""
    try:
        return _mapped(source, model, texel_m)
    except UnreadableError:
        return None


def _mapped(source: Path, model: TemperatureMap, texel_m: float | None) -> np.ndarray:
    """Temperatures of a picture by a map, (h, w) float64 [K]; 0 where there is none."""
    picture, opaque = (first_frame(source), None) if source.suffix.lower() in VIDEOS else read_picture(source)
    counts, _ = Translation(model, texel_m).translated(picture, opaque)
    return counts * TLINEAR_STEP_K


def _spread(maps: Sequence[np.ndarray]) -> float:
    """Root mean square of the standard deviations within pictures' temperatures, each (h, w) [K]."""
    return float(np.sqrt(np.mean([found[found > 0.0].var() if found.any() else 0.0 for found in maps])))


def _by_picture(path: Path, sources: Sequence[Path]) -> dict[Path, list[tuple[str, tuple[int, int, float]]]]:
    """{picture: [(file and row for messages, (column, row, kelvin)), …]} of a CSV."""
    head, rows = rows_of(path)
    if any(name not in head for name in _COLUMNS):
        raise ThermorenderError(f"{path} has the columns {', '.join(head)}; give {', '.join(_COLUMNS)}")
    if "picture" not in head and len(sources) > 1:
        raise ThermorenderError(
            f"{path} has no column 'picture', and {len(sources)} pictures are translated; add that column with their "
            "file names, or translate one picture"
        )
    names = {source.name: source for source in sources}
    found: dict[Path, list[tuple[str, tuple[int, int, float]]]] = {}
    for where, row in rows:
        name = row.get("picture", sources[0].name)
        if name not in names:
            raise ThermorenderError(f"{where}: picture={name!r} is not translated; give {', '.join(list(names)[:5])}")
        numbers = []
        for column in _COLUMNS:
            try:
                numbers.append(float(row[column]))
            except ValueError:
                numbers.append(np.nan)
            if not np.isfinite(numbers[-1]):
                raise ThermorenderError(f"{where}: {column}={row[column]!r} is not allowed; give a number")
        known_k = _at_most(_MOST_K, f"{where}: kelvin", kelvin(f"{where}: kelvin", numbers[2]))
        across, down = (int(np.clip(each, -1.0, 2.0**31) // 1) for each in numbers[:2])
        before = found.setdefault(names[name], [])
        if any(place[:2] == (across, down) for _, place in before):
            raise ThermorenderError(f"{where}: column={across}, row={down} is stated twice; give each pixel once")
        before.append((where, (across, down, known_k)))
    return found
