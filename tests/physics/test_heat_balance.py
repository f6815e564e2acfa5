"""The heat balance against closed forms: conduction, exchange with the air, evaporation, melting, energy."""

import numpy as np
import pytest
from heat_support import COLUMNS, DAY, POND, SOIL, forcing, ground, sunny
from scipy.optimize import brentq, fsolve
from scipy.special import erf, erfc
from support import slow

from thermorender.physics import balance, moisture, turbulence
from thermorender.physics.conduction import LAYERS, Slab, ladder, layered
from thermorender.units import ZERO_CELSIUS_K

INERTIA = np.sqrt(SOIL.conductivity * SOIL.capacity)
# An exchange of 1e7 W m⁻² K⁻¹ fixes the surface at the air's temperature.
HOT_WIND = {"wind_m_s": 1e4, "pressure_pa": 1e7}


def simulate(column, act, seconds, steps, start_k=290.0, state=None):
    """Yield (time at the end [s], State, Fluxes) for each step; `act(time)` gives the Forcing."""
    state = state or balance.at_rest(np, [np.full(np.shape(start_k), start_k)] * len(column.capacity), column)
    for number in range(steps):
        at = number * seconds
        early, late = (act(at + offset) for offset in balance.stage_times(seconds))
        state, fluxes = balance.step(np, state, column, early, late, seconds)
        yield at + seconds, state, fluxes


@pytest.fixture
def airless(monkeypatch):
    monkeypatch.setattr(turbulence, "CALM_W_M2_K", 0.0)


def wave(column, period, seconds, amplitude=100.0):
    """Complex amplitude of the surface temperature per unit of a sinusoidal flux, in the periodic state [K m² W⁻¹].

    Computed from the tenth period, less its mean: the start then only affects the mean, except for 1e-4.
    """
    steps = round(period / seconds)
    omega = 2.0 * np.pi / period
    run = simulate(column, lambda t: forcing(absorbed=amplitude * np.cos(omega * t)), period / steps, 10 * steps)
    seen = np.array([(t, state.surface_k) for t, state, _ in run])[-steps:]
    return 2.0 * np.mean((seen[:, 1] - seen[:, 1].mean()) * np.exp(-1j * omega * seen[:, 0])) / amplitude


# --- conduction --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("hours", "minutes"), [(1.0, 1.0), (2.0, 5.0), (24.0, 15.0), *slow((6.0, 15.0), (240.0, 15.0))]
)
def test_semi_infinite_solid_under_a_sinusoidal_flux(airless, hours, minutes):
    """T = Q / (I √(iω)): amplitude and phase lag of 45° (Carslaw & Jaeger 1959, 2.9), to a thousandth."""
    found = wave(ground(layered([SOIL])), 3600.0 * hours, 60.0 * minutes)
    ratio = found * INERTIA * np.sqrt(2j * np.pi / (3600.0 * hours))
    assert abs(ratio) == pytest.approx(1.0, abs=1e-3)
    assert np.angle(ratio) == pytest.approx(0.0, abs=1e-3)


def impedance(layers, s):
    """Surface temperature over flux of Layers at complex rates s, from their resistances and capacities."""
    admittance = layers.conductance[-1] + 0.0 * s
    for capacity, conductance in zip(layers.capacity[::-1], layers.conductance[-2::-1], strict=True):
        admittance = 1.0 / (1.0 / (admittance + s * capacity) + 1.0 / conductance)
    return 1.0 / admittance


@pytest.mark.parametrize(
    ("count", "hours", "error"),
    [(8, (0.5, 240.0), 1.5e-2), (10, (1.0, 120.0), 3e-3), (LAYERS, (1.0, 240.0), 1e-3), (16, (6.0, 48.0), 1.1e-4)],
)
def test_ladder_matches_the_half_space(count, hours, error):
    """The errors are those its docstring states, neither better nor worse."""
    s = 2j * np.pi / (3600.0 * np.geomspace(*hours, 200))
    found = np.abs(impedance(layered([SOIL], count=count), s) * INERTIA * np.sqrt(s) - 1.0).max()
    assert 0.3 * error < found < error


def test_ladder_scales_with_the_material():
    """A tenfold conductivity stretches all depths by √10; every half-space has the same nodes in s^½."""
    node, border = ladder()
    cut = layered([Slab(np.inf, 10.0, 2e6)])
    np.testing.assert_allclose(cut.node_m, node * np.sqrt(10.0 / 2e6), rtol=1e-12)
    np.testing.assert_allclose(cut.capacity.sum(), border[-1] * np.sqrt(10.0 * 2e6), rtol=1e-12)


def test_damping_depth():
    """Sixty layers over ten damping depths: a daily wave decays as e^(−x/d) and lags by x/d, to a thousandth of d."""
    # Carslaw & Jaeger, Conduction of Heat in Solids (1959), 2.6.
    deep = np.sqrt(DAY * SOIL.conductivity / (np.pi * SOIL.capacity))
    cut = layered([Slab(10.0 * deep, SOIL.conductivity, SOIL.capacity)], count=60)
    below = cut.conductance[1:]
    matrix = np.diag(below + 2j * np.pi / DAY * cut.capacity)
    matrix += np.diag(np.append(0.0, below[:-1])) - np.diag(below[:-1], 1) - np.diag(below[:-1], -1)
    found = np.linalg.solve(matrix, np.eye(60)[0])
    surface = found[0] + 1.0 / cut.conductance[0]
    seen = cut.node_m < 2.0 * deep
    x, fall = cut.node_m[seen] / deep, np.log(found[seen] / surface)
    assert -(x @ fall.real) / (x @ x) == pytest.approx(1.0, abs=1e-3)
    assert -(x @ np.unwrap(fall.imag)) / (x @ x) == pytest.approx(1.0, abs=1e-3)


CHAINS = {
    "asphalt on soil": ([Slab(0.08, 1.0, 2e6), Slab(0.3, 1.5, 2e6), Slab(np.inf, 1.0, 2.2e6)], None, 0.1),
    "snow on soil": ([Slab(0.1, 0.1, 3e5), Slab(np.inf, 1.2, 2.2e6)], None, 0.1),
    "paving on foam": ([Slab(0.02, 1.7, 2e6), Slab(0.05, 0.04, 5e4), Slab(np.inf, 1.2, 2.2e6)], None, 0.1),
    "roof over a room": ([Slab(0.005, 0.2, 1.5e6), Slab(0.15, 0.04, 5e4), Slab(0.2, 1.7, 2.1e6)], 7.7, 0.2),
    "wall": ([Slab(0.2, 1.7, 2.1e6)], 7.7, 0.2),
    "metal sheet": ([Slab(0.0005, 50.0, 3.9e6)], 25.0, 1e-6),
    "deep water": ([Slab(5.0, 0.57, 4.18e6)], None, 0.1),
}


@pytest.mark.parametrize("name", CHAINS)
def test_layers_against_the_exact_impedance(name):
    """Sun of 100 W/m² with periods of 3 h … 10 d, heat loss to the air of 15 W m⁻² K⁻¹: error in kelvin.

    The reference transforms the impedance from slab to slab, as in a transmission line:
    Z' = Z₀ (Z + Z₀ tanh κd) / (Z₀ + Z tanh κd), Z₀ = 1/√(s k c), κ = √(s c/k) (Carslaw & Jaeger 1959, 3.7).
    """
    slabs, film, allowed_k = CHAINS[name]
    s = 2j * np.pi / (3600.0 * np.geomspace(3.0, 240.0, 60))
    exact = np.full(s.shape, 1e12 + 0j) if film is None else np.full(s.shape, 1.0 / film + 0j)
    for slab in slabs[::-1]:
        own = 1.0 / np.sqrt(s * slab.conductivity * slab.capacity)
        if np.isinf(slab.thickness_m):
            exact = own
            continue
        through = np.tanh(np.sqrt(s * slab.capacity / slab.conductivity) * slab.thickness_m)
        exact = own * (exact + own * through) / (own + exact * through)
    found = impedance(layered(slabs, film=film), s)
    error = 100.0 * np.abs(1.0 / (1.0 / found + 15.0) - 1.0 / (1.0 / exact + 15.0))
    assert error.max() < allowed_k


@pytest.mark.parametrize("thick_m", [1e-5, 0.2, 2.0, 2.7, 5.0, 100.0])
def test_layers_hold_the_resistance_and_the_heat_of_a_wall(thick_m):
    """Earth over concrete over a room: the conductances are positive, and sums do not depend on the layers."""
    slabs = [Slab(thick_m, 1.0, 2e6), Slab(0.3, 1.7, 2.1e6)]
    cut = layered(slabs, film=7.7)
    assert min(cut.conductance) > 0.0 and min(cut.capacity) > 0.0
    assert (1.0 / cut.conductance).sum() == pytest.approx(thick_m + 0.3 / 1.7 + 1.0 / 7.7, rel=1e-9)
    assert cut.capacity.sum() == pytest.approx(thick_m * 2e6 + 0.3 * 2.1e6, rel=1e-9)


def after_a_step(t):
    """Allowed relative error of temperature after a step of 15 min: the first has an infinite slope."""
    return 0.065 if t < 1000.0 else 3e-3 if t < 3600.0 else 1e-3


def test_step_in_flux(airless):
    """ΔT = 2 Q √(t/π) / I (Carslaw & Jaeger 1959, 2.9), from a quarter of an hour to three days, in steps of 15 min."""
    for t, state, _ in simulate(ground(layered([SOIL])), lambda t: forcing(absorbed=100.0), 900.0, 288):
        exact = 200.0 * np.sqrt(t / np.pi) / INERTIA
        assert state.surface_k - 290.0 == pytest.approx(exact, rel=after_a_step(t))


def test_step_in_flux_with_newtons_law():
    """ΔT = Q/h (1 − exp(h²t/I²) erfc(h√t/I)), h = 2 W m⁻² K⁻¹ of calm air (Carslaw & Jaeger 1959, 2.7 (4))."""
    h = turbulence.CALM_W_M2_K
    for t, state, _ in simulate(ground(layered([SOIL])), lambda t: forcing(absorbed=100.0), 900.0, 288):
        x = h * np.sqrt(t) / INERTIA
        exact = 100.0 / h * (1.0 - np.exp(x * x) * erfc(x))
        assert state.surface_k - 290.0 == pytest.approx(exact, rel=after_a_step(t))


def test_step_in_temperature():
    """Stored heat is 2 I ΔT √(t/π); temperature by depth follows erfc(x / 2√(at)) (Carslaw & Jaeger 1959, 2.4, 2.5)."""
    cut = layered([Slab(3.0, SOIL.conductivity, SOIL.capacity)], count=100)
    heat, state = 0.0, None
    for t, state, fluxes in simulate(ground(cut), lambda t: forcing(air_k=300.0, **HOT_WIND), 60.0, 1440):  # noqa: B007
        heat += 60.0 * fluxes.into_ground
        if t >= 7200.0:
            assert heat == pytest.approx(2.0 * INERTIA * 10.0 * np.sqrt(t / np.pi), rel=5e-3)
    at = cut.node_m / (2.0 * np.sqrt(SOIL.conductivity / SOIL.capacity * DAY))
    assert np.abs(np.array(state.layers_k) - 290.0 - 10.0 * erfc(at)).max() < 0.03


def test_steady_wall_of_several_slabs():
    """q = ΔT / (Σ d/k + 1/h); mid-slab temperatures from the resistances in front of each (ISO 6946, 6.7)."""
    slabs = [Slab(0.02, 0.9, 1.6e6), Slab(0.1, 0.04, 5e4), Slab(0.24, 0.5, 1.4e6)]
    column = ground(layered(slabs, film=7.7))
    run = simulate(column, lambda t: forcing(air_k=263.0, below_k=293.0, **HOT_WIND), 1e6, 60)
    _, state, fluxes = list(run)[-1]
    through = 30.0 / (0.02 / 0.9 + 0.1 / 0.04 + 0.24 / 0.5 + 1.0 / 7.7)
    assert -fluxes.into_ground == pytest.approx(through, rel=1e-6)
    resistance = np.cumsum(1.0 / np.array(column.conductance))[:-1]
    np.testing.assert_allclose(state.layers_k, 263.0 + through * resistance, atol=1e-4)


@pytest.mark.slow
def test_second_order_in_time():
    """The second day of soil under sun, wind and vapour: half the step, a quarter of the error; 1 mK at 15 min."""
    column, found = ground(layered([SOIL]), emissivity=0.95, resistance=200.0), {}
    for steps in (48, 96, 192, 1536):
        run = simulate(column, sunny, DAY / steps, 2 * steps)
        found[steps] = np.array([state.surface_k for _, state, _ in run])[steps // 48 - 1 :: steps // 48][48:]
    first, second, third = (np.sqrt(((found[n] - found[1536]) ** 2).mean()) for n in (48, 96, 192))
    assert 3.3 < first / second < 4.7 and 3.3 < second / third < 4.7
    assert second < 1e-3


# --- energy, water and ice ---------------------------------------------------------------------------------------


def stored(column, state):
    """Sensible heat of a column above 0 °C [J m⁻²]."""
    return sum(c * (t - ZERO_CELSIUS_K) for c, t in zip(column.capacity, state.layers_k, strict=True))


@pytest.mark.parametrize("name", COLUMNS)
def test_energy_of_a_day_is_conserved(name):
    """Heat stored and used for melting equals the heat into the ground, to 1e-9; surface fluxes close to 1e-3."""
    column, weather = COLUMNS[name]
    start = None
    into = gained = lost = melt = turned = 0.0
    for t, state, fluxes in simulate(column, lambda t: sunny(t, **weather), 900.0, 192, weather.get("air_k", 290.0)):
        if t <= DAY:
            start = stored(column, state)
            continue
        into += 900.0 * fluxes.into_ground
        turned += 900.0 * abs(fluxes.into_ground)
        gained += 900.0 * fluxes.net_radiation
        lost += 900.0 * (fluxes.sensible + fluxes.latent + fluxes.rain)
        melt += 900.0 * fluxes.molten
    change = stored(column, state) - start + balance.FUSION * melt
    assert abs(change - into) < 1e-9 * turned
    assert abs(gained - lost - into) < 1e-6 * turned
    assert turned > 1e6


@pytest.mark.parametrize("name", COLUMNS)
def test_the_terms_of_a_step_add_up_to_nothing(name):
    column, weather = COLUMNS[name]
    state = balance.at_rest(np, [np.full(1, weather.get("air_k", 290.0))] * len(column.capacity), column)
    largest = dict.fromkeys(balance.TERMS, 0.0)
    for number in range(192):
        stages = [sunny(900.0 * number + offset, **weather) for offset in balance.stage_times(900.0)]
        state, fluxes = balance.step(np, state, column, *stages, 900.0)
        found = balance.terms(np, column, *stages, fluxes)
        # Newton's steps end within 1e-8 K, of some 100 W m⁻² K⁻¹.
        found = {term: float(np.ravel(value)[0]) for term, value in found.items()}
        assert abs(sum(found.values())) < 1e-6
        assert found["sunlight"] >= 0.0 and found["longwave"] > 0.0 > found["emission"] and found["rain"] <= 5.0
        largest = {term: max(value, abs(found[term])) for term, value in largest.items()}
    assert (largest["rain"] > 0.1) == ("rain_kg_m2_s" in weather) and largest["conduction"] > 10.0
    assert (largest["melt"] > 50.0) == ("melts" in name)


@pytest.mark.parametrize(("sun", "inner"), [(0.0, 0.0), (0.0, 400.0), (700.0, 0.0), (700.0, 400.0)])
def test_terms_of_a_steady_sheet_are_those_of_its_equation(sun, inner):
    """α G + q = ε σ (T⁴ − T_sky⁴) + h (T − T_air) + g (T − T_behind), with what sun and an engine give."""
    emissivity, film, air, sky, behind = 0.9, 25.0, 285.0, 255.0, 280.0
    sheet = layered([Slab(1e-3, 60.5, 7854.0 * 434.0)], film=film)
    column, longwave = ground(sheet, emissivity=emissivity), balance.STEFAN_BOLTZMANN * sky**4
    act = forcing(absorbed=sun, sunlight=sun, longwave=longwave, air_k=air, below_k=behind, inner_w_m2=inner)
    # The engine's heat enters the last layer: the resistance above it, and the conductance below it.
    above, through = sum(1.0 / each for each in sheet.conductance[:-1]), sheet.conductance[-1]

    def conducted(kelvin):
        return (inner - through * (kelvin - behind)) / (1.0 + through * above)

    def surplus(kelvin):
        lost = emissivity * (balance.STEFAN_BOLTZMANN * kelvin**4 - longwave)
        return sun + conducted(kelvin) - lost - turbulence.CALM_W_M2_K * (kelvin - air)

    state = balance.at_rest(np, [np.full(1, air)] * len(column.capacity), column)
    for _ in range(100):
        state, fluxes = balance.step(np, state, column, act, act, 3600.0)
    found, kelvin = balance.terms(np, column, act, act, fluxes), brentq(surplus, 150.0, 900.0, xtol=1e-9)
    assert above * through < 1e-3
    expected = dict.fromkeys(balance.TERMS, 0.0) | {
        "sunlight": sun, "longwave": emissivity * longwave,
        "emission": -emissivity * balance.STEFAN_BOLTZMANN * kelvin**4,
        "sensible": -turbulence.CALM_W_M2_K * (kelvin - air), "conduction": conducted(kelvin),
    }  # fmt: skip
    for name, value in expected.items():
        assert float(np.ravel(found[name])[0]) == pytest.approx(value, abs=1e-6), name


def test_snow_at_the_melting_point_melts_by_what_it_receives():
    column, weather = COLUMNS["snow that melts and runs off"]
    state = balance.at_rest(np, [np.full(1, 273.15)] * len(column.capacity), column)
    noon = None
    for number in range(192):
        stages = [sunny(900.0 * number + offset, **weather) for offset in balance.stage_times(900.0)]
        state, fluxes = balance.step(np, state, column, *stages, 900.0)
        if number == 96 + 52:
            noon = balance.terms(np, column, *stages, fluxes)
    assert noon is not None and noon["melt"] < -300.0
    # What the snow exchanges with the ground below it.
    assert abs(noon["conduction"]) < 0.5


@pytest.mark.parametrize("gap", [0.1, 0.4])
def test_leaves_over_insulated_ground_share_sun_and_sky_with_it(gap):
    """Steady state of two temperatures: leaves in calm air, and ground that only its gaps and the leaves heat."""
    sun, longwave, air, emissivity, skin = 400.0, 300.0, 290.0, 0.97, 10.0
    column = ground(layered([Slab(0.05, 100.0, 2e5)], skin=skin), emissivity=emissivity, gap=gap)

    def balances(kelvin):
        leaf, below = kelvin
        net_leaf, net_below = (sun + emissivity * (longwave - balance.STEFAN_BOLTZMANN * t**4) for t in (leaf, below))
        passes = column.conductance[0] * (below - leaf)
        return (1.0 - gap) * net_leaf + passes - turbulence.CALM_W_M2_K * (leaf - air), gap * net_below - passes

    leaf, below = fsolve(balances, (300.0, 300.0), xtol=1e-12)
    steady = forcing(absorbed=sun, longwave=longwave, air_k=air)
    *_, (_, state, _) = simulate(column, lambda t: steady, 3600.0, 400)
    assert state.surface_k == pytest.approx(leaf, abs=1e-3) and state.layers_k[0] == pytest.approx(below, abs=1e-3)
    seen = balance.seen_k(state, column)
    assert seen == pytest.approx(((1.0 - gap) * leaf**4 + gap * below**4) ** 0.25, abs=1e-3)
    assert below > leaf


def test_light_ground_below_gaps_is_stable_in_steps_of_three_hours_and_keeps_its_heat():
    column = ground(layered([Slab(1e-3, 1.0, 2e6)], skin=0.5), emissivity=0.95, gap=0.9)
    steady = forcing(absorbed=500.0, longwave=330.0, air_k=290.0)
    fine, state = (balance.at_rest(np, [np.float64(290.0)] * len(column.capacity), column) for _ in range(2))
    for _ in range(2000):
        fine, _ = balance.step(np, fine, column, steady, steady, 20.0)
    for _ in range(20):
        before = state
        state, fluxes = balance.step(np, state, column, steady, steady, 10800.0)
        stored = sum(c * (a - b) for c, a, b in zip(column.capacity, state.layers_k, before.layers_k, strict=True))
        stored += sum(c * a for c, a in zip(column.capacity, state.remainder_k, strict=True))
        stored -= sum(c * a for c, a in zip(column.capacity, before.remainder_k or [0.0] * 99, strict=False))
        assert stored == pytest.approx(10800.0 * fluxes.into_ground, abs=1e-6)
    assert state.layers_k[0] == pytest.approx(fine.layers_k[0], abs=1e-3)


def test_snow_melts_at_the_melting_point_by_the_heat_it_receives():
    """Surface and snow stay at 273.15 K through the afternoon; melt = absorbed heat / heat of fusion."""
    column, weather = COLUMNS["snow that melts and runs off"]
    noon = [
        (t, state, fluxes)
        for t, state, fluxes in simulate(column, lambda t: sunny(t, **weather), 900.0, 192, 273.15)
        if 11.0 < (t - DAY) / 3600.0 < 15.0
    ]
    for _, state, fluxes in noon:
        assert state.surface_k == ZERO_CELSIUS_K
        # Snow exchanges up to 0.2 W/m² with the ground below it.
        assert balance.FUSION * fluxes.molten == pytest.approx(fluxes.into_ground, rel=1e-3, abs=0.5)
        # The dry ground below may be a microkelvin warmer.
        snow = [kelvin for kelvin, water in zip(state.layers_k, column.water, strict=True) if water > 0.0]
        assert max(snow) <= ZERO_CELSIUS_K + 1e-9
        room = balance.RETENTION * np.array(column.water)
        assert (np.array(state.liquid) <= room + 1e-9).all()
    assert noon and sum(fluxes.molten for *_, fluxes in noon) > 0.0


@pytest.mark.parametrize(("count", "error"), [(LAYERS, 0.04), *slow((30, 0.012))])
def test_freezing_of_moist_soil_against_neumann(count, error):
    """Front at 2λ√(at), heat lost 2kΔT√(t/πa)/erf λ, λ e^(λ²) erf λ = cΔT/(√π L): Carslaw & Jaeger (1959), 11.2."""
    cut = layered([Slab(np.inf, 1.5, 2.2e6, 0.3)], count=count)
    column = ground(cut, water=list(cut.water))
    colder, diffusivity = 10.0, 1.5 / 2.2e6
    per_volume = 300.0 * balance.FUSION
    lam = brentq(lambda x: x * np.exp(x * x) * erf(x) - 2.2e6 * colder / (np.sqrt(np.pi) * per_volume), 1e-3, 3.0)
    begin = balance.State(ZERO_CELSIUS_K, [ZERO_CELSIUS_K] * count, 0.0, list(cut.water))
    frozen = heat = 0.0
    air = ZERO_CELSIUS_K - colder
    for t, state, fluxes in simulate(column, lambda t: forcing(air_k=air, **HOT_WIND), 900.0, 960, state=begin):
        heat -= 900.0 * fluxes.into_ground
        frozen = (sum(cut.water) - sum(state.liquid)) / 300.0
        if t >= DAY:
            assert frozen == pytest.approx(2.0 * lam * np.sqrt(diffusivity * t), rel=error)
            exact = 2.0 * 1.5 * colder * np.sqrt(t / (np.pi * diffusivity)) / erf(lam)
            assert heat == pytest.approx(exact, rel=error)
    assert frozen == pytest.approx(0.48, abs=0.03)


def iapws_water(kelvin):
    """Saturation pressure over water [Pa]: Wagner & Pruß, J. Phys. Chem. Ref. Data 31 (2002) 387, eq. 2.5."""
    theta = 1.0 - kelvin / 647.096
    a = (-7.85951783, 1.84408259, -11.7866497, 22.6807411, -15.9618719, 1.80122502)
    power = (1.0, 1.5, 3.0, 3.5, 4.0, 7.5)
    return 22.064e6 * np.exp(647.096 / kelvin * sum(x * theta**n for x, n in zip(a, power, strict=True)))


def iapws_ice(kelvin):
    """Sublimation pressure [Pa]: Wagner et al., J. Phys. Chem. Ref. Data 40 (2011) 043103, eq. 4."""
    theta = kelvin / 273.16
    a, b = (-21.2144006, 27.3203819, -6.10598130), (0.00333333333, 1.20666667, 1.70333333)
    return 611.657 * np.exp(sum(x * theta**n for x, n in zip(a, b, strict=True)) / theta)


def test_saturation_vapour():
    """Within 0.4 % of the international formulations from −40 to 50 °C; their own check values are tested first."""
    assert iapws_water(273.16) == pytest.approx(611.657, rel=1e-5)
    assert iapws_ice(230.0) == pytest.approx(8.94735, rel=1e-6)
    for low, high, exact in ((273.15, 323.15, iapws_water), (233.15, 273.1, iapws_ice)):
        kelvin = np.linspace(low, high, 300)
        pressure, slope = turbulence.saturation_vapour(np, kelvin)
        assert np.abs(pressure / exact(kelvin) - 1.0).max() < 4e-3
        numerical = (exact(kelvin + 0.01) - exact(kelvin - 0.01)) / 0.02
        assert np.abs(slope / numerical - 1.0).max() < 6e-3


@pytest.mark.parametrize(("celsius", "humidity"), [(20, 0.5), (30, 0.4), (40, 0.2), (10, 0.5), (45, 0.05), (5, 0.9)])
def test_wet_surface_without_radiation_is_a_psychrometer(celsius, humidity):
    """e = eₛ(T') − 6.53e-4 (1 + 9.44e-4 T') p (T − T'), WMO-No. 8, annex 4.B: its coefficient is 2 % from ours."""
    from scipy.optimize import brentq

    def over_water(t):
        return 611.2 * np.exp(17.62 * t / (243.12 + t))

    vapour, pressure = humidity * over_water(celsius), 101325.0

    def lacks(t):
        return over_water(t) - 6.53e-4 * (1.0 + 9.44e-4 * t) * pressure * (celsius - t) - vapour

    wet_bulb = brentq(lacks, -10.0, celsius)
    cut = layered([Slab(1e-4, 1.0, 4e6)])
    column = ground(cut, log_wind=4.0, log_heat=4.0, resistance=0.0, held=1e6)
    begin = balance.State(290.0, [290.0] * LAYERS, 1e6, None)
    air = {"air_k": celsius + ZERO_CELSIUS_K, "vapour_pa": vapour, "wind_m_s": 5.0, "pressure_pa": pressure}
    *_, (_, state, _) = simulate(column, lambda t: forcing(**air), 3600.0, 20, state=begin)
    slope = 17.62 * 243.12 / (243.12 + wet_bulb) ** 2 * over_water(wet_bulb)
    allowed = 0.02 * 66.5 / (66.5 + slope) * (celsius - wet_bulb) + 0.01
    assert state.surface_k - ZERO_CELSIUS_K == pytest.approx(wet_bulb, abs=allowed)


# --- exchange with the air ---------------------------------------------------------------------------------------


def exchanged(surface_k, air_k, wind, rough=0.01, rough_heat=0.001, height=2.0):
    density = turbulence.air_density(1e5, air_k)
    logs = np.log(height / rough), np.log(height / rough_heat)
    return turbulence.convection(np, surface_k, air_k, wind, density, *logs, height)


def test_neutral_exchange_follows_the_logarithmic_profile():
    """ρ c u* θ* for a wind and a temperature that are both logarithmic in height."""
    wind, rough, rough_heat = np.array([0.5, 2.0, 10.0, 30.0]), 0.01, 0.001
    friction = 0.4 * wind / np.log(2.0 / rough)
    per_kelvin = 0.4 / np.log(2.0 / rough_heat)
    found, _ = exchanged(290.0, 290.0, wind)
    density = 1e5 / (287.05 * 290.0)
    np.testing.assert_allclose(found - turbulence.CALM_W_M2_K, density * 1005.0 * friction * per_kelvin, rtol=1e-6)


def test_stable_air_reduces_exchange_by_its_richardson_number():
    """Ri = 0.1 halves the turbulent exchange of neutral air; a colder surface still takes more heat."""
    wind, height, air = 2.0, 2.0, 280.0
    # Ri = g z (T_air − T) / (T̄ U²), solved for the surface.
    share = 0.1 * wind**2 / (turbulence.GRAVITY * height)
    surface = air * (1.0 - 0.5 * share) / (1.0 + 0.5 * share)
    logs = np.log(2.0 / 0.01), np.log(2.0 / 0.001)
    h, neutral = (
        turbulence.convection(np, t, air, wind, 1.2, *logs, height)[0] - turbulence.CALM_W_M2_K for t in (surface, air)
    )
    assert h / neutral == pytest.approx(0.5, rel=1e-9)
    # A sensor high above a wood: the profile of a calm night lies in the lowest 10 m.
    low, high = (turbulence.convection(np, surface, air, wind, 1.2, *logs, z)[0] for z in (turbulence.STABLE_M, 40.0))
    assert low == high < h
    colder = np.linspace(air, air - 40.0, 400)
    taken = turbulence.convection(np, colder, air, wind, 1.2, *logs, height)[0] * (air - colder)
    assert (np.diff(taken) > 0.0).all()


def test_stomata_close_in_the_dark_in_dry_air_and_in_frost():
    """The light law's 0.81/0.05 in the dark and 1 in full sun (IFS, eq. 8.11); Leuning's (1 + D/D₀), D₀ 1500 Pa; half
    the conductance 17.7 K from 25 °C (Noilhan and Planton 1989, eq. B5: 1 − 0.0016 ΔT²), none 25 K from it.
    """
    assert turbulence.stomata(np, 60.0, 0.0, 1000.0, 298.0) / 60.0 == pytest.approx(16.2)
    assert turbulence.stomata(np, 60.0, 1000.0, 1000.0, 298.0) / 60.0 == pytest.approx(0.81 * 5.0 / 4.05)
    dry = turbulence.stomata(np, 60.0, 1000.0, 4000.0, 298.0) / turbulence.stomata(np, 60.0, 1000.0, 1000.0, 298.0)
    assert dry == pytest.approx((1500.0 + 4000.0) / (1500.0 + 1000.0))
    open_ = turbulence.stomata(np, 60.0, 1000.0, 1000.0, 298.0)
    for away in (-(312.5**0.5), 312.5**0.5):
        assert turbulence.stomata(np, 60.0, 1000.0, 1000.0, 298.0 + away) / open_ == pytest.approx(2.0)
    assert turbulence.stomata(np, 60.0, 1000.0, 1000.0, 273.0) > 500.0 * open_


def test_growing_season_follows_its_published_ramps():
    """Jolly, Nemani and Running (2005), table 1: −2 … 5 °C, 10 … 11 h, 4100 … 900 Pa; their product."""
    assert moisture.growing_season([-2.0, 1.5, 5.0, 20.0], 12.0).tolist() == [0.0, 0.5, 1.0, 1.0]
    assert moisture.growing_season(20.0, [9.0, 10.5, 11.0]).tolist() == [0.0, 0.5, 1.0]
    assert moisture.growing_season(1.5, 10.5) == 0.25
    assert moisture.moist([900.0, 2500.0, 4100.0]).tolist() == [1.0, 0.5, 0.0]


def test_wind_over_other_land_follows_two_logarithmic_profiles():
    """5 m/s at 10 m over grass of 0.03 m: both profiles meet at 60 m, the blending height."""
    friction = [0.4 * 5.0 / np.log(10.0 / 0.03), None]
    aloft = friction[0] / 0.4 * np.log(60.0 / 0.03)
    friction[1] = 0.4 * aloft / np.log(60.0 / 0.5)
    assert 5.0 * turbulence.wind_factor(20.0, 0.5, 10.0, 0.03) == pytest.approx(friction[1] / 0.4 * np.log(20.0 / 0.5))
    assert turbulence.wind_factor(10.0, 0.03, 10.0, 0.03) == pytest.approx(1.0)


def test_free_convection_is_independent_of_wind():
    """In very unstable air the law's limit is ρ c √(g z₀ ΔT/T)/5, for any wind, height and roughness for heat."""
    kelvin = np.array([300.0, 310.0, 330.0])
    free = turbulence.air_density(1e5, 290.0) * 1005.0 * 0.2 * np.sqrt(9.80665 * 0.01 * (kelvin - 290.0)
                                                                     / (0.5 * (kelvin + 290.0)))  # fmt: skip
    for height, rough_heat in ((2.0, 0.001), (20.0, 0.01)):
        found, _ = exchanged(kelvin, 290.0, 0.1, rough_heat=rough_heat, height=height)
        np.testing.assert_allclose(found - turbulence.CALM_W_M2_K, free, rtol=0.06)
    calm, _ = exchanged(kelvin, 290.0, 0.0)
    np.testing.assert_array_equal(calm, exchanged(kelvin, 290.0, 0.1)[0])


@pytest.mark.parametrize("wind", [0.0, 0.5, 3.0, 30.0])
def test_exchange_is_continuous_and_its_derivative_is_correct(wind):
    """h(T) has no jump at the air's temperature; its derivative is stated at a fixed mean of both temperatures."""
    around, _ = exchanged(290.0 + np.array([-1e-7, 0.0, 1e-7]), 290.0, wind)
    assert np.ptp(around) < 1e-3
    kelvin = 290.0 + np.array([-30.0, -5.0, -0.5, 0.5, 5.0, 40.0])
    _, bend = exchanged(kelvin, 290.0, wind)
    step = 1e-5
    numerical = (exchanged(kelvin + step, 290.0, wind)[0] - exchanged(kelvin - step, 290.0, wind)[0]) / (2.0 * step)
    # d(ΔT/mean)/dT is 1/mean (1 − ΔT / 2 mean).
    mean = 0.5 * (kelvin + 290.0)
    np.testing.assert_allclose(numerical, bend * (1.0 - (kelvin - 290.0) / (2.0 * mean)), rtol=1e-5, atol=1e-8)


def test_balance_has_one_solution():
    """Heat loss grows with surface temperature, from 20 K below the air upwards: wind 0–30 m/s, −40…50 °C.

    In humid hot air and 30 K below the dew point it would not, but only refrigeration makes such a surface.
    """
    rng = np.random.default_rng(1)
    air, wind = rng.uniform(233.0, 323.0, (2000, 1)), rng.uniform(0.0, 30.0, (2000, 1))
    wind[:500] = 0.0
    rough = 10.0 ** rng.uniform(-4.0, -0.3, air.shape)
    kelvin = air + np.linspace(-20.0, 80.0, 1001)
    vapour = rng.uniform(0.0, 1.0, air.shape) * turbulence.saturation_vapour(np, air)[0]
    density = turbulence.air_density(1e5, air)
    h, bend = turbulence.convection(np, kelvin, air, wind, density, np.log(10.0 / rough), np.log(20.0 / rough), 2.0)
    for frozen in (False, True):
        resistance, film = 10.0 ** rng.uniform(0.0, 4.0, air.shape), rng.choice([0.0, 0.5, 1.0], air.shape)
        latent, slope, _ = turbulence.evaporation(np, kelvin, vapour, 1e5, h, bend, density, resistance, film, frozen)
        given = h * (kelvin - air) + latent
        assert (np.diff(given, axis=1) / 0.1).min() > 1.9  # calm air alone takes 2 W m⁻² K⁻¹
        # Newton's slope is that of the flux, except for the mean temperature and where two laws meet.
        middle = 0.5 * (slope[:, 1:] + slope[:, :-1])
        assert np.median(np.abs(middle / (np.diff(latent, axis=1) / 0.1) - 1.0)) < 0.03


def test_newton_converges_from_far_away(monkeypatch):
    """Columns up to 50 K from balance, one step of 1 s … 3 h: 99 % within a millikelvin, all within 2 K.

    The rest are calm, hot and wet ones whose exchange sets in at the air's temperature; they converge in the next step.
    """
    rng, many = np.random.default_rng(0), 20_000
    kinds = [layered([SOIL]), layered([Slab(0.0005, 50.0, 3.9e6)], film=10.0), layered([Slab(np.inf, 0.1, 3e5)]), POND]
    kind = rng.integers(0, len(kinds), many)
    pick = lambda name: list(np.array([getattr(each, name) for each in kinds])[kind].T)  # noqa: E731
    rough, air = 10.0 ** rng.uniform(-4.0, -0.3, many), rng.uniform(233.0, 323.0, many)
    column = balance.ColumnProperties(
        emissivity=rng.choice([1e-3, 0.5, 0.95, 1.0], many), log_wind=np.log(2.0 / rough),
        log_heat=np.log(2.0 / rough) + rng.uniform(0.0, 7.0, many), height_m=2.0,
        resistance=10.0 ** rng.uniform(0.0, 4.0, many), wetness=rng.uniform(0.0, 1.0, many), open_water=0.0, leaves=0.0,
        held=rng.choice([0.0, 0.2, 1e3], many), melting=0.0, capacity=pick("capacity"),
        conductance=pick("conductance"),
    )  # fmt: skip
    act = forcing(
        absorbed=rng.uniform(0.0, 1000.0, many) * rng.choice([0.0, 1.0], many),
        longwave=rng.uniform(100.0, 450.0, many),
        air_k=air, vapour_pa=rng.uniform(0.02, 1.0, many) * turbulence.saturation_vapour(np, air)[0],
        wind_m_s=rng.uniform(0.0, 30.0, many) * rng.choice([0.0, 1.0, 1.0], many), pressure_pa=1e5, below_k=air,
    )  # fmt: skip
    begin = air + rng.uniform(-30.0, 50.0, many)
    state = balance.State(begin, [begin] * LAYERS, rng.uniform(0.0, 1.0, many), None)
    for seconds in (1.0, 60.0, 900.0, 10800.0):
        monkeypatch.setattr(balance, "_NEWTON", 60)
        exact, _ = balance.step(np, state, column, act, act, seconds)
        monkeypatch.undo()
        found, _ = balance.step(np, state, column, act, act, seconds)
        error = np.abs(found.surface_k - exact.surface_k)
        assert np.quantile(error, 0.99) < 1e-3 and error.max() < 2.0
