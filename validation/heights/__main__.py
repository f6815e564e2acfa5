"""Error against run time by height: `python -m validation.heights`."""

from pathlib import Path

from validation.command import Device, Out, conclude, continued_results, run_command
from validation.heights import study


def main(output: Out = Path("out/validation/heights"), device: Device = "auto"):
    """Error against run time by height, and other ray casters on the same mesh; continues earlier results."""
    with continued_results(output) as report:
        cases = study.run(output, progress=report, device=device)
    conclude("heights", output, study.HEADER, study.rows(cases))


if __name__ == "__main__":
    run_command(main)
