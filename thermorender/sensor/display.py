"""Counts to 8 bits for a screen: the automatic gain control of a thermal camera.

Each mode first measures the frame (the ends of a stretch, or a whole curve from counts to levels) and then shows
the counts by that measure. In a flight the measure may follow the scene slowly, as a camera's does: the one used is
a running mean of those measured. The modes and the running mean are those of FLIR, Camera Adjustments,
102-PS242-100-01 rev. 110 (2014), sections 2.2 and 2.3; local contrast is OpenCV's CLAHE.
"""

from dataclasses import dataclass

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.sensor.palettes import palette

# No stretch is steeper than 255 levels over so many counts.
_LEAST_SPAN = 64
# Default plateau value of FLIR's Tau 2 core, in pixels of its 640×512 per count.
_PLATEAU_SHARE = 150.0 / (640 * 512)
# Contrast limit and tiles of OpenCV's CLAHE; three is what keeps noise quiet on heath and sky.
_LOCAL_CLIP, _LOCAL_TILES = 3.0, (8, 8)


@dataclass(frozen=True)
class DisplaySettings:
    """How counts are shown.

    Attributes
    ----------
    mode : str
        linear: stretched between the tails. plateau: histogram equalisation in which no count weighs
        more than a plateau. local: linear, then contrast equalised by tiles.
    palette : str
        white-hot, black-hot or ironbow.
    memory_s : float
        Time constant of the running mean of the gain control [s]; 0 shows each frame by its own measure.
    tails_percent : (2,) floats
        Shares of the darkest and of the brightest pixels that may saturate, plateau aside; cameras have their own.
    """

    mode: str = "linear"
    palette: str = "white-hot"
    memory_s: float = 0.0
    tails_percent: tuple = (0.5, 0.5)

    def __post_init__(self):
        if self.mode not in MODES:
            raise ThermorenderError(f"display mode {self.mode!r} is unknown; give one of {', '.join(MODES)}")
        palette(self.palette)
        if not 0.0 <= self.memory_s < 1e6:
            raise ThermorenderError(f"display memory_s={self.memory_s:g} is not allowed; give seconds from 0 up")

    def image(self, counts, state=None, interval_s=0.0):
        """Return (state, image) of a frame: what to hand to the next one, and (H, W) grey or (H, W, 3) RGB uint8.

        Parameters
        ----------
        counts : (H, W) uint16
        state : array, optional
            What the frame before gave; None for the first. It is all that is carried, so saving the array and
            giving it again continues a flight to the same bytes.
        interval_s : float
            Time since the frame before [s].
        """
        measured = self.measure(counts)
        if state is not None and self.memory_s > 0.0:
            measured = state + -np.expm1(-interval_s / self.memory_s) * (measured - state)
        return measured, self.shown(counts, measured)

    def measure(self, counts):
        """Return what this mode measures of counts (…) uint16, of one frame or of many."""
        return MODES[self.mode][0](counts, self.tails_percent)

    def shown(self, counts, measured):
        """Return counts (H, W) by a measure, of this frame or of others: (H, W) grey or (H, W, 3) RGB uint8."""
        levels = MODES[self.mode][1](counts, measured)
        return levels if self.palette == "white-hot" else np.take(palette(self.palette), levels, axis=0)


def _ends(counts, tails_percent):
    """The counts shown black and white, (2,) float64.

    The span is never below 64 counts, so that noise on a flat scene is not blown up to full contrast.
    """
    below = np.cumsum(np.bincount(counts.ravel()))
    low = int(np.searchsorted(below, tails_percent[0] / 100.0 * below[-1], side="right"))
    high = int(np.searchsorted(below, (1.0 - tails_percent[1] / 100.0) * below[-1]))
    middle, half = 0.5 * (low + high), 0.5 * max(high - low, _LEAST_SPAN)
    return np.array([middle - half, middle + half])


def _stretched(counts, ends):
    low, high = ends.tolist()
    return _look_up(counts, (np.arange(65536, dtype=np.float32) - np.float32(low)) * np.float32(255.0 / (high - low)))


def _equalisation(counts, tails_percent):
    """Level of every count, (65536,) float64, rising.

    A count's share of the 255 levels is its number of pixels, capped at the plateau and, so that noise on a flat
    scene is not blown up, at the steepest slope. What the cap leaves unused stays dark and bright in equal parts.
    """
    pixels = np.bincount(counts.ravel(), minlength=65536)
    share = np.minimum(pixels, max(_PLATEAU_SHARE * counts.size, 1.0))
    step = np.minimum(share * (255.0 / share.sum()), 255.0 / _LEAST_SPAN)
    curve = np.cumsum(step) - 0.5 * step
    return curve + 0.5 * (255.0 - step.sum())


def _look_up(counts, curve):
    return np.clip(np.rint(curve), 0, 255).astype(np.uint8)[counts]


def _local(counts, ends):
    import cv2

    return cv2.createCLAHE(_LOCAL_CLIP, _LOCAL_TILES).apply(_stretched(counts, ends))


# {mode: ((counts, tails) → measure, (counts, measure) → levels)}. Measures of a mode may be averaged.
MODES = {"linear": (_ends, _stretched), "plateau": (_equalisation, _look_up), "local": (_ends, _local)}
