"""Stability cases hold, and are written on one page."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from tests.robustness import cases, heat
from tests.robustness import run as stability
from tests.robustness.__main__ import main
from tests.robustness.cases import Found
from thermorender.errors import ThermorenderError
from validation.command import app_of


@pytest.mark.slow
def test_all_but_heat_hold_and_are_written(tmp_path):
    groups = ("light", "sensor", "air", "maps", "pixels", "precision", "geometry", "motion", "solver")
    done = CliRunner().invoke(app_of(main), [*groups, "-o", str(tmp_path)], catch_exceptions=False)
    assert done.exit_code == 0 and "0 of " in done.output and "FAILS" not in done.output
    result = json.loads((tmp_path / "stability.json").read_text("utf-8"))
    assert result["failed"] == 0 and {case["group"] for case in result["cases"]} == set(groups)
    page = (tmp_path / "stability.md").read_text("utf-8")
    assert page.count("holds |") == len(result["cases"]) and "## sensor" in page


@pytest.fixture
def fresh_caches():
    """Days that several cases share are simulated again, now and afterwards."""
    kept = (heat.everything, heat.fine, heat.stepped, heat.answer_error)
    for each in kept:
        each.cache_clear()
    yield
    for each in kept:
        each.cache_clear()


def own_cases(*words, group="heat"):
    """The cases of a group whose name contains one of some words, as {name: result of `judged`}."""
    return {
        name: stability.judged(job)
        for own, name, job in cases.CASES
        if own == group and any(word in name for word in words)
    }


@pytest.mark.slow
def test_heat_holds(fresh_caches):
    found = {name: stability.judged(job) for group, name, job in cases.CASES if group == "heat"}
    assert len(found) > 40 and [name for name, each in found.items() if not each["passed"]] == []


def raises():
    raise ZeroDivisionError("by nothing")


@pytest.mark.parametrize(
    ("job", "passed"),
    [(lambda: Found(300.0005, 300.0, 1e-3), True), (lambda: Found(300.002, 300.0, 1e-3), False),
     (lambda: Found(np.nan, 300.0, 1e-3), False), (lambda: Found(300.0, 300.0, np.inf), False), (raises, False)],
)  # fmt: skip
def test_verdicts_and_exit_status(job, passed, tmp_path, monkeypatch, call_module):
    monkeypatch.setattr(cases, "CASES", [("light", "made up", job)])
    monkeypatch.setattr(stability, "CASES", cases.CASES)
    status, output, _ = call_module("tests.robustness", "-o", tmp_path)
    assert status == (0 if passed else 1) and ("FAILS" in output) != passed
    json.loads((tmp_path / "stability.json").read_text("utf-8"))
    if job is raises:
        assert "ZeroDivisionError: by nothing" in output


def test_an_unknown_group_is_named():
    with pytest.raises(ThermorenderError, match="group 'heats' is unknown; give some of air, faults, geometry, heat"):
        stability.run(["heats"])
