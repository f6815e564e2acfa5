"""Learned maps on real pairs of pictures, each group of pictures tested by maps trained on the others.

Run it as `python -m validation.real_pairs FOLDER`.
"""

from pathlib import Path
from typing import Annotated

import typer

from thermorender import formats
from thermorender.cli.terminal import split
from validation.command import Out, conclude, new_results, run_command
from validation.real_pairs import study


def main(
    data: Annotated[Path, typer.Argument(help="Folder with the sets' folders, which sets.toml of this study names.")],
    output: Out = Path("out/validation/real_pairs"),
    sets: Annotated[
        str | None, typer.Option(help=f"Comma-separated: {', '.join(study.SETS)}; default: those in the folder.")
    ] = None,
    methods: Annotated[
        str | None, typer.Option(help=f"Comma-separated: {', '.join(study.METHODS)}; default: all.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of training, intervals and draws.", min=0)] = 0,
    rendered: Annotated[Path | None, typer.Option(help="A rendered data set, whose test part is anchored too.")] = None,
):
    """Learned maps on real pairs of pictures, each group of pictures tested by maps trained on the others."""
    with new_results(output) as (report, folder):
        result = study.run(
            data, split(sets) if sets else None, split(methods) if methods else None, seed, rendered, report
        )
        formats.write_json(folder / "real_pairs.json", result)
        study.page(folder / "real_pairs.md", result)
    conclude("real_pairs", output, study.HEADER, study.rows(result), "page and numbers")


if __name__ == "__main__":
    run_command(main)
