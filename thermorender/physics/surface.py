"""Radiance reflected by a surface, and kinetic temperature from apparent radiance."""

import numpy as np
from numpy.typing import ArrayLike

from thermorender.physics.band import Emissivity, Floats, RadianceTable, emitted_radiance


def reflected_radiance(emissivity: Emissivity, temperature: ArrayLike, lower_um: float, upper_um: float) -> Floats:
    """Return the band radiance of a blackbody of `temperature` [K] all around, reflected diffusely [W m⁻² sr⁻¹].

    `emissivity` maps wavelengths [µm] to that of the opaque surface; its reflectance is 1 − ε (Kirchhoff).
    """
    return emitted_radiance(lambda wavelength: 1.0 - emissivity(wavelength), temperature, lower_um, upper_um)


def kinetic_temperature(
    apparent_radiance: ArrayLike, emissivity: Emissivity, sky_temperature: float, band_um: tuple[float, float],
    range_k: tuple[float, float],
) -> Floats:  # fmt: skip
    """Return the kinetic temperature [K] of a surface from its apparent radiance [W m⁻² sr⁻¹]; NaN outside `range_k`.

    Solves ∫[ε B(T) + (1−ε) B(T_sky)] dλ = L for T, with an isotropic blackbody sky. An error of L grows by 1/ε or more
    in T, so low ε needs the plausible range. `emissivity` maps wavelengths [µm] to ε.
    """
    table = RadianceTable.of(emissivity, *range_k, *band_um)
    emitted = np.asarray(apparent_radiance) - reflected_radiance(emissivity, sky_temperature, *band_um)
    temperature = table.inverse(emitted)
    return np.where((temperature >= range_k[0]) & (temperature <= range_k[1]), temperature, np.nan)
