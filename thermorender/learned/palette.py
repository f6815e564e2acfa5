"""A palette: each cell of colour space has an intensity, the mean of the training pixels of that colour.

Cells are cubes of CIELAB. A cell with few pixels says little, so its mean is drawn towards that of the cell twice as
wide around it, that one's towards the next wider, up to the whole; a colour never seen has the wider cell's. Intensity
is linear in band radiance, so its means are means of radiance.
"""

from dataclasses import dataclass

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.learned.features import lab

# CIELAB of sRGB lies within −128…128 in a and b, and 0…100 in L: a cube of this side holds it.
_SIDE = 256.0
_FINEST, _COARSEST = 2.0, 64.0
# Pixels whose colours are computed at a time.
_CHUNK = 1 << 20


@dataclass(frozen=True, eq=False)
class Palette:
    """Intensity of each cell of CIELAB.

    Attributes
    ----------
    cell : float
        Side of a cell.
    value : (n, n, n) float64
        Intensity, by cells of L, a and b; n is a power of two.
    count : (n, n, n) int64
        Pixels it was learned from.
    """

    cell: float
    value: np.ndarray
    count: np.ndarray

    needs = ()
    above_air = False

    def predict(self, inputs, texel_m):
        """Return intensity, (h, w) float64; each pixel's is that of its colour, at any ground sampling distance."""
        return self.value.ravel()[cells(inputs.rgb, self.cell, len(self.value))]

    def unseen(self, inputs):
        """Return where a pixel is of a colour never seen, (h, w) bool: its cell held none when it was trained."""
        return self.count.ravel()[cells(inputs.rgb, self.cell, len(self.value))] == 0

    def header(self):
        """Return what the file's text says of it."""
        return {"cell": self.cell}

    def arrays(self):
        """Return what the file holds of it."""
        return {"value": self.value, "count": self.count}

    @classmethod
    def of(cls, header, arrays):
        """Return the Palette of `header` and `arrays`."""
        found = cls(float(header["cell"]), np.asarray(arrays["value"], np.float64), arrays["count"])
        if not _FINEST <= found.cell <= _COARSEST or not np.isfinite([found.value, found.count]).all():
            raise ValueError("it has no cells, or values that are not finite")
        if found.value.shape != found.count.shape or found.value.shape != (cells_along(found.cell),) * 3:
            raise ValueError("no palette")
        return found


def cells_along(cell):
    """Return how many cells of this side the cube has along each axis: a power of two."""
    return 2 ** int(np.ceil(np.log2(_SIDE / cell)))


def cells(rgb, cell, along):
    """Return each colour's cell, (h, w) int64: its number along L, a and b in one, as `numpy.ravel_multi_index`."""
    flat = rgb.reshape(-1, 3)
    found = np.empty(len(flat), np.int64)
    for start in range(0, len(flat), _CHUNK):
        index = ((lab(flat[start : start + _CHUNK]) + np.float32((0.0, 128.0, 128.0))) / np.float32(cell)).astype(int)
        np.clip(index, 0, along - 1, out=index)
        found[start : start + _CHUNK] = (index[:, 0] * along + index[:, 1]) * along + index[:, 2]
    return found.reshape(rgb.shape[:-1])


def fit_palette(task):
    """Return the Palette that learns a Task.

    Its options: `cell`, a cell's side in CIELAB, and `shrinkage`, the number of pixels with which a cell's own mean
    weighs as much as the wider cell's.

    Raises
    ------
    ThermorenderError
        An option out of range, or no pixel to learn from.
    """
    cell, shrinkage = float(task.options["cell"]), float(task.options["shrinkage"])
    if not _FINEST <= cell <= _COARSEST:
        raise ThermorenderError(
            f"cell={cell:g} is no side of a palette's cells; give {_FINEST:g}…{_COARSEST:g}, in units of CIELAB"
        )
    if not 0.0 <= shrinkage < np.inf:
        raise ThermorenderError(f"shrinkage={shrinkage:g} is no number of pixels; give 0 or more")
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


def shrunk(total, count, shrinkage):
    """Return the mean of each cell, (n, n, n) float64, drawn towards that of the cell twice as wide around it.

    Parameters
    ----------
    total, count : (n, n, n)
        Sum and number of a cell's values; n is a power of two, and one cell at least holds some.
    shrinkage : float
        The cell's own mean weighs count / (count + shrinkage).
    """
    n = len(count)
    if n == 1:
        return total / count
    wide = [image.reshape(n // 2, 2, n // 2, 2, n // 2, 2).sum(axis=(1, 3, 5)) for image in (total, count)]
    around = shrunk(*wide, shrinkage).repeat(2, axis=0).repeat(2, axis=1).repeat(2, axis=2)
    weight = count + shrinkage
    # Nothing was seen, and nothing draws: the wider cell's.
    alone = weight == 0.0
    return np.where(alone, around, (total + shrinkage * around) / np.where(alone, 1.0, weight))
