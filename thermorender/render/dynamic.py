"""Light on and from a dynamic object, for one pose and temperature at a time, without baking the scene again.

The scene was solved without the object. Rays off its faces tell what it receives; by reciprocity the same rays tell
what each face of the static scene receives from it, and the rays' other ends what it hides from there. One bounce each
way: light that went twice between object and ground is left out, as is light between two dynamic objects; both are
weaker by the reflectances of the two.
"""

from dataclasses import dataclass, replace

import drjit as dr
import numpy as np

from thermorender.errors import ThermorenderError, shortened
from thermorender.render import mirrors
from thermorender.render.geometry import Geometry, OutgoingRadiance
from thermorender.render.light import radiosity
from thermorender.render.light.gmres import gmres


@dataclass(frozen=True)
class Placement:
    """Where a dynamic object is and how warm, at one time.

    Attributes
    ----------
    name : str
    pose : (4, 4) float64
        From the object's own frame to the scene's.
    temperature : float
        [K].
    lit : Placement or None
        That whose light it gets and gives; None where it is its own.
    """

    name: str
    pose: np.ndarray
    temperature: float
    lit: "Placement | None" = None

    @property
    def key(self):
        """What it is but for its light, hashable."""
        return self.pose.tobytes(), self.temperature


def placements(scene, time_s, objects=None, lit_s=None):
    """Return the Placement of each dynamic object of a scene at a time, a tuple in their order.

    Parameters
    ----------
    scene : Scene
    time_s : float
        On their tracks [s].
    objects : dict, optional
        {name: {column of its track: value}} to take instead of the track's.
    lit_s : float, optional
        Time whose light they get and give [s], which takes as long as all else: for instants next to that.

    Raises
    ------
    ThermorenderError
        A time that is no finite number, an object that has no track or leaves the terrain, or an unknown column.
    """
    try:
        finite = np.isfinite(float(time_s))
    except (TypeError, ValueError):
        finite = False
    if not finite:
        raise ThermorenderError(f"time_s={shortened(repr(time_s))} is no time; give a finite number of seconds")
    objects = objects or {}
    names = [tracked.name for tracked in scene.tracked_objects]
    for name in objects:
        if name not in names:
            raise ThermorenderError(
                f"object {name!r} has no track and cannot change; give one that has "
                f"({', '.join(names) or 'there is none'}), or add its track to the scene"
            )
    found = []
    for tracked in scene.tracked_objects:
        values = tracked.at(time_s, **objects.get(tracked.name, {}))
        pose = tracked.world_from_own(values, scene.ground)
        found.append(Placement(tracked.name, pose, values["temperature_k"]))
    if lit_s is not None and lit_s != time_s:
        found = [replace(one, lit=lit) for one, lit in zip(found, placements(scene, lit_s, objects), strict=True)]
    return tuple(found)


@dataclass(frozen=True)
class StaticLight:
    """What a dynamic object must know of the static scene's light.

    Attributes
    ----------
    reflectance : (F, N) float32
        Of each face at each node.
    seen : (F + SKY_BINS + 1, N) float32
        Radiance that leaves each face, and that of the sky's bins and of the surroundings [W m⁻² sr⁻¹].
    """

    reflectance: np.ndarray
    seen: np.ndarray

    @classmethod
    def around(cls, environment, faces, nodes):
        """Return that of a number of faces of which nothing is known yet; see `add`."""
        # As faces beyond the last: rays that hit nothing see these.
        outside = np.vstack([environment.sky.mean(axis=0), environment.background]).astype(np.float32)
        return cls(np.zeros((faces, nodes), np.float32), np.vstack([np.zeros((faces, nodes), np.float32), outside]))

    def add(self, nodes, leaving, reflectance):
        """Tell what faces radiate [W m⁻² sr⁻¹] and reflect at a slice of the nodes, both (F, n)."""
        self.seen[: len(leaving), nodes] = leaving
        self.reflectance[:, nodes] = reflectance


class DynamicObject:
    """An object with a track, on the render side.

    Parameters
    ----------
    mi : module
    tracked : TrackedObject
    plan : Plan
    materials : sequence of Material
    tables : DeviceTables or None
        Of the scene's directional materials; None where none is shown as such.

    Attributes
    ----------
    geometry : Geometry
        In the object's own frame.
    """

    def __init__(self, mi, tracked, plan, materials, tables=None):
        self.surfaces, self._plan = tracked.surfaces, plan
        self.geometry = Geometry(mi, tracked.surfaces)
        # One material all over.
        self._material = int(tracked.surfaces[0].material.flat[0])
        self._emissivity_at = materials[self._material].emissivity_at
        self._texel_count = sum(surface.material.size for surface in tracked.surfaces)
        self._tables = tables if tables and tables.number[self._material] else None

    def light(self, placement, geometry, static):
        """Return (light that each own face reflects, (faces, light it adds to them), errors) at a Placement.

        Parameters
        ----------
        placement : Placement
        geometry : Geometry
            Of the static scene.
        static : StaticLight or None
            None where reflection is left out.

        Returns
        -------
        own : (F, K)
            In each channel [W m⁻² sr⁻¹].
        faces : (n,) int64
            Of the static scene.
        added : (n, K) float32
            What these reflect more than without the object, in each channel [W m⁻² sr⁻¹].
        own_square : (F,), square : (n,)
            Of the standard errors of these by the rays' number, in the band [W² m⁻⁴ sr⁻²].

        Notes
        -----
        The errors are those of rays that know nothing of each other. Of Sobol's, which stand evenly, they are too large
        rather than too small.
        """
        if static is None:
            channels = self._plan.spectrum.channels
            return np.zeros((self.geometry.face_count, channels)), (
                np.zeros(0, np.int64),
                np.zeros((0, channels), np.float32),
            ), (np.zeros(self.geometry.face_count), np.zeros(0))  # fmt: skip
        return self._light(placement.pose, placement.temperature, geometry, static)

    def outgoing(self, temperature, own):
        """Return the OutgoingRadiance at a temperature [K], with light that its faces reflect as by `light`."""
        mi, plan = self.geometry.mi, self._plan
        mirror = None
        if self._tables:
            material = np.full(self._texel_count, self._material)
            warm = np.full(self._texel_count, temperature)
            black = mirrors.black_of(plan, self._tables.number, material, warm)
            mirror = mirrors.Mirror(mi, self._tables, material, black)
        emitted = plan.spectrum.emitted_at(self._emissivity_at, temperature, plan.band_um)
        texels = [np.full(self._texel_count, value, np.float32) for value in emitted]
        return OutgoingRadiance.of(self.geometry, texels, own, mirror)

    def box(self, pose):
        """Return the lowest and highest corner of the object at a pose, (2, 3) [m]."""
        corner = np.concatenate([surface.vertices for surface in self.surfaces]) @ pose[:3, :3].T + pose[:3, 3]
        return np.stack([corner.min(axis=0), corner.max(axis=0)])

    def _light(self, pose, temperature, geometry, static):
        """As `light`."""
        from scipy.sparse import csr_array

        mi, plan, count, others = self.geometry.mi, self._plan, self.geometry.face_count, geometry.face_count
        spectrum, known = plan.spectrum, len(static.seen)
        half = (plan.rays + 1) // 2
        rays = 2 * half
        origin, direction, reverse, _ = radiosity.face_rays(self.geometry, half)
        matrix, origin_m = _matrix(mi, pose)
        start, along = matrix @ origin + origin_m, matrix @ direction
        # Both ways off a face: a sheet shines to both sides, and either end tells what the object hides from the other.
        # A static face gets light on its front alone, as in the bake: what stands in the ground does not light it.
        codes, ends, fronts = [], [], []
        for own_from, sign in ((origin, 1.0), (reverse, -1.0)):
            own = self.geometry.cast(mi.Ray3f(mi.Point3f(own_from), mi.Vector3f(sign * direction)))
            end = geometry.cast(mi.Ray3f(mi.Point3f(start), sign * along))
            there = dr.select(end.valid, end.face, others + radiosity.background_code(mi, sign * along))
            codes.append(dr.select(own.distance < end.distance, known + own.face, there))
            ends.append(there)
            normal = mi.Vector3f(*geometry.normals.at(end.face, end.valid))
            fronts.append(end.valid & (dr.dot(normal, sign * along) < 0.0))
        dr.eval(codes, ends, fronts)
        met, met_reverse = (np.array(values, dtype=np.int64) for values in codes)
        end, end_reverse = (np.array(values, dtype=np.int64) for values in ends)
        index = np.arange(0, count * rays + 1, rays)
        seen = csr_array((np.full(met.size, 1.0 / rays), met, index), shape=(count, known + count))
        rho = np.broadcast_to(1.0 - spectrum.emissivity[self._material], (count, spectrum.nodes))
        emitted = spectrum.emissivity[self._material] * spectrum.black([temperature])[0]
        between = seen[:, known:].tocsr()
        source = seen[:, :known] @ static.seen + (between.sum(axis=1))[:, None] * emitted
        incident = gmres(between, rho, source, 1e-6 * np.abs(source).max(axis=0))
        leaving = emitted + rho * incident

        # Of each ray that ends on the ground, that face sees the object in place of what lies behind.
        faces, changes, squares = [], [], []
        for first, hidden, front in ((met, end_reverse, fronts[0]), (met_reverse, end, fronts[1])):
            hit = np.flatnonzero((first < others) & np.array(front))
            face, own = first[hit], hit // rays
            weight = self.geometry.area[own] / (rays * geometry.area[face])
            change = (leaving[own] - static.seen[hidden[hit]]) * static.reflectance[face]
            faces.append(face)
            squares.append((change.sum(axis=1) * weight) ** 2)
            changes.append((change @ spectrum.share.T) * weight[:, None])
        faces, row = np.unique(np.concatenate(faces), return_inverse=True)
        changes = np.concatenate(changes)
        added = np.stack([np.bincount(row, change, len(faces)) for change in changes.T], axis=1)
        square = np.bincount(row, np.concatenate(squares), len(faces))
        reflected = np.concatenate([(static.seen * rho[0]).sum(axis=1), (leaving * rho[0]).sum(axis=1)])
        own_square = np.maximum(seen @ reflected**2 - (seen @ reflected) ** 2, 0.0) / rays
        own_light = incident @ spectrum.reflected[self._material].T
        return own_light, (faces, added.astype(np.float32)), (own_square, square)


def _matrix(mi, pose):
    """(rotation, translation) of a pose as opaque Dr.Jit values, so that a new one reuses the compiled kernel."""
    values = [[dr.opaque(mi.Float, float(value)) for value in row] for row in pose[:3]]
    rotation = mi.Matrix3f([row[:3] for row in values])
    return rotation, mi.Vector3f(*(row[3] for row in values))
