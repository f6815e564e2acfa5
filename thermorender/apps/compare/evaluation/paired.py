"""Differences of mean absolute errors between maps on the same pictures, with intervals over lands and seeds.

Maps that differ only in their training seed count as one method, whose error is the mean of theirs.
"""

import json
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.apps.compare.evaluation.sums import CONFIDENCE, DRAWS, Interval

if TYPE_CHECKING:
    from thermorender.apps.compare.evaluation.estimators import LearnedMap

# Keys that distinguish two trainings, besides the method; the seed is not one of them.
_KEYS = ("dataset", "pairs", "sequences", "conditions", "bounds", "share", "shift_px", "options")


def kin(maps: Sequence["LearnedMap"]) -> list[list[int]]:
    """Return groups of numbers of LearnedMaps whose trainings differ only in the seed, in the given order."""
    groups: dict[tuple[str, int | None], list[int]] = {}
    seeds = set()
    for number, each in enumerate(maps):
        model = each.model
        training = [model.method, each.privileged, *(model.about.get(name) for name in _KEYS)]
        alike, seed = json.dumps(training, sort_keys=True), model.about.get("seed")
        # Two maps of the same seed must differ in something that their files do not record.
        alone = number if seed is None or (alike, seed) in seeds else None
        seeds.add((alike, seed))
        groups.setdefault((alike, alone), []).append(number)
    return list(groups.values())


def differences(
    rows: ArrayLike, groups: list[list[int]], cluster: ArrayLike, seed: int = 0
) -> list[tuple[list[int], float | None, Interval | None]]:
    """Return the mean absolute error of each later group minus the first's: [(group, K or None, interval or None)].

    Parameters
    ----------
    rows : (M, P, 5) array
        Sums of each map's errors on each picture, as `sums.row` returns them.
    groups : list of list of int
        Numbers of the maps of each method.
    cluster : (P,) array of int
        Pictures with the same number are drawn together.
    seed : int

    Notes
    -----
    95 % intervals [K] by a percentile bootstrap of 1000 draws: of clusters, the same for both groups, and of the maps
    in each group. The sample of n seeds scatters less about its own mean than about the true one, so deviations are
    multiplied by √(n / (n − 1)). Even so, intervals of three seeds are too short, and a single map does not show how
    seeds scatter. Only pictures for which every map has an error count; if there are none, the difference is None.
    """
    rows = np.asarray(rows, np.float64)
    shared = (rows[..., 0] > 0).all(axis=0)
    cluster = np.unique(cluster, return_inverse=True)[1]
    whole = np.zeros((len(rows), int(cluster.max(initial=-1)) + 1, 2))
    for own, each in zip(whole, rows, strict=True):
        np.add.at(own, cluster[shared], each[shared][:, [2, 0]])
    kept = whole[:, whole[0, :, 1] > 0]
    if not kept.shape[1]:
        return [(group, None, None) for group in groups[1:]]
    generator = np.random.default_rng(seed)
    times = generator.multinomial(kept.shape[1], np.full(kept.shape[1], 1.0 / kept.shape[1]), DRAWS)
    drawn = _mean(times, kept)
    measured, errors = [], []
    for group in groups:
        own = drawn[group]
        centre = own.mean(axis=0)
        if len(group) > 1:
            chosen = generator.integers(len(group), size=(len(group), DRAWS))
            wider = np.sqrt(len(group) / (len(group) - 1.0))
            errors.append(centre + wider * (np.take_along_axis(own, chosen, axis=0).mean(axis=0) - centre))
        else:
            errors.append(centre)
        measured.append(float(_mean(np.ones((1, kept.shape[1])), kept[group]).mean()))
    ends = 50.0 * (1.0 - CONFIDENCE), 50.0 * (1.0 + CONFIDENCE)
    found: list[tuple[list[int], float | None, Interval | None]] = []
    for group, error, mean in zip(groups[1:], errors[1:], measured[1:], strict=True):
        low, high = np.percentile(error - errors[0], ends).tolist()
        found.append((group, mean - measured[0], (low, high) if kept.shape[1] > 1 else None))
    return found


def _mean(times: NDArray[np.number], sums: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return mean absolute errors (maps, draws) of (maps, clusters, 2) sums, each cluster repeated `times`."""
    absolute, count = (sums[..., column] @ times.T for column in (0, 1))
    return absolute / count
