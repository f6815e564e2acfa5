"""A matched filter for a small bright disc on a textured background: whether a camera picture shows a target.

The response is the mean of a square of the target's size minus that of a ring around it, over the standard deviation of
this difference in the picture.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

# Inner and outer width of the ring in target sizes; the gap keeps the target's edge out of both means.
_INNER, _OUTER = 2.0, 4.0


def response(counts: ArrayLike, size_px: float) -> NDArray[np.float32]:
    """Return the response (H, W) float32 to counts (H, W) for a target `size_px` wide, in standard deviations.

    The standard deviation is 1.4826 times the median absolute deviation, which a small target does not change.
    """
    import cv2

    image = np.asarray(counts, np.float32)
    widths = [max(1, round(size_px * factor)) | 1 for factor in (1.0, _INNER, _OUTER)]
    widths[1] = max(widths[1], widths[0] + 2)
    widths[2] = max(widths[2], widths[1] + 2)
    small, inner, outer = (
        cv2.boxFilter(image, cv2.CV_32F, (width, width), borderType=cv2.BORDER_REFLECT_101) for width in widths
    )
    areas = [float(width * width) for width in widths[1:]]
    ring = (outer * areas[1] - inner * areas[0]) / (areas[1] - areas[0])
    difference = np.asarray(small - ring, np.float32)
    middle = np.median(difference)
    scale = 1.4826 * np.median(np.abs(difference - middle))
    return (difference - middle) / max(float(scale), 1e-6)


def peaks(
    found: NDArray[np.float32], size_px: float, least: float
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float32]]:
    """Return (rows, columns, values) of the local maxima of a response above `least`, highest first."""
    import cv2

    width = 2 * max(1, round(size_px)) + 1
    highest = cv2.dilate(found, np.ones((width, width), np.uint8))
    rows, columns = np.nonzero((found == highest) & (found > least))
    values = found[rows, columns]
    order = np.argsort(-values, kind="stable")
    return rows[order], columns[order], values[order]
