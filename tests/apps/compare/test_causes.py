"""What explains the error of a picture: planted causes are named with their size, innocent pictures are not accused."""

import numpy as np
import pytest
from compare_support import BAND, view
from scipy.ndimage import gaussian_filter, shift

from thermorender.apps.compare import emissivities, findings, frame_order, registration
from thermorender.apps.compare.causes import Causes, clipping
from thermorender.apps.compare.pose_fit import Pair, fit, moved, zoom_of
from thermorender.physics.planck import band_radiance, brightness_temperature
from validation.referee import plants, study

SKY_K = 250.0
SHAPE = (128, 160)
NAMES, EMISSIVITY = ("grass", "asphalt", "sand"), np.array([0.97, 0.95, 0.93])


def field(seed, length, spread=1.0):
    """A smooth random field with structure of two sizes, (H, W)."""
    rng = np.random.default_rng(seed)
    parts = [gaussian_filter(rng.normal(size=SHAPE), each) for each in (length, 3.0 * length)]
    found = sum(each / each.std() for each in parts)
    return spread * found / found.std()


@pytest.fixture(scope="module")
def land():
    """(truth [K], material): three materials of different temperature, with structure within each."""
    patches = field(1, 8.0)
    material = np.digitize(patches, (-0.9, 0.6)).astype(np.uint8)
    kelvin = 292.0 + np.array([0.0, 3.0, -2.0])[material] + field(2, 1.2, 1.0) + field(5, 9.0, 1.5)
    return kelvin, material


def causes_of(land, seen, poses=1, noise=0.05, start=(0.0, 0.0), zoom=None, levels=(0.0, 0.0, 0.0, 0.0)):
    """The summary of Causes of pictures that are `seen` plus noise; `levels` are added to the truth of each pose."""
    plain, material = land
    rng = np.random.default_rng(8)
    row, column = np.mgrid[: SHAPE[0], : SHAPE[1]] // 20
    everywhere = np.ones(SHAPE, bool)
    causes = Causes(emissivity=dict(zip(NAMES, EMISSIVITY.tolist(), strict=True)))
    for number in range(poses):
        truth = plain + levels[number]
        picture = (seen(number) if callable(seen) else seen) + noise * rng.normal(size=SHAPE)
        seen_from = view(everywhere, truth=truth, material=material)
        change = emissivities.change_k(seen_from, EMISSIVITY, picture, SKY_K, BAND)
        pair = Pair(picture, truth, everywhere, everywhere, material, NAMES, change, row * 100 + column, everywhere)
        causes.fits.append(fit(pair, start, zoom=zoom))
    return causes.summary()


def named(found):
    """{(kind, material): size} of what is named."""
    return {(each["kind"], each["material"]): each["size"] for each in found["named"]}


def damped(truth, gain):
    return truth.mean() + gain * (truth - truth.mean())


def by_emissivity(truth, here, change, known):
    radiance = band_radiance(truth, *BAND)
    x = (radiance - band_radiance(SKY_K, *BAND)) / known
    return brightness_temperature(radiance + change * here * x, *BAND)


def test_a_single_cause_is_named_with_its_size(land):
    truth, material = land
    sand = material == 2
    for seen, cause, size, tolerance in (
        (truth - 0.5, ("offset", ""), (-0.5,), 0.03),
        (damped(truth, 0.9), ("contrast", ""), (-0.1,), 0.01),
        (shift(truth, (1.0, -2.5), order=5, mode="nearest"), ("shift", ""), (-2.5, 1.0), 0.05),
        (shift(truth, (0.0, 0.4), order=5, mode="nearest"), ("shift", ""), (0.4, 0.0), 0.05),
        (gaussian_filter(truth, 1.5), ("blur", ""), (2.25,), 0.1),
        (truth - 1.5 * sand, ("material", "sand"), (-1.5,), 0.05),
        (by_emissivity(truth, sand, -0.15, 0.93), ("emissivity", "sand"), (-0.15,), 0.01),
    ):
        found = named(causes_of(land, seen))
        assert list(found) == [cause], (cause, found)
        assert found[cause] == pytest.approx(size, abs=tolerance), cause


def test_contrast_shift_offset_and_blur_are_separated(land):
    truth, _ = land
    seen = 1.0 + gaussian_filter(shift(damped(truth, 0.9), (0.0, 2.0), order=5, mode="nearest"), 1.0)
    found = named(causes_of(land, seen))
    assert set(found) == {("offset", ""), ("contrast", ""), ("shift", ""), ("blur", "")}
    assert found["contrast", ""] == pytest.approx((-0.1,), abs=0.02)
    assert found["offset", ""] == pytest.approx((1.0,), abs=0.05)
    assert found["shift", ""] == pytest.approx((2.0, 0.0), abs=0.05)
    assert found["blur", ""] == pytest.approx((1.0,), abs=0.15)


def test_a_shift_of_forty_pixels_needs_a_first_guess(land):
    truth, material = land
    wide = np.pad(truth, ((0, 0), (0, 40)), mode="reflect")[:, 40:]
    found = named(causes_of((truth, material), wide, start=(-40.0, 0.0)))
    assert found["shift", ""] == pytest.approx((-40.0, 0.0), abs=0.05)


@pytest.mark.parametrize("length", [1.0, 4.0, 12.0])
@pytest.mark.parametrize("size", [0.3, 1.0])
def test_correlated_errors_are_not_accused(land, length, size):
    for seed in (21, 22, 23):
        assert not named(causes_of(land, land[0] + field(seed, length, size))), seed


def test_a_grey_map_with_the_temperatures_of_the_ground_is_not_accused(land):
    """Correlation 0.8, and asphalt wrong because it is dark: neither its contrast nor an emissivity is wrong."""
    truth, material = land
    grey = (truth - truth.mean()) / truth.std() + 0.65 * field(31, 3.0) - 0.5 * (material == 1)
    matched = np.interp(grey, np.sort(grey.ravel()), np.sort(truth.ravel()))
    found = causes_of(land, matched)
    assert 0.6 < 1.0 + found["fit"]["contrast"]["size"][0] < 0.9 and found["resembles"]
    assert not named(found)


def test_a_calibrated_map_of_little_correlation_has_no_wrong_contrast(land):
    """Its slope on the reference is the square of the correlation, but no other scale would be better."""
    truth, _ = land
    guess = (truth - truth.mean()) / truth.std() + 2.5 * field(41, 2.0)
    slope, zero = np.polyfit(guess.ravel(), truth.ravel(), 1)
    found = causes_of(land, zero + slope * guess)
    assert 1.0 + found["fit"]["contrast"]["size"][0] < 0.3 and not named(found)


def test_an_error_on_a_material_without_the_pattern_of_emissivity_is_an_offset(land):
    truth, material = land
    here = material == 1
    # The same mean as by an emissivity, but a change with temperature of another size: an emissivity fits better than
    # an offset, yet not beside one.
    pattern = -4.0 - 0.4 * (truth - truth[here].mean())
    assert set(named(causes_of(land, truth + here * pattern))) == {("material", "asphalt")}


def test_an_impossible_emissivity_is_an_offset(land):
    truth, material = land
    seen = by_emissivity(truth, material == 2, 0.15, 0.93)
    assert set(named(causes_of(land, seen))) == {("material", "sand")}


def test_offsets_of_single_poses_are_one_that_changes_and_neither_an_offset_nor_a_material(land):
    """Seasons: the error of all materials is 20 K in one pose and −7 K in the next, and one material is not unusual."""
    truth, _ = land
    offsets = (20.0, -7.0, 4.0, -17.0)
    found = causes_of(land, lambda number: truth + offsets[number], poses=4)
    assert list(named(found)) == [("drift", "")] and found["unexplained"] < 1e-4
    assert named(found)["drift", ""] == pytest.approx(offsets, abs=0.05)
    found = named(causes_of(land, lambda number: truth + offsets[number] - 2.0 * (land[1] == 2), poses=4))
    assert found[("material", "sand")] == pytest.approx((-2.0,), abs=0.05) and len(found) == 2


def test_small_offsets_of_poses_beside_larger_errors_are_not_named(land):
    truth, _ = land
    offsets = (0.3, -0.2, 0.1, -0.2)
    found = causes_of(land, lambda number: truth + offsets[number] + field(70 + number, 4.0, 0.5), poses=4)
    assert not named(found) and found["unexplained"] == pytest.approx(1.0, abs=0.01)


def test_a_contrast_that_a_line_through_all_poses_does_not_show_is_not_named(land):
    """Half of the contrast within each pose, and more than that of their means: no other scale reduces the error."""
    truth, _ = land
    deviation = truth.std()
    levels = 0.5 * deviation * np.array([-1.3, -0.4, 0.4, 1.3])
    rest = [field(90 + k, 2.0, 0.22 * deviation) for k in range(4)]
    within = 0.5 * (truth - truth.mean())

    def pictures(scale):
        return lambda k: truth.mean() + within + scale * levels[k] + rest[k]

    # The inverse slope of the truth on the picture is 1 over all poses, and 0.6 within one.
    every = np.concatenate([[pictures(1.53)(k), truth + levels[k]] for k in range(4)], axis=1).reshape(2, -1)
    (own, both), _ = np.cov(every)
    assert own / both == pytest.approx(1.0, abs=0.03)
    assert ("contrast", "") not in named(causes_of(land, pictures(1.53), poses=4, levels=levels))
    found = named(causes_of(land, pictures(0.5), poses=4, levels=levels))
    assert found["contrast", ""] == pytest.approx((-0.5,), abs=0.03)


def test_the_unexplained_share_is_that_of_the_error_beside_the_planted_cause(land):
    """0.3 K of smooth error beside an offset of 1 K: 0.09 / 1.09 of the square error, and its noise."""
    truth, _ = land
    found = causes_of(land, truth + 1.0 + field(71, 4.0, 0.3), noise=0.0)
    assert list(named(found)) == [("offset", "")]
    assert found["unexplained"] == pytest.approx(0.09 / 1.09, rel=0.1)


@pytest.mark.parametrize("change", [0.03, -0.05, 0.004])
def test_a_wrong_field_of_view_is_a_zoom(land, change):
    truth, _ = land
    seen = plants.zoomed(truth, change)
    known = np.ones(SHAPE, bool)
    guess, beside = zoom_of(seen, truth, known)
    assert guess == pytest.approx(change, abs=0.01) and np.hypot(*beside) < 1.0
    found = named(causes_of(land, seen, zoom=guess))
    assert list(found) == [("zoom", "")] and found["zoom", ""] == pytest.approx((change,), abs=0.0005)
    # Beside a shift, both are found; a shifted picture alone has no zoom.
    moved_too = shift(seen, (1.0, -2.0), order=5, mode="nearest")
    guess, beside = zoom_of(moved_too, truth, known)
    found = named(causes_of(land, moved_too, start=beside, zoom=guess))
    assert set(found) == {("zoom", ""), ("shift", "")} and found["zoom", ""] == pytest.approx((change,), abs=0.001)
    moved_only = shift(truth, (1.0, -2.0), order=5, mode="nearest")
    guess, beside = zoom_of(moved_only, truth, known)
    assert list(named(causes_of(land, moved_only, start=beside, zoom=guess))) == [("shift", "")]


@pytest.mark.parametrize("side", [1, -1])
def test_clipped_temperatures_give_their_limit_and_share(land, side):
    truth, _ = land
    limit = np.quantile(truth, 0.8 if side > 0 else 0.2)
    cut = np.minimum(truth, limit) if side > 0 else np.maximum(truth, limit)
    noise = 0.05 * np.random.default_rng(3).normal(size=SHAPE)
    of_truth, level, share = clipping(0.9 * cut + 30.0 + noise, truth, side)
    assert of_truth == pytest.approx(limit, abs=0.05) and level == pytest.approx(0.9 * limit + 30.0, abs=0.05)
    assert share == pytest.approx(0.2, abs=0.01)
    assert clipping(0.9 * cut + 30.0 + noise, truth, -side) is None
    # A map of less contrast, and one that errs where it is warm, are not clipped.
    assert clipping(0.5 * truth + 140.0 + noise, truth, side) is None
    assert clipping(truth + field(72, 2.0, 1.0) * (truth > limit), truth, side) is None


def test_frames_of_other_poses_are_found_and_a_shift_or_a_still_camera_are_not():
    wide = 292.0 + field(81, 3.0, 2.0)
    noise = np.random.default_rng(9)
    views = [wide[:, 6 * k : 6 * k + 130] for k in range(5)]
    known = np.ones(views[0].shape, bool)

    def order_of(shows, change=lambda image: image):
        found = frame_order.FrameOrder()
        for number, truth in enumerate(views):
            found.add(change(views[shows[number]]) + 0.1 * noise.normal(size=truth.shape), truth, known)
        return found.summary()

    assert order_of(range(5)) is None
    assert order_of(range(5), lambda image: shift(image, (0.0, 2.0), order=3, mode="nearest")) is None
    for shows, late in (([0, 0, 1, 2, 3], 1), ([1, 2, 3, 4, 4], -1), ([1, 0, 3, 2, 4], None)):
        # A wrong scale does not matter.
        found = order_of(shows, lambda image: 0.7 * image + 80.0)
        assert found["shows"] == shows and found["late"] == late and found["share"] > 0.9, shows
    views = [views[0]] * 5
    assert order_of([1, 0, 3, 2, 4]) is None


def test_a_sharper_picture_is_not_blurred(land):
    truth, material = land
    soft = gaussian_filter(truth, 1.0)
    assert ("blur", "") not in named(causes_of((soft, material), truth))


def test_a_moved_picture_and_its_derivatives_agree_with_shift_and_blur():
    image = field(51, 2.0).astype(np.float32)
    inside = np.s_[16:-16, 16:-16]
    expected = shift(gaussian_filter(image.astype(float), 1.2), (-0.7, 0.4), order=5)
    found = moved(image, 0.4, -0.7, 1.44)
    assert np.abs(found.image - expected)[inside].max() < 0.01
    for k, name in enumerate(("right", "down", "variance")):
        ahead, behind = (moved(image, *(np.array([0.4, -0.7, 1.44]) + step * np.eye(3)[k])).image
                         for step in (0.05, -0.05))  # fmt: skip
        assert np.abs((ahead - behind) / 0.1 - getattr(found, name))[inside].max() < 0.01, name


def test_mirrored_pictures_and_pictures_of_the_same_edges_are_recognised(land):
    truth, material = land
    known = np.ones(SHAPE, bool)
    reference = registration.transform(truth, known)
    other = 290.0 + field(61, 1.5, 3.0)
    # A map of colour: each material has its own level, in another order, and the fine structure is inverted.
    recoloured = np.array([3.0, -2.0, 1.0])[material] - 0.5 * field(2, 1.2, 1.0)
    for name, image, same in (
        ("upside down", truth[::-1], None), ("left to right", truth[:, ::-1], None),
        ("by half a turn", truth[::-1, ::-1], None), (None, other, False), (None, recoloured, True),
    ):  # fmt: skip
        likeness = registration.Likeness()
        likeness.add(registration.transform(image, known), reference, image, (truth,), known)
        found = likeness.summary()
        if name is not None:
            assert max(found["mirrored"], key=found["mirrored"].get) == name and found["mirrored"][name] > 0.9
        else:
            assert max(found["mirrored"].values(), default=0.0) < 0.5 and (found["edges"] > 6.0) == same, name


def test_rates_of_the_study_count_what_is_named_rightly_and_wrongly():
    def case(planted, named, effect_k=1.0):
        return {"planted": planted, "named": named, "effect_k": effect_k}

    found = [case({}, []), case({}, ["flat"]), case({"shift": 2.0}, ["shift"]), case({"shift": 2.0}, ["shift", "blur"]),
             case({"emissivity": 0.1}, ["material"]), case({"offset": 0.1}, [], 0.1),
             case({"material": 1.0}, ["emissivity"]), case({"flat": -0.9}, ["flat"]),
             case({"flat": -0.9}, [])]  # fmt: skip
    rates = study.rates(found)
    assert {name: (each["count"], each["of"]) for name, each in rates.items()} == {
        "accused": (1, 2), "right": (3, 4), "faint_right": (0, 1), "also_wrong": (2, 5), "flat": (1, 2),
    }  # fmt: skip
    # Without a case, the exact interval ends at 1 − 0.025^(1/n).
    assert study.interval(0, 200) == pytest.approx((0.0, 1.0 - 0.025 ** (1 / 200)))
    assert study.confusion(found)["none"] == {"comparisons": 2, "nothing": 1, "contrast": 1}


def test_method_without_any_temperature_is_named():
    ground = {"me_k": None, "mae_k": None, "sd_k": None, "rmse_k": None, "pixels": 0, "pixels_without_temperature": 9}
    own = {"leaks": [], "circular": [], "true_objects": False, "causes": None, "registered": None,
           "errors": {"radiometric": {"ground": ground}}, "order": [], "emissivities": {"scene": {}}}  # fmt: skip
    (found,) = findings.of_method("empty", own)
    assert (found["kind"], found["grave"]) == ("empty", True)
    assert findings.grouped([found])[0][0] == "Without temperatures"
