"""Up, unit and sense of the faces of mesh files: the keys, and warnings on meshes that look as if they need them."""

import re
import warnings

import numpy as np
import pytest
import trimesh

import thermorender as tr
from scenes import plane, scene_object, write_mesh, write_terrain
from thermorender.errors import ThermorenderError, ThermorenderWarning
from thermorender.scene.surface import BEHIND

FORMATS = ("obj", "ply", "stl", "off", "glb")
CAR = trimesh.creation.box([1.8, 4.4, 1.4]).apply_translation([0.0, 0.0, 0.7])


def hills():
    """60 × 60 m of ground with 5 m of relief, faces up."""
    row, column = np.mgrid[:31, :31]
    height = 2.5 * np.sin(column / 4.0) * np.cos(row / 5.0)
    vertices = np.stack([2.0 * column - 30.0, 30.0 - 2.0 * row, height], axis=-1).reshape(-1, 3)
    a, b, c, d = (np.arange(31 * 31).reshape(31, 31)[rows, columns].ravel()
                  for rows in (slice(30), slice(1, 31)) for columns in (slice(30), slice(1, 31)))  # fmt: skip
    faces = np.concatenate([np.stack([a, c, d], axis=-1), np.stack([a, d, b], axis=-1)])
    return trimesh.Trimesh(vertices, faces, process=False)


def y_up(mesh):
    """A mesh with y up, as Blender exports it: −z forward."""
    turned = mesh.copy()
    turned.vertices = mesh.vertices[:, [0, 2, 1]] * [1.0, 1.0, -1.0]
    return turned


def inside_out(mesh):
    return trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1], process=False)


def write(folder, mesh, kind="obj", keys="", extra=""):
    """Write a scene of one mesh in a format, with keys of its [terrain]; return its folder."""
    write_mesh(folder, plane(1.0), extra=extra)
    mesh.export(folder / f"m.{kind}")
    text = (folder / "scene.toml").read_text()
    (folder / "scene.toml").write_text(text.replace('mesh = "mesh.ply"', f'mesh = "m.{kind}"\n{keys}'))
    return folder


def with_object(folder, mesh, kind="obj", **keys):
    """Write a scene of level ground and one mesh as an object; return its folder."""
    keys = {"position": [1.0, 2.0, 0.0], **keys}
    write_terrain(folder, height=np.full((64, 64), 100.0), extra=scene_object("car", file=f"car.{kind}", **keys))
    mesh.export(folder / f"car.{kind}")
    return folder


def triangles(folder, number=0):
    """Corners of a surface's triangles in an order that does not depend on the file's."""
    surface = tr.load_scene(folder).surfaces[number]
    corner = np.round(surface.vertices[surface.faces], 4)
    first = np.lexsort(np.moveaxis(corner, -1, 0)[::-1], axis=-1)[:, :1]
    corner = np.take_along_axis(corner, ((first + np.arange(3)) % 3)[..., None], axis=1)
    return corner[np.lexsort(corner.reshape(len(corner), -1).T)]


def doubts(folder):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        tr.load_scene(folder)
    assert all(issubclass(each.category, ThermorenderWarning) for each in caught)
    return [str(each.message) for each in caught]


def follow(folder, sentence, table):
    """Write the key that a warning advises into a table of the scene."""
    key = re.search(r'write ((?:up = "[yz]")|(?:flip = true)|(?:scale_to_m = [\d.]+))', sentence)[1]
    text = (folder / "scene.toml").read_text()
    (folder / "scene.toml").write_text(text.replace(table, f"{table}\n{key}", 1))


@pytest.mark.parametrize("kind", FORMATS)
def test_up_turns_a_mesh_of_the_other_axis(tmp_path, kind):
    right, other = (hills(), y_up(hills())) if kind != "glb" else (y_up(hills()), hills())
    key = 'up = "z"' if kind == "glb" else 'up = "y"'
    expected = triangles(write(tmp_path / "right", right, kind))
    assert np.allclose(expected[..., 2].min(), hills().vertices[:, 2].min(), atol=1e-3)
    assert np.allclose(triangles(write(tmp_path / "other", other, kind, key)), expected, atol=1e-3)
    own = 'up = "y"' if kind == "glb" else 'up = "z"'
    assert np.array_equal(triangles(write(tmp_path / "same", right, kind, own)), expected)


@pytest.mark.parametrize("kind", FORMATS)
def test_scale_and_flip_of_an_object(tmp_path, kind):
    car = CAR if kind != "glb" else y_up(CAR)
    expected = triangles(with_object(tmp_path / "right", car, kind), 1)
    small = inside_out(car.copy().apply_scale(100.0))
    found = triangles(with_object(tmp_path / "other", small, kind, scale_to_m=0.01, flip=True), 1)
    assert np.allclose(found, expected, atol=1e-3)


def test_flip_keeps_the_texture_in_its_place(tmp_path):
    (tmp_path / "m.mtl").write_text("newmtl paint\nmap_Kd t.png\n")
    from PIL import Image

    Image.fromarray(np.arange(48, dtype=np.uint8).reshape(4, 4, 3)).save(tmp_path / "t.png")
    head = "mtllib m.mtl\nv 0 0 0\nv 8 0 0\nv 0 8 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl paint\n"
    found = []
    for face, keys in (("f 1/1 2/2 3/3\n", ""), ("f 3/3 2/2 1/1\n", "flip = true")):
        folder = write(tmp_path, hills(), "obj", keys)
        (folder / "m.obj").write_text(head + face)
        (surface,) = tr.load_scene(folder).surfaces
        found.append({tuple(point): tuple(uv) for point, uv in
                      zip(surface.vertices[surface.faces[0]], surface.uv[0], strict=True)})  # fmt: skip
        a, b, c = surface.vertices[surface.faces[0]]
        assert np.cross(b - a, c - a)[2] > 0.0
    assert found[0] == found[1]


@pytest.mark.parametrize("kind", FORMATS)
def test_a_terrain_with_another_axis_up_is_named_and_the_advice_mends_it(tmp_path, kind):
    right, other = (hills(), y_up(hills())) if kind != "glb" else (y_up(hills()), hills())
    folder = write(tmp_path / "s", other, kind)
    (doubt,) = doubts(folder)
    assert f"m.{kind} is 4.99 m wide and 60 m high; it looks {'z' if kind == 'glb' else 'y'} up" in doubt
    follow(folder, doubt, "[terrain]")
    assert doubts(folder) == []
    assert np.allclose(triangles(folder), triangles(write(tmp_path / "t", right, kind)), atol=1e-3)


@pytest.mark.parametrize("kind", ["obj", "stl", "glb"])
def test_a_terrain_whose_faces_look_down_is_named_and_the_advice_mends_it(tmp_path, kind):
    ground = hills() if kind != "glb" else y_up(hills())
    folder = write(tmp_path / "s", inside_out(ground), kind)
    (doubt,) = doubts(folder)
    assert "faces that look down" in doubt
    follow(folder, doubt, "[terrain]")
    assert doubts(folder) == []
    frame = tr.Renderer(tr.load_scene(folder), quality="fast").frame(tr.pose(0, 0, 60, pitch_deg=-90))
    assert not (frame.truth["mask"] & BEHIND).any()
    wrong = write(tmp_path / "t", ground, kind, "flip = true")
    assert "leave out flip = true in [terrain]" in doubts(wrong)[0]


@pytest.mark.parametrize(
    ("change", "words", "keys"),
    [
        (lambda car: car.apply_scale(100.0), "is 440 m long; write scale_to_m = 0.01 in its table", {}),
        (lambda car: car.apply_scale(1000.0), "is 4400 m long; write scale_to_m = 0.001 in its table", {}),
        (y_up, 'has 2.2 m of its 4.4 m in the ground; it looks y up: write up = "y"', {}),
        (inside_out, "has faces that look inwards", {}),
        (lambda car: car.apply_scale(440.0), "write scale_to_m = 0.001", {"scale_to_m": 0.1}),
    ],
)
def test_an_object_in_another_frame_or_unit_is_named(tmp_path, change, words, keys):
    folder = with_object(tmp_path / "s", change(CAR.copy()), **keys)
    (doubt,) = doubts(folder)
    assert "object 'car'" in doubt and words in doubt
    if not keys:
        follow(folder, doubt, '[[object]]\nname = "car"')
        assert doubts(folder) == []
        assert np.allclose(triangles(folder, 1), triangles(with_object(tmp_path / "t", CAR), 1), atol=1e-3)


def test_a_level_sheet_whose_faces_look_down_is_named_and_the_advice_mends_it(tmp_path):
    sheet = trimesh.Trimesh([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], [[0, 2, 1], [0, 3, 2]])
    folder = with_object(tmp_path / "s", sheet)
    (doubt,) = doubts(folder)
    assert "has faces that look down, whose backs a camera sees; write flip = true" in doubt
    follow(folder, doubt, '[[object]]\nname = "car"')
    assert doubts(folder) == []


def test_an_object_larger_than_its_terrain_or_of_millimetres_is_named(tmp_path):
    long = trimesh.creation.box([2.0, 80.0, 2.0]).apply_translation([0, 0, 1])
    assert "is 80 m long, longer than the terrain of 63 m" in doubts(with_object(tmp_path / "s", long))[0]
    assert "is 4.4 mm long" in doubts(with_object(tmp_path / "t", CAR.copy().apply_scale(1e-3)))[0]


def test_an_object_whose_file_begins_below_its_foot_is_named_until_it_is_raised(tmp_path):
    centred = CAR.copy().apply_translation([0.0, 0.0, -0.7])
    (doubt,) = doubts(with_object(tmp_path / "s", centred))
    assert "has 0.7 m of its 1.4 m in the ground; its file begins below 0 m: raise it by 0.7 m" in doubt
    raised = with_object(tmp_path / "t", centred, position=[1.0, 2.0, 0.7])
    assert doubts(raised) == []
    assert np.allclose(triangles(raised, 1), triangles(with_object(tmp_path / "u", CAR), 1), atol=1e-6)


def test_copies_in_another_frame_are_named(tmp_path):
    tree = trimesh.creation.cone(1.5, 6.0)
    for name, body, words in (("right", tree, None), ("lying", y_up(tree), 'write up = "y"'),
                              ("large", tree.copy().apply_scale(100.0), "write scale_to_m = 0.01")):  # fmt: skip
        folder = with_object(tmp_path / name, body, position=[0.0, 0.0, 0.0], instances="places.csv")
        (folder / "places.csv").write_text("east_m,north_m,scale\n1,2,1\n3,4,0.9\n")
        found = doubts(folder)
        assert len(found) == (words is not None) and all(words in doubt for doubt in found)


def town():
    """Ground with two houses and a tower, closed from above only."""
    bodies = [trimesh.creation.box([10, 8, high]).apply_translation([east, 0, high / 2])
              for east, high in ((-15.0, 6.0), (0.0, 8.0), (18.0, 40.0))]  # fmt: skip
    return trimesh.util.concatenate([hills(), *bodies])


@pytest.mark.parametrize(
    "right", [hills(), town(), trimesh.creation.box([60, 60, 5]), inside_out(trimesh.creation.box([8, 6, 3]))]
)
def test_ground_a_town_a_block_and_a_room_are_not_doubted(tmp_path, right):
    assert doubts(write(tmp_path / "s", right)) == []


@pytest.mark.parametrize(
    "right",
    [
        CAR,
        trimesh.creation.cylinder(0.05, 3.0).apply_translation([0, 0, 1.5]),
        trimesh.creation.icosphere(radius=0.5).apply_translation([0, 0, 0.5]),
        hills().apply_scale(0.05).apply_translation([0, 0, 0.2]),
        trimesh.Trimesh([[0, 0, 0], [2, 0, 0], [2, 0, 2]], [[0, 1, 2]]),
    ],
)
def test_a_car_a_post_a_ball_a_mat_and_a_sheet_are_not_doubted(tmp_path, right):
    assert doubts(with_object(tmp_path / "s", right)) == []


def test_a_terrain_beyond_the_local_frame_is_read_with_its_unit(tmp_path):
    large = hills().apply_scale(1e4)
    with pytest.raises(ThermorenderError, match=r"more than 100 km from its origin; .* write scale_to_m"):
        tr.load_scene(write(tmp_path / "s", large))
    found = triangles(write(tmp_path / "t", large, keys="scale_to_m = 1e-4"))
    assert np.allclose(found, triangles(write(tmp_path / "u", hills())), atol=1e-3)
    assert "is 30000 m long; write scale_to_m" in doubts(write(tmp_path / "v", hills().apply_scale(500.0)))[0]


@pytest.mark.parametrize("key", ['up = "y"', "scale_to_m = 0.01", "flip = true"])
def test_the_keys_are_refused_without_a_mesh(tmp_path, key):
    folder = write_terrain(tmp_path / "s", extra=scene_object("box") + key)
    with pytest.raises(ThermorenderError, match=r"it with file only"):
        tr.load_scene(folder)
    text = (write_terrain(tmp_path / "t") / "scene.toml").read_text()
    (tmp_path / "t" / "scene.toml").write_text(text.replace("[terrain]", f"[terrain]\n{key}"))
    with pytest.raises(ThermorenderError, match=r"it with mesh only"):
        tr.load_scene(tmp_path / "t")


LOG = "time_s,east_m,north_m,above_ground_m,yaw_deg,pitch_deg,roll_deg\n0,-1,0,30,0,-90,0\n1,1,0,30,0,-90,0\n"


@pytest.mark.parametrize("flipped", [True, False])
def test_render_plan_and_fly_name_a_mesh_inside_out_and_the_share_of_backs(tmp_path, call, flipped):
    folder = write(tmp_path / "s", inside_out(hills()) if flipped else hills())
    (folder / "flight.csv").write_text(LOG)
    few = ("--quality", "fast", "--rays", 4)
    preview = ("fly", folder, "--preview", "--rate-hz", 1, "--products", "display", *few)
    for verb in (
        ("render", folder, "--pose", "0,0,60,0,-90,0", "--products", "display", "-o", tmp_path / "r", *few),
        ("plan", folder, *few),
        preview,
        ("fly", folder, "--rate-hz", 1, "--products", "display", "-o", tmp_path / "f", *few),
    ):
        with warnings.catch_warnings():
            warnings.simplefilter("always", ThermorenderWarning)
            status, _, errors = call(*verb)
        assert status == 0, errors
        assert ("the mesh m.obj has faces that look down" in errors) == flipped
        backs = "100% of what the camera sees is backs of faces" in errors and "flip = true" in errors
        assert backs == (flipped and verb[0] != "plan")
