"""The fit of one pose: how offset, contrast, shift, blur, zoom and materials together explain a picture's difference.

The picture is s = offset + mean + gain (t − mean), with t the reference, zoomed, moved and blurred, and `mean` its mean
over the ground. Gauss–Newton finds zoom, shift and blur; the rest is linear. Each material adds an offset and an
emissivity column. Normal equations are kept by piece of ground, because errors of neighbouring pixels are correlated.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.compare.registration import ALIKE, correlation, peak, transform

# Whether shift, blur and zoom are free.
Free = tuple[bool, bool, bool]
_Value = TypeVar("_Value", bound=np.generic)

# Columns of the normal equations before those of the materials: their number, and the place of each cause.
BASE = {"offset": (0,), "contrast": (1,), "shift": (2, 3), "blur": (4,), "zoom": (5,)}
WIDTH = 6
# Largest number of pixels in the normal equations; more are thinned out to a grid.
_MOST_PIXELS = 40_000
# Pixels this near to unknown ones or to objects are left out [px].
_BORDER_PX = 3
# Gauss–Newton: most steps, largest step of shift [px] and variance [px²], convergence [px], range of the variance.
_STEPS, _STEP_PX, _STEP_PX2, _DONE = 8, 0.7, 1.5, 0.01
_VARIANCE = (-0.3, 25.0)
# Below these, one linearisation holds with and without shift, zoom at the picture's edge, and blur [px, px²].
_SMALL_PX, _SMALL_PX2 = 0.2, 0.3
# Residuals beyond this many robust standard deviations count less. Ridge relative to the reference's variance.
_ROBUST, _RIDGE = 3.0, 1e-6
# Least share of pixels of a single material at which the others are left out.
_PURE = 0.3
# Places along each side at which a first guess of the zoom measures the shift, and least number that must correlate.
_PLACES, _FEWEST_PLACES = 3, 4
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
    # By whether shift, blur and zoom are free; a missing one equals that of `most`
    equations: dict[Free, Equations]
    middle_k: float  # Median error [K]
    mean_k: float  # Mean of the reference [K]

    @property
    def most(self) -> Free:
        """The freest model of the fit."""
        return max(self.equations)

    def at(self, free: Free) -> Equations:
        """Return the Equations for models with or without shift, blur and zoom."""
        return self.equations.get(free, self.equations[self.most])


def fit(
    pair: Pair, start: tuple[float, float] = (0.0, 0.0), least_share: float = 0.005, zoom: float | None = None
) -> PoseFit | None:
    """Return the PoseFit of a Pair, None with too few pixels.

    `start` is the first guess of the shift right and down [px]; materials below `least_share` of the ground have no
    columns. `zoom` is the first guess of the zoom, how much larger the picture is than the reference; None fits none.
    """
    picture = _Picture(pair, start, zoom or 0.0)
    if picture.count < _FEWEST:
        return None
    materials = picture.materials(least_share)
    most = True, True, zoom is not None
    found = {most: picture.solved(np.array([*start, 0.0, zoom or 0.0]), most)}
    right, down, variance, zoomed = found[most]
    if max(np.hypot(right, down), abs(zoomed) * picture.half_px) > _SMALL_PX or abs(variance) > _SMALL_PX2:
        whole = np.array([right, down, max(variance, 0.0), zoomed])
        for free in product((True, False), (True, False), (True, False) if most[2] else (False,)):
            if free != most:
                given = whole * np.array([free[0], free[0], free[1], free[2]])
                found[free] = picture.solved(given, free) if any(free) else given
    cells, order, edges = picture.sorted_cells()
    equations = {free: picture.equations(at, materials, order, edges) for free, at in found.items()}
    names = tuple(pair.names[number] for number in materials)
    return PoseFit(cells, names, equations, picture.middle_k, picture.mean_k)


class _Picture:
    """The pixels of a Pair that take part in the fit."""

    def __init__(self, pair: Pair, start: tuple[float, float], zoom: float) -> None:
        import cv2

        known = pair.known & np.isfinite(pair.truth)
        sides = np.ones((2 * _BORDER_PX + 1,) * 2, np.uint8)
        inside = cv2.erode(known.astype(np.uint8), sides, borderType=cv2.BORDER_CONSTANT, borderValue=0).astype(bool)
        ground = cv2.erode(pair.ground.astype(np.uint8), sides).astype(bool)
        # Pixels must be known before and after the shift, so that all models are fitted to the same ones.
        whole = tuple(round(value) for value in start)
        used = inside & ground & _rolled(inside, whole) & np.isfinite(pair.seen)
        used &= _zoomed(inside.astype(np.float32), zoom) > 0.5
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
        self.mean_k = float(truth[self._used].mean(dtype=np.float64))
        self._variance_k2 = float(truth[self._used].var(dtype=np.float64))
        self._truth = np.where(known, truth - np.float32(self.mean_k), np.float32(0.0))
        self._seen = np.asarray(pair.seen, np.float64)[self._used] - self.mean_k
        self.middle_k = float(np.median(self._seen - self._truth[self._used]))
        self._material = pair.material[self._used]
        self._emissivity = np.asarray(pair.emissivity_k, np.float64)[self._used]
        self._cell = pair.cell[self._used]
        # Distance from the middle, at which a zoom moves a pixel [px].
        row, column = np.nonzero(self._used)
        self._across, self._along = column - 0.5 * (truth.shape[1] - 1), row - 0.5 * (truth.shape[0] - 1)
        self.half_px = 0.5 * max(truth.shape)

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
        """Return (base columns (n, 6), residual of offset and gain (n,), Huber weights (n,)) of a moved picture."""
        right, down, variance, zoom = at.tolist()
        whole = round(right), round(down)
        shown = moved(_rolled(_zoomed(self._truth, zoom), whole), right - whole[0], down - whole[1], variance)
        image, *slopes = (part[self._used].astype(np.float64) for part in shown)
        slopes.append(self._across * slopes[0] + self._along * slopes[1])
        flat = np.stack([np.ones(self.count), image], axis=-1)
        weight = np.ones(self.count)
        for _ in range(2):
            weighted = flat * weight[:, None]
            best = np.linalg.lstsq(weighted.T @ flat, weighted.T @ self._seen, rcond=None)[0]
            residual = self._seen - flat @ best
            scale = max(_ROBUST * 1.4826 * float(np.median(np.abs(residual))), 1e-3)
            weight = np.minimum(1.0, scale / np.maximum(np.abs(residual), 1e-9))
        return np.column_stack([flat, *(best[1] * slope for slope in slopes)]), residual, weight

    def solved(self, at: NDArray[np.float64], free: Free) -> NDArray[np.float64]:
        """Return the best (right, down, variance, zoom) by Gauss–Newton; what is not free keeps its value."""
        kept = [0, 1, *((2, 3) if free[0] else ()), *((4,) if free[1] else ()), *((5,) if free[2] else ())]
        limits = np.array([_STEP_PX, _STEP_PX, _STEP_PX2, _STEP_PX / self.half_px])
        done = np.array([_DONE, _DONE, _DONE, _DONE / self.half_px])
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
            if (np.abs(after - at) < done).all():
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


def zoom_of(
    seen: NDArray[np.floating], truth: NDArray[np.floating], known: NDArray[np.bool_]
) -> tuple[float, tuple[float, float]]:
    """Return a first guess of (zoom, shift right and down [px]) of a picture, from its shifts at several places.

    The zoom is 0 where too few places correlate.
    """
    rows, columns = truth.shape
    height, width = rows // 2, columns // 2
    places = []
    for top in np.linspace(0, rows - height, _PLACES).astype(int):
        for left in np.linspace(0, columns - width, _PLACES).astype(int):
            part = np.s_[top : top + height, left : left + width]
            if known[part].mean() > 0.5:
                one, other = (transform(image[part], known[part]) for image in (seen, truth))
                found = peak(*correlation(one, other))
                if found is not None and found[2] >= ALIKE:
                    places.append((left + 0.5 * (width - columns), top + 0.5 * (height - rows), *found[:2]))
    if len(places) < _FEWEST_PLACES:
        return 0.0, (0.0, 0.0)
    across, along, right, down = np.array(places).T
    flat, none = np.ones(len(across)), np.zeros(len(across))
    matrix = np.block([[across[:, None], flat[:, None], none[:, None]], [along[:, None], none[:, None], flat[:, None]]])
    zoom, *shift = np.linalg.lstsq(matrix, np.concatenate([right, down]), rcond=None)[0].tolist()
    return zoom, (shift[0], shift[1])


def _zoomed(image: NDArray[np.float32], zoom: float) -> NDArray[np.float32]:
    """Return a picture that is larger by `zoom` about its middle."""
    import cv2

    if not zoom:
        return image
    height, width = image.shape
    across, along = ((np.arange(n) - 0.5 * (n - 1)) / (1.0 + zoom) + 0.5 * (n - 1) for n in (width, height))
    columns, rows = np.meshgrid(across.astype(np.float32), along.astype(np.float32))
    found: NDArray[np.float32] = cv2.remap(image, columns, rows, cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REFLECT)  # type: ignore[assignment]
    return found


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
