"""Learned maps on real pairs of pictures: each group of pictures is tested by maps trained on the other groups.

A group is a drive, a tree or a part of a flight, as `sets.toml` states. Every picture is tested once. Intervals are
drawn over groups. The fingerprints of the maps state which test pictures show what training has seen all the same.
"""

import tempfile
import time
from pathlib import Path

import numpy as np

from thermorender.apps.compare import structure, sums
from thermorender.apps.compare.machine import machine
from thermorender.apps.compare.training import read_training_part
from thermorender.apps.compare.view import Levels
from thermorender.apps.training.dataset import read_dataset
from thermorender.apps.training.map_inputs import ground_of, inputs_of
from thermorender.apps.training.map_training import train_map
from thermorender.apps.training.prepare import Source, prepare
from thermorender.apps.training.training_pictures import search_in
from thermorender.errors import ThermorenderError
from thermorender.frame import apparent_temperature
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
HEADER = ("set", "method", "pairs", "MAE [K]", "95 %", "correlation", "slope", "MAE without means [K]",
          "MAE growth by 16 px [K]")  # fmt: skip


def run(folder, names=None, methods=None, seed=0, progress=None):
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
    seen, pixels = {}, np.zeros(2)
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
            guesses = {label: apparent_temperature(model.radiance(inputs), model.band_um)
                       for label, model in maps.items()}  # fmt: skip
            guesses[CONSTANT] = np.full(true.shape, mean_k)
            guesses[OWN_MEAN] = np.full(true.shape, true[known].mean(dtype=np.float64))
            for label, guess in guesses.items():
                rows[label][k] = sums.row(guess[known].astype(np.float64) - true[known])
                scores[label][k] = structure.row(guess, true, known)
    cluster, drawn = sums.clusters(entries)
    return {
        **{key: own[key] for key in ("title", "what", "sensor", "units", "licence", "source", "masked", "group")},
        "pairs": len(entries), "groups": drawn, "folds": max(fold) + 1,
        "masked_share": float(1.0 - pixels[0] / pixels[1]), "shown_in_training": seen,
        "seconds": time.perf_counter() - began,
        "methods": {
            label: {**sums.summary(rows[label].sum(axis=0)), "interval_95": sums.intervals(rows[label], cluster, seed),
                    "structure": structure.summary(scores[label], cluster, seed)}
            for label in labels
        },
    }  # fmt: skip


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
    return [(own["title"], *cells) for own in result["sets"].values() for cells in _cells(own)]


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
            f"- Size: {own['pairs']} pairs in {own['groups']}, {own['folds']} folds",
            f"- Masked: {own['masked']} ({own['masked_share']:.1%} of the pixels)",
            f"- Left out together: {own['group']}", f"- Audit: {_audit(own)}", "",
            f"| {' | '.join(HEADER[1:])} |", "|---|" + "--:|" * (len(HEADER) - 2),
            *(f"| {' | '.join(cells)} |" for cells in _cells(own)), "",
        ]  # fmt: skip
    path.write_text("\n".join(lines), encoding="utf-8")


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
    "The last column is the growth of the MAE when the true picture is shifted by 16 px."
)


def _number(value, sign=""):
    return "" if value is None else f"{value:{sign}.2f}"


def _ends(ends):
    return "" if ends is None else f"{ends[0]:.2f}…{ends[1]:.2f}"
