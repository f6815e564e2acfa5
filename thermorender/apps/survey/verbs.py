"""Verbs on real frames: `fit-camera` writes a camera file, `reconstruct` a map of temperatures."""

from pathlib import Path
from typing import Annotated

import typer

from thermorender import defaults, files
from thermorender.cli.terminal import output_option, progress
from thermorender.errors import ThermorenderError
from thermorender.numbers import parse_numbers, parse_scale

Frames = Annotated[list[Path], typer.Argument(help="Frames, or folders of them: 16-bit TIFF or radiometric JPEG.")]
Base = Annotated[str, typer.Option(help="Camera model with the optics of the real one, or its .toml file.")]
Output = Annotated[
    Path,
    output_option(
        "-o", "--output", help="Camera file to write, .toml.",
        check=lambda path: files.check_output_file(path, (".toml",)),
    ),
]  # fmt: skip
Scale = Annotated[
    str | None, typer.Option(help="STEP,ZERO of TIFFs without a scale: kelvin per count, kelvin of count 0.")
]


def fit_camera(frames: Frames, output: Output, base: Base = defaults.CAMERA, scale: Scale = None) -> None:
    """Estimate noise, fixed pattern, blur and gain control from real frames, and write a camera file."""
    from thermorender.apps.survey.footage import calibration

    estimates = calibration.fit_camera(frames, base, parse_scale(scale))
    calibration.write_camera(output, base, estimates)
    for key, estimate in estimates.items():
        typer.echo(f"{key} = {estimate.text} ± {estimate.uncertainty:.2g}: {estimate.how}")
    for sentence in calibration.not_measured(base, estimates):
        typer.echo(sentence)
    typer.echo(str(output))


def reconstruct(
    inputs: Annotated[
        list[str], typer.Argument(metavar="[SCENE] FRAMES...", help="Scene folder or name, then frames or folders of "
                                  "them; without a scene, level ground with the relief that the frames show.")
    ],
    output: Annotated[
        Path,
        output_option("-o", "--output", help="New folder, or one to continue.", check=lambda path: _check(path)),
    ],
    poses: Annotated[
        Path | None,
        typer.Option(help="Poses of the frames: CSV, Metashape's text, OpenSfM's reconstruction.json or OpenDroneMap's "
                     "shots.geojson; default: the frames' EXIF and XMP tags."),
    ] = None,
    camera: Annotated[
        str | None, typer.Option(help="Camera that took them: a model or its .toml file; default: the scene's, or size "
                                 "and focal length of the frames' tags.")
    ] = None,
    lens: Annotated[
        Path | None, typer.Option(help="Lens of the frames: cameras.json of OpenDroneMap or Metashape's calibration as "
                                  ".xml; default: that of reconstruction.json, otherwise fitted.")
    ] = None,
    texel_m: Annotated[
        float | None, typer.Option(help="Side of a texel of the map [m]; default: the scene's texel, or 1.25 pixels.")
    ] = None,
    pose_error: Annotated[
        str | None, typer.Option(help="METRES,DEGREES: standard deviations of the poses; 0,0 keeps them and the lens; "
                                 "default: 1,0.7, or 0.1,0.7 with RTK.")
    ] = None,
    above_ground: Annotated[
        float | None, typer.Option(help="Height of the first frame above the terrain [m]; shifts all heights.")
    ] = None,
    references: Annotated[
        Path | None, typer.Option(help="CSV of places with known temperature, which fix the common level.")
    ] = None,
    scale: Scale = None,
) -> None:  # fmt: skip
    """Reconstruct a map of temperatures with its uncertainty, corrected poses and the lens, from frames of a survey."""
    from thermorender.apps.survey.inverse.run import Inputs, run

    error = None
    if pose_error is not None:
        metres, degrees = parse_numbers("--pose-error", pose_error, ("METRES", "DEGREES"))
        if min(metres, degrees) < 0.0:
            raise ThermorenderError(f"--pose-error={pose_error} is not allowed; give numbers from 0 on")
        error = metres, degrees
    scene, frames = _parted(inputs)
    given = Inputs(frames, scene, poses, camera, texel_m, error, above_ground, references, parse_scale(scale), lens)
    with progress() as report:
        facts = run(given, output, report)
    typer.echo(
        f"{facts['frames']} frames: a texel is known to {facts['std_median_k']:.3f} K in the median, the common level "
        f"to {facts['level_std_k']:.2f} K from {facts['level_of']}"
    )
    for note in facts["notes"]:
        typer.echo(f"note: {note}", err=True)
    typer.echo(f"look at {output / 'report.html'}; {output / 'scene'} is the scene with these temperatures")


def _parted(inputs: list[str]) -> tuple[str | None, tuple[Path, ...]]:
    """(scene or None, frames) of the arguments: the first is a scene if it is one's folder, or no path and a name."""
    first, *rest = inputs
    path = Path(first)
    if not (path / "scene.toml").is_file() and (path.exists() or not (rest or first in defaults.SCENES)):
        return None, tuple(map(Path, inputs))
    if not rest:
        raise ThermorenderError(f"{first} is a scene; give frames, or folders of them, after it")
    return first, tuple(map(Path, rest))


def _check(path: Path) -> None:
    """Refuse a folder that is neither new nor of a reconstruction."""
    from thermorender.apps.survey.inverse.reconstruct import check_folder

    check_folder(path)
