"""LOWTRAN7's runs: standard atmospheres, their gases, and warmer or moister air."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from thermorender.atmosphere import air_column, lowtran
from thermorender.defaults import BAND_UM
from thermorender.physics.planck import BOLTZMANN
from thermorender.units import ZERO_CELSIUS_K

CAMERA_BANDS = (BAND_UM, (8.0, 12.0), (8.0, 14.0))
# Contrast at which errors are judged [K].
CONTRAST_K = 20.0
# Columns of LOWTRAN's array DENSTY of a gas with its factor to g m⁻³ of water or cm-atm km⁻¹, and the exponents of
# pressure and of inverse temperature that scale it: Kneizys et al. (1988), AFGL-TR-88-0177.
_SCALED = {
    "h2o": (17, 10.0, 1.1406, -2.6343), "o3": (31, 1.0, 0.4221, 0.7678), "co2": (35, 1.0, 0.6705, -2.2560),
    "ch4": (45, 1.0, 0.7139, -0.4185), "n2o": (47, 1.0, 0.7203, -0.1836), "co": (43, 1.0, 0.7589, 0.6911),
}  # fmt: skip
# Molecules per cubic metre in a centimetre-atmosphere per kilometre.
_CM_ATM_KM = 2.6867811e20


def standard_levels():
    """Return {model number: Levels} of the six standard atmospheres."""
    return {
        model: lowtran.spectrum(lowtran.Air(model), 0.0, range_m=1000.0).levels for model in lowtran.MODELS.values()
    }


def run_all(paths, workers=1, limits=lowtran.RANGES[0]):
    """Return LOWTRAN's Run of each path, over one of its ranges."""

    def run(path):
        return lowtran.spectrum(path[0], path[1], path[2], path[4], path[3], limits=limits)

    with ThreadPoolExecutor(workers) as pool:
        return list(pool.map(run, paths))


def water_g_m3(levels):
    """Return the water vapour of a profile, (L,) [g m⁻³]."""
    return _amount(levels, "h2o")


def mixing(levels):
    """Return the gases of a profile, (gases, L) molecules over those of dry air, as `air_column.VARYING`."""
    water = air_column.water_mixing(100.0 * levels.pressure_hpa, levels.temperature, water_g_m3(levels))
    dry = 100.0 * levels.pressure_hpa / (BOLTZMANN * levels.temperature) / (1.0 + water)
    return np.stack([water, *(_amount(levels, gas) * _CM_ATM_KM / dry for gas in air_column.VARYING[1:])])


def offset_air(levels, water, model, temperature_offset_k, humidity_factor, haze=0):
    """Return the lowtran.Air of levels and their water vapour [g m⁻³] with the offsets of `Atmosphere.standard`."""
    temperature, water = air_column.offset_water(levels.temperature, water, temperature_offset_k, humidity_factor)
    rows = zip(levels.altitude_m, levels.pressure_hpa, temperature, water, strict=True)
    return lowtran.Air(model, haze, levels=tuple(tuple(map(float, row)) for row in rows))


def _amount(levels, gas):
    """Amount of a gas, in the units of _SCALED."""
    column, factor, n, m = _SCALED[gas]
    cold = ZERO_CELSIUS_K / levels.temperature
    return levels.density[column] * factor / ((levels.pressure_hpa / 1013.25) ** n * cold**m)
