"""Errors of learned maps moved to another hour and weather, and of simpler methods: `python -m validation.moved`."""

from pathlib import Path
from typing import Annotated

import typer

from thermorender import formats
from validation.command import Device, Out, conclude, new_results, run_command, seeds_of
from validation.moved import study
from validation.moved.figure import figure


def main(
    output: Out = Path("out/validation/moved"),
    seeds: Annotated[str, typer.Option(help="Comma-separated seeds of procedural scenes.")] = "301",
    device: Device = "auto",
):
    """Errors of maps moved to another hour and weather, of unmoved and offset maps, and of the heat balance alone."""
    with new_results(output) as (report, folder):
        result = study.run(seeds=seeds_of(seeds), progress=report, device=device)
        formats.write_json(folder / "moved.json", result)
        figure(folder / "moved.png", result)
    conclude("moved", output, study.HEADER, study.rows(result))


if __name__ == "__main__":
    run_command(main)
