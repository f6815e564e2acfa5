"""Learned maps trained on data sets: results, excluded pixels and pairs, refusals, and the command `train`."""

import json
import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from training_support import SCALE, SHAPE, colours, counts, write

from thermorender.apps.training import map_training
from thermorender.apps.training.dataset import ThermalScale
from thermorender.apps.training.map_inputs import inputs_of
from thermorender.apps.training.map_training import train_map
from thermorender.apps.training.training_methods import METHODS
from thermorender.errors import ThermorenderError
from thermorender.learned.temperature_map import MODELS, SHIPPED, Inputs, load_map, load_model, save_map
from thermorender.physics.planck import band_radiance, brightness_temperature
from thermorender.sensor.camera import load_camera
from thermorender.sensor.readout import radiance_from_counts
from validation.maps import study as maps


def test_linear_relation_is_learned(tmp_path):
    """Values linear in colour are recovered to their rounding, on every thermal scale."""
    grey = ThermalScale("intensity", 1 / 200, -0.1, (10.0, 30.0))
    for name, scale, change in (
        ("radiance", SCALE, lambda values, number: values),
        ("kelvin", ThermalScale("kelvin", 0.01, 200.0), lambda values, number: values),
        ("intensity", grey, lambda values, number: np.clip((values - 8000.0) / 16.0, 0, 255)),
    ):
        dataset = write(tmp_path / name, scale, change=change)
        model = train_map(name, "correlation-1to1", dataset, {"intercept": True})
        known = counts(colours(9))
        if name == "intensity":
            assert model.range_k == pytest.approx((283.15, 303.15))
            known = (known - 8000.0) / 16.0
        found = model.radiance(Inputs(colours(9), 0.2))
        # Kelvin is not linear in radiance, but the map is; the other scales are rounded to 1 of 4000 or of 255.
        limit = {"radiance": 1e-3, "kelvin": 1.0, "intensity": 0.05}[name]
        assert np.abs(found - scale.radiance(known)).max() < limit, name
        assert 0.0 < model.error_k < {"radiance": 0.01, "kelvin": 1.0, "intensity": 0.1}[name]
        assert model.sky_temperature == 240.0 and model.texel_m == pytest.approx(0.2)
        about = model.about
        assert about["unit"] == name and about["pairs"] == {"train": 2, "validation": 1}
        assert about["sequences"] == 3


def test_intensity_bounds_are_those_of_the_training_part(tmp_path):
    dataset = write(tmp_path / "d")
    model = train_map("m", "correlation-1to1", dataset)
    values = np.concatenate([dataset.pair(each).thermal[2:].ravel() for each in dataset.of("train").entries])
    first, third = np.quantile(values, (0.25, 0.75))
    bounds = first - 1.5 * (third - first), third + 1.5 * (third - first)
    assert model.about["bounds"] == pytest.approx(bounds)
    np.testing.assert_allclose(band_radiance(np.array(model.range_k), *SCALE.band_um),
                               SCALE.radiance(bounds), rtol=1e-6)  # fmt: skip


def test_stated_error_is_that_of_the_validation_part(tmp_path, monkeypatch):
    """A validation picture that is 500 counts brighter: 2 W m⁻² sr⁻¹, converted to kelvin by hand."""
    monkeypatch.setattr(map_training, "_FEW_PAIRS", 1)
    dataset = write(tmp_path / "d", change=lambda values, number: values + 500.0 * (number == 2))
    model = train_map("m", "correlation-1to1", dataset, {"intercept": True}, parts=("train",))
    rows, columns = np.mgrid[: SHAPE[0] : 4, : SHAPE[1] : 4]
    true = counts(colours(2))[rows, columns][1:]
    away = brightness_temperature(SCALE.radiance(true + 500.0), *SCALE.band_um)
    away -= brightness_temperature(SCALE.radiance(true), *SCALE.band_um)
    assert model.error_k == pytest.approx(math.sqrt((away**2).mean()), rel=0.01)
    assert model.about["pairs"] == {"train": 2} and model.about["error_on"] == {"pairs": 1, "folds": 1}
    # A fit with the validation part has the same error: it is fitted again without it.
    again = train_map("m", "correlation-1to1", dataset, {"intercept": True})
    assert again.error_k == model.error_k and again.predictor.intercept != model.predictor.intercept


def test_error_of_few_pictures_is_cross_validated_by_sequence(tmp_path):
    """Of four sequences, one is 500 counts brighter: each is predicted by a fit to the other three."""
    dataset = write(tmp_path / "d", parts=("train",) * 3 + ("validation",),
                    change=lambda values, number: values + 500.0 * (number == 2))  # fmt: skip
    model = train_map("m", "correlation-1to1", dataset, {"intercept": True})
    assert model.about["error_on"] == {"pairs": 4, "folds": 4}
    squares = []
    for out in range(4):
        fitted = dataset.having([replace(each, part="train") for k, each in enumerate(dataset.entries) if k != out])
        pair = dataset.pair(dataset.entries[out])
        found = train_map("m", "correlation-1to1", fitted, {"intercept": True}, judged=False)
        assert found.error_k is None
        given, true = (brightness_temperature(each[::4, ::4], *SCALE.band_um)
                       for each in (found.radiance(inputs_of(pair, dataset.card)), pair.reference))  # fmt: skip
        squares.append(((given - true) ** 2)[pair.valid[::4, ::4]])
    assert model.error_k == pytest.approx(math.sqrt(np.concatenate(squares).mean()), rel=1e-9)
    # Every method without a long training, whatever part the pictures are in.
    for method, parts in (("palette", ("train",) * 4), ("trees", ("train",) * 4), ("correlation-1to1", ("train",) * 4)):
        kept = dataset.having([replace(each, part=part) for each, part in zip(dataset.entries, parts, strict=True)])
        assert train_map("m", method, kept).about["error_on"] == {"pairs": 4, "folds": 4}, method


def test_a_network_is_not_judged_by_the_sequences_that_choose_its_state(tmp_path):
    dataset = write(tmp_path / "d", parts=("train", "validation", "validation", "train", "validation"))
    ((kept, out),) = map_training.held_out(dataset, dataset.of("train", "validation"), network=True)
    assert [each.sequence for each in out.entries] == ["s2"]
    assert [each.sequence for each in kept.entries] == ["s0", "s1", "s3", "s4"]
    assert map_training.held_out(dataset.of("train"), dataset.of("train"), network=True) == []


def test_error_is_none_without_a_sequence_or_valid_pixels_to_leave_out(tmp_path, monkeypatch):
    """An error of 0 would be a claim."""
    assert train_map("m", "correlation-1to1", write(tmp_path / "a", parts=("train", "test"))).error_k is None
    monkeypatch.setattr(map_training, "_FEW_PAIRS", 1)
    dataset = write(tmp_path / "b", origin="rendered", camera="boson-640",
                    change=lambda values, number: values * 0 if number == 2 else values)  # fmt: skip
    assert train_map("m", "correlation-1to1", dataset, parts=("train",)).error_k is None


def test_level_and_spread_of_the_training_are_recorded(tmp_path):
    """Of the pictures' valid pixels, without sky and saturated ones; their values are 40 W m⁻² sr⁻¹ and more."""
    from thermorender.learned.pixel_features import lab

    sky = np.zeros(SHAPE, np.uint8)
    sky[:8] = 255
    dataset = write(tmp_path / "d", extra=True, truth=lambda number: {"material": sky})
    model = train_map("m", "correlation-1to1", dataset, judged=False)
    shown = [dataset.pair(each) for each in dataset.of("train", "validation").entries]
    kelvin = np.concatenate([brightness_temperature(each.reference[8::4, ::4], *SCALE.band_um) for each in shown])
    colour = np.concatenate([lab(each.visible[8::4, ::4]) for each in shown]).reshape(-1, 3).astype(np.float64)
    level = model.level
    assert (level.kelvin, level.kelvin_spread) == pytest.approx((kelvin.mean(), kelvin.std()), rel=1e-6)
    within = [brightness_temperature(each.reference[8::4, ::4], *SCALE.band_um).var() for each in shown]
    assert level.kelvin_within == pytest.approx(math.sqrt(np.mean(within)), rel=1e-6)
    assert level.colour == pytest.approx(colour.mean(axis=0), rel=1e-6)
    assert level.colour_spread == pytest.approx(colour.std(axis=0), rel=1e-6)
    assert level.air_k == pytest.approx(281.0)
    # One standard deviation from the mean of training, on the pictures of training.
    own = [level.distance(each.visible[8::4, ::4]) ** 2 for each in shown]
    assert np.mean(own) == pytest.approx(1.0, rel=1e-5)
    even = np.zeros((4, 4, 3), np.uint8)
    away = np.sqrt(np.mean((np.array(level.colour) / level.colour_spread) ** 2))
    assert level.distance(even) == pytest.approx(away, rel=1e-5)
    save_map(model, tmp_path / "m.npz")
    assert load_map(tmp_path / "m.npz").level == level
    # An air that only some pictures state is not that of the level.
    some = [replace(each, conditions={} if number else each.conditions) for number, each in enumerate(dataset.entries)]
    assert train_map("m", "correlation-1to1", dataset.having(some), judged=False).level.air_k is None


@pytest.mark.parametrize("unknown", [1, 4])
@pytest.mark.parametrize("method", ["correlation-9to1", "trees", "palette"])
def test_an_unknown_ground_sampling_distance_stays_unknown(tmp_path, method, unknown):
    """One picture without it is enough: the map resamples nothing, and says so."""
    dataset = write(tmp_path / "d")
    some = [replace(each, texel_m=each.texel_m if number >= unknown else None)
            for number, each in enumerate(dataset.entries)]  # fmt: skip
    model = train_map("m", method, dataset.having(some), judged=False)
    assert model.texel_m is None and model.texel_range_m is None
    assert "texel         unknown size: pictures are not resampled" in str(model)
    fine, coarse = (model.radiance(Inputs(colours(9), texel_m)) for texel_m in (0.05, 5.0))
    assert np.array_equal(fine, coarse) and model.texel_warning(0.05) is None


def test_saturated_pixels_are_excluded(tmp_path):
    """For a known camera, at either end of its counts; for an unknown one all values count."""
    top = 2**14 - 1

    def burnt(values, number):
        values[10:20], values[20:24] = top, 0
        return values

    camera = load_camera("boson-640", "camera")
    zero, high = radiance_from_counts(np.array([0.0, top]), camera)
    scale = ThermalScale("radiance", float((high - zero) / top), float(zero), None, camera.band_um)
    known = scale.radiance(counts(colours(9)))
    error = {}
    for origin in ("rendered", "made"):
        dataset = write(tmp_path / origin, scale, change=burnt, origin=origin, camera="boson-640")
        model = train_map("m", "correlation-1to1", dataset, {"intercept": True})
        error[origin] = np.abs(model.radiance(Inputs(colours(9), 0.2)) - known).max()
    assert error["rendered"] < 0.01 < 1.0 < error["made"]


def test_sky_too_cold_for_the_intensity_bounds(tmp_path):
    """A third of the pixels is sky: the lower bound is a radiance below 0, which no temperature has."""

    def under_the_sky(values, number):
        values[:16] = 500.0
        return values

    dataset = write(tmp_path / "d", change=under_the_sky)
    model = train_map("m", "correlation-1to1", dataset, {"intercept": True})
    assert np.isfinite(model.range_k).all() and model.range_k[0] < model.range_k[1]
    assert SCALE.radiance(model.about["bounds"][0]) < 0.0
    assert np.isfinite(model.radiance(Inputs(colours(9), 0.2))).all()


def test_card_without_a_name(tmp_path):
    dataset = write(tmp_path / "nameless")
    del dataset.card["name"]
    assert train_map("m", "correlation-1to1", dataset).source == "correlation-1to1 on 3 pairs of nameless"


# --- what is refused --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("correlation-1to1", {"intercept": "perhaps"}, "intercept='perhaps' of 'correlation-1to1' is not allowed; give "
         "true or false"),
        ("correlation-1to1", {"intercept": 2}, "intercept=2 .* give true or false"),
        ("correlation-1to1", {"penalty": "much"}, "penalty='much' .* give a number from 0 up"),
        ("correlation-1to1", {"penalty": "-1"}, "penalty='-1' .* give a number from 0 up"),
        ("correlation-1to1", {"penalty": "nan"}, "penalty='nan' .* give a number from 0 up"),
        ("correlation-1to1", {"penalty": None}, "penalty=None .* give a number from 0 up"),
        ("correlation-1to1", {"penalty": [1]}, r"penalty=\[1\] .* give a number from 0 up"),
        ("correlation-1to1", {"cell": 3}, "'correlation-1to1' has no option 'cell'; it has intercept, penalty"),
        ("palette", {"cell": 0}, "cell=0 is not allowed for a palette; give 2…64"),
        ("trees", {"cell": 3}, "'trees' has no option 'cell'; it has none"),
        ("correlation-2x2", {}, "method 'correlation-2x2' is unknown; "),
        ("correlation-17x17", {}, "method 'correlation-17x17' is unknown; "),
        ("corelation+", {}, r"'corelation\+' is unknown; did you mean '?correlation\+'?"),
        ("trees+", {}, r"'trees\+' needs the terrain's relief, hour and weather, which .* does not have; take trees$"),
        ("correlation+", {}, r"'correlation\+' needs .* does not have; take correlation-9to1$"),
    ],
)  # fmt: skip
def test_wrong_settings_are_refused(tmp_path, name, options, words):
    with pytest.raises(ThermorenderError, match=words):
        train_map("m", name, write(tmp_path / "d"), options)


def test_privileged_needs_a_method_and_a_data_set_with_materials(tmp_path, monkeypatch):
    class Enough(Exception):
        pass

    def look(task):
        raise Enough(task.examples[0].inputs.terrain)

    monkeypatch.setitem(METHODS, "trees+", replace(METHODS["trees+"], fit=look))
    plain = write(tmp_path / "plain", extra=True)
    for name in ("trees", "palette", "correlation-9to1", "correlation+"):
        with pytest.raises(ThermorenderError, match="so its map cannot be privileged; take trees"):
            train_map("m", name, plain, material=True)
    with pytest.raises(ThermorenderError, match=r"pair 's\d-0' has no plane 'material'"):
        train_map("m", "trees+", plain, material=True)

    def material(number):
        return {"material": np.full(SHAPE, 3, np.uint8)}

    dataset = write(tmp_path / "knows", extra=True, truth=material, materials=["a", "b", "c", "d"])
    for shown in (True, False):
        with pytest.raises(Enough) as found:
            train_map("m", "trees+", dataset, material=shown)
        assert set(found.value.args[0]) == {"slope", *(["material"] if shown else [])}


def test_empty_parts_are_named(tmp_path):
    dataset = write(tmp_path / "d", parts=("test",))
    with pytest.raises(ThermorenderError, match="d has no pairs in train or validation; give a split that has some"):
        train_map("m", "correlation-1to1", dataset)
    empty = write(tmp_path / "empty", parts=())
    with pytest.raises(ThermorenderError, match="empty has no pairs in train or validation"):
        train_map("m", "correlation-1to1", empty)
    flat = write(tmp_path / "flat", change=lambda values, number: 0.0 * values + 9000.0)
    with pytest.raises(ThermorenderError, match="half of the thermal pixels of the training part are 9000"):
        train_map("m", "correlation-1to1", flat)


# --- the verb ---------------------------------------------------------------------------------------------------


def test_command_trains_and_writes_a_map(tmp_path, call):
    write(tmp_path / "d", extra=True)
    for method, options in (("correlation-1to1", ("--set", "intercept=true", "--set", "penalty=1e-6")),
                            ("correlation+", ())):  # fmt: skip
        path = tmp_path / f"{method}.npz"
        status, out, err = call("train", method, tmp_path / "d", "-o", path, *options, "--seed", 3)
        assert status == 0, err
        model = load_map(path)
        assert model.method == method and model.about["seed"] == 3 and f"{path}: trained in" in out
        assert "K on 3 pairs, cross-validated in 3 folds" in out and model.error_k < 1.0
        assert model.about["conditions"] == {"air_k": [280.0, 282.0], "solar_hour": [6.0, 8.0]}
    assert load_map(tmp_path / "correlation-1to1.npz").about["options"] == {
        "intercept": True, "penalty": 1e-6, "above_air": False,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("corelation+", "{d}"), "method 'corelation+' is unknown"),
        (("trees",), "train trees was given 0 data sets; give one"),
        (("trees", "{d}", "{d}"), "train trees was given 2 data sets; give one"),
        (("trees", "{d}x"), "dx is not a data set: card.json is missing"),
        (("correlation-1to1", "{d}", "--set", "penalty"), "--set='penalty' is not allowed; give OPTION=VALUE"),
        (("correlation-1to1", "{d}", "--set", "=3"), "--set='=3' is not allowed; give OPTION=VALUE"),
        (("correlation-1to1", "{d}", "--set", "penalty=a"), "option penalty='a' of 'correlation-1to1' is not allowed"),
        (("correlation-1to1", "{d}", "--privileged"), "does not use materials, so its map cannot be privileged"),
        (("trees+", "{d}"), "needs the terrain's relief, hour and weather"),
        (("trees", "{d}", "--texel-m", "0.2"), "belong to `train emissivity`, not to 'trees'; leave them out"),
        (("trees", "{d}", "--labels", "x.geojson"), "belong to `train emissivity`, not to 'trees'; leave them out"),
        (("emissivity", "--privileged"), "--run, --resume and --best belong to maps"),
        (("emissivity", "--set", "a=b"), "--run, --resume and --best belong to maps"),
        (("correlation-1to1", "{d}", "--split", "{d}/card.json"), "card.json"),
        (("correlation-1to1", "{d}", "--split", "{d}/none.json"), "none.json"),
    ],
)
def test_command_refuses_in_one_sentence_and_writes_nothing(tmp_path, call, arguments, words):
    write(tmp_path / "d")
    given = [text.replace("{d}", str(tmp_path / "d")) for text in arguments]
    status, out, err = call("train", *given, "-o", tmp_path / "m.npz")
    assert status == 2 and out == "" and words in err and len(err.strip().splitlines()) == 1, err
    assert not (tmp_path / "m.npz").exists()


def test_user_split_is_used(tmp_path, call):
    from thermorender.apps.training.splits import write_split

    dataset = write(tmp_path / "d")
    parts = {each.key: "train" if number < 3 else "test" for number, each in enumerate(dataset.entries)}
    path = tmp_path / "split.json"
    write_split(path, parts)
    status, _, err = call("train", "correlation-1to1", tmp_path / "d", "-o", tmp_path / "m.npz", "--split", path)
    assert status == 0, err
    model = load_map(tmp_path / "m.npz")
    assert model.about["pairs"] == {"train": 3, "validation": 0}
    assert model.about["error_on"] == {"pairs": 3, "folds": 3}


def test_train_emissivity_uses_a_class_raster(tmp_path, call):
    from scenes import write_terrain

    rng = np.random.default_rng(0)
    classes = np.repeat([[1] * 16 + [2] * 16], 32, axis=0)
    colour = np.where(classes[..., None] == 1, (60, 120, 50), (200, 180, 140)) + rng.integers(-9, 9, (32, 32, 3))
    folder = write_terrain(tmp_path / "scene", classes=classes, colour=colour)
    status, out, err = call("train", "emissivity", folder, "-o", tmp_path / "e.npz")
    assert status == 0, err
    assert "grass_green" in out and "sand_quartz" in out and (tmp_path / "e.npz").is_file()


def test_share_of_the_sequences_is_used_for_training(tmp_path):
    dataset = write(tmp_path / "d", parts=("train",) * 8 + ("validation", "test"))
    for share, expected in ((0.01, {"s0"}), (0.25, {"s0", "s4"}), (0.5, {"s0", "s2", "s4", "s6"}), (1.0, None)):
        model = train_map("m", "correlation-1to1", dataset, share=share)
        count = 9 if expected is None else len(expected) + 1
        assert model.about["sequences"] == count and model.about["share"] == share
        assert model.about["pairs"] == {"train": count - 1, "validation": 1}
    # Excluded sequences have no effect: those from another linear relation would change the map.
    other = write(
        tmp_path / "o", parts=("train",) * 8 + ("validation", "test"),
        change=lambda values, number: values if number in (0, 8, 9) else 65535 - values,
    )  # fmt: skip
    options = {"intercept": True}
    few, all_ = (train_map("m", "correlation-1to1", other, options, share=share) for share in (0.01, 1))
    assert few.error_k < 0.05 < 2.0 < all_.error_k


def test_shifted_pairs_have_larger_errors(tmp_path):
    """Where colours are smooth a shift costs little; where they are noise it removes all information."""
    dataset = write(tmp_path / "d")
    options = {"intercept": True}
    errors = [train_map("m", "correlation-1to1", dataset, options, shift_px=shift).error_k
              for shift in (0.0, 1.0, 16.0)]  # fmt: skip
    assert errors[0] < 0.05 < errors[1] < errors[2]


@pytest.mark.slow
def test_error_against_share_and_shift(tmp_path, call_module):
    write(tmp_path / "d", parts=("train",) * 4 + ("validation", "test", "test"))
    status, out, errors = call_module("validation.maps", "--dataset", tmp_path / "d", "--methods", "correlation-1to1",
                               "--limit", "1", "-o", tmp_path / "o")  # fmt: skip
    assert status == 0, errors
    assert "correlation-1to1" in out
    result = json.loads((tmp_path / "o" / "maps.json").read_text())
    cases = {(case["varied"], case["value"]): case for case in result["cases"]}
    assert {key for key in cases if key[0] == "shift_px"} == {("shift_px", float(s)) for s in (0, 1, 2, 4, 8, 16)}
    assert cases["share", 1.0]["mae_k"] == cases["shift_px", 0.0]["mae_k"]
    assert cases["shift_px", 16.0]["mae_k"] > cases["shift_px", 0.0]["mae_k"] + 0.3
    assert result["test_pairs"] == 1 and {"versions", "machine", "seed"} <= set(result)
    for name in ("maps_share.png", "maps_shift_px.png"):
        assert (tmp_path / "o" / name).stat().st_size > 5000
    status, _, errors = call_module("validation.maps", "--dataset", tmp_path / "d", "--methods", "corelation-1to1",
                             "-o", tmp_path / "p")  # fmt: skip
    assert status == 2 and "did you mean 'correlation-1to1'" in errors and not (tmp_path / "p").exists()


@pytest.mark.slow
def test_excluded_kind_of_land_is_not_learned_from(tmp_path):
    """Sand is warm where it is bright, snow is cold there: a map that saw only one is wrong on the other."""
    parts = ("train",) * 6 + ("test",) * 4
    dataset = write(
        tmp_path / "d", parts=parts, change=lambda values, number: values if number % 2 else 18000.0 - values
    )
    named = [replace(entry, labels={"kind": ("snow", "sand")[k % 2]}) for k, entry in enumerate(dataset.entries)]
    dataset = dataset.having(named)
    result = maps.run(dataset, ("correlation-1to1", "trees"), ("kind",), limit=4)
    cases = {(case["method"], case["value"]): case for case in result["cases"]}
    assert set(cases) == {(name, kind) for name in ("correlation-1to1", "trees") for kind in ("sand", "snow")}
    for case in cases.values():
        # A method of colour alone that is trained on both predicts something in between.
        assert case["pairs"] == 3 and case["mae_k"] > 1.2 * case["seen_mae_k"] > 0.5
    assert [row[1] for row in maps.rows(result)] == ["kind"] * 4
    # The figure for a kind equals that of training and scoring on such pairs alone.
    alone = dataset.having([each for each in dataset.entries if each.labels["kind"] == "sand" or each.part == "test"])
    model = train_map("m", "correlation-1to1", alone.having([e for e in alone.entries if e.part == "train"]))
    errors = []
    for entry in dataset.of("test").entries:
        if entry.labels["kind"] == "snow":
            pair = dataset.pair(entry)
            found, true = (brightness_temperature(each[::2, ::2], *SCALE.band_um)
                           for each in (model.radiance(Inputs(pair.visible)), pair.reference))  # fmt: skip
            errors.append(np.abs(found - true)[pair.valid[::2, ::2]])
    assert cases["correlation-1to1", "snow"]["mae_k"] == pytest.approx(np.concatenate(errors).mean(), abs=1e-4)


def test_missing_kinds_are_skipped(tmp_path):
    dataset = write(tmp_path / "d", parts=("train",) * 3 + ("test",) * 2)
    names = ("sand", "snow", None, "sand", None)
    dataset = dataset.having([replace(entry, labels={"kind": name} if name else {})
                              for entry, name in zip(dataset.entries, names, strict=True)])  # fmt: skip
    result = maps.run(dataset, ("correlation-1to1",), ("kind",))
    assert [(case["value"], case["pairs"]) for case in result["cases"]] == [("sand", 2)]


@pytest.mark.slow
def test_methods_that_the_data_set_does_not_support(tmp_path):
    dataset = write(tmp_path / "d", parts=("train",) * 3 + ("test",))
    with pytest.raises(ThermorenderError, match="method 'trees\\+' needs the terrain's relief"):
        maps.run(dataset, ("correlation-1to1", "trees+"), ("share",))
    methods = {case["method"] for case in maps.run(dataset, vary=("share",))["cases"]}
    assert methods == {name for name in maps.METHODS if name != "correlation+"}


@pytest.mark.parametrize(
    ("vary", "words"),
    [(("kind",), "a single kind of land, which cannot be left out"),
     (("shape",), "vary='shape' is unknown; give share, shift_px, kind")],
)  # fmt: skip
def test_unknown_variations_are_refused(tmp_path, vary, words):
    with pytest.raises(ThermorenderError, match=words):
        maps.run(write(tmp_path / "d"), ("correlation-1to1",), vary)


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_maps_record_their_training(name):
    model = load_model(name)
    assert model.name == name and model.source.endswith("rendered from procedural scenes")
    assert model.about["dataset"]["origin"] == "rendered" and model.about["dataset"]["licence"] == "MIT"
    assert model.about["pairs"] == {"train": 1620, "validation": 162} and model.about["seed"] == 0
    # Ground over a year and all hours, on the mean about as warm as the air.
    assert abs(model.level.kelvin - model.level.air_k) < 2.0 < model.level.kelvin_within < model.level.kelvin_spread
    assert "60 training worlds" in model.about["level_of"]
    # Four seasons, day and night.
    seen = model.about["conditions"]
    assert seen["air_k"][0] < 260.0 and seen["air_k"][1] > 300.0 and seen["day"][1] - seen["day"][0] > 350
    assert seen["sun_elevation_deg"][0] < -50.0 and seen["sun_elevation_deg"][1] > 60.0
    assert bool(model.needs) == name.endswith("+")
    assert model.about.get("training") or SHIPPED[name].stat().st_size < 1_000_000
    # Networks record the effect of half precision: less than a count of the 16-bit pictures that they translate to.
    assert 0.0 <= model.about.get("training", {}).get("kept_mk", 0.0) < 40.0


def test_shipped_maps_are_small():
    assert sum(path.stat().st_size for path in SHIPPED.values()) < 30_000_000


def test_shipped_maps_translate_and_name_the_inputs_they_need(tmp_path, call):
    cv2.imwrite(str(tmp_path / "a.png"), colours(3))
    status, _, errors = call("translate", "procedural-palette", tmp_path / "a.png", "-o", tmp_path / "o")
    assert status == 0, errors
    status, _, errors = call("translate", "procedural-trees+", tmp_path / "a.png", "-o", tmp_path / "p")
    assert status == 2 and "procedural-trees+" in errors and not (tmp_path / "p").exists()


def test_uncertainty_in_kelvin_is_that_of_brightness_temperature():
    """Half the change of temperature from one standard deviation of intensity below to one above."""

    class Unsure:
        needs, above_air = (), False

        def with_spread(self, inputs):
            return np.linspace(-0.2, 1.4, inputs.rgb[..., 0].size).reshape(inputs.rgb.shape[:2]), np.full((8, 9), 1e-3)

    published = MODELS["fok-1to1"]
    model = replace(published, predictor=Unsure())
    inputs = Inputs(np.zeros((8, 9, 3), np.uint8))
    radiance, spread = model.translated(inputs)
    cold, warm = band_radiance(np.array(model.range_k), *model.band_um)
    ends = [brightness_temperature(radiance + sign * 1e-3 * (warm - cold), *model.band_um) for sign in (-1.0, 1.0)]
    assert np.allclose(spread, 0.5 * (ends[1] - ends[0]), rtol=1e-4)
    assert np.array_equal(model.radiance(inputs), radiance)
