"""Read FLIR's recorded sequences: SEQ, whose frames hold plain values, and CSQ, whose frames hold JPEG-LS.

A sequence is one FFF container after another. Where each ends follows from its records: the bytes that begin a
container also occur inside pixels.
"""

import struct
from os import PathLike
from pathlib import Path

from thermorender.errors import ThermorenderError
from thermorender.sensor.flir_jpeg import (
    ENTRY_BYTES,
    HEAD_BYTES,
    Damaged,
    FlirImage,
    directory,
    entries,
    flir_image,
)

# Bytes by which the last frame's records may exceed the file: CSQ states 4 too many.
_OVERSTATED = 4
# A frame of more bytes is damaged: twice the largest raw image.
_MOST_BYTES = 1 << 28


def frame_extents(path: str | PathLike[str]) -> list[tuple[int, int]]:
    """Return (offset, bytes) of each frame of a sequence; no pixels are read.

    Raises
    ------
    ThermorenderError
        The file is no sequence, or a frame is not whole.
    """
    path, found = Path(path), list[tuple[int, int]]()
    try:
        size, at = path.stat().st_size, 0
        with path.open("rb") as file:
            while at < size or not found:
                file.seek(at)
                order, start, count = directory(file.read(HEAD_BYTES))
                file.seek(at + start)
                table = file.read(ENTRY_BYTES * count)
                ends = [offset + length for _, offset, length in entries(table, order)]
                length = max([HEAD_BYTES, start + ENTRY_BYTES * count, *ends])
                if length > _MOST_BYTES or at + length > size + _OVERSTATED:
                    raise Damaged(f"it states {length} bytes, and {size - at} are left")
                found.append((at, min(length, size - at)))
                at += length
    except Damaged as error:
        reason = str(error)
    except struct.error:
        reason = "its directory ends too early"
    except OSError as error:
        raise ThermorenderError(f"{path} cannot be read: {error.strerror}; give a sequence of FLIR") from None
    else:
        return found
    raise _not_whole(path, len(found), reason)


def read_flir_frame(path: str | PathLike[str], number: int, extent: tuple[int, int]) -> FlirImage:
    """Return frame `number` of a sequence, from 0, which has an extent of `frame_extents`."""
    offset, length = extent
    try:
        with open(path, "rb") as file:
            file.seek(offset)
            return flir_image(file.read(length))
    except Damaged as error:
        raise _not_whole(path, number, str(error)) from None
    except OSError as error:
        raise ThermorenderError(f"{path} cannot be read: {error.strerror}; give a sequence of FLIR") from None


def _not_whole(path: str | PathLike[str], number: int, reason: str) -> ThermorenderError:
    return ThermorenderError(
        f"{path} is not a whole sequence of FLIR: frame {number + 1}: {reason}; give the camera's original file, or "
        "export it again as SEQ"
    )
