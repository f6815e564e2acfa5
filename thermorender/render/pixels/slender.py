"""Details thinner than a pixel: the pixels of a view that may show them, for importance sampling.

A box is put round each connected part of a surface. Its image is a band; each pixel that it crosses has a rectangle
that contains the band there. Rays are stratified: those in the rectangle are weighted by its area, those outside by the
rest of the pixel. A spot of a thousandth of a pixel is then sampled as well as a wall.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from thermorender.render.arrays import Floats
from thermorender.scene.surface import Surface
from thermorender.sensor.camera import Camera

# A band at least this wide is hit by the ray in the middle of some pixel [px].
_WIDE = 1.5
# A rectangle of more than this share of a pixel is extended to the whole pixel.
_WHOLE = 0.5
# Parts with a corner nearer than this along the camera's axis are not thin [m].
_NEAR = 0.05
# Weight of area times longest side relative to volume in the size of boxes.
_FLAT = 1e-3
_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
# Rotations about each axis in steps of 7.5°.
_TURNS = Rotation.from_rotvec([angle * axis for axis in np.eye(3) for angle in np.arange(12) * np.pi / 24]).as_matrix()


@dataclass(frozen=True)
class Rectangles:
    """Parts of pixels that show something thin."""

    pixels: NDArray[np.int64]  # (n,) flat numbers, ascending
    corner: Floats  # (n, 2) (right, down) of the upper left corner in the pixel, 0…1
    size: Floats  # (n, 2) sides [px]

    def of(self, chosen: NDArray[np.bool_]) -> "Rectangles":
        """Return the Rectangles of `chosen` pixels (n,)."""
        return Rectangles(self.pixels[chosen], self.corner[chosen], self.size[chosen])

    @property
    def share(self) -> Floats:
        """Area of each rectangle [pixels]."""
        return self.size.prod(axis=1)


def boxes(surfaces: Sequence[Surface]) -> Floats:
    """Return the corners of boxes round the connected parts of surfaces, (n, 8, 3) [m]."""
    # Leaves thinner than a pixel are many in each, so that its rays find them as they find a texture.
    solid = [surface for surface in surfaces if surface.instances is None]
    sizes = [len(surface.vertices) for surface in solid]
    if not sum(sizes):
        return np.empty((0, 8, 3))
    # With their surface's number, since surfaces are not connected; all at once, since a scene may have thousands.
    placed = np.column_stack([np.repeat(np.arange(len(solid)), sizes), np.concatenate([s.vertices for s in solid])])
    faces = [surface.faces + start for surface, start in zip(solid, np.cumsum([0, *sizes]), strict=False)]
    placed, _, part = _connected(placed, np.concatenate(faces))
    order = np.argsort(part, kind="stable")
    vertices, part, count = placed[order, 1:], part[order], int(part.max()) + 1
    first = np.flatnonzero(np.diff(part, prepend=-1))
    middle = np.add.reduceat(vertices, first) / np.bincount(part)[:, None]
    offset = vertices - middle[part]
    axes = np.linalg.eigh(np.add.reduceat(np.einsum("vi,vj->vij", offset, offset), first))[1]
    # The axes of a part as wide as long are arbitrary, so the smallest of several rotated boxes is taken.
    least, best = np.full(count, np.inf), np.empty((count, 8, 3))
    for turn in _TURNS:
        turned = axes @ turn
        along = np.einsum("vi,vij->vj", offset, turned[part])
        low, high = np.minimum.reduceat(along, first), np.maximum.reduceat(along, first)
        # By volume, and for flat parts by area.
        side = high - low
        size = side.prod(axis=1) + _FLAT * side.max(axis=1) * (side.sum(axis=1) ** 2 - (side**2).sum(axis=1))
        corner = 0.5 * (low + high)[:, None] + 0.5 * side[:, None] * _CORNERS
        smaller = size < least
        least[smaller] = size[smaller]
        best[smaller] = (middle[:, None] + np.einsum("pcj,pij->pci", corner, turned))[smaller]
    # Single vertices without a face are left out.
    return best[np.bincount(part) > 1]


def connected(surface: Surface) -> tuple[Floats, NDArray[np.integer], NDArray[np.integer]]:
    """Return (unique vertices (V, 3), faces (F, 3), connected part of each vertex (V,)); edges of the texture
    connect."""
    return _connected(np.asarray(surface.vertices, np.float64), surface.faces)


def _connected(vertices: Floats, faces: NDArray[np.integer]) -> tuple[Floats, NDArray[np.integer], NDArray[np.integer]]:
    """As `connected`, of vertices of any dimension."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    # As np.unique of rows, in a third of the time.
    order = np.lexsort(vertices.T[::-1])
    vertices, index = vertices[order], np.empty(len(order), np.int64)
    first = np.concatenate([[True], (vertices[1:] != vertices[:-1]).any(axis=1)])
    index[order] = np.cumsum(first) - 1
    vertices, faces = vertices[first], index[faces]
    sides = np.concatenate([faces[:, :2], faces[:, 1:]]).T
    links = coo_array((np.ones(sides.shape[1], np.int8), sides), shape=(len(vertices),) * 2)
    return vertices, faces, connected_components(links, directed=False)[1]


def rectangles(parts: Sequence[tuple[Floats, Floats]], pose: Floats, camera: Camera) -> Rectangles:
    """Return the Rectangles of pixels that may show parts thinner than 1.5 pixels; `parts` are (boxes (n, 8, 3), pose
    (4, 4))."""
    still = np.eye(4)
    placed = [corners if np.array_equal(own, still) else corners @ own[:3, :3].T + own[:3, 3] for corners, own in parts]
    corners = placed[0] if len(placed) == 1 else np.concatenate(placed)
    local = (corners - pose[:3, 3]) @ pose[:3, :3]
    before = (local[..., 2] > _NEAR).all(axis=1)
    image = camera.project(local if before.all() else local[before])
    size = np.array([camera.width, camera.height])
    # By corner: reductions over a short axis are slow.
    low, high = (reduce(choose, np.moveaxis(image, 1, 0)) for choose in (np.minimum, np.maximum))
    seen = ((high > 0.0) & (low < size)).all(axis=1)
    image, low, high = image[seen], low[seen], high[seen]
    middle = image.mean(axis=1)
    offset = image - middle[:, None]
    axes = np.linalg.eigh(np.einsum("pci,pcj->pij", offset, offset))[1]
    across = np.abs(np.einsum("pci,pi->pc", offset, axes[..., 0])).max(axis=1)
    thin = 2.0 * across < _WIDE
    return _cut(middle[thin], axes[thin, :, 1], across[thin], low[thin], high[thin], size)


def _cut(
    middle: Floats, direction: Floats, across: Floats, lowest: Floats, highest: Floats, size: NDArray[np.integer]
) -> Rectangles:
    """The Rectangles of bands: `middle`, unit `direction`, half the width (n,), and bounding rectangle [px]."""
    number = np.arange(len(middle))
    # Bands are cut into lines of pixels along the closer axis, then each piece into pixels.
    main = np.argmax(np.abs(direction), axis=1)
    other = 1 - main
    slope = direction[number, other] / direction[number, main]
    steep = 1.0 / np.abs(direction[number, main])
    start, stop = lowest[number, main], highest[number, main]
    first = np.maximum(np.floor(start), 0.0)
    lines = np.clip(np.minimum(np.floor(stop), size[main] - 1) - first + 1, 0, None).astype(int)
    band, line = _ragged(lines)
    line = first[band] + line
    low, high = np.maximum(start[band], line), np.minimum(stop[band], line + 1)
    ends = [middle[band, other[band]] + (at - middle[band, main[band]]) * slope[band] for at in (low, high)]
    width = across[band] * steep[band]
    left = np.maximum(np.minimum(*ends) - width, lowest[band, other[band]])
    right = np.minimum(np.maximum(*ends) + width, highest[band, other[band]])
    begin = np.maximum(np.floor(left), 0.0)
    cells = np.clip(np.minimum(np.floor(right), size[other[band]] - 1) - begin + 1, 0, None).astype(int)
    piece, cell = _ragged(cells)
    cell = begin[piece] + cell
    (where, upper, lower), row = np.empty((3, len(piece), 2)), np.arange(len(piece))
    in_line = line[piece], low[piece], high[piece]
    in_cell = cell, np.maximum(left[piece], cell), np.minimum(right[piece], cell + 1)
    for axis, (at, least, most) in ((main, in_line), (other, in_cell)):
        column = axis[band[piece]]
        where[row, column], upper[row, column], lower[row, column] = at, least - at, most - at
    flat = (where[:, 1] * size[0] + where[:, 0]).astype(np.int64)
    pixels, index = np.unique(flat, return_inverse=True)
    corner, far = np.ones((len(pixels), 2)), np.zeros((len(pixels), 2))
    np.minimum.at(corner, index.reshape(-1), upper)
    np.maximum.at(far, index.reshape(-1), lower)
    whole = (far - corner).prod(axis=1) > _WHOLE
    corner[whole], far[whole] = 0.0, 1.0
    return Rectangles(pixels, corner, far - corner)


def _ragged(counts: NDArray[np.integer]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(row, number within it) of the entries of rows with `counts` entries."""
    row = np.repeat(np.arange(len(counts)), counts)
    return row, np.arange(len(row)) - np.repeat(np.cumsum(counts) - counts, counts)
