"""Temperatures of the terrain: from a number, raster or map, or pending until the heat balance solves them."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError, ThermorenderWarning, shortened
from thermorender.materials.material import Material
from thermorender.scene.cover import Cover, Painted
from thermorender.scene.drape import Drape
from thermorender.scene.shape import Placement, Shape
from thermorender.scene.spec import SunSpec, SurfaceSpec, TemperatureSpec, WeatherSpec
from thermorender.scene.surface import FALLBACK, UNMOVED, Surface, fill, nearest_valid, scene_kelvin
from thermorender.scene.temperature import Texels, map_error_k, resolve, trained
from thermorender.scene.temperature_state import Available, Balance, Conditional, Moved, Pending, TemperatureState
from thermorender.scene.textures import stating

if TYPE_CHECKING:
    from thermorender.atmosphere.model import Atmosphere
    from thermorender.learned.temperature_map import TemperatureMap
    from thermorender.weather.series import Weather

# How temperatures follow the weather; "" where they do not.
Follows = Literal["", "balance", "conditional", "moved"]


# Faces at which temperatures are compared with heights, and least standard deviation of both [m, K].
_COMPARED_FACES, _LEAST_RELIEF_M = 10_000, 0.5


class TemperatureInputs(NamedTuple):
    """What temperatures that follow the weather are solved from, besides the surfaces and their materials."""

    weather: WeatherSpec | None
    given_weather: "Weather | None"
    time: "np.datetime64 | None"
    altitude_m: float | None  # As stated, not from the frame
    objects: tuple[
        tuple["float | Path | None", float], ...
    ]  # Temperatures [K] and inner heat [W] of those without a track
    sun: SunSpec | None  # The declared one, which contradicts the weather's and is refused
    sky: "Atmosphere | float | None"  # Which a conditional map's apparent temperatures depend on


@dataclass(frozen=True, eq=False)
class Temperatures:
    """Temperatures of the terrain's surfaces, and of objects that the heat balance solves."""

    kelvin: Sequence[NDArray[np.float32]]  # (h, w) of each terrain surface [K]; NaN while pending
    flags: Sequence[NDArray[np.uint8]]  # (h, w) FALLBACK and UNMOVED of these texels
    state: TemperatureState
    # (temperatures [K], standard deviation within texels [K] or None) of each surface of such objects, once solved
    objects: Sequence[tuple[NDArray[np.float32], NDArray[np.float32] | None]] = ()


def follows(
    spec_temperature: TemperatureSpec, temperature_map: "TemperatureMap | None", spec_weather: WeatherSpec | None
) -> Follows:
    """Return how the terrain's temperatures follow the weather."""
    if temperature_map is not None and temperature_map.needs:
        return "conditional"
    if spec_temperature.source == "balance":
        return "balance"
    return "moved" if spec_weather is not None and trained(spec_temperature, temperature_map) is not None else ""


def temperatures(
    follows: Follows, temperature_inputs: TemperatureInputs | None, spec_temperature: TemperatureSpec,
    temperature_map: "TemperatureMap | None", given_kelvin: tuple[NDArray[Any], ...] | None, given: bool,
    part_temperatures: Sequence[SurfaceSpec], far_temperatures: Sequence["float | Path | None"],
    placements: Sequence[Placement], shape: Shape, covered: "tuple[Cover, tuple[Material, ...]] | None", where: str,
) -> Temperatures:  # fmt: skip
    """Return the Temperatures of the source that a scene declares."""
    if temperature_inputs is not None:
        _refuse_inputs(follows, temperature_inputs, spec_temperature, part_temperatures, shape, where)
    solved = next((each for each in placements if each.balanced), None)
    if solved and spec_temperature.source != "balance":
        raise ThermorenderError(
            f"{where}: the temperature of object {solved.name!r} is 'balance', and that of the terrain is not: "
            f"[temperature] has source={spec_temperature.source!r}; give the object kelvin, or source='balance' with "
            "[weather]"
        )
    # Placeholders without memory of their own.
    nothing = [np.broadcast_to(np.uint8(0), surface.flags.shape) for surface in shape.ground]
    waiting = [np.broadcast_to(np.float32(np.nan), surface.flags.shape) for surface in shape.ground]
    if follows == "conditional":
        return Temperatures(waiting, nothing, Pending(Conditional(temperature_map)))
    if follows == "balance":
        return Temperatures(waiting, nothing, Pending(Balance()))
    report: dict[str, Any] = {}
    if given:
        kelvin = [surface.temperature for surface in shape.ground]
        flags = [_some(surface.flags & np.uint8(FALLBACK | UNMOVED)) for surface in shape.ground]
    else:
        if given_kelvin is not None:
            found = [_filled(values, surface) for values, surface in zip(given_kelvin, shape.ground, strict=True)]
        else:
            source = _Source(
                spec_temperature, part_temperatures, far_temperatures, temperature_map, where, report
            )  # fmt: skip
            found = _resolved(source, shape, covered)
        kelvin, flags = [each[0] for each in found], [each[1] for each in found]
    if follows != "moved":
        return Temperatures(kelvin, flags, Available(report=report))
    weather = trained(spec_temperature, temperature_map)
    assert weather is not None
    moved = Moved(tuple(kelvin), weather, map_error_k(spec_temperature, temperature_map))
    return Temperatures(waiting, flags, Pending(moved, report))


def _some(flags: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Flags, without memory of their own where none is set."""
    return flags if flags.any() else np.broadcast_to(np.uint8(0), flags.shape)


@dataclass(frozen=True)
class _Source:
    """A source of temperatures that do not follow the weather, or are moved by it."""

    spec: TemperatureSpec
    parts: Sequence[SurfaceSpec]  # Parts of a mesh with their own temperature
    far: Sequence["float | Path | None"]  # Own temperature of each far ground
    model: "TemperatureMap | None"
    where: str
    report: dict[str, Any] = field(default_factory=dict)


def _resolved(
    source: _Source, shape: Shape, covered: tuple[Cover, tuple[Material, ...]] | None
) -> list[tuple[NDArray[np.float32], NDArray[np.uint8]]]:
    """(kelvin, flags) of each terrain surface, from its own [[surface]] or from [temperature]."""
    spec, where, near = source.spec, source.where, [surface for surface in shape.ground if not surface.far]
    own = stating(shape.textures, source.parts, ("temperature",), where) or [None] * len(near)
    kelvin = [*(None if one is None else one.temperature for one in own), *source.far]
    kelvin += [None] * (len(shape.ground) - len(kelvin))
    rest = [surface.name for surface, one in zip(near, kelvin, strict=False) if one is None]
    if spec.source == "raster" and shape.textures and len(rest) > 1:
        raise ThermorenderError(
            f"{where}: temperature.raster is in the pixels of one texture, and the mesh has {len(rest)} surfaces "
            f"without another temperature ({shortened(', '.join(map(repr, rest)), 300)}); give each its raster or "
            "kelvin as temperature in a [[surface]]"
        )
    # Surfaces without materials hold placeholders of the same shape.
    ground: Sequence[Painted | Surface] = covered[0].ground if covered else shape.ground
    materials = covered[1] if covered else ()
    found = []
    for number, (surface, painted, stated) in enumerate(zip(shape.ground, ground, kelvin, strict=True)):
        chosen, drape = spec, shape.drape(number)
        texture = shape.textures[number] if number < len(shape.textures) else None
        if surface.far and stated is None:
            stated = _refuse_far(spec, surface, drape, where)
        if isinstance(stated, Path):
            chosen = TemperatureSpec("raster", raster=stated, value=spec.value)
        elif stated is not None:
            chosen = TemperatureSpec("constant", value=stated)
        found.append(resolve(chosen, Texels(
            painted.colour, painted.material, materials, drape.grid if drape else None, surface.texel_m, where,
            {} if surface.far else source.report,
            source.model, drape.on_ground if drape else None, surface if texture else None, texture,
        )))  # fmt: skip
        if chosen.raster is not None:
            _warn_of_heights(chosen.raster, found[-1][0], surface)
    return found


def _refuse_far(spec: TemperatureSpec, surface: Surface, drape: Drape | None, where: str) -> "float | None":
    """Return the kelvin beyond a raster, None for other sources; refuse far ground that a source does not reach."""
    if spec.source == "raster":
        if spec.value is None:
            raise ThermorenderError(
                f"{where}: temperature.raster is of the scene, and {surface.name} ground lies around it; give "
                "terrain.far.temperature, or the kelvin of the rest as temperature.value"
            )
        return spec.value
    if spec.source == "learned" and (drape is None or drape.colour is None):
        raise ThermorenderError(
            f"{where}: temperature.source='learned' reads colours, and {surface.name} ground has no orthophoto; give "
            "terrain.far.orthophoto or terrain.far.temperature"
        )
    return None


def _warn_of_heights(path: Path, kelvin: NDArray[Any], surface: Surface) -> None:
    """Warn where temperatures rise by a kelvin per metre with the heights of the surface, as heights themselves do."""
    some = slice(None, None, max(1, len(surface.faces) // _COMPARED_FACES))
    height = surface.vertices[surface.faces[some], 2].mean(axis=1)
    rows, columns = kelvin.shape
    place = (surface.uv[some].mean(axis=1, dtype=np.float64) * (columns, rows)).astype(int)
    there = kelvin[np.clip(place[:, 1], 0, rows - 1), np.clip(place[:, 0], 0, columns - 1)].astype(np.float64)
    if len(height) < 10 or min(height.std(), there.std()) < _LEAST_RELIEF_M:
        return
    covariance = np.cov(height, there)
    slope, correlation = covariance[0, 1] / covariance[0, 0], np.corrcoef(height, there)[0, 1]
    if correlation > 0.99 and abs(slope - 1.0) < 0.1:
        warnings.warn(
            f"{path} follows the heights of the terrain by {slope:.2f} per metre, so it may hold heights, which are "
            "read as kelvin; give the raster of temperatures",
            ThermorenderWarning, stacklevel=2,
        )  # fmt: skip


def _filled(values: NDArray[Any], surface: Surface) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """(kelvin, flags) of temperatures given in memory; NaN is replaced by the nearest one."""
    kelvin = np.asarray(values, np.float32)
    if kelvin.shape != surface.flags.shape or not np.isfinite(kelvin).any():
        raise ThermorenderError(
            f"kelvin of shape {kelvin.shape} does not cover the terrain's {surface.flags.shape} texels; give an array "
            "of that shape per terrain surface, with NaN for no data"
        )
    scene_kelvin("kelvin", kelvin[np.isfinite(kelvin)])
    valid = np.isfinite(kelvin)
    if not valid.all():
        kelvin = fill(kelvin, nearest_valid(valid))
    return kelvin, np.where(valid, 0, FALLBACK).astype(np.uint8)


def _refuse_inputs(
    follows: Follows, inputs: TemperatureInputs, spec: TemperatureSpec, parts: Sequence[SurfaceSpec], shape: Shape,
    where: str,
) -> None:  # fmt: skip
    """Refuse temperatures that follow the weather if an input is missing or contradictory."""
    if follows == "conditional" and spec.trained:
        raise ThermorenderError(
            f"{where}: temperature.model={spec.model!r} takes hour and weather as input and is not moved by "
            "temperature.trained; leave that out"
        )
    if follows == "conditional" and shape.grid is None:
        raise ThermorenderError(
            f"{where}: temperature.model={spec.model!r} takes relief or hour as input and needs a terrain with an "
            "elevation raster, and this one is a mesh; take a map that sees colour only"
        )
    bare = [surface.name for number, surface in enumerate(shape.ground) if surface.far
            and (drape := shape.drape(number)) is not None and drape.colour is None]  # fmt: skip
    if follows == "conditional" and bare:
        raise ThermorenderError(
            f"{where}: temperature.model={spec.model!r} reads colours, and {bare[0]} ground has no orthophoto; give "
            "terrain.far.orthophoto, or take another source"
        )
    for one in parts:
        if one.temperature is not None:
            raise ThermorenderError(
                f"{where}: surface {one.name!r} has temperature={one.temperature}, and the others follow the "
                "weather, which is not supported; leave it out, or make that part an [[object]] of its own file"
            )
    key = "trained" if follows == "moved" else f"model={spec.model!r}" if spec.model else "source='balance'"
    why = f"{where}: temperature.{key} "
    if inputs.weather is None:
        raise ThermorenderError(f"{why}needs the weather; add [weather] with time and one of file, epw, air_high_c")
    if shape.frame is None:
        raise ThermorenderError(
            f"{why}needs a place, which a mesh does not have; add [frame] with latitude_deg, longitude_deg and height_m"
        )
    if inputs.sun is not None:
        raise ThermorenderError(
            f"{why}computes the sun from weather.time, but this scene declares another sun; leave [sun] out, "
            "or call with_sun(None) first"
        )
