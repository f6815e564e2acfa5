"""Notes on a scene's sky and weather: sentences for the user on what looks wrong or was assumed."""

from typing import TYPE_CHECKING

import numpy as np

from thermorender.defaults import BAND_UM
from thermorender.physics.planck import band_radiance
from thermorender.scene import albedo, open_ground
from thermorender.scene.spec import WEATHER
from thermorender.scene.stages import air_in_weather
from thermorender.scene.weathered_ground import leaf_notes
from thermorender.units import ZERO_CELSIUS_K, utc_text

if TYPE_CHECKING:
    from thermorender.scene.scene import Scene

# Differences between a declared air or sky and the weather that are reported: of the air's temperature near the ground
# [K], and of the sky's irradiance in 7.5–13.5 µm [W m⁻²]. Outside that band a clear sky is nearly as warm as the air,
# so the second is nearly the difference of the long-wave. Another band's limit is the same share of a blackbody.
_AIR_K, _SKY_W_M2, _BLACK_K = 5.0, 15.0, 280.0
# Water in snow that nobody recorded [mm], and difference of rooms from the air outside [K], that are reported.
_LIKELY_SNOW_MM, _INDOORS_K = 3.0, 12.0


def of_sky(scene: "Scene") -> tuple[str, ...]:
    """Return sentences on a declared air or sky that differs from that of the weather by more than 5 K or 15 W/m² in
    the long wave."""
    spec = scene.spec
    of_weather = spec.atmosphere is not None and spec.atmosphere.standard == WEATHER
    if scene.time is None or of_weather:
        return ()
    found, air, altitude_m, weather = [], scene.air, scene.altitude_m, scene.weather
    advice = "leave out [sky] and [atmosphere], or call with_air('weather'), to take the weather's"
    when = f"at {utc_text(scene.time)}"
    if air is not None:
        own, measured = float(air.air_temperature(altitude_m)), float(weather.at(scene.time).air_k)
        if abs(own - measured) > _AIR_K:
            found.append(
                f"the declared air is {own:.1f} K near the ground, and the weather's {measured:.1f} K {when}; {advice}"
            )
    other = air_in_weather(weather, scene.time).in_band(*scene.camera.band_um)
    kelvin = [
        spec.sky_temperature if air is None else air.sky_temperature(altitude_m),
        other.sky_temperature(max(altitude_m, 0.0)),
    ]
    radiance = other.planck(np.array(kelvin, np.float64)).sum(axis=-1)
    difference = float(np.pi * (radiance[0] - radiance[1]))
    share = band_radiance(_BLACK_K, *scene.camera.band_um) / band_radiance(_BLACK_K, *BAND_UM)
    if abs(difference) > _SKY_W_M2 * share:
        digits = 0 if abs(difference) >= 10.0 else 2
        found.append(
            f"the declared sky is {kelvin[0]:.0f} K in the camera's band, and the weather's {kelvin[1]:.0f} K {when}: "
            f"{difference:+.{digits}f} W/m² on the ground; {advice}"
        )
    return tuple(found)


def of_weather(scene: "Scene") -> tuple[str, ...]:
    """Return notes on the weather: filled gaps, a short record, snow, likely snow, rooms, leaves and albedo."""
    weather, time = scene.weather, scene.time
    assert time is not None and scene.spec.weather is not None
    before_h = (time - weather.time[0]) / np.timedelta64(3600, "s")
    found = list(weather.notes)
    if before_h < 24.0:
        found.append(
            f"the weather begins {before_h:.1f} h before {utc_text(time)}: with less than a day the ground "
            "stays near its initial state"
        )
    snow = float(weather.at(time).snow_m)
    if snow > 0.0 and not any(each.thermal and each.thermal.cover == "snow" for each in scene.materials):
        found.append(
            f"the weather has {snow:.2g} m of snow, but no material of the scene is snow, so the heat balance lays "
            "it on soil, grass and heath only, with their own emissivity; use the material snow where there is snow"
        )
    likely = weather.likely_snow_mm(time)
    if likely > _LIKELY_SNOW_MM:
        found.append(
            f"about {likely:.0f} mm of water fell as snow and have not melted by {utc_text(time)}, and the weather "
            "states no snow on the ground, so the ground gets too warm; leave snow_depth_m out or state the depth"
        )
    outside_c, inside_c = float(weather.at(time).air_k) - ZERO_CELSIUS_K, scene.spec.weather.inside_c
    if abs(outside_c - inside_c) > _INDOORS_K and any(open_ground.over_room(material) for material in scene.materials):
        found.append(
            f"rooms below roofs are at inside_c={inside_c:g} °C, and the air outside is at {outside_c:.0f} °C; "
            "state inside_c in [weather] if that is wrong"
        )
    return (*found, *leaf_notes(scene.materials, weather, time), *albedo.notes(scene))
