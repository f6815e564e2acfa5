"""glTF 2.0 files (GLB and glTF), read into Pieces, one for each primitive of each node.

trimesh returns accessors raw. Normalised and sparse values and required extensions are the reader's duty (Khronos, glTF
2.0, ISO/IEC 12113:2022), so they are read here.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError, shortened
from thermorender.scene.meshes.gltf_data import File
from thermorender.scene.meshes.mesh_pieces import Beside, Coat, Piece, of_faces, several

_REPEAT = 10497  # section 5.25: the default wrap mode of a texture
_TRIANGLES, _STRIP, _FAN = 4, 5, 6  # section 5.24; other modes are points and lines, which have no area
# y up to z up: (x, y, z) becomes (x, −z, y).
_TURN = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
_DEEPEST = 100  # nodes above each other
_Floats = NDArray[np.float64]


def read(path: Path, beside: Beside) -> list[Piece]:
    """Return the Pieces of the default scene of a glTF file, in metres and turned from y up to z up; no animation.

    Constant transparency is opaque, as panes are in the long-wave infrared; alpha textures are refused.
    """
    file = File(path, beside)
    pieces = []
    coats: dict[Any, tuple[Coat, Any]] = {}
    for name, matrix, node in _nodes(file):
        mesh = file.item("meshes", node["mesh"])
        _refuse_deformed(file, node, mesh)
        for number, primitive in enumerate(mesh["primitives"]):
            faces, vertices = _geometry(file, primitive)
            if not len(faces):
                continue
            material = primitive.get("material")
            if material not in coats:
                coats[material] = _coat(file, material)
            coat, texture = coats[material]
            coat, tint = _tinted(file, primitive, coat, faces, len(vertices))
            uv = None if coat.image is None else _map(file, primitive, texture, faces, len(vertices))
            vertices = vertices @ matrix[:3, :3].T + matrix[:3, 3]
            if np.linalg.det(matrix[:3, :3]) < 0.0:
                faces, uv = faces[:, ::-1], None if uv is None else uv[:, ::-1]
            own = f"{path.stem}:{name}" + (f":{number}" if number else "")
            names = (name, *_names(file, mesh, material, texture))
            pieces.append(Piece(own, vertices, faces, uv, coat, names, tint))
    return pieces


def _names(file: File, mesh: dict[str, Any], material: int | None, texture: Any) -> Iterator[str]:
    """Names of a primitive's mesh, material and image file."""
    yield str(mesh.get("name", ""))
    if material is not None:
        yield str(file.item("materials", material).get("name", ""))
    if texture is not None:
        source = file.item("textures", texture["index"])
        extensions = source.get("extensions", {})
        image = file.item("images", extensions.get("EXT_texture_webp", {}).get("source", source.get("source")))
        yield str(image.get("name", ""))
        if not str(image.get("uri", "data:")).startswith("data:"):
            yield unquote(str(image["uri"]).rpartition("/")[2])


def _nodes(file: File) -> Iterator[tuple[str, _Floats, dict[str, Any]]]:
    """(name, matrix (4, 4) to the mesh's axes, node) of each node of the default scene that has a mesh."""
    scenes, nodes = file.tree.get("scenes", ()), file.tree.get("nodes", ())
    if "scene" not in file.tree and len(scenes) > 1:
        raise ThermorenderError(f"{file.path} has {len(scenes)} scenes and names none as the default; export one")
    roots = (
        file.item("scenes", file.tree.get("scene", 0)).get("nodes", ()) if scenes
        else set(range(len(nodes))) - {child for node in nodes for child in node.get("children", ())}
    )  # fmt: skip
    waiting = [(number, _TURN, 0) for number in roots]
    seen: set[int] = set()
    while waiting:
        number, above, depth = waiting.pop()
        node = file.item("nodes", number)
        if number in seen or depth > _DEEPEST:
            raise file.damaged(f"node {number} has two parents or is below {_DEEPEST} others")
        seen.add(number)
        matrix = above @ _matrix(file, number, node)
        waiting += [(child, matrix, depth + 1) for child in node.get("children", ())]
        if "EXT_mesh_gpu_instancing" in node.get("extensions", {}):
            raise file.unsupported("EXT_mesh_gpu_instancing")
        if "mesh" in node:
            yield str(node.get("name", number)), matrix, node


def _matrix(file: File, number: int, node: dict[str, Any]) -> _Floats:
    """The matrix of a node, (4, 4); section 3.5.2."""
    if "matrix" in node:
        matrix = np.array(node["matrix"], np.float64).reshape(4, 4).T
    else:
        x, y, z, w = np.array(node.get("rotation", (0.0, 0.0, 0.0, 1.0)), np.float64)
        if abs(length := np.sqrt(x * x + y * y + z * z + w * w)) < 0.5:
            raise file.damaged(f"node {number} has a rotation that is not a unit quaternion")
        x, y, z, w = x / length, y / length, z / length, w / length
        turn = np.array([
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ])  # fmt: skip
        matrix = np.eye(4)
        matrix[:3, :3] = turn * np.array(node.get("scale", (1.0, 1.0, 1.0)), np.float64).reshape(3)
        matrix[:3, 3] = np.array(node.get("translation", (0.0, 0.0, 0.0)), np.float64).reshape(3)
    if not np.isfinite(matrix).all():
        raise file.damaged(f"node {number} has a transform that is not finite")
    return matrix


def _refuse_deformed(file: File, node: dict[str, Any], mesh: dict[str, Any]) -> None:
    name = shortened(repr(node.get("name", node["mesh"])))
    for what, used in (("skin", "skin" in node), ("morph weights", any(node.get("weights", mesh.get("weights", ()))))):
        if used:
            raise ThermorenderError(
                f"{file.path}: node {name} deforms its mesh by {what}, which is not supported; apply it to the mesh "
                "before the export (Blender: Object > Convert > Mesh)"
            )


def _geometry(file: File, primitive: dict[str, Any]) -> tuple[NDArray[np.int64], _Floats]:
    """(faces (F, 3), vertices (V, 3)) of a primitive; no faces where it has points or lines."""
    mode = primitive.get("mode", _TRIANGLES)
    if mode not in (_TRIANGLES, _STRIP, _FAN):
        return np.empty((0, 3), np.int64), np.empty((0, 3))
    position = file.item("accessors", primitive["attributes"]["POSITION"])
    if "KHR_draco_mesh_compression" in primitive.get("extensions", {}) and "bufferView" not in position:
        raise file.unsupported("KHR_draco_mesh_compression")
    vertices = file.attribute(primitive["attributes"]["POSITION"], "POSITION", ["VEC3"], normalized_only=False)
    if "indices" in primitive:
        index = file.accessor(primitive["indices"], "indices", ["SCALAR"])[:, 0]
        if index.dtype.kind != "u":
            raise file.damaged("its indices are not unsigned integers")
    else:
        index = np.arange(len(vertices))
    index = index.astype(np.int64)
    if index.max() >= len(vertices):
        raise file.damaged(f"its indices name vertex {index.max()} of {len(vertices)}")
    if mode == _TRIANGLES:
        if len(index) % 3:
            raise file.damaged(f"{len(index)} indices are not whole triangles")
        return index.reshape(-1, 3), vertices
    one = np.arange(max(len(index) - 2, 0))
    if mode == _FAN:
        return index[np.stack([one + 1, one + 2, 0 * one], axis=-1)], vertices
    # Every second triangle of a strip runs the other way.
    return index[np.stack([one, one + 1 + one % 2, one + 2 - one % 2], axis=-1)], vertices


def _coat(file: File, number: int | None) -> tuple[Coat, Any]:
    """(Coat, the JSON that names its texture or None) of a material."""
    material = {} if number is None else file.item("materials", number)
    what = f"texture of material {shortened(repr(material.get('name', number)))}"
    coat = material.get("pbrMetallicRoughness", {})
    names = "baseColorTexture", "baseColorFactor"
    old = material.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness")
    if old is not None:
        coat, names = old, ("diffuseTexture", "diffuseFactor")
    factor = np.array(coat.get(names[1], (1.0, 1.0, 1.0, 1.0)), np.float64).reshape(4)
    mode = material.get("alphaMode", "OPAQUE")
    cut = {"OPAQUE": 0.0, "MASK": float(material.get("alphaCutoff", 0.5)), "BLEND": 1.0}[mode]
    texture = coat.get(names[0])
    if mode != "OPAQUE" and (factor[3] == 0.0 or (mode == "MASK" and factor[3] < cut)):
        raise ThermorenderError(
            f"{file.path}: material {shortened(repr(material.get('name', number)))} is invisible (alphaMode {mode}); "
            "delete its faces, or set its alphaMode to OPAQUE"
        )
    if texture is None:
        return Coat(what, np.full(3, 255, np.uint8), factor=factor[:3]), None
    source = file.item("textures", texture["index"])
    sampler = file.item("samplers", source["sampler"]) if "sampler" in source else {}
    repeats = all(sampler.get(key, _REPEAT) == _REPEAT for key in ("wrapS", "wrapT"))
    # Transparency of the factor alone is constant.
    cut = cut / factor[3] if mode == "MASK" else cut
    return Coat(what, image=_image(file, source), factor=factor[:3], repeats=repeats, cut_below=cut), texture


def _image(file: File, texture: dict[str, Any]) -> bytes:
    extensions = texture.get("extensions", {})
    webp = extensions.get("EXT_texture_webp", {}).get("source")
    if (source := texture.get("source") if webp is None else webp) is None:
        raise file.unsupported(next(iter(extensions), "a texture without an image"))
    return file.image(source)


def _map(file: File, primitive: dict[str, Any], texture: Any, faces: NDArray[np.int64], vertices: int) -> _Floats:
    """Map coordinates of the faces, (F, 3, 2), v down, after KHR_texture_transform."""
    change = texture.get("extensions", {}).get("KHR_texture_transform", {})
    name = f"TEXCOORD_{change.get('texCoord', texture.get('texCoord', 0))}"
    if name not in primitive["attributes"]:
        raise ThermorenderError(
            f"{file.path} has a texture but no map coordinates for it ({name}); export the mesh with UVs"
        )
    uv = file.attribute(primitive["attributes"][name], name, ["VEC2"], normalized_only=True)
    if len(uv) != vertices:
        raise file.damaged(f"{name} has {len(uv)} of {vertices} vertices")
    uv = uv * np.array(change.get("scale", (1.0, 1.0)), np.float64)
    cos, sin = np.cos(change.get("rotation", 0.0)), np.sin(change.get("rotation", 0.0))
    # Counter-clockwise on the image, whose v runs down: (1, 0) becomes (cos, −sin).
    uv = uv @ np.array([[cos, -sin], [sin, cos]]) + np.array(change.get("offset", (0.0, 0.0)), np.float64)
    found: _Floats = uv[faces]
    return found


def _tinted(
    file: File, primitive: dict[str, Any], coat: Coat, faces: NDArray[np.int64], vertices: int
) -> tuple[Coat, NDArray[np.float32] | None]:
    """Return (coat times a uniform vertex colour, light of each face where colours differ or None); section 3.9.2."""
    number = primitive["attributes"].get("COLOR_0")
    if number is None:
        return coat, None
    linear = file.attribute(number, "COLOR_0", ["VEC3", "VEC4"], normalized_only=True)[:, :3]
    if len(linear) != vertices:
        raise file.damaged(f"COLOR_0 has {len(linear)} of {vertices} vertices")
    if not several(linear):
        return replace(coat, factor=coat.factor * linear[0]), None
    if coat.image is not None:
        raise ThermorenderError(
            f"{file.path}: the {coat.what} is tinted by different colours by vertex (COLOR_0), which is not supported "
            "beside a texture; bake both into one texture, or delete the colours by vertex (Blender: Object Data > "
            "Color Attributes > Remove) and export it again"
        )
    return coat, of_faces(np.clip(linear, 0.0, 1.0), faces)
