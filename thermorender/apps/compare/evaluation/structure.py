"""Scores of the structure within pictures: correlation, slope, error without the mean, and a control by a shift.

A mean absolute error over pictures of similar contrast is nearly blind to where things are. A map that reproduces
structure correlates with the truth within each picture, and its error grows when the true picture is shifted.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.apps.compare.evaluation.sums import CONFIDENCE, DRAWS, Interval

# Shift of the true picture in the control, to the right [px].
SHIFT_PX = 16
# Columns of a row: correlation, slope, Σ|error without its mean|, pixels; of the pixels that are known before and after
# the shift: Σ|error|, Σ|error after the shift|, their number, correlation after the shift.
WIDTH = 8
# Standard deviations below this are those of rounding [K].
_LEAST_K = 1e-3


def row(guess: NDArray[np.floating], true: NDArray[np.floating], known: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the (8,) float64 scores of a picture; NaN where it has none.

    Parameters
    ----------
    guess, true : (H, W) array
        Apparent temperature [K]; NaN where a method has none.
    known : (H, W) bool
    """
    known = known & np.isfinite(guess)
    found = np.full(WIDTH, np.nan)
    error = (guess[known] - true[known]).astype(np.float64)
    found[:2] = _agreement(guess[known], true[known])
    found[2:4] = np.abs(error - error.mean()).sum() if error.size else 0.0, error.size
    both, moved = np.zeros_like(known), np.zeros_like(true)
    both[:, SHIFT_PX:] = known[:, SHIFT_PX:] & known[:, :-SHIFT_PX]
    moved[:, SHIFT_PX:] = true[:, :-SHIFT_PX]
    here, aside = (np.abs(guess[both].astype(np.float64) - each[both]).sum() for each in (true, moved))
    found[4:7] = here, aside, both.sum()
    found[7] = _agreement(guess[both], moved[both])[0]
    return found


def _agreement(guess: NDArray[np.floating], true: NDArray[np.floating]) -> tuple[float, float]:
    """(correlation, slope of guess against true); NaN where either is constant."""
    if true.size < 2:
        return np.nan, np.nan
    x, y = (values.astype(np.float64) - values.mean(dtype=np.float64) for values in (true, guess))
    xx, yy = (x * x).mean(), (y * y).mean()
    if min(xx, yy) < _LEAST_K**2:
        # A constant method has a slope, of 0, but no correlation.
        return np.nan, 0.0 if xx >= _LEAST_K**2 else np.nan
    xy = (x * y).mean()
    return float(xy / np.sqrt(xx * yy)), float(xy / xx)


def summary(rows: ArrayLike, cluster: ArrayLike, seed: int = 0) -> dict[str, Any]:
    """Return the scores of pictures' rows, as plain numbers; None where there are none.

    Parameters
    ----------
    rows : (P, 8) array
    cluster : (P,) array of int
        Pictures with the same number are drawn together.
    seed : int

    Returns
    -------
    dict
        `correlation`, `slope` and `correlation_shifted`, medians over pictures; `mae_without_mean_k`;
        `shift_more_k`, by which the MAE grows by the shift, on the same pixels; each with its 95 % interval under
        `interval_95`.
    """
    table, number = np.asarray(rows, np.float64), np.asarray(cluster)
    some = np.nan_to_num(table[:, 3]) > 0
    table, number = table[some], number[some]
    names = ("correlation", "slope", "mae_without_mean_k", "shift_more_k", "correlation_shifted")
    if not len(table):
        return {**dict.fromkeys(names), "interval_95": dict.fromkeys(names)}
    members = [np.flatnonzero(number == each) for each in np.unique(number)]
    found = dict(zip(names, _scores(table), strict=True))
    ends: dict[str, Interval | None] = dict.fromkeys(names)
    if len(members) > 1:
        generator = np.random.default_rng(seed)
        drawn = np.array([
            _scores(table[np.concatenate([members[k] for k in generator.integers(len(members), size=len(members))])])
            for _ in range(DRAWS)
        ])  # fmt: skip
        for name, values in zip(names, drawn.T, strict=True):
            if np.isfinite(values).any():
                low, high = np.nanpercentile(values, [50.0 * (1.0 - CONFIDENCE), 50.0 * (1.0 + CONFIDENCE)]).tolist()
                ends[name] = low, high
    return {**{name: value if np.isfinite(value) else None for name, value in found.items()}, "interval_95": ends}


def _scores(rows: NDArray[np.float64]) -> tuple[float, float, float, float, float]:
    """(correlation, slope, MAE without the means, growth of MAE by the shift, correlation after the shift) of rows."""
    medians = [float(np.median(own)) if (own := column[np.isfinite(column)]).size else np.nan
               for column in rows.T[[0, 1, 7]]]  # fmt: skip
    without, pixels, here, aside, both = rows[:, 2:7].sum(axis=0)
    more = float((aside - here) / both) if both else np.nan
    return medians[0], medians[1], float(without / pixels), more, medians[2]
