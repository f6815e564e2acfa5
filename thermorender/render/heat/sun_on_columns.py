"""The sun on columns of a heat balance: where it stands, and the share of its rays that arrives, step by step."""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from thermorender.physics.sun import direction
from thermorender.render.arrays import Jit, aligned
from thermorender.render.geometry import Geometry
from thermorender.render.heat.places import sun_share

if TYPE_CHECKING:
    from thermorender.render.heat.simulation import _Columns
    from thermorender.weather.series import Weather

_DAY_S = 86400
# Shares of the sun are alike in steps of 1/64 within the last hour, of 1/16 before.
_FINE, _COARSE, _FINE_S = 64, 16, 3600.0
# Shares of many texels are kept as whole numbers up to this: 0 and 1 are exact, others to 8e-6, 7 mW/m² of sunlight.
_WHOLE = 65535

# Results of tests for the sun on one Geometry, by what they depend on beside it.
SunMemory = dict[bytes, Any]
_Found = TypeVar("_Found")


class Sun:
    """The sun over a scene, at times in seconds after `start`. Faces from `first_copy` on have light of their own.

    `known` is the memory of a run on the same Geometry, whose tests serve again: an edit of materials moves no shadow.
    """

    def __init__(
        self, geometry: Geometry, weather: "Weather", start: np.datetime64, first_copy: int | None,
        known: SunMemory | None = None,
    ) -> None:  # fmt: skip
        self._geometry, self._weather, self._start = geometry, weather, start
        self._first_copy = first_copy
        self._solid_until = None if first_copy is None else dr.opaque(geometry.mi.UInt32, first_copy)
        self._known = known or {}
        # Not kept: None.
        self.memory: SunMemory | None = None

    @property
    def remembers(self) -> bool:
        """Whether there is a memory to read or to write."""
        return self.memory is not None or bool(self._known)

    def remembered(self, make: Callable[[], _Found], times_s: Sequence[float], *arrays: NDArray[Any]) -> _Found:
        """Return what `make` tests for the sun at these times, which depends on `arrays`, or that of the run before."""
        if not self.remembers:
            return make()
        key = hashlib.blake2b(repr((self._first_copy, [array.shape for array in arrays])).encode(), digest_size=16)
        for array in (*(self.towards(self.instant(time_s)) for time_s in times_s), *arrays):
            key.update(np.ascontiguousarray(array).data)
        name = key.digest()
        found: _Found = self._known[name] if name in self._known else make()
        if self.memory is not None:
            self.memory[name] = found
        return found

    def instant(self, at_s: float) -> np.datetime64:
        """Return the instant of a time."""
        return self._start + np.timedelta64(round(1000.0 * at_s), "ms")

    def towards(self, instant: np.datetime64) -> NDArray[np.float64]:
        """Return the unit vector (3,) to the sun at an instant."""
        azimuth, elevation = self._weather.sun(instant)
        return direction(float(elevation), float(azimuth))

    def share(self, point: Jit, normal: Jit, face: Jit, towards: NDArray[np.float64]) -> Jit:
        """Return the share of the sun's rays that arrives at points, Float; 0 on copies."""
        solid = True if self._solid_until is None else face < self._solid_until
        return sun_share(self._geometry, point, normal, towards, self._geometry.mi.Bool(solid))

    def alike(
        self, point: Jit, normal: Jit, face: Jit, times_s: Sequence[float], first_s: float
    ) -> tuple[NDArray[np.uint64], dict[float, NDArray[np.uint16]]]:
        """Return (a number (n,) that is the same for points of one face whose sun is alike at all these times; {time:
        share} of those at which it is up, as `SunShares` takes them).

        `first_s` is the first time whose temperatures are asked for.
        """
        key, shares = np.array(face).astype(np.uint64), dict[float, NDArray[np.uint16]]()
        for time_s in times_s:
            towards = self.towards(self.instant(time_s))
            if towards[2] > 0.0:
                share = np.array(self.share(point, normal, face, towards))
                shares[time_s] = np.rint(share * _WHOLE).astype(np.uint16)
                parts = _FINE if time_s > first_s - _FINE_S else _COARSE
                key = mixed(key) ^ np.rint(share * parts).astype(np.uint64)
        return mixed(key), shares


class SunShares:
    """The share of the sun's rays that arrives at columns, tested at the ends of steps and linear in time between.

    `texels` are shares that are known, {time: (n,) uint16 of 65535} of the columns after those of the `faces`.
    """

    def __init__(self, sun: Sun, faces: int, texels: Mapping[float, NDArray[np.uint16]] | None = None) -> None:
        self._sun, self._faces, self._texels = sun, faces, texels or {}
        # {time of day [s]: share} of the first day, in which texels share columns.
        self._known: dict[int, Jit] = {}
        self._ends: list[tuple[float, Jit | None]] = []
        self._none: Any = None
        # By whether the faces' columns alone are tested: the points and faces that are.
        self._points = dict[bool, tuple[NDArray[Any], NDArray[Any]]]()

    def step(self, columns: "_Columns", at_s: float, seconds: float, keep: bool) -> None:
        """Test at both ends of a step of `seconds` from `at_s`. With `keep`, the share of a day before serves again:
        the sun's height changes by 0.4° a day at most."""
        known, self._none = dict(self._ends), dr.zeros(type(columns.cooler), dr.width(columns.normal))
        self._ends = [
            (time_s, known[time_s] if time_s in known else self._tested(columns, time_s, keep))
            for time_s in (at_s, at_s + seconds)
        ]

    def at(self, at_s: float) -> Jit:
        """Return the share at a time in the step [s], Float."""
        (start_s, first), (end_s, last) = self._ends
        if first is None or last is None:
            # The sun is above the horizon at one end only, or at neither.
            only = last if first is None else first
            return self._none if only is None else only
        return dr.lerp(first, last, dr.opaque(type(first), (at_s - start_s) / (end_s - start_s)))

    def _tested(self, columns: "_Columns", time_s: float, keep: bool) -> Jit | None:
        """The share at a time, None below the horizon."""
        towards, key = self._sun.towards(self._sun.instant(time_s)), round(time_s) % _DAY_S
        if towards[2] <= 0.0:
            return None
        if keep and key in self._known:
            return self._known.pop(key)
        point, normal, face = columns.point, columns.normal, columns.face
        if time_s in self._texels:
            here = dr.arange(type(face), self._faces)
            point, normal, face = (dr.gather(type(each), each, here) for each in (point, normal, face))

        def tested() -> Jit:
            share = self._sun.share(point, normal, face, towards)
            dr.eval(share)
            return share

        if self._sun.remembers and (keep or self._texels):
            alone = time_s in self._texels
            if alone not in self._points:
                self._points[alone] = np.array(point), np.array(face)
            share = self._sun.remembered(tested, [time_s], *self._points[alone])
        else:
            # Every column at every step would fill the memory.
            share = tested()
        if time_s in self._texels:
            share = dr.concat([share, type(share)(aligned(self._texels[time_s] / np.float32(_WHOLE)))])
            dr.eval(share)
        if keep and time_s < _DAY_S:
            self._known[key] = share
        return share


def mixed(key: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Return numbers of 64 bits in which every bit of `key` takes part: the finalizer of MurmurHash3."""
    for factor in (0xFF51AFD7ED558CCD, 0xC4CEB9FE1A85EC53):
        key = (key ^ key >> np.uint64(33)) * np.uint64(factor)
    return key ^ key >> np.uint64(33)
