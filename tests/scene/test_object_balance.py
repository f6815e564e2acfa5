"""Objects of a scene file whose temperature the heat balance solves: what is read, refused and edited."""

import numpy as np
import pytest
from PIL import Image

import thermorender as tr
from scenes import WEATHER, scene_object, write_balance, write_materials
from thermorender.errors import ThermorenderError

# Two squares beside each other with the same map coordinates, so that they share their texels.
MIRRORED = (
    "mtllib t.mtl\nusemtl t\nv 0 0 1\nv 1 0 1\nv 1 1 1\nv 0 1 1\nv 2 0 1\nv 2 1 1\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
    "o left\nf 1/1 2/2 3/3\nf 1/1 3/3 4/4\no right\nf 5/1 2/2 3/3\nf 5/1 3/3 6/4\n"
)


def write(folder, **keys):
    """Write a scene with an object whose temperature is solved, and return its folder; `inner_heat_share` is TOML."""
    folder.mkdir()
    Image.fromarray(np.full((8, 8, 3), (60, 110, 40), np.uint8)).save(folder / "t.png")
    (folder / "t.mtl").write_text("newmtl t\nmap_Kd t.png\n", encoding="utf-8")
    (folder / "m.obj").write_text(MIRRORED, encoding="utf-8")
    (folder / "track.csv").write_text("time_s,east_m\n0,1\n9,2\n", encoding="utf-8")
    (folder / "places.csv").write_text("east_m,north_m\n0,0\n", encoding="utf-8")
    shares = keys.pop("inner_heat_share", "")
    more = scene_object("van", **{"temperature": "balance", **keys}) + (shares and f"inner_heat_share = {shares}\n")
    return write_balance(folder, WEATHER + more)


def test_each_face_has_a_texel_although_the_texture_is_shared(tmp_path):
    van = tr.load_scene(write(tmp_path / "s", file="m.obj")).surfaces[1]
    texel = (van.uv[:, 0].astype(np.float64) * van.flags.shape[::-1]).astype(int)
    assert len(np.unique(texel, axis=0)) == len(van.faces) > 20
    assert (van.uv == van.uv[:, :1]).all()
    assert (van.colour == (60, 110, 40)).all()
    assert np.isnan(van.temperature).all()
    assert tr.load_scene(write(tmp_path / "k", temperature=300.0)).surfaces[1].flags.size == 1


@pytest.mark.parametrize(
    ("keys", "area_m2"),
    [
        ({"size": [4, 2, 1]}, 2.0 * (8 + 4 + 2)),
        ({"size": [2, 2, 2], "shape": "disc"}, 32.0 * np.sin(np.pi / 32.0)),
        ({"file": "m.obj"}, 2.0),
    ],
)
def test_inner_heat_is_even_over_the_area(tmp_path, keys, area_m2):
    scene = tr.load_scene(write(tmp_path / "s", inner_heat_w=700.0, **keys))
    assert scene.surfaces[1].inner_w_m2 == pytest.approx(700.0 / area_m2)
    # A sphere of 2 m is cut into triangles.
    ball = tr.load_scene(write(tmp_path / "b", inner_heat_w=700.0, size=[2, 2, 2], shape="sphere")).surfaces[1]
    assert ball.inner_w_m2 == pytest.approx(700.0 / (4.0 * np.pi), rel=0.02)


def test_shares_name_parts_of_one_texture(tmp_path):
    scene = tr.load_scene(write(tmp_path / "s", file="m.obj", inner_heat_w=100.0, inner_heat_share="{right = 1.0}"))
    found = {surface.name: surface.inner_w_m2 for surface in scene.surfaces[1:]}
    assert found == {"van:m:t": 0.0, "van:m:t:right": pytest.approx(100.0)}
    both = write(tmp_path / "b", file="m.obj", inner_heat_w=100.0, inner_heat_share="{left = 0.25, right = 0.75}")
    assert [surface.inner_w_m2 for surface in tr.load_scene(both).surfaces[1:]] == [
        pytest.approx(25.0), pytest.approx(75.0)
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"track": "track.csv"}, r"object 'van'.temperature='balance' is not allowed; give it to what stands still"),
        (
            {"track": "track.csv", "temperature": 300.0, "follows_balance": True},
            r"object 'van'.follows_balance=.* it without track only",
        ),
        ({"temperature": 300, "inner_heat_w": 5}, r"inner_heat_w=5.0 is not allowed; give it with temperature='bal"),
        ({"instances": "places.csv", "inner_heat_w": 5}, r"inner_heat_w=5.0 is not .*and without instances"),
        ({"inner_heat_w": -1}, r"inner_heat_w=-1 is not allowed; give a number 0…1e\+09 W"),
        ({"inner_heat_share": "{van = 1}"}, r"inner_heat_share=.* is not allowed; give it with file only"),
        ({"file": "m.obj", "inner_heat_share": "{left = 0.5}"}, r"give shares whose sum is 1; that of these is 0.5"),
        ({"file": "m.obj", "inner_heat_share": "{bonnet = 1}"}, r"'bonnet' is not a node.*it has m:t.* left.* right"),
        ({"file": "m.obj", "inner_heat_share": "{left = 0.5, t = 0.5}"}, r"are the same triangles"),
        ({"material": "black"}, r"'van' has temperature='balance' and the material 'black', which has no thermal pro"),
    ],
)  # fmt: skip
def test_what_no_heat_balance_can_solve_is_refused(tmp_path, keys, words):
    folder = write(tmp_path / "s", **keys)
    write_materials(folder)
    with pytest.raises(ThermorenderError, match=words):
        tr.load_scene(folder)


def test_edits_name_balance_kelvin_and_inner_heat(tmp_path):
    scene = tr.load_scene(write(tmp_path / "s", file="m.obj", inner_heat_share="{right = 1.0}"))
    warm = scene.with_objects({"van": {"inner_heat_w": 50.0}})
    assert [surface.inner_w_m2 for surface in warm.surfaces[1:]] == [0.0, pytest.approx(50.0)]
    cold = warm.with_objects({"van": 290.0})
    assert (cold.solved_count, cold.spec.objects[0].inner_heat_w) == (1, 0.0)
    assert {float(surface.temperature.flat[0]) for surface in cold.surfaces[1:]} == {290.0}
    again = cold.with_objects({"van": "balance"})
    assert (again.solved_count, again.surfaces[2].inner_w_m2) == (3, 0.0)
    for given, words in (
        ({"temperature_k": 290.0, "inner_heat_w": 5.0}, r"van: inner_heat_w=5.0 is not allowed; give it with temp"),
        ({"inner_heat_w": -5.0}, r"inner_heat_w=-5.0 is not allowed; give a number 0…1e\+09 W"),
        ("hot", r"temperature_k='hot' is not allowed; give a finite number of kelvin, or 'balance'"),
        ({"inner_heat": 5.0}, r"has no 'inner_heat' to set; give .*inner_heat_w"),
    ):
        with pytest.raises(ThermorenderError, match=words):
            scene.with_objects({"van": given})


def test_an_object_with_a_track_is_not_edited_to_balance(tmp_path):
    scene = tr.load_scene(write(tmp_path / "s", temperature=300.0, track="track.csv"))
    with pytest.raises(ThermorenderError, match="with_objects: van: temperature='balance' is not allowed; give it to"):
        scene.with_objects({"van": "balance"})


def test_materials_in_memory_keep_the_balance_of_objects(tmp_path):
    scene = tr.load_scene(write(tmp_path / "s"))
    assert scene.with_surfaces(materials=scene.materials).solved_count == 2
    with pytest.raises(ThermorenderError, match=r"texels of object 'van:box' have no temperature; give kelvin"):
        scene.with_surfaces(scene.surfaces)


def test_kelvin_with_the_key_follow_a_heat_balance_and_no_other_source(tmp_path):
    file = write(tmp_path / "s", file="m.obj", temperature=301.0, follows_balance=True, inner_heat_w=700.0)
    balanced = tr.load_scene(file)
    # The file's own source is the heat balance: as if the object had "balance".
    asked = tr.load_scene(write(tmp_path / "b", file="m.obj", inner_heat_w=700.0))
    for one, other in zip(balanced.surfaces, asked.surfaces, strict=True):
        np.testing.assert_array_equal(one.temperature, other.temperature)
        np.testing.assert_array_equal(one.uv, other.uv)
    assert balanced.surfaces[1].inner_w_m2 == asked.surfaces[1].inner_w_m2 > 0.0
    known = balanced.with_temperature(290.0)
    assert (known.surfaces[1].temperature == 301.0).all()
    again = known.with_temperature("balance")
    assert np.isnan(again.surfaces[1].temperature).all()
    assert again.digest() == balanced.digest()
    # An edit to "balance" keeps the key of the file; after kelvin, which end it, it is asked for as in a file.
    assert (again.with_objects({"van": "balance"}).with_temperature(290.0).surfaces[1].temperature == 301.0).all()
    with pytest.raises(ThermorenderError, match="give the object kelvin"):
        again.with_objects({"van": 310.0}).with_objects({"van": "balance"}).with_temperature(290.0)
    # Kelvin that a user states are no solution.
    stated = again.with_objects({"van": 310.0}).with_temperature(290.0).with_temperature("balance")
    assert (stated.surfaces[1].temperature == 310.0).all()


def test_crowns_with_the_key_follow_a_heat_balance(tmp_path):
    keys = {"leaf_area_1_m": 1.0, "follows_balance": True}
    crown = scene_object("tree", [2, 2, 2], [0, 0, 3], 301.0, "broadleaf", "sphere", **keys)
    scene = tr.load_scene(write_balance(tmp_path / "s", WEATHER + crown)).with_temperature(290.0)
    assert (scene.surfaces[1].temperature == 301.0).all()
    assert np.isnan(scene.with_temperature("balance").surfaces[1].temperature).all()
