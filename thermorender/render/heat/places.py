"""Points on a terrain: positions of its texels in space, and sunlight there."""

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from thermorender.render.arrays import Jit, opaque_vector
from thermorender.render.geometry import Geometry
from thermorender.scene.surface import Surface


def texel_points(geometry: Geometry, texels: NDArray[np.integer], face: NDArray[np.integer]) -> NDArray[np.float32]:
    """Return the middles of `texels`, flat and ascending, on the faces `face` that cover them, (n, 3) float32 [m]."""
    spot = np.empty((len(texels), 3), dtype=np.float32)
    for number, surface in enumerate(geometry.surfaces):
        first, last = geometry.texel_start[number : number + 2]
        here = slice(*np.searchsorted(texels, [first, last]))
        rows, columns = surface.material.shape
        row, column = np.divmod(texels[here] - first, columns)
        at = np.column_stack([column + 0.5, row + 0.5])
        spot[here] = _on_faces(surface, face[here] - geometry.face_start[number], at, (columns, rows))
    return spot


def sun_cosine(geometry: Geometry, point: Jit, normal: Jit, towards: NDArray[np.float64]) -> Jit:
    """Return the cosine of the sun's rays at points above the surface, Float, 0 in shadow; `towards` (3,) points to the
    sun."""
    return lit_cosine(geometry, normal, towards) * sun_share(geometry, point, normal, towards)


def lit_cosine(geometry: Geometry, normal: Jit, towards: NDArray[np.float64]) -> Jit:
    """Return the cosine of the sun's rays without shadows, Float, 0 on the side away from the sun."""
    return dr.maximum(dr.dot(normal, opaque_vector(geometry.mi, towards)), 0.0)


def sun_share(
    geometry: Geometry, point: Jit, normal: Jit, towards: NDArray[np.float64], active: Jit = True
) -> Jit:  # fmt: skip
    """Return the share of the sun's rays that arrives at points above the surface, Float; 0 on the side away from the
    sun."""
    return geometry.sunlight(point, towards, active & (dr.dot(normal, opaque_vector(geometry.mi, towards)) > 0.0))


def _on_faces(
    surface: Surface, face: NDArray[np.integer], at: NDArray[np.float64], size: tuple[int, int]
) -> NDArray[np.float64]:
    """Points (n, 3) of faces (n,) whose map positions are `at` (n, 2) [texels]."""
    corner, texel = surface.vertices[surface.faces], surface.uv.astype(np.float64) * size
    edge, change = corner[:, 1:] - corner[:, :1], texel[:, 1:] - texel[:, :1]
    area = np.linalg.det(change)
    flat = np.abs(area) < 1e-12
    change[flat] = np.eye(2)
    # Map position to barycentric coordinates, and these to the point.
    to_point = np.einsum("fij,fjk->fik", np.linalg.inv(change), edge)
    to_point[flat] = 0.0
    offset = np.where(flat[:, None], corner.mean(axis=1), corner[:, 0])
    base = np.where(flat[:, None], 0.0, texel[:, 0])
    return offset[face] + np.einsum("ni,nij->nj", at - base[face], to_point[face])
