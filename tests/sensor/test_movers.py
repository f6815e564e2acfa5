"""Moving and warming objects under the camera: the pixels' memory of them, against closed forms and dense instants."""

from dataclasses import replace

import numpy as np
import pytest
from support import slow

from scenes import plane_depth
from thermorender.physics.planck import band_radiance, band_radiance_derivative
from thermorender.sensor import movers
from thermorender.sensor.camera import load_camera
from thermorender.sensor.chain import Sensor, in_sequence
from thermorender.sensor.detector import row_delays
from thermorender.sensor.exposure import Exposure
from thermorender.sensor.movers import Mover
from thermorender.trajectory.path import pose

TAU, HEIGHT_M = 0.010, 120.0
# The same read-out time with fewer rows.
CAMERA = replace(load_camera("zenmuse-xt2"), width=120, height=96, row_time_us=63.5 * 512 / 96, ffc_interval_s=0.0,
                 diffraction=False, blur_sigma_px=0.0, illumination_exponent=0.0, vignetting=0.0)  # fmt: skip
GROUND = band_radiance(290.0, *CAMERA.band_um)
SLOPE = band_radiance_derivative(290.0, *CAMERA.band_um)


class Plate:
    """A plate on level ground whose temperature is a function of time, seen from straight above, north up."""

    def __init__(self, east, north=lambda t: 0.0, warm=lambda t: 45.0, half_m=1.5, bends=()):
        self.east, self.north, self.warm, self.half_m = east, north, warm, half_m
        self.mover = Mover(self.corners, warm, np.array(bends, float))
        self.rendered = []

    def corners(self, time_s):
        side = self.half_m * np.array([-1.0, 1.0])
        return np.array([[self.east(time_s) + x, self.north(time_s) + y, 0.0] for x in side for y in side])

    def radiance(self, time_s, camera, at):
        """Its exact share of each pixel, times its contrast with the ground, plus the ground, (H, W) float32."""
        self.rendered.append(time_s)
        scale = camera.focal_length_px / HEIGHT_M
        middle = 0.5 * np.array([camera.width, camera.height]) + camera.principal_offset_px
        shares = []
        for size, point, offset in ((camera.width, middle[0], self.east(time_s) - at[0]),
                                    (camera.height, middle[1], at[1] - self.north(time_s))):  # fmt: skip
            low, high = (point + scale * (offset + end) for end in (-self.half_m, self.half_m))
            edge = np.arange(size + 1)
            shares.append(np.clip(np.minimum(edge[1:], high) - np.maximum(edge[:-1], low), 0.0, 1.0))
        return (GROUND + SLOPE * self.warm(time_s) * shares[1][:, None] * shares[0]).astype(np.float32)


def flown(plate, flight_mps, rate_hz, frames, camera=CAMERA, known=True):
    """(signals as radiance of each frame, report of the last one, Exposure) of a steady flight north, looking down."""
    at = lambda t: (0.0, flight_mps * t)  # noqa: E731
    path = lambda t: pose(*at(t), HEIGHT_M, 0.0, -90.0)  # noqa: E731
    sensor = Sensor(camera, 0)
    seen = lambda t, by, lit, rim=None: plate.radiance(t, by, at(t))  # noqa: E731
    taken = Exposure(sensor, seen, path, plane_depth(), 1.0 / rate_hz,
                     movers=[plate.mover] if known else [])  # fmt: skip
    found, how = [], None
    for index in range(frames):
        moment = in_sequence(camera, 0, 0.0)
        now = plate.radiance(index / rate_hz, camera, at(index / rate_hz))
        signal, how = taken.signal(moment, index / rate_hz, now)
        offset, gain = sensor.power_law(moment)
        found.append((signal - offset) / gain)
    return found, how, taken


def dense(plate, flight_mps, time_s, rate_hz, camera=CAMERA, each=100):
    """The frame by brute force: every row is an integral over its own past, in float64, in small steps."""
    delays, tau = row_delays(camera, 1.0 / rate_hz), camera.time_constant_s
    age = (np.arange(12 * each) + 0.5) * tau / each
    weight = np.exp(-age / tau)
    total = np.zeros((camera.height, camera.width))
    for row in range(camera.height):
        rows = camera.part(slice(row, row + 1), slice(0, camera.width))
        when = time_s + delays[row] - age
        past = [plate.radiance(t, rows, (0.0, flight_mps * t))[0] for t in when]
        total[row] = np.average(past, axis=0, weights=weight)
    return total


class Both:
    """Two plates in one picture; only the first is a mover."""

    def __init__(self, first, second):
        self.plates, self.mover = (first, second), first.mover

    def radiance(self, *view):
        return sum(plate.radiance(*view) for plate in self.plates) - np.float32(GROUND)


def middle(image):
    """Column of a plate's centre of mass."""
    return (np.maximum(image - GROUND, 0.0).sum(axis=0) * np.arange(CAMERA.width)).sum() / (image - GROUND).sum()


def mk(difference):
    return 1e3 * np.sqrt(np.mean(np.square(difference))) / SLOPE


@pytest.mark.parametrize(
    ("flight_mps", "rate_hz"), [*slow((0.0, 9.0), (0.0, 60.0), (12.0, 30.0), (3.0, 9.0)), (0.0, 30.0)]
)
def test_moving_plate_lags_under_a_hovering_or_flying_camera(flight_mps, rate_hz):
    plate = Plate(lambda t: 20.0 * t - 3.0, lambda t: flight_mps * t + 1.0)
    frames = 1 + round(0.2 * rate_hz)
    found, how, _ = flown(plate, flight_mps, rate_hz, frames)
    time_s = (frames - 1) / rate_hz
    expected = dense(plate, flight_mps, time_s, rate_hz)
    blind = flown(plate, flight_mps, rate_hz, frames, known=False)[0][-1]
    error = mk(found[-1] - expected)
    assert mk(blind - expected) > 500.0
    assert error < 60.0 and error < how["lag_mk"] < 10.0 * error
    # Its centre of mass lags by the way it moves in a time constant.
    now = plate.radiance(time_s, CAMERA, (0.0, flight_mps * time_s))
    trail = 20.0 * TAU * CAMERA.focal_length_px / HEIGHT_M
    # Rows are read before and after the frame's time; the plate is in the middle ones.
    assert middle(now) - middle(found[-1]) == pytest.approx(middle(now) - middle(expected), abs=0.02)
    assert 0.5 * trail < middle(now) - middle(found[-1]) < 1.6 * trail


@pytest.mark.parametrize("rate_hz", [9.0, 30.0, 60.0])
@pytest.mark.parametrize("flight_mps", [0.0, 5.0])
def test_temperature_step_is_read_by_rows_at_their_own_time(rate_hz, flight_mps):
    last = np.ceil(0.5 * rate_hz) / rate_hz
    step_s = last - 0.012
    warm = lambda t: 30.0 * float(np.clip((t - step_s) / 1e-6, 0.0, 1.0))  # noqa: E731
    bends = [0.0, step_s, step_s + 1e-6, 10.0]
    plate = Plate(lambda t: 0.0, lambda t: flight_mps * last, warm, half_m=20.0, bends=bends)
    found, _, _ = flown(plate, flight_mps, rate_hz, round(last * rate_hz) + 1)
    share = (found[-1][:, 60] - GROUND) / (30.0 * SLOPE)
    since = row_delays(CAMERA, 1.0 / rate_hz) + 0.012
    expected = np.where(since > 0.0, -np.expm1(-np.maximum(since, 0.0) / TAU), 0.0)
    np.testing.assert_allclose(share, expected, atol=2e-4)


def test_memory_of_a_plate_that_has_left_fades():
    """Pixels of a slow camera keep fading where the plate was frames ago."""
    slow = replace(CAMERA, time_constant_ms=100.0, row_time_us=0.0)
    leave_s = 0.1
    plate = Plate(lambda t: 0.0 if t < leave_s else 1e4, warm=lambda t: 45.0, bends=[leave_s - 1e-7, leave_s])
    found, how, _ = flown(plate, 0.0, 30.0, 10, slow)
    for index in range(4, 10):
        share = (found[index][48, 60] - GROUND) / (45.0 * SLOPE)
        assert share == pytest.approx(np.exp(-(index / 30.0 - leave_s) / 0.1), abs=2e-4)
    assert how["renders"] == 1


@pytest.mark.slow
@pytest.mark.parametrize("flight_mps", [60.0, 300.0])
def test_object_that_moves_with_the_camera_stays_in_place(flight_mps):
    """Shifting images between renders as the ground moves would misplace it; the ground behind it has its own lag."""
    along = lambda t: flight_mps * t  # noqa: E731
    plates = Both(Plate(lambda t: 0.0, along), Plate(lambda t: 1.0, lambda t: 2.0, half_m=0.7))
    found, how, _ = flown(plates, flight_mps, 9.0, 2)
    frame = dense(plates, flight_mps, 1 / 9.0, 9.0)
    alone = dense(plates.plates[0], flight_mps, 1 / 9.0, 9.0)
    assert mk(found[-1] - frame) < 60.0 and mk(found[-1] - frame) < how["lag_mk"], how
    # Elsewhere nothing of it is visible: of 45 K no more than e⁻⁸.
    found, how, _ = flown(plates.plates[0], flight_mps, 9.0, 2)
    assert np.abs(found[-1] - alone).max() / SLOPE < 0.02, how


@pytest.mark.slow
def test_object_that_crosses_between_two_frames_is_in_the_stated_error():
    # It has left the picture of uniform ground when the frame is taken.
    leave_s = 1.0 / 9.0 - 0.017
    plate = Plate(lambda t: float(np.interp(t, [leave_s - 0.1, leave_s], [-25.0, 25.0])), half_m=3.0,
                  bends=[leave_s - 0.1, leave_s])  # fmt: skip
    found, how, _ = flown(plate, 0.0, 9.0, 2)
    expected = dense(plate, 0.0, 1.0 / 9.0, 9.0)
    assert (plate.radiance(1.0 / 9.0, CAMERA, (0.0, 0.0)) == np.float32(GROUND)).all()
    error = mk(found[-1] - expected)
    assert error < 0.2 * mk(expected - GROUND) and error < how["lag_mk"]


@pytest.mark.slow
def test_fast_warming_follows_the_radiance_curve():
    bends = np.array([0.02, 0.12])
    kelvin = lambda t: float(np.interp(t, bends, [300.0, 500.0]))  # noqa: E731
    plate = Plate(lambda t: 0.0, warm=lambda t: (band_radiance(kelvin(t), *CAMERA.band_um) - GROUND) / SLOPE)
    plate.mover = Mover(plate.corners, kelvin, bends)
    found, how, _ = flown(plate, 0.0, 9.0, 2)
    expected = dense(plate, 0.0, 1.0 / 9.0, 9.0)
    assert mk(found[-1] - expected) < how["lag_mk"]
    # A straight line over 0.1 s would be off by 13 K; over 3 K the limit is ⅛ 3² of a curvature of 0.0113 per K.
    assert np.abs(found[-1] - expected).max() / SLOPE < 9 / 8 * 0.0113 + 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("flight_mps", [0.0, 4.0, 30.0])
def test_pixels_faster_than_the_row_readout(flight_mps):
    fast = replace(CAMERA, time_constant_ms=0.1)
    plate = Plate(lambda t: 20.0 * t - 3.0, lambda t: 1.0)
    found, how, _ = flown(plate, flight_mps, 9.0, 2, fast)
    expected = dense(plate, flight_mps, 1.0 / 9.0, 9.0, fast)
    at = plate.radiance(1.0 / 9.0, CAMERA, (0.0, flight_mps / 9.0))
    error = mk(found[-1] - expected)
    assert error < 0.1 * mk(at - expected) and error < how["lag_mk"], how
    # Without moving objects, rows are read at their own time too; shifted images blur the plate's edges.
    still = Plate(lambda t: 0.0, lambda t: 1.0)
    found, how, _ = flown(still, flight_mps, 9.0, 1, fast)
    expected = dense(still, flight_mps, 0.0, 9.0, fast)
    at = still.radiance(0.0, CAMERA, (0.0, 0.0))
    assert mk(found[-1] - expected) < 0.3 * mk(at - expected) + 0.1, how


def test_slow_pixels_keep_their_stated_error():
    slow = replace(CAMERA, time_constant_ms=500.0)
    plate = Plate(lambda t: 8.0 * t, bends=[-20.0, 20.0])
    seen, path = (
        lambda t, by, lit, rim=None: plate.radiance(t, by, (0.0, 0.0)),
        lambda t: pose(0, 0, HEIGHT_M, 0.0, -90.0),
    )
    taken = Exposure(Sensor(slow, 0), seen, path, plane_depth(), 1.0 / 60.0, movers=[plate.mover])
    stated = []
    for index in range(4):
        now = plate.radiance(index / 60.0, slow, (0.0, 0.0))
        stated.append(taken.signal(in_sequence(slow, 0, 0.0), index / 60.0, now)[1]["lag_mk"])
    # It fades with the pixels' memory, and each frame adds little.
    assert stated[0] > 20.0 and stated[3] == pytest.approx(stated[0] * np.exp(-3 / 60.0 / 0.5), rel=0.1)
    again = Exposure(Sensor(slow, 0), *[None] * 3, 1.0 / 60.0)
    again.restore(taken.state())
    assert again.pixels.error_mk == taken.pixels.error_mk > 0.0


@pytest.mark.parametrize("turns_per_s", [1.0, 2.0, 3.0])
def test_view_that_returns_within_a_time_constant_counts_as_motion(turns_per_s):
    camera = replace(CAMERA, time_constant_ms=1000.0)
    path = lambda t: pose(0.0, 0.0, HEIGHT_M, 360.0 * turns_per_s * t, -90.0)  # noqa: E731
    image = (GROUND + np.zeros((camera.height, camera.width))).astype(np.float32)
    taken = Exposure(Sensor(camera, 0), lambda t, by, lit, rim=None: image, path, plane_depth(), 0.1)
    _, how = taken.signal(in_sequence(camera, 0, 0.0), 0.0, image)
    # Corners move on a circle; the chord of a fiftieth of a second is up to 0.6 % short.
    way_px = 2.0 * np.pi * turns_per_s * np.hypot(camera.width, camera.height) / 2.0
    assert 0.85 * way_px < how["motion_px"] < way_px


def test_only_the_changing_region_is_rendered_again():
    plate, still = Plate(lambda t: 5.0 * t), Plate(lambda t: 2.0)
    _, how, _ = flown(still, 0.0, 30.0, 3)
    assert how["renders"] == 1 and how["lag_mk"] == 0.0
    path = lambda t: pose(0, 0, HEIGHT_M, 0.0, -90.0)  # noqa: E731
    (region,) = movers.changing_regions(CAMERA, path, [plate.mover, still.mover], 0.0, 0.1, 6)
    assert region.px_per_s == pytest.approx(5.0 * CAMERA.focal_length_px / HEIGHT_M, rel=1e-6)
    size = 3.0 * CAMERA.focal_length_px / HEIGHT_M
    assert region.rows.stop - region.rows.start == pytest.approx(size + 12, abs=2)
    # Out of sight, or behind.
    assert not movers.changing_regions(CAMERA, path, [Plate(lambda t: 500.0 + t).mover], 0.0, 0.1, 6)
    up = lambda t: pose(0, 0, HEIGHT_M, 0.0, 90.0)  # noqa: E731
    assert not movers.changing_regions(CAMERA, up, [plate.mover], 0.0, 0.1, 6)


def test_overlapping_regions_are_merged():
    path = lambda t: pose(0, 0, HEIGHT_M, 0.0, -90.0)  # noqa: E731
    near = [Plate(lambda t, off=off: 5.0 * t + off).mover for off in (0.0, 2.0, -8.0)]
    found = movers.changing_regions(CAMERA, path, near, 0.0, 0.1, 3)
    assert len(found) == 2
    assert sum(region.columns.stop - region.columns.start for region in found) < CAMERA.width


def test_region_is_blurred_as_in_the_whole_image():
    camera = replace(load_camera("zenmuse-xt2"), width=243, height=197)
    sensor, image = Sensor(camera, 0), np.random.default_rng(0).normal(20.0, 5.0, (197, 243)).astype(np.float32)
    whole = sensor.blurred(image)
    for top, bottom, left, right in ((60, 83, 101, 140), (0, 9, 230, 243), (180, 197, 3, 50)):
        rows, columns = slice(top, bottom), slice(left, right)
        region = movers.ChangingRegion(rows, columns, 1.0, np.zeros(0), np.zeros(0))
        wide = region.around(197, 243)
        seen = np.zeros_like(image)
        seen[wide] = sensor.blurred(image[wide])
        np.testing.assert_allclose(seen[rows, columns], whole[rows, columns], atol=2e-5)
    # As a camera it has the directions of the whole one.
    part_of = camera.part(*wide)
    pixel = np.array([3.2, 4.1])
    np.testing.assert_allclose(part_of.directions(pixel), camera.directions(pixel + [wide[1].start, wide[0].start]))
