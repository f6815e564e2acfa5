"""Daylight on the texels of a terrain: whether the sun reaches each, and the share of its hemisphere that is sky."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thermorender.physics.sun import direction
from thermorender.render.arrays import aligned
from thermorender.render.geometry import Geometry
from thermorender.render.heat.places import sun_cosine, texel_points
from thermorender.render.light import transport_cache

_RAYS = 64
_AT_ONCE = 1 << 20


class Daylight(NamedTuple):
    """Daylight on texels, (T,) float32 each."""

    cosine: NDArray[np.float32]  # (T,) between the normal and the sun, 0 in shadow
    sky: NDArray[np.float32]  # (T,) share of the hemisphere that is sky, cosine weighted
    shown: NDArray[np.bool_]  # (T,) bool whether a face shows the texel; the others have neither


def daylight(
    geometry: Geometry, surfaces: int, sun: tuple[float, float], normal: NDArray[np.float32] | None = None,
    around: Geometry | None = None,
) -> Daylight:  # fmt: skip
    """Return the Daylight on the texels of the first `surfaces` of a geometry. `sun` is azimuth and elevation [deg];
    `normal` (T, 3) are normals of the texels, NaN for those of their faces. The sky is that which `around` leaves, a
    geometry that begins with the same surfaces."""
    mi, face = geometry.mi, geometry.face_showing(surfaces)
    shown = face < geometry.face_count
    cosine, sky = np.zeros(len(face), np.float32), np.zeros(len(face), np.float32)
    sky[shown] = transport_cache.traced(around or geometry, _RAYS)[0].sky.sum(axis=1)[face[shown]]
    corner = np.concatenate([each.vertices[each.faces] for each in geometry.surfaces[:surfaces]])
    across = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    across = (across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-300)).astype(np.float32)
    texels, towards = np.flatnonzero(shown), direction(sun[1], sun[0])
    for first in range(0, len(texels), _AT_ONCE):
        part = texels[first : first + _AT_ONCE]
        own = across[face[part]]
        point = texel_points(geometry, part, face[part])
        point += geometry.hair_at(point) * own
        if normal is not None:
            own = np.where(np.isfinite(normal[part]), normal[part], own)
        upload = lambda values: [mi.Float(aligned(axis)) for axis in values.T]  # noqa: E731
        cosine[part] = np.array(sun_cosine(geometry, mi.Point3f(*upload(point)), mi.Vector3f(*upload(own)), towards))
    return Daylight(cosine, sky, shown)
