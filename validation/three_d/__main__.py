"""What a draped orthophoto costs by angle and kind of surface, and rankings of maps: `python -m validation.three_d`."""

from pathlib import Path
from typing import Annotated

import typer

from thermorender import formats
from thermorender.cli.terminal import table
from validation.command import Device, Out, conclude, continued_results, run_command, seeds_of
from validation.kept_cases import kept_parts
from validation.three_d import imported, study
from validation.three_d import views as whole


def main(
    output: Out = Path("out/validation/three_d"),
    seeds: Annotated[str, typer.Option(help="Comma-separated seeds of worlds.")] = "401,402,403",
    views: Annotated[int, typer.Option(help="Views per world and angle.", min=1)] = 3,
    size_m: Annotated[float, typer.Option(help="Side of a world [m].")] = 90.0,
    device: Device = "auto",
):
    """Errors of frames of a draped orthophoto against the same world in three dimensions, and rankings of maps;
    continues earlier results."""
    numbers, path = seeds_of(seeds), output / "three_d.json"
    with continued_results(output) as report:
        result = kept_parts(path, {"seeds": numbers, "views": views, "size_m": size_m})

        def keep(part, found):
            result[part] = found
            formats.write_json(path, result)

        if "cases" not in result:
            result |= study.run(numbers, views, size_m, progress=report, device=device)
        if "imported" not in result:
            keep("imported", imported.run(numbers[0], views, size_m, device))
        if "hours" not in result:
            keep("hours", study.by_hour(
                seed=numbers[0], views=views, size_m=size_m, progress=report, device=device
            ))  # fmt: skip
        known = result.get("whole", {}).get("views", ())
        whole.run(known=known, keep=lambda found: keep("whole", found), progress=report, device=device)
    conclude("three_d", output, study.HEADER, study.rows(result), "numbers")
    for name, seen in (("budget", result["budget"]), ("budget, imported", result["imported"]["views"])):
        table((name, *study.BUDGET_HEADER), [(name, *row) for row in study.budget_rows(seen)])
    table(("hour UTC", *(f"{angle:g}° [K]" for angle in study.ANGLES)), study.hour_rows(result["hours"]))
    table(whole.HEADER, whole.rows(result["whole"]))
    table(("map", *(f"{world} [K]" for world in study.WORLDS)), study.ranking_rows(result))


if __name__ == "__main__":
    run_command(main)
