"""What describes a texel to the emissivity map: its colour, and the colour and texture around it.

Colour is CIELAB (D65), where distances are about as large as people see them. Around the texel it is averaged over
Gaussian windows, and texture is told by its spread in them, by the gradient of lightness and by its coherence, which
is high where it has one direction (furrows, roofs, roads). Windows are counted in texels of the grid the map was
trained on: an orthophoto of another ground sampling distance is brought to that first.
"""

import numpy as np

from thermorender.learned.features import blurred, lab, structure

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


def features(rgb):
    """Return what describes each texel, (h, w, len(NAMES)) float32.

    Parameters
    ----------
    rgb : (h, w, 3) uint8
        sRGB on the grid the map was trained on; edges are repeated outwards.
    """
    # Centred, so that a spread is no small difference of large squares in single precision.
    image = lab(rgb) - np.float32((50.0, 0.0, 0.0))
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
