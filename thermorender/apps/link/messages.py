"""The payloads of the link, to the byte: how they are packed, and how bytes from a stranger are checked.

`docs/reference/link.md` describes the same layout. All numbers are little-endian, without padding.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.link.wire import (
    ALL_PRODUCTS,
    ATTITUDES,
    BELOW_GROUND,
    COLUMNS,
    FROZEN,
    IMAGES,
    LATEST,
    NAME_BYTES,
    POSITIONS,
    TOKEN_BYTES,
    Head,
    MalformedError,
    Product,
    Type,
)
from thermorender.errors import ThermorenderError

# camera, map, method, position, attitude, flags, audit, seed, rate, mount, lever arm
_OPEN = struct.Struct("<64s64scBBBIQd3d3d")
# width, height, rate, half a read-out, look-ahead, time constant, band, bits, reserved, range of the map
_OPENED = struct.Struct("<IIddddddIIdd")
# time, products, flags, poses, objects, picture's width and height, its ground sampling distance
_REQUEST = struct.Struct("<dIIIIIId")
# time, seed, index, budget, budget of the image, age, seconds of the render, products, width, height, superseded,
# flags, targets
_REPLY = struct.Struct("<dQQffffIIIIII")
POSE_BYTES = 64
# name, columns that are given, reserved, time and the columns
_OBJECT = struct.Struct("<64sII6d")
# name, column, row, range, in view, visible, reserved
TARGET = np.dtype(
    [("name", "S64"), ("column", "<f8"), ("row", "<f8"), ("range_m", "<f8"), ("in_view", "u1"), ("visible", "u1"),
     ("reserved", "V6")]
)  # fmt: skip

MOST_POSES, MOST_OBJECTS, MOST_SIDE, MOST_PICTURE_BYTES = 4096, 1024, 8192, 64 << 20
# Largest payload of each type that a client may send.
LIMITS = {
    Type.HELLO: TOKEN_BYTES,
    Type.OPEN: _OPEN.size,
    Type.REQUEST: _REQUEST.size + MOST_POSES * POSE_BYTES + MOST_OBJECTS * _OBJECT.size + MOST_PICTURE_BYTES,
    Type.CLOSE: 0,
}


@dataclass(frozen=True)
class Open:
    """The settings of a session: one camera of one vehicle."""

    camera: str = ""
    map: str = ""
    method: str = "A"
    position: str = "enu"
    attitude: str = "camera"
    below_ground: bool = False
    audit: int = 0
    seed: int = 0
    rate_hz: float = 0.0
    mount_deg: Sequence[float] = (0.0, 0.0, 0.0)
    lever_arm_m: Sequence[float] = (0.0, 0.0, 0.0)

    def packed(self) -> bytes:
        """Return the payload."""
        flags = BELOW_GROUND if self.below_ground else 0
        return _OPEN.pack(
            name_bytes(self.camera), name_bytes(self.map), self.method.encode("ascii"),
            _number(POSITIONS, self.position), _number(ATTITUDES, self.attitude), flags, self.audit, self.seed,
            self.rate_hz, *self.mount_deg, *self.lever_arm_m,
        )  # fmt: skip

    @classmethod
    def unpacked(cls, payload: bytes) -> "Open":
        """Return the settings of a payload, checked as far as the protocol says."""
        _exact(payload, _OPEN.size, "OPEN")
        camera, model, method, position, attitude, flags, audit, seed, rate, *six = _OPEN.unpack(payload)
        if method not in (b"A", b"B", b"C"):
            raise ThermorenderError(f"method {method!r} is unknown; give A, B or C")
        if position >= len(POSITIONS) or attitude >= len(ATTITUDES):
            raise ThermorenderError(
                f"position {position} and attitude {attitude} are not allowed; give a position of 0 (ENU) or 1 "
                "(WGS 84), and an attitude of 0 (camera), 1 (body) or 2 (angles)"
            )
        _flags(flags, BELOW_GROUND, "OPEN")
        if not np.isfinite([rate, *six]).all() or rate < 0.0:
            raise ThermorenderError(
                f"rate_hz={rate}, mount and lever arm {six} must be finite, and the rate not negative"
            )
        return cls(
            text_of(camera, "camera"), text_of(model, "map"), method.decode(), POSITIONS[position],
            ATTITUDES[attitude], bool(flags & BELOW_GROUND), audit, seed, rate, tuple(six[:3]), tuple(six[3:]),
        )  # fmt: skip


@dataclass(frozen=True)
class Opened:
    """A session as the server has opened it."""

    # width, height: Of the image [px]
    width: int
    height: int
    rate_hz: float
    # From the frame's time, the middle of the read-out, to the last row: what late rows see of the path [s]
    half_readout_s: float
    # Time beyond the frame's on which a frame depends at most: half a read-out; with dynamic objects also the time
    # over which the sensor moves images, to find the part of the image that they change [s]
    ahead_s: float
    time_constant_s: float  # Of the pixels
    band_um: tuple[float, float]  # (2,) tuple
    bits: int  # Of the counts
    # (2,) tuple temperatures of intensity 0 and 1 of the learned map [K]; NaN for method A
    range_k: tuple[float, float]

    def packed(self) -> bytes:
        """Return the payload."""
        return _OPENED.pack(
            self.width, self.height, self.rate_hz, self.half_readout_s, self.ahead_s, self.time_constant_s,
            *self.band_um, self.bits, 0, *self.range_k,
        )  # fmt: skip

    @classmethod
    def unpacked(cls, payload: bytes) -> "Opened":
        """Return the values of a payload."""
        width, height, rate, half, ahead, constant, low, high, bits, _, cold, warm = _OPENED.unpack(payload)
        return cls(width, height, rate, half, ahead, constant, (low, high), bits, (cold, warm))


@dataclass(frozen=True, eq=False)
class Request:
    """One frame that a client asks for."""

    time_s: float  # Of the frame [s]
    products: int = int(Product.COUNTS)  # Bits of Product
    latest: bool = False  # A later request of the session may replace this one if it waits
    # (n, 8) float64 time [s], position, attitude: the next samples of the path
    poses: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 8)))
    objects: Sequence[tuple[str, float, dict[str, float]]] = ()
    picture: NDArray[np.uint8] | None = None  # (h, w, 3) uint8 the client's own photograph, for method B
    texel_m: float = 0.0  # Ground sampling distance of the picture [m]; 0: the map's own

    @property
    def samples(self) -> int:
        """Number of poses and values of objects, and one for itself."""
        return 1 + len(self.poses) + len(self.objects)

    def packed(self) -> list[Any]:
        """Return the payload as a list of buffers."""
        height, width = (0, 0) if self.picture is None else _size(self.picture)
        _refuse_counts(len(self.poses), len(self.objects), width, height)
        head = _REQUEST.pack(
            self.time_s, self.products, LATEST if self.latest else 0, len(self.poses), len(self.objects), width, height,
            self.texel_m,
        )  # fmt: skip
        parts: list[Any] = [head, np.ascontiguousarray(self.poses, "<f8").tobytes()]
        for name, time_s, values in self.objects:
            odd = set(values) - set(COLUMNS)
            if odd:
                raise ThermorenderError(f"object {name!r} has no {odd.pop()!r} to set; give {', '.join(COLUMNS)}")
            mask = sum(1 << COLUMNS.index(key) for key in values)
            parts.append(_OBJECT.pack(name_bytes(name), mask, 0, time_s, *(values.get(key, 0.0) for key in COLUMNS)))
        if self.picture is not None:
            parts.append(np.ascontiguousarray(self.picture, np.uint8).tobytes())
        return parts

    @classmethod
    def unpacked(cls, payload: bytes) -> "Request":
        """Return the request of a payload, checked as far as the protocol says."""
        if len(payload) < _REQUEST.size:
            raise ThermorenderError(f"REQUEST has {len(payload)} bytes; at least {_REQUEST.size} are needed")
        time_s, products, flags, poses, objects, width, height, texel = _REQUEST.unpack_from(payload)
        _refuse_counts(poses, objects, width, height)
        start = _REQUEST.size
        middle = start + poses * POSE_BYTES
        end = middle + objects * _OBJECT.size
        _exact(payload, end + 3 * width * height, "REQUEST")
        _flags(flags, LATEST, "REQUEST")
        if not products or products & ~ALL_PRODUCTS:
            raise ThermorenderError(
                f"products={products:#x} is not allowed; give bits of {ALL_PRODUCTS:#x}, at least one"
            )
        if not np.isfinite(time_s):
            raise ThermorenderError(f"time_s={time_s} is not a time; give a finite number of seconds")
        if not (np.isfinite(texel) and texel >= 0.0):
            raise ThermorenderError(f"texel_m={texel} is not allowed; give metres, or 0 for the map's own")
        samples = np.frombuffer(payload, "<f8", 8 * poses, start).reshape(poses, 8)
        if not np.isfinite(samples).all():
            row = int(np.argwhere(~np.isfinite(samples))[0][0])
            raise ThermorenderError(f"pose {row} is {samples[row].tolist()}; all its values must be finite numbers")
        things = [_object(payload, middle + number * _OBJECT.size) for number in range(objects)]
        picture = None
        if width:
            picture = np.frombuffer(payload, np.uint8, 3 * width * height, end).reshape(height, width, 3)
        return cls(time_s, products, bool(flags & LATEST), samples.astype(np.float64), things, picture, texel)


def _refuse_counts(poses: int, objects: int, width: int, height: int) -> None:
    """Raise if a request has more than the protocol allows."""
    if poses > MOST_POSES or objects > MOST_OBJECTS:
        raise ThermorenderError(
            f"REQUEST has {poses} poses and {objects} objects; up to {MOST_POSES} and {MOST_OBJECTS} are allowed"
        )
    if max(width, height) > MOST_SIDE or 3 * width * height > MOST_PICTURE_BYTES or (width == 0) != (height == 0):
        raise ThermorenderError(
            f"the picture of {width} × {height} pixels is not allowed; give none, or up to {MOST_SIDE} pixels a "
            f"side and {MOST_PICTURE_BYTES >> 20} MiB"
        )


def _size(picture: NDArray[np.uint8]) -> tuple[int, int]:
    """Height and width of a picture; raise if it is something else than sRGB of 8 bits."""
    picture = np.asarray(picture)
    if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] != 3:
        raise ThermorenderError(
            f"picture of type {picture.dtype} and shape {picture.shape} is not sRGB of 8 bits; give uint8 of shape "
            "(height, width, 3)"
        )
    return picture.shape[0], picture.shape[1]


def _object(payload: bytes, start: int) -> tuple[str, float, dict[str, float]]:
    name, mask, _, time_s, *values = _OBJECT.unpack_from(payload, start)
    name = text_of(name, "object")
    if mask >> len(COLUMNS):
        raise ThermorenderError(f"object {name!r}: columns {mask:#x} are not allowed; give bits of {31:#x}")
    return (
        name,
        time_s,
        {key: value for bit, (key, value) in enumerate(zip(COLUMNS, values, strict=True)) if mask >> bit & 1},
    )


@dataclass(frozen=True, eq=False)
class Reply:
    """One frame."""

    # session, id: Those of the request
    session: int
    id: int
    time_s: float  # Of the frame [s]
    # seed, index: They determine the noise
    seed: int
    index: int
    # budget_mk, image_budget_mk: Error without the sensor's noise over the surfaces, and over the whole image, root
    # mean square [mK at 300 K]; NaN for method B, whose error is the map's
    budget_mk: float
    image_budget_mk: float
    age_s: float  # From the arrival of the request to the reply's departure
    render_s: float  # Of this, the time of the frame and its products
    superseded: int  # Earlier requests that this one replaced
    frozen: bool  # The counts repeat those before a flat-field correction
    products: dict[Product, NDArray[Any]]  # {Product: image (height, width) or (height, width, 3)}
    # {name: {"pixel", "in_view", "visible", "range_m"}}, as `Frame.targets`
    targets: dict[str, dict[str, Any]] | None

    def __repr__(self) -> str:
        names = ", ".join(str(product.name).lower() for product in self.products)
        return (
            f"Reply(frame {self.index} at {self.time_s:g} s, {names or 'no image'}, budget {self.budget_mk:.1f} mK, "
            f"{1e3 * self.age_s:.1f} ms old)"
        )

    def __getattr__(self, name: str) -> NDArray[Any]:
        product = Product.__members__.get(name.upper())
        if product is None or name != name.lower():
            raise AttributeError(f"a Reply has no {name!r}")
        if product not in self.products:
            raise AttributeError(f"product {name!r} was not asked for; add it to products")
        return self.products[product]

    @classmethod
    def unpacked(cls, head: Head, payload: bytes | bytearray) -> "Reply":
        """Return the reply of a payload; its images share the payload's memory."""
        (time_s, seed, index, budget, image_budget, age, render, wanted, width, height, superseded, flags, targets) = (
            _REPLY.unpack_from(payload)
        )
        start, products = _REPLY.size, {}
        for product, (kind, depth) in IMAGES.items():
            if wanted & product:
                count = width * height * depth
                image = np.frombuffer(payload, kind, count, start)
                products[product] = image.reshape((height, width) if depth == 1 else (height, width, depth))
                start += image.nbytes
        found = None
        if wanted & Product.TARGETS:
            found = targets_of(np.frombuffer(payload, TARGET, targets, start))
            start += targets * TARGET.itemsize
        _exact(payload, start, "REPLY")
        return cls(head.session, head.id, time_s, seed, index, budget, image_budget, age, render, superseded,
                   bool(flags & FROZEN), products, found)  # fmt: skip


def reply_head(
    time_s: float, seed: int, index: int, budget: tuple[float, float], age_s: float, render_s: float, products: int,
    shape: tuple[int, int], superseded: int, frozen: bool, targets: int,
) -> bytes:  # fmt: skip
    """Return the fixed beginning of a reply's payload; the products follow."""
    height, width = shape
    return _REPLY.pack(
        time_s,
        seed,
        index,
        *budget,
        age_s,
        render_s,
        products,
        width,
        height,
        superseded,
        FROZEN if frozen else 0,
        targets,
    )


def reply_bytes(products: int, width: int, height: int, targets: int = 0) -> int:
    """Return the length of a reply's payload."""
    pixel = sum(np.dtype(kind).itemsize * depth for each, (kind, depth) in IMAGES.items() if products & each)
    return _REPLY.size + pixel * width * height + targets * TARGET.itemsize


def target_rows(targets: dict[str, dict[str, Any]]) -> NDArray[Any]:
    """Return `Frame.targets` as records; a position behind the camera is NaN."""
    rows = np.zeros(len(targets), TARGET)
    for row, (name, each) in zip(rows, targets.items(), strict=True):
        row["name"], row["range_m"] = name_bytes(name), each["range_m"]
        row["column"], row["row"] = each["pixel"] or (np.nan, np.nan)
        row["in_view"], row["visible"] = each["in_view"], each["visible"]
    return rows


def targets_of(rows: NDArray[Any]) -> dict[str, dict[str, Any]]:
    """Return records as `Frame.targets`."""
    return {
        bytes(row["name"]).decode("utf-8"): {
            "pixel": None if np.isnan(row["column"]) else [float(row["column"]), float(row["row"])],
            "in_view": bool(row["in_view"]),
            "visible": bool(row["visible"]),
            "range_m": float(row["range_m"]),
        }
        for row in rows
    }


def refuse_length(head: Head) -> None:
    """Raise for a message of a client that is longer than its type may be, or of a type that only servers send."""
    if head.type not in LIMITS:
        raise MalformedError(f"message type {head.type.name} is the server's; give HELLO, OPEN, REQUEST or CLOSE")
    if head.length > LIMITS[head.type]:
        raise MalformedError(f"{head.type.name} has {head.length} bytes; up to {LIMITS[head.type]} are allowed")


def text_of(data: bytes, what: str) -> str:
    """Return the text of a name's bytes."""
    try:
        return data.rstrip(b"\0").decode("utf-8")
    except UnicodeDecodeError:
        raise ThermorenderError(f"{what} {data!r} is not UTF-8; give a name in UTF-8, filled up with zeros") from None


def name_bytes(text: str) -> bytes:
    """Return the bytes of a name; raise if they are too many."""
    data = text.encode("utf-8")
    if len(data) > NAME_BYTES:
        raise ThermorenderError(
            f"name {text!r} has {len(data)} bytes in UTF-8; the link takes up to {NAME_BYTES}: shorten it"
        )
    return data


def _number(names: Sequence[str], name: str) -> int:
    if name not in names:
        raise ThermorenderError(f"{name!r} is not allowed; give {' or '.join(names)}")
    return names.index(name)


def _exact(payload: bytes | bytearray, length: int, what: str) -> None:
    if len(payload) != length:
        raise ThermorenderError(
            f"{what} has {len(payload)} bytes where its counts make {length}; send the exact length"
        )


def _flags(flags: int, known: int, what: str) -> None:
    if flags & ~known:
        raise ThermorenderError(f"{what} has the flags {flags:#x}; only {known:#x} is defined, set the others to 0")
