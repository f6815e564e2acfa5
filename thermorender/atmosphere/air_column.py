"""Columns of air: pressure, temperature and gases by altitude, with the well-mixed gases of a year."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.atmosphere.checks import check_within
from thermorender.errors import ThermorenderError
from thermorender.physics.planck import BOLTZMANN
from thermorender.units import ZERO_CELSIUS_K

Floats = NDArray[np.float64]

WATER = "h2o"
# Gases that vary with altitude: rows of the standard atmospheres' `mixing`.
VARYING = (WATER, "o3", "co2", "ch4", "n2o", "co")
# Nitrogen in dry air: U.S. Standard Atmosphere (1976), table 3.
_NITROGEN = {"n2": 0.78084}
# Limits of the bands in which aerosols are tabulated [cm⁻¹]; the one from 1480 to 2050 is in no camera's band.
AEROSOL_CM1 = np.concatenate([np.arange(630.0, 1481.0, 50.0), np.arange(2050.0, 3251.0, 100.0)])
# Year of the gases where neither scene nor weather names one.
YEAR = 2025
# The table is extended by its last slope up to this year, and begins with its first.
FIRST_YEAR, LAST_YEAR = 1750, 2040
_UNITS = {"ppm": 1e-6, "ppb": 1e-9, "ppt": 1e-12}
# All of the air.
_MOST = {"ppm": 1e6, "ppb": 1e9, "ppt": 1e12}
# Molecules in a gram of water, and metres³ per cm³ of a number density.
_OF_WATER = 6.02214076e23 / 18.01528
_TABLE = __file__.removesuffix("air_column.py") + "gases.csv"


@dataclass(frozen=True, eq=False)
class AirColumn:
    """Air at levels, lowest first; constant below the lowest level, none above the highest."""

    altitude_m: Floats  # (L,) above sea level
    pressure_pa: Floats  # (L,)
    temperature: Floats  # (L,) [K]
    mixing: dict[str, Floats]  # {gas: (L,) molecules over those of dry air}

    def __post_init__(self) -> None:
        # Copies that nobody can change, as the nodes of another band follow from them later.
        for name in ("altitude_m", "pressure_pa", "temperature"):
            object.__setattr__(self, name, _fixed(getattr(self, name)))
        object.__setattr__(self, "mixing", {gas: _fixed(values) for gas, values in self.mixing.items()})
        wrong = self._wrong()
        if wrong:
            raise ThermorenderError(f"AirColumn: {wrong}")

    def _wrong(self) -> str | None:
        """The first fault, as a clause, or None."""
        rows = {"altitude_m": self.altitude_m, "pressure_pa": self.pressure_pa, "temperature": self.temperature}
        rows |= {f"mixing of {gas}": values for gas, values in self.mixing.items()}
        for name, values in rows.items():
            if values.shape != (len(self.altitude_m),):
                return f"{name} has the shape {values.shape}; give as many numbers as altitude_m has"
            if not np.isfinite(values).all():
                return f"{name} holds {values[~np.isfinite(values)][0]:g}; give finite numbers"
            if name not in ("altitude_m", "temperature") and (values < 0.0).any():
                return f"{name} holds {values.min():g}; it must not be negative"
        if WATER not in self.mixing:
            return f"mixing has no {WATER}; give water vapour, at least zeros"
        if (np.diff(self.altitude_m) <= 0.0).any() or (np.diff(self.pressure_pa) > 0.0).any():
            return "levels are out of order; altitude_m must rise and pressure_pa fall from level to level"
        odd = (self.temperature < 100.0) | (self.temperature > 1000.0)
        if odd.any():
            return f"temperature holds {self.temperature[odd][0]:g}, not an air temperature in kelvin (100 … 1000)"
        return None

    @property
    def dry(self) -> Floats:
        """Molecules of dry air, (L,) [cm⁻³]."""
        found: Floats = 1e-6 * self.pressure_pa / (BOLTZMANN * self.temperature) / (1.0 + self.mixing[WATER])
        return found

    def at(self, altitude_m: Floats) -> "AirColumn":
        """Return the column at other levels: temperature linear, pressure and gases exponential between these."""
        pressure, *rows = exponential(altitude_m, self.altitude_m, np.array([self.pressure_pa, *self.mixing.values()]))
        temperature = np.interp(altitude_m, self.altitude_m, self.temperature)
        return AirColumn(altitude_m, pressure, temperature, dict(zip(self.mixing, rows, strict=True)))


def with_gases(
    mixing: Mapping[str, Floats], year: float = YEAR, others: Mapping[str, float] | None = None
) -> dict[str, Floats]:
    """Return mixing ratios {gas: (L,)} with the well-mixed gases of a year, nitrogen, and others by name and unit.

    Profiles of `mixing` keep their shape with altitude and have the year's amount at the lowest level; water and ozone
    are left as they are. `others` are {"co2_ppm": 500.0, …}.
    """
    amounts = of_year(year)
    known = [f"{gas}_{unit}" for gas, unit in _units().items()]
    for name, amount in (others or {}).items():
        if name not in known:
            raise ThermorenderError(f"gases has the key {name!r}; give one of {', '.join(known)}")
        gas, _, unit = name.rpartition("_")
        if isinstance(amount, bool) or not isinstance(amount, (int, float, np.number)):
            raise ThermorenderError(f"gases.{name} is {amount!r}; give a number of {unit}")
        check_within(f"gases.{name}", amount, 0.0, _MOST[unit], unit)
        amounts[gas] = amount * _UNITS[unit]
    levels = len(mixing[WATER])
    found = {gas: np.full(levels, share) for gas, share in _NITROGEN.items()}
    for gas in (*mixing, *(each for each in amounts if each not in mixing)):
        shape = mixing.get(gas, np.ones(levels))
        if gas in amounts:
            shape = shape if shape[0] > 0.0 else np.ones(levels)
            shape = shape * (amounts[gas] / shape[0])
        found[gas] = shape
    return found


def of_year(year: float) -> dict[str, float]:
    """Return {gas: share of dry air} of the well-mixed gases in a year up to 2040; before 1985 those of 1985.

    Forster et al. (2025), doi:10.5194/essd-17-2641-2025; after 2024 by the slope of 2020 to 2024.
    """
    if isinstance(year, bool) or not isinstance(year, (int, float, np.number)):
        raise ThermorenderError(f"year is {year!r}; give a number")
    check_within("year", year, FIRST_YEAR, LAST_YEAR, "of the gases")
    _, rows = _table()
    years = rows[:, 0]
    last = rows[-1] + (rows[-1] - rows[-2]) * (LAST_YEAR - years[-1]) / (years[-1] - years[-2])
    rows = np.vstack([rows, np.maximum(last, 0.0)])
    scale = [_UNITS[unit] for unit in _units().values()]
    return {gas: float(np.interp(year, rows[:, 0], column)) * unit
            for gas, column, unit in zip(_units(), rows[:, 1:].T, scale, strict=True)}  # fmt: skip


@cache
def _table() -> tuple[list[str], Floats]:
    """(Names of columns, rows) of the table of years."""
    with open(_TABLE, encoding="utf-8") as file:
        lines = [line.strip().split(",") for line in file if not line.startswith("#")]
    return lines[0], np.array(lines[1:], np.float64)


def _units() -> dict[str, str]:
    """{Gas: unit of its column}."""
    return {name.rpartition("_")[0]: name.rpartition("_")[2] for name in _table()[0][1:]}


def _fixed(values: ArrayLike) -> Floats:
    found = np.array(values, np.float64)
    found.flags.writeable = False
    return found


def saturation_g_m3(temperature: ArrayLike) -> Floats:
    """Return the density of saturated water vapour over liquid water [g m⁻³] at temperatures [K].

    LOWTRAN's fit, so that relative humidities agree: Kneizys et al. (1988), Users Guide to LOWTRAN 7, AFGL-TR-88-0177.
    """
    ratio = ZERO_CELSIUS_K / np.asarray(temperature, dtype=np.float64)
    return ratio * np.exp(18.9766 - 14.9595 * ratio - 2.43882 * np.square(ratio))


def water_mixing(pressure_pa: ArrayLike, temperature: ArrayLike, water_g_m3: ArrayLike) -> Floats:
    """Return the mixing ratio of water vapour of a density [g m⁻³], molecules over those of dry air.

    Vapour takes at most all of the pressure but a thousandth.
    """
    molecules = np.asarray(water_g_m3, np.float64) * _OF_WATER
    air = np.asarray(pressure_pa, np.float64) / (BOLTZMANN * np.asarray(temperature, np.float64))
    return molecules / np.maximum(air - molecules, 1e-3 * air)


def water_g_m3(pressure_pa: ArrayLike, temperature: ArrayLike, mixing: ArrayLike) -> Floats:
    """Return the density of water vapour [g m⁻³] of a mixing ratio over dry air."""
    air = np.asarray(pressure_pa, np.float64) / (BOLTZMANN * np.asarray(temperature, np.float64))
    mixing = np.asarray(mixing, np.float64)
    return air * mixing / (1.0 + mixing) / _OF_WATER


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
