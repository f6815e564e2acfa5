"""Training of learned temperature maps: the data and settings of every method."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from thermorender.learned.temperature_map import Inputs


@dataclass(frozen=True, eq=False)
class Example:
    """A training picture.

    Attributes
    ----------
    inputs : Inputs
    values : (h, w) uint16 or uint8
        Pixels of the thermal picture.
    valid : (h, w) bool
        Where photograph and thermal picture show the same.
    """

    inputs: Inputs
    values: np.ndarray
    valid: np.ndarray


@dataclass(frozen=True, eq=False)
class Task:
    """A training task.

    Attributes
    ----------
    examples : sequence of Example
        Each is read when it is accessed.
    intensity : (n,) float64
        Intensity of each pixel value of the thermal pictures; n is one more than the largest value.
    temperature : (n,) float64
        Apparent temperature of each pixel value [K].
    seed : int
    progress : callable
        Called with (what, share done).
    options : dict
        Options of the method, as in `training_methods.Method.options`.
    texel_m : float or None
        Ground sampling distance that the map will be applied at [m]; methods that use texture learn at it. None takes
        the pictures as they are.
    texel_range_m : (2,) tuple of float
        Finest and coarsest ground sampling distance of the pictures [m].
    held_out : (count,) bool or None
        Examples for early stopping, not learned from; None lets the method choose.
    run : Path or None
        Folder for checkpoints, log and sample pictures of a long training; None for other methods.
    resume : bool
        Continue the training in that folder.
    """

    examples: Sequence[Example]
    intensity: np.ndarray
    temperature: np.ndarray
    seed: int
    progress: Callable[[str, float], object]
    options: dict
    texel_m: float | None = None
    texel_range_m: tuple = (1.0, 1.0)
    held_out: np.ndarray | None = None
    run: Path | None = None
    resume: bool = False
