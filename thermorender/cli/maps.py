"""The command line of learned temperature maps and their data sets; it parses, calls and prints."""

from pathlib import Path
from typing import Annotated

import typer

from thermorender.cli.camera import parse_scale
from thermorender.cli.terminal import output_option, progress, table
from thermorender.errors import ThermorenderError

VisibleFolder = Annotated[Path, typer.Argument(help="Folder of visible pictures.")]
ThermalFolder = Annotated[Path, typer.Argument(help="Folder of thermal pictures; may be the same.")]
DatasetFolder = Annotated[Path, output_option("-o", "--output", help="Folder for the data set.")]
VisiblePattern = Annotated[
    str, typer.Option(help="Names of visible pictures, e.g. '*_rgb.jpg'; what * stands for is the pair's name.")
]
ThermalPattern = Annotated[str, typer.Option(help="Names of thermal pictures, e.g. '*_thermal.tif'.")]
ValidPattern = Annotated[
    str | None, typer.Option(help="Names of masks in the visible folder, not 0 where both show the same.")
]
ThermalScaleText = Annotated[
    str | None, typer.Option("--scale", help="STEP,ZERO of 16-bit files that tell none: kelvin per count, of count 0.")
]
RigFile = Annotated[Path | None, typer.Option("--rig", help="Lay visible pictures onto thermal ones by this rig.json.")]
Calibrate = Annotated[bool, typer.Option("--calibrate", help="Find the rig from the pictures, and keep it.")]
Fields = Annotated[
    str | None,
    typer.Option("--fields-of-view", help="VISIBLE_H,VISIBLE_V,THERMAL_H,THERMAL_V [deg]: where --calibrate begins, "
                 "e.g. 57.12,42.44,45,37."),
]  # fmt: skip
Resized = Annotated[
    bool, typer.Option("--resized", help="Visible pictures were resized unequally along their sides: --calibrate finds "
                       "that ratio too."),
]  # fmt: skip
Crops = Annotated[int, typer.Option(help="Squares cut at random from each pair; 0: whole pictures.")]
CropSize = Annotated[int, typer.Option(help="Their side [px].")]
Shift = Annotated[
    float, typer.Option(help="Move each thermal picture by a random vector of this length [px]: pairs that are not "
                        "aligned."),
]  # fmt: skip
DrawSeed = Annotated[int, typer.Option(help="Of crops, shifts and split.")]
Split = Annotated[str, typer.Option(help="sequence, place or crop: what is kept together.")]
Sequence = Annotated[
    str | None, typer.Option(help="Regular expression whose group is a name's sequence; default: the name without its "
                             "last digits."),
]  # fmt: skip
Gap = Annotated[int | None, typer.Option(help="A greater step of the numbers in names begins a new sequence.")]
TexelM = Annotated[float | None, typer.Option(help="Ground sampling distance of the thermal pictures [m].")]
IntensityRange = Annotated[
    str | None, typer.Option("--range-c", help="COLD,WARM: °C of the bounds of values of unknown scale; default 14,24.")
]
Licence = Annotated[str | None, typer.Option(help="Of the pictures, for the card.")]
SkipBad = Annotated[bool, typer.Option("--skip-bad", help="Leave out what cannot be used, and list it.")]
Resume = Annotated[bool, typer.Option("--resume", help="Continue a data set that was stopped.")]


def prepare(
    visible_folder: VisibleFolder,
    thermal_folder: ThermalFolder,
    output: DatasetFolder,
    visible: VisiblePattern = "*",
    thermal: ThermalPattern = "*",
    valid: ValidPattern = None,
    scale: ThermalScaleText = None,
    rig: RigFile = None,
    calibrate: Calibrate = False,
    fields_of_view: Fields = None,
    resized: Resized = False,
    crops: Crops = 0,
    crop_size: CropSize = 256,
    shift: Shift = 0.0,
    seed: DrawSeed = 0,
    split: Split = "sequence",
    sequence: Sequence = None,
    gap: Gap = None,
    texel_m: TexelM = None,
    range_c: IntensityRange = None,
    licence: Licence = None,
    skip_bad: SkipBad = False,
    resume: Resume = False,
):
    """Make a data set of folders of visible and thermal pictures, registered, cut, split and scaled."""
    from thermorender.campaign.prepare import Cut, Source
    from thermorender.campaign.prepare import prepare as run
    from thermorender.trajectory import parse_numbers

    warm = parse_numbers("--range-c", range_c, ("COLD", "WARM")) if range_c else None
    source = Source(visible_folder, thermal_folder, visible, thermal, valid, parse_scale(scale), sequence, gap)
    with progress() as tell:
        made = run(
            source, output, _registered(rig, calibrate, fields_of_view, resized), Cut(crops, crop_size, shift, seed),
            split, texel_m=texel_m, range_c=warm, licence=licence, skip_bad=skip_bad, resume=resume, progress=tell,
        )  # fmt: skip
    for name, reason in made["left_out"].items():
        typer.echo(f"left out: {name}: {reason}", err=True)
    if made["grey"]:
        typer.echo(f"warning: {made['grey']} of {made['pairs']} visible pictures are grey: fits of three colours to "
                   "them are rank-deficient; use --ridge, or pictures in colour", err=True)  # fmt: skip
    if made["rig"] is not None:
        typer.echo(str(made["rig"]))
    bounds = made["bounds"]
    outside = bounds.share_below + bounds.share_above
    typer.echo(f"{made['scale'].unit}: bounds {bounds.low:g} and {bounds.high:g}, {outside:.2%} of the values outside")
    table(("part", "pairs"), list(made["parts"].items()))
    typer.echo(
        f"{made['entries']} pairs of {made['pairs']} pairs of pictures in {made['sequences']} sequences, in {output}"
    )


def _registered(file, calibrate, fields_of_view, resized):
    """The Rig of a file, a Calibration, or None."""
    from thermorender.campaign.prepare import Calibration
    from thermorender.campaign.rig import load_rig
    from thermorender.trajectory import parse_numbers

    if not calibrate and (fields_of_view or resized):
        raise ThermorenderError("--fields-of-view and --resized tell --calibrate how to begin; add --calibrate")
    if file is not None and calibrate:
        raise ThermorenderError(f"--rig {file} and --calibrate exclude each other; give one of them")
    if not calibrate:
        return load_rig(file) if file is not None else None
    fields = None
    if fields_of_view:
        angles = parse_numbers(
            "--fields-of-view", fields_of_view, ("VISIBLE_H", "VISIBLE_V", "THERMAL_H", "THERMAL_V")
        )
        if not all(0.0 < angle < 180.0 for angle in angles):
            raise ThermorenderError(f"--fields-of-view={fields_of_view!r} holds no angles; give degrees in 0…180")
        fields = (tuple(angles[:2]), tuple(angles[2:]))
    return Calibration(fields, resized)
