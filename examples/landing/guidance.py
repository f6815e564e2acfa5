"""Image-based control: a plain detector says where the marker is, and the vehicle is steered there and down.

The tracker looks for the strongest hot spot of the marker's size in the whole picture, takes it for the marker once it
has been there in several pictures in a row, and then follows the strongest one near where it was. It knows its height
above the ground, as by a laser altimeter, and the size of the marker; nothing of the scene.
"""

from dataclasses import dataclass

import numpy as np

from thermorender.compare import hot_spots

# Responses from which on a spot is looked at and from which on it is still followed, in standard deviations of the
# picture's own response; pictures in a row until it is taken for the marker, and without it until it is lost.
SEEN, FOLLOWED = 6.0, 5.0
AGREEING, MISSING = 3, 5
# Pixels around a spot in which it is looked for in the next picture: so many of its sizes, at least so many.
_GATE_SIZES, _GATE_PX = 3.0, 40.0
# Gains: velocity by offset [1/s], and by its integral [1/s²]; the fastest sideways [m/s].
_ALONG, _INTEGRAL, _FASTEST_M_S = 1.0, 0.3, 5.0
# Descent by height [1/s], at most so fast [m/s], and only while the marker lies within this share of the height.
_DOWN, _DOWN_M_S, _CONE = 0.25, 4.0, 0.25
# Below this the detector's ring no longer fits the picture: straight down, held against the wind as before [m, m/s].
BLIND_M, _BLIND_M_S = 4.5, 1.5


@dataclass
class Tracker:
    """Which spot is taken for the marker.

    Attributes
    ----------
    focal_px : float
        Focal length of the camera [px].
    size_m : float
        Width of the marker [m].
    at : (2,) array or None
        Row and column of the spot that is followed; None while the whole picture is looked through.
    locked : bool
        Whether it is taken for the marker.
    """

    focal_px: float
    size_m: float
    at: np.ndarray | None = None
    locked: bool = False
    _run: int = 0

    def look(self, counts, height_m):
        """Return the spot's row and column (2,) in counts (H, W) from a height [m]; None where none is seen."""
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
            # Before it is locked a spot has to be there in every picture.
            if not self.locked or self._run <= -MISSING:
                self.at, self.locked, self._run = None, False, 0
            return
        self._run = max(self._run, 0) + 1
        self.at = seen
        self.locked = self.locked or self._run >= AGREEING


@dataclass
class Steering:
    """Commands from what the tracker sees.

    Attributes
    ----------
    wind_m_s : (2,) array
        What has to be added against the wind, as integrated so far [m/s].
    """

    wind_m_s: np.ndarray

    def command(self, offset_m, height_m, span_s):
        """Return the commanded velocity (3,) east, north, up [m/s].

        Parameters
        ----------
        offset_m : (2,) array or None
            Where the marker is seen, east and north of the vehicle [m]; None while it is not tracked.
        height_m : float
            Above the ground [m].
        span_s : float
            Until the next command [s].
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
