"""The Weather declared in a scene file: a station's file, a typical year or a named day."""

import datetime
from dataclasses import replace
from typing import Any

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.units import instant
from thermorender.weather.complete import HIGHEST_M, LOWEST_M
from thermorender.weather.epw import read_epw
from thermorender.weather.named_day import named_day
from thermorender.weather.series import Weather
from thermorender.weather.station import read_station

# Defaults of a named day.
_HUMIDITY, _WIND_M_S, _CLOUD = 0.6, 3.0, 0.0

# Within this distance the sun is the same to a degree, and usually the weather is similar.
_FAR_KM, _RADIUS_KM = 100.0, 6371.0


def declared_weather(
    spec: Any, latitude_deg: float, longitude_deg: float, altitude_m: float,
    time: str | datetime.datetime | np.datetime64 | None = None,
) -> Weather:  # fmt: skip
    """Return the Weather of the table [weather], a WeatherSpec with one of file, epw and air_high_c.

    The place is the scene's, but a typical year keeps that of its header. `time` replaces the table's: it chooses the
    date of a named day and the year of a typical year; a station's file must cover it.
    """
    place = latitude_deg, longitude_deg, altitude_m
    snow = spec.snow_depth_m
    try:
        if not LOWEST_M <= altitude_m <= HIGHEST_M:
            raise ThermorenderError(
                f"the scene is {altitude_m:g} m above sea level, out of range for weather; give {LOWEST_M:g} … "
                f"{HIGHEST_M:g} m, by the terrain's heights or height_m of [frame]"
            )
        when = instant("time", spec.time if time is None else time)
        if spec.file is not None:
            names = ("longest_gap_h", "air_height_m", "wind_height_m")
            own = {name: getattr(spec, name) for name in names if getattr(spec, name, None) is not None}
            found = read_station(spec.file, *place, around=when, wind_m_s=spec.wind_m_s, snow_depth_m=snow, **own)
        elif spec.epw is not None:
            shift = getattr(spec, "light_shift_min", None) or 0.0
            found = read_epw(spec.epw, when, snow_depth_m=snow, light_shift_min=shift)
            away_km = _away_km(found.latitude_deg, found.longitude_deg, latitude_deg, longitude_deg)
            if away_km > _FAR_KM:
                note = f"Its place is {away_km:.0f} km away from the scene; sun and weather are those of that place."
                found = replace(found, notes=(*found.notes, note))
        else:
            given = {"air_low_c": spec.air_low_c, "air_high_c": spec.air_high_c}
            missing = [name for name, value in given.items() if value is None]
            if missing:
                raise ThermorenderError(f"{missing[0]} is missing; a named day needs air_low_c and air_high_c")
            humidity, wind, cloud = (
                chosen if value is None else value
                for value, chosen in ((spec.humidity, _HUMIDITY), (spec.wind_m_s, _WIND_M_S), (spec.cloud, _CLOUD))
            )
            found = named_day(when, place, **given, humidity_low=humidity, wind_m_s=wind, cloud=cloud,
                              snow_depth_m=snow or 0.0)  # fmt: skip
        found.at(when)
    except ThermorenderError as error:
        raise ThermorenderError(f"[weather] {error}") from None
    return found


def _away_km(latitude_deg: float, longitude_deg: float, other_latitude_deg: float, other_longitude_deg: float) -> float:
    """Distance of two places on a sphere [km], by the haversine formula."""
    one, other = np.radians(latitude_deg), np.radians(other_latitude_deg)
    turn = np.radians(longitude_deg - other_longitude_deg)
    square = np.sin(0.5 * (one - other)) ** 2 + np.cos(one) * np.cos(other) * np.sin(0.5 * turn) ** 2
    return float(2.0 * _RADIUS_KM * np.arcsin(np.sqrt(np.minimum(square, 1.0))))
