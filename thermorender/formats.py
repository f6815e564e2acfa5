"""Text, JSON, arrays, pictures and rasters: read, and written whole or not at all; checksums of what they hold."""

import json
import os
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path

from thermorender.errors import ThermorenderError
from thermorender.files import atomic

# Where a dict on file keeps the checksum of its other values.
_SEAL = "checksum"


# --- text -------------------------------------------------------------------------------------------------------


def read_text(path, kind="UTF-8"):
    """Return the text of a UTF-8 file, without the byte order mark that spreadsheets put first.

    Parameters
    ----------
    path : path
    kind : str
        What programs call such a file, for the message.
    """
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
        if "\0" in text:
            raise ThermorenderError(f"{path} is not UTF-8 text (it holds zero bytes); save it as {kind}")
        return text
    except UnicodeDecodeError as error:
        raise ThermorenderError(f"{path} is not UTF-8 text ({error.reason}); save it as {kind}") from error
    except OSError as error:
        raise ThermorenderError(f"{path} cannot be read ({error.strerror}); give a text file") from error


def write_text(path, text):
    """Write a text in UTF-8, with the line ends that it has."""
    with atomic(path) as part:
        part.write_bytes(text.encode())


def write_json(path, value):
    """Write a value as indented JSON."""
    write_text(path, json.dumps(value, indent=2) + "\n")


def checksum(path):
    """Return the BLAKE2b checksum of a file's bytes, 32 hexadecimal digits."""
    import hashlib

    state = hashlib.blake2b(digest_size=16)
    with open(path, "rb") as file:
        for block in iter(lambda: file.read(1 << 20), b""):
            state.update(block)
    return state.hexdigest()


def sealed(value):
    """Return a dict of plain values with the checksum of them all as JSON, for `unsealed`."""
    return value | {_SEAL: digest(json.dumps(value), {})}


def unsealed(value):
    """Return the dict that `sealed` was given.

    Raises
    ------
    ValueError
        It is none, or not as it was.
    """
    if not isinstance(value, dict):
        raise ValueError("no dict")
    rest = {name: each for name, each in value.items() if name != _SEAL}
    if value != sealed(rest):
        raise ValueError("its checksum is not that of its values")
    return rest


def append_json(path, *values):
    """Append values to a file of JSON lines, at once; they are on the disk when this returns."""
    try:
        with open(path, "a", encoding="utf-8") as file:
            file.write("".join(json.dumps(value) + "\n" for value in values))
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise ThermorenderError(
            f"{path} cannot be written: {error.strerror}; make room and continue with --resume"
        ) from None


def finite_json(text):
    """Return the value of a JSON text.

    Raises
    ------
    ValueError
        It is no JSON, or a number in it is not finite or takes more than 64 bits.
    """

    def number(kind, digits):
        value = kind(digits)
        if not abs(value) < (2**63 if kind is int else float("inf")):
            raise ValueError(f"it holds {digits[:20]}, which is not finite or takes more than 64 bits")
        return value

    kinds = {"parse_int": int, "parse_float": float, "parse_constant": float}
    return json.loads(text, **{name: partial(number, kind) for name, kind in kinds.items()})


def read_json_lines(path):
    """Return the values of a file of JSON lines, none where there is no file; a last line cut short is cut away.

    Raises
    ------
    ValueError
        A whole line that is no JSON.
    """
    text = read_text(path) if path.exists() else ""
    whole = text[: text.rfind("\n") + 1]
    if whole != text:
        write_text(path, whole)
    return [json.loads(line) for line in whole.splitlines()]


# --- pictures and rasters: made in memory, since neither OpenCV nor GDAL tells that a disk is full ------------------


def write_image(path, image):
    """Write (H, W) uint8 or uint16, or (H, W, 3) uint8 RGB, as PNG or TIFF by the path's suffix."""
    import cv2
    import numpy as np

    ordered = image[..., ::-1] if image.ndim == 3 else image
    with atomic(path) as part:
        encoded, data = cv2.imencode(Path(path).suffix, np.ascontiguousarray(ordered))
        if not encoded:
            raise OSError(f"no encoder took a {image.dtype} image")
        part.write_bytes(data)


def decoded(data, flags):
    """Return the picture in bytes as OpenCV has it with its `flags`, or None where there is none; no word is said."""
    import cv2
    import numpy as np

    before = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        return cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        # Of nothing at all, and of more pixels than it allows.
        return None
    finally:
        cv2.utils.logging.setLogLevel(before)


@contextmanager
def atomic_raster(path):
    """As `atomic`, for GDAL: give the name of a file in memory, which is written when the block ends without error."""
    from rasterio.io import MemoryFile

    with MemoryFile(ext=Path(path).suffix) as memory:
        yield memory.name
        with atomic(path) as part:
            part.write_bytes(memory.getbuffer())


# --- arrays of our own --------------------------------------------------------------------------------------------


def write_arrays(path, what, arrays):
    """Write {name: array} to be read by `read_arrays` alone; `what` tells of what they are the arrays."""
    import numpy as np

    with atomic(path) as part:
        np.savez(part, **arrays, checksum=digest(what, arrays))


def read_arrays(path, what):
    """Return the {name: array} that `write_arrays` wrote, or None where they are absent, damaged or of something else.

    A ZIP's own checksums do not tell of members that its table lacks.
    """
    import numpy as np

    # Damage shows as nearly any exception of zipfile's and NumPy's parsers. Opened here, because NumPy leaves a file
    # open that it cannot read.
    with suppress(Exception), open(path, "rb") as file, np.load(file, allow_pickle=False) as stored:
        arrays = dict(stored)
        if str(arrays.pop("checksum")) == digest(what, arrays):
            return arrays
    return None


def digest(what, arrays):
    """Return the checksum of named arrays; of their types and shapes too, as equal bytes may mean other numbers."""
    import hashlib

    import numpy as np

    state = hashlib.blake2b(repr(what).encode(), digest_size=16)
    for name, values in arrays.items():
        values = np.ascontiguousarray(values)
        state.update(f"{name} {values.dtype.str} {np.shape(arrays[name])}".encode())
        state.update(values.reshape(-1).view(np.uint8))
    return state.hexdigest()
