"""The study of the sky's long-wave: what it withholds, its errors, and the integral over the sky."""

from dataclasses import replace

import numpy as np
import pytest

from thermorender.atmosphere.from_weather import NearGround, from_weather
from thermorender.atmosphere.gpoints import GPoints
from thermorender.atmosphere.model import Atmosphere
from thermorender.physics import sky
from thermorender.physics.planck import STEFAN_BOLTZMANN
from thermorender.weather.complete import complete
from validation.longwave import study

PLACE = (45.0, 10.0, 200.0)


def summer_day(**given):
    """A Weather of a day in June in steps of half an hour."""
    time = np.datetime64("2021-06-21T00:00", "s") + np.arange(48) * np.timedelta64(1800, "s")
    own = {"air_k": np.full(48, 290.0), "vapour_pa": np.full(48, 1200.0), **given}
    return complete(time, PLACE, own)


def test_measured_longwave_is_withheld():
    """A sky as modelled has no error; one that is 10 W/m² brighter has a bias of −10 in every part."""
    clear = summer_day()
    light = clear.direct_w_m2 * np.sin(np.radians(np.maximum(clear.sun(clear.time)[1], 0.0))) + clear.diffuse_w_m2
    weather = summer_day(global_w_m2=0.6 * light)
    for more in (0.0, 10.0):
        found = study.errors_of_model(replace(weather, longwave_w_m2=weather.longwave_w_m2 + more))
        assert found["all"]["rows"] == 48 and {"day, cloudy", "night, cloudy"} <= set(found)
        for part in found.values():
            assert part["bias"] == pytest.approx(-more, abs=1e-9)
            assert part["rms"] == pytest.approx(part["mae"]) == pytest.approx(more, abs=1e-9)


def test_deficit_of_sunlight_tells_clear_from_cloudy():
    clear = summer_day()
    height = np.sin(np.radians(np.maximum(clear.sun(clear.time)[1], 0.0)))
    light = clear.direct_w_m2 * height + clear.diffuse_w_m2
    # The deficit is the share of a black sky, and full cloud is 0.84 of it.
    for share, expected in ((1.0, 0.0), (0.5, 0.5 / 0.84)):
        _, cloud = study.withheld(summer_day(global_w_m2=share * light))
        assert cloud[24] == pytest.approx(expected, abs=0.02)


def test_opaque_sky_is_black_at_air_temperature():
    """π times the integral of L cos θ over the table's wavelengths and the rest add up to σ T⁴."""
    air = Atmosphere.standard("midlatitude-summer")
    thick = replace(air, absorption=1e6 * air.absorption + 1.0)
    kelvin = float(thick.air_temperature(0.0))
    shown = study.spectral_longwave(thick, 0.0, kelvin)
    assert shown == pytest.approx(STEFAN_BOLTZMANN * kelvin**4, rel=2e-3)
    # A sky that the air lets through is darker, by no more than the light of the table's wavelengths.
    window = shown - study.spectral_longwave(air, 0.0, kelvin)
    assert 0.1 * np.pi * air.planck(kelvin).sum() < window < np.pi * air.planck(kelvin).sum()


def test_flux_of_the_clear_column_is_that_of_the_camera_s_sky():
    """By g points and by nodes over 6.8–15.9 µm."""
    day = summer_day()
    tables, row, kelvin = GPoints.shipped(), 24, float(day.air_k[24])
    near = NearGround(kelvin, float(day.vapour_pa[row]), float(day.pressure_pa[row]),
                      float(sky.longwave(day.air_k, day.vapour_pa, 0.0)[row]))  # fmt: skip
    air = from_weather(near, *PLACE[::2], day.time[row], cloud_fraction=0.0)
    beyond = STEFAN_BOLTZMANN * kelvin**4 - np.pi * air.planck(kelvin).sum()
    shown = study.spectral_longwave(air, PLACE[2], kelvin) - beyond
    assert study.clear_flux(day, row, tables) == pytest.approx(shown, rel=5e-3)


def test_columns_are_of_rows_without_cloud():
    clear = summer_day()
    found = study.errors_of_column(replace(clear, longwave_w_m2=clear.longwave_w_m2 + 10.0), GPoints.shipped())
    assert set(found) == {"day", "night"} and found["day"]["rows"] <= 30
    assert found["day"]["modelled_bias"] == pytest.approx(-10.0, abs=1e-6)
    # Of the long-wave bands alone, which hold less than the whole.
    assert found["day"]["bias"] < -50.0


def test_spectral_sky_of_a_moderate_climate_returns_the_measured_longwave():
    """Within 10 W/m² for a clear and an overcast sky, and clouds are told from none."""
    day = summer_day()
    for cloud, kind in ((0.0, "clear"), (0.8, "clouded")):
        longwave = sky.longwave(day.air_k, day.vapour_pa, cloud)
        found = study.errors_of_spectrum(replace(day, longwave_w_m2=longwave))
        assert set(found) == {kind}
        assert found[kind]["rms"] < 10.0 and found[kind]["limited"] == 0.0
