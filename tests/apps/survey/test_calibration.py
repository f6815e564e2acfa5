"""Camera parameters fitted to footage (noise, fixed pattern, blur, gain control), simulated and real."""

import re
from dataclasses import replace

import numpy as np
import pytest
import tifffile
from support import shared_data, slow
from typer.testing import CliRunner

from tests.robustness.fuzz.corpus.images import flir_container
from thermorender.apps.survey.footage import calibration
from thermorender.apps.survey.footage.edge_width import edge_widths, sharpest, width_through
from thermorender.apps.survey.footage.field_statistics import Field
from thermorender.apps.survey.footage.noise_statistics import Spectra, block_powers, noise_of
from thermorender.cli import app as cli
from thermorender.errors import ThermorenderError
from thermorender.formats import write_image
from thermorender.physics.band import RadianceTable
from thermorender.physics.planck import band_radiance
from thermorender.sensor.camera import load_camera
from thermorender.sensor.chain import Sensor, in_sequence
from thermorender.sensor.flir_jpeg import flir_image
from thermorender.sensor.noise import half_waves, noise_power
from thermorender.sensor.psf import otf
from thermorender.sensor.radiometric_files import write_tlinear
from thermorender.sensor.readout import radiance_from_counts
from thermorender.sensor.thermal_files import thermal_frames, thermal_images
from thermorender.sensor.wander import Wander

GRID = RadianceTable.grid(250.0, 345.0)
TABLE = RadianceTable(GRID, band_radiance(GRID, 7.5, 13.5))
STEP_K = 0.006
# A small XT2 whose noise components are large enough to separate, without drift or shading.
STEADY = dict.fromkeys(
    ("narcissus_mk", "shading_mk", "shading_mk_per_k", "flicker_mk", "scale_drift_mk", "blinking_pixels", "case_rise_k",
     "ffc_interval_s"), 0.0,
) | {"responsivity_percent": (0.0, 0.0)}  # fmt: skip
CAMERA = replace(
    load_camera("zenmuse-xt2"), **STEADY, name="known", width=320, height=256, focal_length_mm=6.5, netd_mk=45.0,
    sigma_t_mk=0.0, sigma_tv_mk=8.0, sigma_th_mk=10.0, sigma_v_mk=9.0, sigma_h_mk=14.0, sigma_vh_mk=25.0,
    bad_pixels=0.0, blur_sigma_px=0.4, bits=16, range_c=(-20.0, 60.0),
)  # fmt: skip


def polygons(height, width, seed=0, oversampled=4, count=60):
    """Temperature of flat patches with straight edges, (height, width) pixel means of an oversampled drawing [K]."""
    import cv2

    rng = np.random.default_rng(seed)

    image = np.full((height * oversampled, width * oversampled), 296.0, np.float32)
    for _ in range(count):
        middle = rng.uniform(0, 1, 2) * [width, height] * oversampled
        size, turn = rng.uniform(25, 60, 2) * oversampled, rng.uniform(0, 180)
        corners = cv2.boxPoints((middle.tolist(), size.tolist(), turn))
        cv2.fillPoly(image, [np.rint(corners).astype(np.int32)], float(rng.uniform(286, 306)))
    return image.reshape(height, oversampled, width, oversampled).mean(axis=(1, 3))


def footage(camera, frames, static=False, seed=4, change=lambda view, index: view):
    """Apparent temperatures [K] of a camera over a scene of patches, with a little texture."""
    scene, rng = polygons(2 * camera.height, 2 * camera.width, seed), np.random.default_rng(seed + 1)
    sensor = Sensor(camera, seed)
    for index in range(frames):
        i, j = (0, 0) if static else (int(rng.integers(0, n)) for n in (camera.height, camera.width))
        view = change(scene[i : i + camera.height, j : j + camera.width].astype(np.float64), index)
        moment = in_sequence(camera, index, index / camera.frame_rate_hz)
        counts = sensor.counts(sensor.power(TABLE(view).astype(np.float32), moment), moment)
        yield TABLE.inverse(radiance_from_counts(counts, camera))


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    """Camera file of CAMERA with the shipped camera's noise and blur: what a user starts from."""
    path = tmp_path_factory.mktemp("base") / "small.toml"
    text = calibration.model_path("zenmuse-xt2").read_text(encoding="utf-8")
    for old, new in (("width = 640", "width = 320"), ("height = 512", "height = 256"), ("bits = 14", "bits = 16"),
                     ("focal_length_mm = 13.0", "focal_length_mm = 6.5"),
                     ("range_c = [-25.0, 135.0]", "range_c = [-20.0, 60.0]")):  # fmt: skip
        assert old in text
        text = text.replace(old, new)
    path.write_text(text, encoding="utf-8")
    return path


def write_frames(folder, images):
    folder.mkdir()
    for number, image in enumerate(images):
        write_tlinear(folder / f"{number:03d}.tif", image, STEP_K)
    return folder


# Mean error and spread of single fits over 24 takes, in the keys' units. Takes differ in scene, path and noise. The
# finest texture of edges is fitted as a little sharpness, and no fitted standard deviation is below 0.
TAKES = 4
SINGLE_FIT = {
    "netd_mk": (-0.3, 1.0), "sigma_tv_mk": (0.2, 1.6), "sigma_th_mk": (-1.2, 2.4), "sigma_v_mk": (-0.1, 0.95),
    "sigma_h_mk": (0.0, 1.3), "sigma_vh_mk": (0.1, 0.5), "blur_sigma_px": (-0.041, 0.022),
}  # fmt: skip


@pytest.fixture(scope="module")
def takes(base, tmp_path_factory):
    """[(folder of frames, the fit to them)] of the known camera."""
    folder = tmp_path_factory.mktemp("footage")
    whole = [write_frames(folder / f"take{seed}", footage(CAMERA, 8, seed=seed)) for seed in range(TAKES)]
    return [(take, calibration.fit_camera([take], base)) for take in whole]


@pytest.fixture(scope="module")
def fitted(base, tmp_path_factory):
    """(folder of frames, the fit to them): one take of the known camera."""
    take = write_frames(tmp_path_factory.mktemp("footage") / "take", footage(CAMERA, 8, seed=0))
    return take, calibration.fit_camera([take], base)


@pytest.mark.slow
@pytest.mark.parametrize("key", SINGLE_FIT)
def test_fit_recovers_a_known_camera(takes, key):
    found = np.array([(estimates[key].value, estimates[key].uncertainty) for _, estimates in takes])
    true, (offset, spread) = getattr(CAMERA, key), SINGLE_FIT[key]
    # The error of the mean is the spread over the square root of the number of takes.
    assert abs(found[:, 0].mean() - true - offset) < 3.0 * spread / np.sqrt(TAKES)
    # The stated uncertainty matches the true error: 0.5 to 1.7 times it among the 24 takes.
    error = np.hypot(offset, spread)
    assert 0.4 * error < found[:, 1].min() and found[:, 1].max() < 2.0 * error
    assert error < 0.28 * true


def test_a_sequence_gives_the_fit_of_its_frames_as_tiffs(base, tmp_path):
    planck = flir_image(flir_container(np.zeros((4, 4), np.uint16))).planck
    signals = [np.rint(planck.signal(image)).astype(np.uint16) for image in footage(CAMERA, 4)]
    (tmp_path / "walk.seq").write_bytes(b"".join(map(flir_container, signals)))
    (tmp_path / "tiffs").mkdir()
    for image in thermal_images(thermal_frames([tmp_path / "walk.seq"]), correction="nothing"):
        tifffile.imwrite(tmp_path / "tiffs" / f"{image.frame.name}.tif", image.kelvin)
    found, expected = (calibration.fit_camera([tmp_path / name], base) for name in ("walk.seq", "tiffs"))
    assert found == expected and found["netd_mk"].value == pytest.approx(CAMERA.netd_mk, rel=0.1)


def test_static_camera(base, tmp_path):
    folder = write_frames(tmp_path / "static", footage(CAMERA, 5, static=True))
    found = calibration.fit_camera([folder], base)
    assert "static camera" in found["netd_mk"].how
    # Five frames may contain no information on rows and columns, 1.9 mK of the whole; single pixels are known to 0.2
    # mK.
    without = np.sqrt(CAMERA.netd_mk**2 - CAMERA.sigma_tv_mk**2 - CAMERA.sigma_th_mk**2)
    assert found["netd_mk"].value == pytest.approx(CAMERA.netd_mk, abs=CAMERA.netd_mk - without + 3.0 * 0.2)
    # Mean error and spread over 12 takes: (−1.3, 1.8).
    assert found["sigma_vh_mk"].value == pytest.approx(CAMERA.sigma_vh_mk - 1.3, abs=5.4)


# As SINGLE_FIT, plus the stated uncertainty, over 16 takes of 24 frames over endless scenes and 12 takes of 60 frames
# from a static camera. The uncertainty of bad pixels is that of their share; adjacent bad pixels are missed.
WHOLE = {"shading_mk": (15.0, 60.0, 80.0), "vignetting": (0.006, 0.022, 0.038), "bad_pixels": (-1e-4, 5e-5, 2.2e-4)}
LEVELS = {"sigma_t_mk": (0.0, 2.0, 1.5), "scale_drift_mk": (0.0, 8.0, 6.6), "vignetting": (-0.004, 0.01, 0.02)}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("static", "frames", "fits", "true"),
    [
        (False, 24, WHOLE, {"shading_mk": 400.0, "vignetting": 0.25, "bad_pixels": 0.004}),
        (True, 60, LEVELS, {"sigma_t_mk": 15.0, "scale_drift_mk": 30.0, "vignetting": 0.25}),
    ],
)
def test_fit_of_whole_image_parameters(base, tmp_path, static, frames, fits, true):
    # Rolled at a random seam in every frame, so that views share no gradient.
    camera, takes = replace(CAMERA, **true), 3
    found = []
    for seed in range(takes):
        rng = np.random.default_rng(100 + seed)
        shift = (lambda view, index: view) if static else (
            lambda view, index, rng=rng: np.roll(view, [rng.integers(0, n) for n in view.shape], (0, 1))
        )  # fmt: skip
        folder = write_frames(tmp_path / f"{seed}", footage(camera, frames, static, seed, shift))
        found.append(calibration.fit_camera([folder], base))
    for key, (offset, spread, uncertainty) in fits.items():
        values, uncertainties = np.array([(each[key].value, each[key].uncertainty) for each in found]).T
        assert abs(values.mean() - true[key] - offset) < 3.0 * spread / np.sqrt(takes), key
        assert 0.4 * uncertainty < uncertainties.min() and uncertainties.max() < 2.2 * uncertainty, key
    # A static camera shows its scene's gradients, a moving one another scene in each frame.
    assert ("shading_mk" in found[0]) != static and ("scale_drift_mk" in found[0]) == static
    # Noise is stated for the image centre, using the fitted vignetting.
    netd = np.hypot(CAMERA.netd_mk, true.get("sigma_t_mk", 0.0)) if static else CAMERA.netd_mk
    mean = np.mean([each["netd_mk"].value for each in found])
    assert mean == pytest.approx(netd, abs=3.0 * 1.2 / np.sqrt(takes) + 1.0)


def field_of(images):
    """A Field of images of 32 × 32 pixels, none of which is cut off."""
    field = Field((32, 32))
    for image in images:
        field.add(image, np.zeros((32, 32), bool))
    return field


def test_shading_excludes_what_changing_scenes_add():
    # One mode of 0.4 K, and nine that the scene changes by 0.5 K from frame to frame.
    draws, rng, found, wave = 400, np.random.default_rng(3), [], half_waves(32)
    for _ in range(draws):
        amplitudes = rng.normal(0.0, 0.5, (24, 4, 4)) + np.where(np.arange(16).reshape(4, 4) == 4, 0.4, 0.0)
        found.append(field_of(290.0 + wave.T @ each @ wave for each in amplitudes).shading())
    value, uncertainty = np.array(found).T
    # The mean of the square is compared, as some squares are negative and no root is below zero.
    square = value**2
    assert square.mean() == pytest.approx(0.16, abs=3.0 * square.std() / np.sqrt(draws) + 0.01)
    seen = np.quantile(value, (0.16, 0.84))
    assert np.median(uncertainty) == pytest.approx(0.5 * np.diff(seen)[0], rel=0.25)


@pytest.mark.parametrize(("frames", "rate_hz"), [(60, 9.0), *slow((60, 30.0), (300, 9.0))])
def test_stated_uncertainty_of_scale_drift_matches_its_error(frames, rate_hz):
    # Levels from the camera's own model of scale drift, from a random start: each whole second has a new draw.
    camera, rng, takes = replace(CAMERA, scale_drift_mk=1.0), np.random.default_rng(5), 80
    one_k, time_s, found = noise_power(camera, 1.0), np.arange(frames) / rate_hz, []
    for seed in range(takes):
        course, start_s = Wander(camera, seed), rng.uniform(0.0, 1000.0)
        drift = [course.scale_drift(start_s, start_s + t) / one_k for t in time_s]
        levels = 290.0 + 0.03 * np.array(drift) + rng.normal(0.0, 0.01, frames)
        found.append(field_of(np.full((32, 32), level) for level in levels).wander(rate_hz, 0.0))
    for (value, uncertainty), true in zip(np.moveaxis(found, 0, -1), (0.01, 0.03), strict=True):
        error, stated = (np.sqrt(np.mean(np.square(values))) for values in (value - true, uncertainty))
        # A root mean square of 80 draws has an error of 8 %; with tails as long as these, twice that.
        assert 0.75 * error < stated < 2.0 * error


def test_level_noise_of_uniform_frames_is_small():
    # Row, column and pixel noise enter a frame's level, and the median over its blocks more than its mean.
    rng, found = np.random.default_rng(2), []
    for _ in range(24):
        field = Field((192, 192))
        for _ in range(40):
            field.add(290.0 + rng.normal(0.0, 0.5, (192, 192)), np.zeros((192, 192), bool))
        found.append(field.wander(9.0, 0.5 / 192)[0][0])
    # 40 levels give their variance, 2π/3 of a mean's, to √(2/39): 0.47. Half of the fits are 0, the roots of the others
    # are about 0.6, and the error of the mean of 24 is 0.08.
    assert np.mean(found) < (0.5 * 0.6 + 2.0 * 0.08) * 0.5 / 192, found


def flames(share, most_k, side=16):
    """A share of the picture flickers in squares by up to `most_k` kelvins."""

    def change(view, index):
        rng, (height, width) = np.random.default_rng(index), view.shape
        glow = np.kron(rng.uniform(0.0, most_k, (height // side, width // side)), np.ones((side, side)))
        return view + np.where(abs(np.arange(width) / width - 0.5) < 0.5 * share, glow, 0.0)

    return change


@pytest.mark.parametrize(
    ("share", "most_k", "how"),
    [(0.1, 6.0, "changing scene"), *slow((1.0, 3.0, "changing scene"), (0.4, 30.0, "flattest tenth"))],
)
def test_scene_changes_do_not_count_as_noise(base, tmp_path, share, most_k, how):
    # A small fire in front of a camera that is recognised as static, and one so large that it is not.
    folder = write_frames(tmp_path / "fire", footage(CAMERA, 3, static=True, change=flames(share, most_k)))
    found = calibration.fit_camera([folder], base)
    assert how in found["netd_mk"].how
    # The quiet blocks of three frames give single-pixel noise to 1.5 mK; rows and columns are lost in the flames.
    single = np.sqrt(CAMERA.netd_mk**2 - CAMERA.sigma_tv_mk**2 - CAMERA.sigma_th_mk**2)
    rest = np.hypot(found["sigma_tv_mk"].value, found["sigma_th_mk"].value)
    assert np.sqrt(found["netd_mk"].value ** 2 - rest**2) == pytest.approx(single, abs=4.5)


@pytest.mark.slow
def test_flat_field_correction_between_frames_does_not_count_as_noise(base, tmp_path):
    # Every 1 s at 9 Hz a new pattern, of half the noise of single pixels.
    camera = replace(CAMERA, ffc_interval_s=1.0, ffc_duration_s=0.0)
    folder = write_frames(tmp_path / "static", footage(camera, 24, static=True))
    with pytest.raises(ThermorenderError, match=r"changes from 008.tif to 009.tif, as by a flat-field correction"):
        calibration.fit_camera([folder], base)
    between = calibration.fit_camera(sorted(folder.iterdir())[9:18], base)
    assert abs(between["sigma_vh_mk"].value - CAMERA.sigma_vh_mk) < 3.0 * between["sigma_vh_mk"].uncertainty
    folder = write_frames(tmp_path / "moving", footage(camera, 12))
    assert "too low where a flat-field correction fell" in calibration.fit_camera([folder], base)["sigma_vh_mk"].how


def test_scene_without_flat_or_constant_parts_is_refused(base, tmp_path):
    folder = write_frames(tmp_path / "storm", footage(CAMERA, 3, static=True, change=flames(1.0, 12.0, 4)))
    with pytest.raises(ThermorenderError, match="no part of the frames is flat or constant"):
        calibration.fit_camera([folder], base)


@pytest.mark.slow
def test_pixels_at_the_end_of_the_range_are_ignored(base, tmp_path):
    # The range begins at 293 K; a wedge over four tenths of the picture is colder, and so are some patches.
    camera = replace(CAMERA, range_c=(20.0, 60.0))

    def cold(view, index):
        row, column = np.mgrid[:256, :320]
        return np.where(column + 0.3 * row < 170 + index, 285.0, view)

    for static in (False, True):
        wedge = (lambda view, index: cold(view, 0)) if static else (lambda view, index: cold(view, 10 * index))
        folder = write_frames(tmp_path / f"cold{static}", footage(camera, 8, static=static, change=wedge))
        found = calibration.fit_camera([folder], base)
        single = found["netd_mk"].value ** 2 - found["sigma_tv_mk"].value ** 2 - found["sigma_th_mk"].value ** 2
        assert np.sqrt(single) == pytest.approx(43.1, abs=4.5), static
        assert found["bad_pixels"].value == 0.0
        # The clipped pixels do not enter the temperature at which the noise is stated.
        assert float(re.search(r"frames at (\d+) K", found["netd_mk"].how)[1]) >= 296.0
    folder = write_frames(tmp_path / "all", footage(CAMERA, 2, change=lambda view, index: 0.0 * view + 251.0))
    with pytest.raises(ThermorenderError, match=r"cut off at an end|hold no noise"):
        calibration.fit_camera([folder], base)


def test_frames_without_noise_or_beyond_the_range(base, tmp_path):
    for number in range(3):
        write_tlinear(tmp_path / f"even{number}.tif", np.full((256, 320), 290.0))
    with pytest.raises(ThermorenderError, match="the frames hold no noise"):
        calibration.fit_camera(sorted(tmp_path.glob("even*.tif")), base)
    write_image(tmp_path / "celsius.tif", np.full((256, 320), 7250, np.uint16))
    with pytest.raises(ThermorenderError, match=r"the median temperature of .*celsius.tif=16.85 is below 100 K"):
        calibration.fit_camera([tmp_path / "celsius.tif"], base, (0.04, -273.15))
    hot = next(footage(CAMERA, 1))
    hot[100, 100] = 273.15 + 412.0
    write_tlinear(tmp_path / "hot.tif", hot, 0.04)
    with pytest.raises(ThermorenderError, match=r'holds 412 °C, and high gain .* ends at 60 °C; .* gain = "low"'):
        calibration.fit_camera([tmp_path / "hot.tif"], base)
    low = tmp_path / "low.toml"
    low.write_text(base.read_text(encoding="utf-8") + 'gain = "low"\n', encoding="utf-8")
    found = calibration.fit_camera([tmp_path / "hot.tif"], low)
    assert "low_gain_netd_mk" in found and "netd_mk" not in found
    calibration.write_camera(tmp_path / "mine.toml", low, found)
    assert load_camera(tmp_path / "mine.toml").gain_netd_mk == found["low_gain_netd_mk"].rounded


def test_low_gain_is_suggested_by_high_noise(base, tmp_path):
    folder = write_frames(tmp_path / "low", footage(replace(CAMERA, netd_mk=200.0), 4))
    assert "low gain is likely" in calibration.fit_camera([folder], base)["netd_mk"].how


@pytest.mark.parametrize("frames", [2, *slow(3, 7)])
def test_few_frames_give_fewer_parameters(base, tmp_path, frames):
    for static in (False, True):
        folder = write_frames(tmp_path / f"few{static}", footage(CAMERA, frames, static))
        found = calibration.fit_camera([folder], base)
        assert not {"shading_mk", "sigma_t_mk", "scale_drift_mk"} & set(found)
        # Adjacent pixels of two frames are similar by chance here and there; those of seven are not.
        assert ("bad_pixels" in found) == (frames == 7)
        assert frames < 7 or found["bad_pixels"].value == 0.0


def test_one_frame_gives_noise_including_the_fixed_pattern(base, tmp_path):
    folder = write_frames(tmp_path / "one", footage(CAMERA, 1))
    found = calibration.fit_camera([folder], base)
    assert set(found) <= {"netd_mk", "blur_sigma_px"} and "holds the fixed pattern" in found["netd_mk"].how
    parts = [CAMERA.netd_mk, CAMERA.sigma_v_mk, CAMERA.sigma_h_mk, CAMERA.sigma_vh_mk]
    # Over 12 takes (−1.6, 1.7) around 54.1. The gain correction raises only the temporal part, by up to 1.9 in the
    # corners, so the flattest blocks contain slightly less of the fixed part.
    assert found["netd_mk"].value == pytest.approx(np.linalg.norm(parts) - 1.6, abs=5.1)


def test_noise_scale_against_the_published_ratio():
    # 50 mK at f/1.0 are 72.5 mK at f/1.25, (4F²+1)/5, and 1/0.9 times more through a lens of that transmittance.
    assert calibration.noise_scale(CAMERA, 300.0) == pytest.approx(1.45 / 0.9)
    assert calibration.noise_scale(replace(CAMERA, f_number=1.0, lens_transmittance=1.0), 300.0) == pytest.approx(1.0)
    # The same noise is more kelvins where radiance grows more slowly: dL/dT over 7.5–13.5 µm by differences.
    slope = [band_radiance(t + 0.5, 7.5, 13.5) - band_radiance(t - 0.5, 7.5, 13.5) for t in (300.0, 270.0)]
    assert calibration.noise_scale(CAMERA, 270.0) == pytest.approx(1.45 / 0.9 * slope[0] / slope[1], rel=1e-4)


def test_spectra_of_white_and_fixed_noise():
    # White noise has its variance at every frequency; the mean product of frames keeps only what they share.
    rng, frames = np.random.default_rng(12), 40
    shared, spectra = rng.normal(0.0, 0.03, (128, 192)), Spectra((128, 192))
    for _ in range(frames):
        spectra.add(290.0 + shared + rng.normal(0.0, 0.05, (128, 192)))
    band = spectra.off_axis((0.05, 0.71))
    # Powers scatter by their own size; with Hann's window 3.8 neighbours count as one. The fixed part is one draw, the
    # changing part one of 40, and their cross term counts twice.
    alone = band.sum() / 3.8
    scatter = np.sqrt((0.03**4 + 2.0 * 0.03**2 * 0.05**2 / frames + 0.05**4 / frames) / alone)
    assert abs(spectra.total[band].mean() - 0.03**2 - 0.05**2) < 3.0 * scatter < 0.1 * 0.03**2
    assert abs(spectra.fixed[band].mean() - 0.03**2) < 3.0 * scatter
    # 320 blocks of some 100 frequencies in the finest band.
    blocks = block_powers(rng.normal(0.0, 0.05, (512, 640)))
    spread = blocks.std(axis=0) / np.sqrt(len(blocks))
    assert abs(blocks[:, 1].mean() - 0.05**2) < 3.0 * spread[1] < 0.04 * 0.05**2
    # A plane has 3 of a block's 1024 degrees of freedom, and what it removes is coarse: at most all of it comes from
    # the coarser band, which has 7 % of all frequencies.
    assert -3.0 / (0.07 * 1024) * 0.05**2 - 3.0 * spread[0] < blocks[:, 0].mean() - 0.05**2 < 3.0 * spread[0]


def test_block_powers_ignore_slopes():
    down, right = np.mgrid[:128, :160]
    assert block_powers(3.0 * down - 2.0 * right).max() < 1e-18


def test_row_and_column_noise_from_their_spectral_lines():
    true = {"fixed_row": 0.02, "row": 0.03, "column": 0.03, "fixed_column": 0.0, "pixel": 0.05}
    found = {name: [] for name in true}
    draws = 6
    for draw in range(draws):
        rng, spectra = np.random.default_rng(draw), Spectra((256, 320))
        still = rng.normal(0.0, true["fixed_row"], (256, 1))
        for _ in range(12):
            rows, columns = rng.normal(0.0, true["row"], (256, 1)), rng.normal(0.0, true["column"], (1, 320))
            spectra.add(still + rows + columns + rng.normal(0.0, true["pixel"], (256, 320)))
        noise = noise_of(spectra)
        for name, values in found.items():
            values.append(getattr(noise, name))
    # Mean error and spread of single draws over 24 of them [K]. A zero component reads as (2.6, 2.3) mK, as no
    # deviation is below 0.
    single = {
        "fixed_row": (-3e-4, 1.7e-3), "row": (-9e-4, 1.2e-3), "fixed_column": (2.6e-3, 2.3e-3),
        "column": (-2e-4, 0.9e-3), "pixel": (0.0, 3.6e-4),
    }  # fmt: skip
    for name, (offset, spread) in single.items():
        value, uncertainty = np.mean(found[name], axis=0)
        assert abs(value - true[name] - offset) < 3.0 * spread / np.sqrt(draws), name
        assert 0.5 * spread < uncertainty < 2.2 * spread, name


def blurred_step(sigma, angle, noise=0.0, seed=12):
    from scipy.special import erf

    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:96, :128] - 48.0
    u = (x - 16.0) * np.cos(angle) + y * np.sin(angle)
    return 290.0 + 4.0 * erf(u / (np.sqrt(2.0) * sigma)) + rng.normal(0.0, max(noise, 1e-6), x.shape)


@pytest.mark.parametrize("sigma", [0.45, 0.7, 1.2])
def test_width_of_a_blurred_step(sigma):
    angles = (0.1, 0.7, 1.3, -0.5)
    steps = [blurred_step(sigma, angle, 0.05, seed) for seed, angle in enumerate(angles)]
    widths = np.concatenate([edge_widths(step, 0.05) for step in steps])
    # Some 40 windows along four edges; the error of their median is 0.17 % (one standard deviation, over 12 draws).
    assert len(widths) >= 38
    assert np.median(widths[:, 0]) == pytest.approx(sigma, rel=0.006)
    # The stated uncertainty matches the scatter, which 40 windows give to 1/√80 and a little more.
    assert np.std(widths[:, 0]) == pytest.approx(np.median(widths[:, 1]), rel=0.4)
    width, uncertainty = sharpest(widths)
    # Over 24 draws at each width the error of the sharpest is up to 0.28 % in the mean, with a spread of 0.28 %. The
    # stated uncertainty is the possible softness of a scene's own edges, 0.02 px, and little more.
    assert abs(width - sigma) < 0.0112 * sigma and 0.02 < uncertainty < 0.025


@pytest.mark.parametrize("blur", [0.4, *slow(0.8)])
def test_lens_blur_excludes_pixel_and_diffraction(blur):
    quiet = dict.fromkeys(("sigma_tv_mk", "sigma_th_mk", "sigma_v_mk", "sigma_h_mk", "sigma_vh_mk"), 0.0)
    camera = replace(CAMERA, blur_sigma_px=blur, netd_mk=30.0, **quiet)
    images = list(footage(camera, 2))
    estimate = calibration._blur_key(images, 0.060, camera)["blur_sigma_px"]
    # Over 12 takes: (−0.034, 0.012) at 0.4 px, (−0.011, 0.012) at 0.8 px, and stated uncertainties of 0.02 to 0.05.
    offset = {0.4: -0.034, 0.8: -0.011}[blur]
    assert abs(estimate.value - blur - offset) < 3.0 * 0.012 and 0.015 < estimate.uncertainty < 0.055


def test_thin_lines_are_not_edges():
    y, x = np.mgrid[:96, :128]
    line = 290.0 + 8.0 * np.exp(-0.5 * ((x - 60.0 - 0.3 * y) / 0.6) ** 2)
    line += np.random.default_rng(12).normal(0.0, 0.05, x.shape)
    assert len(edge_widths(line, 0.05)) == 0
    assert sharpest(np.zeros((0, 2))) is None


def test_width_through_a_lens():
    assert width_through(lambda f: np.exp(-2.0 * (np.pi * 0.7 * f) ** 2)) == pytest.approx(0.7, rel=1e-3)
    # A square pixel alone blurs a step to a ramp one pixel wide: compare with the best blurred step from a search.
    from scipy.special import erf

    position, sigmas = np.linspace(-6.0, 6.0, 1201), np.linspace(0.25, 0.4, 301)
    misfit = [((erf(position / (np.sqrt(2.0) * s)) - np.clip(2.0 * position, -1.0, 1.0)) ** 2).sum() for s in sigmas]
    assert width_through(np.sinc) == pytest.approx(sigmas[np.argmin(misfit)], abs=0.01)
    whole = width_through(lambda f: otf(CAMERA, f) * np.sinc(f))
    assert np.sqrt(0.4**2 + 1 / 12) < whole < 1.0


def test_written_file_is_a_valid_camera(fitted, base, tmp_path, monkeypatch):
    folder, estimates = fitted
    calibration.write_camera(tmp_path / "mine.toml", base, estimates)
    mine = load_camera(tmp_path / "mine.toml")
    assert mine.name == "mine" and mine.width == 320 and mine.f_number == CAMERA.f_number
    for key, estimate in estimates.items():
        assert getattr(mine, key) == pytest.approx(estimate.value, rel=1e-3)
    text = (tmp_path / "mine.toml").read_text()
    assert "± " in text and text.count("\nnetd_mk =") == 1
    # The file lists the assumed values that the fit uses, and the other values copied from the base.
    rest, others = calibration.not_measured(base, estimates)
    assert "f_number = 1.25" in rest and "lens_transmittance = 0.9" in rest and "small" in rest
    assert "time_constant_ms" in others and " netd_mk" not in others and "f_number" not in others
    assert re.sub(r"\n# ", " ", text).count(rest) == 1
    asked = []
    monkeypatch.setattr(calibration, "fit_camera", lambda *arguments: asked.append(arguments) or estimates)
    arguments = ["fit-camera", str(folder), "--base", str(base), "-o", str(tmp_path / "b.toml"), "--scale", "0.04,1"]
    run = CliRunner().invoke(cli.app, arguments)
    assert asked == [([folder], str(base), (0.04, 1.0))]
    assert run.exit_code == 0 and (tmp_path / "b.toml").read_text() == text.replace("mine", "b")
    assert f"netd_mk = {estimates['netd_mk'].text} ± " in run.output
    assert rest in run.output and others in run.output


def test_wrong_inputs_are_refused(base, tmp_path):
    small, odd = np.full((64, 64), 290.0), np.full((256, 320), 290.0)
    write_tlinear(tmp_path / "small.tif", small)
    write_tlinear(tmp_path / "odd.tif", odd)
    (tmp_path / "empty").mkdir()
    (tmp_path / "note.txt").write_text("x")
    for paths, words in (
        ([tmp_path / "small.tif"], "is 64×64 pixels and the base camera small 320×256"),
        ([tmp_path / "empty"], "no frames"),
        ([tmp_path / "none.tif"], "does not exist"),
        ([tmp_path / "note.txt"], "unknown kind"),
    ):
        with pytest.raises(ThermorenderError, match=words):
            calibration.fit_camera(paths, base)
    with pytest.raises(ThermorenderError, match="base camera 'bogus' is unknown"):
        calibration.fit_camera([tmp_path / "odd.tif"], "bogus")
    with pytest.raises(ThermorenderError, match=r"ends in .toml"):
        calibration.write_camera(tmp_path / "a.txt", base, {})
    with pytest.raises(ThermorenderError, match="too small to read noise from"):
        Spectra((64, 64))
    with pytest.raises(ThermorenderError, match="the others"):
        Spectra((128, 128)).add(np.zeros((128, 96)))
    with pytest.raises(ThermorenderError, match="no finite value"):
        Spectra((128, 128)).add(np.full((128, 128), np.nan))


@pytest.mark.slow
def test_real_camera(tmp_path):
    # Radiometric JPEGs of a Zenmuse XT, whose core is specified to have less than 50 mK at f/1.0.
    found = calibration.fit_camera([shared_data("pairs/thermal_only/eth_crops_xt/flight1/rjpeg")], "zenmuse-xt2")
    assert 20.0 < found["netd_mk"].value < 50.0
    assert found["agc_tails_percent"].value == pytest.approx((0.0, 0.0), abs=0.01)
    assert 0.1 < found["blur_sigma_px"].value < 1.0
    calibration.write_camera(tmp_path / "xt.toml", "zenmuse-xt2", found)
    assert load_camera(tmp_path / "xt.toml").agc_tails_percent[0] == 0.0


def test_simulated_frames_have_the_noise_of_the_footage(fitted, base, tmp_path, monkeypatch):
    from validation.footage import study as sensor_statistics

    scene = TABLE(polygons(2 * CAMERA.height, 2 * CAMERA.width).astype(float)).astype(np.float32)
    cuts = [(10, 20), (200, 40), (30, 300), (250, 310)]
    views = [scene[i : i + CAMERA.height, j : j + CAMERA.width] for i, j in cuts]
    monkeypatch.setattr(sensor_statistics, "views_of", lambda *rest: views)
    monkeypatch.setattr(sensor_statistics, "fit_camera", lambda *rest: fitted[1])
    result = sensor_statistics.compare([fitted[0]], tmp_path, base)
    assert {path.name for path in tmp_path.iterdir()} == {"footage.json", "footage.png", "footage.toml"}
    real, as_filed, simulated = result["sides"].values()
    for part in ("pixel", "fixed_pixel", "row"):
        (true, error), (filed, _), (found, other) = (side["noise_mk"][part] for side in (real, as_filed, simulated))
        assert abs(found - true) < 3.0 * np.hypot(error, other) + 0.02 * true
        assert part == "row" or abs(filed - true) > 2.0 * abs(found - true)
    # Noise matches the real frame in the corners as well as in the centre.
    np.testing.assert_allclose(simulated["field"]["noise_mk"], real["field"]["noise_mk"], rtol=0.15)
    assert real["frames"] == 8 and len(sensor_statistics.rows(result)[0]) == len(sensor_statistics.HEADER)
