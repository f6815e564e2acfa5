"""Kinetic temperature of each texel from a learned map's apparent radiance, flagged where that is ill-posed."""

from collections.abc import Mapping, Sequence
from functools import lru_cache

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.learned.temperature_map import Inputs, TemperatureMap
from thermorender.materials.extended import missing, within_band
from thermorender.materials.library import load_library
from thermorender.materials.material import Material
from thermorender.materials.mixture import Mixture, mix
from thermorender.physics.band import kinetic_temperature

# Below this band emissivity, an error of 1 K in apparent temperature becomes more than 2 K in kinetic temperature, and
# an error in the assumed sky counts as much as the surface.
LOWEST_EMISSIVITY = 0.5
# Kinetic temperatures are trusted up to twice the width of the trained range beyond its ends.
BELIEVED_MARGIN = 2.0
_REFERENCE_K = 300.0


class InBand:
    """A scene's materials by number, extended to a map's band as to a camera's, from the shipped library.

    `where` is the scene, for the error of a material whose table lacks too much of the band.
    """

    def __init__(self, model: TemperatureMap, materials: Sequence[Material], where: str = "") -> None:
        self._model, self._materials, self._where = model, materials, where

    def __getitem__(self, number: int) -> Material:
        """Return a material; it is extended only if a texel has it."""
        own, band_um = self._materials[number], self._model.band_um
        try:
            found = _extended(own, band_um)
            # It raises at gaps too.
            found.band_emissivity(*band_um, _REFERENCE_K)
        except ThermorenderError:
            (first, last), gaps = own.valid_range_um, " with gaps" if own.gaps_um else ""
            raise ThermorenderError(
                f"{f'{self._where}: ' if self._where else ''}learned map {self._model.name!r} sees "
                f"{band_um[0]:g}–{band_um[1]:g} µm, and material {own.name!r} covers {first:g}–{last:g} µm{gaps}; "
                "choose a material whose table covers the map's band too, or another source of temperatures"
            ) from None
        return found


def _extended(own: Material, band_um: tuple[float, float]) -> Material:
    if not missing(own, band_um):
        return own
    if isinstance(own, Mixture):
        parts, possible = (
            [(_extended(each, band_um), share) for each, share in pairs] for pairs in (own.parts, own.possible)
        )
        return mix(parts, possible)
    return within_band(own, band_um, _library(), own.name)


@lru_cache(maxsize=1)
def _library() -> Mapping[str, Material]:
    return load_library()


def kinetic_from_map(
    model: TemperatureMap, inputs: Inputs, material: np.ndarray, materials: "Sequence[Material] | InBand",
    sky_temperature: float | None = None, stand_in: float | None = None,
) -> tuple[np.ndarray, np.ndarray, float]:  # fmt: skip
    """Return (temperature (h, w) float64 [K], trusted (h, w) bool, share of intensities outside 0…1).

    `material` (h, w) uint8 indexes `materials`, which are taken in the map's band. The map gives *apparent* temperature
    under its training sky, or under `sky_temperature` [K], in its own band, if it takes hour and weather as input; the
    reflection of that sky is removed per material, and no surface is colder than it. Where emissivity is low, or the
    temperature does not exist or is far outside the trained range, `trusted` is False and the temperature `stand_in`
    [K], by default the material's own.
    """
    in_band = materials if isinstance(materials, InBand) else InBand(model, materials)
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
        own = in_band[index]
        other = own.temperature if stand_in is None else stand_in
        temperature[here] = other
        if own.band_emissivity(*model.band_um, middle) >= LOWEST_EMISSIVITY:
            kinetic = kinetic_temperature(apparent[here], own.emissivity_at, sky, model.band_um, believed)
            trusted[here] = np.isfinite(kinetic)
            temperature[here] = np.where(np.isfinite(kinetic), np.maximum(kinetic, sky), other)
    outside = float(np.mean((intensity < 0.0) | (intensity > 1.0)))
    return temperature, trusted, outside
