"""The stated sampling error of frames against 256 rays per pixel: `python -m validation.budget`."""

from pathlib import Path
from typing import Annotated

import typer

from thermorender.cli.workers import Cluster, spread_over
from validation.budget import study
from validation.command import Device, Out, conclude, continued_results, run_command


def main(
    output: Out = Path("out/validation/budget"),
    drawn: Annotated[int, typer.Option(min=0, help="Views to draw between 20 m and 20 km, 10° and 90°.")] = 105,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the drawn views and of the made scenes.")] = 0,
    device: Device = "auto",
    cluster: Cluster = None,
):
    """The stated sampling error of frames against 256 rays per pixel; continues earlier results."""
    with continued_results(output) as report, spread_over(cluster, output) as spread:
        cases = study.run(output, drawn=drawn, seed=seed, progress=report, device=device, spread=spread)
    summary = study.summary(cases)
    if summary["views"]:
        typer.echo(
            f"the stated error exceeds the true one in {summary['covered']:.0%} of {summary['views']} drawn views; "
            f"the median of stated over true is {summary['median']:.2f}"
        )
    conclude("budget", output, study.HEADER, study.rows(cases))


if __name__ == "__main__":
    run_command(main)
