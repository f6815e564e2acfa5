"""The heat balance and simpler methods against measured surface temperatures.

Run it as `python -m validation.heat`.
"""

from pathlib import Path
from typing import Annotated

import typer

from thermorender import formats
from thermorender.cli.workers import Cluster, spread_over
from thermorender.errors import ThermorenderError
from validation.command import Out, conclude, new_results, run_command
from validation.heat import study
from validation.heat.figure import figure


def main(
    data: Annotated[Path, typer.Option(help="Folder with the measured tables that the sites name.")],
    sites: Annotated[Path | None, typer.Option(help="File of sites; default: sites.toml of this study.")] = None,
    output: Out = Path("out/validation/heat"),
    cluster: Cluster = None,
):
    """The heat balance and simpler methods against measured surface temperatures, and error against run time."""
    with new_results(output) as (report, folder), spread_over(cluster, output) as spread:
        result = study.run(sites or Path(__file__).with_name("sites.toml"), data, progress=report, spread=spread)
        if not result["sites"]:
            raise ThermorenderError(f"--data={data} has no table of any site; give the folder with these tables")
        # Results of another file of sites have its name.
        name = sites.stem if sites else "heat"
        figure(folder / f"{name}.png", result)
        study.page(folder / f"{name}.md", result)
        formats.write_json(
            folder / f"{name}.json",
            result | {"sites": {n: {k: v for k, v in s.items() if k != "series"} for n, s in result["sites"].items()}},
        )
    conclude("heat", output, study.HEADER, study.rows(result), "table, numbers and figure")


if __name__ == "__main__":
    run_command(main)
