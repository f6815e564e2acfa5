"""What learned maps lose with less to learn from, and with pairs that are not aligned.

Each method is trained on a growing share of the training part's sequences, and on all of it with thermal pictures moved
against the visible ones by 0 to 16 pixels; the mean absolute error is that on the test part, which is never moved.
Beside it the seconds of each training: error against run time.
"""

import numpy as np

from thermorender.campaign.map_inputs import ground_of, inputs_of
from thermorender.campaign.map_training import train_map
from thermorender.errors import ThermorenderError
from thermorender.frame import apparent_temperature
from thermorender.learned.methods import method
from thermorender.validate.bench import machine
from thermorender.versions import versions

METHODS = ("correlation-1to1", "correlation-9to1", "correlation-5x5", "palette", "correlation+")
SHIFTS_PX = (0.0, 1.0, 2.0, 4.0, 8.0, 16.0)
SHARES = (0.02, 0.05, 0.1, 0.25, 0.5, 1.0)
HEADER = ("method", "varied", "value", "pairs", "training [s]", "mean absolute error [K]")
# Every so many rows and columns of a test picture are scored: neighbours err alike.
_EVERY = 2


def run(dataset, methods=METHODS, shifts_px=SHIFTS_PX, shares=SHARES, limit=60, seed=0, progress=None):
    """Return mean absolute errors of methods against the shift of pairs and the share of training data; plain numbers.

    Parameters
    ----------
    dataset : Dataset
        With parts to train and to test on.
    methods : sequence of str
    shifts_px, shares : sequence of float
    limit : int
        Test pairs that are scored, evenly spaced.
    seed : int
    progress : callable, optional
        Called with (what, share done).

    Raises
    ------
    ThermorenderError
        An unknown method, or a data set without a test part.
    """
    for name in methods:
        method(name)
    test = dataset.of("test")
    if not len(test):
        raise ThermorenderError(f"{dataset.folder} has no pairs of part 'test'; give a data set or a split with some")
    chosen = np.unique(np.linspace(0, len(test) - 1, min(limit, len(test))).astype(int))
    scored = [test.entries[k] for k in chosen]
    cases = [(name, "share", value) for name in methods for value in shares]
    cases += [(name, "shift_px", value) for name in methods for value in shifts_px if value]
    found = []
    for number, (name, varied, value) in enumerate(cases):
        if progress:
            progress(f"{name}, {varied} {value:g}", number / len(cases))
        model = train_map(name, name, dataset, seed=seed, **{varied: value})
        found.append({
            "method": name, "varied": varied, "value": value, "pairs": sum(model.about["pairs"].values()),
            "training_s": model.about["training_s"], "mae_k": _error(model, test, scored),
        })  # fmt: skip
    # Nothing moved is all of the training part.
    whole = [{**case, "varied": "shift_px", "value": 0.0} for case in found
             if case["varied"] == "share" and case["value"] == 1.0 and 0.0 in shifts_px]  # fmt: skip
    return {
        "dataset": dataset.card.get("name"), "test_pairs": len(scored), "seed": seed, "cases": found + whole,
        "machine": machine(), "versions": versions(),
    }  # fmt: skip


def rows(result):
    """Return the rows of a result's table."""
    return [
        (case["method"], case["varied"], f"{case['value']:g}", case["pairs"], case["training_s"],
         f"{case['mae_k']:.3f}")
        for case in result["cases"]
    ]  # fmt: skip


def _error(model, dataset, entries):
    """Mean absolute error of a map on ground [K]."""
    total, count = 0.0, 0
    for entry in entries:
        pair = dataset.pair(entry)
        inputs = inputs_of(pair, dataset.card)
        part = np.s_[::_EVERY, ::_EVERY]
        given, true = (apparent_temperature(each[part], model.band_um) for each in
                       (model.radiance(inputs), pair.reference))  # fmt: skip
        known = ground_of(pair)[part] & np.isfinite(given)
        total += float(np.abs(given.astype(np.float64) - true)[known].sum())
        count += int(known.sum())
    return total / max(count, 1)
