"""The Weather of a named day, repeated: lowest and highest air temperature, humidity, wind and clouds."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.errors import ThermorenderError
from thermorender.physics import humidity, sun
from thermorender.units import ZERO_CELSIUS_K
from thermorender.weather.complete import complete
from thermorender.weather.series import Weather

# Apparent solar time of the highest air temperature [h].
_WARMEST_H = 14.0
_STEP_MIN = 30


def named_day(
    time: np.datetime64, place: tuple[float, float, float], air_low_c: float, air_high_c: float,
    humidity_low: float = 0.6, wind_m_s: ArrayLike = 3.0, cloud: float = 0.0, snow_depth_m: float = 0.0,
    before: int = 5, after: int = 1,
) -> Weather:  # fmt: skip
    """Return the half-hourly Weather of an instant's day, repeated from `before` days before to `after` days after.

    The lowest air temperature at 2 m is at sunrise, on days without sunrise at 2 h, and the highest at 14 h apparent
    solar time. `humidity_low` is the relative humidity at the lowest one, 0.01 … 1; the vapour pressure is constant.
    The wind at 10 m is one number or (24,) at the hours of apparent solar time; `cloud` is the cloud cover, 0 … 1. Half
    cosines between the extremes: de Wit, Goudriaan and van Laar (1978) as in Reicosky and others, Agric. For. Meteorol.
    46 (1989) 193, doi:10.1016/0168-1923(89)90064-6. Sun, sky and long-wave as in `complete`.
    """
    latitude_deg, longitude_deg, _ = place
    wind = np.broadcast_to(np.asarray(wind_m_s, np.float64), (24,)) if np.ndim(wind_m_s) == 0 else np.asarray(wind_m_s)
    if not -90.0 <= air_low_c <= air_high_c <= 60.0:
        raise ThermorenderError(
            f"air_low_c={air_low_c:g}, air_high_c={air_high_c:g} are not allowed; give −90…60 °C, the lower first"
        )
    checks = (
        ("humidity", humidity_low, 0.01, 1.0),
        ("cloud", cloud, 0.0, 1.0),
        ("snow_depth_m", snow_depth_m, 0.0, 20.0),
    )
    for name, value, low, high in checks:
        if not low <= value <= high:
            raise ThermorenderError(f"{name}={value:g} is not allowed; give {low:g}…{high:g}")
    if wind.shape != (24,) or not ((wind >= 0.0) & (wind <= 80.0)).all():
        raise ThermorenderError(f"wind_m_s={wind_m_s!s} is not allowed; give 0…80 m/s, one value or 24 by hour")
    half = np.timedelta64(_STEP_MIN, "m")
    centre = time.astype("datetime64[m]").astype("datetime64[h]")
    count = int((before + after) * 1440 / _STEP_MIN) + 1
    series = (centre - np.timedelta64(before, "D") + half * np.arange(count)).astype("datetime64[s]")
    hour = sun.solar_hour(series, longitude_deg)
    low, high = air_low_c + ZERO_CELSIUS_K, air_high_c + ZERO_CELSIUS_K
    rise = sun.sunrise(latitude_deg, float(sun.declination(centre)))
    air = daily_course(hour, low, high, 2.0 if rise is None else rise)
    vapour = humidity_low * humidity.saturation_pressure(np.asarray(low))
    given = {
        "air_k": air,
        "vapour_pa": np.full(count, vapour),
        "wind_m_s": np.interp(hour, np.arange(25), np.append(wind, wind[0])),
        "cloud": np.full(count, float(cloud)),
        "rain_mm_h": np.zeros(count),
        "snow_m": np.full(count, float(snow_depth_m)),
    }
    return complete(series, place, given, [f"A named day: the air and the clouds of {centre.astype('M8[D]')} repeat."])


def daily_course(hour: NDArray[np.float64], low: float, high: float, rise: float) -> NDArray[np.float64]:
    """Return the air temperature at apparent solar hours, `low` at hour `rise` and `high` at 14 h."""
    since = (hour - rise) % 24.0
    warming = _WARMEST_H - rise
    phase = np.where(since <= warming, since / warming - 1.0, (since - warming) / (24.0 - warming))
    return 0.5 * (low + high) + 0.5 * (high - low) * np.cos(np.pi * phase)
