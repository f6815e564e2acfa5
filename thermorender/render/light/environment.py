"""Light on faces from beyond a scene's surfaces: the sky by zenith angle and altitude, the surroundings, the sun."""

from dataclasses import dataclass, replace

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from thermorender.atmosphere.model import Atmosphere
from thermorender.physics import sun
from thermorender.render.air import altitude
from thermorender.render.arrays import Floats, opaque_vector
from thermorender.render.geometry import Geometry
from thermorender.render.light import contacts, radiosity
from thermorender.render.plan import Plan
from thermorender.scene.scene import Scene

# Levels between which the sky changes linearly with altitude, at most this far apart [m].
_LEVEL_M = 250.0
_NODE, _WEIGHT = np.polynomial.legendre.leggauss(4)
# Points of a face from which rays test for the sun, and faces handled at a time.
SUN_POINTS = 4
_FACES_AT_ONCE = 1 << 19
_ALL = slice(None)


@dataclass(frozen=True)
class Sunlight:
    """The sun's light on the scene."""

    towards: Floats  # (3,) to the sun
    facing: Floats  # (N,) irradiance of a face towards it, over π, at the spectral nodes [W m⁻² sr⁻¹]
    lit: Floats  # (F,) irradiance of each face over that of a face towards it

    def on(self, part: slice | NDArray[np.integer]) -> Floats:
        """Return the irradiance of a part of the faces over π, (n, N) [W m⁻² sr⁻¹]."""
        found: Floats = self.lit[part, None] * self.facing
        return found


@dataclass(frozen=True)
class Environment:
    """Light from beyond the surfaces, at the spectral nodes [W m⁻² sr⁻¹]."""

    sky: Floats  # (A, B, N) at each level of altitude, in each of `radiosity.SKY_BINS` bins of zenith angle
    level: Floats  # (F, A) interpolation weight of each level at a face's altitude
    background: Floats  # (N,) surroundings below the horizon
    sun: Sunlight | None = None  # where included

    def light(self, up: Floats, down: Floats, part: slice | NDArray[np.integer] = _ALL) -> Floats:
        """Return the radiance without sunlight on a part of the faces, (n, N), from fractions of sky (n, B) and
        background (n,). It is linear, so differences of fractions are valid too."""
        total = down[:, None] * self.background
        for level, sky in zip(self.level[part].T, self.sky, strict=True):
            total += level[:, None] * (up @ sky)
        return total

    def received(self, transport: radiosity.Transport, part: slice) -> tuple[Floats, Floats]:
        """Return (light that the rays of some faces receive, half the difference of its two halves), (n, N) each [W m⁻²
        sr⁻¹]."""
        up, down = transport.up[part].astype(np.int32), transport.down[part].astype(np.int32)
        rays = 2.0 * transport.rays
        whole = self.light((up[:, 0] + up[:, 1]) / rays, (down[:, 0] + down[:, 1]) / rays, part)
        if self.sun is not None:
            whole += self.sun.on(part)
        return whole, self.light((up[:, 0] - up[:, 1]) / rays, (down[:, 0] - down[:, 1]) / rays, part)

    def at(self, nodes: slice) -> "Environment":
        """Return the Environment at a slice of the nodes."""
        sun = None if self.sun is None else replace(self.sun, facing=self.sun.facing[nodes])
        return Environment(self.sky[..., nodes], self.level, self.background[nodes], sun)


def even(sky: Floats, background: Floats, faces: int) -> Environment:
    """Return the Environment of a sky of equal radiance (N,) in all directions, for a number of faces."""
    bins = np.broadcast_to(sky, (1, radiosity.SKY_BINS, len(sky)))
    return Environment(bins, np.ones((faces, 1)), np.asarray(background))


def of_scene(scene: Scene, plan: Plan, geometry: Geometry, touching: NDArray[np.integer]) -> Environment:
    """Return the Environment of a scene's faces; those `touching` something solid are as of `radiosity.Transport`."""
    spectrum = plan.spectrum
    background = spectrum.black([scene.surroundings_temperature])[0]
    if scene.air is None:
        return even(spectrum.black([scene.sky_temperature])[0], background, geometry.face_count)
    middle = np.concatenate([s.vertices[s.faces].mean(axis=1) for s in geometry.surfaces])
    height = altitude(middle, scene.altitude_m, geometry.radius_m)
    low, high = float(height.min()), float(height.max())
    levels = np.linspace(low, high, 1 + max(1, int(np.ceil((high - low) / _LEVEL_M))))
    position = (height - low) / max(high - low, 1e-9) * (len(levels) - 1)
    level = np.maximum(1.0 - np.abs(position[:, None] - np.arange(len(levels))), 0.0)
    sky = np.stack([spectrum.of_air(sky_bins(scene.air, at)) for at in levels])
    if not plan.sun:
        return Environment(sky, level, background)
    assert scene.sun is not None
    towards = sun.direction(scene.sun.elevation_deg, scene.sun.azimuth_deg)
    facing = spectrum.gathered(spectrum.points.sunlight(low, towards[2])) / np.pi
    return Environment(sky, level, background, Sunlight(towards, facing, _sunlit(geometry, towards, touching)))


def sky_bins(air: Atmosphere, at_m: float) -> Floats:
    """Return the sky's mean radiance over each bin of zenith angle, (B, n) [W m⁻² sr⁻¹]. The weights are halfway
    between those of a wall (solid angle) and of level ground (cosine). Light on either, and on slopes, is then within
    30 mK of a blackbody of 280 K."""
    edge = radiosity.sky_edges()
    half, middle = 0.5 * np.diff(edge)[:, None], 0.5 * (edge[1:] + edge[:-1])[:, None]
    cosine = middle + half * _NODE
    weight = _WEIGHT * np.sqrt(cosine)
    return (weight[..., None] * air.sky_radiance(at_m, cosine)).sum(axis=1) / weight.sum(axis=1, keepdims=True)


def _sunlit(geometry: Geometry, towards: Floats, touching: NDArray[np.integer]) -> Floats:
    """The sun's irradiance on each face over that of a plane normal to its rays, (F,)."""
    mi = geometry.mi
    rays_of, seen = radiosity.FaceRays(geometry, SUN_POINTS // 2), np.empty(geometry.face_count)
    if len(touching):
        rays_of.start_in_the_open(contacts.solid(geometry), touching)
    direction = opaque_vector(mi, towards)
    for first in range(0, geometry.face_count, _FACES_AT_ONCE):
        count = min(_FACES_AT_ONCE, geometry.face_count - first)
        # Opaque: a literal would compile the kernel again for each part.
        origin, _, _, normal = rays_of(dr.arange(mi.UInt32, count) + dr.opaque(mi.UInt32, first), 0)
        cosine = dr.dot(normal, direction)
        lit = dr.maximum(cosine, 0.0) * geometry.sunlight(origin, towards, cosine > 0.0)
        seen[first : first + count] = np.array(lit).reshape(count, -1).mean(axis=1)
    return seen
