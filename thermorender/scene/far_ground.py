"""Coarser ground around a scene: a mesh of a raster's posts with a hole where finer ground lies, joined to its rim.

Rays are straight, and in reality air bends them: over a sphere of radius R/0.87 straight rays meet the ground where
bent ones meet that of radius R (`atmosphere.rays`). Far ground is thus raised by the difference, 0.8 m at 9 km.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermorender.atmosphere.rays import EARTH_RADIUS_M, MEAN_RADIUS_M
from thermorender.errors import ThermorenderError
from thermorender.physics.geodesy import LocalFrame
from thermorender.scene.georeference import Place
from thermorender.scene.ground import Ground
from thermorender.scene.raster import Grid, lon_lat
from thermorender.scene.seam import with_sides
from thermorender.scene.surface import MOST_OPEN, Surface, fill, nearest_valid
from thermorender.scene.terrain import triangles, whole_cells
from thermorender.scene.textures import separate

_Floats = NDArray[np.float64]
# The ground of a mesh is found on a lattice of so many posts along its longer side.
_LATTICE = 512
# Posts of far ground may be closer than those of the ground inside by this ratio.
_CLOSER = 0.75
# Points between rim and posts of far ground are up to this many times their spacing from the rim; posts of the rim
# whose heights such a point follows.
_FARTHEST, _FARTHEST_STEPS, _AVERAGED = 2.5, 4, 64


class NothingOutside(ThermorenderError):
    """Far ground lies nowhere outside of the ground inside."""


@dataclass(frozen=True, eq=False)
class GroundPlan:
    """Where ground lies: cells between the posts of a lattice."""

    posts: _Floats  # (r, c, 3) local positions [m]
    cells: NDArray[np.bool_]  # (r - 1, c - 1) cells with ground
    lattice: Callable[[_Floats], _Floats]  # (column, row) (n, 2) of local positions (n, 3); posts have whole numbers

    def rim(self) -> tuple[_Floats, NDArray[np.integer]]:
        """Return (posts between cells with and without ground, (n, 3) [m]; the two of each side of such a cell, (m,
        2))."""
        inside = np.pad(self.cells, 1)
        number = np.arange(self.posts[..., 0].size).reshape(self.posts.shape[:2])
        along, across = inside[:-1, 1:-1] != inside[1:, 1:-1], inside[1:-1, :-1] != inside[1:-1, 1:]
        sides = np.concatenate([
            np.stack([number[:, :-1][along], number[:, 1:][along]], axis=-1),
            np.stack([number[:-1][across], number[1:][across]], axis=-1),
        ])  # fmt: skip
        used, index = np.unique(sides, return_inverse=True)
        return self.posts.reshape(-1, 3)[used], index.reshape(-1, 2)

    def covers(self, points: _Floats) -> NDArray[np.bool_]:
        """Return whether local positions (n, 3) are above or below its ground, (n,)."""
        at = np.floor(self.lattice(points)).astype(np.int64)
        rows, columns = self.cells.shape
        within = (at >= 0).all(axis=1) & (at[:, 0] < columns) & (at[:, 1] < rows)
        at = np.where(within[:, None], at, 0)
        found: NDArray[np.bool_] = within & self.cells[at[:, 1], at[:, 0]]
        return found

    def spacing_m(self) -> float:
        """Return the median distance of posts along a row or column [m]."""
        steps = [np.linalg.norm(np.diff(self.posts[..., :2], axis=axis), axis=-1) for axis in (0, 1)]
        return float(max(np.nanmedian(step) for step in steps))


def of_raster(vertices: _Floats, height: _Floats, grid: Grid, frame: LocalFrame) -> GroundPlan:
    """Return the GroundPlan of a raster's mesh: `vertices` (h w, 3) of heights (h, w), NaN where missing."""
    known = np.isfinite(height)
    cells = whole_cells(known)
    return GroundPlan(vertices.reshape(*height.shape, 3), cells, _on_grid(grid, frame))


def of_mesh(surfaces: Sequence[Surface]) -> GroundPlan:
    """Return the GroundPlan of a mesh's ground, the lowest of surfaces at each post; leaves have none."""
    ground = [surface for surface in surfaces if not separate(surface)] or list(surfaces)
    every = np.concatenate([surface.vertices[:, :2] for surface in ground])
    low, high = every.min(axis=0), every.max(axis=0)
    step = float((high - low).max()) / (_LATTICE - 1)
    columns, rows = np.maximum(np.floor((high - low) / step + 1e-6).astype(int) + 1, 2)
    east, north = np.meshgrid(low[0] + step * np.arange(columns), low[1] + step * np.arange(rows))
    up = np.fmin.reduce([Ground([surface])(east, north) for surface in ground])
    known = np.isfinite(up)
    cells = whole_cells(known)
    return GroundPlan(np.stack([east, north, up], axis=-1), cells, lambda points: (points[:, :2] - low) / step)


def _on_grid(grid: Grid, frame: LocalFrame) -> Callable[[_Floats], _Floats]:
    """A function of local positions (n, 3) that returns their (column, row) between a grid's pixel middles, (n, 2)."""
    place = Place(frame, grid.crs)

    def lattice(points: _Floats) -> _Floats:
        return np.stack(grid.to_pixel(*place.to_map(points)), axis=-1) - 0.5

    return lattice


def raised_m(east: _Floats, north: _Floats) -> _Floats:
    """Return the height by which refraction shows ground above its place, as seen from around the origin [m]."""
    return (0.5 / MEAN_RADIUS_M - 0.5 / EARTH_RADIUS_M) * (np.square(east) + np.square(north))


def far_mesh(
    height: _Floats, grid: Grid, frame: LocalFrame, texels: Grid, inside: GroundPlan, extend: bool = True
) -> tuple[tuple[_Floats, NDArray[np.int32], NDArray[np.float32]], GroundPlan]:
    """Return ((vertices (V, 3) [m], faces (F, 3), uv (F, 3, 2)), GroundPlan) of heights (h, w) around other ground.

    Cells that meet the ground `inside` are left out. The Delaunay triangulation of the posts around them, of the posts
    of its rim, and of points between them closes the gap. Posts there without a height have that of the nearest one,
    or leave the gap open if they are not to `extend` the ground.
    """
    rows, columns = height.shape
    column, row = np.meshgrid(np.arange(columns), np.arange(rows))
    x, y = grid.to_map(column + 0.5, row + 0.5)
    longitude, latitude = lon_lat(grid, x.ravel(), y.ravel())
    known = np.isfinite(height)
    level = fill(height, nearest_valid(known))
    posts = frame.enu_from_geodetic(latitude, longitude, level.ravel())
    posts[:, 2] += raised_m(posts[:, 0], posts[:, 1])
    lattice, (rim, sides) = _on_grid(grid, frame), inside.rim()
    at = lattice(rim)
    _refuse_outside(at, rows, columns, grid)
    clear, hole = _hole(at, posts.reshape(rows, columns, 3), inside)
    edge = clear & _any_cell(hole)
    kept = ~hole & ~_any_corner(~(known | edge) if extend else ~known)
    index = np.flatnonzero(edge)
    outer = np.stack([column, row], axis=-1).reshape(-1, 2)[index].astype(np.float64)
    added, places = _between(posts.reshape(rows, columns, 3), rim, at, outer, hole, inside)
    points, positions = np.concatenate([at, outer, added]), np.concatenate([rim, posts[index], places])
    joined, ends = with_sides(points, sides)
    for one, other in ends:
        points = np.concatenate([points, 0.5 * (points[[one]] + points[[other]])])
        positions = np.concatenate([positions, 0.5 * (positions[[one]] + positions[[other]])])
    middle = points[joined].mean(axis=1)
    there = np.clip(np.floor(middle).astype(np.int64), 0, (columns - 2, rows - 2))
    closed = hole if extend else hole & ~_any_corner(~known)
    joined = joined[closed[there[:, 1], there[:, 0]] & ~inside.covers(positions[joined].mean(axis=1))]
    number = rows * columns + np.arange(len(points))
    number[len(at) : len(at) + len(index)] = index
    faces = np.concatenate([triangles(kept), number[joined]])
    vertices = np.concatenate([posts, positions])
    at_texel = np.concatenate([
        np.stack(texels.to_pixel(x, y), axis=-1).reshape(-1, 2),
        np.stack(texels.to_pixel(*grid.to_map(*(points.T + 0.5))), axis=-1),
    ])  # fmt: skip
    corner = vertices[faces][..., :2]
    u, v = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    area = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
    faces = np.where((area < 0.0)[:, None], faces[:, ::-1], faces)[np.abs(area) > 1e-9]
    if not len(faces):
        raise NothingOutside(f"{grid.name} has no ground outside of the scene; give a raster of a larger area")
    used, faces = np.unique(faces, return_inverse=True)
    faces = faces.reshape(-1, 3).astype(np.int32)
    uv = at_texel[used] / (texels.width, texels.height)
    _refuse_bare(uv, texels, grid)
    uv = np.clip(uv, 0.0, 1.0)
    plan = GroundPlan(posts.reshape(rows, columns, 3), kept | hole, lattice)
    return (vertices[used], faces, uv[faces].astype(np.float32)), plan


def _refuse_outside(at: _Floats, rows: int, columns: int, grid: Grid) -> None:
    """Refuse far ground that does not lie all around the ground inside, whose rim is at (column, row) (n, 2)."""
    outside = ((at < 0.0) | (at > (columns - 1, rows - 1))).any(axis=1)
    if outside.any():
        raise ThermorenderError(
            f"{grid.name} does not surround the ground inside of it: {outside.mean():.0%} of that one's edge is beyond "
            "its outer posts; give a wider raster, and several of them from the inner to the outer one"
        )


def _refuse_bare(uv: _Floats, texels: Grid, grid: Grid) -> None:
    """Refuse colours or classes that do not cover far ground, whose vertices are at `uv` (V, 2) on their grid."""
    over = 1.0 / np.array([texels.width, texels.height])
    bare = float(((uv < -over) | (uv > 1.0 + over)).any(axis=1).mean())
    if bare > MOST_OPEN:
        raise ThermorenderError(
            f"{texels.name} covers {1.0 - bare:.0%} of the ground of {grid.name} that lies around the scene; give one "
            "that covers it, or cut the heights to it"
        )


def _hole(at: _Floats, posts: _Floats, inside: GroundPlan) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """(posts (r, c) away from the ground inside, cells (r - 1, c - 1) with another post); the rim is at (column, row)
    (n, 2)."""
    rows, columns = posts.shape[:2]
    cell = np.minimum(at.astype(np.int64), (columns - 2, rows - 2))
    blocked = np.zeros((rows - 1, columns - 1), bool)
    blocked[cell[:, 1], cell[:, 0]] = True
    first, last = cell.min(axis=0), cell.max(axis=0) + 1
    part = slice(first[1], last[1] + 1), slice(first[0], last[0] + 1)
    hidden, some = np.zeros((rows, columns), bool), posts[part]
    hidden[part] = inside.covers(some.reshape(-1, 3)).reshape(some.shape[:2])
    clear = ~_any_cell(blocked | _any_corner(hidden))
    return clear, _any_corner(~clear)


def _between(
    posts: _Floats, rim: _Floats, at: _Floats, outer: _Floats, hole: NDArray[np.bool_], inside: GroundPlan
) -> tuple[_Floats, _Floats]:
    """((column, row) (n, 2), local positions (n, 3) [m]) of points between a rim (n, 3) at `at` (n, 2) and the posts
    `outer` (n, 2) around the hole.

    Their distance grows with that from the rim. Their heights lead from those of the rim to those of `posts` (r, c, 3).
    """
    from scipy.ndimage import map_coordinates
    from scipy.spatial import KDTree

    def on_posts(points: _Floats) -> _Floats:
        return np.stack([map_coordinates(each, points[:, ::-1].T, order=1, mode="nearest")
                         for each in np.moveaxis(posts, -1, 0)], axis=-1)  # fmt: skip

    edge, around, found = KDTree(at), KDTree(outer if len(outer) else at), [np.zeros((0, 2))]
    side, step = float(np.median(edge.query(at, k=2)[0][:, 1])), 0.5
    steps = np.arange(-_FARTHEST_STEPS, _FARTHEST_STEPS + 1)
    near = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    while step > side:
        # Squares of a level around those that the rim passes.
        square = np.unique(np.floor(at / step).astype(np.int64), axis=0)
        square = np.unique((square[:, None] + near).reshape(-1, 2), axis=0)
        points = (square + 0.5) * step
        cell = np.floor(points).astype(np.int64)
        within = ((cell >= 0) & (cell < hole.shape[::-1])).all(axis=1)
        points, cell = points[within], cell[within]
        points = points[hole[cell[:, 1], cell[:, 0]]]
        away = edge.query(points)[0]
        points = points[(away > step) & (away <= _FARTHEST * step)]
        # Closer ones would be in the circle around a side of the hole, which is then no edge.
        found.append(points[around.query(points)[0] > np.sqrt(0.5)] if len(outer) else points)
        step *= 0.5
    chosen = np.concatenate(found)
    places = on_posts(chosen)
    outside = ~inside.covers(places)
    chosen, places = chosen[outside], places[outside]
    off = rim[:, 2] - on_posts(at)[:, 2]
    away, nearest = edge.query(chosen, k=np.arange(1, min(_AVERAGED, len(at)) + 1))
    # Towards the rim its own heights, farther out their mean around.
    weight = 1.0 / (away + 1e-3 * side) ** 2
    mean = (weight * off[nearest]).sum(axis=1) / weight.sum(axis=1)
    places[:, 2] += mean * np.maximum(1.0 - away[:, 0], 0.0)
    return chosen, places


def _any_corner(of_posts: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Whether a cell has such a post, (r - 1, c - 1)."""
    found: NDArray[np.bool_] = of_posts[1:, 1:] | of_posts[1:, :-1] | of_posts[:-1, 1:] | of_posts[:-1, :-1]
    return found


def _any_cell(of_cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Whether a post is at such a cell, (r, c)."""
    return _any_corner(np.pad(of_cells, 1))


def refuse_finer(grid: Grid, spacing_m: float, inside: GroundPlan) -> None:
    """Refuse far ground whose posts are closer than those of the ground inside."""
    finest = inside.spacing_m()
    if spacing_m < _CLOSER * finest:
        raise ThermorenderError(
            f"{grid.name} has posts {spacing_m:.3g} m apart, and the ground inside of it {finest:.3g} m; give the "
            "finer raster as the scene's ground, or thin this one, for example with `rio warp --res`"
        )
