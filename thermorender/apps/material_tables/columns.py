"""Columns of a spectrum's table: which is the wavelength, which the emissivity or reflectance, and in which units.

Headings in other words, such as "Wavelength (µm)" or "Emissivity [%]", and numbers that allow one unit only become the
headings of `WAVELENGTH_UNITS` and `QUANTITIES`. What leaves a doubt is a fault with its correction.
"""

import re
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.materials.csv_tables import Fault, Rows, decimal, is_decimal, parsed_table

# Column heading of a two-column table → function to µm, or to reflectance [1].
WAVELENGTH_UNITS: dict[str, Callable[[Any], Any]] = {
    "wavelength_um": lambda value: value,
    "wavelength_nm": lambda value: value / 1e3,
    "wavenumber_cm-1": lambda value: 1e4 / value,
}
QUANTITIES: dict[str, Callable[[Any], Any]] = {
    "emissivity": lambda value: 1.0 - value,
    "emissivity_percent": lambda value: 1.0 - value / 100.0,
    "reflectance": lambda value: value,
    "reflectance_percent": lambda value: value / 100.0,
}
# Below this wavelength there are no spectra of surfaces [µm]. No spectrum in µm reaches the second one, and any in nm
# or cm⁻¹ is above it.
SHORTEST_UM, _LONGEST_UM = 0.1, 100.0
# Range that a table should cover: every LWIR camera's band with a margin.
WANTED_RANGE_UM = (7.0, 14.0)
# Weak samples are noise around zero, of up to this share beyond 0…1.
NOISE = 0.01

_WORDS = {
    "wavelength": ("wavelength", "wavelengths", "lambda", "λ", "wl"),
    "wavenumber": ("wavenumber", "wavenumbers"),
    "emissivity": ("emissivity", "emissivities", "emittance", "eps", "epsilon", "ε"),
    "reflectance": ("reflectance", "reflectances", "reflectivity", "refl", "rho", "ρ", "r"),
    # As `str.casefold` writes the micro sign.
    "um": ("μm", "um", "micron", "microns", "micrometer", "micrometers", "micrometre", "micrometres"),
    "nm": ("nm", "nanometer", "nanometers", "nanometre", "nanometres"),
    "cm-1": ("cm-1",),
    "percent": ("%", "percent", "pct"),
    "share": ("fraction", "unitless"),
    "": ("spectral", "hemispherical", "directional"),
}
_ORDINALS = ("first", "second")
_HEADINGS = {
    ("axis", "um"): "wavelength_um", ("axis", "nm"): "wavelength_nm", ("axis", "cm-1"): "wavenumber_cm-1",
    ("emissivity", "share"): "emissivity", ("emissivity", "percent"): "emissivity_percent",
    ("reflectance", "share"): "reflectance", ("reflectance", "percent"): "reflectance_percent",
}  # fmt: skip
_KINDS = {word: kind for kind, words in _WORDS.items() for word in words}
_INVERSE_CM = re.compile(r"cm\s*(?:\^|\*\*)?\s*[-−⁻]\s*[1¹]|1\s*/\s*cm")
_UNITLESS = re.compile(r"[\[(]\s*(?:[-–−]|1|0\s*[-–…]\s*1)\s*[\])]")
_TOKEN = re.compile(r"cm-1|%|[^\W_]+")
_NUMBER = r"[-+]?(?:\d+[.,]?\d*|[.,]\d+)(?:[eE][-+]?\d+)?"
_SPACED = re.compile(rf"[ \t]*({_NUMBER})[ \t]+({_NUMBER})[ \t]*")


def parsed_spectrum(text: str) -> tuple[list[str], Rows, list[Fault], bool]:
    """Return (column names, rows, faults, whether a unit follows from the values) of a spectrum's CSV text.

    The columns of wavelength and quantity have the headings of this module where the text leaves no doubt which these
    are; otherwise all columns keep their own. Two columns of numbers without headings are wavelength or wavenumber, and
    emissivity. A unit that no heading states follows from the values: wavelengths up to 100 are µm, larger ones nm or,
    without a heading, those of nm and cm⁻¹ that lie within 7–14 µm; values that all exceed 1 are percent.
    """
    header, rows, faults = parsed_table(_tabbed(text), ())
    # Columns without a single cell, as spreadsheets add them.
    header = [key for key in header if key or any(cells[key] for _, cells in rows)]
    if faults or not rows:
        return header, rows, faults, False
    bare = header[0] == "column_1"
    if not bare and all(re.fullmatch(_NUMBER, key) for key in header):
        fault = f"row 1 holds {', '.join(header)} with different decimal marks; write a point in all numbers"
        return header, rows, [(None, fault)], False
    if bare and len(header) != 2:
        return header, rows, [(None, _without_headings(len(header)))], False
    kinds = [("axis", ""), ("emissivity", "")] if bare else list(map(_kind, header))
    axes = [k for k, (kind, _) in enumerate(kinds) if kind in ("axis", "wavelength", "wavenumber")]
    values = [k for k, (kind, _) in enumerate(kinds) if kind in ("emissivity", "reflectance")]
    if len(axes) != 1 or len(values) != 1:
        return header, rows, [], False
    names, inferred = {}, False
    for at, unit_of in ((axes[0], _unit), (values[0], _scale)):
        key, (kind, unit) = header[at], kinds[at]
        if not unit:
            numbers = np.array([decimal(cells[key]) for _, cells in rows if is_decimal(cells[key])])
            unit, fault = unit_of(f"the {_ORDINALS[at]} column" if bare else key, kind, numbers)
            if fault:
                return header, rows, [(None, fault)], False
            inferred |= bare or unit != "share"
        names[key] = _HEADINGS[kind if unit in ("percent", "share") else "axis", unit]
    renamed = [(row, {names.get(key, key): cell for key, cell in cells.items()}) for row, cells in rows]
    return [names.get(key, key) for key in header], renamed, [], inferred


def _tabbed(text: str) -> str:
    """A text whose lines below the first are two numbers with spaces between them, with tabs in their place."""
    lines = text.split("\n")
    below = [line for line in lines if line.strip()][1:]
    if not below or not all(map(_SPACED.fullmatch, below)):
        return text
    return "\n".join("\t".join(line.split()) if len(line.split()) == 2 else line for line in lines)


def _kind(heading: str) -> tuple[str, str]:
    """(Kind of a column, unit that its heading states or ""); ("", "") for words that are not known."""
    tokens = _TOKEN.findall(_INVERSE_CM.sub(" cm-1 ", _UNITLESS.sub(" fraction ", heading.casefold())))
    found = [_KINDS.get(token) for token in tokens]
    known = [kind for kind in found if kind]
    if None in found or len(known) != len(set(known)):
        return "", ""
    axis = [kind for kind in known if kind in ("wavelength", "wavenumber")]
    quantity = [kind for kind in known if kind in ("emissivity", "reflectance")]
    unit = [kind for kind in known if kind in ("um", "nm", "cm-1")]
    scale = [kind for kind in known if kind in ("percent", "share")]
    # ε(λ) is a quantity.
    if len(quantity) == 1 and not unit and len(scale) <= 1:
        return quantity[0], "".join(scale)
    if quantity or scale or len(axis) > 1 or len(unit) > 1 or not known:
        return "", ""
    if axis and unit and (axis[0] == "wavenumber") != (unit[0] == "cm-1"):
        return "", ""
    return (axis or ["axis"])[0], "cm-1" if axis == ["wavenumber"] else "".join(unit)


def _unit(column: str, kind: str, values: NDArray[np.float64]) -> tuple[str, str]:
    """(Unit of wavelengths or wavenumbers by their range, fault or "")."""
    low, high = (float(values.min()), float(values.max())) if values.size else (SHORTEST_UM, SHORTEST_UM)
    if low >= SHORTEST_UM and high <= _LONGEST_UM:
        return "um", ""
    units = ["nm", "cm-1"] if kind == "axis" else ["nm"]
    if kind == "axis" and low > _LONGEST_UM:
        ranges = {"nm": (low / 1e3, high / 1e3), "cm-1": (1e4 / high, 1e4 / low)}
        first, last = WANTED_RANGE_UM
        units = [unit for unit, (start, end) in ranges.items() if start < last and end > first]
    if low > _LONGEST_UM and len(units) == 1:
        return units[0], ""
    return "", (
        f"{column} runs over {low:g}–{high:g} without a unit; write {', '.join(WAVELENGTH_UNITS)} above it, whichever "
        "it is"
    )


def _scale(column: str, kind: str, values: NDArray[np.float64]) -> tuple[str, str]:
    """(Whether values are "percent" or a "share" by their range, fault or "")."""
    low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 0.0)
    if high <= 1.0 + NOISE:
        return "share", ""
    if low > 1.0 + NOISE and high <= 100.0 * (1.0 + NOISE):
        return "percent", ""
    if high > 100.0 * (1.0 + NOISE):
        return "", f"{column} runs up to {high:g}, but is a share 0…1 or 0…100 percent; correct the values"
    above = int(np.count_nonzero(values > 1.0 + NOISE))
    return "", (
        f"{column} runs over {low:g}–{high:g}, and {above} of {values.size} rows exceed 1; write {kind}_percent above "
        "it if all are percent, or correct these rows"
    )


def _without_headings(count: int) -> str:
    return (
        f"has numbers in {count} column{'s'[: count != 1]} without headings; give two, of wavelength and emissivity "
        "with a point as decimal mark, or write headings above them such as wavelength_um and emissivity"
    )
