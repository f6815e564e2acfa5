"""Rays through the air as steps: straight lines above a sphere, and the altitudes along them.

A chord of a sphere needs no case of its own for level paths, and none for flat ground. Refraction is in the radius.
"""

import numpy as np

# Mean radius of the Earth over 1 minus the mean refraction coefficient of light near the ground, 0.13 (Gauss): rays
# drawn straight above an Earth of this radius keep the altitudes of refracted rays.
MEAN_RADIUS_M = 6.371e6
EARTH_RADIUS_M = MEAN_RADIUS_M / (1.0 - 0.13)
# Altitude above which there is no air [m].
TOP_M = 1.0e5
# Longest line between two points in the air that the Earth does not cut [m].
LONGEST_M = 2.0 * float(np.sqrt((EARTH_RADIUS_M + TOP_M) ** 2 - EARTH_RADIUS_M**2))
# Altitudes of a path's steps are even in ln(this + altitude).
_SCALE_M = 3.0e3
_FEWEST_STEPS = 3
# Steps of a ray that leaves the air, and of its part down to its lowest point: 4 mK of the sky, at 285 K.
_OUTWARD_STEPS = 24
_DESCENT_STEPS = 8
# Outward, altitudes crowd at the lowest point with this scale.
_OUTWARD_SCALE_M = 2.0e3


def horizon_cos_zenith(at_m):
    """Return the cosine of the zenith angle of the sea-level horizon seen from altitudes [m]; 0 from the ground."""
    ratio = EARTH_RADIUS_M / (EARTH_RADIUS_M + np.maximum(np.asarray(at_m, dtype=np.float64), 0.0))
    return -np.sqrt(1.0 - np.square(ratio))


def chord(first, last, distance, step):
    """Return (altitudes (P, 2 M + 1), lengths (P, 2 M)) [m] of the half steps of paths between two altitudes.

    Parameters
    ----------
    first, last, distance : (P,) arrays
        Altitudes of the ends and length of the path [m].
    step : float
        Largest step in ln(3 km + altitude).

    Notes
    -----
    Altitude at a part f of a chord: r² = (1 − f) r₁² + f r₂² − f (1 − f) d² (Stewart's theorem).
    """
    # The altitude above the lower end is a g + b g², g being the part of the path from there. Steps are even in
    # ln(scale + altitude); a path that dips below both ends (a < 0) is nearly level, and they are even in g.
    rise = np.abs(last - first)[..., None]
    bend = np.square(distance)[..., None] / (2.0 * EARTH_RADIUS_M)
    base = _SCALE_M + np.maximum(np.minimum(first, last), 0.0)[..., None]
    span = np.log1p((rise + 2.0 * bend) / base)
    steps = max(_FEWEST_STEPS, int(np.ceil(np.max(span, initial=0.0) / step)))
    part = np.linspace(0.0, 1.0, 2 * steps + 1)
    steep = rise > bend
    slope = np.where(steep, rise - bend, 1.0)
    above = base * np.expm1(part * np.log1p(rise / base))
    fraction = np.where(steep, 2.0 * above / (slope + np.sqrt(slope**2 + 4.0 * bend * above)), part)
    fraction = np.where((last < first)[..., None], 1.0 - fraction[..., ::-1], fraction)
    drop = fraction * (1.0 - fraction) * np.square(distance)[..., None]
    inner = np.square(EARTH_RADIUS_M + first)[..., None] * (1.0 - fraction)
    altitude = np.sqrt(inner + np.square(EARTH_RADIUS_M + last)[..., None] * fraction - drop) - EARTH_RADIUS_M
    return altitude, np.diff(fraction, axis=-1) * distance[..., None]


def outward(at, cosine, top):
    """Return (altitudes (P, 2 M + 1), lengths (P, 2 M)) [m] of the half steps of rays that leave the air.

    Parameters
    ----------
    at, cosine : (P,) arrays
        Altitude of the observer [m], not below 0, and cosine of the ray's zenith angle, not below the horizon.
    top : float
        Altitude at which the rays end [m]; where the observer is higher, after no length.
    """
    # Distance along the ray from its point nearest to the Earth's centre, as a function of altitude.
    nearest = (EARTH_RADIUS_M + at) * np.sqrt(np.maximum(1.0 - np.square(np.minimum(cosine, 1.0)), 0.0))
    low = np.where(cosine < 0.0, np.clip(nearest - EARTH_RADIUS_M, 0.0, at), at)
    # Down to the nearest point, if the ray goes down, and up from there: even in distance about that point.
    down = low[..., None] + (at - low)[..., None] * np.linspace(1.0, 0.0, 2 * _DESCENT_STEPS + 1) ** 2
    height = np.log1p(np.stack([low, np.broadcast_to(np.maximum(top, low), low.shape)], -1) / _OUTWARD_SCALE_M)
    part = np.linspace(0.0, 1.0, 2 * _OUTWARD_STEPS + 1) ** 2
    up = _OUTWARD_SCALE_M * np.expm1(height[..., :1] + (height[..., 1:] - height[..., :1]) * part)
    altitude = np.concatenate([down, up[:, 1:]], axis=-1)
    # (R + z)² − nearest², without its cancellation.
    square = (altitude - low[:, None]) * (2.0 * EARTH_RADIUS_M + altitude + low[:, None])
    square += np.square((EARTH_RADIUS_M + low) * np.maximum(cosine, 0.0))[:, None]
    length = np.abs(np.diff(np.sqrt(square), axis=-1))
    return altitude, length
