"""Sunlight through crowns: the crowns whose shadows fall on each tile of a plane across the sun's rays.

The rays are parallel, so that a ray finds its crowns in its tile, without a ray caster.
"""

from collections.abc import Iterable

import drjit as dr
import numpy as np

from thermorender.render.arrays import Floats, Jit, aligned, opaque_vector
from thermorender.render.turbid import CrownField

# Most tiles, and most crowns in all of them: several for each crown, or that many. The side of a tile is otherwise half
# of the median width of a crown, and grows by this factor.
_MOST, _MOST_LISTED, _EACH, _GROWTH = 1 << 20, 1 << 21, 16, 1.25
# Depth beyond which no more crowns are looked at. It is large, as the transmittance of a crown may be divided out.
_DEEP = 30.0
# Crowns are larger by this share of the largest coordinate, which exceeds the rounding of positions.
_ROUNDING = 1e-6


class CrownShadows:
    """The crowns of a CrownField by tiles of the plane across a direction `towards` the sun (3,)."""

    def __init__(self, field: CrownField, towards: Floats) -> None:
        self._mi, self._field = field.mi, field
        mi, along = field.mi, np.asarray(towards, np.float64)
        across = np.cross(along, np.eye(3)[np.argmin(np.abs(along))])
        across /= np.linalg.norm(across)
        axes = np.stack([across, np.cross(along, across), along])
        origin = field.middle.mean(axis=0)
        at = (field.middle - origin) @ axes.T
        # Half the sides of the boxes round the ellipsoids, whose rows of `reach` are half axes.
        half = np.sqrt(np.square(field.reach @ axes.T).sum(axis=1)) + _ROUNDING * (1.0 + np.abs(field.middle).max())
        low, high = (at - half)[:, :2], (at + half)[:, :2]
        corner = low.min(axis=0)
        extent = high.max(axis=0) - corner
        side = max(float(np.median(half[:, :2])), float(np.sqrt(extent.prod() / _MOST)))
        while (2.0 * half[:, :2] / side + 1.0).prod(axis=1).sum() > max(_MOST_LISTED, _EACH * field.count):
            side *= _GROWTH
        count = np.ceil(extent / side).astype(np.int64)
        first, last = (np.floor((edge - corner) / side).astype(np.int64) for edge in (low, high))
        last = np.minimum(last, count - 1)
        wide, tall = (last - first + 1).T
        number = np.repeat(np.arange(len(wide)), wide * tall)
        step = np.arange(len(number)) - np.repeat(np.cumsum(wide * tall) - wide * tall, wide * tall)
        down, right = np.divmod(step, wide[number])
        tile = (first[number, 1] + down) * count[0] + first[number, 0] + right
        # In each tile the crown that ends nearest to the sun comes first, so that those behind a point end its list.
        end = (at + half)[:, 2]
        order = np.lexsort([-end[number], tile])
        start = np.searchsorted(tile[order], np.arange(count.prod() + 1))
        # The crowns of all tiles. Two more: arrays of one entry would compile other kernels.
        number = np.append(number[order], [0, 0])
        self._start, self.listed = (mi.UInt32(aligned(each, np.uint32)) for each in (start, number))
        self._end = mi.Float(aligned(end[number]))
        self._origin, *self._axes = (opaque_vector(mi, each) for each in (origin, *axes))
        self._corner, self._last, (self._inverse,) = map(self._opaque, (corner, count - 0.5, [1.0 / side]))
        self._columns = dr.opaque(mi.UInt32, int(count[0]))

    def _opaque(self, values: Iterable[float]) -> list[Jit]:
        """Numbers that may differ from one sun to the next without another kernel."""
        return [dr.opaque(self._mi.Float, float(value)) for value in values]

    def passed(self, point: Jit, active: Jit = True) -> Jit:
        """Return the share of sunlight that arrives at points through the crowns, Float."""
        mi, field = self._mi, self._field
        away = mi.Point3f(point) - mi.Point3f(self._origin)
        place = [
            mi.UInt32(dr.clip((dr.dot(axis, away) - low) * self._inverse, 0.0, last))
            for axis, low, last in zip(self._axes[:2], self._corner, self._last, strict=True)
        ]
        tile = place[1] * self._columns + place[0]
        first, end = (dr.gather(mi.UInt32, self._start, tile + k) for k in (0, 1))
        high, ray = dr.dot(self._axes[2], away), mi.Ray3f(point, self._axes[2])
        endless, on = dr.opaque(mi.Float, np.inf), mi.Bool(active)

        def goes_on(index: Jit, depth: Jit) -> Jit:
            here = on & (index < end) & (depth < _DEEP)
            return here & (dr.gather(mi.Float, self._end, index, here) > high)

        def step(index: Jit, depth: Jit) -> tuple[Jit, ...]:
            crown = dr.gather(mi.UInt32, self.listed, index)
            return index + 1, depth + field.chord(crown, ray, endless, mi.Bool(True)).depth

        _, depth = dr.while_loop((first, dr.zeros(mi.Float, dr.width(first))), goes_on, step)
        return dr.exp(-depth)
