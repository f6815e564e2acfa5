"""Emissivity by angle of opaque surfaces: Fresnel's equations, roughness by slopes, and the hemispherical mean.

A smooth opaque surface emits one minus what it reflects (Kirchhoff), and what it reflects follows from its complex
refractive index n + ik. A rough one, whose slopes are large against the wavelength, is a crowd of small mirrors:
from each direction one sees the facets that face it, in proportion to the area they show.
"""

import numpy as np

from thermorender.errors import ThermorenderError

# Cosines of the angle from the normal at which directional emissivities are tabulated: squares of an even grid, dense
# near grazing, where emissivity falls to 0 (for metals within the last degree). Linear interpolation between them
# holds 2e-5 for water and 3e-4 for polished metals.
COSINES = np.linspace(0.0, 1.0, 257) ** 2
COSINES.setflags(write=False)

# Slopes are integrated out to this many standard deviations along each axis; the rest holds 2e-9 of them.
_SLOPE_LIMIT = 6.0

# The largest rms slope that single scattering describes.
LARGEST_SLOPE = 0.5


def reflectances(cos_theta, n, k):
    """Return (perpendicular, parallel) reflectance of a smooth surface in air, broadcast over the arguments.

    Parameters
    ----------
    cos_theta : array
        Cosine of the angle from the normal, 0…1.
    n, k : array
        Real and imaginary part of the refractive index; k ≥ 0 absorbs.

    Returns
    -------
    tuple of two float64 arrays
        Share of the power reflected with the field perpendicular (s) and parallel (p) to the plane of incidence [1].

    Notes
    -----
    Fresnel's equations with a complex index: Born & Wolf, Principles of Optics, 7th ed. (1999), eqs. 1.5.21 and
    14.4.14. Written with m cos θ_t = √(m² − sin²θ), whose principal root is the wave that decays inwards.
    """
    # At exactly grazing view an index of 1 would divide 0 by 0.
    cosine = np.maximum(np.asarray(cos_theta, dtype=np.float64), 1e-9)
    index = np.asarray(n, dtype=np.float64) + 1j * np.asarray(k, dtype=np.float64)
    inside = np.sqrt(index**2 - (1.0 - cosine**2))
    perpendicular = (cosine - inside) / (cosine + inside)
    parallel = (index**2 * cosine - inside) / (index**2 * cosine + inside)
    return np.abs(perpendicular) ** 2, np.abs(parallel) ** 2


def smooth_emissivity(cos_theta, n, k):
    """Return the emissivity of a smooth opaque surface for unpolarised light, broadcast over the arguments [1].

    Parameters as in `reflectances`.
    """
    perpendicular, parallel = reflectances(cos_theta, n, k)
    return 1.0 - 0.5 * (perpendicular + parallel)


def directional_emissivity(n, k, rms_slope=0.0):
    """Return the (N, 257) emissivity of a surface at each of N refractive indices and at `COSINES` [1].

    Parameters
    ----------
    n, k : (N,) array
        Refractive index, k ≥ 0.
    rms_slope : float
        Root mean square slope of the surface, over both axes together; 0 is a mirror.

    Raises
    ------
    ThermorenderError
        The slope is not within 0…0.5.

    Notes
    -----
    Rough surfaces after Masuda, Takashima and Takayama (1988), doi:10.1016/0034-4257(88)90032-6: Fresnel emissivity
    averaged over facets of Gaussian slopes, each weighted with the area it shows the viewer, and divided by the sum
    of these weights. That quotient equals Smith's masking (1967, doi:10.1109/TAP.1967.1138991), so facets hidden at
    grazing view are accounted for. Left out: light of one facet reflected by another (Wu and Smith 1997,
    doi:10.1364/AO.36.002609), which raises the emissivity of wind-roughened water by up to 0.03 near 80°.
    """
    smooth = smooth_emissivity(COSINES, np.asarray(n)[:, None], np.asarray(k)[:, None])
    if not 0.0 <= rms_slope <= LARGEST_SLOPE:
        raise ThermorenderError(
            f"rms_slope={rms_slope:g} is not within 0…{LARGEST_SLOPE:g}; give the tangent of the facets' tilt, 0 for a "
            "mirror and √(0.003 + 0.00512 U) for water under a wind of U m/s"
        )
    return smooth if rms_slope == 0.0 else smooth @ _facets(rms_slope).T


def hemispherical(cosines, emissivity):
    """Return the hemispherical emissivity 2 ∫ ε(µ) µ dµ of tables by angle [1].

    Parameters
    ----------
    cosines : (M,) array
        Rising from 0 to 1.
    emissivity : (..., M) array
        Emissivity at these cosines, linear between them: the integral is exact for that.

    Returns
    -------
    (...) float64 array
    """
    low, high = cosines[:-1], cosines[1:]
    width = high - low
    below, above = width * (2.0 * low + high) / 3.0, width * (low + 2.0 * high) / 3.0
    return emissivity[..., :-1] @ below + emissivity[..., 1:] @ above


def _facets(rms_slope):
    """(257, 257): share of what a viewer at each of COSINES sees whose facets are tilted to each of COSINES."""
    node, weight = np.polynomial.legendre.leggauss(64)
    deviation = rms_slope / np.sqrt(2.0)
    limit = _SLOPE_LIMIT * deviation
    across, across_weight = limit * node, limit * weight * np.exp(-0.5 * (limit * node / deviation) ** 2)
    shares = np.zeros((COSINES.size, COSINES.size))
    for row, cosine in enumerate(COSINES):
        sine = np.sqrt(1.0 - cosine**2)
        # Facets steeper than this face away; ending there keeps the integrand smooth.
        steepest = min(limit, cosine / sine) if sine else limit
        half = 0.5 * (steepest + limit)
        along = 0.5 * (steepest - limit) + half * node
        shown = (cosine - along * sine) * half * weight * np.exp(-0.5 * (along / deviation) ** 2)
        shown = shown[:, None] * across_weight
        facing = (cosine - along[:, None] * sine) / np.sqrt(1.0 + along[:, None] ** 2 + across**2)
        position = np.sqrt(np.clip(facing, 0.0, 1.0))
        below = np.minimum((position * (COSINES.size - 1)).astype(int), COSINES.size - 2)
        upper = (np.clip(facing, 0.0, 1.0) - COSINES[below]) / (COSINES[below + 1] - COSINES[below])
        shares[row] = np.bincount(below.ravel(), (shown * (1.0 - upper)).ravel(), COSINES.size)
        shares[row] += np.bincount(below.ravel() + 1, (shown * upper).ravel(), COSINES.size)
    return shares / shares.sum(axis=1, keepdims=True)
