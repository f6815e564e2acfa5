"""Cases at the limits and, with --fuzz, damaged files for every reader: `python -m tests.robustness`."""

from pathlib import Path
from typing import Annotated

import typer

from tests.robustness import run as study
from tests.robustness.fuzz import run as fuzz_run
from thermorender import files, formats
from thermorender.cli.terminal import progress, table
from validation.command import Out, run_command


def main(
    groups: Annotated[
        list[str] | None, typer.Argument(help="Some groups, such as air, faults, heat, precision; default: all.")
    ] = None,
    output: Out = Path("out/validation/stability"),
    fuzz: Annotated[int, typer.Option(min=0, help="Feed this many damaged files to each reader instead.")] = 0,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the damage.")] = 0,
):
    """Run cases at the limits, each with expected value, tolerance in kelvin and verdict; status 1 if one fails."""

    if fuzz:
        _fuzzed(groups or (), output, fuzz, seed)
        return
    with progress() as report, files.output_folder(output) as folder:
        result = study.run(groups or (), progress=report)
        formats.write_json(folder / "stability.json", result)
        study.table(folder / "stability.md", result)
    table(study.HEADER, study.rows(result))
    typer.echo(f"{result['failed']} of {len(result['cases'])} cases fail; numbers and table in {output}")
    if result["failed"]:
        raise typer.Exit(1)


def _fuzzed(readers, output, count, seed):
    """Feed readers with damaged files; status 1 if a reader neither refused nor accepted one correctly."""
    with progress() as report, files.output_folder(output) as folder:
        counts, faults = fuzz_run.run(count, readers, seed, progress=report)
        record = {"seed": seed, "counts": {name: dict(of) for name, of in counts.items()}}
        formats.write_json(folder / "fuzz.json", record | {"faults": [vars(fault) for fault in faults]})
    table(fuzz_run.HEADER, fuzz_run.rows(counts))
    typer.echo(f"{len(faults)} faults; counts and each fault in {output / 'fuzz.json'}")
    if faults:
        raise typer.Exit(1)


if __name__ == "__main__":
    run_command(main)
