"""`import-terrain --three-d`: trees of a surface model as crowns that light passes in part, and trunks."""

import numpy as np
import pytest
from typer.testing import CliRunner

import thermorender as tr
from scenes import write_raster
from thermorender.apps.lands.import_settings import ImportSettings, ThreeD
from thermorender.apps.lands.import_terrain import import_terrain
from thermorender.cli import app as cli
from thermorender.errors import ThermorenderError
from thermorender.learned.apply import kinetic_from_map
from thermorender.learned.temperature_map import Inputs, load_model
from thermorender.scene.crowns import Crowns
from thermorender.scene.spec import read_scene

SIDE, POST_M, CORNER = 120, 0.5, (500000.0, 5780000.0)
TIME = "2018-07-15T11:00Z"
STATION = "time,air_c\n" + "".join(
    f"2018-07-{day:02d}T{hour:02d}:00Z,{18 + 6 * np.sin((hour - 9) / 24 * 2 * np.pi):.1f}\n"
    for day in range(8, 17)
    for hour in range(24)
)


def planted():
    """Heights of ground and surface [m], and the trees' (east, north, radius, height, top of the rough crown)."""
    random = np.random.default_rng(7)
    row, column = np.mgrid[:SIDE, :SIDE] + 0.5
    ground = 40.0 + 0.02 * column
    surface, trees = ground.copy(), []
    for place in np.ndindex(6, 6):
        east, north = (10.0 * np.array(place) - 25.0 + random.uniform(-1.0, 1.0, 2)).tolist()
        radius = random.uniform(2.0, 3.6)
        height = radius * random.uniform(2.0, 3.0)
        away = np.hypot((column - SIDE / 2) * POST_M - east, (SIDE / 2 - row) * POST_M - north) / radius
        crown = height * (0.5 + 0.5 * np.sqrt(np.maximum(1.0 - away**2, 0.0)))
        # Rough, since smooth ones are roofs.
        crown += random.normal(0.0, 0.7, crown.shape)
        surface = np.where(away < 1.0, ground + crown, surface)
        trees.append((east, north, radius, height, crown[away < 1.0].max()))
    return ground, surface, np.array(trees)


def import_wood(folder, name, **settings):
    return import_terrain(folder / "dsm.tif", None, folder / name, ImportSettings(**settings),
                          three_d=ThreeD(folder / "dem.tif"))  # fmt: skip


@pytest.fixture(scope="module")
def wood(tmp_path_factory):
    """(Folder with the model, scene with a weather, summary of the import)."""
    folder = tmp_path_factory.mktemp("wood")
    for name, values in zip(("dem", "dsm"), planted()[:2], strict=True):
        write_raster(folder / f"{name}.tif", values[None].astype(np.float32), POST_M, corner=CORNER)
    (folder / "w.csv").write_text(STATION)
    made = import_wood(folder, "s", weather=folder / "w.csv", time=TIME)
    return folder, tr.load_scene(folder / "s"), made


def crowns_of(scene):
    (surface,) = (each for each in scene.surfaces if isinstance(each.instances, Crowns))
    return surface, surface.instances


def test_each_tree_has_a_crown_of_its_leaf_area_where_it_stands(wood):
    _, scene, made = wood
    trees = planted()[2]
    assert (made["trees"], made["buildings"]) == (36, 0)
    surface, body = crowns_of(scene)
    assert scene.materials[surface.material.flat[0]].name == "broadleaf" and not body.box
    # From the middle of the model, 60 m wide with a slope of 4 %.
    up = body.middle[:, 2] + scene.frame.height_m - (40.0 + 0.04 * (body.middle[:, 0] + 30.0))
    away = np.hypot(*(body.middle[:, None, :2] - trees[None, :, :2]).transpose(2, 0, 1))
    own = away.argmin(axis=1)
    assert sorted(set(own)) == list(range(36))
    _, _, radius, _, top = trees[own].T
    assert (away.min(axis=1) < radius).all() and (up + body.half[:, 2] < top + 0.5).all()
    assert (up - body.half[:, 2] > 0.15 * top).all()
    for tree in range(36):
        reach = (away[own == tree, tree] + body.half[own == tree, :2].max(axis=1)).max()
        assert 0.7 * trees[tree, 2] < reach < 1.3 * trees[tree, 2]
    # From 0.28 to 0.5 of the top's height up to half a ball above half of the height, 1.2 m² per cubic metre.
    leaves = np.bincount(own, body.density * body.volume)
    volume = np.pi * trees[:, 2] ** 2 * ((0.5 + 0.5 * 2.0 / 3.0) * trees[:, 3] - 0.39 * trees[:, 4])
    assert leaves.sum() == pytest.approx(1.2 * volume.sum(), rel=0.1)
    assert np.corrcoef(leaves, volume)[0, 1] > 0.9


def test_trunks_stand_below_the_crowns_and_temperatures_are_those_of_the_balance(wood):
    _, scene, _ = wood
    trunks = next(each for each in scene.surfaces if each.name.endswith(":trunks"))
    away = np.hypot(*(trunks.vertices[:, None, :2] - planted()[2][None, :, :2]).transpose(2, 0, 1))
    assert away.min(axis=1).max() < 3.0 and away.min(axis=0).max() < 3.0
    assert np.isnan(crowns_of(scene)[0].temperature).all() and scene.solved_count == len(scene.surfaces)


def test_crowns_without_a_weather_have_the_temperature_of_the_ground(wood):
    folder, _, _ = wood
    import_wood(folder, "plain")
    scene = tr.load_scene(folder / "plain")
    surface, _ = crowns_of(scene)
    assert len(np.unique(surface.temperature)) == 1
    assert surface.temperature.flat[0] == scene.surfaces[0].temperature.flat[0]


def test_command_counts_the_trees(wood, tmp_path):
    asked = ["import-terrain", str(wood[0] / "dsm.tif"), "-o", str(tmp_path / "s"), "--three-d"]
    done = CliRunner().invoke(cli.app, asked)
    assert done.exit_code == 0 and "36 trees; walls, trunks and leaves are inferred from heights" in done.output
    assert CliRunner().invoke(cli.app, [*asked, "--copies"]).exit_code == 2


def test_more_trees_than_the_memory_holds_are_refused(wood, tmp_path, monkeypatch):
    monkeypatch.setattr("thermorender.apps.lands.solids.trees.MOST_COPIES", 35)
    with pytest.raises(ThermorenderError, match=r"has 36 trees, more than the 35 whose .*; give a smaller area"):
        import_terrain(wood[0] / "dsm.tif", None, tmp_path / "s", three_d=ThreeD())
    assert not (tmp_path / "s").exists()


def test_crowns_of_many_trees_have_fewer_lobes(wood, monkeypatch):
    monkeypatch.setattr("thermorender.apps.lands.solids.plants._MOST_LOBES", 72)
    import_wood(wood[0], "few")
    many, few = (crowns_of(scene)[1] for scene in (wood[1], tr.load_scene(wood[0] / "few")))
    assert len(few) <= 72 < len(many)
    area = [(body.density * body.volume).sum() for body in (many, few)]
    assert area[0] == pytest.approx(area[1], rel=0.01)


def test_crowns_without_weather_have_the_temperatures_that_the_map_has_for_their_colour(wood):
    folder, _, _ = wood
    rng = np.random.default_rng(2)
    picture = np.clip(rng.normal([70, 110, 50], 12.0, (120, 120, 3)), 0, 255).astype(np.uint8)
    write_raster(folder / "o.tif", picture.transpose(2, 0, 1), 0.5, corner=CORNER, photometric="RGB")
    import_terrain(folder / "dsm.tif", folder / "o.tif", folder / "pictured", ImportSettings(),
                   ThreeD(folder / "dem.tif"))  # fmt: skip
    scene = tr.load_scene(folder / "pictured")
    surface, body = crowns_of(scene)
    material = scene.materials[surface.material.flat[0]]
    for number in (0, len(body) - 1):
        flat = np.full((9, 9, 3), surface.colour.reshape(-1, 3)[8 * number], np.uint8)
        seen, *_ = kinetic_from_map(load_model("fok-1to1"), Inputs(flat), np.zeros((9, 9), np.uint8), [material])
        np.testing.assert_allclose(surface.temperature.ravel()[8 * number : 8 * number + 8], seen[4, 4], atol=0.02)
    # They follow a heat balance, once there is a weather.
    station = read_scene(folder / "s").weather
    balanced = scene.with_weather(station).with_temperature("balance")
    assert np.isnan(crowns_of(balanced)[0].temperature).all()
    plain = import_wood(folder, "unpictured")
    assert plain["trees"] == 36
    bare = tr.load_scene(folder / "unpictured")
    assert set(crowns_of(bare)[0].temperature.ravel()) == set(bare.main_surface.temperature.ravel())
