"""Weather of a synthetic scene: drawn from a seed, and its effect on sky, photograph and objects."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from thermorender import defaults
from thermorender.apps.lands.procedural.noise import stream
from thermorender.atmosphere.declared_air import declared_air
from thermorender.physics import sun
from thermorender.physics.humidity import LAPSE_K_M
from thermorender.scene.spec import AtmosphereSpec, WeatherSpec
from thermorender.weather.declared_weather import declared_weather
from thermorender.weather.series import Conditions

# All kinds are on the central meridian of UTM zone 34, where grid north is true north [deg].
LONGITUDE_DEG = 21.0
# US Standard Atmosphere 1976 at sea level: air temperature [K], water vapour [Pa] and its scale height [m]. Anderson et
# al., AFGL-TR-86-0110 (1986), table 1f.
_STANDARD_K, _STANDARD_VAPOUR_PA, _VAPOUR_SCALE_M = 288.2, 785.0, 2200.0
# Cloud base above the ground [m].
_CLOUD_BASE_M = 1500.0
# Lowest sun elevation of an orthophoto [deg].
PHOTOGRAPH_DEG = 10.0

# Daily mean air temperature in the lowlands of central Europe, 48–54° N near 21° E: annual mean [°C], half the annual
# range [K], coldest day of the year, and altitude [m]; about Warsaw's monthly means, 1991–2020.
_MEAN_C, _SEASON_K, _COLDEST_DAY, _LOWLAND_M = 8.7, 10.7, 15, 100.0
# Standard deviation between the days of a month, in winter and in summer [K].
_STRAYS_K = 4.5, 3.0


def drawn_weather(seed: int, altitude_m: float = _LOWLAND_M) -> WeatherSpec:
    """Return a WeatherSpec drawn from a seed: date, hour, season with snow, cloud, wind and air; colder by 6.5 K per km
    of altitude.

    A climate of central Europe, 48–54° N: any minute of 2001–2020, so half of the instants are at night. Daily means
    deviate from the season by ± 3 K in summer and ± 4.5 K in winter. Cloud follows Beta(0.6, 0.5): mostly clear or
    overcast. The daily range is 6 K in January and 13 K in July under a clear sky, a third of that under clouds.
    Relative humidity at the lowest air temperature is 0.75…0.98. Wind at 10 m follows Weibull's distribution, shape 2,
    scale 4 m/s, clipped to 0.5…12 m/s. Snow of 5 mm to 0.5 m, log-uniform, has probability 0.7 below a mean of 0 °C and
    0.25 up to 3 °C. Indoor air is 20 °C.
    """
    g = stream(seed, "weather")
    day = int(g.integers(0, 7305))
    time = np.datetime64("2001-01-01T00:00:00") + np.timedelta64(1440 * day + int(g.integers(0, 1440)), "m")
    of_year = (time.astype("M8[D]") - time.astype("M8[Y]").astype("M8[D]")).astype(int)
    summer = 0.5 - 0.5 * np.cos(2.0 * np.pi * (of_year - _COLDEST_DAY) / 365.25)
    strays = _STRAYS_K[0] + summer * (_STRAYS_K[1] - _STRAYS_K[0])
    mean = _MEAN_C + _SEASON_K * (2.0 * summer - 1.0) - LAPSE_K_M * (altitude_m - _LOWLAND_M) + g.normal(0.0, strays)
    cloud = float(g.beta(0.6, 0.5))
    range_k = (6.0 + 7.0 * summer) * (1.0 - cloud * 2.0 / 3.0) * np.exp(g.normal(0.0, 0.2))
    humidity = g.uniform(0.75, 0.98)
    wind = np.clip(4.0 * g.weibull(2.0), 0.5, 12.0)
    lies = g.uniform() < (0.7 if mean < 0.0 else 0.25 if mean < 3.0 else 0.0)
    depth = np.exp(g.uniform(np.log(0.005), np.log(0.5)))
    return WeatherSpec(
        time=time, air_low_c=round(float(mean - 0.5 * range_k), 1), air_high_c=round(float(mean + 0.5 * range_k), 1),
        humidity=round(float(humidity), 2), wind_m_s=round(float(wind), 1), cloud=round(cloud, 2),
        snow_depth_m=round(float(depth), 3) if lies else 0.0,
    )  # fmt: skip


def conditions(weather: WeatherSpec, latitude_deg: float, altitude_m: float) -> Conditions:
    """Return the Conditions of a WeatherSpec at its instant and place; refuse an invalid one."""
    return declared_weather(weather, latitude_deg, LONGITUDE_DEG, altitude_m).at(weather.time)


def atmosphere(weather: WeatherSpec, found: Conditions, altitude_m: float) -> AtmosphereSpec:
    """Return the AtmosphereSpec of a synthetic scene; arguments as `sky_temperature`.

    It is the US Standard Atmosphere, shifted to the air temperature and vapour at the ground, with the cloud base at
    1500 m above it.
    """
    usual = _STANDARD_K - LAPSE_K_M * altitude_m
    usual_pa = _STANDARD_VAPOUR_PA * np.exp(-altitude_m / _VAPOUR_SCALE_M)
    return AtmosphereSpec(
        standard="us-1976",
        temperature_offset_k=float(np.clip(found.air_k - usual, -40.0, 40.0)),
        humidity_factor=float(np.clip(found.vapour_pa / usual_pa, 0.0, 5.0)),
        cloud_fraction=weather.cloud,
        cloud_base_m=altitude_m + _CLOUD_BASE_M,
    )


def sky_temperature(weather: WeatherSpec, found: Conditions, altitude_m: float) -> float:
    """Return the temperature [K] of a blackbody with the sky's radiance in the shipped camera's band: a flux-weighted
    mean over the hemisphere.

    The heat balance uses the broadband long-wave sky, which is 20 K warmer under a clear sky, because the band is in
    the atmospheric window.
    """
    air = declared_air(atmosphere(weather, found, altitude_m), defaults.BAND_UM, "synthetic scene")
    assert air is not None
    return air.sky_temperature(altitude_m)


def sun_of_photograph(time: np.datetime64, latitude_deg: float) -> tuple[float, float]:
    """Return (azimuth, elevation) [deg] of the sun in the orthophoto: at the instant, or at noon if it is too low."""
    azimuth, elevation = map(float, sun.position_at(time, latitude_deg, LONGITUDE_DEG))
    if elevation < PHOTOGRAPH_DEG:
        minutes = time.astype("M8[m]") + np.arange(-720, 720)
        noon = minutes[np.argmin(np.abs(sun.solar_hour(minutes, LONGITUDE_DEG) - 12.0))]
        azimuth, elevation = map(float, sun.position_at(noon, latitude_deg, LONGITUDE_DEG))
    return azimuth, elevation


def balanced(items: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return [[object]] tables with temperatures that the heat balance solves, but for those with the key `heated`."""
    return [
        {key: value for key, value in item.items() if key != "heated"}
        | ({} if item.get("heated") else {"temperature": "balance"})
        for item in items
    ]


def follows(
    items: Sequence[dict[str, Any]], found: tuple[float, float], usual: tuple[float, float]
) -> list[dict[str, Any]]:
    """Return [[object]] tables with temperatures adapted from the `usual` (air temperature [K], sunlight on level
    ground [W m⁻²]) to those `found`. The excess over air scales with sunlight; objects with the key `heated` keep their
    temperature.
    """
    made = []
    for item in items:
        item = dict(item)
        item.pop("inner_heat_w", None)
        if not item.pop("heated", False):
            share = found[1] / usual[1]
            item["temperature"] = round(found[0] + share * (item["temperature"] - usual[0]), 1)
        made.append(item)
    return made
