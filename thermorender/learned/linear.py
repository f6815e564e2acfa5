"""Kelvin above the air as a mixture of typical materials, by ridge regression.

The heat balance gives the temperatures of a few typical materials in the open and in shade (`conditions`). A texel's
share of the open sunlight interpolates between them. These temperatures, sunlight, its history and the hidden part of
the sky each have a coefficient that is quadratic in CIELAB, since colour indicates material. So the prediction follows
the heat balance beyond the weather of the training. Relief and station data are additional columns. Columns are
standardised; where there is no terrain its columns are 0, and an indicator column is 1.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from thermorender.errors import ThermorenderError
from thermorender.learned.features import lab
from thermorender.learned.rows import CLASSES, ExtraInputs, at_shape, at_texel, drawn
from thermorender.learned.temperature_map import Inputs
from thermorender.learned.training import Task

# Name prefix of terrain planes of sunlight on the ground [W m⁻²], now or over the hours before.
_SUNLIGHT = "sun"
# Conditions that sunlight in the open is computed from.
_IN_THE_OPEN = ("direct_w_m2", "diffuse_w_m2", "sun_elevation_deg")
# Least sunlight in the open to divide by [W m⁻²]; a greater share of it than this is noise, not reflection.
_LEAST_SUNLIGHT, _MOST_SHARE = 5.0, 3.0
# Lightness is scaled to −1…1, a and b by these units and clipped at ±3.
_CHROMA, _MOST_CHROMA = 20.0, 3.0
# Pixels drawn from an example; neighbours add little.
_MOST_ROWS = 2500
# Pixels computed at a time.
_CHUNK = 1 << 15
# A column whose spread is less than this share of its mean is constant up to rounding.
_CONSTANT = 1e-6
# Usual spread of each quantity, by the beginning of its name, and of each colour term. Columns that vary less, such as
# the weather of one hour or the slopes of a plain, are penalised more, so that they do not dominate elsewhere.
_USUAL = (
    ("air_k", 5.0), ("vapour_pa", 200.0), ("wind_m_s", 1.0), ("direct_w_m2", 100.0), ("diffuse_w_m2", 30.0),
    ("longwave", 20.0), ("snow_m", 0.05), ("air_day_k", 1.0), ("rain_day_mm", 1.0), ("sun_elevation_deg", 10.0),
    ("solar_hour", 3.0), ("day", 30.0), ("open_", 1.0), ("shade_", 1.0), ("as ", 1.0), (_SUNLIGHT, 50.0),
    ("hidden sky", 0.05), ("sky_view", 0.05), ("normal_", 0.05), ("above_m", 0.5),
)  # fmt: skip
_USUAL_COLOUR = 0.03
_COLOURS = ("", "L", "a", "b", "L²", "a²", "b²", "L a", "L b", "a b")


@dataclass(frozen=True, eq=False)
class Linear:
    """A linear predictor of kelvin above the air."""

    extra: ExtraInputs  # Inputs besides the picture
    weight: np.ndarray  # (K,) float64 weights of the columns [K per unit of each]
    offset: float  # Prediction where every column is 0 [K]

    above_air = True

    @property
    def needs(self) -> tuple[str, ...]:
        """Names of the required fields of Inputs."""
        return self.extra.needs

    def predict(self, inputs: Inputs, texel_m: float) -> np.ndarray:
        """Return kelvin above the air, (h, w) float64; an image at another texel is resampled to the map's and back."""
        image = at_texel(inputs, texel_m)
        self.extra.check(image)
        height, width = image.rgb.shape[:2]
        found = np.empty((height, width))
        rows = max(_CHUNK // width, 1)
        for top in range(0, height, rows):
            here = np.s_[top : top + rows]
            terrain = {name: image.terrain[name][here] for name in self.extra.terrain}
            found[here] = self.of_values({**lab_planes(image.rgb[here]), **terrain, **image.conditions})
        return at_shape(found, inputs.rgb.shape[:2])

    def of_values(
        self, values: Mapping[str, ArrayLike], multiplied: Iterable[tuple[str, np.ndarray]] | None = None
    ) -> np.ndarray:
        """Return kelvin above the air of pixels, with `values` as for `columns`.

        `multiplied` are their `grounds`, if already known.
        """
        colours = np.stack(np.broadcast_arrays(1.0, *_colours(values)))
        planes = [plane for _, plane in multiplied or grounds(values, self.extra)]
        alone, many = len(_COLOURS) - 1, len(_COLOURS)
        slopes, rest = np.split(self.weight[alone:], [many * len(planes)])
        found = self.offset + np.tensordot(self.weight[:alone], colours[1:], 1)
        # The factor of each ground is a quadratic of colour: one matrix product for all of them.
        for plane, factor in zip(planes, np.tensordot(slopes.reshape(-1, many), colours, 1), strict=True):
            found += plane * factor
        for (_, column), weight in zip(_others(values, self.extra), rest, strict=True):
            if weight:
                found += weight * column
        return found

    def header(self) -> dict[str, Any]:
        """Return its entries in the file's header."""
        return {"terrain": self.extra.terrain, "conditions": self.extra.conditions, "offset": self.offset}

    def arrays(self) -> dict[str, np.ndarray]:
        """Return its arrays in the file."""
        return {"weight": self.weight}

    @classmethod
    def of(cls, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> "Linear":
        """Return the Linear of `header` and `arrays`."""
        extra = ExtraInputs(tuple(header["terrain"]), tuple(header["conditions"]))
        if not extra.above_air:
            raise ValueError("it does not take the air's temperature as input")
        weight, offset = np.asarray(arrays["weight"], np.float64), float(header["offset"])
        if weight.shape != (len(names_of_columns(extra)),):
            raise ValueError("it has other columns")
        if not (np.isfinite(weight).all() and np.isfinite(offset)):
            raise ValueError("it has coefficients that are not finite")
        return cls(extra, weight, offset)


def names_of_columns(extra: ExtraInputs) -> list[str]:
    """Return the names of `columns`."""
    nothing = np.zeros(0)
    return [name for name, _ in columns(dict.fromkeys([*"Lab", *extra.terrain, *extra.conditions], nothing), extra)]


def columns(values: Mapping[str, ArrayLike], extra: ExtraInputs) -> Iterator[tuple[str, ArrayLike]]:
    """Yield (name, array, or one number for all pixels) of each column.

    Parameters
    ----------
    values : mapping of str to array or number
        By pixel: "L", "a" and "b" of CIELAB, and the inputs in `extra`.
    extra : ExtraInputs
    """
    colours = (None, *_colours(values))
    yield from zip(_COLOURS[1:], colours[1:], strict=True)
    for name, plane in grounds(values, extra):
        for what, colour in zip(_COLOURS, colours, strict=True):
            yield (f"{name} × {what}", plane * colour) if what else (name, plane)
    yield from _others(values, extra)


def _colours(values):
    """The terms `_COLOURS` without the first, from CIELAB."""
    light, a, b = (np.asarray(values[channel]) for channel in "Lab")
    light = light / 50.0 - 1.0
    a, b = (np.clip(channel / _CHROMA, -_MOST_CHROMA, _MOST_CHROMA) for channel in (a, b))
    return light, a, b, light * light, a * a, b * b, light * a, light * b, a * b


def _others(values, extra):
    """Yield (name, array or number) of the columns without colour: relief, "no terrain", and conditions."""
    unknown = np.zeros(np.shape(values["L"]), bool)
    for name in extra.terrain:
        unknown = unknown | np.isnan(values[name])
        # Sunlight is among the `grounds`.
        if not name.startswith(_SUNLIGHT):
            yield name, _known(values[name], 0.0)
    yield "no terrain", unknown
    for name in extra.conditions:
        yield name, values[name]


def grounds(values: Mapping[str, ArrayLike], extra: ExtraInputs) -> Iterator[tuple[str, np.ndarray]]:
    """Yield (name, plane) of the quantities that are multiplied by colour terms; 0 where there is no terrain.

    First "as MATERIAL", kelvin above the air of each typical material in the conditions, in the pixel's sunlight; then
    sunlight, its history, and the hidden part of the sky.
    """
    known = extra.conditions
    materials = [name[5:] for name in known if name.startswith("open_") and f"shade_{name[5:]}" in known]
    sunlight = "sunlight" in extra.terrain and all(name in known for name in _IN_THE_OPEN)
    if materials and sunlight:
        direct, diffuse, elevation = (values[name] for name in _IN_THE_OPEN)
        in_the_open = np.maximum(direct * np.maximum(np.sin(np.radians(elevation)), 0.0) + diffuse, _LEAST_SUNLIGHT)
        share = np.clip(_known(values["sunlight"] / in_the_open, 1.0), 0.0, _MOST_SHARE)
        for material in materials:
            shade = values[f"shade_{material}"]
            yield f"as {material}", shade + (values[f"open_{material}"] - shade) * share
    for name in extra.terrain:
        if name.startswith(_SUNLIGHT):
            yield name, _known(values[name], 0.0)
    if "sky_view" in extra.terrain:
        hidden = 1.0 - _known(values["sky_view"], 1.0)
        yield "hidden sky", hidden
        if "longwave_w_m2" in known:
            yield "hidden sky × longwave", hidden * values["longwave_w_m2"]


def _known(plane, otherwise):
    """A terrain plane with NaN replaced by a number."""
    return np.where(np.isnan(plane), np.asarray(plane).dtype.type(otherwise), plane)


def _usual(name):
    """The usual spread of a column; 0 if unknown."""
    found = 1.0
    for part in name.split(" × "):
        known = (spread for start, spread in _USUAL if part.startswith(start))
        found *= _USUAL_COLOUR if part in _COLOURS else next(known, 0.0)
    return found


def lab_planes(rgb: np.ndarray) -> dict[str, np.ndarray]:
    """Return {"L", "a", "b": array} of sRGB, for `columns`."""
    return dict(zip("Lab", np.moveaxis(lab(rgb), -1, 0), strict=True))


def fit_linear(task: Task) -> Linear:
    """Return the Linear trained on a Task.

    It minimises the mean squared error plus λ, the option `penalty`, times the sum of the squared coefficients of
    standardised columns. A column is standardised by its spread or its usual spread, the greater of the two.
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
    """The sums behind means, variances and covariances of the columns and the target.

    Attributes
    ----------
    extra : ExtraInputs
        As given, without class numbers, which are not quantities.
    """

    def __init__(self, extra: ExtraInputs) -> None:
        self.extra = ExtraInputs(tuple(name for name in extra.terrain if name != CLASSES), extra.conditions)
        self._size = len(names_of_columns(self.extra))
        self._products = np.zeros((self._size + 2, self._size + 2))

    def add(self, values: Mapping[str, ArrayLike], target: np.ndarray) -> None:
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
