"""Spectra from the field: the quantity and the units that a header states are obeyed or refused."""

import numpy as np
import pytest
from test_materials import ecostress_file

from thermorender.apps.material_tables.check import check
from thermorender.apps.material_tables.from_samples import from_samples
from thermorender.apps.material_tables.samples import read_sample
from thermorender.errors import ThermorenderError

WAVELENGTH = np.linspace(14.2, 6.8, 200)


def spectrum(path, values=5.0, x=WAVELENGTH, x_units=None, **kwargs):
    path = ecostress_file(path, x, values + 0.0 * x, **kwargs)
    if x_units:
        path.write_text(path.read_text("latin-1").replace("Wavelength (micrometers)", x_units), "latin-1")
    return path


def emissivity(path):
    return from_samples([read_sample(path)], "rock", solar_absorptance=0.5).emissivity_at(10.0)


@pytest.mark.parametrize(
    ("x_units", "to_x", "y_units", "value"),
    [("Wavelength (micrometers)", lambda um: um, "Reflectance (percentage)", 5.0),
     ("Wavelength (nanometers)", lambda um: 1e3 * um, "Reflectence (percent)", 5.0),
     ("Wavenumber (cm-1)", lambda um: 1e4 / um, "Reflectance (fraction)", 0.05),
     ("Wavenumber (cm^-1)", lambda um: 1e4 / um, "Reflectance (unitless)", 0.05)],
)  # fmt: skip
def test_stated_units_are_obeyed(tmp_path, x_units, to_x, y_units, value):
    path = spectrum(tmp_path / "a.txt", value, to_x(WAVELENGTH), x_units, y_units=y_units)
    assert emissivity(path) == pytest.approx(0.95, abs=1e-4)
    assert not [each for each in check(path) if each.fault]


@pytest.mark.parametrize(
    ("x_units", "y_units"),
    [(None, "Emissivity (percent)"), (None, "Transmittance (percentage)"), (None, "Reflectance"), (None, "percent"),
     ("Frequency (THz)", "Reflectance (percent)")],
)  # fmt: skip
def test_other_quantities_and_units_are_refused(tmp_path, x_units, y_units):
    path = spectrum(tmp_path / "a.txt", 95.0, x_units=x_units, y_units=y_units)
    with pytest.raises(ThermorenderError, match="only hemispherical reflectance in percent or as a fraction"):
        read_sample(path)
    assert any("only hemispherical reflectance" in each.text for each in check(path) if each.fault)


@pytest.mark.parametrize("percent", [0.05, 0.95, 99.5])
def test_reflectance_that_no_surface_has_is_refused(tmp_path, percent):
    with pytest.raises(ThermorenderError, match="which no surface has; its heading may state percent for shares"):
        emissivity(spectrum(tmp_path / "a.txt", percent))


def test_emissivity_under_a_heading_of_reflectance_is_remarked_on(tmp_path):
    for percent, remarked in ((96.0, True), (5.0, False)):
        sample = read_sample(spectrum(tmp_path / "a.txt", percent))
        note = from_samples([sample], "rock", solar_absorptance=0.5).note
        assert ("if the values are emissivities, their heading is wrong" in note) == remarked


def test_impossible_wavelengths_are_refused(tmp_path):
    path = spectrum(tmp_path / "a.txt")
    path.write_text(path.read_text("latin-1") + "1e18\t5.0\n", "latin-1")
    with pytest.raises(ThermorenderError, match=r"pair 1e\+18, 5, a wavelength outside 0.1…1000 µm"):
        read_sample(path)
    path = spectrum(tmp_path / "a.txt", x=1e4 / WAVELENGTH)
    with pytest.raises(ThermorenderError, match="a wavelength outside"):
        read_sample(path)


def table(path, header, rows):
    path.write_text("\n".join([header, *(",".join(map(str, row)) for row in rows)]) + "\n")
    return path


def test_csv_headings_state_one_quantity_each(tmp_path):
    grid = np.round(WAVELENGTH, 3)
    with pytest.raises(ThermorenderError, match="has a column 'transmittance'; emissivity is one minus reflectance"):
        read_sample(table(tmp_path / "a.csv", "wavelength_um,reflectance,transmittance", [(w, 0.1, 0.6) for w in grid]))
    with pytest.raises(ThermorenderError, match="the headings must be one of"):
        read_sample(table(tmp_path / "b.csv", "wavelength_um,reflectance,emissivity", [(w, 0.1, 0.9) for w in grid]))
    with pytest.raises(ThermorenderError, match=r"by its heading wavelength_um, but spectra lie within"):
        read_sample(table(tmp_path / "c.csv", "wavelength_um,emissivity", [(1000 * w, 0.9) for w in grid]))
    with pytest.raises(ThermorenderError, match="which no surface has"):
        emissivity(table(tmp_path / "d.csv", "wavelength_um,emissivity_percent", [(w, 0.95) for w in grid]))


@pytest.mark.parametrize(("count", "last"), [(250, 6.8), (200, 0.4), (200, 6.8)])
def test_a_stated_extent_must_be_the_files(tmp_path, count, last):
    path = spectrum(tmp_path / "a.txt")
    stated = f"First X Value: 14.2\nLast X Value: {last}\nNumber of X Values: {count}\nX Units:"
    path.write_text(path.read_text("latin-1").replace("X Units:", stated), "latin-1")
    if (count, last) == (200, 6.8):
        assert emissivity(path) == pytest.approx(0.95, abs=1e-4)
        return
    with pytest.raises(
        ThermorenderError, match=f"holds 200 pairs from 6.8 to 14.2 where its header states {count} from"
    ):
        read_sample(path)
