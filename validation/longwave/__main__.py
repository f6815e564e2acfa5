"""The sky's long-wave against pyrgeometers: `python -m validation.longwave --data DIR`."""

from pathlib import Path
from typing import Annotated

import typer

from thermorender import formats
from thermorender.cli.workers import Cluster, spread_over
from thermorender.errors import ThermorenderError
from validation.command import Out, conclude, new_results, run_command
from validation.longwave import study


def main(
    data: Annotated[list[Path], typer.Option(help="Folder with the tables that the sites name; may be repeated.")],
    sites: Annotated[
        list[Path] | None, typer.Option(help="File of sites; default: sites.toml and held_out.toml of heat.")
    ] = None,
    gases: Annotated[
        Path | None, typer.Option(help="RRTMGP's rrtmgp-gas-lw-g256.nc, to compute the flux of clear columns.")
    ] = None,
    output: Out = Path("out/validation/longwave"),
    cluster: Cluster = None,
):
    """The modelled and the spectral long-wave irradiance of the sky against pyrgeometers."""
    with new_results(output) as (report, folder), spread_over(cluster, output) as spread:
        result = study.run(sites or study.SITES, data, progress=report, spread=spread, gases=gases)
        if not result["sites"]:
            raise ThermorenderError(
                f"--data={', '.join(map(str, data))} has no table with long-wave of any site; give the folder with them"
            )
        study.page(folder / "longwave.md", result)
        formats.write_json(folder / "longwave.json", result)
    conclude("longwave", output, study.HEADER, study.rows(result), "table and numbers")


if __name__ == "__main__":
    run_command(main)
