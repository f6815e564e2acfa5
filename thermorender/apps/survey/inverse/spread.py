"""The uncertainty of a reconstruction: standard deviation of each texel, without the common level.

Draws of noise and prior, solved like the frames, give the errors within the normal equations. The difference between
maps of both halves of the frames scales them and two further terms: map slope times position error, and residuals in
excess of the noise. Structure within texels, equal in all frames, is taken from the residuals, or from the error of an
edge by the second differences of the map; the larger counts. The truth is not used.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.optimize import nnls

from thermorender import Camera
from thermorender.apps.survey.inverse.normal import Footprint, Normal, Prior, Sums, Unknowns
from thermorender.apps.survey.inverse.poses import slopes
from thermorender.apps.survey.inverse.weights import sharpened, texel_line, texel_means
from thermorender.render.light.exchange import threads
from thermorender.sensor.psf import otf

Floats = NDArray[np.float64]
# Draws, and width of the smoothing of their variance [texels].
DRAWS, _SMOOTH = 8, 2.0
# Relative residual of a draw's solution: a variance needs fewer digits than a map.
_TOLERANCE = 3e-3
# Structure within texels makes errors that are alike in all frames: the halves' differences shrink with more frames,
# and the errors do not. Both agree at this many frames in one simulated flight over heath, by its truth.
_ALIKE = 4.0
# Width of the smoothing of the squares of residuals [texels].
_NEAR = 1.0
# Classes of each term in the fit, and squares beyond so many means of their class that are left out.
_CLASSES, _OUTLIER = 24, 30.0
# Frequencies below half a cycle per texel, and their repetitions to either side.
_STEPS, _ALIASES = 128, 64
# Edges between texels of the scene in a row: whole cycles for sides of halves, thirds, quarters and fifths.
_PLACES = 60


@dataclass(frozen=True, eq=False)
class Spread:
    """The standard deviations of a reconstruction."""

    std: Floats  # (h, w) float64 of each texel, without the common level [linear kelvin]
    scale: float  # Error of even ground by the halves, over that by the draws
    edge_texels: float  # Growth of the error with the slope of the map: error of the position [texels]
    misfit: float  # Growth of the error with what the residuals exceed the noise
    views: NDArray[np.int32]  # (h, w) int32 frames that show each texel
    residual: Floats  # (h, w) float64 root mean square of the residuals of the pixels on each texel [linear kelvin]
    # (F,) float64 root mean square of the residuals of each frame [linear kelvin]; NaN for one that shows nothing
    frames: Floats
    groups: int = 1  # Groups of frames that share no texel; only the prior links their levels


class Drawn(NamedTuple):
    """Right-hand sides of a frame's draws: on its window (DRAWS, …), of its own and of the common parameters.

    The last two are the number of pixels on each texel and the sum of their squared residuals.
    """

    maps: Floats
    frames: Floats
    common: Floats
    pixels: Floats
    square: Floats


class Draws:
    """Random right-hand sides of the normal equations, whose solutions have the covariance H⁻¹.

    `pattern_k`, (H·W,), is the standard deviation of the remaining fixed pattern, common to all frames [K].
    """

    def __init__(self, prior: Prior, common: int, offset_precision: float, pattern_k: Floats, seed: int = 0) -> None:
        shape, self._seed = prior.mean.shape, seed
        self._rng = np.random.default_rng(seed)
        self._pattern = pattern_k.astype(np.float32) * self._rng.standard_normal(
            (DRAWS, pattern_k.size), dtype=np.float32
        )
        self._map = np.zeros((DRAWS, *shape))
        self._frames: list[Floats] = []
        self.misfits: list[float] = []
        self._common = np.zeros((DRAWS, common))
        self.views = np.zeros(shape, np.int32)
        self._square, self._count = np.zeros(shape), np.zeros(shape)
        self._group = np.full(shape, -1)
        offset = np.array([offset_precision])
        self.halves = tuple(Normal(prior, offset, np.zeros(0)) for _ in range(2))

    def of_frame(
        self, number: int, seen: Footprint, pixel: NDArray[np.int64], residual: Floats, precision: Floats, own: Floats,
        common: Floats,
    ) -> "Drawn":  # fmt: skip
        """Return what a frame adds, with arguments as of `Sums.of` and the numbers of its pixels."""
        rng = np.random.default_rng((self._seed, number))
        signs = 2.0 * rng.integers(0, 2, (DRAWS, precision.size), dtype=np.int8) - 1.0
        noise = np.sqrt(precision) * signs + precision * self._pattern[:, pixel]
        *maps, count, square = seen.gathered(np.concatenate([noise, [np.ones_like(residual), residual**2]]))
        return Drawn(np.array(maps), noise @ own.T, noise @ common.T, count, square)

    def add(self, number: int, drawn: "Drawn", sums: Sums) -> None:
        """Add a frame, also to the half of the frames with even or odd numbers."""
        self.halves[number % 2].add(sums.of_offset, np.zeros(1))
        window = sums.block.window
        self._map[(slice(None), *window)] += drawn.maps
        self._frames.append(drawn.frames)
        self._common += drawn.common
        self._count[window] += drawn.pixels
        self._square[window] += drawn.square
        pixels = float(drawn.pixels.sum())
        self.misfits.append(float(np.sqrt(drawn.square.sum() / pixels)) if pixels > 0.0 else np.nan)
        shown, group = drawn.pixels > 0.0, self._group
        self.views[window] += shown
        # A frame joins all groups that it shares a texel with.
        joined = np.unique(group[window][shown])
        joined = joined[joined >= 0]
        if joined.size > 1 or not joined.size:
            group[np.isin(group, joined)] = number
            joined = np.array([number])
        group[window][shown] = joined[0]

    @property
    def groups(self) -> int:
        """Number of groups of frames that share no texel."""
        return int(np.unique(self._group[self._group >= 0]).size)

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


def spread_of(
    normal: Normal, draws: Draws, means: Floats, reach: float, terms: int, side: float, noise_k: float, share: float
) -> Spread:  # fmt: skip
    """Return the Spread of a solution with means (h, w) [K]; their level is the mean of the texels in the frames.

    `reach` and `terms` are those of `weights.sharpened` over all rounds, which raises the noise of fine structure;
    `side` is a texel's side in texels of the scene.
    """
    seen = draws.views > 0
    variance = np.zeros(seen.shape)

    def drawn(gradient: Unknowns) -> Floats:
        found, _ = normal.solved(gradient, _TOLERANCE)
        return texel_means(sharpened(found.map, reach, terms), side)

    gradients = [draws.gradient(normal, number) for number in range(DRAWS)]
    with threads() as pool:
        for found in pool.map(drawn, gradients):
            variance += (found - found[seen].mean()) ** 2 / DRAWS
    # Beyond the texels that are seen the variance is that of the prior, which must not leak in.
    variance = np.where(seen, _near(variance, seen, _SMOOTH), variance)
    beyond = np.where(seen, np.maximum(_near(draws.residual**2, seen, _NEAR) - noise_k**2, 0.0), 0.0)
    right, down = slopes(means)
    shared = np.stack([variance, right**2 + down**2, _ALIKE * beyond / np.maximum(draws.views, 1)])
    factors = _fitted(_difference(draws, reach, terms, side), shared)
    alike = np.maximum(factors[2] * beyond, error_of_edges(means, variance, share))
    std = np.sqrt(np.tensordot(factors[:2], shared[:2], axes=1) + alike)
    scale, edge, misfit = (float(each) for each in np.sqrt(factors))
    return Spread(std, scale, edge, misfit, draws.views, draws.residual, np.array(draws.misfits), draws.groups)


def _near(values: Floats, seen: NDArray[np.bool_], width: float) -> Floats:
    """Means of the texels that are seen around each texel."""
    weight = gaussian_filter(seen.astype(np.float64), width)
    return np.asarray(gaussian_filter(np.where(seen, values, 0.0), width) / np.maximum(weight, 1e-9))


def _difference(draws: Draws, reach: float, terms: int, side: float) -> Floats:
    """Return half the difference of the maps of both halves, (h, w), with the map's error; NaN where one is empty."""
    prior = draws.halves[0].prior
    both = np.ones(prior.mean.shape, bool)
    step = np.zeros(prior.mean.shape)
    if not all(half.count for half in draws.halves):
        return np.full(step.shape, np.nan)

    def solved(half: Normal) -> Floats:
        gradient = half.gradient(np.zeros(step.shape), np.zeros(prior.count), np.zeros(0))
        return half.solved(gradient, _TOLERANCE)[0].map

    with threads() as pool:
        for half, sign, found in zip(draws.halves, (0.5, -0.5), pool.map(solved, draws.halves), strict=True):
            step += sign * found
            both &= half.stencil.link[0] > 0.0
    return np.where(both, texel_means(sharpened(np.where(both, step, 0.0), reach, terms), side), np.nan)


def _fitted(difference: Floats, terms: Floats) -> Floats:
    """Factors (3,) of the terms (3, h, w) in the squares of the halves' differences."""
    known = np.isfinite(difference)
    if known.sum() < _CLASSES:
        return np.array([1.0, 0.0, 0.0])
    square = (difference[known] - np.median(difference[known])) ** 2
    terms = terms[:, known]
    rows = []
    for order in (np.argsort(term, kind="stable") for term in terms[1:]):
        for part in np.array_split(order, _CLASSES):
            kept = part[square[part] <= _OUTLIER * max(float(square[part].mean()), 1e-12)]
            rows.append([square[kept].mean(), *terms[:, kept].mean(axis=1)])
    # Classes have equal numbers of texels, so the relative errors of their means are alike.
    table = np.maximum(rows, 1e-300)
    fit, _ = nnls(table[:, 1:] / table[:, :1], np.ones(len(table)))
    # The draws are the least that is possible.
    return np.array([max(fit[0], 1.0), fit[1], fit[2]])


def error_of_edges(means: Floats, variance: Floats, share: float) -> Floats:
    """Return the squared error by edges within texels, (h, w) [K²], from second differences of the means [K].

    Twelve times the variance of their noise is subtracted.
    """
    padded = np.pad(means, 1, mode="edge")
    down = padded[2:, 1:-1] - 2.0 * means + padded[:-2, 1:-1]
    across = padded[1:-1, 2:] - 2.0 * means + padded[1:-1, :-2]
    return np.asarray(share * np.maximum(down**2 + across**2 - 12.0 * variance, 0.0))


def error_of_curvature(camera: Camera, pixel: float, side: float) -> float:
    """Return the mean square error of edges over the squared second differences of the map.

    `pixel` and `side` are those of a pixel [texels] and of a texel [texels of the scene]; at a `side` of 1 or less it
    is 0. The map is the projection of the edge, blurred by a pixel, on blurred bilinear maps. Both squares are summed
    across the edge and over its places in a texel.
    """
    if pixel <= 0.0 or side < 1.0:
        return 0.0
    base = (np.arange(_STEPS) + 0.5) / _STEPS - 0.5
    frequency = base + np.arange(-_ALIASES, _ALIASES + 1)[:, None]
    seen = np.abs(frequency * pixel)
    transfer = (otf(camera, seen.ravel()).reshape(seen.shape) * np.sinc(seen)) ** 2
    tent = np.sinc(frequency) ** 2
    outer, middle, _ = texel_line(side)
    wave = np.cos(2.0 * np.pi * base)
    means, bends = middle + 2.0 * outer * wave, 2.0 - 2.0 * wave
    # A step between two texels of the scene, before these are joined bilinearly, or each fills its own texel.
    step = 1.0 / (2j * side * np.sin(np.pi * frequency / side))
    scene_texel = np.sinc(frequency / side)
    error = curvature = 0.0
    for place in np.arange(_PLACES) / side % 1.0 - 0.5:
        edge = step * np.exp(-2j * np.pi * frequency * place) * scene_texel
        middles = (transfer * tent * scene_texel * edge).sum(axis=0) / (transfer * tent**2).sum(axis=0)
        truth = (np.sinc(frequency) * edge).sum(axis=0)
        error += float(np.mean(np.abs(middles * means - truth) ** 2))
        curvature += float(np.mean(np.abs(middles * means * bends) ** 2))
    return error / curvature
