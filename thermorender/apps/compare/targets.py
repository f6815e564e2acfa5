"""Targets in the frames of a method: contrast, position, and whether a simple detector finds them.

Responses of both signs count. The detector uses the method's own frame after the sensor, in standard deviations of that
frame, so targets in frames of little contrast are easy to find.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.apps.compare.hot_spots import peaks, response
from thermorender.apps.compare.view import View

# Objects with fewer pixels are ignored; detections within this distance of an object are its own [px].
_LEAST_PX, _NEAR_PX = 4, 3
# Width of the ring around an object against which its contrast is measured [px].
_RING_PX = 6
# Weaker responses are background [standard deviations].
_LEAST = 3.0
# Highest number of false alarms per frame in the ROC.
_MOST_FALSE = 10.0


@dataclass
class Targets:
    """Targets in the frames of a method, over all poses."""

    # For each pose and target: scene, pose, object, pixels, contrast_k, true_contrast_k, offset_px, response
    rows: list[dict[str, Any]] = field(default_factory=list)
    false: list[float] = field(default_factory=list)  # Responses of peaks away from any target
    frames: int = 0  # Number of poses with targets

    def add(
        self, scene: str, view: View, objects: Sequence[str], seen: NDArray[np.floating], counts: NDArray[np.generic]
    ) -> None:
        """Add a View with a reference: the method's apparent temperature (H, W) [K] and sensor counts (H, W)."""
        assert view.truth is not None
        present = [(number, name) for number, name in enumerate(objects) if (view.object == number).sum() >= _LEAST_PX]
        if not present:
            return
        self.frames += 1
        size = np.median([np.sqrt((view.object == number).sum()) for number, _ in present])
        found = np.abs(response(counts, size))
        rows, columns, values = peaks(found, size, _LEAST)
        theirs = np.zeros(len(rows), bool)
        for number, name in present:
            mask = view.object == number
            centre = np.argwhere(mask).mean(axis=0)
            distance = np.hypot(rows - centre[0], columns - centre[1])
            own = _widened(mask, _NEAR_PX)[rows, columns]
            theirs |= own
            first = int(np.flatnonzero(own)[0]) if own.any() else None
            self.rows.append({
                "scene": scene, "pose": view.index, "object": name, "pixels": int(mask.sum()),
                "contrast_k": _contrast(seen, mask, view), "true_contrast_k": _contrast(view.truth, mask, view),
                "offset_px": None if first is None else float(distance[first]),
                "response": None if first is None else float(values[first]),
            })  # fmt: skip
        # Peaks outside the scored pixels do not count.
        counted = view.known[rows, columns] & ~theirs
        self.false += values[counted].tolist()

    def summary(self) -> dict[str, Any]:
        """Return {"objects": {object: statistics}, "roc", "frames"}, as plain numbers."""
        objects = {}
        for name in dict.fromkeys(row["object"] for row in self.rows):
            own = [row for row in self.rows if row["object"] == name]
            contrast, true = (np.array([row[key] for row in own], float) for key in ("contrast_k", "true_contrast_k"))
            hit = [row for row in own if row["offset_px"] is not None]
            # All three over the same poses, so that they are consistent.
            both = np.where(np.isfinite(contrast - true), 1.0, np.nan)
            objects[name] = {
                "poses": len(own), "true_contrast_k": _mean(true * both), "contrast_k": _mean(contrast * both),
                "contrast_error_k": _mean((contrast - true) * both),
                "found": len(hit) / len(own), "offset_px": _mean([row["offset_px"] for row in hit]),
            }  # fmt: skip
        return {"objects": objects, "roc": self.roc(), "frames": self.frames}

    def roc(self) -> list[tuple[float, float, float]]:
        """Return [(false alarms per frame, share of targets found, threshold)], highest threshold first."""
        if not self.frames:
            return []
        responses = np.array([row["response"] if row["response"] is not None else -np.inf for row in self.rows])
        false = np.array(self.false)
        levels = np.unique(np.concatenate([responses[np.isfinite(responses)], false]))[::-1]
        if len(levels) > 200:
            levels = levels[np.linspace(0, len(levels) - 1, 200).astype(int)]
        curve = [((false >= level).sum() / self.frames, float((responses >= level).mean()), float(level))
                 for level in levels]  # fmt: skip
        return [point for point in curve if point[0] <= _MOST_FALSE]


def _contrast(image: NDArray[np.floating], mask: NDArray[np.bool_], view: View) -> float:
    """Return the mean of an image on a target minus that of a ring of known ground around it [K]."""
    ring = _widened(mask, _RING_PX) & view.ground
    own = mask & view.known
    if not ring.any() or not own.any():
        return float("nan")
    return float(image[own].mean(dtype=np.float64) - image[ring].mean(dtype=np.float64))


def _widened(mask: NDArray[np.bool_], px: int) -> NDArray[np.bool_]:
    """Return a mask widened by `px` pixels."""
    side = 2 * px + 1
    widened: NDArray[np.bool_] = cv2.dilate(mask.astype(np.uint8), np.ones((side, side), np.uint8)) > 0
    return widened


def _mean(values: ArrayLike) -> float | None:
    array = np.asarray(values, float)
    return float(np.nanmean(array)) if array.size and np.isfinite(array).any() else None
