"""Cost of air in a frame, and the error of its spectral channels: `python -m validation.air`."""

from pathlib import Path
from typing import Annotated

import typer

from thermorender import formats
from thermorender.cli.options import parse_air
from thermorender.cli.terminal import Time, at_time
from validation.air import study
from validation.air.figure import figure
from validation.command import Device, Out, conclude, new_results, run_command
from validation.drapes import KINDS, drape


def main(
    scene: Annotated[str, typer.Argument(help="Scene folder, or the name of a shipped scene.")] = KINDS[0],
    output: Out = Path("out/validation/air"),
    air: Annotated[str, typer.Option(help="Standard atmosphere and aerosol.")] = "midlatitude-summer,rural-23km",
    time: Time = None,
    device: Device = "auto",
):
    """Cost of air in a frame, and the error of its spectral channels."""
    with new_results(output) as (report, folder):
        result = study.run(at_time(str(drape(scene)), time), parse_air(air), device=device, progress=report)
        formats.write_json(folder / "air.json", result)
        figure(folder / "air.png", result)
    conclude("air", output, study.HEADER, study.rows(result))


if __name__ == "__main__":
    run_command(main)
