"""Whether the parts of a scene agree: the bands of camera, air and materials, the sun, the instant of temperatures.

Edits preserve this. The renderer checks it before baking, so that a scene built in another way is refused.
"""

from typing import TYPE_CHECKING

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.scene.parts.cover import refuse_band
from thermorender.scene.state.declared import Declared
from thermorender.scene.state.derived import Derived, air_of
from thermorender.scene.temperature_state import Known
from thermorender.units import utc_text

if TYPE_CHECKING:
    from thermorender.weather.series import Weather

# Files store the limits of bands in single precision [µm].
_SAME_UM = 1e-6
# Differences between a declared air or sky and the weather that are reported: of the air's temperature near the ground
# [K], and of the sky's irradiance in the camera's band [W m⁻²]. Outside the band a clear sky is nearly as warm as the
# air, so the second is nearly the difference of the long-wave.
_AIR_K, _SKY_W_M2 = 5.0, 15.0


def refuse_disagreement(declared: Declared, derived: Derived) -> None:
    """Raise where parts of a scene do not belong together."""
    where, band, air = declared.where, declared.camera.band_um, derived.air
    if air is None and declared.spec.sky_temperature is None:
        raise ThermorenderError(f"{where}: the scene has neither sky nor air; call with_sky(kelvin) or with_air(name)")
    if air is not None:
        own = float(air.lower_um.min()), float(air.upper_um.max())
        if not np.allclose(own, band, rtol=0.0, atol=_SAME_UM):
            raise ThermorenderError(
                f"{where}: the air is that of {own[0]:g}–{own[1]:g} µm and the camera {declared.camera.name!r} sees "
                f"{band[0]:g}–{band[1]:g} µm; set the camera by with_camera, which makes the air again"
            )
    for material in derived.cover.materials:
        refuse_band(material, band, where)
    if declared.spec.sun is not None and air is None:
        raise ThermorenderError(
            f"{where}: the scene declares a sun, which shines through air, and has no air; call with_air, or "
            "with_sun(None)"
        )
    highest = max(int(surface.material.max(initial=0)) for surface in derived.surfaces)
    if highest >= len(derived.cover.materials):
        raise ThermorenderError(
            f"{where}: a texel has material number {highest}, but the scene has {len(derived.cover.materials)} "
            "materials; give with_surfaces one for each number"
        )
    state = derived.temperature_state
    if isinstance(state, Known) and state.weather_driven:
        if state.time != declared.time:
            solved, now = ("no instant" if each is None else utc_text(each) for each in (state.time, declared.time))
            raise ThermorenderError(
                f"{where}: the temperatures were solved for {solved} and the scene is at {now}; set the instant by "
                "at(time), and they are solved again"
            )
    terrain = derived.surfaces[: len(derived.shape.ground)]
    if state.solved and not all(np.isfinite(surface.temperature).all() for surface in terrain):
        raise ThermorenderError(
            f"{where}: texels of the terrain have no temperature, though they should be known; set a source by "
            "with_temperature"
        )


def contradictions(declared: Declared, derived: Derived, weather: "Weather") -> tuple[str, ...]:
    """Return sentences on a declared air or sky that differs from that of the weather by more than 5 K or 15 W/m²."""
    if derived.weather is not None or declared.time is None:
        return ()
    found, air, altitude_m = [], derived.air, declared.height_m(derived.shape.frame)
    advice = "leave out [sky] and [atmosphere], or call with_air('weather'), to take the weather's"
    when = f"at {utc_text(declared.time)}"
    if air is not None:
        own, measured = float(air.air_temperature(altitude_m)), float(weather.at(declared.time).air_k)
        if abs(own - measured) > _AIR_K:
            found.append(
                f"the declared air is {own:.1f} K near the ground, and the weather's {measured:.1f} K {when}; {advice}"
            )
    other = air_of(weather, declared.time).in_band(*declared.camera.band_um)
    kelvin = [
        declared.spec.sky_temperature if air is None else air.sky_temperature(altitude_m),
        other.sky_temperature(max(altitude_m, 0.0)),
    ]
    radiance = other.planck(np.array(kelvin, np.float64)).sum(axis=-1)
    difference = float(np.pi * (radiance[0] - radiance[1]))
    if abs(difference) > _SKY_W_M2:
        found.append(
            f"the declared sky is {kelvin[0]:.0f} K in the camera's band, and the weather's {kelvin[1]:.0f} K {when}: "
            f"{difference:+.0f} W/m² on the ground; {advice}"
        )
    return tuple(found)
