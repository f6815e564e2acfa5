"""Calibration of a rig: the mapping from thermal to visible pictures, from the directions of their gradients.

All frames share one mapping, so their correlations are summed. A search over scale, rotation and shift on small
pictures precedes a fit of all parameters, coarse to fine. Single frames are registered only to reject outliers.
"""

from collections.abc import Iterable, Sequence

import numpy as np

from thermorender.apps.training.registration.alignment import (
    Normals,
    climb,
    moves_of,
    normals_of,
    pooled,
    sample,
    scores_of,
    step_of,
)
from thermorender.apps.training.registration.coarse_search import CANVAS, SMALL, searched
from thermorender.apps.training.registration.gradient_directions import best_shift
from thermorender.apps.training.registration.levels import Level, ReadPair, level_of, read_frames
from thermorender.apps.training.registration.rig import Rig, parameters_of
from thermorender.errors import ThermorenderError
from thermorender.progress import Progress

# Largest deviation of an inlier frame's shift, as a share of the columns.
_ELSEWHERE = 0.05
_OUTLIER = 3.5 * 1.4826
# Pairs with lower scores do not show the same scene. Chosen: unrelated pictures reach at most 0.06, real pairs 0.2 to
# 0.5.
_LEAST_SCORE = 0.1
# Parameters: ln scale, rotation, shift, shift, k1, ln aspect.
_RIGID, _DISTORTED, _RESIZED = (0, 1, 2, 3), (0, 1, 2, 3, 4), (0, 1, 2, 3, 4, 5)
_ADVICE = "give pairs of one rig with detail in both pictures, far away compared with the cameras' distance"


def calibrate(
    frames: Iterable[tuple[str, ReadPair]],
    fields_of_view: tuple[Sequence[float], Sequence[float]] | None = None,
    resized: bool = False,
    progress: Progress | None = None,
) -> Rig:
    """Return the Rig that fits all frames, each (name, function that reads its pictures, NaN where not measured).

    The search starts from the fields of view of both cameras, horizontal and vertical [deg]. `resized` also fits the
    aspect of visible pictures.
    """
    report_progress = progress or (lambda task, fraction: None)
    pictures, shapes, reduced, start = read_frames(frames, fields_of_view, report_progress)
    visible_shape, thermal_shape = shapes
    free = _RESIZED if resized else _DISTORTED
    report_progress("searching scale and rotation", 0.0)
    starts = searched(pictures, shapes, reduced, start, report_progress)
    coarse = thermal_shape[1] / SMALL
    levels = [factor for factor in (4.0, 2.0, 1.0) if factor <= max(coarse, 1.0)] or [1.0]
    found = []
    for first in starts:
        level = level_of(pictures, shapes, reduced, np.exp(first[0]), coarse)
        found.append(climb(level, climb(level, first, _RIGID)[0], free))
    parameters = max(found, key=lambda each: each[1])[0]
    used = list(range(len(pictures)))
    rejected: dict[str, str] = {}
    for number, factor in enumerate(levels):
        report_progress("fitting the rig", number / len(levels))
        level = level_of([pictures[k] for k in used], shapes, reduced, np.exp(parameters[0]), factor)
        parameters, _ = climb(level, parameters, free)
        if number == 0 and len(pictures) > 1:
            rejected = _outliers(level, parameters, [frame.name for frame in pictures], factor, thermal_shape[1])
            used = [k for k in used if pictures[k].name not in rejected]
            if 2 * len(used) <= len(pictures):
                raise ThermorenderError(
                    f"only {len(used)} of {len(pictures)} pairs of pictures agree on one rig; {_ADVICE}"
                )
    normals = normals_of(level, parameters, free)
    judge = level_of(pictures, shapes, reduced, np.exp(parameters[0]), max(thermal_shape[1] / 320.0, 1.0))
    own = scores_of(judge, parameters)
    if own[used].mean() < _LEAST_SCORE:
        raise ThermorenderError(
            f"the best fit has a score of {own[used].mean():.3f}; pictures of the same scene reach at least "
            f"{_LEAST_SCORE}; {_ADVICE}"
        )
    other = scores_of(judge, parameters, roll=1)[used] if len(pictures) > 1 else None
    scale = float(np.exp(parameters[0]))
    right, down = (float(scale * each) for each in parameters[2:4])
    return Rig(
        visible_shape=visible_shape, thermal_shape=thermal_shape, scale=scale,
        rotation_deg=float(np.degrees(parameters[1])), shift_px=(right, down),
        k1=float(parameters[4]), aspect=float(np.exp(parameters[5])),
        errors=_errors(normals, free, parameters, level), score=float(own[used].mean()),
        score_unrelated=None if other is None else float(other.mean()),
        frames={frame.name: float(score) for frame, score in zip(pictures, own, strict=True)}, rejected=rejected,
    )  # fmt: skip


def scores(
    rig: Rig, frames: Iterable[tuple[str, ReadPair]], progress: Progress | None = None
) -> dict[str, float]:  # fmt: skip
    """Return the score of each frame under a rig, {name: correlation of gradient directions}."""
    pictures, shapes, reduced, _ = read_frames(frames, None, progress or (lambda task, fraction: None))
    parameters = parameters_of(rig)
    judge = level_of(pictures, shapes, reduced, rig.scale, max(shapes[1][1] / 320.0, 1.0))
    return dict(zip([frame.name for frame in pictures], scores_of(judge, parameters).tolist(), strict=True))


def _outliers(
    level: Level, parameters: np.ndarray, names: Sequence[str], factor: float, columns: int
) -> dict[str, str]:
    """{name: reason} of frames whose own best shift or score differs from the others' under the common mapping."""
    height, width = level.thermal[0].shape
    canvas = [int(np.ceil(CANVAS * side)) for side in (height, width)]
    # The grid of the thermal pixels, extended on all sides.
    pitch = level.x[0, 1] - level.x[0, 0], level.y[1, 0] - level.y[0, 0]
    x = (np.arange(canvas[1]) - (canvas[1] - 1) / 2.0) * pitch[0]
    y = (np.arange(canvas[0]) - (canvas[0] - 1) / 2.0) * pitch[1]
    sampled, inside = sample(level, parameters, *np.meshgrid(x, y))
    shifts = np.array([best_shift([seen], [known], inside)[1] * factor
                       for seen, known in zip(sampled, level.thermal, strict=True)])  # fmt: skip
    own = scores_of(level, parameters)
    away = np.hypot(*(shifts - np.median(shifts, axis=0)).T)
    allowed = min(max(_OUTLIER * np.median(away), 2.0 * factor), _ELSEWHERE * columns)
    # Scores of equal scenes spread by 0.02.
    least = np.median(own) - _OUTLIER * max(np.median(np.abs(own - np.median(own))), 0.02)
    found = {}
    for name, distance, score in zip(names, away, own, strict=True):
        if distance > allowed:
            found[name] = f"shifted {distance:.0f} thermal px from the others"
        elif score < least:
            found[name] = f"score {score:.3f}, median of all {np.median(own):.3f}"
    return found


def _errors(normals: Sequence[Normals], free: Sequence[int], parameters: np.ndarray, level: Level) -> dict[str, float]:
    """Standard errors by the jackknife: one step from the common maximum with each frame left out in turn."""
    count = len(normals)
    if count < 2:
        return {}
    _, factor = pooled(normals)
    without = np.array([step_of([*normals[:k], *normals[k + 1 :]], factor) for k in range(count)])
    spread = without - without.mean(axis=0)
    covariance = (count - 1) / count * spread.T @ spread
    moves = moves_of(level, parameters, free) * abs(level.x[0, 1] - level.x[0, 0])
    position = np.sqrt(np.einsum("...ik,ij,...jk->...", moves, covariance, moves).mean())
    error, scale = np.zeros(6), float(np.exp(parameters[0]))
    error[list(free)] = np.sqrt(np.diag(covariance))
    found = {
        "scale": scale * error[0], "rotation_deg": np.degrees(error[1]), "column_px": scale * error[2],
        "row_px": scale * error[3], "k1": error[4], "aspect": np.exp(parameters[5]) * error[5],
        "position_px": position,
    }  # fmt: skip
    return {key: float(value) for key, value in found.items() if value > 0.0}
