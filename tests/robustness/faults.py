"""Faults from outside: killed processes, full disks, folders without permission, damaged files.

Nothing may be lost and nothing doubled. Values are counts: of files that differ from those of an undisturbed run, of
records, of jobs that neither finished nor were refused in a sentence.
"""

import io
import json
import os
import pickle
import signal
import subprocess
import sys
import tempfile
import time
import zipfile
from contextlib import ExitStack, contextmanager
from functools import cache
from pathlib import Path
from unittest.mock import patch

import numpy as np

from tests.robustness.cases import Found, case
from tests.robustness.crash_targets import (
    FRAMES,
    images,
    renderer,
    sentence,
    write_scene,
)  # fmt: skip
from tests.robustness.fuzz.corpus import READERS, Reader
from thermorender.errors import ThermorenderError

# Number of kills of a job, and the longest time of each run [s]: a longer run hangs.
KILLS, _MOST_S = 5, 900.0
# Parts of a file that remain.
_CUTS = (0.0, 0.25, 0.5, 0.9)


# --- processes and their files ----------------------------------------------------------------------------------


@contextmanager
def _place(balance=False):
    """Yield a folder with a scene beside it."""
    with tempfile.TemporaryDirectory(prefix="thermorender-faults-") as folder:
        # Readable for user nobody, too.
        os.chmod(folder, 0o755)
        write_scene(Path(folder) / "scene", balance)
        (Path(folder) / "work").mkdir()
        yield Path(folder) / "work"


def _start(job, folder, *arguments, **more):
    program = "from tests.robustness.crash_targets import main; main()"
    command = [sys.executable, "-c", program, job, folder, *arguments]
    # It has few threads, because the sums of a training depend on their number.
    environment = os.environ | {"OMP_NUM_THREADS": "2", "MKL_NUM_THREADS": "2"} | {k: str(v) for k, v in more.items()}
    return subprocess.Popen(list(map(str, command)), stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environment)


def _end(process):
    """(status, last line of its output, errors) of a process; one that hangs is an error."""
    try:
        output, errors = process.communicate(timeout=_MOST_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        raise
    return process.returncode, (output.decode().splitlines() or [""])[-1], errors.decode().strip()


def printed(job, *arguments, balance=False):
    """Return what a job prints at its end."""
    with _place(balance) as folder:
        status, last, errors = _end(_start(job, folder, *arguments))
    if status:
        raise RuntimeError(errors[-1000:])
    return json.loads(last)


def contents(folder):
    """Return {name: bytes} of the files in a folder and below, except a training's own files, which contain seconds.

    A cache file that a process was writing when it was killed is removed after an hour by the next writer.
    """
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and not (path.parent.name == "light" and path.suffixes[-2:-1] == [".part"])
        and path.relative_to(folder).parts[0] != "run"
    }  # fmt: skip


def differing(one, other):
    """Return how many files of two `contents` differ or are in only one of them."""
    return float(sum(one.get(name) != other.get(name) for name in one | other))


@cache
def undisturbed(job):
    """Return (contents, run time in seconds) of a job that is not disturbed."""
    with _place(job in ("heat", "day")) as folder:
        process = _start(job, folder)
        process.stdout.readline()
        began = time.monotonic()
        status, _, errors = _end(process)
        if status:
            raise RuntimeError(errors[-1000:])
        return contents(folder), time.monotonic() - began


@cache
def killed(job):
    """Return (contents, number of kills) of a job that is killed at random moments and started again until it is done.

    Every other time it is killed as soon as it writes a file.
    """
    _, seconds = undisturbed(job)
    generator, kills = np.random.default_rng(len(job)), 0
    # A job that continues where it was stopped has less to do each time.
    share = 1.0 if job in ("bake", "day") else 2.0 / KILLS
    with _place(job in ("heat", "day")) as folder:
        while True:
            process = _start(job, folder)
            if kills < KILLS and process.stdout.readline():
                until = time.monotonic() + generator.uniform(0.0, share * seconds)
                while process.poll() is None and time.monotonic() < until:
                    if kills % 2 and any(folder.parent.rglob(".*.part*")):
                        break
                    time.sleep(1e-3)
                if process.poll() is None:
                    process.send_signal(signal.SIGKILL)
                    kills += 1
                process.communicate()
                continue
            status, _, errors = _end(process)
            if status:
                raise RuntimeError(errors[-1000:])
            return contents(folder), kills


def _records(found):
    return [json.loads(line)["index"] for line in found["out/frames.jsonl"].decode().splitlines()]


@case("faults", "{} killed at random moments and begun again: files that differ",
      ("flight", "bake", "heat", "day", "training"))  # fmt: skip
def kills(job):
    found, times = killed(job)
    return Found(differing(found, undisturbed(job)[0]) if times >= KILLS else np.nan, 0.0, 0.0)


@case("faults", "flight killed at random moments and resumed: records")
def records():
    found = _records(killed("flight")[0])
    return Found(float(len(found)) if found == list(range(FRAMES)) else np.nan, float(FRAMES), 0.0)


@case("faults", "two flights into one folder at once: files that differ, and processes not refused in a sentence")
def both():
    with _place() as folder:
        pair = [_start("flight", folder) for _ in range(2)]
        ends = [_end(process) for process in pair]
        found = contents(folder)
    refused = [errors for status, _, errors in ends if status == 2 and sentence(errors)]
    done = sum(status == 0 for status, _, _ in ends)
    # If the second starts after the first has ended, it has nothing left to do.
    wrong = sum("is being written by another process" not in errors for errors in refused) + (len(refused) + done != 2)
    return Found(differing(found, undisturbed("flight")[0]) + wrong + (not done), 0.0, 0.0)


@case("faults", "the lock of a killed process does not hold: flights refused")
def stale():
    with _place() as folder:
        process = _start("flight", folder)
        while process.poll() is None and not (folder / "out" / "frames.jsonl").exists():
            time.sleep(1e-3)
        process.kill()
        process.communicate()
        return Found(float(_end(_start("flight", folder))[0] != 0), 0.0, 0.0)


# --- full disks, shut folders, false clocks ---------------------------------------------------------------------


@case("faults", "flight on a disk that is full at each of its files, then with room: files that differ")
def starved():
    whole, _ = undisturbed("flight")
    # One byte less than the largest file of each kind takes; the sensor's memory and the smallest images too.
    kinds = {}
    for name, data in whole.items():
        kind = name.partition("_")[2][6:] or name
        kinds[kind] = min(kinds.get(kind, 1 << 30), len(data))
    limits = sorted({size - 1 for size in kinds.values()} | {0})
    with _place() as folder:
        status, last, errors = _end(_start("starved", folder, *limits))
        if status or json.loads(last):
            raise RuntimeError(last + errors[-1000:])
        return Found(differing(contents(folder), whole), 0.0, 0.0)


@case("faults", "writers of pictures, rasters, videos, arrays and checkpoints on a full disk: ends lost in silence")
def writers():
    return Found(float(len(printed("writers"))), 0.0, 0.0)


@case("faults", "folders and files that a user has no right to: neither worked without nor refused in a sentence")
def shut_out():
    return Found(float(len(printed("shut_out"))), 0.0, 0.0)


@case("faults", "flight and resumes while the clock goes backwards, over files of the future: files that differ")
def backwards():
    with _place() as folder:
        status, _, errors = _end(_start("backwards", folder))
        if status:
            raise RuntimeError(errors[-1000:])
        return Found(differing(contents(folder), undisturbed("flight")[0]), 0.0, 0.0)


# --- killed worker processes ------------------------------------------------------------------------------------


class _Killed(subprocess.Popen):
    """A process that is killed as soon as it runs."""

    def __init__(self, *arguments, **more):
        super().__init__(*arguments, **more)
        self.kill()


def _ends_in_a_sentence(job, words=""):
    """1 if a job is not refused in a sentence with some words."""
    try:
        job()
    except ThermorenderError as error:
        return float(not sentence(str(error)) or words not in str(error))
    except Exception:
        pass
    return 1.0


@case("faults", "{} is killed: neither a sentence nor an end", ("the encoder of a video", "a process that measures"))
def worker(which):
    import imageio_ffmpeg

    from thermorender.apps.compare.machine import apart
    from thermorender.output.video import write_video

    # Searched for once, by running it.
    imageio_ffmpeg.get_ffmpeg_exe()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.mp4"
        if which.startswith("the encoder"):
            made = images(Path(folder))
            with patch.object(subprocess, "Popen", _Killed):
                wrong = _ends_in_a_sentence(lambda: write_video(path, made, 8.0), "the encoder ended with status -9")
            return Found(wrong + path.exists(), 0.0, 0.0)
        return Found(_ends_in_a_sentence(lambda: apart(os._exit, 3), "was killed before it ended"), 0.0, 0.0)


# --- damaged files ----------------------------------------------------------------------------------------------


def _damaged(data):
    """(description, bytes) of a cached file that must not be trusted."""
    generator = np.random.default_rng(0)
    yield from ((f"cut to {share:g}", data[: int(share * len(data))]) for share in _CUTS)
    yield "random", generator.bytes(len(data))
    flipped = bytearray(data)
    flipped[len(data) // 2] ^= 1
    yield "a bit", bytes(flipped)
    yield "pickle", pickle.dumps(np.ones(3))


@case("faults", "light kept on disk and {}: taken as it is, or another result", ("damaged", "of another program"))
def light(how):
    from thermorender.render.light import radiosity
    from thermorender.render.light import transport_cache as kept

    before, worth = os.environ.get("THERMORENDER_CACHE"), kept.WORTH_RAYS
    with _place() as folder, ExitStack() as stack:
        stack.callback(setattr, kept, "WORTH_RAYS", worth)
        stack.callback(_restore, "THERMORENDER_CACHE", before)
        os.environ["THERMORENDER_CACHE"] = str(folder)
        kept.WORTH_RAYS = 0
        geometry = renderer(folder.parent / "scene").baked.geometry
        true, name = radiosity.trace(geometry, 64), kept.key(geometry, 64)
        kept.store(name, true)
        path, wrong = folder / "light" / f"{name}.npz", 0
        whole = path.read_bytes()
        if how == "damaged":
            for _, data in _damaged(whole):
                path.write_bytes(data)
                wrong += kept.load(name) is not None
                again, note = kept.traced(geometry, 64)
                wrong += note is not None or path.read_bytes() != whole or _unlike(again, true)
        else:
            version = radiosity.VERSION
            stack.callback(setattr, radiosity, "VERSION", version)
            radiosity.VERSION = "another"
            # By its own name, and by the name of the other.
            other = kept.key(geometry, 64)
            wrong += other == name or kept.load(other) is not None
            path.rename(path.with_name(f"{other}.npz"))
            wrong += kept.load(other) is not None
        return Found(float(wrong), 0.0, 0.0)


def _restore(name, value):
    if value is None:
        os.environ.pop(name, None)
    else:
        os.environ[name] = value


def _unlike(one, other):
    return any(not np.array_equal(value, vars(other)[name]) for name, value in vars(one).items())


@case("faults", "Dr.Jit's kernels on disk, damaged: frames that differ")
def kernels():
    whole, _ = undisturbed("bake")
    wrong = 0.0
    with _place() as folder:
        for kind in (None, "cut to 0.5", "random"):
            for path in (folder.parent / "kernels").glob("*.bin"):
                path.write_bytes(dict(_damaged(path.read_bytes()))[kind])
            status, _, errors = _end(_start("bake", folder, DRJIT_CACHE_DIR=folder.parent / "kernels"))
            if status:
                raise RuntimeError(errors[-1000:])
            wrong += differing(contents(folder), whole)
        wrong += not any((folder.parent / "kernels").glob("*.bin"))
    return Found(wrong, 0.0, 0.0)


@case("faults", "LOWTRAN's results on disk, damaged: not computed again")
def lowtran():
    from thermorender.atmosphere import lowtran as program

    before, true, wrong = os.environ.get("THERMORENDER_CACHE"), np.arange(500.0).reshape(20, 25), 0
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        stack.callback(_restore, "THERMORENDER_CACHE", before)
        os.environ["THERMORENDER_CACHE"] = folder
        program.cached("key", lambda: true)
        (path,) = Path(folder).rglob("*.npz")
        for _, data in _damaged(path.read_bytes()):
            path.write_bytes(data)
            found = program.cached("key", lambda: true)
            wrong += not (isinstance(found, np.ndarray) and np.array_equal(found, true))
    return Found(float(wrong), 0.0, 0.0)


@case("faults", "inputs cut to nothing, a quarter, half and nine tenths: neither a sentence nor finite numbers")
def cut():
    from tests.robustness.fuzz.run import infinite

    wrong = []
    for name, reader in READERS.items():
        with tempfile.TemporaryDirectory() as folder:
            reader.make(Path(folder))
            path = Path(folder) / reader.file
            whole = path.read_bytes()
            for share in _CUTS:
                path.write_bytes(whole[: int(share * len(whole))])
                try:
                    wrong += [(name, share, what) for what in infinite(reader.read(path))]
                except ThermorenderError as error:
                    wrong += [] if sentence(str(error)) else [(name, share, error)]
                except Exception as error:
                    wrong.append((name, share, error))
    return Found(float(len(wrong)), 0.0, 0.0)


# Readers of files with arrays, of a model or of its weights.
_OF_ARRAYS = (
    "atmosphere",
    "absorption data",
    "map palette",
    "map trees",
    "map compact",
    "emissivity map",
    "checkpoint",
    "kept arrays",
)


class _Evil:
    """An object that creates a file when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


@case("faults", "files of arrays, maps and weights with a pickle inside: run, or not refused in a sentence")
def pickles():
    from thermorender.apps.training.networks.perception import Perception

    wrong, perception = 0, Reader("vgg.safetensors", READERS["checkpoint"].make, Perception)
    for reader in (*map(READERS.get, _OF_ARRAYS), perception):
        with tempfile.TemporaryDirectory() as folder:
            path, marker = Path(folder) / reader.file, Path(folder) / "run"
            reader.make(Path(folder))
            for data in _pickled(path, marker):
                path.write_bytes(data)
                wrong += _ends_in_a_sentence(lambda reader=reader, path=path: reader.read(path))
                wrong += marker.exists()
                marker.unlink(missing_ok=True)
    return Found(float(wrong), 0.0, 0.0)


def _pickled(path, marker):
    """Yield the bytes that would create a file if unpickled, for each form that a model's file may have."""
    evil = _Evil(marker)
    yield pickle.dumps(evil)
    # As written by torch.save.
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as file:
        file.writestr("archive/data.pkl", pickle.dumps(evil))
    yield archive.getvalue()
    if path.suffix == ".npz":
        with np.load(path) as kept:
            arrays = dict(kept)
        for name in arrays:
            changed = io.BytesIO()
            np.savez(changed, **arrays | {name: np.array([evil], dtype=object)})
            yield changed.getvalue()


# --- memory and time --------------------------------------------------------------------------------------------


def _growth(steps, memory):
    """Slope of memory [MB], the median over pairs (Theil and Sen): a piece kept once does not count, one per step does.

    0 if it shrinks.
    """
    from scipy.stats import theilslopes

    return max(float(theilslopes(memory, steps).slope), 0.0)


# Long flights of small frames: their number and kind.
LONG = {
    "10 000 small frames of still ground": (10_000, "still"),
    "1000 small frames of still and moving objects, through air, with photographs": (1000, "busy"),
}


@cache
def long_flight(which):
    """Return (frames, memory [MB], core time [s]), (N,) each, along a flight of `LONG`, without its start."""
    found = np.array(printed("frames", *LONG[which]))
    return found[len(found) // 4 :].T


@case("faults", "{}: growth of memory [MB per 1000 frames]", LONG)
def flat(which):
    done, memory, _ = long_flight(which)
    return Found(1000.0 * _growth(done, memory), 0.0, 1.0)


@case("faults", "{}: core time of the last half of the frames by that of the first", LONG)
def steady(which):
    done, _, seconds = long_flight(which)
    each = np.diff(seconds) / np.diff(done)
    ratio = float(np.median(each[len(each) // 2 :]) / np.median(each[: len(each) // 2]))
    # Other work on the machine makes a core slower by up to this; a faster end is not a fault.
    return Found(max(ratio, 1.0), 1.0, 0.3)


@case("faults", "{}, then dropped: growth of memory [MB each]", ("scenes loaded and flown", "frames path traced"))
def dropped(what):
    """Memory that may be kept: a scene's arrays and kernels' inputs, and the lens of a path-traced frame."""
    memory = printed(*(("scenes", 100) if what.startswith("scenes") else ("references", 30)))
    # By then everything that is created once exists, and fragments between the kept pieces grow little more.
    later = memory[len(memory) // 2 :]
    return Found(_growth(range(len(later)), later), 0.0, 0.3)
