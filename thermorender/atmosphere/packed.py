"""Positive numbers over many magnitudes in 16 bits: the tables of g points as their file holds them."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
_CODES = 65534
# Axes along which neighbours differ little: temperature and pressure.
_SMOOTH = (0, 1)


def packed(values: Floats, relative: float = 0.0) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Return (bytes (2, …) of the differences of codes, (lowest, step) of the logarithm by the last axis (G, 2)).

    A zero has the code 0. The error is half a step, of which there are 65534, or of `relative` where that is coarser.
    """
    flat = np.asarray(values, np.float64).reshape(-1, values.shape[-1])
    known = flat > 0.0
    logs = np.log(np.where(known, flat, 1.0))
    low = np.where(known.any(axis=0), np.where(known, logs, np.inf).min(axis=0), 0.0)
    high = np.where(known.any(axis=0), np.where(known, logs, -np.inf).max(axis=0), 0.0)
    step = np.maximum(np.maximum((high - low) / (_CODES - 1), relative), 1e-9)
    scale = np.stack([low, step], axis=1).astype(np.float32)
    codes = np.where(known, 1.0 + np.clip(np.round((logs - scale[:, 0]) / scale[:, 1]), 0, _CODES - 1), 0.0)
    found = codes.astype(np.uint16).reshape(values.shape)
    for axis in _SMOOTH:
        # Differences wrap around, and sums of them again.
        found = np.diff(found, axis=axis, prepend=np.zeros_like(found.take([0], axis)))
    return np.stack([found & 255, found >> 8]).astype(np.uint8), scale


def unpacked(differences: NDArray[Any], scale: NDArray[Any]) -> Floats:
    """Return the numbers of `packed`."""
    codes = differences[0].astype(np.uint16) + (differences[1].astype(np.uint16) << 8)
    for axis in _SMOOTH:
        codes = np.add.accumulate(codes, axis=axis, dtype=np.uint16)
    low, step = scale.T.astype(np.float64)
    return np.where(codes == 0, 0.0, np.exp(low + (codes - 1.0) * step))
