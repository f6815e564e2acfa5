"""Errors of a learned emissivity map and of simpler methods on procedural scenes.

Run it as `python -m validation.emissivity`.
"""

from pathlib import Path
from typing import Annotated

import typer

from thermorender import formats
from validation.command import Out, conclude, new_results, run_command, seeds_of
from validation.emissivity import study


def main(
    output: Out = Path("out/validation/emissivity"),
    model: Annotated[str, typer.Option(help="Emissivity map: a file, or procedural.")] = "procedural",
    seeds: Annotated[str, typer.Option(help="Comma-separated seeds of procedural scenes not trained on.")] = "201,202",
):
    """Errors of a learned emissivity map and of simpler methods on procedural scenes."""
    numbers = seeds_of(seeds)
    with new_results(output) as (report, folder):
        result = study.evaluate(model, numbers, progress=report)
        formats.write_json(folder / "emissivity.json", result)
        study.write_confusion(result, folder / "emissivity_confusion.csv")
    conclude("emissivity", output, study.HEADER, study.rows(result), "numbers and confusion table")


if __name__ == "__main__":
    run_command(main)
