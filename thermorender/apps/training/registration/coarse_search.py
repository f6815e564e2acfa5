"""First search of a rig: scale, rotation and shift on a grid, on small pictures."""

from collections.abc import Sequence

import numpy as np

from thermorender.apps.training.registration.gradient_directions import best_shift, directions
from thermorender.apps.training.registration.levels import (
    FIELD_TOLERANCE,
    SCALES,
    Frame,
    Shapes,
    filling_scale,
    resized,
)
from thermorender.progress import Progress

# Columns of the small pictures, and the largest number of frames.
SMALL, _FIRST_FRAMES = 112, 16
_SCALE_STEP, _ROTATIONS_DEG = 0.04, (-4.0, -2.0, 0.0, 2.0, 4.0)
# Size of the correlation canvas in pictures: shifts reach a quarter of a picture.
CANVAS = 1.5


def searched(
    pictures: Sequence[Frame], shapes: Shapes, reduced: float, start: float | None, report_progress: Progress
) -> list[np.ndarray]:
    """Return up to three (6,) parameters to start the fit from, the best first."""
    import cv2

    factor = shapes[1][1] / min(SMALL, shapes[1][1])
    if len(pictures) > _FIRST_FRAMES:
        pictures = [pictures[k] for k in np.linspace(0, len(pictures) - 1, _FIRST_FRAMES).round().astype(int)]
    thermal = [directions(resized(frame.thermal, factor)[0]) for frame in pictures]
    shape = thermal[0].shape
    filling = filling_scale(shapes)
    low, high = np.log(SCALES) + np.log(filling)
    if start is not None:
        low, high = np.log(start) + np.log1p(-FIELD_TOLERANCE), np.log(start) + np.log1p(FIELD_TOLERANCE)
    found: list[tuple[float, np.ndarray]] = []
    canvas = [int(np.ceil(CANVAS * side)) for side in shape]
    grid = np.linspace(low, high, int(np.ceil((high - low) / _SCALE_STEP)) + 1)
    for number, log_scale in enumerate(grid):
        report_progress("searching scale and rotation", number / len(grid))
        small = [resized(frame.visible, np.exp(log_scale) * factor / reduced)[0] for frame in pictures]
        height, width = small[0].shape
        for angle in _ROTATIONS_DEG:
            # From the canvas into the small visible picture, about the centres of both.
            cos, sin = np.cos(np.radians(angle)), np.sin(np.radians(angle))
            turn = np.array([[cos, -sin], [sin, cos]])
            middle = (np.array([width, height]) - 1.0) / 2.0 - turn @ ((np.array(canvas[::-1]) - 1.0) / 2.0)
            matrix, flags = np.column_stack([turn, middle]), cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
            covered = cv2.warpAffine(np.ones((height, width), np.uint8), matrix, canvas[::-1], flags=flags)
            inside = np.asarray(cv2.erode(covered, np.ones((5, 5), np.uint8), borderValue=0) > 0)
            turned = [
                directions(cv2.warpAffine(each, matrix, canvas[::-1], flags=flags, borderMode=cv2.BORDER_REPLICATE))
                for each in small
            ]
            score, shift = best_shift(turned, thermal, inside)
            # Point x of the thermal picture is point R(x + shift) of the visible one.
            shift = turn @ shift * factor
            found.append((score, np.array([log_scale, np.radians(angle), *shift, 0.0, 0.0])))
    found.sort(key=lambda each: -each[0])
    starts: list[np.ndarray] = []
    for _, each in found:
        apart = [abs(each[0] - other[0]) > 1.5 * _SCALE_STEP or abs(each[1] - other[1]) > 0.04 for other in starts]
        if all(apart):
            starts.append(each)
        if len(starts) == 3:
            break
    return starts
