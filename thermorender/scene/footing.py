"""How an object stands on the ground: upright, or on the slope of the ground below it."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

_Floats = NDArray[np.float64]
# Callable (east, north) → local height of the terrain [m], NaN off it.
Height = Callable[[Any, Any], Any]

# What reaches higher than this above the ground, such as a house or a drone, stands upright [m].
_HIGH_M = 3.0
# The footprint is the extent of this lowest share of a body's height.
_LOWEST = 0.1
# Points along each side of the footprint, an even number.
_SIDE = 10
# Heights below an object that differ by less than this are level ground [m].
_LEVEL_M = 0.01
# Ground this far above the slope is beside or over the object: a wall, a bush, a crown [m].
_BESIDE_M = 0.3
# Steepest slope on which anything rests, as rise over run.
_STEEPEST = 1.0


def upright(corner: _Floats, above_ground_m: float) -> bool:
    """Return whether a body of vertices (V, 3), z up, stands upright unless the scene file decides otherwise.

    It does if it is taller than wide, where the width is the root of its extents' product, or reaches above 3 m.
    """
    extent = np.ptp(corner, axis=0)
    return bool(extent[2] > np.sqrt(extent[0] * extent[1]) or above_ground_m + extent[2] > _HIGH_M)


def footprint(corner: _Floats) -> _Floats:
    """Return the lowest and highest x and y of the lowest tenth of a body of vertices (V, 3), (2, 2) [m]."""
    up = corner[:, 2]
    foot = corner[up <= up.min() + _LOWEST * np.ptp(up), :2]
    return np.stack([foot.min(axis=0), foot.max(axis=0)])


def resting(foot: _Floats, level: _Floats, ground: Height, above_ground_m: float) -> _Floats | None:
    """Return (4, 4) from the frame of a body on the slope below it to the frame `level` (4, 4), in which it is level.

    The slope is the median of the slopes between opposite points of its footprint, and the height the median above it.
    The body is raised until no ground is above its base, except ground beside it. None on level ground.
    """
    middle, half = foot.mean(axis=0), np.maximum(0.5 * np.ptp(foot, axis=0), 1e-3)
    side = np.linspace(-1.0, 1.0, _SIDE)
    x, y = np.meshgrid(half[0] * side, half[1] * side)
    plan = np.stack([x + middle[0], y + middle[1]], axis=-1) @ level[:2, :2].T + level[:2, 3]
    height = np.asarray(ground(plan[..., 0], plan[..., 1])) - level[2, 3]
    if not np.isfinite(height).all() or np.ptp(height) < _LEVEL_M:
        return None
    slope = np.array(
        [np.median((height - height[:, ::-1]) / (2.0 * x)), np.median((height - height[::-1]) / (2.0 * y))]
    )
    if np.linalg.norm(slope) > _STEEPEST:
        return None
    rest = height - slope[0] * x - slope[1] * y
    base = float(np.median(rest))
    bump = rest[rest < base + _BESIDE_M] - base
    found = np.eye(4)
    # The heading stays: the y axis points along it in plan.
    found[:3, 1] = np.array([0.0, 1.0, slope[1]]) / np.hypot(1.0, slope[1])
    found[:3, 2] = np.array([-slope[0], -slope[1], 1.0]) / np.sqrt(1.0 + slope @ slope)
    found[:3, 0] = np.cross(found[:3, 1], found[:3, 2])
    found[2, 3] = base - slope @ middle + max(float(bump.max()) - max(above_ground_m, 0.0), 0.0)
    return found
