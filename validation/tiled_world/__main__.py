"""Ground of any size: `python -m validation.tiled_world`."""

from pathlib import Path

from validation.command import Device, Out, conclude, new_results, run_command
from validation.tiled_world import study


def main(output: Out = Path("out/validation/tiled_world"), device: Device = "auto"):
    """Tiles against one piece, coarse tiles against fine ones, and a flight over a world of 100 km."""
    with new_results(output) as (report, folder):
        result = study.run(folder, progress=report, device=device)
    conclude("tiled_world", output, study.HEADER, study.rows(result), "numbers")


if __name__ == "__main__":
    run_command(main)
