"""Scenes in three dimensions: quadrilaterals with pictures, their files, crowns, and the survey of a world."""

import warnings
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import rasterio
import trimesh
from rasterio.errors import NotGeoreferencedWarning

import thermorender as tr
from thermorender.apps.lands.procedural.buildings import ROOFS, Window, house
from thermorender.apps.lands.procedural.canvas import Canvas
from thermorender.apps.lands.procedural.solids import Solids
from thermorender.apps.lands.procedural.three_d import SURVEY, _frame, _grid, _positions, _standing, make_world, write
from thermorender.apps.lands.solids.quads import Quads
from thermorender.apps.lands.solids.textured_mesh import TexturedMesh, write_kelvin, write_mesh
from thermorender.errors import ThermorenderError
from thermorender.physics.srgb import linear_from_bytes
from thermorender.render.from_above import from_above
from thermorender.render.geometry import Geometry
from thermorender.render.variant import activate
from thermorender.scene.meshes.mesh import load
from thermorender.scene.raster import lon_lat
from thermorender.scene.spec import WeatherSpec
from thermorender.scene.surface import Surface
from validation.three_d import imported, pictures, study


def surface_of(vertices, faces):
    """A Surface of one texel, of triangles in memory."""
    texel = np.zeros((1, 1), np.uint8)
    uv = np.full((len(faces), 3, 2), 0.5, np.float32)
    return Surface("s", vertices, np.asarray(faces, np.int32), uv, np.zeros((1, 1, 3), np.uint8), texel,
                   texel.astype(np.float32), texel, 1.0)  # fmt: skip


def test_a_picture_is_upright_on_its_wall_and_comes_back_from_the_file(tmp_path):
    """A wall that faces south, 4 m wide and 2 m high: red at its foot, blue in its upper eastern quarter."""

    def paint(s, t):
        blue = (s > 0.5) & (t > 0.5)
        red = t < 0.5
        return np.stack([1.0 * red, 0.0 * s, 1.0 * blue], axis=-1), np.where(red, 1, np.where(blue, 2, 3))

    quads = Quads(0.1)
    quads.add([(0, 0, 0), (4, 0, 0), (4, 0, 2), (0, 0, 2)], paint)
    quads.add([(0, 9, 0), (0, 9, 0.5), (-1, 9, 0.5), (-1, 9, 0)], lambda s, t: ((0.2, 0.2, 0.2), 4))
    mesh = quads.mesh("walls")
    write_mesh(tmp_path / "w.glb", [mesh])
    (part,) = load(tmp_path / "w.glb", named=("walls",))
    corner = part.vertices[part.faces]
    across = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    middle, wall = corner.mean(axis=1), corner[:, 0, 1] < 1.0
    assert (across[wall, 1] < 0.0).all() and np.abs(across[wall][:, [0, 2]]).max() < 1e-6
    rows, columns = part.colour.shape[:2]
    at = (part.uv.mean(axis=1) * (columns, rows)).astype(int)
    shown = linear_from_bytes(part.colour)[at[:, 1], at[:, 0]]
    low = wall & (middle[:, 2] < 1.0)
    upper_east = wall & (middle[:, 2] > 1.0) & (middle[:, 0] > 2.0)
    assert low.any() and (shown[low] == (1.0, 0.0, 0.0)).all()
    assert upper_east.any() and (shown[upper_east] == (0.0, 0.0, 1.0)).all()
    assert (mesh.classes[at[:, 1], at[:, 0]][low] == 1).all() and (mesh.classes[at[:, 1], at[:, 0]][~wall] == 4).all()


def test_photographs_are_jpeg_where_that_is_smaller_and_map_places_are_kept(tmp_path):
    """A picture of many colours, and one of two; another reader finds the same triangles and pictures."""
    random = np.random.default_rng(2)
    grain = cv2.GaussianBlur(random.integers(0, 256, (160, 200, 3)).astype(np.float32), (0, 0), 1.5)
    many = np.clip(128.0 + 3.0 * (grain - grain.mean()), 0, 255).astype(np.uint8)
    few = np.zeros((160, 200, 3), np.uint8)
    few[:80] = 200
    vertices, faces = random.uniform(-300.0, 300.0, (40, 3)), random.permutation(39).reshape(13, 3)
    uv = random.random((13, 3, 2)).astype(np.float32)
    classes = np.zeros((160, 200), np.uint8)
    made = [TexturedMesh(name, vertices, faces, uv, colour, classes) for name, colour in (("a", many), ("b", few))]
    sizes = []
    for photographs in (True, False):
        write_mesh(tmp_path / "m.glb", made, photographs)
        sizes.append((tmp_path / "m.glb").stat().st_size)
        # Two surfaces, each with the place on the map of every corner within half a step of 1/65535.
        parts = sorted(load(tmp_path / "m.glb", named=("a", "b")), key=lambda one: one.name)
        for part, whole in zip(parts, made, strict=True):
            order, own = (np.lexsort(each.vertices[each.faces].mean(axis=1).round(2).T) for each in (part, whole))
            for corner in range(3):
                assert np.abs(part.vertices[part.faces[order, corner]] - vertices[faces[own, corner]]).max() < 2e-5
                assert np.abs(part.uv[order, corner] - uv[own, corner]).max() < 0.5 / 65535 + 1e-7
            loss = np.abs(part.colour.astype(int) - whole.colour)
            assert 0.0 < loss.mean() < 4.0 if photographs and whole is made[0] else not loss.any()
        scene = trimesh.load(tmp_path / "m.glb")
        kinds = {name: each.visual.material.baseColorTexture.format for name, each in scene.geometry.items()}
        assert kinds == {"a": "JPEG" if photographs else "PNG", "b": "PNG"}
        assert all(len(each.faces) == 13 for each in scene.geometry.values())
    assert sizes[0] < 0.6 * sizes[1]


def test_a_mesh_of_more_corners_than_16_bits_number_comes_back_whole(tmp_path):
    line = np.arange(151.0)
    x, y = (each.ravel() for each in np.meshgrid(line, line))
    vertices = np.column_stack([x, y, np.sin(x) + np.cos(y)])
    a = np.arange(151 * 150).reshape(150, 151)[:, :-1].ravel()
    faces = np.concatenate([np.stack([a, a + 1, a + 152], -1), np.stack([a, a + 152, a + 151], -1)])
    # No two faces share a place on the map, so every corner is a vertex of the file.
    uv = np.random.default_rng(6).random((len(faces), 3, 2)).astype(np.float32)
    picture = np.zeros((4, 4, 3), np.uint8)
    write_mesh(tmp_path / "g.glb", [TexturedMesh("ground", vertices, faces, uv, picture, picture[..., 0])])
    (part,) = load(tmp_path / "g.glb", named=("ground",))
    corner, whole = part.vertices[part.faces], vertices[faces]
    first, second = (np.lexsort(each.mean(axis=1)[:, :2].round(3).T) for each in (corner, whole))
    assert len(corner) == 45_000 and np.abs(corner[first] - whole[second]).max() < 1e-4
    assert np.abs(part.uv[first] - uv[second]).max() < 1e-5


def test_stored_temperatures_are_rounded_to_twenty_millikelvin(tmp_path):
    kelvin = np.random.default_rng(4).uniform(240.0, 390.0, (30, 50))
    write_kelvin(tmp_path / "k.tif", kelvin)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(tmp_path / "k.tif") as file:
            read = file.read(1) * file.scales[0] + file.offsets[0]
    assert 9.0 < 1e3 * np.abs(read - kelvin).max() < 10.001


def test_positions_of_a_survey_are_those_of_its_map():
    """Interpolated between 33² points, against each texel's own projection."""
    world = SimpleNamespace(
        corner=(353_840.0, 5_700_160.0), size_m=320.0, texel_m=2.0, epsg=32634, classes=np.zeros((160, 160)),
        elevation=np.full((4, 4), 134.0),
    )  # fmt: skip
    frame, grid = _frame(world), _grid(world)
    column, row = np.meshgrid(np.arange(grid.width) + 0.5 + 0.25, np.arange(grid.height) + 0.5 - 0.25)
    longitude, latitude = lon_lat(grid, *(each.ravel() for each in grid.to_map(column, row)))
    each = frame.enu_from_geodetic(latitude, longitude, np.full(longitude.size, frame.height_m))
    assert np.abs(_positions(frame, grid, 0.25, -0.25) - each).max() < 1e-4


@pytest.mark.parametrize(("roof", "hip"), [(ROOFS[0], False), (ROOFS[0], True), (ROOFS[-1], False)])
def test_a_house_has_the_heights_of_its_surface_model_and_walls_below_its_eaves(roof, hip):
    """The 2.5-D scene paints the same house as heights from above, by a formula of its own."""
    canvas = Canvas(1, 24.0, 0.1)
    canvas.value("grass_green")
    canvas.solids = Solids(canvas)
    window = Window(canvas, 1.0, -0.5, 25.0, 11.0)
    fine = np.zeros(canvas.shape, np.float32)
    body = house(window, fine, np.random.default_rng(5), 0.5, 0.3, 5.5, 4.2, 4.0, roof, 38.0, hip)
    mesh = canvas.solids.quads.mesh("house")
    geometry = Geometry(activate(), [surface_of(mesh.vertices, mesh.faces)])
    east, north = np.broadcast_arrays(canvas.east, canvas.north)
    height, texel = from_above(geometry, east, north)
    there = np.zeros(canvas.shape, bool)
    window.view(there)[...] = body
    assert ((texel >= 0) == there).mean() > 0.995
    apart = np.abs(height - canvas.top)[there & (texel >= 0)]
    print(roof[0], hip, np.median(apart), np.quantile(apart, [0.9, 0.98]))
    # But for chimneys, whose width differs, and texels across an edge.
    assert np.quantile(apart, 0.95) < 0.12
    corner = mesh.vertices[mesh.faces]
    across = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    upright = np.abs(across[:, 2]) < 1e-9
    # Four walls of 11 by 8.4 m, at least to the height of the eaves.
    assert 0.5 * np.linalg.norm(across[upright], axis=1).sum() > 2.0 * (11.0 + 8.4) * 3.9


def test_panels_on_one_line_of_large_texels_lie_on_the_roof():
    """Texels of 2 m show a narrow array as a line, which does not tell the slope across it."""
    canvas = Canvas(1, 64.0, 2.0)
    canvas.value("glass")
    canvas.solids = Solids(canvas)
    window = Window(canvas, 1.0, -0.5, 25.0, 11.0)
    canvas.top[:] = 5.0 + 0.4 * canvas.east
    field = np.zeros(window.view(canvas.top).shape, bool)
    field[len(field) // 2, 1:-1] = True
    canvas.solids.panels(window, field, (0.0, 0.0), (4.0, 0.8))
    vertices = canvas.solids.quads.mesh("panels").vertices
    roof = 5.0 + 0.4 * vertices[:, 0]
    # Level across the line: half of the width times the slope in that direction.
    assert np.abs(vertices[:, 2] - roof - 0.12).max() < 0.8 * 0.4


def test_snow_is_refused():
    winter = WeatherSpec(
        time=np.datetime64("2018-01-17T08:00:00"), air_low_c=-12.0, air_high_c=-3.0, humidity=0.9, wind_m_s=2.0,
        cloud=0.1, snow_depth_m=0.3,
    )  # fmt: skip
    with pytest.raises(ThermorenderError, match=r"snow_depth_m=0\.3: snow on walls and crowns is not modelled"):
        make_world("village", 0, 40.0, 0.5, 1.0, weather=winter)


@pytest.mark.slow
def test_a_world_and_its_survey_are_the_same_from_above(tmp_path):
    """From straight above both show the same ground at the same place; a house's wall is in the world only."""
    folder = write(make_world("village", 2, 48.0, 0.4, 0.8), tmp_path / "world")
    world, survey = tr.load_scene(folder), tr.load_scene(folder / SURVEY)
    assert (survey.frame.latitude_deg, survey.frame.height_m) == (world.frame.latitude_deg, world.frame.height_m)
    shown = []
    for scene in (world, survey):
        camera = replace(scene.camera, width=96, height=80, pixel_pitch_um=scene.camera.pixel_pitch_um * 640 / 96)
        renderer = tr.Renderer(scene.with_camera(camera), quality="fast", rays=64)
        shown.append((renderer.frame(tr.pose(0, 0, 45, pitch_deg=-90)), renderer.scene))
    frames = [frame.apparent_temperature for frame, _ in shown]
    names = np.array([material.name for material in world.materials])
    ground = np.isin(names[shown[0][0].truth["material"]], ("grass_green", "grass_dry", "asphalt", "concrete"))
    # Means of 7 × 7 pixels: between its squares the survey is interpolated, and the world steps.
    inner = cv2.erode(ground.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    mean = [cv2.blur(frame, (7, 7)) for frame in frames]
    apart, moved = (np.median(np.abs(mean[0] - other)[inner]) for other in (mean[1], np.roll(mean[1], 4, axis=1)))
    print("ground", inner.mean(), apart, moved)
    # Two surveys of one ground: noise of the light between surfaces, and edges of crowns.
    assert inner.sum() > 200 and apart < 0.1 < 2.0 * apart < moved
    with (
        rasterio.open(folder / SURVEY / "temperature.tif") as squares,
        rasterio.open(folder / SURVEY / "classes.tif") as one,
    ):
        assert (2 * squares.width, squares.bounds) == (one.width, one.bounds)
    # Texels of a material have one temperature in squares of two by two, but for those that no face shows.
    (ground,) = (surface for surface in world.surfaces if surface.name.endswith("ground"))
    kelvin, material = (
        each.reshape(60, 2, 60, 2).swapaxes(1, 2).reshape(-1, 4) for each in (ground.temperature, ground.material)
    )
    pure = np.ptp(material, axis=1) == 0
    assert 0.5 < pure.mean() < 1.0 and np.ptp(kelvin[pure], axis=1).max() == 0.0 < np.ptp(kelvin[~pure], axis=1).mean()
    # Walls: brick in the world's truth, and no upright brick from above.
    assert {"brick_painted", "brick_clay"} & set(names)
    kelvin = np.concatenate([surface.temperature.ravel() for surface in world.surfaces])
    assert kelvin.min() > 280.0 and kelvin.max() < 345.0
    # Leaves of crowns have temperatures of their own, and some are in the sun.
    (crowns,) = (surface for surface in world.surfaces if surface.instances is not None)
    body, count = crowns.instances, len(crowns.faces)
    assert not body.box and len(body) > 12 and np.abs(body.middle[:, :2]).max() <= 24.0
    warm, more = crowns.temperature.ravel()[:count], crowns.scatter_k.ravel()[:count]
    assert len(np.unique(warm)) > len(body) and np.ptp(warm) < 6.0 and 0.3 < more.max() < 6.0
    # The survey shows the tops of crowns, and classes of leaves there.
    top = body.middle[np.argsort(body.middle[:, 2])[-5:]]
    above = survey.ground(top[:, 0], top[:, 1]) - world.ground(top[:, 0], top[:, 1])
    assert (above > 2.0).all()


@pytest.mark.slow
def test_the_study_finds_the_error_at_walls_and_none_on_open_ground():
    found = study.run(seeds=(7,), views=1, size_m=56.0, maps=("constant", "fok-1to1"))
    error = {(case["angle_deg"], case["kind"]): case.get("mae_k", 0.0) for case in found["cases"]}
    for angle in study.ANGLES[:3]:
        assert error[angle, "far ground"] < 0.5 < error[angle, "façade"]
    assert set(found["ranking"]["mae_k"]) == {"constant", "fok-1to1"} and found["ranking"]["tau"]["3-D"] == 1.0
    assert len(study.rows(found)) > 12 and len(study.budget_rows(found["budget"])) == len(study.ANGLES)
    # Views of all angles, and in each the stated error exceeds the true one.
    assert [view["angle_deg"] for view in found["budget"]] == list(study.ANGLES)
    assert all(0.0 < view["true_mk"] < view["stated_mk"] for view in found["budget"]), found["budget"]


@pytest.mark.slow
def test_the_stated_error_of_an_imported_scene_exceeds_the_true_one_in_oblique_views():
    found = imported.run(seed=7, views=1, size_m=56.0)
    assert found["buildings"] > 0 and found["trees"] > 0
    assert [view["angle_deg"] for view in found["views"]] == list(study.ANGLES)
    assert all(0.0 < view["true_mk"] < view["stated_mk"] for view in found["views"]), found["views"]


def test_a_sheet_has_one_scale_of_grey_for_both_scenes_and_none_for_the_sky():
    visible = np.full((2, 100, 3), 7, np.uint8)
    warm = np.linspace(280.0, 300.0, 200).reshape(2, 100)
    cold = warm - 20.0
    cold[0, 0] = np.nan
    made = pictures.sheet([(visible, cold)], [(visible, warm)])
    assert made.shape == (6, 416, 3) and (made[:2, :100] == 7).all() and (made[:2, 100:104] == 255).all()
    draped, solid = made[:2, 208:308, 0].astype(float), made[:2, 312:412, 0].astype(float)
    assert draped[0, 0] == 0.0
    # Both cover 260 K to 300 K without one percent at each end; a level of grey is 0.15 K, and a pixel 0.1 K.
    kelvin = [260.0 + 40.0 * (0.01 + 0.98 * grey / 255.0) for grey in (draped, solid)]
    assert kelvin[0][:, 2:].ravel() == pytest.approx(np.nan_to_num(cold)[:, 2:].ravel(), abs=0.2)
    assert kelvin[1][:, :-5].ravel() == pytest.approx(warm[:, :-5].ravel(), abs=0.2)


def test_objects_stand_on_the_ground_and_not_within_buildings():
    """A greenhouse of 4 m over the east, heather of 0.3 m in the west, on ground of 100 m."""
    ground = lambda east, north: np.float64(100.0)  # noqa: E731
    highest = lambda east, north: np.float64(104.0 if east > 0.0 else 100.3)  # noqa: E731
    places = {"car_0": -9.0, "car_0_roof": -9.0, "car_1": -0.5, "car_1_bonnet": 0.5, "car_10": -8.0, "marker": -3.0}
    items = [{"name": name, "position": [east, 1.0, 0.5]} for name, east in places.items()]
    found = {item["name"]: item["position"][2] for item in _standing(items, (highest, ground))}
    assert found == pytest.approx(dict.fromkeys(("car_0", "car_0_roof", "car_10", "marker"), 0.2))
