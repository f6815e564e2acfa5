"""Band radiance of real materials, its tables, and the kinetic temperature from an apparent one."""

import numpy as np
import pytest
from scipy.integrate import quad

from thermorender.frame import apparent_temperature
from thermorender.materials.library import load_library
from thermorender.materials.material import grey
from thermorender.physics.band import (
    RadianceTable,
    emitted_radiance,
    kinetic_temperature,
    quadrature,
    reflected_radiance,
)
from thermorender.physics.planck import (
    band_radiance,
    band_radiance_derivative,
    brightness_temperature,
    spectral_radiance,
)

BAND = (7.5, 13.5)
MILLIKELVIN = band_radiance_derivative(300.0, *BAND) * 1e-3


def test_quadrature_integrates_planck():
    wavelength, weight = quadrature(*BAND)
    assert len(wavelength) >= 600
    for temperature in (150.0, 300.0, 1200.0):
        integral = spectral_radiance(wavelength, temperature) @ weight
        assert integral == pytest.approx(band_radiance(temperature, *BAND), rel=1e-12)


@pytest.mark.parametrize("name", ["sand_quartz", "glass", "water"])
def test_measured_material_against_adaptive_integration(name):
    material = load_library()[name]
    knots = material.wavelength_um[(material.wavelength_um > BAND[0]) & (material.wavelength_um < BAND[1])]
    edges = np.concatenate([[BAND[0]], knots, [BAND[1]]])
    exact = sum(
        quad(lambda x: float(material.emissivity_at(x)) * float(spectral_radiance(x, 300.0)), a, b)[0]
        for a, b in zip(edges[:-1], edges[1:], strict=True)
    )
    assert abs(emitted_radiance(material.emissivity_at, 300.0, *BAND) - exact) < 0.1 * MILLIKELVIN


def test_table_and_inverse():
    material = load_library()["granite"]
    table = RadianceTable.of(material.emissivity_at, 250.0, 350.0, *BAND)
    temperature = np.random.default_rng(1).uniform(250.0, 350.0, 500)
    exact = emitted_radiance(material.emissivity_at, temperature, *BAND)
    assert np.abs(table(temperature) - exact).max() < 0.1 * MILLIKELVIN
    assert np.abs(table.inverse(exact) - temperature).max() < 1e-4
    assert np.isnan(table(200.0)) and np.isnan(table.inverse(1e6))


@pytest.mark.filterwarnings("error")
def test_table_from_0_kelvin_is_finite():
    emissivity = load_library()["granite"].emissivity_at
    table = RadianceTable.of(emissivity, 0.0, 296.0, *BAND)
    assert np.isfinite(table.radiance).all() and (np.diff(table.radiance) >= 0.0).all()
    assert table.radiance[0] == 0.0
    assert abs(table(290.0) - emitted_radiance(emissivity, 290.0, *BAND)) < 0.1 * MILLIKELVIN


def measured_in_band():
    ranges = ((material, material.valid_range_um) for material in load_library().values())
    materials = [material for material, (first, last) in ranges if first <= BAND[0] and last >= BAND[1]]
    assert len(materials) > 50
    return materials


def test_emitted_plus_reflected_in_an_isothermal_room_is_black():
    for material in measured_in_band():
        total = emitted_radiance(material.emissivity_at, 290.0, *BAND) + reflected_radiance(
            material.emissivity_at, 290.0, *BAND
        )
        assert abs(total - band_radiance(290.0, *BAND)) < 1e-3 * MILLIKELVIN


# Kinetic temperatures at 19 °C apparent under a 250 K sky, computed independently of this code.
@pytest.mark.parametrize(("emissivity", "celsius"), [(0.2, 109.0), (0.1, 180.0)])
def test_low_emissivity_is_ill_posed(emissivity, celsius):
    material = grey("metal", emissivity)
    radiance = band_radiance(292.15, *BAND)
    kinetic = kinetic_temperature(radiance, material.emissivity_at, 250.0, BAND, (200.0, 600.0))
    assert kinetic == pytest.approx(celsius + 273.15, abs=0.5)


def test_kinetic_temperature_inverts_the_radiance_of_a_surface():
    for material in measured_in_band():
        shown = emitted_radiance(material.emissivity_at, 301.0, *BAND) + reflected_radiance(
            material.emissivity_at, 255.0, *BAND
        )
        assert kinetic_temperature(shown, material.emissivity_at, 255.0, BAND, (200.0, 500.0)) == pytest.approx(
            301.0, abs=1e-4
        )


def test_kinetic_temperature_outside_the_allowed_range_is_nan():
    black = grey("black", 1.0).emissivity_at
    radiance = np.array([-1.0, *band_radiance(np.array([250.0, 279.8, 320.2, 300.0]), *BAND)])
    kinetic = kinetic_temperature(radiance, black, 255.0, BAND, (280.0, 320.0))
    assert np.isnan(kinetic[:4]).all() and kinetic[4] == pytest.approx(300.0, abs=1e-4)


@pytest.mark.parametrize("band_um", [BAND, (3.0, 5.0)])
def test_apparent_temperatures_by_table_are_those_of_the_inverse(band_um):
    """From a cold sky to far above the camera's range; outside the table the inverse itself is used."""
    kelvin = np.concatenate([np.geomspace(15.0, 60.0, 200), np.geomspace(60.0, 1000.0, 20000), [4990.0, 6000.0]])
    radiance = band_radiance(kelvin, *band_um).astype(np.float32)
    off = apparent_temperature(radiance, band_um) - brightness_temperature(radiance, *band_um)
    assert np.abs(off[:-2]).max() < 1e-4 and np.abs(off[-2:]).max() < 5e-4
    np.testing.assert_array_equal(
        apparent_temperature(radiance.astype(np.float64), band_um), apparent_temperature(radiance, band_um)
    )


def test_apparent_temperature_of_any_radiance():
    """Radiances outside any table are inverted directly and leave their neighbours unchanged."""
    odd = np.array([0.0, -1.0, np.nan, np.inf, 5e-324, 1e-300, 1e10, 1e300, 40.0])
    found = apparent_temperature(odd, BAND)
    expected = brightness_temperature(odd, *BAND)
    with np.errstate(over="ignore"):
        np.testing.assert_allclose(found, expected.astype(np.float32), rtol=1e-6)
    assert apparent_temperature(40.0, BAND) == found[-1] == apparent_temperature(odd[-1:], BAND)
