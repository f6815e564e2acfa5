"""Audit of a split for leakage: what test pairs share with training pairs.

It counts five kinds of leak: a crop of the same picture; another picture of the same content; a neighbour in the same
sequence; the same place; the same kind of land at the same hour in the same weather. Thermal pictures and truth are not
used.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from thermorender.apps.training import duplicates
from thermorender.apps.training.dataset import Dataset, Entry
from thermorender.apps.training.kept_searches import kept
from thermorender.apps.training.splits import positions
from thermorender.errors import ThermorenderError
from thermorender.progress import Progress

# Pictures taken within this distance show the same place [m]. Chosen: half the width of a view from 120 m.
NEAR_M = 50.0
# Differences up to these count as the same hour and weather. Chosen: they change surfaces by a few kelvin at most.
_ALIKE = {
    "solar_hour": 1.0, "day": 15.0, "air_k": 2.0, "wind_m_s": 2.0, "direct_w_m2": 100.0, "diffuse_w_m2": 100.0,
    "longwave_w_m2": 30.0, "snow_m": 0.05,
}  # fmt: skip
_PERIOD = {"solar_hour": 24.0, "day": 365.25}
# Labels, and names of the known conditions, of a pair.
Circumstances = tuple[tuple[tuple[str, str], ...], tuple[str, ...]]
# How validation pictures lose what training shows of them.
_MENDED = {
    "sibling": "keep the crops of a picture in one part with `prepare --split sequence`",
    "duplicate": "leave the copies out of the data set, or give a split that keeps them in one part",
}
# A share of the test pairs too small to affect a mean.
_FEW = 0.05
_MOST_NAMED = 5


@dataclass(frozen=True)
class Leak:
    """One kind of leak from training to test pairs."""

    kind: str  # Of `KINDS`, or "duplicate"
    tests: int  # Test pairs with this leak
    asked: int  # Test pairs that could be checked; the others lack a place, or labels and conditions
    median: float | None  # Median over the leaking pairs of the measure that `KINDS` names
    worst: tuple[tuple[str, str, float], ...]  # Test pair, training pair and measure, worst first

    @property
    def share(self) -> float:
        """Share of the checked test pairs with this leak; 0 if none could be checked."""
        return self.tests / self.asked if self.asked else 0.0

    def __str__(self) -> str:
        words = KINDS[self.kind]
        if not self.asked:
            return f"unknown {words.unknown}"
        text = f"{_part(self.tests, self.asked)} have {words.noun} in training"
        if not self.tests:
            return text
        named = ", ".join(f"{test} – {train} ({words.measure.format(value)})" for test, train, value in self.worst)
        return f"{text}, median {words.measure.format(self.median)}; worst: {named}"


@dataclass(frozen=True)
class Audit:
    """The audit of a split."""

    # tests, training: Number of pairs
    tests: int
    training: int
    leaks: dict[str, Leak]  # By kind, most severe first

    @property
    def verdict(self) -> str:
        """One sentence: the most severe leak, and what a score on this split then measures."""
        for kind, leak in self.leaks.items():
            if leak.tests:
                words = KINDS[kind]
                whole = "this split" if leak.share >= _FEW else "these"
                return f"{_part(leak.tests, leak.asked)} have {words.noun} in training: results on {whole} {words.then}"
        unknown = [KINDS[kind].short for kind, leak in self.leaks.items() if not leak.asked]
        but = f", as far as can be checked without {' and '.join(unknown)}" if unknown else ""
        text = f"none of the {self.tests} test pairs has a leak from training"
        return f"{text}: results on this split measure new pictures{but}"

    def lines(self) -> list[str]:
        """Return the audit as lines of text, the verdict first."""
        return [self.verdict, *map(str, self.leaks.values())]

    def summary(self) -> dict[str, Any]:
        """Return the audit as plain values for JSON."""
        return {
            "verdict": self.verdict,
            "tests": self.tests,
            "training": self.training,
            "leaks": {kind: {**asdict(leak), "share": leak.share} for kind, leak in self.leaks.items()},
        }


@dataclass(frozen=True)
class _Words:
    """Wording for a kind of leak: what a test pair has, its measure, what scores then measure, what may be missing."""

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
        "a picture of the same place", "{:.0f} m apart", "measure land seen in training",
        "whether places coincide: no test pair or no training pair has one", "places",
    ),
    "conditions": _Words(
        "the same land, hour and weather", "{:.2f} of the tolerance", "do not measure other land, hours or weather",
        "whether land, hour and weather coincide: labels and conditions are missing", "labels and conditions",
    ),
}  # fmt: skip


def audit(dataset: Dataset, near_m: float = NEAR_M, progress: Progress | None = None) -> Audit:
    """Return the Audit of a Dataset's parts train and test; places coincide within `near_m` [m].

    It reads each visible picture once: about 9 s and 60 MB per 1000 pictures of 256×256 pixels. A later audit of the
    same pairs finds the result in the cache. `progress` takes (task, fraction done).
    """
    test, train = dataset.of("test").entries, dataset.of("train").entries
    for part, entries in (("test", test), ("train", train)):
        if not entries:
            raise ThermorenderError(
                f"{dataset.folder} has no pairs in part {part!r}; split it so that training and test both have some"
            )
    key = ("audit", dataset.digest(), near_m)
    found = kept(key, lambda: _searched(dataset, near_m, progress or (lambda task, fraction: None)).summary())
    leaks = {
        kind: Leak(kind, each["tests"], each["asked"], each["median"], tuple(map(tuple, each["worst"])))
        for kind, each in found["leaks"].items()
    }
    return Audit(found["tests"], found["training"], leaks)


def _searched(dataset: Dataset, near_m: float, report_progress: Progress) -> Audit:
    """Return the Audit of a Dataset by reading its pictures."""
    test, train = dataset.of("test").entries, dataset.of("train").entries
    known, wanted, mirrored = [], [], []
    for number, entry in enumerate((*test, *train), 1):
        rgb = dataset.pair(entry, truth=False).visible
        if number > len(test):
            known.append(duplicates.sketch(rgb))
        else:
            wanted.append(duplicates.sketch(rgb))
            mirrored.append(duplicates.sketch(rgb[:, ::-1]))
        report_progress("reading pictures", number / (len(test) + len(train)))
    matches = duplicates.find(
        [*wanted, *mirrored], known, lambda fraction: report_progress("comparing pictures", fraction)
    )
    duplicated = {}
    for entry, *both in zip(test, matches[: len(test)], matches[len(test) :], strict=True):
        best = max(filter(None, both), key=lambda match: match.overlap * match.correlation, default=None)
        if best is not None:
            duplicated[entry.key] = train[best.index].key, best.overlap
    leaks = {
        "sibling": siblings(test, train),
        "duplicate": _leak("duplicate", duplicated, len(test), worst=max),
        "neighbour": neighbours(test, train),
        "place": places(test, train, near_m, lands=dataset.card.get("origin") == "rendered"),
        "conditions": alike(test, train),
    }
    return Audit(len(test), len(train), leaks)


def memory_of(tests: Sequence[tuple[Dataset, Dataset]], progress: Progress | None = None) -> str | None:
    """Return a sentence if pairs left out are crops or copies of the pairs that a map is fitted to, else None.

    `tests` are [(pairs to fit, pairs left out)], as by `map_training.held_out`.
    """
    # An audit looks at the test part.
    found = [
        audit(out.having([*(replace(entry, part="train") for entry in kept.entries),
                          *(replace(entry, part="test") for entry in out.entries)]), progress=progress)
        for kept, out in tests
    ]  # fmt: skip
    for kind, mend in _MENDED.items():
        leaks = [each.leaks[kind] for each in found]
        number, asked = sum(each.tests for each in leaks), sum(each.asked for each in leaks)
        if number:
            worst = next(each.worst[0] for each in leaks if each.tests)
            return (
                f"{number} of {asked} pictures left out have {KINDS[kind].noun} in training, such as {worst[0]} – "
                f"{worst[1]}: their error measures memory, not new pictures; {mend}"
            )
    return None


def siblings(test: Sequence[Entry], train: Sequence[Entry]) -> Leak:
    """Return the Leak of test Entries cropped from the same picture as a training Entry."""
    known: dict[str, Entry] = {}
    for entry in train:
        known.setdefault(entry.parent, entry)
    found = {
        entry.key: (known[entry.parent].key, abs(known[entry.parent].order - entry.order))
        for entry in test
        if entry.parent in known
    }
    return _leak("sibling", found, len(test))


def neighbours(test: Sequence[Entry], train: Sequence[Entry]) -> Leak:
    """Return the Leak of test Entries with a training Entry in the same sequence, siblings excluded."""
    sequences: dict[str, list[Entry]] = {}
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


def places(test: Sequence[Entry], train: Sequence[Entry], near_m: float = NEAR_M, lands: bool = False) -> Leak:
    """Return the Leak of test Entries within `near_m` of a training Entry [m].

    With `lands`, each sequence is a separate land, since all procedural worlds of a kind share one nominal place.
    """
    from scipy.spatial import cKDTree

    test, train = ([entry for entry in entries if entry.place is not None] for entries in (test, train))
    if not test or not train:
        return _leak("place", {}, 0)
    names = {entry.sequence: number for number, entry in enumerate((*test, *train))} if lands else {}

    def points(entries: Sequence[Entry]) -> np.ndarray:
        # Lands are separated in a fourth dimension by more than `near_m`.
        aside = [2.0 * near_m * names.get(entry.sequence, 0) for entry in entries]
        return np.column_stack([positions(entries), aside])

    apart, nearest = cKDTree(points(train)).query(points(test), distance_upper_bound=near_m)
    found = {
        entry.key: (train[k].key, float(metres))
        for entry, metres, k in zip(test, apart, nearest, strict=True)
        if math.isfinite(metres)
    }
    return _leak("place", found, len(test))


def alike(test: Sequence[Entry], train: Sequence[Entry]) -> Leak:
    """Return the Leak of test Entries with a training Entry of the same labels, hour and weather."""
    from scipy.spatial import cKDTree

    known: dict[Circumstances, list[Entry]] = {}
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


def _circumstances(entry: Entry) -> Circumstances:
    """What must be equal: the labels, and the set of known conditions."""
    return tuple(sorted(entry.labels.items())), tuple(_known(entry))


def _known(entry: Entry) -> dict[str, float]:
    """{name: value} of the known conditions that are compared."""
    return {name: entry.conditions[name] for name in _ALIKE if math.isfinite(entry.conditions.get(name, math.nan))}


def _scaled(entry: Entry) -> list[float]:
    """Conditions in units of their tolerance, periodic ones on a circle; a single 0 if none is known."""
    found = [0.0]
    for name, value in _known(entry).items():
        if name in _PERIOD:
            radius = _PERIOD[name] / (2.0 * math.pi)
            found += [radius * turn(value / radius) / _ALIKE[name] for turn in (math.cos, math.sin)]
        else:
            found.append(value / _ALIKE[name])
    return found


def _leak(
    kind: str, found: Mapping[str, tuple[str, float]], asked: int, worst: Callable[..., Any] = min
) -> Leak:  # fmt: skip
    """The Leak of {test key: (training key, measure)}; `worst` is min or max, whichever measure is worst."""
    rows = sorted(
        ((test, train, value) for test, (train, value) in found.items()),
        key=lambda row: row[2], reverse=worst is max,
    )  # fmt: skip
    median = float(np.median([row[2] for row in rows])) if rows else None
    return Leak(kind, len(rows), asked, median, tuple(rows[:_MOST_NAMED]))


def _part(count: int, whole: int) -> str:
    """Words for a number of test pairs."""
    return f"{count} of {whole} test pairs ({100.0 * count / whole:.3g} %)"
