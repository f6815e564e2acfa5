"""Comparisons, evaluations and studies by the workers of a cluster: the results of one process."""

import importlib
import json
import re
from contextlib import nullcontext

import numpy as np
import pytest
from compare_support import flight, linear_map, make_dataset, structured, uniform_map
from typer.testing import CliRunner

import thermorender as tr
from scenes import coarse, write_terrain
from thermorender.apps.cluster import engine, workers
from thermorender.apps.cluster.workers import spreading
from thermorender.apps.compare.comparison import Options, compare
from thermorender.apps.compare.evaluation import evaluate
from thermorender.errors import ThermorenderError
from thermorender.learned.temperature_map import save_map
from validation.budget import study as budget
from validation.command import app_of
from validation.targets import study as targets

# What depends on the time that the work took.
TIMES = re.compile(r"(_s|seconds.*|peak_.*|once_s)$")


def untimed(value):
    """A result without its times."""
    if isinstance(value, dict):
        return {key: untimed(one) for key, one in value.items() if not TIMES.search(key)}
    return [untimed(one) for one in value] if isinstance(value, list) else value


@pytest.fixture
def in_process(monkeypatch):
    """Units done in this process where workers would do them, the last one first."""
    monkeypatch.setattr(workers, "connected", lambda address: nullcontext())
    monkeypatch.setattr(
        workers, "results", lambda client, do, units, *more: ((unit, do(unit)) for unit in reversed(units))
    )


@pytest.fixture(scope="module")
def by_workers(tmp_path_factory):
    """A function like `map` of two processes."""
    folder = tmp_path_factory.mktemp("spread")
    with spreading("local:2", folder / "out") as spread:
        yield spread
    assert list(folder.iterdir()) == []


def test_results_come_in_the_order_of_units_and_the_folder_of_the_work_is_removed(in_process, tmp_path):
    calls = []
    with spreading("local:2", tmp_path / "new" / "out") as spread:
        assert [*spread(lambda number: number**2, range(5))] == [0, 1, 4, 9, 16]
        offset = 3
        for value in spread(lambda number: number + offset, [10, 20]):
            calls.append(value)
        (place,) = (tmp_path / "new").iterdir()
        assert place.name.startswith(".out.") and place.stat().st_mode & 0o777 == 0o700
        assert len([*place.iterdir()]) == 2
    assert calls == [13, 23] and not (tmp_path / "new").exists()


def test_a_unit_that_fails_is_one_sentence_with_its_worker(in_process, tmp_path):
    def refuse(number):
        raise ThermorenderError(f"unit {number} is not allowed; give another")

    with pytest.raises(ThermorenderError, match=r"^\d+@\S+: unit 2 is not allowed; give another$"):
        with spreading("local:2", tmp_path / "out") as spread:
            list(spread(refuse, range(3)))
    with pytest.raises(ThermorenderError, match=r"^\d+@\S+: ZeroDivisionError: .*zero$"):
        with spreading("local:2", tmp_path / "out") as spread:
            list(spread(lambda number: 1 // number, range(3)))


def test_changed_work_is_refused(in_process, tmp_path):
    with spreading("local:2", tmp_path / "out") as spread:
        found = spread(lambda number: number, [1])
        plain = engine.unpickled
        with pytest.MonkeyPatch.context() as patch:

            def changed(path, checksum):
                path.write_bytes(path.read_bytes() + b"x")
                return plain(path, checksum)

            patch.setattr(engine, "unpickled", changed)
            with pytest.raises(ThermorenderError, match="is not the file of this work; stop other processes"):
                list(found)


@pytest.mark.slow
def test_pairs_are_scored_alike_in_any_order(in_process, tmp_path):
    with spreading("local:2", tmp_path / "two") as spread:
        same_evaluation(spread, tmp_path)


@pytest.mark.parametrize(("verb", "more"), [
    ("evaluate", ("fok-1to1", "--dataset", "d")), ("compare", ("heath",)), ("targets", ()), ("budget", ()),
    ("soundings", ("file.txt",)), ("longwave", ("--data", "d")), ("heat", ("--data", "d")),
])  # fmt: skip
def test_commands_take_a_cluster(call, tmp_path, monkeypatch, verb, more):
    monkeypatch.chdir(tmp_path)
    if verb in ("evaluate", "compare"):
        status, _, errors = call(verb, *more, "-o", "out/here", "--cluster", "here")
        assert status == 2 and "cluster='here' is not allowed; give local:N" in errors
        return
    main = importlib.import_module(f"validation.{verb}.__main__").main
    with pytest.raises(ThermorenderError, match="cluster='here' is not allowed; give local:N"):
        CliRunner().invoke(app_of(main), [*more, "-o", "out/here", "--cluster", "here"], catch_exceptions=False)


def same_evaluation(spread, folder):
    dataset = make_dataset(folder / "d", pairs=5, test=3)
    save_map(linear_map(), folder / "linear.npz")
    models = [str(folder / "linear.npz"), "fok-1to1"]
    one = evaluate(dataset, models, folder / "one")
    two = evaluate(dataset, models, folder / "two", spread=spread)
    assert untimed(one) == untimed(two)
    cost = two["methods"]["linear"]
    assert cost["seconds_per_mpixel"] > 0.0 and cost["pairs"] == 3
    pictures = sorted(path.name for path in (folder / "one").glob("errors_*.png"))
    assert pictures
    for name in pictures:
        assert (folder / "one" / name).read_bytes() == (folder / "two" / name).read_bytes()


@pytest.mark.slow
def test_two_processes_evaluate_as_one(by_workers, tmp_path):
    same_evaluation(by_workers, tmp_path)


@pytest.mark.slow
def test_two_processes_compare_as_one(by_workers, tmp_path):
    ground = write_terrain(tmp_path / "ground", temperature=structured())
    level, options = uniform_map(tmp_path / "level.npz", 0.5), Options(arrays=True, settings={"rays": 8})
    one = compare([flight(ground, poses=2)], tmp_path / "one", [level, "fok-1to1"], options)
    two = compare([flight(ground, poses=2)], tmp_path / "two", [level, "fok-1to1"], options, spread=by_workers)
    assert {own["kind"] for own in one["methods"].values()} >= {"photograph", "true-materials"}
    assert untimed(json.loads(json.dumps(one))) == untimed(json.loads(json.dumps(two)))
    files = sorted(path.relative_to(tmp_path / "one") for path in (tmp_path / "one").rglob("*.*"))
    assert files == sorted(path.relative_to(tmp_path / "two") for path in (tmp_path / "two").rglob("*.*"))
    for path in files:
        # Run times differ.
        if path.suffix not in (".json", ".html") and path.stem != "error-and-time":
            assert (tmp_path / "one" / path).read_bytes() == (tmp_path / "two" / path).read_bytes(), path
    assert not (tmp_path / ".two.frames").exists()


@pytest.mark.slow
def test_two_processes_study_as_one(by_workers):
    few = {"places": 1, "targets": ("car", "fire"), "views": ((120, -90), (400, -30))}
    one, two = targets.run(**few), targets.run(**few, spread=by_workers)
    assert untimed(one) == untimed(two) and len(one["cases"]) == 4


@pytest.mark.slow
def test_two_processes_continue_a_study_as_one(by_workers, tmp_path, monkeypatch):
    monkeypatch.setattr(budget.scenes, "CHOSEN", ((12, -90),))
    monkeypatch.setattr(budget.scenes, "HEIGHTS_M", (20.0, 60.0))
    monkeypatch.setattr(budget.scenes, "made", lambda seed: [])
    folder = write_terrain(tmp_path / "tiny", height=np.random.default_rng(1).uniform(0, 1, (32, 32)))
    scene = coarse(tr.load_scene(folder), 8)
    monkeypatch.setattr(budget, "load_drape", lambda name: scene)
    few = {"scene_names": ("tiny",), "drawn": 2, "qualities": ("fast",)}
    one = budget.run(tmp_path / "one", **few)
    kept = dict(list(one.items())[:1])
    (tmp_path / "two").mkdir()
    (tmp_path / "two/budget.json").write_text(json.dumps({"cases": kept}))
    done = []
    two = budget.run(
        tmp_path / "two", **few, spread=lambda do, units: done.append(len(units)) or by_workers(do, units)
    )  # fmt: skip
    assert done == [2] and list(one) == list(two) and len(one) == 3
    for name, case in one.items():
        assert {**two[name], "frame_ms": 0.0} == {**case, "frame_ms": 0.0}
