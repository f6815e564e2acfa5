"""Measured samples → the mean emissivity of a material, as a table, with its spread.

By Kirchhoff's law the emissivity of an opaque sample is one minus its hemispherical reflectance. A table is the mean
over its samples on a grid of 0.05 µm, made so that its integrals are those of the measurement.
"""

import dataclasses
from pathlib import Path

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.materials.csv_tables import SOLAR_STD_COLUMN, gaps, number_in_cell, read_table, read_text
from thermorender.materials.library import read_library
from thermorender.materials.material import Material
from thermorender.materials.samples import LIBRARIES, is_ecostress, read_sample
from thermorender.materials.store import write_material, write_refractive_index
from thermorender.physics.planck import spectral_radiance
from thermorender.units import kelvin

SELECTION_COLUMNS = (
    "material", "file", "title", "colour_r", "colour_g", "colour_b", "solar_absorptance", "temperature_k",
    "note",
)  # fmt: skip

# What a table should cover: every LWIR camera's band with room on both sides.
WANTED_RANGE_UM = (7.0, 14.0)
# What a table holds if the samples reach so far. Near 3 µm several Nicolet spectra are noise around zero
# and turn negative; above 15 µm there are too few.
KEPT_RANGE_UM = (3.2, 15.0)
STEP_UM = 0.05
# A spectrum may begin or end this far inside the table's end, a quarter of the finest instrument's resolution (4 cm⁻¹
# at 8 µm): SLUM, stated as 8–14 µm, has its first and last points at 8.002 and 13.996 µm.
SLACK_UM = 0.005
# The mean and slope of a spectrum over each stretch of this length survive the thinning exactly.
STRETCH_UM = 0.5

SOLAR_RANGE_UM = (0.3, 2.5)
# A spectrum that starts no later than this holds enough of the solar range to weigh it.
SOLAR_START_UM = 0.42
SUN_TEMPERATURE_K = 5778.0
# Fewer samples tell too little about how a kind of surface differs.
FEWEST_FOR_SPREAD = 3


def from_samples(
    samples,
    name,
    title="",
    colour=(128, 128, 128),
    solar_absorptance=None,
    temperature=300.0,
    note="",
    source="",
    citation="",
    licence="",
    solar_absorptance_std=None,
):
    """Return the Material that is the mean over measured samples.

    Each sample is thinned to steps of 0.05 µm, then mean and standard deviation are taken over the samples. The table
    covers what all of them cover within 3.2–15 µm, widened towards 7–14 µm by those that reach so far: there the mean
    is over fewer of them, and the note says so.

    Parameters
    ----------
    samples : sequence of Sample
    name, title, colour, temperature, note
        As in Material; the temperature in kelvin.
    solar_absorptance : float, optional
        If not given, one minus the reflectance weighted with sunlight, from the samples that reach into it.
    solar_absorptance_std : float, optional
        If not given, the standard deviation over the samples that reach into sunlight, where they are three or more.
    source, citation, licence : str, optional
        For samples of no known library; those of ECOSTRESS and SLUM know theirs.

    Returns
    -------
    Material

    Raises
    ------
    ThermorenderError
        There is no sample, one leaves 0…1 in the table's range, a wavelength is measured by none, or no sample gives
        the solar absorptance.
    """
    if not samples:
        raise ThermorenderError(f"material {name!r} was given no sample; list one spectrum file at least")
    samples = [_thermal_part(sample, name) for sample in samples]
    grid = _common_grid(samples, name)
    tables = np.full((len(samples), grid.size), np.nan)
    for sample, table in zip(samples, tables, strict=True):
        low, high = sample.wavelength_um[[0, -1]]
        covered = (grid >= low - SLACK_UM) & (grid <= high + SLACK_UM)
        _check_sample(sample, name, *grid[covered][[0, -1]])
        table[covered] = _thinned(sample.wavelength_um, 1.0 - sample.reflectance, grid[covered])
    count = np.isfinite(tables).sum(axis=0)
    if count.min() == 0:
        raise ThermorenderError(
            f"no sample of material {name!r} covers {grid[count == 0][0]:g} µm, between those that do; leave samples "
            "out until the rest meet, or make two materials"
        )
    std = np.full(grid.size, np.nan)
    several = count > 1
    std[several] = np.nanstd(tables[:, several], axis=0, ddof=1)
    remarks = [note, _coverage(grid, count), "colour and temperature are typical values, assumed"]
    if solar_absorptance is None:
        solar_absorptance, spread, remark = _solar_absorptance(samples, name)
        if solar_absorptance_std is None and spread is not None:
            solar_absorptance_std, remark = spread, f"{remark}, with their standard deviation"
        remarks.append(remark)
    else:
        remarks.append("solar absorptance is assumed")
    if solar_absorptance_std is not None and not remarks[-1].endswith("with their standard deviation"):
        remarks[-1] += ", its standard deviation chosen"
    libraries = [key for key in LIBRARIES if any(sample.library == key for sample in samples)]
    sources = [
        f"{LIBRARIES[key][0]}: {'; '.join(sample.source for sample in samples if sample.library == key)}"
        for key in libraries
    ]
    return Material(
        name=name,
        title=title or samples[0].name,
        wavelength_um=grid,
        emissivity=np.nanmean(tables, axis=0),
        emissivity_std=std,
        colour=tuple(colour),
        solar_absorptance=solar_absorptance,
        temperature=temperature,
        source="; ".join(filter(None, [source, *sources])),
        citation="; ".join(filter(None, [citation, *(LIBRARIES[key][1] for key in libraries)])),
        licence="; ".join(filter(None, [licence, *(LIBRARIES[key][2] for key in libraries)])),
        samples=len(samples),
        solar_absorptance_std=solar_absorptance_std,
        note="; ".join(remark for remark in remarks if remark),
    )


def import_files(
    paths,
    directory,
    name,
    *,
    columns=None,
    title="",
    colour=(128, 128, 128),
    solar_absorptance=None,
    temperature=300.0,
    rms_slope=0.0,
    source="",
    citation="",
    licence="",
    note="",
    replace=False,
):
    """Make one material of spectrum files and write it into a folder; return it as the folder now holds it.

    Parameters
    ----------
    paths : sequence of path
        Spectra as `read_sample` takes them; or one table of n and k, which makes a Fresnel material.
    directory : path
        Materials folder; made if absent.
    columns : sequence of str, optional
        Samples of a table with several: all of them are taken from each file.
    rms_slope : float
        Roughness, for n and k only.
    others
        As in `from_samples`.

    Raises
    ------
    ThermorenderError
        As `from_samples` and `store`; samples of no known library need source, citation and licence; n and k need
        a solar absorptance.
    """
    kelvin("temperature", temperature)
    paths = [Path(path) for path in paths]
    is_index = [_is_refractive_index(path) for path in paths]
    if any(is_index) and (len(paths) > 1 or columns):
        raise ThermorenderError(f"{paths[is_index.index(True)]} is a table of n and k, which alone makes a material")
    words = {"source": source, "citation": citation, "licence": licence}
    if not any(is_index):
        samples = [read_sample(path, column) for path in paths for column in (columns or [None])]
    if any(is_index) or any(not sample.library for sample in samples):
        missing = [key for key, value in words.items() if not value]
        if missing:
            raise ThermorenderError(
                f"material {name!r} comes from no known library, so say where it is from: add "
                f"{' '.join(f'--{key} TEXT' for key in missing)}"
            )
    if any(is_index):
        if solar_absorptance is None:
            raise ThermorenderError(f"n and k do not give the solar absorptance of {name!r}; add --solar-absorptance")
        cells = words | {
            "name": name, "title": title or name, "samples": 1, "note": note, "temperature_k": f"{temperature:g}",
            "solar_absorptance": f"{solar_absorptance:g}", "rms_slope": f"{rms_slope:g}",
        } | {f"colour_{key}": f"{value:g}" for key, value in zip("rgb", colour, strict=True)}  # fmt: skip
        write_refractive_index(paths[0], cells, directory, replace)
    else:
        if rms_slope:
            raise ThermorenderError(f"rms_slope={rms_slope:g} is for tables of n and k; leave it out for {name!r}")
        material = from_samples(
            samples, name, title, tuple(int(value) for value in colour), solar_absorptance, temperature, note, **words
        )
        write_material(material, directory, replace)
    return read_library(Path(directory))[name]


def read_selection(path, folders):
    """Return the materials of a selection file, each the mean over its samples, in the file's order.

    The file has one row per sample; the first row of a material also holds its title, colour, temperature,
    note and, where it cannot be measured, its solar absorptance; a column solar_absorptance_std may give the latter's
    standard deviation where fewer than three samples do. A sample of a table with several is written
    `LUMA_SLUM_IR.csv#A001`.

    Parameters
    ----------
    path : path
    folders : sequence of path
        Where the spectrum files lie; the first that holds a file gives it.

    Raises
    ------
    ThermorenderError
        As `from_samples`, a cell that is no number, a file that is nowhere, or no row; the message names file and row.
    """
    groups = {}
    for row, cells in read_table(path, SELECTION_COLUMNS):
        file, _, column = cells["file"].partition("#")
        if Path(file).name != file:
            raise ThermorenderError(
                f"{path}, row {row}: file={file!r} is not the bare name of a file; give its folder on the command line"
            )
        found = [Path(folder) / file for folder in folders if (Path(folder) / file).is_file()]
        if not found:
            raise ThermorenderError(
                f"{path}, row {row}: {file} is in none of {', '.join(map(str, folders))}; add the folder that holds it"
            )
        groups.setdefault(cells["material"], (row, cells, []))[2].append((found[0], column or None))
    if not groups:
        raise ThermorenderError(f"{path} selects no sample; give a row for each")
    materials = []
    for name, (row, cells, sources) in groups.items():

        def number(column, low, high, row=row, cells=cells):
            mend = "correct the first row of the material"
            return number_in_cell(path, row, column, cells[column], low, high, mend)

        solar, solar_std = (
            number(key, 0, 1) if cells.get(key) else None for key in ("solar_absorptance", SOLAR_STD_COLUMN)
        )
        materials.append(
            from_samples(
                [read_sample(*source) for source in sources],
                name,
                title=cells["title"],
                colour=tuple(int(number(f"colour_{c}", 0, 255)) for c in "rgb"),
                solar_absorptance=solar,
                temperature=number("temperature_k", 100, 6000),
                note=cells["note"],
                solar_absorptance_std=solar_std,
            )
        )
    return materials


def _is_refractive_index(path):
    """Return whether a file is a CSV with columns n and k."""
    if not path.is_file() or is_ecostress(path):
        return False
    header = read_text(path).partition("\n")[0].split(",")
    return {"n", "k"} <= {cell.strip() for cell in header}


def _common_grid(samples, name):
    """Return the table's wavelengths [µm]: what all samples cover, widened towards 7–14 µm by some."""
    starts, ends = np.array([sample.wavelength_um[[0, -1]] for sample in samples]).T
    first = max(KEPT_RANGE_UM[0], min(starts.max(), max(WANTED_RANGE_UM[0], starts.min())))
    last = min(KEPT_RANGE_UM[1], max(ends.min(), min(WANTED_RANGE_UM[1], ends.max())))
    steps = np.arange(np.ceil((first - SLACK_UM) / STEP_UM), np.floor((last + SLACK_UM) / STEP_UM) + 1)
    if steps.size < 2:
        raise ThermorenderError(
            f"the samples of material {name!r} have less than two steps of {STEP_UM:g} µm in common within "
            f"{KEPT_RANGE_UM[0]:g}–{KEPT_RANGE_UM[1]:g} µm; give thermal spectra"
        )
    return np.round(steps * STEP_UM, 9)


def _thermal_part(sample, name):
    """Return a sample without what lies below a hole of its measurement; refuse holes within 7–14 µm."""
    first = sample.wavelength_um[0]
    for start, end in gaps(sample.wavelength_um):
        if start < WANTED_RANGE_UM[0]:
            first = end
        elif start < KEPT_RANGE_UM[1]:
            raise ThermorenderError(
                f"sample {sample.source} of material {name!r} has no point between {start:g} and {end:g} µm; measure "
                "there, add points you answer for, or cut it off before"
            )
    kept = sample.wavelength_um >= first
    return dataclasses.replace(sample, wavelength_um=sample.wavelength_um[kept], reflectance=sample.reflectance[kept])


def _check_sample(sample, name, first, last):
    """Refuse a sample that leaves 0…1 within the table's range."""
    kept = (sample.wavelength_um >= first - SLACK_UM) & (sample.wavelength_um <= last + SLACK_UM)
    bad = kept & ~((sample.reflectance >= 0.0) & (sample.reflectance <= 1.0))
    if bad.any():
        at = np.flatnonzero(bad)[0]
        raise ThermorenderError(
            f"sample {sample.source} of material {name!r} has reflectance {100 * sample.reflectance[at]:g} % at "
            f"{sample.wavelength_um[at]:g} µm, outside 0…100 % at {np.count_nonzero(bad)} wavelengths; leave "
            "the sample out, or correct its units"
        )


def _thinned(wavelength, value, grid):
    """Return the table on an even grid that lies closest to a spectrum, both taken as linear between their points.

    Closest in the mean square, with the mean and the slope over each half micrometre kept exactly: band emissivities
    are integrals over a smooth weight, so they stay what the measurement says to 1e-6. Nothing leaves 0…1: values
    that would are fixed at the limit and the rest is solved again. `scipy.optimize.lsq_linear` knows limits but no
    equations to be kept.
    """
    step, size = grid[1] - grid[0], grid.size
    nodes = np.union1d(wavelength[(wavelength > grid[0]) & (wavelength < grid[-1])], grid)
    low, high = nodes[:-1], nodes[1:]
    # Everything is linear between nodes, so Simpson's rule takes the products of three exactly.
    points = np.concatenate([low, 0.5 * (low + high), high])
    weights = np.concatenate([high - low, 4.0 * (high - low), high - low]) / 6.0
    # The midpoint tells the cell: a node itself falls to either side by rounding.
    cell = np.tile(((0.5 * (low + high) - grid[0]) / step).astype(int), 3)
    share = (points - grid[cell]) / step
    spectrum = np.interp(points, wavelength, value)

    def onto_grid(values, row=0, rows=1):
        """Integrals of values times each of the table's hat functions, summed into rows."""
        left = np.bincount(row * size + cell, values * weights * (1.0 - share), rows * size)
        return (left + np.bincount(row * size + cell + 1, values * weights * share, rows * size)).reshape(rows, size)

    between = np.diag(np.bincount(cell, weights * share * (1.0 - share), size)[:-1], 1)
    own = np.bincount(cell, weights * (1.0 - share) ** 2, size) + np.bincount(cell + 1, weights * share**2, size)
    gram, pull = np.diag(own) + between + between.T, onto_grid(spectrum)[0]
    edges = np.flatnonzero(np.abs(grid / STRETCH_UM - np.round(grid / STRETCH_UM)) < 1e-6)
    stretch = np.searchsorted(edges, cell, side="right")
    kept, aim = [], []
    for lever in (np.ones(points.size), points - grid[cell[0]]):
        kept.append(onto_grid(lever, stretch, edges.size + 1)[1:-1])
        aim.append(np.bincount(stretch, weights * lever * spectrum, edges.size + 1)[1:-1])
    kept, aim = np.concatenate(kept), np.concatenate(aim)
    table, fixed = np.zeros(size), np.zeros(size, dtype=bool)
    for _ in range(size):
        free = ~fixed
        system = np.block([[gram[np.ix_(free, free)], kept[:, free].T], [kept[:, free], np.zeros((aim.size,) * 2)]])
        known = table[fixed]
        right = np.concatenate([pull[free] - gram[np.ix_(free, fixed)] @ known, aim - kept[:, fixed] @ known])
        # Where all of a stretch is fixed its two conditions say nothing, which only least squares takes.
        solve = np.linalg.solve if not fixed.any() else lambda a, b: np.linalg.lstsq(a, b, rcond=None)[0]
        table[free] = solve(system, right)[: free.sum()]
        outside = (table < 0.0) | (table > 1.0)
        if not outside.any():
            break
        table[outside], fixed = np.clip(table[outside], 0.0, 1.0), fixed | outside
    return table


def _coverage(grid, count):
    """Return a remark on where fewer samples than elsewhere stand behind the mean; "" if they all cover all."""
    if count.min() == count.max():
        return ""
    edges = np.flatnonzero(np.diff(count)) + 1
    parts = zip([0, *edges], [*edges, grid.size], strict=True)
    return "samples: " + ", ".join(f"{count[a]} over {grid[a]:g}–{grid[b - 1]:g} µm" for a, b in parts)


def _solar_absorptance(samples, name):
    """Return one minus the reflectance weighted with a 5778 K blackbody's light, its spread or None, a remark how."""
    values, starts = [], []
    for sample in samples:
        if not sample.sunlight_um.size or sample.sunlight_um[-1] < SOLAR_RANGE_UM[1]:
            continue
        start = max(SOLAR_RANGE_UM[0], sample.sunlight_um[0])
        if start > SOLAR_START_UM:
            continue
        wavelength = np.linspace(start, SOLAR_RANGE_UM[1], 2001)
        weight = spectral_radiance(wavelength, SUN_TEMPERATURE_K)
        reflectance = np.interp(wavelength, sample.sunlight_um, sample.sunlight_reflectance)
        values.append(1.0 - (weight * reflectance).sum() / weight.sum())
        starts.append(start)
    if not values:
        raise ThermorenderError(
            f"no sample of material {name!r} covers {SOLAR_START_UM:g}–{SOLAR_RANGE_UM[1]:g} µm, so its "
            "solar_absorptance is unknown; give an assumed value with --solar-absorptance"
        )
    remark = (
        f"solar absorptance from {len(values)} of {len(samples)} samples, weighted with a "
        f"{SUN_TEMPERATURE_K:g} K blackbody over {max(starts):g}–{SOLAR_RANGE_UM[1]:g} µm"
    )
    spread = float(np.std(values, ddof=1)) if len(values) >= FEWEST_FOR_SPREAD else None
    return float(np.mean(values)), spread, remark
