"""Statistics of the training part: its mean, the mean of each material, and the bounds of its values."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.training.bounds import Histogram, bounds_of
from thermorender.apps.training.dataset import Dataset, ThermalScale
from thermorender.apps.training.map_inputs import NO_MATERIAL, ground_of
from thermorender.frame import apparent_temperature
from thermorender.units import ZERO_CELSIUS_K


class Levels:
    """Look-up tables of radiance and apparent temperature for the integer values of thermal pictures.

    Parameters
    ----------
    scale : ThermalScale
    """

    def __init__(self, scale: ThermalScale) -> None:
        self.scale = scale
        self._tables: dict[Any, tuple[NDArray[np.float64], NDArray[np.float32]]] = {}

    def _table(self, values: NDArray[np.integer]) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
        kind = values.dtype
        if kind not in self._tables:
            radiance = self.scale.radiance(np.arange(np.iinfo(kind).max + 1))
            self._tables[kind] = radiance, apparent_temperature(radiance, self.scale.band_um)
        return self._tables[kind]

    def radiance(self, values: NDArray[np.integer]) -> NDArray[np.float64]:
        """Return band radiance [W m⁻² sr⁻¹], float64."""
        return self._table(values)[0][values]

    def temperature(self, values: NDArray[np.integer]) -> NDArray[np.float32]:
        """Return apparent temperature [K], float32."""
        return self._table(values)[1][values]


@dataclass(frozen=True)
class TrainingPart:
    """Statistics of the training part."""

    pairs: int  # Number of pairs read
    mean_k: float | None  # Apparent temperature of the mean radiance [K]; None without pairs
    material_k: dict[str, float]  # The same for each material that occurs [K]
    # (2,) tuple bounds of the 8-bit scale [K]: 1.5 interquartile ranges beyond the quartiles of all values; for
    # pictures of unknown scale, the assumed temperatures
    bounds_k: tuple[float, float] | None


def read_training_part(
    dataset: Dataset, levels: Levels, progress: Callable[[float], object] = lambda share: None
) -> TrainingPart:
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
    bounds: tuple[float, float] | None = None
    if dataset.scale.unit == "intensity" and dataset.scale.range_c is not None:
        cold_c, warm_c = dataset.scale.range_c
        bounds = ZERO_CELSIUS_K + cold_c, ZERO_CELSIUS_K + warm_c
    counts = histogram.counts
    if not counts.any():
        return TrainingPart(len(dataset), None, {}, bounds)
    band, value = dataset.scale.band_um, np.arange(len(counts), dtype=np.uint16)
    mean = (levels.radiance(value) * counts).sum() / counts.sum()
    if bounds is None:
        limits = bounds_of(histogram)
        low, high = map(float, apparent_temperature(dataset.scale.radiance([limits.low, limits.high]), band))
        bounds = low, high
    seen = [number for number in range(min(len(materials), NO_MATERIAL)) if amount[number]]
    means = apparent_temperature(np.array([total[number] / amount[number] for number in seen]), band)
    material_k = {materials[number]: float(kelvin) for number, kelvin in zip(seen, means, strict=True)}
    return TrainingPart(len(dataset), float(apparent_temperature(mean, band)), material_k, bounds)
