"""Faults from outside: the cases hold, each can fail, and the faults they found stay fixed."""

import errno
import os
import signal
import subprocess
import sys

import numpy as np
import pytest
from support import slow

from tests.robustness import cases, crash_targets, faults
from tests.robustness import run as stability
from thermorender import files, formats
from thermorender.apps.training.networks import checkpoint
from thermorender.errors import ThermorenderError
from thermorender.output.video import write_video

# Simulated flights and trainings take longer; the network's own tests kill one of these, too. Fewer frames than a
# thousand show growth from what is created once, not per frame; that fault is tested in test_flight.py.
SLOW = ("heat killed", "training killed", "1000 small frames")
# Timed cases need a quiet machine.
CASES = {
    name: job
    for group, name, job in cases.CASES
    if group == "faults" and not name.startswith(SLOW) and "core time" not in name
}


@pytest.fixture(scope="module", autouse=True)
def _fewer_kills():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(faults, "KILLS", 2)
        for name, (_, kind) in faults.LONG.items():
            patch.setitem(faults.LONG, name, (300, kind))
        yield
    for each in (faults.undisturbed, faults.killed, faults.long_flight):
        each.cache_clear()


# Cases with many processes, one after the other, or hundreds of frames.
LONG = (
    "killed at random", "two flights", "full at each", "clock goes", "has no right", "is killed: neither",
    "kernels on disk", "growth", "on a full disk: ends lost", "does not hold: flights refused", "inputs cut to nothing",
)  # fmt: skip


@pytest.mark.parametrize(
    "name",
    [
        *(name for name in CASES if not any(words in name for words in LONG)),
        *slow(*(name for name in CASES if any(words in name for words in LONG))),
    ],
)
def test_cases_of_faults_hold(name, capfd):
    found = stability.judged(CASES[name])
    assert found["passed"], found


def test_different_and_missing_files_are_counted():
    assert faults.differing({"a": b"1", "b": b"2", "c": b"3"}, {"a": b"1", "b": b"x", "d": b"4"}) == 3


def test_a_disk_that_fails_at_sync_is_reported(tmp_path, monkeypatch):
    def full(handle):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(os, "fsync", full)
    for code in (errno.ENOSPC, errno.EIO):  # noqa: B007
        with pytest.raises(ThermorenderError, match=r"did not reach the disk: .*; check the disk and continue"):
            files.on_disk(tmp_path)
    # A file system that does not sync folders.
    code = errno.EINVAL
    files.on_disk(tmp_path)


DYING = """
import sys, time
from pathlib import Path
from thermorender import files, formats
with files.atomic_folder(Path(sys.argv[1]), overwrite=True) as part:
    (part / "half").write_text("half")
    print("writing", flush=True)
    time.sleep(60)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="sends POSIX signals")
def test_partial_folders_of_killed_processes_are_removed_and_those_of_living_ones_kept(tmp_path):
    target = tmp_path / "a"
    dead = subprocess.Popen([sys.executable, "-c", DYING, target], stdout=subprocess.PIPE)
    assert dead.stdout.readline() == b"writing\n"
    dead.send_signal(signal.SIGKILL)
    dead.communicate()
    living = subprocess.Popen([sys.executable, "-c", DYING, target], stdout=subprocess.PIPE)
    assert living.stdout.readline() == b"writing\n"
    with pytest.raises(ThermorenderError, match="is being written by another process"), files.atomic_folder(target):
        pytest.fail("the block ran")
    living.kill()
    living.communicate()
    with files.atomic_folder(target) as part:
        (part / "whole").touch()
    assert [path.name for path in tmp_path.iterdir()] == ["a"] and [path.name for path in target.iterdir()] == ["whole"]


def test_a_flight_killed_at_its_first_files_leaves_nothing(tmp_path, monkeypatch):
    crash_targets.write_scene(tmp_path / "scene")
    # Before its folder is fully tested, and while its first file is written.
    with monkeypatch.context() as killed:
        killed.setattr(files, "_remove", lambda path: None)
        files.make_folder(tmp_path / "work" / "out")
    (tmp_path / "work" / "out" / ".flight.01234567.part.json").write_text("{")
    assert len(list((tmp_path / "work" / "out").iterdir())) == 2
    crash_targets.flight(tmp_path / "work", products=("counts",))
    assert not [path.name for path in (tmp_path / "work" / "out").iterdir() if path.name.startswith(".")]


def test_a_second_process_is_kept_out_of_a_running_study(tmp_path, call_module):
    with files.in_use(tmp_path):
        status, _, errors = call_module("validation.budget", "-o", tmp_path)
    assert status == 2 and "is being written by another process" in errors


def test_a_truncated_translation_is_made_again(tmp_path, call):
    formats.write_image(tmp_path / "in.png", np.random.default_rng(0).integers(0, 255, (40, 50, 3)).astype(np.uint8))
    arguments = ("translate", "fok-1to1", tmp_path / "in.png", "-o", tmp_path / "out")
    assert call(*arguments)[0] == 0
    whole = (tmp_path / "out" / "in.tif").read_bytes()
    (tmp_path / "out" / "in.tif").write_bytes(whole[:100])
    assert call(*arguments, "--resume")[0] == 0
    assert (tmp_path / "out" / "in.tif").read_bytes() == whole
    # Only once in the list, too.
    assert len((tmp_path / "out" / "translated.jsonl").read_text().splitlines()) == 1


def test_a_truncated_frame_of_a_translated_video_is_made_again(tmp_path, call):
    write_video(tmp_path / "in.mp4", crash_targets.images(tmp_path), 8.0)
    arguments = ("translate", "fok-1to1", tmp_path / "in.mp4", "-o", tmp_path / "out", "--frames")
    assert call(*arguments)[0] == 0
    frame = tmp_path / "out" / "in_frames" / "000001.tif"
    whole = frame.read_bytes()
    frame.write_bytes(whole[:100])
    assert call(*arguments, "--resume")[1].startswith("1 translated, in ")
    assert frame.read_bytes() == whole
    assert call(*arguments, "--resume")[1].startswith("0 translated, 1 done before, in ")


def test_a_translation_killed_before_its_record_leaves_nothing(tmp_path, call):
    formats.write_image(tmp_path / "in.png", np.full((40, 50, 3), 90, np.uint8))
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / ".translate.0123abcd.part.json").write_bytes(b"{")
    assert call("translate", "fok-1to1", tmp_path / "in.png", "-o", tmp_path / "out", "--resume")[0] == 0
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {"in.tif", "in.png", "translate.json", "translated.jsonl"}


def test_a_checkpoint_with_a_changed_number_is_refused(tmp_path):
    path = tmp_path / "last.safetensors"
    crash_targets.write_checkpoint(path)
    whole = path.read_bytes()
    for place in (len(whole) - 2, len(whole) // 2):
        changed = bytearray(whole)
        changed[place] ^= 0x40
        path.write_bytes(changed)
        with pytest.raises(ThermorenderError, match=r"is not a checkpoint of this training .its bytes are not those"):
            checkpoint.load(path, crash_targets.nets())
    path.write_bytes(whole)
    assert checkpoint.load(path, crash_targets.nets()) == {"crops": 1}
