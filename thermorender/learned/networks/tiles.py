"""Pictures of any size through a network that takes squares: overlapping tiles, blended."""

from collections.abc import Callable

import numpy as np

# Greatest total stride of the networks that take squares of any size [pixels].
_JOINED = 16


def stitched(
    apply: Callable[[np.ndarray], np.ndarray], planes: np.ndarray, sides: tuple[int, int], overlap: int, margin: int
) -> np.ndarray:
    """Return a network's output, (out, h, w) float32, for planes (c, h, w) float32.

    `apply` maps tiles (c, *sides) to (out, *sides), with sides multiples of 16 pixels; smaller pictures are mirrored at
    their edges. Tiles overlap by `overlap` pixels or more; `margin` pixels at each edge are not used, the rest is
    blended with a Hann window.
    """
    height, width = planes.shape[1:]
    lacking = [_length(n, side) - n for side, n in zip(sides, (height, width), strict=True)]
    planes = np.pad(planes, ((0, 0), (0, lacking[0]), (0, lacking[1])), "symmetric")
    rows, columns = (_windows(n, side, overlap, overlap - 2 * margin)
                     for side, n in zip(sides, planes.shape[1:], strict=True))  # fmt: skip
    total: np.ndarray | None = None
    weights = np.zeros(planes.shape[1:], np.float32)
    for top, tall in rows:
        for left, wide in columns:
            here = np.s_[top : top + sides[0], left : left + sides[1]]
            window = tall[:, None] * wide
            found = window * apply(planes[(slice(None), *here)])
            if total is None:
                total = np.zeros((len(found), *planes.shape[1:]), np.float32)
            total[(slice(None), *here)] += found
            weights[here] += window
    assert total is not None
    return (total / weights)[:, :height, :width]


def joints(length: int, side: int, overlap: int) -> np.ndarray:
    """Return the middles of the overlaps between tiles of `stitched` along an axis of `length` pixels [pixels]."""
    places = _places(_length(length, side), side, overlap)
    return 0.5 * (places[:-1] + places[1:] + side)


def _length(length: int, side: int) -> int:
    """Pixels that the tiles cover, at least `length`."""
    # Tiles begin at multiples of the stride, so that all of them have the same pixel grid.
    return max(side, length + -length % _JOINED)


def _places(length: int, side: int, overlap: int) -> np.ndarray:
    """First pixels of the tiles, evenly spaced."""
    count = 1 if length <= side else 1 + int(np.ceil((length - side) / (side - overlap)))
    return (np.linspace(0, length - side, count) / _JOINED).round().astype(int) * _JOINED


def _windows(length: int, side: int, overlap: int, fade: int) -> list[tuple[int, np.ndarray]]:
    """[(first pixel of a tile, its weights)]: neighbours are blended in the middle of their overlap."""
    places, middles = _places(length, side, overlap), joints(length, side, overlap)
    within = np.arange(side) + 0.5
    found = []
    for number, place in enumerate(places):
        weight = np.ones(side)
        if number:
            weight *= _rise(place + within - middles[number - 1], fade)
        if number < len(middles):
            weight *= _rise(middles[number] - place - within, fade)
        found.append((int(place), weight.astype(np.float32)))
    return found


def _rise(distance: np.ndarray, fade: int) -> np.ndarray:
    """From 0 to 1 over `fade` pixels around 0: the rising half of a Hann window."""
    return np.sin(0.5 * np.pi * np.clip(distance / fade + 0.5, 0.0, 1.0)) ** 2
