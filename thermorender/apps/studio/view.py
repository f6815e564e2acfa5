"""What a tab looks at: a pose that a hand can turn, and what is shown of it."""

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from thermorender.errors import ThermorenderError
from thermorender.materials.csv_tables import decimal
from thermorender.numbers import parse_numbers
from thermorender.trajectory.path import pose as local_pose
from thermorender.trajectory.rotations import BODY_FROM_CAMERA, ENU_FROM_NED, angles_from_rotation

if TYPE_CHECKING:
    from thermorender import Scene

POSE_PARTS = ("E", "N", "U", "YAW", "PITCH", "ROLL")
Limits = tuple[float | None, float | None]  # of colours, each of which may be free
_LEAST_ABOVE_M, _NEAREST_M, _FARTHEST_M = 2.0, 5.0, 20_000.0
_STEEPEST_DEG, _FLATTEST_DEG = -90.0, 5.0


@dataclass(frozen=True)
class Pose:
    """A camera's local position [m] and angles [deg], and the distance of the point it turns around [m]."""

    east: float
    north: float
    up: float
    yaw_deg: float
    pitch_deg: float
    roll_deg: float
    distance_m: float

    @classmethod
    def typed(cls, text: str, scene: "Scene", where: str = "pose") -> "Pose":
        """Return the Pose of E,N,U,YAW,PITCH,ROLL, with U above the ground, as `--pose` on the command line; outside
        the terrain, above its nearest point.
        """
        east, north, above, *angles = parse_numbers(where, text, POSE_PARTS)
        if on_terrain(scene, east, north) or above < 0.0:
            return cls.seen(scene.pose(east, north, above, angles[0], angles[1], angles[2]), scene)
        low, high = _bounds(scene)
        away = float(np.hypot(*(np.clip((east, north), low, high) - (east, north))))
        if away > _FARTHEST_M:
            raise ThermorenderError(
                f"{where}={text!r} is {away / 1000.0:.4g} km outside the terrain; give an E,N within "
                f"{_FARTHEST_M / 1000.0:g} km of it"
            )
        up = above + cls._ground(scene, east, north)
        return cls.seen(local_pose(east, north, up, angles[0], angles[1], angles[2]), scene)

    @classmethod
    def seen(cls, matrix: NDArray[np.float64], scene: "Scene") -> "Pose":
        """Return the Pose of a world_from_camera."""
        turned = Rotation.from_matrix(ENU_FROM_NED.T @ matrix[:3, :3] @ BODY_FROM_CAMERA.T)
        yaw, pitch, roll = (float(angle) for angle in angles_from_rotation(turned))
        east, north, up = (float(v) for v in matrix[:3, 3])
        made = cls(east, north, up, yaw % 360.0, pitch, roll, 200.0)
        return replace(made, distance_m=made._to_ground(scene))

    def matrix(self) -> NDArray[np.float64]:
        """Return world_from_camera, (4, 4)."""
        return local_pose(self.east, self.north, self.up, self.yaw_deg, self.pitch_deg, self.roll_deg)

    def text(self, scene: "Scene") -> str:
        """Return E,N,U,YAW,PITCH,ROLL with U above the ground, which `typed` reads."""
        above = self.up - self._ground(scene, self.east, self.north)
        return numbers_text(self.east, self.north, above, self.yaw_deg, self.pitch_deg, self.roll_deg)

    def orbited(self, right_deg: float, up_deg: float, zoom: float, scene: "Scene") -> "Pose":
        """Return the Pose turned around the point in the middle of the picture, at `zoom` times the distance."""
        steepest, flattest = min(_STEEPEST_DEG, self.pitch_deg), max(_FLATTEST_DEG, self.pitch_deg)
        other = replace(
            self, yaw_deg=(self.yaw_deg + right_deg) % 360.0,
            pitch_deg=float(np.clip(self.pitch_deg + up_deg, steepest, flattest)),
            distance_m=float(np.clip(self.distance_m * zoom, _NEAREST_M, _FARTHEST_M)),
        )  # fmt: skip
        target = self.matrix()[:3, 3] + self.distance_m * self.matrix()[:3, 2]
        east, north, up = (float(v) for v in target - other.distance_m * other.matrix()[:3, 2])
        return replace(other, east=east, north=north, up=up)._above(scene)

    def moved(self, right: float, down: float, scene: "Scene") -> "Pose":
        """Return the Pose after a pan along the ground, by shares of the distance."""
        yaw = np.radians(self.yaw_deg)
        east = self.distance_m * (-right * np.cos(yaw) + down * np.sin(yaw))
        north = self.distance_m * (right * np.sin(yaw) + down * np.cos(yaw))
        return replace(self, east=self.east + float(east), north=self.north + float(north))._above(scene)

    def _above(self, scene: "Scene") -> "Pose":
        least = self._ground(scene, self.east, self.north) + _LEAST_ABOVE_M
        return replace(self, up=max(self.up, least))

    def _to_ground(self, scene: "Scene") -> float:
        axis, distance = self.matrix()[:3, 2], 200.0
        if axis[2] > -0.05:
            return distance
        for _ in range(3):
            ground = self._ground(scene, self.east + distance * axis[0], self.north + distance * axis[1])
            distance = float(np.clip((self.up - ground) / -axis[2], _NEAREST_M, _FARTHEST_M))
        return distance

    @staticmethod
    def _ground(scene: "Scene", east: float, north: float) -> float:
        """The height of the terrain at a place, or at the nearest point of it [m]."""
        ground = float(scene.ground(east, north))
        if ground != ground:
            low, high = _bounds(scene)
            # The terrain ends at these bounds, and may not reach its very corners.
            middle, place = 0.5 * (low + high), np.clip((east, north), low, high)
            for inward in (1e-6, 1e-3, 1e-2):
                ground = float(scene.ground(*(place + inward * (middle - place))))
                if ground == ground:
                    break
        return ground if ground == ground else 0.0


def numbers_text(*numbers: float) -> str:
    """Return numbers to a tenth, between commas."""
    return ",".join((text if (text := f"{number:.1f}") != "-0.0" else "0.0").removesuffix(".0") for number in numbers)


def on_terrain(scene: "Scene", east: float, north: float) -> bool:
    """Return whether there is terrain at a place."""
    return bool(np.isfinite(scene.ground(east, north)))


def _bounds(scene: "Scene") -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The least and greatest (east, north) of the terrain [m]."""
    corner = [surface.vertices[:, :2] for surface in scene.near_ground]
    low = np.min([each.min(axis=0) for each in corner], axis=0).astype(np.float64)
    return low, np.max([each.max(axis=0) for each in corner], axis=0).astype(np.float64)


@dataclass(frozen=True)
class View:
    """A pose, what is shown of it, and how its picture is drawn."""

    pose: Pose
    time_s: float = 0.0  # On the tracks of moving objects [s]
    plan: bool = False  # Straight from above, instead of by the camera
    layer: str = "apparent"  # One of `layers.LAYERS`
    # "", or what it is compared with: "saved", "version 3" or "hour 14.5"
    against: str = ""
    slider: bool = False  # Both side by side, instead of their difference
    palette: str = "ironbow"
    # Fixed ends of the colours; None: as the picture needs
    limits: Limits | None = None

    @property
    def place(self) -> tuple[Pose, float, bool]:
        """What is the same for views that see the same places in the same pixels."""
        return self.pose, self.time_s, self.plan


def parsed_hour(text: str) -> float:
    """Return a solar hour, 0 to 24, from a text."""
    try:
        hour = decimal(text)
    except ValueError:
        hour = math.nan
    if not 0.0 <= hour <= 24.0:
        raise ThermorenderError(f"hour={text!r} is not a solar hour; give a number from 0 to 24, such as 14.5")
    return hour


def limits_of(low: str, high: str) -> Limits | None:
    """Return the fixed ends of the colours from two texts, of which an empty one is no fixed end; None for none."""
    try:
        # As many digits as the address and the fields show.
        ends = [float(f"{decimal(text):.6g}") if text.strip() else None for text in (low, high)]
    except ValueError:
        raise ThermorenderError(
            f"range={low!r}…{high!r} is not two numbers; give ends in the unit of the bar, or leave them empty"
        ) from None
    given = [end for end in ends if end is not None]
    if not np.isfinite(given).all() or given != sorted(set(given)):
        raise ThermorenderError(f"range={low}…{high} is not in order; give the lower end first, and finite numbers")
    return (ends[0], ends[1]) if given else None
