"""Stability of pixels with memory: views that turn, objects that move and blink, any time constant and frame time.

Radiance is a closed form of place and time here, and nothing is rendered. The tolerance is the frames' stated lag plus
the light from before their memory begins.
"""

from dataclasses import replace
from itertools import product

import numpy as np

from tests.robustness.cases import Found, case
from thermorender import defaults
from thermorender.physics.planck import band_radiance, band_radiance_derivative
from thermorender.sensor.camera import load_camera
from thermorender.sensor.chain import in_sequence, sensor_of
from thermorender.sensor.exposure import Exposure
from thermorender.sensor.movers import Mover
from thermorender.sensor.schedule import MEMORY
from thermorender.trajectory.path import pose

_HEIGHT_M, _GROUND_K, _FRAMES = 120.0, 290.0, 4
# Time constants [ms] and times from frame to frame [ms].
_PACES = tuple(product((0.0, 0.1, 10.0, 1e4), (1.0, 30.0, 1000.0)))


def _camera(time_constant_ms):
    """A small camera without blur, fall-off or noise, whose rows are read simultaneously."""
    return replace(
        load_camera(defaults.CAMERA), width=80, height=64, time_constant_ms=time_constant_ms, row_time_us=0.0,
        ffc_interval_s=0.0, diffraction=False, blur_sigma_px=0.0, illumination_exponent=0.0, vignetting=0.0,
    )  # fmt: skip


def _places(camera, at):
    """(east, north) of the ground under pixel centres from a pose, each (H, W) [m]."""
    ray, depth = _rays(camera, at)
    return tuple(at[axis, 3] + depth * ray[..., axis] for axis in (0, 1))


def _rays(camera, at):
    """(Directions of pixel centres from a pose, (H, W, 3); distance to level ground in these units, (H, W))."""
    row, column = np.mgrid[: camera.height, : camera.width] + 0.5
    slope = camera.directions(np.stack([column, row], axis=-1))[..., :2]
    ray = np.concatenate([slope, np.ones((*column.shape, 1))], axis=-1) @ at[:3, :3].T
    return ray, -at[2, 3] / ray[..., 2]


def _read(pace, warm, path, movers=()):
    """(warmth above the ground in the last of some frames (H, W) [K], its stated lag [K], its time [s]).

    `warm` is a function of east and north [m] and time [s], [K].
    """
    camera, span_s = _camera(pace[0]), 1e-3 * pace[1]
    ground, slope = (f(_GROUND_K, *camera.band_um) for f in (band_radiance, band_radiance_derivative))

    def radiance(time_s, seen, lit_s=None, rim=None):
        return (ground + slope * warm(*_places(seen, path(time_s)), time_s)).astype(np.float32)

    sensor = sensor_of(camera, 0)
    taken = Exposure(sensor, radiance, path, lambda at, seen: _rays(seen, at)[1], span_s, movers=movers)
    moment = in_sequence(camera, 0, 0.0)
    for now in span_s * np.arange(_FRAMES):
        signal, how = taken.signal(moment, now, radiance(now, camera))
    offset, gain = sensor.power_law(moment)
    return ((signal - offset) / gain - ground) / slope, 1e-3 * how["lag_mk"], now


def _judged(found, expected, stated, rises, tau):
    """RMS of a frame: its stated lag; the lag where memory begins, for a rise at this rate [K/s] by up to 45 K; and an
    ulp of radiance at 290 K, 4e-6 K, at each of some instants."""
    forgotten = np.exp(-MEMORY) * min(rises * tau, 45.0)
    return Found(float(np.sqrt(np.mean((found - expected) ** 2))), 0.0, stated + forgotten + 1e-4)


@case("motion", "a view that turns once a second, a pixel of {0[0]:g} ms in frames of {0[1]:g} ms", _PACES)
def turning(pace):
    """Ground that warms by 0.2 K per metre to the east: cos ωt is read as (cos ωt + ωτ sin ωt) / (1 + ω²τ²)."""
    rate, tau = 2.0 * np.pi, 1e-3 * pace[0]
    found, stated, now = _read(
        pace, lambda east, north, t: 0.2 * east, lambda t: pose(0.0, 0.0, _HEIGHT_M, yaw_deg=360.0 * t, pitch_deg=-90.0)
    )
    ahead, aside = (
        0.2 * _places(_camera(0.0), pose(0.0, 0.0, _HEIGHT_M, yaw_deg=yaw, pitch_deg=-90.0))[0] for yaw in (0.0, 90.0)
    )
    cosine, sine, lag = np.cos(rate * now), np.sin(rate * now), rate * tau
    expected = (ahead * (cosine + lag * sine) + aside * (sine - lag * cosine)) / (1.0 + lag**2)
    return _judged(found, expected, stated, 0.2 * 7.0 * rate, tau)


def _still(t):
    return pose(0.0, 0.0, _HEIGHT_M, pitch_deg=-90.0)


def _ramp(since_s, lag_s):
    """Response to a ramp that began then, a (t − τ (1 − e^(−t/τ))) for a of 1."""
    past = np.maximum(since_s, 0.0)
    return past + lag_s * np.expm1(-past / lag_s) if lag_s else past


@case("motion", "a plate 45 K warmer that crosses at 20 m/s, a pixel of {0[0]:g} ms in frames of {0[1]:g} ms", _PACES)
def crossing(pace):
    """Warm over 8 m, less over 4 m before and behind: four ramps at each place, 0.2 s each. The last frame shows it."""
    speed, last = 20.0, 1e-3 * pace[1] * (_FRAMES - 1)

    def warmth(east, north, t, lag_s=0.0):
        since = t - last + (6.0 - east) / speed
        bends = zip((0.0, 0.2, 0.6, 0.8), (1.0, -1.0, -1.0, 1.0), strict=True)
        total = sum(sign * _ramp(since - at, lag_s) for at, sign in bends)
        return np.where(abs(north) < 2.0, 45.0 / 0.2 * total, 0.0)

    def corners(t):
        front = 6.0 + speed * (t - last)
        return np.array([[x, y, 0.0] for x in (front - 16.0, front) for y in (-2.0, 2.0)])

    found, stated, now = _read(pace, warmth, _still, [Mover(corners, lambda t: 45.0, np.array([]))])
    tau = 1e-3 * pace[0]
    return _judged(found, warmth(*_places(_camera(0.0), _still(0.0)), now, tau), stated, 225.0, tau)


@case("motion", "a plate that blinks by 45 K at 5 Hz, a pixel of {0[0]:g} ms in frames of {0[1]:g} ms", _PACES)
def blinking(pace):
    """Rises and falls linearly over 4 m, for 80 s: each bend starts a ramp. Steps that end at bends are exact."""
    bends = np.arange(-800, 40) * 0.1
    steps = np.where(np.arange(bends.size) % 2, -900.0, 900.0)
    steps[0] = 450.0

    def warmth(t, lag_s=0.0):
        return float(steps @ _ramp(t - bends, lag_s))

    def inside(east, north):
        return (abs(east) < 2.0) & (abs(north) < 2.0)

    corners = np.array([[x, y, 0.0] for x in (-2.0, 2.0) for y in (-2.0, 2.0)])
    found, _, now = _read(pace, lambda east, north, t: inside(east, north) * warmth(t), _still,
                          [Mover(lambda t: corners, warmth, bends)])  # fmt: skip
    tau = 1e-3 * pace[0]
    return _judged(found, inside(*_places(_camera(0.0), _still(0.0))) * warmth(now, tau), 0.0, 450.0, tau)
