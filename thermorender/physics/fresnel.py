"""Directional emissivity of opaque surfaces: Fresnel equations, rough facets, and the hemispherical mean.

The emissivity of a smooth opaque surface is one minus its reflectance (Kirchhoff), which follows from the complex
refractive index n + ik. A rough surface, with facets much larger than the wavelength, is a set of small mirrors: each
visible facet counts in proportion to its projected area.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.errors import ThermorenderError

Floats = NDArray[np.float64]

# Cosines of the angle from the normal in tables of directional emissivity. They are dense near grazing angles, where
# emissivity falls to 0 (for metals within the last degree). The error of linear interpolation between them is 2e-5 for
# water and 3e-4 for polished metals.
COSINES = np.linspace(0.0, 1.0, 257) ** 2
COSINES.setflags(write=False)

# Slopes are integrated up to this many standard deviations along each axis; 2e-9 of them are steeper.
_SLOPE_LIMIT = 6.0

# Largest rms slope for which single scattering is adequate.
LARGEST_SLOPE = 0.5


def reflectances(cos_theta: ArrayLike, n: ArrayLike, k: ArrayLike) -> tuple[Floats, Floats]:
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
    14.4.14, with m cos θ_t = √(m² − sin²θ); the principal root is the wave that decays inwards.
    """
    # At exactly grazing incidence an index of 1 would divide 0 by 0.
    cosine = np.maximum(np.asarray(cos_theta, dtype=np.float64), 1e-9)
    index = np.asarray(n, dtype=np.float64) + 1j * np.asarray(k, dtype=np.float64)
    inside = np.sqrt(index**2 - (1.0 - cosine**2))
    perpendicular = (cosine - inside) / (cosine + inside)
    parallel = (index**2 * cosine - inside) / (index**2 * cosine + inside)
    return np.abs(perpendicular) ** 2, np.abs(parallel) ** 2


def smooth_emissivity(cos_theta: ArrayLike, n: ArrayLike, k: ArrayLike) -> Floats:
    """Return the emissivity of a smooth opaque surface for unpolarised light, broadcast over the arguments [1].

    Parameters as in `reflectances`.
    """
    perpendicular, parallel = reflectances(cos_theta, n, k)
    return 1.0 - 0.5 * (perpendicular + parallel)


def directional_emissivity(n: ArrayLike, k: ArrayLike, rms_slope: float = 0.0) -> Floats:
    """Return the (N, 257) emissivity of a surface at each of N refractive indices and at `COSINES` [1].

    Parameters
    ----------
    n, k : (N,) array
        Refractive index, k ≥ 0.
    rms_slope : float
        Root mean square slope of the surface, both axes combined; 0 is a mirror.

    Raises
    ------
    ThermorenderError
        The slope is not within 0…0.5.

    Notes
    -----
    Rough surfaces after Masuda, Takashima and Takayama (1988), doi:10.1016/0034-4257(88)90032-6: Fresnel emissivity
    averaged over facets of Gaussian slopes, weighted with their projected areas. The normalised weights are equivalent
    to Smith's masking (1967, doi:10.1109/TAP.1967.1138991), so facets hidden at grazing angles are accounted for.
    Reflection between facets is neglected (Wu and Smith 1997, doi:10.1364/AO.36.002609); it raises the emissivity of
    wind-roughened water by up to 0.03 near 80°.
    """
    smooth = smooth_emissivity(COSINES, np.asarray(n)[:, None], np.asarray(k)[:, None])
    if not 0.0 <= rms_slope <= LARGEST_SLOPE:
        raise ThermorenderError(
            f"rms_slope={rms_slope:g} is not within 0…{LARGEST_SLOPE:g}; give the rms tangent of the facets' tilt: 0 "
            "for a mirror, √(0.003 + 0.00512 U) for water under a wind of U m/s"
        )
    # Unlike a product of matrices, einsum sums in an order that does not depend on the number of threads.
    return smooth if rms_slope == 0.0 else np.einsum("nf,mf->nm", smooth, _facets(rms_slope))


def hemispherical(cosines: Floats, emissivity: Floats) -> Floats:
    """Return the hemispherical emissivity 2 ∫ ε(µ) µ dµ of tables of directional emissivity [1].

    Parameters
    ----------
    cosines : (M,) array
        Rising from 0 to 1.
    emissivity : (..., M) array
        Emissivity at these cosines; the integral is exact for linear interpolation between them.

    Returns
    -------
    (...) float64 array
    """
    low, high = cosines[:-1], cosines[1:]
    width = high - low
    below, above = width * (2.0 * low + high) / 3.0, width * (low + 2.0 * high) / 3.0
    return emissivity[..., :-1] @ below + emissivity[..., 1:] @ above


def _facets(rms_slope: float) -> Floats:
    """Share (257, 257) of the projected area, per viewing cosine (rows), of facets seen at each cosine (columns)."""
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
