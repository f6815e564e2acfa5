"""Another material within an area, and objects set on the command line."""

import json

import numpy as np
import pytest
import trimesh
from rasterio.warp import transform

import thermorender as tr
from scenes import scene_object, write_mesh, write_terrain
from thermorender.scene.georeference import place_of

MARKER = scene_object("marker", [2, 2, 0.1], [-4.0, -4.0, 0.0], shape="disc")
# A roof of 4 m × 2 m: local east and north [m].
ROOF = [(1.0, 2.0), (5.0, 2.0), (5.0, 4.0), (1.0, 4.0)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    classes = np.ones((32, 32), int)
    temperature = np.full((32, 32), 300.0)
    return write_terrain(tmp_path_factory.mktemp("s") / "flat", classes=classes, temperature=temperature, extra=MARKER)


@pytest.fixture(scope="module")
def scene(folder):
    scene = tr.load_scene(folder)
    return scene.with_camera(scene.camera.coarser(8))


def write_polygon(path, scene, corners, crs=None, **properties):
    """Write corners in local metres as a GeoJSON polygon, by default in longitude and latitude."""
    x, y = place_of(scene.frame, scene.grid).to_map([(e, n, scene.ground(e, n)) for e, n in corners])
    if crs is None:
        x, y = transform(scene.grid.crs, "OGC:CRS84", x, y)
    ring = np.column_stack([x, y]).tolist()
    feature = {
        "type": "Feature", "properties": properties,
        "geometry": {"type": "Polygon", "coordinates": [[*ring, ring[0]]]},
    }  # fmt: skip
    about = {} if crs is None else {"crs": {"type": "name", "properties": {"name": crs}}}
    path.write_text(json.dumps({"type": "FeatureCollection", **about, "features": [feature]}))
    return path


def covered(scene, name):
    """Which texels of the terrain have a material."""
    names = [material.name for material in scene.materials]
    return scene.surfaces[0].material == names.index(name)


def test_a_polygon_changes_the_texels_within_it(scene):
    painted = scene.with_material_in(ROOF, "asphalt")
    inside = covered(painted, "asphalt")
    # 8 m² of texels of 0.25 m².
    assert inside.sum() == 32
    rows, columns = np.nonzero(inside)
    east, north = 0.5 * (columns + 0.5) - 8.0, 8.0 - 0.5 * (rows + 0.5)
    assert (east.min(), east.max(), north.min(), north.max()) == (1.25, 4.75, 2.25, 3.75)
    np.testing.assert_array_equal(painted.surfaces[0].temperature, scene.surfaces[0].temperature)
    assert not any(material.name == "asphalt" for material in scene.materials), "the scene before is unchanged"
    assert painted.digest() != scene.digest()


def test_the_frame_shows_the_area_and_no_more(scene):
    before = tr.Renderer(scene, quality="fast")
    after = tr.Renderer(scene.with_material_in(ROOF, 0.5), quality="fast", like=before)
    pose = scene.pose(0, 0, 14, pitch_deg=-90)
    change = after.frame(pose).apparent_temperature - before.frame(pose).apparent_temperature
    east, north, _ = np.moveaxis(before.frame(pose).truth["position"], -1, 0)
    inside = (east > 1.3) & (east < 4.7) & (north > 2.3) & (north < 3.7)
    outside = (east < 0.7) | (east > 5.3) | (north < 1.7) | (north > 4.3)
    assert change[inside].max() < -10.0 and np.abs(change[outside]).max() < 0.1


def test_a_geojson_gives_the_same_in_degrees_and_in_metres(scene, tmp_path):
    degrees = write_polygon(tmp_path / "degrees.geojson", scene, ROOF)
    metres = write_polygon(tmp_path / "metres.geojson", scene, ROOF, crs="EPSG:32634", material="asphalt")
    own, contents = scene.with_material_in(ROOF, "asphalt"), json.loads(metres.read_text())
    for area, name in ((degrees, "asphalt"), (metres, None), (contents, None)):
        painted = scene.with_material_in(area, name)
        np.testing.assert_array_equal(covered(painted, "asphalt"), covered(own, "asphalt"))


def test_later_areas_cover_earlier_ones_and_other_edits_keep_them(scene):
    twice = scene.with_material_in(ROOF, "asphalt").with_material_in(np.add(ROOF, (2.0, 0.0)), "snow")
    assert covered(twice, "asphalt").sum() == 16 and covered(twice, "snow").sum() == 32
    # Class 1 changes around the roof only.
    moved = scene.with_material_in(ROOF, "asphalt").with_material({1: "soil_loam"}).with_sky(240.0)
    assert covered(moved, "asphalt").sum() == 32 and covered(moved, "soil_loam").sum() == 32 * 32 - 32
    turned = scene.with_sky(240.0).with_material({1: "soil_loam"}).with_material_in(ROOF, "asphalt")
    np.testing.assert_array_equal(covered(turned, "asphalt"), covered(moved, "asphalt"))


def test_texels_by_number_get_what_an_area_of_them_gets(scene):
    texels = scene.texels_in(ROOF)
    assert texels.dtype == np.int64 and len(texels) == 32 and (np.diff(texels) > 0).all()
    painted, area = scene.with_material_at(texels[::-1], "asphalt"), scene.with_material_in(ROOF, "asphalt")
    np.testing.assert_array_equal(covered(painted, "asphalt"), covered(area, "asphalt"))
    np.testing.assert_array_equal(np.flatnonzero(covered(painted, "asphalt")), texels)
    # Later edits cover earlier ones of either kind, and other edits keep them.
    twice = painted.with_material_in(np.add(ROOF, (2.0, 0.0)), "snow").with_material_at(texels[:1], 0.5)
    assert covered(twice, "asphalt").sum() == 15 and covered(twice, "snow").sum() == 32
    assert covered(twice.with_sky(240.0).with_material({1: "soil_loam"}), "material").sum() == 1


def test_texels_of_a_wall_are_those_that_its_pixels_show(tmp_path):
    mesh = trimesh.creation.box((4.0, 4.0, 4.0)).subdivide()
    # Colours of its faces give each a texel.
    mesh.visual.face_colors = np.random.default_rng(0).integers(0, 255, (len(mesh.faces), 4))
    box = tr.load_scene(write_mesh(tmp_path / "box", mesh))
    box = box.with_camera(box.camera.coarser(16))
    pose = tr.pose(0.0, -8.0, 0.0, pitch_deg=0.0, yaw_deg=0.0)
    before = tr.Renderer(box, quality="fast")
    texels = before.texels(pose)
    east = before.frame(pose).truth["position"][..., 0]
    painted = box.with_material_at(texels[(texels >= 0) & (east > 0.0)], "steel_galvanised")
    after = tr.Renderer(painted, quality="fast", like=before).frame(pose)
    steel = np.array(after.materials)[np.minimum(after.truth["material"], len(after.materials) - 1)]
    seen = texels >= 0
    assert ((steel == "steel_galvanised") == (east > 0.0))[seen].all() and 0.2 < (east > 0.0)[seen].mean() < 0.8
    changed = after.apparent_temperature - before.frame(pose).apparent_temperature
    assert changed[seen & (east > 0.5)].max() < -3.0


@pytest.mark.parametrize(
    "given", [[], [-1], [1024], [0.0], [True], [[0, 1], [2]], "3", np.array([2**63], np.uint64), None]
)
def test_wrong_numbers_of_texels_are_refused_in_one_sentence(scene, given):
    # A marker stands on the 32 × 32 texels.
    with pytest.raises(
        tr.ThermorenderError, match=r"texels=.* is not allowed; give one or more whole numbers 0…1023"
    ) as e:
        scene.with_material_at(given, "asphalt")
    assert "\n" not in str(e.value)


def test_texels_without_files_and_wrong_materials_are_refused(scene):
    with pytest.raises(tr.ThermorenderError, match="with_material_at: material uses material 'aspalt'"):
        scene.with_material_at([3], "aspalt")
    made = scene.with_surfaces(scene.surfaces)
    for edit in (lambda: made.with_material_at([3], 0.5), lambda: made.texels_in(ROOF)):
        with pytest.raises(
            tr.ThermorenderError, match="needs a terrain that files describe; edit the scene before with_"
        ):
            edit()


def test_wrong_areas_are_refused_in_one_sentence(scene, tmp_path):
    box = tr.load_scene(write_mesh(tmp_path / "box", trimesh.creation.box((2.0, 2.0, 2.0))))
    plain = write_polygon(tmp_path / "plain.geojson", scene, ROOF)
    (tmp_path / "list.geojson").write_text("[]")
    (tmp_path / "line.geojson").write_text(
        '{"features": [{"properties": {}, "geometry": {"type": "LineString", "coordinates": [[21, 52], [22, 52]]}}]}'
    )
    # A projected CRS without the member "crs".
    corners = [[500000, 5780000], [500010, 5780000], [500010, 5779990], [500000, 5780000]]
    metres = {"features": [{"geometry": {"type": "Polygon", "coordinates": [corners]}}]}
    cases = [
        (scene, ([(0, 0), (1, 1)], 0.9), "is not a polygon; give three or more"),
        (scene, ("none.geojson", 0.9), "none.geojson cannot be read: No such file"),
        (scene, (tmp_path / "list.geojson", 0.9), "is not a GeoJSON FeatureCollection"),
        (scene, (tmp_path / "line.geojson", 0.9), "feature 1 is not a polygon"),
        (scene, ({"features": [{}]}, 0.9), "^GeoJSON, feature 1 is not a polygon"),
        (scene, (metres, 0.9), "feature 1 has corners that are not coordinates of .*; give GeoJSON in longitude and"),
        (scene, ({"name": "roofs"}, 0.9), "^roofs is not a GeoJSON FeatureCollection"),
        (scene, (np.add(ROOF, 500.0), 0.9), "covers no texel of .*orthophoto.tif; draw it on the terrain"),
        (scene, (plain,), "has a polygon without the property 'material'; give a material"),
        (scene, (ROOF, "aspalt"), "with_material_in: material uses material .aspalt."),
        (scene, (ROOF, 2.0), "with_material_in: material=2.0 is not allowed; give an emissivity above 0 and up to 1"),
        (box, (ROOF, 0.9), r"needs a terrain with a place on a map; add \[frame\]"),
    ]
    for own, arguments, words in cases:
        with pytest.raises(tr.ThermorenderError, match=words) as found:
            own.with_material_in(*arguments)
        assert "\n" not in str(found.value)


def test_the_command_line_paints_and_sets(folder, scene, tmp_path, call):
    from thermorender.frame.exr import read_exr

    roof = write_polygon(tmp_path / "roof.geojson", scene, ROOF)
    options = ["--pose", "0,0,14,0,-90,0", "--products", "exr,truth", "--quality", "fast", "--rays", "4"]
    changes = ["--paint", f"{roof}=0.5", "--set", "marker.temperature_k=350", "--set", "marker.east_m=4"]
    status, _, errors = call("render", folder, *options, *changes, "-o", tmp_path / "out")
    assert status == 0, errors
    found, _ = read_exr(tmp_path / "out/frame_000000.exr")
    own = tr.load_scene(folder).with_material_in(ROOF, 0.5)
    own = own.with_objects({"marker": {"temperature_k": 350.0, "east_m": 4.0}})
    frame = tr.Renderer(own, quality="fast", rays=4).frame(own.pose(0, 0, 14, pitch_deg=-90))
    np.testing.assert_array_equal(found["apparent_temperature"], frame.apparent_temperature)
    assert found["truth.kinetic_temperature"].max() == 350.0
    for option, words in (
        (["--set", "marker=350"], "--set='marker=350' is not allowed; give OBJECT.KEY=VALUE"),
        (["--set", "markr.temperature_k=350"], "has no object 'markr'; did you mean 'marker'?"),
        (["--set", "marker.temperature_k=hot"], "temperature_k"),
        (["--paint", f"{roof}=aspalt"], "aspalt"),
    ):
        status, _, errors = call("render", folder, *options, *option, "-o", tmp_path / "no")
        assert status == 2 and words in errors and "Traceback" not in errors, errors
