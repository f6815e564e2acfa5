"""Parts of a pixel's radiance: closed cases, and the path tracer of `path_tracer`."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from path_tracer import PathTracer
from support import slow

import thermorender as tr
from scenes import narrow, scene_object, write_mesh, write_terrain
from thermorender.errors import ThermorenderError
from thermorender.physics.band import emitted_radiance
from thermorender.physics.planck import band_radiance

BAND = (7.5, 13.5)
WALL = scene_object("wall", [8.0, 1.0, 6.0], [0.0, 3.0, 3.0], temperature=340.0)
POSE = {"pitch_deg": -60.0, "yaw_deg": 0.0}


def plane(folder, track="", side=24, **more):
    """A level plane of one temperature with a warm black wall on it, seen by a camera of few pixels."""
    write_terrain(
        folder, np.zeros((side, side)), np.full((2 * side, 2 * side), 300.0), extra=WALL + track, sky=250.0, **more
    )
    return small(tr.load_scene(folder)).with_material(wall=1.0)


def small(scene, width=12, height=10):
    camera = scene.camera
    wide = camera.pixel_pitch_um * camera.width / width
    return scene.with_camera(replace(camera, width=width, height=height, pixel_pitch_um=wide))


def every(renderer, pose, **more):
    camera = renderer.scene.camera
    return renderer.parts_at(pose, np.argwhere(np.ones((camera.height, camera.width), bool)), **more)


def mean(found, part):
    return float(np.mean([each.radiance[part] for each in found]))


def test_black_surface_only_emits(tmp_path):
    scene = plane(tmp_path / "s").with_material(grass_green=1.0, sand_quartz=1.0)
    renderer, pose = tr.Renderer(scene, rays=16), tr.pose(0, -6, 8, **POSE)
    for each in every(renderer, pose):
        expected = band_radiance(340.0 if each.object else 300.0, *BAND)
        others = sum(abs(value) for part, value in each.radiance.items() if part != "emission")
        assert each.radiance["emission"] == pytest.approx(expected, rel=1e-6) and others < 1e-4
        assert each.apparent_k == pytest.approx(each.kinetic_k, abs=1e-3)


def test_isothermal_enclosure_adds_up_to_a_blackbody(tmp_path):
    room = trimesh.creation.box(extents=(4, 4, 4)).subdivide()
    room.invert()
    scene = small(tr.load_scene(write_mesh(tmp_path / "room", room, emissivity=0.6, sky=200.0)))
    for each in every(tr.Renderer(scene, rays=64, tolerance_mk=0.5), tr.pose(-1, 0, 0, yaw_deg=60.0)):
        black = band_radiance(300.0, *BAND)
        assert sum(each.radiance.values()) == pytest.approx(black, rel=1e-4)
        assert each.radiance["emission"] == pytest.approx(0.6 * black, rel=1e-6)
        assert each.radiance["surroundings"] == pytest.approx(0.4 * black, rel=1e-3)
        assert each.radiance["sky"] == each.radiance["sun"] == each.radiance["air"] == 0.0
        assert each.apparent_k == pytest.approx(300.0, abs=0.01)


@pytest.mark.slow
def test_parts_are_those_of_the_path_tracer(tmp_path):
    """Of a grey plane under the sky beside a black wall, each cause of light is one path tracing less the other."""
    scene = plane(tmp_path / "s", side=12).with_material(grass_green=0.7, sand_quartz=0.7)
    pose, dark = tr.pose(0, -3, 6, pitch_deg=-80.0), scene.with_sky("0 K", surroundings=300.0)
    scene = scene.with_sky(250.0, surroundings=300.0)
    found = every(tr.Renderer(scene, quality="high", rays=1024), pose)
    assert not any(each.object for each in found)
    images = [[PathTracer(each).image(pose, 96, seed) for seed in range(4)] for each in (scene, dark)]
    whole, without = (np.array(each).mean(axis=(1, 2)) for each in images)
    emitted = 0.7 * band_radiance(300.0, *BAND)
    expected = {"emission": np.full(4, emitted), "sky": whole - without, "surroundings": without - emitted}
    for part, values in expected.items():
        error = max(values.std(ddof=1) / 2.0, 5e-4)
        assert error < 0.025 and abs(mean(found, part) - values.mean()) < 4.0 * error, part


@pytest.mark.parametrize("case", ["plain", *slow("air"), "mirror", "track"])
def test_parts_add_up_to_the_image(tmp_path, case):
    """Pixels smaller than texel and face read what the rays through their middles meet."""
    more = {
        "plain": {},
        "air": {"air": "midlatitude-summer"},
        "mirror": {"material": "water_fresnel"},
        "track": {"track": 'track = "t.csv"\n'},
    }[case]
    folder = tmp_path / "s"
    folder.mkdir()
    (folder / "t.csv").write_text("time_s,yaw_deg\n0,0\n", encoding="utf-8")
    plane(folder, track=more.get("track", ""), classes=np.ones((48, 48)))
    scene = narrow(tr.load_scene(folder), 12, 10)
    if "air" in more:
        scene = scene.with_air(more["air"]).with_sun(50.0, 160.0)
    if "material" in more:
        scene = scene.with_material(grass_green=more["material"])
    renderer, pose = tr.Renderer(scene, rays=256, edge_mk=np.inf), tr.pose(0, -6, 8, **POSE)
    image, found = renderer.radiance(pose), every(renderer, pose)
    off = [(sum(each.radiance.values()) - image[each.pixel]) / renderer.plan.radiance_per_mk for each in found]
    assert np.abs(off).max() < 1.0
    ground = [each for each in found if each.object == "" and each.material]
    assert ground and all(np.isfinite(each.range_m) and 0.0 <= each.angle_deg < 90.0 for each in ground)
    for each in ground:
        kind = next(material for material in scene.materials if material.name == each.material)
        emits = emitted_radiance(lambda wave, kind=kind, each=each: kind.emissivity_at_angle(
            wave, np.cos(np.radians(each.angle_deg))), 300.0, *BAND)  # fmt: skip
        share = 1.0 if case != "air" else pytest.approx(1.0, abs=0.02)
        assert each.radiance["emission"] / emits == pytest.approx(share, abs=2e-5) or case == "air"
        assert each.kinetic_k == 300.0 and each.radiance["sky"] >= 0.0
    if case == "air":
        assert all(each.radiance["air"] > 0.0 for each in ground) and mean(ground, "sun") > 0.0


def test_a_pixel_outside_the_image_is_refused(tmp_path):
    renderer = tr.Renderer(plane(tmp_path / "s"), rays=16)
    for pixels in ([(10, 0)], [(0, 12)], [(-1, 0)], [(0.5, 1)], (3, 4)):
        with pytest.raises(ThermorenderError, match=r"rows 0…9 and columns 0…11"):
            renderer.parts_at(tr.pose(0, -6, 8, **POSE), pixels)


def test_no_part_is_negative_beside_walls_of_texels_in_other_light(tmp_path):
    """A level roof sees the sky alone, whatever the walls receive whose texels its faces blend with."""
    height = np.zeros((24, 24))
    height[8:15, 7:16] = 3.0
    write_terrain(tmp_path / "s", height, np.full((48, 48), 300.0), sky=150.0)
    scene = small(tr.load_scene(tmp_path / "s"), 48, 40).with_material(grass_green=0.5, sand_quartz=0.5)
    renderer, pose = tr.Renderer(scene, rays=64), tr.pose(0, 0, 20, pitch_deg=-90.0)
    found, position = every(renderer, pose), renderer.frame(pose).truth["position"]
    assert min(min(*each.radiance.values(), *each.kelvin.values()) for each in found) >= 0.0
    roof = [each for each in found if position[each.pixel][2] > 2.99]
    assert len(roof) > 100 and max(each.radiance["surroundings"] for each in roof) < 1e-5
    inner = [each for each in roof if np.abs(position[each.pixel][:2] - [-0.5, 0.5]).max() < 2.0]
    sky = 0.5 * band_radiance(150.0, *BAND)
    assert len(inner) > 30 and all(each.radiance["sky"] == pytest.approx(sky, rel=1e-4) for each in inner)


@pytest.mark.slow
def test_a_moving_object_takes_the_sun_from_the_ground_in_its_shadow(tmp_path):
    folder = tmp_path / "s"
    folder.mkdir()
    (folder / "t.csv").write_text("time_s,yaw_deg\n0,0\n", encoding="utf-8")
    plane(folder, track='track = "t.csv"\n')
    scene = small(tr.load_scene(folder)).with_material(grass_green=0.5, sand_quartz=0.5)
    scene = scene.with_air("midlatitude-summer").with_sun(45.0, 180.0)
    renderer, pose = tr.Renderer(scene, rays=64), tr.pose(0, 6, 20, pitch_deg=-90.0)
    found, position = every(renderer, pose), renderer.frame(pose).truth["position"]
    ground = [(each, position[each.pixel]) for each in found if each.material and not each.object]
    # The wall stands 3 to 9 m high, its northern side at 3.5 m north. Faces of 1 m are shaded as a whole or not.
    shade = [each.radiance["sun"] for each, (x, y, _) in ground if abs(x) < 3.0 and 7.5 < y < 11.5]
    lit = [each.radiance["sun"] for each, (x, y, _) in ground if abs(x) > 5.5 or y < 5.5]
    assert len(shade) > 10 and len(lit) > 30 and max(shade) < 1e-9
    # The warm wall adds to the surroundings, not to the sun.
    assert min(lit) > 0.06 and max(lit) / min(lit) < 1.01


@pytest.mark.parametrize("case", ["plain", "mirror", "track"])
def test_pixels_beyond_the_scene_show_background_alone(tmp_path, case):
    """Sky above and the surroundings below the horizon, which are 290 K."""
    folder = tmp_path / "s"
    folder.mkdir()
    (folder / "t.csv").write_text("time_s,yaw_deg\n0,0\n", encoding="utf-8")
    plane(folder, track='track = "t.csv"\n' if case == "track" else "")
    scene = small(tr.load_scene(folder)).with_sky(250.0, surroundings=290.0)
    scene = scene.with_material(grass_green="water_fresnel" if case == "mirror" else 0.9)
    renderer = tr.Renderer(scene, rays=8)
    for pitch_deg, kelvin in ((40.0, 250.0), (-15.0, 290.0)):
        (found,) = renderer.parts_at(tr.pose(0, 13, 2, yaw_deg=0.0, pitch_deg=pitch_deg), [[5, 6]])
        assert found.radiance.pop("background") == pytest.approx(band_radiance(kelvin, *BAND), rel=1e-6)
        assert not any(found.radiance.values()) and found.material == found.object == ""
        assert np.isnan([found.kinetic_k, found.emissivity, found.angle_deg]).all() and np.isinf(found.range_m)
