"""Fixtures of the tests and of the studies' tests: a cache of their own, and the command line in this process."""

import functools
import os
import signal
import sys

import pytest
import typer


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


@pytest.fixture(scope="module")
def short_heat():
    """Short simulations of the heat balance for a whole module, whose subject is not their accuracy."""
    from heat_support import short_simulations

    with short_simulations():
        yield


# --- which tests may be skipped ---------------------------------------------------------------------------
