"""The material editor of the studio: layers, spectra from a spreadsheet, sources of edited values, and colours."""

import re
from dataclasses import replace

import numpy as np
import pytest
from studio_support import WAIT_MS, serious, served

import thermorender as tr
from scenes import write_hut, write_terrain
from thermorender.apps.material_tables import layers
from thermorender.apps.material_tables.edit import with_spectrum_of, with_text
from thermorender.apps.studio import section, spectrum
from thermorender.apps.studio.pictures import colours_of_materials
from thermorender.apps.studio.scene_files import SceneFiles
from thermorender.errors import ThermorenderError
from thermorender.materials.library import load_library
from thermorender.materials.store import write_material

LIBRARY = load_library()
ROOF = "roof_flat_membrane"


def stack(library, name=ROOF):
    """(names, thicknesses) of a material's layers, and what is behind them."""
    tables = library[name].thermal.layers
    return layers.names(library, name), [each.thickness_m for each in tables], tables[-1].beneath


# --- sources ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("key", ["emissivity", "solar_absorptance", "solar_absorptance_std"])
def test_an_edited_value_says_so_once_in_the_source(key):
    first = LIBRARY["granite"]
    library = with_text(LIBRARY, "granite", key, "0.31", LIBRARY)
    library = with_text(library, "granite", "solar_absorptance", "0.4", LIBRARY)
    material = library["granite"]
    assert material.source == f"edited by hand, before: {first.source}"
    assert (material.citation, material.licence) == (first.citation, first.licence)


def test_the_original_value_brings_its_source_and_note_back():
    library = with_text(LIBRARY, "granite", "solar_absorptance", "0.4", LIBRARY)
    library = with_text(library, "granite", "temperature_k", "305", LIBRARY)
    original = f"{LIBRARY['granite'].solar_absorptance:g}"
    library = with_text(library, "granite", "solar_absorptance", original, LIBRARY)
    material = library["granite"]
    assert material.source == LIBRARY["granite"].source
    assert material.note.endswith("Set by hand: temperature_k=305.")
    library = with_text(library, "granite", "temperature_k", f"{LIBRARY['granite'].temperature:g}", LIBRARY)
    assert library["granite"] is LIBRARY["granite"]


def test_a_source_that_the_user_wrote_stays():
    library = with_text(LIBRARY, "granite", "source", "own quarry", LIBRARY)
    library = with_text(library, "granite", "solar_absorptance", "0.4", LIBRARY)
    assert library["granite"].source == "edited by hand, before: own quarry"
    library = with_text(library, "granite", "solar_absorptance", f"{LIBRARY['granite'].solar_absorptance:g}", LIBRARY)
    assert library["granite"].source == "own quarry"


def test_a_thermal_value_has_its_former_source_behind_it_and_again_with_the_original_value():
    first = LIBRARY["granite"].thermal
    library = LIBRARY
    for text in ("2.5", "2.6"):
        library = with_text(library, "granite", "conductivity_w_m_k", text, LIBRARY)
    thermal = library["granite"].thermal
    before = first.source["conductivity_w_m_k"]
    assert thermal.source["conductivity_w_m_k"] == f"chosen: edited by hand, before: {before}"
    assert thermal.source["density_kg_m3"] == first.source["density_kg_m3"]
    assert library["granite"].source == LIBRARY["granite"].source
    library = with_text(library, "granite", "wetness", "0.5", LIBRARY)
    library = with_text(library, "granite", "conductivity_w_m_k", f"{first.conductivity_w_m_k:g}", LIBRARY)
    assert library["granite"].thermal.source["conductivity_w_m_k"] == before
    library = with_text(library, "granite", "wetness", f"{first.wetness:g}", LIBRARY)
    assert library["granite"] is LIBRARY["granite"]


def test_a_spectrum_of_a_file_names_the_file_and_what_was_before(tmp_path):
    path = tmp_path / "spectrum.csv"
    path.write_text("7\t95\n10\t94\n14\t93\n")
    first = LIBRARY["granite"]
    for _ in range(2):
        edited = with_text(LIBRARY, "granite", "emissivity", "0.9")["granite"]
        material, words = with_spectrum_of(edited, path, None, "a.csv")
        assert material.source == f"spectrum from a.csv, before: {first.source}"
        assert material.note.endswith("Set by hand: emissivity from a.csv.")
        assert words == "3 rows, 7–14 µm, percent read as emissivity 0.93–0.95"
    assert material.solar_absorptance == first.solar_absorptance


def test_a_spectrum_that_reaches_over_sunlight_gives_the_solar_absorptance(tmp_path):
    path, wavelength = tmp_path / "spectrum.csv", np.linspace(0.35, 15.0, 500)
    path.write_text("".join(f"{w:.4f}\t{0.3 if w < 2.9 else 0.9}\n" for w in wavelength))
    material, words = with_spectrum_of(LIBRARY["granite"], path)
    # Emissivity is absorptance, and all weight is below 2.5 µm.
    assert material.solar_absorptance == pytest.approx(0.3, abs=1e-9)
    assert material.solar_absorptance_std is None
    assert words.endswith("emissivity 0.3–0.9; used over 3–15 µm; solar absorptance 0.3")


# --- layers -----------------------------------------------------------------------------------------------------------


def test_a_layer_without_a_material_is_edited_wherever_it_lies():
    library = with_text(LIBRARY, "insulation_deck", "thickness_m", "0.2", LIBRARY)
    for name in layers.users(library, "insulation_deck"):
        assert library[name].thermal.layers[1].thickness_m == 0.2
    assert layers.users(library, "insulation_deck") == ["roof_flat_gravel", "roof_flat_membrane"]


def test_a_layer_is_inserted_replaced_and_removed_for_one_material_only():
    library = layers.with_beneath(LIBRARY, ROOF, 1, "granite", "0.05", "", LIBRARY)
    own = [ROOF, f"insulation_deck_of_{ROOF}", f"granite_of_{ROOF}", "deck_concrete"]
    assert stack(library) == (own, [0.008, 0.14, 0.05, 0.2], "inside")
    library = layers.with_other(library, ROOF, 3, "wood", LIBRARY)
    assert stack(library) == ([*own[:3], f"wood_of_{ROOF}"], [0.008, 0.14, 0.05, 0.2], "inside")
    library = layers.without(library, ROOF, 2, LIBRARY)
    assert stack(library) == ([*own[:2], f"wood_of_{ROOF}"], [0.008, 0.14, 0.2], "inside")
    changed = {name for name, each in library.items() if each is not LIBRARY[name]}
    assert changed == {ROOF}
    values = library[ROOF].thermal.layers[2].values | {"thickness_m": None, "beneath": ""}
    assert values == LIBRARY["wood"].thermal.values | {"thickness_m": None, "beneath": ""}


def test_a_table_that_already_fits_is_beneath_itself():
    library = layers.with_other(LIBRARY, "asphalt", 1, "soil_dark", LIBRARY)
    assert stack(library, "asphalt") == (["asphalt", "soil_dark"], [0.1, None], "")
    library = layers.with_other(library, "asphalt", 1, "soil_loam", LIBRARY)
    assert library["asphalt"] is LIBRARY["asphalt"]


def test_layers_end_at_air_or_are_unlimited():
    library = layers.with_beneath(LIBRARY, "granite", 0, "inside", "", "0.3", LIBRARY)
    assert stack(library, "granite") == (["granite"], [0.3], "inside")
    library = layers.with_beneath(library, "granite", 0, "", "", "", LIBRARY)
    assert library["granite"] is LIBRARY["granite"]
    library = layers.without(LIBRARY, "asphalt", 1, LIBRARY)
    assert stack(library, "asphalt") == (["asphalt"], [None], "")


@pytest.mark.parametrize(
    ("of", "thickness", "own", "sentence"),
    [
        ("granit", "0.1", "", "'granit' has no thermal table to be a layer; choose one of "),
        ("soil_dark", "0.1 m", "0.2", "thickness_m='0.1 m' is not a number"),
        ("soil_dark", "", "", "beneath='soil_dark' is given without thickness_m; give the layer's thickness"),
    ],
)
def test_a_layer_that_the_tables_refuse_is_one_sentence(of, thickness, own, sentence):
    with pytest.raises(ThermorenderError, match=re.escape(sentence)):
        layers.with_beneath(LIBRARY, "granite", 0, of, thickness, own, LIBRARY)


def test_own_layers_leave_the_shared_ones():
    library = layers.with_own(LIBRARY, ROOF, 2, LIBRARY)
    own = [ROOF, f"insulation_deck_of_{ROOF}", f"deck_concrete_of_{ROOF}"]
    assert stack(library) == (own, [0.008, 0.14, 0.2], "inside")
    assert layers.with_own(library, ROOF, 2, LIBRARY) is library
    library = with_text(library, own[1], "conductivity_w_m_k", "0.05", LIBRARY)
    assert library[ROOF].thermal.layers[1].conductivity_w_m_k == 0.05
    assert library["roof_flat_gravel"] is LIBRARY["roof_flat_gravel"]


def test_layers_are_saved_as_the_scene_reads_them_and_go_again(tmp_path):
    folder = write_hut(tmp_path / "hut")
    files = SceneFiles(tr.load_scene(folder))
    first = files.saved.of_class(1, ROOF)
    inserted = layers.with_beneath(first.library, ROOF, 1, "granite", "0.05", "", first.origin)
    document = first.with_library(with_text(inserted, "deck_concrete", "thickness_m", "0.25", first.origin))
    for each in (document, first):
        files.write(files.plan(each))
        read = load_library(folder / "materials") if each is document else LIBRARY
        for name in (ROOF, "roof_flat_gravel"):
            assert read[name].thermal == each.library[name].thermal
        tables = {path.stem for path in (folder / "materials").rglob("thermal/*.csv")}
        assert {f"granite_of_{ROOF}", "deck_concrete"} <= tables if each is document else not tables


# --- section ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "thickness", [[0.1], [0.05, 0.1], [0.008, 0.14, 0.2], [0.0006, 0.1], [0.3, 2.0], [1e-4, 1e-3, 1.0, 2.0]]
)
def test_layers_are_drawn_to_scale_but_for_those_with_a_break(thickness):
    sizes, scale = section.heights(thickness, 140.0)
    for (size, broken), each in zip(sizes, thickness, strict=True):
        assert size == pytest.approx(scale * each) or (broken and 30.0 < size < scale * each)
    assert min(size for size, _ in sizes) > 5.9
    assert sum(size for size, _ in sizes) == pytest.approx(140.0)


def test_every_material_has_a_section_with_its_layers():
    for name, material in LIBRARY.items():
        drawn = section.drawing(material.thermal.layers, 0)
        assert drawn.count('<rect class="layer') == len(layers.names(LIBRARY, name))
        assert ('class="air"' in drawn) == bool(material.thermal.layers[-1].beneath)


# --- spectrum ---------------------------------------------------------------------------------------------------------


def solar_paint():
    wavelength = np.round(np.linspace(0.25, 15.0, 60), 4)
    emissivity = np.where(wavelength < 3.0, 0.25 + 0.1 * np.sin(wavelength), 0.9)
    return replace(
        LIBRARY["granite"], name="paint_own", wavelength_um=wavelength, emissivity=emissivity,
        emissivity_std=np.full(60, np.nan), solar_absorptance=0.26, solar_absorptance_std=0.02, samples=1, gaps_um=(),
    )  # fmt: skip


def test_the_solar_range_is_drawn_where_the_table_has_it():
    assert not any(map(spectrum.reaches_sunlight, LIBRARY.values()))
    paint = solar_paint()
    assert spectrum.reaches_sunlight(paint)
    drawn = spectrum.options(paint, None, None, (7.5, 13.5), solar=True)
    line = np.array(drawn["series"][1]["data"])
    assert line[[0, -1], 0].tolist() == [0.3, 2.5]
    np.testing.assert_allclose(line[:, 1], np.interp(line[:, 0], paint.wavelength_um, paint.emissivity), atol=1e-5)
    assert drawn["series"][spectrum.HANDLES]["data"] == []
    assert spectrum.words(paint)[1] == "solar absorptance over 0.3–2.5 µm 0.26 ± 0.02 (one standard deviation)"
    assert spectrum.words(LIBRARY["grass_green"])[0] == "shaded: ± one standard deviation over 4 samples"
    assert spectrum.words(LIBRARY["glass_fresnel"])[0] == "from n and k, without a standard deviation"
    assert spectrum.words(LIBRARY["granite"])[1].endswith("; no spectrum below 3 µm")


def colours_in(given):
    return set(re.findall(r"#[0-9a-f]{6}|rgba\([^)]*\)", str(given)))


def test_a_dark_page_has_charts_in_other_colours():
    material = LIBRARY["glass_fresnel"]
    for dark in (False, True):
        drawn = spectrum.options(material, LIBRARY["glass"], LIBRARY["snow"], (7.5, 13.5), dark=dark)
        found = colours_in(drawn) | colours_in(spectrum.by_angle(material, (7.5, 13.5), 300.0, dark))
        assert found == set(spectrum.COLOURS[dark].values()) - {""}
    assert len(spectrum.COLOURS[False]) == len(spectrum.COLOURS[True])


@pytest.mark.parametrize(("wavelength", "row"), [(9.23, 9.23), (9.2501, 9.25)])
def test_a_typed_point_is_on_the_spectrum(wavelength, row):
    made = spectrum.dragged(LIBRARY["granite"], wavelength, 0.5, 0.15)
    assert made.emissivity_at(row) == pytest.approx(0.5, abs=1e-6)
    far = np.abs(made.wavelength_um - row) > 1.0
    kept = LIBRARY["granite"].emissivity_at(made.wavelength_um)
    np.testing.assert_allclose(made.emissivity[far], kept[far], atol=1e-6)
    with pytest.raises(ThermorenderError, match="measured over 3–14 µm only"):
        spectrum.dragged(LIBRARY["granite"], 20.0, 0.5, 0.15)


def test_colours_of_materials_are_distinct():
    import cv2

    colours = colours_of_materials()
    lab = cv2.cvtColor(colours[None].astype(np.float32) / np.float32(255.0), cv2.COLOR_RGB2LAB)[0]
    far = np.linalg.norm(lab[:, None] - lab, axis=2) + 1e3 * np.eye(256)
    assert far[:40, :40].min() > 27.0 and far.min() > 12.0


# --- the page ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def address(browser, tmp_path_factory):
    columns = np.mgrid[:32, :32][1]
    folder = write_terrain(tmp_path_factory.mktemp("materials") / "tiny", classes=np.where(columns < 16, 1, 2))
    text = (folder / "scene.toml").read_text("utf-8")
    text = text.replace("grass_green", "paint_own").replace("sand_quartz", ROOF)
    (folder / "scene.toml").write_text(text, "utf-8")
    write_material(solar_paint(), folder / "materials")
    with served(folder) as found:
        yield found


def wait_for_layers(page, names):
    """Wait until the section has these layers."""
    page.page.wait_for_function(
        "names => [...document.querySelectorAll('.stack .layername')].map((e) => e.innerText).join() == names.join()",
        arg=names, timeout=WAIT_MS,
    )  # fmt: skip


@pytest.mark.slow
def test_layers_are_chosen_edited_and_inserted_in_the_page(page):
    page.choose(ROOF)
    page.page.get_by_role("tab", name="Thermal").click()
    wait_for_layers(page, [ROOF, "insulation_deck", "deck_concrete"])
    assert page.part("behind").inner_text() == "Room air · film R 0.13 m² K W⁻¹"
    # With the keyboard, and then in the drawing.
    page.part("layer-1").focus()
    page.page.keyboard.press("Enter")
    page.page.locator('[data-testid="layer-1"][aria-pressed="true"]').wait_for(timeout=WAIT_MS)
    assert page.part("field-conductivity_w_m_k").input_value() == "0.035"
    assert not page.part("field-roughness_m").is_visible()
    assert not serious(page)
    page.edited("thickness_m", "0.28", pixel=False)
    # 0.008 / 0.23 + 0.28 / 0.035 + 0.2 / 2.3 + 0.13, of the tables and ISO 6946.
    page.part("totals").filter(has_text="8.25 m² K W⁻¹").wait_for(timeout=WAIT_MS)
    page.part("section").locator('[data-depth="2"]').click()
    page.page.locator('[data-testid="layer-2"][aria-pressed="true"]').wait_for(timeout=WAIT_MS)
    assert page.part("field-conductivity_w_m_k").input_value() == "2.3"
    page.part("layer-0").click()
    version = page.version
    page.part("layer-insert").click()
    assert set(serious(page)) <= {"color-contrast"}
    page.part("layer-material").fill("granite")
    page.page.get_by_role("option", name="granite", exact=True).click()
    page.part("layer-thickness-0").fill("thick")
    page.part("layer-accept").click()
    page.part("layer-fault").filter(has_text="thickness_m='thick' is not a number").wait_for(timeout=WAIT_MS)
    page.part("layer-thickness-0").fill("0.05")
    page.part("layer-accept").click()
    version = page.after(version)
    wait_for_layers(page, [ROOF, f"granite_of_{ROOF}", "insulation_deck", "deck_concrete"])
    page.part("layer-1").click()
    page.part("layer-remove").click()
    version = page.after(version)
    wait_for_layers(page, [ROOF, "insulation_deck", "deck_concrete"])


@pytest.mark.slow
def test_a_paste_is_said_in_words_before_it_is_used(page):
    page.choose(ROOF)
    source, version = page.part("field-source").input_value(), page.version
    page.part("load").click()
    assert page.part("replace").is_disabled()
    page.part("paste").fill("7\t4,0\n10\t45\n14\t0,5\n")
    page.part("load-fault").filter(has_text="and 2 of 3 rows exceed 1").wait_for(timeout=WAIT_MS)
    assert page.part("replace").is_disabled()
    page.part("paste").fill("7,0\t4,0\n10,0\t4,5\n14,0\t5,0\n")
    said = "Read: 3 rows, 7–14 µm, percent read as emissivity 0.04–0.05"
    page.part("load-words").filter(has_text=said).wait_for(timeout=WAIT_MS)
    assert page.part("load-fault").inner_text() == ""
    # Axe takes the backdrop of a dialog to lie behind its buttons.
    assert set(serious(page)) <= {"color-contrast"}
    with page.page.expect_file_chooser() as chooser:
        page.part("open-file").click()
    table = b"Wavelength (nm);eps\n7e3;0,1\n14e3;0,1"
    chooser.value.set_files({"name": "mine.csv", "mimeType": "text/csv", "buffer": table})
    said = "Read: 2 rows, 7–14 µm, nm read as µm and emissivity 0.1"
    page.part("load-words").filter(has_text=said).wait_for(timeout=WAIT_MS)
    page.part("paste").fill("7,0\t4,0\n10,0\t4,5\n14,0\t5,0\n")
    page.part("load-words").filter(has_text="Read: 3 rows").wait_for(timeout=WAIT_MS)
    page.part("replace").click()
    version = page.after(version)
    assert page.part("field-source").input_value() == f"spectrum from pasted text, before: {source}"
    assert page.part("band").inner_text().startswith("0.0")
    page.enter("emissivity", "4.0")
    refused = page.page.locator(".q-field__messages:visible").filter(has_text="emissivity=4 is not within 0…1")
    refused.wait_for(timeout=WAIT_MS)
    assert "divide by 100 if the values are percent" in refused.inner_text()
    page.enter("emissivity", "0.5")
    version = page.after(version)
    assert page.part("field-source").input_value() == f"edited by hand, before: {source}"


@pytest.mark.slow
def test_a_point_is_typed_and_the_solar_range_shown(page):
    page.choose("paint_own")
    assert "Solar absorptance over 0.3–2.5 µm 0.26 ± 0.02" in page.part("spectrum-words").inner_text()
    before, version = float(page.part("band").inner_text().split()[0]), page.version
    page.part("point-wavelength").fill("10")
    page.part("point-emissivity").fill("40")
    page.part("point-emissivity").press("Enter")
    page.page.get_by_text("divide by 100 if the values are percent").wait_for(timeout=WAIT_MS)
    page.part("point-emissivity").fill("0.4")
    page.part("point-emissivity").press("Enter")
    version = page.after(version)
    assert float(page.part("band").inner_text().split()[0]) < before - 0.02
    page.part("range").get_by_role("button", name="Solar").click()
    page.part("point-wavelength").wait_for(state="hidden")
    ends = page.page.evaluate(
        """() => {
            const element = document.querySelector('[data-testid=spectrum]');
            return getElement(Number(element.id.slice(1))).chart.getOption().xAxis[0];
        }"""
    )
    assert (ends["min"], ends["max"]) == (0.3, 2.5)
    page.part("range").get_by_role("button", name="Thermal").click()
    page.part("point-wavelength").wait_for()
    page.choose(ROOF)
    assert not page.part("range").is_visible()


@pytest.mark.slow
def test_swatches_have_the_colours_of_the_map(page):
    shown = {
        name: page.page.locator(f'tr[data-name="{name}"] .swatch').evaluate("e => getComputedStyle(e).backgroundColor")
        for name in ("paint_own", ROOF)
    }
    page.seen_from("From above")
    page.show("Material map")
    legend = page.page.locator("[data-testid=legend] > div")
    legend.first.wait_for(timeout=WAIT_MS)
    found = {
        each.inner_text(): each.locator(".swatch").evaluate("e => getComputedStyle(e).backgroundColor")
        for each in legend.all()
    }
    assert found == shown and len(set(found.values())) == 2
