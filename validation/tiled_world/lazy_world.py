"""A square world by a seed, of 100 km unless its side is stated: heights, classes and colours are functions of the
place, made where they are read.

Heights are sums of smooth noise of wavelengths from 32 km to 4 m (value noise between hashed lattice points, with the
amplitude rising as the wavelength to the power 0.85). A grid reads only wavelengths that its pixels resolve, as an
overview does. Classes follow from heights, from fields and from patches of vegetation.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from thermorender.scene.raster import Grid
from thermorender.scene.sources import Extent

_Floats = NDArray[np.float64]
# Side of the large world [m], and pixels of heights and of colours and classes [m].
SIDE_M, POST_M, TEXEL_M = 102_400.0, 2.0, 0.25
CRS = "EPSG:32634"
LEFT, TOP = 450_000.0, 5_800_000.0
CLASSES = {
    1: "grass_dry", 2: "grass_green", 3: "heath_shrub", 4: "sand_quartz", 5: "water", 6: "soil_dark", 7: "soil_loam",
    8: "asphalt",
}  # fmt: skip
_COLOURS = np.array(
    [[0, 0, 0], [150, 140, 90], [80, 110, 50], [90, 85, 60], [200, 185, 150], [40, 60, 80], [90, 70, 55],
     [130, 105, 80], [90, 90, 95]], np.float32,
)  # fmt: skip
_RELIEF_M, _ROUGHNESS = 500.0, 0.85


def _hashed(column: NDArray[np.integer], row: NDArray[np.integer], seed: int) -> _Floats:
    """Numbers −1…1 of lattice points."""
    key = column.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15) ^ row.astype(np.uint64) * np.uint64(
        0xC2B2AE3D27D4EB4F
    ) ^ np.uint64(seed * 0x165667B19E3779F9 & 0xFFFFFFFFFFFFFFFF)  # fmt: skip
    key = (key ^ key >> np.uint64(29)) * np.uint64(0xBF58476D1CE4E5B9)
    key = (key ^ key >> np.uint64(32)) * np.uint64(0x94D049BB133111EB)
    found: _Floats = (key >> np.uint64(11)).astype(np.float64) * 2.0**-52 - 1.0
    return found


def _noise(x: _Floats, y: _Floats, wavelength: float, seed: int) -> NDArray[np.float32]:
    """Smooth noise −1…1 on the lattice of coordinates (n,) and (m,), (m, n); single precision, for speed."""
    u, v = x / wavelength, y / wavelength
    i, j = np.floor(u).astype(np.int64), np.floor(v).astype(np.int64)
    across, along = np.arange(i.min(), i.max() + 2), np.arange(j.min(), j.max() + 2)
    value = _hashed(*np.meshgrid(across, along), seed).astype(np.float32)
    fade = lambda t: (t * t * (3.0 - 2.0 * t)).astype(np.float32)  # noqa: E731
    fu, fv = fade(u - i), fade(v - j)
    i, j = i - across[0], j - along[0]
    rows = value[:, i] * (1.0 - fu) + value[:, i + 1] * fu
    found: NDArray[np.float32] = np.diff(rows, axis=0)[j]
    found *= fv[:, None]
    found += rows[j]
    return found


def _axes(grid: Grid) -> tuple[_Floats, _Floats]:
    """East and south of a grid's pixels from the upper left corner of the world [m]."""
    x, _ = grid.to_map(np.arange(grid.width) + 0.5, 0.5)
    _, y = grid.to_map(0.5, np.arange(grid.height) + 0.5)
    return np.asarray(x) - LEFT, TOP - np.asarray(y)


# Bytes that were read so far.
READ = [0]


@dataclass(frozen=True)
class _Lazy:
    seed: int
    pixel: float
    side: float = SIDE_M
    pixel_bytes: ClassVar[int]

    @property
    def extent(self) -> Extent:
        """The whole world."""
        from rasterio.crs import CRS as Crs

        return Extent(Crs.from_string(CRS), (LEFT, TOP - self.side, LEFT + self.side, TOP), self.pixel, (LEFT, TOP))

    def size(self) -> int:
        """Bytes of the whole world."""
        return round(self.side / self.pixel) ** 2 * self.pixel_bytes

    def digest(self) -> str:
        """Return a fingerprint of the world."""
        return f"{type(self).__name__} {self.seed} {self.pixel} {self.side}"


class LazyHeights(_Lazy):
    """Heights [m]; NaN beyond the world."""

    pixel_bytes = 4

    def read(self, grid: Grid) -> _Floats:
        """Return heights on a grid, (h, w)."""
        x, y = _axes(grid)
        READ[0] += grid.width * grid.height * self.pixel_bytes
        found = self.at(x, y, abs(grid.transform.a))
        beyond = [(each < 0.0) | (each > self.side) for each in (x, y)]
        found[beyond[1]] = np.nan
        found[:, beyond[0]] = np.nan
        return found

    def at(self, x: _Floats, y: _Floats, pixel: float) -> _Floats:
        """Return heights at coordinates (n,) and (m,) with wavelengths that pixels resolve, (m, n)."""
        found, wavelength = np.full((len(y), len(x)), 700.0), 32_768.0
        while wavelength >= max(2.0 * pixel, 4.0):
            found += _RELIEF_M * (wavelength / 32_768.0) ** _ROUGHNESS * _noise(x, y, wavelength, self.seed)
            wavelength *= 0.5
        return found


class LazyClasses(_Lazy):
    """Class numbers of `CLASSES`."""

    pixel_bytes = 1

    def read(self, grid: Grid) -> NDArray[np.uint8]:
        """Return classes on a grid, (h, w)."""
        READ[0] += grid.width * grid.height * self.pixel_bytes
        return self.numbers(grid)

    def numbers(self, grid: Grid) -> NDArray[np.uint8]:
        """Return classes on a grid, (h, w), which do not count as read."""
        x, y = _axes(grid)
        pixel = abs(grid.transform.a)
        height = LazyHeights(self.seed, self.pixel).at(x, y, max(pixel, 64.0))
        field = _noise(x, y, 900.0, self.seed + 1) + 0.5 * _noise(x, y, 210.0, self.seed + 2)
        patch, wavelength = np.zeros_like(field), 128.0
        while wavelength >= max(2.0 * pixel, 0.9):
            patch += (wavelength / 128.0) ** 0.35 * _noise(x, y, wavelength, self.seed + 3 + int(np.log2(wavelength)))
            wavelength *= 0.5
        found = np.where(field > 0.15, 2, 3).astype(np.uint8)
        found[(field > 0.15) & (patch > 0.35)] = 1
        found[(field <= 0.15) & (patch > 0.45)] = 4
        found[(field < -0.45) & (patch < 0.1)] = 7
        found[(field < -0.45) & (patch < -0.6)] = 6
        road = np.abs(_noise(x, y, 1500.0, self.seed + 4)) * 1500.0 < max(6.0, 0.5 * pixel)
        found[road] = 8
        found[height < 420.0] = 5
        return found


class LazyColours(_Lazy):
    """Colours by class, with noise."""

    pixel_bytes = 3

    def read(self, grid: Grid) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """Return (rgb (h, w, 3), where it is known)."""
        READ[0] += grid.width * grid.height * self.pixel_bytes
        number = LazyClasses(self.seed, self.pixel).numbers(grid)
        x, y = _axes(grid)
        light = 1.0 + 0.15 * _noise(x, y, max(1.5, 2.0 * abs(grid.transform.a)), self.seed + 5)
        rgb = np.clip(_COLOURS[number] * light[..., None], 0.0, 255.0).astype(np.uint8)
        return rgb, np.ones(number.shape, bool)
