"""Learned maps on real pairs of pictures: each group of pictures is tested by maps trained on the other groups.

A group is a drive, a tree or a part of a flight, as `sets.toml` states. Every picture is tested once. Intervals are
drawn over groups. The fingerprints of the maps state which test pictures show what training has seen all the same.

These maps and the shipped ones are also anchored: by the air's temperature where it is known, and by three known
temperatures of a picture, drawn by seed and not scored. Both stand beside a constant at the same anchor.
"""

import tempfile
import time
from pathlib import Path

import numpy as np
from scipy.stats import spearmanr

from thermorender.apps.compare import structure, sums
from thermorender.apps.compare.machine import machine
from thermorender.apps.compare.training import read_training_part
from thermorender.apps.compare.view import Levels
from thermorender.apps.training.dataset import read_dataset
from thermorender.apps.training.map_inputs import ground_of, inputs_of
from thermorender.apps.training.map_training import train_map
from thermorender.apps.training.prepare import Source, prepare
from thermorender.apps.training.training_pictures import search_in
from thermorender.defaults import TEMPERATURE_MAPS, TRAINED_MAPS
from thermorender.errors import ThermorenderError
from thermorender.frame import apparent_temperature
from thermorender.learned.anchor import anchored_to_air, anchored_to_known
from thermorender.learned.temperature_map import load_model
from thermorender.schema import read_toml
from thermorender.versions import versions

SETS = read_toml(Path(__file__).with_name("sets.toml"))
# Label: (method, options).
METHODS = {
    "correlation 1-to-1": ("correlation-1to1", {}),
    "correlation 9-to-1": ("correlation-9to1", {}),
    "9-to-1 with intercept": ("correlation-9to1", {"intercept": True}),
    "palette": ("palette", {}),
    "trees": ("trees", {}),
}
# Larger sets are not searched for training pictures, which takes 10 ms for each pair of pictures.
_MOST_SEARCHED = 50
CONSTANT, OWN_MEAN = "constant: mean of the training part", "the frame's own mean"
CONSTANT_AT_ANCHOR = "constant: the anchor"
AS_IS, BY_AIR, BY_KNOWN = "as it is", "by the air", "by three known"
# Known temperatures of a draw, and draws of a picture, which are averaged.
KNOWN, DRAWS = 3, 8
ANCHORED = ("map", AS_IS, BY_AIR, BY_KNOWN, "minus the constant there", "minus the own mean")
HEADER = ("set", "method", "pairs", "MAE [K]", "95 %", "correlation", "slope", "MAE without means [K]",
          "MAE growth by 16 px [K]")  # fmt: skip


def run(folder, names=None, methods=None, seed=0, rendered=None, progress=None):
    """Return the errors of maps on sets of real pairs, as plain numbers.

    Parameters
    ----------
    folder : path
        With the sets' folders.
    names : sequence of str, optional
        Some of `SETS`; default: those whose folders exist.
    methods : sequence of str, optional
        Some of `METHODS`; default: all.
    seed : int
    rendered : path, optional
        A rendered data set, on whose test part the shipped maps are anchored, too: its air is known.
    progress : callable, optional
        Called with (step, share done).

    Raises
    ------
    ThermorenderError
        An unknown set or method, or a folder without any set.
    """
    report = progress or (lambda step, share: None)
    for given, known, what in ((names, SETS, "set"), (methods, METHODS, "method")):
        for each in given or ():
            if each not in known:
                raise ThermorenderError(f"{what} {each!r} is unknown; give {', '.join(known)}")
    names = names or [name for name, own in SETS.items() if (Path(folder) / own["visible_folder"]).is_dir()]
    if not names:
        wanted = ", ".join(own["visible_folder"] for own in SETS.values())
        raise ThermorenderError(f"{folder} has none of the folders {wanted}; give the folder that holds them")
    found = {}
    for number, name in enumerate(names):
        report(name, number / len(names))
        with tempfile.TemporaryDirectory() as work:
            dataset = _dataset(SETS[name], Path(folder), Path(work) / name)
            found[name] = _scored(dataset, SETS[name], methods or METHODS, seed)
    if rendered is not None:
        report("rendered", 1.0)
        found["rendered"] = _rendered(read_dataset(rendered).of("test"), seed)
    return {"sets": found, "seed": seed, "machine": machine(), "versions": versions()}


def _dataset(own, folder, output):
    """The Dataset of a set, prepared in a folder."""
    scale = tuple(own["scale"]) if "scale" in own else None
    source = Source(
        folder / own["visible_folder"], folder / own["thermal_folder"], own["visible"], own["thermal"],
        own.get("valid"), scale, own.get("sequence"), own.get("gap"),
    )  # fmt: skip
    prepare(source, output, split="train")
    return read_dataset(output)


def _scored(dataset, own, methods, seed):
    """Scores of one set."""
    began = time.perf_counter()
    entries, levels = dataset.entries, Levels(dataset.scale)
    fold = folds_of([entry.sequence for entry in entries], own.get("folds"))
    labels = [*methods, CONSTANT, OWN_MEAN]
    rows = {label: np.zeros((len(entries), sums.WIDTH)) for label in labels}
    scores = {label: np.full((len(entries), structure.WIDTH), np.nan) for label in labels}
    seen, pixels, anchored = {}, np.zeros(2), Anchored(len(entries), seed)
    shipped = _shipped()
    for each in range(max(fold) + 1):
        test = [k for k in range(len(entries)) if fold[k] == each]
        split = dataset.split({entry.key: "test" if fold[k] == each else "train" for k, entry in enumerate(entries)})
        maps = {label: train_map("map", METHODS[label][0], split, METHODS[label][1], seed, parts=("train",),
                                 judged=False) for label in methods}  # fmt: skip
        mean_k = read_training_part(split.of("train"), levels).mean_k
        pairs = {k: split.pair(entries[k]) for k in test}
        if maps and len(entries) <= _MOST_SEARCHED:
            search = search_in(next(iter(maps.values())), [entries[k].key for k in test],
                               lambda number, pairs=pairs, test=test: pairs[test[number]].visible)  # fmt: skip
            seen |= {key: one.agreement for key, one in search.found.items()}
        for k, pair in pairs.items():
            true, known = levels.temperature(pair.thermal), ground_of(pair)
            pixels += known.sum(), known.size
            inputs = inputs_of(pair, split.card)
            mapped = {label: _mapped(model, inputs) for label, model in (maps | shipped).items()}
            anchored.add(k, maps | shipped, mapped, true, known, entries[k].conditions.get("air_k"))
            anchored.distance[k] = _distance(shipped, inputs)
            guesses = {label: mapped[label] for label in maps}
            guesses[CONSTANT] = np.full(true.shape, mean_k)
            guesses[OWN_MEAN] = np.full(true.shape, true[known].mean(dtype=np.float64))
            for label, guess in guesses.items():
                rows[label][k] = sums.row(guess[known].astype(np.float64) - true[known])
                scores[label][k] = structure.row(guess, true, known)
    cluster, drawn = sums.clusters(entries)
    return {
        **{key: own[key] for key in ("title", "what", "sensor", "units", "licence", "source", "masked", "group")},
        "air": own.get("air", "Not known"),
        "pairs": len(entries), "groups": drawn, "folds": max(fold) + 1,
        "masked_share": float(1.0 - pixels[0] / pixels[1]), "shown_in_training": seen,
        "seconds": time.perf_counter() - began,
        "methods": {
            label: {**sums.summary(rows[label].sum(axis=0)), "interval_95": sums.intervals(rows[label], cluster, seed),
                    "structure": structure.summary(scores[label], cluster, seed)}
            for label in labels
        },
        "anchored": anchored.summary(cluster),
    }  # fmt: skip


def _rendered(dataset, seed):
    """Scores of the shipped maps on a rendered data set, whose air is known."""
    began, levels, shipped = time.perf_counter(), Levels(dataset.scale), _shipped()
    anchored = Anchored(len(dataset), seed)
    for k, entry in enumerate(dataset.entries):
        pair = dataset.pair(entry)
        known, inputs = ground_of(pair), inputs_of(pair, dataset.card)
        if known.sum() > KNOWN:
            mapped = {label: _mapped(model, inputs) for label, model in shipped.items()}
            anchored.add(k, shipped, mapped, levels.temperature(pair.thermal), known, entry.conditions["air_k"])
            anchored.distance[k] = _distance(shipped, inputs)
    cluster, drawn = sums.clusters(dataset.entries)
    return {
        "title": "Rendered, not real: test worlds of the standard campaign",
        "what": "Procedural heaths, villages and ridges over a year of weathers", "sensor": "zenmuse-xt2",
        "units": "Band radiance", "licence": "MIT", "source": "thermorender dataset", "masked": "Sky",
        "group": "A world", "air": "The weather of each world", "pairs": len(dataset), "groups": drawn,
        "seconds": time.perf_counter() - began, "anchored": anchored.summary(cluster),
    }  # fmt: skip


def _shipped():
    """{name: map} of the shipped maps that need colour only."""
    maps = {name: load_model(name) for name in (*TEMPERATURE_MAPS, *TRAINED_MAPS)}
    return {name: model for name, model in maps.items() if not model.needs}


def _mapped(model, inputs):
    """Apparent temperature as `translate` writes it, (h, w) float64 [K]."""
    return apparent_temperature(model.limited(model.radiance(inputs)), model.band_um).astype(np.float64)


def _distance(shipped, inputs):
    """Distance of a picture's colours from those of the shipped maps' training, which is the same for all; or NaN."""
    levels = [model.level for model in shipped.values() if model.level is not None]
    return levels[0].distance(inputs.rgb) if levels else np.nan


class Anchored:
    """Sums of errors of maps as they are, and anchored, by label and picture."""

    def __init__(self, pictures, seed):
        self.pictures, self.seed = pictures, seed
        self.rows = {}
        self.distance = np.full(pictures, np.nan)

    def add(self, number, maps, mapped, true, known, air_k=None):
        """Add a picture: `mapped` {label: (h, w) [K]} by `maps`, its `true` (h, w) [K] where `known`, and its air."""
        true = true.astype(np.float64)
        generator, pixels = np.random.default_rng([self.seed, number]), np.flatnonzero(known)
        draws = [generator.choice(pixels, KNOWN, replace=False) for _ in range(DRAWS)]
        for label, own in mapped.items():
            model, spread_k = maps[label], own[known].std()
            self._score(number, label, AS_IS, own, true, known)
            if air_k is not None and model.level is not None and model.level.air_k is not None:
                anchor = anchored_to_air(model, air_k, own[known].mean(), spread_k)
                self._score(number, label, BY_AIR, anchor.kelvin(own), true, known)
            for draw in draws:
                anchor = anchored_to_known(model, true.flat[draw], own.flat[draw], spread_k)
                self._score(number, label, BY_KNOWN, anchor.kelvin(own), true, known, draw)
        for draw in draws:
            at_anchor = np.full(true.shape, true.flat[draw].mean())
            self._score(number, CONSTANT_AT_ANCHOR, BY_KNOWN, at_anchor, true, known, draw)
        if air_k is not None:
            self._score(number, CONSTANT_AT_ANCHOR, BY_AIR, np.full(true.shape, air_k), true, known)
        self._score(number, OWN_MEAN, AS_IS, np.full(true.shape, true[known].mean()), true, known)

    def _score(self, number, label, how, guess, true, known, drawn=None):
        """Add the errors of a picture; pixels that are `drawn` are not scored, and their draws share the weight."""
        scored = known.copy()
        if drawn is not None:
            scored.flat[drawn] = False
        rows = self.rows.setdefault((label, how), np.zeros((self.pictures, sums.WIDTH)))
        rows[number] += sums.row(guess[scored] - true[scored]) / (1 if drawn is None else DRAWS)

    def summary(self, cluster):
        """Return {label: {how: {mae_k, interval_95, minus_constant, minus_own_mean}}}, and the distance of colours."""
        found = {}
        for (label, how), rows in self.rows.items():
            own = {"mae_k": sums.summary(rows.sum(axis=0))["mae_k"],
                   "interval_95": sums.intervals(rows, cluster, self.seed)["mae_k"]}  # fmt: skip
            for name, other in (("minus_constant", (CONSTANT_AT_ANCHOR, how)), ("minus_own_mean", (OWN_MEAN, AS_IS))):
                if other in self.rows and other != (label, how):
                    pair = np.stack([self.rows[other], rows])
                    ((_, less, ends),) = sums.differences(pair, [[0], [1]], cluster, self.seed)
                    own[name] = {"k": less, "interval_95": ends}
            found.setdefault(label, {})[how] = own
        known = np.isfinite(self.distance)
        away = {"median": float(np.median(self.distance[known])), "rank_correlation": {}} if known.any() else None
        for (label, how), rows in self.rows.items():
            if away and how == AS_IS and label != OWN_MEAN and known.sum() > 2:
                errors = rows[known, 2] / np.maximum(rows[known, 0], 1.0)
                away["rank_correlation"][label] = float(spearmanr(self.distance[known], errors).statistic)
        return {"maps": found, "colour_distance": away}


def folds_of(groups, count):
    """The fold of each pair: one per group, or `count` folds of about equal size."""
    names, number, sizes = np.unique(groups, return_inverse=True, return_counts=True)
    if len(names) < 2:
        raise ThermorenderError(f"all pairs are of group {names[0]!r}, so none can be left out; give more pairs")
    if count is None or count >= len(names):
        return number.tolist()
    fold, filled = np.zeros(len(names), int), np.zeros(count, int)
    for each in np.argsort(-sizes, kind="stable"):
        fold[each] = filled.argmin()
        filled[fold[each]] += sizes[each]
    return fold[number].tolist()


def rows(result):
    """Return the result as table rows under HEADER."""
    return [(own["title"], *cells) for own in result["sets"].values() if "methods" in own for cells in _cells(own)]


def _cells(own):
    found = []
    for label, each in own["methods"].items():
        within = each["structure"]
        found.append((label, str(own["pairs"]), f"{each['mae_k']:.2f}", _ends(each["interval_95"]["mae_k"]),
                      _number(within["correlation"]), _number(within["slope"]), _number(within["mae_without_mean_k"]),
                      _number(within["shift_more_k"], "+")))  # fmt: skip
    return found


def page(path, result):
    """Write a result as a Markdown page, with a card of each set."""
    lines = ["# Learned maps on real pairs", "", "`python -m validation.real_pairs FOLDER`. " + _ABOUT, ""]
    for own in result["sets"].values():
        lines += [
            f"## {own['title']}", "", f"- What: {own['what']}", f"- Sensor: {own['sensor']}",
            f"- Units: {own['units']}",
            f"- Licence: {own['licence']}. Source: {own['source']}",
            f"- Size: {own['pairs']} pairs in {own['groups']}" + (f", {own['folds']} folds" if "folds" in own else ""),
            f"- Left out together: {own['group']}",
            f"- Air: {own['air']}",
            f"- Colours: {_colours(own['anchored']['colour_distance'])}",
        ]  # fmt: skip
        if "methods" in own:
            lines += [
                f"- Masked: {own['masked']} ({own['masked_share']:.1%} of the pixels)", f"- Audit: {_audit(own)}", "",
                f"| {' | '.join(HEADER[1:])} |", "|---|" + "--:|" * (len(HEADER) - 2),
                *(f"| {' | '.join(cells)} |" for cells in _cells(own)),
            ]  # fmt: skip
        lines += [
            "", f"| {' | '.join(ANCHORED)} |", "|---|" + "--:|" * (len(ANCHORED) - 1),
            *(f"| {' | '.join(cells)} |" for cells in _anchored_cells(own["anchored"]["maps"])), "",
        ]  # fmt: skip
    path.write_text("\n".join(lines), encoding="utf-8")


def _anchored_cells(maps):
    for label, own in maps.items():
        known = own.get(BY_KNOWN, {})
        yield (label, *(_with_ends(own[how]["mae_k"], own[how]["interval_95"]) if how in own else ""
                        for how in (AS_IS, BY_AIR, BY_KNOWN)),
               *(_with_ends(known[name]["k"], known[name]["interval_95"], "+") if name in known else ""
                 for name in ("minus_constant", "minus_own_mean")))  # fmt: skip


def _with_ends(value, ends, sign=""):
    if ends is None:
        return _number(value, sign)
    return f"{value:{sign}.2f} ({ends[0]:{sign}.2f}…{ends[1]:{sign}.2f})"


def _colours(away):
    if away is None:
        return "the shipped maps do not record those of their training"
    ranks = ", ".join(f"{label} {value:+.2f}" for label, value in away["rank_correlation"].items())
    return (
        f"{away['median']:.1f} standard deviations of the shipped maps' training from its mean (median picture); rank "
        f"correlation of that with a picture's error: {ranks or 'too few pictures'}"
    )


def _audit(own):
    seen = own["shown_in_training"]
    if own["pairs"] > _MOST_SEARCHED:
        return "not searched"
    if not seen:
        return "no test picture shows a training picture, by their fingerprints"
    return f"{len(seen)} of {own['pairs']} test pictures show parts of training pictures: {', '.join(seen)}"


_ABOUT = (
    "Each group of pictures is tested by maps trained on the other groups. MAE: over all known pixels; intervals: "
    "bootstrap over groups, too narrow where these are fewer than ten. Correlation and slope: median over pictures. "
    "The last column is the growth of the MAE when the true picture is shifted by 16 px.\n\n"
    "Second tables: MAE [K] with 95 % intervals of these and of the shipped maps, as `translate` writes them: as they "
    "are, anchored by the air's temperature, and by three known temperatures of each picture, which are not scored "
    f"(mean of {DRAWS} draws). The last two columns are of three known temperatures: the map's MAE minus that of the "
    "mean of the three, and minus that of the frame's own mean, which is the best constant that nobody knows."
)


def _number(value, sign=""):
    return "" if value is None else f"{value:{sign}.2f}"


def _ends(ends):
    return "" if ends is None else f"{ends[0]:.2f}…{ends[1]:.2f}"
