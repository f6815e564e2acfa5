"""Work for the workers of a cluster: one function in a file that all read, called with units of work.

A unit of a lost worker is done again; one that fails is reported, and the others go on.
"""

import os
import pickle
import socket
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from thermorender import files, formats
from thermorender.errors import ThermorenderError
from thermorender.render.variant import activate, active_device
from thermorender.versions import versions

if TYPE_CHECKING:
    from distributed import Client

T = TypeVar("T")
Report = Callable[[str], object]
# Units in the scheduler's hands: for each worker, and at least, for workers that join.
_AHEAD, _LEAST = 2, 64
# Dr.Jit and the sensor's state serve one unit at a time.
_ONE = threading.Lock()
# The function of this process: (checksum of its file, function).
_known: tuple[str, Callable[[Any], Any]] | None = None


@dataclass(frozen=True)
class Job:
    """A function for workers; it is sent with every unit, so it is small."""

    path: str  # Of the file that holds the function, on a disk that all workers share
    checksum: str  # The file is unpickled only if it has this one
    processes: int = 0  # On this machine, which share its cores; 0: unknown
    # Workers with others would give other bytes, and are refused.
    versions: dict[str, str] = field(default_factory=versions)
    device: dict[str, str] = field(default_factory=active_device)


def store(do: Callable[[Any], Any], path: Path, processes: int) -> Job:
    """Write a function of a unit for workers, and return its Job."""
    from distributed.protocol.pickle import dumps

    data = dumps(do)
    with files.reported(path):
        files.put_in_place(files.write_aside(path, data), path)
    return Job(os.path.abspath(path), formats.checksum(data), processes)


def do_unit(job: Job, unit: Any) -> dict[str, Any]:
    """Do a unit in this process; return {"worker"} with "error", or with "value" and "loading_s", the time to read."""

    def do() -> dict[str, Any]:
        global _known
        clock = time.perf_counter()
        if _known is None or _known[0] != job.checksum:
            _known = None
            ready(job.versions, job.processes, job.device)
            _known = job.checksum, unpickled(Path(job.path), job.checksum)
        return {"loading_s": time.perf_counter() - clock, "value": _known[1](unit)}

    with _ONE:
        return attempted(do)


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


def results(
    client: "Client", do: Callable[[T], dict[str, Any]], units: Sequence[T], report: Report,
    then: str = "continue with resume",
) -> Iterator[tuple[T, dict[str, Any]]]:  # fmt: skip
    """Yield (unit, result) as the workers finish units, which they begin in order.

    `do` returns a dict with `worker`, and with `error` for a failure. `report` gets lines on workers that join or are
    lost; `then` is advice for a lost scheduler.
    """
    from distributed import CancelledError, KilledWorker, as_completed

    waiting, of = list(reversed(units)), dict[Any, T]()
    seen: dict[str, str] = {}
    running = as_completed(loop=client.loop)

    def more() -> None:
        _watch(client, seen, report)
        while waiting and len(of) < max(_AHEAD * len(seen), _LEAST):
            unit = waiting.pop()
            future = client.submit(do, unit, pure=False)
            of[future] = unit
            running.add(future)

    try:
        more()
        for future in running:
            unit = of.pop(future)
            try:
                found = future.result()
            except (CancelledError, OSError):
                raise
            except KilledWorker as error:
                what = f"{error.allowed_failures + 1} workers were lost with it; look for a crash or too little memory"
                found = {"worker": error.last_worker.address, "error": what}
            except Exception as error:
                # A worker without this package, for example.
                found = {"worker": "a worker", "error": f"{type(error).__name__}: {error}"}
            yield unit, found
            more()
    except (CancelledError, OSError) as error:
        raise ThermorenderError(f"the scheduler was lost ({type(error).__name__}); start it again and {then}") from None


def sentence(found: dict[str, Any]) -> str:
    """Return the worker and the error of a failure."""
    return f"{found['worker']}: {found['error']}"


def _watch(client: "Client", seen: dict[str, str], report: Report) -> None:
    """Report workers that joined or were lost since the last time."""
    workers = client.scheduler_info(n_workers=-1)["workers"]
    now = {address: str(about["name"]) for address, about in workers.items()}
    for address in sorted(now.keys() - seen.keys()):
        report(f"worker {now[address]} at {address} joined")
    for address in sorted(seen.keys() - now.keys()):
        report(f"worker {seen[address]} at {address} was lost; its work is done again")
    if not now:
        report("no worker is there; the work waits for one")
    seen.clear()
    seen.update(now)


def attempted(do: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Return the result of a unit with the name of this worker; an error becomes one sentence, and is never raised."""
    try:
        return {"worker": worker_name(), **do()}
    except ThermorenderError as error:
        what = str(error)
    except MemoryError:
        what = "the machine does not have enough memory"
    except Exception as error:
        what = f"{type(error).__name__}: {error}"
    return {"worker": worker_name(), "error": what}


def worker_name() -> str:
    """Return the name of this worker, with its machine."""
    from distributed import get_worker

    try:
        return f"{get_worker().name}@{socket.gethostname()}"
    except ValueError:
        return f"{os.getpid()}@{socket.gethostname()}"


def ready(wanted: dict[str, str], processes: int, device: dict[str, str] | None = None) -> None:
    """Refuse a worker whose results would have other bytes; bind it to its share of the machine's cores.

    `wanted` are versions of libraries, `processes` as of `Job`, and `device` as of `active_device`: it is made active.
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
