"""The cost of the link: `python -m validation.link`, on a machine that does nothing else."""

from pathlib import Path
from typing import Annotated

import typer

from thermorender import formats
from thermorender.cli.terminal import split
from validation.command import Device, Out, conclude, new_results, run_command
from validation.link import study


def main(
    output: Out = Path("out/validation/link"),
    frames: Annotated[int, typer.Option(min=2, help="Frames of each client and case.")] = 60,
    qualities: Annotated[str, typer.Option(help="Comma-separated: fast, standard, high.")] = ",".join(study.QUALITIES),
    methods: Annotated[str, typer.Option(help="Comma-separated: A, B, C.")] = ",".join(study.METHODS),
    clients: Annotated[int, typer.Option(min=1, max=16, help="Clients at once, in the case with several.")] = 4,
    repeats: Annotated[int, typer.Option(min=1, help="Turns of bench.")] = 15,
    device: Device = "auto",
):
    """Latency and frames per second of the link, beside the bare render."""
    with new_results(output) as (report, folder):
        result = study.run(frames, split(qualities), split(methods), clients, repeats, report, device)
        formats.write_json(folder / "link.json", result)
    conclude("link", output, study.HEADER, study.rows(result), "numbers")


if __name__ == "__main__":
    run_command(main)
