"""Features of a pixel for learned maps: its colour, the colour and texture around it, statistics of the whole picture.

Colour is CIELAB (D65), averaged over Gaussian windows, each twice as wide as the one before. Texture is the spread in
these windows, the gradient of lightness and its coherence, high for one direction (furrows, roofs, roads). Medians,
spreads and shares of dark and bright pixels of the picture indicate exposure, season and snow. Windows are counted in
pixels, so pictures are first resampled to the map's ground sampling distance (`rows.at_texel`).
"""

import numpy as np

from thermorender.physics.srgb import decoded

# Standard deviations of the windows [pixels].
WINDOWS = (1.0, 2.0, 4.0, 8.0, 16.0)
# Windows that contrast is taken against, and that gradients are averaged over.
_CONTRAST_WINDOWS = (4.0, 16.0)
_GRADIENT_WINDOWS = (2.0, 8.0)
# Radius that a pixel's features depend on [pixels]: windows end at three standard deviations, and gradients use
# neighbours' blurred values.
HALO = 52
# Lightness below and above which a pixel counts as dark (deep shadow) or bright (snow, clouds).
_DARK, _BRIGHT = 15.0, 85.0
# Larger pictures are subsampled by rows and columns for the statistics of the whole.
_MOST_PIXELS_OF_WHOLE = 100_000
WHOLE = (*(f"median {c}" for c in "Lab"), *(f"spread of {c}" for c in "Lab"), "dark", "bright")
NAMES = (
    "L", "a", "b",
    *(f"{channel} above median" for channel in "Lab"),
    *(f"{channel} mean {window:g}" for window in WINDOWS for channel in "Lab"),
    *(f"{what} spread {window:g}" for window in WINDOWS for what in ("L", "chroma")),
    *(f"L above mean {window:g}" for window in _CONTRAST_WINDOWS),
    *(f"{what} {window:g}" for window in _GRADIENT_WINDOWS for what in ("gradient", "coherence")),
    *WHOLE,
)  # fmt: skip


def lab(rgb: np.ndarray | np.uint8) -> np.ndarray:
    """Return CIELAB (D65), (..., 3) float32, of sRGB bytes."""
    import colour

    light = decoded(np.arange(256) / 255.0)[rgb]
    to_xyz = colour.models.RGB_COLOURSPACE_sRGB.matrix_RGB_to_XYZ
    return colour.XYZ_to_Lab(light @ to_xyz.T).astype(np.float32)


def blurred(image: np.ndarray, window: float) -> np.ndarray:
    """Return an image's Gaussian mean with standard deviation `window` [pixels], cut at three; edges are repeated."""
    import cv2

    size = 2 * int(np.ceil(3.0 * window)) + 1
    return cv2.GaussianBlur(image, (size, size), window, borderType=cv2.BORDER_REPLICATE)


def structure(lightness: np.ndarray, window: float) -> tuple[np.ndarray, np.ndarray]:
    """Return (gradient, coherence), (h, w) float32, of lightness, (h, w) float32, within a Gaussian window [pixels].

    Gradient is log(1 + root mean square [per pixel]); coherence is from 0, no direction, to 1, a single one. They are
    the sum of the structure tensor's eigenvalues, and their difference over the sum. Förstner & Gülch 1987, "A fast
    operator for detection and precise location of distinct points, corners and centres of circular features".
    """
    import cv2

    soft = blurred(lightness, 0.8)
    across = cv2.Sobel(soft, cv2.CV_32F, 1, 0, scale=0.125, borderType=cv2.BORDER_REPLICATE)
    down = cv2.Sobel(soft, cv2.CV_32F, 0, 1, scale=0.125, borderType=cv2.BORDER_REPLICATE)
    xx, yy, xy = (blurred(product, window) for product in (across * across, down * down, across * down))
    total = xx + yy
    coherence = np.sqrt((xx - yy) ** 2 + 4.0 * xy * xy) / (total + 0.05)
    return np.log1p(np.sqrt(total)), coherence


def whole_picture(rgb: np.ndarray) -> np.ndarray:
    """Return statistics `WHOLE` of a picture, (len(WHOLE),) float32; spread is half the range of the middle 68 %."""
    every = int(np.ceil(np.sqrt(max(rgb.shape[0] * rgb.shape[1] / _MOST_PIXELS_OF_WHOLE, 1.0))))
    image = lab(rgb[::every, ::every]).reshape(-1, 3)
    low, middle, high = np.percentile(image, (16.0, 50.0, 84.0), axis=0)
    dark, bright = np.mean(image[:, 0] < _DARK), np.mean(image[:, 0] > _BRIGHT)
    return np.array([*middle, *(0.5 * (high - low)), dark, bright], np.float32)


def features(rgb: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """Return the features of each pixel, (len(NAMES), h, w) float32, from arguments as of `feature_planes`."""
    found = np.empty((len(NAMES), *rgb.shape[:2]), np.float32)
    for number, plane in enumerate(feature_planes(rgb, whole)):
        found[number] = plane
    return found


def feature_planes(rgb: np.ndarray, whole: np.ndarray) -> list[np.ndarray]:
    """Return the features of each pixel of a part of a picture, (h, w) float32, or () for those of the whole.

    `rgb` is (h, w, 3) uint8 at the map's ground sampling distance, with edges repeated; `whole` as by `whole_picture`.
    """
    # Centred, because the variance is a difference of squares in single precision.
    centre = np.array((50.0, 0.0, 0.0), np.float32)
    image = lab(rgb) - centre
    means, spreads = {}, []
    for window in WINDOWS:
        means[window] = blurred(image, window)
        variance = np.maximum(blurred(image * image, window) - means[window] ** 2, 0.0)
        spreads += [variance[..., 0], variance[..., 1] + variance[..., 2]]
    return [
        *np.moveaxis(image + centre, -1, 0),
        *np.moveaxis(image + centre - whole[:3], -1, 0),
        *(plane for window in WINDOWS for plane in np.moveaxis(means[window] + centre, -1, 0)),
        *(np.log1p(np.sqrt(spread)) for spread in spreads),
        *(image[..., 0] - means[window][..., 0] for window in _CONTRAST_WINDOWS),
        *(plane for window in _GRADIENT_WINDOWS for plane in structure(image[..., 0], window)),
        *map(np.asarray, whole),
    ]
