"""The photon detector against Planck integrals of scipy, Poisson statistics and means over the integration time."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.constants import c, h, k
from scipy.integrate import quad
from scipy.optimize import brentq
from scipy.stats import chi2

from scenes import plane_depth
from thermorender.apps.survey.footage.calibration import fit_camera
from thermorender.errors import ThermorenderError
from thermorender.frame import apparent_temperature
from thermorender.physics.planck import band_radiance, brightness_temperature
from thermorender.schema import every_field
from thermorender.sensor import photons, readout
from thermorender.sensor.camera import load_camera, model_path
from thermorender.sensor.chain import Sensor, in_sequence
from thermorender.sensor.exposure import Exposure
from thermorender.sensor.movers import Mover
from thermorender.sensor.radiometry import ThermographySettings, camera_constants, thermography_reading
from thermorender.sensor.schedule import past_s, per_mk, plan_row
from thermorender.trajectory.path import pose

SHIPPED = load_camera("neutrino-lc")
# Photons and read noise alone, with counts of less than a twentieth of the noise.
CAMERA = replace(
    SHIPPED, width=48, height=40, bits=16, diffraction=False, blur_sigma_px=0.0, illumination_exponent=0.0,
    vignetting=0.0, sigma_t_mk=0.0, sigma_tv_mk=0.0, sigma_th_mk=0.0, sigma_v_mk=0.0, sigma_h_mk=0.0, sigma_vh_mk=0.0,
    responsivity_percent=(0.0, 0.0), bad_pixels=0.0,
)  # fmt: skip
QUIET = replace(CAMERA, netd_mk=CAMERA.least_netd_mk + 1e-9)
FRAMES = 60


def number(kelvin, camera=CAMERA):
    """Electrons of a pixel at the image centre by the integral of photon radiance, written here."""
    low, high = (1e-6 * limit for limit in camera.band_um)
    planck = quad(lambda length: 2.0 * c / length**4 / np.expm1(h * c / (length * k * kelvin)), low, high, epsrel=1e-11)
    cone = np.pi / (4.0 * camera.f_number**2 + 1.0) * camera.lens_transmittance
    area = (1e-6 * camera.pixel_pitch_um) ** 2
    return camera.quantum_efficiency * 1e-3 * camera.integration_ms * area * cone * planck[0]


def slope(kelvin, camera=CAMERA):
    """Electrons per kelvin, by central differences."""
    step = 1e-4 * kelvin
    return (number(kelvin + step, camera) - number(kelvin - step, camera)) / (2.0 * step)


def filled(kelvin, share, **changes):
    """A camera whose well has a share filled by a blackbody."""
    camera = replace(CAMERA, **changes)
    return replace(
        camera, integration_ms=camera.integration_ms * share * camera.well_electrons / number(kelvin, camera)
    )


def even(camera, kelvin):
    return np.full((camera.height, camera.width), band_radiance(float(kelvin), *camera.band_um), np.float32)


def read_k(camera, kelvin, frames=FRAMES):
    """Apparent temperatures of frames of a blackbody, (frames, H, W) [K]."""
    sensor, scene = Sensor(camera, 1), even(camera, kelvin)
    counts = np.array([sensor.counts_at_rest(scene, index) for index in range(frames)])
    assert not readout.saturated(counts, camera).any()
    radiance = readout.radiance_from_counts(np.arange(2.0**camera.bits), camera)
    return brightness_temperature(radiance, *camera.band_um)[counts]


def step_k(camera, kelvin):
    """One count in kelvin."""
    near = brightness_temperature(readout.radiance_from_counts([0, 1], camera), *camera.band_um)
    radiance = readout.radiance_from_counts([0, 1], camera)
    low, high = band_radiance(np.array([kelvin - 0.01, kelvin + 0.01]), *camera.band_um)
    assert np.isfinite(near).all()
    return float((radiance[1] - radiance[0]) / (high - low) * 0.02)


def agrees(values, variance):
    """Whether the variance of values in time is a stated one, within chi-square bounds of one in ten thousand."""
    free = (values.shape[0] - 1) * values[0].size
    ratio = values.var(axis=0, ddof=1).mean() / variance * free
    return chi2.ppf(5e-5, free) < ratio < chi2.ppf(1.0 - 5e-5, free)


# --- electrons and noise ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("band_um", [(3.7, 4.8), (3.1, 4.8), (4.4, 4.5)])
@pytest.mark.parametrize("kelvin", [250.0, 300.0, 600.0, 1000.0, 2000.0])
def test_electrons_are_the_integral_of_photon_radiance(band_um, kelvin):
    camera = replace(CAMERA, band_um=band_um)
    found, per_radiance = photons.electrons(band_radiance(kelvin, *band_um), camera)
    assert found == pytest.approx(number(kelvin, camera), rel=1e-6)
    low, high = band_radiance(kelvin * np.array([1.0 - 1e-4, 1.0 + 1e-4]), *band_um)
    assert per_radiance == pytest.approx(slope(kelvin, camera) * 2e-4 * kelvin / (high - low), rel=2e-5)


@pytest.mark.parametrize("kelvin", [290.0, 325.0])
def test_variance_of_counts_is_the_mean_number_of_electrons(kelvin):
    expected = number(kelvin) / slope(kelvin) ** 2
    assert agrees(read_k(QUIET, kelvin), expected + step_k(QUIET, kelvin) ** 2 / 12.0)
    assert not agrees(read_k(QUIET, kelvin), 1.04 * expected)


@pytest.mark.parametrize("kelvin", [290.0, 325.0])
def test_read_noise_adds_to_that_of_photons(kelvin):
    half = 0.5 * CAMERA.well_electrons
    total = 25e-3 * half * slope(300.0) / number(300.0)
    assert photons.read_noise_electrons(CAMERA) ** 2 == pytest.approx(total**2 - half, rel=1e-6)
    expected = (number(kelvin) + total**2 - half) / slope(kelvin) ** 2
    assert agrees(read_k(CAMERA, kelvin), expected + step_k(CAMERA, kelvin) ** 2 / 12.0)


def test_netd_is_the_stated_one_with_a_half_full_well():
    camera = filled(300.0, 0.5, frame_rate_hz=30.0)
    assert agrees(read_k(camera, 300.0), 25e-3**2 + step_k(camera, 300.0) ** 2 / 12.0)
    # Photons alone: 15 mK at the 30 °C of the data sheet.
    warm = filled(303.15, 0.5)
    assert 1e3 * np.sqrt(number(303.15, warm)) / slope(303.15, warm) == pytest.approx(15.0, abs=0.05)
    assert CAMERA.least_netd_mk == pytest.approx(1e3 * np.sqrt(number(300.0, camera)) / slope(300.0, camera))


def test_hot_targets_have_more_noise_in_radiance_and_less_in_kelvin():
    cold, hot = ((number(t) ** 0.5, 1e3 * number(t) ** 0.5 / slope(t)) for t in (290.0, 325.0))
    assert hot[0] > 1.4 * cold[0] and hot[1] < 0.8 * cold[1]
    found = [read_k(QUIET, t, 8).std(axis=0, ddof=1).mean() for t in (290.0, 325.0)]
    assert found[1] / found[0] == pytest.approx(hot[1] / cold[1], rel=0.03)


def test_noise_of_frames_rows_and_columns_is_part_of_the_netd():
    camera = filled(300.0, 0.5, frame_rate_hz=30.0, sigma_t_mk=5.0, sigma_tv_mk=8.0, sigma_th_mk=6.0)
    found = read_k(camera, 300.0) - 300.0
    assert 1e3 * found.std() == pytest.approx(25.0, rel=0.03)
    rows = found.mean(axis=2)
    assert 1e3 * np.std(rows - rows.mean(axis=1, keepdims=True)) == pytest.approx(
        np.hypot(8.0, 22.0 / 48**0.5), rel=0.1
    )


@pytest.mark.parametrize(
    ("kelvin", "range_c"),
    [(300.0, (-20.0, 60.0)), (600.0, (200.0, 400.0)), (1000.0, (400.0, 900.0)), (2000.0, (1000.0, 2000.0))],
)
def test_radiometry_from_300_to_2000_k(kelvin, range_c):
    camera = filled(kelvin, 0.6, range_c=range_c, frame_rate_hz=10.0)
    assert camera.integration_ms < 30.0 * np.exp(-3345.0 * (1.0 / 300.0 - 1.0 / kelvin)) * 1.2
    found, sigma = read_k(camera, kelvin, 8), np.sqrt(number(kelvin, camera)) / slope(kelvin, camera)
    assert found.mean() == pytest.approx(kelvin, abs=0.02 * step_k(camera, kelvin) + 0.1 * sigma)
    radiance = band_radiance(kelvin, *camera.band_um)
    assert brightness_temperature(radiance, *camera.band_um) == pytest.approx(kelvin, rel=1e-9)
    assert apparent_temperature(np.float32(radiance), camera.band_um) == pytest.approx(kelvin, abs=2e-3)
    # The formula of FLIR, fitted to the camera's band and range.
    at = np.linspace(*camera.count_range_k, 50)
    assert camera_constants(camera).temperature(band_radiance(at, *camera.band_um)) == pytest.approx(at, abs=0.05)


# --- the well ---------------------------------------------------------------------------------------------------


def test_full_wells_read_the_highest_count():
    full_k = brentq(lambda t: number(t) - CAMERA.well_electrons, 250.0, 500.0)
    assert photons.full_well_k(CAMERA) == pytest.approx(full_k, abs=1e-3)
    camera = replace(CAMERA, range_c=(-20.0, 120.0))
    sensor = Sensor(camera, 0)
    for kelvin, full in ((full_k - 1.0, False), (full_k + 1.0, True), (2000.0, True)):
        counts = sensor.counts_at_rest(even(camera, kelvin))
        assert (counts == 2**16 - 1).all() == full and (readout.saturated(counts, camera) == full).all()
    # Half of the pixels at the limit, by noise.
    share = readout.saturated(sensor.counts_at_rest(even(camera, full_k)), camera).mean()
    assert share == pytest.approx(0.5, abs=4.0 * 0.5 / camera.width)
    linear = replace(camera, tlinear_mk=40.0)
    assert readout.saturated(Sensor(linear, 0).counts_at_rest(even(linear, full_k + 1.0)), linear).all()


def test_wells_fill_later_in_the_dark_corners():
    camera = replace(SHIPPED, range_c=(-20.0, 120.0), bad_pixels=0.02)
    counts = Sensor(camera, 0).counts_at_rest(even(camera, photons.full_well_k(camera) + 1.0))
    full = readout.saturated(counts, camera)
    assert full[236:276, 300:340].all() and not full[:20, :20].any()
    found = brightness_temperature(readout.radiance_from_counts(counts[:20, :20], camera), *camera.band_um)
    assert found.mean() == pytest.approx(photons.full_well_k(camera) + 1.0, abs=0.2)


def test_a_shorter_integration_time_extends_the_range():
    short = replace(CAMERA, integration_ms=0.01 * CAMERA.integration_ms)
    assert number(photons.full_well_k(short), short) == pytest.approx(CAMERA.well_electrons, rel=1e-5)
    assert photons.full_well_k(short) > photons.full_well_k(CAMERA) + 100.0


def test_wider_pixels_have_wider_wells():
    assert photons.full_well_k(CAMERA.coarser(4)) == pytest.approx(photons.full_well_k(CAMERA), abs=1e-6)


# --- the integration time ---------------------------------------------------------------------------------------

HEIGHT_M, GROUND, STEP = 120.0, float(band_radiance(290.0, 3.7, 4.8)), 0.2
WIDE = replace(CAMERA, width=120, height=96)
PX_PER_M = WIDE.focal_length_px / HEIGHT_M


def stripe(camera, middle_px, half_px=12.0):
    """Radiance of an upright warm stripe, each pixel's share exact, (H, W) float32."""
    edge = np.arange(camera.width + 1) - 0.5 * camera.width - camera.principal_offset_px[0]
    low, high = middle_px - half_px, middle_px + half_px
    share = np.clip(np.minimum(edge[1:], high) - np.maximum(edge[:-1], low), 0.0, 1.0)
    return np.tile(np.float32(GROUND + STEP * share), (camera.height, 1))


def seen(px_per_s, camera=WIDE, render_px=20.0, lag_mk=10.0, moves=False):
    """(Frame at 1 s, how, expected) of a stripe that crosses the view, moved by the camera or itself."""
    speed = px_per_s / PX_PER_M
    place = lambda t: px_per_s * (t - 1.0)  # noqa: E731
    path = lambda t: pose(0.0 if moves else -speed * (t - 1.0), 0.0, HEIGHT_M, 0.0, -90.0)  # noqa: E731
    half_m = 12.0 / PX_PER_M
    corners = lambda t: np.array([  # noqa: E731
        [place(t) / PX_PER_M + x, y, 0.0] for x in (-half_m, half_m) for y in (-20.0, 20.0)])  # fmt: skip
    mover = Mover(corners, lambda t: 300.0, np.array([]))
    sensor = Sensor(camera, 0)
    taken = Exposure(
        sensor, lambda t, by, lit, rim=None: stripe(by, place(t)), path, plane_depth(), 1.0 / 60.0, render_px, lag_mk,
        movers=[mover] if moves else [],
    )  # fmt: skip
    moment = in_sequence(camera, 0, 0.0)
    signal, how = taken.signal(moment, 1.0, stripe(camera, 0.0))
    assert taken.pixels is None
    offset, gain = sensor.power_law(moment)
    instants = 1.0 - 1e-3 * camera.integration_ms * (np.arange(400) + 0.5) / 400
    return (signal - offset) / gain, how, np.mean([stripe(camera, place(t)) for t in instants], axis=0)


def middle(image):
    """Column of a stripe's centre of mass, from the middle of the image [px]."""
    profile = image[48] - GROUND
    return profile @ (np.arange(WIDE.width) + 0.5 - 60.0) / profile.sum()


@pytest.mark.parametrize("moves", [False, True])
@pytest.mark.parametrize("px_per_s", [40.0, 500.0, 2000.0])
def test_an_edge_is_blurred_over_the_integration_time(px_per_s, moves):
    found, _, expected = seen(px_per_s, render_px=0.0, lag_mk=0.02, moves=moves)
    way = px_per_s * 1e-3 * WIDE.integration_ms
    # A ramp as long as the way, half a way late.
    assert middle(found) == pytest.approx(-0.5 * way, abs=0.02)
    assert np.abs(found - expected)[:, 20:100].max() < 0.02 * STEP
    assert np.abs(stripe(WIDE, 0.0) - expected).max() > 0.2 * STEP


@pytest.mark.parametrize("px_per_s", [40.0, 500.0])
def test_the_estimated_error_holds_where_moved_images_replace_renders(px_per_s):
    found, how, expected = seen(px_per_s)
    off_mk = np.sqrt(np.mean((found - expected) ** 2)) / per_mk(WIDE)
    assert how["renders"] < how["instants"] and off_mk < how["lag_mk"] < 20.0 * off_mk
    assert middle(found) == pytest.approx(-0.5e-3 * px_per_s * WIDE.integration_ms, abs=0.05)


def test_blur_ends_at_the_frames_time_and_grows_with_the_integration_time():
    long, short = (seen(500.0, replace(WIDE, integration_ms=ms), 0.0, 0.02)[0][48] for ms in (16.0, 4.0))
    # Ahead of the edge is no light.
    assert np.abs(short[73:100] - GROUND).max() < 1e-4 * STEP and np.abs(long[73:100] - GROUND).max() < 1e-4 * STEP
    ramps = [
        int(((values > GROUND + 0.02 * STEP) & (values < GROUND + 0.98 * STEP))[:60].sum()) for values in (long, short)
    ]
    assert ramps == [8, 2]
    assert past_s(WIDE) == 0.01 and plan_row(WIDE)[1] == "by motion" and "in 10 ms" in plan_row(WIDE)[2]


# --- files and refusals -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (
            "integration_ms = 10.0",
            "integration_ms = 20.0",
            "integration_ms=20 .* above 0 and up to 16.67 ms, a frame of",
        ),
        ("integration_ms = 10.0", "", "integration_ms=0 is not allowed beside well_electrons"),
        ("netd_mk = 25.0", "netd_mk = 14.0", "netd_mk=14 is below the photon noise .* give at least 14.98 mK"),
        ("well_electrons = 7e6", "", "integration_ms=10 is of a photon detector; give well_electrons too"),
        ("bits = 14", "bits = 14\ntime_constant_ms = 8.0", "time_constant_ms=8.0 is of a microbolometer"),
        ("bits = 14", "bits = 14\nrow_time_us = 8.0", "row_time_us=8.0 is of a microbolometer"),
        ("bits = 14", "bits = 14\ngain = 'low'", "gain='low' is of a microbolometer"),
        ("= 0.8 ", "= 1.8 ", "quantum_efficiency=1.8 is not allowed"),
    ],
)
def test_camera_files_of_photon_detectors(tmp_path, old, new, words):
    text = model_path("neutrino-lc").read_text(encoding="utf-8")
    assert old in text
    path = tmp_path / "mine.toml"
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(ThermorenderError, match=words):
        load_camera(path)


def test_the_shipped_camera():
    assert pytest.approx((35.5, 28.7), abs=0.05) == SHIPPED.field_of_view_deg
    assert SHIPPED.band_um == (3.7, 4.8) and replace(SHIPPED, band_um=(3.1, 4.8)).memory_s == 0.01
    assert "half-full well" in str(SHIPPED) and "photons of 10 ms, a well of 7e+06 electrons" in str(SHIPPED)
    assert photons.full_well_k(SHIPPED) == pytest.approx(65.0 + 273.15, abs=0.5)


def test_the_air_of_long_wave_software_is_refused():
    counts = Sensor(CAMERA, 0).counts_at_rest(even(CAMERA, 300.0))
    with pytest.raises(
        ThermorenderError, match=r"distance_m=50 .* 7…15 µm, and camera neutrino-lc sees 3.7–4.8 µm; give"
    ):
        thermography_reading(counts, CAMERA, ThermographySettings(distance_m=50.0))
    assert thermography_reading(counts, CAMERA, ThermographySettings()).mean() == pytest.approx(300.0, abs=0.01)


def test_fits_take_microbolometers(tmp_path):
    (tmp_path / "frame.tif").touch()
    with pytest.raises(ThermorenderError, match=r"neutrino-lc has a photon detector, .* give a microbolometer"):
        fit_camera([tmp_path], "neutrino-lc")


def test_microbolometers_are_as_before():
    camera = load_camera("zenmuse-xt2")
    text = every_field(camera, *camera.absent)
    assert text.endswith("visible_width=4000, visible_field_of_view_deg=(57.12, 42.44))")
    assert camera.memory_s == camera.time_constant_s and past_s(camera) == 8.0 * camera.time_constant_s
    small = replace(camera, width=32, height=24)
    counts = Sensor(small, 5).counts_at_rest(even(small, 300.0), 3).astype(int)
    assert counts[::8, ::8] == pytest.approx(np.array(BEFORE), abs=1)
    assert counts.mean() == pytest.approx(MEAN_BEFORE, abs=0.01)


# Counts of the version without photon detectors.
BEFORE = [[3155, 3167, 3118, 3083], [3140, 3156, 3118, 3105], [3148, 3152, 3105, 3115]]
MEAN_BEFORE = 3122.194
