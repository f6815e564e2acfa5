"""Errors left by the flat-field correction: shading, gain errors, 1/f noise, a drifting scale, blinking pixels."""

from dataclasses import fields, replace

import numpy as np
import pytest

from thermorender.physics.planck import band_radiance, band_radiance_derivative
from thermorender.sensor import noise, wander
from thermorender.sensor.camera import Camera, load_camera
from thermorender.sensor.chain import Moment, Sensor, at_rest, in_sequence, sensor_of, wandering

CAMERA = load_camera("zenmuse-xt2")
BAND = CAMERA.band_um
# The required keys of a camera, without any of its effects.
PLAIN = Camera(**{item.name: getattr(CAMERA, item.name) for item in fields(Camera)[:13]})
SMALL = replace(PLAIN, width=128, height=96)


def even(camera, kelvin=300.0):
    return np.full((camera.height, camera.width), band_radiance(kelvin, *BAND), np.float32)


def per_mk(sensor):
    """Absorbed power of a millikelvin of a scene of 300 K, in the middle of the image [W]."""
    one = Sensor(replace(sensor.camera, narcissus_mk=0.0, shading_mk=0.0, shading_mk_per_k=0.0), 0)
    power = one.power(np.ones_like(even(one.camera)), at_rest(one.camera)) / one.illumination
    return float(power.mean()) * 1e-3 * band_radiance_derivative(300.0, *BAND)


def wandered(camera, seed, corrected_s, time_s):
    """Addition of `chain.wandering` to zero, in millikelvin of the NETD, (H, W)."""
    moment = Moment(0, 0, 300.0, 300.0, False, time_s, corrected_s)
    image = wandering(np.zeros((camera.height, camera.width), np.float32), sensor_of(camera, seed), moment)
    return image / noise.noise_power(camera, 1.0)


# --- smooth fields and gains ------------------------------------------------------------------------------------


@pytest.mark.parametrize("corners", [{}, {"illumination_exponent": 4.0, "vignetting": 0.1}])
def test_shading_is_smooth_of_the_stated_size_and_grows_with_the_case(corners):
    camera = replace(PLAIN, shading_mk=250.0, shading_mk_per_k=40.0, **corners)
    sensor = Sensor(camera, 3)
    start, later = at_rest(camera), Moment(0, 0, at_rest(camera).case_k + 5.0, at_rest(camera).case_k + 5.0)
    plain = Sensor(replace(PLAIN, **corners), 3).power(even(camera), start)
    seen = [(sensor.power(even(camera), moment) - plain) * sensor.flat_field_gain / per_mk(sensor)
            for moment in (start, later)]  # fmt: skip
    # Single precision: 2⁻²⁴ of the whole, 1 mK, at each of some steps, averaged over the pixels.
    assert [image.std() for image in seen] == pytest.approx([250.0, 450.0], rel=2e-3)
    assert abs(seen[0].mean()) < 2.0
    # At most three halves of a wave in both directions together: the cosine series by its definition.
    row, column = (np.arange(n) + 0.5 for n in seen[0].shape)
    rest = seen[0].astype(float)
    for i in range(4):
        for j in range(4 - i):
            wave = np.outer(np.cos(np.pi * i * row / row.size), np.cos(np.pi * j * column / column.size))
            rest = rest - (rest * wave).sum() / (wave**2).sum() * wave
    assert rest.std() < 2.0
    other = Sensor(camera, 4).power(even(camera), start) - plain
    assert abs(np.corrcoef(other.ravel(), seen[0].ravel())[0, 1]) < 0.9


def test_halves_of_a_frame_differ_as_in_real_cameras():
    # Amplitudes fall with the number of halves; the sum of squares of nine of them is one.
    difference = []
    for seed in range(200):
        field = noise.smooth_field((64, 80), seed, noise.SHADING)
        difference += [abs(np.diff([half.mean() for half in np.array_split(field, 2, axis)])[0]) for axis in (0, 1)]
    assert 0.7 < np.mean(difference) < 1.1


def test_gain_errors_scale_with_the_difference_from_the_shutter():
    camera = replace(PLAIN, responsivity_percent=(0.3, 0.5), netd_mk=1e-3, bits=16)
    sensor = Sensor(camera, 1)
    corrected = at_rest(camera).case_k
    moment = Moment(0, 0, corrected, corrected)
    plain = Sensor(replace(camera, responsivity_percent=(0.0, 0.0)), 1)
    for kelvin in (corrected, corrected + 30.0, corrected - 40.0):
        scene = even(camera, kelvin)
        seen = sensor.counts(sensor.power(scene, moment), moment).astype(float)
        seen -= plain.counts(plain.power(scene, moment), moment)
        full = float(np.diff(band_radiance(np.array(camera.count_range_k), *BAND))[0]) / (2**16 - 1)
        contrast = (band_radiance(kelvin, *BAND) - band_radiance(corrected, *BAND)) / full
        # Steps of a count add uniform noise on both sides.
        expected = np.hypot(np.hypot(0.003, 0.005) * contrast, np.sqrt(1.0 / 6.0) if contrast else 0.0)
        assert seen.std() == pytest.approx(expected, rel=0.01, abs=0.7)
        if kelvin == corrected + 30.0:
            blocks = seen.reshape(32, 16, 40, 16).mean(axis=(1, 3))
            # Means over 256 pixels keep a sixteenth of the pixels' deviations, and all of the smooth field.
            assert blocks.std() == pytest.approx(np.hypot(0.005, 0.003 / 16) * abs(contrast), rel=0.03)


# --- 1/f noise --------------------------------------------------------------------------------------------------


def test_flicker_grows_after_a_correction_by_its_octaves():
    camera = replace(SMALL, flicker_mk=10.0)
    for corrected in (0, 37):
        assert not wandered(camera, 5, float(corrected), float(corrected)).any()
        for lag in (1, 3, 20, 300):
            # The shortest octave is drawn at each tick, the one held for 2ⁿ ticks where these count 2ⁿ⁻¹ more.
            changed = 1 + sum(
                any((tick - 2 ** (n - 1)) % 2**n == 0 for tick in range(corrected + 1, corrected + lag + 1))
                for n in range(1, 10)
            )
            seen = wandered(camera, 5, float(corrected), float(corrected + lag))
            # A standard deviation of n values has a relative error of 1/√(2n).
            expected = 10.0 * np.sqrt(2.0 * changed)
            assert seen.std() == pytest.approx(expected, rel=4.0 / np.sqrt(2.0 * seen.size)), (corrected, lag)
            assert abs(seen.mean()) < 4.0 * expected / np.sqrt(seen.size)


def test_the_flicker_spectrum_falls_as_one_over_the_frequency():
    camera, ticks = replace(PLAIN, width=24, height=16, flicker_mk=1.0), 1024
    series = np.array([wandered(camera, 2, 0.0, float(tick)).ravel() for tick in range(ticks)])
    series = (series - series.mean(axis=0)) * np.hanning(ticks)[:, None]
    power = (np.abs(np.fft.rfft(series, axis=0)) ** 2).mean(axis=1) / (np.hanning(ticks) ** 2).sum()
    frequency = np.fft.rfftfreq(ticks)
    octaves = np.geomspace(1 / 128, 1 / 8, 9)
    parts = [(frequency >= a) & (frequency < b) for a, b in zip(octaves[:-1], octaves[1:], strict=True)]
    slope = np.polyfit(np.log(octaves[:-1]), np.log([power[part].mean() for part in parts]), 1)[0]
    # Octaves ripple around the straight line by a few percent.
    assert slope == pytest.approx(-1.0, abs=0.06)
    # Holds of 2ⁿ ticks have triangular covariances; 384 pixels give the power of a frequency to 1/√384.
    lag = np.arange(1, 512)
    held = [np.maximum(1.0 - lag / 2**n, 0.0) for n in range(10)]
    expected = 10.0 + 2.0 * np.cos(2.0 * np.pi * np.outer(frequency, lag)) @ sum(held)
    chosen = (frequency > 1 / 128) & (frequency < 0.45)
    ratio = power[chosen] / expected[chosen]
    assert ratio.mean() == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / 384 / chosen.sum()) + 0.005)
    # All octaves are 1 over ln 2 in a factor e of frequency, of which a two-sided spectrum has half.
    assert (power * frequency)[parts[2]].mean() == pytest.approx(0.5 / np.log(2.0), rel=0.06)


def test_covariance_of_instants_between_ticks():
    # The same noise from another construction: octaves with holds that start anywhere, linear between whole ticks.
    rng, draws, span = np.random.default_rng(0), 4000, 80
    ticks = np.arange(span + 2)
    total = np.zeros((draws, span + 2))
    for octave in range(wander.OCTAVES):
        begin = rng.integers(0, 2**octave, (draws, 1))
        values = rng.standard_normal((draws, span + 2))
        total += np.take_along_axis(values, (ticks + begin) // 2**octave, axis=1)
    first = rng.random((draws, 1))
    for lag in (0.0, 0.3, 1.0, 1.7, 6.4, 50.0):
        at = np.concatenate([first, first + lag], axis=1)
        left = np.floor(at).astype(int)
        before, after = (np.take_along_axis(total, number, 1) for number in (left, left + 1))
        seen = before + (at - left) * (after - before)
        expected = wander.covariance(lag)
        variance = float(wander.covariance(0.0))
        error = np.sqrt((variance**2 + expected**2) / draws)
        assert abs((seen[:, 0] * seen[:, 1]).mean() - expected) < 3.5 * error, lag
    # Neighbouring ticks share all but 2⁻ᵒ of each octave, and have a weight of a third together.
    least = 10.0 - sum(0.5**octave for octave in range(10)) / 3.0
    assert wander.covariance(np.array([0.0, 5000.0])) == pytest.approx([least, 0.0])


@pytest.mark.slow
def test_the_scale_drifts_by_its_octaves_and_linearly_between_ticks():
    camera = replace(PLAIN, width=2, height=2, scale_drift_mk=7.0)
    seeds = 1500
    seen = np.array([[wandered(camera, seed, 0.0, time_s) for time_s in (8.0, 8.25, 9.0)] for seed in range(seeds)])
    assert (np.ptp(seen, axis=(2, 3)) == 0.0).all()
    now, between, then = seen[:, :, 0, 0].T
    np.testing.assert_allclose(between, 0.75 * now + 0.25 * then, atol=1e-3)
    # By the eighth tick the octaves of 1, 2, 4, 8 and 16 s are new.
    assert now.std() == pytest.approx(7.0 * np.sqrt(10.0), rel=4.0 / np.sqrt(2.0 * seeds))


def test_values_at_an_instant_do_not_depend_on_earlier_calls():
    camera = replace(SMALL, flicker_mk=10.0, scale_drift_mk=5.0, blinking_pixels=0.02, blinking_mk=300.0)
    moments = [in_sequence(replace(camera, ffc_interval_s=40.0), index, index / 9.0) for index in range(0, 900, 90)]
    assert moments[-1].corrected_s == 80.0 and moments[-1].time_s == 90.0
    follow, sensor = [], Sensor(camera, 2)
    for moment in moments:
        follow.append(sensor.counts(sensor.power(even(camera), moment), moment).tobytes())
    for number in (9, 4, 7):
        sensor = Sensor(camera, 2)
        alone = sensor.counts(sensor.power(even(camera), moments[number]), moments[number])
        assert alone.tobytes() == follow[number]
    assert len(set(follow)) == len(follow)


# --- pixels that blink ------------------------------------------------------------------------------------------


def test_blinking_pixels_jump_between_two_levels():
    camera = replace(SMALL, bad_pixels=0.03, blinking_pixels=0.03, blinking_mk=400.0, blinking_s=6.0)
    of = wander.Wander(camera, 1)
    blinking, bad = of.blinking_pixels, noise.bad_pixels(camera, 1)
    assert len(blinking) == round(0.03 * 96 * 128) and not set(blinking.tolist()) & set(bad.tolist())
    step, lag = 0.1, np.array([3, 30, 60, 120])
    times = np.arange(0.0, 200.0, step)
    moved = np.array([of.blinking(0.0, time_s) for time_s in times])
    levels = np.rint(moved / noise.noise_power(camera, 400.0)).astype(int)
    np.testing.assert_allclose(moved, levels * noise.noise_power(camera, 400.0), rtol=1e-6)
    # Relative to the level at the correction there is one other level: up or down.
    assert (levels[0] == 0).all() and set(np.unique(levels)) == {-1, 0, 1}
    assert not ((levels.max(axis=0) == 1) & (levels.min(axis=0) == -1)).any()
    up = np.where((levels == -1).any(axis=0), levels + 1, levels)
    # Mean time at a level, from the jumps; N of them of a Poisson process give it to 1/√N. Of the jumps back within a
    # step half are missed: step/s of all.
    jumps = (up[1:] != up[:-1]).sum()
    pixels = up.shape[1]
    assert jumps == pytest.approx(pixels * 200.0 / 6.0, rel=3.0 / np.sqrt(pixels * 200.0 / 6.0) + step / 6.0)
    spin = 2.0 * up - 1.0
    for shift in lag:
        expected = np.exp(-2.0 * shift * step / 6.0)
        seen = (spin[shift:] * spin[:-shift]).mean(axis=0)
        assert abs(seen.mean() - expected) < 3.5 * seen.std() / np.sqrt(pixels), shift
    assert abs(spin.mean()) < 3.5 * spin.mean(axis=0).std() / np.sqrt(pixels)


def test_effects_that_a_camera_lacks_are_not_computed():
    sensor, moment = Sensor(SMALL, 1), in_sequence(SMALL, 9, 1.0)
    sensor.counts(sensor.power(even(SMALL), moment), moment)
    assert not {"wander", "stray_growth"} & set(vars(sensor))
    assert sensor.residual_responsivity is None and sensor.stray is None
    drifting = Sensor(replace(SMALL, scale_drift_mk=1.0), 1)
    drifting.counts(drifting.power(even(SMALL), moment), moment)
    assert "wander" in vars(drifting)
