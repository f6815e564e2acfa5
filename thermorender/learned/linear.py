"""Kelvin above the air as a mixture of typical materials.

The heat balance gives the temperatures of typical materials in the open and in shade (`conditions`), between which a
texel's share of open sunlight interpolates. These, sunlight, its history and the hidden part of the sky each have a
coefficient quadratic in CIELAB. So the prediction follows the heat balance beyond the weather of the training. Without
terrain, the columns of relief are 0, and an indicator column is 1.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from thermorender.learned.pixel_features import lab
from thermorender.learned.rows import ExtraInputs, at_shape, at_texel
from thermorender.learned.temperature_map import Inputs

# Values of a column by pixel, or one number for all pixels.
Values = np.ndarray | float

# Name prefix of terrain planes of sunlight on the ground [W m⁻²], now or over the hours before.
_SUNLIGHT = "sun"
# Conditions that sunlight in the open is computed from.
_IN_THE_OPEN = ("direct_w_m2", "diffuse_w_m2", "sun_elevation_deg")
# Least sunlight in the open to divide by [W m⁻²]; a greater share of it than this is noise, not reflection.
_LEAST_SUNLIGHT, _MOST_SHARE = 5.0, 3.0
# Lightness is scaled to −1…1, a and b by these units and clipped at ±3.
_CHROMA, _MOST_CHROMA = 20.0, 3.0
# Pixels computed at a time.
_CHUNK = 1 << 15
# Terms of colour: a column's name ends in one, or is one.
COLOURS = ("", "L", "a", "b", "L²", "a²", "b²", "L a", "L b", "a b")


@dataclass(frozen=True, eq=False)
class Linear:
    """A linear predictor of kelvin above the air."""

    extra: ExtraInputs  # Inputs besides the picture
    weight: np.ndarray  # (K,) float64 weights of the columns [K per unit of each]
    offset: float  # Prediction where every column is 0 [K]

    above_air: ClassVar[bool] = True

    @property
    def needs(self) -> tuple[str, ...]:
        """Names of the required fields of Inputs."""
        return self.extra.needs

    def predict(self, inputs: Inputs, texel_m: float | None) -> np.ndarray:
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
        self, values: Mapping[str, Values], multiplied: Iterable[tuple[str, np.ndarray]] | None = None
    ) -> np.ndarray:
        """Return kelvin above the air of pixels, with `values` as for `columns`, and their `grounds` if known."""
        colours = np.stack(np.broadcast_arrays(1.0, *_colours(values)))
        planes = [plane for _, plane in multiplied or grounds(values, self.extra)]
        alone, many = len(COLOURS) - 1, len(COLOURS)
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


def columns(values: Mapping[str, Values], extra: ExtraInputs) -> Iterator[tuple[str, Values]]:
    """Yield (name, array, or one number for all pixels) of each column of "L", "a", "b" (CIELAB) and `extra` inputs."""
    colours = list(zip(COLOURS[1:], _colours(values), strict=True))
    yield from colours
    for name, plane in grounds(values, extra):
        yield name, plane
        for what, colour in colours:
            yield f"{name} × {what}", plane * colour
    yield from _others(values, extra)


def _colours(values: Mapping[str, Values]) -> tuple[np.ndarray, ...]:
    """The terms `COLOURS` without the first, from CIELAB."""
    light, a, b = (np.asarray(values[channel]) for channel in "Lab")
    light = light / 50.0 - 1.0
    a, b = (np.clip(channel / _CHROMA, -_MOST_CHROMA, _MOST_CHROMA) for channel in (a, b))
    return light, a, b, light * light, a * a, b * b, light * a, light * b, a * b


def _others(values: Mapping[str, Values], extra: ExtraInputs) -> Iterator[tuple[str, Values]]:
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


def grounds(values: Mapping[str, Values], extra: ExtraInputs) -> Iterator[tuple[str, np.ndarray]]:
    """Yield (name, plane) of the quantities that are multiplied by colour terms; 0 where there is no terrain.

    First "as MATERIAL", kelvin above the air of each typical material, then sunlight, its history, and hidden sky.
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


def _known(plane: Values, otherwise: float) -> np.ndarray:
    """A terrain plane with NaN replaced by a number."""
    return np.where(np.isnan(plane), np.asarray(plane).dtype.type(otherwise), plane)


def lab_planes(rgb: np.ndarray) -> dict[str, np.ndarray]:
    """Return {"L", "a", "b": array} of sRGB, for `columns`."""
    return dict(zip("Lab", np.moveaxis(lab(rgb), -1, 0), strict=True))
