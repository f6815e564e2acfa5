"""Mixed materials: texels that may be, or are, of several materials share a limited palette of mixes.

The emissivity of a mix is the mean of its parts' by area: what a camera sees that cannot tell them apart, and what
is to be expected where it is uncertain which of them is there.
"""

from dataclasses import dataclass

import numpy as np

from thermorender.materials.library import Material

# Shares are kept in eighths.
_STEPS = 8
_BAND_SAMPLES = 48


@dataclass(frozen=True, eq=False, repr=False)
class Mixture(Material):
    """A Material made of others.

    Attributes
    ----------
    parts : tuple of (Material, share)
        Shares add up to one.
    """

    parts: tuple = ()


def mix(parts):
    """Return the Mixture of (Material, share) pairs whose shares add up to one; of a single part, that Material.

    It is known where all parts are: their common wavelengths, less every hole of theirs.
    """
    if len(parts) == 1:
        return parts[0][0]
    materials = [material for material, _ in parts]
    share = np.array([part for _, part in parts])
    start = max(material.valid_range_um[0] for material in materials)
    end = min(material.valid_range_um[1] for material in materials)
    wavelength = np.unique(np.concatenate([material.wavelength_um for material in materials] + [[start, end]]))
    wavelength = wavelength[(wavelength >= start) & (wavelength <= end)]
    # Between the ends of a hole the value is never asked for.
    emissivity = share @ [np.interp(wavelength, material.wavelength_um, material.emissivity) for material in materials]
    names = " + ".join(f"{part:.3g} {material.name}" for material, part in parts)

    def every(key):
        return "; ".join(dict.fromkeys(getattr(material, key) for material in materials))

    return Mixture(
        name=names,
        title=f"mix of {names}",
        wavelength_um=wavelength,
        emissivity=emissivity,
        emissivity_std=np.full(wavelength.size, np.nan),
        colour=tuple(int(round(c)) for c in share @ [material.colour for material in materials]),
        solar_absorptance=float(share @ [material.solar_absorptance for material in materials]),
        temperature=float(share @ [material.temperature for material in materials]),
        source=every("source"),
        citation=every("citation"),
        licence=every("licence"),
        gaps_um=tuple(gap for material in materials for gap in material.gaps_um),
        parts=tuple(parts),
    )


def palette(index, share, materials, band_um, most):
    """Return (number (h, w) uint8, materials and mixes, error) for texels given as shares of several materials.

    Parameters
    ----------
    index : (h, w, 3) uint8
        Numbers in `materials`.
    share : (h, w, 3) float
        Of each, largest first; adding up to one.
    materials : sequence of Material
    band_um : (2,) floats
        Band over which mixes are compared [µm].
    most : int
        Largest size of the palette, up to 256.

    Returns
    -------
    number : index into the returned materials.
    error : dict
        "mean" and "largest" change of a texel's emissivity, averaged over the band, that rounding its shares and the
        limited palette bring.
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
    # The same mix may come in several orders.
    shares, same = np.unique(shares, axis=0, return_inverse=True)
    same = same.ravel()
    count = np.bincount(same, count, len(shares))
    wavelength = np.linspace(*band_um, _BAND_SAMPLES)
    spectra = np.array([material.emissivity_at(wavelength) for material in materials])
    mixed = shares @ spectra
    chosen = _chosen(mixed, count, most)
    # A rare mix becomes the one of the palette whose spectrum is nearest.
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
    """Numbers of the spectra for a palette: half the most frequent, half those farthest from all chosen before."""
    if len(spectra) <= most:
        return np.arange(len(spectra))
    chosen = list(np.argsort(-count, kind="stable")[: most - most // 2])
    away = np.min([((spectra - spectra[k]) ** 2).sum(axis=-1) for k in chosen], axis=0)
    while len(chosen) < most:
        chosen.append(int(away.argmax()))
        away = np.minimum(away, ((spectra - spectra[chosen[-1]]) ** 2).sum(axis=-1))
    return np.sort(chosen)
