"""Radiance of crowns along rays: sunlit and shaded leaves, by their depth.

Leaves in the sun are warmer than leaves in the shade. The share of sunlit leaves at a point is the transmittance
towards the sun: exact in the own crown, and interpolated in a lattice for what else is in the way. Thin leaves of all
orientations that are in the sun and seen at a phase angle g have 8/(3π) (sin g + (π/2 − |g|) cos g) of their mean
excess, since those that face the sun are warmest (mean of |n·s||n·v| over all normals n).
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from thermorender.physics import sun
from thermorender.render.arrays import Channels, Floats, Jit, aligned
from thermorender.render.geometry import Geometry
from thermorender.render.plan import Plan
from thermorender.render.turbid import Chord
from thermorender.scene.crowns import PATCHES
from thermorender.scene.scene import Scene

if TYPE_CHECKING:
    from thermorender.render.layers import OutgoingRadiance

# Points of the lattice along each axis of a crown.
_LATTICE = 5
# Leaves of a patch that give its mean sunlight.
_LEAVES = 64
# Height of the mean of a half of a ball and of a cube, in half-heights.
_MEAN_HEIGHT = 0.375, 0.5
# Points of a chord, by the share of its opacity (Gauss-Legendre).
_PLACES = 0.2113248654, 0.7886751346
# Least share of shaded leaves, by which the difference of sunlit and mean leaves is divided.
_LEAST_SHADED = 0.05
_NO_LEAVES = 1e-4


@dataclass(frozen=True)
class Along:
    """Leaves along rays: Dr.Jit arrays, one entry per ray."""

    passed: Jit  # share of light that passes
    distance: Jit  # mean distance of the leaves seen [m]; 0 without
    channels: list[Jit]  # mean radiance of the leaves seen; 0 without
    crown: Jit  # UInt32, the crown in which half of the light is lost; 0 without


class SunlitLeaves:
    """The sunlit leaves of a scene's crowns, whose temperatures are solved."""

    def __init__(self, scene: Scene, plan: Plan, geometry: Geometry) -> None:
        field, mi = geometry.crowns, geometry.mi
        assert field is not None and scene.sun is not None
        self._mi, self._geometry = mi, geometry
        towards = sun.direction(scene.sun.elevation_deg, scene.sun.azimuth_deg)
        self._towards = mi.Vector3f(*(dr.opaque(mi.Float, float(value)) for value in towards))
        self._others = mi.Float(aligned(self._lattice()))
        lit = self._means().reshape(-1, 2)
        table = []
        first = 0
        for number, crowns in zip(field.numbers, field.crowns, strict=True):
            surface, own = scene.surfaces[number], np.repeat(lit[first : first + len(crowns)], 2, axis=1).reshape(-1)
            first += len(crowns)
            count = PATCHES * len(crowns)
            warmer = np.zeros(count) if surface.scatter_k is None else surface.scatter_k.reshape(-1)[:count]
            mean = surface.temperature.reshape(-1)[:count].astype(np.float64)
            contrast = warmer / np.maximum(1.0 - own, _LEAST_SHADED)
            shaded = mean - own * contrast
            emits = scene.materials[surface.material.flat[0]].emissivity_at
            grid, of = plan.spectrum.emitted(emits, float(shaded.min()), float((shaded + contrast).max()), plan.band_um)
            more = [np.interp(shaded + contrast, grid, each) - np.interp(shaded, grid, each) for each in of.T]
            # Both sides of a leaf are equally warm.
            table.append(np.stack(more, axis=-1).reshape(-1, 2, 2, len(more)).mean(axis=2).reshape(-1, 2 * len(more)))
        self._more = Channels(mi, np.concatenate(table))
        self._mean = Channels(mi, lit)

    def _lattice(self) -> NDArray[np.float32]:
        """Share of sunlight that other things than the own crown pass, (n × _LATTICE³,), the last axis fastest."""
        field, mi = self._geometry.crowns, self._mi
        assert field is not None
        line = np.linspace(-1.0, 1.0, _LATTICE)
        unit = np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1).reshape(-1, 3)
        found = []
        first = 0
        for crowns in field.crowns:
            place = np.einsum("nij,nvj->nvi", crowns.axes, unit * crowns.half[:, None]) + crowns.middle[:, None]
            point = mi.Point3f(*map(aligned, place.reshape(-1, 3).T))
            crown = mi.UInt32(aligned(np.repeat(first + np.arange(len(crowns)), len(unit)), np.uint32))
            ray = mi.Ray3f(point, self._towards)
            own = dr.exp(-self._own_depth(crown, point, True))
            found.append(np.array(dr.minimum(self._geometry.sunlight(ray) / dr.maximum(own, 1e-6), 1.0)))
            first += len(crowns)
        return np.concatenate(found)

    def _own_depth(self, crown: Jit, point: Jit, active: Jit) -> Jit:
        """Optical depth of the own crown from points towards the sun."""
        field = self._geometry.crowns
        assert field is not None
        start, end = field.chord(crown, point, self._towards, active)
        length = dr.maximum(end - dr.maximum(start, 0.0), 0.0)
        return field.extinction(crown, active) * length

    def share(self, crown: Jit, point: Jit, active: Jit) -> Jit:
        """Return the share of leaves in the sun at points of crowns, Float."""
        field, mi = self._geometry.crowns, self._mi
        assert field is not None
        at, _ = field.local(crown, point, self._towards, active)
        cell = dr.clip((at + 1.0) * (0.5 * (_LATTICE - 1)), 0.0, _LATTICE - 1.001)
        low = mi.Vector3u(cell)
        part = cell - mi.Vector3f(low)
        others: Jit = mi.Float(0.0)
        for k in range(8):
            corner = [(k >> axis) & 1 for axis in range(3)]
            index = ((crown * _LATTICE + low.x + corner[0]) * _LATTICE + low.y + corner[1]) * _LATTICE + low.z + corner[2]
            weight: Jit = mi.Float(1.0)
            for axis, upper in enumerate(corner):
                weight = weight * (part[axis] if upper else 1.0 - part[axis])
            others += weight * dr.gather(mi.Float, self._others, index, active)
        return others * dr.exp(-self._own_depth(crown, point, active))

    def _means(self) -> Floats:
        """Mean share of sunlit leaves in the lower and the upper half of each crown, (n, 2)."""
        field, mi = self._geometry.crowns, self._mi
        assert field is not None
        found, first = [], 0
        for crowns in field.crowns:
            unit, _ = crowns.leaves(_LEAVES)
            # Sides that face up and down are those of the same leaves.
            unit = unit[::2].reshape(-1, 3)
            place = np.einsum("nij,nvj->nvi", crowns.axes, unit * crowns.half[:, None]) + crowns.middle[:, None]
            crown = mi.UInt32(aligned(np.repeat(first + np.arange(len(crowns)), len(unit)), np.uint32))
            share = np.array(self.share(crown, mi.Point3f(*map(aligned, place.reshape(-1, 3).T)), True))
            found.append(share.reshape(-1, 2, _LEAVES).mean(axis=2))
            first += len(crowns)
        return np.concatenate(found).astype(np.float64)

    def phase(self, direction: Jit) -> Jit:
        """Return the excess of the sunlit leaves that rays of a direction meet, relative to their mean."""
        cosine = dr.minimum(dr.abs(dr.dot(direction, self._towards)), 1.0)
        angle = dr.safe_acos(cosine)
        return 8.0 / (3.0 * np.pi) * (dr.safe_sqrt(1.0 - cosine * cosine) + (0.5 * np.pi - angle) * cosine)

    def added(self, chord: Chord, point: Jit, height: Jit, phase: Jit) -> list[Jit]:
        """Return what the sunlit leaves at points of chords add to the mean of leaves at their height, [Float]."""
        more, mean = self._more.at(chord.crown, chord.new), self._mean.at(chord.crown, chord.new)
        excess = phase * self.share(chord.crown, point, chord.new) - (mean[0] + height * (mean[1] - mean[0]))
        count = len(more) // 2
        return [excess * (low + height * (high - low)) for low, high in zip(more[:count], more[count:], strict=True)]


def sunlit_leaves(scene: Scene, plan: Plan, geometry: Geometry) -> SunlitLeaves | None:
    """Return the SunlitLeaves of a scene; None where no crown has leaves that the sun warms."""
    if geometry.crowns is None or scene.sun is None or scene.sun.elevation_deg <= 0.0:
        return None
    spread = [scene.surfaces[number].scatter_k for number in geometry.crowns.numbers]
    if not any(each is not None and each.any() for each in spread):
        return None
    return SunlitLeaves(scene, plan, geometry)


def along(geometry: Geometry, outgoing: "OutgoingRadiance", ray: Jit, until: Jit) -> Along:
    """Return what rays see of the crowns up to `until` [m]."""
    field, mi, leaves = geometry.crowns, geometry.mi, outgoing.leaves
    assert field is not None
    phase = leaves.phase(ray.d) if leaves else None
    up = 0.5 - 0.5 * ray.d.z
    origin, direction = mi.Point3f(ray.o), mi.Vector3f(ray.d)

    def visit(chord: Chord, state: tuple[Jit, ...]) -> tuple[Jit, tuple[Jit, ...]]:
        passed, distance, half, *total = state
        lost = dr.select(chord.new, 1.0 - dr.exp(-chord.depth), 0.0)
        texel, face = (
            dr.gather(mi.UInt32, table, chord.crown, chord.new) for table in (field.first_texel, field.first_face)
        )
        sides = [outgoing.at_texel(texel + k, face + k, chord.new) for k in range(PATCHES)]
        low, high = (
            [dr.lerp(a, b, up) for a, b in zip(*sides[k : k + 2], strict=True)] for k in (0, 2)
        )
        box = dr.gather(mi.Float, field.shapes, chord.crown, chord.new)
        per_height = 0.5 / dr.lerp(*_MEAN_HEIGHT, box)
        weight = 0.5 * passed * lost
        for place in _PLACES:
            depth = -dr.log(dr.maximum(1.0 - place * lost, 1e-7))
            length = chord.start + depth / dr.maximum(chord.extinction, 1e-30)
            point = origin + dr.select(chord.new, length, 0.0) * direction
            at, _ = field.local(chord.crown, point, direction, chord.new)
            height = 0.5 + per_height * at.z
            values = [a + height * (b - a) for a, b in zip(low, high, strict=True)]
            if leaves:
                values = [a + b for a, b in zip(values, leaves.added(chord, point, height, phase), strict=True)]
            total = [t + dr.select(chord.new, weight * value, 0.0) for t, value in zip(total, values, strict=True)]
            distance = distance + dr.select(chord.new, weight * length, 0.0)
        left = passed * (1.0 - lost)
        half = dr.select((passed >= 0.5) & (left < 0.5), chord.crown, half)
        return left > _NO_LEAVES, (left, distance, half, *total)

    width, count = dr.width(direction), outgoing.channels
    zero = [dr.zeros(mi.Float, width) for _ in range(1 + count)]
    begin = (dr.full(mi.Float, 1.0, width), zero[0], dr.zeros(mi.UInt32, width), *zero[1:])
    passed, distance, crown, *channels = field.walk(ray, until, True, begin, visit)
    share = dr.maximum(1.0 - passed, 1e-12)
    return Along(passed, distance / share, [each / share for each in channels], crown)

