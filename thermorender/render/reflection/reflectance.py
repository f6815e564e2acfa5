"""How materials with an angle-dependent emissivity reflect: tables by angle, fitted to the light of a scene."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from thermorender.materials.material import Material
from thermorender.physics.fresnel import COSINES, smooth_emissivity
from thermorender.physics.planck import (
    band_radiance,
    band_radiance_derivative,
    brightness_temperature,
    kelvin_per_radiance,
)
from thermorender.physics.sun import SOLID_ANGLE_SR, direction
from thermorender.render.air import altitude
from thermorender.render.arrays import Floats
from thermorender.render.geometry import farthest
from thermorender.render.spectrum import REFERENCE_K, Envelope, Spectrum
from thermorender.scene.scene import Scene

# Directions of the sky, even in the square root of the cosine of zenith angle.
_DIRECTIONS = np.linspace(0.0, 1.0, 65) ** 2
# Steepest view for which effect and error are stated, and angles at which they are evaluated.
_GRAZING = np.cos(np.radians(80.0))
_JUDGED = np.flatnonzero(COSINES >= _GRAZING)[::8]
# Number of blackbodies between the coldest and the warmest texel, and their weight in the fit of reflected light:
# mirrors emit as they do, and most of the ground nearly so.
_BLACK, _TRUST = 5, 10.0
# Paths behind which other light is reflected too, as shares of the scene's size.
_SEEN_BEHIND = np.array([0.01, 0.1, 0.5])
# Relative size below which the fit ignores variations of the light: float32 does not resolve them.
_SMALLEST = 1e-4


@dataclass(frozen=True)
class ReflectanceTables:
    """How directional materials reflect, by the cosine of the angle of view at `COSINES`."""

    number: NDArray[np.uint8]  # (M,) 1 + row in these tables for each material of the scene; 0 for Lambertian ones
    # (D, 257, K, K + 1) difference of two reflections in each channel, per difference of channels and of b ln b.
    matrix: Floats
    # (D, 257, S, K) reflection of the sky at S − 1 zenith angles and of the surroundings, minus that of no light.
    environment: Floats
    weight: Floats  # (K,) of the channels in the band radiance
    # Largest change if diffuse, over the envelope's light up to 80°, estimated from above [mK at 300 K].
    effect_mk: float
    error_mk: float  # largest error of `matrix`, over the envelope's light up to 80° [mK]
    at_m: float  # mean altitude of the mirrors above sea level [m]
    glint: "Glint | None"  # of the sun, where it shines


@dataclass(frozen=True)
class Glint:
    """The sun as directional materials reflect it."""

    towards: Floats  # (3,) to the sun
    slope: Floats  # (D,) root mean square slope of the facets, 0 for a mirror
    # (D, 257, K) irradiance that facets reflect into each channel, by the cosine of incidence [W m⁻²]
    reflected: Floats

    def brightest(self, weight: Floats) -> float:
        """Return the largest band radiance that a material shows up to 80°; `weight` (K,) of the channels."""
        peak = np.where(self.slope > 0.0, 0.25 / (np.pi * facet_variance(self.slope)), 1.0 / SOLID_ANGLE_SR)
        return float((peak[:, None] * (self.reflected[:, _JUDGED] @ weight)).max() / _GRAZING)


def facet_variance(slope: Any) -> Any:
    """Return the variance of the facets' slopes, both axes together, with the half-width of the sun's disc in it.

    A uniform disc of radius R has the variance R²/2, and a facet turns by half of what its reflection does.
    """
    return slope * slope + SOLID_ANGLE_SR / (8.0 * np.pi)


def directional(materials: Sequence[Material]) -> list[int]:
    """Return the numbers of the materials whose emissivity depends on the angle."""
    return [number for number, material in enumerate(materials) if material.emissivity_by_angle is not None]


def make_tables(scene: Scene, spectrum: Spectrum, envelope: Envelope) -> ReflectanceTables | None:
    """Return the ReflectanceTables of a scene, or None where no texel is of a directional material.

    The channels resolve the spectra that determine reflection only in part. `matrix` is a least-squares fit in relative
    terms, over the envelope's light with and without air in front. Its terms are a constant, a share of each channel,
    and a share of b ln b, which is as curved as the reflection of blackbodies of very different temperatures.
    Differences cancel the constant; `environment` keeps it.
    """
    points = spectrum.points
    seen = {number: texels for number in directional(scene.materials) if (texels := _texels(scene, number, envelope))}
    if not seen:
        return None
    sources = envelope.sources(points)
    spectra = np.array([material.emissivity_at(points.wavelength_um) for material in scene.materials])
    # The environment comes first.
    light = envelope.light(spectra, *sources)
    cases = [
        _MaterialFit(scene, spectrum, scene.materials[number], spectra[number], envelope, sources[0], light, *texels)
        for number, texels in seen.items()
    ]
    row = np.zeros(len(scene.materials), dtype=np.uint8)
    row[list(seen)] = 1 + np.arange(len(seen))
    matrix, environment = (np.stack([getattr(case, name) for case in cases]) for name in ("matrix", "environment"))
    weight = spectrum.solver.sum(axis=0)
    effect_mk, error_mk = (max(getattr(case, name) for case in cases) for name in ("effect_mk", "error_mk"))
    at_m = float(np.mean([at_m for at_m, *_ in seen.values()]))
    glint = None
    if envelope.sun_cosine is not None:
        assert scene.sun is not None
        towards = direction(scene.sun.elevation_deg, scene.sun.azimuth_deg)
        own = [scene.materials[number] for number in seen]
        light = points.sunlight(at_m, envelope.sun_cosine) * spectrum.basis[:, points.node]
        reflected = np.stack([_facets(each, points.wavelength_um) @ light.T for each in own])
        glint = Glint(towards, np.array([each.rms_slope for each in own]), reflected)
        bright = brightness_temperature(
            band_radiance(REFERENCE_K, *envelope.band_um) + glint.brightest(weight), *envelope.band_um
        )
        effect_mk = max(effect_mk, 1e3 * (bright - REFERENCE_K))
    return ReflectanceTables(row, matrix, environment, weight, effect_mk, error_mk, at_m, glint)


def _facets(material: Material, wavelength_um: Floats) -> Floats:
    """Reflectance of single facets of a material by the cosine of incidence, (257, Q)."""
    if not material.rms_slope:
        return 1.0 - material.emissivity_at_angle(wavelength_um, COSINES[:, None])
    # The material's own emissivity is the mean over facets.
    rows = np.loadtxt(material.table.splitlines(), delimiter=",", skiprows=1)
    n, k = (np.interp(wavelength_um, rows[:, 0], rows[:, column]) for column in (1, 2))
    return 1.0 - smooth_emissivity(COSINES[:, None], n, k)


class _MaterialFit:
    """One material's part of `ReflectanceTables`."""

    def __init__(
        self, scene: Scene, spectrum: Spectrum, material: Material, diffuse: Floats, envelope: Envelope,
        environment: Floats, light: Floats, at_m: float, coldest: float, warmest: float,
    ) -> None:  # fmt: skip
        points = spectrum.points
        channel = spectrum.basis[:, points.node]
        reflectance = 1.0 - material.emissivity_at_angle(points.wavelength_um, COSINES[:, None])

        def reflected(spectra: Floats) -> Floats:
            return np.stack([reflectance @ (spectra * row).T for row in channel], axis=-1)

        limits = min(coldest, *envelope.ground), max(warmest, *envelope.ground)
        black = points.planck(np.linspace(*limits, _BLACK))
        every = np.concatenate([black, light[len(environment) :]])
        if scene.air is not None:
            # Light of surfaces behind the air of paths to the mirror has a spectrum unlike a blackbody's.
            paths = scene.air.path(at_m, at_m, farthest(scene) * _SEEN_BEHIND)
            behind = [every * passed[points.node] + points.spread(added) for passed, added in zip(*paths, strict=True)]
            every = np.concatenate([every, *behind])
        every = every[every.sum(axis=1) > 0.0]
        size, channels = every.sum(axis=1), every @ channel.T
        known = np.column_stack([channels, bent(channels @ spectrum.solver.sum(axis=0)), np.full(len(size), size[0])])
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


def _texels(scene: Scene, number: int, envelope: Envelope) -> tuple[float, float, float] | None:
    """(mean altitude [m], coldest, warmest [K]) of the texels of a material, or None without any."""
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


def bent(radiance: Any) -> Any:
    """Return b ln b of band radiances, NumPy or Dr.Jit arrays; 0 for no radiance."""
    log = np.log if isinstance(radiance, np.ndarray) else dr.log
    positive = (np if log is np.log else dr).maximum(radiance, 1e-20)
    return positive * log(positive)
