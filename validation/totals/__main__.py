"""The stated total error of frames against path tracing: `python -m validation.totals`."""

from pathlib import Path
from typing import Annotated

import typer

from validation.command import Device, Out, conclude, continued_results, run_command
from validation.totals import study


def main(
    output: Out = Path("out/validation/totals"),
    seed: Annotated[int, typer.Option(min=0, help="Seed of the drawn scenes and views.")] = 0,
    only: Annotated[list[str] | None, typer.Option(help="Measure cases whose names contain this.")] = None,
    paths: Annotated[int, typer.Option(min=2, help="Paths per pixel of each reference.")] = study.PATHS,
    device: Device = "auto",
):
    """The stated total error of frames against path tracing; continues earlier results."""
    with continued_results(output) as report:
        cases = study.run(output, seed, paths, only, report, device)
    found = study.summary(cases)
    if found["cases"]:
        typer.echo(
            f"the stated error exceeds the true one in {found['covered']:.0%} of {found['cases']} cases; "
            f"the median of stated over true is {found['median']:.2f}"
        )
    conclude("totals", output, study.HEADER, study.rows(cases))


if __name__ == "__main__":
    run_command(main)
