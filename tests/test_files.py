"""Files and folders are written whole or not at all: after failures, interruptions and beside other processes."""

import errno
import gzip
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from support import hear_signals, slow

from thermorender import files, formats
from thermorender.cache import CACHED, cache_folder
from thermorender.errors import ThermorenderError


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_file_is_written_whole_or_left_as_it_was(tmp_path):
    target = tmp_path / "a.txt"
    target.write_text("before")
    with pytest.raises(ThermorenderError, match=r"a.txt cannot be written: no room; check the folder"):
        with files.atomic(target) as part:
            part.write_text("half")
            raise OSError("no room")
    with pytest.raises(KeyboardInterrupt):
        with files.atomic(target) as part:
            part.write_text("half")
            raise KeyboardInterrupt
    assert target.read_text() == "before" and names(tmp_path) == ["a.txt"]
    # A new file takes the name; the old file is never written into.
    (tmp_path / "old").hardlink_to(target)
    with files.atomic(target) as part:
        part.write_text("after")
        assert part.suffix == target.suffix and part.parent == target.parent
    assert target.read_text() == "after" and (tmp_path / "old").read_text() == "before"


@pytest.mark.parametrize("letter", ["n", "ü"])
def test_longest_name_leaves_room_for_a_temporary_name(tmp_path, letter):
    name = letter * (250 // len(letter.encode()))
    with files.atomic(tmp_path / f"{name}.txt") as part:
        part.write_text("whole")
        assert part.suffix == ".txt"
    with files.atomic_folder(tmp_path / name) as part:
        (part / "a").write_text("whole")
    with files.atomic_folder(tmp_path / name, overwrite=True) as part:
        (part / "b").write_text("whole")
    assert names(tmp_path) == [name, f"{name}.txt"] and names(tmp_path / name) == ["b"]
    with (
        pytest.raises(ThermorenderError, match="cannot be written: File name too long"),
        files.atomic(tmp_path / (10 * letter + name)) as part,
    ):
        part.write_text("half")
    assert names(tmp_path) == [name, f"{name}.txt"]


def test_missing_folders_are_made_with_the_file_only(tmp_path):
    with pytest.raises(KeyboardInterrupt), files.atomic(tmp_path / "a" / "b" / "c.txt"):
        raise KeyboardInterrupt
    assert names(tmp_path) == []
    formats.write_text(tmp_path / "a" / "b" / "c.txt", "°\n")
    assert (tmp_path / "a" / "b" / "c.txt").read_bytes() == "°\n".encode()


def test_written_files_and_folders_have_default_permissions(tmp_path):
    (tmp_path / "other").touch()
    formats.write_text(tmp_path / "file", "")
    with files.atomic_folder(tmp_path / "folder"):
        pass
    (tmp_path / "plain").mkdir()
    assert (tmp_path / "file").stat().st_mode == (tmp_path / "other").stat().st_mode
    assert (tmp_path / "folder").stat().st_mode == (tmp_path / "plain").stat().st_mode


@pytest.mark.parametrize("there", ["nothing", "an empty folder", "files"])
def test_folder_is_written_whole_or_left_as_it_was(there, tmp_path):
    target = tmp_path / "a"
    if there != "nothing":
        target.mkdir()
    if there == "files":
        (target / "old").write_text("precious")
        with pytest.raises(ThermorenderError, match="a exists and is not empty; give a new folder"):
            with files.atomic_folder(target):
                pytest.fail("the block ran")
    before = names(tmp_path), names(target) if target.exists() else None
    for error in (OSError("no room"), KeyboardInterrupt()):
        with pytest.raises((ThermorenderError, KeyboardInterrupt)):
            with files.atomic_folder(target, overwrite=True) as part:
                (part / "half").write_text("x")
                raise error
        assert (names(tmp_path), names(target) if target.exists() else None) == before
    with files.atomic_folder(target, overwrite=True) as part:
        (part / "new").write_text("x")
    assert names(tmp_path) == ["a"] and names(target) == ["new"]


def test_folder_that_is_being_written_refuses_a_second_process(tmp_path):
    target = tmp_path / "a"
    with files.atomic_folder(target) as part:
        (part / "first").write_text("x")
        with pytest.raises(ThermorenderError, match="a is being written by another process"):
            with files.atomic_folder(target, overwrite=True):
                pytest.fail("two have it")
    assert names(tmp_path) == ["a"] and names(target) == ["first"]


def test_files_that_appear_during_the_write_are_kept(tmp_path):
    target = tmp_path / "a"
    with pytest.raises(ThermorenderError, match="a cannot be written: Directory not empty"):
        with files.atomic_folder(target) as part:
            (part / "ours").write_text("x")
            target.mkdir()
            (target / "theirs").write_text("x")
    assert names(tmp_path) == ["a"] and names(target) == ["theirs"]


@pytest.mark.parametrize("kept", ["before", "between", "after"])
def test_killed_overwrite_leaves_the_old_or_the_new_folder(kept, tmp_path, monkeypatch):
    """Killed before its two renames, between them, and after them."""
    target, replace, calls = tmp_path / "a", os.replace, []
    target.mkdir()
    (target / "old").touch()

    def killed(*paths):
        if len(calls) == ["before", "between", "after"].index(kept):
            os._exit(9)
        calls.append(paths)
        replace(*paths)

    if os.fork() == 0:
        os.replace = killed
        with files.atomic_folder(target, overwrite=True) as part:
            (part / "new").touch()
        os._exit(0)
    assert os.waitstatus_to_exitcode(os.wait()[1]) == 9 and len(names(tmp_path)) > 1
    with pytest.raises(ThermorenderError, match="is not empty"), files.atomic_folder(target):
        pytest.fail("the block ran")
    with pytest.raises(KeyboardInterrupt), files.atomic_folder(target, overwrite=True):
        raise KeyboardInterrupt
    assert names(tmp_path) == ["a"] and names(target) == [{"after": "new"}.get(kept, "old")]


@pytest.mark.parametrize("error", [OSError("no room"), KeyboardInterrupt()])
def test_old_folder_is_restored_after_an_error(error, tmp_path, monkeypatch):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "old").write_text("precious")
    replace, calls = os.replace, []

    def fail_second(*paths):
        calls.append(paths)
        if len(calls) == 2:
            raise error
        replace(*paths)

    monkeypatch.setattr(os, "replace", fail_second)
    with pytest.raises((ThermorenderError, KeyboardInterrupt)):
        with files.atomic_folder(tmp_path / "a", overwrite=True) as part:
            (part / "new").write_text("x")
    assert len(calls) == 3 and names(tmp_path) == ["a"] and (tmp_path / "a" / "old").read_text() == "precious"


WRITER = """
import signal, sys, time
from pathlib import Path
from thermorender import files, formats
# Whoever starts the tests in the background has them inherit that this signal is ignored.
signal.signal(signal.SIGINT, signal.default_int_handler)
target = Path(sys.argv[1])
with getattr(files, sys.argv[2])(target) as part:
    file = part / "half" if part.is_dir() else part
    file.write_text("half")
    print("writing", flush=True)
    time.sleep(60)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="sends POSIX signals")
@pytest.mark.parametrize("kind", ["atomic", "atomic_folder"])
def test_interrupted_process_leaves_nothing(kind, tmp_path):
    target = tmp_path / "new" / "a.txt"
    command = [sys.executable, "-c", WRITER, target, kind]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, preexec_fn=hear_signals)
    assert process.stdout.readline() == b"writing\n" and any(".part" in name for name in names(target.parent))
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert b"KeyboardInterrupt" in errors and names(tmp_path) == []


def _write_often(path, letter, start, count):
    start.wait()
    for _ in range(count):
        with files.atomic(path) as part, open(part, "x", encoding="ascii") as file:
            for _ in range(20):
                file.write(letter * 1000)
                file.flush()


def test_two_processes_can_write_one_file(tmp_path):
    # Mode "x" fails on another process's temporary file; mixed letters would mean two writers in one file.
    spawn = multiprocessing.get_context("spawn")
    start, path = spawn.Barrier(3), tmp_path / "a.txt"
    both = [spawn.Process(target=_write_often, args=(path, letter, start, 200)) for letter in "ab"]
    for process in both:
        process.start()
    start.wait()
    seen = set()
    while any(process.is_alive() for process in both):
        if path.exists():
            text = path.read_text()
            assert len(text) == 20000 and len(set(text)) == 1
            seen |= set(text)
    for process in both:
        process.join()
    assert [process.exitcode for process in both] == [0, 0] and seen <= {"a", "b"} and names(tmp_path) == ["a.txt"]


def test_temporary_files_of_killed_processes_are_removed(tmp_path):
    parts = []
    for name in ("frame_000001.exr", "frames.jsonl", "notes"):
        with files.atomic(tmp_path / name) as part:
            parts.append(part)
            part.touch()
        part.touch()
    os.utime(parts[0], (time.time() - 100.0,) * 2)
    mine = tmp_path / ".mine.part"
    mine.touch()
    files.remove_parts(tmp_path, r"frame.*", older_s=50.0)
    assert [part.exists() for part in parts] == [False, True, True]
    files.remove_parts(tmp_path, r"frame.*")
    assert [part.exists() for part in parts] == [False, False, True]
    files.remove_parts(tmp_path)
    assert names(tmp_path) == [".mine.part", "frame_000001.exr", "frames.jsonl", "notes"]


def test_checks_leave_nothing_behind(tmp_path):
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "file").write_text("precious")
    for check in (files.check_output_file, files.check_output_folder, files.check_new_folder):
        assert check(tmp_path / "new" / "below") is None
    assert files.check_output_folder(tmp_path / "old") is None
    assert files.check_output_file(tmp_path / "old" / "file") is None
    assert names(tmp_path) == ["old"] and names(tmp_path / "old") == ["file"]
    assert (tmp_path / "old" / "file").read_text() == "precious"


@pytest.mark.parametrize(
    ("check", "path", "words"),
    [
        (files.check_output_file, "file/below", "below cannot be written: Not a directory"),
        (files.check_output_file, "folder", "folder is not an ordinary file; give the name of a file"),
        (files.check_output_file, "x" * 300, "cannot be written: File name too long"),
        (files.check_output_file, os.devnull, "is not an ordinary file"),
        (files.check_output_file, "/proc/thermorender/a", "a cannot be written: No such file"),
        (files.check_output_folder, "file", "output folder .*file cannot be made: File exists"),
        (files.check_output_folder, "file/below", "output folder .*below cannot be made: Not a directory"),
        (files.check_output_folder, "/proc/self", "output folder /proc/self cannot be written to: No such file"),
        (files.check_output_folder, "x" * 300, "output folder .* cannot be made: File name too long"),
        (files.check_new_folder, "file", "file is a file; give the path of a folder to make"),
        (files.check_new_folder, "folder", "folder exists and is not empty; give a new folder"),
        (files.check_new_folder, "file/below", "below cannot be written: Not a directory"),
        (files.check_new_folder, "x" * 300, "cannot be written: File name too long"),
        (files.check_new_folder, "/proc", "/proc is a mount point; give a folder below it"),
    ],
)
def test_unwritable_outputs_are_reported_before_the_work(check, path, words, tmp_path):
    if not os.path.exists("/proc/self") and path.startswith("/proc"):
        pytest.skip("no folder that refuses even root: /proc is not here")
    (tmp_path / "folder").mkdir()
    for file in (tmp_path / "file", tmp_path / "folder" / "file"):
        file.write_text("precious")
    with pytest.raises(ThermorenderError, match=words):
        check(tmp_path / path)
    assert names(tmp_path) == ["file", "folder"] and names(tmp_path / "folder") == ["file"]


def test_folder_in_use_is_reported(tmp_path):
    with files.in_use(tmp_path):
        with pytest.raises(ThermorenderError, match="is being written by another process"), files.in_use(tmp_path):
            pytest.fail("two have it")
    assert names(tmp_path) == []
    with files.in_use(tmp_path):
        pass


def test_folder_without_permission(tmp_path, monkeypatch):
    def refuse(path, *_, **__):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), path)

    # A failed attempt is simulated, since permissions do not bind root.
    monkeypatch.setattr(Path, "touch", refuse)
    with pytest.raises(ThermorenderError, match="cannot be written to: Permission denied; give another folder"):
        files.check_output_folder(tmp_path)
    with pytest.raises(ThermorenderError, match="a cannot be written: Permission denied"):
        files.check_output_file(tmp_path / "a")


@pytest.mark.parametrize(
    ("text", "rows"),
    [
        ("a,b\n1,2\n", [["a", "b"], ["1", "2"]]),
        ("a;b\n1,5;2\n", [["a", "b"], ["1.5", "2"]]),
        ("time;air, °C;wind, m/s\n0;1,5;2,5\n", [["time", "air, °C", "wind, m/s"], ["0", "1.5", "2.5"]]),
        ("7,0;0,04\n10,0;0,05\n", [["7.0", "0.04"], ["10.0", "0.05"]]),
        ("a, m;b, %\n1,5\t2;3,5\n", [["a", "m;b", "%"], ["1", "5\t2;3", "5"]]),
        ("a,b;c\n1,2\n", [["a", "b;c"], ["1", "2"]]),
        ('"a;x",b\n"1;2",3\n', [["a;x", "b"], ["1;2", "3"]]),
        ("a\tb|c\n1\t2\n", [["a", "b|c"], ["1", "2"]]),
        ("a;b;c\n1;2\n", [["a", "b", "c"], ["1", "2"]]),
        ("sep=|\na,b|c\n1,5|2\n", [["a,b", "c"], ["1.5", "2"]]),
        ("title\na;b\n1;2\n", [["title"], ["a", "b"], ["1", "2"]]),
        ("", []),
    ],
)
def test_the_separator_of_a_table_is_found(text, rows):
    assert formats.csv_rows(text) == rows


def test_text_and_json(tmp_path):
    (tmp_path / "a.txt").write_bytes(b"\xef\xbb\xbfa\xc2\xb5")
    assert formats.read_text(tmp_path / "a.txt") == "aµ"
    (tmp_path / "a.txt").write_bytes(b"a\xb5")
    with pytest.raises(ThermorenderError, match=r"a.txt is not UTF-8 text \(invalid start byte\); save it as UTF-8"):
        formats.read_text(tmp_path / "a.txt")
    with pytest.raises(ThermorenderError, match=r"none cannot be read \(No such file or directory\); give a text"):
        formats.read_text(tmp_path / "none")
    formats.write_json(tmp_path / "a.json", {"value": 1})
    assert json.loads((tmp_path / "a.json").read_text()) == {"value": 1}
    for index in range(2):
        formats.append_json(tmp_path / "a.jsonl", {"index": index})
    assert (tmp_path / "a.jsonl").read_text() == '{"index": 0}\n{"index": 1}\n'


def test_each_kind_of_cached_files_has_its_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("THERMORENDER_CACHE", str(tmp_path))
    folders = [cache_folder(kind) for kind in CACHED]
    assert len(set(folders)) == len(folders) and all(folder.parent == tmp_path for folder in folders)
    with pytest.raises(ValueError, match="kind='x' is not cached; give one of light, tiles, lowtran"):
        cache_folder("x")
    monkeypatch.delenv("THERMORENDER_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    if sys.platform == "linux":
        assert cache_folder("light") == tmp_path / "xdg" / "thermorender" / "light"


def test_folder_reserved_by_another_process_is_not_removed(tmp_path):
    folder = tmp_path / "new" / "flight"
    with files.output_folder(folder) as out, files.in_use(out):
        with pytest.raises(ThermorenderError, match="is being written by another process"):
            with files.output_folder(folder) as same, files.in_use(same):
                pytest.fail("two have it")
        assert folder.is_dir()
    assert not names(tmp_path)


def test_waiting_process_gets_the_folder(tmp_path):
    """The holder removes the lock file. Still no two processes may hold it, and none may wait for ever."""
    spawn = multiprocessing.get_context("spawn")
    start = spawn.Barrier(3)
    (tmp_path / "count").write_text("0")
    each = [spawn.Process(target=_count, args=(tmp_path, start, 30)) for _ in range(3)]
    for process in each:
        process.start()
    for process in each:
        process.join(60)
    assert [process.exitcode for process in each] == [0] * 3
    assert names(tmp_path) == ["count"] and (tmp_path / "count").read_text() == "90"


def _count(folder, start, times):
    start.wait()
    for _ in range(times):
        with files.in_use(folder, wait=True):
            before = int((folder / "count").read_text())
            time.sleep(1e-3)
            (folder / "count").write_text(str(before + 1))


@pytest.mark.parametrize("every", [*slow(1), 17])
def test_stored_arrays_are_read_whole_or_not_at_all(tmp_path, every):
    """Every bit of the file flipped, or every 17th, the file truncated at any length, or a file of another version."""
    path, arrays = tmp_path / "a.npz", {"signal": np.arange(6.0).reshape(2, 3), "time_s": np.float64(2.5)}
    assert formats.read_arrays(path, 3) is None
    formats.write_arrays(path, 3, arrays)
    assert formats.read_arrays(path, 4) is None
    whole = path.read_bytes()
    for place in range(0, 8 * len(whole), every):
        damaged = bytearray(whole)
        damaged[place // 8] ^= 1 << place % 8
        path.write_bytes(damaged)
        found = formats.read_arrays(path, 3)
        # Bits that no reader uses, such as a member's date, may flip.
        assert found is None or (all(np.array_equal(found.pop(name), arrays[name]) for name in arrays) and not found)
    for size in range(0, len(whole), 7):
        path.write_bytes(whole[:size])
        assert formats.read_arrays(path, 3) is None


def test_a_text_in_a_gzip_file_comes_back_and_a_cut_one_is_refused(tmp_path):
    path = tmp_path / "table.csv.gz"
    formats.write_text(path, "east_m,north_m\n1,2\n")
    assert gzip.decompress(path.read_bytes()).decode() == formats.read_text(path) == "east_m,north_m\n1,2\n"
    first = path.read_bytes()
    formats.write_text(path, "east_m,north_m\n1,2\n")
    assert path.read_bytes() == first
    for damaged in (first[:-6], first[:12] + b"\xff" + first[13:], b"east_m,north_m\n1,2\n"):
        path.write_bytes(damaged)
        with pytest.raises(ThermorenderError, match=r"table\.csv\.gz is not a whole gzip file .*compress it again"):
            formats.read_text(path)


@pytest.mark.parametrize("length", [2**31 - 1, 2**32 - 1])
def test_a_chunk_of_a_png_longer_than_its_file_is_not_decoded(length):
    """OpenCV would reserve what it states, up to 4 GB."""
    picture = formats.encoded_image(".png", np.zeros((3, 4), np.uint8))
    assert formats.decoded(picture, -1).shape == (3, 4)
    at = picture.index(b"IDAT") - 4
    cut = picture[:at] + length.to_bytes(4, "big") + picture[at + 4 :]
    with mock.patch("cv2.imdecode", side_effect=AssertionError("decoded")):
        assert formats.decoded(cut, -1) is None
