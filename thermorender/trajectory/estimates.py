"""What a state estimator reports about its own output: invalid rows and resets.

A row is dropped if a column of `valid` is 0, and reported if one of `doubtful` is not 0; a log without valid rows is
refused. The change of a reset of position is subtracted from the rows after it, so positions continue from the start.
Attitudes before a reset are turned by its change, because the later one is the corrected one.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError
from thermorender.trajectory.column_mapping import POSITION_GEODETIC, QUATERNION, Mapping, Quantity, Reset
from thermorender.trajectory.rotations import rotation_from_wxyz, wxyz
from thermorender.trajectory.tables import Floats, Table

# Latitudes and longitudes that are 0 [deg]: 0.1 m.
_ZERO_DEG = 1e-6
# Counters are unsigned bytes.
_WRAP = 256


@dataclass(frozen=True, eq=False)
class _Counted:
    """One reset counter of a table: at each row the number of resets since the row before, and their recorded change.

    `change` is (N, width), in the log's unit; `known` is False where a change is not recorded.
    """

    reset: Reset
    count: NDArray[np.int64]
    change: Floats
    known: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Resets:
    """The estimator's resets of a table's rows."""

    counted: tuple[_Counted, ...] = ()
    counters: tuple[str, ...] = ()

    def kept(self, index: NDArray[np.int64]) -> "Resets":
        """Return the resets of some rows in that order; those of the rows between are added to the next one kept."""
        counted, ascending = [], np.sort(index)
        place = np.argsort(index)
        for each in self.counted:
            count, known = np.zeros(index.size, np.int64), np.ones(index.size, bool)
            change = np.zeros((index.size, each.change.shape[1]))
            if each.reset.turn:
                change[:, 0] = 1.0
            rows = np.flatnonzero(each.count)
            later = np.searchsorted(ascending, rows)
            # Nothing is kept before the first row that is kept, and nothing after the last one.
            for row, k in zip(rows, later, strict=True):
                if not 0 < k < index.size:
                    continue
                j = place[k]
                count[j], known[j] = count[j] + each.count[row], known[j] & each.known[row]
                if each.reset.turn and each.known[row]:
                    change[j] = wxyz(rotation_from_wxyz(each.change[row]) * rotation_from_wxyz(change[j]))
                elif not each.reset.turn:
                    change[j] += each.change[row]
            counted.append(_Counted(each.reset, count, change, known))
        return Resets(tuple(counted), self.counters)

    def open(self, time_s: Floats, table: Table) -> dict[str, str]:
        """Return where a counter changes whose effect is in another file: the counter there, to a phrase."""
        return {
            each.reset.unless: f"column {each.reset.counter!r} counts a reset of the estimator at "
            f"{time_s[np.argmax(each.count)]:.3f} s ({table.what} {table.row[np.argmax(each.count)]})"
            for each in self.counted
            if each.reset.unless and each.count.any()
        }

    def undo(self, values: dict[str, Floats], time_s: Floats, table: Table) -> list[tuple[str, float, str]]:
        """Remove the resets from `values` in place; return a note (text, time [s], text) per counter that changes."""
        notes = []
        for each in self.counted:
            rows = np.flatnonzero(each.count)
            names = QUATERNION if each.reset.turn else tuple(each.reset.shift)
            if each.reset.unless or not rows.size or not all(name in values for name in names):
                continue
            note = _turn_back if each.reset.turn else _shift_back
            effect = note(each, rows, values)
            times = "once" if rows.size == 1 else f"{rows.size} times, first"
            unknown = int((~each.known[rows]).sum())
            rest = (
                f"; {unknown} of these changes are not recorded and are taken from the rows before and after"
                if unknown
                else ""
            )
            before = f"{table.path}: the estimator was reset {times} at "
            where = f" s ({table.what} {table.row[rows[0]]}, column {each.reset.counter!r}): {effect}{rest}"
            notes.append((before, float(time_s[rows[0]]), where))
        return notes


def _is_unit(quaternion: Floats) -> NDArray[np.bool_]:
    """Whether quaternions (N, 4) are rotations, up to a log's digits."""
    with np.errstate(over="ignore"):
        return np.abs(np.linalg.norm(quaternion, axis=1) - 1.0) < 0.1


def _shift_back(each: _Counted, rows: NDArray[np.int64], values: dict[str, Floats]) -> str:
    parts = []
    for k, name in enumerate(each.reset.shift):
        shift = np.zeros(values[name].size)
        shift[rows] = np.where(each.known[rows], each.change[rows, k], np.diff(values[name])[rows - 1])
        values[name] = values[name] - np.cumsum(shift)
        if shift.any():
            parts.append(f"{name} by up to {np.abs(shift).max():.3g} m")
    what = ", ".join(parts) or "nothing"
    return f"it changed {what}, which is subtracted from the rows after it so that the path is continuous"


def _turn_back(each: _Counted, rows: NDArray[np.int64], values: dict[str, Floats]) -> str:
    quaternion = np.stack([values[name] for name in QUATERNION], axis=-1)
    largest = 0.0
    if not _is_unit(quaternion).all():
        return "but not every attitude is a rotation"  # which is refused later, with its row
    for row in rows[::-1]:
        if each.known[row]:
            change = rotation_from_wxyz(each.change[row])
        else:
            change = rotation_from_wxyz(quaternion[row]) * rotation_from_wxyz(quaternion[row - 1]).inv()
        largest = max(largest, float(np.degrees(change.magnitude())))
        # The length stays as logged: it is checked later.
        length = np.linalg.norm(quaternion[:row], axis=1, keepdims=True)
        quaternion[:row] = wxyz(change * rotation_from_wxyz(quaternion[:row])) * length
    for k, name in enumerate(QUATERNION):
        values[name] = quaternion[:, k]
    return f"it turned the attitude by up to {largest:.3g} deg, and the rows before it are turned likewise"


def find_resets(table: Table, mapping: Mapping) -> Resets:
    """Return the resets of all rows of a table, as the mapping's counters count them."""
    names = table.header or tuple(table.columns)
    counted = []
    present = tuple(reset for reset in mapping.resets if reset.counter in names)
    for reset in present:
        counter = table.numbers(Quantity(reset.counter))
        odd = (np.abs(counter) > 2**31) | (counter != np.round(counter))
        if odd.any():
            where = table.where(int(np.argmax(odd)), reset.counter)
            raise ThermorenderError(f"{where}: {counter[odd][0]:g} does not count resets; give whole numbers")
        step = np.concatenate([[0.0], np.diff(counter)]).astype(np.int64)
        count = np.where(step < 0, step % _WRAP, step)
        recorded = tuple(reset.shift.values()) or reset.turn
        change = np.zeros((len(table), max(len(recorded), 1)))
        # A counter that advances by several between two rows leaves only the last change in the log.
        known = (count <= 1) & all(column in names for column in recorded)
        rows = np.flatnonzero((count > 0) & known)
        if rows.size and recorded:
            some = table.kept(rows)
            for k, column in enumerate(recorded):
                name = next((name for name, delta in reset.shift.items() if delta == column), None)
                scale = mapping.quantities[name][0].scale if name in mapping.quantities else 1.0
                change[rows, k] = some.numbers(Quantity(column, scale))
            if reset.turn:
                known[rows] &= _is_unit(change[rows])
        counted.append(_Counted(reset, count, change, known))
    return Resets(tuple(counted), tuple(reset.counter for reset in present))


def _without_fix(table: Table, mapping: Mapping) -> NDArray[np.bool_]:
    """Whether each row (N,) has latitude and longitude 0, as receivers write before their first fix."""
    names = table.header or tuple(table.columns)
    zero = np.ones(len(table), bool)
    for name in POSITION_GEODETIC:
        choices = mapping.quantities.get(name, (Quantity(name),))
        column = next((choice.column for choice in choices if choice.column in names), None)
        if column is None:
            return np.zeros(len(table), bool)
        zero &= np.array([_is_zero(cell) for cell in table.cells(column)], bool)
    return zero


def _is_zero(cell: object) -> bool:
    try:
        return abs(float(cell)) < _ZERO_DEG  # type: ignore[arg-type]  # text or a number
    except ValueError:
        return False


def drop_invalid(table: Table, mapping: Mapping, resets: Resets, notes: list[str]) -> tuple[Table, Resets]:
    """Return the valid rows of a table and their resets; append what was dropped to `notes`."""
    names = table.header or tuple(table.columns)
    valid, reasons = np.ones(len(table), bool), []
    for column in (column for column in mapping.valid if column in names):
        zero = table.numbers(Quantity(column)) == 0.0
        if zero.all():
            raise ThermorenderError(
                f"{table.path}: column {column!r} is 0 in all {len(table)} {table.what}s: the log itself says that "
                "they are not valid; give a log with a valid estimate (in CSV the column may be deleted to fly it "
                "nevertheless)"
            )
        if zero.any():
            reasons.append(f"{column} is 0 in {int(zero.sum())}")
        valid &= ~zero
    lost = _without_fix(table, mapping) & valid
    if lost.any() and (valid & ~lost).any():
        reasons.append(f"latitude and longitude are 0 in {int(lost.sum())}")
        valid &= ~lost
    for column in (column for column in mapping.doubtful if column in names):
        doubtful = int((table.numbers(Quantity(column))[valid] != 0.0).sum())
        if doubtful:
            notes.append(
                f"{table.path}: {column} is set in {doubtful} of {int(valid.sum())} {table.what}s "
                f"({doubtful / valid.sum():.1%}), where the position may drift"
            )
    if valid.all():
        return table, resets
    if not valid.any():
        raise ThermorenderError(
            f"{table.path}: no {table.what} is valid ({', '.join(reasons)} of {len(table)} {table.what}s); give a log "
            "with a valid estimate"
        )
    index = np.flatnonzero(valid)
    dropped = len(table) - index.size
    note = f"{table.path}: {dropped} of {len(table)} {table.what}s ({dropped / len(table):.1%}) are dropped as invalid"
    inside = np.diff(index)
    if (inside > 1).any():
        k = int(np.argmax(inside))
        note += (
            f"; the path is straight across the {int((inside > 1).sum())} gaps, the longest between {table.what}s "
            f"{table.row[index[k]]} and {table.row[index[k + 1]]}"
        )
    notes.append(f"{note} ({', '.join(reasons)})")
    return table.kept(index), resets.kept(index)
