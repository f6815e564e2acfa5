"""Heights above the ground and slopes as evidence on materials: roofs and trees stand above it, water lies level.

A progressive morphological filter (Zhang et al. 2003, doi:10.1109/TGRS.2003.810682) separates the ground. `LIKELIHOOD`
is the share of nine cases (three classes each of height and slope) on ground, roofs, trees and water of procedural
land, from `validation.emissivity`. By Bayes' rule it multiplies the probabilities of a texel's materials.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from thermorender.learned.emissivity.kinds import kinds_of
from thermorender.learned.emissivity.mapping import Evidence

Floats = NDArray[np.float32]

# Widest spacing of heights that show roofs and trees [m]; the likelihoods are from land with posts of 0.5 and 1 m.
WIDEST_POST_M = 1.5
# A surface model has at least this share of posts above `HEIGHTS_M[1]`; others may be the bare ground.
LEAST_SHARE = 0.005
# Limits of the classes: height above the ground [m] and slope [deg].
HEIGHTS_M, SLOPES_DEG = (0.7, 2.0), (12.0, 35.0)
CASES = (len(HEIGHTS_M) + 1) * (len(SLOPES_DEG) + 1)
# Share of each case, by height and then slope, of the surface of procedural land.
LIKELIHOOD = {
    "ground": (0.8634, 0.0784, 0.0430, 0.0005, 0.0007, 0.0098, 0.0000, 0.0001, 0.0042),
    "roof": (0.0001, 0.0033, 0.0068, 0.0009, 0.0090, 0.0507, 0.1306, 0.2340, 0.5647),
    "tree": (0.0048, 0.0184, 0.0096, 0.0099, 0.0598, 0.0520, 0.0053, 0.1414, 0.6987),
    "water": (0.9592, 0.0408, 0.0000, 0.0000, 0.0000, 0.0000, 0.0000, 0.0000, 0.0000),
}
# What the surface of each kind of material is; materials of other kinds may be any.
SURFACES = {"roof": "roof", "tree": "tree", "water": "water"} | dict.fromkeys(
    ("paved", "timber", "soil", "sand", "rock", "low"), "ground"
)
# Share of texels whose case is not that of their surface: heights of another day, or shifted against the picture.
_WRONG = 0.1
# Widths of the openings [m], the slope of ground that they keep, and the least and largest step above ground [m].
_WIDTHS_M, _SLOPE, _STEP_M = (3.0, 5.0, 9.0, 17.0, 33.0, 49.0), 0.25, (0.3, 3.0)
# On steeper ground [deg], heights above it are not known. The whole model is no evidence where more than this share is
# steep, as in mountains.
_STEEPEST_DEG, _MOUNTAINS = 25.0, 0.2
# Standard deviation of the surface whose slope counts [m].
_SMOOTH_M = 0.7


def above_ground(height: NDArray[np.float64], post_m: float) -> tuple[Floats, Floats]:
    """Return (height above the ground [m], slope of the surface [deg]), (h, w) each, of a surface model, (h, w) [m].

    Heights are NaN where they are missing; the results also where the ground is steep. `post_m` is the spacing [m].
    """
    import cv2
    from scipy.ndimage import distance_transform_edt

    known = np.isfinite(height)
    if not known.any():
        return (np.full(height.shape, np.nan, np.float32),) * 2
    if not known.all():
        height = height[tuple(distance_transform_edt(~known, return_distances=False, return_indices=True))]
    top = (height - height.min()).astype(np.float32)
    ground, opened, before = np.ones(top.shape, bool), top, 0.0
    for width in _WIDTHS_M:
        side = max(3, round(width / post_m) | 1)
        lower = cv2.morphologyEx(opened, cv2.MORPH_OPEN, np.ones((side, side), np.uint8))
        step = min(_STEP_M[0] + _SLOPE * 0.5 * (width - before), _STEP_M[1])
        ground &= opened - lower <= step
        opened, before = lower, width
    share = ground.astype(np.float32)
    level = _filled(top * share, share)
    slope = _slope_deg(top, max(0.5, _SMOOTH_M / post_m), post_m)
    unknown = ~known | (_slope_deg(level, max(_SMOOTH_M, 0.25 * _WIDTHS_M[-1]) / post_m, post_m) > _STEEPEST_DEG)
    return tuple(np.where(unknown, np.float32(np.nan), each) for each in (top - level, slope))  # type: ignore[return-value]


def _filled(total: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Weighted heights (h, w) over their weight; where that is small, those of a picture of half the size."""
    import cv2

    if min(total.shape) < 4:
        return np.full(total.shape, total.sum() / max(weight.sum(), 1e-9), np.float32)
    coarse = _filled(cv2.pyrDown(total), cv2.pyrDown(weight))
    coarse = cv2.resize(coarse, total.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.where(weight > 0.05, total / np.maximum(weight, 1e-9), coarse)


def _slope_deg(height: np.ndarray, smooth: float, post_m: float) -> np.ndarray:
    """Slope of a smoothed surface [deg]; `smooth` is the standard deviation [posts]."""
    import cv2

    down, right = np.gradient(cv2.GaussianBlur(height, (0, 0), smooth), post_m)
    return np.asarray(np.degrees(np.arctan(np.hypot(down, right))))


def seen(height: NDArray[np.float64], post_m: float) -> tuple[Floats, Floats, str]:
    """Return what `above_ground` returns, and why it is no evidence on materials; "" if it is."""
    if post_m > WIDEST_POST_M:
        nothing = np.full(height.shape, np.nan, np.float32)
        why = f"posts of {post_m:.3g} m are wider than {WIDEST_POST_M:g} m and do not show roofs and trees"
        return nothing, nothing, why
    above, slope = above_ground(height, post_m)
    count, why = max(int(np.isfinite(height).sum()), 1), ""
    steep = 1.0 - np.isfinite(above).sum() / count
    if steep > _MOUNTAINS:
        why = f"{steep:.0%} of the ground is steeper than {_STEEPEST_DEG:g}°, where rocks stand out as roofs do"
    elif (above > HEIGHTS_M[1]).sum() < LEAST_SHARE * count:
        why = f"nothing stands more than {HEIGHTS_M[1]:g} m above the ground, as in a model of the bare ground"
    return above, slope, why


def case_of(above_m: Floats, slope_deg: Floats) -> NDArray[np.uint8]:
    """Return the case of each texel, (h, w) uint8: 1…9 by height and then slope, and 0 where they are not known."""
    case = np.digitize(above_m, HEIGHTS_M) * (len(SLOPES_DEG) + 1) + np.digitize(slope_deg, SLOPES_DEG) + 1
    return np.where(np.isfinite(above_m) & np.isfinite(slope_deg), case, 0).astype(np.uint8)


def evidence(case: NDArray[np.uint8], materials: Sequence[str]) -> Evidence:
    """Return the Evidence of cases, (h, w), on materials by name."""
    share = {name: (1.0 - _WRONG) * np.array(value) + _WRONG / CASES for name, value in LIKELIHOOD.items()}
    factor = np.ones((CASES + 1, len(materials)))
    for column, material in enumerate(materials):
        surfaces = {SURFACES[kind] for kind in kinds_of(material) if kind in SURFACES} or set(share)
        factor[1:, column] = np.mean([share[name] for name in sorted(surfaces)], axis=0)
    return Evidence(case, factor.astype(np.float32))
