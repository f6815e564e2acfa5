"""The camera's shutter in the offsets of frames: where it closed, how the camera drifted since, and what that fixes.

A shutter corrects the offset of the camera, which then drifts away from it. Frames right after one are the closest to
the camera's calibration. Their mean is taken for the common level where no reference fixes it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
# A jump is larger than so many robust standard deviations of the other changes from frame to frame, and than this [K].
_SIGMAS, _LEAST_K = 6.0, 1.0
# Changes around a jump that its neighbourhood is told by, to either side.
_AROUND = 3
# Steps in time that are so many times the usual one are gaps.
_GAP = 3.0
# Fewer frames than this tell no jump from a drift.
_FEWEST = 8


@dataclass(frozen=True, eq=False)
class Shutters:
    """Where a shutter closed between frames in the order of their flight.

    Attributes
    ----------
    after : (E,) ints
        Numbers of the frames right after a shutter.
    drift : (F,) float64
        Smooth curve of the offsets between shutters [K].
    fall_k : float
        Mean size of the jumps [K]; 0 without a shutter.
    level_k : float
        Mean offset of the frames right after a shutter; 0 without one.
    """

    after: NDArray[np.intp]
    drift: Floats
    fall_k: float
    level_k: float


def shutters_of(offsets: Floats, when: Floats, known: NDArray[np.bool_]) -> Shutters:
    """Return the Shutters by the offsets (F,) of frames [K].

    `when` (F,) are their times, in any unit; frames that are not `known` (F,) are left out. Jumps all fall or all rise,
    since a drift after each shutter leads back to where the next one corrects it. What changes in a gap of the flight
    is no shutter.
    """
    order = np.argsort(when, kind="stable")
    kept = order[known[order]]
    own, step = offsets[kept], np.diff(when[kept])
    jumps = _jumps(own)
    jumps = jumps[step[jumps - 1] <= _GAP * max(float(np.median(step)), 1e-9)] if jumps.size else jumps
    after = kept[jumps]
    drift = np.zeros(len(offsets))
    for part in np.split(np.arange(len(own)), jumps):
        drift[kept[part]] = _smooth(own[part])
    if not len(after):
        return Shutters(after, drift, 0.0, 0.0)
    fall = float(np.abs(own[jumps] - own[jumps - 1]).mean())
    return Shutters(after, drift, fall, float(offsets[after].mean()))


def _jumps(offsets: Floats) -> NDArray[np.intp]:
    """Numbers of the values (N,) that a jump leads to."""
    change = np.diff(offsets)
    if len(offsets) < _FEWEST:
        return np.zeros(0, np.intp)
    near = [np.median(np.delete(change, k)[max(k - _AROUND, 0) : k + _AROUND]) for k in range(len(change))]
    away = change - np.array(near)
    limit = max(_SIGMAS * 1.4826 * float(np.median(np.abs(away))), _LEAST_K)
    found = np.flatnonzero(np.abs(away) > limit)
    signs = np.sign(away[found])
    return found + 1 if found.size and (signs == signs[0]).all() else np.zeros(0, np.intp)


def _smooth(values: Floats) -> Floats:
    """A curve through values (N,): means of three, weighted 1, 2, 1, with straight ends."""
    if len(values) < 3:
        return values.copy()
    middle = 0.25 * (values[:-2] + 2.0 * values[1:-1] + values[2:])
    first, last = 2.0 * middle[0] - (middle[1] if len(middle) > 1 else middle[0]), middle[-1]
    return np.concatenate([[0.5 * (values[0] + first)], middle, [0.5 * (values[-1] + last)]])
