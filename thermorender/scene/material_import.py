"""ECOSTRESS spectral library files → material tables, so that the shipped tables can be made again by anyone.

    python -m thermorender.scene.material_import SPECTRA_DIR SELECTION.csv OUT_DIR

The files are free from https://speclib.jpl.nasa.gov. Each holds the reflectance [%] of an opaque sample
over wavelength [µm]; by Kirchhoff's law its emissivity is one minus the hemispherical reflectance.
"""

import csv
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.physics.planck import spectral_radiance
from thermorender.scene.materials import (
    INDEX_COLUMNS,
    SPECTRUM_COLUMNS,
    Material,
    number_in_cell,
    read_table,
)

SELECTION_COLUMNS = (
    "material", "file", "title", "colour_r", "colour_g", "colour_b", "solar_absorptance", "temperature_k",
    "note",
)  # fmt: skip

# What a table must cover: every LWIR camera's band with room on both sides.
REQUIRED_RANGE_UM = (7.0, 14.0)
# What a table holds if the samples reach so far. Near 3 µm several Nicolet spectra are noise around zero
# and turn negative; above 15 µm there are too few.
KEPT_RANGE_UM = (3.2, 15.0)

SOLAR_RANGE_UM = (0.3, 2.5)
# A spectrum that starts no later than this holds enough of the solar range to weigh it.
SOLAR_START_UM = 0.42
SUN_TEMPERATURE_K = 5778.0

CITATION = (
    "Baldridge et al. 2009, doi:10.1016/j.rse.2008.11.007; "
    "Meerdink et al. 2019, doi:10.1016/j.rse.2019.05.015"
)
LICENCE = "free, cite"


@dataclass(frozen=True, eq=False)
class Sample:
    """One measured sample: wavelength [µm], rising, and reflectance [1], both (N,); how it was measured."""

    name: str
    measurement: str
    wavelength_um: np.ndarray
    reflectance: np.ndarray


def read_ecostress(path):
    """Return the Sample of one ECOSTRESS spectrum file.

    Wavelengths may fall or rise; repeated ones are averaged; percent becomes a share of one.

    Raises
    ------
    ThermorenderError
        The file is absent, is not in µm and percent, or holds no spectrum.
    """
    path = Path(path)
    if not path.is_file():
        raise ThermorenderError(
            f"{path} does not exist; order the spectrum at https://speclib.jpl.nasa.gov and put it there"
        )
    header, pairs = {}, []
    # Some headers hold degree signs in latin-1, which decodes any byte.
    for line in path.read_text(encoding="latin-1").splitlines():
        key, colon, value = line.partition(":")
        if colon and not pairs:
            header[key.strip().lower()] = value.strip()
            continue
        try:
            wavelength, percent = (float(cell) for cell in line.split())
        except ValueError:
            continue
        pairs.append((wavelength, percent))
    units = header.get("x units", "nothing"), header.get("y units", "nothing")
    if "micromet" not in units[0].lower() or "percent" not in units[1].lower():
        raise ThermorenderError(
            f"{path} states x units {units[0]!r} and y units {units[1]!r}; only wavelength in micrometres "
            "and reflectance in percent are read, so convert it first"
        )
    if len(pairs) < 2:
        raise ThermorenderError(
            f"{path} holds {len(pairs)} wavelength and reflectance pairs; order the whole file again"
        )
    wavelength, percent = np.array(pairs).T
    unique, where, count = np.unique(wavelength, return_inverse=True, return_counts=True)
    return Sample(
        name=header.get("name", path.stem),
        measurement=header.get("measurement", "not stated"),
        wavelength_um=unique,
        reflectance=np.bincount(where, weights=percent) / count / 100.0,
    )


def from_ecostress(
    paths,
    name,
    title="",
    colour=(128, 128, 128),
    solar_absorptance=None,
    temperature=300.0,
    note="",
    step_um=0.05,
):
    """Return the Material that is the mean over ECOSTRESS samples.

    Each sample is averaged over cells one step wide (finer measurements keep their integral, and their
    noise does not alias), then mean and standard deviation are taken over the samples. Nothing is clipped.

    Parameters
    ----------
    paths : sequence of path
        Spectrum files; each must cover 7–14 µm.
    name, title, colour, temperature, note
        As in Material; the temperature in kelvin.
    solar_absorptance : float, optional
        If not given, one minus the reflectance weighted with sunlight, from the samples that reach into it.
    step_um : float
        Step of the table [µm].

    Returns
    -------
    Material
        Over the range common to all samples within 3.2–15 µm.

    Raises
    ------
    ThermorenderError
        A sample does not cover 7–14 µm, is not hemispherical, leaves 0…100 % in the table's range, or no
        sample gives the solar absorptance.
    """
    paths = [Path(path) for path in paths]
    samples = [read_ecostress(path) for path in paths]
    if not samples:
        raise ThermorenderError(f"material {name!r} was given no sample; list one spectrum file at least")
    first = max([KEPT_RANGE_UM[0]] + [sample.wavelength_um[0] for sample in samples])
    last = min([KEPT_RANGE_UM[1]] + [sample.wavelength_um[-1] for sample in samples])
    # The 1e-6 keeps a range that ends on the grid from losing its last point to rounding.
    steps = np.arange(np.ceil(first / step_um - 1e-6), np.floor(last / step_um + 1e-6) + 1)
    grid = np.round(steps * step_um, 9)
    for path, sample in zip(paths, samples, strict=True):
        _check_sample(path, sample, name, first, last)
    emissivity = np.array([1.0 - _cell_means(sample, grid) for sample in samples])
    unknown = np.full(grid.size, np.nan)
    remarks = [note, "colour and temperature are typical values, assumed"]
    if solar_absorptance is None:
        solar_absorptance, remark = _solar_absorptance(samples, name)
        remarks.append(remark)
    else:
        remarks.append("solar absorptance is assumed")
    return Material(
        name=name,
        title=title or samples[0].name,
        wavelength_um=grid,
        emissivity=emissivity.mean(axis=0),
        emissivity_std=emissivity.std(axis=0, ddof=1) if len(samples) > 1 else unknown,
        colour=tuple(colour),
        solar_absorptance=solar_absorptance,
        temperature=temperature,
        source="ECOSTRESS spectral library (JPL): " + "; ".join(path.name for path in paths),
        citation=CITATION,
        licence=LICENCE,
        samples=len(samples),
        note="; ".join(remark for remark in remarks if remark),
    )


def write_material(material, directory):
    """Write a material's spectrum and its row of `index.csv` into a folder, in place of an earlier one.

    Parameters
    ----------
    material : Material
    directory : path
        Made if absent; other rows of its index stay as they are.
    """
    directory = Path(directory)
    (directory / "spectra").mkdir(parents=True, exist_ok=True)
    with open(directory / "spectra" / f"{material.name}.csv", "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(SPECTRUM_COLUMNS)
        for wavelength, emissivity, std in zip(
            material.wavelength_um, material.emissivity, material.emissivity_std, strict=True
        ):
            writer.writerow(
                [f"{wavelength:.9g}", f"{emissivity:.5f}", "" if np.isnan(std) else f"{std:.5f}"]
            )
    index = directory / "index.csv"
    rows = {cells["name"]: cells for _, cells in read_table(index, INDEX_COLUMNS)} if index.is_file() else {}
    columns = list(dict.fromkeys([*INDEX_COLUMNS, *(key for cells in rows.values() for key in cells)]))
    rows[material.name] = rows.get(material.name, {}) | {
        "name": material.name,
        "title": material.title,
        "colour_r": material.colour[0],
        "colour_g": material.colour[1],
        "colour_b": material.colour[2],
        "solar_absorptance": f"{material.solar_absorptance:.3g}",
        "directional": material.directional,
        "temperature_k": f"{material.temperature:g}",
        "samples": material.samples,
        "source": material.source,
        "citation": material.citation,
        "licence": material.licence,
        "note": material.note,
    }
    with open(index, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns, restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows.values())


def read_selection(path, spectra_directory):
    """Return the materials of a selection file, each the mean over its samples, in the file's order.

    The file has one row per sample; the first row of a material also holds its title, colour, temperature,
    note and, where it cannot be measured, its solar absorptance.

    Raises
    ------
    ThermorenderError
        As `from_ecostress`, or a cell that is no number; the message names file and row.
    """
    groups = {}
    for row, cells in read_table(path, SELECTION_COLUMNS):
        paths = groups.setdefault(cells["material"], (row, cells, []))[2]
        paths.append(Path(spectra_directory) / cells["file"])
    materials = []
    for name, (row, cells, paths) in groups.items():

        def number(column, low, high, row=row, cells=cells):
            mend = "correct the first row of the material"
            return number_in_cell(path, row, column, cells[column], low, high, mend)

        solar = number("solar_absorptance", 0, 1) if cells["solar_absorptance"] else None
        materials.append(
            from_ecostress(
                paths,
                name,
                title=cells["title"],
                colour=tuple(int(number(f"colour_{c}", 0, 255)) for c in "rgb"),
                solar_absorptance=solar,
                temperature=number("temperature_k", 100, 6000),
                note=cells["note"],
            )
        )
    return materials


def main(arguments=None):
    """Write the tables of a selection; return the exit status: 0, or 2 after a user's mistake."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if len(arguments) != 3:
        sys.stderr.write(
            "usage: python -m thermorender.scene.material_import SPECTRA_DIR SELECTION.csv OUT_DIR\n"
        )
        return 2
    spectra_directory, selection, directory = arguments
    try:
        materials = read_selection(selection, spectra_directory)
        for material in materials:
            write_material(material, directory)
    except ThermorenderError as error:
        sys.stderr.write(f"{error}\n")
        return 2
    sys.stdout.write(f"{len(materials)} materials written to {directory}\n")
    return 0


def _check_sample(path, sample, name, first, last):
    """Refuse a sample whose emissivity cannot be had over the whole of the table's range."""
    start, end = sample.wavelength_um[[0, -1]]
    if start > REQUIRED_RANGE_UM[0] or end < REQUIRED_RANGE_UM[1]:
        raise ThermorenderError(
            f"sample {path.name} of material {name!r} covers {start:g}–{end:g} µm and "
            f"{REQUIRED_RANGE_UM[0]:g}–{REQUIRED_RANGE_UM[1]:g} µm is needed; leave the sample out"
        )
    if "hemispherical" not in sample.measurement.lower():
        raise ThermorenderError(
            f"sample {path.name} of material {name!r} was measured as {sample.measurement!r}; emissivity is "
            "one minus reflectance for hemispherical reflectance only, so leave the sample out"
        )
    kept = (sample.wavelength_um >= first) & (sample.wavelength_um <= last)
    bad = kept & ((sample.reflectance < 0.0) | (sample.reflectance > 1.0))
    if bad.any():
        at = np.flatnonzero(bad)[0]
        raise ThermorenderError(
            f"sample {path.name} of material {name!r} has reflectance {100 * sample.reflectance[at]:g} % at "
            f"{sample.wavelength_um[at]:g} µm, outside 0…100 % at {np.count_nonzero(bad)} wavelengths; leave "
            "the sample out"
        )


def _cell_means(sample, grid):
    """Return the reflectance averaged over the cell around each wavelength of the grid."""
    half = 0.5 * (grid[1] - grid[0])
    inner = 0.5 * (grid[1:] + grid[:-1])
    # The outermost cells reach as far as the sample does.
    low = max(grid[0] - half, sample.wavelength_um[0])
    high = min(grid[-1] + half, sample.wavelength_um[-1])
    edges = np.concatenate([[low], inner, [high]])
    nodes = np.union1d(sample.wavelength_um, edges)
    values = np.interp(nodes, sample.wavelength_um, sample.reflectance)
    pieces = 0.5 * np.diff(nodes) * (values[1:] + values[:-1])
    integral = np.concatenate([[0.0], np.cumsum(pieces)])[np.searchsorted(nodes, edges)]
    return np.diff(integral) / np.diff(edges)


def _solar_absorptance(samples, name):
    """Return one minus the reflectance weighted with a 5778 K blackbody's light, and a remark how."""
    values, starts = [], []
    for sample in samples:
        start = max(SOLAR_RANGE_UM[0], sample.wavelength_um[0])
        if start > SOLAR_START_UM or sample.wavelength_um[-1] < SOLAR_RANGE_UM[1]:
            continue
        wavelength = np.linspace(start, SOLAR_RANGE_UM[1], 2001)
        weight = spectral_radiance(wavelength, SUN_TEMPERATURE_K)
        reflectance = np.interp(wavelength, sample.wavelength_um, sample.reflectance)
        values.append(1.0 - (weight * reflectance).sum() / weight.sum())
        starts.append(start)
    if not values:
        raise ThermorenderError(
            f"no sample of material {name!r} covers {SOLAR_START_UM:g}–{SOLAR_RANGE_UM[1]:g} µm, so its "
            "solar_absorptance is unknown; give an assumed value"
        )
    remark = (
        f"solar absorptance from {len(values)} of {len(samples)} samples, weighted with a "
        f"{SUN_TEMPERATURE_K:g} K blackbody over {max(starts):g}–{SOLAR_RANGE_UM[1]:g} µm"
    )
    return float(np.mean(values)), remark


if __name__ == "__main__":
    sys.exit(main())
