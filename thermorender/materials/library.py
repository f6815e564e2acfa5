"""The material library: materials read from tables that a person edits in a spreadsheet.

A library is a folder with `index.csv` (one row per material), `spectra/<name>.csv` (its measured emissivity, its
refractive index, or its emissivity by angle) and, for materials of a heat balance, `thermal/<name>.csv`. The package
ships one; a scene's own `materials/` folder overrides it.
"""

import functools
import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.materials.csv_tables import (
    INDEX_COLUMNS,
    OPTIONAL_COLUMNS,
    ROUGHNESS_COLUMN,
    SOLAR_STD_COLUMN,
    contained,
    parsed_number,
    read_angles,
    read_emissivity,
    read_refractive_index,
    read_table,
)
from thermorender.materials.material import Material
from thermorender.materials.thermal import Thermal, beneath, read_thermals, stacked
from thermorender.paths import data_folder
from thermorender.physics.fresnel import LARGEST_SLOPE
from thermorender.schema import closest
from thermorender.units import LOWEST_KELVIN, ZERO_CELSIUS_K

# Angular models of emissivity; the model determines the columns of `spectra/<name>.csv`.
DIRECTIONAL_MODELS = ("lambertian", "fresnel", "table")
NAME = re.compile(r"[A-Za-z0-9_-]+")
# Numbers of a row of the index: lowest and highest value, and the advice for others.
_LIMITS = {
    "solar_absorptance": (0.0, 1.0, "give the share absorbed, 0.7 for 70 %"),
    "temperature_k": (LOWEST_KELVIN, 6000.0, f"values are kelvin, add {ZERO_CELSIUS_K} to °C"),
    "samples": (1.0, 1e6, "count the measured samples"),
    **{f"colour_{c}": (0.0, 255.0, "give sRGB as a colour picker shows it") for c in "rgb"},
    ROUGHNESS_COLUMN: (0.0, LARGEST_SLOPE, "give the root mean square slope, 0 for a mirror"),
    SOLAR_STD_COLUMN: (0.0, 1.0, "give one standard deviation, or leave the cell empty"),
}


def find(library: Mapping[str, Material], name: str, where: str) -> Material:
    """Return the material `name` of the library.

    Parameters
    ----------
    library : dict of str to Material
        From `load_library`.
    name : str
        Name as the user wrote it.
    where : str
        Place in the user's input for the message, e.g. `scene.toml, object "marker"`.

    Raises
    ------
    ThermorenderError
        The library has no such material; the message lists the closest names.
    """
    if name in library:
        return library[name]
    close = closest(name, library, count=3, cutoff=0.4)
    hint = f"the closest are {', '.join(close)}" if close else f"it holds {', '.join(sorted(library))}"
    raise ThermorenderError(
        f"{where} uses material {name!r}, which the library does not hold; {hint}; use one it "
        "holds, or add yours to a materials/ folder of the scene (index.csv and spectra/)"
    )


def load_library(directory: str | Path | None = None) -> dict[str, Material]:
    """Return the shipped materials by name, overridden by those of a folder of the same form.

    Parameters
    ----------
    directory : path, optional
        Folder with `index.csv`, `spectra/` and `thermal/`, e.g. a scene's own `materials/`. A row with its spectrum
        replaces the shipped ones of the same name; independently, so does a thermal table. A folder with only
        `thermal/` needs no index. A thermal table that another one names as `beneath` needs no material.

    Raises
    ------
    ThermorenderError
        A table is missing or has an invalid cell, thermal properties belong to no material, or the material beneath
        is unknown; the message names file and row.
    """
    shipped = data_folder("materials")
    first, thermals = _read_once(shipped, _state(shipped))
    library, where = dict(first), shipped
    if directory is not None:
        where = Path(directory)
        library |= read_library(where)
        own = read_thermals(where)
        # The folder's own come first, so that their faults are reported first.
        thermals = own | {name: thermal for name, thermal in thermals.items() if name not in own}
        for name in own:
            if name not in {*library, *beneath(thermals)}:
                raise ThermorenderError(f"{where / 'thermal' / name}.csv {stray(name, library)}")
    for name, thermal in stacked(thermals, where).items():
        if name in library:
            library[name] = replace(library[name], thermal=thermal)
    return library


@functools.lru_cache(maxsize=2)
def _read_once(
    directory: Path, state: frozenset[tuple[str, int, int]]
) -> tuple[dict[str, Material], dict[str, Thermal]]:
    """The materials and thermal tables of a folder, read again when `state` differs.

    Arrays are read-only: scenes share them.
    """
    library = read_library(directory)
    for material in library.values():
        for value in vars(material).values():
            if isinstance(value, np.ndarray):
                value.flags.writeable = False
    return library, read_thermals(directory)


def _state(directory: Path) -> frozenset[tuple[str, int, int]]:
    """Name, time of the last change [ns] and size of each table of a folder."""
    tables = [entry for part in (".", "spectra", "thermal") for entry in os.scandir(directory / part)]
    return frozenset((entry.path, entry.stat().st_mtime_ns, entry.stat().st_size) for entry in tables)


def stray(name: str, library: Iterable[str]) -> str:
    """Return the fault of a thermal table whose name no material has, as a clause."""
    near = closest(name, library)
    hint = f"did you mean {near[0]}? " if near else ""
    return f"belongs to no material; {hint}name it after one, beneath another, or add a row to index.csv and a spectrum"


def read_library(directory: Path) -> dict[str, Material]:
    """Return the materials of one folder by name; `load_library` adds the materials beneath their layers."""
    index = directory / "index.csv"
    thermals = read_thermals(directory)
    library: dict[str, Material] = {}
    if thermals and not index.exists():
        return library
    for row, cells in read_table(contained(index, directory), INDEX_COLUMNS):
        name = cells["name"]
        # The name becomes a file name, so it must not contain a path.
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


def parsed_row(cells: Mapping[str, str]) -> tuple[dict[str, float | None], list[str]]:
    """Return ({column: number, or None without one}, sentences on all faults) of a row of the index."""
    faults = [
        f"{column} of material {cells['name']!r} is empty; say where the numbers come from and on what terms ('own "
        "measurement, 2024' will do)"
        for column in ("title", "source", "citation", "licence")
        if not cells[column]
    ]
    if cells["directional"] not in DIRECTIONAL_MODELS:
        faults.append(f"directional={cells['directional']!r} is not known; write {' or '.join(DIRECTIONAL_MODELS)}")
    numbers: dict[str, float | None] = {}
    for column, (low, high, advice) in _LIMITS.items():
        if column in OPTIONAL_COLUMNS and not cells.get(column):
            numbers[column] = None
            continue
        numbers[column], fault = parsed_number(column, cells[column], low, high, advice)
        faults += [fault] if fault else []
    return numbers, faults


def _read_material(
    directory: Path, index: Path, row: int, cells: Mapping[str, str], thermal: Thermal | None
) -> Material:
    """Return the material of one row of the index together with its spectrum and thermal properties."""
    numbers, faults = parsed_row(cells)
    for fault in faults:
        raise ThermorenderError(f"{index}, row {row}: {fault}")
    number = {column: value or 0.0 for column, value in numbers.items()}
    path = contained(directory / "spectra" / f"{cells['name']}.csv", directory)
    if cells["directional"] == "fresnel":
        spectrum = read_refractive_index(path, number[ROUGHNESS_COLUMN])
    else:
        spectrum = {"lambertian": read_emissivity, "table": read_angles}[cells["directional"]](path)
    red, green, blue = (round(number[f"colour_{c}"]) for c in "rgb")
    return Material(
        name=cells["name"], title=cells["title"], **spectrum, rms_slope=number[ROUGHNESS_COLUMN],
        colour=(red, green, blue), solar_absorptance=number["solar_absorptance"],
        temperature=number["temperature_k"], source=cells["source"], citation=cells["citation"],
        licence=cells["licence"], directional=cells["directional"], samples=int(number["samples"]),
        note=cells["note"], solar_absorptance_std=numbers[SOLAR_STD_COLUMN], thermal=thermal,
    )  # fmt: skip
