"""Trainings of networks beside each other: validation error against cost, and strips of epochs.

Run it as `python -m validation.trainings`.
"""

from pathlib import Path
from typing import Annotated

import typer

from thermorender import files, formats
from thermorender.cli.terminal import table
from validation.command import Out, run_command
from validation.trainings import study
from validation.trainings.figure import write


def main(
    runs: Annotated[list[Path], typer.Argument(help="Folders that `train --run` wrote.")],
    output: Out = Path("out/validation/trainings"),
):
    """Trainings of networks beside each other: validation error against what each has cost, and strips of epochs."""
    result = study.run(runs)
    with files.output_folder(output) as folder:
        formats.write_json(folder / "trainings.json", result)
        write(folder, result, runs)
    table(study.HEADER, study.rows(result))
    for line in study.sentences(result):
        typer.echo(line)
    typer.echo(f"numbers and figures in {output}")


if __name__ == "__main__":
    run_command(main)
