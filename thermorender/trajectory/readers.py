"""Read the camera's trajectory from flight logs: heights, attitudes, mounting and anchoring.

Conventions of thermorender's CSV columns (row 1 has the names, which end in units):

- `time_s`; position `east_m, north_m` in the scene's frame or `lat_deg, lon_deg` (WGS 84).
- Exactly one height: `up_m` (local up), `alt_ellipsoid_m`, `alt_geoid_m`, `above_ground_m` (above the ground
  below each sample) or `above_takeoff_m` (above the ground below the first sample).
- The vehicle's attitude: `qw, qx, qy, qz` from body axes (x forward, y right, z down) to local north, east,
  down, or `yaw_deg` (clockwise from north), `pitch_deg` (nose up), `roll_deg` (right side down). A missing
  angle is 0; without any, the vehicle flies level and heads north.
- `gimbal_yaw_deg, gimbal_pitch_deg, gimbal_roll_deg`: the optical axis relative to the Earth (pitch −90 looks
  straight down, 0 at the horizon; yaw clockwise from north). A missing yaw is the vehicle's, a missing pitch
  or roll is 0. With any of these columns the vehicle's attitude only rotates the lever arm.
"""

from collections.abc import Iterable
from dataclasses import replace
from os import PathLike
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from thermorender.errors import ThermorenderError
from thermorender.physics.geodesy import LocalFrame
from thermorender.trajectory.column_mapping import (
    ANGLES,
    GIMBAL,
    HEIGHTS,
    POSITION,
    POSITION_GEODETIC,
    POSITION_LOCAL,
    QUATERNION,
    UNSTATED,
    Mapping,
    bundled_formats,
    format_of_suffix,
    load_mapping,
)
from thermorender.trajectory.heights import (
    frame_of_first_sample,
    geodetic_of_local,
    local_positions,
    refuse_exchanged,
    refuse_far,
)
from thermorender.trajectory.logs import Log, read_log
from thermorender.trajectory.path import QUATERNION_TOLERANCE, Anchor, GroundHeight, Trajectory
from thermorender.trajectory.rotations import (
    BODY_FROM_CAMERA,
    ENU_FROM_NED,
    ecef_from_ned,
    rotation_from_angles,
    rotation_from_wxyz,
    slerp,
    wxyz,
)
from thermorender.trajectory.sources import SOURCES
from thermorender.trajectory.track import course_deg, jumps

# A camera that looks farther aside from the vehicle's nose than this is doubted.
_ASIDE_DEG = 30.0


def read_trajectory(
    paths: str | PathLike[str] | Iterable[str | PathLike[str]], *, frame: LocalFrame | None = None,
    ground: GroundHeight | None = None, geoid_undulation_m: float | None = None,
    format: str | PathLike[str] | None = None, anchor: Anchor | None = None, clock_offset_s: float = 0.0,
    mount: ArrayLike | None = None, lever_arm_m: ArrayLike = (0.0, 0.0, 0.0),
    duplicates: Literal["refuse", "spread", "first"] = "refuse", course: bool = False,
) -> Trajectory:  # fmt: skip
    """Return the camera's `Trajectory` in the scene's frame from one or several log files of a flight.

    Several files have different columns (position, attitude, gimbal) and their own times; they are joined at the times
    of all of them within their common span. `Trajectory.notes` says what was dropped, corrected or assumed.

    - `frame` is the scene's georeference, for latitude and longitude; `ground(east, north)` returns the local up of the
      ground (N,) [m], NaN off the terrain; `geoid_undulation_m` is the geoid's height above the ellipsoid, for
      `alt_geoid_m`. An anchored flight needs no georeference.
    - `format` is a bundled column mapping (`trajectory.column_mapping.bundled_formats()`) or a TOML file of the same
      form.
    - `anchor` moves the first camera position to (east, north), `up` metres above the ground there (local up without
      `ground`), and rotates the flight about up to the heading; it keeps its shape. A log of `above_ground_m` instead
      follows the new ground, with all its heights shifted so that the first is `up`.
    - `clock_offset_s` is added to the log's time [s]; date-time stamps count from the earliest sample.
    - `mount` is yaw, pitch, roll of the optical axis relative to the vehicle's body [deg]: (0, 0, 0), the default,
      looks forward with the image's right edge to the vehicle's right; (0, −90, 0) looks down with the nose at the
      upper edge.
    - `lever_arm_m` is the camera's position in the body: forward, right, down [m].
    - `duplicates` is as in `logs.read_log`; `course` turns a vehicle without yaw to its course, `track.course_deg`.
    """
    mapping = load_mapping(format)
    logs = _read_logs(paths, mapping, duplicates)
    mount_deg = _triple("mount", (0.0, 0.0, 0.0) if mount is None else mount, "yaw, pitch, roll [deg]")
    if not np.isfinite(clock_offset_s):
        raise ThermorenderError(f"clock_offset_s={clock_offset_s} is not a finite number; give seconds")
    lever = _triple("lever_arm_m", lever_arm_m, "forward, right, down [m]")

    position_log, horizontal, height = _position_columns(logs, mapping)
    if position_log.origin and horizontal == POSITION_LOCAL and frame is not None and anchor is None:
        position_log, horizontal = geodetic_of_local(position_log), POSITION_GEODETIC
    if frame is not None and horizontal == POSITION_GEODETIC:
        refuse_exchanged(position_log, frame, mapping, logs)
    if anchor is not None and horizontal == POSITION_GEODETIC:
        frame = frame_of_first_sample(position_log)
    position = local_positions(
        position_log, horizontal, height, frame, ground, geoid_undulation_m, relative=anchor is not None
    )
    jump = jumps(position_log, position)
    notes = _notes(logs, mapping, jump)

    body_log, gimbal_log = _attitude_logs(logs, mount)
    heading = None if mapping.gimbal_on_body else gimbal_log
    course_log = _course(position_log, position, body_log, heading, course, notes)
    time_s = _common_times([log for log in (position_log, body_log, gimbal_log) if log is not None])
    position = np.stack([np.interp(time_s, position_log.time_s, position[:, k]) for k in range(3)], axis=-1)
    enu_from_ned = enu_from_ned_at(position, frame if horizontal == POSITION_GEODETIC else None)
    ned_from_body = _body(body_log, mapping, time_s)
    if course_log is not None:
        course_at = np.interp(time_s, position_log.time_s, course_log)
        ned_from_body = _turned(course_at, enu_from_ned) * ned_from_body
    ned_from_optical = (
        ned_from_body * rotation_from_angles(*mount_deg)
        if gimbal_log is None
        else _gimbal(gimbal_log, time_s, ned_from_body, mapping, body_log is not None, notes)
    )
    trajectory = of_vehicle(
        time_s + clock_offset_s, position, enu_from_ned * ned_from_body, enu_from_ned * ned_from_optical, lever
    )
    if anchor is not None:
        trajectory = _anchored(trajectory, anchor, ground, height)
    refuse_far(position_log, trajectory)
    return replace(trajectory, notes=tuple(notes))


def enu_from_ned_at(position: NDArray[np.float64], frame: LocalFrame | None) -> Rotation:
    """Return the rotations from local NED to the scene's axes at positions in it, (N, 3) [m].

    With `frame`, the scene's georeference, north and down are those of each position; without, of the scene.
    """
    if frame is None:
        return Rotation.from_matrix(ENU_FROM_NED)
    latitude, longitude, _ = frame.geodetic_from_enu(position)
    return Rotation.from_matrix(frame.enu_from_ecef_rotation) * ecef_from_ned(latitude, longitude)


def of_vehicle(
    time_s: NDArray[np.float64], position: NDArray[np.float64], enu_from_body: Rotation, enu_from_optical: Rotation,
    lever_arm_m: NDArray[np.float64],
) -> Trajectory:  # fmt: skip
    """Return the camera's Trajectory on a vehicle at positions (N, 3) [m] in the scene's frame.

    Rotations are from the vehicle's FRD axes and from the optical axis; `lever_arm_m` (3,) as in `read_trajectory`.
    """
    return Trajectory(
        time_s,
        position + enu_from_body.apply(lever_arm_m),
        wxyz(enu_from_optical * Rotation.from_matrix(BODY_FROM_CAMERA)),
    )


def _notes(logs: list[Log], mapping: Mapping, jump: str | None) -> list[str]:
    """Sentences on what the logs say of themselves, on a jump, and on what the format assumes."""
    notes = [note for log in logs for note in (*log.notes, *(f"{a}{t:.3f}{b}" for a, t, b in log.resets))]
    if jump:
        notes.append(jump)
    if mapping.assumes:
        notes.append(f"format {mapping.name}: {mapping.assumes}")
    return notes


def _turned(course: NDArray[np.float64], enu_from_ned: Rotation) -> Rotation:
    """Turns about the vertical of NED to courses in the scene's axes [deg]."""
    heading = np.radians(course)
    direction = np.stack([np.sin(heading), np.cos(heading), np.zeros(heading.size)], axis=-1)
    along = enu_from_ned.inv().apply(direction)
    return rotation_from_angles(np.degrees(np.arctan2(along[:, 1], along[:, 0])), 0.0, 0.0)


def _read_logs(
    paths: str | PathLike[str] | Iterable[str | PathLike[str]], mapping: Mapping, duplicates: str
) -> list[Log]:
    """The logs of the files, with the mapping's constants added, each to the log with columns of its kind."""
    paths = [paths] if isinstance(paths, (str, PathLike)) else list(paths)
    if not paths:
        raise ThermorenderError("paths is empty; give at least one CSV file")
    for path in paths:
        other = format_of_suffix(path)
        if not mapping.quantities and mapping.reader == "csv" and other:
            raise ThermorenderError(f"{path} is read with format={other}; add it, or give a log in CSV")
    logs = [read_log(table, mapping, duplicates) for path in paths for table in SOURCES[mapping.reader](str(path))]
    _refuse_open_resets(logs)
    _add_constants(logs, mapping)
    return _from_zero(logs) if mapping.from_start else logs


def _refuse_open_resets(logs: list[Log]) -> None:
    """Refuse a reset whose effect is in the file with another counter, where none of the files has that counter."""
    for log in logs:
        for counter, phrase in log.open_resets.items():
            if not any(counter in other.counters for other in logs):
                raise ThermorenderError(
                    f"{log.path}: {phrase}, but no file has the column {counter!r} to correct the attitude by; give "
                    "the attitude's file with that column, or a log that begins after the reset"
                )


def _add_constants(logs: list[Log], mapping: Mapping) -> None:
    """Add the mapping's constants, each to the log with columns of its kind."""
    kinds = (POSITION, QUATERNION + ANGLES, GIMBAL)
    for name, (quantity, *_) in mapping.quantities.items():
        if quantity.constant is not None:
            kind = next(kind for kind in kinds if name in kind)
            owner = next((log for log in logs if any(n in log.values for n in kind)), logs[0])
            owner.values[name] = np.full(owner.time_s.size, quantity.constant)


def _from_zero(logs: list[Log]) -> list[Log]:
    """Logs whose time counts from the earliest sample of all: simulations count from the start of the flight."""
    zero = min(log.time_s[0] for log in logs)
    return [
        replace(
            log,
            time_s=log.time_s - zero,
            resets=[(before, time - zero, after) for before, time, after in log.resets],
        )
        for log in logs
    ]


def _triple(name: str, value: ArrayLike, meaning: str) -> NDArray[np.float64]:
    array = np.asarray(value, np.float64)
    if array.shape != (3,) or not np.isfinite(array).all():
        raise ThermorenderError(f"{name}={value!r} must be three finite numbers: {meaning}")
    return array


def _position_columns(logs: list[Log], mapping: Mapping) -> tuple[Log, tuple[str, ...], str]:
    """The log with the position, its pair of horizontal columns and its height column."""
    log_of = _log_of(logs)
    names = ", ".join(log.path for log in logs)
    _refuse_missing(log_of, mapping, names)
    pairs = [pair for pair in (POSITION_LOCAL, POSITION_GEODETIC) if any(name in log_of for name in pair)]
    if len(pairs) != 1:
        raise ThermorenderError(
            f"{names}: has {'both' if pairs else 'neither'} of the position columns east_m, north_m and "
            "lat_deg, lon_deg; give one pair"
        )
    heights = [name for name in (*HEIGHTS, UNSTATED) if name in log_of]
    if len(heights) != 1:
        arrived = "the height columns " + ", ".join(heights) if heights else "no height column"
        raise ThermorenderError(
            f"{names}: has {arrived}; exactly one of {', '.join(HEIGHTS)} is allowed, so that its reference is clear"
        )
    for name in pairs[0]:
        if name not in log_of:
            raise ThermorenderError(f"{names}: column {name!r} is missing; {' and '.join(pairs[0])} go together")
    first, second, above = (log_of[name] for name in (*pairs[0], heights[0]))
    if first is not second:
        raise ThermorenderError(f"{names}: {' and '.join(pairs[0])} must be columns of one file")
    return first if first is above else _joined(first, pairs[0], above, heights[0]), pairs[0], heights[0]


def _refuse_missing(log_of: dict[str, Log], mapping: Mapping, names: str) -> None:
    """Refuse logs that lack a column which a format needs."""
    for name, choices in mapping.quantities.items():
        if name not in log_of and not any(choice.optional for choice in choices):
            column = " or ".join(repr(choice.column) for choice in choices)
            raise ThermorenderError(
                f"{names}: column {column} ({name}) is missing; format={mapping.name!r} needs "
                "it, in this file or in another one given with it"
            )


def _log_of(logs: list[Log]) -> dict[str, Log]:
    """The log of each of our columns, after refusing one in two logs."""
    found: dict[str, Log] = {}
    for log in logs:
        for name in log.values:
            if name in found:
                raise ThermorenderError(
                    f"column {log.columns.get(name, name)!r} is in both {found[name].path} and {log.path}; give it once"
                )
            found[name] = log
    return found


def _joined(log: Log, pair: tuple[str, ...], above: Log, height: str) -> Log:
    """One log of positions from two files: both are interpolated at the times of either within their common span."""
    time_s = _common_times([log, above])
    values = {name: np.interp(time_s, log.time_s, log.values[name]) for name in pair}
    if "lon_deg" in pair:
        # Longitudes may pass from 180 to −180.
        longitude = np.interp(time_s, log.time_s, np.unwrap(log.values["lon_deg"], period=360.0))
        values["lon_deg"] = (longitude + 180.0) % 360.0 - 180.0
    values[height] = np.interp(time_s, above.time_s, above.values[height])
    row = log.row[np.clip(np.searchsorted(log.time_s, time_s), 0, log.row.size - 1)]
    return replace(log, time_s=time_s, values=values, row=row, columns={**above.columns, **log.columns})


def _course(
    log: Log, position: NDArray[np.float64], body: Log | None, gimbal: Log | None, wanted: bool, notes: list[str]
) -> NDArray[np.float64] | None:
    """The course at the positions' times if it stands for the yaw; a note if there is neither yaw nor course."""
    has_yaw = body is not None and ("qw" in body.values or ANGLES[0] in body.values)
    if wanted and has_yaw:
        raise ThermorenderError(f"course: {body.path if body else ''} has the vehicle's yaw already; leave course out")
    if wanted:
        return course_deg(log, position)
    if not has_yaw and (gimbal is None or GIMBAL[0] not in gimbal.values):
        notes.append(
            f"{log.path}: the log has no yaw, so the vehicle heads north all the time; course turns it to its course "
            "over ground"
        )
    return None


def _attitude_logs(logs: list[Log], mount: ArrayLike | None) -> list[Log | None]:
    """The log with the vehicle's attitude and the log with the gimbal's angles, or None."""
    chosen = []
    for group, what in ((QUATERNION + ANGLES, "vehicle's attitude"), (GIMBAL, "gimbal's angles")):
        holders = [log for log in logs if any(name in log.values for name in group)]
        if len(holders) > 1:
            raise ThermorenderError(f"{', '.join(log.path for log in holders)}: the {what} must be columns of one file")
        chosen.append(holders[0] if holders else None)
    body, gimbal = chosen
    if body is not None:
        _check_attitude(body)
    if gimbal is not None and mount is not None:
        raise ThermorenderError(
            f"mount={mount!r} contradicts {gimbal.path}, whose gimbal columns say where the camera looks; leave "
            f"mount out or delete the columns {', '.join(n for n in GIMBAL if n in gimbal.values)}"
        )
    return chosen


def _check_attitude(body: Log) -> None:
    """Refuse an attitude by both quaternion and angles, or by a part of a quaternion."""
    quaternion = [name for name in QUATERNION if name in body.values]
    if quaternion and any(name in body.values for name in ANGLES):
        raise ThermorenderError(f"{body.path}: the attitude is given twice, by qw, qx, qy, qz and by angles; keep one")
    if quaternion and len(quaternion) < 4:
        missing = ", ".join(repr(name) for name in QUATERNION if name not in quaternion)
        raise ThermorenderError(f"{body.path}: column {missing} is missing; a quaternion needs qw, qx, qy, qz")


def _common_times(logs: list[Log]) -> NDArray[np.float64]:
    """All times of all logs within their common span, so that no sample is lost."""
    if all(log is logs[0] for log in logs):
        return logs[0].time_s
    start, stop = max(log.time_s[0] for log in logs), min(log.time_s[-1] for log in logs)
    times = np.unique(np.concatenate([log.time_s for log in logs]))
    times = times[(times >= start) & (times <= stop)]
    if not times.size:
        spans = ", ".join(f"{log.path} {log.time_s[0]:.9g}…{log.time_s[-1]:.9g} s" for log in dict.fromkeys(logs))
        raise ThermorenderError(f"the files share no time: {spans}; give files of one flight and one clock")
    return times


def _body(log: Log | None, mapping: Mapping, time_s: NDArray[np.float64]) -> Rotation:
    """Rotations from body FRD to NED at `time_s`; level and heading north without a log."""
    if log is None:
        return rotation_from_angles(np.zeros(time_s.size), 0.0, 0.0)
    if "qw" not in log.values:
        angles = (log.values.get(name, np.zeros(log.time_s.size)) for name in ANGLES)
        return slerp(log.time_s, rotation_from_angles(*angles))(time_s)
    quaternion = np.stack([log.values[name] for name in QUATERNION], axis=-1)
    with np.errstate(over="ignore"):
        length = np.linalg.norm(quaternion, axis=1)
    bad = np.abs(length - 1.0) > QUATERNION_TOLERANCE
    if bad.any():
        k = int(np.argmax(bad))
        columns = ", ".join(log.columns.get(name, name) for name in QUATERNION)
        raise ThermorenderError(
            f"{log.path}, row {log.row[k]}, columns {columns}: the quaternion has length {length[k]:.6g}; "
            f"attitudes are unit quaternions, to within {QUATERNION_TOLERANCE:g}"
        )
    world_from_log = rotation_from_wxyz(quaternion)
    if mapping.quaternion_inverse:
        world_from_log = world_from_log.inv()
    # ENU_FROM_NED is its own inverse.
    ned_from_world = Rotation.from_matrix(ENU_FROM_NED if mapping.quaternion_world == "ENU" else np.eye(3))
    ned_from_body = ned_from_world * world_from_log * Rotation.from_matrix(mapping.log_body_from_frd)
    return slerp(log.time_s, ned_from_body)(time_s)


def _gimbal(
    log: Log, time_s: NDArray[np.float64], ned_from_body: Rotation, mapping: Mapping, heads: bool, notes: list[str]
) -> Rotation:
    """Rotations from the gimbal's axes (x along the view, y right, z down in the image) to NED.

    `notes` gets a note if angles against the Earth look sideways from a nose whose heading the log has (`heads`).
    """
    zero = np.zeros(log.time_s.size)
    angles = [log.values.get(name, zero) for name in GIMBAL]
    gimbal = slerp(log.time_s, rotation_from_angles(*angles))(time_s)
    if mapping.gimbal_on_body:
        return ned_from_body * gimbal
    nose = ned_from_body.as_matrix()[:, :, 0]
    heading = np.degrees(np.arctan2(nose[:, 1], nose[:, 0]))
    if GIMBAL[0] not in log.values:
        return rotation_from_angles(heading, 0.0, 0.0) * gimbal
    yaw = np.interp(time_s, log.time_s, np.unwrap(log.values[GIMBAL[0]], period=360.0))
    aside = float(np.median(np.abs((yaw - heading + 180.0) % 360.0 - 180.0)))
    # A bundled format knows what its angles are measured against.
    if aside > _ASIDE_DEG and heads and mapping.name not in bundled_formats():
        notes.append(
            f"{log.path}: {GIMBAL[0]} is read against north and differs from the vehicle's heading by {aside:.0f}° in "
            'the median; if it is measured against the airframe, give a mapping with [gimbal] relative_to = "body" as '
            "format"
        )
    return gimbal


def _anchored(trajectory: Trajectory, anchor: Anchor, ground: GroundHeight | None, height: str) -> Trajectory:
    up = anchor.up
    if ground is not None:
        spot = np.array([anchor.east]), np.array([anchor.north])
        below = float(np.asarray(ground(*spot), np.float64)[0])
        if not np.isfinite(below):
            raise ThermorenderError(
                f"anchor: there is no ground below east {anchor.east:g} m, north {anchor.north:g} m; give a "
                "position on the scene's terrain"
            )
        up += below
    moved = trajectory.anchored(anchor.east, anchor.north, anchor.heading_deg, up)
    if height != "above_ground_m":
        return moved
    if ground is None:
        raise ThermorenderError(
            "anchor: a log of above_ground_m follows the ground, and none is given; render a scene with "
            "terrain or give a height of another reference"
        )
    terrain = moved.position[:, 2] - moved.above_ground(ground)
    if not np.isfinite(terrain).all():
        k = int(np.argmax(~np.isfinite(terrain)))
        raise ThermorenderError(
            f"anchor: at {moved.time_s[k]:.3f} s the flight leaves the scene's terrain (east "
            f"{moved.position[k, 0]:.1f} m, north {moved.position[k, 1]:.1f} m), where above_ground_m has no "
            "meaning; choose another anchor"
        )
    position = moved.position.copy()
    position[:, 2] += terrain - terrain[0]
    return Trajectory(moved.time_s, position, moved.quaternion)
