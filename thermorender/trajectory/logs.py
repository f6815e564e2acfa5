"""Flight logs: named columns of checked numbers at strictly increasing times."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta, timezone

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError
from thermorender.schema import closest
from thermorender.trajectory.column_mapping import (
    QUANTITIES,
    UNSTATED,
    Mapping,
    Quantity,
    changed_mapping,
    fitting_formats,
)
from thermorender.trajectory.estimates import drop_invalid, find_resets
from thermorender.trajectory.tables import Floats, Table

# Endings of columns with one of our quantities in another unit.
_OTHER_UNITS = ("rad", "mm", "cm", "km", "ft", "feet", "ms", "us", "ns", "m", "deg", "s")
# Largest time of a log [s], beyond nanosecond counters of a century.
_LATEST_S = 1e11
# Start of GPS time, 6 January 1980 [s since 1970]; a receiver without a fix counts from 1970.
_FIRST_FIX_S = 315_964_800.0
# Treatments of different rows with equal times.
DUPLICATES = ("refuse", "spread", "first")


@dataclass(frozen=True, eq=False)
class Log:
    """One file: `values` by our names and, for messages, the file's `columns` and each sample's row.

    `counters` names the estimator's reset counters that the file has. `open_resets` has the resets whose effect is
    in the file with another counter, and `notes` sentences for the user. `origin` is the latitude and longitude [deg]
    that local positions count from, if the log knows it. `resets` are notes on resets: text, time [s], text.
    """

    path: str
    row: NDArray[np.int64]
    time_s: Floats
    values: dict[str, Floats]
    columns: dict[str, str]
    origin: tuple[float, float] | None = None
    what: str = "row"
    counters: tuple[str, ...] = ()
    open_resets: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    resets: list[tuple[str, float, str]] = field(default_factory=list)

    def where(self, name: str, index: int) -> str:
        """Return "file, row R, column C" of one of our quantities, for messages."""
        column = self.columns.get(name, name)
        alias = "" if column == name else f" ({name})"
        return f"{self.path}, {self.what} {self.row[index]}, column {column!r}{alias}"

    def refuse(self, name: str, bad: NDArray[np.bool_], allowed: str) -> None:
        """Raise for the first bad sample, if any; the message says what arrived and what is allowed."""
        if bad.any():
            k = int(np.argmax(bad))
            raise ThermorenderError(f"{self.where(name, k)}: {self.values[name][k]:.9g} is not allowed; {allowed}")


def read_log(table: Table, mapping: Mapping, duplicates: str = "refuse") -> Log:
    """Return the `Log` of a table: all its mapped quantities, finite, at strictly increasing times.

    Rows marked as invalid and equal successive rows are dropped, and resets are removed; see `trajectory.estimates`.
    Other equal times are refused, spread within the last digit of the clock, or reduced to the first, by `duplicates`
    "refuse", "spread" or "first".
    """
    if duplicates not in DUPLICATES:
        raise ThermorenderError(f"duplicates={duplicates!r} is unknown; give one of {', '.join(DUPLICATES)}")
    if not mapping.quantities:
        _refuse_near_misses(table)
    notes = list(table.notes)
    resets = find_resets(table, mapping)
    table, resets = drop_invalid(table, mapping, resets, notes)
    time_name, time_s = _times(table, mapping)
    if (np.abs(time_s) > _LATEST_S).any():
        k = int(np.argmax(np.abs(time_s) > _LATEST_S))
        raise ThermorenderError(
            f"{table.where(k, time_name)}: {time_s[k]:.3g} s is not a time of a flight; give seconds, at most "
            f"{_LATEST_S:g} from 0"
        )
    early = time_s < _FIRST_FIX_S
    if mapping.stamps and early.any() and not early.all():
        kept = np.flatnonzero(~early)
        table, time_s, resets = table.kept(kept), time_s[kept], resets.kept(kept)
        notes.append(
            f"{table.path}: {early.sum()} {table.what}s are stamped before 1980, without a satellite's time, and are "
            "dropped"
        )
    index = _in_time_order(table, mapping, time_name, time_s, duplicates)
    if not mapping.sort_by_time and index.size > 1 and index[0] > index[-1]:
        notes.append(f"{table.path}: its time runs backwards throughout, so it is read from the end")
    table, time_s, resets = table.kept(index), time_s[index], resets.kept(index)
    if duplicates == "spread":
        time_s = _spread(time_s)
    values, columns = {}, {}
    for name, choices in (mapping.quantities or _own(mapping)).items():
        quantity = _present(choices, table)
        if quantity is None:
            _refuse_other_unit(choices, table, mapping)
        if quantity is not None and quantity.column is not None:
            values[name], columns[name] = table.numbers(quantity), quantity.column
    unseen = resets.open(time_s, table)
    changes = resets.undo(values, time_s, table)
    origin = _origin(table, mapping)
    return Log(
        table.path, table.row, time_s, values, columns, origin, table.what, resets.counters, unseen, notes, changes
    )


def _refuse_other_unit(choices: Sequence[Quantity], table: Table, mapping: Mapping) -> None:
    """Refuse a column that a mapping names with another unit in brackets, which would be ignored silently."""
    stems = {str(choice.column).partition("(")[0] for choice in choices if "(" in str(choice.column)}
    for column in table.header:
        if column.partition("(")[0] in stems and column not in [choice.column for choice in choices]:
            raise ThermorenderError(
                f"{table.path}: column {column!r} is not one that format={mapping.name!r} reads: "
                f"{', '.join(repr(choice.column) for choice in choices)}; rename it if its unit is that, or delete it"
            )


def _own(mapping: Mapping) -> dict[str, tuple[Quantity, ...]]:
    """Our own columns; readers of other files than CSV may also leave the reference of the height open."""
    names = QUANTITIES if mapping.reader == "csv" else (*QUANTITIES, UNSTATED)
    return {name: (Quantity(name),) for name in names}


def _present(choices: Sequence[Quantity], table: Table) -> Quantity | None:
    """The first of a mapping's choices whose column the table has; an optional one without any cell does not count."""
    names = table.header or tuple(table.columns)
    for choice in choices:
        if choice.column in names:
            if not choice.optional or any(table.text(choice.column)):
                return choice
    return None


def _origin(table: Table, mapping: Mapping) -> tuple[float, float] | None:
    """Latitude and longitude of the origin of local positions [deg]; None if the table does not know them."""
    names, origin = table.header or tuple(table.columns), mapping.origin
    if origin is None or not all(name in names for name in (origin.lat_deg, origin.lon_deg, origin.valid)):
        return None
    known = np.flatnonzero(table.numbers(Quantity(origin.valid)) != 0.0)
    if not known.size:
        return None
    first = table.kept(known[:1])
    latitude, longitude = (float(first.numbers(Quantity(name))[0]) for name in (origin.lat_deg, origin.lon_deg))
    return None if latitude == 0.0 == longitude else (latitude, longitude)


def _times(table: Table, mapping: Mapping) -> tuple[str, Floats]:
    """The column with the time and its values [s]."""
    if mapping.stamps:
        return _stamps(table, mapping)
    quantity = _present(mapping.time, table) or mapping.time[0]
    return str(quantity.column), table.numbers(quantity)


def _in_time_order(
    table: Table, mapping: Mapping, time_name: str, time_s: Floats, duplicates: str
) -> NDArray[np.int64]:
    """Indices of the rows that are kept, in order of time."""
    rows = table.rows()
    backwards = len(rows) > 2 and time_s[-1] < time_s[0] and bool((np.diff(time_s) <= 0.0).all())
    order = np.argsort(time_s, kind="stable") if mapping.sort_by_time or backwards else np.arange(len(rows))
    keep = [k for j, k in enumerate(order) if j == 0 or rows[k] != rows[order[j - 1]]]
    if duplicates == "first":
        keep = [k for j, k in enumerate(keep) if j == 0 or time_s[k] != time_s[keep[j - 1]]]
    step = np.diff(time_s[keep])
    wrong = step < 0.0 if duplicates == "spread" else step <= 0.0
    if wrong.any():
        k = int(np.argmax(wrong))
        written, what = table.text(time_name), table.what
        where = f"{table.where(keep[k + 1], time_name)}: {written[keep[k + 1]]!r} follows"
        if step[k] < 0.0:
            raise ThermorenderError(
                f"{where} {written[keep[k]]!r} in {what} {table.row[keep[k]]}: time is running backwards, and must "
                f"strictly increase; if only the order of the {what}s is wrong, give "
                f"{changed_mapping(mapping)} as format, with the first line sort_by_time = true"
            )
        raise ThermorenderError(
            f"{where} the same time in {what} {table.row[keep[k]]}, but time must strictly increase; give duplicates="
            "spread, which spreads them within the clock's last digit, or duplicates=first, which drops the others"
        )
    return np.array(keep)


def _spread(time_s: Floats) -> Floats:
    """Strictly increasing times (N,) [s]: equal times are spread evenly within the last digit of the clock."""
    scaled = (np.round(time_s * 10**digits) / 10**digits for digits in range(6))
    digits = next((k for k, rounded in enumerate(scaled) if np.allclose(rounded, time_s, rtol=0.0, atol=1e-6)), 6)
    _, first, count = np.unique(time_s, return_index=True, return_counts=True)
    rank = np.arange(time_s.size) - np.repeat(first, count)
    return time_s + 10.0**-digits * rank / np.repeat(count, count)


def _stamps(table: Table, mapping: Mapping) -> tuple[str, Floats]:
    """The first stamp column that is filled in every row, and its times in seconds since 1970."""
    names = table.header or tuple(table.columns)
    for stamp in mapping.stamps:
        column = stamp["column"]
        if column not in names:
            continue
        cells = table.text(column)
        if not all(cells):
            continue
        fractions = table.text(stamp["fraction"]) if "fraction" in stamp else [""] * len(cells)
        seconds = [
            _seconds(table.where(k, column), cell, stamp["pattern"], part)
            for k, (cell, part) in enumerate(zip(cells, fractions, strict=True))
        ]
        return column, np.array(seconds)
    raise ThermorenderError(
        f"{table.path}: no time: none of the columns {', '.join(stamp['column'] for stamp in mapping.stamps)} is "
        f"present and filled in every row{fitting_formats(names)}"
    )


def _seconds(where: str, text: str, pattern: str, fraction: str) -> float:
    try:
        if pattern == "iso":
            # Python 3.10 does not read Z, and only three or six decimals of the second.
            # A leap second, or 59.9996 s after rounding, is the second after 59.
            plain, late = re.subn(r"([T ]\d\d:\d\d):60", r"\1:59", _six_decimals(text))
            moment = datetime.fromisoformat(plain.replace("Z", "+00:00").replace("z", "+00:00"))
            moment += timedelta(seconds=late)
        else:
            moment = datetime.strptime(text, pattern)
        # Only digits are allowed; float would read exponents too.
        if not re.fullmatch("[0-9]*", fraction):
            raise ValueError
        part = float(f"0.{fraction}")
    except ValueError as error:
        shown = f"{text!r}" + (f" with the fraction {fraction!r}" if fraction else "")
        raise ThermorenderError(f"{where}: {shown} is not a time written as {pattern!r}") from error
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=timezone.utc)
    return moment.timestamp() + part


def _six_decimals(text: str) -> str:
    return re.sub(r"\.(\d+)", lambda match: f".{match[1][:6].ljust(6, '0')}", text)


def _refuse_near_misses(table: Table) -> None:
    """Refuse a misspelt column of ours, or one in another unit, that would be ignored silently."""
    header = table.header or tuple(table.columns)
    ours = [name for name in ("time_s", *QUANTITIES) if name not in header]
    for column in header:
        if column in QUANTITIES or column == "time_s":
            continue
        close = closest(column, ours, cutoff=0.85)
        stem, _, unit = column.rpartition("_")
        if unit in _OTHER_UNITS:
            close = close or [name for name in ours if name.rpartition("_")[0] == stem]
        if close:
            raise ThermorenderError(
                f"{table.path}: column {column!r} is not known; rename it to {close[0]!r} or delete it (names have "
                "units)"
            )
