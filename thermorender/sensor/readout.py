"""From the corrected signal to counts, and back to the radiance of a count."""

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.physics.planck import band_radiance, brightness_temperature
from thermorender.sensor.camera import Camera, Image
from thermorender.sensor.detector import absorbed_power
from thermorender.sensor.optics import detector_irradiance


def digitised(signal: Image, camera: Camera) -> NDArray[np.uint16]:
    """Return the counts of a signal (H, W) [W] at the image centre, uint16 in 0 … 2**bits − 1; overwrites it."""
    low, step = _scale(camera)
    signal -= np.float32(low)
    signal *= np.float32(1.0 / step)
    np.rint(signal, out=signal)
    return np.clip(signal, 0, 2**camera.bits - 1, out=signal).astype(np.uint16)


def temperature_linear(counts: NDArray[np.uint16], camera: Camera) -> NDArray[np.uint16]:
    """Return counts linear in apparent temperature from 0 K, (H, W) uint16, if the camera has this mode."""
    return counts if not camera.tlinear_mk else np.take(_temperature_table(camera), counts)


def radiance_from_counts(values: ArrayLike, camera: Camera) -> NDArray[np.float64]:
    """Return the band radiance of each count [W m⁻² sr⁻¹]; the inverse of the noise-free read-out."""
    values = np.asarray(values, np.float64)
    if camera.tlinear_mk:
        return band_radiance(values * (camera.tlinear_mk * 1e-3), *camera.band_um)
    return _radiance(values, camera)


def saturated(values: NDArray[np.uint16], camera: Camera) -> NDArray[np.bool_]:
    """Return where a count is at either end of its range, (H, W) bool."""
    first, last = 0, 2**camera.bits - 1
    if camera.tlinear_mk:
        first, last = _temperature_table(camera)[[0, -1]]
    return (values <= first) | (values >= last)


def _radiance(values: NDArray[np.float64], camera: Camera) -> NDArray[np.float64]:
    ends = band_radiance(np.array(camera.count_range_k), *camera.band_um)
    return ends[0] + (ends[1] - ends[0]) / (2**camera.bits - 1) * values


@lru_cache(maxsize=4)
def _scale(camera: Camera) -> tuple[float, float]:
    """(power of count 0, power of one count) [W]."""
    radiance = _radiance(np.array([0.0, 1.0]), camera)
    irradiance = detector_irradiance(radiance, camera.f_number, camera.lens_transmittance)
    low, next_one = absorbed_power(irradiance, camera)
    return low, next_one - low


@lru_cache(maxsize=4)
def _temperature_table(camera: Camera) -> NDArray[np.uint16]:
    """The temperature-linear count of each count, (2**bits,) uint16."""
    temperature = brightness_temperature(_radiance(np.arange(2.0**camera.bits), camera), *camera.band_um)
    return np.minimum(np.rint(temperature / (camera.tlinear_mk * 1e-3)), 2**camera.bits - 1).astype(np.uint16)
