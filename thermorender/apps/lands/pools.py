"""Swimming pools in an orthophoto: cyan, smooth and compact areas that lie on the ground."""

import numpy as np
from numpy.typing import NDArray

# Hue [deg], saturation and value of water over the paint or tiles of a pool; the hue of courts and tarpaulins is bluer.
_HUE_DEG, _SATURATION, _VALUE = (165.0, 200.0), 0.28, 0.5
# Area [m²], share of the convex hull, and the standard deviation of the value within a pool.
_AREA_M2, _COMPACT, _EVEN = (12.0, 3000.0), 0.75, 0.12
# Colours are averaged over this width [m]: lanes, ladders and glints are narrower.
_OVER_M = 0.6
# A pool's surface is at most so high above the ground in the median [m]; surface models of water are rough.
_HIGH_M = 0.7


def pools(
    rgb: NDArray[np.uint8], valid: NDArray[np.bool_], texel_m: float, above_m: NDArray[np.floating] | None = None
) -> NDArray[np.int32]:
    """Return the number of the pool that each texel shows, (h, w) from 1; 0 for none.

    `rgb` (h, w, 3) is sRGB, `above_m` (h, w) the height of the surface above the ground [m], NaN where it is unknown.
    """
    import cv2

    side = max(1, round(_OVER_M / texel_m)) | 1
    smooth = cv2.medianBlur(np.ascontiguousarray(rgb), min(side, 5)) if side > 1 else rgb
    smooth = cv2.blur(smooth, (side, side))
    hsv = cv2.cvtColor(smooth.astype(np.float32) / 255.0, cv2.COLOR_RGB2HSV)
    hue, saturation, value = np.moveaxis(hsv, -1, 0)
    cyan = valid & (hue > _HUE_DEG[0]) & (hue < _HUE_DEG[1]) & (saturation > _SATURATION) & (value > _VALUE)
    kernel = np.ones((side, side), np.uint8)
    mask = cv2.morphologyEx(cv2.morphologyEx(cyan.astype(np.uint8), cv2.MORPH_OPEN, kernel), cv2.MORPH_CLOSE, kernel)
    count, label, about, _ = cv2.connectedComponentsWithStats(mask, connectivity=4)
    found, number = np.zeros(mask.shape, np.int32), 0
    for k in range(1, count):
        left, top, width, height, texels = (int(n) for n in about[k])
        if not _AREA_M2[0] <= texels * texel_m**2 <= _AREA_M2[1]:
            continue
        window = slice(top, top + height), slice(left, left + width)
        own = label[window] == k
        ring, _ = cv2.findContours(own.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        hull = cv2.contourArea(cv2.convexHull(np.concatenate(ring)))
        high = above_m is not None and stands_high(above_m[window][own])
        if texels > _COMPACT * hull and value[window][own].std() < _EVEN and not high:
            number += 1
            found[window][own] = number
    return found


def stands_high(above_m: NDArray[np.floating]) -> bool:
    """Return whether a part of a surface, `above_m` (n,) above the ground [m] or NaN, lies too high for water."""
    known = above_m[np.isfinite(above_m)]
    return bool(known.size) and float(np.median(known)) > _HIGH_M
