"""Evaluation of learned maps in kelvin: known errors are reproduced, tables and figures written, mistakes refused."""

import dataclasses
import functools
import json
import sys
import types

import cv2
import numpy as np
import pytest

from thermorender.apps.compare.evaluation import classes, figures, paired, report, similarity, structure, sums
from thermorender.apps.compare.evaluation.estimators import LearnedMap
from thermorender.apps.compare.evaluation.evaluate import evaluate
from thermorender.apps.training.dataset import Entry, ThermalScale, read_dataset
from thermorender.apps.training.dataset_writer import Writer, packed
from thermorender.apps.training.map_inputs import inputs_of
from thermorender.defaults import BAND_UM
from thermorender.errors import ThermorenderError
from thermorender.learned.correlation import Correlation
from thermorender.learned.temperature_map import Inputs, TemperatureMap, save_map
from thermorender.materials.library import load_library
from thermorender.physics.planck import band_radiance, brightness_temperature
from thermorender.sensor.radiometric_files import write_tlinear

SHAPE = (48, 64)
MATERIALS = ["grass_green", "asphalt", "own_material"]
BALANCE, REDRAWN = "heat balance of tables", "floor: hidden state redrawn, over √2"
MEAN = "constant: mean of the training part"
HIDDEN_K = 0.8


def linear_map(name="linear", intercept=0.0):
    kernel = np.array([[[0.3, 0.4, -0.2]]])
    return TemperatureMap(
        name, "correlation-1to1", Correlation(kernel, intercept), (285.0, 305.0), BAND_UM, 0.1, (0.05, 0.2),
        "zenmuse-xt2", 255.0, "a test", about={"training_s": 3.0},
    )  # fmt: skip


@functools.cache
def known_pair(number):
    """(visible, temperature [K], error of `linear_map` [K], material) of a pair."""
    rng = np.random.default_rng(number)
    visible = cv2.GaussianBlur(rng.integers(0, 256, (*SHAPE, 3)).astype(np.uint8), (0, 0), 2.0)
    error = rng.normal(0.3 * number, 1.0 + 0.1 * number, SHAPE)
    material = rng.integers(0, 3, SHAPE).astype(np.uint8)
    material[:2] = 255
    given = brightness_temperature(linear_map().radiance(Inputs(visible)), *BAND_UM)
    return visible, given - error, error, material


def make_dataset(folder, pairs=10, test=6, truth=True, terrain=("sun",)):
    """A data set of rendered views whose last pairs are the test part."""
    scale = ThermalScale("radiance", 0.002, 0.0)
    card = {"title": "a toy", **({"materials": MATERIALS, "terrain": list(terrain)} if truth else {})}
    writer, members = Writer(folder, card, scale), []
    for number in range(pairs):
        visible, temperature, _, material = known_pair(number)
        radiance = band_radiance(temperature, *BAND_UM)
        rng = np.random.default_rng(100 + number)
        middle = temperature - rng.normal(0.0, HIDDEN_K, SHAPE)
        planes = {
            "radiance": radiance, "material": material, "sun": np.full(SHAPE, 0.5, np.float32),
            "balance": band_radiance(temperature + 1.5, *BAND_UM),
            "redrawn": band_radiance(middle + rng.normal(0.0, HIDDEN_K, SHAPE), *BAND_UM),
        }  # fmt: skip
        valid = np.ones(SHAPE, bool)
        valid[:, :3] = False
        entry = Entry(
            f"p{number}", "test" if number >= pairs - test else "train", f"p{number}", f"world{number}", 0, SHAPE, 0.1,
            conditions={"air_k": 290.0, "solar_hour": 6.0 + number},
            labels={"kind": "heath" if number % 2 else "village", "view": "nadir"},
        )  # fmt: skip
        thermal = np.rint(radiance / scale.step).astype(np.uint16)
        members.append((entry, packed(visible, thermal, valid, planes if truth else None)))
    writer.shard("all", members)
    return read_dataset(folder)


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


# --- sums, intervals, similarity --------------------------------------------------------------------------------


def test_sums_of_parts_add_up_to_the_statistics_of_all_errors():
    rng = np.random.default_rng(1)
    error, group = rng.normal(1.5, 2.0, (30, 40)), rng.integers(0, 3, (30, 40))
    error[3, 4:9] = np.nan
    rows = sums.rows_by(error, group, 4)
    reported, all_of_it = sums.summary(rows.sum(axis=0)), error[np.isfinite(error)]
    assert reported["me_k"] == pytest.approx(all_of_it.mean()) and reported["sd_k"] == pytest.approx(all_of_it.std())
    assert reported["mae_k"] == pytest.approx(np.abs(all_of_it).mean())
    assert reported["rmse_k"] == pytest.approx(np.sqrt((all_of_it**2).mean()))
    assert reported["pixels"] == 1195 and reported["pixels_without_temperature"] == 5
    assert sums.summary(rows[2])["mae_k"] == pytest.approx(np.nanmean(np.abs(error[group == 2])))
    assert sums.summary(rows[3])["mae_k"] is None
    np.testing.assert_allclose(sums.row(error), rows.sum(axis=0))


def test_interval_of_a_known_distribution():
    """Means of 400 independent clusters of 9 equal errors: ±1.96 σ/√400, whatever is inside a cluster."""
    error = np.repeat(np.random.default_rng(2).normal(0.5, 2.0, 400), 9)
    rows = np.stack([sums.row(one) for one in error])
    low, high = sums.intervals(rows, np.arange(3600) // 9, seed=3)["me_k"]
    assert low < error.mean() < high
    assert high - low == pytest.approx(2 * 1.96 * error.std() / np.sqrt(400), rel=0.1)
    assert sums.intervals(rows, np.arange(3600) // 9, seed=3)["me_k"] == (low, high)
    assert sums.intervals(rows, np.zeros(3600, int))["me_k"] is None


def of_errors(absolute, pixels=100):
    """Rows of sums of pictures with given mean absolute errors."""
    absolute = np.asarray(absolute, np.float64)
    row = np.zeros((*absolute.shape, sums.WIDTH))
    row[..., 0], row[..., 2] = pixels, pixels * absolute
    return row


def test_interval_of_a_difference_is_paired_by_picture():
    rng = np.random.default_rng(5)
    common, own = rng.normal(9.0, 2.0, 400), rng.normal(0.25, 0.1, 400)
    cluster = np.arange(3600) // 9
    rows = np.repeat(of_errors([common, common + own]), 9, axis=1)
    ((group, more, (low, high)),) = paired.differences(rows, [[0], [1]], cluster, seed=1)
    assert group == [1] and more == pytest.approx(own.mean())
    # Their common error, twenty times the scatter of the difference, does not widen the interval.
    assert high - low == pytest.approx(2 * 1.96 * own.std() / np.sqrt(400), rel=0.1) and low < more < high
    # A picture that one of them lacks counts for neither, and one cluster gives no interval.
    rows[1, :9] = 0.0
    assert paired.differences(rows, [[0], [1]], cluster)[0][1] == pytest.approx(own[1:].mean())
    assert paired.differences(rows, [[0], [1]], np.zeros(3600, int))[0][2] is None
    # Without a picture that both have, there is nothing to compare.
    rows[1] = 0.0
    assert paired.differences(rows, [[0], [1]], cluster) == [([1], None, None)]
    assert paired.differences(rows[:, :0], [[0], [1]], cluster[:0]) == [([1], None, None)]


def test_interval_of_a_difference_includes_the_scatter_of_seeds():
    """Equal pictures, so only seeds scatter: s √(1/3 + 1/3) for two methods with three seeds each."""
    first, other = np.array([1.0, 1.3, 1.6]), np.array([2.0, 2.3, 2.6])
    rows = of_errors(np.repeat([*first, *other], 50).reshape(6, 50))
    ((_, more, (low, high)),) = paired.differences(rows, [[0, 1, 2], [3, 4, 5]], np.arange(50), seed=2)
    assert more == pytest.approx(1.0) and low < 1.0 < high
    # Few values are drawn, so the percentiles are coarse.
    assert high - low == pytest.approx(2 * 1.96 * first.std(ddof=1) * np.sqrt(2.0 / 3.0), rel=0.15)


def test_maps_that_differ_only_in_their_seed_are_grouped():
    maps = [dataclasses.replace(linear_map(), about=about) for about in (
        {"seed": 0, "options": {"depth": True}}, {"seed": 0, "options": {"depth": False}},
        {"seed": 1, "options": {"depth": True}}, {}, {},
    )]  # fmt: skip
    assert paired.kin([LearnedMap("m", each) for each in maps]) == [[0, 2], [1], [3], [4]]
    # A privileged map counts as another method, and one seed twice as two trainings.
    assert paired.kin([LearnedMap("m", maps[0]), LearnedMap("o", maps[2], privileged=True)]) == [[0], [1]]
    assert paired.kin([LearnedMap("m", maps[0]), LearnedMap("n", maps[0])]) == [[0], [1]]


def test_whole_sequences_are_resampled_however_few_they_are():
    entries = [Entry(f"k{n}", "test", f"parent{n // 4}", f"flight{n % 2}", 0, SHAPE) for n in range(12)]
    number, what = sums.clusters(entries)
    assert what == "2 sequences" and number.tolist() == [0, 1] * 6
    assert sums.clusters(entries[:1])[1] == "1 sequence"


# --- structure --------------------------------------------------------------------------------------------------


def smooth(seed, side=96):
    """A picture whose structure is some 10 px large, of standard deviation 1 [K]."""
    image = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=(side, side)), (0, 0), 4.0)
    return 290.0 + (image - image.mean()) / image.std()


def test_structure_scores_follow_a_known_relation_to_the_truth():
    """A guess 5 + 0.5 (T − mean) + noise of standard deviation 0.5 K."""
    true, known = smooth(0), np.ones((96, 96), bool)
    noise = 0.5 * (smooth(1) - 290.0)
    across = noise - (noise * (true - 290.0)).mean() * (true - 290.0)
    across *= 0.5 / across.std()
    guess = 295.0 + 0.5 * (true - 290.0) + across
    found = structure.summary([structure.row(guess, true, known)], [0])
    assert found["correlation"] == pytest.approx(np.sqrt(0.5), abs=1e-6)
    assert found["slope"] == pytest.approx(0.5, abs=1e-6)
    error = across - 0.5 * (true - 290.0)
    assert found["mae_without_mean_k"] == pytest.approx(np.abs(error).mean(), abs=1e-6)
    # A hidden pixel counts nowhere.
    known[40, 40], guess[40, 40] = False, 1e4
    assert structure.summary([structure.row(guess, true, known)], [0])["slope"] == pytest.approx(0.5, abs=0.01)


def test_the_shift_shows_structure_that_a_constant_lacks():
    true, known = smooth(2), np.ones((96, 96), bool)
    exact = structure.summary([structure.row(true, true, known)], [0])
    # Of two independent pictures of standard deviation 1, the mean absolute difference is 2 / √π.
    assert exact["shift_more_k"] == pytest.approx(2.0 / np.sqrt(np.pi), abs=0.25)
    assert exact["correlation"] == pytest.approx(1.0) and abs(exact["correlation_shifted"]) < 0.35
    flat = structure.summary([structure.row(np.full_like(true, 290.0), true, known)], [0])
    assert flat["correlation"] is None and flat["slope"] == 0.0 and abs(flat["shift_more_k"]) < 0.1
    assert flat["mae_without_mean_k"] == pytest.approx(np.abs(true - 290.0).mean(), abs=1e-6)


def test_structure_intervals_are_those_of_sequences():
    """Equal pictures of two sequences: a draw by picture would give a narrow interval, one by sequence both ends."""
    rows = np.ones((40, structure.WIDTH))
    rows[20:, 0] = 0.0
    number = np.repeat([0, 1], 20)
    assert structure.summary(rows, number)["interval_95"]["correlation"] == (0.0, 1.0)
    low, high = structure.summary(rows, np.arange(40))["interval_95"]["slope"]
    assert low == high == 1.0
    assert structure.summary(rows, np.zeros(40, int))["interval_95"]["correlation"] is None
    assert structure.summary(np.full((3, structure.WIDTH), np.nan), [0, 1, 2])["slope"] is None


def test_pictures_without_the_method_or_too_narrow_to_shift_are_left_out():
    true, known = smooth(3)[:12, :12], np.ones((12, 12), bool)
    narrow = structure.row(true + 1.0, true, known)
    none = structure.row(np.full_like(true, np.nan), true, known)
    found = structure.summary([narrow, none], [0, 1])
    assert found["correlation"] == pytest.approx(1.0) and found["shift_more_k"] is None
    assert found["mae_without_mean_k"] == pytest.approx(0.0, abs=1e-9)


def test_structural_similarity_equals_a_direct_sum():
    rng = np.random.default_rng(4)
    true = np.rint(rng.uniform(0, 255, (20, 23)))
    other = np.clip(true + np.rint(rng.normal(10, 30, true.shape)), 0, 255)
    known = np.ones(true.shape, bool)
    known[0, 0] = known[7, 16] = False
    found = similarity.Similarity(true, known).row(other)
    axis = np.arange(-5, 6)
    window = np.exp(-(axis[:, None] ** 2 + axis**2) / (2 * 1.5**2))
    window /= window.sum()
    values = []
    for row in range(5, 15):
        for column in range(5, 18):
            part = np.s_[row - 5 : row + 6, column - 5 : column + 6]
            if known[part].all():
                x, y = other[part], true[part]
                mx, my = (window * x).sum(), (window * y).sum()
                vx, vy = (window * (x - mx) ** 2).sum(), (window * (y - my) ** 2).sum()
                xy = (window * (x - mx) * (y - my)).sum()
                c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
                values.append((2 * mx * my + c1) * (2 * xy + c2) / ((mx**2 + my**2 + c1) * (vx + vy + c2)))
    reported = similarity.summary(found)
    assert found[3] == len(values) > 20 and reported["ssim"] == pytest.approx(np.mean(values), rel=1e-9)
    square = ((other - true)[known] ** 2).mean()
    assert reported["psnr_db"] == pytest.approx(10 * np.log10(255**2 / square))
    same = similarity.summary(similarity.Similarity(true, known).row(true))
    assert same["ssim"] == pytest.approx(1.0) and same["psnr_db"] is None


def test_eight_bit_values_are_clipped_between_bounds():
    shown = similarity.eight_bit(np.array([280.0, 290.0, 295.0, 310.0, 320.0, np.nan]), (290.0, 310.0))
    assert shown.tolist() == [0.0, 0.0, 64.0, 255.0, 255.0, 0.0]


# --- classes ----------------------------------------------------------------------------------------------------


def test_every_material_of_the_library_is_natural_or_man_made():
    assert not classes.MAN_MADE & classes.NATURAL
    assert set(load_library()) == classes.MAN_MADE | classes.NATURAL


def test_edges_are_two_pixels_around_a_step():
    image = np.full((9, 12), 290.0)
    image[:, 6:] += 3.0
    # Central differences see the step from columns 5 and 6.
    assert (classes.edge_class(image) == 0).all(axis=0).nonzero()[0].tolist() == list(range(3, 9))
    image[:, 6:] -= 1.5
    assert classes.edge_class(image).all(), "0.75 K a pixel is none"


# --- the whole --------------------------------------------------------------------------------------------------


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


def test_exact_map_has_no_error(undrawn, tmp_path, monkeypatch):
    monkeypatch.setitem(globals(), "known_pair", lambda n, of=known_pair: _exact(*of(n)))
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
    for text in ("## Cost", "## Material", "## Man-made and natural", "published: pix2pixHD", report.CAVEAT, "asphalt"):
        assert text in page, text
    assert len(list(folder.glob("errors_*.png"))) == 5
    assert all(path.stat().st_size > 10_000 for path in folder.glob("*.png"))
    for header, lines in ((report.HEADER, report.rows(result)), (report.HEADER, report.published_rows())):
        assert {len(line) for line in lines} == {len(header)}


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
    assert any("assume 14…24 °C" in line for line in report.lines_before(result))
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

    monkeypatch.setattr("thermorender.apps.compare.evaluation.evaluate.audit", audit)
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
