"""Stability of the sensor: scenes of no light and of far too much, and pixels that are read seldom."""

import numpy as np

from thermorender import defaults
from thermorender.physics.planck import band_radiance, brightness_temperature
from thermorender.sensor.camera import load_camera
from thermorender.sensor.chain import sensor_of
from thermorender.sensor.detector import advanced, response_weights, steady, stepped
from thermorender.sensor.readout import radiance_from_counts
from thermorender.units import ZERO_CELSIUS_K
from thermorender.validate.stability.cases import Found, case


@case("sensor", "scene of {:g} K: the end of the range is read", (0.0, 1e4))
def beyond_the_range(kelvin):
    """All pixels are cut off at the first or last count, whose temperature is the range's, to a count."""
    camera = load_camera(defaults.CAMERA)
    image = np.full((camera.height, camera.width), band_radiance(kelvin, *camera.band_um), np.float32)
    counts = sensor_of(camera, 1).counts_at_rest(image)
    number = 0 if kelvin < 300.0 else 1
    worst = counts.max() if number == 0 else counts.min()
    seen = float(brightness_temperature(radiance_from_counts(worst, camera), *camera.band_um))
    beside = float(brightness_temperature(radiance_from_counts(worst + 1 - 2 * number, camera), *camera.band_um))
    return Found(seen, camera.range_c[number] + ZERO_CELSIUS_K, abs(beside - seen))


@case("sensor", "step of 10 K, a pixel of {:g} ms read at 9 Hz", (1.0, 10.0, 100.0, 1000.0))
def slow_frames(milliseconds):
    """10 (1 − exp(−t/τ)) after three frames, whatever the time constant; single precision."""
    tau, state = 1e-3 * milliseconds, steady(0.0, np.zeros((2, 2), np.float32))
    for number in range(1, 4):
        state = stepped(state, number / 9.0, np.full((2, 2), 10.0, np.float32), tau)
    exact = -10.0 * np.expm1(-3.0 / 9.0 / tau)
    return Found(float(state.signal.max()), float(exact), 1e-5)


@case("sensor", "power that rises by 10 K per second, a pixel of {:g} ms read at 9 Hz", (10.0, 1000.0))
def ramp(milliseconds):
    """10 (t − τ (1 − exp(−t/τ))), exact in any step."""
    tau, state = 1e-3 * milliseconds, steady(0.0, np.zeros((2, 2)))
    for number in range(1, 10):
        state = advanced(state, number / 9.0, np.full((2, 2), 10.0 * number / 9.0), tau)
    return Found(float(state.signal.max()), float(10.0 * (1.0 + tau * np.expm1(-1.0 / tau))), 1e-5)


@case("sensor", "weights of a time step of {:g} time constants", (1e-12, 1e-6, 1.0, 1e3, 1e9))
def weights(share):
    """They add up to one, so that a steady 300 K stays there."""
    return Found(300.0 * float(sum(response_weights(share, 1.0))), 300.0, 300.0 * 16.0 * np.finfo(float).eps)
