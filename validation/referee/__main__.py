"""What `compare` names: planted faults and innocent frames on unseen lands.

Run it as `python -m validation.referee`.
"""

from pathlib import Path
from typing import Annotated

import typer

from thermorender import formats
from thermorender.apps.lands.procedural.procedural_scene import KINDS
from thermorender.cli.terminal import split
from validation.command import Out, conclude, continued_results, run_command, seeds_of
from validation.referee import study
from validation.referee.figure import draw


def main(
    output: Out = Path("out/validation/referee"),
    kinds: Annotated[str, typer.Option(help="Comma-separated kinds of land.")] = ",".join(KINDS),
    seeds: Annotated[
        str, typer.Option(help="Comma-separated seeds of lands.")
    ] = ",".join(map(str, study.SEEDS)),
):  # fmt: skip
    """What `compare` names: planted faults and innocent frames on unseen lands."""
    with continued_results(output) as report:
        result = study.run(output, split(kinds), seeds_of(seeds), report)
        formats.write_json(output / "referee.json", result)
        draw(output / "referee.png", result)
    conclude("referee", output, study.HEADER, study.rows(result))


if __name__ == "__main__":
    run_command(main)
