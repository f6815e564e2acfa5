"""The stated sampling error of frames against 256 rays per pixel: `python -m validation.budget`."""

from pathlib import Path
from typing import Annotated

import typer

from thermorender.cli.terminal import progress, table
from validation.budget import study
from validation.command import Device, Out, alone, run_command


def main(
    output: Out = Path("out/validation/budget"),
    drawn: Annotated[int, typer.Option(min=0, help="Views to draw between 20 m and 20 km, 10° and 90°.")] = 105,
    seed: Annotated[int, typer.Option(min=0, help="Of the drawn views and of the made scenes.")] = 0,
    device: Device = "auto",
):
    """What frames state of their sampling error, held against 256 rays per pixel; continues where it was stopped."""
    with progress() as tell, alone(output):
        cases = study.run(output, drawn=drawn, seed=seed, progress=tell, device=device)
    table(study.HEADER, study.rows(cases))
    told = study.summary(cases)
    if told["views"]:
        typer.echo(
            f"of {told['views']} drawn views {told['covered']:.0%} err by no more than is stated; in the median "
            f"{told['median']:.2f} times the error is stated"
        )
    typer.echo(f"numbers and figure in {output}")


if __name__ == "__main__":
    run_command(main)
