"""State derived from a scene's files and declarations: shape, cover, air and temperatures.

Each stage has a key of its inputs. After an edit, only stages with a changed key are made again. The result depends on
the current declarations, not on the order of the edits.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from thermorender.atmosphere.declared import declared_air
from thermorender.atmosphere.model import Atmosphere
from thermorender.errors import ThermorenderError, shortened
from thermorender.materials.extended import missing
from thermorender.scene.parts.cover import Cover, cover_of, refuse_band
from thermorender.scene.parts.read import Parts
from thermorender.scene.parts.shape import Shape, shape_of
from thermorender.scene.parts.textures import stating, used_texels
from thermorender.scene.parts.tracks import TrackedObject
from thermorender.scene.spec import WEATHER, TemperatureSpec
from thermorender.scene.state.albedo import shares, with_albedo
from thermorender.scene.state.declared import Declared
from thermorender.scene.state.own_weather import no_snow_of, weather_of
from thermorender.scene.surface import FALLBACK, UNMOVED, Surface, fill, nearest_valid, scene_kelvin
from thermorender.scene.temperature import Texels, map_error_k, resolve, trained
from thermorender.scene.temperature_state import Balance, Conditional, Known, Moved, Pending, TemperatureState

if TYPE_CHECKING:
    from thermorender.weather.series import Weather


@dataclass(frozen=True, eq=False)
class Derived:
    """State derived from a scene's files and declarations."""

    shape: Shape
    cover: Cover
    air: Atmosphere | None  # In the camera's band
    surfaces: tuple[Surface, ...]  # The terrain's first, then those of objects without a track
    tracked_objects: tuple[TrackedObject, ...]
    temperature_state: TemperatureState
    weather: "Weather | None" = None  # That of the air, if the air is that of the weather
    no_snow: str = ""  # Why a learned emissivity map found no snow; "" if it may


def derived(parts: Parts | None, now: Declared, old: tuple[Declared, Derived] | None = None) -> Derived:
    """Return the state derived from a scene's parts and declarations.

    Parameters
    ----------
    parts : Parts or None
        None for a scene of surfaces made in memory, whose shape and cover are those of `old`.
    now : Declared
    old : (Declared, Derived), optional
        Before an edit; unaffected stages are kept.
    """
    before, had = old or (None, None)
    shape = had.shape if had and before and _shape_key(before) == _shape_key(now) else _shape(parts, now)
    same = had and before and _weather_key(before, had.shape) == _weather_key(now, shape)
    # The cover of surfaces made in memory stays.
    no_snow = had.no_snow if had and parts is None else no_snow_of(now, shape, had.weather if had and same else None)
    if (
        had
        and before
        and _cover_key(before, had.no_snow) == _cover_key(now, no_snow)
        and not _to_extend(had.cover, parts, before, now)
    ):
        cover, no_snow = had.cover, had.no_snow
    else:
        cover = _cover(parts, now, no_snow)
    if before and before.camera.band_um != now.camera.band_um:
        for material in cover.materials:
            refuse_band(material, now.camera.band_um, now.where)
    air, weather = _air_and_weather(now, shape, old)
    if air is not None and not (had and had.air is air and had.shape is shape):
        altitude_m = now.height_m(shape.frame) + shape.highest_m
        air.refuse_above_clouds(f"{now.where}: the highest surface", altitude_m)
    if parts is None and before and _objects_key(before) != _objects_key(now):
        raise _in_memory(now, "an object")
    made = Derived(shape, cover, air, (), (), Known(), weather, no_snow)
    copies: tuple[Surface, ...] = ()
    if had and before and _temperature_key(before, had) == _temperature_key(now, made):
        if cover is had.cover and shape is had.shape and _objects_key(before) == _objects_key(now):
            return replace(had, air=air, weather=weather, no_snow=no_snow)
        ground = had.surfaces[: len(shape.ground)]
        kelvin = [surface.temperature for surface in ground]
        flags = [surface.flags & np.uint8(FALLBACK | UNMOVED) for surface in ground]
        state, copies = had.temperature_state, had.surfaces[len(ground) : len(ground) + shape.balanced]
    else:
        kelvin, flags, state = _temperatures(now, shape, cover)
    return _combined(parts, now, made, kelvin, flags, state, copies)


def of_surfaces(now: Declared, shape: Shape, cover: Cover, had: Derived | None) -> Derived:
    """Return what follows for surfaces made in memory, whose texels `shape` and `cover` hold; the air stays."""
    air, weather = (had.air, had.weather) if had else (None, None)
    made = Derived(shape, cover, air, (), (), Known(), weather)
    return _combined(None, now, made, *_temperatures(now, shape, cover))


def _combined(
    parts: Parts | None, now: Declared, made: Derived, kelvin: list[NDArray[np.float32]],
    flags: list[NDArray[np.uint8]], state: TemperatureState, copies: tuple[Surface, ...] = (),
) -> Derived:  # fmt: skip
    """Combine shape, cover and temperatures; those of `copies` were solved with the terrain's."""
    shape, cover = made.shape, made.cover
    surfaces = tuple(
        replace(bare, colour=own.colour, material=own.material, temperature=warm, flags=own.flags | more)
        for bare, own, warm, more in zip(shape.ground, cover.ground, kelvin, flags, strict=True)
    )
    if parts is None:
        static, tracked = shape.static, shape.tracked
    else:
        for surface, number in zip(shape.static, shape.static_of, strict=True):
            material = cover.materials[cover.objects[number]]
            if surface.instances is not None and material.emissivity_by_angle is not None:
                raise ThermorenderError(
                    f"{now.where}: object {surface.name.split(':')[0]!r} has instances of the material "
                    f"{material.name!r}, whose emissivity depends on the angle, which copies do not support; give "
                    "them another material"
                )
        static = tuple(
            _covered(surface, cover.objects[number], now.spec.objects[number].kelvin)
            for surface, number in zip(shape.static, shape.static_of, strict=True)
        )
        solved = (
            replace(a, temperature=b.temperature, scatter_k=b.scatter_k) for a, b in zip(static, copies, strict=False)
        )
        static = (*solved, *static[len(copies) :])
        tracked = tuple(
            _tracked(one, now, cover, number) for one, number in zip(shape.tracked, shape.tracked_of, strict=True)
        )
    return replace(made, surfaces=(*surfaces, *static), tracked_objects=tracked, temperature_state=state)


def camera_alone_differs(one: Declared, other: Declared) -> bool:
    """Return whether two scenes of the same parts declare the same but for the camera."""
    same = ("air", "weather", "model", "kelvin")
    equal = ("time", "stated_altitude_m", "sky_temperature", "replaced", "painted", "held", "given")
    return (
        all(getattr(one, name) is getattr(other, name) for name in same)
        and all(getattr(one, name) == getattr(other, name) for name in equal)
        and replace(one.spec, camera="") == replace(other.spec, camera="")
    )


def _to_extend(cover: Cover, parts: Parts | None, before: Declared, now: Declared) -> bool:
    """Whether another band needs other assumptions on materials whose tables do not cover it."""
    if parts is None or before.camera.band_um == now.camera.band_um:
        return False
    return any(material.assumed_um or missing(material, now.camera.band_um) for material in cover.materials)


# Keys of the stages


def _shape_key(of: Declared) -> tuple[Any, ...]:
    return tuple((item.position, item.yaw_deg, item.temperature is None) for item in of.spec.objects), of.held


def _cover_key(of: Declared, no_snow: str) -> tuple[Any, ...]:
    band = of.camera.band_um if of.spec.emissivity.source == "learned" else None
    covered = tuple((one.name, one.material, one.classes) for one in of.spec.surfaces)
    objects = tuple(item.material for item in of.spec.objects)
    return of.spec.emissivity, objects, covered, of.replaced, of.painted, band, _albedo(of), bool(no_snow)


def _albedo(of: Declared) -> float | None:
    return of.spec.weather.albedo if of.spec.weather else None


def _air_key(of: Declared, shape: Shape) -> tuple[Any, ...]:
    weather = (*_weather_key(of, shape), of.time) if _air_of_weather(of) else ()
    return id(of.air), of.spec.atmosphere, of.camera.band_um, *weather


def _weather_key(of: Declared, shape: Shape) -> tuple[Any, ...]:
    return of.spec.weather, id(of.weather), of.stated_altitude_m, shape.frame


def _air_of_weather(of: Declared) -> bool:
    return of.air is None and of.spec.atmosphere is not None and of.spec.atmosphere.standard == WEATHER


def _objects_key(of: Declared) -> tuple[Any, ...]:
    return of.spec.objects, of.held


def _temperature_key(of: Declared, made: Derived) -> tuple[Any, ...]:
    """Inputs of the terrain's temperatures, by their source."""
    spec = of.spec
    if of.given:
        # Temperatures of surfaces made in memory change only by a new source or the weather.
        source: tuple[Any, ...] = (made.shape,)
    else:
        # Kelvin of a number or a raster are the same on any material.
        bare = not _weather_driven(of) and (of.kelvin is not None or spec.temperature.source in ("constant", "raster"))
        own_kelvin = tuple((one.name, one.temperature) for one in spec.surfaces)
        source = spec.temperature, own_kelvin, id(of.model), id(of.kelvin), made.shape, None if bare else made.cover
    if not _weather_driven(of):
        return source
    own = tuple(item.temperature for item in spec.objects if item.track is None)
    # A declared sun contradicts the weather's and is refused when the temperatures are made.
    key = (*source, spec.weather, id(of.weather), of.time, of.stated_altitude_m, own, spec.sun)
    if _conditional(of):
        # Its apparent temperatures depend on the sky.
        key += (made.air if of.has_air else spec.sky_temperature,)
    return key


def _conditional(of: Declared) -> bool:
    return of.model is not None and bool(of.model.needs)


def _moved(of: Declared) -> bool:
    return not _conditional(of) and of.spec.weather is not None and trained(of.spec.temperature, of.model) is not None


def _source_moved(now: Declared, kelvin: list[NDArray[np.float32]]) -> Moved:
    spec = now.spec.temperature
    weather = trained(spec, now.model)
    assert weather is not None
    return Moved(tuple(kelvin), weather, map_error_k(spec, now.model))


def _weather_driven(of: Declared) -> bool:
    return of.spec.temperature.source == "balance" or _conditional(of) or _moved(of)


# Stages


def _shape(parts: Parts | None, now: Declared) -> Shape:
    if parts is None:
        raise _in_memory(now, "the place of its objects")
    return shape_of(parts, now.spec.objects, now.held, now.where)


def _cover(parts: Parts | None, now: Declared, no_snow: str) -> Cover:
    band = now.camera.band_um
    if parts is None:
        raise _in_memory(now, "its materials")
    spec, albedo = now.spec, _albedo(now)
    cover = cover_of(
        parts, spec.emissivity, spec.objects, spec.surfaces, now.replaced, now.painted, band, now.where, no_snow
    )
    if albedo is None:
        return cover
    share = shares(parts.ground, cover.ground, len(cover.materials), spec.terrain.mesh is not None)
    return replace(cover, materials=tuple(with_albedo(cover.materials, share, albedo, now.where)))


def _in_memory(now: Declared, what: str) -> ThermorenderError:
    return ThermorenderError(
        f"{now.where}: {what} cannot be edited, because its surfaces were made in memory; edit the scene before "
        "with_surfaces, or give with_surfaces other ones"
    )


def air_of(weather: "Weather", time: Any, **keys: Any) -> Atmosphere:
    """Return the Atmosphere of a Weather at an instant; keys as of `from_weather`."""
    from thermorender.atmosphere.from_weather import NearGround, from_weather

    at = weather.at(time)
    near = NearGround(*(float(getattr(at, name)) for name in NearGround._fields))
    return from_weather(near, weather.latitude_deg, weather.altitude_m, time, **keys)


def air_in(now: Declared, weather: "Weather | None") -> Atmosphere | None:
    """Return the declared air in the camera's band; `weather` is needed if the air follows it."""
    if now.air is None:

        def of_weather(**keys: Any) -> Atmosphere:
            assert weather is not None
            return air_of(weather, now.time, **keys)

        found: Atmosphere | None = declared_air(now.spec.atmosphere, now.camera.band_um, now.where, of_weather)
        return found
    band = now.camera.band_um
    if (now.air.lower_um.min(), now.air.upper_um.max()) == tuple(band):
        return now.air
    try:
        cut: Atmosphere = now.air.in_band(*band)
        return cut
    except ThermorenderError as error:
        raise ThermorenderError(f"{now.where}: {error}") from None


def _air_and_weather(
    now: Declared, shape: Shape, old: tuple[Declared, Derived] | None
) -> tuple[Atmosphere | None, "Weather | None"]:
    """The air in the camera's band, and the weather if the air follows it; those of `old` where they hold."""
    before, had = old or (None, None)
    if had and before and _air_key(before, had.shape) == _air_key(now, shape):
        return had.air, had.weather
    if not _air_of_weather(now):
        return air_in(now, None), None
    same = had and before and _weather_key(before, had.shape) == _weather_key(now, shape)
    weather = (had.weather if had and same else None) or weather_of(now, shape)
    return air_in(now, weather), weather


def _covered(surface: Surface, material: int, kelvin: float) -> Surface:
    """A surface of one material and temperature."""
    shape = surface.flags.shape
    return replace(surface, material=np.full(shape, material, np.uint8), temperature=np.full(shape, kelvin, np.float32))


def _tracked(one: TrackedObject, now: Declared, cover: Cover, number: int) -> TrackedObject:
    item = now.spec.objects[number]
    surfaces = tuple(_covered(surface, cover.objects[number], item.kelvin) for surface in one.surfaces)
    return replace(one, item=item, surfaces=surfaces)


def _temperatures(
    now: Declared, shape: Shape, cover: Cover
) -> tuple[list[NDArray[np.float32]], list[NDArray[np.uint8]], TemperatureState]:
    """(kelvin, flags, state) of the terrain's surfaces, from the source that is declared."""
    spec, weather_driven = now.spec.temperature, _weather_driven(now)
    if weather_driven:
        _refuse_source(now, shape)
    solved = next((each for each in now.spec.objects if each.temperature is None), None)
    if solved and spec.source != "balance":
        raise ThermorenderError(
            f"{now.where}: the temperature of object {solved.name!r} is 'balance', and that of the terrain is not: "
            f"[temperature] has source={spec.source!r}; give the object kelvin, or source='balance' with [weather]"
        )
    nothing = [np.zeros(surface.flags.shape, np.uint8) for surface in shape.ground]
    waiting = [np.full(surface.flags.shape, np.nan, np.float32) for surface in shape.ground]
    if _conditional(now):
        return waiting, nothing, Pending(Conditional(now.model))
    if spec.source == "balance":
        return waiting, nothing, Pending(Balance())
    if now.given:
        kept = [surface.temperature for surface in shape.ground]
        own = [surface.flags & np.uint8(FALLBACK | UNMOVED) for surface in shape.ground]
        if weather_driven:
            return waiting, own, Pending(_source_moved(now, kept))
        return kept, own, Known()
    report: dict[str, Any] = {}
    if now.kelvin is not None:
        found = [_filled(values, surface) for values, surface in zip(now.kelvin, shape.ground, strict=True)]
    else:
        found = _resolved(now, shape, cover, report)
    kelvin, flags = [each[0] for each in found], [each[1] for each in found]
    if weather_driven:
        return waiting, flags, Pending(_source_moved(now, kelvin), report)
    return kelvin, flags, Known(report=report)


def _resolved(
    now: Declared, shape: Shape, cover: Cover, report: dict[str, Any]
) -> list[tuple[NDArray[np.float32], NDArray[np.uint8]]]:
    """(kelvin, flags) of each terrain surface, from its own [[surface]] or from [temperature]."""
    spec, textures = now.spec.temperature, shape.textures or [None] * len(shape.ground)
    own = stating(shape.textures, now.spec.surfaces, ("temperature",), now.where) or [None] * len(textures)
    rest = [surface.name for surface, one in zip(shape.ground, own, strict=True) if one is None]
    if spec.source == "raster" and shape.textures and len(rest) > 1:
        raise ThermorenderError(
            f"{now.where}: temperature.raster is in the pixels of one texture, and the mesh has {len(rest)} surfaces "
            f"without another temperature ({shortened(', '.join(map(repr, rest)), 300)}); give each its raster or "
            "kelvin as temperature in a [[surface]]"
        )
    found = []
    for surface, painted, texture, one in zip(shape.ground, cover.ground, textures, own, strict=True):
        source = spec
        stated = None if one is None else one.temperature
        if isinstance(stated, Path):
            source = TemperatureSpec("raster", raster=stated, value=spec.value)
        elif stated is not None:
            source = TemperatureSpec("constant", value=stated)
        on_ground = used_texels(surface) if texture and source.source == "raster" else shape.on_ground
        found.append(resolve(source, Texels(
            painted.colour, painted.material, cover.materials, shape.grid, surface.texel_m, now.where, report,
            now.model, on_ground, surface if texture else None, texture,
        )))  # fmt: skip
    return found


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


def _refuse_source(now: Declared, shape: Shape) -> None:
    """Refuse temperatures that follow the weather if an input is missing or contradictory."""
    spec, moved = now.spec.temperature, _moved(now)
    if _conditional(now) and spec.trained:
        raise ThermorenderError(
            f"{now.where}: temperature.model={spec.model!r} takes hour and weather as input and is not moved by "
            "temperature.trained; leave that out"
        )
    if _conditional(now) and shape.grid is None:
        raise ThermorenderError(
            f"{now.where}: temperature.model={spec.model!r} takes relief or hour as input and needs a terrain with an "
            "elevation raster, and this one is a mesh; take a map that sees colour only"
        )
    for one in now.spec.surfaces:
        if one.temperature is not None:
            raise ThermorenderError(
                f"{now.where}: surface {one.name!r} has temperature={one.temperature}, and the others follow the "
                "weather, which is not supported; leave it out, or make that part an [[object]] of its own file"
            )
    key = "trained" if moved else f"model={spec.model!r}" if spec.model else "source='balance'"
    why = f"{now.where}: temperature.{key} "
    if now.spec.weather is None:
        raise ThermorenderError(f"{why}needs the weather; add [weather] with time and one of file, epw, air_high_c")
    if shape.frame is None:
        raise ThermorenderError(
            f"{why}needs a place, which a mesh does not have; add [frame] with latitude_deg, longitude_deg and height_m"
        )
    if now.spec.sun is not None:
        raise ThermorenderError(
            f"{why}computes the sun from weather.time, but this scene declares another sun; leave [sun] out, "
            "or call with_sun(None) first"
        )
