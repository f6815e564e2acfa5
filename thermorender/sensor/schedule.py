"""At which instants a frame follows the power on its pixels, which of them are rendered, and the estimated error.

Distances in time are motion of the image: v pixels within a time constant. The constants below are estimates, fitted
to the scenes they name, not bounds.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermorender.physics.planck import band_radiance_derivative
from thermorender.sensor.camera import Camera, Image
from thermorender.sensor.noise import NETD_REFERENCE_K

# Motion within a time constant up to which a frame is one image [px].
STATIC_PX = 0.02
# Motion up to which one image, moved along straight lines to a few ages, represents the past [px].
SUBPIXEL_PX = 0.8
# Time constants that a pixel remembers: e⁻⁸ of 15 K is 5 mK.
MEMORY = 8.0
# Estimated error allowed to the spacing of instants [mK], and motion between two renders [px].
LAG_MK, RENDER_PX = 10.0, 20.0
MOST_INSTANTS = 400
# Error of instants d pixels apart: the first times d² min(1, d/v). Error of moving one image to a few ages: the second
# times v². Both for an image whose radiance changes by the third from pixel to pixel, and proportional to that change;
# fitted to heath from 100 and 120 m.
INSTANT_MK, SUBPIXEL_MK, FITTED_GRADIENT_MK = 12.0, 42.0, 700.0
# A moved image lacks detail finer than its pixels. The root mean square error is estimated as the first times the error
# of interpolating between every other pixel, over √(1 + v / the second), since a moving pixel averages. Fitted from
# above to three scenes from 15 m to 1 km.
_MOVED, _AVERAGING_PX = 0.35, 8.0
# Step in rows and columns between the pixels that sample the error of a frame.
_SAMPLED = 4


@dataclass(frozen=True)
class Schedule:
    """Instants of one frame.

    Attributes
    ----------
    times_s : (n,) float64
        Increasing; the last is that of the last row [s].
    renders : (m,) int64
        Indices of the rendered instants.
    own : int
        Index of the frame's own time; it is rendered.
    row_times_s : (H,) float64
        When each row is read [s].
    spacing_px : float
        Motion between two instants [px].
    """

    times_s: NDArray[np.float64]
    renders: NDArray[np.int64]
    own: int
    row_times_s: NDArray[np.float64]
    spacing_px: float


def schedule(
    time_s: float, delays: NDArray[np.float64], time_constant_s: float, motion: float, since_s: float,
    lag_mk: float = LAG_MK, render_px: float = RENDER_PX,
) -> Schedule:  # fmt: skip
    """Return the Schedule of a frame.

    Parameters
    ----------
    time_s : float
        Of the frame [s].
    delays : (H,) array
        Read-out time of each row after `time_s` [s].
    time_constant_s : float
        Of a pixel [s]; where 0, `motion` is that during the read-out.
    motion : float
        Of the image within a time constant, above 0 [px].
    since_s : float
        Earliest time whose power matters [s].
    lag_mk : float
        Estimated error allowed to the spacing of instants [mK].
    render_px : float
        Motion between two renders [px]; 0: every instant is rendered.

    Notes
    -----
    In the integral of a curved function against e⁻ᵃ, the errors of the trapezoids are balanced if their widths grow as
    e^(a/3). So do the spans between instants before the first row is read, and those between renders.
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
    if camera.time_constant_ms == 0.0:
        return ("sub-frames", "out", "this camera's pixels have no memory")
    why = f"one render where a flight's view moves up to {SUBPIXEL_PX:g} px in {camera.time_constant_ms:g} ms"
    return ("sub-frames", "by motion", f"{why}; above that as many as keep an estimated {LAG_MK:g} mK")


def instants_mk(spacing_px: float, motion: float) -> float:
    """Return the estimated error of instants `spacing_px` apart, at `motion` pixels per time constant [mK]."""
    return INSTANT_MK * spacing_px**2 * min(1.0, spacing_px / motion)


def moved_mk(image: Image, camera: Camera, motion: float, every: int = 8) -> float:
    """Return the estimated error of a moved image [mK], from cubic interpolation between every other pixel."""
    square = 0.0
    for lines in (image[::every], image[:, ::every].T):
        pixel = np.pad(lines, ((0, 0), (3, 3)), mode="edge")
        near, far = pixel[:, 2:-4] + pixel[:, 4:-2], pixel[:, :-6] + pixel[:, 6:]
        square += 0.5 * float(np.mean((lines - (9.0 * near - far) / 16.0) ** 2))
    return float(_MOVED * np.sqrt(square / (1.0 + motion / _AVERAGING_PX)) / per_mk(camera))


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
