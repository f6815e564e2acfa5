"""A comparison from beginning to end: scenes, their campaigns, methods, poses, and what is written.

Two passes. The first reads thermal frames of every scene, for the bounds and means of the campaigns they belong to. The
second takes the scenes one by one: the reference is baked, the frames of each method are made, and every pose of all of
them is judged with the same sensor and the same noise.
"""

import csv
import shutil
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from thermorender import files, formats
from thermorender.compare.machine import machine
from thermorender.compare.referee import findings, methods, provenance, scores, training, views
from thermorender.compare.referee.frames import Frames, waiting
from thermorender.compare.referee.report.page import write_page
from thermorender.compare.referee.report.pictures import Pictures
from thermorender.compare.referee.targets import Targets
from thermorender.compare.referee.trial import Trial
from thermorender.errors import ThermorenderError
from thermorender.learned.temperature_map import load_model
from thermorender.render.renderer import Renderer
from thermorender.versions import versions

COLUMNS = (
    "scene", "land", "pose", "time_s", "method", "stage", "surface", "material", "pixels", "pixels_without_temperature",
    "mean_error_k", "mean_absolute_error_k", "root_mean_square_error_k",
)  # fmt: skip
HEADER = ("method", "mean error [°C]", "mean absolute error [°C]", "95 %", "standard deviation [°C]", "pixels")


@dataclass(frozen=True)
class Flight:
    """A scene and where it is looked at from.

    Attributes
    ----------
    scene : Scene
    times : (P,) array
        [s]
    poses : (P, 4, 4) array
    """

    scene: Any
    times: np.ndarray
    poses: np.ndarray

    @classmethod
    def of(cls, scene, trajectory, rate_hz=1.0, start_s=None, stop_s=None):
        """Return that of a Trajectory or a part of it [s], so many poses per second."""
        times = trajectory.frame_times(rate_hz, start_s, stop_s)
        return cls(scene, times, trajectory.sampled(times).poses())


@dataclass(frozen=True)
class _Asked:
    """What is the same for all scenes: which methods, maps, oracle, foreign frames, learned materials, and settings."""

    letters: frozenset
    maps: list
    oracle: tuple | None
    others: list
    emissivity: Any
    settings: dict


def compare(flights, folder, models, letters=methods.LETTERS, oracle=None, foreign=None, datasets=(),
            emissivity=None, arrays=False, seed=0, progress=None, **settings):  # fmt: skip
    """Compare methods with the radiometric render of the same poses; return the summary that is also written.

    Parameters
    ----------
    flights : sequence of Flight
        Scenes of different names. Those without a truth raster are compared without a reference.
    folder : path
        New folder: `report.html`, `comparison.json`, `pixels.csv`, pictures, all or nothing.
    models : sequence of str
        Names or files of learned maps.
    letters : sequence of str
        Of the methods that are put beside the reference.
    oracle : str, optional
        File of a map that is shown the material, too.
    foreign : dict of str to Path, optional
        Folders of other programs' frames, by their names.
    datasets : sequence of Dataset
        That maps were trained on, to look for the scenes in.
    emissivity : EmissivitySpec, optional
        Of the learned materials of C2, by default as of `methods.learned_materials`.
    arrays : bool
        Whether the frames are kept as `.npz`, apparent temperature [K].
    seed : int
        Of the sensor's noise and of the intervals.
    progress : callable, optional
        Called with (what, share done).
    **settings
        Passed to Renderer.

    Raises
    ------
    ThermorenderError
        No map and no foreign frames, two scenes or two maps of one name, or what a map needs is not there.
    """
    tell = progress or (lambda what, share: None)
    names = [flight.scene.name for flight in flights]
    for name in names:
        if names.count(name) > 1:
            raise ThermorenderError(f"two scenes are called {name!r}; give folders of different names")
    shown = (oracle, load_model(oracle)) if oracle else None
    shapes = {(flight.scene.camera.height, flight.scene.camera.width): flight.scene.name for flight in flights}
    if len(shapes) > 1:
        told = "; ".join(f"{name!r} {width}×{height}" for (height, width), name in shapes.items())
        raise ThermorenderError(f"the scenes' cameras have different pictures: {told}; compare each camera by itself")
    maps = [(text, load_model(text)) for text in models]
    others = [methods.Foreign(name, Path(place)) for name, place in (foreign or {}).items()]
    if not maps and not others:
        raise ThermorenderError("models is empty; give at least one learned map, or foreign frames")
    every = [model for _, model in (*maps, *([shown] if shown else []))]
    called = [each.name for each in (*every, *others)]
    for name in called:
        if called.count(name) > 1:
            raise ThermorenderError(
                f"two methods are called {name!r}; give maps, the oracle and foreign frames different names"
            )
    for other in others:
        for flight in flights:
            camera = flight.scene.camera
            other.check(flight.scene.name, len(flight.times), len(flights) > 1, (camera.height, camera.width))
    asked = _Asked(frozenset(letters), maps, shown, others, emissivity or methods.learned_materials(), settings)
    known = [provenance.TrainingPictures(each, lambda share: tell("sketching training pictures", share))
             for each in datasets]  # fmt: skip
    began = time.perf_counter()
    lands = training.lands_of([flight.scene for flight in flights])
    calibrated = [model for _, model in maps if not model.needs] if {"B", "C1", "C2"} & asked.letters else []
    thermals = _thermals(flights, lands, calibrated, seed, settings, tell)
    found, told, photographs, table, left_out = {}, [], {}, [], []
    with files.atomic_folder(folder) as draft, waiting(folder) as work:
        pictures, targets, kept = Pictures(draft, len(flights)), Targets(), draft if arrays else None
        for number, flight in enumerate(flights):
            name = flight.scene.name

            def say(what, share, name=name, number=number):
                tell(f"{name}: {what}", (number + share) / len(flights))

            campaign = None
            if thermals[number] is not None:
                rest = [each for each in thermals if each is not None]
                campaign = training.training_of(thermals[number], rest, flight.scene.camera)
            truth = _truth(flight.scene)
            reference = Renderer(truth or flight.scene, progress=say, **settings)
            learned = None
            if "C2" in asked.letters and flight.scene.spec.terrain.orthophoto:
                say("telling materials from the orthophoto", 0.0)
                learned = flight.scene.with_learned_materials(asked.emissivity)
            made, missing = _methods(flight.scene, reference, learned, truth is not None, asked, campaign, say)
            left_out += missing
            frames = Frames(work, flight, reference.scene, learned, settings)
            one = Trial(flight, lands[number], reference, truth is not None, made, campaign, found, targets, pictures,
                        seed, frames, kept)  # fmt: skip
            one.run(table, say)
            told.append(one.summary())
            photographs[name] = one.photographs
        summary = {
            "scenes": told, "notes": [*_notes(told), *left_out], "targets": targets.summary(), "methods": {},
            "seed": seed, "machine": machine(),
            "settings": {key: str(value) for key, value in settings.items()}, "versions": versions(),
            "bounds": "of thermal frames of other lands in the same hour and weather; refitted: by eq. 2; calibrated: "
                      "a straight line from what the map says of their photographs, by least squares",
        }  # fmt: skip
        origins, constant = _origins(every, known, photographs), found.get("D constant")
        for label, own in found.items():
            summary["methods"][label] = own.summary(origins.get(own.method.name), seed) | {
                "more_than_constant": None if constant is None else own.tally.more_than(constant.tally, seed)
            }
        summary["findings"] = findings.of(summary)
        summary["seconds"] = time.perf_counter() - began
        with files.atomic(draft / "pixels.csv") as part, open(part, "w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(COLUMNS)
            writer.writerows(table)
        formats.write_json(draft / "comparison.json", summary)
        write_page(draft / "report.html", summary, pictures.views)
    shutil.rmtree(work, ignore_errors=True)
    return summary


def rows(summary):
    """Return the rows of a table of errors on ground, noise-free, under HEADER."""
    made = []
    for label, own in summary["methods"].items():
        if own["errors"]:
            found = own["errors"][scores.RADIOMETRIC]["ground"]
            ends = (found.get("interval_95") or {}).get("mae_k")
            told = [("none" if found[key] is None else format(found[key], form))
                    for key, form in (("me_k", "+.3f"), ("mae_k", ".3f"), ("sd_k", ".3f"))]  # fmt: skip
            sure = "" if ends is None else f"{ends[0]:.2f}…{ends[1]:.2f}"
            made.append((label, told[0], told[1], sure, told[2], str(found["pixels"])))
    return made


def _truth(scene):
    """The scene at its true temperatures, or None where it has none."""
    if scene.spec.truth_temperature is None and not scene.balanced:
        return None
    return scene.with_temperature(scene.truth_temperature_spec)


def _thermals(flights, lands, models, seed, settings, tell):
    """The Thermal of each flight's scene; None where it has no truth, or no other scene could learn from it."""
    keys = [(training.campaign_of(flight.scene, land), land) for flight, land in zip(flights, lands, strict=True)]
    found = []
    for number, (flight, (campaign, land)) in enumerate(zip(flights, keys, strict=True)):
        useful = any(other == campaign and where != land for other, where in keys)
        truth = _truth(flight.scene) if useful else None
        if truth is None:
            found.append(None)
            continue
        tell(f"{flight.scene.name}: thermal frames of its campaign", number / len(flights))
        renderer = Renderer(truth, **settings)
        chosen = views.evenly(len(flight.times), training.POSES)
        seen = (views.view_of(renderer, flight.poses[k], flight.times[k], k, True) for k in chosen)
        found.append(training.thermal_of(truth, land, seen, seed, models))
    return found


def _methods(scene, reference, learned, has_truth, asked, campaign, say):
    """(All Methods of a scene, what had to be left out and why, in sentences)."""
    made, left_out, settings = [], [], asked.settings
    weathered = scene.spec.weather is not None and scene.frame is not None
    for text, model in asked.maps:
        say(f"preparing {model.name}", 0.0)
        if model.needs and not weathered:
            raise ThermorenderError(
                f"{scene.where}: learned map {model.name!r} is told hour and weather, which this scene does not have; "
                "add [weather], or leave the map out"
            )
        if "B" in asked.letters and not model.needs:
            made += methods.translated(model, campaign, scene.sky_temperature)
        if {"C1", "C2"} & asked.letters:
            true = "C1" in asked.letters
            made += methods.rendered(scene, text, model, reference, campaign, true, learned, settings)
    if asked.oracle is not None and weathered:
        made.append(methods.oracle(scene, *asked.oracle, reference, settings))
    if has_truth:
        painted = methods.painted(campaign, scene.camera.band_um)
        made += [each for each in painted if each.letter in asked.letters]
    if "F" in asked.letters and has_truth and weathered and not scene.balanced:
        say("solving the heat balance of tables", 0.0)
        try:
            one = methods.balanced(scene, reference, settings)
            # Solved here, where it can be left out.
            _ = one.renderer
            made.append(one)
        except ThermorenderError as error:
            left_out.append(f"F, the heat balance of tables, is left out of {scene.name}: {error}")
    return made + [other.method(scene.name, scene.camera.band_um) for other in asked.others], left_out


def _origins(models, known, photographs):
    """{map: Provenance}, audited against the training pictures that are at hand."""
    found = {}
    for model in models:
        own = provenance.provenance_of(model)
        pictures = provenance.matched(known, model)
        if pictures is not None:
            pictures.audit(own, photographs)
        found[model.name] = own
    return found


def _notes(told):
    """What a reader has to know before the numbers, in sentences."""
    notes = []
    without = [each["name"] for each in told if not each["reference"]]
    if without:
        notes.append(f"No true temperature is known of {', '.join(without)}: of that only differences between methods "
                     "are told, and none of them is an error.")  # fmt: skip
    alone = [each["name"] for each in told if each["reference"] and each["campaign"] is None]
    if alone:
        notes.append(f"No other land in the hour and weather of {', '.join(alone)} is compared: there bounds are not "
                     "refitted, and constant and means per material are left out.")  # fmt: skip
    dark = [each["name"] for each in told if (each["sun_elevation_deg"] or 0.0) < 0.0]
    if dark:
        notes.append("Photographs show the orthophoto as it was lit when it was taken: where the sun is down they are "
                     f"of another hour, here of {', '.join(dark)}.")  # fmt: skip
    lands = len({each["land"] for each in told if each["reference"]})
    if lands:
        notes.append("Intervals are 95 %, of poses, of blocks of ground or of whole scenes drawn anew, whichever are "
                     f"widest; {'one land was' if lands == 1 else f'{lands} lands were'} seen.")  # fmt: skip
        notes.append("A scene of `make-scene` has temperatures by the heat balance, which F is too, with properties "
                     "drawn from their uncertainty and hidden fields; maps called procedural were trained on such "
                     "scenes. What all have wrong alike does not show here.")  # fmt: skip
    return notes
