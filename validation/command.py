"""Code shared by the commands of studies: options, how they run, and their last lines."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from thermorender import files
from thermorender.cli.process import run
from thermorender.cli.terminal import output_option, progress, split, table
from thermorender.errors import ThermorenderError
from validation.verdicts import STUDIES, verdicts_of

Out = Annotated[Path, output_option("-o", "--output", help="Folder for the results.")]
Device = Annotated[str, typer.Option(help="auto, cpu or cuda.")]


def app_of(function):
    """Return the typer application of a study's main function."""
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)
    app.command()(function)
    return app


def run_command(function):
    """Run a study's main function as a command: a user's mistake is one sentence and status 2."""
    run(app_of(function), without_arguments=[])


@contextmanager
def new_results(output: Path) -> Iterator[tuple[Callable[[str, float], object], Path]]:
    """Give (progress function, folder to write to) of a study whose results are written whole or not at all."""
    with progress() as report, files.output_folder(output) as folder:
        yield report, folder


@contextmanager
def continued_results(output: Path) -> Iterator[Callable[[str, float], object]]:
    """Give the progress function of a study that continues earlier results; keep other processes out meanwhile."""
    with progress() as report, files.in_use(files.make_folder(output)):
        yield report


def conclude(name, output, header, rows, written="numbers and figure"):
    """Print a study's table, how many of its cases hold, and where its files are.

    Parameters
    ----------
    name : str
        Name of the study.
    output : Path
    header, rows : sequences
        Of the table.
    written : str
        The files, in words.
    """
    table(header, rows)
    for study in STUDIES:
        path = output / Path(study.result).name
        if study.name == name and path.is_file():
            verdicts = verdicts_of(study, path)[0]
            if verdicts:
                typer.echo(f"{sum(each.holds for each in verdicts)} of {len(verdicts)} cases hold")
    typer.echo(f"{written} in {output}")


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
