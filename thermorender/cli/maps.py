"""The command line of learned maps: data sets, training, translation and evaluation."""

from pathlib import Path
from typing import Annotated

import typer

from thermorender import defaults, files
from thermorender.cli.terminal import output_option, progress, split, table
from thermorender.errors import ThermorenderError


def dataset(
    output: Annotated[Path, output_option("-o", "--output", help="Folder of the data set.")],
    train: Annotated[int, typer.Option(help="Worlds to train on: a land under a weather each.", min=0)] = 60,
    validation: Annotated[int, typer.Option(help="Worlds for validation.", min=0)] = 6,
    test: Annotated[int, typer.Option(help="Worlds to test on, of other lands and weathers.", min=0)] = 12,
    kinds: Annotated[str, typer.Option(help="Comma-separated kinds of land.")] = ",".join(defaults.SCENES),
    hours: Annotated[int, typer.Option(help="Instants of each world's day.")] = 3,
    views: Annotated[int, typer.Option(help="Pairs of each instant, up to 10.")] = 9,
    seed: Annotated[int, typer.Option(help="Of lands, weathers and views.", min=0)] = 0,
    turn: Annotated[
        str, typer.Option(help="K,N: of N processes on one folder, this one takes every N-th world from number K on.")
    ] = "0,1",
    resume: Annotated[bool, typer.Option("--resume", help="Continue a data set.")] = False,
):
    """Render pairs of visible and thermal pictures of procedural lands, with the truth behind them."""
    from thermorender.campaign.rendered import render_campaign, worlds

    of = worlds(train, validation, test, seed, split(kinds))
    with progress() as tell:
        made = render_campaign(output, of, hours, views, resume=resume, progress=tell, turn=_turn(turn))
    counted = ", ".join(f"{len(made.of(part))} {part}" for part in ("train", "validation", "test"))
    typer.echo(f"{len(made)} pairs ({counted}) in {output}")


def _turn(text):
    """(k, n) of an option --turn."""
    parts = split(text)
    if len(parts) != 2 or not all(part.isdecimal() for part in parts) or not int(parts[0]) < int(parts[1]):
        raise ThermorenderError(f"--turn={text!r} is not allowed; give K,N with K from 0 to N − 1, such as 0,2")
    return int(parts[0]), int(parts[1])


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


def evaluate(
    models: Annotated[list[str], typer.Argument(help="Learned maps: names, or .npz files.")],
    dataset: Annotated[Path, typer.Option(help="Folder of the data set.")],
    output: Annotated[
        Path, output_option("-o", "--output", help="New folder for the results.", check=files.check_new_folder)
    ],
    oracle: Annotated[
        str | None, typer.Option(help="File of a map that is shown the material as well, as a lower limit.")
    ] = None,
    foreign: Annotated[
        list[str] | None,
        typer.Option(help="NAME=FOLDER: pictures that another program made, named by the pairs' keys; repeat."),
    ] = None,
    of: Annotated[Path | None, typer.Option("--split", help="File of a split in place of the data set's own.")] = None,
    part: Annotated[str, typer.Option(help="train, validation or test.")] = "test",
    limit: Annotated[int | None, typer.Option(help="Score so many pairs, evenly spaced.", min=1)] = None,
    seed: Annotated[int, typer.Option(help="Of the bootstrap.", min=0)] = 0,
):
    """Errors of learned maps on a data set, in kelvin, beside simple methods and the least error there is."""
    from thermorender.campaign.dataset import PARTS, read_dataset
    from thermorender.validate import evaluation as study
    from thermorender.validate.evaluation import report

    if part not in PARTS:
        raise ThermorenderError(f"--part={part!r} is unknown; give {', '.join(PARTS)}")
    folders = dict(_named(text) for text in foreign or ())
    parts = None
    if of is not None:
        from thermorender.campaign.splits import read_split

        parts = read_split(of)
    with progress() as tell:
        result = study.evaluate(read_dataset(dataset), models, output, oracle, folders, parts, part, limit, seed, tell)
    for line in report.lines_before(result):
        typer.echo(line)
    table(report.HEADER, [*report.rows(result), *report.published_rows()])
    typer.echo(report.CAVEAT)
    typer.echo(f"tables, numbers and pictures in {output}")


def _named(text):
    """(name, folder) of an option --foreign."""
    name, found, folder = text.partition("=")
    if not (name and found and folder):
        raise ThermorenderError(f"--foreign={text!r} is not allowed; give NAME=FOLDER")
    return name, folder
