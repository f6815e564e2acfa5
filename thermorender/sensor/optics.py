"""From band radiance at the lens to irradiance on the detector."""

import numpy as np


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


def radiance_from_irradiance(irradiance, f_number, transmittance=1.0):
    """Return the band radiance [W m⁻² sr⁻¹] behind a detector irradiance [W m⁻²]; inverse of the above."""
    return np.asarray(irradiance) * (4.0 * f_number**2 + 1.0) / (np.pi * transmittance)
