"""What files state on buildings: odd GeoJSON, parts, courtyards, and the levels that heights count from."""

import json

import numpy as np
import pytest
from rasterio.crs import CRS

import thermorender as tr
from scenes import write_raster
from thermorender.apps.lands.import_settings import ImportSettings, ThreeD
from thermorender.apps.lands.import_terrain import import_terrain
from thermorender.apps.lands.solids import detection
from thermorender.apps.lands.solids.outlines import is_building, outlines_in
from thermorender.errors import ThermorenderError
from thermorender.scene.terrain import read_elevation, zero_of_heights

SIDE, CORNER = 64, (500000.0, 5780000.0)
row, column = np.mgrid[:SIDE, :SIDE] + 0.5
GROUND = 20.0 + 0.02 * column


def box(left, top, right, bottom):
    return (column > left) & (column < right) & (row > top) & (row < bottom)


HOUSE = np.where(box(10, 12, 24, 21), GROUND + 7.0, GROUND)
COURT = np.where(box(10, 12, 50, 50) & ~box(20, 22, 40, 40), GROUND + 10.0, GROUND)


def ring(left, top, right, bottom):
    corners = ((left, top), (right, top), (right, bottom), (left, bottom), (left, top))
    return [[CORNER[0] + x, CORNER[1] - y] for x, y in corners]


def polygon(*rings):
    return {"type": "Polygon", "coordinates": list(rings)}


OUTLINE = ring(10, 12, 24, 21)


def collected(path, *features):
    """A GeoJSON of (geometry, tags)."""
    listed = [{"type": "Feature", "properties": tags, "geometry": shape} for shape, tags in features]
    crs = {"type": "name", "properties": {"name": "EPSG:32634"}}
    path.write_text(json.dumps({"type": "FeatureCollection", "crs": crs, "features": listed}))
    return path


def imported(folder, height, *features, **how):
    """(Summary of an import, {name: (area, area in the plan)} of its surfaces)."""
    write_raster(folder / "dsm.tif", height[None].astype(np.float32), corner=CORNER)
    known = collected(folder / "k.geojson", *features)
    made = import_terrain(folder / "dsm.tif", None, folder / "s", ImportSettings(known=known), ThreeD(**how))
    areas = {}
    for surface in tr.load_scene(folder / "s").surfaces:
        corner = surface.vertices[surface.faces]
        across = 0.5 * np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        areas[surface.name.split(":")[1]] = np.linalg.norm(across, axis=1).sum(), np.abs(across[:, 2]).sum()
    return made, areas


@pytest.mark.parametrize(
    "shape",
    [
        {"type": "GeometryCollection", "geometries": [{"type": "Point", "coordinates": [0, 0]}, polygon(OUTLINE)]},
        # A closed way of OpenStreetMap; heights of corners; clockwise.
        {"type": "LineString", "coordinates": OUTLINE},
        polygon([[*corner, 27.0] for corner in OUTLINE]),
        polygon(OUTLINE[::-1]),
        {"type": "MultiPolygon", "coordinates": [[OUTLINE]]},
    ],
)
def test_an_outline_of_any_kind_is_a_building(tmp_path, shape):
    made, areas = imported(tmp_path, HOUSE, (shape, {"building": "yes"}))
    assert (made["buildings"], made["trees"], made["known"]) == (1, 0, ())
    assert areas["roofs"][1] == pytest.approx(14 * 9, rel=0.01)


def test_what_a_file_states_beside_outlines_is_counted(tmp_path):
    """An underground car park below a tree had a roof of 400 m² at the height of the tree."""
    tree = np.where(np.hypot(column - 45, row - 45) < 4, 8.0, 0.0)
    made, areas = imported(
        tmp_path, HOUSE + tree,
        (polygon(OUTLINE), {"building": "roof"}),
        (polygon(ring(10, 12, 14, 21)), {"building:part": "yes", "min_height": "3 m"}),
        (polygon(ring(35, 35, 55, 55)), {"building": "parking", "location": "underground"}),
        (polygon(ring(35, 5, 40, 10)), {"building": "demolished"}),
        (polygon(ring(35, 5, 40, 10)), {"height": "7"}),
        (polygon(ring(500, 5, 510, 10)), {"building": "yes"}),
        ({"type": "Point", "coordinates": OUTLINE[0]}, {"building": "yes"}),
        ({"type": "LineString", "coordinates": OUTLINE[:2]}, {"highway": "path"}),
        (None, {"building": "yes"}),
    )  # fmt: skip
    assert made["known"] == (
        "k.geojson: 2 outlines of buildings; left out: 2 polygons without a tag 'building', 1 underground, "
        "1 outside of the model, 1 drawn as Point, 1 without a shape",
        "k.geojson: 1 outlines begin above the ground by their tags, and their walls reach down to it",
        "k.geojson: 1 outlines are roofs without walls by their tags, and have walls",
    )
    assert (made["buildings"], made["trees"]) == (1, 1)
    assert areas["roofs"][1] == pytest.approx(14 * 9, rel=0.01)


@pytest.mark.parametrize(("stated", "count"), [("0", 0), ("0.0", 0), ("-1", 0), ("2,5", 1), ("12 ft", 1), ("low", 0)])
def test_heights_of_feet_are_read_with_units_and_commas(tmp_path, stated, count):
    made, _ = imported(tmp_path, HOUSE, (polygon(OUTLINE), {"building": "yes", "building:min_level": stated}))
    assert len(made["known"]) == count


@pytest.mark.parametrize("packed", [
    {"other_tags": '"building:part"=>"yes","building:colour"=>"red","name"=>"a \\"b\\" => c"'},
    {"tags": '{"building:part": "yes", "building:colour": "red", "name": "a \\"b\\" => c"}'},
    {"tags": {"building:part": "yes", "building:colour": "red", "name": 'a "b" => c'}},
])  # fmt: skip
def test_tags_in_one_property_are_read(tmp_path, packed):
    """GDAL writes the tags of OpenStreetMap without a column of their own into other_tags."""
    path = collected(tmp_path / "k.geojson", (polygon(OUTLINE), {"osm_id": "1", **packed}))
    write_raster(tmp_path / "g.tif", HOUSE[None].astype(np.float32), corner=CORNER)
    ((outline,), _) = outlines_in(path, read_elevation(tmp_path / "g.tif")[1])
    assert outline.tags["building:colour"] == "red" and outline.tags["name"] == 'a "b" => c'


def test_a_hole_beside_its_outline_is_no_building(tmp_path):
    _, areas = imported(tmp_path, HOUSE, (polygon(OUTLINE, ring(40, 40, 45, 45)), {"building": "yes"}))
    assert areas["roofs"][1] == pytest.approx(14 * 9, rel=0.01)


def corners(*places):
    return [[CORNER[0] + x, CORNER[1] - y] for x, y in places]


@pytest.mark.parametrize(
    ("shape", "reason"),
    [
        (polygon(), "with no area or almost none"),
        (polygon([]), "with no area or almost none"),
        (polygon(corners((12, 14))), "with no area or almost none"),
        (polygon(corners((12, 14), (20, 14), (12, 14))), "with no area or almost none"),
        (polygon(corners((12, 14), (16, 14), (20, 14), (12, 14))), "with no area or almost none"),
        # 8 m by 1 cm, through the middles of posts; and a triangle, whose border had two points.
        (polygon(corners((12, 14.495), (20, 14.495), (20, 14.505), (12, 14.505))), "with no area or almost none"),
        (polygon(corners((12, 14.495), (20, 14.5), (12, 14.505))), "with no area or almost none"),
        ({"type": "LineString", "coordinates": corners((12, 14), (16, 14), (20, 14), (12, 14))},
         "with no area or almost none"),
        ({"type": "MultiPolygon", "coordinates": []}, "without a shape"),
    ],
)  # fmt: skip
def test_an_outline_without_area_is_left_out_and_the_others_are_read(tmp_path, shape, reason):
    made, areas = imported(tmp_path, HOUSE, (shape, {"building": "yes"}), (polygon(OUTLINE), {"building": "yes"}))
    assert made["known"] == (f"k.geojson: 1 outlines of buildings; left out: 1 {reason}",)
    assert areas["roofs"][1] == pytest.approx(14 * 9, rel=0.01)
    with pytest.raises(ThermorenderError, match=rf"has no polygon with a tag 'building' .*left out: 1 {reason}"):
        outlines_in(
            collected(tmp_path / "k.geojson", (shape, {"building": "yes"})), read_elevation(tmp_path / "dsm.tif")[1]
        )


def test_the_rest_of_a_multipolygon_and_of_its_holes_is_read(tmp_path):
    """One polygon of three is empty. Of the other's holes one is a line, one empty, and one beside the outline."""
    holes = corners((12, 14), (16, 14), (20, 14), (12, 14)), [], ring(40, 40, 45, 45)
    shape = {"type": "MultiPolygon", "coordinates": [[], [OUTLINE, *holes]]}
    made, areas = imported(tmp_path, HOUSE, (shape, {"building": "yes"}))
    left_out = "2 holes without area, 1 with no area or almost none, 1 holes beside their outlines"
    assert made["known"] == (f"k.geojson: 1 outlines of buildings; left out: {left_out}",)
    assert areas["roofs"][1] == pytest.approx(14 * 9, rel=0.01)


def test_an_outline_that_crosses_itself_is_two_triangles(tmp_path):
    """8 by 6 m: each triangle has a quarter of the rectangle."""
    tie = corners((12, 14), (20, 20), (20, 14), (12, 20))
    made, areas = imported(tmp_path, HOUSE, (polygon(tie), {"building": "yes"}))
    assert (made["buildings"], made["known"]) == (1, ())
    assert areas["roofs"][1] == pytest.approx(8 * 6 / 2, rel=0.01)


def test_corners_beyond_any_map_are_refused(tmp_path):
    with pytest.raises(ThermorenderError, match="feature 1 has corners that are not coordinates of EPSG:32634"):
        imported(tmp_path, HOUSE, (polygon([[1e308, 1e308], *OUTLINE]), {"building": "yes"}))


@pytest.mark.parametrize(("nodata", "low", "said"), [(None, 200.0, True), (None, 3.0, False), (-9999.0, 200.0, False)])
def test_heights_of_zero_far_below_all_others_are_named(tmp_path, nodata, low, said):
    gaps = np.where(column > 60.0, 0.0, HOUSE - 20.0 + low)
    write_raster(tmp_path / "dsm.tif", gaps[None].astype(np.float32), corner=CORNER, nodata=nodata)
    made = import_terrain(tmp_path / "dsm.tif", None, tmp_path / "s")
    words = (
        "dsm.tif has 256 posts of exactly 0 m, and all others are 200 m or higher: if they are missing, declare "
        "it with `rio edit-info --nodata 0 FILE`"
    )
    assert made["known"] == ((words,) if said else ())
    write_raster(tmp_path / "dtm.tif", gaps[None].astype(np.float32), corner=CORNER, nodata=nodata)
    write_raster(tmp_path / "dsm.tif", (HOUSE - 20.0 + low)[None].astype(np.float32), corner=CORNER)
    made = import_terrain(tmp_path / "dsm.tif", None, tmp_path / "t", three_d=ThreeD(tmp_path / "dtm.tif"))
    assert made["known"] == ((words.replace("dsm", "dtm"),) if said else ())


def test_latitudes_before_longitudes_are_named(tmp_path):
    write_raster(tmp_path / "dsm.tif", HOUSE[None].astype(np.float32), corner=CORNER)
    corners = [(21.0002, 52.1704), (21.0004, 52.1704), (21.0004, 52.1702)]
    for path, ring in (("a.geojson", corners), ("b.geojson", [each[::-1] for each in corners])):
        shape = {"type": "Feature", "properties": {"building": "yes"}, "geometry": polygon(ring)}
        (tmp_path / path).write_text(json.dumps({"type": "FeatureCollection", "features": [shape]}))
    grid = read_elevation(tmp_path / "dsm.tif")[1]
    assert len(outlines_in(tmp_path / "a.geojson", grid)[0]) == 1
    with pytest.raises(ThermorenderError, match="left out: 1 with latitude before longitude"):
        outlines_in(tmp_path / "b.geojson", grid)


def test_a_demolished_building_is_none():
    assert is_building({"building": "house"}) and is_building({"building:part": "roof"})
    assert not is_building({"building": "False"}) and not is_building({"building": "demolished"})
    assert not is_building({"building:part": "no"})


@pytest.mark.parametrize("crowns", [0.2, 0.5])
def test_an_outline_below_a_tree_is_no_building_and_one_that_is_half_high_is(tmp_path, crowns):
    """The outline has 20 by 20 m; a fifth or half of it is high."""
    height = np.where(box(30, 30, 30 + 20 * crowns, 50), GROUND + 8.0, GROUND)
    made, _ = imported(tmp_path, height, (polygon(ring(30, 30, 50, 50)), {"building": "yes"}))
    assert (made["buildings"], made["flat_outlines"]) == ((1, 0) if crowns > 0.3 else (0, 1))


@pytest.mark.parametrize(
    "rings", [[[ring(10, 12, 50, 50)]], [[ring(10, 12, 50, 50), ring(20, 22, 40, 40)], [ring(10, 12, 50, 50)]]]
)
def test_a_courtyard_is_open_where_no_outline_has_a_hole(tmp_path, rings):
    """The block has 40 by 38 m, and its courtyard 20 by 18: roofs had covered both."""
    made, areas = imported(tmp_path, COURT, *((polygon(*each), {"building": "yes"}) for each in rings))
    assert made["buildings"] == 1
    assert areas["roofs"][1] == pytest.approx(40 * 38 - 20 * 18, rel=0.01)
    # Walls are 10 m high, and 0.5 m below the ground.
    assert areas["walls"][0] == pytest.approx(2 * (40 + 38 + 20 + 18) * 10.5, rel=0.05)


def test_ground_that_reaches_the_outline_is_no_courtyard(tmp_path):
    """An outline drawn 3 m off."""
    _, areas = imported(tmp_path, HOUSE, (polygon(ring(13, 15, 27, 24)), {"building": "yes"}))
    assert areas["roofs"][1] == pytest.approx(14 * 9, rel=0.01)


@pytest.mark.parametrize("width", [6, 10, 20])
def test_roofs_of_a_part_that_tapers_in_the_plan_are_level(tmp_path, width):
    """A wedge 30 m long is 8 m higher than the house around it. Posts of its tip made peaks of the lower roof."""
    wedge = (column > 20) & (column < 20 + width * (42 - row) / 30)
    height = np.where(box(10, 12, 50, 42), np.where(wedge, 32.0, 24.0), 20.0)
    made, areas = imported(tmp_path, height, (polygon(ring(10, 12, 50, 42)), {"building": "yes"}))
    assert made["buildings"] == 1
    assert areas["roofs"] == pytest.approx((40 * 30, 40 * 30), rel=0.002)
    # 8 m high on both sides of the wedge; its tip, narrower than two posts, may have none.
    step = areas["walls"][0] - 4.5 * 140 - 8 * width
    tip = 8 * 2 * 30 * 2 / width
    side = 8 * (30 + np.hypot(30, width))
    assert side - tip < step < 1.05 * side


@pytest.mark.parametrize("tag", ["building", "building:part"])
def test_a_step_that_falls_to_nothing_has_a_wall_where_an_outline_ends(tmp_path, tag):
    """A roof at 12 m beside one that rises from 4 to 12 m over 30 m: without its own outline there is a steep strip."""
    rising = 24.0 + 8.0 * (row - 12) / 30
    height = np.where(box(10, 12, 50, 42), np.where(column < 30, 32.0, rising), 20.0)
    house, part = polygon(ring(10, 12, 50 if ":" in tag else 30, 42)), polygon(ring(30, 12, 50, 42))
    _, areas = imported(tmp_path, height, (house, {"building": "yes"}), (part, {tag: "yes"}))
    outer = 12.5 * (20 + 30 + 20) + 4.5 * 20 + 12.5 * 20 + 8.5 * 30
    assert areas["walls"][0] - outer == pytest.approx(0.5 * 8 * 30, rel=0.02)
    assert areas["roofs"][1] == pytest.approx(40 * 30, rel=0.002)


def test_parts_of_a_building_are_one_with_its_walls(tmp_path):
    """A part has the walls of its building, but for those of its own; another building's part is none of it."""
    whole = {"building": "garage", "building:colour": "red", "building:material": "wood"}
    path = collected(
        tmp_path / "k.geojson",
        (polygon(ring(10, 12, 17, 21)), {"building:part": "yes"}),
        (polygon(OUTLINE), whole),
        (polygon(ring(17, 12, 24, 21)), {"building:part": "yes", "building:cladding": "brick"}),
        (polygon(ring(40, 40, 45, 45)), {"building:part": "yes"}),
    )
    write_raster(tmp_path / "g.tif", HOUSE[None].astype(np.float32), corner=CORNER)
    plain, building, clad, other = outlines_in(path, read_elevation(tmp_path / "g.tif")[1])[0]
    assert plain.building is building and clad.building is building and other.building is other
    assert plain.tags == {**whole, "building:part": "yes"}
    assert clad.tags == {"building": "garage", "building:colour": "red", "building:part": "yes",
                         "building:cladding": "brick"}  # fmt: skip
    features = [(polygon(OUTLINE), whole), (polygon(ring(10, 12, 17, 21)), {"building:part": "yes"})]
    made, _ = imported(tmp_path, HOUSE, *features)
    assert (made["buildings"], made["stated_walls"], made["unmatched"]) == (1, 1, {})
    walls = next(s for s in tr.load_scene(tmp_path / "s").surfaces if s.name.endswith("walls"))
    materials = np.array([m.name for m in tr.load_scene(tmp_path / "s").materials])[walls.material]
    assert set(np.unique(materials)) <= {"wood", "glass"}


def wood(rough):
    """Heights of a closed wood above the ground: crowns of 3.2 m radius, 14 to 22 m high."""
    random = np.random.default_rng(3)
    above = np.zeros((SIDE, SIDE))
    for down in range(-2, SIDE + 4, 4):
        for right in range(-2, SIDE + 4, 4):
            x, y = right + random.uniform(-0.5, 0.5), down + random.uniform(-0.5, 0.5)
            near = np.clip(1.0 - ((column - x) ** 2 + (row - y) ** 2) / 3.2**2, 0.0, 1.0)
            above = np.maximum(above, np.where(near > 0.0, random.uniform(14.0, 22.0) - 8.0 + 8.0 * np.sqrt(near), 0.0))
    return above + rough * random.standard_normal(above.shape)


def test_a_wood_without_a_gap_above_its_terrain_model_is_a_wood(tmp_path):
    above = wood(0.05)
    assert above.min() > 5.0
    write_raster(tmp_path / "dsm.tif", (GROUND + above)[None].astype(np.float32), corner=CORNER)
    write_raster(tmp_path / "dtm.tif", GROUND[None].astype(np.float32), corner=CORNER)
    made = import_terrain(tmp_path / "dsm.tif", None, tmp_path / "s", three_d=ThreeD(tmp_path / "dtm.tif"))
    # Crowns are 4 m apart; many are below the next one's flank, and the widest top takes those within 1.5 m.
    assert 16 * 16 / 4 < made["trees"] < 16 * 16


@pytest.mark.parametrize("share", [0.03, 0.3, 1.0])
@pytest.mark.parametrize("shift", [-40.0, 3.0, 40.0])
def test_an_offset_shows_where_ground_is_open(share, shift):
    """Ground with 0.1 m of noise is open on a share of the posts, and the rest is a closed wood."""
    random = np.random.default_rng(4)
    above = np.where(column < 1.0 + share * SIDE, 0.0, wood(0.05)) + 0.1 * random.standard_normal(GROUND.shape)
    detection.check_levels(GROUND, GROUND + above, 1.0)
    with pytest.raises(ThermorenderError, match="count from different levels"):
        detection.check_levels(GROUND, GROUND + above + shift, 1.0)
    if shift > 0.0:
        detection.check_levels(GROUND, GROUND + above + shift, 1.0, declared=True)


@pytest.mark.parametrize("farm", [False, True])
def test_a_closed_crop_is_refused_with_its_terrain_model_and_is_the_ground_without(tmp_path, farm):
    """Maize of 2.6 m with 0.05 m of noise cannot be told from an offset. A farmhouse in it is 7 m high."""
    above = 2.6 + 0.05 * np.random.default_rng(0).standard_normal(GROUND.shape)
    above = np.where(box(30, 30, 40, 42), 7.0, above) if farm else above
    write_raster(tmp_path / "dsm.tif", (GROUND + above)[None].astype(np.float32), corner=CORNER)
    write_raster(tmp_path / "dtm.tif", GROUND[None].astype(np.float32), corner=CORNER)
    with pytest.raises(
        ThermorenderError, match=r"or a closed crop covers everything; .* above a crop, leave ground out"
    ):
        import_terrain(tmp_path / "dsm.tif", None, tmp_path / "s", three_d=ThreeD(tmp_path / "dtm.tif"))
    made = import_terrain(tmp_path / "dsm.tif", None, tmp_path / "s", three_d=ThreeD())
    assert (made["buildings"], made["trees"]) == (int(farm), 0)
    scene = tr.load_scene(tmp_path / "s")
    ground = next(s for s in scene.surfaces if s.name.endswith("ground")).vertices[:, 2] + scene.frame.height_m
    # From 20 to 21.3 m, and 2.6 m of maize; its noise is within five standard deviations.
    assert ground.min() > 22.6 - 0.25 and ground.max() < 23.9 + 0.25


def test_a_surface_model_below_its_terrain_model_is_not_taken_for_a_crop():
    with pytest.raises(
        ThermorenderError, match="count from different levels; convert one of them, or leave ground out"
    ):
        detection.check_levels(GROUND, HOUSE - 8.0, 1.0, declared=True)


def test_a_terrain_model_above_open_ground_is_refused_though_most_of_the_model_is_wood():
    above = np.where(column < 0.3 * SIDE, 0.0, wood(0.05)) - 8.0
    assert np.median(above) > 2.0
    with pytest.raises(ThermorenderError, match="count from different levels"):
        detection.check_levels(GROUND, GROUND + above, 1.0)


@pytest.mark.parametrize("surface", ["EPSG:32634+5773", "EPSG:32634"])
@pytest.mark.parametrize(
    ("ground", "zero"),
    [("EPSG:32634+5621", "Reference Frame"), ("EPSG:32634+5773", "EGM96"), ("EPSG:4979", "ellipsoid")],
)
def test_vertical_datums_that_files_declare_are_compared(tmp_path, surface, ground, zero):
    write_raster(tmp_path / "dsm.tif", HOUSE[None].astype(np.float32), corner=CORNER, crs=surface)
    if ground == "EPSG:4979":
        step = 2e-5
        write_raster(tmp_path / "dtm.tif", np.full((1, 80, 80), 20, np.float32), corner=(20.9996, 52.1709), step=step,
                     crs=ground)  # fmt: skip
    else:
        write_raster(tmp_path / "dtm.tif", GROUND[None].astype(np.float32), corner=CORNER, crs=ground)
    run = lambda: import_terrain(tmp_path / "dsm.tif", None, tmp_path / "s", three_d=ThreeD(tmp_path / "dtm.tif"))  # noqa: E731
    if surface == "EPSG:32634" or zero == "EGM96":
        assert run()["buildings"] == 1
    else:
        with pytest.raises(ThermorenderError, match=rf"counts heights from '[^']*{zero}[^']*' .* '[^']*EGM96"):
            run()


def test_zero_of_heights_is_the_datum_whatever_the_unit():
    metres, feet = (zero_of_heights(CRS.from_user_input(f"EPSG:2263+{code}")) for code in (5703, 6360))
    assert metres == feet == "North American Vertical Datum 1988"
    own = CRS.from_wkt(CRS.from_user_input("EPSG:2263+5703").to_wkt().replace('AUTHORITY["EPSG","5103"]', "").replace(
        'AUTHORITY["EPSG","5703"]', "").replace(",]", "]").replace(",]", "]"))  # fmt: skip
    assert zero_of_heights(own) is None
    assert zero_of_heights(CRS.from_epsg(4979)) == "the ellipsoid" and zero_of_heights(CRS.from_epsg(32634)) is None


def test_a_terrain_model_of_a_part_says_so(tmp_path):
    write_raster(tmp_path / "dsm.tif", HOUSE[None].astype(np.float32), corner=CORNER)
    write_raster(tmp_path / "dtm.tif", GROUND[None, :, :48].astype(np.float32), corner=CORNER)
    made = import_terrain(tmp_path / "dsm.tif", None, tmp_path / "s", three_d=ThreeD(tmp_path / "dtm.tif"))
    words = "dtm.tif has no heights for 25.0% of the surface model; a filter estimates the ground there"
    assert made["known"] == (words,)
    assert made["buildings"] == 1


def test_posts_that_are_not_square_make_the_same_house(tmp_path):
    """Posts of 0.5 by 1 m; a house of 14 by 9 m, found by height."""
    import rasterio

    with rasterio.open(
        tmp_path / "dsm.tif", "w", driver="GTiff", count=1, dtype="float32", height=SIDE, width=2 * SIDE,
        crs="EPSG:32634", transform=rasterio.Affine(0.5, 0.0, CORNER[0], 0.0, -1.0, CORNER[1]),
    ) as dataset:  # fmt: skip
        dataset.write(np.repeat(HOUSE, 2, axis=1).astype(np.float32), 1)
    made = import_terrain(tmp_path / "dsm.tif", None, tmp_path / "s", three_d=ThreeD())
    assert (made["buildings"], made["trees"]) == (1, 0)
    assert made["post_m"] == pytest.approx(np.sqrt(0.5)) and made["posts"] == [90, 90]
    roof = next(s for s in tr.load_scene(tmp_path / "s").surfaces if s.name.endswith("roofs"))
    # Sides are straightened within a post.
    assert np.ptp(roof.vertices[:, :2], axis=0) == pytest.approx([14.0, 9.0], abs=2 * 0.71)
