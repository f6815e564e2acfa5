"""Procedural scenes: repeatable to the byte, plausible in kelvin, and not to be had from colour or class."""

import csv
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import rasterio

from thermorender.errors import ThermorenderError
from thermorender.physics import sun
from thermorender.physics.heat import STEFAN_BOLTZMANN, march_hours, saturation_vapour, step
from thermorender.synthetic import heath
from thermorender.synthetic.heat import THERMAL, Weather, surface_temperature
from thermorender.synthetic.light import incidence, normals, sky_view, sun_visibility
from thermorender.synthetic.noise import fractal_noise, stream
from thermorender.synthetic.worlds import KINDS, make, write

try:
    import tomllib
except ImportError:  # Python 3.10
    import tomli as tomllib

SCENES = Path(__file__).parents[1] / "scenes"
# Small enough to be grown in a second or two.
SMALL = {"heath": (110.0, 0.5, 1.0), "village": (120.0, 0.5, 1.0), "ridge": (480.0, 3.0, 6.0)}


@cache
def small(kind, seed=0):
    return make(kind, seed, *SMALL[kind])


def class_residual(temperature, classes):
    """Standard deviation left when each class's own mean is known [K]."""
    residual = temperature.astype(np.float64).copy()
    for value in np.unique(classes):
        residual[classes == value] -= residual[classes == value].mean()
    return residual.std()


def colour_residual(temperature, picture):
    """Standard deviation left by the best linear fit on red, green, blue and a constant [K]."""
    design = np.column_stack([picture.reshape(-1, 3) / 255.0, np.ones(temperature.size)])
    target = temperature.astype(np.float64).ravel()
    return (target - design @ np.linalg.lstsq(design, target, rcond=None)[0]).std()


@pytest.mark.parametrize("kind", KINDS)
def test_a_small_scene_is_whole_and_plausible(kind):
    scene = small(kind)
    size, texel, post = SMALL[kind]
    n, p = round(size / texel), round(size / post)
    assert scene.elevation.shape == (p, p) and scene.elevation.dtype == np.float32
    assert scene.orthophoto.shape == (n, n, 3) and scene.orthophoto.dtype == np.uint8
    assert scene.classes.shape == scene.temperature.shape == (n, n)
    assert set(np.unique(scene.classes)) <= set(scene.class_names)
    assert set(scene.class_names.values()) <= set(THERMAL)
    assert 255.0 <= scene.sky_temperature <= 265.0
    low, high = np.percentile(scene.temperature, [0.1, 99.9])
    assert 255.0 < low < high < 340.0
    assert np.isfinite(scene.temperature).all() and scene.temperature.max() < 350.0
    for value, name in scene.class_names.items():
        here = scene.temperature[scene.classes == value]
        if name == "snow" and here.size:
            assert here.max() <= 273.151
    assert scene.orthophoto.std() > 12.0


@pytest.mark.parametrize("kind", KINDS)
def test_objects_and_flight_lie_inside(kind):
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


def test_same_seed_same_bytes_other_seed_other_place(tmp_path):
    one = write(small("heath"), tmp_path / "one")
    two = write(make("heath", 0, *SMALL["heath"]), tmp_path / "two")
    other = write(small("heath", 1), tmp_path / "other")
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


def test_texts_with_quotes_and_backslashes_are_written_as_they_are(tmp_path):
    title = 'A "heath" of C:\\new, in\ntwo lines'
    (item, *_) = small("heath").objects
    scene = replace(small("heath"), title=title, objects=({**item, "name": 'the "marker"'},))
    spec = tomllib.loads((write(scene, tmp_path / "odd") / "scene.toml").read_text(encoding="utf-8"))
    assert spec["title"] == title and spec["object"][0]["name"] == 'the "marker"'


def test_what_is_written_is_what_was_made(tmp_path):
    scene = small("village")
    folder = write(scene, tmp_path / "village")
    with rasterio.open(folder / "temperature.tif") as file:
        stored = file.read(1) * file.scales[0] + file.offsets[0]
        assert file.res == (2 * scene.texel_m,) * 2 and file.crs.to_epsg() == 32634
        extent = file.bounds
    n = len(stored)
    mean = scene.temperature.astype(np.float64).reshape(n, 2, n, 2).mean(axis=(1, 3))
    assert np.abs(stored - mean).max() <= 0.0101
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


@pytest.mark.parametrize("kind", KINDS)
def test_shipped_scene_is_small_and_hard_to_guess(kind):
    folder = SCENES / kind
    assert sum(p.stat().st_size for p in folder.iterdir()) <= 3_000_000
    with rasterio.open(folder / "temperature.tif") as file:
        temperature = file.read(1) * file.scales[0] + file.offsets[0]
    with rasterio.open(folder / "classes.tif") as file:
        factor = file.width // temperature.shape[1]
        classes = file.read(1)
    with rasterio.open(folder / "orthophoto.tif") as file:
        picture = file.read().transpose(1, 2, 0)
    assert classes.shape[0] == factor * temperature.shape[0]
    full = np.repeat(np.repeat(temperature, factor, 0), factor, 1)
    # Knowing every texel's class, or its colour, leaves more than a kelvin open.
    assert class_residual(full, classes) >= 1.0
    assert colour_residual(full[::4, ::4], picture[::4, ::4].astype(np.float64)) >= 1.0
    assert 265.0 < np.percentile(temperature, 0.5) and np.percentile(temperature, 99.5) < 330.0
    text = (folder / "scene.toml").read_text(encoding="utf-8")
    assert f"kind {kind}, seed 0" in text
    assert set(tomllib.loads(text)["emissivity"]["classes"].values()) <= set(THERMAL)


def test_unknown_kind_lists_the_right_ones():
    with pytest.raises(
        ThermorenderError, match="kind='moor' is not a synthetic scene; choose one of heath, village, ridge"
    ):
        make("moor")


@pytest.mark.filterwarnings("error")
def test_the_largest_seeds_are_other_places_too():
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


def test_a_folder_in_use_is_not_overwritten_unasked(tmp_path):
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "notes.txt").write_text("keep me")
    with pytest.raises(ThermorenderError, match="exists and is not empty; give a new folder"):
        write(small("heath"), folder)
    assert (folder / "notes.txt").read_text() == "keep me"
    write(small("heath"), folder, overwrite=True)
    assert (folder / "scene.toml").exists() and not (folder / "notes.txt").exists()
    assert [p.name for p in tmp_path.iterdir()] == ["mine"]


def test_nothing_is_left_behind_when_writing_fails(tmp_path, monkeypatch):
    def fail(flight):
        raise OSError("disk full")

    monkeypatch.setattr("thermorender.synthetic.files.flight_csv", fail)
    with pytest.raises(ThermorenderError, match="scene cannot be written: disk full"):
        write(small("heath"), tmp_path / "scene")
    assert list(tmp_path.iterdir()) == []


def test_temperature_grid_must_divide(tmp_path):
    with pytest.raises(ThermorenderError, match="temperature_every=7 does not divide the 220 texels"):
        write(small("heath"), tmp_path / "scene", temperature_every=7)


def test_sun_stands_where_the_almanac_says():
    azimuth, elevation = sun.position(52.0, 0.0, 12.0)
    assert azimuth == pytest.approx(180.0) and elevation == pytest.approx(38.0)
    azimuth, elevation = sun.position(52.0, 0.0, 18.0)
    assert azimuth == pytest.approx(270.0) and elevation == pytest.approx(0.0, abs=1e-9)
    # Overhead, where rounding makes a sine of more than 1.
    for at in np.linspace(-23.4, 23.4, 200):
        assert sun.position(at, at, 12.0)[1] == pytest.approx(90.0, abs=1e-5)


def bumpy(hour, latitude, declination):
    """Temperature of a small hilly landscape of five materials, and its Weather."""
    weather = Weather(latitude, declination, hour, 283.0, 295.0, 260.0, 1000.0, 2.0)
    names = dict(enumerate(("grass_green", "sand_quartz", "asphalt", "water", "conifer")))
    row, column = np.mgrid[0:64, 0:64]
    surface = np.float32(4.0 * np.sin(row / 6.0) * np.cos(column / 9.0) + 50.0)
    material = np.uint8((row // 8 + column // 8) % len(names))
    return surface_temperature(surface, 1.0, material, names, weather, 3)[0], weather


@pytest.mark.parametrize("hour", [0.0, 3.0, 6.0, 12.0, 18.0, 23.9])
@pytest.mark.parametrize(
    ("latitude", "declination"), [(52.0, 8.0), (-35.0, 23.4), (0.0, 0.0), (75.0, 23.4), (75.0, -23.4), (-90.0, -23.4),
                                  (90.0, 0.0), (66.5, 23.45)]
)  # fmt: skip
def test_any_hour_at_any_latitude_is_plausible(hour, latitude, declination):
    temperature, weather = bumpy(hour, latitude, declination)
    assert np.isfinite(temperature).all()
    air, elevation = weather.air(hour), weather.sun(hour)[1]
    # By night nothing is warmer than the day's warmest air (lakes and stone give back), nor colder than the
    # balance of a dry, windless plate under this sky, 15 K below the coldest air.
    assert weather.air_low - 15.0 < temperature.min() and temperature.max() < weather.air_high + 45.0
    if weather.sun(hour - 3.0)[1] < 0.0 and elevation < 0.0:
        assert temperature.max() < weather.air_high + 1.0 and abs(np.median(temperature) - air) < 8.0
    # A day later the same sun stands there.
    assert np.abs(bumpy(hour + 24.0, latitude, declination)[0] - temperature).max() < 1e-3


def test_the_night_cools_and_the_morning_is_as_the_night_left_it():
    dusk, midnight, small_hours, dawn = (bumpy(hour, 52.0, 8.0)[0] for hour in (19.0, 24.0, 4.0, 5.4))
    assert dusk.mean() > midnight.mean() + 1.0 > small_hours.mean() + 1.5
    # Dawn's own temperature is a guess, from which a day is marched: within the few kelvins of what the night leaves.
    before = bumpy(sun.sunrise(52.0, 8.0) - 1e-3, 52.0, 8.0)[0]
    assert np.abs(dawn - before).mean() < 3.0


def test_march_begins_at_the_last_sunrise_and_never_runs_backwards():
    # Level ground sees the sun's centre rise at 6 h under the equator, and by cos h = −tan φ tan δ elsewhere.
    assert sun.sunrise(0.0, 10.0) == pytest.approx(6.0)
    assert sun.sunrise(52.0, 8.0) == pytest.approx(12.0 - np.degrees(np.arccos(-0.179885)) / 15.0, abs=1e-4)
    assert sun.position(52.0, 8.0, sun.sunrise(52.0, 8.0))[1] == pytest.approx(0.0, abs=1e-9)
    assert sun.sunrise(75.0, 23.4) is None and sun.sunrise(75.0, -23.4) is None and sun.sunrise(-90.0, 5.0) is None
    for latitude, declination in ((52.0, 8.0), (75.0, 23.4), (75.0, -23.4)):
        rise = sun.sunrise(latitude, declination)
        for hour in (-7.0, 0.0, 3.0, 5.0, 14.0, 24.0, 40.0):
            times = march_hours(latitude, declination, hour)
            assert times[-1] == hour and (np.diff(times) > 0.0).all() and np.diff(times).max() <= 1.2 + 1e-9
            if rise is None:
                assert hour - times[0] == pytest.approx(24.0)
            else:
                assert (times[0] - rise) / 24.0 == pytest.approx(round((times[0] - rise) / 24.0))
                assert hour - times[0] <= 24.0


def test_a_day_forgets_where_it_began():
    one, times = np.ones((1, 3), np.float32), march_hours(75.0, 23.4, 3.0)
    ends = []
    for start in (265.0, 305.0):
        temperature = np.float32(start) * one
        for begin, end in zip(times[:-1], times[1:], strict=True):
            # No radiation but its own, no wind, three inertias.
            temperature = step(
                temperature, 3600.0 * (end - begin), 0 * one, 330 * one, 0 * one, 0 * one, 285.0, 1000.0,
                np.float32([[300.0, 2000.0, 14000.0]]), 285 * one,
            )  # fmt: skip
        ends.append(temperature)
    # Force and restore: e^(−2π) of 40 K is 0.08 K; in twenty implicit steps (1 + 2π/20)⁻²⁰, 0.17 K.
    assert 0.01 < np.abs(ends[1] - ends[0]).max() < 0.17


@pytest.mark.parametrize("hour", [3.0, 22.0])
def test_a_scene_by_night_is_whole(monkeypatch, hour):
    monkeypatch.setattr(heath, "WEATHER", replace(heath.WEATHER, solar_hour=hour))
    scene = make("heath", 0, *SMALL["heath"])
    assert np.isfinite(scene.temperature).all() and 270.0 < scene.temperature.min() < scene.temperature.max() < 300.0
    assert scene.temperature.mean() < small("heath").temperature.mean() - 5.0
    # Skylight alone: darker than by day, and no texel without a number.
    assert 10.0 < scene.orthophoto.mean() < 0.8 * small("heath").orthophoto.mean()


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


def test_a_slope_towards_the_sun_is_lit_best():
    rows = np.arange(40, dtype=np.float32)[:, None] * np.ones((1, 40), np.float32)
    # Heights grow to the north (row 0): the slope looks south.
    cosine = incidence(normals(39.0 - rows, 1.0), 180.0, 45.0)
    assert cosine[20, 20] == pytest.approx(1.0, abs=1e-6)
    assert incidence(normals(rows, 1.0), 180.0, 45.0)[20, 20] == pytest.approx(0.0, abs=1e-6)


def test_balance_closes_at_equilibrium():
    one = np.ones((3, 4), np.float32)
    air, sky = 290.0, 260.0
    absorbed, longwave, exchange = 400.0 * one, STEFAN_BOLTZMANN * sky**4 * one, 14.0 * one
    # Almost no inertia: the step lands on the balance of fluxes.
    surface = step(
        290.0 * one, 3600.0, absorbed, longwave, exchange, 0.2 * one, air, 1000.0, 1e-3 * one, 285.0 * one
    )
    t = float(surface[0, 0])
    latent = 0.2 * 14.0 / 66.0 * (float(saturation_vapour(np.float64(t))[0]) - 1000.0)
    flux = 400.0 + 0.96 * STEFAN_BOLTZMANN * (sky**4 - t**4) - 14.0 * (t - air) - latent
    assert abs(flux) < 0.05
    # Great inertia: it stays where it was.
    slow = step(
        288.0 * one, 3600.0, absorbed, longwave, exchange, 0 * one, air, 1000.0, 1e7 * one, 288.0 * one
    )
    assert slow[0, 0] == pytest.approx(288.0, abs=0.01)


def test_wet_is_cooler_than_dry_and_inert_lags():
    one = np.ones((1, 1), np.float32)
    run = lambda wet, inertia: float(  # noqa: E731
        step(
            288 * one,
            7200.0,
            500 * one,
            260 * one,
            14 * one,
            wet * one,
            292.0,
            1000.0,
            inertia * one,
            288 * one,
        )[0, 0]
    )
    assert run(0.5, 400.0) < run(0.0, 400.0) - 3.0
    assert run(0.0, 2200.0) < run(0.0, 400.0) - 3.0


def test_saturation_vapour_matches_the_tables():
    # Allen et al., FAO 56, table 2.3: 1.228, 2.338, 4.243 kPa.
    pressure, slope = saturation_vapour(np.array([283.15, 293.15, 303.15]))
    assert pressure == pytest.approx([1228.0, 2338.0, 4243.0], abs=1.0)
    later, _ = saturation_vapour(293.15 + 0.5)
    earlier, _ = saturation_vapour(293.15 - 0.5)
    assert slope[1] == pytest.approx(later - earlier, rel=1e-3)


def test_noise_is_standardised_and_streams_are_independent():
    field = fractal_noise(stream(3, "a"), (400, 400), 0.25, 8.0)
    assert field.std() == pytest.approx(1.0, abs=0.2) and abs(field.mean()) < 0.25
    again = fractal_noise(stream(3, "a"), (400, 400), 0.25, 8.0)
    assert (field == again).all()
    other = fractal_noise(stream(3, "b"), (400, 400), 0.25, 8.0)
    assert abs(np.corrcoef(field.ravel(), other.ravel())[0, 1]) < 0.2
