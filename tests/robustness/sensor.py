"""Stability of the sensor: scenes without light and with far too much, and pixels that are read seldom."""

from dataclasses import replace
from itertools import product

import numpy as np

from tests.robustness.cases import Found, case
from thermorender import defaults
from thermorender.physics.planck import band_radiance, brightness_temperature
from thermorender.sensor.camera import load_camera
from thermorender.sensor.chain import sensor_of
from thermorender.sensor.detector import advanced, response_weights, steady, stepped
from thermorender.sensor.readout import radiance_from_counts, saturated

_GAINS = ("high", "low")
# From a thousandth of a frame to ten thousand of them: time constants [ms] and times from frame to frame [ms].
_PACES = tuple(product((0.0, 1e-3, 1.0, 100.0, 1e4), (1.0, 30.0, 1000.0)))


@case("sensor", "scene of {0[0]:g} K in {0[1]} gain: the end of the range is read", tuple(product((0.0, 1e4), _GAINS)))
def beyond_the_range(scene):
    """All pixels are clipped at the first or last count, whose temperature is the range's limit, to a count."""
    kelvin, gain = scene
    camera = replace(load_camera(defaults.CAMERA), gain=gain)
    image = np.full((camera.height, camera.width), band_radiance(kelvin, *camera.band_um), np.float32)
    counts = sensor_of(camera, 1).counts_at_rest(image)
    number = 0 if kelvin < 300.0 else 1
    worst = counts.max() if number == 0 else counts.min()
    seen = _read_k(worst, camera)
    return Found(seen, camera.count_range_k[number], abs(_read_k(worst + 1 - 2 * number, camera) - seen))


@case("sensor", "scene of 0 to 1e6 K in {} gain: counts never fall as it warms", _GAINS)
def no_wrapping(gain):
    """The largest fall of the reading from one pixel to a warmer one, over 16 384 pixels: none."""
    kelvin, camera = _warming(gain)
    seen = _read_k(sensor_of(camera, 0).counts_at_rest(band_radiance(kelvin, *camera.band_um)), camera)
    return Found(float(np.maximum(-np.diff(seen.ravel()), 0.0).max()), 0.0, 0.0)


@case("sensor", "scene of 0 to 1e6 K in {} gain: flagged where the range ends", _GAINS)
def flagged(gain):
    """How far inside its range the camera flags a pixel, or outside does not; allowed is a count at the cold end."""
    kelvin, camera = _warming(gain)
    low, high = camera.count_range_k
    counts = sensor_of(camera, 0).counts_at_rest(band_radiance(kelvin, *camera.band_um))
    inside = np.minimum(kelvin - low, high - kelvin)
    wrong = np.where(saturated(counts, camera), inside, -inside)
    return Found(float(max(wrong.max(), 0.0)), 0.0, _read_k(1, camera) - _read_k(0, camera))


def _read_k(counts, camera):
    return brightness_temperature(radiance_from_counts(counts, camera), *camera.band_um)


def _warming(gain):
    """Temperatures of 128 × 128 pixels, each warmer than the previous [K], and a camera without blur and noise."""
    plain = load_camera("ideal")
    camera = replace(plain, width=128, height=128, gain=gain, bits=14, range_c=(-25.0, 135.0), netd_mk=1e-6)
    # Linear within the widest range, and beyond it by orders of magnitude.
    kelvin = np.concatenate([np.linspace(0.0, 900.0, 128 * 128 - 100), np.geomspace(910.0, 1e6, 100)])
    return kelvin.reshape(128, 128), camera


@case("sensor", "step of 10 K, a pixel of {0[0]:g} ms read each {0[1]:g} ms", _PACES)
def step(pace):
    """10 (1 − exp(−t/τ)) after fifty frames, for any time constant; each rounds by 2⁻²³ of it at most."""
    tau, span = (1e-3 * each for each in pace)
    state = steady(0.0, np.zeros((2, 2), np.float32))
    for number in range(1, 51):
        state = stepped(state, number * span, np.full((2, 2), 10.0, np.float32), tau)
    exact = -10.0 * np.expm1(-50.0 * span / tau) if tau else 10.0
    return Found(float(state.signal.max()), float(exact), 50.0 * 10.0 * 2.0**-23)


@case("sensor", "heat of a step from 10 to 15 K, a pixel of {0[0]:g} ms in {0[1]:g} ms", _PACES)
def heat(pace):
    """Incoming heat is sent out or stored: ∫P dt = ∫S dt + τ (S₁ − S₀), per second of the step.

    S is integrated by Gauss' rule over spans of time constants, to the last bits: some 2⁻⁵², and τ/t times that for the
    stored part.
    """
    tau, span = (1e-3 * each for each in pace)
    ends = np.unique(np.minimum(np.append(tau * np.arange(0.0, 41.0, 2.0), span), span))
    node, weight = np.polynomial.legendre.leggauss(24)
    half = 0.5 * np.diff(ends)
    at = (ends[:-1] + half + np.multiply.outer(node, half)).ravel()
    weight = np.multiply.outer(weight, half).ravel()

    def signal(time_s):
        old, first, last = response_weights(time_s, tau)
        return old * 4.0 + first * 10.0 + last * (10.0 + 5.0 * time_s / span)

    out = float((signal(at) * weight).sum() / span)
    kept = tau / span * (float(signal(np.array(span))) - 4.0)
    lost = 16.0 * np.finfo(float).eps * (1.0 + tau / span)
    return Found(out + kept, 12.5, 10.0 * lost)


@case("sensor", "power that rises by 10 K per second, a pixel of {:g} ms read at 9 Hz", (10.0, 1000.0))
def ramp(milliseconds):
    """10 (t − τ (1 − exp(−t/τ))), exact for any step."""
    tau, state = 1e-3 * milliseconds, steady(0.0, np.zeros((2, 2)))
    for number in range(1, 10):
        state = advanced(state, number / 9.0, np.full((2, 2), 10.0 * number / 9.0), tau)
    return Found(float(state.signal.max()), float(10.0 * (1.0 + tau * np.expm1(-1.0 / tau))), 1e-5)


@case("sensor", "weights of a time step of {:g} time constants", (1e-12, 1e-6, 1.0, 1e3, 1e9))
def weights(share):
    """They add up to one, so a steady 300 K stays."""
    return Found(300.0 * float(sum(response_weights(share, 1.0))), 300.0, 300.0 * 16.0 * np.finfo(float).eps)
