"""Miss distances in closed loops: `python -m validation.closed_loop`, with `pip install 'thermorender[sim]'`."""

from pathlib import Path
from typing import Annotated

import typer

from thermorender import formats
from validation.closed_loop import study
from validation.command import Device, Out, conclude, new_results, run_command


def main(
    output: Out = Path("out/validation/closed_loop"),
    runs: Annotated[int, typer.Option(min=1, help="Flights of each vehicle and method.")] = 5,
    device: Device = "auto",
):
    """Miss distances of a rocket and an aircraft that steer by frames of the link, for methods A, B and C."""
    with new_results(output) as (report, folder):
        result = study.run(runs, report, device)
        formats.write_json(folder / "closed_loop.json", result)
        study.figure(folder / "closed_loop.png", result)
    conclude("closed_loop", output, study.HEADER, study.rows(result))


if __name__ == "__main__":
    run_command(main)
