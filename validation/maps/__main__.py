"""Errors of learned temperature maps against their training data: amount, alignment, kinds of land.

Run it as `python -m validation.maps`.
"""

from pathlib import Path
from typing import Annotated

import typer

from thermorender import formats
from thermorender.apps.compare.figures import against_share, against_shift
from thermorender.apps.training.dataset import read_dataset
from thermorender.cli.terminal import split
from validation.command import Out, conclude, new_results, run_command
from validation.maps import study


def main(
    dataset: Annotated[Path, typer.Option(help="Folder of a data set with a training and a test part.")],
    output: Out = Path("out/validation/maps"),
    methods: Annotated[
        str | None, typer.Option(help="Comma-separated methods of `train`; default: correlations, palette, and "
                                 "correlation+ if the data set has relief and weather.")
    ] = None,
    vary: Annotated[
        str | None, typer.Option(help="Comma-separated: share (of sequences), shift_px (of thermal pictures), kind (of "
                                 "land left out). Default: all that the data set allows.")
    ] = None,
    limit: Annotated[int, typer.Option(help="Number of test pairs to score, evenly spaced.", min=1)] = 60,
    seed: Annotated[int, typer.Option(help="Seed of training and shifts.", min=0)] = 0,
):  # fmt: skip
    """Errors of learned temperature maps against their training data: amount, alignment, kinds of land."""
    with new_results(output) as (report, folder):
        names = split(methods) if methods else None
        result = study.run(read_dataset(dataset), names, split(vary) if vary else None, limit, seed, report)
        formats.write_json(folder / "maps.json", result)
        for varied, draw in (("share", against_share), ("shift_px", against_shift)):
            curves = {}
            for case in result["cases"]:
                if case["varied"] == varied:
                    curves.setdefault(case["method"], []).append((case["value"], case["mae_k"]))
            if curves:
                draw(folder / f"maps_{varied}.png", curves)
    conclude("maps", output, study.HEADER, study.rows(result), "numbers and figures")


if __name__ == "__main__":
    run_command(main)
