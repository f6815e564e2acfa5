"""A picture shifted and blurred by fractions of a pixel, with its derivatives by shift and blur.

Shift and Gaussian blur act as one separable filter: along each axis, a band-limited shift times a Gaussian. A negative
blur variance sharpens.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

# Half-width of the filter without blur [px], and its growth with the standard deviation of the blur.
_REACH_PX, _PER_SIGMA = 6, 4.0
# Side of the transform that makes the taps, and the step of the differences between filters [px, px²].
_SIDE, _STEP = 128, 0.02


class Moved(NamedTuple):
    """A moved picture and its derivatives, (H, W) float32 each: by shift right, shift down, and blur variance."""

    image: NDArray[np.float32]
    right: NDArray[np.float32]
    down: NDArray[np.float32]
    variance: NDArray[np.float32]


def moved(image: NDArray[np.float32], right: float, down: float, variance: float) -> Moved:
    """Return a picture moved by `right` and `down` [px] after a Gaussian blur of a variance [px²].

    Parameters
    ----------
    image : (H, W) float32
        Finite everywhere.
    right, down, variance : float
        Shifts of whole pixels are done by the caller: |right|, |down| ≤ 3.
    """
    across, across_d, across_v = _taps(right, variance)
    along, along_d, along_v = _taps(down, variance)
    return Moved(
        _filtered(image, across, along),
        _filtered(image, across_d, along),
        _filtered(image, across, along_d),
        _filtered(image, across_v, along) + _filtered(image, across, along_v),
    )


def _filtered(
    image: NDArray[np.float32], across: NDArray[np.float64], along: NDArray[np.float64]
) -> NDArray[np.float32]:
    import cv2

    found: NDArray[np.float32] = cv2.sepFilter2D(image, cv2.CV_32F, across, along, borderType=cv2.BORDER_REFLECT)  # type: ignore[assignment]
    return found


def _taps(shift: float, variance: float) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return (taps, their derivative by shift, by variance); OpenCV correlates, so the taps are reversed."""
    reach = int(np.ceil(_REACH_PX + _PER_SIGMA * np.sqrt(max(variance, 0.0))))

    def at(shift: float, variance: float) -> NDArray[np.float64]:
        frequency = np.fft.rfftfreq(_SIDE)
        response = np.exp(-2.0 * np.pi**2 * variance * frequency**2 - 2j * np.pi * frequency * shift)
        place = np.arange(-reach, reach + 1)
        # The ends of a sinc are tapered over the outer half.
        taper = np.cos(0.5 * np.pi * np.clip(2.0 * np.abs(place) / (reach + 1) - 1.0, 0.0, 1.0)) ** 2
        taps = np.fft.irfft(response, _SIDE)[place] * taper
        found: NDArray[np.float64] = (taps / taps.sum())[::-1]
        return found

    return (
        at(shift, variance),
        (at(shift + _STEP, variance) - at(shift - _STEP, variance)) / (2.0 * _STEP),
        (at(shift, variance + _STEP) - at(shift, variance - _STEP)) / (2.0 * _STEP),
    )
