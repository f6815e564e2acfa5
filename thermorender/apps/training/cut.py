"""Random crops of a pair of pictures, and random shifts of the thermal picture against the visible one.

They depend on the seed and the pair's name only, so a data set can be resumed, and adding pairs does not change the
others' crops.
"""

import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Cut:
    """How pairs of pictures are cropped and shifted."""

    crops: int = 0  # Square crops per pair, at uniformly distributed positions; 0 keeps the whole picture
    size: int = 256  # Side of a crop [px]
    # Length of the random vector by which each thermal picture is shifted, rounded to whole pixels to avoid blur
    shift_px: float = 0.0
    seed: int = 0


def moved(
    values: NDArray[np.uint8] | NDArray[np.uint16], valid: NDArray[np.bool_], name: str, cut: Cut
) -> tuple[NDArray, NDArray[np.bool_]]:
    """Return a thermal picture and its mask shifted by the pair's random vector.

    Parameters
    ----------
    values : (H, W) uint8 or uint16
    valid : (H, W) bool
    name : str
        Name of the pair.
    cut : Cut

    Returns
    -------
    ((H, W), (H, W) bool)
        Pixels that the shift left without a value are not valid.
    """
    angle = _stream(cut.seed, name, "shift").uniform(0.0, 2.0 * np.pi)
    right, down = (round(cut.shift_px * each) for each in (np.cos(angle), np.sin(angle)))
    known = np.roll(valid, (down, right), axis=(0, 1))
    height, width = valid.shape
    row, column = np.arange(height)[:, None] - down, np.arange(width)[None, :] - right
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    return np.roll(values, (down, right), axis=(0, 1)), known & inside


def piece(image: NDArray, name: str, cut: Cut, number: int) -> NDArray:
    """Return crop `number` of a picture of (H, W, …), or the whole picture if there are no crops."""
    if not cut.crops:
        return image
    top, left = _corner(image.shape, name, cut, number)
    return np.ascontiguousarray(image[top : top + cut.size, left : left + cut.size])


def _corner(shape, name, cut, number):
    """Row and column of a crop's corner, uniform over all positions that fit."""
    stream = _stream(cut.seed, name, f"crop {number}")
    return tuple(int(stream.integers(0, side - cut.size + 1)) for side in shape[:2])


def _stream(seed, name, what):
    """Random generator for a seed, a pair and a purpose."""
    return np.random.default_rng([seed, zlib.crc32(name.encode()), zlib.crc32(what.encode())])
