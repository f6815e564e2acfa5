"""What commands share at the terminal: options for outputs, a progress bar, a table, comma-separated options."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from thermorender import files
from thermorender.errors import ThermorenderError
from thermorender.progress import Progress as Progress
from thermorender.progress import progress as progress
from thermorender.timing import phase
from thermorender.units import instant

if TYPE_CHECKING:
    from thermorender.scene.scene import Scene
    from thermorender.scene.spec import TemperatureSpec

# (scene, text of --time) → instant.
ReadTime = Callable[["Scene", str], Any]
Time = Annotated[
    str | None,
    typer.Option(help="Instant of the scene's temperatures, UTC or with an offset, "
                 "2018-07-28T16:30+02:00. Default: the scene's weather.time."),
]  # fmt: skip


def output_option(*names: str, help: str, check: Callable[[Path], Any] = files.check_output_folder) -> Any:
    """Return a typer option for a path to write; `check` refuses one that cannot be written, before any work."""

    def checked(path: Path) -> Path:
        if path is not None:
            check(path)
        return path

    return typer.Option(*names, help=help, callback=checked)


Results = Annotated[Path, output_option("-o", "--output", help="Folder for the results.")]
NewResults = Annotated[
    Path, output_option("-o", "--output", help="New folder for the results.", check=files.check_new_folder)
]


def read_instant(scene: "Scene", text: str) -> Any:
    """Return the instant of an option --time, datetime64 UTC."""
    return instant("--time", text)


def at_time(
    name: str, time: str | None, read: ReadTime = read_instant, temperature: "TemperatureSpec | None" = None
) -> "Scene":
    """Return the Scene of a folder or name at the instant that `read` makes of (scene, text), or at its own."""
    with phase("imports"):
        from thermorender.scene.load import load_scene

    scene = load_scene(name)
    if temperature:
        scene = scene.with_temperature(temperature)
    if time is None:
        return scene
    return scene.at(read(scene, time))


def table(header: Sequence[object], rows: Iterable[Sequence[object]]) -> None:
    """Print columns with one row per line, also for pipes and spreadsheets; a column of empty cells is left out."""
    lines = [tuple(map(str, line)) for line in (header, *rows)]
    used = [any(line[k] for line in lines[1:]) for k in range(len(header))]
    lines = [tuple(cell for cell, use in zip(line, used, strict=True) if use) for line in lines]
    lines = lines if any(lines[0]) else lines[1:]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    for line in lines:
        typer.echo("  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip())


def warn(sentence: str | None) -> None:
    """Print a warning, if there is one."""
    if sentence:
        typer.echo(f"warning: {sentence}", err=True)


def named(text: str, option: str, form: str) -> tuple[str, str]:
    """Return (name, value) of a repeated option."""
    name, found, value = text.partition("=")
    if not (name and found and value):
        raise ThermorenderError(f"{option}={text!r} is not allowed; give {form}")
    return name, value


def split(text: str) -> tuple[str, ...]:
    """Return the parts of a comma-separated option."""
    return tuple(part.strip() for part in text.split(",") if part.strip())
