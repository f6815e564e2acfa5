"""Stability of the heat balance: thin and thick columns, any step, no wind and storm, nights without end.

Steps in the single precision that renders are compared with the same day in steps of half a minute in double precision.
The allowed error of a step has two parts. One is the
scheme's response error for a wave at twice the day's frequency, at the worst time constant, times half the daily range
of a surface without mass. The other is a millikelvin for Newton's method.
"""

from functools import cache

import numpy as np

from tests.robustness.cases import Found, case
from tests.robustness.stepped import DOUBLE, SINGLE, run
from thermorender.physics import balance, turbulence
from thermorender.physics.conduction import Slab, layered
from thermorender.physics.planck import STEFAN_BOLTZMANN
from thermorender.units import ZERO_CELSIUS_K

DAY_S = 86400.0
FINE_S, SECOND_S = 30.0, 1800.0
NEWTON_K = 1e-3
WINDS = (0.0, 3.0, 30.0)
# Slabs, film below [W m⁻² K⁻¹], emissivity, share of sun that is absorbed, mean of the air [K].
MATERIALS = {
    "metal sheet, 0.5 mm over outdoor air": ([Slab(0.0005, 50.0, 3.9e6)], 25.0, 0.9, 0.7, 288.0),
    "bare metal sheet, emissivity 0.001": ([Slab(0.0005, 200.0, 2.4e6)], 25.0, 1e-3, 0.1, 288.0),
    "water, 5 m": ([Slab(5.0, 0.57, 4.18e6)], None, 0.96, 0.9, 288.0),
    "thick rock": ([Slab(np.inf, 3.0, 2.2e6)], None, 0.95, 0.8, 288.0),
    "dry snow at -40 °C": ([Slab(0.3, 0.1, 3e5), Slab(np.inf, 1.2, 2.2e6)], None, 0.98, 0.15, 233.15),
}
STEPS = {"1 s": 1.0, "1 min": 60.0, "15 min": 900.0, "1 h": 3600.0, "3 h": 10800.0}


def column(cuts, **changed):
    """Return the balance.ColumnProperties of columns (C,) cut into layers, dry by default."""
    own = {
        "emissivity": 0.95, "log_wind": np.log(10.0 / 0.01), "log_heat": np.log(2.0 / 0.001), "height_m": 2.0,
        "resistance": 1e9, "wetness": 1.0, "open_water": 0.0, "leaves": 0.0, "held": 0.0, "melting": 0.0,
        "capacity": list(np.array([cut.capacity for cut in cuts]).T),
        "conductance": list(np.array([cut.conductance for cut in cuts]).T),
    }  # fmt: skip
    return balance.ColumnProperties(**(own | changed))


def air(**changed):
    """Return a balance.Forcing, dark, dry and of 288 K by default."""
    own = {
        "absorbed": 0.0, "longwave": 300.0, "sunlight": 0.0, "air_k": 288.0, "vapour_pa": 100.0, "wind_m_s": 3.0,
        "pressure_pa": 1e5, "rain_kg_m2_s": 0.0, "below_k": 288.0,
    }  # fmt: skip
    return balance.Forcing(**(own | changed))


@cache
def everything():
    """(ColumnProperties, day's Forcing by time) of all materials in all winds; the wind varies fastest."""
    cuts, rest = [], []
    for slabs, film, *numbers in MATERIALS.values():
        for wind in WINDS:
            cuts.append(layered(slabs, film=film))
            rest.append((*numbers, wind))
    emissivity, absorptance, mean_k, wind = np.array(rest).T

    def day(t):
        phase = 2.0 * np.pi * t / DAY_S
        kelvin = mean_k - 7.0 * np.cos(phase - 0.5)
        sun = 200.0 * (1.0 - np.cos(phase)) ** 2 * np.where(mean_k > 250.0, 1.0, 0.3)
        return air(absorbed=absorptance * sun, longwave=0.8 * STEFAN_BOLTZMANN * kelvin**4, air_k=kelvin,
                   wind_m_s=wind, below_k=kelvin, vapour_pa=1.0)  # fmt: skip

    ground = column(cuts, emissivity=emissivity)
    begin = np.tile(mean_k, (len(ground.capacity), 1))
    _, state = run(DOUBLE, ground, day, begin, 900.0, 96, -DAY_S)
    return ground, day, state


@cache
def fine():
    """{time [s]: surface temperatures} of a day in fine steps, and the State at noon."""
    ground, day, state = everything()
    half, found = round(0.5 * DAY_S / FINE_S), []
    for start_s in (0.0, 0.5 * DAY_S):
        kelvin, state = run(DOUBLE, ground, day, state, FINE_S, half, start_s)
        found.append((kelvin, state))
    seen = np.concatenate([kelvin for kelvin, _ in found])
    return {round(FINE_S * (1 + number)): kelvin for number, kelvin in enumerate(seen)}, found[0][1]


@cache
def stepped(seconds):
    """{time [s]: surface temperatures} of the same day in other steps; short ones cover half an hour from noon on."""
    ground, day, state = everything()
    begin, length = 0.0, DAY_S
    if seconds < FINE_S:
        begin, length, state = 0.5 * DAY_S, SECOND_S, fine()[1]
    kelvin, _ = run(SINGLE, ground, day, state, seconds, round(length / seconds), begin)
    return {round(begin + seconds * (1 + number)): values for number, values in enumerate(kelvin)}


@cache
def answer_error(angle):
    """Largest error of the scheme's response to a wave of given phase per step, over all time constants [1].

    dy/dt = (u − y)/τ with u = exp(iωt), in the periodic state, against 1/(1 + iωτ).
    """
    gamma = 1.0 - 0.5**0.5  # of the scheme, derived here again
    ahead, rate = (1.0 - gamma) / gamma, np.geomspace(1e-4, 1e5, 4000)
    solve = 1.0 / (1.0 + gamma * rate)
    first, second = np.exp(1j * gamma * angle), np.exp(1j * angle)
    driven = solve * gamma * rate * (ahead * solve * first + second)
    return np.abs(driven / (second - solve * (1.0 - ahead + ahead * solve)) - rate / (rate + 1j * angle)).max()


def _steps(step, name):
    number, seconds = list(MATERIALS).index(name), STEPS[step]
    columns = slice(number * len(WINDS), (number + 1) * len(WINDS))
    reference, found = fine()[0], stepped(seconds)
    shared = [t for t in found if t in reference]
    error = np.array([found[t] - reference[t] for t in shared])[:, columns]
    if not len(shared) or not np.isfinite(error).all():
        return Found(np.inf, 0.0, NEWTON_K)
    swing = 0.5 * np.ptp(list(reference.values()), axis=0)[: len(WINDS)].max()
    waves = sum(answer_error(4.0 * np.pi * each / DAY_S) for each in (seconds, FINE_S))
    return Found(float(np.abs(error).max()), 0.0, float(swing * waves + NEWTON_K))


for _name in MATERIALS:
    case("heat", _name + ", steps of {}, wind 0 … 30 m/s", STEPS)(lambda step, name=_name: _steps(step, name))


@case("heat", "metal sheet, air jumps by 30 K, step of {}", STEPS)
def jump(step):
    """One step after a jump; the scheme's decay differs from exp(−Δt/τ) by 0.2074 of the jump at most, at Δt = 8 τ.

    For an isolated mode (1 + (1 − 2γ) z)/(1 − γ z)² replaces exp(z); later steps forget it with its square.
    """
    seconds = STEPS[step]
    ground, begin = _settled_sheet()
    after = air(air_k=318.0, below_k=318.0)
    found, _ = run(SINGLE, ground, lambda t: after, begin, seconds, 1)
    exact, _ = run(DOUBLE, ground, lambda t: after, begin, seconds / 200.0, 200)
    return Found(float(found[-1, 0]), float(exact[-1, 0]), 0.2074 * 30.0)


def _settled_sheet():
    """(ColumnProperties, State) of a metal sheet after two days in dark, dry air."""
    ground = column([layered([Slab(0.0005, 50.0, 3.9e6)], film=25.0)])
    _, begin = run(DOUBLE, ground, lambda t: air(), np.full((len(ground.capacity), 1), 288.0), 3600.0, 48)
    return ground, begin


@case("heat", "metal sheet, one hour after that jump, steps of 15 min")
def after_jump():
    """After four steps at most 0.2074⁴ of the jump remains."""
    ground, begin = _settled_sheet()
    after = air(air_k=318.0, below_k=318.0)
    found, exact = (
        run(precision, ground, lambda t: after, begin, 3600.0 / count, count)[0][-1, 0]
        for precision, count in ((SINGLE, 4), (DOUBLE, 600))
    )
    return Found(float(found), float(exact), 0.2074**4 * 30.0 + NEWTON_K)


CLIMATES = {
    "polar night, calm": {"air_k": 233.0, "longwave": 140.0, "wind_m_s": 0.0, "vapour_pa": 15.0},
    "polar night, storm": {"air_k": 233.0, "longwave": 140.0, "wind_m_s": 30.0, "vapour_pa": 15.0},
    "polar day": {"air_k": 263.0, "longwave": 220.0, "absorbed": 250.0, "sunlight": 300.0, "vapour_pa": 200.0},
    "desert noon, calm": {"air_k": 318.0, "longwave": 400.0, "absorbed": 900.0, "wind_m_s": 0.0, "vapour_pa": 500.0},
    "saturated calm tropical night": {"air_k": 300.0, "longwave": 400.0, "wind_m_s": 0.0, "vapour_pa": 3500.0},
}


@case("heat", "{}, dry ground in balance", CLIMATES)
def dry(climate):
    """Three steps of 3 h against the root of the surface's fluxes."""
    return _balanced(air(**CLIMATES[climate]), resistance=1e9)


@case("heat", "{}, wet ground in balance", CLIMATES)
def wet(climate):
    """The same for ground that evaporates freely, with dew or frost."""
    return _balanced(air(**CLIMATES[climate]), resistance=0.0)


@case("heat", "metal of emissivity 0.001, calm night")
def bare_metal():
    """Final temperature of a surface that hardly radiates: the balance of its fluxes [K]."""
    return _balanced(air(wind_m_s=0.0), resistance=1e9, emissivity=1e-3)


def _balanced(act, **changed):
    from scipy.optimize import brentq

    ground = column([layered([Slab(1e-4, 1.0, 2e6)])], **changed)

    def surplus(kelvin):
        density = turbulence.air_density(act.pressure_pa, act.air_k)
        logs = ground.log_wind, ground.log_heat, ground.height_m
        h, bend = turbulence.convection(np, kelvin, act.air_k, act.wind_m_s, density, *logs)
        latent, *_ = turbulence.evaporation(
            np, kelvin, act.vapour_pa, act.pressure_pa, h, bend, density, ground.resistance, 0.0,
            kelvin < ZERO_CELSIUS_K,
        )  # fmt: skip
        emitted = ground.emissivity * (STEFAN_BOLTZMANN * kelvin**4 - act.longwave)
        return act.absorbed - emitted - h * (kelvin - act.air_k) - latent

    exact = brentq(surplus, act.air_k - 60.0, act.air_k + 100.0, xtol=1e-9)
    found, _ = run(SINGLE, ground, lambda t: act, np.full((len(ground.capacity), 1), act.air_k), 10800.0, 3)
    return Found(float(found[-1, 0]), exact, NEWTON_K)


@case("heat", "energy of a day, as kelvin of a metre of soil")
def energy():
    """Heat supplied against heat stored, in soil that freezes and thaws: the remainder is rounding."""
    cut = layered([Slab(np.inf, 1.5, 2.2e6, 0.3)])
    water = [np.array([each]) for each in cut.water]
    ground = column([cut], water=water, room=water, resistance=100.0)
    state = balance.at_rest(np, [np.array([271.0])] * len(ground.capacity), ground)

    def heat(state):
        ice = sum(w - now for w, now in zip(ground.water, state.liquid, strict=True))
        return sum(c * t for c, t in zip(ground.capacity, state.layers_k, strict=True)) - balance.FUSION * ice

    before, into = heat(state), 0.0
    for number in range(96):
        stages = []
        for offset in balance.stage_times(900.0):
            phase = 2.0 * np.pi * (900.0 * number + offset) / DAY_S
            sun = 150.0 * (1.0 - np.cos(phase)) ** 2
            stages.append(air(absorbed=sun, sunlight=sun, air_k=272.0 - 5.0 * np.cos(phase), longwave=240.0))
        state, fluxes = balance.step(np, state, ground, *stages, 900.0)
        into = into + 900.0 * fluxes.into_ground
    return Found(float((heat(state) - before - into)[0]) / 2.2e6, 0.0, 1e-9)
