"""Temperatures of DJI's radiometric JPEGs, whose calibration is not public: by a program that the user has installed.

DJI's settings are not physics: from 25 to −20 °C of reflected and air temperature, the median of a picture moves by 1.7
to 5.4 K. So the program is asked for a blackbody at the least distance that it accepts, with reflected and air
temperature the same: what the camera sees, before any correction for surface and air.
"""

import shutil
import subprocess
import warnings
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError, shortened
from thermorender.files import scratch_folder
from thermorender.formats import finite_json
from thermorender.sensor.flir_jpeg import dji_thermal
from thermorender.units import ZERO_CELSIUS_K

# From PyPI, for Python 3.12 and later. It equals DJI's own library for eight of nine kinds of cameras.
PROGRAM = "dji-thermal-cli"
_LIMIT_S = 120.0
_ADVICE = (
    f"install the program {PROGRAM}, for example with `pipx install {PROGRAM}`, or convert the file with the DJI "
    "Thermal SDK, `dji_irp -s IN.JPG -a measure -o OUT.raw`, save these int16 values as TIFF and give "
    f"scale=0.1,{ZERO_CELSIUS_K}"
)


@dataclass(frozen=True)
class DjiReading:
    """A radiometric JPEG of DJI as its program reads it."""

    kelvin: NDArray[np.float64]  # (H, W) apparent temperature at the camera [K]; NaN where none
    program: str  # its name and version
    # Settings of the reading; those that the camera does not have are NaN
    distance_m: float
    humidity_percent: float
    reflected_c: float  # and of the air

    @property
    def words(self) -> str:
        """The program and the settings in words."""
        return (
            f"{self.program}, as a blackbody at {self.distance_m:g} m, reflected and air {self.reflected_c:g} °C, "
            f"humidity {self.humidity_percent:g} %"
        )


def is_dji_jpeg(path: str | PathLike[str]) -> bool:
    """Return whether a file is DJI's radiometric JPEG; False for one that cannot be read."""
    try:
        return dji_thermal(Path(path).read_bytes())
    except OSError:
        return False


def read_dji_jpeg(path: str | PathLike[str]) -> DjiReading:
    """Return the DjiReading of a file, by `dji-thermal-cli` on the search path, in about a second of one core.

    Reflected and air temperature are the air's that the camera stored, or its reflected one where it stored no other.

    Raises
    ------
    ThermorenderError
        No such program, or one that refuses the file, takes more than two minutes or writes something else.
    """
    path = Path(path).absolute()
    program = shutil.which(PROGRAM)
    if program is None:
        raise ThermorenderError(
            f"{path} is a radiometric JPEG of DJI, whose calibration is not public, and {PROGRAM} is not installed; "
            f"{_ADVICE}"
        )
    stored, allowed = _stored(path, program)
    air = stored.get("ambient_temp", stored.get("reflection"))
    if air is None or "distance" not in stored:
        raise _failed(path, "it states no distance or no temperature")
    least = allowed.get("distance", (stored["distance"],) * 2)[0]
    options = [f"--reflected-temp={air!r}", "--emissivity=1"]
    options += [f"--ambient-temp={air!r}"] if "ambient_temp" in stored else []
    refusal = ""
    # Some files have a calibration for their own distance and farther ones only.
    for distance in dict.fromkeys((least, stored["distance"])):
        with scratch_folder() as scratch:
            place = f"--input-dir={path}", f"--output-dir={scratch}", f"--distance={distance!r}"
            said = _run(
                path, program, "process", *place, *options, "--output=temp_k:tiff", "--compression=none", "--jobs=1",
                "--quiet",
            )  # fmt: skip
            made = sorted(scratch.rglob("*_temp_k.tif*"))
            if len(made) == 1:
                kelvin = _kelvin(path, made[0])
                return DjiReading(kelvin, _version(path, program), distance, stored.get("humidity", np.nan), air)
        refusal = refusal or next((line for line in said.splitlines() if "refused" in line or "skip" in line), "")
    raise _failed(path, f"it says {shortened(ascii(refusal.strip()))}" if refusal else "it wrote no temperatures")


_VERSIONS: dict[str, str] = {}


def _version(path: Path, program: str) -> str:
    """Name and version of the program, which is asked once."""
    if program not in _VERSIONS:
        said = _run(path, program, "--version").strip().splitlines()
        _VERSIONS[program] = shortened(ascii(said[-1]))[1:-1] if said else PROGRAM
    return _VERSIONS[program]


def _stored(path: Path, program: str) -> tuple[dict[str, float], dict[str, tuple[float, float]]]:
    """({setting: its value in the file}, {setting: (least, greatest) that the program accepts})."""
    text = _run(path, program, "list", f"--input-dir={path}", "--format=json", "--no-stats", "--jobs=1")
    try:
        (entry,) = finite_json(text[text.index("[") :])
        thermal = entry["thermal"]
        settings, ranges = thermal["measurement_params"], thermal["measurement_params_range"]
        stored = {str(name): float(value) for name, value in settings.items() if value is not None}
        allowed = {str(name): (float(ends[0]), float(ends[1])) for name, ends in ranges.items() if ends is not None}
    except (ValueError, TypeError, KeyError, IndexError, AttributeError):
        raise _failed(path, "its list of settings cannot be read") from None
    if not np.isfinite([*stored.values(), *(end for ends in allowed.values() for end in ends)]).all():
        raise _failed(path, "its settings are not finite")
    return stored, allowed


def _kelvin(path: Path, made: Path) -> NDArray[np.float64]:
    """Temperatures (H, W) [K] of a TIFF that the program wrote; 0 is no data."""
    import rasterio

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
            with rasterio.open(made) as file:
                kind, values = file.dtypes[0], file.read(1).astype(np.float64)
    except rasterio.errors.RasterioError:
        raise _failed(path, "its TIFF cannot be read") from None
    if not kind.startswith("float"):
        raise _failed(path, f"it wrote {kind} in place of kelvin")
    return np.where(np.isfinite(values) & (values > 0.0), values, np.nan)


def _run(path: Path, *command: Any) -> str:
    """What the program writes; raise where it fails or takes too long."""
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, errors="replace", timeout=_LIMIT_S, check=False,
            stdin=subprocess.DEVNULL,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        raise _failed(path, f"it took more than {_LIMIT_S:g} s") from None
    except OSError as error:
        raise _failed(path, f"it cannot be started ({error.strerror})") from None
    if done.returncode:
        lines = [line for line in (done.stderr + done.stdout).splitlines() if line.strip()]
        words = f"it says {shortened(ascii(lines[-1].strip()))}" if lines else f"it ended with {done.returncode}"
        raise _failed(path, words)
    return done.stdout


def _failed(path: Path, reason: str) -> ThermorenderError:
    return ThermorenderError(
        f"{path} is a radiometric JPEG of DJI that {PROGRAM} did not read: {reason}; give the camera's original file, "
        "update the program, or convert the file with the DJI Thermal SDK to a TIFF in kelvin"
    )
