"""The frames of a folder for exports: the EXR files that `render`, `fly` and `day` wrote there."""

import re
from collections.abc import Iterator, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from thermorender.errors import ThermorenderError
from thermorender.frame.exr import read_exr

_FRAME = re.compile(r"frame_(\d{6,})\.exr")
# (number of the frame, {channel: (H, W) array}, record)
ExrFrame = tuple[int, dict[str, NDArray[Any]], dict[str, Any]]


def exr_frames(folder: str | PathLike[str], channels: Sequence[str], entries: Sequence[str]) -> Iterator[ExrFrame]:
    """Yield the frames of a folder in order; each file must have these channels and entries of the record."""
    # Other files, such as a copy of a frame, have no number of their own.
    numbered = {
        int(match[1]): path for path in Path(folder).glob("frame_*.exr") if (match := _FRAME.fullmatch(path.name))
    }
    if not numbered:
        raise ThermorenderError(f"{folder} holds no frame_*.exr; give a folder of a flight with the products exr,truth")
    for number, path in sorted(numbered.items()):
        images, about = read_exr(path)
        missing = next((name for name in channels if name not in images), None)
        missing = missing or next((name for name in entries if name not in about), None)
        if missing:
            raise ThermorenderError(f"{path} has no {missing!r}; render it again with the products exr,truth")
        yield number, images, about
