"""Time steps of a simulation, shorter towards the instants that are requested, and the functions that a step needs."""

from collections.abc import Sequence

import drjit as dr
import numpy as np

# (Up to this long before an instant, length) [s]: changes of light within the last hour matter to minutes, those a day
# ago only in the mean.
_STEPS_S = ((3600.0, 300.0), (4 * 3600.0, 900.0), (24 * 3600.0, 1800.0), (np.inf, 3600.0))


class Library:
    """Functions of an array library that the physics needs, from Dr.Jit."""

    where, maximum, minimum, exp, sqrt = dr.select, dr.maximum, dr.minimum, dr.exp, dr.sqrt


def steps_to(start: np.datetime64, asked: Sequence[np.datetime64]) -> list[tuple[float, float]]:
    """Return [(beginning, length)] of the steps [s] from `start` to the last instant; a step ends at every instant."""
    ends = [float((at - start) / np.timedelta64(1, "s")) for at in asked]
    steps, at = [], 0.0
    for end in ends:
        while at < end - 1e-6:
            left = end - at
            length = next(length for reach, length in _STEPS_S if left <= reach + 1e-6)
            inner = max((r for r, _ in _STEPS_S if r < left - 1e-6), default=0.0)
            count = max(1, int(np.ceil((left - inner) / length - 1e-9)))
            size = (left - inner) / count
            steps += [(at + k * size, size) for k in range(count)]
            at = end - inner
    return steps
