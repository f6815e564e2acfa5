"""Meshes from files (OBJ, GLB, PLY, …) and primitives, as parts with map coordinates and a colour image.

Each texture or material becomes one part, and each part a surface of the scene with its own texels.
"""

import io
import itertools
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError, shortened
from thermorender.formats import largest_image, refuse_overstated
from thermorender.physics.geodesy import FARTHEST_M
from thermorender.physics.srgb import bytes_from_linear, linear_from_bytes
from thermorender.scene.meshes import gltf, obj, ply
from thermorender.scene.meshes.axes import AS_STORED, Axes
from thermorender.scene.meshes.mesh_pieces import GREY, Beside, Coat, Piece, of_faces, several
from thermorender.scene.surface import MOST_TEXELS

# Not archives, which trimesh reads too: they contain other files.
FORMATS = (".obj", ".glb", ".gltf", ".ply", ".stl", ".off")
# Image formats of Pillow that need no external program.
_IMAGE_FORMATS = ("PNG", "JPEG", "MPO", "WEBP", "TIFF", "BMP", "GIF", "TGA")
# Of a box whose corners are ordered by x, then y, then z; counter-clockwise from outside.
_BOX_FACES = (
    (1, 3, 0), (4, 1, 0), (0, 3, 2), (2, 4, 0), (1, 7, 3), (5, 1, 4), (5, 7, 1), (3, 7, 2), (6, 4, 2), (2, 7, 6),
    (6, 5, 4), (7, 5, 6),
)  # fmt: skip
_IMAGE = f"give a complete PNG or JPEG image of up to {MOST_TEXELS} pixels"


@dataclass(frozen=True)
class Part:
    """One mesh with one colour image."""

    name: str
    vertices: NDArray[np.float64]  # (V, 3) float64
    faces: NDArray[np.int32]  # (F, 3) int32
    uv: NDArray[np.float32]  # (F, 3, 2) float32 0…1, u to the right and v down the image
    colour: NDArray[np.uint8]  # (h, w, 3) uint8 sRGB
    # What the file calls each of the pieces joined here: node, group, material, texture
    names: tuple[tuple[str, ...], ...] = ()
    # (2,) tuple rows and columns of the texture, which `colour` repeats where faces need that; None without a texture
    texture: tuple[int, int] | None = None


def load(
    path: Path | str, folder: Path | None = None, named: Collection[str] = (), axes: Axes = AS_STORED
) -> list[Part]:
    """Return the Parts of a mesh file in metres, z up, faces counter-clockwise seen from outside.

    Files that it names must be inside `folder`, by default its own. `named` are names that keep pieces apart.
    """
    path = Path(path)
    if path.suffix.lower() not in FORMATS:
        raise ThermorenderError(f"{path} is not in a supported format; give one of {', '.join(FORMATS)}")
    if not path.stat().st_size:
        raise ThermorenderError(f"{path} is empty; give an OBJ, GLB or PLY file")
    try:
        # `_parts` checks for values that are not finite.
        with largest_image(MOST_TEXELS), np.errstate(all="ignore"):
            beside = Beside(path, folder or path.parent)
            pieces = _pieces(path, beside, named)
            if not set(named) <= {name for piece in pieces for name in (piece.name, *piece.names)}:
                # Whoever refuses the name that is not there can list all that are.
                pieces = _pieces(path, beside, None)
            return _parts(path, [_turned(piece, path, axes) for piece in pieces], named)
    except ThermorenderError:
        raise
    except Exception as error:  # a broken file breaks its reader in many ways
        reason = shortened(" ".join(f"{type(error).__name__}: {error}".split()))
        raise ThermorenderError(f"{path} cannot be read as a mesh ({reason}); give an OBJ, GLB or PLY file") from None


def files_of(path: Path, folder: Path) -> set[Path]:
    """Return the files that a mesh in a scene's folder is read from: itself, its libraries and its textures."""
    beside = Beside(path, folder)
    _pieces(path, beside, ())
    return {path, *beside.used}


def _pieces(path: Path, beside: Beside, named: Collection[str] | None) -> list[Piece]:
    kind = path.suffix.lower()
    if kind == ".obj":
        return obj.read(path, beside, named)
    reader = {".glb": gltf.read, ".gltf": gltf.read, ".ply": ply.read}.get(kind)
    return _plain(path) if reader is None else reader(path, beside)


def up_of(path: Path) -> str:
    """Return the axis that points up in a format: y in glTF; z where it does not say so."""
    return "y" if path.suffix.lower() in (".glb", ".gltf") else "z"


def _turned(piece: Piece, path: Path, axes: Axes) -> Piece:
    """A piece in metres, z up, with its faces counter-clockwise seen from outside."""
    piece = replace(piece, vertices=axes.turned(piece.vertices, up_of(path)))
    if not axes.flip:
        return piece
    return replace(piece, faces=piece.faces[:, ::-1], uv=None if piece.uv is None else piece.uv[:, ::-1])


def _plain(path: Path) -> list[Piece]:
    """The Pieces of a file without textures, such as an STL."""
    import trimesh

    # With process=True, trimesh silently drops vertices that are not finite, and their faces.
    geometry: Any = trimesh.load_mesh(path, process=False)
    vertices, faces = np.array(geometry.vertices, np.float64), np.array(geometry.faces, np.int64)
    visual, colour, tint = geometry.visual, GREY, None
    if visual.defined:
        by_face = visual.kind == "face"
        found = np.array(visual.face_colors if by_face else visual.vertex_colors, np.uint8)[:, :3]
        colour = found[0]
        if several(found):
            linear = linear_from_bytes(found)
            colour, tint = np.full(3, 255, np.uint8), linear if by_face else of_faces(linear, faces)
    return [Piece(f"{path.stem}:mesh", vertices, faces, None, Coat(colour=colour), ("mesh",), tint)]


def _joined(pieces: Sequence[Piece], named: Collection[str]) -> list[tuple[Piece, tuple[tuple[str, ...], ...]]]:
    """Return the pieces and their names; pieces of one image are joined unless `named` separates them."""
    groups: dict[Any, list[Piece]] = {}
    for number, piece in enumerate(pieces):
        coat = piece.coat
        shared = coat.image is not None and piece.uv is not None
        own = tuple(sorted(set(named) & {piece.name, *piece.names}))
        key = (coat.image, coat.factor.tobytes(), coat.repeats, coat.cut_below, own) if shared else number
        groups.setdefault(key, []).append(piece)
    joined = []
    for group in groups.values():
        first = np.cumsum([0, *(len(piece.vertices) for piece in group)])
        faces = np.concatenate([piece.faces + start for piece, start in zip(group, first, strict=False)])
        uv = None if group[0].uv is None else np.concatenate([piece.uv for piece in group if piece.uv is not None])
        vertices = np.concatenate([piece.vertices for piece in group])
        names = tuple(tuple(dict.fromkeys(filter(None, (piece.name, *piece.names)))) for piece in group)
        joined.append((replace(group[0], vertices=vertices, faces=faces, uv=uv), names))
    return joined


def one_texel_each(faces: int) -> tuple[NDArray[np.float32], tuple[int, int]]:
    """Return (map coordinates (F, 3, 2), (rows, columns)) that give each face a texel of its own."""
    columns = int(np.ceil(np.sqrt(faces)))
    rows = -(-faces // columns)
    row, column = np.divmod(np.arange(faces), columns)
    middle = np.stack([(column + 0.5) / columns, (row + 0.5) / rows], axis=-1).astype(np.float32)
    return np.repeat(middle[:, None], 3, axis=1), (rows, columns)


def _parts(path: Path, pieces: Sequence[Piece], named: Collection[str]) -> list[Part]:
    parts = []
    for piece, names in _joined(pieces, named):
        if not (np.abs(piece.vertices) <= FARTHEST_M).all():
            raise ThermorenderError(
                f"{path} has a vertex that is not finite or is more than {FARTHEST_M / 1e3:g} km from its origin; "
                "export the mesh with map coordinates shifted to an origin near it, or write scale_to_m, the metres in "
                "its unit"
            )
        coat, faces, texture = piece.coat, piece.faces.astype(np.int32), None
        if piece.tint is not None and len(faces):
            uv, size = one_texel_each(len(faces))
            light = np.full((size[0] * size[1], 3), piece.tint.mean(axis=0), np.float32)
            light[: len(faces)] = piece.tint
            colour = bytes_from_linear(light * coat.factor).reshape(*size, 3)
        elif coat.image is None:
            uv, colour = np.full((len(faces), 3, 2), 0.5, np.float32), _tinted(coat.colour.reshape(1, 1, 3), coat)
        else:
            if piece.uv is None:
                raise ThermorenderError(f"{path} has a texture but no map coordinates for it; export the mesh with UVs")
            if not np.isfinite(piece.uv).all():
                raise ThermorenderError(f"{path} has a map coordinate that is not finite; export the mesh again")
            pixels = _pixels(coat, path)
            texture = pixels.shape[0], pixels.shape[1]
            uv, colour = _repeated(piece.uv, pixels, coat, path)
        parts.append(Part(piece.name, piece.vertices, faces, uv, colour, names, texture))
    if not any(_has_area(part) for part in parts):
        raise ThermorenderError(f"{path} holds no triangles of any area; give a mesh with faces")
    return parts


def _has_area(part: Part) -> bool:
    a, b, c = np.moveaxis(part.vertices[part.faces], 1, 0)
    return bool(np.cross(b - a, c - a).any())


def primitive(shape: str, size: Sequence[float]) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Return the vertices [m] and faces of a primitive with its base centred on the origin.

    A disc has the diameter size[0]; a box or ellipsoid ("sphere") has the extents `size` along x, y, z [m].
    """
    if shape == "disc":
        angle = np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False)
        rim = 0.5 * size[0] * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
        vertices = np.vstack([[[0.0, 0.0, 0.0]], rim])
        first = np.arange(1, 65)
        faces = np.stack([0 * first, first, np.roll(first, -1)], axis=-1)
        return vertices, faces.astype(np.int32)
    if shape == "box":
        corners, faces = np.array(list(itertools.product((-0.5, 0.5), repeat=3))), np.array(_BOX_FACES)
    else:
        import trimesh  # which takes 0.3 s to load

        solid = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
        corners, faces = np.array(solid.vertices, dtype=np.float64), np.array(solid.faces)
    return (corners + [0.0, 0.0, 0.5]) * np.asarray(size), faces.astype(np.int32)


def _repeated(
    uv: NDArray[np.float64], colour: NDArray[np.uint8], coat: Coat, path: Path
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """(uv within 0…1, colour image), the image tiled as often as any face repeats it."""
    size = np.array(colour.shape[1::-1])
    # Up to half a texel outside shows only the texel at the edge.
    slack = 0.5 / size
    if ((uv >= -slack) & (uv <= 1.0 + slack)).all():
        return np.clip(uv, 0.0, 1.0).astype(np.float32), colour
    if not coat.repeats:
        raise ThermorenderError(
            f"{path}: the {coat.what} is clamped or mirrored at its edge, which is not supported; bake the texture "
            "with map coordinates in 0…1, or let it repeat"
        )
    uv = uv - np.floor(uv.min(axis=1, keepdims=True) + slack)
    times = np.maximum(np.ceil(uv.max(axis=(0, 1)) - slack), 1.0)
    if not (size * times).prod() <= MOST_TEXELS:
        raise ThermorenderError(
            f"{path} has a face over {times[0]:.0f}×{times[1]:.0f} repeats of its texture of {size[0]}×{size[1]} "
            f"texels, more than {MOST_TEXELS} in all; bake the texture, or cut the faces"
        )
    columns, rows = times.astype(int)
    return np.clip(uv / times, 0.0, 1.0).astype(np.float32), np.tile(colour, (rows, columns, 1))


def _pixels(coat: Coat, path: Path) -> NDArray[np.uint8]:
    """The image of a Coat times its factor, (h, w, 3) sRGB."""
    from PIL import Image, UnidentifiedImageError

    assert coat.image is not None
    try:
        image = Image.open(io.BytesIO(coat.image))
        if image.format not in _IMAGE_FORMATS:
            raise ValueError(f"it is {image.format}")
        refuse_overstated(image, len(coat.image))
        if image.mode[0] in "IF":
            raise ValueError("it has a single band of more than 8 bits")
        lowest = 255
        if coat.cut_below and image.has_transparency_data:
            lowest = int(np.array(image.convert("RGBA").getchannel("A")).min())
        colour = np.array(image.convert("RGB"), dtype=np.uint8)
    except Exception as error:  # Pillow raises many kinds for a broken file
        reason = "it is not an image" if isinstance(error, UnidentifiedImageError) else error
        raise ThermorenderError(f"{path}: the {coat.what} cannot be read ({reason}); {_IMAGE}") from None
    if lowest < 255 * coat.cut_below:
        raise ThermorenderError(
            f"{path}: the {coat.what} has transparent texels (alphaMode), which are not supported; cut the holes into "
            "the mesh, or set the material's alphaMode to OPAQUE"
        )
    return _tinted(colour, coat)


def _tinted(colour: NDArray[np.uint8], coat: Coat) -> NDArray[np.uint8]:
    return colour if (coat.factor == 1.0).all() else bytes_from_linear(linear_from_bytes(colour) * coat.factor)
