"""Surface materials: emissivity spectra with their source, read from tables a person edits in a spreadsheet.

A library is a folder with `index.csv` (one row per material) and `spectra/<name>.csv` (its measured
emissivity). The package ships one; a scene may lay its own `materials/` folder over it. A material knows
the wavelengths at which it was measured and refuses all others.
"""

import csv
import difflib
import io
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.paths import data_folder
from thermorender.units import kelvin

INDEX_COLUMNS = (
    "name", "title", "colour_r", "colour_g", "colour_b", "solar_absorptance", "directional",
    "temperature_k", "samples", "source", "citation", "licence", "note",
)  # fmt: skip
SPECTRUM_COLUMNS = ("wavelength_um", "emissivity", "emissivity_std")
DIRECTIONAL_MODELS = ("lambertian",)

# Wavelengths computed as 1e4 / wavenumber land beside the end of a table by rounding only.
ROUNDING_UM = 1e-9

# Longer than any table in µm, shorter than any thermal table in nm.
LONGEST_WAVELENGTH_UM = 1000.0


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
        Hemispherical emissivity, mean over the samples [1].
    emissivity_std : (N,) float64 array
        Standard deviation over the samples [1]; NaN where one sample only tells nothing about it.
    colour : tuple of 3 int
        Typical sRGB colour, 0-255.
    solar_absorptance : float
        Share of sunlight (0.3-2.5 µm) absorbed [1].
    temperature : float
        Typical daytime kinetic temperature [K], an assumption for where nothing better is known.
    source, citation, licence : str
        Where the numbers come from, what to cite, under which terms.
    directional : str
        How emissivity depends on angle: "lambertian", not at all.
    samples : int
        How many measured samples the mean is taken over.
    note : str
        What a user should know: samples left out, assumptions.
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

    def __post_init__(self):
        for key in SPECTRUM_COLUMNS:
            values = np.array(getattr(self, key), dtype=np.float64)
            values.setflags(write=False)
            object.__setattr__(self, key, values)

    @property
    def valid_range_um(self):
        """The shortest and longest measured wavelength [µm]."""
        return float(self.wavelength_um[0]), float(self.wavelength_um[-1])

    def emissivity_at(self, wavelength_um):
        """Return the emissivity at the wavelengths asked, linear between the measured ones.

        Parameters
        ----------
        wavelength_um : float or array of any shape
            Wavelength [µm].

        Returns
        -------
        float64 array of the shape of `wavelength_um`
            Emissivity [1].

        Raises
        ------
        ThermorenderError
            A wavelength lies outside the measured range; nothing is extrapolated.
        """
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
        return np.interp(asked, self.wavelength_um, self.emissivity)

    def __str__(self):
        first, last = self.valid_range_um
        low, high = int(self.emissivity.argmin()), int(self.emissivity.argmax())
        spread = "unknown, one sample"
        if np.isfinite(self.emissivity_std).any():
            spread = f"±{np.nanmean(self.emissivity_std):.3f} over {self.samples} samples"
        lines = [
            f"{self.name}: {self.title}",
            f"  measured      {first:g}–{last:g} µm at {self.wavelength_um.size} wavelengths",
            f"  emissivity    {self.emissivity[low]:.3f} at {self.wavelength_um[low]:g} µm to "
            f"{self.emissivity[high]:.3f} at {self.wavelength_um[high]:g} µm, {self.directional}",
            f"  spread        {spread}",
            f"  sunlight      absorbs {self.solar_absorptance:.2f}; sRGB colour {self.colour}",
            f"  temperature   {self.temperature:g} K by day, assumed where nothing better is known",
            f"  source        {self.source}",
            f"  cite          {self.citation}",
            f"  licence       {self.licence}",
        ]
        if self.note:
            lines.append(f"  note          {self.note}")
        return "\n".join(lines)


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
    close = difflib.get_close_matches(str(name), library, n=3, cutoff=0.4)
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
        Folder with `index.csv` and `spectra/`, e.g. a scene's own `materials/`. A material of the same
        name takes the place of the shipped one.

    Returns
    -------
    dict of str to Material

    Raises
    ------
    ThermorenderError
        A table is missing or holds something that cannot be right; the message names file and row.
    """
    library = _read_library(data_folder("materials"))
    if directory is not None:
        library.update(_read_library(Path(directory)))
    return library


def read_table(path, columns):
    """Return the rows of a CSV file as (row number in the spreadsheet, dict of column to stripped text).

    Rows with nothing in them are left out; columns beyond those asked for are the user's own and pass.

    Parameters
    ----------
    path : path
        Comma-separated text, UTF-8, first row the column names.
    columns : sequence of str
        Columns that must be there.

    Raises
    ------
    ThermorenderError
        The file is absent, not UTF-8, separated by semicolons, or a column is missing.
    """
    path = Path(path)
    if not path.is_file():
        raise ThermorenderError(
            f"{path} does not exist; a materials folder holds index.csv and spectra/<name>.csv"
        )
    try:
        # utf-8-sig: spreadsheets put a byte order mark first.
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ThermorenderError(
            f"{path} is not UTF-8 text ({error.reason}); save it as 'CSV UTF-8' in the spreadsheet"
        ) from error
    first_line = text.partition("\n")[0]
    if ";" in first_line and "," not in first_line:
        raise ThermorenderError(
            f"{path}, row 1 is separated by semicolons; save it comma-separated with a point as decimal mark"
        )
    try:
        table = list(csv.reader(io.StringIO(text)))
    except csv.Error as error:
        raise ThermorenderError(
            f"{path} is not a CSV file ({error}); save it as 'CSV UTF-8' in the spreadsheet"
        ) from None
    header = [cell.strip() for cell in table[0]] if table else []
    missing = [column for column in columns if column not in header]
    if missing:
        raise ThermorenderError(
            f"{path}, row 1 lacks column {', '.join(missing)} (found: {', '.join(header) or 'nothing'}); the "
            f"first row must hold {', '.join(columns)}"
        )
    rows = []
    for number, cells in enumerate(table[1:], start=2):
        if any(cell.strip() for cell in cells):
            cells = cells + [""] * (len(header) - len(cells))
            rows.append((number, {key: cell.strip() for key, cell in zip(header, cells, strict=False)}))
    return rows


def number_in_cell(path, row, column, text, low, high, mend):
    """Return the number written in a table's cell after checking that it lies within low…high.

    Raises
    ------
    ThermorenderError
        The text is no number or lies outside; the message names file, row, column, what arrived, what is
        allowed, and `mend`, what to do.
    """
    try:
        value = float(text)
    except ValueError:
        raise ThermorenderError(
            f"{path}, row {row}: {column}={text!r} is not a number; write {low:g}…{high:g} with a point as "
            "decimal mark and no unit"
        ) from None
    if not low <= value <= high:
        raise ThermorenderError(
            f"{path}, row {row}: {column}={value:g} is not within {low:g}…{high:g}; {mend}"
        )
    return value


def _read_library(directory):
    """Return the materials of one folder by name."""
    index = directory / "index.csv"
    library = {}
    for row, cells in read_table(index, INDEX_COLUMNS):
        name = cells["name"]
        # The name becomes a file name, so it must not lead elsewhere.
        if not re.fullmatch(r"[A-Za-z0-9_-]+", name):
            raise ThermorenderError(
                f"{index}, row {row}: name={name!r} is not a material name; use letters, digits, _ and -"
            )
        if name in library:
            raise ThermorenderError(
                f"{index}, row {row}: material {name!r} is listed twice; delete one row or rename it"
            )
        library[name] = _read_material(directory, index, row, cells)
    return library


def _read_material(directory, index, row, cells):
    """Return the material of one row of the index together with its spectrum."""
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
    wavelength, emissivity, std = _read_spectrum(directory / "spectra" / f"{cells['name']}.csv")
    return Material(
        name=cells["name"],
        title=cells["title"],
        wavelength_um=wavelength,
        emissivity=emissivity,
        emissivity_std=std,
        colour=tuple(int(round(c)) for c in colour),
        solar_absorptance=number("solar_absorptance", 0.0, 1.0, "give the share absorbed, 0.7 for 70 %"),
        temperature=temperature,
        source=cells["source"],
        citation=cells["citation"],
        licence=cells["licence"],
        directional=cells["directional"],
        samples=int(number("samples", 1, 1e6, "count the measured samples")),
        note=cells["note"],
    )


def _read_spectrum(path):
    """Return wavelength [µm], emissivity and its standard deviation, each (N,), of a spectrum table."""
    wavelength, emissivity, std = [], [], []
    for row, cells in read_table(path, SPECTRUM_COLUMNS):
        value = number_in_cell(
            path, row, "wavelength_um", cells["wavelength_um"], 0.0, LONGEST_WAVELENGTH_UM,
            "the column is in µm; divide by 1000 if the values are nanometres",
        )  # fmt: skip
        if wavelength and value <= wavelength[-1]:
            fault = "repeats" if value == wavelength[-1] else "is less than"
            raise ThermorenderError(
                f"{path}, row {row}: wavelength_um={value:g} {fault} the row above "
                f"({wavelength[-1]:g}); sort the table by its first column, rising, "
                "and keep one row for each wavelength"
            )
        wavelength.append(value)
        emissivity.append(
            number_in_cell(
                path, row, "emissivity", cells["emissivity"], 0.0, 1.0,
                "divide by 100 if the values are percent, take 1 minus them if they are reflectances",
            )  # fmt: skip
        )
        text = cells["emissivity_std"]
        mend = "give the standard deviation over the samples, or leave the cell empty"
        std.append(number_in_cell(path, row, "emissivity_std", text, 0.0, 1.0, mend) if text else np.nan)
    if len(wavelength) < 2:
        raise ThermorenderError(
            f"{path} holds {len(wavelength)} rows of data; a spectrum needs 2 at least (two rows of the same "
            "emissivity make a grey material)"
        )
    return np.array(wavelength), np.array(emissivity), np.array(std)
