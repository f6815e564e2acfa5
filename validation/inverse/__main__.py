"""Maps from frames: `python -m validation.inverse [--flight FOLDER]`."""

import tempfile
from pathlib import Path
from typing import Annotated

import typer

from thermorender import formats
from thermorender.apps.lands.procedural.procedural_scene import make
from thermorender.apps.lands.procedural.truth import write
from thermorender.apps.survey.inverse.solve import Settings
from validation.command import Out, conclude, continued_results, seeds_of
from validation.command import run_command as run
from validation.inverse import flight, study

# (case, every so many frames, keys of Settings): error by prior and reference, then against run time.
_CASES = (
    ("standard", 1, {}), (study.FLAT, 1, {}), (study.REFERENCE, 1, {}),
    ("half of the frames", 2, {}), ("coarse texels", 1, {"texel_m": 0.5}),
    ("one tap", 1, {"taps": 1}), ("three taps a side", 1, {"taps": 3}), ("three rounds", 1, {"rounds": 3}),
    ("six rounds", 1, {"rounds": 6}),
)  # fmt: skip


def main(
    output: Out = Path("out/validation/inverse"),
    kinds: Annotated[str, typer.Option(help="heath,village")] = "heath",
    seeds: Annotated[str, typer.Option(help="Of the landscapes.")] = "21",
    every: Annotated[int, typer.Option(help="Pixels of the camera in one of the simulation's, along a side.")] = 2,
    texel_m: Annotated[float, typer.Option(help="Of the map [m].")] = 0.25,
    only: Annotated[int | None, typer.Option(help="Cases of settings, from the first on.")] = None,
    real: Annotated[Path | None, typer.Option("--flight", help="Folder of the real flight's frames.")] = None,
    alone: Annotated[Path | None, typer.Option(help="Folder of a flight's radiometric JPEGs, without a scene.")] = None,
):
    """The error of reconstructed maps against truth, by setting, and of held-out frames of a real flight."""
    results: list[dict] = []
    path = output / "inverse.json"
    with continued_results(output) as report, tempfile.TemporaryDirectory() as made:
        splits, own = {}, {}
        if real is not None:
            scene, camera, survey = flight.read_flight(real, Path(made) / "flight")
            for which in flight.SPLITS:
                splits[which] = flight.split(scene, camera, survey, which)
                formats.write_json(path, {"simulated": results, "flight": splits, "alone": own})
        if alone is not None:
            scene, camera, survey = flight.read_alone(alone, Path(made) / "level")
            for which in flight.SPLITS:
                own[which] = flight.split(scene, camera, survey, which, flight.RTK, alone=True)
                formats.write_json(path, {"simulated": results, "flight": splits, "alone": own})
        cases = [(seed, kind) for seed in seeds_of(seeds) for kind in kinds.split(",")]
        for done, (seed, kind) in enumerate(cases):
            folder = write(make(kind, seed), Path(made) / f"{kind}{seed}", temperature_every=1)
            simulated = study.Simulated(folder, every, seed)
            for number, (name, step, keys) in enumerate(_CASES[:only]):
                report(f"{kind} {seed}: {name}", (done + number / len(_CASES)) / len(cases))
                settings = Settings(**({"texel_m": texel_m, "pose_error": study.ERROR} | keys))
                results.append(simulated.case(f"{kind} {seed}, {name}", settings, step))
                formats.write_json(path, {"simulated": results, "flight": splits, "alone": own})
    conclude("inverse", output, study.HEADER, study.rows(results), "numbers")


if __name__ == "__main__":
    run(main)
