"""Trainings of networks beside each other: validation error against the time that each has cost so far.

All of them validate on crops of the same pictures, so their errors stand on one axis. Time is that of the machine's
cores, all threads of a process added up: what a training costs whatever ran beside it. A training has come to its
plateau where its best error fell by less than 1 % over the last fifth of its crops. One method is ahead of another
where it errs less within a tenth of the time.
"""

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.learned.networks.recipes import RECIPES
from thermorender.learned.networks.runs import read_log, read_settings

HEADER = ("run", "method", "width", "batch", "crops seen", "published", "core hours", "validation [K]", "at crops",
          "at core hours", "last fifth")  # fmt: skip
PLATEAU = 0.01
# A curve of fewer epochs before its last fifth says nothing of that.
_EPOCHS = 4
# How much sooner one training has to come to another's best error to be called ahead of it.
SOONER = 10.0
# Below this no training is ahead [K].
_LEAST_K = 0.01


def run(folders):
    """Return what the logs of trainings tell; plain numbers.

    Parameters
    ----------
    folders : sequence of path
        As `train --run` wrote them.

    Returns
    -------
    dict
        Its "runs" have name, method, options, seed, pairs of the data set, published_crops, curve [(crops, core
        seconds, validation error [K])], best_mae_k, best_crops, best_core_s, core_s, crops and last_fifth, the share by
        which the best error fell over the last fifth of the crops.

    Raises
    ------
    ThermorenderError
        No folder, one of no training, two of one name, a training without an epoch, or data sets of other sizes.
    """
    if not folders:
        raise ThermorenderError("no training was given; give the folders that `train --run` wrote")
    found = [_read(folder) for folder in folders]
    names = [each["name"] for each in found]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ThermorenderError(f"two trainings are called {twice[0]!r}; rename the folder of one")
    pairs = sorted({each["pairs"] for each in found})
    if len(pairs) > 1:
        raise ThermorenderError(
            f"the trainings were on data sets of {', '.join(map(str, pairs))} pairs, whose errors do not compare; give "
            "those of one data set"
        )
    return {"runs": sorted(found, key=lambda each: each["best_mae_k"])}


def _read(folder):
    settings, log = read_settings(folder), read_log(folder)
    if not log:
        raise ThermorenderError(f"{folder} holds a training without a whole epoch; let it train longer")
    curve = [(line["crops"], line["core_seconds"], line["validation_mae_k"]) for line in log]
    crops, seconds, errors = (np.array(column, np.float64) for column in zip(*curve, strict=True))
    best = int(errors.argmin())
    early = errors[crops <= 0.8 * crops[-1]]
    recipe = RECIPES.get(settings["method"])
    return {
        "name": folder.resolve().name.removesuffix(".run"), "method": settings["method"],
        "options": settings["options"], "seed": settings["seed"], "pairs": settings["examples"][0],
        "published_crops": recipe.published_crops if recipe else None, "curve": curve,
        "best_mae_k": float(errors[best]), "best_crops": int(crops[best]), "best_core_s": float(seconds[best]),
        "core_s": float(seconds[-1]), "crops": int(crops[-1]),
        "last_fifth": float(1.0 - errors.min() / early.min()) if early.size >= _EPOCHS and early.min() > 0.0 else None,
    }  # fmt: skip


def rows(result):
    """Return the rows of a result's table."""
    return [
        (each["name"], each["method"], each["options"]["width"], each["options"]["batch"], each["crops"],
         each["published_crops"] or "–", f"{each['core_s'] / 3600.0:.2f}", f"{each['best_mae_k']:.2f}",
         each["best_crops"], f"{each['best_core_s'] / 3600.0:.3f}", _last_fifth(each["last_fifth"]))
        for each in result["runs"]
    ]  # fmt: skip


def sentences(result):
    """Return one sentence for each pair of methods one of which is ahead of every training of the other.

    Ahead is a training that errs less than the best of the other's, within a tenth of the core seconds that took.
    """
    of_method = {}
    for each in result["runs"]:
        of_method.setdefault(each["method"], []).append(each)
    found = []
    for winner, own in of_method.items():
        for loser, others in of_method.items():
            if loser == winner:
                continue
            margin = min(each["best_mae_k"] - _before(own, each["best_core_s"] / SOONER) for each in others)
            if margin >= _LEAST_K:
                found.append(f"{winner} is ahead of {loser} by {margin:.2f} K at least, at 1/{SOONER:g} of the core "
                             "time that its best took")  # fmt: skip
    return found


def _before(runs, seconds):
    """The least validation error of trainings within so many core seconds; infinite where there is none."""
    curves = (point for each in runs for point in each["curve"])
    return min((error for _, core_s, error in curves if core_s <= seconds > 0.0), default=np.inf)


def _last_fifth(share):
    if share is None:
        return "too short"
    return f"−{100.0 * share:.1f} %" + (", plateau" if share < PLATEAU else "")
