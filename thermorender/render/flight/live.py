"""The frames of a flight whose path is known only up to now, as a simulator gives it step by step.

A frame equals that of `FlightFrames` to the byte if the path reaches `LiveFrames.ahead_s` beyond its time. Beyond its
last sample the path stands still. Only the part that the sensor's memory needs is kept.
"""

import weakref
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Generic

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError
from thermorender.frame import Frame
from thermorender.physics.geodesy import FARTHEST_M
from thermorender.render.flight.frames import exposure_of, movers_of, pose_within
from thermorender.render.flight.timed import STEP_S, InstantRendererT, TimedRenderer
from thermorender.sensor.detector import row_delays
from thermorender.sensor.movers import Mover
from thermorender.sensor.schedule import past_s
from thermorender.trajectory.path import Trajectory
from thermorender.units import utc_text

# Part of a path kept from before the sensor's memory [s].
_MARGIN_S = 0.1
# Most samples of a path, and values of an object, that are kept.
MOST_SAMPLES = 65_536
# Latest time: floating point still separates 0.1 ms, and clocks that count in ms or finer are beyond [s].
LATEST_S = 1e11
# Highest rate, and the inverse of the lowest [Hz].
_MOST_HZ = 1e6
# One value of a dynamic object: (name of the object, time [s], {column of its track: value}).
ObjectSample = tuple[str, float, Mapping[str, float]]


class LiveFrames(Generic[InstantRendererT]):
    """Frames of a camera whose path arrives piece by piece.

    Parameters
    ----------
    renderer : Renderer
        Of the first instant.
    rate_hz : float or None
        Frames per second; None: the camera's. It gives the number of a frame, and limits the read-out's time.
    audit : int
        Frames from one measurement of the error budget to the next; 0 measures the first frame only.
    allow_below_ground : bool
        Take frames from under the terrain.

    Attributes
    ----------
    rate_hz : float
    last : Frame or None
        The frame taken last.
    half_readout_s : float
        From a frame's time to the read-out of its last row [s].
    ahead_s : float
        Time beyond the frame's on which a frame depends at most [s]: half a read-out, and with dynamic objects the time
        over which the sensor may move images.

    Raises
    ------
    ThermorenderError
        A rate that is not a positive number, or an `audit` below 0.
    """

    def __init__(
        self, renderer: InstantRendererT, rate_hz: float | None = None, audit: int = 0, allow_below_ground: bool = False
    ) -> None:
        self.rate_hz = renderer.scene.camera.frame_rate_hz if rate_hz is None else float(rate_hz)
        if not 1.0 / _MOST_HZ <= self.rate_hz <= _MOST_HZ:
            raise ThermorenderError(
                f"rate_hz={rate_hz} is not allowed; give frames per second, {1.0 / _MOST_HZ:g} to {_MOST_HZ:g}"
            )
        if audit < 0:
            raise ThermorenderError(f"audit={audit} is not allowed; give 1 for every frame, more, or 0 for the first")
        self._renderer, self._audit, self._below = renderer, audit, allow_below_ground
        self._path: Trajectory | None = None
        self._given: dict[str, dict[str, tuple[list[float], list[float]]]] = {}
        self._timed: TimedRenderer[InstantRendererT] | None = None
        self._last_s = np.inf
        self._movers: list[Mover] = []
        self._audited: Frame | None = None
        self._first_s = 0.0
        self.last: Frame | None = None
        camera = renderer.scene.camera
        self.half_readout_s = self.ahead_s = float(row_delays(camera, 1.0 / self.rate_hz)[-1])
        if renderer.scene.tracked_objects:
            # Length of the sensor's memory; the part that an object changes is searched as far ahead.
            self.ahead_s = 3.0 * self.half_readout_s + past_s(camera)

    def __repr__(self) -> str:
        taken = "no frame yet" if self.last is None else f"frame {self.last.index} at {self.last.time_s:g} s"
        return f"LiveFrames({taken}, {self.rate_hz:g} Hz, {self._renderer!r})"

    @property
    def index(self) -> int:
        """Number of the frame taken last, −1 before the first."""
        return -1 if self.last is None else self.last.index

    def take(
        self, time_s: float, path: Trajectory | None = None, objects: Sequence[ObjectSample] = (), reading: bool = True
    ) -> Frame:
        """Return the frame of one time, after the frames before it.

        Nothing changes if it raises.

        Parameters
        ----------
        time_s : float
            After that of the frame before [s].
        path : Trajectory, optional
            The next samples of the path, after those given before; together they reach `time_s`.
        objects : sequence of (name, time [s], {column: value})
            The next values of dynamic objects, rising in time for each object. Values between two times are linear;
            before the first and after the last they are constant. Columns that are never given follow the object's
            track.
        reading : bool
            Whether the detector reads this frame. Its pixels continue from the last frame that was read.

        Raises
        ------
        ThermorenderError
            Time runs backwards, the path does not reach `time_s`, is under the terrain or too far from the scene, the
            weather ends before it, or an object is unknown or leaves the terrain.
        """
        time_s = float(time_s)
        whole = self._joined(time_s, path)
        given = self._with(objects)
        if not whole.span_s[0] <= time_s <= whole.span_s[1]:
            raise ThermorenderError(
                f"time_s={time_s:.9g} is outside the path, which spans {whole.span_s[0]:.9g} to "
                f"{whole.span_s[1]:.9g} s; give its samples up to the frame's time"
            )
        if self._timed is None:
            self._start(whole.span_s[0])
        timed = self._timed
        assert timed is not None
        if time_s > self._last_s:
            raise ThermorenderError(
                f"time_s={time_s:.9g} is after the weather of the scene, which ends at {self._last_s:.9g} s "
                f"({utc_text(self._renderer.scene.weather.time[-1])}); stop there, or give longer weather"
            )
        pose = whole.pose(time_s)
        height = float(whole.sampled(time_s).above_ground(self._renderer.scene.ground)[0])
        if height < 0.0 and not self._below:
            raise ThermorenderError(
                f"time_s={time_s:.9g}: the camera is {-height:.2f} m under the terrain; give a higher position, or "
                "allow frames from below the ground"
            )
        # The closures of the sensor see these from here on.
        before = self._path, self._given, self._exposure.pixels, self._exposure.last_counts
        self._path, self._given = whole, given
        try:
            frame = self._taken(timed, time_s, pose, reading)
        except BaseException:
            self._path, self._given, self._exposure.pixels, self._exposure.last_counts = before
            raise
        if self.last is None:
            self._first_s = time_s
        self.last = frame
        self._forget(time_s)
        return frame

    def add(self, time_s: float, path: Trajectory | None = None, objects: Sequence[ObjectSample] = ()) -> None:
        """Add the next samples of a path and of objects without taking the frame of `time_s`; arguments as of `take`.

        Nothing changes if it raises.

        Raises
        ------
        ThermorenderError
            As of `take`, for times and samples.
        """
        whole, given = self._joined(float(time_s), path), self._with(objects)
        if self._timed is None:
            self._start(whole.span_s[0])
        self._path, self._given = whole, given
        self._forget(min(float(time_s), whole.span_s[1]))

    def _joined(self, time_s: float, path: Trajectory | None) -> Trajectory:
        """The path with its next samples."""
        _refuse_time(time_s, "time_s")
        if self.last is not None and time_s <= self.last.time_s:
            raise ThermorenderError(
                f"time_s={time_s:.9g} does not follow the frame before, at {self.last.time_s:.9g} s; time must rise, "
                "and a simulation that starts again opens another session"
            )
        if path is not None:
            _refuse_time(float(path.time_s[np.abs(path.time_s).argmax()]), "path: time_s")
            far = ~(np.abs(path.position).max(axis=1) <= FARTHEST_M)
            if far.any():
                place = ", ".join(f"{each:.6g}" for each in path.position[far][0])
                raise ThermorenderError(
                    f"position: [{place}] m is more than {FARTHEST_M / 1e3:.0f} km from the scene's origin; give east, "
                    "north, up in the scene's frame"
                )
        if self._path is None or path is None:
            whole = path or self._path
            if whole is None:
                raise ThermorenderError("the path is empty; give at least one sample of it with the first frame")
            return whole
        known = self._path
        if path.time_s[0] <= known.time_s[-1]:
            raise ThermorenderError(
                f"path: the sample at {path.time_s[0]:.9g} s does not follow the one at {known.time_s[-1]:.9g} s; "
                "give each sample once, in the order of time"
            )
        whole = Trajectory(
            np.concatenate([known.time_s, path.time_s]),
            np.concatenate([known.position, path.position]),
            np.concatenate([known.quaternion, path.quaternion]),
        )
        if len(whole) > MOST_SAMPLES:
            raise ThermorenderError(
                f"path: {len(whole)} samples within the sensor's memory are more than {MOST_SAMPLES}; give fewer"
            )
        return whole

    def _with(self, objects: Sequence[ObjectSample]) -> dict[str, dict[str, tuple[list[float], list[float]]]]:
        """The values of dynamic objects with their next samples."""
        if not objects:
            return self._given
        given = {name: {key: (list(t), list(v)) for key, (t, v) in own.items()} for name, own in self._given.items()}
        tracked = {each.name: each for each in self._renderer.scene.tracked_objects}
        for name, time_s, values in objects:
            if name not in tracked:
                raise ThermorenderError(
                    f"object {name!r} has no track and cannot change; give one that has "
                    f"({', '.join(tracked) or 'this scene has none'}), or add its track to the scene"
                )
            _refuse_time(time_s, f"object {name!r}: time_s")
            # This refuses unknown columns and impossible values.
            tracked[name].at(time_s, **values)
            for key, value in values.items():
                times, series = given.setdefault(name, {}).setdefault(key, ([], []))
                if times and time_s <= times[-1]:
                    raise ThermorenderError(
                        f"object {name!r}: its value at {time_s:.9g} s does not follow the one at {times[-1]:.9g} s; "
                        "give each once, in the order of time"
                    )
                if key == "yaw_deg" and series:
                    # Turn the shorter way.
                    value = series[-1] + (value - series[-1] + 180.0) % 360.0 - 180.0
                times.append(float(time_s))
                series.append(float(value))
                if len(times) > MOST_SAMPLES:
                    raise ThermorenderError(f"object {name!r} has more than {MOST_SAMPLES} samples; give fewer")
        return given

    def _start(self, first_s: float) -> None:
        """Prepare for a path that begins at a time [s]."""
        renderer, last_s = self._renderer, first_s
        if renderer.scene.temperature_state.weather_driven:
            start, end = renderer.scene.time, renderer.scene.weather.time[-1]
            assert start is not None
            steps = np.floor((end - start) / np.timedelta64(1, "s") / STEP_S)
            last_s = self._last_s = first_s + float(steps) * STEP_S
        self._timed = TimedRenderer(renderer, first_s, last_s)
        # The sensor holds these frames weakly: without a cycle, their memory is free as soon as nobody uses them.
        own = weakref.proxy(self)
        self._values_at = lambda at_s: own.objects_at(at_s)
        self._exposure = exposure_of(
            self._timed, lambda at_s: own._pose_at(at_s), 1.0 / self.rate_hz, self._movers, self._values_at
        )
        self._movers[:] = movers_of(renderer.scene, self._values_at, {})

    def renderer_at(self, time_s: float) -> InstantRendererT:
        """Return the Renderer of a time at which a frame was taken [s]."""
        assert self._timed is not None
        return self._timed.at(time_s)

    def objects_at(self, time_s: float) -> dict[str, dict[str, float]]:
        """Return the given values of dynamic objects at a time [s], {object: {column: value}}."""
        return {
            name: {key: float(np.interp(time_s, *series)) for key, series in own.items()}
            for name, own in self._given.items()
        }

    def made(
        self, timed: TimedRenderer[InstantRendererT], time_s: float, pose: NDArray[np.float64], index: int,
        reading: bool,
    ) -> Frame:  # fmt: skip
        """Return the frame of a pose; see `take`."""
        frame = timed.at(time_s).frame(pose, time_s=time_s, index=index, objects=self.objects_at(time_s))
        if not reading:
            return frame
        if self._given:
            times = {name: np.unique(np.concatenate([t for t, _ in own.values()])) for name, own in self._given.items()}
            self._movers[:] = movers_of(self._renderer.scene, self._values_at, times)
        return frame.with_reading(*self._exposure.read(index, time_s, frame.radiance))

    def _taken(
        self, timed: TimedRenderer[InstantRendererT], time_s: float, pose: NDArray[np.float64], reading: bool
    ) -> Frame:
        first = time_s if self.last is None else self._first_s
        index = max(self.index + 1, round((time_s - first) * self.rate_hz))
        frame = replace(self.made(timed, time_s, pose, index, reading), time=timed.time(time_s))
        if self._audited is None or (self._audit and index - self._audited.index >= self._audit):
            self._audited = frame
            return frame
        return frame.with_audit(self._audited)

    def _pose_at(self, time_s: float) -> NDArray[np.float64]:
        assert self._path is not None
        return pose_within(self._path, time_s)

    def _forget(self, time_s: float) -> None:
        """Drop samples older than the sensor's memory."""
        camera = self._renderer.scene.camera
        oldest = time_s - past_s(camera) - 1.0 / self.rate_hz - _MARGIN_S
        path = self._path
        assert path is not None
        # One sample before stays, to interpolate from.
        first = max(int(np.searchsorted(path.time_s, oldest)) - 1, 0)
        if first:
            self._path = Trajectory(path.time_s[first:], path.position[first:], path.quaternion[first:])
        for own in self._given.values():
            for times, series in own.values():
                first = max(int(np.searchsorted(times, oldest)) - 1, 0)
                del times[:first], series[:first]


def _refuse_time(time_s: float, what: str) -> None:
    if not abs(time_s) <= LATEST_S:
        raise ThermorenderError(f"{what}={time_s:g} is not a time; give seconds, at most {LATEST_S:g} from 0")
