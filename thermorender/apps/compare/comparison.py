"""A comparison from start to end: scenes, their campaigns, methods, poses, and the files written.

The first pass reads thermal frames of all scenes, for campaign bounds and means. The second bakes each scene's
reference, renders the frames of each method, and scores all methods with the same sensor and noise.
"""

import csv
import shutil
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender import files, formats
from thermorender.apps.compare import findings, methods, provenance, training
from thermorender.apps.compare.figures import Pictures
from thermorender.apps.compare.foreign import Foreign
from thermorender.apps.compare.frames import Frames, waiting
from thermorender.apps.compare.machine import machine
from thermorender.apps.compare.report import write_page
from thermorender.apps.compare.trial import Setup, Totals, Trial
from thermorender.apps.compare.view import Flight, evenly, view_of
from thermorender.apps.training.dataset import Dataset
from thermorender.errors import ThermorenderError
from thermorender.learned.temperature_map import TemperatureMap, load_model
from thermorender.progress import Progress, Spread
from thermorender.render.tiled.tiled_renderer import renderer_of
from thermorender.scene.scene import Scene
from thermorender.scene.spec import EmissivitySpec
from thermorender.trajectory import Trajectory
from thermorender.versions import versions

COLUMNS = (
    "scene", "land", "pose", "time_s", "method", "stage", "surface", "material", "pixels", "pixels_without_temperature",
    "mean_error_k", "mean_absolute_error_k", "root_mean_square_error_k",
)  # fmt: skip
# Lowest and highest mean absolute error of the heat balance over the sites of `validation.heat`, by day and night [K].
BALANCE_DAY_K, BALANCE_NIGHT_K = (0.3, 3.1), (0.2, 1.6)


@dataclass(frozen=True)
class Options:
    """Options of a comparison."""

    kinds: Collection[str] = methods.KINDS  # Methods to compare with the reference
    privileged: str | None = None  # File of a map that also takes the material as input
    # Folders of other programs' frames, by name
    foreign: Mapping[str, str | PathLike[str]] = field(default_factory=dict)
    # Run time of a frame [s] of foreign programs and of maps on the photograph, by name, in place of that measured here
    times_s: Mapping[str, float] = field(default_factory=dict)
    # Training data of the maps, in which the scenes' photographs are searched
    datasets: Sequence[Dataset] = ()
    emissivity: EmissivitySpec = field(default_factory=methods.learned_materials)  # Learned materials
    arrays: bool = False  # Whether to keep the frames as `.npz`, apparent temperature [K]
    seed: int = 0  # Of the sensor's noise and of the intervals
    settings: Mapping[str, Any] = field(default_factory=dict)  # Keywords of Renderer


@dataclass(frozen=True)
class _Contestants:
    """The loaded maps and privileged map, (name or file, map) each, and the foreign frames of each scene."""

    maps: list[tuple[str, TemperatureMap]]
    privileged: tuple[str, TemperatureMap] | None
    foreign: list[list[Foreign]]

    @property
    def models(self) -> list[TemperatureMap]:
        """All maps, the privileged one last."""
        return [model for _, model in (*self.maps, *([self.privileged] if self.privileged else []))]


def compare(
    flights: Sequence[Flight | tuple[Scene, Trajectory]],
    folder: str | PathLike[str],
    models: Sequence[str],
    options: Options | None = None,
    progress: Progress | None = None,
    spread: Spread = map,
) -> dict[str, Any]:
    """Compare methods with the radiometric render of the same poses; return the summary, which is also written.

    Parameters
    ----------
    flights : sequence of Flight, or of (Scene, Trajectory)
        Scenes with different names; a pair is seen once per second. Scenes without true temperatures are compared
        without a reference.
    folder : path
        New folder: `report.html`, `comparison.json`, `pixels.csv` and pictures. It is written whole or not at all.
    models : sequence of str
        Names or files of learned maps.
    options : Options, optional
    progress : callable, optional
        Called with (step, share done).
    spread : callable
        (do, units) → do(unit) of each, in order: it renders the frames of each rendered method of a scene.

    Raises
    ------
    ThermorenderError
        No map and no foreign frames, two scenes or two maps of the same name, cameras of different size, or a missing
        input of a map.
    """
    options = options or Options()
    shown = [each if isinstance(each, Flight) else Flight.of(*each) for each in flights]
    report = progress or (lambda step, share: None)
    methods.check_kinds(options.kinds)
    _check_scenes(shown)
    contestants = _contestants(shown, models, options)
    known = [provenance.TrainingPictures(each, lambda share: report("sketching training pictures", share))
             for each in options.datasets]  # fmt: skip
    began = time.perf_counter()
    lands = training.lands_of([flight.scene for flight in shown])
    calibrated = [model for _, model in contestants.maps if not model.needs]
    thermals = _thermals(shown, lands, calibrated if set(methods.OF_MAPS) & set(options.kinds) else [], options, report)
    totals = Totals()
    scenes, notes = [], []
    photographs: dict[str, list[NDArray[np.uint8]]] = {}
    with files.atomic_folder(folder) as draft, waiting(folder) as work:
        pictures = Pictures(draft, len(shown))
        for number, (flight, land, thermal) in enumerate(zip(shown, lands, thermals, strict=True)):

            def own_report(step: str, share: float, flight: Flight = flight, number: int = number) -> None:
                report(f"{flight.scene.name}: {step}", (number + share) / len(shown))

            campaign = training.training_of(thermal, thermals, flight.scene.camera)
            setup, left_out = _setup(number, flight, land, campaign, contestants, options, work, own_report)
            notes += left_out
            trial = Trial(setup, totals, options.seed, draft if options.arrays else None, options.times_s)
            trial.run(pictures, own_report, spread)
            scenes.append(trial.summary())
            photographs[flight.scene.name] = trial.photographs
        summary = _summary(scenes, notes, totals, _origins(contestants.models, known, photographs), options)
        summary["seconds"] = time.perf_counter() - began
        with files.atomic(draft / "pixels.csv") as part, open(part, "w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(COLUMNS)
            writer.writerows(totals.table)
        formats.write_json(draft / "comparison.json", summary)
        write_page(draft / "report.html", summary, pictures)
    shutil.rmtree(work, ignore_errors=True)
    return summary


def _check_scenes(flights: Sequence[Flight]) -> None:
    """Refuse scenes of equal names, and cameras of different size."""
    _check_names([flight.scene.name for flight in flights], "scenes", "folders of different names")
    shapes = {(flight.scene.camera.height, flight.scene.camera.width): flight.scene.name for flight in flights}
    if len(shapes) > 1:
        sizes = "; ".join(f"{name!r} {width}×{height}" for (height, width), name in shapes.items())
        raise ThermorenderError(f"the scenes' cameras have different picture sizes: {sizes}; compare them separately")


def _check_names(names: Sequence[str], what: str, mend: str) -> None:
    for name in names:
        if names.count(name) > 1:
            raise ThermorenderError(f"two {what} are called {name!r}; give {mend}")


def _contestants(flights: Sequence[Flight], models: Sequence[str], options: Options) -> _Contestants:
    """Load the maps, privileged or not, and the foreign frames; refuse equal names."""
    maps = [(text, load_model(text)) for text in models]
    if not maps and not options.foreign:
        raise ThermorenderError("models is empty; give at least one learned map, or foreign frames")
    privileged = (options.privileged, load_model(options.privileged)) if options.privileged else None
    loaded = _Contestants(maps, privileged, [])
    _check_names([*(model.name for model in loaded.models), *options.foreign], "methods",
                 "maps, the privileged map and foreign frames different names")  # fmt: skip
    known = [*(model.name for _, model in maps), *options.foreign]
    for name in options.times_s:
        if name not in known:
            raise ThermorenderError(f"run_time={name!r} is neither a map nor another program; give {', '.join(known)}")
    for flight in flights:
        scene, camera = flight.scene, flight.scene.camera
        loaded.foreign.append([
            Foreign.of_poses(name, Path(place), scene.name, len(flight.times), len(flights) > 1,
                             (camera.height, camera.width)) for name, place in options.foreign.items()
        ])  # fmt: skip
    return loaded


def _truth(scene: Scene) -> Scene | None:
    """Return the scene at its true temperatures, or None if they are unknown."""
    if scene.spec.truth_temperature is None and not scene.balanced:
        return None
    return scene.with_true_temperature()


def _thermals(
    flights: Sequence[Flight],
    lands: Sequence[str],
    models: Sequence[TemperatureMap],
    options: Options,
    report: Progress,
) -> list[training.Thermal | None]:
    """Return the Thermal of each flight's scene; None if it has no truth, or no other scene shares its campaign."""
    keys = [(training.campaign_of(flight.scene, land), land) for flight, land in zip(flights, lands, strict=True)]
    found: list[training.Thermal | None] = []
    for number, (flight, (campaign, land)) in enumerate(zip(flights, keys, strict=True)):
        useful = any(other == campaign and where != land for other, where in keys)
        truth = _truth(flight.scene) if useful else None
        if truth is None:
            found.append(None)
            continue
        report(f"{flight.scene.name}: thermal frames of its campaign", number / len(flights))
        renderer = renderer_of(truth, **options.settings)
        chosen = evenly(len(flight.times), training.POSES)
        seen = (view_of(renderer, flight.poses[k], flight.times[k], k, True) for k in chosen)
        found.append(training.thermal_of(truth, land, seen, options.seed, models))
    return found


def _setup(
    number: int,
    flight: Flight,
    land: str,
    campaign: training.Training | None,
    contestants: _Contestants,
    options: Options,
    work: Path,
    report: Progress,
) -> tuple[Setup, list[str]]:
    """Return the Setup of a scene with its baked reference and methods, and sentences on methods left out."""
    scene, truth = flight.scene, _truth(flight.scene)
    reference = renderer_of(truth or scene, progress=report, **options.settings)
    learned = None
    if methods.LEARNED_MATERIALS in options.kinds and scene.spec.terrain.orthophoto and scene.world is None:
        report("classifying materials from the orthophoto", 0.0)
        learned = scene.with_learned_materials(options.emissivity)
    given = methods.Given(scene, reference, truth is not None, campaign, learned, contestants.privileged,
                          contestants.foreign[number], report)  # fmt: skip
    made, left_out = methods.methods_of(options.kinds, contestants.maps, given)
    if scene.world is not None:
        left_out.append(
            f"Maps on the photograph and as kelvin are not split into terms in {scene.name}: its ground is in tiles."
        )
    frames = Frames(work, flight, reference.scene, learned, dict(options.settings))
    return Setup(flight, land, reference, truth is not None, campaign, frames, made), left_out


def _summary(
    scenes: list[dict[str, Any]],
    left_out: list[str],
    totals: Totals,
    origins: Mapping[str, provenance.Provenance],
    options: Options,
) -> dict[str, Any]:
    """Return the summary of a comparison, as plain numbers."""
    constant, seed = totals.methods.get(methods.A_CONSTANT), options.seed
    summary: dict[str, Any] = {
        "scenes": scenes, "notes": [*_notes(scenes, totals, options.kinds), *dict.fromkeys(left_out)],
        "targets": totals.targets.summary(), "methods": {},
        "seed": seed, "machine": machine(),
        "settings": {key: str(value) for key, value in options.settings.items()}, "versions": versions(),
        "bounds": "from thermal frames of other lands in the same hour and weather; refitted: by eq. 2; calibrated: "
                  "a least-squares line from the map's intensities of their photographs",
    }  # fmt: skip
    for label, own in totals.methods.items():
        summary["methods"][label] = own.summary(origins.get(own.method.name), seed) | {
            "more_than_constant": None if constant is None else own.tally.more_than(constant.tally, seed)
        }
    summary["findings"] = findings.of(summary)
    return summary


def _origins(
    models: Sequence[TemperatureMap],
    known: Sequence[provenance.TrainingPictures],
    photographs: Mapping[str, Sequence[NDArray[np.uint8]]],
) -> dict[str, provenance.Provenance]:
    """Return {map: Provenance}, audited against the available training pictures."""
    found = {model.name: provenance.provenance_of(model) for model in models}
    provenance.search_fingerprints(list(found.values()), models, photographs)
    for model in models:
        pictures = provenance.matched(known, model)
        if pictures is not None:
            pictures.audit(found[model.name], photographs)
    return found


def _notes(scenes: Sequence[dict[str, Any]], totals: Totals, kinds: Collection[str]) -> list[str]:
    """Return sentences that a reader should know before the numbers."""

    def of(chosen: Callable[[dict[str, Any]], bool], sentence: str) -> list[str]:
        names = ", ".join(each["name"] for each in scenes if chosen(each))
        return [sentence.format(names)] if names else []

    words = {methods.CONSTANT: methods.A_CONSTANT, methods.PER_MATERIAL: "a mean per material",
             methods.FRAME_MEAN: methods.OWN_MEAN, methods.BALANCE: "the heat balance of tables"}  # fmt: skip
    unscored = [words[kind] for kind in words if kind in kinds]
    alone = [words[kind] for kind in (methods.CONSTANT, methods.PER_MATERIAL) if kind in kinds]
    left_out = f", and {' and '.join(alone)} {'is' if len(alone) == 1 else 'are'} left out" if alone else ""
    notes = of(
        lambda each: not each["reference"],
        "The true temperature of {} is unknown: only differences between "
        "methods are reported there, not errors."
        + (f" What needs a truth is left out there: {', '.join(unscored)}." if unscored else ""),
    )
    notes += of(
        lambda each: each["computed"],
        "The reference of {} is computed by the heat balance, not measured. Its "
        f"mean absolute error at measured sites is {BALANCE_DAY_K[0]:g} to {BALANCE_DAY_K[1]:g} K by day and "
        f"{BALANCE_NIGHT_K[0]:g} to {BALANCE_NIGHT_K[1]:g} K by night. A difference below that may be the "
        "reference's error.",
    )
    notes += of(
        lambda each: each["reference"] and each["campaign"] is None,
        f"No other land shares the hour and weather of {{}}: bounds are not refitted there{left_out}.",
    )
    if methods.OWN_MEAN in totals.methods:
        notes.append(
            f"{methods.OWN_MEAN.capitalize()} needs the truth of the frame itself. Its error is that of a method that "
            "knows only the mean level."
        )
    notes += of(
        lambda each: (each["sun_elevation_deg"] or 0.0) < 0.0,
        "Photographs show the orthophoto as it was lit "
        "when it was taken, which differs from the scene where the sun is below the horizon, here in {}.",
    )
    return notes + _notes_on_errors(scenes, totals)  # fmt: skip


def _notes_on_errors(scenes: Sequence[dict[str, Any]], totals: Totals) -> list[str]:
    """Return sentences on the errors of scenes with a truth."""
    lands = len({each["land"] for each in scenes if each["reference"]})
    if not lands:
        return []
    found = [each.method for each in totals.methods.values()]
    tables = " like that of tables" if any(method.kind == methods.BALANCE for method in found) else ""
    trained = "; maps called procedural were trained on such scenes"
    trained = trained if any(method.name.startswith("procedural") for method in found) else ""
    return [
        "Intervals are 95 %, by a bootstrap of poses and blocks of ground together, or of whole scenes, if wider. A "
        "block's side is five correlation lengths of the error; "
        f"{'one land was' if lands == 1 else f'{lands} lands were'} seen.",
        f"A scene of make-scene has temperatures by a heat balance{tables}, with properties drawn from their "
        f"uncertainty and with hidden fields{trained}. Errors that all of them share do not show here.",
    ]
