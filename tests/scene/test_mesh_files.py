"""Mesh files: numbers, textures and materials as the file states them, or a refusal that names what is not read."""

import base64
import io
import json
import re
import struct
import zipfile

import numpy as np
import pytest
from mesh_support import BLUE, CODES, GREEN, QUARTERS, RED, WHITE, WIDTH, Gltf, png
from PIL import Image

from thermorender.errors import ThermorenderError
from thermorender.physics.srgb import bytes_from_linear, linear_from_bytes
from thermorender.scene.load import load_scene
from thermorender.scene.meshes.mesh import load

LARGEST = {5120: 127, 5121: 255, 5122: 32767, 5123: 65535}


LETTERS = {"b": "char", "B": "uchar", "h": "short", "H": "ushort", "i": "int", "I": "uint", "f": "float", "d": "double"}


def plain(colour):
    return png(np.full((4, 4, 3), colour))


def at(parts, point):
    """The colour that the parts show at a point (x, y) seen from above, and how many faces are there."""
    found = []
    for part in parts:
        for corners, uv in zip(part.vertices[part.faces][..., :2], part.uv, strict=True):
            sides = np.column_stack([corners[1] - corners[0], corners[2] - corners[0]])
            if abs(np.linalg.det(sides)) < 1e-12:
                continue
            b, c = np.linalg.solve(sides, np.asarray(point) - corners[0])
            if min(b, c, 1.0 - b - c) > 1e-9:
                u, v = (1.0 - b - c) * uv[0] + b * uv[1] + c * uv[2]
                height, width = part.colour.shape[:2]
                found.append(
                    tuple(part.colour[min(int(v * height), height - 1), min(int(u * width), width - 1)].tolist())
                )
    assert len(found) == 1, found
    return found[0]


def refused(path, *words):
    with pytest.raises(ThermorenderError) as error:
        load(path)
    for word in words:
        assert word in str(error.value), (word, str(error.value))


# --- glTF -------------------------------------------------------------------------------------------------------


def reference(path):
    """(positions, map coordinates, triangles) of the first primitive, element by element from the specification."""
    raw = path.read_bytes()
    size = struct.unpack_from("<I", raw, 12)[0]
    tree, data = json.loads(raw[20 : 20 + size]), raw[28 + size :]

    def element(view, offset, code, width, k, packed=False):
        one = tree["bufferViews"][view]
        step = struct.calcsize(code) * width if packed else one.get("byteStride", struct.calcsize(code) * width)
        return list(struct.unpack_from(f"<{width}{code}", data, one.get("byteOffset", 0) + offset + k * step))

    def values(number):
        one = tree["accessors"][number]
        code, width = CODES[one["componentType"]], WIDTH[one["type"]]
        rows = [
            element(one["bufferView"], one.get("byteOffset", 0), code, width, k) if "bufferView" in one else [0] * width
            for k in range(one["count"])
        ]
        for k in range(one.get("sparse", {}).get("count", 0)):
            where, new = one["sparse"]["indices"], one["sparse"]["values"]
            rows[element(where["bufferView"], 0, CODES[where["componentType"]], 1, k)[0]] = (
                element(new["bufferView"], 0, code, width, k, packed=True)
            )  # fmt: skip
        if one.get("normalized"):
            rows = [[max(x / LARGEST[one["componentType"]], -1.0) for x in row] for row in rows]
        return rows

    primitive = tree["meshes"][0]["primitives"][0]
    position, uv = (np.array(values(primitive["attributes"][name]), float) for name in ("POSITION", "TEXCOORD_0"))
    index = [row[0] for row in values(primitive["indices"])] if "indices" in primitive else list(range(len(position)))
    mode, k = primitive.get("mode", 4), range(len(index) - 2)
    faces = {4: [index[i : i + 3] for i in k[::3]], 6: [[index[i + 1], index[i + 2], index[0]] for i in k],
             5: [[index[i], index[i + 1 + i % 2], index[i + 2 - i % 2]] for i in k]}[mode]  # fmt: skip
    return position, uv, np.array(faces)


QUANTIZED = "KHR_mesh_quantization"
KINDS = [
    {}, {"uv": {"kind": 5121, "normalized": True}}, {"uv": {"kind": 5123, "normalized": True}},
    {"uv": {"stride": 20}}, {"uv": {"kind": 5121, "normalized": True, "stride": 4}}, {"uv": {"sparse": (1, 4)}},
    {"uv": {"kind": 5123, "normalized": True, "sparse": (0, 5), "stride": 8}},
    {"uv": {"base": False, "sparse": (0, 1, 2, 3, 4, 5)}}, {"position": {"sparse": (2,)}}, {"position": {"stride": 16}},
    {"uv": {"kind": 5120, "normalized": True}, "uses": QUANTIZED},
    {"uv": {"kind": 5122, "normalized": True}, "uses": QUANTIZED}, {"uv": {"kind": 5121}, "uses": QUANTIZED},
    {"position": {"kind": 5122, "stride": 8}, "uses": QUANTIZED}, {"position": {"kind": 5123}, "uses": QUANTIZED},
    {"position": {"kind": 5120, "normalized": True, "stride": 4}, "uses": QUANTIZED},
    {"position": {"kind": 5121, "sparse": (3,)}, "uses": QUANTIZED},
    *({"indices": kind, "mode": mode} for kind in (5121, 5123, 5125, None) for mode in (4, 5, 6)),
]  # fmt: skip


@pytest.mark.parametrize("kind", KINDS, ids=str)
def test_every_kind_of_accessor_is_read_as_the_specification_says(tmp_path, kind):
    rng, file = np.random.default_rng(7), Gltf()

    def raw(width, options):
        code = options.get("kind", 5126)
        if code == 5126:
            return rng.uniform(-2.0, 2.0, (6, width)).astype(np.float32)
        low = 0 if CODES[code].isupper() else -LARGEST[code] - 1
        largest = LARGEST[code] if options.get("normalized") else 9
        return rng.integers(
            low if options.get("normalized") else min(low, 0) and -9, largest, (6, width), endpoint=True
        )

    uv, position = kind.get("uv", {}), kind.get("position", {})
    file.primitive["attributes"] = {
        "POSITION": file.add(raw(3, position), **position), "TEXCOORD_0": file.add(raw(2, uv), **uv)
    }  # fmt: skip
    if kind.get("indices", 5123):
        file.primitive["indices"] = file.add(np.array([5, 0, 3, 1, 2, 4]), kind.get("indices", 5123))
    file.primitive["mode"] = kind.get("mode", 4)
    if "uses" in kind:
        file.tree["extensionsUsed"] = file.tree["extensionsRequired"] = [kind["uses"]]
    (part,), (corner, on_map, faces) = load(file.write(tmp_path / "m.glb")), reference(tmp_path / "m.glb")
    # y up to z up.
    np.testing.assert_allclose(part.vertices[part.faces], corner[faces][..., [0, 2, 1]] * [1, -1, 1], atol=1e-6)
    # A repeated image is tiled, and a face begins in its first tile.
    tiles = np.array(part.colour.shape[1::-1]) / 16
    shift = part.uv * tiles - on_map[faces]
    np.testing.assert_allclose(shift, np.rint(shift), atol=2e-5)
    np.testing.assert_allclose(shift, shift[:, :1].repeat(3, axis=1), atol=2e-5)


@pytest.mark.parametrize(("kind", "largest"), [(5126, 1), (5121, 255), (5123, 65535)])
def test_normalized_map_coordinates_show_the_texture_once(tmp_path, kind, largest):
    file = Gltf().square(np.array([[0, 1], [1, 1], [1, 0], [0, 0]]) * largest, kind=kind, normalized=largest > 1)
    (part,) = load(file.write(tmp_path / "m.glb"))
    assert part.colour.shape == (16, 16, 3)
    shown = [at([part], point) for point in ((-0.5, 0.4), (0.5, 0.4), (-0.5, -0.6), (0.5, -0.6))]
    assert shown == [RED, GREEN, BLUE, WHITE]


def test_nodes_place_and_turn_their_meshes(tmp_path):
    """A parent that turns by 90° around y and doubles, and a child that moves by 3 along x, as TRS and as a matrix."""
    half = np.sqrt(0.5)
    by_parts = [{"rotation": [0, half, 0, half], "scale": [2, 2, 2], "children": [1]},
                {"translation": [3, 0, 0], "mesh": 0}]  # fmt: skip
    by_matrix = [{"matrix": [0, 0, -2, 0, 0, 2, 0, 0, 2, 0, 0, 0, 0, 0, 0, 1], "children": [1]},
                 {"matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 3, 0, 0, 1], "mesh": 0}]  # fmt: skip
    for nodes in (by_parts, by_matrix):
        file = Gltf().square()
        # Nodes outside the default scene are not shown.
        file.tree["nodes"] = [*nodes, {"mesh": 0}]
        (part,) = load(file.write(tmp_path / "m.glb"))
        # The first corner, (−1, 0, 1): moved (2, 0, 1), doubled (4, 0, 2), turned (2, 0, −4), with z up (2, 4, 0).
        np.testing.assert_allclose(part.vertices[0], [2.0, 4.0, 0.0], atol=1e-12)
    file.tree["nodes"] = [{"mesh": 0, "scale": [-1, 1, 1]}]
    parts = load(file.write(tmp_path / "m.glb"))
    a, b, c = np.moveaxis(parts[0].vertices[parts[0].faces], 1, 0)
    assert (np.cross(b - a, c - a)[:, 2] > 0.0).all()
    assert [at(parts, point) for point in ((0.5, 0.4), (-0.5, 0.4))] == [RED, GREEN]


def test_texture_transform_and_second_map_coordinates(tmp_path):
    file = Gltf().square()
    file.primitive["attributes"]["TEXCOORD_1"] = file.primitive["attributes"].pop("TEXCOORD_0")
    file.primitive["attributes"]["TEXCOORD_0"] = file.add(np.zeros((4, 2)))
    file.texture["texCoord"] = 1
    assert at(load(file.write(tmp_path / "m.glb")), (0.5, 0.4)) == GREEN
    # The example of the extension's text: the lower left quadrant of the image, turned clockwise by 90°.
    change = {"offset": [0, 1], "rotation": np.pi / 2, "scale": [0.5, 0.5], "texCoord": 1}
    file.texture.update({"texCoord": 0, "extensions": {"KHR_texture_transform": change}})
    file.tree["extensionsRequired"] = ["KHR_texture_transform"]
    image = QUARTERS.copy()
    image[8:12, :4], image[12:, :4], image[12:, 4:8] = RED, GREEN, WHITE  # the rest of that quadrant is blue
    file.tree["images"][0]["bufferView"] = file.view(png(image))
    parts = load(file.write(tmp_path / "m.glb"))
    shown = [at(parts, point) for point in ((-0.5, 0.4), (0.5, 0.4), (-0.5, -0.6), (0.5, -0.6))]
    assert shown == [GREEN, RED, WHITE, BLUE]


def test_primitives_have_their_own_textures_and_colours(tmp_path):
    file = Gltf().square()
    file.tree["images"].append({"uri": "data:image/png;base64," + base64.b64encode(plain(BLUE)).decode()})
    file.tree["textures"].append({"extensions": {"EXT_texture_webp": {"source": 2}}, "source": 1})
    webp = io.BytesIO()
    Image.new("RGB", (8, 8), GREEN).save(webp, "WEBP", lossless=True)
    file.tree["images"].append({"bufferView": file.view(webp.getvalue())})
    file.tree["materials"] += [
        {"pbrMetallicRoughness": {"baseColorTexture": {"index": 1}}},
        {"pbrMetallicRoughness": {"baseColorFactor": [0.0, 0.0, 1.0, 1.0]}},
        {"extensions": {"KHR_materials_pbrSpecularGlossiness": {"diffuseFactor": [1, 0, 0, 1]}}},
    ]
    for shift, material in ((10, 1), (20, 2), (30, 3), (40, None)):
        moved = np.array([[-1.0, 0, 1], [1, 0, 1], [1, 0, -1], [-1, 0, -1]]) + [shift, 0, 0]
        more = json.loads(json.dumps(file.primitive)) | {"material": material}
        more["attributes"]["POSITION"] = file.add(moved)
        if material is None:
            del more["material"]
            more["attributes"]["COLOR_0"] = file.add(np.full((4, 3), 51), 5121, normalized=True, stride=4)
        file.tree["meshes"][0]["primitives"].append(more)
    parts = load(file.write(tmp_path / "m.glb"))
    shown = [at(parts, (shift - 0.5, 0.4)) for shift in (0, 10, 20, 30, 40)]
    # A fifth in linear light is 124 in sRGB.
    assert shown == [RED, GREEN, (0, 0, 255), (255, 0, 0), (124, 124, 124)]


def test_nodes_of_one_texture_share_its_texels(tmp_path):
    file = Gltf().square()
    file.tree["nodes"] = [{"mesh": 0, "translation": [10 * k, 0, 0]} for k in range(3)]
    file.tree["scenes"] = [{"nodes": [0, 1, 2]}]
    (part,) = load(file.write(tmp_path / "m.glb"))
    assert part.colour.shape == (16, 16, 3) and len(part.faces) == 6
    shown = [at([part], (10 * k + x, y)) for k in range(3) for x, y in ((-0.5, 0.4), (0.5, 0.4), (0.5, -0.6))]
    assert shown == 3 * [RED, GREEN, WHITE]


def changed(change):
    """A square's file after a change of it."""
    file = Gltf().square()
    change(file)
    return file


def compressed(file):
    file.primitive["extensions"] = {"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {"POSITION": 0}}}
    del file.tree["accessors"][0]["bufferView"]


def coloured(file):
    file.primitive["attributes"]["COLOR_0"] = file.add(np.eye(4)[:, :3])


def beyond(file):
    file.primitive["attributes"]["TEXCOORD_0"] = file.add([[0, 2], [2, 2], [2, 0], [0, 0]])


def clamped(file):
    file.tree.update(samplers=[{"wrapS": 33071}], textures=[{"source": 0, "sampler": 0}])


def spoil(file, at, data):
    start = file.data.index(at)
    file.data[start : start + len(data)] = data


def see_through(file):
    file.paint["alphaMode"] = "MASK"
    file.tree["images"][0]["bufferView"] = file.view(png(np.dstack([QUARTERS, np.arange(256).reshape(16, 16)])))


REFUSED = {
    "uses KHR_draco_mesh_compression, which is not supported; decompress it with `gltf-transform copy": compressed,
    "uses EXT_meshopt_compression, which is not supported; decompress it with `gltf-transform": lambda f: f.tree.update(
        extensionsRequired=["EXT_meshopt_compression"]),
    "uses KHR_texture_basisu, which is not supported; decompress it with `gltf-transform ktx": lambda f: f.tree.update(
        textures=[{"extensions": {"KHR_texture_basisu": {"source": 0}}}]),
    "uses CESIUM_RTC, which is not supported": lambda f: f.tree.update(extensionsRequired=["CESIUM_RTC"]),
    "uses EXT_new, which is not supported; export it again without": lambda f: f.tree.update(
        extensionsRequired=["EXT_new"]),
    "uses EXT_mesh_gpu_instancing, which is not supported": lambda f: f.tree["nodes"][0].update(
        extensions={"EXT_mesh_gpu_instancing": {}}),
    "is glTF 1.0; convert it to glTF 2.0": lambda f: f.tree.update(asset={"version": "1.0"}),
    "POSITION has no data": lambda f: f.tree["accessors"][0].pop("bufferView"),
    "TEXCOORD_0 holds integers of component type 5123 without normalized": lambda f: f.tree["accessors"][1].update(
        componentType=5123),
    "TEXCOORD_0 is normalized, which its component type 5126 cannot be": lambda f: f.tree["accessors"][1].update(
        normalized=True),
    "bufferView 1 of 52 bytes ends before byte 64": lambda f: f.tree["accessors"][0].update(count=5),
    "its indices name vertex 3 of 3": lambda f: f.tree["accessors"][0].update(count=3),
    "5 indices are not whole triangles": lambda f: f.tree["accessors"][2].update(count=5),
    "is tinted by different colours by vertex (COLOR_0), which is not supported beside": coloured,
    "the texture of material 'paint' has transparent texels (alphaMode)": see_through,
    "material 'paint' is invisible (alphaMode BLEND)": lambda f: (
        f.paint.update(alphaMode="BLEND"),
        f.paint["pbrMetallicRoughness"].update(baseColorFactor=[1, 1, 1, 0])),
    "deforms its mesh by skin, which is not supported": lambda f: f.tree["nodes"][0].update(skin=0),
    "deforms its mesh by morph weights": lambda f: f.tree["meshes"][0].update(weights=[0.0, 0.5]),
    "has 2 scenes and names none as the default": lambda f: (f.tree.pop("scene"), f.tree["scenes"].append({})),
    "it names number 7 of 1 materials": lambda f: f.primitive.update(material=7),
    "node 0 has two parents or is below": lambda f: f.tree["nodes"][0].update(children=[0]),
    "the texture of material 'paint' is clamped or mirrored at its edge": lambda f: (beyond(f), clamped(f)),
    "has a texture but no map coordinates for it (TEXCOORD_1)": lambda f: f.texture.update(texCoord=1),
    "has a texture but no map coordinates": lambda f: f.primitive["attributes"].pop("TEXCOORD_0"),
    "the texture of material 'paint' cannot be read": lambda f: spoil(f, b"\x89PNG", b"XXXX"),
    "the texture of material 'paint' cannot be read (broken": lambda f: spoil(f, b"IDAT", b"IDATXXXX"),
}  # fmt: skip


@pytest.mark.parametrize("words", REFUSED)
def test_what_is_not_read_of_a_gltf_is_refused_by_name(tmp_path, words):
    refused(changed(REFUSED[words]).write(tmp_path / "m.glb"), "m.glb", words)


def test_alpha_without_effect_is_accepted(tmp_path):
    """A PNG without holes under alphaMode BLEND, and holes under alphaMode OPAQUE; panes are opaque."""
    opaque = changed(see_through)
    del opaque.paint["alphaMode"]
    pane = Gltf().square()
    pane.paint.update(alphaMode="BLEND")
    pane.paint["pbrMetallicRoughness"]["baseColorFactor"] = [1, 1, 1, 0.3]
    for file in (opaque, pane):
        assert at(load(file.write(tmp_path / "m.glb")), (0.5, 0.4)) == GREEN


def test_textures_may_repeat_or_end_at_their_edge(tmp_path):
    for change, shown in ((beyond, WHITE), (clamped, GREEN)):
        assert at(load(changed(change).write(tmp_path / "m.glb")), (0.8, 0.1)) == shown


@pytest.mark.parametrize("factor", [(0.25, 0.5, 1.0), (0.4, 0.4, 0.4), None])
@pytest.mark.parametrize("shade", [255, 200])
def test_texture_is_multiplied_by_its_material_factor_in_linear_light(tmp_path, shade, factor):
    import colour

    file = Gltf().square()
    file.tree["images"][0]["bufferView"] = file.view(plain(shade))
    if factor:
        file.paint["pbrMetallicRoughness"]["baseColorFactor"] = [*factor, 1.0]
    (part,) = load(file.write(tmp_path / "m.glb"))
    light = colour.models.eotf_sRGB(shade / 255.0) * np.array(factor or (1.0, 1.0, 1.0))
    assert np.abs(part.colour[0, 0] - 255.0 * colour.models.eotf_inverse_sRGB(light)).max() <= 0.501


@pytest.mark.parametrize(("factor", "shown"), [([0.2, 0.4, 0.8, 1.0], (124, 170, 231)), (None, (255, 255, 255))])
def test_part_without_image_has_its_material_colour(tmp_path, factor, shown):
    file = Gltf().square()
    file.paint["pbrMetallicRoughness"] = {"baseColorFactor": factor} if factor else {}
    assert at(load(file.write(tmp_path / "m.glb")), (0.5, 0.4)) == shown


@pytest.mark.parametrize("suffix", ["obj", "glb", "gltf", "ply"])
def test_garbage_and_empty_meshes_are_refused(tmp_path, suffix):
    path = tmp_path / f"model.{suffix}"
    half = Gltf().square().write(tmp_path / "m.glb").read_bytes()[:500]
    for data, words in ((b"garbage \x00\xff\n no mesh", "cannot be read as a mesh"), (b"", "is empty"),
                        (half, "cannot be read as a mesh")):  # fmt: skip
        path.write_bytes(data)
        refused(path, f"model.{suffix} {words}", "give an OBJ, GLB or PLY file")


def test_an_archive_is_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "model.zip", "w") as archive:
        archive.writestr("model.obj", SQUARE + FACES)
    refused(tmp_path / "model.zip", "model.zip is not in a supported format; give one of .obj, .glb")


# --- OBJ --------------------------------------------------------------------------------------------------------

SQUARE = "v -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
FACES = "f 1/1 2/2 3/3\nf 1/1 3/3 4/4\n"
MATERIALS = {
    "one.mtl": "newmtl m\nKd 0.8 0.8 0.8\nmap_Kd t.png\n", "two.mtl": "newmtl a\nmap_Kd t.png\n\nnewmtl b\nKd 0 0 1\n",
    "b.mtl": "newmtl b\nmap_Kd -clamp off -o 0 0 0 -s 1 1 1 -mm 0 1 -blendu on two words.png\n",
    "windows.mtl": "newmtl m\r\nmap_Kd tex\\t.png\r\n", "plain.mtl": "newmtl m\nKd 0.2 0.4 0.8\n",
    "my lib.mtl": "# by Zo\xeb\nnewmtl my stone\nmap_Kd two words.png\n",
}  # fmt: skip


@pytest.fixture
def obj(tmp_path):
    """Return a function that writes an OBJ; its material libraries and textures are beside it."""
    (tmp_path / "t.png").write_bytes(png(QUARTERS))
    (tmp_path / "two words.png").write_bytes(plain(BLUE))
    (tmp_path / "tex").mkdir()
    (tmp_path / "tex" / "t.png").write_bytes(png(QUARTERS))
    (tmp_path / "broken.png").write_text("garbage")
    Image.fromarray(np.full((4, 4), 40000, np.uint16)).save(tmp_path / "deep.png")
    program = "%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n%%EndComments\nshowpage\n"
    (tmp_path / "program.eps").write_text(program)
    for name, text in MATERIALS.items():
        (tmp_path / name).write_bytes(text.encode("latin-1"))

    def write(text, mtl=None):
        if mtl is not None:
            (tmp_path / "own.mtl").write_text(mtl)
        (tmp_path / "m.obj").write_bytes(text.encode("latin-1"))
        return tmp_path / "m.obj"

    return write


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("mtllib one.mtl\nusemtl m\n" + SQUARE + FACES, [RED, GREEN]),
        # A lone material needs no usemtl.
        ("mtllib one.mtl\n" + SQUARE + FACES, [RED, GREEN]),
        ("mtllib two.mtl\n" + SQUARE + "usemtl b\nf 1 2 3\nusemtl a\nf 1/1 3/3 4/4\n", [RED, (0, 0, 255)]),
        # Two libraries, on two lines or one; a second definition of b would be refused.
        ("mtllib one.mtl\nmtllib b.mtl\n" + SQUARE + "usemtl b\nf 1/1 2/2 3/3\nusemtl m\nf 1/1 3/3 4/4\n", [RED, BLUE]),
        ("mtllib one.mtl b.mtl\n" + SQUARE + "usemtl b\nf 1/1 2/2 3/3\nusemtl m\nf 1/1 3/3 4/4\n", [RED, BLUE]),
        ("mtllib my lib.mtl\nusemtl my stone\n" + SQUARE + FACES, [BLUE, BLUE]),
        ("mtllib windows.mtl\r\nusemtl m\r\n" + (SQUARE + FACES).replace("\n", "\r\n"), [RED, GREEN]),
        ("mtllib one.mtl\nusemtl m\n" + SQUARE + "f -4/-4 -3/-3 -2/-2 -1/-1\nv 9 9 9\nvt 5 5\n", [RED, GREEN]),
        ("mtllib one.mtl\nusemtl m\nvn 0 0 1\n" + SQUARE + "f 1/1/1 2/2/1 3/3/1 \\\n4/4/1 # quad\n", [RED, GREEN]),
        ("mtllib one.mtl\nusemtl m\n" + SQUARE + "f 1/1 2/2/1 3/3\ng\nf 1/1/1 3/3 4/4\nvn 0 0 1\n", [RED, GREEN]),
        # Latin-1 in a comment and in a group, and a byte order mark.
        ("\xef\xbb\xbfmtllib one.mtl\nusemtl m\n# Zo\xeb\ng Stra\xdfe\n" + SQUARE + FACES, [RED, GREEN]),
        (re.sub(r"(v .*)", r"\1 1.0 0.0 0.0", SQUARE) + "f 1 2 3 4\n", [(255, 0, 0), (255, 0, 0)]),
        (re.sub(r"(v .*)", r"\1 10 20 30", SQUARE) + "f 1 2 3 4\n", [(10, 20, 30), (10, 20, 30)]),
        ("mtllib one.mtl\nusemtl m\n" + SQUARE + "f 1/1/ 2/2/ 3/3/ 4/4/\n", [RED, GREEN]),
        (SQUARE + "f 1//1 2//1 3//1 4//1\n", [(102, 102, 102), (102, 102, 102)]),
        ("mtllib plain.mtl\nusemtl m\n" + SQUARE + FACES, [(51, 102, 204), (51, 102, 204)]),
    ],
)
def test_obj_shows_the_materials_that_it_names(obj, text, shown):
    parts = load(obj(text))
    assert [at(parts, point) for point in ((-0.5, 0.6), (0.6, 0.4 if shown[1] == GREEN else -0.6))] == shown


OWN = "mtllib own.mtl\nusemtl m\n"


@pytest.mark.parametrize(
    ("text", "mtl", "words"),
    [
        ("mtllib one.mtl\nusemtl other\n", None, "uses the material 'other', but its library one.mtl has 'm'"),
        ("mtllib one.mtl\nusemtl M\n", None, "uses the material 'M', but its library one.mtl has 'm'"),
        ("usemtl m\n", None, "uses the material 'm', but it has no mtllib line"),
        (OWN, "# none\n", "but its library own.mtl has no material"),
        ("mtllib two.mtl\n", None, "has faces before any usemtl, and its library has 2 materials"),
        ("mtllib gone.mtl\nusemtl m\n", None, "names 'gone.mtl', which does not exist; put it beside the mesh"),
        (
            OWN,
            "newmtl m\nmap_Kd C:\\a\\gone.png\n",
            "put it beside the mesh and name it without",
        ),
        (OWN, "newmtl m\nmap_Kd ../t.png\n", "is outside the scene's folder"),
        (OWN, "newmtl m\nmap_Kd -s 2 2 1 t.png\n", "option -s 2 2 1, which is not supported"),
        (OWN, "newmtl m\nmap_Kd -o 0.5 t.png\n", "option -o 0.5, which is not supported"),
        (
            OWN,
            "newmtl m\nmap_Kd -mm 0.1 2 t.png\n",
            "option -mm 0.1 2, which is not supported",
        ),
        (OWN, "newmtl m\nmap_Kd -imfchan r t.png\n", "option -imfchan r, which is not"),
        (OWN, "newmtl m\nmap_Kd\n", "has map_Kd without a file"),
        (OWN, "newmtl m\nmap_Kd t.png\nmap_d t.png\n", "has holes by its map_d"),
        (OWN, "newmtl m\nKd spectral file.rfl\n", "has Kd spectral file.rfl; give red"),
        (OWN, "newmtl m\nKd 1 0 0\nnewmtl m\nKd 0 1 0\n", "two materials 'm'"),
        ("surf 0 1 0 1 1 2\n", None, "cannot be read as a mesh (line 1 begins with 'surf')"),
        ("usemap t.png\n", None, "cannot be read as a mesh (line 1 begins with 'usemap')"),
        (OWN, "newmtl m\nmap_Kd no such.png\n", "names 'no such.png', which does not exist"),
        (OWN, "newmtl m\nmap_Kd broken.png\n", "the texture 'broken.png' cannot be read"),
        (OWN, "newmtl m\nmap_Kd deep.png\n", "a single band of more than 8 bits"),
        (OWN, "newmtl m\nmap_Kd program.eps\n", "the texture 'program.eps' cannot be read (it is EPS)"),
        ("mtllib one.mtl\nmtllib windows.mtl\nusemtl m\n", None, "libraries have two materials 'm'"),
        ("mtllib " + 300 * "x" + "\n", None, "which cannot be read (File name too long)"),
        ("mtllib one.mtl\n" + SQUARE + "f 1 2 3\nf 1 3 4\n", None, "has a texture but no map coordinates"),
        ("mtllib one.mtl\n" + SQUARE.replace("vt 0", "vt nan") + FACES, None, "a map coordinate that is not finite"),
        ("mtllib one.mtl\n" + SQUARE.replace("vt 1 1", "vt 9e8 1") + FACES, None, "repeats of"),
        (SQUARE, None, "holds no triangles"),
        ("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", None, "holds no triangles of any area"),
        (SQUARE + "f 1 2 30\n", None, "cannot be read as a mesh"),
        (SQUARE + "f 1 2 0\n", None, "has a face with a corner of number 0"),
        (SQUARE + "f 0/1 2/1 3/1\n", None, "has a face with a corner of number 0"),
        (SQUARE + "v 1e300 0 0\nf 1 2 5\n", None, "a vertex that is not finite or is more than 100 km from its origin"),
        (SQUARE + "v .5 1 0\nv .5 0 0\nv -.5 0 0\nv -.5 1 0\nf 1 2 3 5 6 7 8 4\n", None, "has a concave polygon"),
    ],
)
def test_what_cannot_be_read_of_an_obj_is_refused(obj, text, mtl, words):
    refused(obj(text if "v " in text else text + SQUARE + FACES, mtl), "m.obj", words)


def test_non_planar_and_concave_polygons_are_accepted(obj):
    def faces(text):
        (part,) = load(obj("v -8 -8 0\nv 8 -8 0\nv 8 8 0\nv -8 8 0\n" + text))
        a, b, c = np.moveaxis(part.vertices[part.faces].astype(np.float64), 1, 0)
        return 0.5 * np.cross(b - a, c - a)[:, 2]

    assert np.isclose(faces("v 0 12 0\nf 1 2 3 5 4\n").sum(), 16.0**2 + 32.0, rtol=1e-6)
    # Concave polygons that triangles from one of their corners cover.
    for text, area in (
        ("v 4 -4 0\nf 5 1 2 3\n", 64.0), ("v 4 -4 0\nf 3 5 1 2\n", 64.0), ("v 0 -6 0\nf 1 2 3 5 4\n", 144.0),
        ("v 0 -6 0\nf -5 -4 -3 \\\n-1 -2\n", 144.0),
    ):  # fmt: skip
        assert np.isclose(np.abs(faces(text)).sum(), area, rtol=1e-6)


def test_faces_without_map_coordinates_and_clamped_textures_are_refused(obj):
    refused(obj("mtllib one.mtl\n" + SQUARE + "f 1/1 2/2 3/3\nf 1 3 4\n"), "has a texture but no map coordinates")
    clamped = "newmtl m\nmap_Kd -clamp on t.png\n"
    assert len(load(obj("mtllib own.mtl\n" + SQUARE + FACES, clamped))) == 1
    beyond = SQUARE.replace("vt 1 1", "vt 3 1")
    refused(obj("mtllib own.mtl\n" + beyond + FACES, clamped), "texture 't.png' is clamped or mirrored at its edge")
    weighted = SQUARE.replace("v 1 1 0", "v 1 1 0 2").replace("v -", "v  -")
    refused(obj(weighted + FACES), "its vertices do not all have x, y, z")
    refused(obj(re.sub(r"(v .*)", r"\1 2", SQUARE) + FACES), "has vertices with a weight other than 1")
    refused(obj(SQUARE + "f 1/1 2/2 3/5\n"), "a face names a vertex or map coordinates that it does not have")
    refused(obj(SQUARE + "f -5 1 2\n"), "a face names a vertex or map coordinates that it does not have")


# --- PLY --------------------------------------------------------------------------------------------------------

VERTICES = [("x", "f"), ("y", "f"), ("z", "f")]
CORNERS = [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]
BY_FACE = [("vertex_indices", "Bi"), ("texcoord", "Bf"), ("texnumber", "i")]
TRIANGLES = [([0, 1, 2], [0, 0, 1, 0, 1, 1], 0), ([0, 2, 3], [0, 0, 1, 1, 0, 1], 1)]


def ply(path, form, vertices, rows, faces, face_rows, comments=(), more=""):
    """Write a PLY with struct; a property's kind is a struct letter, or two for a list: of its length and values."""
    lines = ["ply", f"format {form} 1.0", *(f"comment {text}" for text in comments)]
    order, body = {"ascii": None, "binary_little_endian": "<", "binary_big_endian": ">"}[form], b""
    for name, kinds, table in (("vertex", vertices, rows), ("face", faces, face_rows)):
        lines.append(f"element {name} {len(table)}")
        for column, kind in kinds:
            words = "list " * (len(kind) > 1) + " ".join(LETTERS[letter] for letter in kind)
            lines.append(f"property {words} {column}")
        for row in table:
            for (_, kind), value in zip(kinds, row, strict=True):
                numbers = [len(value), *value] if len(kind) > 1 else [value]
                if order is None:
                    body += (" ".join(map(str, numbers)) + " ").encode()
                else:
                    letters = kind[0] + kind[1:] * (len(numbers) - 1)
                    body += struct.pack(order + letters, *numbers)
            body += b"" if order else b"\n"
    path.write_bytes("\n".join([*lines, *more.splitlines(), "end_header\n"]).encode() + body)
    return path


@pytest.fixture
def images(tmp_path):
    (tmp_path / "t.png").write_bytes(png(QUARTERS))
    (tmp_path / "t two.png").write_bytes(plain(BLUE))
    return tmp_path


FORMS = ("ascii", "binary_little_endian", "binary_big_endian")
BOTH = ("TextureFile t.png", "TextureFile t two.png")


@pytest.mark.parametrize("form", FORMS)
def test_each_texture_of_a_ply_is_on_its_own_faces(images, form):
    path = images / "m.ply"
    parts = load(ply(path, form, VERTICES, CORNERS, BY_FACE, TRIANGLES, BOTH))
    assert [part.colour.shape for part in parts] == [(16, 16, 3), (4, 4, 3)]
    # The lower right triangle shows the first texture, the upper left the second.
    assert [at(parts, point) for point in ((-0.4, -0.6), (0.6, -0.4), (0.6, 0.4), (-0.5, 0.6))] == [
        BLUE,
        WHITE,
        GREEN,
        BLUE,
    ]
    # A polygon and a triangle: lists of different lengths.
    corners = [*CORNERS, (5, 0, 0)]
    faces = [([0, 1, 2, 3], [0, 0, 1, 0, 1, 1, 0, 1], 0), ([1, 4, 2], [0, 0, 1, 0, 1, 1], 1)]
    parts = load(ply(path, form, VERTICES, corners, BY_FACE, faces, BOTH))
    shown = [at(parts, point) for point in ((-0.5, 0.6), (0.5, 0.4), (-0.5, -0.6), (0.5, -0.4), (2, 0.1))]
    assert shown == [RED, GREEN, BLUE, WHITE, BLUE]
    # Map coordinates by vertex.
    by_vertex = [*VERTICES, ("s", "f"), ("t", "d")]
    rows = [(*corner, (corner[0] + 1) / 2, (corner[1] + 1) / 2) for corner in CORNERS]
    face = [([0, 1, 2, 3],)]
    parts = load(ply(path, form, by_vertex, rows, [("vertex_index", "Hh")], face, ("TextureFile t.png",)))
    assert [at(parts, point) for point in ((-0.5, 0.6), (0.5, 0.4), (-0.5, -0.6), (0.5, -0.4))] == shown[:4]


@pytest.mark.parametrize("form", FORMS)
def test_colours_of_a_ply(images, form):
    path, triangle = images / "m.ply", [("vertex_indices", "Bi")]
    for letter, colour in (
        ("B", (10, 20, 30)),
        ("f", (10 / 255, 20 / 255, 30 / 255)),
        ("B", (1, 0, 1)),
        ("f", (1, 1, 1)),
    ):
        columns = [*VERTICES, *((name, letter) for name in ("red", "green", "blue"))]
        path = ply(path, form, columns, [(*corner, *colour) for corner in CORNERS], triangle, [([0, 1, 2],)])
        expected = np.rint(np.array(colour) * (255 if letter == "f" else 1))
        assert load(path)[0].colour.tolist() == [[expected.tolist()]]
    rows = [(*corner, 10 * k, 0, 0) for k, corner in enumerate(CORNERS)]
    # Different colours by vertex: each face has the mean of their light.
    (part,) = load(ply(path, form, columns, rows, triangle, [([0, 1, 2],)]))
    light = linear_from_bytes(np.array([[10 * k, 0, 0] for k in range(3)], np.uint8)).mean(axis=0)
    assert part.colour.tolist() == [[bytes_from_linear(light).tolist()]]
    of_faces = [*triangle, ("red", "B"), ("green", "B"), ("blue", "B")]
    (part,) = load(ply(path, form, VERTICES, CORNERS, of_faces, [([0, 1, 2], 1, 2, 3), ([0, 2, 3], 9, 2, 3)]))
    assert part.colour.tolist() == [[[1, 2, 3], [9, 2, 3]]]


@pytest.mark.parametrize(
    ("faces", "rows", "comments", "more", "words"),
    [
        (BY_FACE[:2], [row[:2] for row in TRIANGLES], BOTH, "", "but its faces have no texnumber that chooses one"),
        (BY_FACE, [TRIANGLES[0], (*TRIANGLES[1][:2], 2)], BOTH, "", "has a face with texnumber 2"),
        (BY_FACE, [TRIANGLES[0], (*TRIANGLES[1][:2], -1)], BOTH, "", "has a face with texnumber -1"),
        (
            BY_FACE,
            [TRIANGLES[0], ([0, 2, 3], [0, 0, 1, 1], 1)],
            BOTH,
            "",
            "a face of 3 corners with 4 numbers in its tex",
        ),
        (BY_FACE[:1], [([0, 1, 2],)], BOTH[:1], "", "has a texture but no map coordinates for it"),
        (BY_FACE, TRIANGLES, ("TextureFile gone.png", BOTH[1]), "", "names 'gone.png', which does not exist"),
        (BY_FACE, TRIANGLES, BOTH, "element tristrips 1\nproperty list int int vertex_indices", "element 'tristrips'"),
        (BY_FACE[:1], [([0, 1, 4],)], (), "", "a face names a vertex that it does not have"),
        (BY_FACE[:1], [([0, 1, 2],)], (), "element edge 9\nproperty int a", "it ends early"),
        ([("corners", "Bi")], [([0, 1, 2],)], (), "", "has faces without the list vertex_indices"),
        (BY_FACE[:1], [], (), "", "holds no triangles"),
    ],
)
@pytest.mark.parametrize("form", FORMS)
def test_what_a_ply_does_not_say_is_refused(images, form, faces, rows, comments, more, words):
    refused(ply(images / "m.ply", form, VERTICES, CORNERS, faces, rows, comments, more), "m.ply", words)


@pytest.mark.parametrize("form", FORMS)
def test_a_ply_of_more_than_its_header_states_is_refused(images, form):
    path = ply(images / "m.ply", form, VERTICES, CORNERS, BY_FACE[:1], [([0, 1, 2],), ([0, 2, 3],)])
    assert len(load(path)[0].faces) == 2
    path.write_bytes(path.read_bytes().replace(b"element face 2", b"element face 1"))
    refused(path, "4 numbers more than its header" if form == "ascii" else "13 bytes more than its header")


# --- scenes -----------------------------------------------------------------------------------------------------


def test_two_textures_of_a_mesh_have_their_own_temperatures(images):
    ply(images / "m.ply", "ascii", VERTICES, CORNERS, BY_FACE, TRIANGLES, BOTH)
    (images / "scene.toml").write_text(
        '[terrain]\nmesh = "m.ply"\n[temperature]\nsource = "learned"\nmodel = "fok-1to1"\n'
        '[emissivity]\nsource = "constant"\nvalue = 1.0\n[sky]\ntemperature = 255.0\n'
    )
    first, second = load_scene(images).surfaces
    # The same colour has the same temperature on both.
    np.testing.assert_allclose(second.temperature, first.temperature[12, 2], atol=1e-3)
    assert np.ptp(first.temperature) > 10.0


@pytest.mark.parametrize(("name", "data", "words"), [
    ("a.off", b"OFF\n3 4\n0.1 0.2 0.3\n0.2 0.3 0.4\n0.3 0.4 0.5\n0\n220\n4\n", "a.off cannot be read as a mesh"),
    ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n".encode("utf-16"), "holds zero bytes.; give .*, OBJ as UTF-8 text"),
])  # fmt: skip
def test_damaged_and_foreign_texts_are_refused_in_one_line(tmp_path, name, data, words):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(ThermorenderError, match=words) as raised:
        load(tmp_path / name)
    assert "\n" not in str(raised.value)
