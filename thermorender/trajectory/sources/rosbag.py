"""Bags of ROS 2 (`.mcap`, `.db3`, or their folder): one topic, named after a `#`, as in `flight.mcap#/odom`.

Poses (geometry_msgs/PoseStamped, PoseWithCovarianceStamped, nav_msgs/Odometry) have x east, y north, z up, and a body
of x forward, y left, z up (REP 103). sensor_msgs/NavSatFix has altitudes above the WGS 84 ellipsoid, NaN without one,
and a status below 0 without a fix.
"""

from pathlib import Path
from typing import Any

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.trajectory.sources.extra import library
from thermorender.trajectory.tables import Table

# Kinds of messages, and the attributes that lead from a message to its pose; None for a fix.
_POSES = {
    "geometry_msgs/msg/PoseStamped": ("pose",),
    "geometry_msgs/msg/PoseWithCovarianceStamped": ("pose", "pose"),
    "nav_msgs/msg/Odometry": ("pose", "pose"),
}
_FIX = "sensor_msgs/msg/NavSatFix"
# Ends of the names of frames, and the axes they stand for (REP 103; REP 105 for the Earth's).
_OTHER_AXES = {
    "_ned": "x north, y east, z down", "_frd": "x forward, y right, z down", "_optical": "a camera's",
    "_optical_frame": "a camera's", "earth": "the Earth's", "ecef": "the Earth's",
}  # fmt: skip
_POSE_COLUMNS = ("time_s", "east_m", "north_m", "up_m", "qw", "qx", "qy", "qz")
_FIX_COLUMNS = ("time_s", "lat_deg", "lon_deg", "alt_ellipsoid_m", "fix")


def read_rosbag(path: str) -> list[Table]:
    """Return the table of one topic of a bag, in a list."""
    bag, topic = _split(path)
    highlevel, typesys = (library(f"rosbags.{part}", "a bag of ROS") for part in ("highlevel", "typesys"))
    try:
        known = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
        with highlevel.AnyReader([bag], default_typestore=known) as reader:
            connections = _chosen(path, reader.connections, topic)
            messages = [
                (received, reader.deserialize(raw, connection.msgtype))
                for connection, received, raw in reader.messages(connections=connections)
            ]
            name, kind = connections[0].topic, connections[0].msgtype
    except ThermorenderError:
        raise
    except Exception as error:  # the library raises whatever a damaged file leads to
        said = " ".join(str(error).split())[:120]
        raise ThermorenderError(
            f"{path} cannot be read as a bag of ROS 2 ({said or type(error).__name__}); copy it again, or give the "
            "folder with its metadata.yaml"
        ) from error
    where = f"{bag}#{name}"
    if not messages:
        raise ThermorenderError(f"{where}: the topic has no messages; give another one")
    notes = [] if kind == _FIX else [_axes(where, messages[0][1])]
    stamps = np.array([_seconds(message) for _, message in messages])
    if not stamps.any():
        stamps = np.array([received * 1e-9 for received, _ in messages])
        notes.append(f"{where}: the headers have no time, so that of recording is used")
    names = _FIX_COLUMNS if kind == _FIX else _POSE_COLUMNS
    rows = [_fix(message) if kind == _FIX else _pose(message, _POSES[kind]) for _, message in messages]
    columns = dict(zip(names, np.column_stack([stamps, np.array(rows, np.float64)]).T, strict=True))
    return [Table(where, dict(columns), np.arange(1, len(rows) + 1), "message", notes=tuple(notes))]


def _split(path: str) -> tuple[Path, str]:
    """The bag, and the topic after a # or ""."""
    if Path(path).exists():
        return Path(path), ""
    bag, _, topic = path.partition("#")
    # A path on Windows has backslashes.
    topic = topic.replace("\\", "/")
    if not Path(bag).exists():
        raise ThermorenderError(f"{bag} does not exist; give a bag of ROS 2: a folder, .mcap or .db3")
    return Path(bag), topic


def _chosen(path: str, connections: list[Any], topic: str) -> list[Any]:
    """The connections of the topic to read."""
    fitting = sorted({each.topic for each in connections if each.msgtype in (*_POSES, _FIX)})
    if topic in fitting or (not topic and len(fitting) == 1):
        return [each for each in connections if each.topic == (topic or fitting[0])]
    if not fitting:
        there = ", ".join(sorted({f"{each.topic} ({each.msgtype})" for each in connections})) or "no topic"
        kinds = ", ".join(kind.rpartition("/")[2] for kind in (*_POSES, _FIX))
        raise ThermorenderError(f"{path}: no topic is of {kinds}, but there is {there}; give another bag")
    what = f"topic {topic!r} is not one of poses or fixes" if topic else "several topics fit"
    raise ThermorenderError(
        f"{path}: {what}; name one after a #, such as {path.partition('#')[0]}#{fitting[0]} (there are "
        f"{', '.join(fitting)})"
    )


def _axes(where: str, message: Any) -> str:
    """What is taken for granted on the axes of poses; refuse frames whose names say otherwise."""
    for frame in (message.header.frame_id, getattr(message, "child_frame_id", "")):
        axes = next((axes for end, axes in _OTHER_AXES.items() if frame.lower().endswith(end)), None)
        if axes:
            raise ThermorenderError(
                f"{where}: the axes of frame {frame!r} are {axes}, and those of REP 103 are needed (world: x east, y "
                "north, z up; body: x forward, y left, z up); give a topic in such frames"
            )
    return (
        f"{where}: x of frame {message.header.frame_id!r} is taken as east, y as north and z as up, and x of the body "
        "as forward, as REP 103 has it"
    )


def _seconds(message: Any) -> float:
    stamp = message.header.stamp
    return float(stamp.sec) + 1e-9 * float(stamp.nanosec)


def _pose(message: Any, way: tuple[str, ...]) -> tuple[float, ...]:
    for name in way:
        message = getattr(message, name)
    place, turn = message.position, message.orientation
    return place.x, place.y, place.z, turn.w, turn.x, turn.y, turn.z


def _fix(message: Any) -> tuple[float, ...]:
    values = message.latitude, message.longitude, message.altitude
    return *values, float(message.status.status >= 0 and np.isfinite(values).all())
