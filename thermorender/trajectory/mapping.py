"""Column names of thermorender's flight logs, and mappings of other programs' columns to them.

A mapping is a TOML file (`formats/`) that names the log's column for each of ours, the notation of time, and the
axes of the quaternion.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field, make_dataclass
from importlib.resources import files
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
    """The source of one of our quantities: a column times `scale` plus `offset`, or a constant."""

    column: str | None = key(text, None)
    scale: float = key(number(), 1.0)
    offset: float = key(number(), 0.0)
    constant: float | None = None


@dataclass(frozen=True, eq=False)
class Mapping:
    """The mapping of a log's columns to ours.

    Parameters
    ----------
    name : str
        Name of the bundled format or path of the file.
    title : str
        Description in one line.
    quantities : dict
        Our column name to `Quantity`; empty for our own format.
    time : Quantity
        Numeric time [s after scaling]; its column is None if `stamps` are used.
    stamps : tuple of dict
        Date-time columns to try in turn: column, pattern ("iso" or strptime's), optional fraction column.
    sort_by_time : bool
        Sort the rows by time before the check.
    quaternion_world : str
        Axes the quaternion rotates into, "NED" or "ENU".
    log_body_from_frd : (3, 3) array
        Columns: forward, right and down in the log's body axes.
    quaternion_inverse : bool
        The log's quaternion rotates world to body.
    """

    name: str = "canonical"
    title: str = "thermorender's own columns"
    quantities: dict[str, Quantity] = field(default_factory=dict)
    time: Quantity = field(default_factory=lambda: Quantity("time_s"))
    stamps: tuple[dict[str, str], ...] = ()
    sort_by_time: bool = False
    quaternion_world: str = "NED"
    log_body_from_frd: NDArray[np.float64] = field(default_factory=lambda: np.eye(3))
    quaternion_inverse: bool = False


def bundled_formats() -> list[str]:
    """Return the names of the bundled column mappings, sorted."""
    folder = files("thermorender.trajectory") / "formats"
    return sorted(entry.name[: -len(".toml")] for entry in folder.iterdir() if entry.name.endswith(".toml"))


def load_mapping(name: str | PathLike[str] | None) -> Mapping:
    """Return the `Mapping` of a bundled format or of a TOML file; None gives our own columns.

    Raises
    ------
    ThermorenderError
        The format does not exist, or the file has an unknown key or an invalid value.
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


def _quantity(value: Any, where: Where) -> Quantity:
    if isinstance(value, str):
        return Quantity(text(value, where))
    if isinstance(value, dict) and "column" in value:
        return read(Quantity, value, where)
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return Quantity(constant=number()(value, where))
    where.refuse(value, "a column's name, a number for all rows, or { column = '…', scale = 1.0, offset = 0.0 }")


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
    column: str | None = key(text, None)
    scale: float = key(number(), 1.0)
    offset: float = key(number(), 0.0)
    stamps: tuple[_Stamp, ...] = key(tables(_Stamp), ())

    def check(self, where: Where, given: dict[str, Any]) -> None:
        where.exactly_one([name for name in given if getattr(self, name)], ("column", "stamps"))


@dataclass(frozen=True)
class _Quaternion:
    world: str = key(choice("NED", "ENU"), "NED")
    body: NDArray[np.float64] = key(_body_axes, _NAMED_AXES["FRD"])
    inverse: bool = key(flag, False)


_Columns = make_dataclass("_Columns", [(name, Quantity, key(_quantity, None)) for name in QUANTITIES], frozen=True)


@dataclass(frozen=True)
class _File:
    title: str | None = key(text, None)
    sort_by_time: bool = key(flag, False)
    time: _Time = key(table(_Time), _Time("time_s"))
    columns: object = key(table(_Columns), _Columns())
    quaternion: _Quaternion = key(table(_Quaternion), _Quaternion())


def fitting_formats(header: Iterable[str]) -> str:
    """Return a hint that names the bundled formats with some of these columns, or ""."""
    fitting = []
    for name in bundled_formats():
        mapping = load_mapping(name)
        times = {stamp["column"] for stamp in mapping.stamps} | {mapping.time.column}
        columns = {q.column for q in mapping.quantities.values() if q.column}
        if times & set(header) and columns & set(header):
            fitting.append(repr(name))
    return f"; the columns fit format={' or '.join(fitting)}" if fitting else ""
