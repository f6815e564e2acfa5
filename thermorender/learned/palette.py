"""A palette: each cell of colour space has the mean intensity of the training pixels of that colour.

Cells are cubes of CIELAB. The mean of a cell with few pixels is shrunk towards that of the cell twice as wide around
it, and so on up to the whole; an unseen colour has the wider cell's value. Intensity is linear in band radiance, so
these are means of radiance.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.learned.features import lab
from thermorender.learned.temperature_map import Inputs
from thermorender.learned.training import Task

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

    needs = ()
    above_air = False

    def predict(self, inputs: Inputs, texel_m: float) -> np.ndarray:
        """Return intensity, (h, w) float64, by colour alone, at any ground sampling distance."""
        return self.value.ravel()[cells(inputs.rgb, self.cell, len(self.value))]

    def reach(self, spacing: float = 1.0) -> int:
        """Return the radius of the neighbourhood [pixels]: 0, colour alone counts."""
        return 0

    def unseen(self, inputs: Inputs) -> np.ndarray:
        """Return where a pixel's cell has no training pixels, (h, w) bool."""
        return self.count.ravel()[cells(inputs.rgb, self.cell, len(self.value))] == 0

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
        if found.value.shape != found.count.shape or found.value.shape != (cells_along(found.cell),) * 3:
            raise ValueError("its arrays have a wrong shape")
        return found


def cells_along(cell: float) -> int:
    """Return the number of cells of this side along each axis of the cube: a power of two."""
    return 2 ** int(np.ceil(np.log2(_SIDE / cell)))


def cells(rgb: np.ndarray, cell: float, along: int) -> np.ndarray:
    """Return each colour's cell, (h, w) int64: its flat index along L, a and b, as by `numpy.ravel_multi_index`."""
    flat = rgb.reshape(-1, 3)
    found = np.empty(len(flat), np.int64)
    for start in range(0, len(flat), _CHUNK):
        index = ((lab(flat[start : start + _CHUNK]) + np.float32((0.0, 128.0, 128.0))) / np.float32(cell)).astype(int)
        np.clip(index, 0, along - 1, out=index)
        found[start : start + _CHUNK] = (index[:, 0] * along + index[:, 1]) * along + index[:, 2]
    return found.reshape(rgb.shape[:-1])


def fit_palette(task: Task) -> Palette:
    """Return the Palette trained on a Task.

    Options: `cell`, a cell's side in CIELAB, and `shrinkage`, the number of pixels at which a cell's own mean counts as
    much as the wider cell's.
    """
    cell, shrinkage = float(task.options["cell"]), float(task.options["shrinkage"])
    if not _FINEST <= cell <= _COARSEST:
        raise ThermorenderError(
            f"cell={cell:g} is not allowed for a palette; give {_FINEST:g}…{_COARSEST:g}, in units of CIELAB"
        )
    if not 0.0 <= shrinkage < np.inf:
        raise ThermorenderError(f"shrinkage={shrinkage:g} is not allowed; give a number of pixels of 0 or more")
    along = cells_along(cell)
    total, count = np.zeros(along**3), np.zeros(along**3, np.int64)
    for number, example in enumerate(task.examples):
        intensity = task.intensity[example.values]
        usable = example.valid & np.isfinite(intensity)
        place = cells(example.inputs.rgb[usable], cell, along)
        count += np.bincount(place, minlength=count.size)
        total += np.bincount(place, intensity[usable], total.size)
        task.progress("counting colours", (number + 1) / len(task.examples))
    if not count.any():
        raise ThermorenderError(
            f"none of {len(task.examples)} pairs has a valid pixel to learn from; give pairs whose pictures overlap"
        )
    shape = (along,) * 3
    return Palette(cell, shrunk(total.reshape(shape), count.reshape(shape), shrinkage), count.reshape(shape))


def shrunk(total: np.ndarray, count: np.ndarray, shrinkage: float) -> np.ndarray:
    """Return the mean of each cell, (n, n, n) float64, shrunk towards that of the cell twice as wide around it.

    Parameters
    ----------
    total, count : (n, n, n)
        Sum and number of a cell's values; n is a power of two, and at least one cell is not empty.
    shrinkage : float
        The weight of the cell's own mean is count / (count + shrinkage).
    """
    n = len(count)
    if n == 1:
        return total / count
    wide = [image.reshape(n // 2, 2, n // 2, 2, n // 2, 2).sum(axis=(1, 3, 5)) for image in (total, count)]
    around = shrunk(*wide, shrinkage).repeat(2, axis=0).repeat(2, axis=1).repeat(2, axis=2)
    weight = count + shrinkage
    # An empty cell without shrinkage has the wider cell's mean.
    alone = weight == 0.0
    return np.where(alone, around, (total + shrinkage * around) / np.where(alone, 1.0, weight))
