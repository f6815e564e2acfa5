"""The frames of a flight in order: functions of path, scene and the sensor's state after the frame before."""

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from thermorender import defaults
from thermorender.errors import ThermorenderError, shortened
from thermorender.frame.frame import Audited, Frame
from thermorender.render.flight.timed import InstantRenderer, InstantRendererT, TimedRenderer
from thermorender.scene.scene import Scene
from thermorender.scene.tracks import TrackedObject
from thermorender.sensor.camera import Camera
from thermorender.sensor.chain import in_sequence, sensor_of
from thermorender.sensor.detector import forgotten_s, row_delays
from thermorender.sensor.exposure import Exposure
from thermorender.sensor.movers import Mover
from thermorender.trajectory.path import Trajectory

if TYPE_CHECKING:
    from thermorender.render.dynamic import Objects

# Poses of instants in memory.
_POSES_KEPT = 64


class FlightFrames:
    """The frames of a flight.

    Parameters
    ----------
    renderer : Renderer
        Of the trajectory's first instant.
    trajectory : Trajectory
    rate_hz : float or None
        Frames per second; None: the camera's.
    start_s, stop_s : float or None
        Part of the trajectory's time [s]; None: from its start, to its end.
    progress : callable, optional
        Called with (what, share done) while a heat balance is solved.
    audit : int
        The error budget is measured in frames whose number is a multiple of this; frames between carry it.

    Attributes
    ----------
    times : (N,) float64
        Of the frames [s].
    poses : (N, 4, 4) float64
    timed : TimedRenderer
    exposure : Exposure
        The sensor after the frame that was taken last.

    Raises
    ------
    ThermorenderError
        Times outside the trajectory, weather that ends before it, a camera above the range of the air or above its
        clouds, or an `audit` below 1.
    """

    def __init__(
        self, renderer: InstantRenderer, trajectory: Trajectory, rate_hz: float | None = None,
        start_s: float | None = None, stop_s: float | None = None,
        progress: Callable[[str, float], object] | None = None, audit: int = defaults.AUDIT,
    ) -> None:  # fmt: skip
        if audit < 1:
            raise ThermorenderError(f"audit={audit} is not allowed; give 1 for every frame, or more")
        if not isinstance(trajectory, Trajectory):
            raise ThermorenderError(
                f"trajectory={shortened(repr(trajectory))} is not a Trajectory; give what load_trajectory returns"
            )
        self._renderer, self._trajectory = renderer, trajectory
        self._part = rate_hz, start_s, stop_s
        self.rate_hz = renderer.scene.camera.frame_rate_hz if rate_hz is None else float(rate_hz)
        self.times = trajectory.frame_times(self.rate_hz, start_s, stop_s)
        self.poses = trajectory.sampled(self.times).poses()
        renderer.refuse_camera(self.poses[:, :3, 3])
        self.timed = TimedRenderer(renderer, *trajectory.span_s, progress)
        self.exposure = self._exposure()
        self._audit = audit
        # The frame that was audited last.
        self._audited: Frame | Audited | None = None

    def by(self, renderer: InstantRenderer) -> "FlightFrames":
        """Return the frames of this flight, from its start, by another renderer of its first instant."""
        return FlightFrames(renderer, self._trajectory, *self._part, audit=self._audit)

    def __reduce__(self) -> tuple[Any, ...]:
        return FlightFrames, (self._renderer, self._trajectory, *self._part, None, self._audit)

    def __len__(self) -> int:
        return len(self.times)

    def __repr__(self) -> str:
        first, last = self.times[0], self.times[-1]
        return f"FlightFrames({len(self)} frames, {first:.3f}…{last:.3f} s, {self.rate_hz:g} Hz, {self._renderer!r})"

    def __iter__(self) -> Iterator[Frame]:
        """Take all frames from the first, with the sensor as it is before a flight."""
        self.exposure = self._exposure()
        for index in range(len(self)):
            yield self.take(index)

    def take(self, index: int) -> Frame:
        """Return one frame with the sensor's reading; frames come in order."""
        if isinstance(self._audited, Frame):
            # A view takes much memory.
            self._audited = self._audited.audit
        time_s = float(self.times[index])
        frame = self.still(index)
        frame = frame.with_reading(*self.exposure.read(index, time_s, frame.radiance))
        first = index - index % self._audit
        if index == first:
            self._audited = frame
            return frame
        # A flight may be continued between two audits.
        if self._audited is None or self._audited.index != first:
            self._audited = self.still(first)
        return frame.with_audit(self._audited)

    def still(self, index: int) -> Frame:
        """Return one frame, in any order, with the reading of a camera at rest."""
        time_s = float(self.times[index])
        frame = self.timed.at(time_s).frame(self.poses[index], time_s=time_s, index=index)
        return replace(frame, time=self.timed.time(time_s))

    def start(self, first: int) -> None:
        """Bring the sensor to its state before a frame, through the radiance of the frames from `warm_up` on."""
        self.exposure = self._exposure()
        for index in range(self.warm_up(first), first):
            time_s, unread = float(self.times[index]), np.empty((0, 0), np.float32)
            radiance = unread if self._frozen(index) else self.timed.at(time_s).radiance(self.poses[index], time_s)
            self.exposure.read(index, time_s, radiance)

    def warm_up(self, first: int) -> int:
        """Return the frame at which a sensor at rest starts to have, before a frame, its state of the flight.

        The frames between last as long as pixels remember (`thermorender.sensor.detector.forgotten_s`). Frames that a
        flat-field correction freezes do not count, since the frame before them is shown in their place.
        """
        camera = self._renderer.scene.camera
        left = int(np.ceil((forgotten_s(camera) + np.ptp(row_delays(camera, 1.0 / self.rate_hz))) * self.rate_hz))
        while first > 0 and left > 0:
            first -= 1
            left -= not self._frozen(first)
        return first

    def _frozen(self, index: int) -> bool:
        return in_sequence(self._renderer.scene.camera, index, index * (1.0 / self.rate_hz)).frozen

    def _exposure(self) -> Exposure:
        """The sensor with its state from frame to frame."""
        # A frame asks for the pose of each of its instants several times.
        pose_at = lru_cache(maxsize=_POSES_KEPT)(partial(pose_within, self._trajectory))
        movers = movers_of(self._renderer.scene, lambda time_s: {}, {})
        return exposure_of(self.timed, pose_at, 1.0 / self.rate_hz, movers)


def pose_within(trajectory: Trajectory, time_s: float) -> NDArray[np.float64]:
    """Return the pose of a trajectory at a time [s], (4, 4); beyond its ends that of the end."""
    first, last = trajectory.span_s
    return trajectory.pose(min(max(time_s, first), last))


def exposure_of(
    timed: TimedRenderer[InstantRendererT], pose_at: Callable[[float], NDArray[np.float64]], interval_s: float,
    movers: Sequence[Mover], objects_at: Callable[[float], "Objects"] = lambda time_s: {},
) -> Exposure:  # fmt: skip
    """Return the sensor of a flight, as it is before the first frame. `pose_at` maps time [s] to world_from_camera (4,
    4), `interval_s` is the frame interval [s], `movers` are from `movers_of`, and `objects_at` maps time [s] to values
    of dynamic objects that replace those of their tracks."""
    first = timed.first

    def radiance_at(
        time_s: float, camera: Camera, lit_s: float, only: NDArray[np.bool_] | None = None
    ) -> NDArray[np.float32]:  # fmt: skip
        return timed.at(time_s).radiance(
            pose_at(time_s), time_s, objects_at(time_s), camera=camera, lit_s=lit_s, lit_objects=objects_at(lit_s),
            only=only,
        )  # fmt: skip

    return Exposure(
        sensor_of(first.scene.camera, first.seed),
        radiance_at,
        pose_at,
        first.depth,
        interval_s,
        movers=movers,
    )


def movers_of(
    scene: Scene, objects_at: Callable[[float], "Objects"], times_s: Mapping[str, NDArray[np.float64]]
) -> list[Mover]:
    """Return the dynamic objects of a scene as Movers of the sensor. `objects_at` is as in `exposure_of`; `times_s` is
    {object: (n,) rising times between which its values are linear [s]}."""
    return [
        _mover(tracked, scene, objects_at, np.union1d(tracked.time_s, times_s.get(tracked.name, [])))
        for tracked in scene.tracked_objects
    ]


def _mover(
    tracked: TrackedObject, scene: Scene, objects_at: Callable[[float], "Objects"], times_s: NDArray[np.float64]
) -> Mover:
    corner = np.concatenate([surface.vertices for surface in tracked.surfaces]).astype(np.float64)
    box = np.array(list(itertools.product(*zip(corner.min(axis=0), corner.max(axis=0), strict=True))))

    def values_at(time_s: float) -> dict[str, float]:
        return tracked.at(time_s, **objects_at(time_s).get(tracked.name, {}))

    def corners_at(time_s: float) -> NDArray[np.float64]:
        pose = tracked.world_from_own(values_at(time_s), scene.ground)
        return box @ pose[:3, :3].T + pose[:3, 3]

    return Mover(corners_at, lambda time_s: values_at(time_s)["temperature_k"], times_s)
