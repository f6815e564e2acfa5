"""Emissivity errors: what a change of a material's emissivity does to radiance and to apparent temperature.

A surface at temperature T under irradiance E emits and reflects ε B(T) + (1 − ε) E/π. An emissivity error Δε changes
this by Δε (B(T) − E/π): much under a cold sky, nothing in an enclosure of the same temperature. Here E is the sky's
irradiance alone, and there is no air.
"""

import numpy as np
from numpy.typing import NDArray

from thermorender.compare.referee.views import View
from thermorender.physics.band import RadianceTable
from thermorender.physics.planck import band_radiance
from thermorender.render.spectrum import REFERENCE_K
from thermorender.scene.scene import Scene

# Least Δε at which the change of temperature is taken.
_STEP = 0.01


def band_emissivities(scene: Scene) -> NDArray[np.float64]:
    """Return the hemispherical emissivity of each of a scene's materials in its camera's band, (M,) [1]."""
    return np.array([each.band_emissivity(*scene.camera.band_um, REFERENCE_K) for each in scene.materials])


def of_scenes(own: Scene, true: Scene) -> dict[str, NDArray[np.float64]]:
    """Return {material: (texels, Σ used emissivity, Σ true emissivity, all texels)} of the terrain of two Scenes.

    Both scenes have the same texels. The names are those of the materials of `true`.
    """
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
            name = true.materials[number].name
            found[name] = found.get(name, 0.0) + row
    return {name: row + [0.0, 0.0, 0.0, total] for name, row in found.items()}


def contrast(view: View, sky_k: float, band_um: tuple[float, float]) -> NDArray[np.float64]:
    """Return B(T) − E/π of a View's pixels, (H, W) [W m⁻² sr⁻¹], from a table; 0 at unknown pixels."""
    kinetic = np.where(view.known, view.kinetic, np.float32(sky_k)).astype(np.float64)
    grid = RadianceTable.grid(kinetic.min(), kinetic.max())
    emitted: NDArray[np.float64] = RadianceTable(grid, band_radiance(grid, *band_um))(kinetic)
    return emitted - band_radiance(sky_k, *band_um)


def change_k(
    view: View, contrast: NDArray[np.float64], image: NDArray[np.floating], band_um: tuple[float, float]
) -> NDArray[np.float64]:
    """Return the change of apparent temperature by a unit of emissivity, (H, W) [K].

    Temperature is not linear in radiance. The change is therefore that of each material's best fit to the error of
    radiance, divided by its Δε.

    Parameters
    ----------
    view : View
        With a reference.
    contrast : (H, W) array
        As the function `contrast` returns it.
    image : (H, W) array
        Apparent temperature of a method [K].
    band_um : (lower, upper)
    """
    assert view.truth is not None
    here = view.known & (view.object < 0) & np.isfinite(image)
    material, x = view.material[here], contrast[here]
    kelvin = RadianceTable.grid(*_limits(view.truth[here], 60.0))
    radiance = band_radiance(kelvin, *band_um)
    true, seen = (np.interp(values[here], kelvin, radiance) for values in (view.truth, image))
    off = seen - true
    both, own = (np.bincount(material, weights, 256) for weights in (x * off, x * x))
    best = np.clip(both / np.maximum(own, 1e-12), -1.0, 1.0)
    # A small step in place of none.
    best = np.where(np.abs(best) < _STEP, np.where(best < 0.0, -_STEP, _STEP), best)
    found = np.zeros(view.known.shape)
    found[here] = (np.interp(true + best[material] * x, radiance, kelvin) - view.truth[here]) / best[material]
    return found


def _limits(kelvin: NDArray[np.floating], beyond: float) -> tuple[float, float]:
    """Return the lowest and highest temperature, and this much more on both sides [K]."""
    if not kelvin.size:
        return 250.0, 350.0
    return max(float(kelvin.min()) - beyond, 100.0), float(kelvin.max()) + beyond
