"""Errors of lag and blur against run time, and the cost of the whole chain.

Run it as `python -m validation.sensor`.
"""

from pathlib import Path
from typing import Annotated

import typer

from thermorender.cli.terminal import Time, at_time, progress
from validation.command import Device, Out, run_command
from validation.drapes import KINDS, drape
from validation.sensor import study


def main(
    scene: Annotated[str, typer.Argument(help="Scene folder, or the name of a shipped scene.")] = KINDS[0],
    output: Out = Path("out/validation/sensor"),
    time: Time = None,
    device: Device = "auto",
):
    """Errors of lag and blur against run time, and the cost of the whole chain."""
    with progress() as report:
        study.sensor(output, at_time(str(drape(scene)), time), device=device, progress=report)
    typer.echo(f"table, numbers and figures in {output}")


if __name__ == "__main__":
    run_command(main)
