"""The renderer against closed forms: enclosures, planes, view factors, geometry and filtering."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from support import slow

import thermorender as tr
from scenes import narrow, scene_object, write_mesh, write_terrain
from thermorender.apps.compare.sampling_error import converged, rms_mk
from thermorender.errors import ThermorenderError
from thermorender.physics.band import emitted_radiance
from thermorender.physics.planck import band_radiance, brightness_temperature
from thermorender.render.geometry import Geometry
from thermorender.render.light import radiosity
from thermorender.render.pixels.sampling import edge_step, morton_order
from thermorender.render.pixels.shapes import positions
from thermorender.render.plan import make_plan
from thermorender.render.quality import Sampling
from thermorender.render.variant import activate
from thermorender.scene.surface import BACKGROUND, FILLED, SURFACE

BAND = (7.5, 13.5)
# Error of arithmetic alone: single precision of a sum of nodes (2⁻²⁴ of 300 K and some ten roundings: 0.2 mK),
# and the tables of black bodies (45 µK). [K]
ARITHMETIC_K = 1e-3
DOWN = {"pitch_deg": -90.0}


def box(inside):
    mesh = trimesh.creation.box(extents=(4, 4, 4)).subdivide().subdivide()
    if inside:
        mesh.invert()
    return mesh


def square(side=10.0, up=0.0):
    h = side / 2
    return trimesh.Trimesh([[-h, -h, up], [h, -h, up], [h, h, up], [-h, h, up]], [[0, 1, 2], [0, 2, 3]])


@pytest.mark.parametrize("emissivity", [1.0, 0.5, *slow(0.9, 0.05), 0.001])
def test_isothermal_enclosure_reads_the_wall(tmp_path, emissivity):
    # Through any leak the sky would be seen at 0 K.
    scene = tr.load_scene(write_mesh(tmp_path / "s", box(True), 300.0, emissivity, sky=0.0))
    frame = tr.Renderer(scene, rays=64, tolerance_mk=0.5).frame(np.eye(4))
    assert np.abs(frame.apparent_temperature - 300.0).max() < ARITHMETIC_K


@pytest.mark.parametrize("emissivity", [0.5, *slow(1.0, 0.9)])
def test_flat_plane_under_an_isotropic_sky(tmp_path, emissivity):
    scene = tr.load_scene(write_mesh(tmp_path / "s", square(40.0), 300.0, emissivity, sky=250.0))
    frame = tr.Renderer(scene, rays=64, tolerance_mk=0.5).frame(tr.pose(0, 0, 5, **DOWN))
    radiance = emissivity * band_radiance(300.0, *BAND) + (1 - emissivity) * band_radiance(250.0, *BAND)
    assert np.abs(frame.apparent_temperature - brightness_temperature(radiance, *BAND)).max() < ARITHMETIC_K


def test_measured_material_on_a_plane(tmp_path):
    # Quartz sand's reststrahlen bands: the sum over wavelengths, not the product of band means.
    scene = tr.load_scene(
        write_terrain(tmp_path / "s", temperature=np.full((32, 32), 305.0), classes=np.full((32, 32), 2), sky=255.0)
    )
    sand = scene.materials[scene.surfaces[0].material[0, 0]]
    assert sand.name == "sand_quartz"
    from scipy.integrate import quad

    from thermorender.physics.planck import spectral_radiance

    def leaving(x):
        epsilon = float(sand.emissivity_at(x))
        return epsilon * float(spectral_radiance(x, 305.0)) + (1 - epsilon) * float(spectral_radiance(x, 255.0))

    knots = sand.wavelength_um[(sand.wavelength_um > BAND[0]) & (sand.wavelength_um < BAND[1])]
    edges = [BAND[0], *knots, BAND[1]]
    exact = sum(quad(leaving, a, b)[0] for a, b in zip(edges[:-1], edges[1:], strict=True))
    frame = tr.Renderer(scene, rays=8, tolerance_mk=0.5).frame(tr.pose(0, 0, 5, **DOWN))
    error = float(frame.apparent_temperature[256, 320]) - brightness_temperature(exact, *BAND)
    assert abs(error) < 0.5e-3 + ARITHMETIC_K


def view_factor_of_parallel_squares(ratio):
    """Identical directly opposed squares of side/distance `ratio` (Howell, catalogue of view factors, C-11)."""
    x = ratio
    one = 1 + x**2
    edges = 2 * x * np.sqrt(one) * np.arctan(x / np.sqrt(one)) - 2 * x * np.arctan(x)
    return 2 / (np.pi * x**2) * (np.log(np.sqrt(one**2 / (1 + 2 * x**2))) + edges)


# Two large faces show that rays start all over a face, many small ones that faces are distinguished.
@pytest.mark.parametrize(("subdivisions", "rays"), [(0, 16384), (2, 1024)])
def test_transport_against_the_view_factor_of_parallel_squares(tmp_path, subdivisions, rays):
    lower, upper = square(2.0), square(2.0, up=2.0)
    upper.invert()
    pair = trimesh.util.concatenate([lower, upper])
    for _ in range(subdivisions):
        pair = pair.subdivide()
    scene = tr.load_scene(write_mesh(tmp_path / "s", pair))
    transport = radiosity.trace(Geometry(activate(), scene.surfaces), rays)
    up = scene.surfaces[0].vertices[scene.surfaces[0].faces].mean(axis=1)[:, 2] > 1.0
    seen = np.asarray(transport.operator[~up][:, up].sum()) / (~up).sum()
    exact = view_factor_of_parallel_squares(1.0)
    assert exact == pytest.approx(0.1998, abs=1e-4)
    # Independent rays would have this error (one standard error); stratified ones have less.
    standard_error = np.sqrt(exact * (1 - exact) / (rays * (~up).sum()))
    assert abs(seen - exact) < 4 * standard_error
    sums = np.asarray(transport.operator.sum(axis=1)).ravel() + transport.sky.sum(axis=1) + transport.background
    np.testing.assert_allclose(sums, 1.0, atol=1e-9)


def test_neighbouring_faces_cast_different_rays(tmp_path):
    # One ray each: parallel rays from the floor of a room would hit its ceiling and two walls at most.
    scene = tr.load_scene(write_mesh(tmp_path / "s", box(True)))
    transport = radiosity.trace(Geometry(activate(), scene.surfaces), 1)
    middle = scene.surfaces[0].vertices[scene.surfaces[0].faces].mean(axis=1)
    side = np.argmax(np.abs(middle), axis=1) + 3 * (middle.max(axis=1) > 1.99)
    floor = np.isclose(middle[:, 2], -2.0)
    assert len(set(side[transport.operator[floor].indices])) == 5


def test_occluded_directions_return_solved_radiance(tmp_path):
    # A grey floor close under a warm black ceiling reflects the ceiling, not black and not the sky.
    floor, ceiling = square(40.0).subdivide().subdivide(), square(40.0, up=1.0)
    floor_scene = write_mesh(
        tmp_path / "s",
        floor,
        280.0,
        0.5,
        sky=200.0,
        extra=scene_object("roof", file="roof.ply", position=[0, 0, 1.0], material="soot"),
    )
    ceiling.apply_translation([0, 0, -1.0])
    ceiling.invert()
    ceiling.export(floor_scene / "roof.ply")
    materials = floor_scene / "materials"
    (materials / "spectra").mkdir(parents=True)
    (materials / "index.csv").write_text(
        "name,title,colour_r,colour_g,colour_b,solar_absorptance,directional,temperature_k,samples,source,citation,licence,note\n"
        "soot,Black soot,10,10,10,0.99,lambertian,300,1,test,test,test,test\n"
    )
    (materials / "spectra" / "soot.csv").write_text("wavelength_um,emissivity,emissivity_std\n7,1,0\n14,1,0\n")
    rays = 1024
    frame = tr.Renderer(tr.load_scene(floor_scene), rays=rays, tolerance_mk=0.5).frame(tr.pose(0, 0, 0.5, **DOWN))
    # From the middle the ceiling, 40 m wide 1 m above, fills 4/π · a arctan(a) of the view, a = 20/√(1+20²) (Howell,
    # B-4, four times), and 0.0028 less from the far corner of a face of 10 m; the rest is sky of 200 K.
    own, roof, sky = (band_radiance(kelvin, *BAND) for kelvin in (280.0, 330.0, 200.0))
    a = 20.0 / np.sqrt(1.0 + 20.0**2)
    middle = 4.0 / np.pi * a * np.arctan(a)
    error = np.sqrt(middle * (1.0 - middle) / rays)
    low, high = (0.5 * own + 0.5 * (share * roof + (1.0 - share) * sky) for share in (middle - 0.0028, middle))
    seen = frame.radiance[200:300, 250:390].mean()
    assert middle == pytest.approx(0.9980, abs=1e-4)
    assert low - 3.0 * error * 0.5 * (roof - sky) < seen < high + 3.0 * error * 0.5 * (roof - sky)
    # Black or sky in the ceiling's place would be clearly wrong.
    assert low > 1.3 * own and low - (0.5 * own + 0.5 * sky) > 20.0 * error * roof


def test_the_plan_leaves_out_steps_that_black_scenes_do_not_need(tmp_path, monkeypatch):
    scene = tr.load_scene(write_mesh(tmp_path / "s", square(), 300.0, 1.0))
    monkeypatch.setattr(radiosity, "trace", lambda *_: pytest.fail("a black scene traced light between surfaces"))
    renderer = tr.Renderer(scene)
    assert not renderer.plan.bake and renderer.plan.as_dict()["bake_rays"] == 0
    frame = renderer.frame(tr.pose(0, 0, 5, **DOWN))
    assert np.abs(frame.apparent_temperature - 300.0).max() < ARITHMETIC_K
    grey = tr.load_scene(write_mesh(tmp_path / "g", square(), 300.0, 0.9))
    assert make_plan(grey).bake and make_plan(grey).nodes == 1


@pytest.mark.parametrize("seed", range(4))
def test_reflected_light_is_below_the_plans_upper_bound(tmp_path, seed):
    random = np.random.default_rng(seed)
    height, warm = random.uniform(0.0, 4.0, (12, 12)), random.uniform(260.0, random.uniform(280.0, 400.0), (24, 24))
    folder = write_terrain(tmp_path / "s", height=height, temperature=warm, sky=random.uniform(200.0, 300.0))
    emissivity = random.uniform(0.1, 0.9, 2)
    scene = tr.load_scene(folder).with_material({1: emissivity[0], 2: emissivity[1]})
    renderer = tr.Renderer(scene, rays=256)
    reflected = (1.0 - emissivity.min()) * renderer.baked.incident.sum(axis=1) / renderer.plan.radiance_per_mk
    assert 0.3 * renderer.plan.reflection_mk < reflected.max() < renderer.plan.reflection_mk


def test_plan_gives_quartz_the_nodes_it_needs(tmp_path):
    scene = tr.load_scene(write_terrain(tmp_path / "s"))
    plan = make_plan(scene, Sampling.of(tolerance_mk=2.0))
    assert plan.nodes > 1 and plan.spectrum.nodes_mk <= 2.0
    loose = make_plan(scene, Sampling.of(tolerance_mk=500.0))
    assert loose.nodes < plan.nodes
    # A single node has the band's emissivity: every wavelength counts with its share of 300 K light.
    (single,) = make_plan(scene, Sampling.of(tolerance_mk=5000.0)).spectrum.emissivity.T
    exact = [emitted_radiance(material.emissivity_at, 300.0, *BAND) for material in scene.materials]
    np.testing.assert_allclose(single, np.array(exact) / band_radiance(300.0, *BAND), rtol=1e-9)
    np.testing.assert_allclose(plan.spectrum.black(np.array([300.0])).sum(), band_radiance(300.0, *BAND), rtol=1e-10)


def test_truth_is_where_the_geometry_puts_it(tmp_path):
    height = np.add.outer(np.zeros(24), np.linspace(0.0, 6.0, 24))
    scene = tr.load_scene(write_terrain(tmp_path / "s", height=height))
    pose = tr.pose(1.0, -2.0, 25.0, yaw_deg=30.0, pitch_deg=-60.0)
    frame = tr.Renderer(scene, rays=1).frame(pose)
    truth = frame.truth
    hit = (truth["mask"] & SURFACE) > 0
    assert 0.02 < hit.mean() < 1.0
    local = (truth["position"][hit] - pose[:3, 3]) @ pose[:3, :3]
    np.testing.assert_allclose(local[:, 2], truth["depth"][hit], atol=1e-3)
    rows, columns = np.nonzero(hit)
    pixel = scene.camera.project(local)
    np.testing.assert_allclose(pixel, np.stack([columns + 0.5, rows + 0.5], -1), atol=0.02)
    ground = scene.ground(truth["position"][hit][:, 0], truth["position"][hit][:, 1])
    assert np.nanmax(np.abs(ground - truth["position"][hit][:, 2])) < 2e-3
    assert set(np.unique(truth["mask"][~hit])) <= {0, BACKGROUND}
    assert np.isinf(truth["depth"][~hit]).all() and (truth["material"][~hit] == 255).all()


def test_texels_are_where_the_map_puts_them(tmp_path):
    # One warm texel seen from straight above: its place in the image gives its place on the ground.
    temperature = np.full((64, 64), 290.0)
    temperature[20, 41] = 320.0
    flat, grass = np.zeros((32, 32)), np.ones((64, 64))
    scene = tr.load_scene(write_terrain(tmp_path / "s", height=flat, temperature=temperature, classes=grass))
    frame = tr.Renderer(scene, rays=1, samples=16, taps=1).frame(tr.pose(0, 0, 20, **DOWN))
    weight = frame.radiance - np.median(frame.radiance[200:300, 300:340])
    weight = np.clip(weight, 0, None) * (frame.truth["mask"] == SURFACE)
    row, column = ((weight * axis).sum() / weight.sum() + 0.5 for axis in np.mgrid[:512, :640])
    slope = scene.camera.directions(np.array([column, row]))
    # Texel (20, 41) of 0.5 m: its centre is at map offsets east +4.75, north +5.75 of the middle, and map
    # north is true north to 1e-4 so near the central meridian.
    np.testing.assert_allclose(20.0 * slope * [1, -1], [4.75, 5.75], atol=0.02)


def test_radiance_is_averaged_not_temperature(tmp_path):
    checker = np.where(np.indices((64, 64)).sum(axis=0) % 2, 250.0, 350.0)
    flat, grass = np.zeros((32, 32)), np.ones((64, 64))
    scene = tr.load_scene(write_terrain(tmp_path / "s", height=flat, temperature=checker, classes=grass, sky=0.0))
    far = tr.Renderer(scene, rays=1, samples=16, taps=1).frame(tr.pose(0, 0, 150, **DOWN))
    seen = far.radiance[236:276, 300:340].mean()
    material = scene.materials[0]
    exact = emitted_radiance(material.emissivity_at, np.array([250.0, 350.0]), *BAND).mean()
    wrong = emitted_radiance(material.emissivity_at, 300.0, *BAND)
    # A rectangle of 40 pixels' side contains more of one kind than of the other by a quarter of a square metre at most,
    # and of its 16 · 1600 places, if they were independent, one in 160.
    side = 40 * 150.0 / scene.camera.focal_length_px
    half = 0.5 * float(np.ptp(emitted_radiance(material.emissivity_at, np.array([250.0, 350.0]), *BAND)))
    limit = half * (0.25 / side**2 + 3.0 / np.sqrt(16 * 1600))
    assert abs(seen - exact) < limit < 0.2 * abs(exact - wrong)


@pytest.mark.slow
def test_places_around_a_ray_replace_more_rays(tmp_path):
    checker = np.where(np.indices((64, 64)).sum(axis=0) % 2, 250.0, 350.0)
    flat, grass = np.zeros((32, 32)), np.ones((64, 64))
    scene = tr.load_scene(write_terrain(tmp_path / "s", height=flat, temperature=checker, classes=grass, sky=0.0))
    pose = tr.pose(0, 0, 400, **DOWN)
    many, one, four = (
        tr.Renderer(scene, rays=1, samples=samples, taps=taps).radiance(pose)[240:272, 304:336]
        for samples, taps in ((16, 1), (1, 1), (1, 4))
    )
    # Four independent places would halve the error; spread evenly over the footprint of the ray they reduce it further.
    assert (four - many).std() < 0.3 * (one - many).std()


@pytest.mark.slow
def test_pixels_on_an_edge_are_shared(tmp_path):
    extra = scene_object("box", [4, 4, 1], [0, 0, 3], yaw_deg=20, temperature=350.0)
    flat, even = np.zeros((32, 32)), np.full((64, 64), 280.0)
    scene = tr.load_scene(write_terrain(tmp_path / "s", height=flat, temperature=even, extra=extra))
    pose = tr.pose(0, 0, 40, **DOWN)
    many = tr.Renderer(scene, rays=8, samples=16, edge_mk=np.inf).radiance(pose)[156:356, 220:420]
    shared = tr.Renderer(scene, rays=8).radiance(pose)[156:356, 220:420]
    contrast = many.max() - many.min()
    assert np.abs(shared - many).max() < 0.3 * contrast
    # A shared value is always between those it is mixed from.
    assert many.min() - 1e-4 * contrast < shared.min() and shared.max() < many.max() + 1e-4 * contrast


@pytest.mark.parametrize("quality", [*slow("fast"), "standard", *slow("high")])
def test_the_sampling_error_is_below_its_budget(tmp_path, quality):
    random = np.random.default_rng(6)
    extra = scene_object("box", [2, 1, 1], [1, 2, 0], yaw_deg=20)
    height, warm = random.uniform(0, 2, (32, 32)), random.uniform(285, 305, (64, 64))
    scene = narrow(tr.load_scene(write_terrain(tmp_path / "s", height=height, temperature=warm, extra=extra)))
    renderer = tr.Renderer(scene, quality=quality, rays=16)
    pose = tr.pose(0, -18, 22, pitch_deg=-50)
    budget = renderer.frame(pose).budget_mk
    truth = converged(renderer, pose)
    error = rms_mk(renderer.radiance(pose), truth, scene.camera)
    assert 0.2 * budget["sampling"] < error < budget["sampling"]
    assert budget["total"] == pytest.approx(np.sqrt(sum(budget[part] ** 2 for part in ("nodes", "bake", "sampling"))))


def test_same_input_same_bytes(tmp_path):
    scene = tr.load_scene(write_terrain(tmp_path / "s", height=np.random.default_rng(2).uniform(0, 2, (16, 16))))
    pose = tr.pose(0, 0, 15, pitch_deg=-70)
    a, b = (tr.Renderer(scene, rays=16).frame(pose, index=4) for _ in range(2))
    assert a.radiance.tobytes() == b.radiance.tobytes() and a.counts.tobytes() == b.counts.tobytes()
    assert a.display.tobytes() == b.display.tobytes()


def test_new_temperatures_reuse_the_traced_light(tmp_path, monkeypatch):
    scene = tr.load_scene(write_terrain(tmp_path / "s", height=np.random.default_rng(2).uniform(0, 2, (16, 16))))
    first = tr.Renderer(scene, rays=16)
    _ = first.baked
    from thermorender.scene.spec import TemperatureSpec

    warmer = scene.with_temperature(TemperatureSpec(source="constant", value=310.0))
    fresh = tr.Renderer(warmer, rays=16).frame(tr.pose(0, 0, 9, **DOWN))
    monkeypatch.setattr(radiosity, "trace", lambda *_: pytest.fail("light was traced again"))
    again = tr.Renderer(warmer, rays=16, like=first).frame(tr.pose(0, 0, 9, **DOWN))
    np.testing.assert_array_equal(again.radiance, fresh.radiance)


def test_targets_and_their_visibility(tmp_path):
    targets = (
        ("disc", "disc", [2.0, 1.0, 0.0]),
        ("roof", "box", [-3.0, 0.0, 2.0]),
        ("hidden", "disc", [-3.0, 0.0, 0.0]),
    )
    extra = "".join(scene_object(name, [1, 1, 1], place, shape=shape) for name, shape, place in targets)
    scene = tr.load_scene(write_terrain(tmp_path / "s", height=np.zeros((16, 16)), extra=extra))
    frame = tr.Renderer(scene, rays=1).frame(tr.pose(0, 0, 20, **DOWN))
    seen = frame.targets
    assert seen["disc"]["visible"] and seen["roof"]["visible"] and not seen["hidden"]["visible"]
    f = scene.camera.focal_length_px
    assert seen["disc"]["pixel"] == pytest.approx([320 + f * 2 / 19.98, 256 - f / 19.98], abs=0.05)
    column, row = map(int, seen["disc"]["pixel"])
    assert frame.truth["kinetic_temperature"][row, column] == pytest.approx(330.0)
    behind = tr.Renderer(scene, rays=1).frame(tr.pose(0, 0, 20, pitch_deg=90.0)).targets["disc"]
    assert behind["pixel"] is None and not behind["in_view"] and not behind["visible"]


def test_empty_colour_is_masked(tmp_path):
    colour = np.random.default_rng(0).integers(40, 200, (32, 32, 3))
    colour[:, :12] = 0
    scene = tr.load_scene(write_terrain(tmp_path / "s", height=np.zeros((16, 16)), colour=colour))
    renderer = tr.Renderer(scene, rays=1)
    pose = tr.pose(0, 0, 9, **DOWN)
    mask = renderer.frame(pose).truth["mask"]
    _, known = renderer.visible(pose)
    assert (mask[256, 100] & FILLED) and not (mask[256, 500] & FILLED)
    assert not known[256, 100] and known[256, 500]


def test_beyond_the_edge_is_ground_not_sky(tmp_path):
    flat, even = np.zeros((16, 16)), np.full((32, 32), 295.0)
    scene = tr.load_scene(write_terrain(tmp_path / "s", height=flat, temperature=even, sky=200.0))
    frame = tr.Renderer(scene, rays=8).frame(tr.pose(0, 0, 30, pitch_deg=0.0))
    assert frame.apparent_temperature[0, 320] == pytest.approx(200.0, abs=ARITHMETIC_K)
    assert frame.apparent_temperature[511, 320] == pytest.approx(295.0, abs=ARITHMETIC_K)
    stated = scene.with_sky(200.0, surroundings=280.0)
    frame = tr.Renderer(stated, rays=8).frame(tr.pose(0, 0, 30, pitch_deg=0.0))
    assert frame.apparent_temperature[511, 320] == pytest.approx(280.0, abs=ARITHMETIC_K)


def test_morton_order_is_a_permutation():
    order = morton_order(13, 22)
    assert sorted(order) == list(range(13 * 22))
    assert order[:4].tolist() == [0, 1, 22, 23]


def test_an_edge_is_where_depth_jumps_and_radiance_differs():
    row, column = np.mgrid[:9, :12].astype(np.float32)
    plane, texture = 0.02 + 1e-4 * column + 2e-4 * row, np.where(column > 5, 7.0, 5.0).astype(np.float32)

    def inner(radiance, inverse_depth):
        return edge_step(radiance, inverse_depth)

    assert inner(texture, plane).max() < 1e-3
    # The right half is further away: the edge is in column 5 or 6, and their neighbours differ from neither.
    broken = np.where(column > 5, 0.8 * plane, plane)
    step = inner(texture, broken)
    np.testing.assert_allclose(step, np.broadcast_to([0, 0, 0, 2, 2, 0, 0, 0], step.shape), atol=1e-3)
    assert inner(np.full_like(texture, 6.0), broken).max() == 0.0
    # An object in one pixel may extend into its neighbours, and half as likely across the corners.
    target = (row == 4) & (column == 5)
    step = inner(np.where(target, 9.0, 5.0).astype(np.float32), np.where(target, 2.0 * plane, plane))
    expected = np.zeros_like(step)
    expected[1:4, 2:5] = [[2.0, 4.0, 2.0], [4.0, 4.0, 4.0], [2.0, 4.0, 2.0]]
    np.testing.assert_allclose(step, expected, atol=1e-3)


def test_a_part_of_an_image_equals_the_whole_there(tmp_path):
    """This includes edges at the rim of a part, which only rays beyond it detect."""
    hot = "".join(
        scene_object(f"box {number}", [side, side, 2.0], [east, north, 0.0], 345.0, yaw_deg=turn)
        for number, (side, east, north, turn) in enumerate(
            [(2.0, -4.0, 1.0, 10.0), (0.6, 1.0, 2.0, 40.0), (1.0, 3.0, -2.0, 0.0), (0.3, -1.0, -3.0, 25.0)]
        )
    )
    scene = tr.load_scene(write_terrain(tmp_path / "s", extra=hot))
    camera = replace(scene.camera, width=96, height=72)
    renderer = tr.Renderer(scene.with_camera(camera), rays=32)
    for yaw in (0.0, 33.0):
        view = tr.pose(0.0, -6.0, 12.0, yaw_deg=yaw, pitch_deg=-60.0)
        whole = renderer.radiance(view)
        for row in range(0, 52):
            rows, columns = slice(row, row + 20), slice(row + 3, row + 40)
            part = renderer.radiance(view, camera=camera.part(rows, columns))
            np.testing.assert_allclose(part, whole[rows, columns], rtol=2e-6)


def test_some_pixels_are_those_of_the_whole_and_others_stay_0(tmp_path):
    scene = tr.load_scene(write_terrain(tmp_path / "s"))
    renderer = tr.Renderer(scene.with_camera(replace(scene.camera, width=33, height=17)), rays=32)
    view, only = tr.pose(0.0, -6.0, 12.0, pitch_deg=-60.0), np.zeros((17, 33), bool)
    assert not renderer.radiance(view, only=only).any()
    only[3:9, 5:30:2] = True
    found, whole = renderer.radiance(view, only=only.tolist()), renderer.radiance(view)
    np.testing.assert_allclose(found[only], whole[only], rtol=2e-3)
    assert not found[~only].any()
    with pytest.raises(ThermorenderError, match=r"only has the shape \(5, 5\).*\(17, 33\)"):
        renderer.radiance(view, only=np.ones((5, 5), bool))


def test_a_ring_of_pixels_determines_all_edges_inside():
    radiance = np.random.default_rng(1).uniform(50.0, 60.0, (20, 24)).astype(np.float32)
    row, column = np.mgrid[:20, :24]
    for jump in range(5, 12):
        depth = np.where((column > jump) | (row > jump + 2), 20.0, 50.0).astype(np.float32)
        whole = edge_step(radiance, 1.0 / depth)
        for cut in range(1, 9):
            part = edge_step(radiance[cut:, cut:], 1.0 / depth[cut:, cut:])
            np.testing.assert_array_equal(part, whole[cut:, cut:])


def test_unusable_scenes_and_poses_are_refused(tmp_path):
    scene = tr.load_scene(write_mesh(tmp_path / "s", square()))
    renderer = tr.Renderer(scene)
    skewed = np.eye(4)
    skewed[0, 1] = 0.5
    with pytest.raises(ThermorenderError, match="rotation that is not orthonormal"):
        renderer.frame(skewed)
    with pytest.raises(ThermorenderError, match=r"pose of shape \(3, 3\)"):
        renderer.frame(np.eye(3))
    for keyword, words in (
        ({"samples": 3}, "samples=3 is not allowed; give one of 1, 2, 4, 8, 16"),
        ({"rays": 0}, "rays=0 is not allowed"),
        ({"tolerance_mk": -1}, "tolerance_mk=-1 is not allowed"),
        ({"seed": -1}, "seed=-1 is not allowed"),
        ({"device": "tpu"}, "device='tpu' is unknown; give one of auto, cpu, cuda"),
    ):
        with pytest.raises(ThermorenderError, match=words):
            tr.Renderer(scene, **keyword)
    with pytest.raises(ThermorenderError, match="scene='heath' is not a Scene; give what load_scene returns"):
        tr.Renderer("heath")


def test_vertex_arrays_have_the_padding_that_embree_reads():
    """Embree reads four bytes beyond the last vertex: where memory ends there, the process would crash."""
    vertices = np.random.default_rng(0).normal(size=(7, 3))
    found = positions(vertices)
    assert found.dtype == np.float32 and np.array_equal(found, vertices.astype(np.float32).ravel())
    assert found.base.ctypes.data + found.base.nbytes >= found.ctypes.data + found.nbytes + 4
