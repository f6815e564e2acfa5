"""The methods of learned temperature maps, by name."""

import re
from collections.abc import Callable
from dataclasses import dataclass

from thermorender.errors import ThermorenderError
from thermorender.learned.correlation import MOST_SIDE
from thermorender.learned.networks.recipes import RECIPES
from thermorender.schema import did_you_mean


@dataclass(frozen=True)
class Method:
    """A training method."""

    fit: Callable  # Task → predictor
    plus: bool  # Whether it takes relief, hour and weather as input
    options: dict  # Its options with their defaults
    classes: bool = False  # Whether it can use class numbers, such as a privileged map's materials, as input
    long: bool = False  # Whether it is trained step by step, in a folder from which it can be resumed


def _correlation(size):
    def fit(task):
        from thermorender.apps.training.correlation_training import fit_correlation

        return fit_correlation(task, size)

    options = {"intercept": False, "penalty": 0.0, "above_air": False}
    return Method(fit, False, options)


def _later(module, name, plus, options, classes=False):
    def fit(task):
        return _imported(module, name)(task)

    return Method(fit, plus, options, classes)


def _network(name, recipe):
    def fit(task):
        return _imported("networks.loop", "train_network")(task, name)

    return Method(fit, recipe.plus, recipe.all_options, long=True)


def _imported(module, name):
    import importlib

    try:
        return getattr(importlib.import_module(f"thermorender.learned.{module}"), name)
    except ModuleNotFoundError as error:
        raise ThermorenderError(
            f"training a network needs {error.name}; install it with: pip install 'thermorender[networks]'"
        ) from None


METHODS = {
    "correlation-1to1": _correlation(1),
    "correlation-9to1": _correlation(3),
    "correlation-5x5": _correlation(5),
    "correlation-7x7": _correlation(7),
    "palette": _later("palette", "fit_palette", False, {"cell": 6.0, "shrinkage": 200.0}),
    "trees": _later("trees", "fit_trees", False, {}),
    "correlation+": _later("linear", "fit_linear", True, {"penalty": 1e-3}),
    "trees+": _later("trees", "fit_trees", True, {}, classes=True),
}
METHODS |= {name: _network(name, recipe) for name, recipe in RECIPES.items()}
_NXN = re.compile(r"correlation-(\d+)x\1")


def method(name: str) -> Method:
    """Return the Method of a name, one of `METHODS` or correlation-NxN with odd N up to 15."""
    if name in METHODS:
        return METHODS[name]
    size = _NXN.fullmatch(name)
    if size and int(size[1]) % 2 == 1 and int(size[1]) <= MOST_SIDE:
        return _correlation(int(size[1]))
    raise ThermorenderError(
        f"method {name!r} is unknown; {did_you_mean(name, METHODS)}known are {', '.join(METHODS)}, and "
        f"correlation-NxN for odd N up to {MOST_SIDE}"
    )
