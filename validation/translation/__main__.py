"""Time and memory of translating a picture with each learned map, and the steps at its tiles' borders.

Run it as `python -m validation.translation`.
"""

from pathlib import Path
from typing import Annotated

import typer

from thermorender import formats
from validation.command import Out, conclude, new_results, run_command
from validation.drapes import KINDS
from validation.translation import study


def main(
    models: Annotated[list[str], typer.Argument(help="Learned maps: names, or .npz files.")],
    dataset: Annotated[Path, typer.Option(help="Folder of a data set with a test part.")],
    output: Out = Path("out/validation/translation"),
    scene: Annotated[str, typer.Option(help="Scene whose orthophoto is translated, too.")] = KINDS[0],
    pictures: Annotated[int, typer.Option(help="Pictures of the test part to translate.", min=1)] = 6,
):
    """Time and memory of translating a picture with each learned map, and the steps at its tiles' borders."""
    with new_results(output) as (report, folder):
        result = study.run(models, dataset, scene, pictures, report)
        formats.write_json(folder / "translation.json", result)
    conclude("translation", output, study.HEADER, study.rows(result), "numbers")


if __name__ == "__main__":
    run_command(main)
