"""The shipped material tables against measurements, and the messages of every refusal."""

import csv
import os
from pathlib import Path

import numpy as np
import pytest
from support import shared_data

from thermorender.apps.material_tables.compare import covers
from thermorender.apps.material_tables.from_samples import from_samples, read_selection
from thermorender.apps.material_tables.samples import read_ecostress, read_sample
from thermorender.errors import ThermorenderError
from thermorender.materials.csv_tables import INDEX_COLUMNS
from thermorender.materials.library import find, load_library
from thermorender.materials.material import grey
from thermorender.materials.store import store, write_material, write_materials
from thermorender.paths import data_folder

# Names that the first scenes use; they must not disappear.
FIRST_NAMES = (
    "grass_green grass_dry heath_shrub conifer broadleaf leaf_litter bark soil_loam soil_dark sand_quartz "
    "granite limestone basalt asphalt concrete roof_shingle roof_slate roof_rubber glass paint_black "
    "paint_metallic wood water snow ice brass"
).split()
LIBRARY = load_library()
NAMES = tuple(LIBRARY)
MEASURED = tuple(name for name, material in LIBRARY.items() if material.directional == "lambertian")
SINGLE = tuple(name for name in MEASURED if LIBRARY[name].samples == 1)


@pytest.fixture(scope="module")
def library():
    return load_library()


@pytest.fixture
def spectra():
    return shared_data("emissivity/ecostress/spectra")


@pytest.fixture
def slum():
    return shared_data("emissivity/slum")


def band_emissivity(wavelength_um, emissivity, lower_um=7.5, upper_um=13.5, temperature=300.0):
    """Independent of the package: Simpson's rule on 8 parts between every two points, CODATA c2.

    Linear between the points, so nothing is left out; on parts this short the rule's error is below 1e-12.
    """
    points = wavelength_um[(wavelength_um > lower_um) & (wavelength_um < upper_um)]
    points = np.concatenate([[lower_um], points, [upper_um]])
    fine = (points[:-1, None] + np.diff(points)[:, None] * np.linspace(0.0, 1.0, 9)).astype(float)
    simpson = np.diff(points)[:, None] * np.array([1, 4, 2, 4, 2, 4, 2, 4, 1]) / 24.0
    weight = simpson * fine**-5.0 / np.expm1(14387.76877 / (fine * temperature))
    return (weight * np.interp(fine, wavelength_um, emissivity)).sum() / weight.sum()


def raw_spectrum(path):
    """Wavelength [µm], rising, and emissivity of an ECOSTRESS file, read without the package."""
    rows = []
    for line in path.read_text(encoding="latin-1").splitlines()[15:]:
        cells = line.split()
        if len(cells) == 2 and cells[0][:1].isdigit():
            rows.append((float(cells[0]), 1.0 - float(cells[1]) / 100.0))
    return np.array(sorted(rows)).T


def raw_slum(folder, reference):
    """Wavelength [µm] and emissivity of one column of the SLUM table, read without the package."""
    file, _, column = reference.partition("#")
    table = np.genfromtxt(folder / file, delimiter=",", names=True, deletechars="")
    return table["wavelength"], table[column]


# --- the shipped tables -----------------------------------------------------------------------------------


def test_library_has_fifty_materials_and_keeps_the_first_names(library):
    assert len(library) >= 50 and set(FIRST_NAMES) <= set(library)


def test_the_pages_state_which_tables_cover_a_band(library):
    page = (data_folder("materials") / "README.md").read_text("utf-8")
    guide = (Path(__file__).parents[2] / "docs" / "guides" / "materials.md").read_text("utf-8")
    bands = ((7.5, 13.5), (3.7, 4.8), (3.1, 4.8))
    without = [sorted(name for name, material in library.items() if not covers(material, band)) for band in bands]
    counts = [len(library) - len(names) for names in without]
    for (lower, upper), count in zip(bands, counts, strict=True):
        assert f"| {lower:g}–{upper:g} µm | {count} |" in page
    assert f"of {len(library)} |" in page and without[1] == without[2]
    assert f"Without the mid-wave: {', '.join(f'`{name}`' for name in without[1])}." in page
    words = f"{counts[0]} of the tables cover the 7.5–13.5 µm of the shipped cameras, and {counts[2]} the mid-wave"
    assert words in guide


@pytest.mark.parametrize("name", NAMES)
def test_shipped_material_is_complete(library, name):
    material = library[name]
    first, last = material.valid_range_um
    assert (first <= 3.0 or name == "silica_fused") == (".spectrum.txt" in material.source or ".yml" in material.source)
    assert first <= 8.0 and last >= 12.5 and not material.gaps_um
    if first > 7.0 or last < 14.0:
        assert "refuses it" in material.note
    assert np.diff(material.wavelength_um).max() < 0.0501
    assert np.all((material.emissivity >= 0.0) & (material.emissivity <= 1.0))
    assert material.licence and material.title and "doi:10." in material.citation and "assumed" in material.note
    assert 250.0 < material.temperature < 350.0


@pytest.mark.parametrize("name", MEASURED)
def test_spread_and_sources_of_measured_materials(library, name):
    material = library[name]
    # One sample gives no spread, and the table must not say 0.
    assert np.isnan(material.emissivity_std).all() == (material.samples == 1)
    ecostress = material.source.count(".spectrum.txt")
    assert ecostress + material.source.count("#") == material.samples
    if ecostress:
        assert "doi:10.1016/j.rse.2008.11.007" in material.citation
        assert "doi:10.1016/j.rse.2019.05.015" in material.citation
    if ecostress < material.samples:
        assert "doi:10.1016/j.isprsjprs.2014.05.005" in material.citation


def test_every_spectrum_has_a_row():
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
def test_band_emissivity_equals_independent_integration(library, name):
    """Over three cameras' bands and three temperatures, to 1e-10: the weight follows band and temperature."""
    material = library[name]
    for band in ((7.5, 13.5), (8.0, 14.0), (8.0, 12.5)):
        if band[0] < material.valid_range_um[0] or band[1] > material.valid_range_um[1]:
            continue
        for temperature in (250.0, 300.0, 600.0):
            expected = band_emissivity(material.wavelength_um, material.emissivity, *band, temperature)
            assert material.band_emissivity(*band, temperature) == pytest.approx(expected, abs=1e-10)


@pytest.mark.parametrize("name", MEASURED)
def test_table_equals_independent_integration_of_its_samples(library, spectra, slum, name):
    """The mean over the raw spectra at their own sampling, to 1e-6: the table loses nothing."""
    material = library[name]
    files = [part.rpartition(": ")[2] for part in material.source.split("; ")]
    raw = [raw_slum(slum, file) if "#" in file else raw_spectrum(spectra / file) for file in files]
    for band in ((7.5, 13.5), (8.0, 14.0), (8.0, 12.5)):
        if band[0] < material.valid_range_um[0] or band[1] > material.valid_range_um[1]:
            continue
        if all(x[0] <= band[0] + 0.005 and x[-1] >= band[1] - 0.005 for x, _ in raw):
            expected = np.mean([band_emissivity(*spectrum, *band) for spectrum in raw])
            assert material.band_emissivity(*band, 300.0) == pytest.approx(expected, abs=1e-6), band


@pytest.mark.parametrize("name", [name for name in MEASURED if LIBRARY[name].valid_range_um[0] <= 3.0])
def test_mid_wave_equals_independent_integration_of_its_samples(library, spectra, name):
    """In a surface's own light and in reflected sunlight; below 8 µm the mean is over the samples from ECOSTRESS."""
    material = library[name]
    files = [part.rpartition(": ")[2] for part in material.source.split("; ")]
    raw = [raw_spectrum(spectra / file) for file in files if "#" not in file]
    for *band, within in ((3.5, 5.0, 1e-5), (3.7, 4.8, 2e-4), (3.1, 4.8, 2e-4), (3.0, 3.2, 5e-4)):
        for temperature in (300.0, 5778.0):
            expected = np.mean([band_emissivity(*spectrum, *band, temperature) for spectrum in raw])
            assert material.band_emissivity(*band, temperature) == pytest.approx(expected, abs=within), band


def test_spread_is_unknown_where_the_band_has_a_single_sample(library):
    """One clay tile was measured below 8 µm, and eight from there on."""
    tile = library["roof_tile_clay"]
    assert np.isnan(tile.band_emissivity_std(3.7, 4.8, 300.0)) and tile.band_emissivity_std(7.5, 13.5, 300.0) > 0.005
    assert np.isnan(library["tarmac"].band_emissivity_std(3.7, 4.8, 300.0))


def test_reader_reproduces_the_published_value_of_every_selected_sample(spectra):
    with open(shared_data("emissivity/curated_materials.csv"), encoding="utf-8") as file:
        published = {row["ecostress_file"]: row for row in csv.DictReader(file)}
    with open(data_folder("materials") / "selection.csv", encoding="utf-8") as file:
        files = [row["file"] for row in csv.DictReader(file) if "#" not in row["file"]]
    assert len(files) > 60
    for file in files:
        sample = read_ecostress(spectra / file)
        if sample.wavelength_um[-1] < 13.5:
            continue
        expected = float(published[file]["eps_band_planck300K_7p5_13p5"])
        found = band_emissivity(sample.wavelength_um, 1.0 - sample.reflectance)
        assert found == pytest.approx(expected, abs=5e-4), file


@pytest.mark.slow
def test_shipped_tables_equal_the_importers_output(tmp_path, spectra, slum):
    shipped = data_folder("materials")
    write_materials(read_selection(shipped / "selection.csv", [spectra, slum]), tmp_path)
    with open(tmp_path / "index.csv", encoding="utf-8") as made, open(shipped / "index.csv", encoding="utf-8") as there:
        rows = {row["name"]: row for row in csv.DictReader(there)}
        for row in csv.DictReader(made):
            assert rows[row["name"]] == row | {"rms_slope": ""}
    for name in MEASURED:
        made = (tmp_path / "spectra" / f"{name}.csv").read_text("utf-8").splitlines()
        there = (shipped / "spectra" / f"{name}.csv").read_text("utf-8").splitlines()
        assert len(made) == len(there) and made[0] == there[0]
        for found, expected in zip(made[1:], there[1:], strict=True):
            # Rounding of the last digit may differ on another machine.
            found, expected = ([float(cell or "nan") for cell in line.split(",")] for line in (found, expected))
            np.testing.assert_allclose(found, expected, atol=1.1e-5)


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
    [(14.5, "14.5 µm"), ([2.9, 8.0], "2.9–8 µm"), (np.nan, "NaN"), (14.0 + 1e-6, "14 µm")],
)
def test_unmeasured_wavelengths_are_refused(library, asked, words):
    with pytest.raises(ThermorenderError, match=r"'water'.* was measured over 3–14 µm only") as error:
        library["water"].emissivity_at(asked)
    assert words in str(error.value)


def test_rounding_at_the_end_of_a_table_is_accepted(library):
    assert library["water"].emissivity_at(np.nextafter(14.0, 15.0)) == library["water"].emissivity[-1]


def test_lambertian_material_is_the_same_from_every_direction(library):
    sand = library["sand_quartz"]
    found = sand.emissivity_at_angle([[8.2], [9.0], [11.0]], [0.0, 0.3, 1.0])
    np.testing.assert_array_equal(found, np.repeat(sand.emissivity_at([[8.2], [9.0], [11.0]]), 3, axis=1))


def test_hemispherical_emissivity_is_the_mean_over_directions(library):
    water = library["water_fresnel"]
    cosine, weight = np.polynomial.legendre.leggauss(200)
    cosine, weight = 0.5 * (cosine + 1.0), 0.5 * weight
    for wavelength in (8.0, 10.03, 12.5):
        expected = (2.0 * weight * cosine * water.emissivity_at_angle(wavelength, cosine)).sum()
        assert water.emissivity_at(wavelength) == pytest.approx(expected, abs=2e-5)
    assert water.emissivity_at_angle(10.0, 1.0).shape == ()
    assert water.emissivity_at_angle(np.full((4, 1), 10.0), np.linspace(0.0, 1.0, 3)).shape == (4, 3)


@pytest.mark.parametrize("cosine", [1.01, -0.1, np.nan])
def test_invalid_angles_are_refused(library, cosine):
    with pytest.raises(ThermorenderError, match=r"'water_fresnel' was asked .* at cos_theta=.*0 \(grazing\) to 1"):
        library["water_fresnel"].emissivity_at_angle(10.0, [0.5, cosine])


def test_roughness_raises_grazing_emissivity(library):
    smooth, rough = library["water_fresnel"], library["water_breeze"]
    assert rough.emissivity_at_angle(11.0, 0.1) > smooth.emissivity_at_angle(11.0, 0.1) + 0.1
    assert rough.emissivity_at_angle(11.0, 1.0) == pytest.approx(smooth.emissivity_at_angle(11.0, 1.0), abs=1e-3)
    assert "hemispherical, fresnel, rms slope 0.1691" in str(rough) and "fresnel, smooth" in str(smooth)


def test_grey_is_constant_at_all_wavelengths():
    material = grey("wall", 0.9)
    np.testing.assert_array_equal(material.emissivity_at([0.0, 3.7, 10.0, 1000.0]), 0.9)
    with pytest.raises(ThermorenderError, match=r"emissivity=1.2 of grey material 'wall' is not within 0…1"):
        grey("wall", 1.2)


def test_printed_material_names_source_and_range(library):
    text = str(library["granite"])
    for words in ("granite: Granite", "3–14 µm", "at 9.", "2 samples", "10.1016", "free, cite", "K by day"):
        assert words in text
    assert "unknown, one sample" in str(library["glass"])


def test_arrays_are_read_only(library):
    with pytest.raises(ValueError, match="read-only"):
        library["water"].emissivity[0] = 0.5


def test_unknown_material_error_names_the_place_and_the_closest(library):
    assert find(library, "granite", "here").name == "granite"
    words = r"""object "marker" uses material 'paint_blak'.*closest are paint_black"""
    with pytest.raises(ThermorenderError, match=words):
        find(library, "paint_blak", 'scene.toml, object "marker"')
    with pytest.raises(ThermorenderError, match="it holds aluminium_polished, aluminium_sheet"):
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


def test_a_scenes_own_folder_overrides_the_shipped_one(tmp_path, library):
    both = load_library(write_library(tmp_path / "m", [ROW, ROW | {"name": "water", "title": "Mine"}]))
    assert sorted(both) == sorted([*NAMES, "tin"])
    assert both["water"].title == "Mine" and library["water"].title != "Mine"
    assert both["tin"].emissivity_at(10.5) == pytest.approx(0.25)
    assert np.isnan(both["tin"].emissivity_std[0]) and both["tin"].emissivity_std[1] == 0.01
    assert both["tin"].colour == (200, 200, 205)


def test_empty_rows_of_spreadsheets_are_ignored(tmp_path):
    folder = write_library(tmp_path / "m", spectrum=SPECTRUM + ",,\n")
    assert load_library(folder)["tin"].wavelength_um.size == 2


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"source": ""}, r"index.csv, row 2: source of material 'tin' is empty"),
        ({"licence": " "}, r"row 2: licence of material 'tin' is empty"),
        ({"directional": "mirror"}, r"row 2: directional='mirror' is not known; write lambertian or fresnel or table"),
        ({"temperature_k": "21"}, r"row 2: temperature_k=21 is not within 100…6000; .*add 273.15"),
        ({"temperature_k": "warm"}, r"row 2: temperature_k='warm' is not a number"),
        ({"solar_absorptance": "40"}, r"row 2: solar_absorptance=40 is not within 0…1; .*0.7 for 70 %"),
        ({"colour_g": "256"}, r"row 2: colour_g=256 is not within 0…255"),
        ({"samples": "0"}, r"row 2: samples=0 is not within 1…"),
        ({"name": "../tin"}, r"row 2: name='../tin' is not a material name"),
    ],
)
def test_faults_of_the_index_are_reported(tmp_path, change, words):
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
        ("7,0.2,", r"tin.csv holds 1 rows of data; a spectrum needs at least 2"),
    ],
)
def test_faults_of_a_spectrum_are_reported(tmp_path, rows, words):
    spectrum = f"wavelength_um,emissivity,emissivity_std\n{rows}\n"
    with pytest.raises(ThermorenderError, match=words):
        load_library(write_library(tmp_path / "m", spectrum=spectrum))


def test_faults_of_a_folder_are_reported(tmp_path):
    with pytest.raises(ThermorenderError, match=r"index.csv does not exist; a materials folder holds"):
        load_library(tmp_path / "nowhere")
    with pytest.raises(ThermorenderError, match=r"row 1 lacks column source, licence \(found: name"):
        columns = [column for column in INDEX_COLUMNS if column not in ("source", "licence")]
        load_library(write_library(tmp_path / "columns", columns=columns))
    with pytest.raises(ThermorenderError, match=r"row 3: material 'tin' is listed twice"):
        load_library(write_library(tmp_path / "twice", [ROW, ROW]))
    folder = write_library(tmp_path / "encoding")
    (folder / "spectra" / "tin.csv").write_bytes(SPECTRUM.encode() + b"15,0.3,\xb5\n")
    with pytest.raises(ThermorenderError, match=r"tin.csv is not UTF-8 text .*; save it as 'CSV UTF-8'"):
        load_library(folder)
    (folder / "spectra" / "tin.csv").unlink()
    with pytest.raises(ThermorenderError, match=r"tin.csv does not exist"):
        load_library(folder)


def test_link_out_of_the_folder_is_refused(tmp_path):
    folder = write_library(tmp_path / "m")
    (tmp_path / "elsewhere.csv").write_text(SPECTRUM)
    (folder / "spectra" / "tin.csv").unlink()
    (folder / "spectra" / "tin.csv").symlink_to(tmp_path / "elsewhere.csv")
    with pytest.raises(ThermorenderError, match=r"tin.csv leads out of .*; put the file itself into the folder"):
        load_library(folder)


def test_gap_in_a_table_is_not_interpolated(tmp_path):
    rows = [f"{w:.2f},0.9," for w in np.arange(7.0, 14.01, 0.1) if not 9.05 < w < 10.35]
    folder = write_library(tmp_path / "m", spectrum="\n".join(["wavelength_um,emissivity,emissivity_std", *rows]))
    holed = load_library(folder)["tin"]
    np.testing.assert_allclose(holed.emissivity_at([9.0, 10.4, 12.03]), 0.9)
    with pytest.raises(ThermorenderError, match=r"at 9.5 µm, but its table has no row between 9 and 10.4 µm"):
        holed.emissivity_at([8.0, 9.5])
    with pytest.raises(ThermorenderError, match=r"has no row between 9 and 10.4"):
        holed.band_emissivity(7.5, 13.5, 300.0)


def test_tables_by_angle(tmp_path):
    """Emissivity linear in the cosine: its hemispherical mean has the closed form a + 2/3 b."""
    angles = [0, 20, 40, 60, 80, 90]
    header = "wavelength_um," + ",".join(f"at_{angle}" for angle in angles)
    cells = ",".join(f"{0.3 + 0.6 * np.cos(np.radians(angle)):.9f}" for angle in angles)
    folder = write_library(tmp_path / "m", [ROW | {"directional": "table"}], f"{header}\n7,{cells}\n14,{cells}\n")
    tin = load_library(folder)["tin"]
    assert tin.emissivity_at(10.0) == pytest.approx(0.3 + 0.6 * 2.0 / 3.0, abs=1e-8)
    assert tin.emissivity_at_angle(10.0, 0.25) == pytest.approx(0.3 + 0.6 * 0.25, abs=1e-8)
    assert "from 6 angles" in str(tin)


@pytest.mark.parametrize(
    ("directional", "spectrum", "words"),
    [
        ("table", "wavelength_um,at_0,at_60\n7,0.9,0.8\n14,0.9,0.8\n", r"row 1 lacks column at_90"),
        ("table", "wavelength_um,at_0,at_90,at_95\n7,0.9,0,0\n14,0.9,0,0\n", r"at_95 is beyond 90 degrees"),
        ("table", "wavelength_um,at_0,at_90\n7,0.9,0\n14,90,0\n", r"row 3: at_0=90 is not within 0…1; divide by 100"),
        ("fresnel", "wavelength_um,n\n7,1.3\n14,1.2\n", r"row 1 lacks column k"),
        ("fresnel", "wavelength_um,n,k\n7,1.3,-0.1\n14,1.2,0.2\n", r"row 2: k=-0.1 is not within 0…1000; give"),
        ("fresnel", "wavelength_um,n,k,k\n7,1.3,0.1,1\n14,1.2,0.2,1\n", r"row 1 holds column k twice"),
    ],
)
def test_faults_of_directional_tables_are_reported(tmp_path, directional, spectrum, words):
    with pytest.raises(ThermorenderError, match=words):
        load_library(write_library(tmp_path / "m", [ROW | {"directional": directional}], spectrum))


def test_user_defined_rough_fresnel_material(tmp_path):
    columns = [*INDEX_COLUMNS, "rms_slope"]
    spectrum = "wavelength_um,n,k\n7,1.5,0\n14,1.5,0\n"
    row = ROW | {"directional": "fresnel", "rms_slope": ""}
    smooth = load_library(write_library(tmp_path / "a", [row], spectrum, columns))["tin"]
    assert smooth.emissivity_at_angle(10.0, 1.0) == pytest.approx(0.96, abs=1e-12)
    with pytest.raises(ThermorenderError, match=r"row 2: rms_slope=2 is not within 0…0.5"):
        load_library(write_library(tmp_path / "b", [row | {"rms_slope": "2"}], spectrum, columns))


# --- written files ------------------------------------------------------------------------------------------


def test_a_material_that_emits_by_angle_is_written_with_its_table(tmp_path):
    spectrum = "wavelength_um,at_0,at_60,at_90\n7,0.9,0.85,0\n14,0.95,0.9,0\n"
    folder = write_library(tmp_path / "m", [ROW | {"directional": "table"}], spectrum)
    for each in (load_library()["glass_fresnel"], load_library(folder)["tin"]):
        write_material(each, tmp_path / "copies")
        read = load_library(tmp_path / "copies")[each.name]
        np.testing.assert_array_equal(read.emissivity_by_angle, each.emissivity_by_angle)
        np.testing.assert_array_equal(read.cosines, each.cosines)
        assert read.table == each.table


def test_writing_keeps_other_rows_and_user_columns(tmp_path):
    folder = write_library(tmp_path / "m", [ROW | {"shop": "Smith"}], columns=[*INDEX_COLUMNS, "shop"])
    write_material(grey("wall", 0.9), folder)
    with pytest.raises(ThermorenderError, match="already holds material 'wall'; choose another name, or set replace"):
        write_material(grey("wall", 0.8), folder)
    assert load_library(folder)["wall"].emissivity_at(10.0) == 0.9
    write_material(grey("wall", 0.8), folder, replace=True)
    with open(folder / "index.csv", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["name"] for row in rows] == ["tin", "wall"] and rows[0]["shop"] == "Smith"
    assert load_library(folder)["wall"].emissivity_at(10.0) == 0.8


def test_failed_write_leaves_the_folder_unchanged(tmp_path, monkeypatch):
    folder = write_library(tmp_path / "m")
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    row = ROW | {"name": "zinc"}
    with pytest.raises(ThermorenderError, match=r"m/spectra/zinc.csv, row 2: emissivity=9 is not within 0…1"):
        store(row, SPECTRUM.replace("0.2", "9"), folder)
    with pytest.raises(ThermorenderError, match=r"licence of material 'zinc' is empty"):
        store(row | {"licence": ""}, SPECTRUM, folder)
    with pytest.raises(ThermorenderError, match=r"name='../zinc' is not a material name"):
        store(row | {"name": "../zinc"}, SPECTRUM, folder)

    replace = os.replace

    def full_disk(source, target):
        if Path(target) == folder / "index.csv":
            raise OSError(28, "No space left on device")
        return replace(source, target)

    monkeypatch.setattr(os, "replace", full_disk)
    for name, overwrite in (("zinc", False), ("tin", True)):
        with pytest.raises(ThermorenderError, match=r"index.csv cannot be written: No space left"):
            store(ROW | {"name": name}, SPECTRUM.replace("0.2", "0.25"), folder, overwrite)
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


def test_thinned_table_stays_within_0_and_1(tmp_path):
    """A spectrum that touches 100 % between the table's points is followed without exceeding it."""
    wavelength = np.linspace(6.9, 14.1, 1500)
    percent = 3.0 + 3.0 * np.sign(np.sin(40.0 * wavelength))
    rows = "".join(f"{w:.4f},{p:.4f}\n" for w, p in zip(wavelength, percent, strict=True))
    (tmp_path / "a.csv").write_text("wavelength_um,reflectance_percent\n" + rows)
    rock = from_samples([read_sample(tmp_path / "a.csv")], "rock", solar_absorptance=0.5)
    assert rock.emissivity.max() <= 1.0
    written = np.round(1.0 - np.round(percent, 4) / 100.0, 6)
    expected = band_emissivity(np.round(wavelength, 4), written, 8.0, 13.0)
    assert rock.band_emissivity(8.0, 13.0, 300.0) == pytest.approx(expected, abs=2e-5)
