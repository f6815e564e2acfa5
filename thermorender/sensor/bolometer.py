"""The microbolometer, thinly: temporal noise of the stated NETD and linear read-out to counts.

The order is physical: radiance, irradiance on the detector, noise there, then the analogue-to-digital
converter, which is linear in irradiance between the two ends of the gain range.
"""

import numpy as np

from thermorender.physics.planck import band_radiance, band_radiance_derivative
from thermorender.sensor.optics import detector_irradiance, radiance_from_irradiance
from thermorender.units import ZERO_CELSIUS_K

NETD_REFERENCE_K = 300.0


def noise_irradiance(camera):
    """Return the standard deviation of the temporal noise on the detector [W m⁻²].

    The noise-equivalent temperature difference is stated for a lossless lens of its own f-number at 300 K:
    σ_E = π NETD dL/dT / (4 F₀² + 1). Seen through another f-number it grows as (4F² + 1), not as F².
    """
    difference = camera.netd_mk * 1e-3 * band_radiance_derivative(NETD_REFERENCE_K, *camera.band_um)
    return float(detector_irradiance(difference, camera.netd_f_number))


def noise(camera, seed, index):
    """Return one frame's temporal noise, (H, W) float32, in standard deviations.

    It depends on `seed` and the frame's `index` only: counter-based Philox, no state between frames.
    """
    generator = np.random.Generator(np.random.Philox(key=np.array([seed, index], dtype=np.uint64)))
    return generator.standard_normal((camera.height, camera.width), dtype=np.float32)


def counts(radiance, camera, seed, index):
    """Return what the detector reads, (H, W) uint16 in 0 … 2**bits − 1.

    Parameters
    ----------
    radiance : (H, W) float32
        Band radiance at the lens [W m⁻² sr⁻¹].
    camera : Camera
    seed, index : int
        Seed of the flight and number of the frame.
    """
    irradiance = detector_irradiance(radiance, camera.f_number, camera.lens_transmittance)
    irradiance += noise_irradiance(camera) * noise(camera, seed, index)
    low, step = map(float, _scale(camera))
    irradiance -= low
    irradiance /= step
    return np.clip(np.rint(irradiance, out=irradiance), 0, 2**camera.bits - 1, out=irradiance).astype(np.uint16)


def radiance_from_counts(values, camera):
    """Return the band radiance each count stands for [W m⁻² sr⁻¹]; the inverse of the noise-free read-out."""
    low, step = _scale(camera)
    irradiance = low + step * np.asarray(values, np.float64)
    return radiance_from_irradiance(irradiance, camera.f_number, camera.lens_transmittance)


def saturated(values, camera):
    """Return where a count sits at either end of its range, (H, W) bool."""
    return (values == 0) | (values == 2**camera.bits - 1)


def _scale(camera):
    """(irradiance of count 0, irradiance of one count) [W m⁻²]."""
    ends = band_radiance(np.array(camera.range_c) + ZERO_CELSIUS_K, *camera.band_um)
    low, high = detector_irradiance(ends, camera.f_number, camera.lens_transmittance)
    return low, (high - low) / (2**camera.bits - 1)
