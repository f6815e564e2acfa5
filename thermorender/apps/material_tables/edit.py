"""Edits of a library's materials by the texts of their tables, refused in the tables' own sentences."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.material_tables.from_samples import from_samples, is_refractive_index
from thermorender.apps.material_tables.samples import read_sample
from thermorender.errors import ThermorenderError
from thermorender.materials.csv_tables import (
    INDEX_COLUMNS,
    ROUGHNESS_COLUMN,
    SHARE_ADVICE,
    SOLAR_STD_COLUMN,
    SPECTRUM_COLUMNS,
    decimal,
    gaps,
    parsed_number,
    read_refractive_index,
    read_table,
    read_text,
)
from thermorender.materials.library import find, load_library, parsed_row
from thermorender.materials.material import Material
from thermorender.materials.store import index_row, store
from thermorender.materials.thermal import CHOSEN, PROPERTIES, Thermal, stacked, table_text, with_values
from thermorender.paths import data_folder
from thermorender.schema import did_you_mean

# A flat emissivity, as a property beside those of the tables.
EMISSIVITY = "emissivity"
# Columns of the index that an edit may set.
_NUMBERS = ("solar_absorptance", SOLAR_STD_COLUMN, "temperature_k")
_TEXTS = ("title", "source", "citation", "licence", "note")
# Columns of the index that a copy may set.
_OF_COPY = ("title", "colour_r", "colour_g", "colour_b", *_NUMBERS, ROUGHNESS_COLUMN, "note")
# Source of thermal values, and begin of the note on others, that an edit sets.
_SOURCE, _NOTE = f"{CHOSEN} set by hand", "Set by hand: "


def text_of(material: Material, key: str) -> str:
    """Return the text of a property: a column of the index, a thermal property, or a flat emissivity."""
    if key == EMISSIVITY:
        low, high = float(material.emissivity.min()), float(material.emissivity.max())
        return f"{low:.4g}" if low == high else ""
    if key in PROPERTIES:
        value = None if material.thermal is None else getattr(material.thermal, key)
        return f"{value:.6g}" if isinstance(value, float) else str(value or "")
    return str(index_row(material).get(key, ""))


def is_chosen(material: Material, key: str) -> bool:
    """Return whether the value of a property was chosen, not measured."""
    if material.thermal is not None and key in material.thermal.chosen:
        return True
    if key == SOLAR_STD_COLUMN:
        return material.solar_absorptance_std is None
    return key == "temperature_k" or f"{key}=" in material.note.partition(_NOTE)[2]


def with_text(library: Mapping[str, Material], name: str, key: str, text: str) -> Mapping[str, Material]:
    """Return a library in which a property of a material has another text; the same object where nothing changes.

    A thermal value also changes in the materials that lie on this one. What was set stands in the note or the source.

    Raises
    ------
    ThermorenderError
        An unknown material or property; or the tables would refuse the text: the message is theirs.
    """
    allowed = (EMISSIVITY, *PROPERTIES, *_NUMBERS, *_TEXTS)
    if key not in allowed:
        raise ThermorenderError(f"key={key!r} is not a property that a text sets; use one of {', '.join(allowed)}")
    material, text = find(library, name, "with_text"), text.strip()
    if text == text_of(material, key):
        return library
    if key in PROPERTIES:
        return _with_thermal(library, material, key, text)
    if key == EMISSIVITY:
        grid = material.wavelength_um
        return {**library, name: with_spectrum(material, grid, np.full(grid.size, share(text)), f"{key}={text}")}
    row = {column: str(value) for column, value in index_row(material).items()} | {key: text}
    for fault in parsed_row(row)[1]:
        raise ThermorenderError(fault)
    new: dict[str, Any] = {key: text}
    if key in _NUMBERS:
        number = decimal(text) if text else None
        new = {key.removesuffix("_k"): number, "note": _noted(material.note, f"{key}={text}")}
    return {**library, name: replace(material, **new)}


def share(text: str) -> float:
    """Return an emissivity 0…1; ThermorenderError, in the words of a table, for any other text."""
    value, fault = parsed_number(EMISSIVITY, text, 0.0, 1.0, SHARE_ADVICE)
    if value is None:
        raise ThermorenderError(fault)
    return value


def _noted(note: str, what: str) -> str:
    """A note that says what was set; the latest value of each property counts."""
    key = what.partition("=")[0]
    before, _, set_ = note.partition(_NOTE)
    parts = [each for each in set_.removesuffix(".").split(", ") if each and each.partition("=")[0] != key]
    first = f"{before.strip().rstrip('.;')}. " if before.strip() else ""
    return f"{first}{_NOTE}{', '.join([*parts, what])}."


def _with_thermal(library: Mapping[str, Material], material: Material, key: str, text: str) -> dict[str, Material]:
    thermal = _thermal_of(material, {key: text}, _SOURCE)
    thermals: dict[str, Thermal] = {}
    for each in library.values():
        layers = each.thermal.layers if each.thermal else ()
        # Layers from the surface down; what lies beneath may be a table without a material.
        thermals |= dict(zip((each.name, *(layer.beneath for layer in layers)), layers, strict=False))
    try:
        layered = stacked(thermals | {material.name: thermal}, "")
    except ThermorenderError as error:
        raise ThermorenderError(str(error).partition(": ")[2]) from None
    return {
        name: each if each.thermal == layered.get(name) else replace(each, thermal=layered[name])
        for name, each in library.items()
    }


def _thermal_of(material: Material, settings: Mapping[str, str], source: str) -> Thermal:
    thermal, faults = with_values(material.thermal, settings, source)
    if thermal is None:
        raise ThermorenderError(faults[0])
    return thermal


def with_spectrum(
    material: Material, wavelength_um: NDArray[np.float64], emissivity: NDArray[np.float64], what: str
) -> Material:
    """Return a Lambertian material with another spectrum; its spread is no longer known.

    Parameters
    ----------
    material : Material
    wavelength_um, emissivity : (N,) arrays
        Ascending [µm], and 0…1 [1].
    what : str
        The edit for the note, as "emissivity=0.9".

    Raises
    ------
    ThermorenderError
        The material emits by angle.
    """
    _refuse_angular(material)
    return replace(
        material, wavelength_um=wavelength_um, emissivity=emissivity, assumed_um=(),
        gaps_um=tuple(gaps(wavelength_um)),
        emissivity_std=np.full(wavelength_um.size, np.nan), samples=1, note=_noted(material.note, what),
    )  # fmt: skip


def _refuse_angular(material: Material) -> None:
    if material.directional != "lambertian":
        raise ThermorenderError(
            f"{material.name} emits by angle ({material.directional}); copy a Lambertian material, or load a table "
            "with the columns wavelength_um, n and k"
        )


def with_spectrum_of(material: Material, path: str | Path, column: str | None = None, name: str = "") -> Material:
    """Return a material with the spectrum of a file.

    Parameters
    ----------
    material : Material
        Gives everything but the spectrum.
    path : path
        A CSV, SLUM or ECOSTRESS spectrum; or a CSV of n and k: the material then emits by angle, with the roughness of
        `material`.
    column : str, optional
        Sample of a table with several.
    name : str, optional
        The file in messages and in the note; by default its own name.
    """
    path = Path(path)
    name = name or path.name
    try:
        if is_refractive_index(path):
            if column:
                raise ThermorenderError(f"{name} is a table of n and k and has no sample {column!r}; leave it out")
            return replace(
                material, directional="fresnel", samples=1, assumed_um=(),
                note=_noted(material.note, f"n and k from {name}"), **read_refractive_index(path, material.rms_slope),
            )  # fmt: skip
        sample = read_sample(path, column)
        made = from_samples(
            [sample], material.name, material.title, material.colour, material.solar_absorptance, material.temperature,
            source=material.source, citation=material.citation, licence=material.licence,
        )  # fmt: skip
    except ThermorenderError as error:
        raise ThermorenderError(str(error).replace(str(path), name).replace(path.name, name)) from None
    new = with_spectrum(material, made.wavelength_um, made.emissivity, f"emissivity from {name}")
    return replace(new, source=made.source, citation=made.citation, licence=made.licence) if sample.library else new


def copy_material(
    source: str, name: str, directory: str | Path, settings: Mapping[str, str], library: str | Path | None = None,
    replace: bool = False,
) -> None:  # fmt: skip
    """Write a copy of a material into a materials folder, with other values of some properties, {name: text}.

    `settings` are columns of the index, properties of the thermal table, and a flat emissivity of a Lambertian
    material; other cells keep their text. The copy's note and sources say what was set. `library` overrides the shipped
    one; a copy of its source's own name is a scene's version of that material.
    """
    known = find(load_library(library), source, "materials copy")
    own = None if library is None else _row(Path(library), source)
    folder = Path(library) if library is not None and own is not None else data_folder("materials")
    row = dict(own or _row(folder, source) or {})
    allowed = (*_OF_COPY, EMISSIVITY, *PROPERTIES)
    for key in settings:
        if key not in allowed:
            raise ThermorenderError(
                f"{key!r} is not a property of a material; {did_you_mean(key, allowed)}give one of {', '.join(allowed)}"
            )
    spectrum = read_text(folder / "spectra" / f"{source}.csv")
    if EMISSIVITY in settings:
        _refuse_angular(known)
        lines = [f"{wavelength:.9g},{settings[EMISSIVITY]}," for wavelength in known.wavelength_um]
        spectrum = "\n".join([",".join(SPECTRUM_COLUMNS), *lines]) + "\n"
    shown = ", ".join(f"{key}={text}" for key, text in settings.items() if key not in ("title", "note"))
    note = f"Copy of {source}" + (f" with {shown}" if shown else "") + "."
    row |= {"name": name, "note": " ".join(filter(None, (note, row.get("note", ""))))}
    row |= {key: text for key, text in settings.items() if key in _OF_COPY}
    changed = {key: text for key, text in settings.items() if key in PROPERTIES}
    thermal = known.thermal
    if changed:
        thermal = _thermal_of(known, changed, f"{CHOSEN} set in a copy of {source}")
    store(row, spectrum, directory, replace, table_text(thermal) if thermal else None)


def _row(folder: Path, name: str) -> dict[str, str] | None:
    """The cells of a material in a folder's index, or None."""
    index = folder / "index.csv"
    if not index.is_file():
        return None
    return next((cells for _, cells in read_table(index, INDEX_COLUMNS) if cells["name"] == name), None)
