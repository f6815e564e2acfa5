"""Texels that belong together on a scene's surfaces: a connected area of one material, or all areas like it.

Texels are connected within a texture, and across its islands where two faces share an edge in space. So a roof is one
area, however its texture is cut.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, label
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from thermorender.render.geometry import Geometry
from thermorender.scene.surface import Surface

# Vertices so near to each other are one point [m].
_SAME_M = 1e-3
# Faces whose normal has a smaller upward share are walls.
_UPRIGHT = 0.5
# A point of a face's edge that is moved this share of the way to its middle lies inside the face.
_INSIDE = 0.05
# Texels without a face this close to one are seen at its edge [texels].
_RIM = 1.5


def region(geometry: Geometry, material: NDArray[Any], texel: int, alike: bool = False) -> NDArray[np.int64]:
    """Return the numbers of the texels connected to one and of its material, ascending, (n,); `material` is that of all
    texels of the geometry. With `alike`, all texels of its surface that have its material and face up, or do not, as
    it does.
    """
    number = int(np.searchsorted(geometry.texel_start, texel, "right")) - 1
    surface, start = geometry.surfaces[number], int(geometry.texel_start[number])
    shape = surface.material.shape
    own = slice(start, int(geometry.texel_start[number + 1]))
    face = geometry.face_showing(number + 1)[own].astype(np.int64) - int(geometry.face_start[number])
    shown = ((face >= 0) & (face < len(surface.faces))).reshape(shape)
    same, at = (material[own] == material[texel]).reshape(shape), np.unravel_index(texel - start, shape)
    # A texel whose middle no face covers, but of which a part is seen, goes with the nearest one.
    away, nearest = distance_transform_edt(~shown, return_indices=True)
    seen, nearest = away < _RIM, tuple(nearest)
    if not (shown & same)[nearest][at]:
        return np.array([texel])
    if alike:
        kind = _upright(surface)[np.where(shown, face.reshape(shape), 0)]
        found = shown & same & (kind == kind[nearest][at])
    else:
        found = _connected(surface, shown & same, tuple(int(each[at]) for each in nearest))
    return start + np.flatnonzero(seen & same & found[nearest])


def _upright(surface: Surface) -> NDArray[np.bool_]:
    corner = surface.vertices[surface.faces]
    across = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    return np.abs(across[:, 2]) < _UPRIGHT * np.linalg.norm(across, axis=1)


def _connected(surface: Surface, same: NDArray[np.bool_], at: tuple[int, ...]) -> NDArray[np.bool_]:
    """The texels (h, w) of `same` that are connected to the one at (row, column)."""
    labels, count = label(same)
    one, other = _joints(surface, labels)
    both = (one > 0) & (other > 0)
    graph = coo_array((np.ones(both.sum()), (one[both], other[both])), (count + 1, count + 1))
    part = connected_components(graph, directed=False)[1]
    found: NDArray[np.bool_] = same & (part[labels] == part[labels[at]])
    return found


def _joints(surface: Surface, labels: NDArray[np.integer]) -> tuple[NDArray[np.integer], NDArray[np.integer]]:
    """Labels (n,) on both sides of the edges that two faces share."""
    point = np.unique(np.round(surface.vertices / _SAME_M).astype(np.int64), axis=0, return_inverse=True)[1].ravel()
    corners = point[surface.faces]
    count = len(corners)
    ends = np.sort(np.concatenate([corners[:, [k, (k + 1) % 3]] for k in range(3)]), axis=1)
    uv = np.concatenate([
        (1.0 - _INSIDE) * 0.5 * (surface.uv[:, k] + surface.uv[:, (k + 1) % 3]) + _INSIDE * surface.uv.mean(axis=1)
        for k in range(3)
    ])  # fmt: skip
    rows, columns = labels.shape
    column, row = (np.clip((uv[:, k] * side).astype(np.int64), 0, side - 1) for k, side in enumerate((columns, rows)))
    key = ends[:, 0] * (point.max() + 1) + ends[:, 1]
    order = np.argsort(key, kind="stable")
    here = labels[row, column]
    one, other = order[:-1], order[1:]
    meet = (key[one] == key[other]) & (one % count != other % count)
    return here[one[meet]], here[other[meet]]
