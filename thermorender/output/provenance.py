"""The record of the weather, versions and device that frames were made with."""

from typing import TYPE_CHECKING, Any

from thermorender.render.variant import active_device
from thermorender.scene.temperature_state import Conditional
from thermorender.versions import versions

if TYPE_CHECKING:
    from thermorender.scene.scene import Scene


def weather_of(scene: "Scene") -> dict[str, Any]:
    """Return the weather of a scene's temperatures and its learned map as plain values, {} if they do not use it."""
    state = scene.temperature_state
    spec = scene.spec.weather
    if not state.weather_driven or spec is None:
        return {}
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
