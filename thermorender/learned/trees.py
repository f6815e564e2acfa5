"""Boosted trees from a pixel's features to its temperature, by LightGBM and stored as its text.

With relief, hour and weather as inputs they predict kelvin above the air, else intensity. A leaf predicts one number
for all weather that reaches it. So with weather the trees learn the residual of a mixture of typical materials
(`linear`), which varies less and does not grow with the sun. Ke et al. 2017, "LightGBM: a highly efficient gradient
boosting decision tree".

A checksum in the file shows accidental damage only. A crafted text can crash LightGBM: load trees only from people you
trust.
"""

from collections import deque
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np

from thermorender import formats
from thermorender.errors import ThermorenderError
from thermorender.learned.features import NAMES
from thermorender.learned.linear import Linear, Sums
from thermorender.learned.rows import CLASSES, ExtraInputs, at_shape, at_texel, drawn
from thermorender.learned.temperature_map import Inputs
from thermorender.learned.training import Task

# Most rows of an example, and most numbers in the whole table: 1 GB in single precision.
_MOST_ROWS = 1000
_MOST_NUMBERS = 250_000_000
# Pictures in the queue for their features, which bounds memory.
_AT_ONCE = 4
# Neighbours in a data set are frames of one flight. So without a given split, examples are cut into runs, and every
# eighth run is held out for early stopping. With fewer than eight runs there is no early stopping.
_RUNS = 40
_HELD_OUT_ONE_IN = 8
# 100 trees fewer cost 1 % of error.
_MOST_TREES = 250
_PATIENCE = 20
_SETTINGS = {
    # Maps are scored by mean absolute error; training on squared error gave 2 % more of it on held-out road scenes.
    "objective": "l1",
    "num_leaves": 63,
    "max_depth": 8,
    "learning_rate": 0.1,
    "min_data_in_leaf": 100,
    "feature_fraction": 0.5,
    "deterministic": True,
    "force_row_wise": True,
    "verbosity": -1,
}
# Ridge penalty of the linear base, as in `linear.Sums.solved`.
_PENALTY = 1e-2
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
    """Boosted trees over the columns of `rows.ExtraInputs.tiles`."""

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

    def predict(self, inputs: Inputs, texel_m: float) -> np.ndarray:
        """Return intensity, or kelvin above the air, (h, w) float64."""
        image = at_texel(inputs, texel_m)
        found = np.empty(image.rgb.shape[:2])

        def evaluate(job):
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
        """Return intensity, or kelvin above the air, (n,) float64, of pixels.

        Each of the columns is (n,) float32, or one number for all pixels.
        """
        if self._forest is not None:
            found = self._forest.predict(columns)
        else:
            found = self._booster.predict(np.stack(np.broadcast_arrays(*columns), axis=1))
        if self.begin is not None:
            for start in range(0, len(found), _CHUNK):
                here = slice(start, start + _CHUNK)
                values = (column[here] if column.ndim else column for column in columns)
                found[here] += self.begin.of_values(dict(zip(self.extra.columns, values, strict=True)))
        return found

    def importances(self) -> dict[str, float]:
        """Return {column: its share of the reduction of training error by all splits}, the greatest first."""
        gain = self._booster.feature_importance("gain")
        order = np.argsort(-gain, kind="stable")
        return {self.extra.columns[number]: float(gain[number] / max(gain.sum(), 1e-300)) for number in order}

    @cached_property
    def _booster(self):
        lightgbm = _lightgbm()
        try:
            return lightgbm.Booster(model_str=self.text)
        except lightgbm.basic.LightGBMError as error:
            raise ValueError("LightGBM cannot read its trees") from error

    @cached_property
    def _forest(self):
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
        found = cls(arrays["trees"].tobytes().decode(), extra, begin)
        if tuple(header["features"]) != NAMES or found._booster.num_feature() != len(found.extra.columns):
            raise ValueError("its features are not those of this version")
        return found


class _Forest:
    """The trees of a text, evaluated for many pixels at once; the result is LightGBM's.

    Over a block of a picture, hour and weather are constant and other columns vary little. So most splits have one
    outcome for the whole block and are skipped. The others are compared for all pixels at once.
    """

    def __init__(self, trees):
        self._trees = trees

    @classmethod
    def of(cls, text, columns):
        """Return the _Forest of a text on so many columns, or None for trees of a kind that it cannot evaluate."""
        head, *rest = text.split("\nTree=")
        lines = head.splitlines()
        if not {"objective=regression_l1", "num_class=1"} <= {*lines} or "average_output" in lines:
            return None
        trees = [_tree(part.split("\n\n")[0], columns) for part in rest]
        return None if None in trees else cls(trees)

    def predict(self, columns):
        """Return the sum of all trees, (n,) float64, of columns, each (n,) float32 or one number."""
        import cv2

        block = _Block(columns)
        total, same = np.zeros(max(column.size for column in columns)), 0.0
        for tree in self._trees:
            values = []
            leaf = block.leaves(tree, 0 if tree[0] else ~0, values)
            if leaf.ndim == 0:
                same += values[0]
            else:
                table = np.zeros((1, _MOST_LEAVES))
                table[0, : len(values)] = values
                total += cv2.LUT(leaf, table).ravel()
        return total + same


class _Block:
    """Columns of pixels, with their ranges."""

    def __init__(self, columns):
        self._columns = columns
        self._least = [column.min() for column in columns]
        self._most = [column.max() for column in columns]

    def leaves(self, tree, node, values):
        """Return the number of each pixel's leaf under a node: (n,) uint8, or one number if it is the same for all.

        The values of leaves are appended to `values`; a leaf's number is its place there.
        """
        columns, thresholds, kinds, left, right, leaf_values = tree
        while node >= 0:
            # NaN is in no range.
            if self._most[columns[node]] <= thresholds[node]:
                node = left[node]
            elif self._least[columns[node]] > thresholds[node]:
                node = right[node]
            else:
                break
        else:
            values.append(leaf_values[~node])
            return np.uint8(len(values) - 1)
        below, above = (self.leaves(tree, side[node], values) for side in (left, right))
        # All bits where a pixel goes right: a bitwise and is faster than a product of bytes.
        to_right = self._to_right(columns[node], thresholds[node], kinds[node]).view(np.uint8)
        np.negative(to_right, out=to_right)
        # Leaves are numbered from left to right, so the greater number is that of a pixel that goes right.
        if below.ndim:
            return np.maximum(below, np.bitwise_and(to_right, above, out=to_right), out=to_right)
        # NumPy's maximum with a single number is slow.
        np.bitwise_and(to_right, above - below, out=to_right)
        return np.add(to_right, below, out=to_right)

    def _to_right(self, number, threshold, kind):
        """Whether each pixel goes right at a split, (n,) bool."""
        column = self._columns[number]
        if not np.isnan(self._least[number]):
            return np.greater(column, threshold)
        if kind & _MISSING != _NAN:
            # Without missing values in the training, LightGBM takes NaN as 0.
            return np.greater(np.where(np.isnan(column), np.float32(0.0), column), threshold)
        found = np.greater(column, threshold)
        return found if kind & _LEFT else found | np.isnan(column)


def _tree(text, columns):
    """(columns, thresholds, kinds, left, right, leaf values) of a tree's text, lists; None if it is of another kind."""
    entries = dict(line.split("=", 1) for line in text.splitlines() if "=" in line)

    def numbers(name, kind):
        return [kind(each) for each in entries.get(name, "").split()]

    split, kinds = numbers("split_feature", int), numbers("decision_type", int)
    left, right = numbers("left_child", int), numbers("right_child", int)
    values, exact = numbers("leaf_value", float), np.array(numbers("threshold", float))
    whole = sorted(left + right) == [*range(-len(values), 0), *range(1, len(split))]
    plain = not any(kind & _BY_CLASS or kind & _MISSING not in (0, _NAN) for kind in kinds)
    if not (whole or not split) or not plain or len(values) > _MOST_LEAVES or entries.get("is_linear", "0") != "0":
        return None
    if not len(split) == len(kinds) == len(exact) == len(left) == len(values) - 1 or max(split, default=0) >= columns:
        return None
    # The greatest number in single precision that is not above a threshold divides single numbers as it does.
    single = exact.astype(np.float32)
    single = np.where(single > exact, np.nextafter(single, np.float32(-np.inf)), single)
    return split, list(single), kinds, left, right, values


def _blocks(shape):
    """Slices of the blocks of a tile."""
    return (tuple(slice(start, start + _BLOCK) for start in corner)
            for corner in product(*(range(0, n, _BLOCK) for n in shape)))  # fmt: skip


def fit_trees(task: Task) -> Trees:
    """Return the Trees trained on a Task.

    The same number of pixels is drawn from each example and the absolute error is minimised. Trees are added until the
    error of the held-out runs stops falling. If air temperature is an input, they are added to a Linear.
    """
    lightgbm = _lightgbm()
    extra = ExtraInputs.of(task.examples[0].inputs)
    learned, watched = _learned_and_watched(task, extra)
    begin = None
    if extra.above_air:
        sums = Sums(extra)
        for here, values in _by_column(extra, learned[0]):
            sums.add(values, learned[1][here])
        begin = sums.solved(_PENALTY)
        for rows, target in (learned, watched):
            for here, values in _by_column(extra, rows):
                target[here] -= begin.of_values(values)
    classes = [extra.columns.index(CLASSES)] if CLASSES in extra.terrain else []
    train, held = (lightgbm.Dataset(*part, categorical_feature=classes) for part in (learned, watched))
    callbacks = [lambda now: task.progress("growing trees", (now.iteration + 1) / _MOST_TREES)]
    if len(watched[0]):
        callbacks.append(lightgbm.early_stopping(_PATIENCE, verbose=False))
    grown = lightgbm.train(
        _SETTINGS | {"seed": task.seed % 2**31}, train, _MOST_TREES, callbacks=callbacks,
        valid_sets=[held.set_reference(train)] if len(watched[0]) else [],
    )  # fmt: skip
    return Trees(grown.model_to_string(num_iteration=grown.best_iteration), extra, begin)


def _learned_and_watched(task, extra):
    """((rows, target) to learn from, (rows, target) for early stopping) of a Task; the second may be empty."""
    most = min(_MOST_ROWS, max(_MOST_NUMBERS // len(extra.columns) // len(task.examples), 1))
    held = held_out(len(task.examples)) if task.held_out is None else task.held_out
    rows = [np.empty((np.count_nonzero(held == part) * most, len(extra.columns)), np.float32) for part in (0, 1)]
    target, used = [np.empty(len(table)) for table in rows], [0, 0]

    def keep(each, table):
        part = int(held[each.number])
        here = slice(used[part], used[part] + each.pixels.size)
        rows[part][here], target[part][here] = table.result(), each.target
        used[part] = here.stop

    # Threads compute features while the next pictures are read; the order of examples is kept.
    waiting = deque()
    with ThreadPoolExecutor() as pool:
        for each in drawn(task, extra, most):
            waiting.append((each, pool.submit(_table, extra, each)))
            if len(waiting) > _AT_ONCE:
                keep(*waiting.popleft())
        while waiting:
            keep(*waiting.popleft())
    parts = [(rows[part][: used[part]], target[part][: used[part]]) for part in (0, 1)]
    return parts if used[0] else parts[::-1]


def held_out(count: int) -> np.ndarray:
    """Return which of `count` examples are held out, (count,) bool: every eighth run."""
    run = np.arange(count) * min(count, _RUNS) // count
    return run % _HELD_OUT_ONE_IN == _HELD_OUT_ONE_IN - 1


def _table(extra, each):
    """Rows of a Drawn, (n, columns) float32."""
    found = np.empty((each.pixels.size, len(extra.columns)), np.float32)
    row, column = np.divmod(each.pixels, each.inputs.rgb.shape[1])
    for (rows, columns), table in extra.tiles(each.inputs, each.window):
        inside = (row >= rows.start) & (row < rows.stop) & (column >= columns.start) & (column < columns.stop)
        found[inside] = table[:, row[inside] - rows.start, column[inside] - columns.start].T
    return found


def _by_column(extra, table):
    """Yield (slice, {column: (n,) values}) of rows, chunk by chunk."""
    for start in range(0, len(table), _CHUNK):
        here = slice(start, min(start + _CHUNK, len(table)))
        yield here, dict(zip(extra.columns, table[here].T, strict=True))


def _checksum(text):
    """The checksum of a model's text, (n,) uint8, as hexadecimal digits."""
    return formats.digest("trees", {"text": text})


def _lightgbm():
    try:
        import lightgbm
    except ImportError:
        raise ThermorenderError(
            "temperature maps of boosted trees need LightGBM; install it with `pip install 'thermorender[maps]'`"
        ) from None
    return lightgbm
