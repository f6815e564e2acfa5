"""Strokes on a picture cover the texels that are seen there, all of them and no others."""

import numpy as np
import pytest

import thermorender as tr
from scenes import write_hut, write_terrain
from thermorender.apps.studio.layers import LAYERS, Plan, Shot, statistics
from thermorender.apps.studio.painting import texels_of
from thermorender.apps.studio.view import Pose, View
from thermorender.errors import ThermorenderError

# Corners of a polygon, as shares of the picture.
CORNERS = np.array([[0.2, 0.3], [0.7, 0.25], [0.8, 0.75], [0.35, 0.8]])


@pytest.fixture(scope="module")
def renderer(tmp_path_factory):
    classes = np.where(np.mgrid[:32, :32][1] < 16, 1, 2)
    return tr.Renderer(tr.load_scene(write_terrain(tmp_path_factory.mktemp("flat") / "tiny", classes=classes)), "fast")


def shot(renderer, pose, plan=False, layer="apparent"):
    """A Shot of a pose."""
    view = View(Pose.typed(pose, renderer.scene), plan=plan, layer=layer)
    if plan:
        return Shot(view, renderer, None, Plan.of(renderer, view, renderer.scene.camera))
    return Shot(view, renderer, renderer.frame(view.pose.matrix()), None)


def middles():
    """(east, north) of the middles of the texels of the terrain, (1024, 2) [m]."""
    row, column = np.mgrid[:32, :32]
    return np.column_stack([(column.ravel() + 0.5) * 0.5 - 8.0, 8.0 - (row.ravel() + 0.5) * 0.5])


def within(point, corner):
    """(whether points are in a polygon, distance to its nearest side)."""
    inside, away = np.zeros(len(point), bool), np.full(len(point), np.inf)
    for a, b in zip(corner, np.roll(corner, -1, axis=0), strict=True):
        crosses = (a[1] > point[:, 1]) != (b[1] > point[:, 1])
        inside ^= crosses & (point[:, 0] < a[0] + (b[0] - a[0]) * (point[:, 1] - a[1]) / (b[1] - a[1]))
        along = np.clip(((point - a) @ (b - a)) / ((b - a) @ (b - a)), 0.0, 1.0)
        away = np.minimum(away, np.linalg.norm(a + along[:, None] * (b - a) - point, axis=1))
    return inside, away


@pytest.mark.parametrize(
    ("pose", "plan"), [("0,0,12,0,-90,0", False), ("0,-7.5,9,0,-50,0", False), ("0,0,12,0,-90,0", True)]
)
def test_a_polygon_covers_every_texel_within_it_and_none_beside_it(renderer, pose, plan):
    """Of the corners on flat ground, as the camera's rays through them meet it."""
    made = shot(renderer, pose, plan)
    camera, scene = renderer.scene.camera, renderer.scene
    pixel = CORNERS * (camera.width, camera.height)
    if plan:
        metres = made.plan.pixel_m
        corner = (pixel - (0.5 * camera.width, 0.5 * camera.height)) * (metres, -metres)
    else:
        matrix = made.frame.pose
        way = np.column_stack([camera.directions(pixel), np.ones(4)]) @ matrix[:3, :3].T
        corner = matrix[:2, 3] + way[:, :2] * (-matrix[2, 3] / way[:, 2:])
    inside, away = within(middles(), corner)
    found = np.zeros(1024, bool)
    found[texels_of(made, "polygon", CORNERS.tolist(), 1.0)] = True
    # A texel of 0.5 m at the edge is covered where a part of it is seen inside.
    sure = away > 0.36
    np.testing.assert_array_equal(found[sure], inside[sure])
    assert found[inside].all() and inside[sure].sum() > 50
    assert scene.terrain_count == 1


def test_a_brush_covers_its_width_even_where_a_texel_is_smaller_than_a_pixel(renderer):
    high = shot(renderer, "0,0,900,0,-90,0", plan=False)
    metres = 900.0 / renderer.scene.camera.focal_length_px
    assert metres > 2 * 0.5
    line = [[0.5 - 4.0 / 640.0, 0.5], [0.5 + 4.0 / 640.0, 0.5]]
    found = np.zeros(1024, bool)
    found[texels_of(high, "brush", line, 3.0)] = True
    east, north = middles().T
    near = (np.abs(north) < 2.0 * metres) & (np.abs(east) < 3.0 * metres)
    assert near.sum() > 100 and found[near].all()
    assert not found[np.abs(north) > 4.5 * metres].any()


def test_what_a_hut_hides_is_not_painted(tmp_path):
    renderer = tr.Renderer(tr.load_scene(write_hut(tmp_path / "hut")), "fast")
    every = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]
    seen = texels_of(shot(renderer, "0,-7,3,0,-25,0"), "polygon", every, 1.0)
    free = texels_of(shot(renderer, "0,0,14,0,-90,0", plan=True), "polygon", every, 1.0)
    matrix, camera = Pose.typed("0,-7,3,0,-25,0", renderer.scene).matrix(), renderer.scene.camera
    point = np.column_stack([middles(), np.zeros(1024)])
    pixel = camera.project((point - matrix[:3, 3]) @ matrix[:3, :3])
    inside = ((pixel > 1.0) & (pixel < (camera.width - 1.0, camera.height - 1.0))).all(axis=1)
    hidden = np.setdiff1d(free[inside[free]], seen)
    # The line of sight to a hidden texel meets the hut, whose walls are 1.5 m from its middle.
    share = np.linspace(0.0, 1.0, 400)[:, None]
    for texel in hidden:
        line = matrix[:3, 3] + share * (point[texel] - matrix[:3, 3])
        assert ((np.abs(line[:, :2]) < 1.85).all(axis=1) & (line[:, 2] < 3.1)).any(), point[texel]
    assert len(hidden) > 20


def test_strokes_that_are_none_are_refused_in_one_sentence(renderer):
    made = shot(renderer, "0,0,12,0,-90,0")
    for tool, points, sentence in (
        ("polygon", [[0.1, 0.1], [0.2, 0.2]], "this polygon has 2 points; draw one of 3 to 5000 points"),
        ("brush", [], "this is not a stroke on the picture"),
        ("brush", [[0.1, float("nan")]], "this is not a stroke on the picture"),
        ("look", [[0.5, 0.5]], "this is not a stroke on the picture"),
        ("area", [[0.5, 0.5, 0.5]], "this is not a stroke on the picture"),
    ):
        with pytest.raises(ThermorenderError, match=sentence):
            texels_of(made, tool, points, 4.0)
    sky = shot(renderer, "0,-7,3,0,10,0")
    for tool in ("area", "brush"):
        with pytest.raises(ThermorenderError, match="there is no terrain at this place, so nothing was painted"):
            texels_of(sky, tool, [[0.5, 0.1]], 4.0)


def test_a_plan_shows_the_values_of_the_texels_under_it(renderer):
    made = shot(renderer, "0,0,12,0,-90,0", plan=True, layer="kinetic")
    values = made.values("kinetic")
    row, column = 100, 200
    east, north, _ = made.position[row, column]
    assert (east, north) == pytest.approx(
        ((column + 0.5 - 320) * made.plan.pixel_m, (256 - row - 0.5) * made.plan.pixel_m), abs=1e-4
    )
    texel = int((8.0 - north) / 0.5) * 32 + int((east + 8.0) / 0.5)
    assert made.texels[row, column] == texel
    assert values[row, column] == renderer.scene.surfaces[0].temperature.ravel()[texel]
    assert made.figures(column, row)["apparent_k"] is None
    assert made.pixel_of(made.position[row, column]) == (column, row)
    with pytest.raises(ThermorenderError, match="Apparent temperature is not shown from above"):
        made.values("apparent")


def test_points_are_found_again_in_another_view_unless_they_are_hidden(tmp_path):
    renderer = tr.Renderer(tr.load_scene(write_hut(tmp_path / "hut")), "fast")
    above = shot(renderer, "0,0,14,0,-90,0", plan=True)
    side = shot(renderer, "0,-7,3,0,-25,0")
    behind, before = np.array([0.0, 4.5, 0.0]), np.array([0.5, -3.0, 0.0])
    assert above.pixel_of(behind) is not None and side.pixel_of(behind) is None
    column, row = side.pixel_of(before)
    np.testing.assert_allclose(side.position[row, column], before, atol=0.05)
    assert side.pixel_of(np.array([0.0, -20.0, 0.0])) is None


def test_the_table_of_materials_has_the_mean_and_extremes_of_what_is_shown(renderer):
    made = shot(renderer, "0,0,12,0,-90,0")
    kelvin, number = made.frame.apparent_temperature, made.frame.truth["material"]
    rows = statistics(made)
    assert sum(row.share for row in rows) == pytest.approx(np.isfinite(made.frame.truth["depth"]).mean())
    assert rows[0].share >= rows[-1].share and len(rows) == 2
    for row in rows:
        own = kelvin[number == made.names.index(row.name)]
        assert (row.mean, row.least, row.greatest) == pytest.approx(
            (own.mean(dtype=float), own.min(), own.max()), rel=1e-6
        )
    assert {row.name for row in rows} == {"grass_green", "sand_quartz"}


def test_every_layer_of_values_has_a_unit_and_a_channel_of_its_own():
    channels = [each.channel for each in LAYERS.values() if each.channel]
    assert len(set(channels)) == len(channels)
    assert {each.unit for each in LAYERS.values()} == {"K", "mK", "W/m²", ""}
