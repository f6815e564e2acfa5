"""Where in its band the light of a g point lies: fitted to LOWTRAN7's spectra of level paths.

A band's transmitted light by wavenumber is the sum over its g points of what each transmits times the point's spectrum.
LOWTRAN gives the left side in bins of 5 cm⁻¹, as a share of its own total, and RRTMGP what each point transmits. The
spectra, distributions over the bins, follow by least squares.
"""

import numpy as np

from thermorender.atmosphere import lowtran
from thermorender.atmosphere.air_column import WATER, AirColumn
from thermorender.atmosphere.gpoints import BIN_CM1, GPoints, knots
from thermorender.atmosphere.nodes import REFERENCE_K
from thermorender.physics.planck import C2, band_radiance_derivative
from tools.lowtran.spectra import CONTRAST_K, run_all
from tools.rrtmgp.columns import standard_of_1986

# Decimal logarithms of water's mixing ratio at which spectra are fitted: which gas absorbs most decides the order.
WATER_KNOTS = np.array([-5.0, -4.0, -3.3, -2.6, -1.9, -1.4])
_ALTITUDES_M = (0.0, 1000.0, 3000.0, 6000.0, 10000.0)
_LENGTHS_M = (100.0, 300.0, 1000.0, 3000.0, 10000.0, 30000.0)
# Pull towards a blackbody's spectrum, relative to the largest curvature, and number of steps.
_PULL, _STEPS = 1e-6, 20000


class Ratios:
    """LOWTRAN's light by bin beside what g points transmit, on level paths."""

    def __init__(self, tables: GPoints, workers=2):
        paths = [(number, up, length) for number in range(6) for up in _ALTITUDES_M for length in _LENGTHS_M]
        # Those that hold all bands.
        limits = next(each for each in lowtran.RANGES if each[1] >= tables.wavenumber[-1, 1])
        of_paths = [(lowtran.Air(number + 1), up, None, None, length) for number, up, length in paths]
        runs = run_all(of_paths, workers, limits)
        self.tables, self.middle = tables, tables.wavenumber[0, 0] + BIN_CM1 * (0.5 + np.arange(_bins(tables)))
        air = {number: standard_of_1986(number).at(np.array(_ALTITUDES_M)) for number in range(6)}
        found = {number: _seen(tables, column) for number, column in air.items()}
        point, light, water, shares, blacks = [], [], [], [], []
        for (number, up, length), run in zip(paths, runs, strict=True):
            level = _ALTITUDES_M.index(up)
            absorption, share = (each[:, level] for each in found[number])
            point.append(share * np.exp(-absorption * length))
            black = _planck(self.middle, air[number].temperature[level])
            shares.append(share)
            blacks.append(black)
            water.append(air[number].mixing[WATER][level])
            light.append(black * np.interp(self.middle, run.wavenumber, run.transmittance))
        self.point, self.light = np.array(point), np.array(light)
        # The same of paths of no length.
        self.share, self.black = np.array(shares), np.array(blacks)
        # Shares of the knots in each path.
        self.knots = knots(np.array(water), WATER_KNOTS)

    def bins(self, band: int):
        """Return the bins of a band."""
        low, high = self.tables.wavenumber[band]
        return np.flatnonzero((self.middle > low) & (self.middle < high))

    def of_band(self, band: int, length: float = 1.0):
        """Return (light of g points (paths, g), LOWTRAN's by bin with the same sum (paths, bins)); for 0 of paths of no
        length."""
        point, light = (self.point, self.light) if length else (self.share, self.black)
        point, light = point[:, self.tables.band_of == band], light[:, self.bins(band)]
        total = light.sum(axis=1, keepdims=True)
        return point, light / np.maximum(total, 1e-30) * point.sum(axis=1, keepdims=True)

    def fitted(self, paths=slice(None)):
        """Return the spectra (K, G, bins) that fit some of the paths."""
        spectrum = np.zeros((len(WATER_KNOTS), len(self.tables.band_of), len(self.middle)))
        for band in range(len(self.tables.wavenumber)):
            point, light = (each[paths] for each in self.of_band(band))
            rows = np.flatnonzero(self.tables.band_of == band)
            # With paths of no length: what all points emit is a blackbody's light.
            none, black = self.of_band(band, 0.0)
            point, light = (np.concatenate([each, own[paths]]) for each, own in ((point, none), (light, black)))
            shares = np.concatenate([self.knots[paths]] * 2)
            even = _planck(self.middle[self.bins(band)], REFERENCE_K)
            joint = (shares[:, :, None] * point[:, None]).reshape(len(point), -1)
            found = _distributions(joint, light, even / even.sum())
            spectrum[np.ix_(range(len(WATER_KNOTS)), rows, self.bins(band))] = found.reshape(
                len(WATER_KNOTS), len(rows), -1
            )
        return spectrum

    def errors(self, band_um, spectrum, paths=slice(None)):
        """Return errors of what a camera sees of targets CONTRAST_K warmer than their air, by cut bands, (paths,) [mK].

        The share that passes in the camera's part of each band that it cuts is compared with LOWTRAN's.
        """
        low, high = 1e4 / band_um[1], 1e4 / band_um[0]
        whole, total = band_radiance_derivative(REFERENCE_K, *band_um), 0.0
        for band, (first, last) in enumerate(self.tables.wavenumber):
            bins, points = self.bins(band), self.tables.band_of == band
            part = np.clip(0.5 + (self.middle[bins] - low) / BIN_CM1, 0.0, 1.0)
            part *= np.clip(0.5 + (high - self.middle[bins]) / BIN_CM1, 0.0, 1.0)
            if part.all() or not part.any():
                continue
            inside = np.einsum("pk,kgb,b->pg", self.knots, spectrum[:, points][..., bins], part, optimize=True)
            (point, light), (none, black) = self.of_band(band), self.of_band(band, 0.0)
            off = (point * inside).sum(axis=1) / (none * inside).sum(axis=1) - (light @ part) / (black @ part)
            edges = 1e4 / min(high, last), 1e4 / max(low, first)
            total = total + off * band_radiance_derivative(REFERENCE_K, *edges) / whole
        return 1e3 * CONTRAST_K * total[paths]

    def left_out(self, band_um, spectra):
        """Return `errors` of each atmosphere's paths by the spectra that were fitted without it."""
        return np.concatenate(
            [self.errors(band_um, each, own) for each, own in zip(spectra, self.atmospheres(), strict=True)]
        )

    def atmospheres(self):
        """Return the paths of each standard atmosphere."""
        count = len(self.point) // 6
        return [slice(number * count, (number + 1) * count) for number in range(6)]

    def fitted_without(self):
        """Return the spectra that are fitted without one atmosphere after the other."""
        every = np.arange(len(self.point))
        return [self.fitted(np.delete(every, each)) for each in self.atmospheres()]


def _bins(tables: GPoints) -> int:
    return round((tables.wavenumber[-1, 1] - tables.wavenumber[0, 0]) / BIN_CM1)


def _seen(tables: GPoints, column: AirColumn):
    """(Absorption [m⁻¹], share of the band's light), each (G, L)."""
    at = column.pressure_pa, column.temperature, column.mixing
    return 100.0 * tables.absorption(*at) * column.dry, tables.shares(*at)


def _planck(wavenumber, temperature):
    """Radiance of a blackbody per wavenumber, up to a constant."""
    return wavenumber**3 / np.expm1(C2 * 1e-4 * wavenumber / temperature)


def _distributions(point, light, even):
    """Rows (g, bins), none negative and each with sum 1, whose sum weighed by `point` is next to `light`."""
    square, target = point.T @ point, point.T @ light
    curvature = np.linalg.eigvalsh(square)[-1]
    found = np.tile(even, (point.shape[1], 1))
    ahead, speed = found, 1.0
    for _ in range(_STEPS):
        slope = square @ ahead - target + _PULL * curvature * (ahead - even)
        after = _onto_simplex(ahead - slope / (curvature * (1.0 + _PULL)))
        faster = 0.5 * (1.0 + np.sqrt(1.0 + 4.0 * speed**2))
        ahead, found, speed = after + (speed - 1.0) / faster * (after - found), after, faster
    return found


def _onto_simplex(rows):
    """The nearest distributions of rows: Held, Wolfe and Crowder (1974), doi:10.1007/BF01580223."""
    falling = np.sort(rows, axis=1)[:, ::-1]
    over = np.cumsum(falling, axis=1) - 1.0
    count = np.arange(1, rows.shape[1] + 1)
    last = (falling - over / count > 0.0).sum(axis=1)
    return np.maximum(rows - (over[np.arange(len(rows)), last - 1] / last)[:, None], 0.0)
