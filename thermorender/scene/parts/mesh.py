"""Meshes from files (OBJ, GLB, PLY, …) and primitives, as parts with map coordinates and a colour image."""

import io
import json
import re
import warnings
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import unquote

import numpy as np

from thermorender.errors import ThermorenderError, shortened
from thermorender.paths import inside
from thermorender.physics.geodesy import FARTHEST_M
from thermorender.physics.srgb import bytes_from_linear, linear_from_bytes
from thermorender.scene.surface import MOST_TEXELS

# Archives, which trimesh would read too, bring files of their own.
FORMATS = (".obj", ".glb", ".gltf", ".ply", ".stl", ".off")
# Kinds of Pillow's images; it would run a program of the machine for some others. None is made by trimesh.
_IMAGE_FORMATS = ("PNG", "JPEG", "MPO", "WEBP", "TIFF", "BMP", "GIF", "TGA", None)
_GLTF_REPEAT = 10497  # glTF 2.0, section 5.25: what a texture does beyond its edge, unless told otherwise
# A face of an OBJ whose first corner, or another, has the number 0.
_COUNTED_FROM_0 = re.compile(r"f(?:\s+\S+)*?\s+-?0+(?:[/\s]|$)")
_IMAGE = f"give a whole PNG or JPEG image of up to {MOST_TEXELS} pixels"


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
    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray
    colour: np.ndarray


def load(path, folder=None):
    """Return the Parts of a mesh file, in the file's own coordinates (z up for OBJ and PLY; GLB's y-up is turned).

    Parameters
    ----------
    path : path
    folder : path, optional
        What the file names must lie in it: material libraries, textures, buffers. Default: the file's own.

    Raises
    ------
    ThermorenderError
        A file trimesh cannot read, one without triangles of any area, vertices 100 km from the origin, an image texture
        without map coordinates, repeated too often or laid in a way of glTF that is not read, or a file that is named
        but missing, broken, too large or elsewhere.
    """
    path = Path(path)
    if path.suffix.lower() not in FORMATS:
        raise ThermorenderError(f"{path} is of no form that is read; give one of {', '.join(FORMATS)}")
    if not path.stat().st_size:
        raise ThermorenderError(f"{path} is empty; give an OBJ, GLB or PLY file")
    named = _Named(path, path.parent if folder is None else folder)
    try:
        # What is not finite is looked for at the end.
        with _largest_image(MOST_TEXELS), np.errstate(all="ignore"):
            return _parts(path, named)
    except Exception as error:  # trimesh raises many kinds for broken files
        if named.refusal or isinstance(error, ThermorenderError):
            raise (named.refusal or error) from None
        reason = f"{type(error).__name__}: {error}"
        if isinstance(error, ImportError) and error.name == "charset_normalizer":
            # What trimesh asks for to guess the encoding of a text that is not UTF-8.
            reason = "it is not text in UTF-8"
        raise ThermorenderError(f"{path} cannot be read as a mesh ({reason}); give an OBJ, GLB or PLY file") from None


class _Named:
    """The files a mesh names, as trimesh asks for them: relative to the mesh, and within a folder only.

    trimesh goes on without a file it cannot have, so that the first refusal is kept for who called it.
    """

    def __init__(self, path, folder):
        self.path, self.folder = path, folder
        self.file_name = path.name  # trimesh names the parts of an OBJ after it
        self.refusal, self.found = None, []

    def get(self, name):
        """Return the bytes of a file."""
        path = self.path.parent / name.strip()
        try:
            # glTF writes a space as %20.
            path = path if path.is_file() else self.path.parent / unquote(name.strip())
            if not inside(path, self.folder):
                reason = "leads out of the scene's folder; put the file into it"
            elif not path.is_file():
                reason = "does not exist; put it beside the mesh"
            else:
                data = path.read_bytes()
                if self.path.suffix.lower() == ".obj" and not self.found:
                    # The material library: trimesh goes without one that is not all UTF-8, a comment in it included.
                    data = data.decode(errors="replace").encode()
                self.found.append((name, data))
                return data
        except (OSError, ValueError) as error:  # too long, with a NUL in it, or closed to the user
            reason = f"cannot be read ({getattr(error, 'strerror', None) or error})"
        self.refusal = self.refusal or ThermorenderError(f"{self.path} names {shortened(repr(name))}, which {reason}")
        raise self.refusal

    __getitem__ = get


@contextmanager
def _largest_image(pixels):
    """Have Pillow refuse larger images from their heads, and warn of no others."""
    from PIL import Image

    before = Image.MAX_IMAGE_PIXELS
    Image.MAX_IMAGE_PIXELS = pixels // 2  # from which on it warns; from twice as many on it refuses
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            yield
    finally:
        Image.MAX_IMAGE_PIXELS = before


def _parts(path, named):
    import trimesh

    is_gltf = path.suffix.lower() in (".glb", ".gltf")
    header = _gltf_header(path) if is_gltf else None
    if path.suffix.lower() == ".obj":
        lines = path.read_text(encoding="utf-8", errors="replace").replace("\\\n", " ").splitlines()
        if lines[0].startswith("\ufeff"):
            raise ThermorenderError(
                f"{path} begins with a byte order mark, which hides its first line; save it as UTF-8 without one"
            )
        libraries = dict.fromkeys(line[7:].strip() for line in lines if line.startswith("mtllib "))
        if len(libraries) > 1:
            # trimesh reads the first.
            raise ThermorenderError(
                f"{path} names the material libraries {shortened(', '.join(libraries))}; join them into one"
            )
        if any(_COUNTED_FROM_0.match(line) for line in lines):
            # It would be the last vertex.
            raise ThermorenderError(
                f"{path} has a face with a corner of number 0; numbers begin with 1, so export the mesh again"
            )
        _refuse_hollow(path, lines)
    # Processed, an OBJ or PLY would lose what is not finite, and the faces on it, in silence.
    loaded = trimesh.load_scene(path, resolver=named, process=False)
    if named.refusal:
        raise named.refusal
    # trimesh leaves out images it cannot read, in silence.
    if is_gltf:
        _check_gltf_textures(path, header, loaded)
    else:
        # The first file an OBJ names is its material library.
        for name, data in named.found[path.suffix.lower() == ".obj" :]:
            _check_image(data, f"{path}: the texture {name!r}")
    # glTF is y-up by its specification; the other formats carry no rule and are taken as z-up.
    turn = np.eye(4)
    if is_gltf:
        turn[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    parts = []
    for node in loaded.graph.nodes_geometry:
        transform, name = loaded.graph[node]
        geometry = loaded.geometry[name]
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
                f"{path} has a vertex that is not finite or lies more than {FARTHEST_M / 1e3:g} km from its origin; "
                "export the mesh again, in metres, and if in coordinates of a map, with an origin beside it"
            )
        uv, colour = _texture(geometry, faces, path)
        parts.append(Part(f"{path.stem}:{node}", vertices, faces, uv, colour))
    if not any(_has_area(part) for part in parts):
        raise ThermorenderError(f"{path} holds no triangles of any area; give a mesh with faces")
    return parts


def _refuse_hollow(path, lines):
    """Refuse an OBJ's polygon that trimesh, which cuts it into triangles from its first corner, would fill wrongly."""
    if not any(line.startswith("f ") and len(line.split()) > 4 for line in lines):
        return
    vertices, polygons = [], {}
    for line in lines:
        if line.startswith("v "):
            vertices.append(line.split()[1:4])
        elif line.startswith("f ") and len(corners := line.split()[1:]) > 3:
            # Counted from 1, or backwards from the last one so far.
            index = (int(corner.partition("/")[0]) for corner in corners)
            polygons.setdefault(len(corners), []).append([k - 1 if k > 0 else len(vertices) + k for k in index])
    for index in polygons.values():
        side = np.array(vertices, np.float64)[index]
        side = side[:, 1:] - side[:, :1]
        normal = np.cross(side[:, :-1], side[:, 1:])
        whole = normal.sum(axis=1, keepdims=True)
        if ((normal * whole).sum(axis=2) < -1e-6 * (whole**2).sum(axis=2)).any():
            raise ThermorenderError(
                f"{path} has a polygon that is hollow, which triangles from its first corner would fill; export the "
                "mesh with its faces triangulated"
            )


def _has_area(part):
    a, b, c = np.moveaxis(part.vertices[part.faces], 1, 0)
    return np.cross(b - a, c - a).any()


def primitive(shape, size):
    """Return the vertices and faces of a unit-less primitive scaled to `size`, its base centred on the origin.

    Parameters
    ----------
    shape : {"disc", "box", "sphere"}
        A disc lies flat with diameter size[0]; a box and an ellipsoid fill size = full extents along x, y, z.
    size : (3,) floats
        Full extents [m].
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


def _texture(geometry, faces, path):
    """(uv, colour image) of a trimesh geometry; a mesh without an image gets one texel of its own colour."""
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


def _linear_factor(material):
    """What a material of glTF multiplies linear light by, (3,): white where it gives nothing (2.0, section 3.9.2)."""
    factor = getattr(material, "baseColorFactor", None)
    return np.ones(3) if factor is None else factor[:3] / 255.0


def _own_colour(visual, material, path):
    """The colour of a geometry without an image, (3,) uint8 sRGB: its material's, else that of all its vertices."""
    if hasattr(material, "baseColorFactor"):
        return bytes_from_linear(_linear_factor(material))
    if material is not None:
        return np.array(material.main_color[:3], np.uint8)
    if visual.defined and np.ptp(visual.vertex_colors[:, :3], axis=0).any():
        raise ThermorenderError(f"{path} is coloured by vertex or face, which is not read; bake that into a texture")
    return np.array(visual.main_color[:3], np.uint8)


def _repeated(uv, colour, path):
    """(uv within 0…1, colour image): beyond, the image goes on from its other side, as often as any face spans it."""
    size = np.array(colour.shape[1::-1])
    # Up to half a texel outside nothing but the texel at the edge is shown.
    slack = 0.5 / size
    if ((uv >= -slack) & (uv <= 1.0 + slack)).all():
        return np.clip(uv, 0.0, 1.0), colour
    uv = uv - np.floor(uv.min(axis=1, keepdims=True) + slack)
    times = np.maximum(np.ceil(uv.max(axis=(0, 1)) - slack), 1.0)
    if not (size * times).prod() <= MOST_TEXELS:
        raise ThermorenderError(
            f"{path} has a face over {times[0]:.0f}×{times[1]:.0f} repeats of its texture, {size[0]}×{size[1]}, where "
            f"{MOST_TEXELS} texels are the most; bake the texture, or cut the faces"
        )
    columns, rows = times.astype(int)
    return np.clip(uv / times, 0.0, 1.0).astype(np.float32), np.tile(colour, (rows, columns, 1))


def _pixels(image, name):
    try:
        if image.format not in _IMAGE_FORMATS:
            raise ValueError(f"it is {image.format}")
        if image.mode[0] in "IF":
            raise ValueError("it has a single band of more than 8 bits")
        return np.array(image.convert("RGB"), dtype=np.uint8)
    except Exception as error:  # Pillow raises many kinds for a broken file
        raise ThermorenderError(f"{name}: the texture cannot be read ({error}); {_IMAGE}") from None


def _check_image(data, name):
    """Refuse what has not even the head of an image."""
    from PIL import Image, UnidentifiedImageError

    try:
        Image.open(io.BytesIO(data))
    except Exception as error:  # of Pillow, as above
        if isinstance(error, UnidentifiedImageError):
            error = "it is no image"
        raise ThermorenderError(f"{name} cannot be read ({error}); {_IMAGE}") from None


def _gltf_header(path):
    data = path.read_bytes()
    if path.suffix.lower() == ".glb":
        # Header of 12 bytes, then the chunk of JSON behind its length and kind.
        data = data[20 : 20 + int.from_bytes(data[12:16], "little")]
    return json.loads(data)


def _check_gltf_textures(path, header, loaded):
    """Refuse a glTF whose colour images trimesh could not read, or would lay otherwise than the file says."""
    named, plain, once = set(), set(), set()
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
        if told := [what for what, used in unread.items() if used]:
            raise ThermorenderError(
                f"{path}: the texture of material {shortened(repr(name))} is laid through {told[0]}, which is not "
                "read; bake it into the image and its first map coordinates"
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
            raise ThermorenderError(
                f"{path}: the texture of material {name!r} cannot be read; {_IMAGE}"
            )
        if image is not None and name in once and geometry.visual.uv is not None:
            # As in `_repeated`, half a texel beyond shows nothing else.
            if (np.abs(geometry.visual.uv - 0.5) > 0.5 + 0.5 / np.array(image.size)).any():
                raise ThermorenderError(
                    f"{path}: the texture of material {shortened(repr(name))} is drawn out or mirrored beyond its "
                    "edge, which is not read; bake the texture, with map coordinates in 0…1, or have it repeat"
                )
