"""Texels averaged over squares of 2, 4, 8 … of them a side: what a pixel that covers many texels is read from.

Radiance is averaged, as a pixel does, never temperature. A square counts the texels that some face covers, so that
what an image of several patches holds between them does not bleed in; where it covers none it is their plain mean.
"""

import numpy as np

# What a texel that no face covers counts for, beside one that is covered.
_UNCOVERED = 1e-6


def sizes(rows, columns):
    """Return [(rows, columns), …] of an image of texels and of its squares, down to a single one."""
    found = [(rows, columns)]
    while found[-1] != (1, 1):
        found.append(tuple((side + 1) // 2 for side in found[-1]))
    return found


def squares(values, covered=None):
    """Yield the means over squares of 2, 4, 8 … texels a side of an image (rows, columns, C), as arrays like it.

    Parameters
    ----------
    values : (rows, columns, C) float32
    covered : (rows, columns) bool, optional
        Texels that count; all where None.
    """
    weight = None if covered is None else np.where(covered, np.float32(1.0), np.float32(_UNCOVERED))[..., None]
    while values.shape[:2] != (1, 1):
        if weight is None:
            values = _halved(values)
        else:
            total = _halved(weight)
            values, weight = _halved(values * weight) / total, total
        yield values


def _halved(values):
    """Means over squares of two texels a side; a side of odd length has its last texel twice."""
    values = np.pad(values, [(0, side % 2) for side in values.shape[:2]] + [(0, 0)], mode="edge")
    total = values[::2, ::2] + values[1::2, ::2]
    total += values[::2, 1::2]
    total += values[1::2, 1::2]
    total *= np.float32(0.25)
    return total
