"""Crowns in a scene file: tables of bodies and of their temperatures, what is refused, and what is said of them."""

import numpy as np
import pytest

import thermorender as tr
from scenes import coarse, scene_object, write_terrain
from thermorender.errors import ThermorenderError
from thermorender.render.basic import basic_frame
from thermorender.render.geometry import refuse_other_surfaces
from thermorender.render.plan import make_plan

TREES = (
    "east_m,north_m,above_ground_m,width_m,length_m,height_m,leaf_area_1_m,yaw_deg,red,green,blue\n"
    "-3,2,1,4,3,5,1.2,30,10,20,30\n3,1.5,0.2,3,5,2,0.5,0,40.4,50,60\n"
)
PARTS = ("core_lower", "core_upper", "shell_lower", "shell_upper")
KELVIN = (
    ",".join([f"{part}_k" for part in PARTS] + [f"{part}_sunlit_k" for part in PARTS])
    + "\n288,290,287,289.5,291,294,292,295\n289,291,288,290,290.5,290,290,292\n"
)


def write_crowns(folder, trees=TREES, kelvin=None, **keys):
    """Write a flat scene with the crowns of a table; `keys` are the object's, None leaves one out."""
    folder.mkdir(parents=True)
    (folder / "trees.csv").write_text(trees, encoding="utf-8")
    if kelvin is not None:
        (folder / "kelvin.csv").write_text(kelvin, encoding="utf-8")
    common = {"shape": "sphere", "instances": "trees.csv", "leaf_area_1_m": 1.0, "material": "broadleaf",
              "temperature": 290.0 if kelvin is None else "kelvin.csv"}  # fmt: skip
    keys = {name: value for name, value in (common | keys).items() if value is not None}
    return write_terrain(folder, extra=scene_object("trees", **keys))


def crowns_of(scene):
    return scene.surfaces[1], scene.surfaces[1].instances


def test_columns_of_a_table_are_bodies(tmp_path):
    surface, body = crowns_of(tr.load_scene(write_crowns(tmp_path / "s")))
    np.testing.assert_allclose(body.middle, [[-3, 2, 1 + 2.5], [3, 1.5, 0.2 + 1]], atol=1e-5)
    np.testing.assert_allclose(2.0 * body.half, [[4, 3, 5], [3, 5, 2]])
    np.testing.assert_allclose(body.density, [1.2, 0.5])
    np.testing.assert_allclose(body.yaw_deg, [30, 0])
    assert not body.box and (surface.material == surface.material.flat[0]).all()
    np.testing.assert_array_equal(surface.colour.reshape(-1, 3)[[0, 7, 8, 15]], [[10, 20, 30]] * 2 + [[40, 50, 60]] * 2)
    # Of the two sides of leaves, in four quarters.
    leaves = np.array([1.2 * 4 * 3 * 5, 0.5 * 3 * 5 * 2]) * np.pi / 6
    np.testing.assert_allclose(body.area, np.repeat(0.25 * leaves, 8))


def test_size_density_and_colour_of_the_object_are_those_of_a_table_without_them(tmp_path):
    places = "east_m,north_m,scale,up_m\n0,0,1,3\n2,1,0.5,7\n"
    folder = write_crowns(tmp_path / "s", places, shape="box", size=[2, 3, 1], leaf_area_1_m=0.7, colour=[9, 8, 7])
    surface, body = crowns_of(tr.load_scene(folder))
    np.testing.assert_allclose(2.0 * body.half, [[2, 3, 1], [1, 1.5, 0.5]])
    # Heights of the base in the local frame, whatever the ground.
    np.testing.assert_allclose(body.middle, [[0, 0, 3.5], [2, 1, 7.25]])
    np.testing.assert_allclose(body.density, 0.7)
    assert body.box and (surface.colour == [9, 8, 7]).all()
    (folder / "trees.csv").write_text("east_m,north_m,green\n0,0,50\n")
    assert (tr.load_scene(folder).surfaces[1].colour == [9, 50, 7]).all()


def test_an_object_without_a_table_is_one_crown(tmp_path):
    folder = write_crowns(tmp_path / "s", instances=None, size=[2, 3, 4], position=[1, -2, 0.5], yaw_deg=20.0)
    scene = tr.load_scene(folder)
    _, body = crowns_of(scene)
    np.testing.assert_allclose(body.middle, [[1, -2, 2.5]], atol=1e-5)
    np.testing.assert_allclose([*body.half[0], body.yaw_deg[0]], [1, 1.5, 2, 20])
    assert "trees (1 crown)" in str(scene) and "1 crown," in repr(scene.surfaces[1])
    moved = scene.with_objects({"trees": {"east_m": 3.0}})
    np.testing.assert_allclose(crowns_of(moved)[1].middle, [[3, -2, 2.5]], atol=1e-5)


def test_temperatures_of_a_table_are_those_of_the_quarters(tmp_path):
    scene = tr.load_scene(write_crowns(tmp_path / "s", kelvin=KELVIN))
    surface, _ = crowns_of(scene)
    np.testing.assert_array_equal(surface.temperature.ravel()[:16:2], [288, 290, 287, 289.5, 289, 291, 288, 290])
    np.testing.assert_array_equal(surface.temperature.ravel()[1:16:2], surface.temperature.ravel()[:16:2])
    # How much warmer a leaf in the sun is; one that the table has colder is as warm as the mean.
    np.testing.assert_array_equal(surface.scatter_k.ravel()[:16:2], [3, 4, 5, 5.5, 1.5, 0, 2, 2])
    warm, _ = crowns_of(scene.with_objects({"trees": 300.0}))
    assert (warm.temperature == 300.0).all() and warm.scatter_k is None


def test_scene_and_plan_say_how_many_crowns_there_are(tmp_path):
    scene = tr.load_scene(write_crowns(tmp_path / "s"))
    assert "trees (2 crowns)" in str(scene) and "2 crowns," in repr(scene.surfaces[1])
    rows = {row[0]: row for row in make_plan(scene).rows()}
    assert rows["crowns"][1] == "2" and "two more casts for each" in rows["crowns"][2] and "copies" not in rows
    assert "crowns" not in {row[0] for row in make_plan(scene.with_surfaces(scene.surfaces[:1])).rows()}


def test_plain_frame_refuses_crowns(tmp_path):
    scene = coarse(tr.load_scene(write_crowns(tmp_path / "s")), 16)
    baked = tr.Renderer(scene, "fast").baked
    with pytest.raises(ThermorenderError, match="moving objects, mirrors, copies or crowns; render it with Renderer"):
        basic_frame(baked, tr.pose(0, 0, 5, pitch_deg=-90))


def test_crowns_of_another_density_are_another_surface(tmp_path):
    one, other = (
        tr.load_scene(write_crowns(tmp_path / name, leaf_area_1_m=density, trees="east_m,north_m\n0,0\n"))
        for name, density in (("a", 1.0), ("b", 1.1))
    )
    with pytest.raises(ThermorenderError, match="other copies or crowns in surface 'trees:sphere'"):
        refuse_other_surfaces(one.surfaces, other.surfaces)
    assert one.digest() != other.digest()


@pytest.mark.parametrize(("shape", "up_m", "share"), [("box", -1.2, 100), ("sphere", -0.8, 62), ("sphere", -0.4, None)])
def test_tops_of_crowns_under_the_ground_are_named(tmp_path, shape, up_m, share):
    """A ball of 1 m whose middle is `up_m` + 0.5 m above the ground: its top is above within a circle."""
    places = f"east_m,north_m,up_m,width_m,length_m,height_m\n0,0,{up_m},1,1,0.99\n2,1,{up_m},1,1,0.99\n"
    scene = tr.load_scene(write_crowns(tmp_path / "s", places, shape=shape))
    found = [note for note in scene.surface_notes if "under the ground" in note]
    assert len(found) == (share is not None)
    if share:
        # In plan the circle at the height of the ground has the square of half a chord.
        middle = up_m + 0.495
        exact = 100.0 if shape == "box" else 100.0 * (1.0 - (0.495**2 - middle**2) / 0.495**2)
        told = float(found[0].split(" is ")[1].split("%")[0])
        assert told == pytest.approx(exact, abs=5.0)


PLACE = "east_m,north_m"
TABLE = r"temperature='.*kelvin.csv' is not allowed; give a table with leaf_area_1_m and instances only"


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"trees": PLACE + ",width_m\n0,0,0\n"}, r"trees.csv, row 2: width_m=0 is not allowed; give 0.01 to 1000 m$"),
        ({"trees": PLACE + ",height_m\n0,0,1\n0,0,2e3\n"}, r"row 3: height_m=2000 is .*; give 0.01 to 1000 m$"),
        ({"trees": PLACE + ",leaf_area_1_m\n0,0,0\n"}, r"row 2: leaf_area_1_m=0 is .*; give 0.001 to 100 m²/m³$"),
        ({"trees": PLACE + ",red\n0,0,256\n"}, r"row 2: red=256 is not allowed; give 0 to 255 of sRGB$"),
        ({"trees": PLACE + ",up_m\n0,0,1e6\n"}, r"row 2: up_m=1e\+06 is not .*; give -100000 to 100000 m in the"),
        ({"trees": "east_m,width_m\n0,1\n"}, r"trees.csv lacks east_m, north_m or rows of numbers"),
        ({"trees": PLACE + ",radius_m\n0,0,1\n"}, r"has the column 'radius_m'; give .*leaf_area_1_m"),
        ({"kelvin": "lower_k,upper_k\n290,290\n"}, r"kelvin.csv has the column 'lower_k'; give .* core_lower_k"),
        ({"kelvin": KELVIN + "1,1,1,1,1,1,1,1\n"}, r"kelvin.csv has 3 rows of temperatures for 2 crowns; give"),
        ({"kelvin": KELVIN.replace("288,290,287", "15,290,287")}, r"core_lower_k=15 is below 100 K .*; values are"),
        ({"kelvin": KELVIN, "leaf_area_1_m": None, "trees": PLACE + "\n0,0\n"}, TABLE),
        ({"kelvin": KELVIN, "instances": None}, TABLE),
        ({"leaf_area_1_m": None}, r"has the column 'width_m'; give a header with east_m"),
        ({"leaf_area_1_m": 0.0}, r"leaf_area_1_m=0.0 .*0.001"),
        ({"leaf_area_1_m": 1000.0}, r"leaf_area_1_m=1000.0 .*100"),
        ({"leaf_area_1_m": None, "leaf_m": 0.2, "trees": PLACE + "\n0,0\n"}, r"leaf_m=0.2 .*with leaf_area_1_m only"),
        ({"leaf_m": 0.0}, r"leaf_m=0.0 .*0.001"),
        ({"shape": "disc"}, r"leaf_area_1_m=1.0 .*shape='box' or 'sphere'"),
        ({"shape": None, "file": "trees.csv"}, r"leaf_area_1_m=1.0 .*shape='box' or 'sphere'"),
        ({"instances": None, "track": "trees.csv"}, r"leaf_area_1_m=1.0 .*without track: a crown stands still"),
        ({"inner_heat_w": 50.0}, r"inner_heat_w=50.0 .*without instances and leaf_area_1_m"),
        ({"inner_heat_w": 50.0, "instances": None, "temperature": "balance"}, r"inner_heat_w=50.0 .*leaf_area_1_m"),
        ({"instances": None, "upright": False}, r"upright=False .*copies and crowns stand upright"),
        ({"temperature": "balance"}, r"temperature of object 'trees' is 'balance', and .*source='raster'; give"),
        ({"material": "water_fresnel"}, r"'trees' has 2 crowns of the material 'water_fresnel', whose emissivity"),
        ({"trees": PLACE + "\n99,0\n"}, r"a crown at 99 m east, 0 m north, .*no terrain; leave that row out of"),
        ({"instances": None, "position": [99, 0, 0]}, r"a crown at 99 m east, 0 m north, .*; give another position$"),
        ({"instances": None, "position": [0, 0, -9]}, r"below the ground; give the third number of its position in"),
        (
            {"trees": PLACE + ",above_ground_m,height_m\n0,0,-3,2\n"},
            r"has a crown at 0 m east, 0 m north whose top is 1 m below the ground; give above_ground_m in",
        ),
    ],
)  # fmt: skip
def test_crowns_that_cannot_be_used_are_refused(tmp_path, keys, words):
    with pytest.raises(ThermorenderError, match=words):
        tr.load_scene(write_crowns(tmp_path / "s", **keys))
