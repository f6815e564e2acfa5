"""Meshes, and the files beside them."""

import numpy as np

from tests.robustness.fuzz.corpus.registry import reader


def _body():
    import trimesh

    body = trimesh.creation.box((4.0, 3.0, 2.0)).subdivide()
    body.visual = trimesh.visual.TextureVisuals(uv=body.vertices[:, :2] / 8.0 + 0.5)
    return body


def _of_mesh(path):
    from thermorender.scene.meshes.mesh import load

    return load(path, path.parent)


for _name in ("ply", "obj", "glb"):
    reader(f"mesh {_name}", f"model.{_name}", lambda path: _body().export(path))(_of_mesh)


def _painted():
    """The body with an image of 16×16 pixels."""
    from PIL import Image
    from trimesh.visual.material import PBRMaterial

    body, colour = _body(), np.random.default_rng(0).integers(0, 255, (16, 16, 3)).astype(np.uint8)
    body.visual.material = PBRMaterial(baseColorTexture=Image.fromarray(colour), baseColorFactor=[200, 220, 255, 255])
    return body


reader("mesh glb painted", "model.glb", lambda path: _painted().export(path))(_of_mesh)


def _write_beside(path):
    """An OBJ, its material library and its image."""
    body = _painted()
    body.visual.material = body.visual.material.to_simple()
    body.visual.material.name = "coat"
    body.export(path.with_name("model.obj"), mtl_name="coat.mtl")


def _of_beside(path):
    return _of_mesh(path.with_name("model.obj"))


for _name in ("coat.mtl", "coat.png"):
    reader(f"mesh's {_name}", _name, _write_beside)(_of_beside)


def _write_gltf(path):
    """A header in text, and the buffer and image that it names."""
    from trimesh.exchange.gltf import export_gltf

    for name, data in export_gltf(_painted().scene()).items():
        path.with_name(name).write_bytes(data)


reader("mesh gltf", "model.gltf", _write_gltf)(_of_mesh)
