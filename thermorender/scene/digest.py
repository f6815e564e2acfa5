"""Hashes of everything a frame depends on, for the resumption of flights and the reuse of cached light.

The parameters of `digest` are what a frame depends on; `Scene.changes` compares scenes by them.
"""

import hashlib
from collections.abc import Callable
from dataclasses import fields
from typing import TYPE_CHECKING, Any

import numpy as np

from thermorender.atmosphere.model import Atmosphere
from thermorender.materials.material import Material
from thermorender.scene.spec import SunSpec, TemperatureSpec, WeatherSpec
from thermorender.scene.surface import Surface
from thermorender.scene.temperature_state import Conditional, Moved, TemperatureState
from thermorender.scene.tracks import TrackedObject
from thermorender.schema import every_field
from thermorender.sensor.camera import Camera

if TYPE_CHECKING:
    from thermorender.weather.series import Weather


def digest(
    surfaces: tuple[Surface, ...], materials: tuple[Material, ...], tracked_objects: tuple[TrackedObject, ...],
    camera: Camera, spec_sky_temperature: float | None, spec_surroundings_temperature: float | None,
    air: Atmosphere | None, altitude_m: float, sun: SunSpec | None, temperature_state: TemperatureState,
    time: "np.datetime64 | None", spec_temperature: TemperatureSpec, spec_weather: WeatherSpec | None,
    noted_weather: Callable[[], "Weather"],
) -> str:  # fmt: skip
    """Return the fingerprint (hex) of everything a frame of a scene depends on."""
    # Libraries change how NumPy writes numbers, for the whole process.
    with np.printoptions(legacy=False):
        state = hashlib.blake2b(digest_size=16)
        for surface in (*surfaces, *(each for tracked in tracked_objects for each in tracked.surfaces)):
            own = {row.name: getattr(surface, row.name) for row in fields(surface)}
            # Without copies nothing is added, so that they change no fingerprint.
            copies = own.pop("instances")
            if own["scatter_k"] is None:
                own.pop("scatter_k")
            for name in ("inner_w_m2", "far", "seeds", "joined"):
                if own[name] is None or not np.any(own[name]):
                    own.pop(name)
            for value in (*own.values(), *(vars(copies).values() if copies is not None else ())):
                state.update(_bytes(value))
        for material in materials:
            state.update(material.name.encode() + material.wavelength_um.tobytes() + material.emissivity.tobytes())
            for table in (material.cosines, material.emissivity_by_angle):
                state.update(b"" if table is None else table.tobytes())
            layers = material.thermal.layers if material.thermal else ()
            # An empty texture is left out, so that it changes no fingerprint.
            known = [{key: each for key, each in layer.values.items() if key != "texture" or each} for layer in layers]
            state.update(repr((material.solar_absorptance, known)).encode())
        for tracked in tracked_objects:
            # What moves has neither copies nor a heat balance.
            item = every_field(tracked.item, "instances", "inner_heat_w", "inner_heat_share")
            state.update(f"({item}, {tracked.lift_m!r})".encode())
            state.update(tracked.time_s.tobytes())
            for name, values in tracked.columns.items():
                state.update(name.encode() + values.tobytes())
        skies = f"{spec_sky_temperature!r}, {spec_surroundings_temperature!r}"
        state.update(f"({every_field(camera, *camera.absent)}, {skies})".encode())
        if air:
            state.update(repr((air.cloud_fraction, air.cloud_base_m, altitude_m, sun)).encode())
            for row in fields(air):
                if isinstance(value := getattr(air, row.name), np.ndarray):
                    state.update(value.tobytes())
        source = temperature_state.source
        if source is not None:
            asked = repr((time, spec_temperature, spec_weather))
            state.update(asked.encode() + weather_digest(noted_weather()).encode())
        if isinstance(source, Moved):
            for kelvin in source.temperatures:
                state.update(kelvin.tobytes())
        if isinstance(source, Conditional):
            # Another map may agree at this instant and differ at others of a flight.
            state.update(source.model.digest().encode())
        return state.hexdigest()


def weather_digest(noted_weather: "Weather") -> str:
    """Return the fingerprint (hex) of a Weather: its series, its place and what was filled in."""
    state = hashlib.blake2b(digest_size=16)
    with np.printoptions(legacy=False):
        for row in fields(noted_weather):
            state.update(_bytes(getattr(noted_weather, row.name)))
    return state.hexdigest()


def _bytes(value: Any) -> bytes:
    return value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode()
