"""Boosted trees from what describes a pixel to its temperature; LightGBM's, kept as its own text.

Told the terrain's relief, hour and weather they give kelvin above the air, else intensity. A leaf says one number for
all weathers that reach it; so there the trees learn what the mixture of typical materials (`linear`) leaves over, which
spreads less and does not grow with the sun. Ke et al. 2017, "LightGBM: a highly efficient gradient boosting decision
tree".

A checksum in the file shows damage to the text. It does not show intent: LightGBM can crash on a text that somebody
made to crash it, so load trees only from people you trust.
"""

from collections import deque
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from thermorender import formats
from thermorender.errors import ThermorenderError
from thermorender.learned.features import NAMES
from thermorender.learned.linear import Linear, Sums
from thermorender.learned.rows import CLASSES, Told, at_shape, at_texel, drawn

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


@dataclass(frozen=True, eq=False)
class Trees:
    """Boosted trees over the columns of `rows.Told.tiles`.

    Attributes
    ----------
    text : str
        The model as LightGBM writes it.
    told : Told
        What it is told besides the picture.
    begin : Linear or None
        What the trees are added to, where the air's temperature is told.
    """

    text: str
    told: Told
    begin: Linear | None = None

    @property
    def needs(self):
        """Names of the fields of Inputs that are needed."""
        return self.told.needs

    @property
    def above_air(self):
        """Whether it gives kelvin above the air instead of intensity."""
        return self.told.above_air

    def predict(self, inputs, texel_m):
        """Return intensity, or kelvin above the air, (h, w) float64.

        Raises
        ------
        ThermorenderError
            A plane of the terrain or a condition is missing, or LightGBM is.
        """
        image = at_texel(inputs, texel_m)
        found = np.empty(image.rgb.shape[:2])
        for here, table in self.told.tiles(image):
            table = np.ascontiguousarray(table.reshape(len(table), -1).T)
            found[here] = self.of_rows(table).reshape(found[here].shape)
        return at_shape(found, inputs.rgb.shape[:2])

    def of_rows(self, table):
        """Return intensity, or kelvin above the air, (n,) float64, of rows, (n, columns) float32."""
        found = self._booster.predict(table)
        if self.begin is not None:
            for here, values in _by_column(self.told, table):
                found[here] += self.begin.of_values(values)
        return found

    def importances(self):
        """Return {column: share of what all splits lowered the training error by}, the greatest first."""
        gain = self._booster.feature_importance("gain")
        order = np.argsort(-gain, kind="stable")
        return {self.told.columns[number]: float(gain[number] / max(gain.sum(), 1e-300)) for number in order}

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
        return {
            "terrain": self.told.terrain, "conditions": self.told.conditions, "features": NAMES,
            "checksum": _checksum(self.arrays()["trees"]), **begin,
        }  # fmt: skip

    def arrays(self):
        """Return what the file holds of it."""
        begin = {} if self.begin is None else self.begin.arrays()
        return {"trees": np.frombuffer(self.text.encode(), np.uint8), **begin}

    @classmethod
    def of(cls, header, arrays):
        """Return the Trees of `header` and `arrays`.

        Raises
        ------
        ValueError
            The text is not the one that was saved, or its columns are others.
        """
        if header.get("checksum") != _checksum(arrays["trees"]):
            raise ValueError("its trees are damaged: their checksum is another")
        told = Told(tuple(header["terrain"]), tuple(header["conditions"]))
        begin = Linear.of(header["begin"], arrays) if told.above_air else None
        if begin is not None and not set(begin.told.columns) <= set(told.columns):
            raise ValueError("what its trees begin with is told other things")
        found = cls(arrays["trees"].tobytes().decode(), told, begin)
        if tuple(header["features"]) != NAMES or found._booster.num_feature() != len(found.told.columns):
            raise ValueError("other features")
        return found


def fit_trees(task):
    """Return the Trees that learn a Task.

    As many pixels are drawn from each example; the absolute error is minimised, and trees are added until that of the
    runs held out has not fallen for a while. Where the air's temperature is told they begin with a Linear.

    Raises
    ------
    ThermorenderError
        LightGBM is missing, or there is nothing to learn from.
    """
    lightgbm = _lightgbm()
    told = Told.of(task.examples[0].inputs)
    most = min(_MOST_ROWS, max(_MOST_NUMBERS // len(told.columns) // len(task.examples), 1))
    held = held_out(len(task.examples)) if task.held_out is None else task.held_out
    rows = {part: np.empty((np.count_nonzero(held == part) * most, len(told.columns)), np.float32) for part in (0, 1)}
    target, used = {part: np.empty(len(rows[part])) for part in rows}, [0, 0]

    def kept(each, table):
        part = int(held[each.number])
        here = slice(used[part], used[part] + each.pixels.size)
        rows[part][here], target[part][here] = table.result(), each.target
        used[part] = here.stop

    # Pictures are described by threads while the next ones are read; they are kept in their order.
    waiting = deque()
    with ThreadPoolExecutor() as pool:
        for each in drawn(task, told, most):
            waiting.append((each, pool.submit(_table, told, each)))
            if len(waiting) > _AT_ONCE:
                kept(*waiting.popleft())
        while waiting:
            kept(*waiting.popleft())
    learned, watched = (0, 1) if used[0] else (1, 0)
    begin = None
    if told.above_air:
        sums = Sums(told)
        for here, values in _by_column(told, rows[learned][: used[learned]]):
            sums.add(values, target[learned][here])
        begin = sums.solved(_PENALTY)
        for part in (0, 1):
            for here, values in _by_column(told, rows[part][: used[part]]):
                target[part][here] -= begin.of_values(values)
    settings = _SETTINGS | {"seed": task.seed % 2**31}
    classes = [told.columns.index(CLASSES)] if CLASSES in told.terrain else []
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
    return Trees(grown.model_to_string(num_iteration=grown.best_iteration), told, begin)


def held_out(count):
    """Return which of so many examples are held out, (count,) bool: every eighth run of them."""
    run = np.arange(count) * min(count, _RUNS) // count
    return run % _HELD_OUT_ONE_IN == _HELD_OUT_ONE_IN - 1


def _table(told, each):
    """Rows of a Drawn, (n, columns) float32."""
    found = np.empty((each.pixels.size, len(told.columns)), np.float32)
    row, column = np.divmod(each.pixels, each.inputs.rgb.shape[1])
    for (rows, columns), table in told.tiles(each.inputs, each.window):
        inside = (row >= rows.start) & (row < rows.stop) & (column >= columns.start) & (column < columns.stop)
        found[inside] = table[:, row[inside] - rows.start, column[inside] - columns.start].T
    return found


def _by_column(told, table):
    """Give (slice, {column: (n,) values}) of rows, some at a time."""
    for start in range(0, len(table), _CHUNK):
        here = slice(start, min(start + _CHUNK, len(table)))
        yield here, dict(zip(told.columns, table[here].T, strict=True))


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
