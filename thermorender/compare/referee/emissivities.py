"""What emissivity an error looks like: the change of each material's that would explain it best.

A surface at temperature T under light E sends ε B(T) + (1 − ε) E/π. An emissivity wrong by Δε changes that by
Δε (B(T) − E/π): large under a cold sky, nothing in an enclosure of its own temperature. The Δε of a material is that of
least squares over its pixels; E is taken for that of the sky alone, and the air for clear.
"""

from dataclasses import dataclass, field

import numpy as np

from thermorender.physics.band import RadianceTable
from thermorender.physics.planck import band_radiance
from thermorender.render.spectrum import REFERENCE_K

# Told where a material covers this share of the ground and errs by as much [K]; its Δε where that takes away this share
# of the mean square error.
LEAST_SHARE, LEAST_K, LEAST_EXPLAINED = 0.005, 0.3, 0.5
# An emissivity beyond 0…1 by more than this is none: the error has another cause.
_BEYOND = 0.02


def band_emissivities(scene):
    """Return the hemispherical emissivity of each of a scene's materials in its camera's band, (M,) [1]."""
    return np.array([each.band_emissivity(*scene.camera.band_um, REFERENCE_K) for each in scene.materials])


def of_scenes(own, true):
    """Return {material: (texels, Σ emissivity used, Σ true emissivity, texels in all)} of the terrain of two Scenes.

    They are of the same texels; the materials are those of the second.
    """
    used, known = band_emissivities(own), band_emissivities(true)
    found, total = {}, 0
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


def contrast(view, sky_k, band_um):
    """Return B(T) − E/π of a View's pixels, (H, W) float64 [W m⁻² sr⁻¹], by table; 0 where nothing is known."""
    kinetic = np.where(view.known, view.kinetic, np.float32(sky_k)).astype(np.float64)
    grid = RadianceTable.grid(kinetic.min(), kinetic.max())
    return RadianceTable(grid, band_radiance(grid, *band_um))(kinetic) - band_radiance(sky_k, *band_um)


@dataclass
class Emissivities:
    """Sums over pixels, per material: n, Σxδ, Σx², Σδ², Σ error in kelvin, Σε; x is B(T) − E/π, δ an error of radiance.

    Attributes
    ----------
    rows : dict of str to (6,) array
    scenes : dict of str to {str: (2,) array}
        Of each scene, per material: n, Σ error in kelvin.
    """

    rows: dict = field(default_factory=dict)
    scenes: dict = field(default_factory=dict)

    def add(self, scene, view, contrast, radiance, error_k, emissivity):
        """Add a View's ground.

        Parameters
        ----------
        scene : str
        view : View
        contrast : (H, W) array
            As by `contrast`.
        radiance, error_k : (H, W) arrays
            What a method sends [W m⁻² sr⁻¹], and how it errs [K].
        emissivity : (M,) array
            True ones of the view's materials, as by `band_emissivities`.
        """
        here = view.known & (view.object < 0) & np.isfinite(error_k)
        material, x = view.material[here], contrast[here]
        off = radiance[here].astype(np.float64) - view.truth_radiance[here]
        columns = [np.bincount(material, weights, 256) for weights in (None, x * off, x * x, off * off, error_k[here])]
        for number in np.flatnonzero(columns[0]):
            name = view.material_names[number]
            row = np.array([*(column[number] for column in columns), columns[0][number] * emissivity[number]])
            self.rows[name] = self.rows.get(name, 0.0) + row
            own = self.scenes.setdefault(scene, {})
            own[name] = own.get(name, 0.0) + row[[0, 4]]

    def _others(self, name):
        """Median size of the mean errors of the other materials in the scenes that have this one [K], or None."""
        together = {}
        for own in self.scenes.values():
            for other, row in own.items() if name in own else ():
                together[other] = together.get(other, 0.0) + row
        together.pop(name, None)
        return float(np.median([abs(error / count) for count, error in together.values()])) if together else None

    def summary(self):
        """Return {material: {share, error_k, others_k, change, explained}} of those that err.

        `others_k` is the median size of the others' mean errors in the same scenes, None where there are none. `change`
        is the Δε, None where it does not explain the error or the emissivity would leave 0…1: something else is wrong,
        such as the temperature.
        """
        total = sum(row[0] for row in self.rows.values())
        told = {}
        for name, (count, xoff, xx, offoff, kelvin, emissivity) in self.rows.items():
            if not xx > 0.0 or not offoff > 0.0:
                continue
            change, explained = xoff / xx, xoff * xoff / (xx * offoff)
            error = kelvin / count
            if count >= LEAST_SHARE * total and abs(error) >= LEAST_K:
                possible = -_BEYOND <= emissivity / count + change <= 1.0 + _BEYOND
                told[name] = {"share": count / total, "error_k": error, "others_k": self._others(name),
                              "change": change if possible and explained >= LEAST_EXPLAINED else None,
                              "explained": explained}  # fmt: skip
        return told
