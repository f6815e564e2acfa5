"""Error against run time of this renderer and of stock Mitsuba, with a path-traced reference.

Run it as `python -m validation.convergence`.
"""

from pathlib import Path
from typing import Annotated

import typer

from thermorender import defaults
from thermorender.cli.terminal import Time, at_time
from validation.command import Device, Out, continued_results, run_command
from validation.convergence import study
from validation.drapes import drape


def main(
    scenes: Annotated[list[str] | None, typer.Argument(help=f"Scenes; default: {' '.join(defaults.SCENES)}.")] = None,
    output: Out = Path("out/validation/convergence"),
    quick: Annotated[bool, typer.Option("--quick", help="Minutes instead of an hour.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Measure existing cases again.")] = False,
    time: Time = None,
    device: Device = "auto",
):
    """Error against run time of this renderer and of stock Mitsuba, with a path-traced reference."""
    with continued_results(output) as report:
        loaded = [at_time(str(drape(name)), time) for name in scenes or defaults.SCENES]
        study.convergence(loaded, output, report, "quick" if quick else "full", overwrite, device)
    typer.echo(f"table, numbers and figures in {output}")


if __name__ == "__main__":
    run_command(main)
