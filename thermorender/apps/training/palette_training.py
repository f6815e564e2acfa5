"""Training of a Palette: means of colour cells, each shrunk towards that of the cell twice as wide around it."""

from dataclasses import replace

import numpy as np

from thermorender.apps.training.task import Task
from thermorender.errors import ThermorenderError
from thermorender.learned.palette import Palette


def fit_palette(task: Task) -> Palette:
    """Return the Palette trained on a Task.

    Options: `cell`, side of a cell in CIELAB; `shrinkage`, pixels at which a cell's mean has half the weight.
    """
    empty, shrinkage = Palette.empty(float(task.options["cell"])), float(task.options["shrinkage"])
    if not 0.0 <= shrinkage < np.inf:
        raise ThermorenderError(f"shrinkage={shrinkage:g} is not allowed; give a number of pixels of 0 or more")
    total, count = empty.value.ravel(), empty.count.ravel()
    for number, example in enumerate(task.examples):
        intensity = task.intensity[example.values]
        usable = example.valid & np.isfinite(intensity)
        place = empty.cells(example.inputs.rgb[usable])
        count += np.bincount(place, minlength=count.size)
        total += np.bincount(place, intensity[usable], total.size)
        task.progress("counting colours", (number + 1) / len(task.examples))
    if not count.any():
        raise ThermorenderError(
            f"none of {len(task.examples)} pairs has a valid pixel to learn from; give pairs whose pictures overlap"
        )
    shape = empty.value.shape
    return replace(empty, value=_shrunk(total.reshape(shape), count.reshape(shape), shrinkage),
                   count=count.reshape(shape))  # fmt: skip


def _shrunk(total: np.ndarray, count: np.ndarray, shrinkage: float) -> np.ndarray:
    """Return the mean of each cell, (n, n, n), of weight count / (count + shrinkage); the wider cell has the rest."""
    n = len(count)
    if n == 1:
        return total / count
    wide = [image.reshape(n // 2, 2, n // 2, 2, n // 2, 2).sum(axis=(1, 3, 5)) for image in (total, count)]
    around = _shrunk(wide[0], wide[1], shrinkage).repeat(2, axis=0).repeat(2, axis=1).repeat(2, axis=2)
    weight = count + shrinkage
    # An empty cell without shrinkage has the wider cell's mean.
    alone = weight == 0.0
    return np.where(alone, around, (total + shrinkage * around) / np.where(alone, 1.0, weight))
