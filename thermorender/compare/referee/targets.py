"""What each method makes of targets: their contrast, where they are, and whether a plain detector finds them.

A target may be warmer or colder than what is around it: a response of either sign counts. The detector sees the
method's own picture behind the sensor, in standard deviations of that picture: one that shows little else makes its
targets easy to find.
"""

from dataclasses import dataclass, field

import cv2
import numpy as np

from thermorender.compare import hot_spots

# Objects smaller than this are not asked for [px], and detections on them or so near are theirs.
_LEAST_PX, _NEAR_PX = 4, 3
# The ring around an object that its contrast is told against [px].
_RING_PX = 6
# Responses from which on peaks are kept: fewer standard deviations are the background's own.
_LEAST = 3.0
_MOST_FALSE = 10.0


@dataclass
class Targets:
    """What a method makes of the targets of all poses.

    Attributes
    ----------
    rows : list of dict
        Of each pose and target: scene, pose, object, pixels, contrast_k, true_contrast_k, offset_px, response.
    false : list of float
        Responses of peaks away from any target.
    frames : int
        Poses in which targets were looked for.
    """

    rows: list = field(default_factory=list)
    false: list = field(default_factory=list)
    frames: int = 0

    def add(self, scene, view, objects, seen, counts):
        """Add a View: what the method sees, (H, W) [K], and what the sensor reads of it, (H, W) counts."""
        present = [(number, name) for number, name in enumerate(objects) if (view.object == number).sum() >= _LEAST_PX]
        if not present:
            return
        self.frames += 1
        size = np.median([np.sqrt((view.object == number).sum()) for number, _ in present])
        found = np.abs(hot_spots.response(counts, size))
        rows, columns, values = hot_spots.peaks(found, size, _LEAST)
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
        # What lies outside the judged part of the picture is nobody's fault.
        counted = view.known[rows, columns] & ~theirs
        self.false += values[counted].tolist()

    def summary(self):
        """Return {object: {…}} and the ROC, plain numbers."""
        told = {}
        for name in dict.fromkeys(row["object"] for row in self.rows):
            own = [row for row in self.rows if row["object"] == name]
            contrast, true = (np.array([row[key] for row in own], float) for key in ("contrast_k", "true_contrast_k"))
            hit = [row for row in own if row["offset_px"] is not None]
            # Of the same poses, so that the three add up.
            both = np.where(np.isfinite(contrast - true), 1.0, np.nan)
            told[name] = {
                "poses": len(own), "true_contrast_k": _mean(true * both), "contrast_k": _mean(contrast * both),
                "contrast_error_k": _mean((contrast - true) * both),
                "found": len(hit) / len(own), "offset_px": _mean([row["offset_px"] for row in hit]),
            }  # fmt: skip
        return {"objects": told, "roc": self.roc(), "frames": self.frames}

    def roc(self):
        """Return [(false alarms per frame, share of targets found, response)] from strict to lax."""
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


def _contrast(image, mask, view):
    """Mean of an image on a target less that of a ring around it, of known ground [K]."""
    ring = _widened(mask, _RING_PX) & view.known & (view.object < 0)
    own = mask & view.known
    if not ring.any() or not own.any():
        return float("nan")
    return float(image[own].mean(dtype=np.float64) - image[ring].mean(dtype=np.float64))


def _widened(mask, px):
    """A mask and so many pixels around it."""
    side = 2 * px + 1
    return cv2.dilate(mask.astype(np.uint8), np.ones((side, side), np.uint8)) > 0


def _mean(values):
    values = np.asarray(values, float)
    return float(np.nanmean(values)) if values.size and np.isfinite(values).any() else None
