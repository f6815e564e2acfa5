"""Measured samples from files: ECOSTRESS text, a column of a SLUM table, or a CSV of two columns.

Every file becomes hemispherical reflectance over ascending wavelength in µm. The file itself must state quantity and
unit, or allow one only.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.material_tables.columns import QUANTITIES, SHORTEST_UM, WAVELENGTH_UNITS, parsed_spectrum
from thermorender.errors import ThermorenderError, shortened
from thermorender.materials.csv_tables import (
    LONGEST_WAVELENGTH_UM,
    Rows,
    decimal,
    number_in_cell,
    read_table,
    read_text,
    refuse,
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

# Words of an ECOSTRESS header's X Units and Y Units.
_X_UNITS = (
    (("micromet", "micron", "µm", "(um)"), WAVELENGTH_UNITS["wavelength_um"]),
    (("nanomet", "(nm)"), WAVELENGTH_UNITS["wavelength_nm"]),
    (("wavenumber", "cm-1", "cm^-1", "cm⁻¹", "1/cm"), WAVELENGTH_UNITS["wavenumber_cm-1"]),
)
# For the words of a Sample: what is read as µm and as emissivity.
_UNITS_READ = {"wavelength_nm": "nm", "wavenumber_cm-1": "cm⁻¹"}
_QUANTITIES_READ = {
    "emissivity": "", "emissivity_percent": "percent", "reflectance": "reflectance",
    "reflectance_percent": "reflectance in percent",
}  # fmt: skip
_Y_UNITS = ((("percent", "%"), 100.0), (("fraction", "unitless", "0-1", "0 to 1", "share", "decimal"), 1.0))


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
    how: str = ""  # How its numbers became emissivity, as "percent read as "; "" for emissivity
    rest: str = ""  # What else is to be known of the file, as "; 2 repeated rows left out"
    inferred: bool = False  # Whether a unit follows from the values, since no heading states it

    @property
    def words(self) -> str:
        """What was read, as "61 rows, 7–14 µm, percent read as emissivity 0.04–0.05"."""
        ends = [f"{1.0 - share:.3g}" for share in (self.reflectance.max(), self.reflectance.min())]
        low, high = self.wavelength_um[[0, -1]]
        count, values = self.wavelength_um.size, "–".join(dict.fromkeys(ends))
        return f"{count} rows, {low:g}–{high:g} µm, {self.how}emissivity {values}{self.rest}"


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
    header, rows, faults, inferred = parsed_spectrum(text)
    stated = [[key for key in kind if key in header] for kind in (WAVELENGTH_UNITS, QUANTITIES)]
    doubtful = any(row is None for row, _ in faults)
    if not doubtful and not all(stated) and not any("wave" in key.lower() for key in header):
        raise _other_headings(path, header or [text.strip().partition("\n")[0]])
    if column is not None or (len(header) > 2 and header[0].lower() == "wavelength"):
        return read_slum(path, column)
    refuse(path, faults)
    return _of_columns(path, header, rows, stated, inferred)


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
        how=f"{_QUANTITIES_READ['reflectance_percent' if divisor > 1.0 else 'reflectance']} read as ",
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


def _of_columns(
    path: Path, header: Sequence[str], rows: Rows, stated: Sequence[Sequence[str]], inferred: bool
) -> Sample:
    """The Sample of the rows of a CSV of two columns; `stated` are its headings of wavelengths and of quantities."""
    through = [key for key in header if "transmi" in key.lower()]
    if through:
        raise ThermorenderError(
            f"{path} has a column {through[0]!r}; emissivity is one minus reflectance for opaque samples only, so "
            "leave the sample out, or delete the column if it is 0 throughout"
        )
    if [len(each) for each in stated] != [1, 1]:
        raise _other_headings(path, header)
    first, second = stated[0][0], stated[1][0]
    values = np.array([[_number(path, row, key, cells[key]) for key in (first, second)] for row, cells in rows])
    pairs = np.unique(values.reshape(-1, 2), axis=0)
    again = np.flatnonzero(np.diff(pairs[:, 0]) == 0.0)
    if again.size:
        one, other = pairs[again[0] : again[0] + 2, 1]
        raise ThermorenderError(
            f"{path} gives {first}={pairs[again[0], 0]:g} twice, with {second}={one:g} and {other:g}; keep one row for "
            "each"
        )
    with np.errstate(divide="ignore"):
        wavelength = WAVELENGTH_UNITS[first](pairs[:, 0])
    order = np.argsort(wavelength)
    wavelength, reflectance = wavelength[order], QUANTITIES[second](pairs[order, 1])
    if len(wavelength) < 2 or wavelength[0] <= 0.0:
        raise ThermorenderError(
            f"{path} needs at least two rows with different, positive {first}; `thermorender materials check` finds "
            "the fault"
        )
    if wavelength[0] < SHORTEST_UM or wavelength[-1] > LONGEST_WAVELENGTH_UM:
        raise ThermorenderError(
            f"{path} covers {wavelength[0]:g}–{wavelength[-1]:g} µm by its heading {first}, but spectra lie within "
            f"{SHORTEST_UM:g}…{LONGEST_WAVELENGTH_UM:g} µm; correct the heading or the values"
        )
    unused = [key for key in header if key not in (first, second)]
    rest = [f"; {len(values) - len(pairs)} repeated rows left out" if len(values) > len(pairs) else ""]
    rest += [f"; {', '.join(unused)} not used" if unused else ""]
    how = [_UNITS_READ.get(first, ""), _QUANTITIES_READ[second]]
    words = f"{' and '.join(filter(None, how))} read as {'µm and ' if how[0] else ''}" if any(how) else ""
    return Sample(
        path.stem, path.name, "", wavelength, reflectance, wavelength, reflectance, words, "".join(rest), inferred
    )


def _other_headings(path: Path, found: Sequence[str]) -> ThermorenderError:
    return ThermorenderError(
        f"{path}, row 1 holds {shortened(', '.join(found)) or 'nothing'}; the headings must be one of "
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
