"""What describes a texel to the emissivity map: its colour, and the colour and texture around it.

Colour is CIELAB (D65), where distances are about as large as people see them. Around the texel it is averaged over
Gaussian windows, and texture is told by its spread in them, by the gradient of lightness and by its coherence, which
is high where it has one direction (furrows, roofs, roads). Windows are counted in texels of the grid the map was
trained on: an orthophoto of another ground sampling distance is brought to that first.
"""

import numpy as np

from thermorender.physics.srgb import decoded

# Standard deviations of the windows [texels].
WINDOWS_TEXELS = (1.5, 4.0, 10.0)
# Texels around a tile that its features depend on: a window is cut at three standard deviations, and spreads and
# gradients are taken of values that are neighbours' already.
HALO_TEXELS = 32
NAMES = (
    "L", "a", "b",
    *(f"{channel} mean {window:g}" for window in WINDOWS_TEXELS for channel in "Lab"),
    *(f"{what} spread {window:g}" for window in WINDOWS_TEXELS for what in ("L", "chroma")),
    "gradient", "coherence",
)  # fmt: skip
# Those of the texel and its near surroundings. The wide windows tell what else is about, in combinations that no
# training ground has all of.
NEAR = tuple(k for k, name in enumerate(NAMES) if not name.endswith(f"{WINDOWS_TEXELS[-1]:g}") and name != "coherence")


def lab(rgb):
    """Return CIELAB (D65), (..., 3) float32, of sRGB bytes."""
    import colour

    # The eye of the standard needs no more than a byte per channel: each is linearised once.
    light = decoded(np.arange(256) / 255.0)[rgb]
    to_xyz = colour.models.RGB_COLOURSPACE_sRGB.matrix_RGB_to_XYZ
    return colour.XYZ_to_Lab(light @ to_xyz.T).astype(np.float32)


def features(rgb):
    """Return what describes each texel, (h, w, len(NAMES)) float32.

    Parameters
    ----------
    rgb : (h, w, 3) uint8
        sRGB on the grid the map was trained on; edges are repeated outwards.
    """
    import cv2

    def mean(image, window):
        size = 2 * int(np.ceil(3.0 * window)) + 1
        return cv2.GaussianBlur(image, (size, size), window, borderType=cv2.BORDER_REPLICATE)

    # Centred, so that a spread is no small difference of large squares in single precision.
    image = lab(rgb) - np.float32((50.0, 0.0, 0.0))
    found = [image]
    spreads = []
    for window in WINDOWS_TEXELS:
        around = mean(image, window)
        variance = np.maximum(mean(image * image, window) - around * around, 0.0)
        found.append(around)
        spreads += [variance[..., 0], variance[..., 1] + variance[..., 2]]
    found.append(np.log1p(np.sqrt(np.stack(spreads, axis=-1))))
    soft = mean(image[..., 0], 0.8)
    across = cv2.Sobel(soft, cv2.CV_32F, 1, 0, scale=0.125, borderType=cv2.BORDER_REPLICATE)
    down = cv2.Sobel(soft, cv2.CV_32F, 0, 1, scale=0.125, borderType=cv2.BORDER_REPLICATE)
    # Eigenvalues of the structure tensor (Förstner & Gülch 1987): their sum and the share of their difference.
    xx, yy, xy = (mean(product, WINDOWS_TEXELS[1]) for product in (across * across, down * down, across * down))
    total = xx + yy
    coherence = np.sqrt((xx - yy) ** 2 + 4.0 * xy * xy) / (total + 0.05)
    found.append(np.stack([np.log1p(np.sqrt(total)), coherence], axis=-1))
    return np.concatenate(found, axis=-1)
