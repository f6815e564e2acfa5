"""Directions of gradients, by which visible and thermal pictures are compared, and their correlation over all shifts.

A complex gradient g becomes z = g² / (|g|² + η²), with η² the median of |g|²: the square removes the sign of the
contrast. This is the normalised gradient field of Haber and Modersitzki, Intensity gradient based registration and
fusion of multi-modal images, MICCAI 2006. Its correlation over all shifts is one Fourier transform.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray


def directions(grey: ArrayLike) -> NDArray[np.complex64]:
    """Return the unsigned directions of a picture's gradients, (h, w) complex64 of magnitude below 1."""
    import cv2

    smooth = cv2.GaussianBlur(np.asarray(grey, np.float32), (0, 0), 1.0)
    gradient = cv2.Sobel(smooth, cv2.CV_32F, 1, 0) + 1j * cv2.Sobel(smooth, cv2.CV_32F, 0, 1)
    power = np.abs(gradient) ** 2
    return (gradient**2 / (power + np.median(power) + 1e-6 * power.mean() + 1e-30)).astype(np.complex64)


def best_shift(
    visible: Sequence[NDArray[np.complex64]], thermal: Sequence[NDArray[np.complex64]], inside: NDArray[np.bool_]
) -> tuple[float, NDArray[np.float64]]:
    """Return (pooled correlation, shift to the right and down from the canvas centre [px]) of the best shift.

    Visible canvases (h, w) have room for shifts of the thermal pictures (H, W); `inside` is where they hold a picture.
    """
    score = _correlations(visible, thermal, inside)
    row, column = np.unravel_index(score.argmax(), score.shape)
    rest = (np.array(inside.shape) - np.array(thermal[0].shape)) / 2.0
    return float(score[row, column]), np.array([column - rest[1], row - rest[0]])


def _correlations(visible: Sequence[np.ndarray], thermal: Sequence[np.ndarray], inside: np.ndarray) -> np.ndarray:
    """Return the pooled correlation of each position of the thermal corner in the canvas, (rows, columns); −1 outside.

    Partial overlaps are weighted by the square root of the overlap.
    """
    from scipy import fft

    canvas, (height, width) = inside.shape, thermal[0].shape

    def transform(image: np.ndarray) -> Any:
        return fft.fft2(image, canvas)

    product: Any = 0.0
    power, own = np.zeros(canvas, np.float32), np.zeros((height, width), np.float32)
    for seen, known in zip(visible, thermal, strict=True):
        seen, known = np.where(inside, seen, 0), known - known.mean()
        product = product + transform(seen) * np.conj(transform(known))
        power += np.abs(seen) ** 2
        own += np.abs(known) ** 2
    window = np.conj(transform(np.ones((height, width), np.float32)))
    known_inside = transform(inside.astype(np.float32))
    seen_power = fft.ifft2(transform(power) * window).real
    known_power = fft.ifft2(known_inside * np.conj(transform(own))).real
    overlap = np.clip(fft.ifft2(known_inside * window).real / (height * width), 0.0, 1.0)
    score: np.ndarray = (
        fft.ifft2(product).real / np.sqrt(np.maximum(seen_power * known_power, 1e-12)) * np.sqrt(overlap)
    )
    score[overlap < 0.6] = -1.0
    # Positions that would wrap around.
    score[canvas[0] - height + 1 :] = -1.0
    score[:, canvas[1] - width + 1 :] = -1.0
    return score
