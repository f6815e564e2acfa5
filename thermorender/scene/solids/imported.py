"""Skins of a user's surface model: ground, roofs as the model has them, walls below their edges, and porous trees.

Walls, trunks and the places of leaves are inferred: no survey from above sees them.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.materials.material import Material
from thermorender.physics.geodesy import LocalFrame
from thermorender.physics.srgb import linear_from_bytes
from thermorender.scene import terrain
from thermorender.scene.raster import Grid, lon_lat
from thermorender.scene.solids import found
from thermorender.scene.solids.facades import DOOR, GLASS, facade
from thermorender.scene.solids.plants import DENSITY, Plants, edge_of
from thermorender.scene.solids.quads import Quads
from thermorender.scene.solids.skin import Skin
from thermorender.scene.surface import fill, nearest_valid

GROUND, ROOFS, WALLS, PLANTS = "ground", "roofs", "walls", "plants"
INFERRED = (WALLS, PLANTS)
# Material of roofs where no orthophoto says more, and of leaves and trunks.
ROOF, LEAVES, BARK = "roof_tile_clay", "broadleaf", "bark"
_TEXEL_M, _EDGE_M, _BELOW_M = 0.3, 2.0, 0.5
# Roofs are those of posts this far inside the outline; nearer ones are mixed with the street [posts].
_WITHIN = 0.8
# Triangles of roofs are larger than this in the plan, in squares of posts.
_LEAST_PLAN = 0.02
_LEAF_COLOUR, _BARK_COLOUR = (72, 96, 48), (104, 88, 72)


@dataclass(frozen=True, eq=False)
class Imported:
    """Skins with their class names, and what was found."""

    skins: tuple[Skin, ...]
    classes: dict[int, str]
    frame: LocalFrame
    buildings: int
    flat_outlines: int  # outlines without a post of a roof inside, left out
    trees: int


class _Local:
    """Local coordinates of positions on the posts' grid."""

    def __init__(self, grid: Grid, frame: LocalFrame) -> None:
        self.grid, self.frame = grid, frame

    def __call__(self, column: Any, row: Any, height: Any) -> NDArray[np.float64]:
        """Return points (n, 3) of columns and rows at heights above the ellipsoid."""
        x, y = self.grid.to_map(np.asarray(column, np.float64), np.asarray(row, np.float64))
        longitude, latitude = lon_lat(self.grid, np.ravel(x), np.ravel(y))
        level = np.broadcast_to(np.asarray(height, np.float64), longitude.shape)
        place: NDArray[np.float64] = self.frame.enu_from_geodetic(latitude, longitude, level)
        return place


def imported(
    height: NDArray[np.float64], grid: Grid, post_m: float, ground: NDArray[np.float64] | None, known: Path | None,
    picture: tuple[NDArray[np.uint8], NDArray[np.bool_], Grid] | None, ground_colour: Sequence[int],
    wall: str, library: Mapping[str, Material], seed: int = 0,
) -> Imported:  # fmt: skip
    """Return the Imported world of a surface model.

    Parameters
    ----------
    height : (h, w) float64
        Surface model [m above the ellipsoid], NaN where missing.
    grid : Grid
    post_m : float
        Distance of posts [m].
    ground : (h, w) float64, optional
        Terrain model on the same grid; found by a filter otherwise.
    known : path, optional
        GeoJSON with outlines of buildings; found by height otherwise.
    picture : (rgb, valid, Grid), optional
        Orthophoto.
    ground_colour : (3,)
        sRGB of the ground without an orthophoto.
    wall : str
        Material of the walls, one for all.
    library : dict of str to Material
        For colours of walls and roofs.
    seed : int
        Of the leaves.
    """
    bare = found.ground_below(height, post_m) if ground is None else found.ground_given(ground, height, post_m)
    outlines = found.outlines_in(known, grid) if known else found.outlines_by_height(height, bare, post_m)
    body = found.inside(outlines, grid)
    frame = terrain.frame_of(bare, grid)
    at, draw = _Local(grid, frame), np.random.default_rng(seed)
    texels = picture[2] if picture else grid
    names = {1: wall, 2: GLASS, 3: DOOR, 4: LEAVES, 5: BARK}
    number = {name: value for value, name in reversed(names.items())}
    tree_cells = _dilated(body, max(1, round(1.0 / post_m)))
    trees = found.trees_in(height - bare, tree_cells, post_m)
    covered = np.isfinite(height) & (height - bare > found.LEAST_M)
    skins = [_ground(bare, grid, frame, texels, picture, covered, ground_colour)]
    roofs, quads, flat = _Roofs(grid, texels), Quads(_TEXEL_M, _EDGE_M), 0
    tint = linear_from_bytes(np.array(library[wall].colour, np.uint8))
    for rings in outlines:
        paint = {"value": number.__getitem__, "draw": draw, "material": wall,
                 "colour": tint * np.exp(draw.normal(0.0, 0.12))}  # fmt: skip
        flat += not _building(rings, height, bare, at, roofs, quads, paint, post_m)
    if roofs.faces:
        skins.append(roofs.skin(picture, library[ROOF].colour))
        skins.append(quads.skin(WALLS))
    if trees:
        skins.append(_plants(trees, height, bare, at, draw, post_m, number, _colours(picture, grid)))
    return Imported(tuple(skins), names, frame, len(outlines) - flat, flat, len(trees))


def _dilated(mask: NDArray[np.bool_], posts: int) -> NDArray[np.bool_]:
    from scipy.ndimage import binary_dilation

    grown: NDArray[np.bool_] = binary_dilation(mask, np.ones((3, 3)), iterations=posts)
    return grown


def _colours(
    picture: tuple[NDArray[np.uint8], NDArray[np.bool_], Grid] | None, grid: Grid
) -> Callable[[NDArray[np.int64]], NDArray[np.float32]]:
    """A function of posts (n, 2) that returns the linear colour of their crowns, (n, 3)."""
    if picture is None:
        green = linear_from_bytes(np.array(_LEAF_COLOUR, np.uint8))
        return lambda posts: np.broadcast_to(green, (len(posts), 3))
    rgb, _, texels = picture
    light = linear_from_bytes(rgb)

    def at(posts: NDArray[np.int64]) -> NDArray[np.float32]:
        column, row = texels.to_pixel(*grid.to_map(posts[:, 1] + 0.5, posts[:, 0] + 0.5))
        inside = [np.clip(np.floor(v).astype(int), 0, n - 1) for v, n in ((row, len(rgb)), (column, rgb.shape[1]))]
        return light[inside[0], inside[1]]

    return at


def _ground(
    bare: NDArray[np.float64], grid: Grid, frame: LocalFrame, texels: Grid,
    picture: tuple[NDArray[np.uint8], NDArray[np.bool_], Grid] | None, covered: NDArray[np.bool_],
    plain: Sequence[int],
) -> Skin:  # fmt: skip
    """The terrain below all objects; what they hide has the colour of the nearest open ground."""
    from thermorender.scene.raster import onto

    vertices, faces, uv = terrain.mesh(bare, grid, frame, texels)
    shape = texels.height, texels.width
    colour = np.broadcast_to(np.array(plain, np.uint8), (*shape, 3))
    if picture is not None:
        open_ground = picture[1] & (onto(covered.astype(np.float32), grid, texels, "nearest") != 1.0)
        colour = fill(picture[0], nearest_valid(open_ground)) if open_ground.any() else picture[0]
    return Skin(GROUND, vertices, faces.astype(np.int64), uv, colour, np.zeros(shape, np.uint8))


class _Roofs:
    """Roofs under construction: triangles between posts, mapped by the texels' grid."""

    def __init__(self, grid: Grid, texels: Grid) -> None:
        self.grid, self.texels = grid, texels
        self._parts: list[tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]] = []
        self.faces = 0

    def add(self, pixel: NDArray[np.float64], point: NDArray[np.float64], faces: NDArray[np.int64]) -> None:
        """Add triangles between points (n, 3), whose (column, row) on the posts' grid are `pixel`."""
        column, row = self.texels.to_pixel(*self.grid.to_map(*pixel.T))
        uv = np.column_stack([column / self.texels.width, row / self.texels.height])
        self._parts.append((point, faces, np.clip(uv, 0.0, 1.0)))
        self.faces += len(faces)

    def skin(self, picture: tuple[NDArray[np.uint8], NDArray[np.bool_], Grid] | None, plain: Sequence[int]) -> Skin:
        """Return all roofs as one Skin, with the orthophoto or a plain colour."""
        shape = self.texels.height, self.texels.width
        colour = np.broadcast_to(np.array(plain, np.uint8), (*shape, 3)) if picture is None else picture[0]
        first = np.cumsum([0, *(len(part[0]) for part in self._parts)])
        faces = np.concatenate([part[1] + start for part, start in zip(self._parts, first, strict=False)])
        uv = np.concatenate([part[2] for part in self._parts])[faces].astype(np.float32)
        return Skin(ROOFS, np.concatenate([part[0] for part in self._parts]), faces, uv, colour,
                    np.zeros(shape, np.uint8))  # fmt: skip


def _building(
    rings: Sequence[found.Ring], height: NDArray[np.float64], bare: NDArray[np.float64], at: _Local, roofs: _Roofs,
    quads: Quads, paint: dict[str, Any], post_m: float,
) -> bool:  # fmt: skip
    """Add the roof and walls of one outline; return whether a roof was found."""
    from scipy.ndimage import median_filter
    from scipy.spatial import Delaunay, cKDTree

    fine = [_resampled(ring) for ring in rings]
    rows, columns = height.shape
    low, high = np.floor(rings[0].min(axis=0)).astype(int), np.ceil(rings[0].max(axis=0)).astype(int)
    column, row = np.meshgrid(np.arange(max(low[0], 0), min(high[0], columns)),
                              np.arange(max(low[1], 0), min(high[1], rows)))  # fmt: skip
    post = np.column_stack([column.ravel(), row.ravel()])
    middle = post + 0.5
    level, ground = height[post[:, 1], post[:, 0]], bare[post[:, 1], post[:, 0]]
    edge = np.concatenate(fine)
    away, _ = cKDTree(edge).query(middle) if len(middle) else (np.empty(0), None)
    roof = found.even_odd(middle, rings) & np.isfinite(level) & (level - ground > found.LEAST_M)
    inner = roof & (away > _WITHIN)
    # A building narrower than two posts has no other than mixed ones.
    inner = inner if inner.any() else roof
    if not inner.any():
        return False
    nearest = cKDTree(middle[inner]).query(edge)[1]
    # A median along each ring leaves corners of gables and no single peaks.
    borders = np.cumsum([len(each) for each in fine])[:-1]
    top = np.concatenate([median_filter(each, 5, mode="wrap") for each in np.split(level[inner][nearest], borders)])
    foot = np.nanmin(np.concatenate([ground[np.isfinite(ground)], [np.inf]]))
    # Points on the outline are at the edge of the grid at most.
    edge = np.clip(edge, 0.5, [columns - 0.5, rows - 0.5])
    pixel = np.concatenate([edge, middle[inner]])
    point = at(pixel[:, 0], pixel[:, 1], np.concatenate([top, level[inner]]))
    if len(pixel) >= 3:
        triangle = Delaunay(pixel, qhull_options="QJ").simplices.astype(np.int64)
        triangle = triangle[found.even_odd(pixel[triangle].mean(axis=1), rings)]
        across = np.cross(point[triangle[:, 1]] - point[triangle[:, 0]], point[triangle[:, 2]] - point[triangle[:, 0]])
        triangle[across[:, 2] < 0.0] = triangle[across[:, 2] < 0.0][:, ::-1]
        # Three points of one side of the outline are a triangle in its wall.
        roofs.add(pixel, point, triangle[np.abs(across[:, 2]) > _LEAST_PLAN * post_m**2])
    base = at(edge[:, 0], edge[:, 1], foot - _BELOW_M)
    start = 0
    for number, ring in enumerate(fine):
        own = slice(start, start + len(ring))
        start += len(ring)
        _walls(quads, base[own], point[own], rings[number], ring, paint, outer=number == 0)
    return True


def _resampled(ring: found.Ring) -> NDArray[np.float64]:
    """Corners of a ring with points between them, at most two posts apart."""
    parts = []
    for a, b in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        count = max(1, int(np.ceil(np.linalg.norm(b - a) / 2.0)))
        parts.append(a + (b - a) * (np.arange(count) / count)[:, None])
    return np.concatenate(parts)


def _walls(
    quads: Quads, base: NDArray[np.float64], top: NDArray[np.float64], corners: found.Ring, ring: found.Ring,
    paint: dict[str, Any], outer: bool,
) -> None:  # fmt: skip
    """Add the walls below a ring, whose points are `base` and `top`; windows run along each side of the outline."""
    plan = base[:, :2]
    area = 0.5 * float(np.sum(plan[:, 0] * np.roll(plan[:, 1], -1) - np.roll(plan[:, 0], -1) * plan[:, 1]))
    order = np.arange(len(ring))
    if (area > 0.0) != outer:
        order = order[::-1]
    is_corner = (ring[:, None] == corners[None]).all(axis=-1).any(axis=1)
    begin = int(np.flatnonzero(is_corner[order])[0])
    order = np.roll(order, -begin)
    ends = [*np.flatnonzero(is_corner[order]), len(order)]
    closed = np.append(order, order[0])
    for first, last in zip(ends[:-1], ends[1:], strict=True):
        side = closed[first : last + 1]
        wide = float(np.linalg.norm(np.diff(base[side, :2], axis=0), axis=1).sum())
        high = top[side, 2] - base[side, 2] - _BELOW_M
        if wide < 0.05 or (high <= 0.0).any():
            continue
        for k, (a, b) in enumerate(zip(side[:-1], side[1:], strict=True)):
            tall = max(float(high[k]), float(high[k + 1]))
            shade = facade(**paint, wide_m=wide, high_m=tall, below_m=_BELOW_M, storeys_m=float(high.min()),
                           part=(k / (len(side) - 1), (k + 1) / (len(side) - 1)))  # fmt: skip
            quads.add([base[a], base[b], top[b], top[a]], shade)


def _plants(
    trees: Sequence[found.Tree], height: NDArray[np.float64], bare: NDArray[np.float64], at: _Local,
    draw: np.random.Generator, post_m: float, number: dict[str, int],
    colours: Callable[[NDArray[np.int64]], NDArray[np.float32]],
) -> Skin:  # fmt: skip
    """All trees: leaves below the surface model within each crown, and a trunk below each top."""
    plants, bark = Plants(), linear_from_bytes(np.array(_BARK_COLOUR, np.uint8))
    for tree in trees:
        row, column = tree.posts.T
        radius = float(np.sqrt(len(row) / np.pi)) * post_m
        ground, top = bare[row, column], height[row, column]
        away = np.hypot(row - tree.top[0], column - tree.top[1]) * post_m / max(radius, post_m)
        low = ground + np.minimum(tree.height_m * (0.28 + 0.22 * np.minimum(away, 1.2) ** 2), 0.8 * (top - ground))
        plan = at(column + 0.5, row + 0.5, ground)
        columns = np.column_stack([plan[:, :2], plan[:, 2] + (low - ground), plan[:, 2] + (top - ground)])
        plants.fill(draw, columns, post_m, edge_of(radius), DENSITY, colours(tree.posts), number[LEAVES])
        k = int(np.argmax((row == tree.top[0]) & (column == tree.top[1])))
        east, north, foot = plan[k]
        plants.trunk(east, north, foot - 0.3, foot + 0.55 * tree.height_m, 0.05 + 0.016 * tree.height_m, bark,
                     number[BARK])  # fmt: skip
    return plants.skin(PLANTS)
