"""From band radiance at the lens to irradiance on the detector: transmission, relative illumination, emission."""

from typing import Any

import numpy as np

from thermorender.sensor.camera import Camera, Image

# Width of the narcissus ring over its radius.
_RING_WIDTH = 0.25


def detector_irradiance(radiance: Any, f_number: float, transmittance: float = 1.0) -> Any:
    """Return the irradiance [W m⁻²] of band radiance [W m⁻² sr⁻¹] at the image's centre: E = τ π L / (4 F² + 1)."""
    return transmittance * np.pi * np.asarray(radiance) / (4.0 * f_number**2 + 1.0)


def relative_illumination(camera: Camera) -> Image:
    """Return the irradiance at each pixel over that on the optical axis, (H, W) float32 in 0 … 1.

    cosⁿθ with n the camera's `illumination_exponent` (4: natural law of a thin lens) and θ the angle of incidence,
    times 1 − v (r/R)² for the rims of the lens, with v `vignetting` and R the largest distance r of a pixel from the
    axis.
    """
    x, y = camera.width / 2 + camera.principal_offset_px[0], camera.height / 2 + camera.principal_offset_px[1]
    row, column = np.mgrid[: camera.height, : camera.width] + 0.5
    radius2 = ((column - x) ** 2 + (row - y) ** 2) / camera.focal_length_px**2
    # In an image of one pixel on the axis all radii are zero.
    rims = 1.0 - camera.vignetting * radius2 / (radius2.max() or 1.0)
    return (rims * (1.0 + radius2) ** (-0.5 * camera.illumination_exponent)).astype(np.float32)


def case_share(camera: Camera, illumination: Image) -> Image:
    """Return the share of each pixel's hemisphere that is lens and housing, in the shape of `illumination`.

    1 − τ V cos⁴θ / (4 F² + 1). Times π B(T), at 300 K and f/1.25, this is seven times the signal of a scene of 300 K.
    """
    return 1.0 - np.asarray(illumination) * (camera.lens_transmittance / (4.0 * camera.f_number**2 + 1.0))


def narcissus_ring(camera: Camera) -> Image:
    """Return the shape of the detector's reflection in the lens, (H, W) float32, 1 on the ring."""
    x, y = camera.width / 2 + camera.principal_offset_px[0], camera.height / 2 + camera.principal_offset_px[1]
    row, column = np.mgrid[: camera.height, : camera.width] + 0.5
    off = np.hypot(column - x, row - y) / camera.narcissus_radius_px - 1.0
    return np.exp(-0.5 * (off / _RING_WIDTH) ** 2).astype(np.float32)
