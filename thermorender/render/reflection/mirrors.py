"""The mirror image on materials whose emissivity depends on the angle of view.

The light between surfaces, and so the baked texels and faces, treats such a material as diffuse, with its hemispherical
emissivity. To the camera it is a mirror: a second ray is reflected about the face's normal, and the texel shows

    black − reflected(θ, black) + reflected(θ, seen),

all in channels: `black` is a blackbody at the texel's temperature, `seen` the light along the second ray. In an
isothermal enclosure the two are equal, and every wall looks black. A ray that hits nothing reflects sky or
surroundings, tabulated by both angles with their spectra. The baked radiance of the texel is subtracted again, so other
materials need no change.

A mirror seen in a mirror is a mirror too. The next one shows its baked, diffuse radiance; the error budget follows one
more reflection to estimate the part left out. The normal is that of the flat face: roughness raises the emissivity at
grazing angles but does not blur the image. Reflected light passes the air up to the mirror, from the mean altitude of
the scene's mirrors. The sun is seen in the first mirror; facets of a rough one spread its image, and nothing else's.
"""

from collections.abc import Sequence
from functools import partial

import drjit as dr
import numpy as np

from thermorender.render.arrays import Jit
from thermorender.render.geometry import Hit
from thermorender.render.layers import Layer, LayerHit, first_hit
from thermorender.render.pixels.crown_light import along

# Largest number of mirrors that reflect light on its way to the camera.
DEPTH = 2
# Distance assumed for the sky in a mirror in a mirror [m].
_SKY_IN_MIRROR_M = 1e6


def met(layer: Layer, hit: Hit, position: tuple[Jit, Jit]) -> tuple[Jit, Jit]:
    """Return (flat number of the texel at a Hit, its row among the layer's mirrors from 1 on; 0 where it is none)."""
    mi, directional = layer.geometry.mi, layer.outgoing.directional
    if not directional:
        return mi.UInt32(0), mi.UInt32(0)
    texel = layer.geometry.nearest(hit.surface, *position, hit.valid)
    return texel, dr.gather(mi.UInt32, directional.row, texel, hit.valid)


def correction(
    layers: Sequence[Layer], depth: int, origin: Jit, direction: Jit, distance: Jit, number: Jit, face: Jit, texel: Jit,
    row: Jit, glint: bool = True,
) -> tuple[list[Jit], Jit]:  # fmt: skip
    """Return (channels to add, [Float], distance [m] from a mirror to the point seen in it) for rays in the first
    layer's frame. They hit a face of layer `number` at `distance` [m]; texel and row are from `met`. Mirrors after
    `depth` reflections are diffuse. Without `glint` the sun is not seen in them."""
    directional = next(layer.outgoing.directional for layer in layers if layer.outgoing.directional)
    nothing = tuple(type(distance)(0.0) for _ in range(directional.black.count + 1))
    # A branch: packets whose rays hit no mirror skip this.
    *added, way = dr.if_stmt(
        (origin, direction, distance, number, face, texel, row),
        row > 0,
        lambda *values: _reflected(layers, depth, glint, *values),
        lambda *_: nothing,
    )
    return added, way


def _reflected(
    layers: Sequence[Layer], depth: int, glint: bool, eye: Jit, view: Jit, distance: Jit, number: Jit, face: Jit,
    texel: Jit, row: Jit,
) -> tuple[Jit, ...]:  # fmt: skip
    """As `correction`, in one tuple, for rays in the first layer's frame that hit mirror `row` ≥ 1 of layer
    `number`."""
    first = layers[0]
    mi, total = first.geometry.mi, list[Jit]()
    # Masked gathers return 0 for all layers but the one hit, so the sum selects its values.
    for place, layer in enumerate(layers):
        directional, geometry = layer.outgoing.directional, layer.geometry
        if not directional:
            continue
        own, tables, count = number == place, directional.tables, directional.black.count
        normal = mi.Vector3f(*geometry.normals.at(face, own))
        found = [
            *transformed(layer.view, first.view, None, normal)[1],
            dr.select(own, dr.opaque(mi.Float, geometry.reach), 0.0),
            dr.gather(mi.UInt32, directional.kind, row - 1, own),
            *directional.black.at(row - 1, own),
            *layer.outgoing.at_texel(geometry, texel, face, own),
        ]
        total = [a + b for a, b in zip(total, found, strict=True)] if total else found
    normal, reach, kind = mi.Vector3f(*total[:3]), *total[3:5]
    black, diffuse = total[5 : 5 + count], total[5 + count :]
    slant = dr.dot(normal, view)
    normal = dr.select(slant > 0.0, -normal, normal)
    cosine = dr.minimum(dr.abs(slant), 1.0)
    direction = view + 2.0 * cosine * normal
    # Lifted off the surface as the rays of the bake, and more where the ray is long.
    lift = 64.0 * 2.0**-24 * (1.0 + dr.maximum(reach, distance))
    origin = mi.Point3f(eye + distance * view + lift * normal)
    seen, length, way = _seen(layers, depth - 1, origin, direction)

    def by(seen: list[Jit], length: Jit) -> list[Jit]:
        valid = length < np.inf
        seen = tables.through_air(seen, length, direction.z, valid)
        return tables.reflected(kind, cosine, black, seen, valid, direction.z)

    reflected = by(seen, length)
    if glint and tables.glint is not None:
        sun = tables.glint.seen(kind, normal, view)
        # Channels may be negative.
        free = sum(map(dr.abs, sun)) > 0.0
        for layer in layers:
            ray = mi.Ray3f(*transformed(first.view, layer.view, origin, tables.glint.direction))
            free &= ~layer.geometry.caster.ray_test(ray, coherent=True, active=free)
        lit = dr.select(free, 1.0, 0.0)
        if first.geometry.crowns is not None:
            lit = dr.select(free, first.geometry.crowns_passed(origin, tables.glint.towards, free), 0.0)
        reflected = [value + lit * more for value, more in zip(reflected, sun, strict=True)]
    if first.geometry.crowns is not None:
        walk = partial(first.geometry.crowns.walk, coherent=True)
        leaves = along(first.geometry, first.outgoing, mi.Ray3f(origin, direction), length, walk)
        some = leaves.passed < 1.0
        shown = by(leaves.channels, dr.select(some, leaves.distance, np.inf))
        reflected = [dr.select(some, dr.lerp(b, a, leaves.passed), a) for a, b in zip(reflected, shown, strict=True)]
    return (*(a + b - c for a, b, c in zip(black, reflected, diffuse, strict=True)), way)


def _seen(layers: Sequence[Layer], depth: int, origin: Jit, direction: Jit) -> tuple[list[Jit], Jit, Jit]:
    """(channels, distance, whole path length) of rays in the first layer's frame, with up to `depth` reflections."""
    first = layers[0]
    mi = first.geometry.mi

    def read(at: LayerHit) -> list[Jit]:
        return [*met(at.layer, at.hit, at.place), *at.layer.outgoing.at(at.layer.geometry, at.hit, at.place)]

    hit, number, (texel, row, *seen) = first_hit(
        layers, lambda layer: mi.Ray3f(*transformed(first.view, layer.view, origin, direction)), read,
        lambda geometry, ray: geometry.cast_solid(ray, coherent=True),
    )  # fmt: skip
    away: Jit = dr.select(hit.valid, hit.distance, np.inf)
    further: Jit = 0.0
    if depth:
        added, further = correction(layers, depth, origin, direction, away, number, hit.face, texel, row, glint=False)
        seen = [a + b for a, b in zip(seen, added, strict=True)]
    # The sky in a mirror has a depth other than the sky beside it, so their edge is found.
    return seen, away, away + dr.minimum(further, _SKY_IN_MIRROR_M)


def last_steps(layers: Sequence[Layer], *ray: Jit) -> list[Jit]:
    """Return the band radiance of one more reflection, and of a second one, [Float] [W m⁻² sr⁻¹]; `ray` as of
    `correction`."""
    tables = next(layer.outgoing.directional.tables for layer in layers if layer.outgoing.directional)
    first, *others = (correction(layers, depth, *ray)[0] for depth in (DEPTH, DEPTH + 1, DEPTH + 2))
    found = []
    for other in others:
        found.append(tables.band([b - a for a, b in zip(first, other, strict=True)]))
        first = other
    return found


def transformed(
    one: tuple[list[Jit], Jit], other: tuple[list[Jit], Jit], point: Jit, direction: Jit
) -> tuple[Jit, Jit]:
    """(point, direction) of one view's frame in the frame of another view from the same camera."""
    if one is other:
        return point, direction
    (rows, origin), (into, start) = one, other

    def turned(vector: Jit) -> Jit:
        local = sum(row * value for row, value in zip(rows, vector, strict=True))
        return type(direction)(*(dr.dot(row, local) for row in into))

    return None if point is None else start + turned(point - origin), turned(direction)
