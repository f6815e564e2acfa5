"""Level and spread of a map's training pictures: of the temperatures of their ground, and of their colours."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from thermorender.learned.pixel_features import lab

# Larger pictures are subsampled by rows and columns for their distance.
_MOST_PIXELS = 100_000


@dataclass(frozen=True)
class TrainingLevel:
    """Means and standard deviations over the pixels of a map's training pictures."""

    kelvin: float  # Mean apparent temperature of ground [K]
    kelvin_spread: float
    kelvin_within: float  # Root mean square of the standard deviations within a picture [K]
    air_k: float | None  # Mean air temperature of the pictures, weighted by their ground [K]; None: unknown
    colour: tuple[float, float, float]  # Mean L, a and b (CIELAB) of ground
    colour_spread: tuple[float, float, float]

    def distance(self, rgb: np.ndarray) -> float:
        """Return how far the colours of a picture, (h, w, 3) uint8, are from the mean of training.

        It is the root mean square over pixels and over L, a and b, in standard deviations of the training: 1 for the
        training pictures themselves.
        """
        every = max(1, int(np.sqrt(rgb.shape[0] * rgb.shape[1] / _MOST_PIXELS)))
        away = (lab(rgb[::every, ::every]) - np.array(self.colour)) / np.array(self.colour_spread)
        return float(np.sqrt(np.mean(away**2)))

    def header(self) -> dict[str, Any]:
        """Return its entries in a map's file."""
        return asdict(self)

    @classmethod
    def of(cls, header: Mapping[str, Any]) -> "TrainingLevel":
        """Return the TrainingLevel of a map's file; ValueError where a number is missing or not allowed."""
        kelvin, spread, within = (float(header[name]) for name in ("kelvin", "kelvin_spread", "kelvin_within"))
        air_k = None if header["air_k"] is None else float(header["air_k"])
        lightness, a, b = map(float, header["colour"])
        of_lightness, of_a, of_b = map(float, header["colour_spread"])
        above_0 = [kelvin, spread, within, kelvin if air_k is None else air_k, of_lightness, of_a, of_b]
        if not (np.isfinite([*above_0, lightness, a, b]).all() and min(above_0) > 0.0):
            raise ValueError("its level of training is not of finite numbers, with kelvin and spreads above 0")
        return cls(kelvin, spread, within, air_k, (lightness, a, b), (of_lightness, of_a, of_b))


class LevelSums:
    """Sums over pixels of training pictures, for their TrainingLevel."""

    def __init__(self) -> None:
        # Numbers of pixels and of those with an air temperature; sums of kelvin, L, a, b; of their squares; of the air;
        # of squared distances from a picture's own mean.
        self._counts, self._first, self._second, self._air = np.zeros(2), np.zeros(4), np.zeros(4), 0.0
        self._within = 0.0

    def add(self, rgb: np.ndarray, kelvin: np.ndarray, air_k: float | None) -> None:
        """Add pixels, (n, 3) uint8 and (n,) [K], of a picture with an air temperature [K] or None."""
        if not len(kelvin):
            return
        values = np.column_stack([kelvin, lab(rgb)]).astype(np.float64)
        self._within += float(((kelvin - kelvin.mean()) ** 2).sum())
        self._first += values.sum(axis=0)
        self._second += (values**2).sum(axis=0)
        self._counts += len(values), 0 if air_k is None else len(values)
        self._air += 0.0 if air_k is None else air_k * len(values)

    def level(self) -> TrainingLevel | None:
        """Return the TrainingLevel; None where pictures are of one temperature or all pixels of one grey."""
        pixels, with_air = self._counts
        if not pixels:
            return None
        mean = self._first / pixels
        spread = np.sqrt(np.maximum(self._second / pixels - mean**2, 0.0))
        within = float(np.sqrt(self._within / pixels))
        if not (np.append(spread, within) > 1e-6).all():
            return None
        # An air temperature of some of the pictures only is not that of the level.
        air = self._air / pixels if with_air == pixels else None
        (kelvin, *colour), (kelvin_spread, *colour_spread) = mean.tolist(), spread.tolist()
        return TrainingLevel(kelvin, kelvin_spread, within, air, tuple(colour), tuple(colour_spread))
