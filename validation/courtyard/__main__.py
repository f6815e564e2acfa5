"""Walls of a courtyard against radiometers by direction: `python -m validation.courtyard --data DIR`."""

from pathlib import Path
from typing import Annotated

import typer

from thermorender import formats
from validation.command import Out, conclude, new_results, run_command
from validation.courtyard import study


def main(
    data: Annotated[Path, typer.Option(help="Folder with the site's files, kronenhuset.")],
    rays: Annotated[int, typer.Option(help="Rays of each sensor.", min=16)] = 16384,
    output: Out = Path("out/validation/courtyard"),
):
    """Long-wave from the walls of a courtyard by orientation and hour against measurements."""
    with new_results(output) as (report, folder):
        result = study.run(data, rays, progress=report)
        formats.write_json(folder / "courtyard.json", result)
    conclude("courtyard", output, study.HEADER, study.rows(result), "numbers")


if __name__ == "__main__":
    run_command(main)
