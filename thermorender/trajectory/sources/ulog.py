"""PX4 logs in ULog: VehicleLocalPosition, VehicleAttitude and GimbalDeviceAttitudeStatus by PX4's definitions.

A gimbal's quaternion rotates its axes to north, east, down if a flag says so, else to axes with the vehicle's heading
(MAVLink, GIMBAL_DEVICE_FLAGS).
"""

import io

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from thermorender.errors import ThermorenderError
from thermorender.trajectory.rotations import rotation_from_wxyz
from thermorender.trajectory.sources.extra import check_file, library, said_by_library
from thermorender.trajectory.tables import Floats, Table

_POSITION, _ATTITUDE = "vehicle_local_position", "vehicle_attitude"
_GIMBAL = "gimbal_device_attitude_status"
_QUATERNION = tuple(f"q[{k}]" for k in range(4))
_FIELDS = {
    _POSITION: ("timestamp", "x", "y", "z"),
    _ATTITUDE: ("timestamp", *_QUATERNION),
    _GIMBAL: ("timestamp", *_QUATERNION),
}
_MAGIC = b"ULog\x01\x12\x35"
# GIMBAL_DEVICE_FLAGS_YAW_LOCK and GIMBAL_DEVICE_FLAGS_YAW_IN_EARTH_FRAME.
_EARTH = 16 | 64
# GIMBAL_DEVICE_FLAGS_YAW_IN_VEHICLE_FRAME.
_VEHICLE = 32
# Reads beyond the end of a file after which a reader goes in circles.
_MOST_SHORT = 100


def read_ulog(path: str) -> list[Table]:
    """Return the tables of a ULog file: position, attitude and, if it is logged, the gimbal's angles."""
    check_file(path, _MAGIC, "a PX4 log in ULog")
    pyulog = library("pyulog", "a PX4 log in ULog")
    try:
        with said_by_library(), _Ending(io.FileIO(path)) as file:
            log = pyulog.ULog(file, [_POSITION, _ATTITUDE, _GIMBAL])
    except Exception as error:  # the library raises whatever a damaged file leads to
        raise ThermorenderError(f"{path} cannot be read as ULog ({type(error).__name__}); copy it again") from error
    messages = {each.name: each.data for each in log.data_list if each.multi_id == 0}
    for name in (_POSITION, _ATTITUDE):
        if name not in messages:
            raise ThermorenderError(
                f"{path}: message {name!r} is not logged; a flight needs {_POSITION} and {_ATTITUDE}"
            )
    for name, data in messages.items():
        if not all(len(values) for values in data.values()):
            raise ThermorenderError(f"{path}: message {name!r} has no samples; give another log")
        lacking = [field for field in _FIELDS[name] if field not in data]
        if lacking:
            raise ThermorenderError(
                f"{path}: message {name!r} lacks {', '.join(lacking)}; the log may be damaged: copy it again"
            )
    notes = []
    if log.file_corruption:
        notes.append(f"{path}: a part of the log is damaged and was skipped")
    if log.dropouts:
        lost = sum(each.duration for each in log.dropouts) / 1e3
        notes.append(
            f"{path}: the logger lost data {len(log.dropouts)} times, {lost:.3g} s in all, where the path is straight"
        )
    tables = [_table(path, name, messages[name]) for name in (_POSITION, _ATTITUDE)]
    if _GIMBAL in messages:
        tables.append(_gimbal(path, messages[_GIMBAL], messages[_ATTITUDE]))
    first = tables[0]
    return [Table(first.path, first.columns, first.row, first.what, notes=tuple(notes)), *tables[1:]]


class _Ending(io.BufferedReader):
    """A file that raises EOFError for a reader that asks for more than there is again and again, as pyulog does where
    the last message is cut off."""

    _short = 0

    def read(self, size: int | None = -1) -> bytes:
        found = super().read(size)
        self._short += size is not None and len(found) < size
        if self._short > _MOST_SHORT:
            raise EOFError("the last message is cut off")
        return found


def _table(path: str, name: str, data: dict[str, Floats]) -> Table:
    columns = {field: np.asarray(values, np.float64) for field, values in data.items()}
    return Table(f"{path} ({name})", dict(columns), np.arange(1, len(data["timestamp"]) + 1), "sample")


def _gimbal(path: str, data: dict[str, Floats], attitude: dict[str, Floats]) -> Table:
    """The gimbal's angles relative to the Earth."""
    time = np.asarray(data["timestamp"], np.float64)
    angles = np.unwrap(_rotation(data).as_euler("ZYX", degrees=True), axis=0, period=360.0)
    flags = np.asarray(data.get("device_flags", np.zeros(time.size))).astype(np.int64)
    earth = ((flags & _EARTH) != 0) & ((flags & _VEHICLE) == 0)
    at = np.asarray(attitude["timestamp"], np.float64)
    inside = (time >= at[0]) & (time <= at[-1])
    # A logger repeats a time after a dropout.
    later = np.r_[True, at[1:] > np.maximum.accumulate(at)[:-1]]
    if not inside.any() or later.sum() < 2:
        raise ThermorenderError(f"{path}: messages {_GIMBAL!r} and {_ATTITUDE!r} share no time; give another log")
    at, rotation = at[later], _rotation(attitude)[later]
    nose = Slerp(at, rotation)(np.clip(time[inside], at[0], at[-1])).as_matrix()[:, :, 0]
    heading = np.degrees(np.arctan2(nose[:, 1], nose[:, 0]))
    yaw = angles[inside, 0] + np.where(earth[inside], 0.0, heading)
    columns: dict[str, Floats] = {
        "timestamp": time[inside],
        "gimbal_yaw_deg": yaw,
        "gimbal_pitch_deg": angles[inside, 1],
        "gimbal_roll_deg": angles[inside, 2],
    }
    return Table(f"{path} ({_GIMBAL})", dict(columns), np.flatnonzero(inside) + 1, "sample")


def _rotation(data: dict[str, Floats]) -> Rotation:
    quaternion = np.stack([np.asarray(data[name], np.float64) for name in _QUATERNION], axis=-1)
    with np.errstate(over="ignore"):
        length = np.linalg.norm(quaternion, axis=1)
    unit = np.abs(length - 1.0) < 0.5
    if not unit.all():
        k = int(np.argmin(unit))
        raise ThermorenderError(
            f"sample {k + 1} of the attitude or gimbal is {quaternion[k]}, not a unit quaternion; give another log"
        )
    return rotation_from_wxyz(quaternion)
