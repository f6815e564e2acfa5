"""The studies of planted leaks and of real pairs, on small pictures made here."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from thermorender.errors import ThermorenderError
from thermorender.learned import fingerprints
from thermorender.learned.temperature_map import MODELS
from thermorender.learned.training_level import TrainingLevel
from validation.leaks import study as leaks
from validation.real_pairs import study as real_pairs


def picture(seed, side=(72, 96)):
    generator, (height, width) = np.random.default_rng(seed), side
    layers = [cv2.resize(generator.normal(size=(height // k, width // k, 3)), (width, height)) for k in (2, 7, 23)]
    return np.clip(128.0 + 30.0 * sum(layers), 0, 255).astype(np.uint8)


def test_planted_leaks_are_counted_and_innocent_pictures_named(monkeypatch):
    monkeypatch.setattr(leaks, "PLANTED", 2)
    known = {f"t{seed}": picture(seed) for seed in range(3)}
    innocent = {"new": picture(50), "copy of t1": picture(1)[::-1]}
    monkeypatch.setattr(leaks, "procedural_pictures", lambda report: (known, innocent))
    result = leaks.run([], seed=1)
    cases = result["sets"]["procedural"]["cases"]
    assert {kind: each["number"] for kind, each in cases.items()} == {**dict.fromkeys(leaks.LEAKS, 2),
                                                                     "innocent pictures": 2}  # fmt: skip
    assert all(cases[kind]["found"] == 2 for kind in leaks.LEAKS)
    assert cases["innocent pictures"]["found"] == 1
    assert result["sets"]["procedural"]["named"]["copy of t1"][0] == "t1"
    assert result["bytes_per_picture"] == fingerprints.BYTES
    assert {len(row) for row in leaks.rows(result)} == {len(leaks.HEADER)}


def test_a_folder_with_too_few_pictures_to_plant_leaks_is_refused(tmp_path):
    cv2.imwrite(str(tmp_path / "one.png"), picture(0))
    with pytest.raises(ThermorenderError, match="has 1 pictures; give a folder of at least 30"):
        leaks.pictures_in(tmp_path)


def write_plots(folder):
    """Six pairs of three columns: temperature follows red, but in the last column it is 5 K warmer."""
    for name in ("visible", "thermal"):
        (folder / "field_plots" / name).mkdir(parents=True)
    for number, name in enumerate(("e0_1", "e0_2", "e1_1", "e1_2", "e2_1", "e2_2")):
        rgb = picture(number)
        celsius = 10.0 + 0.1 * rgb[..., 0].astype(float) + 5.0 * name.startswith("e2")
        cv2.imwrite(str(folder / f"field_plots/visible/{name}.png"), rgb[..., ::-1])
        cv2.imwrite(str(folder / f"field_plots/thermal/{name}.tif"), np.rint(100.0 * celsius).astype(np.uint16))


def test_every_group_is_tested_by_maps_of_the_others(tmp_path, call_module):
    write_plots(tmp_path)
    status, _, err = call_module(
        "validation.real_pairs", tmp_path, "--methods", "9-to-1 with intercept", "-o", tmp_path / "o"
    )
    assert status == 0, err
    own = json.loads((tmp_path / "o/real_pairs.json").read_text())["sets"]["field_plots"]
    found = own["methods"]["9-to-1 with intercept"]
    assert own["pairs"] == 6 and own["folds"] == 3 and own["groups"] == "3 sequences"
    # The third column is 5 K too cold by the maps of the others, and these are 2.5 K too warm by maps of the third.
    assert found["me_k"] == pytest.approx((2.5 + 2.5 - 5.0) / 3, abs=0.3)
    assert found["mae_k"] == pytest.approx((2.5 + 2.5 + 5.0) / 3, abs=0.3)
    within = found["structure"]
    assert within["correlation"] > 0.95 and within["slope"] == pytest.approx(1.0, abs=0.15)
    assert within["mae_without_mean_k"] < 0.5 and within["shift_more_k"] > 0.1
    constant = own["methods"][real_pairs.CONSTANT]["structure"]
    assert constant["correlation"] is None and constant["slope"] == 0.0
    assert own["shown_in_training"] == {} and own["masked_share"] == 0.0
    assert {"fok-1to1", "procedural-trees", "9-to-1 with intercept"} <= set(own["anchored"]["maps"])
    page = (tmp_path / "o/real_pairs.md").read_text()
    for text in ("## Field plots", "Licence: None stated", "no test picture shows a training picture", "+"):
        assert text in page, text


def test_anchors_are_scored_beside_constants_at_the_same_anchor():
    """A map with the truth's pattern, of another level and half the span; and one that is a constant."""
    rng = np.random.default_rng(0)
    level = TrainingLevel(295.0, 8.0, 3.0, 290.0, (50.0, 0.0, 0.0), (20.0, 10.0, 10.0))
    model = replace(MODELS["fok-1to1"], level=level)
    scores, known = real_pairs.Anchored(4, seed=3), np.ones((30, 40), bool)
    known[0] = False
    true = [np.where(known, rng.normal(280.0 + 5.0 * k, 4.0, known.shape), -99.0) for k in range(4)]
    for k in range(4):
        mapped = {"like": 150.0 + 0.5 * true[k], "flat": np.full(known.shape, 300.0)}
        scores.add(k, dict.fromkeys(mapped, model), mapped, true[k], known, air_k=279.0 + 5.0 * k)
    found = scores.summary(np.arange(4))["maps"]
    mae = {key: {how: own["mae_k"] for how, own in each.items()} for key, each in found.items()}
    mean = np.mean([np.abs(each[known] - each[known].mean()).mean() for each in true])
    assert mae[real_pairs.OWN_MEAN][real_pairs.AS_IS] == pytest.approx(mean)
    # The air is 1 K colder than the ground, and the training's ground 5 K warmer than its air.
    assert mae[real_pairs.CONSTANT_AT_ANCHOR][real_pairs.BY_AIR] == pytest.approx(
        np.mean([np.abs(each[known] - 279.0 - 5.0 * k).mean() for k, each in enumerate(true)]))  # fmt: skip
    moved = [284.0 + 5.0 * k - each[known] for k, each in enumerate(true)]
    assert mae["flat"][real_pairs.BY_AIR] == pytest.approx(np.mean(np.abs(moved)))
    like = [284.0 + 5.0 * k + 0.5 * min(1.0, 3.0 / 3.0**0.5 / (0.5 * each[known].std())) * (each - each[known].mean())
            - each for k, each in enumerate(true)]  # fmt: skip
    assert mae["like"][real_pairs.BY_AIR] == pytest.approx(np.mean([np.abs(each[known]).mean() for each in like]))
    # A map without a pattern is the constant at three known temperatures; one with the truth's is better.
    flat, like = found["flat"][real_pairs.BY_KNOWN], found["like"][real_pairs.BY_KNOWN]
    assert flat["mae_k"] == pytest.approx(mae[real_pairs.CONSTANT_AT_ANCHOR][real_pairs.BY_KNOWN])
    assert flat["minus_constant"]["k"] == pytest.approx(0.0, abs=1e-9)
    assert like["minus_constant"]["k"] < like["minus_constant"]["interval_95"][1] < -0.5
    assert like["minus_own_mean"]["k"] == pytest.approx(like["mae_k"] - mean)


def test_known_temperatures_are_not_scored():
    """A picture of 290 K but for a pixel: where that is known, the error of the constant does not count it."""
    model, known = MODELS["fok-1to1"], np.ones((1, 4), bool)
    true = np.array([[290.0, 290.0, 290.0, 350.0]])
    scores = real_pairs.Anchored(1, seed=0)
    scores.add(0, {"m": model}, {"m": np.full((1, 4), 290.0)}, true, known)
    rows = scores.rows[real_pairs.CONSTANT_AT_ANCHOR, real_pairs.BY_KNOWN]
    # One of four pixels is scored: the warm one is 60 K off, any other stands beside a constant that is 20 K too warm.
    warm = (rows[0, 2] - 20.0) / 40.0
    assert rows[0, 0] == 1.0 and 0.0 <= warm <= 1.0 and warm * real_pairs.DRAWS == pytest.approx(
        round(warm * real_pairs.DRAWS))  # fmt: skip


def test_unknown_sets_and_folders_without_sets_are_refused(tmp_path):
    with pytest.raises(ThermorenderError, match="set 'roads' is unknown; give field_plots, flame3"):
        real_pairs.run(tmp_path, ["roads"])
    with pytest.raises(ThermorenderError, match="has none of the folders field_plots/visible"):
        real_pairs.run(tmp_path)


def test_folds_keep_groups_together_and_are_of_about_equal_size():
    groups = np.repeat(list("abcdef"), [30, 20, 10, 10, 5, 5])
    fold = np.array(real_pairs.folds_of(groups, 3))
    assert all(len(set(fold[groups == name])) == 1 for name in "abcdef")
    assert sorted(np.bincount(fold)) == [25, 25, 30]
    assert real_pairs.folds_of(["x", "y", "x"], None) == [0, 1, 0]
    with pytest.raises(ThermorenderError, match="so none can be left out"):
        real_pairs.folds_of(["x", "x"], None)
