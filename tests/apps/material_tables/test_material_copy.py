"""Copies of materials with other values, and what `materials diff` says of them."""

import pytest

from thermorender.apps.material_tables.edit import copy_material
from thermorender.errors import ThermorenderError
from thermorender.materials.library import load_library


def test_copy_has_the_values_set_and_all_others(tmp_path, run):
    folder = tmp_path / "materials"
    options = ("--set", "solar_absorptance=0.25", "--set", "wetness=0.1")
    status, said, errors = run("copy", "soil_loam", "pale_loam", "--into", folder, *options)
    assert (status, errors) == (0, "") and said == f"{folder}: pale_loam, a copy of soil_loam\n"
    library = load_library(folder)
    copied, own = library["pale_loam"], library["soil_loam"]
    assert copied.solar_absorptance == 0.25 and own.solar_absorptance != 0.25
    assert copied.thermal.wetness == 0.1 and copied.thermal.source["wetness"].startswith("chosen:")
    assert copied.thermal.conductivity_w_m_k == own.thermal.conductivity_w_m_k
    assert (copied.emissivity == own.emissivity).all() and copied.citation == own.citation
    assert copied.note.startswith("Copy of soil_loam with solar_absorptance=0.25, wetness=0.1.")
    status, said, _ = run("diff", "soil_loam", "pale_loam", "--library", folder)
    assert f"solar_absorptance {own.solar_absorptance:g} → 0.25" in said
    assert f"wetness {own.thermal.wetness:g} → 0.1" in said and "+0.0" in said


def test_copy_under_its_own_name_overrides_the_shipped_material(tmp_path):
    copy_material("asphalt", "asphalt", tmp_path, {"emissivity": "0.9"})
    copy_material("asphalt", "darker", tmp_path, {"solar_absorptance": "0.97"}, library=tmp_path)
    library = load_library(tmp_path)
    assert {*library["asphalt"].emissivity} == {0.9} == {*library["darker"].emissivity}
    assert library["darker"].solar_absorptance == 0.97


def test_copy_of_a_directional_material_keeps_its_table(tmp_path):
    copy_material("water_fresnel", "pond", tmp_path, {"temperature_k": "290"})
    library = load_library(tmp_path)
    assert library["pond"].directional == library["water_fresnel"].directional == "fresnel"
    assert (library["pond"].emissivity_by_angle == library["water_fresnel"].emissivity_by_angle).all()


@pytest.mark.parametrize(
    ("source", "name", "settings", "match"),
    [
        (
            "soil_lome",
            "mine",
            {},
            "'soil_lome', which the library does not hold; the closest are soil_loam",
        ),
        ("soil_loam", "my loam", {}, "name='my loam' is not a material name"),
        ("soil_loam", "mine", {"solar": "0.2"}, "'solar' is not a property of a material; .*solar_absorptance"),
        ("soil_loam", "mine", {"solar_absorptance": "25"}, "solar_absorptance=25 is not within 0…1"),
        ("soil_loam", "mine", {"emissivity": "95"}, "emissivity=95 is not within 0…1"),
        ("soil_loam", "mine", {"wetness": "wet"}, "wetness='wet' is not a number"),
        ("soil_loam", "mine", {"beneath": "soil_lome"}, "given without thickness_m"),
        ("water_fresnel", "mine", {"emissivity": "0.9"}, r"water_fresnel emits by angle \(fresnel\)"),
    ],
)
def test_wrong_copies_are_refused_and_write_nothing(tmp_path, source, name, settings, match):
    with pytest.raises(ThermorenderError, match=match):
        copy_material(source, name, tmp_path / "m", settings)
    assert not list(tmp_path.rglob("*.csv"))
