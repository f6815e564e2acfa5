"""The Weather of a typical year: EPW files of EnergyPlus, and TMY3 tables of the NSRDB.

Both label hours by their end, in the zone's standard time. Radiation and rain are means over the hour and belong to
its middle. Temperature, humidity, pressure, wind, clouds and snow are values at its end and are interpolated to the
middle.

A typical year joins months of different years. They are mapped to one calendar year, day by day. 29 February repeats
the 28th if the file has none, and is left out if the year has none.
"""

import csv
import datetime
import io
from os import PathLike

import numpy as np

from thermorender.errors import ThermorenderError, shortened
from thermorender.formats import read_text
from thermorender.physics import sun
from thermorender.units import ZERO_CELSIUS_K
from thermorender.weather.clock import check_clock
from thermorender.weather.columns import check_light, check_pressure, check_range, vapour_of
from thermorender.weather.complete import HIGHEST_M, LOWEST_M, complete
from thermorender.weather.gaps import filled, without_offset
from thermorender.weather.series import Weather

# Our quantity: (column, scale, offset added after, lowest mark of a missing value, whether it is at the hour's end).
# EnergyPlus documentation, Auxiliary Programs, "EnergyPlus Weather File (EPW) Data Dictionary"; columns have no names.
_EPW = {
    "air_k": (6, 1.0, ZERO_CELSIUS_K, 99.9, True),
    "dew_point_k": (7, 1.0, ZERO_CELSIUS_K, 99.9, True),
    "rh": (8, 0.01, 0.0, 999.0, True),
    "pressure_pa": (9, 1.0, 0.0, 999999.0, True),
    "longwave_w_m2": (12, 1.0, 0.0, 9999.0, False),
    "global_w_m2": (13, 1.0, 0.0, 9999.0, False),
    "direct_w_m2": (14, 1.0, 0.0, 9999.0, False),
    "diffuse_w_m2": (15, 1.0, 0.0, 9999.0, False),
    "wind_m_s": (21, 1.0, 0.0, 999.0, True),
    "cloud": (22, 0.1, 0.0, 99.0, True),
    "snow_m": (30, 0.01, 0.0, 999.0, True),
    "rain_mm_h": (33, 1.0, 0.0, 999.0, False),
}
# Wilcox and Marion, Users Manual for TMY3 Data Sets, NREL/TP-581-43156 (2008), table 1-2; missing is −9900.
_TMY3 = {
    "air_k": ("Dry-bulb (C)", 1.0, ZERO_CELSIUS_K, np.inf, True),
    "dew_point_k": ("Dew-point (C)", 1.0, ZERO_CELSIUS_K, np.inf, True),
    "rh": ("RHum (%)", 0.01, 0.0, np.inf, True),
    "pressure_pa": ("Pressure (mbar)", 100.0, 0.0, np.inf, True),
    "global_w_m2": ("GHI (W/m^2)", 1.0, 0.0, np.inf, False),
    "direct_w_m2": ("DNI (W/m^2)", 1.0, 0.0, np.inf, False),
    "diffuse_w_m2": ("DHI (W/m^2)", 1.0, 0.0, np.inf, False),
    "wind_m_s": ("Wspd (m/s)", 1.0, 0.0, np.inf, True),
    "cloud": ("TotCld (tenths)", 0.1, 0.0, np.inf, True),
    "rain_mm_h": ("Lprecip depth (mm)", 1.0, 0.0, np.inf, False),
}
_BELOW = -9000.0
_LONGEST_GAP_H = 3
# Days added before and after the year, for simulations that begin earlier.
_BEFORE_D, _AFTER_D = 31, 2


def read_epw(path: str | PathLike[str], year: int | np.datetime64, snow_depth_m: float = 0.0) -> Weather:
    """Return the hourly Weather of an EPW file or a TMY3 table in a calendar year.

    A file of a whole year is extended by its December before the year and its January after it.

    Parameters
    ----------
    path : path
        The first lines name the format.
    year : int or datetime64
        Calendar year; for an instant, its year in the file's zone.
    snow_depth_m : float
        Used if the file has none.

    Raises
    ------
    ThermorenderError
        The file is missing, a value is not a number, hours do not follow each other, or a gap exceeds 3 h.
    """
    lines = [line for line in csv.reader(io.StringIO(read_text(path, "the text it was"))) if line]
    epw = bool(lines) and lines[0][0].strip().upper() == "LOCATION"
    place, zone_h, table, stamps, rows = _epw(path, lines) if epw else _tmy3(path, lines)
    if not abs(zone_h) <= 14.0:
        raise ThermorenderError(f"{path}: zone {zone_h:g} h in the header is not valid; give −12…14 h from UTC")
    if isinstance(year, np.datetime64):
        year = int(str((year + np.timedelta64(round(zone_h * 60), "m")).astype("datetime64[Y]")))
    local, source = _calendar(path, stamps, year)
    time = (local - np.timedelta64(round(zone_h * 3600), "s")).astype("datetime64[s]")
    notes = [f"A typical year: its months, of different years, are mapped to {year}."]
    given = {}
    # For messages: the file's dates, if its days follow each other.
    begin = np.datetime64(f"{year:04d}-{stamps[0][0]:02d}-01", "s") + np.timedelta64(stamps[0][1] - 1, "D")
    hours = begin + np.timedelta64(3600, "s") * np.arange(len(stamps))
    for name, (column, scale, after, missing, at_end) in table.items():
        if column is None:
            continue
        numbers = _numbers(path, rows, column)
        numbers[(numbers >= missing) | (numbers <= _BELOW)] = np.nan
        if np.isnan(numbers).all():
            continue
        numbers = filled(path, name, name, numbers * scale + after, hours, 3600.0, _LONGEST_GAP_H, notes)
        if name in ("global_w_m2", "direct_w_m2", "diffuse_w_m2"):
            numbers = without_offset(name, numbers, notes)
        check_range(path, name, numbers)
        if name == "global_w_m2":
            check_light(path, name, numbers[source], sun.position_at(time, *place[:2])[1])
        # From the ends of hours to their middles; a whole year is periodic.
        before = np.concatenate([numbers[-1:] if len(numbers) >= 8760 else numbers[:1], numbers[:-1]])
        given[name] = (0.5 * (numbers + before) if at_end else numbers)[source]
    if "air_k" not in given:
        raise ThermorenderError(f"{path} has no air temperature; give a file with a filled dry-bulb column")
    if "pressure_pa" in given:
        check_pressure(path, "pressure", given["pressure_pa"], place[2])
    vapour = vapour_of(path, given, given["air_k"], notes)
    given = {name: value for name, value in given.items() if name not in ("dew_point_k", "rh")}
    if vapour is not None:
        given["vapour_pa"] = vapour
    if "global_w_m2" in given:
        note = check_clock(path, time, given["global_w_m2"], *place[:2], 3600.0)
        notes += [note] if note else []
    return complete(time, place, given, notes, snow_depth_m=snow_depth_m)


def _epw(path, lines):
    """(Place, zone [h], columns, (month, day, hour 1…24) of the rows, rows) of an EPW file."""
    start = next((k for k, line in enumerate(lines) if line[0].strip().upper().startswith("DATA PERIODS")), None)
    if start is None or len(lines[0]) < 10:
        raise ThermorenderError(f"{path} has no line DATA PERIODS or an unfinished LOCATION; give the whole EPW file")
    latitude, longitude, zone_h, altitude = (_number(path, "LOCATION", text) for text in lines[0][6:10])
    rows = lines[start + 1 :]
    short = [k for k, row in enumerate(rows) if len(row) < 34]
    if short:
        raise ThermorenderError(
            f"{path}, row {start + 2 + short[0]}: {len(rows[short[0]])} cells; an EPW row has 35, so give the whole row"
        )
    stamps = [_stamp(path, number, row[1:4]) for number, row in enumerate(rows, start=start + 2)]
    return _place(path, latitude, longitude, altitude), zone_h, _EPW, stamps, rows


def _tmy3(path, lines):
    """As `_epw`, for a TMY3 table."""
    header = [cell.strip() for cell in lines[1]] if len(lines) > 1 else []
    if len(lines) < 3 or header[:2] != ["Date (MM/DD/YYYY)", "Time (HH:MM)"] or len(lines[0]) < 7:
        raise ThermorenderError(
            f"{path} is neither an EPW file, which begins with LOCATION, nor a TMY3 table, whose second line begins "
            "with Date (MM/DD/YYYY); give one of these"
        )
    zone_h, latitude, longitude, altitude = (_number(path, "line 1", text) for text in lines[0][3:7])
    rows = lines[2:]
    stamps = []
    for number, row in enumerate(rows, start=3):
        try:
            month, day, _ = row[0].split("/")
            stamps.append(_stamp(path, number, (month, day, row[1].split(":")[0])))
        except (ValueError, IndexError):
            raise ThermorenderError(
                f"{path}, row {number}: {row[:2]} are not a date and hour of TMY3; correct the row"
            ) from None
        if len(row) < len(header):
            raise ThermorenderError(f"{path}, row {number}: {len(row)} cells where row 2 names {len(header)} columns")
    named = {
        name: (header.index(entry[0]) if entry[0] in header else None, *entry[1:]) for name, entry in _TMY3.items()
    }
    return _place(path, latitude, longitude, altitude), zone_h, named, stamps, rows


def _stamp(path, number, texts):
    """(Month, day, hour 1…24) of a row."""
    try:
        month, day, hour = (int(text) for text in texts)
        # A leap year has all possible days.
        datetime.date(2000, month, day)
    except (ValueError, OverflowError):
        raise ThermorenderError(
            f"{path}, row {number}: {'/'.join(map(str, texts[:2]))} is not a date or {texts[2]} not an hour; correct it"
        ) from None
    return month, day, hour


def _place(path, latitude, longitude, altitude):
    if not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0 and LOWEST_M <= altitude <= HIGHEST_M):
        raise ThermorenderError(
            f"{path}: latitude {latitude:g}, longitude {longitude:g}, elevation {altitude:g} m in the header are not "
            "a place on land; correct the first line"
        )
    return latitude, longitude, altitude


def _number(path, where, text):
    try:
        return float(text)
    except ValueError:
        raise ThermorenderError(f"{path}: {shortened(repr(text))} in {where} is not a number; correct it") from None


def _numbers(path, rows, column):
    """Numbers (N,) of a column; empty cells are missing."""
    return np.array(
        [_number(path, f"column {column + 1}", row[column] if row[column].strip() else "nan") for row in rows]
    )


def _calendar(path, stamps, year):
    """(Middles of the hours in the zone's time (M,) datetime64[s], rows of the file (M,)) for a year."""
    if not stamps or len(stamps) % 24 or any(hour != k % 24 + 1 for k, (_, _, hour) in enumerate(stamps)):
        raise ThermorenderError(f"{path} has {len(stamps)} rows; give whole days of hours 1 to 24, in order")
    first_row = {}
    for k in range(0, len(stamps), 24):
        if len({stamp[:2] for stamp in stamps[k : k + 24]}) > 1 or stamps[k][:2] in first_row:
            raise ThermorenderError(f"{path}: {stamps[k][0]}/{stamps[k][1]} occurs twice or changes within the day")
        first_row[stamps[k][:2]] = k
    whole = len(stamps) >= 8760
    if whole:
        first_row.setdefault((2, 29), first_row.get((2, 28)))
    day = np.timedelta64(1, "D")
    start, end = np.datetime64(f"{year:04d}-01-01"), np.datetime64(f"{year:04d}-12-31")
    dates = np.arange(start - _BEFORE_D * day, end + (_AFTER_D + 1) * day) if whole else np.arange(start, end + day)
    found = [(date, first_row.get((date.item().month, date.item().day))) for date in dates]
    found = [(date, row) for date, row in found if row is not None]
    dates = np.array([date for date, _ in found])
    if (np.diff(dates) > day).any():
        k = int(np.argmax(np.diff(dates) > day))
        raise ThermorenderError(
            f"{path}: the days between {dates[k]} and {dates[k + 1]} are missing; give consecutive days"
        )
    local = dates.astype("datetime64[s]")[:, None] + np.timedelta64(1800, "s") * (2 * np.arange(24) + 1)
    return local.ravel(), (np.array([row for _, row in found])[:, None] + np.arange(24)).ravel()
