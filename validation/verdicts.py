"""Verdicts of all studies: each case has a scene, a source, an expected value, a tolerance, a verdict and a run time.

A study writes its numbers as JSON; the functions below read its cases from them. A new study needs a line in `STUDIES`.
Values are in kelvin. A case holds if the found value differs from the expected one by no more than the tolerance.
Studies without an expected value, such as those of cost or of learned maps, have figures only.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from thermorender.errors import ThermorenderError

_MK = 1e-3
# Largest rate of wrong names that the comparison states.
_STATED_RATE = 0.05


@dataclass(frozen=True)
class Verdict:
    """A case of a study.

    Attributes
    ----------
    scene : str
        The case in words.
    source : str
        Source of the expected value.
    expected_k, found_k, tolerance_k : float
        [K]
    seconds : float or None
        Run time of the case [s].
    """

    scene: str
    source: str
    expected_k: float
    found_k: float
    tolerance_k: float
    seconds: float | None

    @property
    def share(self):
        """Error over tolerance; above 1 the case does not hold. NaN if there is no found value."""
        error = abs(self.found_k - self.expected_k)
        return error / self.tolerance_k if self.tolerance_k else (0.0 if error == 0.0 else float("inf"))

    @property
    def holds(self):
        """Whether the case holds; a case without a found value does not."""
        return self.share <= 1.0


@dataclass(frozen=True)
class Study:
    """A study and the paths of its results in the folder.

    Attributes
    ----------
    name : str
    module : str
        The package whose `__main__` runs it: `python -m MODULE`.
    title : str
    result : str
        Path of its JSON.
    figures : tuple of str
        Paths or patterns of its PNGs.
    read : callable or None
        (result) → list of Verdict; None without expected values.
    runs : bool
        Whether `python -m validation` runs it if it has no results; False if it needs further arguments, or hours.
    continues : bool
        Whether its command continues earlier results, and is fast if none are missing.
    """

    name: str
    module: str
    title: str
    result: str
    figures: tuple = ()
    read: Callable | None = None
    runs: bool = True
    continues: bool = False


# Sources of the expected values of stability, by group.
_SOURCES = {"faults": "the same work undisturbed, counts of deviations", "precision": "the same code in double"}


def _stability(found):
    """Cases at the edge; the tolerance is that of each case."""
    return [Verdict(f"{each['group']}: {each['name']}",
                    _SOURCES.get(each["group"], "closed form or limit, stated in the case's code"),
                    each["expected_k"], float("nan") if each["raised"] else each["found_k"], each["tolerance_k"],
                    each["seconds"]) for each in found["cases"]]  # fmt: skip


def _convergence(found):
    """Frames of the named qualities against path tracing; the tolerance is each frame's own error estimate."""
    presets = ("(fast)", "(standard)", "(high)")
    return [Verdict(f"{each['scene']}, {each['view']}, {each['setting']}", "path tracing by stock Mitsuba, RMS", 0.0,
                    _MK * each["error_mk"], _MK * each["budget_mk"], each["seconds"])
            for each in found["cases"].values()
            if each.get("engine") == "thermorender" and each.get("group") == "sampling"
            and each["setting"].endswith(presets)]  # fmt: skip


def _air(found):
    """Channels of the air against every node of its table; the tolerance is the plan's estimate."""
    return [Verdict(f"{found['scene']}, {each['height_m']:g} m, {each['view']}, {each['nodes']} nodes",
                    "all nodes of the table, RMS of a frame", 0.0, _MK * each["error_mk"],
                    _MK * each["planned_mk"], _MK * each["frame_ms"]) for each in found["cases"]]  # fmt: skip


def _sensor(found):
    """Lag as a flight models it, the first setting of each motion; the tolerance is the frame's own estimate."""
    verdicts = []
    for motion, cases in found["lag"].items():
        used = next((each for each in cases if each["estimate_mk"] is not None), None)
        if used is None:
            continue
        verdicts.append(Verdict(f"{found['camera']}, {motion}, {used['renders']} renders",
                                "64 renders per time constant, RMS of a frame", 0.0, _MK * used["all_mk"],
                                _MK * used["estimate_mk"], _MK * used["ms"]))  # fmt: skip
    return verdicts


def _heat(found):
    """Mean absolute errors of the heat balance by day and by night; the tolerance is the aim."""
    return [Verdict(f"{site['title']}, {part}", "measured surface temperature, mean absolute error", 0.0,
                    site["scores"]["balance"][part]["mae"], aim, site["seconds"])
            for site in found["sites"].values() if site["aim_k"]
            for part, aim in zip(("day", "night"), site["aim_k"], strict=True)
            # A site may have no night, or no measurements at night.
            if np.isfinite(site["scores"]["balance"].get(part, {}).get("mae", np.nan))]  # fmt: skip


def _moved(found):
    """Maps moved to another hour; the tolerance is their stated standard deviation."""
    return [Verdict(name, "truth of procedural scenes, mean absolute error", 0.0, each["mae_k"]["moved"],
                    each["stated_k"], None) for name, each in found["all"].items()]  # fmt: skip


def _budget(found):
    """Frames of the chosen views against 256 rays per pixel; the tolerance is each frame's own estimate."""
    source = "256 rays per pixel of the same light, RMS"
    return [Verdict(f"{each['scene']}, {each['view']}, {each['quality']}", source, 0.0, _MK * each["true_mk"],
                    _MK * each["stated_mk"], _MK * each["frame_ms"])
            for each in found["cases"].values() if not each["drawn"]]  # fmt: skip


def _totals(found):
    """Whole frames against path tracing; the tolerance is each frame's own total."""
    return [Verdict(name, "path tracing, RMS", 0.0, _MK * each["true_mk"], _MK * each["stated_mk"], each["seconds"])
            for name, each in found["cases"].items()]  # fmt: skip


def _fuzz(found):
    """Damaged files by reader; no fault is allowed: no foreign error, non-finite number, hanging or crash."""
    verdicts = []
    for reader, of in found["counts"].items():
        ends = sum(count for kind, count in of.items() if kind not in ("rendered", "unfit"))
        what = f"{reader}: {ends} damaged files, {of.get('accepted', 0)} read, {of.get('rendered', 0)} rendered"
        faults = sum(fault["reader"] == reader for fault in found["faults"])
        verdicts.append(Verdict(what, "a sentence or finite numbers; count of others", 0.0, faults, 0.0, None))
    return verdicts


def _referee(found):
    """Rates of wrong names, whose tolerance is the stated rate; and sizes of named offsets [K], the 90th percentile."""
    what = {"accused": "innocent frames that are accused, share", "also_wrong": "faults with a wrong name too, share"}
    verdicts = [Verdict(words, "planted faults and innocent frames on unseen lands", 0.0,
                        found["rates"][name]["count"] / found["rates"][name]["of"], _STATED_RATE, None)
                for name, words in what.items()]  # fmt: skip
    off = [abs(case["sizes"][kind] - size) for case in found["comparisons"] for kind, size in case["planted"].items()
           if kind in ("offset", "material") and kind in case["named"] and kind in case["sizes"]]  # fmt: skip
    if off:
        verdicts.append(Verdict("named offsets, 90 % of errors below", "the planted offset", 0.0,
                                float(np.percentile(off, 90)), 0.1, None))  # fmt: skip
    return verdicts


def _edits(found):
    """Previews of edits against their solutions; the tolerance is the largest error that each preview states."""
    source = "the solution of the edit, largest difference"
    return [Verdict(f"{case['scene']}, {case['quality']}, {case['kind']}", source, 0.0, _MK * worst["true_mk"],
                    _MK * worst["stated_mk"], _MK * worst["preview_ms"])
            for case in found["cases"]
            for worst in [max((edit for edit in case["edits"] if "true_mk" in edit),
                              key=lambda edit: edit["true_mk"] / edit["stated_mk"])]]  # fmt: skip


STUDIES = (
    Study("stability", "tests.robustness", "Cases at the edge", "stability/stability.json", (), _stability),
    Study("fuzz", "tests.robustness", "Damaged files", "fuzz/fuzz.json", (), _fuzz, runs=False),
    Study("convergence", "validation.convergence", "Frames against path tracing", "convergence/convergence.json",
          ("convergence/convergence_*.png",), _convergence, continues=True),
    Study("budget", "validation.budget", "Stated against true sampling error", "budget/budget.json",
          ("budget/budget.png",), _budget, continues=True),
    Study("totals", "validation.totals", "Stated against true total error", "totals/totals.json", (), _totals,
          continues=True),
    Study("targets", "validation.targets", "Small and far targets", "targets/targets.json"),
    Study("air", "validation.air", "Spectral channels of the air", "air/air.json", ("air/*.png",), _air),
    Study("soundings", "validation.soundings", "The air of the weather against whole soundings",
          "soundings/soundings.json", runs=False),
    Study("sensor", "validation.sensor", "Lag and blur of the camera", "sensor/sensor.json",
          ("sensor/sensor.png", "sensor/effects.png"), _sensor),
    Study("heat", "validation.heat", "The heat balance against measurements", "heat/heat.json", ("heat/heat.png",),
          _heat),
    Study("longwave", "validation.longwave", "The sky's long-wave against pyrgeometers", "longwave/longwave.json",
          runs=False),
    Study("courtyard", "validation.courtyard", "Walls of a courtyard against radiometers by direction",
          "courtyard/courtyard.json", runs=False),
    Study("moved", "validation.moved", "Learned maps at another hour", "moved/moved.json", ("moved/moved.png",),
          _moved),
    Study("three_d", "validation.three_d", "What a draped orthophoto costs", "three_d/three_d.json", runs=False),
    Study("horizon", "validation.horizon", "Frames toward the horizon, by far ground", "horizon/horizon.json",
          runs=False),
    Study("tiled_world", "validation.tiled_world", "Ground of any size in tiles", "tiled_world/tiled_world.json",
          runs=False),
    Study("heights", "validation.heights", "Error against run time by height", "heights/heights.json",
          ("heights/heights.png",), continues=True),
    Study("growth", "validation.growth", "Cost against size", "growth/growth.json", ("growth/growth.png",),
          continues=True),
    Study("edits", "validation.edits", "From an edit to its frame", "edits/edits.json", (), _edits, runs=False),
    Study("cluster", "validation.cluster", "Flights over many workers", "cluster/cluster.json",
          ("cluster/cluster.png",), runs=False),
    Study("maps", "validation.maps", "Learned maps on land, hours and weathers not trained on", "maps/maps.json",
          ("maps/*.png",)),
    Study("leaks", "validation.leaks", "Training pictures found in other pictures", "leaks/leaks.json", runs=False),
    Study("real_pairs", "validation.real_pairs", "Learned maps on real pairs", "real_pairs/real_pairs.json",
          runs=False),
    Study("referee", "validation.referee", "What a comparison names: planted faults and innocent frames",
          "referee/referee.json", ("referee/referee.png",), _referee, runs=False),
    Study("trainings", "validation.trainings", "Trainings of networks", "networks/campaign/trainings.json",
          ("networks/campaign/*.png",), runs=False),
    Study("inverse", "validation.inverse", "Maps from frames, by setting", "inverse/inverse.json", runs=False),
    Study("link", "validation.link", "The cost of the link to a simulator", "link/link.json", runs=False),
    Study("closed_loop", "validation.closed_loop", "What guided vehicles miss, by rendered and translated frames",
          "closed_loop/closed_loop.json", ("closed_loop/closed_loop.png",), runs=False),
    Study("landing", "examples.landing", "Landings by rendered and by translated frames", "landing/landing.json",
          ("landing/landing.png",), continues=True),
)  # fmt: skip


def gathered(folder):
    """Return [(Study, list of Verdict or None, machine or None)] of a folder; None for a study without results there.

    Raises
    ------
    ThermorenderError
        A file that is not a result of its study.
    """
    return [(study, *(verdicts_of(study, path) if path.is_file() else (None, None)))
            for study in STUDIES for path in [Path(folder) / study.result]]  # fmt: skip


def verdicts_of(study, path):
    """Return (list of Verdict, machine or None) of a Study's JSON file; the list is empty without expected values.

    Raises
    ------
    ThermorenderError
        The file is not a result of the study.
    """
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        verdicts = study.read(found) if study.read else []
        for each in verdicts:
            # Raises unless all values are numbers.
            _ = each.share
        return verdicts, found.get("machine")
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ThermorenderError(
            f"{path} is not a result of `python -m {study.module}` ({type(error).__name__}: {error}); "
            "remove it to run that study again"
        ) from None
