"""RRTMGP's k-distribution of the thermal infrared: absorption of air at each of its g points.

Pincus, Mlawer and Delamere (2019), J. Adv. Model. Earth Syst. 11, 3074, doi:10.1029/2019MS001621. The data are files
of netCDF (classic) such as `rrtmgp-gas-lw-g256.nc`, under BSD-3. A band has 16 g points. At each one the absorption by
two key species is tabulated by temperature, pressure and their mixture η; further gases, and the self and foreign
continuum of water, by temperature and η.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from os import PathLike
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
# Key species of a band that has none are two of number 2.
_NONE = (2, 2)
WATER = "h2o"


class Place(NamedTuple):
    """Levels between points of the tables: index below and fraction of the way to the next."""

    temperature: tuple[NDArray[np.intp], Floats]
    pressure: tuple[NDArray[np.intp], Floats]
    upper: NDArray[np.bool_]  # Above the reference tropopause

    def part(self, levels: NDArray[np.intp]) -> "Place":
        """Return that of some levels."""
        row, up = ((index[levels], fraction[levels]) for index, fraction in (self.temperature, self.pressure))
        return Place(row, up, self.upper[levels])


class Mixed(NamedTuple):
    """Amount of both key species at levels, in molecules of dry air, and their mixture η in the tables."""

    amount: Floats
    index: NDArray[np.intp]
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

    @classmethod
    def read(cls, path: str | PathLike[str]) -> "GPoints":
        """Return the tables of a file."""
        from scipy.io import netcdf_file

        with netcdf_file(path, mmap=False) as file:
            data = {name: np.array(each.data) for name, each in file.variables.items()}
        names = {name: _texts(values) for name, values in data.items() if values.dtype.kind == "S" and values.ndim == 2}
        key = np.array(data["key_species"], np.intp)
        key[(key == 0).all(axis=-1)] = _NONE
        limits = data["bnd_limits_gpt"]
        band_of = np.repeat(np.arange(len(limits)), limits[:, 1] - limits[:, 0] + 1)
        gas_of = dict(zip(names["identifier_minor"], names["gas_minor"], strict=True))
        minor = tuple(tuple(_minor(data, names, gas_of, part)) for part in ("lower", "upper"))
        return cls(
            tuple(names["gas_names"]), _floats(data["bnd_limits_wavenumber"]), band_of, _floats(data["press_ref"]),
            _floats(data["temp_ref"]), float(data["press_ref_trop"]), key, _floats(data["vmr_ref"]),
            _floats(data["kmajor"]), _floats(data["plank_fraction"]), (minor[0], minor[1]),
            # Some editions of the files have 0 … 195 there.
            160.0 + np.arange(data["totplnk"].shape[1]), _floats(data["totplnk"]),
        )  # fmt: skip

    def points(self, bands: slice) -> NDArray[np.intp]:
        """Return the numbers of the g points of some bands."""
        return np.flatnonzero(np.isin(self.band_of, np.arange(len(self.wavenumber))[bands]))

    def place(self, pressure_pa: Floats, temperature: Floats) -> Place:
        """Return where levels (L,) are in the tables; beyond their ends they are extrapolated."""
        step = np.diff(self.temperature)[0]
        over = (temperature - self.temperature[0]) / step
        first = np.clip(np.floor(over).astype(np.intp), 0, len(self.temperature) - 2)
        high = np.log(pressure_pa / self.pressure[0]) / np.log(self.pressure[1] / self.pressure[0])
        level = np.clip(np.floor(high).astype(np.intp), 0, len(self.pressure) - 2)
        upper = pressure_pa <= self.tropopause_pa
        # The row of the tropopause is there twice, for the lower and for the upper atmosphere.
        return Place((first, over - first), (level + upper, high - level), upper)

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
    ) -> Iterator[tuple[tuple[NDArray[np.intp], ...], slice, int, Place, list[Mixed]]]:
        """Yield (rows and levels, numbers of the g points, part of the atmosphere, Place, Mixed below and above) of
        each band in the lower (0) and in the upper (1) atmosphere."""
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

    def _major(self, table: Floats, points: slice, place: Place, mixed: list[Mixed]) -> Floats:
        """Values (L, g) of a table (T, P + 1, η, G), times the amounts of the key species."""
        row, up = place.pressure
        part = table[..., points]
        found = np.zeros((len(row), part.shape[-1]))
        for first, index, weight, amount in _corners(place, mixed):
            for high, share in ((0, 1.0 - up), (1, up)):
                found += (weight * share * amount)[:, None] * part[first, row + high, index]
        return found


def _corners(place: Place, mixed: list[Mixed]) -> Iterator[tuple[NDArray[np.intp], NDArray[np.intp], Floats, Floats]]:
    """Yield (row of the temperatures, index of η, weight, amount) of the four points around levels."""
    first, warm = place.temperature
    for more, (amount, index, fraction) in enumerate(mixed):
        for further, share in ((0, 1.0 - fraction), (1, fraction)):
            yield first + more, index + further, (warm if more else 1.0 - warm) * share, amount


def _minor_at(section: Floats, place: Place, mixed: list[Mixed]) -> Floats:
    """Cross sections (L, g) of a minor gas."""
    found = np.zeros((len(place.upper), section.shape[-1]))
    for first, index, weight, _ in _corners(place, mixed):
        found += weight[:, None] * section[first, index]
    return found


def _minor(
    data: Mapping[str, NDArray[Any]], names: Mapping[str, list[str]], gas_of: Mapping[str, str], part: str
) -> Iterator[Minor]:
    for number, kind in enumerate(names[f"minor_gases_{part}"]):
        first, last = data[f"minor_limits_gpt_{part}"][number]
        start = int(data[f"kminor_start_{part}"][number]) - 1
        yield Minor(
            gas_of[kind], kind, slice(int(first) - 1, int(last)),
            _floats(data[f"kminor_{part}"][..., start : start + int(last - first) + 1]),
            bool(data[f"minor_scales_with_density_{part}"][number]), names[f"scaling_gas_{part}"][number],
            bool(data[f"scale_by_complement_{part}"][number]),
        )  # fmt: skip


def _texts(values: NDArray[Any]) -> list[str]:
    return [b"".join(row).decode("ascii").strip() for row in values]


def _floats(values: NDArray[Any]) -> Floats:
    return np.array(values, np.float64)
