"""Scores of the structure within pictures: correlation, slope, a control by a shift, PSNR and structural similarity.

The mean absolute error hardly depends on where things are; correlation, and the error against shifted truth, do.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.apps.compare.sums import DRAWS, ENDS, Interval

# Shift of the true picture in the control, to the right [px].
SHIFT_PX = 16
# Columns of a row: correlation, slope, Σ|error without its mean|, pixels; of the pixels that are known before and after
# the shift: Σ|error|, Σ|error after the shift|, their number, correlation after the shift.
WIDTH = 8
# Standard deviations below this are those of rounding [K].
_LEAST_K = 1e-3
# The 8-bit scale is linear in apparent temperature between two bounds, the same for all methods.
PEAK = 255.0
# Wang et al. 2004: a Gaussian window of 11 × 11 pixels and 1.5 px, and the two constants.
RADIUS, SIGMA_PX = 5, 1.5
K1, K2 = 0.01, 0.03


def row(guess: NDArray[np.floating], true: NDArray[np.floating], known: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the (8,) float64 scores of a picture (H, W) [K] against the true one where it is known; NaN for none."""
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
    """Return the scores of pictures' rows (P, 8), as plain numbers; None where there are none.

    `correlation`, `slope` and `correlation_shifted` are medians over pictures; `mae_without_mean_k`; `shift_more_k`, by
    which the MAE grows by the shift, on the same pixels. Each has its 95 % interval under `interval_95`; pictures with
    the same number in `cluster` (P,) are drawn together.
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
                low, high = np.nanpercentile(values, ENDS).tolist()
                ends[name] = low, high
    return {**{name: value if np.isfinite(value) else None for name, value in found.items()}, "interval_95": ends}


def _scores(rows: NDArray[np.float64]) -> tuple[float, float, float, float, float]:
    """(correlation, slope, MAE without the means, growth of MAE by the shift, correlation after the shift) of rows."""
    medians = [float(np.median(own)) if (own := column[np.isfinite(column)]).size else np.nan
               for column in rows.T[[0, 1, 7]]]  # fmt: skip
    without, pixels, here, aside, both = rows[:, 2:7].sum(axis=0)
    more = float((aside - here) / both) if both else np.nan
    return medians[0], medians[1], float(without / pixels), more, medians[2]


def eight_bit(temperature: ArrayLike, bounds: tuple[float, float]) -> NDArray[np.float64]:
    """Return temperatures as whole numbers 0…255 between two bounds [K], clipped and 0 for none, (H, W) float64."""
    low, high = bounds
    return np.rint(PEAK * np.clip((np.nan_to_num(temperature, nan=low) - low) / (high - low), 0.0, 1.0))


class Similarity:
    """Compares pictures with one true picture (H, W) where it is known, both as `eight_bit` returns them.

    Wang, Bovik, Sheikh & Simoncelli, IEEE Trans. Image Process. 13 (2004) 600, doi:10.1109/TIP.2003.819861, equation
    13: SSIM = (2 µx µy + C1)(2 σxy + C2) / ((µx² + µy² + C1)(σx² + σy² + C2)), with moments weighted by the window.
    Only windows inside the picture whose pixels are all known count.
    """

    def __init__(self, true: NDArray[np.floating], known: NDArray[np.bool_]) -> None:
        import cv2

        self.known = known
        self.true = np.where(known, true, 0.0)
        side = 2 * RADIUS + 1
        # The border value 0 excludes windows that leave the picture.
        self.whole: NDArray[np.bool_] = cv2.erode(
            known.astype(np.uint8), np.ones((side, side), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0
        ).astype(bool)
        self.mean = _blurred(self.true)
        self.variance = _blurred(self.true**2) - self.mean**2

    def row(self, image: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return sums that can be added over pictures, (4,): Σ squared difference, pixels, Σ SSIM, windows."""
        image = np.where(self.known, image, 0.0)
        square = float(((image - self.true) ** 2).sum())
        mean = _blurred(image)
        variance, joint = _blurred(image**2) - mean**2, _blurred(image * self.true) - mean * self.mean
        c1, c2 = (K1 * PEAK) ** 2, (K2 * PEAK) ** 2
        like = (2.0 * mean * self.mean + c1) * (2.0 * joint + c2)
        like /= (mean**2 + self.mean**2 + c1) * (variance + self.variance + c2)
        return np.array([square, self.known.sum(), like[self.whole].sum(), self.whole.sum()], np.float64)


def similarity(total: ArrayLike) -> dict[str, float | None]:
    """Return {psnr_db, ssim} of a row: from the mean square of all pixels, and the mean over windows.

    None where nothing was compared; PSNR also for equal pictures.
    """
    square, pixels, like, windows = np.asarray(total, np.float64)
    return {
        "psnr_db": float(10.0 * np.log10(PEAK**2 * pixels / square)) if pixels and square else None,
        "ssim": float(like / windows) if windows else None,
    }


def _blurred(image: NDArray[Any]) -> NDArray[np.float64]:
    import cv2

    side = 2 * RADIUS + 1
    return np.asarray(cv2.GaussianBlur(image.astype(np.float64), (side, side), SIGMA_PX), np.float64)
