"""What a worker does: it reads the flight with its baked scene once, and renders the blocks that it is given."""

import os
import pickle
import socket
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from thermorender import files, formats
from thermorender.apps.cluster.dispatch import attempted, worker_name
from thermorender.errors import ThermorenderError
from thermorender.output.blocks import FOLDER, write_block
from thermorender.output.resume import refuse_other_settings
from thermorender.render.variant import activate, active_device
from thermorender.versions import versions

if TYPE_CHECKING:
    from thermorender.output.flight import Flight

# Dr.Jit and the sensor's state serve one block at a time.
ONE = threading.Lock()
# The flight of this process: (checksum of its file, Flight).
_known: tuple[str, "Flight"] | None = None


@dataclass(frozen=True)
class Job:
    """A flight for workers; it is sent with every block, so it is small."""

    folder: str  # Of the flight, on a disk that all workers share
    # Of the file that holds the flight with its baked scene. It is unpickled only if it has this checksum.
    checksum: str
    processes: int = 0  # On this machine, which share its cores; 0: unknown


def file_of(folder: Path) -> Path:
    """Return the file that workers read the flight from."""
    return folder / FOLDER / "flight.pickle"


def store(flight: "Flight", folder: Path, processes: int) -> Job:
    """Write a flight for workers, and return its Job."""
    # The flight's own bytes: `ready` comes before Mitsuba is loaded.
    value = {"flight": pickle.dumps(flight, pickle.HIGHEST_PROTOCOL), "versions": versions(), "device": active_device()}
    data = pickle.dumps(value, protocol=pickle.HIGHEST_PROTOCOL)
    path = file_of(folder)
    path.parent.mkdir(exist_ok=True)
    files.put_in_place(files.write_aside(path, data), path)
    return Job(os.path.abspath(folder), formats.checksum(data), processes)


def do_block(job: Job, frames: range) -> dict[str, Any]:
    """Render a block in this process; return worker, and error or what `write_block` returns with loading_s."""

    def do() -> dict[str, Any]:
        clock = time.perf_counter()
        folder = Path(job.folder)
        flight = _flight(job, folder)
        loading_s = time.perf_counter() - clock
        refuse_other_settings(folder / "flight.json", flight.settings)
        return {"loading_s": loading_s} | write_block(flight, folder, frames.start, frames.stop)

    with ONE:
        return attempted(do)


def _flight(job: Job, folder: Path) -> "Flight":
    """The flight of a Job, read once per process."""
    global _known
    if _known is None or _known[0] != job.checksum:
        _known = None
        _known = job.checksum, _loaded(job, folder)
    return _known[1]


def _loaded(job: Job, folder: Path) -> "Flight":
    value = unpickled(file_of(folder), job.checksum)
    ready(value["versions"], job.processes, value["device"])
    flight: Flight = pickle.loads(value["flight"])
    return flight


def unpickled(path: Path, checksum: str) -> Any:
    """Return the content of a file for workers; refuse one that another process has written."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ThermorenderError(
            f"{path} cannot be read on {socket.gethostname()}: {error.strerror}; mount the folder of the results there "
            "under the same path"
        ) from None
    if formats.checksum(data) != checksum:
        raise ThermorenderError(f"{path} is not the file of this work; stop other processes that write to its folder")
    return pickle.loads(data)


def ready(wanted: dict[str, str], processes: int, device: dict[str, str] | None = None) -> None:
    """Refuse a worker whose results would have other bytes; bind it to its share of the machine's cores.

    Parameters
    ----------
    wanted : dict of str to str
        Versions of libraries.
    processes : int
        As of `Job`.
    device : dict of str to str, optional
        As of `active_device`; it is made active.
    """
    own = versions()
    for name, expected in wanted.items():
        if own.get(name) != expected:
            raise ThermorenderError(
                f"worker {worker_name()} has {name} {own.get(name)}, the work was started with {expected}; install the "
                "same version"
            )
    if device:
        activate("cuda" if "cuda" in device else "cpu")
        if active_device() != device:
            raise ThermorenderError(
                f"worker {worker_name()} has the device {active_device()}, the work was started with {device}; install "
                "the same version of its library"
            )
    _take_cores(processes)


def _take_cores(processes: int) -> None:
    """Bind this process to its share of the cores; two processes of one core each are faster than one of two."""
    from distributed import get_worker

    if processes < 2 or not hasattr(os, "sched_setaffinity"):
        return
    try:
        number = int(get_worker().name)
    except (ValueError, TypeError):
        return
    cores = sorted(os.sched_getaffinity(0))
    own = {core for k, core in enumerate(cores) if k % processes == number % processes}
    os.sched_setaffinity(0, own or {cores[number % len(cores)]})
