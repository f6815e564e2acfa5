"""Textured triangle meshes with class numbers, and their files in a scene's folder."""

import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.files import atomic
from thermorender.formats import atomic_raster, encoded_image, write_image

# Name of the mesh in a scene's folder.
MESH = "world.glb"
# Step and base of stored temperatures [K]: rounding is 6 mK RMS.
STEP_K, BASE_K = 0.02, 200.0
# Quality of photographs, without loss of resolution in colour.
_JPEG = 86
# Faces of a primitive: 16 bits number all their corners, but for the last number, which glTF reserves.
_FACES = 65535 // 3
# glTF 2.0, sections 3.6.2, 4.4 and 5.1: component types, targets, and the chunks of a GLB.
_FLOAT, _UINT16 = 5126, 5123
_GLTF, _JSON, _BINARY = 0x46546C67, 0x4E4F534A, 0x004E4942


@dataclass(frozen=True, eq=False)
class TexturedMesh:
    """A triangle mesh with a texture."""

    name: str  # Name of its material in the mesh's file
    vertices: NDArray[np.float64]  # (V, 3) float64 east, north, up [m]
    faces: NDArray[np.int64]  # (F, 3) int64 counter-clockwise seen from outside
    uv: NDArray[np.float32]  # (F, 3, 2) float32 0…1, u to the right and v down the texture
    colour: NDArray[np.uint8]  # (h, w, 3) uint8 sRGB
    classes: NDArray[np.uint8]  # (h, w) uint8 class number of each texel; 0 for none


def write_mesh(path: Path, meshes: Sequence[TexturedMesh], photographs: bool = False) -> None:
    """Write meshes as one GLB file, each a node and a material of its name with an embedded texture: PNG, or JPEG where
    `photographs` may lose what no eye sees and that is smaller. Map coordinates are shares of 65535."""
    tree: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "thermorender"}, "scene": 0,
        "scenes": [{"nodes": list(range(len(meshes)))}],
        "nodes": [{"name": mesh.name, "mesh": k} for k, mesh in enumerate(meshes)],
        "meshes": [], "materials": [], "textures": [], "images": [], "accessors": [], "bufferViews": [],
    }  # fmt: skip
    parts: list[bytes] = []

    def view(data: bytes) -> int:
        start = sum(map(len, parts))
        tree["bufferViews"].append({"buffer": 0, "byteOffset": start, "byteLength": len(data)})
        parts.append(data + bytes(-len(data) % 4))
        return len(tree["bufferViews"]) - 1

    def accessor(values: NDArray[Any], kind: str, component: int, limits: bool = False) -> int:
        """Number of an accessor; integers of several to a vertex are shares of their largest."""
        made: dict[str, Any] = {
            "bufferView": view(values.tobytes()), "componentType": component, "count": len(values), "type": kind,
        }  # fmt: skip
        if component == _UINT16 and kind != "SCALAR":
            made["normalized"] = True
        if limits:
            made |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        tree["accessors"].append(made)
        return len(tree["accessors"]) - 1

    for number, mesh in enumerate(meshes):
        primitives = []
        # Neighbours are together, so that few vertices are in two primitives.
        for own in np.split(
            order := np.argsort(mesh.faces.min(axis=1), kind="stable"), range(_FACES, len(order), _FACES)
        ):
            position, uv, index = _unique_corners(mesh, own)
            attributes = {"POSITION": accessor(position, "VEC3", _FLOAT, True)}
            attributes["TEXCOORD_0"] = accessor(uv, "VEC2", _UINT16)
            indices = accessor(index, "SCALAR", _UINT16)
            primitives.append({"attributes": attributes, "indices": indices, "material": number})
        tree["meshes"].append({"name": mesh.name, "primitives": primitives})
        coat = {"baseColorTexture": {"index": number}, "metallicFactor": 0.0}
        tree["materials"].append({"name": mesh.name, "pbrMetallicRoughness": coat})
        tree["textures"].append({"source": number})
        picture, kind = encoded_image(".png", mesh.colour), "image/png"
        if photographs and len(lossy := encoded_image(".jpg", mesh.colour, _JPEG)) < len(picture):
            picture, kind = lossy, "image/jpeg"
        tree["images"].append({"bufferView": view(picture), "mimeType": kind})
    tree["buffers"] = [{"byteLength": sum(map(len, parts))}]
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    body = b"".join(parts)
    head = struct.pack("<3I", _GLTF, 2, 12 + 8 + len(text) + 8 + len(body))
    chunks = struct.pack("<2I", len(text), _JSON) + text + struct.pack("<2I", len(body), _BINARY)
    with atomic(path) as part:
        part.write_bytes(head + chunks + body)


def _unique_corners(
    mesh: TexturedMesh, own: NDArray[np.integer]
) -> tuple[NDArray[np.float32], NDArray[np.uint16], NDArray[np.uint16]]:
    """(position (n, 3), map coordinates (n, 2), index (3 k,)) of `own` faces (k,), each pair of them once; y up."""
    corner = np.zeros(3 * len(own), dtype=[("vertex", np.int64), ("u", np.uint16), ("v", np.uint16)])
    uv = np.rint(np.clip(mesh.uv[own], 0.0, 1.0) * 65535.0).astype(np.uint16)
    corner["vertex"], (corner["u"], corner["v"]) = mesh.faces[own].ravel(), uv.reshape(-1, 2).T
    found, index = np.unique(corner, return_inverse=True)
    east, north, up = mesh.vertices[found["vertex"]].T
    position = np.column_stack([east, up, -north]).astype(np.float32)
    return position, np.column_stack([found["u"], found["v"]]), index.astype(np.uint16)


def write_kelvin(path: Path, kelvin: NDArray[Any]) -> None:
    """Write temperatures in the pixels of a texture, (h, w) [K], as a TIFF of steps of 20 mK."""
    import warnings

    import rasterio
    from rasterio.errors import NotGeoreferencedWarning

    counts = np.clip(np.round((kelvin - BASE_K) / STEP_K), 0, 65535).astype(np.uint16)
    with warnings.catch_warnings():
        # A texture has no place on a map.
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with atomic_raster(path) as part, rasterio.open(
            part, "w", driver="GTiff", count=1, dtype=counts.dtype, height=counts.shape[0], width=counts.shape[1],
            compress="zstd", zstd_level=12, predictor=2, tiled=True,
            blockxsize=-(-counts.shape[1] // 16) * 16, blockysize=-(-counts.shape[0] // 16) * 16,
        ) as file:  # fmt: skip
            file.write(counts[None])
            file.scales, file.offsets, file.units = (STEP_K,), (BASE_K,), ("K",)


def write_meshes(
    folder: Path, meshes: Sequence[TexturedMesh], all_meshes: Sequence[TexturedMesh] | None = None,
    photographs: bool = False,
) -> list[dict[str, Any]]:  # fmt: skip
    """Write a mesh and the class rasters of meshes into a scene's folder; return the [[surface]] tables of the meshes.

    The file holds the same meshes, or `all_meshes`, some of which have no classes; `photographs` as of `write_mesh`.
    """
    write_mesh(folder / MESH, meshes if all_meshes is None else all_meshes, photographs)
    for mesh in meshes:
        write_image(folder / f"{mesh.name}_classes.png", mesh.classes)
    return [{"name": mesh.name, "classes": f"{mesh.name}_classes.png"} for mesh in meshes]
