"""The photon detector: light as electrons in a well, their noise, and the temperature that fills it.

A pixel at the image centre collects N = η t A τ π L_q / (4F² + 1) electrons, with η the quantum efficiency, t the
integration time, A the pixel's area and L_q the photon radiance. L_q is that of the blackbody with the same band
radiance, which is exact for blackbodies. From 300 K to 2000 K the photons per joule fall by 5 % over 3.7–4.8 µm.

Electrons of noise are √(N + r²). The read noise r is what the stated NETD holds beyond photons: of a well half full at
300 K, as data sheets state it. Dark current, the leaks of the cold shield and the detector's own reflection are absent.
"""

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.physics.planck import (
    BOLTZMANN,
    C2,
    band_radiance,
    band_radiance_derivative,
    brightness_temperature,
    spectral_radiance,
)
from thermorender.sensor.camera import NETD_REFERENCE_K, Camera, Image
from thermorender.sensor.detector import absorbed_power
from thermorender.sensor.optics import detector_irradiance

# Share of the well that is full where an NETD is stated.
_FILL = 0.5
# Temperatures of the table of photons [K], and nodes across the band.
_TABLE_K, _NODES = np.geomspace(100.0, 20_000.0, 2048), 64


@lru_cache(maxsize=8)
def _photons(lower_um: float, upper_um: float) -> tuple[NDArray[np.float64], ...]:
    """(Band radiance [W m⁻² sr⁻¹], photons per joule, photons more per joule more) of blackbodies, (n,) each."""
    node, weight = np.polynomial.legendre.leggauss(_NODES)
    half = 0.5 * (upper_um - lower_um)
    wavelength = 0.5 * (upper_um + lower_um) + half * node
    x = C2 / (wavelength * _TABLE_K[:, None])
    # A photon has hc/λ joules.
    spectral = spectral_radiance(wavelength, _TABLE_K[:, None]) * wavelength / (C2 * BOLTZMANN)
    photons = spectral @ weight * half
    per_kelvin = (spectral * x / -np.expm1(-x)) @ weight * half / _TABLE_K
    radiance = band_radiance(_TABLE_K, lower_um, upper_um)
    return radiance, photons / radiance, per_kelvin / band_radiance_derivative(_TABLE_K, lower_um, upper_um)


def electrons(radiance: ArrayLike, camera: Camera) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return (electrons of a pixel at the image centre, electrons per radiance more), in the shape of `radiance`.

    Parameters
    ----------
    radiance : array
        Band radiance [W m⁻² sr⁻¹].
    camera : Camera
        With a photon detector.
    """
    table, ratio, slope = _photons(*camera.band_um)
    irradiance = detector_irradiance(1.0, camera.f_number, camera.lens_transmittance)
    joules = camera.memory_s * (camera.pixel_pitch_um * 1e-6) ** 2 * irradiance
    collected, radiance = camera.quantum_efficiency * joules, np.asarray(radiance, np.float64)
    return collected * radiance * np.interp(radiance, table, ratio), collected * np.interp(radiance, table, slope)


def full_well_k(camera: Camera) -> float:
    """Return the temperature of the blackbody that fills the well at the image centre [K]."""
    table = _photons(*camera.band_um)[0]
    radiance = float(np.interp(camera.well_electrons, electrons(table, camera)[0], table))
    return float(brightness_temperature(radiance, *camera.band_um))


def _half_full(camera: Camera) -> tuple[float, float, float]:
    """(Electrons of a half-full well, their growth per mK at 300 K, the integration time for them in the camera's)."""
    radiance, per_kelvin = (
        function(NETD_REFERENCE_K, *camera.band_um) for function in (band_radiance, band_radiance_derivative)
    )
    number, slope = (float(value) for value in electrons(radiance, camera))
    half = _FILL * camera.well_electrons
    return half, 1e-3 * half * slope * per_kelvin / number, half / number


def least_netd_mk(camera: Camera) -> float:
    """Return the NETD by photons and by the noise of frames, rows and columns, without read noise [mK]."""
    half, per_mk, _ = _half_full(camera)
    return float(np.sqrt(half / per_mk**2 + _common_mk2(camera)))


def read_noise_electrons(camera: Camera) -> float:
    """Return the read noise of a pixel: what its NETD holds beyond photons [electrons]."""
    half, per_mk, _ = _half_full(camera)
    return float(np.sqrt(max((camera.netd_mk**2 - _common_mk2(camera)) * per_mk**2 - half, 0.0)))


def noise_power(camera: Camera, difference_mk: float) -> float:
    """Return the power [W], in the camera's integration time, of as many electrons as a temperature difference [mK]
    makes under the conditions of the NETD."""
    radiance = difference_mk * 1e-3 * band_radiance_derivative(NETD_REFERENCE_K, *camera.band_um)
    return radiance * _power(camera) * _half_full(camera)[2]


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


def _common_mk2(camera: Camera) -> float:
    """Variance by the noise of frames, rows and columns [mK²]."""
    return camera.sigma_t_mk**2 + camera.sigma_tv_mk**2 + camera.sigma_th_mk**2
