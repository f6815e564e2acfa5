"""Light on and from a dynamic object, for one pose and temperature at a time, without baking the scene again.

The scene is solved without the object. Rays from the object's faces sample the light it receives. By reciprocity the
same rays give the light that the static scene receives from the object, and the light that it blocks. One bounce each
way is traced. Interreflection between object and ground, and light between two dynamic objects, are left out: both are
weaker by the product of two reflectances.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError, shortened
from thermorender.materials.material import Material
from thermorender.render.arrays import Floats, Jit, Mitsuba, opaque_vector
from thermorender.render.geometry import Geometry
from thermorender.render.layers import OutgoingRadiance
from thermorender.render.light import contacts, radiosity
from thermorender.render.light.environment import SUN_POINTS, Environment, Sunlight
from thermorender.render.light.gmres import gmres
from thermorender.render.light.shadows import SunlitFaces
from thermorender.render.plan import Plan
from thermorender.render.reflection.device_tables import DeviceTables, DirectionalTexels, black_of
from thermorender.scene.scene import Scene
from thermorender.scene.tracks import TrackedObject
from thermorender.units import Number

# {name of a dynamic object: {column of its track: value}}.
Objects = Mapping[str, Mapping[str, Number]]
# As from `DynamicObject.light`.
_Exchange = tuple[Floats, tuple[NDArray[np.int64], NDArray[np.float32]], tuple[Floats, NDArray[Any]]]


@dataclass(frozen=True)
class ObjectState:
    """Pose and temperature of a dynamic object at one time."""

    name: str
    pose: Floats  # (4, 4) from the object's own frame to the scene's
    temperature: float  # [K]
    lit: "ObjectState | None" = None  # the ObjectState whose light is used instead; None for its own

    @property
    def key(self) -> tuple[bytes, float]:
        """Pose and temperature, hashable."""
        return self.pose.tobytes(), self.temperature


def object_states(
    scene: Scene,
    time_s: float,
    objects: Objects | None = None,
    lit_s: float | None = None,
    lit_objects: Objects | None = None,
) -> tuple[ObjectState, ...]:
    """Return the ObjectState of each dynamic object of a scene at a time on their tracks [s], in their order. `objects`
    replaces values of the tracks: {name: {column of its track: value}}. With `lit_s` [s] objects exchange the light of
    that time, with `lit_objects`. Frames close in time then trace it once, which saves half their cost."""
    try:
        finite = np.isfinite(float(time_s))
    except (TypeError, ValueError):
        finite = False
    if not finite:
        raise ThermorenderError(f"time_s={shortened(repr(time_s))} is not a time; give a finite number of seconds")
    objects = objects or {}
    names = [tracked.name for tracked in scene.tracked_objects]
    for name in objects:
        if name not in names:
            raise ThermorenderError(
                f"object {name!r} has no track and cannot change; give one that has "
                f"({', '.join(names) or 'this scene has none'}), or add its track to the scene"
            )
    found = []
    for tracked in scene.tracked_objects:
        values = tracked.at(time_s, **objects.get(tracked.name, {}))
        pose = tracked.world_from_own(values, scene.ground)
        found.append(ObjectState(tracked.name, pose, values["temperature_k"]))
    if lit_s is not None and lit_s != time_s:
        found = [
            replace(one, lit=lit)
            for one, lit in zip(found, object_states(scene, lit_s, lit_objects or objects), strict=True)
        ]
    return tuple(found)


@dataclass(frozen=True)
class StaticLight:
    """Light of the static scene, for dynamic objects."""

    reflectance: NDArray[np.float32]  # (F, N) of each face at each node
    # (F + SKY_BINS + 1, N) radiance that leaves faces, and that of the sky's bins and of the surroundings [W m⁻² sr⁻¹].
    seen: NDArray[np.float32]
    sun: Sunlight | None  # where included

    @classmethod
    def around(cls, environment: Environment, faces: int, nodes: int) -> "StaticLight":
        """Return a StaticLight with zeros for all faces; see `add`."""
        # Rays that hit nothing see these, numbered after the last face.
        outside = np.vstack([environment.sky.mean(axis=0), environment.background]).astype(np.float32)
        seen = np.vstack([np.zeros((faces, nodes), np.float32), outside])
        return cls(np.zeros((faces, nodes), np.float32), seen, environment.sun)

    def add(self, nodes: slice, leaving: Floats, reflectance: Floats) -> None:
        """Set radiance that leaves faces [W m⁻² sr⁻¹] and reflectance at a slice of the nodes, both (F, n)."""
        self.seen[: len(leaving), nodes] = leaving
        self.reflectance[:, nodes] = reflectance


class DynamicObject:
    """A dynamic object with its `geometry` in its own frame; `tables` of directional materials, None if these are
    diffuse."""

    def __init__(
        self, mi: Mitsuba, tracked: TrackedObject, plan: Plan, materials: Sequence[Material],
        tables: DeviceTables | None = None,
    ) -> None:  # fmt: skip
        self.surfaces, self._plan = tracked.surfaces, plan
        self.geometry = Geometry(mi, tracked.surfaces)
        self._rays_of = radiosity.FaceRays(self.geometry, (plan.sampling.rays + 1) // 2)
        self._rays_of.start_in_the_open(contacts.solid(self.geometry), np.arange(self.geometry.face_count))
        self._sun_rays = radiosity.FaceRays(self.geometry, SUN_POINTS // 2)
        # All texels have the same material.
        self._material = int(tracked.surfaces[0].material.flat[0])
        self._emissivity_at = materials[self._material].emissivity_at
        self._texel_count = sum(surface.material.size for surface in tracked.surfaces)
        self._tables = tables if tables and tables.number[self._material] else None

    def light(
        self, state: ObjectState, geometry: Geometry, static: StaticLight | None, sunlit: SunlitFaces | None = None
    ) -> _Exchange:
        """Return (own (F, K), (faces (n,), added (n, K)), (own_square (F,), square (n,))) at an ObjectState.

        `own` is the light that each own face reflects in each channel; `added` is the change of the light that `faces`
        of the static scene reflect [W m⁻² sr⁻¹]. The squares are their squared standard errors due to the number of
        rays, in the band [W² m⁻⁴ sr⁻²]. They assume independent rays, so for Sobol points they are rather too large.
        `geometry` is the static scene's; `static` is None where reflection is left out, `sunlit` without the sun.
        """
        if static is None:
            channels = self._plan.spectrum.channels
            nothing = np.zeros(0, np.int64), np.zeros((0, channels), np.float32)
            count = self.geometry.face_count
            return np.zeros((count, channels)), nothing, (np.zeros(count), np.zeros(0))
        return self._light(state.pose, state.temperature, geometry, static, sunlit)

    def outgoing(self, temperature: float, own: Floats) -> OutgoingRadiance:
        """Return the OutgoingRadiance at a temperature [K], with the light that its faces reflect from `light`."""
        mi, plan = self.geometry.mi, self._plan
        directional = None
        if self._tables:
            material = np.full(self._texel_count, self._material)
            warm = np.full(self._texel_count, temperature)
            black = black_of(plan, self._tables.number, material, warm)
            directional = DirectionalTexels(mi, self._tables, self._tables.number[material], black)
        emitted = plan.spectrum.emitted_at(self._emissivity_at, temperature, plan.band_um)
        texels = [np.full(self._texel_count, value, np.float32) for value in emitted]
        return OutgoingRadiance.of(self.geometry, texels, own, directional)

    def box(self, pose: Floats) -> Floats:
        """Return the lowest and highest corner of the object at a pose, (2, 3) [m]."""
        corner = np.concatenate([surface.vertices for surface in self.surfaces]) @ pose[:3, :3].T + pose[:3, 3]
        return np.stack([corner.min(axis=0), corner.max(axis=0)])

    def shadow(self, pose: Floats, sunlit: SunlitFaces) -> tuple[NDArray[np.int64], Floats]:
        """Return (faces, part of `Sunlight.lit` taken from each) of the object's shadow at a pose."""
        own_from_scene = _matrix(self.geometry.mi, np.asarray(np.linalg.inv(pose), np.float64))
        return sunlit.shaded(self.geometry, self.box(pose), own_from_scene)

    def _light(
        self, pose: Floats, temperature: float, geometry: Geometry, static: StaticLight, sunlit: SunlitFaces | None
    ) -> _Exchange:
        """As `light`."""
        from scipy.sparse import csr_array

        mi, plan, count, others = self.geometry.mi, self._plan, self.geometry.face_count, geometry.face_count
        spectrum, known = plan.spectrum, len(static.seen)
        rays = 2 * ((plan.sampling.rays + 1) // 2)
        origin, direction, reverse, _ = self._rays_of(dr.arange(mi.UInt32, count), 0)
        matrix, origin_m = _matrix(mi, pose)
        start, along = matrix @ origin + origin_m, matrix @ direction
        # Rays go both ways from a face: a sheet radiates to both sides, and each end shows the light that the object
        # hides from the other. As in the bake, a static face receives light on its front only.
        codes, ends, fronts = list[Jit](), list[Jit](), list[Jit]()
        for own_from, sign in ((origin, 1.0), (reverse, -1.0)):
            own = self.geometry.cast(mi.Ray3f(mi.Point3f(own_from), mi.Vector3f(sign * direction)))
            other = geometry.cast(mi.Ray3f(mi.Point3f(start), sign * along))
            there = dr.select(other.valid, other.face, others + radiosity.background_code(mi, sign * along))
            codes.append(dr.select(own.distance < other.distance, known + own.face, there))
            ends.append(there)
            normal = mi.Vector3f(*geometry.normals.at(other.face, other.valid))
            fronts.append(other.valid & (dr.dot(normal, sign * along) < 0.0))
        dr.eval(codes, ends, fronts)
        met, met_reverse = (np.array(values, dtype=np.int64) for values in codes)
        end, end_reverse = (np.array(values, dtype=np.int64) for values in ends)
        index = np.arange(0, count * rays + 1, rays)
        seen = csr_array((np.full(met.size, 1.0 / rays), met, index), shape=(count, known + count))
        rho = np.broadcast_to(1.0 - spectrum.emissivity[self._material], (count, spectrum.nodes))
        emitted = spectrum.emissivity[self._material] * spectrum.black([temperature])[0]
        between = seen[:, known:].tocsr()
        source = seen[:, :known] @ static.seen + (between.sum(axis=1))[:, None] * emitted
        if static.sun is not None:
            source += self._sunlit(pose, geometry, static.sun.towards)[:, None] * static.sun.facing
        incident = gmres(between, rho, source, 1e-6 * np.abs(source).max(axis=0))
        leaving = emitted + rho * incident

        # Each ray that ends on a static face: that face sees the object instead of the surface behind it.
        ends_on, changes, squares = [], [], []
        for first, hidden, front in ((met, end_reverse, fronts[0]), (met_reverse, end, fronts[1])):
            hit = np.flatnonzero((first < others) & np.array(front))
            face, source_face = first[hit], hit // rays
            weight = self.geometry.area[source_face] / (rays * geometry.area[face])
            change = (leaving[source_face] - static.seen[hidden[hit]]) * static.reflectance[face]
            ends_on.append(face)
            squares.append((change.sum(axis=1) * weight) ** 2)
            changes.append((change @ spectrum.share.T) * weight[:, None])
        if static.sun is not None and sunlit is not None:
            face, taken = self.shadow(pose, sunlit)
            change = -taken[:, None] * static.sun.facing * static.reflectance[face]
            ends_on.append(face)
            squares.append(np.zeros(len(face)))
            changes.append(change @ spectrum.share.T)
        faces, row = np.unique(np.concatenate(ends_on), return_inverse=True)
        columns = np.concatenate(changes).T
        added = np.stack([np.bincount(row, change, len(faces)) for change in columns], axis=1)
        square = np.bincount(row, np.concatenate(squares), len(faces))
        reflected = np.concatenate([(static.seen * rho[0]).sum(axis=1), (leaving * rho[0]).sum(axis=1)])
        own_square = np.maximum(seen @ reflected**2 - (seen @ reflected) ** 2, 0.0) / rays
        own_light = incident @ spectrum.reflected[self._material].T
        return own_light, (faces, added.astype(np.float32)), (own_square, square)

    def _sunlit(self, pose: Floats, geometry: Geometry, towards: Floats) -> Floats:
        """The sun's irradiance on each own face over that of a plane normal to its rays, (F,), among static faces."""
        mi, count = self.geometry.mi, self.geometry.face_count
        origin, _, _, normal = self._sun_rays(dr.arange(mi.UInt32, count), 0)
        matrix, origin_m = _matrix(mi, pose)
        own_way = opaque_vector(mi, pose[:3, :3].T @ towards)
        cosine = dr.dot(normal, own_way)
        facing = (cosine > 0.0) & ~self.geometry.caster.ray_test(mi.Ray3f(origin, own_way), active=cosine > 0.0)
        lit = dr.maximum(cosine, 0.0) * geometry.sunlight(mi.Point3f(matrix @ origin + origin_m), towards, facing)
        return np.array(lit, np.float64).reshape(count, -1).mean(axis=1)


def _matrix(mi: Mitsuba, pose: Floats) -> tuple[Jit, Jit]:
    """(rotation, translation) of a pose as opaque Dr.Jit values, so that a new pose reuses the kernel."""
    values = [[dr.opaque(mi.Float, float(value)) for value in row] for row in pose[:3]]
    rotation = mi.Matrix3f([row[:3] for row in values])
    return rotation, mi.Vector3f(*(row[3] for row in values))
