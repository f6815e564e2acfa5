"""At which instants a frame follows the power on its pixels, which of them are rendered, and the estimated error.

Distances in time are motion of the image: v pixels within a time constant, or within the integration time of a photon
detector, whose instants are as close as those of an exponential past. The constants below are estimates, fitted
to the scenes they name, not bounds.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.physics.planck import band_radiance_derivative
from thermorender.sensor.camera import Camera, Image
from thermorender.sensor.noise import NETD_REFERENCE_K

# Motion within a time constant up to which a frame is one image [px].
STATIC_PX = 0.02
# Motion up to which one image, moved along straight lines to a few ages, represents the past [px].
SUBPIXEL_PX = 0.8
# Motion above which much of what pixels remember lies beyond the border of later images [px].
FAR_PX = 3.0
# Time constants that a pixel remembers: e⁻⁸ of 15 K is 5 mK.
MEMORY = 8.0
# Estimated error allowed to the spacing of instants [mK], and motion between two renders [px].
LAG_MK, RENDER_PX = 10.0, 20.0
MOST_INSTANTS = 400
# Error of instants d pixels apart: the first times d² min(1, d/v). Error of moving one image to a few ages: the second
# times v². Both for an image whose radiance changes by the third from pixel to pixel, and proportional to that change;
# fitted to heath from 100 and 120 m.
INSTANT_MK, SUBPIXEL_MK, FITTED_GRADIENT_MK = 12.0, 42.0, 700.0
# A moved image lacks detail finer than its pixels. With e the root mean square error of interpolation between every
# other pixel and g the change from pixel to pixel, the error at d pixels from a render is estimated as the first times
# (e²/g) d/√(d² + the second²): the larger e/g, the more of the image is aliased. A pixel that moves averages: over
# √(1 + v^1.5). Fitted from above to eight views of three scenes from 15 to 300 m, and to waves of 1/5 of a pixel to 150
# pixels.
_MOVED, _DETAIL_PX = 0.9, 0.2
# Step in rows and columns between the pixels that sample the error of a frame.
_SAMPLED = 4


@dataclass(frozen=True)
class Schedule:
    """Instants of one frame."""

    times_s: NDArray[np.float64]  # (n,) float64 increasing; the last is that of the last row [s]
    renders: NDArray[np.int64]  # (m,) int64 indices of the rendered instants
    own: int  # Index of the frame's own time; it is rendered
    row_times_s: NDArray[np.float64]  # (H,) float64 when each row is read [s]
    spacing_px: float  # Motion between two instants [px]

    def moved_middles(self, time_constant_s: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return (time to the nearest render [time constants], share of the signal) of each middle of two instants.

        Without a time constant, the read-out replaces it.
        """
        times, rows = 0.5 * (self.times_s[1:] + self.times_s[:-1]), self.row_times_s
        gaps = np.abs(times[:, None] - self.times_s[self.renders]).min(axis=1)
        weights = np.diff(self.times_s)
        if time_constant_s:
            ages = (rows[:, None] - times) / time_constant_s
            weights *= np.where(ages >= 0.0, np.exp(-np.maximum(ages, 0.0)), 0.0).mean(axis=0)
        return gaps / (time_constant_s or rows[-1] - rows[0]), weights / weights.sum()


def schedule(
    time_s: float, delays: NDArray[np.float64], time_constant_s: float, motion: float, since_s: float,
    lag_mk: float = LAG_MK, render_px: float = RENDER_PX,
) -> Schedule:  # fmt: skip
    """Return the Schedule of a frame at `time_s` whose rows are read `delays` (H,) [s] later.

    `motion` is that of the image within a time constant [px], or during the read-out without one; power before
    `since_s` does not matter. `lag_mk` is the estimated error allowed to the spacing, `render_px` the motion between
    two renders (0: all). Spans grow with age a as e^(a/3), which balances the errors of the trapezoids in an integral
    against e⁻ᵃ.
    """
    span = time_constant_s or delays[-1] - delays[0]
    rows = time_s + delays
    age_scale = 3.0 * time_constant_s or np.inf
    wanted_px = max(np.sqrt(lag_mk / INSTANT_MK), np.cbrt(lag_mk * motion / INSTANT_MK))
    step = wanted_px / motion * span
    while True:
        back = [rows[-1]]
        while back[-1] > since_s and len(back) <= MOST_INSTANTS:
            back.append(back[-1] - step * np.exp(max(rows[0] - back[-1], 0.0) / age_scale))
        if len(back) <= MOST_INSTANTS:
            break
        step *= 1.25
    times = np.unique(np.array([since_s, time_s, *back[:-1]]))
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


def plan_row(camera: Camera) -> tuple[str, str, str]:
    """Return the cost of the pixels' memory in a flight, as an (item, in or out, why) row of a plan."""
    if camera.memory_s == 0.0:
        return ("sub-frames", "out", "this camera's pixels have no memory")
    why = f"one render where a flight's view moves up to {SUBPIXEL_PX:g} px in {1e3 * camera.memory_s:g} ms"
    return ("sub-frames", "by motion", f"{why}; above that as many as keep an estimated {LAG_MK:g} mK")


def past_s(camera: Camera) -> float:
    """Return the time before a read-out whose light matters [s]."""
    return camera.memory_s if camera.well_electrons else MEMORY * camera.time_constant_s


def instants_mk(spacing_px: float, motion: float) -> float:
    """Return the estimated error of instants `spacing_px` apart, at `motion` pixels per time constant [mK]."""
    return INSTANT_MK * spacing_px**2 * min(1.0, spacing_px / motion)


def moved_mk(
    image: Image, camera: Camera, way: tuple[Image, Image], motion: float, gaps: NDArray[np.float64],
    weights: NDArray[np.float64], counts: NDArray[np.bool_], lines_read: int = 40,
) -> float:  # fmt: skip
    """Return the estimated error of moved images [mK], from cubic interpolation between every other pixel.

    `image` (H, W) is band radiance [W m⁻² sr⁻¹] and `way` its motion within a time constant to the right and down [px],
    of which at most `motion` counts. `gaps` and `weights` (n,) are the times from instants to the nearest render [time
    constants] and their shares of the signal. The error is the root mean square over the pixels of `counts` (H, W),
    read in about `lines_read` rows and as many columns.
    """
    every = max(min(image.shape) // lines_read, 1)
    # An error along an axis arises from motion along it.
    speeds = np.geomspace(1e-3, 1.0, 25) * max(motion, 1e-6)
    square_px = np.square(np.multiply.outer(speeds, gaps))
    shares = square_px / (square_px + _DETAIL_PX**2) @ weights / (1.0 + speeds**1.5) / speeds**2
    square = 0.0
    right, down = way
    # Along rows, then along columns.
    for radiance, counted, onwards, sideways in ((image, counts, right, down), (image.T, counts.T, down.T, right.T)):
        here: NDArray[np.bool_] = counted[::every]
        lines, along, across = (part[::every] for part in (radiance, onwards, sideways))
        between = here[:, 1:] & here[:, :-1]
        if not between.any():
            continue
        pixel = np.pad(lines, ((0, 0), (3, 3)), mode="edge")
        near, far = pixel[:, 2:-4] + pixel[:, 4:-2], pixel[:, :-6] + pixel[:, 6:]
        rough = np.square(lines - (9.0 * near - far) / 16.0)
        change = float(np.mean(np.diff(lines) ** 2, where=between))
        aliased = float(np.mean(rough, where=here)) / max(change, 1e-30)
        speed = np.hypot(along, across)
        share = np.interp(speed, speeds, shares) * along**2 * np.minimum(1.0, motion / np.maximum(speed, 1e-9)) ** 2
        square += aliased * float(np.mean(rough * share, where=here))
    return _MOVED * float(np.sqrt(square)) / per_mk(camera)


def unmoved_mk(image: Image, camera: Camera, motion: float, gradient: float) -> float:
    """Return the estimated error of one image in place of a time constant with so little motion [px], [mK]."""
    way = np.broadcast_to(np.float32(motion / np.sqrt(2.0)), image.shape)
    detail = moved_mk(image, camera, (way, way), motion, np.ones(1), np.ones(1), np.ones(image.shape, bool), 20)
    # Along one direction, an image changes by up to √2 of `gradient_mk`, the mean over both axes.
    return float(np.hypot(np.sqrt(2.0) * motion * gradient, detail))


def gradient_mk(radiance: Image, camera: Camera, every: int = 8) -> float:
    """Return the root mean square change from pixel to pixel [mK], from every eighth row and column."""
    change = np.diff(radiance[::every]), np.diff(radiance[:, ::every], axis=0)
    # An image one pixel wide changes along one axis only.
    return float(np.sqrt(0.5 * sum(float(np.mean(part**2)) for part in change if part.size)) / per_mk(camera))


def per_mk(camera: Camera) -> float:
    """Return the band radiance of one millikelvin at 300 K [W m⁻² sr⁻¹]."""
    return 1e-3 * band_radiance_derivative(NETD_REFERENCE_K, *camera.band_um)


def sample(shape: tuple[int, ...]) -> tuple[NDArray[np.int64], ...]:
    """Return the index of every fourth row and column of an image, the first and last included."""
    return np.ix_(*(np.unique(np.linspace(0, n - 1, -(-n // _SAMPLED)).round().astype(int)) for n in shape))


def sample_mean(values: NDArray[np.floating[Any]], shape: tuple[int, ...]) -> float:
    """Return the mean over an image of values at its `sample`, each for the pixels closest to it."""
    for index in sample(shape):
        at = index.ravel()
        between = 0.5 * (at[1:] + at[:-1])
        widths = np.diff([at[0], *between, at[-1]]) if len(at) > 1 else [1]
        values = np.average(values, axis=0, weights=widths)
    return float(values)
