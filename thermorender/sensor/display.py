"""Counts to 8 bits for a screen: the automatic gain control of a thermal camera.

Each mode first measures the frame (the ends of a stretch, or a whole curve from counts to levels) and then maps the
counts by that measure. In a flight the measure may follow the scene slowly, as in a camera: a running mean. The modes
and the running mean are those of FLIR, Camera Adjustments, 102-PS242-100-01 rev. 110 (2014), sections 2.2 and 2.3;
local contrast is OpenCV's CLAHE.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError
from thermorender.sensor.palettes import palette

_Counts = NDArray[np.uint16]
_Measure = NDArray[np.float64]
_Levels = NDArray[np.uint8]
# Fewest counts over which a stretch spans all 255 levels.
_LEAST_SPAN = 64
# Default plateau value of FLIR's Tau 2 core, in pixels of its 640×512 per count.
_PLATEAU_SHARE = 150.0 / (640 * 512)
# Contrast limit and tiles of OpenCV's CLAHE; a limit of three does not amplify noise on heath and sky.
_LOCAL_CLIP, _LOCAL_TILES = 3.0, (8, 8)


# Values that a display always shows within its range, and how many widths of these it reaches beyond them.
INNER_PERCENT, _REACH = (10.0, 90.0), 3.0


@dataclass(frozen=True)
class DisplaySettings:
    """How counts become display levels.

    Attributes
    ----------
    mode : str
        linear: stretched between the tails. plateau: histogram equalisation with the weight of each count limited to
        a plateau. local: linear, then contrast equalised by tiles.
    palette : str
        white-hot, black-hot or ironbow.
    memory_s : float
        Time constant of the running mean of the gain control [s]; 0 uses each frame's own measure.
    tails_percent : (2,) floats
        Shares of the darkest and of the brightest pixels that may saturate, except in plateau mode; set by the camera.
        More may where they lie far from all others, such as warm cars at night; with 0 none does.
    """

    mode: str = "linear"
    palette: str = "white-hot"
    memory_s: float = 0.0
    tails_percent: tuple[float, float] = (0.5, 0.5)

    def __post_init__(self) -> None:
        if self.mode not in MODES:
            raise ThermorenderError(f"display mode {self.mode!r} is unknown; give one of {', '.join(MODES)}")
        palette(self.palette)
        if not 0.0 <= self.memory_s < 1e6:
            raise ThermorenderError(f"display memory_s={self.memory_s:g} is not allowed; give seconds from 0 up")

    def image(
        self, counts: _Counts, state: _Measure | None = None, interval_s: float = 0.0
    ) -> tuple[_Measure, _Levels]:
        """Return (state, image) of a frame: the state for the next frame, and (H, W) grey or (H, W, 3) RGB uint8.

        Parameters
        ----------
        counts : (H, W) uint16
        state : array, optional
            From the frame before; None for the first. A flight that continues from a saved state gives the same
            bytes.
        interval_s : float
            Time since the frame before [s].
        """
        measured = self.measure(counts)
        if state is not None and self.memory_s > 0.0:
            measured = state + -np.expm1(-interval_s / self.memory_s) * (measured - state)
        return measured, self.shown(counts, measured)

    def measure(self, counts: _Counts) -> _Measure:
        """Return the measure of this mode of counts (…) uint16, of one frame or of many."""
        return MODES[self.mode][0](counts, self.tails_percent)

    def shown(self, counts: _Counts, measured: _Measure) -> _Levels:
        """Return counts (H, W) mapped by a measure, of this frame or of others: (H, W) grey or (H, W, 3) RGB uint8."""
        levels = MODES[self.mode][1](counts, measured)
        return levels if self.palette == "white-hot" else np.take(palette(self.palette), levels, axis=0)


def without_outliers(low: float, high: float, inner: tuple[float, float]) -> tuple[float, float]:
    """Return the ends of a display's range, at most three widths of the `INNER_PERCENT` of the values beyond these.

    A few hot or cold things then saturate, instead of leaving a few levels to all else.
    """
    reach = _REACH * (inner[1] - inner[0])
    # A range of one value, as of a sky without noise, says nothing on what is far.
    return (max(low, inner[0] - reach), min(high, inner[1] + reach)) if reach > 0.0 else (low, high)


def _ends(counts: _Counts, tails_percent: tuple[float, float]) -> _Measure:
    """The counts shown black and white, (2,) float64, at least 64 apart, so that noise on a flat scene stays faint."""
    below = np.cumsum(np.bincount(counts.ravel()))
    low = float(np.searchsorted(below, tails_percent[0] / 100.0 * below[-1], side="right"))
    high = float(np.searchsorted(below, (1.0 - tails_percent[1] / 100.0) * below[-1]))
    inner = tuple(float(np.searchsorted(below, share / 100.0 * below[-1])) for share in INNER_PERCENT)
    within = without_outliers(low, high, (inner[0], inner[1]))
    low, high = (own if tail else end for own, end, tail in zip(within, (low, high), tails_percent, strict=True))
    middle, half = 0.5 * (low + high), 0.5 * max(high - low, _LEAST_SPAN)
    return np.array([middle - half, middle + half])


def _stretched(counts: _Counts, ends: _Measure) -> _Levels:
    low, high = ends.tolist()
    return _look_up(counts, (np.arange(65536, dtype=np.float32) - np.float32(low)) * np.float32(255.0 / (high - low)))


def _equalisation(counts: _Counts, tails_percent: tuple[float, float]) -> _Measure:
    """Level of every count, (65536,) float64, rising.

    A count's share of the 255 levels is its number of pixels, limited to the plateau and to the steepest slope, so
    that noise on a flat scene is not amplified. The unused levels are split equally between dark and bright.
    """
    pixels = np.bincount(counts.ravel(), minlength=65536)
    share = np.minimum(pixels, max(_PLATEAU_SHARE * counts.size, 1.0))
    step = np.minimum(share * (255.0 / share.sum()), 255.0 / _LEAST_SPAN)
    curve = np.cumsum(step) - 0.5 * step
    return curve + 0.5 * (255.0 - step.sum())


def _look_up(counts: _Counts, curve: NDArray[np.floating[Any]]) -> _Levels:
    return np.clip(np.rint(curve), 0, 255).astype(np.uint8)[counts]


def _local(counts: _Counts, ends: _Measure) -> _Levels:
    import cv2

    equalised: Any = cv2.createCLAHE(_LOCAL_CLIP, _LOCAL_TILES).apply(_stretched(counts, ends))
    return equalised


# {mode: ((counts, tails) → measure, (counts, measure) → levels)}. Measures of a mode may be averaged.
MODES: dict[str, tuple[Callable[[_Counts, tuple[float, float]], _Measure], Callable[[_Counts, _Measure], _Levels]]] = {
    "linear": (_ends, _stretched), "plateau": (_equalisation, _look_up), "local": (_ends, _local)
}  # fmt: skip
