"""The record of a frame, and of the weather, versions and device that it was made with."""

from typing import TYPE_CHECKING, Any

import numpy as np

from thermorender.render.variant import active_device
from thermorender.scene.temperature_state import Conditional
from thermorender.units import utc_text
from thermorender.versions import versions

if TYPE_CHECKING:
    from thermorender.frame import Frame
    from thermorender.scene.load import Scene


def record(frame: "Frame") -> dict[str, Any]:
    """Return a frame's line in `frames.jsonl`: time, pose, seed, plan, budget and targets, as plain values."""
    return {
        "index": frame.index,
        "time_s": frame.time_s,
        "time": None if frame.time is None else utc_text(frame.time),
        "world_from_camera": np.round(frame.pose, 9).tolist(),
        "seed": frame.seed,
        "camera": frame.camera.name,
        "plan": frame.plan,
        "budget_mk": frame.budget_mk and {cause: round(value, 2) for cause, value in frame.budget_mk.items()},
        "targets": frame.targets,
    }


def weather_of(scene: "Scene") -> dict[str, Any]:
    """Return the weather of a scene's temperatures, and the learned map that depends on it, as plain values.

    {} if the temperatures do not depend on the weather.
    """
    state = scene.temperature_state
    if not state.weather_driven:
        return {}
    spec = scene.spec.weather
    file = spec.file or spec.epw
    named = "named day" if file is None else file.name
    found: dict[str, Any] = {
        "weather": {"source": named, "digest": scene.weather_digest(), "notes": list(scene.weather_notes)}
    }
    if isinstance(state.source, Conditional):
        model = state.source.model
        found["map"] = {"name": model.name, "digest": model.digest(), **state.report.get(model.name, {})}
    return found | ({"moved": state.moved_report} if state.moved_report else {})


def made_by() -> dict[str, Any]:
    """Return the versions and the device of this process, as plain values: {"versions": …, "device": …}."""
    return {"versions": versions(), "device": active_device()}
