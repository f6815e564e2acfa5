"""Comparison of materials or libraries in a camera's band, and merging two libraries."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.defaults import BAND_UM
from thermorender.errors import ThermorenderError
from thermorender.files import atomic_folder, check_new_folder
from thermorender.formats import read_text, write_text
from thermorender.materials.csv_tables import INDEX_COLUMNS, OPTIONAL_COLUMNS, read_table
from thermorender.materials.library import read_library
from thermorender.materials.material import Material
from thermorender.materials.store import store
from thermorender.materials.thermal import PROPERTIES, Thermal, read_thermals
from thermorender.physics.planck import band_radiance, brightness_temperature

T = TypeVar("T")

# Temperatures of the surface and of the reflected sky for which a change of emissivity is stated.
SURFACE_K = 300.0
SKY_K = 250.0

_COMPARED = (
    "title", "colour", "solar_absorptance", "solar_absorptance_std", "temperature", "directional", "rms_slope",
    "samples", "source", "citation", "licence", "note",
)  # fmt: skip


@dataclass(frozen=True)
class Difference:
    """Difference of one material between two libraries."""

    name: str
    # (float or None, float or None) hemispherical band emissivity in the first and the second; None if absent or not
    # measured
    emissivity: tuple[float | None, float | None]
    millikelvin: float | None  # Apparent temperature of the second minus the first [mK], at 300 K under a 250 K sky
    what: str  # What differs, in words


def apparent_temperature(
    material: Material, band_um: tuple[float, float] = BAND_UM, temperature: ArrayLike = SURFACE_K,
    sky_temperature: ArrayLike = SKY_K,
) -> NDArray[np.float64]:  # fmt: skip
    """Return the apparent temperature of a surface under a uniform blackbody sky [K].

    Brightness temperature of ∫ [ε B(T) + (1 − ε) B(T_sky)] dλ over the camera's flat band, with hemispherical
    emissivity.
    """
    temperature, sky_temperature = np.asarray(temperature), np.asarray(sky_temperature)
    own, sky = band_radiance(temperature, *band_um), band_radiance(sky_temperature, *band_um)
    emitted = material.band_emissivity(*band_um, temperature) * own
    reflected = (1.0 - material.band_emissivity(*band_um, sky_temperature)) * sky
    return brightness_temperature(emitted + reflected, *band_um)


def covers(material: Material, band_um: tuple[float, float]) -> bool:
    """Return whether a material was measured over all of a band [µm]."""
    try:
        material.band_emissivity(*band_um, SURFACE_K)
    except ThermorenderError:
        return False
    return True


def compare(
    first: Material | None, second: Material | None, name: str, band_um: tuple[float, float] = BAND_UM
) -> Difference:
    """Return the Difference between two materials over the camera's band [µm]; None is absent."""
    emissivity = (_measured(first, band_um), _measured(second, band_um))
    if first is None or second is None:
        return Difference(name, emissivity, None, "only in the " + ("first" if second is None else "second"))
    shift = None
    if None not in emissivity:
        shift = float(1e3 * (apparent_temperature(second, band_um) - apparent_temperature(first, band_um)))
    what = [*_changed(first, second), *_thermal_changed(first.thermal, second.thermal)]
    return Difference(name, emissivity, shift, ", ".join(what))


def _measured(material: Material | None, band_um: tuple[float, float]) -> float | None:
    """Hemispherical emissivity of a material measured over all of a band [µm], else None."""
    if material is None or not covers(material, band_um):
        return None
    return float(material.band_emissivity(*band_um, SURFACE_K))


def diff(
    first: dict[str, Material], second: dict[str, Material], band_um: tuple[float, float] = BAND_UM
) -> list[Difference]:
    """Return the Differences between two libraries; equal materials are left out."""
    found = [compare(first.get(name), second.get(name), name, band_um) for name in dict.fromkeys([*first, *second])]
    return [difference for difference in found if difference.what]


def diff_folders(first: Path, second: Path, band_um: tuple[float, float] = BAND_UM) -> list[Difference]:
    """Return the Differences between two materials folders, including thermal tables without a row."""
    folders = (first, second)
    libraries, thermals = [read_library(folder) for folder in folders], [read_thermals(folder) for folder in folders]
    alone = {name: _thermal_changed(*(own.get(name) for own in thermals)) for name in thermals[0] | thermals[1]}
    return diff(libraries[0], libraries[1], band_um) + [
        Difference(name, (None, None), None, ", ".join(what))
        for name, what in alone.items()
        if what and not any(name in library for library in libraries)
    ]


def merge(
    first: str | Path, second: str | Path, output: str | Path, prefer: str | None = None
) -> tuple[list[str], list[str], list[str]]:
    """Merge two libraries into a new folder; return (names from the first, names from the second, conflicts).

    A material that differs between them is a conflict, refused unless `prefer` names the winner, "first" or "second".
    Thermal tables are merged independently of spectra, by the same rule.
    """
    first, second, output = Path(first), Path(second), Path(output)
    check_new_folder(output)
    if prefer not in (None, "first", "second"):
        raise ThermorenderError(f"prefer={prefer!r} is not allowed; give first or second")
    folders = (first, second)
    libraries, thermals = [read_library(folder) for folder in folders], [read_thermals(folder) for folder in folders]
    differing = list(dict.fromkeys(_unlike(libraries, _changed) + _unlike(thermals, _thermal_changed)))
    if differing and prefer is None:
        raise ThermorenderError(
            f"{first} and {second} hold {', '.join(differing)} differently; look with `thermorender materials diff`, "
            "then choose the winner with prefer=first or prefer=second"
        )

    def winners(one: Collection[str], other: Collection[str]) -> dict[str, int]:
        """Return {name: index of the folder it is taken from}; both may be the same folder."""
        won = {name: 1 for name in other if name not in one or (name in differing and prefer == "second")}
        return dict.fromkeys(one, 0) | won

    taken, taken_thermal = winners(*libraries), winners(*thermals)
    with atomic_folder(output) as scratch:
        for number, folder in enumerate(folders):
            for _, cells in read_table(folder / "index.csv", INDEX_COLUMNS) if libraries[number] else ():
                if taken[cells["name"]] == number:
                    table = read_text(folder / "spectra" / f"{cells['name']}.csv")
                    row = {key: cells[key] for key in (*INDEX_COLUMNS, *OPTIONAL_COLUMNS) if key in cells}
                    store(row, table, scratch)
        for name, number in taken_thermal.items():
            write_text(scratch / "thermal" / f"{name}.csv", read_text(folders[number] / "thermal" / f"{name}.csv"))
    both = taken_thermal | taken
    from_first, from_second = ([name for name in both if both[name] == number] for number in (0, 1))
    return from_first, from_second, differing


def _unlike(pair: Sequence[Mapping[str, T]], changed: Callable[[T, T], list[str]]) -> list[str]:
    """Return the names in both dicts whose values `changed` distinguishes."""
    return [name for name in pair[0] if name in pair[1] and changed(pair[0][name], pair[1][name])]


def _changed(first: Material, second: Material) -> list[str]:
    """Return what differs between two materials, without thermal properties; numbers with both values."""
    pairs = ((key, getattr(first, key), getattr(second, key)) for key in _COMPARED)
    changed = [_with_values(*pair) for pair in pairs if pair[1] != pair[2]]
    return changed if _same_spectrum(first, second) else ["spectrum", *changed]


def _thermal_changed(first: Thermal | None, second: Thermal | None) -> list[str]:
    """Return what differs between two Thermals or None; numbers with both values."""
    if first is None or second is None:
        only = "first" if second is None else "second"
        return [] if first is second else [f"thermal properties only in the {only}"]

    def content(thermal: Thermal, key: str) -> tuple[Any, ...]:
        return thermal.values[key], thermal.uncertainty.get(key), thermal.source.get(key)

    pairs = ((key, first.values[key], second.values[key]) for key in PROPERTIES)
    return [_with_values(*pair) for pair in pairs if content(first, pair[0]) != content(second, pair[0])]


def _with_values(key: str, one: Any, other: Any) -> str:
    """The name of a property, with its values if they are different numbers."""
    if one == other or not all(value is None or isinstance(value, (int, float)) for value in (one, other)):
        return key
    return f"{key} {' → '.join('none' if value is None else f'{value:g}' for value in (one, other))}"


def _same_spectrum(first: Material, second: Material) -> bool:
    def content(material: Material) -> list[tuple[tuple[int, ...], bytes] | None]:
        return [
            None if values is None else (values.shape, values.tobytes())
            for values in (material.wavelength_um, material.emissivity, material.emissivity_std,
                           material.cosines, material.emissivity_by_angle)
        ]  # fmt: skip

    return content(first) == content(second)
