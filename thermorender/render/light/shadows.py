"""Shadows of the sun that moving objects throw on the faces of the static scene."""

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from thermorender.render.arrays import Floats, Jit, aligned, opaque_vector
from thermorender.render.geometry import Geometry
from thermorender.render.light import radiosity
from thermorender.render.light.environment import Sunlight

# Points of a face that are tested.
_POINTS = 16


class SunlitFaces:
    """The sunlit faces of a static scene, by their place on a plane across the sun's rays."""

    def __init__(self, geometry: Geometry, sun: Sunlight) -> None:
        self._mi, self._sun, self._rays_of = geometry.mi, sun, radiosity.FaceRays(geometry, _POINTS // 2)
        # Copies of a body are not where its faces are.
        whole = np.concatenate([np.full(len(each.faces), each.instances is None) for each in geometry.surfaces])
        self._faces = np.flatnonzero(whole & (sun.lit[: len(whole)] > 0.0))
        corners = np.concatenate([each.vertices[each.faces] for each in geometry.surfaces])[self._faces]
        middle = corners.mean(axis=1)
        self._reach = np.linalg.norm(corners - middle[:, None], axis=2).max(axis=1, initial=0.0)
        self._axes = np.linalg.svd(sun.towards[None])[2]
        place = middle @ self._axes.T
        order = np.argsort(place[:, 1], kind="stable")
        self._faces, self._reach, self._place = self._faces[order], self._reach[order], place[order]
        self._widest = float(self._reach.max(initial=0.0))

    def shaded(self, shape: Geometry, box: Floats, own_from_scene: tuple[Jit, Jit]) -> tuple[NDArray[np.int64], Floats]:
        """Return (faces, part of `Sunlight.lit` that is taken from each) of an object's shadow.

        `shape` is the object's Geometry, `box` (2, 3) its lowest and highest corner in the scene [m], and
        `own_from_scene` the rotation and translation into its own frame.
        """
        mi, towards = self._mi, self._sun.towards
        radius, middle = 0.5 * float(np.linalg.norm(box[1] - box[0])), self._axes @ box.mean(axis=0)
        reach = radius + self._widest
        near = slice(*np.searchsorted(self._place[:, 1], [middle[1] - reach, middle[1] + reach]))
        away, reach = self._place[near] - middle, radius + self._reach[near]
        # The first axis is along the rays, in either sense.
        ahead = away[:, 0] * (self._axes[0] @ towards)
        chosen = (np.hypot(away[:, 1], away[:, 2]) < reach) & (ahead < reach)
        face = self._faces[near][chosen]
        if not face.size:
            return face, np.zeros(0)
        origin, _, _, normal = self._rays_of(mi.UInt32(aligned(face, np.uint32)), 0)
        turn, shift = own_from_scene
        way = opaque_vector(mi, towards)
        facing = dr.dot(normal, way) > 0.0
        ray = mi.Ray3f(mi.Point3f(turn @ origin + shift), mi.Vector3f(turn @ way))
        hidden = facing & shape.caster.ray_test(ray, active=facing)
        taken, open_ = (
            np.array(dr.select(each, mi.Float(1.0), mi.Float(0.0))).reshape(len(face), -1).mean(axis=1)
            for each in (hidden, facing)
        )
        found = np.flatnonzero(taken > 0.0)
        return face[found], self._sun.lit[face[found]] * (taken / np.maximum(open_, 1e-9))[found]
