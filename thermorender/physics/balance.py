"""Time-stepping of the surface energy balance: sun, sky, air, vapour and the layers beneath.

A surface without heat capacity covers a column of layers. In each stage of a step the column responds linearly to heat
from above, so Newton's method solves for the surface temperature only. Arrays are NumPy's or Dr.Jit's, and `xp` is the
library; all fields broadcast over the columns.
"""

from typing import Any, NamedTuple

from thermorender.physics import turbulence
from thermorender.physics.conduction import filled, top_response
from thermorender.physics.planck import STEFAN_BOLTZMANN
from thermorender.units import ZERO_CELSIUS_K

FUSION = 3.337e5  # J kg⁻¹
WATER_HEAT = 4186.0  # J kg⁻¹ K⁻¹
# Both stages of Alexander's two-stage scheme, which is L-stable and of second order: SIAM J. Numer. Anal. 14 (1977)
# 1006, theorem 5.
_GAMMA = 1.0 - 0.5**0.5
_NEWTON = 6
_LARGEST_STEP_K = 20.0
# Share of liquid water that snow retains against gravity: Anderson, NOAA Technical Report NWS 19 (1976).
RETENTION = 0.05
_ENDLESS = 1e9  # kg m⁻²
# Names of `terms`, in this order.
TERMS = ("sunlight", "longwave", "emission", "sensible", "latent", "rain", "conduction", "melt")


class ColumnProperties(NamedTuple):
    """Properties of the columns: arrays over the columns, or lists of them over the layers."""

    emissivity: Any  # Broadband hemispherical [1]
    # log_wind, log_heat, height_m: As in `turbulence.convection`
    log_wind: Any
    log_heat: Any
    height_m: Any
    resistance: Any  # To evaporation when moist [s/m]; for leaves, of the stomata in full sun
    wetness: Any  # Moisture available to evaporation, 0…1; the resistance is divided by it
    open_water: Any  # Share of the surface that is always free water, 0…1
    leaves: Any  # 1 where stomata evaporate, 0 elsewhere
    held: Any  # Free water that the surface can hold [kg m⁻²]
    melting: Any  # 1 where the surface is snow or ice, 0 elsewhere
    # capacity, conductance: As in `conduction.Layers`
    capacity: list[Any]
    conductance: list[Any]
    water: list[Any] | None = None  # Freezable water of the layers [kg m⁻²]; None: nothing freezes or melts
    # Largest liquid water content of the layers [kg m⁻²]: all their water in soil and lakes, a `RETENTION` of it in
    # snow, whose further melt water runs off. The ice of snow is not used up.
    room: list[Any] | None = None
    # Share of the absorbed sunlight per layer; None: the surface absorbs all of it
    sun_share: list[Any] | None = None
    gap: Any = None  # View factor from the first layer to the sky, through gaps between leaves, 0…1; None: 0


class Forcing(NamedTuple):
    """Radiation and weather on the columns at one instant."""

    absorbed: Any  # Absorbed sunlight [W m⁻²]
    longwave: Any  # Incident long-wave [W m⁻²]
    sunlight: Any  # Incident sunlight from sun and sky, for the stomata [W m⁻²]
    # air_k, vapour_pa, wind_m_s, pressure_pa: Of the air; the wind over this surface
    air_k: Any
    vapour_pa: Any
    wind_m_s: Any
    pressure_pa: Any
    rain_kg_m2_s: Any
    below_k: Any  # Temperature of the air below the column, if any [K]
    inner_w_m2: Any = None  # Heat that enters the last layer from below, as of an engine [W m⁻²]; None: 0


class State(NamedTuple):
    """State of the columns at one instant."""

    surface_k: Any  # [K]
    layers_k: list[Any]  # [K]
    film: Any  # Free water on the surface [kg m⁻²]
    liquid: list[Any] | None  # Liquid part of the layers' freezable water [kg m⁻²]
    # Rounding error of `layers_k` [K], kept for the next step (compensated summation); None: 0. In single precision a
    # short step changes deep layers by less than an ulp, and differences within thin sheets are smaller than one.
    remainder_k: Any = None


class Fluxes(NamedTuple):
    """Means over a step; net_radiation = sensible + latent + rain + into_ground, up to Newton's residual."""

    net_radiation: Any  # Absorbed sunlight and long-wave minus emission [W m⁻²]
    sensible: Any  # Heat given to the air [W m⁻²]
    latent: Any  # Heat of evaporation [W m⁻²]; negative for dew and frost
    rain: Any  # Heat given to rain, which arrives as warm as the air [W m⁻²]
    into_ground: Any  # Heat gained by the layers through the surface and by absorbed sunlight [W m⁻²]
    evaporated: Any  # [kg m⁻² s⁻¹]
    molten: Any  # Melted minus frozen water of the layers [kg m⁻² s⁻¹]


def at_rest(xp: Any, temperatures_k: list[Any], ground: ColumnProperties) -> State:
    """Return the initial State of dry columns of layer temperatures [K]; snow and layers below 0 °C are frozen."""
    liquid = None
    if ground.water is not None and ground.room is not None:
        liquid = [
            xp.where((t < ZERO_CELSIUS_K) | (room < 0.5 * water), 0.0 * water, water)
            for t, water, room in zip(temperatures_k, ground.water, ground.room, strict=True)
        ]
    return State(temperatures_k[0], list(temperatures_k), 0.0 * temperatures_k[0], liquid)


def seen_k(state: State, ground: ColumnProperties) -> Any:
    """Return the radiative temperature of the columns [K]: of the surface, and of the first layer through gaps."""
    if ground.gap is None:
        return state.surface_k
    return ((1.0 - ground.gap) * state.surface_k**4 + ground.gap * state.layers_k[0] ** 4) ** 0.25


def step(
    xp: Any, state: State, ground: ColumnProperties, first: Forcing, second: Forcing, seconds: Any
) -> tuple[State, Fluxes]:
    """Return (State, Fluxes) after `seconds` [s]; `first` and `second` are the Forcing at the `stage_times`."""
    stage = _GAMMA * seconds
    if state.remainder_k is None:
        state = state._replace(remainder_k=[0.0 * t for t in state.layers_k])
    surface, changes, fluxes = _stage(xp, state, None, state.surface_k, ground, first, stage)
    # The second stage starts from an extrapolation of the first.
    ahead = (1.0 - _GAMMA) / _GAMMA / stage
    sources = [ahead * capacity * change for capacity, change in zip(ground.capacity, changes, strict=True)]
    surface, changes, later = _stage(xp, state, sources, surface, ground, second, stage)
    net_radiation, sensible, latent, warmed, into_ground, evaporated = map(_mean, fluxes, later)
    rain = _mean(first.rain_kg_m2_s, second.rain_kg_m2_s)
    film = xp.minimum(xp.maximum(state.film + seconds * (rain - evaporated), 0.0), ground.held)
    changed = [_summed(*each) for each in zip(state.layers_k, state.remainder_k, changes, strict=True)]
    liquid, molten = state.liquid, 0.0 * film
    if ground.water is not None:
        changed, liquid, molten = _melted(xp, changed, liquid, ground)
    means = Fluxes(net_radiation, sensible, latent, warmed, into_ground, evaporated, molten / seconds)
    layers, remainder = zip(*changed, strict=True)
    return State(surface, list(layers), film, liquid, list(remainder)), means


def terms(xp: Any, ground: ColumnProperties, first: Forcing, second: Forcing, fluxes: Fluxes) -> dict[str, Any]:
    """Return the `TERMS` of the surfaces' balance, means over a `step`, above 0 where a surface gains heat [W m⁻²].

    Sunlight and long-wave radiation are what is absorbed, with the first layer's share through gaps between leaves and
    the sunlight that enters water and snow. Conduction is from the layers, which keep this share. Melt is of snow and
    ice; other layers that freeze or thaw do so within conduction. The terms add up to 0 up to Newton's residual.
    """
    sunlight = _mean(first.absorbed, second.absorbed)
    longwave = ground.emissivity * _mean(first.longwave, second.longwave)
    melt = xp.where(ground.melting > 0.5, 0.0 - FUSION * fluxes.molten, 0.0 * fluxes.molten)
    lost = (0.0 - each for each in (fluxes.sensible, fluxes.latent, fluxes.rain, fluxes.into_ground + melt))
    found = sunlight, longwave, fluxes.net_radiation - sunlight - longwave, *lost, melt
    return dict(zip(TERMS, found, strict=True))


def stage_times(seconds: float) -> tuple[float, float]:
    """Return the times of a step's two stages after its beginning [s]."""
    return _GAMMA * seconds, seconds


def _mean(first: Any, second: Any) -> Any:
    """The mean over a step of a quantity at its two stages."""
    return (1.0 - _GAMMA) * first + _GAMMA * second


def _summed(kelvin: Any, remainder: Any, change: Any) -> tuple[Any, Any]:
    """(temperature, remainder) of a layer after a change; the remainder is the rounding error of the sum."""
    change = change + remainder
    after = kelvin + change
    return after, change - (after - kelvin)


def _stage(
    xp: Any, state: State, sources: list[Any] | None, guess: Any, ground: ColumnProperties, forcing: Forcing,
    seconds: Any,
) -> tuple[Any, list[Any], tuple[Any, ...]]:  # fmt: skip
    """(surface [K], changes of the layers [K], Fluxes without `molten`) after one implicit stage.

    `sources` is heat that the layers gain beside conduction and sunlight [W m⁻²]; `guess` starts Newton's method [K].
    """
    layers, remainder = state.layers_k, state.remainder_k
    drops = [(layers[i] - layers[i + 1]) + (remainder[i] - remainder[i + 1]) for i in range(len(layers) - 1)]
    sources = list(sources or [0.0] * len(layers))
    sources[-1] = sources[-1] + ground.conductance[-1] * ((forcing.below_k - layers[-1]) - remainder[-1])
    if forcing.inner_w_m2 is not None:
        sources[-1] = sources[-1] + forcing.inner_w_m2
    surface_sun = forcing.absorbed
    if ground.sun_share is not None:
        heating = [share * forcing.absorbed for share in ground.sun_share]
        surface_sun = forcing.absorbed - sum(heating)
        sources = [a + b for a, b in zip(sources, heating, strict=True)]
    capacity, below, loss = ground.capacity, 0.0, 0.0
    if ground.gap is not None:
        # Radiation of the first layer through the gaps, linear in its change, so that long steps are stable.
        cube = ground.gap * ground.emissivity * STEFAN_BOLTZMANN * layers[0] ** 3
        below = ground.gap * (surface_sun + ground.emissivity * forcing.longwave) - cube * layers[0]
        sources[0], loss = sources[0] + below, 4.0 * cube
        capacity = [capacity[0] + loss * seconds, *capacity[1:]]
    response = top_response(drops, sources, capacity, ground.conductance, seconds)
    # Conductance from the surface into the column: through the skin and the first half layer.
    series = 1.0 / (response.beta + 1.0 / ground.conductance[0])
    before_k, risen = layers[0], response.alpha + remainder[0]
    density = turbulence.air_density(forcing.pressure_pa, forcing.air_k)
    saturation, _ = turbulence.saturation_vapour(xp, forcing.air_k)
    deficit = saturation - forcing.vapour_pa
    closed = turbulence.stomata(xp, ground.resistance, forcing.sunlight, deficit, forcing.air_k)
    resistance = xp.where(ground.leaves > 0.5, closed, ground.resistance) / xp.maximum(ground.wetness, 1e-6)
    wet = xp.maximum(xp.minimum(state.film / xp.maximum(ground.held, 1e-3), 1.0), ground.open_water)
    rain = WATER_HEAT * forcing.rain_kg_m2_s
    covers = 1.0 if ground.gap is None else 1.0 - ground.gap
    emits = covers * ground.emissivity
    gained = covers * surface_sun + emits * forcing.longwave
    t, frozen = guess, guess < ZERO_CELSIUS_K
    low, high = 0.0 * t, 0.0 * t + 1e4

    def residual(t: Any) -> tuple[Any, ...]:
        """Terms of the balance at a surface temperature [K]: net radiation, heat of air and rain, latent heat and that
        per mass [J/kg], conduction, the residual [W m⁻²], and minus its derivative [W m⁻² K⁻¹]."""
        h, bend = turbulence.convection(
            xp, t, forcing.air_k, forcing.wind_m_s, density, ground.log_wind, ground.log_heat, ground.height_m
        )
        latent, slope, heat = turbulence.evaporation(
            xp, t, forcing.vapour_pa, forcing.pressure_pa, h, bend, density, resistance, wet, frozen
        )
        cube = emits * STEFAN_BOLTZMANN * t**3
        warmer = t - forcing.air_k
        radiation, sensible = gained - cube * t, (h + rain) * warmer
        # In stable air the transfer coefficient falls as the surface cools. A lower bound keeps the derivative's sign.
        rate = 4.0 * cube + xp.maximum(h + bend * warmer + slope, 0.25 * h) + rain + series
        conducted = series * ((t - before_k) - risen)
        return radiation, sensible, latent, heat, conducted, radiation - sensible - latent - conducted, rate

    def move(excess: Any, rate: Any) -> Any:
        return xp.minimum(xp.maximum(excess / rate, -_LARGEST_STEP_K), _LARGEST_STEP_K)

    for _ in range(_NEWTON):
        *_, excess, rate = residual(t)
        # The derivative jumps at the onset of stability, dew and ice: where Newton leaves the bracket, bisect.
        low, high = xp.where(excess > 0.0, t, low), xp.where(excess > 0.0, high, t)
        after = t + move(excess, rate)
        t = xp.where((after >= low) & (after <= high), after, 0.5 * (low + high))
    # Melting snow stays at the melting point; the surplus of heat melts its first layer.
    cap = xp.where(ground.melting > 0.5, ZERO_CELSIUS_K, 1e4)
    t = xp.minimum(t, cap)
    radiation, sensible, latent, heat, conducted, excess, rate = residual(t)
    # One more Newton step, of the flux only: in a column that conducts well an ulp of temperature is many W m⁻².
    after = t + move(excess, rate)
    more = xp.where((after >= low) & (after <= high), series * move(excess, rate), 0.0)
    into = xp.where(t < cap, conducted + more, radiation - sensible - latent)
    changes = filled(response.alpha + response.beta * into, drops, response)
    inside = forcing.absorbed - surface_sun + below - loss * changes[0]
    warmed = rain * (t - forcing.air_k)
    return t, changes, (radiation + inside, sensible - warmed, latent, warmed, into + inside, latent / heat)


def _melted(
    xp: Any, layers: list[tuple[Any, Any]], liquid: Any, ground: Any
) -> tuple[list[tuple[Any, Any]], list[Any], Any]:
    """((temperature, remainder) of layers, their liquid water, net melt of all layers [kg m⁻²]) after phase change."""
    warm, wet, total = [], [], 0.0
    for (t, more), now, water, room, capacity in zip(
        layers, liquid, ground.water, ground.room, ground.capacity, strict=True
    ):
        # Snow's ice is unlimited, and excess melt water runs off.
        ice = xp.where(room < 0.5 * water, _ENDLESS, water - now)
        molten = capacity * ((t - ZERO_CELSIUS_K) + more) / FUSION
        after = now + xp.minimum(xp.maximum(molten, -now), ice)
        # A melt that is lost in rounding `after` leaves its heat in the layer.
        molten = after - now
        warm.append(_summed(t, more, -molten * FUSION / capacity))
        wet.append(xp.minimum(after, room))
        total = total + molten
    return warm, wet, total
