"""Error toward the horizon by distance: `python -m validation.horizon`."""

from pathlib import Path

from validation.command import Device, Out, conclude, new_results, run_command
from validation.horizon import study


def main(output: Out = Path("out/validation/horizon"), device: Device = "auto"):
    """Error toward the horizon by distance, without far ground and with coarser posts."""
    with new_results(output) as (report, folder):
        cases = study.run(folder, progress=report, device=device)
    conclude("horizon", output, study.HEADER, study.rows(cases), "numbers")


if __name__ == "__main__":
    run_command(main)
