"""The list of stability cases: each is a function without arguments that returns found, expected and allowed values."""

from functools import partial
from typing import NamedTuple

CASES = []


class Found(NamedTuple):
    """Outcome of a case in kelvin: it passes if value differs from expected by at most the tolerance."""

    value_k: float
    expected_k: float
    tolerance_k: float


def case(group, name, values=(None,)):
    """Return a decorator that registers a function as the case "group: name", or as one for each of some values.

    Parameters
    ----------
    group : str
        Group of the case: heat, light, sensor, air, …
    name : str
        Name of the case; `{}` is replaced by the value.
    values : sequence, optional
        The function is called with each value.
    """

    def register(function):
        for value in values:
            job = function if value is None else partial(function, value)
            CASES.append((group, name.format(value), job))
        return function

    return register
