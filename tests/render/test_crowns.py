"""Crowns as turbid media: Beer's law, form factors and temperatures, against closed forms and explicit leaves."""

import cv2
import drjit as dr
import numpy as np
import pytest

import thermorender as tr
from scenes import WEATHER, coarse, scene_object, write_balance, write_terrain
from thermorender.apps.lands.solids.plants import write_leaf_tables
from thermorender.physics.sun import direction
from thermorender.render.arrays import aligned, opaque_view, view_ray
from thermorender.render.crown_shadows import CrownShadows
from thermorender.render.geometry import Geometry
from thermorender.render.heat.copies import Copies
from thermorender.render.light import radiosity
from thermorender.render.pixels.crown_tiles import CrownTiles
from thermorender.render.pixels.sampling import CameraRays
from thermorender.render.variant import activate

TREES = (
    "east_m,north_m,above_ground_m,width_m,length_m,height_m,leaf_area_1_m,yaw_deg\n"
    "-3,2,1,4,4,3,1.2,0\n3,1.5,0.2,3,5,2,0.5,30\n0,-3,0,2,2,5,2,0\n2,2,0.5,2,3,2,1,-70\n"
)


def write_crowns(folder, trees=TREES, kelvin=290.0, **terrain):
    """Write a flat scene with overlapping ellipsoids and a hedge of two boxes side by side; return its folder."""
    folder.mkdir(parents=True)
    (folder / "trees.csv").write_text(trees, encoding="utf-8")
    common = {"material": "broadleaf", "temperature": kelvin}
    extra = scene_object("trees", shape="sphere", instances="trees.csv", leaf_area_1_m=1.0, **common)
    for k, x in enumerate((-1.5, 1.5)):
        extra += scene_object(f"hedge{k}", [3.0, 1.0, 1.5], [x, 5.0, 0.0], shape="box", leaf_area_1_m=2.0, **common)
    return write_terrain(folder, extra=extra, **terrain)


def rays(mi, start, end):
    """Rays (mi.Ray3f) between points (n, 3), and their lengths."""
    length = np.linalg.norm(end - start, axis=1)
    way = (end - start) / length[:, None]
    return mi.Ray3f(mi.Point3f(*map(mi.Float, start.T)), mi.Vector3f(*map(mi.Float, way.T))), length


def optical_depth(surfaces, start, end):
    """G × density × chord, summed over all crowns, in float64; the chords are those of quadratics and slabs."""
    length = np.linalg.norm(end - start, axis=1)
    way, total = (end - start) / length[:, None], np.zeros(len(start))
    for crowns in (each.instances for each in surfaces if each.instances is not None):
        for k in range(len(crowns)):
            heading = np.radians(crowns.yaw_deg[k])
            right, ahead = (np.cos(heading), -np.sin(heading)), (np.sin(heading), np.cos(heading))
            own = np.array([[*right, 0.0], [*ahead, 0.0], [0.0, 0.0, 1.0]]).T
            q, w = (start - crowns.middle[k]) @ own / crowns.half[k], way @ own / crowns.half[k]
            if crowns.box:
                one, other = (-1.0 - q) / w, (1.0 - q) / w
                low, high = np.minimum(one, other).max(axis=1), np.maximum(one, other).min(axis=1)
            else:
                a, b, c = (w * w).sum(axis=1), (q * w).sum(axis=1), (q * q).sum(axis=1) - 1.0
                root = np.sqrt(np.maximum(b * b - a * c, 0.0))
                low, high = (-b - root) / a, (-b + root) / a
            total += 0.5 * crowns.density[k] * np.maximum(np.minimum(high, length) - np.maximum(low, 0.0), 0.0)
    return total


@pytest.mark.parametrize("away_m", [6.0, 60.0, 900.0])
def test_rays_pass_crowns_by_the_law_of_beer(tmp_path, away_m):
    scene, mi, draw = tr.load_scene(write_crowns(tmp_path / "s")), activate(), np.random.default_rng(2)
    geometry = Geometry(mi, scene.surfaces)
    count = 40_000
    end = np.column_stack([draw.uniform(-5.0, 5.0, (count, 2)), draw.uniform(0.0, 3.0, count)])
    way = draw.standard_normal((count, 3))
    start = end + away_m * np.abs(way) * [1, 1, 1] / np.linalg.norm(way, axis=1)[:, None] * np.sign(way) * [1, 1, 0.2]
    start[:, 2] = np.abs(start[:, 2])
    ray, length = rays(mi, start, end)
    expected = np.exp(-optical_depth(scene.surfaces, start.astype(np.float32).astype(float), end))
    assert (expected < 0.999).mean() > 0.2
    visit = lambda chord, state: (chord.new | True, (state[0] + chord.depth,))  # noqa: E731
    begin = (dr.zeros(mi.Float, count),)
    passed = np.exp(-np.array(geometry.crowns.walk(ray, mi.Float(length), mi.Bool(True), begin, visit)[0]))
    # Float32 at 900 m places a point to 0.06 mm; rays that graze a body err by the root of that.
    np.testing.assert_allclose(passed, expected, atol=0.02)
    assert np.sqrt(((passed - expected) ** 2).mean()) < 3e-4
    # Free flights end as often as light is lost.
    met = np.array(geometry.crowns.drawn(ray, mi.Float(length))[0].met)
    off = met.sum() - (1.0 - expected).sum()
    assert abs(off) < 4.0 * np.sqrt((expected * (1.0 - expected)).sum())


@pytest.mark.parametrize("elevation_deg", [90.0, 40.0, 3.0])
def test_sunlight_passes_crowns_by_the_law_of_beer(tmp_path, elevation_deg):
    """From points within, between, below and above the crowns, and far beside them."""
    scene, mi, draw = tr.load_scene(write_crowns(tmp_path / "s")), activate(), np.random.default_rng(2)
    geometry, count = Geometry(mi, scene.surfaces), 40_000
    place = np.column_stack([draw.uniform(-6.0, 6.0, (count, 2)), draw.uniform(0.0, 5.0, count)]).astype(np.float32)
    towards = direction(elevation_deg, 70.0)
    place[:9000] -= (np.outer(draw.uniform(0.0, 60.0, 9000), towards)).astype(np.float32) * [1, 1, 0]
    passed = np.array(geometry.crowns_passed(mi.Point3f(*map(aligned, place.T)), towards))
    far = place + 500.0 * towards
    expected = np.exp(-optical_depth(scene.surfaces, place.astype(float), far))
    assert 0.1 < (expected < 0.999).mean() < 0.95
    # Rays that graze a body err by the root of the rounding.
    np.testing.assert_allclose(passed, expected, atol=0.02)
    assert np.sqrt(((passed - expected) ** 2).mean()) < 3e-4
    assert len(np.unique(passed)) > 1000


def test_sunlight_deep_in_dense_crowns_keeps_its_share(tmp_path):
    """A crown's own transmittance is divided out, which needs all others in full: depths of 7 to 25."""
    trees = TREES.splitlines()[0] + "\n" + "".join(f"{0.2 * k},0,0,4,4,4,2.5,0\n" for k in range(6))
    scene, mi = tr.load_scene(write_crowns(tmp_path / "s", trees)), activate()
    place = np.random.default_rng(1).uniform([-3.0, -1.0, 0.5], [-1.0, 1.0, 1.0], (2000, 3)).astype(np.float32)
    towards = direction(5.0, 90.0)
    passed = np.array(Geometry(mi, scene.surfaces).crowns_passed(mi.Point3f(*map(aligned, place.T)), towards))
    depth = optical_depth(scene.surfaces, place.astype(float), place + 500.0 * towards)
    deep = (depth > 7.0) & (depth < 25.0)
    assert deep.sum() > 300
    np.testing.assert_allclose(-np.log(passed[deep]), depth[deep], atol=0.02)


def test_large_crowns_beside_small_ones_fill_few_tiles(tmp_path):
    fields = "".join(f"{0.3 * k},0,0,400,400,0.6,0.1,{k}\n" for k in range(-20, 21))
    bushes = "".join(f"{0.2 * k},{k % 7},0,0.2,0.2,0.2,2,0\n" for k in range(-30, 30))
    scene, mi = tr.load_scene(write_crowns(tmp_path / "s", TREES + fields + bushes)), activate()
    geometry, towards = Geometry(mi, scene.surfaces), direction(35.0, 20.0)
    shadows = CrownShadows(geometry.crowns, towards)
    assert len(shadows.listed) < 2.2e6
    place = np.random.default_rng(1).uniform(-6.0, 6.0, (2000, 3)).astype(np.float32) * [1, 1, 0.1]
    passed = np.array(shadows.passed(mi.Point3f(*map(aligned, place.T))))
    expected = np.exp(-optical_depth(scene.surfaces, place.astype(np.float32).astype(float), place + 2000.0 * towards))
    np.testing.assert_allclose(passed, expected, atol=0.02)
    assert (expected < 0.5).any()


VIEWS = [
    ((0.0, -9.0, 4.0), -20.0), *(((-3.0, 2.0, 2.5), pitch_deg) for pitch_deg in (-90.0, 0.0, 60.0)),
    *(((0.5, 5.0, 0.7), pitch_deg) for pitch_deg in (-40.0, 20.0)), ((1.0, -1.0, 30.0), -90.0), ((0.0, -2.9, 9.0), 5.0),
]  # fmt: skip


@pytest.mark.parametrize(("place", "pitch_deg"), VIEWS)
def test_rays_of_a_view_pass_crowns_by_the_law_of_beer(tmp_path, place, pitch_deg):
    # From beside crowns, in an ellipsoid, in a box, and above all, last over their tops, which the view does not show.
    scene, mi = coarse(tr.load_scene(write_crowns(tmp_path / "s")), 8), activate()
    geometry, pose = Geometry(mi, scene.surfaces), tr.pose(*place, pitch_deg=pitch_deg)
    view, camera = opaque_view(mi, pose), CameraRays(mi, scene.camera)
    tiles = CrownTiles(geometry.crowns, view, camera)
    # A pixel and all of its parts, as those of rays at edges.
    slope = camera.finer(np.arange(camera.order.size), 0, 16).slope
    ray = view_ray(mi, *view, *slope)

    def visit(chord, state):
        return chord.crown >= 0, (state[0] + chord.depth,)

    nothing = dr.zeros(mi.Float, dr.width(slope[0]))
    found = np.array(tiles.walk(tiles.listed(slope), ray, mi.Float(80.0), True, (nothing,), visit)[0])
    start = np.broadcast_to(np.array(ray.o).T, (len(found), 3)).astype(float)
    expected = optical_depth(scene.surfaces, start, start + 80.0 * np.array(ray.d).T)
    np.testing.assert_allclose(np.exp(-found), np.exp(-expected), atol=0.01)
    assert (expected > 0.1).any() == (place[2] != 9.0)


def test_views_show_the_nearer_of_dense_crowns(tmp_path):
    # A hedge of 14 m that leads away from the camera, and balls before its ends, on either side of it.
    far = "east_m,north_m\n2,-6\n-2,-5\n2,3\n-2,5\n"
    folder = tmp_path / "s"
    folder.mkdir()
    (folder / "balls.csv").write_text(far, encoding="utf-8")
    common = {"material": "broadleaf", "leaf_area_1_m": 100.0}
    extra = scene_object("hedge", [2.0, 14.0, 1.0], [0.0, 0.0, 0.0], temperature=280.0, **common)
    extra += scene_object("balls", [2.0, 2.0, 2.0], temperature=320.0, shape="sphere", instances="balls.csv", **common)
    scene = tr.load_scene(write_terrain(folder, extra=extra, sky=300.0, temperature=np.full((32, 32), 300.0)))
    renderer = tr.Renderer(scene, "fast")
    for pose in (tr.pose(6.0, -14.0, 2.0, look_at=(0.0, 0.0, 0.5)), tr.pose(-5.0, 12.0, 3.0, look_at=(0.0, 0.0, 0.5))):
        frame = renderer.frame(pose)
        # The truth comes from flights from hull to hull.
        for number, kelvin in ((1, 280.0), (2, 320.0)):
            shown = cv2.erode((frame.truth["object"] == number).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
            assert shown.sum() > 100
            assert np.abs(frame.apparent_temperature[shown] - kelvin).max() < 4.0


def test_flights_end_where_beers_law_says(tmp_path):
    scene, mi = tr.load_scene(write_crowns(tmp_path / "s")), activate()
    geometry, count = Geometry(mi, scene.surfaces), 20_000
    draw = np.random.default_rng(3)
    # Through the middle of the first tree, 3 m high, downwards: its depth is 0.6 per metre.
    start = np.column_stack([-3.0 + 1e-3 * draw.standard_normal((count, 2))[:, :1], np.full((count, 1), 2.0),
                             np.full((count, 1), 9.0)])  # fmt: skip
    end = start - [0.0, 0.0, 8.9]
    ray, length = rays(mi, start, end)
    flight, _ = geometry.crowns.drawn(ray, mi.Float(length))
    met, height = np.array(flight.met), 9.0 - np.array(flight.distance)
    for level in (3.5, 2.5, 1.5):
        share = (met & (height > level)).mean()
        expected = 1.0 - np.exp(-0.6 * (4.0 - level))
        assert abs(share - expected) < 4.0 * np.sqrt(expected * (1.0 - expected) / count)
    quarter, up = np.array(flight.quarter), np.abs(height - 2.5) > 0.01
    assert (quarter % 2 == (height > 2.5))[met & up].all()
    # The core has 0.5^(1/3) of the width.
    shell = np.abs(height - 2.5) / 1.5 > 0.5 ** (1.0 / 3.0)
    assert ((quarter >= 2) == shell)[met].mean() > 0.995


def test_crowns_in_an_isothermal_enclosure_are_a_blackbody(tmp_path):
    warm = np.full((32, 32), 290.0)
    scene = tr.load_scene(write_crowns(tmp_path / "s", temperature=warm, sky=290.0))
    frame = tr.Renderer(coarse(scene, 8), "fast").frame(tr.pose(0.0, 0.0, 20.0, pitch_deg=-90.0))
    assert (frame.truth["object"] == 1).sum() > 100
    shown = frame.truth["object"] > 0
    np.testing.assert_allclose(frame.apparent_temperature[shown], 290.0, atol=0.01)


def test_form_factors_are_reciprocal(tmp_path):
    scene = tr.load_scene(write_crowns(tmp_path / "s"))
    geometry = Geometry(activate(), scene.surfaces)
    flow = radiosity.trace(geometry, 2048).operator.toarray() * geometry.area[:, None]
    first = geometry.face_start[1]
    # From the terrain as a whole and between patches, whose number of rays is large.
    parts = np.concatenate([[0], np.arange(first, geometry.face_count)])
    there = np.add.reduceat(np.add.reduceat(flow, parts, axis=0), parts, axis=1)
    # A patch is 1024 points, whose number limits what its rays find: the terrain's rays have no such limit.
    area = np.add.reduceat(geometry.area, parts)
    share = np.maximum(there, there.T) / area[:, None]
    error = area[:, None] * np.sqrt(share * np.maximum(1.0 - share, 0.0) / 1024)
    patches = slice(1, None)
    off = (there - there.T)[patches] / np.maximum(np.hypot(error, error.T)[patches], 0.02)
    assert np.abs(off).max() < 4.0 and (np.abs(there - there.T)[patches] < 0.1 * there[patches]).mean() > 0.1
    np.testing.assert_allclose(there[patches, 0].sum(), there[0, patches].sum(), rtol=0.02)


def test_sky_below_a_wide_crown_is_that_of_a_turbid_layer(tmp_path):
    # A box of 400 m is a layer: the diffuse transmittance is 2 E₃(depth) for level ground.
    from scipy.special import expn

    wide = "east_m,north_m,above_ground_m,width_m,length_m,height_m\n0,0,0.5,400,400,2\n"
    folder = write_terrain(tmp_path / "s", extra=scene_object(
        "crop", shape="box", instances="crop.csv", leaf_area_1_m=0.8, material="broadleaf", temperature=290.0
    ))  # fmt: skip
    (folder / "crop.csv").write_text(wide, encoding="utf-8")
    geometry = Geometry(activate(), tr.load_scene(folder).surfaces)
    traced = radiosity.trace(geometry, 512)
    ground = slice(0, geometry.face_start[1])
    sky = traced.sky[ground].sum(axis=1)
    expected = 2.0 * expn(3, 0.5 * 0.8 * 2.0)
    assert sky.mean() == pytest.approx(expected, abs=4.0 * sky.std() / np.sqrt(len(sky)) + 0.002)


CROP = scene_object(
    "crop", shape="box", instances="crop.csv", leaf_area_1_m=0.8, material="broadleaf", temperature="balance"
)


@pytest.fixture(scope="module")
def crop(tmp_path_factory):
    """A solved scene of a crop that is 2 m high and 400 m wide, so that its middle is that of a layer."""
    folder = tmp_path_factory.mktemp("crop") / "s"
    folder.mkdir()
    (folder / "crop.csv").write_text("east_m,north_m,above_ground_m,width_m,length_m,height_m\n0,0,0.5,400,400,2\n")
    write_leaf_tables(folder)
    scene = tr.load_scene(write_balance(folder, extra=WEATHER + CROP))
    return tr.Renderer(scene, "fast")


def test_sun_on_the_leaves_of_a_layer_is_what_it_intercepts(crop, monkeypatch):
    scene, depth = crop.scene, 0.5 * 0.8 * 2.0
    _, elevation = scene.weather.sun(scene.time)
    x = depth / np.sin(np.radians(float(elevation)))
    # The share of leaves in the sun falls by Beer's law from the top; halves of the layer are the halves of a crown.
    edges = np.exp(-x * np.array([1.0, 0.5, 0.0]))
    expected = np.diff(edges) / (0.5 * x)
    found = crop.baked.device.static_outgoing.leaves._means(crop.baked.geometry.crowns)[0]
    # Of both halves the core and the shell have half of the volume.
    np.testing.assert_allclose(found.reshape(2, 2).mean(axis=0), expected, atol=0.01)
    # Those of the heat balance, from other points: cosines of the sun on leaves are half of these shares.
    towards = direction(float(elevation), float(scene.weather.sun(scene.time)[0]))
    for most_rays, points, atol in ((1 << 18, 32, 0.02), (1, 8, 0.03)):
        # Many crowns have fewer points each.
        monkeypatch.setattr("thermorender.render.heat.copies._MOST_RAYS", most_rays)
        copies = Copies(crop.baked.geometry, range(1, 2), 1, lambda at_s: towards)
        assert copies._points == points
        mean, spread = copies._tested(0.0)
        halves = mean.reshape(2, 2, 2).mean(axis=(0, 2))
        np.testing.assert_allclose(halves, 0.5 * expected, atol=atol)
        np.testing.assert_allclose(mean + spread, 0.5, rtol=1e-6)


def test_both_sides_of_leaves_have_one_temperature_and_sunlit_ones_are_warmer(crop):
    leaves = crop.scene.surfaces[1]
    kelvin, warmer = leaves.temperature.reshape(-1)[:8], leaves.scatter_k.reshape(-1)[:8]
    np.testing.assert_array_equal(kelvin[::2], kelvin[1::2])
    assert (warmer > 0.1).all() and warmer[4] > warmer[6]


def test_leaves_in_the_shadow_of_something_solid_are_not_sunlit(tmp_path):
    folder = tmp_path / "s"
    folder.mkdir()
    (folder / "trees.csv").write_text("east_m,north_m,above_ground_m\n-4,0,1\n5,-5,1\n")
    write_leaf_tables(folder)
    trees = scene_object("trees", [2.0, 2.0, 2.0], shape="sphere", instances="trees.csv", leaf_area_1_m=1.0,
                         material="broadleaf", temperature="balance")  # fmt: skip
    # The sun stands 58° high in the south at noon: the shadow at 2 m is 1.9 m north of what is 5 m high.
    plate = scene_object("plate", [6.0, 6.0, 0.2], [-4.0, -1.9, 5.0], 300.0, "granite")
    renderer = tr.Renderer(tr.load_scene(write_balance(folder, extra=WEATHER + trees + plate)), "fast")
    share = renderer.baked.device.static_outgoing.leaves._means(renderer.baked.geometry.crowns)
    assert share[0].max() < 0.02 and share[1].min() > 0.4


def test_excess_of_sunlit_leaves_has_its_mean_over_all_directions(crop):
    mi, leaves = activate(), crop.baked.device.static_outgoing.leaves
    way = np.random.default_rng(1).standard_normal((200_000, 3))
    way /= np.linalg.norm(way, axis=1)[:, None]
    found = np.array(leaves.phase(mi.Vector3f(*map(mi.Float, way.T))))
    assert found.mean() == pytest.approx(1.0, abs=4.0 * found.std() / np.sqrt(len(way)))
    # Against a sum over normals of leaves, seen along the sun and across it.
    towards = np.array([float(axis[0]) for axis in leaves._towards])
    normal = way
    for view in (towards, np.cross(towards, [0.0, 0.0, 1.0]) / np.linalg.norm(np.cross(towards, [0.0, 0.0, 1.0]))):
        seen = np.abs(normal @ view)
        expected = (seen * 2.0 * np.abs(normal @ towards)).sum() / seen.sum()
        one = np.array(leaves.phase(mi.Vector3f(*map(mi.Float, view[:, None]))))[0]
        assert one == pytest.approx(expected, abs=0.01)


def test_leaves_before_the_sky_are_no_background(tmp_path):
    scene = tr.load_scene(write_crowns(tmp_path / "s", sky=230.0))
    frame = tr.Renderer(coarse(scene, 8), "fast").frame(tr.pose(-3.0, -9.0, 2.4))
    crown = frame.truth["object"] == 1
    above = crown & (np.arange(len(crown))[:, None] < len(crown) // 2)
    assert above.sum() > 20
    assert np.isfinite(frame.error_mk[above]).all() and (frame.truth["depth"][above] < 12.0).all()


def test_water_shows_crowns_as_it_shows_solid_bodies(tmp_path):
    # 2 m above a lake: many leaves, which are opaque, against a solid box of their material and temperature.
    shown = []
    for name, more in (("leaves", {"leaf_area_1_m": 60.0}), ("solid", {})):
        roof = scene_object("roof", [14.0, 14.0, 2.0], [0.0, 0.0, 2.0], 310.0, "broadleaf", shape="box", **more)
        folder = write_terrain(tmp_path / name, extra=roof, classes=np.full((32, 32), 1), sky=220.0)
        toml = (folder / "scene.toml").read_text().replace('1 = "grass_green"', '1 = "water_fresnel"')
        (folder / "scene.toml").write_text(toml)
        renderer = tr.Renderer(coarse(tr.load_scene(folder), 8), "fast", rays=1024)
        assert renderer.plan.specular
        frame = renderer.frame(tr.pose(0.0, -14.0, 1.4, pitch_deg=-8.0))
        water = (frame.truth["object"] == 0) & (frame.truth["depth"] < 16.0) & (frame.truth["depth"] > 9.0)
        shown.append(frame.apparent_temperature[water])
    assert shown[0].shape == shown[1].shape and shown[0].size > 100
    assert abs(shown[0].mean() - shown[1].mean()) < 0.1
    # At the edge of its image the box is soft.
    assert np.quantile(np.abs(shown[0] - shown[1]), 0.9) < 0.5
