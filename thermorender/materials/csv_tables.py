"""CSV tables of materials: reading rows and numbers with precise errors, and the three forms of a spectrum table.

Every error names file, row and column, and how to correct the fault. Files outside the library's folder are refused.
"""

import csv
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender import formats
from thermorender.errors import ThermorenderError, shortened
from thermorender.formats import csv_rows
from thermorender.paths import inside
from thermorender.physics import fresnel

INDEX_COLUMNS = (
    "name", "title", "colour_r", "colour_g", "colour_b", "solar_absorptance", "directional",
    "temperature_k", "samples", "source", "citation", "licence", "note",
)  # fmt: skip
# Optional: only Fresnel materials need it.
ROUGHNESS_COLUMN = "rms_slope"
# Optional: only the heat balance uses it.
SOLAR_STD_COLUMN = "solar_absorptance_std"
OPTIONAL_COLUMNS = (ROUGHNESS_COLUMN, SOLAR_STD_COLUMN)
SPECTRUM_COLUMNS = ("wavelength_um", "emissivity", "emissivity_std")
INDEX_OF_REFRACTION_COLUMNS = ("wavelength_um", "n", "k")
ANGLE_COLUMN = re.compile(r"at_(\d+(?:\.\d+)?)")

# Above any wavelength in µm, below any thermal wavelength in nm.
LONGEST_WAVELENGTH_UM = 1000.0
LARGEST_INDEX = 1000.0

# Largest wavelength step at which a Fresnel material's emissivity is computed, and that up to 3.5 µm, within the steep
# band of water and ice.
FINEST_UM, STEEP_UM, STEEP_STEP_UM = 0.05, 3.5, 0.005

# A step larger than both limits is a gap in the measurement, not its sampling.
GAP_UM = 0.5
GAP_STEPS = 5.0
# For emissivities, absorptances and reflectances outside 0…1.
SHARE_ADVICE = "divide by 100 if the values are percent, take 1 minus them if they are reflectances"

Rows = list[tuple[int, dict[str, str]]]  # Row number in the spreadsheet, {column: text}
Fault = tuple[int | None, str]  # Row, or None for the whole table; sentence with the correction
Floats = NDArray[np.float64]


def contained(path: Path, directory: str | Path) -> Path:
    """Return the path of a file inside `directory`; refuse one that leads out of it."""
    if not inside(path, directory):
        raise ThermorenderError(f"{path} leads out of {directory}; put the file itself into the folder")
    return path


def read_text(path: str | Path) -> str:
    """Return the text of a UTF-8 file."""
    path = Path(path)
    if not path.is_file():
        raise ThermorenderError(f"{path} does not exist; a materials folder holds index.csv and spectra/<name>.csv")
    return formats.read_text(path, "'CSV UTF-8' in the spreadsheet")


def read_table(path: str | Path, columns: Sequence[str]) -> Rows:
    """Return the rows of a CSV file as `parsed_table` does; its first fault is an error."""
    _, rows, faults = parsed_table(read_text(path), columns)
    refuse(path, faults)
    return rows


def refuse(path: str | Path, faults: Sequence[Fault]) -> None:
    """Raise the first fault of a table."""
    for row, sentence in faults:
        raise ThermorenderError(f"{path}, row {row}: {sentence}" if row else f"{path}, {sentence}")


def parsed_table(text: str, columns: Sequence[str]) -> tuple[list[str], Rows, list[Fault]]:
    """Return (column names, rows as (row number in the spreadsheet, {column: stripped text}), faults) of a CSV text.

    The first row has the names, with at least `columns`, each once. Empty rows are skipped, and additional columns are
    allowed; cells beyond the last heading are not. Numbers without headings, where none are required, are in column_1,
    column_2….
    """
    faults: list[Fault] = []
    try:
        table = csv_rows(text)
    except csv.Error as error:
        advice = "close its quotation marks, or save the file as 'CSV UTF-8' in the spreadsheet"
        return [], [], [(None, f"is not CSV ({error}); {advice}")]
    first = next((k for k, cells in enumerate(table) if any(cells)), 0)
    header, first = (table[first], first + 1) if table else ([], 1)
    if not columns and any(header) and all(map(is_decimal, filter(None, header))):
        width = max(k for cells in table for k, cell in enumerate(cells, start=1) if cell)
        header, first = [f"column_{k}" for k in range(1, width + 1)], first - 1
    missing = [column for column in columns if column not in header]
    if missing:
        found = shortened(" ".join(", ".join(header).split())) or "nothing"
        lacks = f"row {first} lacks column {', '.join(missing)} (found: {found}); it must hold {', '.join(columns)}"
        return header, [], [*faults, (None, lacks)]
    twice = [column for column in dict.fromkeys(header) if column and header.count(column) > 1]
    if twice:
        holds = f"row {first} holds column {shortened(twice[0])} twice; rename or delete one of them"
        return header, [], [*faults, (None, holds)]
    rows: Rows = []
    for number, cells in enumerate(table[first:], start=first + 1):
        if any(cell.strip() for cell in cells):
            if sentence := beyond(header, cells):
                faults.append((number, sentence))
            cells = cells + [""] * (len(header) - len(cells))
            rows.append((number, {key: cell.strip() for key, cell in zip(header, cells, strict=False)}))
    return header, rows, faults


def beyond(header: Sequence[str], cells: Sequence[str]) -> str | None:
    """Return the fault of a row with cells beyond the last heading (a decimal comma, for example), else None."""
    if not any(cell.strip() for cell in cells[len(header) :]):
        return None
    return (
        f"holds {len(cells)} cells under {len(header)} headings; write numbers with a point as decimal mark, and a "
        "text with commas in quotation marks"
    )


def decimal(text: str) -> float:
    """Return the number that a text writes in the digits 0–9; ValueError for any other, such as Python's own 1_0."""
    if "_" in text or not text.isascii():
        raise ValueError
    return float(text)


def is_decimal(text: str) -> bool:
    """Return whether `decimal` reads a text as a finite number."""
    try:
        return bool(np.isfinite(decimal(text)))
    except ValueError:
        return False


def number_in_cell(path: str | Path, row: int, column: str, text: str, low: float, high: float, advice: str) -> float:
    """Return the number in a table's cell, checked to be within low…high."""
    value, fault = parsed_number(column, text, low, high, advice)
    if value is None:
        raise ThermorenderError(f"{path}, row {row}: {fault}")
    return value


def parsed_number(column: str, text: str, low: float, high: float, advice: str) -> tuple[float | None, str]:
    """Return (number of a cell within low…high, or None, a sentence on its fault, or "")."""
    try:
        value = decimal(text)
    except ValueError:
        return None, (
            f"{column}={shortened(repr(text))} is not a number; write {low:g}…{high:g} with a point as decimal mark "
            "and no unit"
        )
    if not low <= value <= high:
        return None, f"{column}={value:g} is not within {low:g}…{high:g}; {advice}"
    return value, ""


def gaps(wavelength_um: ArrayLike) -> list[tuple[float, float]]:
    """Return the gaps of a table as a list of (start, end) [µm]: steps above 0.5 µm and five times the median step.

    Nothing was measured there, so interpolation across it is not justified.
    """
    wavelength = np.asarray(wavelength_um, dtype=np.float64)
    steps = np.diff(wavelength)
    if steps.size == 0:
        return []
    wide = steps > max(GAP_UM, GAP_STEPS * float(np.median(steps)))
    return [(float(wavelength[i]), float(wavelength[i + 1])) for i in np.flatnonzero(wide)]


def read_emissivity(path: str | Path) -> dict[str, Any]:
    """Return a Lambertian table as arguments of a Material: wavelength_um, emissivity, emissivity_std, gaps_um."""
    advice = "give the standard deviation over the samples, or leave the cell empty"
    rows, wavelength = _rows(path, SPECTRUM_COLUMNS)
    return {
        "wavelength_um": wavelength,
        "emissivity": np.array([share_in_cell(path, row, "emissivity", cells["emissivity"]) for row, cells in rows]),
        "emissivity_std": np.array(
            [
                number_in_cell(path, row, "emissivity_std", text, 0.0, 1.0, advice) if text else np.nan
                for row, text in ((row, cells["emissivity_std"]) for row, cells in rows)
            ]
        ),
        "gaps_um": tuple(gaps(wavelength)),
    }


def read_refractive_index(path: str | Path, rms_slope: float) -> dict[str, Any]:
    """Return the emissivity by wavelength and angle of a table of n and k, as arguments of a Material.

    n and k are linear between rows; the emissivity is computed at every row and at steps of at most 0.05 µm, 0.005 µm
    below 3.5 µm.
    """
    advice = "give the refractive index n + ik, k not negative"
    rows, wavelength = _rows(path, INDEX_OF_REFRACTION_COLUMNS)
    n, k = (
        np.array([number_in_cell(path, row, key, cells[key], low, LARGEST_INDEX, advice) for row, cells in rows])
        for key, low in (("n", 1e-3), ("k", 0.0))
    )
    fine = np.concatenate(
        [
            np.linspace(low, high, int(np.ceil((high - low) / step - 1e-9)), endpoint=False)
            for low, high in zip(wavelength[:-1], wavelength[1:], strict=True)
            for step in (STEEP_STEP_UM if low < STEEP_UM else FINEST_UM,)
        ]
        + [wavelength[-1:]]
    )
    by_angle = fresnel.directional_emissivity(np.interp(fine, wavelength, n), np.interp(fine, wavelength, k), rms_slope)
    text = _text(INDEX_OF_REFRACTION_COLUMNS, rows)
    return _directional(fine, fresnel.COSINES, by_angle, gaps(wavelength), text)


def read_angles(path: str | Path) -> dict[str, Any]:
    """Return a table with columns at_0, at_10 … at_90 [degrees] as arguments of a Material.

    The angles must cover 0 to 90 degrees, because nothing is extrapolated. Emissivity is linear in the cosine between
    them.
    """
    rows, wavelength = _rows(path, ("wavelength_um", "at_0", "at_90"))
    matches = [match for match in map(ANGLE_COLUMN.fullmatch, rows[0][1]) if match]
    columns, angle = [match[0] for match in matches], np.array([float(match[1]) for match in matches])
    if angle.max() > 90.0:
        raise ThermorenderError(
            f"{path}, row 1: column at_{angle.max():g} is beyond 90 degrees; angles count from the normal, 0…90"
        )
    order = np.argsort(-angle)
    by_angle = np.array(
        [[share_in_cell(path, row, column, cells[column]) for column in columns] for row, cells in rows]
    )
    cosines = np.cos(np.radians(angle[order]))
    # cos 90° is 6e-17 by rounding.
    cosines[0] = 0.0
    return _directional(
        wavelength, cosines, by_angle[:, order], gaps(wavelength), _text(("wavelength_um", *columns), rows)
    )


def _directional(
    wavelength: Floats, cosines: Floats, by_angle: Floats, holes: list[tuple[float, float]], text: str
) -> dict[str, Any]:
    return {
        "wavelength_um": wavelength, "emissivity": fresnel.hemispherical(cosines, by_angle),
        "emissivity_std": np.full(wavelength.size, np.nan), "cosines": cosines, "emissivity_by_angle": by_angle,
        "gaps_um": tuple(holes), "table": text,
    }  # fmt: skip


def _text(columns: Sequence[str], rows: Rows) -> str:
    """The columns of a table as text."""
    lines = (columns, *([cells[column] for column in columns] for _, cells in rows))
    return "".join(f"{','.join(line)}\n" for line in lines)


def _rows(path: str | Path, columns: Sequence[str]) -> tuple[Rows, Floats]:
    """Return the rows of a spectrum table and their wavelengths (N,) [µm], checked to be ascending."""
    rows = read_table(path, columns)
    wavelength: list[float] = []
    for row, cells in rows:
        value = number_in_cell(
            path, row, "wavelength_um", cells["wavelength_um"], 0.0, LONGEST_WAVELENGTH_UM,
            "the column is in µm; divide by 1000 if the values are nanometres",
        )  # fmt: skip
        if wavelength and value <= wavelength[-1]:
            fault = "repeats" if value == wavelength[-1] else "is less than"
            raise ThermorenderError(
                f"{path}, row {row}: wavelength_um={value:g} {fault} the row above "
                f"({wavelength[-1]:g}); sort the table by its first column, ascending, "
                "and keep one row for each wavelength"
            )
        wavelength.append(value)
    if len(wavelength) < 2:
        raise ThermorenderError(
            f"{path} holds {len(wavelength)} rows of data; a spectrum needs at least 2 (two rows of the same "
            "emissivity make a grey material)"
        )
    return rows, np.array(wavelength)


def share_in_cell(path: str | Path, row: int, column: str, text: str) -> float:
    """Return an emissivity, absorptance or reflectance in a table's cell, checked to be within 0…1."""
    return number_in_cell(path, row, column, text, 0.0, 1.0, SHARE_ADVICE)
