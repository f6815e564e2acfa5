"""Comparison of trainings of networks: validation error against run time.

All trainings validate on crops of the same pictures, so their errors are comparable. Time is core time, summed over all
threads of a process, so other load does not matter. A training has reached its plateau if its best error fell by less
than 1 % over the last fifth of its crops. A method is ahead of another if its error is smaller within a tenth of the
time.

A training that has not reached its plateau is extrapolated: a power law of core time is fitted to the best errors so
far over the later half of the crops, and extended to twice the core time. The result is not a measurement.
"""

import numpy as np

from thermorender.apps.training.networks.runs import read_log, read_settings
from thermorender.errors import ThermorenderError
from thermorender.learned.networks.recipes import RECIPES

HEADER = ("run", "method", "width", "batch", "crops seen", "published", "core hours", "validation [K]", "at crops",
          "at core hours", "last fifth")  # fmt: skip
PLATEAU = 0.01
# Fewest epochs before the last fifth of a curve for a statement about the plateau.
_EPOCHS = 4
# Factor of time by which a training must be sooner to be ahead.
SOONER = 10.0
# Factor of core time up to which a curve is extrapolated, and the share of the crops that is fitted.
FURTHER, _LATER = 2.0, 0.5
# Exponent beyond which a curve is not taken for a power law: the error falls to a hundredth in twice the time.
_STEEPEST = 6.6
# Smallest difference of errors for a training to be ahead [K].
_LEAST_K = 0.01


def run(folders):
    """Return the numbers in the logs of trainings.

    Parameters
    ----------
    folders : sequence of path
        Folders written by `train --run`.

    Returns
    -------
    dict
        Its "runs" have name, method, options, seed, pairs of the data set, published_crops, curve [(crops, core
        seconds, validation error [K])], best_mae_k, best_crops, best_core_s, core_s, crops and last_fifth, the share by
        which the best error fell over the last fifth of the crops, and extrapolated, of that function.

    Raises
    ------
    ThermorenderError
        No folder, a folder without a training, two of the same name, a training without a complete epoch, or data sets
        of different sizes.
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
            f"the trainings used data sets of {', '.join(map(str, pairs))} pairs, so their errors are not comparable; "
            "give trainings on one data set"
        )
    return {"runs": sorted(found, key=lambda each: each["best_mae_k"])}


def _read(folder):
    settings, log = read_settings(folder), read_log(folder)
    if not log:
        raise ThermorenderError(f"{folder} has a training without a complete epoch; train longer")
    curve = [(line["crops"], line["core_seconds"], line["validation_mae_k"]) for line in log]
    crops, seconds, errors = (np.array(column, np.float64) for column in zip(*curve, strict=True))
    best = int(errors.argmin())
    early = errors[crops <= 0.8 * crops[-1]]
    recipe = RECIPES.get(settings["method"])
    last_fifth = float(1.0 - errors.min() / early.min()) if early.size >= _EPOCHS and early.min() > 0.0 else None
    return {
        "name": folder.resolve().name.removesuffix(".run"), "method": settings["method"],
        "options": settings["options"], "seed": settings["seed"], "pairs": settings["examples"][0],
        "published_crops": recipe.published_crops if recipe else None,
        "published_steps": recipe.published_steps if recipe else None, "curve": curve,
        "best_mae_k": float(errors[best]), "best_crops": int(crops[best]), "best_core_s": float(seconds[best]),
        "core_s": float(seconds[-1]), "crops": int(crops[-1]),
        "last_fifth": last_fifth, "extrapolated": extrapolated(curve, last_fifth),
    }  # fmt: skip


def extrapolated(curve, last_fifth):
    """Return {"core_s", "mae_k", "exponent"} of a curve extended `FURTHER` times as far, by a power law of core time.

    None for a training that is on its plateau or too short, or whose times or errors have no power law.

    Parameters
    ----------
    curve : sequence of (crops, core seconds, validation error [K])
    last_fifth : float or None
        As in `run`.
    """
    if last_fifth is None or last_fifth < PLATEAU:
        return None
    crops, seconds, errors = np.array(curve, np.float64).T
    later = crops > (1.0 - _LATER) * crops[-1]
    seconds, best = seconds[later], np.minimum.accumulate(errors)[later]
    # A log of a clock that stood or ran backwards, or with an error of zero, has no power law.
    if (np.diff(seconds) <= 0.0).any() or seconds[0] <= 0.0 or best[-1] <= 0.0:
        return None
    exponent, _ = np.polyfit(np.log(seconds), np.log(best), 1)
    if not -_STEEPEST <= exponent <= 0.0:
        return None
    return {"core_s": float(FURTHER * seconds[-1]), "mae_k": float(errors.min() * FURTHER**exponent),
            "exponent": float(exponent)}  # fmt: skip


def rows(result):
    """Return the result as table rows under HEADER."""
    return [
        (each["name"], each["method"], each["options"]["width"], each["options"]["batch"], each["crops"],
         _published(each), f"{each['core_s'] / 3600.0:.2f}", f"{each['best_mae_k']:.2f}",
         each["best_crops"], f"{each['best_core_s'] / 3600.0:.3f}", _last_fifth(each["last_fifth"]))
        for each in result["runs"]
    ]  # fmt: skip


def _published(each):
    """Training crops of the study, with both readings of its epochs where there are two."""
    epochs, steps = each["published_crops"], each["published_steps"]
    return f"{epochs} or {steps}" if steps else epochs or "–"


def sentences(result):
    """Return one sentence for each method that is ahead of every training of another.

    A training is ahead if its error is smaller than the other's best, within a tenth of the core time of that best.
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
                found.append(f"{winner} is ahead of {loser} by at least {margin:.2f} K, within 1/{SOONER:g} of the "
                             "core time of its best error")  # fmt: skip
    return found


def extrapolations(result):
    """Return one sentence for each extrapolated curve."""
    return [
        f"{each['name']}: {each['best_mae_k']:.2f} K after {each['core_s'] / 3600.0:.2f} core hours; extrapolated, not "
        f"measured: {each['extrapolated']['mae_k']:.2f} K after {each['extrapolated']['core_s'] / 3600.0:.2f}"
        for each in result["runs"] if each["extrapolated"]
    ]  # fmt: skip


def _before(runs, seconds):
    """Return the smallest validation error of trainings within `seconds` core seconds; infinite without any."""
    curves = (point for each in runs for point in each["curve"])
    return min((error for _, core_s, error in curves if core_s <= seconds > 0.0), default=np.inf)


def _last_fifth(share):
    if share is None:
        return "too short"
    return f"−{100.0 * share:.1f} %" + (", plateau" if share < PLATEAU else "")
