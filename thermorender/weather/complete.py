"""Complete a measured series to a Weather: missing sun, sky, vapour and pressure are modelled and noted."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.physics import humidity, moisture, sky, snow, sun
from thermorender.units import ZERO_CELSIUS_K
from thermorender.weather.series import Floats, Weather

# Range of altitudes on land [m].
LOWEST_M, HIGHEST_M = -500.0, 9000.0
# Below this elevation hills, haze and errors of the clear-sky model hide the effect of clouds on sunlight [deg].
_LOWEST_FOR_CLOUD_DEG = 10.0
# Light is averaged over this window before the comparison with a clear sky [h].
_CLOUD_WINDOW_H = 3.0
# Hours in which what daylight told of the clouds fades to 1/e; humidity tells the rest. From 6 h to ∞ the error at
# eleven sites changes by 0.3 W m⁻².
_CLOUD_LASTS_H = 12.0
# Below this elevation of the sun the sky is dark, and a sensor reads its offset [deg].
_DARK_DEG = -6.0
_WIND_M_S = 2.5

Given = Mapping[str, Floats]


def complete(
    time: NDArray[np.datetime64], place: tuple[float, float, float], given: Mapping[str, NDArray[np.float64]],
    notes: Sequence[str] = (), wind_m_s: float | None = None, snow_depth_m: float | None = None, **heights: float,
) -> Weather:  # fmt: skip
    """Return the Weather of a series (N,) at a place; missing quantities are modelled.

    `place` is (latitude_deg, longitude_deg, altitude_m). `given` has arrays without NaN: air_k, and any of vapour_pa,
    wind_m_s, global_w_m2, direct_w_m2, diffuse_w_m2, longwave_w_m2, cloud (0 … 1), rain_mm_h, pressure_pa, snow_m.
    `wind_m_s` (2.5 m/s by default) and `snow_depth_m` replace missing ones. `heights` are air_height_m and
    wind_height_m.

    Short-wave: a global irradiance alone is split by Erbs' correlation; without any, `sky.clear_sky` and `sky.clouded`.
    Clouds for the long-wave: as given, else by day from the deficit of global light against a clear sky. At night they
    change within hours from the deficit interpolated between evening and morning to `sky.cloud_of_humidity`. Mean over
    twelve places with a pyrgeometer, moist tropics to ice sheet: bias −1, mean absolute error 15 W m⁻²; on cloudy
    nights 18. Nights under an overcast sky are 24 W m⁻² too low, clear ones 16 W m⁻² too high. Neither the daily range
    of the air temperature nor its hourly change improved nights at sites left out. Snow: from precipitation and air
    temperature by degree days, `moisture.snow_water`, at the density of `snow.depths`. Vapour: saturated at the day's
    lowest air temperature, FAO Irrigation and Drainage Paper 56 (1998), eq. 48.
    """
    latitude_deg, longitude_deg, altitude_m = place
    notes = list(notes)
    count, air = len(time), given["air_k"]
    rest: dict[str, Floats] = {}

    def take(name: str, value: ArrayLike, note: str) -> None:
        if name not in given:
            notes.append(note)
        rest[name] = given[name] if name in given else np.broadcast_to(np.asarray(value, np.float64), (count,))

    take("pressure_pa", humidity.standard_pressure(altitude_m), "Pressure is missing: that of the standard atmosphere.")
    lowest = _daily_lowest(time, air, longitude_deg)
    take("vapour_pa", humidity.saturation_pressure(lowest),
         "Humidity is missing: the air is saturated at each day's lowest temperature.")  # fmt: skip
    constant = _WIND_M_S if wind_m_s is None else wind_m_s
    take(
        "wind_m_s",
        constant,
        f"Wind is missing: {constant:g} m/s at {heights.get('wind_height_m', 10.0):g} m throughout.",
    )
    take("rain_mm_h", 0.0, "Rain is missing: none falls, and soil has its usual moisture.")
    if snow_depth_m is None and "snow_m" not in given and rest["rain_mm_h"].any():
        given = {**given, "snow_m": _likely_snow(time, latitude_deg, air, rest["rain_mm_h"], notes)}
    depth_m = snow_depth_m or 0.0
    take("snow_m", depth_m, f"Snow on the ground is missing: {depth_m:g} m throughout.")

    elevation = sun.position_at(time, latitude_deg, longitude_deg)[1]
    water = humidity.precipitable_water(rest["vapour_pa"], air)
    clear = sky.clear_sky(
        elevation, rest["pressure_pa"], water, sky.standard_aerosol(altitude_m), sun.eccentricity(time)
    )
    limit = sky.clearest_direct(elevation, rest["pressure_pa"], water, sun.eccentricity(time))
    direct, diffuse = _sunlight(given, elevation, sun.eccentricity(time), clear, limit, notes)
    if "longwave_w_m2" in given:
        rest["longwave_w_m2"] = given["longwave_w_m2"]
    else:
        humid = rest["vapour_pa"] / humidity.saturation_pressure(air)
        cloud = _cloud(time, given, direct, diffuse, elevation, clear, humid, notes)
        rest["longwave_w_m2"] = sky.longwave(air, rest["vapour_pa"], cloud)
    series: dict[str, Any] = {**rest, **heights}
    return Weather(
        time=time, air_k=air, direct_w_m2=direct, diffuse_w_m2=diffuse, latitude_deg=latitude_deg,
        longitude_deg=longitude_deg, altitude_m=altitude_m, notes=tuple(notes), **series,
    )  # fmt: skip


def _likely_snow(
    time: NDArray[np.datetime64], latitude_deg: float, air: Floats, rain: Floats, notes: list[str]
) -> Floats:
    """Depth of snow (N,) [m] from precipitation and air temperature; its note is added."""
    water, _ = moisture.snow_water(time, latitude_deg, air, rain)
    depth = snow.depths(moisture.intervals_s(time), air - ZERO_CELSIUS_K, water)
    how = f"up to {depth.max():.2g} m" if depth.any() else "none"
    notes.append(
        f"Snow on the ground is missing: {how}, from precipitation below {moisture.SNOW_C:g} °C less melt by degree "
        "days; a snow_depth_m replaces it."
    )
    return depth


def _daily_lowest(time: NDArray[np.datetime64], air: Floats, longitude_deg: float) -> Floats:
    """The lowest air temperature of each instant's day in mean solar time."""
    local = time + np.timedelta64(int(240.0 * ((longitude_deg + 180.0) % 360.0 - 180.0)), "s")
    _, day = np.unique(local.astype("datetime64[D]"), return_inverse=True)
    lowest = np.full(day.max() + 1, np.inf)
    np.minimum.at(lowest, day, air)
    return lowest[day]


def _sunlight(
    given: Given, elevation: Floats, distance: Floats, clear: tuple[Floats, Floats], limit: Floats, notes: list[str]
) -> tuple[Floats, Floats]:
    """(Direct, diffuse) irradiance from the measured global, direct or diffuse one, or else from a model."""
    height = np.sin(np.radians(np.maximum(elevation, 0.0)))
    if "direct_w_m2" in given and "diffuse_w_m2" in given:
        direct, diffuse = given["direct_w_m2"], given["diffuse_w_m2"]
    elif "global_w_m2" in given:
        total = given["global_w_m2"]
        if "direct_w_m2" in given:
            direct = np.minimum(given["direct_w_m2"], total / np.maximum(height, 1e-9))
            notes.append("Diffuse light is missing: global less direct light.")
        elif "diffuse_w_m2" in given:
            direct = np.maximum(total - given["diffuse_w_m2"], 0.0) / np.maximum(height, 1e-9)
            direct = np.minimum(direct, limit)
            notes.append("Direct light is missing: global less diffuse light.")
        else:
            direct, _ = sky.split_global(total, elevation, distance, limit)
            notes.append("Direct and diffuse light are missing: the global light is split by Erbs' correlation.")
        direct = np.where(height > 0.0, direct, 0.0)
        diffuse = total - direct * height
    elif "cloud" in given:
        direct, diffuse = sky.clouded(*clear, elevation, given["cloud"])
        notes.append("Short-wave is missing: a clear sky's, dimmed by the clouds.")
    else:
        direct, diffuse = clear
        notes.append("Short-wave and clouds are missing: a clear sky's sun.")
    return np.where(elevation > 0.0, direct, 0.0), np.where(elevation > _DARK_DEG, diffuse, 0.0)


def _cloud(
    time: NDArray[np.datetime64],
    given: Given,
    direct: Floats,
    diffuse: Floats,
    elevation: Floats,
    clear: tuple[Floats, Floats],
    humid: Floats,
    notes: list[str],
) -> Floats:
    """Cloud cover (N,) for the long-wave."""
    if "cloud" in given:
        notes.append("Long-wave is missing: modelled from air, vapour and clouds.")
        return given["cloud"]
    if not {"global_w_m2", "direct_w_m2", "diffuse_w_m2"} & set(given):
        notes.append("Long-wave is missing: modelled from air and vapour for a clear sky.")
        return np.zeros(len(time))
    day = elevation > _LOWEST_FOR_CLOUD_DEG
    if not day.any():
        notes.append("Long-wave is missing, and there is no sun to infer clouds from: modelled from air and humidity.")
        return sky.cloud_of_humidity(humid)
    notes.append(
        "Long-wave is missing: modelled from air, vapour and the sunlight's deficit against a clear sky, at night from "
        "the hours of light and the humidity; ± 16 W/m² by day and ± 20 W/m² at night, 24 W/m² too low if overcast."
    )
    height = np.sin(np.radians(elevation))
    hour = (time - time[0]).astype(np.float64) / 3600.0
    first = np.searchsorted(hour, hour - 0.5 * _CLOUD_WINDOW_H)
    last = np.searchsorted(hour, hour + 0.5 * _CLOUD_WINDOW_H, side="right")

    def windowed(values: Floats) -> Floats:
        sums = np.concatenate([[0.0], np.cumsum(np.where(day, values, 0.0))])
        return (sums[last] - sums[first])[day]

    share = windowed(direct * height + diffuse) / windowed(clear[0] * height + clear[1])
    # The deficit itself is the share of a black sky: Crawford and Duchon, J. Appl. Meteorol. 38 (1999) 474, eq. 20.
    cover = np.interp(hour, hour[day], np.clip(1.0 - share, 0.0, 1.0) / sky.CLOUD_EMISSIVITY)
    lit = hour[day]
    after = np.searchsorted(lit, hour)
    away = np.minimum(np.abs(hour - lit[np.maximum(after - 1, 0)]), np.abs(hour - lit[np.minimum(after, len(lit) - 1)]))
    known = np.exp(-away / _CLOUD_LASTS_H)
    return known * cover + (1.0 - known) * sky.cloud_of_humidity(humid)
