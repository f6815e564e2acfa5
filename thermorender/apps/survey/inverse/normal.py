"""The normal equations of all frames: a stencil of nine points on the map, blocks of each frame, and their solution.

The unknowns are changes of the texels, of each frame's offset and free pose, of the vignetting, and of the offsets of
classes in the prior. A pixel of the matrix is bilinear between four texels, so a texel has eight neighbours: by
symmetry five numbers, 40 bytes a texel. Residuals come from the exact forward model with blur; the matrix without blur
only sets the path to the solution, as in deferred correction.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.survey.inverse.weights import Sight

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

Floats = NDArray[np.float64]
# Maps a function over items, as `map` and `Executor.map` do.
Each = Callable[..., Iterator[Any]]
# Side of a tile in which the frames' couplings are multiplied [texels].
_TILE = 64
# Entries of the stencil: the texel itself, and its neighbours to the right, below, below right and below left.
_SELF, _RIGHT, _BELOW, _BELOW_RIGHT, _BELOW_LEFT = range(5)


class Footprint(NamedTuple):
    """The weights (N, texels) of the pixels of a frame in a window of the map, whose first texel is (top, left)."""

    top: int
    left: int
    shape: tuple[int, int]
    weights: "csr_matrix"

    @property
    def window(self) -> tuple[slice, slice]:
        """The texels of the window on the map."""
        rows, columns = self.shape
        return slice(self.top, self.top + rows), slice(self.left, self.left + columns)

    def gathered(self, values: Floats) -> Floats:
        """Return the sums over pixels of their weights times `values` (n, N), on the window's texels (n, …)."""
        return np.asarray((self.weights.T @ values.T).T).reshape(len(values), *self.shape)


def footprint(sight: Sight) -> Footprint:
    """Return the Footprint of a frame's pixels, by bilinear weights."""
    from scipy.sparse import csr_matrix

    row, column = np.floor(sight.row).astype(np.int32), np.floor(sight.column).astype(np.int32)
    (top, rows), (left, columns) = (
        (int(values.min()), int(np.ptp(values)) + 2) if values.size else (0, 2) for values in (row, column)
    )
    down, right = sight.row - row, sight.column - column
    weight = np.stack([(1 - down) * (1 - right), (1 - down) * right, down * (1 - right), down * right], axis=1)
    first = (row - top) * np.int32(columns) + (column - left)
    texel = first[:, None] + np.array([0, 1, columns, columns + 1], np.int32)
    ends = np.arange(0, 4 * len(row) + 1, 4, dtype=np.int32)
    weights = csr_matrix((weight.ravel(), texel.ravel(), ends), shape=(len(row), rows * columns))
    return Footprint(top, left, (rows, columns), weights)


def links(seen: Footprint, precision: Floats) -> Floats:
    """Return Aᵀ W A of the pixels of a frame on its window, (5, …) as in a Stencil, with the diagonal (N,) of W."""
    scaled = seen.weights.copy()
    scaled.data *= np.repeat(precision, 4)
    product, columns = seen.weights.T @ scaled, seen.shape[1]
    found = np.zeros((5, seen.shape[0] * columns))
    for entry, away in (
        (_SELF, 0), (_RIGHT, 1), (_BELOW, columns), (_BELOW_RIGHT, columns + 1), (_BELOW_LEFT, columns - 1),
    ):  # fmt: skip
        line = product.diagonal(away)
        found[entry, : line.size] = line
    return found.reshape(5, *seen.shape)


class Stencil:
    """A symmetric matrix that links each texel of a map (h, w) with itself and its eight neighbours."""

    def __init__(self, shape: tuple[int, int]) -> None:
        # Links of each texel with itself, and with those to the right, below, below right and below left.
        self.link = np.zeros((5, *shape))

    def __call__(self, x: Floats) -> Floats:
        """Return the product with x, (…, h, w)."""
        link = self.link
        y = link[_SELF] * x
        for entry, here, there in (
            (_RIGHT, np.s_[..., :, :-1], np.s_[..., :, 1:]), (_BELOW, np.s_[..., :-1, :], np.s_[..., 1:, :]),
            (_BELOW_RIGHT, np.s_[..., :-1, :-1], np.s_[..., 1:, 1:]),
            (_BELOW_LEFT, np.s_[..., :-1, 1:], np.s_[..., 1:, :-1]),
        ):  # fmt: skip
            between = link[entry][here]
            y[here] += between * x[there]
            y[there] += between * x[here]
        return y


@dataclass(frozen=True, eq=False)
class Prior:
    """What is known of the map without the frames."""

    mean: Floats  # (h, w) float64
    precision: Floats  # (h, w) float64 1 over the variance of each texel about its class
    classes: NDArray[np.intp]  # (h, w) integers class of each texel, 0…C−1
    class_precision: float  # 1 over the variance of the common offset of a class

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

    @property
    def parameters(self) -> Floats:
        """All but the map, in one line."""
        return np.concatenate([self.frames.ravel(), self.common, self.classes])

    def like(self, values: Floats, parameters: Floats) -> "Unknowns":
        """Return the Unknowns of a map and a line of parameters, with the shapes of these."""
        frames, common, classes = np.split(parameters, np.cumsum([self.frames.size, self.common.size]))
        return Unknowns(values, frames.reshape(self.frames.shape), common, classes)


class Block(NamedTuple):
    """A frame's part of the equations."""

    window: tuple[slice, slice]
    coupling: Floats  # (P, texels of the window)
    own: Floats  # (P, P)
    common: Floats  # (P, V)

    def on(self, tile: tuple[slice, slice]) -> Floats:
        """Return the coupling on a tile of the map, (P, rows, columns); no lines if the frame does not show it."""
        here, there = list[slice](), list[slice]()
        for own, other in zip(self.window, tile, strict=True):
            start, stop = max(own.start, other.start), min(own.stop, other.stop)
            here.append(slice(start - own.start, stop - own.start))
            there.append(slice(start - other.start, stop - other.start))
        sides, own_sides = ([each.stop - each.start for each in window] for window in (tile, self.window))
        if any(part.start >= part.stop for part in here):
            return np.zeros((0, *sides))
        lines = np.zeros((len(self.coupling), *sides))
        lines[:, there[0], there[1]] = self.coupling.reshape(-1, *own_sides)[:, here[0], here[1]]
        return lines


class Sums(NamedTuple):
    """Sums over a frame's N pixels for the normal equations.

    `links`, `pull` and `shared` are on the texels of its window: Aᵀ W A, Aᵀ W r, and Aᵀ W times the columns of the
    common parameters. The others belong to parameters: pulls (P,) and (V,), matrix (V, V).
    """

    block: Block
    links: Floats
    pull: Floats
    shared: Floats
    own_pull: Floats
    common_pull: Floats
    common_own: Floats

    @classmethod
    def of(cls, seen: Footprint, residual: Floats, precision: Floats, own: Floats, common: Floats) -> "Sums":
        """Return the Sums of a frame of N pixels.

        Inputs are residuals (measured minus predicted), precisions (1 / variance), and changes of the prediction with
        the frame's parameters (P, N) and the common ones (V, N).
        """
        count = len(own)
        columns = np.concatenate([own, common])
        weighted = precision * columns
        pulled = precision * residual
        pull, *parts = seen.gathered(np.concatenate([[pulled], weighted]))
        matrix, pulls = weighted @ columns.T, columns @ pulled
        coupling = np.array(parts[:count]).reshape(count, -1)
        block = Block(seen.window, coupling, matrix[:count, :count], matrix[:count, count:])
        shared = np.array(parts[count:]).reshape(-1, *seen.shape)
        return cls(block, links(seen, precision), pull, shared, pulls[:count], pulls[count:], matrix[count:, count:])

    @property
    def of_offset(self) -> "Sums":
        """The Sums with the first of the frame's parameters only."""
        window, coupling, own, _ = self.block
        block = Block(window, coupling[:1], own[:1, :1], np.zeros((1, 0)))
        return Sums(block, self.links, self.pull, self.shared[:0], self.own_pull[:1], np.zeros(0), np.zeros((0, 0)))


class Normal:
    """The normal equations H x = g of a least-squares problem with a prior.

    Precisions (P,) and (V,) are 1 over the prior variances of a frame's parameters and the common ones.
    """

    def __init__(self, prior: Prior, frame_precision: Floats, common_precision: Floats) -> None:
        self.prior, self.shape = prior, prior.mean.shape
        self.frame_precision, self.common_precision = frame_precision, common_precision
        self.stencil = Stencil(self.shape)
        self._blocks: list[Block] = []
        count = len(common_precision)
        self._common_coupling = np.zeros((count, *self.shape))
        self._common_own = np.diag(common_precision).astype(np.float64)
        self._gradient = Unknowns(np.zeros(self.shape), np.zeros((0, 0)), np.zeros(count), np.zeros(prior.count))
        self._frames: list[Floats] = []

    def add(self, sums: Sums, deviation: Floats) -> None:
        """Add a frame, of which the parameters deviate by (P,) from their prior means."""
        block = sums.block
        inside = (slice(None), *block.window)
        self.stencil.link[inside] += sums.links
        self._common_coupling[inside] += sums.shared
        self._common_own += sums.common_own
        self._gradient.map[block.window] += sums.pull
        self._gradient.common[:] += sums.common_pull
        self._frames.append(sums.own_pull - self.frame_precision * deviation)
        self._blocks.append(block._replace(own=block.own + np.diag(self.frame_precision)))

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

    @cached_property
    def _own(self) -> Floats:
        """The equations of the parameters among themselves: of frames, of what is common, and of classes."""
        prior, blocks = self.prior, self._blocks
        ends = np.cumsum([0, *(len(block.own) for block in blocks), len(self._common_own), prior.count])
        matrix = np.zeros((ends[-1], ends[-1]))
        shared = slice(ends[-3], ends[-2])
        for block, start, end in zip(blocks, ends, ends[1:], strict=False):
            matrix[start:end, start:end] = block.own
            matrix[start:end, shared], matrix[shared, start:end] = block.common, block.common.T
        matrix[shared, shared] = self._common_own
        classes = np.bincount(prior.classes.ravel(), prior.precision.ravel(), prior.count)
        matrix[ends[-2] :, ends[-2] :] = np.diag(prior.class_precision + classes)
        return matrix

    def _spread(self, parameters: Floats, each: Each = map) -> Floats:
        """B p: what parameters (n,) add to the equations of the map, (h, w)."""
        prior = self.prior
        frames, common, classes = np.split(parameters, self._splits)

        def part(chosen: slice) -> Floats:
            total = np.zeros(self.shape)
            for block, own in zip(self._blocks[chosen], frames.reshape(max(self.count, 1), -1)[chosen], strict=False):
                window = total[block.window]
                window += np.einsum("p,pn->n", own, block.coupling).reshape(window.shape)
            return total

        first, second = each(part, self._halves)
        first += second
        first += np.tensordot(common, self._common_coupling, axes=1) - prior.precision * classes.take(prior.classes)
        return np.asarray(first)

    def _gathered(self, values: Floats, each: Each = map) -> Floats:
        """Bᵀ m: what a map (h, w) adds to the equations of the parameters, (n,)."""
        prior = self.prior

        def part(chosen: slice) -> list[Floats]:
            return [np.einsum("pn,n->p", b.coupling, values[b.window].ravel()) for b in self._blocks[chosen]]

        frames = chain.from_iterable(each(part, self._halves))
        common = np.tensordot(self._common_coupling, values, axes=2)
        classes = -np.bincount(prior.classes.ravel(), (prior.precision * values).ravel(), prior.count)
        return np.concatenate([*frames, common, classes])

    @property
    def _halves(self) -> tuple[slice, slice]:
        """Two halves of the frames. Sums are added in this order for any number of threads."""
        middle = self.count // 2
        return slice(0, middle), slice(middle, self.count)

    @property
    def _splits(self) -> tuple[int, int]:
        """Where the parameters of frames end, and the common ones."""
        frames = sum(len(block.own) for block in self._blocks)
        return frames, frames + len(self._common_own)

    def _eliminated(self, inverse: Floats) -> Floats:
        """Bᵀ D⁻¹ B of the parameters, with the diagonal D⁻¹ (h, w)."""
        prior = self.prior
        ends = np.cumsum([0, *(len(block.own) for block in self._blocks), len(self._common_own), prior.count])
        matrix = np.zeros((ends[-1], ends[-1]))
        numbers = np.split(np.arange(ends[-1]), ends[1:-1])
        for tile in _tiles(self.shape):
            # Few frames show a tile: one product has all of their pairs.
            parts = [block.on(tile) for block in self._blocks]
            parts.append(self._common_coupling[(slice(None), *tile)])
            classes = np.arange(prior.count)[:, None, None] == prior.classes[tile]
            parts.append(np.where(classes, -prior.precision[tile], 0.0))
            lines = np.concatenate([part.reshape(len(part), classes[0].size) for part in parts])
            at = np.concatenate([number for number, part in zip(numbers, parts, strict=True) if len(part)])
            matrix[np.ix_(at, at)] += (lines * inverse[tile].ravel()) @ lines.T
        return matrix

    @cached_property
    def _lumped(self) -> Floats:
        """Sums of a texel's links, (h, w)."""
        return self.stencil(np.ones(self.shape))

    @cached_property
    def _lumped_factors(self) -> tuple[Floats, tuple[Floats, bool]]:
        """(inverse of the map's equations with lumped links, (h, w); factor of what is left of the parameters')."""
        from scipy.linalg import cho_factor

        inverse = 1.0 / (self._lumped + self.prior.precision)
        return inverse, cho_factor(self._own - self._eliminated(inverse), lower=True)

    def _nearly_inverse(self, values: Floats, each: Each) -> Floats:
        """Return the inverse, for a map (h, w), of the equations without parameters and with lumped links.

        The lumped matrix exceeds the linked one as a quadratic form, so the parameters' matrix stays positive. They
        agree for smooth maps, which offsets, poses and lens are hard to separate from.
        """
        from scipy.linalg import cho_solve

        inverse, factor = self._lumped_factors
        first = inverse * values
        return first + inverse * self._spread(cho_solve(factor, self._gathered(first, each)), each)

    def solved(
        self, gradient: Unknowns, tolerance: float = 1e-4, most: int = 2000, each: Each = map
    ) -> tuple[Unknowns, int]:  # fmt: skip
        """Return (x, steps) by preconditioned conjugate gradients, to a relative residual `tolerance`.

        Parameters are eliminated, so steps are made in the map alone. The preconditioner differs from the matrix only
        in the links between texels, so the product with z = M⁻¹ r is r plus that difference times z. `each` maps a
        function over the halves of the frames, such as `Executor.map`, and does not change the result.
        """
        from scipy.linalg import cho_factor, cho_solve

        own, pulls = cho_factor(self._own, lower=True), gradient.parameters
        r = gradient.map - self._spread(cho_solve(own, pulls), each)
        x, p, product = (np.zeros_like(r) for _ in range(3))
        before, limit, steps = np.inf, 0.0, 0
        while steps <= most:
            z = self._nearly_inverse(r, each)
            rz = float(np.vdot(r, z))
            if steps == 0:
                limit = tolerance**2 * rz
            if rz <= limit:
                break
            ratio = rz / before
            p = z + ratio * p
            product = r + self.stencil(z) - self._lumped * z + ratio * product
            step = rz / max(float(np.vdot(p, product)), 1e-300)
            x += step * p
            r -= step * product
            before, steps = rz, steps + 1
        return gradient.like(x, cho_solve(own, pulls - self._gathered(x, each))), steps


def _tiles(shape: tuple[int, int]) -> Iterator[tuple[slice, slice]]:
    """Yield squares that cover a map."""
    for top in range(0, shape[0], _TILE):
        for left in range(0, shape[1], _TILE):
            yield slice(top, min(top + _TILE, shape[0])), slice(left, min(left + _TILE, shape[1]))
