"""What every study of the folder `validation` comes to: each case's scene, source, expected value, tolerance, verdict.

A study writes its numbers as JSON; here stands how its cases are read from them. A later study joins by a line in
`STUDIES`. Cases are in kelvin and hold where what was found differs from what is expected by no more than is allowed.
Studies without an expected value, such as those of cost or of learned maps, have figures only.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from thermorender.errors import ThermorenderError

_MK = 1e-3


@dataclass(frozen=True)
class Verdict:
    """A case of a study.

    Attributes
    ----------
    scene, source : str
        What is looked at, and what it is held against.
    expected_k, found_k, tolerance_k : float
        [K]
    seconds : float or None
        Run time of the setting that is judged [s].
    """

    scene: str
    source: str
    expected_k: float
    found_k: float
    tolerance_k: float
    seconds: float | None

    @property
    def share(self):
        """The error by what is allowed; above 1 the case does not hold, and NaN where nothing was found."""
        error = abs(self.found_k - self.expected_k)
        return error / self.tolerance_k if self.tolerance_k else (0.0 if error == 0.0 else float("inf"))

    @property
    def holds(self):
        """Whether the case holds; what was not found does not."""
        return self.share <= 1.0


@dataclass(frozen=True)
class Study:
    """A study and where its results lie in the folder.

    Attributes
    ----------
    name : str
    module : str
        The package whose `__main__` runs it: `python -m MODULE`.
    title : str
    result : str
        Path of its JSON in the folder.
    figures : tuple of str
        Paths or patterns of PNGs there.
    read : callable or None
        (result) → list of Verdict; None where nothing is expected.
    runs : bool
        Whether the page runs it where it is missing; False where it needs what the user names, or hours.
    continues : bool
        Whether its command continues what is there, and costs little where nothing is missing.
    """

    name: str
    module: str
    title: str
    result: str
    figures: tuple = ()
    read: Callable | None = None
    runs: bool = True
    continues: bool = False


# What the cases of stability are held against, by their group.
_AGAINST = {"faults": "the same work undisturbed, counts of what is wrong", "precision": "the same code in double"}


def _stability(found):
    return [Verdict(f"{each['group']}: {each['name']}",
                    _AGAINST.get(each["group"], "closed form or limit, each stated in its code"),
                    each["expected_k"], float("nan") if each["raised"] else each["found_k"], each["tolerance_k"],
                    each["seconds"]) for each in found["cases"]]  # fmt: skip


def _convergence(found):
    """Frames of the qualities by name, against path tracing; allowed is what each frame states of its own error."""
    presets = ("(fast)", "(standard)", "(high)")
    return [Verdict(f"{each['scene']}, {each['view']}, {each['setting']}", "path tracing by stock Mitsuba, RMS", 0.0,
                    _MK * each["error_mk"], _MK * each["budget_mk"], each["seconds"])
            for each in found["cases"].values()
            if each.get("engine") == "thermorender" and each.get("group") == "sampling"
            and each["setting"].endswith(presets)]  # fmt: skip


def _air(found):
    """Channels of the air against every node of its table; allowed is what the plan states."""
    return [Verdict(f"{found['scene']}, {each['height_m']:g} m, {each['view']}, {each['nodes']} nodes",
                    "all nodes of the table, RMS of a frame", 0.0, _MK * each["error_mk"],
                    _MK * each["planned_mk"], _MK * each["frame_ms"]) for each in found["cases"]]  # fmt: skip


def _sensor(found):
    """Lag as a flight follows it, the first setting of each motion; allowed is what the frame states."""
    told = []
    for motion, cases in found["lag"].items():
        used = next((each for each in cases if each["estimate_mk"] is not None), None)
        if used is None:
            continue
        told.append(Verdict(f"{found['camera']}, {motion}, {used['renders']} renders",
                            "64 renders in a time constant, RMS of a frame", 0.0, _MK * used["all_mk"],
                            _MK * used["estimate_mk"], _MK * used["ms"]))  # fmt: skip
    return told


def _heat(found):
    """Mean absolute errors of the heat balance by day and by night; allowed is what was aimed at."""
    return [Verdict(f"{site['title']}, {part}", "measured surface temperature, mean absolute error", 0.0,
                    site["scores"]["balance"][part]["mae"], aim, site["seconds"])
            for site in found["sites"].values() if site["aim_k"]
            for part, aim in zip(("day", "night"), site["aim_k"], strict=True)
            # A site may have no night, or not have been measured by night.
            if np.isfinite(site["scores"]["balance"].get(part, {}).get("mae", np.nan))]  # fmt: skip


def _moved(found):
    """Maps moved to another hour; allowed is the standard deviation that is stated of them."""
    return [Verdict(name, "truth of procedural scenes, mean absolute error", 0.0, each["mae_k"]["moved"],
                    each["stated_k"], None) for name, each in found["all"].items()]  # fmt: skip


def _budget(found):
    """Frames of the chosen views against 256 rays per pixel; allowed is what each states of its sampling error."""
    source = "256 rays per pixel of the same light, RMS"
    return [Verdict(f"{each['scene']}, {each['view']}, {each['quality']}", source, 0.0, _MK * each["true_mk"],
                    _MK * each["stated_mk"], _MK * each["frame_ms"])
            for each in found["cases"].values() if not each["drawn"]]  # fmt: skip


def _fuzz(found):
    """Damaged files by reader; allowed is no fault: no foreign error, number that is not finite, hanging or crash."""
    told = []
    for reader, of in found["counts"].items():
        ends = sum(count for kind, count in of.items() if kind not in ("rendered", "unfit"))
        what = f"{reader}: {ends} damaged files, {of.get('accepted', 0)} read, {of.get('rendered', 0)} rendered"
        faults = sum(fault["reader"] == reader for fault in found["faults"])
        told.append(Verdict(what, "a sentence or finite numbers; how many gave neither", 0.0, faults, 0.0, None))
    return told


STUDIES = (
    Study("stability", "tests.robustness", "Cases at the edge", "stability/stability.json", (), _stability),
    Study("fuzz", "tests.robustness", "Damaged files", "fuzz/fuzz.json", (), _fuzz, runs=False),
    Study("convergence", "validation.convergence", "Frames against path tracing", "convergence/convergence.json",
          ("convergence/convergence_*.png",), _convergence, continues=True),
    Study("budget", "validation.budget", "Stated against true sampling error", "budget/budget.json",
          ("budget/budget.png",), _budget, continues=True),
    Study("air", "validation.air", "Spectral channels of the air", "air/air.json", ("air/*.png",), _air),
    Study("sensor", "validation.sensor", "Lag and blur of the camera", "sensor/sensor.json",
          ("sensor/sensor.png", "sensor/effects.png"), _sensor),
    Study("heat", "validation.heat", "The heat balance against measurements", "heat/heat.json", ("heat/heat.png",),
          _heat),
    Study("moved", "validation.moved", "Learned maps at another hour", "moved/moved.json", ("moved/moved.png",),
          _moved),
    Study("growth", "validation.growth", "Cost against size", "growth/growth.json", ("growth/growth.png",),
          continues=True),
    Study("maps", "validation.maps", "Learned maps on land, hours and weathers not trained on", "maps/maps.json",
          ("maps/*.png",)),
    Study("trainings", "validation.trainings", "Trainings of networks", "networks/campaign/trainings.json",
          ("networks/campaign/*.png",), runs=False),
    Study("landing", "examples.landing", "Landings by rendered and by translated frames", "landing/landing.json",
          ("landing/landing.png",), continues=True),
)  # fmt: skip


def gathered(folder):
    """Return [(Study, list of Verdict or None, machine or None)] of a folder; None where a study has no results there.

    Raises
    ------
    ThermorenderError
        A result that is not one of its study.
    """
    told = []
    for study in STUDIES:
        path = Path(folder) / study.result
        if not path.is_file():
            told.append((study, None, None))
            continue
        try:
            found = json.loads(path.read_text(encoding="utf-8"))
            verdicts = study.read(found) if study.read else []
            for each in verdicts:
                # Which all but numbers refuse.
                _ = each.share
            told.append((study, verdicts, found.get("machine")))
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise ThermorenderError(
                f"{path} is not a result of `python -m {study.module}` ({type(error).__name__}: {error}); "
                "remove it to run that study again"
            ) from None
    return told
