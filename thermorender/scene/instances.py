"""Instances of one body: its triangles once, and a position, heading and scale for each copy.

The rest of the package sees each copy as a few patches, by height and orientation, with one texel each. A patch is
stored as a triangle that rays never meet; a hit on a triangle of the body belongs to the patch of that triangle.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError
from thermorender.physics.srgb import bytes_from_linear, linear_from_bytes
from thermorender.scene.meshes.mesh import one_texel_each
from thermorender.scene.surface import Surface
from thermorender.scene.textures import colour_of_faces

Floats = NDArray[np.float64]

# Classes of height of equal area, and sectors round the vertical that triangles face, each with those that face up and
# down. Light within a crown changes with height. What faces a camera is seen by it, and what faces the sun is warm.
HEIGHTS, SECTORS = 2, 3
# Most patches of a copy.
PATCHES = 2 * HEIGHTS * SECTORS
# Rows of a table of copies: the light of so many takes about 6 GB.
MOST_COPIES = 150_000
# Smallest factor: smaller copies are lost in the rounding of places.
LEAST_SCALE = 1e-3
# Triangles that copies may have as ordinary faces, about 200 bytes each.
MOST_EXPANDED = 10_000_000


@dataclass(frozen=True, eq=False)
class Instances:
    """Copies of a body."""

    vertices: Floats  # (V, 3) float64 of the body in its own frame: x right, y ahead, z up [m]
    faces: NDArray[np.int32]  # (F, 3) int32
    patch: NDArray[np.uint8]  # (F,) uint8 patch of each triangle, from 0
    position: Floats  # (n, 3) float64 place of each copy's origin in the scene's frame [m]
    # yaw_deg, scale: (n,) float64 heading, clockwise from north, and factor on all lengths
    yaw_deg: Floats
    scale: Floats

    def __len__(self) -> int:
        return len(self.position)

    def __str__(self) -> str:
        return "1 copy" if len(self) == 1 else f"{len(self)} copies"

    @property
    def patches(self) -> int:
        """Patches of each copy."""
        return int(self.patch.max()) + 1

    @property
    def matrices(self) -> Floats:
        """From the body's frame to the scene's, (n, 3, 4)."""
        heading = np.radians(self.yaw_deg)
        cosine, sine = self.scale * np.cos(heading), self.scale * np.sin(heading)
        found = np.zeros((len(self), 3, 4))
        found[:, 0, 0], found[:, 0, 1] = cosine, sine
        found[:, 1, 0], found[:, 1, 1] = -sine, cosine
        found[:, 2, 2], found[:, :, 3] = self.scale, self.position
        return found

    @property
    def face_area(self) -> Floats:
        """Area of the body's triangles, (F,) [m²]."""
        corner = self.vertices[self.faces]
        across = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        found: Floats = 0.5 * np.linalg.norm(across, axis=1)
        return found

    @property
    def area(self) -> Floats:
        """Area of the triangles of each patch of each copy, (n × patches,) [m²]."""
        own = np.bincount(self.patch, self.face_area, self.patches)
        return (self.scale[:, None] ** 2 * own).reshape(-1)

    def stand_ins(self) -> tuple[Floats, NDArray[np.int32]]:
        """Return (vertices, faces) of a triangle for each patch: its lowest and highest corner, and its mean."""
        corner, area = self.vertices[self.faces], self.face_area
        found = []
        for patch in range(self.patches):
            own = self.patch == patch
            point = corner[own].reshape(-1, 3)
            low, high = point[point[:, 2].argmin()], point[point[:, 2].argmax()]
            middle = np.average(corner[own].mean(axis=1), axis=0, weights=np.maximum(area[own], 1e-12))
            third = 3.0 * middle - low - high
            third[2] = np.clip(third[2], low[2], high[2])
            found.append([low, high, third])
        matrix = self.matrices
        vertices = np.einsum("nij,pkj->npki", matrix[:, :, :3], np.array(found)) + matrix[:, None, None, :, 3]
        vertices = vertices.reshape(-1, 3)
        return vertices, np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)


def placed(surface: Surface, place: Mapping[str, Floats]) -> Surface:
    """Return the Surface of copies of a body; `place` is {"position": (n, 3) [m], "yaw_deg": (n,), "scale": (n,)}."""
    body = Instances(surface.vertices, surface.faces, np.zeros(len(surface.faces), np.uint8), **place)
    patch = _patches(surface.vertices[surface.faces], body.face_area)
    body = replace(body, patch=patch)
    vertices, faces = body.stand_ins()
    uv, shape = one_texel_each(len(faces))
    colour = np.resize(_colours(surface, body), (*shape, 3))
    return replace(
        surface, vertices=vertices, faces=faces, uv=uv, colour=colour,
        material=np.full(shape, surface.material.flat[0]), temperature=np.full(shape, surface.temperature.flat[0]),
        flags=np.full(shape, surface.flags.flat[0]),
        texel_m=float(np.sqrt(body.area.mean())), instances=body,
    )  # fmt: skip


def _colours(surface: Surface, body: Instances) -> NDArray[np.uint8]:
    """Mean colour of the texture on each patch of a body, (patches, 3) sRGB, read at the middles of its triangles."""
    light = linear_from_bytes(colour_of_faces(surface))
    area = np.maximum(body.face_area, 1e-12)
    total = np.column_stack([np.bincount(body.patch, area * band) for band in light.T])
    return bytes_from_linear(total / np.bincount(body.patch, area)[:, None])


def _patches(corner: Floats, area: Floats) -> NDArray[np.uint8]:
    """Patch of each triangle of a body, (F,), by height and by the side that it faces; without empty ones."""
    height, across = corner[..., 2].mean(axis=1), np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    order = np.argsort(height, kind="stable")
    below = np.empty(len(height))
    below[order] = np.cumsum(area[order]) - area[order]
    # Triangles at one height are in one class.
    level, first = np.unique(height[order], return_index=True)
    share = below[order][first][np.searchsorted(level, height)] / max(float(area.sum()), 1e-300)
    layer = np.minimum((HEIGHTS * share).astype(np.int64), HEIGHTS - 1)
    sector = np.floor(SECTORS * np.arctan2(across[:, 1], across[:, 0]) / (2.0 * np.pi)).astype(np.int64) % SECTORS
    kind = 2 * (SECTORS * layer + sector) + (across[:, 2] > 0.0)
    return np.unique(kind, return_inverse=True)[1].reshape(-1).astype(np.uint8)


def alone(surface: Surface) -> Surface:
    """Return the body of a surface of copies, in its own frame, with a single texel."""
    body = surface.instances
    assert isinstance(body, Instances)
    one = {name: getattr(surface, name)[:1, :1] for name in ("colour", "material", "temperature", "flags")}
    uv = np.full((len(body.faces), 3, 2), 0.5, np.float32)
    return replace(surface, vertices=body.vertices, faces=body.faces, uv=uv, instances=None, scatter_k=None, **one)


def expanded(surface: Surface) -> Surface:
    """Return a surface whose copies are ordinary triangles, each with the texel of its patch."""
    body = surface.instances
    if body is None:
        return surface
    if not isinstance(body, Instances):
        raise ThermorenderError(
            f"surface {surface.name!r} has crowns, through which light passes in part, and the reference engine traces "
            "solid surfaces only; leave out its object, or give a mesh of leaves"
        )
    if len(body) * len(body.faces) > MOST_EXPANDED:
        raise ThermorenderError(
            f"surface {surface.name!r} has {len(body)} copies of {len(body.faces)} triangles, more than "
            f"{MOST_EXPANDED} in all for the reference engine; give it a scene with fewer copies"
        )
    matrix = body.matrices
    vertices = np.einsum("nij,vj->nvi", matrix[:, :, :3], body.vertices) + matrix[:, None, :, 3]
    number = np.arange(len(body))[:, None]
    faces = body.faces + (len(body.vertices) * number)[..., None]
    uv = surface.uv[(body.patches * number + body.patch).reshape(-1)]
    return replace(
        surface, vertices=vertices.reshape(-1, 3), faces=faces.reshape(-1, 3).astype(np.int32), uv=uv, instances=None,
        scatter_k=None,
    )  # fmt: skip


def read_places(path: Path, others: Mapping[str, tuple[float, float, str]]) -> dict[str, Floats]:
    """Return {column: (n,)} of a table of copies: a CSV with east_m and north_m, and any of the other columns.

    `others` are further columns, each with its least and largest value and unit.
    """
    from thermorender.scene.tracks import read_columns

    columns, rows = read_columns(path, ("east_m", "north_m"), ("above_ground_m", "yaw_deg", "scale", *others))
    if len(rows) > MOST_COPIES:
        raise ThermorenderError(
            f"{path} has {len(rows)} rows, more than the {MOST_COPIES} copies whose light fits into an ordinary "
            "machine's memory; give fewer rows, such as those in view"
        )
    scale = columns.setdefault("scale", np.ones(len(rows)))
    small = scale < LEAST_SCALE
    if small.any():
        raise ThermorenderError(
            f"{path}, row {rows[int(np.argmax(small))]}: scale={scale[small][0]:g} is not allowed; give a factor of at "
            f"least {LEAST_SCALE:g}"
        )
    for name, (least, most, unit) in others.items():
        values = columns.get(name, np.full(1, least))
        off = (values < least) | (values > most)
        if off.any():
            raise ThermorenderError(
                f"{path}, row {rows[int(np.argmax(off))]}: {name}={values[off][0]:g} is not allowed; give "
                f"{least:g} to {most:g} {unit}"
            )
    for name in ("above_ground_m", "yaw_deg"):
        columns.setdefault(name, np.zeros(len(rows)))
    return columns
