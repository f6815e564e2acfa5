"""Tiles on their way to memory: from disk, from a thread that reads ahead, or baked now."""

from collections.abc import Collection
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field

from thermorender.cache import LIMITS, trim
from thermorender.progress import interactive
from thermorender.render.baked import Progress
from thermorender.render.tiled.baked_tile import TileStore
from thermorender.render.tiled.squares import Squares
from thermorender.render.tiled.texel_memory import SLOTS, TexelMemory
from thermorender.scene.tile_grid import APRON, Tile

# Threads that read tiles: most of a tile's time is its checksum and the means of its texels.
_THREADS = 2


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
        self.memory = self._memory()
        self._bare = set[Tile]()
        self._threads = ThreadPoolExecutor(_THREADS)

    def _memory(self, slots: int = SLOTS) -> TexelMemory:
        side = self.squares.world.grid.texels + 2 * APRON
        return TexelMemory(side, self.squares.plan.spectrum.channels, slots)

    def load(self, tiles: Collection[Tile]) -> TexelMemory:
        """Return the memory with these tiles alone; those without ground are left out."""
        for each in self._ahead:
            each.result()
        self._ahead = []
        self.memory.keep(tiles)
        if not self.memory.room_for(tiles):
            coloured = self.memory.coloured
            self.memory = self._memory(1 << (2 * len(tiles)).bit_length())
            if coloured:
                self.memory.keep_colours()
        wanted = [tile for tile in tiles if tile not in self.memory.tiles and tile not in self._bare]
        stored = list(self._threads.map(self._read, wanted))
        missing = {tile for tile, found in zip(wanted, stored, strict=True) if not found}
        squares = sorted({self.squares.of(tile) for tile in missing})
        with interactive(self.progress) as report:
            for number, first in enumerate(squares):
                if report:
                    report(f"baking tiles: square {number + 1} of {len(squares)}", number / len(squares))
                trim("tiles", LIMITS["tiles"])
                for tile, baked in self.squares.bake(first).items():
                    self.note = self.store.store(tile, baked) or self.note
                    if tile not in missing:
                        continue
                    if baked is None:
                        self._bare.add(tile)
                    else:
                        self.memory.put(tile, baked)
        return self.memory

    def read_ahead(self, tiles: Collection[Tile]) -> None:
        """Begin to read tiles that are on disk, beside the others in memory, where there is room."""
        wanted = [tile for tile in tiles if tile not in self.memory.tiles and tile not in self._bare]
        if self.memory.room_for(wanted):
            self._ahead += [self._threads.submit(self._read, tile) for tile in wanted]

    def _read(self, tile: Tile) -> bool:
        """Whether a tile was on disk, and is in memory now where it has ground."""
        stored, baked = self.store.load(tile)
        if stored and baked is None:
            self._bare.add(tile)
        elif baked is not None:
            self.memory.put(tile, baked)
        return stored
