"""The crowns that each tile of an image may show, nearest first: a view's rays find theirs without a ray caster."""

from collections.abc import Sequence

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from thermorender.render.arrays import Floats, Jit, aligned, view_ray
from thermorender.render.layers import CasterView
from thermorender.render.pixels.sampling import RING, CameraRays
from thermorender.render.turbid import CrownField, State, Visit

# Side of a tile [px].
_SIDE = 4
# Ellipsoids are larger by this, which exceeds the rounding of slopes.
_LARGER = 1.0 + 1e-4
# Bits of a distance in an entry, and last ones of a float that it leaves out: there is no sign.
_DISTANCE, _DROPPED = 19, 12


class CrownTiles:
    """The crowns of a view by tiles of the image."""

    def __init__(self, field: CrownField, view: tuple[list[Jit], Jit], rays: CameraRays) -> None:
        self._mi, self._field = rays.mi, field
        mi, self._low = rays.mi, rays.slope_range[0]
        self._count = -(-(np.array([rays.width, rays.height]) + 2 * RING) // _SIDE)
        self._size = np.ptp(rays.slope_range, axis=0) / self._count
        self._columns = dr.opaque(mi.UInt32, int(self._count[0]))
        crown, tile = self._pairs(*view)
        # By the distance at which a ray through the tile's middle enters.
        number, place = (mi.UInt32(aligned(each, np.uint32)) for each in (crown, tile))
        at = place % self._columns, place // self._columns
        slope = [dr.fma(mi.Float(each) + 0.5, *self._opaque(k)) for k, each in enumerate(at)]
        ray, frame = view_ray(mi, *view, *slope), field.frame(number)
        enter = np.array(dr.maximum(frame.chord(frame.point(ray.o), frame.vector(ray.d))[0], 0.0), np.float32)
        digits, bits = enter.view(np.uint32).astype(np.int64) >> _DROPPED, field.count.bit_length()
        entry = (tile << _DISTANCE | digits) << bits | crown
        entry.sort()
        first = np.searchsorted(entry, np.arange(self._count.prod() + 1) << (_DISTANCE + bits))
        self._first = mi.UInt32(aligned(first, np.uint32))
        self._crown = mi.UInt32(aligned(entry & ((1 << bits) - 1), np.uint32))

    def _opaque(self, axis: int) -> list[Jit]:
        """The size of a tile and the least slope, along an axis."""
        return [dr.opaque(self._mi.Float, float(values[axis])) for values in (self._size, self._low)]

    def _pairs(self, rotation: list[Jit], origin: Jit) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """(crowns, tiles) of which the crown may show in the tile."""
        turn, start = np.array([np.array(row)[:, 0] for row in rotation]), np.array(origin)[:, 0]
        # In the camera's frame; rows of `reach` are half axes.
        middle, reach = (self._field.middle - start) @ turn, _LARGER * (self._field.reach @ turn)
        square = np.einsum("nij,nij->nj", reach, reach)
        near = np.flatnonzero(middle[:, 2] + np.sqrt(square[:, 2]) > 0.0)
        middle, reach, square = middle[near], reach[near], square[near]
        low, high = np.empty((2, len(near), 2))
        for k in (0, 1):
            product = np.einsum("ni,ni->n", reach[:, :, k], reach[:, :, 2])
            low[:, k], high[:, k] = _between(middle[:, k], middle[:, 2], square[:, k], square[:, 2], product)
        first, last = (np.floor((edge - self._low) / self._size).clip(-1.0, self._count) for edge in (low, high))
        shown = ((last >= 0.0) & (first < self._count)).all(axis=1)
        first, last = first[shown].clip(0.0).astype(np.int64), np.minimum(last[shown], self._count - 1).astype(np.int64)
        wide, tall = (last - first + 1).T
        number = np.repeat(np.arange(len(wide)), wide * tall)
        step = np.arange(len(number)) - np.repeat(np.cumsum(wide * tall) - wide * tall, wide * tall)
        down, right = np.divmod(step, wide[number])
        tile = (first[number, 1] + down) * self._count[0] + first[number, 0] + right
        # Two beyond the last tile: arrays of one entry, or none, would compile other kernels.
        return np.append(near[shown][number], [0, 0]), np.append(tile, [self._count.prod()] * 2)

    def listed(self, slope: Sequence[Jit]) -> tuple[Jit, Jit]:
        """Return (first, end) of the entries of the tiles of rays at slopes (x/z, y/z)."""
        mi, place = self._mi, list[Jit]()
        for axis, at in enumerate(slope):
            size, low = self._opaque(axis)
            place.append(mi.UInt32(dr.clip((at - low) / size, 0.0, dr.opaque(mi.Float, self._count[axis] - 0.5))))
        tile = place[1] * self._columns + place[0]
        first, end = (dr.gather(mi.UInt32, self._first, tile + k) for k in (0, 1))
        return first, end

    def walk(self, listed: tuple[Jit, Jit], ray: Jit, until: Jit, active: Jit, state: State, visit: Visit) -> State:
        """Return `state` as `CrownField.walk` does, of the view's rays with the entries `listed`."""
        mi, field, (first, end) = self._mi, self._field, listed

        def goes_on(index: Jit, on: Jit, *_: Jit) -> Jit:
            return on & (index < end)

        def step(index: Jit, on: Jit, *now: Jit) -> tuple[Jit, ...]:
            crown = dr.gather(mi.UInt32, self._crown, index, on)
            chord = field.chord(crown, ray, until, on)
            on, left = visit(chord, now)
            return (index + 1, on, *left)

        return dr.while_loop((first, mi.Bool(active) & (until > 0.0), *state), goes_on, step)[2:]


def tiles_of(layer: CasterView, rays: CameraRays) -> CrownTiles | None:
    """Return the CrownTiles of a view of the static scene; None without crowns."""
    field = layer.geometry.crowns
    return None if field is None else CrownTiles(field, layer.view, rays)


def _between(at: Floats, ahead: Floats, across: Floats, deep: Floats, product: Floats) -> tuple[Floats, Floats]:
    """(least, largest) slope at/ahead of ellipsoids in a plane through the camera: middles (n,), squares of their
    extents and their product as of a covariance, (n,) each; infinite where they reach beside the camera."""
    # Lines of slope s that touch: (at − s ahead)² = across − 2 s product + s² deep.
    square, half, rest = ahead**2 - deep, at * ahead - product, at**2 - across
    root = np.sqrt(np.maximum(half**2 - square * rest, 0.0))
    whole = (square > 0.0) & (ahead > 0.0)
    divisor = np.where(whole, square, 1.0)
    low, high = (half - root) / divisor, (half + root) / divisor
    # Those that reach beside the camera lie in circles, which are seen between two angles.
    beside = np.flatnonzero(~whole)
    distance, radius = np.hypot(at[beside], ahead[beside]), np.sqrt(across[beside] + deep[beside])
    angle, half_angle = np.arctan2(at[beside], ahead[beside]), np.arcsin(radius / np.maximum(distance, radius))
    right, around = 0.5 * np.pi, radius >= distance
    least, most = (np.where(around, edge, angle + edge / right * half_angle) for edge in (-right, right))
    low[beside] = np.where(least <= -right, -np.inf, np.where(least >= right, np.inf, np.tan(least)))
    high[beside] = np.where(most >= right, np.inf, np.where(most <= -right, -np.inf, np.tan(most)))
    return low, high
