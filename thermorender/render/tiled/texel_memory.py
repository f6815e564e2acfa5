"""Texels of tiles in memory: each tile in a slot of arrays that the kernels read in place.

The arrays have many more slots than a view needs. The system gives memory to the pages that were written only, and
those of a tile that is no longer needed go back to it.
"""

import mmap
from collections.abc import Collection, Iterable
from dataclasses import replace
from math import prod
from threading import RLock
from typing import Any
from weakref import finalize

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError
from thermorender.physics.srgb import linear_from_bytes
from thermorender.render.arrays import Channels, Mitsuba, widths
from thermorender.render.geometry import Slots
from thermorender.render.layers import KeptTexels
from thermorender.render.pixels import pyramid
from thermorender.render.tiled.baked_tile import BakedTile
from thermorender.scene.surface import FILLED
from thermorender.scene.tile_grid import Tile

# Slots of a memory, and numbers of texels, which are below 2³¹.
SLOTS, _MOST = 768, 2**31 - 1


class _Pages:
    """An array in memory of its own, parts of which can be given back."""

    def __init__(self, shape: tuple[int, ...], dtype: type[np.generic]) -> None:
        # Pages of a shared map would stay in memory.
        private = {"flags": mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS} if hasattr(mmap, "MAP_PRIVATE") else {}
        self._map = mmap.mmap(-1, max(prod(shape) * np.dtype(dtype).itemsize, 1), **private)
        self.array: NDArray[Any] = np.frombuffer(self._map, dtype, prod(shape)).reshape(shape)

    def forget(self, part: NDArray[Any]) -> None:
        """Give the whole pages of a contiguous part back to the system, where it takes them; they are zero then."""
        if hasattr(mmap, "MADV_DONTNEED"):
            start = part.ctypes.data - self.array.ctypes.data
            first = -(-start // mmap.PAGESIZE) * mmap.PAGESIZE
            length = (start + part.nbytes) // mmap.PAGESIZE * mmap.PAGESIZE - first
            if length > 0:
                self._map.madvise(mmap.MADV_DONTNEED, first, length)


class _Lease:
    """Keeps slots as long as it lives."""


class TexelMemory:
    """Texels of `side`² a tile with their means over squares; `tiles` are BakedTiles without what is kept here.

    Renderers of earlier cells, which frames may hold, keep their slots. Threads may call all methods.
    """

    def __init__(self, side: int, channels: int, slots: int = SLOTS) -> None:
        count = [rows * columns for rows, columns in pyramid.sizes(side, side)]
        if slots * sum(count) > _MOST:
            raise ThermorenderError(
                f"the view needs more than {_MOST // sum(count) // 2} tiles; give a camera of fewer pixels"
            )
        self.slots, self._side, self._count, self._channels = slots, side, count, channels
        self.tiles, self._slot = dict[Tile, BakedTile](), dict[Tile, int]()
        # How many KeptTexels use each slot.
        self._users, self._lock = np.zeros(slots, np.int64), RLock()
        self._first = _Pages((slots * sum(count), 1), np.float32)
        self._rest = [_Pages((slots * sum(count), width), np.float16) for width in widths(channels - 1)]
        # Level that the latter begin with in each slot.
        self._finest = np.zeros(slots, np.uint32)
        shape = slots, side, side
        self._material, self._flags = _Pages(shape, np.uint8), _Pages(shape, np.uint8)
        self._temperature = _Pages(shape, np.float32)
        # Linear colours, and 1 where they are known; None until they are asked for.
        self._colour: _Pages | None = None

    def emptied(self, slots: int) -> "TexelMemory":
        """Return another memory of the same kind without tiles."""
        found = TexelMemory(self._side, self._channels, slots)
        if self.coloured:
            found.keep_colours()
        return found

    @property
    def coloured(self) -> bool:
        """Whether colours are kept."""
        return self._colour is not None

    def room_for(self, tiles: Collection[Tile]) -> bool:
        """Return whether tiles find slots, if those in memory stay."""
        return len(set(tiles).difference(self.tiles)) <= len(self.free)

    def bytes_of(self, tiles: Iterable[Tile]) -> float:
        """Return about the memory that tiles take [bytes]."""
        half = 2.0 * (self._channels - 1)
        colour = 8.0 if self.coloured else 0.0
        # Material, flags and temperature are without means over squares.
        return sum(6.0 * self._count[0] + sum(self._count) * (4.0 + colour + half * (0.25 if tile.level else 1.0))
                   for tile in tiles)  # fmt: skip

    @property
    def free(self) -> NDArray[np.int64]:
        """Slots that neither a tile nor a KeptTexels uses."""
        used = self._users > 0
        used[list(self._slot.values())] = True
        return np.flatnonzero(~used)

    def put(self, tile: Tile, baked: BakedTile) -> None:
        """Keep a tile that is not in memory."""
        with self._lock:
            slot = self._slot[tile] = int(self.free[0])
        for number, level in enumerate(_levels(baked.first[..., None])):
            self._part(self._first.array, number, slot)[...] = level.reshape(-1, 1)
        finest = self._finest[slot] = int(baked.rest.shape[0] < self._side)
        ends = np.cumsum(widths(baked.rest.shape[-1]))[:-1]
        for number, level in enumerate(_levels(baked.rest.astype(np.float32)), start=finest):
            for kept, part in zip(self._rest, np.split(level, ends, axis=-1), strict=bool(self._rest)):
                self._part(kept.array, number, slot)[...] = part.reshape(-1, kept.array.shape[1])
        if self._colour is not None:
            known = (baked.flags & FILLED) == 0
            colour = np.concatenate([linear_from_bytes(baked.colour), known[..., None]], axis=-1, dtype=np.float32)
            for number, level in enumerate(_levels(colour)):
                self._part(self._colour.array, number, slot)[...] = level.reshape(-1, 4)
        material, flags, temperature = (each.array[slot] for each in (self._material, self._flags, self._temperature))
        material[...], flags[...], temperature[...] = baked.material, baked.flags, baked.temperature
        left = replace(
            baked, material=material, flags=flags, temperature=temperature, first=baked.first[:0].copy(),
            rest=baked.rest[:0].copy(), colour=np.broadcast_to(np.uint8(0), baked.colour.shape),
        )  # fmt: skip
        self.tiles[tile] = left

    def keep(self, tiles: Iterable[Tile]) -> None:
        """Forget all tiles but some."""
        with self._lock:
            gone = set(self._slot).difference(tiles)
            slots = [self._slot.pop(tile) for tile in gone]
            for tile in gone:
                self.tiles.pop(tile, None)
            self._give_back(slots)

    def keep_colours(self) -> None:
        """Keep the colours of tiles from now on; those in memory are forgotten."""
        self._colour = _Pages((self.slots * sum(self._count), 4), np.float16)
        self.keep(())

    def texels(self, mi: Mitsuba, tiles: Iterable[Tile]) -> tuple[KeptTexels, Slots]:
        """Return (texels for kernels, the Slots of tiles). The slots are kept as long as the texels are."""
        rest = Channels.of_arrays(mi, [each.array for each in self._rest], coarse=True) if self._rest else None
        first = Channels.of_arrays(mi, [self._first.array])
        colours = None if self._colour is None else Channels.of_arrays(mi, [self._colour.array])
        material, flags, temperature = (each.array.reshape(-1)
                                        for each in (self._material, self._flags, self._temperature))  # fmt: skip
        found = KeptTexels(first, rest, material, flags, temperature, _Lease(), colours=colours)
        with self._lock:
            slot = np.array([self._slot[tile] for tile in tiles], np.int64)
            self._users[slot] += 1
        finalize(found.lease, self._release, slot)
        return found, Slots(self.slots, slot, self._finest.copy())

    def _release(self, slots: NDArray[np.int64]) -> None:
        with self._lock:
            self._users[slots] -= 1
            self._give_back(slots)

    def _give_back(self, slots: Iterable[int]) -> None:
        """Give the memory of slots back that are free."""
        by_texel = [each for each in (self._first, *self._rest, self._colour) if each is not None]
        for slot in set(slots).intersection(self.free.tolist()):
            for pages in by_texel:
                for level in range(len(self._count)):
                    pages.forget(self._part(pages.array, level, slot))
            for pages in (self._material, self._flags, self._temperature):
                pages.forget(pages.array[slot])

    def _part(self, whole: NDArray[np.floating], level: int, slot: int) -> NDArray[np.floating]:
        """The squares of a level of a slot."""
        first = self.slots * sum(self._count[:level]) + slot * self._count[level]
        return whole[first : first + self._count[level]]


def _levels(values: NDArray[np.float32]) -> list[NDArray[np.float32]]:
    """Texels (rows, columns, C) and their means over squares of 2, 4, 8 … a side."""
    return [values, *pyramid.squares(values)]
