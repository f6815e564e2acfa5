"""Water in the ground: snow by degree days, a bucket of two layers, moist soil, and the season of leaves.

The bucket is that of the FAO: Allen et al., Crop Evapotranspiration, FAO Irrigation and Drainage Paper 56 (1998),
https://www.fao.org/4/X0490E/x0490e00.htm, chapters 3, 4, 7 and 8. Amounts of water are mm, that is kg m⁻².
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.units import ZERO_CELSIUS_K

Floats = NDArray[np.float64]

_DAY_S = 86400.0
# Precipitation below this air temperature is snow [°C]: Auer, Weatherwise 27 (1974) 67, half of it at 2 °C, most at 1.
SNOW_C = 1.0
# Melt by day and kelvin above 0 °C at the winter and the summer solstice [mm]: rural land, Huber and Dickinson, Storm
# Water Management Model, Version 4, EPA/600/3-88/001a (1988).
MELT_MM_K = (1.4, 6.9)
# Depth of the layer that evaporates (FAO-56, page 144: 0.10 … 0.15 m) and of the roots of pasture (table 22) [m].
SURFACE_M, ROOTS_M = 0.1, 1.0
# Share of the available water that roots draw without stress: table 22, grazing pasture.
_UNSTRESSED = 0.6
# Transpiration over the reference: table 17, extensive grazing pasture; bare soil has its residual diffusion, 0.15.
_LEAVES, _RESIDUAL = 0.7, 0.15
# Upper limit of both over the reference: eq. 72, for low cover.
_MOST = 1.2
# Share of the soil below closed leaves from which water evaporates: table 21, cover of 0.9.
_EXPOSED = 0.1
# Conductivity of saturated sandy soil: Oke, Boundary Layer Climates (2nd ed. 1987), table 2.1 [W m⁻¹ K⁻¹].
SOAKED_W_M_K = 2.2
# How vapour diffuses through dry soil [m² s⁻¹]: 2.5e-5 in air, of which pores of 40 % and their turns leave a quarter.
_DIFFUSES_M2_S = 6.25e-6

# Lowest temperature of a day [°C], its vapour pressure deficit [Pa] and length [h] at which leaves are absent, and from
# which on they are unlimited: Jolly, Nemani and Running, Glob. Change Biol. 11 (2005) 619, table 1.
_COLD_C, _DRY_PA, _DARK_H = (-2.0, 5.0), (4100.0, 900.0), (10.0, 11.0)
# Days over which the index is averaged: there, page 622.
MEMORY_D = 21


class SoilTexture(NamedTuple):
    """A soil: water at field capacity, at wilting point and in all pores [1], readily evaporable water [mm]; kind.

    `coarse` soils have Johansen's Kersten number for sand.
    """

    capacity: float
    wilting: float
    pores: float
    ready_mm: float
    coarse: bool

    @property
    def evaporable_mm(self) -> float:
        """Total evaporable water of the surface layer, TEW [mm]: FAO-56, eq. 73."""
        return 1000.0 * (self.capacity - 0.5 * self.wilting) * SURFACE_M

    @property
    def available_mm(self) -> float:
        """Total available water of the roots, TAW [mm]: FAO-56, eq. 82."""
        return 1000.0 * (self.capacity - self.wilting) * ROOTS_M


# Middles of FAO-56, table 19. Pores: those of the tables of materials, 40 %, after Oke, Boundary Layer Climates (2nd
# ed. 1987), table 2.1.
TEXTURES = {
    "sand": SoilTexture(0.12, 0.045, 0.4, 4.5, True),
    "loamy_sand": SoilTexture(0.15, 0.065, 0.4, 6.0, True),
    "sandy_loam": SoilTexture(0.23, 0.11, 0.4, 8.0, False),
    "loam": SoilTexture(0.25, 0.12, 0.4, 9.0, False),
    "silt_loam": SoilTexture(0.29, 0.15, 0.4, 9.5, False),
    "clay": SoilTexture(0.36, 0.22, 0.4, 10.0, False),
}


class Bucket(NamedTuple):
    """Depletion of the surface layer and of the roots below field capacity [mm]."""

    surface_mm: Any
    roots_mm: Any


def intervals_s(time: NDArray[np.datetime64]) -> Floats:
    """Return the length [s] of the interval that each of some instants (N,) is the middle of."""
    second = (time - time[0]).astype("timedelta64[s]").astype(np.float64)
    return np.diff(np.concatenate([second[:1], 0.5 * (second[1:] + second[:-1]), second[-1:]]))


def melt_factor(time: NDArray[np.datetime64], latitude_deg: float) -> Floats:
    """Return the melt by day and kelvin above 0 °C (N,) [mm] by season, a sine between `MELT_MM_K`.

    Anderson, NOAA Technical Memorandum NWS HYDRO-17 (1973), of SNOW-17; the southern hemisphere is half a year apart.
    """
    day = (time - time.astype("M8[Y]")) / np.timedelta64(86400, "s") - 80.0
    season = np.sin(2.0 * np.pi * day / 366.0) * (1.0 if latitude_deg >= 0.0 else -1.0)
    low, high = MELT_MM_K
    return 0.5 * (high + low) + 0.5 * (high - low) * season


def melt(time: NDArray[np.datetime64], latitude_deg: float, air_k: Floats) -> Floats:
    """Return the water of snow that air (N,) [K] melts in each interval, (N,) [mm], by `melt_factor`."""
    celsius = np.maximum(air_k - ZERO_CELSIUS_K, 0.0)
    return melt_factor(time, latitude_deg) * celsius * intervals_s(time) / _DAY_S


def snow_water(
    time: NDArray[np.datetime64], latitude_deg: float, air_k: Floats, rain_mm_h: Floats
) -> tuple[Floats, Floats]:
    """Return (water of the snow on the ground, rain and melt that reach the soil) of each interval, (N,) [mm].

    `time` are the middles of the intervals. Precipitation below 1 °C stays, and melts by `melt_factor`.
    """
    length, celsius = intervals_s(time), air_k - ZERO_CELSIUS_K
    rain = rain_mm_h * length / 3600.0
    frozen = np.where(celsius < SNOW_C, rain, 0.0)
    if not frozen.any():
        return np.zeros_like(rain), rain
    snow, water = np.empty_like(rain), 0.0
    for k, (fell, melts) in enumerate(zip(frozen.tolist(), melt(time, latitude_deg, air_k).tolist(), strict=True)):
        water = max(water + fell - melts, 0.0)
        snow[k] = water
    return snow, rain - np.diff(snow, prepend=0.0)


def reference_evapotranspiration(
    celsius: ArrayLike, saturation_pa: ArrayLike, vapour_pa: ArrayLike, wind_2m: ArrayLike, net_w_m2: ArrayLike,
    pressure_pa: ArrayLike,
) -> Floats:  # fmt: skip
    """Return the evapotranspiration of a day of well-watered short grass [mm]: FAO-56, eq. 6, without heat in soil.

    `celsius` is the mean air temperature, `saturation_pa` the mean of the saturation pressures at the highest and
    lowest one, `vapour_pa` that of the air, `wind_2m` the wind at 2 m [m/s] and `net_w_m2` the net radiation of grass.
    """
    celsius, wind_2m = np.asarray(celsius, np.float64), np.asarray(wind_2m, np.float64)
    slope = 4098.0 * 0.6108 * np.exp(17.27 * celsius / (celsius + 237.3)) / (celsius + 237.3) ** 2
    gamma = 0.665e-6 * np.asarray(pressure_pa, np.float64)
    deficit = 1e-3 * (np.asarray(saturation_pa, np.float64) - np.asarray(vapour_pa, np.float64))
    net = 0.0864 * np.asarray(net_w_m2, np.float64)
    return np.maximum(
        (0.408 * slope * net + gamma * 900.0 / (celsius + 273.0) * wind_2m * deficit)
        / (slope + gamma * (1.0 + 0.34 * wind_2m)),
        0.0,
    )


def net_radiation(sunlight_w_m2: ArrayLike, longwave_w_m2: ArrayLike, air_k: ArrayLike) -> Floats:
    """Return the net radiation of reference grass [W m⁻²]: albedo 0.23 (FAO-56, eq. 38), and as warm as the air."""
    from thermorender.physics.planck import STEFAN_BOLTZMANN

    sunlight, longwave, air = (np.asarray(each, np.float64) for each in (sunlight_w_m2, longwave_w_m2, air_k))
    return 0.77 * sunlight + longwave - STEFAN_BOLTZMANN * air**4


def at_two_metres(wind_m_s: ArrayLike, height_m: float) -> Floats:
    """Return the wind at 2 m over short grass [m/s] from that at another height: FAO-56, eq. 47."""
    return np.asarray(wind_m_s, np.float64) * 4.87 / np.log(67.8 * max(height_m, 0.5) - 5.42)


def evaporates(texture: SoilTexture, surface_mm: ArrayLike) -> Floats:
    """Return the reduction Kr of evaporation by the surface layer's depletion [mm], 0 … 1: FAO-56, eq. 74."""
    left = (texture.evaporable_mm - np.asarray(surface_mm, np.float64)) / (texture.evaporable_mm - texture.ready_mm)
    return np.clip(left, 0.0, 1.0)


def transpires(texture: SoilTexture, roots_mm: ArrayLike) -> Floats:
    """Return the reduction Ks of transpiration by the roots' depletion [mm], 0 … 1: FAO-56, eq. 84."""
    left = texture.available_mm - np.asarray(roots_mm, np.float64)
    return np.clip(left / ((1.0 - _UNSTRESSED) * texture.available_mm), 0.0, 1.0)


def filled(texture: SoilTexture, water: float) -> Bucket:
    """Return the Bucket of a soil with this water throughout [m³ m⁻³]."""
    missing = 1000.0 * max(texture.capacity - water, 0.0)
    return Bucket(min(missing * SURFACE_M, texture.evaporable_mm), min(missing * ROOTS_M, texture.available_mm))


def after_day(
    texture: SoilTexture, bucket: Bucket, wet_mm: float, reference_mm: float, leaves: bool
) -> tuple[Bucket, float, float]:
    """Return (Bucket, evapotranspiration, drainage [mm]) after a day of rain and melt and reference evapotranspiration.

    FAO-56, eqs 71 (evaporation), 77 and 79 (surface layer), 85 and 88 (roots), with the day's rain early in the day.
    Closed leaves transpire from the roots. Bare soil evaporates from its surface layer, and by diffusion from below.
    Water above field capacity drains; none runs off.
    """
    surface = max(bucket.surface_mm - wet_mm, 0.0)
    roots = bucket.roots_mm - wet_mm
    drained = max(-roots, 0.0)
    roots = max(roots, 0.0)
    drawn = float(transpires(texture, roots)) * (_LEAVES if leaves else _RESIDUAL) * reference_mm
    drawn = min(drawn, max(texture.available_mm - roots, 0.0))
    most = _EXPOSED * _MOST if leaves else _MOST - _RESIDUAL
    dried = min(float(evaporates(texture, surface)) * most * reference_mm, texture.evaporable_mm - surface)
    # Bare soil transpires nothing from its surface layer.
    surface = min(surface + dried + (drawn * SURFACE_M / ROOTS_M if leaves else 0.0), texture.evaporable_mm)
    return Bucket(surface, roots + drawn + dried), drawn + dried, drained


def dry_depth(texture: SoilTexture, surface_mm: ArrayLike) -> Floats:
    """Return the depth of the air-dry top of the surface layer [m].

    FAO-56 lets the surface layer dry to half its wilting point, between none and all of it: at that limit the upper
    half is dry, and the lower one at the wilting point.
    """
    return 0.5 * SURFACE_M * (1.0 - evaporates(texture, surface_mm))


def kersten(texture: SoilTexture, water: ArrayLike) -> Floats:
    """Return Johansen's Kersten number of unfrozen soil [1]: 1 + 0.7 lg S (coarse) or 1 + lg S (fine), not below 0.

    O. Johansen, Thermal conductivity of soils (1975), CRREL translation 637 (1977), chapter 5; S is saturation.
    """
    saturation = np.clip(np.asarray(water, np.float64) / texture.pores, 1e-6, 1.0)
    return np.maximum(1.0 + (0.7 if texture.coarse else 1.0) * np.log10(saturation), 0.0)


def conductivity(texture: SoilTexture, water: ArrayLike, dry_kg_m3: float) -> Floats:
    """Return the thermal conductivity of unfrozen soil [W m⁻¹ K⁻¹] of this water [m³ m⁻³] and dry density [kg m⁻³].

    Johansen (1975): dry, (0.135 ρ + 64.7) / (2700 − 0.947 ρ), as in Peters-Lidard et al., J. Atmos. Sci. 55 (1998)
    1209, eq. 9; between it and `SOAKED_W_M_K` by `kersten`.
    """
    dry = (0.135 * dry_kg_m3 + 64.7) / (2700.0 - 0.947 * dry_kg_m3)
    return dry + kersten(texture, water) * (SOAKED_W_M_K - dry)


def resistance(texture: SoilTexture, water: ArrayLike, surface_mm: ArrayLike) -> Floats:
    """Return the resistance of bare soil to evaporation [s/m] by its surface layer's water [m³ m⁻³] and depletion.

    A share Kr of the soil is moist up to its surface: exp(8.206 − 4.225 S), Sellers et al., J. Geophys. Res. 97 (1992)
    19033, doi:10.1029/92JD01096. Vapour of the rest diffuses through half the surface layer.
    """
    moist = np.exp(8.206 - 4.225 * np.minimum(np.asarray(water, np.float64) / texture.pores, 1.0))
    share = evaporates(texture, surface_mm)
    return 1.0 / (share / moist + (1.0 - share) / (moist + 0.5 * SURFACE_M / _DIFFUSES_M2_S))


def growing_season(lowest_c: ArrayLike, day_h: ArrayLike) -> Floats:
    """Return the growing season index of days by lowest air temperature [°C] and day length [h], 0 … 1.

    0 is dormant, 1 is green. Product of linear ramps, with `moist` as the third: Jolly, Nemani and Running, Glob.
    Change Biol. 11 (2005) 619, doi:10.1111/j.1365-2486.2005.00930.x, eqs 1–4. The greenness of land is its mean over
    21 days.
    """
    return _ramp(lowest_c, *_COLD_C) * _ramp(day_h, *_DARK_H)


def moist(deficit_pa: ArrayLike) -> Floats:
    """Return the growing season index by mean vapour pressure deficit in daylight [Pa], 0 … 1; dry air: dry soil."""
    return _ramp(deficit_pa, *_DRY_PA)


def _ramp(value: ArrayLike, none: float, full: float) -> Floats:
    return np.clip((np.asarray(value, np.float64) - none) / (full - none), 0.0, 1.0)
