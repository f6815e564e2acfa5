"""Read FLIR's radiometric JPEGs: the raw signal, the factory's constants and the settings stored with it.

The container ("FFF"), split over APP1 segments, has a directory of records: the raw image is record 1 (16-bit values,
plain or PNG with swapped bytes), the camera's block 0x20. Field offsets are from ExifTool's FLIR tables
(https://exiftool.org/TagNames/FLIR.html).
"""

import io
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError
from thermorender.formats import refuse_overstated
from thermorender.sensor.radiometry import AirModel, PlanckConstants, ThermographySettings, thermography_temperature
from thermorender.units import ZERO_CELSIUS_K

_RAW, _CAMERA = 0x01, 0x20
_MOST_PIXELS = 1 << 26
_MOST_RECORDS = 512


@dataclass(frozen=True)
class RadiometricJpeg:
    """One radiometric JPEG."""

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


def read_flir_jpeg(path: str | PathLike[str]) -> RadiometricJpeg:
    """Return the RadiometricJpeg of a file."""
    path = Path(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ThermorenderError(f"{path} cannot be read: {error.strerror}; give a radiometric JPEG") from None
    if dji_thermal(data):
        raise ThermorenderError(f"{path} is a radiometric JPEG of DJI, not of FLIR; give it to read_dji_jpeg")
    try:
        records = _records(_container(data))
        missing = [name for kind, name in ((_RAW, "raw image"), (_CAMERA, "camera block")) if kind not in records]
        if missing:
            raise _Damaged(f"it holds no {' and no '.join(missing)}")
        return RadiometricJpeg(_raw_image(records[_RAW]), **_camera_block(records[_CAMERA]))
    except (_Damaged, ThermorenderError) as error:
        reason = str(error)
    except struct.error:
        reason = "a record ends too early"
    raise ThermorenderError(f"{path} is not a whole FLIR radiometric JPEG: {reason}; give the camera's original file")


def dji_thermal(data: bytes) -> bool:
    """Return whether a JPEG's bytes are DJI's radiometric JPEG (APP3), whose calibration is not public.

    Source: GDAL's JPEG driver (pull request 12972: H20T, M30T, M3T). DJI's cameras with a FLIR core store FLIR's data.
    """
    segments = list(_segments(data))
    signal = sum(len(segment) for marker, segment in segments if marker == 0xE3)
    return signal > 8192 and any(marker == 0xE1 and b"DJI" in segment for marker, segment in segments)


def _segments(data: bytes) -> Iterator[tuple[int, bytes]]:
    """(marker, content) of a JPEG's segments before its picture."""
    offset = 2
    while offset + 4 <= len(data) and data[offset] == 0xFF:
        marker, length = data[offset + 1], int.from_bytes(data[offset + 2 : offset + 4], "big")
        yield marker, data[offset + 4 : offset + 2 + length]
        if marker in (0xD9, 0xDA) or length < 2:
            break
        offset += 2 + length


class _Damaged(Exception):
    """A defect of the file's contents, as half a sentence."""


def _container(data: bytes) -> bytes:
    """The FFF container, joined from the JPEG's APP1 segments by their number."""
    if data[:2] != b"\xff\xd8":
        raise _Damaged("it is not a JPEG")
    parts: dict[int, bytes] = {}
    for marker, segment in _segments(data):
        if marker == 0xE1 and segment[:5] == b"FLIR\0" and len(segment) > 8:
            parts[segment[6]] = segment[8:]
            last = segment[7]
    if not parts:
        raise _Damaged("it carries no FLIR data")
    if sorted(parts) != list(range(last + 1)):
        raise _Damaged(f"it announces {last + 1} pieces of FLIR data and holds {len(parts)}")
    return b"".join(parts[number] for number in sorted(parts))


def _records(container: bytes) -> dict[int, bytes]:
    """{kind: bytes} of the container's records, the first of each kind."""
    if container[:4] not in (b"FFF\0", b"AFF\0") or len(container) < 64:
        raise _Damaged("the FLIR data do not begin with FFF")
    # The version is between 100 and 199 in the right byte order.
    order = ">" if 100 <= struct.unpack(">I", container[20:24])[0] < 200 else "<"
    start, count = struct.unpack(order + "II", container[24:32])
    records: dict[int, bytes] = {}
    for k in range(min(count, _MOST_RECORDS)):
        entry = container[start + 32 * k : start + 32 * k + 32]
        kind = struct.unpack(order + "H", entry[:2])[0]
        offset, length = struct.unpack(order + "II", entry[12:20])
        if kind and kind not in records:
            records[kind] = container[offset : offset + length]
    return records


def _order(record: bytes) -> str:
    """The byte order of a record, given by a leading 2."""
    return "<" if record[:2] == b"\x02\x00" else ">"


def _raw_image(record: bytes) -> NDArray[np.uint16]:
    order = _order(record)
    width, height = struct.unpack(order + "HH", record[2:6])
    pixels = record[32:]
    if not 0 < width * height <= _MOST_PIXELS:
        raise _Damaged(f"the raw image is {width}×{height} pixels")
    if pixels[:8] == b"\x89PNG\r\n\x1a\n":
        raw = _png(pixels, (width, height))
        # PNG is big-endian; little-endian cameras store their values without swapping the bytes.
        return raw.byteswap() if order == "<" else raw
    if len(pixels) < 2 * width * height:
        raise _Damaged(f"the raw image has {len(pixels)} of {2 * width * height} bytes")
    return np.frombuffer(pixels, order + "u2", width * height).reshape(height, width).astype(np.uint16)


def _png(data: bytes, size: tuple[int, int]) -> NDArray[np.uint16]:
    import warnings

    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            with Image.open(io.BytesIO(data), formats=("PNG",)) as image:
                if image.size != size or image.mode not in ("I;16", "I;16B", "I"):
                    raise _Damaged(f"the PNG inside is {image.size[0]}×{image.size[1]} {image.mode}")
                refuse_overstated(image, len(data))
                return np.asarray(image).astype(np.uint16)
    except (OSError, SyntaxError, ValueError, Warning, struct.error) as error:
        raise _Damaged(f"the PNG inside cannot be read: {error}") from None


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
        raise _Damaged("its Planck constants are not positive numbers")
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
