"""Power spectra and noise of simulated frames beside those of real ones: `python -m validation.footage`."""

from pathlib import Path
from typing import Annotated

import typer

from thermorender import defaults, files
from thermorender.cli.camera import Base, Frames, Scale, parse_scale
from thermorender.cli.terminal import progress, table
from validation.command import Device, Out, run_command
from validation.footage import study


def main(
    frames: Frames,
    output: Out = Path("out/validation/footage"),
    base: Base = defaults.CAMERA,
    scale: Scale = None,
    scene: Annotated[str, typer.Option(help="Scene the simulated frames show.")] = defaults.SCENE,
    name: Annotated[str, typer.Option(help="Of the files to write.")] = "footage",
    device: Device = "auto",
):
    """Power spectra and noise of simulated frames beside those of real ones."""
    with progress() as tell, files.output_folder(output) as folder:
        result = study.compare(frames, folder, base, parse_scale(scale), scene, name, progress=tell, device=device)
    table(study.HEADER, study.rows(result))
    typer.echo(f"numbers, figure and fitted camera in {output}")


if __name__ == "__main__":
    run_command(main)
