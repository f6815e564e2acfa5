"""Training of learned temperature maps: what every method is given."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from thermorender.learned.temperature_map import Inputs


@dataclass(frozen=True, eq=False)
class Example:
    """A picture to learn from.

    Attributes
    ----------
    inputs : Inputs
    values : (h, w) uint16 or uint8
        Of the thermal picture.
    valid : (h, w) bool
        Where both show the same.
    """

    inputs: Inputs
    values: np.ndarray
    valid: np.ndarray


@dataclass(frozen=True, eq=False)
class Task:
    """What a method is to learn.

    Attributes
    ----------
    examples : sequence of Example
        Each is read when it is asked for.
    intensity : (n,) float64
        Intensity that each value of the thermal pictures stands for; n is one more than the largest.
    temperature : (n,) float64
        Apparent temperature that it stands for [K].
    seed : int
    progress : callable
        Called with (what, share done).
    options : dict
        Of the method, as by `methods.Method.options`.
    texel_m : float or None
        Ground sampling distance that the map will be applied at [m]; methods that see texture learn at it. None takes
        the pictures as they are.
    texel_range_m : (2,) tuple of float
        Finest and coarsest of the pictures [m].
    held_out : (count,) bool or None
        Examples that say when to stop and are not learned from; None leaves it to the method.
    run : Path or None
        Folder of a training that takes long: checkpoints, log and sample pictures; None for methods without.
    resume : bool
        Continue the training of that folder.
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
