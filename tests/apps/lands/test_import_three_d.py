"""`import-terrain --three-d`: a house and a tree of known shape, from a surface model to a mesh."""

import itertools
import json

import numpy as np
import pytest
from typer.testing import CliRunner

import thermorender as tr
from scenes import write_raster
from thermorender.apps.lands.import_settings import ImportSettings, ThreeD
from thermorender.apps.lands.import_terrain import import_terrain
from thermorender.apps.lands.solids import city_model, detection
from thermorender.apps.lands.solids.borders import OPEN, borders
from thermorender.apps.lands.solids.outlines import outlines_in
from thermorender.apps.lands.solids.roof_steps import cut_at_steps
from thermorender.cli import app as cli
from thermorender.errors import ThermorenderError
from thermorender.formats import write_text
from thermorender.render.plan import make_plan
from thermorender.render.quality import Sampling
from thermorender.scene.ground import Ground
from thermorender.scene.patch import read_features
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
    made = import_terrain(model / "dsm.tif", None, tmp_path / "s", ImportSettings(known=outlines), three_d)
    assert (made["buildings"], made["trees"]) == (1, 1)
    of = surfaces(scene := tr.load_scene(tmp_path / "s"))
    assert set(of) == {"ground", "roofs", "walls", "trunks", "sphere"}
    origin = scene.frame.height_m
    roof = of["roofs"].vertices[:, 2] + origin
    assert roof == pytest.approx(np.full(len(roof), 27.0), abs=0.01)
    ground = of["ground"].vertices[:, 2] + origin
    assert ground.max() < 22.5
    # 46 m round the house, from half a metre below the lowest ground (20.4 m, but for what a filter leaves) to 27 m.
    # An outline found by height lies on the sides of posts.
    assert upright_area(of["walls"]) == pytest.approx(46.0 * (27.0 - 20.4 + 0.5), rel=0.02 if known else 0.15)
    # Trunk and crown of the tree, 30.4 m above the ellipsoid at its top.
    east, north, up = of["trunks"].vertices.T
    assert np.hypot(east - 12.0, north + 9.0).max() < 1.0 and 20.0 < up.min() + origin < up.max() + origin < 27.0
    crown = of["sphere"].instances
    reach = np.hypot(*(crown.middle[:, :2] - [12.0, -9.0]).T) + crown.half[:, :2].max(axis=1)
    low, high = (crown.middle[:, 2] + sign * crown.half[:, 2] + origin for sign in (-1.0, 1.0))
    assert 2.8 < reach.max() < 4.5 and low.min() > 22.0 and 29.0 < high.max() < 31.5


@pytest.mark.parametrize(("rough_m", "smooth"), [(0.0, True), (0.02, True), (0.2, False)])
def test_a_smooth_ground_of_many_posts_is_coarser_and_as_high(model, tmp_path, monkeypatch, rough_m, smooth):
    bent = GROUND + 0.0006 * (ROW - 20.0) ** 2 + rough_m * np.random.default_rng(1).standard_normal(GROUND.shape)
    write_raster(tmp_path / "dem.tif", bent[None].astype(np.float32), corner=CORNER)
    found = []
    for number, many in enumerate((1 << 19, 1000)):
        monkeypatch.setattr(city_model, "_MANY_POSTS", many)
        folder = tmp_path / str(number)
        made = import_terrain(model / "dsm.tif", None, folder, ImportSettings(), ThreeD(tmp_path / "dem.tif"))
        found.append(surfaces(tr.load_scene(folder))["ground"])
        told = [note for note in made["known"] if "the ground has posts 3.9 m apart" in note]
        assert bool(told) == (number == 1 and smooth), made
    fine, coarse = found
    # Faces beside things that stand on the ground are cut further.
    assert len(coarse.faces) < 0.4 * len(fine.faces) if smooth else len(coarse.faces) == len(fine.faces)
    at = np.random.default_rng(0).uniform(-20.0, 20.0, (500, 2))
    off = Ground([fine])(*at.T) - Ground([coarse])(*at.T)
    assert np.sqrt(np.mean(off**2)) < 0.03
    # The same places have the same texels.
    for each in found:
        plane = np.column_stack([each.vertices[each.faces].reshape(-1, 3)[:, :2], np.ones(3 * len(each.faces))])
        fit = np.linalg.lstsq(plane, each.uv.reshape(-1, 2), rcond=None)[0]
        assert np.abs(plane @ fit - each.uv.reshape(-1, 2)).max() < 2e-3
    np.testing.assert_allclose(fine.vertices.min(axis=0)[:2], coarse.vertices.min(axis=0)[:2], atol=1e-3)
    np.testing.assert_allclose(fine.vertices.max(axis=0)[:2], coarse.vertices.max(axis=0)[:2], atol=1e-3)


def test_what_nobody_has_seen_is_flagged_and_listed(model, tmp_path):
    import_terrain(model / "dsm.tif", None, tmp_path / "s", three_d=ThreeD(model / "dem.tif"))
    scene = tr.load_scene(tmp_path / "s")
    flagged = {name: bool((surface.flags & FILLED).all()) for name, surface in surfaces(scene).items()}
    assert flagged == {"ground": False, "roofs": False, "walls": True, "trunks": True, "sphere": True}
    assert {row[0] for row in make_plan(scene, Sampling.of(rays=16)).rows() if row[1] == "inferred"} == {
        "walls",
        "trunks",
        "broadleaf_crowns",
    }
    renderer = tr.Renderer(scene, quality="fast", rays=16)
    frame = renderer.frame(scene.pose(-7.0, -20.0, 6.0, look_at=(-7.0, 3.0, 0.0)))
    names = np.array([material.name for material in scene.materials])
    shown = names[np.minimum(frame.truth["material"], len(names) - 1)]
    wall = np.isin(shown, ("brick_painted", "wood"))
    assert wall.mean() > 0.05 and (frame.truth["mask"][wall] & FILLED != 0).all()


def test_the_ground_below_objects_is_found():
    bare = detection.ground_below(heights(), 1.0)
    # The lowest filter leaves the slope as it is, and fills house and tree linearly.
    assert np.abs(bare - GROUND).max() < 0.35 and np.abs(bare - GROUND).mean() < 0.05


def test_wrong_arguments(model, tmp_path):
    with pytest.raises(ThermorenderError, match="fill is for a raster of heights"):
        import_terrain(model / "dsm.tif", None, tmp_path / "s", ImportSettings(fill=True), ThreeD())
    (tmp_path / "none.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": []}))
    with pytest.raises(ThermorenderError, match="has no polygon with a tag 'building'"):
        import_terrain(
            model / "dsm.tif", None, tmp_path / "s", ImportSettings(known=tmp_path / "none.geojson"), ThreeD()
        )
    done = CliRunner().invoke(cli.app, ["import-terrain", str(model / "dsm.tif"), "-o", str(tmp_path / "s"),
                                        "--wall", "brick_clay"])  # fmt: skip
    assert done.exit_code != 0 and "--ground, --wall and --building-class are for scenes" in str(done.exception)
    assert not (tmp_path / "s").exists()


def test_outlines_of_a_gis_are_read_with_rows_without_a_shape(model, tmp_path):
    content = json.loads((model / "known.geojson").read_text())
    content["features"].insert(0, {"type": "Feature", "properties": {"building": "yes"}, "geometry": None})
    (tmp_path / "known.geojson").write_text(json.dumps(content))
    made = import_terrain(
        model / "dsm.tif", None, tmp_path / "s", ImportSettings(known=tmp_path / "known.geojson"), ThreeD()
    )
    assert made["buildings"] == 1
    # The same outline without a tag, and a member "crs" of null, which stands for longitude and latitude.
    del content["features"][2]["properties"]["building"]
    (tmp_path / "known.geojson").write_text(json.dumps(content))
    with pytest.raises(ThermorenderError, match=r"1 polygons without a tag 'building'.*building=yes"):
        import_terrain(
            model / "dsm.tif", None, tmp_path / "t", ImportSettings(known=tmp_path / "known.geojson"), ThreeD()
        )
    write_text(tmp_path / "l.geojson", '{"features": [], "crs": null}')
    assert read_features(tmp_path / "l.geojson")[1].is_geographic


def test_a_roof_with_missing_posts_is_a_building(model, tmp_path):
    gone = np.random.default_rng(3).random(HOUSE.shape) < 0.2
    gaps = np.where(gone, np.nan, heights())[None].astype(np.float32)
    write_raster(tmp_path / "dsm.tif", gaps, corner=CORNER, nodata=np.nan)
    import_terrain(tmp_path / "dsm.tif", None, tmp_path / "s", three_d=ThreeD(model / "dem.tif"))
    roof = surfaces(tr.load_scene(tmp_path / "s"))["roofs"]
    (a, b), (c, d) = np.moveaxis(np.diff(roof.vertices[roof.faces][..., :2], axis=1), (1, 2), (0, 1))
    plan = 0.5 * np.abs(a * d - b * c).sum()
    # Of 14 by 9 m; outlines by height are within a post of it.
    assert 12 * 7 < plan < 16 * 11


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
    import_terrain(tmp_path / "dsm.tif", None, tmp_path / "s", ImportSettings(known=tmp_path / "b.geojson"), ThreeD())
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
    bare = detection.ground_given(ground, heights(), 1.0)
    assert np.abs(bare - GROUND)[:, :40].max() < 0.05
    assert np.abs(bare - GROUND)[:, 40:].max() < 0.5


@pytest.mark.parametrize("shift", [-100.0, 30.0])
def test_a_terrain_model_from_another_level_is_refused(shift):
    with pytest.raises(ThermorenderError, match="count from different levels"):
        detection.check_levels(GROUND + shift, heights(), 1.0)


def outlined(folder, path, rings):
    """A file with one building of rings of columns and rows."""
    corners = [[[CORNER[0] + x, CORNER[1] - y] for x, y in ring] for ring in rings]
    feature = {"type": "Feature", "properties": {"building": "yes"},
               "geometry": {"type": "Polygon", "coordinates": corners}}  # fmt: skip
    crs = {"type": "name", "properties": {"name": "EPSG:32634"}}
    path.write_text(json.dumps({"type": "FeatureCollection", "crs": crs, "features": [feature]}))
    return outlines_in(path, grid_of(folder))[0]


def test_outlines_keep_their_corners_whether_closed_or_not(model, tmp_path):
    corners = [(10, 12), (24, 12), (24, 21), (10, 21)]
    for ring in (corners, [*corners, corners[0]], [corners[0], *corners, corners[0]]):
        ((outer,),) = (each.rings for each in outlined(model, tmp_path / "k.geojson", [ring]))
        assert sorted(map(tuple, outer.round(6))) == sorted(corners)


def boxes(*given):
    """[Outline] of rectangles (left, top, right, bottom) in posts."""
    return [detection.Outline([np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], float)]) for x0, y0, x1, y1 in given]


def lengths(loops):
    """(Length of a building's border on open ground, and to each other building) [posts]."""
    open_ground, shared = 0.0, {}
    for loop in loops:
        piece = np.linalg.norm(np.roll(loop.point, -1, axis=0) - loop.point, axis=1)
        for length, other in zip(piece, loop.beyond.tolist(), strict=True):
            if other == OPEN:
                open_ground += length
            else:
                shared[other] = shared.get(other, 0.0) + length
    return round(open_ground, 6), {other: round(length, 6) for other, length in shared.items()}


@pytest.mark.parametrize(
    ("outlines", "expected"),
    [
        # Terraced houses, one deeper than the other; drawn 0.2 m apart; overlapping by a metre.
        (boxes((5, 5, 15, 15), (15, 5, 25, 20)), [(30.0, {1: 10.0}), (40.0, {0: 10.0})]),
        (boxes((5, 5, 15, 15), (15.2, 5, 25, 15)), [(30.0, {1: 10.0}), (30.0, {0: 10.0})]),
        (boxes((5, 5, 15, 15), (14, 5, 34, 15)), [(30.0, {1: 10.0}), (48.0, {0: 10.0})]),
        # A tower inside a block, and the same block twice.
        (boxes((5, 5, 25, 25), (10, 10, 15, 15)), [(80.0, {1: 20.0}), (0.0, {0: 20.0})]),
        (boxes((5, 5, 25, 25), (5, 5, 25, 25)), [(0.0, {}), (80.0, {})]),
        # Buildings cross each other.
        (boxes((5, 10, 35, 14), (15, 5, 20, 30)), [(58.0, {1: 10.0}), (52.0, {0: 10.0})]),
        # Over the edge of the grid.
        (boxes((-9, 10, 10.5, 20)), [(40.0, {})]),
        # Corners in an order that crosses itself: two triangles.
        ([detection.Outline([np.array([[5, 5], [15, 15], [15, 5], [5, 15]], float)])], [(48.284271, {})]),
    ],
)
def test_each_piece_of_wall_stands_once(outlines, expected):
    made = borders(outlines, (48, 48), 1.0)
    assert [lengths(loops) for loops in made] == expected
    # Buildings lie to the left of their borders in the world, so that the area in (column, row) is negative.
    for loops in made:
        x, y = np.concatenate([loop.point for loop in loops]).T if loops else np.zeros((2, 0))
        x1, y1 = np.concatenate([np.roll(loop.point, -1, axis=0) for loop in loops]).T if loops else (x, y)
        assert not loops or 0.5 * (x * y1 - x1 * y).sum() < 0.0


def test_terraces_drawn_by_hand_have_no_walls_inside():
    """Corners are 0.1 m off, so that houses of a row overlap or leave gaps, some at others' sides."""
    random, outlines = np.random.default_rng(0), []
    for row in (5, 27, 49):
        for left in range(5, 105, 20):
            corner = np.array([[0, 0], [20, 0], [20, 12], [10, 12], [10, 16], [0, 16]], float) + [left, row]
            outlines.append(detection.Outline([corner + random.uniform(-0.1, 0.1, corner.shape)]))
    made = borders(outlines, (120, 120), 1.0)
    for number, loops in enumerate(made):
        (loop,) = loops
        x, y = loop.point.T
        assert -0.5 * (x * np.roll(y, -1) - np.roll(x, -1) * y).sum() == pytest.approx(280.0, abs=8.0)
        in_row = {number + k for k in (-1, 1) if 0 <= (number % 5) + k < 5}
        assert set(loop.beyond.tolist()) == in_row | {OPEN}
        shared = lengths(loops)[1]
        # Walls to neighbours are 12 m long, where the other is not deeper.
        assert all(length == pytest.approx(12.0, abs=0.5) for length in shared.values())


def features(path, shapes):
    """Write a GeoJSON of [(ring of columns and rows, tags)]."""
    made = [
        {"type": "Feature", "properties": tags, "geometry": {"type": "Polygon", "coordinates": [
            [[CORNER[0] + x, CORNER[1] - y] for x, y in ring]]}}
        for ring, tags in shapes
    ]  # fmt: skip
    crs = {"type": "name", "properties": {"name": "EPSG:32634"}}
    path.write_text(json.dumps({"type": "FeatureCollection", "crs": crs, "features": made}))
    return path


def ring_of(left, top, right, bottom):
    return [(left, top), (right, top), (right, bottom), (left, bottom)]


@pytest.fixture(scope="module")
def terrace(tmp_path_factory):
    """A surface model of two adjoining houses, 5 and 9 m high, on level ground."""
    folder = tmp_path_factory.mktemp("terrace")
    height = np.full((SIDE, SIDE), 20.0, np.float32)
    height[15:30, 10:20], height[15:30, 20:30] = 25.0, 29.0
    write_raster(folder / "dsm.tif", height[None], corner=CORNER)
    return folder


def wall_areas(scene):
    """{rounded east of the plane or None: area} of walls that face east or west, and the sum of all."""
    walls = surfaces(scene)["walls"]
    corner = walls.vertices[walls.faces]
    across = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    area = 0.5 * np.linalg.norm(across, axis=1)
    facing = np.abs(across[:, 0]) > 0.9 * 2.0 * area
    east = corner.mean(axis=1)[:, 0].round().astype(int)
    return {int(e): float(area[facing & (east == e)].sum()) for e in np.unique(east[facing])}, float(area.sum())


def test_a_tip_that_smaller_outlines_leave_of_another_has_no_walls():
    """A wedge of 20 posts, of which rectangles cover all but the last 0.35: a border of two points."""
    wedge = detection.Outline([np.array([[10.0, 16.0], [30.0, 16.5], [10.0, 17.0]])])
    ends = np.linspace(9.0, 29.65, 9)
    made = borders([wedge, *boxes(*((x0, 15, x1, 18) for x0, x1 in itertools.pairwise(ends)))], (48, 48), 1.0)
    assert not made[0] and all(made[1:])


@pytest.mark.parametrize("overlap", [0.0, 0.2, 2.0])
def test_the_wall_between_two_houses_is_the_step_between_their_roofs(terrace, tmp_path, overlap):
    """10 m wide each, 15 m deep: the party wall has 15 by 4 m, above the lower roof, and faces it."""
    known = features(tmp_path / "k.geojson", [(ring_of(10, 15, 20 + overlap, 30), {"building": "house"}),
                                              (ring_of(20, 15, 30, 30), {"building": "house"})])  # fmt: skip
    made = import_terrain(terrace / "dsm.tif", None, tmp_path / "s", ImportSettings(known=known), ThreeD())
    assert made["buildings"] == 2
    planes, total = wall_areas(tr.load_scene(tmp_path / "s"))
    expected = {-14: 15 * 5.5, -4: 15 * 4.0, 6: 15 * 9.5}
    assert planes == pytest.approx(expected, rel=0.02)
    assert total == pytest.approx(sum(expected.values()) + 2 * 10 * 5.5 + 2 * 10 * 9.5, rel=0.02)


def test_walls_are_those_that_outlines_declare(terrace, tmp_path):
    known = features(tmp_path / "k.geojson", [
        (ring_of(10, 15, 20, 30), {"building": "garage", "building:material": "reed", "building:colour": "#ff0000"}),
        (ring_of(20, 15, 30, 30), {"building": "yes", "building:material": "brick", "building:colour": "striped"}),
    ])  # fmt: skip
    three_d = ThreeD(wall=["garage=concrete", "barn=wood"])
    made = import_terrain(terrace / "dsm.tif", None, tmp_path / "s", ImportSettings(known=known), three_d)
    # Each has one declaration with a match.
    assert made["stated_walls"] == 2
    assert made["unmatched"] == {
        "building:material=reed": 1, "building:colour=striped": 1, "building=barn of wall": 0
    }  # fmt: skip
    scene = tr.load_scene(tmp_path / "s")
    walls = surfaces(scene)["walls"]
    names = np.array([material.name for material in scene.materials])[walls.material]
    assert {"concrete", "brick_clay"} <= set(names.ravel()) and "brick_painted" not in names
    # The garage is red, up to stains and the frames of windows.
    red, green, blue = np.moveaxis(walls.colour[names == "concrete"].astype(int), -1, 0)
    assert np.median(red) > 200 and np.median(green) == np.median(blue) == 0
    plain = features(tmp_path / "p.geojson", [(ring_of(10, 15, 20, 30), {"building": "yes", "material": "granite"})])
    made = import_terrain(terrace / "dsm.tif", None, tmp_path / "t", ImportSettings(known=plain), ThreeD())
    assert (made["stated_walls"], made["unmatched"]) == (1, {})
    assert "granite" in {material.name for material in tr.load_scene(tmp_path / "t").materials}


def test_a_class_of_a_raster_is_the_outline_of_buildings(terrace, tmp_path):
    classes = np.ones((SIDE, SIDE), np.uint8)
    classes[15:30, 10:30] = 2
    write_raster(tmp_path / "classes.tif", classes[None], corner=CORNER)
    known = tmp_path / "classes.tif"
    made = import_terrain(
        terrace / "dsm.tif", None, tmp_path / "s", ImportSettings(known=known), ThreeD(building_class=2)
    )
    assert made["buildings"] == 1
    planes, _ = wall_areas(tr.load_scene(tmp_path / "s"))
    # One outline, whose roof steps by 4 m in the middle.
    assert planes == pytest.approx({-14: 15 * 5.5, -4: 15 * 4.0, 6: 15 * 9.5}, rel=0.03)
    for number, words in (
        (None, "give building_class, the number of its buildings"),
        (7, r"holds the classes \[1, 2\]"),
        (0, "building_class=0 marks pixels without data"),
    ):
        with pytest.raises(ThermorenderError, match=words):
            import_terrain(
                terrace / "dsm.tif", None, tmp_path / "t", ImportSettings(known=known), ThreeD(building_class=number)
            )


def test_a_building_of_three_corners_covers_its_posts(model):
    corner = np.array([[4, 4], [20, 4], [4, 20]], float)
    covered = detection.inside([detection.Outline([corner])], grid_of(model))
    # Half of 16 by 16 posts, but for those on the long side.
    assert 112 <= covered.sum() <= 136 and covered[6, 6] and not covered[18, 18]


@pytest.mark.parametrize("coordinates", [5, [5], [[5]], None])
def test_a_polygon_without_corners_is_refused(model, tmp_path, coordinates):
    path = features(tmp_path / "k.geojson", [(ring_of(10, 12, 24, 21), {"building": "yes"})])
    content = json.loads(path.read_text())
    content["features"][0]["geometry"]["coordinates"] = coordinates
    path.write_text(json.dumps(content))
    with pytest.raises(ThermorenderError, match="feature 1 "):
        outlines_in(path, grid_of(model))


def test_buildings_outside_of_the_model_are_counted(model, tmp_path):
    path = features(tmp_path / "k.geojson", [(ring_of(500, 500, 520, 520), {"building:part": "yes"})])
    with pytest.raises(ThermorenderError, match=r"no polygon with a tag 'building' on .* \(left out: 1 outside of"):
        outlines_in(path, grid_of(model))


def test_posts_far_apart_need_outlines(tmp_path):
    """At 2 m, a house of 8 by 16 m was taken for a tree."""
    height = np.full((30, 30), 20.0, np.float32)
    height[10:14, 10:18] = 28.0
    write_raster(tmp_path / "dsm.tif", height[None], step=2.0, corner=CORNER)
    with pytest.raises(ThermorenderError, match=r"posts 2 m apart.*give a finer model \(or more max_vertices"):
        import_terrain(tmp_path / "dsm.tif", None, tmp_path / "s", three_d=ThreeD())
    known = features(tmp_path / "k.geojson", [(ring_of(20, 20, 36, 28), {"building": "yes"})])
    made = import_terrain(tmp_path / "dsm.tif", None, tmp_path / "s", ImportSettings(known=known), ThreeD())
    assert (made["buildings"], made["trees"]) == (1, 0)


BLOCK = (COLUMN > 10) & (COLUMN < 38) & (ROW > 12) & (ROW < 36)
ANNEX = (COLUMN > 26) & (COLUMN < 38) & (ROW > 20) & (ROW < 36)


@pytest.mark.parametrize("smeared", [False, True])
@pytest.mark.parametrize("turned", [False, True])
def test_a_block_and_its_low_annex_in_one_outline_have_a_wall_between_their_roofs(tmp_path, smeared, turned):
    """A block of 28 by 24 m, 12 m high, with an annex of 12 by 16 m, 4 m high, in its corner."""
    height = np.where(ANNEX, 24.0, np.where(BLOCK, 32.0, 20.0))
    if smeared:
        # A post at the step with a height between, as a matched surface model has it.
        height[ANNEX & (COLUMN < 27)] = 28.0
        height[ANNEX & (ROW < 21)] = 28.0
    ring = [(10, 12), (38, 12), (38, 36), (10, 36)]
    write_raster(tmp_path / "dsm.tif", height[None].astype(np.float32), corner=CORNER)
    known = features(tmp_path / "k.geojson", [(ring[::-1] if turned else ring, {"building": "yes"})])
    made = import_terrain(tmp_path / "dsm.tif", None, tmp_path / "s", ImportSettings(known=known), ThreeD())
    assert made["buildings"] == 1
    of = surfaces(scene := tr.load_scene(tmp_path / "s"))
    roof, faces = of["roofs"].vertices, of["roofs"].faces
    origin = scene.frame.height_m
    # Every triangle of a roof is level at one of both heights: no curtain.
    up = roof[faces][..., 2] + origin
    assert np.ptp(up, axis=1).max() < 0.2
    assert np.abs(up[..., None] - [24.0, 32.0]).min(axis=-1).max() < 0.2
    corner = roof[faces][..., :2]
    edge = corner[:, 1:] - corner[:, :1]
    area = 0.5 * np.abs(edge[:, 0, 0] * edge[:, 1, 1] - edge[:, 0, 1] * edge[:, 1, 0])
    low = up.mean(axis=1) < 28.0
    # The step's line is within a post of the drawn one, along 28 m of it, but for its simplified corners.
    assert area[low].sum() == pytest.approx(12.0 * 16.0, abs=28.0)
    assert area.sum() == pytest.approx(28.0 * 24.0, rel=0.01)
    walls = of["walls"].vertices[of["walls"].faces]
    middle = walls.mean(axis=1)
    step = (np.abs(middle[:, 0]) < 13.9) & (np.abs(middle[:, 1]) < 11.9)
    across = np.cross(walls[step][:, 1] - walls[step][:, 0], walls[step][:, 2] - walls[step][:, 0])
    assert 0.5 * np.linalg.norm(across, axis=1).sum() == pytest.approx(28.0 * 8.0, rel=0.1)
    assert walls[step][..., 2].min() + origin == pytest.approx(24.0, abs=0.2)


@pytest.mark.parametrize("flat", [False, True])
def test_steep_roofs_and_steps_below_a_storey_are_not_cut(flat):
    """A gable of 45° with a chimney, and a flat roof with a stair head of 5 by 4 m, 2 m high."""
    height = np.where(HOUSE, 27.0 if flat else 31.0 - np.abs(ROW - 16.5), 20.0)
    if flat:
        height[14:18, 13:18] += 2.0
    height[16, 20] += 4.0
    outline = detection.Outline([np.array([(10, 12), (24, 12), (24, 21), (10, 21)], float)])
    made, clear = cut_at_steps([outline], height, np.full_like(height, 20.0), 1.0)
    assert made == [outline] and (clear == height).all()
