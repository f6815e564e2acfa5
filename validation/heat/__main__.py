"""The heat balance against measured surface temperatures, beside simpler methods.

Run it as `python -m validation.heat`.
"""

from pathlib import Path
from typing import Annotated

import typer

from thermorender import files, formats
from thermorender.cli.terminal import progress, table
from thermorender.errors import ThermorenderError
from validation.command import Out, run_command
from validation.heat import study
from validation.heat.figure import figure


def main(
    data: Annotated[Path, typer.Option(help="Folder with the measured tables that the sites name.")],
    sites: Annotated[Path | None, typer.Option(help="File of sites; default: sites.toml beside this study.")] = None,
    output: Out = Path("out/validation/heat"),
):
    """The heat balance against measured surface temperatures, beside simpler methods, and error against run time."""
    with progress() as tell, files.output_folder(output) as folder:
        result = study.run(sites or study.SITES, data, progress=tell)
        if not result["sites"]:
            raise ThermorenderError(f"--data={data} holds no table of the sites; give the folder that does")
        figure(folder / "heat.png", result)
        study.page(folder / "heat.md", result)
        formats.write_json(
            folder / "heat.json",
            result | {"sites": {n: {k: v for k, v in s.items() if k != "series"} for n, s in result["sites"].items()}},
        )
    table(study.HEADER, study.rows(result))
    typer.echo(f"table, numbers and figure in {output}")


if __name__ == "__main__":
    run_command(main)
