"""A scene's meshes on the render side: the ray caster, and flat per-face and per-texel arrays for its kernels.

All surfaces share one numbering of faces and one of texels. A hit needs two gathers: the face's record and the texels
around the point. The record is the affine map from a point of the face's plane to its position on the texel map. It
also defines the plane, so points near a hit need no ray.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.atmosphere.rays import EARTH_RADIUS_M, MEAN_RADIUS_M
from thermorender.errors import ThermorenderError
from thermorender.render import turbid
from thermorender.render.arrays import Channels, Floats, Jit, Mitsuba, aligned, opaque_vector
from thermorender.render.crown_shadows import CrownShadows
from thermorender.render.pixels import pyramid, shapes, slender
from thermorender.scene.scene import Scene
from thermorender.scene.surface import Surface, over_round_earth


@dataclass(frozen=True)
class Slots:
    """Where the texels of surfaces are, which have equally many of them."""

    count: int  # Number of slots
    of: NDArray[np.int64]  # (S,) the slot of each surface
    finest: NDArray[np.uint32]  # (count,) level of squares that coarse Channels begin with, 0 or 1


_RAYS_AT_ONCE, _FACES_AT_ONCE = 1 << 22, 1 << 20
# 64 float32 steps, relative to a coordinate.
_STEPS = 64.0 * 2.0**-24
# An upward direction that is parallel to hardly any face.
_ASIDE = (0.3717, 0.4693, 0.8010)


@dataclass(frozen=True)
class Hit:
    """Where rays end: Dr.Jit arrays, one entry per ray."""

    valid: Jit  # whether the ray hits a surface
    distance: Jit  # along the ray [m]; infinite for a miss
    face: Jit  # number over the whole scene; 0 for a miss
    surface: Jit  # number over the whole scene; 0 for a miss
    mirrored: Jit = 0.0  # from a mirror to the point seen in it [m]; 0 without a mirror
    leaves: Jit = 0.0  # share of light that crowns in front take; 0 without crowns
    alone: Jit = False  # whether only crowns are hit
    strong: Jit = False  # whether the light on its face differs strongly from that of other faces


class Geometry:
    """Ray caster and flat arrays of a scene's surfaces; `mi` is Mitsuba with a variant active. Squares of a tiled
    ground state their `reach` alike, so that rays begin at the same points in each. With `slots`, texels are numbered
    by slot; else those of one surface follow those of the one before."""

    def __init__(
        self, mi: Mitsuba, surfaces: Sequence[Surface], reach: float | None = None, slots: Slots | None = None
    ) -> None:
        self.mi = mi
        self.surfaces = surfaces
        # (S + 1,) int64: first face and first texel of each surface in the flat numbering.
        self.face_start = np.cumsum([0] + [len(surface.faces) for surface in surfaces])
        self.texel_start = np.cumsum([0] + [surface.material.size for surface in surfaces])
        self.face_count = int(self.face_start[-1])
        # (F,) float64: area of each face [m²].
        self.area = 0.5 * np.linalg.norm(of_faces(surfaces, _across, (3,), np.float64), axis=1)
        for first, surface in zip(self.face_start, surfaces, strict=False):
            if surface.instances is not None:
                self.area[first : first + len(surface.faces)] = surface.instances.area
        # Largest vertex coordinate along any axis [m], without far ground and with it.
        near = [surface for surface in surfaces if not surface.far] or surfaces
        self.reach, self._far_reach = (
            max(float(np.abs(surface.vertices).max()) for surface in some) for some in (near, surfaces)
        )
        self._round = any(surface.on_round_earth for surface in surfaces)
        self.reach = self.reach if reach is None else reach
        # Smallest offset between points [m]: 64 float32 steps at `reach`; see `lift`.
        self.hair = _STEPS * (1.0 + self.reach)
        meshes = {
            f"s{number}": shapes.mesh(mi, f"s{number}", surface.vertices, surface.faces)
            for number, surface in enumerate(surfaces)
            if surface.instances is None
        }
        copies = shapes.CopyShapes(mi, surfaces, self.face_start)
        # Crowns that rays pass in part; None without.
        self.crowns = turbid.field_of(mi, surfaces, self.face_start, self.texel_start, self.hair)
        # Their shadows under the sun that was asked for last: its direction, and them.
        self._shadows: tuple[bytes, CrownShadows] | None = None
        # Without robust intersections rays leak through triangle edges and show the sky.
        self.caster = mi.load_dict({
            "type": "scene", "embree_use_robust_intersections": True, **meshes, **copies.shapes
        })  # fmt: skip
        # Mitsuba numbers shapes over the whole process; this maps its numbers to surfaces.
        registry = [shapes.number_of(mi, mesh) for mesh in meshes.values()]
        surface_of = np.zeros(max([*registry, 0]) + 1, dtype=np.uint32)
        surface_of[registry] = [int(name[1:]) for name in meshes]
        self._surface_of = mi.UInt32(aligned(surface_of, np.uint32))
        self._copies = copies.uploaded() if copies.numbers else None
        self._face_start = mi.UInt32(aligned(self.face_start[:-1], np.uint32))
        # The squares are stored level after level, and in each level surface after surface.
        sizes = [pyramid.sizes(*surface.material.shape) for surface in surfaces]
        # Levels of the texels' averages over squares, see `averaged`; 1 where every surface has a single texel.
        self.levels = max(map(len, sizes))
        squares = np.array([size + [(1, 1)] * (self.levels - len(size)) for size in sizes], dtype=np.int64)
        squares = squares.transpose(1, 0, 2).reshape(-1, 2)
        each = squares.prod(axis=1).reshape(self.levels, -1)
        # (L, S): number of a surface's first square in a level, and (L,): of the level's first one.
        start = np.cumsum(each).reshape(each.shape) - each
        self._slots = slots
        if slots is not None:
            self._level_start = slots.count * (np.cumsum(each[:, 0]) - each[:, 0])
            start = self._level_start[:, None] + each * slots.of
            self.texel_start = np.array([0, slots.count * each[0, 0]])
            self._finest_of_slot = mi.UInt32(aligned(slots.finest, np.uint32))
            self._finest = mi.UInt32(aligned(slots.finest[slots.of], np.uint32))
        self._surfaces, self._boxes = len(surfaces), dict[int, Floats]()
        self._objects = dict[str, Geometry]()
        # {number of a surface: leaves.Open}, what `light.leaves` has traced of the bodies of copies.
        self.openness = dict[int, Any]()
        # Whether its traced light is kept on disk.
        self.kept = True
        parts = (start.ravel(), squares[:, 0], squares[:, 1])
        self._lattice = tuple(mi.Int32(aligned(part, np.int32)) for part in parts)
        # (8 F,): for each face, gradient and offset of the texel map's column, then of its row.
        self.records = mi.Float(aligned(of_faces(surfaces, _map_records, (8,))))

    def lift(self, point: Jit) -> Jit:
        """Return the smallest offset from points, Float [m]: `hair`, and on far ground 64 float32 steps there."""
        mi = self.mi
        hair = dr.opaque(mi.Float, self.hair)
        if self._far_reach <= self.reach:
            return hair
        along = dr.maximum(dr.maximum(dr.abs(point.x), dr.abs(point.y)), dr.abs(point.z))
        return dr.maximum(hair, dr.opaque(mi.Float, _STEPS) * (1.0 + along))

    @cached_property
    def share(self) -> Floats:
        """Area of each face over that of all, (F,)."""
        return self.area / max(self.area.sum(), 1e-300)

    @cached_property
    def joined(self) -> Jit | None:
        """The number of each surface's body, Float: all joined ground is one; None where none is joined."""
        own = [surface.joined for surface in self.surfaces]
        if not any(own):
            return None
        number = np.arange(len(own), dtype=np.float32)
        number[own] = number[own][0]
        return self.mi.Float(aligned(number))

    def hair_at(self, points: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return `lift` of points (n, 3), (n, 1) float32 [m]."""
        if self._far_reach <= self.reach:
            return np.full((len(points), 1), self.hair, np.float32)
        along = np.abs(points).max(axis=1, keepdims=True)
        return np.maximum(self.hair, _STEPS * (1.0 + along)).astype(np.float32)

    @property
    def has_copies(self) -> bool:
        """Whether a surface consists of copies of a body, or of crowns."""
        return self._copies is not None or self.crowns is not None

    def cast(self, ray: Jit, coherent: bool = False, active: Jit = True) -> Hit:
        """Return the Hit of rays (an mi.Ray3f); inactive ones miss. In crowns they end at a random leaf."""
        hit = self.cast_solid(ray, coherent, active)
        if self.crowns is None:
            return hit
        flight, normal = self.crowns.drawn(ray, hit.distance, active)
        return self._in_crowns(hit, flight, normal.z > 0.0)

    def cast_solid(self, ray: Jit, coherent: bool = False, active: Jit = True) -> Hit:
        """Return the Hit of rays as of `cast`, which pass all crowns."""
        return self.hit_of(self.caster.ray_intersect_preliminary(ray, coherent=coherent, active=active))

    def cast_with_normal(self, ray: Jit, active: Jit = True, leaves: bool = True) -> tuple[Hit, Jit]:
        """Return (Hit of rays, unit normal of what they meet, Vector3f); inactive rays miss. Without `leaves` they pass
        all crowns."""
        found = self.caster.ray_intersect_preliminary(ray, active=active)
        hit = self.hit_of(found)
        if self._copies is None:
            normal = self.mi.Vector3f(*self.normals.at(hit.face, hit.valid))
        else:
            # Copies are turned. Mitsuba's own normals need a call for every shape, which thousands of objects are.
            surface = found.compute_surface_interaction(ray, self.mi.RayFlags.Minimal, active)
            normal = self.mi.Vector3f(surface.n)
        if self.crowns is None or not leaves:
            return hit, normal
        flight, side = self.crowns.drawn(ray, hit.distance, active)
        return self._in_crowns(hit, flight, side.z > 0.0), dr.select(flight.met, side, normal)

    def _in_crowns(self, hit: Hit, flight: turbid.FreeFlight, up: Jit) -> Hit:
        """The Hit of rays that end at leaves where their FreeFlight meets one."""
        assert self.crowns is not None
        surface, face = self.crowns.face(flight, up)
        return Hit(
            hit.valid | flight.met, dr.select(flight.met, flight.distance, hit.distance),
            dr.select(flight.met, face, hit.face), dr.select(flight.met, surface, hit.surface),
        )  # fmt: skip

    def sunlight(self, point: Jit, towards: Floats, active: Jit = True) -> Jit:
        """Return the share of the sun's light that arrives at points, Float; 0 where inactive. `towards` (3,) points to
        the sun."""
        mi = self.mi
        ray = mi.Ray3f(point, opaque_vector(mi, towards))
        free = ~self.caster.ray_test(ray, coherent=True, active=active) & active
        return dr.select(free, mi.Float(1.0) if self.crowns is None else self.crowns_passed(point, towards, free), 0.0)

    def crowns_passed(self, point: Jit, towards: Floats, active: Jit = True) -> Jit:
        """Return the share of the sun's light that reaches points through crowns, were all else away, Float."""
        assert self.crowns is not None
        key, shadows = np.asarray(towards, np.float64).tobytes(), self._shadows
        if shadows is None or shadows[0] != key:
            # Replaced as a whole: another thread may light the scene meanwhile.
            shadows = self._shadows = key, CrownShadows(self.crowns, towards)
        return shadows[1].passed(point, active)

    def hit_of(self, found: Jit) -> Hit:
        """Return the Hit of what the caster found."""
        mi = self.mi
        valid = found.is_valid()
        # Shapes of copies have numbers of their own.
        whole = valid if self._copies is None else valid & (dr.reinterpret_array(mi.UInt32, found.instance) == 0)
        surface = dr.gather(mi.UInt32, self._surface_of, dr.reinterpret_array(mi.UInt32, found.shape), whole)
        face = dr.gather(mi.UInt32, self._face_start, surface, whole) + found.prim_index
        if self._copies is not None:
            surface, face = self._on_copies(found, valid & ~whole, surface, face)
        return Hit(valid, found.t, dr.select(valid, face, 0), surface)

    def _on_copies(self, found: Jit, copy: Jit, surface: Jit, face: Jit) -> tuple[Jit, Jit]:
        """(surface, face) of hits, of which those on copies of a body get the patch of the copy."""
        assert self._copies is not None
        mi, (first_face, first_triangle, surface_of, patch) = self.mi, self._copies
        number = dr.reinterpret_array(mi.UInt32, found.instance)
        triangle = dr.gather(mi.UInt32, first_triangle, number, copy) + found.prim_index
        own = dr.gather(mi.UInt32, first_face, number, copy) + dr.gather(mi.UInt32, patch, triangle, copy)
        return dr.select(copy, dr.gather(mi.UInt32, surface_of, number, copy), surface), dr.select(copy, own, face)

    def seen(self, ray: Jit) -> Hit:
        """Return the Hit of a view's rays, as of `seen_through`. Crowns that pass less than half of the light are hit
        where they do."""
        hit = self.seen_through(ray)
        if self.crowns is None:
            return hit
        half = dr.opaque(self.mi.Float, float(np.log(2.0)))
        flight = self.crowns.flight(ray, hit.distance, half, coherent=True)
        return self._in_crowns(hit, flight, ray.d.z < 0.0)

    def seen_through(self, ray: Jit) -> Hit:
        """Return the Hit of a view's rays (an mi.Ray3f) that pass all crowns. Embree returns distance 0 for a camera on
        a surface and for a ray in the plane of a triangle; such rays are cast again, offset by `hair`."""
        hit = self.cast_solid(ray, coherent=True)
        touches = hit.valid & (hit.distance <= 0.0)
        # Opaque: a literal would compile the kernel again for each scene.
        aside = self.lift(ray.o) * self.mi.Vector3f(*_ASIDE)
        beside = self.mi.Ray3f(ray.o + aside, ray.d)
        found = self.hit_of(self.caster.ray_intersect_preliminary(beside, coherent=True, active=touches))
        return Hit(
            dr.select(touches, found.valid, hit.valid), dr.select(touches, found.distance, hit.distance),
            dr.select(touches, found.face, hit.face), dr.select(touches, found.surface, hit.surface),
        )  # fmt: skip

    def record(self, face: Jit, active: Jit = True) -> tuple[Jit, ...]:
        """Return the records of faces, two Vector4f: gradient and offset of the column, then of the row."""
        return tuple(dr.gather(self.mi.Vector4f, self.records, 2 * face + k, active) for k in (0, 1))

    def map_position(self, record: Sequence[Jit], point: Jit) -> tuple[Jit, Jit]:
        """Return (column, row) of points of a face on the texel map, in texels from the upper left corner."""
        column, row = (dr.fma(g.x, point.x, dr.fma(g.y, point.y, dr.fma(g.z, point.z, g.w))) for g in record)
        return column, row

    def normal(self, record: Sequence[Jit]) -> Jit:
        """Return a vector along the normal of a face; zero where its map is constant."""
        u, v = (self.mi.Vector3f(g.x, g.y, g.z) for g in record)
        return dr.cross(u, v)

    def points_in_faces(self, pattern: ArrayLike) -> Iterator[tuple[Jit, Jit, Jit]]:
        """Yield (surface, column, row) on the texel maps of all faces, for each barycentric (u, v) of `pattern`."""
        mi, (surface, corner) = self.mi, self.face_maps()
        for u, v in np.asarray(pattern).tolist():
            # Opaque: literals would compile the kernel again for each point.
            u, v = dr.opaque(mi.Float, u), dr.opaque(mi.Float, v)
            column, row = (
                (1.0 - u - v) * corner[0][axis] + u * corner[1][axis] + v * corner[2][axis] for axis in (0, 1)
            )
            yield surface, column, row

    def face_maps(self) -> tuple[Jit, list[list[Jit]]]:
        """Return the surface of every face, UInt32, and its corners' [column, row] on the texel map, Float."""
        mi, face_counts = self.mi, np.diff(self.face_start)
        surface = mi.UInt32(aligned(np.repeat(np.arange(len(face_counts)), face_counts), np.uint32))
        size = [surface_.material.shape[::-1] for surface_ in self.surfaces]
        corners = np.concatenate([s.uv * np.array(n, np.float32) for s, n in zip(self.surfaces, size, strict=True)])
        return surface, [[mi.Float(aligned(corners[:, k, axis])) for axis in (0, 1)] for k in range(3)]

    def nearest(self, surface: Jit, column: Jit, row: Jit, active: Jit = True) -> Jit:
        """Return the flat number of the texel at a position on a surface's map; outside, of the texel at the edge."""
        mi = self.mi
        start, rows, columns = self.lattice(surface, active)
        i = dr.clip(mi.Int32(dr.floor(row)), 0, rows - 1)
        j = dr.clip(mi.Int32(dr.floor(column)), 0, columns - 1)
        return mi.UInt32(start + i * columns + j)

    def lattice(self, surface: Jit, active: Jit = True, level: Jit = None) -> tuple[Jit, ...]:
        """Return (first texel, rows, columns) of surfaces, Int32; with `level`, of their squares of 2^level texels a
        side."""
        index = surface if level is None else surface + level * self._surfaces
        return tuple(dr.gather(self.mi.Int32, values, index, active) for values in self._lattice)

    def finest(self, surface: Jit, active: Jit = True) -> Jit:
        """Return the level of squares that coarse Channels of surfaces begin with, UInt32."""
        return dr.gather(self.mi.UInt32, self._finest, surface, active)

    def coarse_square(self, texel: Jit, active: Jit = True) -> Jit:
        """Return the number of the finest square of coarse Channels that holds a texel, UInt32; texels are in slots."""
        assert self._slots is not None
        (rows, columns), (high, wide) = pyramid.sizes(*self.surfaces[0].material.shape)[:2]
        slot, within = texel // (rows * columns), texel % (rows * columns)
        square = (within // columns // 2) * wide + within % columns // 2
        half = int(self._level_start[1]) + slot * (high * wide) + square
        return dr.select(dr.gather(self.mi.UInt32, self._finest_of_slot, slot, active) == 0, texel, half)

    def averaged(self, values: ArrayLike) -> Channels:
        """Return Channels of texels (T, C), followed by their means over squares of 2, 4, 8 … texels a side."""
        values = np.asarray(values, dtype=np.float32)
        levels: list[list[NDArray[np.float32]]] = [[] for _ in range(self.levels - 1)]
        parts = np.split(values, self.texel_start[1:-1])
        for surface, covered, part in zip(self.surfaces, self.covered, parts, strict=True):
            last = part.reshape(*surface.material.shape, -1)
            found = list(pyramid.squares(last, covered))
            for number, level in enumerate(levels):
                last = found[number] if number < len(found) else (found or [last])[-1]
                level.append(last.reshape(-1, values.shape[1]))
        return Channels(self.mi, np.concatenate([values, *(part for level in levels for part in level)]))

    def boxes(self, first: int = 0) -> Floats:
        """Return the boxes round connected parts of the surfaces from number `first` on, as `slender.boxes`."""
        if first not in self._boxes:
            self._boxes[first] = slender.boxes(self.surfaces[first:])
        return self._boxes[first]

    @cached_property
    def box(self) -> Floats:
        """The lowest and the highest corner of the surfaces, (2, 3) [m]."""
        return _box(self.surfaces)

    @cached_property
    def low_m(self) -> float:
        """Lowest height of a surface, of far ground over a round Earth [m]."""
        return min(float(surface.heights_m().min()) for surface in self.surfaces)

    def heights_m(self, points: NDArray[np.floating]) -> NDArray[np.floating]:
        """Return heights of points (n, 3), over a round Earth where there is far ground, (n,) [m]."""
        if not self._round:
            return points[:, 2]
        return over_round_earth(points, self.radius_m).astype(points.dtype)

    @property
    def radius_m(self) -> float:
        """Radius of the Earth that surfaces follow [m]; far ground has that with refraction."""
        return EARTH_RADIUS_M if self._round else MEAN_RADIUS_M

    def of_object(self, name: str, first: int) -> "Geometry":
        """Return the Geometry of the surfaces of one object alone, of those from number `first` on."""
        if name not in self._objects:
            own = [surface for surface in self.surfaces[first:] if surface.name.split(":")[0] == name]
            self._objects[name] = Geometry(self.mi, own)
        return self._objects[name]

    @cached_property
    def covered(self) -> list[NDArray[np.bool_] | None]:
        """Texels that a face covers, (rows, columns) bool for each surface; None where all are."""
        found: list[NDArray[np.bool_] | None] = []
        covers = None
        for number, surface in enumerate(self.surfaces):
            if surface.joined:
                # The rim of a tile has the ground of the next one.
                found.append(None)
                continue
            area = of_faces([surface], _mapped_area, (), np.float64).sum()
            if abs(area - 1.0) < 1e-6 or surface.material.size == 1:
                found.append(None)
                continue
            if covers is None:
                covers = self.face_of_texel.numpy() < self.face_count
            part = covers[self.texel_start[number] : self.texel_start[number + 1]]
            found.append(part.reshape(surface.material.shape))
        return found

    def corners(self, lattice: Sequence[Jit], column: Jit, row: Jit) -> list[tuple[Jit, Jit]]:
        """Return the four texels round a position as [(flat number, weight), …]; outside the map, those at the edge."""
        mi = self.mi
        start, rows, columns = lattice
        x, y = column - 0.5, row - 0.5
        left, top = dr.floor(x), dr.floor(y)
        fx, fy = x - left, y - top
        j, i = mi.Int32(left), mi.Int32(top)
        j0, j1 = dr.clip(j, 0, columns - 1), dr.clip(j + 1, 0, columns - 1)
        upper, lower = (start + dr.clip(i + k, 0, rows - 1) * columns for k in (0, 1))
        return [
            (mi.UInt32(line + at), weight * share)
            for line, weight in ((upper, 1.0 - fy), (lower, fy))
            for at, share in ((j0, 1.0 - fx), (j1, fx))
        ]

    def bilinear(
        self, channels: Channels, lattice: Sequence[Jit], column: Jit, row: Jit, active: Jit = True
    ) -> list[Jit]:
        """Return the Channels at a position on a surface's map, bilinear between texel centres, as a list of Float."""
        total: list[Jit] = []
        for texel, weight in self.corners(lattice, column, row):
            values = [weight * value for value in channels.at(texel, active)]
            total = [a + b for a, b in zip(total, values, strict=True)] if total else values
        return total

    @cached_property
    def vertices(self) -> Floats:
        """All vertices, each position once, (n, 3) float64 [m]."""
        return np.unique(np.concatenate([surface.vertices for surface in self.surfaces]), axis=0).astype(np.float64)

    @cached_property
    def normals(self) -> Channels:
        """Unit normals of all faces; zero where a face has no area."""
        return Channels(self.mi, of_faces(self.surfaces, _unit_across, (3,)))

    @cached_property
    def face_of_texel(self) -> Jit:
        """The face that covers each texel's centre, UInt32; `face_count` where none does. Faces without area on the map
        cover none."""
        mi = self.mi
        found = np.full(int(self.texel_start[-1]), self.face_count, dtype=np.uint32)
        for number, surface in enumerate(self.surfaces):
            rows, columns = surface.material.shape
            if rows * columns == 1:
                continue
            here = found[int(self.texel_start[number]) :][: rows * columns].reshape(rows, columns)
            # The map's triangles take 200 bytes each, so they are made in parts.
            for first in range(0, len(surface.faces), _FACES_AT_ONCE):
                part = surface.uv[first : first + _FACES_AT_ONCE]
                self._cover(here, part, int(self.face_start[number]) + first)
        return mi.UInt32(aligned(found, np.uint32))

    def face_showing(self, surfaces: int) -> NDArray[np.uint32]:
        """Return the face that shows each texel of the first `surfaces`, (T,), as `face_of_texel`, or a face whose map
        is a point."""
        found = np.array(self.face_of_texel)[: int(self.texel_start[surfaces])]
        for number, surface in enumerate(self.surfaces[:surfaces]):
            rows, columns = surface.material.shape
            points = np.flatnonzero((np.ptp(surface.uv, axis=1) == 0.0).all(axis=1))
            first, last = self.face_start[number : number + 2]
            points = points[np.argsort(self.area[first:last][points], kind="stable")]
            column, row = (surface.uv[points, 0].astype(np.float64) * (columns, rows)).T.astype(np.int64)
            here = found[self.texel_start[number] : self.texel_start[number + 1]].reshape(rows, columns)
            here[np.minimum(row, rows - 1), np.minimum(column, columns - 1)] = first + points
        return found

    def _cover(self, found: NDArray[np.uint32], uv: NDArray[np.float32], first_face: int) -> None:
        """Write into (rows, columns) of texels the face, of some faces' maps (n, 3, 2), that covers each."""
        mi, (rows, columns) = self.mi, found.shape
        corner = uv.reshape(-1, 2).astype(np.float64) * (columns, rows)
        flat = np.column_stack([corner, np.zeros(len(corner))])
        mesh = shapes.mesh(mi, "map", flat, np.arange(len(flat)).reshape(-1, 3))
        caster = mi.load_dict({"type": "scene", "embree_use_robust_intersections": True, "map": mesh})
        highest, lowest = (int(np.clip(edge, 0, rows)) for edge in (corner[:, 1].min(), np.ceil(corner[:, 1].max())))
        step = max(1, _RAYS_AT_ONCE // columns)
        for top in range(highest, lowest, step):
            count = min(step, lowest - top) * columns
            index = dr.arange(mi.UInt32, count)
            origin = mi.Point3f(
                mi.Float(index % columns) + 0.5, mi.Float(index // columns + dr.opaque(mi.UInt32, top)) + 0.5, 1.0
            )
            hit = caster.ray_intersect_preliminary(mi.Ray3f(origin, mi.Vector3f(0.0, 0.0, -1.0)), coherent=True)
            face = np.array(dr.select(hit.is_valid(), hit.prim_index + first_face, self.face_count))
            texels = found[top : top + step].reshape(-1)[:count]
            np.copyto(texels, face, where=face < self.face_count)


def box_of(scene: Scene) -> Floats:
    """Return the lowest and the highest corner of a scene's surfaces, (2, 3) [m]."""
    return _box(scene.surfaces)


def _box(surfaces: Sequence[Surface]) -> Floats:
    corner = [limit(surface.vertices, axis=0) for limit in (np.min, np.max) for surface in surfaces]
    return np.stack([np.min(corner, axis=0), np.max(corner, axis=0)])


def farthest(scene: Scene) -> float:
    """Return the length of the longest path between surfaces of a scene [m], at least 2 m."""
    return max(float(np.linalg.norm(np.diff(box_of(scene), axis=0))), 2.0)


def refuse_other_surfaces(known: Sequence[Surface], surfaces: Sequence[Surface]) -> None:
    """Raise unless two sequences of surfaces have the same vertices, faces and texel maps."""
    differ = None
    if len(known) != len(surfaces):
        differ = f"{len(known)} surfaces, not {len(surfaces)}"
    for one, other in zip(known, surfaces, strict=False):
        for name in ("vertices", "faces", "uv"):
            first, second = getattr(one, name), getattr(other, name)
            if first is not second and not np.array_equal(first, second):
                differ = differ or f"other {name} in surface {other.name!r}"
        if not _same_copies(one, other):
            differ = differ or f"other copies or crowns in surface {other.name!r}"
        if one.material.shape != other.material.shape:
            differ = differ or f"{one.material.shape} texels, not {other.material.shape}, in surface {other.name!r}"
    if differ:
        raise ThermorenderError(
            f"like=… has {differ}; give one of the same surfaces; only temperatures and materials may differ"
        )


def frames(corners: Floats) -> Floats:
    """Return corner, first edge, second edge and unit normal of triangles (n, 3, 3), (n, 4, 3)."""
    edge_u, edge_v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(edge_u, edge_v)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    # The light on a face without area does not matter, but its rays need a direction.
    normal = np.where(length > 0.0, normal / np.where(length > 0.0, length, 1.0), [0.0, 0.0, 1.0])
    return np.stack([corners[:, 0], edge_u, edge_v, normal], axis=1)


def of_faces(
    surfaces: Sequence[Surface], job: Callable[[Surface, slice], NDArray[Any]], shape: tuple[int, ...],
    dtype: Any = np.float32,
) -> NDArray[Any]:  # fmt: skip
    """Return `job(surface, faces)` of all faces, (F, *shape), for a million faces at a time to limit the memory of
    float64."""
    found = np.empty((sum(len(surface.faces) for surface in surfaces), *shape), dtype)
    first = 0
    for surface in surfaces:
        for start in range(0, len(surface.faces), _FACES_AT_ONCE):
            part = slice(start, min(start + _FACES_AT_ONCE, len(surface.faces)))
            found[first + part.start : first + part.stop] = job(surface, part)
        first += len(surface.faces)
    return found


def _across(surface: Surface, part: slice) -> Floats:
    """Normals of faces, of twice their area."""
    corner = surface.vertices[surface.faces[part]]
    return np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])


def _unit_across(surface: Surface, part: slice) -> Floats:
    """Unit normals of faces; zero where a face has no area, and of copies, whose leaves face all directions."""
    if surface.instances is not None:
        return np.zeros((len(surface.faces[part]), 3))
    normal = _across(surface, part)
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)


def _mapped_area(surface: Surface, part: slice) -> Floats:
    """Areas of faces on the map; the whole map has area 1."""
    edge = surface.uv[part, 1:].astype(np.float64) - surface.uv[part, :1]
    return 0.5 * np.abs(edge[:, 0, 0] * edge[:, 1, 1] - edge[:, 0, 1] * edge[:, 1, 0])


def _map_records(surface: Surface, part: slice) -> Floats:
    """Affine maps (F, 8) from points to texels: gradient (0 without area or map) and offset of the column, then of the
    row."""
    corner = surface.vertices[surface.faces[part]]
    texel = surface.uv[part].astype(np.float64) * surface.material.shape[::-1]
    edge = corner[:, 1:] - corner[:, :1]
    change = texel[:, 1:] - texel[:, :1]
    one, other = edge[:, 0], edge[:, 1]
    a, b, d = ((x * y).sum(axis=1, keepdims=True) for x, y in ((one, one), (one, other), (other, other)))
    determinant = a * d - b * b
    flat = determinant <= 1e-12 * np.maximum(a * d, 1e-300)
    scale = np.where(flat, 0.0, 1.0 / np.where(flat, 1.0, determinant))
    # Shares of the edges in the gradient of each axis, (F, 2).
    along = scale * (d * change[:, 0] - b * change[:, 1]), scale * (a * change[:, 1] - b * change[:, 0])
    gradient = along[0][..., None] * one[:, None] + along[1][..., None] * other[:, None]
    offset = texel[:, 0] - (gradient * corner[:, :1]).sum(axis=-1)
    return np.concatenate([gradient, offset[..., None]], axis=-1).reshape(-1, 8)


def _same_copies(one: Surface, other: Surface) -> bool:
    """Whether two surfaces have the same copies of a body or the same crowns, or none."""
    first, second = one.instances, other.instances
    if first is None or second is None or type(first) is not type(second):
        return first is second
    names = (each.name for each in fields(second))
    return all(np.array_equal(getattr(first, name), getattr(second, name)) for name in names)
