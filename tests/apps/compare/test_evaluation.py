"""Evaluation of learned maps in kelvin: known errors are reproduced, tables and figures written, mistakes refused."""

import dataclasses
import json
import sys
import types

import cv2
import numpy as np
import pytest
from compare_support import HIDDEN_K, SHAPE, known_pair, linear_map, make_dataset

from thermorender.apps.compare import (
    evaluation,
    evaluation_report,
    figures,
)
from thermorender.apps.compare.evaluation import LearnedMap, evaluate
from thermorender.apps.training import training_pictures
from thermorender.apps.training.dataset import Entry, ThermalScale, read_dataset
from thermorender.apps.training.dataset_writer import Writer, packed
from thermorender.apps.training.map_inputs import inputs_of
from thermorender.defaults import BAND_UM
from thermorender.errors import ThermorenderError
from thermorender.learned.correlation import Correlation
from thermorender.learned.fingerprints import fingerprints_of
from thermorender.learned.temperature_map import save_map
from thermorender.physics.planck import band_radiance, brightness_temperature
from thermorender.sensor.radiometric_files import write_tlinear

BALANCE, REDRAWN = "heat balance of tables", "floor: hidden state redrawn, over √2"
MEAN = "constant: mean of the training part"


def known_errors(numbers, valid=np.s_[2:, 3:]):
    return np.concatenate([known_pair(number)[2][valid].ravel() for number in numbers])


@pytest.fixture
def undrawn(monkeypatch):
    """Skip the figures, which one test covers."""
    for name in ("picture", "against_time"):
        monkeypatch.setattr(figures, name, lambda *arguments: None)


@pytest.fixture(scope="module")
def scored(tmp_path_factory):
    """(data set, result, folder) of a whole evaluation."""
    root = tmp_path_factory.mktemp("evaluation")
    dataset = make_dataset(root / "d")
    save_map(linear_map(), root / "linear.npz")
    result = evaluate(dataset, [str(root / "linear.npz"), "fok-1to1"], root / "out")
    return dataset, result, root / "out"


def test_maps_that_differ_only_in_their_seed_are_grouped():
    maps = [dataclasses.replace(linear_map(), about=about) for about in (
        {"seed": 0, "options": {"depth": True}}, {"seed": 0, "options": {"depth": False}},
        {"seed": 1, "options": {"depth": True}}, {}, {},
    )]  # fmt: skip
    assert evaluation.kin([LearnedMap.of("m", each) for each in maps]) == [[0, 2], [1], [3], [4]]
    # A privileged map counts as another method, and one seed twice as two trainings.
    assert evaluation.kin([LearnedMap.of("m", maps[0]), LearnedMap.of("o", maps[2], privileged=True)]) == [[0], [1]]
    assert evaluation.kin([LearnedMap.of("m", maps[0]), LearnedMap.of("n", maps[0])]) == [[0], [1]]


def test_known_errors_are_reproduced(scored):
    """Errors planted per pixel: mean, mean absolute, deviation over all, per picture, material and group."""
    _, result, _ = scored
    found, error = result["methods"]["linear"], known_errors(range(4, 10))
    assert found["me_k"] == pytest.approx(error.mean(), abs=2e-3)
    assert found["mae_k"] == pytest.approx(np.abs(error).mean(), abs=2e-3)
    assert found["sd_k"] == pytest.approx(error.std(), abs=2e-3)
    assert found["rmse_k"] == pytest.approx(np.sqrt((error**2).mean()), abs=2e-3)
    assert found["pixels"] == error.size and found["pixels_without_temperature"] == 0
    assert result["images"]["p7"]["linear"]["mae_k"] == pytest.approx(np.abs(known_errors([7])).mean(), abs=2e-3)
    groups = found["groups"]
    assert groups["kind"]["heath"]["me_k"] == pytest.approx(known_errors([5, 7, 9]).mean(), abs=2e-3)
    assert groups["hour"]["13–14 h"]["me_k"] == pytest.approx(known_errors([7]).mean(), abs=2e-3)
    own = np.concatenate([known_pair(n)[2][2:, 3:][known_pair(n)[3][2:, 3:] == 1] for n in range(4, 10)])
    assert groups["material"]["asphalt"]["mae_k"] == pytest.approx(np.abs(own).mean(), abs=2e-3)
    assert groups["surface"]["man-made"] == groups["material"]["asphalt"]
    assert groups["surface"]["natural"] == groups["material"]["grass_green"]
    assert sum(each["pixels"] for each in groups["edges"].values()) == error.size
    # The first two rows are not ground.
    sky = np.concatenate([known_pair(n)[2][:2, 3:] for n in range(4, 10)])
    assert groups["surface"]["sky, not scored"]["pixels"] == sky.size
    assert groups["surface"]["sky, not scored"]["me_k"] == pytest.approx(sky.mean(), abs=3e-3)
    low, high = found["interval_95"]["mae_k"]
    assert low < found["mae_k"] < high and result["drawn"].endswith("sequences")


def test_baselines_have_the_expected_errors(scored):
    _, result, _ = scored
    methods = result["methods"]
    true = {n: known_pair(n)[1][2:, 3:] for n in range(10)}
    test = np.concatenate([true[n].ravel() for n in range(4, 10)])
    mean = np.concatenate([band_radiance(true[n], *BAND_UM).ravel() for n in range(4)]).mean()
    mean = brightness_temperature(mean, *BAND_UM)
    assert methods[MEAN]["me_k"] == pytest.approx(mean - test.mean(), abs=5e-3)
    assert methods[MEAN]["mae_k"] == pytest.approx(np.abs(mean - test).mean(), abs=5e-3)
    assert methods["air temperature"]["mae_k"] == pytest.approx(np.abs(290.0 - test).mean(), abs=2e-3)
    assert methods["the frame's own mean"]["me_k"] == pytest.approx(0.0, abs=1e-4)
    assert methods["the frame's own mean"]["knows"] == "the truth's mean"
    assert methods[BALANCE]["me_k"] == pytest.approx(1.5, abs=2e-3)
    assert methods[BALANCE]["mae_k"] == pytest.approx(1.5, abs=2e-3)
    assert methods[BALANCE]["sd_k"] == pytest.approx(0.0, abs=5e-3)
    # For Gaussian draws, the error of the best map is √(2/π) of their standard deviation.
    assert methods[REDRAWN]["mae_k"] == pytest.approx(np.sqrt(2 / np.pi) * HIDDEN_K, rel=0.02)
    grass = [known_pair(n)[3][2:, 3:] == 0 for n in range(10)]
    own = band_radiance(np.concatenate([true[n][grass[n]] for n in range(4)]), *BAND_UM).mean()
    own = brightness_temperature(own, *BAND_UM) - np.concatenate([true[n][grass[n]] for n in range(4, 10)])
    assert methods["mean per material"]["groups"]["material"]["grass_green"]["mae_k"] == pytest.approx(
        np.abs(own).mean(), abs=5e-3
    )


def test_maps_of_the_same_pictures_share_one_search_and_each_is_named(undrawn, tmp_path, monkeypatch):
    dataset = make_dataset(tmp_path / "d")
    seen, other = (
        [dataset.pair(each).visible for each in part] for part in (dataset.entries[4:6], dataset.entries[:1])
    )
    for name, pictures in (("one", seen), ("two", seen), ("three", other)):
        prints = fingerprints_of(pictures, len(pictures))
        save_map(dataclasses.replace(linear_map(), name=name, fingerprints=prints), tmp_path / f"{name}.npz")
    searched, search = [], training_pictures.search_in
    monkeypatch.setattr(
        training_pictures, "search_in", lambda model, *rest: searched.append(model.name) or search(model, *rest)
    )
    maps = [str(tmp_path / f"{name}.npz") for name in ("one", "two", "three")]
    found = evaluate(dataset, maps, tmp_path / "out")["training_pictures"]
    assert searched == ["one", "three"]
    assert [f"map {name!r}" in found[name]["line"] for name in ("one", "two", "three")] == [True] * 3
    assert found["one"]["found"] == found["two"]["found"] != {} == found["three"]["found"]
    # A later evaluation of the same pairs finds both searches in the cache, and one that wants none has none.
    again = evaluate(dataset, maps[1:], tmp_path / "again")
    assert again["training_pictures"] == {name: found[name] for name in ("two", "three")} and len(searched) == 2
    monkeypatch.setattr(training_pictures, "kept", None)
    monkeypatch.setattr(evaluation, "audit", None)
    without = evaluate(dataset, maps, tmp_path / "without", leaks=False)
    assert without["audit"] is None and "none was searched for them" in without["training_pictures"]["one"]["line"]


def test_exact_map_has_no_error(undrawn, tmp_path, monkeypatch):
    monkeypatch.setattr("compare_support.known_pair", lambda n: _exact(*known_pair(n)))
    dataset = make_dataset(tmp_path / "d", 4, 2)
    save_map(linear_map(), tmp_path / "m.npz")
    found = evaluate(dataset, [tmp_path / "m.npz"], tmp_path / "o")["methods"]["linear"]
    assert found["mae_k"] < 1e-3 and found["ssim"] > 0.9999


def _exact(visible, temperature, error, material):
    return visible, temperature + error, 0.0 * error, material


def test_tables_numbers_and_figures_are_written(scored):
    _, result, folder = scored
    written = json.loads((folder / "evaluation.json").read_text())
    assert written["methods"] == json.loads(json.dumps(result["methods"]))
    header = written["models"]["linear"]
    assert header["about"] == {"training_s": 3.0} and len(header["sha256"]) == 64
    assert written["published"]["pix2pixHD"]["mae_k"] == 0.69 and written["parts"] == {"train": 4, "test": 6}
    assert written["methods"]["linear"]["seconds_per_mpixel"] > 0.0
    page = (folder / "evaluation.md").read_text()
    sections = ("## Cost", "## Material", "## Man-made and natural", "published: pix2pixHD")
    for text in (*sections, evaluation_report.CAVEAT, "asphalt"):
        assert text in page, text
    assert len(list(folder.glob("errors_*.png"))) == 5
    assert all(path.stat().st_size > 10_000 for path in folder.glob("*.png"))
    for table in (evaluation_report.methods(result), evaluation_report.structures(result)):
        assert table.rows and {len(row) for row in table.rows} == {len(table.head)}


def test_pictures_without_truth_use_an_assumed_range(undrawn, tmp_path):
    writer = Writer(tmp_path / "d", {}, ThermalScale("intensity", 1 / 255, 0.0, (14.0, 24.0)))
    rng = np.random.default_rng(0)
    thermal = [rng.integers(0, 256, SHAPE).astype(np.uint8) for _ in range(3)]
    visible = np.zeros((*SHAPE, 3), np.uint8)
    writer.shard("all", [(Entry(f"p{n}", ("train", "test", "test")[n], f"p{n}", "a", n, SHAPE), packed(visible, image))
                         for n, image in enumerate(thermal)])  # fmt: skip
    # Halfway from cold to warm everywhere.
    save_map(linear_map(intercept=0.5).ranged((14.0, 24.0)), tmp_path / "m.npz")
    result = evaluate(read_dataset(tmp_path / "d"), [tmp_path / "m.npz"], tmp_path / "o")
    cold, warm = band_radiance(np.array([287.15, 297.15]), *BAND_UM)
    true = brightness_temperature(cold + (warm - cold) * np.stack(thermal[1:]) / 255.0, *BAND_UM)
    given = brightness_temperature(0.5 * (cold + warm), *BAND_UM)
    found = result["methods"]["linear"]
    assert found["mae_k"] == pytest.approx(np.abs(given - true).mean(), abs=1e-3)
    assert result["bounds_k"] == [287.15, 297.15]
    assert any("assume 14…24 °C" in line for line in evaluation_report.lines_before(result))
    assert result["methods"][BALANCE]["mae_k"] is None
    assert "not available" in (tmp_path / "o/evaluation.md").read_text()


def test_maps_get_the_inputs_on_the_card_and_only_the_privileged_the_material(undrawn, tmp_path, monkeypatch):
    seen = {}

    def predict(self, inputs, texel_m):
        seen[self.intercept] = dict(inputs.terrain), dict(inputs.conditions)
        return np.zeros(inputs.rgb.shape[:2])

    dataset = make_dataset(tmp_path / "d", 3, 2)
    for name, intercept in (("a", 1.0), ("b", 2.0)):
        save_map(linear_map(name, intercept), tmp_path / f"{name}.npz")
    monkeypatch.setattr(Correlation, "predict", predict)
    result = evaluate(dataset, [tmp_path / "a.npz"], tmp_path / "o", privileged=tmp_path / "b.npz")
    assert set(seen[1.0][0]) == {"sun"} and set(seen[2.0][0]) == {"sun", "material"}
    assert seen[1.0][1]["air_k"] == 290.0
    assert np.isnan(seen[2.0][0]["material"][:2]).all() and set(np.unique(seen[2.0][0]["material"][2:])) == {0, 1, 2}
    assert result["methods"]["privileged b"]["kind"] == "privileged"
    assert result["methods"]["privileged b"]["knows"] == "the material"


def test_only_pictures_without_a_scale_are_fitted(undrawn, tmp_path):
    """The fit recovers an affine function of the truth; bad or missing pictures are refused."""
    dataset = make_dataset(tmp_path / "d", 4, 2)
    for name in ("plain", "scaled"):
        (tmp_path / name).mkdir()
    for entry in dataset.of("test").entries:
        temperature = known_pair(int(entry.key[1:]))[1]
        cv2.imwrite(str(tmp_path / f"plain/{entry.key}.png"), np.rint(100 * (temperature - 200.0)).astype(np.uint16))
        write_tlinear(tmp_path / f"scaled/{entry.key}.tif", temperature + 2.0)
    others = {"plain": tmp_path / "plain", "scaled": tmp_path / "scaled"}
    result = evaluate(dataset, ["fok-1to1"], tmp_path / "o", foreign=others)
    fitted = result["methods"]["plain after its best affine fit"]
    assert fitted["mae_k"] < 0.006 and fitted["knows"] == "the truth, by two numbers"
    assert result["methods"]["scaled"]["me_k"] == pytest.approx(2.0, abs=2e-3)
    (tmp_path / "plain/p3.png").unlink()
    with pytest.raises(ThermorenderError, match="has no picture of 1 of 2 pairs, the first 'p3'"):
        evaluate(dataset, ["fok-1to1"], tmp_path / "q", foreign=others)
    cv2.imwrite(str(tmp_path / "plain/p3.png"), np.zeros((4, 4), np.uint16))
    with pytest.raises(ThermorenderError, match=r"p3.png is not a grey picture of 64×48 pixels"):
        evaluate(dataset, ["fok-1to1"], tmp_path / "q", foreign=others)
    for key in ("p2", "p3"):
        cv2.imwrite(str(tmp_path / f"plain/{key}.png"), np.full(SHAPE, 7, np.uint8))
    with pytest.raises(ThermorenderError, match="all values are the same"):
        evaluate(dataset, ["fok-1to1"], tmp_path / "q", foreign=others)
    assert not (tmp_path / "q").exists()


def test_command_scores_the_given_split_and_part(undrawn, tmp_path, call, monkeypatch):
    make_dataset(tmp_path / "d", 4, 2)
    asked = []

    def audit(dataset):
        asked.append({entry.key: entry.part for entry in dataset.entries})
        return types.SimpleNamespace(lines=lambda: ["nothing leaks"], summary=lambda: {"siblings": 0.0})

    monkeypatch.setattr("thermorender.apps.compare.evaluation.audit", audit)
    splits = types.SimpleNamespace(read_split=lambda path: {"p0": "validation", "p1": "train", "p3": "validation"})
    monkeypatch.setitem(sys.modules, "thermorender.apps.training.splits", splits)
    status, out, err = call(
        "evaluate", "fok-1to1", "fok-9to1", "--dataset", tmp_path / "d", "-o", tmp_path / "o", "--split", "s.json",
        "--part", "validation", "--limit", "1", "--seed", "7",
    )  # fmt: skip
    assert status == 0, err
    for text in ("nothing leaks", "fok-9to1", "published: pix2pix, batch 25", "arbitrary", BALANCE):
        assert text in out, text
    result = json.loads((tmp_path / "o/evaluation.json").read_text())
    assert result["audit"] == {"lines": ["nothing leaks"], "siblings": 0.0} and result["pairs"] == 1
    assert asked == [{"p1": "train", "p0": "test"}] and result["seed"] == 7 and result["split"] == "given"


def test_mistakes_are_refused(tmp_path, call):
    dataset = make_dataset(tmp_path / "d", 3, 2)
    with pytest.raises(ThermorenderError, match="models is empty"):
        evaluate(dataset, [], tmp_path / "o")
    with pytest.raises(ThermorenderError, match="has no pairs of part 'validation'"):
        evaluate(dataset, ["fok-1to1"], tmp_path / "o", part="validation")
    with pytest.raises(ThermorenderError, match="name one map twice"):
        evaluate(dataset, ["fok-1to1", "fok-1to1"], tmp_path / "o")
    lacking = make_dataset(tmp_path / "e", 3, 2, terrain=("slope",))
    with pytest.raises(ThermorenderError, match="pair 'p1' has no plane 'slope'"):
        evaluate(lacking, ["fok-1to1"], tmp_path / "o")
    without = make_dataset(tmp_path / "f", 2, 1, truth=False)
    with pytest.raises(ThermorenderError, match="has no plane 'material'"):
        inputs_of(without.pair(without.entries[0]), {}, material=True)
    for wrong in (("--part", "tests"), ("--foreign", "a"), ("--foreign", f"a={tmp_path / 'none'}")):
        status, _, err = call("evaluate", "fok-1to1", "--dataset", tmp_path / "d", "-o", tmp_path / "o", *wrong)
        assert status == 2 and err.startswith("error: --") and err.count("\n") == 1, wrong
    assert not (tmp_path / "o").exists()


def test_error_against_the_share_of_training_data_is_drawn(tmp_path):
    figures.against_share(tmp_path / "s.png", {"trees": [(1.0, 0.8), (0.1, 1.4), (0.01, 2.0)], "linear": [(1.0, 1.5)]})
    assert (tmp_path / "s.png").stat().st_size > 5000


def test_the_legend_of_many_maps_can_be_read_and_fits(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(figures, "save", lambda figure, path: drawn.append(figure))
    methods = {f"map {k}": {"mae_k": 1.0 + k, "seconds_per_mpixel": 0.1 * (k + 1), "interval_95": {"mae_k": None}}
               for k in range(25)}  # fmt: skip
    figures.against_time(tmp_path / "t.png", {"methods": methods})
    (figure,) = drawn
    figure.canvas.draw()
    (legend,) = figure.legends
    # At 80 pixels per inch; a page has 96.
    assert min(each.get_fontsize() for each in legend.get_texts()) * 80 / 96 >= 9.0
    box = legend.get_window_extent()
    assert len(legend.get_texts()) == 25 and box.y0 >= 0.0 and box.height <= figure.bbox.height
