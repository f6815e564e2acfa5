"""The uncertainty of a reconstruction: standard deviation of each texel, without the common level.

Three terms add up. Draws of the noise and of the prior, solved like the frames, give the errors that the normal
equations know, those of free poses and offsets among them. Poses and optics are never exact, which shows at edges: the
residuals of the pixels grow with the slope of the map, and the growth is fitted from the residuals themselves. The
common level of all texels is removed from each draw, because no frame shows it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from thermorender.inverse.normal import Cells, Normal, Unknowns
from thermorender.inverse.weights import sharpened

Floats = NDArray[np.float64]
# Draws, and width of the smoothing of their variance [texels].
DRAWS = 8
_SMOOTH = 2.0
# Relative residual of a draw's solution: a variance needs fewer digits than a map.
_TOLERANCE = 1e-3
# Classes of slope in the fit, and squares beyond so many means of their class that are left out.
_CLASSES, _OUTLIER = 24, 30.0


@dataclass(frozen=True, eq=False)
class Spread:
    """The standard deviations of a reconstruction.

    Attributes
    ----------
    std : (h, w) float64
        Of each texel, without the common level [linear kelvin].
    shared : float
        Standard deviation of the mean residual of a frame's pixels in a cell on even ground, over that of white noise.
    edge_texels : float
        Growth of that deviation with the slope of the map: error of a frame's position [texels].
    views : (h, w) int32
        Frames that show each texel.
    residual : (h, w) float64
        Root mean square of the residuals of the pixels on each texel [linear kelvin].
    """

    std: Floats
    shared: float
    edge_texels: float
    views: NDArray[np.int32]
    residual: Floats


class Draws:
    """Right-hand sides of the normal equations by random noise, of which the solutions have the covariance H⁻¹.

    Parameters
    ----------
    shape : (2,) ints
        Of the map.
    common, classes : int
        Numbers of common parameters and of classes.
    seed : int
    """

    def __init__(self, shape: tuple[int, int], common: int, classes: int, seed: int = 0) -> None:
        self._rng = np.random.default_rng(seed)
        self._map = np.zeros((DRAWS, *shape))
        self._frames: list[Floats] = []
        self._common, self._classes = np.zeros((DRAWS, common)), np.zeros((DRAWS, classes))
        # Of each frame's cells: pixels times the square of their mean residual, and the sum of their squared slopes.
        self.squares: list[NDArray[np.float32]] = []
        self.views = np.zeros(shape, np.int32)
        self._square, self._count = np.zeros(shape), np.zeros(shape)

    def add(self, cells: Cells, precision: Floats, own: Floats, common: Floats) -> None:
        """Add a frame, as by `Normal.add`."""
        root, frames = np.sqrt(precision), []
        for number in range(DRAWS):
            noise = root * (2.0 * self._rng.integers(0, 2, precision.size, dtype=np.int8) - 1.0)
            self._map[number][cells.window] += cells.gathered(noise)
            frames.append(own @ noise)
            self._common[number] += common @ noise
        self._frames.append(np.array(frames))

    def add_residuals(self, cells: Cells, residual: Floats, steep: Floats, noise_k: float) -> None:
        """Add the residuals of a frame's pixels, at slopes of the map [K/texel], with the noise of their precision."""
        count = cells.gathered(np.ones(residual.size))
        self.views[cells.window] += count > 0.0
        self._count[cells.window] += count
        self._square[cells.window] += cells.gathered(residual**2)
        # Means over the pixels of a frame in a cell: errors that neighbours share stay in them.
        size = cells.shape[0] * cells.shape[1]
        pixels = np.bincount(cells.number, minlength=size)
        total, slope = (np.bincount(cells.number, each, size) for each in (residual, steep**2))
        full = pixels > 0
        square = total[full] ** 2 / pixels[full]
        self.squares.append(np.stack([square / noise_k**2, slope[full] / noise_k**2]).astype(np.float32))

    @property
    def residual(self) -> Floats:
        """Root mean square of the residuals on each texel."""
        return np.sqrt(self._square / np.maximum(self._count, 1e-9))

    def gradient(self, normal: Normal, number: int) -> Unknowns:
        """Return the right-hand side of one draw, with the noise of the prior."""
        prior, rng = normal.prior, self._rng
        pull = np.sqrt(prior.precision) * rng.standard_normal(prior.mean.shape)
        classes = np.sqrt(prior.class_precision) * rng.standard_normal(prior.count)
        classes -= np.bincount(prior.classes.ravel(), pull.ravel(), prior.count)
        frames = np.array([each[number] for each in self._frames])
        frames = frames + np.sqrt(normal.frame_precision) * rng.standard_normal(frames.shape)
        common = self._common[number] + np.sqrt(normal.common_precision) * rng.standard_normal(self._common.shape[1])
        return Unknowns(self._map[number] + pull, frames, common, classes)


def spread_of(normal: Normal, draws: Draws, slope: Floats, reach: float, terms: int) -> Spread:
    """Return the Spread of a solution.

    Parameters
    ----------
    normal : Normal
    draws : Draws
        Of the same frames.
    slope : (h, w) array
        Of the map [K/texel].
    reach, terms : float, int
        As of `weights.sharpened`, over all rounds: removing the blur raises the noise of fine structure.

    Notes
    -----
    The level is the mean of the texels that the frames show.
    """
    seen = draws.views > 0
    variance = np.zeros(seen.shape)
    for number in range(DRAWS):
        x, _ = normal.solved(draws.gradient(normal, number), _TOLERANCE)
        found = sharpened(x.map, reach, terms)
        variance += (found - found[seen].mean()) ** 2 / DRAWS
    # Beyond the texels that are seen the variance is that of the prior, which must not leak in.
    weight = gaussian_filter(seen.astype(np.float64), _SMOOTH)
    smooth = gaussian_filter(np.where(seen, variance, 0.0), _SMOOTH) / np.maximum(weight, 1e-9)
    variance = np.where(seen, smooth, variance)
    scale, edge = _edges(*np.concatenate(draws.squares, axis=1))
    variance *= max(scale, 1.0)
    std = np.sqrt(variance + (edge * slope) ** 2)
    return Spread(std, float(np.sqrt(max(scale, 1.0))), edge, draws.views, draws.residual)


def _edges(square: NDArray[np.float32], slope: NDArray[np.float32]) -> tuple[float, float]:
    """(variance of the cells' means on even ground, over that of the noise; error of the position [texels])."""
    order = np.argsort(slope, kind="stable")
    x, y = np.empty(_CLASSES), np.empty(_CLASSES)
    for number, part in enumerate(np.array_split(order, _CLASSES)):
        kept = square[part] <= _OUTLIER * max(float(np.mean(square[part])), 1e-12)
        x[number], y[number] = slope[part][kept].mean(dtype=np.float64), square[part][kept].mean(dtype=np.float64)
    # Classes have equal numbers of cells, so the relative errors of their means are alike.
    basis = np.stack([np.ones(_CLASSES), x], axis=1) / y[:, None]
    fit, *_ = np.linalg.lstsq(basis, np.ones(_CLASSES), rcond=None)
    return float(max(fit[0], 0.0)), float(np.sqrt(max(fit[1], 0.0)))
