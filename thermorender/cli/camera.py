"""The verb `fit-camera`: a camera file from real frames."""

from pathlib import Path
from typing import Annotated

import typer

from thermorender import defaults, files
from thermorender.cli.terminal import output_option

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
    from thermorender.footage import calibration

    estimates = calibration.fit_camera(frames, base, parse_scale(scale))
    calibration.write_camera(output, base, estimates)
    for key, estimate in estimates.items():
        typer.echo(f"{key} = {estimate.text} ± {estimate.uncertainty:.2g}: {estimate.how}")
    for sentence in calibration.not_measured(base, estimates):
        typer.echo(sentence)
    typer.echo(str(output))


def parse_scale(text: str | None) -> tuple[float, float] | None:
    """Return (kelvin per count, kelvin of count 0) of an option; None if it is not given."""
    from thermorender.trajectory import parse_numbers

    if not text:
        return None
    step, zero = parse_numbers("--scale", text, ("STEP", "ZERO"))
    return step, zero
