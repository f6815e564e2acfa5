"""Run the studies without results, then write one page of verdicts: `python -m validation`."""

from contextlib import suppress
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Annotated

import typer

from thermorender import files
from thermorender.cli.terminal import table
from thermorender.errors import ThermorenderError
from validation.command import run_command
from validation.page import HEADER, PAGE, rows, write_page
from validation.verdicts import gathered


def main(
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Folder of all results; studies with results are not run again.")
    ] = Path("validation"),
    data: Annotated[Path | None, typer.Option(help="Folder of measured tables, for heat.")] = None,
    dataset: Annotated[Path | None, typer.Option(help="Folder of a data set, for maps.")] = None,
):
    """Run the studies without results, and write one page of verdicts; the status is 1 if a case fails."""
    files.check_output_folder(output)
    needs = {"heat": data, "maps": dataset}
    failed = []
    for study, verdicts, _ in gathered(output):
        # A study without its data is left out; the page says so.
        if not study.runs or needs.get(study.name, True) is None or not (verdicts is None or study.continues):
            continue
        typer.echo(f"{study.name}: {study.title}")
        job = import_module(f"{study.module}.__main__").main
        job = partial(job, needs[study.name]) if study.name in needs else job
        # A study exits with a status if a case fails; the others still run.
        with suppress(typer.Exit):
            try:
                job(output=output / Path(study.result).parent)
            except ThermorenderError as error:
                failed.append(f"{study.name}: {error}")
    found = write_page(output)
    table(HEADER, rows(found))
    typer.echo(f"page in {output / PAGE}")
    for sentence in failed:
        typer.echo(sentence, err=True)
    if failed or not all(each.holds for _, verdicts, _ in found for each in verdicts or ()):
        raise typer.Exit(1)


if __name__ == "__main__":
    run_command(main)
