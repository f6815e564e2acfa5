"""Arguments of edits (a number, a word, a path or some keys) converted to declarations of a scene."""

from collections.abc import Mapping
from dataclasses import fields, replace
from numbers import Real
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from thermorender.errors import ThermorenderError, shortened
from thermorender.materials import library as material_tables
from thermorender.materials.material import Material, grey
from thermorender.scene.parts.tracks import COLUMNS
from thermorender.scene.raster import FORMATS
from thermorender.scene.spec import ObjectSpec, TemperatureSpec, WeatherSpec
from thermorender.scene.state.declared import Declared
from thermorender.scene.surface import scene_kelvin
from thermorender.schema import Where, did_you_mean

# Keys of [weather] that say where the weather comes from, each with the keys that belong to it.
_KINDS = {
    "file": ("longest_gap_h", "air_height_m", "wind_height_m"),
    "epw": (),
    "air_high_c": ("air_low_c", "humidity", "wind_m_s", "cloud"),
}


def material_of(key: int | str, value: Any, library: Mapping[str, Material]) -> Material:
    """Return the Material that replaces `key`: by name, by grey emissivity, or as it is."""
    if isinstance(value, Material):
        return value
    if isinstance(value, str):
        return material_tables.find(library, value, f"with_material: {key}")
    if isinstance(value, bool) or not isinstance(value, Real):
        raise ThermorenderError(
            f"with_material: {key}={shortened(repr(value))} is not a material; give a name, an emissivity above 0 and "
            "up to 1, or a Material"
        )
    if not 0.0 < float(value) <= 1.0:
        raise ThermorenderError(f"with_material: {key}={value} is not allowed; give an emissivity above 0 and up to 1")
    return grey(str(key), float(value))


def temperature_spec(source: Any) -> TemperatureSpec:
    """Return the TemperatureSpec for a number, a word or a path."""
    if isinstance(source, TemperatureSpec):
        return source
    if isinstance(source, Real) and not isinstance(source, bool):
        value = float(source)
        scene_kelvin("with_temperature", value)
        return TemperatureSpec(source="constant", value=value)
    if isinstance(source, (str, PathLike)):
        if str(source) == "balance":
            return TemperatureSpec(source="balance")
        path = Path(source)
        if path.suffix.lower() in FORMATS:
            if not path.is_file():
                raise ThermorenderError(f"with_temperature: {path} does not exist; give a raster of kelvin")
            return TemperatureSpec(source="raster", raster=path)
        return TemperatureSpec(source="learned", model=str(source))
    raise ThermorenderError(
        f"with_temperature was given a {type(source).__name__}; give kelvin, the path of a raster, the name or path of "
        "a learned map, 'balance' or a TemperatureSpec"
    )


def changed_weather(spec: WeatherSpec | None, keys: Mapping[str, Any], now: Declared, whole: bool) -> WeatherSpec:
    """Return a WeatherSpec with other values of some keys; `whole`: it must name the source of the weather."""
    rows = {item.name: item for item in fields(WeatherSpec)}
    where = Where("with_weather", now.spec.folder, top="")
    for name in keys:
        if name not in rows:
            raise where.error(f"unknown key {name!r}; {did_you_mean(name, rows)}allowed are {', '.join(rows)}")
    values = {name: row.metadata["read"](keys[name], where.of(name)) for name, row in rows.items() if name in keys}
    kept: dict[str, Any] = {}
    if spec is not None:
        kept = {name: getattr(spec, name) for name in rows if getattr(spec, name) != rows[name].default}
        for kind, others in _KINDS.items():
            if kind not in keys and any(other in keys for other in _KINDS):
                for name in {kind, *others} - set(keys):
                    kept.pop(name, None)
    kept |= values
    if "time" not in kept:
        raise where.error("time is missing; add it, as the scene has none")
    made = WeatherSpec(**kept)
    if whole:
        made.check(where, kept)
    return made


def changed_object(item: ObjectSpec, values: Mapping[str, float]) -> ObjectSpec:
    """Return an ObjectSpec with other values of some columns of a track."""
    position = dict(zip(COLUMNS[:3], item.position, strict=True))
    found: dict[str, Any] = {}
    for column, value in values.items():
        what = f"object {item.name!r}: {column}"
        if column not in COLUMNS:
            raise ThermorenderError(f"object {item.name!r} has no {column!r} to set; give {', '.join(COLUMNS)}")
        finite = isinstance(value, Real) and not isinstance(value, bool)
        if not finite or (column != "temperature_k" and not np.isfinite(float(value))):
            raise ThermorenderError(f"{what}={shortened(repr(value))} is not allowed; give a finite number")
        if column == "temperature_k":
            found["temperature"] = float(scene_kelvin(what, float(value)))
        elif column == "yaw_deg":
            found["yaw_deg"] = float(value)
        else:
            position[column] = float(value)
    east, north, above = position.values()
    return replace(item, position=(east, north, above), **found)
