"""The heat balance of a desert wadi against a drone's thermal map, with a stated albedo and without.

Run it as `python -m validation.wadi --data DIR`.
"""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import typer

from thermorender import formats
from validation.command import Out, conclude, new_results, run_command
from validation.wadi import study


def main(
    data: Annotated[Path, typer.Option(help="Folder with N_dsm.tif, N_shade.tif and N_thermal_degC.tif.")],
    output: Out = Path("out/validation/wadi"),
):
    """The heat balance of a desert wadi against a drone's thermal map, with a stated albedo and without."""
    with new_results(output) as (report, folder), TemporaryDirectory() as scratch:
        result = study.run(data, Path(scratch), report)
        formats.write_json(folder / "wadi.json", result)
    conclude("wadi", output, study.HEADER, study.rows(result), "numbers")


if __name__ == "__main__":
    run_command(main)
