"""Error of an image against a converged one, in mK: as it is, and after the camera's optics."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.errors import ThermorenderError
from thermorender.physics.planck import band_radiance_derivative, brightness_temperature
from thermorender.render.renderer import Renderer
from thermorender.sensor.camera import Camera
from thermorender.sensor.psf import filtered, gaussian_otf, lens_otf

# Subpixels per pixel and direction, and rays in each: 256 rays per pixel.
FINER, RAYS = 8, 4
# A threshold that no edge error exceeds, so only objects thinner than a pixel get extra rays.
_NO_EDGE_MK = 1e12


@contextmanager
def cache_off() -> Iterator[None]:
    """Switch off the disk cache of light between surfaces within the context, so that bakes can be timed."""
    name, before = "THERMORENDER_CACHE", os.environ.get("THERMORENDER_CACHE")
    # No folder can be created below the null device.
    os.environ[name] = os.devnull
    try:
        yield
    finally:
        if before is None:
            del os.environ[name]
        else:
            os.environ[name] = before


def converged(renderer: Renderer, pose: ArrayLike) -> NDArray[np.float64]:
    """Return the band radiance with 256 rays per pixel, (H, W) [W m⁻² sr⁻¹], from the renderer's baked light."""
    camera = renderer.scene.camera
    sampling = replace(renderer.plan.sampling, samples=RAYS, taps=1, edge_mk=_NO_EDGE_MK)
    plan = replace(renderer.plan, sampling=sampling)
    quarters = []
    for lower in range(2):
        for right in range(2):
            part = renderer.scene.with_camera(_quarter(camera, right, lower))
            seen = renderer.baked.seen_as(part, plan)
            assert seen is not None
            image = Renderer.of(seen).radiance(pose).astype(np.float64)
            rows, columns = image.shape
            quarters.append(image.reshape(rows // FINER, FINER, columns // FINER, FINER).mean(axis=(1, 3)))
    return np.block([quarters[:2], quarters[2:]])


def _quarter(camera: Camera, right: int, lower: int) -> Camera:
    """Return a quarter of a camera's image with 8 × 8 subpixels per pixel, to save memory; sides must be even."""
    width, height = (n // 2 * FINER for n in (camera.width, camera.height))
    across, along = camera.principal_offset_px
    return replace(
        camera,
        width=width,
        height=height,
        pixel_pitch_um=camera.pixel_pitch_um / FINER,
        principal_offset_px=(FINER * across + (0.5 - right) * width, FINER * along + (0.5 - lower) * height),
    )


def rms_mk(image: ArrayLike, reference: NDArray[np.floating], camera: Camera, sigma_px: float = 0.0) -> float:
    """Return the rms difference of two radiances (H, W), blurred by `sigma_px`, in apparent temperature [mK]."""
    difference = np.asarray(image, np.float64) - reference
    if sigma_px:
        difference = after_optics(difference, sigma_px)
    return float(np.sqrt((difference**2).mean())) * mk_per_radiance(reference, camera.band_um)


def mk_per_radiance(radiance: ArrayLike, band_um: tuple[float, float]) -> float:
    """Return the slope of apparent temperature at an image's mean band radiance [mK per W m⁻² sr⁻¹]."""
    middle = brightness_temperature(float(np.asarray(radiance).mean()), *band_um)
    return float(1e3 / band_radiance_derivative(middle, *band_um))


def optics_sigma_px(camera: Camera) -> float:
    """Return the standard deviation of the Gaussian that approximates diffraction in a camera's lens [px].

    It equals `lens_otf` at the detector's Nyquist frequency, 1/2 per pixel, in the middle of the band: exp(−π² σ²/2) =
    MTF. At f/1.25, 10.5 µm and 17 µm pixels MTF = 0.521 and σ = 0.363 px; with the pixel's own 1/√12 px, 0.464 px. A
    real lens blurs more and hides more of the error.
    """
    mtf = float(lens_otf(0.5 / camera.pixel_pitch_um, float(np.mean(camera.band_um)), camera.f_number))
    if mtf <= 0.0:
        raise ThermorenderError(
            f"camera {camera.name}: f_number={camera.f_number:g} blurs more than two pixels by diffraction; lower it"
        )
    return float(np.sqrt(-2.0 * np.log(mtf)) / np.pi)


def after_optics(image: ArrayLike, sigma_px: float) -> NDArray[np.float64]:
    """Return an image (H, W) blurred with a Gaussian of `sigma_px`, exactly in frequency, mirrored at its borders."""
    return filtered(image, lambda frequency: gaussian_otf(frequency, sigma_px))
