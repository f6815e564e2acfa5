"""Errors of learned maps with less training data, with misaligned pairs, and on a kind of land absent from training.

Each method is trained on a growing share of the training part's sequences, on all of it with thermal pictures shifted
by 0 to 16 pixels, and without each kind of land. The mean absolute error is that on the test part, which is never
shifted, or on its pairs of the kind left out. The time of each training is recorded, too.
"""

import numpy as np

from thermorender.apps.compare.machine import machine
from thermorender.apps.training.map_inputs import ground_of, inputs_of
from thermorender.apps.training.map_training import has_conditions, refuse_missing_conditions, train_map
from thermorender.apps.training.training_methods import method
from thermorender.errors import ThermorenderError
from thermorender.frame import apparent_temperature
from thermorender.versions import versions

METHODS = ("correlation-1to1", "correlation-9to1", "correlation-5x5", "palette", "correlation+")
# In addition to the whole training part without a shift.
SHIFTS_PX = (1.0, 2.0, 4.0, 8.0, 16.0)
SHARES = (0.02, 0.05, 0.1, 0.25, 0.5)
VARIED = ("share", "shift_px", "kind")
HEADER = ("method", "varied", "value", "pairs", "training [s]", "mean absolute error [K]", "with this kind [K]")
# Spacing of the scored rows and columns of a test picture; errors of neighbours are correlated.
_EVERY = 2


def run(dataset, methods=None, vary=None, limit=60, seed=0, progress=None):
    """Return mean absolute errors of methods against their training data, as plain numbers.

    Parameters
    ----------
    dataset : Dataset
        With a training and a test part.
    methods : sequence of str, optional
        `METHODS` by default, as far as the data set allows.
    vary : sequence of str, optional
        Some of `VARIED`; all by default, but "kind" only if the pairs are labelled with several kinds.
    limit : int
        Number of test pairs to score, evenly spaced.
    seed : int
    progress : callable, optional
        Called with (step, share done).

    Returns
    -------
    dict
        Its "cases" have method, varied, value, pairs, training_s, mae_k. For a kind left out, seen_mae_k is the error
        of the map trained on all kinds on the same pairs.

    Raises
    ------
    ThermorenderError
        An unknown method or variation, a method whose inputs the data set lacks, "kind" with a single kind, or no test
        part.
    """
    if methods is None:
        methods = [name for name in METHODS if has_conditions(dataset) or not method(name).plus]
    for name in methods:
        refuse_missing_conditions(name, dataset)
    test = dataset.of("test")
    if not len(test):
        raise ThermorenderError(f"{dataset.folder} has no pairs of part 'test'; give a data set with a test part")
    kinds = sorted({entry.labels["kind"] for entry in dataset.of("train").entries if "kind" in entry.labels})
    vary = tuple(vary or (VARIED if len(kinds) > 1 else VARIED[:2]))
    for each in vary:
        if each not in VARIED:
            raise ThermorenderError(f"vary={each!r} is unknown; give {', '.join(VARIED)}")
    if "kind" in vary and len(kinds) < 2:
        raise ThermorenderError(f"{dataset.folder} has a single kind of land, which cannot be left out; drop 'kind'")
    chosen = np.unique(np.linspace(0, len(test) - 1, min(limit, len(test))).astype(int))
    scored = [test.entries[k] for k in chosen]
    # Without the validation part, which would be the same for every share.
    train = dataset.of("train")
    values = {
        "share": SHARES,
        "shift_px": SHIFTS_PX,
        # Kinds that occur in the test pairs.
        "kind": [kind for kind in kinds if any(entry.labels.get("kind") == kind for entry in scored)],
    }
    changes = [(None, None), *((each, value) for each in vary for value in values[each])]
    cases = [(name, *change) for name in methods for change in changes]
    found = []
    for number, (name, varied, value) in enumerate(cases):
        if progress:
            progress(f"{name}, {varied} {value}" if varied else name, number / len(cases))
        pairs, options = train, {varied: value} if varied in ("share", "shift_px") else {}
        if varied == "kind":
            pairs = train.having([entry for entry in train.entries if entry.labels.get("kind") != value])
        model = train_map(name, name, pairs, seed=seed, parts=("train",), judged=False, **options)
        here = [varied != "kind" or entry.labels.get("kind") == value for entry in scored]
        errors = _errors(model, test, [entry for entry, of_kind in zip(scored, here, strict=True) if of_kind])
        case = {"method": name, "pairs": sum(model.about["pairs"].values()), "training_s": model.about["training_s"],
                "mae_k": _mean(errors)}  # fmt: skip
        if varied is None:
            whole = errors
            # The whole training part without a shift is an end of both curves.
            ends = {"share": 1.0, "shift_px": 0.0}
            found += [{**case, "varied": each, "value": end} for each, end in ends.items() if each in vary]
        else:
            seen = {"seen_mae_k": _mean(whole[here])} if varied == "kind" else {}
            found.append({**case, "varied": varied, "value": value, **seen})
    return {
        "dataset": dataset.card.get("name"), "test_pairs": len(scored), "seed": seed, "cases": found,
        "machine": machine(), "versions": versions(),
    }  # fmt: skip


def rows(result):
    """Return the result as table rows under HEADER."""
    order = sorted(result["cases"], key=lambda case: (VARIED.index(case["varied"]), case["method"], case["value"]))
    return [
        (case["method"], case["varied"], str(case["value"]), case["pairs"], case["training_s"], f"{case['mae_k']:.3f}",
         f"{case['seen_mae_k']:.3f}" if "seen_mae_k" in case else "")
        for case in order
    ]  # fmt: skip


def _mean(errors):
    """Return the mean absolute error [K] of (n, 2) sums and numbers of pixels."""
    return float(errors[:, 0].sum() / max(errors[:, 1].sum(), 1))


def _errors(model, dataset, entries):
    """Return the sum of absolute errors of a map on ground [K] and the number of pixels of each pair, (n, 2)."""
    found = np.zeros((len(entries), 2))
    for row, entry in zip(found, entries, strict=True):
        pair = dataset.pair(entry)
        inputs = inputs_of(pair, dataset.card)
        part = np.s_[::_EVERY, ::_EVERY]
        given, true = (apparent_temperature(each[part], model.band_um) for each in
                       (model.radiance(inputs), pair.reference))  # fmt: skip
        known = ground_of(pair)[part] & np.isfinite(given)
        row[:] = np.abs(given.astype(np.float64) - true)[known].sum(), known.sum()
    return found
