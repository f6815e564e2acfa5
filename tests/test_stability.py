"""Stability cases hold, and are told on one page."""

import json

import numpy as np
import pytest

from thermorender.errors import ThermorenderError
from thermorender.validate import stability
from thermorender.validate.stability import cases, heat
from thermorender.validate.stability.cases import Found


def test_all_but_heat_hold_and_are_written(tmp_path, call):
    groups = ("light", "sensor", "air", "maps", "pixels", "precision", "geometry", "motion", "solver")
    status, output, _ = call("validate", "stability", *groups, "-o", tmp_path)
    assert status == 0 and "0 of " in output and "FAILS" not in output
    result = json.loads((tmp_path / "stability.json").read_text("utf-8"))
    assert result["failed"] == 0 and {case["group"] for case in result["cases"]} == set(groups)
    page = (tmp_path / "stability.md").read_text("utf-8")
    assert page.count("holds |") == len(result["cases"]) and "## sensor" in page


@pytest.fixture
def anew():
    """Days that are kept for several cases are marched again, now and afterwards."""
    kept = (heat.everything, heat.fine, heat.stepped, heat.answer_error)
    for each in kept:
        each.cache_clear()
    yield
    for each in kept:
        each.cache_clear()


def test_heat_holds(anew):
    found = {name: stability.judged(job) for group, name, job in cases.CASES if group == "heat"}
    assert len(found) > 40 and [name for name, each in found.items() if not each["passed"]] == []


def raises():
    raise ZeroDivisionError("by nothing")


@pytest.mark.parametrize(
    ("job", "passed"),
    [(lambda: Found(300.0005, 300.0, 1e-3), True), (lambda: Found(300.002, 300.0, 1e-3), False),
     (lambda: Found(np.nan, 300.0, 1e-3), False), (lambda: Found(300.0, 300.0, np.inf), False), (raises, False)],
)  # fmt: skip
def test_verdicts(job, passed, tmp_path, monkeypatch, call):
    monkeypatch.setattr(cases, "CASES", [("light", "made up", job)])
    monkeypatch.setattr(stability, "CASES", cases.CASES)
    status, output, _ = call("validate", "stability", "-o", tmp_path)
    assert status == (0 if passed else 1) and ("FAILS" in output) != passed
    json.loads((tmp_path / "stability.json").read_text("utf-8"))
    if job is raises:
        assert "ZeroDivisionError: by nothing" in output


def test_an_unknown_group_is_named():
    with pytest.raises(ThermorenderError, match="group 'heats' is unknown; give some of air, faults, geometry, heat"):
        stability.run(["heats"])
