"""Noise of the detector by NVESD's three-dimensional model (D'Agostino and Webb 1991, doi:10.1117/12.45805).

Each part is Gaussian and random along some of time, rows and columns. A counter-based generator makes it, and the
smooth fields of a camera, a function of the seed and the number of the frame or flat-field correction only.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from thermorender.physics.planck import band_radiance_derivative
from thermorender.sensor import photons
from thermorender.sensor.camera import NETD_REFERENCE_K as NETD_REFERENCE_K
from thermorender.sensor.camera import Camera, Image
from thermorender.sensor.detector import absorbed_power
from thermorender.sensor.optics import detector_irradiance

# Streams of random numbers, so that no part repeats another.
_FRAME, _PATTERN, _DRIFT, _BAD, SHADING, _RESPONSIVITY, _RESPONSIVITY_SHADING, SCALE, FLICKER, BLINKING = range(10)
# Largest total number of half waves across and along an image in a smooth field.
_WAVES = 3


@lru_cache(maxsize=64)
def noise_power(camera: Camera, difference_mk: float) -> float:
    """Return the absorbed power [W] of a temperature difference [mK] under the conditions of the camera's NETD.

    The NETD is stated for a lossless lens of its own f-number at 300 K: σ = π NETD dL/dT / (4 F₀² + 1) on the detector.
    Seen through another f-number it grows as (4F² + 1), not as F². That of a photon detector is stated for a half-full
    well (`thermorender.sensor.photons`).
    """
    if camera.well_electrons:
        return photons.noise_power(camera, difference_mk)
    radiance = difference_mk * 1e-3 * band_radiance_derivative(NETD_REFERENCE_K, *camera.band_um)
    return float(absorbed_power(detector_irradiance(radiance, camera.netd_f_number), camera))


def temporal_noise(camera: Camera, seed: int, index: int, single_w: Image | None = None) -> Image:
    """Return the noise of frame `index` on the detector [W], (H, W) float32: σ_tvh, σ_tv, σ_th and σ_t.

    It depends on `seed` and `index` only. The NETD contains all four, so σ_tvh is the rest, or `single_w` (H, W) [W].
    """
    height, width = camera.height, camera.width
    common = [camera.sigma_t_mk, camera.sigma_tv_mk, camera.sigma_th_mk]
    single = np.sqrt(camera.gain_netd_mk**2 - sum(sigma**2 for sigma in common))
    frame, row, column, pixel = (np.float32(noise_power(camera, sigma)) for sigma in (*common, single))
    if not any(common) and single_w is None:
        return normal(seed, index, _FRAME, (height, width), pixel)
    values = normal(seed, index, _FRAME, height * width + 1 + height + width, np.float32(1.0))
    noise, rest = values[: height * width].reshape(height, width), values[height * width :]
    noise *= pixel if single_w is None else single_w
    noise += frame * rest[0] + row * rest[1 : 1 + height, None]
    noise += column * rest[1 + height :]
    return noise


def fixed_pattern(camera: Camera, seed: int, correction: int = 0) -> Image:
    """Return the residual of a flat-field correction, (H, W) float32 [W]: σ_vh, σ_v and σ_h; new in each correction."""
    return _pattern(camera, seed, correction, _PATTERN, camera.sigma_vh_mk, camera.sigma_v_mk, camera.sigma_h_mk)


def drift_pattern(camera: Camera, seed: int) -> Image:
    """Return the growth of the pattern per kelvin of case drift, (H, W) float32 [W/K]; fixed by the seed."""
    if not camera.drift_mk_per_k:
        return np.zeros((camera.height, camera.width), np.float32)
    # Rows and columns have the same shares as in the pattern itself.
    sigmas = np.array([camera.sigma_vh_mk, camera.sigma_v_mk, camera.sigma_h_mk])
    shares = sigmas / np.linalg.norm(sigmas) if sigmas.any() else np.array([1.0, 0.0, 0.0])
    return _pattern(camera, seed, 0, _DRIFT, *(camera.drift_mk_per_k * shares))


def bad_pixels(camera: Camera, seed: int) -> NDArray[np.int64]:
    """Return the flat indices of the dead or hot pixels, (n,) int64, in order."""
    count = round(camera.bad_pixels * camera.height * camera.width)
    generator = np.random.Generator(philox(seed, 0, _BAD))
    return np.sort(generator.choice(camera.height * camera.width, count, replace=False))


def residual_responsivity(camera: Camera, seed: int) -> Image:
    """Return the relative error of the gain correction of each pixel, (H, W) float32; fixed by the seed."""
    pixel, smooth = (np.float32(percent * 1e-2) for percent in camera.responsivity_percent)
    shape = camera.height, camera.width
    return normal(seed, 0, _RESPONSIVITY, shape, pixel) + smooth * smooth_field(shape, seed, _RESPONSIVITY_SHADING)


def smooth_field(shape: tuple[int, int], seed: int, stream: int) -> Image:
    """Return a smooth field, (H, W) float32, of mean 0 and root mean square 1; fixed by the seed.

    Nine cosines of up to three half waves in total, with normal amplitudes that decrease with the number of half waves.
    """
    halves = np.add.outer(np.arange(_WAVES + 1), np.arange(_WAVES + 1))
    drawn = normal(seed, 0, stream, halves.shape, np.float32(1.0)).astype(np.float64)
    amplitudes = np.where((halves > 0) & (halves <= _WAVES), drawn / np.maximum(halves, 1), 0.0)
    down, right = (half_waves(n) for n in shape)
    return (down.T @ (amplitudes / np.linalg.norm(amplitudes)) @ right).astype(np.float32)


def half_waves(count: int) -> NDArray[np.float64]:
    """Return cosines of 0 … 3 half waves over `count` pixels, (4, count), orthogonal and of mean square 1."""
    number = np.arange(_WAVES + 1)[:, None]
    return np.cos(np.pi * number * (np.arange(count) + 0.5) / count) * np.where(number, np.sqrt(2.0), 1.0)


def _pattern(
    camera: Camera, seed: int, number: int, stream: int, pixel_mk: float, row_mk: float, column_mk: float
) -> Image:
    height, width = camera.height, camera.width
    values = normal(seed, number, stream, height * width + height + width, np.float32(1.0))
    pixel, row, column = (np.float32(noise_power(camera, sigma)) for sigma in (pixel_mk, row_mk, column_mk))
    single, rest = values[: height * width].reshape(height, width), values[height * width :]
    return pixel * single + row * rest[:height, None] + column * rest[height:]


def philox(seed: int, number: int, stream: int, part: int = 0) -> np.random.Philox:
    """Return the generator of random bits for a number, such as that of a frame, in a part of a stream."""
    return np.random.Philox(key=np.array([seed, number], np.uint64), counter=np.array([0, 0, part, stream], np.uint64))


def normal(
    seed: int, number: int, stream: int, shape: int | tuple[int, ...], sigma: np.float32, part: int = 0
) -> Image:
    """Return Gaussian numbers of a stream, float32: 16 random bits each, through a table of quantiles."""
    count = int(np.prod(shape))
    bits = philox(seed, number, stream, part).random_raw(-(-count // 4)).view(np.uint16)[:count]
    return np.take(_quantiles() * sigma, bits).reshape(shape)


@lru_cache(maxsize=1)
def _quantiles() -> Image:
    """Middles of 65 536 equally probable parts of the normal distribution, scaled to unit variance; to ±4.3 σ."""
    from scipy.special import ndtri

    value = ndtri((np.arange(65536) + 0.5) / 65536)
    return (value / value.std()).astype(np.float32)
