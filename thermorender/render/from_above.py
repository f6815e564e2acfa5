"""A scene's surfaces as seen straight from above: height and texel of the nearest surface under each position."""

import numpy as np
from numpy.typing import NDArray

from thermorender.render.arrays import aligned
from thermorender.render.geometry import Geometry

_AT_ONCE = 1 << 20


def from_above(
    geometry: Geometry, east: NDArray[np.floating], north: NDArray[np.floating]
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Return (height [m], flat number of the texel) of the highest surface at positions, in their shape; NaN and −1 for
    none."""
    mi = geometry.mi
    top = max(float(surface.vertices[:, 2].max()) for surface in geometry.surfaces) + 1.0
    height, texel = np.full(east.size, np.nan, np.float32), np.full(east.size, -1, np.int64)
    for first in range(0, east.size, _AT_ONCE):
        part = slice(first, first + _AT_ONCE)
        x, y = (mi.Float(aligned(np.ravel(each)[part].astype(np.float32))) for each in (east, north))
        point = mi.Point3f(x, y, mi.Float(top))
        # Crowns are as high as where half of the light is lost.
        hit = geometry.seen(mi.Ray3f(point, mi.Vector3f(0.0, 0.0, -1.0)))
        below = mi.Point3f(x, y, top - hit.distance)
        column, row = geometry.map_position(geometry.record(hit.face, hit.valid), below)
        number = np.array(geometry.nearest(hit.surface, column, row, hit.valid)).astype(np.int64)
        valid = np.array(hit.valid)
        height[part] = np.where(valid, top - np.array(hit.distance), np.nan)
        texel[part] = np.where(valid, number, -1)
    return height.reshape(east.shape), texel.reshape(east.shape)
