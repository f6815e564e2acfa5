"""The heat balance in Dr.Jit's single precision against NumPy's double precision and against closed forms."""

import numpy as np
import pytest
from heat_support import COLUMNS, forcing, ground, sunny
from scipy.optimize import brentq
from support import slow

from tests.robustness.stepped import DOUBLE, SINGLE, run
from thermorender.physics import balance, turbulence
from thermorender.physics.conduction import Slab, layered

# Allowed differences [K] of any column under any step: from closed forms, which the layers approximate, and from double
# precision. An ulp at 300 K is 0.03 mK.
ALLOWED_K, SINGLE_K = 5e-3, 1e-3
FILM = 12.0
# Sheets, slabs and soils from 10 µm to 10 m: slab and film below [W m⁻² K⁻¹].
SHEETS = {
    "aluminium, 10 µm": (Slab(1e-5, 237.0, 2.44e6), FILM),
    "aluminium, 0.1 mm": (Slab(1e-4, 237.0, 2.44e6), FILM),
    "aluminium, 1 mm": (Slab(1e-3, 237.0, 2.44e6), FILM),
    "copper, 1 mm": (Slab(1e-3, 401.0, 3.44e6), FILM),
    "steel, 1 mm": (Slab(1e-3, 60.0, 3.41e6), FILM),
    "steel, 0.7 mm": (Slab(7e-4, 60.0, 3.41e6), FILM),
    "felt, 10 µm": (Slab(1e-5, 0.02, 3e4), FILM),
}
SLABS = {
    "concrete, 0.2 m": (Slab(0.2, 1.8, 2.07e6), FILM),
    "foam, 0.1 m": (Slab(0.1, 0.02, 3e4), FILM),
    "copper, 1 m": (Slab(1.0, 401.0, 3.44e6), FILM),
    "soil, 10 m": (Slab(10.0, 1.0, 2e6), None),
}
HALF_SPACES = {
    "soil": (Slab(np.inf, 1.0, 2e6), None),
    "peat": (Slab(np.inf, 0.05, 5e5), None),
    "copper": (Slab(np.inf, 401.0, 3.44e6), None),
}
EVERY = SHEETS | SLABS | HALF_SPACES


def columns(chosen, water=0.0, **changed):
    """Ground of one column for each of some slabs, (C,) arrays."""
    slabs = [Slab(s.thickness_m, s.conductivity, s.capacity, water) for s, _ in chosen.values()]
    cuts = [layered([slab], film=film) for slab, (_, film) in zip(slabs, chosen.values(), strict=True)]
    of = lambda name: list(np.array([getattr(cut, name) for cut in cuts]).T)  # noqa: E731
    freezing = {"water": of("water"), "room": of("water")} if water else {}
    one = ground(cuts[0])._replace(capacity=of("capacity"), conductance=of("conductance"), **freezing)
    return one._replace(**changed)


@pytest.mark.parametrize(("seconds", "count"), [(1.0, 1500), (300.0, 300), (10800.0, 60)])
def test_a_sheet_in_sunlight_reaches_its_steady_temperature(seconds, count):
    """Sun and sky against emission and exchange with the air above and below; it begins 1 K colder than their root."""
    thin = columns(SHEETS, emissivity=0.3)
    act = forcing(absorbed=300.0, longwave=330.0)
    exact = []
    for slab, film in SHEETS.values():
        through = 1.0 / (slab.thickness_m / slab.conductivity + 1.0 / film)

        def surplus(kelvin, through=through):
            radiation = 300.0 + 0.3 * (330.0 - balance.STEFAN_BOLTZMANN * kelvin**4)
            return radiation - (turbulence.CALM_W_M2_K + through) * (kelvin - 290.0)

        exact.append(brentq(surplus, 250.0, 400.0, xtol=1e-9))
    begin = np.tile(np.array(exact) - 1.0, (len(thin.capacity), 1))
    found, _ = run(SINGLE, thin, lambda t: act, begin, seconds, count)
    assert dict(zip(SHEETS, found[-1], strict=True)) == pytest.approx(
        dict(zip(SHEETS, exact, strict=True)), abs=ALLOWED_K
    )


def admittance(slab, film, s):
    """Heat flux over temperature at the face of a slab at a complex rate s (Carslaw & Jaeger 1959, 3.7)."""
    own = np.sqrt(s * slab.conductivity * slab.capacity)
    if np.isinf(slab.thickness_m):
        return own
    through = np.tanh(np.sqrt(s * slab.capacity / slab.conductivity) * slab.thickness_m)
    return own * ((film or 0.0) + own * through) / (own + (film or 0.0) * through)


def test_a_sinusoidal_flux_gives_the_wave_of_the_closed_form():
    """Exchange of 2 W m⁻² K⁻¹ above and a daily flux of 5 W/m²; the layers begin in the periodic state.

    The layers of a half-space err by 5e-4 of 2.5 K, those of a slab by up to 2 ‰.
    """
    s, swing = 2j * np.pi / 86400.0, 5.0
    dry = columns(EVERY)
    exact, begin = [], []
    for number, (slab, film) in enumerate(EVERY.values()):
        capacity, conductance = (np.array(each)[:, number] for each in (dry.capacity, dry.conductance))
        wave = swing / (turbulence.CALM_W_M2_K + admittance(slab, film, s))
        exact.append(wave)
        # The same wave at the nodes, from a linear system.
        matrix = np.diag(s * capacity + conductance[:-1] + conductance[1:]).astype(complex)
        matrix -= np.diag(conductance[1:-1], 1) + np.diag(conductance[1:-1], -1)
        above = conductance[0] / (turbulence.CALM_W_M2_K + conductance[0])
        matrix[0, 0] -= above * conductance[0]
        begin.append(np.linalg.solve(matrix, np.eye(len(capacity))[0] * above * swing).real)
    found, _ = run(
        SINGLE, dry, lambda t: forcing(absorbed=swing * np.cos(s.imag * t)), 290.0 + np.array(begin).T, 300.0, 288
    )
    time = 300.0 * (1.0 + np.arange(288))
    expected = 290.0 + (np.array(exact)[None] * np.exp(s * time)[:, None]).real
    error = np.abs(found - expected).max(axis=0)
    assert dict(zip(EVERY, error, strict=True)) == pytest.approx(dict.fromkeys(EVERY, 0.0), abs=ALLOWED_K)


WEATHER = {"dry": {}, "moist and freezing": {"air_k": 272.0, "longwave": 230.0, "vapour_pa": 400.0, "below_k": 272.0}}


@pytest.mark.parametrize(
    ("name", "seconds", "count"),
    [
        ("dry", 300.0, 288), ("dry", 10800.0, 16),
        ("moist and freezing", 1.0, 400), ("moist and freezing", 10800.0, 16),
        *slow(("dry", 1.0, 400), ("dry", 1800.0, 96), ("moist and freezing", 300.0, 288)),
        *slow(("moist and freezing", 1800.0, 96)),
    ],
)  # fmt: skip
def test_single_precision_agrees_with_double(name, seconds, count):
    """Surfaces, layers and ice of sheets, slabs and soils; the shortest steps begin with the sun at 10 o'clock."""
    freezes = name != "dry"
    changed = {"emissivity": 0.9, "resistance": 100.0, "held": 0.2} if freezes else {"emissivity": 0.3}
    own = columns(EVERY, water=0.3 * freezes, **changed)
    begin = np.full((len(own.capacity), len(EVERY)), WEATHER[name].get("air_k", 290.0))
    act = lambda t: sunny(t, **WEATHER[name])  # noqa: E731
    start_s = 36000.0 if seconds < 60.0 else 0.0
    (single, last), (double, exact) = (
        run(precision, own, act, begin, seconds, count, start_s) for precision in (SINGLE, DOUBLE)
    )
    error = np.abs(single - double).max(axis=0)
    assert dict(zip(EVERY, error, strict=True)) == pytest.approx(dict.fromkeys(EVERY, 0.0), abs=SINGLE_K)
    assert np.abs(np.array(last.layers_k) - exact.layers_k).max() < SINGLE_K
    if freezes:
        # As kelvin of the layers; a share of 1e-4 of the water is 5 mK.
        ice = balance.FUSION * np.abs(np.array(last.liquid) - exact.liquid) / np.array(own.capacity)
        assert ice.max() < ALLOWED_K


# One with leaves in rain, one whose water freezes and melts, one with sun in its depth.
QUICK = ("leaves with gaps in rain", "snow that melts and runs off", "pond lit inside")


@pytest.mark.parametrize("name", [name if name in QUICK else slow(name)[0] for name in COLUMNS])
def test_two_days_in_single_precision(name):
    """Soil, grass in rain, frost, melting snow and a pond, in steps of 15 min, from calm air to a storm."""
    column, weather = COLUMNS[name]
    wind = np.array([0.0, 0.5, 3.0, 12.0])
    begin = np.full((len(column.capacity), len(wind)), weather.get("air_k", 290.0))
    act = lambda t: sunny(t, **(weather | {"wind_m_s": wind}))  # noqa: E731
    single, double = (run(each, column, act, begin, 900.0, 192)[0] for each in (SINGLE, DOUBLE))
    assert np.abs(single - double).max() < SINGLE_K
