"""Textures of a mesh's surfaces: what the file calls them, which texels faces use, and rasters in their pixels."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError, shortened
from thermorender.scene.meshes.mesh import one_texel_each
from thermorender.scene.spec import SurfaceSpec
from thermorender.scene.surface import Surface
from thermorender.schema import did_you_mean

# Fractional bits of the corners that OpenCV fills.
_BITS = 4
# End of a message on a name that a mesh does not have.
_OF_EDITS = "; edits may name an object or group of an OBJ once a [[surface]] of scene.toml does"


@dataclass(frozen=True, eq=False)
class Texture:
    """What a mesh's file says of one surface."""

    # What the file calls each of its pieces: node, group, material, texture
    names: tuple[tuple[str, ...], ...] = ()
    # (2,) tuple rows and columns of the texture, which the texels repeat where faces need that; None without a
    # texture
    size: tuple[int, int] | None = None
    classes: NDArray[np.uint8] | None = None  # (h, w) uint8 class numbers of the texels, 0 for no data
    file: Path | None = None  # The raster of these classes in the pixels of the texture; None for one on a map
    # (h, w) bool texels that a map with these numbers shows; None for numbers in the pixels of the texture
    shown: NDArray[np.bool_] | None = None

    @property
    def known(self) -> frozenset[str]:
        """All names of its pieces."""
        return frozenset(name for piece in self.names for name in piece)


def named(
    textures: Sequence[Texture], names: Sequence[str], where: str, what: str = "surface", more: str = _OF_EDITS
) -> list[int | None]:
    """Return the place in `names` of the one that names each of a mesh's surfaces; None where none does.

    `what` and `more` begin and end the message on a name that the mesh does not have.
    """
    known = dict.fromkeys(name for texture in textures for piece in texture.names for name in piece)
    found: list[int | None] = [None] * len(textures)
    for number, name in enumerate(names):
        if name not in known:
            raise ThermorenderError(
                f"{where}: {what} {shortened(repr(name))} is not a node, group, material or texture of the mesh; "
                f"{did_you_mean(name, known)}it has {shortened(', '.join(known), 300) or 'none'}{more}"
            )
        for k, texture in enumerate(textures):
            has = [name in piece for piece in texture.names]
            if not any(has):
                continue
            if not all(has):
                raise ThermorenderError(
                    f"{where}: {what} {name!r} shares the texels of its texture with others; name it in a [[surface]] "
                    "of scene.toml, which gives it its own texels"
                )
            if (other := found[k]) is not None:
                raise ThermorenderError(
                    f"{where}: {what} {names[other]!r} and {what} {name!r} are the same triangles of "
                    f"{texture.names[0][0]!r}; leave one of the two out"
                )
            found[k] = number
    return found


def stating(
    textures: Sequence[Texture], surfaces: Sequence[SurfaceSpec], keys: Sequence[str], where: str
) -> list[SurfaceSpec | None]:
    """Return the [[surface]] that states one of `keys` for each of a mesh's surfaces; None where none does."""
    given = [one for one in surfaces if any(getattr(one, key) is not None for key in keys)]
    found = named(textures, [one.name for one in given], where)
    return [None if number is None else given[number] for number in found]


def onto_texels(values: NDArray[Any], path: Path, surface: Surface, texture: Texture) -> NDArray[Any]:
    """Return a raster in the pixels of a surface's texture on its texels, (h, w); row 0 is the image's top."""
    if texture.size is None:
        raise ThermorenderError(
            f"{path} is a raster for surface {surface.name!r}, which has no texture that it could lie on; give that "
            "surface one material and one temperature"
        )
    if values.shape != texture.size:
        raise ThermorenderError(
            f"{path} has {values.shape[1]}×{values.shape[0]} pixels, and the texture of surface {surface.name!r} has "
            f"{texture.size[1]}×{texture.size[0]}; give a raster in the pixels of that texture"
        )
    rows, columns = surface.flags.shape
    return np.tile(values, (rows // texture.size[0], columns // texture.size[1]))


def separate(surface: Surface) -> bool:
    """Return whether each face shows a single texel, so that neighbouring texels are not neighbours in space."""
    return bool((np.ptp(surface.uv, axis=1) == 0.0).all())


def colour_of_faces(surface: Surface) -> NDArray[np.uint8]:
    """Return the colour of the texel at the middle of each face, (F, 3) sRGB."""
    rows, columns = surface.colour.shape[:2]
    column, row = (surface.uv.mean(axis=1, dtype=np.float64) * (columns, rows)).astype(np.int64).T
    found: NDArray[np.uint8] = surface.colour[np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)]
    return found


def with_texel_per_face(surface: Surface) -> Surface:
    """Return a surface whose faces have a texel each, whatever texture they share; materials are placeholders."""
    uv, shape = one_texel_each(len(surface.faces))
    made = replace(
        surface, uv=uv, colour=np.resize(colour_of_faces(surface), (*shape, 3)),
        material=np.full(shape, surface.material.flat[0]), temperature=np.full(shape, surface.temperature.flat[0]),
        flags=np.full(shape, surface.flags.flat[0]),
    )  # fmt: skip
    return replace(made, texel_m=texel_size_m(made))


def used_texels(surface: Surface) -> NDArray[np.bool_]:
    """Return which texels of a surface a face touches, (h, w) bool."""
    import cv2

    rows, columns = surface.flags.shape
    found = np.zeros((rows, columns), np.uint8)
    # OpenCV counts from the middle of the first pixel.
    corner = np.rint((surface.uv.astype(np.float64) * (columns, rows) - 0.5) * (1 << _BITS)).astype(np.int32)
    for face in corner:
        cv2.fillConvexPoly(found, face, 1, cv2.LINE_8, _BITS)
    return found > 0


def areas(surface: Surface) -> NDArray[np.float64]:
    """Return the area of each face, (F,) [m²]."""
    a, b, c = np.moveaxis(surface.vertices[surface.faces], 1, 0)
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=-1)


def texel_size_m(surface: Surface) -> float:
    """Return the texel side of a mesh [m]: root of the area of its faces over that of the texels they show.

    Where no face covers an area of the map, the faces share the texels evenly.
    """
    rows, columns = surface.flags.shape
    a, b, c = np.moveaxis(surface.uv.astype(np.float64) * (columns, rows), 1, 0)
    shown = 0.5 * np.abs(np.linalg.det(np.stack([b - a, c - a], axis=1)))
    area = areas(surface)
    if shown.sum() < 1e-6:
        return float(np.sqrt(area.sum() / min(len(area), rows * columns)))
    return float(np.sqrt(area[shown > 0.0].sum() / shown.sum()))
