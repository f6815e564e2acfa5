"""The normal equations of all frames: a stencil of nine points on the map, blocks of each frame, and their solution.

The unknowns are changes: of the texels, of each frame's own parameters (its offset, and its pose where that is free),
of parameters common to all frames (the vignetting), and of the offsets of classes in the prior. A pixel of the matrix
is bilinear between four texels, so a texel is linked to its eight neighbours only. By symmetry five numbers hold these
links: 40 bytes a texel, however many frames there are. Residuals come from the exact forward model, with blur; the
matrix without blur then only sets the path to the solution, as in deferred correction.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from thermorender.inverse.weights import Sight

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

Floats = NDArray[np.float64]
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
    """A symmetric matrix that links each texel of a map (h, w) with itself and its eight neighbours.

    Attributes
    ----------
    link : (5, h, w) float64
        Of each texel with itself, and with those to the right, below, below right and below left.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
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

    def shared(self, other: "Block") -> tuple[slice, slice] | None:
        """Return the window that two frames share, or None."""
        rows, columns = (
            slice(max(a.start, b.start), min(a.stop, b.stop)) for a, b in zip(self.window, other.window, strict=True)
        )
        return (rows, columns) if rows.start < rows.stop and columns.start < columns.stop else None

    def on(self, window: tuple[slice, slice]) -> Floats:
        """Return the coupling (P, rows, columns) on a window within the frame's own."""
        rows, columns = (
            (each.start - own.start, each.stop - own.start) for each, own in zip(window, self.window, strict=True)
        )
        sides = (each.stop - each.start for each in self.window)
        return self.coupling.reshape(-1, *sides)[:, slice(*rows), slice(*columns)]


class Sums(NamedTuple):
    """What a frame adds to the normal equations: sums over its N pixels.

    `links`, `pull` and `shared` are on the texels of the frame's window: Aᵀ W A as of `links`, Aᵀ W r, and Aᵀ W times
    the columns of the common parameters. The other three belong to parameters: pulls (P,) and (V,), matrix (V, V).
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
        """Return the Sums of a frame.

        Parameters
        ----------
        seen : Footprint
            Of its N pixels.
        residual : (N,) array
            Measured minus predicted.
        precision : (N,) array
            1 over the variance of each pixel.
        own, common : (P, N) and (V, N) arrays
            Change of the prediction with the frame's parameters and with the common ones.
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

    def _spread(self, parameters: Floats) -> Floats:
        """B p: what parameters (K, n) add to the equations of the map, (K, h, w)."""
        prior = self.prior
        frames, common, classes = np.split(parameters, self._splits, axis=1)
        total = np.tensordot(common, self._common_coupling, axes=1)
        total -= prior.precision * classes.take(prior.classes, axis=1)
        for block, own in zip(self._blocks, np.split(frames, max(self.count, 1), axis=1), strict=False):
            inside = total[(slice(None), *block.window)]
            inside += (own @ block.coupling).reshape(inside.shape)
        return np.asarray(total)

    def _gathered(self, values: Floats) -> Floats:
        """Bᵀ m: what maps (K, h, w) add to the equations of the parameters, (K, n)."""
        prior, count = self.prior, len(values)
        frames = [values[(slice(None), *block.window)].reshape(count, -1) @ block.coupling.T for block in self._blocks]
        common = np.tensordot(values, self._common_coupling, axes=((1, 2), (1, 2)))
        pulls = (prior.precision * values).reshape(count, -1)
        classes = [-np.bincount(prior.classes.ravel(), pull, prior.count) for pull in pulls]
        return np.concatenate([*frames, common, classes], axis=1)

    @property
    def _splits(self) -> tuple[int, int]:
        """Where the parameters of frames end, and the common ones."""
        frames = sum(len(block.own) for block in self._blocks)
        return frames, frames + len(self._common_own)

    def _eliminated(self, inverse: Floats) -> Floats:
        """Bᵀ D⁻¹ B of the parameters, with the diagonal D⁻¹ (h, w)."""
        prior, blocks = self.prior, self._blocks
        classes = [np.where(prior.classes == each, -prior.precision, 0.0) for each in range(prior.count)]
        shared = np.concatenate([self._common_coupling, classes])
        ends = np.cumsum([0, *(len(block.own) for block in blocks), len(shared)])
        matrix = np.zeros((ends[-1], ends[-1]))
        for number, block in enumerate(blocks):
            own = slice(ends[number], ends[number + 1])
            scaled = block._replace(coupling=block.coupling * inverse[block.window].ravel())
            for other, start, end in zip(blocks[number:], ends[number:], ends[number + 1 :], strict=False):
                both = block.shared(other)
                if both is not None:
                    matrix[own, start:end] = _product(scaled.on(both), other.on(both))
            matrix[own, ends[-2] :] = _product(scaled.on(block.window), shared[(slice(None), *block.window)])
        matrix[ends[-2] :, ends[-2] :] = _product(shared * inverse, shared)
        return np.triu(matrix) + np.triu(matrix, 1).T

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

    def _nearly_inverse(self, maps: Floats) -> Floats:
        """The inverse, for maps (K, h, w), of the equations without parameters and with lumped links.

        All links are positive, so the lumped matrix exceeds the linked one in the sense of quadratic forms, and what is
        left of the parameters' matrix stays positive. For smooth maps both are the same, and smooth maps are what
        offsets, poses and lens are hard to tell from.
        """
        from scipy.linalg import cho_solve

        inverse, factor = self._lumped_factors
        first = inverse * maps
        return first + inverse * self._spread(cho_solve(factor, self._gathered(first).T).T)

    def solved(
        self, *gradients: Unknowns, tolerance: float = 1e-4, most: int = 2000
    ) -> tuple[list[Unknowns], int]:  # fmt: skip
        """Return (x of each gradient, steps) by preconditioned conjugate gradients, to a relative residual `tolerance`.

        The parameters are eliminated: steps are made in the map alone. The preconditioner differs from the matrix only
        in the links between texels, so the product with z = M⁻¹ r is r plus that difference times z. What converges
        last is fine structure where pixels are few; offsets and poses are exact long before.
        """
        from scipy.linalg import cho_factor, cho_solve

        own = cho_factor(self._own, lower=True)
        pulls = np.array([each.parameters for each in gradients])
        r = np.array([each.map for each in gradients]) - self._spread(cho_solve(own, pulls.T).T)
        x, p, product = (np.zeros_like(r) for _ in range(3))
        before, steps = np.full(len(r), np.inf), 0
        while steps <= most:
            z = self._nearly_inverse(r)
            rz = _dots(r, z)
            if steps == 0:
                limit = tolerance**2 * rz
            if (rz <= limit).all():
                break
            # A solution that is done goes on with the others, without harm.
            ratio = _each(rz / np.maximum(before, 1e-300))
            p = z + ratio * p
            product = r + self.stencil(z) - self._lumped * z + ratio * product
            step = _each(rz / np.maximum(_dots(p, product), 1e-300))
            x += step * p
            r -= step * product
            before, steps = rz, steps + 1
        parameters = cho_solve(own, (pulls - self._gathered(x)).T).T
        return [each.like(*found) for each, *found in zip(gradients, x, parameters, strict=True)], steps


def _each(values: Floats) -> Floats:
    return values[:, None, None]


def _dots(a: Floats, b: Floats) -> Floats:
    """Scalar products of maps (K, h, w)."""
    return np.einsum("khw,khw->k", a, b)


def _product(a: Floats, b: Floats) -> Floats:
    """Sums (n, m) over the texels of the products of maps a (n, h, w) and b (m, h, w)."""
    return a.reshape(len(a), -1) @ b.reshape(len(b), -1).T
