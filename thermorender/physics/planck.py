"""Planck's law: spectral radiance, band radiance, its temperature derivative, and the inverse to kelvin.

Wavelengths are in micrometres; band radiance is the integral of spectral radiance over a wavelength interval. The
integration variable is x = c₂/(λT), with the integrand x³/(eˣ−1) at every temperature. The integral ends where the
remaining tail is below 1e-20 of it. With 64 Gauss–Legendre nodes the relative error is then at or below 1e-12 from
1 K up, in bands of any width. If x is below 1e-6 in the whole band, the Rayleigh–Jeans law replaces the integral, to
the same accuracy.
"""

from typing import Any, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.errors import ThermorenderError
from thermorender.units import ZERO_CELSIUS_K

# CODATA 2018, exact in the 2019 SI.
_H, _C = 6.62607015e-34, 299792458.0
# Boltzmann's constant [J K⁻¹].
BOLTZMANN = 1.380649e-23
# First radiation constant for radiance, 2hc² [W m⁻² sr⁻¹ µm⁴], and second radiation constant hc/k [µm K].
C1L = 2.0 * _H * _C**2 * 1e24
C2 = _H * _C / BOLTZMANN * 1e6
STEFAN_BOLTZMANN = 5.670374419e-8  # W m⁻² K⁻⁴, CODATA 2018

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(64)
_NODES = 0.5 * (_NODES + 1.0)
_WEIGHTS = 0.5 * _WEIGHTS
_TAIL = 50.0
# The integral is inverted for band radiances [W m⁻² sr⁻¹] above the first limit and λT/c₂ below the second.
_FAINTEST, _HOTTEST = 1e-290, 1e6
# λT/c₂ below which a blackbody's radiance, e^(−10 000), is 0 in float64.
_COLDEST = 1e-4
_WIEN = np.polynomial.Polynomial([6.0, 6.0, 3.0, 1.0])
_CHUNK = 4096
# Range of wavelengths [µm]: outside it their powers leave float64.
_SHORTEST_UM, _LONGEST_UM = 1e-12, 1e18
# Entries of a table of slopes.
_SLOPES = 4096

Floats = NDArray[np.float64]


def spectral_radiance(wavelength_um: ArrayLike, temperature: ArrayLike) -> Floats:
    """Return blackbody spectral radiance [W m⁻² sr⁻¹ µm⁻¹], broadcast over both arguments.

    Parameters
    ----------
    wavelength_um : array
        Vacuum wavelength [µm], 1e-12 … 1e18; NaN gives NaN.
    temperature : array
        Temperature [K], at or above 0; NaN gives NaN.

    Raises
    ------
    ThermorenderError
        A negative temperature or a wavelength out of range.

    Notes
    -----
    Planck (1901), doi:10.1002/andp.19013090310: B = 2hc²/λ⁵ / (exp(hc/λkT) − 1). The exponential has a negative
    argument and cannot overflow. Below the range of float64 the value is 0, above it infinite.
    """
    wavelength = np.asarray(wavelength_um, dtype=np.float64)
    if np.any((wavelength < _SHORTEST_UM) | (wavelength > _LONGEST_UM)):
        worst = np.nanmin(wavelength) if np.any(wavelength < _SHORTEST_UM) else np.nanmax(wavelength)
        raise ThermorenderError(
            f"wavelength_um={worst:g} is out of range; give {_SHORTEST_UM:g} … {_LONGEST_UM:g} micrometres"
        )
    temperature = _checked(temperature)
    with np.errstate(divide="ignore", under="ignore", over="ignore"):
        x = C2 / (wavelength * temperature)
        return C1L / wavelength**5 * np.exp(-x) / -np.expm1(-x)


@overload
def band_radiance(temperature: float, lower_um: float, upper_um: float) -> float: ...
@overload
def band_radiance(temperature: NDArray[Any], lower_um: float, upper_um: float) -> Floats: ...
def band_radiance(temperature: ArrayLike, lower_um: float, upper_um: float) -> Floats | float:
    """Return blackbody radiance between two wavelengths [W m⁻² sr⁻¹], in the shape of `temperature`.

    Parameters
    ----------
    temperature : array
        Temperature [K], at or above 0; NaN gives NaN.
    lower_um, upper_um : float
        Limits of the band [µm].

    Raises
    ------
    ThermorenderError
        A negative temperature, or limits that are not 1e-12 ≤ lower < upper ≤ 1e18.

    Notes
    -----
    The relative error is at or below 1e-12 where the value is a normal float64, in bands at least 1 pm wide. Below
    the range of float64 the value is 0, above it infinite.
    """
    return _band_integral(temperature, lower_um, upper_um, 0)


@overload
def band_radiance_derivative(temperature: float, lower_um: float, upper_um: float) -> float: ...
@overload
def band_radiance_derivative(temperature: NDArray[Any], lower_um: float, upper_um: float) -> Floats: ...
def band_radiance_derivative(temperature: ArrayLike, lower_um: float, upper_um: float) -> Floats | float:
    """Return d(band radiance)/dT [W m⁻² sr⁻¹ K⁻¹], in the shape of `temperature`.

    Parameters, range and errors as in `band_radiance`.
    """
    return _band_integral(temperature, lower_um, upper_um, 1)


@overload
def brightness_temperature(radiance: float, lower_um: float, upper_um: float) -> float: ...
@overload
def brightness_temperature(radiance: NDArray[Any], lower_um: float, upper_um: float) -> Floats: ...
def brightness_temperature(radiance: ArrayLike, lower_um: float, upper_um: float) -> Floats | float:
    """Return the temperature of the blackbody with this band radiance [K], in the shape of `radiance`.

    Parameters
    ----------
    radiance : array
        Band radiance [W m⁻² sr⁻¹], float64 or float32. Zero gives 0 K; negative values, infinities and NaN give NaN.
        A temperature beyond float64 is infinite.
    lower_um, upper_um : float
        Limits of the band [µm].

    Notes
    -----
    Newton's method on ln L as a function of 1/T. The function is convex and nearly straight, so every start
    converges; the relative error is about 1e-12. In the Wien and Rayleigh–Jeans limits, where the integral leaves
    float64, these laws are inverted instead, to the same accuracy. `scipy.optimize.newton` was not used: it iterates
    all values until the last has converged, and does not limit steps.
    """
    lower, upper = _band(lower_um, upper_um)
    radiance = np.asarray(radiance, dtype=np.float64)
    flat = radiance.reshape(-1)
    result = np.where(flat == 0.0, 0.0, np.nan)
    positive = (flat > 0.0) & np.isfinite(flat)
    faint, hot = positive & (flat < _FAINTEST), flat > _slope_of_hot(lower, upper) * _HOTTEST * C2 / lower
    hot &= positive
    result[faint] = _faint_inverse(flat[faint], lower, upper)
    result[hot] = _hot_inverse(flat[hot], lower, upper)
    valid = np.flatnonzero(positive & ~faint & ~hot)
    if valid.size:
        target = np.log(flat[valid])
        # Start from a monochromatic inversion at mid-band.
        middle = 0.5 * (lower + upper)
        inverse = np.log1p(C1L * (upper - lower) / middle**5 / flat[valid]) * middle / C2
        active = np.arange(valid.size)
        for _ in range(50):
            temperature = 1.0 / inverse[active]
            value, slope = _integrals(temperature, lower, upper)
            step = (np.log(value) - target[active]) * value / (slope * temperature**2)
            # ln L against 1/T falls, so the Newton step adds; halving keeps 1/T positive.
            inverse[active] = np.maximum(inverse[active] + step, 0.5 * inverse[active])
            active = active[np.abs(step) > 1e-14 * inverse[active]]
            if not active.size:
                break
        result[valid] = 1.0 / inverse
    result = result.reshape(radiance.shape)
    return result if result.ndim else float(result)


def kelvin_per_radiance(radiance: ArrayLike, lower_um: float, upper_um: float) -> Floats:
    """Return d(brightness temperature)/d(band radiance) [K W⁻¹ m² sr], in the shape of `radiance`.

    Parameters
    ----------
    radiance : array
        Band radiance [W m⁻² sr⁻¹]. Zero gives infinity, and so do values so faint that the slope leaves float64;
        negative values, infinities and NaN give NaN.
    lower_um, upper_um : float
        Limits of the band [µm].

    Notes
    -----
    More than 4096 values are interpolated in a table of 4096 entries, evenly spaced in ln L, where ln dT/dL is nearly
    straight. The relative error is at or below 1e-6 for radiances that span less than ten decades.
    """

    def exact(values: Floats) -> Floats:
        kelvin = brightness_temperature(values, lower_um, upper_um)
        with np.errstate(divide="ignore", over="ignore"):
            return np.divide(1.0, band_radiance_derivative(kelvin, lower_um, upper_um))

    radiance = np.asarray(radiance, dtype=np.float64)
    positive = (radiance > 0.0) & (radiance < np.inf)
    if np.count_nonzero(positive) <= _SLOPES:
        return exact(radiance)
    log = np.log(radiance, where=positive, out=np.full(radiance.shape, np.nan))
    grid = np.linspace(np.nanmin(log), np.nanmax(log), _SLOPES)
    slope = np.exp(np.interp(log, grid, np.log(exact(np.exp(grid)))))
    return np.where(radiance == 0.0, np.inf, slope)


def _faint_inverse(radiance: Floats, lower: float, upper: float) -> Floats:
    """Temperature [K] of radiances below `_FAINTEST`: x = c₂/(λT) > 600, so Wien's law, x³ e⁻ˣ, is exact."""
    ratio, target = upper / lower, np.log(radiance)
    x = -target
    # ∫ x³ e⁻ˣ dx = −(x³ + 3x² + 6x + 6) e⁻ˣ; each iteration reduces the error by at least 100.
    for _ in range(9):
        wide = _WIEN(x) - _WIEN(ratio * x) * np.exp(-(ratio - 1.0) * x)
        x = np.log(C1L) - 4.0 * np.log(upper * x) + np.log(wide) - target
    return C2 / (upper * x)


def _slope_of_hot(lower: float, upper: float) -> float:
    """Band radiance per kelvin by the Rayleigh–Jeans law, 2ck/λ⁴ [W m⁻² sr⁻¹ K⁻¹]."""
    # lower⁻³ − upper⁻³, without cancellation.
    ratio = lower / upper
    return C1L / C2 * (upper - lower) / upper * (1.0 + ratio + ratio**2) / (3.0 * lower**3)


def _offset_of_hot(lower: float, upper: float) -> float:
    """Correction subtracted from the Rayleigh–Jeans law [W m⁻² sr⁻¹], for x = c₂/(λT) < 1/`_HOTTEST`.

    There x³/(eˣ−1) is x² (1 − x/2) to 1e-13.
    """
    return C1L * (lower**-4 - upper**-4) / 8.0


def _hot_inverse(radiance: Floats, lower: float, upper: float) -> Floats:
    """Temperature [K] of radiances with x = c₂/(λT) < 1/`_HOTTEST`."""
    with np.errstate(over="ignore"):
        return (radiance + _offset_of_hot(lower, upper)) / _slope_of_hot(lower, upper)


def _checked(temperature: ArrayLike) -> Floats:
    temperature = np.asarray(temperature, dtype=np.float64)
    if np.any(temperature < 0.0):
        raise ThermorenderError(
            f"temperature={np.nanmin(temperature):g} is below 0 K; values are kelvin, add {ZERO_CELSIUS_K} to °C"
        )
    return temperature


def _band(lower_um: float, upper_um: float) -> tuple[float, float]:
    lower, upper = float(lower_um), float(upper_um)
    if not _SHORTEST_UM <= lower < upper <= _LONGEST_UM:
        raise ThermorenderError(
            f"band {lower:g}–{upper:g} µm is not a band; give {_SHORTEST_UM:g} ≤ lower < upper ≤ {_LONGEST_UM:g} in "
            "micrometres"
        )
    return lower, upper


def _band_integral(temperature: ArrayLike, lower_um: float, upper_um: float, which: int) -> Floats | float:
    lower, upper = _band(lower_um, upper_um)
    temperature = _checked(temperature)
    result = _integrals(temperature.reshape(-1), lower, upper)[which].reshape(temperature.shape)
    return result if result.ndim else float(result)


def _integrals(temperature: Floats, lower: float, upper: float) -> tuple[Floats, Floats]:
    """Band radiance and its derivative at temperatures (n,); 0 K gives 0 for both."""
    value, slope = np.empty(temperature.shape), np.empty(temperature.shape)
    for start in range(0, temperature.size, _CHUNK):
        part = slice(start, start + _CHUNK)
        cold, hot = temperature[part] < _COLDEST * C2 / upper, temperature[part] > _HOTTEST * C2 / lower
        warm = np.where(cold | hot, 1.0, temperature[part])
        first = C2 / (upper * warm)
        # c₂/(lower T) − first, without cancellation.
        width = np.minimum((upper - lower) / lower * first, _TAIL)
        x = first[:, None] + width[:, None] * _NODES
        with np.errstate(under="ignore"):
            # n = 1/(eˣ−1), and eˣ/(eˣ−1)² = n(n+1), without overflow.
            occupation = np.exp(-x) / -np.expm1(-x)
            integrand = x * x * x * occupation
            scale = C1L * (warm / C2) ** 4 * width
            value[part] = np.where(cold, 0.0, scale * (integrand @ _WEIGHTS))
            slope[part] = np.where(cold, 0.0, scale / warm * ((x * integrand * (1.0 + occupation)) @ _WEIGHTS))
        if hot.any():
            straight = _slope_of_hot(lower, upper)
            with np.errstate(over="ignore"):
                value[part][hot] = straight * temperature[part][hot] - _offset_of_hot(lower, upper)
            slope[part][hot] = straight
    return value, slope
