"""How directional materials reflect, on the device: their tables, and the texels of a layer that are of them."""

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from thermorender.atmosphere.model import Atmosphere
from thermorender.physics.fresnel import COSINES
from thermorender.physics.sun import SOLID_ANGLE_SR
from thermorender.render.air import PathGrid
from thermorender.render.arrays import Channels, Floats, Jit, Mitsuba, aligned, opaque_vector
from thermorender.render.geometry import box_of, farthest
from thermorender.render.plan import Plan
from thermorender.render.reflection.reflectance import Glint, bent, facet_variance
from thermorender.render.spectrum import Spectrum
from thermorender.scene.scene import Scene


class DirectionalTexels:
    """Data of the directional texels of one layer: `number` (T,) is of the tables, `black` (n, K) from `black_of`."""

    def __init__(self, mi: Mitsuba, tables: "DeviceTables", number: NDArray[np.integer], black: Floats) -> None:
        self.tables = tables
        texels = np.flatnonzero(number)
        row = np.zeros(len(number), dtype=np.uint32)
        row[texels] = 1 + np.arange(len(texels))
        self.row = mi.UInt32(aligned(row, np.uint32))
        self.kind = mi.UInt32(aligned(number[texels] - 1, np.uint32))
        self.black = Channels(mi, black)


class DeviceTables:
    """The ReflectanceTables of a Plan on the device."""

    def __init__(self, mi: Mitsuba, scene: Scene, plan: Plan) -> None:
        assert plan.specular is not None
        tables, spectrum, spacing = (
            plan.specular,
            plan.spectrum,
            1.0 / (scene.camera.focal_length_px * plan.sampling.samples**0.5),
        )
        self.number, self._mi = tables.number, mi
        self._path = None if scene.air is None else _paths(mi, scene.air, tables.at_m, scene, spectrum)
        self._at_m = None if scene.air is None else dr.opaque(mi.Float, tables.at_m)
        self.count = tables.matrix.shape[-2]
        self._weight = [dr.opaque(mi.Float, float(value)) for value in tables.weight]
        self._directions = tables.environment.shape[2] - 1
        self._matrix = Channels(mi, tables.matrix.reshape(-1, self.count * (self.count + 1)))
        self._environment = Channels(mi, tables.environment.reshape(-1, self.count))
        self.glint = None if tables.glint is None else DeviceGlint(mi, tables.glint, spacing)

    def reflected(self, kind: Jit, cosine: Jit, black: list[Jit], seen: list[Jit], valid: Jit, up: Jit) -> list[Jit]:
        """Return the light that materials reflect into each channel minus that of a blackbody, [Float]. `kind` is the
        row in the tables, `cosine` of the angle of view. Where not `valid`, light comes from the environment at a
        cosine of zenith angle `up`."""
        mi, count, lines = self._mi, self.count, self._directions
        own, other = ([*light, bent(self.band(light))] for light in (black, seen))
        light = [dr.select(valid, a, 0.0) - b for a, b in zip(other, own, strict=True)]
        row, across = _interval(mi, cosine, len(COSINES))
        row = row + kind * len(COSINES)
        near, far = (self._matrix.at(row + k) for k in (0, 1))
        matrix = [dr.lerp(a, b, across) for a, b in zip(near, far, strict=True)]
        column, along = _interval(mi, up, lines) if lines > 1 else (mi.UInt32(0), mi.Float(0.0))
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
        """Return channels of light, [Float], behind the path from its source to the mirror: length [m], cosine of
        zenith."""
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


class DeviceGlint:
    """A Glint on the device, for rays at a `spacing` [rad]: the disc is never smaller than that one meets it."""

    def __init__(self, mi: Mitsuba, glint: Glint, spacing: float) -> None:
        self._solid_sr = dr.opaque(mi.Float, max(SOLID_ANGLE_SR, float(np.pi) * spacing**2))
        self._mi, self.towards, self.direction = mi, glint.towards, opaque_vector(mi, glint.towards)
        self._slope = mi.Float(aligned(glint.slope))
        self._reflected = Channels(mi, glint.reflected.reshape(-1, glint.reflected.shape[-1]))

    def seen(self, kind: Jit, normal: Jit, view: Jit) -> list[Jit]:
        """Return the channels of the sun's image in unshadowed materials, [Float], 0 where there is none. `kind` is the
        row in the tables; `view` points to a surface whose `normal` faces the eye.

        Rough: C. Cox and W. Munk, J. Opt. Soc. Am. 44 (1954) 838, doi:10.1364/JOSA.44.000838, with masking by Smith
        (1967), doi:10.1109/TAP.1967.1138991, in both directions. Smooth: the disc in the reflected direction.
        """
        mi, towards = self._mi, self.direction
        to_eye, to_sun, slope = -dr.dot(normal, view), dr.dot(normal, towards), dr.gather(mi.Float, self._slope, kind)
        half = dr.normalize(towards - view)
        upright = dr.maximum(dr.dot(normal, half), 1e-3)
        square, variance = upright * upright, facet_variance(slope)
        facets = dr.exp((square - 1.0) / (square * variance)) / (np.pi * variance)
        masking = 1.0 + _masking(to_eye, variance) + _masking(to_sun, variance)
        rough = facets / (4.0 * dr.maximum(to_eye, 1e-4) * square * square * masking)
        aside = dr.squared_norm(view + 2.0 * to_eye * normal - towards)
        smooth = dr.select(aside < self._solid_sr / float(np.pi), 1.0 / self._solid_sr, 0.0)
        # The facets of a smooth mirror are its face.
        row, across = _interval(mi, dr.select(slope > 0.0, dr.dot(half, towards), to_eye), len(COSINES))
        row = row + kind * len(COSINES)
        bright = dr.select(to_sun > 0.0, dr.select(slope > 0.0, rough, smooth), 0.0)
        near, far = (self._reflected.at(row + k) for k in (0, 1))
        return [bright * dr.lerp(a, b, across) for a, b in zip(near, far, strict=True)]


def _masking(cosine: Jit, variance: Jit) -> Jit:
    """Smith's function Λ of a direction for Gaussian slopes of a variance, both axes together."""
    steep = cosine / dr.sqrt(dr.maximum(1.0 - cosine * cosine, 1e-12) * variance)
    steep = dr.clip(steep, 1e-3, 4.0)
    return 0.5 * (dr.exp(-steep * steep) / (np.pi**0.5 * steep) - (1.0 - dr.erf(steep)))


def _interval(mi: Mitsuba, cosine: Jit, count: int) -> tuple[Jit, Jit]:
    """(lower index, share of the next) in a table at `count` squares of an even grid."""
    position = dr.sqrt(dr.clip(cosine, 0.0, 1.0)) * (count - 1)
    lower = dr.minimum(mi.UInt32(position), count - 2)
    grid = mi.Float(lower)
    # Linear in the cosine itself between its squares.
    return lower, (position * position - grid * grid) / (2.0 * grid + 1.0)


def black_of(
    plan: Plan, number: NDArray[np.uint8], material: NDArray[np.integer], temperature: NDArray[np.floating]
) -> Floats:
    """Return channels (n, K) of blackbodies at the directional texels' temperatures [W m⁻² sr⁻¹]; `number` (M,) is of
    the tables."""
    warm = temperature[number[material] > 0]
    grid, table = plan.spectrum.emitted(np.ones_like, float(warm.min()), float(warm.max()), plan.band_um)
    return np.stack([np.interp(warm, grid, channel) for channel in table.T], axis=1)


def _paths(mi: Mitsuba, air: Atmosphere, at_m: float, scene: Scene, spectrum: Spectrum) -> PathGrid:
    """PathGrid from mirrors: the share of each channel in each channel, and the light that the air adds to it."""
    box = box_of(scene)
    low, high = (min(at_m, scene.altitude_m + box[0, 2]), max(at_m, scene.altitude_m + box[1, 2]))

    def cells(passed: Floats, added: Floats) -> Floats:
        # Each channel of light behind a path is a sum over channels, as the band radiance is.
        shares = np.einsum("kn,...n,nj->...kj", spectrum.basis, passed, spectrum.solver)
        return np.concatenate([shares, (added @ spectrum.basis.T)[..., None]], -1).reshape(*passed.shape[:-1], -1)

    return PathGrid(mi, air, at_m, (low, high), (1.0, farthest(scene)), cells)
