"""The verbs `materials …`: list, show, plot, check, import, copy, compare and join material tables."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from thermorender.cli.terminal import named, output_option, table
from thermorender.defaults import BAND_UM
from thermorender.errors import ThermorenderError
from thermorender.files import check_new_folder, check_output_file

if TYPE_CHECKING:
    from thermorender.materials.material import Material

app = typer.Typer(
    help="Look at, check, import and join tables of surface materials.", no_args_is_help=True, rich_markup_mode=None
)

Library = Annotated[
    Path | None, typer.Option("--library", help="Materials folder that overrides the shipped one, e.g. a scene's.")
]
BAND = "{:g},{:g}".format(*BAND_UM)
Band = Annotated[str, typer.Option("--band", help="LOWER,UPPER limits of the camera's band [µm].")]
Kelvin = Annotated[float, typer.Option("--temperature", help="Temperature of the surface for the band emissivity [K].")]


@app.command("list")
def list_materials(library: Library = None, band: Band = BAND, temperature: Kelvin = 300.0) -> None:
    """List the materials with their band emissivity."""
    from thermorender.apps.material_tables.compare import covers

    limits = _band(band)
    rows = []
    for material in _library(library).values():
        known = covers(material, limits)
        values = [material.band_emissivity(*limits, temperature, *where) if known else None for where in ((), (1.0,))]
        first, last = material.valid_range_um
        rows.append((material.name, *(f"{v:.4f}" if known else "not measured" for v in values), f"{first:g}–{last:g}",
                     material.directional, f"{material.solar_absorptance:.2f}", material.title))  # fmt: skip
    table(("name", "emissivity", "along normal", "measured [µm]", "by angle", "solar", "title"), rows)
    typer.echo(
        f"{len(rows)} materials; emissivity: hemispherical, over {limits[0]:g}–{limits[1]:g} µm at {temperature:g} K"
    )


@app.command()
def show(
    names: Annotated[list[str], typer.Argument(help="Materials.")],
    library: Library = None,
    band: Band = BAND,
    temperature: Kelvin = 300.0,
) -> None:
    """Print all data of materials, and their band emissivity."""
    import numpy as np

    limits = _band(band)
    for material in _materials(library, names):
        typer.echo(str(material))
        low, high = np.clip(limits, *material.valid_range_um)
        if low >= high:
            typer.echo(f"  band          not measured within {limits[0]:g}–{limits[1]:g} µm")
            continue
        where = f"over {low:g}–{high:g} µm at {temperature:g} K"
        rest = "" if (low, high) == limits else f"; {limits[0]:g}–{limits[1]:g} µm is not all measured"
        typer.echo(f"  band          {material.band_emissivity(low, high, temperature):.6f} {where}{rest}")
        if material.emissivity_by_angle is not None:
            angles = (0, 30, 45, 60, 70, 75, 80, 85)
            by_angle = (material.band_emissivity(low, high, temperature, np.cos(np.radians(angle))) for angle in angles)
            parts = ", ".join(f"{value:.4f} at {angle}°" for angle, value in zip(angles, by_angle, strict=True))
            typer.echo(f"  by angle      {parts}, {where}")


@app.command()
def plot(
    names: Annotated[list[str], typer.Argument(help="Materials, up to 8.")],
    output: Annotated[
        Path,
        output_option("-o", "--output", help="PNG to write.", check=lambda path: check_output_file(path, (".png",))),
    ] = Path("materials.png"),
    library: Library = None,
    band: Band = BAND,
    temperature: Kelvin = 300.0,
) -> None:
    """Draw emissivity against wavelength with its spread, and against angle."""
    from thermorender.apps.material_tables import plot as material_plot

    typer.echo(str(material_plot.plot(_materials(library, names), output, _band(band), temperature)))


@app.command()
def check(path: Annotated[Path, typer.Argument(help="Materials folder, or one spectrum file.")]) -> None:
    """Print errors in tables and how to fix them; status 2 if an error prevents their use."""
    from thermorender.apps.material_tables.check import check as run

    findings = run(path)
    for finding in findings:
        typer.echo(str(finding))
    faults = sum(finding.fault for finding in findings)
    typer.echo(f"{path}: {faults} faults, {len(findings) - faults} notes")
    raise typer.Exit(2 if faults else 0)


@app.command("import")
def import_spectra(
    into: Annotated[Path, output_option("--into", help="Materials folder to write to; made if absent.")],
    files: Annotated[
        list[Path] | None, typer.Argument(help="Spectra of one material, or folders with --selection.")
    ] = None,
    name: Annotated[str | None, typer.Option(help="Name in scene files.")] = None,
    column: Annotated[list[str] | None, typer.Option(help="Sample of a SLUM table; repeat for more.")] = None,
    title: Annotated[str, typer.Option(help="Readable title.")] = "",
    colour: Annotated[str, typer.Option(help="R,G,B: typical sRGB colour, 0-255.")] = "128,128,128",
    solar_absorptance: Annotated[float | None, typer.Option(help="Default: from the samples' reflectance.")] = None,
    temperature: Annotated[float, typer.Option(help="Typical temperature by day [K].")] = 300.0,
    rms_slope: Annotated[float, typer.Option(help="Roughness of a material given by n and k.")] = 0.0,
    source: Annotated[str, typer.Option(help="Origin of the numbers; required for your own.")] = "",
    citation: Annotated[str, typer.Option(help="Publication to cite; required for your own.")] = "",
    licence: Annotated[str, typer.Option(help="Licence; required for your own.")] = "",
    selection: Annotated[Path | None, typer.Option(help="CSV that lists samples of many materials.")] = None,
    replace: Annotated[bool, typer.Option("--replace", help="Replace a material of that name.")] = False,
) -> None:
    """Make a material from ECOSTRESS text, SLUM columns, two-column CSV, or a CSV of n and k."""
    from thermorender.apps.material_tables.from_samples import import_files, read_selection
    from thermorender.materials.store import write_materials

    if selection is not None:
        materials = read_selection(selection, files or [])
        write_materials(materials, into, replace)
        typer.echo(f"{len(materials)} materials written to {into}")
        return
    if not name or not files:
        raise ThermorenderError("materials import needs spectrum files and --name, or folders and --selection")
    stored = import_files(
        files, into, name, columns=column, title=title, colour=_numbers("--colour", colour, ("R", "G", "B")),
        solar_absorptance=solar_absorptance, temperature=temperature, rms_slope=rms_slope, source=source,
        citation=citation, licence=licence, replace=replace,
    )  # fmt: skip
    typer.echo(str(stored))


@app.command("copy")
def copy_material(
    source: Annotated[str, typer.Argument(help="Name of the material to copy.")],
    name: Annotated[str, typer.Argument(help="Name of the copy.")],
    into: Annotated[Path, output_option("--into", help="Materials folder, e.g. a scene's; made if absent.")],
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", help="KEY=VALUE: solar_absorptance, emissivity, a thermal property; repeat for more."),
    ] = None,
    library: Library = None,
    replace: Annotated[bool, typer.Option("--replace", help="Replace a material of that name.")] = False,
) -> None:  # fmt: skip
    """Copy a material into a materials folder, with other values of some properties."""
    from thermorender.apps.material_tables.edit import copy_material as run

    wanted = dict(named(text, "--set", "KEY=VALUE, such as solar_absorptance=0.25") for text in settings or [])
    run(source, name, into, wanted, library, replace)
    typer.echo(f"{into}: {name}, a copy of {source}")


@app.command()
def diff(
    first: Annotated[str, typer.Argument(help="Materials folder, or the name of a material.")],
    second: Annotated[
        str, typer.Argument(help="Materials folder, or name; default: the shipped tables, overridden by the first.")
    ] = "",
    library: Library = None,
    band: Band = BAND,
) -> None:
    """Print differences of materials, in band emissivity and in mK of a 300 K surface under a 250 K sky."""
    from thermorender.apps.material_tables import compare as material_compare

    limits = _band(band)
    if second and not Path(first).is_dir() and not Path(second).is_dir():
        one, other = _materials(library, [first, second])
        found = [material_compare.compare(one, other, f"{first} → {second}", limits)]
    elif second:
        found = material_compare.diff_folders(Path(first), Path(second), limits)
    else:
        # A single folder overrides the shipped tables, as a scene's does; other materials are as shipped.
        found = material_compare.diff(_library(first), _library(None), limits)
    rows = [
        (d.name, *("—" if value is None else f"{value:.4f}" for value in d.emissivity),
         "—" if d.millikelvin is None else f"{d.millikelvin:+.1f}", d.what)
        for d in found
    ]  # fmt: skip
    if rows:
        table(("material", "emissivity, first", "second", "shift [mK]", "differs in"), rows)
    count = "1 difference" if len(rows) == 1 else f"{len(rows)} differences"
    typer.echo(
        f"{count}; emissivity over {limits[0]:g}–{limits[1]:g} µm at 300 K; shift of a camera's reading when the "
        "second replaces the first"
    )


@app.command()
def merge(
    first: Annotated[Path, typer.Argument(help="Materials folder.")],
    second: Annotated[Path, typer.Argument(help="Materials folder.")],
    output: Annotated[Path, output_option("-o", "--output", help="New folder for both.", check=check_new_folder)],
    prefer: Annotated[str | None, typer.Option(help="first or second: which library wins a conflict.")] = None,
) -> None:
    """Join two libraries; materials that differ between them are refused unless --prefer is given."""
    from thermorender.apps.material_tables.compare import merge as run

    from_first, from_second, conflicts = run(first, second, output, prefer)
    typer.echo(f"{output}: {len(from_first)} materials of {first}, {len(from_second)} of {second}")
    if conflicts:
        typer.echo(f"the {prefer} won: {', '.join(conflicts)}")


def _library(folder: Path | str | None) -> "dict[str, Material]":
    from thermorender.materials.library import load_library

    return load_library(folder)


def _materials(folder: Path | None, names: list[str]) -> "list[Material]":
    from thermorender.materials.library import find

    library = _library(folder)
    return [find(library, name, "the command line") for name in names]


def _band(text: str) -> tuple[float, float]:
    lower, upper = _numbers("--band", text, ("LOWER", "UPPER"))
    if not 0.0 < lower < upper:
        raise ThermorenderError(f"--band={text!r} is not a band; give LOWER,UPPER in µm, e.g. {BAND}")
    return lower, upper


def _numbers(option: str, text: str, names: tuple[str, ...]) -> tuple[float, ...]:
    from thermorender.numbers import parse_numbers

    return tuple(parse_numbers(option, text, names))
