"""Versions of labelled land and made lands: measured colours, other cover, roofs one each, what covers each kind."""

import numpy as np
import pytest

from thermorender.apps.training import measured_colours, varied_land
from thermorender.apps.training.emissivity_training import Labelled
from thermorender.apps.training.made_land import MAKERS, made_land
from thermorender.apps.training.measured_colours import COLOURS, ROOFS
from thermorender.apps.training.varied_land import CLIMATES, versions
from thermorender.materials.library import load_library
from thermorender.physics.srgb import linear_from_bytes


@pytest.fixture(scope="module")
def land():
    material = np.zeros((60, 90), np.uint8)
    material[:, :30], material[:, 30:60] = 1, 2
    for column in (65, 77):
        material[10:20, column : column + 8] = 3
    colour = np.array([[0, 0, 0], [90, 120, 60], [110, 110, 110], [120, 60, 50]], np.uint8)
    noise = np.random.default_rng(0).integers(-10, 11, (60, 90, 1))
    rgb = (colour[material] + noise).clip(0, 255).astype(np.uint8)
    return Labelled(rgb, material, {1: "grass_green", 2: "asphalt", 3: "roof_slate"}, 0.5, "land", "kind")


def test_all_materials_are_in_the_library():
    named = {name for climate in CLIMATES.values() for options in climate.values() for name in options}
    assert named | set(COLOURS) | set(ROOFS) <= set(load_library())
    assert sum(ROOFS.values()) == pytest.approx(1.0)


def test_versions_have_the_colours_of_measured_samples(land, monkeypatch):
    monkeypatch.setattr(measured_colours, "_BRIGHTNESS", 0.0)
    monkeypatch.setattr(measured_colours, "_TINT", 0.0)
    made = list(versions(land, 6, np.random.default_rng(1)))
    for one in made:
        numbers = {name: number for number, name in one.names.items()}
        light = linear_from_bytes(one.rgb)[one.material == numbers["asphalt"]].mean(axis=0)
        away = np.abs(np.array(COLOURS["asphalt"]) - light).max(axis=1).min()
        # Bytes and noise of ten levels move the mean by less than this.
        assert away < 0.01
        assert one.domain == "kind" and one.texel_m == 0.5
        assert np.array_equal(one.material == 0, land.material == 0)
    assert len({one.rgb[30, 45].tobytes() for one in made}) > 1


@pytest.mark.parametrize("climate", CLIMATES)
def test_roofs_are_covered_one_each_and_cover_follows_the_climate(land, climate, monkeypatch):
    monkeypatch.setattr(varied_land, "CLIMATES", {climate: CLIMATES[climate]})
    roofs, cover = set(), set()
    for one in versions(land, 10, np.random.default_rng(2)):
        names = np.array(["", *(one.names[k] for k in sorted(one.names))])[one.material]
        pair = names[15, 68], names[15, 80]
        assert set(pair) <= set(ROOFS) and one.source == "land"
        roofs.add(pair)
        cover |= set(np.unique(names[:, :30]))
    assert any(one != other for one, other in roofs)
    assert cover == set(CLIMATES[climate].get("grass_green", ("grass_green",)))


@pytest.mark.parametrize("kind", MAKERS)
def test_a_made_land_is_reproducible_and_labelled_everywhere(kind):
    one, same, other = made_land(kind, 3), made_land(kind, 3), made_land(kind, 4)
    assert np.array_equal(one.rgb, same.rgb) and np.array_equal(one.material, same.material)
    assert not np.array_equal(one.rgb, other.rgb)
    assert (one.material > 0).all() and one.domain == kind
    assert set(one.names.values()) <= set(load_library())


@pytest.mark.parametrize(
    ("kind", "materials", "low", "high"),
    [
        ("town", ROOFS, 0.1, 0.8), ("suburb", ROOFS, 0.05, 0.6), ("coast", ["water"], 0.2, 0.8),
        ("quarry", ["granite", "limestone", "sand_quartz", "soil_loam", "soil_arid", "soil_dark"], 0.4, 1.0),
        ("fields", ["grass_green", "grass_dry", "soil_loam", "soil_dark", "soil_arid", "broadleaf"], 0.7, 1.0),
    ],
)  # fmt: skip
def test_a_made_land_is_covered_by_what_its_kind_says(kind, materials, low, high):
    land = made_land(kind, 3)
    share = {name: (land.material == number).mean() for number, name in land.names.items()}
    assert low < sum(share.get(name, 0.0) for name in materials) < high


def test_texels_of_a_made_land_have_colours_of_their_material():
    """Shadows and slopes aside, the median roof and lawn have the brightness of measured samples."""
    land = made_land("suburb", 3)
    light = linear_from_bytes(land.rgb).mean(axis=-1)
    for number, name in land.names.items():
        samples = np.array(COLOURS.get(name, np.zeros((0, 3)))).mean(axis=-1)
        here = light[land.material == number]
        if samples.size and here.size > 2000 and name != "water":
            assert 0.2 * samples.min() < np.median(here) < 2.5 * samples.max(), name
