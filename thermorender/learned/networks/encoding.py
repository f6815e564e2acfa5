"""Encoding of a network's inputs: planes of a picture, scaled to about one, for training and application.

Hour and weather become temperatures of typical materials per pixel: as plain numbers they did not improve accuracy.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np

from thermorender.learned.linear import Linear, Values, grounds, lab_planes
from thermorender.learned.rows import ExtraInputs, at_texel
from thermorender.learned.temperature_map import Inputs

# Greatest scale of a target, in its unit; its offset is also below.
_MOST_SCALE = 1e6
# Depth is encoded as the logarithm of its ratio to this [m].
_DEPTH_M = 100.0
# Units of terrain planes, by the beginning of their names.
_UNITS = (("normal_", 1.0), ("above_m", 5.0), ("sky_view", 1.0), ("sun", 300.0))


@dataclass(frozen=True)
class Encoding:
    """Encoding of Inputs."""

    extra: ExtraInputs = ExtraInputs()  # Inputs besides the picture
    depth: bool = False  # Whether depth is an input, with a plane that is 1 where it is known
    # offset, scale: The encoded target is (intensity or kelvin above the air − `offset`) / `scale`
    offset: float = 0.0
    scale: float = 1.0
    base: Linear | None = None  # A linear predictor whose kelvin are the last plane

    @property
    def needs(self) -> tuple[str, ...]:
        """Names of the required fields of Inputs."""
        return (*self.extra.needs, *(["depth"] if self.depth else ()))

    @cached_property
    def mixed(self) -> int:
        """Number of the last planes that are temperatures: of typical materials, and of the base."""
        if not self.extra.terrain:
            return 0
        return sum(name.startswith("as ") for name, _ in grounds(_Nothing(), self.extra)) + (self.base is not None)

    @property
    def channels(self) -> int:
        """Number of planes."""
        relief = len(self.extra.terrain) + 1 if self.extra.terrain else 0
        return 3 + 2 * self.depth + relief + self.mixed

    def planes(self, inputs: Inputs) -> np.ndarray:
        """Return the planes of Inputs, (channels, h, w) float32: the picture in −1…1 first."""
        self.extra.check(inputs)
        found = np.zeros((self.channels, *inputs.rgb.shape[:2]), np.float32)
        found[:3] = np.moveaxis(inputs.rgb, -1, 0).astype(np.float32) / np.float32(127.5) - np.float32(1.0)
        number = 3
        if self.depth:
            assert inputs.depth is not None
            known = np.isfinite(inputs.depth)
            found[3] = np.log(np.where(known, inputs.depth, _DEPTH_M) / _DEPTH_M)
            found[4] = known
            number = 5
        for name in self.extra.terrain:
            plane = inputs.terrain[name] / np.float32(_unit(name))
            found[number] = np.where(np.isnan(plane), 0.0, plane)
            number += 1
        if self.extra.terrain:
            found[number] = np.isfinite(inputs.terrain[self.extra.terrain[0]])
            number += 1
        if self.mixed:
            planes = {name: np.asarray(inputs.terrain[name], np.float32) for name in self.extra.terrain}
            values: dict[str, Values] = {**planes, **inputs.conditions}
            multiplied = list(grounds(values, self.extra))
            for plane in (plane for name, plane in multiplied if name.startswith("as ")):
                found[number] = (plane - self.offset) / self.scale
                number += 1
            if self.base is not None:
                values |= lab_planes(inputs.rgb)
                found[number] = (self.base.of_values(values, multiplied) - self.offset) / self.scale
        return found

    def at_range(self, inputs: Inputs, texel_range_m: tuple[float, float] | None) -> Inputs:
        """Return Inputs resampled to the nearest ground sampling distance of the training."""
        if inputs.texel_m is None or texel_range_m is None:
            return inputs
        return at_texel(inputs, float(np.clip(inputs.texel_m, *texel_range_m)))

    def header(self) -> dict[str, Any]:
        """Return its entries in a file's header."""
        plain: dict[str, Any] = {each.name: getattr(self, each.name) for each in fields(self)}
        return {**plain, "extra": asdict(self.extra), "base": self.base and self.base.header()}

    def arrays(self) -> dict[str, np.ndarray]:
        """Return its arrays in a file."""
        return {f"base/{name}": values for name, values in (self.base.arrays() if self.base else {}).items()}

    @classmethod
    def of(cls, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> "Encoding":
        """Return the Encoding of a header and arrays."""
        extra = ExtraInputs(**{name: tuple(names) for name, names in header["extra"].items()})
        scale, offset = float(header["scale"]), float(header["offset"])
        if not (abs(offset) < _MOST_SCALE and 0.0 < scale < _MOST_SCALE):
            raise ValueError("its offset or scale is not finite or too large, or its scale is not above 0")
        base = Linear.of(header["base"], {"weight": arrays["base/weight"]}) if header["base"] else None
        return cls(extra, bool(header["depth"]), offset, scale, base)


class _Nothing(dict[str, np.ndarray]):
    """Values of an empty picture."""

    def __missing__(self, name: str) -> np.ndarray:
        return np.zeros(0)


def _unit(name: str) -> float:
    """Unit that a terrain plane is divided by."""
    return next((unit for start, unit in _UNITS if name.startswith(start)), 1.0)
