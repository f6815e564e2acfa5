"""Contacts: faces that a body covers in part, where objects stand on the ground, touch, or intersect.

Light is constant over a face, and a camera sees only the uncovered part. Rays of a partly covered face therefore start
in its uncovered part. A fully covered face is invisible, but texels blend into their neighbours: it uses the rays of
the nearest partly covered one.

A point is covered if a ray from it first hits the back of a solid surface. A surface is solid if diffuse random walks
from its back do not reach the open air. Sheets, leaves and the walls of open cavities are not solid. A house without a
floor is solid if the ground continues below it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from thermorender.render.arrays import Floats, Jit, aligned
from thermorender.render.geometry import Geometry, Hit, frames, of_faces
from thermorender.render.pixels.slender import connected
from thermorender.scene.instances import Instances, alone
from thermorender.scene.surface import Surface

# Points of a face that are tested, in an order in which neighbours are close to each other.
SPOTS = 64
# Random walks from the back of each connected part: largest number of faces, walks per face, largest number of bounces.
_FACES, _WALKS, _BOUNCES = 64, 16, 8
# Largest share of walks from the back of a solid part that escape: some do at the border of the terrain.
_MOST_IN_AIR = 0.05
# Additional rays from a point whose first ray is inconclusive.
_ASIDE = 3
# Number of nearest faces among which a substitute is searched, and least cosine between its normal and the face's.
_NEAREST, _SAME_WAY = 16, 0.7
_RAYS_AT_ONCE = 1 << 21
_SEED = 0x50D
# Faces (n,) → points of them, offset along the normal, and unit normals, n × SPOTS Vector3f each.
PointsOf = Callable[[NDArray[np.integer]], tuple[Jit, Jit]]


@dataclass(frozen=True, eq=False)
class Contacts:
    """Faces with a covered part, and where in them rays start."""

    faces: NDArray[np.uint32]  # (n,) uint32 ascending
    # (n,) uint32 the face on which their rays start: their own, or its substitute
    start: NDArray[np.uint32]
    # (n, SPOTS) uint8 numbers of its open points among those of `points`; open points repeat where others are covered
    spots: NDArray[np.uint8]


def points() -> Floats:
    """Return the points of a face that are tested, (SPOTS, 2) in the unit square, neighbours close to each other."""
    # Hammersley's points, one in each cell of eight by eight, by Morton's order of the cells.
    index = np.arange(SPOTS)
    place = np.column_stack([index + 0.5, _reversed(index) + 0.5]) / SPOTS
    cell = (place * 8).astype(int)
    bits = sum(((cell[:, axis] >> k) & 1) << (2 * k + axis) for axis in (0, 1) for k in range(3))
    return place[np.argsort(bits)]


def _reversed(index: NDArray[np.integer]) -> NDArray[np.integer]:
    """Six bits in reverse order."""
    return sum((((index >> k) & 1) << (5 - k) for k in range(6)), np.zeros_like(index))


def solid(geometry: Geometry) -> NDArray[np.bool_] | None:
    """Return which faces have something solid behind them, (F,); None for a single connected part, such as a bare
    terrain."""
    part = _parts(geometry.surfaces)
    count = int(part.max(initial=-1)) + 1
    if count < 2 and not geometry.has_copies:
        return None
    found = np.append(_solid_parts(geometry, part, count), False)[part]
    for number, surface in enumerate(geometry.surfaces):
        if isinstance(surface.instances, Instances):
            # The body as a whole: a hit identifies the patch of a copy, not the connected part.
            body = Geometry(geometry.mi, [alone(surface)])
            own = _solid_parts(body, np.zeros(body.face_count, np.int64), 1, stands=False)
            found[slice(*geometry.face_start[number : number + 2])] = own[0]
    return found


def _solid_parts(geometry: Geometry, part: NDArray[np.int64], count: int, stands: bool = True) -> NDArray[np.bool_]:
    """Which of `count` parts of a geometry are solid, by the part of each face (F,), −1 for none. With `stands` the
    geometry has ground below it, where walks do not escape."""
    # A lone triangle encloses nothing.
    size = np.bincount(part[part >= 0], minlength=count)
    order = np.random.Generator(np.random.Philox(_SEED)).permutation(np.flatnonzero(part >= 0)).astype(np.uint32)
    order = order[np.argsort(part[order], kind="stable")]
    place = np.arange(len(order)) - np.repeat(np.cumsum(size) - size, size)
    drawn = order[(place < _FACES) & (size[part[order]] > 1)]
    if not drawn.size:
        return np.zeros(count, bool)
    step = _RAYS_AT_ONCE // _WALKS
    air = np.concatenate(
        [_in_air(geometry, drawn[first : first + step], stands) for first in range(0, len(drawn), step)]
    )
    total, walks = np.bincount(part[drawn], air, count), np.bincount(part[drawn], minlength=count) * _WALKS
    return (walks > 0) & (total <= _MOST_IN_AIR * walks)


def covered(
    geometry: Geometry, solids: NDArray[np.bool_] | None, faces: NDArray[np.integer], points_of: PointsOf
) -> Contacts | None:
    """Return the Contacts among ascending `faces`, None where all are open; `points_of` gives the points of faces."""
    if solids is None or not len(faces):
        return None
    found = np.asarray(faces, np.uint32)
    step = _RAYS_AT_ONCE // SPOTS
    back = geometry.mi.UInt8(aligned(solids, np.uint8))
    parts = [_open(geometry, back, *points_of(found[first : first + step])) for first in range(0, len(found), step)]
    opened = np.concatenate(parts)
    partly = ~opened.all(axis=1)
    found, opened = found[partly], opened[partly]
    if not len(found):
        return None
    number = opened.sum(axis=1)
    # Open points first, in order; each is repeated about equally often.
    order = np.argsort(~opened, axis=1, kind="stable")
    chosen = np.arange(SPOTS) * np.maximum(number, 1)[:, None] // SPOTS
    spots = np.take_along_axis(order, chosen, axis=1).astype(np.uint8)
    start = found.copy()
    _substitute(geometry, found, start, spots, number > 0)
    return Contacts(found, start, spots)


def _substitute(
    geometry: Geometry, faces: NDArray[np.uint32], start: NDArray[np.uint32], spots: NDArray[np.uint8],
    usable: NDArray[np.bool_],
) -> None:  # fmt: skip
    """Give faces without an open point the start and spots of the nearest partly open face that faces the same way."""
    from scipy.spatial import cKDTree

    corner = _corners(geometry, faces)
    middle, normal = corner.mean(axis=1), frames(corner)[:, 3]
    surface = np.searchsorted(geometry.face_start, faces, side="right") - 1
    for one in np.unique(surface[~usable]):
        hidden, given = np.flatnonzero(~usable & (surface == one)), np.flatnonzero(usable & (surface == one))
        if not given.size:
            # The surface lies wholly inside a body and is not visible: its rays start anywhere on it.
            spots[hidden] = np.arange(SPOTS)
            continue
        count = min(_NEAREST, given.size)
        near = given[cKDTree(middle[given]).query(middle[hidden], k=count)[1].reshape(len(hidden), count)]
        like = np.einsum("nkj,nj->nk", normal[near], normal[hidden]) > _SAME_WAY
        best = near[np.arange(len(hidden)), like.argmax(axis=1)]
        start[hidden], spots[hidden] = faces[best], spots[best]


def backs(geometry: Geometry, back: Jit, ray: Jit, active: Jit = True, leaves: bool = True) -> tuple[Hit, Jit]:
    """Return (Hit of rays, whether they meet something solid from behind, Bool); `back` is `solid` as UInt8."""
    hit, normal = geometry.cast_with_normal(ray, active, leaves)
    behind = hit.valid & (dr.dot(normal, ray.d) > 0.0) & (dr.gather(type(back), back, hit.face, hit.valid) > 0)
    return hit, behind


def _open(geometry: Geometry, back: Jit, point: Jit, normal: Jit) -> NDArray[np.bool_]:
    """Whether points of faces lie in the open, (n, SPOTS)."""
    mi = geometry.mi
    dr.eval(point, normal)
    count = dr.width(point) // SPOTS
    index = dr.arange(mi.UInt32, count * SPOTS)
    spot = index % SPOTS
    # Upwards, so that a ray from below the ground hits the ground's back, and away from the face.
    slope = dr.square(normal.z)
    away = dr.select(normal.z >= 0.0, dr.maximum(normal.z, 0.1), 0.1 * (1.0 - slope))
    towards = mi.Vector3f(0.0, 0.0, 1.0) - normal.z * normal + away * normal
    towards = dr.normalize(dr.select(dr.squared_norm(towards) > 1e-6, towards, normal))
    # A front that a ray hits may coincide with the back of the body around the point: oblique rays then decide.
    frame, turn = mi.Frame3f(normal), mi.Float(spot) * (2.0 * np.pi * 0.6180339887)
    hidden, doubtful = mi.Bool(False) & (index >= 0), mi.Bool(True) | (index >= 0)
    for number in range(1 + _ASIDE):
        if number:
            sine, cosine = dr.sincos(turn + number * 2.0 * np.pi / _ASIDE)
            towards = frame.to_world(mi.Vector3f(0.8 * cosine, 0.8 * sine, 0.6))
        hit, behind = backs(geometry, back, mi.Ray3f(mi.Point3f(point), towards), doubtful, leaves=False)
        hidden |= behind
        if not number:
            # Only downward faces cast it downwards, and the ground lies below those that are uncovered.
            hidden |= ~hit.valid & (towards.z < 0.0)
        doubtful &= hit.valid & ~behind
        dr.eval(hidden, doubtful)
    return ~np.array(hidden, dtype=bool).reshape(count, SPOTS)


def _in_air(geometry: Geometry, faces: NDArray[np.uint32], stands: bool) -> Floats:
    """Number of the walks from the backs of faces that reach the open air, (n,); see `_solid_parts`."""
    mi = geometry.mi
    whole = frames(_corners(geometry, faces))
    corner, edge_u, edge_v, normal = (mi.Float(aligned(whole[:, k])) for k in range(4))
    index = dr.arange(mi.UInt32, len(faces) * _WALKS)
    row = index // _WALKS
    corner, edge_u, edge_v, normal = (dr.gather(mi.Vector3f, v, row) for v in (corner, edge_u, edge_v, normal))
    random = mi.PCG32(len(faces) * _WALKS, initstate=_SEED)
    at = mi.warp.square_to_uniform_triangle(mi.Point2f(random.next_float32(), random.next_float32()))
    side = -normal
    point = corner + at.x * edge_u + at.y * edge_v
    walking, air = mi.Bool(True) & (index >= 0), mi.Bool(False) & (index >= 0)
    for _ in range(_BOUNCES):
        pair = mi.Point2f(random.next_float32(), random.next_float32())
        towards = mi.Frame3f(side).to_world(mi.warp.square_to_cosine_hemisphere(pair))
        lift = geometry.lift(point)
        ray = mi.Ray3f(mi.Point3f(point + lift * side), towards)
        hit, normal = geometry.cast_with_normal(ray, walking, leaves=False)
        air |= walking & ~hit.valid & ((towards.z > 0.0) | (not stands))
        walking &= hit.valid
        point = point + lift * side + hit.distance * towards
        side = dr.select(walking, -dr.mulsign(normal, dr.dot(normal, towards)), side)
        point = dr.select(walking, point, 0.0)
        dr.eval(walking, air, point, side, random)
    return np.array(air, dtype=np.float64).reshape(len(faces), _WALKS).sum(axis=1)


def _parts(surfaces: Sequence[Surface]) -> NDArray[np.int64]:
    """Number of the connected part that each face belongs to, (F,); −1 for copies of bodies."""
    found, count = list[NDArray[np.int64]](), 0
    for surface in surfaces:
        if surface.instances is not None:
            found.append(np.full(len(surface.faces), -1))
            continue
        if _faces_up(surface):
            # A terrain, or roofs: what lies below is solid as a whole or not at all.
            part = np.zeros(len(surface.faces), np.int64)
        else:
            _, index, of_vertex = connected(surface)
            part = of_vertex[index[:, 0]].astype(np.int64)
        found.append(part + count)
        count += int(part.max(initial=-1)) + 1
    return np.concatenate(found)


def _faces_up(surface: Surface) -> bool:
    """Whether all faces of a surface face upwards."""
    return bool((of_faces([surface], _rise, ()) > 0.0).all())


def _rise(surface: Surface, part: slice) -> Floats:
    corner = surface.vertices[surface.faces[part]][..., :2]
    u, v = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    return np.asarray(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])


def _corners(geometry: Geometry, faces: NDArray[np.integer]) -> Floats:
    """Corners of faces other than those of copies, (n, 3, 3) [m]."""
    found = np.empty((len(faces), 3, 3))
    surface = np.searchsorted(geometry.face_start, faces, side="right") - 1
    for one in np.unique(surface):
        here = surface == one
        own = geometry.surfaces[one]
        found[here] = own.vertices[own.faces[faces[here].astype(np.int64) - geometry.face_start[one]]]
    return found
