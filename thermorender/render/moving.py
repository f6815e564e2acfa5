"""Light on and from a moving object, for one place and temperature at a time, without baking the scene again.

The scene was solved without the object. Rays off its faces tell what it receives; by reciprocity the same rays tell
what each face of the ground receives from it, and the rays' other ends what it hides from there. One bounce each
way: light that went twice between object and ground is left out, as is light between two moving objects; both are
weaker by the reflectances of the two.
"""

import drjit as dr
import numpy as np

from thermorender.physics.band import emitted_radiance
from thermorender.render import bake
from thermorender.render.geometry import Channels, Geometry
from thermorender.render.gmres import gmres


class Still:
    """What a moving object must know of the scene that stands still.

    Attributes
    ----------
    geometry : Geometry
    reflectance : (F, N) float32
        Of each face at each node.
    seen : (F + 2, N) float32
        Radiance that leaves each face, and that of the sky and of the surroundings [W m⁻² sr⁻¹].
    """

    def __init__(self, geometry, leaving, reflectance, sky, beyond):
        self.geometry, self.reflectance = geometry, reflectance.astype(np.float32)
        # As faces beyond the last: rays that hit nothing see these.
        self.seen = np.vstack([leaving, sky, beyond]).astype(np.float32)


class Moving:
    """A moving object on the render side.

    Parameters
    ----------
    mi : module
    mover : Mover
    plan : Plan
    materials : sequence of Material
    linear : callable
        sRGB bytes to linear light.

    Attributes
    ----------
    geometry : Geometry
        In the object's own frame.
    pose : (4, 4) float64
        From there to the scene's frame, after `put`.
    temperature : float
        [K], after `put`.
    texels, faces : Channels
        Radiance of the texels and its correction per face, as a still object has them, after `put`.
    colour : Channels
        Linear colour of the texels, and 1.
    """

    def __init__(self, mi, mover, plan, materials, linear):
        self.name, self.surfaces, self._plan = mover.name, mover.surfaces, plan
        self.geometry = Geometry(mi, mover.surfaces)
        colour = linear(np.concatenate([surface.colour.reshape(-1, 3) for surface in mover.surfaces]))
        self.colour = Channels(mi, np.column_stack([colour, np.ones(len(colour))]))
        # One material all over.
        self.material = int(mover.surfaces[0].material.flat[0])
        self._emissivity_at = materials[self.material].emissivity_at
        self._texel_count = len(colour)
        self._put = None

    def put(self, pose, temperature, still):
        """Put the object to a pose and temperature; return (faces, light it adds to them) of the still scene.

        Parameters
        ----------
        pose : (4, 4) array
        temperature : float
            [K].
        still : Still or None
            None where reflection is left out.

        Returns
        -------
        faces : (n,) int64
        added : (n,) float32
            Radiance that these faces of the still scene reflect more than without the object [W m⁻² sr⁻¹].
        """
        key = (pose.tobytes(), temperature)
        if self._put and self._put[0] == key:
            return self._put[1]
        mi, plan = self.geometry.mi, self._plan
        self.pose, self.temperature = pose, temperature
        emitted = float(emitted_radiance(self._emissivity_at, temperature, *plan.band_um))
        self.texels = Channels(mi, np.full((self._texel_count, 1), emitted))
        light, added = np.zeros(self.geometry.face_count), (np.zeros(0, np.int64), np.zeros(0, np.float32))
        if still is not None:
            light, added = self._light(pose, temperature, still)
        self.faces = Channels(mi, light[:, None])
        self._put = (key, added)
        return added

    def _light(self, pose, temperature, still):
        """(light that each own face reflects, what `put` returns)."""
        from scipy.sparse import csr_array

        mi, plan, count, others = self.geometry.mi, self._plan, self.geometry.face_count, still.geometry.face_count
        half = (plan.rays + 1) // 2
        rays = 2 * half
        origin, direction, reverse = bake.face_rays(self.geometry, half)
        matrix, origin_m = _matrix(mi, pose)
        start, along = matrix @ origin + origin_m, matrix @ direction
        # Both ways off a face: a sheet shines to both sides, and either end tells what the object hides from the other.
        codes, ends = [], []
        for own_from, sign in ((origin, 1.0), (reverse, -1.0)):
            own = self.geometry.cast(mi.Ray3f(mi.Point3f(own_from), mi.Vector3f(sign * direction)))
            end = still.geometry.cast(mi.Ray3f(mi.Point3f(start), sign * along))
            there = dr.select(end.valid, end.face, dr.select(sign * along.z >= 0.0, others, others + 1))
            codes.append(dr.select(own.distance < end.distance, others + 2 + own.face, there))
            ends.append(there)
        dr.eval(codes, ends)
        met, met_reverse = (np.array(values, dtype=np.int64) for values in codes)
        end, end_reverse = (np.array(values, dtype=np.int64) for values in ends)
        index = np.arange(0, count * rays + 1, rays)
        seen = csr_array((np.full(met.size, 1.0 / rays), met, index), shape=(count, others + 2 + count))
        rho = np.broadcast_to(1.0 - plan.emissivity[self.material], (count, plan.nodes))
        emitted = plan.emissivity[self.material] * plan.node_radiance([temperature])[0]
        between = seen[:, others + 2 :].tocsr()
        source = seen[:, : others + 2] @ still.seen + (between.sum(axis=1))[:, None] * emitted
        incident = gmres(between, rho, source, 1e-6 * np.abs(source).max(axis=0))
        leaving = emitted + rho * incident

        # Of each ray that ends on the ground, that face sees the object in place of what lies behind.
        faces, changes = [], []
        for first, hidden in ((met, end_reverse), (met_reverse, end)):
            hit = np.flatnonzero(first < others)
            face, own = first[hit], hit // rays
            change = ((leaving[own] - still.seen[hidden[hit]]) * still.reflectance[face]).sum(axis=1)
            faces.append(face)
            changes.append(change * self.geometry.area[own] / (rays * still.geometry.area[face]))
        faces, place = np.unique(np.concatenate(faces), return_inverse=True)
        added = np.bincount(place, np.concatenate(changes), len(faces)).astype(np.float32)
        return (rho * incident).sum(axis=1), (faces, added)


def _matrix(mi, pose):
    """(rotation, translation) of a pose as opaque Dr.Jit values, so that a new one reuses the compiled kernel."""
    values = [[dr.opaque(mi.Float, float(value)) for value in row] for row in pose[:3]]
    rotation = mi.Matrix3f([row[:3] for row in values])
    return rotation, mi.Vector3f(*(row[3] for row in values))
