"""Finer triangles where light changes within them: beside objects, and where they are large.

Light between surfaces is constant over a triangle. Beside an object it changes within a fraction of the object's size;
on a wall of a surface model, as high as many posts, from its foot to its eaves.
"""

from dataclasses import replace

import numpy as np

# Longest edge of a triangle on and around an object, and margin around it, as shares of the object's extent.
_EDGE_SHARE = 1.0 / 16.0
_MARGIN_SHARE = 0.25
# A triangle is cut into at most the square of this many equal ones; a longer one is first cut in four, again and again,
# and of these only those that are beside the object: else a spot on a plain would cut all the plain.
_EQUAL_PARTS = 32
# Triangles that are spent on cutting the largest ones: a share of all, or so many of a scene that has few.
_MORE_SHARE, _MORE = 0.2, 1000
# Triangles up to this many times as large as most of the surface's are none of the largest.
_LEAST_RATIO = 3.0
# What a triangle with so many halved edges is cut into: corners 0, 1, 2, and middles 3, 4, 5 of the edges after them.
_CUTS = {
    1: ((0, 3, 2), (3, 1, 2)),
    2: ((3, 1, 4), (0, 3, 4), (0, 4, 2)),
    3: ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5)),
}


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


def evened(surface):
    """Return a surface whose largest triangles are cut along shared edges until a fifth more triangles are there.

    Its shape stays what it is, and no edge is left with a corner of one neighbour in the middle of another's side. A
    surface of few triangles, as a box, gets about a thousand; one of equal triangles stays as it is.
    """
    area = _area(surface)
    limit = _limit(area, max(_MORE, int(_MORE_SHARE * len(area))))
    if limit < area.max():
        surface = replace(surface, faces=_shared(surface))
    while (large := area > limit).any():
        surface = _bisected(surface, large)
        area = _area(surface)
    return surface


def _shared(surface):
    """Faces that name corners at one place by one number, as neighbours of a textured mesh need not."""
    _, index, place = np.unique(surface.vertices, axis=0, return_index=True, return_inverse=True)
    return index[place.reshape(-1)][surface.faces].astype(surface.faces.dtype)


def _area(surface):
    corner = surface.vertices[surface.faces]
    return 0.5 * np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)


def _limit(area, more):
    """Area down to which triangles may be halved again and again so that at most `more` come to them."""
    least = 0.0
    if len(area) > more:
        # Half of the surface is of triangles smaller than this: the ground's own, which to halve is not worth the rays.
        order = np.sort(area)
        least = _LEAST_RATIO * order[np.searchsorted(order.cumsum(), 0.5 * order.sum())]
    low, high = np.log2(max(least, 1e-12)), np.log2(max(area.max(), least, 1e-12))
    for _ in range(30):
        middle = 0.5 * (low + high)
        halvings = np.ceil(np.log2(np.maximum(area, 1e-12)) - middle).clip(0)
        low, high = (low, middle) if (np.exp2(halvings) - 1.0).sum() <= more else (middle, high)
    return np.exp2(high)


def _bisected(surface, large):
    """A surface with the longest edge of each `large` triangle halved, and every triangle that has such an edge cut."""
    faces, vertices, count = surface.faces, surface.vertices, len(surface.vertices)
    touched = np.zeros(count, bool)
    touched[faces[large]] = True
    near = np.flatnonzero(touched[faces].any(axis=1))
    # Edge k leads from corner k to the next.
    ends = np.sort(faces[near][:, [[0, 1], [1, 2], [2, 0]]].astype(np.int64), axis=-1)
    edge = ends[..., 0] * count + ends[..., 1]
    longest = np.linalg.norm(vertices[ends[..., 1]] - vertices[ends[..., 0]], axis=-1).argmax(axis=1)
    on = np.flatnonzero(large[near])
    halved_edges = np.unique(edge[on, longest[on]])
    halved = np.isin(edge, halved_edges)
    cut = halved.any(axis=1)
    near, edge, halved = near[cut], edge[cut], halved[cut]
    # Turned so that those with as many halved edges are alike: its only one first, or its only whole one last.
    number = halved.sum(axis=1)
    first = np.where(number == 1, halved.argmax(axis=1), (halved.argmin(axis=1) + 1) % 3)
    turn = (first[:, None] + np.arange(3)) % 3
    row = np.arange(len(near))[:, None]
    corner, uv = faces[near[:, None], turn], surface.uv[near[:, None], turn]
    corner = np.hstack([corner, count + np.searchsorted(halved_edges, edge[row, turn])])
    uv = np.concatenate([uv, 0.5 * (uv + uv[:, [1, 2, 0]])], axis=1)
    whole = np.ones(len(faces), bool)
    whole[near] = False
    parts = [(faces[whole], surface.uv[whole])]
    parts += [
        (corner[number == n][:, triangle], uv[number == n][:, triangle])
        for n, triangles in _CUTS.items()
        for triangle in triangles
    ]
    middles = 0.5 * (vertices[halved_edges // count] + vertices[halved_edges % count])
    return replace(
        surface,
        vertices=np.concatenate([vertices, middles.astype(vertices.dtype)]),
        faces=np.concatenate([part for part, _ in parts]).astype(faces.dtype),
        uv=np.concatenate([part for _, part in parts]).astype(surface.uv.dtype),
    )


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
