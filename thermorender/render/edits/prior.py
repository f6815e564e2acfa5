"""A baked scene on the device as edits need it: its texels, its light, and the points that represent its faces."""

from concurrent.futures import Executor
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from thermorender.physics.band import RadianceTable
from thermorender.render.arrays import Channels, Floats, Jit, Mitsuba, aligned
from thermorender.render.baked_light import BakedLight
from thermorender.render.device import flat
from thermorender.render.geometry import Geometry
from thermorender.render.light.exchange import Strong
from thermorender.render.light.radiosity import Transport
from thermorender.render.light.texels import pattern
from thermorender.render.plan import Plan
from thermorender.scene.scene import Scene

# Temperatures below the coldest and above the warmest of a scene that its tables have [K].
_BELOW_K, _ABOVE_K = 10.0, 40.0
# Faces between two that an edit changes, which are read with them; parts of the changed faces, handled side by side.
_BETWEEN, _PARTS = 8, 4
_FACES_AT_ONCE = 1 << 16


class Samples:
    """Points that represent the faces of a geometry, `count` in each, and the rays between its faces."""

    def __init__(self, geometry: Geometry, transport: Transport) -> None:
        mi, points = geometry.mi, pattern(geometry)
        self.geometry, self.transport, self.count = geometry, transport, len(points)
        found = []
        for place in geometry.points_in_faces(points):
            number = geometry.nearest(*place)
            dr.eval(number)
            found.append(np.array(number))
        # The number of the texel at each point, of all faces, point after point.
        self.nearest = mi.UInt32(aligned(np.concatenate(found), np.uint32))
        self._pattern = [mi.Float(aligned([point[axis] for point in points])) for axis in (0, 1)]
        self._surface, self._corner = geometry.face_maps()
        self.faces = dr.opaque(mi.UInt32, geometry.face_count)
        outside = transport.up.sum(axis=(1, 2), dtype=np.int64) + transport.down.sum(axis=1, dtype=np.int64)
        # (F,) share of each face's hemisphere that shows other faces, and surroundings below the horizon.
        self.seen = (1.0 - outside / (2.0 * transport.rays)).astype(np.float32)
        self.background = transport.background
        self.area = np.cumsum(geometry.area)  # (F,) of all faces up to each [m²]
        self.strong: Strong | None = None  # of the last solution

    def texel(self, face: Jit, point: Jit) -> Jit:
        """Return the number of the texel at a point of faces, UInt32."""
        return dr.gather(self.geometry.mi.UInt32, self.nearest, point * self.faces + face)

    def corners(self, face: Jit, point: Jit) -> list[tuple[Jit, Jit]]:
        """Return the four texels round a point of faces, as `Geometry.corners`."""
        mi, geometry = self.geometry.mi, self.geometry
        u, v = (dr.gather(mi.Float, values, point) for values in self._pattern)
        at = [[dr.gather(mi.Float, values, face) for values in corner] for corner in self._corner]
        place = [(1.0 - u - v) * at[0][axis] + u * at[1][axis] + v * at[2][axis] for axis in (0, 1)]
        return geometry.corners(geometry.lattice(dr.gather(mi.UInt32, self._surface, face)), *place)

    def with_any(self, flags: Jit) -> NDArray[np.bool_]:
        """Return whether each face has a point whose texel has a flag (UInt8) above 0, (F,)."""
        mi = self.geometry.mi
        face = dr.arange(mi.UInt32, self.geometry.face_count)
        last = dr.opaque(mi.UInt32, self.count)

        def body(point: Jit, found: Jit) -> tuple[Jit, Jit]:
            return point + 1, found | mi.UInt32(dr.gather(mi.UInt8, flags, self.texel(face, point)))

        start = mi.UInt32(0), dr.zeros(mi.UInt32, self.geometry.face_count)
        _, found = dr.while_loop(start, lambda point, _: point < last, body)
        return np.array(found > 0)

    @cached_property
    def others(self) -> tuple[Jit, Jit, Jit]:
        """(first entry of each face (F + 1,), texel, weight): texels of a face's points that other faces cover."""
        mi, cover = self.geometry.mi, self.geometry.face_of_texel
        starts, texels, weights = [np.zeros(1, np.int64)], list[NDArray[Any]](), list[NDArray[Any]]()
        for first in range(0, self.geometry.face_count, _FACES_AT_ONCE):
            count = min(_FACES_AT_ONCE, self.geometry.face_count - first)
            face = dr.arange(mi.UInt32, count) + dr.opaque(mi.UInt32, first)
            keys, shares = list[NDArray[Any]](), list[NDArray[Any]]()
            for point in range(self.count):
                for texel, weight in self.corners(face, dr.opaque(mi.UInt32, point)):
                    other = (dr.gather(mi.UInt32, cover, texel) != face) & (weight > 0.0)
                    dr.eval(texel, weight, other)
                    row = np.flatnonzero(np.array(other))
                    keys.append((row << 32) | np.array(texel)[row])
                    shares.append(np.array(weight)[row])
            key, number = np.unique(np.concatenate(keys), return_inverse=True)
            starts.append(starts[-1][-1] + np.searchsorted(key >> 32, np.arange(count), side="right"))
            texels.append((key & 0xFFFFFFFF).astype(np.uint32))
            weights.append(np.bincount(number, np.concatenate(shares), len(key)) / self.count)
        return (
            mi.UInt32(aligned(np.concatenate(starts), np.uint32)),
            mi.UInt32(aligned(np.concatenate(texels), np.uint32)),
            mi.Float(aligned(np.concatenate(weights))),
        )

    def received(self, sent: NDArray[np.float32], faces: NDArray[np.intp], pool: Executor) -> NDArray[np.float32]:
        """Return what faces receive from radiance that some faces (n,), ascending, send, both (k, F) float32 [W m⁻²
        sr⁻¹]."""
        from scipy.sparse import csc_array

        if not len(faces):
            return np.zeros_like(sent)
        start, seen_by, hits, _ = self._columns
        # Runs of faces, with the few between them that send nothing.
        first = np.flatnonzero(np.diff(faces, prepend=-2 - _BETWEEN) > 1 + _BETWEEN)
        begin, end = faces[first], faces[np.append(first[1:], len(faces)) - 1] + 1
        shares = sent / np.float32(2.0 * self.transport.rays)

        def receive(part: slice) -> NDArray[np.float32]:
            low, high = begin[part], end[part]
            ends = np.cumsum(high - low)
            columns = np.arange(ends[-1]) + np.repeat(high - ends, high - low)
            rays = list(zip(start[low].tolist(), start[high].tolist(), strict=True))
            borders = np.concatenate([[0], np.cumsum(start[columns + 1] - start[columns])]).astype(np.int32)
            own = np.concatenate([hits[a:b] for a, b in rays])
            rows = np.concatenate([seen_by[a:b] for a, b in rays])
            seen = csc_array((own, rows, borders), (sent.shape[1], len(columns)))
            # One after the other: SciPy's product with a few columns takes longer.
            return np.stack([seen @ values for values in shares[:, columns]])

        work = np.cumsum(start[end] - start[begin])
        cuts = np.searchsorted(work, np.arange(1, _PARTS) * work[-1] / _PARTS)
        cuts = np.unique([0, *cuts, len(begin)])
        parts = [slice(low, high) for low, high in zip(cuts[:-1], cuts[1:], strict=True)]
        found, *more = pool.map(receive, parts)
        for each in more:
            found += each
        return np.asarray(found)

    @cached_property
    def _columns(self) -> tuple[NDArray[np.integer], NDArray[np.int32], NDArray[np.float32], NDArray[np.bool_]]:
        """The transport by columns: (first entry of each face (F + 1,), then for each entry the face that sees it, the
        number of that face's rays, and whether they are of its second half)."""
        from scipy.sparse import csr_array

        transport, counted = self.transport, self.transport.counted
        hits: NDArray[Any] = transport.hits.astype(np.int16 if transport.rays < 2**15 else np.int32)
        sign = np.tile(np.array([1, -1], np.int8), len(transport.up))
        np.multiply(hits, np.repeat(sign, np.diff(transport.start)), out=hits)
        found = csr_array((hits, counted.indices, counted.indptr), counted.shape).tocsc()
        return found.indptr.astype(np.int64), found.indices, np.abs(found.data).astype(np.float32), found.data < 0

    def prepare(self) -> None:
        """Sort rays by the faces they hit, and texels by their faces, once for all edits of a geometry."""
        _ = self._columns, self.others

    def rays_on(self, faces: NDArray[np.intp]) -> int:
        """Return the number of pairs of faces that see each other, where the face seen is one of `faces`."""
        start = self._columns[0]
        return int((start[faces + 1] - start[faces]).sum())

    def seen_on(self, faces: NDArray[np.intp], sent: Floats) -> tuple[NDArray[Any], Floats]:
        """Return (faces that see some faces (m,), what they receive by each half of their rays, (m, 2, k)). `sent` is
        the radiance that those faces send, (n, k) [W m⁻² sr⁻¹]."""
        from scipy.sparse import csc_array

        start, seen_by, hits, second = self._columns
        count = start[faces + 1] - start[faces]
        borders = np.concatenate([[0], np.cumsum(count)])
        place = np.arange(borders[-1]) + np.repeat(start[faces] - borders[:-1], count)
        rows, number = np.unique(seen_by[place], return_inverse=True)
        own = hits[place].astype(np.float64) / (2.0 * self.transport.rays)
        seen = csc_array((own, 2 * number + second[place], borders), (2 * len(rows), len(faces)))
        return rows, (seen @ sent).reshape(len(rows), 2, sent.shape[1])

    def received_by(self, faces: NDArray[np.intp], sent: NDArray[np.float32]) -> Floats:
        """Return what some faces (n,) receive from radiance (F,) that faces send, (n,) [W m⁻² sr⁻¹]."""
        transport = self.transport
        start, stop = transport.start[2 * faces], transport.start[2 * faces + 2]
        count = stop - start
        ends = np.cumsum(count)
        place = np.arange(ends[-1]) + np.repeat(start - ends + count, count)
        light = np.cumsum(transport.hits[place] * sent[transport.seen[place]], dtype=np.float64)
        total = np.concatenate([[0.0], light])
        return np.asarray((total[ends] - total[ends - count]) / (2.0 * transport.rays))


@dataclass(frozen=True, eq=False)
class LeftOut:
    """Light that a preview leaves out."""

    # (F,) float32 reflected light that is not followed, of each face, summed over the nodes [W m⁻² sr⁻¹]
    missing: NDArray[np.float32]
    outside: float  # The same of the surroundings
    faces: NDArray[np.intp]  # (n,) int faces where it matters most among those that edits changed


class Tables:
    """Blackbody radiance at the nodes of a spectrum, for each temperature of a `RadianceTable.grid`."""

    def __init__(self, mi: Mitsuba, plan: Plan) -> None:
        self._mi = mi
        # Coldest and warmest temperature [K].
        self.limits_k = plan.coldest - _BELOW_K, plan.warmest + _ABOVE_K
        grid = RadianceTable.grid(*self.limits_k)
        self.black = Channels(mi, plan.spectrum.black(grid))
        values = grid[0], grid[1] - grid[0], len(grid) - 2
        self._steps = [dr.opaque(mi.Float, float(value)) for value in values]
        self.count = dr.opaque(mi.UInt32, len(grid))

    def interval(self, kelvin: Jit) -> tuple[Jit, Jit]:
        """Return (lower index, share of the next) of temperatures in the tables."""
        first, step, last = self._steps
        place = (kelvin - first) / step
        lower = self._mi.UInt32(dr.clip(place, 0.0, last))
        return lower, place - self._mi.Float(lower)

    def radiance(self, kelvin: Jit, active: Jit) -> list[Jit]:
        """Return a blackbody's radiance at each node, [Float]; 0 where inactive."""
        lower, share = self.interval(kelvin)
        ends = (self.black.at(lower + k, active) for k in (0, 1))
        return [dr.lerp(a, b, share) for a, b in zip(*ends, strict=True)]


class PriorLight:
    """Texels and light before an edit, on the device: `kinds` are materials, `kelvin` temperatures [K], `texels`
    radiance."""

    def __init__(
        self, samples: Samples, scene: Scene, kinds: Jit, kelvin: Jit, light: NDArray[np.float32], texels: list[Jit],
        tables: "Tables",
    ) -> None:  # fmt: skip
        self.samples, self.kinds, self.kelvin, self.texels = samples, kinds, kelvin, texels
        self.material, self.temperature = flat(scene.surfaces, "material"), flat(scene.surfaces, "temperature")
        # With the mean in the last row, for texels without a face.
        mean = light.mean(axis=0, keepdims=True, dtype=np.float64)
        self.incident = Channels(samples.geometry.mi, np.vstack([light, mean.astype(np.float32)]))
        self._light, self._tables = light, tables

    @classmethod
    def of(cls, baked: BakedLight, samples: Samples) -> "PriorLight":
        """Return the PriorLight of a solution."""
        mi, scene = samples.geometry.mi, baked.scene
        kinds = mi.UInt8(aligned(flat(scene.surfaces, "material"), np.uint8))
        kelvin = mi.Float(aligned(flat(scene.surfaces, "temperature")))
        texels = [mi.Float(aligned(values)) for values in baked.texels]
        assert baked.incident is not None
        return cls(samples, scene, kinds, kelvin, baked.incident, texels, Tables(mi, baked.plan))

    def after(
        self, scene: Scene, kinds: Jit, kelvin: Jit, basis: Floats, light: NDArray[np.float32], texels: list[Jit]
    ) -> "PriorLight":
        """Return the PriorLight of a preview, whose light changes by `light` (k, F) in the spectra `basis` (k, N)."""
        whole = self._light + light.T @ basis.astype(np.float32)
        return PriorLight(self.samples, scene, kinds, kelvin, whole, texels, self._tables)

    def tables(self, plan: Plan) -> Tables:
        """Return Tables that have the temperatures of a Plan."""
        found = self._tables
        if plan.coldest < found.limits_k[0] or plan.warmest > found.limits_k[1]:
            self._tables = found = Tables(self.samples.geometry.mi, plan)
        return found
