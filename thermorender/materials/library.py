"""Surface materials: emissivity spectra with their source, read from tables a person edits in a spreadsheet.

A library is a folder with `index.csv` (one row per material), `spectra/<name>.csv` (its measured emissivity, its
refractive index, or its emissivity by angle) and, where it takes part in a heat balance, `thermal/<name>.csv`. The
package ships one; a scene may lay its own `materials/` folder over it. A material knows the wavelengths at which it was
measured and refuses all others.
"""

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.materials.files import (
    INDEX_COLUMNS,
    LONGEST_WAVELENGTH_UM,
    ROUGHNESS_COLUMN,
    SOLAR_STD_COLUMN,
    number_in_cell,
    read_angles,
    read_emissivity,
    read_refractive_index,
    read_table,
)
from thermorender.materials.thermal import Thermal, read_thermals, stacked
from thermorender.paths import data_folder
from thermorender.physics.fresnel import LARGEST_SLOPE
from thermorender.physics.planck import spectral_radiance
from thermorender.schema import closest
from thermorender.units import kelvin

# How emissivity depends on the angle, as written in the index, and what that makes of `spectra/<name>.csv`.
DIRECTIONAL_MODELS = ("lambertian", "fresnel", "table")
NAME = re.compile(r"[A-Za-z0-9_-]+")

# Wavelengths computed as 1e4 / wavenumber land beside the end of a table by rounding only.
ROUNDING_UM = 1e-9

# Taken for one standard deviation of the solar absorptance where none is given: what samples of one kind differ by.
ASSUMED_SOLAR_STD = 0.05

# Four nodes a panel take Planck's law exactly over this much of a band, down to 100 K.
LONGEST_PANEL_UM = 0.25
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(4)


@dataclass(frozen=True, eq=False)
class Material:
    """A surface material and what is known about it.

    Attributes
    ----------
    name, title : str
        The name scenes use, and the name people read.
    wavelength_um : (N,) float64 array
        Wavelengths of the measurement [µm], rising.
    emissivity : (N,) float64 array
        Hemispherical emissivity [1]: mean over the samples of a Lambertian material, 2 ∫ ε(µ) µ dµ of others.
    emissivity_std : (N,) float64 array
        Standard deviation over the samples [1]; NaN where one sample only tells nothing about it.
    colour : tuple of 3 int
        Typical sRGB colour, 0-255.
    solar_absorptance : float
        Share of sunlight (0.3-2.5 µm) absorbed [1].
    solar_absorptance_std : float or None
        Its standard deviation [1]; None: unknown, and `solar_uncertainty` is an assumption.
    thermal : Thermal or None
        Thermal properties; None where the library has no table of them. Those of a mixture are its parts'.
    temperature : float
        Typical daytime kinetic temperature [K], an assumption for where nothing better is known.
    source, citation, licence : str
        Where the numbers come from, what to cite, under which terms.
    directional : str
        How emissivity depends on angle: "lambertian", not at all; "fresnel", from the refractive index and the
        roughness; "table", from measured angles.
    samples : int
        How many measured samples the mean is taken over.
    note : str
        What a user should know: samples left out, assumptions.
    rms_slope : float
        Roughness of a "fresnel" material: root mean square slope of its facets, 0 for a mirror.
    cosines, emissivity_by_angle : (M,) and (N, M) float64 arrays, or None
        Cosines of the angle from the normal, rising from 0 to 1, and the emissivity there [1]; None for Lambertian.
    gaps_um : tuple of (start, end)
        Holes of the measurement [µm]; asking inside one is refused.
    """

    name: str
    title: str
    wavelength_um: np.ndarray
    emissivity: np.ndarray
    emissivity_std: np.ndarray
    colour: tuple
    solar_absorptance: float
    temperature: float
    source: str
    citation: str
    licence: str
    directional: str = "lambertian"
    samples: int = 1
    note: str = ""
    rms_slope: float = 0.0
    cosines: np.ndarray | None = None
    emissivity_by_angle: np.ndarray | None = None
    gaps_um: tuple = ()
    solar_absorptance_std: float | None = None
    thermal: Thermal | None = None

    def __post_init__(self):
        for key in ("wavelength_um", "emissivity", "emissivity_std", "cosines", "emissivity_by_angle"):
            if getattr(self, key) is None:
                continue
            values = np.array(getattr(self, key), dtype=np.float64)
            values.setflags(write=False)
            object.__setattr__(self, key, values)

    def __repr__(self):
        low, high = self.valid_range_um
        emits = f"{self.emissivity.min():.2f}–{self.emissivity.max():.2f}"
        return f"{type(self).__name__}({self.name!r}, emissivity {emits} over {low:g}–{high:g} µm, {self.directional})"

    @property
    def valid_range_um(self):
        """The shortest and longest measured wavelength [µm]."""
        return float(self.wavelength_um[0]), float(self.wavelength_um[-1])

    @property
    def solar_uncertainty(self):
        """One standard deviation of the solar absorptance [1]: the table's, or 0.05 where it gives none."""
        return ASSUMED_SOLAR_STD if self.solar_absorptance_std is None else self.solar_absorptance_std

    def known_thermal(self):
        """Return the thermal properties.

        Raises
        ------
        ThermorenderError
            The library has none of this material; the message names the file to add.
        """
        if self.thermal is None:
            raise ThermorenderError(
                f"material {self.name!r} has no thermal properties; add thermal/{self.name}.csv (columns property, "
                "value, uncertainty, source) to a materials/ folder of the scene, or use a material that has them"
            )
        return self.thermal

    def emissivity_at(self, wavelength_um):
        """Return the hemispherical emissivity at the wavelengths asked, linear between the tabulated ones.

        Parameters
        ----------
        wavelength_um : float or array of any shape
            Wavelength [µm].

        Returns
        -------
        float64 array of the shape of `wavelength_um`
            Emissivity [1]. For a Lambertian material that of every direction; else the mean over the hemisphere,
            weighted with the cosine: what the surface emits as a whole, and absorbs of diffuse light.

        Raises
        ------
        ThermorenderError
            A wavelength lies outside the measured range or in a hole of it; nothing is extrapolated.
        """
        return np.interp(self._measured(wavelength_um), self.wavelength_um, self.emissivity)

    def emissivity_at_angle(self, wavelength_um, cos_theta):
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
        wavelength, cosine = np.broadcast_arrays(
            self._measured(wavelength_um), np.asarray(cos_theta, dtype=np.float64)
        )
        outside = cosine[~((cosine >= 0.0) & (cosine <= 1.0))]
        if outside.size:
            raise ThermorenderError(
                f"material {self.name!r} was asked for its emissivity at cos_theta={outside[0]:g}; give the cosine "
                "of the angle from the surface normal, 0 (grazing) to 1 (along the normal)"
            )
        if self.emissivity_by_angle is None:
            return np.interp(wavelength, self.wavelength_um, self.emissivity)
        row, down = _place(self.wavelength_um, wavelength)
        column, along = _place(self.cosines, cosine)
        table = self.emissivity_by_angle
        upper = table[row, column] * (1.0 - along) + table[row, column + 1] * along
        lower = table[row + 1, column] * (1.0 - along) + table[row + 1, column + 1] * along
        return upper * (1.0 - down) + lower * down

    def band_emissivity(self, lower_um, upper_um, temperature, cos_theta=None):
        """Return the share of a blackbody's band radiance the material emits [1], in the shape of `temperature`.

        Parameters
        ----------
        lower_um, upper_um : float
            Limits of the camera's flat band [µm].
        temperature : array
            Temperature of the surface [K]: Planck's law weighs the spectrum.
        cos_theta : float, optional
            Cosine of the angle from the normal; without it the hemispherical emissivity.

        Notes
        -----
        ∫ ε(λ) B(λ, T) dλ / ∫ B(λ, T) dλ, by Gauss–Legendre between every two rows of the table, where ε is linear and B
        smooth: exact to 1e-12.
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

    def _measured(self, wavelength_um):
        """Return the wavelengths as an array after refusing those at which nothing was measured."""
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
                    f"table has no row between {start:g} and {end:g} µm; measure there, or add rows you answer for"
                )
        return asked

    def __str__(self):
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

    def _directional_words(self):
        words = {"lambertian": "lambertian", "table": f"hemispherical, from {np.size(self.cosines)} angles"}
        roughness = f"rms slope {self.rms_slope:g}" if self.rms_slope else "smooth"
        return words.get(self.directional, f"hemispherical, fresnel, {roughness}")


def grey(name, emissivity):
    """Return a Material of one emissivity at all wavelengths, 0–1000 µm.

    Parameters
    ----------
    name : str
        Its name in messages.
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
        name=name,
        title=f"grey, emissivity {emissivity:g}",
        wavelength_um=[0.0, LONGEST_WAVELENGTH_UM],
        emissivity=[emissivity, emissivity],
        emissivity_std=[np.nan, np.nan],
        colour=(128, 128, 128),
        solar_absorptance=float(emissivity),
        temperature=300.0,
        source="assumed constant",
        citation="none",
        licence="none needed",
    )


def find(library, name, where):
    """Return the material `name` of the library.

    Parameters
    ----------
    library : dict of str to Material
        From `load_library`.
    name : str
        As the user wrote it.
    where : str
        Where the user wrote it, e.g. `scene.toml, object "marker"`, for the message.

    Raises
    ------
    ThermorenderError
        The library has no such material; the message names the closest ones.
    """
    if name in library:
        return library[name]
    close = closest(name, library, count=3, cutoff=0.4)
    hint = f"the closest are {', '.join(close)}" if close else f"it holds {', '.join(sorted(library))}"
    raise ThermorenderError(
        f"{where} uses material {name!r}, which the library does not hold; {hint}; use one it "
        "holds, or add yours to a materials/ folder of the scene (index.csv and spectra/)"
    )


def load_library(directory=None):
    """Return the shipped materials by name, overlaid by those of a folder of the same form.

    Parameters
    ----------
    directory : path, optional
        Folder with `index.csv`, `spectra/` and `thermal/`, e.g. a scene's own `materials/`. A row and spectrum of
        the same name replace the shipped ones, and a table of thermal properties the shipped one, each by itself; a
        folder with nothing but `thermal/` needs no index.

    Returns
    -------
    dict of str to Material

    Raises
    ------
    ThermorenderError
        A table is missing or holds something that cannot be right, or thermal properties are of no material, or what
        lies beneath is none; the message names file and row.
    """
    shipped = data_folder("materials")
    library, where = read_library(shipped), shipped
    thermals = {name: material.thermal for name, material in library.items() if material.thermal}
    if directory is not None:
        where = Path(directory)
        library |= read_library(where)
        own = read_thermals(where)
        # Its own first: faults are looked for in this order.
        thermals = own | {name: thermal for name, thermal in thermals.items() if name not in own}
        for name in own:
            if name not in library:
                raise ThermorenderError(f"{where / 'thermal' / name}.csv {stray(name, library)}")
    for name, thermal in stacked(thermals, where).items():
        library[name] = replace(library[name], thermal=thermal)
    return library


def stray(name, library):
    """Return a clause on a table of thermal properties whose name no material has."""
    near = closest(name, library)
    hint = f"did you mean {near[0]}? " if near else ""
    return f"belongs to no material; {hint}name it after one, or add a row to index.csv and a spectrum"


def read_library(directory):
    """Return the materials of one folder by name; thermal properties without what lies beneath, see `load_library`."""
    index = directory / "index.csv"
    thermals, library = read_thermals(directory), {}
    if thermals and not index.exists():
        return library
    for row, cells in read_table(index, INDEX_COLUMNS, directory):
        name = cells["name"]
        # The name becomes a file name, so it must not lead elsewhere.
        if not NAME.fullmatch(name):
            raise ThermorenderError(
                f"{index}, row {row}: name={name!r} is not a material name; use letters, digits, _ and -"
            )
        if name in library:
            raise ThermorenderError(
                f"{index}, row {row}: material {name!r} is listed twice; delete one row or rename it"
            )
        library[name] = _read_material(directory, index, row, cells, thermals.get(name))
    return library


def _read_material(directory, index, row, cells, thermal):
    """Return the material of one row of the index together with its spectrum and thermal properties."""
    for column in ("title", "source", "citation", "licence"):
        if not cells[column]:
            raise ThermorenderError(
                f"{index}, row {row}: {column} of material {cells['name']!r} is empty; say where the numbers "
                "come from and on what terms ('own measurement, 2024' will do)"
            )
    if cells["directional"] not in DIRECTIONAL_MODELS:
        raise ThermorenderError(
            f"{index}, row {row}: directional={cells['directional']!r} is not known; write "
            f"{' or '.join(DIRECTIONAL_MODELS)}"
        )

    def number(column, low, high, mend):
        return number_in_cell(index, row, column, cells[column], low, high, mend)

    temperature = number("temperature_k", 0.0, 6000.0, "give kelvin")
    kelvin(f"{index}, row {row}: temperature_k", temperature)
    colour = [number(f"colour_{c}", 0, 255, "give sRGB as a colour picker shows it") for c in "rgb"]
    rms_slope = 0.0
    if cells.get(ROUGHNESS_COLUMN):
        rms_slope = number(ROUGHNESS_COLUMN, 0.0, LARGEST_SLOPE, "give the root mean square slope, 0 for a mirror")
    solar_std = None
    if cells.get(SOLAR_STD_COLUMN):
        solar_std = number(SOLAR_STD_COLUMN, 0.0, 1.0, "give one standard deviation, or leave the cell empty")
    path = directory / "spectra" / f"{cells['name']}.csv"
    if cells["directional"] == "fresnel":
        spectrum = read_refractive_index(path, rms_slope, directory)
    else:
        spectrum = {"lambertian": read_emissivity, "table": read_angles}[cells["directional"]](path, directory)
    return Material(
        name=cells["name"],
        title=cells["title"],
        **spectrum,
        rms_slope=rms_slope,
        colour=tuple(int(round(c)) for c in colour),
        solar_absorptance=number("solar_absorptance", 0.0, 1.0, "give the share absorbed, 0.7 for 70 %"),
        temperature=temperature,
        source=cells["source"],
        citation=cells["citation"],
        licence=cells["licence"],
        directional=cells["directional"],
        samples=int(number("samples", 1, 1e6, "count the measured samples")),
        note=cells["note"],
        solar_absorptance_std=solar_std,
        thermal=thermal,
    )


def _place(nodes, values):
    """Return the index of the node below each value, and the value's share of the interval up to the next one."""
    below = np.clip(np.searchsorted(nodes, values, side="right") - 1, 0, nodes.size - 2)
    return below, np.clip((values - nodes[below]) / (nodes[below + 1] - nodes[below]), 0.0, 1.0)
