"""A scene's meshes on the render side: the ray caster, and flat per-face and per-texel arrays for its kernels.

All surfaces share one numbering of faces and one of texels, so a hit becomes two gathers: the face's record and the
texels around the point. The record is the affine map from a point of the face's
plane to its position on the texel map; it also tells the plane, so that points near a hit need no ray of their own.
"""

from dataclasses import dataclass
from functools import cached_property

import drjit as dr
import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.render.pixels import pyramid, slender

_RAYS_AT_ONCE, _FACES_AT_ONCE = 1 << 22, 1 << 20
# A direction upwards that hardly a face's plane holds.
_ASIDE = (0.3717, 0.4693, 0.8010)
# From so many bytes on the C library gives memory as pages of its own, behind 16 bytes that tell their number.
_OWN_PAGES = 1 << 25


@dataclass(frozen=True)
class Hit:
    """Where rays end: Dr.Jit arrays, one entry per ray.

    Attributes
    ----------
    valid : Bool
        Whether anything is hit.
    distance : Float
        Along the ray [m]; infinite for a miss.
    face, surface : UInt32
        Numbers over the whole scene; 0 for a miss.
    mirrored : Float
        From a mirror to what it shows [m]; 0 where there is none.
    """

    valid: object
    distance: object
    face: object
    surface: object
    mirrored: object = 0.0


class Geometry:
    """Ray caster and flat arrays of a scene's surfaces.

    Parameters
    ----------
    mi : module
        Mitsuba with a variant active.
    surfaces : sequence of Surface

    Attributes
    ----------
    face_count : int
        Over all surfaces.
    face_start, texel_start : (S + 1,) int64
        First face and texel of each surface in the flat numbering.
    area, share : (F,) float64
        Each face's area [m²], and its share of the area of all.
    reach : float
        Greatest distance of a vertex from the origin along an axis [m].
    hair : float
        A hair's breadth [m], which coordinates in single precision tell apart: 64 of their steps at `reach`.
    levels : int
        Of the texels' averages over squares, `Geometry.averaged`; 1 where all surfaces have a single texel.
    """

    def __init__(self, mi, surfaces):
        self.mi = mi
        self.surfaces = surfaces
        self.face_start = np.cumsum([0] + [len(surface.faces) for surface in surfaces])
        self.texel_start = np.cumsum([0] + [surface.material.size for surface in surfaces])
        self.face_count = int(self.face_start[-1])
        self.area = 0.5 * np.linalg.norm(of_faces(surfaces, _across, (3,), np.float64), axis=1)
        self.share = self.area / max(self.area.sum(), 1e-300)
        self.reach = max(float(np.abs(surface.vertices).max()) for surface in surfaces)
        self.hair = 64.0 * 2.0**-24 * (1.0 + self.reach)
        meshes = {
            f"s{number}": _mesh(mi, f"s{number}", surface.vertices, surface.faces)
            for number, surface in enumerate(surfaces)
        }
        # Without robust intersections rays leak through triangle edges, and a leak is a sky pixel.
        self.caster = mi.load_dict({"type": "scene", "embree_use_robust_intersections": True, **meshes})
        # Mitsuba numbers shapes over the whole process: number → surface.
        registry = [int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(mesh))[0]) for mesh in meshes.values()]
        surface_of = np.zeros(max(registry) + 1, dtype=np.uint32)
        surface_of[registry] = np.arange(len(registry))
        self._surface_of = mi.UInt32(aligned(surface_of, np.uint32))
        self._face_start = mi.UInt32(aligned(self.face_start[:-1], np.uint32))
        # (levels, surfaces): squares of all surfaces lie behind one another, level after level.
        shapes = [pyramid.sizes(*surface.material.shape) for surface in surfaces]
        self.levels = max(map(len, shapes))
        shapes = np.array([shape + [(1, 1)] * (self.levels - len(shape)) for shape in shapes], dtype=np.int64)
        shapes = shapes.transpose(1, 0, 2).reshape(-1, 2)
        start = np.concatenate([[0], np.cumsum(shapes.prod(axis=1))])
        self._surfaces, self._boxes = len(surfaces), {}
        parts = (start[:-1], shapes[:, 0], shapes[:, 1])
        self._lattice = tuple(mi.Int32(aligned(part, np.int32)) for part in parts)
        self._record = mi.Float(aligned(of_faces(surfaces, _map_records, (8,))))

    def cast(self, ray, coherent=False):
        """Return the Hit of rays (an mi.Ray3f)."""
        return self._hit(self.caster.ray_intersect_preliminary(ray, coherent=coherent))

    def _hit(self, found):
        mi = self.mi
        valid = found.is_valid()
        surface = dr.gather(mi.UInt32, self._surface_of, dr.reinterpret_array(mi.UInt32, found.shape), valid)
        face = dr.gather(mi.UInt32, self._face_start, surface, valid) + found.prim_index
        return Hit(valid, found.t, dr.select(valid, face, 0), surface)

    def seen(self, ray):
        """Return the Hit of a view's rays (an mi.Ray3f), with no distance of 0.

        Embree answers that for a camera on a surface, which has no picture, and for a ray in the plane of a triangle,
        wherever this lies. Such rays, and they alone, are cast anew from a hair's breadth aside.
        """
        hit = self.cast(ray, coherent=True)
        touches = hit.valid & (hit.distance <= 0.0)
        # Opaque: as a literal it would have the kernel compiled anew for each scene.
        aside = dr.opaque(self.mi.Float, self.hair) * self.mi.Vector3f(*_ASIDE)
        beside = self.mi.Ray3f(ray.o + aside, ray.d)
        found = self._hit(self.caster.ray_intersect_preliminary(beside, coherent=True, active=touches))
        return Hit(
            dr.select(touches, found.valid, hit.valid), dr.select(touches, found.distance, hit.distance),
            dr.select(touches, found.face, hit.face), dr.select(touches, found.surface, hit.surface),
        )  # fmt: skip

    def record(self, face, active=True):
        """Return the records of faces, as two Vector4f: the gradient of the column and its offset, and the row's."""
        return tuple(dr.gather(self.mi.Vector4f, self._record, 2 * face + k, active) for k in (0, 1))

    def map_position(self, record, point):
        """Return (column, row) on the texel map, in texels from its upper left corner, of points of a face."""
        return tuple(dr.fma(g.x, point.x, dr.fma(g.y, point.y, dr.fma(g.z, point.z, g.w))) for g in record)

    def normal(self, record):
        """Return a vector along the normal of a face; zero where its map is constant."""
        u, v = (self.mi.Vector3f(g.x, g.y, g.z) for g in record)
        return dr.cross(u, v)

    def points_in_faces(self, pattern):
        """Yield (surface, column, row) on the texel maps, in each face, at every barycentric (u, v) of `pattern`."""
        mi = self.mi
        face_counts = np.diff(self.face_start)
        surface = mi.UInt32(aligned(np.repeat(np.arange(len(face_counts)), face_counts), np.uint32))
        size = [surface_.material.shape[::-1] for surface_ in self.surfaces]
        corner = np.concatenate([s.uv * np.array(n, np.float32) for s, n in zip(self.surfaces, size, strict=True)])
        corner = [[mi.Float(aligned(corner[:, k, axis])) for axis in (0, 1)] for k in range(3)]
        for u, v in np.asarray(pattern).tolist():
            # Opaque weights: as literals they would have the kernel that uses them compiled anew for each point.
            u, v = dr.opaque(mi.Float, u), dr.opaque(mi.Float, v)
            column, row = (
                (1.0 - u - v) * corner[0][axis] + u * corner[1][axis] + v * corner[2][axis] for axis in (0, 1)
            )
            yield surface, column, row

    def nearest(self, surface, column, row, active=True):
        """Return the flat number of the texel at a position on a surface's map; outside, that at its edge."""
        mi = self.mi
        start, rows, columns = self.lattice(surface, active)
        i = dr.clip(mi.Int32(dr.floor(row)), 0, rows - 1)
        j = dr.clip(mi.Int32(dr.floor(column)), 0, columns - 1)
        return mi.UInt32(start + i * columns + j)

    def lattice(self, surface, active=True, level=None):
        """Return (first texel, rows, columns) of surfaces, Int32; or of their squares of 2^level texels a side."""
        index = surface if level is None else surface + level * self._surfaces
        return tuple(dr.gather(self.mi.Int32, values, index, active) for values in self._lattice)

    def averaged(self, values):
        """Return Channels of texels (T, C), and of their means over squares of 2, 4, 8 … texels a side behind them."""
        values = np.asarray(values, dtype=np.float32)
        levels = [[] for _ in range(self.levels - 1)]
        for surface, covered, part in zip(
            self.surfaces, self.covered, np.split(values, self.texel_start[1:-1]), strict=True
        ):
            last = part.reshape(*surface.material.shape, -1)
            found = list(pyramid.squares(last, covered))
            for number, level in enumerate(levels):
                last = found[number] if number < len(found) else (found or [last])[-1]
                level.append(last.reshape(-1, values.shape[1]))
        return Channels(self.mi, np.concatenate([values, *(part for level in levels for part in level)]))

    def boxes(self, first=0):
        """Return boxes round the connected parts of the surfaces from number `first` on, as `slender.boxes`."""
        if first not in self._boxes:
            self._boxes[first] = slender.boxes(self.surfaces[first:])
        return self._boxes[first]

    @cached_property
    def covered(self):
        """Which texels some face covers, (rows, columns) bool for each surface; None where it is all of them."""
        found, covers = [], None
        for number, surface in enumerate(self.surfaces):
            area = of_faces([surface], _mapped_area, (), np.float64).sum()
            if abs(area - 1.0) < 1e-6 or surface.material.size == 1:
                found.append(None)
                continue
            if covers is None:
                covers = self.face_of_texel().numpy() < self.face_count
            part = covers[self.texel_start[number] : self.texel_start[number + 1]]
            found.append(part.reshape(surface.material.shape))
        return found

    def corners(self, lattice, column, row):
        """Return the four texels round a position as [(flat number, weight), …]; outside the map, those at its edge."""
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

    def bilinear(self, channels, lattice, column, row, active=True):
        """Return the Channels at a position on a surface's map, linear between texel centres, as a list of Float."""
        total = None
        for texel, weight in self.corners(lattice, column, row):
            values = [weight * value for value in channels.at(texel, active)]
            total = values if total is None else [a + b for a, b in zip(total, values, strict=True)]
        return total

    @cached_property
    def normals(self):
        """Unit normals of all faces, Channels; zero where a face has no area."""
        return Channels(self.mi, of_faces(self.surfaces, _unit_across, (3,)))

    def face_of_texel(self):
        """Return the face that covers each texel's centre, UInt32 over all texels; `face_count` where there is none.

        The map itself is looked at from above: rays down onto its triangles. A face whose map has no area covers
        nothing.
        """
        mi = self.mi
        found = np.full(int(self.texel_start[-1]), self.face_count, dtype=np.uint32)
        for number, surface in enumerate(self.surfaces):
            rows, columns = surface.material.shape
            if rows * columns == 1:
                continue
            here = found[int(self.texel_start[number]) :][: rows * columns].reshape(rows, columns)
            # The map's triangles, like those of the scene, take 200 bytes each: not all at once.
            for first in range(0, len(surface.faces), _FACES_AT_ONCE):
                part = surface.uv[first : first + _FACES_AT_ONCE]
                self._cover(here, part, int(self.face_start[number]) + first)
        return mi.UInt32(aligned(found, np.uint32))

    def _cover(self, found, uv, first_face):
        """Write into (rows, columns) of texels which of some faces' maps (n, 3, 2) covers each."""
        mi, (rows, columns) = self.mi, found.shape
        corner = uv.reshape(-1, 2).astype(np.float64) * (columns, rows)
        flat = np.column_stack([corner, np.zeros(len(corner))])
        mesh = _mesh(mi, "map", flat, np.arange(len(flat)).reshape(-1, 3))
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


class Channels:
    """A few numbers per texel or face, kept side by side so that one gather brings them all.

    Parameters
    ----------
    mi : module
    values : (n, channels) float array
    """

    def __init__(self, mi, values):
        values = np.asarray(values, dtype=np.float32)
        self.count = values.shape[1]
        self.groups = []
        for first in range(0, self.count, 4):
            group = values[:, first : first + 4]
            width = {1: 1, 2: 2, 3: 4, 4: 4}[group.shape[1]]
            if group.shape[1] != width:
                group = np.pad(group, ((0, 0), (0, width - group.shape[1])))
            kind = {1: mi.Float, 2: mi.Vector2f, 4: mi.Vector4f}[width]
            self.groups.append((kind, min(self.count - first, width), mi.Float(aligned(group))))

    def at(self, index, active=True):
        """Return the channels at flat indices, as a list of Float."""
        found = []
        for kind, used, values in self.groups:
            packet = dr.gather(kind, values, index, active)
            found += [packet] if used == 1 and kind.__name__ == "Float" else [packet[i] for i in range(used)]
        return found


@dataclass(frozen=True)
class OutgoingRadiance:
    """Radiance that leaves surfaces towards a camera: channels of their texels, and corrections of their faces.

    Attributes
    ----------
    texels : Channels
        From `Geometry.averaged`, read at every tap of a pixel: all there is, or the first of the spectral channels,
        which carries nearly all.
    rest : Channels or None
        The other spectral channels, read once per ray, as they tell a hundredth of what the first does.
    faces : Channels or None
        Added to all channels of the texels.
    mirror : Mirror or None
        What changes where the material depends on the angle of view; None where none does.
    """

    texels: Channels
    rest: Channels | None = None
    faces: Channels | None = None
    mirror: object = None

    @classmethod
    def of(cls, geometry, texels, faces=None, mirror=None):
        """Return what leaves surfaces by spectral channels of texels, K arrays (T,), and of faces, (F, K)."""
        rest = geometry.averaged(np.stack(texels[1:], axis=1)) if len(texels) > 1 else None
        own = None if faces is None else Channels(geometry.mi, faces)
        return cls(geometry.averaged(texels[0][:, None]), rest, own, mirror)

    def at_texel(self, texel, face, active):
        """Return all channels of texels, seen on faces, as a list of Float; 0 where not active."""
        values = [part.at(texel, active) for part in (self.texels, self.rest) if part]
        return self._on(face, [each for part in values for each in part], active)

    def at(self, geometry, hit, position):
        """Return all channels at positions (column, row) of a Hit, linear between texels, as a list of Float."""
        lattice = geometry.lattice(hit.surface, hit.valid)
        values = [geometry.bilinear(part, lattice, *position, hit.valid) for part in (self.texels, self.rest) if part]
        return self._on(hit.face, [each for part in values for each in part], hit.valid)

    def _on(self, face, values, active):
        added = self.faces.at(face, active) if self.faces else [0.0] * len(values)
        return [a + b for a, b in zip(values, added, strict=True)]


@dataclass(frozen=True)
class Layer:
    """A ray caster, the view (rotation, origin) in its frame, and what leaves its surfaces."""

    geometry: Geometry
    view: tuple
    outgoing: OutgoingRadiance | None


def box_of(scene):
    """Return the lowest and the highest corner of a scene's surfaces, (2, 3) [m]."""
    corner = [limit(surface.vertices, axis=0) for limit in (np.min, np.max) for surface in scene.surfaces]
    return np.stack([np.min(corner, axis=0), np.max(corner, axis=0)])


def farthest(scene):
    """Return the length of the longest path between surfaces of a scene [m], from 2 m on."""
    return max(float(np.linalg.norm(np.diff(box_of(scene), axis=0))), 2.0)


def refuse_other_surfaces(known, surfaces):
    """Raise unless two sequences of surfaces have the same geometry: vertices, faces, and where texels lie on them."""
    differ = None
    if len(known) != len(surfaces):
        differ = f"{len(known)} surfaces, not {len(surfaces)}"
    for one, other in zip(known, surfaces, strict=False):
        for name in ("vertices", "faces", "uv"):
            first, second = getattr(one, name), getattr(other, name)
            if first is not second and not np.array_equal(first, second):
                differ = differ or f"other {name} in surface {other.name!r}"
        if one.material.shape != other.material.shape:
            differ = differ or f"{one.material.shape} texels, not {other.material.shape}, in surface {other.name!r}"
    if differ:
        raise ThermorenderError(
            f"like=… has {differ}; give one of the same surfaces, at other temperatures or of other materials"
        )


def of_faces(surfaces, job, shape, dtype=np.float32):
    """Return what `job(surface, faces)` finds of all faces, (F, *shape), asked for a million of them at a time.

    A job works in double precision on all corners, which for all faces at once would be most of the memory of a scene.
    """
    found = np.empty((sum(len(surface.faces) for surface in surfaces), *shape), dtype)
    first = 0
    for surface in surfaces:
        for start in range(0, len(surface.faces), _FACES_AT_ONCE):
            part = slice(start, min(start + _FACES_AT_ONCE, len(surface.faces)))
            found[first + part.start : first + part.stop] = job(surface, part)
        first += len(surface.faces)
    return found


def _across(surface, part):
    """Vectors across faces, twice as long as these are large."""
    corner = surface.vertices[surface.faces[part]]
    return np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])


def _unit_across(surface, part):
    """Unit normals of faces; zero where a face has no area."""
    normal = _across(surface, part)
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)


def _mapped_area(surface, part):
    """Areas of faces on the map, whose whole is 1."""
    edge = surface.uv[part, 1:].astype(np.float64) - surface.uv[part, :1]
    return 0.5 * np.abs(edge[:, 0, 0] * edge[:, 1, 1] - edge[:, 0, 1] * edge[:, 1, 0])


def aligned(values, kind=np.float32):
    """Return an array flat, of a kind and at a multiple of 64 bytes: itself where it is so, or else a copy.

    Dr.Jit takes NumPy's memory as it lies, and compiles a kernel anew where it lies otherwise than before: in this
    process or, of those that it keeps on disk, in another. Whatever kernels read goes through here, but not what Embree
    alone reads. What is large has pages of its own, and so lies alike each time; a copy would double its memory.
    """
    values = np.asarray(values)
    lies = values.ctypes.data % 64 == 0 or values.nbytes >= _OWN_PAGES
    if lies and values.dtype == kind and values.flags.c_contiguous:
        return values.reshape(-1)
    size = np.dtype(kind).itemsize
    whole = np.empty(values.size + 64 // size, kind)
    first = -whole.ctypes.data % 64 // size
    found = whole[first : first + values.size]
    found.reshape(values.shape)[...] = values
    return found


def opaque_view(mi, pose):
    """Return (rows of the rotation, origin) of a pose as Dr.Jit values: a new one reuses the compiled kernel."""
    values = [[dr.opaque(mi.Float, float(value)) for value in row] for row in pose[:3]]
    return [mi.Vector3f(*row[:3]) for row in values], mi.Point3f(*(row[3] for row in values))


def view_ray(mi, rotation, origin, x, y):
    """Return the rays (mi.Ray3f) of a view at slopes (x/z, y/z); their directions are of unit length."""
    local = dr.normalize(mi.Vector3f(x, y, 1.0))
    return mi.Ray3f(origin, mi.Vector3f(*(dr.dot(row, local) for row in rotation)))


def _map_records(surface, part):
    """Affine maps (F, 8) from points to texels: gradient and offset of the column, then of the row.

    The gradient lies in the face's plane. Faces without area or with a constant map have the gradient 0.
    """
    corner = surface.vertices[surface.faces[part]]
    texel = surface.uv[part].astype(np.float64) * surface.material.shape[::-1]
    edge = corner[:, 1:] - corner[:, :1]
    change = texel[:, 1:] - texel[:, :1]
    gram = edge @ edge.transpose(0, 2, 1)
    determinant = np.linalg.det(gram)
    flat = determinant <= 1e-12 * np.maximum(gram[:, 0, 0] * gram[:, 1, 1], 1e-300)
    gram[flat] = np.eye(2)
    change[flat] = 0.0
    gradient = (edge.transpose(0, 2, 1) @ np.linalg.solve(gram, change)).transpose(0, 2, 1)
    offset = texel[:, 0] - np.einsum("fak,fk->fa", gradient, corner[:, 0])
    return np.concatenate([gradient, offset[..., None]], axis=-1).reshape(-1, 8)


def positions(vertices):
    """Return vertices (V, 3) as a mesh takes them, (3 V,) float32, with the four bytes behind that Embree reads too."""
    whole = np.empty(3 * len(vertices) + 1, np.float32)
    whole[:-1] = np.ravel(vertices)
    return whole[:-1]


def _mesh(mi, name, vertices, faces):
    mesh = mi.Mesh(name, len(vertices), len(faces))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = positions(vertices)
    # np.array drops array subclasses, which Mitsuba refuses.
    parameters["faces"] = np.array(faces, dtype=np.uint32).ravel()
    parameters.update()
    return mesh
