"""The Atmosphere that belongs to the weather at a place and an instant, where no sounding is known.

A climatological profile of latitude and season is moved to the air temperature, vapour and pressure measured near the
ground. The long-wave irradiance of the sky sets the clouds, or without clouds the vapour aloft, so that the sky of the
camera's band and the sky of the heat balance belong together.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from thermorender.atmosphere.air_column import (
    FIRST_YEAR,
    LAST_YEAR,
    WATER,
    AirColumn,
    exponential,
    saturation_g_m3,
    water_mixing,
    with_gases,
)
from thermorender.atmosphere.checks import check_within, name_index
from thermorender.atmosphere.model import Atmosphere
from thermorender.atmosphere.table_files import read_table
from thermorender.physics import sky
from thermorender.physics.humidity import dew_point
from thermorender.physics.planck import STEFAN_BOLTZMANN

Floats = NDArray[np.float64]

# Latitudes of the standard atmospheres [deg]: tropical, mid-latitude, subarctic (Anderson et al. 1986,
# AFGL-TR-86-0110); between them the profile is interpolated. January and July are the seasons of the last two.
_LATITUDES = (15.0, 45.0, 60.0)
_WINTER, _SUMMER = (
    ("tropical", "midlatitude-winter", "subarctic-winter"),
    ("tropical", "midlatitude-summer", "subarctic-summer"),
)
_COLDEST_DAY, _YEAR = 15.0, 365.2425
# Height in which the difference from the climate falls to 1/e [m].
_DECAY_M = 4000.0
# Levels added above the ground, where that difference changes fastest [m].
_ABOVE_M = (0.0, 100.0, 250.0, 500.0, 1000.0, 1500.0)
# The least cloud cover that the long-wave is taken to show; below it the vapour aloft changes instead.
LEAST_CLOUD = 0.1
# Clouds form where rising air is saturated, 125 m higher per kelvin between air and dew point; below that height
# radiation fog would be meant, which is not modelled.
_BASE_M_K, _LOWEST_BASE_M = 125.0, 500.0
# Hydrostatics: R / (M g) of dry air [m K⁻¹].
_SCALE_M_K = 8.314462618 / (0.0289652 * 9.80665)
# Factor on the vapour of the whole column that the long-wave may ask for.
_DRIEST, _WETTEST = 0.2, 3.0


class NearGround(NamedTuple):
    """The weather near the ground: temperature [K], vapour [Pa], pressure [Pa], long-wave irradiance [W m⁻²]."""

    air_k: float
    vapour_pa: float
    pressure_pa: float
    longwave_w_m2: float


def from_weather(
    near: NearGround, latitude_deg: float, altitude_m: float, time: np.datetime64, aerosol: str = "none",
    cloud_fraction: float | None = None, cloud_base_m: float | None = None, gases: Mapping[str, float] | None = None,
) -> Atmosphere:  # fmt: skip
    """Return the Atmosphere of the weather near the ground, at a place and an instant, whose day chooses the season.

    `altitude_m` is the station's above sea level, `aerosol` as in `Atmosphere.standard`; `cloud_fraction` and
    `cloud_base_m` replace those that the long-wave irradiance and the dew point suggest. Well-mixed gases are those of
    the year, or `gases` as in `Atmosphere.standard`.

    Temperature: that of the climate plus the difference at the ground, which decays by 1/e in 4 km. Vapour: the
    climate's mixing ratio times one factor, up to saturation. Clouds: from the excess of the long-wave over a clear sky
    (`thermorender.physics.sky.longwave`); their base is the lifting condensation level, 125 m per kelvin between air
    and dew point (Espy; Lawrence, Bull. Amer. Meteor. Soc. 86 (2005) 225, doi:10.1175/BAMS-86-2-225).
    """
    table = read_table()
    haze = name_index("aerosol", aerosol, table["aerosol"])
    check_within("altitude_m", altitude_m, -500.0, 9000.0, "metres above sea level")
    altitude, temperature, climate, nearest = _climate(table, latitude_deg, time)
    ground = max(float(altitude_m), 0.0)
    levels = np.unique(np.concatenate([altitude, ground + np.array(_ABOVE_M)]))
    kelvin = np.interp(levels, altitude, temperature)
    above = np.maximum(levels - ground, 0.0)
    kelvin += (near.air_k - np.interp(ground, altitude, temperature)) * np.exp(-above / _DECAY_M)
    pressure = _pressure(levels, kelvin, ground, near.pressure_pa)
    mixing = dict(zip(table["gas"].tolist(), exponential(levels, altitude, climate), strict=True))

    cloud, column = _cloud_and_column(near)
    if cloud_fraction is not None:
        cloud, column = cloud_fraction, 1.0
    measured = near.vapour_pa / (near.pressure_pa - near.vapour_pa)
    at_ground = measured / np.interp(ground, levels, mixing[WATER])
    # The vapour measured near the ground is kept there; aloft, the column's factor applies as well.
    factor = at_ground * column ** (1.0 - np.exp(-above / 500.0))
    saturated = water_mixing(pressure, kelvin, saturation_g_m3(kelvin))
    mixing[WATER] = np.minimum(mixing[WATER] * factor, np.maximum(saturated, measured * (above == 0.0)))
    if cloud_base_m is None:
        spread = near.air_k - float(dew_point(np.asarray(near.vapour_pa)))
        cloud_base_m = ground + max(_BASE_M_K * spread, _LOWEST_BASE_M)
    year = float(time.astype("datetime64[Y]").astype(int)) + 1970.0
    made = AirColumn(levels, pressure, kelvin, with_gases(mixing, float(np.clip(year, FIRST_YEAR, LAST_YEAR)), gases))
    extinction = None
    if aerosol != "none":
        extinction = exponential(levels, altitude, table["extinction"][nearest, haze].astype(np.float64))
    found = Atmosphere.of_column(made, extinction=extinction)
    return found.clouded(float(cloud), float(min(cloud_base_m, 1.5e4)))


def _climate(
    table: dict[str, NDArray[Any]], latitude_deg: float, time: np.datetime64
) -> tuple[Floats, Floats, Floats, int]:
    """(Altitudes [m], temperature [K], mixing ratios (gases, L), index of the nearest standard atmosphere)."""
    day = (time - time.astype("datetime64[Y]")) / np.timedelta64(1, "D")
    summer = 0.5 - 0.5 * np.cos(2.0 * np.pi * (day - _COLDEST_DAY) / _YEAR)
    if latitude_deg < 0.0:
        summer = 1.0 - summer
    polar = np.interp(abs(latitude_deg), _LATITUDES, (0.0, 1.0, 2.0))
    weights = np.zeros(len(table["model"]))
    for names, season in ((_WINTER, 1.0 - summer), (_SUMMER, summer)):
        for number, name in enumerate(names):
            weights[name_index("standard", name, table["model"])] += season * max(1.0 - abs(polar - number), 0.0)
    temperature, ratio = (np.asarray(table[key], np.float64) for key in ("temperature", "mixing"))
    # Geometric mean, as vapour varies by orders of magnitude; a standard atmosphere may have none of a gas somewhere.
    mean = np.exp(np.tensordot(weights, np.log(np.maximum(ratio, 1e-30)), 1))
    mean[mean < 1e-25] = 0.0
    return np.asarray(table["altitude_m"], np.float64), weights @ temperature, mean, int(np.argmax(weights))


def _pressure(levels: Floats, kelvin: Floats, ground_m: float, ground_pa: float) -> Floats:
    """Pressure [Pa] at levels in hydrostatic balance with that at the ground."""
    thickness = np.diff(levels) / (_SCALE_M_K * 0.5 * (kelvin[1:] + kelvin[:-1]))
    depth = np.concatenate([[0.0], np.cumsum(thickness)])
    pressure: Floats = ground_pa * np.exp(np.interp(ground_m, levels, depth) - depth)
    return pressure


def _cloud_and_column(near: NearGround) -> tuple[float, float]:
    """(Cloud cover, factor on the vapour aloft) with which a sky has the long-wave irradiance measured."""
    black = STEFAN_BOLTZMANN * near.air_k**4
    shown = near.longwave_w_m2 / black
    clear = float(sky.longwave(np.asarray(near.air_k), np.asarray(near.vapour_pa), 0.0)) / black
    cloud = (shown - clear) / (sky.CLOUD_EMISSIVITY * (1.0 - clear))
    if cloud >= LEAST_CLOUD:
        return min(cloud, 1.0), 1.0
    factor = np.geomspace(_DRIEST, _WETTEST, 200)
    emissivity = sky.longwave(np.asarray(near.air_k), near.vapour_pa * factor, 0.0) / black
    return 0.0, float(np.interp(shown, emissivity, factor))
