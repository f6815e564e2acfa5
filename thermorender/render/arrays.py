"""Arrays on the render side: their upload, packets of channels that one gather reads, and rays of a view."""

from collections.abc import Iterable, Sequence
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike, NDArray

# Dr.Jit arrays and Mitsuba objects: their classes depend on the variant chosen at run time.
Jit = Any
# The module mitsuba with a variant active.
Mitsuba = Any
Floats = NDArray[np.float64]
# From this size on [bytes] the C library maps an array to its own pages, behind 16 bytes that hold its size.
_OWN_PAGES = 1 << 25


def aligned(values: ArrayLike, kind: Any = np.float32) -> NDArray[Any]:
    """Return an array, flat, of a dtype and aligned to 64 bytes; it is copied only where necessary. Dr.Jit uses NumPy's
    memory in place, and recompiles a kernel when the alignment differs. All arrays that kernels read pass through
    here."""
    source = np.asarray(values)
    fits = source.ctypes.data % 64 == 0 or source.nbytes >= _OWN_PAGES
    if fits and source.dtype == kind and source.flags.c_contiguous:
        return source.reshape(-1)
    size = np.dtype(kind).itemsize
    whole = np.empty(source.size + 64 // size, kind)
    first = -whole.ctypes.data % 64 // size
    copy = whole[first : first + source.size]
    copy.reshape(source.shape)[...] = source
    return copy


def widths(channels: int) -> list[int]:
    """Return how many channels are stored side by side; three would take the room of four."""
    found = [4] * (channels // 4)
    left = channels % 4
    return found + ([2, 1] if left == 3 else [left] if left else [])


def opaque_vector(mi: Mitsuba, values: Iterable[float]) -> Jit:
    """Return a Vector3f of opaque Dr.Jit values, so that another one reuses the kernel."""
    return mi.Vector3f(*(dr.opaque(mi.Float, float(value)) for value in values))


def opaque_view(mi: Mitsuba, pose: NDArray[Any]) -> tuple[list[Jit], Jit]:
    """Return (rows of the rotation, origin) of a pose as opaque Dr.Jit values, so that a new pose reuses the kernel."""
    values = [[dr.opaque(mi.Float, float(value)) for value in row] for row in pose[:3]]
    return [mi.Vector3f(*row[:3]) for row in values], mi.Point3f(*(row[3] for row in values))


def view_ray(mi: Mitsuba, rotation: list[Jit], origin: Jit, x: Jit, y: Jit) -> Jit:
    """Return the rays (mi.Ray3f, unit directions) of a view at slopes (x/z, y/z)."""
    local = dr.normalize(mi.Vector3f(x, y, 1.0))
    return mi.Ray3f(origin, mi.Vector3f(*(dr.dot(row, local) for row in rotation)))


class Channels:
    """Numbers per texel or face, (n, channels), stored side by side so that one gather reads them all."""

    def __init__(self, mi: Mitsuba, values: ArrayLike) -> None:
        source = np.asarray(values, dtype=np.float32)
        self._mi, self.count = mi, source.shape[1]
        # Whether surfaces have squares of `Geometry.finest` on alone.
        self.coarse = False
        self.groups: list[tuple[Any, int, Jit]] = []
        for first in range(0, self.count, 4):
            group = source[:, first : first + 4]
            width = {1: 1, 2: 2, 3: 4, 4: 4}[group.shape[1]]
            if group.shape[1] != width:
                group = np.pad(group, ((0, 0), (0, width - group.shape[1])))
            kind = {1: mi.Float, 2: mi.Vector2f, 4: mi.Vector4f}[width]
            self.groups.append((kind, min(self.count - first, width), mi.Float(aligned(group))))

    @classmethod
    def of_arrays(cls, mi: Mitsuba, arrays: Sequence[NDArray[np.floating]], coarse: bool = False) -> "Channels":
        """Return the Channels of arrays (n, width) of `widths`, float32 or float16, which Dr.Jit may use in place."""
        found = cls.__new__(cls)
        found._mi, found.groups, found.count, found.coarse = mi, [], 0, coarse
        for values in arrays:
            width, base = values.shape[1], mi.Float
            if values.dtype == np.float16:
                base = dr.float16_array_t(mi.Float)
            of = {1: mi.Float, 2: mi.Vector2f, 4: mi.Vector4f}[width]
            kind = of if base is mi.Float else dr.float16_array_t(of)
            found.groups.append((kind, width, base(aligned(values, values.dtype))))
            found.count += width
        return found

    def at(self, index: Jit, active: Jit = True) -> list[Jit]:
        """Return the channels at flat indices, as a list of Float."""
        found: list[Jit] = []
        for kind, used, values in self.groups:
            packet = dr.gather(kind, values, index, active)
            found += [packet] if dr.depth_v(packet) == 1 else [packet[i] for i in range(used)]
        # Half precision is for storage only.
        return [self._mi.Float(value) for value in found]
