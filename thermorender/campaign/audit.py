"""What test pairs share with training pairs: the audit of a split for leaks.

A score on test pairs tells of new pictures only as far as training has seen nothing of them. Five ways in which it may
have are counted: a sibling cut from the same picture; another picture that shows the same; a neighbour in the same
sequence; the same place; and the same kind of land at the same hour in the same weather. The thermal pictures and the
truth are not asked.
"""

import math
from dataclasses import asdict, dataclass

import numpy as np

from thermorender.campaign import duplicates
from thermorender.campaign.splits import positions
from thermorender.errors import ThermorenderError

# Pictures taken within this of each other show the same place [m]. Chosen: half the width of a view from 120 m.
NEAR_M = 50.0
# So much apart is the same hour and weather. Chosen: less changes surfaces by a few kelvin at most.
_ALIKE = {
    "solar_hour": 1.0, "day": 15.0, "air_k": 2.0, "wind_m_s": 2.0, "direct_w_m2": 100.0, "diffuse_w_m2": 100.0,
    "longwave_w_m2": 30.0, "snow_m": 0.05,
}  # fmt: skip
_PERIOD = {"solar_hour": 24.0, "day": 365.25}
# A part of the test pairs too small to colour a mean.
_FEW = 0.05
_MOST_NAMED = 5


@dataclass(frozen=True)
class Leak:
    """A way in which training knows test pairs.

    Attributes
    ----------
    kind : str
        Of `KINDS`, or "duplicate".
    tests : int
        Test pairs that training knows this way.
    asked : int
        Test pairs of which it could be told; the others lack a place, or labels and conditions.
    median : float or None
        Of the measure that `KINDS` names, over those pairs.
    worst : tuple of (str, str, float)
        Test pair, training pair and measure, the worst first.
    """

    kind: str
    tests: int
    asked: int
    median: float | None
    worst: tuple

    @property
    def share(self):
        """Share of the test pairs of which it could be told; 0 where that are none."""
        return self.tests / self.asked if self.asked else 0.0

    def __str__(self):
        words = KINDS[self.kind]
        if not self.asked:
            return f"not known {words.unknown}"
        text = f"{_part(self.tests, self.asked)} have {words.noun} in training"
        if not self.tests:
            return text
        named = ", ".join(f"{test} – {train} ({words.measure.format(value)})" for test, train, value in self.worst)
        return f"{text}, median {words.measure.format(self.median)}; worst: {named}"


@dataclass(frozen=True)
class Audit:
    """The audit of a split.

    Attributes
    ----------
    tests, training : int
        Pairs.
    leaks : dict of str to Leak
        By kind, the gravest first.
    """

    tests: int
    training: int
    leaks: dict

    @property
    def verdict(self):
        """One sentence: the gravest leak and what a score on this split then measures."""
        for kind, leak in self.leaks.items():
            if leak.tests:
                words = KINDS[kind]
                whole = "this split" if leak.share >= _FEW else "these"
                return f"{_part(leak.tests, leak.asked)} have {words.noun} in training: results on {whole} {words.then}"
        unknown = [KINDS[kind].short for kind, leak in self.leaks.items() if not leak.asked]
        but = f", as far as can be told without {' and '.join(unknown)}" if unknown else ""
        return f"training knows none of the {self.tests} test pairs: results on this split measure new pictures{but}"

    def lines(self):
        """Return the audit as lines of text, the verdict first."""
        return [self.verdict, *map(str, self.leaks.values())]

    def summary(self):
        """Return the audit as plain values for JSON."""
        return {
            "verdict": self.verdict,
            "tests": self.tests,
            "training": self.training,
            "leaks": {kind: {**asdict(leak), "share": leak.share} for kind, leak in self.leaks.items()},
        }


@dataclass(frozen=True)
class _Words:
    """How a kind of leak is told: what a test pair has, its measure, what scores then do, and what may be missing."""

    noun: str
    measure: str
    then: str
    unknown: str = ""
    short: str = ""


_MEMORY = "measure memory"
KINDS = {
    "sibling": _Words("a sibling", "{:.0f} apart in order", _MEMORY),
    "duplicate": _Words("a picture that shows the same", "{:.0%} covered", _MEMORY),
    "neighbour": _Words(
        "a neighbour in the same sequence", "{:.0f} apart in order", "measure this flight, not new land"
    ),
    "place": _Words(
        "a picture of the same place", "{:.0f} m apart", "measure known land",
        "whether places are the same: no test pair or no training pair has one", "places",
    ),
    "conditions": _Words(
        "the same land, hour and weather", "{:.2f} of what is alike", "do not tell of other land, hours or weather",
        "whether land, hour and weather are the same: labels and conditions are missing", "labels and conditions",
    ),
}  # fmt: skip


def audit(dataset, near_m=NEAR_M, progress=None):
    """Return the Audit of a Dataset's parts train and test.

    Parameters
    ----------
    dataset : Dataset
        Its visible pictures are read, each once: about 9 s and 60 MB for 1000 of 256×256 pixels.
    near_m : float
        Distance within which places are the same [m].
    progress : callable, optional
        Called with (what, share done).

    Raises
    ------
    ThermorenderError
        A part without pairs, or a damaged shard.
    """
    tell = progress or (lambda what, share: None)
    test, train = dataset.of("test").entries, dataset.of("train").entries
    for part, entries in (("test", test), ("train", train)):
        if not entries:
            raise ThermorenderError(
                f"{dataset.folder} has no pairs in part {part!r}; split it so that training and test have some"
            )
    sketches = {}
    for number, entry in enumerate((*test, *train), 1):
        sketches[entry.key] = duplicates.sketch(dataset.pair(entry, truth=False).visible)
        tell("reading pictures", number / (len(test) + len(train)))
    same = duplicates.find(
        [sketches[entry.key] for entry in test], [sketches[entry.key] for entry in train],
        lambda share: tell("comparing pictures", share),
    )  # fmt: skip
    shown = {
        entry.key: (train[match.index].key, match.overlap)
        for entry, match in zip(test, same, strict=True)
        if match is not None
    }
    leaks = {
        "sibling": siblings(test, train),
        "duplicate": _leak("duplicate", shown, len(test), worst=max),
        "neighbour": neighbours(test, train),
        "place": places(test, train, near_m, lands=dataset.card.get("origin") == "rendered"),
        "conditions": alike(test, train),
    }
    return Audit(len(test), len(train), leaks)


def siblings(test, train):
    """Return the Leak of test Entries that are cut from the same picture as one of training."""
    known = {}
    for entry in train:
        known.setdefault(entry.parent, entry)
    found = {
        entry.key: (known[entry.parent].key, abs(known[entry.parent].order - entry.order))
        for entry in test
        if entry.parent in known
    }
    return _leak("sibling", found, len(test))


def neighbours(test, train):
    """Return the Leak of test Entries with one of training from the same sequence, siblings aside."""
    sequences = {}
    for entry in train:
        sequences.setdefault(entry.sequence, []).append(entry)
    orders = {name: np.array([entry.order for entry in entries]) for name, entries in sequences.items()}
    parents = {name: np.array([entry.parent for entry in entries]) for name, entries in sequences.items()}
    found = {}
    for entry in test:
        if entry.sequence in sequences:
            apart = np.abs(orders[entry.sequence] - entry.order).astype(np.float64)
            apart[parents[entry.sequence] == entry.parent] = np.inf
            nearest = int(apart.argmin())
            if np.isfinite(apart[nearest]):
                found[entry.key] = (sequences[entry.sequence][nearest].key, float(apart[nearest]))
    return _leak("neighbour", found, len(test))


def places(test, train, near_m=NEAR_M, lands=False):
    """Return the Leak of test Entries that lie within `near_m` of one of training [m].

    With `lands` each sequence is a land of its own, as procedural worlds are, which all lie at their kind's one place.
    """
    from scipy.spatial import cKDTree

    test, train = ([entry for entry in entries if entry.place is not None] for entries in (test, train))
    if not test or not train:
        return _leak("place", {}, 0)
    names = {entry.sequence: number for number, entry in enumerate((*test, *train))} if lands else {}

    def points(entries):
        # Lands lie side by side in a fourth dimension, farther than any distance.
        aside = [2.0 * near_m * names.get(entry.sequence, 0) for entry in entries]
        return np.column_stack([positions(entries), aside])

    apart, nearest = cKDTree(points(train)).query(points(test), distance_upper_bound=near_m)
    found = {
        entry.key: (train[k].key, float(metres))
        for entry, metres, k in zip(test, apart, nearest, strict=True)
        if math.isfinite(metres)
    }
    return _leak("place", found, len(test))


def alike(test, train):
    """Return the Leak of test Entries with one of training of the same labels, hour and weather."""
    from scipy.spatial import cKDTree

    known = {}
    for entry in train:
        known.setdefault(_circumstances(entry), []).append(entry)
    trees = {name: cKDTree([_scaled(entry) for entry in entries]) for name, entries in known.items()}
    test = [entry for entry in test if entry.labels or entry.conditions]
    found = {}
    for entry in test:
        name = _circumstances(entry)
        if name in trees:
            apart, nearest = trees[name].query(_scaled(entry), p=np.inf, distance_upper_bound=1.0)
            if math.isfinite(apart):
                found[entry.key] = (known[name][nearest].key, float(apart))
    return _leak("conditions", found, len(test))


def _circumstances(entry):
    """What has to be equal: the labels, and which conditions are known."""
    return tuple(sorted(entry.labels.items())), tuple(_known(entry))


def _known(entry):
    """{name: value} of the conditions that count."""
    return {name: entry.conditions[name] for name in _ALIKE if math.isfinite(entry.conditions.get(name, math.nan))}


def _scaled(entry):
    """The conditions in units of what is alike, those that come round on a circle; one 0 where none is known."""
    found = [0.0]
    for name, value in _known(entry).items():
        if name in _PERIOD:
            radius = _PERIOD[name] / (2.0 * math.pi)
            found += [radius * turn(value / radius) / _ALIKE[name] for turn in (math.cos, math.sin)]
        else:
            found.append(value / _ALIKE[name])
    return found


def _leak(kind, found, asked, worst=min):
    """The Leak of {test key: (training key, measure)}; `worst` is min or max, the measure that is worst."""
    rows = sorted(
        ((test, train, value) for test, (train, value) in found.items()),
        key=lambda row: row[2], reverse=worst is max,
    )  # fmt: skip
    median = float(np.median([row[2] for row in rows])) if rows else None
    return Leak(kind, len(rows), asked, median, tuple(rows[:_MOST_NAMED]))


def _part(count, whole):
    return f"{count} of {whole} test pairs ({100.0 * count / whole:.3g} %)"
