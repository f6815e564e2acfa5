"""Errors in kelvin as running sums: mean error, mean absolute error and deviation of any union of pictures.

A row of sums is (pixels, Σe, Σ|e|, Σe², pixels without temperature). Rows add up, so that a picture or a class of its
pixels is read once, and any group of pictures is judged from their rows.
"""

import numpy as np

WIDTH = 5
# Of the bootstrap.
DRAWS = 1000
CONFIDENCE = 0.95
# From so many sequences on, these are drawn; where there are fewer, parents are.
FEWEST_SEQUENCES = 10


def row(error):
    """Return the (5,) float64 sums of errors of any shape [K]; NaN (no temperature) is counted apart."""
    return rows_by(error, np.zeros(np.shape(error), np.intp), 1)[0]


def rows_by(error, group, size):
    """Return the sums of each group, (size, 5) float64.

    Parameters
    ----------
    error : array
        [K]; NaN where there is no temperature.
    group : array of int
        Of the shape of `error`: 0…size − 1.
    size : int
    """
    error, group = np.ravel(error).astype(np.float64), np.ravel(group)
    finite = np.isfinite(error)
    some, where = error[finite], group[finite]
    columns = [np.bincount(where, weights, size) for weights in (None, some, np.abs(some), some * some)]
    return np.stack([*columns, np.bincount(group[~finite], minlength=size)], axis=-1).astype(np.float64)


def summary(total):
    """Return {me_k, mae_k, sd_k, rmse_k, pixels, pixels_without_temperature} of a row; None where nothing was counted.

    `sd_k` is the standard deviation about the mean error: rmse² = me² + sd².
    """
    count, error, absolute, square, without = (float(value) for value in total)
    found = dict.fromkeys(("me_k", "mae_k", "sd_k", "rmse_k"))
    if count:
        mean = error / count
        found = {
            "me_k": mean,
            "mae_k": absolute / count,
            "sd_k": float(np.sqrt(max(square / count - mean * mean, 0.0))),
            "rmse_k": float(np.sqrt(square / count)),
        }
    return found | {"pixels": int(count), "pixels_without_temperature": int(without)}


def clusters(entries):
    """Return (number of each Entry's cluster, what a cluster is): sequences, or where these are few, parents.

    Pictures of one flight or landscape err alike; drawing them one by one would make intervals too narrow.
    """
    sequences = [entry.sequence for entry in entries]
    few = len(set(sequences)) < FEWEST_SEQUENCES
    names = [entry.parent for entry in entries] if few else sequences
    return np.unique(names, return_inverse=True)[1], "parents" if few else "sequences"


def intervals(rows, cluster, seed=0):
    """Return 95 % intervals {me_k: (low, high), mae_k: (low, high)}; None where fewer than two clusters have pixels.

    Parameters
    ----------
    rows : (P, 5) array
        Sums of each picture.
    cluster : (P,) array of int
        Pictures of one number are drawn together.
    seed : int

    Notes
    -----
    Percentile bootstrap of 1000 draws, Efron & Tibshirani, An Introduction to the Bootstrap (1993), section 13.3: so
    many clusters as there are, with replacement.
    """
    rows = np.asarray(rows, np.float64)
    whole = np.zeros((int(np.max(cluster, initial=-1)) + 1, WIDTH))
    np.add.at(whole, cluster, rows)
    whole = whole[whole[:, 0] > 0]
    if len(whole) < 2:
        return {"me_k": None, "mae_k": None}
    times = np.random.default_rng(seed).multinomial(len(whole), np.full(len(whole), 1.0 / len(whole)), DRAWS)
    drawn = times @ whole
    ends = 50.0 * (1.0 - CONFIDENCE), 50.0 * (1.0 + CONFIDENCE)
    return {
        name: tuple(np.percentile(drawn[:, column] / drawn[:, 0], ends).tolist())
        for name, column in (("me_k", 1), ("mae_k", 2))
    }
