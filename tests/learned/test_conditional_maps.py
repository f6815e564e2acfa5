"""Conditional maps, with relief, hour and weather as inputs, as a scene's temperatures: against maps made by hand."""

import json
import pickle
import shutil
import subprocess
import sys

import numpy as np
import pytest
import trimesh

import thermorender as tr
from scenes import write_balance, write_mesh
from thermorender.apps.compare.comparison import Options, compare
from thermorender.apps.compare.view import Flight
from thermorender.errors import ThermorenderError
from thermorender.learned.correlation import Correlation
from thermorender.learned.linear import Linear, names_of_columns
from thermorender.learned.rows import ExtraInputs
from thermorender.learned.temperature_map import TemperatureMap, save_map
from thermorender.output.flight import FlightOptions, fly
from thermorender.output.provenance import weather_of
from thermorender.scene.spec import TemperatureSpec
from thermorender.scene.surface import FALLBACK, SURFACE
from thermorender.scene.temperature_state import Conditional, Pending

pytestmark = pytest.mark.usefixtures("short_heat")

BEGIN, AT = np.datetime64("2018-07-27T00:00:00"), np.datetime64("2018-07-28T12:00:00")
HOUR = np.timedelta64(3600, "s")
STATION = '[weather]\ntime = 2018-07-28T12:00:00Z\nfile = "station.csv"\n'
BLACK = '[emissivity]\nsource = "constant"\nvalue = 1.0\n'
LEARNED = 'source = "learned"\nmodel = "above.npz"'
DOWN = tr.pose(0, 0, 6, pitch_deg=-90)
# Temperatures of texels and radiances of pixels are in single precision: a few ulp of 300 K.
TOLERANCE_K = 5e-4


def air_k(time):
    """The station's air temperature: it rises by 1 K an hour."""
    return 270.0 + (time - BEGIN) / HOUR


def above_air(kelvin):
    return Correlation(np.zeros((1, 1, 3)), kelvin, above_air=True)


def by_sunlight(kelvin_m2_w):
    """Kelvin above the air, proportional to the sunlight on the ground."""
    extra = ExtraInputs(("sunlight",), ("air_k",))
    names = names_of_columns(extra)
    return Linear(extra, kelvin_m2_w * (np.array(names) == "sunlight"), 0.0)


def save(path, predictor, **options):
    usual = {
        "name": path.stem, "method": "by hand", "predictor": predictor, "range_k": (270.0, 330.0),
        "band_um": (7.5, 13.5), "texel_m": 0.5, "texel_range_m": (0.4, 0.6), "camera": "boson-640",
        "sky_temperature": 230.0, "source": "a test",
    }  # fmt: skip
    save_map(TemperatureMap(**usual | options), path)
    return path


def written(folder, predictor, black=True, weather=STATION, **options):
    folder.mkdir(parents=True)
    save(folder / "above.npz", predictor)
    rows = "".join(f"{BEGIN + hour * HOUR}Z,{270.0 + hour}\n" for hour in range(61))
    (folder / "station.csv").write_text("time_utc,air_k\n" + rows)
    write_balance(folder, weather, source=LEARNED, **options)
    if black:
        text = (folder / "scene.toml").read_text()
        start, end = text.index("[emissivity]"), text.index("[sky]")
        (folder / "scene.toml").write_text(text[:start] + BLACK + text[end:])
    return folder


def seen(frame):
    """Apparent temperature where a frame shows ground [K]."""
    ground = (frame.truth["mask"] & SURFACE) > 0
    assert ground.mean() > 0.5
    return frame.apparent_temperature[ground]


def assert_seen(frame, kelvin, tolerance=TOLERANCE_K):
    np.testing.assert_allclose(seen(frame), kelvin, atol=tolerance)


def path_of(minutes):
    """A trajectory that hovers over the middle, looking down."""
    time_s = np.arange(minutes + 1) * 60.0
    return tr.Trajectory(time_s, np.tile([0.0, 0.0, 6.0], (minutes + 1, 1)), np.tile([0.0, 1.0, 0.0, 0.0],
                                                                                       (minutes + 1, 1)))  # fmt: skip


# --- temperatures -----------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_black_ground_is_as_much_warmer_than_the_air_as_the_map_says(tmp_path):
    scene = tr.load_scene(written(tmp_path / "s", above_air(5.0)))
    assert isinstance(scene.temperature_state, Pending)
    assert isinstance(scene.temperature_state.source, Conditional)
    assert "learned, to be solved for 2018-07-28T12:00:00Z" in str(scene)
    words = "a learned map that takes hour and weather as input are not solved yet"
    with pytest.raises(ThermorenderError, match=words):
        scene.refuse_unsolved()
    for hours in (0, -9, 5):
        renderer = tr.Renderer(scene.at(AT + hours * HOUR), rays=4)
        assert_seen(renderer.frame(DOWN), air_k(AT + hours * HOUR) + 5.0)
        assert renderer.scene.time == AT + hours * HOUR and renderer.scene.temperature_state.solved
    # The shipped sky is not that of the map: ground without reflection does not show it.
    other = scene.with_sky(200.0)
    assert_seen(tr.Renderer(other, rays=4).frame(DOWN), air_k(AT) + 5.0)


def test_grass_and_sand_have_the_maps_temperature_under_the_scenes_sky(tmp_path):
    """Through kinetic temperature and back, though the map was trained under a sky 30 K colder."""
    scene = tr.load_scene(written(tmp_path / "s", above_air(5.0), black=False))
    renderer = tr.Renderer(scene, rays=4)
    assert_seen(renderer.frame(DOWN), air_k(AT) + 5.0, 5e-3)
    # Grass reflects the sky, so its temperature is higher than its apparent one.
    assert renderer.scene.surfaces[0].temperature.min() > air_k(AT) + 5.1


@pytest.mark.slow
def test_level_ground_follows_its_sunlight(tmp_path):
    scene = tr.load_scene(written(tmp_path / "s", by_sunlight(0.02)))
    for hours in (0, -4, -11):
        at = AT + hours * HOUR
        now, (_, elevation) = scene.weather.at(at), scene.weather.sun(at)
        sunlight = now.direct_w_m2 * max(np.sin(np.radians(elevation)), 0.0) + now.diffuse_w_m2
        # Sunlight has a relative error of 1e-5 (tested separately), here at most 20 K.
        assert_seen(tr.Renderer(scene.at(at), rays=4).frame(DOWN), air_k(at) + 0.02 * sunlight, 1e-3)
    assert sunlight == 0.0


def test_metal_is_flagged_and_as_warm_as_the_air(tmp_path):
    folder = written(tmp_path / "s", above_air(5.0), black=False, classes=np.repeat([[1, 2]], 32, 0).repeat(16, 1))
    text = (folder / "scene.toml").read_text()
    (folder / "scene.toml").write_text(text.replace('2 = "sand_quartz"', '2 = "aluminium_polished"'))
    solved = tr.Renderer(tr.load_scene(folder), rays=4).scene
    fallback = (solved.surfaces[0].flags & FALLBACK) > 0
    metal = solved.surfaces[0].material == [one.name for one in solved.materials].index("aluminium_polished")
    np.testing.assert_array_equal(fallback, metal)
    assert metal.mean() == 0.5 and solved.temperature_state.report["above"]["share_fallback"] == 0.5
    np.testing.assert_allclose(solved.surfaces[0].temperature[metal], air_k(AT), atol=TOLERANCE_K)
    # Another hour starts again.
    again = tr.Renderer(solved.at(AT + HOUR), rays=4).scene
    np.testing.assert_array_equal((again.surfaces[0].flags & FALLBACK) > 0, metal)


# --- flights and records ----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_flight_follows_its_time_and_records_the_weather(tmp_path):
    scene = tr.load_scene(written(tmp_path / "s", above_air(5.0)))
    renderer = tr.Renderer(scene, rays=4)
    fly(renderer, path_of(3), tmp_path / "f", FlightOptions(rate_hz=1 / 60, products=("exr",)))
    lines = [json.loads(line) for line in (tmp_path / "f/frames.jsonl").read_text().splitlines()]
    assert [line["temperature"]["time"] for line in lines] == [f"2018-07-28T12:0{n}:00Z" for n in range(4)]
    # One kelvin an hour.
    np.testing.assert_allclose([line["temperature"]["change_mk"] for line in lines[1:]], 1e3 / 60, atol=0.1)
    from thermorender.frame.exr import read_exr

    for number in range(4):
        found = read_exr(tmp_path / f"f/frame_{number:06d}.exr")[0]["apparent_temperature"]
        middle = found[found.shape[0] // 2, found.shape[1] // 2]
        assert middle == pytest.approx(air_k(AT + number * HOUR // 60) + 5.0, abs=TOLERANCE_K)
    record = json.loads((tmp_path / "f/flight.json").read_text())
    assert record["weather"]["source"] == "station.csv" and record["temperature_step_s"] == 60.0
    assert record["map"]["name"] == "above" and record["map"] == weather_of(renderer.scene)["map"]


@pytest.mark.slow
def test_a_flight_is_not_continued_with_another_map_of_the_same_name(tmp_path):
    """At night both give the air's temperature, so the scenes start equal."""
    folder = written(tmp_path / "s", by_sunlight(0.02), weather=STATION.replace("12:00", "00:00"))
    first = tr.Renderer(tr.load_scene(folder), rays=4)
    flight = FlightOptions(rate_hz=1 / 60, products=("exr",))
    with pytest.raises(KeyboardInterrupt):
        fly(first, path_of(2), tmp_path / "f", flight, progress=lambda done, total: interrupt())
    save(folder / "above.npz", by_sunlight(0.05))
    second = tr.Renderer(tr.load_scene(folder), rays=4)
    np.testing.assert_array_equal(second.scene.surfaces[0].temperature, first.scene.surfaces[0].temperature)
    assert first.scene.digest() != second.scene.digest()
    with pytest.raises(ThermorenderError, match="was flown with scene_digest="):
        fly(second, path_of(2), tmp_path / "f", flight, resume=True)
    save(folder / "above.npz", by_sunlight(0.02))
    third = tr.Renderer(tr.load_scene(folder), rays=4)
    assert third.scene.digest() == first.scene.digest()
    assert fly(third, path_of(2), tmp_path / "f", flight, resume=True)["rendered"] == 2


def interrupt():
    raise KeyboardInterrupt


def test_a_scene_keeps_the_map_it_was_loaded_with(tmp_path):
    """Also if the file has changed by the time of the frame, or is gone."""
    folder = written(tmp_path / "s", above_air(5.0))
    scene = tr.load_scene(folder)
    save(folder / "above.npz", above_air(9.0))
    renderer = tr.Renderer(scene, rays=4)
    assert_seen(renderer.frame(DOWN), air_k(AT) + 5.0)
    (folder / "above.npz").unlink()
    assert_seen(tr.Renderer(scene.at(AT + HOUR), rays=4).frame(DOWN), air_k(AT + HOUR) + 5.0)
    assert_seen(tr.Renderer(renderer.scene.at(AT - HOUR), rays=4).frame(DOWN), air_k(AT - HOUR) + 5.0)


def test_the_digest_does_not_depend_on_print_options(tmp_path):
    """colour-science makes NumPy print as in 1.13, in every process that has imported it."""
    scene = tr.load_scene(written(tmp_path / "s", by_sunlight(0.02)))
    own, weather = scene.digest(), scene.weather_digest()
    with np.printoptions(legacy="1.13"):
        assert scene.digest() == own and scene.weather_digest() == weather


def test_baked_scenes_and_frames_work_in_processes_without_the_files(tmp_path):
    folder = written(tmp_path / "s", by_sunlight(0.02))
    renderer = tr.Renderer(tr.load_scene(folder), rays=4)
    frame = renderer.frame(DOWN)
    (tmp_path / "kept").write_bytes(pickle.dumps((renderer.baked, frame, renderer.scene.digest())))
    shutil.rmtree(folder)
    code = f"""
import pickle, sys
import numpy as np
import thermorender as tr
from thermorender.scene.temperature_state import Conditional, Available
baked, frame, digest = pickle.load(open({str(tmp_path / "kept")!r}, "rb"))
again = tr.Renderer.of(baked).frame(frame.pose)
assert np.array_equal(again.radiance, frame.radiance)
assert isinstance(baked.scene.temperature_state, Available) and baked.scene.digest() == digest
assert isinstance(baked.scene.temperature_state.source, Conditional)
assert frame.truth["mask"].any() and frame.time == baked.scene.time
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert not run.returncode and not run.stderr.strip(), run.stderr


# --- verbs ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_verbs_accept_conditional_maps(tmp_path, call):
    folder = written(tmp_path / "s", above_air(5.0))
    (folder / "flight.csv").write_text("time_s,lat,lon,alt_m\n")
    status, output, errors = call("plan", folder, "--rays", 4)
    assert status == 0 and "at 2018-07-28T12:00:00Z" in output, errors
    assert "above: 0.0% of the intensities lie outside 0…1, 0.0% of the texels fall back" in output
    night = ("--time", "2018-07-28T02:00Z")
    status, _, errors = call("render", folder, "-o", tmp_path / "r", "--pose", "0,0,6,0,-90,0", "--rays", 4, *night)
    assert status == 0, errors
    record = json.loads((tmp_path / "r/frame_000000.json").read_text())
    assert record["time"] == "2018-07-28T02:00:00Z" and record["weather"]["source"] == "station.csv"
    assert record["map"]["name"] == "above" and record["map"]["share_fallback"] == 0.0
    arguments = ("day", folder, "-o", tmp_path / "d", "--step-min", 720, "--products", "exr", "--pose", "0,0,6,0,-90,0")
    status, _, errors = call(*arguments, "--rays", 4)
    assert status == 0, errors
    import csv

    with open(tmp_path / "d/day.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2
    for row in rows:
        assert float(row["apparent_mean_k"]) - float(row["air_k"]) == pytest.approx(5.0, abs=TOLERANCE_K)


def test_a_map_replaces_the_scenes_own_source(tmp_path, call):
    folder = written(tmp_path / "s", above_air(5.0))
    text = (folder / "scene.toml").read_text()
    (folder / "scene.toml").write_text(text.replace(LEARNED, 'source = "balance"', 1))
    own = save(tmp_path / "mine.npz", above_air(-3.0))
    common = ("--pose", "0,0,6,0,-90,0", "--rays", 4, "--temperature", own)
    status, output, errors = call("render", folder, "-o", tmp_path / "r", *common)
    assert status == 0, errors
    mean = float(output.partition("mean ")[2].partition(" K")[0])
    assert mean == pytest.approx(air_k(AT) - 3.0, abs=0.005)
    status, _, errors = call("render", folder, "-o", tmp_path / "q", *common, "--range-c", "0,20")
    assert status == 2 and "does not apply to learned map 'mine', which predicts kelvin above the air" in errors


def test_another_ground_sampling_distance_gives_a_warning(tmp_path, call):
    folder = written(tmp_path / "s", above_air(5.0))
    save(folder / "above.npz", above_air(5.0), texel_m=0.1, texel_range_m=(0.05, 0.2))
    status, _, errors = call("plan", folder, "--rays", 4)
    assert status == 0
    assert errors.count("warning: learned map 'above' was trained at 0.05–0.2 m a pixel; at 0.5 m texture") == 1


@pytest.mark.slow
def test_compare_accepts_files_and_conditional_maps(tmp_path):
    """The truth comes from the map, so its errors vanish; a file's name is not its location."""
    folder = written(tmp_path / "s", above_air(5.0))
    text = (folder / "scene.toml").read_text()
    constant = text.replace(LEARNED, f'source = "constant"\nvalue = {air_k(AT) + 5.0}', 1)
    raster = np.full((32, 32), air_k(AT) + 5.0)
    from scenes import write_raster

    write_raster(folder / "temperature.tif", raster[None].astype(np.float32), 0.5, nodata=np.nan)
    (folder / "scene.toml").write_text(constant + '[truth]\ntemperature = "temperature.tif"\n')
    plain = save(tmp_path / "plain.npz", Correlation(np.zeros((1, 1, 3)), 0.5))
    above = str(folder / "above.npz")
    flown = Flight.of(tr.load_scene(folder), path_of(0))
    summary = compare([flown], tmp_path / "c", [str(plain), above], Options(settings={"rays": 4}))
    assert {"plain on the photograph", "plain as kelvin, true materials", "above as kelvin, true materials"} < set(
        summary["methods"]
    ) and "above on the photograph" not in summary["methods"]
    assert (
        summary["methods"]["above as kelvin, true materials"]["errors"]["radiometric"]["ground"]["mae_k"] < TOLERANCE_K
    )
    assert summary["scenes"][0]["maps"]["above as kelvin, true materials"]["above"]["share_outside_0_1"] == 0.0
    shutil.copy(plain, tmp_path / "other.npz")
    with pytest.raises(ThermorenderError, match="two methods are called 'plain'; give maps"):
        compare([flown], tmp_path / "e", [str(plain), str(tmp_path / "other.npz")], Options(settings={"rays": 4}))
    assert not (tmp_path / "e").exists()


# --- refusals ---------------------------------------------------------------------------------------------------


def test_refusals(tmp_path):
    folder = written(tmp_path / "s", above_air(5.0))
    text = (folder / "scene.toml").read_text()
    (folder / "scene.toml").write_text(text.replace(STATION, ""))
    with pytest.raises(ThermorenderError, match=r"above.npz' needs the weather; add \[weather\] with time and one of"):
        tr.load_scene(folder)
    trained = "[temperature.trained]\ntime = 2018-07-28T12:00:00Z\nair_low_c = 3.0\nair_high_c = 9.0\nhumidity = 0.5\n"
    trained += "wind_m_s = 2.0\ncloud = 0.0\n"
    (folder / "scene.toml").write_text(text.replace("[emissivity]", trained + "[emissivity]"))
    with pytest.raises(
        ThermorenderError, match=r"takes hour and weather as input and is not moved by temperature.trained; "
    ):
        tr.load_scene(folder)
    mesh = write_mesh(tmp_path / "m", trimesh.creation.box((4.0, 4.0, 1.0)))
    with pytest.raises(ThermorenderError, match="needs a terrain with an elevation raster, and this one is a mesh; "):
        tr.load_scene(mesh).with_temperature(TemperatureSpec("learned", model=str(folder / "above.npz")))


def test_a_map_with_a_training_time_still_takes_the_hour_as_input(tmp_path):
    folder = written(tmp_path / "s", above_air(5.0))
    day = {"time": "2018-07-28T06:00Z", "air_low_c": 3.0, "air_high_c": 9.0, "humidity": 0.5, "wind_m_s": 2.0,
           "cloud": 0.0}  # fmt: skip
    save(folder / "above.npz", above_air(5.0), trained=day)
    scene = tr.load_scene(folder)
    assert isinstance(scene.temperature_state.source, Conditional)
    assert_seen(tr.Renderer(scene, rays=4).frame(DOWN), air_k(AT) + 5.0)
