"""Columns of air that g points are merged for and judged by: the standard atmospheres, warmer, moister, of a year."""

import numpy as np

from thermorender.atmosphere.air_column import AirColumn
from thermorender.atmosphere.emission import ALTITUDE_M
from thermorender.atmosphere.standards import standard_column
from thermorender.atmosphere.table_files import read_table

# Levels of a column: every eighth of those that frames are integrated on.
LEVELS_M = ALTITUDE_M[::8]


def standard(number: int, warmer_k: float = 0.0, moister: float = 1.0) -> AirColumn:
    """Return a standard atmosphere by its number in the shipped table, warmer and moister, at LEVELS_M."""
    return standard_column(str(read_table()["model"][number]), warmer_k, moister).at(LEVELS_M)


def standard_of_1986(number: int) -> AirColumn:
    """Return a standard atmosphere with its own gases, as LOWTRAN7 has them."""
    table = read_table()
    mixing = dict(zip(table["gas"].tolist(), np.float64(table["mixing"][number]), strict=True))
    return AirColumn(
        np.float64(table["altitude_m"]), 100.0 * np.float64(table["pressure_hpa"][number]),
        np.float64(table["temperature"][number]), mixing,
    )  # fmt: skip
