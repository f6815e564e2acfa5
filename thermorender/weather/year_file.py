"""Tables of weather years: EPW, TMY3 and the NSRDB's PSM3 and PSM4, read with the units and clocks that they state.

EPW and TMY3 label intervals by their end, in the zone's standard time. Radiation and rain are means over the interval;
temperature, humidity, pressure, wind, clouds and snow are values at its end. The rows of PSM are instants.
"""

import csv
import datetime
import io
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from os import PathLike

import numpy as np

from thermorender.errors import ThermorenderError, shortened
from thermorender.formats import read_text
from thermorender.units import ZERO_CELSIUS_K
from thermorender.weather.complete import HIGHEST_M, LOWEST_M
from thermorender.weather.rain import Floats, by_hour, in_mm

LIGHT = ("global_w_m2", "direct_w_m2", "diffuse_w_m2")
# Our quantity: (column, scale, offset added after, lowest mark of a missing value).
# EnergyPlus documentation, Auxiliary Programs, "EnergyPlus Weather File (EPW) Data Dictionary"; columns have no names.
_EPW = {
    "air_k": (6, 1.0, ZERO_CELSIUS_K, 99.9),
    "dew_point_k": (7, 1.0, ZERO_CELSIUS_K, 99.9),
    "rh": (8, 0.01, 0.0, 999.0),
    "pressure_pa": (9, 1.0, 0.0, 999999.0),
    "longwave_w_m2": (12, 1.0, 0.0, 9999.0),
    "global_w_m2": (13, 1.0, 0.0, 9999.0),
    "direct_w_m2": (14, 1.0, 0.0, 9999.0),
    "diffuse_w_m2": (15, 1.0, 0.0, 9999.0),
    "wind_m_s": (21, 1.0, 0.0, 999.0),
    "cloud": (22, 0.1, 0.0, 99.0),
    "snow_m": (30, 0.01, 0.0, 999.0),
}
_EPW_RAIN, _EPW_RAIN_H, _EPW_CELLS = 33, 34, 34
# Our quantity: (column, its unit, scale, offset added after). Wilcox and Marion, Users Manual for TMY3 Data Sets,
# NREL/TP-581-43156 (2008), table 1-2; missing is −9900.
_TMY3 = {
    "air_k": ("Dry-bulb", "C", 1.0, ZERO_CELSIUS_K),
    "dew_point_k": ("Dew-point", "C", 1.0, ZERO_CELSIUS_K),
    "rh": ("RHum", "%", 0.01, 0.0),
    "pressure_pa": ("Pressure", "mbar", 100.0, 0.0),
    "global_w_m2": ("GHI", "W/m^2", 1.0, 0.0),
    "direct_w_m2": ("DNI", "W/m^2", 1.0, 0.0),
    "diffuse_w_m2": ("DHI", "W/m^2", 1.0, 0.0),
    "wind_m_s": ("Wspd", "m/s", 1.0, 0.0),
    "cloud": ("TotCld", "tenths", 0.1, 0.0),
    "rain_mm": ("Lprecip depth", "mm", 1.0, 0.0),
    "rain_h": ("Lprecip quantity", "hr", 1.0, 0.0),
}
# NSRDB, "Solar Resource Data: Spectral" and PSM v3 and v4 downloads: line 1 names the fields of line 2, with units.
_PSM = {
    "air_k": ("Temperature", "c", 1.0, ZERO_CELSIUS_K),
    "dew_point_k": ("Dew Point", "c", 1.0, ZERO_CELSIUS_K),
    "rh": ("Relative Humidity", "%", 0.01, 0.0),
    "pressure_pa": ("Pressure", "mbar", 100.0, 0.0),
    "global_w_m2": ("GHI", "w/m2", 1.0, 0.0),
    "direct_w_m2": ("DNI", "w/m2", 1.0, 0.0),
    "diffuse_w_m2": ("DHI", "w/m2", 1.0, 0.0),
    "wind_m_s": ("Wind Speed", "m/s", 1.0, 0.0),
}
_BELOW = -9000.0
_DAY_MIN = 1440
_LAST_YEAR = 9999
# Least number of depths of rain below 3 mm that prove tenths of a millimetre: TMY3 always comes from such gauges.
_FEWEST_TMY3, _FEWEST_EPW = 1, 10
# Records per hour: the divisors of 60.
_PER_HOUR = tuple(count for count in range(1, 61) if 60 % count == 0)
_OFFSET = re.compile(r"Irradiance Time Offset \(h\): *([-+]?[\d.]+)", re.IGNORECASE)
_AVERAGING = re.compile(r"Averaging Method: *([\w ]+)", re.IGNORECASE)

# (year, month, day, minute of the day, text of the hour) of a row.
Label = tuple[int, int, int, int, str]
Lines = list[list[str]]


@dataclass(frozen=True)
class YearFile:
    """A table of whole days."""

    place: tuple[float, float, float]  # (latitude_deg, longitude_deg, altitude_m)
    zone_h: float  # Of the labels, hours east of UTC
    values: dict[str, Floats]  # Quantities by name, NaN where missing
    days: tuple[tuple[int, int], ...]  # Of each of the N / `per_day` days, in order
    years: set[int]  # Calendar years of the rows
    per_day: int  # Rows of a day
    first_min: float  # Label of a day's first row, after midnight [min]
    interval_min: float  # From a label to the middle of its averaging interval [min], not above 0
    light_min: float  # From a label to the instant of its sunlight [min]
    notes: list[str] = field(default_factory=list)

    @property
    def step_min(self) -> float:
        """Length of an interval [min]."""
        return _DAY_MIN / self.per_day

    @property
    def whole(self) -> bool:
        """Whether the file holds a year."""
        return len(self.days) >= 365


def read_year_file(path: str | PathLike[str]) -> YearFile:
    """Return the YearFile of an EPW file or of a TMY3 or PSM table, recognised by its first lines.

    The text may be UTF-8 or, with letters in comments and names, of a Western European code page.
    """
    lines = _lines(path)
    reader = _reader(lines)
    if reader is not None:
        return reader(path, lines)
    raise ThermorenderError(
        f"{path} is neither an EPW file, which begins with LOCATION, nor a TMY3 table, whose second line begins "
        "with Date (MM/DD/YYYY), nor a table of the NSRDB, whose first line names Latitude and Time Zone; give one of "
        "these, or make it a station's table (docs/reference/file-formats.md) and give it as file"
    )


def is_year_file(path: str | PathLike[str]) -> bool:
    """Return whether the first lines of a file are those of an EPW file, or of a TMY3 or PSM table."""
    return _reader(_lines(path)) is not None


def _lines(path: str | PathLike[str]) -> Lines:
    try:
        return [line for line in csv.reader(io.StringIO(read_text(path, "the text it was", "cp1252"))) if line]
    except csv.Error as error:
        raise ThermorenderError(f"{path} is not comma-separated text ({error}); give the file as it came") from None


def _reader(lines: Lines) -> Callable[[object, Lines], YearFile] | None:
    """The reader of the format recognised by its first lines, or None."""
    first = [cell.strip() for cell in lines[0]] if lines else [""]
    second = [cell.strip() for cell in lines[1]] if len(lines) > 1 else []
    if first[0].upper() == "LOCATION":
        return _epw
    if len(first) >= 7 and second[:2] == ["Date (MM/DD/YYYY)", "Time (HH:MM)"]:
        return _tmy3
    if {"Latitude", "Longitude", "Time Zone", "Elevation"} <= set(first) and len(lines) > 3:
        return _psm
    return None


def _epw(path: object, lines: Lines) -> YearFile:
    start = next((k for k, line in enumerate(lines) if line[0].strip().upper().startswith("DATA PERIODS")), None)
    if start is None or len(lines[0]) < 10:
        raise ThermorenderError(f"{path} has no line DATA PERIODS or an unfinished LOCATION; give the whole EPW file")
    latitude, longitude, zone_h, altitude = (_number(path, "LOCATION", text) for text in lines[0][6:10])
    stated_per_hour = _number(path, "DATA PERIODS", lines[start][2]) if len(lines[start]) > 2 else 1.0
    rows = lines[start + 1 :]
    short = [k for k, row in enumerate(rows) if len(row) < _EPW_CELLS]
    if short:
        raise ThermorenderError(
            f"{path}, row {start + 2 + short[0]}: {len(rows[short[0]])} cells; an EPW row has 35, so give the whole row"
        )
    if stated_per_hour not in _PER_HOUR:
        raise ThermorenderError(
            f"{path}: DATA PERIODS states {stated_per_hour:g} records per hour; give a divisor of 60"
        )
    per_hour = int(stated_per_hour)
    labels = []
    for number, row in enumerate(rows, start=start + 2):
        # The minute is the end of the interval within the hour; 0 and 60 are the hour's.
        year, hour, minute = (_whole(path, number, row[k]) for k in (0, 3, 4))
        labels.append((year, *_date(path, number, row[1:3]), 60 * (hour - 1) + (minute or 60), row[3]))
    step = 60.0 / per_hour
    days, years, first = _days(path, labels, step, start + 2, "1 to 24")
    values = {
        name: _scaled(_numbers(path, rows, column), scale, after, missing)
        for name, (column, scale, after, missing) in _EPW.items()
    }
    rain = _scaled(_numbers(path, rows, _EPW_RAIN), 1.0, 0.0, 999.0)
    hours = _scaled(_numbers(path, rows, _EPW_RAIN_H), 1.0, 0.0, 99.5)
    notes: list[str] = []
    # Where every row has the whole step of an hour, a label within the interval is its middle.
    interval = -min(first, step) + 0.5 * step
    light = interval
    stated = next(filter(None, (_OFFSET.search(",".join(line)) for line in lines[:start])), None)
    if stated:
        light = 60.0 * _number(path, "Irradiance Time Offset", stated[1])
        notes.append(f"The file states that sunlight is {stated[1]} h after its labels.")
    _add_rain(path, values, rain, hours, per_hour, len(days) >= 365, _FEWEST_EPW, "column 34", notes)
    return YearFile(_place(path, latitude, longitude, altitude), zone_h, values, days, years, 24 * per_hour, first,
                    interval, light, notes)  # fmt: skip


def _tmy3(path: object, lines: Lines) -> YearFile:
    header, rows = [cell.strip() for cell in lines[1]], lines[2:]
    zone_h, latitude, longitude, altitude = (_number(path, "line 1", text) for text in lines[0][3:7])
    labels = []
    for number, row in enumerate(rows, start=3):
        try:
            month, day, year = row[0].split("/")
            hour, minute = row[1].split(":")[:2]
        except (ValueError, IndexError):
            raise ThermorenderError(
                f"{path}, row {number}: {row[:2]} are not a date and hour of TMY3; correct the row"
            ) from None
        if len(row) < len(header):
            raise ThermorenderError(f"{path}, row {number}: {len(row)} cells where row 2 names {len(header)} columns")
        label = 60 * _whole(path, number, hour) + _whole(path, number, minute)
        labels.append((_whole(path, number, year), *_date(path, number, (month, day)), label, row[1]))
    step = float(labels[1][3] - labels[0][3]) if len(labels) > 1 else 0.0
    days, years, first = _days(path, labels, step, 3, "01:00 to 24:00")
    units = {name: re.match(r"(.*?)\s*\(+([^()]*)\)*$", name) for name in header}
    columns = {found[1]: (k, found[2]) for k, found in enumerate(units[name] for name in header) if found}
    values = _named(path, rows, _TMY3, columns, "row 2")
    rain, hours = values.pop("rain_mm", None), values.pop("rain_h", None)
    notes: list[str] = []
    per_hour = round(60.0 / step)
    if rain is not None:
        hours = np.ones(len(rain)) if hours is None else hours
        whole = len(days) >= 365
        _add_rain(path, values, rain, hours, per_hour, whole, _FEWEST_TMY3, "Lprecip depth", notes)
    interval = -0.5 * step
    stated = _AVERAGING.search(",".join(lines[0]))
    if stated and "end" not in stated[1].lower():
        raise ThermorenderError(
            f"{path}: its first line states the averaging method {stated[1].strip()!r}, but TMY3 labels intervals by "
            "their end; order the table with that, or change labels and statement"
        )
    return YearFile(_place(path, latitude, longitude, altitude), zone_h, values, days, years, 24 * per_hour, first,
                    interval, interval, notes)  # fmt: skip


def _psm(path: object, lines: Lines) -> YearFile:
    about = dict(zip((cell.strip() for cell in lines[0]), (cell.strip() for cell in lines[1]), strict=False))
    zone_h, latitude, longitude, altitude = (
        _number(path, name, about.get(name, "")) for name in ("Time Zone", "Latitude", "Longitude", "Elevation")
    )
    header, rows = [cell.strip() for cell in lines[2]], lines[3:]
    missing = [name for name in ("Year", "Month", "Day", "Hour", "Minute") if name not in header]
    if missing:
        raise ThermorenderError(f"{path}: row 3 has no column {missing[0]}; give the whole table of the NSRDB")
    year, month, day, hour, minute = (header.index(name) for name in ("Year", "Month", "Day", "Hour", "Minute"))
    named = [k for k, name in enumerate(header) if name]
    labels = []
    for number, row in enumerate(rows, start=4):
        if len(row) <= named[-1]:
            raise ThermorenderError(f"{path}, row {number}: {len(row)} cells where row 3 names {len(named)} columns")
        label = 60 * _whole(path, number, row[hour]) + _whole(path, number, row[minute])
        labels.append((_whole(path, number, row[year]), *_date(path, number, (row[month], row[day])), label, row[hour]))
    step = float(labels[1][3] - labels[0][3]) if len(labels) > 1 else 0.0
    days, years, first = _days(path, labels, step, 4, "0 to 23", end=False)
    columns = {name: (k, about.get(f"{name} Units", "")) for k, name in enumerate(header)}
    values = _named(path, rows, _PSM, columns, "row 1")
    return YearFile(_place(path, latitude, longitude, altitude), zone_h, values, days, years, round(_DAY_MIN / step),
                    first, 0.0, 0.0)  # fmt: skip


def _named(
    path: object,
    rows: Lines,
    table: Mapping[str, tuple[str, str, float, float]],
    columns: Mapping[str, tuple[int, str]],
    where: str,
) -> dict[str, Floats]:
    """{Quantity: values (N,)} of named columns {name: (number, unit)}, after refusing other units."""
    values = {}
    for name, (column, unit, scale, after) in table.items():
        if column in columns:
            number, stated = columns[column]
            if stated and stated.lower().replace("²", "^2") != unit.lower():
                raise ThermorenderError(
                    f"{path}: {where} states the unit {stated!r} of {column}; convert the column to {unit}"
                )
            values[name] = _scaled(_numbers(path, rows, number), scale, after, np.inf)
    return values


def _add_rain(
    path: object,
    values: dict[str, Floats],
    depth: Floats,
    period_h: Floats,
    per_hour: int,
    periodic: bool,
    fewest: int,
    column: str,
    notes: list[str],
) -> None:
    if not np.isnan(depth).all():
        amount = by_hour(path, in_mm(column, depth, fewest, notes), period_h, per_hour, periodic, notes)
        values["rain_mm_h"] = amount * per_hour


def _scaled(numbers: Floats, scale: float, after: float, missing: float) -> Floats:
    numbers[(numbers >= missing) | (numbers <= _BELOW)] = np.nan
    return numbers * scale + after


def _days(
    path: object, labels: Sequence[Label], step: float, first_row: int, hours: str, end: bool = True
) -> tuple[tuple[tuple[int, int], ...], set[int], float]:
    """((Month, day) of each day, years, label of a day's first row [min]) of (year, month, day, minute, text).

    Labels are ends of intervals, where 00:00 of the next day or of the same date stands for 24:00, or else instants.
    """
    if not (labels and step > 0.0 and 60.0 % step == 0.0):
        raise ThermorenderError(f"{path}: its rows are {step:g} min apart; give rows of an hour or a whole part of it")
    per_day, first = round(_DAY_MIN / step), labels[0][3]
    if len(labels) % per_day or not (0 < first <= step if end else 0 <= first < step):
        raise ThermorenderError(
            f"{path} has {len(labels)} rows from {labels[0][4]} on; give whole days of hours {hours}, in order"
        )
    days: list[tuple[int, int]] = []
    years: set[int] = set()
    for k, (year, month, day, minute, text) in enumerate(labels):
        number, date = k % per_day, (month, day)
        if number == 0:
            days.append(date)
        elif end and minute == 0 and number == per_day - 1:
            minute, year, date = _DAY_MIN, labels[k - 1][0], days[-1] if date in _following(days[-1]) else date
        years.add(year)
        if date != days[-1] or minute != first + number * step:
            raise ThermorenderError(
                f"{path}, row {first_row + k}: {month}/{day} {text} does not follow the row above; give whole days of "
                f"hours {hours}, in order"
            )
    twice = next((date for date in days if days.count(date) > 1), None)
    if twice:
        raise ThermorenderError(f"{path}: {twice[0]}/{twice[1]} occurs twice; give one year")
    return tuple(days), years, float(first)


def _following(date: tuple[int, int]) -> set[tuple[int, int]]:
    """The (month, day) after a date, in a common year and in a leap year."""
    years = (2000, 2001) if date != (2, 29) else (2000,)
    after = [datetime.date(year, *date) + datetime.timedelta(1) for year in years]
    return {(each.month, each.day) for each in after}


def _date(path: object, number: int, texts: Sequence[str]) -> tuple[int, int]:
    """(Month, day) of a row."""
    try:
        month, day = (int(text) for text in texts)
        # A leap year has all possible days.
        datetime.date(2000, month, day)
    except (ValueError, OverflowError):
        raise ThermorenderError(
            f"{path}, row {number}: {'/'.join(map(str, texts))} is not a date; correct it"
        ) from None
    return month, day


def _whole(path: object, number: int, text: str) -> int:
    try:
        found = float(text)
    except ValueError:
        found = np.nan
    if not 0.0 <= found <= _LAST_YEAR:
        raise ThermorenderError(
            f"{path}, row {number}: {shortened(repr(text))} is not a year, an hour or a minute; correct it"
        )
    return int(found)


def _place(path: object, latitude: float, longitude: float, altitude: float) -> tuple[float, float, float]:
    if not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0 and LOWEST_M <= altitude <= HIGHEST_M):
        raise ThermorenderError(
            f"{path}: latitude {latitude:g}, longitude {longitude:g}, elevation {altitude:g} m in the header are not "
            "a place on land; correct the first line"
        )
    return latitude, longitude, altitude


def _number(path: object, where: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ThermorenderError(f"{path}: {shortened(repr(text))} in {where} is not a number; correct it") from None


def _numbers(path: object, rows: Lines, column: int) -> Floats:
    """Numbers (N,) of a column; empty cells are missing."""
    return np.array(
        [
            _number(path, f"column {column + 1}", row[column] if len(row) > column and row[column].strip() else "nan")
            for row in rows
        ]
    )
