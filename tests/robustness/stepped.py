"""The step of the heat balance in double precision, NumPy's, and in the single precision that renders, Dr.Jit's."""

import numpy as np

from thermorender.physics import balance

SINGLE, DOUBLE = "single", "double"


def run(precision, ground, act, begin, seconds, count, start_s=0.0):
    """Return (surface temperatures (count, C), final State), both float64 NumPy.

    Parameters
    ----------
    precision : str
        SINGLE or DOUBLE.
    ground : balance.ColumnProperties
        Of C columns; NumPy.
    act : callable
        Returns the balance.Forcing at a time [s].
    begin : (L, C) array or balance.State
        Temperatures of the layers [K], at rest; or a State in double precision.
    seconds, count : float, int
        Length and number of steps.
    start_s : float, optional
        Time of the first step's beginning [s].
    """
    given = isinstance(begin, balance.State)
    xp, array, evaluate = _library(precision, np.shape(begin.layers_k if given else begin)[1])
    ground = balance.ColumnProperties(*(_each(array, value) for value in ground))
    if given:
        state = balance.State(*(_each(array, value) for value in begin))
    else:
        state = balance.at_rest(xp, [array(layer) for layer in begin], ground)
    length, seen = array(seconds), []
    for number in range(count):
        at = start_s + number * seconds
        stages = (
            balance.Forcing(*(_each(array, value) for value in act(at + offset)))
            for offset in balance.stage_times(seconds)
        )
        state, _ = balance.step(xp, state, ground, *stages, length)
        evaluate(state)
        seen.append(np.array(state.surface_k, np.float64))
    double = lambda values: np.array(values, np.float64)  # noqa: E731
    return np.array(seen), balance.State(*(_each(double, value) for value in state))


def _library(precision, columns):
    """(array library, function that makes its arrays (C,), function that evaluates a State) of a precision."""
    if precision == DOUBLE:
        return np, lambda value: np.broadcast_to(np.asarray(value, np.float64), columns), lambda state: None
    import drjit as dr

    from thermorender.render.heat.matter import evaluate
    from thermorender.render.heat.steps import Library
    from thermorender.render.variant import activate

    mi = activate("cpu")

    def array(value):
        if np.ndim(value) == 0:
            return dr.opaque(mi.Float, float(value), columns)
        return mi.Float(np.ascontiguousarray(value, np.float32))

    return Library, array, evaluate


def _each(function, value):
    return None if value is None else [function(each) for each in value] if isinstance(value, list) else function(value)
