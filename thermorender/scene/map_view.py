"""A terrain as a map shows it, from straight above: the cell of the map that shows each texel.

A raster terrain is its own map. On a mesh, roofs hide the ground below them; walls, which are upright, and leaves, each
of which has a single texel, are on no map.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.scene.georeference import Place
from thermorender.scene.ground import weights_in_plan
from thermorender.scene.raster import Grid
from thermorender.scene.surface import Surface
from thermorender.scene.textures import Texture, separate

# Steeper faces, by the upward share of their normal, are walls.
_UPRIGHT = 0.1
# A texture is drawn on a map if this share of its corners is so near to their places on it [texels].
_ALIGNED = 0.25
_MOST = 0.95
# A point so far below the highest face may still be on it: faces are compared at the middles of cells [m].
_BELOW_M = 0.3
# Texels beyond the edge of what is seen, whose middle no face shows, are seen too within this distance [texels].
_RIM = 1.5
# A map that no texture gives has at most this many cells along a side.
_MOST_CELLS = 4096
# Points of faces that are compared at once, and vertices that a fit takes.
_AT_ONCE, _FITTED = 2_000_000, 20_000
# Distance of the posts that stand for a mesh as a surface model [m].
_POST_M = 0.5

_Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class MapView:
    """The texels of a terrain's surfaces on the cells of a map."""

    grid: Grid  # (H, W) cells
    # Of each surface: (h, w) int32 flat index of the cell that shows each texel; −1 for none
    cells: tuple[NDArray[np.int32], ...]
    # Of a mesh: (H, W) local height of the highest face over the middle of each cell [m]; NaN for none
    top: _Floats | None = None

    def heights(self, cell_m: float) -> tuple[_Floats, Grid]:
        """Return (local heights [m] of a mesh's highest faces, their Grid) for cells of `cell_m` [m].

        Posts are cells `_POST_M` apart, or all of them where they are wider.
        """
        from rasterio import Affine

        assert self.top is not None
        step = max(1, round(_POST_M / cell_m))
        height = self.top[::step, ::step]
        # The middle of a post is that of its cell.
        t, off = self.grid.transform, 0.5 - 0.5 * step
        transform = Affine(
            step * t.a, step * t.b, t.c + off * (t.a + t.b), step * t.d, step * t.e, t.f + off * (t.d + t.e)
        )
        return height, Grid(self.grid.crs, transform, height.shape[0], height.shape[1], self.grid.name)

    def seen(self, number: int) -> NDArray[np.bool_]:
        """Return which texels of a surface the map shows, (h, w) bool."""
        found: NDArray[np.bool_] = self.cells[number] >= 0
        return found

    def onto(self, number: int, values: NDArray[Any]) -> NDArray[Any]:
        """Return values of the cells, (H, W), at the texels of a surface, (h, w); 0 where the map does not show one."""
        return np.where(self.seen(number), values.ravel()[self.cells[number]], values.dtype.type(0))

    def texels(self, cells: NDArray[np.bool_]) -> NDArray[np.int64]:
        """Return the numbers, over all surfaces, of the texels that some cells (H, W) show, (n,) ascending."""
        found = [self.onto(number, cells).ravel() for number in range(len(self.cells))]
        return np.flatnonzero(np.concatenate(found))


def of_raster(grid: Grid) -> MapView:
    """Return the MapView of a raster terrain, whose texels are the cells."""
    cells = np.arange(grid.height * grid.width, dtype=np.int32).reshape(grid.height, grid.width)
    return MapView(grid, (cells,))


def of_mesh(ground: Sequence[Surface], textures: Sequence[Texture], place: Place) -> MapView | None:
    """Return the MapView of a mesh's surfaces at a place; None where all of them are walls or leaves.

    The map is that of the largest texture that is drawn on one, as those of ground and roofs of an imported surface
    model; else it is north up, with the finest texels of the mesh.
    """
    shown = {k: _Shown.of(surface, place) for k, surface in enumerate(ground) if not separate(surface)}
    shown = {k: each for k, each in shown.items() if len(each.face)}
    if not shown:
        return None
    fits = {k: _map_of(ground[k], each, place) for k, each in shown.items() if textures[k].size}
    fitted = [k for k, grid in fits.items() if grid is not None]
    size = {k: each.area for k, each in shown.items()}
    best = fits[max(fitted, key=size.__getitem__)] if fitted else None
    grid = best if best is not None else _north_up(ground, shown, place)
    pixel = {k: np.stack(grid.to_pixel(*np.moveaxis(each.place, -1, 0)), axis=-1) for k, each in shown.items()}
    order = list(shown)
    corner = np.concatenate([pixel[k] for k in order])
    up = np.concatenate([shown[k].up for k in order])
    owner = np.repeat(order, [len(shown[k].face) for k in order])
    top, level = _highest(corner, up, (grid.height, grid.width))
    cells = []
    for number, surface in enumerate(ground):
        if number not in shown:
            cells.append(np.full(surface.flags.shape, -1, np.int32))
        elif (own := fits.get(number)) is not None:
            cell = _between(own, grid)
            seen = (cell >= 0) & (owner[top.ravel()[cell]] == number) & (top.ravel()[cell] >= 0)
            cells.append(_rimmed(cell, seen))
        else:
            cells.append(_rimmed(*_cells_of(surface, shown[number], pixel[number], top, corner, up)))
    return MapView(grid, tuple(cells), np.where(top < 0, np.nan, level))


@dataclass(frozen=True, eq=False)
class _Shown:
    """Faces of a surface that are not upright."""

    face: NDArray[np.int64]  # (n,) their numbers
    place: _Floats  # (n, 3, 2) map coordinates (x, y) of their corners
    up: _Floats  # (n, 3) local heights of their corners [m]
    area: float  # of their plan [m²]

    @classmethod
    def of(cls, surface: Surface, place: Place) -> "_Shown":
        """Return the faces of a surface that are not upright."""
        corner = surface.vertices[surface.faces]
        across = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        face = np.flatnonzero(np.abs(across[:, 2]) > _UPRIGHT * np.linalg.norm(across, axis=1))
        used, index = np.unique(surface.faces[face], return_inverse=True)
        xy = np.stack(place.to_map(surface.vertices[used]), axis=-1) if len(used) else np.empty((0, 2))
        index = index.reshape(-1, 3)
        return cls(face, xy[index], surface.vertices[:, 2][used][index], 0.5 * float(np.abs(across[face, 2]).sum()))


def _map_of(surface: Surface, shown: _Shown, place: Place) -> Grid | None:
    """The Grid of a surface's texels where its texture is drawn on a map; None for another texture."""
    from rasterio import Affine

    rows, columns = surface.flags.shape
    step = max(1, len(shown.face) // _FITTED)
    texel = (surface.uv[shown.face[::step]] * (columns, rows)).reshape(-1, 2).astype(np.float64)
    xy = shown.place[::step].reshape(-1, 2)
    # Coordinates of maps have many digits before those that count.
    middle = xy.mean(axis=0)
    known, kept = np.column_stack([texel, np.ones(len(texel))]), np.ones(len(texel), bool)
    # Corners at the edge of a texture may be moved to it, or repeat it.
    for _ in range(3):
        fit = np.linalg.lstsq(known[kept], (xy - middle)[kept], rcond=None)[0]
        if abs(np.linalg.det(fit[:2])) < 1e-12:
            return None
        off = np.abs((known @ fit - (xy - middle)) @ np.linalg.inv(fit[:2])).max(axis=1)
        kept = off <= np.quantile(off, _MOST)
    if not off[kept].max() < _ALIGNED:
        return None
    (a, d), (b, e), (c, f) = fit
    transform = Affine(a, b, c + middle[0], d, e, f + middle[1])
    return Grid(place.crs, transform, rows, columns, "the scene's map")


def _north_up(ground: Sequence[Surface], shown: dict[int, _Shown], place: Place) -> Grid:
    """A Grid, north up, around all faces, with the finest texels of their surfaces."""
    from rasterio import Affine

    every = np.concatenate([each.place.reshape(-1, 2) for each in shown.values()])
    low, high = every.min(axis=0), every.max(axis=0)
    across, along = place.pixel_size(min(ground[k].texel_m for k in shown))
    wider = max(1.0, *((high - low) / (across, along) / _MOST_CELLS))
    across, along = wider * across, wider * along
    columns, rows = (max(1, int(np.ceil(n - 1e-6))) for n in (high - low) / (across, along))
    return Grid(place.crs, Affine(across, 0.0, low[0], 0.0, -along, high[1]), rows, columns, "the scene's map")


def _highest(corner: _Floats, up: _Floats, shape: tuple[int, int]) -> tuple[NDArray[np.int64], _Floats]:
    """(number of the highest face over the middle of each cell, its height there), (H, W) each; (−1, −∞) for none.

    `corner` (n, 3, 2) are (column, row) of the faces' corners, `up` (n, 3) their heights.
    """
    limit = np.array(shape[::-1])
    first = np.clip(np.ceil(corner.min(axis=1) - 0.5 - 1e-6), 0, limit).astype(np.int64)
    span = np.clip(np.floor(corner.max(axis=1) - 0.5 + 1e-6) + 1, 0, limit).astype(np.int64) - first
    count = np.maximum(span, 0).prod(axis=1)
    top, height = np.full(shape, -1), np.full(shape, -np.inf)
    ends = np.cumsum(count)
    start = 0
    while start < len(corner):
        before = ends[start] - count[start]
        stop = max(start + 1, int(np.searchsorted(ends, before + _AT_ONCE, "right")))
        own = np.repeat(np.arange(start, stop), count[start:stop])
        offset = np.arange(len(own)) - np.repeat(ends[start:stop] - count[start:stop] - before, count[start:stop])
        column = first[own, 0] + offset % np.maximum(span[own, 0], 1)
        row = first[own, 1] + offset // np.maximum(span[own, 0], 1)
        weight = _weights(corner[own], np.column_stack([column, row]) + 0.5)
        inside = (weight > -1e-6).all(axis=1)
        own, column, row, weight = own[inside], column[inside], row[inside], weight[inside]
        level = (weight * up[own]).sum(axis=1)
        higher = level > height[row, column]
        # Of several assignments to a cell the last one stays.
        order = np.flatnonzero(higher)[np.argsort(level[higher], kind="stable")]
        top[row[order], column[order]], height[row[order], column[order]] = own[order], level[order]
        start = stop
    return top, height


def _weights(corner: _Floats, point: NDArray[Any]) -> _Floats:
    """Barycentric weights (n, 3) of points (n, 2) in triangles (n, 3, 2); not finite in one without area."""
    v, w = weights_in_plan(corner, point)
    with np.errstate(invalid="ignore"):
        return np.stack([1.0 - v - w, v, w], axis=-1)


def _between(texels: Grid, grid: Grid) -> NDArray[np.int32]:
    """The flat index of the cell of a grid below the middle of each texel of another one, (h, w); −1 off the grid."""
    x, y = texels.to_map(np.arange(texels.width) + 0.5, np.arange(texels.height)[:, None] + 0.5)
    column, row = (np.floor(each).astype(np.int32) for each in grid.to_pixel(x, y))
    within = (column >= 0) & (column < grid.width) & (row >= 0) & (row < grid.height)
    return np.where(within, row * grid.width + column, -1).astype(np.int32)


def _cells_of(
    surface: Surface, shown: _Shown, pixel: _Floats, top: NDArray[np.int64], corner: _Floats, up: _Floats
) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
    """(cell, whether it shows the texel) of each texel (h, w) of a surface whose texture is not the map's."""
    shape = surface.flags.shape
    uv = (surface.uv[shown.face] * shape[::-1]).astype(np.float64)
    face, _ = _highest(uv, shown.up, shape)
    row, column = np.nonzero(face >= 0)
    own = face[row, column]
    weight = _weights(uv[own], np.column_stack([column, row]) + 0.5)
    point = (weight[..., None] * pixel[own]).sum(axis=1)
    level = (weight * shown.up[own]).sum(axis=1)
    at = np.floor(point).astype(np.int64)
    within = ((at >= 0) & (at < np.array(top.shape[::-1]))).all(axis=1)
    at = np.where(within[:, None], at, 0)
    above = top[at[:, 1], at[:, 0]]
    highest = (_weights(corner[above], point) * up[above]).sum(axis=1)
    cell, seen = np.full(shape, -1, np.int32), np.zeros(shape, bool)
    cell[row, column] = at[:, 1] * top.shape[1] + at[:, 0]
    seen[row, column] = within & (above >= 0) & (level > highest - _BELOW_M)
    return cell, seen


def _rimmed(cell: NDArray[np.int32], seen: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Cells (h, w) of texels that are seen, −1 for others; those beside one have its cell."""
    from scipy.ndimage import distance_transform_edt

    if not seen.any():
        return np.full(cell.shape, -1, np.int32)
    away, (row, column) = distance_transform_edt(~seen, return_indices=True)
    return np.where(away < _RIM, cell[row, column], np.int32(-1))
