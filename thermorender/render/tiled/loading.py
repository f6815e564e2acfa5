"""Tiles on their way to memory: from disk, from a thread that reads ahead, or baked now."""

import os
from collections.abc import Collection
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from random import Random
from threading import RLock

import numpy as np

from thermorender.progress import interactive
from thermorender.render.baked import Progress
from thermorender.render.tiled.baked_tile import BakedTile, TileStore
from thermorender.render.tiled.squares import Squares
from thermorender.render.tiled.texel_memory import SLOTS, TexelMemory
from thermorender.scene.tile_grid import APRON, Tile

# Threads that read tiles: most of a tile's time is its checksum and the means of its texels.
_THREADS = 2
# Memory of tiles up to which others are read beside them [bytes].
_AHEAD_BYTES = 1.8e9


@dataclass(eq=False)
class TileLoader:
    """Brings tiles to memory."""

    store: TileStore
    squares: Squares
    progress: Progress | None
    note: str | None = None  # Why baked tiles could not be kept on disk
    _ahead: "list[Future[bool]]" = field(default_factory=list)

    def __post_init__(self) -> None:
        """Begin with an empty memory."""
        side = self.squares.world.grid.texels + 2 * APRON
        self.memory = TexelMemory(side, self.squares.plan.spectrum.channels)
        self._bare = set[Tile]()
        # Held by one who makes a renderer of what is in memory.
        self.lock = RLock()
        self._threads = ThreadPoolExecutor(_THREADS)

    def load(self, tiles: Collection[Tile]) -> TexelMemory:
        """Return the memory with these tiles alone; those without ground are left out."""
        self._wait()
        self.memory.keep(tiles)
        absent = [tile for tile in self._wanted(tiles) if not self.store.has(tile)]
        if (absent and all(map(self.store.has, self.memory.tiles))) or not self.memory.room_for(tiles):
            # A bake takes a gigabyte; tiles that are on disk need not be in memory meanwhile.
            self.memory = self.memory.emptied(max(SLOTS, 2 * len(tiles)))
        self._bake(absent, False)
        wanted = self._wanted(tiles)
        reads = [self._threads.submit(self._read, tile) for tile in wanted]
        wait(reads)
        self._bake([tile for tile, read in zip(wanted, reads, strict=True) if not read.result()], True)
        return self.memory

    def keep_colours(self) -> None:
        """Keep the colours of tiles from now on; those in memory are forgotten."""
        self._wait()
        self.memory.keep_colours()

    def _wait(self) -> None:
        """Wait for the tiles that are read ahead; what could not be read is read again where it is needed."""
        wait(self._ahead)
        self._ahead = []

    def _wanted(self, tiles: Collection[Tile]) -> list[Tile]:
        """Tiles that are neither in memory nor known to be without ground."""
        return [tile for tile in tiles if tile not in self.memory.tiles and tile not in self._bare]

    def _bake(self, tiles: Collection[Tile], put: bool) -> None:
        """Bake tiles, with those of their squares, and store them; put them in memory, or only those not stored."""
        squares = sorted({self.squares.of(tile) for tile in tiles})
        # Processes that share a cache begin with different squares, and find those of the others.
        Random(os.getpid()).shuffle(squares)
        with interactive(self.progress) as report:
            for number, first in enumerate(squares):
                if report:
                    report(f"baking tiles: square {number + 1} of {len(squares)}", number / len(squares))
                if not put and all(self.store.has(tile) for tile in tiles if self.squares.of(tile) == first):
                    continue
                for tile, baked in self.squares.bake(first).items():
                    note = self.store.store(tile, baked)
                    self.note = note or self.note
                    if tile in tiles and (put or note):
                        self._put(tile, baked)

    def read_ahead(self, tiles: Collection[Tile]) -> None:
        """Begin to read tiles that are on disk, as many as there is room for beside the others in memory."""
        wanted = self._wanted(tiles)
        room = _AHEAD_BYTES - self.memory.bytes_of(self.memory.tiles)
        ends = np.cumsum([self.memory.bytes_of([tile]) for tile in wanted])
        wanted = wanted[: int(np.searchsorted(ends, room, side="right"))]
        if self.memory.room_for(wanted):
            self._ahead += [self._threads.submit(self._read, tile) for tile in wanted]

    def _read(self, tile: Tile) -> bool:
        """Whether a tile was on disk, and is in memory now where it has ground."""
        stored, baked = self.store.load(tile)
        if stored:
            self._put(tile, baked)
        return stored

    def _put(self, tile: Tile, baked: BakedTile | None) -> None:
        if baked is None:
            self._bare.add(tile)
        else:
            self.memory.put(tile, baked)
