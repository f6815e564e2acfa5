"""A frame as one multi-channel EXR, written and read."""

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.files import atomic
from thermorender.output.record import made_by, record
from thermorender.sensor.radiometry import thermography_reading


def write_exr(path, frame, truth, thermography=None, error=False):
    """Write a frame's radiance and apparent temperature, and its truth where asked, as one multi-channel EXR.

    With `error`, what each pixel errs by is estimated beside them; with `thermography` settings, what such software
    reads from the counts stands there. The header's `thermorender` attribute holds time, pose, seed, plan, versions,
    device and units as JSON.
    """
    import OpenEXR

    channels = {"radiance": frame.radiance, "apparent_temperature": frame.apparent_temperature}
    if thermography is not None:
        channels["thermography_temperature"] = thermography_reading(frame.counts, frame.camera, thermography)
    if error and frame.error_mk is not None:
        channels["error"] = frame.error_mk
    if truth:
        for name, values in frame.truth.items():
            if values.dtype == np.uint8:
                channels[f"truth.{name}"] = values.astype(np.uint32)
            elif values.ndim == 3:
                for axis, letter in enumerate("xyz"):
                    channels[f"truth.{name}.{letter}"] = np.ascontiguousarray(values[..., axis])
            else:
                channels[f"truth.{name}"] = values
    units = {
        "radiance": "W m-2 sr-1",
        "apparent_temperature": "K",
        "thermography_temperature": "K",
        "error": "mK at 300 K",
        "truth.kinetic_temperature": "K",
        "truth.depth": "m along the optical axis",
        "truth.position": "m, local East-North-Up",
    }
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "thermorender": json.dumps(
            {**record(frame), **made_by(), "thermography": thermography and asdict(thermography), "units": units}
        ),
    }
    # A file opened here, since OpenEXR's own does not tell where its last bytes found no room.
    with atomic(path) as part, open(part, "wb") as file:
        OpenEXR.File(header, channels).write(file)


def read_exr(path):
    """Return ({channel: (H, W) array}, the frame's record) of an EXR written by `write_exr`."""
    import OpenEXR

    if not Path(path).is_file():
        raise ThermorenderError(f"{path} does not exist; give an EXR file written by thermorender")
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
            return channels, json.loads(file.header().get("thermorender", "{}"))
    except (RuntimeError, ValueError, TypeError) as error:
        raise ThermorenderError(
            f"{path} cannot be read as EXR: {error}; give a whole file written by thermorender"
        ) from None
