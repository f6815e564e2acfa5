"""The page of all studies: cases are read from results and get a verdict."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

from thermorender.errors import ThermorenderError
from validation.command import app_of
from validation.page import PAGE, rows, write_page
from validation.verdicts import STUDIES, Verdict, gathered

SHIPPED = Path(__file__).parents[1] / "validation"


@pytest.mark.parametrize(
    ("found", "allowed", "holds"),
    [(1.0, 0.0, True), (1.5, 0.5, True), (0.4, 0.5, False), (1.1, 0.0, False), (np.nan, 1.0, False),
     (np.inf, 1.0, False)],
)  # fmt: skip
def test_a_case_holds_if_its_error_is_within_the_tolerance(found, allowed, holds):
    assert Verdict("a scene", "a source", 1.0, found, allowed, None).holds == holds


def stability(folder, found_k, raised=None):
    (folder / "stability").mkdir(exist_ok=True)
    case = {"group": "air", "name": "a <b>wall</b>", "expected_k": 290.0, "found_k": found_k, "tolerance_k": 1e-3,
            "seconds": 0.5, "raised": raised}  # fmt: skip
    (folder / "stability/stability.json").write_text(json.dumps({"cases": [case], "machine": None}))


def test_the_page_shows_failures_and_studies_without_results(tmp_path):
    stability(tmp_path, 290.01)
    summary = rows(write_page(tmp_path))
    assert summary[0] == ("stability", "1", "0", "10.00", "0.5")
    assert all(row[1] == "not run" for row in summary[1:])
    page = (tmp_path / PAGE).read_text()
    assert "does not hold" in page and "class=grave" in page and "<b>wall" not in page
    stability(tmp_path, 290.0005)
    assert rows(write_page(tmp_path))[0][:3] == ("stability", "1", "1")
    stability(tmp_path, 290.0, raised="ValueError")
    assert rows(write_page(tmp_path))[0][2:4] == ("0", "nan")


def test_a_file_that_is_not_a_result_is_refused(tmp_path):
    (tmp_path / "heat").mkdir()
    (tmp_path / "heat/heat.json").write_text('{"sites": 3}')
    with pytest.raises(ThermorenderError, match=r"heat\.json is not a result of `python -m validation.heat`"):
        gathered(tmp_path)


def test_shipped_results_are_read_with_their_figures():
    """Every study with results in the repository has verdicts if it has expected values."""
    found = {study.name: verdicts for study, verdicts, _ in gathered(SHIPPED)}
    assert set(found) == {study.name for study in STUDIES}
    for study in STUDIES:
        if found[study.name] is not None:
            assert bool(found[study.name]) == (study.read is not None), study.name
            assert all(list(SHIPPED.glob(pattern)) for pattern in study.figures), study.name
    stated = json.loads((SHIPPED / "heat/heat.json").read_text())["sites"]["grass"]
    night = next(each for each in found["heat"] if each.scene == f"{stated['title']}, night")
    assert night.found_k == stated["scores"]["balance"]["night"]["mae"] and night.tolerance_k == stated["aim_k"][1]


def test_the_page_runs_studies_without_results(tmp_path, monkeypatch):
    from validation import __main__ as runner

    ran = []

    def fake(name):
        def run(output):
            ran.append((name.removesuffix(".__main__"), output))
            if name == "tests.robustness.__main__":
                output.mkdir()
                stability(tmp_path, 290.0)

        return SimpleNamespace(main=run)

    monkeypatch.setattr(runner, "import_module", fake)
    done = CliRunner().invoke(app_of(runner.main), ["-o", str(tmp_path)], catch_exceptions=False)
    every = {study.module for study in STUDIES if study.runs and study.name not in ("heat", "maps")}
    assert {name for name, _ in ran} == every
    assert dict(ran)["validation.convergence"] == tmp_path / "convergence"
    assert dict(ran)["examples.landing"] == tmp_path / "landing"
    assert done.exit_code == 0 and "page in" in done.output and (tmp_path / PAGE).is_file()
    ran.clear()
    CliRunner().invoke(app_of(runner.main), ["-o", str(tmp_path)], catch_exceptions=False)
    assert "tests.robustness" not in {name for name, _ in ran} and "validation.budget" in {name for name, _ in ran}
