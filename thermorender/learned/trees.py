"""Boosted trees from what describes a pixel to its temperature; LightGBM's, kept as its own text.

With the terrain's relief, hour and weather as inputs they give kelvin above the air, else intensity. A leaf says one
number for all weathers that reach it; so there the trees learn what the mixture of typical materials (`linear`) leaves
over, which spreads less and does not grow with the sun. Ke et al. 2017, "LightGBM: a highly efficient gradient boosting
decision tree".
"""

import re
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.learned.features import NAMES
from thermorender.learned.linear import Linear, Sums
from thermorender.learned.rows import CLASSES, ExtraInputs, at_shape, at_texel, drawn

# Rows drawn from an example, and numbers of all rows' columns together: 1 GB in single precision.
_MOST_ROWS = 1000
_MOST_NUMBERS = 250_000_000
# Pictures that wait to be described, so that memory stays bounded.
_AT_ONCE = 4
# Neighbours in a data set's order are frames of one flight. So where the task holds none out, the examples are cut into
# runs, and every eighth run is held out to say when to stop. With fewer runs than eight none is, and the number of
# trees is that given.
_RUNS = 40
_HELD_OUT_ONE_IN = 8
# A frame of 640 × 512 pixels then takes 0.6 to 4 s on two cores, by how coarse it is; 100 fewer cost 1 % of error.
_MOST_TREES = 250
_PATIENCE = 20
_SETTINGS = {
    # The mean absolute error is what maps are scored by; the squared one gave 2 % more of it on road scenes held out.
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
# Weight of the coefficients' squares of what the trees begin with, as in `linear.Sums.solved`.
_PENALTY = 1e-2
# Rows that its columns are laid out for at a time.
_CHUNK = 1 << 14
# Of what stands before the trees.
_HEAD = ("num_class", "num_tree_per_iteration", "max_feature_idx")
_BLOCK = re.compile(r"Tree=(\d+)\n")


@dataclass(frozen=True, eq=False)
class Trees:
    """Boosted trees over the columns of `rows.ExtraInputs.tiles`.

    Attributes
    ----------
    text : str
        The model as LightGBM writes it.
    extra : ExtraInputs
        What it takes as input besides the picture.
    begin : Linear or None
        What the trees are added to, where the air's temperature is an input.
    """

    text: str
    extra: ExtraInputs
    begin: Linear | None = None

    @property
    def needs(self):
        """Names of the fields of Inputs that are needed."""
        return self.extra.needs

    @property
    def above_air(self):
        """Whether it gives kelvin above the air instead of intensity."""
        return self.extra.above_air

    def predict(self, inputs, texel_m):
        """Return intensity, or kelvin above the air, (h, w) float64.

        Raises
        ------
        ThermorenderError
            A plane of the terrain or a condition is missing, or LightGBM is.
        """
        image = at_texel(inputs, texel_m)
        found = np.empty(image.rgb.shape[:2])
        for here, table in self.extra.tiles(image):
            table = np.ascontiguousarray(table.reshape(len(table), -1).T)
            found[here] = self.of_rows(table).reshape(found[here].shape)
        return at_shape(found, inputs.rgb.shape[:2])

    def of_rows(self, table):
        """Return intensity, or kelvin above the air, (n,) float64, of rows, (n, columns) float32."""
        found = self._booster.predict(table)
        if self.begin is not None:
            for here, values in _by_column(self.extra, table):
                found[here] += self.begin.of_values(values)
        return found

    def importances(self):
        """Return {column: share of what all splits lowered the training error by}, the greatest first."""
        gain = self._booster.feature_importance("gain")
        order = np.argsort(-gain, kind="stable")
        return {self.extra.columns[number]: float(gain[number] / max(gain.sum(), 1e-300)) for number in order}

    @cached_property
    def _booster(self):
        lightgbm = _lightgbm()
        try:
            return lightgbm.Booster(model_str=self.text)
        except lightgbm.basic.LightGBMError as error:
            raise ValueError("no trees") from error

    def header(self):
        """Return what the file's text says of it."""
        begin = {} if self.begin is None else {"begin": self.begin.header()}
        return {"terrain": self.extra.terrain, "conditions": self.extra.conditions, "features": NAMES, **begin}

    def arrays(self):
        """Return what the file holds of it."""
        begin = {} if self.begin is None else self.begin.arrays()
        return {"trees": np.frombuffer(self.text.encode(), np.uint8), **begin}

    @classmethod
    def of(cls, header, arrays):
        """Return the Trees of `header` and `arrays`."""
        extra = ExtraInputs(tuple(header["terrain"]), tuple(header["conditions"]))
        begin = Linear.of(header["begin"], arrays) if extra.above_air else None
        if begin is not None and not set(begin.extra.columns) <= set(extra.columns):
            raise ValueError("what its trees begin with takes other inputs")
        found = cls(arrays["trees"].tobytes().decode(), extra, begin)
        refuse_broken(found.text, len(found.extra.columns))
        if tuple(header["features"]) != NAMES or found._booster.num_feature() != len(found.extra.columns):
            raise ValueError("other features")
        return found


def fit_trees(task):
    """Return the Trees that learn a Task.

    As many pixels are drawn from each example; the absolute error is minimised, and trees are added until that of the
    runs held out has not fallen for a while. Where the air's temperature is an input they begin with a Linear.

    Raises
    ------
    ThermorenderError
        LightGBM is missing, or there is nothing to learn from.
    """
    lightgbm = _lightgbm()
    extra = ExtraInputs.of(task.examples[0].inputs)
    most = min(_MOST_ROWS, max(_MOST_NUMBERS // len(extra.columns) // len(task.examples), 1))
    held = held_out(len(task.examples)) if task.held_out is None else task.held_out
    rows = {part: np.empty((np.count_nonzero(held == part) * most, len(extra.columns)), np.float32) for part in (0, 1)}
    target, used = {part: np.empty(len(rows[part])) for part in rows}, [0, 0]

    def kept(each, table):
        part = int(held[each.number])
        here = slice(used[part], used[part] + each.pixels.size)
        rows[part][here], target[part][here] = table.result(), each.target
        used[part] = here.stop

    # Pictures are described by threads while the next ones are read; they are kept in their order.
    waiting = deque()
    with ThreadPoolExecutor() as pool:
        for each in drawn(task, extra, most):
            waiting.append((each, pool.submit(_table, extra, each)))
            if len(waiting) > _AT_ONCE:
                kept(*waiting.popleft())
        while waiting:
            kept(*waiting.popleft())
    learned, watched = (0, 1) if used[0] else (1, 0)
    begin = None
    if extra.above_air:
        sums = Sums(extra)
        for here, values in _by_column(extra, rows[learned][: used[learned]]):
            sums.add(values, target[learned][here])
        begin = sums.solved(_PENALTY)
        for part in (0, 1):
            for here, values in _by_column(extra, rows[part][: used[part]]):
                target[part][here] -= begin.of_values(values)
    settings = _SETTINGS | {"seed": task.seed % 2**31}
    classes = [extra.columns.index(CLASSES)] if CLASSES in extra.terrain else []
    parts = [
        lightgbm.Dataset(rows[part][: used[part]], target[part][: used[part]], categorical_feature=classes)
        for part in (0, 1)
    ]
    callbacks = [lambda now: task.progress("growing trees", (now.iteration + 1) / _MOST_TREES)]
    if used[watched]:
        callbacks.append(lightgbm.early_stopping(_PATIENCE, verbose=False))
    grown = lightgbm.train(
        settings, parts[learned], _MOST_TREES, callbacks=callbacks,
        valid_sets=[parts[watched].set_reference(parts[learned])] if used[watched] else [],
    )  # fmt: skip
    return Trees(grown.model_to_string(num_iteration=grown.best_iteration), extra, begin)


def held_out(count):
    """Return which of so many examples are held out, (count,) bool: every eighth run of them."""
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
    """Give (slice, {column: (n,) values}) of rows, some at a time."""
    for start in range(0, len(table), _CHUNK):
        here = slice(start, min(start + _CHUNK, len(table)))
        yield here, dict(zip(extra.columns, table[here].T, strict=True))


def _lightgbm():
    try:
        import lightgbm
    except ImportError:
        raise ThermorenderError(
            "temperature maps of boosted trees need LightGBM; install it with `pip install 'thermorender[maps]'`"
        ) from None
    return lightgbm


# --- texts of others -------------------------------------------------------------------------------------------------


_LEAVES_TOO = "leaf_weight", "leaf_count"
_NODES_TOO = "split_gain", "internal_value", "internal_weight", "internal_count"


def refuse_broken(text, features):
    """Raise unless a text is a whole LightGBM model of one value over so many features.

    LightGBM ends the process, or reads past its arrays, on some that are not.

    Raises
    ------
    ValueError
        The message says what is wrong.
    """
    head, found, _ = text.partition("\n\nTree=0\n")
    values = _values(head)
    sizes = [_whole(size) for size in values.get("tree_sizes", "").split()]
    if not found or not sizes or min(sizes) <= 0:
        raise ValueError("its trees are broken off")
    if [_whole(values.get(name, "")) for name in _HEAD] != [1, 1, features - 1]:
        raise ValueError(f"its trees are not of one value over {features} features")
    if len(values.get("feature_names", "").split()) != features or len(values.get("feature_infos", "").split()) != (
        features
    ):
        raise ValueError(f"its trees do not describe {features} features")
    # LightGBM counts bytes; all that it writes is plain.
    if not (text.isascii() and text.replace("\n", "").isprintable()):
        raise ValueError("its trees hold letters that LightGBM does not write")
    start = len(head) + 2
    for number, size in enumerate(sizes):
        block = text[start : start + size]
        match = _BLOCK.match(block)
        if len(block) != size or not match or _whole(match[1]) != number:
            raise ValueError(f"its tree {number} is broken off")
        _refuse_tree(_values(block), number, features)
        start += size
    if not text[start:].lstrip("\n").startswith("end of trees"):
        raise ValueError("its trees have no end")


def _refuse_tree(values, number, features):
    """Raise unless a tree is one: every node and leaf hangs on one node, and what it asks for is there."""
    leaves, sets = (_whole(values.get(name, "")) for name in ("num_leaves", "num_cat"))
    if leaves < 1 or sets < 0 or values.get("is_linear", "0") != "0":
        raise ValueError(f"its tree {number} is none of constant leaves")
    _numbers(values, "leaf_value", leaves, number)
    nodes = leaves - 1
    # What the trees do not need and LightGBM reads all the same, where it is there.
    for names, count in ((_LEAVES_TOO, leaves), (_NODES_TOO, nodes), (("shrinkage",), 1)):
        for name in names:
            if values.get(name, "").strip():
                _numbers(values, name, count, number)
    if not nodes:
        return
    feature, left, right, kind = (
        np.array([_whole(each) for each in values.get(name, "").split()])
        for name in ("split_feature", "left_child", "right_child", "decision_type")
    )
    if {len(feature), len(left), len(right), len(kind)} != {nodes} or not ((feature >= 0) & (feature < features)).all():
        raise ValueError(f"its tree {number} asks for other features")
    children = np.concatenate([left, right])
    # Nodes but the first, and leaves as −1, −2, …; each node comes before those below it, so that none is its own.
    if sorted(children.tolist()) != [*range(-leaves, 0), *range(1, nodes)]:
        raise ValueError(f"its tree {number} has branches that lead nowhere")
    for child in (left, right):
        if ((child >= 0) & (child <= np.arange(nodes))).any():
            raise ValueError(f"its tree {number} has branches that lead back")
    threshold = _numbers(values, "threshold", nodes, number)
    _refuse_sets(values, threshold[kind & 1 == 1], sets, number)


def _refuse_sets(values, chosen, sets, number):
    """Raise unless the sets of classes that a tree's splits choose are there."""
    if not sets:
        if len(chosen):
            raise ValueError(f"its tree {number} chooses classes that it does not have")
        return
    bounds = np.array([_whole(each) for each in values.get("cat_boundaries", "").split()])
    words = values.get("cat_threshold", "").split()
    if len(bounds) != sets + 1 or bounds[0] != 0 or (np.diff(bounds) < 0).any() or bounds[-1] != len(words):
        raise ValueError(f"its tree {number} has broken sets of classes")
    if not all(0 <= _whole(word) < 2**32 for word in words):
        raise ValueError(f"its tree {number} has broken sets of classes")
    if not np.isin(chosen, np.arange(sets)).all():
        raise ValueError(f"its tree {number} chooses classes that it does not have")


def _values(block):
    """{name: text} of lines name=text."""
    return dict(line.split("=", 1) for line in block.splitlines() if "=" in line)


def _whole(text):
    """The whole number of a text; a ValueError where it is none."""
    if not re.fullmatch(r"-?\d{1,18}", text):
        raise ValueError(f"its trees hold {text[:20]!r} in place of a whole number")
    return int(text)


def _numbers(values, name, count, number):
    """The `count` numbers of a line, (count,) float64: finite ones, but for thresholds.

    LightGBM writes a threshold of infinity where a split parts what is unknown from all that is known.
    """
    found = np.array([float(each) for each in values.get(name, "").split()])
    unusable = np.isnan(found) if name == "threshold" else ~np.isfinite(found)
    if len(found) != count or unusable.any():
        raise ValueError(f"its tree {number} has {len(found)} usable {name} for {count}")
    return found
