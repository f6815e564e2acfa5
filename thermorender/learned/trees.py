"""Boosted trees from a pixel's features to its temperature, stored as LightGBM's text.

With relief, hour and weather they predict kelvin above the air, else intensity. With weather they learn the residual of
a mixture of typical materials (`linear`), which does not grow with the sun as temperature does.

Evaluated here, to rounding as by LightGBM, they take a sixth of the time, without the dependency. The text is parsed as
data and never executed.
"""

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np

from thermorender import formats
from thermorender.learned.linear import Linear
from thermorender.learned.pixel_features import NAMES
from thermorender.learned.rows import ExtraInputs, at_shape, at_texel
from thermorender.learned.temperature_map import Inputs

# Rows that the linear base is computed for at a time. For more, BLAS starts threads that mostly wait for each other.
_CHUNK = 1 << 12
# Side of the blocks that trees are evaluated for: their planes fit a core's cache [pixels].
_BLOCK = 256
# Most leaves of a tree, which are numbered in bytes.
_MOST_LEAVES = 256
# LightGBM's bits of a split: it is by sets of classes; a missing value goes left; what counts as missing, and NaN.
_BY_CLASS, _LEFT, _MISSING, _NAN = 1, 2, 12, 8


@dataclass(frozen=True, eq=False)
class Trees:
    """Boosted trees over the columns of `rows.ExtraInputs.planes`."""

    text: str  # The model as LightGBM writes it
    extra: ExtraInputs  # Inputs besides the picture
    begin: Linear | None = None  # The linear base that the trees are added to, if air temperature is an input

    @property
    def needs(self) -> tuple[str, ...]:
        """Names of the required fields of Inputs."""
        return self.extra.needs

    @property
    def above_air(self) -> bool:
        """Whether it predicts kelvin above the air instead of intensity."""
        return self.extra.above_air

    def predict(self, inputs: Inputs, texel_m: float | None) -> np.ndarray:
        """Return intensity, or kelvin above the air, (h, w) float64."""
        image = at_texel(inputs, texel_m)
        found = np.empty(image.rgb.shape[:2])

        def evaluate(job: tuple[np.ndarray, list[np.ndarray]]) -> None:
            target, columns = job
            flat = [np.ascontiguousarray(column).ravel() if column.ndim else column for column in columns]
            target[:] = self.of_columns(flat).reshape(target.shape)

        with ThreadPoolExecutor() as pool:
            for here, columns in self.extra.planes(image):
                jobs = ((found[here][block], [column[block] if column.ndim else column for column in columns])
                        for block in _blocks(found[here].shape))  # fmt: skip
                for _ in pool.map(evaluate, jobs):
                    pass
        return at_shape(found, inputs.rgb.shape[:2])

    def of_columns(self, columns: Sequence[np.ndarray]) -> np.ndarray:
        """Return intensity, or kelvin above the air, (n,) float64, of columns of pixels, each (n,) or () float32."""
        found = self._forest.predict(columns)
        if self.begin is not None:
            for start in range(0, len(found), _CHUNK):
                here = slice(start, start + _CHUNK)
                values = (column[here] if column.ndim else column for column in columns)
                found[here] += self.begin.of_values(dict(zip(self.extra.columns, values, strict=True)))
        return found

    @cached_property
    def _forest(self) -> "_Forest":
        return _Forest.of(self.text, len(self.extra.columns))

    def header(self) -> dict[str, Any]:
        """Return its entries in the file's header."""
        begin = {} if self.begin is None else {"begin": self.begin.header()}
        return {
            "terrain": self.extra.terrain, "conditions": self.extra.conditions, "features": NAMES,
            "checksum": _checksum(self.arrays()["trees"]), **begin,
        }  # fmt: skip

    def arrays(self) -> dict[str, np.ndarray]:
        """Return its arrays in the file."""
        begin = {} if self.begin is None else self.begin.arrays()
        return {"trees": np.frombuffer(self.text.encode(), np.uint8), **begin}

    @classmethod
    def of(cls, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> "Trees":
        """Return the Trees of `header` and `arrays`; raise ValueError if the text or its columns were changed."""
        if header.get("checksum") != _checksum(arrays["trees"]):
            raise ValueError("its trees are damaged: their checksum differs")
        extra = ExtraInputs(tuple(header["terrain"]), tuple(header["conditions"]))
        begin = Linear.of(header["begin"], arrays) if extra.above_air else None
        if begin is not None and not set(begin.extra.columns) <= set(extra.columns):
            raise ValueError("its linear base has inputs that its trees lack")
        if tuple(header["features"]) != NAMES:
            raise ValueError("its features are not those of this version")
        found = cls(arrays["trees"].tobytes().decode(), extra, begin)
        _ = found._forest
        return found


@dataclass(frozen=True, eq=False)
class _Tree:
    """A tree: lists with an entry per split, and the values of its leaves, which children name by their complement."""

    columns: list[int]
    thresholds: list[np.float32]
    kinds: list[int]
    left: list[int]
    right: list[int]
    classes: list[np.ndarray]  # (n,) bool each: of splits by class, the classes that go left
    values: list[float]


class _Forest:
    """The trees of a text, evaluated for many pixels at once.

    Within a block of a picture most splits have one outcome and are skipped; the others are compared for all pixels.
    """

    def __init__(self, trees: list[_Tree]) -> None:
        self._trees = trees

    @classmethod
    def of(cls, text: str, columns: int) -> "_Forest":
        """Return the _Forest of a text on so many columns; ValueError for trees that `train` does not make."""
        head, *rest = text.split("\nTree=")
        lines = {*head.splitlines()}
        if not {"objective=regression_l1", "num_class=1"} <= lines or "average_output" in lines:
            raise ValueError("its trees are not those of a regression by absolute error")
        if f"max_feature_idx={columns - 1}" not in lines:
            raise ValueError("its trees have other columns than this version")
        return cls([_tree(part.split("\n\n")[0], columns) for part in rest])

    def predict(self, columns: Sequence[np.ndarray]) -> np.ndarray:
        """Return the sum of all trees, (n,) float64, of columns, each (n,) or () float32."""
        import cv2

        block = _Block(columns)
        total, same = np.zeros(max(column.size for column in columns)), 0.0
        for tree in self._trees:
            values: list[float] = []
            leaf = block.leaves(tree, 0 if tree.columns else ~0, values)
            if leaf.ndim == 0:
                same += values[0]
            else:
                table = np.zeros((1, _MOST_LEAVES))
                table[0, : len(values)] = values
                total += cv2.LUT(leaf, table).ravel()
        return total + same


class _Block:
    """Columns of pixels, with their ranges."""

    def __init__(self, columns: Sequence[np.ndarray]) -> None:
        self._columns = columns
        self._least = [column.min() for column in columns]
        self._most = [column.max() for column in columns]

    def leaves(self, tree: _Tree, node: int, values: list[float]) -> np.ndarray:
        """Return the number of each pixel's leaf under a node: (n,) uint8, or () for all alike; it indexes `values`."""
        while node >= 0:
            column, by_class = tree.columns[node], tree.kinds[node] & _BY_CLASS
            # NaN is in no range.
            if not by_class and self._most[column] <= tree.thresholds[node]:
                node = tree.left[node]
            elif not by_class and self._least[column] > tree.thresholds[node]:
                node = tree.right[node]
            else:
                break
        else:
            values.append(tree.values[~node])
            return np.asarray(len(values) - 1, np.uint8)
        below, above = (self.leaves(tree, side[node], values) for side in (tree.left, tree.right))
        # All bits where a pixel goes right: a bitwise and is faster than a product of bytes.
        to_right = self._to_right(tree, node).view(np.uint8)
        np.negative(to_right, out=to_right)
        # Leaves are numbered from left to right, so the greater number is that of a pixel that goes right.
        if below.ndim:
            return np.maximum(below, np.bitwise_and(to_right, above, out=to_right), out=to_right)
        # NumPy's maximum with a single number is slow.
        np.bitwise_and(to_right, above - below, out=to_right)
        return np.add(to_right, below, out=to_right)

    def _to_right(self, tree: _Tree, node: int) -> np.ndarray:
        """Whether each pixel goes right at a split, (n,) bool."""
        number, threshold, kind = tree.columns[node], tree.thresholds[node], tree.kinds[node]
        column = self._columns[number]
        if kind & _BY_CLASS:
            # Missing values and classes beyond those of the split go right.
            left = np.append(tree.classes[node], False)
            known = (column >= 0.0) & (column < len(left))
            return ~left[np.where(known, column, len(left) - 1).astype(np.intp)]
        if not np.isnan(self._least[number]):
            return np.greater(column, threshold)
        if kind & _MISSING != _NAN:
            # Without missing values in the training, LightGBM takes NaN as 0.
            return np.greater(np.where(np.isnan(column), np.float32(0.0), column), threshold)
        found = np.greater(column, threshold)
        return found if kind & _LEFT else found | np.isnan(column)


def _tree(text: str, columns: int) -> _Tree:
    """The _Tree of a text; ValueError where `train` makes no such tree."""
    entries = dict(line.split("=", 1) for line in text.splitlines() if "=" in line)

    def numbers(name: str) -> list[str]:
        return entries.get(name, "").split()

    split, kinds, left, right = (
        [*map(int, numbers(name))] for name in ("split_feature", "decision_type", "left_child", "right_child")
    )
    values, exact = [*map(float, numbers("leaf_value"))], np.array(numbers("threshold"), np.float64)
    if not len(split) == len(kinds) == len(exact) == len(left) == len(right) == len(values) - 1 < _MOST_LEAVES:
        raise ValueError("one of its trees is not whole")
    # Each split but the first, and each leaf, is a child of one split.
    if split and sorted(left + right) != [*range(-len(values), 0), *range(1, len(split))]:
        raise ValueError("one of its trees is not whole")
    if any(kind & _MISSING not in (0, _NAN) for kind in kinds) or entries.get("is_linear", "0") != "0":
        raise ValueError("one of its trees is of another kind than this version's")
    if not all(0 <= column < columns for column in split) or not np.isfinite(values).all():
        raise ValueError("one of its trees has another column, or a value that is not finite")
    # The greatest number in single precision that is not above a threshold divides single numbers as it does.
    single = exact.astype(np.float32)
    single = np.where(single > exact, np.nextafter(single, np.float32(-np.inf)), single)
    bounds, words = [*map(int, numbers("cat_boundaries"))], np.array(numbers("cat_threshold"), np.uint32)
    nothing, classes = np.zeros(0, bool), []
    for kind, threshold in zip(kinds, exact, strict=True):
        if kind & _BY_CLASS:
            # The threshold is the number of a set of bits.
            first, last = bounds[int(threshold)], bounds[int(threshold) + 1]
            classes.append(np.unpackbits(words[first:last].astype("<u4").view(np.uint8), bitorder="little") > 0)
        else:
            classes.append(nothing)
    return _Tree(split, list(single), kinds, left, right, classes, values)


def _blocks(shape: tuple[int, ...]) -> Iterator[tuple[slice, ...]]:
    """Slices of the blocks of a tile."""
    return (tuple(slice(start, start + _BLOCK) for start in corner)
            for corner in product(*(range(0, n, _BLOCK) for n in shape)))  # fmt: skip


def _checksum(text: np.ndarray) -> str:
    """Checksum of a model's text, (n,) uint8, as hexadecimal digits."""
    return formats.digest("trees", {"text": text})
