"""A palette: each CIELAB cell has the mean intensity, linear in band radiance, of its training pixels."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.learned.pixel_features import lab
from thermorender.learned.temperature_map import Inputs

# sRGB has −128…128 in a and b and 0…100 in L of CIELAB: a cube of this side holds it.
_SIDE = 256.0
_FINEST, _COARSEST = 2.0, 64.0
# Pixels whose colours are computed at a time.
_CHUNK = 1 << 20


@dataclass(frozen=True, eq=False)
class Palette:
    """Intensity of each cell of CIELAB."""

    cell: float  # Side of a cell
    value: np.ndarray  # (n, n, n) float64 intensity, by cells of L, a and b; n is a power of two
    count: np.ndarray  # (n, n, n) int64 training pixels of each cell

    needs: ClassVar[tuple[str, ...]] = ()
    above_air: ClassVar[bool] = False

    @classmethod
    def empty(cls, cell: float) -> "Palette":
        """Return a Palette of intensity 0 without training pixels; the side of a cell is 2…64."""
        if not _FINEST <= cell <= _COARSEST:
            raise ThermorenderError(
                f"cell={cell:g} is not allowed for a palette; give {_FINEST:g}…{_COARSEST:g}, in units of CIELAB"
            )
        shape = (_cells_along(cell),) * 3
        return cls(cell, np.zeros(shape), np.zeros(shape, np.int64))

    def cells(self, rgb: np.ndarray) -> np.ndarray:
        """Return the flat index of each colour's cell, (...) int64, of (..., 3) uint8 sRGB."""
        flat, along = rgb.reshape(-1, 3), len(self.value)
        offset, cell = np.array((0.0, 128.0, 128.0), np.float32), np.float32(self.cell)
        found = np.empty(len(flat), np.int64)
        for start in range(0, len(flat), _CHUNK):
            index = ((lab(flat[start : start + _CHUNK]) + offset) / cell).astype(int)
            np.clip(index, 0, along - 1, out=index)
            found[start : start + _CHUNK] = (index[:, 0] * along + index[:, 1]) * along + index[:, 2]
        return found.reshape(rgb.shape[:-1])

    def predict(self, inputs: Inputs, texel_m: float | None) -> np.ndarray:
        """Return intensity, (h, w) float64, by colour alone, at any ground sampling distance."""
        return self.value.ravel()[self.cells(inputs.rgb)]

    def reach(self, spacing: float = 1.0) -> int:
        """Return the radius of the neighbourhood [pixels]: 0, colour alone counts."""
        return 0

    def unseen(self, inputs: Inputs) -> np.ndarray:
        """Return where a pixel's cell has no training pixels, (h, w) bool."""
        return self.count.ravel()[self.cells(inputs.rgb)] == 0

    def header(self) -> dict[str, Any]:
        """Return its entries in the file's header."""
        return {"cell": self.cell}

    def arrays(self) -> dict[str, np.ndarray]:
        """Return its arrays in the file."""
        return {"value": self.value, "count": self.count}

    @classmethod
    def of(cls, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> "Palette":
        """Return the Palette of `header` and `arrays`."""
        found = cls(float(header["cell"]), np.asarray(arrays["value"], np.float64), arrays["count"])
        if not _FINEST <= found.cell <= _COARSEST or not np.isfinite([found.value, found.count]).all():
            raise ValueError("its cells have a wrong size, or values that are not finite")
        if found.value.shape != found.count.shape or found.value.shape != (_cells_along(found.cell),) * 3:
            raise ValueError("its arrays have a wrong shape")
        return found


def _cells_along(cell: float) -> int:
    """Number of cells of this side along each axis of the cube: a power of two."""
    return 2 ** int(np.ceil(np.log2(_SIDE / cell)))
