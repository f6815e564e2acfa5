"""Flights as an MCAP file of ROS 2: thermal images, the camera's calibration, and its pose.

A pixel of the image (mono16) is the apparent temperature in steps of 10 mK from 0 K. Gazebo's thermal camera has
the same by default (gz-rendering, BaseThermalCamera.hh: 16 bits, linear resolution 0.01 K). Frames of reference are
those of REP 103: `map` is east, north, up; `thermal_optical` is right, down, along the view.
"""

from collections.abc import Sequence
from datetime import datetime, timezone
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from thermorender.errors import ThermorenderError
from thermorender.files import atomic
from thermorender.frame.exr import read_exr
from thermorender.trajectory.rotations import wxyz

STEP_K = 0.01
IMAGE, INFO, POSE = "/thermal/image_raw", "/thermal/camera_info", "/tf"
WORLD, CAMERA = "map", "thermal_optical"

_TIME = "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec"
_HEADER = "MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id"
# {type: its fields, then those of the types within}
_TYPES = {
    "sensor_msgs/msg/Image": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\n"
        "uint8[] data",
        _HEADER, _TIME,
    ),
    "sensor_msgs/msg/CameraInfo": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\nfloat64[] d\nfloat64[9] k\n"
        "float64[9] r\nfloat64[12] p\nuint32 binning_x\nuint32 binning_y\nsensor_msgs/RegionOfInterest roi",
        "MSG: sensor_msgs/RegionOfInterest\nuint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\n"
        "bool do_rectify",
        _HEADER, _TIME,
    ),
    "tf2_msgs/msg/TFMessage": (
        "geometry_msgs/TransformStamped[] transforms",
        "MSG: geometry_msgs/TransformStamped\nstd_msgs/Header header\nstring child_frame_id\n"
        "geometry_msgs/Transform transform",
        "MSG: geometry_msgs/Transform\ngeometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation",
        "MSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z",
        "MSG: geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w",
        _HEADER, _TIME,
    ),
}  # fmt: skip


def check_mcap(first_s: float, absolute: bool) -> None:
    """Refuse, before a flight, what cannot be written: a missing library, or a first frame before 0 [s]. `absolute`:
    the flight has a date, which the file then gives."""
    _ = _library()
    if first_s < 0.0 and not absolute:
        raise ThermorenderError(
            f"the first frame is at {first_s:g} s, and product 'mcap' has no times before 0; give start_s=0, or a "
            "scene with the time in its [weather]"
        )


def write_mcap(path: str | PathLike[str], frames: Sequence[Path]) -> None:
    """Write EXR files of a flight's frames, in order, as an MCAP file."""
    writer_of = _library()
    with atomic(path) as part, open(part, "wb") as file:
        writer = writer_of(file)
        line = "\n" + "=" * 80 + "\n"
        types = {name: writer.register_msgdef(name, line.join(parts)) for name, parts in _TYPES.items()}
        for each in frames:
            channels, record = read_exr(each)
            stamp = _stamp(record)
            log = stamp["sec"] * 1_000_000_000 + stamp["nanosec"]
            messages = (
                (POSE, "tf2_msgs/msg/TFMessage", _pose(record, stamp)),
                (INFO, "sensor_msgs/msg/CameraInfo", _info(record, stamp)),
                (IMAGE, "sensor_msgs/msg/Image", _image(channels["apparent_temperature"], stamp)),
            )
            for topic, kind, message in messages:
                writer.write_message(topic, types[kind], message, log, log, record["index"])
        writer.finish()


def _stamp(record: dict[str, Any]) -> dict[str, int]:
    """Time of a frame: since 1970 in UTC, or without a date since the flight's own zero."""
    if record["time"] is None:
        total = round(record["time_s"] * 1e9)
    else:
        start = datetime.fromisoformat(record["time"].removesuffix("Z")).replace(tzinfo=timezone.utc)
        since = start - datetime(1970, 1, 1, tzinfo=timezone.utc)
        total = (since.days * 86400 + since.seconds) * 1_000_000_000 + since.microseconds * 1000
    return {"sec": total // 1_000_000_000, "nanosec": total % 1_000_000_000}


def _image(kelvin: Any, stamp: dict[str, int]) -> dict[str, Any]:
    counts = np.clip(np.round(np.nan_to_num(kelvin) / STEP_K), 0, 65535).astype("<u2")
    height, width = counts.shape
    return {
        "header": {"stamp": stamp, "frame_id": CAMERA}, "height": height, "width": width, "encoding": "mono16",
        "is_bigendian": 0, "step": 2 * width, "data": counts.tobytes(),
    }  # fmt: skip


def _info(record: dict[str, Any], stamp: dict[str, int]) -> dict[str, Any]:
    lens = record["lens"]
    width, height = lens["width"], lens["height"]
    focal = 1000.0 * lens["focal_length_mm"] / lens["pixel_pitch_um"]
    # ROS counts pixels from the middle of the first one.
    across, down = (
        n / 2 - 0.5 + offset for n, offset in zip((width, height), lens["principal_offset_px"], strict=True)
    )
    return {
        "header": {"stamp": stamp, "frame_id": CAMERA}, "height": height, "width": width,
        "distortion_model": "plumb_bob", "d": list(lens["distortion"]),
        "k": [focal, 0.0, across, 0.0, focal, down, 0.0, 0.0, 1.0],
        "r": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        "p": [focal, 0.0, across, 0.0, 0.0, focal, down, 0.0, 0.0, 0.0, 1.0, 0.0], "binning_x": 0, "binning_y": 0,
        "roi": {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False},
    }  # fmt: skip


def _pose(record: dict[str, Any], stamp: dict[str, int]) -> dict[str, Any]:
    pose = np.asarray(record["world_from_camera"])
    turn = zip("wxyz", wxyz(Rotation.from_matrix(pose[:3, :3])).tolist(), strict=True)
    transform = {"translation": dict(zip("xyz", pose[:3, 3].tolist(), strict=True)), "rotation": dict(turn)}
    header = {"stamp": stamp, "frame_id": WORLD}
    return {"transforms": [{"header": header, "child_frame_id": CAMERA, "transform": transform}]}


def _library() -> Any:
    try:
        from mcap_ros2.writer import Writer
    except ImportError:
        raise ThermorenderError(
            "product 'mcap' needs mcap-ros2-support, which is not installed; run `pip install 'thermorender[ros]'`"
        ) from None
    return Writer
