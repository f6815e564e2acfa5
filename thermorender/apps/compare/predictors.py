"""Predictors of learned maps that remember their predictions, or put their intensities on a calibration line."""

import hashlib
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.learned.temperature_map import Inputs


class Remembered:
    """A map's predictor that keeps the last `most` predictions, all by default, for all bounds and materials.

    `spared_s` is the time saved minus that of the look-ups [s].
    """

    def __init__(self, predictor: Any, most: int | None = None) -> None:
        self.needs, self.above_air = predictor.needs, predictor.above_air
        self.header, self.arrays = predictor.header, predictor.arrays
        self.reach = getattr(predictor, "reach", None)
        self.spared_s = 0.0
        self.plain, self._most = predictor, most
        self._kept: dict[bytes, tuple[NDArray[np.float64], float]] = {}

    def predict(self, inputs: Inputs, texel_m: float) -> NDArray[np.float64]:
        """Return the predictor's intensities of an Inputs, (h, w) float64."""
        began = time.perf_counter()
        key = _content(inputs)
        self.spared_s -= time.perf_counter() - began
        if key in self._kept:
            found, seconds = self._kept[key]
            self.spared_s += seconds
            return found
        began = time.perf_counter()
        found = self.plain.predict(inputs, texel_m)
        self._kept[key] = found, time.perf_counter() - began
        if self._most and len(self._kept) > self._most:
            self._kept.pop(next(iter(self._kept)))
        return found


class Calibrated:
    """A map's predictor with intensities on a straight line: 0 becomes `first`, 1 becomes `first` + `slope`."""

    needs: tuple[str, ...] = ()
    above_air = False

    def __init__(self, predictor: Remembered, first: float, slope: float) -> None:
        self._predictor, self._line = predictor, (first, slope)
        self.arrays, self.reach = predictor.arrays, predictor.reach

    @property
    def spared_s(self) -> float:
        """As of `Remembered`."""
        return self._predictor.spared_s

    def header(self) -> dict[str, Any]:
        """Return the predictor's header with the calibration line."""
        return {**self._predictor.header(), "calibrated": self._line}

    def predict(self, inputs: Inputs, texel_m: float) -> NDArray[np.float64]:
        """Return calibrated intensities of an Inputs, (h, w) float64."""
        first, slope = self._line
        return first + slope * self._predictor.predict(inputs, texel_m)


def _content(inputs: Inputs) -> bytes:
    """Return a fingerprint of an Inputs."""
    state = hashlib.blake2b(digest_size=16)
    planes = {"rgb": inputs.rgb, "depth": inputs.depth, **inputs.terrain}
    plain = {name: values for name, values in planes.items() if values is not None}
    shapes = {name: values.shape for name, values in plain.items()}
    state.update(repr((shapes, inputs.texel_m, inputs.conditions)).encode())
    for values in plain.values():
        state.update(np.ascontiguousarray(values).data)
    return state.digest()
