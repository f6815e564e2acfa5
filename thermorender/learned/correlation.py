"""Linear correlation from RGB to thermal intensity: each pixel from the k × k colours around it.

The coefficients of the two published maps are from Students' Space Association, Warsaw University of Technology,
"Generation of artificial infrared camera images for visual navigation simulation", equation 9.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from thermorender.learned.temperature_map import Inputs

# Largest neighbourhood: 3 × 15² coefficients.
MOST_SIDE = 15


@dataclass(frozen=True, eq=False)
class Correlation:
    """A linear RGB → intensity predictor.

    Attributes
    ----------
    kernel : (k, k, 3) float64
        Weights of the k × k neighbourhood, first axis down the image, for R, G, B in 0…1.
    intercept : float
        0 in the published form.
    above_air : bool
        Whether it predicts kelvin above the air instead of intensity.
    """

    kernel: np.ndarray
    intercept: float = 0.0
    above_air: bool = False

    @property
    def needs(self) -> tuple[str, ...]:
        """Names of the required fields of Inputs."""
        return ("conditions",) if self.above_air else ()

    def predict(self, inputs: "Inputs", texel_m: float | None) -> np.ndarray:
        """Return intensity, or kelvin above the air, (h, w) float64.

        Notes
        -----
        Cross-correlation centred on the pixel. Edge pixels are repeated at the border, so the outermost ring, which the
        published method leaves out, is extrapolated. For an image at another ground sampling distance than `texel_m`,
        the kernel's taps are spaced accordingly.
        """
        import cv2

        image = inputs.rgb.astype(np.float64) / 255.0
        kernel = self.kernel
        if inputs.texel_m is not None and texel_m is not None:
            kernel = self._kernel_at(texel_m / inputs.texel_m)
        found = [
            cv2.filter2D(image[..., c], cv2.CV_64F, kernel[..., c], borderType=cv2.BORDER_REPLICATE) for c in range(3)
        ]
        return np.asarray(self.intercept + sum(found))

    def reach(self, spacing: float = 1.0) -> int:
        """Return the radius of the neighbourhood [pixels], with taps `spacing` pixels apart."""
        return math.ceil(len(self.kernel) // 2 * spacing + 0.5 * max(spacing - 1.0, 0.0) + 1.0) - 1

    def _kernel_at(self, spacing: float) -> np.ndarray:
        """Kernel with taps `spacing` texels apart: bilinear between texels, averaged over a tap's area."""
        size = len(self.kernel)
        radius = int(np.ceil(size / 2 * spacing + 1))
        texel = np.arange(-radius, radius + 1)
        # Share of each texel in each tap along one axis: linear interpolation, averaged where a tap covers more than
        # one texel.
        fine = (np.arange(64) + 0.5) / 64 - 0.5
        offset = (np.arange(size) - size // 2) * spacing
        sample = offset[:, None] + fine * max(spacing - 1.0, 0.0)
        share = np.clip(1.0 - np.abs(sample[:, None, :] - texel[:, None]), 0.0, 1.0).mean(axis=-1)
        return np.einsum("ia,jb,ijc->abc", share, share, self.kernel)

    def header(self) -> dict[str, Any]:
        """Return its entries in the file's header."""
        return {"intercept": self.intercept, "above_air": self.above_air}

    def arrays(self) -> dict[str, np.ndarray]:
        """Return its arrays in the file."""
        return {"kernel": self.kernel}

    @classmethod
    def of(cls, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> "Correlation":
        """Return the Correlation of `header` and `arrays`."""
        kernel = np.asarray(arrays["kernel"], np.float64)
        if kernel.ndim != 3 or kernel.shape[0] != kernel.shape[1] or len(kernel) % 2 != 1 or kernel.shape[2] != 3:
            raise ValueError("its kernel is not k × k × 3 with odd k")
        if len(kernel) > MOST_SIDE:
            raise ValueError(f"its kernel is {len(kernel)} wide, more than {MOST_SIDE}")
        intercept, above_air = float(header["intercept"]), header["above_air"]
        if not (np.isfinite(kernel).all() and np.isfinite(intercept)):
            raise ValueError("it has coefficients that are not finite")
        if not isinstance(above_air, bool):
            raise ValueError("above_air is neither true nor false")
        return cls(kernel, intercept, above_air)


_NINE = {
    "R": [[0.680, -0.089, 0.853], [-0.299, -0.973, -0.317], [0.991, -0.071, 1.112]],
    "G": [[0.789, -0.157, 0.511], [-0.302, -0.872, -0.451], [0.544, -0.235, 0.329]],
    "B": [[-1.314, 0.322, -1.201], [0.671, 1.873, 0.842], [-1.380, 0.382, -1.279]],
}
PUBLISHED_1TO1 = Correlation(np.array([[[1.750, 0.236, -1.033]]]))
PUBLISHED_9TO1 = Correlation(np.stack([np.array(_NINE[channel]) for channel in "RGB"], axis=-1))
