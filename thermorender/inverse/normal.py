"""The normal equations of all frames: a stencil of nine points on the map, blocks of each frame, and their solution.

The unknowns are changes: of the texels, of each frame's own parameters (its offset, and its pose where that is free),
of parameters common to all frames (the vignetting), and of the offsets of classes in the prior. A pixel of the matrix
is bilinear between four texels, so a texel is linked to its eight neighbours only. By symmetry five numbers hold these
links: 40 bytes a texel, however many frames there are. Residuals come from the exact forward model, with blur; the
matrix without blur then only sets the path to the solution, as in deferred correction.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thermorender.inverse.weights import Sight

Floats = NDArray[np.float64]
# Corners of a cell, (row, column), in the order of the weights.
_CORNERS = ((0, 0), (0, 1), (1, 0), (1, 1))
# The links between the corners of a cell: index in the stencil, of corners a and b, and the texel that holds the link.
# The stencil's entries are: the texel itself, its neighbour to the right, below, below right, and below left.
_LINKS = (
    (0, 0, 0, (0, 0)), (0, 1, 1, (0, 1)), (0, 2, 2, (1, 0)), (0, 3, 3, (1, 1)),
    (1, 0, 1, (0, 0)), (1, 2, 3, (1, 0)), (2, 0, 2, (0, 0)), (2, 1, 3, (0, 1)),
    (3, 0, 3, (0, 0)), (4, 1, 2, (0, 1)),
)  # fmt: skip
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

    def __call__(self, x: Unknowns) -> Unknowns:
        """Return H x."""
        prior = self.prior
        free = prior.precision * (x.map - x.classes[prior.classes])
        total = self.stencil(x.map) + free
        classes = prior.class_precision * x.classes - np.bincount(prior.classes.ravel(), free.ravel(), prior.count)
        total += np.tensordot(x.common, self._common_coupling, axes=1)
        common = self._common_own @ x.common + np.tensordot(self._common_coupling, x.map, axes=2)
        frames = np.empty_like(x.frames)
        for number, block in enumerate(self._blocks):
            own = x.frames[number]
            inside = x.map[block.window]
            total[block.window] += (own.astype(np.float32) @ block.coupling).reshape(inside.shape)
            frames[number] = (
                block.coupling @ inside.ravel().astype(np.float32) + block.own @ own + block.common @ x.common
            )
            common += own @ block.common
        return Unknowns(total, frames, common, classes)

    def _preconditioned(self) -> Callable[[Unknowns], Unknowns]:
        prior = self.prior
        diagonal = self.stencil.link[_SELF] + prior.precision
        own = [np.linalg.inv(block.own) for block in self._blocks]
        common = np.linalg.inv(self._common_own) if len(self._common_own) else self._common_own
        classes = prior.class_precision + np.bincount(prior.classes.ravel(), prior.precision.ravel(), prior.count)
        inverse = np.array(own)

        def apply(r: Unknowns) -> Unknowns:
            frames = np.einsum("fpq,fq->fp", inverse, r.frames)
            return Unknowns(r.map / diagonal, frames, common @ r.common, r.classes / classes)

        return apply

    def solved(
        self, gradient: Unknowns, tolerance: float = 1e-6, most: int = 2000
    ) -> tuple[Unknowns, int]:  # fmt: skip
        """Return (x, steps) by preconditioned conjugate gradients, to a relative residual below `tolerance`.

        A larger tolerance than 1e-6, or too few steps, leaves errors in the offsets, which overlap the map's large
        scales.
        """
        precondition = self._preconditioned()
        x = Unknowns(*map(np.zeros_like, gradient))
        r = gradient
        z = precondition(r)
        p, rz = z, _dot(r, z)
        limit = tolerance**2 * rz
        steps = 0
        while rz > limit and steps < most:
            q = self(p)
            alpha = rz / _dot(p, q)
            x, r = _sum(x, alpha, p), _sum(r, -alpha, q)
            z = precondition(r)
            rz, before = _dot(r, z), rz
            p = _sum(z, rz / before, p)
            steps += 1
        return x, steps


def _dot(a: Unknowns, b: Unknowns) -> float:
    return float(sum(np.vdot(one, other) for one, other in zip(a, b, strict=True)))


def _sum(a: Unknowns, factor: float, b: Unknowns) -> Unknowns:
    return Unknowns(*(one + factor * other for one, other in zip(a, b, strict=True)))
