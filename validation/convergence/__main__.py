"""Error against run time, beside stock Mitsuba, against a path-traced reference.

Run it as `python -m validation.convergence`.
"""

from pathlib import Path
from typing import Annotated

import typer

from thermorender import defaults
from thermorender.cli.terminal import Time, at_time, progress
from validation.command import Device, Out, alone, run_command
from validation.convergence import study


def main(
    scenes: Annotated[list[str] | None, typer.Argument(help=f"Scenes; default: {' '.join(defaults.SCENES)}.")] = None,
    output: Out = Path("out/validation/convergence"),
    quick: Annotated[bool, typer.Option("--quick", help="Minutes instead of an hour.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Measure anew what is there.")] = False,
    time: Time = None,
    device: Device = "auto",
):
    """Error against run time, beside stock Mitsuba, against the path-traced reference."""
    with progress() as tell, alone(output):
        loaded = [at_time(name, time) for name in scenes or defaults.SCENES]
        study.convergence(loaded, output, tell, "quick" if quick else "full", overwrite, device)
    typer.echo(f"table, numbers and figures in {output}")


if __name__ == "__main__":
    run_command(main)
