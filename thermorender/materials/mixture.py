"""Mixed materials: texels of several possible or actual materials share a limited palette of mixtures.

The emissivity of a mixture is the area-weighted mean of its parts. It describes a texel that the camera cannot resolve,
and the expected value of a texel whose material is uncertain.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermorender.materials.material import Material

# Shares are rounded to eighths.
_STEPS = 8
_BAND_SAMPLES = 48


@dataclass(frozen=True, eq=False, repr=False)
class Mixture(Material):
    """A Material made of others.

    Attributes
    ----------
    parts : tuple of (Material, share)
        The shares sum to one.
    """

    parts: tuple[tuple[Material, float], ...] = ()


def parts_of(material: Material) -> tuple[tuple[Material, float], ...]:
    """Return the (Material, share) pairs of a Mixture; those of any other material are itself and 1."""
    return material.parts if isinstance(material, Mixture) else ((material, 1.0),)


def mix(parts: Sequence[tuple[Material, float]]) -> Material:
    """Return the Mixture of (Material, share) pairs whose shares sum to one; for a single part, that Material.

    It is known at the wavelengths of all parts, without the gaps of any.
    """
    if len(parts) == 1:
        return parts[0][0]
    materials = [material for material, _ in parts]
    share = np.array([part for _, part in parts])
    start = max(material.valid_range_um[0] for material in materials)
    end = min(material.valid_range_um[1] for material in materials)
    wavelength = np.unique(np.concatenate([material.wavelength_um for material in materials] + [[start, end]]))
    wavelength = wavelength[(wavelength >= start) & (wavelength <= end)]
    # Values inside gaps are never used.
    emissivity = share @ [np.interp(wavelength, material.wavelength_um, material.emissivity) for material in materials]
    names = " + ".join(f"{part:.3g} {material.name}" for material, part in parts)

    def every(key):
        return "; ".join(dict.fromkeys(getattr(material, key) for material in materials))

    return Mixture(
        name=names, title=f"mix of {names}", wavelength_um=wavelength, emissivity=emissivity,
        emissivity_std=np.full(wavelength.size, np.nan),
        colour=tuple(round(c) for c in share @ [material.colour for material in materials]),
        solar_absorptance=float(share @ [material.solar_absorptance for material in materials]),
        temperature=float(share @ [material.temperature for material in materials]), source=every("source"),
        citation=every("citation"), licence=every("licence"),
        gaps_um=tuple(gap for material in materials for gap in material.gaps_um), parts=tuple(parts),
    )  # fmt: skip


def palette(
    index: NDArray[np.uint8], share: NDArray, materials: Sequence[Material], band_um: tuple[float, float], most: int
) -> tuple[NDArray[np.uint8], list[Material], dict[str, float]]:
    """Return (number (h, w) uint8, materials and mixtures, error) for texels given as shares of several materials.

    Parameters
    ----------
    index : (h, w, 3) uint8
        Indices into `materials`.
    share : (h, w, 3) float
        Share of each, largest first; they sum to one.
    materials : sequence of Material
    band_um : (2,) floats
        Band in which mixtures are compared [µm].
    most : int
        Largest size of the palette, up to 256.

    Returns
    -------
    number : index into the returned materials.
    error : dict
        "mean" and "largest" change of a texel's band-averaged emissivity by rounded shares and the limited palette.
    """
    # One number per texel: three materials in a byte each, and the second and third share.
    code = np.rint(share[..., 2] * _STEPS).astype(np.uint32) * (_STEPS + 1)
    code += np.rint(share[..., 1] * _STEPS).astype(np.uint32)
    for rank in (2, 1, 0):
        code = code * 256 + index[..., rank]
    codes, count = np.unique(code, return_counts=True)
    shares = np.zeros((codes.size, len(materials)))
    row = np.arange(codes.size)
    steps = codes >> 24
    two, three = steps % (_STEPS + 1), steps // (_STEPS + 1)
    for number, part in ((codes & 255, _STEPS - two - three), (codes >> 8 & 255, two), (codes >> 16 & 255, three)):
        np.add.at(shares, (row, number), part / _STEPS)
    # The same mixture may occur in several orders.
    shares, same = np.unique(shares, axis=0, return_inverse=True)
    same = same.ravel()
    count = np.bincount(same, count, len(shares))
    wavelength = np.linspace(*band_um, _BAND_SAMPLES)
    spectra = np.array([material.emissivity_at(wavelength) for material in materials])
    mixed = shares @ spectra
    chosen = _chosen(mixed, count, most)
    # A rare mixture becomes the palette entry with the nearest spectrum.
    nearest = np.empty(len(shares), dtype=np.uint8)
    for start in range(0, len(shares), 512):
        away = ((mixed[start : start + 512, None] - mixed[chosen]) ** 2).sum(axis=-1)
        nearest[start : start + 512] = away.argmin(axis=1)
    number = nearest[same[np.searchsorted(codes, code)]]
    mean = spectra.mean(axis=-1)
    change = np.abs((share * mean[index]).sum(axis=-1) - mixed.mean(axis=-1)[chosen][number])
    made = [
        mix([(materials[k], float(shares[which, k])) for k in np.argsort(-shares[which], kind="stable")[:3]
             if shares[which, k] > 0.0])
        for which in chosen
    ]  # fmt: skip
    return number, made, {"mean": float(change.mean()), "largest": float(change.max())}


def _chosen(spectra, count, most):
    """Indices of the spectra for a palette: half the most frequent, half those farthest from all chosen before."""
    if len(spectra) <= most:
        return np.arange(len(spectra))
    chosen = list(np.argsort(-count, kind="stable")[: most - most // 2])
    away = np.min([((spectra - spectra[k]) ** 2).sum(axis=-1) for k in chosen], axis=0)
    while len(chosen) < most:
        chosen.append(int(away.argmax()))
        away = np.minimum(away, ((spectra - spectra[chosen[-1]]) ** 2).sum(axis=-1))
    return np.sort(chosen)
