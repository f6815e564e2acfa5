"""Commands of learned temperature maps: `thermorender evaluate`."""

from pathlib import Path
from typing import Annotated

import typer

from thermorender import files
from thermorender.cli.terminal import output_option, progress, table
from thermorender.errors import ThermorenderError


def evaluate(
    models: Annotated[list[str], typer.Argument(help="Learned maps: names, or .npz files.")],
    dataset: Annotated[Path, typer.Option(help="Folder of the data set.")],
    output: Annotated[
        Path, output_option("-o", "--output", help="New folder for the results.", check=files.check_new_folder)
    ],
    oracle: Annotated[
        str | None, typer.Option(help="File of a map that is shown the material as well, as a lower limit.")
    ] = None,
    foreign: Annotated[
        list[str] | None,
        typer.Option(help="NAME=FOLDER: pictures that another program made, named by the pairs' keys; repeat."),
    ] = None,
    split: Annotated[Path | None, typer.Option(help="File of a split in place of the data set's own.")] = None,
    part: Annotated[str, typer.Option(help="train, validation or test.")] = "test",
    limit: Annotated[int | None, typer.Option(help="Score so many pairs, evenly spaced.", min=1)] = None,
    seed: Annotated[int, typer.Option(help="Of the bootstrap.", min=0)] = 0,
):
    """Errors of learned maps on a data set, in kelvin, beside simple methods and the least error there is."""
    from thermorender.campaign.dataset import PARTS, read_dataset
    from thermorender.validate import evaluation as study
    from thermorender.validate.evaluation import report

    if part not in PARTS:
        raise ThermorenderError(f"--part={part!r} is unknown; give {', '.join(PARTS)}")
    folders = dict(_named(text) for text in foreign or ())
    parts = None
    if split is not None:
        from thermorender.campaign.splits import read_split

        parts = read_split(split)
    with progress() as tell:
        result = study.evaluate(read_dataset(dataset), models, output, oracle, folders, parts, part, limit, seed, tell)
    for line in report.lines_before(result):
        typer.echo(line)
    table(report.HEADER, [*report.rows(result), *report.published_rows()])
    typer.echo(report.CAVEAT)
    typer.echo(f"tables, numbers and pictures in {output}")


def _named(text):
    """(name, folder) of an option --foreign."""
    name, found, folder = text.partition("=")
    if not (name and found and folder):
        raise ThermorenderError(f"--foreign={text!r} is not allowed; give NAME=FOLDER")
    return name, folder
