"""The sun's position, its light through clear and cloudy air, the sky's long-wave, and moist air, against others."""

import numpy as np
import pytest

from thermorender.physics import humidity, sky, sun
from thermorender.physics.planck import STEFAN_BOLTZMANN

# time, latitude, longitude, azimuth, elevation without refraction: pvlib 0.16.1, `spa_python` (NREL's SPA).
SPA = [
    ("1950-01-01T00:00:00", 51.5, 0.0, 358.4352, -61.5650),
    ("1969-07-20T20:17:40", 28.6, -80.6, 267.9040, 50.9616),
    ("1987-03-20T06:00:00", 0.0, 90.0, 100.5783, 88.0371),
    ("2000-01-01T12:00:00", -33.9, 151.2, 210.5408, -26.4768),
    # Reda and Andreas (2008), NREL/TP-560-34302, table A5.1: e0 = 39.872046, azimuth 194.340241.
    ("2003-10-17T19:30:30", 39.742476, -105.1786, 194.340241, 39.872046),
    ("2018-07-28T14:30:00", 47.1, 11.3, 250.1396, 42.4575),
    ("2016-02-29T23:59:59", 65.0, -179.9, 176.8963, 17.4607),
    ("2016-02-29T23:59:59", 65.0, 180.1, 176.8963, 17.4607),
    ("2024-06-21T00:00:00", 90.0, 0.0, 359.5465, 23.4360),
    ("2024-12-21T12:00:00", -90.0, 45.0, 314.5729, 23.4361),
    ("2024-12-21T11:00:00", 78.2, 15.6, 180.9670, -11.6426),
    ("2024-06-21T23:00:00", 78.2, 15.6, 0.0888, 11.6318),
    ("2050-12-31T23:00:00", -22.9, -43.2, 235.3798, -16.5299),
]


@pytest.mark.parametrize(("time", "latitude", "longitude", "azimuth", "elevation"), SPA)
def test_position_against_the_full_theory(time, latitude, longitude, azimuth, elevation):
    found = sun.position_at(np.datetime64(time), latitude, longitude)
    aside = ((found[0] - azimuth + 180.0) % 360.0 - 180.0) * np.cos(np.radians(elevation))
    # The stated worst case of the short series, and half of the table's last digit.
    assert np.hypot(aside, found[1] - elevation) < 0.011 + 5e-5


def test_the_position_keeps_the_input_shape():
    time = np.datetime64("2018-07-28T00:00") + np.timedelta64(7, "m") * np.arange(200).reshape(4, 50)
    azimuth, elevation = sun.position_at(time, 47.0, 11.0)
    assert azimuth.shape == elevation.shape == (4, 50)
    assert sun.position_at(time[2, 17], 47.0, 11.0) == (azimuth[2, 17], elevation[2, 17])


def test_sunrise():
    # Level ground sees the sun's centre rise at 6 h under the equator, and by cos h = −tan φ tan δ elsewhere.
    assert sun.sunrise(0.0, 10.0) == pytest.approx(6.0)
    assert sun.sunrise(52.0, 8.0) == pytest.approx(12.0 - np.degrees(np.arccos(-0.179885)) / 15.0, abs=1e-4)
    assert sun.sunrise(75.0, 23.4) is None and sun.sunrise(75.0, -23.4) is None and sun.sunrise(-90.0, 5.0) is None
    day = np.datetime64("2018-09-02T00:00") + np.timedelta64(1, "m") * np.arange(1440)
    hour, elevation = sun.solar_hour(day, 21.0), sun.position_at(day, 52.0, 21.0)[1]
    rise = sun.sunrise(52.0, float(sun.declination(day[300])))
    # A minute, and the parallax of 0.0024°.
    assert hour[np.flatnonzero(np.diff(elevation > 0.0))[0]] == pytest.approx(rise, abs=2.0 / 60.0)


def test_polar_day_and_night():
    hours = np.timedelta64(1, "h") * np.arange(24)
    assert (sun.position_at(np.datetime64("2024-06-21") + hours, 75.0, 20.0)[1] > 0.0).all()
    assert (sun.position_at(np.datetime64("2024-12-21") + hours, 75.0, 20.0)[1] < 0.0).all()
    level = sun.position_at(np.datetime64("2024-06-21") + hours, 90.0, 0.0)[1]
    assert np.ptp(level) < 0.01  # declination alone moves it


@pytest.mark.parametrize(
    ("time", "factor"), [("2018-01-03", 1.03428821), ("2018-04-04", 1.00003751), ("2018-07-06", 0.96742742)]
)
def test_distance_of_the_sun(time, factor):
    """pvlib 0.16.1, `get_extra_radiation(method="nrel")`; 0.02 % is the moon's pull and the short series."""
    assert sun.eccentricity(np.datetime64(time)) == pytest.approx(factor, abs=2e-4)


# Elevation, pressure, water, aerosol, albedo, direct, diffuse: pvlib 0.16.1, `clearsky.bird` of the air mass of Kasten
# and Young (1989), 1361 W m⁻², optical depth at 0.38 µm by Ångström's exponent 1.3.
BIRD = [
    (10, 101325, 1.42, 0.1, 0.2, 464.88, 52.02),
    (30, 101325, 1.42, 0.1, 0.2, 791.28, 95.13),
    (60, 77350, 0.27, 0.03, 0.2, 1051.72, 71.74),
    (90, 90000, 3.0, 0.3, 0.6, 815.18, 245.33),
    (15, 60000, 0.1, 0.0, 0.8, 963.15, 33.22),
]


@pytest.mark.parametrize(("elevation", "pressure", "water", "aerosol", "albedo", "direct", "diffuse"), BIRD)
def test_clear_sky_against_another_code(elevation, pressure, water, aerosol, albedo, direct, diffuse):
    found = sky.clear_sky(elevation, pressure, water, aerosol, albedo=albedo)
    # The two codes have the coefficients of ozone and water with different numbers of digits: 1e-4.
    np.testing.assert_allclose(found, (direct, diffuse), rtol=1.5e-4, atol=0.006)


def test_stated_effects_of_aerosol_and_refraction_are_those_of_the_model():
    """± 0.05 of optical depth is 4 to 5 % of the direct light, and the true elevation gives 3 % more air at 5°."""
    for elevation in (60.0, 75.0, 90.0):
        low, usual, high = (
            sky.clear_sky(np.array([elevation]), 101325.0, 1.5, depth)[0][0] for depth in (0.05, 0.1, 0.15)
        )
        assert 0.035 < 1.0 - high / usual < low / usual - 1.0 < 0.05
    # Refraction 1.02′ / tan(5° + 10.3° / (5 + 5.11)), Sæmundsson, Sky and Telescope 72 (1986) 70.
    refracted = 5.0 + 1.02 / np.tan(np.radians(5.0 + 10.3 / 10.11)) / 60.0
    assert sky.air_mass(5.0) / sky.air_mass(refracted) == pytest.approx(1.03, abs=0.005)


def test_light_fades_to_the_horizon():
    elevation = np.linspace(0.01, 89.0, 3000)
    direct, diffuse = sky.clear_sky(elevation, 101325.0, 1.4, 0.1)
    assert (np.diff(direct) > 0.0).all() and (np.diff(direct * np.sin(np.radians(elevation)) + diffuse) > 0.0).all()
    assert (np.diff(sky.clearest_direct(elevation, 101325.0, 1.4)) > 0.0).all()
    assert sky.clear_sky(np.array([0.0, -5.0]), 101325.0, 1.4, 0.1)[0].max() == 0.0
    assert (sky.clearest_direct(elevation, 101325.0, 1.4) >= direct).all()


# Global, elevation, direct, diffuse: pvlib 0.16.1, `irradiance.erbs` with 1365.6 W m⁻² above the air.
ERBS = [
    (50.0, 30.0, 0.65905, 49.67048),
    (300.0, 30.0, 134.26324, 232.86838),
    (500.0, 45.0, 267.66065, 310.73534),
    (900.0, 60.0, 857.44184, 157.43359),
    (1150.0, 60.0, 1108.8012, 189.75),
    (20.0, 2.0, 109.15509, 16.19054),
]


@pytest.mark.parametrize(("total", "elevation", "direct", "diffuse"), ERBS)
def test_split_against_another_code(total, elevation, direct, diffuse):
    distance = 1365.6032047 / sky.SOLAR_CONSTANT_W_M2
    np.testing.assert_allclose(sky.split_global(total, elevation, distance, 2000.0), (direct, diffuse), rtol=1e-5)


def test_split_conserves_energy_and_makes_no_spike_at_the_horizon():
    total, elevation = np.meshgrid(np.linspace(0.0, 1300.0, 53), np.linspace(-3.0, 90.0, 94))
    limit = sky.clearest_direct(elevation, 101325.0, 1.0)
    direct, diffuse = sky.split_global(total, elevation, 1.0, limit)
    height = np.sin(np.radians(np.maximum(elevation, 0.0)))
    np.testing.assert_allclose(direct * height + diffuse, total, atol=1e-9)
    assert (direct <= limit).all() and (direct >= 0.0).all() and (diffuse >= 0.0).all()
    assert direct[elevation == 1.0].max() < 500.0 < (1300.0 * 0.8 / height[elevation == 1.0]).max()


def test_clouds_dim_as_measured():
    """Kasten and Czeplak (1980): a quarter of the light remains under overcast, 1 − 0.75/2^3.4 under half a sky."""
    direct, diffuse = sky.clear_sky(50.0, 101325.0, 1.5, 0.1)
    clear = direct * np.sin(np.radians(50.0)) + diffuse
    for cloud, share in ((0.0, 1.0), (0.5, 0.929), (1.0, 0.25)):
        beam, rest = sky.clouded(direct, diffuse, 50.0, cloud)
        assert beam * np.sin(np.radians(50.0)) + rest == pytest.approx(share * clear, rel=1e-3)
        assert beam == pytest.approx((1.0 - cloud) * direct) and rest > 0.0


@pytest.mark.parametrize(("air", "vapour"), [(273.15, 400.0), (288.15, 1000.0), (298.15, 1800.0)])
def test_longwave_among_other_published_laws(air, vapour):
    """Brutsaert, Water Resour. Res. 11 (1975) 742, and Dilley and O'Brien, Q. J. R. Meteorol. Soc. 124 (1998) 1391.

    The laws differ from each other by 10 to 20 W m⁻² for such air.
    """
    black = STEFAN_BOLTZMANN * air**4
    brutsaert = 1.24 * (0.01 * vapour / air) ** (1.0 / 7.0) * black
    column = 46.5 * 0.01 * vapour / air * 10.0  # kg/m²
    dilley = 59.38 + 113.7 * (air / 273.16) ** 6 + 96.96 * np.sqrt(column / 25.0)
    clear = sky.longwave(air, vapour, 0.0)
    assert abs(clear - 0.5 * (brutsaert + dilley)) < 15.0
    # Overcast: 16 % of the clear sky's deficit remains.
    assert black - sky.longwave(air, vapour, 1.0) == pytest.approx(0.16 * (black - clear))


@pytest.mark.parametrize(
    # IAPWS R7-97 over water; Murphy and Koop (2005), Q. J. R. Meteorol. Soc. 131, 1539, over ice.
    ("celsius", "over", "pascal"),
    [(0.01, "water", 611.66), (20.0, "water", 2339.2), (40.0, "water", 7384.9), (0.0, "ice", 611.15),
     (-20.0, "ice", 103.26), (-40.0, "ice", 12.84)],
)  # fmt: skip
def test_saturation(celsius, over, pascal):
    found = humidity.saturation_pressure(celsius + 273.15, over)
    assert found == pytest.approx(pascal, rel=4e-3)


@pytest.mark.parametrize(
    ("altitude", "pascal"), [(-500.0, 107478.0), (0.0, 101325.0), (1000.0, 89876.0), (5000.0, 54048.0)]
)
def test_pressure_of_the_standard_atmosphere(altitude, pascal):
    """US Standard Atmosphere 1976, table I, by geometric altitude; ours uses it as geopotential: 5 m at 5 km."""
    assert humidity.standard_pressure(altitude) == pytest.approx(pascal, rel=6e-4)


@pytest.mark.parametrize(
    # RRTMGP's `solar_source_quiet` (NRLSSI2) for a total of 1361 W m⁻², by band; 1.5 and 0.04 % off.
    ("low", "high", "w_m2", "tolerance"), [(3.07692, 3.73134, 10.781, 0.016), (3.73134, 12.19512, 14.440, 0.005)],
)  # fmt: skip
def test_sunlight_of_bands_is_that_of_rrtmgp(low, high, w_m2, tolerance):
    wavelength = np.linspace(low, high, 20001)
    assert np.trapezoid(sun.irradiance(wavelength), wavelength) == pytest.approx(w_m2, rel=tolerance)


def test_sunlight_between_3_and_4_micrometres_is_that_of_astm_g173():
    """Extraterrestrial spectrum of ASTM G173-03 (SMARTS), mean over 0.1 µm from each wavelength [W m⁻² µm⁻¹]."""
    theirs = {3.0: 23.90, 3.1: 21.03, 3.2: 18.98, 3.3: 16.70, 3.4: 14.95, 3.5: 13.53, 3.6: 12.28, 3.7: 11.08,
              3.8: 10.06, 3.9: 9.14}  # fmt: skip
    for start, mean in theirs.items():
        wavelength = np.linspace(start, start + 0.1, 201)
        assert np.trapezoid(sun.irradiance(wavelength), wavelength) / 0.1 == pytest.approx(mean, rel=0.018), start
