"""Columns of air that g points are merged for and judged by: the standard atmospheres, warmer, moister, of a year."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermorender.atmosphere.absorbers import exponential, offset_water
from thermorender.atmosphere.emission import ALTITUDE_M
from thermorender.atmosphere.table_files import read_table
from thermorender.physics.planck import BOLTZMANN

Floats = NDArray[np.float64]
# Levels of a column: every eighth of those that frames are integrated on.
LEVELS_M = ALTITUDE_M[::8]
# Molecules in a cubic centimetre for a gram of water in a cubic metre, and for a cm-atm in a kilometre.
_OF_WATER, _OF_GAS = 6.02214076e23 / 18.01528e6, 2.6867811e14
# Gases of the shipped table after water, and their share of dry air at the ground in 2025: NOAA GML, global means.
_TABLE = ("co2", "o3", "n2o", "ch4")
_TODAY = {"co2": 425e-6, "n2o": 3.38e-7, "ch4": 1.93e-6}
# Gases mixed as evenly as dry air itself; those of less than 1e-9 are of 2025.
_EVEN = {
    "o2": 0.20946, "n2": 0.78084, "co": 1e-7, "cfc11": 2.16e-10, "cfc12": 4.85e-10, "cfc22": 2.5e-10, "ccl4": 7.3e-11,
    "hfc134a": 1.3e-10, "hfc125": 4e-11, "hfc143a": 3e-11, "hfc23": 3.6e-11, "hfc32": 3e-11, "cf4": 9e-11,
}  # fmt: skip


@dataclass(frozen=True)
class Column:
    """Air at LEVELS_M."""

    pressure_pa: Floats  # (L,)
    temperature: Floats  # (L,) [K]
    mixing: dict[str, Floats]  # {gas: (L,) molecules over those of dry air}

    @property
    def dry(self) -> Floats:
        """Molecules of dry air, (L,) [cm⁻³]."""
        found: Floats = 1e-6 * self.pressure_pa / (BOLTZMANN * self.temperature) / (1.0 + self.mixing["h2o"])
        return found


def standard(number: int, warmer_k: float = 0.0, moister: float = 1.0) -> Column:
    """Return a standard atmosphere by its number in the shipped table, warmer and moister, with the gases of 2025."""
    table = read_table()
    altitude = np.array(table["altitude_m"], np.float64)
    pressure, temperature, gas = (
        np.array(table[name][number], np.float64) for name in ("pressure_hpa", "temperature", "gas")
    )
    warm, water = offset_water(temperature, gas[0], warmer_k, moister)
    number_density = 1e-4 * pressure / (BOLTZMANN * warm)
    dry = number_density - water * _OF_WATER
    rows = [water * _OF_WATER / dry]
    for name, amount in zip(_TABLE, gas[1:5], strict=True):
        share = amount * temperature / warm * _OF_GAS / dry
        rows.append(share * (_TODAY[name] / share[0] if name in _TODAY else 1.0))
    fine = exponential(LEVELS_M, altitude, np.array([pressure, *rows]))
    mixing = dict(zip(("h2o", *_TABLE), fine[1:], strict=True))
    mixing |= {name: np.full(len(LEVELS_M), share) for name, share in _EVEN.items()}
    return Column(100.0 * fine[0], np.interp(LEVELS_M, altitude, warm), mixing)
