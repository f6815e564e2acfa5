"""Hour and weather in numbers, as input of learned maps.

Besides the station's measurements they include results of the heat balance: how much warmer than the air a few typical
materials are, level in the open and in shade. They describe the heat stored in the ground over the past hours.
"""

from dataclasses import replace
from functools import lru_cache

import numpy as np

from thermorender.materials.library import find, load_library
from thermorender.physics import balance
from thermorender.physics.sun import solar_hour
from thermorender.scene import open_ground
from thermorender.scene.weathered_ground import in_weather
from thermorender.units import ZERO_CELSIUS_K
from thermorender.weather.series import Weather

TYPICAL = (
    "grass_green", "soil_loam", "sand_quartz", "asphalt", "granite", "conifer", "roof_tile_clay", "water", "snow",
)  # fmt: skip
_HOUR, _DAY = np.timedelta64(3600, "s"), np.timedelta64(86400, "s")


def conditions(weather: Weather, time: np.datetime64, inside_c: float = 20.0) -> dict[str, float]:
    """Return {name: float} of an instant (datetime64, UTC) of a Weather. Most names carry their unit. air_day_k is the
    air's mean over the day before minus its present temperature; day is that of the year. For each of `TYPICAL`
    materials, open_NAME and shade_NAME are its temperature above the air's [K], level in the open, or without direct
    sun for a day."""
    return dict(_conditions(weather, time, inside_c))


# Renderers of one scene under many maps ask for the same instant; the balances of typical materials take seconds.
@lru_cache(maxsize=32)
def _conditions(weather: Weather, time: np.datetime64, inside_c: float) -> dict[str, float]:
    """As `conditions`; a Weather does not change."""
    now = weather.at(time)
    elevation = float(weather.sun(time)[1])
    before = max(time - _DAY, weather.time[0])
    past = before + (time - before) * np.arange(25) // 24
    found = {name: float(getattr(now, name)) for name in
             ("air_k", "vapour_pa", "wind_m_s", "direct_w_m2", "diffuse_w_m2", "longwave_w_m2", "snow_m")}  # fmt: skip
    found["air_day_k"] = float(weather.at(past).air_k.mean() - now.air_k)
    found["rain_day_mm"] = float(weather.at(past).rain_mm_h.mean() * ((time - before) / _HOUR))
    found["sun_elevation_deg"] = elevation
    found["solar_hour"] = float(solar_hour(time, weather.longitude_deg))
    found["day"] = float((time.astype("M8[D]") - time.astype("M8[Y]").astype("M8[D]")).astype(int))
    library = load_library(None)
    materials = in_weather([find(library, name, "typical materials") for name in TYPICAL], weather, time)
    columns = open_ground.columns(materials, weather, found["snow_m"], open_ground.STATION_ROUGHNESS_M)
    inside_k = inside_c + ZERO_CELSIUS_K
    start, _ = open_ground.settled(columns, weather, before, inside_k)
    # Stomata of leaves in shade close, so the sun is removed from the weather, not only from absorption.
    shaded = replace(weather, direct_w_m2=np.zeros(weather.time.size))
    for where, under in (("open", weather), ("shade", shaded)):
        state = start
        if time > before:
            state = open_ground.march(columns, under, start, before, time, inside_k)[-1]
        for name, kelvin in zip(TYPICAL, balance.seen_k(state, columns.ground), strict=True):
            found[f"{where}_{name}"] = float(kelvin - now.air_k)
    return found
