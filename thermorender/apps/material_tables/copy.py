"""A copy of a material under another name, with some of its properties set to other values."""

from collections.abc import Mapping
from pathlib import Path

from thermorender.errors import ThermorenderError
from thermorender.materials.csv_tables import (
    INDEX_COLUMNS,
    ROUGHNESS_COLUMN,
    SOLAR_STD_COLUMN,
    SPECTRUM_COLUMNS,
    read_table,
    read_text,
)
from thermorender.materials.library import find, load_library
from thermorender.materials.store import store
from thermorender.materials.thermal import CHOSEN, PROPERTIES, table_text, with_values
from thermorender.paths import data_folder
from thermorender.schema import did_you_mean

# Columns of the index that describe the material itself.
_OF_INDEX = (
    "title", "colour_r", "colour_g", "colour_b", "solar_absorptance", SOLAR_STD_COLUMN, "temperature_k",
    ROUGHNESS_COLUMN, "note",
)  # fmt: skip


def copy_material(
    source: str, name: str, directory: str | Path, settings: Mapping[str, str], library: str | Path | None = None,
    replace: bool = False,
) -> None:  # fmt: skip
    """Write a copy of a material into a materials folder, with other values of some properties, {name: text}.

    `settings` are columns of the index and properties of the thermal table; "emissivity" makes the spectrum of a
    Lambertian material constant. The copy's note and sources say what was set. `library` overrides the shipped one; a
    copy of its source's own name is a scene's version of that material.
    """
    known = find(load_library(library), source, "materials copy")
    own = None if library is None else _row(Path(library), source)
    folder = Path(library) if library is not None and own is not None else data_folder("materials")
    row = dict(own or _row(folder, source) or {})
    allowed = (*_OF_INDEX, "emissivity", *PROPERTIES)
    for key in settings:
        if key not in allowed:
            raise ThermorenderError(
                f"--set {key}: not a property of a material; {did_you_mean(key, allowed)}give one of "
                f"{', '.join(allowed)}"
            )
    spectrum = read_text(folder / "spectra" / f"{source}.csv")
    if "emissivity" in settings:
        if known.directional != "lambertian":
            raise ThermorenderError(
                f"--set emissivity: {source} emits by angle ({known.directional}); copy a Lambertian material, or "
                "import a spectrum"
            )
        lines = [f"{wavelength:.9g},{settings['emissivity']}," for wavelength in known.wavelength_um]
        spectrum = "\n".join([",".join(SPECTRUM_COLUMNS), *lines]) + "\n"
    of_index = {key: text for key, text in settings.items() if key in _OF_INDEX}
    shown = ", ".join(f"{key}={text}" for key, text in settings.items() if key not in ("title", "note"))
    note = f"Copy of {source}" + (f" with {shown}" if shown else "") + "."
    row |= {"name": name, "note": " ".join(filter(None, (note, row.get("note", ""))))} | of_index
    thermal = {key: text for key, text in settings.items() if key in PROPERTIES}
    store(row, spectrum, directory, replace, _thermal_text(known, thermal))


def _row(folder, name):
    """The cells of a material in a folder's index, or None."""
    index = folder / "index.csv"
    if not index.is_file():
        return None
    return next((cells for _, cells in read_table(index, INDEX_COLUMNS) if cells["name"] == name), None)


def _thermal_text(material, settings):
    """Text of the thermal table with other values, or None without a table and values."""
    if material.thermal is None and not settings:
        return None
    source = f"{CHOSEN} set in a copy of {material.name}"
    made, faults = with_values(material.thermal, settings, source)
    if made is None:
        raise ThermorenderError(f"--set: {faults[0]}")
    return table_text(made)
