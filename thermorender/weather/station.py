"""The Weather of a station's CSV file, with units in column names, zones in times, and gaps repaired or refused.

Row numbers in messages are a spreadsheet's: the header is row 1.
"""

import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError, shortened
from thermorender.formats import csv_rows, read_text
from thermorender.physics import sun
from thermorender.schema import closest
from thermorender.units import instant
from thermorender.weather.clock import check_clock
from thermorender.weather.columns import (
    COLUMNS,
    MISSING_NUMBERS,
    MISSING_TEXTS,
    USUAL,
    check_light,
    check_pressure,
    check_values,
    vapour_of,
)
from thermorender.weather.complete import complete
from thermorender.weather.gaps import filled, unbroken, without_offset
from thermorender.weather.rain import amounts_of, check_rain, looks_like_total
from thermorender.weather.series import Floats, Weather

_TIMES = ("time_utc", "time", "time_local")
_LONGEST_STEP_S = 3 * 3600.0
# Lines in which the names of the columns are looked for, below notes on the station.
_MOST_NOTES = 50
# Of cloud in oktas, where fog or snow hides the sky: WMO-No. 306, code table 2700.
_OBSCURED = 9.0
_NO_AIR = "it has no air temperature: add a column air_c, air_k or air_f"
_LIGHT = ("global_w_m2", "direct_w_m2", "diffuse_w_m2")

Times = NDArray[np.datetime64]
Period = Sequence[str | datetime | np.datetime64]


def read_station(
    path: str | PathLike[str], latitude_deg: float, longitude_deg: float, altitude_m: float, *,
    utc_offset_h: float | None = None, names: Mapping[str, str] | None = None,
    during: Period | None = None, around: np.datetime64 | None = None,
    longest_gap_h: float = 3.0, wind_m_s: float | None = None, snow_depth_m: float | None = None,
    air_height_m: float = 2.0, wind_height_m: float = 10.0,
) -> Weather:  # fmt: skip
    """Return the Weather of a station's CSV table, whose missing quantities `complete` models; its notes list them.

    The columns are a time, the air temperature, and any others of `columns.COLUMNS`, or `names`, {column of the file:
    our name}. Times are the middles of averaging intervals: `time_utc`, `time` with a zone in each cell, or
    `time_local`, with `utc_offset_h` eastward positive and without summer time. `during` is the first and last instant
    to read, as in `units.instant`; rows beyond the longer gaps next to the instant `around` are left out. Gaps up to
    `longest_gap_h` are interpolated. `wind_m_s` (2.5 m/s by default) and `snow_depth_m` are used if the file has none.
    """
    place = latitude_deg, longitude_deg, altitude_m
    notes: list[str] = []
    header, cells, rows = _read(path, names or {}, notes)
    _refuse_near_misses(path, header)
    time, cells, rows = _times(path, header, cells, rows, utc_offset_h)
    keep = _within(path, time, during)
    time, rows, cells = time[keep], rows[keep], [cells[k] for k in np.flatnonzero(keep)]
    if (np.diff(time) < np.timedelta64(0, "s")).all():
        time, rows, cells = time[::-1], rows[::-1], cells[::-1]
        notes.append("Its rows are newest first, and read in reverse.")
    step_s = _check_rising(path, time, rows)
    if step_s > _LONGEST_STEP_S:
        raise ThermorenderError(
            f"{path}: rows are {step_s / 3600.0:g} h apart; give steps of 3 h at most, because the sun moves"
        )
    others = [name for name in header if name and name not in COLUMNS and name not in _TIMES]
    notes += [f"Columns that are not read: {shortened(', '.join(others), 200)}."] if others else []
    values, column_of = _quantities(path, header, cells, rows, notes)
    _refuse_totals(path, time, values, column_of, step_s)
    if around is not None:
        ends = unbroken(time, values, column_of, step_s, longest_gap_h, around, notes)
        kept = slice(*np.searchsorted(time, [ends[0], ends[1] + np.timedelta64(1, "s")]))
        if kept.start >= kept.stop:
            raise ThermorenderError(
                f"{path} has no row around {around}Z without a long gap: {' '.join(notes[-1:])} Give a time when all "
                "columns have values"
            )
        time, rows, values = time[kept], rows[kept], {name: series[kept] for name, series in values.items()}
    if "pressure_pa" in values:
        check_pressure(path, column_of["pressure_pa"], values["pressure_pa"], altitude_m)
    _note_missing_rows(path, time, rows, step_s, longest_gap_h, notes)
    time, rows, values = _dry_gaps(time, rows, values, step_s)
    elevation = sun.position_at(time, latitude_deg, longitude_deg)[1]
    _repair(path, time, values, column_of, elevation, step_s, longest_gap_h, notes)
    given = _for_complete(path, values, step_s, notes)
    found = complete(time, place, given, notes, wind_m_s, snow_depth_m, air_height_m=air_height_m,
                     wind_height_m=wind_height_m)  # fmt: skip
    if set(_LIGHT) & set(given):
        height = np.sin(np.radians(np.maximum(elevation, 0.0)))
        light = given.get("global_w_m2", found.direct_w_m2 * height + given.get("diffuse_w_m2", 0.0))
        note = check_clock(path, time, light, latitude_deg, longitude_deg, step_s)
        if note:
            found = replace(found, notes=(*found.notes, note))
    return found


def _refuse_totals(
    path: object, time: Times, values: Mapping[str, Floats], column_of: Mapping[str, str], step_s: float
) -> None:
    """Refuse rain of intervals that looks like a running total."""
    for quantity in ("rain_mm", "rain_mm_h"):
        if column_of.get(quantity) in COLUMNS:
            like = looks_like_total(values[quantity], (time - time[0]).astype(np.float64), step_s)
            if like:
                unit = "in" if column_of[quantity].endswith("_in") else "mm"
                raise ThermorenderError(
                    f"{path}: {column_of[quantity]} looks like {like}, as it seldom falls; rename the column to "
                    f"rain_total_{unit}, or write the rain of each interval"
                )


def _repair(
    path: object, time: Times, values: dict[str, Floats], column_of: Mapping[str, str], elevation: Floats,
    step_s: float, longest_gap_h: float, notes: list[str],
) -> None:  # fmt: skip
    """Check rain and light of `values`, in place, set night offsets of light to 0, and fill short gaps."""
    for quantity in list(values):
        column = column_of[quantity]
        if quantity.startswith("rain_mm"):
            rate = values[quantity] * (3600.0 / step_s if quantity == "rain_mm" else 1.0)
            check_rain(path, column, rate, step_s, notes)
        if quantity in _LIGHT:
            check_light(path, column, values[quantity], elevation, step_s, values)
            values[quantity] = without_offset(column, values[quantity], notes)
        values[quantity] = filled(path, column, quantity, values[quantity], time, step_s, longest_gap_h, notes)


def _for_complete(path: object, values: Mapping[str, Floats], step_s: float, notes: list[str]) -> dict[str, Floats]:
    """The quantities that `complete` takes: one humidity, a rate of rain, and snow that is not negative."""
    vapour = vapour_of(path, values, values["air_k"], notes)
    given = {name: values[name] for name in values if name not in ("vapour_pa", "dew_point_k", "rh", "deficit_pa")}
    if vapour is not None:
        given["vapour_pa"] = vapour
    if "rain_mm" in given:
        rain = given.pop("rain_mm") * 3600.0 / step_s
        given.setdefault("rain_mm_h", rain)
    if "snow_m" in given:
        given["snow_m"] = np.maximum(given["snow_m"], 0.0)
    return given


def _quantities(
    path: object, header: list[str], cells: list[list[str]], rows: NDArray[np.int64], notes: list[str]
) -> tuple[dict[str, Floats], dict[str, str]]:
    """({quantity: values (N,) in its unit, NaN where missing}, {quantity: column}), checked."""
    values: dict[str, Floats] = {}
    column_of: dict[str, str] = {}
    for name, column in COLUMNS.items():
        if name in header:
            numbers = _numbers(path, name, [row[header.index(name)] for row in cells], rows, notes)
            if np.isnan(numbers).all():
                notes.append(f"Column {name} is empty.")
                continue
            if column.quantity in values:
                raise ThermorenderError(
                    f"{path}: columns {column_of[column.quantity]} and {name} are the same quantity; leave one out"
                )
            if name == "cloud_oktas" and (numbers == _OBSCURED).any():
                notes.append(f"{(numbers == _OBSCURED).sum()} values of {name} are 9, a hidden sky: taken as overcast.")
                numbers = np.where(numbers == _OBSCURED, 8.0, numbers)
            numbers = (numbers + column.before) * column.scale + column.after
            check_values(path, name, numbers, rows)
            values[column.quantity], column_of[column.quantity] = numbers, name
    if "rain_total_mm" in values:
        twice = [column_of[name] for name in ("rain_mm", "rain_mm_h") if name in values]
        if twice:
            raise ThermorenderError(
                f"{path}: columns {column_of['rain_total_mm']} and {twice[0]} are rain twice; leave one out"
            )
        values["rain_mm"] = amounts_of(values.pop("rain_total_mm"))
        column_of["rain_mm"] = f"amounts of {column_of['rain_total_mm']}"
    if "air_k" not in values:
        raise ThermorenderError(f"{path} has no air temperature; add a column air_c, air_k or air_f")
    if "ppfd_w_m2" in values:
        photons = values.pop("ppfd_w_m2")
        if not set(_LIGHT) & set(values):
            values["global_w_m2"], column_of["global_w_m2"] = photons, "ppfd_umol_m2_s"
            notes.append("Short-wave is missing: photosynthetic light over 2.05 µmol/J, ± 5 %.")
    if set(_LIGHT) & set(values) in ({"direct_w_m2"}, {"diffuse_w_m2"}):
        raise ThermorenderError(f"{path} has direct or diffuse light only; add sw_down_w_m2, or leave the column out")
    return values, column_of


def read_columns(
    path: str | PathLike[str], columns: Sequence[str], *,
    during: Period | None = None, utc_offset_h: float | None = None,
) -> tuple[Times, dict[str, Floats]]:  # fmt: skip
    """Return (instants (N,) datetime64[s] UTC, {column: numbers (N,), NaN where missing}) of a station's table.

    It reads columns that `read_station` does not use, such as other measurements; the rows are the same.
    """
    header, cells, rows = _read(path, {}, [])
    time, cells, rows = _times(path, header, cells, rows, utc_offset_h)
    keep = np.flatnonzero(_within(path, time, during))
    keep = keep[::-1] if (np.diff(time) < np.timedelta64(0, "s")).all() else keep
    for name in columns:
        if name not in header:
            raise ThermorenderError(f"{path} has no column {name!r}; row 1 names {shortened(', '.join(header))}")
    found = {
        name: _numbers(path, name, [cells[k][header.index(name)] for k in keep], rows[keep], []) for name in columns
    }
    return time[keep], found


# The file


def _read(
    path: str | PathLike[str], names: Mapping[str, str], notes: list[str]
) -> tuple[list[str], list[list[str]], NDArray[np.int64]]:
    """(Header in our names, rows of cells, row numbers)."""
    try:
        above, text = _below_notes(read_text(path, "CSV UTF-8"), names)
        table = [[""]] * above + csv_rows(text)
    except csv.Error as error:
        raise ThermorenderError(f"{path} is not CSV ({error}); correct the quotation marks") from None
    numbers = [number for number, line in enumerate(table, start=1) if any(line)]
    lines = [table[number - 1] for number in numbers]
    if above:
        notes.append(f"Lines above the names of the columns ({above}) are not read.")
    if len(lines) < 3:
        raise ThermorenderError(f"{path} has {max(len(lines) - 1, 0)} rows below a row of names; give at least two")
    unknown = [name for name in names if name not in lines[0]]
    if unknown:
        raise ThermorenderError(f"{path} has no column {unknown[0]!r}; row 1 names {shortened(', '.join(lines[0]))}")
    header = [names.get(name, "" if name in names.values() else name) for name in lines[0]]
    twice = [name for name in header if name and header.count(name) > 1]
    if twice:
        raise ThermorenderError(f"{path}: row 1 names column {twice[0]!r} twice; leave one of them out")
    for number, line in zip(numbers, lines, strict=True):
        if len(line) != len(header):
            raise ThermorenderError(
                f"{path}, row {number}: {len(line)} cells where row 1 names {len(header)} columns; delete lines of "
                "place, units or notes around the row of names, or give the row its cells"
            )
    return header, lines[1:], np.array(numbers[1:])


def _below_notes(text: str, names: Mapping[str, str]) -> tuple[int, str]:
    """(Number of lines above the one that names a column of times, the text from there on); (0, text) without one."""
    times = {*_TIMES, *(own for own, name in names.items() if name in _TIMES)}
    lines = text.splitlines(keepends=True)
    # A stated separator belongs to the table.
    separator = lines.pop(0) if lines and lines[0].lower().lstrip('"').startswith("sep=") else ""
    for number, line in enumerate(lines[:_MOST_NOTES]):
        if times & {cell.strip(' "\r\n') for cell in re.split(r"[;,\t|]", line)}:
            return number, separator + "".join(lines[number:])
    return 0, text


def _refuse_near_misses(path: object, header: list[str]) -> None:
    """Refuse misspelt names of ours, or ones in another unit, if no other column has their quantity."""
    given = {COLUMNS[name].quantity for name in header if name in COLUMNS}
    ours = [name for name, column in COLUMNS.items() if column.quantity not in given and len(name) > 4]
    renamed, misspelt = {}, {}
    for name in header:
        if name and name not in COLUMNS and name not in _TIMES:
            usual = USUAL.get(re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_"))
            near = closest(name, ours, cutoff=0.84)
            if usual and COLUMNS[usual].quantity not in given:
                renamed[name] = usual
            # A longer name, such as roof_air_c, is another place's; sw_up is not sw_down.
            elif near and not name.endswith(f"_{near[0]}") and "_up_" not in name:
                misspelt[name] = near[0]
    wrong = []
    if renamed:
        wrong.append(
            f"{_columns(renamed)} not known by this name; rename it to "
            f"{', '.join(renamed.values())} if that is its unit, else to another name of "
            "docs/reference/file-formats.md, or delete it"
        )
    if misspelt:
        wrong.append(
            f"{_columns(misspelt)} not known; did you mean {', '.join(map(repr, misspelt.values()))}? "
            "rename it, or delete it"
        )
    found = {COLUMNS[name].quantity for name in (*renamed.values(), *misspelt.values())} | given
    if wrong and "air_k" not in found:
        wrong.append(_NO_AIR)
    if wrong:
        raise ThermorenderError(f"{path}: {'; '.join(wrong)}")


def _columns(names: Mapping[str, str]) -> str:
    """Columns as the subject of a sentence: "column 'a' is" or "each of columns 'a', 'b' is"."""
    return f"{'each of columns' if len(names) > 1 else 'column'} {', '.join(map(repr, names))} is"


def _numbers(path: object, name: str, texts: Sequence[str], rows: NDArray[np.int64], notes: list[str]) -> Floats:
    """Numbers of a column (N,), NaN where missing."""
    found = np.full(len(texts), np.nan)
    marked = 0
    for k, text in enumerate(texts):
        if text.lower() in MISSING_TEXTS:
            continue
        try:
            value = float(text)
        except ValueError:
            raise ThermorenderError(
                f"{path}, row {rows[k]}: {name}={shortened(repr(text))} is not a number; write it with a point as "
                "decimal mark and without unit, or leave the cell empty"
            ) from None
        if value in MISSING_NUMBERS:
            marked += 1
        elif np.isfinite(value):
            found[k] = value
    if marked:
        notes.append(f"{marked} values of {name} such as -9999 mark missing ones.")
    return found


# Time


def _times(
    path: object, header: list[str], cells: list[list[str]], rows: NDArray[np.int64], utc_offset_h: float | None
) -> tuple[Times, list[list[str]], NDArray[np.int64]]:
    """(Instants (N,) in UTC, cells, rows); a leap second beside the row of the midnight that it is read as is left
    out."""
    column = next((name for name in _TIMES if name in header), None)
    if column is None:
        raise ThermorenderError(
            f"{path} has no time; name a column time_utc, time (each with Z or an offset) or time_local (with the zone)"
        )
    if column == "time_local" and utc_offset_h is None:
        raise ThermorenderError(
            f"{path}: time_local has no zone; write times in UTC as time_utc, or with an offset as time"
        )
    k = header.index(column)
    found, leaps = [], []
    for number, line in zip(rows, cells, strict=True):
        text, more_s = _within_a_day(line[k].replace("Z", "+00:00"))
        try:
            moment = datetime.fromisoformat(text) + timedelta(seconds=more_s)
        except (ValueError, OverflowError):
            raise ThermorenderError(
                f"{path}, row {number}: {column}={line[k]!r} is not a time; write it as 2018-07-28T14:30Z"
            ) from None
        if column == "time_utc" and moment.tzinfo is None:
            moment = moment.replace(tzinfo=timezone.utc)
        if (moment.tzinfo is None) != (column == "time_local"):
            fault = "has a zone in time_local; name the column time" if moment.tzinfo else "has no zone"
            raise ThermorenderError(
                f"{path}, row {number}: {column}={line[k]!r} {fault}; write 2018-07-28T14:30Z or 2018-07-28T16:30+02:00"
            )
        if column == "time_utc" and moment.utcoffset():
            raise ThermorenderError(f"{path}, row {number}: time_utc={line[k]!r} is not UTC; name the column time")
        found.append(moment.replace(tzinfo=timezone.utc) if column == "time_local" else moment)
        leaps.append(more_s == 1)
    time: Any = np.array([int(moment.timestamp()) for moment in found]).astype("datetime64[s]")
    time = time - np.timedelta64(round(3600 * (utc_offset_h or 0.0)), "s") if column == "time_local" else time
    same = np.concatenate([[False], time[1:] == time[:-1], [False]])
    kept = np.flatnonzero(~(np.array(leaps) & (same[1:] | same[:-1])))
    return time[kept], [cells[k] for k in kept], rows[kept]


def _within_a_day(text: str) -> tuple[str, int]:
    """(Time that a clock of 24 hours of 3600 s shows, seconds to add): for 24:00:00 and a leap second 23:59:60."""
    if re.search(r"[T ]24:00(:00)?(?!\d|:)", text):
        return re.sub(r"([T ])24:", r"\g<1>00:", text), 86400
    if re.search(r"[T ]\d\d:\d\d:60", text):
        return re.sub(r"(:\d\d):60", r"\1:59", text), 1
    return text, 0


def _within(path: object, time: Times, during: Period | None) -> NDArray[np.bool_]:
    """Whether each row (N,) is within the period."""
    if during is None:
        return np.ones(len(time), bool)
    start, end = (instant("during", value) for value in during)
    keep = (time >= start) & (time <= end)
    if keep.sum() < 2:
        raise ThermorenderError(
            f"{path} has {keep.sum()} rows from {start}Z to {end}Z; give a period with at least two"
        )
    return keep


def _check_rising(path: object, time: Times, rows: NDArray[np.int64]) -> float:
    """The step of the series [s], after refusing times that do not rise."""
    step = np.diff(time).astype(np.int64)
    wrong = step <= 0
    if wrong.any():
        k = int(np.argmax(wrong))
        what = "the same time as" if step[k] == 0 else f"a time {-step[k] / 3600.0:g} h before"
        hint = "; an hour that repeats is the end of summer time, so write UTC" if -step[k] <= 3600 else ""
        raise ThermorenderError(
            f"{path}, row {rows[k + 1]}: {time[k + 1]}Z has {what} row {rows[k]}; times must rise{hint}"
        )
    return float(np.median(step))


def _note_missing_rows(
    path: object, time: Times, rows: NDArray[np.int64], step_s: float, longest_gap_h: float, notes: list[str]
) -> None:
    """Refuse long gaps of missing rows, and note short ones."""
    step = np.diff(time).astype(np.float64)
    long = step - step_s > 3600.0 * longest_gap_h
    if long.any():
        k = int(np.argmax(long))
        raise ThermorenderError(
            f"{path}: no rows from {time[k]}Z (row {rows[k]}) to {time[k + 1]}Z, longer than the {longest_gap_h:g} h "
            "that are interpolated; fill the gap, keep the rows before or after it, or give a larger longest_gap_h"
        )
    short = step > 1.5 * step_s
    if short.any():
        notes.append(
            f"{short.sum()} gaps of missing rows, {(step[short].max() - step_s) / 3600.0:.2g} h at most, are "
            "interpolated, without rain."
        )


def _dry_gaps(
    time: Times, rows: NDArray[np.int64], values: dict[str, Floats], step_s: float
) -> tuple[Times, NDArray[np.int64], dict[str, Floats]]:
    """Times, rows and values with rows of no rain after and before gaps, so that rain beside a gap does not fill it."""
    rain = [quantity for quantity in values if quantity in ("rain_mm", "rain_mm_h")]
    step = np.timedelta64(int(step_s), "s")
    after = np.flatnonzero(np.diff(time) > 1.5 * step)
    if not rain or not after.size:
        return time, rows, values
    added = np.unique(np.concatenate([time[after] + step, np.maximum(time[after + 1] - step, time[after] + step)]))
    added = np.setdiff1d(added, time)
    whole = np.concatenate([time, added])
    order = np.argsort(whole, kind="stable")
    found = {}
    for quantity, series in values.items():
        new = np.interp(added.astype(float), time.astype(float), series)
        found[quantity] = np.concatenate([series, np.zeros(len(added)) if quantity in rain else new])[order]
    return whole[order], np.concatenate([rows, rows[np.searchsorted(time, added)]])[order], found
