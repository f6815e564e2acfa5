"""What a scene is given: it cannot be changed from outside, and impossible arguments are refused in one sentence."""

import dataclasses
import pickle

import numpy as np
import pytest
from support import slow

import thermorender as tr
from scenes import CAMERA, MARKER, WEATHER, frame_of, scene_object, write_balance, write_terrain
from thermorender.atmosphere.model import Atmosphere
from thermorender.errors import ThermorenderError
from thermorender.physics.planck import band_radiance
from thermorender.scene.load import scene_folder
from thermorender.scene.spec import AtmosphereSpec, EmissivitySpec, TemperatureSpec, WeatherSpec

pytestmark = pytest.mark.usefixtures("short_heat")

LATER = "2018-07-28T15:00Z"
KELVIN = np.full((32, 32), 300.0, np.float32)
ARRAYS = ("vertices", "faces", "uv", "colour", "material", "temperature", "flags")


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = write_terrain(tmp_path_factory.mktemp("given") / "tiny", extra=WEATHER + MARKER)
    return tr.load_scene(folder).with_camera(CAMERA)


@pytest.fixture(scope="module")
def solved(tmp_path_factory):
    """At the temperatures of its heat balance."""
    folder = write_balance(tmp_path_factory.mktemp("solved") / "tiny", WEATHER + MARKER)
    return tr.Renderer(tr.load_scene(folder).with_camera(CAMERA), rays=2, samples=1)


def test_arrays_of_a_scene_cannot_be_changed(scene):
    for name in ARRAYS:
        with pytest.raises(ValueError, match="read-only"):
            getattr(scene.surfaces[0], name)[0] = 0
    with pytest.raises(ThermorenderError, match="these settings cannot be changed"):
        scene.spec.emissivity.classes[1] = "snow"
    with pytest.raises(ValueError, match="read-only"):
        scene.weather.air_k[0] = 300.0
    with pytest.raises(ValueError, match="read-only"):
        Atmosphere.standard().temperature[0] = 300.0
    again = pickle.loads(pickle.dumps(scene))
    assert again.digest() == scene.digest() and again.spec == scene.spec


def test_changes_of_arrays_that_a_scene_was_given_do_not_reach_it(scene, solved):
    mine, temperature = KELVIN.copy(), np.array(solved.scene.surfaces[0].temperature)
    surfaces = [dataclasses.replace(s, temperature=np.array(s.temperature)) for s in scene.surfaces]
    made = [
        scene.with_temperature(TemperatureSpec("raster", raster=scene.spec.temperature.raster), kelvin=[mine]),
        solved.scene.with_solved_temperatures(solved.scene.time, [temperature]),
        scene.with_surfaces(surfaces),
    ]
    before = [each.digest() for each in made]
    mine += 50.0
    temperature += 50.0
    surfaces[0].temperature.base[...] = 400.0
    assert [each.digest() for each in made] == before
    assert max(each.surfaces[0].temperature.max() for each in made) < 345.0


@pytest.mark.parametrize("edit", [
    *slow(lambda base: base.with_objects({"marker": 600.0})),
    lambda base: base.with_material(grass_green="asphalt", marker="paint_metallic"),
    *slow(lambda base: base.with_material({1: "snow", 2: "snow"})),
])  # fmt: skip
def test_the_light_of_a_like_renderer_does_not_bring_its_objects_and_materials(solved, edit):
    """The heat balance took both from the scene before the edit, which was wrong by up to 30 K."""
    edited = edit(solved.scene)
    fresh = tr.Renderer(edited, rays=2, samples=1)
    alike = tr.Renderer(edited, rays=2, samples=1, like=solved)
    assert alike.scene.digest() == fresh.scene.digest() != solved.scene.digest()


def test_a_weather_in_memory_and_a_key_that_it_measures_are_refused(scene):
    weather = scene.weather
    with pytest.raises(ThermorenderError, match="was given a Weather and wind_m_s=12, which the Weather measures"):
        scene.with_weather(weather, wind_m_s=12)
    assert scene.with_weather(weather, time=LATER).time == np.datetime64("2018-07-28T15:00:00")


def test_an_instant_belongs_to_all_that_a_scene_declares(solved):
    base = solved.scene
    at = np.datetime64("2018-07-28T15:00:00")
    later = base.with_solved_temperatures(at, [np.array(base.surfaces[0].temperature)])
    assert later.time == later.spec.weather.time == at
    assert later.with_weather(wind_m_s=8).time == at


def test_the_truth_returns_with_its_weather(scene):
    truth = scene.spec.truth_temperature
    assert truth and scene.at(LATER).spec.truth_temperature is None
    assert scene.at(LATER).at("2018-07-28T12:00Z").spec.truth_temperature == truth
    assert scene.with_weather(wind_m_s=8).with_weather(wind_m_s=2.5).spec.truth_temperature == truth
    assert scene.with_weather(scene.weather).spec.truth_temperature is None


def test_a_grey_material_does_not_have_the_thermal_table_of_its_name(solved):
    grey = solved.scene.with_material(grass_green=0.9)
    with pytest.raises(ThermorenderError, match="grey material 'grass_green' has no thermal properties; use"):
        tr.Renderer(grey, rays=2, samples=1)


NOTHING = EmissivitySpec("constant", value=0.9)


@pytest.mark.parametrize(
    ("edit", "match"),
    [
        (lambda s: s.with_sky("250"), "with_sky: kelvin='250' is not allowed; give a finite number"),
        (lambda s: s.with_sky(None), "with_sky: kelvin=None is not allowed"),
        (lambda s: s.with_sky(np.inf), "with_sky: kelvin=inf is not allowed"),
        (lambda s: s.with_sky([250.0, 260.0]), "with_sky: kelvin="),
        (lambda s: s.with_sky(250.0, surroundings="x"), "with_sky: surroundings='x' is not allowed"),
        (lambda s: s.with_sun("30", 10.0), "with_sun: elevation_deg='30' is not allowed"),
        (lambda s: s.with_temperature(np.nan), "with_temperature=nan is not allowed; give a finite number"),
        (lambda s: s.with_temperature("fok-1to1", kelvin=[]), "holds arrays of shape nothing; give 1 array of kelvin"),
        (lambda s: s.with_temperature("fok-1to1", kelvin="x"), "kelvin='x' is not allowed; give 1 array of kelvin"),
        (lambda s: s.with_temperature("fok-1to1", kelvin=[KELVIN] * 2), "holds arrays of shape"),
        (lambda s: s.with_temperature("fok-1to1", kelvin=[KELVIN - 280.0]), "values are kelvin, add 273.15 to °C"),
        (lambda s: s.with_temperature("fok-1to1", kelvin=[KELVIN * np.nan]), "holds no number"),
        (lambda s: s.with_temperature("fok-1to1", model=5), "model is a int; give a TemperatureMap"),
        (lambda s: s.with_temperature(TemperatureSpec("material", materials={"grass_dry": 20.0})), "add 273.15 to °C"),
        (lambda s: s.with_temperature(TemperatureSpec("material", materials={"grass_dry": np.nan})), "number"),
        (lambda s: s.with_temperature(TemperatureSpec("raster")), "with_temperature: raster is missing"),
        (lambda s: s.with_temperature(TemperatureSpec("mine")), "source='mine' is not allowed; give one of"),
        (lambda s: s.with_temperature(TemperatureSpec("learned", model="fok-1to1", map_error_k=-5.0)), "error_k=-5"),
        (lambda s: s.with_temperature(TemperatureSpec("learned", model="fok-1to1", range_c=(280.0, 320.0))), "kelvin"),
        (lambda s: s.with_weather(WeatherSpec("noon", air_high_c=20.0)), "time=noon is not an instant"),
        (lambda s: s.with_weather(WeatherSpec(LATER, air_high_c=20.0, air_low_c=9.0)), "humidity is missing"),
        (lambda s: s.with_air(AtmosphereSpec(standard="tropical", altitude_m=np.nan)), "altitude_m=nan is not allowed"),
        (lambda s: s.with_air(AtmosphereSpec(standard="tropical", altitude_m="5")), "altitude_m='5' is not allowed"),
        (lambda s: s.with_learned_materials("procedural"), "was given a str; give EmissivitySpec"),
        (lambda s: s.with_learned_materials(NOTHING), "was given source='constant'; give EmissivitySpec"),
        (lambda s: s.with_learned_materials(EmissivitySpec("learned", model="procedural")), "fallback is missing"),
        (lambda s: s.with_material(["snow"]), "with_material was given a list; give"),
        (lambda s: s.with_objects(["marker"]), "with_objects was given a list; give"),
        (lambda s: s.with_objects({"marker": {"above_ground_m": 1e9}}), "position=.* is not allowed"),
        (lambda s: s.with_surfaces([]), "no surfaces; give at least one Surface"),
        (lambda s: s.with_surfaces(5), "surfaces=5; give a list of Surface"),
        (lambda s: s.with_surfaces(materials=["snow"]), "a str among its materials; give at least one Material"),
        (lambda s: s.with_surfaces(materials=s.materials * 150), "materials; give 255 at most"),
        (lambda s: s.with_surfaces(terrain_count=99), "terrain_count=99 is not allowed; give a whole number 1…"),
        (lambda s: s.with_surfaces(terrain_count=0), "terrain_count=0 is not allowed"),
        (lambda s: s.with_camera("none"), "with_camera: camera 'none' is unknown; give one of"),
        (lambda s: s.with_camera(640), "with_camera was given a int; give the name of a camera"),
        (lambda s: s.with_camera(dataclasses.replace(CAMERA, band_um=(2.0, 5.0))), "its emissivity at 2–5 µm"),
        (lambda s: s.with_air("mars"), "standard='mars' is unknown"),
        (lambda s: s.with_air(3), "with_air was given a int; give the name of a standard atmosphere"),
        (lambda s: s.with_sky(-5.0), "with_sky: kelvin=-5 is"),
        (lambda s: s.with_sun(120.0, 0.0), "elevation_deg=120.0 is not allowed; give a number -90…90"),
        (lambda s: s.with_sun(30.0), r"has no azimuth, and the scene declares no sun; give azimuth_deg"),
        (lambda s: s.with_weather(), "with_weather was given nothing"),
        (lambda s: s.with_weather(wind=3), "unknown key 'wind'; did you mean 'wind_m_s'"),
        (lambda s: s.with_weather(humidity=60), "humidity=60 is not allowed; give a number above 0 and up to 1"),
        (lambda s: s.with_weather(air_low_c=40.0), "air_low_c=40.0 is not allowed; give a value not above"),
        (lambda s: s.with_weather("rain"), "with_weather was given a str"),
        (lambda s: s.with_temperature(21.5), "with_temperature=21.5 is below 100 K"),
        (lambda s: s.with_temperature("gone.tif"), "gone.tif does not exist; give a raster of kelvin"),
        (lambda s: s.with_temperature("fok-1to2"), "learned map 'fok-1to2' is unknown; did you mean 'fok-1to1'"),
        (lambda s: s.with_temperature(TemperatureSpec("raster"), kelvin=[np.zeros((2, 2))]), "holds arrays of shape"),
        (lambda s: s.with_material(moon="sand_quartz"), "given 'moon', which this scene does not have; give one of"),
        (lambda s: s.with_material({7: "sand_quartz"}), "given class 7, which this scene does not have"),
        (lambda s: s.with_material(grass_green="gras_green"), "with_material: grass_green"),
        (lambda s: s.with_material(grass_green=1.2), "grass_green=1.2 is not allowed; give an emissivity above 0"),
        (lambda s: s.with_material(grass_green=None), "grass_green=None is not a material; give a name"),
        (lambda s: s.with_objects({"marke": 300.0}), "has no object 'marke'; did you mean 'marker'"),
        (lambda s: s.with_objects({"marker": {"up": 1.0}}), "object 'marker' has no 'up' to set; give east_m"),
        (lambda s: s.with_objects({"marker": {"east_m": 900.0}}), "where there is no terrain; give a position on"),
        (lambda s: s.with_objects({"marker": "hot"}), "temperature_k='hot' is not allowed; give a finite number"),
        (lambda s: s.with_surfaces(materials=s.materials[:1]), "a texel has material number 2, but there are 1 mater"),
        (lambda s: s.with_surfaces().with_material(grass_green="snow"), "with_material needs materials that files"),
        (lambda s: s.with_surfaces().with_objects({"marker": 300.0}), "an object cannot be edited, because its surf"),
        (lambda s: s.with_solved_temperatures(s.time, [300.0]), "are not solved for an instant; call with_temperature"),
    ],
)  # fmt: skip
def test_impossible_arguments_are_refused(scene, edit, match):
    with pytest.raises(ThermorenderError, match=match) as error:
        edit(scene)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("time", "kelvin", "flags", "match"),
    [
        ("noon", [KELVIN], None, "time=noon is not an instant"),
        ("1900-01-01T00:00Z", [KELVIN], None, "is outside the weather"),
        (LATER, [KELVIN - 280.0], None, "values are kelvin"),
        (LATER, [KELVIN * np.nan], None, "holds no number"),
        (LATER, [KELVIN] * 2, None, "holds arrays of shape"),
        (LATER, [KELVIN], [np.zeros((2, 2))], "flags have the shapes"),
    ],
)
def test_impossible_solutions_are_refused(solved, time, kelvin, flags, match):
    with pytest.raises(ThermorenderError, match=match):
        solved.scene.with_solved_temperatures(time, kelvin, flags=flags)


def test_frames_of_a_scene_do_not_change_with_what_it_was_given(scene):
    mine = KELVIN.copy()
    given = scene.with_temperature("fok-1to1", kelvin=[mine])
    before = frame_of(given)
    mine += 40.0
    np.testing.assert_array_equal(frame_of(given), before)


def test_a_temperature_below_100_k_needs_its_unit(tmp_path):
    """A target at 77 K under a sky of 3 K: ε B(77 K) + (1 − ε) B(3 K), which is nothing."""
    cold = scene_object("marker", [40.0, 40.0, 1.0], [2.0, 1.0, 0.0], "77 K")
    scene = tr.load_scene(write_terrain(tmp_path / "tiny", extra=cold))
    scene = scene.with_camera(CAMERA).with_sky("3 K")
    assert scene.sky_temperature == 3.0 and scene.with_air("tropical").with_air(None).sky_temperature == 3.0
    seen = tr.Renderer(scene, rays=4).frame(tr.pose(0, 0, 12, pitch_deg=-90)).radiance
    black = next(each for each in scene.materials if each.name == "paint_black")
    expected = black.band_emissivity(*CAMERA.band_um, 77.0) * band_radiance(77.0, *CAMERA.band_um)
    np.testing.assert_allclose(seen, expected, rtol=2e-4)
    assert scene.with_objects({"marker": "90 K"}).spec.objects[0].temperature == 90.0
    for edit in (lambda: scene.with_sky(3.0), lambda: scene.with_objects({"marker": 77.0})):
        with pytest.raises(ThermorenderError, match=r"add 273.15 to °C, or write '\d+ K' if it is that cold"):
            edit()
    with pytest.raises(ThermorenderError, match="'cold' is not allowed; give a finite number"):
        scene.with_sky("cold")


def test_a_part_of_a_users_folder_is_not_a_shipped_scene(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shipped = scene_folder("village/survey")
    assert shipped.parent == scene_folder("village") and shipped.is_absolute()
    with pytest.raises(ThermorenderError, match=r"scene './village/survey' does not exist"):
        scene_folder("./village/survey")
    (tmp_path / "village").mkdir()
    with pytest.raises(ThermorenderError, match=r"scene 'village/survey' does not exist"):
        scene_folder("village/survey")
