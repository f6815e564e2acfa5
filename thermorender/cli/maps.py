"""The command line of learned maps of temperature; it parses, calls and prints."""

from pathlib import Path
from typing import Annotated

import typer

from thermorender.cli.terminal import output_option, progress


def translate(
    model: Annotated[str, typer.Argument(help="Learned map: fok-1to1, fok-9to1, or a file ending in .npz.")],
    images: Annotated[list[Path], typer.Argument(help="Pictures, videos (.mp4, .avi), or folders of them.")],
    output: Annotated[Path, output_option("-o", "--output", help="Folder for the results.")],
    texel_m: Annotated[
        float | None, typer.Option(help="Ground sampling distance of the images [m]. Default: the map's own.")
    ] = None,
    range_c: Annotated[str | None, typer.Option(help="COLD,WARM: °C of intensity 0 and 1 of the map.")] = None,
    palette: Annotated[str, typer.Option(help="white-hot, black-hot or ironbow.")] = "white-hot",
    inner: Annotated[
        bool, typer.Option("--inner", help="Leave out the border, as published, instead of repeating edge pixels.")
    ] = False,
    frames: Annotated[bool, typer.Option("--frames", help="Write the frames of videos too.")] = False,
    resume: Annotated[bool, typer.Option("--resume", help="Continue a stopped run.")] = False,
):
    """Translate photographs and videos into thermal ones by a learned map, with temperatures in kelvin."""
    from thermorender.learned.temperature_map import load_model
    from thermorender.learned.translate import translate as run
    from thermorender.trajectory import parse_numbers

    limits = parse_numbers("--range-c", range_c, ("COLD", "WARM")) if range_c else None
    with progress() as tell:
        summary = run(load_model(model, limits), images, output, texel_m, palette, inner, frames, resume, tell)
    if summary["warning"]:
        typer.echo(f"warning: {summary['warning']}", err=True)
    for sentence in summary["failed"].values():
        typer.echo(f"error: {sentence}", err=True)
    counted = [f"{summary['done']} translated"]
    counted += [f"{summary['passed over']} done before"] if summary["passed over"] else []
    counted += [f"{len(summary['failed'])} failed"] if summary["failed"] else []
    typer.echo(f"{', '.join(counted)}, in {output}")
    if summary["failed"]:
        raise typer.Exit(2)
