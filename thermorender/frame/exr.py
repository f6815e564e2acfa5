"""A frame as one multi-channel EXR, written and read."""

import io
import json
import os
from collections.abc import Callable
from dataclasses import asdict
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from thermorender import defaults
from thermorender.errors import ThermorenderError
from thermorender.files import atomic
from thermorender.frame.record import header, truth_header
from thermorender.sensor.radiometry import ThermographySettings, thermography_reading

if TYPE_CHECKING:
    from thermorender.frame.frame import Frame


# {name: OpenEXR's}; all are lossless.
COMPRESSIONS = {"zip": "ZIP", "htj2k32": "HTJ2K32", "rle": "RLE", "none": "NO"}


def write_exr(
    path: str | PathLike[str], frame: "Frame", truth: bool, thermography: ThermographySettings | None = None,
    error: bool = False,
) -> None:  # fmt: skip
    """Write a frame's radiance and apparent temperature as one multi-channel EXR.

    `truth` adds the frame's truth, `error` the estimated error of each pixel, and `thermography` the reading of
    thermography software with these settings. The header's `thermorender` attribute holds time, pose, seed, plan,
    versions, device, units and, with the truth, the entries of `truth_header` as JSON.
    """
    with atomic(path) as part:
        part.write_bytes(exr_encoder(frame, truth, thermography, error)())


def exr_encoder(
    frame: "Frame", truth: bool, thermography: ThermographySettings | None = None, error: bool = False,
    compression: str = defaults.EXR_COMPRESSION,
) -> Callable[[], bytes]:  # fmt: skip
    """Return a function that returns the bytes of `write_exr`; it may run in another thread.

    Raises
    ------
    ThermorenderError
        A compression that is not in `COMPRESSIONS`.
    """
    import OpenEXR  # type: ignore[import-not-found, unused-ignore]

    # What needs the renderer is computed here, and the rest in the function.
    seen, errors = frame.truth if truth else {}, frame.error_mk if error else None
    about = header(frame, thermography=thermography and asdict(thermography))
    about |= truth_header(frame) if truth else {}
    attributes = {
        "compression": getattr(OpenEXR, f"{COMPRESSIONS[check_compression(compression)]}_COMPRESSION"),
        "type": OpenEXR.scanlineimage,
        "thermorender": json.dumps(about),
    }

    def encode() -> bytes:
        channels = {"radiance": frame.radiance, "apparent_temperature": frame.apparent_temperature}
        if thermography is not None:
            channels["thermography_temperature"] = thermography_reading(frame.counts, frame.camera, thermography)
        if errors is not None:
            channels["error"] = errors
        for name, values in seen.items():
            if values.dtype.kind == "u":
                channels[f"truth.{name}"] = values.astype(np.uint32)
            elif values.ndim == 3:
                for axis, letter in enumerate("xyz"):
                    channels[f"truth.{name}.{letter}"] = np.ascontiguousarray(values[..., axis])
            else:
                channels[f"truth.{name}"] = values
        memory = io.BytesIO()
        OpenEXR.File(attributes, channels).write(memory)
        return memory.getvalue()

    return encode


def check_compression(name: str) -> str:
    """Return the name of a compression of EXR; raise ThermorenderError if it is unknown."""
    if name not in COMPRESSIONS:
        raise ThermorenderError(f"exr_compression={name!r} is unknown; give one of {', '.join(COMPRESSIONS)}")
    return name


def read_exr(path: str | PathLike[str]) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Return ({channel: (H, W) array}, the frame's record) of an EXR written by `write_exr`.

    Raises
    ------
    ThermorenderError
        A file that does not exist or cannot be read.
    """
    import OpenEXR  # type: ignore[import-not-found, unused-ignore]

    if not os.path.isfile(path):
        raise ThermorenderError(f"{path} does not exist; give an EXR file written by thermorender")
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
            return channels, json.loads(file.header().get("thermorender", "{}"))
    except (RuntimeError, ValueError, TypeError) as error:
        raise ThermorenderError(
            f"{path} cannot be read as EXR: {error}; give a whole file written by thermorender"
        ) from None
