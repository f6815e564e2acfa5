"""Flight logs in CSV: named columns of checked numbers at strictly increasing times.

Row numbers in messages are a spreadsheet's: the header is row 1.
"""

import csv
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError, shortened
from thermorender.formats import read_text
from thermorender.schema import closest
from thermorender.trajectory.mapping import QUANTITIES, Mapping, Quantity, fitting_formats

Floats = NDArray[np.float64]

# Endings of columns with one of our quantities in another unit.
_OTHER_UNITS = ("rad", "mm", "cm", "km", "ft", "feet", "ms", "us", "ns", "m", "deg", "s")
# Separators of other programs.
_MARKS = {";": "semicolons", "\t": "tabs", "|": "bars"}
# Treatments of different rows with equal times.
DUPLICATES = ("refuse", "spread", "first")


@dataclass(frozen=True, eq=False)
class Log:
    """One file: `values` by our names and, for messages, the file's `columns` and each sample's spreadsheet row."""

    path: str
    row: NDArray[np.int64]
    time_s: Floats
    values: dict[str, Floats]
    columns: dict[str, str]

    def where(self, name: str, index: int) -> str:
        """Return "file, row R, column C" of one of our quantities, for messages."""
        column = self.columns.get(name, name)
        alias = "" if column == name else f" ({name})"
        return f"{self.path}, row {self.row[index]}, column {column!r}{alias}"

    def refuse(self, name: str, bad: NDArray[np.bool_], allowed: str) -> None:
        """Raise for the first bad sample, if any; the message says what arrived and what is allowed."""
        if bad.any():
            k = int(np.argmax(bad))
            raise ThermorenderError(f"{self.where(name, k)}: {self.values[name][k]:.9g} is not allowed; {allowed}")


def read_log(path: str | PathLike[str], mapping: Mapping, duplicates: str = "refuse") -> Log:
    """Return the `Log` of a CSV file: all its mapped quantities, finite, at strictly increasing times.

    A row equal to the row before it is dropped, because some loggers write a record twice.

    Parameters
    ----------
    path : path
    mapping : Mapping
    duplicates : {"refuse", "spread", "first"}
        Treatment of different rows with equal times: refuse them, spread them evenly within the last digit of the
        log's clock, or keep only the first.

    Raises
    ------
    ThermorenderError
        The file is missing, empty or without rows; a cell is missing, not a number, NaN or infinite; time
        runs backwards, or stands still and `duplicates` is "refuse".
    """
    if duplicates not in DUPLICATES:
        raise ThermorenderError(f"duplicates={duplicates!r} is unknown; give one of {', '.join(DUPLICATES)}")
    header, rows, numbers = _read_cells(path)
    quantities = mapping.quantities or {name: Quantity(name) for name in QUANTITIES}
    if not mapping.quantities:
        _refuse_near_misses(path, header)
    time_name: str | None
    if mapping.stamps:
        time_name, written, time_s = _stamps(path, header, rows, numbers, mapping)
    else:
        time_name, time_s = mapping.time.column, _numeric(path, header, rows, numbers, mapping.time)
        written = _cells(path, header, rows, time_name)
    order = np.argsort(time_s, kind="stable") if mapping.sort_by_time else np.arange(len(rows))
    keep = [k for j, k in enumerate(order) if j == 0 or rows[k] != rows[order[j - 1]]]
    if duplicates == "first":
        keep = [k for j, k in enumerate(keep) if j == 0 or time_s[k] != time_s[keep[j - 1]]]
    rows, row_of, time_s = [rows[k] for k in keep], np.array([numbers[k] for k in keep]), time_s[keep]
    step = np.diff(time_s)
    wrong = step < 0.0 if duplicates == "spread" else step <= 0.0
    if wrong.any():
        k = int(np.argmax(wrong))
        where = f"{path}, row {row_of[k + 1]}, column {time_name!r}: {written[keep[k + 1]].strip()!r} follows"
        if step[k] < 0.0:
            raise ThermorenderError(
                f"{where} {written[keep[k]].strip()!r} in row {row_of[k]}: time is running backwards, and must "
                "strictly increase"
            )
        raise ThermorenderError(
            f"{where} the same time in row {row_of[k]}, but time must strictly increase; give --duplicates spread, "
            "which spreads them within the clock's last digit, or --duplicates first, which drops the others"
        )
    if duplicates == "spread":
        time_s = _spread(time_s)
    values, columns = {}, {}
    for name, quantity in quantities.items():
        if quantity.column is not None and quantity.column in header:
            values[name], columns[name] = _numeric(path, header, rows, row_of, quantity), quantity.column
    return Log(str(path), row_of, time_s, values, columns)


def _read_cells(path: str | PathLike[str]) -> tuple[list[str], list[list[str]], list[int]]:
    """Header, rows of text and their spreadsheet row numbers; blank rows are skipped."""
    try:
        lines = list(csv.reader(io.StringIO(read_text(path, "CSV UTF-8"))))
    except csv.Error as error:
        raise ThermorenderError(f"{path} is not CSV ({error}); save it as CSV UTF-8") from None
    if not lines or not any(cell.strip() for cell in lines[0]):
        what = "row 1 is blank" if any(map(any, lines)) else "the file is empty"
        raise ThermorenderError(f"{path}: {what}; row 1 must name the columns, one sample per row follows")
    header = [cell.strip() for cell in lines[0]]
    mark = next((name for mark, name in _MARKS.items() if mark in header[0]), None)
    if mark and len(header) == 1:
        raise ThermorenderError(f"{path} is separated by {mark}; save it comma-separated with a point as decimal mark")
    rows, numbers = [], []
    for number, cells in enumerate(lines[1:], start=2):
        if not any(cell.strip() for cell in cells):
            continue
        if len(cells) != len(header):
            raise ThermorenderError(
                f"{path}, row {number}: {len(cells)} cells where row 1 names {len(header)} columns; give each column "
                "one cell, with a point as decimal mark"
            )
        rows.append(cells)
        numbers.append(number)
    if not rows:
        raise ThermorenderError(f"{path} has no rows below the header; at least one sample is needed")
    return header, rows, numbers


def _cells(path: object, header: list[str], rows: list[list[str]], column: str | None) -> list[str]:
    if column not in header:
        shown = ", ".join(header[:8]) + (f" … ({len(header)} in all)" if len(header) > 8 else "")
        raise ThermorenderError(f"{path}: column {column!r} is missing; row 1 names {shown}" + fitting_formats(header))
    if header.count(column) > 1:
        raise ThermorenderError(f"{path}: row 1 names column {column!r} {header.count(column)} times; once is allowed")
    k = header.index(column)
    return [row[k] for row in rows]


def _numeric(
    path: object, header: list[str], rows: list[list[str]], numbers: Sequence[int] | NDArray[np.int64],
    quantity: Quantity,
) -> Floats:  # fmt: skip
    cells = _cells(path, header, rows, quantity.column)
    try:
        values = np.array(cells).astype(np.float64)
        bad = ~np.isfinite(values)
    except ValueError:
        bad = np.array([not _is_finite_number(cell) for cell in cells])
    if bad.any():
        k = int(np.argmax(bad))
        fix = "write it with a point as decimal mark" if "," in cells[k] else "fill the cell or delete the row"
        raise ThermorenderError(
            f"{path}, row {numbers[k]}, column {quantity.column!r}: {shortened(repr(cells[k]))} is not a finite "
            f"number; {fix}"
        )
    return values * quantity.scale + quantity.offset


def _is_finite_number(cell: str) -> bool:
    try:
        return bool(np.isfinite(float(cell)))
    except ValueError:
        return False


def _spread(time_s: Floats) -> Floats:
    """Strictly increasing times (N,) [s]: equal times are spread evenly within the last digit of the clock."""
    scaled = (np.round(time_s * 10**digits) / 10**digits for digits in range(6))
    digits = next((k for k, rounded in enumerate(scaled) if np.allclose(rounded, time_s, rtol=0.0, atol=1e-6)), 6)
    _, first, count = np.unique(time_s, return_index=True, return_counts=True)
    rank = np.arange(time_s.size) - np.repeat(first, count)
    return time_s + 10.0**-digits * rank / np.repeat(count, count)


def _stamps(
    path: object, header: list[str], rows: list[list[str]], numbers: list[int], mapping: Mapping
) -> tuple[str, list[str], Floats]:
    """The first stamp column that is filled in every row, its times as text and in seconds since 1970."""
    names = [stamp["column"] for stamp in mapping.stamps]
    for stamp in mapping.stamps:
        if stamp["column"] not in header:
            continue
        cells = _cells(path, header, rows, stamp["column"])
        if not all(cell.strip() for cell in cells):
            continue
        fractions = _cells(path, header, rows, stamp["fraction"]) if "fraction" in stamp else [""] * len(rows)
        seconds = [
            _seconds(f"{path}, row {number}, column {stamp['column']!r}", cell.strip(), stamp["pattern"], part.strip())
            for number, cell, part in zip(numbers, cells, fractions, strict=True)
        ]
        written = [f"{cell.strip()}.{part.strip()}".rstrip(".") for cell, part in zip(cells, fractions, strict=True)]
        return stamp["column"], written, np.array(seconds)
    raise ThermorenderError(
        f"{path}: no time: none of the columns {', '.join(names)} is present and filled in every row"
        + fitting_formats(header)
    )


def _seconds(where: str, text: str, pattern: str, fraction: str) -> float:
    try:
        if pattern == "iso":
            # Python 3.10 does not read Z, and only three or six decimals of the second.
            moment = datetime.fromisoformat(text.replace("Z", "+00:00").replace("z", "+00:00"))
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


def _refuse_near_misses(path: object, header: list[str]) -> None:
    """Refuse a misspelt column of ours, or one in another unit, that would be ignored silently."""
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
                f"{path}: column {column!r} is not known; rename it to {close[0]!r} or delete it (names have units)"
            )
