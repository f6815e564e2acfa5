"""Time, kernels and differences of the devices of this machine: `python -m validation.gpu`."""

from pathlib import Path
from typing import Annotated

import typer

from thermorender.cli.terminal import split, table
from validation.command import Out, new_results, run_command
from validation.gpu import study


def main(
    output: Out = Path("out/validation/gpu"),
    devices: Annotated[str, typer.Option(help="cpu, cuda or both with a comma; by default those that work.")] = "",
    scenes: Annotated[str, typer.Option(help="Scenes, with a comma between them.")] = ",".join(study.SCENES),
    limit_s: Annotated[float, typer.Option(help="Time after which no further case begins [s].")] = study.LIMIT_S,
):
    """Time of loading, light, heat and frames by device, their kernels, and how far apart their frames are."""
    with new_results(output) as (report, folder):
        found = study.run(folder, split(devices) or None, split(scenes), limit_s=limit_s, progress=report)
    for header, rows in study.tables(found):
        if rows:
            table(header, rows)
            typer.echo("")
    for sentence in study.notes(found):
        typer.echo(sentence)
    typer.echo(f"numbers and frames in {output}")


if __name__ == "__main__":
    run_command(main)
