"""The sRGB curve between image bytes and linear light.

colour-science has the same curve but takes seconds to import; a test compares the two.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray


def decoded(value: ArrayLike) -> NDArray[Any]:
    """Return the linear light, 0…1 [1], of sRGB values 0…1, in their shape and precision.

    IEC 61966-2-1:1999, section 5.2.
    """
    value = np.asarray(value)
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def encoded(light: NDArray[Any]) -> NDArray[Any]:
    """Return the sRGB values, 0…1 [1], of linear light 0…1, in its shape and precision; the inverse of `decoded`.

    The curve is continued below 0 and above 1. IEC 61966-2-1:1999, section 5.3.
    """
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)


def linear_from_bytes(colour: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the linear light [1], float32 in the shape of `colour`, of sRGB bytes."""
    return decoded(np.arange(256) / 255.0).astype(np.float32)[colour]


def bytes_from_linear(light: NDArray[Any]) -> NDArray[np.uint8]:
    """Return the nearest sRGB bytes, in the shape of `light`, of linear light clipped to 0…1 [1]."""
    return np.clip(np.rint(encoded(light) * 255.0), 0, 255).astype(np.uint8)
