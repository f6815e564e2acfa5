"""Flight logs as CSV: named columns of checked numbers on a strictly increasing time.

Rows are counted in messages as a spreadsheet shows them: the header is row 1.
"""

import csv
from dataclasses import dataclass
from datetime import datetime, timezone

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.schema import closest
from thermorender.trajectory.mapping import QUANTITIES, Quantity, fitting_formats

# Endings of columns that hold one of our quantities in another unit.
_OTHER_UNITS = ("rad", "mm", "cm", "km", "ft", "feet", "ms", "us", "ns", "m", "deg", "s")


@dataclass(frozen=True, eq=False)
class Log:
    """One file's `values` by our names; for messages its own `columns` and each sample's spreadsheet row."""

    path: str
    row: np.ndarray
    time_s: np.ndarray
    values: dict
    columns: dict

    def where(self, name, index):
        """Return "file, row R, column C" of one of our quantities, for messages."""
        column = self.columns.get(name, name)
        alias = "" if column == name else f" ({name})"
        return f"{self.path}, row {self.row[index]}, column {column!r}{alias}"

    def refuse(self, name, bad, allowed):
        """Raise for the first sample where `bad`, saying what arrived and what is allowed."""
        if bad.any():
            k = int(np.argmax(bad))
            raise ThermorenderError(
                f"{self.where(name, k)}: {self.values[name][k]:.9g} is not allowed; {allowed}"
            )


def read_log(path, mapping):
    """Return the `Log` of a CSV file: every mapped quantity it holds, finite, on strictly increasing time.

    Rows equal to the row before them in every cell are dropped: loggers write a record twice.

    Raises
    ------
    ThermorenderError
        The file is missing, empty or without rows; a cell is missing, not a number, NaN or infinite; time
        runs backwards or stands still.
    """
    header, rows, numbers = _read_cells(path)
    quantities = mapping.quantities or {name: Quantity(name) for name in QUANTITIES}
    if not mapping.quantities:
        _refuse_near_misses(path, header)
    time_name = mapping.time.column or mapping.stamps[0]["column"]
    time_s = (
        _stamps(path, header, rows, numbers, mapping)
        if mapping.stamps
        else _numeric(path, header, rows, numbers, mapping.time)
    )
    order = np.argsort(time_s, kind="stable") if mapping.sort_by_time else np.arange(len(rows))
    keep = [k for j, k in enumerate(order) if j == 0 or rows[k] != rows[order[j - 1]]]
    rows, numbers, time_s = [rows[k] for k in keep], np.array([numbers[k] for k in keep]), time_s[keep]
    step = np.diff(time_s)
    if (step <= 0.0).any():
        k = int(np.argmax(step <= 0.0))
        raise ThermorenderError(
            f"{path}, row {numbers[k + 1]}, column {time_name!r}: {time_s[k + 1]:.9g} s follows "
            f"{time_s[k]:.9g} s in row {numbers[k]}: time is running backwards or standing still, and must "
            "strictly increase"
        )
    values, columns = {}, {}
    for name, quantity in quantities.items():
        if quantity.column is not None and quantity.column in header:
            values[name], columns[name] = _numeric(path, header, rows, numbers, quantity), quantity.column
    return Log(str(path), numbers, time_s, values, columns)


def _read_cells(path):
    """Header, rows of text and their spreadsheet row numbers; rows without any text are skipped."""
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            lines = list(csv.reader(file))
    except OSError as error:
        raise ThermorenderError(
            f"{path}: cannot be read ({error.strerror}); give the path of a CSV file"
        ) from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise ThermorenderError(f"{path}: is not a CSV file in UTF-8: {error}") from error
    if not lines or not any(cell.strip() for cell in lines[0]):
        raise ThermorenderError(
            f"{path}: the file is empty; row 1 must name the columns, one sample per row follows"
        )
    header = [cell.strip() for cell in lines[0]]
    rows, numbers = [], []
    for number, cells in enumerate(lines[1:], start=2):
        if not any(cell.strip() for cell in cells):
            continue
        if len(cells) != len(header):
            raise ThermorenderError(
                f"{path}, row {number}: {len(cells)} cells where row 1 names {len(header)} columns"
            )
        rows.append(cells)
        numbers.append(number)
    if not rows:
        raise ThermorenderError(f"{path}: has no rows below the header; at least one sample is needed")
    return header, rows, numbers


def _cells(path, header, rows, column):
    if column not in header:
        shown = ", ".join(header[:8]) + (f" … ({len(header)} in all)" if len(header) > 8 else "")
        raise ThermorenderError(
            f"{path}: column {column!r} is missing; row 1 names {shown}" + fitting_formats(header)
        )
    if header.count(column) > 1:
        raise ThermorenderError(
            f"{path}: row 1 names column {column!r} {header.count(column)} times; once is allowed"
        )
    k = header.index(column)
    return [row[k] for row in rows]


def _numeric(path, header, rows, numbers, quantity):
    cells = _cells(path, header, rows, quantity.column)
    try:
        values = np.array(cells).astype(np.float64)
        bad = ~np.isfinite(values)
    except ValueError:
        bad = np.array([not _is_finite_number(cell) for cell in cells])
    if bad.any():
        k = int(np.argmax(bad))
        raise ThermorenderError(
            f"{path}, row {numbers[k]}, column {quantity.column!r}: {cells[k]!r} is not a finite number; "
            "fill the cell or delete the row"
        )
    return values * quantity.scale + quantity.offset


def _is_finite_number(cell):
    try:
        return bool(np.isfinite(float(cell)))
    except ValueError:
        return False


def _stamps(path, header, rows, numbers, mapping):
    """Seconds since 1970 of the first stamp column that is filled in every row."""
    names = [stamp["column"] for stamp in mapping.stamps]
    for stamp in mapping.stamps:
        if stamp["column"] not in header:
            continue
        cells = _cells(path, header, rows, stamp["column"])
        if not all(cell.strip() for cell in cells):
            continue
        fractions = _cells(path, header, rows, stamp["fraction"]) if "fraction" in stamp else [""] * len(rows)
        return np.array(
            [
                _seconds(
                    f"{path}, row {number}, column {stamp['column']!r}",
                    cell.strip(),
                    stamp["pattern"],
                    part.strip(),
                )
                for number, cell, part in zip(numbers, cells, fractions, strict=True)
            ]
        )
    raise ThermorenderError(
        f"{path}: no time: of the columns {', '.join(names)} none is there and filled in every row"
        + fitting_formats(header)
    )


def _seconds(where, text, pattern, fraction):
    try:
        if pattern == "iso":
            # Python 3.10 reads no zone letter and only three or six decimals of the second.
            moment = datetime.fromisoformat(text.replace("Z", "+00:00").replace("z", "+00:00"))
        else:
            moment = datetime.strptime(text, pattern)
        part = float(f"0.{fraction}") if fraction else 0.0
    except ValueError as error:
        shown = f"{text!r}" + (f" with the fraction {fraction!r}" if fraction else "")
        raise ThermorenderError(f"{where}: {shown} is not a time written as {pattern!r}") from error
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=timezone.utc)
    return moment.timestamp() + part


def _refuse_near_misses(path, header):
    """Refuse a misspelt column of ours, or one in other units, that would be skipped in silence."""
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
                f"{path}: column {column!r} is not known; write it as {close[0]!r} (units are in the names) "
                "or take it out"
            )
