"""Radiance of a real material in a camera's band, emitted and reflected, and the temperature of a radiance."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.physics.planck import band_radiance, brightness_temperature, spectral_radiance

Floats = NDArray[np.float64]
# Emissivity (n,) at wavelengths (n,) [µm].
Emissivity = Callable[[Floats], Floats]

# Over 7.5–13.5 µm, panels end at the points of the material tables, which are 0.05 µm apart.
_PANELS = 240


def quadrature(lower_um: float, upper_um: float, panels: int = _PANELS) -> tuple[Floats, Floats]:
    """Return (wavelength, weight), each (4 × panels,) [µm]: composite 4-point Gauss–Legendre.

    With 240 panels over 7.5–13.5 µm the integral of Planck's law times a measured emissivity (points every 0.05 µm,
    linear between) is exact to 1e-6.
    """
    node, weight = np.polynomial.legendre.leggauss(4)
    edge = np.linspace(lower_um, upper_um, panels + 1)
    half = 0.5 * np.diff(edge)[:, None]
    middle = 0.5 * (edge[:-1] + edge[1:])[:, None]
    return (middle + half * node).ravel(), (half * weight).ravel()


def emitted_radiance(emissivity: Emissivity, temperature: ArrayLike, lower_um: float, upper_um: float) -> Floats:
    """Return the band radiance emitted by a material [W m⁻² sr⁻¹], in the shape of `temperature`.

    Parameters
    ----------
    emissivity : callable
        Wavelengths [µm] → emissivity.
    temperature : array
        Kinetic temperature [K].
    lower_um, upper_um : float
        Limits of the band [µm].

    Notes
    -----
    ∫ ε(λ) B(λ, T) dλ.
    """
    wavelength, weight = quadrature(lower_um, upper_um)
    weight = weight * emissivity(wavelength)
    temperature = np.asarray(temperature, dtype=np.float64)
    return spectral_radiance(wavelength, temperature[..., None]) @ weight


def reflected_radiance(emissivity: Emissivity, temperature: ArrayLike, lower_um: float, upper_um: float) -> Floats:
    """Return the band radiance of a blackbody of `temperature` [K] all around, reflected diffusely [W m⁻² sr⁻¹].

    `emissivity` maps wavelengths [µm] to that of the opaque surface; its reflectance is 1 − ε (Kirchhoff).
    """
    return emitted_radiance(lambda wavelength: 1.0 - emissivity(wavelength), temperature, lower_um, upper_um)


@dataclass(frozen=True)
class RadianceTable:
    """Radiance against temperature on a uniform grid, and its inverse, by linear interpolation.

    Attributes
    ----------
    temperature : (n,) float64
        Increasing, evenly spaced [K].
    radiance : (n,) float64
        Increasing [W m⁻² sr⁻¹].

    Notes
    -----
    The error of linear interpolation at a spacing h is at most h²/8 · L″/L′ kelvin: 4 µK at 300 K and 45 µK at
    100 K for the 0.05 K used here.
    """

    temperature: Floats
    radiance: Floats

    SPACING_K = 0.05

    @classmethod
    def of(
        cls, emissivity: Emissivity, coldest: float, warmest: float, lower_um: float, upper_um: float
    ) -> "RadianceTable":
        """Return the table of a material between two temperatures [K].

        The blackbody's radiance is exact at every entry. The ratio to it varies slowly with temperature: it is
        integrated at 257 temperatures and interpolated linearly between them.
        """
        temperature, black, *_ = _blackbody(float(coldest), float(warmest), lower_um, upper_um)
        return cls(temperature, cls.ratio(emissivity, coldest, warmest, lower_um, upper_um) * black)

    @staticmethod
    def ratio(emissivity: Emissivity, coldest: float, warmest: float, lower_um: float, upper_um: float) -> Floats:
        """Return the radiance of a material over that of a blackbody [1], (n,), at the temperatures of `grid`
        (`coldest`, `warmest`) [K], in the band from `lower_um` to `upper_um` [µm]."""
        temperature, _, coarse, wavelength, share = _blackbody(float(coldest), float(warmest), lower_um, upper_um)
        return np.interp(temperature, coarse, share @ emissivity(wavelength))

    @classmethod
    def grid(cls, coldest: float, warmest: float) -> Floats:
        """Return the evenly spaced temperatures from just below `coldest` to just above `warmest` [K]."""
        coldest, warmest = max(coldest - 0.5, 1.0), warmest + 0.5
        return np.linspace(coldest, warmest, int(np.ceil((warmest - coldest) / cls.SPACING_K)) + 1)

    def __call__(self, temperature: NDArray[np.floating]) -> Floats:
        """Return radiance [W m⁻² sr⁻¹] at temperatures [K]; NaN outside the table."""
        return np.interp(temperature, self.temperature, self.radiance, left=np.nan, right=np.nan)

    def inverse(self, radiance: NDArray[np.floating]) -> Floats:
        """Return temperatures [K] at radiances [W m⁻² sr⁻¹]; NaN outside the table."""
        return np.interp(radiance, self.radiance, self.temperature, left=np.nan, right=np.nan)


@lru_cache(maxsize=16)
def _blackbody(coldest: float, warmest: float, lower_um: float, upper_um: float) -> tuple[Floats, ...]:
    """The values common to all materials: grid, its radiance, coarse temperatures, wavelengths, spectral shares."""
    temperature = RadianceTable.grid(coldest, warmest)
    coarse = np.linspace(temperature[0], temperature[-1], 257)
    wavelength, weight = quadrature(lower_um, upper_um)
    black = band_radiance(coarse, lower_um, upper_um)
    # Near 0 K the radiance is 0 in float64 and has no ratio: the coldest ratio that exists holds there.
    coarse, black = coarse[black > 0.0], black[black > 0.0]
    share = spectral_radiance(wavelength, coarse[:, None]) * weight / black[:, None]
    found = temperature, band_radiance(temperature, lower_um, upper_um), coarse, wavelength, share
    for values in found:
        values.setflags(write=False)
    return found


def kinetic_temperature(
    apparent_radiance: ArrayLike, emissivity: Emissivity, sky_temperature: float, band_um: tuple[float, float],
    range_k: tuple[float, float],
) -> Floats:  # fmt: skip
    """Return the kinetic temperature [K] of a surface from its apparent radiance [W m⁻² sr⁻¹]; NaN outside `range_k`.

    Solves ∫[ε B(T) + (1−ε) B(T_sky)] dλ = L for T, with an isotropic blackbody sky. An error of L grows by 1/ε or more
    in T, so low ε needs the plausible range. `emissivity` maps wavelengths [µm] to ε.
    """
    table = RadianceTable.of(emissivity, *range_k, *band_um)
    emitted = np.asarray(apparent_radiance) - reflected_radiance(emissivity, sky_temperature, *band_um)
    temperature = table.inverse(emitted)
    return np.where((temperature >= range_k[0]) & (temperature <= range_k[1]), temperature, np.nan)


# Leading bits of a float32 that number the steps of `KelvinTable`: sign, exponent and 1024 steps in an octave.
_FRACTION_BITS = 23 - 10
# Its range, and the temperatures between which it is interpolated [K].
_RANGE_K, _KNOTS = (20.0, 5000.0), 8192


@dataclass(frozen=True)
class KelvinTable:
    """Blackbody temperatures on a fixed grid of radiances, whose steps are numbered by the leading bits of a float32.

    Attributes
    ----------
    first : int
        Number of the first step.
    temperature : (n,) float64
        At the beginning of each step [K].
    slope : (n,) float64
        Temperature per unit of the last bit [K].

    Notes
    -----
    A step is at most 1/1024 of its radiance. The error is at most 0.05 mK below 1000 K, in addition to the rounding of
    float32.
    """

    first: int
    temperature: Floats
    slope: Floats

    def kelvin(self, radiance: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Return (temperatures (n,) [K], whether the table has them) of band radiances (n,) [W m⁻² sr⁻¹]."""
        # Bits rise with positive numbers. Those of negative numbers are negative, those of NaN above all others.
        bits = np.ascontiguousarray(radiance, dtype=np.float32).view(np.int32)
        step = (bits >> _FRACTION_BITS) - self.first
        known = (step >= 0) & (step < len(self.slope))
        step = np.where(known, step, 0)
        fraction = bits & ((1 << _FRACTION_BITS) - 1)
        return (self.temperature[step] + fraction * self.slope[step]).astype(np.float32), known


@lru_cache(maxsize=4)
def kelvin_table(lower_um: float, upper_um: float) -> KelvinTable:
    """Return the KelvinTable of a band [µm] for 20 to 5000 [K], as far as float32 holds their radiances."""
    knot = np.geomspace(*_RANGE_K, _KNOTS)
    radiance = band_radiance(knot, lower_um, upper_um)
    # 1/T is nearly straight over ln L.
    held = radiance > np.finfo(np.float32).tiny
    knot, log = knot[held], np.log(radiance[held])
    ends = np.exp(log[[0, -1]]).astype(np.float32).view(np.int32) >> _FRACTION_BITS
    step = np.arange(ends[0] + 1, ends[1], dtype=np.int32)
    edge = (step << _FRACTION_BITS).view(np.float32).astype(np.float64)
    temperature = 1.0 / np.interp(np.log(edge), log, 1.0 / knot)
    return KelvinTable(int(step[0]), temperature[:-1], np.diff(temperature) / (1 << _FRACTION_BITS))


def radiance_of(temperature: NDArray[np.floating], lower_um: float, upper_um: float) -> Floats:
    """Return the band radiance of a picture of blackbodies [W m⁻² sr⁻¹], in the shape of `temperature` [K].

    It is by a table where this has fewer entries than the picture has pixels.
    """
    if not np.ptp(temperature) / RadianceTable.SPACING_K < temperature.size:
        return band_radiance(temperature, lower_um, upper_um)
    grid = RadianceTable.grid(temperature.min(), temperature.max())
    return RadianceTable(grid, band_radiance(grid, lower_um, upper_um))(temperature)


def radiance_in_band(
    radiance: NDArray[np.floating], from_um: tuple[float, float], to_um: tuple[float, float]
) -> NDArray[np.floating]:
    """Return the radiance of the same apparent temperatures in another band, (…) [W m⁻² sr⁻¹]; as given in its own.

    Negative values, which have no temperature, stay negative.
    """
    if tuple(from_um) == tuple(to_um):
        return radiance
    size = np.abs(np.asarray(radiance, np.float64))
    with np.errstate(over="ignore", under="ignore"):
        found, known = kelvin_table(*from_um).kelvin(size.astype(np.float32).ravel())
    kelvin = found.astype(np.float64)
    kelvin[~known] = brightness_temperature(size.ravel()[~known], *from_um)
    # Below 1 K there is no radiance in float64, and no table.
    return np.copysign(radiance_of(np.maximum(kelvin, 1.0), *to_um), np.ravel(radiance)).reshape(size.shape)
