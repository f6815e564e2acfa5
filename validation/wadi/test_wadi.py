"""The study of a wadi: the station's day, its scores, and which properties explain an error."""

import numpy as np
import pytest

from thermorender.errors import ThermorenderError
from thermorender.materials.library import load_library
from validation.wadi import study


def test_weather_passes_through_the_stations_records():
    own, air = study.station(), study.weather()
    now = air.at(own["time"])
    # Records are up to 15 minutes from a row of the Weather, which is linear between its rows.
    assert now.air_k - 273.15 == pytest.approx(own["air_c"], abs=0.3)
    assert now.wind_m_s == pytest.approx(own["wind_m_s"], abs=0.3)
    sine = np.sin(np.radians(air.sun(own["time"])[1]))
    assert now.direct_w_m2 * sine + now.diffuse_w_m2 == pytest.approx(own["global_w_m2"], abs=25.0)
    night = air.sun(air.time)[1] < -1.0
    assert air.direct_w_m2[night].max() == 0.0 and air.diffuse_w_m2[night].max() == 0.0


def test_ground_at_the_station_agrees_within_the_tables_uncertainty():
    """With the data set's albedo, at five records with the sun above 40°: the mean error is less than the standard
    deviation that the table's properties and the albedo give, each changed by its own.
    """
    thermal = load_library()[study.MATERIAL].known_thermal()
    changed = [(study.ALBEDO, {name: getattr(thermal, name) + std}) for name, std in thermal.uncertainty.items()]
    changed.append((study.ALBEDO + study.ALBEDO_STD, {}))
    cases = [(study.ALBEDO, {}), *changed, (study.ALBEDO - 0.1, {})]
    error, *others, darker = study.at_station_of(cases)[:, 2:7].mean(axis=1)
    spread = np.sqrt(sum((each - error) ** 2 for each in others))
    assert abs(error) < spread < 3.0
    # The albedo decides the level: 0.1 are more than 2 K.
    assert darker - error > 2.0


def test_scores_of_a_map_with_an_offset():
    generator = np.random.default_rng(3)
    read = 45.0 + generator.normal(0.0, 1.5, (64, 64))
    found = study.scores(read + study.STATION_MINUS_MAP_K + 2.0, read)
    assert found["bias_k"] == pytest.approx(2.0) and found["mae_k"] == pytest.approx(2.0)
    assert found["mae_after_offset_k"] == pytest.approx(0.0, abs=1e-9)
    assert found["correlation"] == pytest.approx(1.0) and found["spread_k"] == pytest.approx(0.0, abs=1e-9)
    assert found["mae_as_read_k"] == pytest.approx(2.0 + study.STATION_MINUS_MAP_K)


def test_an_error_that_follows_the_slope_is_explained_by_it_alone():
    generator = np.random.default_rng(4)
    height = np.cumsum(generator.normal(0.0, 0.05, (96, 96)), axis=1)
    shade = (generator.random((96, 96)) < 0.05).astype(float)
    _, east = np.gradient(height, 0.6)
    found = study.explained(3.0 * east + generator.normal(0.0, 0.01, east.shape), height, shade, 0.6)
    assert (
        found["slope and aspect"] > 0.9
        and found["all of the relief"] > 0.9
        and found["shade, and shade within 3 m"] < 0.05
    )
    noise = study.explained(generator.normal(0.0, 1.0, east.shape), height, shade, 0.6)
    assert max(noise.values()) < 0.02


def test_a_folder_without_patches_is_refused(tmp_path):
    with pytest.raises(ThermorenderError, match=r"has no patch; give a folder with N_dsm.tif"):
        study.run(tmp_path, tmp_path / "scratch")
