"""The normal equations of all frames: a stencil of nine points on the map, blocks of each frame, and their solution.

The unknowns are changes: of the texels, of each frame's own parameters (its offset, and its pose where that is free),
of parameters common to all frames (the vignetting), and of the offsets of classes in the prior. A pixel of the matrix
is bilinear between four texels, so a texel is linked to its eight neighbours only. By symmetry five numbers hold these
links: 40 bytes a texel, however many frames there are. Residuals come from the exact forward model, with blur; the
matrix without blur then only sets the path to the solution, as in deferred correction.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from thermorender.inverse.weights import Sight

Floats = NDArray[np.float64]
_T = TypeVar("_T")
# Corners of a cell, (row, column), in the order of the weights.
_CORNERS = ((0, 0), (0, 1), (1, 0), (1, 1))
# The links between the corners of a cell: index in the stencil, of corners a and b, and the texel that holds the link.
# The stencil's entries are: the texel itself, its neighbour to the right, below, below right, and below left.
_LINKS = (
    (0, 0, 0, (0, 0)), (0, 1, 1, (0, 1)), (0, 2, 2, (1, 0)), (0, 3, 3, (1, 1)),
    (1, 0, 1, (0, 0)), (1, 2, 3, (1, 0)), (2, 0, 2, (0, 0)), (2, 1, 3, (0, 1)),
    (3, 0, 3, (0, 0)), (4, 1, 2, (0, 1)),
)  # fmt: skip
# Two, whatever the machine has, so that sums have one order. They start with the first work.
_THREADS = ThreadPoolExecutor(2)
_SELF, _RIGHT, _BELOW, _BELOW_RIGHT, _BELOW_LEFT = range(5)


class Cells(NamedTuple):
    """The cells of a window of the map that hold the pixels of a frame, and the pixels' weights in them.

    `shape` counts cells; the window has one texel more along each side.
    """

    top: int
    left: int
    shape: tuple[int, int]
    number: NDArray[np.int64]  # (N,) of each pixel's cell in the window
    weight: Floats  # (4, N) bilinear, in the order of `_CORNERS`

    @property
    def window(self) -> tuple[slice, slice]:
        """The texels of the window on the map."""
        rows, columns = self.shape
        return slice(self.top, self.top + rows + 1), slice(self.left, self.left + columns + 1)

    def gathered(self, values: Floats) -> Floats:
        """Return the sums over pixels (N,) of their weights times `values`, on the window's texels."""
        rows, columns = self.shape
        total = np.zeros((rows + 1, columns + 1))
        for (down, right), weight in zip(_CORNERS, self.weight, strict=True):
            part = np.bincount(self.number, weight * values, rows * columns).reshape(self.shape)
            total[down : down + rows, right : right + columns] += part
        return total


def cells_of(sight: Sight) -> Cells:
    """Return the Cells of a frame's pixels."""
    row, column = np.floor(sight.row).astype(np.int64), np.floor(sight.column).astype(np.int64)
    (top, rows), (left, columns) = (
        (int(values.min()), int(np.ptp(values)) + 1) if values.size else (0, 1) for values in (row, column)
    )
    down, right = sight.row - row, sight.column - column
    weight = np.stack([(1 - down) * (1 - right), (1 - down) * right, down * (1 - right), down * right])
    return Cells(top, left, (rows, columns), (row - top) * columns + column - left, weight)


class Stencil:
    """A symmetric matrix that links each texel of a map (h, w) with itself and its eight neighbours.

    Attributes
    ----------
    link : (5, h, w) float64
        Of each texel with itself, and with those to the right, below, below right and below left.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self.link = np.zeros((5, *shape))

    def add(self, cells: Cells, precision: Floats) -> None:
        """Add Aᵀ W A of the pixels of a frame, with the diagonal (N,) of W."""
        rows, columns = cells.shape
        for entry, a, b, (down, right) in _LINKS:
            values = precision * cells.weight[a] * cells.weight[b]
            part = np.bincount(cells.number, values, rows * columns).reshape(cells.shape)
            top, left = cells.top + down, cells.left + right
            self.link[entry, top : top + rows, left : left + columns] += part

    def __call__(self, x: Floats) -> Floats:
        """Return the product with x, (h, w)."""
        link = self.link
        y = link[_SELF] * x
        for entry, here, there in (
            (_RIGHT, np.s_[:, :-1], np.s_[:, 1:]), (_BELOW, np.s_[:-1, :], np.s_[1:, :]),
            (_BELOW_RIGHT, np.s_[:-1, :-1], np.s_[1:, 1:]), (_BELOW_LEFT, np.s_[:-1, 1:], np.s_[1:, :-1]),
        ):  # fmt: skip
            between = link[entry][here]
            y[here] += between * x[there]
            y[there] += between * x[here]
        return y


@dataclass(frozen=True, eq=False)
class Prior:
    """What is known of the map without the frames.

    Attributes
    ----------
    mean : (h, w) float64
    precision : (h, w) float64
        1 over the variance of each texel about its class.
    classes : (h, w) integers
        Class of each texel, 0…C−1.
    class_precision : float
        1 over the variance of the common offset of a class.
    """

    mean: Floats
    precision: Floats
    classes: NDArray[np.intp]
    class_precision: float

    @property
    def count(self) -> int:
        """Number of classes."""
        return int(self.classes.max()) + 1


class Unknowns(NamedTuple):
    """Changes: of the map (h, w), of frames (F, P), of what is common (V,), and of classes (C,)."""

    map: Floats
    frames: Floats
    common: Floats
    classes: Floats


class _Block(NamedTuple):
    """A frame's part of the equations."""

    window: tuple[slice, slice]
    coupling: NDArray[np.float32]  # (P, texels of the window)
    own: Floats  # (P, P)
    common: Floats  # (P, V)


class Normal:
    """The normal equations H x = g of a least-squares problem with a prior.

    Parameters
    ----------
    prior : Prior
    frame_precision : (P,) array
        1 over the prior variance of a frame's parameters.
    common_precision : (V,) array
    """

    def __init__(self, prior: Prior, frame_precision: Floats, common_precision: Floats) -> None:
        self.prior, self.shape = prior, prior.mean.shape
        self.frame_precision, self.common_precision = frame_precision, common_precision
        self.stencil = Stencil(self.shape)
        self._blocks: list[_Block] = []
        count = len(common_precision)
        self._common_coupling = np.zeros((count, *self.shape))
        self._common_own = np.diag(common_precision).astype(np.float64)
        self._gradient = Unknowns(np.zeros(self.shape), np.zeros((0, 0)), np.zeros(count), np.zeros(prior.count))
        self._frames: list[Floats] = []

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self._blocks)

    def add(
        self, sight: Sight, residual: Floats, precision: Floats, own: Floats, common: Floats, deviation: Floats
    ) -> Cells:  # fmt: skip
        """Add a frame.

        Parameters
        ----------
        sight : Sight
            Of its N pixels.
        residual : (N,) array
            Measured minus predicted.
        precision : (N,) array
            1 over the variance of each pixel.
        own, common : (P, N) and (V, N) arrays
            Change of the prediction with the frame's parameters and with the common ones.
        deviation : (P,) array
            Of the frame's parameters from their prior means.
        """
        cells = cells_of(sight)
        self.__dict__.pop("_preconditioned", None)
        self.stencil.add(cells, precision)
        weighted = precision * residual
        self._gradient.map[cells.window] += cells.gathered(weighted)
        self._gradient.common[:] += common @ weighted
        self._frames.append(own @ weighted - self.frame_precision * deviation)
        coupling = np.array([cells.gathered(precision * each) for each in own]).reshape(len(own), -1)
        for row, each in zip(self._common_coupling, common, strict=True):
            row[cells.window] += cells.gathered(precision * each)
        self._common_own += (common * precision) @ common.T
        matrix = (own * precision) @ own.T + np.diag(self.frame_precision)
        block = _Block(cells.window, coupling.astype(np.float32), matrix, (own * precision) @ common.T)
        self._blocks.append(block)
        return cells

    @property
    def count(self) -> int:
        """Number of frames."""
        return len(self._blocks)

    def gradient(self, deviation: Floats, classes: Floats, common: Floats) -> Unknowns:
        """Return g where the map deviates from the prior mean by (h, w), classes are at (C,), common at (V,)."""
        prior = self.prior
        pull = prior.precision * (deviation - classes[prior.classes])
        own = np.bincount(prior.classes.ravel(), pull.ravel(), prior.count) - prior.class_precision * classes
        return Unknowns(
            self._gradient.map - pull, np.array(self._frames),
            self._gradient.common - self.common_precision * common, own,
        )  # fmt: skip

    def __call__(self, x: Unknowns, shown: Floats | None = None) -> Unknowns:
        """Return H x; `shown` is `_shown` of x, where it is known."""
        prior = self.prior
        shown, own = self._shown(x) if shown is None else shown, self._seen(x.map)
        frames, common = own.frames, own.common + self._common_own @ x.common
        for number, block in enumerate(self._blocks):
            frames[number] += block.own @ x.frames[number] + block.common @ x.common
            common += x.frames[number] @ block.common
        classes = own.classes + self._class_own * x.classes
        return Unknowns(self.stencil(x.map) + prior.precision * x.map + shown, frames, common, classes)

    def _shown(self, x: Unknowns) -> Floats:
        """The part of H x on the map, (h, w), of all but the map."""
        # What float32 leaves of a parameter would act on all texels of its frame alike.
        upper = x.frames.astype(np.float32)
        both = np.stack([upper, (x.frames - upper).astype(np.float32)], axis=1)

        def of(part: slice) -> Floats:
            total = np.zeros(self.shape)
            for own, block in zip(both[part], self._blocks[part], strict=True):
                inside = total[block.window]
                inside += (own @ block.coupling).sum(axis=0, dtype=np.float64).reshape(inside.shape)
            return total

        prior, (one, other) = self.prior, self._in_parts(of)
        rest = np.tensordot(x.common, self._common_coupling, axes=1) - prior.precision * x.classes[prior.classes]
        return np.asarray(one + other + rest)

    def _seen(self, values: Floats) -> Unknowns:
        """The part of H x on all but the map of a map (h, w), which is left out."""
        prior = self.prior

        def of(part: slice) -> list[NDArray[np.float32]]:
            return [block.coupling @ values[block.window].ravel().astype(np.float32) for block in self._blocks[part]]

        one, other = self._in_parts(of)
        frames = np.array(one + other, np.float64).reshape(self.frames, len(self.frame_precision))
        classes = np.bincount(prior.classes.ravel(), -(prior.precision * values).ravel(), prior.count)
        common = np.tensordot(self._common_coupling, values, axes=2)
        return Unknowns(values[:0], frames, common, np.asarray(classes, np.float64))

    def _in_parts(self, function: Callable[[slice], _T]) -> list[_T]:
        """The results of a function of a slice of the frames, for both halves of them, in two threads."""
        middle = self.frames // 2
        return list(_THREADS.map(function, (slice(0, middle), slice(middle, None))))

    @property
    def _class_own(self) -> Floats:
        prior = self.prior
        own = np.bincount(prior.classes.ravel(), prior.precision.ravel(), prior.count)
        return np.asarray(prior.class_precision + own, np.float64)

    @cached_property
    def _preconditioned(self) -> Callable[[Unknowns], tuple[Unknowns, Floats]]:
        """The inverse of H with the links between texels added to the texels themselves, and `_shown` of its result.

        Bilinear weights link close neighbours only, so this changes fine structure alone, by a factor of up to 9. The
        large scales, which offsets and poses share with the map, are exact, and conjugate gradients need few steps.
        """
        from scipy.linalg import cho_factor, cho_solve

        diagonal = self.stencil(np.ones(self.shape)) + self.prior.precision
        factor, shape = cho_factor(self._without_map(diagonal), lower=True), (self.frames, len(self.frame_precision))

        def apply(r: Unknowns) -> tuple[Unknowns, Floats]:
            own = self._seen(r.map / diagonal)
            right = [(one - other).ravel() for one, other in zip(r[1:], own[1:], strict=True)]
            frames, common, classes = np.split(cho_solve(factor, np.concatenate(right)), self._ends)
            found = Unknowns(r.map, frames.reshape(shape), common, classes)
            shown = self._shown(found)
            return found._replace(map=(r.map - shown) / diagonal), shown

        return apply

    @property
    def _ends(self) -> list[int]:
        """Where the common parameters and the classes begin among all unknowns but the map."""
        first = self.frames * len(self.frame_precision)
        return [first, first + len(self.common_precision)]

    def _without_map(self, diagonal: Floats) -> Floats:
        """The equations of all but the map, (n, n), after elimination of a map whose texels have no links."""
        prior, (first, second) = self.prior, self._ends
        each, count = len(self.frame_precision), prior.count
        left = np.zeros((second + count, second + count))
        weak, number = 1.0 / np.sqrt(diagonal), prior.classes.ravel()
        pull = prior.precision * weak
        common = self._common_coupling * weak
        place = [slice(k * each, (k + 1) * each) for k in range(self.frames)]
        for k, block in enumerate(self._blocks):
            rows, columns = block.window
            scaled = block.coupling.reshape(each, rows.stop - rows.start, columns.stop - columns.start)
            scaled = scaled * weak[block.window].astype(np.float32)
            left[place[k], place[k]] = block.own
            left[place[k], first:second] = block.common
            left[place[k], first:second] -= np.tensordot(scaled, common[:, rows, columns], axes=((1, 2), (1, 2)))
            kind, drawn = prior.classes[block.window].ravel(), pull[block.window].ravel()
            left[place[k], second:] = [np.bincount(kind, drawn * row.ravel(), count) for row in scaled]
            for other in range(k + 1):
                both = _overlap(block.window, self._blocks[other].window)
                if both is None:
                    continue
                here, there = ((slice(r.start - w[0].start, r.stop - w[0].start),
                                slice(c.start - w[1].start, c.stop - w[1].start))
                               for w in (block.window, self._blocks[other].window) for r, c in (both,))  # fmt: skip
                second_one = self._blocks[other]
                h, w = (side.stop - side.start for side in second_one.window)
                beside = second_one.coupling.reshape(each, h, w)[:, there[0], there[1]] * weak[both].astype(np.float32)
                own = scaled[:, here[0], here[1]].reshape(each, -1) @ beside.reshape(each, -1).T
                left[place[k], place[other]] -= own
        left[first:second, first:second] = self._common_own - np.tensordot(common, common, axes=((1, 2), (1, 2)))
        for row, own in zip(left[first:second, second:], common, strict=True):
            row[:] = np.bincount(number, (pull * own).ravel(), count)
        left[second:, second:] = np.diag(self._class_own - np.bincount(number, (pull**2).ravel(), count))
        lower = np.tril(left[:first, :first], -1)
        left[:first, :first] += lower.T
        left[first:, :first] = left[:first, first:].T
        left[second:, first:second] = left[first:second, second:].T
        return left

    def solved(
        self, gradient: Unknowns, tolerance: float = 1e-4, most: int = 2000
    ) -> tuple[Unknowns, int]:  # fmt: skip
        """Return (x, steps) by preconditioned conjugate gradients, to a relative error of about `tolerance`.

        The error is that of fine structure which the frames hardly show. Offsets, which overlap the map's large scales,
        are exact to a thousandth of it.
        """
        precondition = self._preconditioned
        x, r = Unknowns(*map(np.zeros_like, gradient)), gradient
        p, shown = precondition(r)
        rz = _dot(r, p)
        limit, steps = tolerance**2 * rz, 0
        while rz > limit and steps < most:
            q = self(p, shown)
            alpha = rz / _dot(p, q)
            x, r = _sum(x, alpha, p), _sum(r, -alpha, q)
            z, more = precondition(r)
            rz, before = _dot(r, z), rz
            p, shown = _sum(z, rz / before, p), more + rz / before * shown
            steps += 1
        return x, steps


def _overlap(one: tuple[slice, slice], other: tuple[slice, slice]) -> tuple[slice, slice] | None:
    """The texels in both of two windows; None for none."""
    both = tuple(slice(max(a.start, b.start), min(a.stop, b.stop)) for a, b in zip(one, other, strict=True))
    return (both[0], both[1]) if all(side.start < side.stop for side in both) else None


def _dot(a: Unknowns, b: Unknowns) -> float:
    return float(sum(np.vdot(one, other) for one, other in zip(a, b, strict=True)))


def _sum(a: Unknowns, factor: float, b: Unknowns) -> Unknowns:
    return Unknowns(*(one + factor * other for one, other in zip(a, b, strict=True)))
