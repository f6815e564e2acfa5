"""A map's temperatures brought to another hour and weather, by the air's temperature or by known temperatures.

Level and span of a map of colour are those of its training. A MapAnchor is a line from a map's apparent temperature to
the one that is stated: T = offset + span × T_map.
"""

from dataclasses import dataclass
from typing import overload

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.learned.temperature_map import TemperatureMap

# Expected share of a picture's variance that a map explains: a correlation of 0.58 within a picture. Estimated: trees
# reach 0.60 on road scenes, and values of 0.2 to 0.5 give errors within 0.2 K of each other on four sets of real pairs.
EXPLAINED = 1.0 / 3.0


@dataclass(frozen=True)
class MapAnchor:
    """A line from a map's apparent temperature to the one that is stated, [K] to [K]."""

    offset_k: float = 0.0
    span: float = 1.0

    @overload
    def kelvin(self, mapped: float) -> float: ...
    @overload
    def kelvin(self, mapped: np.ndarray) -> np.ndarray: ...
    def kelvin(self, mapped: np.ndarray | float) -> np.ndarray | float:
        """Return stated temperatures of a map's [K]."""
        return self.offset_k + self.span * mapped


def anchored_to_air(model: TemperatureMap, air_k: float) -> MapAnchor:
    """Return the MapAnchor to an air temperature [K], for a map of colour.

    It carries over how far each colour was from the air in training, on the mean of its weathers: the map is moved by
    the difference of the air temperatures. Sun, clouds, season and hour may differ from that mean, and the span stays.

    Raises
    ------
    ThermorenderError
        The map takes the air as input, or the air temperature of its training is unknown.
    """
    if model.predictor.above_air:
        raise ThermorenderError(
            f"anchor air={air_k:g} does not apply to learned map {model.name!r}, which takes the air's temperature as "
            "input; leave it out"
        )
    if model.level is None or model.level.air_k is None:
        raise ThermorenderError(
            f"anchor air={air_k:g} needs the air temperature of the training, which learned map {model.name!r} does "
            "not record; give a file of known temperatures, or another map"
        )
    return MapAnchor(air_k - model.level.air_k)


def anchored_to_known(mapped: np.ndarray, known: np.ndarray, spread_k: float) -> MapAnchor:
    """Return the MapAnchor to known temperatures, (n,) [K], at pixels where the map gives `mapped`, (n,) [K].

    One known temperature sets the level, and the span stays. Two or more set the level by their mean, and the span by
    least squares with a normal prior of mean 0. The prior's strength follows from the spread of the map's temperatures
    in its pictures, `spread_k` [K], and from the share of a picture's variance that a map is expected to explain,
    `EXPLAINED`. So few or similar known temperatures give a picture nearly of their mean, and the picture does not
    meet each of them exactly. The span is never negative.
    """
    level = float(np.mean(known)), float(np.mean(mapped))
    if len(known) == 1:
        return MapAnchor(level[0] - level[1])
    away = mapped - level[1]
    weight = float(away @ away) + (1.0 / EXPLAINED - 1.0) * spread_k**2
    span = max(float(away @ (known - level[0])) / weight, 0.0) if weight > 0.0 else 0.0
    return MapAnchor(level[0] - span * level[1], span)
