"""Files of temperatures of every kind that is read, told apart by their content: one registry for all callers.

A file becomes frames, which are read one after another. What its own settings would correct is for the caller to say.
"""

import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from os import PathLike
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError, ThermorenderWarning
from thermorender.sensor.dji_jpeg import read_dji_jpegs
from thermorender.sensor.flir_jpeg import CONTAINERS, FlirImage, radiometry_of_jpeg, read_flir_jpeg
from thermorender.sensor.flir_sequence import frame_extents, read_flir_frame
from thermorender.sensor.radiometric_files import read_temperature
from thermorender.sensor.radiometry import ThermographySettings
from thermorender.units import ZERO_CELSIUS_K

# What is removed from temperatures at the camera. "air" is air and window, with an emissivity of 1.
Correction = Literal["nothing", "air", "surface and air"]
# {suffix: kind of a file whose content is none of those known}; the reader says what is wrong with it.
_OF_SUFFIX = {
    ".tif": "TIFF", ".tiff": "TIFF", ".jpg": "picture", ".jpeg": "picture", ".seq": "sequence", ".csq": "sequence",
    ".irg": "IRG",
}  # fmt: skip
SUFFIXES = tuple(_OF_SUFFIX)
_TIFF = b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"
# First bytes of InfiRay's files, each with its head's last ones, and the least length of that head.
_IRG, _IRG_HEAD = {b"\xca\xac": b"\xac\xca", b"\xba\xab": b"\xac\xca", b"\x04\xa0": b""}, 78
# Sequences that only FLIR's own programs read.
_CONVERTED = (".ats", ".fcf", ".sfmov")


@dataclass(frozen=True)
class ThermalFrame:
    """A frame of a file, before it is read.

    Attributes
    ----------
    path : Path
    name : str
        The file's name without suffix; of a sequence NAME with a number, NAME_000001 the first.
    kind : str
        Of the file: "TIFF", "FLIR", "DJI", "sequence" or "IRG"; "picture" for a JPEG without temperatures.
    number : int
        In its file, from 0.
    extent : (2,) ints, optional
        (offset, bytes) in a sequence.
    """

    path: Path
    name: str
    kind: str
    number: int = 0
    extent: tuple[int, int] | None = None

    @property
    def label(self) -> str:
        """The name for messages: the file's, or that of a sequence's frame."""
        return self.path.name if self.extent is None else self.name


@dataclass(frozen=True, eq=False)
class ThermalImage:
    """A frame of temperatures.

    Attributes
    ----------
    frame : ThermalFrame
    kelvin : (H, W) float64
        Temperature [K]; NaN where none.
    corrected : str
        A `Correction`, or "unknown": what was removed from the temperatures at the camera.
    settings : ThermographySettings, optional
        Those stored in a file of FLIR.
    saturated : (2,) floats, optional
        Shares of pixels below and above the colour scale that a file of FLIR stores [%].
    words : str
        How another program read the frame, as the rest of a sentence after a number; else empty.
    air_c : float, optional
        Temperature of the air [°C] that this program was given.
    """

    frame: ThermalFrame
    kelvin: NDArray[np.float64]
    corrected: str
    settings: ThermographySettings | None = None
    saturated: tuple[float, float] | None = None
    words: str = ""
    air_c: float | None = None


@dataclass(frozen=True)
class _Wanted:
    """How `thermal_images` was asked to read."""

    scale: tuple[float, float] | None
    correction: Correction
    air_c: float | None
    takes_scale: bool


def files_of(folder: Path) -> list[Path]:
    """Return the thermal files of a folder, sorted by name, without hidden ones.

    JPEGs without temperatures are left out where other files have some, and a warning counts them.
    """
    # macOS keeps a file ._NAME beside each NAME on drives of other systems.
    inside = (each for each in folder.iterdir() if not each.name.startswith(".") and not each.is_dir())
    found = sorted(each for each in inside if each.suffix.lower() in SUFFIXES)
    thermal = [each for each in found if is_radiometric(each)]
    pictures = [each.name for each in found if each not in set(thermal)]
    if thermal and pictures:
        warnings.warn(
            f"{len(pictures)} JPEGs of {folder} hold no temperatures and are left out, such as {pictures[0]}",
            ThermorenderWarning, stacklevel=2,
        )  # fmt: skip
    return thermal or found


def is_radiometric(path: str | PathLike[str]) -> bool:
    """Return whether a file is of a kind that holds temperatures, by its content."""
    return _kind(Path(path)) not in ("picture", "")


def thermal_frames(paths: Iterable[str | PathLike[str]]) -> list[ThermalFrame]:
    """Return the ThermalFrames of files, in their order; a sequence has several.

    Raises
    ------
    ThermorenderError
        A file of another kind, or a sequence that is not whole.
    """
    found = []
    for path in map(Path, paths):
        kind = _kind(path)
        if kind == "sequence":
            extents = enumerate(frame_extents(path))
            found += [ThermalFrame(path, f"{path.stem}_{k + 1:06d}", kind, k, extent) for k, extent in extents]
        elif kind:
            found.append(ThermalFrame(path, path.stem, kind))
        else:
            raise ThermorenderError(
                f"{path} is of unknown kind; give one of {', '.join(SUFFIXES)}{sequence_hint([path])}"
            )
    return found


def thermal_images(
    frames: Iterable[ThermalFrame], scale: tuple[float, float] | None = None,
    correction: Correction = "surface and air", air_c: float | None = None, *, takes_scale: bool = True,
) -> Iterator[ThermalImage]:  # fmt: skip
    """Yield the ThermalImage of each frame, in their order, with few in memory at a time.

    Parameters
    ----------
    frames : iterable of ThermalFrame
    scale : (2,) floats, optional
        (kelvin per count, kelvin of count 0) of TIFFs that do not declare them.
    correction : str
        What is removed by the settings stored in files of FLIR: "nothing", "air" (and window) or "surface and air".
        DJI's are read without any, and what other programs removed is unknown.
    air_c : float, optional
        Temperature of the air [°C] for files of DJI, of which it moves all temperatures; by default the file's own.
    takes_scale : bool
        Whether the user can state a scale.

    Raises
    ------
    ThermorenderError
        A file that is damaged, holds no temperatures, lacks its unit or needs another program.
    """
    wanted = _Wanted(scale, correction, air_c, takes_scale)
    for kind, some in groupby(frames, key=lambda frame: frame.kind):
        yield from _READERS[kind]([*some], wanted)


def read_thermal_image(
    path: str | PathLike[str], scale: tuple[float, float] | None = None, correction: Correction = "surface and air",
    *, takes_scale: bool = True,
) -> ThermalImage:  # fmt: skip
    """Return the ThermalImage of a file of one frame, as `thermal_images` reads it."""
    frames = thermal_frames([path])
    if len(frames) > 1:
        raise ThermorenderError(f"{path} is a sequence of {len(frames)} frames; give a file of one")
    return next(thermal_images(frames, scale, correction, takes_scale=takes_scale))


def sequence_hint(paths: Iterable[Path]) -> str:
    """Return how to convert FLIR's sequences that are not read, after another sentence; empty without any."""
    found = next((path.name for path in paths if path.suffix.lower() in _CONVERTED), None)
    if found is None:
        return ""
    return (
        f"; {found} is a sequence that only FLIR's own programs read, so export it as SEQ, or its frames as TIFF in "
        "kelvin, for example with FLIR Research Studio"
    )


def _kind(path: Path) -> str:
    """Kind of a file: a key of `_READERS`, or empty."""
    suffix = path.suffix.lower()
    if suffix in _CONVERTED:
        return ""
    try:
        with path.open("rb") as file:
            head = file.read(4)
            if head.startswith(CONTAINERS):
                return "sequence"
            if head.startswith(_TIFF):
                return "TIFF"
            if head.startswith(b"\xff\xd8"):
                file.seek(0)
                return radiometry_of_jpeg(file) or "picture"
            length = int.from_bytes(head[2:], "little")
            if head[:2] in _IRG and length >= _IRG_HEAD:
                file.seek(0)
                last = file.read(length)
                if len(last) == length and last.endswith(_IRG[head[:2]]):
                    return "IRG"
    except OSError:
        pass  # Who reads the file says what is wrong with it.
    return _OF_SUFFIX.get(suffix, "")


def _tiffs(frames: Sequence[ThermalFrame], wanted: _Wanted) -> Iterator[ThermalImage]:
    for frame in frames:
        kelvin = read_temperature(frame.path, wanted.scale, takes_scale=wanted.takes_scale)
        yield ThermalImage(frame, kelvin, "unknown")


def _flir_jpegs(frames: Sequence[ThermalFrame], wanted: _Wanted) -> Iterator[ThermalImage]:
    for frame in _calibrated(frames, wanted):
        yield _of_flir(frame, read_flir_jpeg(frame.path), wanted)


def _sequences(frames: Sequence[ThermalFrame], wanted: _Wanted) -> Iterator[ThermalImage]:
    for frame in _calibrated(frames, wanted):
        assert frame.extent is not None
        yield _of_flir(frame, read_flir_frame(frame.path, frame.number, frame.extent), wanted)


def _of_flir(frame: ThermalFrame, found: FlirImage, wanted: _Wanted) -> ThermalImage:
    stored = found.thermography
    settings = {
        "nothing": ThermographySettings(), "air": replace(stored, emissivity=1.0), "surface and air": stored,
    }[wanted.correction]  # fmt: skip
    ends, saturated = found.camera["scale_raw"], None
    if ends is not None:
        saturated = 100.0 * float((found.raw < ends[0]).mean()), 100.0 * float((found.raw > ends[1]).mean())
    return ThermalImage(frame, found.temperature(settings), wanted.correction, stored, saturated)


def _dji_jpegs(frames: Sequence[ThermalFrame], wanted: _Wanted) -> Iterator[ThermalImage]:
    paths = [frame.path for frame in _calibrated(frames, wanted)]
    for frame, found in zip(frames, read_dji_jpegs(paths, wanted.air_c), strict=True):
        words = f"radiometric JPEGs of DJI were read by {found.words}"
        yield ThermalImage(frame, found.kelvin, "nothing", words=words, air_c=found.reflected_c)


def _irgs(frames: Sequence[ThermalFrame], wanted: _Wanted) -> Iterator[ThermalImage]:
    try:
        import infiray_irg
    except ImportError:
        raise ThermorenderError(
            f"{frames[0].path} is of InfiRay, whose reading needs infiray-irg, which is not installed; run pip install "
            "'thermorender[thermal-files]'"
        ) from None
    for frame in _calibrated(frames, wanted):
        try:
            celsius = np.asarray(infiray_irg.load(frame.path.read_bytes())[1], np.float64)
        except OSError as error:
            raise ThermorenderError(f"{frame.path} cannot be read: {error}; give a file of InfiRay") from None
        except Exception as error:  # what damaged files lead to in the package
            raise ThermorenderError(
                f"{frame.path} is not a whole IRG file: {error}; give the camera's original file"
            ) from None
        kelvin = celsius + ZERO_CELSIUS_K
        words = f"files of InfiRay were read by infiray-irg {infiray_irg.__version__}"
        yield ThermalImage(frame, np.where(kelvin > 0.0, kelvin, np.nan), "unknown", words=words)


def _pictures(frames: Sequence[ThermalFrame], wanted: _Wanted) -> Iterator[ThermalImage]:
    raise ThermorenderError(
        f"{frames[0].path} is a picture without temperatures; give the camera's radiometric file, whose name ends in "
        "_T or _R for most cameras of DJI, or leave it out"
    )


def _calibrated(frames: Sequence[ThermalFrame], wanted: _Wanted) -> Sequence[ThermalFrame]:
    """The frames of files that contain their calibration; raise if a scale was given."""
    if wanted.scale is not None:
        raise ThermorenderError(f"{frames[0].path} contains its calibration; leave out the scale")
    return frames


_READERS: dict[str, Callable[[Sequence[ThermalFrame], _Wanted], Iterator[ThermalImage]]] = {
    "TIFF": _tiffs, "FLIR": _flir_jpegs, "DJI": _dji_jpegs, "sequence": _sequences, "IRG": _irgs,
    "picture": _pictures,
}  # fmt: skip
