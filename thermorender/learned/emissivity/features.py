"""Features of a texel for the emissivity map: its colour, and the colour and texture around it, as in `pixel_features`.

Windows are counted in texels of the training grid, to which an orthophoto is resampled first.
"""

import numpy as np

from thermorender.learned.pixel_features import blurred, lab, structure

# Standard deviations of the windows [texels].
WINDOWS_TEXELS = (1.5, 4.0, 10.0)
# Radius that a texel's features depend on: windows end at three standard deviations, and gradients use neighbours'
# blurred values.
HALO_TEXELS = 32
NAMES = (
    "L", "a", "b",
    *(f"{channel} mean {window:g}" for window in WINDOWS_TEXELS for channel in "Lab"),
    *(f"{what} spread {window:g}" for window in WINDOWS_TEXELS for what in ("L", "chroma")),
    "gradient", "coherence",
)  # fmt: skip
# Features of the texel and its near surroundings. Wide windows see combinations of ground that training cannot cover.
NEAR = tuple(k for k, name in enumerate(NAMES) if not name.endswith(f"{WINDOWS_TEXELS[-1]:g}") and name != "coherence")


def features(rgb: np.ndarray) -> np.ndarray:
    """Return the features of each texel, (h, w, len(NAMES)) float32, of sRGB (h, w, 3) uint8 on the training grid.

    Edges are repeated outwards.
    """
    # Centred, because the variance is a difference of squares in single precision.
    image = lab(rgb) - np.array((50.0, 0.0, 0.0), np.float32)
    found = [image]
    spreads = []
    for window in WINDOWS_TEXELS:
        around = blurred(image, window)
        variance = np.maximum(blurred(image * image, window) - around * around, 0.0)
        found.append(around)
        spreads += [variance[..., 0], variance[..., 1] + variance[..., 2]]
    found.append(np.log1p(np.sqrt(np.stack(spreads, axis=-1))))
    found.append(np.stack(structure(image[..., 0], WINDOWS_TEXELS[1]), axis=-1))
    return np.concatenate(found, axis=-1)
