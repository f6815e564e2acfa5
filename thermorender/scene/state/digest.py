"""Fingerprints of a scene and its weather: hashes of everything a frame depends on.

Flights resume and cached light is reused by these, so their input changes only where a frame may change.
"""

import hashlib
from dataclasses import fields
from typing import Any

import numpy as np

from thermorender.scene.state.declared import Declared
from thermorender.scene.state.derived import Derived
from thermorender.scene.temperature_state import Conditional, Moved
from thermorender.schema import every_field


def digest_of(declared: Declared, derived: Derived, sun: Any, weather: Any) -> str:
    """Return the fingerprint (hex) of everything a frame of a scene depends on.

    Parameters
    ----------
    declared : Declared
    derived : Derived
    sun : SunSpec or None
        The sun that shines.
    weather : Weather or None
        None where the temperatures do not follow it.
    """
    # Libraries change how NumPy writes numbers, for the whole process.
    with np.printoptions(legacy=False):
        return _digest(declared, derived, sun, weather)


def weather_digest_of(weather: Any) -> str:
    """Return the fingerprint (hex) of a Weather: its series, its place and what was filled in."""
    state = hashlib.blake2b(digest_size=16)
    with np.printoptions(legacy=False):
        for item in fields(weather):
            value = getattr(weather, item.name)
            state.update(value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode())
    return state.hexdigest()


def _digest(declared: Declared, derived: Derived, sun: Any, weather: Any) -> str:
    state, spec, air = hashlib.blake2b(digest_size=16), declared.spec, derived.air
    moved = [surface for tracked in derived.tracked_objects for surface in tracked.surfaces]
    for surface in (*derived.surfaces, *moved):
        parts: dict[str, Any] = {item.name: getattr(surface, item.name) for item in fields(surface)}
        # Without copies nothing is added, so that they change no fingerprint.
        copies: Any = parts.pop("instances")
        if parts["scatter_k"] is None:
            parts.pop("scatter_k")
        for value in (*parts.values(), *(vars(copies).values() if copies is not None else ())):
            state.update(value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode())
    for material in derived.cover.materials:
        state.update(material.name.encode() + material.wavelength_um.tobytes() + material.emissivity.tobytes())
        for table in (material.cosines, material.emissivity_by_angle):
            state.update(b"" if table is None else table.tobytes())
        layers = material.thermal.layers if material.thermal else ()
        # An empty texture is left out, so that it changes no fingerprint.
        own = [{key: each for key, each in layer.values.items() if key != "texture" or each} for layer in layers]
        state.update(repr((material.solar_absorptance, own)).encode())
    for tracked in derived.tracked_objects:
        # What moves has no copies.
        item_text = repr((tracked.item, tracked.lift_m)).replace(", instances=None", "")
        state.update(item_text.encode() + tracked.time_s.tobytes())
        for name, values in tracked.columns.items():
            state.update(name.encode() + values.tobytes())
    skies = f"{spec.sky_temperature!r}, {spec.surroundings_temperature!r}"
    state.update(f"({every_field(declared.camera)}, {skies})".encode())
    if air:
        altitude_m = declared.height_m(derived.shape.frame)
        state.update(repr((air.cloud_fraction, air.cloud_base_m, altitude_m, sun)).encode())
        for item in fields(air):
            if isinstance(value := getattr(air, item.name), np.ndarray):
                state.update(value.tobytes())
    if weather is not None:
        asked = repr((declared.time, spec.temperature, spec.weather))
        state.update(asked.encode() + weather_digest_of(weather).encode())
    source = derived.temperature_state.source
    if isinstance(source, Moved):
        for kelvin in source.temperatures:
            state.update(kelvin.tobytes())
    if isinstance(source, Conditional):
        # Another map may agree at this instant and differ at others of a flight.
        state.update(source.model.digest().encode())
    return state.hexdigest()
