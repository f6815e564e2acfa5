"""A pixel's footprint on a texture: the cell of a ray projected onto the plane it hit, and the points where it is read.

A cell is read at a few points, evenly spread over it, each in squares of texels about as large as its share of the cell
(`thermorender.render.pixels.pyramid`). This gives the mean over the cell from any distance at constant cost. The area
of the footprint selects the size of the squares; at grazing angles the points cover its length.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import drjit as dr

from thermorender.render.arrays import Channels, Jit, Mitsuba
from thermorender.render.geometry import Geometry, Hit
from thermorender.render.pixels.sampling import Footprint, places

# Points read in a pixel that holds more texels a side than this; otherwise the plan's taps are read.
PLACES, _FEW_TEXELS = 16, 1.2
# A judge reads cells of up to this many texels a side at many points: faces are hardly smaller.
_JUDGED_TEXELS = 2.5
# Side of the squares read, relative to a point's share of the cell; measured on heath from 20 m to 3 km.
SQUARE = 0.7
# Smallest distance in a cell relative to its middle, for planes seen edge-on.
_NEAREST = 0.5


@dataclass(frozen=True)
class OnMap:
    """The cell of a ray on the texel map of the plane that the ray hit."""

    across: tuple[Jit, Jit]  # change of (column, row) from the left to the right side of the cell [texels]
    along: tuple[Jit, Jit]  # from its upper to its lower side [texels]
    nearer: tuple[Jit, Jit]  # (right, down) relative change of the inverse distance

    @classmethod
    def of(
        cls, mi: Mitsuba, rotation: list[Jit], direction: Jit, distance: Jit, record: Sequence[Jit], cell: Footprint
    ) -> "OnMap":
        """Return the OnMap of hits at `distance` [m] along unit `direction`s; `record` as of `Geometry.record`."""
        x, y = cell.slope
        column, row = (mi.Vector3f(g.x, g.y, g.z) for g in record)
        normal = dr.cross(column, row)
        slant = dr.dot(normal, direction)
        # Zero where the map is constant.
        inverse = dr.select(slant != 0.0, 1.0 / slant, 0.0)
        length = distance * dr.rsqrt(1.0 + x * x + y * y)
        changes, nearer = [], []
        for slope in (cell.across, cell.along):
            turned = length * mi.Vector3f(*(axis.x * slope[0] + axis.y * slope[1] for axis in rotation))
            share = dr.dot(normal, turned) * inverse
            step = turned - share * direction
            changes.append((dr.dot(column, step), dr.dot(row, step)))
            nearer.append(share / distance)
        return cls(changes[0], changes[1], (nearer[0], nearer[1]))

    @property
    def area(self) -> Jit:
        """Number of texels in the cell."""
        return dr.abs(self.across[0] * self.along[1] - self.across[1] * self.along[0])

    def moved(self, right: Jit, down: Jit) -> tuple[Jit, ...]:
        """Return (columns, rows) from the ray to a point in the cell [texels], given in sides of the cell."""
        stretch = 1.0 / dr.maximum(dr.fma(right, self.nearer[0], dr.fma(down, self.nearer[1], 1.0)), _NEAREST)
        return tuple(stretch * dr.fma(right, self.across[axis], down * self.along[axis]) for axis in (0, 1))


@dataclass(frozen=True)
class Climb:
    """The cosine of the zenith angle over the cell of a ray, linear within it."""

    middle: Jit  # at the middle of the cell
    half: tuple[Jit, Jit]  # half its change across and along the cell, both from 0 on

    @classmethod
    def of(cls, rotation: list[Jit], cosine: Jit, cell: Footprint) -> "Climb":
        """Return the Climb of rays whose directions have these cosines."""
        (x, y), up = cell.slope, rotation[2]
        inverse = dr.rsqrt(1.0 + x * x + y * y)
        by_slope = [inverse * (part - cosine * inverse * at) for part, at in ((up.x, x), (up.y, y))]
        across, along = (by_slope[0] * part[0] + by_slope[1] * part[1] for part in (cell.across, cell.along))
        middle = cosine + cell.middle[0] * across + cell.middle[1] * along
        return cls(middle, (0.5 * dr.abs(across), 0.5 * dr.abs(along)))

    def parts(self, horizon: Jit) -> tuple[Jit, Jit, Jit]:
        """Return (fraction of the cell above a horizon, mean height of that part above it, of the part below). Heights
        are differences of cosines of zenith angles. The fraction is exact; heights are of a cell aligned with the
        horizon."""
        rise, (a, b) = self.middle - horizon, self.half
        reach, shorter = a + b, dr.minimum(a, b)
        longer, off = dr.maximum(a, b), dr.abs(rise)
        # Where the horizon cuts off a corner of the cell, and where it crosses two opposite sides.
        corner = dr.square(dr.maximum(reach - off, 0.0)) / dr.maximum(8.0 * shorter * longer, 1e-30)
        crossed = 0.5 - 0.5 * off / dr.maximum(longer, 1e-30)
        whole = off >= reach
        less = dr.select(whole, 0.0, dr.select(off > longer - shorter, corner, crossed))
        higher, lower = 0.5 * (rise + reach), 0.5 * (rise - reach)
        share = dr.select(rise >= 0.0, 1.0 - less, less)
        return share, dr.select(whole, rise, higher), dr.select(whole, rise, lower)


class Reading:
    """Points at which the cells of rays are read: `few` where a cell holds about a texel or less, else `many`. A cell
    is a `share` of a pixel. `judges`, for the error budget, read single texels, and cells larger than a face only at
    the hit."""

    def __init__(self, mi: Mitsuba, few: int, many: int, share: float, judges: bool = False) -> None:
        self._mi, self._few, self._many, self._judges = mi, few, many, judges
        self._limit = _JUDGED_TEXELS**2 if judges else _FEW_TEXELS**2 * share
        offsets = places(few) + (places(many) if many != few else [])
        self._offsets = [mi.Float([place[axis] for place in offsets]) for axis in (0, 1)]

    def level(self, area: Jit, count: Jit, levels: int) -> Jit:
        """Return the level of squares to read at `count` points of a cell that holds `area` texels, UInt32."""
        level = 0.5 * dr.log2(dr.maximum(area * (SQUARE**2 / count), 1e-30)) + 0.5
        return self._mi.UInt32(dr.clip(level, 0.0, levels - 0.5))

    def mean(
        self, geometry: Geometry, channels: Channels, hit: Hit, position: Sequence[Jit], on_map: OnMap,
        middle: Sequence[Jit],
    ) -> tuple[list[Jit], Jit]:  # fmt: skip
        """Return (the mean of Channels over the cell, a list of Float; the level it was read at)."""
        mi = self._mi
        if self._many == self._few == 1:
            level = self.level(on_map.area, 1.0, geometry.levels)
            return self._read(geometry, channels, hit, level)(position, on_map, *middle), level
        several = on_map.area > self._limit
        count = dr.select(several, mi.UInt32(self._many), self._few)
        first = dr.select(several, mi.UInt32(len(self._offsets[0]) - self._many), 0)
        level = self.level(on_map.area, mi.Float(count), 1 if self._judges else geometry.levels)
        if self._judges:
            middle = [dr.select(several, 0.0, value) for value in middle]
        read = self._read(geometry, channels, hit, level)
        active = hit.valid

        def body(number: Jit, *total: Jit) -> tuple[Jit, ...]:
            right, down = (dr.gather(mi.Float, values, first + number) for values in self._offsets)
            values = read(position, on_map, right + middle[0], down + middle[1])
            return (number + 1, *(a + b for a, b in zip(total, values, strict=True)))

        state = (mi.UInt32(0), *(mi.Float(0.0) for _ in range(channels.count)))
        _, *total = dr.while_loop(state, lambda number, *_: active & (number < count), body)
        return [value / mi.Float(count) for value in total], level

    def _read(self, geometry: Geometry, channels: Channels, hit: Hit, level: Jit) -> Callable[..., list[Jit]]:
        if channels.coarse:
            level = dr.maximum(level, geometry.finest(hit.surface, hit.valid))
        lattice = geometry.lattice(hit.surface, hit.valid, level)
        scale = 1.0 / self._mi.Float(1 << level)

        def read(position: Sequence[Jit], on_map: OnMap, right: Jit, down: Jit) -> list[Jit]:
            column, row = (scale * (at + by) for at, by in zip(position, on_map.moved(right, down), strict=True))
            return geometry.bilinear(channels, lattice, column, row, hit.valid)

        return read
