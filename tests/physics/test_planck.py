"""Planck's law against 30-digit references, closed forms and its own inverse."""

import csv

import mpmath
import numpy as np
import pytest
from support import shared_data

from thermorender.errors import ThermorenderError
from thermorender.physics import planck

BAND = (7.5, 13.5)


def exact_band_radiance(temperature, lower_um, upper_um):
    """30-digit band radiance through the polylogarithm series of x³/(eˣ−1)."""
    with mpmath.workdps(40):
        h, c, k = mpmath.mpf("6.62607015e-34"), mpmath.mpf(299792458), mpmath.mpf("1.380649e-23")
        c1 = 2 * h * c**2 * mpmath.mpf(10) ** 24
        c2 = h * c / k * mpmath.mpf(10) ** 6
        temperature = mpmath.mpf(temperature)

        def tail(x):
            return mpmath.nsum(
                lambda n: mpmath.exp(-n * x) * (x**3 / n + 3 * x**2 / n**2 + 6 * x / n**3 + 6 / n**4), [1, mpmath.inf]
            )

        integral = tail(c2 / (upper_um * temperature)) - tail(c2 / (lower_um * temperature))
        return c1 * (temperature / c2) ** 4 * integral


def test_reference_table():
    with open(shared_data("planck_reference.csv"), newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) > 50
    held = 0
    for row in rows:
        band = float(row["lambda1_um"]), float(row["lambda2_um"])
        temperature = float(row["T_K"])
        for column, function in (
            ("L_W_m2_sr", planck.band_radiance),
            ("dLdT_W_m2_sr_K", planck.band_radiance_derivative),
        ):
            exact = mpmath.mpf(row[column])
            value = function(temperature, *band)
            if exact < np.finfo(float).tiny:
                assert value < np.finfo(float).tiny
                continue
            held += 1
            assert abs(value / exact - 1) < 1e-12, (row["T_K"], band, column)
    assert held > 100


@pytest.mark.parametrize("temperature", [2, 3, 4, 5, 6, 7, 8, 9])
@pytest.mark.parametrize("band", [(7.5, 13.5), (8.0, 12.0), (3.0, 5.0)])
def test_cold_end(temperature, band):
    exact = exact_band_radiance(temperature, *band)
    value = planck.band_radiance(float(temperature), *band)
    if exact < np.finfo(float).tiny:
        assert value < np.finfo(float).tiny
    else:
        assert abs(value / exact - 1) < 1e-12


def test_whole_spectrum_is_stefan_boltzmann():
    sigma = 5.670374419e-8
    for temperature in (50.0, 300.0, 5772.0):
        total = planck.band_radiance(temperature, 1e-3, 10.0) + planck.band_radiance(temperature, 10.0, 1e7)
        assert np.pi * total == pytest.approx(sigma * temperature**4, rel=1e-9)


def test_spectral_integrates_to_band():
    wavelength, weight = np.polynomial.legendre.leggauss(200)
    wavelength, weight = 10.5 + 3.0 * wavelength, 3.0 * weight
    temperature = np.array([150.0, 300.0, 1000.0])
    integral = planck.spectral_radiance(wavelength, temperature[:, None]) @ weight
    np.testing.assert_allclose(integral, planck.band_radiance(temperature, *BAND), rtol=1e-12)


@pytest.mark.parametrize("temperature", [20.0, 300.0, 5000.0])
def test_derivative_is_that_of_the_band_radiance(temperature):
    with mpmath.workdps(40):
        exact = mpmath.diff(lambda kelvin: exact_band_radiance(kelvin, *BAND), mpmath.mpf(temperature), h="1e-9")
    assert abs(planck.band_radiance_derivative(temperature, *BAND) / exact - 1) < 1e-12


def test_published_derivative_at_300_k():
    assert planck.band_radiance_derivative(300.0, *BAND) == pytest.approx(0.8825, abs=5e-5)


def test_inverse_returns_temperature():
    temperature = np.geomspace(100.0, 3000.0, 5000)
    for band in (BAND, (8.0, 12.0), (3.0, 5.0)):
        back = planck.brightness_temperature(planck.band_radiance(temperature, *band), *band)
        assert np.abs(back - temperature).max() < 1e-9


@pytest.mark.parametrize("temperature", [3.0, 20.0, 1e5])
def test_inverse_at_the_extremes(temperature):
    assert planck.brightness_temperature(planck.band_radiance(temperature, *BAND), *BAND) == pytest.approx(
        temperature, rel=1e-11
    )


@pytest.mark.parametrize("band", [BAND, (3.0, 5.0), (8.0, 8.001), (14.0, 1000.0)])
@pytest.mark.parametrize(
    "radiance", [5e-324, 1e-320, 2.3e-308, 1e-300, 0.9e-290, 1.1e-290, 1e-200, 1e-9, 1e6, 1e9, 1e14, 1e60, 1e100, 1e300]
)
def test_inverse_of_any_radiance_that_a_float_can_hold(radiance, band):
    temperature = planck.brightness_temperature(radiance, *band)
    with mpmath.workdps(40):
        kelvin, lower, upper = (mpmath.mpf(value) for value in (temperature, *band))
        c2 = mpmath.mpf("6.62607015e-34") * 299792458 / mpmath.mpf("1.380649e-23") * 10**6
        coldest = c2 / (upper * kelvin)
        if coldest > 1:
            exact = exact_band_radiance(kelvin, *band)
        else:
            c1 = 2 * mpmath.mpf("6.62607015e-34") * mpmath.mpf(299792458) ** 2 * mpmath.mpf(10) ** 24
            exact = mpmath.quad(lambda um: c1 / um**5 / mpmath.expm1(c2 / (um * kelvin)), [lower, upper])
        # The error of ln L is x = c₂/(λT) times the relative error of T; the logarithm itself is exact to one ulp.
        assert abs(mpmath.log(exact / mpmath.mpf(radiance))) < 2e-12 * max(1, coldest), (temperature, exact)


def test_inverse_outside_the_range_of_a_blackbody():
    """0 K for 0; NaN below 0 and for NaN; infinity where the temperature itself overflows."""
    values = planck.brightness_temperature(np.array([0.0, -0.0, -1e-320, -1e300, np.nan, np.inf, -np.inf]), *BAND)
    assert list(values[:2]) == [0.0, 0.0] and np.isnan(values[2:]).all()
    assert planck.brightness_temperature(1.7e308, 100.0, 1000.0) == np.inf


@pytest.mark.parametrize("band", [BAND, (3.0, 5.0), (10.5, 10.6)])
def test_slope_of_the_inverse_equals_its_finite_difference(band):
    """For few values, and for many, which are read from a table: ten decades, kelvin to one part in a million."""
    top = planck.band_radiance(2000.0, *band)
    radiance = np.geomspace(1e-10 * top, top, 5001)
    below, above = (planck.brightness_temperature(radiance * factor, *band) for factor in (1.0 - 1e-5, 1.0 + 1e-5))
    expected = (above - below) / (2e-5 * radiance)
    assert planck.kelvin_per_radiance(radiance, *band) == pytest.approx(expected, rel=1e-6)
    assert planck.kelvin_per_radiance(radiance[::50], *band) == pytest.approx(expected[::50], rel=1e-6)
    holed = np.where(np.arange(5001) == 7, np.nan, radiance)
    found = planck.kelvin_per_radiance(holed.reshape(3, -1), *band)
    assert found.shape == (3, 1667) and np.isnan(found[0, 7]) and np.isfinite(found).sum() == 5000


@pytest.mark.parametrize("temperature", [3.0, 30.0, 300.0, 2e4])
@pytest.mark.parametrize("width_um", [1e-3, 1e-6])
def test_bands_of_a_nanometre_and_of_a_picometre(temperature, width_um):
    band = (10.0, 10.0 + width_um)
    with mpmath.workdps(60):
        assert abs(planck.band_radiance(temperature, *band) / exact_band_radiance(temperature, *band) - 1) < 1e-12


@pytest.mark.parametrize("band", [BAND, (8.0, 8.001), (1e-3, 1e7)])
def test_any_temperature_gives_a_value_without_a_warning(band):
    """Linear in temperature in the Rayleigh-Jeans limit, across the transition, up to the end of float64."""
    border = 1e6 * planck.C2 / band[0]
    kelvin = border * np.array([1.0 - 1e-9, 1.0 + 1e-9, 1e3, 1e60])
    value, slope = (f(kelvin, *band) for f in (planck.band_radiance, planck.band_radiance_derivative))
    assert value[1] / value[0] - 1.0 == pytest.approx(2e-9, rel=1e-3)
    assert value[2:] / kelvin[2:] == pytest.approx(slope[0], rel=1e-6) and slope == pytest.approx(slope[0], rel=1e-12)
    assert np.abs(planck.brightness_temperature(value, *band) / kelvin - 1.0).max() < 1e-12
    odd = np.array([0.0, 1e-300, 5e-324, 1e308, np.inf, np.nan])
    for found in (planck.band_radiance(odd, *band), [planck.band_radiance(each, *band) for each in odd]):
        assert list(found[:3]) == [0.0, 0.0, 0.0] and found[3] > 1e300 and found[4] == np.inf and np.isnan(found[5])


@pytest.mark.parametrize("kind", [float, np.float32, np.float64])
@pytest.mark.parametrize("radiance", [1e-320, 1e-45, 1e-30, 1e38, 1e300])
def test_faint_and_bright_radiances_of_any_type(kind, radiance):
    if kind is np.float32:
        radiance = np.clip(radiance, 1e-45, 3e38)
    alone = planck.brightness_temperature(kind(radiance), *BAND)
    assert 0.0 < alone < np.inf
    among = planck.brightness_temperature(np.full((2, 3), radiance, kind), *BAND)
    assert among.shape == (2, 3) and np.abs(among / alone - 1.0).max() < 1e-14
    # T rises with L, but more slowly than L itself.
    assert 0.0 < planck.kelvin_per_radiance(kind(radiance), *BAND) <= np.inf


def test_slope_outside_the_range_of_a_blackbody():
    for count in (1, 2000):
        found = planck.kelvin_per_radiance(np.tile([0.0, -1.0, np.nan, np.inf, 1.0, 2.0, 3.0], count), *BAND)
        assert found[0] == np.inf and np.isnan(found[1:4]).all() and np.isfinite(found[4:7]).all()


def test_shapes_and_odd_values():
    assert isinstance(planck.band_radiance(300.0, *BAND), float)
    assert planck.band_radiance(np.full((2, 3), 300.0), *BAND).shape == (2, 3)
    assert planck.band_radiance(0.0, *BAND) == 0.0
    assert planck.spectral_radiance(10.0, 0.0) == 0.0
    values = planck.band_radiance(np.array([np.nan, 300.0]), *BAND)
    assert np.isnan(values[0]) and values[1] > 0
    back = planck.brightness_temperature(np.array([0.0, -1.0, np.nan]), *BAND)
    assert back[0] == 0.0 and np.isnan(back[1:]).all()


def test_errors_name_the_argument():
    with pytest.raises(ThermorenderError, match=r"temperature=-5 is below 0 K.*add 273.15"):
        planck.band_radiance(-5.0, *BAND)
    with pytest.raises(ThermorenderError, match=r"band 13.5–7.5 µm.*lower < upper"):
        planck.band_radiance(300.0, 13.5, 7.5)
    with pytest.raises(ThermorenderError, match="wavelength_um=0"):
        planck.spectral_radiance(0.0, 300.0)
