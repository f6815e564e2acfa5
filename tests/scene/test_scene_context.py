"""Learned materials use what the scene knows: its weather, heights above the ground, and shapes of OpenStreetMap."""

import json
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

import thermorender as tr
from scenes import WEATHER, write_raster, write_terrain
from thermorender.apps.lands.procedural.procedural_scene import make
from thermorender.apps.training.emissivity_training import Labelled, train
from thermorender.apps.training.material_training import band_emissivity_of, labelled_scene
from thermorender.cli.app import app
from thermorender.errors import ThermorenderError
from thermorender.learned.emissivity import elevation
from thermorender.learned.emissivity.mapping import Evidence, load_map, map_materials, save_map
from thermorender.materials.library import load_library
from thermorender.materials.mixture import spectra_of
from thermorender.scene.mapped_cover import RULES, read_mapped_cover
from thermorender.scene.raster import grid_of
from thermorender.scene.surface import UNKNOWN
from thermorender.weather.named_day import named_day
from validation.emissivity import relief as fitted

EAST, NORTH = 500000.0, 5780000.0
WARM, COLD = WEATHER, WEATHER.replace("= 12.0", "= -6.0").replace("= 24.0", "= 2.0")


def learned(folder, more="", model="procedural", height=None, colour=None, weather=""):
    """A terrain scene of 32 m with texels of 0.5 m and materials of a learned map."""
    height = np.zeros((32, 32)) if height is None else height
    colour = np.full((64, 64, 3), 236) if colour is None else colour
    write_terrain(folder, height, colour=colour, classes=np.ones((64, 64)), extra=weather)
    text = (folder / "scene.toml").read_text(encoding="utf-8")
    start, end = text.index("[emissivity]"), text.index("[sky]")
    table = f'[emissivity]\nsource = "learned"\nmodel = "{model}"\nfallback = "granite"\n{more}\n'
    (folder / "scene.toml").write_text(text[:start] + table + text[end:], encoding="utf-8")
    return folder


def possible(scene):
    """Names of all materials that a texel of the scene may be."""
    return {part.name for material in scene.materials for part, _ in spectra_of(material)}


def shapes(path, *features, crs="EPSG:32634"):
    """Write a GeoJSON of (tags, geometry type, corners in metres from the corner of the scene, south positive)."""
    made = []
    for tags, kind, corners in features:
        points = [[EAST + x, NORTH - y] for x, y in corners]
        nested = {"Polygon": [[*points, points[0]]], "Point": points[0]}.get(kind, points)
        made.append({"type": "Feature", "properties": tags, "geometry": {"type": kind, "coordinates": nested}})
    content = {"type": "FeatureCollection", "features": made}
    if crs:
        content["crs"] = {"type": "name", "properties": {"name": crs}}
    path.write_text(json.dumps(content), encoding="utf-8")
    return path


def box(left, top, right, bottom):
    return [(left, top), (right, top), (right, bottom), (left, bottom)]


HOUSE = ({"building": "yes"}, "Polygon", box(4, 4, 12, 10))


# Weather


def day(low, high, time="2018-07-28T12:00", **more):
    when = np.datetime64(time)
    return named_day(when, (52.0, 21.0, 100.0), low, high, **more), when


@pytest.mark.parametrize(
    ("weather", "free"),
    [
        (day(12.0, 24.0), True),
        (day(0.5, 24.0), False),  # precipitation of a cold hour is snow
        (day(12.0, 24.0, snow_depth_m=0.1), False),
        (day(1.5, 3.0), False),  # old snow melts slowly: 2 K × 6 mm × 30 days are below 500 mm
        (day(12.0, 24.0, before=1), False),  # a day is too short a record
        (day(5.0, 9.0, "2018-01-28T12:00"), False),  # 1.5 mm by day and kelvin in winter: 300 mm in 30 days
        (day(5.0, 9.0), True),
    ],
)  # fmt: skip
def test_weather_excludes_snow_only_where_old_snow_melts_too(weather, free):
    series, when = weather
    why = series.why_no_snow(when)
    assert bool(why) == free
    assert not free or "the weather has no snow on the ground and air of" in why


def test_melt_of_the_sentence_is_that_of_the_degree_days():
    series, when = day(20.0, 20.0, "2018-06-21T12:00")
    # 6.9 mm by day and kelvin at the solstice: 138 mm a day.
    assert "air of 20.0 °C or more, which melts a metre of old snow in 4 days" in series.why_no_snow(when)
    rain = replace(series, air_k=np.where(series.time < when - np.timedelta64(4, "D"), 272.0, series.air_k))
    assert not rain.why_no_snow(when)


def test_snow_is_left_out_in_warm_weather_unless_it_is_stated(tmp_path):
    warm = tr.load_scene(learned(tmp_path / "warm", weather=WARM))
    assert "snow" not in possible(warm)
    assert any(note.startswith("snow left out: in the 5 days before, ") for note in warm.emissivity_report["context"])
    for name, more, weather in (("bare", "", ""), ("cold", "", COLD), ("stated", 'present = ["snow"]', WARM)):
        other = tr.load_scene(learned(tmp_path / name, more, weather=weather))
        assert "snow" in possible(other), name
        assert not any("snow" in note for note in other.emissivity_report["context"])
    # A scene under another weather has other materials.
    cold = warm.with_weather(replace(warm.spec.weather, air_low_c=-6.0, air_high_c=2.0))
    assert "snow" in possible(cold) and "snow" not in possible(cold.with_weather(warm.spec.weather))


def test_commands_state_what_the_context_does(tmp_path):
    folder = learned(tmp_path / "warm", weather=WARM)
    for words in (["plan", folder], ["map-materials", folder, "-o", tmp_path / "out"]):
        said = CliRunner().invoke(app, [*map(str, words)], catch_exceptions=False).output
        assert "snow left out: in the 5 days before, the weather has no snow on the ground" in said
        assert "heights are not used: nothing stands more than 2 m above the ground" in said
    table = (tmp_path / "out" / "emissivity.toml").read_text(encoding="utf-8")
    assert "snow" not in table


# Heights


def land():
    """Heights of 1 m posts: a slope of 10 %, a house of 6 m and a tree of 9 m on it, and a level pond."""
    north, east = np.mgrid[:120, :120].astype(float)
    ground = 100.0 + 0.1 * east
    height = ground.copy()
    height[20:32, 20:34] += 6.0
    away = np.hypot(north - 70, east - 40)
    height[away < 4] += 9.0 - 0.5 * away[away < 4]
    height[90:110, 60:80] = 104.0
    return height, ground


def test_heights_above_the_ground_are_those_of_houses_and_trees():
    height, _ = land()
    above, slope = elevation.above_ground(height, 1.0)
    assert above[22:30, 22:32] == pytest.approx(np.full((8, 10), 6.0), abs=0.5)
    assert above[70, 40] == pytest.approx(9.0, abs=0.5)
    assert np.abs(above[50:60]).max() < 0.3
    # 10 % are 5.7°.
    assert slope[50:60, 10:110] == pytest.approx(np.full((10, 100), 5.71), abs=0.05)
    assert slope[95:105, 65:75].max() < 0.1
    case = elevation.case_of(above, slope)
    assert set(case[24:28, 24:30].flat) == {7} and set(case[50:60].flat) == {1}
    # A hole stays one, and does not change its surroundings.
    height[24, 25] = np.nan
    holed, _ = elevation.above_ground(height, 1.0)
    assert np.isnan(holed[24, 25]) and np.isnan(holed).sum() == 1
    assert holed[22, 22] == pytest.approx(above[22, 22], abs=0.1)


@pytest.mark.parametrize(
    ("height", "post_m", "why"),
    [
        (land()[0], 1.0, ""),
        (land()[0], 2.0, "posts of 2 m are wider than 1.5 m"),
        (land()[1], 1.0, "nothing stands more than 2 m above the ground"),
        (land()[0] + 0.7 * np.arange(120.0)[:, None], 1.0, "66% of the ground is steeper than 25°, where rocks"),
    ],
)  # fmt: skip
def test_heights_that_show_nothing_are_no_evidence(height, post_m, why):
    found = elevation.seen(height, post_m)[2]
    assert found.startswith(why) and bool(found) == bool(why)


def test_evidence_of_heights_follows_bayes_rule():
    names = ["asphalt", "roof_slate", "conifer", "water", "concrete", "brass"]
    factor = elevation.evidence(np.zeros((1, 1), np.uint8), names).factor
    share = {name: 0.9 * np.array(values) + 0.1 / 9 for name, values in elevation.LIKELIHOOD.items()}
    assert (factor[0] == 1.0).all()
    for column, surface in enumerate(("ground", "roof", "tree", "water")):
        assert factor[1:, column] == pytest.approx(share[surface])
    # Concrete is a roof or paving; a material of unknown kind may be anything.
    assert factor[1:, 4] == pytest.approx(0.5 * (share["roof"] + share["ground"]))
    assert factor[1:, 5] == pytest.approx(np.mean(list(share.values()), axis=0))
    assert all(sum(values) == pytest.approx(1.0, abs=2e-4) for values in elevation.LIKELIHOOD.values())


@pytest.mark.slow
def test_likelihoods_are_those_of_procedural_land():
    found = fitted.shares([make("village", 103), make("heath", 102)])
    for surface, values in elevation.LIKELIHOOD.items():
        # Two lands of the five that the table is from.
        assert found[surface] == pytest.approx(np.array(values), abs=0.06), surface


def test_scene_uses_heights_where_they_show_houses(tmp_path):
    height = np.zeros((32, 32))
    height[4:12, 4:12] = 6.0
    grey = np.clip(90.0 + 8.0 * np.random.default_rng(0).standard_normal((64, 64, 1)), 0, 255).repeat(3, axis=2)
    grey = grey.astype(np.uint8)
    with_heights = tr.load_scene(learned(tmp_path / "with", height=height, colour=grey))
    without = tr.load_scene(learned(tmp_path / "without", "heights = false", height=height, colour=grey))
    assert "heights are not used: emissivity.heights is false" in without.emissivity_report["context"]
    (note,) = with_heights.emissivity_report["context"]
    assert note.startswith("heights above the ground and slopes weigh the materials; 6% of the surface")

    def roofs(scene, rows, columns):
        share = [
            sum(part for each, part in spectra_of(material) if "roof" in each.name) for material in scene.materials
        ]
        return np.mean(np.array(share)[scene.surfaces[0].material[rows, columns]])

    house, yard = (slice(12, 20),) * 2, (slice(40, 60),) * 2
    assert roofs(with_heights, *house) > 5.0 * roofs(without, *house)
    assert roofs(with_heights, *yard) < 0.5 * roofs(without, *yard)


# Shapes of OpenStreetMap


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    """A map of three materials that colour does not tell apart."""
    names = {1: "asphalt", 2: "roof_slate", 3: "grass_green"}
    random = np.random.default_rng(0)
    rgb = random.integers(60, 90, (60, 60, 3)).astype(np.uint8)
    number = random.integers(1, 4, (60, 60)).astype(np.uint8)
    path = tmp_path_factory.mktemp("map") / "own.npz"
    save_map(train([Labelled(rgb, number, names, 0.5, "noise")], 0.5, "own", band_emissivity_of())[0], path)
    return path


def grey_scene(folder, model, *features, **more):
    colour = np.random.default_rng(1).integers(60, 90, (64, 64, 3))
    learned(folder, 'known = "osm.geojson"', "own.npz", colour=colour, **more)
    shapes(folder / "osm.geojson", *features)
    (folder / "own.npz").write_bytes(model.read_bytes())
    return folder


def test_known_shapes_renormalise_the_posterior_inside_their_group(tmp_path, model):
    """A road of 6 m crosses the scene, a house stands on it, and the rest is as the map says."""
    road = ({"highway": "tertiary"}, "LineString", [(0, 20), (32, 20)])
    lake = ({"natural": "water"}, "Polygon", box(20, 2, 30, 12))
    folder = grey_scene(tmp_path / "s", model, ({"building": "house"}, "Polygon", box(10, 14, 16, 26)), road, lake)
    scene = tr.load_scene(folder)
    found = np.array([{part.name for part, share in spectra_of(one) if share > 1e-6} for one in scene.materials])
    of = found[scene.surfaces[0].material]
    assert all(names == {"roof_slate"} for names in of[30:50, 21:31].flat)
    assert all(names == {"asphalt"} for names in of[35:45, :20].flat)
    # The map lacks water, which the shape states.
    assert all(names == {"water"} for names in of[6:22, 42:58].flat)
    assert {"asphalt", "grass_green", "roof_slate"} <= set.union(*of[50:].flat)
    # The rest and the road's edge: 6 m are 12 texels around row 40.
    assert "grass_green" in set.union(*of[47:].flat) and not any("grass_green" in names for names in of[36:44].flat)
    notes = scene.emissivity_report["context"]
    assert "osm.geojson: 3 of 3 shapes restrict the materials of 32.0% of the texels (natural=water 9.8%, " in " ".join(
        notes
    )


def test_evidence_leaves_the_ratios_of_what_it_allows(model):
    """Probabilities inside a group keep their ratios, and texels unlike the training data are evenly divided."""
    own = load_map(model)
    rgb = np.random.default_rng(2).integers(60, 90, (40, 40, 3)).astype(np.uint8)
    rgb[:, 30:] = (255, 0, 255)
    number = np.zeros((40, 40), np.uint8)
    number[:20] = 1
    group = np.array([name != "grass_green" for name in own.materials])
    kept = {}

    def keep(name):
        return lambda rows, columns, planes: kept.__setitem__(name, planes.copy())

    before = map_materials(own, rgb, 0.5, keep=keep("before"))
    after = map_materials(own, rgb, 0.5, keep=keep("after"), evidence=[
        Evidence(number, np.array([[1, 1, 1], group], np.float32))])  # fmt: skip
    like = np.zeros((40, 40), bool)
    like[:20] = before.confidence[:20] > 0.0
    # Less is not above what any material has before others are excluded.
    like &= kept["before"][group].sum(axis=0) > 1e-5
    inside = kept["before"][group][:, like]
    assert like[:, :20].sum() > 100
    assert kept["after"][group][:, like] == pytest.approx(inside / inside.sum(axis=0), abs=1e-6)
    assert kept["after"][~group][:, :20].max() == 0.0
    assert kept["after"][:, 20:] == pytest.approx(kept["before"][:, 20:], abs=1e-6)
    assert (before.confidence[:, 36:] == 0.0).all() and (after.confidence[20:, 36:] == 0.0).all()
    assert kept["after"][group][:, :20, 36:] == pytest.approx(np.full((2, 20, 4), 0.5), abs=1e-6)
    assert (after.confidence[:20, 36:] == 0.5).all()


def test_shapes_that_are_not_used_are_counted(tmp_path):
    path = write_raster(tmp_path / "o.tif", np.zeros((3, 64, 64), np.uint8), 0.5)
    file = shapes(
        tmp_path / "osm.geojson", HOUSE,
        ({"building": "yes"}, "Polygon", box(400, 4, 412, 10)),
        ({"building": "yes"}, "Polygon", box(20.3, 4.3, 20.4, 4.4)),
        ({"building": "yes"}, "Point", [(1, 1)]),
        ({"highway": "footway", "width": "0.3"}, "LineString", [(0, 20), (32, 20)]),
        ({"highway": "primary", "tunnel": "yes"}, "LineString", [(0, 20), (32, 20)]),
        ({"landuse": "residential"}, "Polygon", box(0, 0, 32, 32)),
        ({"man_made": "mast"}, "Point", [(1, 1)]),
    )  # fmt: skip
    known = read_mapped_cover(file, grid_of(path), 0.5)
    assert (known.number[8:20, 8:24] == 1).all() and known.number.sum() == 12 * 16
    assert known.cases == (("roof",),)
    assert known.notes == (
        "osm.geojson: 1 of 8 shapes restrict the materials of 4.7% of the texels (building 4.7%)",
        "osm.geojson: left out are 1 of building as Point, 1 narrower than a texel, 1 underground, 1 outside the "
        "picture, 1 smaller than a texel",
        "osm.geojson: tags that say nothing on materials: 1 landuse=residential, 1 others",
    )


@pytest.mark.parametrize(
    ("kind", "wrapped", "used"),
    [
        ("Polygon", lambda _: [], 0),
        ("Polygon", lambda _: [[]], 0),
        ("MultiPolygon", lambda _: [], 0),
        ("Polygon", lambda rings: [*rings, []], 1),
        ("MultiPolygon", lambda rings: [[], rings, [[]]], 1),
    ],
)
def test_shapes_without_corners_are_counted_and_the_others_are_used(tmp_path, kind, wrapped, used):
    path = write_raster(tmp_path / "o.tif", np.zeros((3, 64, 64), np.uint8), 0.5)
    file = shapes(tmp_path / "a.geojson", HOUSE, ({"building": "yes"}, "Polygon", box(20, 20, 30, 30)))
    content = json.loads(file.read_text())
    geometry = content["features"][0]["geometry"]
    geometry.update(type=kind, coordinates=wrapped(geometry["coordinates"]))
    file.write_text(json.dumps(content))
    known = read_mapped_cover(file, grid_of(path), 0.5)
    assert known.number.sum() == 20 * 20 + used * 12 * 16
    left_out = () if used else ("a.geojson: left out are 1 without a shape",)
    assert known.notes[1:] == left_out


@pytest.mark.parametrize(
    ("tags", "kinds"),
    [
        ({"building": "garage"}, ("roof",)),
        ({"building": "no", "landuse": "meadow"}, ("low", "soil", "tree")),
        ({"tags": {"natural": "glacier"}}, ("snow",)),
        ({"natural": "water", "intermittent": "yes"}, ("water", "soil", "sand", "rock", "low")),
        ({"highway": "pedestrian", "area": "yes"}, ("paved", "tree")),
        ({"highway": "residential", "surface": "gravel"}, ("paved", "soil", "sand", "rock", "low", "tree")),
        ({"material": "brick_clay", "building": "yes"}, "brick_clay"),
    ],
)  # fmt: skip
def test_tags_name_kinds_of_material(tmp_path, tags, kinds):
    path = write_raster(tmp_path / "o.tif", np.zeros((3, 64, 64), np.uint8), 0.5)
    known = read_mapped_cover(shapes(tmp_path / "a.geojson", (tags, "Polygon", box(2, 2, 9, 9))), grid_of(path), 0.5)
    assert known.cases == (kinds,)


def test_shares_are_of_what_no_later_shape_covers(tmp_path):
    path = write_raster(tmp_path / "o.tif", np.zeros((3, 64, 64), np.uint8), 0.5)
    paving = ({"material": "pavement_concrete"}, "Polygon", box(2, 2, 18, 18))
    pool = ({"leisure": "swimming_pool"}, "Polygon", box(6, 6, 14, 14))
    known = read_mapped_cover(shapes(tmp_path / "a.geojson", paving, pool), grid_of(path), 0.5)
    assert "(leisure=swimming_pool 0.0%, material=pavement_concrete 25.0%)" in known.notes[0]


def test_polygons_without_tags_are_buildings_unless_another_feature_has_some(tmp_path):
    path = write_raster(tmp_path / "o.tif", np.zeros((3, 64, 64), np.uint8), 0.5)
    footprint = ({"height": 6.0, "confidence": -1.0}, "Polygon", box(2, 2, 9, 9))
    known = read_mapped_cover(shapes(tmp_path / "a.geojson", footprint), grid_of(path), 0.5)
    assert known.cases == (("roof",),)
    assert known.notes[0] == "a.geojson: no feature has a tag of OpenStreetMap, so all polygons are buildings"
    pool = ({"leisure": "swimming_pool"}, "Polygon", box(12, 12, 19, 19))
    known = read_mapped_cover(shapes(tmp_path / "b.geojson", footprint, pool), grid_of(path), 0.5)
    assert known.cases == (("water",),)


def test_snow_and_materials_of_unknown_kind_stay_possible_in_every_shape(tmp_path):
    path = write_raster(tmp_path / "o.tif", np.zeros((3, 64, 64), np.uint8), 0.5)
    known = read_mapped_cover(shapes(tmp_path / "a.geojson", HOUSE), grid_of(path), 0.5)
    names = ["roof_slate", "snow", "brass", "asphalt", "water"]
    assert known.evidence(names).factor.tolist() == [[1, 1, 1, 1, 1], [1, 1, 1, 0, 0]]
    assert known.beyond(["asphalt", "water"]) == ["roof_shingle"] and known.beyond(names) == []


def test_every_rule_names_materials_of_the_library():
    from thermorender.learned.emissivity.kinds import KINDS

    assert {kind for _, _, kinds in RULES for kind in kinds} <= set(KINDS)
    assert {name for names in KINDS.values() for name in names} <= set(load_library())
    for kind in ("roof", "paved", "soil", "low", "tree", "water", "snow"):
        assert set(KINDS[kind]) & set(load_map("procedural").materials), kind


@pytest.mark.parametrize(
    ("features", "crs", "words"),
    [
        ([HOUSE], None, r"a.geojson, feature 1 has corners that are not coordinates of .*; give GeoJSON in longitude"),
        ([({"building": "yes"}, "Polygon", box(4000, 4, 4012, 10))], "EPSG:32634",
         r"a.geojson restricts no texel of .*o.tif \(1 outside the picture\); give OpenStreetMap shapes of the"),
        ([({"landuse": "residential"}, "Polygon", box(0, 0, 9, 9))], "EPSG:32634", r"\(1 landuse=residential\)"),
        ([], "EPSG:32634", r"\(it has no feature\)"),
        ([HOUSE], "EPSG:4258", "feature 1 has corners that are not coordinates of EPSG:4258"),
    ],
)  # fmt: skip
def test_shapes_elsewhere_are_refused(tmp_path, features, crs, words):
    path = write_raster(tmp_path / "o.tif", np.zeros((3, 64, 64), np.uint8), 0.5)
    with pytest.raises(ThermorenderError, match=words):
        read_mapped_cover(shapes(tmp_path / "a.geojson", *features, crs=crs), grid_of(path), 0.5)


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ('known = "lost.geojson"', "emissivity.known='lost.geojson' does not exist"),
        ('present = ["ice"]', "emissivity.present names 'ice', which emissivity map 'procedural' does not have"),
        ('present = ["snow"]\nwithout = ["snow"]', r"present=\['snow'\] is not allowed; give 'snow' in one of"),
        ('heights = "no"', "emissivity.heights='no' is not allowed; give one of false, true"),
    ],
)
def test_wrong_context_keys_are_refused(tmp_path, more, words):
    with pytest.raises(ThermorenderError, match=words):
        tr.load_scene(learned(tmp_path / "s", more))


def test_context_keys_of_another_source_are_refused(tmp_path):
    folder = write_terrain(tmp_path / "s")
    path = folder / "scene.toml"
    path.write_text(path.read_text("utf-8").replace('"classes"\n', '"classes"\nheights = false\n', 1), "utf-8")
    with pytest.raises(ThermorenderError, match="heights=False is not allowed; give it with source='learned' only"):
        tr.load_scene(folder)


def test_import_takes_known_shapes(tmp_path):
    folder = write_terrain(tmp_path / "given", np.zeros((32, 32)))
    osm = shapes(tmp_path / "osm.geojson", HOUSE, ({"natural": "tree"}, "Point", [(1, 1)]))
    words = ["import-terrain", folder / "elevation.tif", folder / "orthophoto.tif", "--known", osm]
    done = CliRunner().invoke(app, [*map(str, words), "-o", str(tmp_path / "mine")], catch_exceptions=False)
    assert "osm.geojson: 1 of 2 shapes restrict the materials of 4.7% of the texels" in done.output
    assert "tags that say nothing on materials: 1 natural=tree" in done.output
    scene = tr.load_scene(tmp_path / "mine")
    inside = scene.surfaces[0].material[8:20, 8:24]
    names = {part.name for number in np.unique(inside) for part, share in spectra_of(scene.materials[number]) if share}
    assert names <= {*fitted_roofs(), "snow"}
    assert not (scene.surfaces[0].flags[8:20, 8:24] & UNKNOWN).all()
    alone = CliRunner().invoke(app, ["import-terrain", str(folder / "elevation.tif"), "--known", str(osm), "-o",
                                     str(tmp_path / "other")])  # fmt: skip
    assert "restricts materials that are read from an orthophoto; give one too" in str(alone.exception)
    assert not (tmp_path / "other").exists()


def fitted_roofs():
    from thermorender.learned.emissivity.kinds import KINDS

    return KINDS["roof"]


def test_labels_outside_the_picture_are_reported(tmp_path):
    folder = write_terrain(tmp_path / "s", np.zeros((32, 32)))
    path = shapes(
        tmp_path / "labels.geojson", ({"material": "water"}, "Polygon", box(2, 2, 12, 30)),
        ({"material": "asphalt"}, "Polygon", box(14, 2, 30, 30)),
        ({"material": "snow"}, "Polygon", box(900, 2, 930, 30)),
        ({"material": "water"}, "Polygon", box(20.3, 4.3, 20.4, 4.4)),
    )  # fmt: skip
    labelled = labelled_scene(folder, path)
    assert labelled.unused == (
        "2 of the 4 polygons of labels.geojson label no texel, because they are outside the picture or smaller than a "
        "texel: 3 (snow), 4 (water)"
    )
    words = ["train", "emissivity", str(folder), "--labels", str(path), "-o", str(tmp_path / "m.npz")]
    done = CliRunner().invoke(app, words, catch_exceptions=False)
    assert f"warning: {labelled.unused}" in done.output
    assert load_map(tmp_path / "m.npz").about["unused_labels"] == labelled.unused
    assert set(load_map(tmp_path / "m.npz").materials) == {"water", "asphalt"}
