"""Pixels drawn from the examples of a Task, for maps that learn from single pixels."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from thermorender.apps.training.task import Task
from thermorender.errors import ThermorenderError
from thermorender.learned.rows import ExtraInputs, at_shape, at_texel
from thermorender.learned.temperature_map import Inputs

# Side of the window of a picture that pixels are drawn from [pixels]; features of a whole one take five times as long.
_WINDOW = 256


@dataclass(frozen=True, eq=False)
class Drawn:
    """Pixels drawn from an example."""

    number: int  # Index of the example
    inputs: Inputs  # At the map's ground sampling distance
    # (4,) ints first row, end row, first column and end column of the window that holds them
    window: tuple[int, int, int, int]
    pixels: np.ndarray  # (n,) int row times width plus column, ascending
    target: np.ndarray  # (n,) float64 intensity, or apparent temperature above the air's [K]


def drawn(task: Task, extra: ExtraInputs, most: int) -> Iterator[Drawn]:
    """Yield the Drawn of each example of a Task: at most `most` pixels from a window around a random valid pixel."""
    generator = np.random.Generator(np.random.Philox(task.seed))
    empty = True
    for number, example in enumerate(task.examples):
        extra.check(example.inputs)
        inputs = at_texel(example.inputs, task.texel_m)
        if extra.above_air:
            target = task.temperature[example.values] - inputs.conditions["air_k"]
        else:
            target = task.intensity[example.values]
        usable = example.valid & np.isfinite(target)
        shape = inputs.rgb.shape[:2]
        if shape != target.shape:
            # Only pixels that are valid over their whole area.
            target = at_shape(np.where(usable, target, 0.0), shape)
            usable = at_shape(usable.astype(np.float32), shape) > 0.999
        window = _window(usable, generator)
        inside = np.zeros(shape, bool)
        inside[window[0] : window[1], window[2] : window[3]] = True
        pixels = np.flatnonzero(usable & inside)
        if pixels.size > most:
            pixels = np.sort(generator.choice(pixels, most, replace=False))
        empty &= pixels.size == 0
        yield Drawn(number, inputs, window, pixels, target.ravel()[pixels])
        task.progress("reading", (number + 1) / len(task.examples))
    if empty:
        raise ThermorenderError(
            f"none of {len(task.examples)} pairs has a valid pixel to learn from; give pairs whose pictures overlap"
        )


def _window(usable: np.ndarray, generator: np.random.Generator) -> tuple[int, int, int, int]:
    """Random window (first row, end row, first column, end column) around a usable pixel."""
    within = np.flatnonzero(usable)
    if not within.size:
        return 0, 0, 0, 0
    at = np.divmod(within[generator.integers(within.size)], usable.shape[1])
    top, left = (
        int(np.clip(place - generator.integers(_WINDOW), 0, max(size - _WINDOW, 0)))
        for place, size in zip(at, usable.shape, strict=True)
    )
    height, width = usable.shape
    return top, min(top + _WINDOW, height), left, min(left + _WINDOW, width)
