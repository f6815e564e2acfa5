"""All that a scene declares and all that follows from it, as plain values: two scenes are compared to the bit."""

import dataclasses
import hashlib
from typing import Any

import numpy as np

import thermorender as tr
from thermorender.errors import ThermorenderError


def content(value: Any) -> Any:
    """A value as plain ones: two have the same content if they are the same to the bit."""
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, hashlib.blake2b(value.tobytes()).hexdigest()
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        own = {row.name: content(getattr(value, row.name)) for row in dataclasses.fields(value)}
        return type(value).__name__, own
    if isinstance(value, (tuple, list)):
        return [content(each) for each in value]
    if isinstance(value, dict):
        return {key: content(each) for key, each in value.items()}
    if callable(value):
        return getattr(value, "__qualname__", type(value).__name__)
    return repr(value)


def refusal(act: Any) -> Any:
    """The content of a result, or the sentence that refuses it."""
    try:
        return content(act())
    except ThermorenderError as error:
        return str(error)


def everything(scene: tr.Scene) -> dict[str, Any]:
    """The content of all that a scene declares and all that follows from it."""
    names = ("spec", "camera", "time", "frame", "grid", "surfaces", "terrain_count", "solved_count", "materials", "air",
             "tracked_objects", "temperature_state", "emissivity_report", "where", "altitude_m", "sky_temperature",
             "surroundings_temperature", "sun", "weather", "sky_notes", "surface_notes", "targets",
             "geoid_undulation_m")  # fmt: skip
    found = {name: refusal(lambda name=name: getattr(scene, name)) for name in names}
    calls = {
        "digest": scene.digest, "weather_digest": scene.weather_digest, "agreement": scene.refuse_disagreement,
        "text": lambda: str(scene), "line": lambda: repr(scene), "ground": lambda: scene.ground(0.3, 0.4),
    }  # fmt: skip
    return found | {name: refusal(act) for name, act in calls.items()}


def different(one: tr.Scene, other: tr.Scene) -> list[str]:
    """Names of what differs between two scenes."""
    first, second = everything(one), everything(other)
    return [name for name in first if first[name] != second[name]]
