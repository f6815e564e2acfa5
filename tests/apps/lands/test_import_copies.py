"""`import-terrain --three-d --copies`: a wood whose trees are copies of typical ones, against trees of their own."""

import numpy as np
import pytest
from typer.testing import CliRunner

import thermorender as tr
from scenes import coarse, write_raster
from thermorender.apps.lands.import_settings import ImportSettings, ThreeD
from thermorender.apps.lands.import_terrain import import_terrain
from thermorender.cli import app as cli
from thermorender.errors import ThermorenderError

SIDE, POST_M, CORNER = 120, 0.5, (500000.0, 5780000.0)
TIME = "2018-07-15T11:00Z"
STATION = "time,air_c\n" + "".join(
    f"2018-07-{day:02d}T{hour:02d}:00Z,{18 + 6 * np.sin((hour - 9) / 24 * 2 * np.pi):.1f}\n"
    for day in range(8, 17)
    for hour in range(24)
)


def planted():
    """Heights of the ground and the surface [m], and the trees' (east, north, radius, height) from a seed."""
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
        trees.append((east, north, radius, crown[away < 1.0].max()))
    return ground, surface, np.array(trees)


@pytest.fixture(scope="module")
def wood(tmp_path_factory):
    """(Folder with the model, scene of copies, scene of trees of their own, summary of the first import)."""
    folder = tmp_path_factory.mktemp("wood")
    for name, values in zip(("dem", "dsm"), planted()[:2], strict=True):
        write_raster(folder / f"{name}.tif", values[None].astype(np.float32), POST_M, corner=CORNER)
    (folder / "w.csv").write_text(STATION)
    made = [
        import_terrain(folder / "dsm.tif", None, folder / name, ImportSettings(weather=folder / "w.csv", time=TIME),
                       three_d=ThreeD(folder / "dem.tif", copies=name == "copies"))
        for name in ("copies", "own")
    ]  # fmt: skip
    return folder, *(tr.load_scene(folder / name) for name in ("copies", "own")), made[0]


def crowns(scene):
    return [s for s in scene.surfaces if s.instances is not None and s.name.startswith("broadleaf")]


def test_each_tree_is_a_copy_where_it_stands_and_as_large(wood):
    _, scene, _, made = wood
    trees = planted()[2]
    assert (made["trees"], made["buildings"]) == (36, 0) and 2 <= made["kinds"] <= 16
    bodies = [surface.instances for surface in crowns(scene)]
    assert len(bodies) == made["kinds"] and sum(map(len, bodies)) == 36
    foot = np.concatenate([body.position for body in bodies])
    size = np.concatenate([
        np.column_stack([
            np.abs(body.vertices[:, :2]).max() * body.scale, body.vertices[:, 2].max() * body.scale
        ]) for body in bodies
    ])  # fmt: skip
    away = np.hypot(*(foot[:, None, :2] - trees[None, :, :2]).transpose(2, 0, 1))
    nearest = away.argmin(axis=1)
    assert sorted(nearest) == list(range(36)) and away.min(axis=1).max() < 1.0
    # From the middle of the model, 60 m wide with a slope of 4 %.
    np.testing.assert_allclose(foot[:, 2] + scene.frame.height_m, 40.0 + 0.04 * (foot[:, 0] + 30.0), atol=0.1)
    # Leaves reach half an edge of a cluster, at most 0.5 m, beyond the crown, and kinds are alike to 20 %.
    assert (np.abs(size - trees[nearest, 2:]) < 0.5 + 0.2 * trees[nearest, 2:]).all()
    # What `tree_types.MOST_TREES` counts on.
    trunks = [s.instances for s in scene.surfaces if s.instances is not None and s.name.startswith("bark")]
    assert max(body.patches for body in bodies) == 12 and max(body.patches for body in trunks) <= 6
    scale = np.concatenate([body.scale for body in bodies])
    assert 0.8 < scale.min() < scale.max() < 1.25 and len(np.unique(np.round(scale, 3))) > 10


def test_command_says_that_trees_are_copies(wood, tmp_path):
    folder, _, _, made = wood
    asked = ["import-terrain", str(folder / "dsm.tif"), "-o", str(tmp_path / "s"), "--copies"]
    done = CliRunner().invoke(cli.app, asked)
    assert done.exit_code != 0 and "--copies are for scenes in three dimensions" in str(done.exception)
    done = CliRunner().invoke(cli.app, [*asked, "--three-d"])
    assert done.exit_code != 0 and "give a weather and a time too" in str(done.exception)
    assert not (tmp_path / "s").exists()
    done = CliRunner().invoke(cli.app, [*asked, "--three-d", "--weather", str(folder / "w.csv"), "--time", TIME])
    assert done.exit_code == 0 and f"36 trees as copies of {made['kinds']} typical ones" in done.output


def test_more_trees_than_the_memory_holds_are_refused(wood, tmp_path, monkeypatch):
    monkeypatch.setattr("thermorender.apps.lands.solids.tree_types.MOST_TREES", 35)
    with pytest.raises(ThermorenderError, match=r"has 36 trees, more than the 35 whose .*; give a smaller area"):
        import_terrain(wood[0] / "dsm.tif", None, tmp_path / "s", ImportSettings(weather=wood[0] / "w.csv", time=TIME),
                       three_d=ThreeD(copies=True))  # fmt: skip
    assert not (tmp_path / "s").exists()


@pytest.mark.slow
def test_copies_look_like_trees_of_their_own_within_the_stated_error(wood):
    found = []
    for scene in wood[1:3]:
        path = scene.spec.folder / "scene.toml"
        text = path.read_text(encoding="utf-8")
        # Otherwise the terrain's mean, which includes the leaves where they belong to the terrain.
        path.write_text(text + "\n[surroundings]\ntemperature = 300.0\n", encoding="utf-8")
        seen = tr.Renderer(coarse(tr.load_scene(path.parent), 6), "fast", samples=16, edge_mk=np.inf, rays=64)
        names = np.array([material.name for material in scene.materials] + [""])
        frames = [
            seen.frame(tr.pose(70.0 * np.cos(pitch), 0.0, 5.0 + 70.0 * np.sin(pitch), look_at=(0.0, 0.0, 4.0)))
            for pitch in np.radians([50.0, 85.0])
        ]
        found.append([
            (frame, names[np.minimum(frame.truth["material"], len(names) - 1)] == "broadleaf") for frame in frames
        ])  # fmt: skip
        path.write_text(text, encoding="utf-8")
    for (copies, leaves), (own, others) in zip(*found, strict=True):
        stated = np.sqrt(np.nanmean(copies.error_mk[leaves] ** 2))
        off = copies.apparent_temperature[leaves].mean() - own.apparent_temperature[others].mean()
        assert 1e3 * abs(off) < 200.0 < stated < 1400.0
        # Volumes are the same, and kinds are alike to a few percent in each of 36 crowns.
        assert leaves.mean() == pytest.approx(others.mean(), rel=0.08)
        assert leaves.mean() > 0.1
