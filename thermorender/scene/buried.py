"""Objects that are in the ground in part: what share of each is, seen from above."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from thermorender.scene.crowns import Crowns
from thermorender.scene.ground import Ground
from thermorender.scene.instances import Instances, alone
from thermorender.scene.surface import Surface
from thermorender.scene.tracks import TrackedObject

_Floats = NDArray[np.float64]
# Largest share that needs no note, and depth that counts [m].
_MOST, _DEPTH_M = 0.1, 0.01
# Points of an object at a place, and places along a track or copies, that are looked at.
_POINTS, _PLACES = 150, 20
_MOST_NAMED = 5


def notes(
    surfaces: Sequence[Surface], terrain_count: int, tracked: Sequence[TrackedObject], ground: Ground
) -> tuple[str, ...]:
    """Return a sentence on each object that is more than 10 % under the ground, seen from above.

    An object with a track is looked at along it, and of copies and crowns some are.
    """
    still: dict[str, list[Surface]] = {}
    for surface in surfaces[terrain_count:]:
        still.setdefault(surface.name.split(":")[0], []).append(surface)
    parts = [(name, "", _still(own)) for name, own in still.items()]
    parts += [part for one in tracked for part in _along(one, ground)]
    if not parts:
        return ()
    point = np.concatenate([points for _, _, points in parts])
    # Off the terrain nothing is buried.
    depth = np.nan_to_num(ground(point[:, 0], point[:, 1]) - point[:, 2], nan=-np.inf)
    start = np.cumsum([len(points) for _, _, points in parts])[:-1]
    found: dict[str, tuple[float, float, str]] = {}
    for (name, where, _), own in zip(parts, np.split(depth, start), strict=True):
        share = float(np.mean(own > _DEPTH_M))
        if share > max(_MOST, found.get(name, (0.0,))[0]):
            found[name] = share, float(own.max()), where
    sentences = [
        f"object {name!r} is {share:.0%} under the ground, seen from above{where}; move it, or raise it by "
        f"{np.ceil(100.0 * deep) / 100.0:.2f} m (the third number of its position, or above_ground_m)"
        for name, (share, deep, where) in list(found.items())[:_MOST_NAMED]
    ]
    if len(found) > _MOST_NAMED:
        sentences.append(f"{len(found) - _MOST_NAMED} further objects are more than {_MOST:.0%} under the ground")
    return tuple(sentences)


def _still(surfaces: Sequence[Surface]) -> _Floats:
    """Tops (n, 3) of an object without a track; of copies and crowns those of some."""
    bodies = surfaces[0].instances
    if bodies is None:
        return _tops(surfaces, np.eye(4))
    chosen = np.linspace(0, len(bodies) - 1, min(len(bodies), _PLACES)).astype(int)
    return _crowns(bodies, chosen) if isinstance(bodies, Crowns) else _copies(surfaces, bodies, chosen)


def _crowns(crowns: Crowns, chosen: NDArray[np.int_]) -> _Floats:
    """Tops (n, 3) of chosen crowns."""
    unit = 2.0 * _even() - 1.0
    if not crowns.box:
        unit = unit[np.hypot(*unit.T) < 1.0]
    top = np.ones(len(unit)) if crowns.box else np.sqrt(1.0 - (unit**2).sum(axis=1))
    local = np.column_stack([unit, top]) * crowns.half[chosen, None]
    found: _Floats = np.einsum("nij,npj->npi", crowns.axes[chosen], local) + crowns.middle[chosen, None]
    return found.reshape(-1, 3)


def _copies(surfaces: Sequence[Surface], copies: Instances, chosen: NDArray[np.int_]) -> _Floats:
    """Tops (n, 3) of chosen copies of a body."""
    some, body = copies.matrices[chosen], _tops([alone(surface) for surface in surfaces], np.eye(4))
    found: _Floats = (np.einsum("nij,pj->npi", some[:, :, :3], body) + some[:, None, :, 3]).reshape(-1, 3)
    return found


def _along(one: TrackedObject, ground: Ground) -> Iterator[tuple[str, str, _Floats]]:
    """(name, place in words, tops) of an object at times of its track, where it is over the terrain."""
    for time_s in np.linspace(one.time_s[0], one.time_s[-1], _PLACES):
        values = one.at(float(time_s))
        if np.isnan(ground(values["east_m"], values["north_m"])):
            continue
        matrix = one.world_from_own(values, ground)
        where = f" at {values['east_m']:.1f} m east, {values['north_m']:.1f} m north"
        yield one.name, where, _tops(one.surfaces, matrix)


def _tops(surfaces: Sequence[Surface], matrix: _Floats) -> _Floats:
    """Points (n, 3) of triangles that face up, for equal shares of their area in plan, of surfaces placed by (4, 4).

    A body without such triangles, as an upright sheet, has points of all its triangles.
    """
    corner = np.concatenate([one.vertices[one.faces] for one in surfaces]) @ matrix[:3, :3].T + matrix[:3, 3]
    across = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    up = np.maximum(across[:, 2], 0.0)
    reached = np.cumsum(up if up.any() else np.linalg.norm(across, axis=1))
    number = np.arange(_POINTS)
    a, b, c = np.moveaxis(corner[np.searchsorted(reached, (number + 0.5) / _POINTS * reached[-1])], 1, 0)
    # Folded from the square into a triangle.
    even = _even()
    even = np.where(even.sum(axis=1, keepdims=True) > 1.0, 1.0 - even, even)
    found: _Floats = a + even[:, :1] * (b - a) + even[:, 1:] * (c - a)
    return found


def _even() -> _Floats:
    """Even points (n, 2) of a unit square: the additive sequence of the plastic number."""
    found: _Floats = np.outer(np.arange(_POINTS) + 0.5, [0.7548776662466927, 0.5698402909980532]) % 1.0
    return found
