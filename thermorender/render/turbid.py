"""Rays through crowns: chords for Beer's law, and random free flights.

Each crown has a convex hull of triangles, in a ray caster of their own beside that of the solid surfaces. A ray goes
from hull to hull, and the chord in each crown is analytic. Where crowns overlap their densities add: transmittances are
exact, the order of their leaves is not.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from thermorender.render.arrays import Floats, Jit, Mitsuba, aligned
from thermorender.render.pixels import shapes
from thermorender.scene.crowns import PATCHES, PROJECTION, Crowns
from thermorender.scene.surface import Surface

# Crowns that a ray remembers, so that leaving a hull does not count as entering it: more are rarely entered at once.
_REMEMBERED = 4
# Hulls that are looked at beyond the end of a ray: one in which it begins may not be left before.
_AFTER = 3
# Hulls are larger by a random share up to this, so that those of crowns side by side have no common face.
_LARGER = 0.02
_GOLDEN = 0.6180339887498949


class FreeFlight(NamedTuple):
    """Where rays meet leaves."""

    met: Jit  # Bool
    distance: Jit  # along the ray [m]
    crown: Jit  # UInt32; 0 where none is met
    quarter: Jit  # UInt32, part of the crown: 2 × shell + upper


class UnitBody(NamedTuple):
    """The frames of crowns in which they are a unit ball or cube."""

    middle: Jit  # Vector3f [m]
    scale: Jit  # Vector3f, inverse of the half-extents [1/m]
    turn: Jit  # Vector2f, cosine and sine of the heading
    extinction: Jit  # optical depth per length [1/m]
    box: Jit  # Bool

    def vector(self, v: Jit) -> Jit:
        """Return a vector of the scene's frame in those of the crowns."""
        scale, turn = self.scale, self.turn
        return type(self.middle)(
            scale.x * (turn.x * v.x - turn.y * v.y), scale.y * (turn.y * v.x + turn.x * v.y), scale.z * v.z
        )

    def point(self, p: Jit) -> Jit:
        """Return a point of the scene's frame in those of the crowns."""
        return self.vector(type(self.middle)(p) - self.middle)

    def inner(self, at: Jit) -> Jit:
        """Return the share of the volume that is nearer to the middle than points in these frames, Float."""
        wide = dr.max(dr.abs(at))
        width = dr.select(self.box, wide, dr.norm(at))
        return dr.minimum(width * width * width, 1.0)

    def quarter(self, at: Jit) -> Jit:
        """Return the part of the crown at points in these frames, 2 × shell + upper."""
        number = dr.uint32_array_t(at.z)
        return dr.select(self.inner(at) >= 0.5, number(2), 0) + dr.select(at.z >= 0.0, number(1), 0)

    def chord(self, at: Jit, way: Jit) -> tuple[Jit, Jit]:
        """Return distances at which lines enter and leave the crowns, equal where they miss; `at` and `way` are a point
        and the direction of unit length in the scene, both in these frames."""
        # Of an ellipsoid, from the point nearest to its middle: the difference of large squares would not be exact.
        square = dr.maximum(dr.squared_norm(way), 1e-30)
        nearest = -dr.dot(at, way) / square
        reach = dr.safe_sqrt((1.0 - dr.squared_norm(at + nearest * way)) / square)
        slope = dr.rcp(dr.select(dr.abs(way) < 1e-20, 1e-20, way))
        one, other = (-1.0 - at) * slope, (1.0 - at) * slope
        enter, leave = dr.max(dr.minimum(one, other)), dr.min(dr.maximum(one, other))
        start = dr.select(self.box, enter, nearest - reach)
        return start, dr.select(self.box, dr.maximum(enter, leave), nearest + reach)


class Chord(NamedTuple):
    """A ray's path in a crown."""

    crown: Jit  # UInt32; 0 where inactive
    frame: UnitBody
    at: Jit  # Vector3f, origin of the ray in the frame
    way: Jit  # Vector3f, its direction there
    start: Jit  # distance of its begin [m]
    depth: Jit  # optical depth of the whole chord; 0 where inactive
    new: Jit  # Bool, whether there is one


# What rays carry from crown to crown, and what they do in each: (whether to go on, state) of a Chord and the state.
State = tuple[Jit, ...]
Visit = Callable[[Chord, State], tuple[Jit, State]]


class CrownField:
    """The crowns of surfaces. `face_start` and `texel_start` number their faces and texels; `hair` is the smallest
    offset between points [m]."""

    def __init__(
        self, mi: Mitsuba, surfaces: Sequence[Surface], face_start: NDArray[np.integer],
        texel_start: NDArray[np.integer], hair: float,
    ) -> None:  # fmt: skip
        own = [(k, each.instances) for k, each in enumerate(surfaces) if isinstance(each.instances, Crowns)]
        self.mi, self.count = mi, sum(len(crowns) for _, crowns in own)
        vertices, faces, owner, first = list[Floats](), list[NDArray[Any]](), list[NDArray[Any]](), 0
        for _, crowns in own:
            corner, triangles = _hull(crowns.box)
            larger = 1.0 + _LARGER * ((first + np.arange(len(crowns))) * _GOLDEN % 1.0)
            local = corner * (crowns.half * larger[:, None])[:, None]
            placed = np.einsum("nij,nvj->nvi", crowns.axes, local) + crowns.middle[:, None]
            number = len(corner) * np.arange(len(crowns))[:, None, None] + sum(map(len, vertices))
            faces.append((triangles + number).reshape(-1, 3))
            owner.append(np.repeat(first + np.arange(len(crowns)), len(triangles)))
            vertices.append(placed.reshape(-1, 3))
            first += len(crowns)
        hull = shapes.mesh(mi, "hulls", np.concatenate(vertices), np.concatenate(faces))
        self._hulls = mi.load_dict({"type": "scene", "embree_use_robust_intersections": True, "hulls": hull})
        self._owner = mi.UInt32(aligned(np.concatenate(owner), np.uint32))
        every = [crowns for _, crowns in own]
        join = lambda of: np.concatenate([of(each) for each in every])  # noqa: E731
        heading = np.radians(join(lambda c: c.yaw_deg))
        boxes = join(lambda c: np.full(len(c), float(c.box)))
        tables = (
            np.column_stack([join(lambda c: c.middle), PROJECTION * join(lambda c: c.density)]),
            np.column_stack([1.0 / join(lambda c: c.half), boxes]),
            np.column_stack([np.cos(heading), np.sin(heading)]),
        )
        self._middle, self._half, self._turn = (mi.Float(aligned(table)) for table in tables)
        numbers = [(k, int(face_start[k]), int(texel_start[k]), len(crowns)) for k, crowns in own]
        per = [np.concatenate([f(k, *rest) for k, *rest in numbers]) for f in (
            lambda k, face, texel, n: np.full(n, k), lambda k, face, texel, n: face + PATCHES * np.arange(n),
            lambda k, face, texel, n: texel + PATCHES * np.arange(n),
        )]  # fmt: skip
        self.surface, self.first_face, self.first_texel = (mi.UInt32(aligned(each, np.uint32)) for each in per)
        self._hair = dr.opaque(mi.Float, hair)
        # (n, 3) middles and (n, 3, 3) half axes, a row each, of ellipsoids round the crowns, in the scene's frame [m].
        self.middle = join(lambda c: c.middle)
        self.reach = join(lambda c: (c.axes * c.half[:, None] * (np.sqrt(3.0) if c.box else 1.0)).transpose(0, 2, 1))
        self.leaf_m = max(crowns.leaf_m for _, crowns in own)
        self.crowns, self.numbers = every, [k for k, _ in own]

    def frame(self, crown: Jit, active: Jit = True) -> UnitBody:
        """Return the UnitBody of crowns."""
        mi = self.mi
        middle, half = (dr.gather(mi.Vector4f, table, crown, active) for table in (self._middle, self._half))
        turn = dr.gather(mi.Vector2f, self._turn, crown, active)
        place, scale = (mi.Vector3f(each.x, each.y, each.z) for each in (middle, half))
        return UnitBody(place, scale, turn, middle.w, half.w > 0.5)

    def chord(self, crown: Jit, ray: Jit, until: Jit, new: Jit) -> Chord:
        """Return the Chord of rays up to `until` [m] in crowns; there is none where not `new`."""
        frame = self.frame(crown, new)
        at, way = frame.point(ray.o), frame.vector(ray.d)
        start, end = frame.chord(at, way)
        start = dr.maximum(start, 0.0)
        length = dr.select(new, dr.maximum(dr.minimum(end, until) - start, 0.0), 0.0)
        return Chord(crown, frame, at, way, start, frame.extinction * length, new & (length > 0.0))

    def walk(
        self, ray: Jit, until: Jit, active: Jit, state: State, visit: Visit, coherent: bool = False
    ) -> State:  # fmt: skip
        """Return `state` after `visit(chord, state)`, which returns (whether to go on, state), of each crown that rays
        meet before `until` [m]. `coherent` rays are those of a view, side by side."""
        mi = self.mi
        origin, direction = mi.Point3f(ray.o), mi.Vector3f(ray.d)
        none = mi.UInt32(0xFFFFFFFF)

        def goes_on(going: Jit, *_: Jit) -> Jit:
            return going

        def step(going: Jit, at: Jit, after: Jit, *rest: Jit) -> tuple[Jit, ...]:
            seen, now = rest[:_REMEMBERED], rest[_REMEMBERED:]
            ray = mi.Ray3f(origin + at * direction, direction)
            found = self._hulls.ray_intersect_preliminary(ray, coherent=coherent, active=going)
            hit = found.is_valid() & going
            crown = dr.gather(mi.UInt32, self._owner, found.prim_index, hit)
            new = mi.Bool(hit)
            for each in seen:
                new &= crown != each
            on, now = visit(self.chord(crown, mi.Ray3f(origin, direction), until, new), now)
            remembered = [dr.select(new, value, old) for value, old in zip((crown, *seen[:-1]), seen, strict=True)]
            at = at + dr.select(hit, found.t + self._hair, 0.0)
            after = after + dr.select(at > until, mi.UInt32(1), 0)
            return (hit & on & (after < _AFTER), at, after, *remembered, *now)

        begin = mi.Bool(active) & (until > 0.0)
        width = dr.width(direction)
        first = (begin, dr.zeros(mi.Float, width), dr.zeros(mi.UInt32, width), *([none] * _REMEMBERED), *state)
        return dr.while_loop(first, goes_on, step)[3 + _REMEMBERED :]

    def flight(self, ray: Jit, until: Jit, depth: Jit, active: Jit = True, coherent: bool = False) -> FreeFlight:
        """Return the FreeFlight of rays to an optical depth, before `until` [m]."""
        mi = self.mi

        def visit(chord: Chord, state: State) -> tuple[Jit, State]:
            left, met, distance, crown = state
            here = chord.new & (chord.depth >= left)
            place = dr.select(here, chord.start + left / chord.frame.extinction, distance)
            left = left - dr.select(here, 0.0, chord.depth)
            return ~here, (left, met | here, place, dr.select(here, chord.crown, crown))

        width = dr.width(ray.d)
        begin = mi.Float(depth), dr.zeros(mi.Bool, width), dr.full(mi.Float, np.inf, width), dr.zeros(mi.UInt32, width)
        if dr.width(begin[0]) != width:
            begin = (dr.zeros(mi.Float, width) + depth, *begin[1:])
        _, met, distance, crown = self.walk(ray, until, active, begin, visit, coherent)
        body = self.frame(crown, met)
        at = body.point(ray.o + dr.select(met, distance, 0.0) * ray.d)
        return FreeFlight(met, distance, crown, body.quarter(at))

    def drawn(self, ray: Jit, until: Jit, active: Jit = True) -> tuple[FreeFlight, Jit]:
        """Return (random FreeFlight of rays, unit normal of the side of the leaf that they meet); both follow from the
        ray alone."""
        mi = self.mi
        bits = [dr.reinterpret_array(mi.UInt32, each) for each in (*ray.o, *ray.d)]
        key = bits[0] * 0x9E3779B1 ^ bits[1] * 0x85EBCA77 ^ bits[2] * 0xC2B2AE3D
        other = bits[3] * 0x27D4EB2F ^ bits[4] * 0x165667B1 ^ bits[5] * 0xD3A2646C
        one, two = mi.sample_tea_32(key, other, 6)
        three, _ = mi.sample_tea_32(key ^ 0x68E31DA4, other, 6)
        u = [mi.Float(each >> 8) * 2.0**-24 for each in (one, two, three)]
        flight = self.flight(ray, until, -dr.log(1.0 - u[0]), active)
        # Leaves of all orientations are met by the cosine of the ray's angle.
        normal = mi.Frame3f(-ray.d).to_world(mi.warp.square_to_cosine_hemisphere(mi.Point2f(u[1], u[2])))
        return flight, normal

    def face(self, flight: FreeFlight, up: Jit) -> tuple[Jit, Jit]:
        """Return (surface, face) of the patches that a FreeFlight meets; `up`: the side of the leaf faces up."""
        mi = self.mi
        surface, first = (
            dr.gather(mi.UInt32, table, flight.crown, flight.met) for table in (self.surface, self.first_face)
        )
        return surface, first + 2 * flight.quarter + dr.select(up, mi.UInt32(1), 0)


def field_of(
    mi: Mitsuba, surfaces: Sequence[Surface], face_start: NDArray[np.integer], texel_start: NDArray[np.integer],
    hair: float,
) -> CrownField | None:  # fmt: skip
    """Return the CrownField of surfaces; None where none of them has crowns."""
    if not any(isinstance(surface.instances, Crowns) for surface in surfaces):
        return None
    return CrownField(mi, surfaces, face_start, texel_start, hair)


def _hull(box: bool) -> tuple[Floats, NDArray[np.int64]]:
    """(vertices, faces) of a convex body around the unit cube or ball."""
    import trimesh

    if box:
        made = trimesh.creation.box(extents=(2.0, 2.0, 2.0))
        return np.array(made.vertices, np.float64), np.array(made.faces, np.int64)
    made = trimesh.creation.icosphere(subdivisions=1, radius=1.0)
    nearest = float(np.einsum("fi,fi->f", made.triangles[:, 0], made.face_normals).min())
    return np.array(made.vertices, np.float64) / nearest, np.array(made.faces, np.int64)
