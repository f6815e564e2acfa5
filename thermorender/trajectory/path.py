"""A camera's flight: timed positions and attitudes in the scene's frame.

Positions are interpolated linearly, attitudes by slerp. Nothing is extrapolated.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from thermorender.errors import ThermorenderError
from thermorender.numbers import parse_numbers
from thermorender.physics.geodesy import FARTHEST_M
from thermorender.trajectory.rotations import (
    BODY_FROM_CAMERA,
    ENU_FROM_NED,
    rotation_from_angles,
    rotation_from_wxyz,
    slerp,
    wxyz,
)
from thermorender.units import Number

# (east, north), each (N,) [m], to the ground's local up (N,) [m]; NaN off the terrain.
GroundHeight = Callable[[NDArray[np.float64], NDArray[np.float64]], ArrayLike]

# Largest deviation of a quaternion's length from 1, by digits lost in a log.
QUATERNION_TOLERANCE = 1e-3
# Deviation that normalising leaves.
_ROUNDING = 1e-15

# Frame numbers have six digits.
MOST_FRAMES = 1_000_000

# The first heading points to the first sample at least this far away; less can be the jitter of a receiver at rest.
MOVED_M = 1.0


@dataclass(frozen=True)
class Anchor:
    """The target of a moved flight: its first camera position and first heading."""

    # Scene coordinates of the first camera position [m]
    east: float
    north: float
    up: float  # Its height [m]: above the ground below it if the ground is known, otherwise local up
    heading_deg: float  # First heading, clockwise from north


@dataclass(frozen=True, eq=False)
class Trajectory:
    """A camera's path through the scene.

    Parameters
    ----------
    time_s : (N,) array
        Strictly increasing times [s].
    position : (N, 3) array
        Camera positions: local east, north, up [m].
    quaternion : (N, 4) array
        Unit quaternions (w, x, y, z) that rotate camera axes (x right, y down, z forward) to east, north, up.

    notes : tuple of str
        What a reader of logs dropped, corrected or assumed, in sentences.

    Raises
    ------
    ThermorenderError
        Shapes disagree, a value is not finite, time does not increase, or a quaternion's length is not 1 within 1e-3
        (smaller errors are normalised).
    """

    time_s: NDArray[np.float64]
    position: NDArray[np.float64]
    quaternion: NDArray[np.float64]
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        time_s, position, quaternion = (np.array(a, np.float64) for a in (self.time_s, self.position, self.quaternion))
        count = time_s.size
        if time_s.shape != (count,) or count < 1:
            raise ThermorenderError(f"time_s has shape {time_s.shape}; a trajectory needs (N,) with N ≥ 1")
        for name, array, width in (("position", position, 3), ("quaternion", quaternion, 4)):
            if array.shape != (count, width):
                raise ThermorenderError(f"{name} has shape {array.shape}; {count} times need ({count}, {width})")
        for name, array in (("time_s", time_s), ("position", position), ("quaternion", quaternion)):
            if not np.isfinite(array).all():
                bad = np.argwhere(~np.isfinite(array))[0][0]
                raise ThermorenderError(f"{name}: sample {bad} is {array[bad]}; all values must be finite")
        step = np.diff(time_s)
        if (step <= 0.0).any():
            k = int(np.argmax(step <= 0.0))
            raise ThermorenderError(
                f"time_s: sample {k + 1} at {time_s[k + 1]:.9g} s follows {time_s[k]:.9g} s: time is running "
                f"backwards or standing still, and must strictly increase"
            )
        with np.errstate(over="ignore"):
            length = np.linalg.norm(quaternion, axis=1)
        if (np.abs(length - 1.0) > QUATERNION_TOLERANCE).any():
            k = int(np.argmax(np.abs(length - 1.0) > QUATERNION_TOLERANCE))
            raise ThermorenderError(f"quaternion: sample {k} has length {length[k]:.6g}; unit quaternions are needed")
        # Rounded unit quaternions stay as they are, so that a trajectory of another's samples is the same.
        off = np.abs(length - 1.0) > _ROUNDING
        quaternion[off] /= length[off, None]
        for name, array in (("time_s", time_s), ("position", position), ("quaternion", quaternion)):
            array.flags.writeable = False
            object.__setattr__(self, name, array)

    def __len__(self) -> int:
        return self.time_s.size

    def __repr__(self) -> str:
        start, stop = self.span_s
        low, high = self.position.min(axis=0), self.position.max(axis=0)
        ranges = ", ".join(
            f"{name} {a:.1f}…{b:.1f} m" for name, a, b in zip(("east", "north", "up"), low, high, strict=True)
        )
        return f"Trajectory({len(self)} samples, {start:.3f}…{stop:.3f} s, {ranges})"

    @property
    def span_s(self) -> tuple[float, float]:
        """First and last time [s]."""
        return float(self.time_s[0]), float(self.time_s[-1])

    @cached_property
    def rotation(self) -> Rotation:
        """Attitudes, N rotations of SciPy from camera axes to east, north, up."""
        return rotation_from_wxyz(self.quaternion)

    @cached_property
    def _rotation_at(self) -> Callable[[ArrayLike], Rotation]:
        return slerp(self.time_s, self.rotation)

    def sampled(self, times_s: ArrayLike) -> "Trajectory":
        """Return the trajectory at other times (M,) [s], strictly increasing and within the span."""
        times = np.atleast_1d(np.asarray(times_s, np.float64))
        start, stop = self.span_s
        outside = ~((times >= start) & (times <= stop))
        if outside.any():
            raise ThermorenderError(
                f"time_s={times[outside][0]:.9g} is outside the trajectory, which spans {start:.9g} to "
                f"{stop:.9g} s and is not extrapolated"
            )
        position = np.stack([np.interp(times, self.time_s, self.position[:, k]) for k in range(3)], axis=-1)
        return Trajectory(times, position, wxyz(self._rotation_at(times)))

    def pose(self, time_s: float) -> NDArray[np.float64]:
        """Return the interpolated `world_from_camera`, (4, 4), at one time [s].

        Raises
        ------
        ThermorenderError
            The time is outside the span.
        """
        return self.sampled(float(time_s)).poses()[0]

    def poses(self) -> NDArray[np.float64]:
        """Return `world_from_camera` of every sample, (N, 4, 4)."""
        poses = np.tile(np.eye(4), (len(self), 1, 1))
        poses[:, :3, :3] = self.rotation.as_matrix()
        poses[:, :3, 3] = self.position
        return poses

    def frame_times(
        self, rate_hz: float, start_s: float | None = None, stop_s: float | None = None
    ) -> NDArray[np.float64]:
        """Return frame times, (M,) [s], at a fixed rate from start to stop.

        Parameters
        ----------
        rate_hz : float
            Frames per second.
        start_s, stop_s : float, optional
            Part of the span [s]; the whole span by default.
        """
        if not (np.isfinite(rate_hz) and rate_hz > 0.0):
            raise ThermorenderError(f"rate_hz={rate_hz} must be a positive number of frames per second")
        first, last = self.span_s
        start = first if start_s is None else float(start_s)
        stop = last if stop_s is None else float(stop_s)
        if not (first <= start <= stop <= last):
            raise ThermorenderError(
                f"start_s={start:.9g}, stop_s={stop:.9g}: start_s must not exceed stop_s, and both must be within the "
                f"trajectory's span, {first:.9g} to {last:.9g} s"
            )
        # 1e-6 of a frame keeps a last frame that rounding would push past the end.
        frames = np.floor((stop - start) * rate_hz + 1e-6) + 1
        if not frames <= MOST_FRAMES:
            step = np.diff(self.time_s)
            k = int(np.argmax(step)) if step.size else 0
            paused = ""
            if step.size and step[k] > 0.5 * (stop - start):
                paused = f", most of them in a pause of {step[k]:.9g} s after {self.time_s[k]:.9g} s"
            raise ThermorenderError(
                f"rate_hz={rate_hz:g} makes {frames:.4g} frames of {start:.9g} to {stop:.9g} s{paused}; up to "
                f"{MOST_FRAMES} are allowed: lower the rate, or fly a shorter part (start_s, stop_s)"
            )
        count = int(frames)
        return np.minimum(start + np.arange(count) / rate_hz, stop)

    @property
    def first_heading_deg(self) -> float:
        """Heading at the start, clockwise from north, in [0, 360) [deg].

        This is the direction from the first sample to the first one at least 1 m away horizontally. For a camera that
        never moves so far it is the horizontal direction of view or, looking straight up or down, of the image's upper
        edge.
        """
        away = self.position[:, :2] - self.position[0, :2]
        moved = np.hypot(*away.T) >= MOVED_M
        if moved.any():
            direction = away[np.argmax(moved)]
        else:
            axes = self.rotation[0].as_matrix()
            direction = axes[:2, 2] if np.hypot(*axes[:2, 2]) > 1e-6 else -axes[:2, 1]
        return float(np.degrees(np.arctan2(direction[0], direction[1])) % 360.0)

    def anchored(self, east: Number, north: Number, heading_deg: Number, up: Number | None = None) -> "Trajectory":
        """Return the trajectory moved to another position and rotated about up, its shape unchanged.

        Parameters
        ----------
        east, north : float
            New first camera position [m].
        heading_deg : float
            New first heading (see `first_heading_deg`), clockwise from north [deg].
        up : float, optional
            New local up of the first camera position [m]; by default heights do not change.
        """
        # Headings increase clockwise, rotations about up anticlockwise.
        turn = Rotation.from_euler("z", self.first_heading_deg - float(heading_deg), degrees=True)
        origin = self.position[0]
        target = np.array([east, north, origin[2] if up is None else up], np.float64)
        return Trajectory(self.time_s, turn.apply(self.position - origin) + target, wxyz(turn * self.rotation))

    def above_ground(self, ground: GroundHeight) -> NDArray[np.float64]:
        """Return the camera's height above the ground, (N,) [m]; NaN off the terrain.

        Parameters
        ----------
        ground : callable
            `ground(east, north)`: (N,) arrays [m] to the ground's local up, (N,) [m], NaN off the terrain.
        """
        return self.position[:, 2] - np.asarray(ground(self.position[:, 0], self.position[:, 1]), np.float64)


def check_above_ground(trajectory: Trajectory, ground: GroundHeight, minimum_m: float = 0.0) -> float:
    """Return the lowest height above ground at the samples [m] after refusing one below `minimum_m`.

    `trajectory.sampled(frame_times)` has the rendered frames. `ground` is as in `Trajectory.above_ground`; samples off
    the terrain are not checked.
    """
    height = trajectory.above_ground(ground)
    low = height < minimum_m
    if low.any():
        k = int(np.argmax(low))
        limit = "the ground" if minimum_m == 0.0 else f"the lowest height allowed, {minimum_m:g} m above ground"
        raise ThermorenderError(
            f"trajectory: at {trajectory.time_s[k]:.3f} s the camera is {minimum_m - height[k]:.2f} m below "
            f"{limit} ({int(low.sum())} of {len(trajectory)} samples are); check the height column's "
            "reference, raise the flight with an anchor (--anchor), or allow it to be below ground "
            "(--allow-below-ground)"
        )
    return float(np.nanmin(height)) if np.isfinite(height).any() else float("nan")


def parse_anchor(text: str) -> Anchor:
    """Return the `Anchor` of "E,N,U,heading" [m, m, m, deg clockwise from north]."""
    return Anchor(*parse_numbers("anchor", text, ("E", "N", "U", "heading")))


def parse_mount(text: str) -> tuple[float, ...]:
    """Return (yaw, pitch, roll) [deg] of "yaw,pitch,roll": the optical axis relative to the vehicle's body."""
    return parse_numbers("mount", text, ("yaw", "pitch", "roll"))


def parse_lever_arm(text: str) -> tuple[float, ...]:
    """Return (forward, right, down) [m] of "forward,right,down": the camera's position in the vehicle's body."""
    return parse_numbers("lever_arm", text, ("forward", "right", "down"))


def pose(
    east: Number, north: Number, up: Number, yaw_deg: Number = 0.0, pitch_deg: Number = 0.0, roll_deg: Number = 0.0,
    look_at: ArrayLike | None = None,
) -> NDArray[np.float64]:  # fmt: skip
    """Return world_from_camera, (4, 4), of a camera at a local position; `scene.pose` takes metres above the ground.

    Parameters
    ----------
    east, north, up : float
        Position in the scene's local frame [m].
    yaw_deg, pitch_deg, roll_deg : float
        Of the optical axis [deg]: heading clockwise from north, elevation above the horizon (at −90 the image's upper
        edge points to the heading), right side of the image down.
    look_at : (3,) floats, optional
        Local position of a point on the optical axis [m], in place of yaw and pitch. Straight above or below it,
        `yaw_deg` is still the heading.

    Raises
    ------
    ThermorenderError
        The position is more than 100 km from the scene's origin, or angles contradict `look_at`.
    """
    east, north, up, yaw_deg, pitch_deg = map(float, (east, north, up, yaw_deg, pitch_deg))
    if not max(abs(east), abs(north), abs(up)) <= FARTHEST_M:
        raise ThermorenderError(
            f"pose: east {east:g} m, north {north:g} m, up {up:g} m is more than {FARTHEST_M / 1e3:.0f} km from the "
            "scene's origin; give a position in the scene"
        )
    if look_at is not None:
        yaw_deg, pitch_deg = _towards((east, north, up), look_at, yaw_deg, pitch_deg)
    matrix = np.eye(4)
    attitude = rotation_from_angles(yaw_deg, pitch_deg, float(roll_deg)).as_matrix()
    matrix[:3, :3] = ENU_FROM_NED @ attitude @ BODY_FROM_CAMERA
    matrix[:3, 3] = east, north, up
    return matrix


def _towards(position: Sequence[float], point: ArrayLike, yaw_deg: float, pitch_deg: float) -> tuple[float, float]:
    """Return (yaw, pitch) [deg] of the direction from a position to a point; refuse other angles."""
    target = np.asarray(point, np.float64)
    if target.shape != (3,) or not np.isfinite(target).all():
        raise ThermorenderError(f"look_at={point!r} is not a point; give three finite numbers: east, north, up [m]")
    east, north, up = map(float, target - np.asarray(position, np.float64))
    level = float(np.hypot(east, north))
    if level == up == 0.0:
        raise ThermorenderError(f"look_at={point!r} is the camera's own position; give another point")
    # Below a micrometre the heading is rounding of the coordinates.
    vertical = level < 1e-6
    if pitch_deg or (yaw_deg and not vertical):
        raise ThermorenderError(
            f"look_at={point!r} sets yaw and pitch, and yaw_deg={yaw_deg:g}, pitch_deg={pitch_deg:g} were given too; "
            "leave these out"
        )
    yaw = yaw_deg if vertical else float(np.degrees(np.arctan2(east, north)))
    return yaw, float(np.degrees(np.arctan2(up, level)))
