"""Weights of a network on file in few bits: tensors as whole multiples of a step each, Huffman coded."""

import zlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

# Greatest code by bytes: one, or two where a tensor needs finer steps.
MOST_CODE = {1: 127, 2: 32767}
# Bytes that codes may unpack to: the largest network of full width, in two bytes a weight.
_MOST_BYTES = 1 << 29


def packed(state: Mapping[str, np.ndarray], steps: Mapping[str, float]) -> tuple[np.ndarray, list[list[Any]]]:
    """Return (codes (n,) uint8, table) of the tensors that have a step; a row is (name, shape, bytes, step)."""
    found, table = [], []
    for name, step in steps.items():
        codes = np.rint(state[name] / np.float32(step)).astype(np.int16)
        size = 1 if np.abs(codes).max() <= MOST_CODE[1] else 2
        # Bytes of one place after the other: those above are nearly all alike.
        found.append(codes.astype(f"<i{size}").reshape(-1, 1).view(np.uint8).T.tobytes())
        table.append([name, list(codes.shape), size, step])
    press = zlib.compressobj(9, zlib.DEFLATED, -15, 9, zlib.Z_HUFFMAN_ONLY)
    return np.frombuffer(press.compress(b"".join(found)) + press.flush(), np.uint8), table


def unpacked(codes: np.ndarray, table: Sequence[Sequence[Any]]) -> dict[str, np.ndarray]:
    """Return {name: float32 array} of `packed`; ValueError if the table is none or does not belong to the codes."""
    sizes = []
    for name, shape, size, step in table:
        if not (isinstance(name, str) and size in MOST_CODE and isinstance(step, float) and 0.0 < step < np.inf):
            raise ValueError("its table of weights is none")
        if not all(type(length) is int and 0 < length < 1 << 24 for length in shape):
            raise ValueError("its table of weights is none")
        sizes.append(size * int(np.prod([float(length) for length in shape])))
    if sum(sizes) > _MOST_BYTES:
        raise ValueError("its table of weights is of more than a network holds")
    press = zlib.decompressobj(-15)
    data = press.decompress(codes.tobytes(), sum(sizes) + 1)
    if len(data) != sum(sizes):
        raise ValueError("its weights are not those of its table")
    found, start = {}, 0
    for (name, shape, size, step), length in zip(table, sizes, strict=True):
        each = np.frombuffer(data, np.uint8, length, start).reshape(size, -1).T
        found[name] = np.ascontiguousarray(each).view(f"<i{size}").reshape(shape) * np.float32(step)
        start += length
    return found
