"""The difference between the 2D translation and the 3D render of a map, split into terms in kelvin.

A sequence of pictures leads from one to the other. Each changes one thing:

1. the map's apparent temperature of the photograph;
2. the map's apparent temperature of the orthophoto, projected into the view. The difference is **geometry**: the scale
   and angle at which the map saw the ground, and objects translated without their surroundings;
3. the emission and reflection of these surfaces under the sky that the map was trained under: **emission**. It is zero
   where apparent temperatures could be converted to kinetic ones, and elsewhere the effect of the substitute;
4. the same under the light of the scene, its sky and other surfaces: **reflection**;
5. the same through the air to the camera: **air**; this is the map as kelvin, with true materials;
6. after the sensor: the change of this picture by its blur, noise and scale minus that of the first: **sensor**.

The order is a choice: where two causes interact, their common part counts for the earlier one. All pictures are of the
camera's band. Under a map of another band, steps 1 to 3 keep its apparent temperatures, and the change of band counts
for reflection.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.apps.compare.methods import Method
from thermorender.frame import apparent_temperature
from thermorender.learned.apply import InBand
from thermorender.learned.temperature_map import Inputs
from thermorender.physics.band import RadianceTable, emitted_radiance, radiance_in_band
from thermorender.physics.planck import band_radiance

NAMES = ("geometry", "emission", "reflection", "air", "sensor")


class Terms:
    """The terms of one map in one scene, from its Method as kelvin; maps with extra inputs have no photograph."""

    def __init__(self, method: Method) -> None:
        assert method.model is not None
        self._method, self._renderer = method, method.renderer
        scene, model = self._renderer.scene, method.model
        self._band_um, sky = scene.camera.band_um, model.sky_temperature
        terrain, materials = scene.surfaces[: scene.terrain_count], InBand(model, scene.materials, scene.where)
        seen, given = [], []
        for surface in scene.surfaces:
            kept = _under_sky(surface.temperature, surface.material, materials, sky, model.band_um)
            own = kept
            if surface in terrain:
                apparent = model.radiance(Inputs(surface.colour, surface.texel_m))
                own = np.where(apparent > 0.0, apparent, kept)
            seen.append(own.ravel())
            given.append(kept.ravel())
        for item in scene.tracked_objects:
            kelvin = method.kelvin.get(item.name, item.item.kelvin)
            for surface in item.surfaces:
                warm = np.full(surface.material.shape, kelvin)
                kept = _under_sky(warm, surface.material, materials, sky, model.band_um).ravel()
                seen.append(kept)
                given.append(kept)
        self._seen, self._given = (
            radiance_in_band(np.concatenate(parts), model.band_um, self._band_um).astype(np.float32)
            for parts in (seen, given)
        )

    def pictures(self, pose: ArrayLike, time_s: float) -> NDArray[np.float32]:
        """Return steps 2, 3 and, with air, 4 of a pose, (2 or 3, H, W) float32 [K] apparent."""
        renderer = self._renderer
        at = (pose, time_s, self._method.objects)
        steps = [renderer.pictured(values, *at) for values in (self._seen, self._given)]
        if renderer.scene.air is not None:
            steps.append(renderer.radiance(*at, through_air=False))
        return np.stack([apparent_temperature(picture, self._band_um) for picture in steps])


def terms_of(
    pictures: NDArray[np.floating],
    flat: NDArray[np.floating],
    solid: NDArray[np.floating],
    flat_read: NDArray[np.floating],
    solid_read: NDArray[np.floating],
) -> dict[str, NDArray[np.floating]]:
    """Return {name of `NAMES`: (H, W) float32 [K]}, which add up to the difference after the sensor.

    `flat` and `solid` are apparent temperatures (H, W) on the photograph and as kelvin [K], `flat_read` and
    `solid_read` those after the sensor.
    """
    steps = [flat, *pictures, *([solid] if len(pictures) == 2 else []), solid]
    found = {name: after - before for name, before, after in zip(NAMES, steps, steps[1:], strict=False)}
    found["sensor"] = (solid_read - solid) - (flat_read - flat)
    return found


def _under_sky(
    temperature: NDArray[np.floating],
    material: NDArray[np.integer],
    materials: "InBand",
    sky_k: float,
    band_um: tuple[float, float],
) -> NDArray[np.float64]:
    """Return band radiance of texels at kinetic temperatures (h, w) [K] under an isotropic sky, without occlusion."""
    found, sky = np.empty(temperature.shape), band_radiance(sky_k, *band_um)
    for number in np.unique(material):
        here, emissivity = material == number, materials[number].emissivity_at
        own = temperature[here].astype(np.float64)
        # A table, because the spectra of millions of texels would not fit in memory.
        emitted = RadianceTable.of(emissivity, own.min(), own.max(), *band_um)
        found[here] = emitted(own) + sky - emitted_radiance(emissivity, sky_k, *band_um)
    return found
