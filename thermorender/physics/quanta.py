"""Light in photons: those per joule of a blackbody's band radiance, and the growth of their number with temperature."""

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.physics.planck import BOLTZMANN, C2, band_radiance, band_radiance_derivative, spectral_radiance

# Temperatures of the table [K], and nodes across the band.
_TABLE_K, _NODES = np.geomspace(100.0, 20_000.0, 2048), 64


@lru_cache(maxsize=8)
def _table(lower_um: float, upper_um: float) -> tuple[NDArray[np.float64], ...]:
    """(Band radiance [W m⁻² sr⁻¹], photons per joule, photons more per joule more) of blackbodies, (n,) each."""
    node, weight = np.polynomial.legendre.leggauss(_NODES)
    half = 0.5 * (upper_um - lower_um)
    wavelength = 0.5 * (upper_um + lower_um) + half * node
    x = C2 / (wavelength * _TABLE_K[:, None])
    # A photon has hc/λ joules.
    spectral = spectral_radiance(wavelength, _TABLE_K[:, None]) * wavelength / (C2 * BOLTZMANN)
    photons = spectral @ weight * half
    per_kelvin = (spectral * x / -np.expm1(-x)) @ weight * half / _TABLE_K
    radiance = band_radiance(_TABLE_K, lower_um, upper_um)
    return radiance, photons / radiance, per_kelvin / band_radiance_derivative(_TABLE_K, lower_um, upper_um)


def photons_per_joule(
    radiance: ArrayLike, lower_um: float, upper_um: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return (photons per joule, photons more per joule more) of blackbodies, in the shape of `radiance`.

    Parameters
    ----------
    radiance : array
        Band radiance [W m⁻² sr⁻¹], of 100 K to 20 000 K; beyond, the values of these hold.
    lower_um, upper_um : float
        Limits of the band [µm].
    """
    table, ratio, slope = _table(lower_um, upper_um)
    radiance = np.asarray(radiance, np.float64)
    return np.interp(radiance, table, ratio), np.interp(radiance, table, slope)


def photon_growth(temperature: float, lower_um: float, upper_um: float) -> float:
    """Return d(ln photon radiance)/dT of a blackbody [K⁻¹] at a temperature [K]."""
    radiance = band_radiance(temperature, lower_um, upper_um)
    ratio, slope = photons_per_joule(radiance, lower_um, upper_um)
    return float(slope / ratio * band_radiance_derivative(temperature, lower_um, upper_um) / radiance)
