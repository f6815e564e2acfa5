"""Radiance to counts, stage by stage: optics, noise, flat field, read-out, and their order."""

from dataclasses import fields, replace

import numpy as np
import pytest

from thermorender.frame import apparent_temperature
from thermorender.physics.planck import band_radiance, band_radiance_derivative, brightness_temperature
from thermorender.sensor import chain, noise, optics, psf, readout
from thermorender.sensor.camera import Camera, load_camera
from thermorender.sensor.chain import Moment, Sensor, at_rest, in_sequence

CAMERA = load_camera("zenmuse-xt2")
BAND = CAMERA.band_um
K300 = float(band_radiance(300.0, *BAND))
# The first and the required keys of a camera, without any of its effects.
PLAIN = Camera(**{item.name: getattr(CAMERA, item.name) for item in fields(Camera)[:13]})
SMALL = replace(PLAIN, width=128, height=96)
# Everything except noise of frames, rows, columns or pixels, and not uniform over the image.
EVEN = {"narcissus_mk": 0.0, "shading_mk": 0.0, "shading_mk_per_k": 0.0, "responsivity_percent": (0.0, 0.0)}


def even(camera, kelvin=300.0):
    return np.full((camera.height, camera.width), band_radiance(kelvin, *camera.band_um), np.float32)


def read_mk(camera, frames, seed=0, kelvin=300.0):
    """Apparent temperature from the counts of frames of a blackbody, minus the blackbody's, (frames, H, W) [mK]."""
    sensor, scene = Sensor(camera, seed), even(camera, kelvin)
    counts = [sensor.counts_at_rest(scene, index) for index in range(frames)]
    table = brightness_temperature(readout.radiance_from_counts(np.arange(2.0**camera.bits), camera), *camera.band_um)
    return ((table - kelvin) * 1e3)[np.array(counts)]


def step_mk(camera, kelvin=300.0):
    """Temperature step of one count at a temperature [mK]."""
    step = np.diff(readout.radiance_from_counts([0, 1], camera))[0]
    return 1e3 * step / band_radiance_derivative(kelvin, *camera.band_um)


# --- optics -----------------------------------------------------------------------------------------------------


def test_published_irradiance_of_the_netd():
    # 50 mK at f/1.0 and 300 K: 0.139 W m⁻² of scene exitance, 0.0277 W m⁻² at the detector.
    difference = 0.050 * band_radiance_derivative(300.0, 7.5, 13.5)
    assert np.pi * difference == pytest.approx(0.139, abs=5e-4)
    assert optics.detector_irradiance(difference, 1.0) == pytest.approx(0.0277, abs=5e-5)
    area = 0.8 * 17e-6**2
    assert noise.noise_power(CAMERA, 50.0) == pytest.approx(0.0277 * area, rel=2e-3)


def test_irradiance_of_a_lens_is_the_integral_over_its_cone():
    # ∫ L cosθ dω over the cone whose half-angle is arctan(1/2F).
    rim = np.arctan(1.0 / (2.0 * 1.25))
    angle = np.linspace(0.0, rim, 20001)
    integral = np.trapezoid(np.cos(angle) * 2.0 * np.pi * np.sin(angle), angle)
    assert optics.detector_irradiance(1.0, 1.25) == pytest.approx(integral, rel=1e-8)


def test_light_falls_with_the_fourth_power_of_the_cosine_and_by_the_rims():
    share = optics.relative_illumination(replace(PLAIN, illumination_exponent=4.0))
    angle = np.arctan(np.hypot(255.5, 319.5) / CAMERA.focal_length_px)
    assert share[0, 0] == pytest.approx(np.cos(angle) ** 4, rel=1e-6)
    assert share[255:257, 319:321] == pytest.approx(np.ones((2, 2)), abs=1e-5)
    rims = optics.relative_illumination(replace(PLAIN, vignetting=0.2))
    assert rims[-1, -1] == pytest.approx(0.8, rel=1e-6) and rims[255, 319] == pytest.approx(1.0, abs=1e-5)
    assert (optics.relative_illumination(PLAIN) == 1.0).all()
    assert optics.relative_illumination(replace(PLAIN, width=1, height=1, vignetting=0.2)) == 1.0


def test_lens_and_housing_at_the_temperature_of_the_scene_make_an_enclosure():
    # In a closed black room a pixel receives π B(T), whatever the lens transmits.
    camera = replace(CAMERA, width=64, height=48)
    share = optics.relative_illumination(camera)
    scene = optics.detector_irradiance(K300, camera.f_number, camera.lens_transmittance) * share
    case = optics.case_share(camera, share) * np.pi * K300
    np.testing.assert_allclose(scene + case, np.pi * K300, rtol=1e-6)


# --- blur -------------------------------------------------------------------------------------------------------


def test_mtf_of_a_perfect_lens_at_published_frequencies():
    # Goodman, Introduction to Fourier Optics: (2/π)(arccos s − s√(1−s²)) of the cut-off 1/(λF).
    cut_off = 1.0 / (10.0 * 1.25)
    found = psf.lens_otf(np.array([0.0, 0.25, 0.5, 0.75, 1.0, 1.3]) * cut_off, 10.0, 1.25)
    np.testing.assert_allclose(found, [1.0, 0.6850, 0.3910, 0.1443, 0.0, 0.0], atol=5e-5)


@pytest.mark.parametrize("defocus_um", [0.0, 20.0, 60.0])
def test_transfer_function_is_the_autocorrelation_of_the_pupil(defocus_um):
    count, wavelength_um, f_number = 1024, 10.0, 1.25
    x = (np.arange(count) - count // 2 + 0.5) / (count / 4)
    r2 = x[:, None] ** 2 + x**2
    path = defocus_um / (8.0 * f_number**2) * r2
    pupil = np.where(r2 <= 1.0, np.exp(2j * np.pi / wavelength_um * path), 0.0)
    spread = np.abs(np.fft.fft2(pupil)) ** 2
    transfer = np.fft.ifft2(spread)[0].real
    shift = np.arange(0, count // 2, 16)
    frequency = shift / (count / 2) / (wavelength_um * f_number)
    expected = transfer[shift] / transfer[0]
    # The drawn pupil has a jagged rim: one part in 512, its diameter in pixels.
    np.testing.assert_allclose(psf.lens_otf(frequency, wavelength_um, f_number, defocus_um), expected, atol=2e-3)


def test_strong_defocus_is_the_disc_of_geometrical_optics():
    from scipy.special import j1

    frequency, defocus_um, f_number = np.linspace(1e-4, 2e-3, 20), 800.0, 1.25
    argument = np.pi * frequency * defocus_um / f_number
    expected = 2.0 * j1(argument) / argument
    # Geometry ignores diffraction, which near zero takes 4/π of the share of the cut-off 1/(λF): 2.5 % at most here.
    limit = 4.0 / np.pi * frequency[-1] * 10.0 * f_number
    np.testing.assert_allclose(psf.lens_otf(frequency, 10.0, f_number, defocus_um), expected, atol=limit)
    assert limit < 0.033


@pytest.mark.parametrize("direction", ["across", "diagonal"])
def test_blurred_waves_shrink_by_the_transfer_function_and_not_by_the_pixel(direction):
    camera = replace(PLAIN, diffraction=True)
    row, column = np.mgrid[:256, :256]
    for cycles in (4, 12, 32, 64, 96):
        frequency = cycles / 256
        phase = column if direction == "across" else (row + column) / 2
        wave = np.cos(2.0 * np.pi * 2.0 * cycles / 512 * (phase if direction == "across" else 2.0 * phase))
        radius = frequency if direction == "across" else np.sqrt(2.0) * frequency
        if radius > 0.45:
            continue
        seen = psf.blurred(wave.astype(np.float32), psf.blur_of(camera))[48:-48, 48:-48]
        inner = wave[48:-48, 48:-48]
        amplitude = (seen * inner).sum() / (inner**2).sum()
        # Goodman's formula at the middle of the band, within 1 % of the band's mean; the kernel's fit: 2 %.
        s = radius * 10.3 * camera.f_number / camera.pixel_pitch_um
        expected = 2.0 / np.pi * (np.arccos(s) - s * np.sqrt(1.0 - s**2))
        assert amplitude == pytest.approx(expected, abs=0.03), cycles
        # With the pixel's sinc applied twice it would be lower from a quarter of a cycle on.
        if radius >= 0.25:
            assert amplitude > expected * np.sinc(frequency) + 0.03


def test_blur_of_a_scene_agrees_with_its_fourier_transform():
    from scipy.fft import dctn, idctn

    rng = np.random.default_rng(0)
    row, column = np.arange(256) / 512, np.arange(320) / 640
    radius = np.hypot(row[:, None], column)
    pixel = np.outer(np.sinc(row), np.sinc(column))
    scene = idctn(dctn(rng.standard_normal((256, 320))) / np.maximum(radius, 1 / 640) * pixel)
    scene = (scene / scene.std()).astype(np.float32)
    transfer = psf.otf(CAMERA, radius.ravel()).reshape(radius.shape)
    expected = idctn(dctn(scene.astype(float)) * transfer)
    # For a scene of unit contrast the finite kernels leave 0.0037 and 0.019 at most, over three scenes.
    for fine, coarse, allowed in ((7, 5, 0.005), (5, 0, 0.025)):
        blur = psf.blur_of(CAMERA, fine, coarse)
        assert blur.fine.sum() + blur.coarse.sum() == pytest.approx(1.0, abs=1e-6)
        assert np.std(psf.blurred(scene, blur) - expected) < allowed
    assert np.std(psf.blurred(scene, psf.blur_of(CAMERA, 5, 0)) - expected) > 0.01


@pytest.mark.parametrize("shape", [(12, 16), (97, 131)])
def test_an_even_scene_stays_even_in_any_format(shape):
    blurred = psf.blurred(np.full(shape, 50.0, np.float32), psf.blur_of(CAMERA))
    np.testing.assert_allclose(blurred, 50.0, rtol=1e-6)


# --- noise ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("f_number", "expected_mk"), [(1.0, 50.0), (1.25, 72.5)])
def test_netd_over_a_thousand_frames(f_number, expected_mk):
    # All temporal parts together, in the middle of the image; many pixels share the noise of rows and columns,
    # so 1000 frames measure σ_t alone to 2 % of a part that is 0.4 % of the whole.
    camera = replace(CAMERA, width=96, height=64, f_number=f_number, lens_transmittance=1.0, drift_mk_per_k=0.0)
    seen = read_mk(camera, 1000)
    light = optics.relative_illumination(camera)
    per_pixel = seen.std(axis=0, ddof=1) * light
    assert np.sqrt((per_pixel**2).mean()) == pytest.approx(expected_mk, rel=0.02)


@pytest.mark.parametrize("kelvin", [260.0, 350.0])
def test_netd_follows_the_slope_of_planck_with_scene_temperature(kelvin):
    camera, frames = replace(SMALL, lens_transmittance=1.0), 60
    seen = np.sqrt(read_mk(camera, frames, kelvin=kelvin).var(axis=0, ddof=1).mean())
    slope = band_radiance_derivative(300.0, *BAND) / band_radiance_derivative(kelvin, *BAND)
    # Counts add uniform noise; a variance of n values has a relative error of √(2/n).
    error = 1.0 / np.sqrt(2.0 * (frames - 1) * camera.width * camera.height)
    assert seen == pytest.approx(np.hypot(72.5 * slope, step_mk(camera, kelvin) / np.sqrt(12.0)), rel=3.0 * error)


def components(cube):
    """NVESD's seven parts of a noise cube (t, v, h), by averaging along directions; standard deviations."""
    t, v, h = cube.shape
    mean = {"": cube.mean()}
    for axes, name in (((1, 2), "t"), ((0, 2), "v"), ((0, 1), "h"), ((2,), "tv"), ((1,), "th"), ((0,), "vh")):
        mean[name] = cube.mean(axis=axes)
    total = {name: values.var() for name, values in mean.items() if name} | {"tvh": cube.var()}
    size = {"t": t, "v": v, "h": h}
    names = ["t", "v", "h", "tv", "th", "vh", "tvh"]
    # The variance of a mean contains every part: those along the remaining axes fully, the others divided by the count.
    matrix = np.zeros((7, 7))
    for i, kept in enumerate(names):
        for j, part in enumerate(names):
            if set(part) & set(kept):
                lost = np.prod([size[axis] for axis in part if axis not in kept])
                matrix[i, j] = 1.0 / lost
    variance = np.linalg.solve(matrix, [total[name] for name in names])
    return dict(zip(names, np.sqrt(np.maximum(variance, 0.0)), strict=True))


def test_the_seven_parts_are_recovered_by_directional_averages():
    stated = {"t": 12.0, "tv": 16.0, "th": 14.0, "v": 15.0, "h": 22.0, "vh": 30.0}
    camera = replace(SMALL, lens_transmittance=1.0, f_number=1.0, **{f"sigma_{k}_mk": v for k, v in stated.items()})
    # There are few single rows, columns and frames: several seeds, and tolerances of three standard errors.
    seeds, frames = 8, 60
    found = [components(read_mk(camera, frames, seed)) for seed in range(seeds)]
    degrees = {"t": frames, "v": 96, "h": 128, "tv": frames * 96, "th": frames * 128, "vh": 96 * 128}
    for name, sigma in stated.items():
        seen = np.sqrt(np.mean([part[name] ** 2 for part in found]))
        assert seen == pytest.approx(sigma, rel=3.0 / np.sqrt(2 * seeds * degrees[name]) + 0.01), name
    left = np.sqrt(50.0**2 - sum(stated[name] ** 2 for name in ("t", "tv", "th")))
    assert np.mean([part["tvh"] for part in found]) == pytest.approx(left, rel=0.01)


def test_noise_is_normal_white_and_of_unit_size():
    from scipy.stats import kstest

    values = np.concatenate([noise.temporal_noise(PLAIN, 3, index).ravel() for index in range(6)])
    values /= noise.noise_power(PLAIN, PLAIN.netd_mk)
    assert values.std() == pytest.approx(1.0, rel=3.0 / np.sqrt(2 * values.size))
    assert abs(values.mean()) < 4.0 / np.sqrt(values.size)
    assert kstest(values[::7], "norm").pvalue > 1e-3
    image = values[: 512 * 640].reshape(512, 640)
    following = values[image.size : 2 * image.size].reshape(image.shape)
    for shifted in (image[1:] * image[:-1], image[:, 1:] * image[:, :-1], image * following):
        assert abs(shifted.mean()) < 4.0 / np.sqrt(shifted.size)


def test_noise_depends_on_seed_and_index_only():
    sensor = Sensor(CAMERA, 7)
    first = sensor.counts_at_rest(even(CAMERA), 3)
    sensor.counts_at_rest(even(CAMERA), 9)
    assert (first == sensor.counts_at_rest(even(CAMERA), 3)).all()
    assert (first == Sensor(CAMERA, 7).counts_at_rest(even(CAMERA), 3)).all()
    assert (first != sensor.counts_at_rest(even(CAMERA), 4)).mean() > 0.5
    assert (first != Sensor(CAMERA, 8).counts_at_rest(even(CAMERA), 3)).mean() > 0.5


def test_the_same_bytes_on_any_number_of_threads():
    import cv2

    scene = even(CAMERA) * np.linspace(0.9, 1.1, 640, dtype=np.float32)
    before = cv2.getNumThreads()
    found = []
    for threads in (1, 2, 5):
        cv2.setNumThreads(threads)
        found.append(Sensor(CAMERA, 1).counts_at_rest(scene, 0).tobytes())
    cv2.setNumThreads(before)
    assert len(set(found)) == 1


# --- flat field, drift, bad pixels ------------------------------------------------------------------------------


def test_an_even_scene_is_even_after_the_flat_field_but_noisier_in_the_corners():
    camera = replace(PLAIN, illumination_exponent=4.0, vignetting=0.1, lens_transmittance=1.0)
    seen = read_mk(camera, 40)
    share = optics.relative_illumination(camera)
    for rows, columns in ((slice(0, 40), slice(0, 40)), (slice(236, 276), slice(300, 340))):
        part = seen[:, rows, columns]
        assert part.std() == pytest.approx(72.5 / share[rows, columns].mean(), rel=0.02)
        assert abs(part.mean()) < 4.0 * part.std() / np.sqrt(part.size) + 0.5


def test_the_pattern_grows_with_the_drift_and_is_new_after_a_correction():
    camera = replace(SMALL, netd_mk=1e-3, sigma_vh_mk=20.0, drift_mk_per_k=30.0, lens_transmittance=1.0, f_number=1.0)
    sensor = Sensor(camera, 1)
    read = lambda moment: sensor.counts(sensor.power(even(camera), moment), moment)  # noqa: E731
    fresh, drifted = read(Moment(0, 1, 300.0, 300.0)), read(Moment(0, 1, 302.0, 300.0))
    again = read(Moment(0, 2, 302.0, 302.0))
    # Steps of a count add uniform noise; the spread of n pixels has an error of 1/√(2n), and a correlation of 1/√n.
    step, pixels = step_mk(camera), camera.width * camera.height
    for counts, wanted in ((fresh, 20.0), (drifted, np.hypot(20.0, 60.0)), (again, 20.0)):
        expected = np.hypot(wanted, step / np.sqrt(12.0))
        assert counts.std() * step == pytest.approx(expected, rel=3.0 / np.sqrt(2.0 * pixels))
    assert abs(np.corrcoef(fresh.ravel(), again.ravel())[0, 1]) < 3.0 / np.sqrt(pixels)


def test_radiation_of_the_case_shows_only_by_its_uncompensated_drift():
    camera = replace(SMALL, netd_mk=1e-3, housing_residual=0.01, lens_transmittance=0.9)
    sensor = Sensor(camera, 0)
    moment = Moment(0, 0, 301.0, 300.0)
    more = sensor.power(even(camera), moment) - sensor.power(even(camera), at_rest(camera))
    sent = np.pi * (band_radiance(301.0, *BAND) - K300) * (1.0 - 0.9 / (4 * 1.25**2 + 1))
    np.testing.assert_allclose(more, 0.01 * sent * camera.absorptance * 17e-6**2, rtol=2e-3)


def test_narcissus_is_a_ring_of_the_stated_size():
    camera = replace(CAMERA, **EVEN | {"narcissus_mk": 300.0, "narcissus_radius_px": 120.0})
    plain = Sensor(replace(CAMERA, **EVEN), 0).power(even(CAMERA), at_rest(CAMERA))
    ring = Sensor(camera, 0).power(even(camera), at_rest(camera)) - plain
    kelvin = ring / (plain / K300) / band_radiance_derivative(300.0, *BAND)
    # Powers are single precision, and 0.3 K is some 0.5 % of them: 2⁻²⁴ / 0.005, and half a pixel off the ring's crest.
    assert kelvin[256, 320 + 120] * Sensor(CAMERA, 0).illumination[256, 440] == pytest.approx(0.3, rel=1e-3)
    assert kelvin[256, 320] < 1e-3


def test_bad_pixels_take_the_mean_of_good_neighbours():
    camera = replace(SMALL, bad_pixels=0.03)
    sensor = Sensor(camera, 2)
    bad = noise.bad_pixels(camera, 2)
    assert len(bad) == round(0.03 * 128 * 96) and len(set(bad.tolist())) == len(bad)
    image = np.random.default_rng(0).normal(size=(96, 128)).astype(np.float32)
    repaired = chain.bad_pixels(image.copy(), sensor, None)
    untouched = np.ones(image.size, bool)
    untouched[bad] = False
    assert (repaired.ravel()[untouched] == image.ravel()[untouched]).all()
    for number in bad[:40]:
        i, j = divmod(int(number), 128)
        near = [
            (a, b)
            for a in range(max(i - 1, 0), min(i + 2, 96))
            for b in range(max(j - 1, 0), min(j + 2, 128))
            if a * 128 + b not in bad
        ]
        assert repaired[i, j] == pytest.approx(np.mean([image[pixel] for pixel in near]), abs=1e-6)


def test_corrections_follow_at_their_interval_and_freeze_the_image():
    camera = replace(PLAIN, ffc_interval_s=2.0, ffc_duration_s=0.5, case_rise_k=10.0, case_time_constant_s=5.0)
    moments = [in_sequence(camera, index, index / 10.0) for index in range(50)]
    assert [m.index for m in moments if m.frozen] == [20, 21, 22, 23, 24, 40, 41, 42, 43, 44]
    assert [m.correction for m in moments] == [0] * 20 + [1] * 20 + [2] * 10
    # The case warms to 1 − 1/e of its rise in a time constant, and the drift starts again with each correction.
    assert in_sequence(camera, 0, 5.0).case_k - 298.15 == pytest.approx(10.0 * (1 - np.exp(-1)))
    assert moments[20].drift_k == pytest.approx(0.0, abs=1e-12) and moments[39].drift_k > 1.0
    assert not any(in_sequence(PLAIN, index, index / 9.0).frozen for index in range(10000))


# --- read-out ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("gain", ["high", "low"])
def test_noise_free_chain_inverts_within_half_a_count(gain):
    # All effects on the signal are on, except blur and noise.
    effects = EVEN | {"diffraction": False, "blur_sigma_px": 0.0, "netd_mk": 1e-6, "low_gain_netd_mk": 1e-6}
    effects |= {"bad_pixels": 0.0} | dict.fromkeys((f"sigma_{k}_mk" for k in ("t", "tv", "th", "v", "h", "vh")), 0.0)
    camera = replace(CAMERA, gain=gain, **effects)
    kelvin = np.linspace(250.0, 400.0, 512 * 640).reshape(512, 640)
    radiance = band_radiance(kelvin, *BAND)
    back = readout.radiance_from_counts(Sensor(camera, 0).counts_at_rest(radiance, 0), camera)
    step = np.diff(readout.radiance_from_counts([0, 1], camera))[0]
    # Single precision adds 2⁻²⁴ of full scale for each of some ten steps: a hundredth of a count at 14 bits.
    assert np.abs(back - radiance).max() <= 0.51 * step


@pytest.mark.parametrize(("tlinear_mk", "gain"), [(40.0, "high"), (400.0, "high"), (400.0, "low")])
def test_temperature_linear_counts_are_steps_of_kelvin(tlinear_mk, gain):
    camera = replace(SMALL, tlinear_mk=tlinear_mk, gain=gain, netd_mk=1e-6)
    kelvin = np.linspace(255.0, 400.0, 128 * 96).reshape(96, 128)
    counts = Sensor(camera, 0).counts_at_rest(band_radiance(kelvin, *BAND))
    raw_k = np.diff(readout.radiance_from_counts([0, 1], replace(camera, tlinear_mk=0.0)))[0]
    raw_k = raw_k / band_radiance_derivative(255.0, *BAND)
    assert np.abs(counts * tlinear_mk * 1e-3 - kelvin).max() <= 0.5 * tlinear_mk * 1e-3 + 0.51 * raw_k
    found = brightness_temperature(readout.radiance_from_counts(counts, camera), *BAND)
    np.testing.assert_allclose(found, counts * tlinear_mk * 1e-3, rtol=1e-9)


@pytest.mark.parametrize("tlinear_mk", [0.0, 40.0])
@pytest.mark.parametrize(("gain", "ends"), [("high", (-25.0, 135.0)), ("low", (-40.0, 550.0))])
def test_only_both_ends_of_a_range_are_flagged(tlinear_mk, gain, ends):
    camera = replace(SMALL, netd_mk=1e-6, gain=gain, tlinear_mk=tlinear_mk)
    cold, warm = np.array(ends) + 273.15
    inside = 1.5 if gain == "high" else 4.0
    for kelvin, expected in ((cold - 1, True), (cold + inside, False), (300.0, False), (warm + 1, True)):
        counts = Sensor(camera, 0).counts_at_rest(even(camera, kelvin))
        assert (readout.saturated(counts, camera) == expected).all(), kelvin
    within = Sensor(camera, 0).counts_at_rest(even(camera, min(warm - 1, 640.0)))
    assert not readout.saturated(within, camera).any()


def test_low_gain_is_noisier():
    quiet, loud = (replace(CAMERA, width=64, height=64, gain=gain, **EVEN) for gain in ("high", "low"))
    # Temporal noise follows lens and mode; the pattern is the same in both; steps of a count add uniform noise.
    lens = (4.0 * CAMERA.f_number**2 + 1.0) / 5.0 / CAMERA.lens_transmittance
    pattern = lens * np.linalg.norm([CAMERA.sigma_v_mk, CAMERA.sigma_h_mk, CAMERA.sigma_vh_mk])
    expected = [
        np.linalg.norm([lens * netd, pattern, step_mk(camera) / np.sqrt(12.0)])
        for camera, netd in ((quiet, 50.0), (loud, 200.0))
    ]
    seen = [read_mk(camera, 10).std() for camera in (quiet, loud)]
    # 4096 pixels give the pattern to 1.1 %, 64 rows and columns their third of it to 9 %, and ten frames the rest well;
    # light falls by 1 % towards the corners of so small a picture.
    assert seen == pytest.approx(expected, rel=0.02)


# --- whole chain ------------------------------------------------------------------------------------------------


def test_the_order_of_the_stages():
    assert [stage.__name__ for stage in chain.OPTICS] == [
        "point_spread", "irradiance", "case_emission", "stray_light", "absorption",
    ]  # fmt: skip
    assert [stage.__name__ for stage in chain.READOUT] == [
        "temporal_noise", "wandering", "flat_field", "fixed_pattern", "bad_pixels", "analogue_to_digital",
        "temperature_linear",
    ]  # fmt: skip
    # A single hot pixel shows the order: it is blurred before it is clipped at the end of the range.
    scene = even(CAMERA)
    scene[200, 300] = band_radiance(900.0, *BAND)
    counts = Sensor(replace(CAMERA, bad_pixels=0.0), 0).counts_at_rest(scene).astype(int)
    assert counts[200, 300] == 2**14 - 1 and counts[200, 301] > counts[200, 310] + 500


def test_the_ideal_camera_returns_the_scene_temperature():
    camera = load_camera("ideal")
    rng = np.random.default_rng(1)
    radiance = band_radiance(rng.uniform(280.0, 320.0, (512, 640)), *camera.band_um).astype(np.float32)
    back = readout.radiance_from_counts(Sensor(camera, 0).counts_at_rest(radiance), camera)
    kelvin = apparent_temperature(back, camera.band_um) - apparent_temperature(radiance, camera.band_um)
    # Half a count of 16 bits over −60 … 150 °C is 2 mK at 280 K.
    assert np.abs(kelvin).max() < 3e-3


def test_every_camera_reads_a_blackbody_correctly():
    for name in ("zenmuse-xt2", "zenmuse-xt2-9mm", "zenmuse-xt2-19mm", "tau2-640", "boson-640"):
        camera = load_camera(name)
        seen = read_mk(camera, 1)[0]
        # Noise in the middle, by the lens; towards the corners it grows as light falls.
        lens = (4.0 * camera.f_number**2 + 1.0) / (4.0 * camera.netd_f_number**2 + 1.0) / camera.lens_transmittance
        light = optics.relative_illumination(camera)
        fixed = [camera.sigma_v_mk, camera.sigma_h_mk, camera.sigma_vh_mk]
        noise_mk = lens * np.hypot(camera.netd_mk * np.sqrt((1.0 / light**2).mean()), np.linalg.norm(fixed))
        # A frame has one draw of the noise common to all pixels, 512 of rows, 640 of columns: three times their means.
        rows, columns = np.hypot(camera.sigma_v_mk, camera.sigma_tv_mk), np.hypot(camera.sigma_h_mk, camera.sigma_th_mk)
        shared = np.linalg.norm([camera.sigma_t_mk, rows / np.sqrt(512), columns / np.sqrt(640)])
        # The lens's own radiation is smooth, and gain errors act on the 1.85 K to the shutter's 25 °C.
        row, column = np.mgrid[:512, :640] + 0.5
        off = np.hypot(column - 320.0, row - 256.0) / camera.narcissus_radius_px - 1.0
        ring = camera.narcissus_mk * np.exp(-0.5 * (off / 0.25) ** 2) / light
        gains = 1850.0 * 0.01 * np.linalg.norm(camera.responsivity_percent)
        assert abs(seen.mean() - ring.mean()) < 3.0 * lens * shared / light.min(), name
        assert seen.std() > 1.5 * noise_mk
        whole = np.linalg.norm([camera.shading_mk, ring.std(), gains, noise_mk])
        # Ring and shading may correlate up to a tenth of their product.
        alike = 0.1 * camera.shading_mk * ring.std() / whole**2
        assert seen.std() == pytest.approx(whole, rel=0.01 + alike), name
        # Differences of neighbours contain only the noise, which is white except for the tenths of rows and columns.
        fine = np.diff(np.diff(seen, axis=0), axis=1)
        single = lens * np.hypot(
            np.sqrt((camera.netd_mk**2 - camera.sigma_tv_mk**2 - camera.sigma_th_mk**2 - camera.sigma_t_mk**2)
                    * (1.0 / light**2).mean()), camera.sigma_vh_mk,
        )  # fmt: skip
        assert 0.5 * fine.std() == pytest.approx(single, rel=0.02), name
