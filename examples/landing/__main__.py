"""Landings on a heated marker with rendered and with translated frames in the loop.

Run it as `python -m examples.landing`.
"""

from pathlib import Path
from typing import Annotated

import typer

from examples.landing import run as study
from examples.landing.figure import figure
from thermorender import defaults
from thermorender.cli.terminal import output_option, split
from validation.command import Device, conclude, continued_results, run_command


def main(
    output: Annotated[
        Path, output_option("-o", "--output", help="Folder for the results; its runs are not flown again.")
    ] = Path("out/landing"),
    models: Annotated[
        str, typer.Option(help="Comma-separated learned maps without extra inputs: names, or .npz files.")
    ] = ",".join(reversed(defaults.TEMPERATURE_MAPS)),
    runs: Annotated[int, typer.Option(help="Number of landings with each kind of frames.", min=1)] = 104,
    quality: Annotated[str, typer.Option(help="fast, standard or high: sampling of a pixel.")] = "fast",
    device: Device = "auto",
):
    """Landings on a heated marker by image-based control, with rendered and with translated frames in the loop."""
    with continued_results(output) as report:
        found = study.fly(output, split(models), runs, report, quality=quality, device=device)
    summary = study.write(found, output)
    figure(output / "landing.png", found)
    conclude("landing", output, study.HEADER, study.rows(summary), "runs, numbers and figure")


if __name__ == "__main__":
    run_command(main)
