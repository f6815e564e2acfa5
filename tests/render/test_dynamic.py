"""Dynamic objects: lit like static ones, moved along their tracks, without tracing the scene again."""

import numpy as np
import pytest
from support import slow

import thermorender as tr
from scenes import plane, scene_object, write_mesh, write_terrain
from thermorender.errors import ThermorenderError
from thermorender.formats import write_image
from thermorender.physics.planck import band_radiance, band_radiance_derivative, brightness_temperature
from thermorender.render.light import radiosity
from thermorender.scene.tracks import read_track

BAND = (7.5, 13.5)


def scene_with(folder, track=None, shape="box", size=(3, 3, 1.5), rest="", up_m=0.5, **keywords):
    extra = scene_object("target", size, [1, 2, up_m], 340.0, shape=shape, yaw_deg=30) + rest
    if track:
        extra += 'track = "track.csv"\n'
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "track.csv").write_text(track)
    # Of the materials in the small tests, sand reflects most.
    sand = np.full((66, 66), 2)
    return tr.load_scene(write_terrain(folder, height=np.zeros((33, 33)), classes=sand, extra=extra, **keywords))


@pytest.mark.parametrize(("shape", "size"), slow(("box", (3, 3, 1.5)), ("disc", (3, 3, 1))))
def test_tracked_object_is_lit_as_a_static_one(tmp_path, shape, size):
    pose, rays = tr.pose(1, -6, 8, pitch_deg=-45), 1024
    scene = scene_with(tmp_path / "static", None, shape, size)
    static = tr.Renderer(scene, rays=rays).frame(pose)
    tracked = scene_with(tmp_path / "dynamic", "time_s,yaw_deg\n0,30\n", shape, size)
    dynamic = tr.Renderer(tracked, rays=rays).frame(pose)
    for name in ("kinetic_temperature", "material", "mask", "depth", "emissivity"):
        # A point between two texels may belong to either.
        assert np.mean(~np.isclose(dynamic.truth[name], static.truth[name], rtol=1e-5)) < 1e-4
    assert dynamic.targets == static.targets and dynamic.targets["target"]["visible"]
    difference = 1e3 * (dynamic.apparent_temperature - static.apparent_temperature)
    material = static.truth["material"]
    target = material == material[int(static.targets["target"]["pixel"][1]), int(static.targets["target"]["pixel"][0])]
    near = ~target & (np.linalg.norm(static.truth["position"][..., :2] - [1, 2], axis=-1) < 3.0)
    assert near.sum() > 5000

    def one_face(name, warm, cold, temperature):
        """Standard error [mK] of two frames' difference on one face that sees half warm and half cold."""
        reflected = 1.0 - next(m for m in scene.materials if m.name == name).band_emissivity(*BAND, 300.0)
        contrast = reflected * (band_radiance(warm, *BAND) - band_radiance(cold, *BAND))
        return 1e3 * contrast * np.sqrt(2.0 * 0.25 / rays) / band_radiance_derivative(temperature, *BAND)

    # Sand sees the target at 340 K or the sky at 260 K. A cell of 1 m² is two faces with independent errors.
    error = one_face("sand_quartz", 340.0, 260.0, 290.0)
    faces = 2.0 * (9.0 * np.pi - size[0] * size[1] * (1.0 if shape == "box" else np.pi / 4))
    assert difference[near].std() < error and abs(difference[near].mean()) < 3.0 * error / np.sqrt(faces)
    # Black paint sees ground of at most 300 K, or the sky; one of its faces may fill the picture.
    assert abs(difference[target].mean()) < 3.0 * one_face("paint_black", 300.0, 260.0, 340.0) < 100.0
    # The target's own light on the ground is far larger than any of these errors.
    cold = scene_with(tmp_path / "cold", "time_s,temperature_k\n0,300\n", shape, size)
    change = static.apparent_temperature - tr.Renderer(cold, rays=rays).frame(pose).apparent_temperature
    assert 1e3 * change[near].mean() > 3.0 * 3.0 * error / np.sqrt(faces)


def in_the_sun(folder, track, material="aluminium_sheet", camera="neutrino-lc", size=(8, 8, 0.2), ground="concrete"):
    """A plate over level ground in the sun, at rest or on a track, under a mid-wave camera."""
    extra = scene_object("plate", size, [0, 0, 6.0], 295.0, material)
    if track:
        extra += 'track = "track.csv"\n'
    extra += "[sun]\nelevation_deg = 60.0\nazimuth_deg = 180.0\n"
    mesh = plane(60.0)
    for _ in range(5):
        mesh = mesh.subdivide()
    write_mesh(folder, mesh, 295.0, extra=extra)
    (folder / "track.csv").write_text("time_s,temperature_k\n0,295\n")
    path = folder / "scene.toml"
    text = path.read_text().replace('source = "constant"\nvalue = 0.9', f'source = "material"\nmaterial = "{ground}"')
    path.write_text(text.replace("[sky]\ntemperature = 250.0\n", '[atmosphere]\nstandard = "midlatitude-summer"\n'))
    return tr.Renderer(tr.load_scene(folder).with_camera(camera), quality="high")


@pytest.mark.parametrize("material", ["aluminium_sheet", *slow("roof_rubber_white")])
def test_the_sun_lights_what_moves_and_it_casts_a_shadow(tmp_path, material):
    """As at rest, in 3.7–4.8 µm: 31 K of sunlight on aluminium, 4 K in the shadow on concrete."""
    pose = tr.pose(0, 0, 30, pitch_deg=-90)
    still, moving = (in_the_sun(tmp_path / str(track), track, material).frame(pose) for track in (False, True))
    kelvin = [frame.apparent_temperature.astype(np.float64) for frame in (still, moving)]
    top, east, north = (still.truth["position"][..., axis] for axis in (2, 0, 1))
    plate = top > 6.0
    # 6 m over tan 60°.
    shade = (top < 0.1) & (np.abs(east) < 2.5) & (north > 4.5) & (north < 6.5)
    open_ground = (top < 0.1) & (np.abs(east) > 6.0)
    assert plate.sum() > 5000 and shade.sum() > 1000
    assert np.abs(np.mean(kelvin[1][plate] - kelvin[0][plate])) < 0.2
    assert np.median(kelvin[0][open_ground]) - np.median(kelvin[0][shade]) > 2.0
    assert np.median(kelvin[1][shade]) == pytest.approx(np.median(kelvin[0][shade]), abs=0.3)
    assert np.abs(np.median(kelvin[1][open_ground] - kelvin[0][open_ground])) < 0.1


def test_a_moving_roof_hides_the_image_of_the_sun_in_water(tmp_path):
    pose = tr.pose(0, 30, 30 * np.sqrt(3.0), yaw_deg=180, pitch_deg=-60)
    still, moving = (
        in_the_sun(tmp_path / str(track), track, "paint_black", ground="water_breeze").frame(pose) for track in (0, 1)
    )
    north = still.truth["position"][..., 1]
    water = (still.truth["position"][..., 2] < 0.1) & (np.abs(still.truth["position"][..., 0]) < 2.5)
    shaded = water & (north > 4.5) & (north < 6.5)
    assert shaded.sum() > 100
    difference = (moving.apparent_temperature - still.apparent_temperature)[shaded]
    assert np.abs(np.median(difference)) < 0.2


@pytest.mark.parametrize("kelvin", [*slow(300.0, 340.0), 900.0])
def test_frame_states_the_error_of_a_moving_objects_light(tmp_path, kelvin):
    """Compared with a static object under many rays, on the ground around it."""
    pose, track = tr.pose(1, 2, 14, pitch_deg=-90), f"time_s,temperature_k\n0,{kelvin}\n"
    still = scene_with(tmp_path / "still").with_objects({"target": kelvin})
    still = tr.Renderer(still, quality="high", rays=4096).frame(pose)
    frame = tr.Renderer(scene_with(tmp_path / "moving", track), quality="high", rays=128).frame(pose)
    away = np.linalg.norm(still.truth["position"][..., :2] - [1, 2], axis=-1)
    # Its edges, half a metre wide, are excluded: rays differ there for another reason.
    ground = (away > 2.7) & (away < 5.0)
    error = 1e3 * (frame.radiance - still.radiance)[ground] / band_radiance_derivative(300.0, *BAND)
    off, stated = (np.sqrt(np.mean(np.square(values))) for values in (error, frame.error_mk[ground]))
    assert 0.8 * off < stated < 2.0 * off
    assert 0.5 * off < frame.budget_mk["bake"] < 2.0 * off


def test_object_moves_without_another_trace(tmp_path, monkeypatch):
    scene = scene_with(tmp_path / "s", "time_s,east_m,yaw_deg,temperature_k\n0,-6,350,300\n10,6,10,320\n")
    renderer = tr.Renderer(scene, rays=16)
    _ = renderer.baked
    monkeypatch.setattr(radiosity, "trace", lambda *_: pytest.fail("light was traced again"))
    pose = tr.pose(0, 2, 30, pitch_deg=-90)
    seen = []
    for time_s, east, kelvin in ((-1.0, -6.0, 300.0), (5.0, 0.0, 310.0), (10.0, 6.0, 320.0)):
        frame = renderer.frame(pose, time_s=time_s)
        column, row = frame.targets["target"]["pixel"]
        height = 30.0 - 0.5 - 0.75
        assert column == pytest.approx(320 + scene.camera.focal_length_px * east / height, abs=0.5)
        assert frame.truth["kinetic_temperature"][int(row), int(column)] == pytest.approx(kelvin)
        seen.append(frame)
    # A frame keeps its own truth after the object has moved on.
    column, row = seen[0].targets["target"]["pixel"]
    assert seen[0].truth["kinetic_temperature"][int(row), int(column)] == pytest.approx(300.0)
    back = renderer.frame(pose, time_s=-1.0)
    np.testing.assert_array_equal(back.radiance, seen[0].radiance)
    given = renderer.frame(pose, objects={"target": {"temperature_k": 360.0, "east_m": 1.0}})
    column, row = given.targets["target"]["pixel"]
    assert given.apparent_temperature[int(row), int(column)] > 350.0
    image, known = renderer.visible(pose)
    assert known[int(row), int(column)] and image.any()


def test_heading_turns_the_short_way(tmp_path):
    scene = scene_with(tmp_path / "s", "time_s,yaw_deg\n0,350\n10,10\n")
    (tracked,) = scene.tracked_objects
    assert tracked.at(5.0)["yaw_deg"] % 360.0 == pytest.approx(0.0, abs=1e-9)
    ahead = tracked.world_from_own(tracked.at(5.0), scene.ground)[:3, :3] @ [0, 1, 0]
    np.testing.assert_allclose(ahead, [0, 1, 0], atol=1e-9)


def test_track_is_part_of_the_scene_digest(tmp_path):
    one = scene_with(tmp_path / "a", "time_s,yaw_deg\n0,30\n")
    other = scene_with(tmp_path / "b", "time_s,yaw_deg\n0,31\n")
    assert one.digest() != other.digest()


def test_texture_mapping_of_a_tracked_model_is_part_of_the_scene_digest(tmp_path):
    extra = scene_object("car", file="car.obj", track="car.csv")  # fmt: skip
    folder = write_terrain(tmp_path / "tiny", extra=extra)
    (folder / "car.csv").write_text("time_s,east_m\n0,0\n1,1\n")
    write_image(folder / "car.png", np.arange(48, dtype=np.uint8).reshape(4, 4, 3))
    (folder / "car.mtl").write_text("newmtl paint\nmap_Kd car.png\n")
    model = "mtllib car.mtl\nusemtl paint\nv 0 0 0\nv 1 0 0\nv 0 1 1\nvt 0 0\nvt 1 0\nvt {}\nf 1/1 2/2 3/3\n"
    digests = []
    for corner in ("1 1", "0 1", "1 1"):
        (folder / "car.obj").write_text(model.format(corner))
        digests.append(tr.load_scene(folder).digest())
    assert digests[0] == digests[2] != digests[1]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "lacks time_s"),
        ("time_s,yaw\n0,1\n", "the column 'yaw'"),
        ("time_s,yaw_deg\n", "lacks time_s, another column or rows of numbers"),
        ("time_s,yaw_deg\n0,x\n", "row 2: '0,x' is not 2 finite numbers"),
        ("time_s,yaw_deg\n0,1,2\n", "row 2"),
        ("time_s,yaw_deg\n0,1\n5\n", "row 3: '5' is not 2 finite numbers"),
        ("time_s,yaw_deg\n0,1\n0,2\n", "row 3: time_s does not rise"),
        ("time_s,yaw_deg\n\n0,1\n\n0,2\n", "row 5: time_s does not rise"),
        ("time_s,yaw_deg\n\n0,x\n", "row 3: '0,x' is not 2 finite"),
        ("time_s,yaw_deg\n0,1\0\n", "track.csv is not UTF-8 text .it holds zero bytes.; save it as CSV UTF-8"),
        ("time_s,temperature_k\n0,20\n", "20 is below 100 K"),
        ("time_s,yaw_deg\n0,1e308\n1,-1e308\n", r"yaw_deg=1e\+308 is out of range; give degrees, up to 1e\+06"),
        ("time_s,yaw_deg\n-1e308,0\n1e308,1\n", r"time_s=-1e\+308 is out of range; give seconds, up to 1e\+12"),
    ],
)
def test_bad_tracks(tmp_path, text, words):
    path = tmp_path / "track.csv"
    path.write_text(text)
    with pytest.raises(ThermorenderError, match=words):
        read_track(path)


def test_bad_settings(tmp_path):
    scene = scene_with(tmp_path / "s", "time_s,yaw_deg\n0,30\n")
    renderer = tr.Renderer(scene, rays=4)
    for objects, words in (
        ({"other": {}}, "object 'other' has no track and cannot change; give one that has [(]target[)]"),
        ({"target": {"speed": 1.0}}, "object 'target' has no 'speed' to set"),
        ({"target": {"east_m": np.nan}}, "east_m=nan is not allowed"),
        ({"target": {"east_m": None}}, "east_m=None is not allowed; give a finite number"),
        ({"target": {"temperature_k": [300.0, 310.0]}}, r"temperature_k=.300.0, 310.0. is not allowed; give a finite"),
        ({"target": {"temperature_k": 20.0}}, "20 is below 100 K"),
        ({"target": {"east_m": 1e4}}, "where there is no terrain"),
    ):
        with pytest.raises(ThermorenderError, match=words):
            renderer.frame(tr.pose(0, 0, 30, pitch_deg=-90), objects=objects)
    for name, value in (("index", -1), ("index", 1.5), ("index", 2**64), ("index", None), ("seed", 0.5), ("seed", "a")):
        settings = {name: value} if name == "index" else {}
        with pytest.raises(ThermorenderError, match=f"^{name}=.* is not allowed; give a whole number 0 … 2⁶⁴−1$"):
            made = tr.Renderer.of(renderer.baked, **({name: value} if name == "seed" else {}))
            made.frame(tr.pose(0, 0, 30, pitch_deg=-90), **settings)
    # Without moving objects, a camera passed in place of a time would otherwise go unnoticed.
    for time_s in (np.nan, scene.camera):
        for render in (renderer.frame, renderer.visible):
            with pytest.raises(ThermorenderError, match=r"^time_s=.* is not a time; give a finite number of seconds$"):
                render(tr.pose(0, 0, 30, pitch_deg=-90), time_s=time_s)
    assert brightness_temperature(renderer.frame(tr.pose(0, 0, 30, pitch_deg=-90)).radiance.mean(), *BAND) > 200.0
    with pytest.raises(ThermorenderError, match=r"camera=1.0 is not a Camera; give what load_camera returns"):
        renderer.visible(tr.pose(0, 0, 30, pitch_deg=-90), 1.0)


def test_object_below_the_ground_does_not_light_it(tmp_path):
    """The bake's faces are lit from the front only, so objects below them must not light them either."""
    scene = scene_with(tmp_path / "s", "time_s,above_ground_m\n0,-3\n")
    renderer, pose = tr.Renderer(scene, rays=64), tr.pose(1, 2, 10, pitch_deg=-90)
    below, hotter = (renderer.radiance(pose, objects={"target": {"temperature_k": k}}) for k in (300.0, 900.0))
    np.testing.assert_array_equal(hotter, below)
    # Half of it below: the part above still lights the ground.
    above, hotter = (
        renderer.radiance(pose, objects={"target": {"temperature_k": k, "above_ground_m": -0.75}}) for k in (300, 900)
    )
    assert (hotter > above).mean() > 0.9


@pytest.mark.slow
def test_half_buried_tracked_object_is_lit_as_a_static_one(tmp_path):
    moving = scene_with(tmp_path / "moving", "time_s,above_ground_m\n0,-0.5\n")
    still = scene_with(tmp_path / "still", up_m=-0.5)
    pose = tr.pose(1, 2, 12, pitch_deg=-90)
    one, other = (tr.Renderer(one, rays=512).frame(pose) for one in (still, moving))
    ground = one.truth["kinetic_temperature"] != 340.0
    apart = 1e3 * (other.apparent_temperature - one.apparent_temperature)[ground]
    assert ground.sum() > 100_000 and abs(apart.mean()) < 20.0


def test_only_mirror_may_be_a_tracked_object(tmp_path):
    folder = tmp_path / "s"
    scene_with(folder, "time_s,yaw_deg\n0,30\n")
    toml = folder / "scene.toml"
    toml.write_text(toml.read_text().replace("paint_black", "aluminium_polished"))
    frame = tr.Renderer(tr.load_scene(folder), rays=16).frame(tr.pose(1, 2, 10, pitch_deg=-90))
    target = frame.truth["kinetic_temperature"] == 340.0
    # It is at 340 K, but nearly all of its radiance is reflected sky at 260 K.
    assert frame.plan["specular"] and abs(np.median(frame.apparent_temperature[target]) - 260.0) < 15.0


def test_the_truth_of_rays_cast_before_is_that_of_rays_cast_again(tmp_path):
    track = "time_s,east_m\n0,-3\n1,3\n"
    scene = scene_with(tmp_path, track)
    renderer = tr.Renderer(scene, "fast", rays=4)
    pose = tr.pose(0, -12, 6, pitch_deg=-20)
    frame, late = (renderer.frame(pose, 0.6) for _ in range(2))
    before, again = frame.truth, renderer.frame_of(frame.radiance, pose, {}, 0.6).truth
    assert list(before) == list(again) and {0, 1} == set(np.unique(before["object"]))
    assert 0.2 < np.isfinite(before["depth"]).mean() < 0.9
    for name, image in before.items():
        np.testing.assert_array_equal(image, again[name], err_msg=name)
    # The rays of a later frame are not those of this one.
    renderer.frame(tr.pose(0, -12, 9, pitch_deg=-40), 0.1)
    np.testing.assert_array_equal(late.truth["depth"], before["depth"])
    # With several rays per pixel none goes through the middle.
    several = tr.Renderer(scene, samples=4, rays=4).frame(pose, 0.6)
    np.testing.assert_array_equal(several.truth["depth"], before["depth"])
