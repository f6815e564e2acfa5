"""Time and memory against triangles, texels and spectral nodes: `python -m validation.growth`."""

from pathlib import Path

import typer

from thermorender.cli.terminal import progress, table
from validation.command import Device, Out, alone, run_command
from validation.growth import study


def main(output: Out = Path("out/validation/growth"), device: Device = "auto"):
    """How time and memory grow with triangles, texels and spectral nodes; continues where it was stopped."""
    with progress() as tell, alone(output):
        cases = study.run(output, progress=tell, device=device)
    table(study.HEADER, study.rows(cases))
    typer.echo(f"numbers and figure in {output}")


if __name__ == "__main__":
    run_command(main)
