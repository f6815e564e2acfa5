"""What ground and roofs of an imported surface model are: shapes that are known, painted areas, rasters, pools."""

import json
import re

import numpy as np
import pytest
from rasterio import Affine
from rasterio.crs import CRS
from rasterio.warp import transform
from typer.testing import CliRunner

import thermorender as tr
from scenes import write_raster
from thermorender.apps.lands.import_settings import ImportSettings, ThreeD
from thermorender.apps.lands.import_terrain import import_terrain
from thermorender.apps.lands.pools import pools
from thermorender.apps.lands.unexplained import Photograph, write_unexplained
from thermorender.cli import app as cli
from thermorender.errors import ThermorenderError
from thermorender.learned.emissivity.kinds import kinds_of
from thermorender.materials.extended import within_band
from thermorender.materials.library import load_library
from thermorender.materials.mixture import parts_of
from thermorender.scene import open_ground
from thermorender.scene.folder import read_files
from thermorender.scene.raster import Grid

SIDE, CORNER = 48, (500000.0, 5780000.0)
# Posts of 1 m, texels of 0.5 m. Two houses, 8 m and 5 m high, a lawn, and a pool of 12 by 6 m, as (west, north) to
# (east, south) [m] from the corner.
HIGH, LOW, POOL = (6, 6, 18, 16), (30, 8, 40, 18), (14, 30, 26, 36)
CYAN, GREEN, RED = (84, 200, 212), (104, 112, 72), (158, 74, 56)


def within(area, step):
    """Which pixels of a step have their middle in an area."""
    row, column = (np.mgrid[: round(SIDE / step), : round(SIDE / step)] + 0.5) * step
    return (column > area[0]) & (column < area[2]) & (row > area[1]) & (row < area[3])


def photograph(pool=CYAN):
    draw = np.random.default_rng(0)
    rgb = np.full((2 * SIDE, 2 * SIDE, 3), GREEN, float)
    rgb[within(HIGH, 0.5) | within(LOW, 0.5)] = RED
    # Light and shade of plants, in tufts and fine.
    tufts = np.kron(draw.normal(0.0, 6.0, (SIDE // 2, SIDE // 2)), np.ones((4, 4)))
    rgb += tufts[..., None] + draw.normal(0.0, 6.0, (*rgb.shape[:2], 1)) + draw.normal(0.0, 1.0, rgb.shape)
    rgb[within(POOL, 0.5)] = pool + draw.normal(0.0, 2.0, 3)
    return np.clip(rgb, 0, 255).astype(np.uint8)


def ring(area):
    west, north, east, south = area
    corners = [(west, north), (east, north), (east, south), (west, south), (west, north)]
    return [[CORNER[0] + x, CORNER[1] - y] for x, y in corners]


def shapes(path, *given):
    """A GeoJSON of (area, properties) in the CRS of the rasters."""
    features = [{"type": "Feature", "properties": tags, "geometry": {"type": "Polygon", "coordinates": [ring(area)]}}
                for area, tags in given]  # fmt: skip
    crs = {"type": "name", "properties": {"name": "EPSG:32634"}}
    path.write_text(json.dumps({"type": "FeatureCollection", "crs": crs, "features": features}))
    return path


def write_survey(folder, pool=CYAN):
    height = np.where(within(HIGH, 1.0), 28.0, np.where(within(LOW, 1.0), 25.0, 20.0))
    write_raster(folder / "dsm.tif", height[None].astype(np.float32), corner=CORNER)
    write_raster(folder / "ortho.tif", np.moveaxis(photograph(pool), -1, 0), step=0.5, corner=CORNER)
    hours = np.arange("2018-07-20T00:30", "2018-07-26T00:30", 60, dtype="datetime64[m]")
    of_day = (hours - hours.astype("datetime64[D]")).astype(float) / 60.0
    air, light = 20.0 - 7.0 * np.cos((of_day - 3.0) * np.pi / 12.0), np.sin((of_day - 2.6) * np.pi / 16.0)
    lines = [f"{t}:00Z,{a:.1f},55,2.0,{max(800.0 * s, 0.0):.0f}" for t, a, s in zip(hours, air, light, strict=True)]
    (folder / "st.csv").write_text("\n".join(["time,air_c,rh_percent,wind_m_s,sw_down_w_m2", *lines]) + "\n")
    return folder


@pytest.fixture(scope="module")
def survey(tmp_path_factory):
    return write_survey(tmp_path_factory.mktemp("survey"))


def imported(survey, folder, known=None, three_d=True, **settings):
    how = ImportSettings(known=known, **settings)
    made = import_terrain(survey / "dsm.tif", survey / "ortho.tif", folder, how, ThreeD() if three_d else None)
    return tr.load_scene(folder), made


def is_of(scene, name, surface):
    """Which texels of a surface have a material or a mixture that is mostly it."""
    (own,) = (each for each in scene.surfaces if each.name.split(":")[-1] == surface)
    return np.array([each.name == name for each in scene.materials])[own.material]


def is_water(scene):
    """Which texels of the ground have water, or a mixture of kinds of it."""
    names = [[part.name for part, _ in parts_of(each)] for each in scene.materials]
    water = np.array([all(name.startswith(("water", "sea")) for name in each) for each in names])
    (ground,) = (each for each in scene.surfaces if each.name in ("world:ground", "terrain"))
    return water[ground.material]


# --- painted areas ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def scene(survey, tmp_path_factory):
    return imported(survey, tmp_path_factory.mktemp("plain") / "s")[0]


def test_an_area_covers_roofs_and_the_ground_beside_them_as_a_map_shows_them(scene, tmp_path):
    # The western half of the high house and 4 m of ground before it.
    area = (2, 6, 12, 16)
    painted = scene.with_material_in(shapes(tmp_path / "a.geojson", (area, {})), "steel_galvanised")
    roof, ground = (is_of(painted, "steel_galvanised", name) for name in ("roofs", "ground"))
    # A roof that is found by height has bevelled corners.
    inside, house = within(area, 0.5), within((8, 8, 16, 14), 0.5)
    np.testing.assert_array_equal(roof[house], inside[house])
    assert not roof[~within((5, 5, 19, 17), 0.5)].any()
    # Roofs reach to the outlines, which surface models give to a post.
    outside = ~within((5, 5, 19, 17), 0.5)
    np.testing.assert_array_equal(ground[outside], inside[outside])
    assert not ground[within((8, 8, 16, 14), 0.5)].any()
    assert not is_of(painted, "steel_galvanised", "walls").any()


def test_a_painted_roof_has_the_emissivity_of_steel_in_the_truth(scene, tmp_path):
    path = shapes(tmp_path / "a.geojson", (HIGH, {"material": "steel_galvanised"}))
    camera = scene.camera.coarser(8)
    frame = tr.Renderer(scene.with_camera(camera).with_material_in(path), quality="fast").frame(
        tr.pose(-12.0, 13.0, 40.0, pitch_deg=-90.0)
    )
    library = load_library()
    steel = within_band(library["steel_galvanised"], camera.band_um, library, "it")
    expected = float(steel.band_emissivity(*camera.band_um, 300.0))
    row, column = (n // 2 for n in frame.truth["emissivity"].shape)
    assert frame.truth["emissivity"][row, column] == pytest.approx(expected, abs=0.01)


def test_areas_off_every_ground_and_roof_are_refused(scene, tmp_path):
    with pytest.raises(ThermorenderError, match="covers no texel of the scene's map; draw it on the terrain"):
        scene.with_material_in(shapes(tmp_path / "a.geojson", ((600, 600, 620, 620), {})), "asphalt")


def test_rasters_of_classes_lie_on_ground_and_roofs(survey, tmp_path):
    imported(survey, tmp_path / "s")
    classes = np.where(within(HIGH, 1.0), 101, np.where(within(POOL, 1.0), 102, 103)).astype(np.uint8)
    gap = (40, 40, 46, 46)
    classes[within(gap, 1.0)] = 0
    write_raster(tmp_path / "s" / "classes.tif", classes[None], corner=CORNER)
    text = (tmp_path / "s" / "scene.toml").read_text()
    table = '[emissivity]\nsource = "classes"\nraster = "classes.tif"\nfallback = "asphalt"\n'
    named = '101 = "steel_galvanised"\n102 = "water"\n103 = "grass_green"\n'
    text = re.sub(r"\[emissivity\]\n.*?\n\n", table + "\n", text, flags=re.DOTALL)
    text = text.replace("[emissivity.classes]\n", "[emissivity.classes]\n" + named)
    text = text.replace('[[surface]]\nname = "roofs"\nmaterial = "roof_tile_clay"\n', "")
    (tmp_path / "s" / "scene.toml").write_text(text)
    found = tr.load_scene(tmp_path / "s")
    assert is_of(found, "steel_galvanised", "roofs")[within((8, 8, 16, 14), 0.5)].all()
    assert is_of(found, "grass_green", "roofs")[within((32, 10, 38, 16), 0.5)].all()
    np.testing.assert_array_equal(is_of(found, "water", "ground"), within(POOL, 0.5))
    assert not is_of(found, "water", "walls").any()
    # What the map does not show, below the roofs, has the nearest class, and not that of gaps in the raster.
    np.testing.assert_array_equal(is_of(found, "asphalt", "ground"), within(gap, 0.5))


# --- heights ------------------------------------------------------------------------------------------------------


def test_a_light_yard_on_the_ground_is_of_no_roof_material(tmp_path):
    """The yard is as light as membrane roofs; the mesh shows that it lies on the ground."""
    write_survey(tmp_path, (185, 185, 180))
    weather = {"weather": tmp_path / "st.csv", "time": "2018-07-24T12:00Z"}
    found, _ = imported(tmp_path, tmp_path / "s", **weather)
    text = (tmp_path / "s" / "scene.toml").read_text()
    (tmp_path / "s" / "scene.toml").write_text(text.replace("[emissivity]\n", "[emissivity]\nheights = false\n"))
    blind = tr.load_scene(tmp_path / "s")

    def of_roofs(scene):
        """Mean share of materials that only roofs have, in the yard."""
        (ground,) = (each for each in scene.surfaces if each.name == "world:ground")
        share = [sum(part for each, part in parts_of(one) if kinds_of(each.name) == ("roof",))
                 for one in scene.materials]  # fmt: skip
        return float(np.array(share)[ground.material][within(POOL, 0.5)].mean())

    assert of_roofs(blind) > 0.1 and of_roofs(found) < 0.02
    (said,) = (one for one in found.emissivity_report["context"] if one.startswith("heights"))
    share = re.fullmatch(
        r"heights above the ground and slopes weigh the materials; (\d+)% of .* more than 2 m .*", said
    )
    assert share and float(share[1]) == pytest.approx(100.0 * 220.0 / 2304.0, abs=1.5)
    assert "heights are not used: emissivity.heights is false" in blind.emissivity_report["context"]


@pytest.mark.parametrize("cell_m", [0.5, 0.25])
def test_the_map_of_a_mesh_has_the_heights_of_its_highest_faces(survey, tmp_path, cell_m):
    found, _ = imported(survey, tmp_path / "s")
    files = read_files(found.spec, "it")
    height, grid = files.map_view.heights(cell_m)
    assert grid.width == round(2 * SIDE * cell_m / 0.5)
    x, y = grid.to_map(np.arange(grid.width) + 0.5, np.arange(grid.height)[:, None] + 0.5)
    # Texels have their middles a quarter of a metre from the lines of half a metre.
    east, south = x - CORNER[0], CORNER[1] - y
    assert east.ravel()[:2] == pytest.approx((0.25, 0.25 + 0.25 / cell_m), abs=1e-3)
    for (left, top, right, bottom), level in ((HIGH, 28.0), (LOW, 25.0), (POOL, 20.0)):
        inner = (east > left + 1) & (east < right - 1) & (south > top + 1) & (south < bottom - 1)
        np.testing.assert_allclose(height[inner] + files.frame.height_m, level, atol=0.02)


# --- known shapes -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("three_d", [True, False])
def test_shapes_restrict_the_materials_of_the_ground(survey, tmp_path, three_d):
    """A road across the lawn, and a field: as without --three-d, without a building among the shapes."""
    road, field = (0, 24, 48, 28), (30, 30, 46, 46)
    known = shapes(tmp_path / "k.geojson", (road, {"amenity": "parking"}), (field, {"material": "sand_quartz"}))
    scene, made = imported(survey, tmp_path / "s", known, three_d)
    ground = "ground" if three_d else "terrain"
    inside = within(field, 0.5)
    np.testing.assert_array_equal(is_of(scene, "sand_quartz", ground), inside)
    assert any("2 of 2 shapes restrict the materials" in note for note in made["known"])
    if three_d:
        assert made["buildings"] == 2 and not is_of(scene, "sand_quartz", "roofs").any()


def test_outlines_and_other_shapes_are_used_together(survey, tmp_path):
    """One of two houses is drawn: both stand, the wall's material stays on walls, and the pool beside them is water."""
    known = shapes(tmp_path / "k.geojson", (HIGH, {"building": "yes", "material": "wood"}),
                   (POOL, {"leisure": "swimming_pool"}))  # fmt: skip
    scene, made = imported(survey, tmp_path / "s", known, weather=survey / "st.csv", time="2018-07-25T12:00Z")
    assert (made["buildings"], made["trees"], made["stated_walls"]) == (2, 0, 1)
    assert not any("left out" in note or "are water by" in note for note in made["known"])
    np.testing.assert_array_equal(is_water(scene), within(POOL, 0.5))
    assert (
        is_of(scene, "wood", "roofs")[within((8, 8, 16, 14), 0.5)].mean() < 0.5 and is_of(scene, "wood", "walls").any()
    )


def test_a_file_without_any_use_is_refused(survey, tmp_path):
    away = shapes(tmp_path / "k.geojson", ((600, 600, 620, 620), {"natural": "water"}))
    with pytest.raises(ThermorenderError, match=r"restricts no texel .* give OpenStreetMap shapes of the terrain"):
        imported(survey, tmp_path / "s", away)
    known = shapes(tmp_path / "p.geojson", (POOL, {"natural": "water"}))
    with pytest.raises(ThermorenderError, match=r"no polygon with a tag 'building' .* 1 polygons without a tag"):
        import_terrain(survey / "dsm.tif", None, tmp_path / "s", ImportSettings(known=known), ThreeD())


# --- pools and what nothing explains ------------------------------------------------------------------------------


@pytest.mark.parametrize("three_d", [True, False])
def test_a_pool_is_found_and_is_water(survey, tmp_path, three_d):
    weather = {"weather": survey / "st.csv", "time": "2018-07-25T12:00Z"}
    scene, made = imported(survey, tmp_path / "s", three_d=three_d, **weather)
    (note,) = (each for each in made["known"] if "are water by" in each)
    latitude, longitude = map(float, re.search(r"latitude (\S+), longitude ([-\d.]+);", note).groups())
    (x,), (y,) = transform("EPSG:4326", "EPSG:32634", [longitude], [latitude])
    assert (x - CORNER[0], CORNER[1] - y) == pytest.approx((20.0, 33.0), abs=0.6)
    wet = is_water(scene)
    assert wet[within((15, 31, 25, 35), 0.5)].all() and wet[~within((13, 29, 27, 37), 0.5)].mean() < 0.01


@pytest.mark.parametrize(
    ("colour", "above", "words"),
    [((84, 200, 212), 3.0, "a roof"), ((60, 100, 165), 0.0, "a court"), ((60, 75, 78), 0.0, "a shadow"),
     ((86, 120, 58), 0.0, "a lawn")],
)  # fmt: skip
def test_what_is_no_pool_is_not_found(colour, above, words):
    rgb = photograph(colour)
    height = np.where(within(POOL, 0.5), above, 0.0)
    assert not pools(rgb, np.ones(height.shape, bool), 0.5, height).any(), words
    assert pools(photograph(), np.ones(height.shape, bool), 0.5, 0.0 * height).max() == 1


def test_a_patch_that_nothing_explains_is_named_with_a_command_that_works(tmp_path):
    survey = write_survey(tmp_path, pool=(226, 30, 210))
    args = ["import-terrain", "dsm.tif", "ortho.tif", "--three-d", "--weather", "st.csv", "--time",
            "2018-07-25T12:00Z", "-o", "s"]  # fmt: skip
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(survey)
        printed = CliRunner().invoke(cli.app, args, catch_exceptions=False).stdout
        found = re.search(r"no material of the learned map explains (\d+) m² of #(\w+) at .*? --paint (\S+)=(\w+),",
                          printed)  # fmt: skip
        assert found is not None, printed
        area, colour, path, material = found.groups()
        assert int(area) == pytest.approx(72, abs=8)
        np.testing.assert_allclose([int(colour[k : k + 2], 16) for k in (0, 2, 4)], (226, 30, 210), atol=10)
        scene = tr.load_scene("s")
        ground = next(each for each in scene.surfaces if each.name == "world:ground")
        middle = within((16, 32, 24, 34), 0.5)
        assert (ground.flags[middle] & 32).all()
        painted = scene.with_material_in(path)
    assert is_of(painted, material, "ground")[middle].all()


@pytest.mark.parametrize(("high", "material"), [(0.0, "water"), (5.0, "metal_painted")])
def test_a_blue_patch_that_nothing_explains_may_be_water_on_the_ground_only(tmp_path, high, material):
    grid = Grid(CRS.from_epsg(32634), Affine(0.5, 0.0, CORNER[0], 0.0, -0.5, CORNER[1]), 2 * SIDE, 2 * SIDE, "o.tif")
    rgb, known = photograph((10, 70, 230)), np.zeros((2 * SIDE, 2 * SIDE), bool)
    height = np.where(within(POOL, 0.5), high, 0.0)
    picture = Photograph(rgb, ~known, grid, 0.5, height, grid, 0.5)
    (note,) = write_unexplained(tmp_path, tmp_path, known, picture, "soil_loam")
    assert f"={material}," in note


@pytest.mark.slow
def test_a_pool_has_the_temperature_of_water_and_not_of_soil(survey, tmp_path):
    weather = {"weather": survey / "st.csv", "time": "2018-07-25T12:00Z"}
    scene, _ = imported(survey, tmp_path / "s", **weather)
    solved = tr.Renderer(scene, quality="fast").scene
    (ground,) = (each for each in solved.surfaces if each.name == "world:ground")
    pool = ground.temperature[within((16, 32, 24, 34), 0.5)]
    soil = tr.Renderer(scene.with_material_in(tr_corners(POOL), "soil_loam"), quality="fast").scene
    (bare,) = (each for each in soil.surfaces if each.name == "world:ground")
    # An open column of water by itself, which knows neither mesh nor map; and the air's mean and highest.
    state, _ = open_ground.settled(
        open_ground.columns([load_library()["water"]], scene.weather), scene.weather, np.datetime64(solved.time)
    )
    assert pool.mean() == pytest.approx(float(state.surface_k[0]), abs=1.0)
    assert 293.15 < pool.mean() < 300.15
    assert bare.temperature[within((16, 32, 24, 34), 0.5)].mean() > pool.mean() + 8.0


def tr_corners(area):
    """An area in local metres; the frame is in the middle of the survey."""
    west, north, east, south = area
    half = 0.5 * SIDE
    return [(west - half, half - north), (east - half, half - north), (east - half, half - south),
            (west - half, half - south)]  # fmt: skip


def test_a_shape_of_grass_over_the_plot_leaves_found_roofs_of_roof_materials(survey, tmp_path):
    lawn = shapes(tmp_path / "lawn.geojson", ((1, 1, 47, 47), {"landuse": "grass"}))
    scene, _ = imported(survey, tmp_path / "s", known=lawn, weather=survey / "st.csv", time="2018-07-24T12:00Z")
    (roofs,) = (each for each in scene.surfaces if each.name.split(":")[-1] == "roofs")
    seen = np.unique(roofs.material[within((8, 8, 16, 14), 0.5)])
    assert all("roof" in kinds_of(part.name) for number in seen for part, _ in parts_of(scene.materials[number]))
    stated = json.loads((tmp_path / "s" / "known.geojson").read_text())["features"]
    assert [each["properties"].get("building") for each in stated] == [None, None, "yes", "yes"]


@pytest.mark.parametrize("outlined", [(), (HIGH,)])
def test_houses_that_outlines_lack_stay_houses_and_are_named(survey, tmp_path, outlined):
    given = [(area, {"building": "yes"}) for area in outlined] or [((2, 42, 8, 46), {"landuse": "grass"})]
    _, made = imported(survey, tmp_path / "s", known=shapes(tmp_path / "k.geojson", *given))
    assert (made["buildings"], made["trees"]) == (2, 0)
    assert any("1 smooth, high parts outside of all outlines" in note for note in made["known"]) == bool(outlined)
