"""Writing into a materials folder: index row and tables, all or none; existing ones are replaced only on request."""

import csv
import io
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.files import atomic
from thermorender.formats import write_text
from thermorender.materials.csv_tables import (
    INDEX_COLUMNS,
    INDEX_OF_REFRACTION_COLUMNS,
    ROUGHNESS_COLUMN,
    SOLAR_STD_COLUMN,
    SPECTRUM_COLUMNS,
    read_table,
)
from thermorender.materials.library import NAME, read_library
from thermorender.materials.material import Material
from thermorender.materials.thermal import table_text


def write_material(material: Material, directory: str | Path, replace: bool = False) -> None:
    """Write a material's tables and its row of `index.csv` into a folder, all or none.

    Parameters
    ----------
    material : Material
        Lambertian, or with its `table`. Without thermal properties, an existing thermal table stays unchanged.
    directory : path
        Created if missing; other rows of its index stay unchanged.
    replace : bool
        Whether a material of the same name may be replaced.

    Raises
    ------
    ThermorenderError
        The folder already has a material of that name, or the new tables cannot be read back.
    """
    lines = [",".join(SPECTRUM_COLUMNS)]
    for row in zip(material.wavelength_um, material.emissivity, material.emissivity_std, strict=True):
        wavelength, emissivity, std = row
        lines.append(f"{wavelength:.9g},{emissivity:.6f},{'' if np.isnan(std) else f'{std:.5f}'}")
    thermal = table_text(material.thermal) if material.thermal else None
    store(index_row(material), material.table or "\n".join(lines) + "\n", directory, replace, thermal)


def write_materials(materials: Sequence[Material], directory: str | Path, replace: bool = False) -> None:
    """Write several materials; existing names are refused before the first is written."""
    for material in materials:
        _refuse_existing(Path(directory), material.name, replace)
    for material in materials:
        write_material(material, directory, replace)


def write_refractive_index(
    path: str | Path, material: Mapping[str, Any], directory: str | Path, replace: bool = False
) -> None:
    """Write a table of n and k as a Fresnel material into a folder, both index row and table or neither.

    Parameters
    ----------
    path : path
        CSV with the columns wavelength_um, n, k.
    material : dict
        Cells of its index row: name, title, source, rms_slope…
    directory, replace
        As in `write_material`.
    """
    row = {SOLAR_STD_COLUMN: "", **material, "directional": "fresnel"}
    lines = [",".join(INDEX_OF_REFRACTION_COLUMNS)]
    rows = read_table(path, INDEX_OF_REFRACTION_COLUMNS)
    lines += [",".join(cells[key] for key in INDEX_OF_REFRACTION_COLUMNS) for _, cells in rows]
    store(row, "\n".join(lines) + "\n", directory, replace)


def index_row(material: Material) -> dict[str, Any]:
    """Return the cells of a material's row of the index."""
    return {
        "name": material.name, "title": material.title, "colour_r": material.colour[0],
        "colour_g": material.colour[1], "colour_b": material.colour[2],
        "solar_absorptance": f"{material.solar_absorptance:.3g}", "directional": material.directional,
        "temperature_k": f"{material.temperature:g}", "samples": material.samples, "source": material.source,
        "citation": material.citation, "licence": material.licence, "note": material.note,
        SOLAR_STD_COLUMN: "" if material.solar_absorptance_std is None else f"{material.solar_absorptance_std:.2g}",
    } | ({ROUGHNESS_COLUMN: f"{material.rms_slope:g}"} if material.directional == "fresnel" else {})  # fmt: skip


def store(
    row: Mapping[str, Any], spectrum: str, directory: str | Path, replace: bool = False, thermal: str | None = None
) -> None:
    """Write a material's index row and the texts of its tables into a folder, all or none.

    `thermal` None writes no thermal table. Everything is read back from a scratch folder first, so nothing is written
    that the library would refuse.
    """
    directory, name = Path(directory), str(row["name"])
    if not NAME.fullmatch(name):
        raise ThermorenderError(f"name={name!r} is not a material name; use letters, digits, _ and -")
    index = directory / "index.csv"
    _refuse_existing(directory, name, replace)
    rows = {cells["name"]: cells for _, cells in read_table(index, INDEX_COLUMNS)} if index.is_file() else {}
    tables = {f"spectra/{name}.csv": spectrum} | ({f"thermal/{name}.csv": thermal} if thermal else {})
    with tempfile.TemporaryDirectory() as scratch:
        try:
            _write_all(Path(scratch), tables | {"index.csv": _index_text([row])})
            read_library(Path(scratch))
        except ThermorenderError as error:
            raise ThermorenderError(str(error).replace(scratch, str(directory))) from None
    rows[name] = {**rows.get(name, {}), **row}
    _write_all(directory, tables | {"index.csv": _index_text(rows.values())})


def _refuse_existing(directory: Path, name: str, replace: bool) -> None:
    index, table = directory / "index.csv", directory / "spectra" / f"{name}.csv"
    names = {cells["name"] for _, cells in read_table(index, INDEX_COLUMNS)} if index.is_file() else set()
    if replace:
        return
    if name in names:
        raise ThermorenderError(f"{directory} already holds material {name!r}; choose another name, or set replace")
    if table.exists():
        raise ThermorenderError(
            f"{table} has no row in index.csv, as after an interrupted import; set replace, or choose another name"
        )


def drop_material(name: str, directory: str | Path) -> None:
    """Remove a material's row and tables from a folder, all or none; nothing happens without them."""
    directory, index = Path(directory), Path(directory) / "index.csv"
    rows = [cells for _, cells in read_table(index, INDEX_COLUMNS)] if index.is_file() else []
    left = [cells for cells in rows if cells["name"] != name]
    gone: dict[Path, str | bytes | None] = {directory / part / f"{name}.csv": None for part in ("spectra", "thermal")}
    replace_files(gone | ({index: _index_text(left) if left else None} if left != rows else {}))


def _write_all(directory: Path, texts: Mapping[str, str]) -> None:
    """Replace files of a folder, {path in it: text}; a failure restores those already written."""
    replace_files({directory / name: text for name, text in texts.items()})


def replace_files(contents: Mapping[Path, str | bytes | None]) -> None:
    """Replace files by new contents (None: remove them); a failure restores those already replaced."""
    before = {path: path.read_bytes() if path.exists() else None for path in contents}
    done = []
    try:
        for path, data in contents.items():
            _replace(path, data)
            done.append(path)
    except BaseException:
        for path in done:
            _replace(path, before[path])
        raise


def _replace(path: Path, data: str | bytes | None) -> None:
    if data is None:
        path.unlink(missing_ok=True)
        return
    if isinstance(data, str):
        write_text(path, data)
        return
    with atomic(path) as part:
        part.write_bytes(data)


def _index_text(rows: Iterable[Mapping[str, Any]]) -> str:
    rows = list(rows)
    columns = list(dict.fromkeys([*INDEX_COLUMNS, *(key for cells in rows for key in cells)]))
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()
