"""What the commands of studies share: their options, and how they run."""

from pathlib import Path
from typing import Annotated

import typer

from thermorender import files
from thermorender.cli.process import run
from thermorender.cli.terminal import output_option, split
from thermorender.errors import ThermorenderError

Out = Annotated[Path, output_option("-o", "--output", help="Folder for the results.")]
Device = Annotated[str, typer.Option(help="auto, cpu or cuda.")]


def app_of(function):
    """Return the typer application of one study, a function."""
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)
    app.command()(function)
    return app


def run_command(function):
    """Run a study as a command: a user's mistake is one sentence and status 2."""
    run(app_of(function), without_arguments=[])


def alone(folder):
    """Keep other processes out of a folder of results that is continued."""
    return files.in_use(files.make_folder(folder))


def seeds_of(text):
    """Return the whole numbers of an option --seeds.

    Raises
    ------
    ThermorenderError
        The text is not a list of whole numbers.
    """
    if not all(part.isdigit() for part in split(text)) or not split(text):
        raise ThermorenderError(f"--seeds={text!r} is not allowed; give whole numbers such as 201,202")
    return [int(part) for part in split(text)]
