"""Procedural scenes: repeatable to the byte, plausible at any hour and weather, not predictable from colour."""

import csv
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import rasterio
from support import slow
from typer.testing import CliRunner

from thermorender.apps.lands.procedural import truth as procedural_truth
from thermorender.apps.lands.procedural.canvas import Canvas
from thermorender.apps.lands.procedural.deviations import deviations_of
from thermorender.apps.lands.procedural.light import incidence, normals, sky_view, sun_visibility
from thermorender.apps.lands.procedural.noise import fractal_noise, stream
from thermorender.apps.lands.procedural.procedural_scene import KINDS, make, weather_of
from thermorender.apps.lands.procedural.scene_files import scene_toml, write_declared
from thermorender.apps.lands.procedural.weather import (
    conditions,
    drawn_weather,
    follows,
    sky_temperature,
    sun_of_photograph,
)
from thermorender.cli import app as cli
from thermorender.errors import ThermorenderError
from thermorender.materials.library import load_library
from thermorender.physics import balance
from thermorender.render.heat.relief import relief
from thermorender.scene import open_ground
from thermorender.scene.deviations import Deviations
from thermorender.scene.load import load_scene
from thermorender.scene.spec import TemperatureSpec, WeatherSpec
from thermorender.scene.weathered_ground import in_weather

pytestmark = pytest.mark.usefixtures("short_heat")

try:
    import tomllib
except ImportError:  # Python 3.10
    import tomli as tomllib

SCENES = Path(__file__).parents[3] / "scenes"
# Small enough to be generated in a second or two.
SMALL = {"heath": (110.0, 0.5, 1.0), "village": (120.0, 0.5, 1.0), "ridge": (480.0, 3.0, 6.0)}


@cache
def small(kind, seed=0):
    return make(kind, seed, *SMALL[kind])


WINTER = WeatherSpec(
    time=np.datetime64("2018-01-17T08:00:00"), air_low_c=-12.0, air_high_c=-3.0, humidity=0.9, wind_m_s=2.0, cloud=0.1,
    snow_depth_m=0.3,
)  # fmt: skip
NIGHT = "2018-09-02T23:30Z"


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    """Callable (kind, seed, time, weather) → folder of a small scene with its true temperature, made once."""

    @cache
    def made(kind, seed=0, time=None, weather=None):
        folder = tmp_path_factory.mktemp("truth") / kind
        scene = make(kind, seed, *SMALL[kind], time=time, weather=weather)
        return procedural_truth.write(scene, folder, temperature_every=1)

    return made


def stored(folder):
    """Kelvin of a scene's stored temperature."""
    with rasterio.open(folder / "temperature.tif") as file:
        return file.read(1) * file.scales[0] + file.offsets[0]


def by_class(folder):
    """{material: median of its true temperature [K]} of a scene whose rasters have the same texels."""
    with rasterio.open(folder / "classes.tif") as file:
        classes = file.read(1)
    names = tomllib.loads((folder / "scene.toml").read_text(encoding="utf-8"))["emissivity"]["classes"]
    kelvin = stored(folder)
    return {name: np.median(kelvin[classes == int(k)]) for k, name in names.items() if (classes == int(k)).any()}


def in_the_open(folder, kind):
    """{material: true temperature [K]} of a land of seed 0 if each material was level, in the open and uniform."""
    true, exchange = procedural_truth.drawn(load_scene(folder), kind, 0)
    weather, inside_k = true.weather, true.spec.weather.inside_c + 273.15
    materials = in_weather(true.materials, weather, true.time)
    columns = open_ground.columns(materials, weather, station_roughness_m=open_ground.STATION_ROUGHNESS_M)
    columns = replace(columns, ground=columns.ground._replace(log_heat=columns.ground.log_heat / exchange))
    start = true.time - np.timedelta64(48, "h")
    state, _ = open_ground.settled(columns, weather, start, inside_k)
    state = open_ground.march(columns, weather, state, start, true.time, inside_k)[-1]
    seen = balance.seen_k(state, columns.ground)
    return {material.name: kelvin for material, kelvin in zip(materials, seen, strict=True)}


@pytest.fixture
def unsolved(monkeypatch):
    """No heat balance: a known field replaces the true temperature."""
    field = lambda loaded, scene, progress=None: np.float32(280.0) + np.float32(0.05) * scene.classes  # noqa: E731
    monkeypatch.setattr(procedural_truth, "true_temperature", field)
    return field


def class_residual(temperature, classes):
    """Standard deviation that remains when each class's mean is known [K]."""
    residual = temperature.astype(np.float64).copy()
    for value in np.unique(classes):
        residual[classes == value] -= residual[classes == value].mean()
    return residual.std()


def colour_residual(temperature, picture):
    """Standard deviation that remains after the best linear fit on red, green, blue and a constant [K]."""
    design = np.column_stack([picture.reshape(-1, 3) / 255.0, np.ones(temperature.size)])
    target = temperature.astype(np.float64).ravel()
    return (target - design @ np.linalg.lstsq(design, target, rcond=None)[0]).std()


@pytest.mark.parametrize("kind", ["heath", *slow("ridge"), "village"])
def test_a_small_scene_is_complete_and_plausible(kind):
    scene = small(kind)
    size, texel, post = SMALL[kind]
    n, p = round(size / texel), round(size / post)
    assert scene.elevation.shape == (p, p) and scene.elevation.dtype == np.float32
    assert scene.orthophoto.shape == (n, n, 3) and scene.orthophoto.dtype == np.uint8
    assert scene.classes.shape == (n, n)
    assert set(np.unique(scene.classes)) <= set(scene.class_names)
    assert scene.deviations.columns(n * n).shape == (4, n * n)
    # Every class has the properties that the balance needs.
    library = load_library()
    assert all(library[name].thermal for name in scene.class_names.values())
    # In the band, under clear air: below that of all long-wave, and colder for drier and thinner air.
    assert 205.0 <= scene.sky_temperature <= 255.0
    assert scene.orthophoto.std() > 12.0


@pytest.mark.parametrize("kind", KINDS)
def test_objects_and_flight_are_inside_the_scene(kind):
    scene = small(kind)
    half = 0.5 * scene.size_m
    assert scene.objects
    for item in scene.objects:
        assert np.abs(item["position"][:2]).max() < half, item["name"]
        assert len(item["size"]) == len(item["position"]) == len(item["colour"]) == 3
        assert item["temperature"] > 270.0
    assert len({item["name"] for item in scene.objects}) == len(scene.objects)
    flight = scene.flight
    assert np.abs(flight["east_m"]).max() < half and np.abs(flight["north_m"]).max() < half
    assert np.allclose(np.diff(flight["time_s"]), 0.5) and 10.0 <= flight["time_s"][-1] <= 12.0
    assert (flight["gimbal_pitch_deg"] >= -90.0).all() and (flight["gimbal_pitch_deg"] < 0.0).all()
    assert ((flight["yaw_deg"] >= 0.0) & (flight["yaw_deg"] < 360.0)).all()
    assert flight["above_ground_m"].min() > (100.0 if kind == "ridge" else 60.0)


def test_the_heath_has_a_warm_marker_near_its_middle():
    (marker,) = (item for item in small("heath").objects if item["name"] == "marker")
    assert marker["temperature"] == 330.0
    assert 1.0 <= marker["size"][0] <= 2.0
    assert np.hypot(*marker["position"][:2]) < 20.0


@pytest.mark.slow
def test_the_same_seed_gives_the_same_bytes_and_another_seed_another_place(truth, tmp_path):
    one, other = truth("heath"), truth("heath", 1)
    two = procedural_truth.write(make("heath", 0, *SMALL["heath"]), tmp_path / "two", temperature_every=1)
    names = sorted(p.name for p in one.iterdir())
    assert names == [
        "classes.tif", "elevation.tif", "flight.csv", "orthophoto.tif", "scene.toml", "temperature.tif"
    ]  # fmt: skip
    for name in names:
        assert (one / name).read_bytes() == (two / name).read_bytes(), name
    for name in ("classes.tif", "elevation.tif", "orthophoto.tif", "temperature.tif"):
        assert (one / name).read_bytes() != (other / name).read_bytes(), name
    difference = small("heath").elevation - small("heath", 1).elevation
    assert np.abs(difference).max() > 1.0


def test_texts_with_quotes_and_backslashes_are_written_unchanged():
    title = 'A "heath" of C:\\new, in\ntwo lines'
    (item, *_) = small("heath").objects
    scene = replace(small("heath"), title=title, objects=({**item, "name": 'the "marker"'},))
    spec = tomllib.loads(scene_toml(scene))
    assert spec["title"] == title and spec["object"][0]["name"] == 'the "marker"'


def test_written_files_equal_the_generated_arrays(tmp_path, unsolved):
    scene = small("village")
    folder = procedural_truth.write(scene, tmp_path / "village")
    with rasterio.open(folder / "temperature.tif") as file:
        assert file.res == (2 * scene.texel_m,) * 2 and file.crs.to_epsg() == 32634
        extent = file.bounds
    found = stored(folder)
    n = len(found)
    mean = unsolved(None, scene).astype(np.float64).reshape(n, 2, n, 2).mean(axis=(1, 3))
    assert np.abs(found - mean).max() <= 0.0101
    for name in ("orthophoto.tif", "elevation.tif", "classes.tif"):
        with rasterio.open(folder / name) as file:
            assert file.bounds == extent
            raster = file.read()
        if name == "classes.tif":
            assert (raster[0] == scene.classes).all()
        if name == "elevation.tif":
            assert (raster[0] == scene.elevation).all()
    spec = tomllib.loads((folder / "scene.toml").read_text(encoding="utf-8"))
    assert spec["temperature"] == {"source": "raster", "raster": "temperature.tif"}
    assert spec["emissivity"]["classes"] == {str(k): v for k, v in scene.class_names.items()}
    assert [item["name"] for item in spec["object"]] == [item["name"] for item in scene.objects]
    assert load_scene(folder).spec.weather == scene.weather
    with open(folder / "flight.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["time_s", "east_m", "north_m", "above_ground_m", "yaw_deg", "gimbal_pitch_deg"]
    assert float(rows[3]["above_ground_m"]) == pytest.approx(scene.flight["above_ground_m"][3], abs=6e-4)


def test_flight_altitude_is_smooth_over_the_surface_model():
    scene = small("heath")
    half, post = 0.5 * scene.size_m, scene.post_m
    row = ((half - scene.flight["north_m"]) / post).astype(int)
    column = ((scene.flight["east_m"] + half) / post).astype(int)
    altitude = scene.flight["above_ground_m"] + scene.elevation[row, column]
    assert np.ptp(altitude) < 3.0


@pytest.mark.parametrize("kind", ["ridge", *slow("heath", "village")])
def test_shipped_scene_is_small_and_hard_to_guess(kind):
    assert sum(p.stat().st_size for p in (SCENES / kind).rglob("*") if p.is_file()) <= 10_000_000
    folder = SCENES / kind / "survey"
    with rasterio.open(folder / "temperature.tif") as file:
        temperature = file.read(1) * file.scales[0] + file.offsets[0]
    with rasterio.open(folder / "classes.tif") as file:
        factor = file.width // temperature.shape[1]
        classes = file.read(1)
    with rasterio.open(folder / "orthophoto.tif") as file:
        picture = file.read().transpose(1, 2, 0)
    assert classes.shape[0] == factor * temperature.shape[0]
    full = np.repeat(np.repeat(temperature, factor, 0), factor, 1)
    # Knowing every texel's class, or its colour, leaves an error of more than a kelvin.
    assert class_residual(full, classes) >= 1.0
    assert colour_residual(full[::4, ::4], picture[::4, ::4].astype(np.float64)) >= 1.0
    assert np.percentile(temperature, 0.5) > 265.0 and np.percentile(temperature, 99.5) < 330.0
    text = (folder / "scene.toml").read_text(encoding="utf-8")
    assert f"kind {kind}, seed 0" in text
    loaded = load_scene(folder)
    assert loaded.spec.weather == KINDS[kind].weather and not loaded.balanced


def test_the_error_of_an_unknown_kind_lists_the_known_ones():
    with pytest.raises(
        ThermorenderError, match="kind='moor' is not a synthetic scene; choose one of heath, village, ridge"
    ):
        make("moor")


@pytest.mark.filterwarnings("error")
def test_the_largest_seeds_give_different_places():
    drawn = {stream(seed, "heat").integers(2**62) for seed in (2**63, 2**63 + 1, 2**64 - 1)}
    assert len(drawn) == 3


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"seed": -1}, "seed=-1 must be a whole number of at least 0"),
        ({"seed": 2**64}, "seed=18446744073709551616 must be .* less than 2⁶⁴"),
        ({"seed": np.nan}, "seed=nan must be a whole number"),
        ({"size_m": 1e5, "texel_m": 100.0, "post_m": 1e3}, "size_m=100000 is more than the 6400 m that a heath"),
        ({"size_m": 100.0, "texel_m": 0.3}, "texel_m=0.3 does not divide size_m=100"),
        ({"size_m": 100.0, "texel_m": 1.0, "post_m": 0.5}, "post_m=0.5 is smaller than texel_m=1"),
        ({"size_m": -5.0}, "size_m=-5 must be a length in metres above 0"),
        ({"size_m": 5000.0, "texel_m": 0.25}, "makes 20000 texels a side; 64 to 8000 are allowed"),
    ],
)
def test_sizes_that_do_not_fit_are_refused(arguments, words):
    with pytest.raises(ThermorenderError, match=words):
        make("heath", **arguments)


def test_a_folder_in_use_is_not_overwritten_unasked(tmp_path, unsolved):
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "notes.txt").write_text("keep me")
    with pytest.raises(ThermorenderError, match="exists and is not empty; give a new folder"):
        procedural_truth.write(small("heath"), folder)
    assert (folder / "notes.txt").read_text() == "keep me"
    procedural_truth.write(small("heath"), folder, overwrite=True)
    assert (folder / "scene.toml").exists() and not (folder / "notes.txt").exists()
    assert [p.name for p in tmp_path.iterdir()] == ["mine"]


def test_a_failed_write_leaves_nothing_behind(tmp_path, monkeypatch):
    def fail(flight):
        raise OSError("disk full")

    monkeypatch.setattr("thermorender.apps.lands.procedural.scene_files.flight_csv", fail)
    with pytest.raises(ThermorenderError, match="scene cannot be written: disk full"):
        procedural_truth.write(small("heath"), tmp_path / "scene")
    assert list(tmp_path.iterdir()) == []


def test_temperature_grid_must_divide(tmp_path):
    with pytest.raises(ThermorenderError, match="temperature_every=7 does not divide the 220 texels"):
        procedural_truth.write(small("heath"), tmp_path / "scene", temperature_every=7)


# --- truth and prediction -----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_balance_predicts_the_truth_except_for_hidden_properties(truth, monkeypatch, tmp_path):
    """With source="balance" the written scene differs from the truth by its hidden random properties only."""
    from thermorender.render.heat.simulation import solved

    folder = truth("heath")
    shown = load_scene(folder)
    asked = shown.with_temperature(TemperatureSpec(source="balance"))
    predicted = solved(asked, [asked.time])[0].surfaces[0].temperature
    error = shown.surfaces[0].temperature - predicted
    # Tables are accurate to a few kelvin at a clear noon, and texels deviate by about one.
    assert 0.5 < np.abs(error).mean() < 4.0 and error.std() > 0.7

    scene = small("heath")
    one = np.ones_like(scene.deviations.wetness)
    monkeypatch.setattr(procedural_truth, "drawn", lambda loaded, kind, seed: (loaded, 1.0))
    plain = procedural_truth.true_temperature(asked, replace(scene, deviations=Deviations(one, one, one, one)))
    # Texels of a face may share a column where no data distinguish them: 0.1 K.
    assert np.sqrt(((plain - predicted) ** 2).mean()) < 0.1
    hidden = procedural_truth.true_temperature(asked, scene) - predicted
    assert 0.4 < np.abs(hidden - hidden.mean()).mean() < 1.6


@pytest.mark.slow
def test_drawn_properties_have_the_mean_and_spread_of_the_tables(tmp_path):
    write_declared(small("village"), tmp_path)
    loaded = load_scene(tmp_path)
    count = 400
    made = [procedural_truth.drawn(loaded, "village", seed) for seed in range(count)]
    for number, material in enumerate(loaded.materials):
        table = material.thermal
        for key in ("conductivity_w_m_k", "density_kg_m3", "specific_heat_j_kg_k"):
            values = np.array([getattr(scene.materials[number].thermal, key) for scene, _ in made])
            # Mean and spread of 400 within four standard errors; those of a skewed spread are wider.
            mean, spread = getattr(table, key), table.uncertainty[key]
            assert abs(values.mean() - mean) < 4.0 * spread / np.sqrt(count)
            assert values.std() == pytest.approx(spread, rel=0.25)
        absorptance = np.array([scene.materials[number].solar_absorptance for scene, _ in made])
        assert ((absorptance > 0.0) & (absorptance < 1.0)).all()
        assert all(0.0 <= scene.materials[number].thermal.wetness <= 1.0 for scene, _ in made)
    factor = np.array([exchange for _, exchange in made])
    assert factor.mean() == pytest.approx(1.0, abs=0.04) and np.log(factor).std() == pytest.approx(0.2, rel=0.15)
    inside = np.array([scene.spec.weather.inside_c for scene, _ in made])
    assert inside.mean() == pytest.approx(20.0, abs=0.4) and inside.std() == pytest.approx(2.0, rel=0.15)
    # The tables themselves are unchanged; a soil beneath grass is the same as the soil beside it.
    (one, _), (again, _) = made[0], procedural_truth.drawn(loaded, "village", 0)
    named = {material.name: material.thermal for material in one.materials}
    assert named == {material.name: material.thermal for material in again.materials}
    assert named["grass_green"].below == named["soil_loam"]
    assert procedural_truth.drawn(loaded, "heath", 0)[1] != made[0][1]


def test_wet_soil_is_darker_and_dry_grass_yellower_with_scatter():
    for name, channel, sign in (("soil_loam", slice(None), -1.0), ("grass_dry", 0, -1.0)):
        canvas = Canvas(5, 400.0, 1.0)
        canvas.paint(np.ones(canvas.shape, np.float32), np.float32([0.3, 0.25, 0.2]), name)
        before = canvas.albedo.copy()
        found = deviations_of(canvas)
        tint = np.log(canvas.albedo / before)
        seen = tint[..., channel] if channel == 0 else tint.mean(axis=-1)
        # 0.6 of the moisture is visible, whose share of wetness is 0.55 / √(0.55² + 0.30²): 0.53, from few patches.
        assert sign * np.corrcoef(seen.ravel(), np.log(found.wetness).ravel())[0, 1] == pytest.approx(0.53, abs=0.17)
        # Wettest against driest soil: a factor of two at most, as between dry and saturated.
        assert 0.05 < seen.std() < 0.3
        if name == "grass_dry":
            red, _, blue = (tint[..., k][seen > 0.0] for k in range(3))
            assert (red > blue).all()
            assert np.exp(np.ptp(np.quantile(seen, [0.02, 0.98]))) < 2.2


def test_deviations_depend_only_on_the_seed():
    first, second = small("heath").deviations, small("heath", 1).deviations
    later = make("heath", 0, *SMALL["heath"], time="2018-09-12T22:00Z").deviations
    for name, values in vars(first).items():
        assert np.exp(np.log(values).std()) > 1.05
        assert abs(np.corrcoef(values.ravel(), getattr(second, name).ravel())[0, 1]) < 0.5, name
        assert (values == getattr(later, name)).all(), name


# --- hours and weathers -------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_weather_changes_the_temperature_but_not_the_land(truth):
    day, night = truth("village"), truth("village", 0, NIGHT)
    for name in ("classes.tif", "elevation.tif", "flight.csv"):
        assert (day / name).read_bytes() == (night / name).read_bytes(), name
    assert stored(day).mean() > stored(night).mean() + 6.0
    # Photographed at noon of that day instead.
    with rasterio.open(night / "orthophoto.tif") as file:
        assert file.read().mean() > 60.0


@pytest.mark.slow
def test_afternoon_temperatures_are_in_the_observed_order(truth):
    for kind, seed in (("heath", 0), ("village", 0)):
        found = by_class(truth(kind, seed))
        air = conditions(KINDS[kind].weather, KINDS[kind].latitude_deg, KINDS[kind].altitude_m).air_k
        assert found["asphalt"] > found["grass_green"] + 2.0
        assert found["grass_green"] > found["conifer"] + 0.5
        assert found["water"] < found["grass_green"]
        # Trees follow the air: transpiring and half in shade, 2 K below it, plus two random deviations of 1.5 K.
        assert found["conifer"] == pytest.approx(air, abs=3.0)


@pytest.mark.slow
def test_the_order_of_thin_roofs_and_stone_reverses_at_night(truth):
    """Leaves store as little as thin roofs, and asphalt as much as stone.

    Both pairs differ at night by what the thin one loses to the cold sky. Surroundings about as warm as the air hide
    part of its sky, so of the difference in the open at least its visible share remains.
    """
    folder = truth("village", 0, NIGHT)
    day, night, flat = by_class(truth("village")), by_class(folder), in_the_open(folder, "village")
    assert day["roof_shingle"] > day["concrete"] + 1.0
    scene = load_scene(folder)
    names, view = [material.name for material in scene.materials], relief(scene, scene.time)["sky_view"]
    for thin, stone in (("roof_shingle", "concrete"), ("grass_green", "asphalt")):
        share = np.median(view[scene.surfaces[0].material == names.index(thin)])
        assert 0.75 < share < 1.0
        assert night[stone] - night[thin] > share * (flat[stone] - flat[thin]) > 1.0
    air = conditions(weather_of("village", time=NIGHT), KINDS["village"].latitude_deg, 134.0).air_k
    assert night["conifer"] == pytest.approx(air, abs=3.0)
    assert min(night.values()) > air - 10.0


@pytest.mark.slow
def test_a_winter_morning_with_snow(truth):
    folder = truth("ridge", 0, None, WINTER)
    found = by_class(folder)
    with rasterio.open(folder / "classes.tif") as file:
        classes = file.read(1)
    names = tomllib.loads((folder / "scene.toml").read_text(encoding="utf-8"))["emissivity"]["classes"]
    snow = np.isin(classes, [int(k) for k, name in names.items() if name == "snow"])
    assert snow.mean() > 0.5 and "water" not in found and "conifer" in found
    kelvin = stored(folder)
    # Within half a post of the edge there is no mesh: texels there take their neighbour's temperature.
    assert (kelvin * snow)[2:-2, 2:-2].max() <= 273.15 + 0.01
    assert 245.0 < np.median(kelvin[snow]) < 271.0
    # Snow insulates: bare places are warmer.
    assert found["granite"] > found["snow"]
    with rasterio.open(folder / "orthophoto.tif") as file:
        picture = file.read().mean(axis=0)
    assert np.percentile(picture[snow], 75) > 1.3 * np.percentile(picture[~snow], 75)


@pytest.mark.slow
def test_old_snow_melts_at_the_melting_point(truth):
    found = by_class(truth("ridge"))
    assert 270.0 < found["snow"] <= 273.15 + 0.01 < found["grass_dry"]


def test_no_snow_on_walls_warm_glass_and_open_water():
    mild = replace(WINTER, air_low_c=-4.0, air_high_c=1.0, time=np.datetime64("2018-01-17T10:00:00"))
    bare, covered, frozen = (make("village", 0, *SMALL["village"], weather=w) for w in (None, mild, WINTER))
    bare, covered, frozen = (np.vectorize(s.class_names.get)(s.classes) for s in (bare, covered, frozen))
    for kept in ("water", "glass"):
        assert (covered[bare == kept] == kept).all()
    # Surfaces that carry ice carry snow.
    assert not (frozen == "water").any() and (frozen[bare == "water"] == "snow").mean() > 0.9
    assert (covered[bare == "asphalt"] == "snow").mean() > 0.95
    # Trees carry part of it.
    assert 0.1 < (covered[bare == "broadleaf"] == "snow").mean() < 0.9


def test_heated_objects_keep_their_temperature_and_others_follow_the_weather():
    items = [{"name": "fire", "temperature": 620.0, "heated": True}, {"name": "car", "temperature": 302.0}]
    fire, car = follows(items, (263.0, 0.0), (295.0, 600.0))
    assert fire == {"name": "fire", "temperature": 620.0} and car["temperature"] == 263.0
    assert follows(items, (290.0, 300.0), (295.0, 600.0))[1]["temperature"] == 293.5
    objects = {item["name"]: item["temperature"] for item in make("heath", 0, *SMALL["heath"], weather=WINTER).objects}
    assert objects["marker"] == 330.0 and objects["car"] < 273.15
    usual = {item["name"]: item["temperature"] for item in small("heath").objects}
    assert usual["car"] == 302.0


def test_the_photograph_is_taken_by_day():
    azimuth, elevation = sun_of_photograph(np.datetime64("2018-09-12T12:44:00"), 52.2)
    # pvlib 0.16.1, spa_python: 221.28, 34.71.
    assert (azimuth, elevation) == pytest.approx((221.28, 34.71), abs=0.05)
    azimuth, elevation = sun_of_photograph(np.datetime64("2018-09-12T23:44:00"), 52.2)
    assert azimuth == pytest.approx(180.0, abs=0.5) and elevation == pytest.approx(90.0 - 52.2 + 4.0, abs=0.5)


def test_the_sky_of_the_band():
    place = 52.2, 112.0
    clear = KINDS["heath"].weather
    overcast = replace(clear, cloud=1.0)
    found = {w.cloud: conditions(w, *place) for w in (clear, overcast)}
    sky = {w.cloud: sky_temperature(w, found[w.cloud], 112.0) for w in (clear, overcast)}
    # Black clouds 1500 m up are 9.75 K colder than the air below them, and the air between is warmer than the clouds.
    air = found[1.0].air_k
    assert air - 9.75 < sky[1.0] < air - 2.0
    # Less radiation comes down in the window than at all wavelengths.
    assert sky[0.0] < (found[0.0].longwave_w_m2 / 5.670374e-8) ** 0.25 - 10.0


@pytest.mark.slow
def test_weathers_of_seeds_match_the_given_climate():
    made = [drawn_weather(seed) for seed in range(3000)]
    month = np.array([w.time.astype("M8[M]").astype(int) % 12 for w in made])
    hour = np.array([w.time.astype("M8[h]").astype(int) % 24 for w in made])
    mean = np.array([0.5 * (w.air_low_c + w.air_high_c) for w in made])
    # Warsaw 1991–2020 (IMGW): January −1.5, April 9.1, July 19.7, October 8.9 °C; standard error of 250 draws 0.3 K.
    for number, celsius in ((0, -1.5), (3, 9.1), (6, 19.7), (9, 8.9)):
        assert mean[month == number].mean() == pytest.approx(celsius, abs=1.5)
    assert np.bincount(hour).min() > 80 and np.bincount(month).min() > 190
    snow = np.array([w.snow_depth_m for w in made])
    assert 0.1 < (snow > 0.0).mean() < 0.25 and snow[(month > 4) & (month < 9)].max() == 0.0 and snow.max() <= 0.5
    cloud, wind = (np.array([getattr(w, key) for w in made]) for key in ("cloud", "wind_m_s"))
    assert (cloud < 0.1).mean() > 0.15 and (cloud > 0.9).mean() > 0.2 and 0.5 <= wind.min() <= wind.max() <= 12.0
    for weather in made[:100]:
        found = conditions(weather, 52.2, 112.0)
        assert np.isfinite(list(found)).all() and found.vapour_pa > 0.0
        assert 150.0 < sky_temperature(weather, found, 112.0) <= found.air_k + 0.5
    # Higher land is colder by 6.5 K per km, and the weather does not depend on the kind.
    assert weather_of("heath", 7).time == weather_of("ridge", 7).time
    assert weather_of("heath", 7).air_low_c - weather_of("ridge", 7).air_low_c == pytest.approx(9.3, abs=0.11)


def test_the_command_takes_time_and_weather(tmp_path, unsolved):
    small_one = ["--size-m", "60", "--texel-m", "0.5", "--post-m", "1"]

    def run(name, *more):
        return CliRunner().invoke(
            cli.app, ["make-scene", "village", "--draped", "-o", str(tmp_path / name), *small_one, *more]
        )

    given = ("--time", "2018-02-03T16:30+01:00", "--air-low-c=-9", "--air-high-c=-1", "--humidity", "0.9", "--wind-m-s",
             "1.5", "--cloud", "0.4", "--snow-depth-m", "0.2")  # fmt: skip
    assert run("given", *given).exit_code == 0
    weather = load_scene(tmp_path / "given").spec.weather
    assert weather == WeatherSpec(
        time=np.datetime64("2018-02-03T15:30:00"), air_low_c=-9.0, air_high_c=-1.0, humidity=0.9, wind_m_s=1.5,
        cloud=0.4, snow_depth_m=0.2,
    )  # fmt: skip
    assert run("drawn", "--weather-seed", "12", "--wind-m-s", "2.5").exit_code == 0
    drawn = load_scene(tmp_path / "drawn").spec.weather
    assert drawn == replace(weather_of("village", 12), wind_m_s=2.5)
    for more, words in (
        (("--air-low-c", "40"), "air_low_c=40, air_high_c=23.9 are not allowed"),
        (("--cloud", "3"), "cloud=3 is not allowed; give 0…1"),
        (("--time", "2018-02-03T16:30"), "time=2018-02-03T16:30 has no zone"),
        (("--weather-seed", "-1"), "weather_seed=-1 must be a whole number"),
    ):
        done = run("refused", *more)
        assert isinstance(done.exception, ThermorenderError) and words in str(done.exception), done.exception
        assert not (tmp_path / "refused").exists()
    with pytest.raises(ThermorenderError, match="has no air_high_c; declare a day with it"):
        make("heath", weather=WeatherSpec(time=WINTER.time))


# --- light and noise ----------------------------------------------------------------------------------------------


def test_a_wall_casts_a_shadow_of_its_length():
    surface = np.zeros((80, 80), np.float32)
    surface[:, 20:22] = 10.0
    # Sun in the west at 45°: the shadow falls 10 m to the east.
    visible = sun_visibility(surface, 0.5, 270.0, 45.0)
    assert (visible[40, 24:40] == 0.0).all()
    assert (visible[40, 43:] == 1.0).all() and (visible[40, :20] == 1.0).all()
    assert (visible[40, 20:22] == 1.0).all()


def test_level_ground_sees_the_whole_sky_and_a_wall_hides_half():
    surface = np.zeros((128, 128), np.float32)
    assert sky_view(surface, 1.0).min() == pytest.approx(1.0)
    surface[:, 64:] = 200.0
    assert sky_view(surface, 1.0)[64, 62] == pytest.approx(0.5, abs=0.03)


def test_a_slope_towards_the_sun_gets_the_most_light():
    rows = np.arange(40, dtype=np.float32)[:, None] * np.ones((1, 40), np.float32)
    # Heights grow to the north (row 0): the slope faces south.
    cosine = incidence(normals(39.0 - rows, 1.0), 180.0, 45.0)
    assert cosine[20, 20] == pytest.approx(1.0, abs=1e-6)
    assert incidence(normals(rows, 1.0), 180.0, 45.0)[20, 20] == pytest.approx(0.0, abs=1e-6)


def test_noise_has_unit_variance_and_streams_are_independent():
    field = fractal_noise(stream(3, "a"), (400, 400), 0.25, 8.0)
    assert field.std() == pytest.approx(1.0, abs=0.2) and abs(field.mean()) < 0.25
    again = fractal_noise(stream(3, "a"), (400, 400), 0.25, 8.0)
    assert (field == again).all()
    other = fractal_noise(stream(3, "b"), (400, 400), 0.25, 8.0)
    assert abs(np.corrcoef(field.ravel(), other.ravel())[0, 1]) < 0.2
