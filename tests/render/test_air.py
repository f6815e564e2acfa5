"""Frames through air, compared at single pixels with sums over steps, nodes and wavelengths (`air_by_steps`)."""

from dataclasses import replace

import air_by_steps
import numpy as np
import pytest
import trimesh
from support import shared_data, slow

import thermorender as tr
from scenes import plane, scene_object, write_mesh
from thermorender.atmosphere.model import Atmosphere
from thermorender.atmosphere.rays import MEAN_RADIUS_M
from thermorender.errors import ThermorenderError
from thermorender.physics import sun
from thermorender.physics.band import quadrature
from thermorender.physics.planck import (
    band_radiance,
    band_radiance_derivative,
    brightness_temperature,
    spectral_radiance,
)
from thermorender.render import reference
from thermorender.render.geometry import Geometry
from thermorender.render.light import environment, radiosity
from thermorender.render.light.absorbed import left_out
from thermorender.render.plan import make_plan
from thermorender.render.variant import activate

BAND = (7.5, 13.5)
DOWN = {"pitch_deg": -90.0}
AIR = '[atmosphere]\nstandard = "midlatitude-summer"\naerosol = "rural-23km"\n'


def write(folder, mesh, air=AIR, temperature=300.0, material=None, emissivity=1.0, extra=""):
    """A mesh scene with air in place of [sky], and optionally `material` in place of a constant emissivity."""
    write_mesh(folder, mesh, temperature, emissivity, extra=extra)
    path = folder / "scene.toml"
    text = path.read_text().replace("[sky]\ntemperature = 250.0\n", air)
    if material:
        constant = f'source = "constant"\nvalue = {emissivity}'
        text = text.replace(constant, f'source = "material"\nmaterial = "{material}"')
    path.write_text(text)
    return folder


def isothermal(folder, temperature):
    """Scene line that names a table of hazy air with one temperature at all altitudes."""
    air = Atmosphere.standard("tropical", "rural-5km")
    folder.mkdir(parents=True, exist_ok=True)
    replace(air, temperature=np.full_like(air.temperature, temperature)).save(folder / "air.npz")
    return '[atmosphere]\nfile = "air.npz"\n'


def directions(camera, pose, pixel):
    local = camera.directions(np.asarray(pixel, dtype=float) + 0.5)
    world = np.column_stack([local, np.ones(len(local))]) @ pose[:3, :3].T
    return world / np.linalg.norm(world, axis=1, keepdims=True)


def ground_radiance(air, material, temperature, height, cosine, ground_m=0.0):
    """Band radiance of a plane behind air, summed over nodes; wavelengths within a node share its transmittance."""
    length = height / cosine
    # A flat plane under a curved atmosphere: its ends lie higher than its middle.
    end = ground_m + (length**2 - height**2) / (2.0 * MEAN_RADIUS_M)
    paths = [air_by_steps.between(air, ground_m + height, *path) for path in zip(end, length, strict=True)]
    passed, added = (np.array(part) for part in zip(*paths, strict=True))
    sky, leaving = air_by_steps.sky_mean(air, ground_m), np.empty(air.nodes)
    warm = air_by_steps.planck(air, temperature)[0]
    for node, (low, high) in enumerate(zip(air.lower_um, air.upper_um, strict=True)):
        wavelength, weight = quadrature(low, high)
        own, cool = (spectral_radiance(wavelength, t) * weight for t in (temperature, 285.0))
        emissivity = material.emissivity_at(wavelength)
        leaving[node] = emissivity @ own / own.sum() * warm[node]
        leaving[node] += (1.0 - emissivity) @ cool / cool.sum() * sky[node]
    return passed @ leaving + added.sum(axis=1)


@pytest.mark.parametrize(("height", "pitch"), [(2.0, -10.0), (120.0, -45.0), (5000.0, -30.0)])
def test_isothermal_air_is_invisible(tmp_path, height, pitch):
    folder = tmp_path / "s"
    extra = "[surroundings]\ntemperature = 290.0\n"
    air = isothermal(folder, 290.0)
    scene = tr.load_scene(write(folder, plane(4.0 * height), air, temperature=290.0, extra=extra))
    frame = tr.Renderer(scene).frame(tr.pose(0, 0, height, pitch_deg=pitch))
    below = ~((frame.truth["mask"] == 0) & ~np.isfinite(frame.truth["depth"]))
    assert below.mean() > 0.3 and np.isfinite(frame.truth["depth"]).any()
    # Everything but the sky, which is thin straight up: the ground and the surroundings beyond it.
    assert np.abs(frame.apparent_temperature[below] - 290.0).max() < 1e-3


@pytest.mark.parametrize("material", [*slow("grass_green"), "sand_quartz"])
@pytest.mark.parametrize(("height", "pitch"), [(1.5, -20.0), *slow((120.0, -90.0), (120.0, -45.0)), (12000.0, -60.0)])
def test_ground_behind_air_equals_the_sum_over_nodes(tmp_path, height, pitch, material):
    scene = tr.load_scene(write(tmp_path / "s", plane(4.0 * height), temperature=305.0, material=material))
    renderer = tr.Renderer(scene, rays=4096)
    pose = tr.pose(0, 0, height, pitch_deg=pitch)
    frame = renderer.frame(pose)
    pixel = np.column_stack([a.ravel() for a in np.meshgrid([5, 200, 320, 634], [90, 256, 400, 507])])
    direction = directions(scene.camera, pose, pixel)
    hit = np.isfinite(frame.truth["depth"][pixel[:, 1], pixel[:, 0]])
    exact = ground_radiance(scene.air, renderer.scene.materials[0], 305.0, height, -direction[hit, 2])
    seen = frame.radiance[pixel[hit, 1], pixel[hit, 0]]
    error = (seen - exact) / band_radiance_derivative(brightness_temperature(exact, *BAND), *BAND) * 1e3
    spectrum = renderer.plan.spectrum
    # Nodes and channels as planned, and 2 mK for the grid of lengths and for the sky in 8 bins of 4096 rays. On a path
    # from 12 km the model's own steps add 6 mK.
    steps = 6.0 if height > 1e4 else 0.0
    assert hit.sum() >= 8 and np.abs(error).max() < spectrum.nodes_mk + spectrum.channels_mk + 2.0 + steps, error


def test_sky_and_surroundings_against_steps(tmp_path):
    scene = tr.load_scene(write(tmp_path / "s", plane(10.0), extra="[surroundings]\ntemperature = 310.0\n"))
    pose = tr.pose(0, 0, 120.0, pitch_deg=10.0)
    frame = tr.Renderer(scene).frame(pose)
    pixel = np.array([[320, 3], [100, 100], [320, 300], [600, 330], [320, 420], [50, 500]])
    z = directions(scene.camera, pose, pixel)[:, 2]
    up, air = z > 0.0, scene.air
    exact = np.empty(len(pixel))
    exact[up] = [air_by_steps.outward(air, 120.0, cosine)[1].sum() for cosine in z[up]]
    length = 120.0 / -z[~up] * (1.0 + 120.0 / z[~up] ** 2 / (2.0 * MEAN_RADIUS_M))
    below = [air_by_steps.between(air, 120.0, 0.0, metres) for metres in length]
    exact[~up] = [passed @ air_by_steps.planck(air, 310.0)[0] + added.sum() for passed, added in below]
    kelvin = frame.apparent_temperature[pixel[:, 1], pixel[:, 0]] - brightness_temperature(exact, *BAND)
    # The table's 10 mK, and refraction, which the straight chord here leaves out.
    assert np.abs(kelvin).max() < 0.02, kelvin
    assert list(frame.truth["mask"][pixel[:, 1], pixel[:, 0]] == 0) == list(up)


def test_sky_bins_on_a_wall_and_on_a_slope(tmp_path):
    # A single tilted face: the upper part of its hemisphere sees the sky, the lower part the surroundings.
    air = Atmosphere.standard("us-1976", "rural-23km").in_band(*BAND)
    node, weight = np.polynomial.legendre.leggauss(60)
    cosine = 0.5 * (node + 1.0)
    sky = np.array([air_by_steps.outward(air, 0.0, c)[1].sum() for c in cosine])
    for tilt in (0.0, 40.0, 90.0):
        turned = trimesh.Trimesh([[-1, -1, 0], [1, -1, 0], [0, 1, 0]], [[0, 1, 2]])
        turned.apply_transform(trimesh.transformations.rotation_matrix(np.radians(tilt), [1, 0, 0]))
        scene = tr.load_scene(write_mesh(tmp_path / f"{tilt}", turned))
        geometry = Geometry(activate(), scene.surfaces)
        # The triangles that this face is split into share these rays.
        transport = radiosity.trace(geometry, (1 << 20) // geometry.face_count)
        light = environment.Environment(environment.sky_bins(air, 0.0)[None], np.ones((1, 1)), np.zeros(air.nodes))
        found = geometry.share @ light.light(transport.sky, transport.background).sum(axis=1)
        # ∫ L cos θ dω / π over zenith angle and azimuth, with the cosine to the face's normal clipped at 0.
        azimuth = np.linspace(0.0, 2.0 * np.pi, 4000, endpoint=False)
        sine = np.sqrt(1.0 - cosine**2)[:, None]
        facing = cosine[:, None] * np.cos(np.radians(tilt)) + sine * np.sin(np.radians(tilt)) * np.cos(azimuth)
        share = np.maximum(facing, 0.0).mean(axis=1) * 2.0
        exact = (0.5 * weight * share) @ sky
        # Bins and rays: 30 mK of apparent temperature; at a reflectance of 0.05 that is 1.5 mK of a frame.
        assert abs(found - exact) < 0.03 * band_radiance_derivative(280.0, *BAND), (tilt, found, exact)


def test_sun_lights_surfaces_that_face_it(tmp_path):
    roof = scene_object("roof", [4.0, 4.0, 0.2], [0, 0, 2.0], 300.0, "paint_metallic")
    bright = "[sun]\nelevation_deg = 30.0\nazimuth_deg = 90.0\n"
    mesh = plane(16.0)
    for _ in range(4):
        mesh = mesh.subdivide()
    frames = []
    for name, extra in (("dark", roof), ("lit", bright + roof)):
        scene = tr.load_scene(write(tmp_path / name, mesh, extra=extra, emissivity=0.6))
        # The same rays in both.
        frames.append(tr.Renderer(scene, edge_mk=np.inf).frame(tr.pose(0, 0, 12.0, **DOWN)))
    more = frames[1].radiance - frames[0].radiance
    position = frames[0].truth["position"]
    ground = np.abs(position[..., 2]) < 0.01
    # The roof's shadow falls to the west: 2 m of height over tan 30° are 3.5 m.
    shade = ground & (np.abs(position[..., 0] + 3.46) < 1.0) & (np.abs(position[..., 1]) < 1.0)
    open_ground = ground & (position[..., 0] > 3.2) & (np.abs(position[..., 1]) < 4.0)
    wavelength, weight = quadrature(*BAND)
    above = sun.irradiance(wavelength) @ weight
    share = air_by_steps.planck(scene.air, 5036.0)[0]
    passed = air_by_steps.outward(scene.air, 0.0, 0.5)[0] @ share / share.sum()
    expected = 0.4 * 0.5 * above * passed / np.pi
    # The shade receives only sunlight that the lit ground and the roof's shiny underside reflect.
    assert shade.any() and np.abs(more[shade]).max() < 0.08 * expected
    # The air's nodes weight sunlight as they weight a 285 K blackbody.
    assert np.median(more[open_ground]) == pytest.approx(expected, rel=0.03)


def test_sunlight_above_the_air_agrees_with_modtran():
    tape = shared_data("emissivity/pyradi_modtran/tape7.LWIRSun")
    lines = tape.read_text(encoding="latin-1").splitlines()
    head = next(number for number, line in enumerate(lines) if "TOA_SUN" in line)
    column = lines[head].replace("BBODY_T[K]", "BBODY_T").split().index("TOA_SUN")
    rows = [line.split() for line in lines[head + 1 :] if len(line.split()) > column]
    wavenumber = np.array([float(row[0]) for row in rows])
    theirs = np.array([float(row[column]) for row in rows]) * 1e4 * wavenumber**2 / 1e4
    ours = sun.irradiance(1e4 / wavenumber)
    # MODTRAN's sun is that of 1 January (card 3A1), at 0.9833 astronomical units; ours is at one.
    assert lines[6].split()[:3] == ["1", "2", "1"]
    assert np.abs(ours / 0.9833**2 / theirs - 1.0).max() < 0.013


def test_grey_sand_is_wrong_and_spectral_nodes_correct_it(tmp_path):
    # Hot sand reflects most where a clear sky is coldest and the air most transparent.
    air = '[atmosphere]\nstandard = "tropical"\n'
    own = tr.load_scene(write(tmp_path / "own", plane(2000.0), air, temperature=340.0, material="sand_quartz"))
    sand = own.materials[0]
    grey = float(sand.band_emissivity(*BAND, 340.0))
    even = tr.load_scene(write(tmp_path / "grey", plane(2000.0), air, temperature=340.0, emissivity=round(grey, 9)))
    true, wrong = (tr.Renderer(scene, rays=1024) for scene in (own, even))
    pose = tr.pose(0, 0, 1000.0, **DOWN)
    seen = [float(renderer.frame(pose).apparent_temperature[256, 320]) for renderer in (true, wrong)]
    exact = brightness_temperature(ground_radiance(own.air, sand, 340.0, 1000.0, np.ones(1))[0], *BAND)
    assert abs(seen[0] - exact) < 0.01, (seen, exact)
    assert abs(seen[1] - exact) > 0.1, (seen, exact)
    assert true.plan.nodes > wrong.plan.nodes


def test_plan_states_the_effects_of_air(tmp_path):
    scene = tr.load_scene(write(tmp_path / "s", plane(10.0), emissivity=0.95))
    rows = {row[0]: row for row in make_plan(scene).rows()}
    assert "channels" in rows["air"][1] and "kilometre" in rows["air"][2] and rows["sun"][1] == "out"
    assert rows["air between surfaces"][1] == "out"
    sunny = "[sun]\nelevation_deg = 40\nazimuth_deg = 180\n"
    lit = tr.load_scene(write(tmp_path / "lit", plane(10.0), emissivity=0.95, extra=sunny))
    assert make_plan(lit).sun and 5.0 < make_plan(lit).sun_mk < 100.0
    # Nearly black ground: at most half a millikelvin.
    black = tr.load_scene(write(tmp_path / "black", plane(10.0), emissivity=0.9995, extra=sunny))
    assert not make_plan(black).sun and 0.0 < make_plan(black).sun_mk < 0.5
    night = tr.load_scene(write(tmp_path / "night", plane(10.0), extra=sunny.replace("40", "-5")))
    assert not make_plan(night).sun
    frame = tr.Renderer(scene).frame(tr.pose(0, 0, 5, **DOWN))
    assert {"nodes", "bake", "sampling", "air", "total", "image", "gases"} == set(frame.budget_mk)
    # From 5 m less than from 500 m, and none of it in the total.
    higher = tr.Renderer(scene).frame(tr.pose(0, 0, 500, **DOWN)).budget_mk
    assert 0.0 < frame.budget_mk["gases"] < 0.2 * higher["gases"] < 100.0
    parts = ("nodes", "bake", "sampling", "air")
    # Also where few pixels show the land.
    far = tr.Renderer(scene).frame(tr.pose(0, 0, 3000, **DOWN)).budget_mk
    assert far["gases"] > higher["gases"]
    assert higher["total"] == pytest.approx(np.sqrt(sum(higher[name] ** 2 for name in parts)))
    without = tr.load_scene(write_mesh(tmp_path / "without", plane(10.0)))
    assert make_plan(without).spectrum.channels == 1 and make_plan(without).air_mk is None


@pytest.mark.slow
def test_neglected_air_between_surfaces_is_in_the_stated_error(tmp_path):
    """A floor under a roof at 60 m: view factor of the roof × change of light by 60 m of air × reflectance."""
    roof = scene_object("roof", [60.0, 60.0, 0.2], [0, 0, 60.0], 340.0, "asphalt")
    scene = tr.load_scene(write(tmp_path / "s", plane(4.0), emissivity=0.8, extra=roof))
    renderer = tr.Renderer(scene, rays=1024)
    baked = renderer.baked
    passed, added = scene.air.path(0.0, 0.0, 60.0)
    change = abs(passed @ scene.air.planck(340.0) + added.sum() - scene.air.planck(340.0).sum())
    seen = np.asarray(baked.transport.operator[[0, 1]].sum(axis=1))
    assert seen == pytest.approx(0.24, abs=0.05)
    reflected = [left_out(scene, baked.transport, np.full(baked.geometry.face_count, r)) for r in (0.2, 0.4)]
    # The roof's faces are 60 to 70 m from the middle.
    assert np.all(reflected[0][:2] > 0.2 * seen * change) and np.all(reflected[0][:2] < 0.2 * seen * change * 70 / 60)
    assert reflected[1] == pytest.approx(2.0 * reflected[0])
    # A frame's budget includes it, together with the noise of the rays.
    stated = renderer.frame(tr.pose(0, 0, 2.0, **DOWN)).budget_mk["bake"]
    assert stated > reflected[0][:2].min() / renderer.plan.radiance_per_mk
    assert (
        baked.errors_mk["air"] > 0.0 and "air" not in tr.Renderer(tr.load_scene("heath/survey"), rays=2).baked.errors_mk
    )


@pytest.mark.parametrize(
    ("air", "words"),
    [
        (
            "",
            "needs exactly one of sky, atmosphere (a sky of one temperature and no air, or air with its sky; with ",
        ),
        (AIR + "[sky]\ntemperature = 250.0\n", "but sky and atmosphere are given"),
        ('[atmosphere]\nstandard = "polar"\n', "standard='polar' is unknown"),
        ('[atmosphere]\nstandard = "tropical"\naerosol = "smoke"\n', "aerosol='smoke' is unknown"),
        ("[atmosphere]\n", "atmosphere needs exactly one of standard, file, profile, but none is given"),
        ('[atmosphere]\nstandard = "tropical"\nvisibility_km = 5\n', "atmosphere.visibility_km"),
        ('[atmosphere]\nstandard = "tropical"\nclouds = 1\n', "did you mean 'cloud"),
        ('[atmosphere]\nstandard = "tropical"\ncloud_fraction = 40\n', "cloud_fraction=40 is out of range"),
        ('[atmosphere]\nfile = "scene.toml"\n', "is not an .npz file with its arrays"),
        (AIR + "[sun]\nelevation_deg = 100\nazimuth_deg = 0\n", "sun.elevation_deg"),
        ("[sky]\ntemperature = 250.0\n[sun]\nelevation_deg = 10\nazimuth_deg = 0\n", "add [atmosphere]"),
    ],
)
def test_wrong_air_settings_are_refused_by_key(tmp_path, air, words):
    folder = write(tmp_path / "s", plane(4.0), air)
    with pytest.raises(ThermorenderError) as caught:
        tr.load_scene(folder)
    assert words in str(caught.value) and "\n" not in str(caught.value)


def test_camera_in_space_is_refused(tmp_path):
    scene = tr.load_scene(write(tmp_path / "s", plane(4.0)))
    with pytest.raises(ThermorenderError, match="outside the range of the air"):
        tr.Renderer(scene).frame(tr.pose(0, 0, 4e4, **DOWN))


def test_the_reference_engine_refuses_air(tmp_path):
    scene = tr.load_scene(write(tmp_path / "s", plane(4.0)))
    with pytest.raises(ThermorenderError, match=r"has \[atmosphere\], which the reference engine does not support"):
        reference.render(scene, tr.pose(0, 0, 5.0, **DOWN), samples=1)


def test_clouds_warm_the_sky(tmp_path):
    found = []
    for share in (0.0, 1.0):
        scene = tr.load_scene(write(tmp_path / f"{share}", plane(4.0), AIR + f"cloud_fraction = {share}\n"))
        found.append(tr.Renderer(scene).frame(tr.pose(0, 0, 2.0, pitch_deg=80.0)).apparent_temperature[256, 320])
    assert found[1] > found[0] + 20.0
    assert found[1] < scene.air.air_temperature(0.0)


def test_surfaces_above_the_cloud_base_are_refused_before_any_work(tmp_path, monkeypatch):
    air = AIR + "cloud_fraction = 0.3\ncloud_base_m = 500.0\naltitude_m = 400.0\n"
    scene = tr.load_scene(write(tmp_path / "s", plane(4.0), air, emissivity=0.9))
    renderer = tr.Renderer(scene, rays=16)
    monkeypatch.setattr("thermorender.render.renderer.bake", lambda *_: pytest.fail("baked in vain"))
    words = r"pose: the camera is 500\.1\d* m above sea level, above the cloud base at 500 m.*to 0"
    with pytest.raises(ThermorenderError, match=words):
        renderer.radiance(tr.pose(0, 0, 100.1, **DOWN))
    up = tr.Trajectory(np.array([0.0, 1.0]), np.array([[0, 0, 50.0], [0, 0, 101.0]]), np.array([[0, 1.0, 0, 0]] * 2))
    with pytest.raises(ThermorenderError, match="pose: the camera is 501 m above sea level, above the cloud base"):
        tr.fly(renderer, up, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    monkeypatch.undo()
    # Just below the base, the cloud is all of the sky.
    over = tr.load_scene(write(tmp_path / "over", plane(4.0), air.replace("0.3", "1.0"), emissivity=0.9))
    seen = tr.Renderer(over, rays=16).frame(tr.pose(0, 0, 99.9, pitch_deg=60.0)).apparent_temperature
    assert np.abs(seen - over.air.air_temperature(500.0)).max() < 0.005
    roof = scene_object("roof", [4.0, 4.0, 0.2], [0, 0, 99.9], 300.0, "paint_metallic")
    high = write(tmp_path / "high", plane(4.0), air, extra=roof)
    words = r"scene.toml: the highest surface is 500\.\d+ m above sea level, above the cloud base at 500 m"
    with pytest.raises(ThermorenderError, match=words):
        tr.load_scene(high)
    (high / "scene.toml").write_text((high / "scene.toml").read_text() + 'track = "up.csv"\n')
    (high / "up.csv").write_text("time_s,above_ground_m\n0,0\n1,150\n")
    with pytest.raises(ThermorenderError, match=r"the highest surface is 550\.\d* m above"):
        tr.load_scene(high)


def test_standard_air_replaces_the_scenes_sky(tmp_path):
    scene = tr.load_scene(write_mesh(tmp_path / "s", plane(10.0), emissivity=1.0))
    replaced = tr.load_scene(write(tmp_path / "t", plane(10.0)))
    aired = scene.with_air("midlatitude-summer", "rural-23km")
    pose = tr.pose(0, 0, 50, **DOWN)
    assert np.array_equal(*(tr.Renderer(each).radiance(pose) for each in (aired, replaced)))
    assert len({scene.digest(), aired.digest(), scene.with_air("tropical").digest()}) == 3
    arrays = [name for name, value in vars(aired.air).items() if isinstance(value, np.ndarray) and name[0] != "_"]
    # Others than the limits of the sub-bands, which must stay those of the camera.
    arrays = [name for name in arrays if name not in ("lower_um", "upper_um")]
    others = [aired.with_air(replace(aired.air, **{name: getattr(aired.air, name) * 1.0001})) for name in arrays]
    assert len(arrays) == 6 and len({aired.digest(), *(other.digest() for other in others)}) == 7
    with pytest.raises(ThermorenderError, match="standard='moon' is unknown"):
        scene.with_air("moon")


@pytest.mark.slow
def test_dynamic_object_in_air_equals_a_static_one(tmp_path):
    item = scene_object("car", [1.8, 4.0, 1.2], temperature=310.0, material="paint_metallic")
    mesh = plane(20.0)
    for _ in range(5):
        mesh = mesh.subdivide()
    images = []
    for name, more in (("static", ""), ("dynamic", 'track = "car.csv"\n')):
        folder = write(tmp_path / name, mesh, emissivity=0.9, extra=item + more)
        (folder / "car.csv").write_text("time_s,east_m\n0,0\n1,0.0\n") if more else None
        images.append(tr.Renderer(tr.load_scene(folder), rays=512).frame(tr.pose(0, -8, 9, pitch_deg=-50.0)))
    difference = images[1].apparent_temperature - images[0].apparent_temperature
    # Noise of the rays in the car's reflected light (reflectance 0.59); a wrong sky or channel would be kelvins off.
    assert np.sqrt(np.mean(np.square(difference))) < 0.06
    assert images[0].apparent_temperature.std() > 1.0


@pytest.mark.parametrize("up", [4e4, *slow(-2000.0)])
def test_camera_above_the_modelled_air_is_refused_by_pose(up):
    scene = tr.load_scene("heath/survey").with_air("us-1976")
    with pytest.raises(ThermorenderError, match=r"pose: the camera is -?\d+ m above .* give −500 … 30000 m"):
        tr.Renderer(scene, "fast", rays=4, device="cpu").radiance(tr.pose(0.0, 0.0, up, pitch_deg=-90.0))


def test_ground_less_than_a_metre_below_clouds(tmp_path):
    """No camera a metre above the ground is below the clouds; the ground reflects a cloud as warm as the air."""
    air = AIR + "cloud_fraction = 1.0\ncloud_base_m = 0.5\naltitude_m = 0.0\n"
    scene = tr.load_scene(write(tmp_path / "s", plane(4.0), air, emissivity=0.5))
    seen = tr.Renderer(scene, rays=16).radiance(tr.pose(0, 0, 0.2, **DOWN), through_air=False)
    warm, cloud = band_radiance(np.array([300.0, scene.air.air_temperature(0.5)]), *BAND)
    assert np.abs(seen - 0.5 * (warm + cloud)).max() / band_radiance_derivative(300.0, *BAND) < 0.005


@pytest.mark.parametrize("altitude", [-600.0, 30_100.0, 100_000.0])
def test_surfaces_outside_the_modelled_air_are_refused_by_altitude(tmp_path, altitude):
    scene = tr.load_scene(write(tmp_path / "s", plane(4.0), AIR + f"altitude_m = {altitude}\n"))
    words = rf"surfaces are at {altitude:.7g} … {altitude:.7g} m above sea level, outside the range of the air"
    with pytest.raises(ThermorenderError, match=words):
        tr.Renderer(scene)
