"""Shared fixtures and options: measured data, the list of allowed skips, and one core per worker."""

import os

import pytest
from fixtures import _cache, _commands_built_once, call, call_module, run, short_heat  # noqa: F401
from hypothesis import HealthCheck, settings
from support import allowed_skips


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
