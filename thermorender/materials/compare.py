"""Two materials, or two libraries, compared in a camera's band; and two libraries made one."""

from dataclasses import dataclass
from pathlib import Path

from thermorender.defaults import BAND_UM
from thermorender.errors import ThermorenderError
from thermorender.files import atomic_folder, check_new_folder, read_text
from thermorender.materials.files import INDEX_COLUMNS, ROUGHNESS_COLUMN, read_table
from thermorender.materials.library import read_library
from thermorender.materials.store import store
from thermorender.physics.planck import band_radiance, brightness_temperature

# What a change of emissivity is told in, over a camera's band: a surface, and the sky it reflects.
SURFACE_K = 300.0
SKY_K = 250.0

TOLD = (
    "title", "colour", "solar_absorptance", "temperature", "directional", "rms_slope", "samples", "source", "citation",
    "licence", "note",
)  # fmt: skip


@dataclass(frozen=True)
class Difference:
    """How one material of two libraries differs.

    Attributes
    ----------
    name : str
    emissivity : (float or None, float or None)
        Hemispherical band emissivity in the first and the second; None where it is absent or not measured.
    millikelvin : float or None
        By how much the second looks warmer [mK], at 300 K under a 250 K sky.
    what : str
        What differs in words.
    """

    name: str
    emissivity: tuple
    millikelvin: float | None
    what: str


def apparent_temperature(material, band_um=BAND_UM, temperature=SURFACE_K, sky_temperature=SKY_K):
    """Return the temperature a camera reads off a surface under an even sky [K].

    Parameters
    ----------
    material : Material
        Taken with its hemispherical emissivity.
    band_um : (lower, upper)
        The camera's flat band [µm].
    temperature, sky_temperature : float
        Of the surface and of the blackbody it reflects [K].

    Notes
    -----
    Brightness temperature of ∫ [ε B(T) + (1 − ε) B(T_sky)] dλ.
    """
    own, sky = band_radiance(temperature, *band_um), band_radiance(sky_temperature, *band_um)
    emitted = material.band_emissivity(*band_um, temperature) * own
    reflected = (1.0 - material.band_emissivity(*band_um, sky_temperature)) * sky
    return brightness_temperature(emitted + reflected, *band_um)


def covers(material, band_um):
    """Return whether a material was measured over all of a band [µm]."""
    try:
        material.band_emissivity(*band_um, SURFACE_K)
    except ThermorenderError:
        return False
    return True


def compare(first, second, name, band_um=BAND_UM):
    """Return the Difference between two materials.

    Parameters
    ----------
    first, second : Material or None
        None: absent.
    name : str
    band_um : (lower, upper)
    """
    measured = [material is not None and covers(material, band_um) for material in (first, second)]
    emissivity = tuple(
        float(material.band_emissivity(*band_um, SURFACE_K)) if known else None
        for material, known in zip((first, second), measured, strict=True)
    )
    if first is None or second is None:
        return Difference(name, emissivity, None, "only in the " + ("first" if second is None else "second"))
    shift = None
    if all(measured):
        shift = 1e3 * (apparent_temperature(second, band_um) - apparent_temperature(first, band_um))
    what = [key for key in TOLD if getattr(first, key) != getattr(second, key)]
    if not _same_spectrum(first, second):
        what.insert(0, "spectrum")
    return Difference(name, emissivity, shift, ", ".join(what))


def diff(first, second, band_um=BAND_UM):
    """Return the Differences between two libraries (dicts of name to Material); equal materials are left out."""
    found = [compare(first.get(name), second.get(name), name, band_um) for name in dict.fromkeys([*first, *second])]
    return [difference for difference in found if difference.what]


def merge(first, second, output, prefer=None):
    """Make one library of two in a new folder; return (names from the first, names from the second, conflicts).

    A material in only one of them is taken; one that is alike in both is taken once; one that differs between
    them is a conflict, refused unless `prefer` says which folder wins.

    Parameters
    ----------
    first, second : path
        Folders with `index.csv` and `spectra/`.
    output : path
        Folder to make; it must not exist, or be empty.
    prefer : {None, "first", "second"}

    Raises
    ------
    ThermorenderError
        There are conflicts and no winner, the output is in use, or a library cannot be read. Nothing is written then.
    """
    first, second, output = Path(first), Path(second), Path(output)
    check_new_folder(output)
    if prefer not in (None, "first", "second"):
        raise ThermorenderError(f"--prefer={prefer!r} is not allowed; give first or second")
    libraries = [read_library(folder) for folder in (first, second)]
    differing = [d.name for d in diff(*libraries) if d.name in libraries[0] and d.name in libraries[1]]
    if differing and prefer is None:
        raise ThermorenderError(
            f"{first} and {second} hold {', '.join(differing)} differently; look with `thermorender materials diff`, "
            "then say which wins with --prefer first or --prefer second"
        )
    # By number, as both may be the same folder.
    taken = dict.fromkeys(libraries[0], 0) | {
        name: 1 for name in libraries[1] if name not in libraries[0] or (name in differing and prefer == "second")
    }
    with atomic_folder(output) as scratch:
        for number, folder in enumerate((first, second)):
            for _, cells in read_table(folder / "index.csv", INDEX_COLUMNS, folder):
                if taken[cells["name"]] == number:
                    table = read_text(folder / "spectra" / f"{cells['name']}.csv")
                    row = {key: cells[key] for key in (*INDEX_COLUMNS, ROUGHNESS_COLUMN) if key in cells}
                    store(row, table, scratch)
    chosen = [[name for name in taken if taken[name] == number] for number in (0, 1)]
    return *chosen, differing


def _same_spectrum(first, second):
    def content(material):
        return [
            None if values is None else (values.shape, values.tobytes())
            for values in (material.wavelength_um, material.emissivity, material.emissivity_std,
                           material.cosines, material.emissivity_by_angle)
        ]  # fmt: skip

    return content(first) == content(second)
