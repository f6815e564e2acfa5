"""Squares of tiles baked, each as a scene of its own with the ground around that its light comes from."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from thermorender.render.baked import BakedScene, Progress, bake
from thermorender.render.geometry import Geometry
from thermorender.render.heat.instants import solved_at
from thermorender.render.plan import Plan
from thermorender.render.tiled.baked_tile import BakedTile
from thermorender.render.variant import activate
from thermorender.scene.far_ground import raised_m
from thermorender.scene.scene import Scene
from thermorender.scene.tile_grid import APRON, Tile
from thermorender.scene.world import World, WorldGround

# Tiles along a side of a square that is baked at once.
ROWS = 2
# Finer posts between two of a square, to find the relief there; posts closer than so many pixels of the heights
# leave none. What relief does beside turning faces, such as shadows, over that: 1.04 on rough ground, less on heath.
_FINER, _RESOLVED, _BESIDE = 4, 1.5, 1.25


@dataclass(frozen=True, eq=False)
class Squares:
    """The squares of a scene with a tiled ground, to be baked."""

    scene: Scene  # With its overview, at known temperatures
    plan: Plan  # Of all squares
    rows: int = ROWS

    @property
    def world(self) -> World:
        """The tiled ground."""
        world = self.scene.world
        assert world is not None
        return world

    def of(self, tile: Tile) -> Tile:
        """Return the first tile of the square that a tile is in."""
        return Tile(tile.level, tile.row - tile.row % self.rows, tile.column - tile.column % self.rows)

    def bake(self, first: Tile, progress: Progress | None = None) -> dict[Tile, BakedTile | None]:
        """Return the tiles of the square from a tile on; None where there is no ground."""
        every = [Tile(first.level, first.row + i, first.column + j) for i in range(self.rows) for j in range(self.rows)]
        ground = self.world.square(first, self.rows)
        if ground is None:
            return dict.fromkeys(every)
        own = self.scene.on_ground(ground)
        grid = self.world.grid
        reach = grid.side(first.level) * (0.5 * self.rows + APRON / grid.texels)
        geometry = Geometry(activate(), own.surfaces, reach)
        # The light of a square is kept with its tiles.
        geometry.kept = False
        if not own.temperature_state.solved:
            assert own.time is not None
            own = solved_at(own, [own.time], geometry, progress)[0]
        warm = np.array([limit(each.temperature) for each in own.surfaces for limit in (np.min, np.max)])
        plan = replace(self.plan, coldest=min(self.plan.coldest, float(warm.min())),
                       warmest=max(self.plan.warmest, float(warm.max())))  # fmt: skip
        baked = bake(own, plan, geometry, progress=progress)
        found = dict(self._cut(baked, ground, first, self._lost(baked, ground, first)))
        # Dr.Jit keeps the memory of the largest step.
        dr.flush_malloc_cache()
        return found

    def _lost(self, baked: BakedScene, ground: WorldGround, first: Tile) -> NDArray[np.float32]:
        """Mean square error of the radiance of the square's faces, (F,), for the relief between its posts.

        Radiance follows the normals of faces; the normals of finer ground deviate from those of its posts.
        """
        surface, grid = baked.scene.surfaces[0], self.world.grid
        none = np.zeros(len(surface.faces), np.float32)
        around = -(-APRON * grid.cells // grid.texels)
        finer = grid.finer_posts(first, self.rows, around, _FINER)
        step = grid.side(first.level) / grid.cells
        if first.level == 0 or step < _RESOLVED * self.world.heights.extent.pixel:
            return none
        height = self.world.heights.read(finer)
        rows, columns = ground.whole.shape
        slope = np.stack([np.diff(height, axis=1)[:-1], np.diff(height, axis=0)[:, :-1]], axis=-1) * (_FINER / step)
        normal = slope / np.sqrt(1.0 + np.square(slope).sum(axis=-1, keepdims=True))
        spread = normal.reshape(rows, _FINER, columns, _FINER, 2).var(axis=(1, 3)).sum(axis=-1)
        corner = surface.vertices[surface.faces]
        across = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        own = across[:, :2] / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-300)
        sums, size = baked.plan.spectrum.solver.sum(axis=0), surface.material.shape
        leaving = sum(weight * each[: surface.material.size] for weight, each in zip(sums, baked.texels, strict=True))
        place = (surface.uv.mean(axis=1, dtype=np.float64) * size[::-1]).astype(np.int64)
        texel = np.clip(place[:, 1], 0, size[0] - 1) * size[1] + np.clip(place[:, 0], 0, size[1] - 1)
        value, kind = np.asarray(leaving)[texel].astype(np.float64), surface.material.ravel()[texel]
        # Within each material, as materials differ by more than slopes do.
        count = np.maximum(np.bincount(kind), 1)
        centred = [each - (np.bincount(kind, each) / count)[kind] for each in (value, *own.T)]
        gradient, *_ = np.linalg.lstsq(np.stack(centred[1:], axis=1), centred[0], rcond=None)
        square = np.nan_to_num(spread)[ground.whole] * float(gradient @ gradient) / 2.0 * _BESIDE**2
        return np.repeat(square, 2).astype(np.float32)

    def _cut(
        self, baked: BakedScene, ground: WorldGround, first: Tile, lost: NDArray[np.float32]
    ) -> Iterator[tuple[Tile, BakedTile | None]]:
        """Yield the tiles of a baked square; `lost` is from `_lost`."""
        grid, surface = self.world.grid, baked.scene.surfaces[0]
        around = -(-APRON * grid.cells // grid.texels)
        whole, count = ground.whole, surface.material.size
        number = np.where(whole, np.cumsum(whole.ravel()).reshape(whole.shape) - 1, -1)
        texels = [each[:count].reshape(surface.material.shape) for each in baked.texels]
        per_mk, errors = baked.plan.radiance_per_mk, baked.errors_mk
        within = (errors["faces"] * per_mk) ** 2
        kept = np.array([errors["solution"], errors.get("air", 0.0)])
        place = np.array([ground.frame.latitude_deg, ground.frame.longitude_deg, ground.frame.height_m])
        vertices = surface.vertices.copy()
        # How refraction shows a post depends on where the camera is.
        vertices[:, 2] -= raised_m(vertices[:, 0], vertices[:, 1])
        posts = vertices.reshape(whole.shape[0] + 1, whole.shape[1] + 1, 3)
        for i in range(self.rows):
            for j in range(self.rows):
                tile = Tile(first.level, first.row + i, first.column + j)
                row, column = around + i * grid.cells, around + j * grid.cells
                cells = (slice(row, row + grid.cells), slice(column, column + grid.cells))
                if not whole[cells].any():
                    yield tile, None
                    continue
                own = number[cells][whole[cells]]
                face = (2 * own[:, None] + np.arange(2)).ravel()
                part = tuple(slice(k * grid.texels, (k + 1) * grid.texels + 2 * APRON) for k in (i, j))
                corner = posts[row : row + grid.cells + 1, column : column + grid.cells + 1]
                lit = baked.faces is not None
                yield (
                    tile,
                    BakedTile(
                        place,
                        _without(corner, whole[cells]).astype(np.float32),
                        surface.material[part].copy(),
                        surface.colour[part].copy(),
                        surface.flags[part].copy(),
                        surface.temperature[part].copy(),
                        texels[0][part].copy(),
                        _means(texels[1:], part, 2 if first.level else 1),
                        np.zeros((len(face), 0), np.float16)
                        if baked.faces is None
                        else baked.faces[face].astype(np.float16),
                        baked.face_error[face] + np.float32(within) + lost[face]
                        if lit and baked.face_error is not None
                        else np.zeros(0, np.float32),
                        kept,
                    ),
                )


def _means(texels: Sequence[NDArray[np.float32]], part: tuple[slice, ...], side: int) -> NDArray[np.float16]:
    """Means of a part of channels over squares of `side` texels a side, (h/side, w/side, C)."""
    rows, columns = ((each.stop - each.start) // side for each in part)
    found = [each[part].reshape(rows, side, columns, side).mean(axis=(1, 3)) for each in texels]
    return np.stack(found, axis=-1).astype(np.float16) if found else np.empty((rows, columns, 0), np.float16)


def _without(posts: NDArray[np.float64], whole: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Posts with NaN where no cell has ground."""
    padded = np.pad(whole, 1)
    used = padded[1:, 1:] | padded[1:, :-1] | padded[:-1, 1:] | padded[:-1, :-1]
    return np.where(used[..., None], posts, np.nan)
