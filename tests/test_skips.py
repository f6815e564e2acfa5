"""What the check itself checks: skips that no list names, data without a source, rooms that no test visits."""

import json
import re
import subprocess
import sys
from pathlib import Path

import coverage_of_rooms
import pytest
from conftest import HERE, allowed_skips

SKIPPED = "import pytest\ndef test_a(): pytest.skip('no data')"


@pytest.mark.parametrize(
    ("body", "listed", "status", "words"),
    [
        (SKIPPED, "", 1, "SKIPPED AND NOT IN .*test_x.py::test_a.*no data"),
        (SKIPPED, "test_x.py::test_a: none here", 0, "1 skipped"),
        ("import pytest\n@pytest.mark.parametrize('n', [1, 2])\ndef test_a(n): pytest.skip('no data')",
         "test_x.py::test_a: none here", 0, "2 skipped"),
        ("import pytest\npytest.importorskip('no_such_module')\ndef test_a(): pass", "", 1, "SKIPPED AND NOT IN"),
        ("def test_a(): pass", "", 0, "2 passed"),
    ],
)  # fmt: skip
def test_only_listed_tests_may_be_skipped(tmp_path, body, listed, status, words):
    (tmp_path / "conftest.py").write_text((HERE / "conftest.py").read_text("utf-8"), "utf-8")
    (tmp_path / "test_x.py").write_text(f"{body}\n")
    (tmp_path / "test_y.py").write_text("def test_b(): pass\n")
    (tmp_path / "allowed_skips.txt").write_text(f"# why\n{listed}\n")
    (tmp_path / "pytest.ini").write_text("[pytest]\n")
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "--rootdir", str(tmp_path), str(tmp_path)]
    run = subprocess.run([*command, "--listed-skips-only"], capture_output=True, text=True, cwd=tmp_path)
    assert run.returncode == status, run.stdout
    assert re.search(words, run.stdout), run.stdout
    if status:
        # Without the option, as on a user's machine, a skip is none of CI's business.
        environment = {"PATH": "", "PYTHONPATH": ":".join(sys.path)}
        run = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=environment)
        assert run.returncode == 0, run.stdout


@pytest.mark.parametrize("body", [SKIPPED, "import pytest\npytest.importorskip('no_such_module')"])
def test_skips_in_workers_are_seen_too(tmp_path, body):
    (tmp_path / "conftest.py").write_text((HERE / "conftest.py").read_text("utf-8"), "utf-8")
    (tmp_path / "test_x.py").write_text(f"{body}\n")
    (tmp_path / "allowed_skips.txt").write_text("")
    (tmp_path / "pytest.ini").write_text("[pytest]\n")
    command = [sys.executable, "-m", "pytest", "-n", "1", "-p", "no:cacheprovider", "--listed-skips-only"]
    run = subprocess.run([*command, "--rootdir", str(tmp_path), str(tmp_path)], capture_output=True, text=True)
    assert run.returncode and "SKIPPED AND NOT IN allowed_skips.txt" in run.stdout, run.stdout


def test_the_list_names_tests_that_exist_and_says_why():
    for name, reason in allowed_skips().items():
        file, _, function = name.partition("::")
        assert re.search(rf"^def {function}\(", (HERE / file).read_text("utf-8"), re.M), name
        assert len(reason) > 20, name


def test_data_of_the_tests_is_small_and_each_file_has_its_source():
    folder = Path(HERE, "data")
    files = [path for path in folder.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) < 3_000_000
    told = (folder / "README.md").read_text("utf-8")
    for path in files:
        name = path.relative_to(folder).as_posix()
        assert name == "README.md" or name in told or f"{path.parent.relative_to(folder).as_posix()}/" in told, name


@pytest.mark.parametrize(("covered", "status"), [(17, 0), (16, 1)])
def test_a_room_below_the_floor_is_red(tmp_path, capsys, covered, status):
    files = {
        "thermorender/scene/load.py": (covered - 8, 10), "thermorender/scene/procedural/heat.py": (8, 10),
        "/somewhere/thermorender/thermorender/sensor/noise.py": (50, 50), "thermorender/cli.py": (9, 10),
        "thermorender/scene/__init__.py": (0, 0),
    }  # fmt: skip
    report = {
        "files": {
            name: {"summary": {"covered_lines": seen, "num_statements": lines}} for name, (seen, lines) in files.items()
        }
    }
    (tmp_path / "c.json").write_text(json.dumps(report))
    assert coverage_of_rooms.main(tmp_path / "c.json") == status
    rows = {line.split()[0]: line for line in capsys.readouterr().out.splitlines()[1:]}
    assert list(rows) == ["scene", "sensor", "thermorender"] and "100.0 %" in rows["sensor"]
    assert ("below 85 %" in rows["scene"]) == bool(status) and f"{5 * covered:.1f} %" in rows["scene"]
