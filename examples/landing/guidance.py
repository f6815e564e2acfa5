"""Image-based control: a simple detector locates the marker, and the controller steers the vehicle there and down.

The tracker searches the whole picture for the strongest hot spot of the marker's size. A spot in several consecutive
pictures is accepted as the marker; then the tracker follows the strongest spot near the last position. It knows the
height above the ground (as from a laser altimeter) and the size of the marker, but nothing of the scene.
"""

from dataclasses import dataclass

import numpy as np

from thermorender.apps.compare import hot_spots

# Smallest responses to detect and to follow a spot, in standard deviations of the response; consecutive pictures with
# the spot until it is accepted, and without it until it is lost.
SEEN, FOLLOWED = 6.0, 5.0
AGREEING, MISSING = 3, 5
# Radius of the search around a spot in the next picture: in sizes of the spot, and at least this many pixels.
_GATE_SIZES, _GATE_PX = 3.0, 40.0
# Gains of velocity: proportional [1/s] and integral [1/s²]; largest horizontal speed [m/s].
_ALONG, _INTEGRAL, _FASTEST_M_S = 1.0, 0.3, 5.0
# Descent rate per height [1/s], largest descent rate [m/s], and largest offset of the marker for descent, as a share of
# the height.
_DOWN, _DOWN_M_S, _CONE = 0.25, 4.0, 0.25
# Below this height the detector's ring no longer fits the picture: the vehicle descends vertically at this speed with
# the last wind correction [m, m/s].
BLIND_M, _BLIND_M_S = 4.5, 1.5


@dataclass
class Tracker:
    """The spot that is tracked as the marker.

    Attributes
    ----------
    focal_px : float
        Focal length of the camera [px].
    size_m : float
        Width of the marker [m].
    at : (2,) array or None
        Row and column of the followed spot; None while the whole picture is searched.
    locked : bool
        Whether the spot is accepted as the marker.
    """

    focal_px: float
    size_m: float
    at: np.ndarray | None = None
    locked: bool = False
    _run: int = 0

    def look(self, counts, height_m):
        """Return the spot's row and column (2,) in counts (H, W) from a height [m]; None if no spot is detected."""
        size = self.focal_px * self.size_m / max(height_m, 0.1)
        found = hot_spots.response(counts, size)
        rows, columns, values = hot_spots.peaks(found, size, SEEN if self.at is None else FOLLOWED)
        spots = np.column_stack([rows, columns])
        if self.at is not None:
            near = np.hypot(*(spots - self.at).T) <= max(_GATE_SIZES * size, _GATE_PX)
            spots, values = spots[near], values[near]
        seen = spots[0].astype(float) if len(spots) else None
        self._count(seen)
        return seen

    def _count(self, seen):
        if seen is None:
            self._run = min(self._run, 0) - 1
            # Before it is locked, a spot must be detected in every picture.
            if not self.locked or self._run <= -MISSING:
                self.at, self.locked, self._run = None, False, 0
            return
        self._run = max(self._run, 0) + 1
        self.at = seen
        self.locked = self.locked or self._run >= AGREEING


@dataclass
class Steering:
    """Velocity commands from the tracker's offset.

    Attributes
    ----------
    wind_m_s : (2,) array
        Integrated correction of the wind [m/s].
    """

    wind_m_s: np.ndarray

    def command(self, offset_m, height_m, span_s):
        """Return the commanded velocity (3,) east, north, up [m/s].

        Parameters
        ----------
        offset_m : (2,) array or None
            Position of the marker east and north of the vehicle [m]; None while it is not tracked.
        height_m : float
            Height above the ground [m].
        span_s : float
            Time until the next command [s].
        """
        if height_m < BLIND_M:
            return np.array([*self.wind_m_s, -_BLIND_M_S])
        if offset_m is None:
            return np.array([*self.wind_m_s, 0.0])
        along = _ALONG * offset_m
        if np.hypot(*along) < _FASTEST_M_S:
            self.wind_m_s = self.wind_m_s + _INTEGRAL * span_s * offset_m
        along = along + self.wind_m_s
        along *= min(1.0, _FASTEST_M_S / max(float(np.hypot(*along)), 1e-9))
        inside = np.hypot(*offset_m) < _CONE * height_m
        return np.array([*along, -min(_DOWN * height_m, _DOWN_M_S) if inside else 0.0])
