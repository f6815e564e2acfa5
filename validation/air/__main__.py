"""What air costs a frame, and the error of its spectral channels: `python -m validation.air`."""

from pathlib import Path
from typing import Annotated

import typer

from thermorender import defaults, files, formats
from thermorender.cli.terminal import Time, at_time, progress, table
from thermorender.cli.terminal import air as parse_air
from validation.air import study
from validation.air.figure import figure
from validation.command import Device, Out, run_command


def main(
    scene: Annotated[str, typer.Argument(help="Scene folder, or the name of a shipped one.")] = defaults.SCENE,
    output: Out = Path("out/validation/air"),
    air: Annotated[str, typer.Option(help="Standard atmosphere and aerosol.")] = "midlatitude-summer,rural-23km",
    time: Time = None,
    device: Device = "auto",
):
    """What air costs a frame, and what its spectral channels leave wrong."""
    with progress() as tell, files.output_folder(output) as folder:
        result = study.run(at_time(scene, time), parse_air(air), device=device, progress=tell)
        formats.write_json(folder / "air.json", result)
        figure(folder / "air.png", result)
    table(study.HEADER, study.rows(result))
    typer.echo(f"numbers and figure in {output}")


if __name__ == "__main__":
    run_command(main)
