"""Air between camera and ground: transmittance, emission and sky radiance per spectral node.

A node is a group of wavelengths of one sub-band that absorb alike at every level: merged g points of a k-distribution
(`atmosphere.nodes`). It has the share `weight` of the sub-band's Planck radiance. Its absorption coefficient is a sum
over absorbers, each a density by altitude times a constant of the node; the air of a column has one absorber per node,
gases and aerosol together. Beer's law is exact within a node, so transmittances of consecutive paths multiply, and air
as warm as its background is invisible. Multiply per node, then sum over nodes: products of band-averaged transmittances
are wrong.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from os import PathLike
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.atmosphere import rays
from thermorender.atmosphere.air_column import AEROSOL_CM1, YEAR, AirColumn, exponential
from thermorender.atmosphere.checks import check_altitudes, check_within, not_covered
from thermorender.atmosphere.emission import ALTITUDE_M, Profile, amounts, emission
from thermorender.atmosphere.gpoints import GPoints
from thermorender.atmosphere.nodes import REFERENCE_K, nodes_of, share_change
from thermorender.atmosphere.standards import standard_aerosol, standard_column
from thermorender.atmosphere.table_files import NAMES, read_saved
from thermorender.errors import ThermorenderError
from thermorender.files import atomic
from thermorender.physics.planck import spectral_radiance

Floats = NDArray[np.float64]

LOWEST_M, HIGHEST_CAMERA_M = -500.0, 3.0e4
# Levels of a column beside its own: every eighth of those that paths are integrated on.
LEVELS_M = ALTITUDE_M[::8]
# Most levels of a column's own that count, and least pressure at its lowest level [Pa]: that of 9 km.
_MOST_LEVELS, _LEAST_PA = 300, 3e4
_HAZES = len(AEROSOL_CM1) - 1
# Steps of a path in ln(3 km + altitude). A thousand steps change the light of tested paths by less than 10 mK.
_STEP = 0.08
# Paths per batch, so that intermediate values stay in the processor's cache.
_CHUNK = 128
_PLANCK_NODE, _PLANCK_WEIGHT = np.polynomial.legendre.leggauss(6)


# Compared by identity, as all values that hold arrays.
@dataclass(frozen=True, repr=False, eq=False)
class Atmosphere:
    """Absorbing and emitting air over a spherical Earth.

    Attributes
    ----------
    lower_um, upper_um : (N,) float64
        Sub-band of each node [µm].
    weight : (N,) float64
        Share of the sub-band's Planck radiance at 285 K; sums to 1 over each sub-band.
    tilt : (N, P) float64
        Changes the share with temperature (`nodes.share_change`): first the wavenumber of the node's light minus that
        of mid-sub-band [µm⁻¹].
    altitude_m : (L,) float64
        Levels above sea level, rising from 0.
    temperature : (L,) float64
        Of the air at the levels [K]; linear between them.
    density : (J, L) float64
        Scaled density of each absorber; exponential between levels.
    absorption : (N, J) float64
        Absorption coefficient of each node [m⁻¹] per density of each absorber.
    cloud_fraction, cloud_base_m : float
        Share of the sky covered by black clouds, and the altitude of their base above sea level.

    Notes
    -----
    Paths are chords of a sphere, valid from sea level (the air below is that at sea level) to 100 km. Clouds are
    modelled from below only, because a cloud cover has neither positions nor thickness. With clouds, camera, ground
    and objects must therefore be below their base.
    """

    lower_um: Floats
    upper_um: Floats
    weight: Floats
    tilt: Floats
    altitude_m: Floats
    temperature: Floats
    density: Floats
    absorption: Floats
    cloud_fraction: float = 0.0
    cloud_base_m: float = 2000.0

    if TYPE_CHECKING:
        # Set with the fields, and not fields themselves.
        _source: ClassVar[tuple[AirColumn, Floats | None, GPoints | None] | None]
        _bands: ClassVar[Floats]
        _band_of: ClassVar[NDArray[np.intp]]
        _profile: ClassVar[Profile]

    def __post_init__(self) -> None:
        for name in NAMES:
            values = np.array(getattr(self, name), np.float64)
            values.flags.writeable = False
            # The dataclass is frozen, so values are set this way.
            object.__setattr__(self, name, values)
        # AirColumn, aerosol and own tables that the arrays follow from; copies with other arrays have none.
        object.__setattr__(self, "_source", None)
        limits = np.stack([self.lower_um, self.upper_um], axis=1)
        bands, which = np.unique(limits, axis=0, return_inverse=True)
        object.__setattr__(self, "_bands", bands)
        object.__setattr__(self, "_band_of", which.reshape(-1))
        density = exponential(ALTITUDE_M, self.altitude_m, self.density).T.copy()
        planck = self.planck(np.interp(ALTITUDE_M, self.altitude_m, self.temperature))
        object.__setattr__(self, "_profile", Profile.of(density, planck))

    def __repr__(self) -> str:
        clouds = f", {self.cloud_fraction:.0%} clouds at {self.cloud_base_m:.0f} m" if self.cloud_fraction else ""
        passed = self.transmittance(0.0, 0.0, 1000.0) @ self.planck(REFERENCE_K) / self.planck(REFERENCE_K).sum()
        return (
            f"Atmosphere({self.lower_um.min():g}–{self.upper_um.max():g} µm in {self.nodes} nodes, "
            f"{self.temperature[0]:.1f} K at the ground, transmittance {passed:.3f} over 1 km there{clouds})"
        )

    @classmethod
    def standard(
        cls, name: str = "us-1976", aerosol: str = "none", temperature_offset_k: float = 0.0,
        humidity_factor: float = 1.0, cloud_fraction: float = 0.0, cloud_base_m: float = 2000.0,
        year: float = YEAR, gases: Mapping[str, float] | None = None,
    ) -> "Atmosphere":  # fmt: skip
        """Return one of the six standard atmospheres.

        Parameters
        ----------
        name : str
            tropical, midlatitude-summer, midlatitude-winter, subarctic-summer, subarctic-winter or us-1976.
        aerosol : str
            none, rural-23km, rural-5km, maritime-23km or urban-5km: type and visibility at the ground.
        temperature_offset_k : float
            Added to the air's temperature at every altitude, −40 … 40 K; pressure and mixing ratios do not change.
        humidity_factor : float
            Multiplies the water vapour at every altitude, 0 … 5, up to saturation.
        cloud_fraction : float
            Share of the sky covered by black clouds, 0 … 1.
        cloud_base_m : float
            Altitude of their base above sea level, 0 … 15 km; clouds have the air temperature there. With clouds,
            cameras, ground and objects must be below it.
        year : float
            Of the well-mixed gases, up to 2040.
        gases : dict, optional
            Amounts of well-mixed gases instead: {"co2_ppm": 500.0, "ch4_ppb": 1950.0, …}.

        Raises
        ------
        ThermorenderError
            A name is unknown or a value is out of range.

        Notes
        -----
        Anderson et al. (1986), AFGL Atmospheric Constituent Profiles, AFGL-TR-86-0110; Kneizys et al. (1988),
        Users Guide to LOWTRAN 7, AFGL-TR-88-0177. The aerosol grows with the humidity of the standard atmosphere,
        without `humidity_factor`.
        """
        column = standard_column(name, temperature_offset_k, humidity_factor, year, gases)
        extinction = None if aerosol == "none" else standard_aerosol(name, aerosol)
        return cls.of_column(column, extinction=extinction).clouded(cloud_fraction, cloud_base_m)

    @classmethod
    def of_column(
        cls, column: AirColumn, band_um: tuple[float, float] | None = None, extinction: Floats | None = None,
        tables: GPoints | None = None,
    ) -> "Atmosphere":  # fmt: skip
        """Return the air of an AirColumn in a camera's band [µm], or over 6.8–15.9 µm.

        Parameters
        ----------
        column : AirColumn
        band_um : (float, float), optional
        extinction : (bands, L) array, optional
            Of an aerosol at the column's levels [m⁻¹], in the bands of `air_column.AEROSOL_CM1`.

        tables : GPoints, optional
            Of the gases, instead of the package's.

        Raises
        ------
        ThermorenderError
            The gases' tables do not cover the band.

        Notes
        -----
        `in_band` computes the nodes of another band from the column again, also of a saved atmosphere. The sub-bands of
        air without a column are cut, as if each node's light were spread evenly over its sub-band.
        """
        own_tables, tables = tables, tables or GPoints.shipped(band_um)
        _check_column(column, extinction, tables)
        # Of a sounding in thousands of levels every few, and the last.
        own = np.append(column.altitude_m[: -1 : 1 + len(column.altitude_m) // _MOST_LEVELS], column.altitude_m[-1])
        levels = np.union1d(LEVELS_M[own[-1] > LEVELS_M], own)
        fine = column.at(levels)
        nodes = nodes_of(tables, fine, band_um)
        density = nodes.absorption
        if extinction is not None:
            density = density + nodes.of_spectrum(AEROSOL_CM1, exponential(levels, column.altitude_m, extinction))
        found = cls(
            nodes.lower_um, nodes.upper_um, nodes.weight, nodes.tilt, levels, fine.temperature, density,
            np.eye(len(nodes.weight)),
        )  # fmt: skip
        object.__setattr__(found, "_source", (column, extinction, own_tables))
        return found

    @classmethod
    def load(cls, path: str | PathLike[str]) -> "Atmosphere":
        """Return the atmosphere of a file written by `save`.

        Raises
        ------
        ThermorenderError
            The file is missing or not such a table, or one of its arrays is invalid.
        """
        arrays, cloud, source = read_saved(path)
        values: dict[str, Any] = dict(arrays)
        try:
            found = cls(**values)
            if source is not None:
                (altitude, pressure, temperature), gas, mixing, extinction = source
                column = AirColumn(altitude, pressure, temperature, dict(zip(gas, mixing, strict=True)))
                _check_column(column, extinction, GPoints.shipped())
                object.__setattr__(found, "_source", (column, extinction if extinction.any() else None, None))
            return found.clouded(*cloud)
        except ThermorenderError as error:
            raise ThermorenderError(f"atmosphere {path}: {error}") from None

    def save(self, path: str | PathLike[str]) -> None:
        """Write the atmosphere to an .npz file of plain arrays, with its column where it has one."""
        arrays: dict[str, Any] = {name: getattr(self, name) for name in NAMES}
        if self._source is not None:
            column, extinction, _ = self._source
            arrays |= {
                "column": np.stack([column.altitude_m, column.pressure_pa, column.temperature]),
                "gas": np.array([*column.mixing]),
                "mixing": np.stack([*column.mixing.values()]),
                "extinction": np.zeros((_HAZES, len(column.altitude_m))) if extinction is None else extinction,
            }
        with atomic(path) as part, open(part, "wb") as file:
            np.savez_compressed(file, **arrays, cloud=[self.cloud_fraction, self.cloud_base_m])

    def clouded(self, cloud_fraction: float, cloud_base_m: float = 2000.0) -> "Atmosphere":
        """Return this air with a cloud cover of 0 … 1 and a cloud base 0 … 15 km above sea level."""
        check_within("cloud_fraction", cloud_fraction, 0.0, 1.0, "share of the sky")
        check_within("cloud_base_m", cloud_base_m, 0.0, 1.5e4, "metres above sea level")
        if (cloud_fraction, cloud_base_m) == (self.cloud_fraction, self.cloud_base_m):
            return self
        found = replace(self, cloud_fraction=float(cloud_fraction), cloud_base_m=float(cloud_base_m))
        object.__setattr__(found, "_source", self._source)
        return found

    def in_band(self, lower_um: float, upper_um: float) -> "Atmosphere":
        """Return this atmosphere limited to a camera's band [µm], sub-bands cut at its limits.

        Raises
        ------
        ThermorenderError
            The table does not cover the band, or absorbs nothing in it.
        """
        if not lower_um < upper_um:
            raise ThermorenderError(
                f"the camera's band {lower_um:g}–{upper_um:g} µm is empty; give the shorter wavelength first"
            )
        if (lower_um, upper_um) == (self.lower_um.min(), self.upper_um.max()):
            return self._absorbing(self.absorption, lower_um, upper_um)
        if self._source is not None:
            column, extinction, tables = self._source
            found = self.of_column(column, (lower_um, upper_um), extinction, tables)
            return found.clouded(self.cloud_fraction, self.cloud_base_m)
        first, last = self.lower_um.min(), self.upper_um.max()
        if not first - 1e-9 <= lower_um < upper_um <= last + 1e-9:
            raise not_covered(f"{first:g}–{last:g}", (lower_um, upper_um))
        kept = (self.upper_um > lower_um + 1e-9) & (self.lower_um < upper_um - 1e-9)
        absorption = self.absorption[kept]
        self._absorbing(absorption, lower_um, upper_um)
        used = (absorption > 0.0).any(axis=0)
        return replace(
            self,
            lower_um=np.maximum(self.lower_um[kept], lower_um),
            upper_um=np.minimum(self.upper_um[kept], upper_um),
            weight=self.weight[kept],
            tilt=self.tilt[kept],
            density=self.density[used],
            absorption=absorption[:, used],
        )

    @property
    def ceiling_m(self) -> float:
        """Highest altitude of a camera above sea level [m]: 30 km, or the cloud base if there are clouds."""
        return min(HIGHEST_CAMERA_M, self.cloud_base_m) if self.cloud_fraction else HIGHEST_CAMERA_M

    def refuse_above_clouds(self, what: str, altitude_m: ArrayLike) -> None:
        """Refuse altitudes [m] above the cloud base; the message begins with `what`."""
        highest = np.max(np.asarray(altitude_m, np.float64), initial=-np.inf)
        if self.cloud_fraction and highest > self.cloud_base_m:
            raise ThermorenderError(
                f"{what} is {highest:.7g} m above sea level, above the cloud base at {self.cloud_base_m:g} m; clouds "
                "are modelled from below only: stay below them, raise cloud_base_m or set cloud_fraction to 0"
            )

    def _absorbing(self, absorption: Floats, lower_um: float, upper_um: float) -> "Atmosphere":
        """Return this atmosphere, or refuse one whose nodes absorb nothing."""
        if not (absorption @ self.density).any():
            raise ThermorenderError(
                f"the atmosphere absorbs nothing over {lower_um:g}–{upper_um:g} µm (absorption times density is 0), so "
                "it has no sky; give the absorption of the gases, or [sky] with a temperature for a scene without air"
            )
        return self

    def with_tables(self, change: Callable[[GPoints], GPoints]) -> "Atmosphere":
        """Return this air of a column with changed tables of the gases, in the same band and with the same nodes."""
        assert self._source is not None
        column, extinction, tables = self._source
        band = float(self.lower_um.min()), float(self.upper_um.max())
        tables = change(tables or GPoints.shipped(band))
        return self.of_column(column, band, extinction, tables).clouded(self.cloud_fraction, self.cloud_base_m)

    @property
    def column(self) -> AirColumn | None:
        """Pressure, temperature and gases that the air follows from; None for that of a file or of other arrays."""
        return self._source[0] if self._source else None

    @property
    def nodes(self) -> int:
        """Number of spectral nodes N."""
        return len(self.weight)

    def planck(self, temperature: ArrayLike) -> Floats:
        """Return a blackbody's radiance in each node, (..., N) [W m⁻² sr⁻¹]: share × sub-band integral.

        Notes
        -----
        The integral has six Gauss–Legendre points per sub-band, exact to 1e-9 from 150 K. The share is the weight
        times `nodes.share_change`, normalised over the sub-band, for a node whose light is not at its middle.
        """
        half = 0.5 * (self._bands[:, 1] - self._bands[:, 0])
        wavelength = self._bands.mean(axis=1)[:, None] + half[:, None] * _PLANCK_NODE
        temperature = np.asarray(temperature, dtype=np.float64)
        band = spectral_radiance(wavelength, temperature[..., None, None]) @ _PLANCK_WEIGHT * half
        return self.shares(temperature) * band[..., self._band_of]

    def shares(self, temperature: ArrayLike) -> Floats:
        """Return each node's share of a blackbody's radiance in its sub-band, (..., N)."""
        temperature = np.asarray(temperature, dtype=np.float64)[..., None]
        share = self.weight * share_change(self.tilt, temperature)
        return share / (share @ np.equal.outer(self._band_of, np.arange(len(self._bands))))[..., self._band_of]

    def air_temperature(self, at_m: ArrayLike) -> Floats:
        """Return the air's temperature at altitudes above sea level [K], in their shape."""
        return np.interp(_floats(at_m), self.altitude_m, self.temperature)

    def amounts(self, from_m: ArrayLike, to_m: ArrayLike, range_m: ArrayLike) -> Floats:
        """Return the absorbers' amounts along straight paths, (..., J): integral of density over metres.

        Parameters as in `transmittance`.
        """

        def total(*path: Floats) -> Floats:
            return amounts(self._profile, *path).sum(axis=(0, 1))

        # Amounts are exact in a step of any height; steps are needed only for the Earth's curvature.
        return self._along(from_m, to_m, range_m, total, 4.0 * _STEP)

    def transmittance(self, from_m: ArrayLike, to_m: ArrayLike, range_m: ArrayLike) -> Floats:
        """Return the transmittance of straight paths, (..., N).

        Parameters
        ----------
        from_m, to_m : array
            Altitudes of the camera and of the target above sea level [m], up to 100 km.
        range_m : array
            Length of the path [m]; at least the difference of the altitudes, and at most `rays.LONGEST_M`, 2430 km.

        Raises
        ------
        ThermorenderError
            A path is shorter than the difference of its altitudes, or an altitude is out of range or above the cloud
            base.

        Notes
        -----
        The path is a chord of a sphere. Altitudes along it are exact (Stewart's theorem); amounts neglect part of the
        curvature within a step.
        """
        return np.exp(-(self.amounts(from_m, to_m, range_m) @ self.absorption.T))

    def path_radiance(self, from_m: ArrayLike, to_m: ArrayLike, range_m: ArrayLike) -> Floats:
        """Return the radiance emitted towards the camera by the air on straight paths, (..., N) [W m⁻² sr⁻¹].

        Parameters and errors as in `transmittance`.

        Notes
        -----
        L = ∫ B(T(s)) (−dτ/ds) ds, integrated by parts: B(0) − B(S) τ(S) + ∫ τ dB, with B a parabola over each step.
        In isothermal air the last term vanishes and L = B (1 − τ) to rounding.
        """
        return self.path(from_m, to_m, range_m)[1]

    def path(self, from_m: ArrayLike, to_m: ArrayLike, range_m: ArrayLike) -> tuple[Floats, Floats]:
        """Return (`transmittance`, `path_radiance`) of straight paths, in the time of the second alone."""
        both = self._along(from_m, to_m, range_m, lambda *path: np.hstack(self._sum(*path)))
        return both[..., : self.nodes], both[..., self.nodes :]

    def sky_temperature(self, at_m: float) -> float:
        """Return the temperature [K] of the blackbody sky with the same irradiance on level ground, at least 100 K.

        Parameters
        ----------
        at_m : float
            Altitude above sea level [m].
        """
        cosine, weight = np.polynomial.legendre.leggauss(6)
        cosine = 0.5 * (cosine + 1.0)
        radiance = (weight * cosine) @ self.sky_radiance(np.full(len(cosine), at_m), cosine).sum(axis=-1)
        kelvin = np.linspace(100.0, 330.0, 4601)
        return float(np.interp(radiance, self.planck(kelvin).sum(axis=-1), kelvin))

    def sky_radiance(self, at_m: ArrayLike, cos_zenith: ArrayLike) -> Floats:
        """Return the sky's radiance at a point, (..., N) [W m⁻² sr⁻¹], clouds included.

        Parameters
        ----------
        at_m : array
            Altitude of the observer above sea level [m], up to 30 km or the cloud base.
        cos_zenith : array
            Cosine of the zenith angle of the viewing direction: 1 straight up, slightly negative between the level
            and the horizon of a raised observer (`rays.horizon_cos_zenith`).

        Raises
        ------
        ThermorenderError
            A direction is below the horizon, or an altitude is out of range.

        Notes
        -----
        Clouds are black at their base, seen through the air below.
        """
        self.refuse_above_clouds("at_m", at_m)
        _, sky = self._column(at_m, cos_zenith, rays.TOP_M)
        if self.cloud_fraction:
            through, light = self._column(at_m, cos_zenith, self.cloud_base_m)
            cloudy = light + through * self.planck(self.air_temperature(self.cloud_base_m))
            sky = (1.0 - self.cloud_fraction) * sky + self.cloud_fraction * cloudy
        return sky

    def sun_transmittance(self, at_m: ArrayLike, cos_zenith: ArrayLike) -> Floats:
        """Return the transmittance from a point to space without clouds, (..., N); parameters as in `sky_radiance`."""
        return self._column(at_m, cos_zenith, rays.TOP_M)[0]

    def _along(
        self, from_m: ArrayLike, to_m: ArrayLike, range_m: ArrayLike, function: Callable[[Floats, Floats], Floats],
        step: float = _STEP,
    ) -> Floats:  # fmt: skip
        """Values (..., n) of a function of (altitude, length) from `rays.chord`, in batches of paths."""
        first, last, distance = np.broadcast_arrays(*(_floats(value) for value in (from_m, to_m, range_m)))
        for name, values in (("from_m", first), ("to_m", last)):
            check_altitudes(name, values, LOWEST_M, rays.TOP_M)
            self.refuse_above_clouds(name, values)
        short = ~(np.abs(last - first) <= distance * (1.0 + 1e-6) + 1e-6)
        if short.any():
            raise ThermorenderError(
                f"range_m={distance[short].flat[0]:g} is shorter than the difference of from_m="
                f"{first[short].flat[0]:g} and to_m={last[short].flat[0]:g}; give the length of the path in metres"
            )
        if (distance > rays.LONGEST_M).any():
            raise ThermorenderError(
                f"range_m={distance.max():g} is longer than any line of sight in the air, "
                f"{rays.LONGEST_M:.3g} m; give the length of the path in metres"
            )
        one, other, length = (values.reshape(-1) for values in (first, last, distance))
        parts = [slice(start, start + _CHUNK) for start in range(0, max(distance.size, 1), _CHUNK)]
        result = np.concatenate([function(*rays.chord(one[part], other[part], length[part], step)) for part in parts])
        return result.reshape(*distance.shape, -1)

    def _column(self, at_m: ArrayLike, cos_zenith: ArrayLike, top_m: float) -> tuple[Floats, Floats]:
        """(transmittance, emission) from a point along a direction up to an altitude, each (..., N)."""
        at, cosine = np.broadcast_arrays(_floats(at_m), _floats(cos_zenith))
        check_altitudes("at_m", at, LOWEST_M, HIGHEST_CAMERA_M)
        lowest = rays.horizon_cos_zenith(at)
        if np.any((cosine < lowest - 1e-9) | (cosine > 1.0 + 1e-9)) or np.isnan(cosine).any():
            worst = np.argmax(np.nan_to_num(np.maximum(lowest - cosine, cosine - 1.0), nan=np.inf))
            raise ThermorenderError(
                f"cos_zenith={cosine.flat[worst]:g} is not a direction of the sky; at {at.flat[worst]:g} m give "
                f"{lowest.flat[worst]:.6g} (the horizon) to 1 (straight up)"
            )
        shape, at, cosine = at.shape, np.maximum(at, 0.0).reshape(-1), cosine.reshape(-1)
        altitude, length = rays.outward(at, cosine, top_m)
        through, light = self._sum(altitude, length)
        return through.reshape(*shape, -1), light.reshape(*shape, -1)

    def _sum(self, altitude: Floats, length: Floats) -> tuple[Floats, Floats]:
        """(transmittance, emission), each (P, N), along rays."""
        return emission(self._profile, self.absorption, altitude, length, amounts(self._profile, altitude, length))


def _check_column(column: AirColumn, extinction: Floats | None, tables: GPoints) -> None:
    """Refuse a column that is not one of air from the ground up."""
    levels = len(column.altitude_m)
    if levels < 2:
        raise ThermorenderError(f"AirColumn has {levels} levels; give at least 2")
    if column.pressure_pa[0] < _LEAST_PA:
        raise ThermorenderError(
            f"AirColumn: pressure_pa is {column.pressure_pa[0]:g} at the lowest level; give pascals, at least "
            f"{_LEAST_PA:g} there"
        )
    other = [gas for gas in column.mixing if gas not in tables.gases]
    if other:
        raise ThermorenderError(
            f"AirColumn: mixing has the gas {other[0]!r}; the tables know {', '.join(tables.gases)}"
        )
    if extinction is not None and np.shape(extinction) != (_HAZES, levels):
        raise ThermorenderError(
            f"extinction has the shape {np.shape(extinction)}; give ({_HAZES}, {levels}), bands and levels of aerosol"
        )


def _floats(values: ArrayLike) -> Floats:
    return np.array(values, np.float64)
