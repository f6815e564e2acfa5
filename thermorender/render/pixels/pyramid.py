"""Means of radiance over squares of 2, 4, 8 … texels a side, a mipmap for pixels that cover many texels.

Only texels that a face covers count, so that unused parts of a texture do not bleed in. A square without covered texels
has the plain mean.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

# Weight of a texel that no face covers, relative to a covered one.
_UNCOVERED = 1e-6


def sizes(rows: int, columns: int) -> list[tuple[int, int]]:
    """Return [(rows, columns), …] of an image of texels and of its levels of squares, down to a single one."""
    found = [(rows, columns)]
    while found[-1] != (1, 1):
        found.append(((found[-1][0] + 1) // 2, (found[-1][1] + 1) // 2))
    return found


def squares(values: NDArray[np.float32], covered: NDArray[np.bool_] | None = None) -> Iterator[NDArray[np.float32]]:
    """Yield the means over squares of 2, 4, 8 … texels a side of an image (rows, columns, C), of `covered` texels."""
    weight = None if covered is None else np.where(covered, np.float32(1.0), np.float32(_UNCOVERED))[..., None]
    while values.shape[:2] != (1, 1):
        if weight is None:
            values = _halved(values)
        else:
            total = _halved(weight)
            values, weight = _halved(values * weight) / total, total
        yield values


def _halved(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Means over squares of two texels a side; a side of odd length repeats its last texel."""
    odd = [side % 2 for side in values.shape[:2]]
    if any(odd):
        values = np.pad(values, [*((0, side) for side in odd), (0, 0)], mode="edge")
    total = values[::2, ::2] + values[1::2, ::2]
    total += values[::2, 1::2]
    total += values[1::2, 1::2]
    total *= np.float32(0.25)
    return total
