"""The weather of a synthetic scene: named days, one drawn from a seed, and what they make of sky and objects."""

import numpy as np

from thermorender import defaults
from thermorender.atmosphere.declared import declared_air
from thermorender.physics import sun
from thermorender.physics.humidity import LAPSE_K_M
from thermorender.scene.spec import AtmosphereSpec, WeatherSpec
from thermorender.synthetic.noise import stream
from thermorender.weather.declared import declared_weather

# All kinds lie on the central meridian of UTM zone 34, where grid north is true north [deg].
LONGITUDE_DEG = 21.0
# Air of the US Standard Atmosphere 1976 at sea level [K], and its water vapour [Pa] with its scale height
# [m]: Anderson et al., AFGL-TR-86-0110 (1986), table 1f.
_STANDARD_K, _STANDARD_VAPOUR_PA, _VAPOUR_SCALE_M = 288.2, 785.0, 2200.0
# Base of clouds above the ground [m].
_CLOUD_BASE_M = 1500.0
# An orthophoto is taken by day, with the sun at least so high [deg].
PHOTOGRAPH_DEG = 10.0

# Daily mean air in the lowlands of central Europe, 48–54° N near 21° E: middle of the year's course [°C], half its
# range [K], the coldest day of the year, and the altitude [m]: about those of Warsaw's months, 1991–2020.
_MEAN_C, _SEASON_K, _COLDEST_DAY, _LOWLAND_M = 8.7, 10.7, 15, 100.0
# Between days of a month: standard deviation in winter and in summer [K].
_STRAYS_K = 4.5, 3.0


def drawn_weather(seed, altitude_m=_LOWLAND_M):
    """Return a WeatherSpec drawn from a seed: date, hour, season with snow, cloud, wind and air.

    Parameters
    ----------
    seed : int
        0 … 2⁶⁴−1. The weather belongs to it alone, not to the landscape.
    altitude_m : float
        Of the land [m]; air is colder by 6.5 K per km.

    Notes
    -----
    A climate of central Europe, 48–54° N, not a forecast: any minute of 2001–2020, so that half of the instants are
    night. Daily mean of the season ± 3 K in summer and ± 4.5 K in winter. Cloud from Beta(0.6, 0.5), as skies are
    rather clear or overcast. The day's range is 6 K in January and 13 K in July under a clear sky, a third of it under
    clouds. Relative humidity at its lowest air 0.75…0.98. Wind at 10 m from Weibull's distribution, shape 2, scale
    4 m/s, 0.5…12. Snow lies where the mean is below 0 °C, seven times out of ten, and up to 3 °C one time out of four:
    5 mm to 0.5 m, log-uniform. Inside air 20 °C.
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
        time=time,
        air_low_c=round(float(mean - 0.5 * range_k), 1),
        air_high_c=round(float(mean + 0.5 * range_k), 1),
        humidity=round(float(humidity), 2),
        wind_m_s=round(float(wind), 1),
        cloud=round(cloud, 2),
        snow_depth_m=round(float(depth), 3) if lies else 0.0,
    )


def conditions(weather, latitude_deg, altitude_m):
    """Return the Conditions of a WeatherSpec at its instant and place, refused where it is no weather."""
    return declared_weather(weather, latitude_deg, LONGITUDE_DEG, altitude_m).at(weather.time)


def atmosphere(weather, found, altitude_m):
    """Return the AtmosphereSpec of a synthetic scene's air: arguments as of `sky_temperature`.

    The US Standard Atmosphere, moved to the air's temperature and vapour at the ground, with clouds whose base lies
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


def sky_temperature(weather, found, altitude_m):
    """Return the temperature [K] of the blackbody that shines as the sky does in the shipped camera's band.

    Parameters
    ----------
    weather : WeatherSpec
    found : Conditions
        At its instant.
    altitude_m : float

    Notes
    -----
    Flux-weighted mean over the hemisphere under the air of `atmosphere`. The heat balance knows the sky by its
    broadband long-wave, 20 K warmer under a clear sky than that of the band, which lies in the air's window.
    """
    air = declared_air(atmosphere(weather, found, altitude_m), defaults.BAND_UM, "synthetic scene")
    return air.sky_temperature(altitude_m)


def sun_of_photograph(time, latitude_deg):
    """Return (azimuth, elevation) [deg] of the sun in the orthophoto: that of the instant, or by night of that noon."""
    azimuth, elevation = map(float, sun.position_at(time, latitude_deg, LONGITUDE_DEG))
    if elevation < PHOTOGRAPH_DEG:
        minutes = time.astype("M8[m]") + np.arange(-720, 720)
        noon = minutes[np.argmin(np.abs(sun.solar_hour(minutes, LONGITUDE_DEG) - 12.0))]
        azimuth, elevation = map(float, sun.position_at(noon, latitude_deg, LONGITUDE_DEG))
    return azimuth, elevation


def follows(items, found, usual):
    """Return [[object]] tables whose temperatures follow the weather from what they are under the usual one.

    Above air by a part of the sunlight on level ground; what stands as heated keeps its temperature.

    Parameters
    ----------
    items : list of dict
        Tables, with `heated` beside a scene file's keys where something else heats the object.
    found, usual : (kelvin of the air, sunlight on level ground [W m⁻²])
    """
    made = []
    for item in items:
        item = dict(item)
        if not item.pop("heated", False):
            share = found[1] / usual[1]
            item["temperature"] = round(found[0] + share * (item["temperature"] - usual[0]), 1)
        made.append(item)
    return made
