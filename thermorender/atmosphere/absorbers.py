"""Absorbers of the air: what LOWTRAN7's band models make of pressure, temperature and amounts of gas.

Along a path each absorber counts through one number, the integral of its scaled density. Water counts several times:
its lines below and above 1000 cm⁻¹, and its continuum between its own molecules (with the square of its density, more
when cold) and with those of dry air.
"""

import numpy as np

from thermorender.units import ZERO_CELSIUS_K


def saturation_g_m3(temperature):
    """Return the density of saturated water vapour over liquid water [g m⁻³] at temperatures [K].

    Kneizys et al. (1988), Users Guide to LOWTRAN 7, AFGL-TR-88-0177: its fit, so that relative humidities agree.
    """
    ratio = ZERO_CELSIUS_K / np.asarray(temperature, dtype=np.float64)
    return ratio * np.exp(18.9766 - 14.9595 * ratio - 2.43882 * np.square(ratio))


def offset_water(temperature, water, temperature_offset_k, humidity_factor):
    """Return (temperature [K], water vapour [g m⁻³]) of a profile that is made warmer and moister.

    The mixing ratio stays under a change of temperature. Vapour past saturation over liquid is left out, unless the
    profile has it from the start.
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


def scaled_densities(pressure_hpa, temperature, gas):
    """Return the scaled density of each gaseous absorber, (11, L), in the order of ABSORBERS.

    Parameters
    ----------
    pressure_hpa, temperature : (L,) arrays
    gas : (6, L) array
        Water vapour [g m⁻³]; the others [cm-atm km⁻¹], in the order of GASES.

    Notes
    -----
    Line absorption: amount × (p/p₀)ⁿ (T₀/T)ᵐ. Continuum: water times water, the same times the fall of the
    temperature from 296 to 260 K, and water times dry air, in units of the density of air at p₀, T₀.
    """
    pressure = np.asarray(pressure_hpa, dtype=np.float64) / 1013.25
    cold = ZERO_CELSIUS_K / np.asarray(temperature, dtype=np.float64)
    lines = [gas[row] * pressure**n * cold**m for row, n, m in BAND_MODELS]
    # 1 g/m³ of water vapour is 1/803.8 of the molecules in a cubic metre of air at p₀, T₀.
    water = gas[0] / 803.8
    fall = np.clip((296.0 - np.asarray(temperature)) / 36.0, 0.0, 1.0)
    return np.stack([*lines, water**2, water**2 * fall, water * (pressure * cold - water)])


def exponential(altitude, levels, values):
    """Return `values` (J, L) at levels, interpolated exponentially, or linearly where an end is 0.

    Below the levels it is as on the lowest of them, above them 0.
    """
    upper = np.clip(np.searchsorted(levels, altitude), 1, len(levels) - 1)
    part = np.clip((altitude - levels[upper - 1]) / (levels[upper] - levels[upper - 1]), 0.0, 1.0)
    first, last = values[:, upper - 1], values[:, upper]
    return np.where(altitude > levels[-1], 0.0, between(first, last, part))


def between(first, last, part):
    """Return what lies a part of the way from first to last, exponentially, or linearly where one of them is 0."""
    # Powers of each: a ratio of the two may leave float64.
    powers = first ** (1.0 - part) * last**part
    return np.where((first > 0.0) & (last > 0.0), powers, first + (last - first) * part)
