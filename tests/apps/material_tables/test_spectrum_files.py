"""Spectra from the field: the quantity and the units that a header states are obeyed or refused."""

import numpy as np
import pytest

from thermorender.apps.material_tables.check import check
from thermorender.apps.material_tables.from_samples import from_samples, read_selection
from thermorender.apps.material_tables.samples import read_ecostress, read_sample
from thermorender.errors import ThermorenderError
from thermorender.materials.library import load_library
from thermorender.materials.store import write_material

WAVELENGTH = np.linspace(14.2, 6.8, 200)


def ecostress_file(path, wavelength, percent, measurement="Hemispherical reflectance", y_units="Reflectance (percent)"):
    header = [
        "Name: Made-up rock", "Type: rock", "Description: at 10\xb0: rough", f"Measurement: {measurement}",
        "X Units: Wavelength (micrometers)", f"Y Units:{y_units}", "",
    ]  # fmt: skip
    lines = [f" {w:.4f}\t{p:.4f}" for w, p in zip(wavelength, percent, strict=True)]
    path.write_text("\n".join(header + lines) + "\n", encoding="latin-1")
    return path


def spectrum(path, values=5.0, x=WAVELENGTH, x_units=None, **kwargs):
    path = ecostress_file(path, x, values + 0.0 * x, **kwargs)
    if x_units:
        path.write_text(path.read_text("latin-1").replace("Wavelength (micrometers)", x_units), "latin-1")
    return path


def columns(header, *values, unit=1.0):
    """The text of a table of these values at all wavelengths."""
    return "\n".join([header, *(",".join(map(str, [unit * w, *values])) for w in np.round(WAVELENGTH, 3))])


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
    [(None, "Emissivity (percent)"), (None, "Transmittance (percentage)"), (None, "Transmittance"),
     (None, "Reflectance"), (None, "percent"), ("Frequency (THz)", "Reflectance (percent)")],
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
    (tmp_path / "a.csv").write_text(columns("wavelength_um,emissivity_percent", percent))
    with pytest.raises(ThermorenderError, match="which no surface has"):
        emissivity(tmp_path / "a.csv")


def test_two_points_beyond_the_table_s_ends_are_read(tmp_path):
    """Of 7.14 and 14.29 µm; the rows of the table are at multiples of 0.05 µm between them."""
    path = tmp_path / "two.csv"
    path.write_text("wavenumber_cm-1,emissivity\n700,0.9\n1400,0.95\n")
    made = from_samples([read_sample(path)], "two", solar_absorptance=0.5)
    assert (made.wavelength_um[0], made.wavelength_um[-1]) == pytest.approx((7.15, 14.25))
    between = np.interp(made.wavelength_um, 1e4 / np.array([1400, 700]), [0.95, 0.9])
    np.testing.assert_allclose(made.emissivity, between, atol=1e-6)


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


# --- tables of samples -----------------------------------------------------------------------------------------------


def test_mean_and_spread_over_samples_in_either_order(tmp_path):
    coarse = np.linspace(2.0, 14.2, 123)
    fine = np.linspace(14.01, 0.4, 2001)
    paths = [
        ecostress_file(tmp_path / "a.txt", coarse, 10.0 + coarse),
        ecostress_file(tmp_path / "b.txt", fine, 12.0 + fine),
    ]
    rock = from_samples([read_ecostress(path) for path in paths], "rock", title="Rock", temperature=301.0)
    np.testing.assert_allclose(rock.wavelength_um, np.arange(60, 281) * 0.05)
    np.testing.assert_allclose(rock.emissivity[1:-1], 0.89 - rock.wavelength_um[1:-1] / 100, atol=1e-6)
    np.testing.assert_allclose(rock.emissivity_std[1:-1], np.sqrt(2.0) * 0.01, atol=2e-6)
    assert rock.samples == 2 and rock.source.endswith("a.txt; b.txt")
    # Only the second extends to sunlight, where it reflects 12.4 to 14.5 %.
    assert 0.855 < rock.solar_absorptance < 0.876 and "from 1 of 2 samples" in rock.note
    write_material(rock, tmp_path / "m")
    back = load_library(tmp_path / "m")["rock"]
    np.testing.assert_allclose(back.emissivity, rock.emissivity, atol=5.1e-7)
    assert (back.title, back.temperature) == ("Rock", 301.0)
    assert (back.source, back.note) == (rock.source, rock.note)


def test_repeated_wavelengths_are_averaged_and_percent_is_converted(tmp_path):
    path = ecostress_file(tmp_path / "a.txt", [14.0, 9.0, 9.0, 2.0], [10.0, 20.0, 40.0, 5.0])
    sample = read_ecostress(path)
    np.testing.assert_allclose(sample.wavelength_um, [2.0, 9.0, 14.0])
    np.testing.assert_allclose(sample.reflectance, [0.05, 0.30, 0.10])
    assert sample.name == "Made-up rock"


def test_samples_without_usable_emissivity_are_refused(tmp_path):
    wavelength = np.linspace(2.0, 14.5, 200)

    def refused(words, *, wavelength=wavelength, percent=5.0, solar=0.5, **kwargs):
        path = ecostress_file(tmp_path / "a.txt", wavelength, percent + 0.0 * wavelength, **kwargs)
        with pytest.raises(ThermorenderError, match=words):
            from_samples([read_ecostress(path)], "rock", solar_absorptance=solar)

    refused(r"less than two steps of 0.05 µm in common within 3–15 µm", wavelength=np.linspace(0.4, 2.5, 99))
    refused(r"measured as 'Bidirectional'; .* leave the sample out", measurement="Bidirectional")
    refused(r"has reflectance -0.5 %, emissivity 1.005, at .* outside 0…100 % at", percent=-0.5)
    refused(r"no sample of material 'rock' covers 0.42–2.5 µm.*give an assumed value", solar=None)
    with pytest.raises(ThermorenderError, match=r"b.txt does not exist; order the spectrum"):
        read_ecostress(tmp_path / "b.txt")
    with pytest.raises(ThermorenderError, match=r"'rock' has no sample"):
        from_samples([], "rock")


def test_libraries_that_end_at_different_wavelengths_make_one_table(tmp_path):
    """Over 3–14 µm the mean is over the samples that extend there, and the note gives their number."""
    samples = [
        read_ecostress(ecostress_file(tmp_path / "a.txt", np.linspace(3.0, 12.5, 400), np.full(400, 10.0))),
        read_ecostress(ecostress_file(tmp_path / "b.txt", np.linspace(8.0, 14.2, 400), np.full(400, 20.0))),
    ]
    rock = from_samples(samples, "rock", solar_absorptance=0.5)
    assert rock.valid_range_um == (3.0, 14.0)
    np.testing.assert_allclose(rock.emissivity_at([4.0, 7.5, 10.0, 13.0]), [0.9, 0.9, 0.85, 0.8], atol=1e-9)
    assert "samples: 1 over 3–7.95 µm, 2 over 8–12.5 µm, 1 over 12.55–14 µm" in rock.note
    assert np.isnan(rock.emissivity_std[0])
    apart = read_ecostress(ecostress_file(tmp_path / "c.txt", np.linspace(9.0, 14.2, 400), np.full(400, 20.0)))
    short = read_ecostress(ecostress_file(tmp_path / "d.txt", np.linspace(6.0, 8.0, 400), np.full(400, 20.0)))
    with pytest.raises(ThermorenderError, match=r"no sample of material 'rock' covers 8.05 µm, between those that do"):
        from_samples([apart, short], "rock", solar_absorptance=0.5)


def test_rows_below_the_seam_change_no_other(tmp_path):
    """The seam is 3.2 µm, or 7 µm with a sample that begins above."""
    wavelength = np.linspace(2.9, 14.3, 2281)
    percent = 20.0 + 5.0 * np.sin(7.0 * wavelength) + 3.0 * np.cos(31.0 * wavelength)
    late = read_ecostress(ecostress_file(tmp_path / "c.txt", np.linspace(8.0, 14.2, 400), np.full(400, 20.0)))
    for seam, others in ((3.2, []), (7.0, [late])):
        for first in (0.0, seam - 1e-6):
            kept = wavelength >= first
            ecostress_file(tmp_path / f"{first:g}.txt", wavelength[kept], percent[kept])
        whole, part = (
            from_samples([read_ecostress(tmp_path / f"{first:g}.txt"), *others], "rock", solar_absorptance=0.5)
            for first in (0.0, seam - 1e-6)
        )
        assert (whole.wavelength_um[0], part.wavelength_um[0]) == (3.0, seam)
        np.testing.assert_array_equal(whole.emissivity[whole.wavelength_um >= seam], part.emissivity)
        short = whole.wavelength_um < seam
        truth = 0.8 - 0.05 * np.sin(7.0 * whole.wavelength_um[short]) - 0.03 * np.cos(31.0 * whole.wavelength_um[short])
        np.testing.assert_allclose(whole.emissivity[short], truth, atol=0.012)


@pytest.mark.parametrize(("least", "first"), [(-0.9, 3.0), (-1.1, 3.2)])
def test_a_table_begins_where_noise_ends(tmp_path, least, first):
    """Noise of 1 % reflectance beyond 0…100 % averages out near 3 µm; a table begins above any larger."""
    wavelength = np.round(np.arange(2.5, 14.3, 0.002), 3)
    percent = np.where(wavelength == 3.1, least, 1.2)
    rock = from_samples(
        [read_ecostress(ecostress_file(tmp_path / "a.txt", wavelength, percent))], "rock", solar_absorptance=0.5
    )
    assert rock.wavelength_um[0] == first and abs(rock.emissivity - 0.988).max() < 0.0015


def test_gaps_of_a_sample_are_not_interpolated(tmp_path):
    path = tmp_path / "own.csv"

    def write(*ranges):
        rows = "".join(f"{w:.3f},0.9\n" for low, high in ranges for w in np.arange(low, high, 0.02))
        path.write_text("wavelength_um,emissivity\n" + rows)
        return from_samples([read_sample(path)], "rock", solar_absorptance=0.5)

    assert write((0.4, 2.5), (8.0, 14.01)).valid_range_um == (8.0, 14.0)
    with pytest.raises(ThermorenderError, match=r"own.csv of material 'rock' has no point between 8.98 and 10 µm"):
        write((7.0, 8.99), (10.0, 14.01))


@pytest.mark.parametrize(
    ("header", "rows"),
    [
        ("wavelength_um,emissivity", [(7.0, 0.9), (10.0, 0.8), (14.0, 0.95)]),
        ("wavelength_nm,reflectance_percent", [(7000, 10.0), (10000, 20.0), (14000, 5.0)]),
        ("wavenumber_cm-1,reflectance", [(1e4 / 7.0, 0.1), (1000.0, 0.2), (1e4 / 14.0, 0.05)]),
        ("emissivity_percent,wavelength_um", [(90.0, 7.0), (80.0, 10.0), (95.0, 14.0)]),
    ],
)
def test_two_column_tables_state_their_units(tmp_path, header, rows):
    path = tmp_path / "own.csv"
    path.write_text(header + "\n" + "".join(f"{a!r},{b!r}\n" for a, b in rows))
    sample = read_sample(path)
    np.testing.assert_allclose(sample.wavelength_um, [7.0, 10.0, 14.0], rtol=1e-12)
    np.testing.assert_allclose(sample.reflectance, [0.1, 0.2, 0.05], atol=1e-12)


@pytest.mark.parametrize(
    ("text", "column", "words"),
    [
        ("um,e\n7,0.9\n14,0.9\n", None, r"row 1 holds um, e; the headings must be one of wavelength_um, wave"),
        (
            "/*** A spectrometer ***/\nname= a\nunits= Radiance, Radiance\n350.0  1.0  2.0  50.0\n",
            None,
            r"row 1 holds /\*",
        ),
        ("wavelength_um,emissivity\n7,x\n", None, r"row 2: emissivity='x' is not a number"),
        ("wavelength_um,emissivity\n7,nan\n8,0.1\n", None, r"row 2: emissivity=nan is not within"),
        ("wavelength_um,emissivity\n7,0.9\n7,0.9\n", None, r"at least two rows with different, positive"),
        ("wavelength,A001,A002\n8,0.9,0.8\n9,0.9,0.8\n", "A9", r"holds the samples A001, A002 … A002, not 'A9'"),
        ("wavelength,A001,A002\n8,0.9,0.8\n9,0.9,0.8\n", None, r"not None; name one as column"),
        (
            columns("wavelength_um,reflectance,transmittance", 0.1, 0.6),
            None,
            "has a column 'transmittance'; emissivity is one minus reflectance",
        ),
        (columns("wavelength_um,reflectance,emissivity", 0.1, 0.9), None, "the headings must be one of"),
        (
            columns("wavelength_um,emissivity", 0.9, unit=1000.0),
            None,
            "by its heading wavelength_um, but spectra lie within",
        ),
    ],
)
def test_faults_of_sample_files_are_reported(tmp_path, text, column, words):
    path = tmp_path / "own.csv"
    path.write_text(text)
    with pytest.raises(ThermorenderError, match=words):
        read_sample(path, column)


def test_selection_accepts_bare_file_names_only(tmp_path):
    selection = tmp_path / "selection.csv"
    header = "material,file,title,colour_r,colour_g,colour_b,solar_absorptance,temperature_k,note\n"
    selection.write_text(header + "rock,a.txt,Rock,1,2,3,0.5,20,\n")
    ecostress_file(tmp_path / "a.txt", np.linspace(2.0, 14.5, 200), np.full(200, 5.0))
    with pytest.raises(ThermorenderError, match=r"selection.csv, row 2: temperature_k=20 is not within 100…6000"):
        read_selection(selection, [tmp_path])
    selection.write_text(header + "rock,a.txt,Rock,1,2,3,0.5,300,\n")
    assert read_selection(selection, [tmp_path])[0].emissivity_at(10.0) == pytest.approx(0.95)
    selection.write_text(header + "rock,../a.txt,Rock,1,2,3,0.5,300,\n")
    with pytest.raises(ThermorenderError, match=r"file='../a.txt' is not the bare name of a file"):
        read_selection(selection, [tmp_path])
    selection.write_text(header + "rock,b.txt,Rock,1,2,3,0.5,300,\n")
    with pytest.raises(ThermorenderError, match=r"b.txt is in none of .*; add the folder that holds it"):
        read_selection(selection, [tmp_path])


# --- pasted from a spreadsheet ---------------------------------------------------------------------------------------

# The same spectrum each time: (text, what the reader says of it).
PASTED = [
    ("wavelength_um\temissivity\n7\t0.04\n10\t0.045\n14\t0.05\n", "3 rows, 7–14 µm, emissivity 0.04–0.05"),
    ("7\t0.04\n10\t0.045\n14\t0.05\n", "3 rows, 7–14 µm, emissivity 0.04–0.05"),
    ("7\t4\n10\t4.5\n14\t5", "3 rows, 7–14 µm, percent read as emissivity 0.04–0.05"),
    ("7,0;0,04\n10,0;0,045\n14,0;0,05\n", "3 rows, 7–14 µm, emissivity 0.04–0.05"),
    ("7,0\t4,0\n10,0\t4,5\n14,0\t5,0\n", "3 rows, 7–14 µm, percent read as emissivity 0.04–0.05"),
    ("7,0   4,0\n10,0  4,5\n14,0  5,0\n", "3 rows, 7–14 µm, percent read as emissivity 0.04–0.05"),
    ("\n\n7000;0,04;;\n;;;\n10000;0,045;;\n14000;0,05;;\n", "3 rows, 7–14 µm, nm read as µm and emissivity 0.04–0.05"),
    ("\ufeffWavelength (µm);Emissivity [%]\r\n7,0;4,0\r\n10,0;4,5\r\n14,0;5,0\r\n",
     "3 rows, 7–14 µm, percent read as emissivity 0.04–0.05"),
    ("lambda,eps,\n14,0.05,\n10,0.045,\n7,0.04,\n", "3 rows, 7–14 µm, emissivity 0.04–0.05"),
    ("λ / nm\tε(λ)\n7000\t0.04\n10000\t0.045\n14000\t0.05\n",
     "3 rows, 7–14 µm, nm read as µm and emissivity 0.04–0.05"),
    ("Wavelength\tSpectral emissivity\tstd\n7\t0.04\t0.01\n10\t0.045\t0.01\n14\t0.05\t0.01\n",
     "3 rows, 7–14 µm, emissivity 0.04–0.05; std not used"),
    ("wavelength [microns];R [%]\n7;96\n10;95,5\n14;95\n",
     "3 rows, 7–14 µm, reflectance in percent read as emissivity 0.04–0.05"),
    ("Wavelength (um),Reflectance\n7,0.96\n10,0.955\n14,0.95\n",
     "3 rows, 7–14 µm, reflectance read as emissivity 0.04–0.05"),
    (f"{1e4 / 7!r}\t4\n1000\t4.5\n{1e4 / 14!r}\t5\n",
     "3 rows, 7–14 µm, cm⁻¹ and percent read as µm and emissivity 0.04–0.05"),
    (f"Wavenumber (cm⁻¹)\tEmissivity (-)\n{1e4 / 7!r}\t0.04\n1000\t0.045\n{1e4 / 14!r}\t0.05\n",
     "3 rows, 7–14 µm, cm⁻¹ read as µm and emissivity 0.04–0.05"),
    ("7\t0.04\n10\t0.045\n10\t0.045\n14\t0.05\n",
     "3 rows, 7–14 µm, emissivity 0.04–0.05; 1 repeated rows left out"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "words"), PASTED)
def test_a_spectrum_from_a_spreadsheet_is_read_and_said_in_words(tmp_path, text, words):
    path = tmp_path / "pasted.csv"
    path.write_bytes(text.encode())
    sample = read_sample(path)
    np.testing.assert_allclose(sample.wavelength_um, [7.0, 10.0, 14.0], rtol=1e-12)
    np.testing.assert_allclose(1.0 - sample.reflectance, [0.04, 0.045, 0.05], rtol=1e-9)
    assert sample.words == words
    # What follows from the values stays with the material.
    made = from_samples([sample], "foil", solar_absorptance=0.1)
    assert ("pasted.csv read as 3 rows" in made.note) == sample.inferred
    assert not [each for each in check(path) if each.fault and "gap" not in each.text and "repeats" not in each.text]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("7\t0.9\n10\t4\n", "the second column runs over 0.9–4, and 1 of 2 rows exceed 1; write emissivity_percent"),
        ("lambda,emissivity\n7,0.9\n10,1.2\n", "emissivity runs over 0.9–1.2, and 1 of 2 rows exceed 1"),
        ("7\t95\n10\t950\n", r"the second column runs up to 950, but is a share 0…1 or 0…100 percent"),
        ("3000\t0.9\n5000\t0.9\n", "the first column runs over 3000–5000 without a unit; write wavelength_um, wave"),
        ("600\t0.9\n15000\t0.9\n", "the first column runs over 600–15000 without a unit"),
        ("50\t0.9\n500\t0.9\n", "the first column runs over 50–500 without a unit"),
        ("lambda,eps\n50,0.9\n500,0.9\n", "lambda runs over 50–500 without a unit"),
        ("7,0,0,04\n10,0,0,045\n", "has numbers in 4 columns without headings; give two, of wavelength and emissivity"),
        ("7\t0.9\t0.01\n8\t0.9\t0.01\n", "has numbers in 3 columns without headings"),
        ("7\n8\n", "has numbers in 1 column without headings"),
        ("7\t0.9\n7\t0.8\n9\t0.8\n", "gives wavelength_um=7 twice, with emissivity=0.8 and 0.9; keep one row for each"),
        ("wavelength (cm-1),eps\n1000,0.9\n800,0.9\n", r"row 1 holds wavelength \(cm-1\), eps; the headings must be"),
        ("wavelength\teps 1\teps 2\n7\t0.9\t0.8\n", "holds the samples eps 1, eps 2 … eps 2"),
        ("wavelength\tabsorbance\n7\t0.9\n8\t0.9\n", "row 1 holds wavelength, absorbance; the headings must be"),
        ("wavelength\temissivity\n7\t0.9\n8\t#N/A\n", "row 3: emissivity='#N/A' is not a number"),
        ("7,5\t0.9\n8,5\t0.95\n", "row 1 holds 7,5, 0.9 with different decimal marks; write a point in all numbers"),
        ("wavelength_um,emissivity [1]\n7,4\n14,5\n", "reflectance -300 %, emissivity 4, at 7 µm"),
    ],
)  # fmt: skip
def test_a_spectrum_in_doubt_is_refused_with_its_remedy(tmp_path, text, words):
    path = tmp_path / "pasted.csv"
    path.write_text(text, "utf-8")
    with pytest.raises(ThermorenderError, match=words) as refused:
        emissivity(path)
    assert "\\t" not in str(refused.value) and "\t" not in str(refused.value)


def test_thousands_of_rows_in_descending_order_are_read(tmp_path):
    path, wavelength = tmp_path / "long.csv", np.linspace(14.5, 6.5, 8001)
    path.write_text("".join(f"{w:.3f}\t{90 + w / 10:.4f}\r\n" for w in wavelength))
    sample = read_sample(path)
    assert sample.words == "8001 rows, 6.5–14.5 µm, percent read as emissivity 0.907–0.914"
    assert emissivity(path) == pytest.approx(0.91, abs=1e-6)
