"""Baked tiles put together for the cameras of a cell: one baked scene in a frame of its own."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from thermorender.atmosphere.rays import EARTH_RADIUS_M
from thermorender.physics.geodesy import LocalFrame
from thermorender.render.arrays import Channels, Mitsuba, widths
from thermorender.render.baked import BakedScene
from thermorender.render.geometry import Geometry
from thermorender.render.loaded import Loaded
from thermorender.render.plan import Plan
from thermorender.render.reflection.device_tables import black_of
from thermorender.render.tiled.baked_tile import BakedTile
from thermorender.render.tiled.texel_memory import TexelMemory
from thermorender.render.variant import activate
from thermorender.scene.far_ground import raised_m
from thermorender.scene.scene import Scene
from thermorender.scene.surface import Surface, over_round_earth
from thermorender.scene.terrain import triangles, whole_cells
from thermorender.scene.tile_grid import APRON, Tile, TileGrid

_Floats = NDArray[np.float64]
# Tiles that are farther from the camera than this many times its height above ground are far ground.
_NEAR, _NEAR_M = 4.0, 500.0
# Depth of the skirts of a tile beyond the relief along its edge, over the distance of posts and at most [m]; posts
# among which that relief is taken.
_DEEPER, _DEEPER_M, _AROUND = 0.25, 10.0, 17


def assembled(
    scene: Scene, plan: Plan, grid: TileGrid, memory: TexelMemory, frame: LocalFrame, above_m: float
) -> BakedScene:
    """Return the BakedScene of the tiles in memory in a frame; `above_m` is the cameras' height above ground [m]."""
    surfaces, of_faces = list[Surface](), list[NDArray[np.intp]]()
    tiles = dict(sorted(memory.tiles.items()))
    kept, slots = memory.texels(activate(), tiles)
    for tile, baked in tiles.items():
        surface, of_face = _surface(tile, baked, grid, frame, above_m)
        surfaces.append(surface)
        of_faces.append(of_face)
    geometry = Geometry(activate(), surfaces, slots=slots)
    warm = [limit(surface.temperature) for surface in surfaces for limit in (np.min, np.max)]
    plan = replace(plan, coldest=float(min(warm)), warmest=float(max(warm)))
    own = scene.of_tiles(surfaces, frame)
    error = black = None
    if plan.bake:
        each = list(zip(tiles.values(), of_faces, strict=True))
        error = np.concatenate([baked.face_error[of] for baked, of in each])
        kept = replace(kept, faces=_corrections(geometry.mi, [baked.faces[of] for baked, of in each]))
    if plan.specular:
        mirrors = np.zeros((memory.slots, surfaces[0].material.size), np.uint8)
        for number, surface in zip(slots.of, surfaces, strict=True):
            mirrors[number] = plan.specular.number[surface.material.ravel()]
        kept = replace(kept, mirrors=mirrors.reshape(-1))
        # In the order of their slots.
        wet = [surfaces[number] for number in np.argsort(slots.of) if mirrors[slots.of[number]].any()]
        if wet:
            material, kelvin = (np.concatenate([getattr(each, name).ravel() for each in wet])
                                for name in ("material", "temperature"))  # fmt: skip
            black = black_of(plan, plan.specular.number, material, kelvin)
    worst = np.max([each.errors_mk for each in tiles.values()], axis=0)
    errors_mk = {"solution": float(worst[0]), "noise": 0.0, "faces": 0.0, "texels": 0.0}
    if scene.air is not None:
        errors_mk["air"] = float(worst[1])
    loaded = Loaded(geometry=geometry, kept=kept)
    return BakedScene(own, plan, None, None, (), None, error, black, None, errors_mk, None, loaded)


def _corrections(mi: Mitsuba, parts: Sequence[NDArray[np.float16]]) -> Channels:
    """Channels of faces, (n, K) of each tile."""
    ends = np.cumsum(widths(parts[0].shape[1]))
    groups = (slice(end - width, end) for end, width in zip(ends, widths(parts[0].shape[1]), strict=True))
    return Channels.of_arrays(mi, [np.concatenate([part[:, group] for part in parts]) for group in groups])


def between(one: LocalFrame, other: LocalFrame) -> _Floats:
    """Return the transform of positions in one frame to those in another, (4, 4)."""
    turn = other.enu_from_ecef_rotation
    found = np.eye(4)
    found[:3, :3] = turn @ one.enu_from_ecef_rotation.T
    found[:3, 3] = turn @ (one.origin_ecef - other.origin_ecef)
    return found


def _depth(height: _Floats, step: float) -> _Floats:
    """Depths of the skirts below posts along an edge with these heights (n,) [m]: the relief around, which is also that
    of a coarser neighbour between its posts."""
    from scipy.ndimage import maximum_filter1d, minimum_filter1d

    known = np.isfinite(height)
    if not known.any():
        return np.zeros(len(height))
    level = np.interp(np.arange(len(height)), np.flatnonzero(known), height[known])
    relief = maximum_filter1d(level, _AROUND) - minimum_filter1d(level, _AROUND)
    return np.minimum(_DEEPER * step, _DEEPER_M) + relief


@dataclass(frozen=True, eq=False)
class _Mesh:
    """The triangles of a tile with skirts below its four edges; tiles without a hole share one."""

    used: NDArray[np.intp]  # (V,) the vertices, by number of the posts and then of the edges' lower ends
    faces: NDArray[np.int32]  # (F, 3)
    uv: NDArray[np.float32]  # (F, 3, 2)
    of_face: NDArray[np.intp]  # (F,) the face of the tile that each one shows


def _edges(index: NDArray[np.intp]) -> tuple[NDArray[np.intp], ...]:
    """The posts, or cells, (n, n) along the edges of a tile, with its ground on their left."""
    return index[:, 0], index[-1], index[::-1, -1], index[0, ::-1]


@lru_cache(maxsize=8)
def _mesh(whole: bytes, cells: int, texels: int) -> _Mesh:
    """The _Mesh of cells with ground, (cells, cells) bool."""
    ground = np.frombuffer(whole, np.bool_).reshape(cells, cells)
    count, size = cells + 1, texels + 2 * APRON
    at = (APRON + np.arange(count) * (texels / cells)) / size
    uv = np.stack(np.meshgrid(at, at), axis=-1).reshape(-1, 2)
    index = np.arange(count * count).reshape(count, count)
    faces = triangles(ground)
    number = np.where(ground, np.cumsum(ground.ravel()).reshape(ground.shape) - 1, -1)
    rows, of_face, first = [faces], [np.arange(len(faces))], count * count
    for edge, cell, second in zip(_edges(index), _edges(number), (0, 0, 1, 1), strict=True):
        there = cell >= 0
        p, q = edge[:-1][there], edge[1:][there]
        lower = first + np.arange(count)
        p_low, q_low = lower[:-1][there], lower[1:][there]
        rows.append(np.stack([np.stack([p, p_low, q_low], axis=-1), np.stack([p, q_low, q], axis=-1)], axis=1)
                    .reshape(-1, 3))  # fmt: skip
        of_face.append(np.repeat(2 * cell[there] + second, 2))
        first += count
        uv = np.concatenate([uv, uv[edge]])
    used, corner = np.unique(np.concatenate(rows).astype(np.intp), return_inverse=True)
    corner = corner.reshape(-1, 3)
    return _Mesh(used, corner.astype(np.int32), uv[used][corner].astype(np.float32), np.concatenate(of_face))


def _surface(
    tile: Tile, baked: BakedTile, grid: TileGrid, frame: LocalFrame, above_m: float
) -> tuple[Surface, NDArray[np.intp]]:
    """(Surface of a tile with skirts, the face of the tile that each of its faces shows)."""
    to = between(baked.frame, frame)
    posts = baked.posts.astype(np.float64) @ to[:3, :3].T + to[:3, 3]
    posts[..., 2] += raised_m(posts[..., 0], posts[..., 1])
    # Of a cell without ground one post at least has none.
    mesh = _mesh(whole_cells(np.isfinite(posts[..., 2])).tobytes(), grid.cells, grid.texels)
    step = grid.side(tile.level) / grid.cells
    points = [posts.reshape(-1, 3)]
    for edge in _edges(np.arange(points[0].shape[0]).reshape(posts.shape[:2])):
        low = points[0][edge]
        low[:, 2] -= _depth(over_round_earth(low, EARTH_RADIUS_M), step)
        points.append(low)
    vertices = np.nan_to_num(np.concatenate(points)[mesh.used])
    low, high = vertices[:, :2].min(axis=0), vertices[:, :2].max(axis=0)
    away = float(np.linalg.norm(np.maximum(np.maximum(low, -high), 0.0)))
    surface = Surface(
        name="terrain", vertices=vertices, faces=mesh.faces, uv=mesh.uv, colour=baked.colour,
        material=baked.material, temperature=baked.temperature, flags=baked.flags,
        texel_m=grid.texel * 2.0**tile.level, far=away > max(_NEAR * above_m, _NEAR_M), joined=True,
    )  # fmt: skip
    return surface, mesh.of_face
