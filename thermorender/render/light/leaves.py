"""Rays from instanced bodies, such as crowns: a patch sends them from points of its triangles.

Points are drawn by area among those from which a ray leaves the body. The light of a patch is then that of the leaves
seen from outside, which also receive more of the sky than those within the crown.
"""

from collections.abc import Callable
from typing import NamedTuple

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from thermorender.render.arrays import Floats, Jit, aligned
from thermorender.render.geometry import Geometry, frames
from thermorender.render.light.contacts import SPOTS
from thermorender.render.plan import Plan
from thermorender.render.spectrum import REFERENCE_K
from thermorender.scene.crowns import PATCHES, Crowns
from thermorender.scene.instances import Instances, alone
from thermorender.scene.scene import Scene

# Points that represent a patch of a body, and of crowns. Successive rays start from successive ones.
_DRAWN, _IN_CROWN = 256, 1024
_SEED, _HASH = 0x1EAF, 2654435761
# Odd, near the golden section of _DRAWN.
_TURN = 159
# Least weight and share of an open hemisphere, so that each patch has points to draw.
_LEAST_OPEN = 1e-3


class Open(NamedTuple):
    """How open the triangles of a body alone are."""

    sky: Floats  # (F,) share of each triangle's hemisphere that sees the sky
    below: Floats  # (F,) share that sees what is beyond all triangles below it
    point: NDArray[np.float32]  # (F, R, 3) points of each triangle from which rays start [m]
    out: NDArray[np.bool_]  # (F, R) whether the ray leaves the body


# Of a body's Geometry.
Openness = Callable[[Geometry], Open]


class Leaves:
    """Points of patches, and the places of their copies; `openness` is as `radiosity.openness`."""

    def __init__(self, geometry: Geometry, openness: Openness) -> None:
        self._mi = mi = geometry.mi
        first = np.arange(geometry.face_count, dtype=np.uint32)
        drawn = np.ones(geometry.face_count, np.uint32)
        turn = np.tile(np.array([1.0, 0.0], np.float32), (geometry.face_count, 1))
        scale = np.ones((geometry.face_count, 3), np.float32)
        shift = np.zeros((geometry.face_count, 3), np.float32)
        found = list[Floats]()
        random, count = np.random.Generator(np.random.Philox(_SEED)), geometry.face_count
        for number, surface in enumerate(geometry.surfaces):
            body = surface.instances
            if body is None:
                continue
            here = slice(*geometry.face_start[number : number + 2])
            points = _IN_CROWN if isinstance(body, Crowns) else _DRAWN
            first[here], drawn[here] = count + points * np.tile(np.arange(body.patches), len(body)), points
            heading = np.repeat(np.radians(body.yaw_deg), body.patches)
            turn[here, 0], turn[here, 1] = np.cos(heading), np.sin(heading)
            if isinstance(body, Crowns):
                scale[here], shift[here] = (np.repeat(each, PATCHES, axis=0) for each in (body.half, body.middle))
                made = np.zeros((PATCHES, points, 4, 3))
                made[:, :, 0], made[:, :, 3] = body.leaves(points)
                found.append(made.reshape(-1, 4, 3))
                count += PATCHES * points
                continue
            scale[here] = np.repeat(body.scale, body.patches)[:, None]
            shift[here] = np.repeat(body.position, body.patches, axis=0)
            opened = open_points(geometry, number, openness)
            weight = body.face_area[:, None] * np.where(opened.out, 1.0, _LEAST_OPEN)
            normal = frames(body.vertices[body.faces])[:, 3]
            for patch in range(body.patches):
                own = np.flatnonzero(body.patch == patch)
                triangle, ray = np.divmod(_drawn(weight[own].reshape(-1), random), opened.out.shape[1])
                made = np.zeros((_DRAWN, 4, 3))
                made[:, 0], made[:, 3] = opened.point[own[triangle], ray], normal[own[triangle]]
                found.append(made)
                count += _DRAWN
        # (n, 4, 3) float64: points that represent the patches, in the body's frame, as `geometry.frames` without
        # extent.
        self.frames = np.concatenate(found)
        self._first, self._count = (mi.UInt32(aligned(values, np.uint32)) for values in (first, drawn))
        self._turn, self._scale, self._shift = (mi.Float(aligned(each)) for each in (turn, scale, shift))

    def row(self, face: Jit, number: Jit) -> Jit:
        """Return the row of the frames from which a ray of a face starts, by the ray's number; UInt32."""
        mi = self._mi
        first, count = dr.gather(mi.UInt32, self._first, face), dr.gather(mi.UInt32, self._count, face)
        # Each patch begins elsewhere, so that like copies do not repeat their errors. Lanes of the processor beyond the
        # last ray have gathered a count of 0, and a division by it ends the process.
        # Rays of one point would have like directions, as Sobol' points 256 apart do.
        count = dr.maximum(count, 1)
        return first + (number + (number // count) * _TURN + ((face * _HASH) >> 16)) % count

    def row_of_spot(self, face: Jit, spot: Jit) -> Jit:
        """Return the row of the frames of a spot of a face, one of `contacts.SPOTS`; UInt32."""
        mi = self._mi
        first, count = dr.gather(mi.UInt32, self._first, face), dr.gather(mi.UInt32, self._count, face)
        return dr.select(count > 1, first + spot * (count // SPOTS), face)

    def placed(self, face: Jit, corner: Jit, edge_u: Jit, edge_v: Jit, normal: Jit) -> tuple[Jit, ...]:
        """Return frames of triangles in the scene's frame, for the faces that they belong to."""
        mi = self._mi
        turn = dr.gather(mi.Vector2f, self._turn, face)
        scale, shift = (dr.gather(mi.Vector3f, table, face) for table in (self._scale, self._shift))

        def turned(vector: Jit) -> Jit:
            return mi.Vector3f(turn.x * vector.x + turn.y * vector.y, turn.x * vector.y - turn.y * vector.x, vector.z)

        return turned(scale * corner) + shift, turned(scale * edge_u), turned(scale * edge_v), turned(normal)


def open_points(geometry: Geometry, number: int, openness: Openness) -> Open:
    """Return the Open of the body of a surface of copies, by the surface's number; it is traced once."""
    if number not in geometry.openness:
        geometry.openness[number] = openness(Geometry(geometry.mi, [alone(geometry.surfaces[number])]))
    found: Open = geometry.openness[number]
    return found


def _drawn(weight: Floats, random: np.random.Generator) -> NDArray[np.intp]:
    """Numbers of points, evenly by weight and in random order, (_DRAWN,)."""
    share = np.cumsum(weight)
    place = (random.permutation(_DRAWN) + 0.5) / _DRAWN * share[-1]
    return np.minimum(np.searchsorted(share, place), len(weight) - 1)


def within(geometry: Geometry, openness: Openness, sky: Floats, reflected: NDArray[np.floating]) -> Floats:
    """Return an estimate of the scatter of reflected light within the patches of copies, (F,); 0 for other faces. `sky`
    (F,) is each face's sky fraction, `reflected` (F,) its light, in the unit of the result. The scatter is that of the
    sky fraction between triangles, weighted by area seen from above, times the slope of light against sky fraction over
    the patches of a surface."""
    found = np.zeros(geometry.face_count)
    for number, surface in enumerate(geometry.surfaces):
        body = surface.instances
        if not isinstance(body, Instances):
            continue
        here = slice(*geometry.face_start[number : number + 2])
        spread = within_body(geometry, number, openness)
        more = sky[here] - sky[here].mean()
        slope = float(more @ (reflected[here] - reflected[here].mean())) / max(float(more @ more), 1e-12)
        found[here] = abs(slope) * np.tile(spread, len(body))
    return found


def emitted(geometry: Geometry, scene: Scene, plan: Plan) -> Floats:
    """Return the scatter of emitted radiance within the patches of copies, (F,) [W m⁻² sr⁻¹]; 0 for other faces."""
    found = np.zeros(geometry.face_count)
    for number, surface in enumerate(scene.surfaces):
        if surface.scatter_k is not None and isinstance(surface.instances, Instances):
            first, last = geometry.face_start[number : number + 2]
            emissivity = scene.materials[surface.material.flat[0]].band_emissivity(*plan.band_um, REFERENCE_K)
            kelvin = surface.scatter_k.reshape(-1)[: last - first]
            found[first:last] = 1e3 * plan.radiance_per_mk * float(emissivity) * kelvin
    return found


def within_body(geometry: Geometry, number: int, openness: Openness) -> Floats:
    """Return the spread of the sky fraction over the triangles of each patch of a single body, (patches,): the root
    mean square deviation of triangles seen from above, from the mean of those from which rays start."""
    body = geometry.surfaces[number].instances
    assert isinstance(body, Instances)
    opened = open_points(geometry, number, openness)
    up, weight = opened.sky, body.face_area * np.maximum(opened.sky + opened.below, _LEAST_OPEN)
    mean = np.bincount(body.patch, weight * up) / np.bincount(body.patch, weight)
    seen = body.face_area * np.maximum(up, _LEAST_OPEN)
    square = np.bincount(body.patch, seen * (up - mean[body.patch]) ** 2) / np.bincount(body.patch, seen)
    return np.sqrt(square)
