"""Maps of single pixels: their features, the palette, the trees, and the linear map with relief."""

import sys
from dataclasses import replace

import numpy as np
import pytest

from thermorender.apps.training import drawn_pixels, linear_training, trees_training
from thermorender.apps.training.linear_training import fit_linear
from thermorender.apps.training.palette_training import fit_palette
from thermorender.apps.training.task import Example, Task
from thermorender.apps.training.training_methods import method
from thermorender.apps.training.trees_training import fit_trees
from thermorender.errors import ThermorenderError
from thermorender.learned import linear, pixel_features, rows, trees
from thermorender.learned.temperature_map import Inputs, TemperatureMap, load_map, save_map

# Thermal values are hundredths of a kelvin; intensities have a range of 280 K to 300 K.
TEMPERATURE = np.arange(40000) / 100.0
INTENSITY = (TEMPERATURE - 280.0) / 20.0


def picture(seed, height=48, width=64):
    """A picture of smooth colours from the whole colour cube."""
    import cv2

    image = np.random.default_rng(seed).normal(size=(height, width, 3))
    image = cv2.GaussianBlur(image, (0, 0), 3.0)
    return np.clip(127.0 + 127.0 * image / np.abs(image).max(), 0, 255).astype(np.uint8)


def example(inputs, kelvin, valid=None):
    valid = np.ones(kelvin.shape, bool) if valid is None else valid
    return Example(inputs, np.rint(kelvin * 100.0).astype(np.uint16), valid)


def task_of(name, examples, texel_m=None, **options):
    return Task(examples, INTENSITY, TEMPERATURE, 3, lambda what, share: None,
                method(name).options | options, texel_m)  # fmt: skip


def tables(extra, inputs, window=None):
    """[((rows, columns) slices, (columns, h, w))] of the tiles of a picture."""
    found = []
    for here, planes in extra.planes(inputs, window):
        shape = [part.stop - part.start for part in here]
        found.append((here, np.stack([np.broadcast_to(plane, shape) for plane in planes])))
    return found


def through_a_file(predictor, folder, name="m"):
    model = TemperatureMap(name, name, predictor, (280.0, 300.0), (7.5, 13.5), 0.5, (0.4, 0.6), "boson-640", 260.0, "x")
    save_map(model, folder / f"{name}.npz")
    return load_map(folder / f"{name}.npz")


# --- features ---------------------------------------------------------------------------------------------------


def described(rgb):
    return dict(zip(pixel_features.NAMES, pixel_features.features(rgb, pixel_features.whole_picture(rgb)), strict=True))


def test_features_against_direct_sums():
    import colour

    rgb = picture(1, 40, 50)
    lab = colour.XYZ_to_Lab(colour.sRGB_to_XYZ(rgb / 255.0), (0.3127, 0.3290))
    found = described(rgb)
    # Around one pixel, far enough from the edges for a window of 4.
    row, column, window = 20, 24, 4.0
    offset = np.arange(-12, 13)
    weight = np.exp(-0.5 * (offset / window) ** 2)
    weight = np.outer(weight, weight) / weight.sum() ** 2
    around = lab[row - 12 : row + 13, column - 12 : column + 13]
    mean = np.einsum("ij,ijc->c", weight, around)
    variance = np.einsum("ij,ijc->c", weight, (around - mean) ** 2)
    for number, name in enumerate("Lab"):
        assert found[name][row, column] == pytest.approx(lab[row, column, number], abs=0.02)
        assert found[f"{name} mean 4"][row, column] == pytest.approx(mean[number], abs=0.02)
        middle = np.median(lab[..., number])
        assert (found[f"median {name}"] == found[f"median {name}"][0, 0]).all()
        assert found[f"median {name}"][0, 0] == pytest.approx(middle, abs=0.02)
        assert found[f"{name} above median"][row, column] == pytest.approx(lab[row, column, number] - middle, abs=0.03)
        low, high = np.percentile(lab[..., number], (16, 84))
        assert found[f"spread of {name}"][0, 0] == pytest.approx((high - low) / 2, abs=0.02)
    assert found["L spread 4"][row, column] == pytest.approx(np.log1p(np.sqrt(variance[0])), abs=2e-3)
    chroma = np.log1p(np.sqrt(variance[1] + variance[2]))
    assert found["chroma spread 4"][row, column] == pytest.approx(chroma, abs=2e-3)
    assert found["L above mean 4"][row, column] == pytest.approx(lab[row, column, 0] - mean[0], abs=0.03)
    assert found["dark"][0, 0] == pytest.approx(np.mean(lab[..., 0] < 15.0), abs=1e-3)


def test_stripes_have_one_direction_and_noise_has_none():
    stripes = np.broadcast_to(np.uint8(127 + 60 * np.sin(np.arange(96) / 2.0))[None, :, None], (64, 96, 3))
    noise = np.random.default_rng(0).integers(60, 190, (64, 96, 1), dtype=np.uint8).repeat(3, axis=2)
    assert described(stripes)["coherence 8"][20:40, 30:60].min() > 0.95
    assert described(noise)["coherence 8"][20:40, 30:60].max() < 0.5


def test_features_move_with_the_picture():
    rgb = picture(2, 150, 160)
    moved = np.roll(rgb, (5, -7), axis=(0, 1))
    before, after = (pixel_features.features(image, pixel_features.whole_picture(image)) for image in (rgb, moved))
    inner = slice(pixel_features.HALO + 8, -pixel_features.HALO - 8)
    expected = np.roll(before, (5, -7), axis=(1, 2))
    np.testing.assert_allclose(after[:, inner, inner], expected[:, inner, inner], atol=2e-3)


def test_a_picture_is_resampled_to_the_maps_texel_and_back():
    rgb = picture(3)
    plane = np.arange(48.0 * 64.0).reshape(48, 64)
    plane[4, 5] = np.nan
    twice = Inputs(rgb.repeat(2, axis=0).repeat(2, axis=1), 0.25, {"x": plane.repeat(2, axis=0).repeat(2, axis=1)})
    found = rows.at_texel(twice, 0.5)
    np.testing.assert_array_equal(found.rgb, rgb)
    np.testing.assert_array_equal(found.terrain["x"], plane)
    assert found.texel_m == 0.5
    assert rows.at_texel(Inputs(rgb, 0.54), 0.5).rgb is rgb and rows.at_texel(Inputs(rgb), 0.5).rgb is rgb
    # Classes keep their numbers at any ratio.
    odd = rows.at_texel(Inputs(rgb, 0.3, {"material": np.where(plane > 900.0, 7, 2).astype(np.uint8)}), 0.5)
    assert odd.rgb.shape == (29, 38, 3) and np.unique(odd.terrain["material"]).tolist() == [2.0, 7.0]
    # Coarser by ten: enlarged at most twofold.
    assert rows.at_texel(Inputs(rgb, 5.0), 0.5).rgb.shape == (96, 128, 3)
    ramp = np.add.outer(np.arange(48.0), 2.0 * np.arange(64.0))
    back = rows.at_shape(ramp, (96, 128))
    np.testing.assert_allclose(rows.at_shape(back, (48, 64)), ramp, atol=1.0)


def test_tiles_together_equal_the_picture(monkeypatch):
    inputs = Inputs(picture(4, 150, 170), 0.5, {"sky": np.random.default_rng(0).random((150, 170))}, {"air_k": 290.0})
    extra = rows.ExtraInputs.of(inputs)
    ((_, whole),) = tables(extra, inputs)
    assert whole.shape == (len(extra.columns), 150, 170)
    monkeypatch.setattr(rows, "_TILE", 64)
    parts = tables(extra, inputs)
    assert len(parts) == 9
    for (down, across), part in parts:
        np.testing.assert_allclose(part, whole[:, down, across], atol=2e-3)


def test_rows_are_drawn_evenly_from_valid_pixels():
    valid = np.zeros((48, 64), bool)
    valid[10:20] = True
    kelvin = 280.0 + np.arange(48.0)[:, None] + np.zeros(64)
    examples = [example(Inputs(picture(k)), kelvin, valid if k else None) for k in range(3)]
    found = list(drawn_pixels.drawn(task_of("trees", examples), rows.ExtraInputs(), 500))
    assert [each.pixels.size for each in found] == [500, 500, 500]
    assert valid.ravel()[found[1].pixels].all()
    for each in found:
        np.testing.assert_allclose(each.target, each.pixels // 64 / 20.0)
    again = list(drawn_pixels.drawn(task_of("trees", examples), rows.ExtraInputs(), 500))
    assert all((one.pixels == other.pixels).all() for one, other in zip(found, again, strict=True))
    nothing = [replace(one, valid=np.zeros((48, 64), bool)) for one in examples]
    for name in ("trees", "palette"):
        with pytest.raises(ThermorenderError, match="none of 3 pairs has a valid pixel to learn from"):
            method(name).fit(task_of(name, nothing))


def test_features_of_a_part_of_a_large_picture_equal_those_of_the_whole():
    g = np.random.default_rng(11)
    rgb = g.integers(0, 256, (420, 600, 3), dtype=np.uint8)
    valid = np.zeros((420, 600), bool)
    valid[300:, 400:] = True
    large = example(Inputs(rgb), np.full((420, 600), 290.0), valid)
    seen = set()
    for seed in range(8):
        (found,) = drawn_pixels.drawn(replace(task_of("trees", [large]), seed=seed), rows.ExtraInputs(), 200)
        top, bottom, left, right = found.window
        assert bottom - top == right - left == 256 and top >= 0 and bottom <= 420 and left >= 0 and right <= 600
        row, column = np.divmod(found.pixels, 600)
        assert valid[row, column].all() and row.min() >= top and row.max() < bottom
        assert column.min() >= left and column.max() < right
        seen.add(found.window)
    assert len(seen) > 4
    extra = rows.ExtraInputs()
    ((_, whole),) = tables(extra, Inputs(rgb))
    ((where, part),) = tables(extra, Inputs(rgb), found.window)
    assert where == (slice(top, bottom), slice(left, right))
    np.testing.assert_allclose(part, whole[:, top:bottom, left:right], atol=2e-3)


def test_training_resamples_pictures_to_the_maps_texel():
    rgb = picture(5)
    kelvin = 280.0 + np.arange(48.0)[:, None] + np.zeros(64)
    fine = example(Inputs(rgb.repeat(2, axis=0).repeat(2, axis=1), 0.25), kelvin.repeat(2, axis=0).repeat(2, axis=1))
    (found,) = drawn_pixels.drawn(task_of("trees", [fine], 0.5), rows.ExtraInputs(), 10**6)
    np.testing.assert_array_equal(found.inputs.rgb, rgb)
    np.testing.assert_allclose(found.target, INTENSITY[np.rint(100.0 * kelvin.ravel()).astype(int)])


# --- palette ----------------------------------------------------------------------------------------------------


def test_palette_is_the_mean_of_each_cell(tmp_path):
    import colour

    generator = np.random.default_rng(0)
    rgb = generator.integers(0, 256, (40, 50, 3), dtype=np.uint8)
    kelvin = generator.uniform(280.0, 300.0, (40, 50)).round(2)
    valid = generator.random((40, 50)) < 0.7
    model = method("palette").fit(task_of("palette", [example(Inputs(rgb), kelvin, valid)], cell=20.0, shrinkage=0.0))
    lab = colour.XYZ_to_Lab(colour.sRGB_to_XYZ(rgb / 255.0), (0.3127, 0.3290)) + (0.0, 128.0, 128.0)
    found = model.predict(Inputs(rgb), None)
    wide = {}
    for level in range(4, -1, -1):
        cells = [tuple(cell) for cell in (lab // (20.0 * 2**level)).astype(int).reshape(-1, 3)]
        own = {}
        for cell, value, use in zip(cells, INTENSITY[np.rint(kelvin * 100).astype(int)].ravel(), valid.ravel(),
                                    strict=True):  # fmt: skip
            if use:
                own.setdefault(cell, []).append(value)
        # The narrowest cell that contains a valid pixel.
        for number, cell in enumerate(cells):
            if cell in own:
                wide[number] = np.mean(own[cell])
    expected = np.array([wide[number] for number in range(rgb.shape[0] * rgb.shape[1])])
    # A colour within rounding of a cell's wall may fall to either side.
    near_wall = (np.abs(lab / 20.0 - np.rint(lab / 20.0)) < 1e-4).any(axis=-1).ravel()
    assert near_wall.mean() < 0.01
    np.testing.assert_allclose(found.ravel()[~near_wall], expected[~near_wall], atol=1e-12)
    unseen = [cell not in own for cell in cells]
    assert 0.0 < np.mean(unseen) == pytest.approx(model.unseen(Inputs(rgb)).mean(), abs=0.002)
    again = through_a_file(model, tmp_path).predictor
    np.testing.assert_array_equal(again.predict(Inputs(rgb), None), found)


def test_shrinkage_pulls_towards_the_mean_of_wider_cells():
    """Black and white only share cells of 192 and wider: five steps from the whole range down to cells of 6."""
    rgb = np.zeros((1, 40, 3), np.uint8)
    rgb[0, 30:] = 255
    kelvin = np.where(np.arange(40)[None] < 30, 284.0, 296.0)
    model = method("palette").fit(task_of("palette", [example(Inputs(rgb), kelvin)], cell=6.0, shrinkage=50.0))
    mean = 0.75 * 0.2 + 0.25 * 0.8
    found = model.predict(Inputs(rgb), None)[0]
    assert found[0] == pytest.approx(0.2 + (mean - 0.2) * (50 / 80) ** 5, abs=1e-12)
    assert found[-1] == pytest.approx(0.8 + (mean - 0.8) * (50 / 60) ** 5, abs=1e-12)
    # Lightness 6.9: this colour was not seen, and the cell twice as wide holds black only.
    grey = Inputs(np.full((1, 1, 3), 20, np.uint8))
    assert model.unseen(grey) == 1.0
    assert model.predict(grey, None)[0, 0] == pytest.approx(0.2 + (mean - 0.2) * (50 / 80) ** 4, abs=1e-12)


@pytest.mark.parametrize(("option", "value"), [("cell", 0.5), ("cell", np.nan), ("shrinkage", -1.0)])
def test_palette_refuses_options(option, value):
    with pytest.raises(ThermorenderError, match=f"{option}={value:g} is no"):
        method("palette").fit(task_of("palette", [], **{option: value}))


# --- trees ------------------------------------------------------------------------------------------------------


def test_trees_learn_a_step_and_survive_their_file(tmp_path):
    examples = [example(Inputs(rgb), np.where(rgb[..., 1] > 120, 296.0, 284.0)) for rgb in map(picture, range(10))]
    model = fit_trees(task_of("trees", examples))
    assert model.needs == () and not model.above_air
    unseen = picture(99)
    found = model.predict(Inputs(unseen), 0.5)
    expected = np.where(unseen[..., 1] > 120, 0.8, 0.2)
    # Green is not an axis of CIELAB, so its step has no straight boundary there.
    assert np.abs(found - expected).mean() < 0.03
    again = through_a_file(model, tmp_path)
    np.testing.assert_array_equal(again.predictor.predict(Inputs(unseen), 0.5), found)


def test_trees_do_not_depend_on_how_many_threads_grow_them(monkeypatch):
    examples = [example(Inputs(rgb), 280.0 + rgb[..., 0] / 20.0) for rgb in map(picture, range(9))]
    monkeypatch.setattr(trees_training, "_MOST_TREES", 20)
    found = []
    for threads in (1, 3):
        monkeypatch.setitem(trees_training._SETTINGS, "num_threads", threads)
        found.append(fit_trees(task_of("trees", examples)).predict(Inputs(picture(50)), None))
    np.testing.assert_array_equal(*found)


def above_air(seed, air):
    """An example whose temperature above the air is red's in the sun; class 3 is 6 K colder."""
    generator = np.random.default_rng(seed)
    rgb = picture(seed)
    sun = generator.uniform(0.0, 800.0, (48, 64))
    number = generator.integers(1, 6, (48, 64)).astype(np.uint8)
    kelvin = air + 0.02 * sun * rgb[..., 0] / 255.0 - 6.0 * (number == 3)
    terrain = {"sunlight": sun.astype(np.float32), "material": number}
    return example(Inputs(rgb, None, terrain, {"air_k": air, "wind_m_s": 2.0}), kelvin)


def test_trees_with_relief_give_kelvin_above_the_air(tmp_path):
    examples = [above_air(seed, 270.0 + 5.0 * seed) for seed in range(6)]
    model = fit_trees(task_of("trees+", examples))
    assert model.needs == ("terrain", "conditions") and model.above_air
    assert model.extra == rows.ExtraInputs(("material", "sunlight"), ("air_k", "wind_m_s"))
    # LightGBM's name for splits by sets of classes.
    assert max(int(line[8:]) for line in model.text.splitlines() if line.startswith("num_cat=")) > 0
    other = above_air(20, 287.0)
    again = through_a_file(model, tmp_path)
    assert again.predictor.extra == model.extra
    found = again.predictor.predict(other.inputs, None)
    assert np.abs(found + 287.0 - TEMPERATURE[other.values]).mean() < 0.8
    # The terrain ends within the picture; a temperature is still given.
    other.inputs.terrain["sunlight"][:, :20] = np.nan
    assert np.isfinite(model.predict(other.inputs, None)).all()
    with pytest.raises(ThermorenderError, match="terrain of a picture have material and lack sunlight, which the map"):
        model.predict(replace(other.inputs, terrain={"material": other.inputs.terrain["material"]}), None)


def thresholds_of(node, column):
    """Thresholds of a column in a tree, as LightGBM lists it."""
    if "split_feature" not in node:
        return []
    own = [node["threshold"]] if node["split_feature"] == column else []
    return own + [each for side in ("left_child", "right_child") for each in thresholds_of(node[side], column)]


@pytest.mark.parametrize("missing", [False, True], ids=["all known in training", "some unknown in training"])
def test_trees_are_evaluated_as_lightgbm_does(missing, monkeypatch):
    """To rounding: on thresholds, with NaN, by known and other classes, in blocks, and where all have the same leaf."""
    import lightgbm

    generator = np.random.default_rng(3)

    def conditional(seed):
        terrain = {"slope": generator.normal(size=(48, 64)).astype(np.float32).round(1),
                   "material": generator.integers(0, 70, (48, 64)).astype(np.float32),
                   "view": generator.random((48, 64)).astype(np.float32)}  # fmt: skip
        if missing:
            terrain["slope"][generator.random((48, 64)) < 0.2] = np.nan
        return Inputs(picture(seed), None, terrain, {"wind_m_s": float(seed)})

    monkeypatch.setattr(trees_training, "_MOST_TREES", 20)
    made = [conditional(seed) for seed in range(9)]
    true = [290.0 + np.nan_to_num(one.terrain["slope"], nan=4.0) + one.rgb[..., 0] / 50.0
            + one.terrain["material"] % 7 for one in made]  # fmt: skip
    model = fit_trees(task_of("trees+", [example(*one) for one in zip(made, true, strict=True)]))
    slope = model.extra.columns.index("slope")
    booster = lightgbm.Booster(model_str=model.text)
    trees_of = [each["tree_structure"] for each in booster.dump_model()["tree_info"]]
    limits = [limit for tree in trees_of for limit in thresholds_of(tree, slope)]
    # LightGBM takes numbers below 1e-35 as 0.
    thresholds = np.float32([limit for limit in limits if abs(limit) > 1e-30][:99])
    by_class = [limit for tree in trees_of for limit in thresholds_of(tree, model.extra.columns.index("material"))]
    assert max(map(len, by_class)) > 9
    assert thresholds.size > 9
    other = conditional(20)
    # Thresholds themselves, and their neighbours in single precision.
    flat = other.terrain["slope"].ravel()
    beside = [np.nextafter(thresholds, np.float32(to)) for to in (-9, 9)]
    flat[: 3 * len(thresholds)] = np.concatenate([thresholds, *beside])
    other.terrain["slope"][20:22, :32] = np.nan
    other.terrain["view"][:, :40] = 0.5
    other.terrain["material"][:4] = np.array([np.nan, -1.0, 71.0, 1e6])[:, None]
    ((_, table),) = tables(model.extra, other)
    wanted = booster.predict(table.reshape(len(table), -1).T).reshape(48, 64)
    wanted += model.begin.of_values(dict(zip(model.extra.columns, table, strict=True))) if model.begin else 0.0
    for side in (256, 20):
        monkeypatch.setattr(trees, "_BLOCK", side)
        np.testing.assert_allclose(model.predict(other, None), wanted, rtol=0.0, atol=1e-12)


def test_trees_of_other_kinds_are_refused(monkeypatch, tmp_path):
    """Another treatment of missing values, and texts that training does not write."""
    monkeypatch.setattr(trees_training, "_MOST_TREES", 2)
    plain = fit_trees(task_of("trees", [example(Inputs(picture(0)), 280.0 + picture(0)[..., 0] / 20.0)]))
    through_a_file(plain, tmp_path)
    changes = {"objective=regression_l1": "objective=binary sigmoid:1", "\nis_linear=0": "\nis_linear=1",
               "tree\nversion": "tree\naverage_output\nversion", "num_class=1\n": "num_class=2\n",
               "decision_type=2": "decision_type=1", "\ndecision_type=2": "\ndecision_type=6",
               "\nleft_child=": "\nleft_child=0 ", "\nleaf_value=": "\nleaf_value=nan ",
               "\nsplit_feature=": "\nsplit_feature=99999 ", "max_feature_idx=": "max_feature_idx=1"}  # fmt: skip
    for before, after in changes.items():
        assert before in plain.text
        with pytest.raises(ThermorenderError, match=r"is not a learned map of format 1 \(.*\); make one with"):
            through_a_file(replace(plain, text=plain.text.replace(before, after)), tmp_path)


def test_whole_runs_are_held_out():
    held = trees_training.held_out(1600)
    assert held.sum() == 200
    starts = np.flatnonzero(np.diff(held.astype(int)) == 1)
    np.testing.assert_array_equal(np.diff(starts), 320)
    assert held[280:320].all() and not held[:280].any()
    assert not trees_training.held_out(7).any() and trees_training.held_out(8).sum() == 1


def test_training_needs_lightgbm_and_applying_does_not(monkeypatch, tmp_path):
    task = task_of("trees", [example(Inputs(picture(0)), 280.0 + picture(0)[..., 0] / 20.0)])
    model = fit_trees(task)
    monkeypatch.setitem(sys.modules, "lightgbm", None)
    with pytest.raises(ThermorenderError, match=r"needs LightGBM; install .*`pip install 'thermorender\[maps\]'`"):
        fit_trees(task)
    again = through_a_file(model, tmp_path).predictor
    assert np.ptp(again.predict(Inputs(picture(0)), None)) > 0.1


def test_files_that_are_not_such_maps_are_refused(tmp_path):
    examples = [example(Inputs(picture(0)), 280.0 + picture(0)[..., 0] / 20.0)]
    grown = fit_trees(task_of("trees", examples))
    colours = fit_palette(task_of("palette", examples))
    narrow = linear.Linear(rows.ExtraInputs(), np.zeros(5), 0.0)
    for bad in (replace(grown, text="tree\nno"), replace(grown, extra=rows.ExtraInputs(("slope",))),
                replace(colours, cell=24.0), narrow):  # fmt: skip
        with pytest.raises(ThermorenderError, match=r"is not a learned map of format 1 \(.*\); make one with"):
            through_a_file(bad, tmp_path)


# --- linear, with relief ----------------------------------------------------------------------------------------


def linear_example(seed, air, generator):
    rgb = generator.integers(0, 256, (48, 64, 3), dtype=np.uint8)
    terrain = {name: generator.uniform(0.0, most, (48, 64)) for name, most in (("sky_view", 1.0), ("sunlight", 900.0))}
    given = {"air_k": air, "wind_m_s": generator.uniform(0.0, 8.0), "longwave_w_m2": generator.uniform(250.0, 400.0),
             "direct_w_m2": generator.uniform(100.0, 800.0), "diffuse_w_m2": 100.0, "sun_elevation_deg": 50.0,
             "open_sand": generator.uniform(0.0, 20.0), "shade_sand": generator.uniform(-5.0, 5.0)}  # fmt: skip
    inputs = Inputs(rgb, None, terrain, given)
    return inputs, air + above_the_air(inputs)


def above_the_air(inputs):
    """Kelvin above the air by a law of the linear map's form, written out."""
    given, view, sunlight = inputs.conditions, inputs.terrain["sky_view"], inputs.terrain["sunlight"]
    light, green, blue = np.moveaxis(pixel_features.lab(inputs.rgb), -1, 0)
    light, green, blue = light / 50.0 - 1.0, np.clip(green / 20.0, -3.0, 3.0), np.clip(blue / 20.0, -3.0, 3.0)
    known = np.isfinite(view)
    level = given["direct_w_m2"] * np.sin(np.radians(50.0)) + 100.0
    share = np.where(known, np.minimum(sunlight / level, 3.0), 1.0)
    sand = given["shade_sand"] + (given["open_sand"] - given["shade_sand"]) * share
    return (
        1.5 + 3.0 * light - 0.4 * green * blue + sand * (0.7 + 0.2 * blue)
        + np.where(known, sunlight * (0.02 - 0.01 * light * light) - 4.0 * view, -20.0)
        + np.where(known, 1.0 - view, 0.0) * given["longwave_w_m2"] * 0.01 * green - 0.5 * given["wind_m_s"]
    )  # fmt: skip


LAW = {
    "L": 3.0, "a b": -0.4, "as sand": 0.7, "as sand × b": 0.2, "sunlight": 0.02, "sunlight × L²": -0.01,
    "hidden sky × longwave × a": 0.01, "wind_m_s": -0.5,
}  # fmt: skip


def test_linear_finds_known_coefficients(tmp_path):
    generator = np.random.default_rng(0)
    made = [linear_example(seed, 275.0 + 4.0 * seed, generator) for seed in range(12)]
    # Outside the terrain, other laws.
    for inputs, kelvin in made:
        inputs.terrain["sky_view"][:10] = inputs.terrain["sunlight"][:10] = np.nan
        kelvin[:10] = (inputs.conditions["air_k"] + above_the_air(inputs))[:10]
    model = fit_linear(task_of("correlation+", [example(*one) for one in made], penalty=0.0))
    names = linear.names_of_columns(model.extra)
    found = dict(zip(names, model.weight, strict=True))
    # Sky view and hidden sky carry the same information except at the terrain's edge, and share a coefficient.
    assert found["sky_view"] - found["hidden sky"] == pytest.approx(-4.0, abs=0.01)
    # The pictures' values are rounded to 0.01 K.
    for name, value in found.items():
        if name not in ("sky_view", "hidden sky", "no terrain"):
            tolerance = 2e-5 if name.startswith(("sunlight", "hidden sky × longwave")) else 0.01
            assert value == pytest.approx(LAW.get(name, 0.0), abs=tolerance), name
    inputs, _ = linear_example(9, 288.0, generator)
    inputs.terrain["sky_view"][0, 0] = inputs.terrain["sunlight"][0, 0] = np.nan
    above = through_a_file(model, tmp_path).predictor.predict(inputs, None)
    np.testing.assert_allclose(above, above_the_air(inputs), atol=0.05)


def test_linear_is_ridge_regression(monkeypatch):
    from sklearn.linear_model import Ridge

    # All pixels, not a sample.
    monkeypatch.setattr(linear_training, "_MOST_ROWS", 48 * 64)
    generator = np.random.default_rng(1)
    made = [linear_example(seed, 275.0 + 4.0 * seed, generator) for seed in range(5)]
    model = fit_linear(task_of("correlation+", [example(*one) for one in made], penalty=0.1))
    table, size = [], 48 * 64
    for inputs, _ in made:
        values = {**dict(zip("Lab", pixel_features.lab(inputs.rgb).reshape(-1, 3).T, strict=True)), **inputs.conditions,
                  **{name: plane.ravel() for name, plane in inputs.terrain.items()}}  # fmt: skip
        columns = linear.columns(values, model.extra)
        table.append(np.stack([np.broadcast_to(column, size) for _, column in columns], axis=-1))
    table = np.concatenate(table).astype(float)
    target = np.concatenate([(kelvin.round(2) - inputs.conditions["air_k"]).ravel() for inputs, kelvin in made])
    mean, scale = table.mean(axis=0), np.where(table.std(axis=0) > 0.0, table.std(axis=0), 1.0)
    other = Ridge(alpha=0.1 * len(target)).fit((table - mean) / scale, target)
    np.testing.assert_allclose(model.weight * scale, other.coef_, atol=1e-6)
    assert model.offset + model.weight @ mean == pytest.approx(other.intercept_, abs=1e-6)


@pytest.mark.parametrize("fit", [fit_linear, fit_trees])
def test_inputs_that_hardly_varied_have_little_effect_far_outside_their_range(fit):
    """Training has one hour's weather with 1 K of noise between pictures, and a plain; the test asks for others."""
    generator = np.random.default_rng(4)

    def conditional(seed, hot=0.0):
        terrain = {"normal_east": generator.normal(hot, 2e-7, (48, 64)).astype(np.float32),
                   "sky_view": np.full((48, 64), 1.0 - 0.3 * hot, np.float32)}  # fmt: skip
        known = {"air_k": 290.0 + 0.02 * seed + 10.0 * hot, "solar_hour": 12.0 + 0.01 * seed + 6.0 * hot,
                 "open_sand": 15.0 + 0.01 * seed - 15.0 * hot, "shade_sand": 2.0}  # fmt: skip
        return Inputs(picture(seed), None, terrain, known)

    made = [conditional(seed) for seed in range(9)]
    kelvin = [one.conditions["air_k"] + 10.0 * one.rgb[..., 0] / 255.0 + generator.normal() for one in made]
    name = "correlation+" if fit is fit_linear else "trees+"
    model = fit(task_of(name, [example(*one) for one in zip(made, kelvin, strict=True)]))
    found = model.predict(conditional(20, hot=1.0), None)
    # The training data are between 0 and 10 K, plus or minus the noise.
    assert found.min() > -25.0 and found.max() < 35.0


def test_linear_ignores_conditions_it_was_not_trained_with():
    """A condition that training lacked, although it would form a column together with a known one."""
    inputs, _ = linear_example(0, 290.0, np.random.default_rng(2))
    extra = rows.ExtraInputs(("sunlight",), tuple(sorted(set(inputs.conditions) - {"shade_sand"})))
    weight = np.array([name == "sunlight" for name in linear.names_of_columns(extra)], float)
    found = linear.Linear(extra, weight, 1.0).predict(inputs, None)
    np.testing.assert_allclose(found, 1.0 + inputs.terrain["sunlight"], rtol=1e-12)


def test_linear_leaves_out_constant_columns_and_classes():
    inputs, kelvin = linear_example(0, 290.0, np.random.default_rng(2))
    inputs.terrain["material"] = np.ones((48, 64), np.uint8)
    model = fit_linear(task_of("correlation+", [example(inputs, kelvin)]))
    assert model.extra.terrain == ("sky_view", "sunlight")
    assert (model.weight[-2:] == 0.0).all()


def test_linear_refuses_unusable_inputs():
    inputs, kelvin = linear_example(0, 290.0, np.random.default_rng(3))
    with pytest.raises(ThermorenderError, match="penalty=-1 is not allowed; give 0 or more"):
        fit_linear(task_of("correlation+", [example(inputs, kelvin)], penalty=-1))
    with pytest.raises(ThermorenderError, match="lack the condition air_k"):
        fit_linear(task_of("correlation+", [example(replace(inputs, conditions={"wind_m_s": 1.0}), kelvin)]))
