"""Whether frames of another program show other poses than their own: late, early or in another order."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.compare.causes import SHARE

# Poses that are compared, the first ones of a scene, longest side of the small pictures [px], and least share that both
# show.
_MOST, _SIDE_PX, _LEAST = 48, 160, 0.1


@dataclass
class FrameOrder:
    """Small pictures of a scene's frames and of their references, with NaN where unknown."""

    seen: list[NDArray[np.float32]] = field(default_factory=list)
    truth: list[NDArray[np.float32]] = field(default_factory=list)

    def add(self, image: NDArray[np.floating], truth: NDArray[np.floating], known: NDArray[np.bool_]) -> None:
        """Add a pose: its frame and its reference (H, W) [K]."""
        if len(self.seen) < _MOST:
            self.seen.append(_small(image, known))
            self.truth.append(_small(truth, known))

    def summary(self) -> dict[str, Any] | None:
        """Return {"shows": number of the pose that each frame shows, "late": poses or None, "share"}, or None.

        "share" is that of the square error about a line which the poses shown explain, of all frames; it is None unless
        the frames that show another pose do so far better than their own, by the same share. "late" is the number of
        poses by which all such frames are late, negative where they are early.
        """
        poses = len(self.seen)
        if poses < 2:
            return None
        left = np.array([[_left(seen, truth) for truth in self.truth] for seen in self.seen])
        own = np.diag(left)
        shows = np.where(left.min(axis=1) <= (1.0 - SHARE) * own, left.argmin(axis=1), np.arange(poses))
        best = left[np.arange(poses), shows]
        share = 1.0 - float(best.sum() / own.sum()) if own.sum() > 0.0 else 0.0
        if (shows == np.arange(poses)).all() or share < SHARE:
            return None
        late = (np.arange(poses) - shows)[shows != np.arange(poses)]
        same = len(late) > 1 and bool((late == late[0]).all()) and len(late) >= poses - abs(int(late[0]))
        return {"shows": shows.tolist(), "late": int(late[0]) if same else None, "share": share}


def _small(image: NDArray[np.floating], known: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Return a picture of at most `_SIDE_PX`, of means of its pixels."""
    step = -(-max(image.shape) // _SIDE_PX)
    rows, columns = (n // step * step for n in image.shape)
    values = np.where(known, image, np.nan)[:rows, :columns].astype(np.float32)
    # The mean of a square with an unknown pixel is unknown.
    return values.reshape(rows // step, step, columns // step, step).mean(axis=(1, 3))


def _left(seen: NDArray[np.float32], truth: NDArray[np.float32]) -> float:
    """Return the square error that a rising line of the reference leaves in a frame [K²]; infinite for unlike ones."""
    here = np.isfinite(seen) & np.isfinite(truth)
    if here.mean() < _LEAST:
        return np.inf
    s, t = (values[here].astype(np.float64) for values in (seen, truth))
    s, t = s - s.mean(), t - t.mean()
    both, square = float(s @ t), float(t @ t)
    line = max(both, 0.0) ** 2 / square if square > 0.0 else 0.0
    return max(float(s @ s) - line, 0.0) / len(s)
