"""A scene and the poses of a comparison."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermorender.scene.scene import Scene
from thermorender.trajectory import Trajectory


@dataclass(frozen=True)
class Flight:
    """A scene and the poses from which it is seen."""

    scene: Scene
    times: NDArray[np.float64]  # (P,) [s]
    poses: NDArray[np.float64]  # (P, 4, 4) world_from_camera

    @classmethod
    def of(
        cls,
        scene: Scene,
        trajectory: Trajectory,
        rate_hz: float = 1.0,
        start_s: float | None = None,
        stop_s: float | None = None,
    ) -> "Flight":
        """Return the Flight of a Trajectory, or of a part of it [s], with `rate_hz` poses per second."""
        times = trajectory.frame_times(rate_hz, start_s, stop_s)
        return cls(scene, times, trajectory.sampled(times).poses())
