"""Seconds and memory of translating a picture with each learned map, and the steps where its tiles meet.

Run it as `python -m validation.translation`.
"""

from pathlib import Path
from typing import Annotated

import typer

from thermorender import defaults, files, formats
from thermorender.cli.terminal import progress, table
from validation.command import Out, run_command
from validation.translation import study


def main(
    models: Annotated[list[str], typer.Argument(help="Learned maps: names, or .npz files.")],
    dataset: Annotated[Path, typer.Option(help="Folder of a data set with a part to test on.")],
    output: Out = Path("out/validation/translation"),
    scene: Annotated[str, typer.Option(help="Its orthophoto is translated, too.")] = defaults.SCENE,
    pictures: Annotated[int, typer.Option(help="Of the test part.", min=1)] = 6,
):
    """What translating a picture costs with each learned map, and how far its tiles disagree where they meet."""
    with progress() as tell, files.output_folder(output) as folder:
        result = study.run(models, dataset, scene, pictures, tell)
        formats.write_json(folder / "translation.json", result)
    table(study.HEADER, study.rows(result))
    typer.echo(f"numbers in {output}")


if __name__ == "__main__":
    run_command(main)
