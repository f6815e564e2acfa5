"""A flight whose blocks are rendered by the workers of a Dask cluster."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from thermorender import FlightOptions, files
from thermorender.apps.cluster.connect import Address, connected
from thermorender.apps.cluster.engine import Report, do_unit, results, sentence, store
from thermorender.errors import ThermorenderError
from thermorender.output.blocks import FOLDER, finished_blocks, gaps, join, uncovered, usual_length, write_block
from thermorender.output.flight import Flight
from thermorender.output.flight import fly as fly_here
from thermorender.output.resume import finished, refuse_other_settings

if TYPE_CHECKING:
    from thermorender import Renderer, Trajectory


@dataclass
class Tally:
    """What one worker has done."""

    blocks: int = 0
    frames: int = 0
    failed: int = 0
    bytes: int = 0
    loading_s: float = 0.0
    warm_up_s: float = 0.0
    frames_s: float = 0.0
    moving_s: float = 0.0

    def add(self, found: dict[str, Any], frames: int) -> None:
        """Add the result of a block."""
        if "error" in found:
            self.failed += 1
            return
        self.blocks += 1
        self.frames += frames
        spent = found["value"] | {"loading_s": found["loading_s"]}
        for name in ("bytes", "loading_s", "warm_up_s", "frames_s", "moving_s"):
            setattr(self, name, getattr(self, name) + spent[name])


@dataclass
class FlightBlocks:
    """Renders blocks of a flight into a folder, in the worker to which it is sent."""

    folder: Path
    flight: Flight

    def __call__(self, frames: range) -> dict[str, Any]:
        """Render a block; return what `write_block` does."""
        refuse_other_settings(self.folder / "flight.json", self.flight.settings)
        return write_block(self.flight, self.folder, frames.start, frames.stop)


def fly(
    renderer: "Renderer", trajectory: "Trajectory", folder: str | os.PathLike[str], address: Address,
    options: FlightOptions, *, block: int | None = None, resume: bool = False, verify: bool = False,
    progress: Callable[[int, int], object] | None = None,
    of_worker: Callable[[str, int, int], object] | None = None, report: Report = lambda line: None,
) -> dict[str, Any]:  # fmt: skip
    """Render a flight by the workers of a cluster and return its summary: that of `thermorender.fly`, and `workers`.

    The folder must be on a disk that all workers share, under the same path. Its files have the bytes of a flight on
    one machine with the same kind of processor. `block` is the frames of a block; `of_worker` is called with (worker,
    its frames, frames in total), and `report` with lines on workers that join, are lost, or fail.
    """
    flight = Flight(renderer, trajectory, options, None)
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
            work = cut(uncovered(kept, before, total), block or usual_length(flight))
            failures: list[str] = []
            if work:
                path = out / FOLDER / "flight.pickle"
                path.parent.mkdir(exist_ok=True)
                job = store(FlightBlocks(Path(os.path.abspath(out)), flight), path, address.local)
                done = total - sum(map(len, work))
                with connected(address) as client:
                    for frames, found in results(client, partial(do_unit, job), work, report):
                        tallies.setdefault(found["worker"], Tally()).add(found, len(frames))
                        if "error" in found:
                            failures.append(f"frames {frames.start} to {frames.stop - 1} on {sentence(found)}")
                            report(failures[-1])
                            continue
                        done += len(frames)
                        if progress:
                            progress(done, total)
                        if of_worker:
                            of_worker(found["worker"], tallies[found["worker"]].frames, total)
            if failures:
                # The frames before the first gap are finished.
                next(gaps(flight, out), None)
                raise ThermorenderError(
                    f"{len(failures)} of {len(work)} blocks failed, the first: {failures[0]}; the others are finished, "
                    "mend the cause and continue with resume"
                )
        summary = fly_here(renderer, trajectory, out, options, resume=True)
    return summary | {"rendered": total - before, "workers": {name: vars(each) for name, each in tallies.items()}}


def cut(ranges: list[range], length: int) -> list[range]:
    """Ranges of frames in blocks that begin at multiples of a length, so that a resume finds the same ones."""
    found = []
    for each in ranges:
        first = each.start
        while first < each.stop:
            stop = min((first // length + 1) * length, each.stop)
            found.append(range(first, stop))
            first = stop
    return found
