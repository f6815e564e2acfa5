"""Check of material tables: all faults at once, each with its correction.

Reading a library stops at the first fault. The check continues, and also looks for likely mistakes in valid tables:
units in nanometres, percent or wavenumbers, gaps, missing spreads, tables without a row in the index.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.material_tables.columns import QUANTITIES, WANTED_RANGE_UM, WAVELENGTH_UNITS, parsed_spectrum
from thermorender.apps.material_tables.samples import ecostress_lines, is_ecostress, stated_units
from thermorender.errors import ThermorenderError, shortened
from thermorender.materials.csv_tables import (
    ANGLE_COLUMN,
    INDEX_COLUMNS,
    INDEX_OF_REFRACTION_COLUMNS,
    LONGEST_WAVELENGTH_UM,
    SPECTRUM_COLUMNS,
    Fault,
    Rows,
    contained,
    decimal,
    gaps,
    is_decimal,
    parsed_table,
    read_text,
)
from thermorender.materials.library import NAME, parsed_row, stray
from thermorender.materials.thermal import THERMAL_COLUMNS, Thermal, beneath, beneath_fault, parsed, read_thermals
from thermorender.paths import data_folder

Floats = NDArray[np.float64]

_IN_UM = "the column is in µm"


@dataclass(frozen=True)
class Finding:
    """A finding: whether it prevents use of the table (`fault`), its location, and a sentence with its correction."""

    fault: bool
    where: str
    text: str

    def __str__(self) -> str:
        return f"{'fault' if self.fault else 'note '}  {self.where}: {self.text}"


def check(path: str | Path) -> list[Finding]:
    """Return the findings on a materials folder or a spectrum file; only faults prevent reading or using it."""
    path = Path(path)
    if path.is_dir():
        return _check_library(path)
    if not path.is_file():
        raise ThermorenderError(f"{path} does not exist; give a materials folder or a spectrum file")
    if is_ecostress(path):
        return _check_ecostress(path)
    return _check_spectrum(path, path.name, None)


def _check_library(folder: Path) -> list[Finding]:
    rows: Rows = []
    findings: list[Finding] = []
    # A folder with only thermal properties needs no index.
    if (folder / "index.csv").exists() or not any((folder / "thermal").glob("*.csv")):
        _, rows, findings = _table(folder, folder / "index.csv", INDEX_COLUMNS, "index.csv")
    seen: set[str] = set()
    for row, cells in rows:
        where, name = f"index.csv, row {row}", cells["name"]
        if not NAME.fullmatch(name):
            findings.append(Finding(True, where, f"name={name!r} is not a material name; use letters, digits, _ and -"))
            continue
        if name in seen:
            findings.append(Finding(True, where, f"material {name!r} is listed twice; delete one row or rename it"))
        seen.add(name)
        findings += [Finding(True, where, fault) for fault in parsed_row(cells)[1]]
        findings += _check_spectrum(
            folder / "spectra" / f"{name}.csv", f"spectra/{name}.csv", cells["directional"], folder, cells["samples"]
        )
    for table in sorted((folder / "spectra").glob("*.csv")) if rows else []:
        if table.stem not in seen:
            findings.append(
                Finding(False, f"spectra/{table.name}", "has no row in index.csv; add a row, or delete the file")
            )
    return findings + _check_thermals(folder, seen)


def _check_thermals(folder: Path, names: set[str]) -> list[Finding]:
    """Return the findings on the thermal tables of a folder whose index has `names`."""
    shipped = read_thermals(data_folder("materials"))
    own: dict[str, Thermal] = {}
    unreadable: set[str] = set()
    findings: list[Finding] = []
    for path in sorted((folder / "thermal").glob("*.csv")):
        where = f"thermal/{path.name}"
        _, rows, found = _table(folder, path, THERMAL_COLUMNS, where)
        thermal, faults = parsed(rows) if rows or not found else (None, [])
        findings += found + _of_faults(where, faults)
        if thermal:
            own[path.stem] = thermal
        else:
            unreadable.add(path.stem)
    for name in sorted({*own, *unreadable} - {*names, *shipped, *beneath(own)}):
        findings.append(Finding(True, f"thermal/{name}.csv", stray(name, {*names, *shipped})))
    for name, thermal in own.items():
        # A table that cannot be read still exists for the layers above it.
        if thermal.beneath not in unreadable and (fault := beneath_fault(name, shipped | own)):
            findings.append(Finding(True, f"thermal/{name}.csv", fault))
    return findings


def _of_faults(where: str, faults: Sequence[Fault]) -> list[Finding]:
    return [Finding(True, f"{where}, row {row}" if row else where, sentence) for row, sentence in faults]


def _check_spectrum(
    path: Path, where: str, directional: str | None, folder: Path | None = None, samples: str = ""
) -> list[Finding]:
    """The findings on a CSV table; with `directional` None its column names determine its kind."""
    header, rows, findings = _table(folder, path, None if directional is None else (), where)
    if directional is None and "property" in header:
        missing = [column for column in THERMAL_COLUMNS if column not in header]
        lacks = f"row 1 lacks column {', '.join(missing)}; it must hold {', '.join(THERMAL_COLUMNS)}"
        return findings + _of_faults(where, [(None, lacks)] if missing else parsed(rows)[1])
    if not rows:
        if header and not findings:
            findings.append(Finding(True, where, "has no row of data; a spectrum needs at least 2"))
        return findings
    if directional is None and header[0].lower() == "wavelength":
        return findings + _check_slum(where, header, rows)
    quantities = _quantities(header, directional)
    first = next((key for key in WAVELENGTH_UNITS if key in header), None)
    # Tables of a library are in µm only.
    if first is None or not quantities or (directional is not None and first != "wavelength_um"):
        wanted = {
            "fresnel": ", ".join(INDEX_OF_REFRACTION_COLUMNS),
            "table": "wavelength_um, at_0 … at_90",
            None: f"one of {', '.join(WAVELENGTH_UNITS)} and one of {', '.join(QUANTITIES)}",
        }.get(directional, ", ".join(SPECTRUM_COLUMNS))
        return findings + [
            Finding(True, where, f"row 1 holds {shortened(', '.join(header))}; it must hold {wanted}, which state the "
                    "units")
        ]  # fmt: skip
    axis, found = _check_axis(where, rows, first, in_library=directional is not None)
    findings += found
    for column in quantities:
        findings += _check_quantity(where, rows, column)
    if "emissivity_std" in header:
        findings += _spread(where, rows, samples)
    return findings + _coverage(where, axis)


def _check_axis(where: str, rows: Rows, column: str, in_library: bool) -> tuple[Floats, list[Finding]]:
    """(Wavelengths (N,) [µm] of a column, findings on their unit, range and order)."""
    axis, findings = _column(where, rows, column)
    found: list[Finding] = []
    if column == "wavelength_um":
        axis, found = _to_um(where, axis)
        # In another unit all values are outside, which is reported once.
        findings += found or _outside(where, _numbers(rows), column, axis, 0.0, LONGEST_WAVELENGTH_UM, _IN_UM)
    else:
        found, axis = findings[:], WAVELENGTH_UNITS[column](axis)
    # Wavenumbers, and tables that `import` sorts, may be in either order.
    falls, order = bool(np.all(np.diff(axis) < 0.0)), _order(where, _numbers(rows), axis, column)
    if in_library or found or np.any(np.diff(axis) >= 0.0):
        findings += order if not (found and falls) else []
    return axis, findings


def _check_quantity(where: str, rows: Rows, column: str) -> list[Finding]:
    """The findings on a column of n, k, emissivity or reflectance."""
    values, findings = _column(where, rows, column)
    if column in ("n", "k"):
        low = 1e-3 if column == "n" else 0.0
        return findings + _outside(where, _numbers(rows), column, values, low, 1e3, "give n + ik")
    return findings + _share(where, _numbers(rows), column, values, "percent" in column)


def _check_slum(where: str, header: list[str], rows: Rows) -> list[Finding]:
    """The findings on a SLUM table: emissivity against µm, or reflectance [%] against nm, one column each."""
    axis, findings = _column(where, rows, header[0])
    short_wave = bool(np.nanmax(axis) > LONGEST_WAVELENGTH_UM)
    axis = axis / 1e3 if short_wave else axis
    findings += _order(where, _numbers(rows), axis, header[0])
    for column in header[1:]:
        values, found = _column(where, rows, column)
        findings += found + _share(where, _numbers(rows), column, values, short_wave)
    return findings if short_wave else findings + _coverage(where, axis)


def _check_ecostress(path: Path) -> list[Finding]:
    where = path.name
    header, pairs = ecostress_lines(path)
    findings = []
    to_um, divisor = WAVELENGTH_UNITS["wavelength_um"], 100.0
    try:
        to_um, divisor = stated_units(where, header)
    except ThermorenderError as error:
        findings.append(Finding(True, where, str(error).removeprefix(f"{where} ")))
    if "hemispherical" not in header.get("measurement", "").lower():
        findings.append(
            Finding(True, where, f"measured as {header.get('measurement', 'not stated')!r}; one minus reflectance is "
                    "emissivity for hemispherical reflectance only, so leave the sample out")
        )  # fmt: skip
    if len(pairs) < 2:
        return findings + [Finding(True, where, f"holds {len(pairs)} pairs of numbers; order the whole file again")]
    if not header.get("origin") and not header.get("owner"):
        findings.append(Finding(False, where, "names neither origin nor owner; add the source yourself"))
    numbers = list(range(1, len(pairs) + 1))
    x, y = np.array(pairs).T
    with np.errstate(divide="ignore"):
        wavelength, percent = to_um(x), 100.0 * y / divisor
    if wavelength[0] > wavelength[-1]:
        wavelength, percent, numbers = wavelength[::-1], percent[::-1], numbers[::-1]
    wavelength, found = _to_um(where, wavelength)
    findings += found + _order(where, numbers, wavelength, "wavelength", "pair")
    thermal = wavelength > 3.2
    kept = [number for number, own in zip(numbers, thermal, strict=True) if own]
    return findings + _share(where, kept, "reflectance", percent[thermal], True, "pair") + _coverage(where, wavelength)


def _table(
    folder: Path | None, path: Path, columns: Sequence[str] | None, where: str
) -> tuple[list[str], Rows, list[Finding]]:
    """(Column names, rows, findings) of a CSV file, continuing after faults if possible; with `columns` None of a
    measured spectrum.
    """
    findings = []
    try:
        text = read_text(path if folder is None else contained(path, folder))
    except ThermorenderError as error:
        findings.append(Finding(True, where, str(error).removeprefix(f"{path} ")))
        if not isinstance(error.__cause__, UnicodeDecodeError):
            return [], [], findings
        text = path.read_bytes().decode("latin-1")
    if columns is None:
        header, rows, faults, inferred = parsed_spectrum(text)
        if inferred:
            note = (
                f"units follow from the values, as in the headings {', '.join(header)}; write these above the columns"
            )
            findings.append(Finding(False, where, note))
    else:
        header, rows, faults = parsed_table(text, columns)
    return header, rows, findings + _of_faults(where, faults)


def _quantities(header: list[str], directional: str | None) -> list[str]:
    """Return the value columns that a table of this kind must have; empty if they are missing."""
    angles = [column for column in header if ANGLE_COLUMN.fullmatch(column)]
    if directional == "fresnel" or (directional is None and {"n", "k"} <= set(header)):
        return ["n", "k"] if {"n", "k"} <= set(header) else []
    if directional == "table" or (directional is None and angles):
        return angles if {"at_0", "at_90"} <= set(angles) else []
    if directional is None:
        return [column for column in QUANTITIES if column in header][:1]
    return ["emissivity"] if set(SPECTRUM_COLUMNS) <= set(header) else []


def _numbers(rows: Rows) -> list[int]:
    return [number for number, _ in rows]


def _column(where: str, rows: Rows, column: str, empty: str = "") -> tuple[Floats, list[Finding]]:
    """(Values (N,) of a column, NaN where a cell is not a number, one finding on these); `empty` is for empty cells."""
    texts = [cells[column] or empty for _, cells in rows]
    values = np.full(len(texts), np.nan)
    for index, text in enumerate(texts):
        try:
            values[index] = decimal(text)
        except ValueError:
            continue
    bad = np.flatnonzero(~np.isfinite(values))
    if not bad.size:
        return values, []
    first = shortened(repr(texts[bad[0]]))
    text = f"{column}={first} is not a number{_more(bad)}; write it with a point as decimal mark and no unit"
    return values, [Finding(True, f"{where}, row {rows[bad[0]][0]}", text)]


def _to_um(where: str, wavelength: Floats) -> tuple[Floats, list[Finding]]:
    """Return the wavelengths converted to µm from their apparent unit, and a finding if that is not µm."""
    known = wavelength[np.isfinite(wavelength)]
    if not known.size or (known.max() <= LONGEST_WAVELENGTH_UM and not known.min() >= 300.0):
        return wavelength, []
    span = f"wavelength_um runs over {known.min():g}–{known.max():g}"
    # 1–100 µm is 100–10000 cm⁻¹, and 1000–100000 nm; a thermal table that ends below 5000 is in wavenumbers.
    if known.max() < 5000.0:
        return 1e4 / wavelength, [Finding(True, where, f"{span}: wavenumbers in cm⁻¹? write 10000 divided by them")]
    return wavelength / 1e3, [Finding(True, where, f"{span}: nanometres? divide the column by 1000")]


def _order(where: str, numbers: Sequence[int], wavelength: Floats, column: str, word: str = "row") -> list[Finding]:
    steps = np.diff(wavelength)
    findings = []
    repeated, falling = np.flatnonzero(steps == 0.0), np.flatnonzero(steps < 0.0)
    if repeated.size:
        at = repeated[0] + 1
        text = f"{column} repeats the {word} above ({wavelength[at]:g} µm){_more(repeated)}; keep one {word} for each"
        findings.append(Finding(True, f"{where}, {word} {numbers[at]}", text))
    if falling.size:
        at = falling[0] + 1
        text = (
            f"{column} is less than in the {word} above ({wavelength[at]:g} after {wavelength[at - 1]:g} µm)"
            f"{_more(falling)}; sort the table by it, ascending"
        )
        findings.append(Finding(True, f"{where}, {word} {numbers[at]}", text))
    return findings


def _share(
    where: str, numbers: Sequence[int], column: str, values: Floats, percent: bool, word: str = "row"
) -> list[Finding]:
    """Return the findings on values within 0…1, or within 0…100 percent."""
    known = values[np.isfinite(values)]
    if not percent and known.size and np.median(known) > 1.5 and known.max() <= 100.0:
        text = f"{column} runs over {known.min():g}–{known.max():g}: percent? divide the column by 100"
        return [Finding(True, where, text)]
    top = 100.0 if percent else 1.0
    return _outside(where, numbers, column, values, 0.0, top, "leave the sample out, or correct it", word)


def _outside(
    where: str,
    numbers: Sequence[int],
    column: str,
    values: Floats,
    low: float,
    high: float,
    advice: str,
    word: str = "row",
) -> list[Finding]:
    bad = np.flatnonzero((values < low) | (values > high))
    if not bad.size:
        return []
    text = f"{column}={values[bad[0]]:g} is not within {low:g}…{high:g}{_more(bad)}; {advice}"
    return [Finding(True, f"{where}, {word} {numbers[bad[0]]}", text)]


def _spread(where: str, rows: Rows, samples: str) -> list[Finding]:
    texts = [cells["emissivity_std"] for _, cells in rows]
    values, findings = _column(where, rows, "emissivity_std", "0")
    advice = "give the standard deviation, or nothing"
    findings += _outside(where, _numbers(rows), "emissivity_std", values, 0.0, 1.0, advice)
    if samples.isdigit() and int(samples) > 1 and not any(texts):
        text = f"emissivity_std is empty for {samples} samples; give their standard deviation"
        findings.append(Finding(False, where, text))
    if samples == "1" and any(text and decimal(text) == 0.0 for text in texts if is_decimal(text)):
        text = "emissivity_std is 0 for one sample, whose spread is unknown; leave the column empty"
        findings.append(Finding(False, where, text))
    return findings


def _coverage(where: str, wavelength: Floats) -> list[Finding]:
    """Return the findings on gaps and on the range of the wavelengths [µm]."""
    known = np.unique(wavelength[np.isfinite(wavelength)])
    if known.size < 2:
        return [Finding(True, where, f"holds {known.size} wavelengths; a spectrum needs at least 2")]
    findings = [
        Finding(True, where, f"has a gap: no row between {start:g} and {end:g} µm, and wavelengths there are refused; "
                "measure there, or add rows of your own")
        for start, end in gaps(known)
        if end > WANTED_RANGE_UM[0] and start < WANTED_RANGE_UM[1]
    ]  # fmt: skip
    if known[0] > WANTED_RANGE_UM[0] + 1e-9 or known[-1] < WANTED_RANGE_UM[1] - 1e-9:
        text = (
            f"covers {known[0]:g}–{known[-1]:g} µm, not all of {WANTED_RANGE_UM[0]:g}–{WANTED_RANGE_UM[1]:g}; a camera "
            "whose band reaches further refuses it"
        )
        findings.append(Finding(False, where, text))
    return findings


def _more(bad: NDArray[np.intp]) -> str:
    return f" (and {bad.size - 1} more)" if bad.size > 1 else ""
