"""The shipped material tables against measurements, and the words of every refusal."""

import csv
from pathlib import Path

import numpy as np
import pytest
from conftest import shared_data

from thermorender.errors import ThermorenderError
from thermorender.paths import data_folder
from thermorender.scene.material_import import from_ecostress, main, read_ecostress, write_material
from thermorender.scene.materials import INDEX_COLUMNS, find, grey, load_library

NAMES = (
    "grass_green grass_dry heath_shrub conifer broadleaf leaf_litter bark soil_loam soil_dark sand_quartz "
    "granite limestone basalt asphalt concrete roof_shingle roof_slate roof_rubber glass paint_black "
    "paint_metallic wood water snow ice brass"
).split()


@pytest.fixture(scope="module")
def library():
    return load_library()


@pytest.fixture
def spectra():
    return shared_data("emissivity/ecostress/spectra")


def band_emissivity(wavelength_um, emissivity):
    """Independent of the package: 7.5-13.5 µm, 300 K, Simpson's rule in wavenumber, CODATA c2."""
    wavenumber = np.linspace(1e4 / 13.5, 1e4 / 7.5, 8001)
    planck = wavenumber**3 / np.expm1(1.438776877 * wavenumber / 300.0)
    weight = np.where(np.arange(wavenumber.size) % 2, 4.0, 2.0) * planck
    weight[[0, -1]] /= 2.0
    return (weight * np.interp(1e4 / wavenumber, wavelength_um, emissivity)).sum() / weight.sum()


def raw_spectrum(path):
    """The numbers of an ECOSTRESS file without the package's reader: wavelength [µm] rising, emissivity."""
    rows = []
    for line in path.read_text(encoding="latin-1").splitlines()[15:]:
        cells = line.split()
        if len(cells) == 2 and cells[0][:1].isdigit():
            rows.append((float(cells[0]), 1.0 - float(cells[1]) / 100.0))
    return np.array(sorted(rows)).T


# --- the shipped tables -----------------------------------------------------------------------------------


def test_all_agreed_names_are_there_and_nothing_else(library):
    assert sorted(library) == sorted(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_shipped_material_is_complete(library, name):
    material = library[name]
    first, last = material.valid_range_um
    assert first <= 7.0 and last >= 14.0
    assert np.diff(material.wavelength_um).max() < 0.0501
    assert np.all((material.emissivity >= 0.0) & (material.emissivity <= 1.0))
    # One sample says nothing about the spread, and the table must not say 0.
    assert np.isnan(material.emissivity_std).all() == (material.samples == 1)
    assert material.source.count(".spectrum.txt") == material.samples
    assert "doi:10.1016/j.rse.2008.11.007" in material.citation
    assert "doi:10.1016/j.rse.2019.05.015" in material.citation
    assert material.licence and material.title and "assumed" in material.note
    assert 250.0 < material.temperature < 350.0


def test_no_spectrum_lies_around_without_a_row():
    assert sorted(path.stem for path in (data_folder("materials") / "spectra").glob("*.csv")) == sorted(NAMES)


# Band emissivities at 300 K over 7.5-13.5 µm of single ECOSTRESS samples, integrated at their own sampling.
@pytest.mark.parametrize(
    ("name", "expected"),
    [("sand_quartz", 0.9354), ("roof_slate", 0.8564), ("glass", 0.8669), ("wood", 0.9477), ("ice", 0.9738),
     ("brass", 0.1256), ("paint_metallic", 0.4108)],
)  # fmt: skip
def test_published_values_of_single_samples(library, name, expected):
    material = library[name]
    assert band_emissivity(material.wavelength_um, material.emissivity) == pytest.approx(expected, abs=2e-4)


def test_quartz_doublet_is_resolved(library):
    """Quartz has two reststrahlen bands, near 8.2 and 9.0 µm, and a rise near 8.6 µm between them."""
    left, between, right = library["sand_quartz"].emissivity_at([8.2, 8.65, 8.9])
    assert left < between - 0.05 and right < between - 0.02


@pytest.mark.parametrize("name", NAMES)
def test_table_equals_independent_integration_of_its_samples(library, spectra, name):
    material = library[name]
    files = material.source.partition(": ")[2].split("; ")
    singles = [band_emissivity(*raw_spectrum(spectra / file)) for file in files]
    found = band_emissivity(material.wavelength_um, material.emissivity)
    assert found == pytest.approx(np.mean(singles), abs=5e-5)
    start, end = zip(*(raw_spectrum(spectra / file)[0][[0, -1]] for file in files), strict=True)
    assert max(start) <= 7.0 and min(end) >= 14.0


def test_reader_reproduces_the_published_value_of_every_selected_sample(spectra):
    with open(shared_data("emissivity/curated_materials.csv"), encoding="utf-8") as file:
        published = {row["ecostress_file"]: row for row in csv.DictReader(file)}
    with open(data_folder("materials") / "selection.csv", encoding="utf-8") as file:
        files = [row["file"] for row in csv.DictReader(file)]
    assert len(files) > 60
    for file in files:
        sample = read_ecostress(spectra / file)
        expected = float(published[file]["eps_band_planck300K_7p5_13p5"])
        found = band_emissivity(sample.wavelength_um, 1.0 - sample.reflectance)
        assert found == pytest.approx(expected, abs=5e-4), file


def test_shipped_tables_are_what_the_importer_writes(tmp_path, spectra):
    shipped = data_folder("materials")
    assert main([str(spectra), str(shipped / "selection.csv"), str(tmp_path)]) == 0
    for file in ["index.csv", *(f"spectra/{name}.csv" for name in NAMES)]:
        assert (tmp_path / file).read_text("utf-8") == (shipped / file).read_text("utf-8")


# --- a material -------------------------------------------------------------------------------------------


def test_interpolation_is_exact_at_the_nodes_and_linear_between(library):
    quartz = library["sand_quartz"]
    np.testing.assert_array_equal(quartz.emissivity_at(quartz.wavelength_um), quartz.emissivity)
    middle = 0.5 * (quartz.wavelength_um[1:] + quartz.wavelength_um[:-1])
    np.testing.assert_allclose(
        quartz.emissivity_at(middle), 0.5 * (quartz.emissivity[1:] + quartz.emissivity[:-1]), rtol=1e-12
    )
    assert quartz.emissivity_at(9.0).shape == ()
    assert quartz.emissivity_at(np.full((2, 3), 9.0)).shape == (2, 3)


@pytest.mark.parametrize(
    ("asked", "words"),
    [(14.5, "14.5 µm"), ([3.0, 8.0], "3–8 µm"), (np.nan, "NaN"), (14.0 + 1e-6, "14 µm")],
)
def test_wavelengths_never_measured_are_refused(library, asked, words):
    with pytest.raises(ThermorenderError, match=r"'water'.* was measured over 3.2–14 µm only") as error:
        library["water"].emissivity_at(asked)
    assert words in str(error.value)


def test_rounding_beside_the_end_of_a_table_is_not_refused(library):
    assert library["water"].emissivity_at(np.nextafter(14.0, 15.0)) == library["water"].emissivity[-1]


def test_grey_is_constant_and_knows_no_other_wavelengths():
    material = grey("wall", 0.9)
    np.testing.assert_array_equal(material.emissivity_at([0.0, 3.7, 10.0, 1000.0]), 0.9)
    with pytest.raises(ThermorenderError, match="emissivity=1.2 of grey material 'wall' is not within 0…1"):
        grey("wall", 1.2)


def test_printing_teaches(library):
    text = str(library["granite"])
    for words in ("granite: Granite", "3.2–14 µm", "at 9.", "2 samples", "10.1016", "free, cite", "K by day"):
        assert words in text
    assert "unknown, one sample" in str(library["glass"])


def test_arrays_cannot_be_changed(library):
    with pytest.raises(ValueError, match="read-only"):
        library["water"].emissivity[0] = 0.5


def test_unknown_material_names_the_place_and_the_closest(library):
    assert find(library, "granite", "here").name == "granite"
    words = r"""object "marker" uses material 'paint_blak'.*closest are paint_black"""
    with pytest.raises(ThermorenderError, match=words):
        find(library, "paint_blak", 'scene.toml, object "marker"')
    with pytest.raises(ThermorenderError, match="it holds asphalt, bark"):
        find(library, "zzz", "scene.toml")


# --- tables a person wrote ---------------------------------------------------------------------------------

ROW = {
    "name": "tin", "title": "Tin roof", "colour_r": "200", "colour_g": "200", "colour_b": "205",
    "solar_absorptance": "0.4", "directional": "lambertian", "temperature_k": "310", "samples": "1",
    "source": "own measurement", "citation": "none", "licence": "CC0", "note": "",
}  # fmt: skip
SPECTRUM = "wavelength_um,emissivity,emissivity_std\n7,0.2,\n14,0.3,0.01\n"


def write_library(folder, rows=(ROW,), spectrum=SPECTRUM, columns=INDEX_COLUMNS):
    (folder / "spectra").mkdir(parents=True)
    with open(folder / "index.csv", "w", newline="", encoding="utf-8-sig") as file:
        writer = csv.DictWriter(file, columns, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)
    for row in rows:
        (folder / "spectra" / f"{Path(row['name']).name}.csv").write_text(spectrum, encoding="utf-8")
    return folder


def test_a_scenes_own_folder_lies_over_the_shipped_one(tmp_path, library):
    both = load_library(write_library(tmp_path / "m", [ROW, ROW | {"name": "water", "title": "Mine"}]))
    assert sorted(both) == sorted([*NAMES, "tin"])
    assert both["water"].title == "Mine" and library["water"].title != "Mine"
    assert both["tin"].emissivity_at(10.5) == pytest.approx(0.25)
    assert np.isnan(both["tin"].emissivity_std[0]) and both["tin"].emissivity_std[1] == 0.01
    assert both["tin"].colour == (200, 200, 205)


def test_spreadsheets_leave_empty_rows_behind(tmp_path):
    folder = write_library(tmp_path / "m", spectrum=SPECTRUM + ",,\n")
    assert load_library(folder)["tin"].wavelength_um.size == 2


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"source": ""}, r"index.csv, row 2: source of material 'tin' is empty"),
        ({"licence": " "}, r"row 2: licence of material 'tin' is empty"),
        ({"directional": "mirror"}, r"row 2: directional='mirror' is not known; write lambertian"),
        ({"temperature_k": "21"}, r"row 2: temperature_k=21 is below 100 K.*add 273.15"),
        ({"temperature_k": "warm"}, r"row 2: temperature_k='warm' is not a number"),
        ({"solar_absorptance": "40"}, r"row 2: solar_absorptance=40 is not within 0…1; .*0.7 for 70 %"),
        ({"colour_g": "256"}, r"row 2: colour_g=256 is not within 0…255"),
        ({"samples": "0"}, r"row 2: samples=0 is not within 1…"),
        ({"name": "../tin"}, r"row 2: name='../tin' is not a material name"),
    ],
)
def test_faults_of_the_index_are_told(tmp_path, change, words):
    with pytest.raises(ThermorenderError, match=words):
        load_library(write_library(tmp_path / "m", [ROW | change]))


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ("7,1.2,\n14,0.3,", r"tin.csv, row 2: emissivity=1.2 is not within 0…1; divide by 100"),
        ("7,nan,\n14,0.3,", r"row 2: emissivity=nan is not within 0…1"),
        ("7,0.2,\n14,n/a,", r"row 3: emissivity='n/a' is not a number.*point as decimal mark"),
        ('7,0.2,\n14,"0,3",', r"row 3: emissivity='0,3' is not a number"),
        ("14,0.2,\n7,0.3,", r"row 3: wavelength_um=7 is less than the row above \(14\); sort the table"),
        ("7,0.2,\n7,0.3,", r"row 3: wavelength_um=7 repeats the row above \(7\)"),
        ("7000,0.2,\n14000,0.3,", r"row 2: wavelength_um=7000 is not within 0…1000; .*nanometres"),
        ("7,0.2,-1\n14,0.3,", r"row 2: emissivity_std=-1 is not within 0…1"),
        ("7,0.2,", r"tin.csv holds 1 rows of data; a spectrum needs 2"),
    ],
)
def test_faults_of_a_spectrum_are_told(tmp_path, rows, words):
    spectrum = f"wavelength_um,emissivity,emissivity_std\n{rows}\n"
    with pytest.raises(ThermorenderError, match=words):
        load_library(write_library(tmp_path / "m", spectrum=spectrum))


def test_faults_of_a_folder_are_told(tmp_path):
    with pytest.raises(ThermorenderError, match=r"index.csv does not exist; a materials folder holds"):
        load_library(tmp_path / "nowhere")
    with pytest.raises(ThermorenderError, match=r"row 1 lacks column source, licence \(found: name"):
        columns = [column for column in INDEX_COLUMNS if column not in ("source", "licence")]
        load_library(write_library(tmp_path / "columns", columns=columns))
    with pytest.raises(ThermorenderError, match=r"row 3: material 'tin' is listed twice"):
        load_library(write_library(tmp_path / "twice", [ROW, ROW]))
    with pytest.raises(ThermorenderError, match=r"tin.csv, row 1 is separated by semicolons; save it comma"):
        load_library(write_library(tmp_path / "semicolon", spectrum=SPECTRUM.replace(",", ";")))
    folder = write_library(tmp_path / "encoding")
    (folder / "spectra" / "tin.csv").write_bytes(SPECTRUM.encode() + b"15,0.3,\xb5\n")
    with pytest.raises(ThermorenderError, match=r"tin.csv is not UTF-8 text .*; save it as 'CSV UTF-8'"):
        load_library(folder)
    (folder / "spectra" / "tin.csv").unlink()
    with pytest.raises(ThermorenderError, match=r"tin.csv does not exist"):
        load_library(folder)


# --- the importer ------------------------------------------------------------------------------------------


def ecostress_file(
    path, wavelength, percent, measurement="Hemispherical reflectance", y_units="Reflectance (percent)"
):
    header = [
        "Name: Made-up rock", "Type: rock", "Description: at 10\xb0: rough", f"Measurement: {measurement}",
        "X Units: Wavelength (micrometers)", f"Y Units:{y_units}", "",
    ]  # fmt: skip
    lines = [f" {w:.4f}\t{p:.4f}" for w, p in zip(wavelength, percent, strict=True)]
    path.write_text("\n".join(header + lines) + "\n", encoding="latin-1")
    return path


def test_mean_and_spread_over_samples_that_fall_and_rise(tmp_path):
    coarse = np.linspace(2.0, 14.2, 123)
    fine = np.linspace(14.01, 0.4, 2001)
    paths = [
        ecostress_file(tmp_path / "a.txt", coarse, 10.0 + coarse),
        ecostress_file(tmp_path / "b.txt", fine, 12.0 + fine),
    ]
    rock = from_ecostress(paths, "rock", title="Rock", temperature=301.0)
    np.testing.assert_allclose(rock.wavelength_um, np.arange(64, 281) * 0.05)
    np.testing.assert_allclose(rock.emissivity[1:-1], 0.89 - rock.wavelength_um[1:-1] / 100, atol=1e-6)
    np.testing.assert_allclose(rock.emissivity_std[1:-1], np.sqrt(2.0) * 0.01, atol=2e-6)
    assert rock.samples == 2 and rock.source.endswith("a.txt; b.txt")
    # Only the second reaches into sunlight, where it reflects 12.4 to 14.5 %.
    assert 0.855 < rock.solar_absorptance < 0.876 and "from 1 of 2 samples" in rock.note
    write_material(rock, tmp_path / "m")
    back = load_library(tmp_path / "m")["rock"]
    np.testing.assert_allclose(back.emissivity, rock.emissivity, atol=5.1e-6)
    assert (back.title, back.temperature) == ("Rock", 301.0)
    assert (back.source, back.note) == (rock.source, rock.note)


def test_repeated_wavelengths_are_averaged_and_percent_becomes_a_share(tmp_path):
    path = ecostress_file(tmp_path / "a.txt", [14.0, 9.0, 9.0, 2.0], [10.0, 20.0, 40.0, 5.0])
    sample = read_ecostress(path)
    np.testing.assert_allclose(sample.wavelength_um, [2.0, 9.0, 14.0])
    np.testing.assert_allclose(sample.reflectance, [0.05, 0.30, 0.10])
    assert sample.name == "Made-up rock"


def test_writing_keeps_the_other_rows_and_a_persons_own_columns(tmp_path):
    folder = write_library(tmp_path / "m", [ROW | {"shop": "Smith"}], columns=[*INDEX_COLUMNS, "shop"])
    write_material(grey("wall", 0.9), folder)
    write_material(grey("wall", 0.8), folder)
    with open(folder / "index.csv", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["name"] for row in rows] == ["tin", "wall"] and rows[0]["shop"] == "Smith"
    assert load_library(folder)["wall"].emissivity_at(10.0) == 0.8


def test_samples_that_cannot_give_emissivity_are_refused(tmp_path):
    wavelength = np.linspace(2.0, 14.5, 200)

    def refused(words, *, wavelength=wavelength, percent=5.0, solar=0.5, **kwargs):
        path = ecostress_file(tmp_path / "a.txt", wavelength, percent + 0.0 * wavelength, **kwargs)
        with pytest.raises(ThermorenderError, match=words):
            from_ecostress([path], "rock", solar_absorptance=solar)

    short = np.linspace(2.0, 12.5, 99)
    refused(r"a.txt of material 'rock' covers 2–12.5 µm and 7–14 µm is needed", wavelength=short)
    refused(r"measured as 'Bidirectional'; .* leave the sample out", measurement="Bidirectional")
    refused(r"has reflectance -0.5 % at .* outside 0…100 % at", percent=-0.5)
    refused(r"no sample of material 'rock' covers 0.42–2.5 µm.*give an assumed value", solar=None)
    refused(r"y units 'Transmittance'; only wavelength in micrometres", y_units="Transmittance")
    with pytest.raises(ThermorenderError, match=r"b.txt does not exist; order the spectrum"):
        from_ecostress([tmp_path / "b.txt"], "rock")
    with pytest.raises(ThermorenderError, match=r"'rock' was given no sample"):
        from_ecostress([], "rock")


def test_command_tells_a_mistake_in_one_line(tmp_path, capsys):
    selection = tmp_path / "selection.csv"
    selection.write_text(
        "material,file,title,colour_r,colour_g,colour_b,solar_absorptance,temperature_k,note\n"
        "rock,a.txt,Rock,1,2,3,0.5,20,\n"
    )
    ecostress_file(tmp_path / "a.txt", np.linspace(2.0, 14.5, 200), np.full(200, 5.0))
    assert main([str(tmp_path), str(selection), str(tmp_path / "out")]) == 2
    assert "selection.csv, row 2: temperature_k=20 is not within 100…6000" in capsys.readouterr().err
    selection.write_text(selection.read_text().replace(",20,", ",300,"))
    assert main([str(tmp_path), str(selection), str(tmp_path / "out")]) == 0
    assert load_library(tmp_path / "out")["rock"].emissivity_at(10.0) == pytest.approx(0.95)
    assert main([]) == 2 and "usage" in capsys.readouterr().err
