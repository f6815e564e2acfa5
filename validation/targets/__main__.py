"""Small and far targets against a long lens: `python -m validation.targets`."""

from pathlib import Path
from typing import Annotated

import typer

from thermorender import formats
from thermorender.cli.workers import Cluster, spread_over
from validation.command import Device, Out, conclude, new_results, run_command
from validation.targets import study


def main(
    output: Out = Path("out/validation/targets"),
    places: Annotated[int, typer.Option(min=1, help="Places of each target, in different parts of a pixel.")] = 6,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the places and directions.")] = 0,
    device: Device = "auto",
    cluster: Cluster = None,
):
    """The radiance that small targets add to a frame, against the same view through a long lens."""
    with new_results(output) as (report, folder), spread_over(cluster, output) as spread:
        result = study.run(places, seed, progress=report, device=device, spread=spread)
        study.page(folder / "targets.md", result)
        formats.write_json(folder / "targets.json", result)
    conclude("targets", output, study.HEADER, study.rows(result), "table and numbers")


if __name__ == "__main__":
    run_command(main)
