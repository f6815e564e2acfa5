"""What commands share at the terminal: options for outputs, a progress bar, a table, comma-separated options."""

from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from thermorender import files
from thermorender.errors import ThermorenderError
from thermorender.units import instant

Time = Annotated[
    str | None,
    typer.Option(help="Instant of the scene's temperatures, UTC or with an offset: 2018-07-28T14:30Z, "
                 "2018-07-28T16:30+02:00. Default: the scene's weather.time."),
]  # fmt: skip


def output_option(*names, help, check=files.check_output_folder):
    """Return a typer option for a path to write; `check` refuses one that cannot be written, before any work."""

    def checked(path: Path):
        if path is not None:
            check(path)
        return path

    return typer.Option(*names, help=help, callback=checked)


@contextmanager
def progress():
    """Give a function (what, share done) that draws a bar on a terminal and nothing elsewhere."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        tasks = {}

        def tell(what, share):
            key = "frames" if what.startswith("frame ") else what.partition(":")[0]
            if key not in tasks:
                tasks[key] = bar.add_task(what, total=1.0)
            bar.update(tasks[key], completed=share, description=what)

        yield tell


def at_time(name, time, read=lambda scene, text: instant("--time", text), temperature=None):
    """Return the Scene of a folder or name at the instant of an option --time, or at its own for None.

    `read` makes an instant of the scene and the text; `temperature` is a TemperatureSpec in place of the scene's own.
    """
    from thermorender.scene.load import load_scene

    scene = load_scene(name)
    if temperature:
        scene = scene.with_temperature(temperature)
    if time is None:
        return scene
    scene = scene.at(read(scene, time))
    if not scene.temperature_state.weather_driven:
        source = scene.spec.temperature.source
        typer.echo(f"note: temperatures of source {source!r} do not change with --time", err=True)
    return scene


def table(header, rows):
    """Print columns in whole lines, so that pipes and spreadsheets get them too."""
    lines = [tuple(map(str, line)) for line in (header, *rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    for line in lines:
        typer.echo("  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip())


def air(text):
    """Return (standard atmosphere, aerosol) of an option --air, or None for None."""
    if text is None:
        return None
    parts = split(text)
    if len(parts) > 2:
        raise ThermorenderError(f"--air={text!r} has {len(parts)} parts; give ATMOSPHERE or ATMOSPHERE,AEROSOL")
    return parts or ("",)


def named(text, option, form):
    """Return (name, value) of a repeated option."""
    name, found, value = text.partition("=")
    if not (name and found and value):
        raise ThermorenderError(f"{option}={text!r} is not allowed; give {form}")
    return name, value


def split(text):
    """Return the parts of a comma-separated option."""
    return tuple(part.strip() for part in text.split(",") if part.strip())
