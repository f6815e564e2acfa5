"""Text, JSON, arrays, pictures and rasters: reading, atomic writing, checksums."""

from __future__ import annotations

import gzip
import io
import json
import os
import re
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from thermorender.errors import ThermorenderError
from thermorender.files import PathLike, atomic

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

    import numpy as np

# Key of a dict's checksum on file.
_SEAL = "checksum"
# Tags of a picture that lead to those of EXIF and GPS, and that of an XMP packet.
_EXIF, _GPS, _XMP = 34665, 34853, 700
_PNG = b"\x89PNG\r\n\x1a\n"
_JPEG = b"\xff\xd8"
# Deflate writes at most 1032 bytes for one, and a byte has at most 8 pixels. Huffman codes of JPEG reach less.
_PIXELS_PER_BYTE = 8 * 1032
_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+(?:[eE][-+]?\d+)?")


# --- text -------------------------------------------------------------------------------------------------------


def read_text(path: PathLike, kind: str = "UTF-8", other: str | None = None) -> str:
    """Return the text of a UTF-8 file, or of one in a .gz file, without its byte order mark.

    `kind` names the file type in programs, for the message; `other` is the encoding of a file that is not UTF-8, and
    bytes that it lacks are replaced.
    """
    try:
        data = Path(path).read_bytes()
        if Path(path).suffix == ".gz":
            data = gzip.decompress(data)
        try:
            text = data.decode("utf-8-sig")
        except UnicodeDecodeError:
            if other is None:
                raise
            text = data.decode(other, errors="replace")
        text = text.replace("\r\n", "\n").replace("\r", "\n")
        if "\0" in text:
            raise ThermorenderError(f"{path} is not UTF-8 text (it holds zero bytes); save it as {kind}")
        return text
    except UnicodeDecodeError as error:
        raise ThermorenderError(f"{path} is not UTF-8 text ({error.reason}); save it as {kind}") from error
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise ThermorenderError(f"{path} is not a whole gzip file ({error}); compress it again with gzip") from error
    except OSError as error:
        raise ThermorenderError(f"{path} cannot be read ({error.strerror}); give a text file") from error


def xml_root(path: PathLike, kind: str, again: str) -> Element:
    """Return the outermost element of an XML file without entities of its own, which may be of any size.

    `kind` and `again` are for messages: what it should be, and how to mend it.
    """
    from xml.etree import ElementTree

    text = read_text(path, f"{kind} in UTF-8")
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ThermorenderError(
            f"{path} holds a document type definition (<!DOCTYPE …>), which {kind} does not need and which is not "
            "read; delete it"
        )
    try:
        return ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise ThermorenderError(f"{path} is not {kind} ({error}); {again}") from error


def csv_rows(text: str, strict: bool = True) -> list[list[str]]:
    """Return the rows of a CSV text as lists of stripped cells; a row that is not CSV raises csv.Error.

    Commas, semicolons, tabs or bars separate the cells: those that give the first two lines the same number of cells,
    and the most. Decimal commas of numbers become points beside other separators, unless some number has a point. A
    line such as sep=; before it states the separator, as Excel writes it, and is not a row. `strict` refuses loose
    quotation marks.
    """
    import csv

    first, _, rest = text.partition("\n")
    stated = re.fullmatch(r'"?sep=([,;\t|])"?', first.strip(" \r"), re.IGNORECASE)
    if stated:
        mark, text = stated[1], rest
    else:
        mark = _separator(text)
    rows: list[list[str]] = []
    try:
        for row in csv.reader(io.StringIO(text), delimiter=mark, strict=strict):
            rows.append([cell.strip() for cell in row])
    except csv.Error as error:
        raise csv.Error(f"row {len(rows) + 1}: {error}") from None
    if mark == ",":
        return rows
    if any(re.fullmatch(r"[-+]?\d*\.\d+(?:[eE][-+]?\d+)?", cell) for row in rows for cell in row):
        return rows
    return [[cell.replace(",", ".") if _DECIMAL_COMMA.fullmatch(cell) else cell for cell in row] for row in rows]


def _separator(text: str) -> str:
    """The separator of a CSV text by its first two lines of several cells; a comma where none fits."""
    import csv
    import itertools

    lines = (line for line in io.StringIO(text) if any(mark in line for mark in ",;\t|"))
    head = list(itertools.islice(lines, 2))
    best, most = ",", 1
    for mark in ",;\t|":
        cells = list(csv.reader(head, delimiter=mark))
        counts = {len(row) for row in cells}
        # Decimal commas may number as many as the cells, or more where there are no headings.
        last = [cell.strip() for row in cells[-1:] for cell in row if "," in cell]
        all_decimal = mark != "," and best == "," and all(map(_DECIMAL_COMMA.fullmatch, last))
        if len(counts) == 1 and max(counts) >= (2 if all_decimal else max(most, 2)):
            best, most = mark, max(counts)
    if most == 1 and head:
        best = next((mark for mark in ";\t|" if mark in head[0] and "," not in head[0]), ",")
    return best


def write_text(path: PathLike, text: str) -> None:
    """Write a text in UTF-8, compressed where the file's name ends in .gz; line ends stay as they are."""
    data = text.encode()
    with atomic(path) as part:
        # Equal texts give equal files.
        part.write_bytes(gzip.compress(data, mtime=0) if Path(path).suffix == ".gz" else data)


def write_json(path: PathLike, value: Any) -> None:
    """Write a value as indented JSON."""
    write_text(path, json.dumps(value, indent=2) + "\n")


def checksum(source: PathLike | bytes) -> str:
    """Return the SHA-256 checksum of a file's bytes, or of bytes, 64 hexadecimal digits, as `sha256sum` prints it."""
    import hashlib

    state = hashlib.sha256()
    if isinstance(source, bytes):
        state.update(source)
        return state.hexdigest()
    with open(source, "rb") as file:
        for block in iter(lambda: file.read(1 << 20), b""):
            state.update(block)
    return state.hexdigest()


def sealed(value: dict[str, Any]) -> dict[str, Any]:
    """Return a dict of plain values with the checksum of its JSON, for `unsealed`."""
    return value | {_SEAL: digest(json.dumps(value), {})}


def unsealed(value: Any) -> dict[str, Any]:
    """Return the dict that `sealed` was given; raise ValueError if `value` is not a dict or was changed."""
    if not isinstance(value, dict):
        raise ValueError("it is not a dict")
    rest = {name: each for name, each in value.items() if name != _SEAL}
    if value != sealed(rest):
        raise ValueError("its checksum does not match its values")
    return rest


def append_json(path: PathLike, *values: Any) -> None:
    """Append values to a file of JSON lines in one write; they are on the disk when this returns."""
    try:
        with open(path, "a", encoding="utf-8") as file:
            file.write("".join(json.dumps(value) + "\n" for value in values))
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise ThermorenderError(
            f"{path} cannot be written: {error.strerror}; make room and continue with resume"
        ) from None


def finite_json(text: str) -> Any:
    """Return the value of a JSON text; ValueError for numbers that are not finite or take more than 64 bits."""

    def number(kind: type, digits: str) -> float:
        value = kind(digits)
        if not abs(value) < (2**63 if kind is int else float("inf")):
            raise ValueError(f"it holds {digits[:20]}, which is not finite or takes more than 64 bits")
        return value

    whole, real = partial(number, int), partial(number, float)
    try:
        return json.loads(text, parse_int=whole, parse_float=real, parse_constant=real)
    except RecursionError:
        raise ValueError("it is nested too deep") from None


def read_json_lines(path: Path) -> list[Any]:
    """Return the values of a file of JSON lines, [] without one; an incomplete last line is removed from the file."""
    text = read_text(path) if path.exists() else ""
    whole = text[: text.rfind("\n") + 1]
    if whole != text:
        write_text(path, whole)
    return [json.loads(line) for line in whole.splitlines()]


# --- pictures and rasters: encoded in memory, since neither OpenCV nor GDAL reports a full disk -------------------


def label(text: object) -> str:
    """Return a text from outside, such as an object's name, for Matplotlib to draw as it is.

    Matplotlib takes text between dollars as a formula, and leaves a line whose label begins with _ out of legends.
    """
    words = str(text).replace("$", r"\$")
    return f" {words}" if words.startswith("_") else words


def write_image(path: PathLike, image: np.ndarray) -> None:
    """Write (H, W) uint8 or uint16, or (H, W, 3) uint8 RGB, as PNG or TIFF by the path's suffix."""
    with atomic(path) as part:
        part.write_bytes(encoded_image(Path(path).suffix, image))


def encoded_image(suffix: str, image: np.ndarray, quality: int | None = None) -> bytes:
    """Return the bytes of a file that `write_image` writes; `quality` of a JPEG, with colours as fine as light."""
    import cv2
    import numpy as np

    ordered = image[..., ::-1] if image.ndim == 3 else image
    # Deflate, which every reader of TIFF decodes; OpenCV's own choice is LZW.
    how = [cv2.IMWRITE_TIFF_COMPRESSION, cv2.IMWRITE_TIFF_COMPRESSION_ADOBE_DEFLATE] if "tif" in suffix.lower() else []
    if quality is not None:
        how = [
            cv2.IMWRITE_JPEG_QUALITY,
            quality,
            cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
            cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
        ]
    encoded, data = cv2.imencode(suffix, np.ascontiguousarray(ordered), how)
    if not encoded:
        raise OSError(f"OpenCV cannot encode a {image.dtype} image")
    return data.tobytes()


def decoded(data: bytes, flags: int) -> np.ndarray | None:
    """Return a picture decoded by OpenCV with its `flags`, or None if that fails; nothing is printed."""
    import cv2
    import numpy as np

    if (data.startswith(_PNG) and not _whole_png(data)) or (data.startswith((_PNG, _JPEG)) and not _full(data)):
        return None
    before = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        return cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        # No bytes, or more pixels than OpenCV allows.
        return None
    finally:
        cv2.utils.logging.setLogLevel(before)


def can_hold(size: int, pixels: int) -> bool:
    """Return whether a PNG or JPEG of `size` bytes can hold so many pixels; a library reserves memory for all."""
    return pixels <= _PIXELS_PER_BYTE * size


def refuse_overstated(image: Any, size: int) -> None:
    """Raise ValueError where a Pillow image, a PNG or JPEG of `size` bytes, states more pixels than these can hold."""
    if image.format in ("PNG", "JPEG") and not can_hold(size, image.width * image.height):
        raise ValueError(f"it has too few bytes for its {image.width}×{image.height} pixels")


def _full(data: bytes) -> bool:
    """Whether a PNG or JPEG can hold the pixels that it states."""
    from PIL import Image

    try:
        with largest_image(None), Image.open(io.BytesIO(data), formats=("PNG", "JPEG")) as image:
            return can_hold(len(data), image.width * image.height)
    except Exception:  # what damaged headers lead to; the decoder refuses them
        return True


def _whole_png(data: bytes) -> bool:
    """Whether all chunks of a PNG are there: OpenCV reserves what a chunk states, up to 4 GB."""
    at = len(_PNG)
    while at + 8 <= len(data):
        at += 12 + int.from_bytes(data[at : at + 4], "big")
    return at <= len(data)


@contextmanager
def largest_image(pixels: int | None) -> Iterator[None]:
    """Let Pillow refuse larger images by their headers, without warnings for smaller ones; None: it refuses none."""
    import warnings

    from PIL import Image

    before = Image.MAX_IMAGE_PIXELS
    # Pillow warns above this number and refuses above twice as many.
    Image.MAX_IMAGE_PIXELS = None if pixels is None else pixels // 2
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            yield
    finally:
        Image.MAX_IMAGE_PIXELS = before


def picture_tags(path: PathLike) -> tuple[dict[int, Any], dict[int, Any], dict[int, Any], str]:
    """Return (tags, those of EXIF, those of GPS, XMP packet) of a picture of any size; ValueError if unreadable."""
    import warnings

    from PIL import Image

    try:
        # No pixels are read, so their number does not matter.
        with largest_image(None), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(path) as image:
                exif = image.getexif()
                inner, gps = (dict(exif.get_ifd(tag)) for tag in (_EXIF, _GPS))
                tags, packet = dict(exif), image.info.get("xmp") or exif.get(_XMP, b"")
            text = packet if isinstance(packet, str) else bytes(packet or b"").decode("utf-8", "replace")
    except Exception as error:  # Pillow raises whatever damaged tags lead to
        raise ValueError(str(error)) from None
    return tags, inner, gps, text


@contextmanager
def atomic_raster(path: PathLike) -> Iterator[str]:
    """As `atomic`, for GDAL: yield the name of a file in memory; write it to `path` if the block ends without error."""
    from rasterio.io import MemoryFile

    with MemoryFile(ext=Path(path).suffix) as memory:
        yield memory.name
        with atomic(path) as part:
            part.write_bytes(memory.getbuffer())


# --- arrays -------------------------------------------------------------------------------------------------------


def write_arrays(path: PathLike, what: object, arrays: Mapping[str, np.ndarray]) -> None:
    """Write {name: array} for `read_arrays`; `what` identifies what they belong to."""
    with atomic(path) as part:
        part.write_bytes(encoded_arrays(what, arrays))


def encoded_arrays(what: object, arrays: Mapping[str, np.ndarray]) -> bytes:
    """Return the bytes of a file that `write_arrays` writes."""
    import numpy as np

    memory = io.BytesIO()
    named: dict[str, Any] = {**arrays, "checksum": digest(what, arrays)}
    np.savez(memory, **named)
    return memory.getvalue()


def read_arrays(path: PathLike, what: object) -> dict[str, np.ndarray] | None:
    """Return the {name: array} that `write_arrays` wrote for `what`, or None if they are missing, damaged or others."""
    import numpy as np

    # A damaged file can raise almost any exception in zipfile and NumPy. NumPy does not close a file that it cannot
    # read, so it is opened here.
    with suppress(Exception), open(path, "rb") as file, np.load(file, allow_pickle=False) as stored:
        arrays = dict(stored)
        if str(arrays.pop("checksum")) == digest(what, arrays):
            return arrays
    return None


def digest(what: object, arrays: Mapping[str, np.ndarray]) -> str:
    """Return the checksum of `what` and of named arrays with their types and shapes."""
    import hashlib

    import numpy as np

    state = hashlib.blake2b(repr(what).encode(), digest_size=16)
    for name, values in arrays.items():
        values = np.ascontiguousarray(values)
        state.update(f"{name} {values.dtype.str} {np.shape(arrays[name])}".encode())
        state.update(values.reshape(-1).view(np.uint8).data)
    return state.hexdigest()
