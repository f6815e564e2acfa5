"""The pixels' memory: exponential response, rolling rows, and frames whose image moves."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support import slow

from scenes import plane_depth
from thermorender.errors import ThermorenderError
from thermorender.physics.planck import band_radiance, band_radiance_derivative
from thermorender.sensor import detector, motion
from thermorender.sensor import exposure as exposure_module
from thermorender.sensor.camera import load_camera
from thermorender.sensor.chain import Sensor, at_rest
from thermorender.sensor.exposure import Exposure
from thermorender.sensor.schedule import plan_row, schedule
from thermorender.trajectory.path import pose

# No radiation of the lens, so that powers are proportional to radiance.
CAMERA = replace(
    load_camera("zenmuse-xt2"), width=80, height=64, ffc_interval_s=0.0, narcissus_mk=0.0, shading_mk=0.0,
    shading_mk_per_k=0.0,
)  # fmt: skip
TAU = 0.010
K295 = band_radiance(295.0, *CAMERA.band_um)
SLOPE = band_radiance_derivative(295.0, *CAMERA.band_um)


def textured(camera, view, rows=slice(None), depth=None, finer=1.0):
    """Radiance of ground with waves of 20 to 75 m and a range of about 1 K, seen from a pose; level if no `depth`.

    Averaged over a pixel where waves may be finer than that.
    """
    if finer > 8.0:
        size, pitch_um = (3 * camera.width, 3 * camera.height), camera.pixel_pitch_um / 3
        parts = replace(camera, width=size[0], height=size[1], pixel_pitch_um=pitch_um)
        within = slice(3 * rows.start, 3 * rows.stop) if rows.stop else rows
        image = waving(parts, view, within, depth, finer)
        return image.reshape(-1, 3, camera.width, 3).mean(axis=(1, 3))
    return waving(camera, view, rows, depth, finer)


def waving(camera, view, rows, depth, finer):
    row, column = (index[rows] for index in np.mgrid[: camera.height, : camera.width] + 0.5)
    slope = camera.directions(np.stack([column, row], axis=-1))
    ray = np.concatenate([slope, np.ones_like(slope[..., :1])], axis=-1) @ view[:3, :3].T
    far = -view[2, 3] / ray[..., 2] if depth is None else depth(view, camera)[rows]
    x, y = (finer * (view[axis, 3] + far * ray[..., axis]) for axis in (0, 1))
    waves = 0.3 * np.sin(x / 6.0 + 1.0) * np.cos(y / 8.0) + 0.2 * np.cos((x + y) / 12.0)
    waves += 0.1 * np.sin((y - 0.3 * x) / 3.0)
    # Linear in radiance: fast, and irrelevant here.
    return (K295 + SLOPE * waves).astype(np.float32)


# --- one pixel --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rate_hz", [9.0, 30.0, 60.0])
def test_response_to_a_step_is_exponential_at_any_frame_rate(rate_hz):
    dark, light = np.zeros((2, 2), np.float32), np.ones((2, 2), np.float32)
    state = detector.steady(0.0, dark)
    for frame in range(1, 8):
        state = detector.stepped(state, frame / rate_hz, light, TAU)
        assert state.signal[0, 0] == pytest.approx(1.0 - np.exp(-frame / rate_hz / TAU), abs=1e-6)


@pytest.mark.parametrize("span_s", [1e-6, 0.003, 0.02, 0.5])
def test_response_to_a_ramp_and_its_weights(span_s):
    # P = t gives ΔT = t − τ + τ e^(−t/τ).
    old, first, last = detector.response_weights(span_s, TAU)
    assert old + first + last == pytest.approx(1.0, abs=1e-12)
    assert last * span_s == pytest.approx(span_s - TAU + TAU * np.exp(-span_s / TAU), rel=1e-6)
    # Two halves equal one whole.
    half, a, b = detector.response_weights(0.5 * span_s, TAU)
    assert half * (a * 1.0 + b * 1.5) + a * 1.5 + b * 2.0 == pytest.approx(first * 1.0 + last * 2.0, rel=1e-9)


def test_without_a_time_constant_a_pixel_shows_the_present():
    assert [float(w) for w in detector.response_weights(0.01, 0.0)] == [0.0, 0.0, 1.0]


def test_response_agrees_with_a_numerical_solution():
    from scipy.integrate import solve_ivp

    power = lambda t: np.interp(t, [0.0, 0.004, 0.010, 0.030], [1.0, 3.0, -1.0, 2.0])  # noqa: E731
    solved = solve_ivp(lambda t, y: (power(t) - y) / TAU, (0.0, 0.030), [0.5], rtol=1e-10, atol=1e-12, max_step=1e-4)
    state = detector.PixelState(0.0, np.float32(0.5), np.float32(1.0))
    for time_s in (0.004, 0.010, 0.030):
        state = detector.advanced(state, time_s, np.float32(power(time_s)), TAU)
    assert state.signal == pytest.approx(solved.y[0, -1], abs=1e-6)


def test_a_slow_pixel_follows_a_step_through_many_short_frames():
    """30 000 frames of 0.1 ms, three time constants of a second: each changes less than single precision holds."""
    state = detector.steady(0.0, np.float32(50.0))
    for frame in range(1, 30_001):
        state = detector.advanced(state, 1e-4 * frame, np.float32(60.0), 1.0)
    # The power rises within the first frame, half of it on average.
    assert state.signal == pytest.approx(60.0 - 10.0 * np.exp(-3.0 + 0.5e-4), abs=1e-6)


def test_rows_are_read_one_after_another():
    delays = detector.row_delays(CAMERA)
    assert np.diff(delays) == pytest.approx(63.5e-6) and delays.sum() == pytest.approx(0.0, abs=1e-12)
    # The read-out is not slower than the frames.
    assert np.diff(detector.row_delays(CAMERA, 1e-3)) == pytest.approx(1e-3 / 64)
    # A step at time 0: each row has responded to it since then.
    dark, light = np.zeros((64, 80), np.float32), np.ones((64, 80), np.float32)
    out = np.empty((64, 80), np.float32)
    state = detector.PixelState(0.0, dark, light)
    times = delays - delays[0]
    detector.read_rows(state, times[-1], light, times, slice(0, 64), TAU, out)
    np.testing.assert_allclose(out[:, 5], 1.0 - np.exp(-times / TAU), atol=1e-6)


# --- motion -----------------------------------------------------------------------------------------------------


def relief(camera, view, ground=None):
    return motion.Relief(camera, view, (ground or plane_depth())(view, motion.grid_camera(camera)))


def test_motion_in_pixels_by_hand():
    camera = load_camera("zenmuse-xt2")
    f = camera.focal_length_px
    down = lambda e, n, u, yaw: pose(e, n, u, yaw, -90.0)  # noqa: E731
    assert relief(camera, down(0, 0, 100, 0)).motion_px(down(0, 0, 100, 0)) == pytest.approx(0.0, abs=1e-9)
    moved = relief(camera, down(2, 0, 110, 0), plane_depth(10.0)).motion_px(down(0, 0, 110, 0))
    assert moved == pytest.approx(f * 2 / 100, rel=1e-6)
    # A turn about the optical axis moves each point by its chord: at most this much for all but a fiftieth of the area.
    row, column = np.mgrid[4:512:8, 4:640:8]
    farthest = np.percentile(np.hypot(column - 320, row - 256), 98)
    chord = 2.0 * farthest * np.sin(np.radians(3.6) / 2)
    assert relief(camera, down(0, 0, 100, 3.6)).motion_px(down(0, 0, 100, 0)) == pytest.approx(chord, rel=1e-6)
    # Above the horizon a translation moves nothing, a rotation everything.
    level = lambda e, yaw: pose(e, 0, 100, yaw, 40.0)  # noqa: E731
    assert relief(camera, level(5, 0)).motion_px(level(0, 0)) == pytest.approx(0.0, abs=1e-9)
    assert relief(camera, level(0, 1)).motion_px(level(0, 0)) > f * np.radians(1) * np.cos(np.radians(60))


@pytest.mark.parametrize("size", [(640, 512), (85, 53), (3, 2)])
def test_grid_points_are_the_centres_of_their_cells(size):
    camera = replace(load_camera("zenmuse-xt2"), width=size[0], height=size[1], principal_offset_px=(3.0, -2.0))
    grid = motion.grid_camera(camera)
    cell = 8 if size[0] == 640 else 1
    assert (grid.width, grid.height) == tuple(n // cell for n in size)
    pixel = np.array([[0.5, 0.5], [grid.width - 0.5, grid.height - 0.5]])
    np.testing.assert_allclose(grid.directions(pixel), camera.directions(cell * pixel), atol=1e-12)


@pytest.mark.parametrize("distortion", [(0.0,) * 5, (-0.25, 0.06, 1e-3, -1e-3, 0.0)])
def test_an_image_moved_over_level_ground_equals_the_view_from_there(distortion):
    camera = replace(load_camera("zenmuse-xt2"), width=160, height=128, distortion=distortion, focal_length_mm=4.0)
    here, there = pose(0, 0, 40, 10, -75, 2), pose(0.6, 0.4, 40.5, 13, -74, 0)
    seen, wanted = textured(camera, here), textured(camera, there)
    column, row = relief(camera, here).source_pixels(here, there)
    moved = motion.moved(seen, column, row)
    inside = (column >= 0.0) & (column <= 159.0) & (row >= 0.0) & (row <= 127.0)
    assert 0.8 < inside.mean() < 1.0
    # Cubic interpolation; for so wide and distorted a view the grid is a twentieth of a pixel off.
    whole = np.sqrt(np.mean((seen - wanted) ** 2))
    assert np.sqrt(np.mean((moved - wanted)[inside > 0] ** 2)) < 0.02 * whole


@pytest.mark.parametrize("distortion", [(0.0,) * 5, (-0.2, 0.05, 1e-3, -1e-3, 0.0)])
@pytest.mark.parametrize("ground", [(3.0, (0.0, 0.0)), (37.5, (0.0, 0.0)), (60.0, (0.0, 0.0)), (0.0, (0.6, -0.4))])
def test_motion_of_ground_points_agrees_with_projection(ground, distortion):
    """Cameras above level and steep ground and, looking up, below it; the relief is from a third view."""
    camera = replace(load_camera("zenmuse-xt2"), distortion=distortion)
    ground_m, slope = ground
    up = -75.0 if ground_m < 40.0 else 75.0
    own, here, there = (pose(0.3 * k, 0.2 * k, 40 + 0.2 * k, 10 + 2 * k, up + k / 2, k) for k in (1, 0, 2))
    depth = plane_depth(ground_m, slope)
    column, row = relief(camera, own, depth).source_pixels(here, there)
    y, x = np.mgrid[8:504:31, 8:632:31]
    ray = np.concatenate([camera.directions(np.stack([x, y], axis=-1) + 0.5), np.ones((*x.shape, 1))], axis=-1)
    point = ray * depth(there, camera)[y, x, None] @ there[:3, :3].T + there[:3, 3]
    expected = camera.project((point - here[:3, 3]) @ here[:3, :3]) - 0.5
    inside = (np.abs(expected - (320, 256)) < (310, 246)).all(axis=-1)
    assert inside.mean() > 0.4
    np.testing.assert_allclose(np.stack([column, row], axis=-1)[y, x][inside], expected[inside], atol=0.03)


def test_the_rim_of_an_object_before_the_sky_moves_with_it():
    camera = replace(CAMERA, width=160, height=128)
    depth = np.full((64, 80), np.inf)
    depth[16:48, 20:60] = 50.0
    column, _ = motion.Relief(camera, pose(0, 0, 50, 0, -90), depth).source_pixels(
        pose(0, 0, 50, 0, -90), pose(1, 0, 50, 0, -90)
    )
    moved = column - np.arange(160, dtype=np.float32)
    assert moved[32:96, 40:120] == pytest.approx(camera.focal_length_px / 50.0, rel=1e-3)
    assert moved[:20] == pytest.approx(0.0, abs=1e-3)


def test_a_camera_on_the_ground_has_finite_motion():
    camera, here, there = load_camera("ideal"), pose(0, 0, 5, 0, -30), pose(0.01, 0, 5, 0, -30)
    for found in (relief(camera, here, plane_depth(5.0)), motion.Relief(camera, here, np.zeros((64, 80)))):
        assert np.isfinite(found.motion_px(there))
        assert np.isfinite(found.source_pixels(here, there)).all()


def test_a_linear_gradient_stays_linear_when_moved():
    column, row = np.meshgrid(np.arange(40, dtype=np.float32), np.arange(30, dtype=np.float32))
    for fraction in np.arange(0.0, 1.0, 1 / 32):
        moved = motion.moved(column + 2.0 * row, column + np.float32(fraction), row + np.float32(1.0 - fraction))
        wanted = (column + 2.0 * row + 2.0 - fraction)[3:-3, 3:-3]
        # In steps of whole 32nds of a pixel.
        np.testing.assert_allclose(moved[3:-3, 3:-3], wanted, atol=0.05)


# --- frames -----------------------------------------------------------------------------------------------------


def rocket(time_s):
    """One turn a second and 200 m/s at 100 m."""
    return pose(0.0, 204.0 * time_s, 100.0, 360.0 * time_s, -90.0)


def exposure(camera, path, rate_hz=30.0, render_px=20.0, depth=None, finer=1.0, relief_depth=None):
    rendered = []

    def radiance_at(time_s, seen_by, lit_s, rim=None):
        rendered.append(time_s)
        return textured(seen_by, path(time_s), depth=depth, finer=finer)

    relief_depth = relief_depth or depth or plane_depth()
    return Exposure(Sensor(camera, 0), radiance_at, path, relief_depth, 1.0 / rate_hz, render_px), rendered


def radiance_of(signal, taken):
    """Radiance that corresponds to a signal [W m⁻² sr⁻¹]."""
    one = taken.sensor.power(np.ones_like(signal), at_rest(taken.sensor.camera), blurred=True)
    return signal / one


# As wide a view as the camera's and as slow a read-out, on coarser pixels, without the lens's blur.
COARSE = replace(CAMERA, pixel_pitch_um=17.0 * 8, row_time_us=63.5 * 8, diffraction=False, blur_sigma_px=0.0)


@pytest.mark.parametrize("render_px", [0.0, 20.0])
def test_fast_motion_with_rolling_rows_agrees_with_64_instants_per_time_constant(render_px):
    taken, rendered = exposure(COARSE, rocket, render_px=render_px)
    now = textured(COARSE, rocket(0.0))
    signal, how = taken.signal(at_rest(COARSE), 0.0, now)
    assert 4.3 < how["motion_px"] < 5.3 and how["renders"] == len(rendered) + 1
    assert how["renders"] < 0.5 * how["instants"] if render_px else how["renders"] == how["instants"]
    seen = radiance_of(signal, taken)
    rows = range(3, 64, 12)
    expected = past_of(COARSE, rocket, rows)
    mk = lambda image: 1e3 / SLOPE * np.sqrt(np.mean((image - expected) ** 2))  # noqa: E731
    assert mk(seen[list(rows)]) < 20.0
    assert mk(now[list(rows)]) > 100.0


def past_of(camera, path, rows, **ground):
    """Radiance of some rows from 64 instants per time constant, (len(rows), W)."""
    tau, delays = camera.time_constant_s, detector.row_delays(camera)
    times = (np.arange(-8 * 64, 0) + 0.5) / 64 * tau
    found = []
    for row in rows:
        past = [textured(camera, path(delays[row] + t), slice(row, row + 1), **ground)[0] for t in times]
        found.append(np.average(past, axis=0, weights=np.exp(times / tau)))
    return np.array(found)


@pytest.mark.parametrize("speed", [10.0, 60.0])
def test_one_image_suffices_for_sub_pixel_motion(speed):
    path = lambda time_s: pose(speed * time_s, 0.0, 100.0, 20.0, -60.0)  # noqa: E731
    taken, rendered = exposure(COARSE, path)
    now, rows = textured(COARSE, path(0.0)), range(3, 64, 12)
    signal, how = taken.signal(at_rest(COARSE), 0.0, now)
    assert 0.02 < how["motion_px"] < 0.8 and how["renders"] == 1 and not rendered
    expected = past_of(COARSE, path, rows)
    mk = lambda image: 1e3 / SLOPE * np.sqrt(np.mean((image[list(rows)] - expected)[:, 3:-3] ** 2))  # noqa: E731
    # OpenCV moves images by whole 32nds of a pixel, 0.01 pixels root mean square.
    gradient = np.hypot(*np.gradient(now.astype(float))).mean() * 1e3 / SLOPE
    assert mk(radiance_of(signal, taken)) < 0.03 * gradient < 0.5 * mk(now)


@pytest.mark.parametrize("speed", [*slow(30.0, 60.0), 200.0])
@pytest.mark.parametrize("finer", [*slow(1.0), 8.0, *slow(40.0)])
@pytest.mark.parametrize("slope", [pytest.param((0.0, 0.0), marks=pytest.mark.slow), (0.7, -0.5)])
def test_the_estimated_lag_error_is_near_the_true_one(slope, finer, speed):
    """Waves with a length of 150 pixels down to 1/5 of one, over level and steep ground."""
    depth = plane_depth(0.0, slope)
    path = lambda time_s: pose(speed * time_s, 0.4 * speed * time_s, 100.0, 60.0 * time_s, -75.0)  # noqa: E731
    taken, _ = exposure(COARSE, path, depth=depth, finer=finer)
    now = textured(COARSE, path(0.0), depth=depth, finer=finer)
    signal, how = taken.signal(at_rest(COARSE), 0.0, now)
    rows = range(0, 64, 7)
    expected = past_of(COARSE, path, rows, depth=depth, finer=finer)
    error = 1e3 / SLOPE * np.sqrt(np.mean((radiance_of(signal, taken)[list(rows)] - expected) ** 2))
    # An estimate, not a bound.
    assert error < 1.1 * how["lag_mk"] < 5.0 * error, how


def followed(taken, radiance_at, each=32):
    """A frame at time 0 from `each` instants per time constant, all rows."""
    tau, delays = taken.sensor.camera.time_constant_s, detector.row_delays(taken.sensor.camera, 1.0 / 30.0)
    times = delays[-1] + np.arange(-round(each * (9 + (delays[-1] - delays[0]) / tau)), 1) * tau / each
    pixels = detector.Follower(None, delays, tau, (taken.sensor.camera.height, taken.sensor.camera.width))
    for time_s in times:
        pixels.step(time_s, radiance_at(time_s) - np.float32(K295), time_s == times[-1])
    return pixels.signal + K295


@pytest.mark.parametrize(
    ("speed", "yaw_rate", "finer", "most"),
    [(1.0, 0.0, 40.0, 4.0), (1.0, 0.0, 8.0, 4.0), (5.0, 0.0, 8.0, 4.0), (60.0, 0.0, 1.0, 2.0), (40.0, 30.0, 1.0, 2.0)],
)
def test_the_estimated_lag_error_vanishes_with_motion_and_counts_the_border(speed, yaw_rate, finer, most):
    """Short waves are interpolated wrongly, long waves are wrong only where they enter at the border."""
    path = lambda t: pose(speed * t, 0.4 * speed * t, 100.0, yaw_rate * t, -75.0)  # noqa: E731
    taken, _ = exposure(COARSE, path, finer=finer)
    signal, how = taken.signal(at_rest(COARSE), 0.0, textured(COARSE, path(0.0), finer=finer))
    assert how["motion_px"] < 0.8 and how["renders"] == 1
    expected = followed(taken, lambda t: textured(COARSE, path(t), finer=finer))
    error = 1e3 / SLOPE * np.sqrt(np.mean((radiance_of(signal, taken) - expected) ** 2))
    assert error < how["lag_mk"] < most * error + 0.2, how


def test_what_a_fast_view_has_left_behind_is_rendered():
    """Warm ground lies just outside of the frame's own view, which remembers it."""
    camera = replace(COARSE, time_constant_ms=50.0, row_time_us=0.0)
    path = lambda t: pose(0.0, 67.0 * t, 100.0, 0.0, -90.0)  # noqa: E731
    half_m = 100.0 * 0.5 * camera.height / camera.focal_length_px

    def radiance_at(time_s, seen_by=camera, lit_s=None, rim=None):
        row = np.arange(seen_by.height) + 0.5
        down = seen_by.directions(np.column_stack([np.full(len(row), 0.5 * seen_by.width), row]))[:, 1]
        north = path(time_s)[1, 3] - 100.0 * down
        warm = 8.0 * np.clip((-north - half_m) / 4.0, 0.0, 1.0) + 2.0 * np.sin(north / 6.0)
        return np.repeat((K295 + SLOPE * warm)[:, None], seen_by.width, axis=1).astype(np.float32)

    taken = Exposure(Sensor(camera, 0), radiance_at, path, plane_depth(), 1.0 / 30.0)
    signal, how = taken.signal(at_rest(camera), 0.0, radiance_at(0.0))
    error = 1e3 / SLOPE * np.sqrt(np.mean((radiance_of(signal, taken) - followed(taken, radiance_at)) ** 2))
    assert how["motion_px"] > 3.0 and how["renders"] < how["instants"]
    assert error < 45.0 and error < how["lag_mk"] < 5.0 * error, (error, how)


def test_an_image_is_not_continued_where_its_distortion_folds():
    camera = replace(CAMERA, width=640, height=512)
    # r + k₁ r³ is largest at 2/3 (−3 k₁)^−½, here just beyond the corner of the image.
    corner = np.hypot(0.5 * camera.width, 0.5 * camera.height) / camera.focal_length_px
    folds = replace(camera, distortion=(-4.0 / (27.0 * (1.01 * corner) ** 2), 0.0, 0.0, 0.0, 0.0))
    folds.directions([(0.0, 0.0)])
    assert motion.widest_px(folds) == 0 < motion.widest_px(camera)


def test_the_error_of_what_a_step_of_depth_uncovers_is_stated():
    """Posts stand over ground that only earlier instants see."""
    size = {"width": 320, "height": 256, "pixel_pitch_um": 34.0, "row_time_us": 0.0}
    camera = replace(CAMERA, diffraction=False, blur_sigma_px=0.0, **size)
    path = lambda t: pose(0.0, 30.0 * t, 100.0, 0.0, -90.0)  # noqa: E731
    height_m = 60.0

    def seen(time_s, seen_by):
        down, right = np.mgrid[: seen_by.height, : seen_by.width] + 0.5
        slope = seen_by.directions(np.stack([right, down], axis=-1)) @ path(time_s)[:2, :2].T
        # The camera looks down; tops of posts are 12 m squares every 24 m.
        top = path(time_s)[:2, 3] + (100.0 - height_m) * slope
        on = ((top + 6.0) % 24.0 < 12.0).all(axis=-1)
        east, north = np.moveaxis(path(time_s)[:2, 3] + 100.0 * slope, -1, 0)
        return on, np.where(on, -3.0, 3.0 * np.sin(north / 3.0 + east / 4.0))

    def radiance_at(time_s, seen_by=camera, lit_s=None, rim=None):
        return np.where(True if rim is None else rim, K295 + SLOPE * seen(time_s, seen_by)[1], 0.0).astype(np.float32)

    depth = lambda at, seen_by: np.where(seen(at[1, 3] / 30.0, seen_by)[0], 100.0 - height_m, 100.0)  # noqa: E731
    taken = Exposure(Sensor(camera, 0), radiance_at, path, depth, 1.0 / 30.0)
    signal, how = taken.signal(at_rest(camera), 0.0, radiance_at(0.0))
    error = 1e3 / SLOPE * np.sqrt(np.mean((radiance_of(signal, taken) - followed(taken, radiance_at)) ** 2))
    assert how["renders"] == 3, how
    assert error < 1.1 * how["lag_mk"] < 3.0 * error, (error, how)


# The last measures the error in every pixel, which are more than OpenCV takes in a row.
@pytest.mark.parametrize(("heading", "every"), [(0.0, 64), *slow((180.0, 64)), (90.0, 64), (0.0, 1)])
def test_a_rim_around_the_image_stands_for_whole_images_of_the_past(monkeypatch, heading, every):
    """Warm ground lies just outside of the frame's own view, which remembers it."""
    size = {"width": 320, "height": 256, "pixel_pitch_um": 34.0, "row_time_us": 0.0}
    camera = replace(CAMERA, diffraction=False, blur_sigma_px=0.0, **size)
    path = lambda t: pose(0.0, 27.0 * t, 100.0, heading, -90.0)  # noqa: E731
    half_m = 100.0 * 0.5 * (camera.width if heading == 90.0 else camera.height) / camera.focal_length_px
    asked, draw = [], np.random.default_rng(0)
    monkeypatch.setattr(exposure_module, "_EVERY", every)

    def radiance_at(time_s, seen_by=camera, lit_s=None, rim=None):
        asked.append(rim)
        down, right = np.mgrid[: seen_by.height, : seen_by.width] + 0.5
        slope = seen_by.directions(np.stack([right, down], axis=-1))
        # The camera looks down.
        east, north = path(time_s)[:2, 3, None, None] + 100.0 * np.moveaxis(slope @ path(time_s)[:2, :2].T, -1, 0)
        warm = 8.0 * np.clip((-north - half_m) / 4.0, 0.0, 1.0) + 2.0 * np.sin(north / 3.0 + east / 4.0)
        # Few rays have noise, which is no error of motion.
        noise = 0.0 if rim is None else 0.1 * draw.standard_normal(warm.shape)
        return np.where(True if rim is None else rim, K295 + SLOPE * (warm + noise), 0.0).astype(np.float32)

    taken = Exposure(Sensor(camera, 0), radiance_at, path, plane_depth(), 1.0 / 30.0)
    signal, how = taken.signal(at_rest(camera), 0.0, radiance_at(0.0))
    assert how["motion_px"] > 1.0 and how["renders"] == 3 and how["lag_mk"] < 40.0
    # Beside the frame's own image only a rim of it is rendered, and few pixels of it and of an instant before.
    assert asked[0] is None and len(asked) == 3
    assert every == 1 or (0.0 < asked[1].mean() < 0.12 and 0.0 < asked[2].mean() < 0.02)
    error = 1e3 / SLOPE * (radiance_of(signal, taken) - followed(taken, radiance_at))
    assert np.sqrt(np.mean(error**2)) < min(how["lag_mk"], 25.0), how


@pytest.mark.parametrize("size", [(2, 1), (1, 9), (7, 50), (300, 3)])
@pytest.mark.parametrize("speed", [0.0, 5.0, 60.0, 300.0])
@pytest.mark.filterwarnings("error")
def test_a_camera_of_few_pixels_has_a_finite_lag_error(size, speed):
    camera = replace(COARSE, width=size[0], height=size[1])
    path = lambda time_s: pose(speed * time_s, 0.0, 100.0, 0.0, -80.0)  # noqa: E731
    signal, how = exposure(camera, path)[0].signal(at_rest(camera), 0.0, textured(camera, path(0.0)))
    assert np.isfinite(signal).all() and np.isfinite(how["lag_mk"])


@pytest.mark.slow
def test_steep_ground_moves_by_its_depth():
    """Treated as level ground, it would be seen in the wrong place."""
    depth = plane_depth(0.0, (0.7, -0.5))
    path = lambda time_s: pose(200.0 * time_s, 0.0, 100.0, 0.0, -90.0)  # noqa: E731
    now, rows, found = textured(COARSE, path(0.0), depth=depth), range(3, 64, 12), []
    for assumed in (depth, plane_depth()):
        taken, _ = exposure(COARSE, path, depth=depth, relief_depth=assumed)
        signal, _ = taken.signal(at_rest(COARSE), 0.0, now)
        expected = past_of(COARSE, path, rows, depth=depth)
        found.append(1e3 / SLOPE * np.sqrt(np.mean((radiance_of(signal, taken)[list(rows)] - expected) ** 2)))
    # The remaining error comes from the spacing of instants.
    assert found[0] < 0.5 * found[1]


def test_a_slow_view_needs_one_image_and_the_memory_of_earlier_ones():
    camera = replace(COARSE, row_time_us=0.0)
    slow = lambda time_s: pose(0.2 * time_s, 0.0, 100.0, 0.0, -90.0)  # noqa: E731
    taken, rendered = exposure(camera, slow, rate_hz=30.0)
    rng = np.random.default_rng(0)
    images = [(K295 + rng.normal(size=(64, 80))).astype(np.float32) for _ in range(4)]
    expected, old = images[0].astype(float), np.exp(-1 / 30.0 / TAU)
    for index, image in enumerate(images):
        how = taken.read(index, index / 30.0, image)[1]
        expected = image + old * (expected - image)
        assert (how["instants"], how["renders"]) == (1, 1) and how["motion_px"] < 0.1
    np.testing.assert_allclose(radiance_of(taken.pixels.signal, taken), expected, rtol=1e-6)
    assert not rendered


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
    # The bytes are equal because of the restored state.
    fresh, _ = exposure(COARSE, path)
    assert read(fresh, 2) != frames[2]


def test_a_frozen_image_is_the_last_one_before_the_correction():
    camera = replace(COARSE, ffc_interval_s=0.2, ffc_duration_s=0.08)
    taken, _ = exposure(camera, lambda time_s: pose(0, 0, 100, 0, -90))
    scene = textured(camera, pose(0, 0, 100, 0, -90))
    counts = [taken.read(index, index / 30.0, scene + 0.1 * index)[0] for index in range(10)]
    frozen = [taken.read(index, index / 30.0, scene)[1]["frozen"] for index in range(6, 10)]
    assert all((counts[index] == counts[5]).all() for index in (6, 7, 8))
    assert (counts[9] != counts[5]).any() and frozen == [True, True, True, False]


def test_the_schedule_grows_coarser_with_age_and_is_bounded():
    delays = detector.row_delays(load_camera("zenmuse-xt2"))
    plan = schedule(5.0, delays, TAU, 40.0, 5.0 + delays[0] - 0.08)
    gaps = np.diff(plan.times_s)
    assert plan.times_s[0] == pytest.approx(5.0 + delays[0] - 0.08) and plan.times_s[-1] == 5.0 + delays[-1]
    assert plan.times_s[plan.own] == 5.0 and plan.own in plan.renders
    # Three pixels at 40 pixels a time constant, and e^(8/3) times as many at the oldest.
    assert gaps[-10:].max() == pytest.approx(3.2 / 40.0 * TAU, rel=0.02) and gaps[1] > 8.0 * gaps[-1]
    assert 8 <= len(plan.renders) <= 16 and 60 <= len(plan.times_s) <= 100
    assert len(schedule(5.0, delays, TAU, 1e5, 4.9).times_s) <= 403
    few = schedule(5.0, delays, TAU, 0.9, 5.0 + delays[0] - 0.08)
    assert len(few.renders) == 1 and len(few.times_s) <= 10


def test_the_plan_reports_the_effect_of_the_pixels_memory():
    camera = load_camera("zenmuse-xt2")
    assert plan_row(camera)[1] == "by motion" and "10 ms" in plan_row(camera)[2]
    assert plan_row(replace(camera, time_constant_ms=0.0))[1] == "out"


@pytest.mark.parametrize("cycles", [0.3, 0.7, 0.9])
def test_a_wave_is_blurred_before_and_after_sampling(cycles):
    from thermorender.sensor.psf import otf
    from validation.sensor.study import blurred_before_and_after

    camera, times, count = load_camera("zenmuse-xt2"), 4, 160
    # Cosines with their crests at the border continue themselves when mirrored.
    wave = np.cos(2.0 * np.pi * cycles * (np.arange(times * count) + 0.5) / times) * np.ones((times * count, 1))
    before, after, sampled = blurred_before_and_after(wave, camera, times)
    # The lens transmits the wave's own frequency; blurred after sampling, that of the samples.
    shown = min(cycles, 1.0 - cycles)
    crest = np.cos(2.0 * np.pi * cycles * (np.arange(count) + 0.5))
    # The mean of four samples is the pixel's average over the fine pixel's own sinc.
    mean = np.sinc(cycles) / np.sinc(cycles / times)
    for image, passed in ((sampled, 1.0), (before, otf(camera, cycles)), (after, otf(camera, shown))):
        amplitude = 2.0 * (image[count // 2] * crest).mean()
        assert amplitude == pytest.approx(passed * mean, rel=2e-3)
    assert cycles < 0.5 or abs(after).max() > 2.0 * abs(before).max()


def test_finer_pixels_see_the_same_image():
    from validation.sensor.study import finer

    whole = replace(load_camera("zenmuse-xt2-9mm"), principal_offset_px=(3.0, -2.0))
    camera = whole.part(slice(100, 228), slice(40, 168))
    points = np.array([[-0.3, -0.2, 1.0], [-0.2, 0.1, 1.0], [0.1, 0.3, 2.0]])
    np.testing.assert_allclose(finer(camera, 4).project(points), 4.0 * camera.project(points), rtol=1e-12)
    assert (finer(camera, 4).width, finer(camera, 4).height) == (512, 512)


def test_small_targets_keep_their_area_and_their_error_depends_on_position():
    from validation.sensor import study as validation

    lens = load_camera("zenmuse-xt2")
    for side in (0.5, 3.0):
        line = validation.covered(12.25, side, 28)
        assert line.sum() / validation.DRAWN == pytest.approx(side) and line.max() == pytest.approx(1.0)
    few = {record["side_px"]: record for record in validation.small_targets(lens)}
    assert few[0.5]["peak_mk"] < few[1.0]["peak_mk"] < few[3.0]["peak_mk"] < few[3.0]["contrast_mk"]
    assert all(0.0 < record["error_mk"] < record["worst_mk"] for record in few.values())
    # A softer lens leaves less aliasing.
    soft = validation.small_targets(replace(lens, blur_sigma_px=1.2))
    assert all(record["worst_mk"] < 0.6 * few[record["side_px"]]["worst_mk"] for record in soft)


@pytest.mark.slow
def test_validation_measures_lag_blur_and_chain(tmp_path, monkeypatch):
    from scenes import write_terrain
    from validation.sensor import study as validation

    # An eighth of its renders is enough to show that it measures.
    monkeypatch.setattr(validation, "REFERENCE", 8)
    sensor = validation.sensor
    folder = write_terrain(tmp_path / "scene", height=np.zeros((48, 48)), extra='[camera]\nmodel = "small.toml"\n')
    shipped = (Path(detector.__file__).parent / "cameras" / "zenmuse-xt2.toml").read_text(encoding="utf-8")
    small = shipped.replace("width = 640", "width = 64").replace("height = 512", "height = 48")
    (folder / "small.toml").write_text(small.replace("row_time_us = 63.5", "row_time_us = 635"), encoding="utf-8")
    result = sensor(tmp_path / "out", folder, ("drone, low",))
    records = result["lag"]["drone, low"]
    flown = next(record for record in records if (record["lag_mk"], record["render_px"]) == (10.0, 20.0))
    assert flown["all_mk"] < 0.25 * records[0]["all_mk"] and flown["renders"] < flown["instants"]
    errors = {(record["fine"], record["coarse"]): record["error_mk"] for record in result["blur"]}
    assert errors[7, 5] < errors[5, 0] < errors[1, 0]
    assert all(0.0 <= record["aliasing_mk"] <= record["worst_mk"] for record in result["aliasing"]["views"])
    page = (tmp_path / "out" / "sensor.md").read_text(encoding="utf-8")
    assert "## Aliasing" in page and page.count("| 0.5 |") == 1
    assert result["chain"]["standing_ratio"] > 0.0 and result["chain"]["subpixel_ratio"] > 0.0
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "sensor.json", "sensor.md", "sensor.png", "effects.png",
    }  # fmt: skip
    with pytest.raises(ThermorenderError, match="flight 'balloon' is unknown; give some of rocket, down"):
        sensor(tmp_path / "out", folder, ("balloon",))
