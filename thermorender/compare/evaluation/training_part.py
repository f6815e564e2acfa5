"""What the training part tells without any method: its mean, that of each material, and the bounds of its values."""

from dataclasses import dataclass

import numpy as np

from thermorender.campaign.bounds import Histogram, bounds_of
from thermorender.campaign.map_inputs import NO_MATERIAL, ground_of
from thermorender.frame import apparent_temperature
from thermorender.units import ZERO_CELSIUS_K


class Levels:
    """Radiance and apparent temperature of the values of thermal pictures, looked up: they are whole numbers.

    Parameters
    ----------
    scale : ThermalScale
    """

    def __init__(self, scale):
        self.scale, self._tables = scale, {}

    def _table(self, values):
        kind = values.dtype
        if kind not in self._tables:
            radiance = self.scale.radiance(np.arange(np.iinfo(kind).max + 1))
            self._tables[kind] = radiance, apparent_temperature(radiance, self.scale.band_um)
        return self._tables[kind]

    def radiance(self, values):
        """Return band radiance [W m⁻² sr⁻¹], float64."""
        return self._table(values)[0][values]

    def temperature(self, values):
        """Return apparent temperature [K], float32."""
        return self._table(values)[1][values]


@dataclass(frozen=True)
class TrainingPart:
    """What is known of the training part.

    Attributes
    ----------
    pairs : int
        How many were read.
    mean_k : float or None
        Apparent temperature of the mean radiance [K]; None where there is no pair.
    material_k : dict of str to float
        The same per material [K]; those that occur.
    bounds_k : (2,) tuple of float or None
        Of the 8-bit scale [K]: 1.5 interquartile ranges beyond the quartiles of all values; for pictures of unknown
        scale the temperatures that these are taken for.
    """

    pairs: int
    mean_k: float | None
    material_k: dict
    bounds_k: tuple | None


def read_training_part(dataset, levels, progress=lambda share: None):
    """Return the TrainingPart of a Dataset, read pair by pair."""
    materials = dataset.card.get("materials", [])
    histogram = Histogram()
    total, amount = np.zeros(256), np.zeros(256)
    for number, entry in enumerate(dataset.entries):
        progress(number / len(dataset))
        pair = dataset.pair(entry, truth=bool(materials))
        known = ground_of(pair)
        values = pair.thermal[known]
        histogram.add(values)
        if "material" in pair.truth:
            where = pair.truth["material"][known]
            total += np.bincount(where, levels.radiance(values), 256)
            amount += np.bincount(where, minlength=256)
    bounds = None
    if dataset.scale.unit == "intensity":
        bounds = tuple(ZERO_CELSIUS_K + limit for limit in dataset.scale.range_c)
    counts = histogram.counts
    if not counts.any():
        return TrainingPart(len(dataset), None, {}, bounds)
    band, value = dataset.scale.band_um, np.arange(len(counts), dtype=np.uint16)
    mean = (levels.radiance(value) * counts).sum() / counts.sum()
    if bounds is None:
        found = bounds_of(histogram)
        bounds = tuple(map(float, apparent_temperature(dataset.scale.radiance([found.low, found.high]), band)))
    seen = [number for number in range(min(len(materials), NO_MATERIAL)) if amount[number]]
    warm = apparent_temperature(np.array([total[number] / amount[number] for number in seen]), band)
    own = {materials[number]: float(kelvin) for number, kelvin in zip(seen, warm, strict=True)}
    return TrainingPart(len(dataset), float(apparent_temperature(mean, band)), own, bounds)

