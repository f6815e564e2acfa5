"""A sounding of the Integrated Global Radiosonde Archive, version 2, in its text format of fixed columns.

Durre and others, "IGRA data format", NOAA NCEI (igra2-data-format.txt): pressure in Pa, geopotential height in m,
temperature and dew point depression in tenths of a kelvin, relative humidity in tenths of a percent; −9999 is missing
and −8888 was removed by the quality control.
"""

import re

import numpy as np
from numpy.typing import NDArray

from thermorender.atmosphere.air_column import saturation_g_m3
from thermorender.errors import ThermorenderError
from thermorender.units import ZERO_CELSIUS_K

_HEADER = re.compile(r"#[A-Z]{2}\w{9} +(\d{4}) +(\d\d) +(\d\d) +(\d\d) +\d{4} +(\d+)")
_MISSING = (-8888.0, -9999.0)
# Columns of a level, counted from 0: pressure, height, temperature, relative humidity, dew point depression.
_COLUMNS = ((9, 15), (16, 21), (22, 27), (28, 33), (34, 39))
_WIDTH = 52
# Hydrostatics: R / (M g) of dry air [m K⁻¹].
_SCALE_M_K = 8.314462618 / (0.0289652 * 9.80665)


def is_igra(line: str) -> bool:
    """Return whether a file's first line is the header of such a sounding."""
    return _HEADER.match(line) is not None


def read_igra(path: object, lines: list[tuple[int, str]]) -> list[NDArray[np.float64]]:
    """Return [altitude [m], pressure [hPa], temperature [K], relative humidity [%]], each (n,), of a sounding.

    `lines` are (line number, text). Levels without temperature or humidity are left out. Levels without a height get it
    from the hydrostatic thickness, fitted to the heights around them.
    """
    heads = [head for head in (_HEADER.match(text) for _, text in lines) if head]
    days = ["-".join(head.groups()[:3]) + f"T{head[4]}" for head in heads]
    if len(days) > 1:
        raise ThermorenderError(
            f"profile {path} holds {len(days)} soundings, {days[0]} to {days[-1]}; copy one, its header line and its "
            "levels, into a file of its own"
        )
    levels = [(number, text) for number, text in lines if text.strip() and not text.startswith("#")]
    if len(levels) != int(heads[0][5]):
        raise ThermorenderError(
            f"profile {path} holds {len(levels)} levels where its header states {heads[0][5]}; give the whole sounding"
        )
    table = np.array([_level(path, number, text) for number, text in levels]).reshape(-1, len(_COLUMNS))
    pressure, height, celsius, humidity, depression = table.T
    kelvin = celsius + ZERO_CELSIUS_K
    dew = saturation_g_m3(kelvin - depression) * (kelvin - depression) / (saturation_g_m3(kelvin) * kelvin)
    humidity = np.where(np.isnan(humidity), 100.0 * dew, humidity)
    kept = ~np.isnan([pressure, kelvin, humidity]).any(axis=0)
    pressure, height, kelvin, humidity = (each[kept] for each in (pressure, height, kelvin, humidity))
    order = np.argsort(-pressure, kind="stable")
    pressure, height, kelvin, humidity = (each[order] for each in (pressure, height, kelvin, humidity))
    known = ~np.isnan(height)
    if known.any():
        # Levels below the first height have no altitude to begin from.
        first = int(np.argmax(known))
        pressure, height, kelvin, humidity = (each[first:] for each in (pressure, height, kelvin, humidity))
        known = known[first:]
        layers = _SCALE_M_K * 0.5 * (kelvin[1:] + kelvin[:-1]) * np.log(pressure[:-1] / pressure[1:])
        thick = np.concatenate([[0.0], layers.cumsum()])
        height = np.where(known, height, thick + np.interp(thick, thick[known], height[known] - thick[known]))
    return [height, pressure, kelvin, humidity]


def _level(path: object, number: int, text: str) -> list[float]:
    """Numbers of a level in hPa, m, °C, % and K, NaN where missing."""
    try:
        if len(text.rstrip()) > _WIDTH:
            # IGRA's derived soundings have the same header and other columns.
            raise ValueError
        found = [float(text[first:last]) for first, last in _COLUMNS]
    except ValueError:
        raise ThermorenderError(
            f"profile {path}, line {number}: {text[:60]!r} is not a level of an IGRA sounding; give the text as it came"
        ) from None
    found = [np.nan if value in _MISSING else value for value in found]
    return [value * scale for value, scale in zip(found, (0.01, 1.0, 0.1, 0.1, 0.1), strict=True)]
