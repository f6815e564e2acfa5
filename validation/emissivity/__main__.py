"""Errors of a learned emissivity map and of simpler methods on procedural scenes.

Run it as `python -m validation.emissivity`.
"""

from pathlib import Path
from typing import Annotated

import typer

from thermorender import formats
from thermorender.cli.terminal import table
from validation.command import Out, conclude, new_results, run_command, seeds_of
from validation.emissivity import labelled, study


def main(
    output: Out = Path("out/validation/emissivity"),
    model: Annotated[str, typer.Option(help="Emissivity map: a file, or procedural.")] = "procedural",
    seeds: Annotated[str, typer.Option(help="Comma-separated seeds of procedural scenes not trained on.")] = "201,202",
    pictures: Annotated[
        list[Path] | None, typer.Option(help="Folder of NAME.jpg and NAME_label.png; may be repeated.")
    ] = None,
    texel_m: Annotated[
        list[float] | None, typer.Option(help="Ground sampling distance of each folder of pictures [m].")
    ] = None,
):
    """Errors of a learned emissivity map and of simpler methods on procedural scenes."""
    numbers = seeds_of(seeds)
    with new_results(output) as (report, folder):
        result = study.evaluate(model, numbers, progress=report)
        formats.write_json(folder / "emissivity.json", result)
        study.write_confusion(result, folder / "emissivity_confusion.csv")
        if pictures:
            judged = labelled.run(pictures, texel_m or [], model, progress=report)
            judged["updated"] = labelled.updated(pictures, texel_m or [], model=model, progress=report)
            formats.write_json(folder / "labelled.json", judged)
            labelled.figure(folder / "calibration.png", judged)
            labelled.pictures(folder / "labelled.png", *labelled.first(pictures, texel_m or []), model)
            table(labelled.HEADER, labelled.rows(judged))
            table(labelled.UPDATED_HEADER, labelled.updated_rows(judged["updated"]))
    conclude("emissivity", output, study.HEADER, study.rows(result), "numbers and confusion table")


if __name__ == "__main__":
    run_command(main)
