"""The hour of a scene: [weather], instants with zones, temperatures that change along a flight, a day of one view.

Weather and heat balance are stand-ins here, as both have their own tests: the air follows a sine over the day, and
each texel is warmer than the air by the kelvins that its material's number gives.
"""

import csv
import json
import sys
import warnings
from collections import namedtuple
from dataclasses import dataclass, replace
from datetime import datetime, timedelta, timezone
from types import ModuleType

import numpy as np
import pytest
import trimesh
from support import contents, interrupted, slow

import thermorender as tr
from scenes import coarse, write_balance, write_mesh, write_terrain
from thermorender.apps.compare.comparison import Options, compare
from thermorender.apps.compare.view import Flight
from thermorender.errors import ThermorenderError, ThermorenderWarning
from thermorender.materials.library import load_library
from thermorender.materials.mixture import mix
from thermorender.output.day import _largest, day, instant_of, solar_midnight
from thermorender.output.flight import FlightOptions, fly
from thermorender.render import reference
from thermorender.render.flight import timed
from thermorender.render.plan import make_plan
from thermorender.scene.spec import TemperatureSpec
from thermorender.units import instant, utc_text

pytestmark = pytest.mark.usefixtures("short_heat")

DAY = """
[weather]
time = 2018-07-28T14:30:00Z
air_low_c = 10
air_high_c = 22
humidity = 0.6
wind_m_s = 3
cloud = 0.2
"""
NOON = np.datetime64("2018-07-28T14:30:00")
MINUTE = np.timedelta64(60, "s")
Conditions = namedtuple("Conditions", ["air_k", "direct_w_m2", "snow_m", "vapour_pa", "pressure_pa", "longwave_w_m2"])


@dataclass(frozen=True)
class StandIn:
    """Weather of five days before an instant to one after."""

    time: np.ndarray
    longitude_deg: float
    notes: tuple = ("the sky's long-wave was modelled",)
    latitude_deg: float = 52.0
    altitude_m: float = 0.0
    knows_rain: bool = False

    @property
    def air_k(self):
        return self.at(self.time).air_k

    @property
    def vapour_pa(self):
        return np.full(self.time.shape, 1200.0)

    def why_no_snow(self, time):
        return ""

    def at(self, time):
        hour = (np.asarray(time, "datetime64[s]").astype(np.int64) % 86400) / 3600.0
        air_k = 289.15 + 6.0 * np.sin(2.0 * np.pi * (hour - 9.0) / 24.0)
        one = np.ones_like(hour)
        return Conditions(air_k, 500.0 * one, 0.0 * one, 1200.0 * one, 101325.0 * one, 320.0 * one)

    def likely_snow_mm(self, time):
        return 0.0

    def sun(self, time):
        hour = (np.asarray(time, "datetime64[s]").astype(np.int64) % 86400) / 3600.0
        return 15.0 * hour, 50.0 * np.sin(2.0 * np.pi * (hour - 6.0) / 24.0)


@pytest.fixture(autouse=True)
def simulations(monkeypatch):
    """The instants of each simulation of the heat balance; weather and balance are stand-ins."""
    done = []

    def declared_weather(spec, latitude_deg, longitude_deg, altitude_m):
        return StandIn(spec.time + np.timedelta64(3600, "s") * np.arange(-120, 25), longitude_deg)

    def solved(scene, times, geometry=None, progress=None, records=None, known=None):
        assert scene.balanced and all(isinstance(time, np.datetime64) for time in times)
        done.append(list(times))
        if progress:
            progress("simulating the heat balance", 1.0)
        return [
            scene.with_solved_temperatures(time, [scene.weather.at(time).air_k + 2.0 * scene.surfaces[0].material])
            for time in times
        ]

    for name, function in (("weather.declared_weather", declared_weather), ("render.heat.simulation", solved)):
        module = ModuleType(f"thermorender.{name}")
        setattr(module, function.__name__, function)
        monkeypatch.setitem(sys.modules, module.__name__, module)
    return done


def write(folder, extra=DAY, *source, **options):
    return write_balance(folder, extra, *source, **options)


@pytest.fixture
def scene(tmp_path):
    return coarse(tr.load_scene(write(tmp_path / "tiny")))


@pytest.fixture
def path():
    """Two minutes and a half over the scene, from 10 s on."""
    ends = np.array([[-1.0, 0.0, 12.0], [1.0, 0.0, 12.0]])
    return tr.Trajectory(np.array([10.0, 160.0]), ends, np.array([[0.0, 1.0, 0.0, 0.0]] * 2))


# --- weather ------------------------------------------------------------------------------------------------------


def test_the_weather_table_is_read(scene, monkeypatch):
    monkeypatch.delitem(sys.modules, "thermorender.weather.declared_weather")
    weather = scene.weather
    # The named day's limits and place, five days before and one after.
    assert 283.15 <= weather.air_k.min() < 283.3 and 295.0 < weather.air_k.max() <= 295.15 + 1e-6
    assert weather.longitude_deg == scene.frame.longitude_deg and weather.altitude_m == scene.altitude_m
    assert weather.time[0] <= NOON - np.timedelta64(4, "D") and weather.time[-1] >= NOON + 600 * MINUTE
    assert scene.weather_notes == weather.notes and len(scene.digest()) == 32
    dawn = scene.at("2018-01-05T06:00Z")
    assert dawn.weather.time[0] < dawn.time < dawn.weather.time[-1] and dawn.weather_digest() != scene.weather_digest()


def test_an_instant_outside_its_file_is_refused(tmp_path, monkeypatch):
    monkeypatch.delitem(sys.modules, "thermorender.weather.declared_weather")
    table = '[weather]\ntime = 2018-07-28T14:30:00Z\nfile = "station.csv"\nwind_m_s = 3\n'
    folder = write(tmp_path / "tiny", table)
    rows = [f"2018-07-{27 + hour // 24}T{hour % 24:02d}:00:00Z,{18 + hour % 24 / 4},60" for hour in range(36)]
    (folder / "station.csv").write_text("\n".join(["time_utc,air_c,rh_percent", *rows]) + "\n")
    with pytest.raises(ThermorenderError) as error:
        _ = tr.load_scene(folder).weather
    for words in (str(folder / "scene.toml"), "[weather] time=2018-07-28T14:30:00Z is outside the weather", "give the"):
        assert words in str(error.value)
    scene = tr.load_scene(folder).at("2018-07-28T09:00Z")
    assert scene.weather.wind_m_s.max() == 3.0 and scene.weather_notes
    lines = (folder / "station.csv").read_text()
    (folder / "station.csv").write_text(lines.replace(",60\n", ",61\n", 1))
    assert tr.load_scene(folder).at("2018-07-28T09:00Z").digest() != scene.digest()


# --- instants -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "value",
    [
        "2018-07-28T14:30Z", "2018-07-28T14:30:00Z", "2018-07-28 16:30+02:00", "2018-07-28T04:30:00-1000",
        NOON, datetime(2018, 7, 28, 20, 15, tzinfo=timezone(timedelta(hours=5, minutes=45))),
        "2018-07-28T14:30:00.999Z", "2018-07-28T16:30:00,5+02:00", np.datetime64("2018-07-28T14:30:00.999"),
        datetime(2018, 7, 28, 14, 30, 0, 123456, timezone.utc),
    ],
)  # fmt: skip
def test_an_instant_is_utc(value):
    assert instant("time", value) == NOON and instant("time", value).dtype == "datetime64[s]"
    assert utc_text(instant("time", value)) == "2018-07-28T14:30:00Z"


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ("2018-07-28T14:30", "time=2018-07-28T14:30 has no zone; add Z for UTC"),
        (datetime(2018, 7, 28), "has no zone"),
        ("2018-07-28", "is not an instant; give date, T, hour, minute and zone"),
        ("2018-02-30T12:00Z", "is not an instant"),
        ("2018-07-28T14:30.5Z", "is not an instant"),
        ("2018-07-28T14:30:00.5", "has no zone; add Z for UTC"),
        ("2018-07-28T14:30+15:00", "has an impossible offset from UTC"),
        ("noon", "time=noon is not an instant"),
        (np.datetime64("NaT"), "is not an instant"),
        (5, "time=5 is not an instant"),
    ],
)
def test_values_that_are_not_instants_are_refused(value, words):
    with pytest.raises(ThermorenderError) as error:
        instant("time", value)
    assert words in str(error.value)


# --- scene files --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("time = 2018-07-28T14:30:00Z\n", ""), "key 'time' is missing in weather"),
        (("T14:30:00Z", "T14:30:00"), "weather.time=2018-07-28T14:30:00 has no zone; add Z"),
        (("2018-07-28T14:30:00Z", '"2018-07-28T14:30"'), "weather.time=2018-07-28T14:30 has no zone"),
        (("2018-07-28T14:30:00Z", "2018-07-28"), "weather.time=2018-07-28 is not an instant"),
        (("air_high_c = 22\n", ""), "weather needs exactly one of file, epw, air_high_c"),
        (("air_high_c = 22", 'air_high_c = 22\nfile = "scene.toml"'), "file and air_high_c are given"),
        (
            ("air_high_c = 22", 'file = "scene.toml"'),
            "weather.air_low_c=10 is not allowed; give it with air_high_c only",
        ),
        (("cloud = 0.2", ""), "weather.cloud is missing; a named day needs it"),
        (("wind_m_s = 3", ""), "weather.wind_m_s is missing; a named day needs it in m/s"),
        (("wind_m_s = 3", "wind_m_s = -1"), "weather.wind_m_s=-1 is not allowed; give a number 0…60 m/s"),
        (("humidity = 0.6", "humidity = 60"), "weather.humidity=60 is not allowed; give a number above 0 and up to 1"),
        (("air_low_c = 10", "air_low_c = 25"), "weather.air_low_c=25 is not allowed; give a value not above"),
        (("cloud = 0.2", "clouds = 0.2"), "unknown key 'clouds' in weather; did you mean 'cloud'?"),
        (("[weather]", "[weathers]"), "unknown key 'weathers'"),
    ],
)
def test_inconsistent_weather_is_refused(tmp_path, change, words):
    assert DAY.count(change[0]) == 1
    with pytest.raises(ThermorenderError) as error:
        tr.load_scene(write(tmp_path / "tiny", DAY.replace(*change)))
    assert words in str(error.value)


@pytest.mark.parametrize(
    ("source", "extra", "words"),
    [
        (
            'source = "balance"',
            "",
            "temperature.source='balance' needs the weather; add [weather] with time and one of",
        ),
        ('source = "constant"\nvalue = 300\nbrightness = true', DAY, "temperature.brightness=True is not allowed"),
        ('source = "balance"\nbrightness = 1', DAY, "temperature.brightness=1 is not allowed; give one of false, true"),
        ('source = "balances"', DAY, "give one of constant, raster, material, learned, balance"),
    ],
)
def test_a_balance_without_its_required_inputs_is_refused(tmp_path, source, extra, words):
    with pytest.raises(ThermorenderError) as error:
        tr.load_scene(write(tmp_path / "tiny", extra, source))
    assert words in str(error.value)


def test_a_sun_at_odds_with_the_hour_is_refused(tmp_path):
    folder = write(tmp_path / "tiny", DAY + "[sun]\nelevation_deg = 30\nazimuth_deg = 0\n")
    text = (folder / "scene.toml").read_text()
    text = text.replace("[sky]\ntemperature = 260.0", '[atmosphere]\nstandard = "midlatitude-summer"')
    (folder / "scene.toml").write_text(text)
    with pytest.raises(ThermorenderError, match=r"\[sun\] follows from weather.time"):
        tr.load_scene(folder)


def test_a_mesh_needs_a_place(tmp_path):
    folder = write_mesh(tmp_path / "m", trimesh.creation.box((2, 2, 2)), extra=DAY)
    text = (folder / "scene.toml").read_text().replace('source = "constant"\nvalue = 300.0', 'source = "balance"')
    (folder / "scene.toml").write_text(text)
    with pytest.raises(ThermorenderError, match=r"needs a place, which a mesh does not have; add \[frame\]"):
        tr.load_scene(folder)
    with open(folder / "scene.toml", "a") as file:
        file.write("[frame]\nlatitude_deg = 50\nlongitude_deg = 10\nheight_m = 300\n")
    scene = tr.load_scene(folder)
    assert scene.weather.longitude_deg == 10.0 and scene.altitude_m == 300.0


# --- scenes -------------------------------------------------------------------------------------------------------


def test_temperatures_of_a_scene_are_solved_on_demand(scene, simulations):
    assert scene.time == NOON and scene.balanced and not scene.temperature_state.solved and not simulations
    assert np.isnan(scene.surfaces[0].temperature).all()
    assert "balance, to be solved for 2018-07-28T14:30:00Z" in str(scene)
    unsolved = (lambda: make_plan(scene), lambda: scene.surroundings_temperature,
                lambda: reference.render(scene, tr.pose(0, 0, 12, pitch_deg=-90), samples=1))  # fmt: skip
    for ask in unsolved:
        with pytest.raises(ThermorenderError, match=r"are not solved yet; use Renderer\(scene\).scene"):
            ask()
    messages = []
    renderer = tr.Renderer(scene, rays=4, samples=1, progress=lambda what, share: messages.append(what))
    assert simulations == [[NOON]] and messages[0] == "simulating the heat balance"
    solved = renderer.scene
    assert solved.temperature_state.solved and not scene.temperature_state.solved
    expected = scene.weather.at(NOON).air_k + 2.0 * scene.surfaces[0].material
    np.testing.assert_allclose(solved.surfaces[0].temperature, expected, atol=2e-5)
    assert f"{expected.min():.1f}–{expected.max():.1f} K at 2018-07-28T14:30:00Z" in str(solved)
    frame = renderer.frame(tr.pose(0, 0, 12, pitch_deg=-90))
    assert frame.time == NOON and np.isfinite(frame.apparent_temperature).all()
    kinetic = frame.truth["kinetic_temperature"]
    assert expected.min() - 1e-3 <= kinetic.min() and kinetic.max() <= expected.max() + 1e-3


def test_a_wrong_setting_is_refused_before_the_simulation(scene, simulations):
    with pytest.raises(ThermorenderError, match="rays=0 is not allowed"):
        tr.Renderer(scene, rays=0)
    assert not simulations


def test_the_same_scene_is_simulated_once(scene, simulations):
    first = tr.Renderer(scene, rays=4, samples=1)
    small = scene.with_camera(replace(scene.camera, width=64, height=64))
    for other in (scene, small):
        assert tr.Renderer(other, rays=4, samples=1, like=first).baked.texels is first.baked.texels
    assert len(simulations) == 1
    later = tr.Renderer(scene.at(NOON + 60 * MINUTE), rays=4, samples=1, like=first)
    assert len(simulations) == 2 and later.scene.time == NOON + 60 * MINUTE


def test_a_scene_at_another_instant(scene):
    later = scene.at("2018-07-28T20:00+02:00")
    assert later.time == np.datetime64("2018-07-28T18:00:00") == later.spec.weather.time
    assert not later.temperature_state.solved
    assert scene.at(NOON) is scene
    digests = [
        one.digest() for one in (scene, later, scene.with_temperature(TemperatureSpec("balance", brightness=True)))
    ]
    assert len(set(digests)) == 3 and coarse(tr.load_scene(scene.spec.folder)).digest() == digests[0]
    assert scene.with_weather(inside_c=21.0).digest() != digests[0]


def test_a_truth_raster_is_valid_at_the_scenes_own_instant(tmp_path):
    scene = tr.load_scene(write_terrain(tmp_path / "tiny", extra=DAY))
    assert scene.with_true_temperature().spec.temperature.source == "raster"
    assert scene.at(NOON).spec.truth_temperature is not None
    with pytest.raises(ThermorenderError, match=r"its truth is of 2018-07-28T14:30:00Z .* leave time and weather"):
        scene.at(NOON + MINUTE).with_true_temperature()
    balanced = scene.with_temperature("balance").at(NOON + MINUTE)
    assert balanced.with_true_temperature().balanced
    plain = tr.load_scene(write_balance(tmp_path / "plain", DAY, 'source = "constant"\nvalue = 290.0'))
    with pytest.raises(ThermorenderError, match=r"has no truth.temperature; name a raster"):
        plain.with_true_temperature()


def test_too_little_weather_before_the_instant_gives_a_warning(scene):
    assert scene.weather_notes == ("the sky's long-wave was modelled",)
    scene = scene.with_weather(StandIn(NOON + 60 * MINUTE * np.arange(-13, 25), 21.0))
    assert "the weather begins 13.0 h before 2018-07-28T14:30:00Z" in scene.weather_notes[1]


def test_a_scene_without_an_hour_refuses_one(tmp_path, call):
    folder = write_terrain(tmp_path / "tiny")
    with pytest.raises(ThermorenderError, match=r"needs temperature.source='balance' with \[weather\]"):
        tr.load_scene(folder).at(NOON)
    for verb in ("plan", "render", "fly", "compare", "bench", "day"):
        output = [] if verb in ("plan", "bench") else ["-o", tmp_path / verb]
        status, _, errors = call(verb, folder, "--time", "2018-07-28T14:30Z", *output)
        assert status == 2 and "needs temperature.source='balance'" in errors, (verb, errors)
        assert not (tmp_path / verb).exists()
        status, _, errors = call(verb, folder, "--time", "2018-07-28T14:30", *output)
        assert status == 2 and "time=2018-07-28T14:30 has no zone" in errors


def test_the_sun_position_follows_the_instant(tmp_path):
    folder = write(tmp_path / "tiny")
    scene = tr.load_scene(folder).with_air("midlatitude-summer").with_temperature(TemperatureSpec("balance"))
    found = tr.Renderer(scene, rays=4, samples=1).scene.sun
    assert (found.azimuth_deg, found.elevation_deg) == pytest.approx([float(x) for x in scene.weather.sun(NOON)])
    night = scene.at("2018-07-28T01:00Z")
    assert tr.Renderer(night, rays=4, samples=1).scene.sun is None
    # The weather's sun also shines on temperatures that do not follow it, unless another is declared.
    constant = scene.with_temperature(300.0)
    assert constant.sun == found and constant.with_sky(250.0).sun is None
    declared = constant.with_sun(20.0, 90.0).sun
    assert (declared.elevation_deg, declared.azimuth_deg) == (20.0, 90.0)


# --- flights ------------------------------------------------------------------------------------------------------


def test_a_flight_uses_temperatures_of_its_own_time(scene, path, simulations, tmp_path):
    renderer = tr.Renderer(scene, rays=4, samples=1)
    fly(renderer, path, tmp_path / "f", FlightOptions(rate_hz=0.1, products=("counts",)))
    # One simulation for the renderer, one for all the rest of the flight.
    assert [len(times) for times in simulations] == [1, 3]
    lines = [json.loads(line) for line in (tmp_path / "f/frames.jsonl").read_text().splitlines()]
    assert len(lines) == 16 and [line["time_s"] for line in lines[:2]] == [10.0, 20.0]
    assert lines[0]["time"] == "2018-07-28T14:30:00.000Z" and lines[15]["time"] == "2018-07-28T14:32:30.000Z"
    steps = [line["temperature"]["time"] for line in lines]
    # The nearest minute; of two equally near ones the even one, as Python rounds.
    assert steps == [f"2018-07-28T14:3{round(k / 6)}:00Z" for k in range(16)]
    air = [float(scene.weather.at(NOON + k * MINUTE).air_k) for k in range(3)]
    changes = {line["temperature"]["time"][14:16]: line["temperature"]["change_mk"] for line in lines}
    assert changes["30"] is None and changes["31"] == pytest.approx(1e3 * abs(air[0] - air[1]), abs=0.1)
    assert changes["32"] == pytest.approx(1e3 * abs(air[1] - air[2]), abs=0.1)
    flown = json.loads((tmp_path / "f/flight.json").read_text())
    assert flown["time"] == "2018-07-28T14:30:00.000Z" and flown["temperature_step_s"] == 60.0
    assert flown["weather"]["source"] == "named day" and flown["weather"]["notes"] == list(scene.weather.notes)
    # A frame equals that of the scene at its step's instant.
    follower = timed.TimedRenderer(renderer, *path.span_s)
    alone = tr.Renderer(scene.at(NOON + 2 * MINUTE), rays=4, samples=1).radiance(path.pose(130.0))
    np.testing.assert_allclose(follower.at(130.0).radiance(path.pose(130.0)), alone, rtol=2e-6)
    assert np.abs(alone / renderer.radiance(path.pose(130.0)) - 1.0).max() > 1e-5


def test_light_is_traced_once_for_a_flight(scene, path, tmp_path, monkeypatch):
    from thermorender.render.light import transport_cache

    traced, known = [], transport_cache.traced
    monkeypatch.setattr(transport_cache, "traced", lambda *given: traced.append(1) or known(*given))
    fly(tr.Renderer(scene, rays=4, samples=1), path, tmp_path / "f", FlightOptions(rate_hz=0.05, products=("counts",)))
    assert len(traced) == 1


@pytest.mark.parametrize("done", [*slow(3), 7, *slow(12)])
def test_a_resumed_flight_over_steps_gives_the_same_bytes(scene, path, tmp_path, done, monkeypatch):
    monkeypatch.setattr(timed, "TOGETHER", 1)
    flight = FlightOptions(rate_hz=0.1, products=("counts", "display"))
    fly(tr.Renderer(scene, rays=4, samples=1), path, tmp_path / "whole", flight)
    with interrupted(done) as stop:
        fly(tr.Renderer(scene, rays=4, samples=1), path, tmp_path / "part", flight, progress=stop)
    (tmp_path / "part/sensor_even.npz").unlink(missing_ok=True)
    fly(tr.Renderer(scene, rays=4, samples=1), path, tmp_path / "part", flight, resume=True)
    assert contents(tmp_path / "part") == contents(tmp_path / "whole")
    other = tr.Renderer(scene.at(NOON + MINUTE), rays=4, samples=1)
    with pytest.raises(ThermorenderError, match="was flown with scene_digest="):
        fly(other, path, tmp_path / "part", flight, resume=True)


def test_part_of_a_flight_uses_the_same_instants(scene, path, tmp_path):
    renderer = tr.Renderer(scene, rays=4, samples=1)
    fly(renderer, path, tmp_path / "f", FlightOptions(rate_hz=0.05, products=("counts",), start_s=110.0, stop_s=130.0))
    lines = [json.loads(line) for line in (tmp_path / "f/frames.jsonl").read_text().splitlines()]
    assert [line["time"] for line in lines] == ["2018-07-28T14:31:40.000Z", "2018-07-28T14:32:00.000Z"]


def test_a_flight_beyond_its_weather_is_refused(scene, path, tmp_path):
    renderer = tr.Renderer(scene, rays=4, samples=1)
    long = tr.Trajectory(path.time_s * 1000.0, path.position, path.quaternion)
    with pytest.raises(ThermorenderError, match="after its weather, which ends at 2018-07-29T14:30:00Z"):
        fly(renderer, long, tmp_path / "f", FlightOptions(rate_hz=0.001, products=("counts",)))
    assert not (tmp_path / "f").exists()


def test_a_wrong_pose_a_used_folder_and_a_late_flight_are_refused_before_the_heat_balance(
    scene, simulations, call, tmp_path
):
    folder, log, used = tmp_path / "tiny", tmp_path / "log.csv", tmp_path / "used"
    head = "time_s,east_m,north_m,above_ground_m,yaw_deg,pitch_deg,roll_deg\n"
    log.write_text(f"{head}0,0,0,12,0,-90,0\n200000,1,0,12,0,-90,0\n")
    used.mkdir()
    (used / "frames.jsonl").touch()
    for words, verb, *options in (
        ("the camera is 70", "render", "--pose", "0,0,70000,0,-90,0", "--air", "tropical"),
        ("after its weather, which ends at", "fly", "--trajectory", log, "--rate-hz", 0.0001),
        ("already holds a flight", "fly", "--trajectory", log, "-o", used),
    ):
        status, _, errors = call(verb, folder, "-o", tmp_path / "new", *options)
        assert status == 2 and words in errors and not simulations


def test_plan_shows_its_progress_and_keeps_notes_on_the_standard_output(scene, call, tmp_path, monkeypatch):
    # As on a terminal whose standard output goes to a file.
    monkeypatch.setenv("FORCE_COLOR", "1")
    status, output, errors = call("plan", tmp_path / "tiny")
    assert status == 0 and "weather: " in output and "spectral nodes" in output
    assert "loading the scene" in errors and "simulating the heat balance" in errors and "weather: " not in errors


def test_a_scene_without_an_hour_needs_no_simulation(tmp_path, path, simulations):
    renderer = tr.Renderer(tr.load_scene(write_terrain(tmp_path / "tiny")), rays=4, samples=1)
    fly(renderer, path, tmp_path / "f", FlightOptions(rate_hz=0.02, products=("counts",)))
    lines = [json.loads(line) for line in (tmp_path / "f/frames.jsonl").read_text().splitlines()]
    assert all(line["time"] is None and "temperature" not in line for line in lines) and not simulations
    assert "weather" not in json.loads((tmp_path / "f/flight.json").read_text())


# --- a day --------------------------------------------------------------------------------------------------------


def test_the_local_solar_day():
    # Date line, and 15° an hour.
    for longitude, begins in (
        (0.0, "28T00:00:00"),
        (21.0, "27T22:36:00"),
        (-120.0, "28T08:00:00"),
        (180.0, "28T12:00:00"),
    ):
        assert solar_midnight(NOON, longitude) == np.datetime64(f"2018-07-{begins}")


def test_a_day_has_columns_for_the_eight_largest_materials():
    library = load_library()
    pure = [library[name] for name in list(library)[:10]]
    mixed = mix([(pure[0], 0.6), (pure[9], 0.4)])
    texels = np.repeat(np.arange(11, dtype=np.uint8), [1, 20, 19, 18, 17, 16, 15, 14, 13, 12, 30])
    groups = _largest([*pure, mixed], texels)
    # The mix counts as its first part, which is thereby the largest of all.
    assert list(groups) == [pure[k].name for k in (0, 1, 2, 3, 4, 5, 6, 7)] + ["others"]
    assert groups[pure[0].name] == [0, 10] and groups["others"] == [8, 9]


def test_a_day_of_one_view(scene, simulations, tmp_path):
    import cv2

    pose = tr.pose(0, 0, 12, pitch_deg=-90)
    rows = day(scene, pose, tmp_path / "d", 180, ("exr", "counts", "display", "video"), rays=4, samples=1)
    folder, first = tmp_path / "d", solar_midnight(NOON, scene.frame.longitude_deg)
    assert [len(times) for times in simulations] == [8] and simulations[0][0] == first
    names = set(contents(folder))
    assert {"day.csv", "day.png", "day.mp4", "day.json", "frames.jsonl", "frame_000007.png"} <= names
    assert not any(".part" in name for name in names)
    with open(folder / "day.csv", newline="") as file:
        table = list(csv.DictReader(file))
    assert (
        [float(row["solar_hour"]) for row in table]
        == [3.0 * k for k in range(8)]
        == [row["solar_hour"] for row in rows]
    )
    for k, row in enumerate(table):
        assert row["time_utc"] == utc_text(first + k * 180 * MINUTE)
        air = float(scene.weather.at(first + k * 180 * MINUTE).air_k)
        assert float(row["air_k"]) == pytest.approx(air, abs=6e-4)
        grass, sand = (float(row[f"{name}_mean_k"]) for name in ("grass_green", "sand_quartz"))
        assert sorted([grass, sand]) == pytest.approx([air, air + 2.0], abs=2e-3)
        assert float(row["grass_green_min_k"]) <= grass <= float(row["grass_green_max_k"])
    alone = tr.Renderer(scene.at(first + 540 * MINUTE), rays=4, samples=1).frame(pose, index=3)
    mean = float(alone.apparent_temperature.mean(dtype=np.float64))
    assert float(table[3]["apparent_mean_k"]) == pytest.approx(mean, abs=2e-3)
    lines = [json.loads(line) for line in (folder / "frames.jsonl").read_text().splitlines()]
    assert [line["time"] for line in lines] == [row["time_utc"] for row in table]
    # One common scale: the same count has the same level in every frame.
    level = {}
    for k in range(8):
        counts = cv2.imread(str(folder / f"frame_{k:06d}_counts.png"), cv2.IMREAD_UNCHANGED)
        shown = cv2.imread(str(folder / f"frame_{k:06d}.png"), cv2.IMREAD_UNCHANGED)
        for count, seen in np.unique(np.stack([counts.ravel(), shown.ravel()]), axis=1).T.tolist():
            assert level.setdefault(count, seen) == seen
    levels = np.array([level[count] for count in sorted(level)])
    assert (np.diff(levels) >= 0).all() and levels[0] == 0 and levels[-1] == 255
    assert cv2.VideoCapture(str(folder / "day.mp4")).get(cv2.CAP_PROP_FRAME_COUNT) == 8
    assert cv2.imread(str(folder / "day.png")).std() > 5.0


def test_a_day_that_is_stopped_leaves_nothing(scene, tmp_path):
    with interrupted("frame 2 of 4") as stop:
        day(scene, tr.pose(0, 0, 12, pitch_deg=-90), tmp_path / "d", 360, ("counts",), progress=stop, rays=4, samples=1)
    assert [path.name for path in tmp_path.iterdir()] == ["tiny"]


def test_impossible_days_are_refused(scene, tmp_path, simulations):
    pose = tr.pose(0, 0, 12, pitch_deg=-90)
    for step in (0, 1, 7, 721, 1440):
        with pytest.raises(ThermorenderError, match=f"step_min={step} is not allowed; give minutes from 5 to 720"):
            day(scene, pose, tmp_path / "d", step)
    constant = scene.with_temperature(TemperatureSpec("constant", value=300.0))
    with pytest.raises(
        ThermorenderError, match=r"a day needs temperatures that follow the hour .* give the temperature 'balance'"
    ):
        day(constant, pose, tmp_path / "d")
    scene = scene.with_weather(StandIn(NOON + 60 * MINUTE * np.arange(-3, 4), 21.0))
    with pytest.raises(ThermorenderError, match="is not all inside its weather, 2018-07-28T11:30:00Z to"):
        day(scene, pose, tmp_path / "d")
    assert not simulations and not (tmp_path / "d").exists()


def test_a_date_is_local_to_the_place(scene):
    noon = instant_of(scene, "2018-07-29")
    assert solar_midnight(noon, scene.frame.longitude_deg) == noon - 720 * MINUTE
    assert instant_of(scene, "2018-07-29T01:00+02:00") == np.datetime64("2018-07-28T23:00")
    with pytest.raises(ThermorenderError, match="time=2018-02-30"):
        instant_of(scene, "2018-02-30")


# --- command line -------------------------------------------------------------------------------------------------


def test_verbs_accept_an_instant(tmp_path, call, simulations):
    folder = write(tmp_path / "tiny")
    fast = ("--rays", "4", "--time", "2018-07-28T18:00+02:00")
    asked = np.datetime64("2018-07-28T16:00")
    status, output, errors = call("plan", folder, *fast)
    assert status == 0 and "K at 2018-07-28T16:00:00Z" in output, errors
    assert "weather: the sky's long-wave was modelled" in output
    frame = ("--pose", "0,0,12,0,-90,0", "--products", "counts,display")
    status, output, errors = call("render", folder, "-o", tmp_path / "r", *fast, *frame)
    assert status == 0, errors
    record = json.loads((tmp_path / "r/frame_000000.json").read_text())
    assert record["time"] == "2018-07-28T16:00:00Z" and record["weather"]["source"] == "named day"
    assert len(record["weather"]["digest"]) == 32 and simulations == [[asked], [asked]]
    status, output, errors = call("day", folder, "-o", tmp_path / "d", "--step-min", "720", "--rays", "4", *frame,
                                  "--time", "2018-07-27")  # fmt: skip
    assert status == 0 and "2 frames from 2018-07-26T22:" in output, errors
    assert (tmp_path / "d/day.png").is_file()


def test_a_warning_for_an_hour_that_changes_nothing(tmp_path, call):
    folder = write_terrain(tmp_path / "tiny", extra=DAY)
    with warnings.catch_warnings():
        warnings.simplefilter("always", ThermorenderWarning)
        status, _, errors = call("plan", folder, "--time", "2018-07-28T18:00Z")
    assert (
        status == 0
        and "note: temperatures of source 'raster' do not change with time; those of a heat balance do" in errors
    )


@pytest.mark.slow
def test_a_balance_is_the_truth_of_a_comparison_without_a_raster(scene, path, tmp_path):
    options = Options(settings={"rays": 4, "samples": 1})
    found = compare([Flight.of(scene, path, 0.01)], tmp_path / "c", ("fok-1to1",), options)
    (record,) = found["scenes"]
    assert record["time"] == "2018-07-28T14:30:00Z" and record["weather"]["source"] == "named day"
    assert found["methods"]["fok-1to1 as kelvin, true materials"]["errors"]["radiometric"]["ground"]["pixels"] > 0


def test_an_edit_of_the_weather_warns_where_temperatures_do_not_follow_it(tmp_path):
    """Python says what the command line says, at the line of the call."""
    fixed = tr.load_scene(write_terrain(tmp_path / "s", extra=DAY))
    with pytest.warns(ThermorenderWarning, match="source 'raster' do not change with time") as found:
        fixed.at("2018-07-28T03:00Z")
    assert found[0].filename == __file__
    with pytest.warns(ThermorenderWarning, match="do not change with the weather"):
        fixed.with_weather(wind_m_s=9.0)
