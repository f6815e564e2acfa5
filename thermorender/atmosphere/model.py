"""Air between camera and ground: transmittance, its own emission and the sky, per spectral node.

A node is one absorption term of one sub-band: of the sub-band's Planck radiance it holds the share `weight`, and
its absorption coefficient at every altitude is a sum over absorbers (water lines, water continuum, carbon dioxide,
ozone, nitrous oxide, methane, nitric acid, aerosol), each a scaled density times a constant of the node. Within a
node Beer's law holds exactly, so transmittances of adjoining paths multiply, and air as warm as what stands behind
it is invisible. Products are taken per node and summed over nodes last; a band average of transmittance is wrong
to multiply with.

The constants are fitted to LOWTRAN7 (`atmosphere.lowtran.fit`). Fitted are paths of 100 m and more; shorter ones follow
from the same terms, where LOWTRAN's own band model absorbs too much.
"""

from dataclasses import dataclass, replace

import numpy as np

from thermorender.atmosphere import rays
from thermorender.atmosphere.absorbers import exponential, offset_water, scaled_densities
from thermorender.atmosphere.emission import ALTITUDE_M, Profile, amounts, emission
from thermorender.atmosphere.tables import NAMES, read_saved, read_table
from thermorender.errors import ThermorenderError
from thermorender.files import atomic
from thermorender.physics.planck import C2, spectral_radiance

# Temperature at which nodes' weights are shares of their sub-band.
REFERENCE_K = 285.0
LOWEST_M, HIGHEST_CAMERA_M = -500.0, 3.0e4
# Steps of a path in ln(3 km + altitude); finer ones change no result by more than 6 mK, and near the ground by 1 mK.
_STEP = 0.08
# Paths handled at a time, so that intermediate values stay in the processor's cache.
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
        Share of its sub-band's Planck radiance at 285 K that a node stands for; sums to 1 over each sub-band.
    tilt : (N,) float64
        How the share changes with temperature [µm⁻¹]: the wavenumber of the node's light, from mid-sub-band.
    altitude_m : (L,) float64
        Levels above sea level, rising from 0.
    temperature : (L,) float64
        Of the air at the levels [K]; linear between them.
    density : (J, L) float64
        Scaled density of each absorber; exponential between levels.
    absorption : (N, J) float64
        Absorption coefficient of each node [m⁻¹] per density of each absorber.
    cloud_fraction, cloud_base_m : float
        Share of the sky that black clouds cover, and the altitude of their base above sea level.

    Notes
    -----
    Paths are valid from sea level (the air below is that at sea level) to 100 km, for chords of a sphere. Clouds are
    known from below only: a share of the sky says neither where they are nor how thick, which is what decides what is
    seen from above or from within. So under clouds nothing may lie above their base, neither camera nor ground.
    """

    lower_um: np.ndarray
    upper_um: np.ndarray
    weight: np.ndarray
    tilt: np.ndarray
    altitude_m: np.ndarray
    temperature: np.ndarray
    density: np.ndarray
    absorption: np.ndarray
    cloud_fraction: float = 0.0
    cloud_base_m: float = 2000.0

    def __post_init__(self):
        limits = np.stack([self.lower_um, self.upper_um], axis=1)
        bands, which = np.unique(limits, axis=0, return_inverse=True)
        # A frozen dataclass keeps what is derived under names of its own.
        object.__setattr__(self, "_bands", bands)
        object.__setattr__(self, "_band_of", which.reshape(-1))
        density = exponential(ALTITUDE_M, self.altitude_m, self.density).T.copy()
        planck = self.planck(np.interp(ALTITUDE_M, self.altitude_m, self.temperature))
        object.__setattr__(self, "_profile", Profile.of(density, planck))

    def __repr__(self):
        clouds = f", {self.cloud_fraction:.0%} clouds at {self.cloud_base_m:.0f} m" if self.cloud_fraction else ""
        passed = self.transmittance(0.0, 0.0, 1000.0) @ self.planck(REFERENCE_K) / self.planck(REFERENCE_K).sum()
        return (
            f"Atmosphere({self.lower_um.min():g}–{self.upper_um.max():g} µm in {self.nodes} nodes, "
            f"{self.temperature[0]:.1f} K at the ground, transmittance {passed:.3f} over 1 km there{clouds})"
        )

    @classmethod
    def standard(
        cls,
        name="us-1976",
        aerosol="none",
        temperature_offset_k=0.0,
        humidity_factor=1.0,
        cloud_fraction=0.0,
        cloud_base_m=2000.0,
        table=None,
    ):
        """Return one of the six standard atmospheres of LOWTRAN7.

        Parameters
        ----------
        name : str
            tropical, midlatitude-summer, midlatitude-winter, subarctic-summer, subarctic-winter or us-1976.
        aerosol : str
            none, rural-23km, rural-5km, maritime-23km or urban-5km: type and visibility at the ground.
        temperature_offset_k : float
            Added to the air's temperature at every altitude, −40 … 40 K; pressure and mixing ratios stay.
        humidity_factor : float
            Multiplies the water vapour at every altitude, 0 … 5; what exceeds saturation is left out.
        cloud_fraction : float
            Share of the sky covered by black clouds, 0 … 1.
        cloud_base_m : float
            Altitude of their base above sea level, 0 … 15 km; they are as warm as the air there. Under clouds whose
            share is not 0 cameras, ground and objects stay below it.
        table : dict, optional
            As from `read_table`, in place of the shipped one.

        Raises
        ------
        ThermorenderError
            An unknown name or a value out of range.

        Notes
        -----
        Anderson et al. (1986), AFGL Atmospheric Constituent Profiles, AFGL-TR-86-0110; Kneizys et al. (1988),
        Users Guide to LOWTRAN 7, AFGL-TR-88-0177. The aerosol's growth with humidity is that of the standard
        atmosphere, whatever `humidity_factor` is.
        """
        table = table or read_table()
        model = name_index("standard", name, table["model"])
        haze = name_index("aerosol", aerosol, table["aerosol"])
        check_within("temperature_offset_k", temperature_offset_k, -40.0, 40.0, "kelvin")
        check_within("humidity_factor", humidity_factor, 0.0, 5.0, "times the standard water vapour")
        pressure, temperature = np.float64(table["pressure_hpa"][model]), np.float64(table["temperature"][model])
        gas = np.float64(table["gas"][model])
        warmer, water = offset_water(temperature, gas[0], temperature_offset_k, humidity_factor)
        gas *= temperature / warmer
        gas[0] = water
        gases = scaled_densities(pressure, warmer, gas)
        extinction = np.float64(table["extinction"][model, haze])
        factor = table["aerosol_factor"][haze]
        result = cls.of_table(table, np.float64(table["altitude_m"]), warmer, gases, extinction, factor)
        return result.clouded(cloud_fraction, cloud_base_m)

    @classmethod
    def of_table(cls, table, altitude_m, temperature, gases, extinction, factor):
        """Return the atmosphere of the shipped nodes and of own air.

        Parameters
        ----------
        table : dict
            From `read_table`.
        altitude_m, temperature : (L,) arrays
        gases : (11, L) array
            From `scaled_densities`.
        extinction : (sub-bands, L) array
            Of the aerosol [m⁻¹], mean over each sub-band.
        factor : (N,) array
            Of each node on the aerosol's extinction.
        """
        _, band_of = np.unique(table["lower_um"], return_inverse=True)
        own = (band_of.reshape(-1)[:, None] == np.arange(len(extinction))) * np.float64(factor)[:, None]
        return cls(
            *(np.float64(table[key]) for key in ("lower_um", "upper_um", "weight", "tilt")),
            altitude_m=altitude_m,
            temperature=temperature,
            density=np.concatenate([gases, extinction]),
            absorption=np.hstack([np.float64(table["absorption"]), own]),
        )

    @classmethod
    def load(cls, path):
        """Return the atmosphere that `save` wrote: own weather or an imported table.

        Raises
        ------
        ThermorenderError
            The file is missing or is no such table, or one of its arrays is out of order.
        """
        values, cloud = read_saved(path)
        try:
            return cls(**values).clouded(*cloud)
        except ThermorenderError as error:
            raise ThermorenderError(f"atmosphere {path}: {error}") from None

    def save(self, path):
        """Write the atmosphere to an .npz file of plain arrays."""
        with atomic(path) as part, open(part, "wb") as file:
            np.savez_compressed(
                file, **{name: getattr(self, name) for name in NAMES}, cloud=[self.cloud_fraction, self.cloud_base_m]
            )

    def clouded(self, cloud_fraction, cloud_base_m=2000.0):
        """Return this air under clouds that cover a share 0 … 1 of the sky, base 0 … 15 km above sea level."""
        check_within("cloud_fraction", cloud_fraction, 0.0, 1.0, "share of the sky")
        check_within("cloud_base_m", cloud_base_m, 0.0, 1.5e4, "metres above sea level")
        return replace(self, cloud_fraction=float(cloud_fraction), cloud_base_m=float(cloud_base_m))

    def in_band(self, lower_um, upper_um):
        """Return this atmosphere limited to a camera's band, sub-bands cut at its limits.

        Raises
        ------
        ThermorenderError
            The table does not cover the band.
        """
        first, last = self.lower_um.min(), self.upper_um.max()
        if not first - 1e-9 <= lower_um < upper_um <= last + 1e-9:
            raise ThermorenderError(
                f"the atmosphere covers {first:g}–{last:g} µm, which does not hold the camera's band "
                f"{lower_um:g}–{upper_um:g} µm; give another atmosphere or a narrower band"
            )
        kept = (self.upper_um > lower_um + 1e-9) & (self.lower_um < upper_um - 1e-9)
        absorption = self.absorption[kept]
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
    def ceiling_m(self):
        """Highest altitude of a camera above sea level [m]: 30 km, or the base of the clouds where there are any."""
        return min(HIGHEST_CAMERA_M, self.cloud_base_m) if self.cloud_fraction else HIGHEST_CAMERA_M

    def refuse_above_clouds(self, what, altitude_m):
        """Refuse altitudes above sea level [m] that lie above the base of the clouds; `what` begins the sentence."""
        highest = np.max(altitude_m, initial=-np.inf)
        if self.cloud_fraction and highest > self.cloud_base_m:
            raise ThermorenderError(
                f"{what} is {highest:.7g} m above sea level, above the base of the clouds at {self.cloud_base_m:g} m, "
                "which are known from below only; stay below it, raise cloud_base_m or set cloud_fraction to 0"
            )

    @property
    def nodes(self):
        """Number of spectral nodes N."""
        return len(self.weight)

    def planck(self, temperature):
        """Return a blackbody's radiance in each node, (..., N) [W m⁻² sr⁻¹]: share × sub-band integral.

        Notes
        -----
        The integral is taken with six Gauss–Legendre points per sub-band, exact to 1e-9 from 150 K. The share is
        weight · exp(c₂ tilt (1/285 K − 1/T)), normalised over the sub-band: Wien's law for a node whose light lies
        off the middle of its sub-band.
        """
        half = 0.5 * (self._bands[:, 1] - self._bands[:, 0])
        wavelength = self._bands.mean(axis=1)[:, None] + half[:, None] * _PLANCK_NODE
        temperature = np.asarray(temperature, dtype=np.float64)
        band = spectral_radiance(wavelength, temperature[..., None, None]) @ _PLANCK_WEIGHT * half
        return self.shares(temperature) * band[..., self._band_of]

    def shares(self, temperature):
        """Return the share of each node in a blackbody's radiance over its sub-band, (..., N)."""
        temperature = np.asarray(temperature, dtype=np.float64)[..., None]
        # Tilts are at most half a sub-band, so the exponent stays below 30 from 20 K up.
        share = self.weight * np.exp(C2 * self.tilt * (1.0 / REFERENCE_K - 1.0 / np.maximum(temperature, 20.0)))
        return share / (share @ np.equal.outer(self._band_of, np.arange(len(self._bands))))[..., self._band_of]

    def air_temperature(self, at_m):
        """Return the air's temperature at altitudes above sea level [K], in their shape."""
        return np.interp(at_m, self.altitude_m, self.temperature)

    def amounts(self, from_m, to_m, range_m):
        """Return the absorbers' amounts along straight paths, (..., J): integral of density over metres.

        Parameters as in `transmittance`.
        """

        def total(*path):
            return amounts(self._profile, *path).sum(axis=(0, 1))

        # Amounts are exact in a step of any height, and need steps only against the ray's bend.
        return self._along(from_m, to_m, range_m, total, 4.0 * _STEP)

    def transmittance(self, from_m, to_m, range_m):
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
            A path shorter than its altitudes are apart, or altitudes out of range or above the base of clouds.

        Notes
        -----
        The path is a chord of a sphere at any length, so a horizontal one needs no formula of its own. Altitudes
        along it are exact (Stewart's theorem), and so are amounts but for the bend within a step.
        """
        return np.exp(-(self.amounts(from_m, to_m, range_m) @ self.absorption.T))

    def path_radiance(self, from_m, to_m, range_m):
        """Return what the air along straight paths emits towards the camera, (..., N) [W m⁻² sr⁻¹].

        Parameters and errors as in `transmittance`.

        Notes
        -----
        L = ∫ B(T(s)) (−dτ/ds) ds, integrated by parts: B(0) − B(S) τ(S) + ∫ τ dB, with B a parabola over each step.
        In isothermal air the last term vanishes and L = B (1 − τ) to rounding.
        """
        return self.path(from_m, to_m, range_m)[1]

    def path(self, from_m, to_m, range_m):
        """Return (`transmittance`, `path_radiance`) of straight paths, in the time of the second alone."""
        both = self._along(from_m, to_m, range_m, lambda *path: np.hstack(self._sum(*path)))
        return both[..., : self.nodes], both[..., self.nodes :]

    def sky_temperature(self, at_m):
        """Return the temperature [K] of the blackbody that sends as much onto level ground as the sky, from 100 K on.

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

    def sky_radiance(self, at_m, cos_zenith):
        """Return the sky's radiance at a point, (..., N) [W m⁻² sr⁻¹], clouds included.

        Parameters
        ----------
        at_m : array
            Altitude of the observer above sea level [m], up to 30 km, and to the base of clouds.
        cos_zenith : array
            Cosine of the zenith angle of the direction looked in: 1 straight up, slightly negative for a raised
            observer looking between the level and his horizon (`rays.horizon_cos_zenith`).

        Raises
        ------
        ThermorenderError
            A direction below the horizon, or an altitude out of range.

        Notes
        -----
        Clouds are black at their base, behind the air below it.
        """
        self.refuse_above_clouds("at_m", at_m)
        _, sky = self._column(at_m, cos_zenith, rays.TOP_M)
        if self.cloud_fraction:
            through, light = self._column(at_m, cos_zenith, self.cloud_base_m)
            cloudy = light + through * self.planck(self.air_temperature(self.cloud_base_m))
            sky = (1.0 - self.cloud_fraction) * sky + self.cloud_fraction * cloudy
        return sky

    def sun_transmittance(self, at_m, cos_zenith):
        """Return the transmittance from a point to space between clouds, (..., N); parameters as `sky_radiance`."""
        return self._column(at_m, cos_zenith, rays.TOP_M)[0]

    def _along(self, from_m, to_m, range_m, function, step=_STEP):
        """Values (..., n) of a function of (altitude, length) from `rays.chord`, a few hundred paths at a time."""
        first, last, distance = np.broadcast_arrays(*(np.float64(value) for value in (from_m, to_m, range_m)))
        for name, values in (("from_m", first), ("to_m", last)):
            _altitudes(name, values, rays.TOP_M)
            self.refuse_above_clouds(name, values)
        short = ~(np.abs(last - first) <= distance * (1.0 + 1e-6) + 1e-6)
        if short.any():
            raise ThermorenderError(
                f"range_m={distance[short].flat[0]:g} is shorter than the altitudes from_m={first[short].flat[0]:g} "
                f"and to_m={last[short].flat[0]:g} are apart; give the length of the path in metres"
            )
        if (distance > rays.LONGEST_M).any():
            raise ThermorenderError(
                f"range_m={distance.max():g} is longer than any line of sight in the air, "
                f"{rays.LONGEST_M:.3g} m; give the length of the path in metres"
            )
        flat = [values.reshape(-1) for values in (first, last, distance)]
        parts = [slice(start, start + _CHUNK) for start in range(0, max(distance.size, 1), _CHUNK)]
        result = np.concatenate([function(*rays.chord(*(values[part] for values in flat), step)) for part in parts])
        return result.reshape(*distance.shape, -1)

    def _column(self, at_m, cos_zenith, top_m):
        """(transmittance, emission) from a point along a direction up to an altitude, each (..., N)."""
        at, cosine = np.broadcast_arrays(np.float64(at_m), np.float64(cos_zenith))
        _altitudes("at_m", at, HIGHEST_CAMERA_M)
        lowest = rays.horizon_cos_zenith(at)
        if np.any((cosine < lowest - 1e-9) | (cosine > 1.0 + 1e-9)) or np.isnan(cosine).any():
            worst = np.argmax(np.nan_to_num(np.maximum(lowest - cosine, cosine - 1.0), nan=np.inf))
            raise ThermorenderError(
                f"cos_zenith={cosine.flat[worst]:g} is no direction of the sky; at {at.flat[worst]:g} m give "
                f"{lowest.flat[worst]:.6g} (the horizon) to 1 (straight up)"
            )
        shape, at, cosine = at.shape, np.maximum(at, 0.0).reshape(-1), cosine.reshape(-1)
        altitude, length = rays.outward(at, cosine, top_m)
        values = self._sum(altitude, length)
        return tuple(value.reshape(*shape, -1) for value in values)

    def _sum(self, altitude, length):
        """(transmittance, emission), each (P, N), along rays."""
        return emission(self._profile, self.absorption, altitude, length, amounts(self._profile, altitude, length))


def name_index(what, name, names):
    """Return the index of a name in a list, or refuse it in a sentence that lists the names."""
    names = [str(value) for value in names]
    if name not in names:
        raise ThermorenderError(f"{what}={name!r} is unknown; give one of {', '.join(names)}")
    return names.index(name)


def check_within(name, value, lowest, highest, unit):
    """Refuse a value outside its limits."""
    if not lowest <= value <= highest:
        raise ThermorenderError(f"{name}={value:g} is out of range; give {lowest:g} … {highest:g} ({unit})")


def _altitudes(name, values, highest):
    """Refuse altitudes that are not finite, deep below sea level or above the table."""
    bad = ~((values >= LOWEST_M) & (values <= highest))
    if bad.any():
        raise ThermorenderError(
            f"{name}={values[bad].flat[0]:g} is out of range; give metres above sea level, −{-LOWEST_M:g} … {highest:g}"
        )
