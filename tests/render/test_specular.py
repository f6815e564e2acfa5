"""Materials that depend on the angle of view, against closed forms, mirrored geometry and Lambertian scenes."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from support import slow

import thermorender as tr
from scenes import plane, scene_object, write_materials, write_mesh, write_terrain
from thermorender.atmosphere.model import Atmosphere
from thermorender.atmosphere.rays import MEAN_RADIUS_M
from thermorender.physics.band import quadrature
from thermorender.physics.planck import band_radiance_derivative, brightness_temperature, spectral_radiance
from thermorender.render.geometry import Geometry
from thermorender.render.plan import make_plan
from thermorender.render.reflection import mirrors

BAND = (7.5, 13.5)
AIR = '[atmosphere]\nstandard = "midlatitude-summer"\naerosol = "rural-23km"\n'


def write(folder, mesh, material, temperature=300.0, sky=250.0, air=None, extra=""):
    """A mesh scene of one material from the library, or of "black" or "sheen" (by angle), which the scene brings."""
    write_mesh(folder, mesh, temperature, sky=sky, extra=extra)
    path = folder / "scene.toml"
    text = path.read_text().replace('source = "constant"\nvalue = 0.9', f'source = "material"\nmaterial = "{material}"')
    path.write_text(text.replace(f"[sky]\ntemperature = {sky}\n", air) if air else text)
    write_materials(folder)
    return folder


def directions(camera, pose):
    """Unit directions (H, W, 3) through the pixel centres."""
    row, column = np.mgrid[: camera.height, : camera.width] + 0.5
    local = camera.directions(np.stack([column, row], axis=-1).reshape(-1, 2))
    world = np.column_stack([local[:, :2], np.ones(len(local))]) @ pose[:3, :3].T
    return (world / np.linalg.norm(world, axis=1, keepdims=True)).reshape(camera.height, camera.width, 3)


def shown(material, cosine, own, seen):
    """Band radiance of a mirror of temperature `own` that shows a blackbody `seen`, summed over wavelengths."""
    wavelength, weight = quadrature(*BAND)
    emissivity = material.emissivity_at_angle(wavelength, np.asarray(cosine)[..., None])
    warm, cold = (spectral_radiance(wavelength, t) * weight for t in (own, seen))
    return emissivity @ warm + (1.0 - emissivity) @ cold


def kelvin_apart(radiance, exact):
    return (radiance - exact) / band_radiance_derivative(brightness_temperature(exact, *BAND), *BAND)


@pytest.mark.parametrize("material", ["water_fresnel", *slow("water_breeze", "silica_fused"), "gold_polished", "sheen"])
def test_level_mirror_under_an_isotropic_sky(tmp_path, material):
    scene = tr.load_scene(write(tmp_path / "s", plane(4e4), material))
    pose = tr.pose(0, 0, 10, pitch_deg=-18)
    frame = tr.Renderer(scene, rays=2).frame(pose)
    cosine = -directions(scene.camera, pose)[..., 2]
    hit = np.isfinite(frame.truth["depth"])
    cosine, seen = cosine[hit][::97], frame.radiance[hit][::97]
    assert cosine.min() < 0.02 and cosine.max() > 0.5
    exact = shown(scene.materials[0], cosine, 300.0, 250.0)
    # 257 angles give a material's emissivity to 3e-4 near grazing and 2e-5 elsewhere, times some 50 K between sky and
    # ground where the sky contributes most.
    limit = np.where(cosine < 0.1, 12e-3, 2e-3)
    if material == "sheen":
        # A table's bend between two of the 257: a quarter of their step of 0.0033 times the change of slope, 0.65.
        limit = np.array(27e-3)
    error = np.abs(kelvin_apart(seen, exact))
    assert (error < limit).all(), error.max()
    # A diffuse surface of the same hemispherical emissivity would be far off, polished gold too, so the test can fail.
    wavelength, weight = quadrature(*BAND)
    whole = scene.materials[0].emissivity_at(wavelength)
    warm, cold = (spectral_radiance(wavelength, kelvin) * weight for kelvin in (300.0, 250.0))
    diffuse = whole @ warm + (1.0 - whole) @ cold
    assert np.abs(kelvin_apart(diffuse, exact)).max() > 10.0 * limit.max()
    wanted = [scene.materials[0].band_emissivity(*BAND, 300.0, value) for value in cosine[::400]]
    assert np.abs(frame.truth["emissivity"][hit][::97][::400] - wanted).max() < 4e-4


def test_a_mirror_that_shows_sky_states_its_error(tmp_path):
    """The sky in it is infinitely far away, but the mirror is a surface, and its surroundings are not."""
    scene = tr.load_scene(write(tmp_path / "s", plane(4e3), "water_fresnel"))
    frame = tr.Renderer(scene, rays=2).frame(tr.pose(0, 0, 30, pitch_deg=-10))
    shown = np.isfinite(frame.truth["depth"])
    assert shown.any() and not shown.all()
    # Along the horizon, the rays of a pixel meet both.
    assert (np.isfinite(frame.error_mk) != shown).mean() < 1.0 / len(shown)


def even_air(folder, absorption=(2e-3, 1e-2)):
    """The [atmosphere] of a scene: 290 K, one density up to 2 km; 0.6 and 0.4 of the light with two absorptions."""
    Atmosphere(
        lower_um=np.full(2, BAND[0]), upper_um=np.full(2, BAND[1]), weight=np.array([0.6, 0.4]), tilt=np.zeros(2),
        altitude_m=np.array([0.0, 2e3, 2001.0]), temperature=np.full(3, 290.0), density=np.array([[1.0, 1.0, 0.0]]),
        absorption=np.array(absorption)[:, None],
    ).save(folder / "air.npz")  # fmt: skip
    return '[atmosphere]\nfile = "air.npz"\naltitude_m = 500.0\n'


@pytest.mark.parametrize("track", ["", 'track = "still.csv"'])
@pytest.mark.parametrize("material", ["gold_polished", *slow("sheen")])
def test_a_mirror_image_is_seen_through_the_air_between(tmp_path, material, track):
    """A level mirror, a black roof of 400 K above it, and a camera between them, all in air of one density."""
    roof = scene_object("roof", (400, 400, 1), (0, 0, 60), 400.0, "black") + track
    folder = write(tmp_path / "s", plane(100.0), material, 300.0, extra=roof)
    (folder / "still.csv").write_text("time_s,yaw_deg\n0,0\n1,0\n")
    (folder / "scene.toml").write_text(
        (folder / "scene.toml").read_text().replace("[sky]\ntemperature = 250.0\n", even_air(folder))
    )
    scene = tr.load_scene(folder)
    renderer, pose = tr.Renderer(scene, rays=2), tr.pose(0, 0, 30, pitch_deg=-45)
    frame = renderer.frame(pose)
    cosine = -directions(scene.camera, pose)[100:400:50, 50:600:50, 2].ravel()
    hit = np.isfinite(frame.truth["depth"])[100:400:50, 50:600:50].ravel()
    assert hit.all() and cosine.min() < 0.6
    wavelength, weight = quadrature(*BAND)
    emissivity = scene.materials[0].emissivity_at_angle(wavelength, cosine[:, None])
    own, plate, air = (spectral_radiance(wavelength, t) * weight for t in (300.0, 400.0, 290.0))
    exact = np.zeros(len(cosine))
    without = exact.copy()
    for share, absorption in ((0.6, 2e-3), (0.4, 1e-2)):
        near, far = (np.exp(-absorption * up / cosine)[:, None] for up in (30.0, 60.0))
        for total, through in ((exact, far), (without, 1.0)):
            image = emissivity * own + (1.0 - emissivity) * (through * plate + (1.0 - through) * air)
            total += share * (near * image + (1.0 - near) * air).sum(axis=1)
    seen = frame.radiance[100:400:50, 50:600:50].ravel()
    plan = renderer.plan
    # Of two grids, straight in the logarithm of lengths that are 1.08 apart: ln² 1.08 / 8 of the largest bend of
    # e^(−kd), 0.16, is the share of plate and air's difference; channels and their fit as planned.
    grids = 2.0 * np.log(1.08) ** 2 / 8.0 * 0.161 * (plate - air).sum() / band_radiance_derivative(350.0, *BAND)
    limit = grids + 1e-3 * (plan.spectrum.channels_mk + plan.specular.error_mk)
    error = np.abs(kelvin_apart(seen, exact)).max()
    assert error < limit < 0.1, (error, limit)
    assert np.abs(kelvin_apart(without, exact)).min() > 5.0


@pytest.mark.parametrize(("height", "pitch"), [(1.5, -14.0), *slow((120.0, -45.0)), (3000.0, -60.0)])
@pytest.mark.parametrize("material", ["water_fresnel", *slow("silica_fused")])
def test_level_mirror_behind_air(tmp_path, height, pitch, material):
    # Small faces, because a chord over kilometres would be deep in the air of a round Earth.
    scene = tr.load_scene(write(tmp_path / "s", plane(8.0 * height), material, 290.0, air=AIR))
    renderer = tr.Renderer(scene, rays=2)
    pose = tr.pose(0, 0, height, pitch_deg=pitch)
    frame = renderer.frame(pose)
    pixels = np.isfinite(frame.truth["depth"])[::61, ::73]
    cosine = -directions(scene.camera, pose)[::61, ::73, 2][pixels]
    seen, air = frame.radiance[::61, ::73][pixels], scene.air
    length = height / cosine
    passed, added = air.path(height, (length**2 - height**2) / (2.0 * MEAN_RADIUS_M), length)
    # The mean of its triangles' corners, over the round Earth.
    corner = scene.surfaces[0].vertices[scene.surfaces[0].faces].reshape(-1, 3)
    at_m = np.square(corner[:, :2]).sum(axis=1).mean() / (2.0 * MEAN_RADIUS_M)
    sky, leaving = air.sky_radiance(at_m, cosine), np.empty((len(cosine), air.nodes))
    for node, limits in enumerate(zip(air.lower_um, air.upper_um, strict=True)):
        wavelength, weight = quadrature(*limits)
        own, cool = (spectral_radiance(wavelength, t) * weight for t in (290.0, 300.0))
        emissivity = scene.materials[0].emissivity_at_angle(wavelength, cosine[:, None])
        leaving[:, node] = emissivity @ own / own.sum() * air.planck(290.0)[node]
        leaving[:, node] += (1.0 - emissivity) @ cool / cool.sum() * sky[:, node]
    exact = (passed * leaving).sum(axis=1) + added.sum(axis=1)
    plan = renderer.plan
    # Channels as planned, a thirtieth of the fit's worst error for blackbodies, 2 mK for the grid of lengths, 5 of sky.
    limit = plan.spectrum.channels_mk + plan.specular.error_mk / 30.0 + 2.0 + 5.0
    error = 1e3 * kelvin_apart(seen, exact)
    assert len(cosine) > 20 and np.abs(error).max() < limit, error


def test_a_mirror_image_is_where_geometry_puts_it(tmp_path):
    low, high = np.array([-2.0, 19.0, 3.0]), np.array([1.0, 22.0, 6.0])
    extra = scene_object("hot", high - low, [*(0.5 * (low + high))[:2], low[2]], 600.0, "black")
    scene = tr.load_scene(write(tmp_path / "s", plane(400.0), "water_fresnel", 290.0, extra=extra))
    renderer = tr.Renderer(scene, rays=16, samples=1, taps=1, edge_mk=np.inf)
    pose = tr.pose(0, 0, 5, pitch_deg=-14)
    frame = renderer.frame(pose)
    # From the mirror image of the camera the box appears directly: a ray meets it between its slabs.
    towards, truth = directions(scene.camera, pose), frame.truth
    flipped, eye = towards * [1, 1, -1], np.array([0.0, 0.0, -5.0])
    ends = np.sort(np.stack([(low - eye) / flipped, (high - eye) / flipped]), axis=0)
    water = towards[..., 2] < -0.01
    image = water & (ends[0].max(axis=-1) < ends[1].min(axis=-1))
    cosine = -towards[..., 2]
    angle = np.linspace(0.0, 1.0, 200)
    halfway = 0.5 * sum(shown(scene.materials[0], angle, 290.0, seen) for seen in (600.0, 250.0))
    clear = water & (frame.radiance > np.interp(cosine, angle, halfway))
    direct = truth["material"] == 1
    clear &= ~direct
    image &= ~direct
    assert image.sum() > 1000
    apart = np.argwhere(clear).mean(axis=0) - np.argwhere(image).mean(axis=0)
    assert np.abs(apart).max() < 0.1 and (clear != image).sum() < 0.1 * np.sqrt(image.sum())
    # Away from the outline: the mirrored blackbody of 600 K, or the sky.
    import cv2

    near = np.ones((5, 5), np.uint8)
    inside = cv2.erode(image.astype(np.uint8), near) > 0
    outside = water & ~direct & (cv2.dilate((image | direct).astype(np.uint8), near) == 0) & (cosine > 0.1)
    error_mk = renderer.plan.specular.error_mk
    # One channel estimates the band's reflectance for fire and ground from how these curve between them.
    assert error_mk < 10.0
    for where, seen in ((inside, 600.0), (outside, 250.0)):
        some = frame.radiance[where][::97], shown(scene.materials[0], cosine[where][::97], 290.0, seen)
        error = 1e3 * kelvin_apart(*some)
        assert np.abs(error).max() < (error_mk + 1.0 if seen == 600.0 else 2.0)
    # The image is many kelvin, so an error of its place or strength would be visible.
    assert kelvin_apart(*(shown(scene.materials[0], 0.3, 290.0, seen) for seen in (600.0, 250.0))) > 5.0


@pytest.mark.parametrize("material", ["water_fresnel", "gold_polished", "sheen"])
def test_isothermal_enclosure_with_mirrors_reads_the_wall(tmp_path, material):
    room = trimesh.creation.box(extents=(4, 4, 4)).subdivide()
    room.invert()
    scene = tr.load_scene(write(tmp_path / "s", room, material, sky=200.0))
    renderer = tr.Renderer(scene, rays=64, tolerance_mk=0.5)
    assert renderer.plan.specular
    frame = renderer.frame(tr.pose(-1, 0, 0, yaw_deg=60))
    # A leak would show 200 K; light reflected from black walls is right to a millionth of the worst error of all light.
    assert np.abs(frame.apparent_temperature - 300.0).max() < 1e-3 + 1e-6 * renderer.plan.specular.error_mk


@pytest.mark.parametrize("track", [None, "time_s,yaw_deg\n0,0\n"])
def test_isothermal_air_is_invisible_on_the_way_to_a_mirror_too(tmp_path, track):
    folder = tmp_path / "s"
    rest = 'track = "t.csv"' if track else ""
    wall = scene_object("wall", [200, 2, 60], [0, 150, 0], 290.0, "black") + rest
    # Clouds near the ground, so that the air above the wall is as warm.
    air = '[atmosphere]\nfile = "air.npz"\ncloud_fraction = 1.0\ncloud_base_m = 100.0\n'
    write(folder, plane(400.0), "water_fresnel", 290.0, air=air, extra=wall)
    (folder / "t.csv").write_text(track or "")
    air = Atmosphere.standard("tropical", "rural-5km")
    replace(air, temperature=np.full_like(air.temperature, 290.0)).save(folder / "air.npz")
    frame = tr.Renderer(tr.load_scene(folder), rays=16).frame(tr.pose(0, 0, 4, pitch_deg=-15))
    assert np.abs(frame.apparent_temperature - 290.0).max() < 2e-3


def test_dynamic_mirrors_and_dynamic_objects_in_mirrors(tmp_path):
    frames = []
    for track in (None, "time_s,yaw_deg\n0,30\n"):
        rest = 'track = "t.csv"\n' if track else "yaw_deg = 30\n"
        extra = scene_object("hot", [3, 3, 3], [0, 20, 3], 340.0, "black") + rest
        extra += scene_object("plate", [4, 4, 0.5], [6, 14, 4], 300.0, "gold_polished") + rest
        folder = tmp_path / str(bool(track))
        write(folder, plane(100.0), "water_fresnel", 290.0, extra=extra)
        (folder / "t.csv").write_text(track or "")
        frames.append(tr.Renderer(tr.load_scene(folder), rays=256).frame(tr.pose(1, 0, 6, pitch_deg=-14)))
    still, moving = frames
    apart = np.abs(moving.apparent_temperature - still.apparent_temperature)
    hot = np.isin(still.truth["material"], 1)
    assert (moving.truth["emissivity"][hot] == still.truth["emissivity"][hot]).mean() > 0.999
    # The mirror image of black objects and of mirrors depends on the bake's rays only through what they reflect.
    assert np.percentile(apart, 99) < 0.02 and np.median(apart) < 1e-3
    plate = still.truth["emissivity"] < 0.1
    assert plate.sum() > 1000 and np.percentile(apart[plate], 90) < 0.05


@pytest.mark.parametrize("depth", [*slow(1), 2])
def test_a_mirror_in_a_mirror(tmp_path, monkeypatch, depth):
    """The sky in a wall of gold in water: where the wall is rendered as diffuse, the frame reports its error."""
    monkeypatch.setattr(mirrors, "DEPTH", depth)
    extra = scene_object("wall", [120, 2, 80], [0, 31, 0], 330.0, "gold_polished")
    scene = tr.load_scene(write(tmp_path / "s", plane(400.0), "water_fresnel", 290.0, extra=extra))
    pose = tr.pose(0, 0, 5, pitch_deg=-18)
    renderer = tr.Renderer(scene, rays=1024)
    frame = renderer.frame(pose)
    # From the mirror image of the camera, the wall's front is 30 m ahead.
    towards = directions(scene.camera, pose)
    flipped = towards * [1, 1, -1]
    place = [0, 0, -5] + flipped * (30.0 / flipped[..., 1:2])
    image = (frame.truth["material"] == 0) & (np.abs(place[..., 0]) < 55.0) & (flipped[..., 2] > 0.1)
    image &= (place[..., 2] > 1.0) & (place[..., 2] < 75.0)
    some = tuple(np.argwhere(image)[::211].T)
    wavelength, weight = quadrature(*BAND)
    down, ahead = (np.abs(towards[some][:, axis, None]) for axis in (2, 1))
    water, gold = (
        next(m for m in scene.materials if m.name == name).emissivity_at_angle(wavelength, cosine)
        for name, cosine in (("water_fresnel", down), ("gold_polished", ahead))
    )
    own, wall, sky = (spectral_radiance(wavelength, kelvin) * weight for kelvin in (290.0, 330.0, 250.0))
    exact = (water * own + (1.0 - water) * (gold * wall + (1.0 - gold) * sky)).sum(axis=1)
    error_mk = 1e3 * np.abs(frame.radiance[some] - exact) / band_radiance_derivative(300.0, *BAND)
    told_mk = frame.error_mk[some]
    assert len(error_mk) > 1000 and (error_mk < told_mk).all()
    if depth == 1:
        assert error_mk.max() > 4000.0 and (told_mk < 2.0 * error_mk + 50.0).all()
        assert frame.budget_mk["mirrors"] > 4000.0
    else:
        assert error_mk.max() < renderer.plan.specular.error_mk <= frame.budget_mk["mirrors"] < 30.0


def test_scenes_without_mirrors_cast_no_mirror_rays(tmp_path, monkeypatch):
    casts = []
    cast = Geometry.cast_solid
    monkeypatch.setattr(Geometry, "cast_solid", lambda self, *a, **k: casts.append(k) or cast(self, *a, **k))
    counts, plans, radiance = [], [], []
    classes = np.full((32, 32), 1)
    for name, one, texels in (("diffuse", "water", 1), ("mirror", "water_fresnel", 1), ("unused", "water", 1)):
        other = "water_fresnel" if name == "unused" else "sand_quartz"
        folder = write_terrain(tmp_path / name, classes=classes * texels)
        path = folder / "scene.toml"
        path.write_text(path.read_text().replace("grass_green", one).replace("sand_quartz", other))
        renderer = tr.Renderer(tr.load_scene(folder), rays=16, edge_mk=np.inf)
        _ = renderer.baked
        casts.clear()
        radiance.append(renderer.radiance(tr.pose(0, -4, 6, pitch_deg=-40)))
        counts.append(len(casts))
        plans.append(renderer.plan)
    # A mirror seen in the mirror is a mirror, too.
    assert counts == [1, 3, 1]
    assert np.abs(radiance[1] - radiance[0]).max() > 0.1
    rows = [plan.rows()[-1] for plan in plans]
    assert [row[:2] for row in rows] == [("specular rays", what) for what in ("out", "in", "out")]
    assert "Lambertian" in rows[0][2] and "estimated" in rows[1][2] and rows[2] == rows[0]
    assert [plan.as_dict()["specular"] for plan in plans] == [False, True, False]


def test_the_plan_leaves_mirrors_out_in_an_isothermal_scene(tmp_path):
    plans = [make_plan(tr.load_scene(write(tmp_path / f"{sky}", plane(9.0), "water_fresnel", 300.0, sky)))
             for sky in (300.0, 299.99, 280.0)]  # fmt: skip
    assert [plan.specular is not None for plan in plans] == [False, True, True]
    assert plans[0].specular_mk < 1e-6 and "out" in plans[0].rows()[-1]
    # At 80° water reflects a third of the sky's 10 mK and 20 K.
    scene = tr.load_scene(tmp_path / "280.0")
    for plan, apart in zip(plans[1:], (0.01, 20.0), strict=True):
        share = 1.0 - scene.materials[0].band_emissivity(*BAND, 290.0, np.cos(np.radians(80.0)))
        assert 0.7 * share * apart < plan.specular_mk * 1e-3 < 1.3 * (share + 0.06) * apart
