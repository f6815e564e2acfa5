"""Meshes from files (OBJ, GLB, PLY, …) and primitives, as parts with map coordinates and a colour image."""

import io
import json
import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError, shortened
from thermorender.paths import inside
from thermorender.physics.geodesy import FARTHEST_M
from thermorender.physics.srgb import bytes_from_linear, linear_from_bytes
from thermorender.scene.surface import MOST_TEXELS

# Not archives, which trimesh reads too: they contain other files.
FORMATS = (".obj", ".glb", ".gltf", ".ply", ".stl", ".off")
# Image formats of Pillow that need no external program; None is an image that trimesh made.
_IMAGE_FORMATS = ("PNG", "JPEG", "MPO", "WEBP", "TIFF", "BMP", "GIF", "TGA", None)
_GLTF_REPEAT = 10497  # glTF 2.0, section 5.25: the default wrap mode of a texture
# A face of an OBJ with a corner of number 0.
_COUNTED_FROM_0 = re.compile(r"f(?:\s+\S+)*?\s+-?0+(?:[/\s]|$)")
_IMAGE = f"give a complete PNG or JPEG image of up to {MOST_TEXELS} pixels"


@dataclass(frozen=True)
class Part:
    """One mesh with one colour image.

    Attributes
    ----------
    name : str
    vertices : (V, 3) float64
    faces : (F, 3) int32
    uv : (F, 3, 2) float32
        0…1, u to the right and v down the image.
    colour : (h, w, 3) uint8
        sRGB.
    """

    name: str
    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]
    uv: NDArray[np.float32]
    colour: NDArray[np.uint8]


def load(path: Path | str, folder: Path | None = None) -> list[Part]:
    """Return the Parts of a mesh file in its own coordinates, z up; the y-up axes of glTF are rotated.

    Parameters
    ----------
    path : path
    folder : path, optional
        Material libraries, textures and buffers that the file names must be inside it. Default: the file's folder.

    Raises
    ------
    ThermorenderError
        An unreadable file, no triangle with an area, or a vertex more than 100 km from the origin; an image texture
        without map coordinates, repeated too often or with an unsupported glTF feature; a file that the mesh names but
        that is missing, broken, too large or outside `folder`.
    """
    path = Path(path)
    if path.suffix.lower() not in FORMATS:
        raise ThermorenderError(f"{path} is not in a supported format; give one of {', '.join(FORMATS)}")
    if not path.stat().st_size:
        raise ThermorenderError(f"{path} is empty; give an OBJ, GLB or PLY file")
    named = _Named(path, path.parent if folder is None else folder)
    try:
        # `_parts` checks for values that are not finite.
        with _largest_image(MOST_TEXELS), np.errstate(all="ignore"):
            return _parts(path, named)
    except Exception as error:  # trimesh raises many kinds for broken files
        if named.refusal or isinstance(error, ThermorenderError):
            raise (named.refusal or error) from None
        reason = f"{type(error).__name__}: {error}"
        if isinstance(error, ImportError) and error.name == "charset_normalizer":
            # trimesh imports it to guess the encoding of text that is not UTF-8.
            reason = "it is not UTF-8 text"
        raise ThermorenderError(f"{path} cannot be read as a mesh ({reason}); give an OBJ, GLB or PLY file") from None


class _Named:
    """trimesh's resolver of the files that a mesh names: relative to the mesh, and inside a folder only.

    trimesh continues without a refused file, so the first refusal is kept for the caller.
    """

    def __init__(self, path: Path, folder: Path) -> None:
        self.path, self.folder = path, folder
        self.file_name = path.name  # trimesh names the parts of an OBJ after it
        self.refusal: ThermorenderError | None = None
        self.found: list[tuple[str, bytes]] = []

    def get(self, name: str) -> bytes:
        """Return the bytes of a file."""
        path = self.path.parent / name.strip()
        try:
            # glTF writes a space as %20.
            path = path if path.is_file() else self.path.parent / unquote(name.strip())
            if not inside(path, self.folder):
                reason = "is outside the scene's folder; move the file into it"
            elif not path.is_file():
                reason = "does not exist; put it beside the mesh"
            else:
                data = path.read_bytes()
                if self.path.suffix.lower() == ".obj" and not self.found:
                    # The material library: trimesh ignores one that is not UTF-8 throughout, comments included.
                    data = data.decode(errors="replace").encode()
                self.found.append((name, data))
                return data
        except (OSError, ValueError) as error:  # too long, with a NUL in it, or not permitted
            reason = f"cannot be read ({getattr(error, 'strerror', None) or error})"
        self.refusal = self.refusal or ThermorenderError(f"{self.path} names {shortened(repr(name))}, which {reason}")
        raise self.refusal

    __getitem__ = get


@contextmanager
def _largest_image(pixels: int) -> Iterator[None]:
    """Let Pillow refuse larger images by their headers, without warnings for smaller ones."""
    from PIL import Image

    before = Image.MAX_IMAGE_PIXELS
    Image.MAX_IMAGE_PIXELS = pixels // 2  # Pillow warns above this number and refuses above twice as many
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            yield
    finally:
        Image.MAX_IMAGE_PIXELS = before


def _check_obj(path: Path) -> None:
    """Refuse an OBJ that trimesh would read wrongly."""
    try:
        lines = path.read_text(encoding="utf-8").replace("\\\n", " ").splitlines()
    except UnicodeDecodeError:
        # With an optional package trimesh guesses the encoding, and reads any bytes as a mesh without faces.
        raise ThermorenderError(
            f"{path} cannot be read as a mesh (it is not UTF-8 text); give an OBJ, GLB or PLY file, an OBJ in UTF-8"
        ) from None
    if lines[0].startswith("\ufeff"):
        raise ThermorenderError(
            f"{path} begins with a byte order mark, which hides its first line; save it as UTF-8 without one"
        )
    libraries = dict.fromkeys(line[7:].strip() for line in lines if line.startswith("mtllib "))
    if len(libraries) > 1:
        # trimesh reads only the first.
        raise ThermorenderError(
            f"{path} names the material libraries {shortened(', '.join(libraries))}; join them into one"
        )
    if any(_COUNTED_FROM_0.match(line) for line in lines):
        # trimesh would take it for the last vertex.
        raise ThermorenderError(
            f"{path} has a face with a corner of number 0; numbers begin with 1, so export the mesh again"
        )
    _refuse_hollow(path, lines)


def _parts(path: Path, named: _Named) -> list[Part]:
    import trimesh

    is_gltf, is_obj = path.suffix.lower() in (".glb", ".gltf"), path.suffix.lower() == ".obj"
    if is_obj:
        _check_obj(path)
    header = _gltf_header(path) if is_gltf else {}
    # With process=True, trimesh silently drops vertices that are not finite, and their faces.
    loaded = trimesh.load_scene(path, resolver=cast(Any, named), process=False)
    if named.refusal:
        raise named.refusal
    # trimesh silently ignores images that it cannot read.
    if is_gltf:
        _check_gltf_textures(path, header, loaded)
    else:
        # The first file an OBJ names is its material library.
        for name, data in named.found[is_obj:]:
            _check_image(data, f"{path}: the texture {name!r}")
    # glTF is y-up by its specification; other formats define no axis and are taken as z-up.
    turn = np.eye(4)
    if is_gltf:
        turn[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    parts = []
    for node in loaded.graph.nodes_geometry:
        transform, geometry_name = loaded.graph[node]
        geometry = loaded.geometry[geometry_name]
        if not isinstance(geometry, trimesh.Trimesh) or not len(geometry.faces):
            continue
        if not is_gltf:
            geometry.merge_vertices()
        matrix = turn @ np.asarray(transform, dtype=np.float64)
        vertices = np.array(geometry.vertices, dtype=np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
        faces = np.array(geometry.faces, dtype=np.int32)
        if np.linalg.det(matrix[:3, :3]) < 0.0:
            faces = faces[:, ::-1]
        if not (np.abs(vertices) <= FARTHEST_M).all():
            raise ThermorenderError(
                f"{path} has a vertex that is not finite or is more than {FARTHEST_M / 1e3:g} km from its origin; "
                "export the mesh in metres, with map coordinates shifted to an origin near it"
            )
        uv, colour = _texture(geometry, faces, path)
        parts.append(Part(f"{path.stem}:{node}", vertices, faces, uv, colour))
    if not any(_has_area(part) for part in parts):
        raise ThermorenderError(f"{path} holds no triangles of any area; give a mesh with faces")
    return parts


def _refuse_hollow(path: Path, lines: Sequence[str]) -> None:
    """Refuse concave polygons: trimesh cuts them into triangles from the first corner."""
    if not any(line.startswith("f ") and len(line.split()) > 4 for line in lines):
        return
    vertices: list[list[str]] = []
    polygons: dict[int, list[list[int]]] = {}
    for line in lines:
        if line.startswith("v "):
            vertices.append(line.split()[1:4])
        elif line.startswith("f ") and len(corners := line.split()[1:]) > 3:
            # Indices count from 1, or backwards from the last vertex so far.
            numbers = (int(corner.partition("/")[0]) for corner in corners)
            polygons.setdefault(len(corners), []).append([k - 1 if k > 0 else len(vertices) + k for k in numbers])
    for index in polygons.values():
        side = np.array(vertices, np.float64)[np.array(index)]
        side = side[:, 1:] - side[:, :1]
        normal = np.cross(side[:, :-1], side[:, 1:])
        whole = normal.sum(axis=1, keepdims=True)
        if ((normal * whole).sum(axis=2) < -1e-6 * (whole**2).sum(axis=2)).any():
            raise ThermorenderError(
                f"{path} has a concave polygon, which cannot be split from its first corner; export the mesh with "
                "triangulated faces"
            )


def _has_area(part: Part) -> bool:
    a, b, c = np.moveaxis(part.vertices[part.faces], 1, 0)
    return bool(np.cross(b - a, c - a).any())


def primitive(shape: str, size: Sequence[float]) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Return the vertices [m] and faces of a primitive with its base centred on the origin.

    Parameters
    ----------
    shape : {"disc", "box", "sphere"}
        A disc is flat with diameter size[0]; a box or ellipsoid has the extents `size` along x, y, z.
    size : (3,) floats
        [m].
    """
    import trimesh

    if shape == "disc":
        angle = np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False)
        rim = 0.5 * size[0] * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
        vertices = np.vstack([[[0.0, 0.0, 0.0]], rim])
        first = np.arange(1, 65)
        faces = np.stack([0 * first, first, np.roll(first, -1)], axis=-1)
        return vertices, faces.astype(np.int32)
    solid = trimesh.creation.box() if shape == "box" else trimesh.creation.icosphere(subdivisions=3, radius=0.5)
    vertices = (np.array(solid.vertices, dtype=np.float64) + [0.0, 0.0, 0.5]) * np.asarray(size)
    return vertices, np.array(solid.faces, dtype=np.int32)


def _texture(geometry: Any, faces: NDArray[np.int32], path: Path) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """(uv, colour image) of a trimesh geometry; without an image it is one texel of the mesh's colour."""
    visual = geometry.visual
    image = None
    material = getattr(visual, "material", None)
    if material is not None:
        image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    if image is None:
        return np.full((len(faces), 3, 2), 0.5, np.float32), _own_colour(visual, material, path).reshape(1, 1, 3)
    if visual.uv is None or len(visual.uv) != len(geometry.vertices):
        raise ThermorenderError(f"{path} has a texture but no map coordinates for it; export the mesh with UVs")
    uv = np.array(visual.uv, dtype=np.float32)[faces]
    uv[..., 1] = 1.0 - uv[..., 1]
    if not np.isfinite(uv).all():
        raise ThermorenderError(f"{path} has a map coordinate that is not finite; export the mesh again")
    colour = _pixels(image, path)
    if (factor := _linear_factor(material)).min() < 1.0:
        colour = bytes_from_linear(linear_from_bytes(colour) * factor)
    return _repeated(uv, colour, path)


def _linear_factor(material: Any) -> NDArray[np.float64]:
    """Factor of a glTF material on linear colour, (3,): 1 where it gives none (glTF 2.0, section 3.9.2)."""
    factor = getattr(material, "baseColorFactor", None)
    return np.ones(3) if factor is None else np.asarray(factor[:3] / 255.0)


def _own_colour(visual: Any, material: Any, path: Path) -> NDArray[np.uint8]:
    """The colour of a geometry without an image, (3,) sRGB: of its material, else of all its vertices."""
    if hasattr(material, "baseColorFactor"):
        return bytes_from_linear(_linear_factor(material))
    if material is not None:
        return np.array(material.main_color[:3], np.uint8)
    if visual.defined and np.ptp(visual.vertex_colors[:, :3], axis=0).any():
        raise ThermorenderError(f"{path} is coloured by vertex or face, which is not supported; bake it into a texture")
    return np.array(visual.main_color[:3], np.uint8)


def _repeated(
    uv: NDArray[np.float32], colour: NDArray[np.uint8], path: Path
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """(uv within 0…1, colour image), the image tiled as often as any face repeats it."""
    size = np.array(colour.shape[1::-1])
    # Up to half a texel outside shows only the texel at the edge.
    slack = 0.5 / size
    if ((uv >= -slack) & (uv <= 1.0 + slack)).all():
        return np.clip(uv, 0.0, 1.0), colour
    uv = uv - np.floor(uv.min(axis=1, keepdims=True) + slack)
    times = np.maximum(np.ceil(uv.max(axis=(0, 1)) - slack), 1.0)
    if not (size * times).prod() <= MOST_TEXELS:
        raise ThermorenderError(
            f"{path} has a face over {times[0]:.0f}×{times[1]:.0f} repeats of its texture of {size[0]}×{size[1]} "
            f"texels, more than {MOST_TEXELS} in all; bake the texture, or cut the faces"
        )
    columns, rows = times.astype(int)
    return np.clip(uv / times, 0.0, 1.0).astype(np.float32), np.tile(colour, (rows, columns, 1))


def _pixels(image: Any, name: object) -> NDArray[np.uint8]:
    try:
        if image.format not in _IMAGE_FORMATS:
            raise ValueError(f"it is {image.format}")
        if image.mode[0] in "IF":
            raise ValueError("it has a single band of more than 8 bits")
        return np.array(image.convert("RGB"), dtype=np.uint8)
    except Exception as error:  # Pillow raises many kinds for a broken file
        raise ThermorenderError(f"{name}: the texture cannot be read ({error}); {_IMAGE}") from None


def _check_image(data: bytes, name: str) -> None:
    """Refuse data without the header of an image."""
    from PIL import Image, UnidentifiedImageError

    try:
        Image.open(io.BytesIO(data))
    except Exception as error:  # of Pillow, as above
        reason = "it is not an image" if isinstance(error, UnidentifiedImageError) else error
        raise ThermorenderError(f"{name} cannot be read ({reason}); {_IMAGE}") from None


def _gltf_header(path: Path) -> Any:
    data = path.read_bytes()
    if path.suffix.lower() == ".glb":
        # A header of 12 bytes, then length, type and data of the JSON chunk.
        data = data[20 : 20 + int.from_bytes(data[12:16], "little")]
    return json.loads(data)


def _check_gltf_textures(path: Path, header: Any, loaded: Any) -> None:
    """Refuse a glTF with colour images that trimesh could not read or would map differently from the file."""
    named: set[Any] = set()
    plain: set[Any] = set()
    once: set[Any] = set()
    samplers = header.get("samplers", ())
    for material in header.get("materials", ()):
        coat = material.get("pbrMetallicRoughness", {})
        texture, name = coat.get("baseColorTexture"), material.get("name")
        (plain if texture is None else named).add(name)
        if texture is None:
            continue
        unread = {
            "the second map coordinates": texture.get("texCoord", 0),
            "KHR_texture_transform": "KHR_texture_transform" in texture.get("extensions", {}),
        }
        if unsupported := [what for what, used in unread.items() if used]:
            raise ThermorenderError(
                f"{path}: the texture of material {shortened(repr(name))} uses {unsupported[0]}, which is not "
                "supported; bake it into the image and its first map coordinates"
            )
        sampler = header.get("textures", ())[texture["index"]].get("sampler")
        wraps = {} if sampler is None else samplers[sampler]
        if any(wraps.get(key, _GLTF_REPEAT) != _GLTF_REPEAT for key in ("wrapS", "wrapT")):
            once.add(name)
    for geometry in loaded.geometry.values():
        # Lines and points have no material.
        material = getattr(getattr(geometry, "visual", None), "material", None)
        name, image = getattr(material, "name", None), getattr(material, "baseColorTexture", None)
        if image is None and name in named - plain:
            raise ThermorenderError(f"{path}: the texture of material {name!r} cannot be read; {_IMAGE}")
        if image is not None and name in once and geometry.visual.uv is not None:
            # As in `_repeated`, half a texel outside shows the texel at the edge.
            if (np.abs(geometry.visual.uv - 0.5) > 0.5 + 0.5 / np.array(image.size)).any():
                raise ThermorenderError(
                    f"{path}: the texture of material {shortened(repr(name))} is clamped or mirrored at its edge, "
                    "which is not supported; bake the texture with map coordinates in 0…1, or let it repeat"
                )
