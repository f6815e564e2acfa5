"""What each method makes of targets: their contrast, where they are, and whether a plain detector still finds them."""

from dataclasses import dataclass, field

import cv2
import numpy as np

from thermorender.validate import detector

# Objects smaller than this are not asked for [px], and detections within so many sizes, at least so far, are theirs.
_LEAST_PX, _NEAR_SIZES, _NEAR_PX = 4, 1.5, 3.0
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
        found = detector.response(counts, size)
        rows, columns, values = detector.peaks(found, size, _LEAST)
        theirs = np.zeros(len(rows), bool)
        for number, name in present:
            mask = view.object == number
            centre = np.argwhere(mask).mean(axis=0)
            near = max(_NEAR_SIZES * np.sqrt(mask.sum()), _NEAR_PX)
            distance = np.hypot(rows - centre[0], columns - centre[1])
            own = distance <= near
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
            finite = np.isfinite(contrast - true)
            told[name] = {
                "poses": len(own), "true_contrast_k": _mean(true), "contrast_k": _mean(contrast),
                "contrast_error_k": _mean((contrast - true)[finite]),
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
    side = 2 * _RING_PX + 1
    around = cv2.dilate(mask.astype(np.uint8), np.ones((side, side), np.uint8)) > 0
    ring = around & view.known & (view.object < 0)
    own = mask & view.known
    if not ring.any() or not own.any():
        return float("nan")
    return float(image[own].mean(dtype=np.float64) - image[ring].mean(dtype=np.float64))


def _mean(values):
    values = np.asarray(values, float)
    return float(np.nanmean(values)) if values.size and np.isfinite(values).any() else None
