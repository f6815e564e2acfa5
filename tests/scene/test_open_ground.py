"""Columns of level, open ground at the end of a repeated day."""

import numpy as np
import pytest
from support import slow

from thermorender.materials.library import load_library
from thermorender.scene import open_ground
from thermorender.weather.named_day import named_day


@pytest.mark.parametrize("name", ["asphalt", "grass_green", *slow("grass_dry"), "conifer", *slow("sand_quartz")])
def test_no_mean_heat_flows_into_the_depth_of_a_settled_column(name):
    """The deepest layer has the mean of the first layer; 250 repeated days differ by 0.2 K at most."""
    weather = named_day(np.datetime64("2018-07-28T12:00:00"), (52.0, 21.0, 100.0), air_low_c=12.0, air_high_c=24.0,
                        humidity_low=0.8, wind_m_s=2.5, cloud=0.1)  # fmt: skip
    columns = open_ground.columns([load_library()[name]], weather, station_roughness_m=0.03)
    start = weather.time[0]
    state, _ = open_ground.settled(columns, weather, start)
    day = open_ground.march(columns, weather, state, start, start + np.timedelta64(1, "D"), step_s=1800.0)
    mean = np.mean([each.layers_k[0] for each in day])
    assert abs(state.layers_k[-1][0] - mean) < 0.25
