"""The mirror image on materials whose emissivity depends on the angle of view.

The light between surfaces, and so the baked texels and faces, treats such a material as diffuse, with its hemispherical
emissivity. To the camera it is a mirror: where a ray hits it, a second ray continues about the face's normal, and the
texel shows

    black − reflected(θ, black) + reflected(θ, seen),

all in channels: `black` is a blackbody at the texel's temperature, `seen` the light along the second ray. In an
isothermal enclosure the two are equal, and every wall looks black. A ray that hits nothing reflects sky or
surroundings, tabulated by both angles with their spectra. The baked radiance of the texel is subtracted again, so other
materials need no change.

A mirror seen in a mirror is treated as a mirror too. A mirror seen in that one shows its baked, diffuse radiance; the
error budget follows one more reflection to estimate the part left out. The mirror's normal is that of its flat face:
roughness raises the emissivity at grazing angles but does not blur the image. Reflected light passes the air up to the
mirror, from the mean altitude of the scene's mirrors. Glint of the sun is left out.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from thermorender.atmosphere.model import Atmosphere
from thermorender.physics.fresnel import COSINES
from thermorender.render.air import PathGrid
from thermorender.render.arrays import Channels, Floats, Jit, Mitsuba, aligned
from thermorender.render.geometry import Hit, box_of, farthest
from thermorender.render.layers import Layer, LayerHit, first_hit
from thermorender.render.reflection.reflectance import ReflectanceTables, bent
from thermorender.render.spectrum import Spectrum
from thermorender.scene.scene import Scene

if TYPE_CHECKING:
    from thermorender.render.plan import Plan

# Largest number of mirrors that reflect light on its way to the camera.
DEPTH = 2
# Distance assumed for the sky in a mirror in a mirror [m].
_SKY_IN_MIRROR_M = 1e6


class Mirror:
    """Data of the directional texels of one layer.

    `material` holds the number of each texel's material, (T,); `black` (n, K) comes from `black_of`.
    """

    def __init__(self, mi: Mitsuba, tables: "DeviceTables", material: NDArray[np.integer], black: Floats) -> None:
        self.tables = tables
        number = tables.number[material]
        texels = np.flatnonzero(number)
        row = np.zeros(len(number), dtype=np.uint32)
        row[texels] = 1 + np.arange(len(texels))
        self.row = mi.UInt32(aligned(row, np.uint32))
        self.kind = mi.UInt32(aligned(number[texels] - 1, np.uint32))
        self.black = Channels(mi, black)


class DeviceTables:
    """ReflectanceTables on the device."""

    def __init__(self, mi: Mitsuba, tables: ReflectanceTables, scene: Scene, spectrum: Spectrum) -> None:
        self.number, self._mi = tables.number, mi
        self._path = None if scene.air is None else _paths(mi, scene.air, tables.at_m, scene, spectrum)
        self._at_m = None if scene.air is None else dr.opaque(mi.Float, tables.at_m)
        self.count = tables.matrix.shape[-2]
        self._weight = [dr.opaque(mi.Float, float(value)) for value in tables.weight]
        self._directions = tables.environment.shape[2] - 1
        self._matrix = Channels(mi, tables.matrix.reshape(-1, self.count * (self.count + 1)))
        self._environment = Channels(mi, tables.environment.reshape(-1, self.count))

    def reflected(self, kind: Jit, cosine: Jit, black: list[Jit], seen: list[Jit], valid: Jit, up: Jit) -> list[Jit]:
        """Return the light that materials reflect into each channel, minus that of a blackbody, [Float].

        `kind` is the row in the tables, `cosine` that of the angle of view, `black` and `seen` the channels of the
        blackbody and of the incident light. Where `valid` is False the light comes from the environment, at a cosine of
        zenith angle `up`.
        """
        mi, count, lines = self._mi, self.count, self._directions
        own, other = ([*light, bent(self.band(light))] for light in (black, seen))
        light = [dr.select(valid, a, 0.0) - b for a, b in zip(other, own, strict=True)]
        row, across = self._interval(cosine, len(COSINES))
        row = row + kind * len(COSINES)
        near, far = (self._matrix.at(row + k) for k in (0, 1))
        matrix = [dr.lerp(a, b, across) for a, b in zip(near, far, strict=True)]
        column, along = self._interval(up, lines) if lines > 1 else (mi.UInt32(0), mi.Float(0.0))
        # The last column holds the surroundings.
        below, step = up < 0.0, min(lines - 1, 1)
        column, along = dr.select(below, lines, column), dr.select(below, 0.0, along)
        step = dr.select(below, 0, mi.UInt32(step))
        added = [mi.Float(0.0) for _ in range(count)]
        for k, part in ((0, 1.0 - across), (1, across)):
            for index, share in ((column, 1.0 - along), (column + step, along)):
                values = self._environment.at((row + k) * (lines + 1) + index, ~valid)
                added = [a + part * share * value for a, value in zip(added, values, strict=True)]
        return [
            added[k] + sum(m * value for m, value in zip(matrix[k * len(light) :], light, strict=False))
            for k in range(count)
        ]

    def through_air(self, light: list[Jit], distance: Jit, up: Jit, valid: Jit) -> list[Jit]:
        """Return light, [Float] by channel, behind the path from its source to the mirror: length [m], cosine of
        zenith.
        """
        if self._path is None:
            return light
        total = [self._mi.Float(0.0) for _ in light]
        for weight, found in self._path.corners(distance, self._at_m + up * distance, valid):
            for k in range(self.count):
                *row, added = found[k * (self.count + 1) : (k + 1) * (self.count + 1)]
                passed = sum(number * value for number, value in zip(row, light, strict=True))
                total[k] += weight * (passed + added)
        return total

    def band(self, light: list[Jit]) -> Jit:
        """Return the band radiance of light given by channels, Float [W m⁻² sr⁻¹]."""
        return sum(weight * value for weight, value in zip(self._weight, light, strict=True))

    def _interval(self, cosine: Jit, count: int) -> tuple[Jit, Jit]:
        """(lower index, share of the next) in a table at `count` squares of an even grid."""
        position = dr.sqrt(dr.clip(cosine, 0.0, 1.0)) * (count - 1)
        lower = dr.minimum(self._mi.UInt32(position), count - 2)
        grid = self._mi.Float(lower)
        # Linear in the cosine itself between its squares.
        return lower, (position * position - grid * grid) / (2.0 * grid + 1.0)


def black_of(
    plan: "Plan", number: NDArray[np.uint8], material: NDArray[np.integer], temperature: NDArray[np.floating]
) -> Floats:
    """Return channels (n, K) of blackbodies at the temperatures of the directional texels, in order [W m⁻² sr⁻¹].

    `number` is that of `ReflectanceTables`, (M,).
    """
    warm = temperature[number[material] > 0]
    grid, table = plan.spectrum.emitted(np.ones_like, float(warm.min()), float(warm.max()), plan.band_um)
    return np.stack([np.interp(warm, grid, channel) for channel in table.T], axis=1)


def met(layer: Layer, hit: Hit, position: tuple[Jit, Jit]) -> tuple[Jit, Jit]:
    """Return (flat number of the texel at a Hit, its row among the layer's mirrors from 1 on; 0 where it is none)."""
    mi, mirror = layer.geometry.mi, layer.outgoing.mirror
    if not mirror:
        return mi.UInt32(0), mi.UInt32(0)
    texel = layer.geometry.nearest(hit.surface, *position, hit.valid)
    return texel, dr.gather(mi.UInt32, mirror.row, texel, hit.valid)


def correction(
    layers: Sequence[Layer], depth: int, origin: Jit, direction: Jit, distance: Jit, number: Jit, face: Jit, texel: Jit,
    row: Jit,
) -> tuple[list[Jit], Jit]:  # fmt: skip
    """Return (channels to add, [Float], distance [m] from a mirror to the point seen in it) for rays of a view.

    Parameters
    ----------
    layers : sequence of Layer
        The static scene first, in whose frame the rays are.
    depth : int
        Largest number of reflections by mirrors; the next mirror is taken as diffuse.
    distance, number, face, texel, row
        Of the hit: distance [m], layer, face, and the result of `met`.
    """
    mirror = next(layer.outgoing.mirror for layer in layers if layer.outgoing.mirror)
    nothing = tuple(type(distance)(0.0) for _ in range(mirror.black.count + 1))
    # A branch: packets whose rays hit no mirror skip this.
    *added, way = dr.if_stmt(
        (origin, direction, distance, number, face, texel, row),
        row > 0,
        lambda *values: _reflected(layers, depth, *values),
        lambda *_: nothing,
    )
    return added, way


def _reflected(
    layers: Sequence[Layer], depth: int, eye: Jit, view: Jit, distance: Jit, number: Jit, face: Jit, texel: Jit,
    row: Jit,
) -> tuple[Jit, ...]:  # fmt: skip
    """As `correction`, in one tuple, for rays in the first layer's frame that hit mirror `row` (from 1 on) of layer
    `number`.
    """
    first = layers[0]
    mi, total = first.geometry.mi, list[Jit]()
    # Masked gathers return 0 for all layers but the one hit, so the sum selects its values.
    for place, layer in enumerate(layers):
        mirror, geometry = layer.outgoing.mirror, layer.geometry
        if not mirror:
            continue
        own, tables, count = number == place, mirror.tables, mirror.black.count
        normal = mi.Vector3f(*geometry.normals.at(face, own))
        found = [
            *transformed(layer.view, first.view, None, normal)[1],
            dr.select(own, dr.opaque(mi.Float, geometry.reach), 0.0),
            dr.gather(mi.UInt32, mirror.kind, row - 1, own),
            *mirror.black.at(row - 1, own),
            *layer.outgoing.at_texel(texel, face, own),
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
    seen, length, way = _seen(layers, depth - 1, mi.Point3f(eye + distance * view + lift * normal), direction)
    valid = length < np.inf
    seen = tables.through_air(seen, length, direction.z, valid)
    reflected = tables.reflected(kind, cosine, black, seen, valid, direction.z)
    return (*(a + b - c for a, b, c in zip(black, reflected, diffuse, strict=True)), way)


def _seen(layers: Sequence[Layer], depth: int, origin: Jit, direction: Jit) -> tuple[list[Jit], Jit, Jit]:
    """(channels, distance, whole path length) of rays in the first layer's frame, with up to `depth` reflections."""
    first = layers[0]
    mi = first.geometry.mi

    def read(at: LayerHit) -> list[Jit]:
        return [*met(at.layer, at.hit, at.place), *at.layer.outgoing.at(at.layer.geometry, at.hit, at.place)]

    hit, number, (texel, row, *seen) = first_hit(
        layers, lambda layer: mi.Ray3f(*transformed(first.view, layer.view, origin, direction)), read,
        lambda geometry, ray: geometry.cast(ray, coherent=True),
    )  # fmt: skip
    away: Jit = dr.select(hit.valid, hit.distance, np.inf)
    further: Jit = 0.0
    if depth:
        added, further = correction(layers, depth, origin, direction, away, number, hit.face, texel, row)
        seen = [a + b for a, b in zip(seen, added, strict=True)]
    # The sky in a mirror has a depth other than the sky beside it, so their edge is found.
    return seen, away, away + dr.minimum(further, _SKY_IN_MIRROR_M)


def last_steps(layers: Sequence[Layer], *ray: Jit) -> list[Jit]:
    """Return the band radiance that one more reflection would add to a frame, and a second one, [Float] [W m⁻² sr⁻¹].

    Parameters as of `correction`, without the depth.
    """
    tables = next(layer.outgoing.mirror.tables for layer in layers if layer.outgoing.mirror)
    first, *others = (correction(layers, depth, *ray)[0] for depth in (DEPTH, DEPTH + 1, DEPTH + 2))
    found = []
    for other in others:
        found.append(tables.band([b - a for a, b in zip(first, other, strict=True)]))
        first = other
    return found


def _paths(mi: Mitsuba, air: Atmosphere, at_m: float, scene: Scene, spectrum: Spectrum) -> PathGrid:
    """PathGrid from mirrors: the share of each channel in each channel, and the light that the air adds to it."""
    box = box_of(scene)
    low, high = (min(at_m, scene.altitude_m + box[0, 2]), max(at_m, scene.altitude_m + box[1, 2]))

    def cells(passed: Floats, added: Floats) -> Floats:
        # Each channel of light behind a path is a sum over channels, as the band radiance is.
        shares = np.einsum("kn,...n,nj->...kj", spectrum.basis, passed, spectrum.solver)
        return np.concatenate([shares, (added @ spectrum.basis.T)[..., None]], -1).reshape(*passed.shape[:-1], -1)

    return PathGrid(mi, air, at_m, (low, high), (1.0, farthest(scene)), cells)


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
