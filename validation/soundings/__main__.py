"""The air of the weather against whole soundings: `python -m validation.soundings SOUNDING.txt …`."""

from pathlib import Path
from typing import Annotated

import typer

from thermorender import formats
from thermorender.cli.workers import Cluster, spread_over
from validation.command import Out, conclude, new_results, run_command
from validation.soundings import study


def main(
    files: Annotated[list[Path], typer.Argument(help="Soundings in the University of Wyoming's text format.")],
    output: Out = Path("out/validation/soundings"),
    cluster: Cluster = None,
):
    """Error of the air that follows the weather, made from a sounding's lowest level, against the whole sounding."""
    with new_results(output) as (report, folder), spread_over(cluster, output) as spread:
        result = study.run(files, progress=report, spread=spread)
        formats.write_json(folder / "soundings.json", result)
    conclude("soundings", output, study.HEADER, study.rows(result), written="numbers")


if __name__ == "__main__":
    run_command(main)
