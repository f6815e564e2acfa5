"""A surface material: its emissivity by wavelength and angle, its thermal properties, and where they come from.

A material knows the wavelengths at which it was measured and refuses all others.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.errors import ThermorenderError
from thermorender.materials.csv_tables import LONGEST_WAVELENGTH_UM
from thermorender.materials.thermal import Thermal
from thermorender.physics.planck import spectral_radiance

# Tolerance at the ends of a table: wavelengths computed as 1e4 / wavenumber are off by rounding.
ROUNDING_UM = 1e-9

# Standard deviation assumed for the solar absorptance if the table has none: the spread of samples of one kind.
ASSUMED_SOLAR_STD = 0.05

# Source of a grey material.
_ASSUMED_GREY = "assumed constant"

# With four nodes per panel up to this long, Planck's law is integrated exactly down to 100 K.
LONGEST_PANEL_UM = 0.25
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(4)


@dataclass(frozen=True, eq=False)
class Material:
    """A surface material.

    Attributes
    ----------
    name, title : str
        Name in scene files, and title for people.
    wavelength_um : (N,) float64 array
        Wavelengths of the measurement [µm], ascending.
    emissivity : (N,) float64 array
        Hemispherical emissivity [1]: mean over the samples if Lambertian, else 2 ∫ ε(µ) µ dµ.
    emissivity_std : (N,) float64 array
        Standard deviation over the samples [1]; NaN for a single sample.
    colour : tuple of 3 int
        Typical sRGB colour, 0-255.
    solar_absorptance : float
        Absorbed fraction of sunlight, 0.3–2.5 µm [1].
    solar_absorptance_std : float or None
        Its standard deviation [1]; None: unknown, so `solar_uncertainty` is an assumption.
    thermal : Thermal or None
        Thermal properties; None if the library has no table. A mixture has those of its parts.
    temperature : float
        Typical daytime kinetic temperature [K], an assumption if nothing better is known.
    source, citation, licence : str
        Origin of the numbers, what to cite, terms of use.
    directional : str
        Angular model: "lambertian", constant; "fresnel", from refractive index and roughness; "table", measured.
    samples : int
        Number of measured samples in the mean.
    note : str
        Remarks for users: samples left out, assumptions.
    rms_slope : float
        Roughness of a "fresnel" material: RMS slope of its facets, 0 for a mirror.
    cosines, emissivity_by_angle : (M,) and (N, M) float64 arrays, or None
        Cosines of the angle from the normal, ascending from 0 to 1, and the emissivity there [1]; None if Lambertian.
    gaps_um : tuple of (start, end)
        Gaps of the measurement [µm]; wavelengths inside are refused.
    assumed_um : tuple of (start, end)
        Ends of the table that are not measured but assumed from similar materials
        (`thermorender.materials.extended`) [µm].
    table : str
        Text of the spectral table of a material that emits by angle, from which it is written; "" if Lambertian.
    """

    name: str
    title: str
    wavelength_um: NDArray[np.float64]
    emissivity: NDArray[np.float64]
    emissivity_std: NDArray[np.float64]
    colour: tuple[int, int, int]
    solar_absorptance: float
    temperature: float
    source: str
    citation: str
    licence: str
    directional: str = "lambertian"
    samples: int = 1
    note: str = ""
    rms_slope: float = 0.0
    cosines: NDArray[np.float64] | None = None
    emissivity_by_angle: NDArray[np.float64] | None = None
    gaps_um: tuple[tuple[float, float], ...] = ()
    assumed_um: tuple[tuple[float, float], ...] = ()
    solar_absorptance_std: float | None = None
    thermal: Thermal | None = None
    table: str = ""

    def __repr__(self) -> str:
        low, high = self.valid_range_um
        emits = f"{self.emissivity.min():.2f}–{self.emissivity.max():.2f}"
        return f"{type(self).__name__}({self.name!r}, emissivity {emits} over {low:g}–{high:g} µm, {self.directional})"

    def __post_init__(self) -> None:
        for key in ("wavelength_um", "emissivity", "emissivity_std", "cosines", "emissivity_by_angle"):
            if getattr(self, key) is None:
                continue
            values = np.array(getattr(self, key), dtype=np.float64)
            values.setflags(write=False)
            object.__setattr__(self, key, values)

    @property
    def valid_range_um(self) -> tuple[float, float]:
        """The shortest and longest measured wavelength [µm]."""
        return float(self.wavelength_um[0]), float(self.wavelength_um[-1])

    @property
    def solar_uncertainty(self) -> float:
        """Standard deviation of the solar absorptance [1]: the table's, or 0.05 if it has none."""
        return ASSUMED_SOLAR_STD if self.solar_absorptance_std is None else self.solar_absorptance_std

    def known_thermal(self) -> Thermal:
        """Return the thermal properties.

        Raises
        ------
        ThermorenderError
            The library has none for this material.
        """
        if self.thermal is None and self.source == _ASSUMED_GREY:
            raise ThermorenderError(
                f"grey material {self.name!r} has no thermal properties; use a material of the library that has them"
            )
        if self.thermal is None:
            raise ThermorenderError(
                f"material {self.name!r} has no thermal properties; add thermal/{self.name}.csv (columns property, "
                "value, uncertainty, source) to a materials/ folder of the scene, or use a material that has them"
            )
        return self.thermal

    def emissivity_at(self, wavelength_um: ArrayLike) -> NDArray[np.float64]:
        """Return the hemispherical emissivity, linear between the tabulated wavelengths.

        Parameters
        ----------
        wavelength_um : float or array of any shape
            Wavelength [µm].

        Returns
        -------
        float64 array of the shape of `wavelength_um`
            Emissivity [1], the cosine-weighted mean over the hemisphere; also the absorptance of diffuse light.

        Raises
        ------
        ThermorenderError
            A wavelength is outside the measured range or in one of its gaps; nothing is extrapolated.
        """
        return np.interp(self._measured(wavelength_um), self.wavelength_um, self.emissivity)

    def emissivity_at_angle(self, wavelength_um: ArrayLike, cos_theta: ArrayLike) -> NDArray[np.float64]:
        """Return the emissivity towards a direction, broadcast over both arguments.

        Parameters
        ----------
        wavelength_um : float or array
            Wavelength [µm].
        cos_theta : float or array
            Cosine of the angle between direction and surface normal, 0…1.

        Returns
        -------
        float64 array
            Emissivity [1], unpolarised; linear between the tabulated wavelengths and cosines.

        Raises
        ------
        ThermorenderError
            As `emissivity_at`, or a cosine is not within 0…1.
        """
        wavelength, cosine = np.broadcast_arrays(self._measured(wavelength_um), np.asarray(cos_theta, dtype=np.float64))
        outside = cosine[~((cosine >= 0.0) & (cosine <= 1.0))]
        if outside.size:
            raise ThermorenderError(
                f"material {self.name!r} was asked for its emissivity at cos_theta={outside[0]:g}; give the cosine "
                "of the angle from the surface normal, 0 (grazing) to 1 (along the normal)"
            )
        if self.emissivity_by_angle is None or self.cosines is None:
            return np.interp(wavelength, self.wavelength_um, self.emissivity)
        row, down = _place(self.wavelength_um, wavelength)
        column, along = _place(self.cosines, cosine)
        table = self.emissivity_by_angle
        upper = table[row, column] * (1.0 - along) + table[row, column + 1] * along
        lower = table[row + 1, column] * (1.0 - along) + table[row + 1, column + 1] * along
        return upper * (1.0 - down) + lower * down

    def band_emissivity_std(self, lower_um: float, upper_um: float, temperature: float) -> float:
        """Return the standard deviation of the band emissivity [1], NaN for a single sample within the band.

        Errors at different wavelengths are taken as fully correlated, which is an upper bound.
        """
        from thermorender.physics.band import quadrature

        wavelength, weight = quadrature(lower_um, upper_um)
        weight = weight * spectral_radiance(wavelength, temperature)
        known = np.isfinite(self.emissivity_std)
        # Beside a row without a deviation there is none.
        own = np.interp(wavelength, self.wavelength_um, self.emissivity_std, np.nan, np.nan)
        if not np.isfinite(own).any():
            return float("nan")
        std = np.interp(wavelength, self.wavelength_um[known], self.emissivity_std[known])
        return float(std @ weight / weight.sum())

    def band_emissivity(
        self, lower_um: float, upper_um: float, temperature: ArrayLike, cos_theta: float | None = None
    ) -> NDArray[np.float64]:
        """Return emitted over blackbody band radiance [1], in the shape of `temperature`.

        Parameters
        ----------
        lower_um, upper_um : float
            Limits of the camera's flat band [µm].
        temperature : array
            Surface temperature [K], for the Planck weighting of the spectrum.
        cos_theta : float, optional
            Cosine of the angle from the normal; without it the hemispherical emissivity.

        Notes
        -----
        ∫ ε(λ) B(λ, T) dλ / ∫ B(λ, T) dλ by Gauss–Legendre between adjacent rows of the table, where ε is linear and B
        smooth: exact to 1e-10.
        """
        between = self.wavelength_um[(self.wavelength_um > lower_um) & (self.wavelength_um < upper_um)]
        steps = np.linspace(lower_um, upper_um, int(np.ceil((upper_um - lower_um) / LONGEST_PANEL_UM)) + 1)
        edges = np.union1d(between, steps)
        half = 0.5 * np.diff(edges)[:, None]
        wavelength = (edges[:-1, None] + half + half * _NODES).ravel()
        if cos_theta is None:
            emissivity = self.emissivity_at(wavelength)
        else:
            emissivity = self.emissivity_at_angle(wavelength, cos_theta)
        temperature = np.asarray(temperature, dtype=np.float64)
        planck = spectral_radiance(wavelength, temperature[..., None]) * (half * _WEIGHTS).ravel()
        return (planck @ emissivity) / planck.sum(axis=-1)

    def _measured(self, wavelength_um: ArrayLike) -> NDArray[np.float64]:
        """Return the wavelengths as an array; refuse those at which nothing was measured."""
        asked = np.asarray(wavelength_um, dtype=np.float64)
        first, last = self.valid_range_um
        if not np.all((asked >= first - ROUNDING_UM) & (asked <= last + ROUNDING_UM)):
            if np.isnan(asked).any():
                span = "a wavelength that is NaN"
            elif asked.max() - asked.min() > 0.0:
                span = f"{asked.min():g}–{asked.max():g} µm"
            else:
                span = f"{asked.min():g} µm"
            raise ThermorenderError(
                f"material {self.name!r} was asked for its emissivity at {span} but was measured over "
                f"{first:g}–{last:g} µm only; choose a band inside that range, or a material (or your own "
                "table) that covers it"
            )
        for start, end in self.gaps_um:
            inside = (asked > start + ROUNDING_UM) & (asked < end - ROUNDING_UM)
            if inside.any():
                raise ThermorenderError(
                    f"material {self.name!r} was asked for its emissivity at {asked[inside].flat[0]:g} µm, but its "
                    f"table has no row between {start:g} and {end:g} µm; measure there, or add rows of your own"
                )
        return asked

    def __str__(self) -> str:
        first, last = self.valid_range_um
        low, high = int(self.emissivity.argmin()), int(self.emissivity.argmax())
        spread = "unknown, one sample" if self.samples == 1 else "unknown"
        if np.isfinite(self.emissivity_std).any():
            spread = f"±{np.nanmean(self.emissivity_std):.3f} over {self.samples} samples"
        lines = [
            f"{self.name}: {self.title}",
            f"  measured      {first:g}–{last:g} µm at {self.wavelength_um.size} wavelengths",
            f"  emissivity    {self.emissivity[low]:.3f} at {self.wavelength_um[low]:g} µm to "
            f"{self.emissivity[high]:.3f} at {self.wavelength_um[high]:g} µm, {self._directional_words()}",
            f"  spread        {spread}",
            f"  sunlight      absorbs {self.solar_absorptance:.2f} ± {self.solar_uncertainty:.2g}"
            f"{' (assumed)' if self.solar_absorptance_std is None else ''}; sRGB colour {self.colour}",
            f"  temperature   {self.temperature:g} K by day, assumed where nothing better is known",
            f"  source        {self.source}",
            f"  cite          {self.citation}",
            f"  licence       {self.licence}",
        ]
        if self.note:
            lines.append(f"  note          {self.note}")
        if self.thermal:
            lines.append(f"  thermal       inertia {self.thermal.inertia:.0f} J m⁻² K⁻¹ s^-½, value ± one standard "
                         "deviation and source:")  # fmt: skip
            lines += [f"    {line}" for line in str(self.thermal).splitlines()]
        return "\n".join(lines)

    def _directional_words(self) -> str:
        words = {
            "lambertian": "lambertian",
            "table": f"hemispherical, from {0 if self.cosines is None else self.cosines.size} angles",
        }
        roughness = f"rms slope {self.rms_slope:g}" if self.rms_slope else "smooth"
        return words.get(self.directional, f"hemispherical, fresnel, {roughness}")


def grey(name: str, emissivity: float) -> Material:
    """Return a Material with the same emissivity at all wavelengths, 0–1000 µm.

    Parameters
    ----------
    name : str
        Name in messages.
    emissivity : float
        0…1 [1].

    Raises
    ------
    ThermorenderError
        The emissivity is not a number from 0 to 1.
    """
    if not 0.0 <= emissivity <= 1.0:
        raise ThermorenderError(
            f"emissivity={emissivity:g} of grey material {name!r} is not within 0…1; give the share of a "
            "blackbody's radiance, 0.95 for 95 %"
        )
    return Material(
        name=name, title=f"grey, emissivity {emissivity:g}", wavelength_um=np.array([0.0, LONGEST_WAVELENGTH_UM]),
        emissivity=np.full(2, emissivity), emissivity_std=np.full(2, np.nan), colour=(128, 128, 128),
        solar_absorptance=float(emissivity), temperature=300.0, source=_ASSUMED_GREY, citation="none",
        licence="none needed",
    )  # fmt: skip


def _place(nodes: NDArray[np.float64], values: NDArray[np.float64]) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Return the index of the node below each value, and the value's fraction of the interval to the next node."""
    below = np.clip(np.searchsorted(nodes, values, side="right") - 1, 0, nodes.size - 2)
    return below, np.clip((values - nodes[below]) / (nodes[below + 1] - nodes[below]), 0.0, 1.0)
