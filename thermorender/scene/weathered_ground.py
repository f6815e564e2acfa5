"""Soil and low vegetation with the moisture of the past weeks and under snow, as the weather leaves them.

Only materials whose table names a soil texture change; paving, roofs and trees stay as their tables say.
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
from thermorender.physics import humidity, moisture, sky, snow, sun
from thermorender.physics.moisture import Bucket, SoilTexture
from thermorender.physics.snow import NEW_ALBEDO, NEW_KG_M3, Pack
from thermorender.units import ZERO_CELSIUS_K
from thermorender.weather.series import Weather

Floats = NDArray[np.float64]

_DAY_S = 86400
_WATER_J_M3_K = 4.186e6
# Thinner dry soil and snow are neglected [m], and smaller shares of ground.
_LEAST_M, _FEW = 1e-3, 0.01
# A note names a smaller transpiration than this share, and the air's temperature under more cloud at lower sun [deg].
_GREEN, _CLOUDY, _DARK_DEG = 0.8, 0.5, -3.0


class _Days(NamedTuple):
    """Rain and melt [mm], reference evapotranspiration [mm], and whether snow lies, by day (N,)."""

    wet_mm: Floats
    reference_mm: Floats
    white: NDArray[np.bool_]


class Season(NamedTuple):
    """Shares of full transpiration by frost and length of day, and by these and dry air, 0 … 1."""

    green: float
    watered: float


def lying_snow(materials: Iterable[Material], weather: Weather, at: np.datetime64) -> Pack:
    """Return the snow on low ground at an instant; of depth 0 where a material is snow and says where it lies.

    Snow that lies at the weather's first instant is of medium age, as the material snow_medium.
    """
    if float(weather.at(at).snow_m) < _LEAST_M or any(map(is_snow, materials)):
        return Pack(0.0, NEW_KG_M3, NEW_ALBEDO)
    count = max(int(np.searchsorted(weather.time, at, side="right")), 1)
    medium = find(load_library(None), "snow_medium", "snow on the ground")
    first = Pack(float(weather.snow_m[0]), medium.known_thermal().density_kg_m3, 1.0 - medium.solar_absorptance)
    seconds = moisture.intervals_s(weather.time)[1:count]
    found = snow.packs(seconds, weather.air_k[1:count] - ZERO_CELSIUS_K, weather.snow_m[1:count], first)
    return found._replace(depth_m=float(weather.at(at).snow_m))


def in_weather(materials: Sequence[Material], weather: Weather, at: np.datetime64) -> list[Material]:
    """Return materials, without mixtures and snow, as the weather before an instant leaves them.

    Where rain is known, moisture begins at the table's `water_share` and follows `moisture.after_day` from the
    weather's first instant. Conductivity changes by Johansen's law from the table's value, heat capacity by that of
    water. Leaves transpire by `season`; without rain data, dry air indicates dry roots.
    """
    found, days, now = [], None, None
    for material in materials:
        thermal = material.known_thermal()
        known = bool(thermal.texture) and weather.knows_rain
        if thermal.cover == "leaves":
            now = now or season(weather, at)
        if known:
            days = days or _days(weather, at)
            material = replace(material, thermal=_moist(thermal, days, now.green if now else 1.0))
        elif thermal.cover == "leaves" and now:
            material = replace(material, thermal=replace(thermal, wetness=thermal.wetness * now.watered))
        found.append(material)
    return found


def parts_in_weather(
    materials: Sequence[Material], weather: Weather, at: np.datetime64, higher_m: float = 0.0
) -> list[tuple[tuple[Material, float], ...]]:
    """Return ((material, share), …) of each material at an instant: its parts by `in_weather`, with and without snow.

    Air is cooler and thinner at `higher_m` [m] above the height of the weather.
    """
    weather = _lifted(weather, higher_m)
    pack = lying_snow(materials, weather, at)
    parts = [parts_of(material) for material in materials]
    used = [(number, part, share) for number, each in enumerate(parts) for part, share in each]
    solved = [each for each in used if each[1].thermal is not None]
    present = iter(in_weather([part for _, part, _ in solved], weather, at))
    found: list[list[tuple[Material, float]]] = [[] for _ in materials]
    for number, part, share in used:
        own = part if part.thermal is None else next(present)
        found[number] += [(each, share * of) for each, of in parted(own, pack) if of > 0.0]
    return [tuple(each) for each in found]


def _lifted(weather: Weather, higher_m: float) -> Weather:
    """Weather at another height: air by the standard lapse, the same relative humidity, pressure with the air."""
    air = weather.air_k - humidity.LAPSE_K_M * higher_m
    thinner = (air / weather.air_k) ** humidity.PRESSURE_EXPONENT
    moister = humidity.saturation_pressure(air) / humidity.saturation_pressure(weather.air_k)
    return replace(weather, air_k=air, vapour_pa=weather.vapour_pa * moister, pressure_pa=weather.pressure_pa * thinner)


def parted(
    material: Material, pack: Pack, always: bool = False
) -> tuple[tuple[Material, float], tuple[Material, float]]:
    """Return ((ground under snow, share), (snow-free part, share)) by `snow.covers`; shares below 1 % are 0.

    Only low vegetation and soil with a texture lie under snow; leaves stand above it. `always` makes the first part at
    any share.
    """
    thermal, share = material.thermal, 0.0
    if thermal is None or not thermal.texture:
        return (material, 0.0), (material, 1.0)
    share = float(snow.covers(pack.depth_m, thermal.roughness_m))
    share = 0.0 if share < _FEW else 1.0 if share > 1.0 - _FEW else share
    white = covered(material, pack) if share or always else material
    if thermal.cover == "leaves" and share:
        below = white.known_thermal()
        stalks = replace(
            thermal, conductivity_w_m_k=below.conductivity_w_m_k, density_kg_m3=below.density_kg_m3,
            specific_heat_j_kg_k=below.specific_heat_j_kg_k, thickness_m=below.thickness_m, below=below.below,
            texture="", beneath=below.beneath, water_share=0.0, wetness=0.0,
        )  # fmt: skip
        material = replace(material, thermal=stalks)
    return (white, share), (material, 1.0 - share)


def season(weather: Weather, at: np.datetime64) -> Season:
    """Return the Season at an instant: means over the 21 days before, or over the first day of a shorter series."""
    day = np.timedelta64(_DAY_S, "s")
    first = max(weather.time[0], at - moisture.MEMORY_D * day)
    rows = np.flatnonzero((weather.time >= first) & (weather.time <= max(at, first + day)))
    time, air = weather.time[rows], weather.air_k[rows]
    lit = weather.sun(time)[1] > 0.0
    deficit = np.maximum(humidity.saturation_pressure(air) - weather.vapour_pa[rows], 0.0)
    number = ((time[-1] - time) / day).astype(int)
    found, count = [], []
    for each in np.unique(number):
        here = number == each
        length_h = sun.day_h(weather.latitude_deg, float(sun.declination(time[here][0])))
        green = float(moisture.growing_season(air[here].min() - ZERO_CELSIUS_K, length_h))
        moist = float(moisture.moist(deficit[here & lit if (here & lit).any() else here].mean()))
        found.append((green, green * moist))
        count.append(here.sum())
    return Season(*np.average(found, axis=0, weights=count).tolist())


def leaf_notes(materials: Iterable[Material], weather: Weather, at: np.datetime64) -> tuple[str, ...]:
    """Return notes on what leaves transpire at an instant, and where the air's temperature is as near to theirs."""
    thermal = [part.thermal for material in materials for part, _ in parts_of(material)]
    leafy = [each for each in thermal if each is not None and each.cover == "leaves"]
    if not leafy:
        return ()
    notes, now = [], season(weather, at)
    known = weather.knows_rain and all(each.texture for each in leafy)
    share = now.green if known else now.watered
    if share < _GREEN:
        why = (
            "frost and short days"
            if known
            else "frost, short days, and dry air where no rain tells of the roots' water"
        )
        notes.append(
            f"leaves transpire {share:.2f} of what they do in season, by {why} in the {moisture.MEMORY_D} days before "
            "(growing season index)"
        )
    found, up = weather.at(at), float(weather.sun(at)[1])
    clear = sky.longwave(found.air_k, found.vapour_pa, 0.0)
    cloud = (found.longwave_w_m2 - clear) / (sky.longwave(found.air_k, found.vapour_pa, 1.0) - clear)
    if up < _DARK_DEG and cloud > _CLOUDY:
        notes.append(
            "on cloudy nights the air's temperature is as near to that of leaves as the heat balance: 0.60 against "
            "0.65 K at thirteen measured stands"
        )
    return tuple(notes)


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


def _wetted(thermal: Thermal, texture: SoilTexture, water: float) -> Thermal:
    """A layer with this water [m³ m⁻³] in place of its usual water."""
    added = water - thermal.water_share
    dry = thermal.density_kg_m3 - 1000.0 * thermal.water_share
    now, usual = (float(moisture.conductivity(texture, each, dry)) for each in (water, thermal.water_share))
    density = thermal.density_kg_m3 + 1000.0 * added
    return replace(
        thermal, conductivity_w_m_k=thermal.conductivity_w_m_k * now / usual, density_kg_m3=density,
        specific_heat_j_kg_k=(thermal.heat_capacity_j_m3_k + added * _WATER_J_M3_K) / density, water_share=water,
    )  # fmt: skip


def covered(material: Material, pack: Pack) -> Material:
    """Return a ground with thermal properties under snow; it keeps its name."""
    white = find(load_library(None), "snow_medium", "snow on the ground")
    thermal = material.known_thermal()
    # Leaves are bent down or covered.
    ground = replace(thermal, skin_conductance_w_m2_k=None)
    own = replace(
        white.known_thermal(), thickness_m=max(pack.depth_m, _LEAST_M), density_kg_m3=pack.density_kg_m3,
        conductivity_w_m_k=float(snow.conductivity(pack.density_kg_m3)), beneath=material.name, below=ground,
    )  # fmt: skip
    return replace(white, name=material.name, solar_absorptance=1.0 - pack.albedo, thermal=own)
