"""Evaluation of learned maps on a data set, in kelvin: the comparison with measured frames as reference.

The error is a method's apparent temperature minus the true one. Maps are not refitted. Sky pixels, where marked, are
reported separately. All methods get the same pairs; missing ones are counted.

The *floor* is the smallest error that a map can reach, from a view rendered again with redrawn hidden state (moisture,
roughness, material properties). With T = f + a and T′ = f + b, where f is the mean given the inputs and a, b are
independent draws, f is the best prediction and a its error. For a Gaussian, the mean of |a| is that of |T − T′| over
√2; for other distributions of mean zero, it is between half of the latter and the whole.
"""

import hashlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender import files, formats
from thermorender.apps.compare import evaluation_report, figures, structure, sums
from thermorender.apps.compare.classes import EDGES, GROUND, MAN_MADE, NATURAL, PixelClasses, picture_classes
from thermorender.apps.compare.foreign import Foreign
from thermorender.apps.compare.machine import forget_peak_memory, machine, peak_memory_mib
from thermorender.apps.compare.methods import Method, constant, own_mean, per_material
from thermorender.apps.compare.scores import RADIOMETRIC, Tally
from thermorender.apps.compare.training import TrainingPart, read_training_part
from thermorender.apps.compare.view import Image, Levels, PairViews, View
from thermorender.apps.training.audit import audit
from thermorender.apps.training.dataset import Dataset, Entry, ThermalScale
from thermorender.apps.training.map_inputs import inputs_of
from thermorender.apps.training.training_pictures import Search, searches_in
from thermorender.errors import ThermorenderError
from thermorender.frame import apparent_temperature
from thermorender.learned.temperature_map import Inputs, TemperatureMap, load_model
from thermorender.progress import Progress, Spread
from thermorender.versions import versions

# The pairs at these quantiles of the first map's mean absolute error are drawn.
SHOWN = (0.05, 0.25, 0.5, 0.75, 0.95)
# Keys that distinguish two trainings, besides the method; the seed is not one of them.
_KEYS = ("dataset", "pairs", "sequences", "conditions", "bounds", "share", "shift_px", "options")


@dataclass
class Spent:
    """The cost of a map's predictions, and how far it knows its own errors."""

    seconds_per_mpixel: list[float] = field(default_factory=list)  # Run time of each prediction
    peak_mib: float | None = None  # Peak memory of the process during a prediction
    # (5,) for maps that predict a standard deviation σ for each pixel: number of pixels, of errors within σ and within
    # 2 σ, Σσ² and Σ of squared errors [K²]
    covered: NDArray[np.float64] = field(default_factory=lambda: np.zeros(5))
    # (2, sums.WIDTH) for maps that flag colours absent from training: sums of errors of the other and of the flagged
    # pixels
    unseen: NDArray[np.float64] = field(default_factory=lambda: np.zeros((2, sums.WIDTH)))

    def add(self, more: "Spent") -> None:
        """Add that of other predictions."""
        self.seconds_per_mpixel += more.seconds_per_mpixel
        self.peak_mib = max(filter(None, (self.peak_mib, more.peak_mib)), default=None)
        self.covered += more.covered
        self.unseen += more.unseen

    def summary(self, model: TemperatureMap) -> dict[str, Any]:
        """Return {seconds_per_mpixel (median), peak_memory_mib, training_s, covered, unseen}; None where absent."""
        covered = unseen = None
        pixels, one, two, variances, squares = map(float, self.covered)
        if pixels:
            covered = {
                "within_1": one / pixels, "within_2": two / pixels,
                "predicted_rms_k": np.sqrt(variances / pixels), "rmse_k": np.sqrt(squares / pixels),
            }  # fmt: skip
        if self.unseen.any():
            rest, own = (sums.summary(row) for row in self.unseen)
            share = own["pixels"] / max(own["pixels"] + rest["pixels"], 1)
            unseen = {"share": share, "mae_k": own["mae_k"], "elsewhere_k": rest["mae_k"]}
        seconds = self.seconds_per_mpixel
        return {
            "seconds_per_mpixel": float(np.median(seconds)) if seconds else None, "peak_memory_mib": self.peak_mib,
            "training_s": model.about.get("training_s"), "covered": covered, "unseen": unseen,
        }  # fmt: skip


@dataclass
class LearnedMap(Method):
    """A TemperatureMap applied to the picture of a pair; `spent` is the cost of its last prediction."""

    spent: Spent = field(default_factory=Spent)

    @classmethod
    def of(cls, name: str, model: TemperatureMap, privileged: bool = False) -> "LearnedMap":
        """Return a map by the name in tables; a privileged one takes the material as input."""
        knows, kind = ("the material", "privileged") if privileged else (", ".join(model.needs), "map")
        return cls(kind, name, knows=knows, model=model)

    def temperature(self, view: View) -> Image:
        """Return its apparent temperature, (H, W) float32 [K]."""
        assert self.model is not None and view.pair is not None and view.truth is not None
        inputs = inputs_of(view.pair, view.card or {}, material=self.kind == "privileged")
        forget_peak_memory()
        began = time.perf_counter()
        radiance, spread = self.model.translated(inputs)
        self.spent = Spent([(time.perf_counter() - began) / (radiance.size / 1e6)], peak_memory_mib())
        seen: NDArray[np.float32] = apparent_temperature(radiance, self.model.band_um)
        self._doubt(inputs, seen[view.known].astype(np.float64) - view.truth[view.known], spread, view.known)
        return seen

    def _doubt(
        self, inputs: Inputs, error: NDArray[np.float64], spread: Image | None, known: NDArray[np.bool_]
    ) -> None:
        """Compare the map's predicted standard deviations and flags with its errors."""
        if spread is not None:
            here = np.isfinite(error)
            off, sigma = np.abs(error[here]), spread[known][here]
            self.spent.covered += [off.size, (off <= sigma).sum(), (off <= 2.0 * sigma).sum(), (sigma**2).sum(),
                                   (off**2).sum()]  # fmt: skip
        predictor = self.model.predictor if self.model else None
        if predictor is not None and hasattr(predictor, "unseen"):
            self.spent.unseen += sums.rows_by(error, predictor.unseen(inputs)[known].astype(np.intp), 2)


def baselines(training: TrainingPart) -> list[Method]:
    """Return the baselines that every map is compared with; some know more than a map can."""
    mean_k, material_k = training.mean_k, training.material_k

    def constant_of_part(view: View) -> Image | None:
        return None if mean_k is None else constant(mean_k)(view)

    def material(view: View) -> Image | None:
        if mean_k is None or view.pair is None or "material" not in view.pair.truth:
            return None
        return per_material(mean_k, material_k)(view)

    def air(view: View) -> Image | None:
        kelvin = view.pair.entry.conditions.get("air_k") if view.pair else None
        return None if kelvin is None else constant(kelvin)(view)

    def balance(view: View) -> Image | None:
        return _plane(view, "balance")

    def floor(view: View) -> Image | None:
        redrawn = _plane(view, "redrawn")
        return None if redrawn is None or view.truth is None else view.truth + (redrawn - view.truth) / np.sqrt(2.0)

    return [
        Method(kind, name, knows=knows, function=function)
        for name, kind, knows, function in (
            ("constant: mean of the training part", "baseline", "", constant_of_part),
            ("the frame's own mean", "baseline", "the truth's mean", own_mean),
            ("mean per material", "baseline", "the material", material),
            ("air temperature", "baseline", "the weather", air),
            ("heat balance of tables", "baseline", "shape, material, weather", balance),
            ("floor: hidden state redrawn, over √2", "floor", "all but the hidden state", floor),
        )
    ]


def _plane(view: View, name: str) -> Image | None:
    """Return the apparent temperature of a radiance among a pair's planes, (H, W) [K]."""
    radiance = view.pair.truth.get(name) if view.pair else None
    return None if radiance is None else apparent_temperature(radiance, view.band_um)


def evaluate(
    dataset: Dataset,
    models: Sequence[str | Path],
    folder: str | PathLike[str],
    privileged: str | Path | None = None,
    foreign: Mapping[str, str | PathLike[str]] | None = None,
    split: Mapping[str, str] | None = None,
    part: str = "test",
    limit: int | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    spread: Spread = map,
    leaks: bool = True,
) -> dict[str, Any]:
    """Evaluate learned maps (names or files) on a part of a data set; return the result, which is also written.

    The new `folder` is written whole or not at all: `evaluation.json`, `evaluation.md` and figures. `privileged` is the
    file of a map that takes the material as input, `foreign` {name: folder} other programs' pictures. `split` {key:
    part} replaces the data set's. `limit` is the number of pairs to score, evenly spaced, and of training pairs to
    read; `seed` is the bootstrap's. `leaks` says whether the pictures are searched for those of training. `progress`
    takes (step, share done); `spread` (do, units) → do(unit) of each, in order.
    """
    if not models:
        raise ThermorenderError("models is empty; give at least one learned map, by its name or file")
    report = progress or (lambda step, share: None)
    if split is not None:
        dataset = dataset.split(split)
    scored, train = (_limited(dataset.of(each), limit) for each in (part, "train"))
    if not scored.entries:
        raise ThermorenderError(f"{dataset.folder} has no pairs of part {part!r}; give another --part, or a --split")
    maps = _maps(models, privileged)
    began, levels = time.perf_counter(), Levels(dataset.scale)
    views = PairViews(scored, levels)
    # The maps were trained on the pairs that `limit` leaves out, too.
    audited = _audit(dataset.of("train"), scored) if leaks and part != "train" and train.entries else None
    training = read_training_part(train, levels, lambda share: report("reading the training part", share))
    bounds = training.bounds_k or _model(maps[0]).range_k
    seen = _training_pictures([_model(each) for each in maps], scored, report, leaks)
    drawn = [*maps, *_foreign(foreign or {}, views)]
    scores = _scores(views, [*drawn, *baselines(training)], bounds, report, spread)
    texts = [*models, *([privileged] if privileged else [])]
    result = {
        "part": part, "split": "given" if split is not None else "the data set's own", "limit": limit, "seed": seed,
        "training_pairs": training.pairs, "bounds_k": list(bounds), "audit": audited,
        "training_pictures": {each.label: own.summary() for each, own in zip(maps, seen, strict=True)},
        **_result(dataset, scored, maps, texts, scores, seed),
    }  # fmt: skip
    with files.atomic_folder(folder) as draft:
        for number, share in _quantiles(scores[0].rows).items():
            view = views[number]
            guesses = {each.label: image for each in drawn if (image := each.temperature(view)) is not None}
            name = f"errors_{round(100 * share):02d}_{scored.entries[number].key}.png"
            figures.picture(draft / name, view, guesses, share)
        figures.against_time(draft / "error_against_time.png", result)
        result["seconds"] = time.perf_counter() - began
        evaluation_report.write(draft / "evaluation.md", result)
        formats.write_json(draft / "evaluation.json", result)
    return result


def _model(method: Method) -> TemperatureMap:
    assert method.model is not None
    return method.model


def _foreign(folders: Mapping[str, str | PathLike[str]], views: PairViews) -> list[Method]:
    """Return the pictures of other programs as methods."""
    entries = views.dataset.entries
    others = [Foreign.of_pairs(name, Path(place), entries) for name, place in folders.items()]
    return [
        Method("foreign", each.name if each.scaled else f"{each.name} after its best affine fit",
               knows="" if each.scaled else "the truth, by two numbers",
               function=each.fitted(views).temperature) for each in others
    ]  # fmt: skip


@dataclass
class _Score:
    """The errors of one method in some pairs."""

    method: Method
    tally: Tally = field(default_factory=Tally)
    spent: Spent = field(default_factory=Spent)
    pairs: int = 0  # Number of pairs of which it has a picture

    @property
    def rows(self) -> NDArray[np.float64]:
        """Sums of each pair, (P, 5); 0 where the method has no picture."""
        return np.array(self.tally.views[RADIOMETRIC, GROUND])

    def summary(
        self, entries: Sequence[Entry], materials: Sequence[str], cluster: NDArray[np.intp], seed: int
    ) -> dict[str, Any]:
        """Return the statistics of the method, as plain numbers."""
        method, rows = self.method, self.rows
        groups: dict[str, dict[str, Any]] = {}
        for entry, row in zip(entries, rows, strict=True):
            for grouping, name in picture_classes(entry).items():
                own = groups.setdefault(grouping, {})
                own[name] = own.get(name, 0.0) + row
        by_material, edges = (self.tally.of(RADIOMETRIC, name) for name in ("material", "edges"))
        groups["material"] = {name: by_material[name] for name in materials if name in by_material}
        groups["surface"] = {}
        for surface, members in (("man-made", MAN_MADE), ("natural", NATURAL)):
            own_rows = [row for name, row in groups["material"].items() if name in members]
            if own_rows:
                groups["surface"][surface] = sum(own_rows)
        groups["surface"] |= self.tally.of(RADIOMETRIC, "sky")
        groups["edges"] = {name: edges.get(name, np.zeros(sums.WIDTH)) for name in EDGES}
        return {
            "kind": method.kind, "knows": method.knows, "pairs": self.pairs,
            **sums.summary(rows.sum(axis=0)),
            "interval_95": sums.intervals(rows, cluster, seed),
            "structure": structure.summary(self.tally.structure, cluster, seed),
            **structure.similarity(self.tally.similarity),
            **(self.spent.summary(method.model) if method.model else {}),
            "groups": {grouping: {name: sums.summary(own[name]) for name in sorted(own)}
                       for grouping, own in groups.items() if own},
        }  # fmt: skip


def _scores(
    views: PairViews, methods: Sequence[Method], bounds: tuple[float, float], report: Progress, spread: Spread
) -> list[_Score]:
    """Return the score of each method over all Views, scored by `spread`."""
    total = [_Score(method) for method in methods]
    for number, found in enumerate(spread(partial(_score, views, methods, bounds), range(len(views)))):
        report("scoring", (number + 1) / len(views))
        for one, (tally, spent, has) in zip(total, found, strict=True):
            one.tally.merge(tally)
            one.spent.add(spent)
            one.pairs += has
    return total


def _score(
    views: PairViews, methods: Sequence[Method], bounds: tuple[float, float], number: int
) -> list[tuple[Tally, Spent, bool]]:
    """Return every method's (errors, cost, whether it has a picture) in View number `number`."""
    view = views[number]
    known, truth, sky = view.known, view.truth, view.sky
    assert truth is not None and sky is not None
    alike = structure.Similarity(structure.eight_bit(truth, bounds), known)
    classes = PixelClasses(view)
    scores = []
    for method in methods:
        guess, tally = method.temperature(view), Tally()
        # The floor is an error estimate, not a picture to compare.
        if guess is None or method.kind == "floor":
            tally.structure.append(np.full(structure.WIDTH, np.nan))
        else:
            tally.structure.append(structure.row(guess, truth, known))
            tally.similarity += alike.row(structure.eight_bit(guess, bounds))
        if guess is None:
            tally.views[RADIOMETRIC, GROUND] = [np.zeros(sums.WIDTH)]
        else:
            tally.add(view, RADIOMETRIC, classes, guess[known].astype(np.float64) - truth[known])
            if sky.any():
                off = guess[sky].astype(np.float64) - truth[sky]
                tally.into((RADIOMETRIC, "sky", "sky, not scored"), sums.row(off))
        scores.append((tally, method.spent if isinstance(method, LearnedMap) else Spent(), guess is not None))
    return scores


def _result(
    dataset: Dataset,
    scored: Dataset,
    maps: Sequence[LearnedMap],
    texts: Sequence[str | Path],
    scores: Sequence[_Score],
    seed: int,
) -> dict[str, Any]:
    """Return the part of the result that follows from the scores; `texts` are the maps' names or files."""
    entries = scored.entries
    cluster, drawn = sums.clusters(entries)
    materials = scored.card.get("materials", [])
    return {
        "dataset": {
            "folder": str(dataset.folder), "card_sha256": _digest(dataset.folder / "card.json"),
            "title": dataset.card.get("title", dataset.card.get("name")), "thermal": dataset.card["thermal"],
        },
        "pairs": len(scored),
        "parts": {name: len(dataset.of(name)) for name in dict.fromkeys(entry.part for entry in dataset.entries)},
        "notes": _notes(dataset.scale, maps, entries), "drawn": drawn,
        "methods": {each.method.label: each.summary(entries, materials, cluster, seed) for each in scores},
        "differences": _differences(maps, [each.rows for each in scores[: len(maps)]], cluster, seed),
        "images": {
            entry.key: {each.method.label: _brief(row) for each in scores
                        if (row := each.tally.views[RADIOMETRIC, GROUND][number]).any()}
            for number, entry in enumerate(entries)
        },
        "models": {each.label: _header(_model(each), text) for each, text in zip(maps, texts, strict=True)},
        "published": evaluation_report.PUBLISHED, "machine": machine(), "versions": versions(),
    }  # fmt: skip


def _maps(models: Sequence[str | Path], privileged: str | Path | None) -> list[LearnedMap]:
    """Return the maps of names and files, with unique labels."""
    loaded = [load_model(model) for model in models]
    names = [model.name for model in loaded]
    labels = [name if names.count(name) == 1 else f"{name} ({text})" for name, text in zip(names, models, strict=True)]
    if len(set(labels)) < len(labels):
        raise ThermorenderError(f"models {', '.join(map(str, models))} name one map twice; give each once")
    found = [LearnedMap.of(label, model) for label, model in zip(labels, loaded, strict=True)]
    if privileged:
        model = load_model(privileged)
        found.append(LearnedMap.of(f"privileged {model.name}", model, privileged=True))
    return found


def kin(maps: Sequence[LearnedMap]) -> list[list[int]]:
    """Return groups of numbers of maps whose trainings differ only in the seed, in the given order."""
    groups: dict[tuple[str, int | None], list[int]] = {}
    seeds = set()
    for number, each in enumerate(maps):
        model = _model(each)
        training = [model.method, each.kind == "privileged", *(model.about.get(name) for name in _KEYS)]
        alike, seed = json.dumps(training, sort_keys=True), model.about.get("seed")
        # Two maps of the same seed must differ in something that their files do not record.
        alone = number if seed is None or (alike, seed) in seeds else None
        seeds.add((alike, seed))
        groups.setdefault((alike, alone), []).append(number)
    return list(groups.values())


def _differences(
    maps: Sequence[LearnedMap], rows: Sequence[NDArray[np.float64]], cluster: NDArray[np.intp], seed: int
) -> dict[str, Any]:
    """Return the error of each map minus the first map's; maps that differ only in their seed count as one."""
    groups, names = kin(maps), [each.label for each in maps]
    found = sums.differences(rows, groups, cluster, seed)
    more = [{"maps": [names[k] for k in group], "more_k": more, "interval_95": ends} for group, more, ends in found]
    return {"than": [names[k] for k in groups[0]], "maps": more}


def _limited(dataset: Dataset, limit: int | None) -> Dataset:
    if limit is None or limit >= len(dataset):
        return dataset
    if limit < 1:
        raise ThermorenderError(f"limit={limit} leaves no pair; give at least 1")
    chosen = np.linspace(0, len(dataset) - 1, limit).round().astype(int)
    return dataset.having([dataset.entries[number] for number in chosen])


def _audit(train: Dataset, scored: Dataset) -> dict[str, Any]:
    """Return the audit of the scored pairs against the training pairs, in lines and as plain numbers."""
    # An audit looks at the test part, so the scored part is renamed.
    found = audit(train.having([*train.entries, *(replace(entry, part="test") for entry in scored.entries)]))
    return {"lines": found.lines(), **found.summary()}


def _training_pictures(
    models: Sequence[TemperatureMap], scored: Dataset, report: Callable[[str, float], object], searched: bool
) -> list[Search]:
    """Return the Search for each map's training pictures in the scored ones, which were not searched unless asked."""
    entries = scored.entries
    if not searched:
        return [Search(model, len(entries)) for model in models]

    def read(number: int) -> NDArray[np.uint8]:
        return scored.pair(entries[number], truth=False).visible

    return searches_in(models, [entry.key for entry in entries], read, report, scored.digest())


def _notes(scale: ThermalScale, maps: Sequence[LearnedMap], entries: Sequence[Entry]) -> list[str]:
    """Return sentences that a reader should know before the numbers."""
    notes = []
    if scale.unit == "intensity" and scale.range_c is not None:
        low, high = scale.range_c
        notes.append(
            f"the scale of the thermal pictures is unknown: temperatures assume {low:g}…{high:g} °C for intensity 0…1"
        )
    drives = len({entry.sequence for entry in entries})
    if drives == 1:
        notes.append("all scored pairs are of one sequence, so that errors have no intervals")
    elif drives < sums.FEWEST_SEQUENCES:
        notes.append(f"the scored pairs are of {drives} sequences only: intervals are too narrow")
    sizes = [entry.texel_m for entry in entries if entry.texel_m is not None]
    for each in maps:
        model = _model(each)
        found = [model.texel_warning(size) for size in (min(sizes), max(sizes))] if sizes else []
        notes += dict.fromkeys(filter(None, found))
        notes += filter(None, [model.band_note(scale.band_um)])
    return notes


def _quantiles(rows: NDArray[np.float64]) -> dict[int, float]:
    """Return {pair number: quantile of its mean absolute error} of the pairs to draw."""
    have = np.flatnonzero(rows[:, 0])
    order = have[np.argsort(rows[have, 2] / rows[have, 0], kind="stable")]
    return {int(order[round(share * (len(order) - 1))]): share for share in SHOWN} if len(order) else {}


def _brief(row: NDArray[np.float64]) -> dict[str, Any]:
    statistics = sums.summary(row)
    return {name: statistics[name] for name in ("me_k", "mae_k", "sd_k", "pixels")}


def _header(model: TemperatureMap, text: str | Path) -> dict[str, Any]:
    """Return the header of a map's file, and its digest where `text` is a file."""
    left_out = ("predictor", "fingerprints", "level")
    header = {each.name: getattr(model, each.name) for each in fields(model) if each.name not in left_out}
    header["level"] = None if model.level is None else model.level.header()
    return header | {"sha256": _digest(text) if str(text).endswith(".npz") else None}


def _digest(path: str | Path) -> str:
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()
