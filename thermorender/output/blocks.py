"""Blocks of a flight's frames: rendered in any order, also by other machines, and taken over into the flight in order.

A block begins with a sensor at rest that is brought to its state by a warm-up; see `FlightFrames.warm_up`. Its frames
are rendered in a folder of their own, then moved into the flight's. The block's record, written last, holds the lines
of the frames and checksums of the sensor's state before and after them. A block is taken over only if the state before
it is that after the frame before, to the bit. Otherwise its frames are rendered again from that state. So the bytes of
a flight never depend on how it was divided.
"""

import json
import secrets
import shutil
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from thermorender import files, formats
from thermorender.errors import ThermorenderError
from thermorender.output.resume import load_state, refuse_other_settings, refuse_used, state_file, whole

if TYPE_CHECKING:
    from thermorender.output.flight import Flight

# Folder in that of a flight.
FOLDER = "blocks"
# Fewest frames of a block by default, and their number over that of the warm-up, which is lost work.
_LEAST, _OVER_WARM_UP = 40, 10


@dataclass(frozen=True)
class Block:
    """The record of finished frames.

    Attributes
    ----------
    first, stop : int
        Number of the first frame, and of that behind the last.
    before, after : str
        Checksum of the sensor's state before the first frame, "" at the start of a flight, and after the last.
    lines : list of dict
        Of the frames, as in `frames.jsonl`; left out by `finished_blocks`, since those of a campaign fill the memory.
    settings : str
        Checksum of the flight's settings.
    """

    first: int
    stop: int
    before: str
    after: str
    lines: list[dict[str, Any]]
    settings: str


def settings_digest(settings: dict[str, Any]) -> str:
    """Return the checksum of a flight's settings."""
    return formats.checksum(json.dumps(settings).encode())


def usual_length(flight: "Flight") -> int:
    """Return the number of frames of a block by default: many more than its warm-up, whole spans of the audit."""
    warm_up = len(flight.times) - flight.flown.warm_up(len(flight.times))
    least = max(_LEAST, _OVER_WARM_UP * warm_up)
    return -(-least // flight.audit) * flight.audit


def refuse_display_memory(flight: "Flight") -> None:
    """Raise ThermorenderError for display images that depend on all frames before."""
    if flight.display.memory_s and "display" in flight.products:
        raise ThermorenderError(
            f"the gain control's memory of {flight.display.memory_s:g} s links all frames of a flight; leave "
            "--agc-memory-s out, or fly without --cluster and --frames"
        )


def join(folder: Path, flight: "Flight") -> None:
    """Write `flight.json` into a folder without flight; refuse one with another flight."""
    described = folder / "flight.json"
    if described.exists():
        refuse_other_settings(described, flight.settings)
        return
    refuse_used(folder)
    formats.write_json(described, flight.described)


def write_block(flight: "Flight", folder: Path, first: int, stop: int) -> dict[str, Any]:
    """Render frames and write their files and record; the flight's folder must have its `flight.json`.

    Returns
    -------
    dict
        warm_up_s, frames_s and moving_s: time for warm-up, for frames, and for putting them in place; bytes written.
    """
    name, digest = f"{first:09d}-{stop:09d}", settings_digest(flight.settings)
    # Two processes may render the same block, if one of them was believed to be lost.
    place = folder / FOLDER / f"{name}.{secrets.token_hex(4)}"
    place.mkdir(parents=True)
    try:
        clock = [time.perf_counter()]
        flight.flown.start(first)
        before = _checksum(flight.flown.exposure.state()) if first else ""
        clock.append(time.perf_counter())
        flight.write_frames(place, range(first, stop))
        after = _checksum(flight.flown.exposure.state())
        clock.append(time.perf_counter())
        written = (place / "frames.jsonl").read_text(encoding="utf-8").splitlines()
        lines = [formats.unsealed(json.loads(line)) for line in written]
        for line in lines:
            for file in line["files"]:
                files.put_in_place(place / file, folder / file)
        files.put_in_place(state_file(place, stop - 1), folder / FOLDER / f"{name}.npz")
        files.on_disk(folder)
        block = Block(first, stop, before, after, lines, digest)
        formats.write_text(folder / FOLDER / f"{name}.json", json.dumps(formats.sealed(vars(block))))
        clock.append(time.perf_counter())
    finally:
        shutil.rmtree(place, ignore_errors=True)
    spent = dict(zip(("warm_up_s", "frames_s", "moving_s"), np.diff(clock).tolist(), strict=True))
    return spent | {"bytes": sum(size for line in lines for size, _ in line["files"].values())}


def finished_blocks(folder: Path, settings: dict[str, Any], verify: bool) -> dict[int, Block]:
    """Return {first frame: Block} of the intact blocks of a flight of these settings, the longest of each beginning."""
    found: dict[int, Block] = {}
    digest = settings_digest(settings)
    for path in sorted((folder / FOLDER).glob("*.json")):
        block = _read(path)
        if block is None or block.settings != digest:
            continue
        known = [(folder / name, each) for line in block.lines for name, each in line["files"].items()]
        if all(whole(file, each, verify) for file, each in known):
            if block.first not in found or found[block.first].stop < block.stop:
                found[block.first] = replace(block, lines=[])
    return found


def _read(path: Path) -> Block | None:
    """The Block of a file; None if it is missing or damaged."""
    try:
        return Block(**formats.unsealed(json.loads(path.read_text(encoding="utf-8"))))
    except (OSError, ValueError, TypeError):
        return None


def uncovered(kept: dict[int, Block], done: int, total: int) -> list[range]:
    """Return the ranges from frame `done` on that no block holds."""
    found = []
    while done < total:
        if done in kept:
            done = kept[done].stop
            continue
        stop = min((first for first in kept if first > done), default=total)
        found.append(range(done, stop))
        done = stop
    return found


def gaps(flight: "Flight", folder: Path, verify: bool = False) -> Iterator[range]:
    """Yield the ranges of frames to render here, in order; take over the finished blocks between them.

    The sensor is in its state before the range; its frames are written when the next range is asked for.
    """
    total, kept, after = len(flight.times), finished_blocks(folder, flight.settings, verify), None
    while (done := len(flight.terrain)) < total:
        if done in kept:
            block = kept.pop(done)
            if (after or _state_checksum(folder, done)) == block.before and _taken_over(flight, folder, block):
                after = block.after
                continue
        stop, after = min((first for first in kept if first > done), default=total), None
        if done:
            flight.restore(folder, done)
        yield range(done, stop)


def _state_checksum(folder: Path, first: int) -> str | None:
    """The checksum of the sensor's state before a frame, as in a Block; None if the state is lost."""
    state = state_before(folder, first) if first else None
    return _checksum(state) if state is not None else None if first else ""


def _taken_over(flight: "Flight", folder: Path, block: Block) -> bool:
    """Append the lines of a block to `frames.jsonl`, unless its record was lost. The state stays beside the record."""
    read = _read(folder / FOLDER / f"{block.first:09d}-{block.stop:09d}.json")
    if read is None:
        return False
    formats.append_json(folder / "frames.jsonl", *map(formats.sealed, read.lines))
    flight.terrain += [line["shows_terrain"] for line in read.lines]
    return True


def state_before(folder: Path, first: int) -> dict[str, NDArray[Any]] | None:
    """Return the state of sensor and display before a frame, kept by the flight or by a block; None if it is lost."""
    state = load_state(folder, first - 1)
    if state is None:
        for path in (folder / FOLDER).glob(f"*-{first:09d}.npz"):
            state = formats.read_arrays(path, first - 1)
    return state


def remove_blocks(folder: Path) -> None:
    """Remove the records of blocks of a finished flight."""
    shutil.rmtree(folder / FOLDER, ignore_errors=True)


def _checksum(state: dict[str, NDArray[Any]]) -> str:
    return formats.digest("sensor", {name: values for name, values in state.items() if name != "agc"})


def parse_frames(text: str) -> tuple[int, int]:
    """Return (first, stop) of an option --frames=A:B."""
    first, colon, stop = text.partition(":")
    if not (colon and first.isdecimal() and stop.isdecimal() and int(first) < int(stop)):
        raise ThermorenderError(
            f"--frames={text!r} is not allowed; give FIRST:STOP, such as 0:100 for the first hundred frames"
        )
    return int(first), int(stop)
