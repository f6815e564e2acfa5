"""Errors of maps moved to another hour and weather, beside simpler methods: `python -m validation.moved`."""

from pathlib import Path
from typing import Annotated

import typer

from thermorender import files, formats
from thermorender.cli.terminal import progress, table
from validation.command import Device, Out, run_command, seeds_of
from validation.moved import study
from validation.moved.figure import figure


def main(
    output: Out = Path("out/validation/moved"),
    seeds: Annotated[str, typer.Option(help="Comma-separated seeds of procedural scenes.")] = "301",
    device: Device = "auto",
):
    """Errors of maps moved to another hour and weather, beside the map unmoved, offset, and the heat balance alone."""
    with progress() as tell, files.output_folder(output) as folder:
        result = study.run(seeds=seeds_of(seeds), progress=tell, device=device)
        formats.write_json(folder / "moved.json", result)
        figure(folder / "moved.png", result)
    table(study.HEADER, study.rows(result))
    typer.echo(f"numbers and figure in {output}")


if __name__ == "__main__":
    run_command(main)
