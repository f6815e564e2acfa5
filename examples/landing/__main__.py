"""Landings on a heated marker, with rendered and with translated frames in the loop.

Run it as `python -m examples.landing`.
"""

from pathlib import Path
from typing import Annotated

import typer

from examples.landing import run as study
from examples.landing.figure import figure
from thermorender import defaults
from thermorender.cli.terminal import output_option, progress, split, table
from validation.command import Device, alone, run_command


def main(
    output: Annotated[
        Path, output_option("-o", "--output", help="Folder for the results; runs that it holds are not flown again.")
    ] = Path("out/landing"),
    models: Annotated[
        str, typer.Option(help="Comma-separated learned maps that see colour only: names, or .npz files.")
    ] = ",".join(reversed(defaults.TEMPERATURE_MAPS)),
    runs: Annotated[int, typer.Option(help="Landings with each kind of frames.", min=1)] = 104,
    quality: Annotated[str, typer.Option(help="fast, standard or high: how finely a pixel is sampled.")] = "fast",
    device: Device = "auto",
):
    """Landings on a heated marker by image-based control, the renderer in the loop: rendered and translated frames."""
    with progress() as tell, alone(output):
        found = study.fly(output, split(models), runs, tell, quality=quality, device=device)
    told = study.write(found, output)
    figure(output / "landing.png", found)
    table(study.HEADER, study.rows(told))
    typer.echo(f"runs, numbers and figure in {output}")


if __name__ == "__main__":
    run_command(main)
