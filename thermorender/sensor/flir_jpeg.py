"""Read FLIR's radiometric JPEGs: the raw signal, the factory's constants and the settings stored with it.

The container ("FFF"), split over APP1 segments, has a directory of records: the raw image is record 1 (16-bit values,
plain, PNG with swapped bytes, or JPEG-LS in sequences), the camera's block 0x20. Field offsets are from ExifTool's FLIR
tables (https://exiftool.org/TagNames/FLIR.html).
"""

import io
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError
from thermorender.formats import refuse_overstated
from thermorender.sensor.radiometry import AirModel, PlanckConstants, ThermographySettings, thermography_temperature
from thermorender.units import ZERO_CELSIUS_K

_FLIR = b"FLIR\0"
_RAW, _CAMERA = 0x01, 0x20
_MOST_PIXELS = 1 << 26
_MOST_RECORDS = 512
# First bytes of a container, and sizes of its head and of an entry of its directory.
CONTAINERS = b"FFF\0", b"AFF\0"
HEAD_BYTES, ENTRY_BYTES = 64, 32


@dataclass(frozen=True, eq=False)
class FlirImage:
    """A radiometric JPEG, or a frame of a sequence."""

    raw: NDArray[np.uint16]  # (H, W) uint16 signal of the detector
    planck: PlanckConstants  # Of the factory's calibration, with `raw` as the signal
    thermography: ThermographySettings  # Settings stored in the file
    air: AirModel
    # model, serial, lens, range_c (the calibrated range) and scale_raw (the signals at the ends of the colour scale;
    # None if the file has none)
    camera: dict[str, Any]

    def temperature(self, thermography: ThermographySettings | None = None) -> NDArray[np.float64]:
        """Return the reading of thermography software, (H, W) float64 [K], with the stored or other settings."""
        return thermography_temperature(self.raw, self.planck, thermography or self.thermography, self.air)


def read_flir_jpeg(path: str | PathLike[str]) -> FlirImage:
    """Return the FlirImage of a radiometric JPEG."""
    path = Path(path)
    try:
        with path.open("rb") as file:
            return flir_image(_container(file))
    except Damaged as error:
        raise ThermorenderError(
            f"{path} is not a whole FLIR radiometric JPEG: {error}; give the camera's original file"
        ) from None
    except OSError as error:
        raise ThermorenderError(f"{path} cannot be read: {error.strerror}; give a radiometric JPEG") from None


def flir_image(container: bytes) -> FlirImage:
    """Return the FlirImage of an FFF container; raise `Damaged` where it is not whole."""
    try:
        records = _records(container)
        missing = [name for kind, name in ((_RAW, "raw image"), (_CAMERA, "camera block")) if kind not in records]
        if missing:
            raise Damaged(f"it holds no {' and no '.join(missing)}")
        raw = _raw_image(records[_RAW])
        try:
            return FlirImage(raw, **_camera_block(records[_CAMERA]))
        except ThermorenderError as error:
            raise Damaged(str(error)) from None
    except struct.error:
        raise Damaged("a record ends too early") from None


def radiometry_of_jpeg(file: BinaryIO) -> str:
    """Return whose radiometric data a JPEG carries: "FLIR", "DJI" or, without any, ""; only its segments are read.

    DJI's have their signal in segments APP3, and their calibration is not public. DJI's cameras with a FLIR core store
    FLIR's data. Source: GDAL's JPEG driver (pull request 12972: H20T, M30T, M3T).
    """
    signal, dji, flir = 0, False, False
    for marker, segment in _segments(file):
        signal += len(segment) if marker == 0xE3 else 0
        dji = dji or (marker == 0xE1 and b"DJI" in segment)
        flir = flir or (marker == 0xE1 and segment.startswith(_FLIR))
    return "DJI" if dji and signal > 8192 else "FLIR" if flir else ""


def _segments(file: BinaryIO) -> Iterator[tuple[int, bytes]]:
    """(marker, content) of a JPEG's segments before its picture; none of another file."""
    if file.read(2) != b"\xff\xd8":
        return
    while len(head := file.read(4)) == 4 and head[0] == 0xFF:
        marker, length = head[1], int.from_bytes(head[2:], "big")
        yield marker, file.read(max(length - 2, 0))
        if marker in (0xD9, 0xDA) or length < 2:
            break


class Damaged(Exception):
    """A defect of a file's contents, as half a sentence."""


def _container(file: BinaryIO) -> bytes:
    """The FFF container, joined from the JPEG's APP1 segments by their number."""
    if file.read(2) != b"\xff\xd8":
        raise Damaged("it is not a JPEG")
    file.seek(0)
    parts: dict[int, bytes] = {}
    for marker, segment in _segments(file):
        if marker == 0xE1 and segment.startswith(_FLIR) and len(segment) > 8:
            parts[segment[6]] = segment[8:]
            last = segment[7]
    if not parts:
        raise Damaged("it carries no FLIR data")
    if sorted(parts) != list(range(last + 1)):
        raise Damaged(f"it announces {last + 1} pieces of FLIR data and holds {len(parts)}")
    return b"".join(parts[number] for number in sorted(parts))


def directory(head: bytes) -> tuple[str, int, int]:
    """Return (byte order, offset, number of entries) of the directory of a container's records, by its first bytes."""
    if head[:4] not in CONTAINERS or len(head) < HEAD_BYTES:
        raise Damaged("the FLIR data do not begin with FFF")
    # The version is between 100 and 199 in the right byte order.
    order = ">" if 100 <= struct.unpack(">I", head[20:24])[0] < 200 else "<"
    start, count = struct.unpack(order + "II", head[24:32])
    return order, start, min(count, _MOST_RECORDS)


def entries(table: bytes, order: str) -> Iterator[tuple[int, int, int]]:
    """Yield (kind, offset, length) of the records in a directory's bytes; empty entries are left out."""
    for at in range(0, len(table), ENTRY_BYTES):
        kind = struct.unpack_from(order + "H", table, at)[0]
        offset, length = struct.unpack_from(order + "II", table, at + 12)
        if kind:
            yield kind, offset, length


def _records(container: bytes) -> dict[int, bytes]:
    """{kind: bytes} of the container's records, the first of each kind."""
    order, start, count = directory(container[:HEAD_BYTES])
    records: dict[int, bytes] = {}
    for kind, offset, length in entries(container[start : start + ENTRY_BYTES * count], order):
        records.setdefault(kind, container[offset : offset + length])
    return records


def _order(record: bytes) -> str:
    """The byte order of a record, given by a leading 2."""
    return "<" if record[:2] == b"\x02\x00" else ">"


def _raw_image(record: bytes) -> NDArray[np.uint16]:
    order = _order(record)
    width, height = struct.unpack(order + "HH", record[2:6])
    pixels = record[32:]
    if not 0 < width * height <= _MOST_PIXELS:
        raise Damaged(f"the raw image is {width}×{height} pixels")
    if pixels[:8] == b"\x89PNG\r\n\x1a\n":
        raw = _picture(pixels, (width, height), "PNG")
        # PNG is big-endian; little-endian cameras store their values without swapping the bytes.
        return raw.byteswap() if order == "<" else raw
    if pixels[:4] == b"\xff\xd8\xff\xf7":
        return _jpeg_ls(pixels, (width, height))
    if len(pixels) < 2 * width * height:
        raise Damaged(f"the raw image has {len(pixels)} of {2 * width * height} bytes")
    return np.frombuffer(pixels, order + "u2", width * height).reshape(height, width).astype(np.uint16)


def _jpeg_ls(data: bytes, size: tuple[int, int]) -> NDArray[np.uint16]:
    try:
        import pillow_jpls  # noqa: F401  # Pillow reads JPEG-LS once it is imported.
    except ImportError:
        raise ThermorenderError(
            "FLIR data with pixels in JPEG-LS, as of CSQ files, need pillow-jpls, which is not installed; run pip "
            "install 'thermorender[thermal-files]'"
        ) from None
    return _picture(data, size, "JPEG-LS")


def _picture(data: bytes, size: tuple[int, int], kind: str) -> NDArray[np.uint16]:
    """A grey picture of 16 bits inside, of a kind that Pillow reads."""
    import warnings

    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            with Image.open(io.BytesIO(data), formats=(kind,)) as image:
                if image.size != size or image.mode not in ("I;16", "I;16B", "I"):
                    raise Damaged(f"the {kind} inside is {image.size[0]}×{image.size[1]} {image.mode}")
                refuse_overstated(image, len(data))
                return np.asarray(image).astype(np.uint16)
    except (
        OSError, SyntaxError, ValueError, RuntimeError, Warning, struct.error, Image.DecompressionBombError
    ) as error:  # fmt: skip
        raise Damaged(f"the {kind} inside cannot be read: {error}") from None


def _camera_block(record: bytes) -> dict[str, Any]:
    order = _order(record)

    def number(offset: int, kind: str = "f") -> Any:
        return struct.unpack_from(order + kind, record, offset)[0]

    def text(offset: int, length: int) -> str:
        return record[offset : offset + length].split(b"\0")[0].decode("latin-1").strip()

    planck = PlanckConstants(
        r1=number(0x58), b=number(0x5C), f=number(0x60), o=float(number(0x308, "i")), r2=number(0x30C)
    )
    finite = np.isfinite([planck.r1, planck.b, planck.f, planck.r2]).all()
    if not (finite and planck.r1 > 0.0 and planck.b > 0.0 and planck.r2 > 0.0):
        raise Damaged("its Planck constants are not positive numbers")
    humidity = number(0x3C)
    thermography = ThermographySettings(
        emissivity=number(0x20),
        distance_m=number(0x24),
        reflected_c=number(0x28) - ZERO_CELSIUS_K,
        air_c=number(0x2C) - ZERO_CELSIUS_K,
        window_c=number(0x30) - ZERO_CELSIUS_K,
        window_transmittance=number(0x34),
        # Some cameras store per cent.
        humidity=humidity / 100.0 if humidity > 2.0 else humidity,
    )
    air = AirModel(*(number(offset) for offset in (0x70, 0x74, 0x78, 0x7C, 0x80)))
    if not np.isfinite([air.alpha1, air.alpha2, air.beta1, air.beta2, air.x]).all() or air.x == 0.0:
        air = AirModel()
    middle, span = number(0x338, "H"), number(0x33C, "i")
    camera = {
        "model": text(0xD4, 32),
        "serial": text(0x104, 16),
        "lens": text(0x170, 32),
        "range_c": (number(0x94) - ZERO_CELSIUS_K, number(0x90) - ZERO_CELSIUS_K),
        "scale_raw": (middle - span / 2, middle + span / 2) if middle else None,
    }
    return {"planck": planck, "thermography": thermography, "air": air, "camera": camera}
