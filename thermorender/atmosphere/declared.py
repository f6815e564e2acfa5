"""The air a scene file declares: a standard atmosphere, a table or a profile, limited to the camera's band."""

from thermorender.atmosphere.absorption import from_absorption
from thermorender.atmosphere.model import Atmosphere
from thermorender.atmosphere.profile import from_profile
from thermorender.errors import ThermorenderError


def declared_air(spec, band_um, where):
    """Return the Atmosphere of an AtmosphereSpec over a band, or None for None.

    Parameters
    ----------
    spec : AtmosphereSpec or None
    band_um : (2,) floats
        The camera's band [µm].
    where : str
        Path of the scene file, for messages.

    Raises
    ------
    ThermorenderError
        An unknown name, a value out of range, a file that cannot be used, or a table that does not cover the band.
    """
    if spec is None:
        return None
    clouds = {"cloud_fraction": spec.cloud_fraction, "cloud_base_m": spec.cloud_base_m}
    try:
        if spec.file:
            air = Atmosphere.load(spec.file).clouded(**clouds)
        elif spec.absorption:
            air = from_absorption(spec.absorption, spec.profile, **clouds)
        elif spec.profile:
            air = from_profile(spec.profile, spec.aerosol, spec.visibility_km, **clouds)
        else:
            air = Atmosphere.standard(
                spec.standard, spec.aerosol, spec.temperature_offset_k, spec.humidity_factor, **clouds
            )
        return air.in_band(*band_um)
    except ThermorenderError as error:
        raise ThermorenderError(f"{where}: [atmosphere] {error}") from None
