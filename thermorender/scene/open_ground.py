"""Heat balance of level, open ground: one column of each material on its substrate.

Such ground is the site of a weather station and the initial state of a terrain's simulation.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError
from thermorender.materials.material import Material
from thermorender.materials.mixture import parts_of
from thermorender.materials.thermal import FILMS, Thermal
from thermorender.physics import balance, turbulence
from thermorender.physics.balance import ColumnProperties, Forcing, State
from thermorender.physics.conduction import LAYERS, Slab, layered
from thermorender.units import ZERO_CELSIUS_K, utc_text
from thermorender.weather.series import Conditions, Weather

# Roughness length of the open grass over which wind is measured: WMO-No. 8 (2018), volume I, 5.9.2 [m].
STATION_ROUGHNESS_M = 0.03
# Water that stays on leaves and on hard ground, and what bare soil holds before it resists evaporation: FAO Irrigation
# and Drainage Paper 56 (1998), table 19, loams: 8 mm [kg m⁻²].
_HELD, _HELD_BY_SOIL = 0.5, 8.0
# Air inside buildings by default [K].
INSIDE_K = 20.0 + ZERO_CELSIUS_K
# Resistance of a surface that does not evaporate [s/m].
_NEVER_S_M = 1e9
# Share of sunlight that enters water, snow and ice; the surface absorbs the near infrared: about table 2 of Paulson &
# Simpson, J. Phys. Oceanogr. 7 (1977) 952.
_LET_IN = 0.45
# Water is stirred by wind and waves down to some metres, but for a skin: Henderson-Sellers, Appl. Math. Model. 9 (1985)
# 441, has 1e-5 to 1e-3 m² s⁻¹ near the surface, fading within some metres; Saunders, J. Atmos. Sci. 24 (1967) 269, a
# skin of about a millimetre.
_MIXED_M2_S, _MIXED_M, _CALM_M2_S, _COOL_SKIN_M = 1e-4, 4.0, 1e-6, 1e-3
# Share of the ground that shows between closed leaves: FAO Irrigation and Drainage Paper 56 (1998), table 21, cover of
# 0.9; the IFS has 0.85 … 0.9 for grass, crops and trees (documentation CY41R2, part IV, table 8.1).
_GAP = 0.1
# Heights of wind and air above a rough cover, in roughness lengths at least.
_ABOVE = 5.0
_TEMPERATURE_K = 290.0
# Simulation in the open: time step, largest number of repeated days before it, and the change that ends them.
STEP_S = 900.0
_SETTLE_STEP_S = 2.0 * STEP_S
_MOST_DAYS, SETTLED_K = 15, 0.1
# The ground below seasonal snow stays near the melting point: Goodrich, Can. Geotech. J. 19 (1982) 421,
# doi:10.1139/t82-047 [K].
_BELOW_SNOW_K = ZERO_CELSIUS_K
# Above this depth, the ground settles within a few days [m].
_SOON_M = 0.5
# Older weather affects only the depth, which a settled day approximates.
LOOK_BACK = np.timedelta64(14 * 86400, "s")
_DAY = np.timedelta64(86400, "s")


@dataclass(frozen=True, eq=False)
class Columns:
    """Columns of some materials under a weather."""

    ground: ColumnProperties  # Arrays (M,), and lists of L arrays (M,)
    absorptance: NDArray[np.float64]  # (M,) float64 of sunlight
    wind_factor: NDArray[np.float64]  # (M,) wind over the material as a share of the station's
    # (M,) bool whether indoor air is below; otherwise outdoor air, or air without effect
    indoors: NDArray[np.bool_]
    node_m: NDArray[np.float64]  # (M, L) depth of the layers' temperatures [m]
    snow_m: NDArray[np.float64]  # (M,) depth of snow on top [m]


def chosen(columns: Columns, index: NDArray[np.integer]) -> Columns:
    """Return the Columns of some of the materials, by their numbers."""

    def pick(values: Any) -> Any:
        return [each[index] for each in values] if isinstance(values, list) else values[index]

    ground: dict[str, Any] = columns.ground._asdict()
    ground = {name: None if values is None else pick(values) for name, values in ground.items()}
    others = columns.absorptance, columns.wind_factor, columns.indoors, columns.node_m, columns.snow_m
    return Columns(ColumnProperties(**ground), *map(pick, others))


def columns(
    materials: "Sequence[Material]", weather: Weather, snow_m: float = 0.0, station_roughness_m: float | None = None,
    layers: int = LAYERS,
) -> Columns:  # fmt: skip
    """Return the Columns of materials that have thermal properties.

    `snow_m` replaces the depth of snow in the table [m]; 0: the table's. `station_roughness_m` is that of the land
    around the station; None: the station stands on the material itself.
    """
    made = [_column(material, weather, snow_m, station_roughness_m, layers) for material in materials]
    stacked: dict[str, Any] = {}
    for name in ColumnProperties._fields:
        values = np.array([getattr(each[0], name) for each in made], dtype=np.float64)
        stacked[name] = list(values.T) if values.ndim == 2 else values
    # Omit processes that no material has.
    if not sum(map(np.sum, stacked["water"])):
        stacked["water"] = stacked["room"] = None
    if not sum(map(np.sum, stacked["sun_share"])):
        stacked["sun_share"] = None
    if not np.any(stacked["gap"]):
        stacked["gap"] = None
    rest = zip(*(each[1:] for each in made), strict=True)
    return Columns(ColumnProperties(**stacked), *(np.array(values) for values in rest))


def _column(
    material: Material, weather: Weather, snow_m: float, station_roughness_m: float | None, layers: int
) -> tuple[ColumnProperties, float, float, bool, NDArray[np.float64], float]:
    """(ColumnProperties, absorptance, factor on the wind, whether indoor air is below, depth of nodes, of snow)."""
    thermal = material.known_thermal()
    slabs, snowy = _slabs(thermal, snow_m)
    end = thermal.layers[-1].beneath
    skin = thermal.skin_conductance_w_m2_k or np.inf
    if thermal.cover == "water":
        skin = thermal.conductivity_w_m_k / _COOL_SKIN_M
    cut = layered(slabs, skin, FILMS.get(end), layers)
    # Liquid water that the layers can hold.
    kept = [balance.RETENTION if snow else 1.0 for snow in snowy]
    held = [replace(slab, water=share * slab.water) for slab, share in zip(slabs, kept, strict=True)]
    room = layered(held, skin, FILMS.get(end), layers).water
    rough = thermal.roughness_m
    wind_m, air_m, factor = _wind_over(material.name, rough, weather, station_roughness_m)
    log_wind = np.log(wind_m / rough)
    # Stability follows from the wind at the height of the air temperature.
    stability_m = air_m * (log_wind / np.log(air_m / rough)) ** 2
    resistance = thermal.surface_resistance_s_m
    # A wet surface without resistance is free water.
    free = thermal.wetness if resistance == 0.0 else 0.0
    soil = thermal.cover == "bare" and bool(resistance) and (thermal.thickness_m is None or bool(thermal.texture))
    ground = ColumnProperties(
        emissivity=broadband(material),
        log_wind=log_wind,
        log_heat=np.log(air_m / rough) + thermal.heat_roughness_ratio,
        height_m=stability_m,
        resistance=resistance or _NEVER_S_M,
        wetness=thermal.wetness,
        open_water=free,
        leaves=float(thermal.cover == "leaves"),
        held=_HELD_BY_SOIL if soil else _HELD,
        melting=float(thermal.melting_k is not None and thermal.cover == "snow"),
        gap=_GAP if thermal.cover == "leaves" else 0.0,
        capacity=list(cut.capacity),
        conductance=list(cut.conductance),
        water=list(cut.water),
        room=list(room),
        sun_share=list(_sun_share(thermal.attenuation_1_m, cut.edge_m)),
    )
    deep = slabs[0].thickness_m if snowy[0] and np.isfinite(slabs[0].thickness_m) else 0.0
    return ground, material.solar_absorptance, factor, end == "inside", cut.node_m, deep


def _slabs(thermal: Thermal, snow_m: float) -> tuple[list[Slab], list[bool]]:
    """(slabs of a column from the top down, whether each is snow); water is mixed near its surface, calm below it."""
    slabs, snowy = [], []
    for each in thermal.layers:
        thickness, conductivity, water = each.thickness_m, each.conductivity_w_m_k, each.water_share
        if each.cover == "snow":
            water = each.density_kg_m3 / 1000.0
            thickness = snow_m or thickness
        elif each.cover == "water":
            capacity, depth = each.heat_capacity_j_m3_k, np.inf if thickness is None else thickness
            slabs.append(Slab(min(depth, _MIXED_M), _MIXED_M2_S * capacity, capacity, water))
            snowy.append(False)
            if depth <= _MIXED_M:
                continue
            thickness, conductivity = depth - _MIXED_M, _CALM_M2_S * capacity
        slabs.append(Slab(np.inf if thickness is None else thickness, conductivity, each.heat_capacity_j_m3_k, water))
        snowy.append(each.cover == "snow")
    return slabs, snowy


def _wind_over(
    name: str, rough_m: float, weather: Weather, station_roughness_m: float | None
) -> tuple[float, float, float]:
    """(heights of wind and air above a material [m], its wind as a share of the station's) by its roughness [m]."""
    wind_m, air_m = weather.wind_height_m, weather.air_height_m
    if station_roughness_m is not None:
        over_m = max(wind_m, _ABOVE * rough_m)
        factor = turbulence.wind_factor(over_m, rough_m, wind_m, station_roughness_m)
        return over_m, max(air_m, _ABOVE * rough_m), factor
    if min(wind_m, air_m) < _ABOVE * rough_m:
        raise ThermorenderError(
            f"air_height_m={air_m:g}, wind_height_m={wind_m:g} are too low over {name}, whose roughness length is "
            f"{rough_m:g} m; give heights above the displacement plane of {_ABOVE * rough_m:g} m at least"
        )
    return wind_m, air_m, 1.0


def _sun_share(attenuation_1_m: float | None, edge_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Share of the absorbed sunlight (L,) that layers with edges (L + 1,) [m] take; 0 where the surface takes all."""
    if not attenuation_1_m:
        return np.zeros(len(edge_m) - 1)
    reached = np.exp(-attenuation_1_m * edge_m)
    share = _LET_IN * (reached[:-1] - reached[1:])
    # The bottom layer absorbs the rest.
    share[-1] += _LET_IN * reached[-1]
    return share


def over_room(material: Material) -> bool:
    """Return whether a room is below a material or one of a mixture's parts."""
    for part, _ in parts_of(material):
        thermal = part.thermal
        while thermal is not None:
            if thermal.beneath == "inside":
                return True
            thermal = thermal.below
    return False


def bare(material: Material) -> bool:
    """Return whether a material, or each part of a mixture, is bare: no leaves, water or snow."""
    return all(part.thermal is not None and part.thermal.cover == "bare" for part, _ in parts_of(material))


def broadband(material: Material) -> float:
    """Return the hemispherical emissivity over the measured part of 8–14 µm, weighted with Planck's law at 290 K.

    It stands for the whole spectrum, though half of the emission lies outside this range.
    """
    low, high = material.valid_range_um
    band = max(low, 8.0), min(high, 14.0)
    return (
        float(material.band_emissivity(*band, _TEMPERATURE_K))
        if band[0] < band[1]
        else float(material.emissivity.mean())
    )


def forcing(
    found: Conditions, columns: Columns, sun_sine: Any, inside_k: float, shortwave: Any = None
) -> Forcing:  # fmt: skip
    """Return the Forcing of level, open ground under Conditions of one instant.

    `sun_sine` is the sine of the solar elevation, `inside_k` the air inside buildings [K], `shortwave` measured
    absorbed sunlight [W m⁻²]; by default it follows from the absorptance.
    """
    level = found.direct_w_m2 * np.maximum(sun_sine, 0.0) + found.diffuse_w_m2
    return Forcing(
        absorbed=columns.absorptance * level if shortwave is None else shortwave,
        longwave=found.longwave_w_m2,
        sunlight=level,
        air_k=found.air_k,
        vapour_pa=found.vapour_pa,
        wind_m_s=found.wind_m_s * columns.wind_factor,
        pressure_pa=found.pressure_pa,
        rain_kg_m2_s=found.rain_mm_h / 3600.0,
        below_k=np.where(columns.indoors, inside_k, found.air_k),
    )


def march(
    columns: Columns, weather: Weather, state: State, start: np.datetime64, stop: np.datetime64,
    inside_k: float = INSIDE_K, step_s: float = STEP_S,
    shortwave: "Callable[[NDArray[np.datetime64]], NDArray[np.float64]] | None" = None,
) -> list[State]:  # fmt: skip
    """Return the State of open columns after each step from `start` to `stop`.

    Steps are at most `step_s` long and fill the time evenly. `shortwave` is measured absorbed sunlight at instants [W
    m⁻²].
    """
    span = float((stop - start) / np.timedelta64(1, "s"))
    count = max(1, int(np.ceil(span / step_s - 1e-9)))
    length = span / count
    offset = np.add.outer(np.arange(count) * length, balance.stage_times(length))
    instant = start + np.round(offset).astype("timedelta64[s]")
    found = weather.at(instant)
    sine = np.sin(np.radians(weather.sun(instant)[1]))
    absorbed = None if shortwave is None else shortwave(instant)
    states = []
    for number in range(count):
        first, second = (
            forcing(
                Conditions(*(values[number, k] for values in found)), columns, sine[number, k], inside_k,
                None if absorbed is None else absorbed[number, k],
            )
            for k in (0, 1)
        )  # fmt: skip
        state, _ = balance.step(np, state, columns.ground, first, second, length)
        states.append(state)
    return states


def settled(
    columns: Columns, weather: Weather, at: np.datetime64, inside_k: float = INSIDE_K
) -> "tuple[State, float]":  # fmt: skip
    """Return (State of open columns at an instant, change of surfaces and first layers over the last repeated day [K]).

    The first of the 14 days before `at` is repeated until two days differ by less than 0.1 K, each from the previous
    one's mean at depth. From there the weather is simulated to `at`, in steps of at most half an hour.
    """
    if at < weather.time[0]:
        raise ThermorenderError(f"{utc_text(at)} is before the weather, which begins at {utc_text(weather.time[0])}")
    first = max(weather.time[0], at - LOOK_BACK)
    day = min(first + _DAY, weather.time[-1])
    mean = float(weather.at(first + np.arange(24) * ((day - first) // 24)).air_k.mean())
    state, change = settle(
        columns, mean, lambda state: march(columns, weather, state, first, day, inside_k, _SETTLE_STEP_S)
    )
    if at > first:
        # The repeated day is the first one, so start it again from its final state.
        state = march(columns, weather, state, first, at, inside_k, _SETTLE_STEP_S)[-1]
    return state, change


def settle(columns: Columns, mean_k: float, day: "Callable[[State], Sequence[State]]") -> "tuple[State, float]":
    """Return (State, change of its surfaces and first layers over the last day [K]) of columns after a repeated day.

    All depths begin at `mean_k` [K]; snow starts frozen, with the ground below it at 0 °C. `day` maps a State to
    the States after each step of a day.
    """
    count, ground = len(columns.absorptance), columns.ground
    snowy, depth = ground.melting > 0.5, columns.node_m.T
    under = snowy & (columns.snow_m > 0.0) & (depth > columns.snow_m)
    begin = np.where(snowy, np.where(under, _BELOW_SNOW_K, min(mean_k, ZERO_CELSIUS_K)), mean_k)
    state = balance.at_rest(np, list(begin), ground)
    # In a periodic state no mean heat flows below the first layer: without sunlight, the depth has that layer's mean.
    # Between leaves the first layer is not the surface's mean, as it sees the sky.
    free = ~columns.indoors & (ground.conductance[-1] == 0.0) & (ground.melting < 0.5)
    if ground.sun_share is not None:
        free &= sum(ground.sun_share) == 0.0
    deep = np.minimum(columns.node_m.T / _SOON_M, 1.0)
    before, change = np.full((2, count), np.inf), np.inf
    mean: Any = None
    moved: Any = None
    for _ in range(_MOST_DAYS):
        states = day(state)
        state = states[-1]
        ends = np.array([state.surface_k, state.layers_k[0]])
        change = float(np.abs(ends - before).max())
        if change < SETTLED_K:
            break
        before, mean_before, mean = ends, mean, np.mean([each.layers_k[0] for each in states], axis=0)
        layers = [np.where(free, t + d * (mean - t), t) for t, d in zip(state.layers_k, deep, strict=True)]
        # Extrapolate a steady daily ratio, as of deep water, to its limit.
        last, moved = moved, None if mean_before is None else mean - mean_before
        if last is not None:
            ratio = np.clip(moved / np.where(np.abs(last) > 1e-6, last, np.inf), 0.0, 0.9)
            layers = [t + ratio / (1.0 - ratio) * moved for t in layers]
            moved = None
        state = state._replace(layers_k=layers)
    return state, change
