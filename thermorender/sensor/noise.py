"""Noise of the detector by the three-dimensional model: each part is random along some of time, rows and columns.

The parts are those of NVESD's model (D'Agostino and Webb 1991, doi:10.1117/12.45805). All of them are Gaussian, drawn
by a counter-based generator from the seed and the number of the frame, or of the flat-field correction, alone; so are
the smooth fields that belong to a camera.
"""

from functools import lru_cache

import numpy as np

from thermorender.physics.planck import band_radiance_derivative
from thermorender.sensor.detector import absorbed_power
from thermorender.sensor.optics import detector_irradiance

NETD_REFERENCE_K = 300.0
# Streams of random numbers, so that no part repeats another.
_FRAME, _PATTERN, _DRIFT, _BAD, SHADING, _RESPONSIVITY, _RESPONSIVITY_SHADING, SCALE, FLICKER, BLINKING = range(10)
# Waves across and along an image of which smooth fields are made: no more than so many halves together.
_WAVES = 3


@lru_cache(maxsize=64)
def noise_power(camera, difference_mk):
    """Return the absorbed power [W] of a temperature difference [mK] as the camera's NETD is stated.

    Notes
    -----
    The noise-equivalent temperature difference is stated for a lossless lens of its own f-number at 300 K:
    σ = π NETD dL/dT / (4 F₀² + 1) on the detector. Seen through another f-number it grows as (4F² + 1), not as F².
    """
    radiance = difference_mk * 1e-3 * band_radiance_derivative(NETD_REFERENCE_K, *camera.band_um)
    return float(absorbed_power(detector_irradiance(radiance, camera.netd_f_number), camera))


def temporal_noise(camera, seed, index):
    """Return the noise of one frame on the detector [W], (H, W) float32: σ_tvh, σ_tv, σ_th and σ_t.

    Depends on `seed` and the frame's `index` only. The NETD holds all four, so σ_tvh is what the others leave.
    """
    height, width = camera.height, camera.width
    common = [camera.sigma_t_mk, camera.sigma_tv_mk, camera.sigma_th_mk]
    single = np.sqrt(camera.gain_netd_mk**2 - sum(sigma**2 for sigma in common))
    frame, row, column, single = (np.float32(noise_power(camera, sigma)) for sigma in (*common, single))
    if not any(common):
        return normal(seed, index, _FRAME, (height, width), single)
    values = normal(seed, index, _FRAME, height * width + 1 + height + width, np.float32(1.0))
    noise, rest = values[: height * width].reshape(height, width), values[height * width :]
    noise *= single
    noise += frame * rest[0] + row * rest[1 : 1 + height, None]
    noise += column * rest[1 + height :]
    return noise


def fixed_pattern(camera, seed, correction=0):
    """Return what a flat-field correction leaves, (H, W) float32 [W]: σ_vh, σ_v and σ_h; new with each correction."""
    return _pattern(camera, seed, correction, _PATTERN, camera.sigma_vh_mk, camera.sigma_v_mk, camera.sigma_h_mk)


def drift_pattern(camera, seed):
    """Return how the pattern grows per kelvin of drift of the case, (H, W) float32 [W/K]; fixed by the seed."""
    if not camera.drift_mk_per_k:
        return np.zeros((camera.height, camera.width), np.float32)
    # Rows and columns have their share, as in the pattern itself.
    sigmas = np.array([camera.sigma_vh_mk, camera.sigma_v_mk, camera.sigma_h_mk])
    shares = sigmas / np.linalg.norm(sigmas) if sigmas.any() else np.array([1.0, 0.0, 0.0])
    return _pattern(camera, seed, 0, _DRIFT, *(camera.drift_mk_per_k * shares))


def bad_pixels(camera, seed):
    """Return the numbers of the pixels that are dead or hot, (n,) int64, in order."""
    count = round(camera.bad_pixels * camera.height * camera.width)
    generator = np.random.Generator(philox(seed, 0, _BAD))
    return np.sort(generator.choice(camera.height * camera.width, count, replace=False))


def residual_responsivity(camera, seed):
    """Return how far the gain that a pixel is corrected with lies off, over it, (H, W) float32; fixed by the seed."""
    pixel, smooth = (np.float32(percent * 1e-2) for percent in camera.responsivity_percent)
    shape = camera.height, camera.width
    return normal(seed, 0, _RESPONSIVITY, shape, pixel) + smooth * smooth_field(shape, seed, _RESPONSIVITY_SHADING)


def smooth_field(shape, seed, stream):
    """Return a field without detail, (H, W) float32, of mean 0 and root mean square 1; fixed by the seed.

    Nine cosines of up to three halves of a wave across and along the image together, their amplitudes normal and
    falling with the number of halves, as what glows before and beside a lens leaves on the detector.
    """
    halves = np.add.outer(np.arange(_WAVES + 1), np.arange(_WAVES + 1))
    drawn = normal(seed, 0, stream, halves.shape, np.float32(1.0)).astype(np.float64)
    amplitudes = np.where((halves > 0) & (halves <= _WAVES), drawn / np.maximum(halves, 1), 0.0)
    down, right = (half_waves(n) for n in shape)
    return (down.T @ (amplitudes / np.linalg.norm(amplitudes)) @ right).astype(np.float32)


def half_waves(count):
    """Return cosines of 0 … 3 halves of a wave over `count` pixels, (4, count), of mean square 1 and orthogonal."""
    number = np.arange(_WAVES + 1)[:, None]
    return np.cos(np.pi * number * (np.arange(count) + 0.5) / count) * np.where(number, np.sqrt(2.0), 1.0)


def _pattern(camera, seed, number, stream, pixel_mk, row_mk, column_mk):
    height, width = camera.height, camera.width
    values = normal(seed, number, stream, height * width + height + width, np.float32(1.0))
    pixel, row, column = (np.float32(noise_power(camera, sigma)) for sigma in (pixel_mk, row_mk, column_mk))
    single, rest = values[: height * width].reshape(height, width), values[height * width :]
    return pixel * single + row * rest[:height, None] + column * rest[height:]


def philox(seed, number, stream, part=0):
    """Return the generator of the random bits of a number, say of a frame, in a part of a stream."""
    return np.random.Philox(key=np.array([seed, number], np.uint64), counter=np.array([0, 0, part, stream], np.uint64))


def normal(seed, number, stream, shape, sigma, part=0):
    """Return Gaussian numbers of a stream, float32: 16 random bits each, through a table of quantiles."""
    count = int(np.prod(shape))
    bits = philox(seed, number, stream, part).random_raw(-(-count // 4)).view(np.uint16)[:count]
    return np.take(_quantiles() * sigma, bits).reshape(shape)


@lru_cache(maxsize=1)
def _quantiles():
    """Middles of 65 536 equally probable parts of the normal distribution, scaled to unit variance; to ±4.3 σ."""
    from scipy.special import ndtri

    value = ndtri((np.arange(65536) + 0.5) / 65536)
    return (value / value.std()).astype(np.float32)
