"""The `thermorender materials …` commands as a user runs them, and the messages of their findings."""

import csv
import struct

import numpy as np
import pytest
from support import shared_data

from thermorender.apps.material_tables.check import check
from thermorender.apps.material_tables.compare import apparent_temperature
from thermorender.errors import ThermorenderError
from thermorender.materials.csv_tables import INDEX_COLUMNS
from thermorender.materials.library import load_library, read_library
from thermorender.materials.material import grey
from thermorender.paths import data_folder
from thermorender.physics.planck import band_radiance, brightness_temperature

ROW = {
    "name": "tin", "title": "Tin roof", "colour_r": "200", "colour_g": "200", "colour_b": "205",
    "solar_absorptance": "0.4", "directional": "lambertian", "temperature_k": "310", "samples": "1",
    "source": "own measurement", "citation": "none", "licence": "CC0", "note": "",
}  # fmt: skip
WAVELENGTH = np.round(np.arange(7.0, 14.01, 0.1), 2)
SPECTRUM = "wavelength_um,emissivity,emissivity_std\n" + "".join(f"{w},0.2,\n" for w in WAVELENGTH)


def library(folder, rows=(ROW,), spectrum=SPECTRUM):
    (folder / "spectra").mkdir(parents=True)
    with open(folder / "index.csv", "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(dict.fromkeys([*INDEX_COLUMNS, *rows[0]])))
        writer.writeheader()
        writer.writerows(rows)
    for row in rows:
        (folder / "spectra" / f"{row['name']}.csv").write_text(spectrum, encoding="utf-8")
    return folder


def content(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


# --- list, show, plot -------------------------------------------------------------------------------------


def test_list_and_show_print_band_emissivity(run):
    status, out, _ = run("list")
    assert status == 0 and f"{len(load_library())} materials" in out
    line = next(line for line in out.splitlines() if line.startswith("water_fresnel"))
    assert line.split()[1:3] == ["0.9421", "0.9863"]
    assert "not measured" in next(line for line in out.splitlines() if line.startswith("tarmac"))
    status, out, _ = run("list", "--band", "8,12")
    assert "not measured" not in out
    status, out, _ = run("show", "sand_quartz", "water_fresnel")
    band = load_library()["sand_quartz"].band_emissivity(7.5, 13.5, 300.0)
    assert status == 0 and f"{band:.6f} over 7.5–13.5 µm at 300 K" in out and "0.6657 at 80°" in out
    _, out, _ = run("show", "tarmac")
    assert "over 8–13.5 µm at 300 K; 7.5–13.5 µm is not all measured" in out


def test_mistakes_are_one_sentence_and_status_2(run, tmp_path):
    for arguments, words in (
        (("show", "watr"), "the closest are water"),
        (("list", "--band", "13,8"), "--band='13,8' is not a band"),
        (("list", "--band", "8"), "--band"),
        (("plot", "water", "-o", tmp_path / "a.jpg"), "give one that ends in .png"),
        (("plot", *["water"] * 9, "-o", tmp_path / "a.png"), "9 materials cannot be distinguished"),
        (("check", tmp_path / "nowhere"), "nowhere does not exist"),
        (("import", "--into", tmp_path), "needs spectrum files and --name"),
        (("list", "--library", tmp_path), "index.csv does not exist"),
    ):
        status, _, complaint = run(*arguments)
        assert status == 2 and words in complaint and complaint.count("\n") == 1, arguments


def test_plot_writes_a_picture_of_spectra_and_angles(run, tmp_path):
    status, out, _ = run("plot", "granite", "tarmac", "-o", tmp_path / "flat.png")
    assert status == 0 and "flat.png" in out
    run("plot", "granite", "water_breeze", "-o", tmp_path / "angle.png")
    sizes = [struct.unpack(">II", (tmp_path / name).read_bytes()[16:24]) for name in ("flat.png", "angle.png")]
    # The second panel is drawn when something depends on angle.
    assert sizes[1][0] > 1.4 * sizes[0][0] > 1000
    # Fused silica is not measured there: no curve by angle.
    assert run("plot", "silica_fused", "water_fresnel", "--band", "3.7,4.8", "-o", tmp_path / "angle.png")[0] == 0


# --- check ------------------------------------------------------------------------------------------------


def found(folder):
    return [str(finding) for finding in check(folder)]


def test_shipped_library_has_no_faults():
    assert [finding for finding in check(data_folder("materials")) if finding.fault] == []


def test_valid_library_has_no_findings(tmp_path):
    assert found(library(tmp_path / "m")) == []


@pytest.mark.parametrize(
    ("spectrum", "words"),
    [
        (SPECTRUM.replace("9.0,0.2", "9.0,1.2").replace("9.5,0.2", "9.5,-0.2"),
         ["row 22: emissivity=1.2 is not within 0…1 (and 1 more); leave"]),
        (SPECTRUM.replace(",0.2,", ",20,"), ["emissivity runs over 20–20: percent? divide the column by 100"]),
        ("\n".join([SPECTRUM.splitlines()[0], *(f"{w * 1000:.0f},0.2," for w in WAVELENGTH)]),
         ["wavelength_um runs over 7000–14000: nanometres? divide the column by 1000"]),
        ("\n".join([SPECTRUM.splitlines()[0], *(f"{1e4 / w:.9f},0.2," for w in WAVELENGTH[::-1])]),
         ["wavelength_um runs over 714.286–1428.57: wavenumbers in cm⁻¹? write 10000 divided by them"]),
        ("".join(line + "\n" for line in SPECTRUM.splitlines() if not line.startswith(("10.", "11."))),
         ["has a gap: no row between 9.9 and 12 µm"]),
        (SPECTRUM.replace("9.0,", "9.1,"), ["row 23: wavelength_um repeats the row above (9.1 µm); keep one row"]),
        (SPECTRUM.replace("9.0,", "9.9,"), ["row 23: wavelength_um is less than in the row above (9.1 after 9.9 µm)"]),
        (SPECTRUM.replace("9.0,0.2", '9.0,"0,2"'), ["row 22: emissivity='0,2' is not a number; write it with a point"]),
        (SPECTRUM.replace("9.0,0.2", "9.0,nan"), ["row 22: emissivity='nan' is not a number"]),
        (SPECTRUM.replace("emissivity,", "eps,"), ["row 1 holds wavelength_um, eps, emissivity_std; it must hold"]),
        ("".join(SPECTRUM.splitlines(True)[:40]), ["covers 7–10.8 µm, not all of 7–14; a camera"]),
        (SPECTRUM.replace("0.2,\n", "0.2,0\n"), ["emissivity_std is 0 for one sample"]),
        (SPECTRUM.splitlines(True)[0], ["has no row of data"]),
    ],
)  # fmt: skip
def test_check_finds_the_fault_of_a_spectrum_and_its_fix(tmp_path, spectrum, words):
    findings = found(library(tmp_path / "m", spectrum=spectrum))
    assert len(findings) == len(words)
    for finding, expected in zip(findings, words, strict=True):
        assert expected in finding and "spectra/tin.csv" in finding


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"source": ""}, "source of material 'tin' is empty; say where"),
        ({"citation": ""}, "citation of material 'tin' is empty"),
        ({"temperature_k": "21"}, "temperature_k=21 is not within 100…6000; values are kelvin"),
        ({"solar_absorptance": "40"}, "solar_absorptance=40 is not within 0…1; give the share"),
        ({"colour_r": "red"}, "colour_r='red' is not a number"),
        ({"rms_slope": "3"}, "rms_slope=3 is not within 0…0.5"),
    ],
)
def test_check_finds_faults_of_the_index(tmp_path, change, words):
    findings = found(library(tmp_path / "m", [ROW | change]))
    assert len(findings) == 1 and words in findings[0] and "index.csv, row 2" in findings[0]


def test_check_continues_where_reading_stops(run, tmp_path):
    rows = [ROW | {"licence": "", "samples": "3"}, ROW | {"name": "../x"}, ROW | {"name": "zinc", "directional": "odd"}]
    folder = library(tmp_path / "m", rows)
    (folder / "spectra" / "stray.csv").write_text(SPECTRUM)
    (folder / "spectra" / "zinc.csv").write_bytes(SPECTRUM.encode() + b"15,0.2,\xb5\n")
    status, out, _ = run("check", folder)
    assert status == 2 and "5 faults, 2 notes" in out
    for words in ("licence of material 'tin'", "name='../x' is not", "directional='odd' is not known",
                  "zinc.csv: is not UTF-8 text", "emissivity_std='µ' is not a number", "emissivity_std is empty for 3",
                  "stray.csv: has no row in index.csv"):  # fmt: skip
        assert words in out, words
    (folder / "spectra" / "tin.csv").unlink()
    assert any("tin.csv: does not exist" in finding for finding in found(folder))
    (folder / "spectra" / "tin.csv").symlink_to(tmp_path / "elsewhere.csv")
    assert any("tin.csv: leads out of" in finding for finding in found(folder))


def test_check_of_single_files(tmp_path):
    path = tmp_path / "own.csv"
    path.write_text("wavelength_nm,reflectance_percent\n" + "".join(f"{w * 1000:.0f},20\n" for w in WAVELENGTH))
    assert found(path) == []
    path.write_text("wavelength_um,n,k\n7,1.3,-1\n14,1.2,0.1\n")
    assert "row 2: k=-1 is not within 0…1000" in found(path)[0]
    path.write_text("lambda,counts\n7,1\n")
    assert "row 1 holds lambda, counts; it must hold one of wavelength_um" in found(path)[0]
    path.write_text("lambda;eps\n7,0;4,5\n14,0;5,5\n")
    assert found(path) == [
        "note   own.csv: units follow from the values, as in the headings wavelength_um, emissivity_percent; write "
        "these above the columns"
    ]
    path.write_text("wavelength,A001,A002\n" + "".join(f"{w},0.9,{0.9 + (w == 9.0)}\n" for w in WAVELENGTH))
    assert len(found(path)) == 1 and "row 22: A002=1.9 is not within 0…1" in found(path)[0]
    path = tmp_path / "rock.txt"
    pairs = "".join(f"{w:.2f} 20.0\n" for w in WAVELENGTH[::-1])
    header = (
        "Name: Rock\nMeasurement: Hemispherical\nX Units: Wavelength (micrometers)\nY Units: Reflectance (percent)\n"
    )
    path.write_text(header + "Owner: us\n\n" + pairs)
    assert found(path) == []
    path.write_text(header.replace("Hemi", "Bi").replace("percent", "counts") + "\n" + pairs.replace(" 20.0", " -1", 1))
    findings = found(path)
    words = (
        "and y units 'Reflectance (counts)'",
        "measured as 'Bispherical'",
        "neither origin",
        "pair 1: reflectance=-1",
    )
    assert [w for w in words if not any(w in finding for finding in findings)] == []


# --- import -----------------------------------------------------------------------------------------------

ROWS = "".join(f"{w},0.9,x\n" for w in WAVELENGTH)
ABOUT = ("--source", "own", "--citation", "none", "--licence", "CC0")


def test_import_of_a_two_column_table_takes_effect_at_once(run, tmp_path):
    path, folder = tmp_path / "own.csv", tmp_path / "m"
    path.write_text("wavelength_um,emissivity_percent\n" + "".join(f"{w},{90 + (w > 10)}\n" for w in WAVELENGTH))
    status, out, _ = run("import", path, "--into", folder, "--name", "tile", "--solar-absorptance", 0.6, *ABOUT)
    assert status == 0 and "tile" in out
    assert load_library(folder)["tile"].emissivity_at([8.0, 12.0]) == pytest.approx([0.9, 0.91], abs=1e-6)
    before = content(folder)
    again = ("import", path, "--into", folder, "--name", "tile", "--solar-absorptance", 0.7, *ABOUT)
    status, _, complaint = run(*again)
    assert status == 2 and "already holds material 'tile'" in complaint and content(folder) == before
    assert run(*again, "--replace")[0] == 0
    assert read_library(folder)["tile"].solar_absorptance == 0.7
    # The state that a process leaves if it is killed between writing its two files.
    (folder / "index.csv").unlink()
    status, _, complaint = run(*again)
    assert status == 2 and "tile.csv has no row in index.csv, as after an interrupted import" in complaint
    assert run(*again, "--replace")[0] == 0 and "tile" in read_library(folder)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), "does not come from a known library; add its origin as source, citation, licence"),
        (ABOUT, "so its solar_absorptance is unknown; give an assumed value"),
        ((*ABOUT, "--solar-absorptance", 0.5, "--temperature", 20), "temperature=20 is below 100 K"),
        ((*ABOUT, "--solar-absorptance", 5), "solar_absorptance=5 is not within 0…1"),
        ((*ABOUT, "--solar-absorptance", 0.5, "--colour", "1,2"), "--colour"),
        ((*ABOUT, "--solar-absorptance", 0.5, "--rms-slope", 0.1), "rms_slope=0.1 is for tables of n and k"),
    ],
)
def test_refused_import_writes_nothing(run, tmp_path, arguments, words):
    path, folder = tmp_path / "own.csv", tmp_path / "m"
    path.write_text("wavelength_um,emissivity\n7,0.9\n14,0.9\n")
    status, _, complaint = run("import", path, "--into", folder, "--name", "tile", *arguments)
    assert status == 2 and words in complaint and not folder.exists()


def test_import_of_n_and_k_makes_a_fresnel_material(run, tmp_path):
    path, folder = tmp_path / "nk.csv", tmp_path / "m"
    path.write_text("wavelength_um,n,k\n7,1.5,0\n14,1.5,0\n")
    arguments = ("import", path, "--into", folder, "--name", "plate", *ABOUT)
    assert "add solar_absorptance" in run(*arguments)[2]
    assert run(*arguments, "--solar-absorptance", 0.1, "--rms-slope", 0.2)[0] == 0
    plate = read_library(folder)["plate"]
    assert plate.rms_slope == 0.2 and plate.directional == "fresnel"
    assert plate.emissivity_at_angle(10.0, 1.0) == pytest.approx(0.96, abs=2e-3)


def test_imported_band_emissivity_matches_the_file(run, tmp_path):
    """For a library's own file, by the trapezoidal rule at its own points and many between, to 1e-6."""
    spectra = shared_data("emissivity/ecostress/spectra")
    file = "soil.entisol.quartzipsamment.none.all.87p706.jhu.becknic.spectrum.txt"
    assert run("import", spectra / file, "--into", tmp_path, "--name", "sand")[0] == 0
    lines = (spectra / file).read_text(encoding="latin-1").splitlines()
    # The header is 15 lines of text.
    pairs = np.array(sorted([float(cell) for cell in line.split()] for line in lines[15:] if line.strip()))
    wavelength, emissivity = pairs[:, 0], 1.0 - pairs[:, 1] / 100.0
    fine = np.union1d(wavelength[(wavelength > 7.5) & (wavelength < 13.5)], np.linspace(7.5, 13.5, 200_001))
    planck = fine**-5 / np.expm1(14387.76877 / (fine * 300.0))
    expected = np.trapezoid(planck * np.interp(fine, wavelength, emissivity), fine) / np.trapezoid(planck, fine)
    assert read_library(tmp_path)["sand"].band_emissivity(7.5, 13.5, 300.0) == pytest.approx(expected, abs=1e-6)


def test_import_of_slum_samples_records_their_source(run, tmp_path):
    table = shared_data("emissivity/slum/LUMA_SLUM_IR.csv")
    status, _, _ = run("import", table, "--column", "A008", "--column", "A009", "--into", tmp_path, "--name", "road")
    road = read_library(tmp_path)["road"]
    assert status == 0 and road.samples == 2 and "doi:10.1016/j.isprsjprs.2014.05.005" in road.citation
    assert road.valid_range_um == (8.0, 14.0) and 0.8 < road.solar_absorptance < 0.95


@pytest.mark.parametrize(
    ("directional", "table", "words"),
    [
        # 1,5 + 0,1 i written with decimal commas must not be read as 1 + 5 i.
        ("fresnel", "wavelength_um,n,k\n7,1,5,0,1\n14,1,5,0,1\n", "row 2: holds 5 cells under 3 headings; write"),
        ("lambertian", SPECTRUM.replace("7.0,0.2,", "-7.0,0.2,"), "row 2: wavelength_um=-7 is not within 0…1000"),
    ],
)
def test_check_finds_what_a_scene_refuses(run, tmp_path, directional, table, words):
    folder = library(tmp_path / "m", [ROW | {"directional": directional}], table)
    status, out, _ = run("check", folder)
    assert status == 2 and words in out
    with pytest.raises(ThermorenderError, match=words):
        read_library(folder)


def test_cells_beyond_the_last_heading_may_be_empty(tmp_path):
    folder = library(tmp_path / "m", spectrum=SPECTRUM.replace("0.2,\n", "0.2,,,\n"))
    assert read_library(folder)["tin"].emissivity[0] == 0.2


@pytest.mark.parametrize("verb", ["import", "check"])
@pytest.mark.parametrize(
    "text",
    [
        f'wavelength_um,emissivity,note\n6.9,"0.9,x\n{ROWS}',
        f'wavelength_um,emissivity,note\n6.9,"0.9,x\n{ROWS}14.1,0.9,"x"\n',
        f'wavelength_um,emissivity,note\n6.9,"0.9\n{ROWS}14.1,0.9",x\n',
        f'"wavelength_um,emissivity\n{ROWS}',
        f'"wavelength_um,emissivity\n{300 * ROWS}',
    ],
)
def test_unclosed_quote_is_reported_in_a_short_message(run, tmp_path, verb, text):
    """The message does not repeat a cell that swallowed the rest of the file."""
    path, folder = tmp_path / "own.csv", tmp_path / "m"
    path.write_text(text)
    arguments = ("--into", folder, "--name", "tile", "--solar-absorptance", 0.5, *ABOUT) if verb == "import" else ()
    status, out, complaint = run(verb, path, *arguments)
    assert status == 2 and not folder.exists()
    message = out.splitlines() if verb == "check" else complaint.splitlines()
    assert "own.csv" in message[0] and max(map(len, message)) < 400 + len(str(path)), message
    assert verb == "check" or len(message) == 1


# --- diff and merge ---------------------------------------------------------------------------------------


def test_diff_reports_emissivity_and_kelvin(run, tmp_path):
    one = library(tmp_path / "a", [ROW, ROW | {"name": "zinc"}])
    two = library(tmp_path / "b", [ROW | {"name": "zinc", "title": "Zinc"}, ROW | {"name": "lead"}])
    (two / "spectra" / "zinc.csv").write_text(SPECTRUM.replace(",0.2,", ",0.3,"))
    status, out, _ = run("diff", one, two)
    own, sky = band_radiance(300.0, 7.5, 13.5), band_radiance(250.0, 7.5, 13.5)
    seen = [brightness_temperature(e * own + (1 - e) * sky, 7.5, 13.5) for e in (0.2, 0.3)]
    assert status == 0 and "3 differences" in out
    line = next(line for line in out.splitlines() if line.startswith("zinc"))
    assert line.split()[1:4] == ["0.2000", "0.3000", f"{1e3 * (seen[1] - seen[0]):+.1f}"]
    assert "spectrum, title" in line
    assert "only in the first" in out and "only in the second" in out
    assert "0 differences" in run("diff", one, one)[1]
    _, out, _ = run("diff", "water", "water_fresnel")
    assert "0.9846" in out and "0.9421" in out


def test_diff_with_the_shipped_tables_reports_only_the_librarys_changes(run, tmp_path):
    """A folder overrides the shipped tables, so a material that it lacks is as shipped."""
    own = library(tmp_path / "a", [ROW, ROW | {"name": "asphalt"}])
    status, out, _ = run("diff", own)
    assert status == 0 and "2 differences" in out and "only in the second" not in out
    assert [line.split()[0] for line in out.splitlines()[1:3]] == ["asphalt", "tin"]
    assert "0 differences" in run("diff", data_folder("materials"))[1]
    # Two named folders are compared in full.
    assert "only in the second" in run("diff", own, data_folder("materials"))[1]


def test_apparent_temperature_of_black_and_mirror_surfaces():
    assert apparent_temperature(grey("black", 1.0)) == pytest.approx(300.0, abs=1e-9)
    assert apparent_temperature(grey("mirror", 0.0)) == pytest.approx(250.0, abs=1e-9)


def test_merge_takes_both_and_refuses_conflicts(run, tmp_path):
    one = library(tmp_path / "a", [ROW, ROW | {"name": "zinc"}])
    two = library(tmp_path / "b", [ROW, ROW | {"name": "zinc", "title": "Zinc"}, ROW | {"name": "lead"}])
    out = tmp_path / "both"
    status, _, complaint = run("merge", one, two, "-o", out)
    assert status == 2 and "hold zinc differently" in complaint and "prefer=first" in complaint
    assert not out.exists() and sorted(path.name for path in tmp_path.iterdir()) == ["a", "b"]
    assert run("merge", one, two, "-o", out, "--prefer", "second")[0] == 0
    both = read_library(out)
    assert sorted(both) == ["lead", "tin", "zinc"] and both["zinc"].title == "Zinc"
    assert run("merge", one, two, "-o", tmp_path / "c", "--prefer", "first")[0] == 0
    assert read_library(tmp_path / "c")["zinc"].title == "Tin roof"
    assert (out / "spectra" / "lead.csv").read_text() == SPECTRUM
    assert "exists and is not empty; give a new folder" in run("merge", one, two, "-o", out)[2]
    assert "prefer='both' is not allowed" in run("merge", one, two, "-o", tmp_path / "d", "--prefer", "both")[2]


def test_merge_of_a_library_with_itself_changes_nothing(run, tmp_path):
    one = library(tmp_path / "a", [ROW, ROW | {"name": "zinc"}])
    status, out, complaint = run("merge", one, one, "-o", tmp_path / "both")
    assert (status, complaint) == (0, "") and f"2 materials of {one}, 0 of {one}" in out
    assert "0 differences" in run("diff", one, tmp_path / "both")[1]
    assert set(content(tmp_path / "both")) == set(content(one))


def test_merge_of_the_shipped_library_loses_nothing(run, tmp_path):
    own = library(tmp_path / "a")
    assert run("merge", data_folder("materials"), own, "-o", tmp_path / "all")[0] == 0
    status, out, _ = run("diff", data_folder("materials"), tmp_path / "all")
    assert status == 0 and "1 difference;" in out and "only in the second" in out
