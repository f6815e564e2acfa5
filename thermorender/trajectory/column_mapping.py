"""Column names of thermorender's flight logs, and mappings of other programs' columns to them (TOML, `formats/`).

A mapping names the log's column for each of ours, the notation of time, and the axes of the quaternion.
"""

import os
from collections.abc import Iterable
from dataclasses import dataclass, field, make_dataclass
from importlib.resources import files
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError
from thermorender.schema import (
    FrozenDict,
    Where,
    choice,
    flag,
    key,
    mapping,
    number,
    read,
    read_toml,
    table,
    tables,
    text,
    texts,
)

POSITION_LOCAL = ("east_m", "north_m")
POSITION_GEODETIC = ("lat_deg", "lon_deg")
HEIGHTS = ("up_m", "alt_ellipsoid_m", "alt_geoid_m", "above_ground_m", "above_takeoff_m")
QUATERNION = ("qw", "qx", "qy", "qz")
ANGLES = ("yaw_deg", "pitch_deg", "roll_deg")
GIMBAL = ("gimbal_yaw_deg", "gimbal_pitch_deg", "gimbal_roll_deg")
# A height whose reference the log does not state; internal to readers, since only its changes mean something.
UNSTATED = "height_m"
POSITION = POSITION_LOCAL + POSITION_GEODETIC + HEIGHTS
QUANTITIES = POSITION + QUATERNION + ANGLES + GIMBAL
READERS = ("csv", "dataflash", "gpx", "kml", "poses", "rosbag", "srt", "ulog")

_NAMED_AXES = {
    "FRD": np.eye(3),
    "FLU": np.diag([1.0, -1.0, -1.0]),
}


@dataclass(frozen=True)
class Quantity:
    """The source of one of our quantities: a column times `scale` plus `offset`, or a constant."""

    column: str | None = key(text, None)
    scale: float = key(number(), 1.0)
    offset: float = key(number(), 0.0)
    optional: bool = key(flag, False)  # A log without the column is read all the same
    constant: float | None = None


@dataclass(frozen=True)
class Reset:
    """The columns of an estimator's resets: a counter, and what the last reset changed.

    Without `shift` and `turn`, a change of the counter is refused unless a file has the counter `unless`.
    """

    counter: str = key(text)
    # Column of the change for each of our quantities, in the unit of that quantity's own column
    shift: dict[str, str] = key(mapping(text), FrozenDict())
    # Columns w, x, y, z of the rotation that the attitude was multiplied by from the left
    turn: tuple[str, ...] = key(texts, ())
    unless: str | None = key(text, None)

    def check(self, where: Where, given: dict[str, Any]) -> None:
        """Raise if the keys contradict each other."""
        where.exactly_one([name for name in given if getattr(self, name)], ("shift", "turn", "unless"))
        for name in self.shift:
            if name not in QUANTITIES:
                where.of("shift").refuse(name, f"names of {', '.join(QUANTITIES)}")
        if self.turn and len(self.turn) != 4:
            where.of("turn").refuse(list(self.turn), "four columns: w, x, y, z")


@dataclass(frozen=True)
class Origin:
    """The columns with latitude and longitude of a log's local origin, and the flag that says that they are known."""

    lat_deg: str = key(text)
    lon_deg: str = key(text)
    valid: str = key(text)


@dataclass(frozen=True, eq=False)
class Mapping:
    """The mapping of a log's columns to ours."""

    name: str = "canonical"  # Of the bundled format, or path of the file
    title: str = "thermorender's own columns"
    # Our column name to its sources, of which the first whose column is present counts; empty for our own format
    quantities: dict[str, tuple[Quantity, ...]] = field(default_factory=dict)
    # Numeric times [s after scaling], of which the first present counts; ignored if `stamps` are used
    time: tuple[Quantity, ...] = (Quantity("time_s"),)
    from_start: bool = False  # Time counts from the earliest sample of all files
    # Date-time columns to try in turn: column, pattern ("iso" or strptime's), optional fraction column
    stamps: tuple[dict[str, str], ...] = ()
    sort_by_time: bool = False  # Before the check of the times
    quaternion_world: str = "NED"  # Axes that the quaternion rotates into, "NED" or "ENU"
    # (3, 3); its columns are forward, right and down in the log's body axes
    log_body_from_frd: NDArray[np.float64] = field(default_factory=lambda: np.eye(3))
    quaternion_inverse: bool = False  # The log's quaternion rotates world to body
    gimbal_on_body: bool = False  # The gimbal's angles are relative to the vehicle's body, not to the Earth
    valid: tuple[str, ...] = ()  # Columns, if present; rows where one is 0 are dropped
    doubtful: tuple[str, ...] = ()  # Columns, if present; rows where one is not 0 are reported
    resets: tuple[Reset, ...] = ()  # Of the estimator, if their counters are present
    origin: Origin | None = None  # Of local positions, if its columns are present
    reader: str = "csv"  # Kind of file; see `trajectory.sources`
    suffix: str = ""  # Ends of the names of such files, separated by blanks; "" for CSV
    assumes: str = ""  # What the format takes for granted, for the user


def bundled_formats() -> list[str]:
    """Return the names of the bundled column mappings, sorted."""
    folder = files("thermorender.trajectory") / "formats"
    return sorted(entry.name[: -len(".toml")] for entry in folder.iterdir() if entry.name.endswith(".toml"))


def changed_mapping(mapping: Mapping) -> str:
    """Return which file a user changes to read a log otherwise than a mapping: "a copy of …", or "a TOML file"."""
    if mapping.name == Mapping.name:
        return "a TOML file"
    bundled = mapping.name in bundled_formats()
    shipped = files("thermorender.trajectory") / "formats" / f"{mapping.name}.toml"
    return f"a copy of {shipped if bundled else mapping.name}"


def load_mapping(name: str | PathLike[str] | None) -> Mapping:
    """Return the `Mapping` of a bundled format or of a TOML file; None gives our own columns."""
    if name is None:
        return Mapping()
    if str(name) in bundled_formats():
        file = files("thermorender.trajectory") / "formats" / f"{name}.toml"
    elif os.path.isfile(name):
        file = Path(name)
    else:
        raise ThermorenderError(
            f"format={str(name)!r} is neither a bundled trajectory format ({', '.join(bundled_formats())}) "
            "nor the path of a mapping file in TOML"
        )
    given = read(_File, read_toml(file, str(name)), Where(name))
    return Mapping(
        name=str(name),
        title=given.title or str(name),
        quantities={ours: value for ours, value in vars(given.columns).items() if value is not None},
        time=tuple(Quantity(column, given.time.scale, given.time.offset) for column in given.time.column),
        from_start=given.time.from_start or bool(given.time.stamps),
        stamps=tuple({k: v for k, v in vars(stamp).items() if v is not None} for stamp in given.time.stamps),
        sort_by_time=given.sort_by_time,
        quaternion_world=given.quaternion.world,
        log_body_from_frd=given.quaternion.body,
        quaternion_inverse=given.quaternion.inverse,
        gimbal_on_body=given.gimbal.relative_to == "body",
        valid=given.valid,
        doubtful=given.doubtful,
        resets=given.resets,
        origin=given.origin,
        reader=given.reader,
        suffix=given.suffix or "",
        assumes=given.assumes or "",
    )


def _quantity(value: Any, where: Where) -> tuple[Quantity, ...]:
    if isinstance(value, list) and value:
        return tuple(_one_quantity(each, where) for each in value)
    return (_one_quantity(value, where),)


def _one_quantity(value: Any, where: Where) -> Quantity:
    if isinstance(value, str):
        return Quantity(text(value, where))
    if isinstance(value, dict) and "column" in value:
        return read(Quantity, value, where)
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return Quantity(constant=number()(value, where))
    where.refuse(
        value,
        "a column's name, a number for all rows, { column = '…', scale = 1.0, offset = 0.0 }, or a list of these whose "
        "first present column counts",
    )


def _names(value: Any, where: Where) -> tuple[str, ...]:
    return (value,) if isinstance(value, str) and value else texts(value, where)


def _body_axes(axes: Any, where: Where) -> NDArray[np.float64]:
    """Columns: forward, right, down in the log's body axes, from "FRD", "FLU" or signed axis letters."""
    if isinstance(axes, str) and axes in _NAMED_AXES:
        return _NAMED_AXES[axes]
    letters = {
        sign + letter: s * unit
        for letter, unit in zip("xyz", np.eye(3), strict=True)
        for sign, s in (("", 1.0), ("+", 1.0), ("-", -1.0))
    }
    if isinstance(axes, list) and len(axes) == 3 and all(isinstance(axis, str) and axis in letters for axis in axes):
        matrix = np.stack([letters[axis] for axis in axes], axis=-1)
        if np.isclose(np.linalg.det(matrix), 1.0):
            return matrix
    where.refuse(
        axes,
        "'FRD', 'FLU' or three of x, y, z with signs that say where forward, right and down lie, as a right-handed set",
    )


# A mapping file's tables.


@dataclass(frozen=True)
class _Stamp:
    column: str = key(text)
    pattern: str = key(text)
    fraction: str | None = key(text, None)


@dataclass(frozen=True)
class _Time:
    column: tuple[str, ...] = key(_names, ())
    scale: float = key(number(), 1.0)
    offset: float = key(number(), 0.0)
    from_start: bool = key(flag, False)
    stamps: tuple[_Stamp, ...] = key(tables(_Stamp), ())

    def check(self, where: Where, given: dict[str, Any]) -> None:
        where.exactly_one([name for name in given if getattr(self, name)], ("column", "stamps"))


@dataclass(frozen=True)
class _Quaternion:
    world: str = key(choice("NED", "ENU"), "NED")
    body: NDArray[np.float64] = key(_body_axes, _NAMED_AXES["FRD"])
    inverse: bool = key(flag, False)


@dataclass(frozen=True)
class _Gimbal:
    relative_to: str = key(choice("earth", "body"), "earth")


_Columns = make_dataclass("_Columns", [(name, tuple, key(_quantity, None)) for name in QUANTITIES], frozen=True)


@dataclass(frozen=True)
class _File:
    title: str | None = key(text, None)
    sort_by_time: bool = key(flag, False)
    time: _Time = key(table(_Time), _Time(("time_s",)))
    columns: object = key(table(_Columns), _Columns())
    quaternion: _Quaternion = key(table(_Quaternion), _Quaternion())
    gimbal: _Gimbal = key(table(_Gimbal), _Gimbal())
    valid: tuple[str, ...] = key(texts, ())
    doubtful: tuple[str, ...] = key(texts, ())
    resets: tuple[Reset, ...] = key(tables(Reset), ())
    origin: Origin | None = key(table(Origin), None)
    reader: str = key(choice(*READERS), "csv")
    suffix: str | None = key(text, None)
    assumes: str | None = key(text, None)


def fitting_formats(header: Iterable[str]) -> str:
    """Return a hint that names the bundled formats with some of these columns, or `format` if there is none."""
    fitting, header = [], set(header)
    for name in bundled_formats():
        mapping = load_mapping(name)
        times = {stamp["column"] for stamp in mapping.stamps} | {time.column for time in mapping.time}
        columns = {each.column for choices in mapping.quantities.values() for each in choices if each.column}
        if mapping.reader == "csv" and times & header and columns & header:
            fitting.append(name)
    if fitting:
        return f"; the columns fit format={' or format='.join(fitting)}"
    return (
        f"; if another program wrote the file, give its format ({', '.join(bundled_formats())}) or a mapping of its "
        "columns"
    )


def format_of_suffix(path: object) -> str | None:
    """Return the bundled format of files whose names end like this one, or None."""
    end = Path(str(path).partition("#")[0]).suffix.lower()
    return next((name for name in bundled_formats() if end and end in load_mapping(name).suffix.split()), None)
