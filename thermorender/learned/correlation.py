"""Linear correlation from RGB to thermal intensity: 1-to-1 (one pixel) and 9-to-1 (3 × 3 pixels).

The two shipped maps carry the coefficients published with the method (Students' Space Association, Warsaw
University of Technology, "Generation of artificial infrared camera images for visual navigation simulation",
equation 9). Intensity is linear in band radiance: 0 stands for the coldest and 1 for the warmest end of the
campaign's temperature range; it is never clipped, since values outside are what the method gives.
"""

from dataclasses import dataclass, replace

import numpy as np

from thermorender.defaults import BAND_UM
from thermorender.errors import ThermorenderError
from thermorender.physics.planck import band_radiance
from thermorender.schema import did_you_mean
from thermorender.units import ZERO_CELSIUS_K


@dataclass(frozen=True)
class Correlation:
    """A linear RGB → intensity map.

    Attributes
    ----------
    name : str
    kernel : (k, k, 3) float64
        Weights of the k × k neighbourhood, first axis down the image, for R, G, B in 0…1.
    range_k : (2,) floats
        Temperatures of intensity 0 and 1 [K].
    band_um : (2,) floats
        Band of the camera it was trained with [µm].
    texel_m : float
        Ground sampling distance it was trained at [m].
    sky_temperature : float
        Isotropic sky its thermal images were taken under [K].
    source : str
    trained : dict or None
        When and in what weather its thermal images were taken: keys and values of a scene's [weather], a named day's.
        None where that is not known: the map cannot be moved to another hour unless the scene says it.
    error_k : float or None
        One standard deviation of its own error [K]; None: unknown.
    """

    name: str
    kernel: np.ndarray
    range_k: tuple
    band_um: tuple
    texel_m: float
    sky_temperature: float
    source: str
    trained: dict | None = None
    error_k: float | None = None

    def intensity(self, rgb, texel_m=None):
        """Return intensity, (h, w) float64, of an sRGB image, (h, w, 3) uint8.

        Parameters
        ----------
        rgb : (h, w, 3) uint8
        texel_m : float, optional
            Ground sampling distance of the image [m]; the neighbourhood is then laid out at the map's own
            distance. None applies it pixel by pixel, as published.

        Notes
        -----
        Cross-correlation centred on the pixel, without a flip. At the border the edge pixels are repeated, so
        the outermost ring (which the published method leaves out) is extrapolated.
        """
        import cv2

        image = rgb.astype(np.float64) / 255.0
        kernel = self.kernel if texel_m is None else self._kernel_at(self.texel_m / texel_m)
        return sum(
            cv2.filter2D(image[..., c], cv2.CV_64F, kernel[..., c], borderType=cv2.BORDER_REPLICATE) for c in range(3)
        )

    def _kernel_at(self, spacing):
        """Kernel whose taps lie `spacing` texels apart: bilinear between texels, averaged over a tap's area."""
        size = len(self.kernel)
        radius = int(np.ceil(size / 2 * spacing + 1))
        texel = np.arange(-radius, radius + 1)
        # Share of each texel in each tap, along one axis: linear interpolation, widened by a box where a tap
        # covers more than one texel.
        fine = (np.arange(64) + 0.5) / 64 - 0.5
        offset = (np.arange(size) - size // 2) * spacing
        sample = offset[:, None] + fine * max(spacing - 1.0, 0.0)
        share = np.clip(1.0 - np.abs(sample[:, None, :] - texel[:, None]), 0.0, 1.0).mean(axis=-1)
        return np.einsum("ia,jb,ijc->abc", share, share, self.kernel)

    def radiance(self, intensity):
        """Return apparent band radiance [W m⁻² sr⁻¹] of intensities; negative where no temperature exists."""
        cold, warm = band_radiance(np.array(self.range_k), *self.band_um)
        return cold + intensity * (warm - cold)


_FOK = {
    "range_k": (ZERO_CELSIUS_K + 14.0, ZERO_CELSIUS_K + 24.0),
    "band_um": BAND_UM,
    # 120 m, the campaign's greatest height, times 17 µm over 13 mm.
    "texel_m": 120.0 * 17e-6 / 13e-3,
    # The publication states no sky; assumed that of a clear mid-latitude summer day in this band.
    "sky_temperature": 255.0,
    "source": "Generation of artificial infrared camera images for visual navigation simulation, eq. 9",
}
_NINE = {
    "R": [[0.680, -0.089, 0.853], [-0.299, -0.973, -0.317], [0.991, -0.071, 1.112]],
    "G": [[0.789, -0.157, 0.511], [-0.302, -0.872, -0.451], [0.544, -0.235, 0.329]],
    "B": [[-1.314, 0.322, -1.201], [0.671, 1.873, 0.842], [-1.380, 0.382, -1.279]],
}
MODELS = {
    "fok-1to1": Correlation("fok-1to1", np.array([[[1.750, 0.236, -1.033]]]), **_FOK),
    "fok-9to1": Correlation("fok-9to1", np.stack([np.array(_NINE[c]) for c in "RGB"], axis=-1), **_FOK),
}


def load_model(name, range_c=None):
    """Return the learned map of this name, its temperature range replaced by `range_c` [°C] where given.

    Raises
    ------
    ThermorenderError
        An unknown name, or a range whose first value is not below its second.
    """
    if name not in MODELS:
        hint = did_you_mean(name, MODELS)
        raise ThermorenderError(f"learned map {name!r} is unknown; {hint}known are {', '.join(MODELS)}")
    model = MODELS[name]
    if range_c is None:
        return model
    low, high = (float(limit) for limit in range_c)
    if not -ZERO_CELSIUS_K < low < high:
        raise ThermorenderError(
            f"range_c=({low:g}, {high:g}) is not a range; give coldest and warmest in °C, coldest first"
        )
    return replace(model, range_k=(low + ZERO_CELSIUS_K, high + ZERO_CELSIUS_K))
