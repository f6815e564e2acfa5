"""Colours without a picture around them, such as those of faces: a map sees each as an even area of its colour."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from thermorender.learned.temperature_map import Inputs, TemperatureMap

# Side of an even area for a map whose reach is not known, a network: the square of pix2pix [pixels].
EVEN_PX = 256
# Such a map sees levels in steps of this, the middle of each: areas are translated one by one.
_STEP = 16
# Largest picture of areas side by side [pixels].
_MOST_PIXELS = 1 << 20


class Even:
    """A map's predictor for pixels that are not neighbours in space; it takes colour only."""

    needs: tuple[str, ...] = ()

    def __init__(self, model: TemperatureMap) -> None:
        self._predictor, self.above_air = model.predictor, model.predictor.above_air
        self.header, self.arrays = model.predictor.header, model.predictor.arrays

    def predict(self, inputs: Inputs, texel_m: float | None) -> NDArray[np.float64]:
        """Return the predictor's values of the middles of even areas of the colours of `inputs`, (h, w) float64."""
        rgb = inputs.rgb.reshape(-1, 3)
        reach = getattr(self._predictor, "reach", None)
        side = EVEN_PX if reach is None else 2 * reach() + 1
        if reach is None:
            rgb = rgb // _STEP * _STEP + _STEP // 2
        colours, at = np.unique(rgb, axis=0, return_inverse=True)
        # One below the other: the middle of an area sees no other within the reach. A network sees one at a time.
        found, most = np.empty(len(colours)), 1 if reach is None else max(1, _MOST_PIXELS // side**2)
        for first in range(0, len(colours), most):
            some = colours[first : first + most, None]
            picture = np.repeat(np.repeat(some, side, axis=0), side, axis=1)
            values = self._predictor.predict(Inputs(picture), texel_m)
            found[first : first + most] = values[side // 2 :: side, side // 2]
        return found[at.ravel()].reshape(inputs.rgb.shape[:2])


def even(model: TemperatureMap) -> TemperatureMap:
    """Return a TemperatureMap that sees each pixel of a picture as an even area of its colour."""
    return replace(model, predictor=Even(model))
