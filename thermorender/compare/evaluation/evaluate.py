"""Learned maps evaluated on a data set, in kelvin, beside simple methods and beside the least error there is.

The error of a pixel is the apparent temperature that a method gives less the true one. Maps are judged as they are,
never refitted. Sky is no ground: where the truth tells it, its errors stand apart. The same pairs are given to every
method; a method that some pairs lack says on how many it stands.

The *floor* is what no map can go below, where the data set holds the same view with its hidden state (moisture,
roughness, properties of the materials) drawn anew. Let T = f + a be the truth and T′ = f + b the redrawn one, f being
the mean over all draws of what is known and a, b independent draws of one law. The best that can be given is f, with
error a. If that law is Gaussian of standard deviation σ, a − b has √2 σ, so the mean of |T − T′| is √2 times that of
|a|; hence the mean of |T − T′| over √2. For other laws of mean zero it lies between the mean of |a| and twice that.
"""

import hashlib
import time
from dataclasses import fields, replace
from pathlib import Path

import numpy as np

from thermorender import files, formats
from thermorender.campaign.audit import audit
from thermorender.campaign.map_inputs import NO_MATERIAL, ground_of
from thermorender.compare.evaluation import figures, paired, report, similarity, sums
from thermorender.compare.evaluation.classes import EDGES, edge_class, material_groups, picture_classes
from thermorender.compare.evaluation.estimators import Foreign, LearnedMap, View, baselines
from thermorender.compare.evaluation.training_part import Levels, read_training_part
from thermorender.compare.machine import machine
from thermorender.errors import ThermorenderError
from thermorender.frame import apparent_temperature
from thermorender.learned.temperature_map import load_model
from thermorender.versions import versions

# Pictures are drawn of the pairs at these quantiles of the first map's mean absolute error.
SHOWN = (0.05, 0.25, 0.5, 0.75, 0.95)


def evaluate(dataset, models, folder, oracle=None, foreign=None, split=None, part="test", limit=None, seed=0,
             progress=None):  # fmt: skip
    """Evaluate learned maps on a part of a data set; return the result that is also written.

    Parameters
    ----------
    dataset : Dataset
    models : sequence of str
        Names or files of learned maps.
    folder : path
        New folder: `evaluation.json`, `evaluation.md` and figures, all or nothing.
    oracle : str, optional
        File of a map that is shown the material, too.
    foreign : dict of str to path, optional
        Folders of other translators' pictures, by their names.
    split : dict of str to str, optional
        {key: part} in place of the data set's own.
    part : str
        Which is scored.
    limit : int, optional
        Take so many pairs of the part, evenly spaced, and as many of the training part.
    seed : int
        Of the bootstrap.
    progress : callable, optional
        Called with (what, share done).

    Raises
    ------
    ThermorenderError
        No map or no pair to score, an unknown map, a map that needs what the data set lacks.
    """
    if not models:
        raise ThermorenderError("models is empty; give at least one learned map, by its name or file")
    tell = progress or (lambda what, share: None)
    if split is not None:
        dataset = dataset.split(split)
    scored, train = (_limited(dataset.of(each), limit) for each in (part, "train"))
    if not scored.entries:
        raise ThermorenderError(f"{dataset.folder} has no pairs of part {part!r}; give another --part, or a --split")
    maps = _maps(models, oracle)
    began, levels = time.perf_counter(), Levels(dataset.scale)
    views = _Views(scored, levels)
    # What was left out by `limit` was trained on all the same.
    leaks = _audit(dataset.of("train"), scored) if part != "train" and train.entries else None
    training = read_training_part(train, levels, lambda share: tell("reading the training part", share))
    bounds = training.bounds_k or maps[0].model.range_k
    others = [Foreign(name, place, scored.entries) for name, place in (foreign or {}).items()]
    others = [other.fitted(views) for other in others]
    tallies = [_Tally(method, len(scored)) for method in (*maps, *others, *baselines(training))]
    for number, view in enumerate(views):
        tell("scoring", number / len(scored))
        _score(view, number, tallies, bounds)
    entries = scored.entries
    cluster, what = sums.clusters(entries)
    result = {
        "dataset": {
            "folder": str(dataset.folder), "card_sha256": _digest(dataset.folder / "card.json"),
            "title": dataset.card.get("title", dataset.card.get("name")), "thermal": dataset.card["thermal"],
        },
        "part": part, "pairs": len(scored), "parts": {name: len(dataset.of(name)) for name in _parts(dataset)},
        "split": "given" if split is not None else "the data set's own", "limit": limit, "seed": seed,
        "training_pairs": training.pairs, "bounds_k": list(bounds), "notes": _notes(dataset.scale, maps, entries),
        "audit": None if leaks is None else {"lines": leaks.lines(), **leaks.summary()},
        "drawn": what,
        "methods": {tally.label: tally.summary(entries, scored.card, cluster, seed) for tally in tallies},
        "differences": _differences(maps, tallies, cluster, seed),
        "images": {
            entry.key: {tally.label: _brief(tally.rows[number]) for tally in tallies if tally.rows[number].any()}
            for number, entry in enumerate(entries)
        },
        "models": {each.label: _header(each.model, text) for each, text in
                   zip(maps, (*models, *([oracle] if oracle else ())), strict=True)},
        "published": report.PUBLISHED, "machine": machine(), "versions": versions(),
    }  # fmt: skip
    shown = _quantiles(tallies[0].rows)
    with files.atomic_folder(folder) as draft:
        for number, share in shown.items():
            view = views[number]
            guesses = {method.label: method.guess(view) for method in (*maps, *others)}
            figures.picture(draft / f"errors_{round(100 * share):02d}_{view.pair.entry.key}.png", view, guesses, share)
        figures.against_time(draft / "error_against_time.png", result)
        result["seconds"] = time.perf_counter() - began
        report.write(draft / "evaluation.md", result)
        formats.write_json(draft / "evaluation.json", result)
    return result


class _Views:
    """The Views of a Dataset, read one by one."""

    def __init__(self, dataset, levels):
        self.dataset, self.levels = dataset, levels

    def __getitem__(self, number):
        pair = self.dataset.pair(self.dataset.entries[number])
        band = self.dataset.scale.band_um
        if "radiance" in pair.truth:
            true = apparent_temperature(pair.truth["radiance"], band)
        else:
            true = self.levels.temperature(pair.thermal)
        known, ground = pair.valid & np.isfinite(true), ground_of(pair)
        return View(pair, self.dataset.card, band, true, known & ground, known & ~ground)

    def __iter__(self):
        return (self[number] for number in range(len(self.dataset)))


class _Tally:
    """What one method is found to err, over all pairs."""

    def __init__(self, method, pairs):
        self.method = method
        self.label = method.label
        self.rows = np.zeros((pairs, sums.WIDTH))
        self.materials = np.zeros((256, sums.WIDTH))
        self.edges = np.zeros((len(EDGES), sums.WIDTH))
        self.sky = np.zeros(sums.WIDTH)
        self.alike = np.zeros(4)
        self.pairs = 0

    def summary(self, entries, card, cluster, seed):
        """Return everything that is known of the method, plain numbers."""
        groups = {}
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
            **similarity.summary(self.alike), **self.method.cost(),
            "groups": {grouping: {name: sums.summary(own[name]) for name in sorted(own)}
                       for grouping, own in groups.items() if own},
        }  # fmt: skip


def _score(view, number, tallies, bounds):
    """Add a View, the number of which is given, to every method's tally."""
    known = view.known
    alike = similarity.Similarity(similarity.eight_bit(view.true, bounds), known)
    edges = edge_class(np.where(known, view.true, np.nan))[known]
    material = view.pair.truth.get("material", np.full(known.shape, NO_MATERIAL, np.uint8))[known]
    both = material.astype(np.intp) * len(EDGES) + edges
    for tally in tallies:
        guess = tally.method.guess(view)
        if guess is None:
            continue
        error = guess[known].astype(np.float64) - view.true[known]
        found = sums.rows_by(error, both, 256 * len(EDGES)).reshape(256, len(EDGES), sums.WIDTH)
        tally.rows[number] = found.sum(axis=(0, 1))
        tally.materials += found.sum(axis=1)
        tally.edges += found.sum(axis=0)
        if view.sky.any():
            off = guess[view.sky].astype(np.float64) - view.true[view.sky]
            tally.sky += sums.rows_by(off, np.zeros(off.size, np.intp), 1)[0]
        tally.pairs += 1
        # The floor is an error, and its picture no guess.
        if tally.method.kind != "floor":
            tally.alike += alike.row(similarity.eight_bit(guess, bounds))


def _maps(models, oracle):
    """The LearnedMaps of names and files, by names that differ."""
    loaded = [load_model(model) for model in models]
    names = [model.name for model in loaded]
    labels = [name if names.count(name) == 1 else f"{name} ({text})" for name, text in zip(names, models, strict=True)]
    if len(set(labels)) < len(labels):
        raise ThermorenderError(f"models {', '.join(map(str, models))} name one map twice; give each once")
    found = [LearnedMap(label, model) for label, model in zip(labels, loaded, strict=True)]
    if oracle:
        model = load_model(oracle)
        found.append(LearnedMap(f"oracle {model.name}", model, oracle=True))
    return found


def _differences(maps, tallies, cluster, seed):
    """What maps err more than the first, those that differ in their seed alone taken together; plain numbers."""
    groups, names = paired.kin(maps), [each.label for each in maps]
    found = paired.differences([tally.rows for tally in tallies[: len(maps)]], groups, cluster, seed)
    more = [{"maps": [names[k] for k in group], "more_k": more, "interval_95": ends} for group, more, ends in found]
    return {"than": [names[k] for k in groups[0]], "maps": more}


def _limited(dataset, limit):
    if limit is None or limit >= len(dataset):
        return dataset
    if limit < 1:
        raise ThermorenderError(f"limit={limit} leaves no pair; give at least 1")
    chosen = np.linspace(0, len(dataset) - 1, limit).round().astype(int)
    return dataset.having([dataset.entries[number] for number in chosen])


def _audit(train, scored):
    """The audit of what is scored against what was trained on."""
    # An audit looks at the test part, whatever part is scored.
    return audit(train.having([*train.entries, *(replace(entry, part="test") for entry in scored.entries)]))


def _parts(dataset):
    return dict.fromkeys(entry.part for entry in dataset.entries)


def _notes(scale, maps, entries):
    """What a reader has to know before the numbers, in sentences."""
    notes = []
    if scale.unit == "intensity":
        low, high = scale.range_c
        notes.append(
            f"the scale of the thermal pictures is unknown: kelvin are those of an assumed {low:g}…{high:g} °C for "
            "intensity 0…1"
        )
    sizes = [entry.texel_m for entry in entries if entry.texel_m is not None]
    for each in maps:
        found = [each.model.texel_warning(size) for size in (min(sizes), max(sizes))] if sizes else []
        notes += dict.fromkeys(filter(None, found))
        if tuple(each.model.band_um) != tuple(scale.band_um):
            told = "–".join(f"{limit:g}" for limit in each.model.band_um)
            notes.append(f"learned map {each.model.name!r} gives apparent temperatures of {told} µm, another band")
    return notes


def _quantiles(rows):
    """{number of a pair: quantile of its mean absolute error} of the pairs to draw."""
    have = np.flatnonzero(rows[:, 0])
    order = have[np.argsort(rows[have, 2] / rows[have, 0], kind="stable")]
    return {int(order[round(share * (len(order) - 1))]): share for share in SHOWN} if len(order) else {}


def _brief(row):
    told = sums.summary(row)
    return {name: told[name] for name in ("me_k", "mae_k", "sd_k", "pixels")}


def _header(model, text):
    """What a map's file says of it, and its digest where it is one."""
    told = {each.name: getattr(model, each.name) for each in fields(model) if each.name != "predictor"}
    return told | {"sha256": _digest(text) if str(text).endswith(".npz") else None}


def _digest(path):
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()
