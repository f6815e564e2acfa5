"""The methods of learned temperature maps, by name."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from thermorender.apps.training.task import Task
from thermorender.errors import ThermorenderError
from thermorender.learned.correlation import MOST_SIDE
from thermorender.learned.networks.recipes import RECIPES
from thermorender.schema import did_you_mean


@dataclass(frozen=True)
class Method:
    """A training method."""

    # Task → predictor
    fit: Callable[[Task], Any]
    plus: bool  # Whether it takes relief, hour and weather as input
    options: dict[str, Any]  # Its options with their defaults
    classes: bool = False  # Whether it can use class numbers, such as a privileged map's materials, as input
    long: bool = False  # Whether it is trained step by step, in a folder from which it can be resumed


def _fit(module: str, name: str, *more: Any) -> Callable[[Task], Any]:
    """Function of a Task and `more` in a module of this package, imported when it is called."""

    def fit(task: Task) -> Any:
        try:
            found = import_module(f"thermorender.apps.training.{module}")
        except ModuleNotFoundError as error:
            raise ThermorenderError(
                f"training a network needs {error.name}; install it with: pip install 'thermorender[networks]'"
            ) from None
        return getattr(found, name)(task, *more)

    return fit


def _correlation(size: int) -> Method:
    """Method of a correlation with size × size colours."""
    options = {"intercept": False, "penalty": 0.0, "above_air": False}
    return Method(_fit("correlation_training", "fit_correlation", size), False, options)


METHODS = {
    "correlation-1to1": _correlation(1),
    "correlation-9to1": _correlation(3),
    "correlation-5x5": _correlation(5),
    "correlation-7x7": _correlation(7),
    "palette": Method(_fit("palette_training", "fit_palette"), False, {"cell": 6.0, "shrinkage": 200.0}),
    "trees": Method(_fit("trees_training", "fit_trees"), False, {}),
    "correlation+": Method(_fit("linear_training", "fit_linear"), True, {"penalty": 1e-3}),
    "trees+": Method(_fit("trees_training", "fit_trees"), True, {}, classes=True),
}
METHODS |= {
    name: Method(_fit("networks.loop", "train_network", name), recipe.plus, recipe.all_options, long=True)
    for name, recipe in RECIPES.items()
}
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
