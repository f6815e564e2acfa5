"""Units of work given to the workers of a cluster: done again where a worker is lost, reported where they fail."""

from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

from thermorender.errors import ThermorenderError

if TYPE_CHECKING:
    from distributed import Client

T = TypeVar("T")
Report = Callable[[str], object]
# Units in the scheduler's hands: for each worker, and at least, for workers that join.
_AHEAD, _LEAST = 2, 64


def results(
    client: "Client", do: Callable[[T], dict[str, Any]], units: Sequence[T], report: Report,
    then: str = "continue with --resume",
) -> Iterator[tuple[T, dict[str, Any]]]:  # fmt: skip
    """Yield (unit, result) as units of work are done by the workers.

    Parameters
    ----------
    client : distributed.Client
    do : callable
        Called with a unit in a worker's process; it returns a dict with `worker`, and with `error` for a failure.
    units : sequence
        In the order in which they are begun.
    report : callable
        Called with lines on workers that join or are lost.
    then : str
        Advice for a lost scheduler.
    """
    from distributed import CancelledError, KilledWorker, as_completed

    waiting, of = list(reversed(units)), {}
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
    import os
    import socket

    from distributed import get_worker

    try:
        return f"{get_worker().name}@{socket.gethostname()}"
    except ValueError:
        return f"{os.getpid()}@{socket.gethostname()}"
