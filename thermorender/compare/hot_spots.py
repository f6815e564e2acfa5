"""A plain detector of hot spots: what a target's contrast to its surroundings is worth behind a camera.

The mean of a square of the target's size less that of a ring around it, over the standard deviation of that response
in the picture: a matched filter for a small bright disc in a textured background. It knows nothing else, neither
temperatures nor what targets look like.
"""

import numpy as np

# The ring lies this many target sizes out, so that the target's own edge is in neither.
_INNER, _OUTER = 2.0, 4.0


def response(counts, size_px):
    """Return the detector's response, (H, W) float32, in standard deviations of itself.

    Parameters
    ----------
    counts : (H, W) array
        What a camera reads.
    size_px : float
        Width of the target in the picture [px].

    Notes
    -----
    The deviation is 1.4826 times the median absolute one, so that the target itself does not widen it.
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
    found = small - ring
    middle = np.median(found)
    scale = 1.4826 * np.median(np.abs(found - middle))
    return (found - middle) / max(float(scale), 1e-6)


def peaks(found, size_px, least):
    """Return local maxima of a response above `least`: (rows, columns, values), the highest first."""
    import cv2

    width = 2 * max(1, round(size_px)) + 1
    highest = cv2.dilate(found, np.ones((width, width), np.uint8))
    rows, columns = np.nonzero((found == highest) & (found > least))
    values = found[rows, columns]
    order = np.argsort(-values, kind="stable")
    return rows[order], columns[order], values[order]
