"""Between apparent and kinetic temperature of the terrain's texels, with the scene's emissivity and reflected light.

The reflected radiance is that of the scene's own temperatures; it changes little with those of a reconstruction.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.survey.inverse.linear import RANGE_K, LinearKelvin
from thermorender.apps.survey.inverse.weights import Lattice
from thermorender.learned.apply import LOWEST_EMISSIVITY
from thermorender.physics.band import RadianceTable, emitted_radiance, reflected_radiance
from thermorender.physics.planck import band_radiance

if TYPE_CHECKING:
    from thermorender import Renderer

Floats = NDArray[np.float64]
# A sky without weather may be so much warmer than its setting: under clouds instead of a clear sky [K].
_WARMER_K = 30.0


@dataclass(frozen=True, eq=False)
class Light:
    """The terrain's radiance by a scene's own temperatures and light, on the texels of a map."""

    apparent: Floats  # (h, w) float64 radiance that leaves each texel [linear kelvin]
    reflected: Floats  # (h, w) float64 reflected part [W m⁻² sr⁻¹]
    material: NDArray[np.uint8]  # (h, w) uint8 of the texel's middle, index in the scene's materials
    kinetic: Floats  # (h, w) float64 the scene's own temperature [K]


def light_of(renderer: "Renderer", lattice: Lattice, linear: LinearKelvin) -> Light:
    """Return the Light of a renderer's scene on a map."""
    scene, baked = renderer.scene, renderer.baked
    ground = scene.surfaces[0]
    count = ground.material.size
    leaving = sum(channel[:count].astype(np.float64) for channel in baked.texels)
    if baked.faces is not None:
        own = np.append(baked.faces.sum(axis=1, dtype=np.float64), 0.0)
        leaving = leaving + own[np.array(baked.geometry.face_of_texel)[:count]]
    leaving = np.asarray(leaving).reshape(ground.material.shape)
    emitted = np.empty(leaving.shape)
    for number in np.unique(ground.material):
        here = ground.material == number
        emitted[here] = _table(renderer, int(number), linear)(ground.temperature[here])
    material = ground.material[np.ix_(*lattice.middles(ground.material.shape))]
    return Light(
        lattice.of_scene(linear.of_radiance(leaving)), lattice.of_scene(leaving - emitted), material,
        lattice.of_scene(ground.temperature),
    )  # fmt: skip


def kinetic_of(
    apparent: Floats, light: Light, renderer: "Renderer", linear: LinearKelvin
) -> tuple[Floats, Floats, Floats, NDArray[np.bool_]]:  # fmt: skip
    """Return (kinetic temperature [K], its change with linear kelvin, standard deviation by that of the emissivity [K],
    trusted), each (h, w); unknown input is NaN.

    Not trusted are emissivities below 0.5, reflection by angle (water, glass), and equations without a solution; the
    kinetic temperature is then the scene's.
    """
    scene = renderer.scene
    emitted = linear.radiance(apparent) - light.reflected
    kinetic, change, std = light.kinetic.copy(), np.zeros(apparent.shape), np.zeros(apparent.shape)
    trusted = np.zeros(apparent.shape, bool)
    for number in np.unique(light.material):
        here, material = light.material == number, scene.materials[number]
        emissivity = float(material.band_emissivity(*linear.band_um, linear.reference_k))
        low = emissivity < LOWEST_EMISSIVITY
        table = _table(renderer, int(number), linear)
        step = 0.05 * linear.slope
        found = table.inverse(emitted[here])
        slope = (table.inverse(emitted[here] + step) - table.inverse(emitted[here] - step)) / 0.1
        known = np.isfinite(found) & np.isfinite(slope)
        if low or material.emissivity_by_angle is not None:
            known[:] = False
        kinetic[here] = np.where(known, found, kinetic[here])
        change[here] = np.where(known, slope, 0.0)
        # ε B(T) + (1 − ε) E is seen, so T falls by (B − E) / (ε dB/dT) per unit of ε.
        error = np.nan_to_num(material.band_emissivity_std(*linear.band_um, linear.reference_k))
        incident = light.reflected[here] / max(1.0 - emissivity, 1e-6)
        per_kelvin = linear.slope / linear.kelvin_per_linear(kinetic[here])
        contrast = np.abs(linear.radiance(linear.of(kinetic[here])) - incident)
        std[here] = np.where(known, error * contrast / (emissivity * per_kelvin), 0.0)
        trusted[here] = known
    return kinetic, change, std, trusted


def unknowns(renderer: "Renderer", material: NDArray[np.uint8], linear: LinearKelvin) -> list[str]:
    """Return sentences on what kinetic temperatures of a map's materials, (h, w), assume without a stated error."""
    scene, notes = renderer.scene, []
    present = [scene.materials[number] for number in np.unique(material)]
    unstated = [each.name for each in present if np.isnan(each.band_emissivity_std(*linear.band_um, 300.0))]
    if unstated:
        notes.append(
            f"the emissivity of {', '.join(unstated[:4])}{' and others' if len(unstated) > 4 else ''} has no stated "
            "error, so kinetic_std leaves it out; 0.01 is about 0.4 K under a cold sky"
        )
    if scene.spec.sky_temperature is not None:
        mend = "give the scene [weather] and leave out [sky]"
        if scene.spec.weather is not None:
            mend = "leave out [sky], so that the scene's [weather] gives it"
        sky = float(scene.sky_temperature)
        shares = [1.0 / float(each.band_emissivity(*linear.band_um, linear.reference_k)) - 1.0 for each in present]
        warmer, now = band_radiance(np.array([sky + _WARMER_K, sky]), *linear.band_um)
        notes.append(
            f"the reflected sky of {sky:.0f} K is [sky] of the scene, not of a weather: if it is {_WARMER_K:.0f} K "
            f"warmer, kinetic temperatures are {max(shares) * float(warmer - now) / linear.slope:.2f} K lower at most; "
            f"{mend}, or replace [sky] by [atmosphere]"
        )
    return notes


def apparent_of(kinetic_k: float, number: int, reflected: float, renderer: "Renderer", linear: LinearKelvin) -> float:
    """Return linear kelvin of a texel with a kinetic temperature [K] that reflects a radiance.

    Water and glass, which reflect by angle, are taken as seen from above under the scene's sky.
    """
    material = renderer.scene.materials[number]
    if material.emissivity_by_angle is None:
        emitted = float(_table(renderer, number, linear)(np.array([kinetic_k]))[0])
    else:

        def upward(wavelength_um: Floats) -> Floats:
            return np.asarray(material.emissivity_at_angle(wavelength_um, 1.0))

        emitted = float(emitted_radiance(upward, kinetic_k, *linear.band_um))
        reflected = float(reflected_radiance(upward, renderer.scene.sky_temperature, *linear.band_um))
    return float(linear.of_radiance(np.array([emitted + reflected]))[0])


def _table(renderer: "Renderer", number: int, linear: LinearKelvin) -> RadianceTable:
    material = renderer.scene.materials[number]
    return RadianceTable.of(material.emissivity_at, *RANGE_K, *linear.band_um)
