"""Errors of a learned emissivity map on procedural scenes, beside simpler methods.

Run it as `python -m validation.emissivity`.
"""

from pathlib import Path
from typing import Annotated

import typer

from thermorender import files, formats
from thermorender.cli.terminal import progress, table
from validation.command import Out, run_command, seeds_of
from validation.emissivity import study


def main(
    output: Out = Path("out/validation/emissivity"),
    model: Annotated[str, typer.Option(help="Emissivity map: a file, or procedural.")] = "procedural",
    seeds: Annotated[str, typer.Option(help="Comma-separated seeds of procedural scenes not trained on.")] = "201,202",
):
    """Errors of a learned emissivity map on procedural scenes, beside simpler methods."""
    numbers = seeds_of(seeds)
    with progress() as tell, files.output_folder(output) as folder:
        result = study.evaluate(model, numbers, progress=tell)
        formats.write_json(folder / "emissivity.json", result)
        study.write_confusion(result, folder / "emissivity_confusion.csv")
    table(study.HEADER, study.rows(result))
    typer.echo(f"numbers and confusion table in {output}")


if __name__ == "__main__":
    run_command(main)
