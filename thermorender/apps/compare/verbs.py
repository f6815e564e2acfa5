"""Verbs that compare: translation with the render, maps with a data set, a frame with the cost of its rays."""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

import typer

from thermorender import defaults, files, formats
from thermorender.cli.options import (
    SCENE_NAMES,
    Air,
    Device,
    SamplingOptions,
    SceneOptions,
    Seed,
    TrajectoryOptions,
    flat,
    parse_air,
)
from thermorender.cli.terminal import NewResults, Results, Time, at_time, named, output_option, progress, split, table
from thermorender.cli.workers import Cluster, spread_over
from thermorender.errors import ThermorenderError
from thermorender.numbers import parse_numbers


@flat
def compare(
    scenes: Annotated[
        list[str], typer.Argument(help=f"Scene folders, or names of shipped ones: {SCENE_NAMES}. Scenes of the same "
                                  "hour and weather are training data for each other's refitted bounds.")
    ],
    output: NewResults,
    *,
    models: Annotated[str, typer.Option(help="Comma-separated learned maps: names, or .npz files.")] = ",".join(
        defaults.TEMPERATURE_MAPS
    ),
    privileged: Annotated[
        str | None, typer.Option(help="A map (.npz) that takes the true material as extra input.",
                                 rich_help_panel="maps and files")
    ] = None,
    foreign: Annotated[
        list[str] | None,
        typer.Option(help="NAME=FOLDER with another program's frames, pose_0000.tif and so on, TIFFs that declare "
                     "their unit; for several scenes in folders of the scenes' names. Repeat for more."),
    ] = None,
    run_time: Annotated[
        list[str] | None,
        typer.Option(help="NAME=MS: your own run time of a frame, of another program or of a map on the photograph. "
                     "Repeat for more.", rich_help_panel="maps and files"),
    ] = None,
    dataset: Annotated[
        list[Path] | None,
        typer.Option(help="Data set that maps were trained on: the scenes are searched in it. Repeat for more.",
                     rich_help_panel="maps and files"),
    ] = None,
    methods: Annotated[
        str, typer.Option(help="Comma-separated: maps on the photograph, or as kelvin with true or learned materials; "
                          "means; the heat balance.")
    ] = "photograph,true-materials,learned-materials,constant,per-material,frame-mean,balance",
    emissivity: Annotated[
        str, typer.Option(help="Emissivity map of the learned materials.", rich_help_panel="maps and files")
    ] = defaults.EMISSIVITY_MAP,
    log: TrajectoryOptions,
    rate_hz: Annotated[float, typer.Option(help="Poses per second of flight.")] = 1.0,
    arrays: Annotated[
        bool, typer.Option("--arrays", help="Keep the frames as .npz, apparent temperature.",
                           rich_help_panel="maps and files")
    ] = False,
    situation: SceneOptions,
    seed: Seed = 0,
    sampling: SamplingOptions,
    device: Device = "auto",
    cluster: Cluster = None,
) -> None:  # fmt: skip
    """Compare learned 2D translation with the radiometric render of the same poses: a page, a table, pictures."""
    from thermorender.apps.compare import comparison, findings, report
    from thermorender.apps.compare.methods import check_kinds, learned_materials
    from thermorender.apps.compare.view import Flight
    from thermorender.apps.training.dataset import read_dataset

    kinds = split(methods)
    check_kinds(kinds or [""])
    folders = dict(named(text, "--foreign", "NAME=FOLDER") for text in foreign or ())
    with progress() as advance, spread_over(cluster, output) as spread:
        flights = []
        for name in scenes:
            loaded = situation.load(name)
            flights.append(Flight.of(loaded, log.read(loaded, rate_hz), rate_hz, log.start_s, log.stop_s))
        options = comparison.Options(
            kinds, privileged, folders, _times_s(run_time or ()), [read_dataset(one) for one in dataset or ()],
            learned_materials(emissivity), arrays, seed, {"device": device, **sampling.settings()},
        )  # fmt: skip
        summary = comparison.compare(flights, output, split(models), options, advance, spread)
    for each in report.terminal(summary):
        table(each.head, each.rows)
    for line in report.unconverged(summary):
        typer.echo(line)
    unexplained = findings.headline(summary)
    for line in unexplained[:3]:
        typer.echo(line)
    if len(unexplained) > 3:
        typer.echo(f"and {len(unexplained) - 3} more in report.html")
    for title, grave, lines in findings.grouped(summary["findings"]):
        typer.echo(f"{title}:")
        for line in lines if grave else lines[:3]:
            typer.echo(f"  {line}")
        if not grave and len(lines) > 3:
            typer.echo(f"  and {len(lines) - 3} more in report.html")
    typer.echo(f"report.html, pixels.csv, comparison.json and pictures in {output}")


def _times_s(given: Iterable[str]) -> dict[str, float]:
    """Return {name: seconds} of NAME=MS."""
    found = {}
    for text in given:
        name, value = named(text, "--run-time", "NAME=MS")
        (milliseconds,) = parse_numbers("--run-time", value, ("MS",))
        if not milliseconds > 0.0:
            raise ThermorenderError(f"--run-time={text!r} is not allowed; give a time above 0 ms")
        found[name] = 1e-3 * milliseconds
    return found


def bench(
    scenes: Annotated[list[str] | None, typer.Argument(help=f"Scenes; default: {defaults.SCENE}.")] = None,
    repeats: Annotated[int, typer.Option(help="Turns of each measurement.")] = 15,
    output: Annotated[
        Path | None, output_option("-o", "--output", help="JSON file for the result.", check=files.check_output_file)
    ] = None,
    air: Air = None,
    time: Time = None,
    device: Device = "auto",
) -> None:
    """Measure frames per second, their ratio to casting the rays alone, and the error of each quality."""
    from thermorender.apps.compare import bench as run

    with progress() as report:
        loaded = [at_time(name, time) for name in scenes or (defaults.SCENE,)]
        result = run.bench(loaded, repeats, report, device=device, air=None if air is None else parse_air(air))
    table(run.HEADER, run.rows(result))
    for line in run.costs(result):
        typer.echo(line)
    if output:
        formats.write_json(output, result)


def evaluate(
    models: Annotated[list[str], typer.Argument(help="Learned maps: names, or .npz files.")],
    dataset: Annotated[Path, typer.Option(help="Folder of the data set.")],
    output: Annotated[
        Path, output_option("-o", "--output", help="New folder for the results.", check=files.check_new_folder)
    ],
    privileged: Annotated[
        str | None,
        typer.Option(help="File of a map that takes the true material as extra input. Its error is not a lower limit."),
    ] = None,
    foreign: Annotated[
        list[str] | None,
        typer.Option(help="NAME=FOLDER: pictures of another program, named by the pairs' keys; repeat."),
    ] = None,
    of: Annotated[Path | None, typer.Option("--split", help="File of a split in place of the data set's own.")] = None,
    part: Annotated[str, typer.Option(help="train, validation or test.")] = "test",
    limit: Annotated[int | None, typer.Option(help="Number of pairs to score, evenly spaced.", min=1)] = None,
    seed: Annotated[int, typer.Option(help="Seed of the bootstrap.", min=0)] = 0,
    leaks: Annotated[
        bool, typer.Option("--leaks/--no-leaks", help="Search the pictures for those of training; kept for later runs.")
    ] = True,
    cluster: Cluster = None,
) -> None:
    """Print errors of learned maps on a data set, in kelvin, with simple methods and the least possible error."""
    from thermorender.apps.compare import evaluation, evaluation_report
    from thermorender.apps.training.dataset import PARTS, read_dataset

    if part not in PARTS:
        raise ThermorenderError(f"--part={part!r} is unknown; give {', '.join(PARTS)}")
    folders = dict(named(text, "--foreign", "NAME=FOLDER") for text in foreign or ())
    parts = None
    if of is not None:
        from thermorender.apps.training.splits import read_split

        parts = read_split(of)
    with progress() as advance, spread_over(cluster, output) as spread:
        data = read_dataset(dataset)
        result = evaluation.evaluate(
            data, models, output, privileged, folders, parts, part, limit, seed, advance, spread, leaks
        )
    for line in evaluation_report.lines_before(result):
        typer.echo(line)
    scores, structure = evaluation_report.methods(result), evaluation_report.structures(result)
    table(scores.head, scores.rows)
    typer.echo(evaluation_report.CAVEAT)
    table(structure.head, structure.rows)
    typer.echo(evaluation_report.ABOUT_STRUCTURE)
    typer.echo(f"tables, numbers and pictures in {output}")


def demo(output: Results = Path("out/demo"), device: Device = "auto") -> None:
    """Run the main job on the shipped village: a flight along its street, and the comparison of two learned maps."""
    from thermorender.cli.render import fly

    if (output / "flight" / "flight.json").exists():
        raise ThermorenderError(f"{output} already holds a demo; give another folder with -o, or remove it")
    fly(defaults.SCENE, output / "flight", rate_hz=4.0, device=device)
    compare(
        [defaults.SCENE],
        output / "comparison",
        methods="photograph,true-materials,frame-mean",
        rate_hz=0.2,
        device=device,
    )
    typer.echo(f"look at {output / 'flight' / 'flight.mp4'} and at {output / 'comparison' / 'report.html'}")
