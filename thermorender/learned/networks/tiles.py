"""Pictures of any size through a network that takes squares: overlapping tiles, blended."""

import numpy as np

# Pixels along a side that networks join into one place, at most but for those that take squares of one size.
_JOINED = 16


def stitched(apply, planes, sides, overlap, margin):
    """Return what a network makes of a picture, (out, h, w) float32.

    Parameters
    ----------
    apply : callable
        (c, *sides) → (out, *sides).
    planes : (c, h, w) float32
        Mirrored at its edges where it is smaller than a tile.
    sides : (2,) tuple of int
        Of tiles, multiples of 16 [pixels].
    overlap : int
        By how much neighbours overlap at least [pixels].
    margin : int
        What of the overlap is not taken from either end, as the network lacks what lies beyond [pixels]. Over the rest
        one tile fades into the other by Hann's window, so that no seam is sharper than that.
    """
    height, width = planes.shape[1:]
    lacking = [_length(n, side) - n for side, n in zip(sides, (height, width), strict=True)]
    planes = np.pad(planes, ((0, 0), (0, lacking[0]), (0, lacking[1])), "symmetric")
    rows, columns = (_windows(n, side, overlap, overlap - 2 * margin)
                     for side, n in zip(sides, planes.shape[1:], strict=True))  # fmt: skip
    total, weights = 0.0, np.zeros(planes.shape[1:], np.float32)
    for top, tall in rows:
        for left, wide in columns:
            here = np.s_[top : top + sides[0], left : left + sides[1]]
            window = tall[:, None] * wide
            found = window * apply(planes[(slice(None), *here)])
            if np.ndim(total) == 0:
                total = np.zeros((len(found), *planes.shape[1:]), np.float32)
            total[(slice(None), *here)] += found
            weights[here] += window
    return (total / weights)[:, :height, :width]


def joints(length, side, overlap):
    """Return where, along an axis of so many pixels, one tile of `stitched` has faded into the next by half: floats."""
    places = _places(_length(length, side), side, overlap)
    return 0.5 * (places[:-1] + places[1:] + side)


def _length(length, side):
    """Pixels that tiles cover, at least `length`."""
    # Tiles begin at multiples of what a network joins into one place, so that all of them join the same pixels.
    return max(side, length + -length % _JOINED)


def _places(length, side, overlap):
    """Where tiles begin, evenly spaced."""
    count = 1 if length <= side else 1 + int(np.ceil((length - side) / (side - overlap)))
    return (np.linspace(0, length - side, count) / _JOINED).round().astype(int) * _JOINED


def _windows(length, side, overlap, fade):
    """[(where a tile begins, its weights)]: each fades into the next in the middle of their overlap."""
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


def _rise(distance, fade):
    """From 0 to 1 over `fade` pixels about 0, the rising half of Hann's window."""
    return np.sin(0.5 * np.pi * np.clip(distance / fade + 0.5, 0.0, 1.0)) ** 2
