"""Edits of a scene: the order does not matter, no part is left stale, and each value has a short repr.

The scenes are of 16 × 16 posts; a frame has 16 × 12 pixels.
"""

import copy
import dataclasses
import itertools
import pickle

import numpy as np
import pytest
import trimesh
from scene_content import different

import thermorender as tr
from scenes import CAMERA, MARKER, NARROW, WEATHER, frame_of, write_balance, write_mesh, write_terrain
from thermorender.errors import ThermorenderError
from thermorender.learned.temperature_map import MODELS
from thermorender.materials.library import load_library
from thermorender.render.plan import make_plan
from thermorender.scene.spec import AtmosphereSpec, EmissivitySpec, TemperatureSpec, WeatherSpec
from thermorender.scene.surface import SURFACE
from thermorender.scene.temperature_state import Available, Balance, Moved, Pending

pytestmark = pytest.mark.usefixtures("short_heat")

AT = "2018-07-28T15:00Z"
CAR = MARKER.replace("marker", "car") + 'track = "car.csv"\n'


def written(folder, extra=WEATHER + MARKER):
    return tr.load_scene(write_terrain(folder, extra=extra)).with_camera(CAMERA)


@pytest.fixture(scope="module")
def weathered(tmp_path_factory):
    """A raster of kelvin, two classes, weather, truth and one object."""
    return written(tmp_path_factory.mktemp("weathered") / "tiny")


@pytest.fixture(scope="module")
def balanced(tmp_path_factory):
    """The same at the temperatures of its heat balance, under air."""
    scene = tr.load_scene(write_balance(tmp_path_factory.mktemp("balanced") / "tiny", WEATHER + MARKER))
    return scene.with_camera(CAMERA).with_air("midlatitude-summer")


@pytest.fixture(scope="module")
def solved(balanced):
    return tr.Renderer(balanced, rays=2, samples=1).scene


def test_numbers_and_points_of_numpy_are_those_of_python(weathered):
    number, point = np.float32, np.array([1.0, 2.0, 3.0])
    given = (number(1.0), np.int64(2), number(30.0))
    for pose in (tr.pose, weathered.pose):
        np.testing.assert_array_equal(pose(*given, look_at=point), pose(1.0, 2.0, 30.0, look_at=(1.0, 2.0, 3.0)))
    edits = [
        lambda n: weathered.with_sky(n(250.0), n(260.0)), lambda n: weathered.with_temperature(n(300.0)),
        lambda n: weathered.with_air("tropical").with_sun(n(30.0), n(150.0)),
        lambda n: weathered.with_material({1: n(0.5)}), lambda n: weathered.with_objects({"marker": n(310.0)}),
    ]  # fmt: skip
    for edit in edits:
        assert edit(number).digest() == edit(float).digest()


# --- order --------------------------------------------------------------------------------------------------------

EDITS = {
    "camera": lambda scene: scene.with_camera(NARROW),
    "air": lambda scene: scene.with_air("tropical"),
    "weather's air": lambda scene: scene.with_air("weather"),
    "sky": lambda scene: scene.with_sky(240.0),
    "sun": lambda scene: scene.with_sun(40.0, 150.0),
    "no sun": lambda scene: scene.with_sun(None),
    "weather": lambda scene: scene.with_weather(wind_m_s=6.0),
    "kelvin": lambda scene: scene.with_temperature(305.0),
    "balance": lambda scene: scene.with_temperature("balance"),
    "map": lambda scene: scene.with_temperature("fok-1to1"),
    "material": lambda scene: scene.with_material(grass_green="soil_loam"),
    "class": lambda scene: scene.with_material({2: 0.8}),
    "object's material": lambda scene: scene.with_material(marker="sand_quartz"),
    "object": lambda scene: scene.with_objects({"marker": {"temperature_k": 310.0, "east_m": -2.0}}),
    "learned materials": lambda scene: scene.with_learned_materials(
        EmissivitySpec("learned", model="procedural", fallback="sand_quartz")
    ),
    "instant": lambda scene: scene.at(AT),
}
# The last edit counts here, as the second declares the same as the first.
SAME = [
    {"air", "sky"}, {"air", "weather's air"}, {"sky", "weather's air"}, {"sun", "no sun"}, {"kelvin", "balance"},
    {"kelvin", "map"}, {"balance", "map"},
]  # fmt: skip
# Each edit refuses what the other declares.
CONTRADICT = [{"sun", "balance"}, {"class", "learned materials"}, {"instant", "map"}]
PAIRS = [set(pair) for pair in itertools.combinations(EDITS, 2)]


# Seconds each, as a map is applied to each scene: one pair of them is quick enough.
LEARNED = [pair for pair in PAIRS if "learned materials" in pair and pair != {"material", "learned materials"}]


@pytest.mark.parametrize(
    "pair",
    [
        pytest.param(sorted(pair), marks=[pytest.mark.slow] if pair in LEARNED else [])
        for pair in PAIRS
        if pair not in SAME + CONTRADICT
    ],
    ids=" and ".join,
)
def test_two_edits_in_either_order_make_the_same_scene(weathered, pair):
    """Under air where the sun needs it."""
    base = weathered if "sun" not in pair or pair == ["sky", "sun"] else weathered.with_air("midlatitude-summer")
    one, two = (EDITS[name] for name in pair)
    both = two(one(base))
    assert different(both, one(two(base))) == []
    assert (both.digest(), both.spec) != (base.digest(), base.spec)


@pytest.mark.parametrize("pair", [sorted(pair) for pair in CONTRADICT[:2]], ids=" and ".join)
def test_edits_that_contradict_each_other_are_refused_in_either_order(weathered, pair):
    one, two = (EDITS[name] for name in pair)
    for first, second in ((one, two), (two, one)):
        with pytest.raises(ThermorenderError):
            second(first(weathered))


@pytest.mark.parametrize("band_um", [(8.0, 14.0), (8.0, 12.0), (7.5, 9.0)])
def test_air_follows_the_band_of_a_later_camera(weathered, band_um):
    """If the air keeps the old band, a camera set after the air has an error of +0.57, +24 and +94 K."""
    camera = dataclasses.replace(CAMERA, band_um=band_um)
    after = weathered.with_air("tropical").with_camera(camera)
    before = weathered.with_camera(camera).with_air("tropical")
    assert (after.air.lower_um.min(), after.air.upper_um.max()) == pytest.approx(band_um)
    assert frame_of(after).tobytes() == frame_of(before).tobytes()


# --- no edit may leave a part stale ---------------------------------------------------------------------------------


def test_no_part_of_a_scene_can_be_replaced_alone(weathered):
    with pytest.raises(TypeError):
        dataclasses.replace(weathered, camera=NARROW)
    with pytest.raises(ThermorenderError, match="would leave parts of it stale; use with_camera, with_air, with_sky"):
        weathered.__replace__(camera=NARROW)
    for name in ("camera", "spec", "air", "time", "surfaces", "materials", "weather"):
        with pytest.raises(ThermorenderError, match=rf"scene.{name} cannot be set; use with_camera"):
            setattr(weathered, name, None)
    with pytest.raises(ThermorenderError, match=r"scene.camera cannot be deleted"):
        del weathered.camera
    assert copy.copy(weathered).digest() == weathered.digest()


def test_temperatures_follow_the_declaration(weathered):
    """Replacing only the specification left them unchanged, 47 K off."""
    warm = weathered.with_temperature(345.0)
    assert warm.spec.temperature == TemperatureSpec("constant", value=345.0)
    assert (warm.surfaces[0].temperature == 345.0).all() and (frame_of(warm) > 1.3 * frame_of(weathered)).any()
    back = warm.with_temperature(weathered.spec.folder / "temperature.tif")
    assert back.digest() == weathered.digest()
    np.testing.assert_array_equal(frame_of(back), frame_of(weathered))
    learned = weathered.with_temperature(MODELS["fok-1to1"])
    assert learned.digest() == weathered.with_temperature("fok-1to1").digest()
    assert list(learned.temperature_state.report) == ["fok-1to1"]


def test_emissivity_follows_the_declaration(tmp_path):
    """Replacing only the specification left it unchanged, 15.6 K off."""
    scene = tr.load_scene(write_mesh(tmp_path / "m", trimesh.creation.box((40, 40, 2)))).with_camera(CAMERA)
    dark = scene.with_material(constant=0.6)
    direct = tr.load_scene(write_mesh(tmp_path / "d", trimesh.creation.box((40, 40, 2)), emissivity=0.6))
    np.testing.assert_array_equal(frame_of(dark), frame_of(direct.with_camera(CAMERA)))
    assert frame_of(dark).mean() < 0.95 * frame_of(scene).mean()


def test_temperatures_follow_an_edit_of_time_or_weather(balanced, solved):
    """Replacing only `weather.time` left them unchanged, 18.5 K off."""
    later = balanced.at("2018-07-28T01:00Z")
    assert later.time == later.spec.weather.time and isinstance(later.temperature_state, Pending)
    asked = balanced.with_weather(time="2018-07-28T01:00Z")
    assert asked.digest() == later.digest()
    cold = tr.Renderer(later, rays=2, samples=1).scene
    assert cold.temperature_state.time == later.time and cold.sun is None and solved.sun is not None
    assert solved.surfaces[0].temperature.mean() - cold.surfaces[0].temperature.mean() > 10.0


def test_solved_temperatures_are_asked_for_again_after_an_edit_they_depend_on(balanced, solved):
    """They stayed unchanged, up to 18.5 K off."""
    assert isinstance(solved.temperature_state, Available) and isinstance(solved.temperature_state.source, Balance)
    edited, unsolved = (each.with_surfaces(materials=each.materials[::-1]) for each in (solved, balanced))
    assert isinstance(edited.temperature_state, Pending) and isinstance(edited.temperature_state.source, Balance)
    assert np.isnan(edited.surfaces[0].temperature).all() and edited.digest() == unsolved.digest()
    with pytest.raises(ThermorenderError, match="are not solved yet"):
        make_plan(edited)


def test_another_air_keeps_the_sun_of_a_solved_scene(solved):
    azimuth, elevation = map(float, solved.weather.sun(solved.time))
    sun = solved.with_air("tropical").sun
    assert (sun.elevation_deg, sun.azimuth_deg) == pytest.approx((elevation, azimuth)) and elevation > 30.0
    assert solved.with_sky(250.0).sun is None and solved.with_sky(250.0).with_air("tropical").sun == sun


def test_air_uses_its_own_altitude(weathered):
    """The specification's air was ignored and its altitude obeyed."""
    high = weathered.with_air(AtmosphereSpec(standard="tropical", altitude_m=2000.0))
    assert high.altitude_m == 2000.0 and high.sky_temperature < weathered.with_air("tropical").sky_temperature - 5.0
    # Another air does not keep it; that of the scene file belongs to the place and stays.
    assert high.with_sky(250.0).with_air("tropical").digest() == weathered.with_air("tropical").digest()
    text = (weathered.spec.folder / "scene.toml").read_text()
    folder = weathered.spec.folder.parent / "high"
    write_terrain(folder)
    air = '[atmosphere]\nstandard = "tropical"\naltitude_m = 2000\n'
    (folder / "scene.toml").write_text(text.replace("[sky]\ntemperature = 260.0\n", air))
    assert tr.load_scene(folder).with_sky(250.0).with_air("midlatitude-winter").altitude_m == 2000.0


def test_removing_the_air_restores_the_declared_sky(weathered):
    """`air=None` was a TypeError."""
    assert weathered.with_air("tropical").with_air(None).digest() == weathered.digest()
    folder = weathered.spec.folder.parent / "aired"
    write_terrain(folder)
    text = (folder / "scene.toml").read_text()
    text = text.replace("[sky]\ntemperature = 260.0", '[atmosphere]\nstandard = "tropical"')
    (folder / "scene.toml").write_text(text)
    with pytest.raises(ThermorenderError, match=r"with_air\(None\) leaves the scene without a sky; call with_sky"):
        tr.load_scene(folder).with_air(None)


def test_an_object_has_the_temperature_and_place_declared(weathered, tmp_path):
    warm = weathered.with_objects({"marker": 400.0})
    assert warm.spec.objects[0].temperature == 400.0 and (warm.surfaces[1].temperature == 400.0).all()
    moved = weathered.with_objects({"marker": {"east_m": -4.0, "yaw_deg": 30.0}})
    assert moved.targets["marker"][0] == pytest.approx(-4.0) and moved.spec.objects[0].yaw_deg == 30.0
    # The ground is finer where the object is now.
    near = np.linalg.norm(moved.surfaces[0].vertices[:, :2] - [-4.0, 1.0], axis=1) < 1.5
    assert near.sum() > 3 * (np.linalg.norm(weathered.surfaces[0].vertices[:, :2] - [-4.0, 1.0], axis=1) < 1.5).sum()
    direct = tmp_path / "direct"
    write_terrain(direct, extra=WEATHER + MARKER.replace("[2.0, 1.0, 0.0]", "[-4.0, 1.0, 0.0]\nyaw_deg = 30"))
    np.testing.assert_array_equal(frame_of(moved), frame_of(tr.load_scene(direct).with_camera(CAMERA)))


def test_an_edit_fixes_a_column_of_a_track(tmp_path):
    write_terrain(tmp_path / "t", extra=CAR)
    (tmp_path / "t/car.csv").write_text("time_s,east_m,temperature_k\n0,0,310\n10,3,330\n")
    scene = tr.load_scene(tmp_path / "t").with_camera(CAMERA)
    (car,) = scene.with_objects({"car": 300.0}).tracked_objects
    assert car.at(5.0)["temperature_k"] == 300.0 and car.at(5.0)["east_m"] == 1.5
    assert scene.tracked_objects[0].at(5.0)["temperature_k"] == 320.0
    assert scene.with_objects({"car": 300.0}).digest() != scene.digest()


def test_kelvin_of_a_raster_or_number_stay_when_a_material_is_edited(weathered):
    raster, name = weathered, weathered.materials[0].name
    number = raster.with_temperature(291.0)
    by_material = raster.with_temperature(TemperatureSpec(source="material", materials={name: 300.0}))
    for scene, kept in ((raster, True), (number, True), (by_material, False)):
        edited = scene.with_material({scene.materials[1].name: "snow"})
        assert np.shares_memory(edited.surfaces[0].temperature, scene.surfaces[0].temperature) == kept
        assert edited.materials != scene.materials


def test_a_material_is_replaced_everywhere_it_is_used(weathered):
    names = [each.name for each in weathered.materials]
    assert names == ["grass_green", "sand_quartz", "asphalt"]
    snow = weathered.with_material(grass_green="snow", marker="snow")
    assert [each.name for each in snow.materials] == ["snow", "sand_quartz"]
    assert (snow.surfaces[1].material == 0).all()
    np.testing.assert_array_equal(snow.surfaces[0].material, weathered.surfaces[0].material)
    # All at once, by the names of the files.
    swapped = weathered.with_material(grass_green="sand_quartz", sand_quartz="grass_green")
    assert [each.name for each in swapped.materials] == ["sand_quartz", "grass_green", "asphalt"]
    own = dataclasses.replace(load_library()["grass_green"], solar_absorptance=0.5)
    assert weathered.with_material(grass_green=own).materials[0] is own
    assert weathered.with_material({1: 0.7}).materials[0].emissivity_at(np.array([10.0])) == pytest.approx(0.7)


def test_a_raster_in_memory_is_a_source(weathered):
    kelvin = np.full(weathered.surfaces[0].material.shape, 301.0)
    kelvin[0, 0] = np.nan
    given = weathered.with_temperature(TemperatureSpec("raster"), kelvin=[kelvin])
    assert (given.surfaces[0].temperature == 301.0).all() and given.surfaces[0].flags[0, 0] != SURFACE
    assert given.with_camera(NARROW).surfaces[0].temperature is given.surfaces[0].temperature
    trained = WeatherSpec(np.datetime64("2018-07-28T09:00:00"), air_low_c=5.0, air_high_c=9.0, humidity=0.9,
                          wind_m_s=6.0, cloud=1.0)  # fmt: skip
    moved = weathered.with_temperature(TemperatureSpec("raster", trained=trained), kelvin=[kelvin])
    assert isinstance(moved.temperature_state.source, Moved) and moved.temperature_state.source.trained == trained
    assert isinstance(moved.with_material(grass_green="snow").temperature_state.source, Moved)


def test_a_truth_raster_is_of_its_own_weather(weathered):
    assert weathered.with_weather(cloud=0.9).spec.truth_temperature is None
    assert weathered.with_weather(time=str(weathered.time) + "Z").spec.truth_temperature is not None


# --- refusals -----------------------------------------------------------------------------------------------------


def test_a_sun_without_air_is_refused_when_the_scene_is_rendered(weathered):
    shone = weathered.with_sun(30.0, 180.0)
    with pytest.raises(ThermorenderError, match=r"has no air; call with_air, or with_sun\(None\)"):
        tr.Renderer(shone, rays=1)
    assert frame_of(shone.with_sun(None)).tobytes() == frame_of(weathered).tobytes()


def test_the_renderer_refuses_a_scene_of_surfaces_that_cannot_be_rendered(weathered):
    ground = weathered.surfaces[0]
    cold = dataclasses.replace(ground, temperature=np.full_like(ground.temperature, np.nan))

    def made(surface=ground, count=1, **changes):
        return tr.Scene.of_surfaces(dataclasses.replace(weathered.spec, objects=(), **changes), [surface],
                                    weathered.materials[:count], CAMERA)  # fmt: skip

    renderer = tr.Renderer(made(count=2), rays=1, samples=1)
    cases = [
        (made(), "a texel has material number 1, but the scene has 1 materials"),
        (made(dataclasses.replace(ground, material=0 * ground.material), sky_temperature=None),
         r"the scene has neither sky nor air; call with_sky\(kelvin\) or with_air\(name\)"),
        (made(dataclasses.replace(cold, material=0 * ground.material)), "texels of the terrain have no temperature"),
    ]  # fmt: skip
    for scene, words in cases:
        for use in (lambda s: tr.Renderer(s, rays=1), make_plan, renderer.baked.solved_for):
            with pytest.raises(ThermorenderError, match=words) as error:
                use(scene)
            assert "\n" not in str(error.value)


# --- reprs --------------------------------------------------------------------------------------------------------


def test_reprs_take_a_line_or_two(weathered, balanced, solved):
    """A scene took 147,867 characters, a plan 35,384."""
    renderer = tr.Renderer(weathered, rays=2, samples=1)
    frame = renderer.frame(tr.pose(0, 0, 12, pitch_deg=-90))
    values = [weathered, balanced, solved, weathered.surfaces[0], renderer, renderer.baked, renderer.plan, frame,
              balanced.air, weathered.camera, weathered.materials[0], MODELS["fok-1to1"]]  # fmt: skip
    for value in values:
        assert len(repr(value)) < 260 and repr(value).count("\n") < 2, repr(value)
        assert repr(value).startswith(type(value).__name__ + "("), repr(value)
    for value in (weathered, balanced, solved, renderer.plan, MODELS["fok-1to1"]):
        assert 4 < len(str(value).splitlines()) <= 15 and max(map(len, str(value).splitlines())) < 260, str(value)
    shown = [
        (weathered, ("'tiny'", "1025 texels of 0.5 m", "285.0–300.0 K", "sky of 260 K", "zenmuse-xt2 16×12")),
        (balanced, ("to be solved for 2018-07-28T12:00:00Z", "m above sea level")),
        (solved, (" K at 2018-07-28T12:00:00Z",)),
        (weathered.surfaces[0], ("'terrain'", "triangles", "32×32 texels of 0.5 m", "K")),
        (renderer.plan, ("nodes", "rays", "mK")),
        (frame, ("16×12", "K", "zenmuse-xt2")),
        (weathered.camera, ("zenmuse-xt2", "16×12", "7.5–13.5 µm", "°")),
        (weathered.materials[0], ("grass_green", "µm", "emissivity")),
        (MODELS["fok-1to1"], ("fok-1to1", "7.5–13.5 µm", "°C")),
    ]
    for value, words in shown:
        for word in words:
            assert word in repr(value), (word, repr(value))


def test_a_scene_equals_only_itself_and_is_hashable(weathered):
    """`scene == other` and `hash(scene)` raised."""
    same = tr.load_scene(weathered.spec.folder)
    assert weathered == weathered and weathered != same and len({weathered, same}) == 2
    baked = tr.Renderer(weathered, rays=2, samples=1).baked
    assert pickle.loads(pickle.dumps(baked)).scene.digest() == weathered.digest()
    for value in (weathered.surfaces[0], baked.plan):
        assert value == value and hash(value) is not None and value != copy.copy(value)
