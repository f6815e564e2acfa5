"""Effect of an emissivity error on radiance and on apparent temperature.

A surface at T under irradiance E emits and reflects ε B(T) + (1 − ε) E/π, so an error Δε changes this by Δε (B(T) −
E/π). Here E is the sky's irradiance alone, and there is no air.
"""

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.compare.sums import into
from thermorender.apps.compare.view import View
from thermorender.physics.band import RadianceTable
from thermorender.physics.planck import band_radiance
from thermorender.render.spectrum import REFERENCE_K
from thermorender.scene.scene import Scene

# Least Δε at which the change of temperature is taken, least emissivity that a radiance is divided by, and range of
# temperatures beyond those of the reference [K].
_STEP, _LEAST, _BEYOND_K = 0.01, 0.1, 60.0


def band_emissivities(scene: Scene) -> NDArray[np.float64]:
    """Return the hemispherical emissivity of each of a scene's materials in its camera's band, (M,) [1]."""
    return np.array([each.band_emissivity(*scene.camera.band_um, REFERENCE_K) for each in scene.materials])


def of_scenes(own: Scene, true: Scene) -> dict[str, NDArray[np.float64]]:
    """Return {true material: (texels, Σ used emissivity, Σ true emissivity, all texels)}; the terrains share texels."""
    used, known = band_emissivities(own), band_emissivities(true)
    found: dict[str, NDArray[np.float64]] = {}
    total = 0
    for mine, theirs in zip(own.surfaces[: own.terrain_count], true.surfaces, strict=False):
        material = theirs.material.ravel()
        total += material.size
        count = np.bincount(material, minlength=256)
        mine_sum = np.bincount(material, used[mine.material.ravel()], 256)
        for number in np.flatnonzero(count):
            row = np.array([count[number], mine_sum[number], count[number] * known[number], 0.0])
            into(found, true.materials[number].name, row)
    return {name: row + [0.0, 0.0, 0.0, total] for name, row in found.items()}


def change_k(
    view: View, emissivity: NDArray[np.float64], image: NDArray[np.floating], sky_k: float, band_um: tuple[float, float]
) -> NDArray[np.float64]:
    """Return the change of a method's apparent temperature by a unit of emissivity, (H, W) [K]; 0 outside known ground.

    `emissivity` (M,) holds the true ones of the view's materials, `image` (H, W) is the method's apparent temperature
    [K]. The change is that of each material's best fit to the error of radiance, over its Δε, with B(T) − E/π = (L −
    E/π) / ε of the reference radiance L. The texel's kinetic temperature would not match a radiance interpolated
    between texels.
    """
    assert view.truth is not None
    here = view.ground & np.isfinite(image)
    found = np.zeros(view.known.shape)
    if not here.any():
        return found
    material = view.material[here]
    kelvin = RadianceTable.grid(float(view.truth[here].min()) - _BEYOND_K, float(view.truth[here].max()) + _BEYOND_K)
    radiance = band_radiance(kelvin, *band_um)
    true, seen = (np.interp(values[here], kelvin, radiance) for values in (view.truth, image))
    known = np.append(np.maximum(emissivity, _LEAST), np.ones(256 - len(emissivity)))
    x = (true - band_radiance(sky_k, *band_um)) / known[material]
    both, own = (np.bincount(material, weights, 256) for weights in (x * (seen - true), x * x))
    best = np.clip(both / np.maximum(own, 1e-12), -1.0, 1.0)
    best = np.where(np.abs(best) < _STEP, np.where(best < 0.0, -_STEP, _STEP), best)
    found[here] = (np.interp(true + best[material] * x, radiance, kelvin) - view.truth[here]) / best[material]
    return found
