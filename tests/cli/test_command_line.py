"""Every verb: its help text, and outputs that are refused before any work."""

import re
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest
from support import hear_signals, slow

from thermorender.cli import registry
from thermorender.progress import progress


def verbs(command=None, path=()):
    """{words of the command line: click command} of every verb."""
    if command is not None and not hasattr(command, "commands"):
        return {path: command}
    children = command.commands if command else {name: registry.command(name) for name in registry.verbs()}
    below = (verbs(each, (*path, name)) for name, each in children.items())
    return {words: verb for found in below for words, verb in found.items()}


def outputs(verb):
    """Parameters of a verb that name a file or folder to be written."""
    return [parameter for parameter in verb.params if {"-o", "--into"} & set(parameter.opts)]


VERBS = verbs()
WRITING = [words for words, verb in VERBS.items() if outputs(verb)]


def with_option(name):
    return {words for words, verb in VERBS.items() for parameter in verb.params if name in parameter.opts}


def test_every_verb_is_found():
    assert {("render",), ("fly",), ("train",), ("bench",), ("materials", "merge")} <= set(VERBS)
    assert len(WRITING) >= 14
    logs = with_option("--trajectory")
    assert logs >= {("fly",), ("compare",)}
    # Every verb that takes a log has all options for logs. `translate --anchor` is of temperatures.
    for option in ("--format", "--anchor", "--duplicates", "--clock-offset-s", "--mount", "--lever-arm-m"):
        assert with_option(option) - {("translate",)} == logs, option


@pytest.mark.parametrize("words", VERBS, ids=" ".join)
def test_help_is_printed_in_full_with_units(words, call):
    status, output, errors = call(
        *words, "--help-all" if len(words) == 1 and not hasattr(VERBS[words], "commands") else "--help"
    )
    assert (status, errors) == (0, "")
    # The help text appears in full, units included, whatever the terminal's width and frames.
    shown = "".join(re.sub(r"[│╭╮╰╯─]", " ", output).split())
    verb = VERBS[words]
    for text in (verb.help, *(parameter.help for parameter in verb.params if getattr(parameter, "help", None))):
        assert "".join(text.split()) in shown


@pytest.mark.parametrize("name", ["fly", "compare"])
def test_help_of_long_verbs_fits_a_screen_and_names_every_option(name, call, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.setenv("TERMINAL_WIDTH", "100")
    status, output, _ = call(name, "--help")
    lines = output.splitlines()
    assert status == 0 and len(lines) <= 50 and max(map(len, lines)) <= 100
    options = {each.opts[0] for each in VERBS[name,].params if each.param_type_name == "option"}
    assert options <= set(re.findall(r"--?[a-z][a-z0-9-]*", output))


def test_some_help_has_units():
    texts = [parameter.help or "" for verb in VERBS.values() for parameter in verb.params if hasattr(parameter, "help")]
    units = {unit for text in texts for unit in re.findall(r"\[[^\]]+\]", text)}
    assert {"[m]", "[s]", "[deg]", "[mK]", "[K]", "[µm]"} <= units


@pytest.mark.parametrize("words", WRITING, ids=" ".join)
@pytest.mark.parametrize("where", ["below a file", "where nothing can be made"])
def test_outputs_are_refused_before_the_work(words, where, call, tmp_path):
    (tmp_path / "file").write_text("precious")
    if where == "below a file":
        folder = tmp_path / "file"
    elif Path("/proc/self").exists():
        folder = Path("/proc")
    else:
        pytest.skip("no folder that refuses even root: /proc is not here")
    verb = VERBS[words]
    (option,) = outputs(verb)
    # A verb that read its inputs first would report that they do not exist.
    inputs = ["none" for parameter in verb.params if parameter.param_type_name == "argument"]
    suffix = ".toml" if words == ("fit-camera",) else ".png" if words == ("materials", "plot") else ""
    output = folder / f"thermorender{suffix}"
    status, printed, errors = call(*words, *inputs, option.opts[0], output)
    assert status == 2 and printed == "", errors
    assert errors.startswith("error: ") and str(output) in errors and len(errors.splitlines()) == 1, errors
    assert (tmp_path / "file").read_text() == "precious"
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize(
    ("words", "output", "fragment"),
    [
        (("fit-camera",), "a.txt", "give one that ends in .toml"),
        (("materials", "plot"), "a.jpg", "give one that ends in .png"),
        (("materials", "plot"), "full", "give one that ends in .png"),
        (("bench",), "full", "is not an ordinary file"),
        (("train",), "full", "give one that ends in .npz"),
        (("make-scene",), "full", "exists and is not empty; give a new folder"),
        (("import-terrain",), "full", "exists and is not empty; give a new folder"),
        (("materials", "merge"), "full", "exists and is not empty; give a new folder"),
        (("render",), "full/file", "output folder"),
    ],
)
def test_outputs_of_the_wrong_kind_are_refused_before_any_work(words, output, fragment, call, tmp_path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").write_text("precious")
    inputs = ["none" for parameter in VERBS[words].params if parameter.param_type_name == "argument"]
    status, printed, errors = call(*words, *inputs, "-o", tmp_path / output)
    assert status == 2 and printed == "" and str(tmp_path / output) in errors and fragment in errors, errors
    assert (tmp_path / "full" / "file").read_text() == "precious"
    assert [path.name for path in tmp_path.rglob("*")] == ["full", "file"]


@pytest.mark.skipif(sys.platform == "win32", reason="sends POSIX signals")
@pytest.mark.parametrize("name", ["SIGTERM", *slow("SIGHUP")])
def test_terminated_process_cleans_up(tmp_path, name):
    """Terminated by SIGTERM, as `timeout`, `docker stop` and systemd do, or by the end of its terminal."""
    number = getattr(signal, name)
    folder = tmp_path / "new"
    land = ["make-scene", "heath", "--draped", "--size-m", "100", "-o", folder / "scene"]
    command = [sys.executable, "-m", "thermorender", *land]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, preexec_fn=hear_signals)
    begun = False
    while process.poll() is None and not begun:
        time.sleep(1e-3)
        # The folder may be renamed while glob reads it.
        with suppress(FileNotFoundError):
            begun = any(folder.glob(".scene*.part/*"))
    process.send_signal(number)
    _, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (128 + number, b"") and not folder.exists()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
def test_full_disk_on_standard_output_is_reported():
    with open("/dev/full", "w") as full:
        command = [sys.executable, "-m", "thermorender", "materials", "list"]
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True)
    assert done.returncode == 2 and done.stderr == (
        "error: the current folder or the standard output cannot be used: No space left on device; check that it is "
        "there, its permissions and the disk\n"
    )


def test_one_study_does_not_need_the_common_folder(tmp_path, call_module, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "validation").write_text("in the way")
    status, _, errors = call_module("validation.trainings", "nothing", "-o", "out")
    assert status == 2 and "nothing is not the folder of a training" in errors
    status, _, errors = call_module("validation")
    assert status == 2 and "output folder validation cannot be made: File exists" in errors


def test_a_warning_of_the_package_is_a_note_and_another_one_stays():
    code = (
        "import typer, warnings; from thermorender.cli.process import run; "
        "from thermorender.errors import ThermorenderWarning; app = typer.Typer()\n"
        "@app.command()\ndef verb():\n    warnings.warn('nothing moves', ThermorenderWarning)\n"
        "    warnings.warn('of a library', UserWarning)\nrun(app, ())"
    )
    made = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert made.returncode == 0 and "note: nothing moves\n" in made.stderr
    assert "UserWarning: of a library" in made.stderr and "ThermorenderWarning" not in made.stderr


def test_long_work_prints_lines_where_no_bar_can_be_drawn(capsys, monkeypatch):
    now = iter([0.0, 10.0, 31.0, 31.0, 40.0, 62.0, 62.0])
    monkeypatch.setattr("thermorender.progress.time.monotonic", lambda: next(now))
    with progress() as report:
        for share in (0.1, 0.4, 0.5, 0.9):
            report("light traced", share)
    assert capsys.readouterr().err == "light traced: 40%\nlight traced: 90%\n"
