"""The sRGB curve between bytes as images store them and linear light.

colour-science has the same curve but takes seconds to import; a test holds the two together.
"""

import numpy as np


def decoded(value):
    """Return the linear light, 0…1, of sRGB values 0…1, in their shape and precision.

    Notes
    -----
    IEC 61966-2-1:1999, section 5.2.
    """
    value = np.asarray(value)
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def encoded(light):
    """Return the sRGB values, 0…1, of linear light 0…1, in its shape and precision; the inverse of `decoded`.

    Light below 0 or above 1 continues the curve; IEC 61966-2-1:1999, section 5.3.
    """
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)


def linear_from_bytes(colour):
    """Return the linear light, float32 in the shape of `colour`, of sRGB bytes."""
    return decoded(np.arange(256) / 255.0).astype(np.float32)[colour]


def bytes_from_linear(light):
    """Return the sRGB bytes, in the shape of `light`, nearest to linear light; what lies outside 0…1 is cut."""
    return np.clip(np.rint(encoded(light) * 255.0), 0, 255).astype(np.uint8)
