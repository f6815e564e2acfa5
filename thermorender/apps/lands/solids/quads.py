"""Plane quadrilaterals with pictures of their own, collected into one mesh: walls, roofs, boxes."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.apps.lands.solids.textured_mesh import TexturedMesh
from thermorender.physics.srgb import bytes_from_linear

# Called with (s, t), each (h, w) from 0 to 1 along the first and the last edge; returns linear colour (h, w, 3) or
# (3,), and class numbers (h, w) or a number.
Paint = Callable[[NDArray[np.float64], NDArray[np.float64]], tuple[ArrayLike, ArrayLike]]


class Quads:
    """Quadrilaterals under construction, with texels of `texel_m`; triangles have edges up to `edge_m`, as light is
    constant over one.
    """

    def __init__(self, texel_m: float, edge_m: float = 2.0) -> None:
        self.texel_m, self.edge_m = texel_m, edge_m
        self._corners: list[NDArray[np.float64]] = []
        self._colour: list[NDArray[np.uint8]] = []
        self._classes: list[NDArray[np.uint8]] = []

    def __len__(self) -> int:
        return len(self._corners)

    def add(self, corners: ArrayLike, paint: Paint) -> None:
        """Add a quadrilateral, (4, 3) [m], counter-clockwise seen from outside; two corners may coincide.

        Its picture has its rows along the first edge and is seen upright with that edge at the bottom.
        """
        corner = np.asarray(corners, np.float64)
        width, height = _sides(corner)
        if min(width, height) < 1e-3:
            return
        columns, rows = (max(1, int(np.ceil(side / self.texel_m - 1e-9))) for side in (width, height))
        s, t = np.meshgrid((np.arange(columns) + 0.5) / columns, 1.0 - (np.arange(rows) + 0.5) / rows)
        colour, classes = paint(s, t)
        self._corners.append(corner)
        linear = np.broadcast_to(np.asarray(colour, np.float32), (rows, columns, 3))
        self._colour.append(bytes_from_linear(np.clip(linear, 0.0, 1.0)))
        self._classes.append(np.broadcast_to(np.asarray(classes, np.uint8), (rows, columns)))

    def box(self, position: Callable[[float, float], tuple[float, float]], u: float, v: float, half_u: float,
            half_v: float, low: float, high: float, paint: Paint) -> None:  # fmt: skip
        """Add the sides and the top of a box; `position` maps its own axes to east and north [m]."""
        ring = [(u - half_u, v - half_v), (u + half_u, v - half_v), (u + half_u, v + half_v), (u - half_u, v + half_v)]
        plan = [position(*each) for each in ring]
        self.prism(plan, low, high, paint)
        self.add([(*each, high) for each in plan], paint)

    def prism(self, plan: Sequence[tuple[float, float]], low: float, high: float, paint: Paint) -> None:
        """Add the sides of a prism over a plan, whose corners are counter-clockwise seen from above [m]."""
        for (e0, n0), (e1, n1) in zip(plan, [*plan[1:], plan[0]], strict=True):
            self.add([(e0, n0, low), (e1, n1, low), (e1, n1, high), (e0, n0, high)], paint)

    def mesh(self, name: str) -> TexturedMesh:
        """Return all quadrilaterals as one TexturedMesh, their pictures side by side in one texture."""
        sizes = np.array([each.shape for each in self._classes]) + 2
        places, (height, width) = _packed(sizes)
        colour = np.zeros((height, width, 3), np.uint8)
        classes = np.full((height, width), self._classes[0].flat[0])
        vertices, faces, uv, count = [], [], [], 0
        pictures = zip(self._corners, self._colour, self._classes, places, sizes, strict=True)
        for corner, own, numbers, (row, column), (rows, columns) in pictures:
            part = slice(row, row + rows), slice(column, column + columns)
            # A border of one texel keeps neighbours from blending in.
            colour[part] = np.pad(own, ((1, 1), (1, 1), (0, 0)), "edge")
            classes[part] = np.pad(numbers, 1, "edge")
            point, triangle, at = _grid(corner, self.edge_m)
            across = column + 1 + at[..., 0] * (columns - 2)
            down = row + 1 + (1.0 - at[..., 1]) * (rows - 2)
            vertices.append(point)
            faces.append(triangle + count)
            uv.append(np.stack([across / width, down / height], axis=-1)[triangle])
            count += len(point)
        joined = np.concatenate(uv).astype(np.float32)
        return TexturedMesh(name, np.concatenate(vertices), np.concatenate(faces), joined, colour, classes)


def _sides(corner: NDArray[np.float64]) -> tuple[float, float]:
    """(width, height): the longer of each pair of opposite edges."""
    length = np.linalg.norm(np.roll(corner, -1, axis=0) - corner, axis=1)
    return float(max(length[0], length[2])), float(max(length[1], length[3]))


def _grid(
    corner: NDArray[np.float64], edge_m: float
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]:
    """(points (n, 3), triangles (m, 3), (s, t) of the points (n, 2)) of a quadrilateral cut into small triangles."""
    across, along = (max(1, int(np.ceil(side / edge_m - 1e-9))) for side in _sides(corner))
    s, t = (line.ravel() for line in np.meshgrid(np.linspace(0, 1, across + 1), np.linspace(0, 1, along + 1)))
    weight = np.stack([(1 - s) * (1 - t), s * (1 - t), s * t, (1 - s) * t], axis=-1)
    point = weight @ corner
    index = np.arange(len(s)).reshape(along + 1, across + 1)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
    triangle = np.concatenate([np.stack([a, b, c], axis=-1), np.stack([a, c, d], axis=-1)])
    first, second, third = np.moveaxis(point[triangle], 1, 0)
    area = np.linalg.norm(np.cross(second - first, third - first), axis=1)
    return point, triangle[area > 1e-9], np.stack([s, t], axis=-1)


def _packed(sizes: NDArray[np.integer]) -> tuple[NDArray[np.int64], tuple[int, int]]:
    """(row and column (n, 2) of rectangles of `sizes` (n, 2) in one picture, its rows and columns), row by row."""
    width = int(max(sizes[:, 1].max(), np.ceil(np.sqrt(1.1 * sizes.prod(axis=1).sum()))))
    place, row, column, tall = np.zeros((len(sizes), 2), np.int64), 0, 0, 0
    for number in np.argsort(-sizes[:, 0], kind="stable"):
        rows, columns = sizes[number]
        if column + columns > width:
            row, column, tall = row + tall, 0, 0
        place[number] = row, column
        column, tall = column + columns, max(tall, rows)
    return place, (int(row + tall), width)
