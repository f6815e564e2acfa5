"""The pixels' memory: exponential response, rolling rows, and frames whose image moves."""

from dataclasses import replace

import numpy as np
import pytest

from thermorender.physics.planck import band_radiance, band_radiance_derivative
from thermorender.sensor import detector, motion
from thermorender.sensor.camera import load_camera
from thermorender.sensor.chain import Sensor, at_rest
from thermorender.sensor.exposure import Exposure, schedule
from thermorender.trajectory.path import pose

CAMERA = replace(load_camera("zenmuse-xt2"), width=80, height=64, ffc_interval_s=0.0)
TAU = 0.010
K295 = band_radiance(295.0, *CAMERA.band_um)
SLOPE = band_radiance_derivative(295.0, *CAMERA.band_um)


def textured(camera, place, rows=slice(None)):
    """Radiance of level ground with waves of 20 to 75 m and a span of about 1 K, seen from a pose."""
    row, column = (index[rows] for index in np.mgrid[: camera.height, : camera.width] + 0.5)
    slope = camera.directions(np.stack([column, row], axis=-1))
    ray = np.concatenate([slope, np.ones_like(slope[..., :1])], axis=-1) @ place[:3, :3].T
    x, y = (place[axis, 3] - place[2, 3] * ray[..., axis] / ray[..., 2] for axis in (0, 1))
    waves = 0.3 * np.sin(x / 6.0 + 1.0) * np.cos(y / 8.0) + 0.2 * np.cos((x + y) / 12.0)
    waves += 0.1 * np.sin((y - 0.3 * x) / 3.0)
    # Linear in radiance: fast, and no matter here.
    return (K295 + SLOPE * waves).astype(np.float32)


# --- one pixel --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rate_hz", [9.0, 30.0, 60.0])
def test_response_to_a_step_is_exponential_at_any_frame_rate(rate_hz):
    dark, light = np.zeros((2, 2), np.float32), np.ones((2, 2), np.float32)
    membrane = detector.steady(0.0, dark)
    for frame in range(1, 8):
        membrane = detector.stepped(membrane, frame / rate_hz, light, TAU)
        assert membrane.signal[0, 0] == pytest.approx(1.0 - np.exp(-frame / rate_hz / TAU), abs=1e-6)


@pytest.mark.parametrize("span_s", [1e-6, 0.003, 0.02, 0.5])
def test_response_to_a_ramp_and_its_weights(span_s):
    # P = t gives ΔT = t − τ + τ e^(−t/τ).
    old, first, last = detector.response_weights(span_s, TAU)
    assert old + first + last == pytest.approx(1.0, abs=1e-12)
    assert last * span_s == pytest.approx(span_s - TAU + TAU * np.exp(-span_s / TAU), rel=1e-6)
    # Two halves are one whole.
    half, a, b = detector.response_weights(0.5 * span_s, TAU)
    assert half * (a * 1.0 + b * 1.5) + a * 1.5 + b * 2.0 == pytest.approx(first * 1.0 + last * 2.0, rel=1e-9)


def test_without_a_time_constant_a_pixel_shows_the_present():
    assert [float(w) for w in detector.response_weights(0.01, 0.0)] == [0.0, 0.0, 1.0]


def test_response_agrees_with_a_numerical_solution():
    from scipy.integrate import solve_ivp

    power = lambda t: np.interp(t, [0.0, 0.004, 0.010, 0.030], [1.0, 3.0, -1.0, 2.0])  # noqa: E731
    solved = solve_ivp(lambda t, y: (power(t) - y) / TAU, (0.0, 0.030), [0.5], rtol=1e-10, atol=1e-12, max_step=1e-4)
    membrane = detector.Membrane(0.0, np.float32(0.5), np.float32(1.0))
    for time_s in (0.004, 0.010, 0.030):
        membrane = detector.advanced(membrane, time_s, np.float32(power(time_s)), TAU)
    assert membrane.signal == pytest.approx(solved.y[0, -1], abs=1e-6)


def test_rows_are_read_one_after_another():
    delays = detector.row_delays(CAMERA)
    assert np.diff(delays) == pytest.approx(63.5e-6) and delays.sum() == pytest.approx(0.0, abs=1e-12)
    # No slower than the frames themselves.
    assert np.diff(detector.row_delays(CAMERA, 1e-3)) == pytest.approx(1e-3 / 64)
    # A step at time 0: each row knows of it for as long as since then.
    dark, light = np.zeros((64, 80), np.float32), np.ones((64, 80), np.float32)
    out = np.empty((64, 80), np.float32)
    membrane = detector.Membrane(0.0, dark, light)
    times = delays - delays[0]
    detector.read_rows(membrane, times[-1], light, times, slice(0, 64), TAU, out)
    np.testing.assert_allclose(out[:, 5], 1.0 - np.exp(-times / TAU), atol=1e-6)


# --- motion -----------------------------------------------------------------------------------------------------


def test_motion_in_pixels_by_hand():
    camera = load_camera("zenmuse-xt2")
    f = camera.focal_length_px
    down = lambda e, n, u, yaw: pose(e, n, u, yaw, -90.0)  # noqa: E731
    assert motion.motion_px(camera, down(0, 0, 100, 0), down(0, 0, 100, 0), 0.0) == pytest.approx(0.0, abs=1e-9)
    moved = motion.motion_px(camera, down(2, 0, 110, 0), down(0, 0, 110, 0), 10.0)
    assert moved == pytest.approx(f * 2 / 100, rel=1e-6)
    # A turn about the optical axis moves the corner by the chord.
    chord = 2.0 * np.hypot(320, 256) * np.sin(np.radians(3.6) / 2)
    assert motion.motion_px(camera, down(0, 0, 100, 3.6), down(0, 0, 100, 0), 0.0) == pytest.approx(chord, rel=1e-6)
    # Above the horizon a shift moves nothing, a turn everything.
    level = lambda e, yaw: pose(e, 0, 100, yaw, 40.0)  # noqa: E731
    assert motion.motion_px(camera, level(5, 0), level(0, 0), 0.0) == pytest.approx(0.0, abs=1e-9)
    assert motion.motion_px(camera, level(0, 1), level(0, 0), 0.0) > f * np.radians(1) * np.cos(np.radians(60))


@pytest.mark.parametrize("distortion", [(0.0,) * 5, (-0.25, 0.06, 1e-3, -1e-3, 0.0)])
def test_an_image_moved_over_level_ground_is_that_seen_from_there(distortion):
    camera = replace(load_camera("zenmuse-xt2"), width=160, height=128, distortion=distortion, focal_length_mm=4.0)
    here, there = pose(0, 0, 40, 10, -75, 2), pose(0.6, 0.4, 40.5, 13, -74, 0)
    seen, wanted = textured(camera, here), textured(camera, there)
    moved, inside = motion.warped(camera, seen, motion.homography(here, there, 0.0), True)
    assert 0.8 < inside.mean() < 1.0
    # Cubic interpolation; off the net of so wide and distorted a view a twentieth of a pixel.
    whole = np.sqrt(np.mean((seen - wanted) ** 2))
    assert np.sqrt(np.mean((moved - wanted)[inside > 0] ** 2)) < 0.02 * whole


# --- frames -----------------------------------------------------------------------------------------------------


def rocket(time_s):
    """One turn a second and 200 m/s at 100 m."""
    return pose(0.0, 204.0 * time_s, 100.0, 360.0 * time_s, -90.0)


def exposure(camera, path, rate_hz=30.0, warp=True):
    looks = []

    def look(time_s):
        looks.append(time_s)
        return textured(camera, path(time_s))

    return Exposure(Sensor(camera, 0), look, path, lambda place: 0.0, 1.0 / rate_hz, warp), looks


def radiance_of(signal, taken):
    """What a signal stands for [W m⁻² sr⁻¹]."""
    one = taken.sensor.power(np.ones_like(signal), at_rest(taken.sensor.camera), blurred=True)
    return signal / one


# As wide a view as the camera's own and as slow a read-out, on coarser pixels, without the lens's blur.
COARSE = replace(CAMERA, pixel_pitch_um=17.0 * 8, row_time_us=63.5 * 8, diffraction=False, blur_sigma_px=0.0)


@pytest.mark.parametrize("warp", [False, True])
def test_a_rolling_and_racing_view_is_right_against_64_instants_per_time_constant(warp):
    taken, looks = exposure(COARSE, rocket, warp=warp)
    now = textured(COARSE, rocket(0.0))
    counts, how = taken.read(0, 0.0, now)
    assert 4.5 < how["motion_px"] < 5.5 and how["renders"] == len(looks) + 1
    assert how["renders"] < 0.5 * how["instants"] if warp else how["renders"] == how["instants"]
    taken.membrane = None
    plan = schedule(0.0, taken._delays, TAU, taken._motion(0.0), taken._since(0.0), warp)
    seen = radiance_of(taken._moving(plan, now, at_rest(COARSE)), taken)
    times = (np.arange(-8 * 64, 0) + 0.5) / 64 * TAU
    weight = np.exp(times / TAU)
    rows = range(3, 64, 12)
    expected = []
    for row in rows:
        past = [textured(COARSE, rocket(taken._delays[row] + t), slice(row, row + 1))[0] for t in times]
        expected.append(np.average(past, axis=0, weights=weight))
    expected = np.array(expected)
    mk = lambda image: 1e3 / SLOPE * np.sqrt(np.mean((image - expected) ** 2))  # noqa: E731
    assert mk(seen[list(rows)]) < 20.0
    assert mk(now[list(rows)]) > 100.0


def test_a_slow_view_is_one_image_with_the_memory_of_those_before():
    camera = replace(COARSE, row_time_us=0.0)
    slow = lambda time_s: pose(0.2 * time_s, 0.0, 100.0, 0.0, -90.0)  # noqa: E731
    taken, looks = exposure(camera, slow, rate_hz=30.0)
    rng = np.random.default_rng(0)
    images = [(K295 + rng.normal(size=(64, 80))).astype(np.float32) for _ in range(4)]
    expected, old = images[0].astype(float), np.exp(-1 / 30.0 / TAU)
    for index, image in enumerate(images):
        how = taken.read(index, index / 30.0, image)[1]
        expected = image + old * (expected - image)
        assert (how["instants"], how["renders"]) == (1, 1) and how["motion_px"] < 0.1
    np.testing.assert_allclose(radiance_of(taken.membrane.signal, taken), expected, rtol=1e-6)
    assert not looks


@pytest.mark.parametrize("path", [rocket, lambda time_s: pose(0, 0, 100, 0, -90)])
def test_a_state_restored_gives_the_same_bytes(path):
    def read(taken, index):
        return taken.read(index, index / 30.0, textured(COARSE, path(index / 30.0)) + 10.0 * index)[0].tobytes()

    whole, _ = exposure(COARSE, path)
    frames = [read(whole, index) for index in range(3)]
    part, _ = exposure(COARSE, path)
    for index in range(2):
        read(part, index)
    resumed, _ = exposure(COARSE, path)
    resumed.restore({name: np.array(value) for name, value in part.state().items()})
    assert read(resumed, 2) == frames[2]
    # It is what is remembered that makes them so.
    fresh, _ = exposure(COARSE, path)
    assert read(fresh, 2) != frames[2]


def test_a_frozen_image_is_the_last_one_before():
    camera = replace(COARSE, ffc_interval_s=0.2, ffc_duration_s=0.08)
    taken, _ = exposure(camera, lambda time_s: pose(0, 0, 100, 0, -90))
    scene = textured(camera, pose(0, 0, 100, 0, -90))
    counts = [taken.read(index, index / 30.0, scene + 0.1 * index)[0] for index in range(10)]
    told = [taken.read(index, index / 30.0, scene)[1]["frozen"] for index in range(6, 10)]
    assert all((counts[index] == counts[5]).all() for index in (6, 7, 8))
    assert (counts[9] != counts[5]).any() and told == [True, True, True, False]


def test_schedule_grows_coarser_with_age_and_is_bounded():
    delays = detector.row_delays(load_camera("zenmuse-xt2"))
    plan = schedule(5.0, delays, TAU, 40.0, 5.0 + delays[0] - 0.08, True)
    gaps = np.diff(plan.times_s)
    assert plan.times_s[0] == pytest.approx(5.0 + delays[0] - 0.08) and plan.times_s[-1] == 5.0 + delays[-1]
    assert plan.times_s[plan.own] == 5.0 and plan.own in plan.renders
    # Three pixels at 40 pixels a time constant, and e^(8/3) times that at the oldest.
    assert gaps[-10:].max() == pytest.approx(3.0 / 40.0 * TAU) and gaps[1] > 8.0 * gaps[-1]
    assert 8 <= len(plan.renders) <= 16 and 60 <= len(plan.times_s) <= 100
    assert len(schedule(5.0, delays, TAU, 1e5, 4.9, False).times_s) <= 403
    few = schedule(5.0, delays, TAU, 0.6, 5.0 + delays[0] - 0.08, True)
    assert len(few.renders) == 1 and len(few.times_s) <= 5
