"""Procedural worlds to the horizon: the ring around the square, and what stands on the heath."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from support import slow

import thermorender as tr
from thermorender.apps.lands.procedural import three_d
from thermorender.apps.lands.procedural.buildings import car
from thermorender.apps.lands.procedural.canvas import Canvas, Road
from thermorender.apps.lands.procedural.procedural_scene import KINDS, painted, weather_of
from thermorender.apps.lands.procedural.solids import Solids
from thermorender.apps.lands.procedural.surroundings import Surroundings
from thermorender.apps.lands.procedural.weather import balanced
from thermorender.physics.srgb import linear_from_bytes
from thermorender.render.geometry import Geometry
from thermorender.render.variant import activate
from thermorender.scene.ground import Ground
from thermorender.scene.raster import read_band
from thermorender.scene.surface import Surface

SCENES = Path(__file__).parents[3] / "scenes"
SMALL = {"heath": (80.0, 0.5, 1.0), "village": (80.0, 0.5, 1.0), "ridge": (320.0, 2.0, 8.0)}
SIZE, POSTS = 60.0, 60


def height(east, north):
    """Heights of a land with a slope and waves [m]."""
    return 100.0 + 0.05 * east + 2.0 * np.sin(0.15 * east + 0.3) * np.cos(0.11 * north + 0.5)


def tone(east, north):
    """Linear colour of that land in one channel."""
    return 0.3 + 0.15 * np.sin(0.09 * east + 0.4) * np.sin(0.07 * north)


@cache
def around():
    """Surroundings of a square of 60 m with the heights and colours above, and rolling country."""
    canvas = Canvas(5, SIZE, 0.5)
    canvas.albedo[...] = tone(canvas.east, canvas.north)[..., None]
    canvas.material[...] = canvas.value("grass_green")
    line = np.linspace(-0.5 * SIZE, 0.5 * SIZE, POSTS + 1)
    far = Surroundings(canvas, height(line[None, :], -line[:, None]), 1000.0, 180.0)
    far.hills(4.0, 500.0)
    far.woods(far.fractal("woods", 300.0, 4), 12.0, [(90, 100, 60), (80, 90, 60)], "conifer")
    return far


def made(kind):
    """Surroundings of a procedural landscape on level ground, and its canvas."""
    size, texel, post = SMALL[kind]
    canvas = painted(kind, 4, size, texel, post, None, None).canvas
    count = round(size / post) + 1
    sky = float(canvas.surface.max()) + KINDS[kind].heights_m[1]
    far = Surroundings(canvas, np.full((count, count), float(np.median(canvas.surface))), KINDS[kind].reach_m, sky)
    KINDS[kind].around(far)
    return far, canvas


def edge(n=400):
    """Positions on the edge of the square (4 n, 2) [m], and outward directions."""
    s = np.linspace(-0.5, 0.5, n, endpoint=False) * SIZE + 0.03
    half = np.full(n, 0.5 * SIZE)
    points = np.concatenate([
        np.column_stack([s, -half]), np.column_stack([half, s]),
        np.column_stack([-s, half]), np.column_stack([-half, -s]),
    ])  # fmt: skip
    return points, np.repeat([[0.0, -1.0], [1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]], n, axis=0)


def normals(mesh):
    """Unit normals of faces."""
    corner = mesh.vertices[mesh.faces]
    across = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    return across / np.linalg.norm(across, axis=1, keepdims=True)


def test_heights_have_no_step_at_the_edge_of_the_square():
    """A millimetre outside, the ring is as high as the lines between the posts of the square."""
    points, outward = edge()
    east, north = (points + 1e-3 * outward).T
    ring = Ground([around().mesh()])(east, north)
    along = np.where(outward[:, 0] == 0.0, points[:, 0], points[:, 1])
    step = SIZE / POSTS
    low = np.floor(along / step) * step
    ends = [
        height(*np.where(outward == 0.0, place[:, None], points).T) for place in (low, low + step)
    ]  # fmt: skip
    expected = ends[0] + (along - low) / step * (ends[1] - ends[0])
    assert np.isfinite(ring).all()
    assert np.abs(ring - expected).max() < 2e-3
    assert np.ptp(expected) > 4.0


def test_the_ring_has_no_cracks():
    """Each edge of a triangle belongs to two triangles or four, but those at the square and at the horizon."""
    far = around()
    mesh = far.mesh()
    point = np.round(mesh.vertices, 6)
    _, number = np.unique(point, axis=0, return_inverse=True)
    sides = np.sort(number.ravel()[mesh.faces[:, [0, 1, 1, 2, 2, 0]]].reshape(-1, 2), axis=1)
    lines, count = np.unique(sides, axis=0, return_counts=True)
    open_ = lines[count % 2 == 1]
    first = np.zeros((number.max() + 1, 3))
    first[number.ravel()] = point
    reach = np.abs(first[open_][..., :2]).max(axis=-1)
    assert set(np.round(reach.ravel(), 3)) == {0.5 * SIZE, 1000.0}
    assert (reach == 0.5 * SIZE).all(axis=1).sum() == 4 * POSTS
    # Faces are counter-clockwise from above, and those of the walls of woods lean back by a fifth.
    up = normals(mesh)[:, 2]
    assert up.min() > -1e-6 and ((up > 0.0) & (up < 0.3)).sum() > 100


def test_no_wall_of_a_wood_points_to_the_middle():
    """Rays of a camera above the middle never lie in a face, which they could pass unseen."""
    mesh = around().mesh()
    normal = normals(mesh)
    wall = normal[:, 2] < 0.3
    middle = mesh.vertices[mesh.faces[wall]].mean(axis=1)
    for height_m in (10.0, 60.0, 120.0):
        ahead = middle - [0.0, 0.0, 100.0 + height_m]
        ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
        assert np.abs((ahead * normal[wall]).sum(axis=1)).min() > 1e-6


def test_walls_of_woods_face_outwards():
    """Seen from below a wood there is nothing: its roof and walls show their backs only."""
    mesh = around().mesh()
    normal = normals(mesh)
    wall = normal[:, 2] < 0.3
    middle, out = mesh.vertices[mesh.faces[wall]].mean(axis=1), normal[wall]
    ground = Ground([mesh])
    # Heights seen from above: the canopy is behind a wall, not in front of it.
    behind, before = (ground(*(middle + side * 0.05 * out)[:, :2].T) for side in (-1.0, 1.0))
    known = np.isfinite(before) & np.isfinite(behind)
    assert known.mean() > 0.9
    assert (behind[known] > middle[known, 2]).mean() > 0.98 and (before[known] < middle[known, 2]).mean() > 0.98


def test_colours_have_no_step_at_the_edge_of_the_square():
    far = around()
    mesh = far.mesh()
    shown = linear_from_bytes(mesh.colour[0])[:, 1]
    inside = np.clip(np.stack([far.east[0], far.north[0]]), -0.5 * SIZE, 0.5 * SIZE)
    expected = tone(*inside)
    # Texels of a fraction of a metre by half a metre, and cells of two metres in the mirror image.
    assert np.abs(shown - expected).max() < 0.03
    assert np.ptp(expected) > 0.2
    assert (mesh.classes[0] == 1).all()


def test_normals_are_those_of_the_slope():
    """A plane has the normal of its gradient in all texels, at corners and edges too."""
    canvas = Canvas(1, SIZE, 1.0)
    canvas.material[...] = canvas.value("grass_green")
    far = Surroundings(canvas, np.full((31, 31), 50.0), 500.0, 60.0)
    far.ground[...] = 50.0 + 0.3 * far.east - 0.1 * far.north
    expected = np.array([-0.3, 0.1, 1.0]) / np.linalg.norm([-0.3, 0.1, 1.0])
    found = far.normals()
    apart = np.degrees(np.arccos(np.clip(np.einsum("i,ihw->hw", expected, found), -1.0, 1.0)))
    assert apart.max() < 0.5


@pytest.mark.parametrize("kind", ["heath", *slow(*(kind for kind in SMALL if kind != "heath"))])
def test_the_ring_closes_the_horizon_from_all_heights_of_flight(kind):
    far, canvas = made(kind)
    mesh = far.mesh()
    assert 5_000 < len(mesh.faces) < 30_000 and np.abs(mesh.vertices[:, :2]).max() == pytest.approx(far.reach)
    assert far.reach == KINDS[kind].reach_m
    flags = np.zeros((1, 1), np.uint8)
    ring = Surface("s", mesh.vertices, mesh.faces.astype(np.int32), mesh.uv, np.zeros((1, 1, 3), np.uint8), flags,
                   flags.astype(np.float32), flags, 1.0)  # fmt: skip
    mi = activate()
    geometry = Geometry(mi, [ring])
    g = np.random.default_rng(7)
    n = 20_000
    half = 0.5 * canvas.size
    low, high = KINDS[kind].heights_m
    top = float(canvas.surface.max())
    place = np.column_stack([g.uniform(-half, half, (n, 2)), top + g.uniform(low, high, n)])
    azimuth, dip = g.uniform(0.0, 2.0 * np.pi, n), np.radians(g.uniform(0.01, 5.0, n))
    ahead = np.column_stack([np.cos(dip) * np.sin(azimuth), np.cos(dip) * np.cos(azimuth), -np.sin(dip)])
    ray = mi.Ray3f(mi.Point3f(*place.T.astype(np.float32)), mi.Vector3f(*ahead.T.astype(np.float32)))
    hit = np.array(geometry.cast(ray).valid)
    # Only the square itself is missing below the views.
    down = place[:, :2] + ahead[:, :2] * ((place[:, 2:] - canvas.surface.min()) / np.sin(dip)[:, None])
    on_square = (np.abs(down) < half).all(axis=1)
    assert on_square.mean() < 0.05
    assert hit[~on_square].all()


def test_a_road_goes_on_beyond_the_square():
    canvas = Canvas(3, SIZE, 0.5)
    canvas.material[...] = canvas.value("grass_green")
    line = np.linspace(-50.0, 50.0, 60)
    canvas.roads.append(Road(np.column_stack([line, 0.1 * line]), 3.0, np.array([0.5, 0.5, 0.5]), "asphalt"))
    far = Surroundings(canvas, np.zeros((31, 31)), 800.0, 50.0)
    far.continue_roads()
    asphalt = far.material == far.value("asphalt")
    away = np.hypot(far.east, far.north)
    # It winds by up to 30 m to each side.
    off = np.abs(far.north - 0.1 * far.east)
    assert off[asphalt].max() < 66.0 and (off[asphalt & (away < 80.0)] < 6.0).all()
    for side in (-1.0, 1.0):
        assert away[asphalt & (side * far.east > 0.0)].max() > 300.0


@cache
def heath_with_solids():
    return painted("heath", 2, 64.0, 0.5, 1.0, None, None, solid=True)


def test_the_hide_stands_on_the_ground_of_the_heath_outside_the_wood():
    canvas = heath_with_solids().canvas
    mesh = canvas.solids.quads.mesh("hide")
    row, column = (np.round(each).astype(int) for each in canvas.texels(mesh.vertices[:, 0], mesh.vertices[:, 1]))
    above = mesh.vertices[:, 2] - canvas.ground[row, column]
    low = above < 0.0
    # Four legs and two rails of the ladder end in the ground, not deep below it; the roof is about 5 m above it.
    feet = mesh.vertices[low, :2] - mesh.vertices[:, :2].mean(axis=0)
    assert len(np.unique(np.round(feet / 0.4), axis=0)) >= 6
    assert above.min() > -1.0 and 4.8 < above.max() < 6.0
    middle = mesh.vertices[:, :2].mean(axis=0)
    assert np.abs(middle).max() < 0.5 * canvas.size - 2.0
    assert {canvas.names[value] for value in np.unique(mesh.classes)} == {"wood", "roof_rubber"}


def test_the_car_of_the_heath_has_a_cabin_and_a_warm_bonnet_in_three_dimensions():
    objects = {item["name"]: item for item in heath_with_solids().objects}
    assert set(objects) == {"marker", "car", "car_cabin", "car_roof", "car_bonnet"}
    assert objects["marker"]["temperature"] == 330.0
    assert all(objects[name]["temperature"] == "balance" for name in objects if name != "marker")
    assert objects["car_bonnet"]["inner_heat_w"] == 450.0


def test_an_engine_heats_a_bonnet_that_is_warmer_than_sunlight_makes_it():
    cold, warm = (
        balanced(car("a", 0.0, 0.0, 0.0, (90, 90, 90), "paint_metallic", 300.0, bonnet))[-1]
        for bonnet in (302.0, 322.0)
    )
    assert cold["inner_heat_w"] == 0.0
    # 20 K above the sunlit paint, on both sides of 1.76 m², at about 20 W m⁻² K⁻¹.
    assert warm["inner_heat_w"] == pytest.approx(20.0 * 2.0 * 1.6 * 1.1 * 20.0, rel=0.1)


@pytest.fixture
def bare(monkeypatch):
    """Worlds without plants, which are most of their cost."""
    monkeypatch.setattr(Solids, "tree", lambda *args: None)
    monkeypatch.setattr(Solids, "hedge", lambda *args: None)


@pytest.mark.slow
@pytest.mark.parametrize("kind", SMALL)
def test_a_world_loads_and_shows_land_at_the_horizon(kind, tmp_path, bare):
    size, texel, post = SMALL[kind]
    folder = three_d.write(three_d.make_world(kind, 4, size, texel, post), tmp_path / "world")
    scene = tr.load_scene(folder)
    parts = {surface.name.split(":")[-1]: surface for surface in scene.surfaces[: scene.terrain_count]}
    # About as warm as the square.
    ring, square = parts["surroundings"], parts["ground"]
    assert abs(float(np.median(ring.temperature)) - float(np.median(square.temperature))) < 12.0
    renderer = tr.Renderer(scene, quality="fast")
    for pitch in (-5.0, -10.0):
        frame = renderer.frame(scene.pose(0.0, 0.0, KINDS[kind].heights_m[0], yaw_deg=30.0, pitch_deg=pitch))
        background = (frame.truth["mask"] & 16) > 0
        assert not background.any()
        assert np.nanmin(frame.apparent_temperature[-40:]) > 270.0


@pytest.mark.slow
def test_cars_follow_the_weather(tmp_path, bare):
    kelvin = {}
    for time in ("2018-09-02T12:30Z", "2018-09-02T03:00Z"):
        world = three_d.make_world("heath", 4, *SMALL["heath"], weather=weather_of("heath", time=time))
        folder = three_d.write(world, tmp_path / time[-6:-4])
        scene = tr.load_scene(folder)
        kelvin[time] = {item.name: item.temperature for item in scene.spec.objects}
        air = float(scene.weather.at(scene.time).air_k)
        kelvin[time] |= {"air": air}
        survey = tr.load_scene(folder / three_d.SURVEY)
        assert {item.name: item.temperature for item in survey.spec.objects} == {
            name: value for name, value in kelvin[time].items() if name != "air"
        }
        ground = Ground([surface for surface in scene.surfaces if surface.name.split(":")[-1] == "ground"])
        body = next(surface for surface in scene.surfaces if surface.name.split(":")[0] == "car")
        low = body.vertices[:, 2].min()
        assert low - ground(*body.vertices[:, :2].mean(axis=0)) == pytest.approx(0.25, abs=0.15)
    noon, night = kelvin.values()
    # In the sun above the air; under the clear sky of the night below it, but for the bonnet above the engine.
    assert noon["car_roof"] > noon["air"] + 2.0 and noon["car"] > night["car"] + 5.0
    assert night["car_roof"] < night["air"]
    assert night["car_bonnet"] > night["car_roof"] + 3.0
    assert noon["marker"] == night["marker"] == 330.0


@pytest.mark.parametrize("kind", KINDS)
def test_the_shipped_survey_shows_the_shipped_world(kind):
    """Where nothing stands, a survey's texel has the ground's material and temperature."""
    # The ground's texture is on the survey's extent, but for the turn of the grid, which is small near the middle.
    names = ("survey/temperature.tif", "ground_kelvin.tif", "survey/classes.tif", "ground_classes.png")
    found = [read_band(SCENES / kind / name) for name in names]
    side = min(map(len, found))
    one, other, material, ground = (each[np.ix_(*2 * [np.arange(side) * len(each) // side])] for each in found)
    middle = np.zeros(ground.shape, bool)
    middle[3 * side // 8 : 5 * side // 8, 3 * side // 8 : 5 * side // 8] = True
    same = (material == ground)[middle]
    assert same.mean() > 0.3
    error = np.abs(one - other)[middle][same]
    assert np.median(error) < 0.1 < np.median(np.abs(np.roll(one, side // 4, axis=0) - other)[middle][same])
