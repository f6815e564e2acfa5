"""A frame as one file, whose kind is the suffix of its name."""

import json
from collections.abc import Callable
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError
from thermorender.files import atomic
from thermorender.formats import write_image
from thermorender.frame.exr import write_exr
from thermorender.frame.record import header, truth_header
from thermorender.frame.tiff import write_kelvin

if TYPE_CHECKING:
    from thermorender.frame.frame import Frame


def save(frame: "Frame", path: str | PathLike[str]) -> None:
    """Write a frame, as `Frame.save`."""
    suffix = Path(path).suffix.lower()
    if suffix not in WRITERS:
        raise ThermorenderError(f"{path} ends in {suffix or 'no suffix'!r}; give one of {', '.join(WRITERS)}")
    WRITERS[suffix](path, frame)


def images(frame: "Frame") -> dict[str, NDArray[Any]]:
    """Return the images of a frame by the names that files give them: radiance, temperature, counts and the truth."""
    own: dict[str, NDArray[Any]] = {
        "radiance": frame.radiance, "apparent_temperature": frame.apparent_temperature, "counts": frame.counts,
    }  # fmt: skip
    return own | {f"truth.{name}": values for name, values in frame.truth.items()}


def _write_arrays(path: str | PathLike[str], frame: "Frame") -> None:
    about = json.dumps(header(frame, **truth_header(frame)))
    arrays: dict[str, Any] = {**images(frame), "record": np.array(about)}
    # `atomic` keeps the suffix, to which NumPy adds nothing then.
    with atomic(path) as part:
        np.savez_compressed(part, **arrays)


_Writer = Callable[[str | PathLike[str], "Frame"], None]
# {suffix: writer}
WRITERS: dict[str, _Writer] = {
    ".exr": lambda path, frame: write_exr(path, frame, truth=True),
    ".tif": lambda path, frame: write_kelvin(path, frame.apparent_temperature),
    ".tiff": lambda path, frame: write_kelvin(path, frame.apparent_temperature),
    ".png": lambda path, frame: write_image(path, frame.display),
    ".npz": _write_arrays,
}
