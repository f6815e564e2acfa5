"""Edits of a scene's materials written into its own files, and what these keep."""

from dataclasses import replace

import numpy as np
import pytest

import thermorender as tr
from scenes import WEATHER, scene_object, write_balance, write_hut
from thermorender.apps.material_tables.edit import with_spectrum_of, with_text
from thermorender.apps.studio.scene_files import SceneFiles
from thermorender.errors import ThermorenderError
from thermorender.paths import data_folder

BAND = (7.5, 13.5, 300.0)


@pytest.fixture
def folder(tmp_path):
    return write_hut(tmp_path / "tiny scene")


@pytest.fixture
def files(folder):
    return SceneFiles(tr.load_scene(folder))


def saved(files, document):
    """The materials of the scene by name, as it is read after a save."""
    files.write(files.plan(document))
    return {each.name: each for each in tr.load_scene(files.scene.spec.folder).materials}


def test_a_document_shows_in_the_scene_what_a_save_makes_of_it(files, folder):
    document = files.saved.duplicated("snow", "mine").with_text("mine", "emissivity", "0.9")
    document = document.of_class(2, "mine").of_object("hut", "granite", 320.0)
    shown, before = document.scene(files.scene, files.origin), files.scene
    save = files.plan(document)
    assert {line.split("  ")[0] for line in save.lines} >= {"mine", "scene.toml", "materials/spectra/mine.csv"}
    assert not (folder / "materials").exists()
    files.write(save)
    read = tr.load_scene(folder)
    for one, other, old in zip(read.surfaces, shown.surfaces, before.surfaces, strict=True):
        np.testing.assert_array_equal(one.temperature, other.temperature)
        names = [np.array([each.name for each in of.materials]) for of in (read, shown, before)]
        covered = [names[k][each.material] for k, each in enumerate((one, other, old))]
        np.testing.assert_array_equal(covered[0], covered[1])
        assert (covered[0] != covered[2]).any()
    assert files.plan(document).files == {}


def test_the_shipped_tables_and_scenes_are_not_written(files, folder, monkeypatch, tmp_path):
    save = files.plan(files.saved.with_text("snow", "emissivity", "0.9"))
    assert save.files and all(folder in path.parents for path in save.files)
    monkeypatch.setattr("thermorender.apps.studio.scene_files.data_folder", lambda kind: tmp_path)
    with pytest.raises(ThermorenderError, match="is a shipped scene, which is not written"):
        files.plan(files.saved)


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_a_save_keeps_comments_line_ends_and_digits(folder, end):
    path = folder / "scene.toml"
    text = path.read_text("utf-8").replace('1 = "grass_green"', '1 = "grass_green" # the owner\'s "lawn", # 7')
    path.write_bytes(b"\xef\xbb\xbf" + text.replace("\n", end).encode())
    files = SceneFiles(tr.load_scene(folder))
    saved(files, files.saved.of_class(1, "snow").of_object("hut", "granite", 301.234567))
    spec = tr.load_scene(folder).spec
    assert spec.objects[0].temperature == 301.234567 and spec.objects[0].material == "granite"
    expected = text.replace('1 = "grass_green"', '1 = "snow"').replace("305.0", "301.234567")
    expected = expected.replace("'asphalt'", '"granite"')
    assert path.read_bytes() == b"\xef\xbb\xbf" + expected.replace("\n", end).encode()


def test_a_value_that_shares_its_line_is_left_to_the_hand(folder):
    path = folder / "scene.toml"
    inline = (
        '[[object]]\n"name" = "shed"\nshape = "box"\nsize = [1, 1, 1]\nposition = [5, 0, 0.5]\ntemperature = 300.0\n'
    )
    path.write_text(path.read_text("utf-8") + inline + 'material = """asphalt"""\n', "utf-8")
    files = SceneFiles(tr.load_scene(folder))
    files.plan(files.saved.of_object("shed", kelvin=301.0))
    with pytest.raises(ThermorenderError, match=r"does not state material of shed on a line of its own.*by hand"):
        files.plan(files.saved.of_object("shed", "granite"))


def test_a_copy_of_a_material_that_emits_by_angle_is_saved(files):
    document = files.saved.duplicated("glass_fresnel", "pane").of_class(1, "pane")
    first = saved(files, document)["pane"]
    second = saved(files, document.renamed("pane", "window"))["window"]
    glass = files.origin.library["glass_fresnel"]
    for cosine in (1.0, 0.3):
        wanted = glass.band_emissivity(*BAND, cosine)
        assert [each.band_emissivity(*BAND, cosine) for each in (first, second)] == [wanted, wanted]


def test_a_table_of_n_and_k_makes_a_material_emit_by_angle(files, tmp_path):
    path = data_folder("materials") / "spectra" / "glass_fresnel.csv"
    own, bad = files.saved.library["glass"], tmp_path / "nk.csv"
    bad.write_text("wavelength_um,n,k\n2,1.5,-1\n20,1.5,0.1\n")
    with pytest.raises(ThermorenderError, match=r"nk\.csv is a table of n and k and has no sample 'A001'; leave it"):
        with_spectrum_of(own, bad, "A001")
    with pytest.raises(ThermorenderError, match=r"^nk\.csv, row 2: k=-1 is not within .*k not negative"):
        with_spectrum_of(own, bad)
    document = files.saved.duplicated("glass", "pane")
    pane = with_spectrum_of(document.library["pane"], path, name="nk.csv")[0]
    document = document.with_material(pane).of_class(1, "pane")
    read = saved(files, document)["pane"]
    for cosine in (1.0, 0.3):
        wanted = document.library["glass_fresnel"].band_emissivity(*BAND, cosine)
        assert [each.band_emissivity(*BAND, cosine) for each in (pane, read)] == [wanted, wanted]
    assert "n and k from nk.csv" in read.note
    with pytest.raises(ThermorenderError, match=r"pane emits by angle \(fresnel\); copy a Lambertian"):
        document.with_text("pane", "emissivity", "0.9")


def test_gaps_are_those_of_the_new_spectrum(files, tmp_path):
    old = replace(files.saved.library["snow"], gaps_um=((8.0, 9.0),))
    (tmp_path / "a.csv").write_text("wavelength_um,emissivity\n2,0.9\n9,0.8\n20,0.9\n")
    assert with_spectrum_of(old, tmp_path / "a.csv")[0].gaps_um == ()


def test_names_longer_than_a_file_name_are_refused(files):
    with pytest.raises(ThermorenderError, match="use 1 … 100 letters"):
        files.saved.duplicated("snow", "a" * 101)
    assert "a" * 100 in files.saved.duplicated("snow", "a" * 100).library


def test_a_scene_still_loads_after_a_save_that_failed(files, monkeypatch):
    document = files.saved.with_text("grass_green", "emissivity", "0.8")
    save = files.plan(document)

    def full(contents):
        next(iter(contents)).parent.mkdir(parents=True, exist_ok=True)
        raise ThermorenderError("no space")

    with monkeypatch.context() as patched:
        patched.setattr("thermorender.apps.studio.scene_files.replace_files", full)
        with pytest.raises(ThermorenderError, match="no space"):
            files.write(save)
    tr.load_scene(files.scene.spec.folder)
    assert saved(files, document)["grass_green"].emissivity.max() == 0.8


def test_a_new_name_is_not_saved_where_the_scene_names_the_old_one_elsewhere(files, folder):
    path = folder / "scene.toml"
    saved(files, files.saved.duplicated("snow", "mine"))
    text = path.read_text("utf-8")
    path.write_text(text.replace('raster = "classes.tif"', 'raster = "classes.tif"\nfallback = "mine"'), "utf-8")
    files = SceneFiles(tr.load_scene(folder))
    with pytest.raises(ThermorenderError, match=r"scene\.toml names mine outside its classes and objects"):
        files.plan(files.saved.renamed("mine", "yours"))
    saved(files, files.saved.duplicated("mine", "yours"))
    assert sorted(each.name for each in (folder / "materials" / "spectra").iterdir()) == ["mine.csv", "yours.csv"]


def test_a_material_of_the_scene_is_deleted_where_nothing_uses_it(files, folder):
    with pytest.raises(ThermorenderError, match="snow is a material of the shipped library, which stays"):
        files.saved.without("snow")
    document = files.saved.duplicated("snow", "mine").of_class(1, "mine")
    saved(files, document)
    assert (folder / "materials" / "spectra" / "mine.csv").is_file()
    with pytest.raises(ThermorenderError, match="mine is the material of class 1; give that another one"):
        document.without("mine")
    assert "mine" not in saved(files, document.of_class(1, "grass_green").without("mine"))
    assert not (folder / "materials").exists()


@pytest.mark.parametrize("text", ["1_0", "0.8_5", "٣", "０.９"])
def test_numbers_in_other_digits_are_refused_as_in_tables(files, text):
    for key in ("emissivity", "solar_absorptance", "conductivity_w_m_k"):
        with pytest.raises(ThermorenderError, match="is not a number"):
            files.saved.with_text("grass_green", key, text)


def test_a_thermal_value_changes_in_the_materials_that_lie_on_it(files):
    library = files.saved.library
    upper = next(each for each in library.values() if each.thermal and each.thermal.beneath in library)
    lower = upper.thermal.beneath
    document = files.saved.with_text(lower, "density_kg_m3", "1234")
    assert document.library[upper.name].thermal.below.density_kg_m3 == 1234.0
    assert document.library[lower].thermal.source["density_kg_m3"].startswith("chosen: edited by hand, before: ")
    changed = document.changed(files.saved)
    assert {lower, upper.name} <= set(changed) and len(changed) < len(library)


def test_a_file_that_changed_after_it_was_read_is_not_overwritten(files, folder):
    path = folder / "scene.toml"
    text = path.read_text("utf-8")
    document = files.saved.with_text("grass_green", "emissivity", "0.8")
    save = files.plan(document)
    path.write_text(text + "# by hand\n", "utf-8")
    for act in (lambda: files.plan(document), lambda: files.write(save)):
        with pytest.raises(ThermorenderError, match=r"scene\.toml has changed on disk since it was read"):
            act()
    assert not (folder / "materials").exists()
    path.write_text(text, "utf-8")
    assert saved(files, document)["grass_green"].emissivity.max() == 0.8


def test_a_save_planned_before_another_one_was_written_is_refused(files, folder):
    first, second = (files.plan(files.saved.of_class(number, "snow")) for number in (1, 2))
    files.write(first)
    with pytest.raises(ThermorenderError, match=r"another save has been written since.*nothing was written"):
        files.write(second)
    assert tr.load_scene(folder).spec.emissivity.classes == {1: "snow", 2: "sand_quartz"}
    files.write(files.plan(files.saved.of_class(2, "snow")))
    assert tr.load_scene(folder).spec.emissivity.classes == {1: "snow", 2: "snow"}


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda document: document.of_class(7, "snow"), r"^the scene has no class 7; it has 1, 2$"),
        (lambda document: document.of_class("1", "snow"), r"^the scene has no class '1'; it has 1, 2$"),
        (lambda document: document.of_object("shed", "snow"), r"^the scene has no object 'shed'; it has 'hut'$"),
        (lambda document: document.of_object("hut", kelvin=-5.0), "object 'hut': kelvin=-5 is "),
        (lambda document: document.of_object("hut", kelvin=np.nan), "object 'hut': kelvin=nan is not allowed"),
        (lambda document: document.of_object("hut", kelvin="300 K"), "kelvin='300 K' is not allowed; give a finite"),
        (lambda document: document.with_text("snow", "name", "x"), "key='name' is not a property that a text sets"),
        (
            lambda document: document.with_text("snow", "emisivity", "1"),
            "key=.emisivity. is not .*emissivity",
        ),
        (lambda document: document.with_text("snow", "samples", "4"), "key='samples' is not a property"),
        (lambda document: with_text(document.library, "snwo", "emissivity", "1"), "'snwo'.*closest are snow"),
    ],
)
def test_what_a_scene_does_not_have_is_refused_in_one_sentence(files, change, sentence):
    with pytest.raises(ThermorenderError, match=sentence):
        change(files.saved)


def test_an_object_that_the_heat_balance_solves_stays_so(tmp_path):
    warm = scene_object("warm", [2, 2, 1], temperature="balance")
    folder = write_balance(tmp_path / "scene", WEATHER + warm)
    files = SceneFiles(tr.load_scene(folder))
    files.write(files.plan(files.saved.of_class(1, "asphalt").of_object("warm", "granite")))
    (found,) = tr.load_scene(folder).spec.objects
    assert (found.material, np.isnan(found.kelvin)) == ("granite", True)
    assert 'temperature = "balance"' in (folder / "scene.toml").read_text()
