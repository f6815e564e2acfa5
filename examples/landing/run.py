"""Landings in the loop: a frame, the detector's result, a command, and the vehicle's state a frame interval later.

Every run is flown with each kind of frames under the same conditions: start, wind and gusts, marker, air and sensor
noise. *A* is the radiometric render; *B* is a learned map applied to the photograph of the same pose; *C* is the same
map applied to the orthophoto and rendered. In B and C the marker has the temperature that the map predicts from its
colour: no map can know that it is heated. The pixels' thermal lag of about 10 ms is left out: at 9 Hz a frame does not
depend on the one before.
"""

import json
import time
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from examples.landing import sites
from examples.landing.guidance import BLIND_M, Steering, Tracker
from examples.landing.vehicle import flown, winds
from thermorender import formats
from thermorender.apps.compare import methods
from thermorender.errors import ThermorenderError
from thermorender.learned.temperature_map import load_model
from thermorender.output.photograph import photograph
from thermorender.render.renderer import Renderer
from thermorender.sensor.chain import in_sequence, sensor_of
from thermorender.versions import versions

LOG, SETTINGS = "runs.jsonl", "settings.json"
HEADER = ("frames", "runs", "acquired", "after [s]", "lost the marker", "landed", "median error [m]", "90 % [m]",
          "within 1 m", "elsewhere", "frame [ms]", "run [s]")  # fmt: skip
# Longest duration of a run [s], and height below which the vehicle has landed [m].
LONGEST_S, _DOWN_M = 20.0, 0.2
# Largest distance from the marker of a landing that counts as on it [m].
NEAR_M = 1.0
# Rotation of a camera that looks straight down with the top of the picture to the north: world_from_camera.
_NADIR = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])


@dataclass(frozen=True, eq=False)
class _Pose:
    """The part of a View that a Method uses."""

    pose: np.ndarray
    time_s: float
    visible: Any
    texel_m: float
    band_um: tuple[float, float]


def fly(folder, models, runs, progress=None, sizes=None, **settings):
    """Fly the runs that a folder lacks, and return all runs, a list of dict.

    Parameters
    ----------
    folder : path
        Folder of the worlds and of `runs.jsonl`, which has a line for each run and kind of frames.
    models : sequence of str
        Names or files of learned maps without extra inputs.
    runs : int
    progress : callable, optional
        Called with (step, share done).
    sizes : dict, optional
        Sides of the worlds, as in `sites.SIZES`.
    **settings
        Keywords of Renderer.

    Raises
    ------
    ThermorenderError
        A map with extra inputs, or a folder with runs of other settings.
    """
    report = progress or (lambda step, share: None)
    loaded = [(text, load_model(text)) for text in models]
    for _, model in loaded:
        if model.needs:
            raise ThermorenderError(
                f"models={model.name!r} takes hour and weather as input; give maps without extra inputs"
            )
    kinds = ["A", *(f"{letter} {model.name}" for _, model in loaded for letter in "BC")]
    names = [model.name for _, model in loaded]
    if len(set(names)) < len(names):
        raise ThermorenderError(f"models={','.join(names)} names a map twice; give each once")
    asked = {
        "settings": settings, "sizes": sizes or sites.SIZES, "thermorender": versions()["thermorender"],
        "models": {model.name: model.digest() for _, model in loaded},
    }  # fmt: skip
    log, done = folder / LOG, _flown(folder, json.loads(json.dumps(asked)))
    have = {(each["run"], each["frames"]) for each in done}
    for number in range(min(sites.WORLDS, runs)):
        own = [run for run in range(number, runs, sites.WORLDS) if any((run, kind) not in have for kind in kinds)]
        if not own:
            continue
        report(f"world {number}: making", number / sites.WORLDS)
        scene = sites.world(number, folder / "worlds" / str(number), sizes)
        made = _kinds(scene, loaded, settings)
        for count, run in enumerate(own):
            for kind in kinds:
                if (run, kind) not in have:
                    report(f"world {number}, run {run}: {kind}", (number + count / len(own)) / sites.WORLDS)
                    done.append(_landing(run, kind, made[kind], scene))
                    formats.append_json(log, done[-1])
    wanted = set(kinds)
    return [each for each in done if each["frames"] in wanted and each["run"] < runs]


def summary(found):
    """Return {kind of frames: statistics} of runs, as plain numbers."""
    statistics = {}
    for kind in dict.fromkeys(each["frames"] for each in found):
        own = [each for each in found if each["frames"] == kind]
        error = np.array([each["error_m"] for each in own if each["error_m"] is not None])
        acquired = [each["acquired_s"] for each in own if each["acquired_s"] is not None]
        statistics[kind] = {
            "runs": len(own), "acquired": len(acquired) / len(own),
            "acquired_s": float(np.median(acquired)) if acquired else None,
            "lost": sum(each["lost"] > 0 for each in own) / len(own),
            "landed": len(error) / len(own),
            "error_m": float(np.median(error)) if len(error) else None,
            "error_90_m": float(np.quantile(error, 0.9)) if len(error) else None,
            "near": float((error <= NEAR_M).sum() / len(own)),
            "elsewhere": float((error > NEAR_M).sum() / len(own)),
            "frame_ms": 1e3 * float(np.median([each["frame_s"] for each in own])),
            "run_s": float(np.median([each["wall_s"] for each in own])),
        }  # fmt: skip
    return statistics


def rows(statistics):
    """Return a summary as table rows of text under HEADER."""

    def text(value, form):
        return "none" if value is None else format(value, form)

    return [
        (kind, str(own["runs"]), f"{own['acquired']:.0%}", text(own["acquired_s"], ".2f"), f"{own['lost']:.0%}",
         f"{own['landed']:.0%}", text(own["error_m"], ".2f"), text(own["error_90_m"], ".2f"), f"{own['near']:.0%}",
         f"{own['elsewhere']:.0%}", f"{own['frame_ms']:.0f}", f"{own['run_s']:.1f}")
        for kind, own in statistics.items()
    ]  # fmt: skip


def _flown(folder, asked):
    """Return the runs in a folder; refuse runs of other settings, or of another map with the same name."""
    path, log = folder / SETTINGS, folder / LOG
    try:
        if log.is_file() and not path.is_file():
            raise ValueError("no settings")
        before = json.loads(formats.read_text(path)) if path.is_file() else {**asked, "models": {}}
        models = before["models"]
        same = all(before[name] == asked[name] for name in asked if name != "models")
        same &= all(models.get(name, digest) == digest for name, digest in asked["models"].items())
        done = formats.read_json_lines(log)
    except (ValueError, KeyError, TypeError):
        raise ThermorenderError(f"{folder} has files that are not landings; give another folder") from None
    if not same:
        raise ThermorenderError(f"{folder} has landings of other settings or maps; give another folder")
    formats.write_json(path, {**asked, "models": models | asked["models"], "versions": versions()})
    return done


def _kinds(scene, loaded, settings):
    """Return {kind of frames: (Renderer, Method or None)} of a world."""
    reference = Renderer(scene, **settings)
    made = {"A": (reference, None)}
    for text, model in loaded:
        flat = methods.translated(model)[0]
        solid = methods.rendered(scene, text, model, reference)[0]
        made[f"B {model.name}"], made[f"C {model.name}"] = (reference, flat), (reference, solid)
    return made


def _landing(run, kind, made, scene):
    """Return the record of one landing with one kind of frames, as plain numbers."""
    began = time.perf_counter()
    reference, method = made
    given = sites.conditions_of(run)
    camera = replace(scene.camera, netd_mk=scene.camera.netd_mk * given.noise)
    sensor, span = sensor_of(camera, run), 1.0 / camera.frame_rate_hz
    marker = next(item.item.position for item in scene.tracked_objects if item.name == sites.MARKER)
    base = float(scene.ground(*marker[:2]))
    hot = {sites.MARKER: {"temperature_k": sites.ground_around(scene, *marker[:2]) + given.contrast_k}}
    steps = int(LONGEST_S / span)
    wind = winds(np.array(given.wind_m_s), steps, span, np.random.default_rng([8405, run]))
    position = np.array([marker[0] + given.offset_m[0], marker[1] + given.offset_m[1], base + sites.START_M])
    velocity, pose = np.zeros(3), np.eye(4)
    pose[:3, :3] = _NADIR
    tracker, steering = Tracker(camera.focal_length_px, sites.MARKER_M), Steering(np.zeros(2))
    path, frame_s, acquired, lost, right, followed, landed = [], [], None, 0, 0, 0, None
    for step in range(steps):
        height = float(position[2] - scene.ground(*position[:2]))
        if not np.isfinite(height) or height <= _DOWN_M:
            landed = position if np.isfinite(height) else None
            break
        pose[:3, 3], when = position, step * span
        frame_began = time.perf_counter()
        if method is None:
            radiance = reference.radiance(pose, 0.0, hot)
        else:
            visible = photograph(reference, pose, 0.0)[0] if method.kind == "photograph" else None
            radiance = method.radiance(_Pose(pose, 0.0, visible, height / camera.focal_length_px, camera.band_um))
        frame_s.append(time.perf_counter() - frame_began)
        moment = in_sequence(camera, step, when)
        counts = sensor.counts(sensor.power(radiance, moment), moment)
        # Too near to be visible as a whole, the marker is neither followed nor lost.
        blind, before, offset = height < BLIND_M, tracker.locked, None
        spot = None if blind else tracker.look(counts, height)
        lost += before and not tracker.locked
        if spot is not None:
            slope = camera.directions(spot[::-1] + 0.5)
            offset = (_NADIR @ [*slope, 1.0])[:2] * height
            if tracker.locked:
                acquired = when if acquired is None else acquired
                followed += 1
                true = np.array(marker[:2]) - position[:2]
                right += bool(np.hypot(*(offset - true)) < NEAR_M + 0.05 * height)
        command = steering.command(offset if tracker.locked else None, height, span)
        path.append([*position, None if offset is None else offset.tolist()])
        position, velocity = flown(position, velocity, command, wind[step], span)
    error = None if landed is None else float(np.hypot(*(landed[:2] - np.array(marker[:2]))))
    return {
        "run": run, "frames": kind, "scene": scene.name, **asdict(given), "acquired_s": acquired, "lost": int(lost),
        "right": right / followed if followed else None, "error_m": error, "steps": len(path),
        "frame_s": float(np.median(frame_s)), "wall_s": time.perf_counter() - began,
        "path": [[round(float(value), 3) for value in place[:3]] for place in path],
    }  # fmt: skip


def write(found, folder):
    """Write the summary of runs to `landing.json` in their folder; return it."""
    statistics = summary(found)
    formats.write_json(folder / "landing.json", {"frames": statistics})
    return statistics
