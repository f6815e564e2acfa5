"""Training of Trees by LightGBM (Ke et al. 2017, "LightGBM: a highly efficient gradient boosting decision tree")."""

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np

from thermorender.apps.training.drawn_pixels import Drawn, drawn
from thermorender.apps.training.linear_training import Sums
from thermorender.apps.training.task import Task
from thermorender.errors import ThermorenderError
from thermorender.learned.rows import CLASSES, ExtraInputs
from thermorender.learned.trees import Trees

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
_SETTINGS: dict[str, Any] = {
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
# Ridge penalty of the linear base.
_PENALTY = 1e-2
# Rows that the linear base is computed for at a time. For more, BLAS starts threads that mostly wait for each other.
_CHUNK = 1 << 12


def fit_trees(task: Task) -> Trees:
    """Return the Trees trained on a Task, with the same number of pixels from each example and least absolute error.

    Early stopping uses held-out runs. With air temperature as input, the trees are added to a Linear.
    """
    try:
        import lightgbm
    except ImportError:
        raise ThermorenderError(
            "training boosted trees needs LightGBM; install it with `pip install 'thermorender[maps]'`"
        ) from None
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
    callbacks: list[Callable[[Any], object]] = [
        lambda now: task.progress("growing trees", (now.iteration + 1) / _MOST_TREES)
    ]
    if len(watched[0]):
        callbacks.append(lightgbm.early_stopping(_PATIENCE, verbose=False))
    grown = lightgbm.train(
        _SETTINGS | {"seed": task.seed % 2**31}, train, _MOST_TREES, callbacks=callbacks,
        valid_sets=[held.set_reference(train)] if len(watched[0]) else [],
    )  # fmt: skip
    return Trees(grown.model_to_string(num_iteration=grown.best_iteration), extra, begin)


def _learned_and_watched(
    task: Task, extra: ExtraInputs
) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """((rows, target) to learn from, (rows, target) for early stopping) of a Task; the second may be empty."""
    most = min(_MOST_ROWS, max(_MOST_NUMBERS // len(extra.columns) // len(task.examples), 1))
    held = held_out(len(task.examples)) if task.held_out is None else task.held_out
    rows = [np.empty((np.count_nonzero(held == part) * most, len(extra.columns)), np.float32) for part in (0, 1)]
    target, used = [np.empty(len(table)) for table in rows], [0, 0]

    def keep(each: Drawn, table: "Future[np.ndarray]") -> None:
        part = int(held[each.number])
        here = slice(used[part], used[part] + each.pixels.size)
        rows[part][here], target[part][here] = table.result(), each.target
        used[part] = here.stop

    # Threads compute features while the next pictures are read; the order of examples is kept.
    waiting: deque[tuple[Drawn, Future[np.ndarray]]] = deque()
    with ThreadPoolExecutor() as pool:
        for each in drawn(task, extra, most):
            waiting.append((each, pool.submit(_table, extra, each)))
            if len(waiting) > _AT_ONCE:
                keep(*waiting.popleft())
        while waiting:
            keep(*waiting.popleft())
    learned, watched = ((rows[part][: used[part]], target[part][: used[part]]) for part in (0, 1))
    return (learned, watched) if used[0] else (watched, learned)


def held_out(count: int) -> np.ndarray:
    """Return which of `count` examples are held out, (count,) bool: every eighth run."""
    run = np.arange(count) * min(count, _RUNS) // count
    return run % _HELD_OUT_ONE_IN == _HELD_OUT_ONE_IN - 1


def _table(extra: ExtraInputs, each: Drawn) -> np.ndarray:
    """Rows of a Drawn, (n, columns) float32."""
    found = np.empty((each.pixels.size, len(extra.columns)), np.float32)
    row, column = np.divmod(each.pixels, each.inputs.rgb.shape[1])
    for (rows, columns), planes in extra.planes(each.inputs, each.window):
        inside = (row >= rows.start) & (row < rows.stop) & (column >= columns.start) & (column < columns.stop)
        for number, plane in enumerate(planes):
            here = plane[row[inside] - rows.start, column[inside] - columns.start] if plane.ndim else plane
            found[inside, number] = here
    return found


def _by_column(extra: ExtraInputs, table: np.ndarray) -> Iterator[tuple[slice, dict[str, np.ndarray | float]]]:
    """Yield (slice, {column: (n,) values}) of rows, chunk by chunk."""
    for start in range(0, len(table), _CHUNK):
        here = slice(start, min(start + _CHUNK, len(table)))
        yield here, dict(zip(extra.columns, table[here].T, strict=True))
