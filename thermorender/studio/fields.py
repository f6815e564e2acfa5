"""Fields of a material: their labels, how a text is checked and what it changes.

Checks are those of the material tables, so a fault has the sentence that the command line prints.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError
from thermorender.files import reported
from thermorender.materials.check import check_row
from thermorender.materials.csv_tables import SOLAR_STD_COLUMN, decimal, gaps, read_refractive_index, share_in_cell
from thermorender.materials.from_samples import from_samples, is_refractive_index
from thermorender.materials.material import Material
from thermorender.materials.samples import read_sample
from thermorender.materials.store import index_row, refractive_index_text
from thermorender.materials.thermal import CHOSEN, NUMBERS, Thermal, stacked, with_values
from thermorender.studio.document import Document

# Source of a thermal value that was typed here.
TYPED = f"{CHOSEN} set in the studio"
# Limits of a table that is drawn and dragged [µm].
SHOWN_UM = (2.5, 16.0)
_GRID_UM = 0.25
# A laboratory's spectrum has some thousand rows; more would hold the page up.
_MOST_ROWS = 20_000


@dataclass(frozen=True)
class Field:
    """A field of a material: its column in the tables, its label, and its unit."""

    key: str
    label: str
    unit: str = ""


EMISSIVITY = "emissivity"
OPTICAL = (
    Field(EMISSIVITY, "Emissivity, flat", "1"),
    Field("solar_absorptance", "Solar absorptance", "1"),
    Field(SOLAR_STD_COLUMN, "± standard deviation", "1"),
    Field("temperature_k", "Typical temperature", "K"),
    Field("title", "Title"),
    Field("source", "Source"),
    Field("citation", "Citation"),
    Field("licence", "Licence"),
    Field("note", "Note"),
)
_NUMBERS = {
    "solar_absorptance": "solar_absorptance",
    SOLAR_STD_COLUMN: SOLAR_STD_COLUMN,
    "temperature_k": "temperature",
}
THERMAL = tuple(
    Field(key, label, unit)
    for key, label, unit in (
        ("cover", "Cover", ""),
        ("conductivity_w_m_k", "Conductivity", "W m⁻¹ K⁻¹"),
        ("density_kg_m3", "Density", "kg m⁻³"),
        ("specific_heat_j_kg_k", "Specific heat", "J kg⁻¹ K⁻¹"),
        ("thickness_m", "Thickness", "m"),
        ("beneath", "Beneath", ""),
        ("skin_conductance_w_m2_k", "Skin conductance", "W m⁻² K⁻¹"),
        ("roughness_m", "Roughness length", "m"),
        ("heat_roughness_ratio", "ln(z0/z0h)", "1"),
        ("surface_resistance_s_m", "Surface resistance", "s m⁻¹"),
        ("wetness", "Wetness", "1"),
        ("water_share", "Freezable water", "m³ m⁻³"),
        ("attenuation_1_m", "Attenuation of sunlight", "m⁻¹"),
        ("melting_k", "Melting point", "K"),
        ("texture", "Soil texture", ""),
    )
)


def text_of(material: Material, key: str) -> str:
    """Return the text of a field."""
    if key == EMISSIVITY:
        low, high = float(material.emissivity.min()), float(material.emissivity.max())
        return f"{low:.4g}" if low == high else ""
    if key in NUMBERS or key in ("cover", "beneath", "texture"):
        value = None if material.thermal is None else getattr(material.thermal, key)
        return f"{value:.6g}" if isinstance(value, float) else str(value or "")
    return str(index_row(material).get(key, ""))


def alike(one: str, other: str) -> bool:
    """Return whether two texts of a field stand for the same value, as 0.90 and 0.9 do."""
    try:
        return decimal(one) == decimal(other)
    except ValueError:
        return one.strip() == other.strip()


def changed(document: Document, name: str, key: str, text: str) -> Document:
    """Return the Document with another text in a field of a material.

    Raises
    ------
    ThermorenderError
        The tables would refuse the text; the message is theirs.
    """
    material, text = document.material(name), text.strip()
    if text == text_of(material, key):
        return document
    if key in NUMBERS or key in ("cover", "beneath", "texture"):
        return _with_thermal(document, material, key, text)
    if key == EMISSIVITY:
        value = _share(text)
        grid = material.wavelength_um
        return document.with_material(with_spectrum(material, grid, np.full(grid.size, value), f"emissivity={text}"))
    row = {column: str(value) for column, value in index_row(material).items()} | {key: text}
    for finding in check_row(name, row):
        if finding.fault:
            raise ThermorenderError(finding.text)
    if key not in _NUMBERS:
        return document.with_material(replace(material, **{key: text}))  # type: ignore[arg-type]
    number = decimal(text) if text else None
    note = _noted(material.note, f"{key}={text}")
    return document.with_material(replace(material, **{_NUMBERS[key]: number, "note": note}))  # type: ignore[arg-type]


def _share(text: str) -> float:
    try:
        return share_in_cell("", 0, EMISSIVITY, text)
    except ThermorenderError as error:
        raise ThermorenderError(str(error).partition(": ")[2]) from None


def _noted(note: str, what: str) -> str:
    """A note that says what was set here; the latest value of each property counts."""
    key, begin = what.partition("=")[0], "Set in the studio: "
    before, _, set_ = note.partition(begin)
    parts = [each for each in set_.removesuffix(".").split(", ") if each and each.partition("=")[0] != key]
    first = f"{before.strip().rstrip('.;')}. " if before.strip() else ""
    return f"{first}{begin}{', '.join([*parts, what])}."


def chosen(material: Material, key: str) -> bool:
    """Return whether a field's value was chosen, not measured."""
    if material.thermal is not None and material.thermal.source.get(key, "").startswith(CHOSEN):
        return True
    if key == SOLAR_STD_COLUMN:
        return material.solar_absorptance_std is None
    return key == "temperature_k" or f"{key}=" in material.note.partition("Set in the studio: ")[2]


def _layers(material: Material) -> list[tuple[str, Thermal]]:
    """The layers of a material from the surface down, with the names of their tables."""
    if material.thermal is None:
        return []
    layers = material.thermal.layers
    return list(zip((material.name, *(layer.beneath for layer in layers)), layers, strict=False))


def _with_thermal(document: Document, material: Material, key: str, text: str) -> Document:
    """The Document with another thermal value, in all materials that lie on this one too."""
    thermal, faults = with_values(material.thermal, {key: text}, TYPED)
    if thermal is None:
        raise ThermorenderError(faults[0])
    thermals: dict[str, Thermal] = {}
    for each in document.library.values():
        thermals |= {key: layer for key, layer in _layers(each) if key not in thermals}
    thermals[material.name] = thermal
    try:
        layered = stacked(thermals, "")
    except ThermorenderError as error:
        raise ThermorenderError(str(error).partition(": ")[2]) from None
    upon = {material.name}
    while more := {key for key, each in layered.items() if each.beneath in upon} - upon:
        upon |= more
    library = {
        name: replace(each, thermal=layered[name]) if name in upon and name in layered else each
        for name, each in document.library.items()
    }
    return replace(document, library=library)


def with_spectrum(
    material: Material, wavelength_um: NDArray[np.float64], emissivity: NDArray[np.float64], what: str
) -> Material:
    """Return a Lambertian material with another spectrum; its spread is no longer known.

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


def dragged(material: Material, wavelength_um: float, emissivity: float, width_um: float) -> Material:
    """Return a material whose spectrum passes through a point, with its surroundings moved along a bell curve.

    Parameters
    ----------
    material : Material
        Lambertian.
    wavelength_um, emissivity : float
        The point [µm, 1].
    width_um : float
        Standard deviation of the bell [µm].
    """
    _share(f"{emissivity:g}")
    grid = material.wavelength_um
    low, high = max(SHOWN_UM[0], float(grid[0])), min(SHOWN_UM[1], float(grid[-1]))
    # A coarse table, such as a grey one, gets rows that can follow.
    inner = grid[(grid >= low) & (grid <= high)]
    if inner.size < (high - low) / (2.0 * _GRID_UM):
        grid = np.union1d(grid, np.round(np.arange(low, high + 1e-9, _GRID_UM), 4))
    now = material.emissivity_at(grid)
    nearest = int(np.argmin(np.abs(grid - wavelength_um)))
    bell = np.exp(-0.5 * ((grid - grid[nearest]) / max(width_um, 1e-6)) ** 2)
    moved = np.clip(now + (emissivity - now[nearest]) * bell, 0.0, 1.0)
    return with_spectrum(material, grid, np.round(moved, 6), f"emissivity_at_{grid[nearest]:.4g}_um={emissivity:.4g}")


@contextmanager
def scratch_folder() -> Iterator[str]:
    """Yield a temporary folder; ThermorenderError where it cannot be written."""
    with reported(gettempdir()), TemporaryDirectory(prefix="thermorender-studio-") as folder:
        yield folder


def read_spectrum(
    name: str, data: bytes, material: Material, column: str | None = None
) -> tuple[Material, str | None]:  # fmt: skip
    """Return (material with the spectrum of a file, text of its table as of `Document.tables`).

    The file is a CSV, SLUM or ECOSTRESS spectrum, or a CSV of n and k: the material then emits by angle.

    Parameters
    ----------
    name : str
        The file's name, for messages; it is not used as a path.
    data : bytes
        Contents.
    material : Material
        Gives everything but the spectrum.
    column : str, optional
        Sample of a table with several.
    """
    if (rows := data.count(b"\n")) > _MOST_ROWS:
        raise ThermorenderError(
            f"{name} has {rows} rows, more than the {_MOST_ROWS} of the finest spectra; give one spectrum, thinned out"
        )
    with scratch_folder() as folder:
        path = Path(folder, "spectrum.txt" if name.lower().endswith(".txt") else "spectrum.csv")
        path.write_bytes(data)
        try:
            if is_refractive_index(path):
                if column:
                    raise ThermorenderError(f"{name} is a table of n and k and has no sample {column!r}; leave it out")
                return _of_refractive_index(path, name, material), refractive_index_text(path)
            sample = read_sample(path, column or None)
            made = from_samples(
                [sample], material.name, material.title, material.colour, material.solar_absorptance,
                material.temperature, "", source=material.source, citation=material.citation, licence=material.licence,
            )  # fmt: skip
        except ThermorenderError as error:
            raise ThermorenderError(str(error).replace(str(path), name).replace(path.name, name)) from None
    shown = with_spectrum(material, made.wavelength_um, made.emissivity, f"emissivity from {name}")
    if sample.library:
        shown = replace(shown, source=made.source, citation=made.citation, licence=made.licence)
    return shown, None


def _of_refractive_index(path: Path, name: str, material: Material) -> Material:
    """A material of n and k, with the roughness of the one before; one that had none is smooth."""
    return replace(
        material, directional="fresnel", samples=1, assumed_um=(), note=_noted(material.note, f"n and k from {name}"),
        **read_refractive_index(path, material.rms_slope),
    )  # fmt: skip
