"""glTF files in the making, for tests to change."""

import io
import json
import struct

import numpy as np
from PIL import Image

RED, GREEN, BLUE, WHITE = (200, 0, 0), (0, 180, 0), (0, 0, 160), (255, 255, 255)
# Upper left, upper right, lower left, lower right quadrant of `QUARTERS`.
QUARTERS = np.repeat(np.repeat(np.array([[RED, GREEN], [BLUE, WHITE]], np.uint8), 8, axis=0), 8, axis=1)
CODES = {5120: "b", 5121: "B", 5122: "h", 5123: "H", 5125: "I", 5126: "f"}
WIDTH = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


def png(image, **options):
    file = io.BytesIO()
    Image.fromarray(np.asarray(image, np.uint8)).save(file, "PNG", **options)
    return file.getvalue()


class Gltf:
    """A glTF file in the making: one square of 2 m, its material 'paint' with an image of quarters."""

    def __init__(self):
        self.data = bytearray()
        self.tree = {
            "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": [{"attributes": {}, "material": 0}]}], "accessors": [], "bufferViews": [],
            "textures": [{"source": 0}], "images": [{"bufferView": 0, "mimeType": "image/png"}],
            "materials": [{"name": "paint", "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        }  # fmt: skip
        self.view(png(QUARTERS))
        self.primitive = self.tree["meshes"][0]["primitives"][0]
        self.paint = self.tree["materials"][0]
        self.texture = self.paint["pbrMetallicRoughness"]["baseColorTexture"]

    def view(self, data, **more):
        self.data += bytes(-len(self.data) % 4)
        self.tree["bufferViews"].append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data), **more})
        self.data += data
        return len(self.tree["bufferViews"]) - 1

    def add(self, values, kind=5126, normalized=False, stride=None, base=True, sparse=()):
        """An accessor of raw values; `sparse` lists rows that are stored apart, and zeros stand in their place."""
        values = np.asarray(values).reshape(len(values), -1)
        rows = [struct.pack(f"<{len(row)}{CODES[kind]}", *row.tolist()) for row in values]
        accessor = {
            "componentType": kind,
            "count": len(rows),
            "type": {v: k for k, v in WIDTH.items()}[values.shape[1]],
        }
        if normalized:
            accessor["normalized"] = True
        if base:
            kept = [bytes(len(row)) if k in sparse else row for k, row in enumerate(rows)]
            more = {"byteStride": stride} if stride else {}
            accessor["bufferView"] = self.view(
                b"\7\7\7\7" + b"".join(r.ljust(stride or 0, b"\xaa") for r in kept), **more
            )
            accessor["byteOffset"] = 4
        if len(sparse):
            place = self.view(struct.pack(f"<{len(sparse)}H", *sparse))
            new = self.view(b"".join(rows[k] for k in sparse))
            accessor["sparse"] = {"count": len(sparse), "indices": {"bufferView": place, "componentType": 5123},
                                  "values": {"bufferView": new}}  # fmt: skip
        self.tree["accessors"].append(accessor)
        return len(self.tree["accessors"]) - 1

    def square(self, uv=((0, 1), (1, 1), (1, 0), (0, 0)), **options):
        corners = [[-1.0, 0, 1], [1, 0, 1], [1, 0, -1], [-1, 0, -1]]
        self.primitive["attributes"] |= {"POSITION": self.add(corners), "TEXCOORD_0": self.add(uv, **options)}
        self.primitive["indices"] = self.add(np.array([0, 1, 2, 0, 2, 3]), 5123)
        return self

    def write(self, path, buffer="model.bin"):
        """Write a .glb, or a .gltf with its data in the file `buffer` beside it."""
        data = bytes(self.data) + bytes(-len(self.data) % 4)
        self.tree["buffers"] = [{"byteLength": len(data)} | ({"uri": buffer} if path.suffix == ".gltf" else {})]
        text = json.dumps(self.tree).encode()
        if path.suffix == ".gltf":
            (path.parent / buffer).write_bytes(data)
            path.write_bytes(text)
            return path
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
        path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
        return path
