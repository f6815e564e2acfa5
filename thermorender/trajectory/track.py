"""What a log's positions alone say: jumps, and the course over ground."""

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError
from thermorender.trajectory.logs import Log
from thermorender.trajectory.path import MOVED_M

Floats = NDArray[np.float64]

# A step between two samples is a jump if it is faster than this and than three times the median of its neighbours.
JUMP_M_S = 20.0
_TIMES_NEIGHBOURS = 3.0
_NEIGHBOURS = 3
# A step without neighbours is a jump above the speed of sound.
_LONE_M_S = 340.0
# A vehicle that stood turns to its new course within this time [s].
_TURN_S = 2.0


def jumps(log: Log, position: Floats) -> str | None:
    """Return a note that names the jumps of a log's positions, (N, 3) [m], with their time; None without one."""
    if len(position) < 2:
        return None
    duration = np.diff(log.time_s)
    with np.errstate(over="ignore"):
        length = np.linalg.norm(np.diff(position, axis=0), axis=1)
        speed = length / duration
    fast = np.flatnonzero(speed > JUMP_M_S)
    found = []
    for k in fast:
        around = np.r_[speed[max(k - _NEIGHBOURS, 0) : k], speed[k + 1 : k + 1 + _NEIGHBOURS]]
        limit = max(JUMP_M_S, _TIMES_NEIGHBOURS * float(np.median(around))) if around.size else _LONE_M_S
        if speed[k] > limit:
            found.append(k)
    if not found:
        return None
    k = max(found, key=lambda k: speed[k])
    rest = (
        f"; so do {len(found) - 1} other steps, the first at {log.time_s[found[0] + 1]:.3f} s" if len(found) > 1 else ""
    )
    return (
        f"{log.path}: the position jumps by {length[k]:.1f} m within {duration[k]:.3g} s at {log.time_s[k + 1]:.3f} s "
        f"({log.what} {log.row[k + 1]}), {speed[k]:.0f} m/s where up to {JUMP_M_S:.0f} m/s or "
        f"{_TIMES_NEIGHBOURS:.0f} times the speed around it is usual{rest}; fly a part without them with start_s and "
        "stop_s, or correct the log"
    )


def course_deg(log: Log, position: Floats) -> Floats:
    """Return the course over ground of positions (N, 3) at a log's samples, (N,) [deg from north, not wrapped].

    The course of steps of at least 1 m, at their middle times, is interpolated linearly, clockwise positive. It is held
    before the first step, after the last one, and in a step of more than 4 s.
    """
    kept = [0]
    for k in range(1, len(position)):
        if np.hypot(*(position[k, :2] - position[kept[-1], :2])) >= MOVED_M:
            kept.append(k)
    if len(kept) < 2:
        raise ThermorenderError(
            f"{log.path}: the positions move less than {MOVED_M:g} m, so there is no course over ground; leave "
            "course out, or give yaw_deg"
        )
    step = np.diff(position[kept, :2], axis=0)
    course = np.unwrap(np.degrees(np.arctan2(step[:, 0], step[:, 1])), period=360.0)
    start, end = log.time_s[kept[:-1]], log.time_s[kept[1:]]
    # In a step that takes long the vehicle stands, and keeps the course that it came with until shortly before its end.
    stands = end - start > 2.0 * _TURN_S
    middle = np.where(stands, end - _TURN_S / 2.0, (start + end) / 2.0)
    hold = np.flatnonzero(stands[1:]) + 1
    knots = np.concatenate([middle, end[hold] - _TURN_S])
    courses = np.concatenate([course, course[hold - 1]])
    order = np.argsort(knots, kind="stable")
    return np.interp(log.time_s, knots[order], courses[order])
