"""Evaluation of learned maps on a data set, in kelvin, with baselines and the smallest possible error.

The error of a pixel is the apparent temperature of a method minus the true one. Maps are evaluated as they are, never
refitted. The sky is not ground: where the truth marks it, its errors are reported separately. Every method gets the
same pairs; where a method lacks some, the result says how many pairs it has.

The *floor* is the smallest error that a map can reach. It needs a data set with the same view rendered again with
redrawn hidden state (moisture, roughness, material properties). Let T = f + a be the truth and T′ = f + b the redrawn
one; f is the mean over all draws given the map's inputs, and a and b are independent draws of one distribution. The
best prediction is f, with error a. For a Gaussian of standard deviation σ, a − b has √2 σ, so the mean of |T − T′| over
√2 is the mean of |a|. For other distributions of mean zero, the mean of |T − T′| lies between the mean of |a| and twice
that.
"""

import hashlib
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender import files, formats
from thermorender.apps.compare.evaluation import figures, paired, report, similarity, structure, sums
from thermorender.apps.compare.evaluation.classes import EDGES, edge_class, material_groups, picture_classes
from thermorender.apps.compare.evaluation.estimators import Foreign, LearnedMap, Simple, Spent, View, baselines
from thermorender.apps.compare.evaluation.training_part import Levels, read_training_part
from thermorender.apps.compare.machine import machine
from thermorender.apps.training.audit import Audit, audit
from thermorender.apps.training.dataset import Dataset, Entry, ThermalScale
from thermorender.apps.training.map_inputs import NO_MATERIAL, ground_of
from thermorender.apps.training.training_pictures import Search, search_in
from thermorender.errors import ThermorenderError
from thermorender.frame import apparent_temperature
from thermorender.learned.temperature_map import TemperatureMap, load_model
from thermorender.progress import Progress, Spread
from thermorender.versions import versions

# The pairs at these quantiles of the first map's mean absolute error are drawn.
SHOWN = (0.05, 0.25, 0.5, 0.75, 0.95)


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
) -> dict[str, Any]:
    """Evaluate learned maps on a part of a data set; return the result, which is also written.

    Parameters
    ----------
    dataset : Dataset
    models : sequence of str
        Names or files of learned maps.
    folder : path
        New folder: `evaluation.json`, `evaluation.md` and figures. It is written whole or not at all.
    privileged : str, optional
        File of a map that also takes the material as input.
    foreign : dict of str to path, optional
        Folders of other programs' pictures, by name.
    split : dict of str to str, optional
        {key: part} that replaces the data set's own split.
    part : str
        Part to score.
    limit : int, optional
        Number of pairs of the part to score, evenly spaced, and number of training pairs to read.
    seed : int
        Seed of the bootstrap.
    progress : callable, optional
        Called with (step, share done).
    spread : callable
        (do, units) → do(unit) of each, in order: it scores the pairs.
    """
    if not models:
        raise ThermorenderError("models is empty; give at least one learned map, by its name or file")
    report_progress = progress or (lambda step, share: None)
    if split is not None:
        dataset = dataset.split(split)
    scored, train = (_limited(dataset.of(each), limit) for each in (part, "train"))
    if not scored.entries:
        raise ThermorenderError(f"{dataset.folder} has no pairs of part {part!r}; give another --part, or a --split")
    maps = _maps(models, privileged)
    began, levels = time.perf_counter(), Levels(dataset.scale)
    views = _Views(scored, levels)
    # The maps were trained on the pairs that `limit` leaves out, too.
    leaks = _audit(dataset.of("train"), scored) if part != "train" and train.entries else None
    training = read_training_part(train, levels, lambda share: report_progress("reading the training part", share))
    bounds = training.bounds_k or maps[0].model.range_k
    seen = [_training_pictures(each.model, scored, report_progress) for each in maps]
    others = [Foreign(name, place, scored.entries) for name, place in (foreign or {}).items()]
    others = [other.fitted(views) for other in others]
    drawn: list[LearnedMap | Foreign] = [*maps, *others]
    methods: list[LearnedMap | Foreign | Simple] = [*drawn, *baselines(training)]
    tallies = [_Tally(method, len(scored)) for method in methods]
    for number, found in enumerate(spread(partial(_score, views, methods, bounds), range(len(scored)))):
        report_progress("scoring", (number + 1) / len(scored))
        for tally, own in zip(tallies, found, strict=True):
            tally.add(number, own)
    texts = [*models, *([privileged] if privileged else [])]
    result = {
        "part": part, "split": "given" if split is not None else "the data set's own", "limit": limit, "seed": seed,
        "training_pairs": training.pairs, "bounds_k": list(bounds),
        "audit": None if leaks is None else {"lines": leaks.lines(), **leaks.summary()},
        "training_pictures": {each.label: own.summary() for each, own in zip(maps, seen, strict=True)},
        **_result(dataset, scored, maps, texts, tallies, seed),
    }  # fmt: skip
    with files.atomic_folder(folder) as draft:
        for number, share in _quantiles(tallies[0].rows).items():
            view = views[number]
            guesses = {method.label: method.guess(view) for method in drawn}
            figures.picture(draft / f"errors_{round(100 * share):02d}_{view.pair.entry.key}.png", view, guesses, share)
        figures.against_time(draft / "error_against_time.png", result)
        result["seconds"] = time.perf_counter() - began
        report.write(draft / "evaluation.md", result)
        formats.write_json(draft / "evaluation.json", result)
    return result


def _result(
    dataset: Dataset,
    scored: Dataset,
    maps: list[LearnedMap],
    texts: list[str | Path],
    tallies: "list[_Tally]",
    seed: int,
) -> dict[str, Any]:
    """Return the part of the result that follows from the tallies; `texts` are the maps' names or files."""
    entries = scored.entries
    cluster, drawn = sums.clusters(entries)
    return {
        "dataset": {
            "folder": str(dataset.folder), "card_sha256": _digest(dataset.folder / "card.json"),
            "title": dataset.card.get("title", dataset.card.get("name")), "thermal": dataset.card["thermal"],
        },
        "pairs": len(scored),
        "parts": {name: len(dataset.of(name)) for name in dict.fromkeys(entry.part for entry in dataset.entries)},
        "notes": _notes(dataset.scale, maps, entries), "drawn": drawn,
        "methods": {tally.label: tally.summary(entries, scored.card, cluster, seed) for tally in tallies},
        "differences": _differences(maps, tallies, cluster, seed),
        "images": {
            entry.key: {tally.label: _brief(tally.rows[number]) for tally in tallies if tally.rows[number].any()}
            for number, entry in enumerate(entries)
        },
        "models": {each.label: _header(each.model, text) for each, text in zip(maps, texts, strict=True)},
        "published": report.PUBLISHED, "machine": machine(), "versions": versions(),
    }  # fmt: skip


class _Views:
    """The Views of a Dataset, read one by one."""

    def __init__(self, dataset: Dataset, levels: Levels) -> None:
        # Workers of a cluster have folders of their own.
        self.dataset = Dataset(dataset.folder.absolute(), dataset.card, dataset.entries, dataset.scale)
        self.levels = levels

    def __getitem__(self, number: int) -> View:
        pair = self.dataset.pair(self.dataset.entries[number])
        band = self.dataset.scale.band_um
        if "radiance" in pair.truth:
            true = apparent_temperature(pair.truth["radiance"], band)
        else:
            true = self.levels.temperature(pair.thermal)
        known, ground = pair.valid & np.isfinite(true), ground_of(pair)
        return View(pair, self.dataset.card, band, true, known & ground, known & ~ground)

    def __iter__(self) -> Iterator[View]:
        return (self[number] for number in range(len(self.dataset)))


class _Tally:
    """The errors of one method, summed over all pairs."""

    def __init__(self, method: LearnedMap | Foreign | Simple, pairs: int) -> None:
        self.method = method
        self.label = method.label
        self.rows = np.zeros((pairs, sums.WIDTH))
        self.materials = np.zeros((256, sums.WIDTH))
        self.edges = np.zeros((len(EDGES), sums.WIDTH))
        self.sky = np.zeros(sums.WIDTH)
        self.alike = np.zeros(4)
        self.structure = np.full((pairs, structure.WIDTH), np.nan)
        self.spent = Spent()
        self.pairs = 0

    def add(self, number: int, own: "_Score | None") -> None:
        """Add the score of pair number `number`, None where the method has no picture of it."""
        if own is None:
            return
        self.rows[number] = own.row
        self.materials[own.materials] += own.of_materials
        self.edges += own.edges
        self.sky += own.sky
        self.structure[number] = own.structure
        self.alike += own.alike
        self.spent.add(own.spent)
        self.pairs += 1

    def summary(
        self, entries: Sequence[Entry], card: Mapping[str, Any], cluster: NDArray[np.intp], seed: int
    ) -> dict[str, Any]:
        """Return the statistics of the method, as plain numbers."""
        groups: dict[str, dict[str, Any]] = {}
        for entry, row in zip(entries, self.rows, strict=True):
            for grouping, name in picture_classes(entry).items():
                own = groups.setdefault(grouping, {})
                own[name] = own.get(name, 0.0) + row
        groups["material"], groups["surface"] = material_groups(self.materials, card.get("materials", []))
        if self.sky.any():
            groups["surface"]["sky, not scored"] = self.sky
        groups["edges"] = dict(zip(EDGES, self.edges, strict=True))
        return {
            "kind": self.method.kind, "knows": self.method.knows, "pairs": self.pairs,
            **sums.summary(self.rows.sum(axis=0)),
            "interval_95": sums.intervals(self.rows, cluster, seed),
            "structure": structure.summary(self.structure, cluster, seed),
            **similarity.summary(self.alike), **self.method.cost(self.spent),
            "groups": {grouping: {name: sums.summary(own[name]) for name in sorted(own)}
                       for grouping, own in groups.items() if own},
        }  # fmt: skip


@dataclass
class _Score:
    """The errors of one method in one pair; sums by material have rows only for the materials of the pair."""

    row: NDArray[np.float64]
    materials: NDArray[np.intp]
    of_materials: NDArray[np.float64]
    edges: NDArray[np.float64]
    sky: NDArray[np.float64]
    spent: Spent
    structure: NDArray[np.float64]
    alike: NDArray[np.float64]


def _score(
    views: _Views, methods: Sequence[LearnedMap | Foreign | Simple], bounds: tuple[float, float], number: int
) -> list[_Score | None]:
    """Return every method's score in View number `number`."""
    view = views[number]
    known = view.known
    alike = similarity.Similarity(similarity.eight_bit(view.true, bounds), known)
    edges = edge_class(np.where(known, view.true, np.nan))[known]
    material = view.pair.truth.get("material", np.full(known.shape, NO_MATERIAL, np.uint8))[known]
    both = material.astype(np.intp) * len(EDGES) + edges
    present = np.unique(material).astype(np.intp)
    scores: list[_Score | None] = []
    for method in methods:
        guess = method.guess(view)
        if guess is None:
            scores.append(None)
            continue
        error = guess[known].astype(np.float64) - view.true[known]
        found = sums.rows_by(error, both, 256 * len(EDGES)).reshape(256, len(EDGES), sums.WIDTH)
        sky = np.zeros(sums.WIDTH)
        if view.sky.any():
            off = guess[view.sky].astype(np.float64) - view.true[view.sky]
            sky = sums.rows_by(off, np.zeros(off.size, np.intp), 1)[0]
        own = _Score(
            found.sum(axis=(0, 1)), present, found.sum(axis=1)[present], found.sum(axis=0), sky,
            method.spent if isinstance(method, LearnedMap) else Spent(), np.full(structure.WIDTH, np.nan), np.zeros(4),
        )  # fmt: skip
        # The floor is an error estimate, not a picture to compare.
        if method.kind != "floor":
            own.structure = structure.row(guess, view.true, known)
            own.alike = alike.row(similarity.eight_bit(guess, bounds))
        scores.append(own)
    return scores


def _maps(models: Sequence[str | Path], privileged: str | Path | None) -> list[LearnedMap]:
    """Return the LearnedMaps of names and files, with unique labels."""
    loaded = [load_model(model) for model in models]
    names = [model.name for model in loaded]
    labels = [name if names.count(name) == 1 else f"{name} ({text})" for name, text in zip(names, models, strict=True)]
    if len(set(labels)) < len(labels):
        raise ThermorenderError(f"models {', '.join(map(str, models))} name one map twice; give each once")
    found = [LearnedMap(label, model) for label, model in zip(labels, loaded, strict=True)]
    if privileged:
        model = load_model(privileged)
        found.append(LearnedMap(f"privileged {model.name}", model, privileged=True))
    return found


def _differences(maps: list[LearnedMap], tallies: list[_Tally], cluster: NDArray[np.intp], seed: int) -> dict[str, Any]:
    """Return the error of each map minus the first map's; maps that differ only in their seed count as one."""
    groups, names = paired.kin(maps), [each.label for each in maps]
    found = paired.differences([tally.rows for tally in tallies[: len(maps)]], groups, cluster, seed)
    more = [{"maps": [names[k] for k in group], "more_k": more, "interval_95": ends} for group, more, ends in found]
    return {"than": [names[k] for k in groups[0]], "maps": more}


def _limited(dataset: Dataset, limit: int | None) -> Dataset:
    if limit is None or limit >= len(dataset):
        return dataset
    if limit < 1:
        raise ThermorenderError(f"limit={limit} leaves no pair; give at least 1")
    chosen = np.linspace(0, len(dataset) - 1, limit).round().astype(int)
    return dataset.having([dataset.entries[number] for number in chosen])


def _audit(train: Dataset, scored: Dataset) -> Audit:
    """Return the audit of the scored pairs against the training pairs."""
    # An audit looks at the test part, so the scored part is renamed.
    return audit(train.having([*train.entries, *(replace(entry, part="test") for entry in scored.entries)]))


def _training_pictures(model: TemperatureMap, scored: Dataset, report: Callable[[str, float], object]) -> Search:
    """Return the Search for a map's training pictures in the scored ones."""
    entries = scored.entries

    def read(number: int) -> NDArray[np.uint8]:
        return scored.pair(entries[number], truth=False).visible

    step = f"searching training pictures of {model.name}"
    return search_in(model, [entry.key for entry in entries], read, lambda share: report(step, share))


def _notes(scale: ThermalScale, maps: list[LearnedMap], entries: Sequence[Entry]) -> list[str]:
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
        found = [each.model.texel_warning(size) for size in (min(sizes), max(sizes))] if sizes else []
        notes += dict.fromkeys(filter(None, found))
        if tuple(each.model.band_um) != tuple(scale.band_um):
            band = "–".join(f"{limit:g}" for limit in each.model.band_um)
            notes.append(f"learned map {each.model.name!r} gives apparent temperatures of {band} µm, another band")
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
    header = {
        each.name: getattr(model, each.name) for each in fields(model) if each.name not in ("predictor", "fingerprints")
    }
    return header | {"sha256": _digest(text) if str(text).endswith(".npz") else None}


def _digest(path: str | Path) -> str:
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()
