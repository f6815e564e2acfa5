"""The photon detector: light as electrons in a well, their noise, and the temperature that fills it.

A pixel at the image centre collects N = η t A τ π L_q / (4F² + 1) electrons, with η the quantum efficiency, t the
integration time, A the pixel's area and L_q the photon radiance. L_q is that of the blackbody with the same band
radiance, which is exact for blackbodies. From 300 K to 2000 K the photons per joule fall by 5 % over 3.7–4.8 µm.

Electrons of noise are √(N + r²). The read noise r is what the stated NETD holds beyond photons: of a well half full at
300 K, as data sheets state it. Dark current, the leaks of the cold shield and the detector's own reflection are absent.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.physics.planck import band_radiance, brightness_temperature
from thermorender.physics.quanta import photons_per_joule
from thermorender.sensor.camera import NETD_REFERENCE_K, Camera, Image
from thermorender.sensor.detector import absorbed_power
from thermorender.sensor.optics import detector_irradiance

# Temperatures between which a well is filled [K].
_FILLED_K = np.geomspace(100.0, 20_000.0, 4096)


def electrons(radiance: ArrayLike, camera: Camera) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return (electrons of a pixel at the image centre, electrons per radiance more), in the shape of `radiance`.

    Parameters
    ----------
    radiance : array
        Band radiance [W m⁻² sr⁻¹].
    camera : Camera
        With a photon detector.
    """
    ratio, slope = photons_per_joule(radiance, *camera.band_um)
    irradiance = detector_irradiance(1.0, camera.f_number, camera.lens_transmittance)
    joules = camera.memory_s * (camera.pixel_pitch_um * 1e-6) ** 2 * irradiance
    return camera.quantum_efficiency * joules * radiance * ratio, camera.quantum_efficiency * joules * slope


def full_well_k(camera: Camera) -> float:
    """Return the temperature of the blackbody that fills the well at the image centre [K]."""
    radiance = band_radiance(_FILLED_K, *camera.band_um)
    full = float(np.interp(camera.well_electrons, electrons(radiance, camera)[0], radiance))
    return float(brightness_temperature(full, *camera.band_um))


def read_noise_electrons(camera: Camera) -> float:
    """Return the read noise of a pixel: what its NETD holds beyond photons [electrons]."""
    beyond_mk2 = max(camera.netd_mk**2 - camera.least_netd_mk**2, 0.0)
    return float(np.sqrt(beyond_mk2)) * camera.half_well_per_mk


def noise_power(camera: Camera, difference_mk: float) -> float:
    """Return the power [W], in the camera's integration time, of as many electrons as a temperature difference [mK]
    makes under the conditions of the NETD."""
    _, slope = electrons(band_radiance(NETD_REFERENCE_K, *camera.band_um), camera)
    return difference_mk * camera.half_well_per_mk / float(slope) * _power(camera)


def collected(
    power: Image, illumination: Image, camera: Camera
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return (electrons, electrons per watt more, their noise [W]) of pixels, (H, W) each.

    Parameters
    ----------
    power : (H, W) float32
        On the pixels [W].
    illumination : (H, W) float32
        Irradiance of each pixel over that at the image centre.
    camera : Camera
    """
    centre = _power(camera)
    number, slope = electrons(np.maximum(power / (centre * illumination), 0.0), camera)
    number, per_watt = number * illumination, slope / centre
    return number, per_watt, np.sqrt(number + read_noise_electrons(camera) ** 2) / per_watt


def _power(camera: Camera) -> Any:
    """Power on a pixel at the image centre per radiance [m² sr]."""
    return absorbed_power(detector_irradiance(1.0, camera.f_number, camera.lens_transmittance), camera)
