"""Time and memory against triangles, texels and spectral nodes: `python -m validation.growth`."""

from pathlib import Path

from validation.command import Device, Out, conclude, continued_results, run_command
from validation.growth import study


def main(output: Out = Path("out/validation/growth"), device: Device = "auto"):
    """Time and memory against triangles, texels and spectral nodes; continues earlier results."""
    with continued_results(output) as report:
        cases = study.run(output, progress=report, device=device)
    conclude("growth", output, study.HEADER, study.rows(cases))


if __name__ == "__main__":
    run_command(main)
