"""Temperatures of DJI's radiometric JPEGs, whose calibration is not public: by a program that the user has installed.

DJI's settings are not physics: from 25 to −20 °C of reflected and air temperature, the median of a picture moves by 1.7
to 5.4 K. So the program is asked for a blackbody at the least distance that it accepts, with reflected and air
temperature the same: what the camera sees, before any correction for surface and air.
"""

import shutil
import subprocess
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError, shortened
from thermorender.files import scratch_folder
from thermorender.formats import finite_json
from thermorender.units import ZERO_CELSIUS_K

# From PyPI, for Python 3.12 and later. It equals DJI's own library for eight of nine kinds of cameras.
PROGRAM = "dji-thermal-cli"
# Pictures that the program reads in one call, which takes about a second a picture at most, and the longest call.
_AT_ONCE, _LIMIT_S = 32, 120.0
_ADVICE = (
    f"install the program {PROGRAM}, for example with `pipx install {PROGRAM}`, or convert the file with the DJI "
    "Thermal SDK, `dji_irp -s IN.JPG -a measure -o OUT.raw`, save these int16 values as TIFF and give "
    f"scale=0.1,{ZERO_CELSIUS_K}"
)


@dataclass(frozen=True, eq=False)
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
            f"{self.program}, as a blackbody at {self.distance_m:g} m, reflected and air {self.reflected_c:.4g} °C, "
            f"humidity {self.humidity_percent:g} %"
        )


@dataclass(frozen=True)
class _Stored:
    """What the program lists of a picture: settings, and the least distance that it accepts [m]."""

    settings: dict[str, float]
    least_m: float
    air_c: float  # Reflected and air temperature of the reading [°C]

    @property
    def states_air(self) -> bool:
        return "ambient_temp" in self.settings


def read_dji_jpegs(paths: Sequence[str | PathLike[str]], air_c: float | None = None) -> Iterator[DjiReading]:
    """Yield the DjiReading of each file, by `dji-thermal-cli` on the search path; 32 files need two or three calls.

    `air_c` is the reflected and air temperature [°C]: by default the air's that the camera stored, or its reflected one
    where it stored no other.

    Raises
    ------
    ThermorenderError
        No such program, or one that refuses a file, takes more than two minutes or writes something else.
    """
    files = [Path(path).absolute() for path in paths]
    program = shutil.which(PROGRAM)
    if files and program is None:
        raise ThermorenderError(
            f"{files[0]} is a radiometric JPEG of DJI, whose calibration is not public, and {PROGRAM} is not "
            f"installed; {_ADVICE}"
        )
    for start in range(0, len(files), _AT_ONCE):
        with scratch_folder() as scratch:
            yield from _read(files[start : start + _AT_ONCE], str(program), air_c, scratch)


def _read(paths: Sequence[Path], program: str, air_c: float | None, scratch: Path) -> Iterator[DjiReading]:
    stored = _stored(paths, program, air_c, scratch / "all")
    # {number of a picture: (its TIFF, distance)}, and what the program says of the others.
    made, refusals = dict[int, tuple[Path, float]](), dict[int, str]()
    # Some files have a calibration for their own distance and farther ones only.
    for turn in ("least", "own"):
        groups: dict[tuple[float, float, bool], list[int]] = {}
        for number, each in enumerate(stored):
            if number not in made:
                distance = each.least_m if turn == "least" else each.settings["distance"]
                groups.setdefault((distance, each.air_c, each.states_air), []).append(number)
        for place, (how, members) in enumerate(groups.items()):
            folder = scratch / f"{turn}_{place}"
            said = _processed(paths, members, program, how, folder)
            for number in members:
                written = folder / "out" / f"{number:06d}_temp_k.tiff"
                if written.is_file():
                    made[number] = written, how[0]
                    continue
                lines = [line for line in said.splitlines() if "refused" in line or "skip" in line]
                own = [line for line in lines if f"{number:06d}" in line] or lines
                refusals.setdefault(number, own[0].strip() if own else "")
    for number, (path, each) in enumerate(zip(paths, stored, strict=True)):
        if number not in made:
            said = refusals[number]
            raise _failed(path, f"it says {shortened(ascii(said))}" if said else "it wrote no temperatures")
        written, distance = made[number]
        humidity = each.settings.get("humidity", np.nan)
        yield DjiReading(_kelvin(path, written), _version(path, program), distance, humidity, each.air_c)


def _processed(
    paths: Sequence[Path], members: Sequence[int], program: str, how: tuple[float, float, bool], folder: Path
) -> str:
    """Let the program write the temperatures of some pictures into the folder's `out`; return what it says."""
    distance, air, states_air = how
    _linked(paths, members, folder / "in")
    options = [f"--distance={distance!r}", f"--reflected-temp={air!r}", "--emissivity=1"]
    options += [f"--ambient-temp={air!r}"] if states_air else []
    return _run(
        paths[members[0]], program, "process", f"--input-dir={folder / 'in'}", f"--output-dir={folder / 'out'}",
        *options, "--output=temp_k:tiff", "--compression=none", "--quiet",
    )  # fmt: skip


def _linked(paths: Sequence[Path], members: Sequence[int], folder: Path) -> None:
    """Make a folder of some pictures, named by their numbers, since the program reads a file or a folder."""
    folder.mkdir(parents=True)
    for number in members:
        link = folder / f"{number:06d}.jpg"
        try:
            link.symlink_to(paths[number])
        except OSError:  # as on Windows, without the right to make links
            shutil.copyfile(paths[number], link)


_VERSIONS: dict[str, str] = {}


def _version(path: Path, program: str) -> str:
    """Name and version of the program, which is asked once."""
    if program not in _VERSIONS:
        said = _run(path, program, "--version").strip().splitlines()
        _VERSIONS[program] = shortened(ascii(said[-1]))[1:-1] if said else PROGRAM
    return _VERSIONS[program]


def _stored(paths: Sequence[Path], program: str, air_c: float | None, folder: Path) -> list[_Stored]:
    """What the program lists of each picture."""
    _linked(paths, range(len(paths)), folder)
    text = _run(paths[0], program, "list", f"--input-dir={folder}", "--format=json", "--no-stats")
    try:
        listed = {str(entry["file"]["name"]): entry["thermal"] for entry in finite_json(text[text.index("[") :])}
    except (ValueError, TypeError, KeyError):
        raise _failed(paths[0], "its list of settings cannot be read") from None
    return [_settings(path, listed.get(f"{number:06d}.jpg"), air_c) for number, path in enumerate(paths)]


def _settings(path: Path, thermal: Any, air_c: float | None) -> _Stored:
    """The settings that the program lists of one picture."""
    if thermal is None:
        raise _failed(path, "it does not list the file")
    try:
        settings, ranges = thermal["measurement_params"], thermal["measurement_params_range"]
        stored = {str(name): float(value) for name, value in settings.items() if value is not None}
        least = float((ranges.get("distance") or (stored.get("distance", np.nan),))[0])
    except (ValueError, TypeError, KeyError, IndexError, AttributeError):
        raise _failed(path, "its list of settings cannot be read") from None
    air = stored.get("ambient_temp", stored.get("reflection")) if air_c is None else air_c
    if air is None or "distance" not in stored:
        raise _failed(path, "it states no distance or no temperature")
    if not np.isfinite([*stored.values(), least]).all():
        raise _failed(path, "its settings are not finite")
    return _Stored(stored, least, air)


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
