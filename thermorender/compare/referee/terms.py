"""Why a 2D translation and the 3D render of the same map differ: terms in kelvin that add up to the difference.

The way from one to the other goes through pictures of which each changes one thing, in this order:

1. the map's apparent temperature of the photograph (B);
2. that of the orthophoto, projected into the view: what differs is **geometry**, the scale and angle at which the map
   saw the ground, and objects by themselves in place of objects in their surroundings;
3. what these surfaces emit and reflect under the sky that the map was trained under: **emission**, zero where the
   map's apparent temperatures could be turned into kinetic ones, and elsewhere what stands in for them;
4. under the light of the scene instead, its sky and other surfaces: **reflection**;
5. through the air to the camera: **air**; that is C;
6. and behind the sensor, what its blur, noise and scale change of C less what they change of B: **sensor**.

An order is a choice: where two things act together, their common part counts for the earlier.
"""

import numpy as np

from thermorender.frame import apparent_temperature
from thermorender.learned.temperature_map import Inputs
from thermorender.physics.band import RadianceTable, emitted_radiance
from thermorender.physics.planck import band_radiance

NAMES = ("geometry", "emission", "reflection", "air", "sensor")


class Terms:
    """The terms of one map in one scene.

    Parameters
    ----------
    method : Method
        Its C1, of a map that sees colour only: others have no B.
    """

    def __init__(self, method):
        self._method, self._renderer = method, method.renderer
        scene, model = self._renderer.scene, method.model
        sky = model.sky_temperature
        terrain = scene.surfaces[: scene.terrain_count]
        seen, given = [], []
        for surface in scene.surfaces:
            kept = _under_sky(surface.temperature, surface.material, scene.materials, sky, model.band_um)
            own = kept
            if surface in terrain:
                apparent = model.radiance(Inputs(surface.colour, surface.texel_m))
                own = np.where(apparent > 0.0, apparent, kept)
            seen.append(own.ravel())
            given.append(kept.ravel())
        for item in scene.tracked_objects:
            kelvin = method.kelvin.get(item.name, item.item.temperature)
            for surface in item.surfaces:
                warm = np.full(surface.material.shape, kelvin)
                kept = _under_sky(warm, surface.material, scene.materials, sky, model.band_um).ravel()
                seen.append(kept)
                given.append(kept)
        self._seen, self._given = (np.concatenate(parts).astype(np.float32) for parts in (seen, given))

    def pictures(self, pose, time_s):
        """Return the pictures between B and C of a pose, (2 or 3, H, W) float32 apparent temperature [K].

        Those of the second and third step, and of the fourth where there is air: without it nothing lies between the
        surfaces and the camera, and what they send is the frame.
        """
        renderer, method, band = self._renderer, self._method, self._method.model.band_um
        at = (pose, time_s, method.objects)
        made = [renderer.pictured(values, *at) for values in (self._seen, self._given)]
        made += [renderer.radiance(*at, through_air=False)] if renderer.scene.air is not None else []
        return np.stack([apparent_temperature(picture, band) for picture in made])


def terms_of(pictures, flat, solid, flat_read, solid_read):
    """Return {name of `NAMES`: (H, W) float32} that add up to the difference of what the sensor reads of C and B.

    Parameters
    ----------
    pictures : (2 or 3, H, W) array
        As by `Terms.pictures`.
    flat, solid : (H, W) arrays
        Apparent temperature of B and of C [K].
    flat_read, solid_read : (H, W) arrays
        The same behind the sensor [K].
    """
    steps = [flat, *pictures, *([solid] if len(pictures) == 2 else []), solid]
    found = {name: after - before for name, before, after in zip(NAMES, steps, steps[1:], strict=False)}
    found["sensor"] = (solid_read - solid) - (flat_read - flat)
    return found


def _under_sky(temperature, material, materials, sky_k, band_um):
    """Band radiance of texels at kinetic temperatures (h, w) [K] under an isotropic sky, without other surfaces."""
    found, sky = np.empty(temperature.shape), band_radiance(sky_k, *band_um)
    for number in np.unique(material):
        here, emissivity = material == number, materials[number].emissivity_at
        own = temperature[here].astype(np.float64)
        # By table: the spectra of millions of texels would not fit memory.
        emitted = RadianceTable.of(emissivity, own.min(), own.max(), *band_um)
        found[here] = emitted(own) + sky - emitted_radiance(emissivity, sky_k, *band_um)
    return found
