"""Maps moved to another hour and weather: the model against draws from it, and scenes through the whole renderer."""

from dataclasses import replace

import numpy as np
import pytest
from heat_support import short_simulations

import thermorender as tr
from scenes import write_raster, write_terrain
from thermorender.errors import ThermorenderError
from thermorender.learned import temperature_map
from thermorender.materials.library import load_library
from thermorender.materials.mixture import mix
from thermorender.materials.shifted import PROPERTIES, shifted
from thermorender.scene.spec import TemperatureSpec, WeatherSpec
from thermorender.scene.surface import FALLBACK, UNMOVED
from thermorender.scene.temperature import map_error_k, trained
from thermorender.scene.temperature_state import Moved, Pending
from validation.moved import study

DAY = {"air_low_c": 11.0, "air_high_c": 23.0, "humidity": 0.7, "wind_m_s": 3.0, "cloud": 0.1}
KEYS = "\n".join(f"{key} = {value}" for key, value in DAY.items())
TABLES = f"""
[temperature.trained]
time = 2018-07-15T12:36:00Z
{KEYS}
[weather]
time = 2018-07-15T12:36:00Z
{KEYS}
"""
TRAINED = np.datetime64("2018-07-15T12:36:00")
HOUR = np.timedelta64(3600, "s")
LIBRARY = load_library()


def stripes(side=32):
    """Classes of grass and sand, half each."""
    return np.repeat([[1, 2]], side, axis=0).repeat(side // 2, axis=1)


def written(folder, extra=TABLES, **options):
    return write_terrain(folder, extra=extra, classes=stripes(), **options)


@pytest.fixture(scope="module", autouse=True)
def _short_simulations():
    """These tests do not judge the accuracy of simulations, only how they are used."""
    with short_simulations():
        yield


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A raster for the trained instant with a hole in it, requested at that instant."""
    temperature = np.full((32, 32), 300.0) + np.arange(32)[:, None] / 8.0
    temperature[:3, :3] = np.nan
    folder = written(tmp_path_factory.mktemp("moved") / "tiny", temperature=temperature)
    return tr.load_scene(folder)


@pytest.fixture(scope="module")
def tools():
    """The modules that import Mitsuba, imported on first use."""
    from thermorender.render.heat import moved
    from thermorender.render.heat import simulation as heat

    return heat, moved


def mapped(scene, kelvin, error_k):
    """The scene with other temperatures in its map, and their error."""
    spec = replace(scene.spec.temperature, map_error_k=error_k)
    return scene.with_temperature(spec, kelvin=(kelvin.astype(np.float32),))


# --- the model --------------------------------------------------------------------------------------------------


def test_stated_uncertainty_matches_the_spread_of_draws(tmp_path, tools):
    """Errors over their stated deviation have a root mean square of one.

    Allowed are three standard errors, plus those of the variance ratio, which comes from a median over as many texels.
    Without a map the ratio would be far from one.
    """
    _, moved = tools
    side, error_k = 128, 0.8
    folder = written(tmp_path / "tiny", texel=0.125)
    write_raster(folder / "classes.tif", stripes(side)[None].astype(np.uint8), 0.125)
    scene = tr.load_scene(folder)
    here, there = moved.balances(scene)
    rng, count = np.random.default_rng(3), side * side
    at = TRAINED + 2 * HOUR
    rho = moved._correlation((there.weather, there.time), (here.weather, at))
    assert 0.3 < rho < 0.95
    # All of one length, so that the median of the squares is that of one normal variable.
    first, second = rng.normal(size=(2, len(PROPERTIES), count))
    first *= 2.0 / np.linalg.norm(first, axis=0)
    second = 0.7 * first + 0.3 * second
    before = moved.Expected(np.full(count, 300.0, np.float32), first.astype(np.float16))
    after = moved.Expected(np.full(count, 290.0, np.float32), second.astype(np.float16))
    known = rng.normal(size=first.shape)
    rest, other = moved.BALANCE_ERROR_K * rng.normal(size=(2, count))
    later = rho * rest + np.sqrt(1.0 - rho**2) * other
    given = 300.0 + (first * known).sum(axis=0) + rest + error_k * rng.normal(size=count)
    truth = 290.0 + (second * known).sum(axis=0) + later
    own = mapped(scene, given.reshape(side, side), error_k)
    found = moved.Carried(own, there, here, before).to(at, after)
    error = found.scene.surfaces[0].temperature.ravel() - truth
    ratio = np.sqrt(np.mean((error / found.std_k[0].ravel()) ** 2))
    allowed = 3.0 * (1.0 / np.sqrt(2.0 * count) + 1.25 / np.sqrt(0.5 * count))
    print(ratio, allowed, np.std(error), np.std(truth))
    assert abs(ratio - 1.0) < allowed
    # Without a map the error of the balance is the spread of the truth.
    assert np.std(error) < 0.8 * np.std(truth)
    assert not (found.scene.surfaces[0].flags & UNMOVED).any()


def test_properties_move_by_their_stated_uncertainty():
    grass, sand = LIBRARY["grass_green"], LIBRARY["sand_quartz"]
    assert shifted(sand, "absorptance").solar_absorptance == sand.solar_absorptance + sand.solar_uncertainty
    black = replace(sand, solar_absorptance=0.96)
    assert shifted(black, "absorptance").solar_absorptance == 0.96 - sand.solar_uncertainty
    thermal, spread = sand.thermal, sand.thermal.uncertainty
    logs = [np.log1p((spread[k] / getattr(thermal, k)) ** 2)
            for k in ("conductivity_w_m_k", "density_kg_m3", "specific_heat_j_kg_k")]  # fmt: skip
    moved = shifted(sand, "inertia").thermal
    # ln I = ½ (ln k + ln ρ + ln c); the diffusivity k/ρc stays.
    assert np.log(moved.inertia / thermal.inertia) == pytest.approx(0.5 * np.sqrt(np.sum(logs)), rel=1e-12)
    assert moved.conductivity_w_m_k / moved.heat_capacity_j_m3_k == pytest.approx(
        thermal.conductivity_w_m_k / thermal.heat_capacity_j_m3_k, rel=1e-12
    )
    deeper = shifted(grass, "inertia").thermal
    assert deeper.below.inertia > grass.thermal.below.inertia
    assert deeper.skin_conductance_w_m2_k > grass.thermal.skin_conductance_w_m2_k
    leaves = replace(grass, thermal=replace(grass.thermal, texture=""))
    dry = shifted(leaves, "wetness").thermal
    assert 0.0 < dry.wetness < grass.thermal.wetness and dry.surface_resistance_s_m == 59.0
    # The weather sets the wetness of soil, so its resistance moves, to the same ratio.
    soil = shifted(grass, "wetness").thermal
    assert soil.wetness == grass.thermal.wetness
    assert soil.surface_resistance_s_m / soil.wetness == pytest.approx(59.0 / dry.wetness)
    rough = shifted(grass, "exchange").thermal
    assert rough.roughness_m > grass.thermal.roughness_m
    assert rough.heat_roughness_ratio < grass.thermal.heat_roughness_ratio
    both = shifted(mix([(leaves, 0.5), (sand, 0.5)]), "wetness")
    assert both.parts[0][0].thermal.wetness == dry.wetness and both.parts[1][1] == 0.5
    unknown = replace(sand, thermal=None)
    with pytest.raises(ThermorenderError, match=r"has no thermal properties; add thermal/sand_quartz.csv"):
        shifted(unknown, "inertia")


# --- scenes -----------------------------------------------------------------------------------------------------


def test_map_is_unchanged_at_the_trained_instant(scene, tools):
    _, moved = tools
    state = scene.temperature_state
    assert isinstance(state, Pending) and isinstance(state.source, Moved) and not scene.balanced
    assert "raster, to be solved for 2018-07-15T12:36:00Z" in str(scene)
    found = moved.moved(scene, [TRAINED])[0]
    surface = found.scene.surfaces[0]
    hole = (surface.flags & FALLBACK) > 0
    assert hole.sum() == 9
    np.testing.assert_array_equal(surface.temperature[~hole], state.source.temperatures[0][~hole])
    np.testing.assert_array_equal((surface.flags & UNMOVED) > 0, hole)
    # At least the error that is assumed when none is stated.
    assert found.std_k[0][~hole].min() > 2.0 - 1e-5
    for number in (0, 1):
        own = found.std_k[0][(surface.material == number) & ~hole]
        assert np.ptp(own) < 1e-4
    report = found.scene.temperature_state.moved_report
    assert report["trained"] == "2018-07-15T12:36:00Z" and report["correlation"] == 1.0
    assert report["share_unmoved"] == round(9 / 1024, 5) and found.scene.temperature_state.solved


@pytest.mark.slow
def test_balance_is_used_where_the_map_failed(scene, tools):
    heat, moved = tools
    at = TRAINED + 3 * HOUR
    found = moved.moved(scene, [at])[0].scene.surfaces[0]
    balance = heat.solved(scene.with_temperature(TemperatureSpec("balance")), [at])[0].surfaces[0]
    hole = (found.flags & FALLBACK) > 0
    np.testing.assert_array_equal(found.temperature[hole], balance.temperature[hole])
    assert ((found.flags & UNMOVED) > 0)[hole].all()
    # Elsewhere the map contributes.
    assert np.abs(found.temperature - balance.temperature)[~hole].mean() > 0.1


@pytest.mark.slow
def test_wrong_absorptance_is_corrected_at_other_hours(scene, tools):
    """A map whose only difference from the balance is an absorptance 0.04 too low in the table."""
    heat, moved = tools
    balanced = scene.with_temperature("balance")
    true = balanced.with_material(
        {m.name: replace(m, solar_absorptance=m.solar_absorptance + 0.04) for m in balanced.materials}
    )
    times = [TRAINED, *(TRAINED + hours * HOUR for hours in (-4, 4, 12))]
    truth = [one.surfaces[0].temperature for one in heat.solved(true, times)]
    alone = [one.surfaces[0].temperature for one in heat.solved(balanced, times)]
    found = moved.moved(mapped(scene, truth[0], 0.1), times)
    for known, expected, one in zip(truth[1:], alone[1:], found[1:], strict=True):
        error = one.scene.surfaces[0].temperature - known
        away = np.abs(error) / one.std_k[0]
        print(np.abs(error).mean(), np.abs(expected - known).mean(), one.std_k[0].mean(), away.max())
        assert away.max() < 2.0
        assert np.abs(error).mean() < 0.6 * np.abs(expected - known).mean() + 0.02


@pytest.mark.slow
def test_uncertainty_grows_with_the_time_difference(scene, tools):
    heat, moved = tools
    # A good map that differs from the balance by as much as the stated errors explain. A poor map would gain from the
    # balance at once.
    expected = heat.solved(scene.with_temperature(TemperatureSpec("balance")), [TRAINED])[0].surfaces[0].temperature
    known = mapped(scene, expected + 0.5, 0.3)
    hours = moved.moved(known, [TRAINED + step * np.timedelta64(60, "s") for step in (0, 30, 60, 120)])
    later = TRAINED + 60 * 24 * HOUR
    days = [moved.moved(known.at(later), [later])[0]]
    other = moved.moved(known.with_weather(wind_m_s=8.0), [TRAINED])[0]
    for rising in (hours, [hours[0], *days]):
        mean = [one.scene.temperature_state.moved_report["mean_uncertainty_k"] for one in rising]
        rho = [one.scene.temperature_state.moved_report["correlation"] for one in rising]
        print(mean, rho)
        assert (np.diff(mean) > 0.0).all() and (np.diff(rho) < 0.0).all()
    report, first = (one.scene.temperature_state.moved_report for one in (other, hours[0]))
    assert report["correlation"] < 0.5 and report["mean_uncertainty_k"] > first["mean_uncertainty_k"]


@pytest.mark.slow
def test_snow_or_rain_at_one_instant_only_leaves_the_balance(scene, tools):
    heat, moved = tools
    at = TRAINED + HOUR
    white = scene.with_weather(snow_depth_m=0.1)
    dry = scene.weather
    wet = replace(dry, rain_mm_h=np.where(dry.time < at, 1.0, 0.0))
    rained = scene.with_weather(wet)
    for one in (white, rained):
        found = moved.moved(one, [at])[0].scene
        assert ((found.surfaces[0].flags & UNMOVED) > 0).all()
        assert found.temperature_state.moved_report["share_unmoved"] == 1.0
        balanced = one.with_temperature("balance")
        expected = heat.solved(balanced, [at])[0].surfaces[0].temperature
        np.testing.assert_allclose(found.surfaces[0].temperature, expected, atol=1e-4)


@pytest.mark.slow
def test_frames_flags_and_records_describe_the_moved_map(scene, tmp_path, call):
    from thermorender.output.provenance import weather_of

    renderer = tr.Renderer(scene.at(TRAINED + 2 * HOUR), rays=4, samples=1)
    frame = renderer.frame(tr.pose(0, 0, 20, pitch_deg=-90))
    assert frame.time == TRAINED + 2 * HOUR
    assert (frame.truth["mask"] & UNMOVED).any() and not (frame.truth["mask"] & UNMOVED).all()
    recorded = weather_of(renderer.scene)
    assert recorded["moved"] == renderer.scene.temperature_state.moved_report
    assert recorded["moved"]["mean_absolute_difference_k"] > 0.0
    assert np.isfinite(frame.apparent_temperature).all()


def test_learned_map_with_a_recorded_training_time(tmp_path, monkeypatch):
    recorded = {"time": "2018-07-15T12:36Z", **DAY}
    known = replace(temperature_map.MODELS["fok-1to1"], name="mine", trained=recorded, error_k=1.5)
    monkeypatch.setitem(temperature_map.MODELS, "mine", known)
    folder = written(tmp_path / "tiny", extra=TABLES.partition("[weather]")[1] + TABLES.partition("[weather]")[2])
    text = (folder / "scene.toml").read_text()
    text = text.replace('source = "raster"\nraster = "temperature.tif"', 'source = "learned"\nmodel = "mine"', 1)
    (folder / "scene.toml").write_text(text)
    scene = tr.load_scene(folder)
    assert isinstance(scene.temperature_state.source, Moved)
    assert "share_outside_0_1" in scene.temperature_state.report["mine"]
    own = scene.spec.temperature
    assert trained(own) == WeatherSpec(time=TRAINED, **DAY) and map_error_k(own) == 1.5
    # The scene file overrides the map's record.
    other = replace(own, trained=WeatherSpec(time=TRAINED + HOUR, **DAY), map_error_k=0.5)
    assert trained(other).time == TRAINED + HOUR and map_error_k(other) == 0.5
    monkeypatch.setitem(temperature_map.MODELS, "mine", replace(known, trained=recorded | {"wind": 3.0}))
    with pytest.raises(ThermorenderError, match="learned map 'mine': unknown key 'wind' in trained; did you mean"):
        tr.load_scene(folder)


def test_wrong_settings_are_refused(tmp_path, call, tools):
    _, moved = tools
    weather = TABLES[TABLES.index("[weather]") :]
    folder = written(tmp_path / "tiny", extra=weather)
    plain = (folder / "scene.toml").read_text()
    raster = 'source = "raster"\nraster = "temperature.tif"'
    learned = plain.replace(raster, 'source = "learned"\nmodel = "fok-9to1"', 1)
    (folder / "scene.toml").write_text(learned)
    words = (r"time=2018-07-15T18:00:00Z is not available from learned map 'fok-9to1', which does not state the "
             r"instant and weather of its training; add \[temperature.trained\]")  # fmt: skip
    with pytest.raises(ThermorenderError, match=words):
        tr.load_scene(folder).at("2018-07-15T18:00Z")
    status, _, errors = call("plan", folder, "--time", "2018-07-15T18:00Z")
    assert status == 2 and "is not available from learned map 'fok-9to1'" in errors
    with pytest.raises(ThermorenderError, match="has no map that could be moved; add"):
        moved.moved(tr.load_scene(folder), [TRAINED])
    of_map = TABLES.partition("[weather]")[0]
    cases = (
        (learned + of_map.replace("wind_m_s", "wind"), "unknown key 'wind' in temperature.trained"),
        (learned + of_map.replace("Z", ""), "temperature.trained.time=.* has no zone"),
        (learned + of_map.replace("air_high_c = 23.0\n", ""), "temperature.trained needs exactly one of file, epw"),
        (plain.replace('source = "raster"\nraster = "temperature.tif"', 'source = "constant"\nvalue = 290', 1) + of_map,
         "temperature.trained=.* is not allowed; give it with source='learned' or 'raster' only, not 'constant'"),
        (plain.replace('source = "raster"', 'source = "raster"\nmap_error_k = -1', 1), "map_error_k=-1 is not allowed"),
        (plain.replace("[sky]\ntemperature = 260.0", '[atmosphere]\nstandard = "midlatitude-summer"') + of_map
         + "[sun]\nelevation_deg = 40\nazimuth_deg = 180\n", "follows from weather.time with temp"),
    )  # fmt: skip
    for text, match in cases:
        (folder / "scene.toml").write_text(text)
        with pytest.raises(ThermorenderError, match=match):
            tr.load_scene(folder)
    (folder / "scene.toml").write_text(plain + of_map.replace("time = 2018", "file = \"station.csv\"\ntime = 2017")
                                       .replace(KEYS, ""))  # fmt: skip
    rows = "".join(f"2018-07-{day:02d}T{hour:02d}:00:00Z,20\n" for day in (14, 15) for hour in range(24))
    (folder / "station.csv").write_text("time_utc,air_c\n" + rows)
    with pytest.raises(ThermorenderError, match=r"\[temperature.trained\] time=2017-07-15T12:36:00Z is outside"):
        moved.moved(tr.load_scene(folder), [TRAINED])


# --- the study --------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_study_reports_errors_of_every_method():
    found = study.run(("heath",), (5,), ("14 h", "18 h"), sizes={"heath": (32.0, 0.5, 2.0)})
    assert set(found["all"]) == {f"{name}: {case}" for name in study.MAPS for case in ("14 h", "18 h")}
    assert all(len(row) == len(study.HEADER) for row in study.rows(found))
    now, later = found["all"]["picture: 14 h"], found["all"]["picture: 18 h"]
    # At the trained instant nothing is moved.
    assert now["mae_k"]["moved"] == now["mae_k"]["unmoved"] == now["mae_k"]["offset"]
    assert later["mae_k"]["moved"] < later["mae_k"]["offset"] < later["mae_k"]["unmoved"]
    with pytest.raises(ThermorenderError, match="case='noon' is not part of this study; give one of 14 h, 15 h"):
        study.run(cases=("noon",))
