"""Moist air: saturation over water and ice, precipitable water, and pressure by altitude."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.units import ZERO_CELSIUS_K

# Alduchov and Eskridge, J. Appl. Meteorol. 35 (1996) 601, doi:10.1175/1520-0450(1996)035<0601:IMFAOS>2.0.CO;2,
# eqs 21 and 23: pressure at 0 °C [Pa], factor, offset [K].
MAGNUS = {"water": (610.94, 17.625, 243.04), "ice": (611.21, 22.587, 273.86)}
# The standard atmosphere's troposphere: pressure [Pa], temperature [K] at sea level, lapse [K/m], exponent.
_SEA_PA, _SEA_K, LAPSE_K_M, PRESSURE_EXPONENT = 101325.0, 288.15, 0.0065, 5.255880


def saturation_pressure(temperature: NDArray[np.float64], over: str = "water") -> NDArray[np.float64]:
    """Return the saturation vapour pressure [Pa] over liquid water or ice at temperatures [K].

    Magnus form of Alduchov and Eskridge (1996), within 0.4 % over −40 … 50 °C (water) and −80 … 0 °C (ice).
    Meteorology defines relative humidity and dew point over water below freezing too.
    """
    pressure, factor, offset = MAGNUS[over]
    celsius = temperature - ZERO_CELSIUS_K
    return pressure * np.exp(factor * celsius / (celsius + offset))


def dew_point(vapour_pa: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the dew point over water [K] of vapour pressures [Pa], the inverse of `saturation_pressure`."""
    pressure, factor, offset = MAGNUS["water"]
    ratio = np.log(np.maximum(vapour_pa, 1e-3) / pressure)
    return ZERO_CELSIUS_K + offset * ratio / (factor - ratio)


def standard_pressure(altitude_m: ArrayLike) -> NDArray[np.float64]:
    """Return the pressure [Pa] at altitudes [m], −5 … 11 km, in the ICAO standard atmosphere (Doc 7488)."""
    return _SEA_PA * (1.0 - LAPSE_K_M / _SEA_K * np.asarray(altitude_m, np.float64)) ** PRESSURE_EXPONENT


def precipitable_water(vapour_pa: NDArray[np.float64], temperature: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the precipitable water [cm] from vapour pressure [Pa] and temperature [K] near the ground.

    Prata, Q. J. R. Meteorol. Soc. 122 (1996) 1127, doi:10.1002/qj.49712253306: 46.5 e/T with e in hPa.
    """
    return 0.465 * vapour_pa / temperature
