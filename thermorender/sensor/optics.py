"""From band radiance at the lens to irradiance on the detector: transmission, fall of light, own emission."""

import numpy as np

# Width of the narcissus ring over its radius.
_RING_WIDTH = 0.25


def detector_irradiance(radiance, f_number, transmittance=1.0):
    """Return the irradiance on a detector at the centre of the image [W m⁻²], in the shape of `radiance`.

    Parameters
    ----------
    radiance : array
        Band radiance of an extended source [W m⁻² sr⁻¹].
    f_number : float
        Focal length over aperture diameter.
    transmittance : float
        Of the lens.

    Notes
    -----
    E = τ π L / (4 F² + 1), the cone of half-angle arctan(1/2F) seen from the detector.
    """
    return transmittance * np.pi * np.asarray(radiance) / (4.0 * f_number**2 + 1.0)


def relative_illumination(camera):
    """Return the irradiance at each pixel over that on the optical axis, (H, W) float32 in 0 … 1.

    Notes
    -----
    cosⁿθ by the camera's `illumination_exponent`, n = 4 being the natural law of a thin lens, θ the angle at which
    the light arrives; times 1 − v (r/R)² for the rims of the lens, v being `vignetting` and R the farthest pixel's
    distance r from the axis.
    """
    x, y = camera.width / 2 + camera.principal_offset_px[0], camera.height / 2 + camera.principal_offset_px[1]
    row, column = np.mgrid[: camera.height, : camera.width] + 0.5
    radius2 = ((column - x) ** 2 + (row - y) ** 2) / camera.focal_length_px**2
    # A single pixel is on the axis.
    rims = 1.0 - camera.vignetting * radius2 / (radius2.max() or 1.0)
    return (rims * (1.0 + radius2) ** (-0.5 * camera.illumination_exponent)).astype(np.float32)


def case_share(camera, illumination):
    """Return the share of what each pixel sees that is lens and housing, in the shape of `illumination`.

    Parameters
    ----------
    camera : Camera
    illumination : array
        As by `relative_illumination`.

    Notes
    -----
    1 − τ V cos⁴θ / (4 F² + 1): the hemisphere above a pixel is black but for the part of the lens's cone that the
    lens passes. Times π B(T), at 300 K and f/1.25, this is seven times the signal of a scene of 300 K, which is why
    cameras close a shutter every few minutes.
    """
    return 1.0 - np.asarray(illumination) * (camera.lens_transmittance / (4.0 * camera.f_number**2 + 1.0))


def narcissus_ring(camera):
    """Return the shape of the detector's own reflection in the lens, (H, W) float32, 1 on the ring."""
    x, y = camera.width / 2 + camera.principal_offset_px[0], camera.height / 2 + camera.principal_offset_px[1]
    row, column = np.mgrid[: camera.height, : camera.width] + 0.5
    off = np.hypot(column - x, row - y) / camera.narcissus_radius_px - 1.0
    return np.exp(-0.5 * (off / _RING_WIDTH) ** 2).astype(np.float32)
