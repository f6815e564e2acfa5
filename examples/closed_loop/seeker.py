"""A seeker: the centroid of a hot spot in the counts, the filtered line of sight, and proportional navigation.

The seeker has a camera fixed to the vehicle, the attitude of the camera and the velocity. It knows no range, no
position of the target and nothing of the scene.
"""

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from thermorender.apps.compare import hot_spots
from thermorender.trajectory.rotations import rotation_from_wxyz

# Smallest responses to detect and to follow a spot, in standard deviations of the response.
SEEN, FOLLOWED = 8.0, 5.0
# Width of the first detector, its limits, and the smallest radius of the search around the last position [px].
_FIRST_PX, _SIZES_PX, _GATE_PX = 2.0, (1.5, 30.0), 12.0
# Frames in a row with the spot until it steers, and without it until the whole picture is searched again.
AGREEING, MISSING = 3, 6
# Gains of the filter of the line of sight: share of the new direction, and of its change in the rate.
_DIRECTION, _RATE = 0.5, 0.2
# A spot from this width on was seen before as a small one: it is not searched for edges [px].
_LARGE_PX = 8.0
NAVIGATION = 3.0
GRAVITY = np.array([0.0, 0.0, -9.80665])


@dataclass
class Seeker:
    """The spot that is followed, and its line of sight.

    Attributes
    ----------
    focal_px : float
        Focal length of the camera [px].
    lag_s : float
        Age of what the pixels show: their time constant [s].
    at : (2,) array or None
        Column and row where the spot was seen last; None while the whole picture is searched.
    run : int
        Frames in a row with the spot; negative: without it.
    size_px : float
        Width of the spot.
    sight, rate : (3,) arrays or None
        Unit vector to the spot in the scene's axes, and its change [1/s].
    locked : bool
        Whether the spot steers.
    """

    focal_px: float
    lag_s: float = 0.0
    at: np.ndarray | None = None
    run: int = 0
    size_px: float = _FIRST_PX
    sight: np.ndarray | None = None
    rate: np.ndarray = field(default_factory=lambda: np.zeros(3))
    locked: bool = False
    _time_s: float = 0.0

    @classmethod
    def of(cls, session, focal_px):
        """Return the seeker of a session, or of None; frames of method B show a camera at rest."""
        still = session is None or session.settings.method == "B"
        return cls(focal_px, 0.0 if still else session.opened.time_constant_s)

    def look(self, time_s, counts, attitude, rates):
        """Take a frame.

        Parameters
        ----------
        time_s : float
        counts : (H, W) array
        attitude : (4,) array
            Quaternion w, x, y, z from camera axes to the scene's east, north, up.
        rates : (3,) array
            Angular rates about the camera's axes, as a gyroscope gives them [rad/s].
        """
        spot = self._spot(np.asarray(counts, np.float32))
        if spot is None:
            self._missed()
            return
        self.at, self.run = spot, max(self.run, 0) + 1
        height, width = counts.shape
        column, row = self.at - ((width - 1) / 2.0, (height - 1) / 2.0)
        then = rotation_from_wxyz(attitude) * Rotation.from_rotvec(-self.lag_s * np.asarray(rates))
        ray = then.apply([column, row, self.focal_px])
        self._filter(time_s, ray / np.linalg.norm(ray))

    def acceleration(self, velocity):
        """Return the specific force that proportional navigation wants, (3,) across the velocity [m/s²].

        It is zero until the spot was found.
        """
        if self.sight is None or not self.locked:
            return np.zeros(3)
        forward = velocity / np.linalg.norm(velocity)
        across = self.rate - self.sight * (self.rate @ self.sight)
        wanted = NAVIGATION * max(velocity @ self.sight, 0.0) * across - GRAVITY
        return wanted - forward * (wanted @ forward)

    def _missed(self):
        self.run = min(self.run, 0) - 1
        # Before it steers, a spot must be in every frame.
        if not self.locked or self.run <= -MISSING:
            self.at, self.sight, self.locked = None, None, False
            self.size_px, self.rate = _FIRST_PX, np.zeros(3)

    def _spot(self, counts):
        """Column and row of the spot's centroid, (2,); None without a spot."""
        found = hot_spots.response(counts, self.size_px)
        rows, columns, _ = hot_spots.peaks(found, self.size_px, SEEN if self.at is None else FOLLOWED)
        spots = np.column_stack([columns, rows]).astype(float)
        if self.at is not None:
            spots = spots[np.hypot(*(spots - self.at).T) <= max(3.0 * self.size_px, _GATE_PX)]
        reach = int(2.0 * self.size_px) + 2
        for column, row in spots.astype(int):
            top, left = max(row - reach, 0), max(column - reach, 0)
            window = counts[top : row + reach + 1, left : column + reach + 1]
            if self.size_px >= _LARGE_PX or _is_spot(window):
                break
        else:
            return None
        low = float(np.median(window)) if self.size_px < _LARGE_PX else float(window.min())
        weight = np.clip(window - 0.5 * (low + window.max()), 0.0, None)
        self.size_px = float(np.clip(np.sqrt(np.count_nonzero(weight)), *_SIZES_PX))
        y, x = np.indices(window.shape)
        return np.array([left + np.average(x, weights=weight), top + np.average(y, weights=weight)])

    def _filter(self, time_s, seen):
        """Alpha-beta filter of the unit vector."""
        if self.sight is None:
            self.sight, self._time_s = seen, time_s
            return
        step, self._time_s = time_s - self._time_s, time_s
        ahead = self.sight + step * self.rate
        self.rate = self.rate + _RATE / step * (seen - ahead)
        self.locked = self.locked or self.run >= AGREEING
        sight = ahead + _DIRECTION * (seen - ahead)
        self.sight = sight / np.linalg.norm(sight)


def _is_spot(window):
    """Whether the middle is warmer than all four sides of a window; at the edge of the land one side is as warm."""
    sides = [np.median(side) for side in (window[0], window[-1], window[:, 0], window[:, -1])]
    return window.max() - max(sides) > 0.5 * (window.max() - min(sides))


def closest(path, target):
    """Return the smallest distance of a path of straight pieces, (n, 3), from a place (3,) [m]."""
    start, step = path[:-1] - target, np.diff(path, axis=0)
    length = np.maximum((step * step).sum(axis=1), 1e-12)
    share = np.clip(-(start * step).sum(axis=1) / length, 0.0, 1.0)
    return float(np.linalg.norm(start + share[:, None] * step, axis=1).min())
