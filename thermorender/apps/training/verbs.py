"""Verbs of learned maps: data sets, training, translation and evaluation."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from thermorender import defaults, files
from thermorender.apps.training.cut import Cut
from thermorender.cli.options import flat
from thermorender.cli.terminal import named, output_option, progress, split, table, warn
from thermorender.cli.workers import Cluster
from thermorender.errors import ThermorenderError
from thermorender.learned.networks.recipes import RECIPES
from thermorender.numbers import parse_numbers, parse_scale

if TYPE_CHECKING:
    from thermorender.learned.temperature_map import TemperatureMap

MAPS = ", ".join((*defaults.TEMPERATURE_MAPS, *defaults.TRAINED_MAPS))


@flat
def prepare(
    *,
    visible_folder: Annotated[Path, typer.Argument(help="Folder of visible pictures.")],
    thermal_folder: Annotated[Path, typer.Argument(help="Folder of thermal pictures; may be the same.")],
    output: Annotated[Path, output_option("-o", "--output", help="Folder for the data set.")],
    visible: Annotated[
        str, typer.Option(help="Names of visible pictures, e.g. '*_rgb.jpg'; the part matched by * names the pair.")
    ] = "*",
    thermal: Annotated[str, typer.Option(help="Names of thermal pictures, e.g. '*_thermal.tif'.")] = "*",
    valid: Annotated[
        str | None, typer.Option(help="Names of masks in the visible folder, not 0 where both show the same scene.")
    ] = None,
    scale: Annotated[
        str | None, typer.Option(help="STEP,ZERO of files without a scale: kelvin per count, of count 0.")
    ] = None,
    rig: Annotated[Path | None, typer.Option(help="Register visible pictures by this rig.json.")] = None,
    calibrate: Annotated[
        bool, typer.Option("--calibrate", help="Estimate the rig from the pictures, and save it.")
    ] = False,
    fields_of_view: Annotated[
        str | None,
        typer.Option(help="VISIBLE_H,VISIBLE_V,THERMAL_H,THERMAL_V [deg]: start of --calibrate, e.g. "
                     "57.12,42.44,45,37."),
    ] = None,
    resized: Annotated[
        bool, typer.Option("--resized", help="Visible pictures were resized with different factors along their sides: "
                           "--calibrate estimates the ratio too."),
    ] = False,
    cut: Cut,
    split: Annotated[
        str, typer.Option(help="sequence, place or crop: unit that is kept together; train, validation or test: the "
                          "part of all pairs; or a file of a split, .json or .csv.")
    ] = "sequence",
    sequence: Annotated[
        str | None, typer.Option(help="Regular expression whose group is a name's sequence; default: the name without "
                                 "its last digits."),
    ] = None,
    gap: Annotated[
        int | None, typer.Option(help="A larger step of the numbers in names starts a new sequence.")
    ] = None,
    texel_m: Annotated[
        float | None, typer.Option(help="Ground sampling distance of the thermal pictures [m].")
    ] = None,
    range_c: Annotated[
        str | None, typer.Option(help="COLD,WARM: °C of the bounds of values without a scale; default 14,24.")
    ] = None,
    licence: Annotated[str | None, typer.Option(help="Licence of the pictures, for the card.")] = None,
    skip_bad: Annotated[bool, typer.Option("--skip-bad", help="Leave out unusable pictures, and list them.")] = False,
    resume: Annotated[bool, typer.Option("--resume", help="Continue a stopped data set.")] = False,
) -> None:  # fmt: skip
    """Make a data set from folders of visible and thermal pictures: registered, cut, split and scaled."""
    from thermorender.apps.training.prepare import Source
    from thermorender.apps.training.prepare import prepare as run

    warm = parse_numbers("--range-c", range_c, ("COLD", "WARM")) if range_c else None
    source = Source(visible_folder, thermal_folder, visible, thermal, valid, parse_scale(scale), sequence, gap,
                    warm is not None)  # fmt: skip
    with progress() as report:
        made = run(
            source, output, _registered(rig, calibrate, fields_of_view, resized), cut, split, texel_m=texel_m,
            range_c=warm, licence=licence, skip_bad=skip_bad, resume=resume, progress=report,
        )  # fmt: skip
    for name, reason in made["left_out"].items():
        typer.echo(f"left out: {name}: {reason}", err=True)
    if made["turned"]:
        typer.echo(f"warning: visible and thermal picture of {made['turned']} pairs state different orientations "
                   "(EXIF); each is turned as its own tag says, as viewers do: look at a pair, and set the tag to 1 "
                   "with `exiftool -n -Orientation=1` where the stored pixels fit", err=True)  # fmt: skip
    if made["grey"]:
        typer.echo(f"warning: {made['grey']} of {made['pairs']} visible pictures are grey, so that fits are "
                   "rank-deficient: train with --set penalty=1e-6, or take pictures in colour", err=True)  # fmt: skip
    if made["rig"] is not None:
        typer.echo(str(made["rig"]))
    bounds = made["bounds"]
    outside = bounds.share_below + bounds.share_above
    typer.echo(f"{made['scale'].unit}: bounds {bounds.low:g} and {bounds.high:g}, {outside:.2%} of the values outside")
    table(("part", "pairs"), list(made["parts"].items()))
    for line in made["audit"].lines() if made["audit"] else ():
        typer.echo(line)
    typer.echo(
        f"{made['entries']} pairs of {made['pairs']} pairs of pictures in {made['sequences']} sequences, in {output}"
    )


def _registered(file: Path | None, calibrate: bool, fields_of_view: str | None, resized: bool) -> Any:
    """The Rig of a file, a Calibration, or None."""
    from thermorender.apps.training.prepare import Calibration
    from thermorender.apps.training.registration.rig import load_rig

    if not calibrate and (fields_of_view or resized):
        raise ThermorenderError("--fields-of-view and --resized are settings of --calibrate; add --calibrate")
    if file is not None and calibrate:
        raise ThermorenderError(f"--rig {file} and --calibrate exclude each other; give one of them")
    if not calibrate:
        return load_rig(file) if file is not None else None
    fields = None
    if fields_of_view:
        angles = parse_numbers("--fields-of-view", fields_of_view, ("VISIBLE_H", "VISIBLE_V", "THERMAL_H", "THERMAL_V"))
        if not all(0.0 < angle < 180.0 for angle in angles):
            raise ThermorenderError(f"--fields-of-view={fields_of_view!r} is not allowed; give degrees in 0…180")
        fields = (tuple(angles[:2]), tuple(angles[2:]))
    return Calibration(fields, resized)


def dataset(
    output: Annotated[Path, output_option("-o", "--output", help="Folder of the data set.")],
    train: Annotated[int, typer.Option(help="Worlds to train on, each a land with a weather.", min=0)] = 60,
    validation: Annotated[int, typer.Option(help="Worlds for validation.", min=0)] = 6,
    test: Annotated[int, typer.Option(help="Worlds to test on, with other lands and weathers.", min=0)] = 12,
    kinds: Annotated[str, typer.Option(help="Comma-separated kinds of land.")] = ",".join(defaults.SCENES),
    hours: Annotated[int, typer.Option(help="Instants of each world's day.")] = 3,
    views: Annotated[int, typer.Option(help="Pairs of each instant, up to 10.")] = 9,
    seed: Annotated[int, typer.Option(help="Seed of lands, weathers and views.", min=0)] = 0,
    turn: Annotated[
        str, typer.Option(help="K,N: of N processes on one folder, this one takes every N-th world from number K on.")
    ] = "0,1",
    cluster: Cluster = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue a stopped data set.")] = False,
) -> None:
    """Render pairs of visible and thermal pictures of procedural lands, with their truth."""
    from thermorender.apps.training.rendered import render_campaign, worlds

    of = worlds(train, validation, test, seed, split(kinds))
    if cluster and turn != "0,1":
        raise ThermorenderError("--turn and --cluster both divide the data set; give one of them")
    with progress() as report:
        if cluster:
            from thermorender.apps.cluster.connect import parse_cluster
            from thermorender.apps.training.on_workers import render_campaign_by

            made = render_campaign_by(
                output, of, hours, views, parse_cluster(cluster), resume=resume, progress=report,
                report=lambda line: typer.echo(line, err=True),
            )  # fmt: skip
        else:
            made = render_campaign(output, of, hours, views, resume=resume, progress=report, turn=_turn(turn))
    counted = ", ".join(f"{len(made.of(part))} {part}" for part in ("train", "validation", "test"))
    typer.echo(f"{len(made)} pairs ({counted}) in {output}")


def _turn(text: str) -> tuple[int, int]:
    """(k, n) of an option --turn."""
    parts = split(text)
    if len(parts) != 2 or not all(part.isdecimal() for part in parts) or not int(parts[0]) < int(parts[1]):
        raise ThermorenderError(f"--turn={text!r} is not allowed; give K,N with K from 0 to N − 1, such as 0,2")
    return int(parts[0]), int(parts[1])


def train(
    method: Annotated[
        str,
        typer.Argument(help="emissivity, or one of correlation-1to1, correlation-9to1, correlation-NxN, palette, "
                       "trees, correlation+, trees+; networks: " + ", ".join(RECIPES) + "."),
    ],
    sources: Annotated[
        list[str] | None,
        typer.Argument(help="A data set; for emissivity, scenes with orthophoto and class raster, or none: procedural "
                       "scenes of every kind."),
    ] = None,
    output: Annotated[
        Path,
        output_option("-o", "--output", help="File for the map, .npz.",
                      check=lambda path: files.check_output_file(path, (".npz",))),
    ] = Path("map.npz"),
    of: Annotated[Path | None, typer.Option("--split", help="File of a split in place of the data set's own.")] = None,
    setting: Annotated[
        list[str] | None,
        typer.Option("--set", help="OPTION=VALUE of the method, such as intercept=true or penalty=1e-6; repeat."),
    ] = None,
    privileged: Annotated[
        bool, typer.Option("--privileged", help="Add the true material of each pixel as input: for evaluate and "
                           "compare --privileged only.")
    ] = False,
    labels: Annotated[
        Path | None, typer.Option(help="Emissivity: GeoJSON polygons with a property 'material', in place of the "
                                  "classes of a scene."),
    ] = None,
    base: Annotated[
        str | None, typer.Option("--from", help="Emissivity: map to update with the labels of one scene.")
    ] = None,
    texel_m: Annotated[
        float | None, typer.Option(help="Emissivity: ground sampling distance to train at [m].")
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the training.", min=0)] = 0,
    run: Annotated[
        Path | None,
        typer.Option("--run", help="Networks: folder for checkpoints, log and sample pictures; default: the map's "
                     "file with .run for .npz."),
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Networks: continue the training of that folder.")] = False,
    best: Annotated[
        bool, typer.Option("--best", help="Networks: write the map of the best state so far in that folder, without "
                           "training on; a training there may go on.")
    ] = False,
) -> None:  # fmt: skip
    """Train a learned map: from colour to temperature on a data set, or to materials on scenes."""
    if method == "emissivity":
        if of or setting or privileged or run or resume or best:
            raise ThermorenderError(
                "--split, --set, --privileged, --run, --resume and --best belong to maps of temperature; leave them out"
            )
        if base is not None:
            _update_emissivity(sources, output, labels, base, seed, texel_m is None)
            return
        _train_emissivity(sources, output, labels, texel_m, seed)
        return
    if (labels, base, texel_m) != (None,) * 3:
        raise ThermorenderError(
            f"--labels, --from and --texel-m belong to `train emissivity`, not to {method!r}; leave them out"
        )
    _train_temperature(method, sources or [], output, of, setting or [], privileged, seed, run, resume, best)


def _train_temperature(
    method: str, sources: list[str], output: Path, of: Path | None, setting: list[str], privileged: bool, seed: int,
    run: Path | None, resume: bool, best: bool,
) -> None:  # fmt: skip
    """Train a map from colour to temperature, and print its error."""
    from thermorender.apps.training.audit import memory_of
    from thermorender.apps.training.dataset import read_dataset
    from thermorender.apps.training.map_training import held_out, train_map
    from thermorender.apps.training.splits import read_split
    from thermorender.apps.training.training_methods import method as known
    from thermorender.learned.temperature_map import save_map

    if not known(method).long and (run or resume or best):
        raise ThermorenderError(
            f"--run, --resume and --best belong to networks, and {method!r} is not one; leave them out"
        )
    if resume and best:
        raise ThermorenderError("--resume trains on and --best does not; give one of them")
    if len(sources) != 1:
        raise ThermorenderError(f"train {method} was given {len(sources)} data sets; give one")
    pairs = read_dataset(sources[0])
    if of is not None:
        pairs = pairs.split(read_split(of))
    options = dict(named(text, "--set", "OPTION=VALUE") for text in setting)
    with progress() as report:
        folder = (run or output.with_suffix(".run")) if known(method).long else None
        model = train_map(
            output.stem, method, pairs, options, seed, report, material=privileged, run=folder, resume=resume,
            best=best,
        )  # fmt: skip
        # Only one process of a data-parallel training writes.
        if os.environ.get("RANK", "0") != "0":
            return
        save_map(model, output)
        tests = held_out(pairs, pairs.of("train", "validation"), known(method).long)
        memory = memory_of(tests, report) if model.error_k is not None else None
    typer.echo(str(model))
    training = model.about["training"]
    if training.get("stopped"):
        typer.echo(f"warning: {training['stopped']}; the map is the best state before", err=True)
    own = _error_in_words(model)
    warn(memory)
    kept = training.get("kept_mk")
    cost = f"; its weights as the file keeps them change it by {kept:.2g} mK" if kept is not None else ""
    typer.echo(f"{output}: trained in {model.about['training_s']:g} s{own}{cost}")


def _error_in_words(model: "TemperatureMap") -> str:
    """A trained map's own error, and what it was measured on."""
    if model.error_k is None:
        return ", own error unknown: no sequence could be left out"
    on = model.about["error_on"]
    how = f", cross-validated in {on['folds']} folds" if on["folds"] > 1 else " left out"
    return f", own error {model.error_k:.2f} K on {on['pairs']} pairs{how}"


def _train_emissivity(
    scenes: list[str] | None, output: Path, labels: Path | None, texel_m: float | None, seed: int
) -> None:
    """Train a map from colour and texture to materials, and print its accuracy."""
    from thermorender.apps.training.material_training import train_on
    from thermorender.learned.emissivity.mapping import save_map

    with progress() as report:
        model, confusion = train_on(scenes or (), labels, output.stem, texel_m, seed=seed, progress=report)
        save_map(model, output)
    typer.echo(str(model))
    rows = [
        (name, str(row.sum()), f"{row[k] / row.sum():.1%}" if row.sum() else "not tested")
        for k, (name, row) in enumerate(zip(model.materials, confusion, strict=True))
    ]
    table(("material", "texels held out", "right"), rows)
    warn(model.about.get("unused_labels"))
    if "not_tested" in model.about:
        typer.echo(f"warning: not tested: {model.about['not_tested']}; label more of it to know", err=True)
    typer.echo(str(output))


def _update_emissivity(
    scenes: list[str] | None, output: Path, labels: Path | None, base: str, seed: int, alone: bool
) -> None:
    """Update a map from colour and texture to materials with the labels of one scene."""
    from thermorender.apps.training.material_training import adapted_to
    from thermorender.learned.emissivity.mapping import save_map

    if not alone or len(scenes or ()) != 1:
        raise ThermorenderError(
            "--from updates a map with the labels of one scene, without --texel-m; give one scene and leave that out"
        )
    assert scenes is not None
    model = adapted_to(scenes[0], base, labels, output.stem, seed)
    save_map(model, output)
    typer.echo(str(model))
    warn(model.about.get("unused_labels"))
    typer.echo(str(output))


def translate(
    model: Annotated[str, typer.Argument(help=f"Learned map: {MAPS}, or a file ending in .npz.")],
    images: Annotated[list[Path], typer.Argument(help="Pictures, videos (.mp4, .avi), or folders of them.")],
    output: Annotated[Path, output_option("-o", "--output", help="Folder for the results.")],
    texel_m: Annotated[
        float | None, typer.Option(help="Ground sampling distance of the images [m]. Default: the map's own.")
    ] = None,
    range_c: Annotated[str | None, typer.Option(help="COLD,WARM: °C of intensity 0 and 1 of the map.")] = None,
    anchor: Annotated[
        str | None, typer.Option(help="Level for another hour: air=KELVIN, or a .csv of known temperatures, column, "
                                 "row, kelvin; two or more set the span too."),
    ] = None,
    palette: Annotated[str, typer.Option(help="white-hot, black-hot or ironbow.")] = "white-hot",
    frames: Annotated[bool, typer.Option("--frames", help="Write the frames of videos too.")] = False,
    audit: Annotated[
        bool, typer.Option("--audit", help="Search the pictures, and first frames of videos, for those that the map "
                           "was trained on.")
    ] = False,
    resume: Annotated[bool, typer.Option("--resume", help="Continue a stopped run.")] = False,
) -> None:  # fmt: skip
    """Translate photographs and videos into thermal ones with a learned map; temperatures are in kelvin."""
    from thermorender.apps.training.anchoring import anchor_of
    from thermorender.apps.training.training_pictures import search_in_files
    from thermorender.apps.training.translate import translate as run
    from thermorender.learned.temperature_map import load_model

    limits = parse_numbers("--range-c", range_c, ("COLD", "WARM")) if range_c else None
    with progress() as report:
        chosen = load_model(model, limits)
        line = None if anchor is None else anchor_of(anchor, chosen, images, texel_m, output if resume else None)
        summary = run(chosen, images, output, texel_m, palette, frames, resume, report, line)
        seen = search_in_files(chosen, images, lambda share: report("audit", share)) if audit else None
    for sentence in summary["warnings"]:
        typer.echo(f"warning: {sentence}", err=True)
    if seen is not None:
        typer.echo(seen.line)
    for sentence in summary["failed"].values():
        typer.echo(f"error: {sentence}", err=True)
    counted = [f"{summary['done']} translated"]
    counted += [f"{summary['passed over']} done before"] if summary["passed over"] else []
    counted += [f"{len(summary['failed'])} failed"] if summary["failed"] else []
    typer.echo(f"{', '.join(counted)}, in {output}")
    if line is not None:
        typer.echo(f"anchor: temperatures are {line.span:.2f} times those of the map {line.offset_k:+.1f} K")
        if line.span == 0.0:
            typer.echo(
                "warning: the known temperatures do not rise with the map's, so every pixel is their mean", err=True
            )
    for sentence in summary["notes"]:
        typer.echo(sentence)
    if summary["failed"]:
        raise typer.Exit(2)
