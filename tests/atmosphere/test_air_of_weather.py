"""The air that follows the weather: against standard atmospheres, through scene files and edits, and contradictions."""

from dataclasses import replace

import numpy as np
import pytest
from heat_support import short_simulations

import thermorender as tr
from scenes import WEATHER, coarse, write_balance, write_terrain
from thermorender.atmosphere.from_weather import LEAST_CLOUD, NearGround, from_weather
from thermorender.atmosphere.model import Atmosphere
from thermorender.atmosphere.table_files import read_table
from thermorender.errors import ThermorenderError
from thermorender.physics import sky

BAND = (7.5, 13.5)
SKY = "[sky]\ntemperature = 260.0\n"  # of the tiny scenes
JANUARY, JULY = np.datetime64("2019-01-16T00:00"), np.datetime64("2019-07-17T00:00")
# Pressure [Pa], temperature [K] and vapour [Pa] at sea level: Anderson et al. (1986), AFGL-TR-86-0110, table 1, with
# mixing ratios of water of 25900, 18700, 4316, 11900 and 1405 ppm.
STANDARDS = {
    "tropical": (15.0, JULY, 101300.0, 299.7, 2624.0),
    "midlatitude-summer": (45.0, JULY, 101300.0, 294.2, 1894.0),
    "midlatitude-winter": (45.0, JANUARY, 101800.0, 272.2, 439.4),
    "subarctic-summer": (60.0, JULY, 101000.0, 287.2, 1202.0),
    "subarctic-winter": (60.0, JANUARY, 101300.0, 257.2, 142.3),
}


def near(air_k=290.0, vapour_pa=1200.0, pressure_pa=101325.0, cloud=0.0, more_w_m2=0.0):
    longwave = float(sky.longwave(np.float64(air_k), np.float64(vapour_pa), cloud)) + more_w_m2
    return NearGround(air_k, vapour_pa, pressure_pa, longwave)


def made(measured, latitude_deg=45.0, altitude_m=0.0, time=JULY, **keys):
    return from_weather(measured, latitude_deg, altitude_m, time, **keys).in_band(*BAND)


@pytest.mark.parametrize("name", STANDARDS)
def test_weather_of_a_standard_atmosphere_gives_that_atmosphere(name):
    """At its latitude and season, within 0.3 K: pressures of the table are given to a thousandth, vapour to 1 %."""
    latitude_deg, time, pressure_pa, air_k, vapour_pa = STANDARDS[name]
    found = made(near(air_k, vapour_pa, pressure_pa), latitude_deg, time=time)
    standard = Atmosphere.standard(name).in_band(*BAND)
    assert found.sky_temperature(0.0) == pytest.approx(standard.sky_temperature(0.0), abs=0.3)
    ground = found.planck(300.0)
    for height in (120.0, 1000.0, 3000.0):
        kelvin = []
        for air in (found, standard):
            through, added = air.path(height, 0.0, height)
            kelvin.append(np.interp((ground * through + added).sum(), *tabulated(air)))
        assert kelvin[0] == pytest.approx(kelvin[1], abs=0.05)


def tabulated(air):
    kelvin = np.linspace(230.0, 320.0, 3601)
    return air.planck(kelvin).sum(axis=-1), kelvin


def test_the_air_at_the_station_is_that_of_the_weather():
    for altitude_m in (0.0, 137.0, 1000.0, 2480.0):
        pressure_pa = 101325.0 * (1.0 - 2.2558e-5 * altitude_m) ** 5.2559
        found = from_weather(near(303.0, 900.0, pressure_pa), 35.0, altitude_m, JANUARY)
        assert found.air_temperature(altitude_m) == pytest.approx(303.0, abs=1e-9)
        column = found.column.at(np.array([altitude_m]))
        assert column.pressure_pa[0] == pytest.approx(pressure_pa, rel=1e-9)
        assert column.mixing["h2o"][0] == pytest.approx(900.0 / (pressure_pa - 900.0), rel=1e-9)


def test_southern_seasons_are_opposite():
    north, south = made(near(), 45.0, time=JULY), made(near(), -45.0, time=JANUARY)
    assert south.sky_temperature(0.0) == pytest.approx(north.sky_temperature(0.0), abs=0.2)
    assert abs(made(near(), -45.0, time=JULY).sky_temperature(0.0) - north.sky_temperature(0.0)) > 0.3


@pytest.mark.parametrize("cloud", [0.2, 0.5, 1.0])
def test_clouds_are_those_with_which_the_long_wave_was_modelled(cloud):
    found = made(near(air_k=290.0, vapour_pa=1200.0, cloud=cloud))
    assert found.cloud_fraction == pytest.approx(cloud, abs=1e-9)
    # Dew point of 1200 Pa: 282.8 K (Alduchov and Eskridge 1996), so the base is 125 m · 7.2 above the ground.
    assert found.cloud_base_m == pytest.approx(900.0, abs=15.0)


def test_a_warmer_long_wave_makes_a_warmer_sky():
    kelvin = [made(near(more_w_m2=more)).sky_temperature(0.0) for more in (-40, -20, -5, 0, 3, 8, 20, 50)]
    assert (np.diff(kelvin) > 0.0).all()
    assert made(near(more_w_m2=3.0)).cloud_fraction == 0.0 and made(near(more_w_m2=20.0)).cloud_fraction > LEAST_CLOUD


def test_long_wave_and_band_change_together():
    """A change of the long-wave by 20 W/m² changes the sky's irradiance in 7.5–13.5 µm by 10 to 25 W/m²."""
    for measured, more in ((near(), near(more_w_m2=20.0)), (near(), near(more_w_m2=-20.0))):
        one, other = made(measured), made(more)
        irradiance = [np.pi * air.planck(air.sky_temperature(0.0)).sum() for air in (one, other)]
        assert 10.0 < abs(irradiance[1] - irradiance[0]) < 25.0


def test_stated_clouds_and_aerosol_are_used():
    assert made(near(), cloud_fraction=0.4, cloud_base_m=1500.0).cloud_base_m == 1500.0
    clear, hazy = made(near()), made(near(), aerosol="rural-5km")
    assert hazy.transmittance(0.0, 0.0, 1000.0).max() < 0.95 * clear.transmittance(0.0, 0.0, 1000.0).max()
    with pytest.raises(ThermorenderError, match="aerosol='fog' is unknown; give one of none"):
        made(near(), aerosol="fog")


def test_gases_of_the_climate_are_positive():
    for latitude_deg in (-90.0, -30.0, 0.0, 52.0, 80.0):
        found = from_weather(near(), latitude_deg, 0.0, JULY)
        assert (found.density >= 0.0).all() and np.isfinite(found.density).all()
    assert list(read_table()["model"][:5]) == list(STANDARDS)


# --- scenes -------------------------------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path):
    """A balance under [weather], with neither sky nor atmosphere."""
    path = write_balance(tmp_path / "tiny", WEATHER)
    file = path / "scene.toml"
    text = file.read_text()
    file.write_text(text.replace(SKY, ""))
    return path


def test_a_scene_with_weather_alone_has_its_air(folder):
    scene = tr.load_scene(folder)
    weather = scene.weather.at(scene.time)
    assert scene.air.air_temperature(scene.altitude_m) == pytest.approx(float(weather.air_k))
    assert "of the weather" in str(scene) and scene.sky_notes == ()
    night = scene.at("2018-07-29T03:00Z")
    assert night.air.temperature[0] < scene.air.temperature[0] - 5.0 and night.sky_temperature < scene.sky_temperature
    overcast = scene.with_weather(cloud=0.9)
    assert overcast.air.cloud_fraction == pytest.approx(0.9) and overcast.sky_temperature > scene.sky_temperature + 15.0
    assert scene.with_sky(240.0).air is None and scene.with_sky(240.0).with_air("weather").digest() == scene.digest()


def test_a_day_under_the_weather_has_the_air_of_each_hour(folder):
    scene = coarse(tr.load_scene(folder), 16)
    pose = tr.pose(0, 0, 12, pitch_deg=-90)
    with short_simulations():
        renderer = tr.Renderer(scene, rays=2)
        later = renderer.scene.at("2018-07-29T03:00Z")
        later = tr.Renderer(later, rays=2).scene
        assert later.air is not scene.air and later.sun is None and renderer.scene.sun is not None
        changed = renderer.baked.solved_for(later)
        frames = [
            tr.Renderer.of(baked, 0).frame(pose).apparent_temperature.mean() for baked in (renderer.baked, changed)
        ]
    assert frames[1] < frames[0] - 5.0


def test_a_scene_without_weather_sky_and_air_is_refused(tmp_path):
    file = write_terrain(tmp_path / "tiny") / "scene.toml"
    text = file.read_text()
    file.write_text(text.replace(SKY, ""))
    with pytest.raises(ThermorenderError, match=r"exactly one of sky, atmosphere .*with \[weather\] none means its"):
        tr.load_scene(file.parent)
    file.write_text(text.replace(SKY, '[atmosphere]\nstandard = "weather"\n'))
    with pytest.raises(ThermorenderError, match=r"atmosphere.standard='weather' needs the weather; add \[weather\]"):
        tr.load_scene(file.parent)


def test_numbers_that_the_weather_measures_are_refused(folder):
    file = folder / "scene.toml"
    own = file.read_text() + '\n[atmosphere]\nstandard = "weather"\naerosol = "rural-23km"\ncloud_base_m = 900\n'
    file.write_text(own)
    assert tr.load_scene(folder).air.cloud_base_m == 900.0
    file.write_text(own + "humidity_factor = 2.0\n")
    with pytest.raises(
        ThermorenderError, match=r"atmosphere\.humidity_factor=2\.0 is not allowed; give it without stand"
    ):
        tr.load_scene(folder)


def test_a_declared_sky_or_air_that_contradicts_the_weather_is_named(folder):
    scene = tr.load_scene(folder)
    near_k = scene.sky_temperature
    assert scene.with_sky(near_k).sky_notes == ()
    (note,) = scene.with_sky(200.0).sky_notes
    assert "the declared sky is 200 K in the camera's band, and the weather's" in note and "with_air('weather')" in note
    # The sky of the long wave is none of the mid-wave, where it shows less power and the same contradiction.
    mid = scene.with_camera(replace(scene.camera, band_um=(3.7, 4.8)))
    assert mid.with_sky(mid.sky_temperature).sky_notes == () and mid.sky_temperature > near_k + 10.0
    (note,) = mid.with_sky(near_k).sky_notes
    assert "the declared sky is" in note
    cold, _ = scene.with_air("subarctic-winter").sky_notes
    assert "the declared air is 257.2 K near the ground, and the weather's 297.0 K at 2018-07-28T12:00:00Z" in cold
