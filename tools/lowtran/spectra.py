"""LOWTRAN7's runs in the table's terms: amounts of gas, warmer and moister air."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from thermorender.atmosphere import absorbers, lowtran
from thermorender.defaults import BAND_UM
from thermorender.units import ZERO_CELSIUS_K

CAMERA_BANDS = (BAND_UM, (8.0, 12.0), (8.0, 14.0))
# Contrast at which errors are judged [K].
CONTRAST_K = 20.0
_MOLECULES = 2.6868e24 / (ZERO_CELSIUS_K / 296.0)


def standard_levels():
    """Return {model number: Levels} of the six standard atmospheres."""
    return {
        model: lowtran.spectrum(lowtran.Air(model), 0.0, range_m=1000.0).levels for model in lowtran.MODELS.values()
    }


def run_all(paths, workers=1):
    """Return LOWTRAN's Run of each path."""
    with ThreadPoolExecutor(workers) as pool:
        return list(pool.map(lambda path: lowtran.spectrum(path[0], path[1], path[2], path[4], path[3]), paths))


def gas_amounts(levels):
    """Return the gases of a profile, (6, L) in the order and units of `absorbers.GASES`."""
    pressure, cold = levels.pressure_hpa / 1013.25, ZERO_CELSIUS_K / levels.temperature
    scaled = {0: (17, 10.0), 1: (35, 1.0), 2: (31, 1.0), 3: (47, 1.0), 4: (45, 1.0), 5: (10, 1.0)}
    exponents = {row: (n, m) for row, n, m in reversed(absorbers.BAND_MODELS)}
    return np.stack(
        [
            levels.density[column] * factor / (pressure ** exponents[row][0] * cold ** exponents[row][1])
            for row, (column, factor) in scaled.items()
        ]
    )


def path_amounts(run):
    """Return LOWTRAN's absorber amounts of a path, (11,): integrals of `absorbers.scaled_densities` over metres."""
    amount = run.amount
    lines = np.array([10.0, 10.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0]) * amount[[17, 18, 35, 36, 31, 47, 45, 10]]
    return 1e3 * np.concatenate([lines, amount[[4, 8, 9]] / _MOLECULES])


def offset_air(levels, water, model, temperature_offset_k, humidity_factor, haze=0):
    """Return the lowtran.Air of levels and their water vapour [g m⁻³] with the offsets of `Atmosphere.standard`."""
    temperature, water = absorbers.offset_water(levels.temperature, water, temperature_offset_k, humidity_factor)
    rows = zip(levels.altitude_m, levels.pressure_hpa, temperature, water, strict=True)
    return lowtran.Air(model, haze, levels=tuple(tuple(map(float, row)) for row in rows))
