"""Radiance of crowns along rays: sunlit and shaded leaves, by their depth.

Leaves in the sun are warmer than leaves in the shade. The share of sunlit leaves at a point is the transmittance
towards the sun: exact in the own crown, and interpolated in a lattice for what else is in the way. Thin leaves of all
orientations that are in the sun and seen at a phase angle g have 8/(3π) (sin g + (π/2 − |g|) cos g) of their mean
excess, since those that face the sun are warmest (mean of |n·s||n·v| over all normals n).
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from thermorender.physics import sun
from thermorender.render.arrays import Channels, Floats, Jit, aligned, opaque_vector
from thermorender.render.geometry import Geometry
from thermorender.render.plan import Plan
from thermorender.render.turbid import Chord, CrownField, State, UnitBody
from thermorender.scene.crowns import PATCHES, QUARTERS
from thermorender.scene.scene import Scene

if TYPE_CHECKING:
    from thermorender.render.layers import OutgoingRadiance

# Points of the lattice along each axis of a crown.
_LATTICE = 5
# Leaves of a patch that give its mean sunlight.
_LEAVES = 64
# Heights of the means of an upper half of the core and of the shell, of a ball and of a cube, in half-heights: those of
# the whole half are 3/8 and 1/2, and the core has half of the volume.
_CORE = 0.5 ** (1.0 / 3.0)
_MEAN_HEIGHTS = tuple((whole * _CORE, whole * (2.0 - _CORE)) for whole in (0.375, 0.5))
# Points of a chord, by the share of its opacity (Gauss-Legendre).
_PLACES = 0.2113248654, 0.7886751346
# Least share of shaded leaves, by which the difference of sunlit and mean leaves is divided.
_LEAST_SHADED = 0.05
# A ray that passes less than this share is stopped.
_NO_LEAVES = 1e-3


@dataclass(frozen=True)
class Along:
    """Leaves along rays: Dr.Jit arrays, one entry per ray."""

    passed: Jit  # share of light that passes
    distance: Jit  # mean distance of the leaves seen [m]; 0 without
    channels: list[Jit]  # mean radiance of the leaves seen; 0 without


class InCrown(NamedTuple):
    """Weights of the quarters of a crown at points, linear in height and in the volume nearer to the middle."""

    shell: Jit
    core_upper: Jit
    shell_upper: Jit

    @classmethod
    def of(cls, body: UnitBody, at: Jit) -> "InCrown":
        """Return the InCrown of points in the frames of crowns; beyond the means of quarters it is extrapolated."""
        ball, cube = _MEAN_HEIGHTS
        upper = (0.5 + 0.5 * at.z / dr.select(body.box, b, a) for a, b in zip(ball, cube, strict=True))
        return cls(2.0 * body.inner(at) - 0.5, *upper)

    def between(self, core_lower: Jit, core_upper: Jit, shell_lower: Jit, shell_upper: Jit) -> Jit:
        """Return the value at points of values that quarters have in the mean."""
        core = dr.lerp(core_lower, core_upper, self.core_upper)
        return dr.lerp(core, dr.lerp(shell_lower, shell_upper, self.shell_upper), self.shell)


class SunlitLeaves:
    """The sunlit leaves of a scene's crowns, whose temperatures are solved; `towards` (3,) points to the sun."""

    def __init__(self, scene: Scene, plan: Plan, geometry: Geometry, towards: Floats) -> None:
        field, mi = geometry.crowns, geometry.mi
        assert field is not None
        self._mi, self._geometry = mi, geometry
        self._sun, self._towards = towards, opaque_vector(mi, towards)
        self._others = mi.Float(aligned(self._lattice(field)))
        lit = self._means(field)
        table, first = [], 0
        for number, crowns in zip(field.numbers, field.crowns, strict=True):
            surface, mean = scene.surfaces[number], lit[first : first + len(crowns)]
            count = PATCHES * len(crowns)
            first += len(crowns)
            # Both sides of a leaf are equally warm.
            warm, warmer = (
                np.zeros((len(crowns), QUARTERS)) if each is None
                else each.reshape(-1)[:count].reshape(-1, QUARTERS, 2).mean(axis=2).astype(np.float64)
                for each in (surface.temperature, surface.scatter_k)
            )  # fmt: skip
            contrast = warmer / np.maximum(1.0 - mean, _LEAST_SHADED)
            shaded = warm - mean * contrast
            emits = scene.materials[surface.material.flat[0]].emissivity_at
            grid, of = plan.spectrum.emitted(emits, float(shaded.min()), float((shaded + contrast).max()), plan.band_um)
            more = [np.interp(shaded + contrast, grid, each) - np.interp(shaded, grid, each) for each in of.T]
            table.append(np.concatenate([mean, *more], axis=1))
        whole = np.concatenate(table)
        self._quarters = Channels(mi, whole)
        self._largest = np.abs(whole[:, QUARTERS:]).max(axis=0).reshape(-1, QUARTERS).max(axis=1)

    def _lattice(self, field: CrownField) -> NDArray[np.float32]:
        """Share of sunlight that other things than the own crown pass, (n × _LATTICE³,), the last axis fastest."""
        line = np.linspace(-1.0, 1.0, _LATTICE)
        unit = np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1).reshape(-1, 3)
        found = []
        for crown, point in self._points(field, unit):
            own = dr.exp(-self._own_depth(field.frame(crown), field.frame(crown).point(point)))
            light = self._geometry.sunlight(point, self._sun)
            found.append(np.array(dr.minimum(light / dr.maximum(own, 1e-6), 1.0)))
        return np.concatenate(found)

    def _means(self, field: CrownField) -> Floats:
        """Mean share of sunlit leaves in the quarters of each crown, (n, QUARTERS)."""
        found = []
        for crowns, (crown, point) in zip(field.crowns, self._points(field), strict=True):
            frame = field.frame(crown)
            share = np.array(self._share(crown, frame, frame.point(point), True), np.float64)
            found.append(share.reshape(len(crowns), QUARTERS, _LEAVES).mean(axis=2))
        return np.concatenate(found)

    def _points(self, field: CrownField, unit: Floats | None = None) -> Iterator[tuple[Jit, Jit]]:
        """Yield (numbers of crowns, points), one after another crown: points `unit` (m, 3) in their frames, or leaves,
        one quarter after another."""
        mi, first = self._mi, 0
        for crowns in field.crowns:
            # Sides that face up and down are those of the same leaves.
            own = crowns.leaves(_LEAVES)[0][::2].reshape(-1, 3) if unit is None else unit
            place = np.einsum("nij,nvj->nvi", crowns.axes, own * crowns.half[:, None]) + crowns.middle[:, None]
            crown = np.repeat(first + np.arange(len(crowns)), len(own))
            yield mi.UInt32(aligned(crown, np.uint32)), mi.Point3f(*map(aligned, place.reshape(-1, 3).T))
            first += len(crowns)

    def _own_depth(self, frame: UnitBody, at: Jit) -> Jit:
        """Optical depth of the own crown from points in its frame towards the sun."""
        start, end = frame.chord(at, frame.vector(self._towards))
        return frame.extinction * dr.maximum(end - dr.maximum(start, 0.0), 0.0)

    def _share(self, crown: Jit, frame: UnitBody, at: Jit, active: Jit) -> Jit:
        """Share of leaves in the sun at points in the frames of crowns."""
        mi = self._mi
        cell = dr.clip((at + 1.0) * (0.5 * (_LATTICE - 1)), 0.0, _LATTICE - 1.001)
        low = mi.Vector3u(cell)
        part = cell - mi.Vector3f(low)
        base = ((crown * _LATTICE + low.x) * _LATTICE + low.y) * _LATTICE + low.z
        edges = []
        for step in (0, _LATTICE, _LATTICE**2, _LATTICE**2 + _LATTICE):
            ends = (dr.gather(mi.Float, self._others, base + (step + k), active) for k in (0, 1))
            edges.append(dr.lerp(*ends, part.z))
        others = dr.lerp(dr.lerp(edges[0], edges[1], part.y), dr.lerp(edges[2], edges[3], part.y), part.x)
        return others * dr.exp(-self._own_depth(frame, at))

    def scatter(self, weight: Floats) -> float:
        """Return the largest standard deviation of radiance over leaves in and out of the sun, of all orientations;
        `weight` (K,) is of the channels."""
        # Half of the leaves in the sun: 1/2 (1 − 1/2) of sun and shade, and a third by the variance of 2 |n·s|.
        return float(np.sqrt(0.25 + 1.0 / 6.0) * (self._largest @ weight))

    def phase(self, direction: Jit) -> Jit:
        """Return the excess of the sunlit leaves that rays of a direction meet, relative to their mean."""
        cosine = dr.minimum(dr.abs(dr.dot(direction, self._towards)), 1.0)
        angle = dr.safe_acos(cosine)
        return 8.0 / (3.0 * np.pi) * (dr.safe_sqrt(1.0 - cosine * cosine) + (0.5 * np.pi - angle) * cosine)

    def quarters(self, chord: Chord) -> list[Jit]:
        """Return what `added` needs of the crowns of chords."""
        return self._quarters.at(chord.crown, chord.new)

    def added(self, chord: Chord, quarters: list[Jit], at: Jit, place: "InCrown", phase: Jit) -> list[Jit]:
        """Return what the sunlit leaves at points of chords add to the mean of leaves at their place, [Float]."""
        parts = [quarters[k : k + QUARTERS] for k in range(0, len(quarters), QUARTERS)]
        mean, *more = (place.between(*part) for part in parts)
        excess = phase * self._share(chord.crown, chord.frame, at, chord.new) - mean
        return [excess * each for each in more]


def sunlit_leaves(scene: Scene, plan: Plan, geometry: Geometry) -> SunlitLeaves | None:
    """Return the SunlitLeaves of a scene; None where no crown has leaves that the sun warms."""
    if geometry.crowns is None or scene.spec.weather is None or scene.time is None:
        return None
    azimuth, elevation = scene.weather.sun(scene.time)
    spread = [scene.surfaces[number].scatter_k for number in geometry.crowns.numbers]
    if elevation <= 0.0 or not any(each is not None and each.any() for each in spread):
        return None
    return SunlitLeaves(scene, plan, geometry, sun.direction(float(elevation), float(azimuth)))


def along(geometry: Geometry, outgoing: "OutgoingRadiance", ray: Jit, until: Jit, walk: Callable[..., State]) -> Along:
    """Return what rays see of the crowns up to `until` [m]; `walk` is as of `CrownField`."""
    field, mi, leaves = geometry.crowns, geometry.mi, outgoing.leaves
    assert field is not None
    phase = leaves.phase(ray.d) if leaves else None
    # Sides that are seen face the camera, and see more of what is behind it than others: where light is linear in the
    # direction, their mean is 4/9 of its change to the mean of all, against 1/3 of sides that face up.
    up = 0.5 - 2.0 / 3.0 * ray.d.z
    tables = outgoing.patches(geometry)

    def visit(chord: Chord, state: State) -> tuple[Jit, State]:
        passed, distance, *total = state
        lost = dr.select(chord.new, 1.0 - dr.exp(-chord.depth), 0.0)
        quarters = []
        for table in tables:
            core, shell = (dr.gather(mi.Vector4f, table, 2 * chord.crown + k, chord.new) for k in (0, 1))
            quarters.append([dr.lerp(*each, up) for part in (core, shell) for each in (part.xy, part.zw)])
        warmer = leaves.quarters(chord) if leaves else []
        weight = 0.5 * passed * lost
        for place in _PLACES:
            depth = -dr.log(dr.maximum(1.0 - place * lost, 1e-7))
            length = dr.select(chord.new, chord.start + depth / chord.frame.extinction, 0.0)
            at = chord.at + length * chord.way
            where = InCrown.of(chord.frame, at)
            values = [where.between(*each) for each in quarters]
            if leaves:
                more = leaves.added(chord, warmer, at, where, phase)
                values = [a + b for a, b in zip(values, more, strict=True)]
            total = [t + dr.select(chord.new, weight * value, 0.0) for t, value in zip(total, values, strict=True)]
            distance = distance + weight * length
        left = passed * (1.0 - lost)
        return left > _NO_LEAVES, (left, distance, *total)

    width = dr.width(ray.d)
    begin = (dr.full(mi.Float, 1.0, width), *(dr.zeros(mi.Float, width) for _ in range(1 + outgoing.channels)))
    passed, distance, *channels = walk(ray, until, True, begin, visit)
    share = dr.maximum(1.0 - passed, 1e-12)
    return Along(passed, distance / share, [each / share for each in channels])
