"""`import-terrain --three-d`: a house and a tree of known shape, from a surface model to a mesh."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

import thermorender as tr
from scenes import write_raster
from thermorender.cli import app as cli
from thermorender.errors import ThermorenderError
from thermorender.render.plan import make_plan
from thermorender.scene.import_terrain import import_terrain
from thermorender.scene.solids import found
from thermorender.scene.solids.importing import ThreeD
from thermorender.scene.surface import FILLED
from thermorender.scene.terrain import read_elevation

SIDE, CORNER = 48, (500000.0, 5780000.0)
# A slope of 4 %; a house of 14 by 9 m with flat eaves at 6 m above the ground; a tree of 3.5 m radius, 9 m high.
ROW, COLUMN = np.mgrid[:SIDE, :SIDE] + 0.5
GROUND = 20.0 + 0.04 * COLUMN
HOUSE = (COLUMN > 10) & (COLUMN < 24) & (ROW > 12) & (ROW < 21)
AWAY = np.hypot(COLUMN - 36.0, ROW - 33.0)


def heights():
    tree = np.where(AWAY < 3.5, 4.0 + 5.0 * np.sqrt(np.maximum(1.0 - (AWAY / 3.5) ** 2, 0.0)), 0.0)
    return np.where(HOUSE, 27.0, GROUND + tree)


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    folder = tmp_path_factory.mktemp("model")
    write_raster(folder / "dsm.tif", heights()[None].astype(np.float32), corner=CORNER)
    write_raster(folder / "dem.tif", GROUND[None].astype(np.float32), corner=CORNER)
    ring = [[CORNER[0] + x, CORNER[1] - y] for x, y in ((10, 12), (24, 12), (24, 21), (10, 21), (10, 12))]
    house = {"type": "Feature", "properties": {"building": "house"},
             "geometry": {"type": "Polygon", "coordinates": [ring]}}  # fmt: skip
    road = {"type": "Feature", "properties": {"highway": "service"},
            "geometry": {"type": "LineString", "coordinates": ring[:2]}}  # fmt: skip
    crs = {"type": "name", "properties": {"name": "EPSG:32634"}}
    (folder / "known.geojson").write_text(
        json.dumps({"type": "FeatureCollection", "crs": crs, "features": [road, house]})
    )
    return folder


def surfaces(scene):
    return {surface.name.split(":")[1]: surface for surface in scene.surfaces}


def upright_area(surface):
    corner = surface.vertices[surface.faces]
    across = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    assert np.abs(across[:, 2]).max() < 1e-3 * np.linalg.norm(across, axis=1).max()
    return 0.5 * np.linalg.norm(across, axis=1).sum()


@pytest.mark.parametrize(("given", "known"), [(True, True), (False, False)])
def test_a_house_has_walls_to_its_eaves_and_a_tree_a_crown(model, tmp_path, given, known):
    three_d = ThreeD(model / "dem.tif" if given else None)
    outlines = model / "known.geojson" if known else None
    made = import_terrain(model / "dsm.tif", None, tmp_path / "s", known=outlines, three_d=three_d)
    assert (made["buildings"], made["trees"]) == (1, 1)
    of = surfaces(scene := tr.load_scene(tmp_path / "s"))
    assert set(of) == {"ground", "roofs", "walls", "plants"}
    origin = scene.frame.height_m
    roof = of["roofs"].vertices[:, 2] + origin
    assert roof == pytest.approx(np.full(len(roof), 27.0), abs=0.01)
    ground = of["ground"].vertices[:, 2] + origin
    assert ground.max() < 22.5
    # 46 m round the house, from half a metre below the lowest ground (20.4 m, but for what a filter leaves) to 27 m.
    # An outline found by height lies on the sides of posts.
    assert upright_area(of["walls"]) == pytest.approx(46.0 * (27.0 - 20.4 + 0.5), rel=0.02 if known else 0.15)
    east, north, up = of["plants"].vertices.T
    assert np.hypot(east - 12.0, north + 9.0).max() < 4.5
    assert up.min() + origin > 20.0 and 29.0 < up.max() + origin < 31.5
    # Nothing stands inside the house.
    inside = (np.abs(east + 7.0) < 6.0) & (np.abs(north - 7.5) < 3.5)
    assert not inside.any()


def test_what_nobody_has_seen_is_flagged_and_listed(model, tmp_path):
    import_terrain(model / "dsm.tif", None, tmp_path / "s", three_d=ThreeD(model / "dem.tif"))
    scene = tr.load_scene(tmp_path / "s")
    flagged = {name: bool((surface.flags & FILLED).all()) for name, surface in surfaces(scene).items()}
    assert flagged == {"ground": False, "roofs": False, "walls": True, "plants": True}
    assert {row[0] for row in make_plan(scene, rays=16).rows() if row[1] == "inferred"} == {"walls", "plants"}
    renderer = tr.Renderer(scene, quality="fast", rays=16)
    frame = renderer.frame(scene.pose(-7.0, -20.0, 6.0, look_at=(-7.0, 3.0, 0.0)))
    names = np.array([material.name for material in scene.materials])
    shown = names[np.minimum(frame.truth["material"], len(names) - 1)]
    wall = np.isin(shown, ("brick_painted", "wood"))
    assert wall.mean() > 0.05 and (frame.truth["mask"][wall] & FILLED != 0).all()


def test_the_ground_below_objects_is_found():
    bare = found.ground_below(heights(), 1.0)
    # The lowest filter leaves the slope as it is, and fills house and tree linearly.
    assert np.abs(bare - GROUND).max() < 0.35 and np.abs(bare - GROUND).mean() < 0.05


def test_wrong_arguments(model, tmp_path):
    with pytest.raises(ThermorenderError, match="fill is for a raster of heights"):
        import_terrain(model / "dsm.tif", None, tmp_path / "s", fill=True, three_d=ThreeD())
    (tmp_path / "none.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": []}))
    with pytest.raises(ThermorenderError, match="has no polygon with a tag 'building'"):
        import_terrain(model / "dsm.tif", None, tmp_path / "s", known=tmp_path / "none.geojson", three_d=ThreeD())
    done = CliRunner().invoke(cli.app, ["import-terrain", str(model / "dsm.tif"), "-o", str(tmp_path / "s"),
                                        "--wall", "brick_clay"])  # fmt: skip
    assert done.exit_code != 0 and "--ground and --wall are for scenes" in str(done.exception)
    assert not (tmp_path / "s").exists()


@pytest.mark.parametrize("reverse", [False, True])
def test_walls_of_a_courtyard_face_it(tmp_path, reverse):
    """A block of 28 m a side around a courtyard of 8 m, its outlines in either sense of rotation."""
    block = (np.abs(COLUMN - 24) < 14) & (np.abs(ROW - 24) < 14) & ~((np.abs(COLUMN - 24) < 4) & (np.abs(ROW - 24) < 4))
    write_raster(tmp_path / "dsm.tif", np.where(block, 32.0, 20.0)[None].astype(np.float32), corner=CORNER)
    rings = []
    for half in (14, 4):
        ring = [[CORNER[0] + 24 + x, CORNER[1] - 24 + y]
                for x, y in ((-half, -half), (half, -half), (half, half), (-half, half), (-half, -half))]  # fmt: skip
        rings.append(ring[::-1] if reverse else ring)
    feature = {"type": "Feature", "properties": {"building": "yes"},
               "geometry": {"type": "Polygon", "coordinates": rings}}  # fmt: skip
    crs = {"type": "name", "properties": {"name": "EPSG:32634"}}
    (tmp_path / "b.geojson").write_text(
        json.dumps({"type": "FeatureCollection", "crs": crs, "features": [feature]}), encoding="utf-8"
    )
    import_terrain(tmp_path / "dsm.tif", None, tmp_path / "s", known=tmp_path / "b.geojson", three_d=ThreeD())
    walls = surfaces(tr.load_scene(tmp_path / "s"))["walls"]
    corner = walls.vertices[walls.faces]
    across = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    middle = corner.mean(axis=1)
    within = np.abs(middle[:, :2]).max(axis=1) < 5.0
    outward = np.einsum("fi,fi->f", across[:, :2], middle[:, :2])
    assert within.any() and (outward[within] < 0.0).all() and (outward[~within] > 0.0).all()
    area = 0.5 * np.linalg.norm(across, axis=1)
    assert area[within].sum() == pytest.approx(32.0 * 12.5, rel=0.02)
    assert area[~within].sum() == pytest.approx(112.0 * 12.5, rel=0.02)


def grid_of(folder):
    return read_elevation(folder / "dsm.tif")[1]


def test_holes_of_the_terrain_model_below_a_building_keep_it(model):
    ground = np.where(HOUSE, np.nan, GROUND)
    ground[:, 40:] = np.nan
    bare = found.ground_given(ground, heights(), 1.0)
    assert np.abs(bare - GROUND)[:, :40].max() < 0.05
    assert np.abs(bare - GROUND)[:, 40:].max() < 0.5


@pytest.mark.parametrize("shift", [-100.0, 30.0])
def test_a_terrain_model_from_another_level_is_refused(shift):
    with pytest.raises(ThermorenderError, match="count from different levels"):
        found.ground_given(GROUND + shift, heights(), 1.0)


def outlined(folder, path, rings):
    """A file with one building of rings of columns and rows."""
    corners = [[[CORNER[0] + x, CORNER[1] - y] for x, y in ring] for ring in rings]
    feature = {"type": "Feature", "properties": {"building": "yes"},
               "geometry": {"type": "Polygon", "coordinates": corners}}  # fmt: skip
    crs = {"type": "name", "properties": {"name": "EPSG:32634"}}
    path.write_text(json.dumps({"type": "FeatureCollection", "crs": crs, "features": [feature]}))
    return found.outlines_in(path, grid_of(folder))


def test_outlines_keep_their_corners_whether_closed_or_not(model, tmp_path):
    corners = [(10, 12), (24, 12), (24, 21), (10, 21)]
    for ring in (corners, [*corners, corners[0]], [corners[0], *corners, corners[0]]):
        ((outer,),) = outlined(model, tmp_path / "k.geojson", [ring])
        assert sorted(map(tuple, outer.round(6))) == sorted(corners)


@pytest.mark.parametrize("rings", [[], [[(10, 12), (24, 12), (10, 12)]], [[(10, 12), (17, 12), (24, 12), (10, 12)]]])
def test_outlines_without_area_are_refused(model, tmp_path, rings):
    with pytest.raises(ThermorenderError, match="feature 1 has an outline without area"):
        outlined(model, tmp_path / "k.geojson", rings)


def test_a_building_drawn_twice_is_one(model, tmp_path):
    corners = [(10, 12), (24, 12), (24, 21), (10, 21)]
    path = tmp_path / "k.geojson"
    outlined(model, path, [corners])
    once = json.loads(path.read_text())
    again = json.loads(path.read_text())["features"][0]
    ring = again["geometry"]["coordinates"][0]
    again["geometry"]["coordinates"] = [[*ring[2:], *ring[:2]][::-1]]
    path.write_text(json.dumps(once | {"features": [*once["features"], again]}))
    assert len(found.outlines_in(path, grid_of(model))) == 1
