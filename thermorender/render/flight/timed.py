"""Renderers of one scene at the instants of a flight or of a day, as its temperatures follow the weather.

The heat balance is solved once for many instants, and the light of each is solved without tracing rays. Memory is
bounded. A renderer depends only on its instant, not on earlier requests.
"""

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.errors import ThermorenderError
from thermorender.frame import Frame
from thermorender.render.heat.instants import solved_at
from thermorender.scene.scene import Scene
from thermorender.sensor.camera import Camera
from thermorender.units import utc_text

if TYPE_CHECKING:
    # These import Mitsuba, which is loaded if there is a renderer.
    from thermorender.render.baked import BakedScene, Progress
    from thermorender.render.dynamic import Objects
    from thermorender.render.geometry import Geometry

# Step of the temperatures of a flight [s]; a frame takes the nearest: at 3 K an hour the error is up to 25 mK.
STEP_S = 60.0
# Instants that are solved together, with all their temperatures in memory.
TOGETHER = 32


def solved_in_parts(
    scene: Scene, times: "Sequence[np.datetime64] | NDArray[Any]", geometry: "Geometry",
    progress: "Progress | None" = None,
) -> Iterator[Scene]:  # fmt: skip
    """Yield the scene with solved temperatures at each instant of a rising sequence; few are in memory at once."""
    for first in range(0, len(times), TOGETHER):
        yield from solved_at(scene, list(times[first : first + TOGETHER]), geometry, progress)


_Self = TypeVar("_Self", bound="InstantRenderer")
InstantRendererT = TypeVar("InstantRendererT", bound="InstantRenderer")


class InstantRenderer(Protocol):
    """What flights use of a `Renderer`, the renderer of one instant."""

    follows_weather: bool
    scene: Scene
    seed: int

    @property
    def baked(self) -> "BakedScene":
        """The scene with its light."""

    def solved_for(self: _Self, scene: Scene) -> _Self:
        """Return the renderer of the same surfaces at other temperatures."""

    def refuse_camera(self, positions: ArrayLike) -> None:
        """Raise for cameras at local positions (…, 3) without air or above its clouds."""

    def frame(self, pose: ArrayLike, time_s: float = ..., index: int = ..., objects: "Objects | None" = ...) -> Frame:
        """Return the Frame of a pose."""

    def radiance(
        self, pose: ArrayLike, time_s: float = ..., objects: "Objects | None" = ..., *, camera: Camera | None = ...,
        lit_s: float | None = ..., lit_objects: "Objects | None" = ..., only: NDArray[np.bool_] | None = ...,
    ) -> NDArray[np.float32]:  # fmt: skip
        """Return the band radiance of `frame`, (H, W) [W m⁻² sr⁻¹]."""

    def depth(self, pose: ArrayLike, camera: Camera | None = ...) -> NDArray[np.float32]:
        """Return the depth of the static scene along the camera's axis, (H, W) [m]."""


class TimedRenderer(Generic[InstantRendererT]):
    """The renderer of each instant of a flight; `renderer`, kept as `first`, is that of the first instant. `first_s`
    and `last_s` are the times of the whole trajectory [s], even if only a part is flown. `progress` is called with
    (what, share done) while a heat balance is solved."""

    def __init__(
        self, renderer: InstantRendererT, first_s: float, last_s: float, progress: "Progress | None" = None
    ) -> None:
        self.first, self._first_s, self._progress = renderer, first_s, progress
        self._last_step = _steps(renderer.scene, last_s - first_s) if renderer.follows_weather else 0
        # At most two steps, since the memory of pixels reaches back over a change of the step.
        self._made: dict[int, InstantRendererT] = {}
        self._part: tuple[int, dict[int, Scene]] = (-1, {})
        refuse_late(renderer.scene, last_s - first_s)

    def at(self, time_s: float) -> InstantRendererT:
        """Return the Renderer for a time of the trajectory [s]."""
        step = self._step(time_s)
        if step == 0:
            return self.first
        if step not in self._made:
            made = self.first.solved_for(self._scenes(step)[step])
            self._made = dict(list(self._made.items())[-1:]) | {step: made}
        return self._made[step]

    def time(self, time_s: float) -> "np.datetime64 | None":
        """Return the instant of a time of the trajectory, datetime64[ms] UTC; None for a scene without an hour."""
        start = self.first.scene.time
        if start is None:
            return None
        return start.astype("datetime64[ms]") + np.timedelta64(round(1e3 * (time_s - self._first_s)), "ms")

    def temperature_record(self, time_s: float) -> dict[str, Any]:
        """Return the entry of temperatures in a frame's record, {"temperature": {"time", "change_mk", "moved"}}; {}
        without a heat balance. "time" is their instant, UTC. "change_mk" is the root mean square change over the
        terrain's texels in the last `STEP_S` [mK], None at the first instant. "moved" is the `moved_report` of a map
        moved to the instant."""
        scene = self.first.scene
        if not scene.temperature_state.weather_driven:
            return {}
        step, change = self._step(time_s), None
        if step:
            scenes = self._scenes(step)
            change, scene = round(1e3 * _rms_change_k(scenes[step - 1], scenes[step]), 2), scenes[step]
        report = scene.temperature_state.moved_report
        moved = {"moved": report} if report else {}
        return {"temperature": {"time": utc_text(self._instant(step)), "change_mk": change, **moved}}

    def _step(self, time_s: float) -> int:
        return min(max(round((time_s - self._first_s) / STEP_S), 0), self._last_step)

    def _instant(self, step: int) -> np.datetime64:
        return _instant(self.first.scene, step)

    def _scenes(self, step: int) -> dict[int, Scene]:
        """The scenes of the part of the flight around a step, and of the step before this part."""
        part = (step - 1) // TOGETHER
        if part != self._part[0]:
            steps = range(part * TOGETHER, min((part + 1) * TOGETHER, self._last_step) + 1)
            times = [self._instant(number) for number in steps]
            found = solved_at(self.first.scene, times, self.first.baked.geometry, self._progress)
            self._part = part, dict(zip(steps, found, strict=True))
        return self._part[1]


def refuse_late(scene: Scene, duration_s: float) -> None:
    """Raise for a flight that lasts longer than its weather."""
    steps = _steps(scene, duration_s)
    if steps and (end := _instant(scene, steps)) > scene.weather.time[-1]:
        raise ThermorenderError(
            f"{scene.where}: the flight ends at {utc_text(end)}, after its weather, which ends at "
            f"{utc_text(scene.weather.time[-1])}; give an earlier time, or longer weather"
        )


def _steps(scene: Scene, duration_s: float) -> int:
    """Number of steps of the temperatures in a time; 0 for temperatures that stay."""
    return round(duration_s / STEP_S) if scene.temperature_state.weather_driven else 0


def _instant(scene: Scene, step: int) -> np.datetime64:
    """The instant of a step of the temperatures."""
    assert scene.time is not None
    return scene.time + np.timedelta64(round(step * STEP_S), "s")


def _rms_change_k(one: Scene, other: Scene) -> float:
    """Root mean square over the terrain's texels of a change of temperature [K]."""
    pairs = zip(one.surfaces[: one.terrain_count], other.surfaces, strict=False)
    change = np.concatenate([(b.temperature - a.temperature).ravel() for a, b in pairs])
    return float(np.sqrt(np.mean(np.square(change, dtype=np.float64))))
