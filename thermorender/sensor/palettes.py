"""Colours of an 8-bit display image: white-hot, black-hot and ironbow."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError

# Evenly spaced from cold to hot: every sixteenth of the 224 entries of the Iron palette in FLIR's radiometric JPEGs,
# with the ends extended to black and white.
_IRONBOW = (
    (0, 0, 8), (22, 0, 107), (78, 0, 151), (125, 0, 168), (164, 10, 160), (197, 30, 136), (221, 55, 99), (240, 84, 64),
    (252, 113, 31), (255, 144, 4), (255, 176, 0), (255, 205, 11), (255, 230, 53), (252, 248, 136), (255, 255, 255),
)  # fmt: skip


def _ironbow() -> NDArray[np.uint8]:
    level = np.linspace(0.0, 255.0, len(_IRONBOW))
    channels = [np.interp(np.arange(256), level, channel) for channel in np.array(_IRONBOW).T]
    return np.rint(np.stack(channels, axis=-1)).astype(np.uint8)


# Tables from level to colour: (256,) grey or (256, 3) RGB.
PALETTES: dict[str, Callable[[], NDArray[np.uint8]]] = {
    "white-hot": lambda: np.arange(256, dtype=np.uint8),
    "black-hot": lambda: np.arange(255, -1, -1, dtype=np.uint8),
    "ironbow": _ironbow,
}


def palette(name: str) -> NDArray[np.uint8]:
    """Return the colours of the 256 levels, (256,) grey or (256, 3) RGB, uint8."""
    if name not in PALETTES:
        raise ThermorenderError(f"palette {name!r} is unknown; give one of {', '.join(PALETTES)}")
    return PALETTES[name]()
