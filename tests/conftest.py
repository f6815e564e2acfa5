"""Shared fixtures and options: measured data, the list of allowed skips, and one core per worker."""

import atexit
import functools
import os
import shutil
import signal
import sys
import tarfile
import tempfile
from pathlib import Path

import pytest
import typer
from hypothesis import HealthCheck, settings


def _take_one_core():
    """Bind a worker of pytest-xdist to one core and one thread; other processes keep all of theirs.

    Two processes with one core each are faster than one with two. NumPy, torch and Dr.Jit read these settings when they
    are imported, so this runs before any of them is.
    """
    worker = os.environ.get("PYTEST_XDIST_WORKER", "")
    if not worker.startswith("gw"):
        return
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = "1"
    if hasattr(os, "sched_setaffinity"):  # Linux only; Dr.Jit starts as many threads as the process has cores
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {cores[int(worker[2:]) % len(cores)]})


_take_one_core()

# Number of examples for Hypothesis; `--hypothesis-profile slow` tries many. The examples are always the same, so that a
# green test stays green.
for name, count in (("default", 15), ("slow", 60)):
    settings.register_profile(
        name, derandomize=True, database=None, deadline=None, max_examples=count,
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
    )  # fmt: skip
settings.load_profile("default")


def slow(*cases):
    """Return cases of a parametrised test, each a value or a tuple of values, marked as slow."""
    return [pytest.param(*(case if isinstance(case, tuple) else (case,)), marks=pytest.mark.slow) for case in cases]


HERE = Path(__file__).resolve().parent
# Data that may be redistributed is in tests/data; the rest is looked for here.
DATA = Path(os.environ.get("THERMORENDER_DATA", HERE.parents[1] / "shared" / "data"))


@pytest.fixture(scope="session", autouse=True)
def _cache(tmp_path_factory):
    """Keep the tests' traced light out of the user's own cache."""
    before = os.environ.get("THERMORENDER_CACHE")
    os.environ["THERMORENDER_CACHE"] = str(tmp_path_factory.mktemp("cache"))
    yield
    os.environ.pop("THERMORENDER_CACHE")
    if before is not None:
        os.environ["THERMORENDER_CACHE"] = before


@pytest.fixture(scope="session", autouse=True)
def _commands_built_once():
    """Build each command line once per process instead of at each call."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(typer.main, "get_command", functools.cache(typer.main.get_command))
        yield


@pytest.fixture
def call(monkeypatch, capfd):
    """Run the command line in this process; return (status, output, errors)."""
    from thermorender.cli.app import main

    # The command line installs a signal handler for the whole process.
    ending = signal.getsignal(signal.SIGTERM)

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["thermorender", *map(str, arguments)])
        capfd.readouterr()
        with pytest.raises(SystemExit) as exit:
            main()
        return exit.value.code, *capfd.readouterr()

    yield run
    signal.signal(signal.SIGTERM, ending)


@pytest.fixture
def call_module(monkeypatch, capfd):
    """Run `python -m MODULE` in this process; return (status, output, errors)."""
    from importlib import import_module

    from validation.command import run_command

    def run(module, *arguments):
        monkeypatch.setattr(sys, "argv", [module, *map(str, arguments)])
        capfd.readouterr()
        with pytest.raises(SystemExit) as exit:
            run_command(import_module(f"{module}.__main__").main)
        return exit.value.code, *capfd.readouterr()

    return run


@pytest.fixture
def run(call):
    """Run `thermorender materials …`; return (status, output, errors)."""
    return lambda *arguments: call("materials", *arguments)


def shared_data(path):
    """Path of a file or folder of the real data sets, or a skip that says where it was looked for."""
    for folder in (HERE / "data", _unpacked(), DATA):
        if (folder / path).exists():
            return folder / path
    pytest.skip(f"real data not present: {DATA / path} (set THERMORENDER_DATA to the folder that holds it)")


@functools.cache
def _unpacked():
    """Temporary folder with the contents of `data/**/NAME.tar.xz`, each as `**/NAME/`."""
    folder = Path(tempfile.mkdtemp(prefix="thermorender-tests-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    for archive in (HERE / "data").rglob("*.tar.xz"):
        with tarfile.open(archive) as tar:
            tar.extractall(folder / archive.relative_to(HERE / "data").with_suffix("").with_suffix(""), filter="data")
    return folder


# --- which tests may be skipped ---------------------------------------------------------------------------


def allowed_skips(path=HERE / "allowed_skips.txt"):
    """{"file.py::test": reason} of the tests that may be skipped."""
    lines = [line.strip() for line in path.read_text(encoding="utf-8").splitlines()]
    return dict(line.split(": ", 1) for line in lines if line and not line.startswith("#"))


def pytest_addoption(parser):
    parser.addoption(
        "--listed-skips-only", action="store_true", default=bool(os.environ.get("CI")),
        help="fail where a test is skipped that allowed_skips.txt does not name; default where CI is set",
    )  # fmt: skip


def pytest_configure(config):
    if config.getoption("--listed-skips-only"):
        config.pluginmanager.register(_ListedSkips())


class _ListedSkips:
    """Fails a run that skipped a test that is not on the list."""

    def __init__(self):
        self.unlisted = {}

    def pytest_runtest_logreport(self, report):
        if report.skipped and not hasattr(report, "wasxfail"):
            name = report.nodeid.partition("[")[0].rpartition("/")[2]
            if name not in allowed_skips():
                self.unlisted[report.nodeid] = report.longrepr[2]

    def pytest_collectreport(self, report):
        if report.skipped:
            self.unlisted[report.nodeid] = report.longrepr[2]

    def pytest_sessionfinish(self, session, exitstatus):
        if self.unlisted and exitstatus == pytest.ExitCode.OK:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(self, terminalreporter):
        for name, reason in self.unlisted.items():
            terminalreporter.write_line(f"SKIPPED AND NOT IN allowed_skips.txt: {name}: {reason}", red=True)
