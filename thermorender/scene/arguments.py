"""Arguments of edits (a number, a word, a path or some keys) converted to declarations of a scene."""

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from numbers import Real
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError, shortened
from thermorender.materials import library as material_tables
from thermorender.materials.material import Material, grey
from thermorender.scene.declared import Declared
from thermorender.scene.raster import FORMATS
from thermorender.scene.spec import BALANCE, ObjectSpec, SceneSpec, SurfaceSpec, TemperatureSpec, WeatherSpec
from thermorender.scene.surface import Surface, scene_kelvin
from thermorender.scene.tracks import COLUMNS
from thermorender.schema import Where, did_you_mean
from thermorender.units import Stated, with_unit

if TYPE_CHECKING:
    from thermorender.scene.scene import Scene

_Spec = TypeVar("_Spec", bound=Any)
# Of a scene: texels number them in a byte.
_MOST_MATERIALS = 255

# The key of an object that edits change and tracks do not have.
_INNER = "inner_heat_w"
# Keys of [weather] that no Weather holds.
_OF_SCENE = {"time", "inside_c", "albedo", "albedo_std"}
# Keys of [weather] that say where the weather comes from, each with the keys that belong to it.
_KINDS = {
    "file": ("longest_gap_h", "air_height_m", "wind_height_m"),
    "epw": ("light_shift_min",),
    "air_high_c": ("air_low_c", "humidity", "wind_m_s", "cloud"),
}


def material_of(key: int | str, value: Any, library: Mapping[str, Material], edit: str = "with_material") -> Material:
    """Return the Material that replaces `key`: by name, by grey emissivity, or as it is; `edit` is for messages."""
    if isinstance(value, Material):
        return value
    if isinstance(value, str):
        return material_tables.find(library, value, f"{edit}: {key}")
    if isinstance(value, bool) or not isinstance(value, Real):
        raise ThermorenderError(
            f"{edit}: {key}={shortened(repr(value))} is not a material; give a name, an emissivity above 0 and "
            "up to 1, or a Material"
        )
    if not 0.0 < float(value) <= 1.0:
        raise ThermorenderError(f"{edit}: {key}={value} is not allowed; give an emissivity above 0 and up to 1")
    return grey(str(key), float(value))


def checked_spec(spec: _Spec, name: str, folder: Path, given: Iterable[str] = ()) -> _Spec:
    """Return scene-file keys made in code, each checked by its reader.

    Keys in `given` are set elsewhere and may be missing.
    """
    where, found, read = Where(name, top=""), {}, {}
    for item in fields(spec):
        value = getattr(spec, item.name)
        if "read" not in item.metadata or value is None or value is item.default or not (value or value == 0):
            continue
        found[item.name] = value
        if isinstance(value, PathLike):
            if not os.path.isfile(value):
                raise where.error(f"{item.name}={str(value)!r} does not exist; give a file")
        elif is_dataclass(value):
            read[item.name] = checked_spec(value, f"{name}: {item.name}", folder)
        elif not (item.name == "model" and str(value).endswith(".npz")):
            value = list(value) if isinstance(value, tuple) else value
            read[item.name] = item.metadata["read"](value, where.of(item.name))
    made: _Spec = replace(spec, **read)
    replace(made, **dict.fromkeys(given, "given")).check(where, found)
    return made


def refuse_other(edit: str, value: Any, allowed: str) -> None:
    """Refuse a value that is not a dict."""
    if not isinstance(value, Mapping):
        raise ThermorenderError(f"{edit} was given a {type(value).__name__}; give {allowed}")


def number_of(what: str, value: Any, none: str = "") -> float:
    """Return a finite float; `none` says what None would mean, if it is not allowed."""
    if isinstance(value, Real) and not isinstance(value, bool) and np.isfinite(float(value)):
        return value if isinstance(value, Stated) else float(value)
    raise ThermorenderError(f"{what}={shortened(repr(value))} is not allowed; give a finite number{none}")


def kelvin_argument(
    what: str, values: Any, surfaces: Sequence[Surface], no_data: bool
) -> tuple[NDArray[np.float32], ...]:
    """Return read-only copies of temperatures of surfaces' texels [K], checked; NaN is allowed with `no_data` only."""
    shapes = [surface.flags.shape for surface in surfaces]
    advice = f"give {len(shapes)} array{'s' if len(shapes) > 1 else ''} of kelvin, of shape {shapes[0]}" + (
        f" … {shapes[-1]}" if len(shapes) > 1 else ""
    )
    if isinstance(values, (str, bytes)) or not isinstance(values, Iterable):
        raise ThermorenderError(f"{what}={shortened(repr(values))} is not allowed; {advice}")
    found = []
    for one in values:
        try:
            found.append(np.array(one, np.float32))
        except (TypeError, ValueError):
            raise ThermorenderError(f"{what} holds {shortened(repr(one))}; {advice}") from None
    if [one.shape for one in found] != shapes and [one.size for one in found] != [int(np.prod(s)) for s in shapes]:
        shown = ", ".join(str(one.shape) for one in found) or "nothing"
        raise ThermorenderError(f"{what} holds arrays of shape {shown}; {advice}")
    for one in (found := [one.reshape(shape) for one, shape in zip(found, shapes, strict=True)]):
        _check_kelvin(what, one, no_data, advice)
        one.flags.writeable = False
    return tuple(found)


def _check_kelvin(what: str, kelvin: NDArray[np.float32], no_data: bool, advice: str) -> None:
    """Refuse temperatures of one surface (h, w) [K] that a scene cannot have, and NaN that `no_data` does not allow."""
    known = ~np.isnan(kelvin)
    if not known.all() and not (no_data and known.any()):
        why = "no number" if not known.any() else f"{(~known).sum()} values that are not a number"
        raise ThermorenderError(f"{what} holds {why}; {advice}")
    scene_kelvin(what, kelvin[known])


def flags_argument(flags: Any, surfaces: Sequence[Surface]) -> list[NDArray[np.uint8]]:
    """Return copies of the flags of surfaces' texels that `with_solved_temperatures` was given, checked."""
    found = [np.array(own, np.uint8) for own in flags]
    shapes = [surface.flags.shape for surface in surfaces]
    if [own.shape for own in found] != shapes:
        raise ThermorenderError(
            f"with_solved_temperatures: flags have the shapes {[own.shape for own in found]}; give {shapes}"
        )
    return found


def surfaces_argument(
    surfaces: Any, materials: Any, terrain_count: Any, scene: "Scene"
) -> tuple[tuple[Surface, ...], tuple[Material, ...], int]:
    """Return (surfaces with own copies of the arrays, materials, count of terrain) of `with_surfaces`, checked."""
    if surfaces is not None:
        _check_list("surfaces", surfaces, Surface)
    if materials is not None:
        _check_list("materials", materials, Material)
    made = tuple(scene.materials if materials is None else materials)
    if len(made) > _MOST_MATERIALS:
        raise ThermorenderError(f"with_surfaces was given {len(made)} materials; give {_MOST_MATERIALS} at most")
    shown = scene.surfaces
    if surfaces is not None:
        for surface in surfaces:
            known = surface.temperature[np.isfinite(surface.temperature)]
            if known.size:
                scene_kelvin(f"with_surfaces: temperature of {surface.name!r}", known)
        shown = tuple(surface.copied() for surface in surfaces)
    count = scene.terrain_count if terrain_count is None else terrain_count
    if not isinstance(count, int) or not 1 <= count <= len(shown):
        raise ThermorenderError(
            f"with_surfaces: terrain_count={count!r} is not allowed; give a whole number 1…{len(shown)}, as there are "
            f"{len(shown)} surfaces"
        )
    unknown = [each.name for each in shown[count:] if not np.isfinite(each.temperature).all()]
    if surfaces is not None and unknown:
        raise ThermorenderError(
            f"with_surfaces: texels of object {unknown[0]!r} have no temperature; give kelvin, such as those that "
            "Renderer(scene).scene has solved"
        )
    highest = max(int(surface.material.max(initial=0)) for surface in shown)
    if highest >= len(made):
        raise ThermorenderError(
            f"{scene.where}: a texel has material number {highest}, but there are {len(made)} materials; give one for "
            "each number"
        )
    return shown, made, count


def _check_list(name: str, values: Any, kind: type) -> None:
    """Refuse an argument of `with_surfaces` other than a list of one `kind`, and an empty one."""
    what = "with_surfaces was given"
    if isinstance(values, (str, bytes)) or not isinstance(values, Iterable):
        raise ThermorenderError(f"{what} {name}={shortened(repr(values))}; give a list of {kind.__name__}")
    odd = [value for value in values if not isinstance(value, kind)]
    if odd or not list(values):
        sort = f"a {type(odd[0]).__name__} among its {name}" if odd else f"no {name}"
        raise ThermorenderError(f"{what} {sort}; give at least one {kind.__name__}")


def temperature_spec(source: Any, folder: Path, kelvin: bool = False) -> TemperatureSpec:
    """Return the TemperatureSpec for a number, a word or a path; with `kelvin`, it may lack the source's file."""
    if isinstance(source, TemperatureSpec):
        file = {"raster": ("raster",), "learned": ("model",)}.get(source.source, ())
        return checked_spec(source, "with_temperature", folder, file if kelvin else ())
    source = with_unit(source)
    if isinstance(source, Real) and not isinstance(source, bool):
        value = number_of("with_temperature", source)
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


def surface_temperatures(spec: SceneSpec, given: Mapping[str, Any]) -> SceneSpec:
    """Return a SceneSpec in which parts of a mesh have other temperatures, [K] or a raster's path by their names."""
    if not spec.terrain.mesh:
        raise ThermorenderError(
            "with_temperature: a dict gives temperatures to parts of a mesh, and this terrain is an elevation raster; "
            "give one source"
        )
    surfaces = {one.name: one for one in spec.surfaces}
    for name, value in given.items():
        what = f"with_temperature: {name}"
        if isinstance(value, (str, PathLike)) and not isinstance(with_unit(value), Stated):
            found: float | Path = Path(value)
            if not os.path.isfile(value):
                raise ThermorenderError(f"{what}={str(value)!r} does not exist; give kelvin, or a raster of kelvin")
        else:
            found = scene_kelvin(what, number_of(what, with_unit(value)))
        surfaces[name] = replace(surfaces.get(name, SurfaceSpec(name=name)), temperature=found)
    return replace(spec, surfaces=tuple(surfaces.values()))


def weather_argument(weather: Any, keys: Mapping[str, Any], now: Declared) -> tuple[WeatherSpec, Any]:
    """Return (keys of [weather], Weather in place of its file or None) of the arguments of `with_weather`."""
    series = now.given_weather if weather is None and set(keys) <= _OF_SCENE else None
    spec = now.spec.weather
    if isinstance(weather, WeatherSpec):
        spec = checked_spec(weather, "with_weather", now.spec.folder)
    elif weather is not None:
        if not all(hasattr(weather, name) for name in ("time", "at", "sun")):
            raise ThermorenderError(
                f"with_weather was given a {type(weather).__name__}; give a WeatherSpec, a Weather or keys of [weather]"
            )
        series = weather
        measured = sorted(set(keys) - _OF_SCENE)
        if measured:
            raise ThermorenderError(
                f"with_weather was given a Weather and {measured[0]}={keys[measured[0]]!r}, which the Weather "
                "measures; change the Weather, or give the keys without it"
            )
        if spec is None and "time" not in keys:
            raise ThermorenderError(f"{now.where}: with_weather needs time=…, because the scene has none; add it")
    if keys:
        spec = _changed_weather(spec, keys, now, series is None)
    assert spec is not None
    return spec, series


def _changed_weather(spec: WeatherSpec | None, keys: Mapping[str, Any], now: Declared, whole: bool) -> WeatherSpec:
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


def objects_under(source: str, objects: Sequence[ObjectSpec], file: "SceneSpec | None") -> tuple[ObjectSpec, ...]:
    """Return ObjectSpecs; those with the key `follows_balance` are solved by a heat balance of the terrain, else they
    have the kelvin of the scene's file.
    """
    known = {} if file is None else {item.name: item.temperature for item in file.objects}
    return tuple(
        replace(item, temperature=None if source == BALANCE else known.get(item.name)) if item.follows_balance else item
        for item in objects
    )


def changed_object(item: ObjectSpec, values: Mapping[str, Any]) -> ObjectSpec:
    """Return an ObjectSpec with another inner heat, or other values of some columns of a track.

    Kelvin in place of a heat balance leave no inner heat.
    """
    position = dict(zip(COLUMNS[:3], item.position, strict=True))
    found: dict[str, Any] = {}
    for column, value in values.items():
        what = f"object {item.name!r}: {column}"
        if column not in (*COLUMNS, _INNER):
            allowed = ", ".join((*COLUMNS, _INNER))
            raise ThermorenderError(f"object {item.name!r} has no {column!r} to set; give {allowed}")
        if column == "temperature_k" and value == BALANCE:
            found["temperature"] = None
        elif column == "temperature_k":
            found["temperature"] = scene_kelvin(what, number_of(what, with_unit(value), f" of kelvin, or {BALANCE!r}"))
            found |= {"follows_balance": False, _INNER: found.get(_INNER, 0.0)}
        elif column in ("yaw_deg", _INNER):
            found[column] = number_of(what, value)
        else:
            position[column] = number_of(what, value)
    where = Where(f"with_objects: {item.name}", top="")
    rows = {each.name: each.metadata["read"] for each in fields(ObjectSpec)}
    found |= {name: rows[name](found[name], where.of(name)) for name in (_INNER,) if name in found}
    found["position"] = rows["position"](list(position.values()), where.of("position"))
    made = replace(item, **found)
    made.check(where, {row.name: 1 for row in fields(made) if getattr(made, row.name) != row.default})
    return made
