"""The list of stability cases: each a function of no arguments that returns what was found, expected and allowed."""

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
        What it belongs to: heat, light, sensor, air, …
    name : str
        Of the case; `{}` stands for the value.
    values : sequence, optional
        The function is called with each.
    """

    def register(function):
        for value in values:
            job = function if value is None else partial(function, value)
            CASES.append((group, name.format(value), job))
        return function

    return register
