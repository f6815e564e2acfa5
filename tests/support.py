"""What test files import: where data are, cases marked as slow, and the list of allowed skips."""

import atexit
import functools
import json
import os
import shutil
import signal
import tarfile
import tempfile
from contextlib import contextmanager
from pathlib import Path

import pytest

HERE = Path(__file__).resolve().parent
# Data that may be redistributed is in tests/data; the rest is looked for here.
DATA = Path(os.environ.get("THERMORENDER_DATA", HERE.parents[1] / "shared" / "data"))


def slow(*cases):
    """Return cases of a parametrised test, each a value or a tuple of values, marked as slow."""
    return [pytest.param(*(case if isinstance(case, tuple) else (case,)), marks=pytest.mark.slow) for case in cases]


def hear_signals():
    """For a process under test: end at signals that the tests were told to ignore, as in the background by `nohup`."""
    for name in ("SIGINT", "SIGHUP"):
        signal.signal(getattr(signal, name), signal.SIG_DFL)


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


def contents(folder):
    """{name: bytes} of the files in a folder."""
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir()) if path.is_file()}


def records(folder):
    """The records of a flight's frames."""
    return [json.loads(line) for line in (folder / "frames.jsonl").read_text(encoding="utf-8").splitlines()]


@contextmanager
def interrupted(at):
    """Yield a progress function that raises KeyboardInterrupt when it is told `at`; the block must end by that."""

    def stop(done, total):
        if done == at:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        yield stop


def allowed_skips(path=HERE / "allowed_skips.txt"):
    """{"file.py::test": reason} of the tests that may be skipped."""
    lines = [line.strip() for line in path.read_text(encoding="utf-8").splitlines()]
    return dict(line.split(": ", 1) for line in lines if line and not line.startswith("#"))


def write_dji_jpeg(path):
    """Write a JPEG with the segments of DJI's radiometric ones, without a signal in them; return its path."""
    import cv2
    import numpy as np

    _, data = cv2.imencode(".jpg", np.random.default_rng(0).integers(0, 256, (40, 48), np.uint8))
    exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x0f\x01\x02\0\x04\0\0\0DJI\0\0\0\0\0"
    signal = bytes(40000)
    blocks = b"".join(
        b"\xff" + bytes([kind]) + (len(block) + 2).to_bytes(2, "big") + block
        for kind, block in ((0xE1, exif), (0xE3, signal), (0xE3, signal))
    )
    plain = data.tobytes()
    path.write_bytes(plain[:2] + blocks + plain[2:])
    return path
