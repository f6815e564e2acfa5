"""Whose column is which: the names of our columns and the mappings of foreign flight logs onto them.

A mapping is a TOML file (`formats/`): which of a log's columns is which of ours, how its time is
written, and between which axes its quaternion turns.
"""

from dataclasses import dataclass, field, make_dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.schema import Where, choice, flag, key, number, read, read_toml, table, tables, text

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

    column: str | None = key(text, None)
    scale: float = key(number(), 1.0)
    offset: float = key(number(), 0.0)
    constant: float | None = None


@dataclass(frozen=True, eq=False)
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
        Sort the rows by time before the check.
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


def bundled_formats():
    """Return the names of the column mappings that come with the package, sorted."""
    folder = files("thermorender.trajectory") / "formats"
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
        file = files("thermorender.trajectory") / "formats" / f"{name}.toml"
    elif Path(name).is_file():
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
        time=Quantity() if given.time.stamps else Quantity(given.time.column, given.time.scale, given.time.offset),
        stamps=tuple({k: v for k, v in vars(stamp).items() if v is not None} for stamp in given.time.stamps),
        sort_by_time=given.sort_by_time,
        quaternion_world=given.quaternion.world,
        log_body_from_frd=given.quaternion.body,
        quaternion_inverse=given.quaternion.inverse,
    )


def _quantity(value, where):
    if isinstance(value, str):
        return Quantity(text(value, where))
    if isinstance(value, dict) and "column" in value:
        return read(Quantity, value, where)
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return Quantity(constant=number()(value, where))
    where.refuse(
        value, "a column's name, a number for all rows, or { column = '…', scale = 1.0, offset = 0.0 }"
    )


def _body_axes(axes, where):
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
        axes, "'FRD', 'FLU' or three of x, y, z with signs that say where forward, right and down lie, as a "
        "right-handed set"
    )


# A mapping file's tables.


@dataclass(frozen=True)
class _Stamp:
    column: str = key(text)
    pattern: str = key(text)
    fraction: str | None = key(text, None)


@dataclass(frozen=True)
class _Time:
    column: str | None = key(text, None)
    scale: float = key(number(), 1.0)
    offset: float = key(number(), 0.0)
    stamps: tuple = key(tables(_Stamp), ())

    def check(self, where, given):
        where.exactly_one([name for name in given if getattr(self, name)], ("column", "stamps"))


@dataclass(frozen=True)
class _Quaternion:
    world: str = key(choice("NED", "ENU"), "NED")
    body: np.ndarray = key(_body_axes, _NAMED_AXES["FRD"])
    inverse: bool = key(flag, False)


_Columns = make_dataclass("_Columns", [(name, Quantity, key(_quantity, None)) for name in QUANTITIES], frozen=True)


@dataclass(frozen=True)
class _File:
    title: str | None = key(text, None)
    sort_by_time: bool = key(flag, False)
    time: _Time = key(table(_Time), _Time("time_s"))
    columns: object = key(table(_Columns), _Columns())
    quaternion: _Quaternion = key(table(_Quaternion), _Quaternion())


def fitting_formats(header):
    """A hint that names the bundled formats which know some of these columns, or nothing."""
    fitting = []
    for name in bundled_formats():
        mapping = load_mapping(name)
        times = {stamp["column"] for stamp in mapping.stamps} | {mapping.time.column}
        columns = {q.column for q in mapping.quantities.values() if q.column}
        if times & set(header) and columns & set(header):
            fitting.append(repr(name))
    return f"; the columns fit format={' or '.join(fitting)}" if fitting else ""
