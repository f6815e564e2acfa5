"""Power spectra and noise of simulated and of real frames: `python -m validation.footage`."""

from pathlib import Path
from typing import Annotated

import typer

from thermorender import defaults
from thermorender.apps.survey.verbs import Base, Frames, Scale, parse_scale
from validation.command import Device, Out, conclude, new_results, run_command
from validation.drapes import KINDS
from validation.footage import study


def main(
    frames: Frames,
    output: Out = Path("out/validation/footage"),
    base: Base = defaults.CAMERA,
    scale: Scale = None,
    scene: Annotated[str, typer.Option(help="Scene of the simulated frames.")] = KINDS[0],
    name: Annotated[str, typer.Option(help="Name of the files to write.")] = "footage",
    device: Device = "auto",
):
    """Power spectra and noise of simulated and of real frames."""
    with new_results(output) as (report, folder):
        result = study.compare(frames, folder, base, parse_scale(scale), scene, name, progress=report, device=device)
    conclude("footage", output, study.HEADER, study.rows(result), "numbers, figure and fitted camera")


if __name__ == "__main__":
    run_command(main)
