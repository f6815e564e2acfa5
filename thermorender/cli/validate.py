"""Commands that compare the renderer with references: `thermorender validate …`."""

from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from thermorender import defaults, files, formats
from thermorender.cli.camera import Base, Frames, Scale, parse_scale
from thermorender.cli.terminal import Time, at_time, output_option, progress, split, table
from thermorender.cli.terminal import air as parse_air
from thermorender.errors import ThermorenderError

app = typer.Typer(invoke_without_command=True)

Out = Annotated[Path, output_option("-o", "--output", help="Folder for the results.")]
Device = Annotated[str, typer.Option(help="auto, cpu or cuda.")]


@app.callback()
def validate(
    context: typer.Context,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Folder of all results; what it holds is not run again.")
    ] = Path("validation"),
    data: Annotated[Path | None, typer.Option(help="Folder of measured tables, for heat.")] = None,
    dataset: Annotated[Path | None, typer.Option(help="Folder of a data set, for maps.")] = None,
):
    """Compare the renderer with references: one study, or without a command all of them, on one page of verdicts."""
    if context.invoked_subcommand:
        # One study has a folder of its own, and this one need not be writable.
        return
    files.check_output_folder(output)
    from thermorender.validate.page import HEADER, PAGE, rows, write_page
    from thermorender.validate.verdicts import gathered

    runs = {
        "stability": validate_stability, "convergence": convergence, "budget": validate_budget, "air": validate_air,
        "sensor": validate_sensor, "moved": validate_moved, "growth": validate_growth,
        "closed-loop": validate_closed_loop,
    }  # fmt: skip
    # A study without what it needs is left out, and the page says so.
    runs |= {"heat": partial(validate_heat, data)} if data else {}
    runs |= {"maps": partial(validate_maps, dataset)} if dataset else {}
    failed = []
    for study, verdicts, _ in gathered(output):
        if study.name in runs and (verdicts is None or study.goes_on):
            typer.echo(f"{study.name}: {study.title}")
            # Stability ends with a status where a case fails; the others run all the same.
            with suppress(typer.Exit):
                try:
                    runs[study.name](output=output / Path(study.result).parent)
                except ThermorenderError as error:
                    failed.append(f"{study.name}: {error}")
    told = write_page(output)
    table(HEADER, rows(told))
    typer.echo(f"page in {output / PAGE}")
    for sentence in failed:
        typer.echo(sentence, err=True)
    if failed or not all(each.holds for _, verdicts, _ in told for each in verdicts or ()):
        raise typer.Exit(1)


@app.command()
def convergence(
    scenes: Annotated[list[str] | None, typer.Argument(help=f"Scenes; default: {' '.join(defaults.SCENES)}.")] = None,
    output: Out = Path("validation"),
    quick: Annotated[bool, typer.Option("--quick", help="Minutes instead of an hour.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Measure anew what is there.")] = False,
    time: Time = None,
    device: Device = "auto",
):
    """Error against run time, beside stock Mitsuba, against the path-traced reference."""
    from thermorender.validate.convergence import convergence as run

    with progress() as tell, _alone(output):
        loaded = [at_time(name, time) for name in scenes or defaults.SCENES]
        run(loaded, output, tell, "quick" if quick else "full", overwrite, device)
    typer.echo(f"table, numbers and figures in {output}")


@app.command("emissivity")
def validate_emissivity(
    output: Out = Path("out/validation"),
    model: Annotated[str, typer.Option(help="Emissivity map: a file, or procedural.")] = "procedural",
    seeds: Annotated[str, typer.Option(help="Comma-separated seeds of procedural scenes not trained on.")] = "201,202",
):
    """Errors of a learned emissivity map on procedural scenes, beside simpler methods."""
    from thermorender.validate.learned import emissivity as study

    numbers = _seeds(seeds)
    with progress() as tell, files.output_folder(output) as folder:
        result = study.evaluate(model, numbers, progress=tell)
        formats.write_json(folder / "emissivity.json", result)
        study.write_confusion(result, folder / "emissivity_confusion.csv")
    table(study.HEADER, study.rows(result))
    typer.echo(f"numbers and confusion table in {output}")


@app.command("maps")
def validate_maps(
    dataset: Annotated[Path, typer.Option(help="Folder of a data set with parts to train and to test on.")],
    output: Out = Path("out/validation"),
    methods: Annotated[
        str | None, typer.Option(help="Comma-separated, as of `train`; default: correlations, palette, and "
                                 "correlation+ where the data set tells relief and weather.")
    ] = None,
    vary: Annotated[
        str | None, typer.Option(help="Comma-separated: share, of sequences; shift_px, of thermal pictures; kind, of "
                                 "land that is left out. Default: all that the data set allows.")
    ] = None,
    limit: Annotated[int, typer.Option(help="Test pairs that are scored, evenly spaced.", min=1)] = 60,
    seed: Annotated[int, typer.Option(help="Of training and shifts.", min=0)] = 0,
):  # fmt: skip
    """Errors of learned temperature maps against what they were trained on: how much, how aligned, which land."""
    from thermorender.campaign.dataset import read_dataset
    from thermorender.validate.figures.evaluation import against_share, against_shift
    from thermorender.validate.learned import maps as study

    with progress() as tell, files.output_folder(output) as folder:
        names = split(methods) if methods else None
        result = study.run(read_dataset(dataset), names, split(vary) if vary else None, limit, seed, tell)
        formats.write_json(folder / "maps.json", result)
        for varied, draw in (("share", against_share), ("shift_px", against_shift)):
            curves = {}
            for case in result["cases"]:
                if case["varied"] == varied:
                    curves.setdefault(case["method"], []).append((case["value"], case["mae_k"]))
            if curves:
                draw(folder / f"maps_{varied}.png", curves)
    table(study.HEADER, study.rows(result))
    typer.echo(f"numbers and figures in {output}")


@app.command("trainings")
def validate_trainings(
    runs: Annotated[list[Path], typer.Argument(help="Folders that `train --run` wrote.")],
    output: Out = Path("out/validation"),
):
    """Trainings of networks beside each other: validation error against what each has cost, and strips of epochs."""
    from thermorender.validate.figures.trainings import write
    from thermorender.validate.learned import trainings as study

    result = study.run(runs)
    with files.output_folder(output) as folder:
        formats.write_json(folder / "trainings.json", result)
        write(folder, result, runs)
    table(study.HEADER, study.rows(result))
    for line in study.sentences(result):
        typer.echo(line)
    typer.echo(f"numbers and figures in {output}")


@app.command("translation")
def validate_translation(
    models: Annotated[list[str], typer.Argument(help="Learned maps: names, or .npz files.")],
    dataset: Annotated[Path, typer.Option(help="Folder of a data set with a part to test on.")],
    output: Out = Path("out/validation"),
    scene: Annotated[str, typer.Option(help="Its orthophoto is translated, too.")] = defaults.SCENE,
    pictures: Annotated[int, typer.Option(help="Of the test part.", min=1)] = 6,
):
    """What translating a picture costs with each learned map, and how far its tiles disagree where they meet."""
    from thermorender.validate.learned import translation as study

    with progress() as tell, files.output_folder(output) as folder:
        result = study.run(models, dataset, scene, pictures, tell)
        formats.write_json(folder / "translation.json", result)
    table(study.HEADER, study.rows(result))
    typer.echo(f"numbers in {output}")


@app.command("air")
def validate_air(
    scene: Annotated[str, typer.Argument(help="Scene folder, or the name of a shipped one.")] = defaults.SCENE,
    output: Out = Path("out/validation"),
    air: Annotated[str, typer.Option(help="Standard atmosphere and aerosol.")] = "midlatitude-summer,rural-23km",
    time: Time = None,
    device: Device = "auto",
):
    """What air costs a frame, and what its spectral channels leave wrong."""
    from thermorender.validate import air as study
    from thermorender.validate.figures.air import figure

    with progress() as tell, files.output_folder(output) as folder:
        result = study.run(at_time(scene, time), parse_air(air), device=device, progress=tell)
        formats.write_json(folder / "air.json", result)
        figure(folder / "air.png", result)
    table(study.HEADER, study.rows(result))
    typer.echo(f"numbers and figure in {output}")


@app.command("moved")
def validate_moved(
    output: Out = Path("out/validation"),
    seeds: Annotated[str, typer.Option(help="Comma-separated seeds of procedural scenes.")] = "301",
    device: Device = "auto",
):
    """Errors of maps moved to another hour and weather, beside the map unmoved, offset, and the heat balance alone."""
    from thermorender.validate import moved as study
    from thermorender.validate.figures.moved import figure

    with progress() as tell, files.output_folder(output) as folder:
        result = study.run(seeds=_seeds(seeds), progress=tell, device=device)
        formats.write_json(folder / "moved.json", result)
        figure(folder / "moved.png", result)
    table(study.HEADER, study.rows(result))
    typer.echo(f"numbers and figure in {output}")


@app.command("growth")
def validate_growth(output: Out = Path("out/validation"), device: Device = "auto"):
    """How time and memory grow with triangles, texels and spectral nodes; continues where it was stopped."""
    from thermorender.validate import growth as study

    with progress() as tell, _alone(output):
        cases = study.run(output, progress=tell, device=device)
    table(study.HEADER, study.rows(cases))
    typer.echo(f"numbers and figure in {output}")


@app.command("budget")
def validate_budget(
    output: Out = Path("out/validation"),
    drawn: Annotated[int, typer.Option(min=0, help="Views to draw between 20 m and 20 km, 10° and 90°.")] = 105,
    seed: Annotated[int, typer.Option(min=0, help="Of the drawn views and of the made scenes.")] = 0,
    device: Device = "auto",
):
    """What frames state of their sampling error, held against 256 rays per pixel; continues where it was stopped."""
    from thermorender.validate.budget import study

    with progress() as tell, _alone(output):
        cases = study.run(output, drawn=drawn, seed=seed, progress=tell, device=device)
    table(study.HEADER, study.rows(cases))
    told = study.summary(cases)
    if told["views"]:
        typer.echo(
            f"of {told['views']} drawn views {told['covered']:.0%} err by no more than is stated; in the median "
            f"{told['median']:.2f} times the error is stated"
        )
    typer.echo(f"numbers and figure in {output}")


@app.command("footage")
def validate_footage(
    frames: Frames,
    output: Out = Path("out/validation"),
    base: Base = defaults.CAMERA,
    scale: Scale = None,
    scene: Annotated[str, typer.Option(help="Scene the simulated frames show.")] = defaults.SCENE,
    name: Annotated[str, typer.Option(help="Of the files to write.")] = "footage",
    device: Device = "auto",
):
    """Power spectra and noise of simulated frames beside those of real ones."""
    from thermorender.validate import sensor_statistics as study

    with progress() as tell, files.output_folder(output) as folder:
        result = study.compare(frames, folder, base, parse_scale(scale), scene, name, progress=tell, device=device)
    table(study.HEADER, study.rows(result))
    typer.echo(f"numbers, figure and fitted camera in {output}")


@app.command("sensor")
def validate_sensor(
    scene: Annotated[str, typer.Argument(help="Scene folder, or the name of a shipped one.")] = defaults.SCENE,
    output: Out = Path("out/validation"),
    time: Time = None,
    device: Device = "auto",
):
    """Errors of lag and blur against run time, and what the whole chain costs."""
    from thermorender.validate.sensor import sensor as run

    with progress() as tell:
        run(output, at_time(scene, time), device=device, progress=tell)
    typer.echo(f"table, numbers and figures in {output}")


@app.command("heat")
def validate_heat(
    data: Annotated[Path, typer.Option(help="Folder with the measured tables that the sites name.")],
    sites: Annotated[Path | None, typer.Option(help="File of sites; default: the shipped one.")] = None,
    output: Out = Path("out/validation"),
):
    """The heat balance against measured surface temperatures, beside simpler methods, and error against run time."""
    from thermorender.paths import data_folder
    from thermorender.validate import heat as study
    from thermorender.validate.figures.heat import figure

    with progress() as tell, files.output_folder(output) as folder:
        result = study.run(sites or data_folder("validation") / study.SITES, data, progress=tell)
        if not result["sites"]:
            raise ThermorenderError(f"--data={data} holds no table of the sites; give the folder that does")
        figure(folder / "heat.png", result)
        study.page(folder / "heat.md", result)
        formats.write_json(
            folder / "heat.json",
            result | {"sites": {n: {k: v for k, v in s.items() if k != "series"} for n, s in result["sites"].items()}},
        )
    table(study.HEADER, study.rows(result))
    typer.echo(f"table, numbers and figure in {output}")


@app.command("closed-loop")
def validate_closed_loop(
    output: Annotated[
        Path, output_option("-o", "--output", help="Folder for the results; runs that it holds are not flown again.")
    ] = Path("out/closed_loop"),
    models: Annotated[
        str, typer.Option(help="Comma-separated learned maps that see colour only: names, or .npz files.")
    ] = ",".join(reversed(defaults.TEMPERATURE_MAPS)),
    runs: Annotated[int, typer.Option(help="Landings with each kind of frames.", min=1)] = 104,
    quality: Annotated[str, typer.Option(help="fast, standard or high: how finely a pixel is sampled.")] = "fast",
    device: Device = "auto",
):
    """Landings on a heated marker by image-based control, the renderer in the loop: rendered and translated frames."""
    from thermorender.validate.closed_loop import run as study
    from thermorender.validate.figures.closed_loop import figure

    with progress() as tell, _alone(output):
        found = study.fly(output, split(models), runs, tell, quality=quality, device=device)
    told = study.write(found, output)
    figure(output / "closed_loop.png", found)
    table(study.HEADER, study.rows(told))
    typer.echo(f"runs, numbers and figure in {output}")


@app.command("stability")
def validate_stability(
    groups: Annotated[
        list[str] | None, typer.Argument(help="Some groups, such as air, faults, heat, precision; default: all.")
    ] = None,
    output: Out = Path("out/validation"),
    fuzz: Annotated[int, typer.Option(min=0, help="Instead: so many damaged files for each reader.")] = 0,
    seed: Annotated[int, typer.Option(min=0, help="Of the damage.")] = 0,
):
    """Cases at the edge, each with expected value, tolerance in kelvin and verdict; status 1 where one fails."""
    from thermorender.validate import stability as study

    if fuzz:
        _fuzzed(groups or (), output, fuzz, seed)
        return
    with progress() as tell, files.output_folder(output) as folder:
        result = study.run(groups or (), progress=tell)
        formats.write_json(folder / "stability.json", result)
        study.table(folder / "stability.md", result)
    table(study.HEADER, study.rows(result))
    typer.echo(f"{result['failed']} of {len(result['cases'])} cases fail; numbers and table in {output}")
    if result["failed"]:
        raise typer.Exit(1)


def _alone(folder):
    """Keep other processes out of a folder of results that is continued."""
    return files.in_use(files.make_folder(folder))


def _fuzzed(readers, output, count, seed):
    """Feed readers with damaged files; status 1 where one did not refuse or accept as it must."""
    from thermorender.validate import fuzz

    with progress() as tell, files.output_folder(output) as folder:
        counts, faults = fuzz.run(count, readers, seed, progress=tell)
        told = {"seed": seed, "counts": {name: dict(of) for name, of in counts.items()}}
        formats.write_json(folder / "fuzz.json", told | {"faults": [vars(fault) for fault in faults]})
    table(fuzz.HEADER, fuzz.rows(counts))
    typer.echo(f"{len(faults)} faults; counts and each fault in {output / 'fuzz.json'}")
    if faults:
        raise typer.Exit(1)


def _seeds(text):
    """The whole numbers of an option --seeds."""
    if not all(part.isdigit() for part in split(text)) or not split(text):
        raise ThermorenderError(f"--seeds={text!r} is not allowed; give whole numbers such as 201,202")
    return [int(part) for part in split(text)]
