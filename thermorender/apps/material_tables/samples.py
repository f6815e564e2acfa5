"""Measured samples from files: ECOSTRESS text, a column of a SLUM table, or a CSV of two columns.

Every file becomes hemispherical reflectance over ascending wavelength in µm. The file itself must state quantity and
unit; nothing is guessed.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError, shortened
from thermorender.materials.csv_tables import (
    LONGEST_WAVELENGTH_UM,
    decimal,
    number_in_cell,
    parsed_table,
    read_table,
    read_text,
)

# Library → (its title, citation, licence).
LIBRARIES = {
    "ECOSTRESS": (
        "ECOSTRESS spectral library (JPL)",
        "Baldridge et al. 2009, doi:10.1016/j.rse.2008.11.007; Meerdink et al. 2019, doi:10.1016/j.rse.2019.05.015",
        "free, cite",
    ),
    "SLUM": (
        "Spectral Library of impervious Urban Materials (LUMA SLUM)",
        "Kotthaus et al. 2014, doi:10.1016/j.isprsjprs.2014.05.005; data doi:10.5281/zenodo.4263842",
        "CC0, cite",
    ),
}

# Column heading of a two-column table → function to µm, or to reflectance [1].
WAVELENGTH_UNITS = {
    "wavelength_um": lambda value: value,
    "wavelength_nm": lambda value: value / 1e3,
    "wavenumber_cm-1": lambda value: 1e4 / value,
}
# Words of an ECOSTRESS header's X Units and Y Units.
_X_UNITS = (
    (("micromet", "micron", "µm", "(um)"), WAVELENGTH_UNITS["wavelength_um"]),
    (("nanomet", "(nm)"), WAVELENGTH_UNITS["wavelength_nm"]),
    (("wavenumber", "cm-1", "cm^-1", "cm⁻¹", "1/cm"), WAVELENGTH_UNITS["wavenumber_cm-1"]),
)
_Y_UNITS = ((("percent", "%"), 100.0), (("fraction", "unitless", "0-1", "0 to 1", "share", "decimal"), 1.0))
# Below this wavelength there are no spectra of surfaces [µm].
SHORTEST_UM = 0.1
QUANTITIES = {
    "emissivity": lambda value: 1.0 - value,
    "emissivity_percent": lambda value: 1.0 - value / 100.0,
    "reflectance": lambda value: value,
    "reflectance_percent": lambda value: value / 100.0,
}


@dataclass(frozen=True, eq=False)
class Sample:
    """One measured sample."""

    # name, source: Its name, and the file (and column) it comes from
    name: str
    source: str
    library: str  # Key of LIBRARIES, or "" for the user's own
    # wavelength_um, reflectance: (N,) float64 ascending wavelength [µm] and hemispherical reflectance [1] in the
    # thermal range
    wavelength_um: NDArray[np.float64]
    reflectance: NDArray[np.float64]
    # sunlight_um, sunlight_reflectance: (M,) float64 the same in the measured part of the solar range; may be empty
    sunlight_um: NDArray[np.float64]
    sunlight_reflectance: NDArray[np.float64]


def read_sample(path: str | Path, column: str | None = None) -> Sample:
    """Return the Sample of a file of any of the three kinds, which its content distinguishes.

    ECOSTRESS text; a SLUM table (`LUMA_SLUM_IR.csv`, with its short-wave table in the same folder), of which `column`
    is one sample; or a CSV of two columns with the headings wavelength_um, wavelength_nm or wavenumber_cm-1, and
    emissivity, emissivity_percent, reflectance or reflectance_percent.
    """
    path = Path(path)
    if not path.is_file():
        raise ThermorenderError(f"{path} does not exist; give a spectrum file")
    if is_ecostress(path):
        if column is not None:
            raise ThermorenderError(f"{path} is one ECOSTRESS spectrum and has no column {column!r}; leave it out")
        return read_ecostress(path)
    text = read_text(path)
    first = text.partition("\n")[0]
    if not any(axis.partition("_")[0] in first.lower() for axis in WAVELENGTH_UNITS):
        raise _other_headings(path, ", ".join(cell.strip() for cell in first.split(",")))
    header = parsed_table(text, ())[0]
    if column is not None or (len(header) > 2 and header[0].lower() == "wavelength"):
        return read_slum(path, column)
    return read_columns(path)


def is_ecostress(path: str | Path) -> bool:
    """Return whether a file begins with the header of an ECOSTRESS spectrum."""
    with open(path, "rb") as file:
        return b"x units" in file.read(4000).lower()


def read_ecostress(path: str | Path) -> Sample:
    """Return the Sample of an ECOSTRESS file; wavelengths may be in either order, and repeated ones are averaged."""
    path = Path(path)
    if not path.is_file():
        raise ThermorenderError(
            f"{path} does not exist; order the spectrum at https://speclib.jpl.nasa.gov and put it there"
        )
    header, pairs = ecostress_lines(path)
    to_um, divisor = stated_units(path, header)
    if "hemispherical" not in header.get("measurement", "").lower():
        raise ThermorenderError(
            f"{path} was measured as {header.get('measurement', 'not stated')!r}; emissivity is one minus reflectance "
            "for hemispherical reflectance only, so leave the sample out"
        )
    if len(pairs) < 2:
        raise ThermorenderError(
            f"{path} holds {len(pairs)} wavelength and reflectance pairs; order the whole file again"
        )
    _check_extent(path, header, pairs)
    x, y = np.array(pairs).T
    with np.errstate(divide="ignore"):
        wavelength = to_um(x)
    broken = ~(np.isfinite(y) & (wavelength >= SHORTEST_UM) & (wavelength <= LONGEST_WAVELENGTH_UM))
    if broken.any():
        found = pairs[int(broken.argmax())]
        raise ThermorenderError(
            f"{path} holds the pair {found[0]:g}, {found[1]:g}, a wavelength outside {SHORTEST_UM:g}…"
            f"{LONGEST_WAVELENGTH_UM:g} µm or no number; order the file again, or correct its X Units"
        )
    unique, where, count = np.unique(wavelength, return_inverse=True, return_counts=True)
    reflectance = np.bincount(where, weights=y) / count / divisor
    return Sample(
        name=header.get("name", path.stem), source=path.name, library="ECOSTRESS", wavelength_um=unique,
        reflectance=reflectance, sunlight_um=unique, sunlight_reflectance=reflectance,
    )  # fmt: skip


def _check_extent(path: Path, header: Mapping[str, str], pairs: Sequence[tuple[float, float]]) -> None:
    """Refuse pairs that are not as many, or do not begin and end, as a header states."""
    names = ("number of x values", "first x value", "last x value")
    try:
        count, *ends = (decimal(header[name]) for name in names)
    except (KeyError, ValueError):
        return
    found = sorted((pairs[0][0], pairs[-1][0]))
    if count != len(pairs) or not np.allclose(found, sorted(ends), rtol=0.01):
        raise ThermorenderError(
            f"{path} holds {len(pairs)} pairs from {found[0]:g} to {found[1]:g} where its header states {count:g} from "
            f"{min(ends):g} to {max(ends):g}; order the whole file again, or correct the header if you edited the file"
        )


def stated_units(
    path: str | Path, header: dict[str, str]
) -> tuple[Callable[[NDArray[np.float64]], NDArray[np.float64]], float]:
    """Return (function of x to µm, what reflectance 1 is in y) that the header of an ECOSTRESS file states."""
    x, y = header.get("x units", "nothing"), header.get("y units", "nothing")
    to_um = next((unit for words, unit in _X_UNITS if any(word in x.lower() for word in words)), None)
    divisor = next((one for words, one in _Y_UNITS if any(word in y.lower() for word in words)), None)
    # Libraries spell reflectance in several ways.
    if to_um is None or divisor is None or "reflect" not in y.lower():
        raise ThermorenderError(
            f"{path} states x units {x!r} and y units {y!r}; only hemispherical reflectance in percent or as a "
            "fraction, over µm, nm or cm-1, is read from such a file, so write an emissivity as a CSV with the "
            "headings wavelength_um and emissivity, and leave a transmittance out"
        )
    return to_um, divisor


def ecostress_lines(path: str | Path) -> tuple[dict[str, str], list[tuple[float, float]]]:
    """Return the header of an ECOSTRESS file with lower-case keys, and its (x, y) pairs in file order."""
    header: dict[str, str] = {}
    pairs: list[tuple[float, float]] = []
    # Some headers have degree signs in latin-1, which decodes any byte.
    for line in Path(path).read_text(encoding="latin-1").splitlines():
        key, colon, value = line.partition(":")
        if colon and not pairs:
            header[key.strip().lower()] = value.strip()
            continue
        try:
            wavelength, percent = (decimal(cell) for cell in line.split())
        except ValueError:
            continue
        pairs.append((wavelength, percent))
    return header, pairs


def read_slum(path: str | Path, column: str | None) -> Sample:
    """Return the Sample of one column of a SLUM table of emissivity against µm, with its short-wave reflectance.

    The short-wave reflectance [%] against nm comes from the file with `_SW` for `_IR` in the same folder, if any.
    """
    path = Path(path)
    wavelength, emissivity = _slum_column(path, column)
    beside = path.with_name(path.name.replace("_IR", "_SW"))
    sunlight, percent = np.empty(0), np.empty(0)
    if beside != path and beside.is_file():
        sunlight, percent = _slum_column(beside, column)
    return Sample(
        name=f"SLUM {column}",
        source=f"{path.name}#{column}",
        library="SLUM",
        wavelength_um=wavelength,
        reflectance=1.0 - emissivity,
        sunlight_um=sunlight / 1e3,
        sunlight_reflectance=percent / 100.0,
    )


def read_columns(path: str | Path) -> Sample:
    """Return the Sample of a CSV of two columns whose headings state quantity and unit."""
    path = Path(path)
    rows = read_table(path, ())
    header = list(rows[0][1]) if rows else []
    axes, quantities = ([key for key in kind if key in header] for kind in (WAVELENGTH_UNITS, QUANTITIES))
    through = [key for key in header if "transmi" in key.lower()]
    if through:
        raise ThermorenderError(
            f"{path} has a column {through[0]!r}; emissivity is one minus reflectance for opaque samples only, so "
            "leave the sample out, or delete the column if it is 0 throughout"
        )
    if len(axes) != 1 or len(quantities) != 1:
        raise _other_headings(path, ", ".join(header))
    first, second = axes[0], quantities[0]
    values = np.array([[_number(path, row, key, cells[key]) for key in (first, second)] for row, cells in rows])
    with np.errstate(divide="ignore"):
        wavelength = WAVELENGTH_UNITS[first](values[:, 0])
    order = np.argsort(wavelength)
    wavelength, reflectance = wavelength[order], QUANTITIES[second](values[order, 1])
    if len(wavelength) < 2 or np.any(np.diff(wavelength) <= 0.0) or wavelength[0] <= 0.0:
        raise ThermorenderError(
            f"{path} needs at least two rows with different, positive {first}; `thermorender materials check` finds "
            "the fault"
        )
    if wavelength[0] < SHORTEST_UM or wavelength[-1] > LONGEST_WAVELENGTH_UM:
        raise ThermorenderError(
            f"{path} covers {wavelength[0]:g}–{wavelength[-1]:g} µm by its heading {first}, but spectra lie within "
            f"{SHORTEST_UM:g}…{LONGEST_WAVELENGTH_UM:g} µm; correct the heading or the values"
        )
    return Sample(path.stem, path.name, "", wavelength, reflectance, wavelength, reflectance)


def _other_headings(path: Path, found: str) -> ThermorenderError:
    return ThermorenderError(
        f"{path}, row 1 holds {shortened(found.strip()) or 'nothing'}; the headings must be one of "
        f"{', '.join(WAVELENGTH_UNITS)} and one of {', '.join(QUANTITIES)}, which state the units"
    )


def _number(path: Path, row: int, column: str, text: str) -> float:
    """Return a cell as a finite float."""
    return number_in_cell(path, row, column, text, -1e9, 1e9, "correct the cell")


def _slum_column(path: Path, column: str | None) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    rows = read_table(path, ("wavelength",))
    names = [key for key in rows[0][1] if key != "wavelength"] if rows else []
    if column is None or column not in names:
        raise ThermorenderError(
            f"{path} holds the samples {', '.join(names[:3])} … {', '.join(names[-1:])}, not {column!r}; name one as "
            "column"
        )
    values = [[_number(path, row, key, cells[key]) for key in ("wavelength", column)] for row, cells in rows]
    wavelength, value = np.array(sorted(values)).T
    if np.any(np.diff(wavelength) <= 0.0):
        raise ThermorenderError(f"{path} repeats a wavelength; keep one row for each")
    return wavelength, value
