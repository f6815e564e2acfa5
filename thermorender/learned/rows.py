"""Rows of a table: what maps that learn from single pixels are given, at the map's own ground sampling distance.

A row is a pixel. Its columns are what describes it in the picture (`features`), what the terrain knows of it, and hour
and weather, the same for all pixels of a picture.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.learned.features import HALO, NAMES, features, whole_picture
from thermorender.learned.temperature_map import Inputs

# A picture is taken as it is where its ground sampling distance differs from the map's by less than this share.
_SAME_TEXEL = 0.1
# A coarser one is enlarged by no more than this: what it has no texture of would only cost memory.
_MOST_ENLARGED = 2.0
# Side of the parts that a large picture is described in [pixels].
_TILE = 768
# Side of the part of a picture that pixels are drawn from [pixels]: to describe a whole one takes five times as long.
_WINDOW = 256
# A terrain's plane that holds numbers of classes, with no order.
CLASSES = "material"


def at_texel(inputs, texel_m):
    """Return Inputs brought to a ground sampling distance [m]: themselves where theirs is that or unknown.

    Colours are averaged over areas or interpolated; the terrain's planes, which may hold classes and NaN, keep the
    nearest value.
    """
    import cv2

    if inputs.texel_m is None or texel_m is None or abs(inputs.texel_m / texel_m - 1.0) <= _SAME_TEXEL:
        return inputs
    ratio = min(inputs.texel_m / texel_m, _MOST_ENLARGED)
    size = [max(1, round(n * ratio)) for n in inputs.rgb.shape[1::-1]]
    rgb = at_shape(inputs.rgb, size[::-1])
    terrain = {
        name: cv2.resize(np.float32(plane), size, interpolation=cv2.INTER_NEAREST_EXACT)
        for name, plane in inputs.terrain.items()
    }
    depth = inputs.depth
    if depth is not None:
        depth = cv2.resize(np.float32(depth), size, interpolation=cv2.INTER_NEAREST_EXACT)
    return replace(inputs, rgb=rgb, texel_m=inputs.texel_m / ratio, terrain=terrain, depth=depth)


def at_shape(image, shape):
    """Return an image resampled to (rows, columns): means over areas where that is fewer, else interpolated."""
    import cv2

    if image.shape[:2] == tuple(shape):
        return image
    fewer = shape[0] * shape[1] < image.shape[0] * image.shape[1]
    return cv2.resize(image, shape[::-1], interpolation=cv2.INTER_AREA if fewer else cv2.INTER_LINEAR)


@dataclass(frozen=True)
class ExtraInputs:
    """Names of what a map takes as input besides the picture, each sorted.

    Attributes
    ----------
    terrain, conditions : tuple of str
        Fields of Inputs.
    """

    terrain: tuple = ()
    conditions: tuple = ()

    def __post_init__(self):
        if not all(isinstance(name, str) for name in (*self.terrain, *self.conditions)):
            raise ValueError("it takes something without a name as input")

    @classmethod
    def of(cls, inputs):
        """Return the names that Inputs have."""
        return cls(tuple(sorted(inputs.terrain)), tuple(sorted(inputs.conditions)))

    @property
    def needs(self):
        """Names of the fields of Inputs that are needed."""
        return tuple(name for name in ("terrain", "conditions") if getattr(self, name))

    @property
    def above_air(self):
        """Whether the air's temperature is an input, so that kelvin above it are learned."""
        return "air_k" in self.conditions

    def check(self, inputs):
        """Refuse Inputs that lack something.

        Raises
        ------
        ThermorenderError
            The message names it.
        """
        for what in ("terrain", "conditions"):
            given = getattr(inputs, what)
            missing = [name for name in getattr(self, what) if name not in given]
            if missing:
                raise ThermorenderError(
                    f"{what} of a picture have {', '.join(sorted(given)) or 'nothing'} and lack {', '.join(missing)}, "
                    "which the map was trained with; give those, or train the map without them"
                )

    @property
    def columns(self):
        """Names of the columns of `tiles`."""
        return (*NAMES, *self.terrain, *self.conditions)

    def tiles(self, inputs, window=None):
        """Give ((rows, columns) slices, (len(columns), h, w) float32) of a picture, part by part.

        Parameters
        ----------
        inputs : Inputs
            At the map's ground sampling distance.
        window : (4,) ints, optional
            First and last row and column of the part that is asked for; the whole by default.
        """
        self.check(inputs)
        whole = whole_picture(inputs.rgb)
        height, width = inputs.rgb.shape[:2]
        first_row, last_row, first_column, last_column = window or (0, height, 0, width)
        for top in range(first_row, last_row, _TILE):
            for left in range(first_column, last_column, _TILE):
                bottom, right = min(top + _TILE, last_row), min(left + _TILE, last_column)
                up, before = max(top - HALO, 0), max(left - HALO, 0)
                part = features(inputs.rgb[up : bottom + HALO, before : right + HALO], whole)
                part = part[:, top - up : bottom - up, left - before : right - before]
                here = slice(top, bottom), slice(left, right)
                table = np.empty((len(self.columns), *part.shape[1:]), np.float32)
                table[: len(part)] = part
                for number, name in enumerate(self.terrain, len(part)):
                    table[number] = inputs.terrain[name][here]
                for number, name in enumerate(self.conditions, len(part) + len(self.terrain)):
                    table[number] = inputs.conditions[name]
                yield here, table


@dataclass(frozen=True, eq=False)
class Drawn:
    """Pixels drawn from an example.

    Attributes
    ----------
    number : int
        Of the example.
    inputs : Inputs
        At the map's ground sampling distance.
    window : (4,) ints
        First and last row and column of the part that they lie in.
    pixels : (n,) int
        Row times width plus column, ascending.
    target : (n,) float64
        Intensity, or apparent temperature above the air's [K].
    """

    number: int
    inputs: Inputs
    window: tuple
    pixels: np.ndarray
    target: np.ndarray


def drawn(task, extra, most) -> Iterator[Drawn]:
    """Give the Drawn of each example of a Task: as many pixels of each, `most`, or all where it has fewer.

    They are drawn from a part of the picture that is placed about one of its valid pixels at random.

    Raises
    ------
    ThermorenderError
        No example has a pixel to learn from, or one lacks what the others have.
    """
    generator = np.random.Generator(np.random.Philox(task.seed))
    empty = True
    for number, example in enumerate(task.examples):
        extra.check(example.inputs)
        inputs = at_texel(example.inputs, task.texel_m)
        if extra.above_air:
            target = task.temperature[example.values] - inputs.conditions["air_k"]
        else:
            target = task.intensity[example.values]
        usable = example.valid & np.isfinite(target)
        shape = inputs.rgb.shape[:2]
        if shape != target.shape:
            # A pixel all of whose parts are valid.
            target = at_shape(np.where(usable, target, 0.0), shape)
            usable = at_shape(usable.astype(np.float32), shape) > 0.999
        window = _window(usable, generator)
        inside = np.zeros(shape, bool)
        inside[window[0] : window[1], window[2] : window[3]] = True
        pixels = np.flatnonzero(usable & inside)
        if pixels.size > most:
            pixels = np.sort(generator.choice(pixels, most, replace=False))
        empty &= pixels.size == 0
        yield Drawn(number, inputs, window, pixels, target.ravel()[pixels])
        task.progress("reading", (number + 1) / len(task.examples))
    if empty:
        raise ThermorenderError(
            f"none of {len(task.examples)} pairs has a valid pixel to learn from; give pairs whose pictures overlap"
        )


def _window(usable, generator):
    """First and last row and column of a part of a picture, about a pixel of it that can be used."""
    within = np.flatnonzero(usable)
    if not within.size:
        return 0, 0, 0, 0
    at = np.divmod(within[generator.integers(within.size)], usable.shape[1])
    found = []
    for place, size in zip(at, usable.shape, strict=True):
        first = int(np.clip(place - generator.integers(_WINDOW), 0, max(size - _WINDOW, 0)))
        found += [first, min(first + _WINDOW, size)]
    return tuple(found)
