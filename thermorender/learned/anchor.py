"""A map's temperatures brought to another hour and weather, by the air's temperature or by known temperatures.

Level and span of a map of colour are those of its training. A MapAnchor is a line from a map's apparent temperature to
the one that is stated: T = offset + span × T_map.
"""

from dataclasses import dataclass, field

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.learned.temperature_map import TemperatureMap

# Expected share of a picture's variance that a map explains: a correlation of 0.58 within a picture. Estimated: trees
# reach 0.60 on road scenes; 1/5 to 1/2 change the error by at most 0.3 K on field plots, fires, trees and roads.
EXPLAINED = 1.0 / 3.0


@dataclass(frozen=True)
class MapAnchor:
    """A line from a map's apparent temperature to the one that is stated, [K] to [K]."""

    offset_k: float = 0.0
    span: float = 1.0
    stated: str = field(default="", compare=False)  # The text that it was made of, for the record

    def kelvin(self, mapped: np.ndarray) -> np.ndarray:
        """Return stated temperatures of a map's [K]."""
        return self.offset_k + self.span * mapped


def anchored_to_air(model: TemperatureMap, air_k: float, mean_k: float, spread_k: float) -> MapAnchor:
    """Return the MapAnchor to an air temperature [K], for a map of colour.

    `mean_k` is the mean of the map's temperatures in the pictures, and `spread_k` their standard deviation within one
    [K]. The ground of the pictures is taken to be as far above the air as that of the training, on the mean of its
    weathers and hours: sun, clouds and season are not known. The span is 1, or less where the map has more contrast
    than it should explain of the training pictures'.

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
    return _through(model, air_k + model.level.kelvin - model.level.air_k, mean_k, spread_k)


def anchored_to_known(model: TemperatureMap, known: np.ndarray, mapped: np.ndarray, spread_k: float) -> MapAnchor:
    """Return the MapAnchor to known temperatures, (n,) [K], at pixels where the map gives `mapped`, (n,) [K].

    `spread_k` is the standard deviation of the map's temperatures within a picture [K]. One known temperature sets the
    level, with the span of `anchored_to_air`. Two or more set the level by their mean, and the span by least squares
    with a normal prior of mean 0, whose strength is that of a map which explains `EXPLAINED` of a picture's variance.
    So few or similar known temperatures give a picture nearly of their mean, and a picture does not meet each of them
    exactly. The span is never negative.
    """
    known_k, mapped_k = float(np.mean(known)), float(np.mean(mapped))
    if len(known) == 1:
        return _through(model, known_k, mapped_k, spread_k)
    away = mapped - mapped_k
    weight = float(away @ away) + (1.0 / EXPLAINED - 1.0) * spread_k**2
    span = max(float(away @ (known - known_k)) / weight, 0.0) if weight > 0.0 else 0.0
    return MapAnchor(known_k - span * mapped_k, span)


def _through(model: TemperatureMap, stated_k: float, mapped_k: float, spread_k: float) -> MapAnchor:
    """The MapAnchor through one point; where the training's contrast is unknown, the span stays."""
    span = 1.0
    if model.level is not None and spread_k > 0.0:
        span = min(1.0, EXPLAINED**0.5 * model.level.kelvin_within / spread_k)
    return MapAnchor(stated_k - span * mapped_k, span)
