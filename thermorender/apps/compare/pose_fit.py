"""The fit of one pose: how offset, contrast, shift, blur and materials together explain a picture's difference.

The picture is s = offset + mean + gain (t − mean), with t the reference, moved and blurred, and `mean` its mean over
the ground. Gauss–Newton finds shift and blur; the rest is linear. Each material adds an offset and an emissivity
column. Normal equations are kept by piece of ground, because errors of neighbouring pixels are correlated.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

_Value = TypeVar("_Value", bound=np.generic)

# Columns of the normal equations before those of the materials: their number, and the place of each cause.
BASE = {"offset": (0,), "contrast": (1,), "shift": (2, 3), "blur": (4,)}
WIDTH = 5
# Largest number of pixels in the normal equations; more are thinned out to a grid.
_MOST_PIXELS = 40_000
# Pixels this near to unknown ones or to objects are left out [px].
_BORDER_PX = 3
# Gauss–Newton: most steps, largest step of shift [px] and variance [px²], convergence [px], range of the variance.
_STEPS, _STEP_PX, _STEP_PX2, _DONE = 8, 0.7, 1.5, 0.01
_VARIANCE = (-0.3, 25.0)
# Below these, one linearisation holds with and without shift and blur [px, px²].
_SMALL_PX, _SMALL_PX2 = 0.2, 0.3
# Residuals beyond this many robust standard deviations count less. Ridge relative to the reference's variance.
_ROBUST, _RIDGE = 3.0, 1e-6
# Least share of pixels of a single material at which the others are left out.
_PURE = 0.3
# Least number of pixels of a fit.
_FEWEST = 200
# Filter of shift and blur: half-width without blur [px], its growth with the standard deviation of the blur, side of
# the transform that makes the taps, and step of the differences between filters [px, px²].
_REACH_PX, _PER_SIGMA = 6, 4.0
_SIDE, _STEP = 128, 0.02


@dataclass(frozen=True)
class Pair:
    """A method's picture and the reference of one pose."""

    # seen, truth: (H, W) arrays apparent temperature [K]
    seen: NDArray[np.floating]
    truth: NDArray[np.floating]
    ground: NDArray[np.bool_]  # (H, W) bool pixels of ground with known temperature
    known: NDArray[np.bool_]  # (H, W) bool pixels where the reference is known, objects too
    material: NDArray[np.uint8]  # (H, W) uint8
    names: Sequence[str]  # Name of each material number
    emissivity_k: NDArray[np.floating]  # (H, W) change of apparent temperature by a unit of emissivity [K]
    cell: NDArray[np.integer]  # (H, W) int number of the piece of ground that a pixel shows
    pure: NDArray[np.bool_]  # (H, W) bool pixels that show a single material


@dataclass(frozen=True)
class Equations:
    """Normal equations of one pose by piece of ground, about the fitted shift and blur."""

    matrix: NDArray[np.float64]  # (K, Q, Q) float64 aᵀA
    # (K, Q) float64 aᵀy; y is linearised, so that the solution is the deviation from a perfect picture
    right: NDArray[np.float64]
    square: NDArray[np.float64]  # (K,) float64 yᵀy [K²]


@dataclass(frozen=True)
class PoseFit:
    """The fit of one pose."""

    cells: NDArray[np.intp]  # (K,) int numbers of the pieces of ground
    materials: tuple[str, ...]  # Materials with columns, in their order
    # By whether shift and blur are free; a missing one equals that of (True, True)
    equations: dict[tuple[bool, bool], Equations]
    middle_k: float  # Median error [K]

    def at(self, shift: bool, blur: bool) -> Equations:
        """Return the Equations for models with or without shift and blur."""
        return self.equations.get((shift, blur), self.equations[True, True])


def fit(pair: Pair, start: tuple[float, float] = (0.0, 0.0), least_share: float = 0.005) -> PoseFit | None:
    """Return the PoseFit of a Pair, None with too few pixels.

    `start` is the first guess of the shift right and down [px]; materials below `least_share` of the ground have no
    columns.
    """
    picture = _Picture(pair, start)
    if picture.count < _FEWEST:
        return None
    materials = picture.materials(least_share)
    origin = np.array([*start, 0.0])
    found = {(True, True): picture.solved(origin, (True, True))}
    right, down, variance = found[True, True]
    if np.hypot(right, down) > _SMALL_PX or abs(variance) > _SMALL_PX2:
        found[True, False] = picture.solved(np.array([right, down, 0.0]), (True, False))
        found[False, True] = picture.solved(np.array([0.0, 0.0, max(variance, 0.0)]), (False, True))
        found[False, False] = np.zeros(3)
    cells, order, edges = picture.sorted_cells()
    equations = {free: picture.equations(at, materials, order, edges) for free, at in found.items()}
    names = tuple(pair.names[number] for number in materials)
    return PoseFit(cells, names, equations, picture.middle_k)


class _Picture:
    """The pixels of a Pair that take part in the fit."""

    def __init__(self, pair: Pair, start: tuple[float, float]) -> None:
        import cv2

        known = pair.known & np.isfinite(pair.truth)
        sides = np.ones((2 * _BORDER_PX + 1,) * 2, np.uint8)
        inside = cv2.erode(known.astype(np.uint8), sides, borderType=cv2.BORDER_CONSTANT, borderValue=0).astype(bool)
        ground = cv2.erode(pair.ground.astype(np.uint8), sides).astype(bool)
        # Pixels must be known before and after the shift, so that all models are fitted to the same ones.
        whole = tuple(round(value) for value in start)
        used = inside & ground & _rolled(inside, whole) & np.isfinite(pair.seen)
        # Pixels of several materials have errors that none of the materials has, but fine mosaics have no others.
        if (used & pair.pure).sum() >= _PURE * used.sum():
            used &= pair.pure
        step = max(1, round(np.sqrt(used.sum() / _MOST_PIXELS)))
        grid = np.zeros(used.shape, bool)
        grid[step // 2 :: step, step // 2 :: step] = True
        self._used = used & grid
        self.count = int(self._used.sum())
        if not self.count:
            return
        truth = np.asarray(pair.truth, np.float32)
        self._mean = float(truth[self._used].mean(dtype=np.float64))
        self._variance_k2 = float(truth[self._used].var(dtype=np.float64))
        self._truth = np.where(known, truth - np.float32(self._mean), np.float32(0.0))
        self._seen = np.asarray(pair.seen, np.float64)[self._used] - self._mean
        self.middle_k = float(np.median(self._seen - self._truth[self._used]))
        self._material = pair.material[self._used]
        self._emissivity = np.asarray(pair.emissivity_k, np.float64)[self._used]
        self._cell = pair.cell[self._used]

    def materials(self, least_share: float) -> list[int]:
        """Return the numbers of materials with at least this share of the pixels; none if there is only one."""
        counts = np.bincount(self._material, minlength=256)[:255]
        found = np.flatnonzero(counts >= max(least_share * self.count, 20)).tolist()
        return found if len(found) > 1 else []

    def sorted_cells(self) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
        """Return (numbers of the cells, order of the pixels by cell, their edges in this order)."""
        order = np.argsort(self._cell, kind="stable")
        cells, first = np.unique(self._cell[order], return_index=True)
        return cells, order, np.append(first, self.count)

    def columns(self, at: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return (base columns (n, 5), residual of offset and gain (n,), Huber weights (n,)) of a moved picture."""
        right, down, variance = at.tolist()
        whole = round(right), round(down)
        shown = moved(_rolled(self._truth, whole), right - whole[0], down - whole[1], variance)
        image, *slopes = (part[self._used].astype(np.float64) for part in shown)
        flat = np.stack([np.ones(self.count), image], axis=-1)
        weight = np.ones(self.count)
        for _ in range(2):
            weighted = flat * weight[:, None]
            best = np.linalg.lstsq(weighted.T @ flat, weighted.T @ self._seen, rcond=None)[0]
            residual = self._seen - flat @ best
            scale = max(_ROBUST * 1.4826 * float(np.median(np.abs(residual))), 1e-3)
            weight = np.minimum(1.0, scale / np.maximum(np.abs(residual), 1e-9))
        return np.column_stack([flat, *(best[1] * slope for slope in slopes)]), residual, weight

    def solved(self, at: NDArray[np.float64], free: tuple[bool, bool]) -> NDArray[np.float64]:
        """Return the best (right, down, variance) by Gauss–Newton; what is not free keeps its value."""
        kept = [0, 1, *((2, 3) if free[0] else ()), *((4,) if free[1] else ())]
        limits = np.array([_STEP_PX, _STEP_PX, _STEP_PX2])
        best, least = at, np.inf
        for _ in range(_STEPS):
            columns, residual, weight = self.columns(at)
            loss = float(np.minimum(weight, 1.0) @ residual**2)
            if loss < least:
                best, least = at, loss
            part = columns[:, kept]
            weighted = part * weight[:, None]
            matrix = weighted.T @ part
            # A flat picture has no derivatives; its shift remains zero.
            matrix[np.diag_indices_from(matrix)] += _RIDGE * self.count * max(self._variance_k2, 1e-6)
            step = np.zeros(WIDTH)
            step[kept] = np.linalg.solve(matrix, weighted.T @ residual)
            after = at + np.clip(step[2:], -limits, limits)
            after[2] = np.clip(after[2], *_VARIANCE)
            if np.abs(after - at).max() < _DONE:
                break
            at = after
        return best

    def equations(
        self, at: NDArray[np.float64], materials: Sequence[int], order: NDArray[np.intp], edges: NDArray[np.intp]
    ) -> Equations:
        """Return the Equations at a shift and variance."""
        base, _, _ = self.columns(at)
        size = WIDTH + 2 * len(materials)
        columns = np.zeros((self.count, size))
        columns[:, :WIDTH] = base
        for k, number in enumerate(materials):
            here = self._material == number
            columns[here, WIDTH + 2 * k] = 1.0
            columns[here, WIDTH + 2 * k + 1] = self._emissivity[here]
        # y: the residual plus the effect of the deviations from a perfect picture (gain 1, nothing else).
        wanted = self._seen - base[:, 1] + base[:, 2:] @ at
        columns, wanted = columns[order], wanted[order]
        matrix = np.empty((len(edges) - 1, size, size))
        right, square = np.empty((len(edges) - 1, size)), np.empty(len(edges) - 1)
        for k, (first, last) in enumerate(zip(edges[:-1], edges[1:], strict=True)):
            part, own = columns[first:last], wanted[first:last]
            matrix[k], right[k], square[k] = part.T @ part, part.T @ own, own @ own
        return Equations(matrix, right, square)


def _rolled(image: NDArray[_Value], whole: tuple[int, ...]) -> NDArray[_Value]:
    """Return a picture moved by whole pixels (right, down); what enters is zero."""
    right, down = whole
    if not right and not down:
        return image
    found = np.zeros_like(image)
    height, width = image.shape
    if abs(right) < width and abs(down) < height:
        found[max(down, 0) : height + min(down, 0), max(right, 0) : width + min(right, 0)] = image[
            max(-down, 0) : height + min(-down, 0), max(-right, 0) : width + min(-right, 0)
        ]
    return found


class Moved(NamedTuple):
    """A moved picture and its derivatives, (H, W) float32 each: by shift right, shift down, and blur variance."""

    image: NDArray[np.float32]
    right: NDArray[np.float32]
    down: NDArray[np.float32]
    variance: NDArray[np.float32]


def moved(image: NDArray[np.float32], right: float, down: float, variance: float) -> Moved:
    """Return a finite picture (H, W) moved by `right` and `down` [px], at most 3, after a blur of a variance [px²].

    Each axis has one filter: a band-limited shift times a Gaussian. A negative variance sharpens.
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
