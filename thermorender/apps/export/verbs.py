"""The verbs `export …`: files for other programs from the frames of a folder."""

from pathlib import Path
from typing import Annotated

import typer

from thermorender.cli.terminal import NewResults, output_option
from thermorender.files import check_output_file

app = typer.Typer(
    help="Write labels, masks and geotagged images from the frames of render, fly or day.",
    no_args_is_help=True,
    rich_markup_mode=None,
)

Frames = Annotated[Path, typer.Argument(help="Folder with frame_*.exr and their truth.")]


def _counted(number: int, name: str) -> str:
    return f"{number} {name}" if number == 1 else f"{number} {name}s"


@app.command()
def coco(
    folder: Frames,
    output: Annotated[
        Path,
        output_option("-o", "--output", help="JSON to write.", check=lambda path: check_output_file(path, (".json",))),
    ],
) -> None:
    """Write COCO detection JSON of the objects: boxes, masks, tracks, hidden share, range and contrast."""
    from thermorender.apps.export.labels import coco as run

    found = run(folder, output)
    typer.echo(f"{_counted(found['annotations'], 'annotation')} of {_counted(found['images'], 'image')} in {output}")


@app.command()
def masks(folder: Frames, output: NewResults) -> None:
    """Write masks of materials and objects as PNG, with a legend."""
    from thermorender.apps.export.labels import masks as run

    typer.echo(f"masks of {_counted(run(folder, output), 'frame')} in {output}")


@app.command()
def geotiff(
    folder: Frames,
    output: NewResults,
    float32: Annotated[bool, typer.Option("--float32", help="Write kelvin, not counts of 0.01 K as uint16.")] = False,
) -> None:
    """Write radiometric TIFFs with position and gimbal angles, such as OpenDroneMap reads; they are not maps."""
    from thermorender.apps.export.survey import geotiff as run

    typer.echo(f"{_counted(run(folder, output, float32), 'image')} in {output}")


@app.command()
def ground(
    folder: Frames,
    output: NewResults,
    metres: Annotated[float, typer.Option(help="Size of a pixel on the map [m].")],
) -> None:
    """Write a map of each frame: a GeoTIFF of apparent temperature [K] in the scene's CRS."""
    from thermorender.apps.export.survey import ground as run

    typer.echo(f"{_counted(run(folder, output, metres), 'map')} in {output}")
