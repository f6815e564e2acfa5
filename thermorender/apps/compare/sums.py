"""Errors in kelvin as running sums, their statistics, and bootstrap intervals of these and of their differences.

A row (pixels, Σe, Σ|e|, Σe², pixels without temperature) is additive, so a group's statistics follow from its rows.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.apps.training.dataset import Entry

Sums = NDArray[np.float64]
Interval = tuple[float, float]

WIDTH = 5
# Bootstrap.
DRAWS = 1000
CONFIDENCE = 0.95
ENDS = 50.0 * (1.0 - CONFIDENCE), 50.0 * (1.0 + CONFIDENCE)
# With fewer sequences, percentile intervals are too narrow.
FEWEST_SEQUENCES = 10


def into(where: dict[Any, Sums], key: object, row: Sums) -> None:
    """Add a row to that of a key."""
    where[key] = where[key] + row if key in where else row.copy()


def row(error: ArrayLike) -> Sums:
    """Return the (5,) float64 sums of errors of any shape [K]; NaN (no temperature) is counted separately."""
    sums: Sums = rows_by(error, np.zeros(np.shape(error), np.intp), 1)[0]
    return sums


def rows_by(error: ArrayLike, group: ArrayLike, size: int) -> Sums:
    """Return the sums (size, 5) float64 of errors [K] by their group, 0…size − 1; NaN where there is no temperature."""
    flat, groups = np.ravel(error).astype(np.float64), np.ravel(group)
    finite = np.isfinite(flat)
    some, where = flat[finite], groups[finite]
    columns = [np.bincount(where, weights, size) for weights in (None, some, np.abs(some), some * some)]
    return np.stack([*columns, np.bincount(groups[~finite], minlength=size)], axis=-1).astype(np.float64)


def summary(total: ArrayLike) -> dict[str, Any]:
    """Return {me_k, mae_k, sd_k, rmse_k, pixels, pixels_without_temperature} of a row, or None if it is empty.

    `sd_k` is the standard deviation about the mean error: rmse² = me² + sd².
    """
    count, error, absolute, square, without = (float(value) for value in np.asarray(total))
    found: dict[str, float | None] = dict.fromkeys(("me_k", "mae_k", "sd_k", "rmse_k"))
    if count:
        mean = error / count
        found = {
            "me_k": mean,
            "mae_k": absolute / count,
            "sd_k": float(np.sqrt(max(square / count - mean * mean, 0.0))),
            "rmse_k": float(np.sqrt(square / count)),
        }
    return found | {"pixels": int(count), "pixels_without_temperature": int(without)}


def clusters(entries: Sequence[Entry]) -> tuple[NDArray[np.intp], str]:
    """Return (number of each Entry's sequence, the clusters in words); errors within a sequence are correlated."""
    names, number = np.unique([entry.sequence for entry in entries], return_inverse=True)
    return number, f"{len(names)} sequence{'s' if len(names) != 1 else ''}"


def intervals(rows: ArrayLike, cluster: ArrayLike, seed: int = 0) -> dict[str, Interval | None]:
    """Return 95 % intervals {me_k: (low, high), mae_k: (low, high)}; None where fewer than two clusters have pixels.

    Rows (P, 5) of pictures with the same number in `cluster` (P,) are drawn together: percentile bootstrap of 1000
    draws, Efron & Tibshirani, An Introduction to the Bootstrap (1993), section 13.3. Each draw takes as many clusters
    as there are, with replacement.
    """
    number = np.asarray(cluster)
    whole = np.zeros((int(np.max(number, initial=-1)) + 1, WIDTH))
    np.add.at(whole, number, np.asarray(rows, np.float64))
    whole = whole[whole[:, 0] > 0]
    if len(whole) < 2:
        return {"me_k": None, "mae_k": None}
    drawn = np.random.default_rng(seed).multinomial(len(whole), np.full(len(whole), 1.0 / len(whole)), DRAWS) @ whole
    found: dict[str, Interval | None] = {}
    for name, column in (("me_k", 1), ("mae_k", 2)):
        low, high = np.percentile(drawn[:, column] / drawn[:, 0], ENDS).tolist()
        found[name] = low, high
    return found


def widest(
    drawn: Mapping[str, Sequence[Sums] | Sums],
    sd_k: float,
    seed: int,
    others: Mapping[str, dict[str, Any]] | None = None,
) -> dict[str, Any]:
    """Return {interval_95: {me_k, mae_k}, drawn, effective_pixels}, the widest intervals of all units drawn.

    `drawn` holds the rows of each unit by name, `others` intervals of other units, `sd_k` is the standard deviation of
    pixels [K]. The effective number is
    that of independent pixels with the same standard error of the mean error: (σ / standard error)².
    """
    found: list[tuple[str, dict[str, Any]]] = list((others or {}).items())
    for what, units in drawn.items():
        rows = np.asarray(units, float)
        if len(rows) and (rows[:, 0] > 0).sum() > 1:
            found.append((what, intervals(rows, np.arange(len(rows)), seed)))
    if not found:
        return {"interval_95": {"me_k": None, "mae_k": None}, "drawn": None, "effective_pixels": None}
    # The widest of each statistic: the mean may vary with the unit when the mean absolute error does not.
    ends = {name: max((each[name] for _, each in found), key=np.ptp) for name in ("me_k", "mae_k")}
    what = next(what for what, each in found if each["me_k"] == ends["me_k"])
    # The 95 % interval of a normal distribution is 3.92 standard errors wide.
    width = float(np.ptp(ends["me_k"]))
    effective = (sd_k / (width / 3.92)) ** 2 if width > 0.0 else None
    return {"interval_95": ends, "drawn": what, "effective_pixels": effective}


def differences(
    rows: ArrayLike, groups: list[list[int]], cluster: ArrayLike, seed: int = 0
) -> list[tuple[list[int], float | None, Interval | None]]:
    """Return the mean absolute error of each later group minus the first's: [(group, K or None, interval or None)].

    `rows` (M, P, 5) are error sums of each map and picture; `groups` lists maps that differ only in their training
    seed. Only pictures scored by all maps count. 95 % intervals [K] are by percentile bootstrap of 1000 draws of
    clusters (`cluster` (P,)) and of maps within groups. Deviations of n seeds are multiplied by √(n / (n − 1)) for the
    scatter of their own mean. Even so, intervals of three seeds are too short, and one map shows no scatter of seeds.
    """
    rows = np.asarray(rows, np.float64)
    shared = (rows[..., 0] > 0).all(axis=0)
    cluster = np.unique(cluster, return_inverse=True)[1]
    whole = np.zeros((len(rows), int(cluster.max(initial=-1)) + 1, 2))
    for own, each in zip(whole, rows, strict=True):
        np.add.at(own, cluster[shared], each[shared][:, [2, 0]])
    kept = whole[:, whole[0, :, 1] > 0]
    if not kept.shape[1]:
        return [(group, None, None) for group in groups[1:]]
    generator = np.random.default_rng(seed)
    times = generator.multinomial(kept.shape[1], np.full(kept.shape[1], 1.0 / kept.shape[1]), DRAWS)
    drawn = _mean(times, kept)
    measured, errors = [], []
    for group in groups:
        own = drawn[group]
        centre = own.mean(axis=0)
        if len(group) > 1:
            chosen = generator.integers(len(group), size=(len(group), DRAWS))
            wider = np.sqrt(len(group) / (len(group) - 1.0))
            errors.append(centre + wider * (np.take_along_axis(own, chosen, axis=0).mean(axis=0) - centre))
        else:
            errors.append(centre)
        measured.append(float(_mean(np.ones((1, kept.shape[1])), kept[group]).mean()))
    found: list[tuple[list[int], float | None, Interval | None]] = []
    for group, error, mean in zip(groups[1:], errors[1:], measured[1:], strict=True):
        low, high = np.percentile(error - errors[0], ENDS).tolist()
        found.append((group, mean - measured[0], (low, high) if kept.shape[1] > 1 else None))
    return found


def _mean(times: NDArray[np.number], sums: Sums) -> NDArray[np.float64]:
    """Return mean absolute errors (maps, draws) of (maps, clusters, 2) sums, each cluster repeated `times`."""
    absolute, count = (sums[..., column] @ times.T for column in (0, 1))
    return absolute / count
