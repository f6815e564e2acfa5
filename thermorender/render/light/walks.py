"""Light at single points by random walks: an independent check of the light that is solved between faces.

Walks use the temperature and material of the texels that they hit, and end where light is absorbed or at the sky. They
share the ray caster, the spectral nodes and the tables of the sky with the solution, but neither its faces of constant
light nor its rays. Their error is Monte Carlo noise.
"""

from collections.abc import Sequence

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from thermorender.materials.material import Material
from thermorender.physics.band import RadianceTable
from thermorender.render.arrays import Floats, Jit, aligned
from thermorender.render.geometry import Geometry
from thermorender.render.layers import TexelArrays
from thermorender.render.light.environment import Environment
from thermorender.render.light.radiosity import SKY_BINS, background_code
from thermorender.render.plan import Plan
from thermorender.render.sobol import sobol

# Longest walk, and bounces between looks whether any goes on.
_LONGEST, _LOOK = 256, 4
_SEED = 0x3A1C
# Entries of the table of nodes.
_TABLE = 1024


class Walks:
    """Random walks in a scene with `texels` in the light `around` it, without its moving objects."""

    def __init__(
        self, materials: Sequence[Material], plan: Plan, geometry: Geometry, around: Environment, texels: TexelArrays
    ) -> None:
        self._materials, self._plan, self._emitted = materials, plan, dict[int, tuple[Floats, Floats]]()
        self._geometry, self._texels = geometry, texels
        mi, spectrum = geometry.mi, plan.spectrum
        grid = RadianceTable.grid(plan.coldest, plan.warmest)
        self._grid = tuple(dr.opaque(mi.Float, float(v)) for v in (grid[0], grid[1] - grid[0], len(grid) - 2))
        self._size = dr.opaque(mi.UInt32, len(grid))
        self._black = mi.Float(aligned(spectrum.black(grid).T))
        self._nodes = dr.opaque(mi.UInt32, spectrum.nodes)
        # A spare row: an array of one entry is a constant to Dr.Jit, and another kernel.
        self._emissivity = mi.Float(aligned(np.vstack([spectrum.emissivity, np.zeros(spectrum.nodes)])))
        # The sky's bins followed by the surroundings, for each level of altitude; a face lies between two of them.
        levels = around.sky.shape[0]
        beyond = np.concatenate([around.sky, np.broadcast_to(around.background, (levels, 1, spectrum.nodes))], axis=1)
        self._beyond = mi.Float(aligned(beyond))
        position = around.level @ np.arange(levels)
        self._level, self._last = mi.Float(aligned(position)), dr.opaque(mi.UInt32, levels - 1)
        self._direct = None if around.sun is None else mi.Float(aligned(around.sun.on(slice(None))))
        # Walks choose their node from this table, each at least once.
        black = spectrum.black([plan.warmest])[0]
        number = np.maximum(np.rint(_TABLE * black / black.sum()).astype(int), 1)
        self._node = mi.UInt32(aligned(np.repeat(np.arange(spectrum.nodes), number), np.uint32))
        self._choices = dr.opaque(mi.UInt32, int(number.sum()))
        self.share = number / number.sum()

    def incident(self, point: Jit, face: Jit, normal: Jit, walks: int) -> tuple[Floats, NDArray[np.uint32]]:
        """Return (radiance that falls on n points, of a node over its `share` [W m⁻² sr⁻¹]; node of each walk), (n,
        walks) each."""
        mi, geometry = self._geometry.mi, self._geometry
        count = len(face)
        index = dr.arange(mi.UInt32, count * walks)
        row, number = index // walks, index % walks
        shifts = (*mi.sample_tea_32(row, _SEED, 8), mi.sample_tea_32(row, _SEED + 1, 8)[0])
        columns = (mi.UInt32(aligned(column * 2.0**24, np.uint32)) for column in sobol(3, walks).T)
        u = [
            mi.Float(dr.gather(mi.UInt32, column, number) ^ (shift >> 8)) * 2.0**-24
            for column, shift in zip(columns, shifts, strict=True)
        ]
        node = dr.gather(
            mi.UInt32, self._node, dr.minimum(mi.UInt32(u[2] * mi.Float(self._choices)), self._choices - 1)
        )
        random = mi.PCG32(count * walks, initstate=_SEED)
        at, side, here = (dr.gather(kind, values, row) for kind, values in (
            (mi.Point3f, point), (mi.Vector3f, normal), (mi.UInt32, face)
        ))  # fmt: skip
        total = self._sun(here, node)
        walking = dr.full(mi.Bool, True, count * walks)
        towards = mi.Frame3f(side).to_world(mi.warp.square_to_cosine_hemisphere(mi.Point2f(u[0], u[1])))
        for step in range(_LONGEST):
            ray = mi.Ray3f(at + geometry.lift(at) * side, towards)
            hit, normal = geometry.cast_with_normal(ray, walking)
            total += dr.select(walking & ~hit.valid, self._outside(here, towards, node), 0.0)
            walking &= hit.valid
            behind = dr.dot(normal, towards)
            # Continue on the side that was hit; the solution gives a back its front's light instead.
            here, side, at = hit.face, -dr.mulsign(normal, behind), mi.Point3f(ray.o + hit.distance * towards)
            place = geometry.map_position(geometry.record(here, walking), at)
            texel = geometry.nearest(hit.surface, *place, walking)
            material = mi.UInt32(dr.gather(type(self._texels.material), self._texels.material, texel, walking))
            epsilon = dr.gather(mi.Float, self._emissivity, material * self._nodes + node, walking)
            warm = dr.gather(mi.Float, self._texels.temperature, texel, walking)
            sun = self._sun(here, node, walking & (behind < 0.0))
            sent = epsilon * self._planck(warm, node, walking) + (1.0 - epsilon) * sun
            total += dr.select(walking, sent, 0.0)
            walking &= random.next_float32() < 1.0 - epsilon
            pair = mi.Point2f(random.next_float32(), random.next_float32())
            towards = mi.Frame3f(side).to_world(mi.warp.square_to_cosine_hemisphere(pair))
            dr.eval(total, walking, at, side, here, towards, random)
            if step % _LOOK == _LOOK - 1 and not dr.any(walking):
                break
        shape = count, walks
        node = np.array(node).reshape(shape)
        return np.array(total, dtype=np.float64).reshape(shape) / self.share[node], node

    def emitted(self, material: NDArray[np.integer], kelvin: NDArray[np.floating]) -> Floats:
        """Return the band radiance that materials (n,) emit at temperatures (n,) [K], without a path [W m⁻² sr⁻¹]."""
        plan, found = self._plan, np.empty(len(material))
        for one in np.unique(material):
            if one not in self._emitted:
                at = self._materials[one].emissivity_at
                grid, table = plan.spectrum.emitted(at, plan.coldest, plan.warmest, plan.band_um)
                self._emitted[one] = grid, table @ plan.spectrum.solver.sum(axis=0)
            here = material == one
            found[here] = np.interp(kelvin[here], *self._emitted[one])
        return found

    def _planck(self, kelvin: Jit, node: Jit, active: Jit) -> Jit:
        mi, (coldest, step, last) = self._geometry.mi, self._grid
        position = (kelvin - coldest) / step
        lower = mi.UInt32(dr.clip(position, 0.0, last))
        ends = (dr.gather(mi.Float, self._black, node * self._size + lower + k, active) for k in (0, 1))
        return dr.lerp(*ends, position - mi.Float(lower))

    def _outside(self, face: Jit, towards: Jit, node: Jit) -> Jit:
        """Radiance of sky or surroundings in a direction, as a face sees it."""
        mi = self._geometry.mi
        level = dr.gather(mi.Float, self._level, face)
        lower = dr.minimum(mi.UInt32(level), self._last)
        code = background_code(mi, towards)

        def at(step: Jit) -> Jit:
            return dr.gather(mi.Float, self._beyond, (step * (SKY_BINS + 1) + code) * self._nodes + node)

        return dr.lerp(at(lower), at(dr.minimum(lower + 1, self._last)), level - mi.Float(lower))

    def _sun(self, face: Jit, node: Jit, active: Jit = True) -> Jit:
        """The sun's irradiance on faces over π."""
        mi = self._geometry.mi
        if self._direct is None:
            return mi.Float(0.0)
        return dr.gather(mi.Float, self._direct, face * self._nodes + node, active)
