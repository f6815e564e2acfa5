"""The files of a flight's frame: written under temporary names, then put in place with the frame's line."""

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender import files, formats
from thermorender.errors import ThermorenderError
from thermorender.output.resume import refuse_moved
from thermorender.timing import phase


@dataclass(frozen=True)
class Prepared:
    """A frame whose files are on the disk under temporary names."""

    line: dict[str, Any]  # The frame's line in `frames.jsonl`
    parts: dict[Path, Path]  # {path: temporary file}
    image: NDArray[np.uint8] | None = None  # (H, W) or (H, W, 3) display image, for the video

    def discard(self) -> None:
        """Remove the temporary files."""
        for part in self.parts.values():
            part.unlink(missing_ok=True)


def prepare(
    folder: Path, place: os.stat_result, line: Callable[[], dict[str, Any]],
    encoders: Mapping[Path, Callable[[], bytes]], state: tuple[Path, Callable[[], bytes]],
    image: NDArray[np.uint8] | None = None,
) -> Prepared:  # fmt: skip
    """Write the files of a frame, {path: returns the bytes}, under temporary names in a folder, identified by `place`.
    `line` returns the frame's line in `frames.jsonl` without its files. `state` (path, returns the bytes) is the
    sensor's. It is not in the line and not synced to the disk, as a resume can do without it. `image` is as in
    Prepared."""
    frame, known = Prepared({}, {}), {}
    try:
        refuse_moved(folder, place)
        for path, encode in (*encoders.items(), state):
            with files.reported(path), phase(f"writer: {path.suffix} encoded"):
                data = encode()
            with phase("writer: files written"):
                frame.parts[path] = files.write_aside(path, data)
            if path in encoders:
                with phase("writer: checksums"):
                    known[path.name] = [len(data), formats.checksum(data)]
        with phase("writer: files on the disk"):
            files.on_disk(*(frame.parts[path] for path in encoders))
        return Prepared(line() | {"files": known}, frame.parts, image)
    except BaseException as error:
        frame.discard()
        if isinstance(error, ThermorenderError):
            # A folder that is gone has a sentence of its own.
            refuse_moved(folder, place)
        raise


@phase("writer: names and lines")
def put_in_place(folder: Path, place: os.stat_result, described: Callable[[], dict[str, Any]], frame: Prepared) -> None:
    """Give the files of a frame their names, then append its line to `frames.jsonl`. The first frame also writes
    `flight.json`, the value of `described`: an error before it leaves no files."""
    refuse_moved(folder, place)
    if not (folder / "flight.json").exists():
        formats.write_json(folder / "flight.json", described())
    for path, part in frame.parts.items():
        files.put_in_place(part, path)
    files.on_disk(folder)
    formats.append_json(folder / "frames.jsonl", formats.sealed(frame.line))
