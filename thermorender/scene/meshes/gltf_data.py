"""The container and the numbers of a glTF 2.0 file: JSON, buffers, accessors and images, converted as it states."""

import base64
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast
from urllib.parse import unquote_to_bytes

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError, shortened
from thermorender.scene.meshes.mesh_pieces import Beside

# glTF 2.0, sections 3.6.2.2 and 3.6.2.3.
_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_SIZES = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_MOST = 2**31  # elements of an accessor: faces count vertices in 32 bits
# Extensions that change nothing that is read here, and those that are read.
_READ = frozenset({"KHR_mesh_quantization", "KHR_texture_transform", "EXT_texture_webp"})
_HARMLESS = ("KHR_materials_", "KHR_lights_punctual", "KHR_xmp", "KHR_animation_pointer")
# What to do about an extension that is not read; the commands are those of https://gltf-transform.dev.
_MENDS = {
    "KHR_draco_mesh_compression": "decompress it with `gltf-transform copy IN.glb OUT.glb`",
    "EXT_meshopt_compression": "decompress it with `gltf-transform copy IN.glb OUT.glb`",
    "KHR_texture_basisu": "decompress it with `gltf-transform ktxdecompress IN.glb OUT.glb` (with KTX-Software)",
    "EXT_mesh_gpu_instancing": "open it in Blender, apply Object > Apply > Make Instances Real, and export it again",
    "CESIUM_RTC": "move its centre to the origin: convert the tile to a mesh in local metres",
}


class File:
    """A glTF file: its JSON, and its data by their numbers in it."""

    def __init__(self, path: Path, beside: Beside) -> None:
        self.path, self.beside = path, beside
        self.tree, self.chunk = _container(path)
        version = str(self.tree["asset"].get("minVersion", self.tree["asset"]["version"]))
        if version.split(".")[0] != "2":
            raise ThermorenderError(f"{path} is glTF {shortened(version)}; convert it to glTF 2.0")
        for name in self.tree.get("extensionsRequired", ()):
            if name not in _READ and not name.startswith(_HARMLESS):
                raise self.unsupported(name)
        used = {*self.tree.get("extensionsUsed", ()), *self.tree.get("extensionsRequired", ())}
        self.quantized = "KHR_mesh_quantization" in used
        self.buffers: dict[int, bytes] = {}

    def unsupported(self, extension: str) -> ThermorenderError:
        """Return the error of an extension that is not read, with what to do about it."""
        mend = _MENDS.get(extension, "export it again without that extension")
        return ThermorenderError(f"{self.path} uses {shortened(extension)}, which is not supported; {mend}")

    def item(self, kind: str, number: Any) -> dict[str, Any]:
        """Return an object of the JSON by its kind and number."""
        items = self.tree.get(kind, ())
        if not (isinstance(number, int) and not isinstance(number, bool) and 0 <= number < len(items)):
            raise self.damaged(f"it names number {shortened(repr(number), 40)} of {len(items)} {kind}")
        return cast(dict[str, Any], items[number])

    def damaged(self, reason: str) -> ThermorenderError:
        """Return the error of a file that breaks its specification."""
        return ThermorenderError(f"{self.path} cannot be read as a mesh ({reason}); give an OBJ, GLB or PLY file")

    def accessor(self, number: int, what: str, types: Sequence[str]) -> NDArray[Any]:
        """Return the values of an accessor, (count, components): integers as they are, all others as float64.

        Normalised integers are converted and sparse values put in (glTF 2.0, sections 3.6.2.3 and 3.11). `types` are
        the allowed types; messages call the accessor `what`.
        """
        one = self.item("accessors", number)
        kind, count = one["componentType"], one["count"]
        if kind not in _COMPONENTS or one["type"] not in types or not 0 < count < _MOST:
            raise self.damaged(f"{what} is {count} of {one['type']} in component type {kind}")
        size = _SIZES[one["type"]]
        if "bufferView" in one:
            values = self._values(one["bufferView"], one.get("byteOffset", 0), kind, count, size)
        elif "sparse" in one:
            values = np.zeros((count, size), _COMPONENTS[kind])
        else:
            raise self.damaged(f"{what} has no data")
        if "sparse" in one:
            sparse = one["sparse"]
            place, new = sparse["indices"], sparse["values"]
            changed = sparse["count"]
            at = self._values(place["bufferView"], place.get("byteOffset", 0), place["componentType"], changed, 1)[:, 0]
            if at.dtype.kind != "u" or at.max() >= count:
                raise self.damaged(f"{what} has sparse values beyond its {count} elements")
            values = values.copy()
            values[at] = self._values(new["bufferView"], new.get("byteOffset", 0), kind, changed, size)
        if not one.get("normalized", False):
            return values.astype(np.float64) if values.dtype.kind == "f" else values
        if values.dtype.kind == "f" or values.dtype.itemsize > 2:
            raise self.damaged(f"{what} is normalized, which its component type {kind} cannot be")
        return np.maximum(values / float(np.iinfo(values.dtype).max), -1.0)

    def attribute(self, number: int, what: str, types: Sequence[str], normalized_only: bool) -> NDArray[np.float64]:
        """Return the values of a vertex attribute as float64, in component types that the file may use for it."""
        one = self.item("accessors", number)
        whole, kept = one["componentType"] != 5126, one.get("normalized", False)
        # Section 3.7.2.1; KHR_mesh_quantization adds integers, normalised or not.
        if whole and not self.quantized and not (normalized_only and kept and one["componentType"] in (5121, 5123)):
            raise self.damaged(
                f"{what} holds integers of component type {one['componentType']}"
                f"{'' if kept else ' without normalized'}, which needs the extension KHR_mesh_quantization"
            )
        return self.accessor(number, what, types).astype(np.float64)

    def _values(self, view: int, offset: int, kind: int, count: int, size: int) -> NDArray[Any]:
        """The raw values of a buffer view, (count, size)."""
        data, stride = self.view(view)
        dtype = np.dtype(_COMPONENTS[kind])
        stride = stride or dtype.itemsize * size
        end = offset + stride * (count - 1) + dtype.itemsize * size
        if min(offset, count - 1) < 0 or stride < dtype.itemsize * size or end > len(data):
            raise self.damaged(f"bufferView {view} of {len(data)} bytes ends before byte {end} of its accessor")
        return np.ndarray((count, size), dtype, data, offset, (stride, dtype.itemsize))

    def view(self, number: int) -> tuple[memoryview, int | None]:
        """Return (bytes, stride) of a buffer view."""
        one = self.item("bufferViews", number)
        if "EXT_meshopt_compression" in one.get("extensions", {}):
            raise self.unsupported("EXT_meshopt_compression")
        whole = self.buffer(one["buffer"])
        start, length = one.get("byteOffset", 0), one["byteLength"]
        if min(start, length) < 0 or start + length > len(whole):
            raise self.damaged(f"bufferView {number} ends after its buffer of {len(whole)} bytes")
        return memoryview(whole)[start : start + length], one.get("byteStride")

    def buffer(self, number: int) -> bytes:
        """Return the bytes of a buffer."""
        if number not in self.buffers:
            one = self.item("buffers", number)
            if "uri" in one:
                data = self.bytes_of(one["uri"])
            elif number == 0 and self.chunk is not None:
                data = self.chunk
            else:
                raise self.damaged(f"buffer {number} has no data")
            if len(data) < one["byteLength"]:
                raise self.damaged(f"buffer {number} has {len(data)} bytes, and {one['byteLength']} are stated")
            self.buffers[number] = data
        return self.buffers[number]

    def bytes_of(self, uri: str) -> bytes:
        """Return the bytes of a data URI, or of a file beside this one."""
        if not uri.startswith("data:"):
            return self.beside.get(uri)
        head, comma, data = uri.partition(",")
        if not comma:
            raise self.damaged("a data URI has no data")
        return base64.b64decode(unquote_to_bytes(data)) if head.endswith(";base64") else unquote_to_bytes(data)

    def image(self, number: int) -> bytes:
        """Return the bytes of an image."""
        one = self.item("images", number)
        return bytes(self.view(one["bufferView"])[0]) if "bufferView" in one else self.bytes_of(one["uri"])


def _container(path: Path) -> tuple[dict[str, Any], bytes | None]:
    """(JSON, binary chunk or None) of a file (section 4.4)."""
    data, chunk = path.read_bytes(), None
    if data[:4] == b"glTF":
        version, length = (int.from_bytes(data[at : at + 4], "little") for at in (4, 8))
        if version != 2:
            raise ThermorenderError(f"{path} is glTF {version}; convert it to glTF 2.0")
        if length > len(data):
            raise ValueError(f"it has {len(data)} bytes, and {length} are stated")
        chunks: dict[bytes, bytes] = {}
        at = 12
        while at + 8 <= length:
            size = int.from_bytes(data[at : at + 4], "little")
            if at + 8 + size > length:
                raise ValueError("a chunk ends after the file")
            chunks.setdefault(data[at + 4 : at + 8], data[at + 8 : at + 8 + size])
            at += 8 + size
        data, chunk = chunks[b"JSON"], chunks.get(b"BIN\0")
    return cast(dict[str, Any], json.loads(data)), chunk
