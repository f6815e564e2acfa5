"""Finer triangles where objects stand: light between surfaces is constant over a triangle, and beside an object
it changes within a fraction of the object's size.
"""

from dataclasses import replace

import numpy as np

# Longest edge of a triangle on and around an object, and margin around it, as shares of the object's extent.
_EDGE_SHARE = 1.0 / 16.0
_MARGIN_SHARE = 0.25
# A triangle is cut into at most the square of this many equal ones; a longer one is first cut in four, again and again,
# and of these only those that are beside the object: else a spot on a plain would cut all the plain.
_EQUAL_PARTS = 32


def refined(terrain, objects):
    """Return (terrain, objects): the surfaces with their triangles split where objects are.

    Parameters
    ----------
    terrain, objects : sequences of Surface
        A triangle is split so that no edge is longer than a 16th of the extent of the object it belongs to or stands
        beside. The shapes stay what they are.
    """
    terrain = [_quartered(surface, objects) for surface in terrain]
    wanted = [np.full(len(surface.faces), np.inf) for surface in terrain]
    done = []
    for item in objects:
        box, edge = _around(item)
        for surface, limit in zip(terrain, wanted, strict=True):
            near = _near(surface, box)
            limit[near] = np.minimum(limit[near], edge)
        done.append(_split(item, np.full(len(item.faces), edge)))
    return [_split(surface, limit) for surface, limit in zip(terrain, wanted, strict=True)], done


def _around(item):
    """((lowest, highest) corner of what is beside an object, longest edge wanted there [m])."""
    low, high = item.vertices.min(axis=0), item.vertices.max(axis=0)
    extent = float((high - low).max())
    margin = _MARGIN_SHARE * extent
    return (low - margin, high + margin), _EDGE_SHARE * extent


def _near(surface, box):
    """Which triangles of a surface may lie in a box, (F,)."""
    corner = surface.vertices[surface.faces]
    return ((corner.min(axis=1) <= box[1]) & (corner.max(axis=1) >= box[0])).all(axis=1)


def _longest(surface):
    corner = surface.vertices[surface.faces]
    return np.linalg.norm(corner - np.roll(corner, 1, axis=1), axis=-1).max(axis=1)


def _quartered(surface, objects):
    """A surface whose triangles beside objects are cut in four until `_EQUAL_PARTS` suffice."""
    for box, edge in map(_around, objects):
        while (far := _near(surface, box) & (_longest(surface) > _EQUAL_PARTS * edge)).any():
            surface = _split(surface, np.where(far, 0.5 * _longest(surface), np.inf))
    return surface


def _split(surface, limit):
    """A surface whose triangles have no edge longer than `limit` (F,) [m]."""
    corner = surface.vertices[surface.faces]
    parts = np.ceil(np.where(np.isfinite(limit), _longest(surface) / limit, 1.0) - 1e-9).astype(int).clip(1)
    if (parts == 1).all():
        return surface
    whole = parts == 1
    vertices, faces, uv = [surface.vertices], [surface.faces[whole]], [surface.uv[whole]]
    count = len(surface.vertices)
    for n in np.unique(parts[~whole]):
        here = parts == n
        weights = _lattice(n)
        # (faces, n² triangles, 3 corners): corners of their own, since neighbours may be split otherwise.
        points = np.einsum("tcw,fwk->ftck", weights, corner[here]).reshape(-1, 3)
        vertices.append(points)
        faces.append(np.arange(count, count + len(points), dtype=np.int32).reshape(-1, 3))
        uv.append(np.einsum("tcw,fwk->ftck", weights, surface.uv[here]).reshape(-1, 3, 2).astype(np.float32))
        count += len(points)
    return replace(surface, vertices=np.concatenate(vertices), faces=np.concatenate(faces), uv=np.concatenate(uv))


def _lattice(n):
    """Barycentric weights of the corners of n² equal triangles in one, (n², 3, 3)."""
    triangles = []
    for i in range(n):
        for j in range(n - i):
            triangles.append([(i, j), (i + 1, j), (i, j + 1)])
            if i + j < n - 1:
                triangles.append([(i + 1, j), (i + 1, j + 1), (i, j + 1)])
    weights = np.array(triangles, dtype=np.float64) / n
    return np.concatenate([1.0 - weights.sum(axis=-1, keepdims=True), weights], axis=-1)
