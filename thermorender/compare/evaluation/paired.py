"""Differences of mean absolute errors between maps, on the same pictures, with what lands and seeds leave uncertain.

Maps that were trained alike but for their seed stand for one method: theirs is the mean of their errors.
"""

import json

import numpy as np

from thermorender.compare.evaluation.sums import CONFIDENCE, DRAWS

# What tells two trainings apart, besides the method; the seed does not.
_TOLD = ("dataset", "pairs", "sequences", "conditions", "bounds", "share", "shift_px", "options")


def kin(maps):
    """Return lists of numbers of LearnedMaps that were trained alike but for their seed, in the order given."""
    groups, seeds = {}, set()
    for number, each in enumerate(maps):
        model = each.model
        told = [model.method, each.oracle, *(model.about.get(name) for name in _TOLD)]
        alike, seed = json.dumps(told, sort_keys=True), model.about.get("seed")
        # Of one seed twice something else must differ, which their files do not tell.
        alone = number if seed is None or (alike, seed) in seeds else None
        seeds.add((alike, seed))
        groups.setdefault((alike, alone), []).append(number)
    return list(groups.values())


def differences(rows, groups, cluster, seed=0):
    """Return what each group but the first errs more than the first: [(group, K or None, (low, high) [K] or None)].

    Parameters
    ----------
    rows : sequence of (P, 5) array
        Sums of each map's errors on each picture, as of `sums.row`.
    groups : list of list of int
        Maps that stand for one method.
    cluster : (P,) array of int
        Pictures of one number are drawn together.
    seed : int

    Notes
    -----
    95 % intervals, percentile bootstrap of 1000 draws: clusters, the same for both, and of each group its maps. Since n
    maps of few seeds scatter about their own mean by less than about the true one, their deviations are taken
    √(n / (n − 1)) times; even so the intervals of three seeds hold the true difference in 86 % of simulated cases, and
    a group of one map tells nothing of how its seeds scatter. Pictures that a map has no error for count for none;
    where none is left, there is no difference.
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
    found, errors = [], []
    for group in groups:
        own = drawn[group]
        centre = own.mean(axis=0)
        if len(group) > 1:
            chosen = generator.integers(len(group), size=(len(group), DRAWS))
            wider = np.sqrt(len(group) / (len(group) - 1.0))
            errors.append(centre + wider * (np.take_along_axis(own, chosen, axis=0).mean(axis=0) - centre))
        else:
            errors.append(centre)
        found.append(float(_mean(np.ones((1, kept.shape[1])), kept[group]).mean()))
    ends = 50.0 * (1.0 - CONFIDENCE), 50.0 * (1.0 + CONFIDENCE)
    told = []
    for group, error, own in zip(groups[1:], errors[1:], found[1:], strict=True):
        sure = tuple(np.percentile(error - errors[0], ends).tolist()) if kept.shape[1] > 1 else None
        told.append((group, own - found[0], sure))
    return told


def _mean(times, sums):
    """Mean absolute errors of (maps, clusters, 2) sums, each cluster so many times: (maps, draws)."""
    absolute, count = (sums[..., column] @ times.T for column in (0, 1))
    return absolute / count
