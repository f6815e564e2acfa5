"""Edits of a library's materials by the texts of their tables, refused in the tables' own sentences."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.material_tables.check import check_row
from thermorender.apps.material_tables.from_samples import from_samples, is_refractive_index
from thermorender.apps.material_tables.samples import read_sample
from thermorender.errors import ThermorenderError
from thermorender.materials.csv_tables import SOLAR_STD_COLUMN, decimal, gaps, read_refractive_index, share_in_cell
from thermorender.materials.library import find
from thermorender.materials.material import Material
from thermorender.materials.store import index_row
from thermorender.materials.thermal import CHOSEN, PROPERTIES, Thermal, stacked, with_values

# A flat emissivity, as a property beside those of the tables.
EMISSIVITY = "emissivity"
# Columns of the index that an edit may set.
_NUMBERS = ("solar_absorptance", SOLAR_STD_COLUMN, "temperature_k")
_TEXTS = ("title", "source", "citation", "licence", "note")
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
    for finding in check_row(name, row):
        if finding.fault:
            raise ThermorenderError(finding.text)
    new: dict[str, Any] = {key: text}
    if key in _NUMBERS:
        number = decimal(text) if text else None
        new = {key.removesuffix("_k"): number, "note": _noted(material.note, f"{key}={text}")}
    return {**library, name: replace(material, **new)}


def share(text: str) -> float:
    """Return an emissivity 0…1; ThermorenderError, in the words of a table, for any other text."""
    try:
        return share_in_cell("", 0, EMISSIVITY, text)
    except ThermorenderError as error:
        raise ThermorenderError(str(error).partition(": ")[2]) from None


def _noted(note: str, what: str) -> str:
    """A note that says what was set; the latest value of each property counts."""
    key = what.partition("=")[0]
    before, _, set_ = note.partition(_NOTE)
    parts = [each for each in set_.removesuffix(".").split(", ") if each and each.partition("=")[0] != key]
    first = f"{before.strip().rstrip('.;')}. " if before.strip() else ""
    return f"{first}{_NOTE}{', '.join([*parts, what])}."


def _with_thermal(library: Mapping[str, Material], material: Material, key: str, text: str) -> dict[str, Material]:
    thermal, faults = with_values(material.thermal, {key: text}, _SOURCE)
    if thermal is None:
        raise ThermorenderError(faults[0])
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
    if material.directional != "lambertian":
        raise ThermorenderError(
            f"{material.name} emits by angle ({material.directional}); duplicate a Lambertian material, or load a "
            "table with the columns wavelength_um, n and k"
        )
    return replace(
        material, wavelength_um=wavelength_um, emissivity=emissivity, assumed_um=(),
        gaps_um=tuple(gaps(wavelength_um)),
        emissivity_std=np.full(wavelength_um.size, np.nan), samples=1, note=_noted(material.note, what),
    )  # fmt: skip


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
