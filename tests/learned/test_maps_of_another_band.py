"""Learned maps under cameras of another band: temperatures of the ground, pictures, materials."""

from dataclasses import replace

import numpy as np
import pytest

import thermorender as tr
from scenes import WEATHER, write_balance, write_terrain
from thermorender.errors import ThermorenderError
from thermorender.learned.apply import InBand
from thermorender.learned.correlation import Correlation
from thermorender.learned.temperature_map import Inputs, TemperatureMap, load_model, save_map
from thermorender.materials.csv_tables import INDEX_COLUMNS
from thermorender.materials.library import load_library
from thermorender.materials.mixture import mix
from thermorender.physics.band import radiance_in_band
from thermorender.physics.planck import band_radiance, brightness_temperature

pytestmark = pytest.mark.usefixtures("short_heat")

LONG, MID = (7.5, 13.5), (3.7, 4.8)
AIR = '[atmosphere]\nstandard = "midlatitude-summer"\n'


def under_air(folder):
    """Replace the sky of a scene's folder by air, and return it."""
    text = (folder / "scene.toml").read_text()
    start = text.index("[sky]")
    (folder / "scene.toml").write_text(text[:start] + AIR + text[text.index("\n", start + 6) + 1 :])
    return folder


def mid_wave(scene):
    return scene.with_camera(replace(scene.camera, name="mid", band_um=MID))


def of_air(path, kelvin=5.0):
    """A map of kelvin above the air, which takes hour and weather."""
    save_map(TemperatureMap(path.stem, "by hand", Correlation(np.zeros((1, 1, 3)), kelvin, above_air=True),
                            (270.0, 330.0), LONG, 0.5, (0.4, 0.6), "boson-640", 230.0, "a test"), path)  # fmt: skip


# --- radiance ---------------------------------------------------------------------------------------------------


def test_radiance_in_another_band_keeps_the_temperature():
    kelvin = np.random.default_rng(1).uniform(230.0, 400.0, (200, 100))
    for picture in (kelvin, kelvin[:2, :2]):
        found = radiance_in_band(band_radiance(picture, *LONG), LONG, MID)
        np.testing.assert_allclose(brightness_temperature(found, *MID), picture, atol=3e-4)
    own = band_radiance(kelvin, *LONG)
    assert radiance_in_band(own, LONG, list(LONG)) is own
    odd = np.array([[0.0, -3.0, np.nan, 1e-30]])
    found = radiance_in_band(odd, LONG, MID)
    assert found.shape == odd.shape and found[0, 0] == 0.0 and found[0, 1] < 0.0 and np.isnan(found[0, 2])
    assert 0.0 <= found[0, 3] < 1e-12


def test_a_maps_picture_has_the_same_temperature_in_a_cameras_band():
    model = load_model("fok-1to1")
    inputs = Inputs(np.random.default_rng(2).integers(0, 256, (40, 50, 3), np.uint8))
    own, seen = model.radiance(inputs), model.radiance(inputs, MID)
    np.testing.assert_array_equal(model.radiance(inputs, tuple(model.band_um)), own)
    there = own > 0.0
    assert there.mean() > 0.9 and (seen[there] < 0.1 * own[there]).all()
    np.testing.assert_allclose(
        brightness_temperature(seen[there], *MID), brightness_temperature(own[there], *model.band_um), atol=3e-4
    )
    assert model.band_note(tuple(model.band_um)) is None and "another band" in model.band_note(MID)


# --- sky --------------------------------------------------------------------------------------------------------


def test_the_sky_in_a_band_is_that_of_a_camera_of_the_band(tmp_path):
    plain = tr.load_scene(write_terrain(tmp_path / "plain"))
    assert mid_wave(plain).sky_temperature_in(LONG) == plain.sky_temperature == 260.0
    airy = tr.load_scene(under_air(write_terrain(tmp_path / "airy")))
    other = mid_wave(airy)
    assert airy.sky_temperature_in(list(airy.camera.band_um)) == airy.sky_temperature
    assert other.sky_temperature_in(LONG) == airy.sky_temperature
    assert other.sky_temperature_in(MID) == other.sky_temperature > airy.sky_temperature + 1.0
    assert airy.sky_temperature_in(MID) == other.sky_temperature


def test_air_that_lacks_a_maps_band_is_refused_in_one_sentence(tmp_path):
    scene = tr.load_scene(under_air(write_terrain(tmp_path / "s")))
    with pytest.raises(ThermorenderError, match="a learned map of 2–3 µm needs the sky of this band"):
        scene.sky_temperature_in((2.0, 3.0))


@pytest.mark.parametrize("air", [AIR, '[atmosphere]\nstandard = "weather"\n'])
def test_a_conditional_maps_temperatures_do_not_depend_on_the_cameras_band(tmp_path, air):
    """The sky differs by tens of kelvin between the bands, and the ground reflects it."""
    folder = tmp_path / "s"
    folder.mkdir()
    of_air(folder / "above.npz")
    write_balance(folder, WEATHER + "[frame]\nlatitude_deg = 52.2\nlongitude_deg = 20.9\nheight_m = 100.0\n",
                  source='source = "learned"\nmodel = "above.npz"')  # fmt: skip
    text = under_air(folder) / "scene.toml"
    text.write_text(text.read_text().replace(AIR, air))
    scene = tr.load_scene(folder)
    kelvin = [tr.Renderer(each, rays=4).scene.surfaces[0].temperature for each in (scene, mid_wave(scene))]
    np.testing.assert_allclose(kelvin[1], kelvin[0], atol=1e-3)
    assert np.ptp(kelvin[0]) > 0.1


# --- materials --------------------------------------------------------------------------------------------------


def learned(folder, material, model="fok-1to1"):
    """A scene of grass and another material with a learned map."""
    write_balance(folder, "", source=f'source = "learned"\nmodel = "{model}"')
    text = (folder / "scene.toml").read_text()
    (folder / "scene.toml").write_text(text.replace("sand_quartz", material))
    return folder


@pytest.mark.parametrize("material", ["steel_galvanised", "paint_olive"])
def test_a_material_is_extended_to_the_maps_band_as_to_a_cameras(tmp_path, material):
    folder = learned(tmp_path / "s", material)
    scene = tr.load_scene(folder)
    other = mid_wave(scene)
    np.testing.assert_array_equal(other.surfaces[0].temperature, scene.surfaces[0].temperature)
    np.testing.assert_array_equal(other.surfaces[0].flags, scene.surfaces[0].flags)


def test_a_mixture_is_extended_by_its_parts():
    library = load_library()
    parts = [(library["paint_olive"], 0.4), (library["grass_green"], 0.6)]
    model = load_model("fok-1to1")
    found = InBand(model, [mix(parts)])[0].band_emissivity(*model.band_um, 300.0)
    each = [InBand(model, [material])[0].band_emissivity(*model.band_um, 300.0) * share for material, share in parts]
    assert found == pytest.approx(sum(each), abs=1e-9)


def test_a_material_that_lacks_the_maps_band_is_named_with_map_and_scene(tmp_path):
    folder = tmp_path / "s"
    spectra = folder / "materials" / "spectra"
    spectra.mkdir(parents=True)
    cells = dict.fromkeys(INDEX_COLUMNS, "x") | dict.fromkeys([c for c in INDEX_COLUMNS if "colour" in c], "9")
    cells |= {"name": "short", "directional": "lambertian", "solar_absorptance": "1", "temperature_k": "300",
              "samples": "1"}  # fmt: skip
    rows = [",".join(INDEX_COLUMNS), ",".join(cells[column] for column in INDEX_COLUMNS)]
    (spectra.parent / "index.csv").write_text("\n".join(rows) + "\n")
    (spectra / "short.csv").write_text("wavelength_um,emissivity,emissivity_std\n3,0.9,\n6,0.9,\n")
    learned(folder, "short")
    text = (folder / "scene.toml").read_text()
    (folder / "scene.toml").write_text(text + '[camera]\nmodel = "neutrino-lc"\n')
    with pytest.raises(ThermorenderError) as raised:
        tr.load_scene(folder)
    words = str(raised.value)
    for word in ("scene.toml", "learned map 'fok-1to1'", "7.5–13.5 µm", "material 'short' covers 3–6 µm", "choose"):
        assert word in words
