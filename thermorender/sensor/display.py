"""Counts to 8 bits for a screen."""

import numpy as np

# Shares of the darkest and brightest pixels that may saturate on the screen.
_TAILS = (0.5, 99.5)
_LEAST_SPAN = 64


def linear(counts):
    """Return an 8-bit white-hot image, (H, W) uint8, stretched linearly between the half-percent tails.

    Parameters
    ----------
    counts : (H, W) uint16

    Notes
    -----
    The span is never below 64 counts, so that noise on a flat scene is not blown up to full contrast.
    """
    below = np.cumsum(np.bincount(counts.ravel()))
    low, high = np.searchsorted(below, np.array(_TAILS) / 100.0 * below[-1]).tolist()
    span = max(high - low, _LEAST_SPAN)
    low = 0.5 * (low + high - span)
    shown = (counts.astype(np.float32) - np.float32(low)) * np.float32(255.0 / span)
    return np.clip(np.rint(shown), 0, 255).astype(np.uint8)
