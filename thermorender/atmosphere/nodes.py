"""Spectral nodes of a column of air: neighbouring g points of a band merged, with an absorption of their own by level.

A camera's band cuts RRTMGP's bands. `GPoints.spectrum` says which share of a g point's light lies inside, and where. A
group of g points absorbs at each level as its points do on the path where its mean optical depth is that of the group:
the mean of their absorption with weights exp(−τ). `tools/rrtmgp` chooses groups and depths.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.atmosphere.air_column import WATER, AirColumn
from thermorender.atmosphere.checks import not_covered
from thermorender.atmosphere.gpoints import BIN_CM1, GPoints
from thermorender.physics.planck import C2

Floats = NDArray[np.float64]

# Temperature of the nodes' weights and of the g points' spectra [K].
REFERENCE_K = 285.0
# Most nodes of a camera's band, if a grouping has so few there; all bands have 26.
MOST_NODES = 20
# Share of a g point's light that is spread evenly over its band, so that no part of a band is without light.
_EVEN = 1e-4
# Temperatures between which shares of several powers are fitted [K]: the sun's is below the highest. Beyond, they stay.
_COLDEST_K, _HOTTEST_K, _SHARES = 160.0, 6000.0, 64
# Rounds of the fixed point for a group's absorption, which change it by less than 1 % after the third.
_ROUNDS = 3


class Nodes(NamedTuple):
    """Nodes of a column in a camera's band."""

    lower_um: Floats  # (N,) limits of the node's sub-band
    upper_um: Floats
    weight: Floats  # (N,) share of the sub-band's Planck radiance at 285 K
    tilt: Floats  # (N, P) of `share_change` [µm⁻¹, µm⁻² …]
    absorption: Floats  # (N, L) [m⁻¹]
    spectrum: Floats  # (N, bins) where the node's light lies: shares of bins as `GPoints.spectrum`
    middle: Floats  # (bins,) middles of the bins [cm⁻¹]

    def of_spectrum(self, limits_cm1: Floats, values: Floats) -> Floats:
        """Return the mean (N, L) over each node's light of values (bands, L) between rising limits (bands + 1,)."""
        band = np.clip(np.searchsorted(limits_cm1, self.middle) - 1, 0, len(values) - 1)
        share = self.spectrum @ np.equal.outer(band, np.arange(len(values)))
        found: Floats = share @ values
        return found


def nodes_of(tables: GPoints, column: AirColumn, band_um: tuple[float, float] | None = None) -> Nodes:
    """Return the Nodes of a column, over all bands of the tables or those of a camera [µm].

    Raises
    ------
    ThermorenderError
        The tables do not cover the band.
    """
    low, high = tables.wavenumber[0, 0], tables.wavenumber[-1, 1]
    if band_um is not None:
        if not tables.covers(band_um):
            raise not_covered(tables.span_text, band_um)
        low, high = 1e4 / band_um[1], 1e4 / band_um[0]
    inside = inside_of(tables, low, high, float(column.mixing[WATER][0]))
    ground = {gas: mixing[:1] for gas, mixing in column.mixing.items()}
    share = tables.shares(column.pressure_pa[:1], column.temperature[:1], ground)[:, 0]
    light = share * inside.sum(axis=1)
    bands = np.flatnonzero((tables.wavenumber[:, 0] < high) & (tables.wavenumber[:, 1] > low))
    used = slice(int(bands[0]), int(bands[-1]) + 1)
    first = int(tables.points(used)[0])
    absorption = 100.0 * tables.absorption(column.pressure_pa, column.temperature, column.mixing, used) * column.dry
    middle = tables.middles()
    rows = []
    for points, depth in _groups(tables, used):
        band = int(tables.band_of[points.start])
        own = light[points]
        spectrum = (share[points, None] * inside[points]).sum(axis=0)
        spectrum /= spectrum.sum()
        ends = max(tables.wavenumber[band, 0], low), min(tables.wavenumber[band, 1], high)
        tilt = tilts(spectrum, middle, ends, tables.powers)
        part = slice(points.start - first, points.stop - first)
        # `share` belongs to the temperature at the ground.
        weight = own.sum() / float(share_change(tilt, column.temperature[0]))
        rows.append((1e4 / ends[1], 1e4 / ends[0], weight, tilt, merged(absorption[part], own, depth), spectrum))
    lower, upper, weight, tilt, found, spectra = (np.array(each) for each in zip(*rows, strict=True))
    if band_um is not None:
        # Not their inverse's inverse.
        lower[lower == lower.min()], upper[upper == upper.max()] = band_um
    for edge in np.unique(lower):
        weight[lower == edge] /= weight[lower == edge].sum()
    return Nodes(lower, upper, weight, tilt, found, spectra, middle)


def tilts(spectrum: Floats, middle: Floats, ends: tuple[float, float], powers: int) -> Floats:
    """Return the coefficients (P,) of `share_change` for light by bin (bins,) in a sub-band between two wavenumbers."""
    mean: Floats = np.array([1e-4 * (spectrum @ middle - 0.5 * sum(ends))])
    if powers == 1:
        return mean
    # The sub-band's own change is left out, as shares are normalised.
    lit, centre = spectrum > 0.0, np.array([0.5 * sum(ends)])
    x = np.cos(np.pi * (np.arange(_SHARES) + 0.5) / _SHARES) * 0.5 * (_warmth(_HOTTEST_K) - _warmth(_COLDEST_K))
    x += 0.5 * (_warmth(_HOTTEST_K) + _warmth(_COLDEST_K))
    kelvin = 1.0 / (1.0 / REFERENCE_K - x / C2)
    change = np.log(_warmer(middle[lit], kelvin) @ spectrum[lit]) - np.log(_warmer(centre, kelvin)[:, 0])
    found: Floats = np.linalg.lstsq(x[:, None] ** np.arange(1, powers + 1), change, rcond=None)[0]
    return found


def share_change(tilt: Floats, kelvin: ArrayLike) -> Floats:
    """Return the factor (...,) on a node's share at temperatures against that at 285 K, before shares are normalised.

    exp(Σ tilt_p x^p) with x = c₂ (1/285 K − 1/T). One power is Wien's law for light at one wavenumber, given from
    mid-sub-band; more are fitted to Planck's law over the light's spectrum. `tilt` is (..., P), broadcast.
    """
    kelvin = np.asarray(kelvin, np.float64)
    powers = tilt.shape[-1]
    # Tilts are at most half a sub-band, so the exponent of one power stays below 30 from 20 K up.
    x = _warmth(np.maximum(kelvin, 20.0) if powers == 1 else np.clip(kelvin, _COLDEST_K, _HOTTEST_K))
    total: Floats = tilt[..., powers - 1] * x
    for power in range(powers - 2, -1, -1):
        total = (total + tilt[..., power]) * x
    return np.exp(total)


def _warmth(kelvin: Any) -> Any:
    """c₂ (1/285 K − 1/T) [µm]."""
    return C2 * (1.0 / REFERENCE_K - 1.0 / kelvin)


def _warmer(wavenumber: Floats, kelvin: Floats) -> Floats:
    """Blackbody radiance at temperatures over that at 285 K, (T, n), at wavenumbers [cm⁻¹]."""
    at = C2 * 1e-4 * wavenumber
    return np.expm1(at / REFERENCE_K) / np.expm1(at / kelvin[:, None])


def merged(absorption: Floats, weight: Floats, depth: float) -> Floats:
    """Return the absorption (L,) of a group of points (n, L) of weights (n,) at its own optical depth."""
    found: Floats = weight @ absorption / weight.sum()
    for _ in range(_ROUNDS if len(absorption) > 1 else 0):
        passed = weight[:, None] * np.exp(-np.minimum(absorption * (depth / np.maximum(found, 1e-30)), 50.0))
        found = (absorption * passed).sum(axis=0) / passed.sum(axis=0)
    return found


def _groups(tables: GPoints, bands: slice) -> list[tuple[slice, float]]:
    """Groups of some bands: the finest with at most MOST_NODES nodes, or the coarsest."""
    found = [[each for each in own if bands.start <= tables.band_of[each[0].start] < bands.stop]
             for own in tables.groupings]  # fmt: skip
    return [own for own in found if own is found[0] or len(own) <= MOST_NODES][-1]


def inside_of(tables: GPoints, low: float, high: float, water: float) -> Floats:
    """Return the share (G, bins) of each g point's light in each bin between two wavenumbers [cm⁻¹], at a mixing ratio
    of water."""
    middle = tables.middles()
    own = tables.wavenumber[tables.band_of]
    even = ((middle > own[:, :1]) & (middle < own[:, 1:])) * (BIN_CM1 / (own[:, 1:] - own[:, :1]))
    spectrum = (1.0 - _EVEN) * tables.spectrum_at(water) + _EVEN * even
    overlap = np.minimum(middle + 0.5 * BIN_CM1, high) - np.maximum(middle - 0.5 * BIN_CM1, low)
    found: Floats = spectrum * np.clip(overlap / BIN_CM1, 0.0, 1.0)
    return found
