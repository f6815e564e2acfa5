"""Properties of the whole image from a sequence of frames: shading, vignetting, replaced pixels, drift of the scale.

For a moving camera, the smooth part of the mean frame is the shading; for a static one, the common change of all pixels
is the drift. Noise grows as the light decreases. A pixel that is the mean of its neighbours has no noise of its own.
"""

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.survey.footage.noise_statistics import block_means, sigma_of
from thermorender.sensor.noise import half_waves
from thermorender.sensor.wander import TICK_S, covariance

# Fewest frames for shading and the drift of the scale, and the most for the latter.
_FEWEST, _MOST = 8, 600
# Parts of a sequence whose means count as independent, and rings of blocks around the centre.
_PARTS, _RINGS = 8, 6
# Probability that any good pixel of the image counts as replaced.
_FALSE_ALARM = 0.1


class Field:
    """Sums over frames of one size, gathered frame by frame."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self.shape = shape
        self._waves: list[NDArray[np.float64]] = []
        self._levels: list[float] = []
        self._first: NDArray[np.float64] | None = None
        self._sum, self._square, self._cut_off = np.zeros(shape), np.zeros(shape), np.zeros(shape, bool)

    def add(self, image: NDArray[np.float64], cut_off: NDArray[np.bool_]) -> None:
        """Add a frame, (H, W) [K], all finite, and where its pixels are at an end of their range, (H, W) bool."""
        from scipy.ndimage import uniform_filter

        self._cut_off |= cut_off
        down, right = (half_waves(n) for n in self.shape)
        self._waves.append(down @ image @ right.T / image.size)
        if self._first is None:
            self._first = image
        # The median, since a change in a part of the scene leaves most blocks unchanged.
        self._levels.append(float(np.median(block_means(image - self._first))))
        beside = image - (9.0 * uniform_filter(image, 3) - image) / 8.0
        self._sum += beside
        self._square += beside**2

    def shading(self) -> tuple[float, float] | None:
        """Return (root mean square of the smooth part of the mean frame, uncertainty) [K]; None for few frames.

        For a moving camera: the half waves of `sensor.noise.smooth_field`, less the residual of the scene in their
        mean, estimated from its change between eighths of the sequence.
        """
        if len(self._waves) < _FEWEST:
            return None
        halves = np.add.outer(np.arange(4), np.arange(4))
        parts = np.array([part.mean(axis=0) for part in np.array_split(np.array(self._waves), _PARTS)])
        parts = parts[:, (halves > 0) & (halves < 4)]
        mean, error = parts.mean(axis=0), parts.var(axis=0, ddof=1) / _PARTS
        return sigma_of((mean**2 - error).sum(), np.sqrt((4.0 * mean**2 * error + 2.0 * error**2).sum()))

    def replaced(self, noise_k: float, step_k: float) -> tuple[float, float] | None:
        """Return (share of pixels that are the mean of their neighbours, uncertainty); None for too few frames.

        The difference of a pixel from the mean of its eight neighbours has 9/8 of the noise's variance or more; that of
        a replaced pixel is rounding, by steps of `step_k` [K].
        """
        from scipy.ndimage import binary_dilation
        from scipy.stats import chi2

        free = len(self._waves) - 1
        if free < 1:
            return None
        inner = (slice(1, -1),) * 2
        variance = ((self._square - self._sum**2 / (free + 1)) / free)[inner]
        # Pixels cut off at the same value have no noise either.
        variance = variance[~binary_dilation(self._cut_off, np.ones((3, 3)))[inner]]
        limit = 1.125 * noise_k**2 * chi2.ppf(_FALSE_ALARM / variance.size, free) / free
        if limit < 1.125 * step_k**2 / 12.0 * chi2.ppf(0.999, free) / free:
            return None
        count = int((variance < limit).sum())
        return count / variance.size, np.sqrt(max(count, 1)) / variance.size

    def wander(self, rate_hz: float, known_k: float) -> tuple[tuple[float, float], ...] | None:
        """Return ((noise of frame means, uncertainty), (1/f noise of the scale per octave, uncertainty)) [K], or None.

        The camera is static; `known_k` is what pixels, rows and columns add to a frame's mean [K]. None for few frames.
        Maximum likelihood of the levels of up to 600 frames, with the covariance of `sensor.wander.covariance` plus
        white noise: along its eigenvectors, orthogonal to the mean, the variances add. A span of k ticks has about k
        draws of the drift, so its variance is uncertain by √(2/k) at least. The median over blocks of the difference
        from the first frame has 2π/3 of the mean's variance, apart from the noise of the first frame.
        """
        from scipy.optimize import minimize

        level = np.array(self._levels[:_MOST])
        if len(level) < _FEWEST:
            return None
        time_s = np.arange(len(level)) / rate_hz
        contrast = np.linalg.svd(np.ones((1, len(level))))[2][1:]
        each, along = np.linalg.eigh(contrast @ covariance(time_s[:, None] - time_s) @ contrast.T)
        square, each = (along.T @ (contrast @ level)) ** 2, np.maximum(each, 0.0)
        unit = max(square.mean(), 1e-18)
        known = 2.0 / 3.0 * np.pi * known_k**2 / unit + 1e-9

        def unlikeliness(p: NDArray[np.float64]) -> float:
            variance = p[0] + p[1] * each + known
            return 0.5 * float((np.log(variance) + square / unit / variance).sum())

        starts = [(share, (1.0 - share) / max(each.mean(), 1e-9)) for share in (0.99, 0.5, 0.01)]
        found = min((minimize(unlikeliness, start, bounds=[(0.0, None)] * 2) for start in starts), key=lambda f: f.fun)
        variance = found.x[0] + found.x[1] * each + known
        weights = np.array([np.ones_like(each), each]) / variance
        error = np.sqrt(np.diag(np.linalg.inv(0.5 * weights @ weights.T)))
        error[1] = np.hypot(error[1], found.x[1] * np.sqrt(2.0 * TICK_S / time_s[-1]))
        return tuple(sigma_of(*pair) for pair in zip(found.x * unit, error * unit, strict=True))


def vignetting(
    blocks: NDArray[np.float64], share: float, illumination: NDArray[np.float64], rims: NDArray[np.float64],
    fixed: float,
) -> tuple[float, float] | None:  # fmt: skip
    """Return (share of light that the rims of the lens block at the corner, uncertainty), from the growth of noise.

    Least squares of a / (light (1 − v·rims))² + fixed to the mean powers of six rings; None if a ring has fewer than
    four flat blocks. `blocks` are `block_powers` (n, 2) [K²], of which `share` are flat enough; `illumination`, `rims`
    (H, W).
    """
    from scipy.optimize import minimize_scalar

    frames = len(blocks) // len(block_means(rims))
    light, dark = (np.tile(block_means(values), frames) for values in (illumination, rims))
    ring = np.searchsorted(np.quantile(dark, np.linspace(0.0, 1.0, _RINGS + 1))[1:-1], dark, "right")
    power, error, chosen = np.zeros(_RINGS), np.zeros(_RINGS), []
    for number in range(_RINGS):
        own = np.flatnonzero((ring == number) & np.isfinite(blocks[:, 0]))
        if len(own) < 4:
            return None
        own = own[np.argsort(blocks[own, 0])[: max(int(share * len(own)), 4)]]
        power[number] = blocks[own, 1].mean() - fixed
        error[number] = blocks[own, 1].std() / np.sqrt(len(own))
        chosen.append(own)

    def misfit(value: float) -> float:
        gain = np.array([np.mean(1.0 / (light[own] * (1.0 - value * dark[own])) ** 2) for own in chosen])
        middle = (power * gain / error**2).sum() / (gain**2 / error**2).sum()
        return float((((power - middle * gain) / error) ** 2).sum())

    value = float(minimize_scalar(misfit, bounds=(0.0, 0.9), method="bounded", options={"xatol": 1e-4}).x)
    # The misfit grows by one within an uncertainty; its curvature is that of a parabola over a hundredth.
    low, middle, high = (misfit(value + step) for step in (-0.01, 0.0, 0.01))
    curvature = max((low + high - 2.0 * middle) / 1e-4, 1e-9)
    return value, float(np.sqrt(2.0 / curvature) * max(np.sqrt(middle / (_RINGS - 2)), 1.0))
