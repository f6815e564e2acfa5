"""RRTMGP's k-distribution of the thermal infrared: absorption of air at each of its g points.

Pincus, Mlawer and Delamere (2019), J. Adv. Model. Earth Syst. 11, 3074, doi:10.1029/2019MS001621. A band has 16 g
points. At each one the absorption by two key species is tabulated by temperature, pressure and their mixture η; further
gases, and the self and foreign continuum of water, by temperature and η. `python -m tools.rrtmgp` packs the tables of
the package from the file `rrtmgp-gas-lw-g256.nc`, under BSD-3 (`gpoints.license`).
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thermorender.atmosphere.air_column import WATER
from thermorender.atmosphere.checks import not_covered
from thermorender.atmosphere.packed import unpacked

Floats = NDArray[np.float64]
# Bins of `GPoints.spectrum` [cm⁻¹]; the limits of bands are multiples of them.
BIN_CM1 = 5.0
# Key species of a band that has none are two of number 2.
NO_KEY = (2, 2)
# Of the long wave and of the mid-wave.
_FILES = ("gpoints.npz", "gpoints_midwave.npz")


class TablePlace(NamedTuple):
    """Levels between points of the tables: index below and fraction of the way to the next."""

    temperature: tuple[NDArray[np.intp], Floats]
    pressure: tuple[NDArray[np.intp], Floats]
    upper: NDArray[np.bool_]  # Above the reference tropopause

    def part(self, levels: NDArray[np.intp]) -> "TablePlace":
        """Return that of some levels."""
        row, up = ((index[levels], fraction[levels]) for index, fraction in (self.temperature, self.pressure))
        return TablePlace(row, up, self.upper[levels])


class Mixed(NamedTuple):
    """Amount of both key species at levels, in molecules of dry air, and their mixture η in the tables."""

    amount: Floats
    below: NDArray[np.intp]
    fraction: Floats


@dataclass(frozen=True)
class Minor:
    """A gas with absorption by temperature and mixture in some g points, in the lower or the upper atmosphere."""

    gas: str
    kind: str  # Its name; of water "h2o_self" or "h2o_frgn"
    points: slice  # Numbers of its g points
    cross_section: Floats  # (T, η, g) [cm²]
    with_density: bool  # Whether it is in units of pressure over temperature [hPa K⁻¹]
    scaled_by: str  # A gas whose share of moist air scales it; empty: none
    by_complement: bool  # Or the share of all other gases


@dataclass(frozen=True)
class GPoints:
    """The tables."""

    gases: tuple[str, ...]
    wavenumber: Floats  # (B, 2) limits of the bands [cm⁻¹]
    band_of: NDArray[np.intp]  # (G,) band of each g point
    pressure: Floats  # (P,) [Pa], falling, even in its logarithm
    temperature: Floats  # (T,) [K], even
    tropopause_pa: float
    key: NDArray[np.intp]  # (B, 2, 2) numbers of the key species by band, in the lower and the upper atmosphere
    ratio: Floats  # (T, 1 + gases, 2) reference mixing ratios, dry air first
    major: Floats  # (T, P + 1, η, G) [cm²]
    share: Floats  # (T, P + 1, η, G) of the band's Planck radiance
    minor: tuple[tuple[Minor, ...], tuple[Minor, ...]]  # Of the lower and the upper atmosphere
    planck_k: Floats  # (K,) temperatures of `planck`
    planck: Floats  # (B, K) radiance of a blackbody in each band [W m⁻² sr⁻¹]
    # (K, G, bins) share of each g point's light at 285 K in bins of 5 cm⁻¹ from the first band on, where the decimal
    # logarithm of water's mixing ratio is one of `spectrum_water` (K,).
    spectrum: Floats
    spectrum_water: Floats
    groupings: tuple[tuple[tuple[slice, float], ...], ...] = ()  # From coarse to fine: (g points, depth) of each node
    powers: int = 1  # In which the logarithm of a node's share changes with 1/temperature
    # Relative spread of published versions of the self and of the foreign continuum of water.
    continuum: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def shipped(cls, band_um: tuple[float, float] | None = None) -> "GPoints":
        """Return the tables of the package for a camera's band [µm], or of the long wave; read once.

        Raises
        ------
        ThermorenderError
            No tables cover the band.
        """
        if band_um is None:
            return _shipped(_FILES[0])
        spans = []
        for name in _FILES:
            found = _shipped(name)
            if found.covers(band_um):
                return found
            spans.append(found.span_text)
        raise not_covered(" and ".join(spans), band_um)

    @property
    def span_um(self) -> tuple[float, float]:
        """Limits of all bands [µm]."""
        return 1e4 / float(self.wavenumber[-1, 1]), 1e4 / float(self.wavenumber[0, 0])

    @property
    def span_text(self) -> str:
        """The limits in words, with four digits inside them."""
        ends = []
        for value, inwards in zip(self.span_um, (np.ceil, np.floor), strict=True):
            unit = 10.0 ** (3 - int(np.floor(np.log10(value))))
            ends.append(f"{inwards(value * unit) / unit:g}")
        return "–".join(ends)

    def covers(self, band_um: tuple[float, float]) -> bool:
        """Return whether a band [µm] is within the tables'."""
        least, most = self.span_um
        return least - 1e-9 <= band_um[0] < band_um[1] <= most + 1e-9

    def middles(self) -> Floats:
        """Return the middle of each bin of `spectrum`, (bins,) [cm⁻¹]."""
        return self.wavenumber[0, 0] + BIN_CM1 * (0.5 + np.arange(self.spectrum.shape[-1]))

    def spectrum_at(self, water: float) -> Floats:
        """Return where the light of each g point lies, (G, bins), at a mixing ratio of water."""
        parts = knots(np.array([water]), self.spectrum_water)[0]
        found: Floats = np.tensordot(parts, self.spectrum, 1)
        return found

    def points(self, bands: slice) -> NDArray[np.intp]:
        """Return the numbers of the g points of some bands."""
        return np.flatnonzero(np.isin(self.band_of, np.arange(len(self.wavenumber))[bands]))

    def place(self, pressure_pa: Floats, temperature: Floats) -> TablePlace:
        """Return where levels (L,) are in the tables; beyond their ends they are at these."""
        step = np.diff(self.temperature)[0]
        over = np.clip((temperature - self.temperature[0]) / step, 0.0, len(self.temperature) - 1.0)
        first = np.minimum(over.astype(np.intp), len(self.temperature) - 2)
        pressure_pa = np.clip(pressure_pa, self.pressure[-1], self.pressure[0])
        high = np.log(pressure_pa / self.pressure[0]) / np.log(self.pressure[1] / self.pressure[0])
        level = np.minimum(high.astype(np.intp), len(self.pressure) - 2)
        upper = pressure_pa <= self.tropopause_pa
        # The row of the tropopause is there twice, for the lower and for the upper atmosphere.
        return TablePlace((first, over - first), (level + upper, high - level), upper)

    def absorption(
        self, pressure_pa: Floats, temperature: Floats, mixing: Mapping[str, Floats], bands: slice = slice(None)
    ) -> Floats:
        """Return absorption cross sections per molecule of dry air, (G of the bands, L) [cm²].

        Parameters
        ----------
        pressure_pa, temperature : (L,) arrays
        mixing : {gas: (L,) array}
            Molecules of a gas over those of dry air; gases that are not given are absent.
        bands : slice
        """
        total = np.zeros((len(self.points(bands)), len(pressure_pa)))
        for at, points, upper, place, mixed in self._walk(pressure_pa, temperature, mixing, bands):
            total[at] = self._major(self.major, points, place, mixed).T
            levels = at[1].ravel()
            own = {name: values[levels] for name, values in mixing.items()}
            water = own.get(WATER, np.zeros(len(levels)))
            for minor in self.minor[upper]:
                if minor.points.start != points.start or minor.gas not in own:
                    continue
                scale = own[minor.gas]
                if minor.with_density:
                    scale = scale * 0.01 * pressure_pa[levels] / temperature[levels]
                if minor.scaled_by:
                    share = own.get(minor.scaled_by, np.zeros(len(levels))) / (1.0 + water)
                    scale = scale * (1.0 - share if minor.by_complement else share)
                total[at] += (scale[:, None] * _minor_at(minor.cross_section, place, mixed)).T
        return np.maximum(total, 0.0)

    def shares(
        self, pressure_pa: Floats, temperature: Floats, mixing: Mapping[str, Floats], bands: slice = slice(None)
    ) -> Floats:
        """Return the share of each g point in its band's Planck radiance, (G of the bands, L)."""
        found = np.zeros((len(self.points(bands)), len(pressure_pa)))
        for at, points, _, place, mixed in self._walk(pressure_pa, temperature, mixing, bands):
            one = [each._replace(amount=np.ones_like(each.amount)) for each in mixed]
            found[at] = self._major(self.share, points, place, one).T
        return found

    def radiance(self, temperature: Floats) -> Floats:
        """Return a blackbody's radiance in each band, (..., B) [W m⁻² sr⁻¹]."""
        return np.stack([np.interp(temperature, self.planck_k, each) for each in self.planck], axis=-1)

    def _walk(
        self, pressure_pa: Floats, temperature: Floats, mixing: Mapping[str, Floats], bands: slice
    ) -> Iterator[tuple[tuple[NDArray[np.intp], ...], slice, int, TablePlace, list[Mixed]]]:
        """Yield (rows and levels, numbers of the g points, part of the atmosphere, place, keys below and above) of each
        band in the lower (0) and in the upper (1) atmosphere."""
        place, chosen = self.place(pressure_pa, temperature), self.points(bands)
        for band in np.unique(self.band_of[chosen]):
            rows, points = np.flatnonzero(self.band_of[chosen] == band), np.flatnonzero(self.band_of == band)
            for upper in (0, 1):
                levels = np.flatnonzero(place.upper == bool(upper))
                if levels.size:
                    own = place.part(levels)
                    mixed = [self._mixed(band, upper, own.temperature[0] + more, mixing, levels) for more in (0, 1)]
                    yield np.ix_(rows, levels), slice(points[0], points[-1] + 1), upper, own, mixed

    def _mixed(
        self, band: int, upper: int, row: NDArray[np.intp], mixing: Mapping[str, Floats], levels: NDArray[np.intp]
    ) -> Mixed:
        """The key species of a band at rows of the temperatures."""
        one, other = (self._of(number, mixing, levels) for number in self.key[band, upper])
        ratio = self.ratio[row, :, upper][:, self.key[band, upper]]
        amount = one + ratio[:, 0] / ratio[:, 1] * other
        known = amount > 0.0
        eta = np.where(known, one / np.where(known, amount, 1.0), 0.5) * (self.major.shape[2] - 1)
        index = np.minimum(eta.astype(np.intp), self.major.shape[2] - 2)
        return Mixed(amount, index, eta - index)

    def _of(self, number: int, mixing: Mapping[str, Floats], levels: NDArray[np.intp]) -> Floats:
        """Mixing ratio of a gas by its number; 0 is dry air."""
        if number == 0:
            return np.ones(len(levels))
        given = mixing.get(self.gases[number - 1])
        return np.zeros(len(levels)) if given is None else given[levels]

    def _major(self, table: Floats, points: slice, place: TablePlace, mixed: list[Mixed]) -> Floats:
        """Values (L, g) of a table (T, P + 1, η, G), times the amounts of the key species."""
        row, up = place.pressure
        part = table[..., points]
        found = np.zeros((len(row), part.shape[-1]))
        for first, index, weight, amount in _corners(place, mixed):
            for high, share in ((0, 1.0 - up), (1, up)):
                found += (weight * share * amount)[:, None] * part[first, row + high, index]
        return found


def knots(water: Floats, knot: Floats) -> Floats:
    """Return shares (n, K) of knots in mixing ratios (n,): linear in their logarithm, constant beyond the ends."""
    logs = np.log10(np.maximum(water, 1e-30))
    return np.stack([np.interp(logs, knot, unit) for unit in np.eye(len(knot))], axis=-1)


def _corners(
    place: TablePlace, mixed: list[Mixed]
) -> Iterator[tuple[NDArray[np.intp], NDArray[np.intp], Floats, Floats]]:
    """Yield (row of the temperatures, index of η, weight, amount) of the four points around levels."""
    first, warm = place.temperature
    for more, (amount, index, fraction) in enumerate(mixed):
        for further, share in ((0, 1.0 - fraction), (1, fraction)):
            yield first + more, index + further, (warm if more else 1.0 - warm) * share, amount


def _minor_at(section: Floats, place: TablePlace, mixed: list[Mixed]) -> Floats:
    """Cross sections (L, g) of a minor gas."""
    found = np.zeros((len(place.upper), section.shape[-1]))
    for first, index, weight, _ in _corners(place, mixed):
        found += weight[:, None] * section[first, index]
    return found


@cache
def _shipped(name: str) -> GPoints:
    with open(__file__.removesuffix("gpoints.py") + name, "rb") as file, np.load(file, allow_pickle=False) as stored:
        data = {name: stored[name] for name in stored.files}
    gases = tuple(data["gases"].tolist())
    groups = list(zip(data["group"].tolist(), data["depth"].tolist(), strict=True))
    sections = unpacked(data["minor"], data["minor_scale"])
    minor: tuple[list[Minor], list[Minor]] = ([], [])
    start = 0
    for name, (upper, first, last, with_density, scaled, complement) in zip(
        data["minor_kind"].tolist(), data["minor_of"].tolist(), strict=True
    ):
        end = start + last - first
        kind, gas = name.split("/")
        by = "" if scaled < 0 else gases[scaled]
        minor[upper].append(
            Minor(gas, kind, slice(first, last), sections[..., start:end], bool(with_density), by, bool(complement))
        )
        start = end
    return GPoints(
        gases, data["wavenumber"], data["band_of"], data["pressure"], data["temperature"],
        float(data["tropopause_pa"]), data["key"], data["ratio"], unpacked(data["major"], data["major_scale"]),
        unpacked(data["share"], data["share_scale"]), (tuple(minor[0]), tuple(minor[1])), data["planck_k"],
        data["planck"], data["spectrum"].astype(np.float64), data["spectrum_water"],
        tuple(
            tuple((slice(*ends), depth) for (of, *ends), depth in groups if of == k)
            for k in range(1 + int(data["group"][:, 0].max()))
        ),
        int(data["powers"]), tuple(data["continuum"].tolist()),
    )  # fmt: skip
