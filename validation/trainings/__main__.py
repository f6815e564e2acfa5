"""Comparison of trainings of networks: validation error against cost, and strips of epochs.

Run it as `python -m validation.trainings`.
"""

from pathlib import Path
from typing import Annotated

import typer

from thermorender import files, formats
from validation.command import Out, conclude, run_command
from validation.trainings import study
from validation.trainings.figure import write


def main(
    runs: Annotated[list[Path], typer.Argument(help="Folders that `train --run` wrote.")],
    output: Out = Path("out/validation/trainings"),
):
    """Comparison of trainings of networks: validation error against cost, and strips of epochs."""
    result = study.run(runs)
    with files.output_folder(output) as folder:
        formats.write_json(folder / "trainings.json", result)
        write(folder, result, runs)
    for line in study.sentences(result) + study.extrapolations(result):
        typer.echo(line)
    conclude("trainings", output, study.HEADER, study.rows(result), "numbers and figures")


if __name__ == "__main__":
    run_command(main)
