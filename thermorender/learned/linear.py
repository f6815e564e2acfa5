"""Kelvin above the air as a mixture of typical materials: least squares on what they would be here, by colour.

The heat balance says how warm a few typical materials are in the open and in shade (`conditions`). How much of the open
sunlight a texel gets lies between, so each of them has a temperature there. Colour tells what the ground is made of:
each of these temperatures, and sunlight, its past and the hidden part of the sky, has a coefficient that is a quadratic
of CIELAB. So warmth grows with the weather as the balance says, further than was seen in training. Beside these stand
what the terrain and the station tell, each by itself. Coefficients are those of ridge regression on standardised
columns; where the terrain knows nothing its columns are 0, and one that says so is 1.
"""

from dataclasses import dataclass

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.learned.features import lab
from thermorender.learned.rows import CLASSES, ExtraInputs, at_shape, at_texel, drawn

# Planes of a terrain whose names begin so are sunlight on the ground [W m⁻²], now or over the hours before.
_SUNLIGHT = "sun"
# What the sunlight in the open is made of.
_IN_THE_OPEN = ("direct_w_m2", "diffuse_w_m2", "sun_elevation_deg")
# Less than this sunlight in the open [W m⁻²] warms nothing; more than so many times it is no reflection but noise.
_LEAST_SUNLIGHT, _MOST_SHARE = 5.0, 3.0
# Lightness is counted from the middle in halves of its range, a and b in these units and no further than three.
_CHROMA, _MOST_CHROMA = 20.0, 3.0
# Pixels drawn from an example: neighbours say the same.
_MOST_ROWS = 2500
# Pixels whose columns are laid out at a time.
_CHUNK = 1 << 15
# A column that spreads less than this share of its own size is constant, but for rounding.
_CONSTANT = 1e-6
# What each quantity spreads by where it varies at all, by how its name begins, and each colour's term. A column that
# spreads less, as the weather of one hour or the slopes of a plain, would else be believed far beyond that.
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
    """A linear predictor of kelvin above the air.

    Attributes
    ----------
    extra : ExtraInputs
        What it takes as input besides the picture.
    weight : (K,) float64
        Of the columns [K per unit of each].
    offset : float
        Prediction where every column is 0 [K].
    """

    extra: ExtraInputs
    weight: np.ndarray
    offset: float

    above_air = True

    @property
    def needs(self):
        """Names of the fields of Inputs that are needed."""
        return self.extra.needs

    def predict(self, inputs, texel_m):
        """Return kelvin above the air, (h, w) float64; an image at another texel is brought to the map's and back.

        Raises
        ------
        ThermorenderError
            A plane of the terrain or a condition is missing.
        """
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

    def of_values(self, values, multiplied=None):
        """Return kelvin above the air of pixels, as `columns` takes them.

        `multiplied` are their `grounds`, where they are known already.
        """
        colours = np.stack(np.broadcast_arrays(1.0, *_colours(values)))
        planes = [plane for _, plane in multiplied or grounds(values, self.extra)]
        alone, many = len(_COLOURS) - 1, len(_COLOURS)
        slopes, rest = np.split(self.weight[alone:], [many * len(planes)])
        found = self.offset + np.tensordot(self.weight[:alone], colours[1:], 1)
        # What each ground is multiplied by is a quadratic of colour: one product of matrices for all of them.
        for plane, factor in zip(planes, np.tensordot(slopes.reshape(-1, many), colours, 1), strict=True):
            found += plane * factor
        for (_, column), weight in zip(_others(values, self.extra), rest, strict=True):
            if weight:
                found += weight * column
        return found

    def header(self):
        """Return what the file's text says of it."""
        return {"terrain": self.extra.terrain, "conditions": self.extra.conditions, "offset": self.offset}

    def arrays(self):
        """Return what the file holds of it."""
        return {"weight": self.weight}

    @classmethod
    def of(cls, header, arrays):
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


def names_of_columns(extra):
    """Return the names of `columns`."""
    nothing = np.zeros(0)
    return [name for name, _ in columns(dict.fromkeys([*"Lab", *extra.terrain, *extra.conditions], nothing), extra)]


def columns(values, extra):
    """Give (name, array, or a number that holds for all pixels) of each column, one after the other.

    Parameters
    ----------
    values : mapping of str to array or number
        By pixel: "L", "a" and "b" of CIELAB, and what `extra` names.
    extra : ExtraInputs
    """
    colours = (None, *_colours(values))
    yield from zip(_COLOURS[1:], colours[1:], strict=True)
    for name, plane in grounds(values, extra):
        for what, colour in zip(_COLOURS, colours, strict=True):
            yield (f"{name} × {what}", plane * colour) if what else (name, plane)
    yield from _others(values, extra)


def _colours(values):
    """What `_COLOURS` names but for the first, of CIELAB."""
    light, a, b = (np.asarray(values[channel]) for channel in "Lab")
    light = light / 50.0 - 1.0
    a, b = (np.clip(channel / _CHROMA, -_MOST_CHROMA, _MOST_CHROMA) for channel in (a, b))
    return light, a, b, light * light, a * a, b * b, light * a, light * b, a * b


def _others(values, extra):
    """Give (name, array or number) of what stands by itself: the terrain, where there is none, and the station."""
    unknown = np.zeros(np.shape(values["L"]), bool)
    for name in extra.terrain:
        unknown = unknown | np.isnan(values[name])
        # Sunlight is among what colour multiplies.
        if not name.startswith(_SUNLIGHT):
            yield name, _known(values[name], 0.0)
    yield "no terrain", unknown
    for name in extra.conditions:
        yield name, values[name]


def grounds(values, extra):
    """Give (name, plane) of what colour multiplies, 0 where there is no terrain.

    First "as MATERIAL", kelvin above the air of each typical material that the conditions tell, in the sunlight that
    the terrain has there; then sunlight, its past, and the hidden part of the sky.
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
    """A terrain's plane with a number where there is no terrain."""
    return np.where(np.isnan(plane), np.asarray(plane).dtype.type(otherwise), plane)


def _usual(name):
    """What a column usually spreads by; 0 where that is not known."""
    found = 1.0
    for part in name.split(" × "):
        known = (spread for start, spread in _USUAL if part.startswith(start))
        found *= _USUAL_COLOUR if part in _COLOURS else next(known, 0.0)
    return found


def lab_planes(rgb):
    """Return {"L", "a", "b": array} of sRGB, as `columns` takes them."""
    return dict(zip("Lab", np.moveaxis(lab(rgb), -1, 0), strict=True))


def fit_linear(task):
    """Return the Linear that learns a Task.

    Its option `penalty` is the penalty λ: the mean squared error plus λ times the sum of the squared coefficients of
    standardised columns is smallest. A column is standardised by its spread, or by what it usually spreads by where
    that is more.

    Raises
    ------
    ThermorenderError
        A negative `penalty`, examples without the air's temperature, or nothing to learn from.
    """
    penalty = float(task.options["penalty"])
    if not 0.0 <= penalty < np.inf:
        raise ThermorenderError(f"penalty={penalty:g} is not allowed; give 0 or more")
    first = ExtraInputs.of(task.examples[0].inputs)
    if not first.above_air:
        raise ThermorenderError(
            "the pairs have no condition air_k, the air's temperature, that correlation+ adds to; give a data set "
            "with weather, or take correlation-9to1"
        )
    sums = Sums(first)
    for each in drawn(task, sums.extra, _MOST_ROWS):
        terrain = {name: np.ravel(each.inputs.terrain[name])[each.pixels] for name in sums.extra.terrain}
        picked = lab_planes(each.inputs.rgb.reshape(-1, 3)[each.pixels])
        sums.add({**picked, **terrain, **each.inputs.conditions}, each.target)
    return sums.solved(penalty)


class Sums:
    """All sums that means, variances and covariances of the columns and the target are made of.

    Attributes
    ----------
    extra : ExtraInputs
        As given, without numbers of classes, which are no quantities.
    """

    def __init__(self, extra):
        self.extra = ExtraInputs(tuple(name for name in extra.terrain if name != CLASSES), extra.conditions)
        self._size = len(names_of_columns(self.extra))
        self._products = np.zeros((self._size + 2, self._size + 2))

    def add(self, values, target):
        """Add pixels, as `columns` takes them, and their kelvin above the air, (n,)."""
        table = np.ones((self._size + 2, target.size))
        for row, (_, column) in zip(table, columns(values, self.extra), strict=False):
            row[:] = column
        table[self._size] = target
        self._products += table @ table.T

    def solved(self, penalty):
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
        # The least of all solutions where columns repeat each other and nothing is penalised.
        weight[varies] = np.linalg.lstsq(among, covariance[size, :size][varies] / scale, rcond=None)[0] / scale
        return Linear(self.extra, weight, float(mean[size] - weight @ mean[:size]))
