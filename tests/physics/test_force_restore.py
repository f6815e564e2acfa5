"""Force–restore, kept for comparison: balance of fluxes, inertia, memory of its start, vapour tables."""

import numpy as np
import pytest

from thermorender.physics.heat import saturation_vapour, step
from thermorender.physics.planck import STEFAN_BOLTZMANN


def test_start_is_forgotten_after_a_day():
    one, ends = np.ones((1, 3), np.float32), []
    for start in (265.0, 305.0):
        temperature = np.float32(start) * one
        for _ in range(20):
            # Only its own emission, no wind, three inertias.
            temperature = step(
                temperature, 4320.0, 0 * one, 330 * one, 0 * one, 0 * one, 285.0, 1000.0,
                np.float32([[300.0, 2000.0, 14000.0]]), 285 * one,
            )  # fmt: skip
        ends.append(temperature)
    # Force and restore: e^(−2π) of 40 K is 0.08 K; with twenty implicit steps (1 + 2π/20)⁻²⁰, 0.17 K.
    assert 0.01 < np.abs(ends[1] - ends[0]).max() < 0.18


def test_balance_closes_at_equilibrium():
    one = np.ones((3, 4), np.float32)
    air, sky = 290.0, 260.0
    absorbed, longwave, exchange = 400.0 * one, STEFAN_BOLTZMANN * sky**4 * one, 14.0 * one
    # Almost no inertia: the step ends at the balance of fluxes.
    surface = step(290.0 * one, 3600.0, absorbed, longwave, exchange, 0.2 * one, air, 1000.0, 1e-3 * one, 285.0 * one)
    t = float(surface[0, 0])
    latent = 0.2 * 14.0 / 66.0 * (float(saturation_vapour(np.float64(t))[0]) - 1000.0)
    flux = 400.0 + 0.96 * STEFAN_BOLTZMANN * (sky**4 - t**4) - 14.0 * (t - air) - latent
    assert abs(flux) < 0.05
    # Great inertia: the temperature stays.
    slow = step(288.0 * one, 3600.0, absorbed, longwave, exchange, 0 * one, air, 1000.0, 1e7 * one, 288.0 * one)
    assert slow[0, 0] == pytest.approx(288.0, abs=0.01)


def test_wet_is_cooler_than_dry_and_high_inertia_lags():
    one = np.ones((1, 1), np.float32)
    run = lambda wet, inertia: float(  # noqa: E731
        step(
            288 * one,
            7200.0,
            500 * one,
            260 * one,
            14 * one,
            wet * one,
            292.0,
            1000.0,
            inertia * one,
            288 * one,
        )[0, 0]
    )
    assert run(0.5, 400.0) < run(0.0, 400.0) - 3.0
    assert run(0.0, 2200.0) < run(0.0, 400.0) - 3.0


def test_saturation_vapour_matches_the_tables():
    # Allen et al., FAO 56, table 2.3: 1.228, 2.338, 4.243 kPa.
    pressure, slope = saturation_vapour(np.array([283.15, 293.15, 303.15]))
    assert pressure == pytest.approx([1228.0, 2338.0, 4243.0], abs=1.0)
    later, _ = saturation_vapour(293.15 + 0.5)
    earlier, _ = saturation_vapour(293.15 - 0.5)
    assert slope[1] == pytest.approx(later - earlier, rel=1e-3)
