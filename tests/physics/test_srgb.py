"""The sRGB curve against colour-science's, and bytes to light and back."""

import colour
import numpy as np

from thermorender.physics import srgb

BYTES = np.arange(256, dtype=np.uint8)


def test_decoding_a_byte_equals_colour_science_to_the_last_bit():
    expected = colour.models.eotf_sRGB(BYTES / 255.0)
    assert np.array_equal(srgb.decoded(BYTES / 255.0), expected)
    assert np.array_equal(srgb.linear_from_bytes(BYTES), expected.astype(np.float32))


def test_encoding_equals_colour_science():
    light = np.linspace(0.0, 1.0, 100_001)
    # Both raise to 1/2.4, and may round differently by a unit in the last place of 1.
    assert np.abs(srgb.encoded(light) - colour.models.eotf_inverse_sRGB(light)).max() <= 2.0**-52


def test_bytes_to_light_and_back():
    image = np.random.default_rng(0).integers(0, 256, (5, 7, 3)).astype(np.uint8)
    light = srgb.linear_from_bytes(image)
    assert light.shape == image.shape and light.dtype == np.float32
    assert np.array_equal(srgb.bytes_from_linear(light), image)
    assert np.array_equal(srgb.bytes_from_linear(np.array([-1.0, -0.0, 1e-30, 1.0, 7.0])), [0, 0, 0, 255, 255])


def test_encoding_and_decoding_keep_precision():
    for kind in (np.float32, np.float64):
        value = np.linspace(0.0, 1.0, 1001, dtype=kind)
        light = srgb.decoded(value)
        assert light.dtype == kind and srgb.encoded(light).dtype == kind
        # The standard's rounded constants leave a step of 3e-8 where the two parts of the curve meet; the steepest
        # part, 12.92, brings the rounding of light back as that of the value.
        assert np.abs(srgb.encoded(light) - value).max() < 3e-8 + 4.0 * np.finfo(kind).eps
