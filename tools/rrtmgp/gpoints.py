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
        self, pressure_pa: Floats, temperature: Floats, mixing: Mapping[str, Floats], bands: slice = slice(None),
        parts: bool = False,
    ) -> Floats | tuple[Floats, dict[str, Floats]]:  # fmt: skip
        """Return absorption cross sections per molecule of dry air, (G of the bands, L) [cm²].

        Parameters
        ----------
        pressure_pa, temperature : (L,) arrays
        mixing : {gas: (L,) array}
            Molecules of a gas over those of dry air; gases that are not given are absent.
        bands : slice
        parts : bool
            Also return those of the self and of the foreign continuum of water, by "h2o_self" and "h2o_frgn".
        """
        place, chosen = self.place(pressure_pa, temperature), self.points(bands)
        total = np.zeros((len(chosen), len(pressure_pa)))
        apart = {f"{WATER}_{kind}": np.zeros_like(total) for kind in ("self", "frgn")}
        water = mixing.get(WATER, np.zeros(len(pressure_pa)))
        for band in np.unique(self.band_of[chosen]):
            rows = np.flatnonzero(self.band_of[chosen] == band)
            of_band = np.flatnonzero(self.band_of == band)
            for upper in (0, 1):
                levels = np.flatnonzero(place.upper == bool(upper))
                if not levels.size:
                    continue
                own = _part(place, levels)
                mixed = self._mixed(band, upper, own, mixing, levels)
                at = np.ix_(rows, levels)
                total[at] += self._looked_up(self.major, of_band, own, mixed, weighted=True).T
                for minor in self.minor[upper]:
                    if minor.points.start != of_band[0] or minor.gas not in mixing:
                        continue
                    scale = mixing[minor.gas][levels].copy()
                    if minor.with_density:
                        scale *= 0.01 * pressure_pa[levels] / temperature[levels]
                    if minor.scaled_by:
                        share = mixing.get(minor.scaled_by, np.zeros_like(water))[levels] / (1.0 + water[levels])
                        scale *= 1.0 - share if minor.by_complement else share
                    found = (scale[:, None] * _minor_at(minor.cross_section, own, mixed)).T
                    total[at] += found
                    if minor.kind in apart:
                        apart[minor.kind][at] += found
        total = np.maximum(total, 0.0)
        return (total, apart) if parts else total

    def shares(
        self, pressure_pa: Floats, temperature: Floats, mixing: Mapping[str, Floats], bands: slice = slice(None)
    ) -> Floats:
        """Return the share of each g point in its band's Planck radiance, (G of the bands, L)."""
        place, chosen = self.place(pressure_pa, temperature), self.points(bands)
        found = np.zeros((len(chosen), len(pressure_pa)))
        for band in np.unique(self.band_of[chosen]):
            rows, of_band = np.flatnonzero(self.band_of[chosen] == band), np.flatnonzero(self.band_of == band)
            for upper in (0, 1):
                levels = np.flatnonzero(place.upper == bool(upper))
                if levels.size:
                    own = _part(place, levels)
                    mixed = self._mixed(band, upper, own, mixing, levels)
                    found[np.ix_(rows, levels)] = self._looked_up(self.share, of_band, own, mixed, weighted=False).T
        return found

    def radiance(self, temperature: Floats) -> Floats:
        """Return a blackbody's radiance in each band, (..., B) [W m⁻² sr⁻¹]."""
        return np.stack([np.interp(temperature, self.planck_k, each) for each in self.planck], axis=-1)

    def _mixed(
        self, band: int, upper: int, place: Place, mixing: Mapping[str, Floats], levels: NDArray[np.intp]
    ) -> list[tuple[Floats, NDArray[np.intp], Floats]]:
        """[(amount of both key species, index of η, fraction)] at the temperatures below and above."""
        one, other = (self._of(number, mixing, levels) for number in self.key[band, upper])
        found = []
        for more in (0, 1):
            ratio = self.ratio[place.temperature[0] + more, :, upper][:, self.key[band, upper]]
            amount = one + ratio[:, 0] / ratio[:, 1] * other
            known = amount > 0.0
            eta = np.where(known, one / np.where(known, amount, 1.0), 0.5) * (self.major.shape[2] - 1)
            index = np.minimum(eta.astype(np.intp), self.major.shape[2] - 2)
            found.append((amount, index, eta - index))
        return found

    def _of(self, number: int, mixing: Mapping[str, Floats], levels: NDArray[np.intp]) -> Floats:
        """Mixing ratio of a gas by its number; 0 is dry air."""
        if number == 0:
            return np.ones(len(levels))
        given = mixing.get(self.gases[number - 1])
        return np.zeros(len(levels)) if given is None else given[levels]

    def _looked_up(
        self, table: Floats, points: NDArray[np.intp], place: Place,
        mixed: list[tuple[Floats, NDArray[np.intp], Floats]], weighted: bool,
    ) -> Floats:  # fmt: skip
        """Values (L, g) of a table (T, P + 1, η, G), times the amounts of the key species if `weighted`."""
        row, up = place.pressure
        first, warm = place.temperature
        part = table[..., points[0] : points[-1] + 1]
        found = np.zeros((len(row), len(points)))
        for more, (amount, index, fraction) in enumerate(mixed):
            of_t = warm if more else 1.0 - warm
            for high, of_p in ((0, 1.0 - up), (1, up)):
                for further, of_eta in ((0, 1.0 - fraction), (1, fraction)):
                    weight = of_t * of_p * of_eta * (amount if weighted else 1.0)
                    found += weight[:, None] * part[first + more, row + high, index + further]
        return found


def _part(place: Place, levels: NDArray[np.intp]) -> Place:
    return Place(
        (place.temperature[0][levels], place.temperature[1][levels]),
        (place.pressure[0][levels], place.pressure[1][levels]), place.upper[levels],
    )  # fmt: skip


def _minor_at(section: Floats, place: Place, mixed: list[tuple[Floats, NDArray[np.intp], Floats]]) -> Floats:
    """Cross sections (L, g) of a minor gas."""
    first, warm = place.temperature
    found = np.zeros((len(first), section.shape[-1]))
    for more, (_, index, fraction) in enumerate(mixed):
        of_t = warm if more else 1.0 - warm
        for further, of_eta in ((0, 1.0 - fraction), (1, fraction)):
            found += (of_t * of_eta)[:, None] * section[first + more, index + further]
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
