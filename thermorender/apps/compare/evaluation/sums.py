"""Errors in kelvin as running sums: mean error, mean absolute error and standard deviation of any set of pixels.

A row of sums is (pixels, Σe, Σ|e|, Σe², pixels without temperature). Rows can be added: each picture is read once, and
the statistics of any group of pictures follow from their rows.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.apps.training.dataset import Entry

Interval = tuple[float, float]

WIDTH = 5
# Bootstrap.
DRAWS = 1000
CONFIDENCE = 0.95
# With fewer sequences, percentile intervals are too narrow.
FEWEST_SEQUENCES = 10


def row(error: ArrayLike) -> NDArray[np.float64]:
    """Return the (5,) float64 sums of errors of any shape [K]; NaN (no temperature) is counted separately."""
    sums: NDArray[np.float64] = rows_by(error, np.zeros(np.shape(error), np.intp), 1)[0]
    return sums


def rows_by(error: ArrayLike, group: ArrayLike, size: int) -> NDArray[np.float64]:
    """Return the sums of each group, (size, 5) float64.

    Parameters
    ----------
    error : array
        [K]; NaN where there is no temperature.
    group : array of int
        Group of each error, 0…size − 1.
    size : int
    """
    flat, groups = np.ravel(error).astype(np.float64), np.ravel(group)
    finite = np.isfinite(flat)
    some, where = flat[finite], groups[finite]
    columns = [np.bincount(where, weights, size) for weights in (None, some, np.abs(some), some * some)]
    return np.stack([*columns, np.bincount(groups[~finite], minlength=size)], axis=-1).astype(np.float64)


def summary(total: ArrayLike) -> dict[str, Any]:
    """Return {me_k, mae_k, sd_k, rmse_k, pixels, pixels_without_temperature} of a row; None where there are no pixels.

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
    """Return (number of each Entry's sequence, the clusters in words).

    Errors of one drive, flight or landscape are correlated: drawing single pictures would make intervals too narrow.
    """
    names, number = np.unique([entry.sequence for entry in entries], return_inverse=True)
    return number, f"{len(names)} sequence{'s' if len(names) != 1 else ''}"


def intervals(rows: ArrayLike, cluster: ArrayLike, seed: int = 0) -> dict[str, Interval | None]:
    """Return 95 % intervals {me_k: (low, high), mae_k: (low, high)}; None where fewer than two clusters have pixels.

    Parameters
    ----------
    rows : (P, 5) array
        Sums of each picture.
    cluster : (P,) array of int
        Pictures with the same number are drawn together.
    seed : int

    Notes
    -----
    Percentile bootstrap of 1000 draws, Efron & Tibshirani, An Introduction to the Bootstrap (1993), section 13.3:
    each draw takes as many clusters as there are, with replacement.
    """
    number = np.asarray(cluster)
    whole = np.zeros((int(np.max(number, initial=-1)) + 1, WIDTH))
    np.add.at(whole, number, np.asarray(rows, np.float64))
    whole = whole[whole[:, 0] > 0]
    if len(whole) < 2:
        return {"me_k": None, "mae_k": None}
    times = np.random.default_rng(seed).multinomial(len(whole), np.full(len(whole), 1.0 / len(whole)), DRAWS)
    drawn = times @ whole
    ends = 50.0 * (1.0 - CONFIDENCE), 50.0 * (1.0 + CONFIDENCE)
    found: dict[str, Interval | None] = {}
    for name, column in (("me_k", 1), ("mae_k", 2)):
        low, high = np.percentile(drawn[:, column] / drawn[:, 0], ends).tolist()
        found[name] = low, high
    return found
