"""The renderer of a tiled ground: a renderer for each cell of cameras, of the tiles that it needs."""

import ctypes
import gc
from collections.abc import Iterable, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import replace
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Literal

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.errors import ThermorenderError
from thermorender.render.baked import Progress
from thermorender.render.layers import OutgoingRadiance
from thermorender.render.plan import make_plan
from thermorender.render.renderer import Renderer, whole_number
from thermorender.render.tiled.baked_tile import VERSION, TileStore
from thermorender.render.tiled.cells import assembled, between
from thermorender.render.tiled.loading import TileLoader
from thermorender.render.tiled.squares import ROWS, Squares
from thermorender.render.view import View
from thermorender.scene.georeference import place_of
from thermorender.scene.scene import Scene
from thermorender.scene.temperature_state import Conditional
from thermorender.scene.tile_grid import APRON, Cell, Tile, cell_of
from thermorender.sensor.camera import Camera
from thermorender.trajectory.rotations import checked_pose
from thermorender.units import utc_text
from thermorender.versions import versions

if TYPE_CHECKING:
    from thermorender.frame import Frame
    from thermorender.render.dynamic import Objects
    from thermorender.render.pixels.parts import PixelParts

# CPU time of a square on two cores, with a heat balance and at known temperatures [s]; bytes of a texel on disk, with
# one channel, and for each other one of a tile of level 0 and of coarser tiles.
_SQUARE_S, _TEXEL_BYTES, _CHANNEL_BYTES = {False: 40.0, True: 15.0}, 13.6, (2.0, 0.5)
# Temperatures of tiles beyond those of the overview, for which spectral nodes are chosen [K].
_WIDER_K = 15.0


class TiledRenderer(Renderer):
    """Renders frames of a scene with a tiled ground; arguments and methods are those of `Renderer`.

    The temperatures of tiles are those of the scene's instant. `hits`, `faces`, `baked` and what follows from them are
    of the overview.
    """

    follows_weather = False

    def __init__(
        self, scene: Scene, quality: Literal["fast", "standard", "high"] = "standard", samples: int | None = None,
        taps: int | None = None, edge_mk: float | None = None, rays: int | None = None, tolerance_mk: float = 5.0,
        seed: int = 0, device: Literal["auto", "cpu", "cuda"] = "auto", progress: Progress | None = None,
        *, rows: int = ROWS,
    ) -> None:  # fmt: skip
        if scene.world is None:
            raise ThermorenderError(f"{scene.where}: the scene has no terrain.tiles; give it to Renderer")
        # An edit may ask for what the scene file may not.
        if scene.spec.lacking_on_tiles:
            raise scene.not_on_tiles(scene.spec.lacking_on_tiles)
        if isinstance(scene.temperature_state.source, Conditional):
            raise scene.not_on_tiles("a map that takes hour or relief")
        self._given = (scene, quality, samples, taps, edge_mk, rays, tolerance_mk, seed, device), rows
        super().__init__(scene, quality, samples, taps, edge_mk, rays, tolerance_mk, seed, device, progress)
        self.world, sampling = scene.world, self.plan.sampling
        self.plan = make_plan(_wider(self.scene), sampling)
        key = (VERSION, scene.digest(), sampling, rows, self._geometry.mi.variant(), versions())
        self.store = TileStore(repr(key))
        self.squares = Squares(self.scene, self.plan, rows)
        self.loader = TileLoader(self.store, self.squares, self._progress)
        # The cell that was made last.
        self._made: tuple[Cell, Renderer, NDArray[np.float64]] | None = None
        # {cell: the next one on the way}
        self._next: dict[Cell, Cell] = {}

    def __reduce__(self) -> tuple[Any, ...]:
        return _again, self._given

    def seen_by(self, camera: Camera) -> "TiledRenderer":
        """Return the renderer of another camera."""
        return TiledRenderer(self.scene.with_camera(camera), seed=self.seed, **self.plan.sampling.settings(),
                             rows=self.squares.rows)  # fmt: skip

    def prepare(self, pose: ArrayLike | None = None) -> None:
        """Bake and load the tiles of frames from a pose; do nothing without one."""
        if pose is not None:
            self.at(pose)

    def with_seed(self, seed: int) -> "TiledRenderer":
        """Return this renderer with another seed of the sensor's noise."""
        found = copy(self)
        found.seed = whole_number("seed", seed)
        found._given = (*self._given[0][:-2], seed, self._given[0][-1]), self._given[1]
        return found

    def __repr__(self) -> str:
        name, camera = self.scene.name, self.scene.camera.name
        return f"TiledRenderer({name!r}, {camera}, {self.plan.nodes} nodes, seed {self.seed})"

    @cached_property
    def _half(self) -> tuple[float, float]:
        """Largest slopes of rays of a picture, across and along."""
        camera = self.scene.camera
        corner = camera.directions(np.array([[0.0, 0.0], [camera.width, 0.0], [0.0, camera.height],
                                             [camera.width, camera.height]]))  # fmt: skip
        across, along = np.abs(corner).max(axis=0).tolist()
        return across, along

    def cell(self, pose: ArrayLike) -> Cell:
        """Return the Cell of a pose in the scene's frame, on the map."""
        matrix = checked_pose(pose)
        frame, place = self.scene.frame, place_of(self.scene.frame, self.scene.grid)
        assert frame is not None and place is not None
        x, y = place.to_map(matrix[None, :3, 3])
        height = float(frame.geodetic_from_enu(matrix[:3, 3])[2])
        ground = self.ground_m(float(x[0]), float(y[0]))
        return cell_of(np.array([x[0], y[0], height]), matrix[:3, :3], height - ground, self._half)

    def ground_m(self, x: float, y: float) -> float:
        """Return the height of the ground at a place on the map [m above the ellipsoid], or the lowest."""
        longitude, latitude = self._lon_lat(x, y)
        frame = self.scene.frame
        assert frame is not None
        low = float(np.nanmin(self.world.relief))
        east, north, _ = frame.enu_from_geodetic(latitude, longitude, low)
        up = float(self.scene.ground(east, north))
        return low if up != up else float(frame.geodetic_from_enu(np.array([east, north, up]))[2])

    def tiles(self, cell: Cell) -> list[Tile]:
        """Return the tiles that a cell needs, in a fixed order."""
        slope, world = 1.0 / self.scene.camera.focal_length_px, self.world
        return sorted(world.grid.chosen(cell, slope, world.between, world.within))

    def outlook(self, poses: NDArray[np.float64]) -> tuple[str, ...]:
        """Return a sentence on the tiles that frames from some poses (n, 4, 4) need, and what it takes to bake them."""
        cells = list(dict.fromkeys(self.cell(pose) for pose in poses))
        needed = [self.tiles(cell) for cell in cells]
        every = sorted({tile for tiles in needed for tile in tiles})
        missing = [tile for tile in every if not self.store.has(tile)]
        levels = [square.level for square in {self.squares.of(tile) for tile in missing}]
        squares = len(levels)
        most = max(map(len, needed))
        line = f"tiles: {len(every)} for the poses looked at, up to {most} in a frame, {len(missing)} not baked yet"
        stays = () if self._asked.temperature_state.solved else (_stays(self.scene),)
        if not squares:
            return (line, *stays)
        hours = squares * _SQUARE_S[self._asked.temperature_state.solved] / 3600.0
        texels = self.squares.rows**2 * (self.world.grid.texels + 2 * APRON) ** 2
        size = texels * sum(_TEXEL_BYTES + _CHANNEL_BYTES[level > 0] * (self.plan.spectrum.channels - 1)
                            for level in levels)  # fmt: skip
        return (f"{line}: {squares} squares, about {hours:.2g} CPU hours and {size / 1e9:.2g} GB of disk", *stays)

    def at(self, pose: ArrayLike) -> tuple[Renderer, NDArray[np.float64]]:
        """Return (the Renderer of the cell of a pose, the pose in its frame)."""
        cell, matrix = self.cell(pose), checked_pose(pose)
        with self.loader.lock:
            if self._made is None or self._made[0] != cell:
                # Gigabytes: the former one goes first.
                self._made = None
                give_memory_back()
                self._made = cell, *self._renderer_of(cell)
                if cell in self._next:
                    self.loader.read_ahead(self.tiles(self._next[cell]))
            _, renderer, to = self._made
        return renderer, to @ matrix

    def expect(self, poses: Iterable[ArrayLike]) -> frozenset[int]:
        """Read tiles of the next cell while one is in use, for frames from poses in this order; return the numbers of
        the poses that are in another cell than the one before."""
        cells = [self.cell(pose) for pose in poses]
        self._next = dict(pairwise(dict.fromkeys(cells)))
        return frozenset(number for number, (one, other) in enumerate(pairwise(cells), 1) if one != other)

    def _renderer_of(self, cell: Cell) -> tuple[Renderer, NDArray[np.float64]]:
        """(Renderer of a cell, transform from the scene's frame to its own)."""
        own = self.scene.frame
        assert own is not None
        x, y, height = (0.5 * (np.array(cell.low) + cell.high)).tolist()
        longitude, latitude = self._lon_lat(x, y)
        frame = type(own)(latitude, longitude, own.height_m)
        above_m = height - self.ground_m(x, y)
        memory = self.loader.load(self.tiles(cell))
        if not memory.tiles:
            raise ThermorenderError(
                f"{self.scene.where}: terrain.tiles has no ground around the camera; give a pose over it"
            )
        baked = assembled(self.scene, self.plan, self.world.grid, memory, frame, max(above_m, 0.0))
        return Renderer.of(baked, self.seed), between(own, frame)

    def _lon_lat(self, x: float, y: float) -> tuple[float, float]:
        from thermorender.scene.raster import lon_lat

        longitude, latitude = lon_lat(self.world.grid.posts(self.world.root), np.array([x]), np.array([y]))
        return float(longitude[0]), float(latitude[0])

    @property
    def cache_note(self) -> str | None:
        """Why baked tiles could not be kept on disk."""
        return self.loader.note

    def visible(
        self, pose: ArrayLike, camera: Camera | None = None, time_s: float = 0.0, objects: "Objects | None" = None
    ) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """Return the orthophoto seen from `pose`, as of `Renderer.visible`."""
        with self.loader.lock:
            renderer, own = self.at(pose)
            kept = renderer.baked.loaded.kept
            if kept is None or kept.colours is None:
                self._made = None
                self.loader.keep_colours()
                renderer, own = self.at(pose)
                kept = renderer.baked.loaded.kept
        assert kept is not None and kept.colours is not None
        renderer._coloured = [(renderer._geometry, OutgoingRadiance(kept.colours))]
        return renderer.visible(own, camera, time_s, objects)

    def frame(
        self, pose: ArrayLike, time_s: float = 0.0, index: int = 0, objects: "Objects | None" = None,
        sampled_as: "Frame | None" = None,
    ) -> "Frame":  # fmt: skip
        """Return the Frame seen from `pose`, as of `Renderer.frame`, without `sampled_as`, which is for edits."""
        if sampled_as is not None:
            raise self.scene.not_on_tiles("sampled_as=…, which compares edits,")
        return super().frame(pose, time_s, index, objects)

    def sky(
        self, pose: ArrayLike, camera: Camera | None = None, time_s: float = 0.0, objects: "Objects | None" = None
    ) -> NDArray[np.bool_]:
        """Return where a pixel's middle is above the horizon without a surface, as of `Renderer.sky`."""
        renderer, own = self.at(pose)
        return renderer.sky(own, camera, time_s, objects)

    def depth(self, pose: ArrayLike, camera: Camera | None = None) -> NDArray[np.float32]:
        """Return the depth along the axis, as of `Renderer.depth`."""
        renderer, own = self.at(pose)
        return renderer.depth(own, camera)

    def cast_only(self, pose: ArrayLike, rays: Sequence[Sequence[Any]]) -> None:
        """Cast rays from `rays` and do nothing else, as of `Renderer.cast_only`."""
        renderer, own = self.at(pose)
        renderer.cast_only(own, rays)

    def parts_at(
        self, pose: ArrayLike, pixels: ArrayLike, time_s: float = 0.0, objects: "Objects | None" = None,
        camera: Camera | None = None,
    ) -> "list[PixelParts]":  # fmt: skip
        """Refuse what needs the rays between surfaces, which tiles do not keep."""
        raise self.scene.not_on_tiles("the parts of a pixel's radiance")

    def heat_terms(self) -> dict[str, NDArray[np.float32]] | None:
        """Refuse what a run keeps of all texels, which are solved tile by tile."""
        raise self.scene.not_on_tiles("the terms of the heat balance")

    def texels(
        self, pose: ArrayLike, time_s: float = 0.0, objects: "Objects | None" = None, static: bool = False
    ) -> NDArray[np.int64]:
        """Refuse numbers of texels, which differ from cell to cell."""
        raise self.scene.not_on_tiles("numbers of texels")

    def pictured(
        self, values: NDArray[np.float32], pose: ArrayLike, time_s: float = 0.0, objects: "Objects | None" = None
    ) -> NDArray[np.float32]:
        """Refuse radiances given to texels, whose numbers differ from cell to cell."""
        raise self.scene.not_on_tiles("radiances of texels")

    def solved_for(self, scene: Scene, progress: Progress | None = None) -> Renderer:
        """Refuse an edited scene, whose tiles are to be baked again."""
        raise self.scene.not_on_tiles("an edit without new rays")

    def preview_for(self, scene: Scene, progress: Progress | None = None) -> Renderer:
        """Refuse an edited scene, as `solved_for`."""
        raise self.scene.not_on_tiles("a preview of an edit")

    def _view(
        self, pose: ArrayLike, time_s: float = 0.0, objects: "Objects | None" = None, camera: Camera | None = None,
        lit_s: float | None = None, lit_objects: "Objects | None" = None,
    ) -> View:  # fmt: skip
        renderer, own = self.at(pose)
        view = renderer._view(own, time_s, objects, camera, lit_s, lit_objects)
        frame, there = self.scene.frame, renderer.scene.frame
        assert frame is not None and there is not None
        return replace(view, to_scene=between(there, frame))


def give_memory_back() -> None:
    """Free what nothing refers to, and give it back to the system: the C library of Linux keeps 0.3 GB for later."""
    gc.collect()
    dr.flush_malloc_cache()
    with suppress(AttributeError, OSError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)


def _stays(scene: Scene) -> str:
    assert scene.time is not None
    return f"temperatures of tiles are those of {utc_text(scene.time)}, also during the flight"


def renderer_of(scene: Scene, like: Renderer | None = None, **settings: Any) -> Renderer:
    """Return the Renderer of a scene of any ground; tiles share nothing with those of `like`."""
    return TiledRenderer(scene, **settings) if scene.world is not None else Renderer(scene, like=like, **settings)


def _again(settings: tuple[Any, ...], rows: int) -> TiledRenderer:
    return TiledRenderer(*settings, rows=rows)


def _wider(scene: Scene) -> Scene:
    """A scene whose terrain has temperatures beyond its own, as tiles may."""
    first, *rest = scene.surfaces
    kelvin = first.temperature.copy()
    low, high = (limit([limit(each.temperature) for each in scene.surfaces]) for limit in (np.min, np.max))
    kelvin.flat[0], kelvin.flat[-1] = low - _WIDER_K, high + _WIDER_K
    if scene.temperature_state.source is None:
        return scene.with_surfaces([replace(first, temperature=kelvin), *rest])
    assert scene.time is not None
    return scene.with_solved_temperatures(scene.time, [kelvin, *(each.temperature for each in rest)])
