"""The six standard atmospheres as columns of air, warmer and moister ones too: Anderson et al. (1986),
AFGL-TR-86-0110, as LOWTRAN7 holds them."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from thermorender.atmosphere.air_column import (
    WATER,
    YEAR,
    AirColumn,
    offset_water,
    water_g_m3,
    water_mixing,
    with_gases,
)
from thermorender.atmosphere.checks import check_within, name_index
from thermorender.atmosphere.table_files import read_table

Floats = NDArray[np.float64]


def standard_column(
    name: str, temperature_offset_k: float = 0.0, humidity_factor: float = 1.0, year: float = YEAR,
    gases: Mapping[str, float] | None = None,
) -> AirColumn:  # fmt: skip
    """Return a standard atmosphere; parameters as in `Atmosphere.standard`."""
    table = read_table()
    model = name_index("standard", name, table["model"])
    check_within("temperature_offset_k", temperature_offset_k, -40.0, 40.0, "kelvin")
    check_within("humidity_factor", humidity_factor, 0.0, 5.0, "times the standard water vapour")
    pressure, temperature, rows = (
        table[name][model].astype(np.float64) for name in ("pressure_hpa", "temperature", "mixing")
    )
    pressure *= 100.0
    mixing = dict(zip(table["gas"].tolist(), rows, strict=True))
    water = water_g_m3(pressure, temperature, mixing[WATER])
    warmer, water = offset_water(temperature, water, temperature_offset_k, humidity_factor)
    mixing[WATER] = water_mixing(pressure, warmer, water)
    return AirColumn(table["altitude_m"].astype(np.float64), pressure, warmer, with_gases(mixing, year, gases))


def standard_aerosol(name: str, aerosol: str) -> Floats:
    """Return the extinction of a standard atmosphere's aerosol, (bands of `aerosol_cm1`, L) [m⁻¹]."""
    table = read_table()
    haze = name_index("aerosol", aerosol, table["aerosol"])
    found: Floats = table["extinction"][name_index("standard", name, table["model"]), haze].astype(np.float64)
    return found
