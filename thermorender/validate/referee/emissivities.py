"""What emissivity an error looks like: the change of each material's that would explain it best.

A surface at temperature T under light E sends ε B(T) + (1 − ε) E/π. An emissivity wrong by Δε changes that by
Δε (B(T) − E/π): large under a cold sky, nothing in an enclosure of its own temperature. The Δε of a material is that of
least squares over its pixels; E is taken for that of the sky alone, and the air for clear.
"""

from dataclasses import dataclass, field

import numpy as np

from thermorender.physics.band import RadianceTable
from thermorender.physics.planck import band_radiance

# Told where a material covers this share of the ground, errs by as much [K], and its Δε takes away this share of the
# mean square error.
LEAST_SHARE, LEAST_K, LEAST_EXPLAINED = 0.005, 0.3, 0.5


def contrast(view, sky_k, band_um):
    """Return B(T) − E/π of a View's pixels, (H, W) float64 [W m⁻² sr⁻¹], by table; 0 where nothing is known."""
    kinetic = np.where(view.known, view.kinetic, np.float32(sky_k)).astype(np.float64)
    grid = RadianceTable.grid(kinetic.min(), kinetic.max())
    return RadianceTable(grid, band_radiance(grid, *band_um))(kinetic) - band_radiance(sky_k, *band_um)


@dataclass
class Emissivities:
    """Sums over pixels, per material: n, Σxδ, Σx², Σδ², Σ error in kelvin; x is B(T) − E/π, δ an error of radiance.

    Attributes
    ----------
    rows : dict of str to (5,) array
    """

    rows: dict = field(default_factory=dict)

    def add(self, view, contrast, radiance, error_k):
        """Add a View's ground.

        Parameters
        ----------
        view : View
        contrast : (H, W) array
            As by `contrast`.
        radiance, error_k : (H, W) arrays
            What a method sends [W m⁻² sr⁻¹], and how it errs [K].
        """
        here = view.known & (view.object < 0) & np.isfinite(error_k)
        material, x = view.material[here], contrast[here]
        off = radiance[here].astype(np.float64) - view.truth_radiance[here]
        columns = [np.bincount(material, weights, 256) for weights in (None, x * off, x * x, off * off, error_k[here])]
        for number in np.flatnonzero(columns[0]):
            name = view.material_names[number]
            row = np.array([column[number] for column in columns])
            self.rows[name] = self.rows.get(name, 0.0) + row

    def summary(self):
        """Return {material: {share, error_k, change, explained}} of those that an emissivity may explain."""
        total = sum(row[0] for row in self.rows.values())
        told = {}
        for name, (count, xoff, xx, offoff, kelvin) in self.rows.items():
            if not xx > 0.0 or not offoff > 0.0:
                continue
            change, explained = xoff / xx, xoff * xoff / (xx * offoff)
            error = kelvin / count
            if count >= LEAST_SHARE * total and abs(error) >= LEAST_K and explained >= LEAST_EXPLAINED:
                told[name] = {"share": count / total, "error_k": error, "change": change, "explained": explained}
        return told
