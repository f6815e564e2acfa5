"""Materials whose table covers most of a camera's band: the rest is assumed from materials with similar spectra.

The 53 complete Lambertian materials of the shipped library, each cut at 8 µm in turn, are predicted over 7.5–13.5 µm
with an error of the band emissivity of 0.0010 RMS and 0.0035 at most: 38 and 137 mK at 300 K under a sky of 250 K.
Nothing is assumed below 7 µm. There the sun outshines the thermal radiance that weighs these errors: tables cut at 4 µm
err over 3.7–4.8 µm by 0.0015 RMS in a surface's own light, but by 0.0050 RMS and 0.017 at most in reflected sunlight.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError
from thermorender.materials.material import ROUNDING_UM, Material
from thermorender.physics.planck import band_radiance

# Share of a band's radiance at 300 K that may be assumed.
MOST_ASSUMED = 0.2
# Shortest wavelength that may be assumed [µm].
SHORTEST_ASSUMED_UM = 7.0
# Materials that are compared, and the standard deviation of their agreement [1] beyond their own scatter.
_SIMILAR, _FLOOR = 12, 0.02
# Step of the comparison and of the rows added [µm].
_STEP_UM = 0.05
_REFERENCE_K = 300.0


@dataclass(frozen=True)
class Assumption:
    """Part of a band whose emissivity is assumed."""

    material: str
    limits_um: tuple[float, float]  # (2,) floats the part [µm]
    share: float  # Its share of the band's blackbody radiance at 300 K
    emissivity_std: float  # Standard deviation of the band emissivity that follows [1]


def missing(material: Material, band_um: tuple[float, float]) -> list[tuple[float, float]]:
    """Return the parts of a band [µm] below and above a material's table."""
    first, last = material.valid_range_um
    lower, upper = band_um
    parts = [(lower, min(first, upper))] if lower < first - ROUNDING_UM else []
    return parts + ([(max(last, lower), upper)] if upper > last + ROUNDING_UM else [])


def assumptions(material: Material, band_um: tuple[float, float]) -> list[Assumption]:
    """Return the Assumptions that a material of `within_band` holds within a band."""
    found = []
    for start, end in material.assumed_um:
        limits = max(start, band_um[0]), min(end, band_um[1])
        if limits[0] >= limits[1] - ROUNDING_UM:
            continue
        share = _share(limits, band_um)
        inside = (material.wavelength_um >= limits[0] - ROUNDING_UM) & (
            material.wavelength_um <= limits[1] + ROUNDING_UM
        )
        # The error is the same at all wavelengths of the part, as spectra are smooth.
        std = share * float(np.nanmean(material.emissivity_std[inside]))
        found.append(Assumption(material.name, limits, share, std))
    return found


def within_band(
    material: Material, band_um: tuple[float, float], library: Mapping[str, Material], where: object
) -> Material:
    """Return a material that covers a band [µm]: itself, or with rows assumed where its table ends, from 7 µm on.

    The 12 materials of the library with the smallest difference over the common part are compared. The assumed
    emissivity is the table's last one plus the mean step of those materials; its standard deviation is theirs and 0.02
    in quadrature.
    """
    parts = missing(material, band_um)
    share = sum(_share(part, band_um) for part in parts)
    small = share <= MOST_ASSUMED and all(start >= SHORTEST_ASSUMED_UM - ROUNDING_UM for start, _ in parts)
    if not parts or not small or material.directional != "lambertian" or hasattr(material, "parts"):
        try:
            material.emissivity_at(np.array(band_um))
        except ThermorenderError as error:
            raise ThermorenderError(f"{where}: {error}") from None
        return material
    similar = _similar(material, band_um, library.values())
    if len(similar) < 3:
        raise ThermorenderError(
            f"{where}: material {material.name!r} lacks {share:.0%} of the band {band_um[0]:g}–{band_um[1]:g} µm, and "
            "the library has no materials to assume it from; choose a band inside its range"
        )
    wavelength, emissivity, std = material.wavelength_um, material.emissivity, material.emissivity_std
    for start, end in parts:
        edge = start if start > band_um[0] else end
        rows = np.linspace(start, end, int(np.ceil((end - start) / _STEP_UM)) + 1)
        rows = rows[~np.isclose(rows, edge)]
        steps = np.array([each.emissivity_at(rows) - each.emissivity_at(edge) for each in similar])
        own = np.clip(np.interp(edge, material.wavelength_um, material.emissivity) + steps.mean(axis=0), 0.0, 1.0)
        spread = np.hypot(steps.std(axis=0, ddof=1), _FLOOR)
        wavelength, emissivity, std = (
            np.concatenate((new, old) if edge == end else (old, new))
            for new, old in ((rows, wavelength), (own, emissivity), (spread, std))
        )
    return replace(
        material, wavelength_um=wavelength, emissivity=emissivity, emissivity_std=std, assumed_um=tuple(parts)
    )


def _similar(material: Material, band_um: tuple[float, float], others: Iterable[Material]) -> list[Material]:
    """Lambertian materials measured over the whole band, the most similar ones over the common part first."""
    first, last = material.valid_range_um
    common = np.arange(max(first, band_um[0]), min(last, band_um[1]) + 1e-9, _STEP_UM)
    own = material.emissivity_at(common)
    # A copy of a material under another name counts once.
    found: dict[bytes, tuple[float, str, Material]] = {}
    for other in others:
        complete = not missing(other, band_um) and not other.gaps_um and not other.assumed_um
        if other.name != material.name and other.directional == "lambertian" and complete:
            difference = float(np.sqrt(np.mean((other.emissivity_at(common) - own) ** 2)))
            found.setdefault(other.emissivity.tobytes(), (difference, other.name, other))
    return [other for *_, other in sorted(found.values(), key=lambda one: one[:2])[:_SIMILAR]]


def _share(part: tuple[float, float], band_um: tuple[float, float]) -> float:
    """Share of a band's blackbody radiance at 300 K that a part of it has."""
    radiance: NDArray[np.float64] = np.array([band_radiance(_REFERENCE_K, *limits) for limits in (part, band_um)])
    return float(radiance[0] / radiance[1])
