"""A sequence of images as a microbolometer takes them: each pixel remembers, and rows are read one after another.

Static view: where the image hardly moves within a time constant, one radiance image per frame is enough, and what
the pixels remember of the frames before. Sub-pixel motion: that image is moved back along its path, to the ages that
stand best for the exponential past of each row. Fast motion: the power on the pixels is followed through instants
close to each other, linear in time between them, and the response to that is exact. Few of these instants need a
rendered image: between renders, an image is moved as the ground moves, and what comes from the render before and the
render after is blended. Things with a course of their own: the part of the image that they cross is followed through
rendered instants, whatever the camera does (`thermorender.sensor.movers`).
"""

from dataclasses import dataclass, replace

import numpy as np

from thermorender.physics.planck import band_radiance_derivative
from thermorender.sensor import movers
from thermorender.sensor.chain import in_sequence
from thermorender.sensor.detector import (
    SETTLED,
    PixelState,
    advanced,
    read_rows,
    response_weights,
    row_delays,
    steady,
    stepped,
)
from thermorender.sensor.motion import Relief, grid_camera, guess_of, moved, pixel_grid
from thermorender.sensor.noise import NETD_REFERENCE_K

# Motion within a time constant up to which a frame is one image [px].
STATIC_PX = 0.02
# Motion up to which one image, moved along straight lines to a few ages, stands for the past [px]. These ages [time
# constants] and weights integrate cubics against e⁻ᵃ exactly (Gauss–Laguerre).
SUBPIXEL_PX = 0.8
_AGES, _WEIGHTS = np.polynomial.laguerre.laggauss(2)
# Time constants that a pixel remembers: e⁻⁸ of 15 K is 5 mK.
MEMORY = 8.0
# Estimated error allowed to the spacing of instants [mK], and motion between two renders [px].
LAG_MK, RENDER_PX = 10.0, 20.0
# By these instants are chosen: at v pixels per time constant, d pixels apart, they err by about the first times
# d² min(1, d/v), and moving one image to a few ages by the second times v², where radiance changes by the third from
# pixel to pixel; fitted to heath from 100 and 120 m, proportional to that change.
_INSTANT_MK, _SUBPIXEL_MK, _FITTED_GRADIENT_MK = 12.0, 42.0, 700.0
# What they do err by is told by half of them. Trapezoids err by a third of what those twice as wide differ by, where
# the power bends gently, and by more of it where it bends from pixel to pixel.
_BY_HALF = 0.5
# An image that is moved lacks what is finer than its pixels. Estimate, no bound, of the root mean square error that
# this makes: so much of what interpolation between every other pixel misses of the image, over √(1 + v/8), as a pixel
# that sees many averages. Fitted from above to three scenes from 15 m to 1 km.
_MOVED, _AVERAGING_PX = 0.35, 8.0
# Every so many rows and columns tell the error of a frame.
_SAMPLED = 4
MOST_INSTANTS = 400
# Over which a view's speed is told: it does not turn round in so short a time [s].
_SHORT_S = 0.02
# Of the part of an image that a thing crosses, beyond its box [px]: what the lens spreads and it lights nearby.
_MARGIN_PX = 6
# Images that are moved show such a thing where it was not: age [time constants] up to which that counts.
_GHOST_AGE = 4.0


def plan_row(camera):
    """Return what the pixels' memory brings to a flight, as an (item, in or out, why) row of a plan."""
    if camera.time_constant_ms == 0.0:
        return ("sub-frames", "out", "this camera's pixels remember nothing")
    why = f"one render where a flight's view moves up to {SUBPIXEL_PX:g} px in {camera.time_constant_ms:g} ms"
    return ("sub-frames", "by motion", f"{why}; above that as many as keep an estimated {LAG_MK:g} mK")


@dataclass(frozen=True)
class Schedule:
    """Instants of one frame.

    Attributes
    ----------
    times_s : (n,) float64
        Increasing; the last is that of the last row [s].
    renders : (m,) int64
        Which of them are rendered.
    own : int
        Which instant is the frame's own time; it is rendered.
    row_times_s : (H,) float64
        When each row is read [s].
    spacing_px : float
        Motion between two instants [px].
    """

    times_s: np.ndarray
    renders: np.ndarray
    own: int
    row_times_s: np.ndarray
    spacing_px: float


class Exposure:
    """What a flight keeps of its sensor from one frame to the next.

    Parameters
    ----------
    sensor : Sensor
    radiance_at : callable
        Time [s], Camera, time whose light moving things get and give [s] → (H, W) float32 band radiance [W m⁻² sr⁻¹] as
        that camera sees it: the sensor's, or a part of it. The light is that of the frame's own time.
    pose_at : callable
        Time [s] → (4, 4) world_from_camera.
    depth_at : callable
        Pose, Camera → (h, w) depth along the axis of what the middles of that camera's pixels show of what stands
        still, infinite where there is nothing [m].
    interval_s : float
        From one frame to the next [s].
    render_px : float
        Motion between two renders [px], between which images are moved as the ground moves; 0: every instant is
        rendered.
    lag_mk : float
        Estimated error allowed to the spacing of instants [mK].
    movers : sequence of Mover
        Things with a course of their own.
    """

    def __init__(
        self, sensor, radiance_at, pose_at, depth_at, interval_s, render_px=RENDER_PX, lag_mk=LAG_MK, movers=()
    ):
        self.sensor, self.interval_s, self._movers = sensor, interval_s, movers
        self._radiance_at, self._pose_at, self._depth_at = radiance_at, pose_at, depth_at
        self._grid_camera = grid_camera(sensor.camera)
        self._delays = row_delays(sensor.camera, interval_s)
        self._render_px, self._lag_mk = render_px, lag_mk
        self.pixels, self.last_counts = None, None

    def read(self, index, time_s, radiance):
        """Return (counts (H, W) uint16, how they were made) of one frame; frames come in order.

        Parameters
        ----------
        index : int
            Number of the frame, from 0 at the start of the flight.
        time_s : float
            The frame's time: the middle of its read-out [s].
        radiance : (H, W) float32
            As seen at that time [W m⁻² sr⁻¹].

        Returns
        -------
        counts : (H, W) uint16
        how : dict
            frozen (by a flat-field correction), and as by `signal`.
        """
        moment = in_sequence(self.sensor.camera, index, index * self.interval_s)
        if moment.frozen and self.last_counts is not None:
            # The shutter stays closed for many time constants: nothing of before is remembered.
            self.pixels = None
            return self.last_counts, {"frozen": True, "motion_px": None, "instants": 0, "renders": 1, "lag_mk": None}
        signal, how = self.signal(moment, time_s, radiance)
        self.last_counts = self.sensor.counts(signal, moment)
        return self.last_counts, {"frozen": False, **how}

    def signal(self, moment, time_s, radiance):
        """Return (signal (H, W) float32 [W], how it was made) that the read-out of one frame starts from.

        `how` holds motion_px (of the view within a time constant), instants, renders (those of a part of the image
        too), and lag_mk: estimated error of the lag, root mean square over the frame [mK].
        """
        relief, interpolates, before = self._relief(time_s), bool(self._render_px), self.pixels
        motion, gradient_mk = self._motion_px(relief, time_s), _gradient_mk(radiance, self.sensor)
        # The next frame starts from pixels that were followed through instants, and from what they err by.
        contrast, moved_s, carried = gradient_mk / _FITTED_GRADIENT_MK, 0.0, 0.0
        # What moves little in a short time constant may move more while the rows are read.
        late = np.std(self._delays) / (self.sensor.camera.time_constant_s or np.inf)
        reading = motion * max(late, 1.0)
        if reading <= STATIC_PX:
            signal = self._static(time_s, self.sensor.power(radiance, moment))
            instants, renders, error = 1, 1, motion * np.hypot(1.0, late) * gradient_mk
        elif reading <= SUBPIXEL_PX and interpolates and self.sensor.camera.time_constant_s:
            image = self.sensor.blurred(radiance)
            signal = self._subpixel(relief, time_s, image, moment)
            moved_s = _AGES[-1] * self.sensor.camera.time_constant_s - self._delays[0]
            error = np.hypot(_moved_mk(image, self.sensor, motion), _SUBPIXEL_MK * motion**2 * contrast)
            instants, renders = len(_AGES), 1
        else:
            plan = self._schedule(time_s, motion, contrast, self._since(time_s, before), self._render_px)
            image = self.sensor.blurred(radiance)
            plan = self._seen(plan, relief, image) if interpolates else plan
            signal, error = self._fast(plan, relief, image, moment)
            instants, renders, moved_s = len(plan.times_s), len(plan.renders), self._moved_s(plan)
            if len(plan.renders) < len(plan.times_s):
                error = np.hypot(error, _moved_mk(image, self.sensor, motion))
            carried = error**2
        parts = self._parts(time_s, before, moved_s)
        remembered = self._remembered_mk(time_s, before) ** 2
        square = error**2 + remembered
        followed = remembered + carried
        if parts:
            # Pixels that stand still may be read as they are: what is written into the frame is not what they are.
            signal = signal.copy()
            for part in parts:
                count, own = self._follow(part, motion, before, moment, time_s, radiance, signal)
                # The frame's own image is among its instants.
                renders, instants = renders + count - 1, max(instants, count)
                share = signal[part.rows, part.columns].size / signal.size
                square += (own**2 - error**2) * share
                followed += (own**2 - carried) * share
        error = np.sqrt(square)
        if self.pixels is not None:
            self.pixels = replace(self.pixels, error_mk=float(np.sqrt(followed)))
        made = {"motion_px": round(motion, 3), "instants": instants, "renders": renders}
        return signal, made | {"lag_mk": round(float(error), 1)}

    def state(self):
        """Return {name: array} of what the next frame depends on."""
        arrays = {"counts": self.last_counts} if self.sensor.camera.ffc_interval_s else {}
        if self.pixels is not None:
            arrays |= {name: np.float64(getattr(self.pixels, name)) for name in ("time_s", "error_mk")}
            arrays |= {"signal": self.pixels.signal, "power": self.pixels.power}
        return arrays

    def restore(self, arrays):
        """Take over a `state`."""
        self.last_counts = arrays.get("counts")
        self.pixels = None
        if "signal" in arrays:
            time_s, error_mk = (float(arrays[name]) for name in ("time_s", "error_mk"))
            self.pixels = PixelState(time_s, arrays["signal"], arrays["power"], error_mk)

    def _span_s(self):
        """A time constant; without one only the read-out of the rows takes time [s]."""
        return self.sensor.camera.time_constant_s or self._delays[-1] - self._delays[0]

    def _relief(self, time_s):
        """What the view at a time shows, as far as that moves its image."""
        pose = self._pose_at(time_s)
        return Relief(self.sensor.camera, pose, self._depth_at(pose, self._grid_camera))

    def _motion_px(self, relief, time_s):
        """Motion of the view in a time constant: between its ends or, as it may come back, by its speed [px]."""
        span = self._span_s()
        motion = relief.motion_px(self._pose_at(time_s - span))
        if span <= _SHORT_S:
            return motion
        return max(motion, relief.motion_px(self._pose_at(time_s - _SHORT_S)) * span / _SHORT_S)

    def _remembered_mk(self, time_s, before):
        """How much of the error of the state `before` pixels remember at the end of a frame [mK]."""
        if before is None:
            return 0.0
        passed = time_s + self._delays[-1] - before.time_s
        return before.error_mk * float(response_weights(passed, self.sensor.camera.time_constant_s)[0])

    def _since(self, time_s, before):
        """From when on the power matters to a frame whose pixels were left in the state `before` [s]."""
        since_s = time_s + self._delays[0] - MEMORY * self.sensor.camera.time_constant_s
        return since_s if before is None else max(since_s, before.time_s)

    def _schedule(self, time_s, motion, contrast, since_s, render_px):
        lag_mk = self._lag_mk / max(contrast, 1e-6)
        return schedule(time_s, self._delays, self.sensor.camera.time_constant_s, motion, since_s, lag_mk, render_px)

    def _seen(self, plan, relief, image):
        """A Schedule that renders also what the images before and after do not see: of its last instant, of its first
        row's, and of that a time constant before."""
        times, here, renders = plan.times_s, _sample(image.shape), plan.renders
        for age in (None, 0.0, 1.0):
            number = len(times) - 1
            if age is not None:
                since = plan.row_times_s[0] - age * self.sensor.camera.time_constant_s
                number = max(int(np.searchsorted(times, since, "right")) - 1, 0)
            after = np.searchsorted(renders, number)
            unseen = np.exp(-(age or 0.0))
            for at in {renders[max(after - 1, 0)], renders[min(after, len(renders) - 1)], plan.own}:
                column, row = relief.source_pixels(self._pose_at(times[at]), self._pose_at(times[number]))
                column, row = column[here], row[here]
                guess = guess_of(image, column, row)
                # What the frame's own image has on its rim tells how much is not known beyond another's.
                unseen = unseen * (guess if at == plan.own else guess > 0.0)
            if number not in renders and np.sqrt(np.mean(unseen**2)) > self._lag_mk * _per_mk(self.sensor):
                renders = np.union1d(renders, number)
        return replace(plan, renders=renders)

    def _moved_s(self, plan):
        """How far in time images are moved between the renders of a Schedule, where that is not long forgotten [s]."""
        if not self._render_px:
            return 0.0
        rendered = np.union1d(plan.times_s[[0, -1]], plan.times_s[plan.renders])
        ages = plan.row_times_s[0] - rendered[1:]
        return float(np.diff(rendered)[ages <= _GHOST_AGE * self.sensor.camera.time_constant_s].max())

    def _parts(self, time_s, before, moved_s):
        """Parts of the frame that things with a course of their own change within the pixels' memory."""
        if not self._movers:
            return []
        since_s, until_s = self._since(time_s, before), time_s + self._delays[-1]
        if since_s >= until_s:
            return []
        return movers.parts(self.sensor.camera, self._pose_at, self._movers, since_s, until_s, _MARGIN_PX, moved_s)

    def _follow(self, part, motion, before, moment, time_s, radiance, signal):
        """Put the signal of a part of the image into `signal`, followed through rendered instants of its own.

        Returns
        -------
        instants : int
        error_mk : float
            Estimate, root mean square: by how much it differs through half the instants between bends, and not
            below that of their spacing [mK].
        """
        camera, since_s = self.sensor.camera, self._since(time_s, before)
        here = part.rows, part.columns
        # What crosses the part between two frames is not in their own images.
        contrast = max(_gradient_mk(radiance[here], self.sensor, 1) / _FITTED_GRADIENT_MK, 1.0)
        # Behind what goes with the camera, the ground moves.
        motion = max(part.px_per_s * self._span_s(), motion, 1e-9)
        plan = self._schedule(time_s, motion, contrast, since_s, 0.0)
        times = np.unique([*plan.times_s, *part.bends_s, *part.warming_s])
        wide = part.around(camera.height, camera.width)
        inner = tuple(slice(a.start - b.start, a.stop - b.start) for a, b in zip(here, wide, strict=True))
        part_of = camera.part(*wide)
        offset, gain = self.sensor.power_law(moment)
        offset, gain = offset[here], gain[here]

        def powers():
            for at in times:
                image = radiance[wide] if at == time_s else self._radiance_at(at, part_of, time_s)
                yield at, offset + gain * self.sensor.blurred(image)[inner]

        state, rows = None, plan.row_times_s[part.rows]
        if before is not None and before.time_s == times[0]:
            state = PixelState(before.time_s, before.signal[here], before.power[here])
        # All at once, since powers are rendered; of two instants next to each other only one tells something.
        kept = np.isin(times, [times[0], *part.bends_s])
        fine, *coarser = (_Follower(state, rows, camera.time_constant_s, signal[here].shape) for _ in range(3))
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
        per_mk = gain * _per_mk(self.sensor)
        apart = [np.mean(((fine.signal - coarse.signal) / per_mk) ** 2) for coarse in coarser]
        return len(times), max(float(np.sqrt(max(apart))), _instants_mk(plan.spacing_px, motion) * contrast)

    def _static(self, time_s, power):
        time_constant_s, end_s = self.sensor.camera.time_constant_s, time_s + self._delays[-1]
        if not time_constant_s:
            return power
        before = self.pixels or steady(end_s, power)
        self.pixels = stepped(before, end_s, power, time_constant_s)
        passed = np.maximum(time_s + self._delays - before.time_s, 0.0)
        old = response_weights(passed, time_constant_s)[0].astype(np.float32)
        if old[0] < SETTLED:
            return power
        return power + old[:, None] * (before.signal - power)

    def _subpixel(self, relief, time_s, image, moment):
        """The signal of each row at its own time, from one image that is moved to a few ages, (H, W) float32 [W]."""
        camera = self.sensor.camera
        column, row = pixel_grid(camera)
        # So little motion is the same to and fro.
        right, down = relief.source_pixels(self._pose_at(time_s - camera.time_constant_s), self._pose_at(time_s))
        np.subtract(column, right, out=right)
        np.subtract(row, down, out=down)
        total = np.zeros_like(image)
        for age, weight in zip(_AGES, _WEIGHTS.astype(np.float32), strict=True):
            ago = (age - self._delays / camera.time_constant_s).astype(np.float32)[:, None]
            # The blur of linear interpolation counts little at a small weight.
            total += weight * moved(image, column + right * ago, row + down * ago, coarsely=weight < 0.2)
        # Of a static scene, the next frame's own image tells the past.
        self.pixels = None
        return self.sensor.power(total, moment, blurred=True)

    def _fast(self, plan, relief, image, moment):
        """The signal of each row at its own time from the image at the frame's time, and the error of its lag.

        Returns
        -------
        signal : (H, W) float32
            [W]
        error_mk : float
            Root mean square, on every so many rows and columns: of the instants, by half of them, and of what no image
            saw [mK].
        """
        camera, times = self.sensor.camera, plan.times_s
        state = self.pixels if self.pixels is not None and self.pixels.time_s >= times[0] else None
        follower = _Follower(state, plan.row_times_s, camera.time_constant_s, image.shape)
        here = _sample(image.shape)
        rows = plan.row_times_s[here[0][:, 0]]
        if state is not None:
            state = PixelState(state.time_s, state.signal[here], state.power[here])
        shape = image[here].shape
        *coarser, unseen = (_Follower(one, rows, camera.time_constant_s, shape) for one in (state, state, None))
        for number, (time_s, power, guess) in enumerate(self._powers(plan, relief, image, moment, here)):
            last = number == len(times) - 1
            follower.step(time_s, power, last)
            for odd, one in enumerate(coarser):
                if number % 2 == odd or number == 0 or last:
                    one.step(time_s, power[here], last)
            unseen.step(time_s, guess, last)
        self.pixels = follower.pixels
        per_mk = self.sensor.power_law(moment)[1] * _per_mk(self.sensor)
        per_mk = np.broadcast_to(per_mk, image.shape)[here]
        apart = [np.mean(((follower.signal[here] - one.signal) / per_mk) ** 2) for one in coarser]
        guessed = np.mean((unseen.signal / _per_mk(self.sensor)) ** 2)
        return follower.signal, float(np.sqrt(_BY_HALF**2 * max(apart) + guessed))

    def _powers(self, plan, relief, image, moment, here):
        """Yield (time, absorbed power, and of some pixels what radiance is guessed by) of each instant, in order."""
        times, renders, seen = plan.times_s, plan.renders, {plan.own: image}
        for number, time_s in enumerate(times):
            before = renders[max(np.searchsorted(renders, number, "right") - 1, 0)]
            after = renders[min(np.searchsorted(renders, number), len(renders) - 1)]
            for render in (before, after):
                if render not in seen:
                    made = self._radiance_at(times[render], self.sensor.camera, times[plan.own])
                    seen[render] = self.sensor.blurred(made)
            images = [(times[render], seen[render]) for render in dict.fromkeys((before, after))]
            seen = {render: made for render, made in seen.items() if render >= before}
            interpolated, guess = self._interpolated(images, relief, time_s, here)
            yield time_s, self.sensor.power(interpolated, moment, blurred=True), guess

    def _interpolated(self, images, relief, time_s, here):
        """The image at a time, from one or two images (time, (H, W) float32) of before and after, and `guess_of` it."""
        if images[0][0] == time_s:
            return images[0][1], np.zeros_like(images[0][1][here])
        camera, wanted = self.sensor.camera, self._pose_at(time_s)
        found = []
        for at, image in images:
            column, row = relief.source_pixels(self._pose_at(at), wanted)
            inside = (np.abs(column + 0.5 - 0.5 * camera.width) <= 0.5 * camera.width) & (
                np.abs(row + 0.5 - 0.5 * camera.height) <= 0.5 * camera.height
            )
            found.append((moved(image, column, row), inside, guess_of(image, column[here], row[here])))
        if len(found) == 1:
            return found[0][0], found[0][2]
        (first, in_first, guess), (second, in_second, other) = found
        share = (time_s - images[0][0]) / (images[1][0] - images[0][0])
        # Where one of them does not see the point, the other counts alone.
        weight = np.where(in_first == in_second, np.float32(share), in_second.astype(np.float32))
        second -= first
        second *= weight
        guess += weight[here] * (other - guess)
        return np.add(first, second, out=first), guess


class _Follower:
    """Pixels as they are heated from instant to instant, and their rows as they are read in between.

    Attributes
    ----------
    pixels : PixelState or None
        At the last instant; None before the first.
    signal : (H, W) float32
        The rows that have been read.
    """

    def __init__(self, pixels, row_times_s, time_constant_s, shape):
        self.pixels, self.signal = pixels, np.empty(shape, np.float32)
        self._row_times_s, self._time_constant_s, self._done = row_times_s, time_constant_s, 0

    def step(self, time_s, power, last):
        """Go on to an instant at which pixels are heated by `power`; the last reads all rows that are left."""
        if self.pixels is None:
            self.pixels = steady(time_s, power)
        until = len(self._row_times_s) if last else np.searchsorted(self._row_times_s, time_s, "right")
        if until > self._done:
            rows = slice(self._done, until)
            read_rows(self.pixels, time_s, power, self._row_times_s[rows], rows, self._time_constant_s, self.signal)
            self._done = until
        self.pixels = advanced(self.pixels, time_s, power, self._time_constant_s)


def schedule(time_s, delays, time_constant_s, motion, since_s, lag_mk=LAG_MK, render_px=RENDER_PX):
    """Return the Schedule of a frame.

    Parameters
    ----------
    time_s : float
        Of the frame [s].
    delays : (H,) array
        When each row is read, against that [s].
    time_constant_s : float
        Of a pixel [s]; where 0, `motion` is that during the read-out.
    motion : float
        Of the image within a time constant, above 0 [px].
    since_s : float
        From when on the power matters [s].
    lag_mk : float
        Estimated error allowed to the spacing of instants [mK].
    render_px : float
        Motion between two renders [px]; 0: every instant is rendered.

    Notes
    -----
    Of the integral of a curved function against e⁻ᵃ, the trapezoids' errors are balanced where their widths grow as
    e^(a/3); so do the spans between instants before the first row is read, and those between renders.
    """
    span = time_constant_s or delays[-1] - delays[0]
    rows = time_s + delays
    age_scale = 3.0 * time_constant_s or np.inf
    wanted_px = max(np.sqrt(lag_mk / _INSTANT_MK), np.cbrt(lag_mk * motion / _INSTANT_MK))
    step = wanted_px / motion * span
    while True:
        times = [rows[-1]]
        while times[-1] > since_s and len(times) <= MOST_INSTANTS:
            times.append(times[-1] - step * np.exp(max(rows[0] - times[-1], 0.0) / age_scale))
        if len(times) <= MOST_INSTANTS:
            break
        step *= 1.25
    times = np.unique([since_s, time_s, *times[:-1]])
    age = np.maximum(rows[0] - 0.5 * (times[1:] + times[:-1]), 0.0)
    travelled_px = np.concatenate([[0.0], np.cumsum(np.diff(times) * motion / span * np.exp(-age / age_scale))])
    own = int(np.searchsorted(times, time_s))
    renders = np.arange(len(times))
    if render_px:
        travelled_px -= travelled_px[own]
        least, most = (int(np.ceil(abs(end) / render_px - 0.5)) for end in travelled_px[[0, -1]])
        wanted = np.arange(-least, most + 1) * render_px
        renders = np.unique(np.abs(travelled_px[:, None] - wanted).argmin(axis=0))
    return Schedule(times, renders, own, rows, float(min(step, times[-1] - times[0]) * motion / span))


def _instants_mk(spacing_px, motion):
    """Estimated error of instants [mK] that are `spacing_px` apart at `motion` pixels per time constant."""
    return _INSTANT_MK * spacing_px**2 * min(1.0, spacing_px / motion)


def _sample(shape):
    """Every so many rows and columns of an image, with the first and last, to index it by."""
    return np.ix_(*(np.unique(np.linspace(0, n - 1, -(-n // _SAMPLED)).round().astype(int)) for n in shape))


def _per_mk(sensor):
    """Band radiance of a millikelvin [W m⁻² sr⁻¹]."""
    return 1e-3 * band_radiance_derivative(NETD_REFERENCE_K, *sensor.camera.band_um)


def _gradient_mk(radiance, sensor, every=8):
    """Root mean square change of an image from pixel to pixel [mK]; told by every so many of its rows and columns."""
    change = np.diff(radiance[::every]), np.diff(radiance[:, ::every], axis=0)
    # An image one pixel wide changes one way alone.
    return np.sqrt(0.5 * sum(float(np.mean(part**2)) for part in change if part.size)) / _per_mk(sensor)


def _moved_mk(image, sensor, motion, every=8):
    """Estimated error of an image that is moved [mK], by what cubic interpolation from every other pixel misses."""
    square = 0.0
    for lines in (image[::every], image[:, ::every].T):
        pixel = np.pad(lines, ((0, 0), (3, 3)), mode="edge")
        near, far = pixel[:, 2:-4] + pixel[:, 4:-2], pixel[:, :-6] + pixel[:, 6:]
        square += 0.5 * float(np.mean((lines - (9.0 * near - far) / 16.0) ** 2))
    return _MOVED * np.sqrt(square / (1.0 + motion / _AVERAGING_PX)) / _per_mk(sensor)
