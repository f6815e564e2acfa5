"""How objects stand on the ground: on its slope or upright, and notes on those that are in it."""

import re

import numpy as np
import pytest

import thermorender as tr
from scenes import coarse, plane, scene_object, write_mesh, write_terrain
from thermorender.errors import ThermorenderError

SLOPE = np.tan(np.radians(15.0))


def sloping(rows=64, east=SLOPE, north=0.0):
    """Heights (rows, rows) of posts 1 m apart on a plane that is 0 m high in the middle of the scene."""
    row, column = np.mgrid[:rows, :rows] - 0.5 * (rows - 1)
    return 100.0 + east * column - north * row


def scene(folder, *objects, height=None, **terrain):
    return tr.load_scene(
        write_terrain(folder, height=sloping() if height is None else height, extra="".join(objects), **terrain)
    )


def corners(of, name):
    """Vertices of a static object in the scene's frame, (V, 3)."""
    return np.concatenate([one.vertices for one in of.surfaces if one.name.split(":")[0] == name])


def above(of, point):
    """Height of points (n, 3) above the ground of a scene, which is a plane through its triangles (n,)."""
    return point[:, 2] - of.ground(point[:, 0], point[:, 1])


def axes(of, name, size):
    """Unit vectors (3, 3) of a box along its sides, by its eight corners in the order of x, then y, then z."""
    box = corners(of, name)[:8]
    return np.stack([box[4] - box[0], box[2] - box[0], box[1] - box[0]]) / np.reshape(size, (3, 1))


def tilt_deg(sides):
    """Angle of a box's upright sides from the vertical, by its `axes`."""
    return np.degrees(np.arctan2(np.hypot(*sides[2, :2]), sides[2, 2]))


def test_a_disc_lies_on_a_slope_and_all_of_it_is_seen(tmp_path):
    of = scene(tmp_path / "s", scene_object("marker", [2, 2, 0.05], shape="disc"))
    disc = corners(of, "marker")
    # 2 cm along the normal of the slope, which is 2 cm / cos 15° above it.
    assert np.allclose(above(of, disc), 0.02 / np.cos(np.radians(15.0)), atol=2e-4)
    assert np.allclose(np.ptp(disc, axis=0), [2 * np.cos(np.radians(15)), 2, 2 * np.sin(np.radians(15))], atol=1e-3)
    assert of.surface_notes == ()
    frame = tr.Renderer(of, quality="fast").frame(of.pose(0, 0, 20, 90, -90))
    focal, depth = frame.camera.focal_length_px, 20.0 - 0.02
    seen = np.sum(frame.truth["object"] == frame.objects.index("marker") + 1)
    # Area of a circle on the slope, projected along the vertical.
    assert seen == pytest.approx(np.pi * (focal / depth) ** 2 * np.cos(np.radians(15.0)), rel=0.01)
    assert frame.targets["marker"]["visible"]


@pytest.mark.parametrize("yaw", [0.0, 35.0, 200.0])
def test_a_box_takes_the_slope_and_keeps_its_heading(tmp_path, yaw):
    east, north = 0.2, -0.1
    car = scene_object("car", [1.8, 4.4, 1.4], [3.0, -5.0, 0.0], yaw_deg=yaw)
    of = scene(tmp_path / "s", car, height=sloping(east=east, north=north))
    right, ahead, up = axes(of, "car", [1.8, 4.4, 1.4])
    normal = np.array([-east, -north, 1.0]) / np.sqrt(1.0 + east**2 + north**2)
    heading = np.radians(yaw)
    assert np.allclose(up, normal, atol=1e-4)
    assert np.degrees(np.arctan2(ahead[0], ahead[1])) % 360.0 == pytest.approx(yaw, abs=0.01)
    assert np.allclose(ahead[2] / np.hypot(*ahead[:2]), east * np.sin(heading) + north * np.cos(heading), atol=1e-4)
    assert np.allclose(right, np.cross(ahead, up), atol=1e-4)
    assert np.allclose(above(of, corners(of, "car")[[0, 2, 4, 6]]), 0.0, atol=2e-4)


@pytest.mark.parametrize(
    ("size", "position", "more", "tilted"),
    [
        ([1, 1, 1], [0, 0, 0], {}, True),
        ([2.5, 8, 2.9], [0, 0, 0], {}, True),
        ([0.5, 0.5, 1.8], [0, 0, 0], {}, False),  # a person
        ([10, 0.2, 2], [0, 0, 0], {}, False),  # a wall
        ([9, 13, 6], [0, 0, 0], {}, False),  # a house
        ([1, 1, 0.3], [0, 0, 20], {}, False),  # a drone
        ([1, 1, 0.3], [0, 0, 0], {"upright": True}, False),
        ([0.5, 0.5, 1.8], [0, 0, 0], {"upright": False}, True),
    ],
)
def test_what_is_high_or_taller_than_wide_stands_upright_unless_stated(tmp_path, size, position, more, tilted):
    of = scene(tmp_path / "s", scene_object("it", size, position, **more))
    assert tilt_deg(axes(of, "it", size)) == pytest.approx(15.0 if tilted else 0.0, abs=0.01)


def test_parts_of_a_body_stay_together_on_a_slope(tmp_path):
    body = scene_object("body", [1.8, 4.4, 0.7], [1, 2, 0.25], yaw_deg=40.0)
    roof = scene_object("roof", [1.8, 4.4, 0.05], [1, 2, 0.95], yaw_deg=40.0)
    of = scene(tmp_path / "s", body, roof)
    assert np.allclose(corners(of, "body")[[1, 3, 5, 7]], corners(of, "roof")[[0, 2, 4, 6]], atol=1e-6)


def test_on_level_ground_an_object_stands_exactly_level(tmp_path):
    height = np.full((16, 16), 100.0)
    height[:4] += 0.3 * np.arange(4, 0, -1)[:, None]
    of = scene(tmp_path / "s", scene_object("mat", [2, 3, 0.1], [1, -2, 0.2], yaw_deg=0.0), height=height)
    mat = corners(of, "mat")[:8]
    assert set(mat[:, 0]) == {0.0, 2.0} and set(mat[:, 1]) == {-3.5, -0.5}
    assert len(set(mat[:, 2])) == 2 and mat[0, 2] == float(of.ground(1.0, -2.0)) + 0.2


def rough(seed, posts=48):
    """Heights of posts on a slope with grass of up to 20 cm."""
    return sloping(posts) + np.random.default_rng(seed).uniform(0.0, 0.2, (posts, posts))


@pytest.mark.parametrize("seed", range(4))
def test_on_rough_ground_a_disc_lies_on_the_highest_points(tmp_path, seed):
    of = scene(tmp_path / "s", scene_object("marker", [6, 6, 0.05], [2, 1, 0], shape="disc"), height=rough(seed))
    disc = of.surfaces[1]
    height = above(of, disc.vertices[disc.faces].mean(axis=1))
    assert height.min() > -0.01 and height.max() < 0.25
    assert of.surface_notes == ()


def test_a_crown_and_a_wall_beside_an_object_neither_tilt_nor_raise_it(tmp_path):
    height = sloping(240)
    height[:, 126:] += 6.0  # a wall whose foot is 0.7 m of the car's width
    height[121:124, 122:124] += 4.0  # a crown over its rear
    of = scene(tmp_path / "s", scene_object("car", [4.0, 6.0, 1.4], [4.2, 0.0, 0.0]), height=height)
    assert tilt_deg(axes(of, "car", [4.0, 6.0, 1.4])) == pytest.approx(15.0, abs=1.0)
    middle = corners(of, "car")[:8].mean(axis=0)
    assert middle[2] == pytest.approx(
        SLOPE * middle[0] + float(of.ground(0.0, 0.0)) + 0.7 / np.cos(np.radians(15)), abs=0.3
    )


def test_an_object_on_a_track_follows_the_slope(tmp_path):
    folder = write_terrain(
        tmp_path / "s", height=sloping(), extra=scene_object("van", [2, 5, 2], [0, 0, 0], track="van.csv")
    )
    (folder / "van.csv").write_text("time_s,east_m,north_m,yaw_deg\n0,-5,0,90\n10,5,0,90\n20,5,6,0\n")
    of = tr.load_scene(folder)
    (van,) = of.tracked_objects
    for time_s, yaw in ((3.0, 90.0), (20.0, 0.0)):
        pose = van.world_from_own(van.at(time_s), of.ground)
        heading = np.radians(yaw)
        pitch = SLOPE * np.sin(heading)
        assert np.allclose(pose[:3, 2], [-np.sin(np.radians(15)), 0, np.cos(np.radians(15))], atol=1e-4)
        assert np.allclose(pose[:3, 1] * np.hypot(1, pitch), [np.sin(heading), np.cos(heading), pitch], atol=1e-3)
        assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
    assert of.surface_notes == ()


def test_a_level_disc_in_a_slope_is_named_with_its_share_and_the_height_that_frees_it(tmp_path):
    marker = scene_object("marker", [2, 2, 0.05], shape="disc", upright=True)
    (note,) = scene(tmp_path / "s", marker).surface_notes
    # More than 1 cm under the ground is the segment of the circle beyond this distance from its middle.
    far = (0.02 + 0.01) / SLOPE
    share = (np.arccos(far) - far * np.sqrt(1.0 - far**2)) / np.pi
    assert "object 'marker'" in note and int(re.search(r"(\d+)%", note)[1]) == pytest.approx(100 * share, abs=3)
    raised = float(re.search(r"raise it by ([\d.]+) m", note)[1])
    lifted = scene_object("marker", [2, 2, 0.05], [0, 0, raised], shape="disc", upright=True)
    assert scene(tmp_path / "t", lifted).surface_notes == ()
    level = np.full((64, 64), 100.0)
    assert scene(tmp_path / "u", marker, height=level).surface_notes == ()


def test_an_object_on_a_track_is_named_with_a_place_where_it_is_in_the_ground(tmp_path):
    sledge = scene_object("sledge", [2, 5, 0.3], [0, 0, 0], upright=True, yaw_deg=90.0, track="track.csv")
    folder = write_terrain(tmp_path / "s", height=sloping(), extra=sledge)
    (folder / "track.csv").write_text("time_s,north_m\n0,-8\n10,8\n")
    (note,) = tr.load_scene(folder).surface_notes
    # The ground is 1 cm above its top beyond this distance from its middle.
    share = (2.5 - 0.31 / SLOPE) / 5.0
    assert "object 'sledge'" in note and re.search(r"at 0\.0 m east, -?\d\.\d m north", note)
    assert int(re.search(r"(\d+)%", note)[1]) == pytest.approx(100 * share, abs=3)


def test_flat_copies_in_a_slope_are_named_and_trees_are_not(tmp_path):
    for name, size, named in (("mats", [2, 2, 0.05], True), ("trees", [2, 2, 6], False)):
        extra = scene_object(name, size, instances="places.csv")
        folder = write_terrain(tmp_path / name, height=sloping(), extra=extra)
        (folder / "places.csv").write_text("east_m,north_m,scale\n1,2,1\n3,4,1\n-8,9,1\n")
        found = tr.load_scene(folder).surface_notes
        assert len(found) == named
        # The ground is 1 cm above the level top beyond this distance from its middle.
        assert not named or int(re.search(r"(\d+)%", found[0])[1]) == pytest.approx(50 * (1 - 0.06 / SLOPE), abs=4)


def test_copies_stand_upright_and_refuse_another_statement(tmp_path):
    copies = scene_object("posts", [0.5, 0.5, 0.2], instances="places.csv", upright=False)
    folder = write_terrain(tmp_path / "s", height=sloping(), extra=copies)
    (folder / "places.csv").write_text("east_m,north_m\n1,2\n3,4\n")
    with pytest.raises(ThermorenderError, match=r"upright=False is not allowed; give it without instances"):
        tr.load_scene(folder)
    (folder / "scene.toml").write_text((folder / "scene.toml").read_text().replace("upright = false\n", ""))
    body = tr.load_scene(folder).surfaces[1].instances
    assert np.array_equal(body.matrices[:, :, :3], np.broadcast_to(np.eye(3), (2, 3, 3)))


def test_a_sloping_scene_is_lit_as_the_level_one_turned(tmp_path):
    cos, sin = np.cos(np.radians(15.0)), np.sin(np.radians(15.0))
    turn = np.array([[cos, 0, -sin, 0], [0, 1, 0, 0], [sin, 0, cos, 0], [0, 0, 0, 1]])
    # Sky and surroundings are one temperature in all directions, so only the ground's slope differs.
    box = scene_object("box", [3, 3, 1.5], [0, 0, 0], 340.0, "asphalt") + "[surroundings]\ntemperature = 250.0\n"
    images = []
    for name, matrix in (("level", np.eye(4)), ("slope", turn)):
        ground = plane(40.0).subdivide_to_size(1.0).apply_transform(matrix)
        of = coarse(tr.load_scene(write_mesh(tmp_path / name, ground, extra=box)), 8)
        frame = tr.Renderer(of, quality="fast").frame(matrix @ tr.pose(-6, 0, 12, yaw_deg=90, pitch_deg=-60))
        images.append((frame.apparent_temperature, frame.truth["object"]))
    (level, number), (slope, turned) = images
    assert (number > 0).sum() > 500 and (number != turned).mean() < 0.005
    box, bare = (((number == k) & (turned == k)) for k in (1, 0))
    # The ground beside the box differs by the noise of its light only.
    assert np.percentile(np.abs(level - slope)[box], 98) < 0.05 and abs((level - slope)[bare].mean()) < 0.01
