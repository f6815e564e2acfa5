"""Flight logs as CSV: named columns of checked numbers on a strictly increasing time, whatever the log calls them.

A *mapping* (TOML, `trajectory_formats/`) says which of a foreign log's columns is which of ours and how its time is
written. Without one the file's own column names are ours. Rows are counted as a spreadsheet shows them: the header
is row 1.
"""

import csv
import difflib
import sys
from dataclasses import dataclass, field
from datetime import datetime, timezone
from importlib.resources import files
from pathlib import Path

import numpy as np

from thermorender.errors import ThermorenderError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

POSITION_LOCAL = ("east_m", "north_m")
POSITION_GEODETIC = ("lat_deg", "lon_deg")
HEIGHTS = ("up_m", "alt_ellipsoid_m", "alt_geoid_m", "above_ground_m", "above_takeoff_m")
QUATERNION = ("qw", "qx", "qy", "qz")
ANGLES = ("yaw_deg", "pitch_deg", "roll_deg")
GIMBAL = ("gimbal_yaw_deg", "gimbal_pitch_deg", "gimbal_roll_deg")
POSITION = POSITION_LOCAL + POSITION_GEODETIC + HEIGHTS
QUANTITIES = POSITION + QUATERNION + ANGLES + GIMBAL

_NAMED_AXES = {
    "FRD": np.eye(3),
    "FLU": np.diag([1.0, -1.0, -1.0]),
}


@dataclass(frozen=True)
class Quantity:
    """Where one of our quantities comes from: a column times `scale` plus `offset`, or a constant."""

    column: str | None = None
    scale: float = 1.0
    offset: float = 0.0
    constant: float | None = None


@dataclass(frozen=True)
class Mapping:
    """How a log's columns become ours.

    Parameters
    ----------
    name : str
        Name of the bundled format or path of the file.
    title : str
        One line for people.
    quantities : dict
        Our column name to `Quantity`; empty for our own format, where each name stands for itself.
    time : Quantity
        Numeric time [s after scaling]; its column is None where `stamps` are used.
    stamps : tuple of dict
        Date-time columns to try in turn: column, pattern ("iso" or strptime's), optional fraction column.
    sort_by_time : bool
        Put the rows in order of time before the check.
    quaternion_world : str
        Axes the quaternion rotates into, "NED" or "ENU".
    log_body_from_frd : (3, 3) array
        Columns: forward, right and down in the log's own body axes.
    quaternion_inverse : bool
        The log's quaternion rotates world to body.
    """

    name: str = "canonical"
    title: str = "thermorender's own columns"
    quantities: dict = field(default_factory=dict)
    time: Quantity = field(default_factory=lambda: Quantity("time_s"))
    stamps: tuple = ()
    sort_by_time: bool = False
    quaternion_world: str = "NED"
    log_body_from_frd: np.ndarray = field(default_factory=lambda: np.eye(3))
    quaternion_inverse: bool = False


@dataclass(frozen=True)
class Log:
    """One file's columns: `values` and, for messages, `columns` by our names, and each sample's spreadsheet row."""

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


def bundled_formats():
    """Return the names of the column mappings that come with the package, sorted."""
    folder = files("thermorender") / "trajectory_formats"
    return sorted(entry.name[: -len(".toml")] for entry in folder.iterdir() if entry.name.endswith(".toml"))


def load_mapping(name):
    """Return the `Mapping` of a bundled format's name or of a TOML file's path; None gives our own columns.

    Raises
    ------
    ThermorenderError
        No such format, or the file has an unknown key or a wrong value.
    """
    if name is None:
        return Mapping()
    if str(name) in bundled_formats():
        text = (files("thermorender") / "trajectory_formats" / f"{name}.toml").read_text(encoding="utf-8")
    elif Path(name).is_file():
        text = Path(name).read_text(encoding="utf-8")
    else:
        raise ThermorenderError(
            f"format={str(name)!r} is neither a bundled trajectory format ({', '.join(bundled_formats())}) nor the "
            f"path of a mapping file in TOML"
        )
    try:
        return _mapping_from(str(name), tomllib.loads(text))
    except tomllib.TOMLDecodeError as error:
        raise ThermorenderError(f"{name}: not a TOML file: {error}") from error


def _mapping_from(name, data):
    _known(name, "", data, ("title", "sort_by_time", "time", "columns", "quaternion"))
    time = data.get("time", {"column": "time_s"})
    _known(name, "time.", time, ("column", "scale", "offset", "stamps"))
    stamps = tuple(time.get("stamps", ()))
    if bool(stamps) == ("column" in time):
        raise ThermorenderError(f"{name}: [time] needs either column or [[time.stamps]]")
    for stamp in stamps:
        _known(name, "time.stamps.", stamp, ("column", "pattern", "fraction"))
        for key in ("column", "pattern"):
            if key not in stamp:
                raise ThermorenderError(f"{name}: [[time.stamps]] lacks {key}")
    columns = data.get("columns", {})
    _known(name, "columns.", columns, QUANTITIES)
    quaternion = data.get("quaternion", {})
    _known(name, "quaternion.", quaternion, ("world", "body", "inverse"))
    world = quaternion.get("world", "NED")
    if world not in ("NED", "ENU"):
        raise ThermorenderError(f"{name}: quaternion.world={world!r}; allowed are 'NED' and 'ENU'")
    return Mapping(
        name=name,
        title=data.get("title", name),
        quantities={ours: _quantity(name, f"columns.{ours}", value) for ours, value in columns.items()},
        time=Quantity() if stamps else _quantity(name, "time", time),
        stamps=stamps,
        sort_by_time=bool(data.get("sort_by_time", False)),
        quaternion_world=world,
        log_body_from_frd=_body_axes(name, quaternion.get("body", "FRD")),
        quaternion_inverse=bool(quaternion.get("inverse", False)),
    )


def _known(name, prefix, data, allowed):
    for key in data:
        if key not in allowed:
            raise ThermorenderError(f"{name}: unknown key {prefix}{key}; allowed are {', '.join(allowed)}")


def _quantity(name, key, value):
    if isinstance(value, str):
        return Quantity(column=value)
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return Quantity(constant=float(value))
    if (
        isinstance(value, dict)
        and set(value) <= {"column", "scale", "offset"}
        and isinstance(value.get("column"), str)
    ):
        factors = {k: value[k] for k in ("scale", "offset") if k in value}
        if all(isinstance(f, (int, float)) and not isinstance(f, bool) for f in factors.values()):
            return Quantity(column=value["column"], **{k: float(f) for k, f in factors.items()})
    raise ThermorenderError(
        f"{name}: {key}={value!r} is not understood; give a column's name, a number for all rows, or "
        f'{{ column = "…", scale = 1.0, offset = 0.0 }}'
    )


def _body_axes(name, axes):
    """Columns: forward, right, down in the log's body axes, from "FRD", "FLU" or signed axis letters."""
    if isinstance(axes, str) and axes in _NAMED_AXES:
        return _NAMED_AXES[axes]
    letters = {
        sign + letter: s * unit
        for letter, unit in zip("xyz", np.eye(3), strict=True)
        for sign, s in (("", 1.0), ("+", 1.0), ("-", -1.0))
    }
    if isinstance(axes, list) and len(axes) == 3 and all(axis in letters for axis in axes):
        matrix = np.stack([letters[axis] for axis in axes], axis=-1)
        if np.isclose(np.linalg.det(matrix), 1.0):
            return matrix
    raise ThermorenderError(
        f"{name}: quaternion.body={axes!r}; allowed are 'FRD', 'FLU' or three of x, y, z with signs that say where "
        f"forward, right and down lie, as a right-handed set"
    )


def read_log(path, mapping):
    """Return the `Log` of a CSV file: every mapped quantity it holds, finite, on strictly increasing time.

    Rows equal to the row before them in every cell are dropped: loggers write a record twice.

    Raises
    ------
    ThermorenderError
        The file is missing, empty or without rows; a cell is missing, not a number, NaN or infinite; time runs
        backwards or stands still.
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
            f"{path}, row {numbers[k + 1]}, column {time_name!r}: {time_s[k + 1]:.9g} s follows {time_s[k]:.9g} s in "
            f"row {numbers[k]}: time is running backwards or standing still, and must strictly increase"
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
        raise ThermorenderError(
            f"{path}: column {column!r} is missing; row 1 names {', '.join(header)}"
            + _fitting_formats(header)
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
            f"{path}, row {numbers[k]}, column {quantity.column!r}: {cells[k]!r} is not a finite number; fill the cell "
            f"or delete the row"
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
        + _fitting_formats(header)
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


def _fitting_formats(header):
    """A hint that names the bundled formats which know some of these columns, or nothing."""
    fitting = []
    for name in bundled_formats():
        mapping = load_mapping(name)
        times = {stamp["column"] for stamp in mapping.stamps} | {mapping.time.column}
        columns = {q.column for q in mapping.quantities.values() if q.column}
        if times & set(header) and columns & set(header):
            fitting.append(repr(name))
    return f"; the columns fit format={' or '.join(fitting)}" if fitting else ""


def _refuse_near_misses(path, header):
    """A misspelt column of ours would be skipped in silence, and the camera look elsewhere."""
    ours = [name for name in ("time_s", *QUANTITIES) if name not in header]
    for column in header:
        if column in QUANTITIES or column == "time_s":
            continue
        close = difflib.get_close_matches(column, ours, n=1, cutoff=0.85)
        if close:
            raise ThermorenderError(
                f"{path}: column {column!r} is not known; rename it {close[0]!r} if that is meant"
            )
