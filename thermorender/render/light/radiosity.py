"""Diffuse light between surfaces and from the sky, solved once per scene.

For each face a fixed set of cosine-distributed rays is traced once. Hits form a sparse matrix K of form factors; misses
see the sky, or the surroundings below the horizon. Per spectral node the mean incident radiance x of every face
satisfies

    x = K (e + ρ x) + outside,

with e and ρ the faces' mean emitted radiance and reflectance; see `solver.solve`.

The rays of a face are Sobol' points (1967, doi:10.1016/0041-5553(67)90144-9) in four dimensions, two of direction and
two of position, with a random digital shift per face (Owen 2003, doi:10.1145/945511.945518). They are split into two
halves, whose difference estimates the Monte Carlo error. Normals are those of the flat faces.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from thermorender.render.arrays import Floats, Jit, Mitsuba, aligned
from thermorender.render.geometry import Geometry, frames, of_faces
from thermorender.render.light import contacts, leaves
from thermorender.render.sobol import sobol
from thermorender.scene.surface import Surface

# A cached Transport of another version is not used: increase this when the result of `trace` changes.
VERSION = 8
# Bins of zenith angle for rays to the sky, even in the root of its cosine: narrow at the horizon.
SKY_BINS = 16
# About 30 bytes per ray at once.
_RAYS_AT_ONCE = 1 << 21
_SEED = 0x7E44
# Faces handled at once. Products of matrices of so few rows stay in their thread, so that their sums have one order.
_FACES_AT_ONCE = 3000
# Rays per triangle of a body that find how open it is.
_OPEN_RAYS = 64
# Steps of the table of chords of the unit disk.
_CHORDS = 4096
# In place of the row of a face without a covered part.
_OPEN = 0xFFFFFFFF


@dataclass(frozen=True)
class Transport:
    """Surfaces seen by the faces' rays, independent of any temperature."""

    rays: int  # per face in each of the two halves
    # (2 F + 1,) rows 2 i and 2 i + 1, the hits of the halves of face i's rays, are start[row]:start[row + 1].
    start: NDArray[np.int64]
    seen: NDArray[np.int32]  # (nnz,) faces hit, ascending in each row
    hits: NDArray[np.uint16]  # (nnz,) number of rays that hit them
    up: NDArray[np.uint16]  # (F, 2, SKY_BINS) rays of each half that see the sky, by zenith angle
    down: NDArray[np.uint16]  # (F, 2) rays of each half that see the surroundings below the horizon
    touching: NDArray[np.uint32]  # (n,) faces that something solid may cover in part, see `contacts`

    @property
    def sky(self) -> Floats:
        """Share of each face's cosine-weighted hemisphere that sees each bin of the sky, (F, SKY_BINS)."""
        return self.up.sum(axis=1) / (2.0 * self.rays)

    @property
    def background(self) -> Floats:
        """Share of each face's cosine-weighted hemisphere that sees the surroundings below the horizon, (F,)."""
        return self.down.sum(axis=1) / (2.0 * self.rays)

    @property
    def operator(self) -> Any:
        """Share of face i's cosine-weighted hemisphere that sees face j, (F, F) csr_array of float64."""
        return self.counted / (2.0 * self.rays)

    @property
    def counted(self) -> Any:
        """Number of the rays of face i that hit face j, (F, F) csr_array that shares memory with `hits`."""
        from scipy.sparse import csr_array

        # A row is the two halves' rows in succession: every second border is left out. SciPy would convert the int32
        # columns to the borders' type, at twice the memory.
        borders = self.start[::2].astype(np.int32 if self.start[-1] < 2**31 else np.int64)
        return csr_array((self.hits, self.seen, borders), shape=(len(self.up), len(self.up)))

    def parts(self) -> list[slice]:
        """Return slices of the faces, so small that their hits fit into a core's own cache."""
        count = len(self.up)
        return [slice(first, min(first + _FACES_AT_ONCE, count)) for first in range(0, count, _FACES_AT_ONCE)]

    def halves(self, part: slice) -> Any:
        """Number of the rays of n faces that hit each face, csr_array (2 n, F) of float64; rows 2 i and 2 i + 1 are
        halves."""
        from scipy.sparse import csr_array

        start = self.start[2 * part.start : 2 * part.stop + 1]
        here = slice(int(start[0]), int(start[-1]))
        borders = (start - start[0]).astype(np.int32)
        return csr_array((self.hits[here].astype(np.float64), self.seen[here], borders), (len(start) - 1, len(self.up)))

    def among(self, faces: NDArray[np.intp]) -> tuple[Any, Any]:
        """Rows of `operator` of n ascending faces, (n, F), and their part between these faces, (n, n)."""
        if len(faces) == len(self.up):
            return self.operator, self.operator
        rows = self.counted[faces]
        rows.data = rows.data / (2.0 * self.rays)
        return rows, rows[:, faces]


def trace(geometry: Geometry, rays: int, progress: Callable[[float], object] | None = None, seed: int = 0) -> Transport:
    """Return the Transport of a scene. `rays` per face are 1…65536, odd numbers rounded up for two equal halves; powers
    of two spread most evenly. `progress` is called with the share done, 0…1. Another `seed`, 0…2³²−1, gives an
    independent estimate."""
    mi, count, half = geometry.mi, geometry.face_count, (rays + 1) // 2
    rays_of, solids = FaceRays(geometry, half), contacts.solid(geometry)
    back = None if solids is None else mi.UInt8(aligned(solids, np.uint8))
    up, down = np.empty((count, 2, SKY_BINS), dtype=np.uint16), np.empty((count, 2), dtype=np.uint16)
    touching = np.zeros(count, dtype=bool)

    def rows_of(rays_of: FaceRays, faces: NDArray[np.uint32]) -> _Rows:
        """The rows of some faces; what their rays see beyond the surfaces is written to `up` and `down`."""
        origin, direction, _, _ = rays_of(mi.UInt32(aligned(faces, np.uint32)), seed)
        ray, behind = mi.Ray3f(origin, direction), mi.Bool(False)
        if back is None:
            found = geometry.cast(ray)
        else:
            found, behind = contacts.backs(geometry, back, ray)
        # One number per ray: the face, or face count plus the code of the background.
        code = dr.select(found.valid, found.face, count + background_code(mi, direction))
        dr.eval(code, behind)
        if back is not None:
            touching[faces] |= np.array(behind, dtype=bool).reshape(len(faces), -1).any(axis=1)
        length, seen, hits, missing = _counted(np.array(code, dtype=np.int32).reshape(2 * len(faces), half), count)
        up[faces] = missing[:, :SKY_BINS].reshape(-1, 2, SKY_BINS)
        down[faces] = missing[:, SKY_BINS].reshape(-1, 2)
        return _Rows(length, seen, hits)

    step = max(1, _RAYS_AT_ONCE // (2 * half))
    parts = [np.arange(first, min(first + step, count), dtype=np.uint32) for first in range(0, count, step)]
    rows = list[_Rows]()
    for part in parts:
        rows.append(rows_of(rays_of, part))
        if progress:
            progress((int(part[-1]) + 1) / count)
    at_risk = np.flatnonzero(touching).astype(np.uint32)
    covered = rays_of.start_in_the_open(solids, at_risk)
    if covered is not None:
        for number, part in enumerate(parts):
            again = covered.faces[slice(*np.searchsorted(covered.faces, [part[0], part[-1] + 1]))]
            if len(again):
                rows[number] = rows[number].replaced(again - part[0], rows_of(rays_of, again))
    lengths, seen, hits = (np.concatenate([getattr(each, name) for each in rows]) for name in _Rows._fields)
    start = np.concatenate([[0], np.cumsum(lengths, dtype=np.int64)])
    return Transport(half, start, seen, hits, up, down, at_risk)


class _Rows(NamedTuple):
    """Rows of a Transport: two for each of n faces."""

    length: NDArray[np.int64]  # (2 n,)
    seen: NDArray[np.int32]
    hits: NDArray[np.uint16]

    def replaced(self, faces: NDArray[np.integer], others: "_Rows") -> "_Rows":
        """Return these rows with those of some ascending faces, counted from the first, replaced by others."""
        new = np.zeros(len(self.length), dtype=bool)
        new.reshape(-1, 2)[faces] = True
        length = self.length.copy()
        length[new] = others.length
        kept, here = np.repeat(~new, self.length), np.repeat(~new, length)
        found = []
        for own, other in ((self.seen, others.seen), (self.hits, others.hits)):
            values = np.empty(len(here), own.dtype)
            values[here], values[~here] = own[kept], other
            found.append(values)
        return _Rows(length, *found)


def sky_edges() -> Floats:
    """Return the cosines of zenith angle at the edges of the sky bins, (SKY_BINS + 1,)."""
    return (np.arange(SKY_BINS + 1) / SKY_BINS) ** 2


def background_code(mi: Mitsuba, direction: Jit) -> Jit:
    """Return the background of a ray that hits nothing, UInt32: a bin of the sky, or SKY_BINS for the surroundings."""
    position = mi.UInt32(dr.sqrt(dr.clip(direction.z, 0.0, 1.0)) * SKY_BINS)
    return dr.select(direction.z >= 0.0, dr.minimum(position, SKY_BINS - 1), SKY_BINS)


class FaceRays:
    """The cosine-distributed rays from faces, in two halves of `half` rays.

    Cosine-distributed directions are even over the unit disk (Malley's method). The disk is divided here by level
    chords: at angle θ, sin θ from the middle, a fraction 1/2 + (θ + sin θ cos θ) / π of the disk is below. A distant
    horizon then cuts all chords at the same fraction, whatever the slope, and Sobol points resolve it to 1 / n. Rays of
    covered faces start at their open points, of which the third Sobol dimension chooses one.
    """

    def __init__(self, geometry: Geometry, half: int) -> None:
        self._geometry, self._mi, self._rays = geometry, geometry.mi, 2 * half
        self._base = [self._mi.UInt32(aligned(column * 2.0**24, np.uint32)) for column in sobol(4, 2 * half).T]
        angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 64 * _CHORDS)
        share = 0.5 + (angle + np.sin(angle) * np.cos(angle)) / np.pi
        self._chord = self._mi.Float(aligned(np.interp(np.linspace(0.0, 1.0, _CHORDS + 1), share, angle)))
        found = of_faces(geometry.surfaces, _frames, (4, 3))
        self._leaves = leaves.Leaves(geometry, openness) if geometry.has_copies else None
        if self._leaves is not None:
            found = np.concatenate([found, self._leaves.frames])
        self._faces = [self._mi.Float(aligned(found[:, k])) for k in range(4)]
        self._seeds = _seeds(geometry)
        self._spots = self._mi.Float(aligned(contacts.points()))
        self._covered: tuple[Jit, ...] | None = None

    def start_in_the_open(
        self, solids: NDArray[np.bool_] | None, faces: NDArray[np.integer]
    ) -> contacts.Contacts | None:
        """Return the Contacts among ascending faces, in whose open parts rays start from now on; `solids` are from
        `contacts.solid`."""
        found = contacts.covered(self._geometry, solids, faces, self._points)
        if found is not None:
            place = np.full(self._geometry.face_count, _OPEN, np.uint32)
            place[found.faces] = np.arange(len(found.faces))
            tables = place, found.start, found.spots
            self._covered = tuple(self._mi.UInt32(aligned(each, np.uint32)) for each in tables)
        return found

    def _points(self, faces: NDArray[np.integer]) -> tuple[Jit, Jit]:
        """(points, normals) of the spots of faces, n × SPOTS Vector3f, a little above the faces."""
        mi = self._mi
        index = dr.arange(mi.UInt32, len(faces) * contacts.SPOTS)
        face = dr.gather(mi.UInt32, mi.UInt32(aligned(faces, np.uint32)), index // contacts.SPOTS)
        spot = index % contacts.SPOTS
        row = face if self._leaves is None else self._leaves.row_of_spot(face, spot)
        corner, edge_u, edge_v, normal = self._frame(face, row)
        at = mi.warp.square_to_uniform_triangle(self._at_spot(spot, True))
        point = corner + at.x * edge_u + at.y * edge_v
        return point + self._geometry.lift(point) * normal, normal

    def _frame(self, face: Jit, row: Jit) -> tuple[Jit, ...]:
        """Corner, edges and unit normal of faces, by the row of their frame."""
        corner, edge_u, edge_v, normal = (dr.gather(self._mi.Vector3f, values, row) for values in self._faces)
        if self._leaves is None:
            return corner, edge_u, edge_v, normal
        return self._leaves.placed(face, corner, edge_u, edge_v, normal)

    def _at_spot(self, spot: Jit, active: Jit) -> Jit:
        """The points of spots in the unit square."""
        mi = self._mi
        return mi.Point2f(*(dr.gather(mi.Float, self._spots, 2 * spot + axis, active) for axis in (0, 1)))

    def __call__(self, faces: Jit, seed: int) -> tuple[Jit, Jit, Jit, Jit]:
        """(origin, direction, origin on the other side, normal) of the rays of faces, (n,) UInt32, side by side."""
        mi = self._mi
        index = dr.arange(mi.UInt32, len(faces) * self._rays)
        face, number = dr.gather(mi.UInt32, faces, index // self._rays), index % self._rays
        # One random shift per face decorrelates neighbours and keeps the even spread.
        key = dr.opaque(mi.UInt32, seed) * 2 + _SEED
        own = face if self._seeds is None else dr.gather(mi.UInt32, self._seeds, face)
        # With the usual 4 rounds the shifts of successive faces are correlated; with 6 no test finds a correlation.
        shifts = (*mi.sample_tea_32(own, key, 8), *mi.sample_tea_32(own, key + 1, 8))
        base = (dr.gather(mi.UInt32, values, number) for values in self._base)
        u = [mi.Float(value ^ (shift >> 8)) * 2.0**-24 for value, shift in zip(base, shifts, strict=True)]
        # A chord of the unit disk across the slope, drawn by its length, and a place along it.
        at = u[0] * _CHORDS
        left = dr.minimum(mi.UInt32(at), _CHORDS - 1)
        angle = dr.lerp(*(dr.gather(mi.Float, self._chord, left + k) for k in (0, 1)), at - mi.Float(left))
        across, half_chord = dr.sincos(angle)
        along = (2.0 * u[1] - 1.0) * half_chord
        out = dr.safe_sqrt((1.0 - dr.square(along)) - dr.square(across))
        row = face if self._leaves is None else self._leaves.row(face, number)
        place = mi.Point2f(u[2], u[3])
        if self._covered is not None:
            of_face, start, spots = self._covered
            number = dr.gather(mi.UInt32, of_face, face)
            covered = number != _OPEN
            spot = dr.minimum(mi.UInt32(u[2] * contacts.SPOTS), contacts.SPOTS - 1)
            spot = dr.gather(mi.UInt32, spots, number * contacts.SPOTS + spot, covered)
            place = dr.select(covered, self._at_spot(spot, covered), place)
            other = dr.gather(mi.UInt32, start, number, covered)
            row = dr.select(covered, other if self._leaves is None else self._leaves.row_of_spot(other, spot), row)
        corner, edge_u, edge_v, normal = self._frame(face, row)
        spot = mi.warp.square_to_uniform_triangle(place)
        point = corner + spot.x * edge_u + spot.y * edge_v
        lift = normal * self._geometry.lift(point)
        level = mi.Vector3f(-normal.y, normal.x, 0.0)
        level = dr.normalize(dr.select(dr.squared_norm(level) > 1e-12, level, mi.Vector3f(1.0, 0.0, 0.0)))
        towards = dr.normalize(along * dr.cross(normal, level) + across * level + out * normal)
        return mi.Point3f(point + lift), towards, mi.Point3f(point - lift), normal


def _seeds(geometry: Geometry) -> Jit | None:
    """The numbers by which the rays of each face are drawn, UInt32; None where those of the faces serve."""
    if all(surface.seeds is None for surface in geometry.surfaces):
        return None
    found = np.arange(geometry.face_count, dtype=np.uint32)
    for first, surface in zip(geometry.face_start, geometry.surfaces, strict=False):
        if surface.seeds is not None:
            found[first : first + len(surface.seeds)] = surface.seeds
    return geometry.mi.UInt32(aligned(found, np.uint32))


def _counted(
    code: NDArray[np.int32], count: int
) -> tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.uint16], NDArray[np.uint16]]:
    """(length of each row, faces, hits, missing rays (rows, SKY_BINS + 1)) from the codes (rows, rays) of rays."""
    rows, rays = code.shape
    code.sort(axis=1)
    flat = code.ravel()
    begins = np.empty(flat.size, dtype=bool)
    np.not_equal(flat[1:], flat[:-1], out=begins[1:])
    begins[::rays] = True
    first = np.flatnonzero(begins)
    hits = np.diff(first, append=flat.size).astype(np.uint16)
    seen = flat[first]
    missing = np.zeros((rows, SKY_BINS + 1), dtype=np.uint16)
    surface = seen < count
    missed = ~surface
    missing[first[missed] // rays, seen[missed] - count] = hits[missed]
    return np.bincount(first[surface] // rays, minlength=rows), seen[surface], hits[surface], missing


def openness(geometry: Geometry) -> leaves.Open:
    """Return how open the faces of a Geometry are."""
    mi, count = geometry.mi, geometry.face_count
    origin, direction, _, _ = FaceRays(geometry, _OPEN_RAYS // 2)(dr.arange(mi.UInt32, count), 0)
    out = ~np.array(geometry.cast(mi.Ray3f(origin, direction)).valid, dtype=bool).reshape(count, _OPEN_RAYS)
    up = np.array(direction.z >= 0.0, dtype=bool).reshape(out.shape)
    point = np.array(origin, dtype=np.float32).T.reshape(*out.shape, 3)
    return leaves.Open((out & up).mean(axis=1), (out & ~up).mean(axis=1), point, out)


def _frames(surface: Surface, part: slice) -> Floats:
    """Corner, first edge, second edge and unit normal of faces, (n, 4, 3)."""
    return frames(surface.vertices[surface.faces[part]])
