"""A multirotor as a point mass: its autopilot follows a commanded velocity with a lag, and wind exerts drag.

    dv/dt = clip((u − v) / τ, a_max) + k (w − v)

with the commanded velocity u and the wind w. The wind is a mean plus first-order gusts along each horizontal axis, the
longitudinal form of the Dryden spectrum (MIL-F-8785C, 3.7.1) for a slow vehicle.
"""

import numpy as np

# Lag of the velocity controller [s], drag [1/s], and largest acceleration by tilting [m/s²]: assumed for a camera drone
# of a few kilograms.
LAG_S, DRAG_PER_S, MOST_M_S2 = 0.5, 0.15, 5.0
# Standard deviation of a gust component over the mean wind, and its correlation time [s]: assumed for a moderate breeze
# near the ground.
GUST_SHARE, GUST_S = 0.2, 2.0
_STEP_S = 0.01


def flown(position, velocity, command, wind, span_s):
    """Return (position, velocity), (3,) each, after a span of time in a steady wind [m, m/s].

    Parameters
    ----------
    position, velocity, command, wind : (3,) arrays
        East, north, up [m, m/s].
    span_s : float
        [s]

    Notes
    -----
    Midpoint rule with steps of 10 ms: within 0.1 mm of the closed form over a second, without clipping.
    """
    count = max(1, int(np.ceil(span_s / _STEP_S)))
    step = span_s / count
    for _ in range(count):
        middle = velocity + 0.5 * step * _acceleration(velocity, command, wind)
        changed = velocity + step * _acceleration(middle, command, wind)
        position = position + 0.5 * step * (velocity + changed)
        velocity = changed
    return position, velocity


def winds(mean, count, span_s, rng):
    """Return the wind over `count` spans of time, (count, 3) [m/s]: a mean (2,) east and north plus gusts."""
    keep = np.exp(-span_s / GUST_S)
    spread = GUST_SHARE * float(np.hypot(*mean))
    gusts = np.empty((count, 2))
    now = rng.normal(size=2)
    for k in range(count):
        gusts[k] = now
        now = keep * now + np.sqrt(1.0 - keep * keep) * rng.normal(size=2)
    return np.column_stack([mean + spread * gusts, np.zeros(count)])


def _acceleration(velocity, command, wind):
    wanted = (command - velocity) / LAG_S
    size = float(np.linalg.norm(wanted))
    return wanted * min(1.0, MOST_M_S2 / max(size, 1e-9)) + DRAG_PER_S * (wind - velocity)
