"""The air declared in a scene file: a standard atmosphere, a table, a profile or that of the weather, in a band."""

from collections.abc import Callable
from typing import Any

from thermorender.atmosphere.absorption import from_absorption
from thermorender.atmosphere.model import Atmosphere
from thermorender.atmosphere.profile import from_profile
from thermorender.errors import ThermorenderError


def declared_air(
    spec: Any, band_um: tuple[float, float], where: object, of_weather: Callable[..., Atmosphere] | None = None
) -> Atmosphere | None:
    """Return the Atmosphere of an AtmosphereSpec over the camera's band [µm], or None for None.

    `where` is the scene file, for messages; `of_weather` makes the air of the weather from aerosol, cloud_fraction and
    cloud_base_m.
    """
    if spec is None:
        return None
    given = {"cloud_fraction": spec.cloud_fraction, "cloud_base_m": spec.cloud_base_m}
    clouds = {"cloud_fraction": 0.0} | {name: value for name, value in given.items() if value is not None}
    mixed = {"gases": spec.gases} | ({} if spec.year is None else {"year": spec.year})
    try:
        if spec.standard == "weather" and of_weather:
            air = of_weather(aerosol=spec.aerosol, gases=spec.gases, **given)
        elif spec.file:
            air = Atmosphere.load(spec.file).clouded(**clouds)
        elif spec.absorption:
            air = from_absorption(spec.absorption, spec.profile, **clouds)
        elif spec.profile:
            air = from_profile(spec.profile, spec.aerosol, spec.visibility_km, **clouds, **mixed)
        else:
            air = Atmosphere.standard(
                spec.standard, spec.aerosol, spec.temperature_offset_k, spec.humidity_factor, **clouds, **mixed
            )
        return air.in_band(*band_um)
    except ThermorenderError as error:
        raise ThermorenderError(f"{where}: [atmosphere] {error}") from None
