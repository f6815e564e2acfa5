"""Tables of flight logs: the columns of a file before a mapping gives them their meaning.

Row numbers are a spreadsheet's for CSV (the header is row 1), else they count samples from 1.
"""

import csv
from collections.abc import Sequence
from dataclasses import dataclass, field
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError, shortened
from thermorender.formats import csv_rows, read_text
from thermorender.trajectory.column_mapping import Quantity, fitting_formats

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Table:
    """Columns of one file, or of one message of a binary log."""

    path: str  # The file and, for a binary log, the message
    columns: dict[str, Sequence[Any] | Floats]  # Name to cells: text from CSV, numbers from other files
    row: NDArray[np.int64]  # (N,) int number of each row in messages
    what: str = "row"  # What a row is called in messages
    header: tuple[str, ...] = ()  # Row 1 of a CSV file with repeated names; else the names of the columns
    notes: tuple[str, ...] = field(default=())  # Sentences for the user, from the reader of the file

    def __len__(self) -> int:
        return self.row.size

    def rows(self) -> list[tuple[Any, ...]]:
        """Return all cells by row."""
        return list(zip(*self.columns.values(), strict=True))

    def kept(self, index: NDArray[np.int64]) -> "Table":
        """Return the table of some rows, in that order."""
        columns: dict[str, Sequence[Any] | Floats] = {
            name: cells[index] if isinstance(cells, np.ndarray) else [cells[k] for k in index]
            for name, cells in self.columns.items()
        }
        return Table(self.path, columns, self.row[index], self.what, self.header, self.notes)

    def where(self, index: int, column: str) -> str:
        """Return "file, row R, column C", for messages."""
        return f"{self.path}, {self.what} {self.row[index]}, column {column!r}"

    def cells(self, column: str | None) -> Sequence[Any] | Floats:
        """Return a column's cells; raise if the file does not name it exactly once."""
        names = self.header or tuple(self.columns)
        if column not in names:
            shown = ", ".join(names[:8]) + (f" … ({len(names)} in all)" if len(names) > 8 else "")
            raise ThermorenderError(
                f"{self.path}: column {column!r} is missing; row 1 names {shown}{fitting_formats(names)}"
            )
        if names.count(column) > 1:
            raise ThermorenderError(
                f"{self.path}: row 1 names column {column!r} {names.count(column)} times; once is allowed"
            )
        return self.columns[column]

    def text(self, column: str) -> list[str]:
        """Return a column's cells as text without blanks around it."""
        cells = self.cells(column)
        return [f"{cell:.9g}" for cell in cells] if isinstance(cells, np.ndarray) else [cell.strip() for cell in cells]

    def numbers(self, quantity: Quantity) -> Floats:
        """Return a column's finite numbers, (N,), scaled and shifted to our unit."""
        cells = self.cells(quantity.column)
        try:
            values = np.asarray(cells).astype(np.float64)
            bad = ~np.isfinite(values)
        except ValueError:
            bad = np.array([not _is_finite_number(cell) for cell in cells])
        if bad.any():
            k = int(np.argmax(bad))
            cell = cells[k] if isinstance(cells[k], str) else f"{cells[k]:g}"
            fix = "write it with a point as decimal mark" if "," in cell else "fill the cell or delete the row"
            raise ThermorenderError(
                f"{self.where(k, str(quantity.column))}: {shortened(repr(cell))} is not a finite number; {fix}"
            )
        return values * quantity.scale + quantity.offset


def _is_finite_number(cell: str) -> bool:
    try:
        return bool(np.isfinite(float(cell)))
    except ValueError:
        return False


def rows_of(path: str | PathLike[str]) -> tuple[list[str], list[tuple[str, dict[str, str]]]]:
    """Return (column names, [(file and row for messages, {column: text}), …]) of a CSV file."""
    (table,) = read_csv(path)
    head = list(table.header)
    cells = zip(*(table.text(name) for name in head), strict=True)
    return head, [
        (f"{path}, row {number}", dict(zip(head, row, strict=True)))
        for number, row in zip(table.row, cells, strict=True)
    ]


def read_csv(path: str | PathLike[str]) -> list[Table]:
    """Return the `Table` of a CSV file, in a list; blank rows are skipped."""
    try:
        lines = csv_rows(read_text(path, "CSV UTF-8"), strict=False)
    except csv.Error as error:
        raise ThermorenderError(f"{path} is not CSV ({error}); save it as CSV UTF-8") from None
    if not lines or not any(lines[0]):
        what = "row 1 is blank" if any(map(any, lines)) else "the file is empty"
        raise ThermorenderError(f"{path}: {what}; row 1 must name the columns, one sample per row follows")
    # Lines of one cell above the names, such as the title of an export, are not read.
    top = next((k for k, cells in enumerate(lines) if sum(map(bool, cells)) > 1), 0)
    header = tuple(lines[top])
    rows, numbers = [], []
    for number, cells in enumerate(lines[top + 1 :], start=top + 2):
        if not any(cells):
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
    columns: dict[str, Sequence[Any] | Floats] = dict(zip(header, map(list, zip(*rows, strict=True)), strict=True))
    return [Table(str(path), columns, np.array(numbers), header=header)]
