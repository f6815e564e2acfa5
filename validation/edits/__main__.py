"""Time from an edit of materials or temperatures to its frame, and the error of previews.

Run it as `python -m validation.edits`.
"""

from pathlib import Path
from typing import Annotated

import typer

from thermorender import formats
from thermorender.cli.terminal import split
from validation.command import Device, Out, conclude, new_results, run_command
from validation.edits import study


def main(
    output: Out = Path("out/validation/edits"),
    scenes: Annotated[str, typer.Option(help="Scenes, with commas.")] = "heath,village",
    qualities: Annotated[str, typer.Option(help="Qualities, with commas.")] = "fast,standard",
    edits: Annotated[int, typer.Option(help="Edits of each of the four kinds.", min=1)] = 25,
    exact_every: Annotated[int, typer.Option(help="Every n-th edit is solved too.", min=1)] = 5,
    seed: Annotated[int, typer.Option(help="Seed of the edits.", min=0)] = 0,
    device: Device = "auto",
):
    """Time from an edit of materials or temperatures to its frame, and the error of previews."""
    with new_results(output) as (report, folder):
        result = study.run(split(scenes), split(qualities), edits, exact_every, seed, device, report)
        formats.write_json(folder / "edits.json", result)
    conclude("edits", output, study.HEADER, study.rows(result), "numbers")


if __name__ == "__main__":
    run_command(main)
