"""A comparison from beginning to end: scenes, their campaigns, methods, poses, and what is written.

Two passes. The first reads thermal frames of every scene, for the bounds and means of the campaigns they belong to. The
second takes the scenes one by one: the reference is baked, each method made, and every pose given to all of them, with
the same sensor and the same noise.
"""

import csv
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from thermorender import files
from thermorender.errors import ThermorenderError
from thermorender.frame import apparent_temperature
from thermorender.learned.temperature_map import load_model
from thermorender.output.record import weather_of
from thermorender.physics.band import emitted_radiance
from thermorender.physics.planck import band_radiance
from thermorender.render.renderer import Renderer
from thermorender.render.spectrum import REFERENCE_K
from thermorender.sensor.chain import sensor_of
from thermorender.sensor.readout import radiance_from_counts
from thermorender.units import ZERO_CELSIUS_K, utc_text
from thermorender.validate.bench import machine
from thermorender.validate.evaluation import sums
from thermorender.validate.referee import emissivities, findings, methods, provenance, scores, training, views
from thermorender.validate.referee.page import write_page
from thermorender.validate.referee.pictures import Pictures
from thermorender.validate.referee.structure import Structure, Track, correlation, shift_of, transform
from thermorender.validate.referee.targets import Targets
from thermorender.validate.referee.terms import NAMES, Terms
from thermorender.versions import versions

COLUMNS = (
    "scene", "land", "pose", "time_s", "method", "stage", "surface", "material", "pixels", "pixels_without_temperature",
    "mean_error_k", "mean_absolute_error_k", "root_mean_square_error_k",
)  # fmt: skip
HEADER = ("method", "mean error [°C]", "mean absolute error [°C]", "95 %", "standard deviation [°C]", "pixels")
# A material is told whose band emissivity a method has wrong by this on average.
_EMISSIVITY = 0.02


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
    def of(cls, scene, trajectory, rate_hz=1.0):
        """Return that of a Trajectory, so many poses per second of it."""
        times = trajectory.frame_times(rate_hz)
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


@dataclass
class _Found:
    """What a method is found to do, over all scenes."""

    method: methods.Method
    tally: scores.Tally = field(default_factory=scores.Tally)
    targets: Targets = field(default_factory=Targets)
    structure: Structure = field(default_factory=Structure)
    explained: emissivities.Emissivities = field(default_factory=emissivities.Emissivities)
    scene_emissivities: dict = field(default_factory=dict)
    registered: list = field(default_factory=list)
    changes: np.ndarray = field(default_factory=lambda: np.zeros(3))
    seconds: list = field(default_factory=list)
    circular: list = field(default_factory=list)
    once_s: float = 0.0


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
    maps = _maps(models)
    others = [methods.Foreign(name, Path(place)) for name, place in (foreign or {}).items()]
    if not maps and not others:
        raise ThermorenderError("models is empty; give at least one learned map, or foreign frames")
    for other in others:
        for flight in flights:
            other.check(flight.scene.name, len(flight.times), len(flights) > 1)
    shown = (oracle, load_model(oracle)) if oracle else None
    asked = _Asked(frozenset(letters), maps, shown, others, emissivity or methods.learned_materials(), settings)
    known = [provenance.TrainingPictures(each, lambda share: tell("sketching training pictures", share))
             for each in datasets]  # fmt: skip
    began = time.perf_counter()
    thermals = _thermals(flights, seed, settings, tell)
    found, told, photographs, table, left_out = {}, [], {}, [], []
    with files.atomic_folder(folder) as draft:
        pictures, kept = Pictures(draft), draft if arrays else None
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
            made, missing = _methods(flight.scene, reference, truth is not None, asked, campaign, say)
            left_out += missing
            one = _Scene(flight, reference, truth is not None, made, campaign, found, pictures, seed, kept)
            one.run(table, say)
            told.append(one.summary())
            photographs[name] = one.photographs
        summary = {
            "scenes": told, "notes": [*_notes(told), *left_out], "methods": {}, "seed": seed, "machine": machine(),
            "settings": {key: str(value) for key, value in settings.items()}, "versions": versions(),
            "bounds": "refitted: eq. 2 on thermal frames of other lands in the same hour and weather",
        }  # fmt: skip
        origins = _origins(maps, known, photographs)
        for label, own in found.items():
            summary["methods"][label] = _summary(own, origins.get(own.method.name), seed)
        summary["findings"] = findings.of(summary)
        summary["seconds"] = time.perf_counter() - began
        with files.atomic(draft / "pixels.csv") as part, open(part, "w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(COLUMNS)
            writer.writerows(table)
        files.write_json(draft / "comparison.json", summary)
        write_page(draft / "report.html", summary, pictures.views)
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


def _maps(models):
    """[(name or file, TemperatureMap)] of names that differ."""
    loaded = [(text, load_model(text)) for text in models]
    called = [model.name for _, model in loaded]
    for name in called:
        if called.count(name) > 1:
            raise ThermorenderError(f"two of the models are called {name!r}; give maps of different names")
    return loaded


def _truth(scene):
    """The scene at its true temperatures, or None where it has none."""
    if scene.spec.truth_temperature is None and not scene.balanced:
        return None
    return scene.with_temperature(scene.truth_temperature_spec)


def _thermals(flights, seed, settings, tell):
    """The Thermal of each flight's scene; None where it has no truth, or no other scene could learn from it."""
    keys = [(training.campaign_of(flight.scene), training.land_of(flight.scene)) for flight in flights]
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
        found.append(training.thermal_of(truth, seen, seed))
    return found


def _methods(scene, reference, has_truth, asked, campaign, say):
    """(All Methods of a scene, what had to be left out and why, in sentences)."""
    bounds, settings = None if campaign is None else campaign.bounds_c, asked.settings
    made, left_out, learned = [], [], None
    if "C2" in asked.letters and scene.spec.terrain.orthophoto:
        say("telling materials from the orthophoto", 0.0)
        learned = scene.with_learned_materials(asked.emissivity)
    weathered = scene.spec.weather is not None and scene.frame is not None
    for text, model in asked.maps:
        say(f"preparing {model.name}", 0.0)
        if model.needs and not weathered:
            raise ThermorenderError(
                f"{scene.where}: learned map {model.name!r} is told hour and weather, which this scene does not have; "
                "add [weather], or leave the map out"
            )
        if "B" in asked.letters and not model.needs:
            made += methods.translated(model, bounds)
        if {"C1", "C2"} & asked.letters:
            true = "C1" in asked.letters
            made += methods.rendered(scene, text, model, reference, bounds, true, learned, settings)
    if asked.oracle is not None and weathered:
        made.append(methods.oracle(scene, *asked.oracle, reference, settings))
    if has_truth:
        painted = methods.painted(campaign, scene.camera.band_um)
        made += [each for each in painted if each.letter in asked.letters]
    if "F" in asked.letters and has_truth and weathered and not scene.balanced:
        say("solving the heat balance of tables", 0.0)
        try:
            made.append(methods.balanced(scene, reference, settings))
        except ThermorenderError as error:
            left_out.append(f"F, the heat balance of tables, is left out of {scene.name}: {error}")
    for method in made:
        if method.renderer is not None:
            say(f"solving the light of {method.label}", 0.0)
            # Once for a scene, and so not part of a frame's time.
            method.once_s = _timed(lambda each=method: each.renderer.baked)
    return made + [other.method(scene.name, scene.camera.band_um) for other in asked.others], left_out


class _Scene:
    """One scene's poses given to all of its methods."""

    def __init__(self, flight, reference, has_truth, made, campaign, found, pictures, seed, arrays):
        self._flight, self._reference, self._has_truth, self._made = flight, reference, has_truth, made
        self._campaign, self._pictures, self._seed, self._arrays = campaign, pictures, seed, arrays
        self.scene = reference.scene
        self._found = {}
        for method in made:
            # Renderers go with their scene; what is told of a method in the end is the same in all.
            plain = replace(method, renderer=None, paint=None)
            self._found[method.label] = found.setdefault(method.label, _Found(plain))
        self._objects = [item.name for item in self.scene.spec.objects]
        self._land = training.land_of(self.scene)
        vertices = np.concatenate([s.vertices[:, :2] for s in self.scene.surfaces[: self.scene.terrain_count]])
        self._corners = np.stack([vertices.min(axis=0), vertices.max(axis=0)])
        self._pairs = self._between()
        self._terms = {name: np.zeros((len(NAMES) + 1, sums.WIDTH)) for name in self._pairs}
        self._apart = 0.0
        self._reference_structure, self._changes = Structure(), np.zeros(3)
        self.photographs = []
        self._between_methods = {}

    def _between(self):
        """{map: (its B, its C1, Terms)} by the best bounds that both have."""
        found = {}
        for method in self._made:
            if method.letter == "B":
                twins = [each for each in self._made if each.letter == "C1" and each.name == method.name
                         and each.bounds == method.bounds and each.knows == "the materials"]  # fmt: skip
                if twins:
                    found[method.name] = method, twins[0]
        return {name: (flat, solid, Terms(solid)) for name, (flat, solid) in found.items()}

    def run(self, table, say):
        """Give every pose to every method; `table` gains its rows."""
        flight, camera = self._flight, self.scene.camera
        sensor, before, seen_before = sensor_of(camera, self._seed), None, {}
        chosen = views.evenly(len(flight.times), provenance.PHOTOGRAPHS)
        self._check_scenes()
        for method in self._made:
            self._found[method.label].once_s += method.once_s
        for index, (time_s, pose) in enumerate(zip(flight.times, flight.poses, strict=True)):
            say("comparing", index / len(flight.times))
            view = views.view_of(self._reference, pose, time_s, index, self._has_truth)
            if index in chosen:
                self.photographs.append(view.visible)
            seen, read, counts = {}, {}, {}
            contrast = (
                emissivities.contrast(view, self.scene.sky_temperature, camera.band_um) if self._has_truth else None
            )
            for method in self._made:
                began = time.perf_counter()
                radiance = method.radiance(view)
                self._found[method.label].seconds.append(time.perf_counter() - began)
                seen[method.label] = apparent_temperature(radiance, camera.band_um)
                counts[method.label], read[method.label] = _read(radiance, sensor, camera, index)
                if self._has_truth and method.letter not in ("D", "E"):
                    error = seen[method.label] - view.truth
                    self._found[method.label].explained.add(view, contrast, radiance, error)
            true_read = None
            if self._has_truth:
                true_counts = sensor.counts_at_rest(view.truth_radiance, index)
                true_read = apparent_temperature(radiance_from_counts(true_counts, camera), camera.band_um)
                self._score(view, seen, read, counts, true_read, table)
            else:
                self._differences(view, seen)
            self._split(view, seen, read)
            if before is not None:
                self._follow(Track(before, view, camera), seen_before, seen, before, view)
            self._pictures.add(self.scene.name, view, seen, index, len(flight.times))
            if self._arrays is not None:
                out = self._arrays / "arrays"
                out.mkdir(exist_ok=True)
                named = {_file_name(label): image.astype(np.float32) for label, image in seen.items()}
                reference = {} if view.truth is None else {"reference": view.truth}
                np.savez_compressed(out / f"{self.scene.name}_{index:04d}.npz", known=view.known, **reference, **named)
            before, seen_before = view, seen

    def _score(self, view, seen, read, counts, true_read, table):
        classes = scores.PixelClasses(view, self._objects, self._corners)
        reference = transform(view.truth, view.known)
        self._reference_structure.add(reference, reference)
        for label, image in seen.items():
            own = self._found[label]
            stages = ((scores.RADIOMETRIC, image, view.truth), (scores.SENSOR, read[label], true_read))
            for stage, picture, truth in stages:
                error = picture[view.known].astype(np.float64) - truth[view.known]
                for surface, material, row in own.tally.add(self.scene.name, self._land, view, stage, classes, error):
                    told = sums.summary(row)
                    table.append((self.scene.name, self._land, view.index, view.time_s, label, stage, surface, material,
                                 told["pixels"], told["pixels_without_temperature"], told["me_k"], told["mae_k"],
                                 told["rmse_k"]))  # fmt: skip
            own.structure.add(transform(image, view.known), reference)
            own.targets.add(self.scene.name, view, self._objects, image, counts[label])

    def _split(self, view, seen, read):
        for name, (flat, solid, terms) in self._pairs.items():
            parts = terms.of(view, seen[flat.label], seen[solid.label], read[flat.label], read[solid.label])
            whole = read[solid.label] - read[flat.label]
            known = view.known & np.isfinite(whole)
            pair = (transform(image, view.known) for image in (seen[flat.label], seen[solid.label]))
            self._found[flat.label].registered.append(correlation(*pair))
            together = sum(parts.values())
            self._apart = max(self._apart, float(np.abs(together - whole)[known].max(initial=0.0)))
            for k, image in enumerate((*parts.values(), whole)):
                self._terms[name][k] += sums.row(image[known])

    def _differences(self, view, seen):
        labels = list(seen)
        for k, one in enumerate(labels):
            for other in labels[k + 1 :]:
                off = (seen[other] - seen[one])[view.known]
                row = self._between_methods.setdefault((one, other), np.zeros(sums.WIDTH))
                row += sums.row(off)

    def _follow(self, track, seen_before, seen, before, view):
        if self._has_truth:
            self._changes += _moments(track.change(before.truth, view.truth))
        for label, image in seen.items():
            self._found[label].changes += _moments(track.change(seen_before[label], image))

    def _check_scenes(self):
        """Find emissivities that a rendered method has otherwise than the reference, and a truth that is its own."""
        if not self._has_truth:
            return
        for method in self._made:
            if method.renderer is None or method.letter == "F":
                continue
            own = self._found[method.label]
            text = provenance.circular(method.renderer.scene, self.scene) if method.letter != "O" else None
            own.circular += [text] if text else []
            for name, row in _emissivity_differences(method.renderer.scene, self.scene).items():
                own.scene_emissivities[name] = own.scene_emissivities.get(name, 0.0) + row

    def summary(self):
        """Return what is told of the scene, plain numbers."""
        scene, campaign = self.scene, self._campaign
        pairs = {}
        for name, (flat, solid, _) in self._pairs.items():
            rows = [sums.summary(row) for row in self._terms[name]]
            pairs[name] = {"from": flat.label, "to": solid.label,
                           "terms": dict(zip((*NAMES, "whole"), rows, strict=True))}  # fmt: skip
        spectrum = self._reference_structure.summary()["spectrum"] if self._has_truth else None
        return {
            "name": scene.name, "title": scene.spec.title, "land": self._land,
            "time": None if scene.time is None else utc_text(scene.time), **weather_of(scene),
            "digest": scene.digest(), "poses": len(self._flight.times), "reference": self._has_truth,
            "campaign": None if campaign is None else vars(campaign), "plan": self._reference.plan.as_dict(),
            "terms": pairs, "terms_apart_mk": 1e3 * self._apart, "spectrum": spectrum,
            "steadiness_k": _deviation(self._changes), "maps": _reports(self._made),
            "differences": [{"one": one, "other": other, **sums.summary(row)}
                            for (one, other), row in self._between_methods.items()],
        }  # fmt: skip


def _read(radiance, sensor, camera, index):
    """(Counts, apparent temperature) of radiance (H, W) behind a sensor; NaN where there is none to begin with."""
    known = np.isfinite(radiance)
    middle = np.median(radiance[known]) if known.any() else 0.0
    # What is not there must not chill what is, through the lens.
    counts = sensor.counts_at_rest(np.where(known, radiance, middle).astype(np.float32), index)
    seen = apparent_temperature(radiance_from_counts(counts, camera), camera.band_um)
    return counts, np.where(known, seen, np.float32(np.nan))


def _moments(change):
    finite = change[np.isfinite(change)].astype(np.float64)
    return np.array([finite.size, finite.sum(), (finite**2).sum()])


def _deviation(moments):
    """Root mean square of changes [K], or None."""
    return float(np.sqrt(moments[2] / moments[0])) if moments[0] else None


def _emissivity_differences(own, true):
    """{material: (texels, Σ emissivity used, Σ true emissivity, texels in all)} of the terrain, by true material."""
    band = true.camera.band_um
    black = band_radiance(REFERENCE_K, *band)
    used, known = (
        np.array([emitted_radiance(each.emissivity_at, REFERENCE_K, *band) / black for each in scene.materials])
        for scene in (own, true)
    )
    found, total = {}, 0
    for mine, theirs in zip(own.surfaces[: own.terrain_count], true.surfaces, strict=False):
        material = theirs.material.ravel()
        total += material.size
        count = np.bincount(material, minlength=256)
        mine_sum = np.bincount(material, used[mine.material.ravel()], 256)
        for number in np.flatnonzero(count):
            row = np.array([count[number], mine_sum[number], count[number] * known[number], 0.0])
            name = true.materials[number].name
            found[name] = found.get(name, 0.0) + row
    return {name: row + [0.0, 0.0, 0.0, total] for name, row in found.items()}


def _reports(made):
    """{label: what the map has to tell of a rendered scene}."""
    return {method.label: method.renderer.scene.report for method in made
            if method.renderer is not None and method.renderer.scene.report}  # fmt: skip


def _origins(maps, known, photographs):
    """{map: Provenance}, audited against the training pictures that are at hand."""
    found = {}
    for _, model in maps:
        own = provenance.provenance_of(model)
        pictures = provenance.matched(known, model)
        if pictures is not None:
            pictures.audit(own, photographs)
        found[model.name] = own
    return found


def _summary(own, origin, seed):
    """What is told of a method, plain numbers."""
    method, scored = own.method, bool(own.tally.poses)
    emissivity = {
        name: {"share": row[0] / row[3], "used": row[1] / row[0], "true": row[2] / row[0]}
        for name, row in own.scene_emissivities.items() if abs(row[1] - row[2]) > _EMISSIVITY * row[0]
        and row[0] > 0.01 * row[3]
    }  # fmt: skip
    mean = {name: row[4] / row[0] for name, row in own.explained.rows.items() if row[0]}
    return {
        "letter": method.letter, "map": method.name, "bounds": method.bounds, "knows": method.knows,
        "range_c": None if method.bounds != methods.PUBLISHED else
        [limit - ZERO_CELSIUS_K for limit in method.model.range_k],
        "once_s": own.once_s, "scenes": len({name for _, name in own.tally.scenes}),
        "errors": own.tally.summary(seed) if scored else None,
        "groups": own.tally.grouped() if scored else {},
        "targets": own.targets.summary(), "structure": own.structure.summary(), "registered": shift_of(own.registered),
        "emissivities": {"told": own.explained.summary(), "scene": emissivity, "error_k": mean},
        "steadiness_k": _deviation(own.changes),
        "seconds_per_frame": float(np.median(own.seconds)) if own.seconds else None,
        "training_s": None if origin is None else origin.told["training_s"],
        "training": None if origin is None else {**origin.told, "audited": origin.audited},
        "leaks": [] if origin is None else origin.leaks, "circular": own.circular,
    }  # fmt: skip


def _timed(call):
    began = time.perf_counter()
    call()
    return time.perf_counter() - began


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
    lands = len({each["land"] for each in told})
    notes.append(f"Intervals are 95 %, of poses or of blocks of ground drawn anew, the wider of the two. They hold for "
                 f"{'this land' if lands == 1 else f'these {lands} lands'}: another land is another draw.")  # fmt: skip
    return notes


def _file_name(label):
    return "".join(char if char.isalnum() or char in "+-" else "_" for char in label)
