"""Table rows for maps of single pixels, at the map's ground sampling distance.

Columns are a pixel's `pixel_features`, its relief, and hour and weather, which are the same for a whole picture.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.learned.pixel_features import HALO, NAMES, feature_planes, whole_picture
from thermorender.learned.temperature_map import Inputs

# A picture is not resampled if its ground sampling distance differs from the map's by less than this share.
_SAME_TEXEL = 0.1
# A coarser picture is enlarged at most this much: more would cost memory and add no texture.
_MOST_ENLARGED = 2.0
# Side of the tiles for features of a large picture [pixels].
_TILE = 768
# The terrain plane that holds class numbers, which have no order.
CLASSES = "material"


def at_texel(inputs: Inputs, texel_m: float | None) -> Inputs:
    """Return Inputs resampled to a ground sampling distance [m], or unchanged if theirs is the same or unknown.

    Colours are averaged or interpolated; terrain planes keep the nearest value.
    """
    import cv2

    if inputs.texel_m is None or texel_m is None or abs(inputs.texel_m / texel_m - 1.0) <= _SAME_TEXEL:
        return inputs
    ratio = min(inputs.texel_m / texel_m, _MOST_ENLARGED)
    size = [max(1, round(n * ratio)) for n in inputs.rgb.shape[1::-1]]
    rgb = at_shape(inputs.rgb, size[::-1])
    terrain = {
        name: cv2.resize(plane.astype(np.float32), size, interpolation=cv2.INTER_NEAREST_EXACT)
        for name, plane in inputs.terrain.items()
    }
    depth = inputs.depth
    if depth is not None:
        depth = cv2.resize(depth.astype(np.float32), size, interpolation=cv2.INTER_NEAREST_EXACT)
    return replace(inputs, rgb=rgb, texel_m=inputs.texel_m / ratio, terrain=terrain, depth=depth)


def at_shape(image: np.ndarray, shape: Sequence[int]) -> np.ndarray:
    """Return an image resampled to (rows, columns): averaged over areas if that is fewer pixels, else interpolated."""
    import cv2

    if image.shape[:2] == tuple(shape):
        return image
    fewer = shape[0] * shape[1] < image.shape[0] * image.shape[1]
    return cv2.resize(image, shape[::-1], interpolation=cv2.INTER_AREA if fewer else cv2.INTER_LINEAR)


@dataclass(frozen=True)
class ExtraInputs:
    """Names of a map's inputs besides the picture, sorted."""

    # terrain, conditions: Fields of Inputs
    terrain: tuple[str, ...] = ()
    conditions: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not all(isinstance(name, str) for name in (*self.terrain, *self.conditions)):
            raise ValueError("one of its inputs has no name")

    @classmethod
    def of(cls, inputs: Inputs) -> "ExtraInputs":
        """Return the names of all terrain planes and conditions of Inputs."""
        return cls(tuple(sorted(inputs.terrain)), tuple(sorted(inputs.conditions)))

    @property
    def needs(self) -> tuple[str, ...]:
        """Names of the required fields of Inputs."""
        return tuple(name for name in ("terrain", "conditions") if getattr(self, name))

    @property
    def above_air(self) -> bool:
        """Whether air temperature is an input, so that the target is kelvin above it."""
        return "air_k" in self.conditions

    def check(self, inputs: Inputs) -> None:
        """Raise ThermorenderError if Inputs lack a plane or condition; the message names it."""
        for what in ("terrain", "conditions"):
            given = getattr(inputs, what)
            missing = [name for name in getattr(self, what) if name not in given]
            if missing:
                raise ThermorenderError(
                    f"{what} of a picture have {', '.join(sorted(given)) or 'nothing'} and lack {', '.join(missing)}, "
                    "which the map was trained with; add them, or train the map without them"
                )

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns of `planes`."""
        return (*NAMES, *self.terrain, *self.conditions)

    def planes(
        self, inputs: Inputs, window: tuple[int, int, int, int] | None = None
    ) -> Iterator[tuple[tuple[slice, slice], list[np.ndarray]]]:
        """Yield ((rows, columns) slices, values of each column) of a picture at the map's texel, tile by tile.

        Values are (h, w) float32, or () for all pixels alike. `window` is (first row, end row, first column, end
        column).
        """
        self.check(inputs)
        whole = whole_picture(inputs.rgb)
        conditions = [np.asarray(inputs.conditions[name], np.float32) for name in self.conditions]
        height, width = inputs.rgb.shape[:2]
        first_row, last_row, first_column, last_column = window or (0, height, 0, width)
        for top in range(first_row, last_row, _TILE):
            for left in range(first_column, last_column, _TILE):
                bottom, right = min(top + _TILE, last_row), min(left + _TILE, last_column)
                up, before = max(top - HALO, 0), max(left - HALO, 0)
                part = feature_planes(inputs.rgb[up : bottom + HALO, before : right + HALO], whole)
                inner = np.s_[top - up : bottom - up, left - before : right - before]
                here = slice(top, bottom), slice(left, right)
                yield (
                    here,
                    [
                        *(plane[inner] if plane.ndim else plane for plane in part),
                        *(np.asarray(inputs.terrain[name][here], np.float32) for name in self.terrain),
                        *conditions,
                    ],
                )
