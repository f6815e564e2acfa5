"""Radiance reflected by a surface, and kinetic temperature from apparent radiance."""

import numpy as np
from numpy.typing import ArrayLike

from thermorender.physics.band import Emissivity, Floats, RadianceTable, emitted_radiance


def reflected_radiance(emissivity: Emissivity, temperature: ArrayLike, lower_um: float, upper_um: float) -> Floats:
    """Return the band radiance of an isotropic blackbody reflected by a diffuse opaque surface [W m⁻² sr⁻¹].

    Parameters
    ----------
    emissivity : callable
        Wavelengths [µm] → emissivity of the surface; its reflectance is 1 − ε (Kirchhoff).
    temperature : array
        Temperature of the surroundings [K].
    """
    return emitted_radiance(lambda wavelength: 1.0 - emissivity(wavelength), temperature, lower_um, upper_um)


def kinetic_temperature(
    apparent_radiance: ArrayLike, emissivity: Emissivity, sky_temperature: float, band_um: tuple[float, float],
    range_k: tuple[float, float],
) -> Floats:  # fmt: skip
    """Return the kinetic temperature [K] of a surface from its apparent radiance; NaN for no solution in `range_k`.

    Parameters
    ----------
    apparent_radiance : array
        Band radiance leaving the surface [W m⁻² sr⁻¹].
    emissivity : callable
        Wavelengths [µm] → emissivity.
    sky_temperature : float
        Temperature of the isotropic blackbody sky during the measurement [K].
    band_um : (lower, upper)
        Band [µm].
    range_k : (coldest, warmest)
        Plausible kinetic temperatures [K]; NaN outside.

    Notes
    -----
    Solves ∫[ε B(T) + (1−ε) B(T_sky)] dλ = L for T. An error of L grows by 1/ε or more in T, so low ε needs the
    plausible range.
    """
    table = RadianceTable.of(emissivity, *range_k, *band_um)
    emitted = np.asarray(apparent_radiance) - reflected_radiance(emissivity, sky_temperature, *band_um)
    temperature = table.inverse(emitted)
    return np.where((temperature >= range_k[0]) & (temperature <= range_k[1]), temperature, np.nan)
