"""Light on and from a moving object, for one place and temperature at a time, without baking the scene again.

The scene was solved without the object. Rays off its faces tell what it receives; by reciprocity the same rays tell
what each face of the ground receives from it, and the rays' other ends what it hides from there. One bounce each
way: light that went twice between object and ground is left out, as is light between two moving objects; both are
weaker by the reflectances of the two.
"""

import drjit as dr
import numpy as np

from thermorender.render import bake, specular
from thermorender.render.geometry import Channels, Geometry, Shown
from thermorender.render.gmres import gmres


class Still:
    """What a moving object must know of the scene that stands still.

    Attributes
    ----------
    geometry : Geometry
    reflectance : (F, N) float32
        Of each face at each node.
    seen : (F + SKY_BINS + 1, N) float32
        Radiance that leaves each face, and that of the sky's bins and of the surroundings [W m⁻² sr⁻¹].
    """

    def __init__(self, geometry, leaving, reflectance, outside):
        self.geometry, self.reflectance = geometry, reflectance.astype(np.float32)
        # As faces beyond the last: rays that hit nothing see these.
        self.seen = np.vstack([leaving, outside.sky.mean(axis=0), outside.beyond]).astype(np.float32)


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
    laws : Laws or None
        Of the scene's directional materials; None where none is shown as such.

    Attributes
    ----------
    geometry : Geometry
        In the object's own frame.
    pose : (4, 4) float64
        From there to the scene's frame, after `put`.
    temperature : float
        [K], after `put`.
    shown : Shown
        As a still object's, after `put`.
    colour : Shown
        Linear colour of the texels, and 1.
    """

    def __init__(self, mi, mover, plan, materials, linear, laws=None):
        self.name, self.surfaces, self._plan = mover.name, mover.surfaces, plan
        self.geometry = Geometry(mi, mover.surfaces)
        colour = linear(np.concatenate([surface.colour.reshape(-1, 3) for surface in mover.surfaces]))
        self.colour = Shown(Channels(mi, np.column_stack([colour, np.ones(len(colour))])))
        # One material all over.
        self.material = int(mover.surfaces[0].material.flat[0])
        self._emissivity_at = materials[self.material].emissivity_at
        self._texel_count = len(colour)
        self._laws = laws if laws and laws.number[self.material] else None
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
        added : (n, K) float32
            What these faces of the still scene reflect more than without the object, in each channel [W m⁻² sr⁻¹].
        """
        key = (pose.tobytes(), temperature)
        if self._put and self._put[0] == key:
            return self._put[1]
        mi, plan = self.geometry.mi, self._plan
        self.pose, self.temperature = pose, temperature
        emitted = plan.spectrum.emitted_at(self._emissivity_at, temperature, plan.band_um)
        channels = plan.spectrum.channels
        light = np.zeros((self.geometry.face_count, channels))
        added = np.zeros(0, np.int64), np.zeros((0, channels), np.float32)
        if still is not None:
            light, added = self._light(pose, temperature, still)
        mirror = None
        if self._laws:
            material = np.full(self._texel_count, self.material)
            black = specular.black_of(plan, self._laws, material, np.full(self._texel_count, temperature))
            mirror = specular.Mirror(mi, self._laws, material, black)
        self.shown = Shown.of(mi, [np.full(self._texel_count, value, np.float32) for value in emitted], light, mirror)
        self._put = (key, added)
        return added

    def box(self):
        """Return the lowest and highest corner of the object where it is now, (2, 3) [m]."""
        place = np.concatenate([surface.vertices for surface in self.surfaces]) @ self.pose[:3, :3].T + self.pose[:3, 3]
        return np.stack([place.min(axis=0), place.max(axis=0)])

    def _light(self, pose, temperature, still):
        """(light that each own face reflects, what `put` returns)."""
        from scipy.sparse import csr_array

        mi, plan, count, others = self.geometry.mi, self._plan, self.geometry.face_count, still.geometry.face_count
        spectrum, known = plan.spectrum, len(still.seen)
        half = (plan.rays + 1) // 2
        rays = 2 * half
        origin, direction, reverse, _ = bake.face_rays(self.geometry, half)
        matrix, origin_m = _matrix(mi, pose)
        start, along = matrix @ origin + origin_m, matrix @ direction
        # Both ways off a face: a sheet shines to both sides, and either end tells what the object hides from the other.
        codes, ends = [], []
        for own_from, sign in ((origin, 1.0), (reverse, -1.0)):
            own = self.geometry.cast(mi.Ray3f(mi.Point3f(own_from), mi.Vector3f(sign * direction)))
            end = still.geometry.cast(mi.Ray3f(mi.Point3f(start), sign * along))
            there = dr.select(end.valid, end.face, others + bake.beyond_code(mi, sign * along))
            codes.append(dr.select(own.distance < end.distance, known + own.face, there))
            ends.append(there)
        dr.eval(codes, ends)
        met, met_reverse = (np.array(values, dtype=np.int64) for values in codes)
        end, end_reverse = (np.array(values, dtype=np.int64) for values in ends)
        index = np.arange(0, count * rays + 1, rays)
        seen = csr_array((np.full(met.size, 1.0 / rays), met, index), shape=(count, known + count))
        rho = np.broadcast_to(1.0 - spectrum.emissivity[self.material], (count, spectrum.nodes))
        emitted = spectrum.emissivity[self.material] * spectrum.black([temperature])[0]
        between = seen[:, known:].tocsr()
        source = seen[:, :known] @ still.seen + (between.sum(axis=1))[:, None] * emitted
        incident = gmres(between, rho, source, 1e-6 * np.abs(source).max(axis=0))
        leaving = emitted + rho * incident

        # Of each ray that ends on the ground, that face sees the object in place of what lies behind.
        faces, changes = [], []
        for first, hidden in ((met, end_reverse), (met_reverse, end)):
            hit = np.flatnonzero(first < others)
            face, own = first[hit], hit // rays
            change = ((leaving[own] - still.seen[hidden[hit]]) * still.reflectance[face]) @ spectrum.share.T
            faces.append(face)
            changes.append(change * (self.geometry.area[own] / (rays * still.geometry.area[face]))[:, None])
        faces, place = np.unique(np.concatenate(faces), return_inverse=True)
        changes = np.concatenate(changes)
        added = np.stack([np.bincount(place, change, len(faces)) for change in changes.T], axis=1)
        return incident @ spectrum.reflected[self.material].T, (faces, added.astype(np.float32))


def _matrix(mi, pose):
    """(rotation, translation) of a pose as opaque Dr.Jit values, so that a new one reuses the compiled kernel."""
    values = [[dr.opaque(mi.Float, float(value)) for value in row] for row in pose[:3]]
    rotation = mi.Matrix3f([row[:3] for row in values])
    return rotation, mi.Vector3f(*(row[3] for row in values))
