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
    ROUGHNESS_COLUMN,
    SOLAR_STD_COLUMN,
    number_in_cell,
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
from thermorender.units import kelvin

# Angular models of emissivity; the model determines the columns of `spectra/<name>.csv`.
DIRECTIONAL_MODELS = ("lambertian", "fresnel", "table")
NAME = re.compile(r"[A-Za-z0-9_-]+")


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
    thermals, library = read_thermals(directory), {}
    if thermals and not index.exists():
        return library
    for row, cells in read_table(index, INDEX_COLUMNS, directory):
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

    def number(column, low, high, advice):
        return number_in_cell(index, row, column, cells[column], low, high, advice)

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
        name=cells["name"], title=cells["title"], **spectrum, rms_slope=rms_slope,
        colour=tuple(round(c) for c in colour),
        solar_absorptance=number("solar_absorptance", 0.0, 1.0, "give the share absorbed, 0.7 for 70 %"),
        temperature=temperature, source=cells["source"], citation=cells["citation"], licence=cells["licence"],
        directional=cells["directional"], samples=int(number("samples", 1, 1e6, "count the measured samples")),
        note=cells["note"], solar_absorptance_std=solar_std, thermal=thermal,
    )  # fmt: skip
