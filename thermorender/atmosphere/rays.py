"""Rays through the air in steps: straight lines above a sphere, and the altitudes along them.

Chords of a sphere treat level paths like all others. The Earth's radius includes refraction.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

# The mean radius is divided by 1 minus the mean refraction coefficient near the ground, 0.13 (Gauss). A straight ray
# above a sphere of that radius has the altitudes of the refracted ray.
MEAN_RADIUS_M = 6.371e6
EARTH_RADIUS_M = MEAN_RADIUS_M / (1.0 - 0.13)
# Top of the air [m].
TOP_M = 1.0e5
# Longest unobstructed line between two points in the air [m].
LONGEST_M = 2.0 * float(np.sqrt((EARTH_RADIUS_M + TOP_M) ** 2 - EARTH_RADIUS_M**2))
# Steps of a path are uniform in ln(this + altitude).
_SCALE_M = 3.0e3
_FEWEST_STEPS = 3
# Steps of a ray that leaves the air, and of its part down to its lowest point. They err by
# up to 7 mK of the sky at 285 K (tropical air, straight up).
_OUTWARD_STEPS = 24
_DESCENT_STEPS = 8
# Scale of the denser steps of such a ray near its lowest point.
_OUTWARD_SCALE_M = 2.0e3


def horizon_cos_zenith(at_m: ArrayLike) -> Floats:
    """Return the cosine of the zenith angle of the sea-level horizon seen from altitudes [m]; 0 from the ground."""
    ratio = EARTH_RADIUS_M / (EARTH_RADIUS_M + np.maximum(np.asarray(at_m, dtype=np.float64), 0.0))
    return -np.sqrt(1.0 - np.square(ratio))


def chord(first: Floats, last: Floats, distance: Floats, step: float) -> tuple[Floats, Floats]:
    """Return (altitudes (P, 2 M + 1), lengths (P, 2 M)) [m] of the half steps of paths between two altitudes.

    `step` is the largest one in ln(3 km + altitude). Altitude at a part f of a chord of length d: r² = (1 − f) r₁² + f
    r₂² − f (1 − f) d² (Stewart's theorem).
    """
    # The altitude above the lower end is a g + b g², with g the part of the path from there. Steps are uniform in
    # ln(scale + altitude), but uniform in g for a path that dips below both ends (a < 0), as it is nearly level.
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


def outward(at: Floats, cosine: Floats, top: float) -> tuple[Floats, Floats]:
    """Return (altitudes (P, 2 M + 1), lengths (P, 2 M)) [m] of the half steps of rays that leave the air at `top` [m].

    `at` and `cosine` (P,) are the observer's altitude [m], not below 0, and the cosine of the zenith angle, not below
    the horizon; rays of an observer above `top` have length 0.
    """
    # Smallest distance of the ray's line from the Earth's centre.
    nearest = (EARTH_RADIUS_M + at) * np.sqrt(np.maximum(1.0 - np.square(np.minimum(cosine, 1.0)), 0.0))
    low = np.where(cosine < 0.0, np.clip(nearest - EARTH_RADIUS_M, 0.0, at), at)
    # Down to the nearest point, if the ray goes down, and up from there; steps are uniform in distance near that point.
    down = low[..., None] + (at - low)[..., None] * np.linspace(1.0, 0.0, 2 * _DESCENT_STEPS + 1) ** 2
    height = np.log1p(np.stack([low, np.broadcast_to(np.maximum(top, low), low.shape)], -1) / _OUTWARD_SCALE_M)
    part = np.linspace(0.0, 1.0, 2 * _OUTWARD_STEPS + 1) ** 2
    up = _OUTWARD_SCALE_M * np.expm1(height[..., :1] + (height[..., 1:] - height[..., :1]) * part)
    altitude = np.concatenate([down, up[:, 1:]], axis=-1)
    # (R + z)² − nearest², without cancellation.
    square = (altitude - low[:, None]) * (2.0 * EARTH_RADIUS_M + altitude + low[:, None])
    square += np.square((EARTH_RADIUS_M + low) * np.maximum(cosine, 0.0))[:, None]
    length = np.abs(np.diff(np.sqrt(square), axis=-1))
    return altitude, length
