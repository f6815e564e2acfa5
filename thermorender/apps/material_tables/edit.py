"""Edits of a library's materials by the texts of their tables, refused in the tables' own sentences."""

import re
from collections.abc import Iterable, Mapping
from dataclasses import fields, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.material_tables.from_samples import covers_sunlight, from_samples, is_refractive_index
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
# Source of values that an edit sets, what stands before their source before it, and begin of the note on them.
_BY_HAND, _BEFORE, _NOTE = "edited by hand", ", before: ", "Set by hand: "
_EDITED = re.compile(rf"\A(?:{_BY_HAND}|spectrum from .*?){_BEFORE}")
# Begins of what the note says of spectra.
_OF_SPECTRUM = (EMISSIVITY, "n and k")
# What a material takes from its source.
_SPECTRUM = ("wavelength_um", "emissivity", "emissivity_std", "emissivity_by_angle")
_SOLAR = ("solar_absorptance", SOLAR_STD_COLUMN)


def text_of(material: Material, key: str) -> str:
    """Return the text of a property: a column of the index, a thermal property, or a flat emissivity."""
    if key == EMISSIVITY:
        low, high = float(material.emissivity.min()), float(material.emissivity.max())
        return f"{low:.4g}" if low == high else ""
    if key in PROPERTIES:
        return thermal_text(material.thermal, key)
    return str(index_row(material).get(key, ""))


def thermal_text(thermal: Thermal | None, key: str) -> str:
    """Return the text of a thermal property; "" without one."""
    value = None if thermal is None else getattr(thermal, key)
    return f"{value:.6g}" if isinstance(value, float) else str(value or "")


def with_text(
    library: Mapping[str, Material], name: str, key: str, text: str,
    original: Mapping[str, Material] = MappingProxyType({}),
) -> Mapping[str, Material]:  # fmt: skip
    """Return a library in which a property of a material has another text; the same object where nothing changes.

    A thermal value also changes in the materials that lie on this one; `name` may be a layer's that is not a material.
    The source then says "edited by hand, before: …", and the note what was set. With the values of `original`, a
    material has its source and note again.

    Raises
    ------
    ThermorenderError
        An unknown material or property; or the tables would refuse the text: the message is theirs.
    """
    allowed = (EMISSIVITY, *PROPERTIES, *_NUMBERS, *_TEXTS)
    if key not in allowed:
        raise ThermorenderError(f"key={key!r} is not a property that a text sets; use one of {', '.join(allowed)}")
    text = text.strip()
    if key in PROPERTIES:
        return with_thermal(library, {name: {key: text}}, original)
    material = find(library, name, "with_text")
    if text == text_of(material, key):
        return library
    if key == EMISSIVITY:
        grid = material.wavelength_um
        made = with_spectrum(material, grid, np.full(grid.size, share(text)), f"{key}={text}")
    else:
        row = {column: str(value) for column, value in index_row(material).items()} | {key: text}
        for fault in parsed_row(row)[1]:
            raise ThermorenderError(fault)
        new: dict[str, Any] = {key: text}
        if key in _NUMBERS:
            number = decimal(text) if text else None
            new = {key.removesuffix("_k"): number, "note": _noted(material.note, f"{key}={text}")}
            new |= {"source": _edited(material.source)} if key in _SOLAR else {}
        made = replace(material, **new)
    return _settled({**library, name: made}, [name], original)


def _settled(
    library: Mapping[str, Material], names: Iterable[str], original: Mapping[str, Material]
) -> Mapping[str, Material]:
    """A library in which edited materials have the source that their values ask for; one as in `original` is that."""
    settled = dict(library)
    for name in names:
        material, before = library[name], original.get(name)
        if before is not None:
            spectrum = all(_same(material, before, key) for key in _SPECTRUM)
            same = {key for key in _NUMBERS if _same(material, before, key.removesuffix("_k"))}
            base = _EDITED.sub("", material.source, 1)
            if spectrum and same.issuperset(_SOLAR):
                base = before.source if base == _EDITED.sub("", before.source, 1) else base
                material = replace(material, source=base)
            note = _without(material.note, same, spectrum)
            note = before.note if note.rstrip(".;") == before.note.rstrip(".;") else note
            material = replace(material, note=note)
            if all(_same(material, before, each.name) for each in fields(material)):
                material = before
        settled[name] = material
    return settled


def _same(one: Material, other: Material, key: str) -> bool:
    first, second = getattr(one, key), getattr(other, key)
    if isinstance(first, np.ndarray) and isinstance(second, np.ndarray):
        return np.array_equal(first, second, equal_nan=True)
    return bool(first is second or (not isinstance(first, np.ndarray) and first == second))


def share(text: str) -> float:
    """Return an emissivity 0…1; ThermorenderError, in the words of a table, for any other text."""
    value, fault = parsed_number(EMISSIVITY, text, 0.0, 1.0, SHARE_ADVICE)
    if value is None:
        raise ThermorenderError(fault)
    return value


def _edited(source: str, what: str = _BY_HAND) -> str:
    """The source of edited values: `what` was done, and the source before all edits."""
    return f"{what}{_BEFORE}{_EDITED.sub('', source, 1)}"


def _noted(note: str, what: str) -> str:
    """A note that says what was set; the latest value of each property counts."""
    key = what.partition("=")[0]
    # A whole spectrum replaces points that were set before.
    whole = key == EMISSIVITY or " from " in key
    before, _, set_ = note.partition(_NOTE)
    parts = [each for each in set_.removesuffix(".").split(", ") if each and each.partition("=")[0] != key]
    parts = [each for each in parts if not (whole and each.startswith(_OF_SPECTRUM))]
    first = f"{before.strip().rstrip('.;')}. " if before.strip() else ""
    return f"{first}{_NOTE}{', '.join([*parts, what])}."


def _without(note: str, keys: set[str], spectrum: bool) -> str:
    """A note that does not say that some properties, or the spectrum, were set."""
    before, _, set_ = note.partition(_NOTE)
    parts = [each for each in set_.removesuffix(".").split(", ") if each and each.partition("=")[0] not in keys]
    parts = [each for each in parts if not (spectrum and each.startswith(_OF_SPECTRUM))]
    return f"{before}{_NOTE}{', '.join(parts)}." if parts else before.strip()


def thermal_tables(library: Mapping[str, Material]) -> dict[str, Thermal]:
    """Return {name: Thermal} of all materials, and of the layers beneath them, which may be no materials."""
    tables: dict[str, Thermal] = {}
    for each in library.values():
        layers = each.thermal.layers if each.thermal else ()
        tables |= dict(zip((each.name, *(layer.beneath for layer in layers)), layers, strict=False))
    return tables


def with_thermal(
    library: Mapping[str, Material], settings: Mapping[str, Mapping[str, str]],
    original: Mapping[str, Material] = MappingProxyType({}), new: Mapping[str, Thermal] = MappingProxyType({}),
) -> Mapping[str, Material]:  # fmt: skip
    """Return a library in which thermal properties have other texts, {material or layer: {property: text}}.

    The same object is returned where nothing changes. `new` are tables of further layers, {name: Thermal}. Sources are
    as in `with_text`.
    """
    tables, before = {**thermal_tables(library), **new}, thermal_tables(original)
    for name, texts in settings.items():
        if name not in tables:
            find(library, name, "with_text")
        now, first = tables.get(name), before.get(name)
        texts = {key: text for key, text in texts.items() if text != thermal_text(now, key)}
        if texts:
            made = _thermal_of(now, texts, f"{CHOSEN} {_BY_HAND}")
            source = {key: _source_of(key, made, now, first) if key in texts else text for key, text in
                      made.source.items()}  # fmt: skip
            tables[name] = replace(made, source=source)
    try:
        layered = stacked(tables, "")
    except ThermorenderError as error:
        raise ThermorenderError(str(error).partition(": ")[2]) from None
    changed = {
        name: replace(each, thermal=layered[name])
        for name, each in library.items()
        if name in layered and each.thermal != layered[name]
    }
    return _settled({**library, **changed}, changed, original) if changed else library


def _source_of(key: str, made: Thermal, now: Thermal | None, first: Thermal | None) -> str:
    """The source of a property that was set in `made`, in a table that was `now` and, before all edits, `first`."""
    if first is not None and getattr(first, key) == getattr(made, key):
        return first.source.get(key, made.source[key])
    known = "" if now is None else now.source.get(key, "")
    known = known.removeprefix(f"{CHOSEN} {_BY_HAND}").removeprefix(_BEFORE)
    return f"{CHOSEN} {_BY_HAND}{_BEFORE}{known}" if known else made.source[key]


def _thermal_of(before: Thermal | None, settings: Mapping[str, str], source: str) -> Thermal:
    thermal, faults = with_values(before, settings, source)
    if thermal is None:
        raise ThermorenderError(faults[0])
    return thermal


def with_spectrum(
    material: Material, wavelength_um: NDArray[np.float64], emissivity: NDArray[np.float64], what: str
) -> Material:
    """Return a Lambertian material with another spectrum; its spread is no longer known, and its source says so.

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
        source=_edited(material.source),
    )  # fmt: skip


def _refuse_angular(material: Material) -> None:
    if material.directional != "lambertian":
        raise ThermorenderError(
            f"{material.name} emits by angle ({material.directional}); copy a Lambertian material, or load a table "
            "with the columns wavelength_um, n and k"
        )


def with_spectrum_of(
    material: Material, path: str | Path, column: str | None = None, name: str = ""
) -> tuple[Material, str]:
    """Return (a material with the spectrum of a file, what was read in words).

    Parameters
    ----------
    material : Material
        Gives everything but the spectrum, and the solar absorptance where the spectrum does not reach from 0.42 to
        2.5 µm.
    path : path
        A CSV, SLUM or ECOSTRESS spectrum; or a CSV of n and k: the material then emits by angle, with the roughness of
        `material`.
    column : str, optional
        Sample of a table with several.
    name : str, optional
        The file in messages, in the source and in the note; by default its own name.
    """
    path = Path(path)
    name = name or path.name
    try:
        if is_refractive_index(path):
            if column:
                raise ThermorenderError(f"{name} is a table of n and k and has no sample {column!r}; leave it out")
            values = read_refractive_index(path, material.rms_slope)
            made = replace(
                material, directional="fresnel", samples=1, assumed_um=(), **values,
                note=_noted(material.note, f"n and k from {name}"),
                source=_edited(material.source, f"spectrum from {name}"),
            )  # fmt: skip
            low, high = made.valid_range_um
            return made, f"n and k over {low:g}–{high:g} µm; the material emits by angle"
        sample = read_sample(path, column)
        sample = replace(sample, source=sample.source.replace(path.name, name))
        sunlit = covers_sunlight(sample)
        found = from_samples(
            [sample], material.name, material.title, material.colour, None if sunlit else material.solar_absorptance,
            material.temperature, citation=material.citation, licence=material.licence,
        )  # fmt: skip
    except ThermorenderError as error:
        raise ThermorenderError(str(error).replace(str(path), name).replace(path.name, name)) from None
    made = with_spectrum(material, found.wavelength_um, found.emissivity, f"emissivity from {name}")
    made = replace(made, source=_edited(material.source, f"spectrum from {found.source or name}"))
    words, used = sample.words, "–".join(f"{end:g}" for end in made.valid_range_um)
    if f" {used} µm" not in words:
        words += f"; used over {used} µm"
    if sunlit:
        solar = round(found.solar_absorptance, 4)
        made = replace(
            made, solar_absorptance=solar, solar_absorptance_std=None,
            note=_noted(made.note, f"solar_absorptance={solar:g}"),
        )  # fmt: skip
        words += f"; solar absorptance {solar:.3g}"
    return replace(made, citation=found.citation, licence=found.licence) if sample.library else made, words


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
        thermal = _thermal_of(known.thermal, changed, f"{CHOSEN} set in a copy of {source}")
    store(row, spectrum, directory, replace, table_text(thermal) if thermal else None)


def _row(folder: Path, name: str) -> dict[str, str] | None:
    """The cells of a material in a folder's index, or None."""
    index = folder / "index.csv"
    if not index.is_file():
        return None
    return next((cells for _, cells in read_table(index, INDEX_COLUMNS) if cells["name"] == name), None)
