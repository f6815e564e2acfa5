"""Whether the parts of a scene agree: the bands of camera, air and materials, the sun, the instant of temperatures.

Edits preserve this. The renderer checks it before baking, so that a scene built in another way is refused.
"""

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.scene.parts.cover import refuse_band
from thermorender.scene.state.declared import Declared
from thermorender.scene.state.derived import Derived
from thermorender.scene.temperature_state import Known
from thermorender.units import utc_text

# Files store the limits of bands in single precision [µm].
_SAME_UM = 1e-6


def refuse_disagreement(declared: Declared, derived: Derived) -> None:
    """Raise where parts of a scene do not belong together.

    Raises
    ------
    ThermorenderError
        States which parts disagree and which edit corrects it.
    """
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
