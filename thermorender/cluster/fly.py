"""A flight whose blocks are rendered by the workers of a Dask cluster."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from os import PathLike
from typing import TYPE_CHECKING, Any

from thermorender import files
from thermorender.cluster.connect import Address, connected
from thermorender.cluster.work import Job, do_block, store
from thermorender.errors import ThermorenderError
from thermorender.output.blocks import finished_blocks, gaps, join, refuse_display_memory, uncovered, usual_length
from thermorender.output.flight import Flight, FlightOptions
from thermorender.output.flight import fly as fly_here
from thermorender.output.resume import finished

if TYPE_CHECKING:
    from distributed import Client

    from thermorender.render.renderer import Renderer
    from thermorender.trajectory.path import Trajectory

# Blocks in the scheduler's hands: for each worker, and at least, for workers that join.
_AHEAD, _LEAST = 2, 64

Report = Callable[[str], object]


@dataclass
class Tally:
    """What one worker has done.

    Attributes
    ----------
    blocks, frames, failed, bytes : int
    loading_s, warm_up_s, frames_s, moving_s : float
    """

    blocks: int = 0
    frames: int = 0
    failed: int = 0
    bytes: int = 0
    loading_s: float = 0.0
    warm_up_s: float = 0.0
    frames_s: float = 0.0
    moving_s: float = 0.0

    def add(self, found: dict[str, Any]) -> None:
        """Add the result of a block."""
        if "error" in found:
            self.failed += 1
            return
        self.blocks += 1
        self.frames += found["stop"] - found["first"]
        for name in ("bytes", "loading_s", "warm_up_s", "frames_s", "moving_s"):
            setattr(self, name, getattr(self, name) + found[name])


def fly(
    renderer: "Renderer",
    trajectory: "Trajectory",
    folder: str | PathLike[str],
    address: Address,
    options: FlightOptions,
    *,
    block: int | None = None,
    resume: bool = False,
    verify: bool = False,
    progress: Callable[[int, int], object] | None = None,
    report: Report = lambda line: None,
) -> dict[str, Any]:
    """Render a flight by the workers of a cluster and return its summary: that of `thermorender.fly`, and `workers`.

    The folder must be on a disk that all workers share, under the same path. Its files have the bytes of a flight on
    one machine with the same kind of processor.

    Parameters
    ----------
    renderer, trajectory, folder, options, resume, verify, progress
        As of `thermorender.output.flight.fly`.
    address : Address
    block : int, optional
        Frames of a block; see `thermorender.output.blocks.usual_length`.
    report : callable
        Called with lines on workers that join, are lost, or fail.

    Raises
    ------
    ThermorenderError
        As of `thermorender.output.flight.fly`; a block that failed, after all others are finished; a scheduler that
        was lost.
    """
    flight = Flight(renderer, trajectory, options, None)
    refuse_display_memory(flight)
    total = len(flight.times)
    if block is not None and block < 1:
        raise ThermorenderError(f"block={block} is not allowed; give a number of frames from 1 up")
    tallies: dict[str, Tally] = {}
    with files.output_folder(folder) as out:
        with files.in_use(out):
            flight.terrain = finished(out, flight.settings, flight.products, resume or verify, verify)
            before = len(flight.terrain)
            join(out, flight)
            kept = finished_blocks(out, flight.settings, verify)
            work = _cut(uncovered(kept, before, total), block or usual_length(flight))
            failures: list[str] = []
            if work:
                job = store(flight, out, address.local)
                done = total - sum(map(len, work))
                with connected(address) as client:
                    for found in _results(client, job, work, report):
                        tallies.setdefault(found["worker"], Tally()).add(found)
                        if "error" in found:
                            failures.append(_failed(found))
                            report(failures[-1])
                            continue
                        done += found["stop"] - found["first"]
                        if progress:
                            progress(done, total)
            if failures:
                # The frames before the first gap are finished.
                next(gaps(flight, out), None)
                raise ThermorenderError(
                    f"{len(failures)} of {len(work)} blocks failed, the first: {failures[0]}; the others are finished, "
                    "mend the cause and continue with --resume"
                )
        summary = fly_here(renderer, trajectory, out, options, resume=True)
    return summary | {"rendered": total - before, "workers": {name: vars(each) for name, each in tallies.items()}}


def _cut(ranges: list[range], length: int) -> list[range]:
    """Ranges of frames in blocks that begin at multiples of a length, so that a resume finds the same ones."""
    found = []
    for each in ranges:
        first = each.start
        while first < each.stop:
            stop = min((first // length + 1) * length, each.stop)
            found.append(range(first, stop))
            first = stop
    return found


def _failed(found: dict[str, Any]) -> str:
    return f"frames {found['first']} to {found['stop'] - 1} on {found['worker']}: {found['error']}"


def _results(client: "Client", job: Job, work: list[range], report: Report) -> Iterator[dict[str, Any]]:
    """Yield the results of blocks as they come; few are in hand, and more if workers join."""
    from distributed import CancelledError, KilledWorker, as_completed

    waiting, of = list(reversed(work)), {}
    seen: dict[str, str] = {}
    running = as_completed(loop=client.loop)

    def more() -> None:
        while waiting and len(of) < max(_AHEAD * len(seen), _LEAST):
            frames = waiting.pop()
            future = client.submit(do_block, job, frames.start, frames.stop, pure=False)
            of[future] = frames
            running.add(future)

    try:
        _watch(client, seen, report)
        more()
        for future in running:
            frames = of.pop(future)
            about = {"first": frames.start, "stop": frames.stop, "worker": "a worker"}
            try:
                yield future.result()
            except (CancelledError, OSError):
                raise
            except KilledWorker as error:
                what = f"{error.allowed_failures + 1} workers were lost with it; look for a crash or too little memory"
                yield about | {"worker": str(error.last_worker.address), "error": what}
            except Exception as error:
                # A worker without this package, for example.
                yield about | {"error": f"{type(error).__name__}: {error}"}
            _watch(client, seen, report)
            more()
    except (CancelledError, OSError) as error:
        raise ThermorenderError(
            f"the scheduler was lost ({type(error).__name__}); start it again and continue with --resume"
        ) from None


def _watch(client: "Client", seen: dict[str, str], report: Report) -> None:
    """Report workers that joined or were lost since the last time."""
    workers = client.scheduler_info(n_workers=-1)["workers"]
    now = {address: str(about["name"]) for address, about in workers.items()}
    for address in sorted(now.keys() - seen.keys()):
        report(f"worker {now[address]} at {address} joined")
    for address in sorted(seen.keys() - now.keys()):
        report(f"worker {seen[address]} at {address} was lost; its block is done again")
    seen.clear()
    seen.update(now)
