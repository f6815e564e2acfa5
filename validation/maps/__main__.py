"""Errors of learned temperature maps against what they were trained on: how much, how aligned, which land.

Run it as `python -m validation.maps`.
"""

from pathlib import Path
from typing import Annotated

import typer

from thermorender import files, formats
from thermorender.campaign.dataset import read_dataset
from thermorender.cli.terminal import progress, split, table
from thermorender.compare.evaluation.figures import against_share, against_shift
from validation.command import Out, run_command
from validation.maps import study


def main(
    dataset: Annotated[Path, typer.Option(help="Folder of a data set with parts to train and to test on.")],
    output: Out = Path("out/validation/maps"),
    methods: Annotated[
        str | None, typer.Option(help="Comma-separated, as of `train`; default: correlations, palette, and "
                                 "correlation+ where the data set tells relief and weather.")
    ] = None,
    vary: Annotated[
        str | None, typer.Option(help="Comma-separated: share, of sequences; shift_px, of thermal pictures; kind, of "
                                 "land that is left out. Default: all that the data set allows.")
    ] = None,
    limit: Annotated[int, typer.Option(help="Test pairs that are scored, evenly spaced.", min=1)] = 60,
    seed: Annotated[int, typer.Option(help="Of training and shifts.", min=0)] = 0,
):  # fmt: skip
    """Errors of learned temperature maps against what they were trained on: how much, how aligned, which land."""
    with progress() as tell, files.output_folder(output) as folder:
        names = split(methods) if methods else None
        result = study.run(read_dataset(dataset), names, split(vary) if vary else None, limit, seed, tell)
        formats.write_json(folder / "maps.json", result)
        for varied, draw in (("share", against_share), ("shift_px", against_shift)):
            curves = {}
            for case in result["cases"]:
                if case["varied"] == varied:
                    curves.setdefault(case["method"], []).append((case["value"], case["mae_k"]))
            if curves:
                draw(folder / f"maps_{varied}.png", curves)
    table(study.HEADER, study.rows(result))
    typer.echo(f"numbers and figures in {output}")


if __name__ == "__main__":
    run_command(main)
