"""Radiance leaving a surface, and the kinetic temperature behind an apparent one."""

import numpy as np

from thermorender.physics.band import RadianceTable, emitted_radiance


def reflected_radiance(emissivity, temperature, lower_um, upper_um):
    """Return the band radiance a diffuse opaque surface reflects from an isotropic blackbody [W m⁻² sr⁻¹].

    Parameters
    ----------
    emissivity : callable
        Wavelengths [µm] → emissivity of the surface; its reflectance is 1 − ε (Kirchhoff).
    temperature : array
        Temperature of the surroundings [K].
    """
    return emitted_radiance(lambda wavelength: 1.0 - emissivity(wavelength), temperature, lower_um, upper_um)


def kinetic_temperature(apparent_radiance, emissivity, sky_temperature, band_um, range_k):
    """Return the kinetic temperature [K] of a surface seen at an apparent radiance, NaN where there is none.

    Parameters
    ----------
    apparent_radiance : array
        Band radiance leaving the surface [W m⁻² sr⁻¹].
    emissivity : callable
        Wavelengths [µm] → emissivity.
    sky_temperature : float
        Temperature of the isotropic blackbody sky the radiance was measured under [K].
    band_um : (lower, upper)
        Band [µm].
    range_k : (coldest, warmest)
        Kinetic temperatures that are believed [K]; NaN outside.

    Notes
    -----
    Solves ∫[ε B(T) + (1−ε) B(T_sky)] dλ = L for T. The smaller ε, the larger an error of L becomes in T
    (by 1/ε and more), which is why the believed range is an argument.
    """
    table = RadianceTable.of(emissivity, *range_k, *band_um)
    emitted = np.asarray(apparent_radiance) - reflected_radiance(emissivity, sky_temperature, *band_um)
    temperature = table.inverse(emitted)
    return np.where((temperature >= range_k[0]) & (temperature <= range_k[1]), temperature, np.nan)
