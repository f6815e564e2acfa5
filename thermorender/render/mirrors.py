"""Materials that depend on the angle of view: what they emit towards the camera, and the mirror image on them.

To the light between surfaces such a material is diffuse, with its hemispherical emissivity, and so it is in the baked
texels and faces. To the camera it is a mirror: where a ray meets one, a second ray goes on about the normal of the
face, and the texel shows

    black − reflected(θ, black) + reflected(θ, seen),

all in channels: `black` is a blackbody of its temperature, `seen` what the second ray meets. In an isothermal
enclosure the two are one, and every wall looks black. A ray that meets nothing reflects sky or surroundings, tabulated
by both angles with their spectra. What the bake has put there is taken off again, so other materials know nothing of
all this.

A mirror in a mirror is one, too; a mirror in that shows what the bake makes of it, emission and reflection of a
diffuse surface, and the error budget follows it once more to tell what that leaves out. The mirror's normal is that of
its flat face, whatever its roughness: roughness raises the emissivity at grazing angles but does not blur the image.
Light from what a mirror shows passes the air up to it, from the mean altitude of the scene's mirrors; the glint of the
sun is left out.
"""

from dataclasses import dataclass

import drjit as dr
import numpy as np

from thermorender.physics.fresnel import COSINES
from thermorender.physics.planck import band_radiance_derivative, kelvin_per_radiance
from thermorender.render.air import PathGrid, altitude
from thermorender.render.geometry import Channels, aligned, box_of, farthest
from thermorender.render.spectrum import REFERENCE_K

# Directions of the sky, even in the root of the cosine of zenith angle: 5 mK of the sky.
_DIRECTIONS = np.linspace(0.0, 1.0, 65) ** 2
# Steepest view for which effect and error are stated, and angles at which they are evaluated.
_GRAZING = np.cos(np.radians(80.0))
_JUDGED = np.flatnonzero(COSINES >= _GRAZING)[::8]
# Blackbodies between the coldest and the warmest texel, and how much more than other light they count in the fit of
# what is reflected: they are what a mirror emits, and nearly what most of the ground does.
_BLACK, _TRUST = 5, 10.0
# Paths behind which that light is reflected too, as parts of the scene's size.
_SEEN_BEHIND = np.array([0.01, 0.1, 0.5])
# How often light is reflected by mirrors on its way to the camera.
DEPTH = 2
# Where what is endlessly far in a mirror in a mirror is taken to be [m].
_SKY_IN_MIRROR_M = 1e6
# Of the light's variation, the share below which that fit takes no notice: float32 does not tell it.
_SMALLEST = 1e-4


@dataclass(frozen=True)
class ReflectanceTables:
    """How directional materials reflect, by the cosine of the angle of view at `COSINES`.

    Attributes
    ----------
    number : (M,) uint8
        1 + row in these tables of each material of the scene; 0 for Lambertian ones.
    matrix : (D, 257, K, K + 1) float64
        Difference in each channel between what is reflected of two lights, per difference of their channels and of
        b ln b, their band radiance by its logarithm to the base e.
    environment : (D, 257, S, K) float64
        What is reflected of the sky at S − 1 zenith angles, and of the surroundings last, less what `matrix` takes for
        the reflection of no light [W m⁻² sr⁻¹].
    weight : (K,) float64
        Of the channels in the band radiance.
    effect_mk : float
        Largest change of what these materials show if they were diffuse, over the envelope's light up to 80°; estimated
        from above, as mirror and diffuse surface may see any two of its lights [mK at 300 K].
    error_mk : float
        Largest error of `matrix`, over the envelope's light up to 80° [mK].
    at_m : float
        Mean altitude of the mirrors above sea level [m].
    """

    number: np.ndarray
    matrix: np.ndarray
    environment: np.ndarray
    weight: np.ndarray
    effect_mk: float
    error_mk: float
    at_m: float


def directional(materials):
    """Return the numbers of the materials whose emissivity depends on the angle."""
    return [number for number, material in enumerate(materials) if material.emissivity_by_angle is not None]


def make_tables(scene, spectrum, envelope):
    """Return the ReflectanceTables of a scene, or None where nothing is of a directional material.

    Notes
    -----
    What a channel reflects depends on spectra that channels tell only in part. `matrix` is the least-squares fit, over
    the scene's envelope of light, bare and behind its air, in relative terms, of what is reflected: a constant, a share
    of each channel, and a share of b ln b, which bends as the reflection of blackbodies of very different temperatures
    does. The constant falls out of differences and is kept in `environment`.
    """
    points = spectrum.points
    seen = {number: texels for number in directional(scene.materials) if (texels := _texels(scene, number, envelope))}
    if not seen:
        return None
    sources = envelope.sources(points)
    spectra = np.array([material.emissivity_at(points.wavelength_um) for material in scene.materials])
    # Beginning with the environment itself.
    light = envelope.light(spectra, *sources)
    cases = [
        _Case(scene, spectrum, scene.materials[number], spectra[number], envelope, sources[0], light, *texels)
        for number, texels in seen.items()
    ]
    row = np.zeros(len(scene.materials), dtype=np.uint8)
    row[list(seen)] = 1 + np.arange(len(seen))
    stacked = [np.stack([getattr(case, name) for case in cases]) for name in ("matrix", "environment")]
    weight = spectrum.solver.sum(axis=0)
    worst = [max(getattr(case, name) for case in cases) for name in ("effect_mk", "error_mk")]
    return ReflectanceTables(row, *stacked, weight, *worst, float(np.mean([at_m for at_m, *_ in seen.values()])))


class _Case:
    """One material's part of `ReflectanceTables`."""

    def __init__(self, scene, spectrum, material, diffuse, envelope, environment, light, at_m, coldest, warmest):
        points = spectrum.points
        channel = spectrum.basis[:, points.node]
        reflectance = 1.0 - material.emissivity_at_angle(points.wavelength_um, COSINES[:, None])

        def reflected(spectra):
            return np.stack([reflectance @ (spectra * row).T for row in channel], axis=-1)

        limits = min(coldest, *envelope.ground), max(warmest, *envelope.ground)
        black = points.planck(np.linspace(*limits, _BLACK))
        every = np.concatenate([black, light[len(environment) :]])
        if scene.air is not None:
            # What surfaces send, behind the air of paths to the mirror: no longer of a blackbody's colours.
            paths = scene.air.path(at_m, at_m, farthest(scene) * _SEEN_BEHIND)
            behind = [every * passed[points.node] + points.spread(added) for passed, added in zip(*paths, strict=True)]
            every = np.concatenate([every, *behind])
        every = every[every.sum(axis=1) > 0.0]
        size, channels = every.sum(axis=1), every @ channel.T
        known = np.column_stack([channels, _bent(channels @ spectrum.solver.sum(axis=0)), np.full(len(size), size[0])])
        wanted = reflected(every)
        trust = np.where(np.arange(len(size)) < _BLACK, _TRUST, 1.0) / size
        fit = np.linalg.pinv(known * trust[:, None], rcond=_SMALLEST) @ (wanted * trust[:, None])
        self.matrix = fit[:, :-1].transpose(0, 2, 1)
        if scene.air is None:
            sky = environment[:1]
        else:
            sky = points.spread(scene.air.sky_radiance(at_m, _DIRECTIONS))
        self.environment = reflected(np.concatenate([sky, environment[-1:]])) - fit[:, None, -1] * size[0]
        band_um, judged = scene.camera.band_um, reflectance[_JUDGED]
        # The mirror and the diffuse surface may see any two surfaces of the scene.
        emitted = (1.0 - diffuse - judged) @ black.T
        image, glow = judged @ light.T, (1.0 - diffuse) @ light.T
        most = emitted.max(axis=1) + image.max(axis=1) - glow.min()
        least = emitted.min(axis=1) + image.min(axis=1) - glow.max()
        self.effect_mk = float(np.abs([most, least]).max() / band_radiance_derivative(REFERENCE_K, *band_um)) * 1e3
        shown = (black[0].sum() - judged @ black[0])[:, None] + judged @ every.T
        mk_per_radiance = 1e3 * kelvin_per_radiance(shown, *band_um)
        left = (wanted - known @ fit)[_JUDGED] @ spectrum.solver.sum(axis=0) * mk_per_radiance
        self.error_mk = float((np.abs(left) + np.abs(left[:, :_BLACK]).max(axis=1, keepdims=True)).max())


class Mirror:
    """What the directional texels of one layer need.

    Parameters
    ----------
    mi : module
    tables : DeviceTables
        Of the scene.
    material : (T,) uint8
        Number of each texel's material.
    black : (n, K) array
        From `black_of`.
    """

    def __init__(self, mi, tables, material, black):
        self.tables = tables
        number = tables.number[material]
        texels = np.flatnonzero(number)
        row = np.zeros(len(number), dtype=np.uint32)
        row[texels] = 1 + np.arange(len(texels))
        self.row = mi.UInt32(aligned(row, np.uint32))
        self.kind = mi.UInt32(aligned(number[texels] - 1, np.uint32))
        self.black = Channels(mi, black)


class DeviceTables:
    """Tables on the render side.

    Parameters
    ----------
    mi : module
    tables : ReflectanceTables
    scene : Scene
    spectrum : Spectrum
    """

    def __init__(self, mi, tables, scene, spectrum):
        self.number, self._mi, self._path = tables.number, mi, None
        if scene.air is not None:
            self._path, self._at_m = _paths(mi, tables.at_m, scene, spectrum), dr.opaque(mi.Float, tables.at_m)
        self.count = tables.matrix.shape[-2]
        self._weight = [dr.opaque(mi.Float, float(value)) for value in tables.weight]
        self._directions = tables.environment.shape[2] - 1
        self._matrix = Channels(mi, tables.matrix.reshape(-1, self.count * (self.count + 1)))
        self._environment = Channels(mi, tables.environment.reshape(-1, self.count))

    def reflected(self, kind, cosine, black, seen, valid, up):
        """Return what materials reflect into each channel, less what they reflect of a blackbody, [Float].

        Parameters
        ----------
        kind : UInt32
            Rows of the tables.
        cosine : Float
            Of the angle of view.
        black, seen : list of Float
            Channels of the blackbody and of the light.
        valid : Bool
            Whether the light is that of something; else it is that of the environment.
        up : Float
            Cosine of the zenith angle that the environment is seen at.
        """
        mi, count, lines = self._mi, self.count, self._directions
        own, other = ([*light, _bent(self.band(light))] for light in (black, seen))
        light = [dr.select(valid, a, 0.0) - b for a, b in zip(other, own, strict=True)]
        row, across = self._interval(cosine, len(COSINES))
        row = row + kind * len(COSINES)
        near, far = (self._matrix.at(row + k) for k in (0, 1))
        matrix = [dr.lerp(a, b, across) for a, b in zip(near, far, strict=True)]
        column, along = self._interval(up, lines) if lines > 1 else (mi.UInt32(0), mi.Float(0.0))
        # The last column is the surroundings'.
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

    def through_air(self, light, distance, up, valid):
        """Return light, [Float] by channel, at a mirror as far below what sends it: length [m], cosine of zenith."""
        if self._path is None:
            return light
        total = [self._mi.Float(0.0) for _ in light]
        for weight, found in self._path.corners(distance, self._at_m + up * distance, valid):
            for k in range(self.count):
                *row, added = found[k * (self.count + 1) : (k + 1) * (self.count + 1)]
                passed = sum(number * value for number, value in zip(row, light, strict=True))
                total[k] += weight * (passed + added)
        return total

    def band(self, light):
        """Return the band radiance of light given by its channels, Float [W m⁻² sr⁻¹]."""
        return sum(weight * value for weight, value in zip(self._weight, light, strict=True))

    def _interval(self, cosine, count):
        """(lower index, share of the next) in a table of `count` squares of an even grid."""
        position = dr.sqrt(dr.clip(cosine, 0.0, 1.0)) * (count - 1)
        lower = dr.minimum(self._mi.UInt32(position), count - 2)
        grid = self._mi.Float(lower)
        # Linear in the cosine itself between its squares.
        return lower, (position * position - grid * grid) / (2.0 * grid + 1.0)


def black_of(plan, number, material, temperature):
    """Return the channels (n, K) of blackbodies of the directional texels' temperatures, in order [W m⁻² sr⁻¹].

    `number` is that of `ReflectanceTables`, (M,).
    """
    warm = temperature[number[material] > 0]
    grid, table = plan.spectrum.emitted(np.ones_like, float(warm.min()), float(warm.max()), plan.band_um)
    return np.stack([np.interp(warm, grid, channel) for channel in table.T], axis=1)


def met(layer, hit, position):
    """Return (flat number of the texel at a Hit, its row among the layer's mirrors from 1 on; 0 for no mirror)."""
    mi, mirror = layer.geometry.mi, layer.outgoing.mirror
    if not mirror:
        return mi.UInt32(0), mi.UInt32(0)
    texel = layer.geometry.nearest(hit.surface, *position, hit.valid)
    return texel, dr.gather(mi.UInt32, mirror.row, texel, hit.valid)


def correction(layers, depth, origin, direction, distance, number, face, texel, row):
    """Return (channels to be added, [Float], way [m] from a mirror to what it shows) for rays of a view.

    Parameters
    ----------
    layers : sequence of Layer
        The static scene first, in whose frame the rays are.
    depth : int
        How often light is reflected by mirrors; those that it meets then are diffuse.
    origin, direction : Point3f, Vector3f
    distance : Float
        To what the rays meet [m].
    number : UInt32
        Of the layer that this is in.
    face, texel, row : UInt32
        Of a Hit in it, and as by `met`.
    """
    mirror = next(layer.outgoing.mirror for layer in layers if layer.outgoing.mirror)
    nothing = tuple(type(distance)(0.0) for _ in range(mirror.black.count + 1))
    # A branch: where no ray of a packet meets a mirror nothing of this is computed.
    *added, way = dr.if_stmt(
        (origin, direction, distance, number, face, texel, row),
        row > 0,
        lambda *values: _reflected(layers, depth, *values),
        lambda *_: nothing,
    )
    return added, way


def _reflected(layers, depth, eye, view, distance, number, face, texel, row):
    """As `correction`, in one tuple, for rays of the first layer's frame that meet mirrors.

    These are texels `row`, counted from 1, of the layers of that `number`.
    """
    first = layers[0]
    mi, total = first.geometry.mi, None
    # One layer has what is asked for; masked, the others have zeros.
    for place, layer in enumerate(layers):
        mirror, geometry = layer.outgoing.mirror, layer.geometry
        if not mirror:
            continue
        own, tables, count = number == place, mirror.tables, mirror.black.count
        normal = mi.Vector3f(*geometry.normals.at(face, own))
        found = [
            *_transformed(layer.view, first.view, None, normal)[1],
            dr.select(own, dr.opaque(mi.Float, geometry.reach), 0.0),
            dr.gather(mi.UInt32, mirror.kind, row - 1, own),
            *mirror.black.at(row - 1, own),
            *layer.outgoing.at_texel(texel, face, own),
        ]
        total = found if total is None else [a + b for a, b in zip(total, found, strict=True)]
    normal, reach, kind = mi.Vector3f(*total[:3]), *total[3:5]
    black, diffuse = total[5 : 5 + count], total[5 + count :]
    slant = dr.dot(normal, view)
    normal = dr.select(slant > 0.0, -normal, normal)
    cosine = dr.minimum(dr.abs(slant), 1.0)
    direction = view + 2.0 * cosine * normal
    # As far off the surface as the rays of the bake, and more where the ray is long.
    lift = 64.0 * 2.0**-24 * (1.0 + dr.maximum(reach, distance))
    seen, length, way = _seen(layers, depth - 1, mi.Point3f(eye + distance * view + lift * normal), direction)
    valid = length < np.inf
    seen = tables.through_air(seen, length, direction.z, valid)
    reflected = tables.reflected(kind, cosine, black, seen, valid, direction.z)
    return (*(a + b - c for a, b, c in zip(black, reflected, diffuse, strict=True)), way)


def _seen(layers, depth, origin, direction):
    """(channels, distance, whole way) of what rays of the first layer's frame meet, where mirrors reflect so often."""
    first, best = layers[0], None
    mi = first.geometry.mi
    for place, layer in enumerate(layers):
        geometry, outgoing = layer.geometry, layer.outgoing
        ray = mi.Ray3f(*_transformed(first.view, layer.view, origin, direction))
        hit = geometry.cast(ray, coherent=True)
        position = geometry.map_position(geometry.record(hit.face, hit.valid), ray.o + hit.distance * ray.d)
        away = dr.select(hit.valid, hit.distance, np.inf)
        found = [away, mi.UInt32(place), hit.face, *met(layer, hit, position)]
        found += outgoing.at(geometry, hit, position)
        best = found if best is None else [dr.select(away < best[0], a, b) for a, b in zip(found, best, strict=True)]
    state, seen, further = best[:5], best[5:], 0.0
    if depth:
        added, further = correction(layers, depth, origin, direction, *state)
        seen = [a + b for a, b in zip(seen, added, strict=True)]
    # The sky in a mirror ends elsewhere than the sky beside it, which tells their edge.
    return seen, state[0], state[0] + dr.minimum(further, _SKY_IN_MIRROR_M)


def last_steps(layers, *ray):
    """Return the band radiance that one reflection more would add to a frame, and another, [Float] [W m⁻² sr⁻¹].

    Parameters as of `correction`, without the depth.
    """
    tables = next(layer.outgoing.mirror.tables for layer in layers if layer.outgoing.mirror)
    first, *others = (correction(layers, depth, *ray)[0] for depth in (DEPTH, DEPTH + 1, DEPTH + 2))
    found = []
    for other in others:
        found.append(tables.band([b - a for a, b in zip(first, other, strict=True)]))
        first = other
    return found


def _paths(mi, at_m, scene, spectrum):
    """PathGrid from mirrors: of each channel, its share of each channel that is sent, and what the air adds to it."""
    box = box_of(scene)
    low, high = (min(at_m, scene.altitude_m + box[0, 2]), max(at_m, scene.altitude_m + box[1, 2]))

    def cells(passed, added):
        # Light of a basis behind a path is itself a sum over channels, as the band's is.
        shares = np.einsum("kn,...n,nj->...kj", spectrum.basis, passed, spectrum.solver)
        return np.concatenate([shares, (added @ spectrum.basis.T)[..., None]], -1).reshape(*passed.shape[:-1], -1)

    return PathGrid(mi, scene.air, at_m, (low, high), (1.0, farthest(scene)), cells)


def _bent(radiance):
    """b ln b of band radiances; 0 for none."""
    log = np.log if isinstance(radiance, np.ndarray) else dr.log
    positive = (np if log is np.log else dr).maximum(radiance, 1e-20)
    return positive * log(positive)


def _transformed(one, other, point, direction):
    """(point, direction) of one view's frame in that of another view from the same camera."""
    if one is other:
        return point, direction
    (rows, origin), (into, start) = one, other

    def turned(vector):
        local = sum(row * value for row, value in zip(rows, vector, strict=True))
        return type(direction)(*(dr.dot(row, local) for row in into))

    return None if point is None else start + turned(point - origin), turned(direction)


def _texels(scene, number, envelope):
    """(mean altitude [m], coldest, warmest [K]) of what is of a material, or None where nothing is."""
    warm, points = [], []
    for surface in scene.surfaces:
        own = surface.material == number
        if own.any():
            warm += [limit(surface.temperature[own]) for limit in (np.min, np.max)]
            column, row = (surface.uv.mean(axis=1) * own.shape[::-1]).astype(int).T
            faces = own[np.clip(row, 0, own.shape[0] - 1), np.clip(column, 0, own.shape[1] - 1)]
            points.append(surface.vertices[surface.faces[faces]].reshape(-1, 3))
    for tracked in scene.tracked_objects:
        if tracked.surfaces[0].material.flat[0] == number:
            warm += tracked.temperatures()
    if not warm:
        return None
    height = altitude(np.concatenate([*points, np.zeros((0, 3))]), scene.altitude_m)
    return float(height.mean() if height.size else np.mean(envelope.altitude_m)), float(min(warm)), float(max(warm))
