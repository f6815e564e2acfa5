"""Sunlight on the patches of instanced bodies, such as crowns, and its scatter within a patch.

A patch has one temperature, that of its mean sunlight. A second column of each patch stands for a leaf with one
standard deviation more sunlight and less sky. The difference of their temperatures estimates the scatter.
"""

from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from thermorender.render.arrays import Floats, Jit, aligned, opaque_vector
from thermorender.render.geometry import Geometry
from thermorender.render.light import leaves, radiosity
from thermorender.scene.crowns import PROJECTION, Crowns

# Points of a patch from which rays test for the sun; fewer of leaves in crowns, of which the light is a mean already,
# where all together would have more rays than that, but as many as in the last number; and patches handled at a time.
_POINTS, _MOST_RAYS, _LEAST_POINTS = 32, 1 << 18, 8
_AT_ONCE = 1 << 16
# Interval between instants for which the sun is tested [s]; between them sunlight is linear in time.
_STEP_S = 3600.0
# Steps in a day, and days for which one day's sunlight is used: the sun's height changes by 0.4° a day at most.
_DAY, _DAYS = 24, 2
# Least variation of the share of sky within a patch.
_LEAST = 1e-6

_Pair = tuple[NDArray[np.float32], NDArray[np.float32]]


class Copies:
    """The patches of copies, whose temperatures are solved at a number of `instants`. `surfaces` are the numbers of
    their surfaces, the last ones that are solved; `towards` returns the direction to the sun, (3,), at a time [s].
    Their faces are `first` to `last` − 1."""

    def __init__(
        self, geometry: Geometry, surfaces: range, instants: int, towards: Callable[[float], Floats]
    ) -> None:  # fmt: skip
        self.first, self.last = (int(geometry.face_start[number]) for number in (surfaces.start, surfaces.stop))
        self._geometry, self._surfaces, self._towards = geometry, surfaces, towards
        self._points = _POINTS
        self._known: dict[tuple[int, int], _Pair] = {}
        self._texels = geometry.texel_start[surfaces.start : surfaces.stop + 1]
        own = [geometry.surfaces[number] for number in surfaces]
        self._leaf = np.repeat([isinstance(s.instances, Crowns) for s in own], [len(s.faces) for s in own])
        while self._leaf.all() and len(self._leaf) // 2 * self._points > _MOST_RAYS and self._points > _LEAST_POINTS:
            self._points //= 2
        self._rays_of = radiosity.FaceRays(geometry, self._points // 2)
        self._scatter = np.zeros((instants, int(self._texels[-1] - self._texels[0])), np.float32)

    def hidden(self, face: NDArray[Any]) -> NDArray[np.float32]:
        """Return the standard deviation of the share of sky within patches, above 0, of faces (n,); 0 elsewhere."""
        found = [np.zeros(1)]
        for number in self._surfaces:
            body = self._geometry.surfaces[number].instances
            assert body is not None
            if isinstance(body, Crowns):
                found.append(np.zeros(body.patches * len(body)))
                continue
            found.append(np.tile(leaves.within_body(self._geometry, number, radiosity.openness), len(body)))
        spread = np.maximum(np.concatenate(found), _LEAST).astype(np.float32)
        spread[0] = 0.0
        return spread[np.where(face >= self.first, face.astype(np.int64) - self.first + 1, 0)]

    def take_means(
        self, instant: int, found: NDArray[Any], texels: NDArray[Any], face: NDArray[Any], kelvin: NDArray[Any]
    ) -> None:  # fmt: skip
        """Replace leaf temperatures `found` of texels on copies by the means of their patches, and keep the difference
        as scatter. `face` is that of each of `texels`, `kelvin` the temperature of all faces [K]; mixtures keep the
        largest scatter of their parts."""
        on = (face >= self.first) & (face < self.last)
        place, mean = texels[on] - self._texels[0], kelvin[face[on]]
        scatter = np.abs(found[texels[on]] - mean)
        self._scatter[instant, place] = np.maximum(self._scatter[instant, place], scatter)
        found[texels[on]] = mean

    def spread(self, first: NDArray[np.integer]) -> None:
        """Give texels the scatter of the texel whose number is theirs in `first`, (T,)."""
        own = slice(self._texels[0], self._texels[-1])
        self._scatter = self._scatter[:, first[own] - self._texels[0]]

    def scatter_k(self, instant: int) -> list[NDArray[np.float32]]:
        """Return the standard deviation of temperature within the texels of each surface at an instant [K]."""
        return np.split(self._scatter[instant], self._texels[1:-1] - self._texels[0])

    def on(self, face: Jit, more: Jit, cosine: Jit, at_s: float) -> Jit:
        """Return the cosines of the sun's rays on columns at a time [s], 0 in shadow: on copies the mean of the patch,
        with `more` one standard deviation above it."""
        mi, first = self._geometry.mi, dr.opaque(self._geometry.mi.UInt32, self.first)
        here = face >= first
        place = at_s / _STEP_S
        step = int(np.floor(place + 1e-9))
        share = np.float32(max(place - step, 0.0))
        mean, spread = (
            dr.gather(mi.Float, mi.Float(aligned((1.0 - share) * a + share * b)), face - first, here)
            for a, b in zip(self._at(step), self._at(step + 1), strict=True)
        )
        return dr.select(here, mean + dr.select(more, spread, 0.0), cosine)

    def _at(self, step: int) -> _Pair:
        """(mean, standard deviation) of the cosine over each patch, 0 in shadow, (last − first,) each."""
        key = step % _DAY, step // (_DAY * _DAYS)
        if key not in self._known:
            # Only those of the latest days are kept.
            self._known = {each: values for each, values in self._known.items() if each[1] >= key[1] - 1}
            self._known[key] = self._tested(step * _STEP_S)
        return self._known[key]

    def _tested(self, at_s: float) -> _Pair:
        mi, towards, leaf = self._geometry.mi, self._towards(at_s), self._leaf
        mean, spread = np.zeros(len(leaf), np.float32), np.zeros(len(leaf), np.float32)
        if towards[2] <= 0.0:
            return mean, spread
        sun = opaque_vector(mi, towards)
        # The two sides of a leaf in a crown have the same sunlight: one of them is tested.
        tested = np.flatnonzero(~leaf | (np.cumsum(leaf) % 2 == 1))
        for start in range(0, len(tested), _AT_ONCE):
            part = tested[start : start + _AT_ONCE]
            origin, _, _, normal = self._rays_of(mi.UInt32(aligned(part + self.first, np.uint32)), 0)
            even = mi.Float(aligned(np.repeat(np.where(leaf[part], PROJECTION, 0.0), self._points)))
            # Of thin leaves of all orientations, by their mean projection; of triangles on the lit side.
            cosine = dr.select(even > 0.0, even, dr.maximum(dr.dot(normal, sun), 0.0))
            lit = cosine * self._geometry.sunlight(origin, towards, cosine > 0.0)
            found = np.array(lit).reshape(len(part), -1)
            mean[part], spread[part] = found.mean(axis=1), found.std(axis=1)
        mean[leaf] = mean[leaf][::2].repeat(2)
        # Other columns of crowns are leaves in the sun.
        spread[leaf] = PROJECTION - mean[leaf]
        return mean, spread
