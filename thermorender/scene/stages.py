"""The stages of a scene: functions that return the value of their own name, with their inputs as parameters.

Inputs are the fields of `Declared`; the key `x` of the scene file is `spec_x`.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from thermorender.atmosphere.declared_air import declared_air
from thermorender.atmosphere.model import Atmosphere
from thermorender.errors import ThermorenderError
from thermorender.materials.extended import within_band
from thermorender.materials.material import Material
from thermorender.materials.mixture import parts_of
from thermorender.physics.geodesy import LocalFrame
from thermorender.scene import buried, coplanar
from thermorender.scene.albedo import shares, with_albedo
from thermorender.scene.cover import WHY, Cover, Covering, Replaced, cover_of
from thermorender.scene.declared import Declared, InMemory
from thermorender.scene.digest import digest, weather_digest
from thermorender.scene.folder import SceneFiles
from thermorender.scene.ground import Ground
from thermorender.scene.patch import Patch
from thermorender.scene.pipeline import Pipeline
from thermorender.scene.raster import Grid
from thermorender.scene.shape import Held, Placement, Shape, shape_of
from thermorender.scene.spec import (
    WEATHER,
    AtmosphereSpec,
    EmissivitySpec,
    ObjectSpec,
    SunSpec,
    SurfaceSpec,
    TemperatureSpec,
    TerrainSpec,
    WeatherSpec,
)
from thermorender.scene.surface import Surface
from thermorender.scene.temperature_state import Available, TemperatureState
from thermorender.scene.terrain_temperature import Follows, TemperatureInputs, Temperatures, follows, temperatures
from thermorender.scene.tracks import TrackedObject
from thermorender.scene.world import FineGround
from thermorender.sensor.camera import Camera

if TYPE_CHECKING:
    from pathlib import Path

    from thermorender.weather.series import Weather

# The sun shines where its direct irradiance is above this [W m⁻²]: World Meteorological Organization, Guide to
# Instruments and Methods of Observation, WMO-No. 8 (2018), volume I, 8.1.1.
_SUNSHINE_W_M2 = 120.0


# --- place ----------------------------------------------------------------------------------------------------------


def where(spec_folder: "Path") -> str:
    """Return the path of the scene file, for messages."""
    return str(spec_folder / "scene.toml")


def frame(files: SceneFiles | None, in_memory: InMemory | None) -> LocalFrame | None:
    """Return the position of the local East-North-Up frame on Earth; None for a mesh without [frame]."""
    return in_memory.shape.frame if in_memory else files.frame if files else None


def grid(shape: Shape) -> Grid | None:
    """Return the map grid of the terrain's texels, or None."""
    return shape.grid


def geoid_undulation_m(spec_terrain: TerrainSpec) -> float | None:
    """Return the height of the geoid above the ellipsoid [m], or None where it is not declared."""
    declared = spec_terrain.geoid_undulation_m
    return 0.0 if declared is None and spec_terrain.height_reference == "geoid" else declared


def stated_altitude_m(spec_atmosphere: AtmosphereSpec | None, place_altitude_m: float | None) -> float | None:
    """Return the altitude of the frame's origin above sea level that the air states, else the scene file [m]."""
    own = spec_atmosphere.altitude_m if spec_atmosphere else None
    return place_altitude_m if own is None else own


def altitude_m(
    stated_altitude_m: float | None, frame: LocalFrame | None, geoid_undulation_m: float | None
) -> float:  # fmt: skip
    """Return the altitude of the local frame's origin above sea level [m]: as declared, else from the frame, else 0."""
    if stated_altitude_m is not None:
        return stated_altitude_m
    return float(frame.height_m - (geoid_undulation_m or 0.0)) if frame else 0.0


# --- shape ----------------------------------------------------------------------------------------------------------


def placements(spec_objects: Sequence[ObjectSpec]) -> tuple[Placement, ...]:
    """Return where each object stands."""
    return tuple(Placement(item.name, item.position, item.yaw_deg, item.temperature is None) for item in spec_objects)


def shape(
    files: SceneFiles | None, in_memory: InMemory | None, placements: Sequence[Placement], held: Held, where: str
) -> Shape:
    """Return where the surfaces lie."""
    if in_memory:
        _refuse_edit(in_memory, "placements", (placements, held), "the place of its objects", where)
        return in_memory.shape
    assert files is not None
    return shape_of(files, placements, held, where)


def terrain_count(shape: Shape) -> int:
    """Return how many of the surfaces are terrain."""
    return len(shape.ground)


def solved_count(shape: Shape) -> int:
    """Return the number of surfaces whose temperatures the heat balance solves: the terrain, objects and copies."""
    return len(shape.ground) + shape.balanced


def ground(shape: Shape, files: SceneFiles | None) -> Ground:
    """Return a callable (east, north) → local height of the terrain [m], NaN off it."""
    return Ground(shape.ground) if files is None or files.world is None else FineGround(files.world)


def made_in_memory(declared: Declared, shape: Shape, cover: Cover, materials: tuple[Material, ...]) -> Declared:
    """Return declarations with surfaces made in memory, in place of those that files describe."""
    spec = declared.spec
    fixed = {
        "placements": (placements(spec.objects), declared.held),
        "covering": covering(
            spec.emissivity, spec.objects, spec.surfaces, declared.replaced, declared.painted, declared.camera.band_um
        ),
        "albedo": albedo(spec.weather),
        "objects": spec.objects,
    }
    return replace(declared, files=None, in_memory=InMemory(shape, cover, materials, fixed), given=True)


def _refuse_edit(in_memory: InMemory, name: str, value: Any, what: str, where: str) -> None:
    """Refuse another value of an input that surfaces made in memory do not follow."""
    if in_memory.fixed[name] != value:
        raise ThermorenderError(
            f"{where}: {what} cannot be edited, because its surfaces were made in memory; edit the scene before "
            "with_surfaces, or give with_surfaces other ones"
        )


# --- weather and air ------------------------------------------------------------------------------------------------


def weather(
    spec_weather: WeatherSpec | None, time: "np.datetime64 | None", given_weather: "Weather | None",
    frame: LocalFrame | None, altitude_m: float, where: str,
) -> "Weather":  # fmt: skip
    """Return the Weather that a scene declares, at its own place."""
    if spec_weather is None or time is None:
        raise ThermorenderError(f"{where} has no [weather]; add it")
    if given_weather is not None:
        return given_weather
    if frame is None:
        raise ThermorenderError(
            f"{where}: [weather] needs a place, which a mesh does not have; add [frame] with latitude_deg, "
            "longitude_deg and height_m"
        )
    from thermorender.weather.declared_weather import declared_weather

    try:
        return declared_weather(spec_weather, frame.latitude_deg, frame.longitude_deg, altitude_m)
    except ThermorenderError as error:
        raise ThermorenderError(f"{where}: {error}") from None


def weather_now(weather: "Weather", time: "np.datetime64") -> "tuple[Weather, np.datetime64]":
    """Return the weather and the instant of the scene in it."""
    return weather, time


def noted_weather(weather: "Weather", solution_notes: tuple[str, ...]) -> "Weather":
    """Return the weather with the notes of solving the temperatures."""
    return replace(weather, notes=(*weather.notes, *solution_notes)) if solution_notes else weather


def band_um(camera: Camera) -> tuple[float, float]:
    """Return the camera's band [µm]."""
    return camera.band_um


def air_of_weather(given_air: Atmosphere | None, spec_atmosphere: AtmosphereSpec | None) -> bool:
    """Return whether the air is that of the weather."""
    return given_air is None and spec_atmosphere is not None and spec_atmosphere.standard == WEATHER


def air(
    given_air: Atmosphere | None, spec_atmosphere: AtmosphereSpec | None, air_of_weather: bool,
    band_um: tuple[float, float], weather_now: Callable[[], "tuple[Weather, np.datetime64]"], where: str,
) -> Atmosphere | None:  # fmt: skip
    """Return the declared air in the camera's band."""
    if given_air is None:
        follow = partial(air_in_weather, *weather_now()) if air_of_weather else None
        return declared_air(spec_atmosphere, band_um, where, follow)
    if (given_air.lower_um.min(), given_air.upper_um.max()) == tuple(band_um):
        return given_air
    try:
        return given_air.in_band(*band_um)
    except ThermorenderError as error:
        raise ThermorenderError(f"{where}: {error}") from None


def air_in_weather(weather: "Weather", time: Any, **keys: Any) -> Atmosphere:
    """Return the Atmosphere of a Weather at an instant; keys as of `from_weather`."""
    from thermorender.atmosphere.from_weather import NearGround, from_weather

    at = weather.at(time)
    near = NearGround(*(float(getattr(at, name)) for name in NearGround._fields))
    return from_weather(near, weather.latitude_deg, weather.altitude_m, time, **keys)


def clear_of_clouds(air: Atmosphere | None, shape: Shape, altitude_m: float, where: str) -> None:
    """Refuse surfaces above the base of the clouds."""
    if air is not None:
        air.refuse_above_clouds(f"{where}: the highest surface", altitude_m + shape.highest_m)


def sun(
    temperatures: Temperatures, spec_sun: SunSpec | None, air: Atmosphere | None, time: "np.datetime64 | None",
    weather: Callable[[], "Weather"],
) -> SunSpec | None:  # fmt: skip
    """Return the sun that shines on the scene, or None.

    It is the declared one, or that of the weather at `time`, provided that its direct irradiance is above 120 W m⁻².
    Until temperatures that follow the weather are solved there is none.
    """
    if spec_sun is not None or time is None:
        return spec_sun
    if air is None or not temperatures.state.solved:
        return None
    azimuth, elevation = map(float, weather().sun(time))
    shines = elevation > 0.0 and float(weather().at(time).direct_w_m2) > _SUNSHINE_W_M2
    return SunSpec(elevation, azimuth) if shines else None


# --- materials ------------------------------------------------------------------------------------------------------


def no_snow(
    spec_emissivity: EmissivitySpec, spec_weather: WeatherSpec | None, time: "np.datetime64 | None",
    given_weather: "Weather | None", frame: LocalFrame | None, weather: Callable[[], "Weather"],
) -> str:  # fmt: skip
    """Return why no snow lies on the ground by the weather; "" if it may, or where no learned map asks."""
    if spec_emissivity.source != "learned" or spec_weather is None or time is None:
        return ""
    if given_weather is None and frame is None:
        return ""
    return weather().why_no_snow(time)


def snow(no_snow: str) -> bool:
    """Return whether a learned map may find snow."""
    return not no_snow


def covering(
    spec_emissivity: EmissivitySpec, spec_objects: Sequence[ObjectSpec], spec_surfaces: Sequence[SurfaceSpec],
    replaced: Replaced, painted: tuple[Patch, ...], band_um: tuple[float, float],
) -> Covering:  # fmt: skip
    """Return what the scene declares on its materials."""
    objects = tuple((item.name, item.material) for item in spec_objects)
    parts = tuple(replace(one, temperature=None, inferred=None) for one in spec_surfaces)
    learned = band_um if spec_emissivity.source == "learned" else None
    return Covering(spec_emissivity, objects, parts, replaced, painted, learned)


def cover(files: SceneFiles | None, in_memory: InMemory | None, covering: Covering, snow: bool, where: str) -> Cover:
    """Return which material covers each texel and object."""
    if in_memory:
        _refuse_edit(in_memory, "covering", covering, "its materials", where)
        return in_memory.cover
    assert files is not None
    return cover_of(files, covering, snow, where)


def emissivity_report(cover: Cover, no_snow: str) -> Mapping[str, Any]:
    """Return the report of the learned emissivity map; empty without one."""
    if "context" not in cover.report:
        return cover.report
    return {**cover.report, "context": tuple(note.replace(WHY, no_snow) for note in cover.report["context"])}


def albedo(spec_weather: WeatherSpec | None) -> float | None:
    """Return the stated reflectance of the terrain for sunlight."""
    return spec_weather.albedo if spec_weather else None


def materials(
    cover: Cover, files: SceneFiles | None, in_memory: InMemory | None, band_um: tuple[float, float],
    albedo: float | None, spec_terrain: TerrainSpec, where: str,
) -> tuple[Material, ...]:  # fmt: skip
    """Return the materials that `Surface.material` indexes, in the camera's band and of the stated albedo."""
    if in_memory:
        _refuse_edit(in_memory, "albedo", albedo, "its materials", where)
        for material in in_memory.materials:
            refuse_band(material, band_um, where)
        return in_memory.materials
    assert files is not None
    found = [within_band(material, band_um, files.library, where) for material in cover.tables]
    if albedo is not None:
        share = shares(files.near, cover.ground[: len(files.near)], len(found), spec_terrain.mesh is not None)
        found = with_albedo(found, share, albedo, where)
    return tuple(found)


def refuse_band(material: Material, band_um: tuple[float, float], where: str) -> None:
    """Refuse a material that does not cover the camera's band."""
    try:
        material.emissivity_at(np.array(band_um))
    except ThermorenderError as error:
        raise ThermorenderError(f"{where}: {error}") from None


# --- temperatures ---------------------------------------------------------------------------------------------------


def temperature_inputs(
    follows: Follows, spec_weather: WeatherSpec | None, given_weather: "Weather | None", time: "np.datetime64 | None",
    stated_altitude_m: float | None, spec_objects: Sequence[ObjectSpec], spec_sun: SunSpec | None,
    air: Atmosphere | None, spec_sky_temperature: float | None,
) -> TemperatureInputs | None:  # fmt: skip
    """Return what the temperatures are solved from; None where they do not follow the weather."""
    if not follows:
        return None
    still = tuple((item.temperature, item.inner_heat_w) for item in spec_objects if item.track is None)
    sky = (spec_sky_temperature if air is None else air) if follows == "conditional" else None
    return TemperatureInputs(spec_weather, given_weather, time, stated_altitude_m, still, spec_sun, sky)


def part_temperatures(spec_surfaces: Sequence[SurfaceSpec]) -> tuple[SurfaceSpec, ...]:
    """Return the parts of a mesh that have their own temperatures."""
    return tuple(SurfaceSpec(name=one.name, temperature=one.temperature) for one in spec_surfaces)


def covered(
    follows: Follows, given: bool, given_kelvin: tuple[NDArray[Any], ...] | None, spec_temperature: TemperatureSpec,
    cover: Cover, materials: tuple[Material, ...],
) -> tuple[Cover, tuple[Material, ...]] | None:  # fmt: skip
    """Return the materials that temperatures depend on; None where they are the same on any material."""
    plain = given_kelvin is not None or spec_temperature.source in ("constant", "raster")
    return None if given or (plain and not follows) else (cover, materials)


def far_temperatures(spec_terrain: TerrainSpec) -> "tuple[float | Path | None, ...]":
    """Return the own temperature of each far ground."""
    return tuple(one.temperature for one in spec_terrain.far)


# (Temperature [K], a table of them, None where the heat balance solves it; inner heat [W]) of each object.
_Heat = tuple[tuple["float | Path | None", float], ...]


def object_heat(spec_objects: Sequence[ObjectSpec]) -> _Heat:
    """Return (temperature [K], None where the heat balance solves it, and inner heat [W]) of each object."""
    return tuple((item.temperature, item.inner_heat_w) for item in spec_objects)


def surfaces(
    shape: Shape, cover: Cover, materials: tuple[Material, ...], temperatures: Temperatures,
    object_heat: _Heat, in_memory: InMemory | None, where: str,
) -> tuple[Surface, ...]:  # fmt: skip
    """Return the surfaces: the terrain's first, then those of objects without a track."""
    terrain = tuple(
        replace(
            bare,
            colour=own.colour,
            material=own.material,
            temperature=warm,
            flags=own.flags | more if more.any() else own.flags,
        )
        for bare, own, warm, more in zip(
            shape.ground, cover.ground, temperatures.kelvin, temperatures.flags, strict=True
        )
    )
    static = list(shape.static if in_memory else _objects(shape, cover, materials, object_heat, where))
    for number, (kelvin, scatter_k) in enumerate(temperatures.objects):
        static[number] = replace(static[number], temperature=kelvin, scatter_k=scatter_k)
    return (*terrain, *static)


def _objects(
    shape: Shape, cover: Cover, materials: tuple[Material, ...], object_heat: _Heat,
    where: str,
) -> Iterator[Surface]:  # fmt: skip
    """Yield the surfaces of objects without a track, NaN where the heat balance solves their temperature."""
    for surface, number, inner_1_m2 in zip(shape.static, shape.static_of, shape.inner_1_m2, strict=True):
        name, material = surface.name.split(":")[0], materials[cover.objects[number]]
        kelvin, inner_w = object_heat[number]
        if kelvin is None:
            _refuse_without_thermal(name, material, where)
        if surface.instances is not None and material.emissivity_by_angle is not None:
            raise ThermorenderError(
                f"{where}: object {name!r} has {surface.instances} of the material {material.name!r}, whose emissivity "
                "depends on the angle, which copies and crowns do not support; give them another material"
            )
        yield replace(_covered(surface, cover.objects[number], kelvin), inner_w_m2=inner_w * inner_1_m2)


def _refuse_without_thermal(name: str, material: Material, where: str) -> None:
    """Refuse an object whose heat balance is asked for and whose material has no thermal table."""
    for part, _ in parts_of(material):
        if part.thermal is None:
            raise ThermorenderError(
                f"{where}: object {name!r} has temperature='balance' and the material {part.name!r}, which has no "
                f"thermal properties; give it another material, add thermal/{part.name}.csv to the scene's "
                "materials, or give the object kelvin"
            )


def tracked_objects(
    shape: Shape, cover: Cover, spec_objects: Sequence[ObjectSpec], in_memory: InMemory | None, where: str
) -> tuple[TrackedObject, ...]:
    """Return the objects with a track, each in its own frame."""
    if in_memory:
        _refuse_edit(in_memory, "objects", spec_objects, "an object", where)
        return shape.tracked
    return tuple(
        replace(
            one, item=spec_objects[number],
            surfaces=tuple(
                _covered(surface, cover.objects[number], spec_objects[number].temperature) for surface in one.surfaces
            ),
        )
        for one, number in zip(shape.tracked, shape.tracked_of, strict=True)
    )  # fmt: skip


def _covered(surface: Surface, material: int, kelvin: "float | Path | None") -> Surface:
    """A surface of one material and temperature, NaN where it is to be solved; crowns may have those of a table."""
    texels = surface.flags.shape
    own = replace(surface, material=np.full(texels, material, np.uint8))
    if isinstance(kelvin, Path):
        return own
    warm = np.full(texels, np.nan if kelvin is None else kelvin, np.float32)
    return replace(own, temperature=warm, scatter_k=None)


def temperature_state(temperatures: Temperatures) -> TemperatureState:
    """Return whether the terrain's temperatures are known, and the source of those that follow the weather."""
    return temperatures.state


def solution_notes(temperatures: Temperatures) -> tuple[str, ...]:
    """Return the notes of solving the temperatures."""
    return temperatures.state.notes if isinstance(temperatures.state, Available) else ()


def refuse_unsolved(temperatures: Temperatures, where: str) -> None:
    """Raise unless the terrain's temperatures are known."""
    state = temperatures.state
    if not state.solved and state.source is not None:
        raise ThermorenderError(
            f"{where}: the temperatures of {state.source.words} are not solved yet; use Renderer(scene).scene"
        )


def surroundings_temperature(
    spec_surroundings_temperature: float | None, refuse_unsolved: Callable[[], None], surfaces: tuple[Surface, ...],
    terrain_count: int,
) -> float:  # fmt: skip
    """Return the temperature of the black background beyond the terrain's edge [K]: as stated, else the mean of the
    terrain without far ground."""
    if spec_surroundings_temperature is not None:
        return float(spec_surroundings_temperature)
    refuse_unsolved()
    terrain = [surface.temperature.ravel() for surface in surfaces[:terrain_count] if not surface.far]
    return float(np.concatenate(terrain).mean(dtype=np.float64))


# --- the whole ------------------------------------------------------------------------------------------------------


def agreement(
    air: Atmosphere | None, spec_sky_temperature: float | None, spec_sun: SunSpec | None,
    surfaces: tuple[Surface, ...], terrain_count: int, materials: tuple[Material, ...], temperatures: Temperatures,
    where: str,
) -> None:  # fmt: skip
    """Refuse a scene that cannot be rendered, though each of its parts is allowed."""
    if air is None and spec_sky_temperature is None:
        raise ThermorenderError(f"{where}: the scene has neither sky nor air; call with_sky(kelvin) or with_air(name)")
    if spec_sun is not None and air is None:
        raise ThermorenderError(
            f"{where}: the scene declares a sun, which shines through air, and has no air; call with_air, or "
            "with_sun(None)"
        )
    highest = max(int(surface.material.max(initial=0)) for surface in surfaces)
    if highest >= len(materials):
        raise ThermorenderError(
            f"{where}: a texel has material number {highest}, but the scene has {len(materials)} "
            "materials; give with_surfaces one for each number"
        )
    known = all(np.isfinite(surface.temperature).all() for surface in surfaces[:terrain_count])
    if temperatures.state.solved and not known:
        raise ThermorenderError(
            f"{where}: texels of the terrain have no temperature, though they should be known; set a source by "
            "with_temperature"
        )


def surface_notes(
    surfaces: tuple[Surface, ...], terrain_count: int, tracked_objects: tuple[TrackedObject, ...], ground: Ground
) -> tuple[str, ...]:
    """Return sentences on objects under the ground, and on those that share a plane with another surface."""
    sunk = buried.notes(surfaces, terrain_count, tracked_objects, ground)
    return (*sunk, *coplanar.notes(surfaces, terrain_count))


PIPELINE = Pipeline(
    (where, frame, geoid_undulation_m, stated_altitude_m, altitude_m, placements, shape, grid, terrain_count,
     solved_count, band_um, air_of_weather, no_snow, snow, covering, cover, emissivity_report, albedo, materials, air,
     clear_of_clouds, follows, temperature_inputs, part_temperatures, far_temperatures, covered,
     temperatures, temperature_state,
     solution_notes, object_heat, surfaces, tracked_objects),
    lazy=(weather, weather_now, noted_weather, sun, ground, refuse_unsolved, surroundings_temperature, agreement,
          surface_notes, digest, weather_digest),
)  # fmt: skip
