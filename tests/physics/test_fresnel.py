"""Emissivity by angle against closed forms, another library, two sets of optical constants, and measured water."""

import os
import re
import subprocess
import sys

import numpy as np
import pytest
from support import shared_data

from thermorender.errors import ThermorenderError
from thermorender.materials.library import load_library
from thermorender.paths import data_folder
from thermorender.physics import fresnel

DEGREES = np.array([0.0, 10.0, 30.0, 45.0, 60.0, 70.0, 75.0, 80.0])


@pytest.fixture(scope="module")
def library():
    return load_library()


def optical_constants(file):
    """Wavelength [µm], n and k of a refractiveindex.info table, read without the package."""
    text = shared_data(f"optical_constants/{file}").read_text(encoding="utf-8")
    rows = [line.split() for line in text.splitlines() if re.fullmatch(r"\s+[\d.Ee+-]+ [\d.Ee+-]+ [\d.Ee+-]+", line)]
    table = np.array(rows, dtype=float)
    return table[np.argsort(table[:, 0])].T


def measured(file):
    """Wavelength [µm] and emissivity of an ECOSTRESS spectrum, read without the package."""
    text = shared_data(f"emissivity/ecostress/spectra/{file}").read_text(encoding="latin-1")
    rows = [line.split() for line in text.splitlines()[15:]]
    table = np.array(sorted([float(a), 1.0 - float(b) / 100.0] for a, b in (row for row in rows if len(row) == 2)))
    return table.T


# --- smooth surfaces --------------------------------------------------------------------------------------


@pytest.mark.parametrize(("n", "k"), [(1.5, 0.0), (1.15, 0.1), (0.6, 0.3), (12.0, 55.0)])
def test_closed_form_along_the_normal(n, k):
    expected = 4.0 * n / ((n + 1.0) ** 2 + k**2)
    assert fresnel.smooth_emissivity(1.0, n, k) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(("n", "k"), [(1.5, 0.0), (1.15, 0.1), (0.6, 0.3), (12.0, 55.0)])
def test_at_45_degrees_parallel_reflectance_is_the_square_of_perpendicular(n, k):
    """Abelès' identity, valid for every complex index."""
    perpendicular, parallel = fresnel.reflectances(np.sqrt(0.5), n, k)
    assert parallel == pytest.approx(perpendicular**2, rel=1e-12)


def test_brewster_angle_and_grazing_view():
    brewster = np.cos(np.arctan(1.5))
    assert fresnel.reflectances(brewster, 1.5, 0.0)[1] == pytest.approx(0.0, abs=1e-15)
    assert fresnel.smooth_emissivity(0.0, 1.15, 0.1) == pytest.approx(0.0, abs=1e-7)


def test_fresnel_agrees_with_mitsuba():
    """Mitsuba has its own Fresnel equations for a complex index, in single precision."""
    import mitsuba

    variant = mitsuba.scalar_rgb
    for n, k in ((1.218, 0.0508), (1.5, 0.0), (0.6, 0.5), (12.0, 55.0)):
        cosines = np.cos(np.radians([0.0, 30.0, 60.0, 75.0, 85.0, 89.0]))
        expected = [variant.fresnel_conductor(float(cosine), variant.Complex2f(n, k)) for cosine in cosines]
        np.testing.assert_allclose(1.0 - fresnel.smooth_emissivity(cosines, n, k), expected, atol=2e-6)


def test_hemispherical_emissivity_of_a_dielectric_matches_walsh():
    """Walsh's closed form of the reflectance for diffuse light (Duntley 1942, doi:10.1364/JOSA.32.000061)."""
    for n in (1.2, 1.5, 2.0):
        q = n**2
        reflected = (
            0.5
            + (n - 1.0) * (3.0 * n + 1.0) / (6.0 * (n + 1.0) ** 2)
            + q * (q - 1.0) ** 2 / (q + 1.0) ** 3 * np.log((n - 1.0) / (n + 1.0))
            - 2.0 * n**3 * (q + 2.0 * n - 1.0) / ((q + 1.0) * (q**2 - 1.0))
            + 8.0 * q**2 * (q**2 + 1.0) / ((q + 1.0) * (q**2 - 1.0) ** 2) * np.log(n)
        )
        table = fresnel.directional_emissivity([n], [0.0])
        assert fresnel.hemispherical(fresnel.COSINES, table)[0] == pytest.approx(1.0 - reflected, abs=1e-5)
    # Tabulated: 9.18 % for n = 1.5.
    assert fresnel.hemispherical(fresnel.COSINES, fresnel.directional_emissivity([1.5], [0.0]))[0] == pytest.approx(
        1.0 - 0.0918, abs=5e-5
    )


def test_table_of_cosines_is_fine_enough():
    """2e-5 for water and 3e-4 for metals, as stated at COSINES."""
    cosine = np.cos(np.radians(np.linspace(0.0, 89.9, 3000)))
    for n, k, tolerance in ((1.15, 0.1, 2.2e-5), (12.0, 55.0, 3e-4), (30.0, 90.0, 3e-4)):
        table = fresnel.directional_emissivity([n], [k])[0]
        found = np.interp(cosine, fresnel.COSINES, table)
        np.testing.assert_allclose(found, fresnel.smooth_emissivity(cosine, n, k), atol=tolerance)


# --- rough surfaces ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("slope", [0.055, 0.169, 0.4])
def test_roughness_against_random_facets(slope):
    """Facets with Gaussian slopes, weighted by their projected area, within four standard errors."""
    random = np.random.Generator(np.random.Philox(7))
    along, across = random.normal(0.0, slope / np.sqrt(2.0), (2, 400_000))
    table = fresnel.directional_emissivity([1.15], [0.1], slope)[0]
    for degrees in (0.0, 45.0, 70.0, 80.0, 88.0):
        cosine, sine = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        shown = np.maximum(cosine - along * sine, 0.0)
        facing = np.clip(shown / np.sqrt(1.0 + along**2 + across**2), 0.0, 1.0)
        emissivity = fresnel.smooth_emissivity(facing, 1.15, 0.1)
        expected = (shown * emissivity).sum() / shown.sum()
        error = np.sqrt((shown**2 * (emissivity - expected) ** 2).sum()) / shown.sum()
        assert np.interp(cosine, fresnel.COSINES, table) == pytest.approx(expected, abs=4.0 * error + 3e-5)


def test_nearly_smooth_equals_smooth():
    smooth = fresnel.directional_emissivity([1.15], [0.1])
    rough = fresnel.directional_emissivity([1.15], [0.1], 1e-3)
    inside = np.cos(np.radians(85.0)) < fresnel.COSINES
    np.testing.assert_allclose(rough[:, inside], smooth[:, inside], atol=3e-5)


def test_emissivity_is_between_0_and_1_and_energy_is_conserved():
    """For any index 0 ≤ ε ≤ 1; in isothermal surroundings a surface looks black from every direction."""
    n, k = np.meshgrid([0.3, 1.0, 1.3, 4.0, 40.0], [0.0, 0.1, 1.0, 10.0, 100.0])
    for slope in (0.0, 0.1, 0.5):
        table = fresnel.directional_emissivity(n.ravel(), k.ravel(), slope)
        assert table.min() >= -1e-12 and table.max() <= 1.0 + 1e-12
        mean = fresnel.hemispherical(fresnel.COSINES, table)
        assert np.all(mean >= table.min(axis=1) - 1e-12) and np.all(mean <= table.max(axis=1) + 1e-12)
    np.testing.assert_allclose(fresnel.hemispherical(fresnel.COSINES, np.ones((3, 257))), 1.0, rtol=1e-12)


def test_slope_of_water_in_a_breeze_matches_cox_and_munk():
    """Mean square slope by their regression: 0.003 in calm air, plus 0.0256 at 5 m/s."""
    assert load_library()["water_breeze"].rms_slope == pytest.approx(np.sqrt(0.003 + 0.0256), abs=5e-5)


def test_wrong_slopes_are_refused():
    with pytest.raises(ThermorenderError, match=r"rms_slope=5 is not within 0…0.5; give the rms tangent"):
        fresnel.directional_emissivity([1.2], [0.1], 5.0)


# --- water and ice ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "file", "range_um", "tolerance"),
    [
        ("water_fresnel", "water.tapwater.none.liquid.all.tapwater.jhu.becknic.spectrum.txt", (7.0, 14.0), 0.003),
        ("water_fresnel", "water.seawater.none.liquid.tir.seawater.jhu.becknic.spectrum.txt", (7.0, 14.0), 0.004),
        ("ice_fresnel", "water.ice.none.solid.all.ice_dat_.jhu.becknic.spectrum.txt", (7.0, 14.0), 0.001),
        ("water_fresnel", "water.tapwater.none.liquid.all.tapwater.jhu.becknic.spectrum.txt", (3.0, 4.8), 0.003),
        ("water_fresnel", "water.seawater.none.liquid.tir.seawater.jhu.becknic.spectrum.txt", (3.0, 4.8), 0.003),
        ("ice_fresnel", "water.ice.none.solid.all.ice_dat_.jhu.becknic.spectrum.txt", (3.0, 4.8), 0.004),
        ("glass_fresnel", "manmade.generalconstructionmaterial.glas.solid.all.0796uuugls.jhu.becknic.spectrum.txt",
         (3.0, 4.8), 0.004),
    ],
)  # fmt: skip
def test_optical_constants_give_the_measured_emissivity_at_10_degrees(library, name, file, range_um, tolerance):
    wavelength, emissivity = measured(file)
    inside = (wavelength >= range_um[0]) & (wavelength <= range_um[1])
    found = library[name].emissivity_at_angle(wavelength[inside], np.cos(np.radians(10.0)))
    np.testing.assert_allclose(found, emissivity[inside], atol=tolerance)


@pytest.mark.parametrize(
    ("degrees", "of_band"),
    [(0, 0.002), (10, 0.002), (30, 0.002), (45, 0.002), (60, 0.004), (70, 0.005), (75, 0.006), (80, 0.007)],
)
def test_water_by_angle_agrees_with_segelsteins_constants(library, degrees, of_band):
    """Other constants and another form of the equations: two compilations of n and k differ by the tolerance."""
    wavelength, n, k = optical_constants("H2O-Segelstein.yml")
    grid = np.linspace(7.5, 13.5, 601)
    index = np.interp(grid, wavelength, n) + 1j * np.interp(grid, wavelength, k)
    cosine = np.cos(np.radians(degrees))
    refracted = np.sqrt(1.0 - (1.0 - cosine**2) / index**2)
    reflected = [abs((cosine - index * refracted) / (cosine + index * refracted)) ** 2,
                 abs((refracted - index * cosine) / (refracted + index * cosine)) ** 2]  # fmt: skip
    difference = library["water_fresnel"].emissivity_at_angle(grid, cosine) - (1.0 - np.mean(reflected, axis=0))
    assert abs(difference.mean()) < of_band and abs(difference).max() < 2.6 * of_band


def test_water_by_angle_is_that_of_the_page(library):
    page = (data_folder("materials") / "README.md").read_text("utf-8")
    degrees, stated = (re.findall(r"[\d.]+", next(line for line in page.splitlines() if line.startswith(begin)))
                       for begin in ("| angle | 0°", "| emissivity | 0.986"))  # fmt: skip
    water = library["water_fresnel"]
    found = [water.band_emissivity(7.5, 13.5, 300.0, np.cos(np.radians(float(each)))) for each in degrees]
    assert [f"{value:.3f}" for value in (*found, water.band_emissivity(7.5, 13.5, 300.0))] == stated


def test_emissivity_of_water_decreases_with_angle_as_measured(library):
    """About 7 % less at 65° than at nadir over 8–14 µm.

    Measured: "Experimental investigation of the angular variation of emissivity in the thermal infrared band" (SPIE).
    """
    water = library["water_fresnel"]
    nadir, oblique = (water.band_emissivity(8.0, 14.0, 290.0, np.cos(np.radians(angle))) for angle in (0.0, 65.0))
    assert 1.0 - oblique / nadir == pytest.approx(0.07, abs=0.005)


@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("water_fresnel", "H2O-Hale.yml"), ("ice_fresnel", "H2O-Warren-2008.yml"),
        ("glass_fresnel", "soda-lime-Rubin-IR.yml"), ("silica_fused", "SiO2-Popova.yml"),
        ("aluminium_polished", "Al-Ordal.yml"), ("copper_polished", "Cu-Ordal.yml"),
        ("gold_polished", "Au-Ordal.yml"), ("iron_polished", "Fe-Ordal.yml"),
    ],
)  # fmt: skip
def test_shipped_constants_match_the_papers(library, name, file):
    """Along the normal, by the closed form from the paper's rows, at every row within the table."""
    wavelength, n, k = optical_constants(file)
    low, high = library[name].valid_range_um
    inside = (wavelength >= low) & (wavelength <= high)
    assert low <= (7.0 if name == "silica_fused" else 3.0) and high >= 15.0 and inside.sum() >= 14
    expected = 4.0 * n / ((n + 1.0) ** 2 + k**2)
    found = library[name].emissivity_at_angle(wavelength[inside], 1.0)
    np.testing.assert_allclose(found, expected[inside], atol=1e-5)


@pytest.mark.parametrize(
    ("name", "file"),
    [("water_fresnel", "H2O-Hale.yml"), ("ice_fresnel", "H2O-Warren-2008.yml"), ("gold_polished", "Au-Ordal.yml"),
     ("iron_polished", "Fe-Ordal.yml")],
)  # fmt: skip
def test_reflectance_between_the_papers_rows(library, name, file):
    """Along the normal at every nanometre of 3–8 µm, with n and k linear between the paper's rows."""
    wavelength, n, k = optical_constants(file)
    fine = np.linspace(3.0, 8.0, 5001)
    index = np.interp(fine, wavelength, n) + 1j * np.interp(fine, wavelength, k)
    expected = abs((index - 1.0) / (index + 1.0)) ** 2
    np.testing.assert_allclose(1.0 - library[name].emissivity_at_angle(fine, 1.0), expected, atol=1e-4)


def test_glass_is_clear_glass_below_5_um(library):
    """Rubin's formula for clear soda-lime glass, 0.31–4.6 µm; k is below 0.001 there."""
    wavelength = np.linspace(3.0, 4.6, 161)
    n = 1.5130 - 0.003169 * wavelength**2 + 0.003962 / wavelength**2
    found = library["glass_fresnel"].emissivity_at_angle(wavelength, 1.0)
    np.testing.assert_allclose(1.0 - found, ((n - 1.0) / (n + 1.0)) ** 2, atol=5e-5)


def test_rough_emissivity_does_not_depend_on_the_number_of_threads():
    """A scene's digest holds these bytes."""
    code = (
        "import numpy as np, hashlib; from thermorender.physics import fresnel; n = np.linspace(1.1, 1.4, 161); "
        "print(hashlib.sha256(fresnel.directional_emissivity(n, 0.1 * n, 0.15)).hexdigest())"
    )
    found = {
        subprocess.run(
            [sys.executable, "-c", code], env={**os.environ, "OPENBLAS_NUM_THREADS": threads}, capture_output=True,
            text=True, check=True,
        ).stdout
        for threads in ("1", "2")
    }  # fmt: skip
    assert len(found) == 1
