"""A material from measured samples: the mean emissivity with its spread, as a table.

By Kirchhoff's law the emissivity of an opaque sample is one minus its hemispherical reflectance. The table is the mean
over the samples on a grid of 0.05 µm that preserves the integrals of the measurements.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.material_tables.columns import NOISE, WANTED_RANGE_UM
from thermorender.apps.material_tables.samples import LIBRARIES, Sample, is_ecostress, read_sample
from thermorender.errors import ThermorenderError
from thermorender.materials.csv_tables import (
    SOLAR_STD_COLUMN,
    gaps,
    number_in_cell,
    parsed_table,
    read_table,
    read_text,
)
from thermorender.materials.library import read_library
from thermorender.materials.material import Material
from thermorender.materials.store import write_material, write_refractive_index
from thermorender.physics.planck import spectral_radiance
from thermorender.units import kelvin

Floats = NDArray[np.float64]

SELECTION_COLUMNS = (
    "material", "file", "title", "colour_r", "colour_g", "colour_b", "solar_absorptance", "temperature_k",
    "note",
)  # fmt: skip

# Range of a table if the samples cover it: from the mid-wave to where samples become few.
KEPT_RANGE_UM = (3.0, 15.0)
# Rows from here on are fitted without those below, so that the mid-wave changes no other row. Below, a step of the
# table averages 25 points of up to `NOISE` beyond 0…1.
_SEAM_UM = 3.2
STEP_UM = 0.05
# A spectrum may fall short of the table's ends by this much, a quarter of the finest instrument's resolution (4 cm⁻¹ at
# 8 µm): SLUM, stated as 8–14 µm, has its first and last points at 8.002 and 13.996 µm.
SLACK_UM = 0.005
# Resampling preserves the mean and slope of a spectrum over each interval of this length exactly.
INTERVAL_UM = 0.5

SOLAR_RANGE_UM = (0.3, 2.5)
# A spectrum must start at this wavelength or below for a solar absorptance.
SOLAR_START_UM = 0.42
SUN_TEMPERATURE_K = 5778.0
# Reflectances throughout the thermal range that no surface has: soot is brighter, polished gold darker.
_DARKEST, _BRIGHTEST = 0.0101, 0.9899
# Emissivities below this throughout get a remark: roofing of copper and aluminium in ECOSTRESS reaches 0.05 and 0.06.
_BARE_METAL = 0.1
# Least number of samples for a standard deviation of the solar absorptance.
FEWEST_FOR_SPREAD = 3


def from_samples(
    samples: Sequence[Sample], name: str, title: str = "", colour: Sequence[int] = (128, 128, 128),
    solar_absorptance: float | None = None, temperature: float = 300.0, note: str = "", source: str = "",
    citation: str = "", licence: str = "", solar_absorptance_std: float | None = None,
) -> Material:  # fmt: skip
    """Return the Material with the mean emissivity of measured samples.

    Samples are resampled to steps of 0.05 µm before the mean and standard deviation. The table begins with the first
    sample, from 3 µm on, and ends with the range of all samples, or at 14 µm if that ends before and one reaches it.
    Where some samples are missing the mean is over fewer, as the note records. `solar_absorptance` is by default one
    minus the sunlight-weighted reflectance of the samples that cover the solar range, and its standard deviation that
    over them if they are three or more. Source, citation and licence are known for ECOSTRESS and SLUM.
    """
    if not samples:
        raise ThermorenderError(f"material {name!r} has no sample; give at least one spectrum file")
    read = [f"{sample.source} read as {sample.words}" for sample in samples if sample.inferred]
    samples = [_thermal_part(sample, name) for sample in samples]
    grid, tables = _resampled(samples, name)
    count = np.isfinite(tables).sum(axis=0)
    several = count > 1
    std = np.full(grid.size, np.nan)
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
    if np.nanmax(tables) < _BARE_METAL:
        remarks.append(
            f"emissivity below {_BARE_METAL:g} throughout, as of bare metal; if the values are emissivities, their "
            "heading is wrong"
        )
    libraries = [key for key in LIBRARIES if any(sample.library == key for sample in samples)]
    sources = [
        f"{LIBRARIES[key][0]}: {'; '.join(sample.source for sample in samples if sample.library == key)}"
        for key in libraries
    ]
    red, green, blue = colour
    return Material(
        name=name, title=title or samples[0].name, wavelength_um=grid, emissivity=np.nanmean(tables, axis=0),
        emissivity_std=std, colour=(red, green, blue), solar_absorptance=solar_absorptance, temperature=temperature,
        source="; ".join(filter(None, [source, *sources])),
        citation="; ".join(dict.fromkeys(filter(None, [citation, *(LIBRARIES[key][1] for key in libraries)]))),
        licence="; ".join(dict.fromkeys(filter(None, [licence, *(LIBRARIES[key][2] for key in libraries)]))),
        samples=len(samples), solar_absorptance_std=solar_absorptance_std,
        note="; ".join(remark for remark in [*remarks, *read] if remark),
    )  # fmt: skip


def import_files(
    paths: Sequence[str | Path], directory: str | Path, name: str, *, columns: Sequence[str] | None = None,
    title: str = "", colour: Sequence[float] = (128, 128, 128), solar_absorptance: float | None = None,
    temperature: float = 300.0, rms_slope: float = 0.0, source: str = "", citation: str = "", licence: str = "",
    replace: bool = False,
) -> Material:  # fmt: skip
    """Write a material from spectra for `read_sample`, or from one table of n and k; return it as read back.

    `columns` are the samples to take from each table with several; `rms_slope` is the roughness, for n and k only.
    Others are as in `from_samples`.
    """
    kelvin("temperature", temperature)
    files = [Path(path) for path in paths]
    tables = [path for path in files if is_refractive_index(path)]
    if tables and (len(files) > 1 or columns):
        raise ThermorenderError(f"{tables[0]} is a table of n and k, which must be a material's only file")
    words = {"source": source, "citation": citation, "licence": licence}
    samples = [] if tables else [read_sample(path, column) for path in files for column in (columns or (None,))]
    if tables or not all(sample.library for sample in samples):
        _refuse_without_origin(name, words)
    if tables:
        if solar_absorptance is None:
            raise ThermorenderError(f"n and k do not give the solar absorptance of {name!r}; add solar_absorptance")
        cells = words | {
            "name": name, "title": title or name, "samples": "1", "note": "", "temperature_k": f"{temperature:g}",
            "solar_absorptance": f"{solar_absorptance:g}", "rms_slope": f"{rms_slope:g}",
        } | {f"colour_{key}": f"{value:g}" for key, value in zip("rgb", colour, strict=True)}  # fmt: skip
        write_refractive_index(files[0], cells, directory, replace)
    else:
        if rms_slope:
            raise ThermorenderError(f"rms_slope={rms_slope:g} is for tables of n and k; leave it out for {name!r}")
        material = from_samples(
            samples, name, title, tuple(int(value) for value in colour), solar_absorptance, temperature,
            source=source, citation=citation, licence=licence,
        )  # fmt: skip
        write_material(material, directory, replace)
    return read_library(Path(directory))[name]


def _refuse_without_origin(name: str, words: Mapping[str, str]) -> None:
    missing = [key for key, value in words.items() if not value]
    if missing:
        raise ThermorenderError(
            f"material {name!r} does not come from a known library; add its origin as {', '.join(missing)}"
        )


def read_selection(path: str | Path, folders: Sequence[str | Path]) -> list[Material]:
    """Return the materials of a selection file, each the mean over its samples, in the file's order.

    The file has one row per sample. The first row of a material also has its title, colour, temperature, note and, if
    not measured, its solar absorptance; solar_absorptance_std may add the standard deviation if fewer than three
    samples give one. A sample of a table with several is written `LUMA_SLUM_IR.csv#A001`. `folders` are searched in
    order.
    """
    groups: dict[str, tuple[int, dict[str, str], list[tuple[Path, str | None]]]] = {}
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
        raise ThermorenderError(f"{path} selects no sample; add a row for each")
    materials = []
    for name, (row, cells, sources) in groups.items():

        def number(column: str, low: float, high: float, row: int = row, cells: dict[str, str] = cells) -> float:
            return number_in_cell(path, row, column, cells[column], low, high, "correct the first row of the material")

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


def _resampled(samples: Sequence[Sample], name: str) -> tuple[Floats, Floats]:
    """Return the wavelengths (N,) [µm] and the emissivity of each sample, (samples, N), NaN where not covered."""
    grid = _common_grid(samples, name)
    tables = np.full((len(samples), grid.size), np.nan)
    # Samples of several libraries meet at 7 µm.
    seam = max(_SEAM_UM, min(WANTED_RANGE_UM[0], max(sample.wavelength_um[0] for sample in samples)))
    for sample, table in zip(samples, tables, strict=True):
        low, high = sample.wavelength_um[[0, -1]]
        covered = (grid >= low - SLACK_UM) & (grid <= high + SLACK_UM)
        rows = grid[covered]
        _check_sample(sample, name, *rows[[0, -1]])
        below = int(np.count_nonzero(rows < seam - SLACK_UM))
        below = below if rows.size - below > 1 else 0
        fitted = _on_grid(sample.wavelength_um, 1.0 - sample.reflectance, rows[below:])
        if below:
            head = _on_grid(sample.wavelength_um, 1.0 - sample.reflectance, rows[: below + 1], fitted[0])
            fitted = np.concatenate([head, fitted[1:]])
        table[covered] = fitted
    missing = ~np.isfinite(tables).any(axis=0)
    if missing.any():
        raise ThermorenderError(
            f"no sample of material {name!r} covers {grid[missing][0]:g} µm, between those that do; leave samples out "
            "until the rest overlap, or make two materials"
        )
    return grid, tables


def is_refractive_index(path: Path) -> bool:
    """Return whether a file is a CSV with columns n and k."""
    if not path.is_file() or is_ecostress(path):
        return False
    return {"n", "k"} <= set(parsed_table(read_text(path), ())[0])


def _common_grid(samples: Sequence[Sample], name: str) -> Floats:
    """Return the table's wavelengths [µm], as in `from_samples`."""
    starts, ends = np.array([sample.wavelength_um[[0, -1]] for sample in samples]).T
    first = max(KEPT_RANGE_UM[0], starts.min())
    last = min(KEPT_RANGE_UM[1], max(ends.min(), min(WANTED_RANGE_UM[1], ends.max())))
    steps = np.arange(np.ceil((first - SLACK_UM) / STEP_UM), np.floor((last + SLACK_UM) / STEP_UM) + 1)
    if steps.size < 2:
        raise ThermorenderError(
            f"the samples of material {name!r} have less than two steps of {STEP_UM:g} µm in common within "
            f"{KEPT_RANGE_UM[0]:g}–{KEPT_RANGE_UM[1]:g} µm; give thermal spectra"
        )
    return np.round(steps * STEP_UM, 9)


def _thermal_part(sample: Sample, name: str) -> Sample:
    """Return a sample without the part below a gap, or all noise below 3.2 µm; refuse gaps within 7–14 µm."""
    first = sample.wavelength_um[0]
    short = (sample.wavelength_um >= KEPT_RANGE_UM[0] - SLACK_UM) & (sample.wavelength_um < _SEAM_UM)
    if np.any(short & (np.abs(sample.reflectance - 0.5) > 0.5 + NOISE)):
        first = sample.wavelength_um[sample.wavelength_um <= _SEAM_UM][-1]
    for start, end in gaps(sample.wavelength_um):
        if start < WANTED_RANGE_UM[0]:
            first = max(first, end)
        elif start < KEPT_RANGE_UM[1]:
            raise ThermorenderError(
                f"sample {sample.source} of material {name!r} has no point between {start:g} and {end:g} µm; measure "
                "there, add points of your own, or end the sample before"
            )
    kept = sample.wavelength_um >= first
    return dataclasses.replace(sample, wavelength_um=sample.wavelength_um[kept], reflectance=sample.reflectance[kept])


def _check_sample(sample: Sample, name: str, first: float, last: float) -> None:
    """Refuse a sample outside 0…1, apart from noise below 3.2 µm, within the table's range."""
    kept = (sample.wavelength_um >= first - SLACK_UM) & (sample.wavelength_um <= last + SLACK_UM)
    noise = np.where(sample.wavelength_um < _SEAM_UM, NOISE, 0.0)
    bad = kept & ~((sample.reflectance >= -noise) & (sample.reflectance <= 1.0 + noise))
    if bad.any():
        at = np.flatnonzero(bad)[0]
        raise ThermorenderError(
            f"sample {sample.source} of material {name!r} has reflectance {100 * sample.reflectance[at]:g} %, "
            f"emissivity {1.0 - sample.reflectance[at]:g}, at {sample.wavelength_um[at]:g} µm, outside 0…100 % at "
            f"{np.count_nonzero(bad)} wavelengths; leave the sample out, or correct its units"
        )
    # The ends of the table may be between points.
    ends = np.interp([first, last], sample.wavelength_um, sample.reflectance)
    inside = np.concatenate([sample.reflectance[kept], ends])
    low, high = inside.min(), inside.max()
    if high < _DARKEST or low > _BRIGHTEST:
        extreme, wrong = ("at most", high) if high < _DARKEST else ("at least", low)
        raise ThermorenderError(
            f"sample {sample.source} of material {name!r} has reflectance {100 * wrong:.3g} % {extreme} over "
            f"{first:g}–{last:g} µm, which no surface has; its heading may state percent for shares, or reflectance "
            "for emissivity, so correct the heading or the values"
        )


def _on_grid(wavelength: Floats, value: Floats, grid: Floats, last: float | None = None) -> Floats:
    """Return the least-squares table of a spectrum on an even grid, both linear between their points.

    `last` is the value of the last row where it is given.

    The mean and slope over each half micrometre are kept exactly. Band emissivities are integrals with a smooth weight,
    so they agree with the measurement to 1e-6, below 7 µm to 1e-5. Values outside 0…1 are fixed at the limit and the
    rest is solved again; `scipy.optimize.lsq_linear` has limits but no equality constraints.
    """
    step, size = grid[1] - grid[0], grid.size
    nodes = np.union1d(wavelength[(wavelength > grid[0]) & (wavelength < grid[-1])], grid)
    low, high = nodes[:-1], nodes[1:]
    # Everything is linear between nodes, so Simpson's rule integrates products of three exactly.
    points = np.concatenate([low, 0.5 * (low + high), high])
    weights = np.concatenate([high - low, 4.0 * (high - low), high - low]) / 6.0
    # The midpoint determines the cell; a node may be on either side by rounding, even of the last row.
    cell = np.tile(np.minimum((0.5 * (low + high) - grid[0]) / step, size - 2).astype(int), 3)
    share = (points - grid[cell]) / step
    spectrum = np.interp(points, wavelength, value)

    def onto_grid(values: Floats, row: NDArray[np.intp] | int = 0, rows: int = 1) -> Floats:
        """Integrals of values times each hat function of the table, summed into rows."""
        left = np.bincount(row * size + cell, values * weights * (1.0 - share), rows * size)
        right = np.bincount(row * size + cell + 1, values * weights * share, rows * size)
        return np.asarray(left + right, np.float64).reshape(rows, size)

    between = np.diag(np.bincount(cell, weights * share * (1.0 - share), size)[:-1], 1)
    own = np.bincount(cell, weights * (1.0 - share) ** 2, size) + np.bincount(cell + 1, weights * share**2, size)
    gram, pull = np.diag(own) + between + between.T, onto_grid(spectrum)[0]
    edges = np.flatnonzero(np.abs(grid / INTERVAL_UM - np.round(grid / INTERVAL_UM)) < 1e-6)
    interval = np.searchsorted(edges, cell, side="right")
    levers = (np.ones(points.size), points - grid[cell[0]])
    kept = np.concatenate([onto_grid(lever, interval, edges.size + 1)[1:-1] for lever in levers])
    moments = [np.bincount(interval, weights * lever * spectrum, edges.size + 1)[1:-1] for lever in levers]
    aim = np.concatenate(moments)
    table, fixed = np.zeros(size), np.zeros(size, dtype=bool)
    if last is not None:
        table[-1], fixed[-1] = last, True
    for _ in range(size):
        free = ~fixed
        system = np.block([[gram[np.ix_(free, free)], kept[:, free].T], [kept[:, free], np.zeros((aim.size,) * 2)]])
        known = table[fixed]
        right = np.concatenate([pull[free] - gram[np.ix_(free, fixed)] @ known, aim - kept[:, fixed] @ known])
        # If a whole interval is fixed, its two conditions are void, which needs least squares.
        solve = np.linalg.solve if not fixed.any() else lambda a, b: np.linalg.lstsq(a, b, rcond=None)[0]
        table[free] = solve(system, right)[: free.sum()]
        outside = (table < 0.0) | (table > 1.0)
        if not outside.any():
            break
        table[outside], fixed = np.clip(table[outside], 0.0, 1.0), fixed | outside
    return table


def _coverage(grid: Floats, count: NDArray[np.intp]) -> str:
    """Return a remark on the number of samples by wavelength; "" if it is constant."""
    if count.min() == count.max():
        return ""
    edges = np.flatnonzero(np.diff(count)) + 1
    parts = zip([0, *edges], [*edges, grid.size], strict=True)
    return "samples: " + ", ".join(f"{count[a]} over {grid[a]:g}–{grid[b - 1]:g} µm" for a, b in parts)


def covers_sunlight(sample: Sample) -> bool:
    """Return whether a sample covers sunlight, 0.42–2.5 µm, for a solar absorptance."""
    known = sample.sunlight_um
    return bool(known.size and known[0] <= SOLAR_START_UM and known[-1] >= SOLAR_RANGE_UM[1])


def _solar_absorptance(samples: Sequence[Sample], name: str) -> tuple[float, float | None, str]:
    """Return one minus the reflectance weighted with a 5778 K blackbody, its spread or None, and a remark."""
    values, starts = [], []
    for sample in filter(covers_sunlight, samples):
        start = max(SOLAR_RANGE_UM[0], sample.sunlight_um[0])
        wavelength = np.linspace(start, SOLAR_RANGE_UM[1], 2001)
        weight = spectral_radiance(wavelength, SUN_TEMPERATURE_K)
        reflectance = np.interp(wavelength, sample.sunlight_um, sample.sunlight_reflectance)
        values.append(1.0 - (weight * reflectance).sum() / weight.sum())
        starts.append(start)
    if not values:
        raise ThermorenderError(
            f"no sample of material {name!r} covers {SOLAR_START_UM:g}–{SOLAR_RANGE_UM[1]:g} µm, so its "
            "solar_absorptance is unknown; give an assumed value as solar_absorptance"
        )
    remark = (
        f"solar absorptance from {len(values)} of {len(samples)} samples, weighted with a "
        f"{SUN_TEMPERATURE_K:g} K blackbody over {max(starts):g}–{SOLAR_RANGE_UM[1]:g} µm"
    )
    spread = float(np.std(values, ddof=1)) if len(values) >= FEWEST_FOR_SPREAD else None
    return float(np.mean(values)), spread, remark
