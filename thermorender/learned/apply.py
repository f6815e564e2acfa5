"""Kinetic temperature of each texel from a learned map's apparent radiance, flagged where that is ill-posed."""

from collections.abc import Sequence

import numpy as np

from thermorender.learned.temperature_map import Inputs, TemperatureMap
from thermorender.materials.material import Material
from thermorender.physics.band import kinetic_temperature

# Below this band emissivity, an error of 1 K in apparent temperature becomes more than 2 K in kinetic temperature, and
# an error in the assumed sky counts as much as the surface.
LOWEST_EMISSIVITY = 0.5
# Kinetic temperatures are trusted up to twice the width of the trained range beyond its ends.
BELIEVED_MARGIN = 2.0


def kinetic_from_map(
    model: TemperatureMap, inputs: Inputs, material: np.ndarray, materials: Sequence[Material],
    sky_temperature: float | None = None, stand_in: float | None = None,
) -> tuple[np.ndarray, np.ndarray, float]:  # fmt: skip
    """Return (temperature (h, w) float64 [K], trusted (h, w) bool, share of intensities outside 0…1).

    `material` (h, w) uint8 indexes `materials`. The map gives *apparent* temperature under its training sky, or under
    `sky_temperature` [K] if it takes hour and weather as input; the reflection of that sky is removed per material.
    Where emissivity is low, or the temperature does not exist or is far outside the trained range, `trusted` is False
    and the temperature `stand_in` [K], by default the material's own.
    """
    sky = model.sky_temperature if sky_temperature is None else sky_temperature
    apparent = model.radiance(inputs)
    intensity = model.intensity(apparent)
    temperature = np.empty(apparent.shape)
    low, high = model.range_k
    margin = BELIEVED_MARGIN * (high - low)
    believed = (max(low - margin, 100.0), high + margin)
    middle = 0.5 * (low + high)
    trusted = np.zeros(apparent.shape, dtype=bool)
    for index in np.unique(material):
        here = material == index
        own = materials[index]
        other = own.temperature if stand_in is None else stand_in
        temperature[here] = other
        if own.band_emissivity(*model.band_um, middle) >= LOWEST_EMISSIVITY:
            kinetic = kinetic_temperature(apparent[here], own.emissivity_at, sky, model.band_um, believed)
            trusted[here] = np.isfinite(kinetic)
            temperature[here] = np.where(np.isfinite(kinetic), kinetic, other)
    outside = float(np.mean((intensity < 0.0) | (intensity > 1.0)))
    return temperature, trusted, outside
