"""The Weather of a weather year: EPW files of EnergyPlus, and TMY3 and PSM tables of the NSRDB.

A typical year joins months of different years. It is mapped to one calendar year, day by day, as is a real year.
29 February repeats the 28th if the file has none, and is left out if the year has none. The instants of the Weather are
those of the sunlight, to which the other quantities are interpolated.
"""

from dataclasses import replace
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError
from thermorender.physics import sun
from thermorender.weather.clock import check_clock
from thermorender.weather.columns import check_light, check_pressure, check_range, vapour_of
from thermorender.weather.complete import complete
from thermorender.weather.gaps import filled, unbroken, without_offset
from thermorender.weather.rain import check_rain
from thermorender.weather.series import Floats, Weather
from thermorender.weather.year_file import LIGHT, YearFile, read_year_file

_LONGEST_GAP_H = 3
_GAP_ADVICE = (
    "choose an instant outside of it, or give a station's table as file, which may lack columns and has longest_gap_h"
)
# Days added before and after the year, for simulations that begin earlier.
_BEFORE_D, _AFTER_D = 31, 2
_MEANS = ("longwave_w_m2", "rain_mm_h")


def read_epw(
    path: str | PathLike[str],
    year: int | np.datetime64,
    snow_depth_m: float | None = None,
    light_shift_min: float = 0.0,
) -> Weather:  # fmt: skip
    """Return the Weather of an EPW file, or a TMY3 or PSM table, in a calendar year or that of an instant.

    A file of a whole year is extended by its December before the year and its January after it. `snow_depth_m` is used
    if the file has none. `light_shift_min` is added to the times of the sunlight [min], for a file whose radiation
    belongs to other instants than its format says: 30 for the labels themselves, -30 for an hour before them.
    """
    file = read_year_file(path)
    place, zone_h, step_min = file.place, file.zone_h, file.step_min
    if not abs(zone_h) <= 14.0:
        raise ThermorenderError(f"{path}: zone {zone_h:g} h in the header is not valid; give −12…14 h from UTC")
    left_out: list[str] = []
    if isinstance(year, np.datetime64):
        local = year + np.timedelta64(round(zone_h * 60), "m")
        file = _unbroken(file, local, left_out)
        year = int(str(local.astype("datetime64[Y]")))
    labels, source = _calendar(path, file, year)
    light_min = file.light_min + light_shift_min
    time = labels + np.timedelta64(round(60.0 * (light_min - 60.0 * zone_h)), "s")
    notes = [_of_years(file.years, year), *file.notes, *left_out]
    if light_shift_min:
        notes.append(f"Its sunlight is shifted by {light_shift_min:g} min, as declared.")
    given: dict[str, Floats] = {}
    stamps = _stamps(file, year)
    for name, numbers in file.values.items():
        if np.isnan(numbers).all():
            continue
        if name == "rain_mm_h":
            check_rain(path, "rain", numbers, 60.0 * step_min, notes)
        numbers = filled(path, name, name, numbers, stamps, 60.0 * step_min, _LONGEST_GAP_H, notes, "", _GAP_ADVICE)
        if name in LIGHT:
            numbers = without_offset(name, numbers, notes)
        check_range(path, name, numbers)
        if name == "global_w_m2":
            elevation = sun.position_at(time, *place[:2])[1]
            check_light(path, name, numbers[source], elevation, 60.0 * step_min)
        # Where in the file's rows the sunlight of each row is found, relative to this quantity's instants.
        own = light_min if name in LIGHT else file.interval_min if name in _MEANS else 0.0
        given[name] = _moved(numbers, (light_min - own) / step_min, file.whole)[source]
    if "air_k" not in given:
        raise ThermorenderError(f"{path} has no air temperature; give a file with a filled dry-bulb column")
    if "pressure_pa" in given:
        check_pressure(path, "pressure", given["pressure_pa"], place[2])
    vapour = vapour_of(path, given, given["air_k"], notes)
    given = {name: value for name, value in given.items() if name not in ("dew_point_k", "rh")}
    if vapour is not None:
        given["vapour_pa"] = vapour
    if "global_w_m2" in given:
        note = check_clock(path, time, given["global_w_m2"], *place[:2], 60.0 * step_min, light_shift_min)
        notes += [note] if note else []
    return complete(time, place, given, notes, snow_depth_m=snow_depth_m)


def _stamps(file: YearFile, year: int) -> NDArray[np.datetime64]:
    """Dates and times (N,) of the file's rows, if its days follow each other."""
    begin = np.datetime64(f"{year:04d}-{file.days[0][0]:02d}-01", "s") + np.timedelta64(file.days[0][1] - 1, "D")
    return begin + np.timedelta64(round(60 * file.step_min), "s") * np.arange(len(file.days) * file.per_day)


def _unbroken(file: YearFile, local: np.datetime64, notes: list[str]) -> YearFile:
    """The whole days around an instant in the file's zone that have no long gap; the file itself without one."""
    day = local.astype("datetime64[D]")
    date = day.item().month, day.item().day
    if date not in file.days:
        return file
    stamps = _stamps(file, day.item().year)
    around = stamps[file.days.index(date) * file.per_day] + (local - day)
    names = {name: name for name in file.values}
    first, last = unbroken(stamps, file.values, names, 60.0 * file.step_min, _LONGEST_GAP_H, around, notes, zone="")
    days = slice(
        -(-int(np.searchsorted(stamps, first)) // file.per_day),
        int(np.searchsorted(stamps, last, side="right")) // file.per_day,
    )
    if days == slice(0, len(file.days)) or days.start >= days.stop:
        return file
    rows = slice(days.start * file.per_day, days.stop * file.per_day)
    return replace(file, days=file.days[days], values={name: series[rows] for name, series in file.values.items()})


def _of_years(years: set[int], year: int) -> str:
    """A note on the years of the rows."""
    if len(years) > 1:
        return f"A typical year: its months, of different years, are mapped to {year}."
    return f"Its rows of the year {min(years)} are mapped to {year}." if years != {year} else f"Its rows are of {year}."


def _moved(numbers: Floats, rows: float, periodic: bool) -> Floats:
    """Values (N,) interpolated at `rows` (fractional) after each sample; a whole year is periodic."""
    if rows == 0.0:
        return numbers
    count = len(numbers)
    return np.interp(np.arange(count) + rows, np.arange(count), numbers, period=count if periodic else None)


def _calendar(path: object, file: YearFile, year: int) -> tuple[NDArray[np.datetime64], NDArray[np.int64]]:
    """(Labels in the zone's time (M,) datetime64[s], rows of the file (M,)) for a year."""
    first_row = {date: file.per_day * k for k, date in enumerate(file.days)}
    if (2, 28) in first_row and (3, 1) in first_row:
        first_row.setdefault((2, 29), first_row[2, 28])
    day = np.timedelta64(1, "D")
    start, end = np.datetime64(f"{year:04d}-01-01"), np.datetime64(f"{year:04d}-12-31")
    dates = (
        np.arange(start - _BEFORE_D * day, end + (_AFTER_D + 1) * day) if file.whole else np.arange(start, end + day)
    )
    found = [(date, first_row.get((date.item().month, date.item().day))) for date in dates]
    found = [(date, row) for date, row in found if row is not None]
    dates = np.array([date for date, _ in found])
    if (np.diff(dates) > day).any():
        k = int(np.argmax(np.diff(dates) > day))
        raise ThermorenderError(
            f"{path}: the days between {dates[k]} and {dates[k + 1]} are missing; give consecutive days"
        )
    within = np.timedelta64(1, "s") * np.round(
        60.0 * (file.first_min + file.step_min * np.arange(file.per_day))
    ).astype(int)
    labels: Any = (dates.astype("datetime64[s]")[:, None] + within).ravel()
    return labels, (np.array([row for _, row in found])[:, None] + np.arange(file.per_day)).ravel()
