"""Mitsuba's shapes of surfaces: a mesh each, or the copies of a body."""

from collections.abc import Sequence
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from thermorender.render.arrays import Floats, Jit, Mitsuba, aligned
from thermorender.scene.instances import Instances
from thermorender.scene.surface import Surface


def positions(vertices: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return vertices (V, 3) flat, (3 V,) float32, with the four bytes of padding that Embree reads."""
    whole = np.empty(3 * len(vertices) + 1, np.float32)
    whole[:-1] = np.ravel(vertices)
    return whole[:-1]


def mesh(mi: Mitsuba, name: str, vertices: Floats, faces: NDArray[np.integer]) -> Jit:
    """Return a mesh without normals of its own."""
    made = mi.Mesh(name, len(vertices), len(faces))
    parameters = mi.traverse(made)
    parameters["vertex_positions"] = positions(vertices)
    # np.array drops array subclasses, which Mitsuba refuses.
    parameters["faces"] = np.array(faces, dtype=np.uint32).ravel()
    parameters.update()
    return made


class CopyShapes:
    """Shapes of the caster for copies of bodies, and what their numbers mean."""

    def __init__(self, mi: Mitsuba, surfaces: Sequence[Surface], face_start: NDArray[np.integer]) -> None:
        self._mi, self.shapes, self.numbers = mi, dict[str, Jit](), list[NDArray[Any]]()
        self._parts: list[tuple[NDArray[Any], int, int]] = []
        self._patch: list[NDArray[np.uint8]] = []
        triangles = 0
        for number, surface in enumerate(surfaces):
            body = surface.instances
            if not isinstance(body, Instances):
                continue
            shape = mesh(mi, f"s{number}", body.vertices, body.faces)
            group = mi.load_dict({"type": "shapegroup", "mesh": shape})
            # The scene holds the group too, since it gives it to Embree.
            self.shapes[f"g{number}"] = group
            to_world = np.tile(np.eye(4), (len(body), 1, 1))
            to_world[:, :3] = body.matrices
            made = [
                mi.load_dict({"type": "instance", "group": group, "to_world": mi.ScalarTransform4f(matrix)})
                for matrix in to_world
            ]
            self.shapes |= {f"i{number}_{copy}": shape for copy, shape in enumerate(made)}
            self.numbers.append(np.array([number_of(mi, shape) for shape in made]))
            first = int(face_start[number]) + body.patches * np.arange(len(body))
            self._parts.append((first, triangles, number))
            self._patch.append(body.patch)
            triangles += len(body.patch)

    def uploaded(self) -> tuple[Jit, ...]:
        """Return (first face, first triangle, surface) by the number of a copy, and the patch of each triangle."""
        table = np.zeros((3, int(max(part.max() for part in self.numbers)) + 1), np.uint32)
        for number, (first, triangle, surface) in zip(self.numbers, self._parts, strict=True):
            table[0, number], table[1, number], table[2, number] = first, triangle, surface
        return tuple(self._mi.UInt32(aligned(values, np.uint32)) for values in (*table, np.concatenate(self._patch)))


def number_of(mi: Mitsuba, shape: Jit) -> int:
    """Mitsuba's number of a shape."""
    return int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0])
