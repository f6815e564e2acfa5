"""Training pictures found in other pictures: planted leaks of six kinds, and pictures found by mistake.

Run it as `python -m validation.leaks`.
"""

from pathlib import Path
from typing import Annotated

import typer

from thermorender import formats
from validation.command import Out, conclude, new_results, run_command
from validation.leaks import study


def main(
    pictures: Annotated[
        list[Path] | None, typer.Option(help="Folder of pictures to try beside the procedural ones; repeat.")
    ] = None,
    output: Out = Path("out/validation/leaks"),
    seed: Annotated[int, typer.Option(help="Seed of crops and brightness.", min=0)] = 0,
):
    """Training pictures found in other pictures: planted leaks of six kinds, and pictures found by mistake."""
    with new_results(output) as (report, folder):
        result = study.run(pictures or (), seed, report)
        formats.write_json(folder / "leaks.json", result)
    conclude("leaks", output, study.HEADER, study.rows(result), "numbers")


if __name__ == "__main__":
    run_command(main)
