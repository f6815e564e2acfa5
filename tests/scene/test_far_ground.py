"""Far ground: where it lies, that it closes to the scene without a crack, and what covers it."""

import re

import numpy as np
import pytest
import rasterio
from rasterio import warp
from rasterio.windows import Window

import thermorender as tr
from scenes import WEATHER, narrow, write_mesh, write_raster, write_terrain
from thermorender.errors import ThermorenderError
from thermorender.materials.library import load_library
from thermorender.physics.geodesy import LocalFrame
from thermorender.scene.drape import mixed_classes_on
from thermorender.scene.open_ground import broadband
from thermorender.scene.raster import Grid, grid_of, window_of
from thermorender.scene.surface import UNKNOWN
from thermorender.scene.terrain import read_elevation

# Middle of the terrain of `write_terrain` on its map.
MIDDLE = np.array([500008.0, 5779992.0])
FAR = '[[terrain.far]]\nelevation = "far.tif"\ntemperature = 280.0\n'


def write_far(folder, height, step, name="far.tif", **options):
    """Write a raster around the middle of the terrain."""
    height = np.asarray(height)
    corner = MIDDLE + 0.5 * step * np.array([-height.shape[1], height.shape[0]])
    return write_raster(folder / name, height[None], step, corner=tuple(corner), **options)


def far_scene(folder, far_m=0.0, step=40.0, posts=61, near=None, table=FAR, extra=""):
    """A scene of 16 m (or of `near` heights) amid far ground of heights `far_m`, and its folder."""
    write_terrain(folder, height=near, extra=table + 'classes = "far_classes.tif"\n' + extra)
    height = np.broadcast_to(np.float32(far_m), (posts, posts))
    write_far(folder, height, step)
    write_far(folder, np.where(np.arange(posts) % 2, 1, 2)[None].repeat(posts, 0).astype(np.uint8), step,
              "far_classes.tif")  # fmt: skip
    return tr.load_scene(folder)


def open_edges(surfaces):
    """Edges (n, 2, 3) that belong to a single triangle of all surfaces, whose corners are merged by position."""
    corner = np.concatenate([each.vertices[each.faces] for each in surfaces])
    _, number = np.unique(np.round(corner.reshape(-1, 3), 4), axis=0, return_inverse=True)
    face = number.reshape(-1, 3)
    edge = np.sort(np.concatenate([face[:, [0, 1]], face[:, [1, 2]], face[:, [2, 0]]]), axis=1)
    place = np.concatenate([corner[:, [0, 1]], corner[:, [1, 2]], corner[:, [2, 0]]])
    _, first, count = np.unique(edge, axis=0, return_index=True, return_counts=True)
    return place[first[count == 1]]


@pytest.mark.parametrize(("shape", "step", "posts"), [((16, 16), 40.0, 61), ((9, 23), 40.0, 61), ((20, 20), 1.0, 80)])
def test_the_mesh_is_closed_from_the_middle_to_the_outer_edge(tmp_path, shape, step, posts):
    near = np.random.default_rng(1).uniform(0.0, 3.0, shape)
    scene = far_scene(tmp_path, 1.0, step, posts, near=near)
    left = open_edges(scene.surfaces)
    assert np.abs(left[..., :2]).max(axis=(1, 2)).min() > 0.4 * step * posts
    normal = np.concatenate([np.cross(*np.diff(each.vertices[each.faces], axis=1).transpose(1, 0, 2))
                             for each in scene.surfaces])  # fmt: skip
    assert (normal[:, 2] > 0.0).all()


def test_each_place_in_the_plan_has_one_ground(tmp_path):
    scene = far_scene(tmp_path, 1.0)
    across = [np.cross(*np.diff(each.vertices[each.faces], axis=1).transpose(1, 0, 2)) for each in scene.surfaces]
    area = [0.5 * each[:, 2].sum() for each in across]
    # 60 cells of 40 m on the map, whose scale is 0.9996.
    assert sum(area) == pytest.approx((60 * 40.0 / 0.9996) ** 2, rel=1e-6)


def test_gaps_in_the_scene_are_closed_by_far_ground(tmp_path):
    near = np.zeros((200, 200))
    near[60:140, 60:140] = np.nan
    near[:30, :50] = np.nan
    write_terrain(tmp_path, height=near, texel=1.0, extra=FAR + 'classes = "far_classes.tif"\n')
    write_far(tmp_path, np.ones((81, 81), np.uint8), 10.0, "far_classes.tif")
    write_far(tmp_path, np.zeros((81, 81), np.float32), 10.0)
    scene = tr.load_scene(tmp_path)
    assert np.abs(open_edges(scene.surfaces)[..., :2]).max(axis=(1, 2)).min() > 300.0


def test_rings_close_around_one_another(tmp_path):
    classes = 'classes = "far_classes.tif"\n'
    write_terrain(tmp_path, extra=FAR + classes + FAR.replace("far.tif", "outer.tif") + classes)
    write_far(tmp_path, np.ones((41, 41), np.uint8), 200.0, "far_classes.tif")
    write_far(tmp_path, np.full((31, 31), 2.0, np.float32), 20.0)
    write_far(tmp_path, np.full((41, 41), 5.0, np.float32), 200.0, "outer.tif")
    scene = tr.load_scene(tmp_path)
    assert [each.name for each in scene.surfaces] == ["terrain", "far 1", "far 2"]
    assert np.abs(open_edges(scene.surfaces)[..., :2]).max(axis=(1, 2)).min() > 3000.0
    level = lambda east: scene.ground(east, 0.0) + east**2 * 0.5 / 7.323e6  # noqa: E731
    assert [level(east) for east in (0.0, 200.0, 2000.0)] == pytest.approx([0.0, 2.0, 5.0], abs=0.02)


def test_far_ground_in_degrees_closes_where_they_are_four_times_as_high_as_wide(tmp_path):
    """75° north, around a scene with a ragged edge: sides of its rim differ fourfold on the lattice of far posts."""
    near = np.random.default_rng(3).uniform(0.0, 3.0, (40, 40))
    near[np.random.default_rng(4).uniform(size=near.shape) < 0.1] = np.nan
    table = FAR.replace("far.tif", "degrees.tif") + 'classes = "classes_far.tif"\n'
    write_terrain(tmp_path, height=near, extra=table)
    corner = 500000.0, 8325000.0
    for name in ("elevation", "orthophoto", "temperature", "classes"):
        with rasterio.open(tmp_path / f"{name}.tif", "r+") as file:
            step = file.transform.a
            file.transform = rasterio.Affine(step, 0.0, corner[0], 0.0, -step, corner[1])
    (longitude,), (latitude,) = warp.transform("EPSG:32634", "EPSG:4326", [corner[0] + 20.0], [corner[1] - 20.0])
    step = 3.0 / 3600.0
    place = {"crs": "EPSG:4326", "corner": (longitude - 30.0 * step, latitude + 30.0 * step)}
    write_raster(tmp_path / "degrees.tif", np.ones((1, 60, 60), np.float32), step, **place)
    write_raster(tmp_path / "classes_far.tif", np.ones((1, 60, 60), np.uint8), step, **place)
    scene = tr.load_scene(tmp_path)
    assert np.abs(open_edges(scene.surfaces)[..., :2]).max(axis=(1, 2)).min() > 600.0


def test_gaps_of_a_ring_are_closed_by_the_next_one(tmp_path):
    classes = 'classes = "far_classes.tif"\n'
    write_terrain(tmp_path, extra=FAR + classes + FAR.replace("far.tif", "outer.tif") + classes)
    write_far(tmp_path, np.ones((41, 41), np.uint8), 200.0, "far_classes.tif")
    write_far(tmp_path, np.zeros((41, 41), np.float32), 100.0, "outer.tif")
    rng = np.random.default_rng(5)
    for _ in range(4):
        ring = rng.uniform(0.0, 30.0, (41, 41)).astype(np.float32)
        ring[rng.uniform(size=ring.shape) < 0.1] = np.nan
        write_far(tmp_path, ring, 10.0, nodata=np.nan)
        scene = tr.load_scene(tmp_path)
        assert np.abs(open_edges(scene.surfaces)[..., :2]).max(axis=(1, 2)).min() > 1900.0


def test_a_mesh_is_closed_by_far_ground(tmp_path):
    import trimesh

    side = np.linspace(-30.0, 30.0, 31)
    east, north = np.meshgrid(side, side)
    up = 2.0 + np.sin(east / 7.0)
    index = np.arange(31 * 31).reshape(31, 31)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    faces = np.concatenate([np.stack(each, -1).reshape(-1, 3) for each in ((a, b, d), (a, d, c))])
    mesh = trimesh.Trimesh(np.stack([east, north, up], -1).reshape(-1, 3), faces, process=False)
    place = LocalFrame(52.17, 21.0, 0.0)
    write_mesh(tmp_path, mesh, extra=f"[frame]\nlatitude_deg = {place.latitude_deg}\nlongitude_deg = "
               f"{place.longitude_deg}\nheight_m = 0.0\n" + FAR)  # fmt: skip
    write_far(tmp_path, np.zeros((61, 61), np.float32), 40.0)
    scene = tr.load_scene(tmp_path)
    # Every ray down meets ground, which is continuous within the slope of the rim to the next post.
    east, north = np.meshgrid(np.linspace(-60.0, 60.0, 241), np.linspace(-60.0, 60.0, 241))
    found = scene.ground(east, north)
    assert np.isfinite(found).all()
    assert np.abs(np.diff(found, axis=0)).max() < 0.3


def test_far_ground_falls_with_the_refracted_earth_and_background_meets_its_horizon(tmp_path):
    scene = far_scene(tmp_path, 100.0, step=1000.0, posts=121, near=np.full((16, 16), 100.0))
    far = scene.surfaces[1]
    east, north, up = far.vertices.T
    there = np.hypot(east, north) > 5000.0
    # Sphere of the Earth's radius over 0.87; the ellipsoid's own radii differ from the mean by 0.5 %.
    np.testing.assert_allclose(up[there], -(east**2 + north**2)[there] * 0.87 / (2.0 * 6.371e6), rtol=8e-3, atol=0.05)
    camera = narrow(scene).with_air("midlatitude-summer")
    renderer = tr.Renderer(camera, rays=2, samples=1)
    # The horizon of 300 m is 66 km away; the ground ends within a row of where the sky begins.
    frame = renderer.frame(camera.pose(0.0, 0.0, 300.0, pitch_deg=0.0))
    shown = np.isfinite(frame.truth["depth"])
    assert (shown | renderer.sky(frame.pose)).mean() > 1.0 - 1.5 / 128.0


def test_old_scenes_are_the_same_beside_far_ground(tmp_path):
    near = np.random.default_rng(2).uniform(0.0, 2.0, (32, 32))
    alone = write_terrain(tmp_path / "alone", height=near)
    with_far = far_scene(tmp_path / "far", 1.0, near=near)
    alone = tr.load_scene(alone)
    assert np.array_equal(alone.surfaces[0].vertices, with_far.surfaces[0].vertices)
    assert with_far.surroundings_temperature == alone.surroundings_temperature
    assert [each.name for each in with_far.near_ground] == ["terrain"]
    renderers = tr.Renderer(alone), tr.Renderer(with_far)
    assert renderers[0].baked.geometry.hair == renderers[1].baked.geometry.hair
    faces = [each.baked.errors_mk["faces"] for each in renderers]
    assert faces[1] == pytest.approx(faces[0], rel=0.5)


def test_offsets_of_points_grow_with_their_distance_on_far_ground_only(tmp_path):
    geometry = tr.Renderer(far_scene(tmp_path, 0.0, step=400.0, posts=251)).baked.geometry
    points = np.array([[1.0, 2.0, 3.0], [20000.0, 5.0, 0.0]], np.float32)
    numpy = geometry.hair_at(points).ravel()
    jit = np.array(geometry.lift(geometry.mi.Point3f(points.T)))
    np.testing.assert_allclose(numpy, jit, rtol=1e-6)
    assert numpy[0] == np.float32(geometry.hair) < 1e-4
    assert numpy[1] == pytest.approx(64 * 2.0**-24 * 20001.0, rel=1e-5)


def test_heights_on_far_ground_are_those_above_the_ellipsoid(tmp_path):
    """The air, the sky and the lapse of 6.5 K/km take them; the ground is at 0 m everywhere."""
    scene = far_scene(tmp_path, 0.0, step=1000.0, posts=81)
    far = scene.surfaces[1]
    geometry = tr.Renderer(scene).baked.geometry
    for found in (far.heights_m(), geometry.heights_m(far.vertices)):
        # The ellipsoid's radii differ from the Earth's mean by up to 0.5 %: 1.3 m at 57 km, 8 mK of the air there.
        assert np.abs(found).max() * 6.5e-3 < 0.01
    assert geometry.low_m > -1.5


def test_a_thinned_window_has_the_means_of_known_heights(tmp_path):
    values = np.random.default_rng(8).uniform(0.0, 100.0, (1, 64, 64)).astype(np.float32)
    values[0, :3, :3] = -9999.0
    path = write_raster(tmp_path / "h.tif", values, 1.0, nodata=-9999.0)
    bounds = (500000.0, 5779936.0, 500064.0, 5780000.0)
    window = window_of(path, grid_of(path).crs, bounds, 256)
    found, grid = read_elevation(path, window)
    assert found.shape == (16, 16) and grid.transform.a == 4.0 and grid.bounds == bounds
    known = np.where(values[0] == -9999.0, np.nan, values[0])
    np.testing.assert_allclose(found, np.nanmean(known.reshape(16, 4, 16, 4), axis=(1, 3)), rtol=1e-5)


def test_coarse_texels_have_the_shares_of_classes_of_a_finer_raster(tmp_path):
    fine = np.zeros((64, 64), np.uint8)
    fine[:, :32], fine[:, 32:] = 1, 2
    fine[::2, 32:] = 3
    fine[:8, :8] = 0
    write_raster(tmp_path / "fine.tif", fine[None], 10.0)
    own = grid_of(tmp_path / "fine.tif")
    coarse = Grid(own.crs, own.transform @ own.transform.scale(8.0), 8, 8)
    names = {1: "grass_green", 2: "sand_quartz", 3: "asphalt"}
    number, mixed = mixed_classes_on(tmp_path / "fine.tif", names, coarse, "scene.toml")
    assert number[0, 0] == 0 and number[0, 1] > 0
    assert mixed[number[4, 0] - 1] == {1: 1.0} and mixed[number[4, 7] - 1] == {2: 0.5, 3: 0.5}
    # Many mixtures are joined, and the ground keeps its shares of classes.
    many = np.random.default_rng(6).integers(1, 10, (64, 64)).astype(np.uint8)
    write_raster(tmp_path / "many.tif", many[None], 10.0)
    two = Grid(own.crs, own.transform @ own.transform.scale(2.0), 32, 32)
    number, mixed = mixed_classes_on(tmp_path / "many.tif", dict.fromkeys(range(1, 10), "asphalt"), two, "scene.toml")
    assert 40 < len(mixed) <= 48 and all(sum(each.values()) == pytest.approx(1.0) for each in mixed)
    found = [np.mean([mixed[k - 1].get(one, 0.0) for k in number.ravel()]) for one in range(1, 10)]
    np.testing.assert_allclose(found, np.bincount(many.ravel(), minlength=10)[1:] / many.size, atol=0.01)
    same, none = mixed_classes_on(tmp_path / "fine.tif", names, own, "scene.toml")
    assert none == () and np.array_equal(same, fine)


@pytest.mark.slow
def test_the_balance_of_mixed_far_texels_is_the_mean_of_their_parts(tmp_path):
    source = '[temperature]\nsource = "balance"\n'
    for name, classes in (("mixed", None), ("grass", 1), ("sand", 2)):
        folder = tmp_path / name
        far_scene(folder)
        text = (folder / "scene.toml").read_text().replace("temperature = 280.0\n", "")
        text = re.sub(r'\[temperature\]\nsource = "raster"\nraster = "temperature.tif"\n', source, text)
        (folder / "scene.toml").write_text(text.replace('[truth]\ntemperature = "temperature.tif"\n', WEATHER))
        fine = (
            np.where(np.indices((3000, 3000)).sum(axis=0) % 2, 1, 2)
            if classes is None
            else np.full((300, 300), classes)
        )
        write_far(folder, fine.astype(np.uint8), 2440.0 / len(fine), "far_classes.tif")
    kelvin = {}
    for name in ("mixed", "grass", "sand"):
        scene = tr.Renderer(tr.load_scene(tmp_path / name)).scene
        far = scene.surfaces[1]
        kelvin[name] = float(np.median(far.temperature))
        if name == "mixed":
            mixed = [each for each in scene.materials if hasattr(each, "parts")]
            assert [{part.name: share for part, share in each.parts} for each in mixed] == [
                {"grass_green": 0.5, "sand_quartz": 0.5}
            ]
    # Emissions add up; the light of other ground around differs a little.
    emits = np.array([broadband(part) for part in (load_library()[name] for name in ("grass_green", "sand_quartz"))])
    mean = (emits @ np.array([kelvin["grass"], kelvin["sand"]]) ** 4 / emits.sum()) ** 0.25
    assert kelvin["mixed"] == pytest.approx(mean, abs=0.1)
    assert abs(kelvin["grass"] - kelvin["sand"]) > 3.0


def test_a_raster_of_temperatures_needs_those_of_far_ground(tmp_path):
    with pytest.raises(ThermorenderError, match=r"terrain\.far\.temperature"):
        far_scene(tmp_path, table=FAR.replace("temperature = 280.0\n", ""))


def test_far_ground_elsewhere_and_finer_than_the_scene_is_refused(tmp_path):
    write_terrain(tmp_path, extra=FAR)
    write_raster(tmp_path / "far.tif", np.zeros((1, 20, 20), np.float32), 100.0, corner=(600000.0, 5780000.0))
    with pytest.raises(ThermorenderError, match="does not surround the ground inside of it: 100%"):
        tr.load_scene(tmp_path)
    # Beside the scene there is no ground on one side.
    write_raster(tmp_path / "far.tif", np.zeros((1, 20, 20), np.float32), 10.0, corner=(500004.0, 5780100.0))
    with pytest.raises(ThermorenderError, match="give a wider raster, and several of them from the inner to the outer"):
        tr.load_scene(tmp_path)
    write_far(tmp_path, np.zeros((200, 200), np.float32), 0.4)
    with pytest.raises(ThermorenderError, match=r"0\.4 m apart"):
        tr.load_scene(tmp_path)


def test_statements_on_far_ground_are_used_or_refused(tmp_path):
    far_scene(tmp_path)
    text = (tmp_path / "scene.toml").read_text()
    raster = 'source = "raster"\nraster = "temperature.tif"\n'
    cases = {
        text.replace(raster, 'source = "balance"\n').replace('[truth]\ntemperature = "temperature.tif"\n', WEATHER):
            "terrain.far.temperature is given, and temperature.source='balance' solves far ground too; leave it out",
        text.replace("temperature = 280.0", 'temperature = 280.0\nheight_reference = "geoid"'):
            "far ground are above the geoid, and those of the scene above the ellipsoid; give geoid_undulation_m",
    }  # fmt: skip
    for content, said in cases.items():
        (tmp_path / "scene.toml").write_text(content)
        with pytest.raises(ThermorenderError) as error:
            tr.load_scene(tmp_path)
        assert said in str(error.value)
    (tmp_path / "scene.toml").write_text(
        text.replace("temperature = 280.0", 'temperature = 280.0\nheight_reference = "geoid"').replace(
            'orthophoto = "orthophoto.tif"', 'orthophoto = "orthophoto.tif"\ngeoid_undulation_m = 30.0'
        )
    )
    assert tr.load_scene(tmp_path).ground(500.0, 0.0) == pytest.approx(30.0 - 0.02, abs=0.01)
    write_far(tmp_path, np.ones((20, 20), np.uint8), 40.0, "far_classes.tif")
    (tmp_path / "scene.toml").write_text(text)
    with pytest.raises(ThermorenderError, match=r"covers 1[0-9]% of the ground of"):
        tr.load_scene(tmp_path)


def test_posts_of_kilometres_around_a_scene_of_metres_take_seconds(tmp_path):
    scene = far_scene(tmp_path, 1.0, step=9000.0, posts=9)
    assert np.abs(open_edges(scene.surfaces)[..., :2]).max(axis=(1, 2)).min() > 30_000.0
    assert len(scene.surfaces[1].faces) < 20_000


def test_a_learned_emissivity_map_leaves_coarse_far_ground_to_the_fallback(tmp_path):
    far_scene(tmp_path)
    text = (tmp_path / "scene.toml").read_text()
    learned = '[emissivity]\nsource = "learned"\nmodel = "procedural"\nfallback = "soil_loam"\n'
    a, b = text.index("[emissivity]"), text.index("[sky]")
    text = text[:a] + learned + text[b:].replace('classes = "far_classes.tif"', 'orthophoto = "picture.tif"')
    write_raster(tmp_path / "picture.tif", np.full((3, 61, 61), 90, np.uint8), 40.0,
                 corner=tuple(MIDDLE + 1220.0 * np.array([-1.0, 1.0])), photometric="RGB")  # fmt: skip
    (tmp_path / "scene.toml").write_text(text)
    far = tr.load_scene(tmp_path).surfaces[1]
    assert (far.flags & UNKNOWN).all() and len(np.unique(far.material)) == 1 and (far.colour == 90).all()


def test_an_area_paints_the_scene_and_not_far_ground(tmp_path):
    scene = far_scene(tmp_path)
    painted = scene.with_material_in([(-4, -4), (4, -4), (4, 4), (-4, 4)], "asphalt")
    assert np.array_equal(painted.surfaces[1].material, scene.surfaces[1].material)
    assert not np.array_equal(painted.surfaces[0].material, scene.surfaces[0].material)
    # Numbers of texels go on over far ground, which has the colours of its materials without an orthophoto.
    first = scene.surfaces[0].material.size
    far, other = scene.with_material_at([first + 5], "asphalt"), scene.surfaces[1]
    assert np.flatnonzero(far.surfaces[1].material != other.material).tolist() == [5]
    assert tuple(far.surfaces[1].colour.reshape(-1, 3)[5]) == tuple(far.materials[-1].colour)
    assert np.array_equal(far.surfaces[0].colour, scene.surfaces[0].colour)


def test_an_import_puts_a_wider_model_around_the_scene(tmp_path, call):
    near = write_terrain(tmp_path / "near", height=np.full((16, 16), 20.0))
    write_far(tmp_path, np.full((50, 50), 21.0, np.float32), 30.0, "wide.tif")
    colour = np.full((3, 100, 100), 90, np.uint8)
    write_raster(tmp_path / "picture.tif", colour, 15.0, corner=(499258.0, 5780742.0), photometric="RGB")
    write_far(tmp_path, np.full((60, 60), 60.0, np.float32), 200.0, "wider.tif")
    status, said, _ = call(
        "import-terrain", near / "elevation.tif", near / "orthophoto.tif", "-o", tmp_path / "mine",
        "--far", f"{tmp_path}/wide.tif,{tmp_path}/picture.tif", "--far", tmp_path / "wider.tif",
    )  # fmt: skip
    assert status == 0 and "far ground 1: 50×50 posts of 30 m, with an orthophoto" in said
    assert "far ground 2: 60×60 posts of 200 m, with the material of unknown texels" in said
    # The second model is 40 m higher than the scene, the first within what two surveys differ by.
    assert "wider.tif lies 40 m above the ground of the scene" in said and "wide.tif lies" not in said
    scene = tr.load_scene(tmp_path / "mine")
    assert [each.name for each in scene.surfaces] == ["terrain", "far 1", "far 2"]
    assert (scene.surfaces[1].colour == 90).mean() > 0.99
    assert (scene.surfaces[2].temperature == 288.15).all()
    status, _, errors = call(
        "import-terrain", near / "elevation.tif", "-o", tmp_path / "wrong", "--far", tmp_path / "wider.tif", "--far",
        tmp_path / "wide.tif",
    )  # fmt: skip
    assert status == 2 and "far_2_elevation.tif does not surround" in errors and not (tmp_path / "wrong").exists()


def test_classes_of_far_ground_are_used_or_refused(tmp_path):
    table = FAR + 'classes = "far_classes.tif"\n'
    far_scene(tmp_path)
    text = (tmp_path / "scene.toml").read_text()
    constant = text.replace('source = "classes"\nraster = "classes.tif"\n', 'source = "constant"\nvalue = 0.95\n')
    (tmp_path / "scene.toml").write_text(constant)
    with pytest.raises(ThermorenderError, match=r"terrain\.far\.classes is given, and emissivity\.source='constant'"):
        tr.load_scene(tmp_path)
    (tmp_path / "scene.toml").write_text(text.replace(table, table.replace("far_classes", "none")))
    with pytest.raises(ThermorenderError, match=r"none\.tif' does not exist"):
        tr.load_scene(tmp_path)


def test_a_square_of_a_file_of_any_size_is_imported(tmp_path, call):
    """Of rasters of 3.6 and 14.4 thousand million pixels, and with the same values as of files of the square alone."""
    corner, sides = (470000.0, 5810000.0), {"heights": (60_000, 1.0, 1), "colours": (120_000, 0.5, 3)}
    rng = np.random.default_rng(4)
    for name, (side, step, bands) in sides.items():
        count = round(400 / step)
        values = rng.uniform(20, 200, (bands, count, count)).astype(np.float32 if bands == 1 else np.uint8)
        middle = side // 2 - count // 2
        here = corner[0] + middle * step, corner[1] - middle * step
        options = {"photometric": "RGB"} if bands == 3 else {"nodata": -9999.0}
        write_raster(tmp_path / f"{name}_alone.tif", values, step, corner=here, **options)
        with rasterio.open(
            tmp_path / f"{name}.tif", "w", driver="GTiff", width=side, height=side, count=bands, dtype=values.dtype,
            crs="EPSG:32634", transform=rasterio.Affine(step, 0.0, corner[0], 0.0, -step, corner[1]), tiled=True,
            blockxsize=512, blockysize=512, SPARSE_OK=True, BIGTIFF="YES", compress="deflate", **options,
        ) as file:  # fmt: skip
            file.write(values, window=Window(middle, middle, count, count))
    for name in ("", "_alone"):
        files = tmp_path / f"heights{name}.tif", tmp_path / f"colours{name}.tif"
        around = "52.17048216,21.0,300"
        status, _, errors = call("import-terrain", *files, "--around", around, "-o", tmp_path / f"mine{name}")
        assert status == 0, errors
    for name in ("elevation", "orthophoto"):
        found = []
        for folder in ("mine", "mine_alone"):
            with rasterio.open(tmp_path / folder / f"{name}.tif") as file:
                found.append((file.read(), file.transform))
        assert found[0][0].shape[1] >= 299 and np.array_equal(found[0][0], found[1][0])
        assert found[0][1].almost_equals(found[1][1], 1e-6)
    for around, said in (
        ("52,21", "3 are needed: LATITUDE,LONGITUDE,SIDE"), ("52,21,0", "is not allowed"), ("10,21,300", "not reach")
    ):  # fmt: skip
        status, _, errors = call("import-terrain", *files, "--around", around, "-o", tmp_path / "none")
        assert status == 2 and said in errors and not (tmp_path / "none").exists()
