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
    # Tiles begin at multiples of what a network joins into one place, so that all of them join the same pixels.
    lacking = [max(side, n + -n % _JOINED) - n for side, n in zip(sides, (height, width), strict=True)]
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


def _windows(length, side, overlap, fade):
    """[(where a tile begins, its weights)]: evenly spaced, each fading into the next in the middle of their overlap."""
    count = 1 if length <= side else 1 + int(np.ceil((length - side) / (side - overlap)))
    places = (np.linspace(0, length - side, count) / _JOINED).round().astype(int) * _JOINED
    within = np.arange(side) + 0.5
    found = []
    for number, place in enumerate(places):
        weight = np.ones(side)
        if number:
            weight *= _rise(within - 0.5 * (places[number - 1] + side - place), fade)
        if number + 1 < count:
            weight *= _rise((side - within) - 0.5 * (place + side - places[number + 1]), fade)
        found.append((int(place), weight.astype(np.float32)))
    return found


def _rise(distance, fade):
    """From 0 to 1 over `fade` pixels about 0, the rising half of Hann's window."""
    return np.sin(0.5 * np.pi * np.clip(distance / fade + 0.5, 0.0, 1.0)) ** 2
