"""The trial of one scene: all of its methods at all of its poses, with the same View, sensor and noise."""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.compare import emissivities, findings, provenance, scores, sums
from thermorender.apps.compare.causes import Causes, Fitting
from thermorender.apps.compare.classes import GROUND, PixelClasses
from thermorender.apps.compare.figures import Pictures
from thermorender.apps.compare.frame_order import FrameOrder
from thermorender.apps.compare.frames import Frames
from thermorender.apps.compare.ground_intervals import side_of
from thermorender.apps.compare.methods import (
    BALANCE,
    FLAT,
    FOREIGN,
    OWN,
    PHOTOGRAPH,
    PRIVILEGED,
    TRUE_MATERIALS,
    Method,
)
from thermorender.apps.compare.registration import ALIKE, Appearance, Likeness, Registration, Track, transform
from thermorender.apps.compare.targets import Targets
from thermorender.apps.compare.terms import NAMES, terms_of
from thermorender.apps.compare.training import Training
from thermorender.apps.compare.view import Flight, Image, View, evenly, view_of
from thermorender.frame import apparent_temperature
from thermorender.output.provenance import weather_of
from thermorender.physics.sun import position_at
from thermorender.progress import Progress, Spread
from thermorender.render.renderer import Renderer
from thermorender.scene.scene import Scene
from thermorender.sensor.camera import Camera
from thermorender.sensor.chain import Sensor, sensor_of
from thermorender.sensor.readout import radiance_from_counts
from thermorender.units import ZERO_CELSIUS_K, utc_text

# A material is reported if a rendered method's band emissivity is wrong by more than this on average, and it covers at
# least this share of the ground.
_EMISSIVITY, _SHARE = 0.02, 0.01
# Sources of materials that are assumed: one for the whole scene, or those of a learned map.
_ASSUMED = ("constant", "material", "learned")


class Picture(NamedTuple):
    """A method's picture of a View."""

    seen: Image  # (H, W) apparent temperature [K]
    counts: NDArray[Any]  # (H, W) sensor counts
    read: Image  # (H, W) apparent temperature after the sensor [K]


@dataclass
class Results:
    """Results of a method, summed over all scenes."""

    method: Method  # Without renderer: the fields that the summary uses are equal in all scenes
    tally: scores.Tally = field(default_factory=scores.Tally)
    targets: Targets = field(default_factory=Targets)
    appearance: Appearance = field(default_factory=Appearance)
    causes: Causes = field(default_factory=Causes)  # Fits of some poses
    # Of the poses of another program that look unlike the reference
    likeness: Likeness = field(default_factory=Likeness)
    order: list[dict[str, Any]] = field(default_factory=list)  # Scenes in which its frames show other poses
    gain: scores.Gain = field(default_factory=scores.Gain)
    # For a rendered method, as `emissivities.of_scenes` returns them
    scene_emissivities: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    # Shift of its pictures against the same map rendered
    registered: Registration = field(default_factory=Registration)
    # (3,) number, sum and square sum of changes of the same ground from pose to pose [K]
    changes: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    seconds: list[float] = field(default_factory=list)  # Run time of each pose
    circular: list[str] = field(default_factory=list)  # Sentences
    once_s: float = 0.0  # Time needed once per scene, summed over scenes [s]
    in_scenes: int = 0

    def summary(self, origin: provenance.Provenance | None, seed: int) -> dict[str, Any]:
        """Return the results as plain numbers, with a map's Provenance and intervals of a seed."""
        method, errors = self.method, self.tally.summary(seed) if self.tally.views else None
        ends = errors[scores.RADIOMETRIC][GROUND].get("interval_95", {}).get("me_k") if errors else None
        own_range = method.model.range_k if method.model and method.bounds == OWN else None
        wrong = {
            name: {"share": row[0] / row[3], "used": row[1] / row[0], "true": row[2] / row[0]}
            for name, row in self.scene_emissivities.items()
            if abs(row[1] - row[2]) > _EMISSIVITY * row[0] and row[0] > _SHARE * row[3]
        }
        return {
            "kind": method.kind, "map": method.name, "bounds": method.bounds, "knows": method.knows,
            "true_objects": method.true_objects,
            "range_c": None if own_range is None else [limit - ZERO_CELSIUS_K for limit in own_range],
            "once_s": self.once_s / max(self.in_scenes, 1),
            "scenes": len({name for _, grouping, name in self.tally.groups if grouping == "scene"}),
            "errors": errors, "groups": self.tally.grouped() if errors else {},
            "targets": self.targets.summary(), "structure": self.appearance.summary(), "gain": self.gain.summary(),
            "registered": self.registered.summary(),
            "causes": self.causes.summary(partial(findings.said, method.kind, ends)), "emissivities": {"scene": wrong},
            "likeness": self.likeness.summary(), "order": self.order,
            "steadiness_k": _deviation(self.changes),
            "seconds_per_frame": float(np.median(self.seconds)) if self.seconds else None,
            "training_s": None if origin is None else origin.header["training_s"],
            "training": None if origin is None else {**origin.header, "audited": origin.audited},
            "leaks": [] if origin is None else origin.leaks, "circular": self.circular,
        }  # fmt: skip


@dataclass
class Totals:
    """Results of a comparison, summed over all scenes."""

    methods: dict[str, Results] = field(default_factory=dict)  # By label
    targets: Targets = field(default_factory=Targets)  # Targets of the reference
    table: list[tuple[Any, ...]] = field(default_factory=list)  # Rows of `pixels.csv`


@dataclass
class Setup:
    """A scene with its reference and methods."""

    flight: Flight
    land: str  # As `training.lands_of` names it
    reference: Renderer  # Renderer at the true temperatures, or of the scene as it is if they are unknown
    has_truth: bool
    campaign: Training | None
    frames: Frames  # Frames of the rendered methods
    methods: list[Method] = field(default_factory=list)


class Trial:
    """All methods of one scene at all of its poses; results are added to `totals`.

    `seed` is that of the sensor's noise, `arrays` the folder of frames; `photographs` (H, W, 3) are searched for
    training pictures. `times_s` are run times of frames that others measured, by name of the map or program [s].
    """

    def __init__(
        self,
        setup: Setup,
        totals: Totals,
        seed: int,
        arrays: Path | None,
        times_s: Mapping[str, float] = MappingProxyType({}),
    ) -> None:
        self._setup, self._totals, self._arrays, self._times_s = setup, totals, arrays, times_s
        self.scene: Scene = setup.reference.scene
        self._sensor = sensor_of(self.scene.camera, seed)
        self._results: dict[str, Results] = {}
        for method in setup.methods:
            # Without renderers, which belong to this scene.
            plain = replace(method, build=None, function=None)
            self._results[method.label] = totals.methods.setdefault(method.label, Results(plain))
            self._results[method.label].in_scenes += 1
        # A heat balance as the reference has errors of its own.
        self._computed = setup.has_truth and self.scene.balanced
        self._reference = "reference, computed" if self._computed else "reference"
        self._objects = [item.name for item in self.scene.spec.objects]
        self._cell_m: float | None = None
        self._pairs = self._twins()
        # Tiles have no radiances of texels, which terms need.
        terms = self._pairs if self.scene.world is None else ()
        self._terms = {name: np.zeros((len(NAMES) + 1, sums.WIDTH)) for name in terms}
        self._apart = 0.0
        self._appearance, self._changes = Appearance(), np.zeros(3)
        self._orders = {each.label: FrameOrder() for each in setup.methods if each.kind == FOREIGN}
        self.photographs: list[NDArray[np.uint8]] = []
        self._between_methods: dict[tuple[str, str], NDArray[np.float64]] = {}
        self._reports: dict[str, Any] = {}

    def _twins(self) -> dict[str, tuple[Method, Method]]:
        """Return {map: (it on the photograph, as kelvin with true materials)} with the best bounds that both have."""
        rendered = {(each.name, each.bounds): each for each in reversed(self._setup.methods)
                    if each.kind == TRUE_MATERIALS and not each.true_objects}  # fmt: skip
        return {each.name: (each, rendered[each.name, each.bounds]) for each in self._setup.methods
                if each.kind == PHOTOGRAPH and (each.name, each.bounds) in rendered}  # fmt: skip

    def run(self, pictures: Pictures | None, report: Progress, spread: Spread = map) -> None:
        """Score every method at every pose, add the scene's pictures, and render methods through `spread`."""
        flight = self._setup.flight
        before: tuple[View, dict[str, Picture]] | None = None
        chosen = evenly(len(flight.times), provenance.PHOTOGRAPHS)
        self._render(report, spread)
        fitting = Fitting(self.scene, self._setup.land, len(flight.times), pictures.scenes if pictures else 1)
        for index, (time_s, pose) in enumerate(zip(flight.times, flight.poses, strict=True)):
            report("comparing", index / len(flight.times))
            view = view_of(self._setup.reference, pose, time_s, index, self._setup.has_truth)
            if index in chosen:
                self.photographs.append(view.visible)
            taken = self._taken(view)
            if view.truth is not None:
                self._score(view, view.truth, taken, fitting)
            else:
                self._differences(view, taken)
            self._split(view, taken)
            if before is not None:
                self._follow(before, (view, taken))
            seen = {label: own.seen for label, own in taken.items()}
            if pictures is not None:
                pictures.add(self.scene.name, view, seen, len(flight.times), self._reference)
            if self._arrays is not None:
                self._keep(self._arrays / "arrays", view, seen)
            before = view, taken
        for label, order in self._orders.items():
            found = order.summary()
            self._results[label].order += [] if found is None else [{"scene": self.scene.name, **found}]

    def _taken(self, view: View) -> dict[str, Picture]:
        """Return {label: Picture} of a View."""
        taken: dict[str, Picture] = {}
        camera = self.scene.camera
        for method in self._setup.methods:
            own = self._results[method.label]
            radiance: Image
            if method.build is not None:
                radiance = self._setup.frames.radiance(method, view.index)
            else:
                began = method.clock()
                radiance = method.radiance(view)
                spent = method.clock() - began
                if method.kind in (FOREIGN, PHOTOGRAPH) and method.name in self._times_s:
                    own.seconds.append(self._times_s[method.name])
                elif method.kind != FOREIGN:
                    # The time to read another program's frame is not its own.
                    own.seconds.append(spent)
            image = apparent_temperature(radiance, camera.band_um)
            taken[method.label] = Picture(image, *_read(radiance, self._sensor, camera, view.index))
            if view.truth is not None and method.kind not in FLAT:
                own.gain.add(image[view.ground], view.truth[view.ground])
        return taken

    def _keep(self, folder: Path, view: View, seen: Mapping[str, Image]) -> None:
        """Write the frames of a View."""
        folder.mkdir(exist_ok=True)
        names = array_names(seen)
        arrays: dict[str, Any] = {names[label]: image.astype(np.float32) for label, image in seen.items()}
        reference: dict[str, Any] = {} if view.truth is None else {"reference": view.truth}
        path = folder / f"{self.scene.name}_{view.index:04d}.npz"
        np.savez_compressed(path, known=view.known, **reference, **arrays)

    def _score(self, view: View, truth: Image, taken: Mapping[str, Picture], fitting: Fitting) -> None:
        """Add the errors of all methods at a View, before and after the sensor."""
        assert view.truth_radiance is not None
        scene, land, camera = self.scene.name, self._setup.land, self.scene.camera
        true_counts = self._sensor.counts_at_rest(view.truth_radiance, view.index)
        true_read = apparent_temperature(radiance_from_counts(true_counts, camera), camera.band_um)
        self._totals.targets.add(scene, view, self._objects, truth, true_counts)
        if self._cell_m is None and view.ground.any():
            assert view.position is not None
            self._cell_m = side_of(view.position[view.ground])
        classes = PixelClasses(view, self._objects, self._cell_m)
        reference = transform(truth, view.known)
        self._appearance.add(reference, reference)
        for label, (image, counts, read) in taken.items():
            own = self._results[label]
            for stage, picture, true in ((scores.RADIOMETRIC, image, truth), (scores.SENSOR, read, true_read)):
                error = picture[view.known].astype(np.float64) - true[view.known]
                for surface, material, row in own.tally.add(view, stage, classes, error, scene, land):
                    errors = sums.summary(row)
                    self._totals.table.append((
                        scene, land, view.index, view.time_s, label, stage, surface, material, errors["pixels"],
                        errors["pixels_without_temperature"], errors["me_k"], errors["mae_k"], errors["rmse_k"],
                    ))  # fmt: skip
            spectrum = transform(image, view.known)
            shift = own.appearance.add(spectrum, reference)
            if own.method.kind == FOREIGN and (shift is None or abs(shift[2]) < ALIKE):
                own.likeness.add(spectrum, reference, image, (truth, view.visible.mean(axis=-1)), view.known)
            if not own.method.true_objects and own.method.kind not in FLAT:
                fitting.add(own.causes, view, image, shift, own.method.kind == FOREIGN)
            if label in self._orders:
                self._orders[label].add(image, truth, view.known)
            own.targets.add(scene, view, self._objects, image, counts)

    def _split(self, view: View, taken: Mapping[str, Picture]) -> None:
        """Add the shifts and the terms of the differences between a map on the photograph and as kelvin at a View."""
        for name, (method, rendered) in self._pairs.items():
            flat, solid = taken[method.label], taken[rendered.label]
            pair = (transform(each.seen, view.known) for each in (flat, solid))
            self._results[method.label].registered.add(*pair)
            if name not in self._terms:
                continue
            pictures = self._setup.frames.terms(rendered, view.index)
            parts = terms_of(pictures, flat.seen, solid.seen, flat.read, solid.read)
            whole = solid.read - flat.read
            together = sum(parts.values(), start=np.zeros(whole.shape, np.float32))
            # Pixels where a step has no temperature do not count.
            known = view.known & np.isfinite(whole) & np.isfinite(together)
            self._apart = float(np.maximum(self._apart, np.abs(together - whole)[known].max(initial=0.0)))
            for k, image in enumerate((*parts.values(), whole)):
                self._terms[name][k] += sums.row(image[known])

    def _differences(self, view: View, taken: Mapping[str, Picture]) -> None:
        labels = list(taken)
        for k, one in enumerate(labels):
            for other in labels[k + 1 :]:
                off = (taken[other].seen - taken[one].seen)[view.known]
                sums.into(self._between_methods, (one, other), sums.row(off))

    def _follow(self, before: tuple[View, dict[str, Picture]], after: tuple[View, dict[str, Picture]]) -> None:
        """Add the changes of the same ground points from one View to the next."""
        (earlier, was), (view, taken) = before, after
        track = Track(earlier, view, self.scene.camera)
        if earlier.truth is not None and view.truth is not None:
            self._changes += _moments(track.change(earlier.truth, view.truth))
        for label, own in taken.items():
            self._results[label].changes += _moments(track.change(was[label].seen, own.seen))

    def _render(self, report: Progress, spread: Spread) -> None:
        """Render the frames of all rendered methods, one method after the other or by a cluster."""
        split = frozenset(self._pairs[name][1].label for name in self._terms)
        # A report of every frame stays in this process.
        do = partial(_rendered, self._setup, split, report if spread is map else None)
        labels = [method.label for method in self._setup.methods if method.build is not None]
        for number, (label, facts) in enumerate(zip(labels, spread(do, labels), strict=True), 1):
            report("rendered methods", number / len(labels))
            own = self._results[label]
            own.once_s += facts["once_s"]
            own.seconds += facts["seconds"]
            own.circular += facts["circular"]
            for name, row in facts["emissivities"].items():
                sums.into(own.scene_emissivities, name, np.array(row))
            if facts["report"]:
                self._reports[label] = facts["report"]

    def summary(self) -> dict[str, Any]:
        """Return the results of the scene, as plain numbers."""
        scene, setup = self.scene, self._setup
        pairs = {}
        for name, parts in self._terms.items():
            flat, solid = self._pairs[name]
            rows = [sums.summary(row) for row in parts]
            pairs[name] = {"from": flat.label, "to": solid.label,
                           "terms": dict(zip((*NAMES, "whole"), rows, strict=True))}  # fmt: skip
        spectrum = self._appearance.summary()["spectrum"] if setup.has_truth else None
        return {
            "name": scene.name, "title": scene.spec.title, "land": setup.land,
            "time": None if scene.time is None else utc_text(scene.time), **weather_of(scene),
            "sun_elevation_deg": _sun_elevation(scene),
            "digest": scene.digest(), "poses": len(setup.flight.times), "reference": setup.has_truth,
            "computed": self._computed,
            "assumed_materials": not setup.has_truth or scene.spec.emissivity.source in _ASSUMED,
            "campaign": None if setup.campaign is None else vars(setup.campaign),
            "plan": setup.reference.plan.as_dict(), "planned": setup.reference.plan.rows(),
            "terms": pairs, "terms_apart_mk": 1e3 * self._apart, "spectrum": spectrum,
            "steadiness_k": _deviation(self._changes), "maps": self._reports,
            "differences": [{"one": one, "other": other, **sums.summary(row)}
                            for (one, other), row in self._between_methods.items()],
        }  # fmt: skip


def _rendered(setup: Setup, split: Collection[str], report: Progress | None, label: str) -> dict[str, Any]:
    """Render the frames of a rendered method; return its facts."""
    method = next(each for each in setup.methods if each.label == label)
    return setup.frames.rendered(method, partial(_described, setup), label in split, report or (lambda *_: None))


def _described(setup: Setup, method: Method) -> dict[str, Any]:
    """Return facts of a rendered method's scene: whether it made the truth, and its and the true emissivities."""
    scene, true = method.renderer.scene, setup.reference.scene
    facts: dict[str, Any] = {"circular": [], "emissivities": {}, "report": dict(scene.temperature_state.report)}
    if setup.has_truth and method.kind != BALANCE:
        text = provenance.circular(scene, true) if method.kind != PRIVILEGED else None
        facts["circular"] += [text] if text else []
        rows = emissivities.of_scenes(scene, true)
        facts["emissivities"] = {name: row.tolist() for name, row in rows.items()}
    return facts


def _sun_elevation(scene: Scene) -> float | None:
    """Return the sun's elevation at a scene's time and place [deg], None if these are unknown."""
    if scene.time is None or scene.frame is None:
        return None
    return float(position_at(scene.time, scene.frame.latitude_deg, scene.frame.longitude_deg)[1])


def _read(radiance: Image, sensor: Sensor, camera: Camera, index: int) -> tuple[NDArray[Any], Image]:
    """Return (counts, apparent temperature) of radiance (H, W) after a sensor; NaN where the radiance is unknown."""
    known = np.isfinite(radiance)
    middle = np.median(radiance[known]) if known.any() else 0.0
    # The median at unknown pixels keeps the optics from darkening their neighbours.
    counts = sensor.counts_at_rest(np.where(known, radiance, middle).astype(np.float32), index)
    seen = apparent_temperature(radiance_from_counts(counts, camera), camera.band_um)
    return counts, np.where(known, seen, np.float32(np.nan))


def _moments(change: Image) -> NDArray[np.float64]:
    finite = change[np.isfinite(change)].astype(np.float64)
    return np.array([finite.size, finite.sum(), (finite**2).sum()])


def _deviation(moments: NDArray[np.float64]) -> float | None:
    """Return the root mean square of changes [K], or None."""
    return float(np.sqrt(moments[2] / moments[0])) if moments[0] else None


def array_names(labels: Iterable[str]) -> dict[str, str]:
    """Return {label: name in a `.npz`}: letters, digits, + and −, underscores for others; numbered if not unique."""
    found: dict[str, str] = {}
    for label in labels:
        plain = name = "".join(char if char.isalnum() or char in "+-" else "_" for char in label)
        number = 1
        while name in (*found.values(), "reference", "known"):
            number += 1
            name = f"{plain}_{number}"
        found[label] = name
    return found
