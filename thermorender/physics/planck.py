"""Planck's law: spectral radiance, band radiance, its temperature derivative, and the inverse to kelvin.

Everything is in terms of wavelength in micrometres; band radiance is the integral of spectral radiance
over a wavelength interval. The integral is taken in x = c₂/(λT), where the integrand is x³/(eˣ−1) at every
temperature, and is cut where the remaining tail is below 1e-20 of it: 64 Gauss–Legendre nodes then hold
1e-12 relative from 1 K (where float64 still holds the value) up, in bands of any width. Where x is below 1e-6 all
over the band Rayleigh and Jeans' law stands for it, as exactly, to the end of float64.
"""

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.units import ZERO_CELSIUS_K

# CODATA 2018, exact in the 2019 SI.
_H, _C = 6.62607015e-34, 299792458.0
# Boltzmann's constant [J K⁻¹].
BOLTZMANN = 1.380649e-23
# First radiation constant for radiance, 2hc² [W m⁻² sr⁻¹ µm⁴], and second radiation constant hc/k [µm K].
C1L = 2.0 * _H * _C**2 * 1e24
C2 = _H * _C / BOLTZMANN * 1e6

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(64)
_NODES = 0.5 * (_NODES + 1.0)
_WEIGHTS = 0.5 * _WEIGHTS
_TAIL = 50.0
# Limits of the band radiance [W m⁻² sr⁻¹] and of λT/c₂ between which it is inverted by its integral.
_FAINTEST, _HOTTEST = 1e-290, 1e6
# λT/c₂ below which a blackbody's radiance, e^(−10 000), is 0 in float64.
_COLDEST = 1e-4
_WIEN = np.polynomial.Polynomial([6.0, 6.0, 3.0, 1.0])
_CHUNK = 4096
# Wavelengths that are computed with [µm]: beyond these powers of them would leave float64.
_SHORTEST_UM, _LONGEST_UM = 1e-12, 1e18
# Entries of a table of slopes.
_SLOPES = 4096


def spectral_radiance(wavelength_um, temperature):
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
    Planck (1901), doi:10.1002/andp.19013090310: B = 2hc²/λ⁵ / (exp(hc/λkT) − 1). The exponential is taken
    of the negative argument, so nothing overflows; below the range of float64 the value is 0, above it infinite.
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


def band_radiance(temperature, lower_um, upper_um):
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
    Relative error at or below 1e-12 wherever the value is a normal float64, in bands from 1 pm wide; below the range
    of float64 it is 0, above it infinite.
    """
    return _band_integral(temperature, lower_um, upper_um, 0)


def band_radiance_derivative(temperature, lower_um, upper_um):
    """Return d(band radiance)/dT [W m⁻² sr⁻¹ K⁻¹], in the shape of `temperature`.

    Parameters, range and errors as in `band_radiance`.
    """
    return _band_integral(temperature, lower_um, upper_um, 1)


def brightness_temperature(radiance, lower_um, upper_um):
    """Return the temperature of the blackbody with this band radiance [K], in the shape of `radiance`.

    Parameters
    ----------
    radiance : array
        Band radiance [W m⁻² sr⁻¹], any positive float64, or float32. Zero gives 0 K; negative values, infinities and
        NaN give NaN, since no blackbody has them; a temperature beyond float64 is infinite.
    lower_um, upper_um : float
        Limits of the band [µm].

    Notes
    -----
    Newton's method on ln L as a function of 1/T, which is nearly straight and convex, so it converges from
    every start; the result is exact to about 1e-12 relative. Radiances whose blackbody lies so far in Wien's or in
    Rayleigh's and Jeans' limit that the integral leaves float64 are inverted by these laws, as exactly.
    `scipy.optimize.newton` takes arrays too, but goes on with all of them until the last has converged, and does not
    limit steps.
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


def kelvin_per_radiance(radiance, lower_um, upper_um):
    """Return d(brightness temperature)/d(band radiance) [K W⁻¹ m² sr], in the shape of `radiance`.

    Parameters
    ----------
    radiance : array
        Band radiance [W m⁻² sr⁻¹]. Zero gives infinity, and so do values so faint that the slope leaves float64; what
        no blackbody has gives NaN.
    lower_um, upper_um : float
        Limits of the band [µm].

    Notes
    -----
    Of more than 4096 values it is read from a table of so many, even in ln L, in which ln dT/dL is nearly straight:
    relative error at or below 1e-6 where radiances span less than ten decades.
    """

    def exact(values):
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


def _faint_inverse(radiance, lower, upper):
    """Temperature of radiances below `_FAINTEST`, where x = c₂/(λT) > 600 and Wien's law, x³ e⁻ˣ, is exact."""
    ratio, target = upper / lower, np.log(radiance)
    x = -target
    # ∫ x³ e⁻ˣ dx = −(x³ + 3x² + 6x + 6) e⁻ˣ; each round leaves less than 1/100 of the error.
    for _ in range(9):
        wide = _WIEN(x) - _WIEN(ratio * x) * np.exp(-(ratio - 1.0) * x)
        x = np.log(C1L) - 4.0 * np.log(upper * x) + np.log(wide) - target
    return C2 / (upper * x)


def _slope_of_hot(lower, upper):
    """Band radiance per kelvin by Rayleigh and Jeans' law, 2ck/λ⁴ [W m⁻² sr⁻¹ K⁻¹]."""
    # lower⁻³ − upper⁻³, without its cancellation.
    ratio = lower / upper
    return C1L / C2 * (upper - lower) / upper * (1.0 + ratio + ratio**2) / (3.0 * lower**3)


def _offset_of_hot(lower, upper):
    """What is taken off Rayleigh and Jeans' law [W m⁻² sr⁻¹] where x = c₂/(λT) < 1/`_HOTTEST`.

    There x³/(eˣ−1) is x² (1 − x/2) to 1e-13.
    """
    return C1L * (lower**-4 - upper**-4) / 8.0


def _hot_inverse(radiance, lower, upper):
    """Temperature of radiances where x = c₂/(λT) < 1/`_HOTTEST`."""
    with np.errstate(over="ignore"):
        return (radiance + _offset_of_hot(lower, upper)) / _slope_of_hot(lower, upper)


def _checked(temperature):
    temperature = np.asarray(temperature, dtype=np.float64)
    if np.any(temperature < 0.0):
        raise ThermorenderError(
            f"temperature={np.nanmin(temperature):g} is below 0 K; values are kelvin, add {ZERO_CELSIUS_K} to °C"
        )
    return temperature


def _band(lower_um, upper_um):
    lower, upper = float(lower_um), float(upper_um)
    if not _SHORTEST_UM <= lower < upper <= _LONGEST_UM:
        raise ThermorenderError(
            f"band {lower:g}–{upper:g} µm is not a band; give {_SHORTEST_UM:g} ≤ lower < upper ≤ {_LONGEST_UM:g} in "
            "micrometres"
        )
    return lower, upper


def _band_integral(temperature, lower_um, upper_um, which):
    lower, upper = _band(lower_um, upper_um)
    temperature = _checked(temperature)
    result = _integrals(temperature.reshape(-1), lower, upper)[which].reshape(temperature.shape)
    return result if result.ndim else float(result)


def _integrals(temperature, lower, upper):
    """Band radiance and its derivative of a flat array of temperatures; 0 K gives 0 for both."""
    value, slope = np.empty(temperature.shape), np.empty(temperature.shape)
    for start in range(0, temperature.size, _CHUNK):
        part = slice(start, start + _CHUNK)
        cold, hot = temperature[part] < _COLDEST * C2 / upper, temperature[part] > _HOTTEST * C2 / lower
        warm = np.where(cold | hot, 1.0, temperature[part])
        first = C2 / (upper * warm)
        # c₂/(lower T) less the first, without its cancellation.
        width = np.minimum((upper - lower) / lower * first, _TAIL)
        x = first[:, None] + width[:, None] * _NODES
        with np.errstate(under="ignore"):
            # 1/(eˣ−1), and eˣ/(eˣ−1)² = n(n+1), without an overflow.
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
