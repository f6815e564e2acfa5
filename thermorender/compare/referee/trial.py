"""One scene's poses given to all of its methods: every method sees the same View, the same sensor, the same noise."""

from dataclasses import dataclass, field, replace

import numpy as np

from thermorender.compare.evaluation import sums
from thermorender.compare.referee import emissivities, methods, provenance, scores, views
from thermorender.compare.referee.structure import Registration, Structure, Track, transform
from thermorender.compare.referee.targets import Targets
from thermorender.compare.referee.terms import NAMES, terms_of
from thermorender.frame import apparent_temperature
from thermorender.output.record import weather_of
from thermorender.physics.sun import position_at
from thermorender.sensor.chain import sensor_of
from thermorender.sensor.readout import radiance_from_counts
from thermorender.units import ZERO_CELSIUS_K, utc_text

# A material is told whose band emissivity a rendered method has wrong by this on average, where it covers this share.
_EMISSIVITY, _SHARE = 0.02, 0.01


@dataclass
class Found:
    """What a method is found to do, over all scenes.

    Attributes
    ----------
    method : Method
        Without its renderers: what is told of it in the end is the same in all scenes.
    tally, targets, structure, explained
        Sums over all poses.
    gain : Gain
    scene_emissivities : dict of str to (4,) array
        Of a rendered method, as by `emissivities.of_scenes`.
    registered : Registration
        Of its pictures against the same map rendered.
    changes : (3,) array
        Number, sum and square sum of changes of the same ground from pose to pose [K].
    seconds : list of float
        What each pose took.
    circular : list of str
        Sentences.
    once_s : float
        What was needed once for each scene, all together [s].
    in_scenes : int
    """

    method: methods.Method
    tally: scores.Tally = field(default_factory=scores.Tally)
    targets: Targets = field(default_factory=Targets)
    structure: Structure = field(default_factory=Structure)
    explained: emissivities.Emissivities = field(default_factory=emissivities.Emissivities)
    gain: scores.Gain = field(default_factory=scores.Gain)
    scene_emissivities: dict = field(default_factory=dict)
    registered: Registration = field(default_factory=Registration)
    changes: np.ndarray = field(default_factory=lambda: np.zeros(3))
    seconds: list = field(default_factory=list)
    circular: list = field(default_factory=list)
    once_s: float = 0.0
    in_scenes: int = 0

    def summary(self, origin, seed):
        """Return what is told of the method, plain numbers.

        Parameters
        ----------
        origin : Provenance or None
        seed : int
            Of the intervals.
        """
        method, scored = self.method, bool(self.tally.poses)
        wrong = {
            name: {"share": row[0] / row[3], "used": row[1] / row[0], "true": row[2] / row[0]}
            for name, row in self.scene_emissivities.items()
            if abs(row[1] - row[2]) > _EMISSIVITY * row[0] and row[0] > _SHARE * row[3]
        }
        return {
            "letter": method.letter, "map": method.name, "bounds": method.bounds, "knows": method.knows,
            "true_objects": method.true_objects,
            "range_c": None if method.bounds != methods.OWN else
            [limit - ZERO_CELSIUS_K for limit in method.model.range_k],
            "once_s": self.once_s / max(self.in_scenes, 1), "scenes": len({name for _, name in self.tally.scenes}),
            "errors": self.tally.summary(seed) if scored else None,
            "groups": self.tally.grouped() if scored else {},
            "targets": self.targets.summary(), "structure": self.structure.summary(), "gain": self.gain.summary(),
            "registered": self.registered.summary(),
            "emissivities": {"told": self.explained.summary(), "scene": wrong},
            "steadiness_k": _deviation(self.changes),
            "seconds_per_frame": float(np.median(self.seconds)) if self.seconds else None,
            "training_s": None if origin is None else origin.told["training_s"],
            "training": None if origin is None else {**origin.told, "audited": origin.audited},
            "leaks": [] if origin is None else origin.leaks, "circular": self.circular,
        }  # fmt: skip


class Trial:
    """One scene's poses given to all of its methods.

    Parameters
    ----------
    flight : Flight
    land : str
        As by `training.lands_of`.
    reference : Renderer
        Of the true temperatures, or where none are known of the scene as it is.
    has_truth : bool
    made : sequence of Method
    campaign : Training or None
    found : dict of str to Found
        By label; gains those of this scene.
    targets : Targets
        Of the reference; gains those of this scene.
    pictures : Pictures
    seed : int
        Of the sensor's noise.
    frames : Frames
        Of the methods that are rendered.
    arrays : Path or None
        Folder of the frames that are kept.
    """

    def __init__(self, flight, land, reference, has_truth, made, campaign, found, targets, pictures, seed, frames,
                 arrays):  # fmt: skip
        self._flight, self._reference, self._has_truth, self._made = flight, reference, has_truth, made
        self._campaign, self._pictures, self._seed, self._arrays = campaign, pictures, seed, arrays
        self._targets, self._frames = targets, frames
        self.scene = reference.scene
        self._found = {}
        for method in made:
            # Renderers go with their scene; what is told of a method in the end is the same in all.
            plain = replace(method, build=None, paint=None)
            self._found[method.label] = found.setdefault(method.label, Found(plain))
            self._found[method.label].in_scenes += 1
        self._emissivity = emissivities.band_emissivities(self.scene)
        self._objects = [item.name for item in self.scene.spec.objects]
        self._land = land
        vertices = np.concatenate([s.vertices[:, :2] for s in self.scene.surfaces[: self.scene.terrain_count]])
        self._corners = np.stack([vertices.min(axis=0), vertices.max(axis=0)])
        self._pairs = self._between()
        self._terms = {name: np.zeros((len(NAMES) + 1, sums.WIDTH)) for name in self._pairs}
        self._apart = 0.0
        self._reference_structure, self._changes = Structure(), np.zeros(3)
        self.photographs = []
        self._between_methods, self._reports = {}, {}

    def _between(self):
        """{map: (its B, its C1)} by the best bounds that both have."""
        found = {}
        for method in self._made:
            if method.letter == "B":
                twins = [each for each in self._made if each.letter == "C1" and each.name == method.name
                         and each.bounds == method.bounds and not each.true_objects]  # fmt: skip
                if twins:
                    found[method.name] = method, twins[0]
        return found

    def run(self, table, say):
        """Give every pose to every method; `table` gains its rows."""
        flight, camera = self._flight, self.scene.camera
        sensor, before, seen_before = sensor_of(camera, self._seed), None, {}
        chosen = views.evenly(len(flight.times), provenance.PHOTOGRAPHS)
        self._render(say)
        for index, (time_s, pose) in enumerate(zip(flight.times, flight.poses, strict=True)):
            say("comparing", index / len(flight.times))
            view = views.view_of(self._reference, pose, time_s, index, self._has_truth)
            if index in chosen:
                self.photographs.append(view.visible)
            seen, read, counts = self._looked(view, sensor)
            if self._has_truth:
                true_counts = sensor.counts_at_rest(view.truth_radiance, index)
                true_read = apparent_temperature(radiance_from_counts(true_counts, camera), camera.band_um)
                self._targets.add(self.scene.name, view, self._objects, view.truth, true_counts)
                self._score(view, seen, read, counts, true_read, table)
            else:
                self._differences(view, seen)
            self._split(view, seen, read)
            if before is not None:
                self._follow(Track(before, view, camera), seen_before, seen, before, view)
            self._pictures.add(self.scene.name, view, seen, index, len(flight.times))
            if self._arrays is not None:
                self._keep(view, seen)
            before, seen_before = view, seen

    def _looked(self, view, sensor):
        """{label: what a method gives of a View}: apparent temperature, the same behind the sensor, and its counts."""
        seen, read, counts, camera, contrast = {}, {}, {}, self.scene.camera, None
        if self._has_truth:
            contrast = emissivities.contrast(view, self.scene.sky_temperature, camera.band_um)
        for method in self._made:
            own = self._found[method.label]
            if method.build is not None:
                radiance = self._frames.radiance(method, view.index)
            else:
                began = method.clock()
                radiance = method.radiance(view)
                own.seconds.append(method.clock() - began)
            image = seen[method.label] = apparent_temperature(radiance, camera.band_um)
            counts[method.label], read[method.label] = _read(radiance, sensor, camera, view.index)
            if self._has_truth and method.letter not in ("D", "E"):
                ground = view.known & (view.object < 0)
                own.explained.add(self.scene.name, view, contrast, radiance, image - view.truth, self._emissivity)
                own.gain.add(image[ground], view.truth[ground])
        return seen, read, counts

    def _keep(self, view, seen):
        """Write the frames of a View."""
        folder = self._arrays / "arrays"
        folder.mkdir(exist_ok=True)
        names = array_names(seen)
        named = {names[label]: image.astype(np.float32) for label, image in seen.items()}
        reference = {} if view.truth is None else {"reference": view.truth}
        path = folder / f"{self.scene.name}_{view.index:04d}.npz"
        np.savez_compressed(path, known=view.known, **reference, **named)

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
        for name, (flat, solid) in self._pairs.items():
            pictures = self._frames.terms(solid, view.index)
            parts = terms_of(pictures, seen[flat.label], seen[solid.label], read[flat.label], read[solid.label])
            whole, together = read[solid.label] - read[flat.label], sum(parts.values())
            # Where a step on the way has no temperature, nothing is split.
            known = view.known & np.isfinite(whole) & np.isfinite(together)
            pair = (transform(image, view.known) for image in (seen[flat.label], seen[solid.label]))
            self._found[flat.label].registered.add(*pair)
            self._apart = float(np.maximum(self._apart, np.abs(together - whole)[known].max(initial=0.0)))
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

    def _render(self, say):
        """Render the frames of all methods that are rendered, one after the other."""
        split = [solid.label for _, solid in self._pairs.values()]
        for method in self._made:
            if method.build is None:
                continue
            own = self._found[method.label]
            told = self._frames.rendered(method, self._described, method.label in split, say)
            own.once_s += told["once_s"]
            own.seconds += told["seconds"]
            own.circular += told["circular"]
            for name, row in told["emissivities"].items():
                own.scene_emissivities[name] = own.scene_emissivities.get(name, 0.0) + np.array(row)
            if told["report"]:
                self._reports[method.label] = told["report"]

    def _described(self, method):
        """What a rendered method's scene tells: whether the truth is its own, and emissivities beside the true ones."""
        scene = method.renderer.scene
        told = {"circular": [], "emissivities": {}, "report": dict(scene.temperature_state.report)}
        if self._has_truth and method.letter != "F":
            text = provenance.circular(scene, self.scene) if method.letter != "O" else None
            told["circular"] += [text] if text else []
            rows = emissivities.of_scenes(scene, self.scene)
            told["emissivities"] = {name: row.tolist() for name, row in rows.items()}
        return told

    def summary(self):
        """Return what is told of the scene, plain numbers."""
        scene, campaign = self.scene, self._campaign
        pairs = {}
        for name, (flat, solid) in self._pairs.items():
            rows = [sums.summary(row) for row in self._terms[name]]
            pairs[name] = {"from": flat.label, "to": solid.label,
                           "terms": dict(zip((*NAMES, "whole"), rows, strict=True))}  # fmt: skip
        spectrum = self._reference_structure.summary()["spectrum"] if self._has_truth else None
        return {
            "name": scene.name, "title": scene.spec.title, "land": self._land,
            "time": None if scene.time is None else utc_text(scene.time), **weather_of(scene),
            "sun_elevation_deg": _sun_elevation(scene),
            "digest": scene.digest(), "poses": len(self._flight.times), "reference": self._has_truth,
            "campaign": None if campaign is None else vars(campaign), "plan": self._reference.plan.as_dict(),
            "terms": pairs, "terms_apart_mk": 1e3 * self._apart, "spectrum": spectrum,
            "steadiness_k": _deviation(self._changes), "maps": self._reports,
            "differences": [{"one": one, "other": other, **sums.summary(row)}
                            for (one, other), row in self._between_methods.items()],
        }  # fmt: skip


def _sun_elevation(scene):
    """That of the sun at a scene's hour and place [deg], None where these are not known."""
    if scene.time is None or scene.frame is None:
        return None
    return float(position_at(scene.time, scene.frame.latitude_deg, scene.frame.longitude_deg)[1])


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


def array_names(labels):
    """Return {label: name in a `.npz`}: letters, digits, + and −, else underscores; numbered where two are alike."""
    found = {}
    for label in labels:
        plain = name = "".join(char if char.isalnum() or char in "+-" else "_" for char in label)
        number = 1
        while name in (*found.values(), "reference", "known"):
            number += 1
            name = f"{plain}_{number}"
        found[label] = name
    return found
