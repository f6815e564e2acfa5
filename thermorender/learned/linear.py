"""Linear map from the 3 × 3 colours around a pixel, the terrain's relief, hour and weather to kelvin above the air.

Beside these stand products of the sunlight on the ground with the pixel's colour: what a surface absorbs is sunlight
times what it does not reflect, and colour tells that. Where the terrain knows nothing its columns are 0, and one that
says so is 1. The coefficients are those of ridge regression on standardised columns.
"""

from dataclasses import dataclass

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.learned.rows import CLASSES, Told, at_shape, at_texel, drawn, part_of

_SIDE = 3
# Planes of a terrain whose names begin so are sunlight on the ground [W m⁻²], now or over the hours before.
_SUNLIGHT = "sun"
# Pixels drawn from an example.
_MOST_ROWS = 20_000
# A column that spreads less than this share of its own size is constant, but for rounding.
_CONSTANT = 1e-6


@dataclass(frozen=True, eq=False)
class Linear:
    """A linear predictor of kelvin above the air.

    Attributes
    ----------
    told : Told
        What it is told besides the picture.
    weight : (K,) float64
        Of the columns [K per unit of each].
    offset : float
        Prediction where every column is 0 [K].
    """

    told: Told
    weight: np.ndarray
    offset: float

    above_air = True

    @property
    def needs(self):
        return self.told.needs

    def predict(self, inputs, texel_m):
        """Return kelvin above the air, (h, w) float64; an image at another texel is brought to the map's and back.

        Raises
        ------
        ThermorenderError
            A plane of the terrain or a condition is missing.
        """
        image = at_texel(inputs, texel_m)
        found = np.full(image.rgb.shape[:2], self.offset)
        for (_, column), weight in zip(columns(image, self.told), self.weight, strict=True):
            found += weight * column
        return at_shape(found, inputs.rgb.shape[:2])

    def header(self):
        """Return what the file's text says of it."""
        return {"terrain": self.told.terrain, "conditions": self.told.conditions, "offset": self.offset}

    def arrays(self):
        """Return what the file holds of it."""
        return {"weight": self.weight}

    @classmethod
    def of(cls, header, arrays):
        """Return the Linear of `header` and `arrays`."""
        told = Told(tuple(header["terrain"]), tuple(header["conditions"]))
        if not told.above_air:
            raise ValueError("it is not told the air's temperature")
        weight, offset = np.asarray(arrays["weight"], np.float64), float(header["offset"])
        if weight.shape != (count_of_columns(told),):
            raise ValueError("it has other columns")
        if not (np.isfinite(weight).all() and np.isfinite(offset)):
            raise ValueError("it has coefficients that are not finite")
        return cls(told, weight, offset)


def count_of_columns(told):
    """Return how many columns `columns` gives."""
    sunlight = sum(name.startswith(_SUNLIGHT) for name in told.terrain)
    return 3 * _SIDE**2 + len(told.terrain) + 3 * sunlight + 1 + len(told.conditions)


def columns(inputs, told):
    """Give (name, (h, w) float64, or a number that holds for all pixels) of each column, one after the other."""
    told.check(inputs)
    height, width = inputs.rgb.shape[:2]
    ring = _SIDE // 2
    colour = np.pad(inputs.rgb / 255.0, ((ring, ring), (ring, ring), (0, 0)), mode="edge")
    for down in range(_SIDE):
        for across in range(_SIDE):
            for number, name in enumerate("RGB"):
                yield f"{name} {down - ring:+d} {across - ring:+d}", (
                    colour[down : down + height, across : across + width, number]
                )
    unknown = np.zeros((height, width), bool)
    for name in told.terrain:
        plane = np.float64(inputs.terrain[name])
        unknown |= np.isnan(plane)
        plane = np.nan_to_num(plane)
        yield name, plane
        if name.startswith(_SUNLIGHT):
            for number, channel in enumerate("RGB"):
                yield f"{name} × {channel}", plane * colour[ring:-ring, ring:-ring, number]
    yield "no terrain", unknown
    for name in told.conditions:
        yield name, inputs.conditions[name]


def fit_linear(task):
    """Return the Linear that learns a Task.

    Its option `penalty` is the penalty λ: the mean squared error plus λ times the sum of the squared coefficients of
    standardised columns is smallest.

    Raises
    ------
    ThermorenderError
        A negative `penalty`, examples without the air's temperature, or nothing to learn from.
    """
    penalty = float(task.options["penalty"])
    if not 0.0 <= penalty < np.inf:
        raise ThermorenderError(f"penalty={penalty:g} is not allowed; give 0 or more")
    first = Told.of(next(iter(task.examples())).inputs)
    if not first.above_air:
        raise ThermorenderError(
            "the pairs have no condition air_k, the air's temperature, that correlation+ adds to; give a data set "
            "with weather, or take correlation-9to1"
        )
    # Numbers of classes are no quantities.
    told = Told(tuple(name for name in first.terrain if name != CLASSES), first.conditions)
    size = count_of_columns(told)
    # Of the columns, the target and one: all sums that means, variances and covariances are made of.
    products = np.zeros((size + 2, size + 2))
    for each in drawn(task, told, _MOST_ROWS):
        table = np.ones((size + 2, each.pixels.size))
        part, (above, before) = part_of(each.inputs, each.window, _SIDE // 2)
        row, column = np.divmod(each.pixels, each.inputs.rgb.shape[1])
        at = row - each.window[0] + above, column - each.window[2] + before
        for values, (_, plane) in zip(table, columns(part, told), strict=False):
            values[:] = plane[at] if np.ndim(plane) else plane
        table[size] = each.target
        products += table @ table.T
    count = products[-1, -1]
    mean = products[-1, :-1] / count
    covariance = products[:-1, :-1] / count - np.outer(mean, mean)
    scale = np.sqrt(np.maximum(np.diag(covariance)[:size], 0.0))
    varies = scale > _CONSTANT * np.abs(mean[:size])
    weight = np.zeros(size)
    scale = scale[varies]
    among = covariance[:size, :size][np.ix_(varies, varies)] / np.outer(scale, scale)
    among[np.diag_indices_from(among)] += penalty
    # The least of all solutions where columns repeat each other and nothing is penalised.
    weight[varies] = np.linalg.lstsq(among, covariance[size, :size][varies] / scale, rcond=None)[0] / scale
    return Linear(told, weight, float(mean[size] - weight @ mean[:size]))
