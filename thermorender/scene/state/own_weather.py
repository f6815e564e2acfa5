"""The weather that a scene declares, at its own place."""

from typing import TYPE_CHECKING

from thermorender.errors import ThermorenderError
from thermorender.scene.parts.shape import Shape
from thermorender.scene.state.declared import Declared

if TYPE_CHECKING:
    from thermorender.weather.series import Weather


def weather_of(now: Declared, shape: Shape) -> "Weather":
    """Return the Weather that a scene declares, at its own place."""
    if now.spec.weather is None or now.time is None:
        raise ThermorenderError(f"{now.where} has no [weather]; add it")
    if now.weather is not None:
        given: Weather = now.weather
        return given
    if shape.frame is None:
        raise ThermorenderError(
            f"{now.where}: [weather] needs a place, which a mesh does not have; add [frame] with latitude_deg, "
            "longitude_deg and height_m"
        )
    from thermorender.weather.declared import declared_weather

    try:
        return declared_weather(
            now.spec.weather, shape.frame.latitude_deg, shape.frame.longitude_deg, now.height_m(shape.frame)
        )
    except ThermorenderError as error:
        raise ThermorenderError(f"{now.where}: {error}") from None


def no_snow_of(now: Declared, shape: Shape, weather: "Weather | None" = None) -> str:
    """Return why no snow lies on a scene's ground by its weather; "" if it may, or where no learned map asks.

    `weather` is that of the scene, where it is known.
    """
    if now.spec.emissivity.source != "learned" or now.spec.weather is None or now.time is None:
        return ""
    if now.weather is None and shape.frame is None:
        return ""
    return (weather or weather_of(now, shape)).why_no_snow(now.time)
