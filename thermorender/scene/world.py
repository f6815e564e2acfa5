"""A ground of any size, of which a scene holds an overview: its tiles are read where a flight needs them.

Light and heat of a square of tiles are those of a scene of its own: the square, a rim that filters of its pictures
reach, and rings of coarser ground around it, whose posts are as far apart as a 32nd of their distance.
"""

from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError
from thermorender.materials.material import Material
from thermorender.physics.geodesy import LocalFrame
from thermorender.scene import far_ground, terrain
from thermorender.scene.class_mixtures import ClassMixtures, class_mixtures_of, sample
from thermorender.scene.drape import Drape, on_ground
from thermorender.scene.far_ground import GroundPlan
from thermorender.scene.georeference import Place
from thermorender.scene.ground import Ground
from thermorender.scene.raster import Bounds, Grid, crs_name, lon_lat
from thermorender.scene.sources import Source
from thermorender.scene.surface import Surface, bare
from thermorender.scene.tile_grid import APRON, TEXELS, Tile, TileGrid

# Ground around a square of tiles that its light comes from [m], and distance over that of the posts there. On a real
# relief of 840 m a ring of 4 km leaves 1 mK (RMS), of 2 km 24 mK; posts of a 16th 3 mK.
LIGHT_M, _POSTS = 4000.0, 32.0
# What messages call the classes.
_CLASSES = Path("terrain.tiles.classes")
# Cells along a side of a tile's mesh.
_LEAST_CELLS, _MOST_CELLS = 32, 128
# Tiles in memory whose heights were asked for, and steps along the vertical to a height.
_GROUND_TILES, _VERTICALS = 256, 2


@dataclass(frozen=True, eq=False)
class WorldGround:
    """Surfaces of raster ground with their Drapes, the first ones of it without far ground."""

    frame: LocalFrame
    surfaces: tuple[Surface, ...]
    drapes: tuple[Drape, ...]
    whole: NDArray[np.bool_]  # (r, c) cells of the first surface that have ground


@dataclass(frozen=True, eq=False)
class World:
    """A tiled ground by its sources."""

    heights: Source
    colours: Source | None
    classes: Source | None
    grid: TileGrid
    frame: LocalFrame
    mixtures: ClassMixtures | None
    library: Mapping[str, Material]
    # (n, n) heights of the posts of its coarsest tile [m above the ellipsoid], NaN where missing
    relief: NDArray[np.float64]

    @property
    def within(self) -> Bounds:
        """Bounds of the ground on the map."""
        return self.heights.extent.bounds

    @property
    def root(self) -> Tile:
        """The tile of all the ground."""
        return Tile(self.grid.levels - 1, 0, 0)

    def digest(self) -> str:
        """Return a fingerprint (hex) of the ground."""
        every = [each.digest() for each in (self.heights, self.colours, self.classes) if each is not None]
        parts = None if self.mixtures is None else (self.mixtures.classes, self.mixtures.parts.tobytes())
        return repr((every, self.grid.left, self.grid.top, self.grid.texel, self.grid.cells, self.grid.levels,
                     self.grid.texels, parts))  # fmt: skip

    def overview(self) -> WorldGround:
        """Return the ground of all the world at the texels of its coarsest tile."""
        posts, texels = self.grid.posts(self.root), self.grid.texel_grid(self.root, around=0)
        surface, drape = self._near(self.relief, posts, texels, self.frame)
        return WorldGround(self.frame, (surface,), (drape,), terrain.whole_cells(np.isfinite(self.relief)))

    def between(self, bounds: Bounds) -> tuple[float, float]:
        """Return about the lowest and the highest ground within bounds on the map [m above the ellipsoid]."""
        step = self.grid.side(self.root.level) / self.grid.cells
        (left, bottom, right, top), most = bounds, self.grid.cells
        # A post more on each side, as ground between posts may be beyond them.
        first = [int(np.clip(np.floor(each / step) - 1, 0, most)) for each in (left - self.grid.left,
                                                                         self.grid.top - top)]  # fmt: skip
        last = [int(np.clip(np.ceil(each / step) + 1, 0, most)) for each in (right - self.grid.left,
                                                                        self.grid.top - bottom)]  # fmt: skip
        part = self.relief[first[1] : last[1] + 1, first[0] : last[0] + 1]
        part = part if np.isfinite(part).any() else self.relief
        return float(np.nanmin(part)), float(np.nanmax(part))

    def square(self, tile: Tile, rows: int) -> WorldGround | None:
        """Return the ground of `rows`² tiles from one on with the rings around them; None where there is none."""
        around = -(-APRON * self.grid.cells // self.grid.texels)
        posts = self.grid.posts(tile, rows, around)
        height = self.heights.read(posts)
        frame = self.frame_at(self.grid.bounds(tile, rows), height)
        if frame is None:
            return None
        surface, drape = self._near(height, posts, self.grid.texel_grid(tile, rows), frame)
        cell = np.arange(posts.height - 1) - around
        whole = terrain.whole_cells(np.isfinite(height))
        surface = replace(surface, seeds=_seeds(whole, tile, cell, self.grid.cells))
        surfaces, drapes = [surface], [drape]
        inside = far_ground.of_raster(surface.vertices, height, posts, frame)
        step = self.grid.side(tile.level) / self.grid.cells
        near = 2.0 * _POSTS * step
        for number in range(64):
            away = min(near * 2.0**number, LIGHT_M)
            made = self._ring(tile, rows, step * 2.0**number, away, inside, frame, f"ring {number + 1}")
            if made is not None:
                surface, drape, inside = made
                surfaces.append(surface)
                drapes.append(drape)
            if away == LIGHT_M:
                break
        # Gaps of the classes are judged on the whole ground, in its overview.
        drapes = [replace(each, most_open=1.0) for each in drapes]
        return WorldGround(frame, tuple(surfaces), tuple(drapes), whole)

    def frame_at(self, bounds: Bounds, height: NDArray[np.floating]) -> LocalFrame | None:
        """Return the LocalFrame in the middle of bounds on the map, at the median of heights; None without any."""
        known = height[np.isfinite(height)]
        if not known.size:
            return None
        x, y = 0.5 * (bounds[0] + bounds[2]), 0.5 * (bounds[1] + bounds[3])
        longitude, latitude = lon_lat(self.grid.posts(self.root), np.array([x]), np.array([y]))
        return LocalFrame(float(latitude[0]), float(longitude[0]), float(np.round(np.median(known))))

    def _near(self, height: NDArray[np.float64], posts: Grid, texels: Grid, frame: LocalFrame) -> tuple[Surface, Drape]:
        """(Surface, Drape) of heights on posts."""
        vertices, faces, uv = terrain.mesh(height, posts, frame, texels)
        shape = texels.height, texels.width
        vertices[:, 2] += far_ground.raised_m(vertices[:, 0], vertices[:, 1])
        surface = bare("terrain", vertices, faces, uv, shape, terrain.texel_size_m(texels, frame))
        return replace(surface, joined=True), self._drape(height, posts, texels)

    def _drape(self, height: NDArray[np.float64], posts: Grid, texels: Grid) -> Drape:
        colour = valid = classes = None
        if self.colours is not None:
            colour, valid = self.colours.read(texels)
            if not valid.any():
                # Beyond the pictures ground has the colours of its materials.
                colour = valid = None
        if self.classes is not None and self.mixtures is not None:
            classes = self.mixtures.on(self.classes, texels)
        return Drape(
            texels, colour, valid, classes, self.mixtures.mixed if self.mixtures else (),
            classes_file=_CLASSES,
            on_ground=on_ground(height, posts, texels), height=None if colour is None else (height, posts),
        )  # fmt: skip

    def _ring(
        self, tile: Tile, rows: int, step: float, away: float, inside: GroundPlan, frame: LocalFrame, name: str
    ) -> tuple[Surface, Drape, GroundPlan] | None:
        """(Surface, Drape, GroundPlan) of ground up to `away` from a square of tiles; None where there is none."""
        from rasterio import Affine

        left, bottom, right, top = self.grid.bounds(tile, rows)
        # Posts of all squares and rings are on one lattice.
        first = [np.floor((low - away - origin) / step) for low, origin in ((left, self.grid.left),
                                                                         (self.grid.top - top, 0.0))]  # fmt: skip
        count = [int(np.ceil((high + away - origin) / step) - low) + 1
                 for high, origin, low in ((right, self.grid.left, first[0]),
                                           (self.grid.top - bottom, 0.0, first[1]))]  # fmt: skip
        corner = Affine(step, 0.0, self.grid.left + first[0] * step, 0.0, -step, self.grid.top - first[1] * step)
        texels = Grid(self.grid.crs, corner, count[1] - 1, count[0] - 1, name)
        posts = Grid(self.grid.crs, corner @ Affine.translation(-0.5, -0.5), count[1], count[0], name)
        height = self.heights.read(posts)
        if not np.isfinite(height).any():
            return None
        try:
            (vertices, faces, uv), plan = far_ground.far_mesh(height, posts, frame, texels, inside, extend=False)
        except far_ground.NothingOutside:
            return None
        surface = bare(name, vertices, faces, uv, (texels.height, texels.width), terrain.texel_size_m(texels, frame))
        return replace(surface, far=True), self._drape(height, posts, texels), plan


class FineGround(Ground):
    """Callable (east, north) → local height of a tiled ground's finest tiles [m], NaN where there is none."""

    def __init__(self, world: World) -> None:
        super().__init__(())
        self._world = world
        self._tiles: OrderedDict[Tile, NDArray[np.float64]] = OrderedDict()

    def _height(self, point: NDArray[np.float64]) -> NDArray[np.float64]:
        frame, place = self._world.frame, Place(self._world.frame, self._world.grid.crs)
        point = np.column_stack([point, np.zeros(len(point))])
        # The vertical there is not that of the frame.
        for _ in range(_VERTICALS):
            height = self._above_ellipsoid(*place.to_map(point))
            latitude, longitude, _ = frame.geodetic_from_enu(point)
            point[:, 2] = frame.enu_from_geodetic(latitude, longitude, np.nan_to_num(height))[:, 2]
        return np.where(np.isfinite(height), point[:, 2], np.nan)

    def _above_ellipsoid(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Height of the mesh at places on the map, (n,) [m above the ellipsoid]."""
        grid, found = self._world.grid, np.full(len(x), np.nan)
        side = grid.side(0)
        column, row = (x - grid.left) / side, (grid.top - y) / side
        most = 1 << (grid.levels - 1)
        inside = (column >= 0.0) & (column < most) & (row >= 0.0) & (row < most)
        key = np.where(inside, np.floor(row) * most + np.floor(column), -1.0).astype(np.int64)
        for each in np.unique(key[inside]):
            here = key == each
            tile = Tile(0, *divmod(int(each), most))
            at = np.stack([row[here] - tile.row, column[here] - tile.column]) * grid.cells
            found[here] = _on_triangles(self._posts(tile), *at)
        return found

    def _posts(self, tile: Tile) -> NDArray[np.float64]:
        if tile not in self._tiles:
            while len(self._tiles) >= _GROUND_TILES:
                self._tiles.popitem(last=False)
            self._tiles[tile] = self._world.heights.read(self._world.grid.posts(tile))
        self._tiles.move_to_end(tile)
        return self._tiles[tile]


def _on_triangles(
    height: NDArray[np.float64], row: NDArray[np.float64], column: NDArray[np.float64]
) -> NDArray[np.float64]:  # fmt: skip
    """Heights (n,) between posts (r, c), on cells that are split from the upper left to the lower right post."""
    i, j = (np.minimum(np.floor(each).astype(np.int64), height.shape[0] - 2) for each in (row, column))
    v, u = row - i, column - j
    a, b, c, d = height[i, j], height[i, j + 1], height[i + 1, j], height[i + 1, j + 1]
    found: NDArray[np.float64] = np.where(v > u, a + v * (c - a) + u * (d - c), a + u * (b - a) + v * (d - b))
    return found


def world_of(
    heights: Source, colours: Source | None, classes: Source | None, names: Mapping[int, str],
    library: Mapping[str, Material], where: str, frame: LocalFrame | None = None,
) -> World:  # fmt: skip
    """Return the World of sources; `names` has the material of each class number. Without a `frame` its origin is in
    the middle."""
    finest = colours or classes
    if finest is None:
        raise ThermorenderError(
            f"{where}: terrain.tiles has heights alone, which one raster can hold; give elevation of [terrain], or add "
            "orthophoto or classes"
        )
    crs, (left, bottom, right, top) = finest.extent.crs, heights.extent.bounds
    for each in (heights, colours, classes):
        if each is not None and each.extent.crs != crs:
            raise ThermorenderError(
                f"{where}: rasters of terrain.tiles are in {crs_name(each.extent.crs)} and {crs_name(crs)}; "
                "convert all to one map, for example with `rio warp`"
            )
    if not crs.is_projected or abs(crs.linear_units_factor[1] - 1.0) > 1e-9:
        raise ThermorenderError(
            f"{where}: terrain.tiles is on the map {crs_name(crs)}, and tiles need one in metres; convert the rasters, "
            "for example with `rio warp`"
        )
    texel, texels = finest.extent.pixel, TEXELS
    # Tiles begin at a corner of the finest pixels, the nearest to the middle of the first pixel of heights, so that
    # posts are in the middles of pixels where both agree.
    x, y = finest.extent.corner
    half = 0.5 * heights.extent.pixel
    left, top = x + np.rint((left + half - x) / texel) * texel, y + np.rint((top - half - y) / texel) * texel
    levels = 1 + max(0, int(np.ceil(np.log2(max(right - left, top - bottom) / (texels * texel)))))
    cells = 2 ** int(np.ceil(np.log2(texels * texel / heights.extent.pixel)))
    grid = TileGrid(crs, float(left), float(top), texel, int(np.clip(cells, _LEAST_CELLS, _MOST_CELLS)), levels, texels)
    root = Tile(levels - 1, 0, 0)
    height = heights.read(grid.posts(root))
    if not np.isfinite(height).any():
        raise ThermorenderError(f"{where}: terrain.tiles.elevation has no valid height; give other rasters")
    mixtures = None
    if classes is not None:
        middle = [Tile(level, *(2 * (1 << (levels - 1 - level)) // 4,) * 2) for level in range(levels)]
        mixtures = class_mixtures_of(
            classes, names, [sample(grid.texel_grid(each, around=0)) for each in middle], where
        )
    made = World(heights, colours, classes, grid, frame or LocalFrame(0.0, 0.0, 0.0), mixtures, library,
                 height)  # fmt: skip
    own = frame or made.frame_at(heights.extent.bounds, height)
    assert own is not None
    return replace(made, frame=own)


def _seeds(whole: NDArray[np.bool_], tile: Tile, cell: NDArray[np.integer], cells: int) -> NDArray[np.uint32]:
    """Numbers of the faces of a square by their level and place, (F,), the same in whatever square they are."""
    row, column = np.meshgrid(tile.row * cells + cell, tile.column * cells + cell, indexing="ij")
    row, column = (each[whole].astype(np.uint64) for each in (row, column))
    key = row * 0x9E3779B1 + column * 0x85EBCA77 + tile.level * 0xC2B2AE3D
    key = np.stack([2 * key, 2 * key + 1], axis=-1)
    key = (key ^ (key >> np.uint64(15))) * np.uint64(0x2C1B3C6D)
    return (key ^ (key >> np.uint64(12))).astype(np.uint32).ravel()
