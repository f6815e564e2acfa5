"""Attitudes of vehicles and cameras as rotations of SciPy: aviation angles, axis conventions and interpolation.

*Body* axes are x forward, y right, z down (FRD); *NED* north, east, down at the vehicle; *camera* x right, y down, z
forward along the optical axis.
"""

import warnings
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation, Slerp

from thermorender.errors import ThermorenderError

# Columns: the source's x, y and z axes in the target's.
ENU_FROM_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
BODY_FROM_CAMERA = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def rotation_from_angles(yaw_deg: ArrayLike, pitch_deg: ArrayLike, roll_deg: ArrayLike) -> Rotation:
    """Return the rotation from body FRD axes to NED axes for aviation angles, scalars or (N,) [deg].

    Intrinsic rotations: yaw clockwise from north, pitch nose up, roll right side down. At pitch ±90° only the sum or
    difference of yaw and roll counts.
    """
    angles = np.stack(np.broadcast_arrays(*(np.asarray(a, np.float64) for a in (yaw_deg, pitch_deg, roll_deg))), -1)
    return Rotation.from_euler("ZYX", angles, degrees=True)


def angles_from_rotation(rotation: Rotation) -> NDArray[np.float64]:
    """Return (yaw, pitch, roll) [deg], (3,) or (N, 3), as of `rotation_from_angles`; roll is 0 at pitch ±90°."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Gimbal lock detected", UserWarning)
        return rotation.as_euler("ZYX", degrees=True)


def checked_pose(pose: ArrayLike) -> NDArray[np.float64]:
    """Return a pose as (4, 4) float64; raise if it is not a rigid transform."""
    pose = np.array(pose, dtype=np.float64)
    if pose.shape != (4, 4) or not np.isfinite(pose).all() or not np.allclose(pose[3], [0, 0, 0, 1]):
        raise ThermorenderError(
            f"pose of shape {pose.shape} is not a world_from_camera; give (4, 4) with last row 0 0 0 1"
        )
    rotation = pose[:3, :3]
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4) or np.linalg.det(rotation) < 0.0:
        raise ThermorenderError(
            "pose has a rotation that is not orthonormal and right-handed; normalise its quaternion"
        )
    return pose


def rotation_from_wxyz(quaternion: ArrayLike) -> Rotation:
    """Return the rotation of quaternions, (..., 4) in the order (w, x, y, z); they are normalised."""
    return Rotation.from_quat(np.roll(np.asarray(quaternion, np.float64), -1, axis=-1))


def wxyz(rotation: Rotation) -> NDArray[np.float64]:
    """Return unit quaternions, (..., 4) in the order (w, x, y, z), with w ≥ 0."""
    return np.roll(rotation.as_quat(canonical=True), 1, axis=-1)


def ecef_from_ned(latitude_deg: ArrayLike, longitude_deg: ArrayLike) -> Rotation:
    """Return the rotations from local NED axes to ECEF at geodetic coordinates, (N,) [deg]."""
    lat, lon = (
        np.radians(np.asarray(latitude_deg, np.float64)),
        np.radians(np.asarray(longitude_deg, np.float64)),
    )
    sl, cl, so, co = np.sin(lat), np.cos(lat), np.sin(lon), np.cos(lon)
    north = np.stack([-sl * co, -sl * so, cl], axis=-1)
    east = np.stack([-so, co, np.zeros_like(so)], axis=-1)
    down = np.stack([-cl * co, -cl * so, -sl], axis=-1)
    return Rotation.from_matrix(np.stack([north, east, down], axis=-1))


def slerp(time_s: NDArray[np.float64], rotation: Rotation) -> Callable[[ArrayLike], Rotation]:
    """Return the spherical linear interpolation of N attitudes at increasing `time_s`, a function of time [s].

    It follows the shorter rotation (K. Shoemake, SIGGRAPH 1985, doi:10.1145/325334.325242); one attitude is constant.
    """
    if len(time_s) == 1:
        return lambda at_s: rotation[np.zeros(np.shape(at_s), np.intp)]
    return Slerp(time_s, rotation)
