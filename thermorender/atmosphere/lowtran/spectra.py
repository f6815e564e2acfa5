"""LOWTRAN7's runs in the table's terms: amounts of gas, warmer and moister air, means over sub-bands, aerosols."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from thermorender.atmosphere import absorbers
from thermorender.atmosphere.lowtran import program
from thermorender.atmosphere.model import REFERENCE_K
from thermorender.defaults import BAND_UM
from thermorender.units import ZERO_CELSIUS_K

# Sub-bands [µm]. The edges are the limits of cameras' bands, those of LOWTRAN's band models (10 and 12 µm) and that
# of ozone's band (9.2 µm).
SUB_BANDS = ((7.0, 7.5), (7.5, 8.0), (8.0, 9.2), (9.2, 10.0), (10.0, 12.0), (12.0, 13.5), (13.5, 14.0), (14.0, 14.5))
CAMERA_BANDS = (BAND_UM, (8.0, 12.0), (8.0, 14.0))
# Contrast at which errors are judged [K].
CONTRAST_K = 20.0
# Levels that are added to LOWTRAN's, where an aerosol regime fades into the next.
EXTRA_LEVELS_M = (2250.0, 2500.0, 2750.0, 10500.0)
_MOLECULES = 2.6868e24 / (ZERO_CELSIUS_K / 296.0)


def standard_levels():
    """Return {model number: Levels} of the six standard atmospheres."""
    return {
        model: program.spectrum(program.Air(model), 0.0, range_m=1000.0).levels for model in program.MODELS.values()
    }


def run_all(paths, workers=1):
    """Return LOWTRAN's Run of each path."""
    with ThreadPoolExecutor(workers) as pool:
        return list(pool.map(lambda path: program.spectrum(path[0], path[1], path[2], path[4], path[3]), paths))


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
    """Return the program.Air of levels and their water vapour [g m⁻³] with the offsets of `Atmosphere.standard`."""
    temperature, water = absorbers.offset_water(levels.temperature, water, temperature_offset_k, humidity_factor)
    rows = zip(levels.altitude_m, levels.pressure_hpa, temperature, water, strict=True)
    return program.Air(model, haze, levels=tuple(tuple(map(float, row)) for row in rows))


def spectral_weights(wavenumber, lower_um, upper_um, temperature=REFERENCE_K):
    """Return weights (n,) that sum to 1: a spectrum's mean over a sub-band by Planck's law, linear between points."""
    fine = np.linspace(1e4 / upper_um, 1e4 / lower_um, 801)
    share = np.gradient(fine) * fine**3 / np.expm1(1.438777 * fine / temperature)
    share[[0, -1]] *= 0.5
    index = np.clip(np.searchsorted(wavenumber, fine) - 1, 0, len(wavenumber) - 2)
    part = (fine - wavenumber[index]) / np.diff(wavenumber)[index]
    weights = np.bincount(index, share * (1.0 - part), len(wavenumber))
    weights += np.bincount(index + 1, share * part, len(wavenumber))
    return weights / weights.sum()


def extinction(air, altitude_m):
    """Return the mean extinction of an Air's aerosol in each sub-band, (sub-bands, L) [m⁻¹], at altitudes."""
    result = np.zeros((len(SUB_BANDS), len(altitude_m)))
    if air.haze:
        grid = np.arange(program.FIRST, program.LAST + 1, program.STEP)
        means = np.stack([spectral_weights(grid, *band) for band in SUB_BANDS])
        result[:] = np.stack([means @ aerosol_depth(air, altitude) for altitude in altitude_m], axis=1)
    return np.maximum(result, 0.0)


def aerosol_depth(air, altitude):
    """Return the spectrum of an Air's aerosol extinction at an altitude [m⁻¹], from level paths with and without it."""
    with_it, without = (
        program.spectrum(which, float(altitude), range_m=100.0) for which in (air, replace(air, haze=0))
    )
    return np.log(without.transmittance / with_it.transmittance) / 100.0
