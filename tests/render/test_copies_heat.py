"""Temperatures of copies of bodies by heat balance, against the same leaves as faces."""

import numpy as np
import pytest
from copies_support import apart, write_crown

import thermorender as tr
from scenes import WEATHER, coarse, scene_object, write_balance, write_terrain
from thermorender.apps.lands.solids.plants import write_leaf_tables
from thermorender.errors import ThermorenderError
from thermorender.render.geometry import Geometry
from thermorender.render.heat.instants import solved_at
from thermorender.render.light import leaves as light_leaves
from thermorender.render.light import radiosity
from thermorender.render.variant import activate

PLACES = "east_m,north_m,yaw_deg\n0,0,30\n4,3,200\n"


def write_crowns(folder, extra="", kelvin="balance", clusters=90, write=write_balance):
    """Write a flat scene with two porous crowns and return its folder."""
    folder.mkdir(parents=True)
    write_crown(folder, 3 * clusters, 0.5, clusters)
    (folder / "places.csv").write_text(PLACES, encoding="utf-8")
    write_leaf_tables(folder)
    trees = scene_object("trees", temperature=kelvin, material="broadleaf", file="crown.ply", instances="places.csv")
    still = scene_object("stone", position=[-5.0, -5.0, 0.0], temperature=285.0, material="granite")
    return write(folder, extra=WEATHER + still + trees + extra)


@pytest.mark.slow
def test_patches_have_the_mean_temperature_and_the_scatter_of_their_leaves(tmp_path):
    scene = tr.load_scene(write_crowns(tmp_path / "s"))
    assert scene.solved_count == 2
    assert np.isnan(scene.surfaces[1].temperature).all()
    trees = solved_at(scene, [scene.time])[0].surfaces[1]
    body, found = trees.instances, trees.temperature.ravel()[: len(trees.faces)]
    # The sun is tested at one point of a texel, and leaves are shaded in part: 16 texels make their means exact.
    single = solved_at(apart(scene, halvings=2), [scene.time])[0].surfaces[1]
    own = single.temperature.ravel()[: len(single.faces)].reshape(len(body), -1, 16)
    geometry = Geometry(activate(), [trees])
    opened = light_leaves.open_points(geometry, 0, radiosity.openness)
    weight = body.face_area * (opened.sky + opened.below)
    total = np.bincount(body.patch, weight)
    mean, square = (
        np.array([np.bincount(body.patch, weight * copy) / total for copy in (own**power).mean(axis=2)])
        for power in (1, 2)
    )
    off = found.reshape(mean.shape) - mean
    scatter = np.sqrt(np.maximum(square - mean**2, 0.0))
    assert scatter.max() > 0.8
    # 32 points of each patch test for the sun.
    assert np.sqrt((off**2).mean()) < 0.2
    assert abs(off.mean()) < 0.1
    stated = trees.scatter_k.ravel()[: len(trees.faces)].reshape(mean.shape)
    assert np.sqrt((stated**2).mean()) == pytest.approx(np.sqrt((scatter**2).mean()), rel=0.15)


@pytest.mark.slow
def test_budget_of_copies_has_the_scatter_of_their_temperatures(tmp_path):
    scene = coarse(tr.load_scene(write_crowns(tmp_path / "s")), 8)
    renderer = tr.Renderer(scene, "fast")
    first = renderer.baked.geometry.face_start[1]
    scatter = renderer.scene.surfaces[1].scatter_k.ravel()[:24]
    error = np.sqrt(renderer.baked.face_error[first : first + 24]) / renderer.plan.radiance_per_mk
    assert (error > 900.0 * scatter).all()
    assert scatter.max() > 0.8
    solved = renderer.scene.surfaces[:2]
    columns = sum(each.material.size + len(each.faces) for each in solved)
    row = next(row for row in renderer.plan.rows() if row[0] == "heat columns")
    assert (row[1], "terrain and of 1 object" in row[2]) == (str(columns), True)
    # Objects with kelvin of their own keep it, and names stay with their surfaces.
    frame = renderer.frame(tr.pose(0.0, 0.0, 20.0, pitch_deg=-90.0))
    shown = {name: frame.truth["object"] == number for number, name in enumerate(frame.objects, start=1)}
    assert frame.truth["kinetic_temperature"][shown["stone"]] == pytest.approx(285.0)
    assert len(np.unique(frame.truth["kinetic_temperature"][shown["trees"]])) > 4
    # An edit that does not change the balance keeps the temperatures.
    moved = renderer.scene.with_sky(200.0)
    np.testing.assert_array_equal(moved.surfaces[1].temperature, renderer.scene.surfaces[1].temperature)


def test_kelvin_of_an_edit_replaces_the_balance(tmp_path):
    scene = tr.load_scene(write_crowns(tmp_path / "s"))
    warm = scene.with_objects({"trees": 290.0})
    assert (warm.solved_count, scene.solved_count) == (1, 2)
    assert {float(surface.temperature.flat[0]) for surface in warm.surfaces[1:]} == {285.0, 290.0}


def test_balance_is_refused_where_the_terrain_has_another_source(tmp_path):
    words = r"temperature of object 'trees' is 'balance', .*source='raster'; give the object"
    with pytest.raises(ThermorenderError, match=words):
        tr.load_scene(write_crowns(tmp_path / "s", write=write_terrain))
