"""Training of learned temperature maps: what every method is given."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

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


# Gives the examples from the first one on, each time it is called.
Examples = Callable[[], Iterator[Example]]


@dataclass(frozen=True, eq=False)
class Task:
    """What a method is to learn.

    Attributes
    ----------
    examples : Examples
    count : int
        How many there are.
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
    held_out : (count,) bool or None
        Examples that say when to stop and are not learned from; None leaves it to the method.
    """

    examples: Examples
    count: int
    intensity: np.ndarray
    temperature: np.ndarray
    seed: int
    progress: Callable[[str, float], object]
    options: dict
    texel_m: float | None = None
    held_out: np.ndarray | None = None
