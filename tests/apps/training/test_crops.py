"""Training crops: their order, what they show, and the encoding measured on them."""

from dataclasses import replace

import numpy as np
import pytest
from training_support import TEMPERATURE, example, kelvin, picture, task_of

from thermorender.apps.training.networks.crops import Crops, measured
from thermorender.errors import ThermorenderError
from thermorender.learned.networks.encoding import Encoding


def test_crops_depend_only_on_seed_and_number():
    examples = [example(seed) for seed in range(12)]
    first, again, other = (Crops(task_of("unet", examples, seed=seed), 64, False) for seed in (3, 3, 4))
    some = first.batch(0, 700)
    for number in (699, 5, 256, 0):
        (alone,) = again.batch(number, 1)
        assert np.array_equal(alone.inputs.rgb, some[number].inputs.rgb)
        assert np.array_equal(alone.target, some[number].target)
    assert any(not np.array_equal(a.inputs.rgb, b.inputs.rgb) for a, b in zip(some, other.batch(0, 20), strict=False))


def test_crops_of_both_pictures_show_the_same_and_are_mirrored():
    examples = [example(seed) for seed in range(12)]
    crops = Crops(task_of("unet", examples), 64, False)
    mirrored = 0
    for crop in crops.batch(0, 256):
        # Equal up to rounding: both were cut and mirrored in the same way.
        assert np.abs(280.0 + 20.0 * crop.target - kelvin(crop.inputs.rgb)).max() < 0.006 and crop.valid.all()
        mirrored += not any(_holds(each.inputs.rgb, crop.inputs.rgb) for each in examples)
    # One half, within four standard deviations of 256 draws.
    assert abs(mirrored - 128) < 32


def test_jitter_cuts_a_square_from_an_enlarged_crop():
    """The same of both pictures, at 286 : 256, and nothing of it in validation."""
    valid = np.ones((96, 128), bool)
    valid[:, :30] = False
    examples = [example(seed, valid) for seed in range(12)]
    whole, some = (Crops(task_of("pix2pix", examples), 64, False, jitter) for jitter in (64, 72))
    places = set()
    for before, after in zip(whole.batch(0, 64), some.batch(0, 64), strict=True):
        assert after.inputs.rgb.shape == (64, 64, 3) and after.inputs.texel_m == pytest.approx(0.2 * 64 / 72)
        # The picture varies by a few levels per pixel, the target is linear in it.
        off = np.abs(280.0 + 20.0 * after.target - kelvin(after.inputs.rgb))[after.valid]
        assert off.max() < 0.1 and after.valid.mean() > 0.2 and (after.target[~after.valid] == 0.0).all()
        larger = np.kron(before.inputs.rgb.astype(float), np.ones((9, 9, 1)))[4::8, 4::8]
        errors = {(top, left): np.abs(larger[top : top + 64, left : left + 64] - after.inputs.rgb).mean()
                  for top in range(9) for left in range(9)}  # fmt: skip
        places.add(min(errors, key=errors.get))
        assert min(errors.values()) < 4.0
    # 81 places are equally likely.
    assert len(places) > 30
    plain, jittered = whole.validation()[0], some.validation()[0]
    assert np.array_equal(plain.inputs.rgb, jittered.inputs.rgb)


def _holds(whole, part):
    """Whether a picture contains a square unchanged."""
    rows, columns = np.where((whole[: whole.shape[0] - 63, : whole.shape[1] - 63] == part[0, 0]).all(axis=-1))
    return any(np.array_equal(whole[r : r + 64, c : c + 64], part) for r, c in zip(rows, columns, strict=True))


def test_every_training_picture_is_used_and_held_out_ones_are_not():
    examples = [example(seed) for seed in range(40)]
    held = np.zeros(40, bool)
    held[[3, 17, 30]] = True
    crops = Crops(replace(task_of("unet", examples), held_out=held), 64, False)
    read = []
    original = crops.read
    crops.read = lambda number: (read.append(int(number)), original(number))[1]
    crops.batch(0, 512)
    crops.close()
    order = read[: len(crops.train)]
    assert sorted(order) == [k for k in range(40) if k not in (3, 17, 30)] and order != sorted(order)
    assert not {3, 17, 30} & set(read)
    read.clear()
    crops.validation()
    assert read == [3, 17, 30]


def test_invalid_and_missing_pixels_do_not_affect_training():
    valid = np.ones((96, 128), bool)
    valid[40:60] = False
    crops = Crops(task_of("unet", [example(seed, valid) for seed in range(12)]), 64, False)
    for crop in crops.batch(0, 30):
        assert (crop.target[~crop.valid] == 0.0).all() and np.isfinite(crop.target).all()
    # Smaller than a square: placed in its corner, with edges repeated and marked as not valid.
    crops = Crops(task_of("unet", [example(seed, height=40, width=50) for seed in range(12)]), 64, False)
    (crop,) = crops.batch(0, 1)
    assert crop.valid[:40, :50].all() and not crop.valid[40:].any() and not crop.valid[:, 50:].any()
    assert np.array_equal(crop.inputs.rgb[40:, :50], np.repeat(crop.inputs.rgb[39:40, :50], 24, axis=0))


def test_values_without_a_temperature_are_left_out():
    cold = replace(example(1), values=np.full((96, 128), 7, np.uint16))
    table = TEMPERATURE.copy()
    table[7] = np.nan
    task = replace(task_of("unet", [cold] * 12), temperature=table, intensity=(table - 280.0) / 20.0)
    (crop,) = Crops(task, 64, False).batch(0, 1)
    assert not crop.valid.any() and (crop.target == 0.0).all()


def test_too_few_pairs_are_refused():
    with pytest.raises(ThermorenderError, match="2 pairs are too few to train and validate"):
        Crops(task_of("unet", [example(0), example(1)]), 64, False)


def test_hour_and_weather_planes_are_scaled_to_about_one():
    examples = [example(seed, conditional=True) for seed in range(12)]
    crops = Crops(task_of("compact+", examples), 64, True)
    encoding = measured(crops, False)
    # Kelvin above the air are measured from 0 and scaled by their root mean square over the training pictures.
    above = [kelvin(picture(seed)) - 285.0 - seed % 3 for seed in range(12) if seed % 10 != 9]
    assert encoding.offset == 0.0 and encoding.scale == pytest.approx(np.sqrt(np.mean(np.square(above))), rel=1e-3)
    assert encoding.extra.conditions == ("air_k", "wind_m_s")
    assert Encoding.of(encoding.header(), encoding.arrays()) == encoding
