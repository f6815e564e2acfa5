"""What the readers of mesh formats return: triangles of one material; and the files that a mesh names."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError, shortened
from thermorender.paths import inside

# sRGB of a surface whose file states no colour.
GREY = np.full(3, 102, np.uint8)
# Corners of a concave polygon that are tried as the start of its triangles.
_MOST_STARTS = 64


@dataclass(frozen=True, eq=False)
class Coat:
    """Colour of triangles, as their file states it."""

    what: str = "texture"  # "texture 'a.png'" or "texture of material 'a'", for messages
    colour: NDArray[np.uint8] = field(default_factory=GREY.copy)  # (3,) uint8 sRGB where there is no image
    image: bytes | None = None  # An image file
    # (3,) float64 on the linear light of the colour or image
    factor: NDArray[np.float64] = field(default_factory=lambda: np.ones(3))
    repeats: bool = True  # Whether the image repeats beyond 0…1; otherwise its edge is clamped or mirrored
    cut_below: float = 0.0  # Texels of a smaller alpha, 0…1, are holes
    file: str = ""  # Name of the image file, without its folder


@dataclass(frozen=True, eq=False)
class Piece:
    """Triangles with one Coat."""

    name: str
    vertices: NDArray[np.float64]  # (V, 3) float64 z up
    faces: NDArray[np.int64]  # (F, 3) int64
    uv: NDArray[np.float64] | None  # (F, 3, 2) float64 u to the right and v down the image
    coat: Coat
    names: tuple[str, ...] = ()  # What the file calls its node, group, material and texture
    # (F, 3) float32 linear light of each face, on which `coat.factor` works, where the file states several colours
    tint: NDArray[np.float32] | None = None

    def compact(self) -> "Piece":
        """Return this piece without the vertices that no face uses."""
        used, faces = np.unique(self.faces, return_inverse=True)
        return replace(self, vertices=self.vertices[used], faces=faces.reshape(-1, 3))


class Beside:
    """The files that a mesh names: relative to the mesh, and inside a folder only. `used` are those that were read."""

    def __init__(self, path: Path, folder: Path) -> None:
        self.path, self.folder, self.used = path, folder, set[Path]()

    def find(self, name: str) -> Path:
        """Return the path of a file; glTF writes a blank as %20, and Windows a backslash between folders."""
        first = self.path.parent / name
        return next((p for p in (first, first.parent / unquote(first.name), self.path.parent / unquote(name),
                                 self.path.parent / name.replace("\\", "/")) if p.is_file()), first)  # fmt: skip

    def get(self, name: str) -> bytes:
        """Return the bytes of a file."""
        try:
            path = self.find(name)
            if not inside(path, self.folder):
                reason = "is outside the scene's folder; move the file into it"
            elif not path.is_file():
                reason = "does not exist; put it beside the mesh"
                if any(sign in name for sign in "/\\"):
                    reason += " and name it without its folder"
            else:
                self.used.add(path)
                return path.read_bytes()
        except (OSError, ValueError) as error:  # too long, with a NUL in it, or not permitted
            reason = f"cannot be read ({getattr(error, 'strerror', None) or error})"
        raise ThermorenderError(f"{self.path} names {shortened(repr(name))}, which {reason}")


def several(colours: NDArray[Any] | None) -> bool:
    """Return whether vertices or faces, (N, C), have different colours; None has not."""
    return colours is not None and len(colours) > 0 and bool(np.ptp(colours, axis=0).any())


def of_faces(linear: NDArray[Any], faces: NDArray[np.int64]) -> NDArray[np.float32]:
    """Return the mean light of each face, (F, 3) float32, of its vertices' linear light, (V, 3)."""
    return np.asarray(linear, np.float32)[faces].mean(axis=1)


def triangles(
    lengths: NDArray[np.int64], index: NDArray[np.int64], vertices: NDArray[np.float64], path: Path
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return (corner (T, 3), polygon (T,)) of polygons split into fans; `corner` counts the entries of `index`.

    `lengths` (P,) is the number of corners of each polygon, `index` (C,) the vertex of each corner.
    """
    if index.size and not (index.min() >= 0 and index.max() < len(vertices)):
        raise ThermorenderError(
            f"{path} cannot be read as a mesh (a face names a vertex that it does not have); export the mesh again"
        )
    start = np.cumsum(lengths) - lengths
    corners, polygons = [np.empty((0, 3), np.int64)], [np.empty(0, np.int64)]
    for count in np.unique(lengths[lengths > 2]):
        rows = np.flatnonzero(lengths == count)
        corner = start[rows, None] + np.arange(count)
        for _ in range(min(count, _MOST_STARTS)):
            folded = _folds(vertices[index[corner]])
            if not folded.any():
                break
            corner[folded] = np.roll(corner[folded], -1, axis=1)
        else:
            raise ThermorenderError(
                f"{path} has a concave polygon, which cannot be split into triangles from one corner; export the mesh "
                "with triangulated faces"
            )
        later = np.arange(1, count - 1)
        corners.append(corner[:, np.stack([0 * later, later, later + 1], axis=-1)].reshape(-1, 3))
        polygons.append(np.repeat(rows, count - 2))
    order = np.argsort(polygon := np.concatenate(polygons), kind="stable")
    return np.concatenate(corners)[order], polygon[order]


def _folds(corner: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether triangles from the first corner of polygons, (P, corners, 3), lie over each other, (P,)."""
    side = corner[:, 1:] - corner[:, :1]
    normal = np.cross(side[:, :-1], side[:, 1:])
    whole = normal.sum(axis=1, keepdims=True)
    folds: NDArray[np.bool_] = ((normal * whole).sum(axis=2) < -1e-6 * (whole**2).sum(axis=2)).any(axis=1)
    return folds
