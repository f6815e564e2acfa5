"""From a learned map's apparent radiance to each texel's kinetic temperature, flagged where that is ill-posed."""

import numpy as np

from thermorender.physics.surface import kinetic_temperature

# Below this band emissivity an apparent temperature says little about the kinetic one: an error of 1 K in the
# apparent becomes more than 2 K, and an error in the assumed sky counts for as much as the surface.
LOWEST_EMISSIVITY = 0.5
# Kinetic temperatures are believed up to twice the width of the trained range beyond its ends.
BELIEVED_MARGIN = 2.0


def kinetic_from_map(model, inputs, material, materials, sky_temperature=None, stand_in=None):
    """Return (temperature (h, w) float64 [K], trusted (h, w) bool, share of intensities outside 0…1).

    The map gives *apparent* temperature under the sky it was trained under; the reflection of that sky is taken
    out per material. Where the map cannot be trusted (low emissivity, no temperature, or one far outside the
    trained range) another temperature stands in and `trusted` is False.

    Parameters
    ----------
    model : TemperatureMap
    inputs : Inputs
    material : (h, w) uint8
        Index into `materials`.
    materials : sequence of Material
    sky_temperature : float, optional
        Of the sky of this hour, for a map that takes hour and weather as input, in place of the map's own [K].
    stand_in : float, optional
        Temperature where the map cannot be trusted [K]; the material's own by default.
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
            kinetic = kinetic_temperature(
                apparent[here], own.emissivity_at, sky, model.band_um, believed
            )
            trusted[here] = np.isfinite(kinetic)
            temperature[here] = np.where(np.isfinite(kinetic), kinetic, other)
    outside = float(np.mean((intensity < 0.0) | (intensity > 1.0)))
    return temperature, trusted, outside
