"""Whose column is which: the names of our columns and the mappings of foreign flight logs onto them.

A mapping is a TOML file (`formats/`): which of a log's columns is which of ours, how its time is
written, and between which axes its quaternion turns.
"""

import sys
from dataclasses import dataclass, field
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
    try:
        data = tomllib.loads(file.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ThermorenderError(f"{name}: is not a TOML file: {error}") from error
    return _mapping_from(str(name), data)


def _mapping_from(name, data):
    _known(name, "", data, ("title", "sort_by_time", "time", "columns", "quaternion"))
    time = data.get("time", {"column": "time_s"})
    _known(name, "time.", time, ("column", "scale", "offset", "stamps"))
    stamps = time.get("stamps", ())
    if not isinstance(stamps, (list, tuple)):
        raise ThermorenderError(f"{name}: time.stamps={stamps!r} is not understood; give tables headed [[time.stamps]]")
    stamps = tuple(stamps)
    if bool(stamps) == ("column" in time):
        raise ThermorenderError(f"{name}: [time] needs either column or [[time.stamps]]")
    for stamp in stamps:
        _known(name, "time.stamps.", stamp, ("column", "pattern", "fraction"))
        for key in ("column", "pattern"):
            if key not in stamp:
                raise ThermorenderError(f"{name}: [[time.stamps]] lacks {key}")
        for key, value in stamp.items():
            if not isinstance(value, str):
                raise ThermorenderError(f"{name}: time.stamps.{key}={value!r} is not a text; give one in quotes")
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
    if not isinstance(data, dict):
        raise ThermorenderError(f"{name}: {prefix[:-1]} must be a table with the keys {', '.join(allowed)}")
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
        "{ column = '…', scale = 1.0, offset = 0.0 }"
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
        f"{name}: quaternion.body={axes!r}; allowed are 'FRD', 'FLU' or three of x, y, z with signs that say "
        "where forward, right and down lie, as a right-handed set"
    )


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
