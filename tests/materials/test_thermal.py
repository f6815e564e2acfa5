"""Thermal properties of materials: the shipped ones against published numbers, and the text of every error."""

import csv
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import solve_banded

from scenes import write_terrain
from thermorender.apps.material_tables.check import check
from thermorender.errors import ThermorenderError
from thermorender.formats import write_text
from thermorender.materials import store as store_module
from thermorender.materials.csv_tables import INDEX_COLUMNS
from thermorender.materials.library import load_library, read_library
from thermorender.materials.material import ASSUMED_SOLAR_STD, grey
from thermorender.materials.mixture import mix
from thermorender.materials.store import write_material
from thermorender.materials.thermal import (
    COVERS,
    ENDS,
    NUMBERS,
    PROPERTIES,
    beneath,
    read_thermal,
    read_thermals,
    table_text,
)
from thermorender.paths import data_folder
from thermorender.scene.load import load_scene

SHIPPED = data_folder("materials")
LIBRARY = load_library()

# Oke, Boundary Layer Climates (2nd ed. 1987), tables 2.1 and 7.4: the column of thermal admittance [J m⁻² K⁻¹ s^-½],
# which none of our tables is based on. Soils are between the dry and the saturated one; the steel there is different.
ADMITTANCE = {
    "sand_quartz": (620, 620), "water": (1545, 1545), "ice": (2080, 2080), "asphalt": (1205, 1205),
    "concrete": (1785, 1785), "brick_clay": (1065, 1065), "paint_black": (14475, 14475), "granite": (2220, 2220),
    "soil_loam": (600, 2550), "soil_arid": (600, 2550), "soil_dark": (190, 2210), "grass_green": (190, 2210),
    "snow": (130, 595), "snow_coarse": (130, 595),
}  # fmt: skip

TABLE = """property,value,uncertainty,source
cover,bare,,by its nature
conductivity_w_m_k,0.75,0.2,handbook
density_kg_m3,2110,100,handbook
specific_heat_j_kg_k,920,60,handbook
thickness_m,0.1,0.03,chosen: a usual road
beneath,soil_loam,,chosen: no table of gravel
roughness_m,0.002,0.002,chosen: smooth
heat_roughness_ratio,2.7,1,chosen: as a formula says
wetness,0,0.02,chosen: dry
water_share,0,0.01,chosen: dry
"""
ROW = {
    "name": "tin", "title": "Tin roof", "colour_r": "200", "colour_g": "200", "colour_b": "205",
    "solar_absorptance": "0.4", "directional": "lambertian", "temperature_k": "310", "samples": "1",
    "source": "own measurement", "citation": "none", "licence": "CC0", "note": "",
}  # fmt: skip


def folder(path, thermals, rows=()):
    """A materials folder of tables of thermal properties by name, and of index rows with a grey spectrum."""
    for name, text in thermals.items():
        write_text(path / "thermal" / f"{name}.csv", text)
    if rows:
        path.mkdir(parents=True, exist_ok=True)
        with open(path / "index.csv", "w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, list(dict.fromkeys([*INDEX_COLUMNS, *rows[0]])))
            writer.writeheader()
            writer.writerows(rows)
    for row in rows:
        spectrum = "wavelength_um,emissivity,emissivity_std\n" + "".join(f"{w},0.2,\n" for w in range(7, 15))
        write_text(path / "spectra" / f"{row['name']}.csv", spectrum)
    return path


def edited(**cells):
    """TABLE with other lines at its end: a value, or value, uncertainty and source, or None for no line."""
    lines = TABLE.splitlines()
    for key, value in cells.items():
        lines = [line for line in lines if not line.startswith(f"{key},")]
        if value is not None:
            lines.append(",".join([key, *([value, "0.1", "handbook"] if isinstance(value, str) else value)]))
    return "\n".join(lines) + "\n"


# --- shipped tables ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", list(LIBRARY))
def test_every_shipped_material_is_complete(name):
    thermal = LIBRARY[name].known_thermal()
    assert thermal.cover in COVERS
    for key, value in thermal.values.items():
        if value not in (None, ""):
            assert thermal.source[key].removeprefix("chosen:").strip(), key
        if key in NUMBERS and value is not None:
            low, high, _ = NUMBERS[key]
            assert low <= value <= high and np.isfinite(value) and thermal.uncertainty[key] >= 0.0, key
    # A number that is exact is one by definition.
    exact = {key for key, spread in thermal.uncertainty.items() if spread == 0.0}
    assert exact <= {"melting_k", "surface_resistance_s_m", "wetness", "water_share"}
    assert thermal.layers[-1].beneath in ("", *ENDS)
    assert all(one.below is other for one, other in zip(thermal.layers, thermal.layers[1:], strict=False))
    assert 0.0 < LIBRARY[name].solar_absorptance_std < 0.5


def test_shipped_tables_belong_to_materials_and_are_in_canonical_form():
    thermals = read_thermals(SHIPPED)
    assert set(thermals) == set(LIBRARY) | beneath(thermals) - {"", *ENDS}
    for name, thermal in thermals.items():
        assert (SHIPPED / "thermal" / f"{name}.csv").read_text("utf-8") == table_text(thermal), name


def test_the_daily_wave_falls_to_1_over_e_at_the_penetration_depth():
    """Against finite differences of the heat equation with a wave of 24 h at the surface."""
    for name in ("soil_loam", "granite", "snow"):
        thermal = LIBRARY[name].thermal
        depth = thermal.diurnal_depth_m
        step, count = depth / 200.0, 4000
        # k T'' = i ω ρ c T, with T = 1 at the surface and 0 far below.
        wave = 2j * np.pi / 86400.0 * thermal.heat_capacity_j_m3_k * step**2 / thermal.conductivity_w_m_k
        bands = np.array([np.ones(count), np.full(count, -2.0 - wave), np.ones(count)])
        right = np.zeros(count, complex)
        right[0] = -1.0
        amplitude = np.abs(solve_banded((1, 1), bands, right))
        assert amplitude[199] == pytest.approx(np.exp(-1.0), rel=1e-4)
    assert LIBRARY["water"].thermal.diurnal_depth_m is None


def test_resistances_are_those_of_iso_6946():
    """A flat roof by its tables: 8 mm of bitumen, 14 cm of insulation, 20 cm of concrete, and a film of 0.13."""
    roof = LIBRARY["roof_flat_membrane"].thermal
    assert [each.resistance_m2_k_w for each in roof.layers] == pytest.approx([0.008 / 0.23, 0.14 / 0.035, 0.2 / 2.3])
    assert roof.resistance_to_air_m2_k_w == pytest.approx(0.034783 + 4.0 + 0.086957 + 0.13, abs=1e-5)
    assert LIBRARY["roof_tile_loft"].thermal.resistance_to_air_m2_k_w == pytest.approx(0.018 + 0.13)
    assert [each.resistance_m2_k_w for each in LIBRARY["ice"].thermal.layers][1:] == [None, None]
    assert LIBRARY["grass_green"].thermal.resistance_to_air_m2_k_w is None
    bark = LIBRARY["bark"].thermal
    with_leaves = replace(bark, skin_conductance_w_m2_k=10.0)
    assert with_leaves.resistance_to_air_m2_k_w - bark.resistance_to_air_m2_k_w == pytest.approx(0.1)


@pytest.mark.parametrize("name", list(ADMITTANCE))
def test_thermal_inertia_against_published_admittances(name):
    low, high = ADMITTANCE[name]
    thermal = LIBRARY[name].thermal
    # Three digits are printed, for k and for ρc: 1 %. Rock and steel were taken from another book: 10 %.
    slack = 0.1 if name in ("granite", "paint_black") else 0.01
    assert low * (1 - slack) <= thermal.inertia <= high * (1 + slack)
    assert thermal.inertia == pytest.approx(
        (thermal.conductivity_w_m_k * thermal.density_kg_m3 * thermal.specific_heat_j_kg_k) ** 0.5
    )


@pytest.mark.parametrize(
    ("name", "diffusivity"),
    [("sand_quartz", 0.24e-6), ("water", 0.14e-6), ("ice", 1.16e-6), ("asphalt", 0.38e-6), ("concrete", 0.72e-6),
     ("brick_clay", 0.61e-6)],
)  # fmt: skip
def test_diffusivity_against_published_values(name, diffusivity):
    """The same tables' column of thermal diffusivity [m²/s]: two digits for it, k and ρc leave 3 %."""
    thermal = LIBRARY[name].thermal
    found = thermal.conductivity_w_m_k / thermal.heat_capacity_j_m3_k
    assert found == pytest.approx(diffusivity, rel=0.03)


def test_conductivity_of_snow_agrees_with_another_fit_to_measurements():
    """Sturm et al. 1997 (doi:10.3189/S0022143000002781): quadratic in density above 156 kg/m³, scatter ± 0.1."""
    for name in ("snow", "snow_medium", "snow_coarse"):
        thermal = LIBRARY[name].thermal
        density = thermal.density_kg_m3 / 1000.0
        expected = 0.138 - 1.01 * density + 3.233 * density**2
        assert abs(thermal.conductivity_w_m_k - expected) < 0.13 and thermal.melting_k == 273.15


def test_metals_are_sheets_and_leaves_are_above_the_ground():
    for name, material in LIBRARY.items():
        thermal = material.thermal
        if thermal.conductivity_w_m_k > 20.0:
            assert thermal.beneath in ("outside", "insulation_panel") and 0.0005 <= thermal.thickness_m <= 0.002, name
        assert (thermal.cover == "leaves") == (thermal.skin_conductance_w_m2_k is not None), name
        assert (thermal.cover in ("water", "snow")) == (thermal.wetness == 1.0), name


def test_unmeasured_values_are_marked():
    thermal = LIBRARY["asphalt"].thermal
    assert {"thickness_m", "beneath", "wetness"} <= set(thermal.chosen)
    assert not {"conductivity_w_m_k", "density_kg_m3", "cover"} & set(thermal.chosen)
    # Soil moisture was chosen, and all values that follow from it.
    assert "conductivity_w_m_k" in LIBRARY["soil_loam"].thermal.chosen


# --- a hand-written table ---------------------------------------------------------------------------------


def test_a_table_is_read_and_written_back(tmp_path):
    write_text(tmp_path / "a.csv", TABLE)
    thermal = read_thermal(tmp_path / "a.csv")
    assert thermal.conductivity_w_m_k == 0.75 and thermal.uncertainty["conductivity_w_m_k"] == 0.2
    assert thermal.source["thickness_m"] == "chosen: a usual road" and thermal.beneath == "soil_loam"
    assert thermal.skin_conductance_w_m2_k is None and thermal.melting_k is None and thermal.attenuation_1_m is None
    assert thermal.surface_resistance_s_m is None
    assert thermal.heat_capacity_j_m3_k == 2110 * 920
    write_text(tmp_path / "b.csv", table_text(thermal))
    assert read_thermal(tmp_path / "b.csv") == thermal
    # An empty row has the same meaning as no row.
    write_text(tmp_path / "c.csv", TABLE + "melting_k,,,\n,,,\n")
    assert read_thermal(tmp_path / "c.csv") == thermal
    with pytest.raises(ThermorenderError, match=r"beneath='soil_loam' has not been looked up; .*load_library"):
        _ = thermal.layers


FAULTS = [
    (edited(conductivity_w_m_k="750"), r", row 11: conductivity_w_m_k=750 is not within 0.005…450; .*in mW"),
    (edited(density_kg_m3="2.11"), r"density_kg_m3=2.11 is not within 20…23000; multiply by 1000 .*g/cm³"),
    (edited(density_kg_m3="19.3"), r"density_kg_m3=19.3 is not within 20…"),
    (edited(specific_heat_j_kg_k="0.92"), r"specific_heat_j_kg_k=0.92 is not within 100…5000; .*kJ"),
    (
        edited(conductivity_w_m_k="300", density_kg_m3="1600"),
        r"conductivity_w_m_k=300 is that of a metal, at density_kg_m3=1600; divide it by 1000",
    ),
    (edited(conductivity_w_m_k="warm"), r"conductivity_w_m_k='warm' is not a number; .*no unit"),
    (edited(conductivity_w_m_k="nan"), r"conductivity_w_m_k=nan is not within"),
    (edited(melting_k="0"), r"melting_k=0 is not within 150…3700; values are kelvin"),
    (edited(wetness="30"), r"wetness=30 is not within 0…1; give a share, 0.3 for 30 %"),
    (edited(roughness_m="0"), r"roughness_m=0 is not within 1e-07…10"),
    (edited(thickness_m="0"), r"thickness_m=0 is not within 1e-05…200"),
    (edited(cover=["lawn", "", "handbook"]), r"cover='lawn' is not known; write bare, leaves, water or snow"),
    (edited(cover=["snow", "", "handbook"]), r"melting_k of a snow cover is missing; write 273.15"),
    (edited(conductivity=["1", "1", "x"]), r"property='conductivity' is not known; did you mean conductivity_w_m_k"),
    (edited(zzz=["1", "1", "x"]), r"property='zzz' is not known; write one of cover, conductivity_w_m_k, density"),
    (TABLE + "wetness,0.5,0.1,x\n", r", row 12: property wetness is already in a row above"),
    (edited(wetness=None, density_kg_m3=None), r"a.csv: lacks density_kg_m3, wetness; add a row"),
    (edited(wetness=["", "", ""]), r"lacks wetness"),
    (edited(wetness=["0.5", "-0.1", "x"]), r"uncertainty of wetness=-0.1 is not within 0….*one standard deviation"),
    (edited(wetness=["0.5", "", "x"]), r"uncertainty of wetness='' is not a number"),
    (edited(wetness=["0.5", "0.1", ""]), r"source of wetness is empty; .*chosen:"),
    (edited(wetness=["0.5", "0.1", "chosen:"]), r"source of wetness is empty"),
    (
        edited(beneath=None),
        r"thickness_m has nothing beneath; name the material there, or inside, outside or ventilated",
    ),
    (edited(thickness_m=None), r"beneath='soil_loam' is given without thickness_m"),
    (TABLE.replace("uncertainty", "std"), r"row 1 lacks column uncertainty"),
]


@pytest.mark.parametrize(("text", "words"), FAULTS)
def test_faults_of_a_table_are_reported(tmp_path, text, words):
    write_text(tmp_path / "thermal" / "a.csv", text)
    with pytest.raises(ThermorenderError, match=words):
        read_thermal(tmp_path / "thermal" / "a.csv")
    # `check` reports it too: in a folder, and for the file alone.
    folder(tmp_path, {"asphalt": text})
    (tmp_path / "thermal" / "a.csv").unlink()
    for path in (tmp_path, tmp_path / "thermal" / "asphalt.csv"):
        assert any(finding.fault and finding.where.startswith(("thermal/asphalt.csv", "asphalt.csv"))
                   for finding in check(path))  # fmt: skip


def test_check_finds_all_faults_at_once(tmp_path, run):
    text = edited(conductivity_w_m_k="750", wetness=["0.5", "-1", ""], density_kg_m3=None, zzz=["1", "1", "x"])
    sand = edited(beneath=["asphlt", "", "x"])
    circle = edited(beneath=["water", "", "x"])
    folder(tmp_path, {"granite": text, "sand_quartz": sand, "soil_dark": circle, "concret": TABLE})
    reported = [str(finding) for finding in check(tmp_path)]
    expected = [
        "thermal/granite.csv, row 9: conductivity_w_m_k=750 is not within", "row 10: source of wetness is empty",
        "row 10: uncertainty of wetness=-1 is not within", "row 11: property='zzz'", "granite.csv: lacks density_kg_m3",
        "thermal/concret.csv: belongs to no material; did you mean concrete?",
        "thermal/sand_quartz.csv: beneath='asphlt' is not a material with thermal properties; did you mean asphalt?",
        "thermal/soil_dark.csv: beneath leads in a circle, soil_dark → water → soil_dark; leave the",
    ]  # fmt: skip
    for words in expected:
        assert sum(words in line for line in reported) == 1, (words, reported)
    assert len(reported) == len(expected)
    status, out, _ = run("check", tmp_path)
    assert status == 2 and "8 faults" in out
    # Tables over an unreadable table are not blamed for it.
    folder(tmp_path / "b", {"soil_loam": "property,value,uncertainty,source\n", "asphalt": TABLE})
    assert [finding.where for finding in check(tmp_path / "b")] == ["thermal/soil_loam.csv"]


# --- a scene's own tables override the shipped ones -------------------------------------------------------


def test_a_scenes_table_replaces_the_shipped_one(tmp_path):
    own = load_library(folder(tmp_path, {"asphalt": edited(wetness="0.5")}))
    assert own["asphalt"].thermal.wetness == 0.5 and LIBRARY["asphalt"].thermal.wetness == 0.0
    np.testing.assert_array_equal(own["asphalt"].emissivity, LIBRARY["asphalt"].emissivity)
    assert own["granite"].thermal == LIBRARY["granite"].thermal


def test_the_material_beneath_comes_from_the_scene_too(tmp_path):
    soil = edited(thickness_m=None, beneath=None, conductivity_w_m_k="2")
    own = load_library(folder(tmp_path, {"soil_loam": soil}))
    assert own["asphalt"].thermal.layers[1].conductivity_w_m_k == 2.0
    assert own["grass_green"].thermal.below.conductivity_w_m_k == 2.0


def test_a_user_material_has_the_properties_of_its_folder(tmp_path):
    rows = [ROW, ROW | {"name": "granite", "title": "Mine"}]
    own = load_library(folder(tmp_path / "a", {"tin": edited(beneath=["granite", "", "x"])}, rows))
    assert [layer.conductivity_w_m_k for layer in own["tin"].thermal.layers] == [0.75, 2.79]
    # Without its own table it keeps the shipped one of the same name.
    assert own["granite"].title == "Mine" and own["granite"].thermal == LIBRARY["granite"].thermal
    bare = load_library(folder(tmp_path / "b", {}, [ROW]))["tin"]
    assert bare.thermal is None
    with pytest.raises(ThermorenderError, match=r"material 'tin' has no thermal properties; add thermal/tin.csv"):
        bare.known_thermal()
    with pytest.raises(ThermorenderError, match="has no thermal properties"):
        mix([(LIBRARY["granite"], 0.5), (LIBRARY["asphalt"], 0.5)]).known_thermal()
    assert grey("g", 0.9).thermal is None


@pytest.mark.parametrize(
    ("thermals", "words"),
    [
        ({"asphlt": TABLE}, r"thermal.asphlt.csv belongs to no material; did you mean asphalt\? name it after one"),
        ({"sand_quartz": edited(beneath=["mud", "", "x"])}, r"sand_quartz.csv: beneath='mud' is not a material"),
        ({"soil_loam": edited(beneath=["asphalt", "", "x"])},
         r"soil_loam.csv: beneath leads in a circle, soil_loam → asphalt → soil_loam"),
        ({"asphalt": edited(beneath=["asphalt", "", "x"])}, r"beneath leads in a circle, asphalt → asphalt"),
        ({"asphalt": edited(beneath=["tin", "", "x"])}, r"beneath='tin' is not a material with thermal properties"),
    ],
)  # fmt: skip
def test_faults_of_an_overlay_are_reported(tmp_path, thermals, words):
    with pytest.raises(ThermorenderError, match=words):
        load_library(folder(tmp_path, thermals, [ROW]))


def test_a_link_that_leaves_the_folder_is_refused(tmp_path):
    folder(tmp_path / "m", {}, [ROW])
    write_text(tmp_path / "elsewhere.csv", TABLE)
    (tmp_path / "m" / "thermal").mkdir()
    (tmp_path / "m" / "thermal" / "tin.csv").symlink_to(tmp_path / "elsewhere.csv")
    with pytest.raises(ThermorenderError, match=r"tin.csv leads out of "):
        load_library(tmp_path / "m")


# --- solar absorptance ------------------------------------------------------------------------------------


def test_the_uncertainty_of_the_solar_absorptance(tmp_path):
    read = read_library(folder(tmp_path / "a", {}, [ROW | {"solar_absorptance_std": "0.11"}]))["tin"]
    assert read.solar_absorptance_std == read.solar_uncertainty == 0.11
    assert "absorbs 0.40 ± 0.11;" in str(read)
    for number, row in enumerate((ROW, ROW | {"solar_absorptance_std": ""})):
        unknown = read_library(folder(tmp_path / f"{number}", {}, [row]))["tin"]
        assert unknown.solar_absorptance_std is None and unknown.solar_uncertainty == ASSUMED_SOLAR_STD == 0.05
        assert "absorbs 0.40 ± 0.05 (assumed);" in str(unknown)
    bad = folder(tmp_path / "c", {}, [ROW | {"solar_absorptance_std": "5"}])
    with pytest.raises(ThermorenderError, match=r"row 2: solar_absorptance_std=5 is not within 0…1"):
        read_library(bad)
    assert any("solar_absorptance_std=5 is not within" in str(finding) for finding in check(bad))
    # Three samples and more have their own: reflectances of the basalts, by hand.
    assert LIBRARY["basalt"].solar_absorptance_std == pytest.approx(np.std([0.783, 0.795, 0.752], ddof=1), abs=6e-4)


# --- writing, showing, comparing, merging -----------------------------------------------------------------


def test_a_material_is_written_with_its_table_or_not_at_all(tmp_path, monkeypatch):
    granite = LIBRARY["granite"]
    write_material(granite, tmp_path)
    assert read_thermals(tmp_path)["granite"].values == granite.thermal.values
    assert read_library(tmp_path)["granite"].solar_absorptance_std == granite.solar_absorptance_std
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.csv")}
    # Measured again: the table of thermal properties stays.
    bare = read_library(folder(tmp_path / "other", {}, [ROW | {"name": "granite"}]))["granite"]
    write_material(bare, tmp_path, replace=True)
    assert read_thermals(tmp_path)["granite"] == read_thermals(SHIPPED)["granite"]
    for path, content in before.items():
        path.write_bytes(content)

    def full(path, text):
        if path.name == "index.csv" and path.parent == tmp_path:
            raise OSError("no space left")
        write_text(path, text)

    monkeypatch.setattr(store_module, "write_text", full)
    for material in (granite, LIBRARY["asphalt"]):
        with pytest.raises(OSError, match="no space"):
            write_material(material, tmp_path, replace=True)
    kept = [path for path in tmp_path.rglob("*.csv") if "other" not in path.parts]
    assert {path: path.read_bytes() for path in kept} == before


def test_show_prints_every_property_with_spread_and_source(run):
    status, out, _ = run("show", "asphalt")
    assert status == 0 and "inertia 1207 J m⁻² K⁻¹ s^-½" in out
    line = next(line for line in out.splitlines() if "conductivity_w_m_k" in line)
    assert "0.75 ± 0.25 " in line and " Oke, Boundary Layer Climates" in line
    assert "soil_loam" in next(line for line in out.splitlines() if line.strip().startswith("beneath"))
    assert "skin_conductance" not in out


def test_diff_reports_the_differences(tmp_path, run):
    """Over the shipped tables, and between two folders, also where a table has no row."""
    text = (SHIPPED / "thermal" / "asphalt.csv").read_text("utf-8")
    one = folder(tmp_path / "one", {"asphalt": text.replace("0.75,0.25", "0.9,0.25"), "tin": TABLE}, [ROW])
    two = folder(tmp_path / "two", {"asphalt": text}, [ROW])
    status, out, _ = run("diff", one)
    line = next(line for line in out.splitlines() if line.startswith("asphalt"))
    assert status == 0 and line.endswith("conductivity_w_m_k 0.9 → 0.75") and "2 differences" in out
    _, out, _ = run("diff", one, two)
    assert "conductivity_w_m_k" in out and "thermal properties only in the first" in out and "2 differences" in out
    assert "0 differences" in run("diff", one, one)[1]
    _, out, _ = run("diff", "granite", "marble")
    assert "density_kg_m3" in out and "water_share" in out


def test_merge_joins_each_table_separately(tmp_path, run):
    one = folder(tmp_path / "one", {"asphalt": TABLE, "granite": edited(thickness_m=None, beneath=None)})
    two = folder(tmp_path / "two", {"asphalt": edited(wetness="0.5"), "tin": TABLE}, [ROW])
    status, _, complaint = run("merge", one, two, "-o", tmp_path / "out")
    assert status == 2 and "hold asphalt differently" in complaint and not (tmp_path / "out").exists()
    for prefer, wetness in (("first", 0.0), ("second", 0.5)):
        out = tmp_path / prefer
        assert run("merge", one, two, "-o", out, "--prefer", prefer)[0] == 0
        made = load_library(out)
        assert made["asphalt"].thermal.wetness == wetness
        assert made["granite"].thermal.conductivity_w_m_k == made["tin"].thermal.conductivity_w_m_k == 0.75
    # The spectrum of one, the thermal properties of the other.
    three = folder(tmp_path / "three", {}, [ROW])
    four = folder(tmp_path / "four", {"tin": TABLE})
    assert run("merge", three, four, "-o", tmp_path / "both")[0] == 0
    assert load_library(tmp_path / "both")["tin"].thermal.beneath == "soil_loam"


def test_a_scenes_fingerprint_covers_them(tmp_path):
    copies = []
    for number, wetness in enumerate(("0.1", "0.1", "0.2")):
        copy = write_terrain(tmp_path / f"{number}" / "tiny")
        folder(copy / "materials", {"soil_loam": edited(thickness_m=None, beneath=None, wetness=wetness)})
        copies.append(load_scene(copy))
    used = {layer for material in copies[0].materials for layer in (material.name, material.thermal.beneath)}
    assert "soil_loam" in used
    assert copies[0].digest() == copies[1].digest() != copies[2].digest()


def test_the_names_of_the_format_match_the_documentation():
    text = (SHIPPED / "README.md").read_text("utf-8")
    assert all(f"| `{key}` |" in text for key in PROPERTIES)
