"""Radiance of air by brute force, from the table's numbers alone, which frames through air are compared with.

A ray is a straight line above a sphere of the Earth's radius over 0.87 (refraction), cut into a thousand steps. At each
step, densities are interpolated between the table's own levels, depth is summed by the trapezoidal rule, and light is
Planck's law times the absorption in that step. The model only provides its arrays.
"""

import numpy as np

from thermorender.physics.planck import C2, band_radiance

RADIUS_M = 6.371e6 / 0.87
TOP_M = 1.0e5
STEPS = 1000


def planck(air, temperature):
    """Blackbody radiance of each node at temperatures (T,), (T, N): the sub-band's integral times the node's share."""
    temperature = np.atleast_1d(np.asarray(temperature, dtype=float))[:, None]
    powers = air.tilt.shape[1]
    warmth = C2 * (1.0 / 285.0 - 1.0 / (temperature if powers == 1 else np.clip(temperature, 160.0, 6000.0)))
    share = air.weight * np.exp(sum(air.tilt[:, k] * warmth ** (k + 1) for k in range(powers)))
    result = np.empty_like(share)
    for lower, upper in {*zip(air.lower_um, air.upper_um, strict=True)}:
        own = air.lower_um == lower
        result[:, own] = (
            share[:, own] / share[:, own].sum(axis=1, keepdims=True) * band_radiance(temperature, lower, upper)
        )
    return result


def along(air, altitude, distance):
    """(transmittance (N,), light (N,)) of the air between points of a ray at altitudes (n,), distances (n,)."""
    density = np.empty((len(air.density), len(altitude)))
    above = np.clip(np.searchsorted(air.altitude_m, altitude, side="right"), 1, len(air.altitude_m) - 1)
    for row, levels in zip(density, air.density, strict=True):
        row[:] = np.interp(altitude, air.altitude_m, levels)
        falls = (levels[above - 1] > 0.0) & (levels[above] > 0.0)
        row[falls] = np.exp(np.interp(altitude[falls], air.altitude_m, np.log(np.maximum(levels, 1e-300))))
    extinction = air.absorption @ density
    depth = np.cumsum(0.5 * (extinction[:, 1:] + extinction[:, :-1]) * np.diff(distance), axis=1)
    passed = np.exp(-np.concatenate([np.zeros((len(depth), 1)), depth], axis=1))
    source = planck(air, np.interp(altitude, air.altitude_m, air.temperature)).T
    light = np.sum(0.5 * (source[:, 1:] + source[:, :-1]) * -np.diff(passed, axis=1), axis=1)
    return passed[:, -1], light


def between(air, from_m, to_m, length):
    """(transmittance, light) of a straight path between two altitudes, of a length [m]."""
    near, far = RADIUS_M + from_m, RADIUS_M + to_m
    # In the triangle of the Earth's centre and both ends: cosine at the first end.
    cosine = (near**2 + length**2 - far**2) / (2.0 * near * length)
    return along(air, *_points(from_m, -cosine, length * np.linspace(0.0, 1.0, STEPS)))


def outward(air, at_m, cosine):
    """(transmittance, light) of a ray from an altitude to the top of the air; cosine of its zenith angle."""
    near = (RADIUS_M + at_m) * cosine
    length = -near + np.sqrt(near**2 + (RADIUS_M + TOP_M) ** 2 - (RADIUS_M + at_m) ** 2)
    return along(air, *_points(at_m, cosine, length * np.linspace(0.0, 1.0, STEPS) ** 3))


def _points(at_m, cosine, distance):
    """(altitudes, distances) of points of a ray: r² = (R + z)² + s² + 2 (R + z) s cosθ, without its cancellation."""
    square = distance**2 + 2.0 * (RADIUS_M + at_m) * distance * cosine
    return at_m + square / (np.sqrt((RADIUS_M + at_m) ** 2 + square) + RADIUS_M + at_m), distance


def sky_mean(air, at_m, directions=14):
    """E/π of the sky on level ground, (N,): the mean of its radiance over directions uniform in cos²θ."""
    root, weight = np.polynomial.legendre.leggauss(directions)
    cosine = np.square(0.5 * (root + 1.0))
    # 2 cosθ d(cosθ) with cosθ = u².
    return sum(0.5 * w * 4.0 * c**1.5 * outward(air, at_m, c)[1] for w, c in zip(weight, cosine, strict=True))
