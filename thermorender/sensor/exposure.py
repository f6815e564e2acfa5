"""A sequence of images as a microbolometer takes them: pixels with a thermal memory, rows read one after another.
Photon detectors integrate up to the frame's time and remember no frame; their integration time is the time constant.

- Static view: one radiance image per frame, and the pixels' state after the frame before.
- Sub-pixel motion: that image is moved back along its path, to the ages that best represent each row's exponential
  past.
- Fast motion: power is followed through close instants, with the exact response. Some of these are rendered; between
  them, two images are moved as the ground moves, and blended. Where a rim around the frame's own image shows all that
  its pixels remember, it replaces renders of other instants.
- Moving objects: the part of the image that they cross is followed through rendered instants (`sensor.movers`).
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.sensor.camera import Camera, Image, Pose
from thermorender.sensor.chain import Moment, Sensor, in_sequence
from thermorender.sensor.detector import (
    SETTLED,
    PixelState,
    follower,
    response_weights,
    row_delays,
    steady,
    stepped,
)
from thermorender.sensor.motion import (
    Relief,
    WideImage,
    border_uncertainty,
    grid_camera,
    moved,
    pixel_grid,
    widest_px,
)
from thermorender.sensor.movers import ChangingRegion, Mover, changing_regions, outside
from thermorender.sensor.schedule import (
    FAR_PX,
    FITTED_GRADIENT_MK,
    LAG_MK,
    RENDER_PX,
    STATIC_PX,
    SUBPIXEL_MK,
    SUBPIXEL_PX,
    Schedule,
    gradient_mk,
    instants_mk,
    moved_mk,
    past_s,
    per_mk,
    sample,
    sample_mean,
    schedule,
    unmoved_mk,
)

# Ages [time constants] and weights that integrate cubics exactly: against e⁻ᵃ (Gauss–Laguerre), and as the mean over an
# integration time (Gauss–Legendre).
_EXPONENTIAL, _MEAN = np.polynomial.laguerre.laggauss(2), (0.5 + np.array([-0.5, 0.5]) / np.sqrt(3.0), np.full(2, 0.5))
# Ratio of the error of trapezoids to their difference from those twice as wide: a third where the power bends gently,
# more where it bends from pixel to pixel.
_BY_HALF = 0.5
# Time over which the speed of a view is measured; no view turns round within it [s].
_SHORT_S = 0.02
# Margin around the box of a moving object for the blur of the lens and the light that it casts nearby [px].
_MARGIN_PX = 6
# Moved images show a moving object where it was not. Age [time constants] up to which that matters.
_GHOST_AGE = 4.0
# Age [time constants] up to which a frame's own image is continued beyond its borders: e⁻³ of 1 K in 1 % of the pixels
# is 5 mK.
_RIM_AGE = 3.0
# Pixels for each one in which the error of moving the frame's own image is measured.
_EVERY = 64
# Factor of the error measured at one age on that over all: older instants uncover more than in proportion.
_OLDER = 1.2

# (column, row) (H, W) in one instant's image of the pixels of another, both by number in a Schedule.
_Ways = Callable[[int, int], tuple[Image, Image]]


class Exposure:
    """The state of a flight's sensor from one frame to the next, `interval_s` [s] apart.

    `radiance_at` (time [s], Camera, time [s] of the light on and from moving objects) returns band radiance, (H, W)
    float32 [W m⁻² sr⁻¹], of the sensor's camera, of a part of it or of a wider view; with a fourth argument, (H, W)
    bool, only those pixels are used. `pose_at` (time) returns world_from_camera. `depth_at`
    (pose, Camera) is the depth of the static scene along the axis, (h, w) [m], infinite where nothing is hit.
    `render_px` is the motion between two renders; 0 renders every instant. `lag_mk` is the estimated error allowed to
    the spacing of instants.
    """

    pixels: PixelState | None
    last_counts: NDArray[np.uint16] | None

    def __init__(
        self,
        sensor: Sensor,
        radiance_at: Callable[..., Image],
        pose_at: Callable[[float], Pose],
        depth_at: Callable[[Pose, Camera], NDArray[Any]],
        interval_s: float,
        render_px: float = RENDER_PX,
        lag_mk: float = LAG_MK,
        movers: Sequence[Mover] = (),
    ) -> None:
        self.sensor, self.interval_s, self._movers = sensor, interval_s, movers
        self._radiance_at, self._pose_at, self._depth_at = radiance_at, pose_at, depth_at
        self._grid_camera = grid_camera(sensor.camera)
        self._delays = row_delays(sensor.camera, interval_s)
        self._ages: NDArray[np.float64]
        self._weights: NDArray[np.float64]
        self._ages, self._weights = _MEAN if sensor.camera.well_electrons else _EXPONENTIAL
        self._render_px, self._lag_mk = render_px, lag_mk
        self.pixels, self.last_counts = None, None

    def read(self, index: int, time_s: float, radiance: Image) -> tuple[NDArray[np.uint16], dict[str, Any]]:
        """Return (counts (H, W) uint16, facts) of the next frame, `index`, at `time_s`, the middle of its read-out.

        `radiance` (H, W) is that at `time_s` [W m⁻² sr⁻¹]. Facts are those of `signal`, and whether the image is
        frozen.
        """
        moment = in_sequence(self.sensor.camera, index, index * self.interval_s)
        if moment.frozen and self.last_counts is not None:
            # The shutter stays closed for many time constants, so the pixels forget the scene.
            self.pixels = None
            return self.last_counts, {"frozen": True, "motion_px": None, "instants": 0, "renders": 1, "lag_mk": None}
        signal, how = self.signal(moment, time_s, radiance)
        self.last_counts = self.sensor.counts(signal, moment)
        return self.last_counts, {"frozen": False, **how}

    def signal(self, moment: Moment, time_s: float, radiance: Image) -> tuple[Image, dict[str, Any]]:
        """Return (signal (H, W) float32 [W] before the read-out of one frame, how it was made).

        `how` holds motion_px (of the view within a time constant), instants, renders (those of parts of the image
        included), and lag_mk: estimated error of the lag, root mean square over the frame [mK].
        """
        relief, interpolates, before = self._relief(time_s), bool(self._render_px), self.pixels
        motion, gradient = self._motion_px(relief, time_s), gradient_mk(radiance, self.sensor.camera)
        # The next frame starts from pixels that were followed through instants, and from their error.
        contrast, moved_s, carried = gradient / FITTED_GRADIENT_MK, 0.0, 0.0
        # A view that moves little in a short time constant may move more while the rows are read.
        late = float(np.std(self._delays)) / (self.sensor.camera.memory_s or np.inf)
        reading = motion * max(late, 1.0)
        if reading <= STATIC_PX:
            signal = self._static(time_s, self.sensor.power(radiance, moment))
            instants, renders, regions = 1, 1, self._changing_regions(time_s, before, moved_s)
            error = unmoved_mk(radiance, self.sensor.camera, motion * np.hypot(1.0, late), gradient)
        elif reading <= SUBPIXEL_PX and interpolates and self.sensor.camera.memory_s:
            image = self.sensor.blurred(radiance)
            way = self._way(relief, time_s, self.sensor.camera.memory_s)
            signal, error = self._subpixel(way, time_s, image, moment)
            moved_s = self._ages[-1] * self.sensor.camera.memory_s - self._delays[0]
            regions = self._changing_regions(time_s, before, moved_s)
            gaps, rest = np.hypot(self._ages, late), outside(regions, image.shape)
            error = np.hypot(error, moved_mk(image, self.sensor.camera, way, motion, gaps, self._weights, rest))
            error = np.hypot(error, SUBPIXEL_MK * motion**2 * contrast)
            instants, renders = len(self._ages), 1
        else:
            plan = self._schedule(time_s, motion, contrast, self._since(time_s, before), self._render_px)
            own, measured, ways = WideImage(self.sensor.blurred(radiance)), None, self._ways(plan, relief)
            if interpolates:
                seen = self._seen(plan, ways, own, motion)
                if len(seen.renders) > len(plan.renders):
                    own, measured = self._widened(plan, ways, own, radiance)
                    seen = seen if measured is None else self._seen(plan, ways, own, motion)
                plan = seen
            signal, error = self._fast(plan, ways, own, moment)
            image = own.of(self.sensor.camera)
            instants, renders, moved_s = (
                len(plan.times_s),
                len(plan.renders) + 2 * (measured is not None),
                self._moved_s(plan),
            )
            regions = self._changing_regions(time_s, before, moved_s)
            if len(plan.renders) < len(plan.times_s):
                way = self._way(relief, time_s, min(self._span_s(), _SHORT_S))
                gaps, weights = plan.moved_middles(self.sensor.camera.memory_s)
                rest = outside(regions, image.shape)
                apart = moved_mk(image, self.sensor.camera, way, motion, gaps, weights, rest)
                # A moved image shows neither what a step of depth uncovers nor detail that it has not.
                error = np.hypot(error, max(apart, _OLDER * (measured or 0.0) * float(gaps @ weights)))
            carried = error**2
        remembered = self._remembered_mk(time_s, before) ** 2
        square = error**2 + remembered
        followed = remembered + carried
        if regions:
            # The signal of steady pixels may share memory with their state.
            signal = signal.copy()
            for region in regions:
                count, followed_mk = self._follow(region, motion, before, moment, time_s, radiance, signal)
                # The frame's own image is among its instants.
                renders, instants = renders + count - 1, max(instants, count)
                share = signal[region.rows, region.columns].size / signal.size
                square += (followed_mk**2 - error**2) * share
                followed += (followed_mk**2 - carried) * share
        error = np.sqrt(square)
        if self.pixels is not None:
            self.pixels = replace(self.pixels, error_mk=float(np.sqrt(followed)))
        made = {"motion_px": round(motion, 3), "instants": instants, "renders": renders}
        return signal, made | {"lag_mk": round(float(error), 1)}

    def state(self) -> dict[str, NDArray[Any]]:
        """Return {name: array} of everything that the next frame depends on."""
        arrays: dict[str, Any] = {"counts": self.last_counts} if self.sensor.camera.ffc_interval_s else {}
        if self.pixels is not None:
            arrays |= {name: np.float64(getattr(self.pixels, name)) for name in ("time_s", "error_mk")}
            arrays |= {"signal": self.pixels.signal, "power": self.pixels.power}
        return arrays

    def restore(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Continue from a `state`."""
        self.last_counts = arrays.get("counts")
        self.pixels = None
        if "signal" in arrays:
            time_s, error_mk = (float(arrays[name]) for name in ("time_s", "error_mk"))
            self.pixels = PixelState(time_s, arrays["signal"], arrays["power"], error_mk)

    def _span_s(self) -> float:
        """The pixels' memory, or the read-out time of a camera without one [s]."""
        return self.sensor.camera.memory_s or self._delays[-1] - self._delays[0]

    def _relief(self, time_s: float) -> Relief:
        """The Relief of the view at a time."""
        pose = self._pose_at(time_s)
        return Relief(self.sensor.camera, pose, self._depth_at(pose, self._grid_camera))

    def _motion_px(self, relief: Relief, time_s: float) -> float:
        """Motion of the view in a time constant: between its ends or, since it may return, by its speed [px]."""
        span = self._span_s()
        motion = relief.motion_px(self._pose_at(time_s - span))
        if span <= _SHORT_S:
            return motion
        return max(motion, relief.motion_px(self._pose_at(time_s - _SHORT_S)) * span / _SHORT_S)

    def _remembered_mk(self, time_s: float, before: PixelState | None) -> float:
        """The part of the error of the state `before` that remains at the end of a frame [mK]."""
        if before is None:
            return 0.0
        passed = time_s + self._delays[-1] - before.time_s
        # Rounded, so that a small rest is forgotten as the signal is.
        return round(before.error_mk * float(response_weights(passed, self.sensor.camera.memory_s)[0]), 6)

    def _since(self, time_s: float, before: PixelState | None) -> float:
        """Earliest time whose power matters to a frame that follows the state `before` [s]."""
        since_s = time_s + self._delays[0] - past_s(self.sensor.camera)
        return since_s if before is None else max(since_s, before.time_s)

    def _schedule(self, time_s: float, motion: float, contrast: float, since_s: float, render_px: float) -> Schedule:
        lag_mk = self._lag_mk / max(contrast, 1e-6)
        return schedule(time_s, self._delays, self.sensor.camera.memory_s, motion, since_s, lag_mk, render_px)

    def _ways(self, plan: Schedule, relief: Relief) -> _Ways:
        """The motion of the image between the instants of a Schedule."""
        times = plan.times_s

        @lru_cache(maxsize=8)
        def way(seen: int, wanted: int) -> tuple[Image, Image]:
            return relief.source_pixels(self._pose_at(times[seen]), self._pose_at(times[wanted]))

        return way

    def _number(self, plan: Schedule, age: float | None) -> int:
        """The instant in a Schedule that is `age` time constants before the first row is read; without, the last."""
        if age is None:
            return len(plan.times_s) - 1
        since = plan.row_times_s[0] - age * self.sensor.camera.memory_s
        return max(int(np.searchsorted(plan.times_s, since, "right")) - 1, 0)

    def _widened(
        self, plan: Schedule, ways: _Ways, own: WideImage, radiance: Image
    ) -> tuple[WideImage, float | None]:  # fmt: skip
        """(The frame's own image, blurred, with what other instants see beyond its borders; its error when moved by a
        time constant [mK]), or `own` and None where other instants see more than an image may be continued.

        The error is measured in some pixels of an instant about a time constant earlier, rendered with few rays, less
        the noise of those."""
        (height, width), most = radiance.shape, widest_px(self.sensor.camera)
        reach = np.zeros(4)
        # The oldest of these instants is no older than that age.
        for number in (len(plan.times_s) - 1, min(self._number(plan, _RIM_AGE) + 1, plan.own)):
            column, row = ways(plan.own, number)
            beyond = -column.min(), -row.min(), column.max() - (width - 1), row.max() - (height - 1)
            reach = np.maximum(reach, beyond)
        if reach.max() > most:
            return own, None
        left, top, right, bottom = np.ceil(np.maximum(reach, 0.0)).astype(int).tolist()
        if left == top == right == bottom == 0:
            return own, None
        # One camera, whose rays serve all frames, though few need all of its rim.
        camera = self.sensor.camera.part(slice(-most, height + most), slice(-most, width + most))
        inside = slice(most, most + height), slice(most, most + width)
        around = slice(most - top, most + height + bottom), slice(most - left, most + width + right)
        rim = np.zeros((camera.height, camera.width), bool)
        rim[around] = True
        rim[inside] = False
        here, some = _spread(height, width, _EVERY), np.zeros(radiance.shape, bool)
        some[here] = True
        time_s = plan.times_s[plan.own]
        image = self._radiance_at(time_s, camera, time_s, rim | np.pad(some, most))
        noise = (image[inside] - radiance)[here]
        image[inside] = radiance
        wide = WideImage(image[around], left, top)
        measured = self._moved_error_mk(plan, ways, wide, here, some, noise)
        return WideImage(self.sensor.blurred(wide.image), left, top), measured

    def _moved_error_mk(
        self, plan: Schedule, ways: _Ways, own: WideImage, here: Any, some: NDArray[np.bool_], noise: Image
    ) -> float:  # fmt: skip
        """The error of an image that is moved by a time constant [mK], from the pixels `here`, those of the mask
        `some`, of an earlier instant; `noise` is that of few rays there."""
        past = self._number(plan, 1.0)
        time_s, past_s = plan.times_s[plan.own], plan.times_s[past]
        column, row = (position[here] for position in ways(plan.own, past))
        off = self._radiance_at(past_s, self.sensor.camera, time_s, some)[here] - own.moved(column, row)
        # What moving objects change is followed apart.
        changing = self._changing_regions(time_s, self.pixels, self._moved_s(plan))
        still = outside(changing, some.shape)[here]
        square = max(float(np.mean(off**2 - noise**2, where=still)), 0.0) if still.any() else 0.0
        gap = (time_s - past_s) / self._span_s()
        return float(np.sqrt(square) / (per_mk(self.sensor.camera) * max(gap, 0.1)))

    def _seen(self, plan: Schedule, ways: _Ways, own: WideImage, motion: float) -> Schedule:
        """The Schedule with more renders where the images before and after do not see enough of an instant: the last
        one, the first row's, and those one and, in fast motion, three time constants earlier."""
        camera, renders = self.sensor.camera, plan.renders
        here, inside = sample((camera.height, camera.width)), WideImage(own.of(camera))
        for age in (None, 0.0, 1.0, *([_RIM_AGE] if motion > FAR_PX else [])):
            number = self._number(plan, age)
            after = int(np.searchsorted(renders, number))
            unseen: Any = np.exp(-(age or 0.0))
            for at in {renders[max(after - 1, 0)], renders[min(after, len(renders) - 1)], plan.own}:
                column, row = (position[here] for position in ways(at, number))
                # The border of the frame's own image estimates the uncertainty beyond the border of another.
                unseen = unseen * (
                    own.uncertainty(column, row) if at == plan.own else inside.uncertainty(column, row) > 0.0
                )
            if number not in renders and np.sqrt(np.mean(unseen**2)) > self._lag_mk * per_mk(self.sensor.camera):
                renders = np.union1d(renders, number)
        return replace(plan, renders=renders)

    def _moved_s(self, plan: Schedule) -> float:
        """Longest time over which images are moved between the renders of a Schedule that pixels remember [s]."""
        if not self._render_px:
            return 0.0
        rendered = np.union1d(plan.times_s[[0, -1]], plan.times_s[plan.renders])
        ages = plan.row_times_s[0] - rendered[1:]
        return float(np.diff(rendered)[ages <= _GHOST_AGE * self.sensor.camera.memory_s].max())

    def _changing_regions(self, time_s: float, before: PixelState | None, moved_s: float) -> list[ChangingRegion]:
        """Regions of the frame that moving objects change within the pixels' memory."""
        if not self._movers:
            return []
        since_s, until_s = self._since(time_s, before), time_s + self._delays[-1]
        if since_s >= until_s:
            return []
        return changing_regions(self.sensor.camera, self._pose_at, self._movers, since_s, until_s, _MARGIN_PX, moved_s)

    def _follow(
        self, region: ChangingRegion, motion: float, before: PixelState | None, moment: Moment, time_s: float,
        radiance: Image, signal: Image,
    ) -> tuple[int, float]:  # fmt: skip
        """Write the signal of a region of the image from separately rendered instants; return (instants, error_mk).

        The rms error is estimated as the difference from the signal through half the instants, and at least that of
        spacing.
        """
        camera, since_s = self.sensor.camera, self._since(time_s, before)
        here = region.rows, region.columns
        # An object that crosses the region between two frames is in neither of their images.
        contrast = max(gradient_mk(radiance[here], camera, 1) / FITTED_GRADIENT_MK, 1.0)
        # The ground moves behind an object that moves with the camera.
        motion = max(region.px_per_s * self._span_s(), motion, 1e-9)
        plan = self._schedule(time_s, motion, contrast, since_s, 0.0)
        times = np.unique([*plan.times_s, *region.bends_s, *region.warming_s])
        wide = region.around(camera.height, camera.width)
        sides = zip(here, wide, strict=True)
        inner_rows, inner_columns = (slice(a.start - b.start, a.stop - b.start) for a, b in sides)
        part_of = camera.part(*wide)
        offset, gain = self.sensor.power_law(moment)
        offset, gain = offset[here], gain[here]

        def powers() -> Iterator[tuple[float, Image]]:
            for at in times:
                image = radiance[wide] if at == time_s else self._radiance_at(at, part_of, time_s)
                yield at, offset + gain * self.sensor.blurred(image)[inner_rows, inner_columns]

        state, rows = None, plan.row_times_s[region.rows]
        if before is not None and before.time_s == times[0]:
            state = PixelState(before.time_s, before.signal[here], before.power[here])
        # In one pass, since each power is a render. `kept` are instants that the coarser followers need.
        kept = np.isin(times, [times[0], *region.bends_s])
        fine, *coarser = (follower(camera, state, rows, signal[here].shape) for _ in range(3))
        for number, (at, power) in enumerate(powers()):
            last = number == len(times) - 1
            fine.step(at, power, last)
            for odd, coarse in enumerate(coarser):
                if number % 2 == odd or kept[number] or last:
                    coarse.step(at, power, last)
        signal[here] = fine.signal
        if self.pixels is not None:
            for name in ("signal", "power"):
                whole = getattr(self.pixels, name).copy()
                whole[here] = getattr(fine.pixels, name)
                self.pixels = replace(self.pixels, **{name: whole})
        scale = gain * per_mk(camera)
        apart = [np.mean(((fine.signal - coarse.signal) / scale) ** 2) for coarse in coarser]
        return len(times), max(float(np.sqrt(max(apart))), instants_mk(plan.spacing_px, motion) * contrast)

    def _static(self, time_s: float, power: Image) -> Image:
        """The signal of each row at its own time under a power that is constant since the last instant [W]."""
        time_constant_s, end_s = self.sensor.camera.time_constant_s, time_s + self._delays[-1]
        if not time_constant_s:
            return power
        before = self.pixels or steady(end_s, power)
        self.pixels = stepped(before, end_s, power, time_constant_s)
        passed = np.maximum(time_s + self._delays - before.time_s, 0.0)
        old = response_weights(passed, time_constant_s)[0][:, None]
        return power if old[0] < SETTLED else (power + old * (before.signal - power)).astype(np.float32)

    def _way(self, relief: Relief, time_s: float, span_s: float) -> tuple[Image, Image]:
        """Motion of each pixel within a time constant, by that in a span before a time: (right, down) (H, W) [px]."""
        found = relief.source_pixels(self._pose_at(time_s - span_s), self._pose_at(time_s))
        for here, before in zip(pixel_grid(self.sensor.camera), found, strict=True):
            np.subtract(here, before, out=before)
            before *= np.float32(self._span_s() / span_s)
        return found

    def _subpixel(self, way: tuple[Image, Image], time_s: float, image: Image, moment: Moment) -> tuple[Image, float]:
        """(The signal (H, W) [W] of each row at its own time, from one image that is moved to a few ages; the error of
        what lies beyond its border, root mean square [mK])."""
        camera, here = self.sensor.camera, sample(image.shape)
        column, row = pixel_grid(camera)
        total, unseen = np.zeros_like(image), np.zeros_like(image[here])
        for age, weight in zip(self._ages, self._weights.astype(np.float32), strict=True):
            ago = (age - self._delays / camera.memory_s).astype(np.float32)[:, None]
            # Such a small motion is the same in both directions.
            right, down = column + way[0] * ago, row + way[1] * ago
            # The blur of linear interpolation matters little at a small weight.
            total += weight * moved(image, right, down, coarsely=bool(weight < 0.2))
            unseen += weight * border_uncertainty(image, right[here], down[here])
        # The scene is static, so the next frame's own image gives its past.
        self.pixels = None
        error_mk = np.sqrt(sample_mean(unseen**2, image.shape)) / per_mk(camera)
        return self.sensor.power(total, moment, blurred=True), error_mk

    def _fast(self, plan: Schedule, ways: _Ways, own: WideImage, moment: Moment) -> tuple[Image, float]:
        """Return (signal (H, W) float32 [W] of each row at its own time, estimated rms error of its lag [mK]).

        The error is that of the spacing, by leaving out half of the instants, and of parts of the view that no image
        shows.
        """
        camera, times = self.sensor.camera, plan.times_s
        whole = camera.height, camera.width
        state = self.pixels if self.pixels is not None and self.pixels.time_s >= times[0] else None
        pixels = follower(camera, state, plan.row_times_s, whole)
        here = sample(whole)
        rows = plan.row_times_s[here[0][:, 0]]
        if state is not None:
            state = PixelState(state.time_s, state.signal[here], state.power[here])
        shape = np.broadcast_shapes(*(index.shape for index in here))
        *coarser, unseen = (follower(camera, one, rows, shape) for one in (state, state, None))
        for number, (time_s, power, guess) in enumerate(self._powers(plan, ways, own, moment, here)):
            last = number == len(times) - 1
            pixels.step(time_s, power, last)
            for odd, one in enumerate(coarser):
                if number % 2 == odd or number == 0 or last:
                    one.step(time_s, power[here], last)
            unseen.step(time_s, guess, last)
        self.pixels = pixels.pixels
        scale = np.broadcast_to(self.sensor.power_law(moment)[1] * per_mk(camera), whole)[here]
        apart = [np.mean(((pixels.signal[here] - one.signal) / scale) ** 2) for one in coarser]
        guessed = sample_mean((unseen.signal / per_mk(camera)) ** 2, whole)
        return pixels.signal, float(np.sqrt(_BY_HALF**2 * max(apart) + guessed))

    def _powers(
        self, plan: Schedule, ways: _Ways, own: WideImage, moment: Moment, here: Any
    ) -> Iterator[tuple[float, Image, Image]]:
        """Yield (time, absorbed power, uncertainty of the radiance of the sampled pixels) of each instant, in order."""
        times, renders, seen = plan.times_s, plan.renders, {plan.own: own}
        for number, time_s in enumerate(times):
            before = renders[max(int(np.searchsorted(renders, number, "right")) - 1, 0)]
            after = renders[min(int(np.searchsorted(renders, number)), len(renders) - 1)]
            for render in (before, after):
                if render not in seen:
                    made = self._radiance_at(times[render], self.sensor.camera, times[plan.own])
                    seen[render] = WideImage(self.sensor.blurred(made))
            images = {render: seen[render] for render in dict.fromkeys((before, after))}
            seen = {render: made for render, made in seen.items() if render >= before}
            interpolated, guess = self._interpolated(images, plan, ways, number, here)
            yield time_s, self.sensor.power(interpolated, moment, blurred=True), guess

    def _interpolated(
        self, images: Mapping[int, WideImage], plan: Schedule, ways: _Ways, number: int, here: Any
    ) -> tuple[Image, Image]:
        """(The image of an instant, its `border_uncertainty`) from the images before and after, by instant."""
        if number in images:
            image = images[number].of(self.sensor.camera)
            return image, np.zeros_like(image[here])
        found = []
        for at, wide in images.items():
            column, row = ways(at, number)
            guess = wide.uncertainty(column[here], row[here])
            found.append((wide.moved(column, row), wide.shows(column, row), guess))
        if len(found) == 1:
            return found[0][0], found[0][2]
        (first, in_first, guess), (second, in_second, other) = found
        start, end = (plan.times_s[at] for at in images)
        share = (plan.times_s[number] - start) / (end - start)
        # If only one of them sees a point, it has the whole weight.
        weight = np.where(in_first == in_second, np.float32(share), in_second.astype(np.float32))
        second -= first
        second *= weight
        guess += weight[here] * (other - guess)
        return np.add(first, second, out=first), guess


@lru_cache(maxsize=2)
def _spread(height: int, width: int, every: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(rows, columns) of one in `every` pixels, scattered, as a lattice may miss upright and level edges. They are
    square arrays, since OpenCV moves no image of more than 32 767 columns."""
    side = int(np.ceil(np.sqrt(height * width / every)))
    row, column = np.random.default_rng(0).random((2, side, side))
    return (row * height).astype(np.int64), (column * width).astype(np.int64)
