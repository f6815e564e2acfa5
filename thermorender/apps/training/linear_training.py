"""Training of a Linear by ridge regression of kelvin above the air on standardised columns."""

from collections.abc import Mapping

import numpy as np

from thermorender.apps.training.drawn_pixels import drawn
from thermorender.apps.training.task import Task
from thermorender.errors import ThermorenderError
from thermorender.learned.linear import COLOURS, Linear, columns, lab_planes, names_of_columns
from thermorender.learned.rows import CLASSES, ExtraInputs

# Pixels drawn from an example; neighbours add little.
_MOST_ROWS = 2500
# A column whose spread is less than this share of its mean is constant up to rounding.
_CONSTANT = 1e-6
# Usual spread of each quantity, by the beginning of its name, and of each colour term. Columns that vary less, such as
# the weather of one hour or the slopes of a plain, are penalised more, so that they do not dominate elsewhere.
_USUAL = (
    ("air_k", 5.0), ("vapour_pa", 200.0), ("wind_m_s", 1.0), ("direct_w_m2", 100.0), ("diffuse_w_m2", 30.0),
    ("longwave", 20.0), ("snow_m", 0.05), ("air_day_k", 1.0), ("rain_day_mm", 1.0), ("sun_elevation_deg", 10.0),
    ("solar_hour", 3.0), ("day", 30.0), ("open_", 1.0), ("shade_", 1.0), ("as ", 1.0), ("sun", 50.0),
    ("hidden sky", 0.05), ("sky_view", 0.05), ("normal_", 0.05), ("above_m", 0.5),
)  # fmt: skip
_USUAL_COLOUR = 0.03


def fit_linear(task: Task) -> Linear:
    """Return the Linear trained on a Task: least squares plus the option `penalty` times the squared coefficients.

    Columns are standardised by their spread or their usual spread, the greater of the two.
    """
    penalty = float(task.options["penalty"])
    if not 0.0 <= penalty < np.inf:
        raise ThermorenderError(f"penalty={penalty:g} is not allowed; give 0 or more")
    first = ExtraInputs.of(task.examples[0].inputs)
    if not first.above_air:
        raise ThermorenderError(
            "the pairs lack the condition air_k, the air's temperature, which correlation+ needs; give a data set with "
            "weather, or take correlation-9to1"
        )
    sums = Sums(first)
    for each in drawn(task, sums.extra, _MOST_ROWS):
        terrain = {name: np.ravel(each.inputs.terrain[name])[each.pixels] for name in sums.extra.terrain}
        picked = lab_planes(each.inputs.rgb.reshape(-1, 3)[each.pixels])
        sums.add({**picked, **terrain, **each.inputs.conditions}, each.target)
    return sums.solved(penalty)


class Sums:
    """The sums behind means, variances and covariances of the columns and the target."""

    def __init__(self, extra: ExtraInputs) -> None:
        # Class numbers are not quantities.
        self.extra = ExtraInputs(tuple(name for name in extra.terrain if name != CLASSES), extra.conditions)
        self._size = len(names_of_columns(self.extra))
        self._products = np.zeros((self._size + 2, self._size + 2))

    def add(self, values: Mapping[str, np.ndarray | float], target: np.ndarray) -> None:
        """Add pixels, with `values` as for `columns`, and their kelvin above the air, (n,)."""
        table = np.ones((self._size + 2, target.size))
        for row, (_, column) in zip(table, columns(values, self.extra), strict=False):
            row[:] = column
        table[self._size] = target
        self._products += table @ table.T

    def solved(self, penalty: float) -> Linear:
        """Return the Linear of ridge regression with this penalty."""
        size, count = self._size, self._products[-1, -1]
        mean = self._products[-1, :-1] / count
        covariance = self._products[:-1, :-1] / count - np.outer(mean, mean)
        scale = np.sqrt(np.maximum(np.diag(covariance)[:size], 0.0))
        varies = scale > _CONSTANT * np.abs(mean[:size])
        weight = np.zeros(size)
        scale = scale[varies]
        among = covariance[:size, :size][np.ix_(varies, varies)] / np.outer(scale, scale)
        usual = np.array([_usual(name) for name in names_of_columns(self.extra)])[varies]
        among[np.diag_indices_from(among)] += penalty * np.maximum(usual / scale, 1.0) ** 2
        # The minimum-norm solution if columns are dependent and the penalty is 0.
        weight[varies] = np.linalg.lstsq(among, covariance[size, :size][varies] / scale, rcond=None)[0] / scale
        return Linear(self.extra, weight, float(mean[size] - weight @ mean[:size]))


def _usual(name: str) -> float:
    """Usual spread of a column; 0 if unknown."""
    found = 1.0
    for part in name.split(" × "):
        known = (spread for start, spread in _USUAL if part.startswith(start))
        found *= _USUAL_COLOUR if part in COLOURS else next(known, 0.0)
    return found
