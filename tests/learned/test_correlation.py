"""The published linear maps: coefficients, neighbourhood, range and the conversion to kinetic temperature."""

from dataclasses import replace

import numpy as np
import pytest

from thermorender.errors import ThermorenderError
from thermorender.learned.apply import kinetic_from_map
from thermorender.learned.temperature_map import MODELS, Inputs, load_model
from thermorender.materials.library import load_library
from thermorender.materials.material import grey
from thermorender.physics.planck import band_radiance, brightness_temperature


def intensity(model, rgb, texel_m=None):
    return model.intensity(model.radiance(Inputs(rgb, texel_m)))


def picture(height=40, width=30):
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)


def test_published_coefficients():
    assert MODELS["fok-1to1"].predictor.kernel.ravel().tolist() == [1.750, 0.236, -1.033]
    # Equation 9, row by row of the neighbourhood.
    red, green, blue = np.moveaxis(MODELS["fok-9to1"].predictor.kernel, -1, 0)
    assert red.ravel().tolist() == [0.680, -0.089, 0.853, -0.299, -0.973, -0.317, 0.991, -0.071, 1.112]
    assert green.ravel().tolist() == [0.789, -0.157, 0.511, -0.302, -0.872, -0.451, 0.544, -0.235, 0.329]
    assert blue.ravel().tolist() == [-1.314, 0.322, -1.201, 0.671, 1.873, 0.842, -1.380, 0.382, -1.279]
    np.testing.assert_allclose(MODELS["fok-9to1"].predictor.kernel.sum(axis=(0, 1)), [1.887, 0.156, -1.084], atol=1e-12)


def test_one_to_one_spans_the_published_range():
    model = load_model("fok-1to1")
    extremes = np.array([[[255, 255, 0], [0, 0, 255]]], dtype=np.uint8)
    np.testing.assert_allclose(intensity(model, extremes)[0], [1.986, -1.033], atol=1e-12)
    celsius = brightness_temperature(model.radiance(Inputs(extremes))[0], *model.band_um) - 273.15
    np.testing.assert_allclose(celsius, [33.0, 2.4], atol=0.05)


def test_nine_to_one_equals_equation_six():
    rgb = picture()
    model = load_model("fok-9to1")
    found = intensity(model, rgb)
    image = rgb / 255.0
    expected = np.zeros((38, 28))
    for i in range(38):
        for j in range(28):
            for k in range(3):
                for m in range(3):
                    expected[i, j] += model.predictor.kernel[k, m] @ image[i + k, j + m]
    np.testing.assert_allclose(found[1:-1, 1:-1], expected, atol=1e-12)
    assert found.shape == (40, 30)


def test_stating_the_published_ground_sampling_distance_changes_nothing():
    rgb = picture()
    for model in MODELS.values():
        np.testing.assert_allclose(intensity(model, rgb, model.texel_m), intensity(model, rgb), atol=1e-12)


def test_neighbourhood_scales_with_the_texel_size():
    model = load_model("fok-9to1")
    rgb = np.repeat(np.repeat(picture(12, 12), 4, axis=0), 4, axis=1)
    fine = intensity(model, rgb, model.texel_m / 4)
    # The middles of the fine picture's blocks see whole blocks only, like the coarse picture's pixels.
    block = fine.reshape(12, 4, 12, 4)[:, 1:3, :, 1:3].mean(axis=(1, 3))
    coarse = intensity(model, rgb[::4, ::4])
    assert np.corrcoef(block[2:-2, 2:-2].ravel(), coarse[2:-2, 2:-2].ravel())[0, 1] > 0.97
    # With the neighbourhood counted in texels the same picture gives something else.
    assert np.abs(intensity(model, rgb)[8:-8, 8:-8] - fine[8:-8, 8:-8]).max() > 0.5
    for texel_m in (0.02, 0.1, 0.5, 6.0):
        flat = np.full((30, 30, 3), 128, np.uint8)
        np.testing.assert_allclose(intensity(model, flat, texel_m), 128 / 255 * model.predictor.kernel.sum(), atol=1e-9)


def test_a_tap_averages_its_whole_area():
    # Stripes one texel wide, four to a tap: averaging nearly removes them, picking single texels keeps them.
    stripes = np.zeros((32, 32, 3), np.uint8)
    stripes[:, ::2] = 255
    model = load_model("fok-1to1")
    averaged = intensity(model, stripes, model.texel_m / 4)[8:-8, 8:-8]
    assert averaged.std() < 0.2 * intensity(model, stripes)[8:-8, 8:-8].std()


def test_intensity_is_linear_in_band_radiance():
    model = load_model("fok-1to1", (10.0, 30.0))
    ends = band_radiance(np.array([283.15, 303.15]), *model.band_um)
    np.testing.assert_allclose(model.intensity(ends), [0.0, 1.0], atol=1e-12)
    # At a grey of 0.5 the intensity is half the sum of the weights.
    half = model.radiance(Inputs(np.full((1, 1, 3), 128, np.uint8)))
    np.testing.assert_allclose(half, ends[0] + (ends[1] - ends[0]) * 0.953 * 128 / 255, atol=1e-12)
    middle = brightness_temperature(ends.mean(), *model.band_um) - 273.15
    assert 20.2 < middle < 20.8
    published = band_radiance(np.array([287.15, 297.15]), *model.band_um).mean()
    assert brightness_temperature(published, *model.band_um) - 273.15 - 19.0 == pytest.approx(0.13, abs=0.01)


def test_kinetic_temperatures_and_their_flags():
    model = load_model("fok-1to1")
    library = load_library()
    materials = (library["grass_green"], library["brass"], grey("dark", 1.0))
    rgb = np.full((3, 4, 3), 120, np.uint8)
    material = np.repeat(np.arange(3, dtype=np.uint8)[:, None], 4, axis=1)
    temperature, trusted, outside = kinetic_from_map(model, Inputs(rgb, 0.157), material, materials)
    apparent = brightness_temperature(model.radiance(Inputs(rgb)), *model.band_um)
    assert trusted[0].all() and not trusted[1].any() and trusted[2].all()
    assert (temperature[1] == library["brass"].temperature).all()
    np.testing.assert_allclose(temperature[2], apparent[2], atol=1e-3)
    # Grass reflects a sky colder than itself, so it must be warmer than it appears.
    assert 0.3 < (temperature[0] - apparent[0]).mean() < 1.5
    assert outside == 0.0
    blue = np.zeros((3, 4, 3), np.uint8)
    blue[..., 2] = 255
    assert kinetic_from_map(model, Inputs(blue, 0.157), material, materials)[2] == 1.0
    yellow = 255 - blue
    assert kinetic_from_map(model, Inputs(yellow, 0.157), material, materials)[2] == 1.0


def test_untrusted_texels_get_their_materials_temperature():
    model = load_model("fok-1to1")
    shiny, dull = replace(grey("shiny", 0.45), temperature=311.0), replace(grey("dull", 0.55), temperature=312.0)
    # 9 °C and 33 °C apparent; under a sky of 255 K the dull surface is then at about 25 °C and 70 °C.
    rgb = np.array([[[0, 0, 124], [255, 255, 0]]] * 2, np.uint8)
    material = np.array([[0, 0], [1, 1]], np.uint8)
    temperature, trusted, _ = kinetic_from_map(model, Inputs(rgb, model.texel_m), material, (shiny, dull))
    assert trusted.tolist() == [[False, False], [True, False]]
    assert temperature[~trusted].tolist() == [311.0, 311.0, 312.0]
    assert 290.0 < temperature[1, 0] < 305.0


def test_neighbourhood_in_metres_also_applies_to_temperatures():
    model, rgb, black = load_model("fok-9to1"), picture(12, 12), grey("black", 1.0)
    material = np.zeros((12, 12), np.uint8)
    temperature, trusted, _ = kinetic_from_map(model, Inputs(rgb, model.texel_m / 4), material, (black,))
    expected = brightness_temperature(model.radiance(Inputs(rgb, model.texel_m / 4)), *model.band_um)
    np.testing.assert_allclose(temperature[trusted], expected[trusted], atol=1e-3)
    assert trusted.mean() > 0.5


def test_wrong_arguments_are_refused():
    with pytest.raises(ThermorenderError, match=r"'fok-1to2' is unknown; did you mean 'fok-1to1'.*fok-9to1"):
        load_model("fok-1to2")
    with pytest.raises(ThermorenderError, match=r"range_c=\(24, 14\) is not a range.*coldest first"):
        load_model("fok-1to1", (24, 14))
