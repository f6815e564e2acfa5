"""A training task: the data and settings that every method fits a map to."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from thermorender.learned.temperature_map import Inputs


@dataclass(frozen=True, eq=False)
class Example:
    """A training picture."""

    inputs: Inputs
    values: np.ndarray  # (h, w) uint16 pixels of the thermal picture
    valid: np.ndarray  # (h, w) bool where photograph and thermal picture show the same


@dataclass(frozen=True, eq=False)
class Task:
    """A training task."""

    examples: Sequence[Example]  # Each is read when it is accessed
    # (n,) float64 intensity of each pixel value of the thermal pictures; n is one more than the largest value
    intensity: np.ndarray
    temperature: np.ndarray  # (n,) float64 apparent temperature of each pixel value [K]
    seed: int
    progress: Callable[[str, float], object]  # Called with (what, share done)
    options: dict[str, Any]  # Options of the method, as in `training_methods.Method.options`
    # Ground sampling distance that the map will be applied at [m]; methods that use texture learn at it. None takes
    # the pictures as they are.
    texel_m: float | None = None
    # Finest and coarsest ground sampling distance of the pictures [m]; None: unknown
    texel_range_m: tuple[float, float] | None = None
    # (count,) bool examples for early stopping, not learned from; None lets the method choose
    held_out: np.ndarray | None = None
    # Folder for checkpoints, log and sample pictures of a long training; None for other methods
    run: Path | None = None
    resume: bool = False  # Continue the training in that folder
    best: bool = False  # Take the best state so far in that folder, without training on
