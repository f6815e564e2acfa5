"""Mixed materials: texels of several possible or actual materials share a limited palette of mixtures.

The emissivity of a mixture is the area-weighted mean of its parts. It describes a texel that the camera cannot resolve,
and the expected value of a texel whose material is uncertain. There, the standard deviation over the possible materials
is the uncertainty of the texel, and that over the means of their groups the uncertainty of a mean over many texels.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.materials.material import Material

# Spread of one material's emissivity between places, about that of its samples: 0.006 to 0.016 for most.
MATERIAL_STD = 0.010
# Shares are rounded to eighths.
_STEPS = 8
_BAND_SAMPLES = 48


@dataclass(frozen=True)
class Doubt:
    """What a learned map knows of possible materials besides their probabilities."""

    groups: tuple[str, ...]  # Group of surfaces that each belongs to, such as roofs
    mean_std: tuple[float, ...]  # Uncertainty of the mean emissivity of that group [1]
    # Calibrated factors on the deviations between groups, for a mean, and between materials, for a texel.
    factors: tuple[float, float] = (1.0, 1.0)


@dataclass(frozen=True, eq=False, repr=False)
class Mixture(Material):
    """A Material made of others."""

    # Its main materials, whose temperatures it combines. The shares sum to one.
    parts: tuple[tuple[Material, float], ...] = ()
    # The materials whose mean its emissivity is, where these are more than its parts. The probabilities sum to one.
    possible: tuple[tuple[Material, float], ...] = ()
    # About the possible materials, where a map knows more of them.
    doubt: Doubt | None = None

    def band_emissivity_std(self, lower_um: float, upper_um: float, temperature: float) -> float:
        """Return the standard deviation of the band emissivity [1] of one texel, NaN without possible materials.

        It is smaller than the band mean of the spectrum's standard deviation, because spectra cross within the band.
        """
        if not self.possible:
            return super().band_emissivity_std(lower_um, upper_um, temperature)
        share, value, own = self._possible_in(lower_um, upper_um, temperature)
        variance = share @ ((value - share @ value) ** 2 + np.square(own))
        if self.doubt is None:
            return float(np.sqrt(variance))
        alone = float(np.hypot(self.doubt.factors[1] * np.sqrt(variance), share @ self.doubt.mean_std))
        # A texel varies at least as much as the mean that it is a part of.
        return max(alone, self.band_emissivity_mean_std(lower_um, upper_um, temperature))

    def band_emissivity_mean_std(self, lower_um: float, upper_um: float, temperature: float) -> float:
        """Return the standard deviation [1] of the mean band emissivity of many such texels, NaN where it is unknown.

        Materials of a group differ from texel to texel and average out; which group it is, and the group's mean, do
        not.
        """
        if self.doubt is None:
            return float("nan")
        share, value, _ = self._possible_in(lower_um, upper_um, temperature)
        mean, variance = share @ value, 0.0
        groups = np.array(self.doubt.groups)
        for group in set(self.doubt.groups):
            part = share * (groups == group)
            if part.any():
                variance += part.sum() * (part @ value / part.sum() - mean) ** 2
        return float(np.hypot(self.doubt.factors[0] * np.sqrt(variance), share @ self.doubt.mean_std))

    def _possible_in(self, *band: float) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """(probability, band emissivity, its own standard deviation) of each possible material, (K,)."""
        share = np.array([part for _, part in self.possible])
        value, own = np.array([_band_values(material, band) for material, _ in self.possible]).T
        return share, value, own


def uncertainties(material: Material, *band: float) -> tuple[float, float]:
    """Return the standard deviations [1] of a material's band emissivity, of one texel and of a mean over many.

    `band` is (lower [µm], upper [µm], temperature [K]). A material that is certain differs between places.
    """
    own = material.band_emissivity_std(*band)
    if isinstance(material, Mixture) and material.doubt is not None:
        return own, material.band_emissivity_mean_std(*band)
    return max(MATERIAL_STD, float(np.nan_to_num(own))), MATERIAL_STD


@lru_cache(maxsize=512)
def _band_values(material: Material, band: tuple[float, ...]) -> tuple[float, float]:
    """(band emissivity, its standard deviation or 0) of a material; each of many mixtures asks for it."""
    return float(material.band_emissivity(*band)), float(np.nan_to_num(material.band_emissivity_std(*band)))


def parts_of(material: Material) -> tuple[tuple[Material, float], ...]:
    """Return the (Material, share) pairs of a Mixture; those of any other material are itself and 1."""
    return material.parts if isinstance(material, Mixture) else ((material, 1.0),)


def spectra_of(material: Material) -> tuple[tuple[Material, float], ...]:
    """Return the (Material, share) pairs whose mean a material's emissivity is."""
    return material.possible or material.parts if isinstance(material, Mixture) else ((material, 1.0),)


def largest_part(name: str) -> str:
    """Return the material with the largest share in the name that `mix` gives; a name of one material is itself."""
    shares = [part.partition(" ") for part in name.split(" + ")]
    try:
        return max(shares, key=lambda part: float(part[0]))[2]
    except ValueError:
        return name


def mix(
    parts: Sequence[tuple[Material, float]], possible: Sequence[tuple[Material, float]] = (), doubt: Doubt | None = None
) -> Material:
    """Return the Mixture of (Material, share) pairs whose shares sum to one; for a single part, that Material.

    `possible` are (Material, probability) pairs where the material is uncertain. The emissivity is then their mean, and
    its standard deviation is theirs and the materials' own in quadrature. The mixture is known at the wavelengths of
    all its materials, without the gaps of any. `doubt` is on each of the possible materials.
    """
    if len(parts) == 1 and len(possible) < 2:
        return parts[0][0]
    materials = [material for material, _ in parts]
    share = np.array([part for _, part in parts])
    wavelength, emissivity, std = _mean_spectrum(possible or parts, bool(possible))
    names = " + ".join(f"{part:.3g} {material.name}" for material, part in parts)

    def every(key: str) -> str:
        return "; ".join(dict.fromkeys(getattr(material, key) for material in materials))

    red, green, blue = (round(c) for c in share @ [material.colour for material in materials])
    return Mixture(
        name=names, title=f"mix of {names}", wavelength_um=wavelength, emissivity=emissivity,
        emissivity_std=std, colour=(red, green, blue),
        solar_absorptance=float(share @ [material.solar_absorptance for material in materials]),
        temperature=float(share @ [material.temperature for material in materials]), source=every("source"),
        citation=every("citation"), licence=every("licence"),
        gaps_um=tuple(gap for material, _ in possible or parts for gap in material.gaps_um), parts=tuple(parts),
        possible=tuple(possible), doubt=doubt,
    )  # fmt: skip


def _mean_spectrum(
    weighted: Sequence[tuple[Material, float]], uncertain: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """(Wavelengths (N,) [µm], mean emissivity, its deviation, NaN unless `uncertain`) of (Material, share) pairs."""
    materials = [material for material, _ in weighted]
    share = np.array([part for _, part in weighted])
    start = max(material.valid_range_um[0] for material in materials)
    end = min(material.valid_range_um[1] for material in materials)
    wavelength = np.unique(np.concatenate([*(material.wavelength_um for material in materials), [start, end]]))
    wavelength = wavelength[(wavelength >= start) & (wavelength <= end)]
    # Values inside gaps are never used.
    spectra = np.array([np.interp(wavelength, material.wavelength_um, material.emissivity) for material in materials])
    emissivity = share @ spectra
    if not uncertain:
        return wavelength, emissivity, np.full(wavelength.size, np.nan)
    own = [np.interp(wavelength, material.wavelength_um, np.nan_to_num(material.emissivity_std))
           for material in materials]  # fmt: skip
    return wavelength, emissivity, np.sqrt(share @ ((spectra - emissivity) ** 2 + np.square(own)))


def palette(
    index: NDArray[np.uint8], share: NDArray[Any], probability: NDArray[np.uint8], materials: Sequence[Material],
    band_um: tuple[float, float], most: int, group: NDArray[np.uint8] | None = None, doubt: Doubt | None = None,
) -> tuple[NDArray[np.uint8], list[Material], dict[str, float]]:  # fmt: skip
    """Return (number (h, w) uint8, materials and mixtures, error) for texels of several materials.

    `index` (h, w, 3) are the indices into `materials`, `share` their shares, largest first, which sum to one, and
    `probability` (h, w, C) that of each material, in any unit. `number` is the index into the returned materials, at
    most `most` ≤ 256, which are compared over `band_um`. Texels of different `group` (h, w), fewer than `most`, share
    no entry: other materials may be excluded there. `doubt` is on each of the materials. `error` has the "mean" and
    "largest" change of a texel's band-averaged emissivity by rounded shares and the limited palette.
    """
    # One number per texel: three materials in a byte each, and the second and third share.
    code = np.rint(share[..., 2] * _STEPS).astype(np.uint32) * (_STEPS + 1)
    code += np.rint(share[..., 1] * _STEPS).astype(np.uint32)
    for rank in (2, 1, 0):
        code = code * 256 + index[..., rank]
    if group is not None:
        code = code + (group.astype(np.uint64) << np.uint64(32))
    codes, count = np.unique(code, return_counts=True)
    shares = np.zeros((codes.size, len(materials)))
    row = np.arange(codes.size)
    steps = (codes & 0xFFFFFFFF) >> 24
    two, three = steps % (_STEPS + 1), steps // (_STEPS + 1)
    for number, part in ((codes & 255, _STEPS - two - three), (codes >> 8 & 255, two), (codes >> 16 & 255, three)):
        np.add.at(shares, (row, number), part / _STEPS)
    # The same mixture may occur in several orders.
    keyed = np.column_stack([codes.astype(np.uint64) >> np.uint64(32), shares])
    keyed, same = np.unique(keyed, axis=0, return_inverse=True)
    same, of, shares = same.ravel(), keyed[:, 0], keyed[:, 1:]
    count = np.bincount(same, count, len(shares))
    own = same[np.searchsorted(codes, code)]
    possible = _means(own, probability, len(shares))
    wavelength = np.linspace(*band_um, _BAND_SAMPLES)
    spectra = np.array([material.emissivity_at(wavelength) for material in materials])
    mixed = possible @ spectra
    chosen = _chosen(mixed, count, most, of)
    # A rare mixture becomes the palette entry with the nearest spectrum.
    nearest = np.empty(len(shares), dtype=np.uint8)
    for start in range(0, len(shares), 512):
        away = ((mixed[start : start + 512, None] - mixed[chosen]) ** 2).sum(axis=-1)
        away[of[start : start + 512, None] != of[chosen]] = np.inf
        nearest[start : start + 512] = away.argmin(axis=1)
    number = nearest[own]
    change = np.abs(_band_means(probability, spectra.mean(axis=-1)) - mixed.mean(axis=-1)[chosen][number])
    made = [
        mix([(materials[k], float(shares[which, k])) for k in np.argsort(-shares[which], kind="stable")[:3]
             if shares[which, k] > 0.0],
            [(materials[k], float(possible[which, k])) for k in np.flatnonzero(possible[which]).tolist()],
            doubt and _of(doubt, np.flatnonzero(possible[which])))
        for which in chosen
    ]  # fmt: skip
    return number, made, {"mean": float(change.mean()), "largest": float(change.max())}


def _of(doubt: Doubt, numbers: NDArray[np.intp]) -> Doubt:
    """The part of a Doubt on materials by number."""
    return Doubt(tuple(doubt.groups[k] for k in numbers), tuple(doubt.mean_std[k] for k in numbers), doubt.factors)


def _means(group: NDArray[np.integer], probability: NDArray[np.uint8], count: int) -> NDArray[np.float64]:
    """Return the mean probabilities of each of `count` groups of texels, (count, C), with a sum of one."""
    flat = group.ravel()
    sums = [np.bincount(flat, plane.ravel(), count) for plane in np.moveaxis(probability, -1, 0)]
    return np.stack(sums, axis=1) / np.sum(sums, axis=0)[:, None]


def _band_means(probability: NDArray[np.uint8], emissivity: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean over materials of their band emissivity, (h, w), with the probabilities of each texel."""
    planes = np.moveaxis(probability, -1, 0)
    total = sum((plane.astype(np.float32) for plane in planes), np.float32(0.0))
    weighted = sum(plane * np.float32(value) for plane, value in zip(planes, emissivity, strict=True))
    return np.asarray(weighted / total)


def _chosen(spectra: NDArray[np.float64], count: NDArray[Any], most: int, of: NDArray[Any]) -> NDArray[np.intp]:
    """Indices of the spectra for a palette: half the most frequent, half those farthest from all chosen before.

    Each group, by its number `of` (N,), has its most frequent spectrum.
    """
    if len(spectra) <= most:
        return np.arange(len(spectra))
    order = np.argsort(-count, kind="stable")
    first = order[np.unique(of[order], return_index=True)[1]]
    frequent = order[: most - most // 2]
    chosen = [*frequent, *first[~np.isin(first, frequent)]]
    away = np.min([((spectra - spectra[k]) ** 2).sum(axis=-1) for k in chosen], axis=0)
    while len(chosen) < most:
        chosen.append(int(away.argmax()))
        away = np.minimum(away, ((spectra - spectra[chosen[-1]]) ** 2).sum(axis=-1))
    return np.sort(chosen)
