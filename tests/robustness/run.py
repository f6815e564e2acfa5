"""Cases at the limits, each with expected value, tolerance in kelvin and a verdict.

A study adds its cases with `cases.case` in a module of this folder, which is listed in `_GROUPS`.
"""

import time

import numpy as np

from tests.robustness import (
    air,
    faults,
    geometry,
    heat,
    light,
    maps,
    motion,
    pixels,
    precision,
    sensor,
    solver,
)
from tests.robustness.cases import CASES
from thermorender import formats
from thermorender.apps.compare.machine import machine
from thermorender.errors import ThermorenderError
from thermorender.versions import versions

_GROUPS = (air, faults, geometry, heat, light, maps, motion, pixels, precision, sensor, solver)
HEADER = ("case", "expected [K]", "found [K]", "error [K]", "allowed [K]", "verdict", "time [s]")
_FORMS = (("expected_k", "{:.6g}"), ("found_k", "{:.6g}"), ("error_k", "{:.1e}"), ("tolerance_k", "{:.1e}"))


def run(groups=(), progress=None):
    """Return the results of every case, or of some groups; plain numbers.

    Parameters
    ----------
    groups : sequence of str
        Some of "air", "heat", "light", …; none: all.
    progress : callable, optional
        Called with (what, share done).

    Returns
    -------
    dict
        machine, versions, seconds, failed (how many), and cases: [{group, name, expected_k, found_k, error_k,
        tolerance_k, passed, seconds, raised}]. A case that raises an error has failed: its numbers are None, and
        `raised` is the error's message; otherwise `raised` is None.

    Raises
    ------
    ThermorenderError
        An unknown group.
    """
    known = sorted({group for group, _, _ in CASES})
    for group in groups:
        if group not in known:
            raise ThermorenderError(f"group {group!r} is unknown; give some of {', '.join(known)}")
    report = progress or (lambda what, share: None)
    chosen = [each for each in CASES if not groups or each[0] in groups]
    begin, cases = time.perf_counter(), []
    for number, (group, name, job) in enumerate(chosen):
        report(group, number / len(chosen))
        cases.append({"group": group, "name": name, **judged(job)})
    report("measured", 1.0)
    return {
        "machine": machine(), "versions": versions(), "seconds": time.perf_counter() - begin,
        "failed": sum(not case["passed"] for case in cases), "cases": cases,
    }  # fmt: skip


def judged(job):
    """Return a case's values and whether they are allowed, as in the result of `run`."""
    start, found, raised = time.perf_counter(), None, None
    try:
        found = job()
    except Exception as error:  # a case exists to show whatever breaks
        raised = f"{type(error).__name__}: {error}"
    seconds = time.perf_counter() - start
    numbers = dict.fromkeys(("expected_k", "found_k", "error_k", "tolerance_k"))
    passed = False
    if found is not None and np.isfinite(found).all():
        value, expected, tolerance = map(float, found)
        numbers = {"expected_k": expected, "found_k": value, "error_k": abs(value - expected), "tolerance_k": tolerance}
        passed = numbers["error_k"] <= tolerance
    return numbers | {"passed": passed, "seconds": seconds, "raised": raised}


def rows(result):
    """Return a result of `run` as rows of text under `HEADER`."""
    return [
        (f"{case['group']}: {case['name']}",
         *("" if case[key] is None else form.format(case[key]) for key, form in _FORMS),
         "holds" if case["passed"] else "FAILS" + (f" ({case['raised']})" if case["raised"] else ""),
         f"{case['seconds']:.2f}")
        for case in result["cases"]
    ]  # fmt: skip


def table(path, result):
    """Write a result as a page of Markdown."""
    held = len(result["cases"]) - result["failed"]
    lines = [
        "# Stability",
        "",
        f"{held} of {len(result['cases'])} cases hold, in {result['seconds']:.0f} s. A case holds if its value differs",
        "from the expected one by at most the allowed error, in kelvin or in the unit in its name. The code of each",
        "case derives the allowed error. Errors of steps are the largest of a day, and of some winds.",
    ]
    for group in dict.fromkeys(case["group"] for case in result["cases"]):
        cases = [case for case in result["cases"] if case["group"] == group]
        lines += ["", f"## {group}", ""]
        if group == "precision":
            lines += ["Kernels in single precision against double, largest difference first.", ""]
            cases.sort(key=lambda case: -np.inf if case["error_k"] is None else -case["error_k"])
        lines += [f"| {' | '.join(HEADER)} |", "|---" + "|--:" * 4 + "|---|--:|"]
        own = {**result, "cases": cases}
        lines += [f"| {' | '.join((row[0].partition(': ')[2], *row[1:]))} |" for row in rows(own)]
    formats.write_text(path, "\n".join(lines) + "\n")
