"""Emissivity errors: the change of each material's emissivity that best explains an error of radiance.

A surface at temperature T under irradiance E emits and reflects ε B(T) + (1 − ε) E/π. An emissivity error Δε changes
this by Δε (B(T) − E/π): much under a cold sky, nothing in an enclosure of the same temperature. Δε is a least-squares
fit over the pixels of a material, with the sky's irradiance alone and without air.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from thermorender.compare.referee.views import View
from thermorender.physics.band import RadianceTable
from thermorender.physics.planck import band_radiance
from thermorender.render.spectrum import REFERENCE_K
from thermorender.scene.scene import Scene

# A material is reported if it covers this share of the ground and its error is at least this large [K]; its Δε, if that
# explains at least this share of the mean square error.
LEAST_SHARE, LEAST_K, LEAST_EXPLAINED = 0.005, 0.3, 0.5
# If the emissivity would leave 0…1 by more than this, the error has another cause.
_BEYOND = 0.02


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


@dataclass
class Emissivities:
    """Sums per material: n, Σxδ, Σx², Σδ², Σ error in kelvin, Σε; x is B(T) − E/π, δ is the error of radiance.

    Attributes
    ----------
    rows : dict of str to (6,) array
    scenes : dict of str to {str: (2,) array}
        For each scene, per material: n, Σ error in kelvin.
    """

    rows: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    scenes: dict[str, dict[str, NDArray[np.float64]]] = field(default_factory=dict)

    def add(
        self,
        scene: str,
        view: View,
        contrast: NDArray[np.float64],
        radiance: NDArray[np.floating],
        error_k: NDArray[np.floating],
        emissivity: NDArray[np.float64],
    ) -> None:
        """Add the ground of a View.

        Parameters
        ----------
        scene : str
        view : View
            With a reference.
        contrast : (H, W) array
            As the function `contrast` returns it.
        radiance, error_k : (H, W) arrays
            Band radiance of a method [W m⁻² sr⁻¹], and its error [K].
        emissivity : (M,) array
            True emissivities of the view's materials, as `band_emissivities` returns them.
        """
        assert view.truth_radiance is not None
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

    def _others(self, name: str) -> float | None:
        """Return the median absolute mean error of the other materials in the scenes with this one [K], or None."""
        together: dict[str, NDArray[np.float64]] = {}
        for own in self.scenes.values():
            entries: Iterable[tuple[str, NDArray[np.float64]]] = own.items() if name in own else ()
            for other, row in entries:
                together[other] = together.get(other, 0.0) + row
        together.pop(name, None)
        return float(np.median([abs(error / count) for count, error in together.values()])) if together else None

    def summary(self) -> dict[str, dict[str, float | None]]:
        """Return {material: {share, error_k, others_k, change, explained}} of materials with a large error.

        `others_k` is the median absolute mean error of the other materials in the same scenes, None without others.
        `change` is Δε. It is None where it does not explain the error or the emissivity would leave 0…1: then the error
        has another cause, such as the temperature.
        """
        total = sum(row[0] for row in self.rows.values())
        reported: dict[str, dict[str, float | None]] = {}
        for name, (count, xoff, xx, offoff, kelvin, emissivity) in self.rows.items():
            if not xx > 0.0 or not offoff > 0.0:
                continue
            change, explained = xoff / xx, xoff * xoff / (xx * offoff)
            error = kelvin / count
            if count >= LEAST_SHARE * total and abs(error) >= LEAST_K:
                possible = -_BEYOND <= emissivity / count + change <= 1.0 + _BEYOND
                reported[name] = {"share": count / total, "error_k": error, "others_k": self._others(name),
                                  "change": change if possible and explained >= LEAST_EXPLAINED else None,
                                  "explained": explained}  # fmt: skip
        return reported
