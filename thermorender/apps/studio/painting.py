"""Strokes of a hand on a picture, as texels: a brush, a polygon, a connected area, or all areas like it."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.studio.layers import Shot, plan_places, plan_window, top_of
from thermorender.errors import ThermorenderError

TOOLS = {
    "look": "Look", "point": "Point", "brush": "Brush", "polygon": "Polygon", "area": "This area", "alike": "All alike",
}  # fmt: skip
# Those that paint.
PAINTS = ("brush", "polygon", "area", "alike")
_MOST_CORNERS = 5000
# Rays within a stroke: finer ones are cast until fewer new texels than this share appear, up to so many a pixel's side
# and in all.
_NEW, _FINEST, _MOST_RAYS = 0.002, 16, 6_000_000


def texels_of(shot: Shot, tool: str, points: Any, radius_px: float) -> NDArray[np.int64]:
    """Return the texels of the terrain that a stroke on a Shot covers, ascending, (n,).

    `points` (n, 2) are shares of the picture's width and height: corners of a polygon, the line of a brush, whose
    `radius_px` is in pixels, or one place. A brush and a polygon cover what is seen there, and nothing behind it.

    Raises
    ------
    ThermorenderError
        No such tool or points, or nothing of the terrain there.
    """
    camera = shot.renderer.scene.camera
    known = np.asarray(points, np.float64)
    if tool not in PAINTS or known.ndim != 2 or known.shape[1] != 2 or not np.isfinite(known).all():
        raise ThermorenderError("this is not a stroke on the picture; draw it again")
    least = 3 if tool == "polygon" else 1
    if not least <= len(known) <= _MOST_CORNERS:
        what, end = ("polygon", ", and double-click to end it") if tool == "polygon" else ("stroke", "")
        raise ThermorenderError(
            f"this {what} has {len(known)} point{'s' * (len(known) != 1)}; draw one of {least} to {_MOST_CORNERS} "
            f"points{end}"
        )
    corner = known * (camera.width, camera.height)
    if tool in ("area", "alike"):
        column, row = (
            int(np.clip(at, 0, side - 1)) for at, side in zip(corner[0], shot.texels.shape[::-1], strict=True)
        )
        texel = int(shot.texels[row, column])
        found = shot.renderer.region(texel, tool == "alike") if texel >= 0 else np.empty(0, np.int64)
    else:
        found = _covered(shot, tool, corner, max(radius_px, 0.5))
    count = sum(surface.material.size for surface in shot.renderer.scene.surfaces[: shot.renderer.scene.terrain_count])
    found = found[(found >= 0) & (found < count)]
    if not found.size:
        raise ThermorenderError(
            "there is no terrain at this place, so nothing was painted; the material of an object is chosen in Cover"
        )
    return found


def _covered(shot: Shot, tool: str, corner: NDArray[np.float64], radius_px: float) -> NDArray[np.int64]:
    """The texels under a polygon or a line of a brush, by rays that become finer until they find no more."""
    side = np.array(shot.texels.shape[::-1])
    reach = radius_px if tool == "brush" else 0.0
    low = np.clip(np.floor(corner.min(axis=0) - reach), 0, side).astype(int)
    high = np.clip(np.ceil(corner.max(axis=0) + reach), 0, side).astype(int)
    if not (high > low).all():
        return np.empty(0, np.int64)
    found, finer = np.empty(0, np.int64), 1
    while finer == 1 or finer**2 * int((high - low).prod()) <= _MOST_RAYS:
        place = low + _inside(tool, (corner - low) * finer, radius_px * finer, (high - low) * finer) / finer
        seen = np.unique(_texels_at(shot, place)) if len(place) else found
        new = len(np.union1d(found, seen)) - len(found)
        found = np.union1d(found, seen)
        if finer >= _FINEST or (finer > 1 and new <= _NEW * len(found)):
            break
        finer *= 2
    return found


def _inside(tool: str, corner: NDArray[np.float64], radius: float, size: NDArray[np.integer]) -> NDArray[np.float64]:
    """The middles (n, 2) of the cells of an image that a stroke covers."""
    import cv2

    image: Any = np.zeros((int(size[1]), int(size[0])), np.uint8)
    # Fixed point of 1/16 cell; corners of cells are whole numbers here, and their middles for OpenCV.
    line = np.rint(16.0 * (corner - 0.5)).astype(np.int32)
    if tool == "polygon":
        cv2.fillPoly(image, [line], 1, shift=4)
    else:
        cv2.polylines(image, [line], False, 1, max(1, round(2.0 * radius)), shift=4)
        for end in (line[0], line[-1]):
            cv2.circle(image, tuple(map(int, end)), round(16.0 * radius), 1, -1, shift=4)
    row, column = np.nonzero(image)
    return np.column_stack([column, row]).astype(np.float64) + 0.5


def _texels_at(shot: Shot, place: NDArray[np.float64]) -> NDArray[np.int64]:
    """The texels that are seen at places (n, 2) of the picture [px]; −1 for none."""
    camera = shot.renderer.scene.camera
    if shot.plan is not None:
        east, north, _ = plan_window(shot.view, camera)
        x, y = plan_places(place[:, 0], place[:, 1], east, north, shot.plan.pixel_m, camera)
        start = np.column_stack([x, y, np.full(len(x), top_of(shot.renderer) + 1.0)])
        way = np.broadcast_to([0.0, 0.0, -1.0], start.shape)
    else:
        assert shot.frame is not None
        pose = shot.frame.pose
        slope = np.column_stack([camera.directions(place), np.ones(len(place))])
        way, start = slope @ pose[:3, :3].T, np.broadcast_to(pose[:3, 3], slope.shape)
    return shot.renderer.hits(start, way)[1]
