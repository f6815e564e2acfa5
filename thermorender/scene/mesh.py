"""Meshes from files (OBJ, GLB, PLY, …) and primitives, as parts with map coordinates and a colour image."""

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
        A file trimesh cannot read, one without triangles, an image texture without map coordinates, or a
        texture file that is named but not there.
    """
    import trimesh

    path = Path(path)
    try:
        loaded = trimesh.load_scene(path)
    except Exception as error:  # trimesh raises many kinds for broken files
        raise ThermorenderError(f"{path} cannot be read as a mesh: {error}; give an OBJ, GLB or PLY file") from None
    if path.suffix.lower() == ".obj":
        _check_obj_textures(path)
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
        parts.append(Part(f"{path.stem}:{node}", vertices, faces, *_texture(geometry, faces, path)))
    if not parts:
        raise ThermorenderError(f"{path} holds no triangles; give a mesh with faces")
    return parts


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
    return uv, np.array(image.convert("RGB"), dtype=np.uint8)


def _check_obj_textures(path):
    """Refuse an OBJ whose material library or image is named but missing; trimesh leaves it out in silence."""
    for line in path.read_text(errors="replace").splitlines():
        if line.startswith("mtllib "):
            library = path.parent / line[7:].strip()
            if not library.is_file():
                raise ThermorenderError(f"{path}: material library {library.name!r} does not exist; put it beside the OBJ")
            for entry in library.read_text(errors="replace").splitlines():
                words = entry.split()
                if words and words[0] == "map_Kd" and not (library.parent / words[-1]).is_file():
                    raise ThermorenderError(f"{library}: texture {words[-1]!r} does not exist; put it beside the OBJ")
