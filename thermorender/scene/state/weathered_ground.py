"""Ground as a weather leaves it: soil and low vegetation with the moisture of the past weeks, and under snow.

A material whose table names a soil's texture takes part. Others, such as paving, roofs and trees, stay as their tables
say, and so does all ground where the weather has no rain.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thermorender.materials.library import find, load_library
from thermorender.materials.material import Material
from thermorender.materials.mixture import parts_of
from thermorender.materials.thermal import Thermal
from thermorender.physics import humidity, leaves, moisture, sun
from thermorender.physics.moisture import Bucket, Texture
from thermorender.units import ZERO_CELSIUS_K
from thermorender.weather.series import Weather

Floats = NDArray[np.float64]

# Snow covers low ground from this depth on, 1 mm of water at 250 kg/m³: in SNOW-17 new snow covers all of it [m].
COVERS_M = 0.004
_DAY_S = 86400
_WATER_J_M3_K = 4.186e6
# Thinner dry soil is neglected [m].
_LEAST_M = 1e-3


class _Days(NamedTuple):
    """Rain and melt [mm], reference evapotranspiration [mm], and whether snow lies, by day (N,)."""

    wet_mm: Floats
    reference_mm: Floats
    white: NDArray[np.bool_]


def lying_snow(materials: Iterable[Material], weather: Weather, at: np.datetime64) -> float:
    """Return the depth of snow that covers low ground at an instant [m]; 0 where a material is snow and says where."""
    depth = float(weather.at(at).snow_m)
    return depth if depth >= COVERS_M and not any(map(is_snow, materials)) else 0.0


def in_weather(
    materials: Sequence[Material], weather: Weather, at: np.datetime64, snow_m: float = 0.0
) -> list[Material]:
    """Return materials as the weather before an instant leaves them.

    Parameters
    ----------
    materials : sequence of Material
        Each with thermal properties; no mixtures.
    weather : Weather
    at : datetime64
    snow_m : float
        Of `lying_snow`.

    Notes
    -----
    Moisture begins at the table's `water_share` and follows `moisture.after_day` from the weather's first instant.
    Conductivity changes by Johansen's law from the table's value, heat capacity by that of water.
    """
    found, days, green = [], None, None
    for material in materials:
        thermal = material.known_thermal()
        if thermal.cover == "leaves":
            green = greenness(weather, at) if green is None else green
            # Dry air stands for dry soil where no bucket knows its water.
            share = green[0 if thermal.texture and weather.knows_rain else 1]
            thermal = replace(thermal, wetness=thermal.wetness * share)
            material = replace(material, thermal=thermal)
        if thermal.texture and weather.knows_rain:
            days = days or _days(weather, at)
            material = replace(material, thermal=_moist(thermal, days, green[0] if green else 1.0))
        found.append(covered(material, snow_m) if thermal.texture and snow_m else material)
    return found


def greenness(weather: Weather, at: np.datetime64) -> tuple[float, float]:
    """Return (greenness of leaves at an instant, the same where dry air tells that the soil is dry), 0 … 1.

    Means of `leaves.growing_season` over the 21 days before, or over the first day of a shorter series.
    """
    day = np.timedelta64(_DAY_S, "s")
    first = max(weather.time[0], at - leaves.MEMORY_D * day)
    rows = np.flatnonzero((weather.time >= first) & (weather.time <= max(at, first + day)))
    time, air = weather.time[rows], weather.air_k[rows]
    elevation = weather.sun(time)[1]
    deficit = np.maximum(humidity.saturation_pressure(air) - weather.vapour_pa[rows], 0.0)
    number = ((time[-1] - time) / day).astype(int)
    index, rows_of = [], []
    for each in np.unique(number):
        here = number == each
        up = here & (elevation > 0.0)
        lowest = air[here].min() - ZERO_CELSIUS_K
        dry = deficit[up if up.any() else here].mean()
        length_h = sun.day_h(weather.latitude_deg, float(sun.declination(time[here][0])))
        index.append([float(leaves.growing_season(lowest, length_h, given)) for given in (None, dry)])
        rows_of.append(here.sum())
    moist, dry = np.average(index, axis=0, weights=rows_of)
    return float(moist), float(dry)


def is_snow(material: Material) -> bool:
    """Return whether a material, or a part of a mixture, is snow or ice."""
    return any(part.thermal is not None and part.thermal.cover == "snow" for part, _ in parts_of(material))


def water_of(thermal: Thermal, weather: Weather, at: np.datetime64) -> Bucket:
    """Return the Bucket of a soil with texture at an instant."""
    return _bucket(thermal, _days(weather, at))


def _days(weather: Weather, at: np.datetime64) -> _Days:
    """The days of 24 h before an instant, from the weather's first instant on; the first one may be shorter."""
    count = int(np.searchsorted(weather.time, at, side="right"))
    if count < 2:
        return _Days(*(np.zeros(0),) * 2, np.zeros(0, bool))
    time, air = weather.time[:count], weather.air_k[:count]
    length, celsius = moisture.intervals_s(weather.time)[:count], air - ZERO_CELSIUS_K
    snow, wet = moisture.snow_water(time, weather.latitude_deg, air, weather.rain_mm_h[:count])
    before = (time[-1] - time).astype(np.int64) // _DAY_S
    # A day without rows, in a longer gap, joins its neighbours.
    _, first = np.unique(before[0] - before, return_index=True)
    rows = np.diff(np.append(first, count))
    mean = lambda values: np.add.reduceat(values[:count], first) / rows  # noqa: E731
    pressure = humidity.saturation_pressure
    saturated = 0.5 * (pressure(np.maximum.reduceat(air, first)) + pressure(np.minimum.reduceat(air, first)))
    sine = np.sin(np.radians(np.maximum(weather.sun(time)[1], 0.0)))
    light = weather.direct_w_m2[:count] * sine + weather.diffuse_w_m2[:count]
    net = moisture.net_radiation(light, weather.longwave_w_m2[:count], air)
    wind = moisture.at_two_metres(mean(weather.wind_m_s), weather.wind_height_m)
    reference = moisture.reference_evapotranspiration(
        mean(celsius), saturated, mean(weather.vapour_pa), wind, mean(net), mean(weather.pressure_pa)
    )
    # The first day may be shorter.
    reference *= np.add.reduceat(length, first) / _DAY_S
    white = mean((snow > 0.0).astype(np.float64)) > 0.5
    return _Days(np.add.reduceat(wet, first), np.where(white, 0.0, reference), white)


def _bucket(thermal: Thermal, days: _Days) -> Bucket:
    texture = moisture.TEXTURES[thermal.texture]
    bucket, leaves = moisture.filled(texture, thermal.water_share), thermal.cover == "leaves"
    for wet, reference in zip(days.wet_mm.tolist(), days.reference_mm.tolist(), strict=True):
        bucket, _, _ = moisture.after_day(texture, bucket, wet, reference, leaves)
    return bucket


def _moist(thermal: Thermal, days: _Days, green: float) -> Thermal:
    """A soil, or vegetation on it of this greenness, with the water of its bucket."""
    texture, bucket = moisture.TEXTURES[thermal.texture], _bucket(thermal, days)
    top = texture.capacity - 1e-3 * bucket.surface_mm / moisture.SURFACE_M
    deep = texture.capacity - 1e-3 * (bucket.roots_mm - bucket.surface_mm) / (moisture.ROOTS_M - moisture.SURFACE_M)
    soil = _wetted(thermal.below or thermal, texture, max(deep, 0.5 * texture.wilting))
    dry_m = float(moisture.dry_depth(texture, bucket.surface_mm))
    moist_m = moisture.SURFACE_M - dry_m
    moist = _wetted(thermal, texture, top * moisture.SURFACE_M / moist_m)
    moist = replace(moist, thickness_m=moist_m, beneath="soil", below=soil)
    if dry_m > _LEAST_M:
        dry = _wetted(thermal, texture, 0.0)
        moist = replace(dry, thickness_m=dry_m, beneath="soil", below=moist)
    if thermal.cover == "leaves":
        return replace(moist, wetness=green * float(moisture.transpires(texture, bucket.roots_mm)))
    soaked, now = (
        float(moisture.resistance(texture, *each)) for each in ((texture.pores, 0.0), (top, bucket.surface_mm))
    )
    return replace(moist, wetness=soaked / now)


def _wetted(thermal: Thermal, texture: Texture, water: float) -> Thermal:
    """A layer with this water [m³ m⁻³] in place of its usual water."""
    added = water - thermal.water_share
    dry = thermal.density_kg_m3 - 1000.0 * thermal.water_share
    now, usual = (float(moisture.conductivity(texture, each, dry)) for each in (water, thermal.water_share))
    density = thermal.density_kg_m3 + 1000.0 * added
    return replace(
        thermal, conductivity_w_m_k=thermal.conductivity_w_m_k * now / usual, density_kg_m3=density,
        specific_heat_j_kg_k=(thermal.heat_capacity_j_m3_k + added * _WATER_J_M3_K) / density, water_share=water,
    )  # fmt: skip


def covered(material: Material, snow_m: float) -> Material:
    """Return a ground with thermal properties under this much snow [m]; it keeps its name."""
    snow = find(load_library(None), "snow_medium", "snow on the ground")
    thermal = material.known_thermal()
    # Leaves are bent down or covered.
    ground = replace(thermal, skin_conductance_w_m2_k=None)
    own = replace(snow.known_thermal(), thickness_m=snow_m, beneath=material.name, below=ground)
    return replace(snow, name=material.name, thermal=own)
