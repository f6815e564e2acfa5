"""A baked tile: its ground, its temperatures and the radiance that leaves it; a value of arrays, kept on disk."""

import hashlib
import os
from contextlib import suppress
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thermorender import formats
from thermorender.cache import LIMITS, cache_folder, trim
from thermorender.errors import ThermorenderError
from thermorender.physics.geodesy import LocalFrame
from thermorender.scene.tile_grid import Tile

# A file of another version is not used: increase this when what a tile holds changes.
VERSION = 7


@dataclass(frozen=True, eq=False)
class BakedTile:
    """A tile with its light, from the square that it was baked in. Texels include the rim of `tile_grid.APRON`."""

    place: NDArray[np.float64]  # (3,) latitude, longitude [deg] and ellipsoid height [m] of the frame of its posts
    posts: NDArray[np.float32]  # (n, n, 3) local positions of the posts [m]; NaN where there is no ground
    material: NDArray[np.uint8]  # (h, w)
    colour: NDArray[np.uint8]  # (h, w, 3)
    flags: NDArray[np.uint8]  # (h, w)
    temperature: NDArray[np.float32]  # (h, w) [K]
    first: NDArray[np.float32]  # (h, w) radiance of the first channel [W m⁻² sr⁻¹]
    # (h, w, K − 1) of the others, about a hundredth of it: half precision is below a millikelvin. Of coarse tiles they
    # are means over squares of two texels a side, (h/2, w/2, K − 1), as their texels are far smaller than pixels
    rest: NDArray[np.float16]
    faces: NDArray[np.float16]  # (F, K) correction of each face [W m⁻² sr⁻¹]; (F, 0) where reflection is left out
    face_error: NDArray[np.float32]  # (F,) mean square error of the light [(W m⁻² sr⁻¹)²]; (0,) likewise
    errors_mk: NDArray[np.float64]  # (2,) solution and air of the square's light [mK]

    @property
    def frame(self) -> LocalFrame:
        """The LocalFrame of its posts."""
        return LocalFrame(*self.place.tolist())


@dataclass(frozen=True)
class TileStore:
    """Baked tiles on disk, for all that depends on the same things."""

    key: str  # Fingerprint of the scene, the ground, the settings and the versions

    def path(self, tile: Tile) -> Path:
        """Return the path of a tile's file; RuntimeError where no home folder exists."""
        name = hashlib.blake2b(f"{self.key} {tuple(tile)}".encode(), digest_size=20).hexdigest()
        return cache_folder("tiles") / f"{name}.npz"

    def load(self, tile: Tile) -> tuple[bool, BakedTile | None]:
        """Return (whether an undamaged file of a tile is stored, the tile; None where it has no ground)."""
        try:
            path = self.path(tile)
        except RuntimeError:
            return False, None
        found = formats.read_arrays(path, (self.key, tuple(tile)))
        if found is None:
            return False, None
        with suppress(OSError):
            # The modification time records when a file was last used.
            os.utime(path)
        return True, BakedTile(**found) if found else None

    def has(self, tile: Tile) -> bool:
        """Return whether a file of a tile is stored, undamaged or not."""
        with suppress(RuntimeError):
            return self.path(tile).is_file()
        return False

    def store(self, tile: Tile, baked: BakedTile | None) -> str | None:
        """Store a tile, or that it has no ground; return None, or why that failed."""
        arrays = {} if baked is None else {field.name: getattr(baked, field.name) for field in fields(baked)}
        try:
            path = self.path(tile)
            formats.write_arrays(path, (self.key, tuple(tile)), arrays)
            trim("tiles", LIMITS["tiles"], keep=path.name)
        except (OSError, RuntimeError, ThermorenderError) as error:
            return f"baked tiles are not kept: {error}; set THERMORENDER_CACHE to a writable folder"
        return None
