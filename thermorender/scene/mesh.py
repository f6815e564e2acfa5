"""Meshes from files (OBJ, GLB, PLY, …) and primitives, as parts with map coordinates and a colour image."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from thermorender.errors import ThermorenderError


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


def load(path):
    """Return the Parts of a mesh file, in the file's own coordinates (z up for OBJ and PLY; GLB's y-up is turned).

    Raises
    ------
    ThermorenderError
        A file trimesh cannot read, one without triangles of any area, an image texture without map coordinates,
        or a texture that is named but missing or broken.
    """
    import trimesh

    path = Path(path)
    if not path.stat().st_size:
        raise ThermorenderError(f"{path} is empty; give an OBJ, GLB or PLY file")
    try:
        loaded = trimesh.load_scene(path)
    except Exception as error:  # trimesh raises many kinds for broken files
        reason = f"{type(error).__name__}: {error}"
        if isinstance(error, ImportError) and error.name == "charset_normalizer":
            # What trimesh asks for to guess the encoding of a text that is not UTF-8.
            reason = "it is not text in UTF-8"
        raise ThermorenderError(f"{path} cannot be read as a mesh ({reason}); give an OBJ, GLB or PLY file") from None
    # trimesh leaves out images it cannot find or read, in silence.
    if path.suffix.lower() == ".obj":
        _check_obj_textures(path)
    if path.suffix.lower() in (".glb", ".gltf"):
        _check_gltf_textures(path, loaded)
    # glTF is y-up by its specification; the other formats carry no rule and are taken as z-up.
    turn = np.eye(4)
    if path.suffix.lower() in (".glb", ".gltf"):
        turn[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    parts = []
    for node in loaded.graph.nodes_geometry:
        transform, name = loaded.graph[node]
        geometry = loaded.geometry[name]
        if not isinstance(geometry, trimesh.Trimesh) or not len(geometry.faces):
            continue
        matrix = turn @ np.asarray(transform, dtype=np.float64)
        vertices = np.array(geometry.vertices, dtype=np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
        faces = np.array(geometry.faces, dtype=np.int32)
        if np.linalg.det(matrix[:3, :3]) < 0.0:
            faces = faces[:, ::-1]
        if not np.isfinite(vertices).all():
            raise ThermorenderError(f"{path} has a vertex that is not finite; export the mesh again")
        parts.append(Part(f"{path.stem}:{node}", vertices, faces, *_texture(geometry, faces, path)))
    if not any(_has_area(part) for part in parts):
        raise ThermorenderError(f"{path} holds no triangles of any area; give a mesh with faces")
    return parts


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
        colour = np.asarray(getattr(visual, "main_color", (128, 128, 128, 255)), dtype=np.uint8)[:3]
        return np.full((len(faces), 3, 2), 0.5, np.float32), colour.reshape(1, 1, 3).copy()
    if visual.uv is None or len(visual.uv) != len(geometry.vertices):
        raise ThermorenderError(f"{path} has a texture but no map coordinates for it; export the mesh with UVs")
    uv = np.array(visual.uv, dtype=np.float32)[faces]
    uv[..., 1] = 1.0 - uv[..., 1]
    return uv, _pixels(image, path)


def _pixels(image, name):
    try:
        return np.array(image.convert("RGB"), dtype=np.uint8)
    except (OSError, SyntaxError) as error:  # Pillow's kinds for a broken file
        raise ThermorenderError(
            f"{name}: the texture cannot be read ({error}); give a whole PNG or JPEG image"
        ) from None


def _check_gltf_textures(path, loaded):
    """Refuse a glTF whose material names a colour image that trimesh could not read."""
    data = path.read_bytes()
    if path.suffix.lower() == ".glb":
        # Header of 12 bytes, then the chunk of JSON behind its length and kind.
        data = data[20 : 20 + int.from_bytes(data[12:16], "little")]
    named, plain = set(), set()
    for material in json.loads(data).get("materials", ()):
        textured = "baseColorTexture" in material.get("pbrMetallicRoughness", {})
        (named if textured else plain).add(material.get("name"))
    for geometry in loaded.geometry.values():
        material = getattr(geometry.visual, "material", None)
        if getattr(material, "name", None) in named - plain and getattr(material, "baseColorTexture", None) is None:
            raise ThermorenderError(
                f"{path}: the texture of material {material.name!r} cannot be read; give a whole PNG or JPEG image"
            )


def _check_obj_textures(path):
    """Refuse an OBJ whose material library or image is named but missing or broken."""
    from PIL import Image

    for line in path.read_text(errors="replace").splitlines():
        if line.startswith("mtllib "):
            library = path.parent / line[7:].strip()
            if not library.is_file():
                raise ThermorenderError(
                    f"{path}: material library {library.name!r} does not exist; put it beside the OBJ"
                )
            for entry in library.read_text(errors="replace").splitlines():
                key, _, name = entry.strip().partition(" ")
                if key.lower() != "map_kd":
                    continue
                image = library.parent / name.strip()
                if not image.is_file():
                    raise ThermorenderError(
                        f"{library}: texture {name.strip()!r} does not exist; put it beside the OBJ"
                    )
                try:
                    with Image.open(image) as opened:
                        opened.load()
                except (OSError, SyntaxError) as error:
                    raise ThermorenderError(
                        f"{image} cannot be read as an image ({error}); give a PNG or JPEG"
                    ) from None
