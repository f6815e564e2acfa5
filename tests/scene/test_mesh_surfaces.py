"""Surfaces of a mesh: their own materials, class rasters and temperatures; colours by vertex; the size of texels."""

import json

import numpy as np
import pytest
from PIL import Image

import thermorender as tr
from scenes import WEATHER, write_raster
from thermorender.errors import ThermorenderError
from thermorender.learned.apply import kinetic_from_map
from thermorender.learned.temperature_map import Inputs, load_model
from thermorender.physics.srgb import bytes_from_linear, linear_from_bytes
from thermorender.scene.material_map import write_map
from thermorender.scene.meshes.mesh import load
from thermorender.scene.spec import EmissivitySpec
from thermorender.scene.surface import FALLBACK, FILLED, UNKNOWN

FRAME = "[frame]\nlatitude_deg = 52.0\nlongitude_deg = 20.0\nheight_m = 100.0\n"
# A square of 20 m with a texture of 16 × 8 texels, in two objects; and a triangle of one colour.
OBJ = (
    "mtllib m.mtl\nv 0 0 0\nv 20 0 0\nv 20 20 0\nv 0 20 0\nv 5 5 3\nv 9 5 3\nv 9 9 3\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
    "usemtl ground\no south\nf 1/1 2/2 3/3\no north\nf 1/1 3/3 4/4\no roof\nusemtl tiles\nf 5 6 7\n"
)


@pytest.fixture
def folder(tmp_path):
    """A mesh whose texture is green in its upper half and grey in its lower one."""
    picture = np.full((16, 8, 3), (120, 120, 125), np.uint8)
    picture[:8] = (60, 110, 40)
    Image.fromarray(picture).save(tmp_path / "t.png")
    (tmp_path / "m.mtl").write_text("newmtl ground\nmap_Kd t.png\nnewmtl tiles\nKd 0.6 0.2 0.1\n")
    (tmp_path / "m.obj").write_text(OBJ)
    numbers = np.ones((16, 8), np.uint8)
    numbers[8:] = 2
    Image.fromarray(numbers).save(tmp_path / "classes.png")
    kelvin = np.full((1, 16, 8), 290.0, np.float32)
    kelvin[:, 8:] = 305.0
    write_raster(tmp_path / "kelvin.tif", kelvin, nodata=np.nan)
    return tmp_path


CLASSES = '[emissivity.classes]\n1 = "grass_green"\n2 = "asphalt"\n'
ROOF = '[[surface]]\nname = "tiles"\nmaterial = "roof_tile_clay"\ntemperature = 310.0\n'


def scene(folder, emissivity='source = "constant"\nvalue = 0.9', temperature='source = "constant"\nvalue = 290.0',
          more="", mesh="m.obj"):  # fmt: skip
    (folder / "scene.toml").write_text(
        f'[terrain]\nmesh = "{mesh}"\n[temperature]\n{temperature}\n[emissivity]\n{emissivity}\n'
        f"[sky]\ntemperature = 255.0\n{more}",
        encoding="utf-8",
    )
    return tr.load_scene(folder)


def names(of, surface):
    """Names of the materials of a surface's texels, (h, w)."""
    return np.array([material.name for material in of.materials])[surface.material]


def test_a_surface_has_its_own_material_and_temperature(folder):
    found = scene(folder, more=ROOF)
    ground, roof = found.surfaces
    assert found.main_surface is ground
    assert set(names(found, ground).flat) == {"constant"} and (ground.temperature == 290.0).all()
    assert set(names(found, roof).flat) == {"roof_tile_clay"} and (roof.temperature == 310.0).all()
    for one in ("m:tiles", "tiles", "roof"):
        again = scene(folder, more=ROOF.replace('"tiles"', f'"{one}"'))
        assert (again.surfaces[1].temperature == 310.0).all()


def test_a_named_part_of_one_texture_gets_its_own_texels(folder):
    found = scene(folder, more='[[surface]]\nname = "north"\ntemperature = 280.0\n')
    assert [len(surface.faces) > 0 for surface in found.surfaces] == [True] * 3
    assert sorted(float(surface.temperature.mean()) for surface in found.surfaces) == [280.0, 290.0, 290.0]
    cold = next(surface for surface in found.surfaces if surface.temperature.mean() == 280.0)
    # The upper left triangle of the square.
    assert (cold.vertices[cold.faces][..., 0] <= cold.vertices[cold.faces][..., 1] + 1e-9).all()


@pytest.mark.parametrize("by", ["emissivity", "surface"])
def test_class_numbers_lie_on_the_texture_as_its_picture_does(folder, by):
    if by == "emissivity":
        found = scene(folder, f'source = "classes"\nraster = "classes.png"\n{CLASSES}', more=ROOF)
    else:
        own = '[[surface]]\nname = "t.png"\nclasses = "classes.png"\n'
        found = scene(folder, f'source = "material"\nmaterial = "soil_loam"\n{CLASSES}', more=own + ROOF)
    ground = found.surfaces[0]
    assert set(names(found, ground)[:8].flat) == {"grass_green"}
    assert set(names(found, ground)[8:].flat) == {"asphalt"}
    np.testing.assert_array_equal(ground.colour[:8], np.full((8, 8, 3), (60, 110, 40)))
    # Replaced by class number, as on a map.
    changed = found.with_material({2: "sand_quartz"})
    assert set(names(changed, changed.surfaces[0])[8:].flat) == {"sand_quartz"}


def test_class_numbers_repeat_with_their_texture(folder):
    (folder / "m.obj").write_text(OBJ.replace("vt 1 0\nvt 1 1\n", "vt 2 0\nvt 2 1\n"))
    found = scene(folder, f'source = "classes"\nraster = "classes.png"\n{CLASSES}', more=ROOF)
    ground = found.surfaces[0]
    assert ground.material.shape == (16, 16)
    assert set(names(found, ground)[8:].flat) == {"asphalt"} and set(names(found, ground)[:8].flat) == {"grass_green"}


def test_open_texels_count_where_faces_show_them(folder):
    numbers = np.array(Image.open(folder / "classes.png"))
    # Faces use the left half of the texture alone.
    (folder / "m.obj").write_text(OBJ.replace("vt 1 0\nvt 1 1\n", "vt 0.45 0\nvt 0.45 1\n"))
    numbers[:, 5:] = 0
    Image.fromarray(numbers).save(folder / "classes.png")
    of = f'source = "classes"\nraster = "classes.png"\n{CLASSES}'
    ground = scene(folder, of, more=ROOF).surfaces[0]
    assert not (ground.flags[:, :4] & FILLED).any()
    numbers[:4] = 0
    Image.fromarray(numbers).save(folder / "classes.png")
    with pytest.raises(ThermorenderError, match=r"leaves 25.0% of the terrain .* or name .* emissivity.fallback"):
        scene(folder, of, more=ROOF)
    found = scene(folder, of.replace("[emis", 'fallback = "soil_loam"\n[emis'), more=ROOF)
    assert set(names(found, found.surfaces[0])[:4, :4].flat) == {"soil_loam"}
    assert (found.surfaces[0].flags[:4, :4] & UNKNOWN).all() and not (found.surfaces[0].flags[4:] & UNKNOWN).any()


def test_materials_are_learned_from_the_texture_at_its_size_on_the_ground(folder):
    (folder / "m.obj").write_text(OBJ.replace("20", "10"))
    learned = EmissivitySpec("learned", model="procedural", fallback="soil_loam", confidence=0.01)
    found = scene(folder, more=ROOF).with_learned_materials(learned)
    ground, roof = found.surfaces
    # 10 m across 8 and 16 texels.
    assert found.emissivity_report["texel_m"] == ground.texel_m == pytest.approx(10.0 / np.sqrt(128.0), rel=1e-6)
    assert set(names(found, roof).flat) == {"roof_tile_clay"}
    assert len(np.unique(ground.material)) > 1
    # A part without texture has the fallback, flagged.
    bare = scene(folder).with_learned_materials(learned).surfaces[1]
    assert (bare.flags & UNKNOWN).all()


TILES = """mtllib tiles.mtl
v 0 0 0
v 20 0 0
v 20 20 0
v 0 20 0
v 40 0 0
v 40 20 0
vt 0 0
vt 1 0
vt 1 1
vt 0 1
usemtl west
f 1/1 2/2 3/3 4/4
usemtl east
f 2/1 5/2 6/3 3/4
"""


def test_two_textures_of_a_mesh_share_learned_materials(folder):
    """The west is grass with sand in its north, the east is water; each texture has its own size."""
    green, sand, deep = (70, 110, 50), (225, 212, 190), (45, 60, 62)
    random = np.random.default_rng(1)
    west = np.full((40, 40, 3), green) + random.normal(0.0, 12.0, (40, 40, 1))
    west[:16] = np.array(sand) + random.normal(0.0, 3.0, (16, 40, 1))
    east = np.full((80, 80, 3), deep) + random.normal(0.0, 0.5, (80, 80, 1))
    for name, picture in (("west", west), ("east", east)):
        Image.fromarray(np.clip(picture, 0, 255).astype(np.uint8)).save(folder / f"{name}.png")
    (folder / "m.obj").write_text(TILES)
    (folder / "tiles.mtl").write_text("newmtl west\nmap_Kd west.png\nnewmtl east\nmap_Kd east.png\n")
    learned = 'source = "learned"\nmodel = "procedural"\nfallback = "soil_loam"\n'
    found = scene(folder, learned)
    first, second = found.surfaces
    assert (first.texel_m, second.texel_m) == pytest.approx((0.5, 0.25), rel=1e-6)
    mean = np.array([one.band_emissivity(7.5, 13.5, 300.0) for one in found.materials])
    own = [mean[each.material] for each in (first, second)]
    # Sand at the top of its texture, which lies in the north; numbers and mixes are of both textures together.
    assert own[0][:12].mean() < own[0][24:].mean() - 0.01 and own[1].std() < 0.01
    Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(folder / "east.png")
    with pytest.raises(ThermorenderError, match=r"texture of surface 'm:east' has texels of 5 m, but emissivity"):
        scene(folder, learned)
    with pytest.raises(ThermorenderError, match=r"emissivity\.known lies on a map, and this mesh has no place on it"):
        scene(folder, learned + 'known = "m.obj"\n')


def test_temperatures_of_a_raster_lie_on_the_texture(folder):
    own = '[[surface]]\nname = "ground"\ntemperature = "kelvin.tif"\n'
    for found in (
        scene(folder, more=own),
        scene(folder, temperature='source = "raster"\nraster = "kelvin.tif"', more=ROOF),
    ):
        ground = found.surfaces[0]
        assert (ground.temperature[:8] == 290.0).all() and (ground.temperature[8:] == 305.0).all()
        assert not (ground.flags & FALLBACK).any()


def test_edits_name_the_same_parts(folder):
    start = scene(folder, more=ROOF)
    found = start.with_material({"ground": "asphalt"}).with_temperature({"tiles": "77 K", "t.png": 280.0})
    ground, roof = found.surfaces
    assert set(names(found, ground).flat) == {"asphalt"} and set(names(found, roof).flat) == {"roof_tile_clay"}
    assert (ground.temperature == 280.0).all() and (roof.temperature == 77.0).all()
    raster = start.with_temperature({"ground": folder / "kelvin.tif"})
    assert float(np.ptp(raster.surfaces[0].temperature)) == 15.0
    # One source for all texels replaces those of parts.
    assert all((surface.temperature == 300.0).all() for surface in found.with_temperature(300.0).surfaces)
    again = found.with_material(tiles=0.5, ground="sand_quartz")
    assert [set(names(again, surface).flat) for surface in again.surfaces] == [{"sand_quartz"}, {"tiles"}]


def test_an_edit_of_a_group_of_an_obj_needs_its_name_in_the_scene_file(folder):
    start = scene(folder, more=ROOF)
    for edit in (start.with_material, start.with_temperature):
        with pytest.raises(ThermorenderError, match=r"group of an OBJ once a \[\[surface\]\] of scene.toml"):
            edit({"roof": 0.5 if edit == start.with_material else 300.0})
    # The advice works.
    named = scene(folder, more=ROOF.replace('"tiles"', '"roof"'))
    assert (named.with_temperature({"roof": 300.0}).surfaces[1].temperature == 300.0).all()
    assert "roof" in names(named.with_material(roof=0.5), named.with_material(roof=0.5).surfaces[1])


BALANCE = 'source = "balance"'


def test_texels_by_number_are_painted_on_every_surface_without_a_place_on_a_map(folder):
    before = scene(folder, f'source = "material"\nmaterial = "soil_loam"\n{CLASSES}',
                   more='[[surface]]\nname = "t.png"\nclasses = "classes.png"\n' + ROOF)  # fmt: skip
    ground, roof = before.surfaces
    assert before.class_files == (folder / "classes.png", None)
    count = ground.material.size
    painted = before.with_material_at([3, count - 1, count], "snow")
    found = np.concatenate([names(painted, surface).ravel() for surface in painted.surfaces])
    wanted = np.concatenate([names(before, surface).ravel() for surface in before.surfaces])
    wanted[[3, count - 1, count]] = "snow"
    np.testing.assert_array_equal(found, wanted)
    assert roof.material.size == 1
    np.testing.assert_array_equal(painted.surfaces[0].colour, ground.colour)


CLASS = 'source = "classes"\n'
REFUSED = {
    "surface 'tile' is not a node, group, material or texture of the mesh; did you mean 'tiles'? it has m:ground:":
        {"more": ROOF.replace("tiles", "tile")},
    "surface 'tiles' and surface 'm:tiles' are the same triangles of 'm:tiles'; leave one of the two out":
        {"more": ROOF + ROOF.replace("tiles", "m:tiles")},
    "surface 'tiles' states nothing; give material, classes, temperature or inferred":
        {"more": '[[surface]]\nname = "tiles"\n'},
    "surface 'tiles' has both material and classes; give one of them":
        {"more": ROOF + 'classes = "classes.png"\n'},
    "surface.classes needs the materials of its numbers; add [emissivity.classes]":
        {"more": '[[surface]]\nname = "ground"\nclasses = "classes.png"\n'},
    "surface 'm:tiles', which has no texture that it could lie on; give that surface one material":
        {"emissivity": 'source = "constant"\nvalue = 0.9\n' + CLASSES,
         "more": '[[surface]]\nname = "tiles"\nclasses = "classes.png"\n'},
    "has 8×16 pixels, and the texture of surface 'm:ground' has 4×4; give a raster in the pixels of that texture":
        {"emissivity": f'{CLASS}raster = "classes.png"\nfallback = "soil_loam"\n{CLASSES}'},
    "surface 'm:tiles' has no class raster; give it classes or a material in a [[surface]], or name the material of":
        {"emissivity": f'{CLASS}raster = "classes.png"\n{CLASSES}'},
    "temperature.raster is in the pixels of one texture, and the mesh has 2 surfaces without another temperature":
        {"temperature": 'source = "raster"\nraster = "kelvin.tif"'},
    "surface 'tiles' has temperature=310.0, and the others follow the weather, which is not supported; leave it out":
        {"temperature": BALANCE, "more": ROOF + FRAME + WEATHER},
}  # fmt: skip


@pytest.mark.parametrize("words", REFUSED)
def test_what_a_surface_cannot_be_is_refused_in_one_sentence(folder, words):
    if "4×4" in words:
        Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(folder / "t.png")
    with pytest.raises(ThermorenderError) as error:
        scene(folder, **REFUSED[words])
    assert words in str(error.value), str(error.value)


def test_two_textures_need_a_raster_each(folder):
    (folder / "m.mtl").write_text("newmtl ground\nmap_Kd t.png\nnewmtl tiles\nmap_Kd u.png\n")
    (folder / "m.obj").write_text(OBJ.replace("f 5 6 7", "f 5/1 6/2 7/3"))
    Image.fromarray(np.zeros((16, 8, 3), np.uint8)).save(folder / "u.png")
    with pytest.raises(
        ThermorenderError, match=r"2 textures without another material .* as classes in a \[\[surface\]\]"
    ):
        scene(folder, f'{CLASS}raster = "classes.png"\n{CLASSES}')
    both = "".join(f'[[surface]]\nname = "{name}"\nclasses = "classes.png"\n' for name in ("t.png", "u.png"))
    found = scene(folder, f"{CLASS}{CLASSES}", more=both)
    assert [set(names(found, surface)[8:].flat) for surface in found.surfaces] == [{"asphalt"}] * 2


def test_an_edit_of_a_part_of_shared_texels_says_what_to_do(folder):
    corners = [[0, 0, 0], [1, 0, 0], [0, 0, -1]]
    data = (
        np.array([*corners, [2, 0, 0], [3, 0, 0], [2, 0, -1]], "<f4").tobytes()
        + np.array([[0, 0], [1, 0], [0, 1]] * 2, "<f4").tobytes()
    )
    (folder / "m.bin").write_bytes(data)
    tree = {
        "asset": {"version": "2.0"}, "scenes": [{"nodes": [0, 1]}], "nodes": [{"mesh": 0, "name": "left"},
        {"mesh": 1, "name": "right"}], "buffers": [{"uri": "m.bin", "byteLength": len(data)}],
        "bufferViews": [{"buffer": 0, "byteOffset": at, "byteLength": size} for at, size in ((0, 72), (72, 48))],
        "accessors": [{"bufferView": 0, "byteOffset": 36 * k, "componentType": 5126, "count": 3, "type": "VEC3"}
                      for k in (0, 1)]
        + [{"bufferView": 1, "componentType": 5126, "count": 3, "type": "VEC2"}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": k, "TEXCOORD_0": 2}, "material": 0}]} for k in (0, 1)],
        "materials": [{"name": "paint", "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "textures": [{"source": 0}], "images": [{"uri": "t.png"}],
    }  # fmt: skip
    (folder / "m.gltf").write_text(json.dumps(tree))
    found = scene(folder, mesh="m.gltf")
    assert len(found.surfaces) == 1
    with pytest.raises(
        ThermorenderError, match=r"'left' shares the texels .* name it in a \[\[surface\]\] of scene.toml"
    ):
        found.with_material(left="asphalt")
    # The advice works.
    own = '[[surface]]\nname = "left"\nmaterial = "asphalt"\n'
    assert len(scene(folder, mesh="m.gltf", more=own).surfaces) == 2
    assert (scene(folder, mesh="m.gltf").with_temperature({"paint": 280.0}).surfaces[0].temperature == 280.0).all()


def test_maps_on_the_ground_say_what_a_mesh_has_instead(folder):
    found = scene(folder)
    with pytest.raises(ThermorenderError, match=r"is a mesh, .* give emissivity.source='learned' .* or class rasters"):
        write_map(folder, folder)
    with pytest.raises(ThermorenderError, match="or name a part of the mesh in with_material"):
        found.with_material_in([[0, 0], [5, 0], [5, 5]], "asphalt")


# --- colours by vertex --------------------------------------------------------------------------------------------

THREE = ((255, 0, 0), (0, 255, 0), (0, 0, 255))
MEAN = bytes_from_linear(np.full(3, 1.0 / 3.0)).tolist()


def coloured_obj(colours, scale=1.0, mtl=""):
    corner = ((0, 0, 0), (6, 0, 0), (6, 6, 0), (0, 6, 0))
    lines = [f"v {x} {y} {z} " + " ".join(f"{c * scale:g}" for c in rgb) for (x, y, z), rgb in
             zip(corner, colours, strict=True)]  # fmt: skip
    return mtl + "\n".join(lines) + "\nf 1 2 3\nf 1 3 4\n"


@pytest.mark.parametrize("scale", [1.0, 1.0 / 255.0])
def test_colours_by_vertex_are_the_photograph_of_each_face(tmp_path, scale):
    colours = (*THREE, (120, 60, 30))
    (tmp_path / "m.mtl").write_text("newmtl dark\nKd 0.1 0.1 0.1\n")
    for mtl in ("", "mtllib m.mtl\nusemtl dark\n"):
        (tmp_path / "m.obj").write_text(coloured_obj(colours, scale, mtl))
        (part,) = load(tmp_path / "m.obj")
        shown = [part.colour[int(v * part.colour.shape[0]), int(u * part.colour.shape[1])] for u, v in part.uv[:, 0]]
        # Light is averaged, not bytes.
        other = bytes_from_linear(linear_from_bytes(np.array([colours[k] for k in (0, 2, 3)], np.uint8)).mean(axis=0))
        np.testing.assert_array_equal(shown, [MEAN, other])
        assert (np.ptp(part.uv, axis=1) == 0.0).all()


def test_gltf_multiplies_linear_colours_by_vertex_and_factor(tmp_path):
    data = np.array([[0, 0, 0], [6, 0, 0], [0, 0, -6]], "<f4").tobytes() + np.array(THREE, "u1").tobytes()
    (tmp_path / "m.bin").write_bytes(data)
    tree = {
        "asset": {"version": "2.0"}, "nodes": [{"mesh": 0}], "buffers": [{"uri": "m.bin", "byteLength": len(data)}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}, {"buffer": 0, "byteOffset": 36, "byteLength": 9}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
                      {"bufferView": 1, "componentType": 5121, "normalized": True, "count": 3, "type": "VEC3"}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 1}, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": {"baseColorFactor": [1.0, 0.5, 0.25, 1.0]}}],
    }  # fmt: skip
    (tmp_path / "m.gltf").write_text(json.dumps(tree))
    (part,) = load(tmp_path / "m.gltf")
    expected = bytes_from_linear(np.array([1.0, 0.5, 0.25]) / 3.0)
    np.testing.assert_array_equal(part.colour, [[expected]])


@pytest.mark.parametrize("name", ["fok-1to1", "fok-9to1", "procedural-palette"])
def test_maps_see_a_face_of_one_colour_as_an_even_area(folder, name):
    (folder / "m.obj").write_text(coloured_obj((*THREE, (200, 100, 50))))
    made = scene(folder, temperature=f'source = "learned"\nmodel = "{name}"')
    (found,) = made.surfaces
    assert found.temperature.shape == (1, 2) and float(np.ptp(found.temperature)) > 0.5
    for colour, kelvin in zip(found.colour[0], found.temperature[0], strict=True):
        picture = np.ascontiguousarray(np.broadcast_to(colour, (9, 9, 3)))
        expected, *_ = kinetic_from_map(load_model(name), Inputs(picture), np.zeros((9, 9), np.uint8), made.materials)
        assert kelvin == pytest.approx(expected[4, 4], abs=1e-3)


def test_learned_materials_refuse_colours_without_a_picture(folder):
    (folder / "m.obj").write_text(coloured_obj((*THREE, (200, 100, 50))))
    with pytest.raises(ThermorenderError, match=r"reads materials from textures, and this mesh has none"):
        scene(folder, 'source = "learned"\nmodel = "procedural"\nfallback = "soil_loam"')


def test_the_true_temperatures_of_a_mesh_are_those_of_its_file(folder):
    raster = '[[surface]]\nname = "ground"\ntemperature = "kelvin.tif"\n'
    made = scene(folder, more=f"{raster}{ROOF}[truth]\ntemperature = true\n")
    guessed = made.with_temperature("fok-1to1").with_camera("boson-640")
    assert (guessed.surfaces[1].temperature != 310.0).all()
    for one, own in zip(guessed.with_true_temperature().surfaces, made.surfaces, strict=True):
        np.testing.assert_array_equal(one.temperature, own.temperature)
    with pytest.raises(ThermorenderError, match=r"truth.temperature=False .*true, where the temperatures of this file"):
        scene(folder, more="[truth]\ntemperature = false\n")


def test_a_map_reports_the_mean_of_all_surfaces(folder):
    found = scene(folder, temperature='source = "learned"\nmodel = "fok-1to1"')
    alone = scene(folder, temperature='source = "learned"\nmodel = "fok-1to1"', more=ROOF)
    both, ground = (each.temperature_state.report["fok-1to1"] for each in (found, alone))
    assert (both["texels"], ground["texels"]) == (129, 128)
    # The roof's one texel is outside the map's range, or inside it.
    of_roof = 129 * both["share_outside_0_1"] - 128 * ground["share_outside_0_1"]
    assert of_roof == pytest.approx(round(of_roof), abs=1e-9) and 0 <= round(of_roof) <= 1


def test_coloured_points_without_faces_are_refused(tmp_path):
    (tmp_path / "m.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
        "property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n0 0 0 1 2 3\n1 0 0 4 5 6\n"
    )
    with pytest.raises(ThermorenderError, match="holds no triangles of any area"):
        load(tmp_path / "m.ply")


def test_texels_that_no_face_shows_do_not_make_the_others_smaller(folder):
    # The square of 20 m shows an eighth of the texture: 4 × 4 of its 8 × 16 texels.
    (folder / "m.obj").write_text(OBJ.replace("vt 1 0\nvt 1 1\nvt 0 1", "vt 0.5 0\nvt 0.5 0.25\nvt 0 0.25"))
    ground, roof = scene(folder).surfaces
    assert ground.texel_m == pytest.approx(5.0)
    # 8 m² in one texel.
    assert roof.texel_m == pytest.approx(np.sqrt(8.0))
