"""Few spectral nodes out of many g points: neighbours in a band become one, with an absorption of its own by level.

`thermorender.atmosphere.nodes.merged` gives the absorption of a group. A search chooses the groups and their depths, so
that lines of sight and skies of all columns at once err least: dynamic programming by band for groups alone, then one
change after the other for the sum of all, as errors of groups cancel.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from thermorender.atmosphere.air_column import WATER, AirColumn
from thermorender.atmosphere.gpoints import GPoints
from thermorender.atmosphere.nodes import inside_of, merged, share_change, tilts
from thermorender.physics.planck import band_radiance
from tools.rrtmgp.columns import LEVELS_M

Floats = NDArray[np.float64]
# Optical depths at which a group's absorption may be taken.
DEPTHS = (0.05, 0.1, 0.2, 0.4, 0.7, 1.0, 1.5, 2.5, 4.0)
# A target is warmer than its air by this [K]; the error of a sky counts so much less than that of a path.
CONTRAST_K, _SKY = 20.0, 0.3
# (altitude of the camera, of the target, length) of lines of sight [m], and cosines of zenith angles of skies.
Paths = Sequence[tuple[float, float, float]]
PATHS: Paths = (
    *((up, up, length) for up in (0.0, 500.0, 2000.0, 5000.0) for length in (50.0, 200.0, 1000.0, 5000.0, 20000.0)),
    *((up, 0.0, up / cosine) for up in (120.0, 1000.0, 3000.0, 6000.0) for cosine in (1.0, 0.5, 0.1)),
)
SKIES = (1.0, 0.5, 0.2, 0.1)


@dataclass(frozen=True)
class Group:
    """Neighbouring g points of a band that become a node."""

    points: slice  # Among all
    depth: float


@dataclass(frozen=True, eq=False)
class Lit:
    """Absorption and emission of g points, or of nodes, in a column."""

    absorption: Floats  # (G, L) [m⁻¹]
    share: Floats  # (G, L) of the Planck radiance of its band
    planck: Floats  # (G, L) radiance of a blackbody as warm as the air [W m⁻² sr⁻¹]
    warmer: Floats  # (G, L) that of one CONTRAST_K warmer
    as_nodes: Floats  # (2, G, L) `planck` and `warmer` with shares as nodes have them

    @classmethod
    def of(
        cls, tables: GPoints, column: AirColumn, band_um: tuple[float, float], warmer_k: float = CONTRAST_K
    ) -> "Lit":
        """Return that of all g points in a camera's band, and targets `warmer_k` warmer than the air; g points outside
        the band have next to no light."""
        low, high = 1e4 / band_um[1], 1e4 / band_um[0]
        inside = np.maximum(inside_of(tables, low, high, float(column.mixing[WATER][0])), 1e-15)
        centre = 0.5 * np.clip(tables.wavenumber, low, high).sum(axis=1)[tables.band_of]
        spectrum = inside / inside.sum(axis=1, keepdims=True)
        tilt = np.array([tilts(own, tables.middles(), (middle, middle), tables.powers)
                         for own, middle in zip(spectrum, centre, strict=True)])  # fmt: skip
        # A target's share is that of air as warm as itself, or that of the warmest air changed.
        warm = column.temperature + warmer_k
        known = np.minimum(warm, tables.temperature[-1])
        share, warm_share = (
            tables.shares(column.pressure_pa, kelvin, column.mixing) * inside.sum(axis=1)[:, None]
            for kelvin in (column.temperature, known)
        )
        warm_share *= _changed(tilt, warm) / _changed(tilt, known)
        light, as_nodes = np.zeros((2, *share.shape)), np.zeros((2, *share.shape))
        for band, (first, last) in enumerate(np.clip(tables.wavenumber, low, high)):
            own = tables.band_of == band
            share[own] /= share[own].sum(axis=0)
            warm_share[own] /= warm_share[own].sum(axis=0)
            if last <= first:
                continue
            for k, each in enumerate((share, warm_share)):
                kelvin = column.temperature + k * warmer_k
                black = band_radiance(kelvin, 1e4 / last, 1e4 / first)
                light[k, own] = each[own] * black
                # Shares at the ground, which change with temperature by the place of the light in the band.
                node = share[own, :1] * _changed(tilt[own], kelvin) / _changed(tilt[own], column.temperature[:1])
                as_nodes[k, own] = node / node.sum(axis=0) * black
        absorption = tables.absorption(column.pressure_pa, column.temperature, column.mixing)
        return cls(100.0 * absorption * column.dry, share, *light, as_nodes)

    @property
    def kelvin(self) -> float:
        """Kelvin of a blackbody for a radiance, at the ground, as if all targets were CONTRAST_K warmer."""
        return CONTRAST_K / float((self.warmer[:, 0] - self.planck[:, 0]).sum())

    def part(self, points: slice) -> "Lit":
        """Return that of some points."""
        own = (each[points] for each in (self.absorption, self.share, self.planck, self.warmer))
        return Lit(*own, self.as_nodes[:, points])

    def merged(self, groups: Sequence[Group]) -> "Lit":
        """Return that of nodes."""
        absorption = [merged(self.absorption[one.points], self.share[one.points, 0], one.depth) for one in groups]
        share = np.array([self.share[one.points].sum(axis=0) for one in groups])
        light = np.stack([self.as_nodes[:, one.points].sum(axis=1) for one in groups], axis=1)
        return Lit(np.array(absorption), share, *light, light)

    def seen(self, paths: Paths, skies: Sequence[float]) -> Floats:
        """Return radiance of warm targets through the air, and of the sky from the ground, (tests, G)."""
        found = [through * self.warmer[:, _level(last)] + own
                 for first, last, length in paths for through, own in [self._path(first, last, length)]]  # fmt: skip
        return np.array([*found, *(self._along(slice(0, None), np.diff(LEVELS_M) / cosine)[1] for cosine in skies)])

    def _path(self, first_m: float, last_m: float, length_m: float) -> tuple[Floats, Floats]:
        """(Transmittance, emission) of a straight path, each (G,)."""
        first, last = _level(first_m), _level(last_m)
        if first == last:
            through = np.exp(-self.absorption[:, first] * length_m)
            return through, self.planck[:, first] * (1.0 - through)
        part = slice(first, last + 1) if first < last else slice(first, last - 1 if last else None, -1)
        step = np.abs(np.diff(LEVELS_M[part]))
        return self._along(part, step * (length_m / step.sum()))

    def _along(self, part: slice, step: Floats) -> tuple[Floats, Floats]:
        """(Transmittance, emission) of steps [m] between levels, with a source linear in optical depth."""
        absorption, source = self.absorption[:, part], self.planck[:, part]
        depth = np.maximum(0.5 * (absorption[:, 1:] + absorption[:, :-1]) * step, 1e-12)
        total = np.cumsum(depth, axis=1)
        before, passed = np.exp(depth - total), np.exp(-depth)
        mean = -np.expm1(-depth) / depth
        light = before * (source[:, :-1] * (1.0 - mean) + source[:, 1:] * (mean - passed))
        return np.exp(-total[:, -1]), light.sum(axis=1)


def chosen(every: Sequence[Lit], band_of: NDArray[np.intp], most: int) -> list[Group]:
    """Return the groups of `most` nodes for all columns at once; `band_of` (G,) are the bands of points, rising."""
    starts = np.unique(band_of, return_index=True)[1].tolist()
    bands = [slice(first, end) for first, end in pairwise([*starts, len(band_of)])]
    alone, errors = (
        [np.concatenate([_errors(lit, band, level) for lit in every], axis=-1) for band in bands]
        for level in (False, True)
    )
    found = [_together(errors, _alone(each, most), starts) for each in (alone, errors)]
    return min(found, key=lambda each: each[0])[1]


def judged(lit: Lit, groups: Sequence[Group], paths: Paths, skies: Sequence[float]) -> Floats:
    """Return errors of apparent temperature of targets and of skies, (tests,) [K], by the slope at the ground's air."""
    return (lit.merged(groups).seen(paths, skies).sum(axis=1) - lit.seen(paths, skies).sum(axis=1)) * lit.kelvin


def _changed(tilt: Floats, kelvin: Floats) -> Floats:
    """Change of shares (G, L) at temperatures (L,)."""
    found: Floats = share_change(tilt[:, None], kelvin)
    return found


def _level(altitude_m: float) -> int:
    return int(np.abs(LEVELS_M - altitude_m).argmin())


def _errors(lit: Lit, band: slice, by_level: bool) -> Floats:
    """Errors of all groups of neighbours among a band's points in a column, (first, end, depth, tests) [K].

    They are those against the points with their shares at each level, or with the shares that nodes have. The errors of
    shares alone cancel in the sum of points.
    """
    own, count = lit.part(band), band.stop - band.start
    pairs = [(first, end) for first in range(count) for end in range(first + 1, count + 1)]
    points = own if by_level else own.merged([Group(slice(k, k + 1), 1.0) for k in range(count)])
    seen = points.seen(PATHS, SKIES)
    before = np.concatenate([np.zeros((len(seen), 1)), np.cumsum(seen, axis=1)], axis=1)
    merged = own.merged([Group(slice(*pair), depth) for pair in pairs for depth in DEPTHS]).seen(PATHS, SKIES)
    true = np.stack([before[:, end] - before[:, first] for first, end in pairs], axis=1)
    off = merged.reshape(len(seen), len(pairs), len(DEPTHS)) - true[..., None]
    off *= lit.kelvin
    off[len(PATHS) :] *= _SKY
    found = np.full((count, count + 1, len(DEPTHS), len(seen)), np.inf)
    for number, (first, end) in enumerate(pairs):
        found[first, end] = off[:, number].T
    return found


def _cost(off: Floats) -> Floats:
    """Cost of errors (..., tests): their squares, with more weight on the largest."""
    square = np.square(off)
    found: Floats = square.sum(axis=-1) + 2.0 * np.sqrt(np.square(square).sum(axis=-1))
    return found


def _alone(errors: Sequence[Floats], most: int) -> list[list[int]]:
    """Ends of the groups of each band, as if the errors of groups were independent."""
    best, back = [], []
    for off in errors:
        count = len(off)
        cost = np.square(off).sum(axis=-1).min(axis=-1)
        least, before = np.full((count + 1, count + 1), np.inf), np.zeros((count + 1, count + 1), np.intp)
        least[0, 0] = 0.0
        for groups in range(1, count + 1):
            for end in range(groups, count + 1):
                sums = least[groups - 1, :end] + cost[:end, end]
                before[groups, end] = sums.argmin()
                least[groups, end] = sums.min()
        best.append(least[:, count])
        back.append(before)
    # Nodes of the bands so far: (cost, groups of each).
    shared: dict[int, tuple[float, list[int]]] = {0: (0.0, [])}
    for number, least in enumerate(best):
        left, more = len(best) - number - 1, dict[int, tuple[float, list[int]]]()
        for nodes, (cost, groups) in shared.items():
            for own in range(1, min(len(least) - 1, most - left - nodes) + 1):
                whole = cost + float(least[own]), [*groups, own]
                more[nodes + own] = min(more.get(nodes + own, whole), whole)
        shared = more
    cuts = []
    for before, own in zip(back, shared[max(shared)][1], strict=True):
        ends = [len(before) - 1]
        for groups in range(own, 0, -1):
            ends.append(int(before[groups, ends[-1]]))
        cuts.append(ends[::-1])
    return cuts


def _together(errors: Sequence[Floats], cuts: list[list[int]], starts: Sequence[int]) -> tuple[float, list[Group]]:
    """(Cost, groups) after changes of one end or one optical depth at a time that lower the cost of the sum."""
    depth = [[int(np.square(off[first, end]).sum(axis=-1).argmin()) for first, end in pairwise(own)]
             for off, own in zip(errors, cuts, strict=True)]  # fmt: skip
    total = np.sum([off[first, end, which] for off, own, chosen in zip(errors, cuts, depth, strict=True)
                    for (first, end), which in zip(pairwise(own), chosen, strict=True)], axis=0)  # fmt: skip
    least = float(_cost(total))
    while True:
        best = None
        for band, (off, own) in enumerate(zip(errors, cuts, strict=True)):
            for k, (first, end) in enumerate(pairwise(own)):
                others = total - off[first, end, depth[band][k]]
                cost = _cost(others + off[first, end])
                own_best = (float(cost.min()), band, k, end, int(cost.argmin()), None)
                best = own_best if best is None else min(best, own_best, key=lambda each: each[0])
                if k + 2 >= len(own):
                    continue
                others = others - off[end, own[k + 2], depth[band][k + 1]]
                for moved in range(first + 1, own[k + 2]):
                    two = off[first, moved][:, None] + off[moved, own[k + 2]][None]
                    cost = _cost(others + two)
                    one, other = divmod(int(cost.argmin()), len(DEPTHS))
                    best = min(best, (float(cost.min()), band, k, moved, one, other), key=lambda each: each[0])
        assert best is not None
        if best[0] >= least * (1.0 - 1e-9):
            break
        least, band, k, end, one, other = best
        off, own = errors[band], cuts[band]
        total = total - off[own[k], own[k + 1], depth[band][k]]
        if other is not None:
            total = total - off[own[k + 1], own[k + 2], depth[band][k + 1]] + off[end, own[k + 2], other]
            own[k + 1], depth[band][k + 1] = end, other
        depth[band][k] = one
        total = total + off[own[k], own[k + 1], one]
    return least, [Group(slice(start + first, start + end), DEPTHS[which])
                   for start, own, chosen in zip(starts, cuts, depth, strict=True)
                   for (first, end), which in zip(pairwise(own), chosen, strict=True)]  # fmt: skip
