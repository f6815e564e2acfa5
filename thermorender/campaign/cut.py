"""What is drawn at random of a pair of pictures: crops, and how far they are moved against each other.

It depends on the seed and the pair's name alone, so a data set can be continued, and what is drawn of a pair does not
change where others are added.
"""

import zlib
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Cut:
    """What is made of a pair of pictures.

    Attributes
    ----------
    crops : int
        Squares at uniformly distributed places of each pair; 0 keeps the whole picture.
    size : int
        Their side [px].
    shift_px : float
        Length of a random vector by which each thermal picture is moved, in whole pixels, so that nothing is blurred.
    seed : int
    """

    crops: int = 0
    size: int = 256
    shift_px: float = 0.0
    seed: int = 0


def moved(values, valid, name, cut):
    """Return a thermal picture and its mask moved by the pair's random vector.

    Parameters
    ----------
    values : (H, W) uint8 or uint16
    valid : (H, W) bool
    name : str
        Of the pair.
    cut : Cut

    Returns
    -------
    ((H, W), (H, W) bool)
        Nothing is known where no picture came to lie.
    """
    angle = _stream(cut.seed, name, "shift").uniform(0.0, 2.0 * np.pi)
    right, down = (int(round(cut.shift_px * each)) for each in (np.cos(angle), np.sin(angle)))
    known = np.roll(valid, (down, right), axis=(0, 1))
    height, width = valid.shape
    row, column = np.arange(height)[:, None] - down, np.arange(width)[None, :] - right
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    return np.roll(values, (down, right), axis=(0, 1)), known & inside


def piece(image, name, cut, number):
    """Return crop `number` of a picture of (H, W, …), or the whole one where none are asked for."""
    if not cut.crops:
        return image
    top, left = _corner(image.shape, name, cut, number)
    return np.ascontiguousarray(image[top : top + cut.size, left : left + cut.size])


def _corner(shape, name, cut, number):
    """Row and column of a crop's corner, uniform over all places that fit."""
    stream = _stream(cut.seed, name, f"crop {number}")
    return tuple(int(stream.integers(0, side - cut.size + 1)) for side in shape[:2])


def _stream(seed, name, what):
    """Random numbers of a seed, a pair and a purpose."""
    return np.random.default_rng([seed, zlib.crc32(name.encode()), zlib.crc32(what.encode())])
