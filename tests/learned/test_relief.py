"""Inputs of conditional maps from terrain and station: relief, sunlight and its memory; hour and weather as numbers."""

import math
from dataclasses import replace

import numpy as np
import pytest

from scenes import WEATHER, write_balance
from thermorender.materials.library import find, load_library
from thermorender.physics import balance
from thermorender.physics.humidity import saturation_pressure
from thermorender.render.geometry import Geometry
from thermorender.render.heat.conditions import TYPICAL, conditions
from thermorender.render.heat.relief import MEMORY_H, NAMES, relief, reliefs
from thermorender.render.variant import activate
from thermorender.scene import open_ground
from thermorender.scene.load import load_scene
from thermorender.weather.series import Weather

pytestmark = pytest.mark.usefixtures("short_heat")

# The sun is in the south.
AT = np.datetime64("2018-07-28T10:42:00")
HOUR = np.timedelta64(3600, "s")


def scene_of(folder, height=None):
    return load_scene(write_balance(folder, WEATHER, height=height))


@pytest.fixture(scope="module")
def level(tmp_path_factory):
    return scene_of(tmp_path_factory.mktemp("level") / "scene")


def under(scene, weather):
    """A scene with another Weather."""
    return scene.with_weather(weather)


def sunlit(weather, time):
    """Sunlight on level ground in the open [W m⁻²] at instants."""
    found, (_, elevation) = weather.at(time), weather.sun(time)
    return found.direct_w_m2 * np.maximum(np.sin(np.radians(elevation)), 0.0) + found.diffuse_w_m2


def steady(start, hours=160.0, latitude=52.0, **values):
    """An hourly Weather that is constant except for the values given at its instants."""
    time = start + HOUR * np.arange(int(hours) + 1)
    usual = {"air_k": 285.0, "vapour_pa": 900.0, "wind_m_s": 3.0, "direct_w_m2": 0.0, "diffuse_w_m2": 80.0,
             "longwave_w_m2": 320.0, "rain_mm_h": 0.0, "pressure_pa": 1e5, "snow_m": 0.0}  # fmt: skip
    series = {name: np.broadcast_to(np.float64(value), time.shape) for name, value in {**usual, **values}.items()}
    return Weather(time=time, latitude_deg=latitude, longitude_deg=21.0, altitude_m=0.0, **series)


# --- relief -----------------------------------------------------------------------------------------------------


def test_level_ground_in_the_open(level):
    found = relief(level, AT)
    assert tuple(found) == NAMES
    for name, values in found.items():
        assert values.dtype == np.float32 and values.shape == (32, 32) and np.isfinite(values).all(), name
    for name, value in (("normal_east", 0.0), ("normal_north", 0.0), ("normal_up", 1.0), ("sky_view", 1.0)):
        np.testing.assert_allclose(found[name], value, atol=1e-5)
    # The ray casting has a relative precision of 1e-7 of the scene's coordinates.
    np.testing.assert_allclose(found["above_m"], 0.0, atol=1e-3)
    np.testing.assert_allclose(found["sunlight"], sunlit(level.weather, AT), rtol=1e-5)


def test_memory_of_the_sun_against_a_dense_sum(level):
    """Within 1 % of a sum over minutes of the previous 40 hours, at noon, in the morning and at night."""
    for hours in (0, -5, 13):
        at = AT + hours * HOUR
        found = relief(level, at)
        ago = (np.arange(40 * 60) + 0.5) / 60.0
        light = sunlit(level.weather, at - np.round(ago * 3600.0).astype("timedelta64[s]"))
        for memory in MEMORY_H:
            weight = np.exp(-ago / memory)
            expected = (weight * light).sum() / weight.sum()
            print(hours, memory, found[f"sunlight_{memory:g}h"].mean() / expected - 1.0)
            # Steps with a weight below 1e-4 are left out: at most 12e-4 of an evening's 250 W/m².
            np.testing.assert_allclose(found[f"sunlight_{memory:g}h"], expected, rtol=0.01, atol=0.3)


def test_instants_share_their_memory_and_equal_separate_ones(level, monkeypatch):
    asked = []
    weather = level.weather
    times = [AT + np.timedelta64(minutes, "m") for minutes in (3, 0, 1, 2, 25)]
    alone = [relief(level, time) for time in times]
    watched = under(level, replace(weather))
    monkeypatch.setattr(Weather, "sun", lambda self, time, real=Weather.sun: asked.append(time) or real(self, time))
    together = reliefs(watched, times)
    # 120 steps, one more for the later hour, the one at the end of each minute, and the present.
    assert len(asked) <= 121 + 2 * len(times)
    for time, one in zip(times, alone, strict=True):
        for name in NAMES:
            np.testing.assert_array_equal(together[time][name], one[name])


def test_a_slope_that_faces_the_sun(tmp_path):
    """30° towards the south: its normal by hand, its view of the sky, and the sun against its cosine."""
    rise = math.tan(math.radians(30.0))
    scene = scene_of(tmp_path / "s", np.repeat(rise * -np.arange(16.0)[:, None], 16, axis=1))
    # A metre of the map, in the middle of its zone, is longer on the ground.
    tilt = math.atan(0.9996 * rise)
    found = relief(scene, AT)
    for name, value in (("east", 0.0), ("north", -math.sin(tilt)), ("up", math.cos(tilt))):
        np.testing.assert_allclose(found[f"normal_{name}"], value, atol=1e-5)
    azimuth, elevation = np.radians(scene.weather.sun(AT))
    assert abs(azimuth - math.pi) < 0.02
    cosine = math.cos(azimuth - math.pi) * math.cos(elevation) * math.sin(tilt) + math.sin(elevation) * math.cos(tilt)
    now = scene.weather.at(AT)
    direct = found["sunlight"] - now.diffuse_w_m2 * found["sky_view"]
    np.testing.assert_allclose(direct, now.direct_w_m2 * cosine, rtol=1e-4)
    # The share of 2 × 64 rays is binomial: each of 450 faces within 4.5 standard deviations, their mean within 3.
    view = (1.0 + math.cos(tilt)) / 2.0
    spread = math.sqrt(view * (1.0 - view) / 128.0)
    np.testing.assert_allclose(found["sky_view"], view, atol=4.5 * spread)
    assert found["sky_view"].mean() == pytest.approx(view, abs=3.0 * spread / math.sqrt(450))
    # By symmetry the middle is as high as the mean around it.
    assert abs(found["above_m"][15:17].mean()) < 1e-3


def test_height_above_the_mean_around_against_scipy(tmp_path):
    from scipy.ndimage import gaussian_filter

    rows, columns = np.mgrid[:64, :64] + 0.5
    height = 5.0 * np.exp(-((rows - 32) ** 2 + (columns - 20) ** 2) / 60.0)
    scene = scene_of(tmp_path / "s", height)
    found = relief(scene, AT)["above_m"]
    # Its posts interpolated to the texels, half a metre each.
    rows, columns = (np.mgrid[:128, :128] + 0.5) / 2.0
    fine = 5.0 * np.exp(-((rows - 32) ** 2 + (columns - 20) ** 2) / 60.0)
    expected = fine - gaussian_filter(fine, 30.0, mode="mirror")
    # A triangle of 1 m is up to h″/8 + … below a round hill: 5 / 30 / 4.
    np.testing.assert_allclose(found[4:-4, 4:-4], expected[4:-4, 4:-4], atol=0.05)
    assert found.max() > 4.0


def test_the_shadow_of_a_wall_has_its_length(tmp_path):
    height = np.zeros((32, 32))
    height[20:22] = 6.0
    scene = scene_of(tmp_path / "s", height)
    now, found = scene.weather.at(AT), relief(scene, AT)
    azimuth, elevation = np.radians(scene.weather.sun(AT))
    length = 6.0 / math.tan(elevation) * math.cos(azimuth - math.pi)
    assert 3.0 < length < 6.0
    direct = ((found["sunlight"] - now.diffuse_w_m2 * found["sky_view"]) / now.direct_w_m2)[:, 24:40]
    # Texel centres from the wall's upper edge, whose posts are cell centres, northward; level from 1 m on.
    north = 20.5 - (np.arange(64) + 0.5) / 2.0
    shaded, lit = (north > 1.0) & (north < length - 0.01), (north > length + 0.01) | (north < -2.0)
    assert shaded.sum() >= 4 and lit.sum() > 40 and (shaded | lit)[north > 1.0].all()
    np.testing.assert_allclose(direct[shaded], 0.0, atol=1e-4)
    np.testing.assert_allclose(direct[lit], math.sin(elevation), rtol=1e-4)


def test_polar_night_has_skylight_only(level):
    at = np.datetime64("2018-12-21T12:00:00")
    # No direct sun, which a station could not have measured.
    weather = steady(at - 100 * HOUR, latitude=80.0, direct_w_m2=300.0, diffuse_w_m2=2.0)
    found = relief(under(level, weather), at)
    for name in NAMES[5:]:
        # Steps with a weight below 1e-4 are left out: of a memory of four hours what is 27 hours ago, 12e-4.
        np.testing.assert_allclose(found[name], 2.0, rtol=1.3e-3)


def test_the_memory_of_weather_that_has_just_begun(level):
    """The memory consists of the past that exists; at the very beginning that is the present."""
    ramp = np.array([100.0, 400.0])
    for after_s in (3600, 1200, 60, 0):
        weather = replace(steady(AT, hours=1), diffuse_w_m2=ramp)
        at = AT + np.timedelta64(after_s, "s")
        found = relief(under(level, weather), at)
        present = sunlit(weather, at)
        np.testing.assert_allclose(found["sunlight"], present, rtol=1e-5)
        for memory in MEMORY_H:
            mean = found[f"sunlight_{memory:g}h"]
            expected = present
            if after_s:
                ago = (np.arange(after_s) + 0.5) / 3600.0
                light, weight = 100.0 + 300.0 * (after_s / 3600.0 - ago), np.exp(-ago / memory)
                expected = (weight * light).sum() / weight.sum()
            # Twenty minutes, part of which the weather covers, change it by up to 50 W/m².
            np.testing.assert_allclose(mean, expected, atol=51.0)


# --- hour and weather -------------------------------------------------------------------------------------------


def by_hand(weather, begin, stop, inside_k, shade, step_s=450.0):
    """Kelvin that the typical materials radiate at, level in the open or in shade, simulated at half the usual step."""
    library = load_library()
    made = open_ground.columns(
        [find(library, name, "x") for name in TYPICAL], weather, float(weather.at(stop).snow_m),
        open_ground.STATION_ROUGHNESS_M,
    )  # fmt: skip
    # Without frost, and on long days, dry air alone limits transpiration: full up to 900 Pa, none from 4100 Pa on.
    leaves = np.isin(TYPICAL, ("grass_green", "conifer"))
    lit = (weather.time <= stop) & (weather.sun(weather.time)[1] > 0.0)
    deficit = (saturation_pressure(weather.air_k) - weather.vapour_pa)[lit].mean()
    share = np.where(leaves, (4100.0 - deficit) / 3200.0, 1.0)
    assert 0.5 < share.min() < 0.95
    made = replace(made, ground=made.ground._replace(wetness=share * made.ground.wetness))
    state, _ = open_ground.settled(made, weather, begin, inside_k)

    def forced(instant):
        now = weather.at(instant)
        level = now.diffuse_w_m2 if shade else sunlit(weather, instant)
        return balance.Forcing(
            absorbed=made.absorptance * level, longwave=now.longwave_w_m2, sunlight=level, air_k=now.air_k,
            vapour_pa=now.vapour_pa, wind_m_s=now.wind_m_s * made.wind_factor, pressure_pa=now.pressure_pa,
            rain_kg_m2_s=now.rain_mm_h / 3600.0, below_k=np.where(made.indoors, inside_k, now.air_k),
        )  # fmt: skip

    for number in range(round((stop - begin) / np.timedelta64(1, "s") / step_s)):
        early, late = (
            begin + np.timedelta64(round(number * step_s + part), "s") for part in balance.stage_times(step_s)
        )
        state, _ = balance.step(np, state, made.ground, forced(early), forced(late), step_s)
    # A tenth of what leaves show is the ground between them.
    return (state.surface_k**4 + 0.1 * leaves * (state.layers_k[0] ** 4 - state.surface_k**4)) ** 0.25


@pytest.mark.slow
def test_typical_materials_against_a_simulation_by_hand(level):
    """Half the step changes 4 mK; leaves in shade, where stomata close, are 0.8 to 1.3 K warmer than with open ones."""
    weather, at = level.weather, AT
    found = conditions(weather, at, 18.0)
    for where in ("open", "shade"):
        expected = by_hand(weather, at - 24 * HOUR, at, 291.15, where == "shade") - weather.at(at).air_k
        given = np.array([found[f"{where}_{name}"] for name in TYPICAL])
        print(where, dict(zip(TYPICAL, np.round(given - expected, 3), strict=True)))
        np.testing.assert_allclose(given, expected, atol=0.01)
    assert found["open_asphalt"] > found["shade_asphalt"] + 10.0


def test_conditions_include_the_stations_measurements():
    """At night on a rainy day: means over a day against sums by the minute; the names are always the same."""
    start = np.datetime64("2018-03-01T00:00:00")
    count = np.arange(73.0)
    weather = steady(start, 72, air_k=275.0 + count / 8.0, rain_mm_h=np.where(count > 60, 1.5, 0.0), snow_m=0.05)
    at = start + 70 * HOUR
    found = conditions(weather, at)
    past = at - np.arange(24 * 60) * np.timedelta64(60, "s")
    assert found["air_day_k"] == pytest.approx(weather.at(past).air_k.mean() - found["air_k"], abs=0.01)
    assert found["rain_day_mm"] == pytest.approx(weather.at(past).rain_mm_h.mean() * 24.0, rel=0.05)
    assert found["sun_elevation_deg"] == weather.sun(at)[1] < 0.0 and found["day"] == 61.0
    assert found["solar_hour"] == pytest.approx(23.2, abs=0.05) and found["snow_m"] == 0.05
    # Skylight alone, in the open and in shade.
    for name in TYPICAL:
        assert found[f"open_{name}"] == pytest.approx(found[f"shade_{name}"], abs=1e-9)
    first = conditions(weather, start)
    assert list(first) == list(found) and len(found) == 12 + 2 * len(TYPICAL)
    assert all(type(value) is float and math.isfinite(value) for each in (first, found) for value in each.values())
    assert first["air_day_k"] == first["rain_day_mm"] == 0.0


def test_an_instant_is_traced_once_for_several_maps(level):
    geometry, later = Geometry(activate(), level.surfaces), level.time + HOUR
    first = reliefs(level, [level.time], geometry)
    assert reliefs(level, [level.time], geometry) is first and list(first) == [level.time]
    assert list(reliefs(level, [later], geometry)) == [later]
    again = reliefs(level, [level.time], geometry)
    cloudy = reliefs(level.with_weather(cloud=0.7), [level.time], geometry)
    np.testing.assert_array_equal(again[level.time]["sunlight"], first[level.time]["sunlight"])
    assert (cloudy[level.time]["sunlight"] < again[level.time]["sunlight"]).all()
