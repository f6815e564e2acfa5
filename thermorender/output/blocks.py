"""Blocks of a flight's frames: rendered in any order, also by other machines, and merged into the flight in order.

A block begins with a sensor at rest, followed by a warm-up; see `FlightFrames.warm_up`. Its frames are rendered in a
folder of their own, then moved into the flight's. The block's record, written last, holds the lines of the frames and
checksums of the sensor's state before and after them. A block is merged only if the state before it is that after the
frame before, to the bit. Otherwise its frames are rendered again from that state. So the bytes of a flight never depend
on how it was divided.
"""

import json
import secrets
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from thermorender import files, formats
from thermorender.errors import ThermorenderError
from thermorender.output import products as product_files
from thermorender.output.resume import is_damaged, load_state, refuse_other_settings, refuse_used, state_file

if TYPE_CHECKING:
    from thermorender.output.flight import Flight

# Folder in that of a flight.
FOLDER = "blocks"
# Fewest frames of a block by default, and their number over that of the warm-up, which is lost work.
_LEAST, _OVER_WARM_UP = 40, 10


@dataclass(frozen=True)
class Block:
    """The record of finished frames."""

    # first, stop: Number of the first frame, and of that behind the last
    first: int
    stop: int
    # before, after: Checksum of the sensor's state before the first frame, "" at the start of a flight, and after the
    # last
    before: str
    after: str
    # Of the frames, as in `frames.jsonl`; left out by `finished_blocks`, since those of a campaign fill the memory
    lines: list[dict[str, Any]]
    settings: str  # Checksum of the flight's settings


def settings_digest(settings: dict[str, Any]) -> str:
    """Return the checksum of a flight's settings."""
    return formats.checksum(json.dumps(settings).encode())


def usual_length(flight: "Flight") -> int:
    """Return the number of frames of a block by default: many more than its warm-up, whole spans of the audit."""
    warm_up = len(flight.times) - flight.flown.warm_up(len(flight.times))
    least = max(_LEAST, _OVER_WARM_UP * warm_up)
    return -(-least // flight.audit) * flight.audit


def join(folder: Path, flight: "Flight") -> None:
    """Write `flight.json` into a folder without flight; refuse one with another flight."""
    described = folder / "flight.json"
    if not described.exists():
        try:
            refuse_used(folder)
        except ThermorenderError:
            # Another process may have joined meanwhile.
            if not described.exists():
                raise
        else:
            formats.write_json(described, flight.described)
    refuse_other_settings(described, flight.settings)


def write_block(flight: "Flight", folder: Path, first: int, stop: int) -> dict[str, Any]:
    """Render frames and write their files and record into a folder with `flight.json`; return {warm_up_s, frames_s,
    moving_s: times of warm-up, frames and moving files; bytes: number written}."""
    name, digest = f"{first:09d}-{stop:09d}", settings_digest(flight.settings)
    # Two processes may render the same block, if one of them was believed to be lost.
    place = folder / FOLDER / f"{name}.{secrets.token_hex(4)}"
    place.mkdir(parents=True)
    try:
        clock = [time.perf_counter()]
        flight.flown.start(first)
        before = _checksum(flight.flown.exposure.state()) if first else ""
        clock.append(time.perf_counter())
        with _without_display(flight):
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


@contextmanager
def _without_display(flight: "Flight") -> Iterator[None]:
    """Let a flight write counts in place of display images that depend on the frames before; see `_shown`."""
    asked = flight.products
    if flight.remembers_display:
        others = (name for name in asked if name not in ("display", "video", "counts"))
        flight.products = (*others, "counts")
    try:
        yield
    finally:
        flight.products = asked


def finished_blocks(folder: Path, settings: dict[str, Any], verify: bool) -> dict[int, Block]:
    """Return {first frame: Block} of the intact blocks of a flight of these settings, the longest of each beginning."""
    found: dict[int, Block] = {}
    digest = settings_digest(settings)
    # Display images that depend on the frames before are made of counts.
    copied = product_files.copied(settings["products"]) | {"counts"}
    for path in sorted((folder / FOLDER).glob("*.json")):
        block = _read(path)
        if block is None or block.settings != digest:
            continue
        known = {folder / name: each for line in block.lines for name, each in line["files"].items()}
        again = {path for line in block.lines for path in product_files.paths(folder, line["index"], copied).values()}
        if not is_damaged(known, again, verify):
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
    """Yield the ranges of frames to render here, in order, and merge the finished blocks between them. The sensor is in
    its state before the range; its frames are written when the next range is asked for."""
    total, kept, after = len(flight.times), finished_blocks(folder, flight.settings, verify), None
    while (done := len(flight.terrain)) < total:
        if done in kept:
            block = kept.pop(done)
            if (after or _resumed(flight, folder, done)) == block.before and _taken_over(flight, folder, block):
                after = block.after
                continue
        stop, after = min((first for first in kept if first > done), default=total), None
        if done:
            flight.restore(folder, done)
        yield range(done, stop)


def _resumed(flight: "Flight", folder: Path, first: int) -> str | None:
    """Take the state of the display before a frame, and return the checksum of the sensor's; None if it is lost."""
    if not first:
        return ""
    state = state_before(folder, first, flight.remembers_display)
    if state is None:
        return None
    flight.agc = state.get("agc")
    return _checksum(state)


def _taken_over(flight: "Flight", folder: Path, block: Block) -> bool:
    """Append the lines of a block to `frames.jsonl`, unless its record was lost. The state stays beside the record."""
    record = folder / FOLDER / f"{block.first:09d}-{block.stop:09d}.json"
    read, kept = _read(record), record.with_suffix(".npz")
    state = formats.read_arrays(kept, block.stop - 1)
    if read is None or state is None:
        return False
    lines = read.lines
    if flight.remembers_display:
        lines = [_shown(flight, folder, line) for line in lines]
        arrays: dict[str, Any] = {**state, "agc": flight.agc}
        data = formats.encoded_arrays(block.stop - 1, arrays)
        files.put_in_place(files.write_aside(kept, data), kept)
    formats.append_json(folder / "frames.jsonl", *map(formats.sealed, lines))
    flight.terrain += [line["shows_terrain"] for line in lines]
    return True


def _shown(flight: "Flight", folder: Path, line: dict[str, Any]) -> dict[str, Any]:
    """Write the display image of a frame from its counts, and return its line with that file."""
    paths = product_files.paths(folder, line["index"], (*flight.products, "counts"))
    counts = formats.decoded(paths["counts"].read_bytes(), -1)
    if counts is None:
        raise ThermorenderError(f"{paths['counts']} is damaged; remove it and continue with resume")
    flight.agc, image = flight.display.image(counts, flight.agc, 1.0 / flight.flown.rate_hz)
    data, path = formats.encoded_image(".png", image), paths["display"]
    files.put_in_place(files.write_aside(path, data), path)
    known = line["files"] | {path.name: [len(data), formats.checksum(data)]}
    own = product_files.paths(folder, line["index"], flight.products).values()
    return line | {"files": {path.name: known[path.name] for path in own}}


def state_before(folder: Path, first: int, display: bool = False) -> dict[str, NDArray[Any]] | None:
    """Return the state before a frame, with that of the display if asked, of the flight or a block; None if lost."""
    kept = [load_state(folder, first - 1)]
    kept += [formats.read_arrays(path, first - 1) for path in (folder / FOLDER).glob(f"*-{first:09d}.npz")]
    return next((state for state in kept if state is not None and ("agc" in state or not display)), None)


def remove_blocks(flight: "Flight", folder: Path) -> None:
    """Remove what only the blocks of a finished flight needed."""
    if (folder / FOLDER).exists() and flight.remembers_display and "counts" not in flight.products:
        for index in range(len(flight.times)):
            product_files.paths(folder, index, ("counts",))["counts"].unlink(missing_ok=True)
    shutil.rmtree(folder / FOLDER, ignore_errors=True)


def _checksum(state: dict[str, NDArray[Any]]) -> str:
    return formats.digest("sensor", {name: values for name, values in state.items() if name != "agc"})


def parse_frames(text: str) -> tuple[int, int]:
    """Return (first, stop) of a text A:B."""
    first, colon, stop = text.partition(":")
    if not (colon and first.isdecimal() and stop.isdecimal() and int(first) < int(stop)):
        raise ThermorenderError(
            f"frames={text!r} is not allowed; give FIRST:STOP, such as 0:100 for the first hundred frames"
        )
    return int(first), int(stop)
