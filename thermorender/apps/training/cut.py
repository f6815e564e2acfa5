"""Random crops of a pair of pictures, and random shifts of the thermal picture against the visible one.

They depend on the seed and the pair's name only, so other pairs do not change them.
"""

import zlib
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray


@dataclass(frozen=True)
class Cut:
    """How pairs of pictures are cropped and shifted; its fields are options of `prepare`."""

    # Positions are uniformly distributed.
    crops: Annotated[int, typer.Option(help="Squares cut at random from each pair; 0: whole pictures.")] = 0
    size: Annotated[int, typer.Option("--crop-size", help="Their side [px].")] = 256
    # Rounded to whole pixels to avoid blur.
    shift_px: Annotated[
        float, typer.Option("--shift", help="Move each thermal picture by a random vector of this length [px], to "
                            "simulate misaligned pairs."),
    ] = 0.0  # fmt: skip
    seed: Annotated[int, typer.Option(help="Seed of crops, shifts and split.")] = 0


def moved(
    values: NDArray[np.uint8] | NDArray[np.uint16], valid: NDArray[np.bool_], name: str, cut: Cut
) -> tuple[np.ndarray, NDArray[np.bool_]]:
    """Return a thermal picture and its mask, (H, W) each, shifted by the random vector of the pair `name`."""
    angle = _stream(cut.seed, name, "shift").uniform(0.0, 2.0 * np.pi)
    right, down = (round(cut.shift_px * each) for each in (np.cos(angle), np.sin(angle)))
    known = np.roll(valid, (down, right), axis=(0, 1))
    height, width = valid.shape
    row, column = np.arange(height)[:, None] - down, np.arange(width)[None, :] - right
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    return np.roll(values, (down, right), axis=(0, 1)), known & inside


def piece(image: np.ndarray, name: str, cut: Cut, number: int) -> np.ndarray:
    """Return crop `number` of a picture of (H, W, …), or the whole picture if there are no crops."""
    if not cut.crops:
        return image
    top, left = _corner(image.shape, name, cut, number)
    return np.ascontiguousarray(image[top : top + cut.size, left : left + cut.size])


def _corner(shape: tuple[int, ...], name: str, cut: Cut, number: int) -> tuple[int, ...]:
    """Row and column of a crop's corner, uniform over all positions that fit."""
    stream = _stream(cut.seed, name, f"crop {number}")
    return tuple(int(stream.integers(0, side - cut.size + 1)) for side in shape[:2])


def _stream(seed: int, name: str, what: str) -> np.random.Generator:
    """Random generator for a seed, a pair and a purpose."""
    return np.random.default_rng([seed, zlib.crc32(name.encode()), zlib.crc32(what.encode())])
