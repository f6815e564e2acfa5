"""Absorbers of the air: scaled densities of LOWTRAN7's band models from pressure, temperature and gas amounts.

The amount of an absorber on a path is the integral of its scaled density. Water is several absorbers: its lines below
and above 1000 cm⁻¹, its self continuum (square of the density, stronger in cold air) and its foreign continuum.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.units import ZERO_CELSIUS_K

Floats = NDArray[np.float64]


def saturation_g_m3(temperature: ArrayLike) -> Floats:
    """Return the density of saturated water vapour over liquid water [g m⁻³] at temperatures [K].

    LOWTRAN's fit, so that relative humidities agree: Kneizys et al. (1988), Users Guide to LOWTRAN 7, AFGL-TR-88-0177.
    """
    ratio = ZERO_CELSIUS_K / np.asarray(temperature, dtype=np.float64)
    return ratio * np.exp(18.9766 - 14.9595 * ratio - 2.43882 * np.square(ratio))


def offset_water(
    temperature: Floats, water: Floats, temperature_offset_k: float, humidity_factor: float
) -> tuple[Floats, Floats]:
    """Return (temperature [K], water vapour [g m⁻³]) of a profile made warmer and moister.

    A change of temperature keeps the mixing ratio. Vapour is limited to saturation over liquid water, or to the
    original profile where that has more.
    """
    warmer = temperature + temperature_offset_k
    moister = water * humidity_factor * temperature / warmer
    return warmer, np.minimum(moister, np.maximum(saturation_g_m3(warmer), water))


# Exponents of pressure and of inverse temperature in the scaled amounts of LOWTRAN7's band models for 7–14.5 µm, by
# gas (row of the table's `gas`): Kneizys et al. (1988), AFGL-TR-88-0177, table of band model parameters.
BAND_MODELS = (
    (0, 1.1406, -2.6343),  # water, up to 1000 cm⁻¹
    (0, 0.9834, -2.5294),  # water, above
    (1, 0.6705, -2.2560),  # carbon dioxide, up to 835 cm⁻¹
    (1, 0.7038, -5.0768),  # carbon dioxide, above
    (2, 0.4221, 0.7678),  # ozone
    (3, 0.7203, -0.1836),  # nitrous oxide
    (4, 0.7139, -0.4185),  # methane
    (5, 0.0, 0.0),  # nitric acid
)
GASES = ("water", "carbon dioxide", "ozone", "nitrous oxide", "methane", "nitric acid")
ABSORBERS = (
    "water lines up to 1000 cm⁻¹", "water lines above 1000 cm⁻¹", "carbon dioxide up to 835 cm⁻¹",
    "carbon dioxide above 835 cm⁻¹", "ozone", "nitrous oxide", "methane", "nitric acid",
    "water continuum, self, 296 K", "water continuum, self, change to 260 K", "water continuum, foreign",
)  # fmt: skip


def scaled_densities(pressure_hpa: ArrayLike, temperature: ArrayLike, gas: Floats) -> Floats:
    """Return the scaled density of each gaseous absorber, (11, L), in the order of ABSORBERS.

    `gas` (6, L) is water vapour [g m⁻³] and the others [cm-atm km⁻¹], in the order of GASES. Line absorption: amount ×
    (p/p₀)ⁿ (T₀/T)ᵐ. Continuum: water times water, the same times (296 K − T)/36 K limited to 0…1, and water times dry
    air, in units of the density of air at p₀, T₀.
    """
    pressure = np.asarray(pressure_hpa, dtype=np.float64) / 1013.25
    cold = ZERO_CELSIUS_K / np.asarray(temperature, dtype=np.float64)
    lines = [gas[row] * pressure**n * cold**m for row, n, m in BAND_MODELS]
    # 1 g/m³ of water vapour has 1/803.8 of the molecules in a cubic metre of air at p₀, T₀.
    water = gas[0] / 803.8
    fall = np.clip((296.0 - np.asarray(temperature)) / 36.0, 0.0, 1.0)
    return np.stack([*lines, water**2, water**2 * fall, water * (pressure * cold - water)])


def exponential(altitude: ArrayLike, levels: Floats, values: Floats) -> Floats:
    """Return `values` (J, L) at levels interpolated to altitudes, exponentially, or linearly where an end is 0.

    Below the lowest level the values are constant, above the highest 0.
    """
    altitude = np.asarray(altitude, np.float64)
    upper = np.clip(np.searchsorted(levels, altitude), 1, len(levels) - 1)
    part = np.clip((altitude - levels[upper - 1]) / (levels[upper] - levels[upper - 1]), 0.0, 1.0)
    first, last = values[:, upper - 1], values[:, upper]
    return np.where(altitude > levels[-1], 0.0, between(first, last, part))


def between(first: Floats, last: Floats, part: Floats) -> Floats:
    """Return the interpolation from first (part 0) to last (part 1), exponential, or linear where one of them is 0."""
    # Powers of each, because their ratio may leave float64.
    powers = first ** (1.0 - part) * last**part
    return np.where((first > 0.0) & (last > 0.0), powers, first + (last - first) * part)
