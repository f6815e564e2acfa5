"""Errors of an image in mK: against a converged one, as it is and behind the camera's optics."""

import os
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.physics.planck import band_radiance_derivative, brightness_temperature
from thermorender.render.renderer import Renderer
from thermorender.sensor.psf import filtered, gaussian_otf, lens_otf

# Pixels of the converged image per pixel and direction, and rays in each: 256 per pixel.
FINER, RAYS = 8, 4
# No edge errs so much; what is thinner than a pixel gets its rays.
_NO_EDGE_MK = 1e12
# Keywords of Renderer that decide how a pixel is sampled, and nothing else.
SAMPLING = ("quality", "samples", "taps", "edge_mk")


@contextmanager
def cache_off():
    """Within it, light between surfaces is traced and neither read from disk nor kept there: for timing a bake."""
    name, before = "THERMORENDER_CACHE", os.environ.get("THERMORENDER_CACHE")
    # No folder can be made below it.
    os.environ[name] = os.devnull
    try:
        yield
    finally:
        if before is None:
            del os.environ[name]
        else:
            os.environ[name] = before


def converged(renderer, pose, keywords):
    """Return (H, W) float64 radiance [W m⁻² sr⁻¹] of a renderer's scene with 256 rays per pixel.

    Parameters
    ----------
    renderer : Renderer
        Its light between surfaces is used again.
    pose : (4, 4) array
        world_from_camera.
    keywords : dict
        What the renderer was made with.
    """
    camera = renderer.scene.camera
    settings = {"rays": renderer.plan.rays, **keywords}
    settings |= {"samples": RAYS, "taps": 1, "edge_mk": _NO_EDGE_MK, "like": renderer}
    quarters = []
    for lower in range(2):
        for right in range(2):
            part = renderer.scene.with_camera(_quarter(camera, right, lower))
            image = Renderer(part, **settings).radiance(pose).astype(np.float64)
            rows, columns = image.shape
            quarters.append(image.reshape(rows // FINER, FINER, columns // FINER, FINER).mean(axis=(1, 3)))
    return np.block([quarters[:2], quarters[2:]])


def _quarter(camera, right, lower):
    """A quarter of a camera's image with each pixel cut into 8 × 8; both sides must be even.

    In quarters, since the rays of a whole image so fine take more than a gigabyte.
    """
    width, height = (n // 2 * FINER for n in (camera.width, camera.height))
    middle = zip(camera.principal_offset_px, (right, lower), (width, height), strict=True)
    return replace(
        camera,
        width=width,
        height=height,
        pixel_pitch_um=camera.pixel_pitch_um / FINER,
        principal_offset_px=tuple(FINER * shift + (0.5 - side) * size for shift, side, size in middle),
    )


def rms_mk(image, reference, camera, sigma_px=0.0):
    """Return the root mean square difference of two images in apparent temperature [mK].

    Parameters
    ----------
    image, reference : (H, W) arrays
        Band radiance [W m⁻² sr⁻¹].
    camera : Camera
    sigma_px : float
        Width of a Gaussian both are filtered with first [px].
    """
    difference = np.asarray(image, np.float64) - reference
    if sigma_px:
        difference = after_optics(difference, sigma_px)
    return float(np.sqrt((difference**2).mean())) * mk_per_radiance(reference, camera.band_um)


def mk_per_radiance(radiance, band_um):
    """Return mK of apparent temperature per W m⁻² sr⁻¹ at the mean of an image of band radiance."""
    middle = brightness_temperature(float(np.mean(radiance)), *band_um)
    return float(1e3 / band_radiance_derivative(middle, *band_um))


def optics_sigma_px(camera):
    """Return the width of the Gaussian that stands for diffraction in the lens of a camera [px].

    Notes
    -----
    The Gaussian passes as much as `lens_otf` at the detector's Nyquist frequency, 1/2 per pixel, at the middle of the
    band: exp(−π² σ²/2) = MTF. At f/1.25, 10.5 µm and 17 µm pixels MTF = 0.521 and σ = 0.363 px. A pixel's own width
    is in the images already; with it, 1/√12 px, the whole is as wide as a Gaussian of 0.464 px. A real lens blurs
    more, and so hides more of the error.
    """
    mtf = float(lens_otf(0.5 / camera.pixel_pitch_um, np.mean(camera.band_um), camera.f_number))
    if mtf <= 0.0:
        raise ThermorenderError(
            f"camera {camera.name}: f_number={camera.f_number:g} blurs more than two pixels by diffraction; lower it"
        )
    return float(np.sqrt(-2.0 * np.log(mtf)) / np.pi)


def after_optics(image, sigma_px):
    """Return an image (H, W) filtered with a Gaussian of `sigma_px`, mirrored at its borders.

    Exactly: sampled at pixels, so narrow a Gaussian would hardly blur.
    """
    return filtered(image, lambda frequency: gaussian_otf(frequency, sigma_px))
