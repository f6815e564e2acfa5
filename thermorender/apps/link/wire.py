"""The frame of each message of the link, to the byte: header, types, errors, and the names of products.

`docs/reference/link.md` describes the same layout. All numbers are little-endian, without padding. This module imports
NumPy only, so that a client is light.
"""

import struct
from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import Any

from thermorender.errors import ThermorenderError

MAGIC, VERSION = b"TRLK", 1
# magic, version, type, length of the payload [bytes], session, id
HEADER = struct.Struct("<4sHHIIQ")
TOKEN_BYTES = 64
DEFAULT_PORT = 47800
NAME_BYTES = 64


class Type(IntEnum):
    """Types of messages; a reply is one more than its request."""

    HELLO = 1
    WELCOME = 2
    OPEN = 3
    OPENED = 4
    REQUEST = 5
    REPLY = 6
    CLOSE = 7
    CLOSED = 8
    ERROR = 9


class Code(IntEnum):
    """Kinds of errors."""

    MALFORMED = 1  # the bytes are not the protocol's; the connection ends
    ACCESS = 2  # the token is missing or wrong; the connection ends
    BUSY = 3  # too many connections or sessions
    REFUSED = 4  # a value is not allowed; the session continues
    INTERNAL = 5  # the server failed at this message; the session continues


class Product(IntFlag):
    """Products of a frame, in the order of their bits and of the payload."""

    COUNTS = 1
    TEMPERATURE = 2
    DISPLAY = 4
    RADIANCE = 8
    DEPTH = 16
    SEGMENTATION = 32
    MATERIAL = 64
    VISIBLE = 128
    TARGETS = 256


# {product: (type of a pixel, values of a pixel)}
IMAGES: dict[Product, tuple[str, int]] = {
    Product.COUNTS: ("<u2", 1),
    Product.TEMPERATURE: ("<f4", 1),
    Product.DISPLAY: ("u1", 1),
    Product.RADIANCE: ("<f4", 1),
    Product.DEPTH: ("<f4", 1),
    Product.SEGMENTATION: ("<u4", 1),
    Product.MATERIAL: ("u1", 1),
    Product.VISIBLE: ("u1", 3),
}
ALL_PRODUCTS = sum(Product)
POSITIONS = ("enu", "wgs84")
ATTITUDES = ("camera", "body", "angles")
COLUMNS = ("east_m", "north_m", "above_ground_m", "yaw_deg", "temperature_k")

# Flags of OPEN, REQUEST and REPLY.
BELOW_GROUND = 1
LATEST = 1
FROZEN = 1


class MalformedError(ThermorenderError):
    """Bytes that are not a message of this protocol: the connection cannot continue."""


class LinkError(ThermorenderError):
    """An error that the server reports, or a lost connection."""

    code = Code.INTERNAL
    session = id = 0  # Of the message that it answers; 0 for none


@dataclass(frozen=True)
class Head:
    """The fixed beginning of a message."""

    type: Type
    length: int
    session: int
    id: int


def message(kind: Type, session: int, number: int, parts: Iterable[Any] = ()) -> list[Any]:
    """Return a message as a list of buffers: its header and the parts of its payload."""
    parts = [memoryview(part).cast("B") for part in parts if len(part)]
    length = sum(part.nbytes for part in parts)
    return [HEADER.pack(MAGIC, VERSION, kind, length, session, number), *parts]


def error_message(code: Code, text: str, session: int = 0, number: int = 0) -> list[Any]:
    """Return a message ERROR: a code and one sentence."""
    return message(Type.ERROR, session, number, [struct.pack("<I", code) + text.encode("utf-8")[:4096]])


def error_of(head: Head, payload: bytes | bytearray) -> LinkError:
    """Return the error of a message."""
    (code,) = struct.unpack_from("<I", payload)
    made = LinkError(bytes(payload[4:]).decode("utf-8", "replace"))
    made.code = Code(code) if code in Code._value2member_map_ else Code.INTERNAL
    made.session, made.id = head.session, head.id
    return made


def head_of(data: bytes) -> Head:
    """Return the header of a message; MalformedError for other bytes, another version or an unknown type."""
    magic, version, kind, length, session, number = HEADER.unpack(data)
    if magic != MAGIC:
        raise MalformedError(f"the message begins with {magic!r}, not {MAGIC!r}; this port speaks thermorender's link")
    if version != VERSION:
        raise MalformedError(f"the message has version {version}, this server has {VERSION}; use the matching client")
    if kind not in Type._value2member_map_:
        raise MalformedError(f"message type {kind} is unknown; give 1 HELLO, 3 OPEN, 5 REQUEST or 7 CLOSE")
    return Head(Type(kind), length, session, number)
